"""Which disc of the left image and which of the right may be one disc of a body, and its position then.

Uncoded discs have no names. A pair is possible where both rays lie in one epipolar plane within what pixel noise and
the rig's own covariance allow, where they meet in front of both cameras within reach, and where a disc of one of the
body's radii at that distance looks as large as both ellipses do. The first pass runs over the sorted angles of the
epipolar planes, so its time grows with the pairs that the planes allow and not with all of them.

:class:`DiscView` is one shot of a body's discs with the tolerances for size and position. :func:`wrong_size` explains a
miss: the pairs that the epipolar planes allow are triangulated without a test of their size, and a common ratio of
radii or distances to the body's is reported.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import permutations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Discs, Ids, Record
from armsight.geometry.near import pairs_within
from armsight.geometry.pose import inverse, transform
from armsight.kernels import kernel, kernel_types
from armsight.vision.camera import Camera
from armsight.vision.discs.bias import Expected
from armsight.vision.markers.discs import DiscTarget
from armsight.vision.match import GATE_PX, SIGMAS, epipolar_distances
from armsight.vision.rig import StereoRig
from armsight.vision.triangulate import midpoints, optimal_points, pixels_by_rig

#: An ellipse may be this much longer or shorter than the disc would look, beyond SIGMAS standard deviations of its rim.
SIZE_TOLERANCE = 0.15
#: The same along any of its axes, where the orientation of the disc is known.
SHAPE_TOLERANCE = 0.25
#: Errors that neither noise nor calibration explain: exposures that are not quite simultaneous, ink that ran, px; and a
#: body that deviates from its file, as a share of its size. One standard deviation each.
UNMODELLED_PX, UNMODELLED_SHARE = 0.1, 2e-3


@dataclass(frozen=True, eq=False)
class DiscView(Record):
    """One shot of a body's discs, with the quantities that every test of it needs.

    Attributes:
        rig: the calibrated pair.
        target: the body's discs.
        discs: the discs detected in the left and the right image.
        cov_uv: per camera (N, 2, 2) covariance of the centres: that of the image, the rig's and the unmodelled, px^2.
        radius_px: per camera (N,) longer half axes; NaN, which matches nothing, where a disc was detected a second
            time.
        tolerance_px: per camera (N,) how far noise alone may change a half axis.
        rig_root: (P, R) with rig_root @ rig_root.T the rig's covariance, without the directions that are exact.
        made_sigma_m: standard deviation of a disc's position on the body as it was made, m.
    """

    rig: StereoRig
    target: DiscTarget
    discs: tuple[Discs, Discs]
    cov_uv: tuple[Array, Array]
    radius_px: tuple[Array, Array]
    tolerance_px: tuple[Array, Array]
    rig_root: Array
    made_sigma_m: float

    @staticmethod
    def of(rig: StereoRig, target: DiscTarget, left: Discs, right: Discs) -> DiscView:
        """Gather one shot."""
        more = (rig.sigma_px**2 + UNMODELLED_PX**2) * np.eye(2)
        tolerance = (SIGMAS * np.sqrt(np.trace(seen.cov_uv, axis1=1, axis2=2) / 2) for seen in (left, right))
        return DiscView(
            rig,
            target,
            (left, right),
            (left.cov_uv + more, right.cov_uv + more),
            (_radius_once(left), _radius_once(right)),
            (next(tolerance), next(tolerance)),
            _root(rig),
            UNMODELLED_SHARE * float(np.linalg.norm(np.ptp(target.body.points, axis=0))),
        )

    def alike(self, expected: Expected, side: int) -> NDArray[np.bool_]:
        """(M, N) which detections of one camera have a disc's brightness and about the length of its ellipse."""
        seen, long, share = self.radius_px[side], expected.radius_px[:, side, None], SIZE_TOLERANCE
        size = np.abs(seen - long) <= share * long + self.tolerance_px[side]
        return np.asarray(size & (self.discs[side].bright == self.target.bright[:, None]))

    def congruent(self, expected: Expected, side: int) -> NDArray[np.bool_]:
        """(M, N) which detections of one camera have the size, the slenderness and the direction of a disc's ellipse."""
        alike = self.alike(expected, side)
        m, n = np.nonzero(alike & np.isfinite(expected.facing[:, side, None]))
        a, b, c = expected.shape[m, side].T
        det = a * c - b * b
        s11, s12, s22 = self.discs[side].shape[n].T
        # Squares of how many times longer each ellipse is: the eigenvalues of S_expected^-1 S.
        mean, product = (c * s11 - 2 * b * s12 + a * s22) / (2 * det), (s11 * s22 - s12**2) / det
        half = np.sqrt(np.maximum(mean**2 - product, 0.0))
        tolerance = SHAPE_TOLERANCE + self.tolerance_px[side][n] / np.sqrt(det / np.maximum(a, c))
        slim = (np.sqrt(np.maximum(mean - half, 0.0)) < 1 - tolerance) | (np.sqrt(mean + half) > 1 + tolerance)
        alike[m[slim], n[slim]] = False
        return alike

    def covariances(self, expected: Expected, m: Ids, side: int, rows: Ids) -> Array:
        """Return (K, 2, 2) covariance of detections ``rows`` as discs ``m``, px^2: noise, and the tolerance of the body."""
        made = self.made_sigma_m * expected.radius_px[m, side] / self.target.radii_m[m]
        return np.asarray(
            self.cov_uv[side][rows] + made[:, None, None] ** 2 * np.eye(2) + expected.cov_bias[m, side], np.float64
        )


def _radius_once(discs: Discs) -> Array:
    """Return (N,) longer half axes, NaN where one as large lies within half of it: the same disc detected again."""
    radius = discs.radius_px
    if len(radius) < 2:
        return radius
    one, again = pairs_within(discs.uv, radius.max() / 2).T
    near = np.linalg.norm(discs.uv[one] - discs.uv[again], axis=1) < radius[one] / 2
    same = near & (np.abs(radius[one] - radius[again]) < SIZE_TOLERANCE * radius[one])
    radius[again[same & (discs.bright[one] == discs.bright[again])]] = np.nan
    return radius


@lru_cache(maxsize=4)
def _root(rig: StereoRig) -> Array:
    """Return (P, R) with root @ root.T the rig's covariance, without the directions that are exact."""
    cov = rig.cov
    sigma = np.sqrt(np.diag(cov))
    scale = np.where(sigma > 0, sigma, 1.0)
    values, vectors = np.linalg.eigh(cov / np.outer(scale, scale))
    keep = values > 1e-12
    return np.asarray(scale[:, None] * vectors[:, keep] * np.sqrt(values[keep]))


#: With more discs than this in view, or a ratio outside of these, nothing is reported.
_MOST_DISCS, _LEAST, _MOST = 12, 0.2, 5.0
#: Ratios of one body agree within this; a ratio nearer to 1 explains nothing.
_ALIKE_RADIUS, _ALIKE_LENGTH = 0.08, 0.01


def wrong_size(rig: StereoRig, target: DiscTarget, left: Discs, right: Discs) -> str | None:
    """Report that the discs in view have another radius or other distances than the body's, by one ratio; or None."""
    if max(len(left.uv), len(right.uv)) > _MOST_DISCS or min(len(left.uv), len(right.uv)) < 3:
        return None
    i, j = np.divmod(np.arange(len(left.uv) * len(right.uv)), len(right.uv))
    keep = epipolar_distances(rig, left.uv[i], right.uv[j]).max(axis=1) <= GATE_PX
    i, j = i[keep], j[keep]
    p = midpoints(rig, left.uv[i], right.uv[j])
    keep = np.isfinite(p).all(axis=1)
    i, j, p = i[keep], j[keep], p[keep]
    if not 3 <= len(p) <= _MOST_DISCS:
        return None
    radii = left.radius_px[i] * p[:, 2] / rig.left.intrinsics[0]
    ratio = float(np.median(radii)) / float(np.median(target.radii_m))
    alike = np.abs(radii / np.median(radii) - 1).max() < _ALIKE_RADIUS
    if alike and len(set(target.radii_m)) == 1 and _explains(ratio, 2 * _ALIKE_RADIUS):
        return (
            f"the discs in view have a radius of about {1e3 * np.median(radii):.1f} mm, those of {target.body.name} "
            f"{1e3 * target.radii_m[0]:.1f} mm: is radius_mm right?"
        )
    scale = _size_scale(p, target.body.points)
    if scale is None or not _explains(scale, _ALIKE_LENGTH):
        return None
    return (
        f"three discs in view lie {scale:.3f} times as far apart as those of {target.body.name}: are the positions in "
        "the body file right, and is it the body that the cameras see?"
    )


def _explains(ratio: float, tolerance: float) -> bool:
    """Whether a ratio is one that a mistake in the body file gives."""
    return _LEAST < ratio < _MOST and abs(ratio - 1) > tolerance


def _size_scale(p: Array, points: Array) -> float | None:
    """Return the one ratio by which a triangle of p (N, 3) is similar to the body's first three discs; None without one."""
    corners, body = p[np.array(list(permutations(range(len(p)), 3)))], points[:3]
    sides = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
    sides /= np.linalg.norm(body - np.roll(body, -1, axis=0), axis=1)
    found = sides[np.ptp(sides, axis=1) < _ALIKE_LENGTH * sides.mean(axis=1)].mean(axis=1)
    return float(found[0]) if len(found) and np.ptp(found) < _ALIKE_LENGTH * found[0] else None


#: Nearest and farthest disc, m.
DEPTHS_M = (0.1, 10.0)
#: Two rays do not meet where their distance is more than so many standard deviations.
GATE_SIGMAS = 5.0
#: With more pairs than this none is examined.
MOST_PAIRS = 20_000
_STEP_PX = 0.5  # to differentiate the angle of an epipolar plane


@dataclass(frozen=True, eq=False)
class Pairs(Record):
    """Pairs of discs that may be one disc of the body.

    Attributes:
        left: (K,) rows of the left camera's discs.
        right: (K,) rows of the right camera's discs.
        p_left: (K, 3) position of the disc, m, left frame.
        cov: (K, 3, 3) its covariance from the pixel noise, m^2.
        by_rig: (K, 3, R) its change by each of the rig's R independent errors of one standard deviation, m.
        fits: (K, M) whether it may be a disc of the body, by size and brightness.
    """

    left: Ids
    right: Ids
    p_left: Array
    cov: Array
    by_rig: Array
    fits: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class _Lines(Record):
    """The N discs of one image as epipolar planes, at an angle about the baseline, rad; NaN where a pixel has no ray.

    ``by_pixel`` (N, 2): its derivative; ``variance``: from the noise of the centre, rad^2; ``along``: component of the
    ray along the baseline for one unit away from it; ``out`` (N, 3): the ray, ending one unit away, left frame;
    ``scale`` (N, 2): least and largest half axis, px, of a disc of unit radius at unit distance.
    """

    angle: Array
    by_pixel: Array
    variance: Array
    along: Array
    out: Array
    scale: Array


def pair(view: DiscView) -> Pairs | None:
    """Find the pairs of discs that may be one disc of the body; None where they are more than MOST_PAIRS."""
    (left, right), target, baseline = view.discs, view.target, view.rig.T_left_right[:3, 3].copy()
    lines = _lines(view.rig, 0, left.uv, view.cov_uv[0]), _lines(view.rig, 1, right.uv, view.cov_uv[1])
    reach = np.sqrt(lines[1].variance.max(initial=0.0, where=np.isfinite(lines[1].variance)))
    gate = GATE_SIGMAS * (np.sqrt(lines[0].variance + _share_of_rig(view, lines[0])) + reach)
    order = np.argsort(lines[1].angle)
    order = order[np.isfinite(lines[1].angle[order])]
    kinds = np.unique(np.column_stack([target.radii_m, target.bright]), axis=0)
    rows = np.empty((MOST_PAIRS, 2), np.int64)
    in_left, in_right = _side(view, lines[0], 0), _side(view, lines[1], 1)
    radii, bright = kinds[:, 0].copy(), kinds[:, 1] > 0.5
    found = _sweep(gate, order, lines[1].angle[order], in_left, in_right, baseline, radii, bright, rows)
    return None if found > MOST_PAIRS else _triangulated(view, lines, rows[:found])


def _lines(rig: StereoRig, side: int, uv: Array, cov_uv: Array) -> _Lines:
    """Convert the discs of one image to epipolar planes about the baseline."""
    camera, R = rig.cameras[side], np.eye(3) if side == 0 else rig.T_left_right[:3, :3]
    along = rig.T_left_right[:3, 3] / rig.baseline_m
    ahead = rig.T_left_right[:3, 2] + np.array([0.0, 0.0, 1.0])
    ahead -= (ahead @ along) * along
    ahead /= np.linalg.norm(ahead)
    axes = np.stack([along, np.cross(ahead, along), ahead])

    def planes(at: Array) -> tuple[Array, Array]:
        rays = camera.unproject(at) @ R.T
        in_axes = rays @ axes.T
        return np.arctan2(in_axes[:, 1], in_axes[:, 2]), rays

    angle, rays = planes(uv)
    steps = [planes(uv + s * _STEP_PX * np.eye(2)[k])[0] for k in (0, 1) for s in (1, -1)]
    by_pixel = np.stack([steps[0] - steps[1], steps[2] - steps[3]], axis=1) / (2 * _STEP_PX)
    variance = np.einsum("ni,nij,nj->n", by_pixel, cov_uv, by_pixel)
    away = np.linalg.norm(rays - (rays @ along)[:, None] * along, axis=1)
    return _Lines(angle, by_pixel, variance, rays @ along / away, rays / away[:, None], _scale(camera, rays @ R))


def _scale(camera: Camera, p: Array) -> Array:
    """Return (N, 2) smallest and largest half axis, px, of a disc of unit radius at points (N, 3), any orientation."""
    good = np.asarray(np.isfinite(p).all(axis=1))
    J = camera.project_jacobians(np.where(good[:, None], p, [0.0, 0.0, 1.0]))[1]
    a, b, c = (J[:, 0] ** 2).sum(axis=1), (J[:, 0] * J[:, 1]).sum(axis=1), (J[:, 1] ** 2).sum(axis=1)
    mean, half = (a + c) / 2, np.hypot((a - c) / 2, b)
    scale = np.sqrt(np.stack([np.maximum(mean - half, 0.0), mean + half], axis=1))
    return np.asarray(np.where(good[:, None], scale, np.nan))


def _share_of_rig(view: DiscView, lines: _Lines) -> Array:
    """Return (N,) variance of the gap between the planes of a pair from the rig's covariance, rad^2, for each left disc.

    Evaluated at the nearest possible position of the disc, that of the smallest radius.
    """
    rig, left = view.rig, view.discs[0]
    if not view.rig_root.size or not len(left.uv):
        return np.zeros(len(left.uv))
    rays = rig.left.unproject(left.uv)
    distance = (1 - SIZE_TOLERANCE) * lines.scale[:, 0] * view.target.radii_m.min() / view.radius_px[0]
    p = np.where(np.isfinite(rays), rays * np.clip(distance, *DEPTHS_M)[:, None], [0.0, 0.0, 1.0])
    uv_right = rig.right.project(transform(inverse(rig.T_left_right), p))
    there = np.asarray(np.isfinite(uv_right).all(axis=1))
    right = _lines(rig, 1, np.where(there[:, None], uv_right, 0.0), view.cov_uv[0])
    w = np.concatenate([lines.by_pixel, -right.by_pixel], axis=1)
    J = pixels_by_rig(rig, p) @ view.rig_root
    share = np.einsum("ni,nir->nr", w, np.where(np.isfinite(J), J, 0.0))
    return np.asarray(np.nan_to_num((share**2).sum(axis=1)))


@kernel_types("const f8[::1], const f8[::1], const f8[:, ::1], const f8[:, ::1], f8[::1], f8[::1], const b1[::1]")
class _Side(NamedTuple):
    """The N discs of one image as the compiled sweep needs them, as in :class:`_Lines` and :class:`DiscView`."""

    angle: Array
    along: Array
    out: Array
    scale: Array
    radius_px: Array
    tolerance_px: Array
    bright: NDArray[np.bool_]


def _side(view: DiscView, of: _Lines, s: int) -> _Side:
    """Gather the discs of one image, camera s, for the sweep."""
    return _Side(of.angle, of.along, of.out, of.scale, view.radius_px[s], view.tolerance_px[s], view.discs[s].bright)


@kernel("f8[::1], i8[::1], f8[::1], _Side, _Side, f8[::1], f8[::1], b1[::1], i8[:, ::1]")
def _sweep(
    gate: Array, order: Ids, angle_r: Array, left: _Side, right: _Side, t: Array, radii: Array, bright: NDArray[np.bool_],
    rows: Ids,
) -> int:  # fmt: skip
    """Write the possible pairs into ``rows`` (L, 2); return their number, more than its length when it overflows.

    gate (N,): largest difference of the epipolar planes' angles for each left disc, rad; order (K,): right discs that
    have a ray by angle_r, ascending, rad; t (3,): position of the right camera, m, left frame; radii and bright (R,):
    the body's kinds of disc.
    """
    count, baseline = 0, np.sqrt(t[0] ** 2 + t[1] ** 2 + t[2] ** 2)
    for i in range(len(left.angle)):
        if not np.isfinite(gate[i] + left.angle[i]):
            continue
        k = np.searchsorted(angle_r, left.angle[i] - gate[i])
        while k < len(order) and angle_r[k] <= left.angle[i] + gate[i]:
            j = order[k]
            k += 1
            parallax = left.along[i] - right.along[j]
            if left.bright[i] != right.bright[j] or not parallax > 0.0:
                continue
            h = baseline / parallax
            x, y, z = h * left.out[i, 0], h * left.out[i, 1], h * left.out[i, 2]
            if not DEPTHS_M[0] <= z <= DEPTHS_M[1]:
                continue
            far_l = np.sqrt(x * x + y * y + z * z)
            far_r = np.sqrt((x - t[0]) ** 2 + (y - t[1]) ** 2 + (z - t[2]) ** 2)
            for m in range(len(radii)):
                a_l, a_r = radii[m] / far_l, radii[m] / far_r
                if (
                    bright[m] == left.bright[i]
                    and left.radius_px[i] >= (1 - SIZE_TOLERANCE) * left.scale[i, 0] * a_l - left.tolerance_px[i]
                    and left.radius_px[i] <= (1 + SIZE_TOLERANCE) * left.scale[i, 1] * a_l + left.tolerance_px[i]
                    and right.radius_px[j] >= (1 - SIZE_TOLERANCE) * right.scale[j, 0] * a_r - right.tolerance_px[j]
                    and right.radius_px[j] <= (1 + SIZE_TOLERANCE) * right.scale[j, 1] * a_r + right.tolerance_px[j]
                ):
                    if count >= len(rows):
                        return len(rows) + 1
                    rows[count, 0], rows[count, 1] = i, j
                    count += 1
                    break
    return count


def _triangulated(view: DiscView, lines: tuple[_Lines, _Lines], rows: Ids) -> Pairs:
    """Triangulate pairs (K, 2) and keep those whose rays meet and whose size fits at that position."""
    rig, target, discs = view.rig, view.target, view.discs
    i, j = rows[:, 0], rows[:, 1]
    uv, cov_uv = (
        np.stack([discs[0].uv[i], discs[1].uv[j]], axis=1),
        np.stack([view.cov_uv[0][i], view.cov_uv[1][j]], axis=1),
    )
    p, cov, by_rig = optimal_points(rig, uv, cov_uv)
    good = np.flatnonzero(np.isfinite(p).all(axis=1))
    i, j, p = i[good], j[good], p[good]
    w = np.concatenate([lines[0].by_pixel[i], -lines[1].by_pixel[j]], axis=1)
    gap = lines[0].angle[i] - lines[1].angle[j]
    share = np.einsum("ni,nir->nr", w, pixels_by_rig(rig, p) @ view.rig_root)
    met = gap**2 <= GATE_SIGMAS**2 * (lines[0].variance[i] + lines[1].variance[j] + (share**2).sum(axis=1))
    kind = np.array(discs[0].bright[i][:, None] == target.bright[None])
    for side, chosen, p_camera in ((0, i, p), (1, j, transform(inverse(rig.T_left_right), p))):
        radius, tolerance = view.radius_px[side][chosen][:, None], view.tolerance_px[side][chosen][:, None]
        scale = _scale(rig.cameras[side], p_camera)
        kind &= radius >= (1 - SIZE_TOLERANCE) * scale[:, :1] * target.radii_m - tolerance
        kind &= radius <= (1 + SIZE_TOLERANCE) * scale[:, 1:] * target.radii_m + tolerance
    keep = met & kind.any(axis=1)
    return Pairs(i[keep], j[keep], p[keep], cov[good][keep], by_rig[good][keep] @ view.rig_root, kind[keep])
