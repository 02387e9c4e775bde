"""The background of both images: whether a camera still stands where it stood, without any marker.

In: shots. Out: findings. Conspicuous, stable spots of each background are learned from the mean of the first images:
corners (Shi and Tomasi, CVPR 1994), weighted by the spectral residual of the image (Hou and Zhang, "Saliency detection: a
spectral residual approach", CVPR 2007), without what changes meanwhile. Each later image says by how much each spot is
displaced from where it was first (Lucas and Kanade, with brightness and contrast of its own: a lamp is no motion), and a
robust fit to all spots of one camera by how much that rotated. What an arm or people hide does not look like its spot any
more; what else moves is outvoted. A spot's depth, from the other camera, distinguishes a shift from a rotation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from armsight.data import SIDES, Array, Image, Shot
from armsight.estimate.chance import squares_of
from armsight.geometry.pose import inverse, transform
from armsight.geometry.rotation import skew
from armsight.loop.finding import HealthFinding, alarm_limit, make_finding, sized
from armsight.vision.camera import Camera
from armsight.vision.image import grey
from armsight.vision.rig import StereoRig
from armsight.vision.triangulate import midpoints

Grey = NDArray[np.float32]
#: Looks a second, for the rate of false alarms; half, double: nothing that shows.
_LOOKS_HZ = 5.0
#: Images whose mean the spots are learned from, and then their noise; half: a noisier reference, double: after 8 s.
_LEARNED = 10
#: Cells of an image, at most one spot each; half: half as accurate, double: twice the time.
_CELLS = (10, 8)
#: Half the side of a spot's patch, px; half: fewer patterns are unmistakable, double: more of them are hidden now and then.
_HALF = 8
#: A spot is stable where the noise of one image displaces it by less, px; half: plain walls have none, double: noise has.
_STABLE_PX = 0.1
#: What changes by more than so many times the usual noise while spots are learned is no background.
_CHANGES = 3.0
#: Steps of Lucas and Kanade; a spot further than this from where it was, px, is not followed: half a patch.
_STEPS, _FAR_PX = 4, 4.0
#: A patch that leaves this share of its contrast unexplained is hidden; half: noise hides them, double: people do not.
_HIDDEN = 0.4
#: Fewest spots that say something, and the share of those seen that must agree; half: two chairs are a room.
_LEAST, _MAJORITY = 10, 0.5
#: Residuals beyond so many sigmas do not agree; rounds in which that settles.
_AGREES, _ROUNDS = 4.0, 8
#: A smaller rotation is not said, standard deviation, rad: mounts breathe; half: compression is said, double: 0.5 mm
#: not.
_FLOOR_RAD = np.radians(0.001)
#: Depths from this, m, on are tried for a spot, and patches of both cameras that correlate less are different ones.
_NEAREST_M, _ALIKE = 0.25, 0.8
#: A shift and a rotation are distinguished where their chi-squares differ by this.
_DISTINCT = 9.0
#: Looks in a row that must agree, and those without a motion after which the camera is back where it was.
_AGAIN, _BACK = 2, 10
_LIMIT = alarm_limit(3, _LOOKS_HZ, 2)
_SPOT = np.stack(np.meshgrid(*2 * [np.arange(-_HALF, _HALF + 1.0)]), axis=-1).reshape(-1, 2).astype(np.float32)


class CameraMotion(NamedTuple):
    """How a camera moved since its spots were learned."""

    #: (3,) of the camera about its own axes, rad, if it rotated alone; covariance (3, 3)
    rotation: tuple[Array, Array]
    #: (3,) of the camera, m, if it moved alone; covariance (3, 3); None where too few depths are known
    shift: tuple[Array, Array] | None
    favours: float  #: by how much the chi-square of a shift is larger than that of a rotation; 0 without a shift
    seen: int

    @property
    def chi_square(self) -> float:
        """Of no rotation, a mount's own breathing included."""
        return float(squares_of(*self.rotation))

    def sized(self) -> tuple[tuple[float, float], str, str]:
        """Return size and sigma (SI), unit and words of a shift where it explains it clearly, else of a rotation."""
        how = f"rotated by {np.degrees(sized(*self.rotation)[0]):.3f} deg"
        if self.shift is not None and self.favours <= _DISTINCT:
            shifted = f"moved by {1e3 * sized(*self.shift)[0]:.2f} mm"
            if self.favours < -_DISTINCT:
                return sized(*self.shift), "mm", shifted
            how += f", or {shifted}: the two cannot be distinguished"
        return sized(*self.rotation), "deg", how


class _Spots:
    """The spots of one camera: learned from images, then followed.

    Attributes:
        uv: (K, 2) where they are, raw pixels.
        depth_m: (K,) along the optical axis; NaN where it is not known.
    """

    def __init__(self, camera: Camera) -> None:
        self._camera, self._looks, self._tried = camera, 0, list[tuple[Array, Array, NDArray[np.bool_]]]()
        self._sum = self._squares = np.zeros(camera.image_size_px[::-1], np.float32)
        self.uv, self.depth_m = np.zeros((0, 2)), np.zeros(0)
        self._cov: Array = np.zeros((0, 2, 2))  # of a displacement, by noise of one grey level

    def learned(self, image: Grey) -> bool:
        """Take an image to learn from; return whether it is the last one: the mean of some, then how others scatter."""
        self._looks += 1
        if self._looks <= _LEARNED:
            self._sum, self._squares = self._sum + image, self._squares + image * image
            if self._looks == _LEARNED:
                self._choose()
            return False
        if self.followed:
            self._tried.append(self.displaced(image))
        if self._looks < 2 * _LEARNED:
            return False
        if self.followed:  # neighbouring pixels of compressed and interpolated images err alike
            scatter = np.array([np.where(seen[:, None], d, np.nan) for d, _, seen in self._tried])
            said = np.median([np.trace(cov, axis1=1, axis2=2) for _, cov, _ in self._tried], axis=0)
            always = np.isfinite(scatter).all(axis=(0, 2))
            ratio = scatter[:, always].var(axis=0, ddof=1).sum(axis=1) / said[always]
            self._cov = self._cov * max(float(np.median(ratio)) if always.any() else 1.0, 1.0)
        self._tried.clear()
        return True

    @property
    def followed(self) -> bool:
        return len(self.uv) >= _LEAST

    def _choose(self) -> None:
        mean, side = np.asarray(self._sum / _LEARNED, np.float32), 2 * _HALF + 1
        noise = np.sqrt(np.maximum(self._squares / _LEARNED - mean * mean, 0.0))
        self._sum = self._squares = np.zeros((0, 0), np.float32)
        usual = max(float(np.median(noise)), 0.3)
        steady = cv2.blur((noise < _CHANGES * usual).astype(np.float32), (side, side)) > 0.95
        strength = cv2.cornerMinEigenVal(mean, side, ksize=3) * side**2 / 4  # of the sums of squared derivatives
        good = (usual / np.sqrt(np.maximum(strength, 1e-9)) < _STABLE_PX) & steady
        rank = np.where(good, np.sqrt(strength) * _saliency(mean), 0.0)
        edge = _HALF + int(_FAR_PX) + 2
        rank[:edge], rank[-edge:], rank[:, :edge], rank[:, -edge:] = 0, 0, 0, 0
        chosen = []
        for v in np.array_split(np.arange(mean.shape[0]), _CELLS[1]):
            for u in np.array_split(np.arange(mean.shape[1]), _CELLS[0]):
                cell = rank[v[0] : v[-1] + 1, u[0] : u[-1] + 1]
                row, column = np.unravel_index(int(cell.argmax()), cell.shape)
                if cell[row, column] > 0:
                    chosen.append((u[0] + column, v[0] + row))
        self.uv = np.array(chosen, float).reshape(-1, 2)
        self.depth_m = np.full(len(chosen), np.nan)
        if not self.followed:
            return
        self._template = self._patches(mean, self.uv)
        slopes = (cv2.Scharr(mean, cv2.CV_32F, *each, scale=1 / 32) for each in ((1, 0), (0, 1)))
        rows = [
            *(self._patches(np.asarray(each, np.float32), self.uv) for each in slopes),
            self._template,
            np.ones_like(self._template),
        ]
        A = np.stack(rows, axis=2).astype(float)
        self._by = np.linalg.pinv(A)
        self._cov = np.linalg.inv(np.swapaxes(A, 1, 2) @ A)[:, :2, :2]
        self._contrast = self._template.std(axis=1)

    @staticmethod
    def _patches(image: Grey, uv: Array) -> Grey:
        """Return the patches (K, P) about pixels (K, 2); OpenCV's cubic interpolation would displace them."""
        at = (uv[:, None] + _SPOT).astype(np.float32)
        return np.asarray(cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_LINEAR))

    def displaced(self, image: Grey) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Return by how much each spot is displaced (K, 2), px, the covariance (K, 2, 2), and whether it is seen (K,)."""
        d = np.zeros_like(self.uv)
        patches = self._template
        for _ in range(_STEPS):
            patches = self._patches(image, self.uv + d)
            step = (self._by @ (patches - self._template)[..., None].astype(float))[:, :2, 0]
            d = np.clip(d - step, -2 * _FAR_PX, 2 * _FAR_PX)
        centred = patches - patches.mean(axis=1, keepdims=True)
        fixed = self._template - self._template.mean(axis=1, keepdims=True)
        share = (centred * fixed).sum(axis=1) / np.maximum((fixed**2).sum(axis=1), 1e-9)
        left = (centred - share[:, None] * fixed).std(axis=1)
        seen = (left < _HIDDEN * np.abs(share) * self._contrast) & (share > 0) & (np.abs(d) < _FAR_PX).all(axis=1)
        cov = self._cov * (left / np.maximum(share, 1e-3))[:, None, None] ** 2
        return d, cov, seen

    def moved(self, image: Grey) -> CameraMotion | None:
        if not self.followed:
            return None
        d, cov, seen = self.displaced(image)
        if seen.sum() < _LEAST:
            return None
        d, cov = d[seen], cov[seen] + 1e-8 * np.eye(2)
        rays = self._camera.unproject(self.uv[seen])
        _, J, _ = self._camera.project_jacobians(rays)
        focal = self.uv[seen] - self._camera.intrinsics[2:4]  # a lens that breathes moves spots to and from the middle
        rotating = np.concatenate([J @ skew(rays), focal[..., None]], axis=2)
        found = _fitted(rotating, d, cov)
        if found is None:
            return None
        x, C, _, good = found
        rotation = x[:3], C[:3, :3] + _FLOOR_RAD**2 * np.eye(3)
        depth = self.depth_m[seen] / rays[:, 2]
        known = np.isfinite(depth) & good
        if known.sum() < _LEAST:
            return CameraMotion(rotation, None, 0.0, int(good.sum()))
        shifting = np.concatenate([-J / depth[:, None, None], focal[..., None]], axis=2)
        rows = np.flatnonzero(known)
        moved, rotated = (_fitted(A[rows], d[rows], cov[rows], robust=False) for A in (shifting, rotating))
        if moved is None or rotated is None:
            return CameraMotion(rotation, None, 0.0, int(good.sum()))
        floor = (_FLOOR_RAD * float(np.median(self.depth_m[seen][rows]))) ** 2 * np.eye(3)
        scale = max(min(moved[2].mean(), rotated[2].mean()) / 2, 1.0)
        favours = float(moved[2].sum() - rotated[2].sum()) / scale
        return CameraMotion(rotation, (moved[0][:3], moved[1][:3, :3] + floor), favours, int(good.sum()))


def _saliency(image: Grey) -> Array:
    """Return how conspicuous each pixel (H, W) is, 1 on average."""
    small = cv2.resize(image, (64, 48), interpolation=cv2.INTER_AREA)
    F = np.fft.fft2(small)
    log = np.log(np.abs(F) + 1e-9).astype(np.float32)
    residual = np.exp(log - cv2.blur(log, (3, 3), borderType=cv2.BORDER_WRAP) + 1j * np.angle(F))
    map_ = cv2.GaussianBlur((np.abs(np.fft.ifft2(residual)) ** 2).astype(np.float32), (0, 0), 2.5)
    return np.asarray(cv2.resize(map_ / map_.mean(), image.shape[::-1]))


def _fitted(
    A: Array, d: Array, cov: Array, *, robust: bool = True
) -> tuple[Array, Array, Array, NDArray[np.bool_]] | None:
    """Fit displacements d (K, 2) by A (K, 2, P): fit, covariance, squares (K,), which agree; None without a majority."""
    half = np.linalg.inv(np.linalg.cholesky(cov))
    white, e = half @ A, (half @ d[..., None])[..., 0]
    good = np.ones(len(d), np.bool_)
    weights, x = np.ones(len(d)), np.zeros(A.shape[2])
    for _ in range(_ROUNDS if robust else 1):
        H = np.einsum("kip,k,kiq->pq", white, weights, white)
        x = np.linalg.lstsq(H, np.einsum("kip,k,ki->p", white, weights, e), rcond=1e-12)[0]
        squares = ((e - white @ x) ** 2).sum(axis=1)
        scale = max(float(np.median(squares)) / 1.3863, 1.0)
        weights = 1.0 / (1.0 + squares / scale) if robust else weights
        good = squares < _AGREES**2 * scale
    if good.sum() < max(_LEAST, _MAJORITY * len(d)):
        return None
    rows = np.flatnonzero(good)
    H = np.einsum("kip,kiq->pq", white[rows], white[rows])
    x = np.linalg.lstsq(H, np.einsum("kip,ki->p", white[rows], e[rows]), rcond=1e-12)[0]
    squares = ((e - white @ x) ** 2).sum(axis=1)
    excess = max(float(squares[rows].sum()) / max(2 * len(rows) - len(x), 1), 1.0)
    return x, excess * np.linalg.pinv(H), squares, good


class SceneWatch:
    """Watches the background of a pair of cameras."""

    def __init__(self, rig: StereoRig) -> None:
        self._rig = rig
        self._spots = tuple(_Spots(camera) for camera in rig.cameras)
        self._learning = True
        self._alarms, self._since = [0, 0], list[float | None]([None, None])
        self._quiet, self._found = 0, tuple[HealthFinding, ...]()

    @property
    def spots(self) -> tuple[int, int]:
        """How many spots of each camera are watched; 0 before they were learned."""
        left, right = self._spots
        return len(left.uv), len(right.uv)

    def take(self, shot: Shot, t_s: float, p_left: Array | None = None) -> None:
        """Look at a shot, in order of time, s; the cost of a finding is that at a point (3,), m, left camera."""
        if shot.left is None or shot.right is None:
            return
        images = tuple(_float(image) for image in (shot.left, shot.right))
        if any(i.shape[::-1] != c.image_size_px for i, c in zip(images, self._rig.cameras, strict=True)):
            return
        if self._learning:
            ready = [spots.learned(image) for spots, image in zip(self._spots, images, strict=True)]
            self._learning = not all(ready)
            if not self._learning:
                self._find_depths(images)
            return
        motions = [spots.moved(image) for spots, image in zip(self._spots, images, strict=True)]
        self._count(motions, t_s)
        certain = [count >= _AGAIN for count in self._alarms]
        self._quiet = 0 if any(self._alarms) else self._quiet + 1
        if self._quiet == _BACK:
            self._found = tuple(replace(each, corrected_s=each.corrected_s or t_s) for each in self._found)
        if any(certain):
            at = np.array([0.0, 0.0, 1.0]) if p_left is None else p_left
            self._found = self._said(motions, certain, at)

    def _count(self, motions: Sequence[CameraMotion | None], t_s: float) -> None:
        """Count looks in a row at which a camera seems to have moved, and note when the first was, s."""
        for side, motion in enumerate(motions):
            if motion is None:
                continue
            alarm = motion.chi_square > _LIMIT
            self._since[side] = (t_s if self._alarms[side] == 0 else self._since[side]) if alarm else None
            self._alarms[side] = self._alarms[side] + 1 if alarm else 0

    def findings(self) -> tuple[HealthFinding, ...]:
        """Return what was found so far; nothing while all is well."""
        return self._found

    def _find_depths(self, images: Sequence[Grey]) -> None:
        """Find the depth of each spot: the distance along its ray at which the other camera sees the same patch."""
        for side, spots in enumerate(self._spots):
            if not spots.followed:
                continue
            other = self._rig.cameras[1 - side]
            T = inverse(self._rig.T_left_right) if side == 0 else self._rig.T_left_right
            pixels = float(other.intrinsics[0]) * self._rig.baseline_m / _NEAREST_M  # of the nearest depth's disparity
            near = np.linspace(0.0, 1.0 / _NEAREST_M, max(int(pixels / 1.5), 2))[1:]
            rays = self._rig.cameras[side].unproject(spots.uv)
            p = transform(T, (rays[:, None] / rays[:, None, 2:] / near[:, None]).reshape(-1, 3))
            uv = other.project(p).reshape(len(rays), len(near), 2)
            mine = spots._patches(images[side], spots.uv)
            mine = _unit(mine)
            for k, row in enumerate(uv):
                inside = np.isfinite(row).all(axis=1)
                alike = np.full(len(row), -1.0)
                alike[inside] = _unit(spots._patches(images[1 - side], row[inside])) @ mine[k]
                best = int(alike.argmax())
                apart = np.abs(np.arange(len(row)) - best) > 4
                if alike[best] > _ALIKE and (alike[apart] < alike[best] - 0.1).all():
                    spots.depth_m[k] = 1.0 / near[best]

    def _said(
        self, motions: Sequence[CameraMotion | None], certain: Sequence[bool], p_left: Array
    ) -> tuple[HealthFinding, ...]:
        moved = {side: motion for side, motion in enumerate(motions) if certain[side] and motion is not None}
        if not moved:
            return self._found
        side = max(moved, key=lambda each: moved[each].chi_square)
        together = len(moved) == 2 and self._alike(moved[0], moved[1])
        evidence, unit, how = moved[side].sized()
        who = f"the {SIDES[side]} camera {how}"
        if len(moved) == 2:
            who = f"both cameras moved{'' if together else ', not'} together: {who}"
        elif motions[1 - side] is not None:
            who += f", the {SIDES[1 - side]} one did not"
        return (
            make_finding(
                "scene together" if together else "scene",
                evidence,
                min((since for each in moved if (since := self._since[each]) is not None), default=None),
                cost_m=self._cost_m(moved, p_left, together=together),
                unit=unit,
                words={"who": who, "count": moved[side].seen},
            ),
        )

    def _alike(self, left: CameraMotion, right: CameraMotion) -> bool:
        """Return whether both cameras rotated as one."""
        R = self._rig.T_left_right[:3, :3]
        apart = left.rotation[0] - R @ right.rotation[0]
        cov = left.rotation[1] + R @ right.rotation[1] @ R.T
        return bool(squares_of(apart, cov) < _LIMIT)

    def _cost_m(self, moved: dict[int, CameraMotion], p_left: Array, *, together: bool) -> float:
        """Return by how much a measured point (3,) is displaced by rotations of the cameras, m."""
        if together:
            return float(np.linalg.norm(np.cross(moved[0].rotation[0], p_left)))
        uv = []
        for side, camera in enumerate(self._rig.cameras):
            p = p_left if side == 0 else transform(inverse(self._rig.T_left_right), p_left)
            rotated = moved[side].rotation[0] if side in moved else np.zeros(3)
            uv.append(camera.project((p - np.cross(rotated, p))[None]))
        (found,) = midpoints(self._rig, *uv)
        return float(np.linalg.norm(found - p_left))


def _float(image: Image) -> Grey:
    """Return an image in grey, smoothed as much as a patch is interpolated."""
    return np.asarray(cv2.GaussianBlur(grey(image), (0, 0), 0.7).astype(np.float32))


def _unit(patches: Grey) -> Grey:
    """Return patches (K, P) of mean zero and length one."""
    centred = patches - patches.mean(axis=1, keepdims=True)
    return np.asarray(centred / np.maximum(np.linalg.norm(centred, axis=1, keepdims=True), 1e-9))
