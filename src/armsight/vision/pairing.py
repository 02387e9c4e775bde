"""Which disc of the left image and which of the right may be one disc of a body, and where it is then.

Uncoded discs have no names. A pair is possible where both rays lie in one epipolar plane within what pixel noise and the
rig's own covariance allow, where they meet in front of both cameras within reach, and where a disc of one of the body's
radii at that distance looks as large as both ellipses do. The first pass runs over the sorted angles of the epipolar
planes, so its time grows with the pairs that the planes allow and not with all of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Discs, Ids, Record
from armsight.geometry.pose import inverse, transform
from armsight.geometry.rotation import skew
from armsight.vision.camera import Camera
from armsight.vision.markers.disc import DiscTarget
from armsight.vision.rig import StereoRig
from armsight.vision.triangulate import optimal_points

#: Nearest and farthest disc, m.
DEPTHS_M = (0.1, 10.0)
#: An ellipse may be this much longer or shorter than the disc would look, beyond six standard deviations of its centre.
SIZE_TOLERANCE, SIZE_SIGMAS = 0.15, 6.0
#: Two rays farther apart than so many standard deviations do not meet.
GATE_SIGMAS = 5.0
#: What neither noise nor calibration explain: shutters that are not quite simultaneous, ink that ran, px; and a body that
#: is not made as drawn, as a share of its size.
UNMODELLED_PX, UNMODELLED_SHARE = 0.1, 2e-3
#: More pairs than these are not looked at.
MOST_PAIRS = 20_000
_STEP_PX = 0.5  # to differentiate the angle of an epipolar plane


@dataclass(frozen=True, eq=False)
class Pairs(Record):
    """Pairs of discs that may be one disc of the body.

    Attributes:
        left: (K,) rows of the left camera's discs.
        right: (K,) rows of the right camera's discs.
        p_left: (K, 3) where the disc would be, m, left frame.
        cov: (K, 3, 3) its covariance from the pixel noise, m^2.
        by_rig: (K, 3, R) what the rig's R independent errors of one standard deviation each do to it, m.
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
    """The N discs of one image as epipolar planes.

    Attributes:
        angle: (N,) of the epipolar plane about the baseline, rad; NaN where a pixel has no ray.
        by_pixel: (N, 2) its derivative, rad/px.
        variance: (N,) of the angle from the noise of the disc's centre, rad^2.
        along: (N,) how far the ray goes along the baseline for one unit away from it.
        out: (N, 3) the ray, scaled to go one unit away from the baseline, left frame.
        scale: (N, 2) smallest and largest half axis, px, of a disc of unit radius at unit distance.
    """

    angle: Array
    by_pixel: Array
    variance: Array
    along: Array
    out: Array
    scale: Array


def noise(rig: StereoRig, cov_uv: Array) -> Array:
    """Return covariances (..., 2, 2) of ellipse centres with all that adds to what the image tells, px^2."""
    return np.asarray(cov_uv + (rig.sigma_px**2 + UNMODELLED_PX**2) * np.eye(2))


def fits(radius_px: Array, sigma_px: Array, shortest: Array, longest: Array) -> NDArray[np.bool_]:
    """Whether half axes with such a sigma can be those of discs that look between ``shortest`` and ``longest`` px."""
    slack = SIZE_SIGMAS * sigma_px
    return np.asarray(
        (radius_px >= (1 - SIZE_TOLERANCE) * shortest - slack) & (radius_px <= (1 + SIZE_TOLERANCE) * longest + slack)
    )


def pair(rig: StereoRig, target: DiscTarget, left: Discs, right: Discs) -> Pairs | None:
    """Find the pairs of discs that may be one disc of the body; None where they are more than MOST_PAIRS."""
    lines = _lines(rig, 0, left), _lines(rig, 1, right)
    share = _share_of_rig(rig, target, left, lines)
    reach = np.sqrt(lines[1].variance.max(initial=0.0, where=np.isfinite(lines[1].variance)))
    gate = GATE_SIGMAS * (np.sqrt(lines[0].variance + share) + reach)
    order = np.argsort(lines[1].angle)
    order = order[np.isfinite(lines[1].angle[order])]
    kinds = np.unique(np.column_stack([target.radii_m, target.bright]), axis=0)
    sizes = tuple((d.radius_px, SIZE_SIGMAS * size_sigma(d)) for d in (left, right))
    rows = np.empty((MOST_PAIRS, 2), np.int64)
    found = _walk(
        gate, order, lines[0].angle, lines[1].angle[order], lines[0].along, lines[1].along, lines[0].out,
        rig.baseline_m, lines[0].scale, lines[1].scale, *sizes[0], *sizes[1], left.bright, right.bright,
        kinds[:, 0].copy(), kinds[:, 1] > 0.5, rig.T_left_right[:3, 3].copy(), rows,
    )  # fmt: skip
    if found > MOST_PAIRS:
        return None
    return _triangulated(rig, target, left, right, lines, rows[:found])


def size_sigma(discs: Discs) -> Array:
    """(N,) about how well each half axis is known, px: as its centre."""
    return np.asarray(np.sqrt(np.trace(discs.cov_uv, axis1=1, axis2=2) / 2))


def _lines(rig: StereoRig, side: int, discs: Discs) -> _Lines:
    """Turn the discs of one image into epipolar planes about the baseline."""
    camera, R = rig.cameras[side], np.eye(3) if side == 0 else rig.T_left_right[:3, :3]
    along = rig.T_left_right[:3, 3] / rig.baseline_m
    ahead = rig.T_left_right[:3, 2] + np.array([0.0, 0.0, 1.0])
    ahead -= (ahead @ along) * along
    ahead /= np.linalg.norm(ahead)
    axes = np.stack([along, np.cross(ahead, along), ahead])

    def planes(uv: Array) -> tuple[Array, Array]:
        rays = camera.unproject(uv) @ R.T
        in_axes = rays @ axes.T
        return np.arctan2(in_axes[:, 1], in_axes[:, 2]), rays

    angle, rays = planes(discs.uv)
    steps = [planes(discs.uv + s * _STEP_PX * np.eye(2)[k])[0] for k in (0, 1) for s in (1, -1)]
    by_pixel = np.stack([steps[0] - steps[1], steps[2] - steps[3]], axis=1) / (2 * _STEP_PX)
    variance = np.einsum("ni,nij,nj->n", by_pixel, noise(rig, discs.cov_uv), by_pixel)
    away = np.linalg.norm(rays - (rays @ along)[:, None] * along, axis=1)
    return _Lines(angle, by_pixel, variance, rays @ along / away, rays / away[:, None], _scale(camera, rays @ R))


def _scale(camera: Camera, p: Array) -> Array:
    """Return (N, 2) smallest and largest half axis, px, of a disc of unit radius at points (N, 3), however it is turned."""
    good = np.asarray(np.isfinite(p).all(axis=1))
    J = camera.project_jacobians(np.where(good[:, None], p, [0.0, 0.0, 1.0]))[1]
    a, b, c = (J[:, 0] ** 2).sum(axis=1), (J[:, 0] * J[:, 1]).sum(axis=1), (J[:, 1] ** 2).sum(axis=1)
    mean, half = (a + c) / 2, np.hypot((a - c) / 2, b)
    scale = np.sqrt(np.stack([np.maximum(mean - half, 0.0), mean + half], axis=1))
    return np.asarray(np.where(good[:, None], scale, np.nan))


def _share_of_rig(rig: StereoRig, target: DiscTarget, left: Discs, lines: tuple[_Lines, _Lines]) -> Array:
    """Return (N,) variance of the gap between the planes of a pair from the rig's covariance, rad^2, for each left disc.

    Taken where the disc would be nearest, at the smallest radius; nearer than that, no pair is.
    """
    if not rig.cov.any() or not len(left.uv):
        return np.zeros(len(left.uv))
    rays = rig.left.unproject(left.uv)
    distance = (1 - SIZE_TOLERANCE) * lines[0].scale[:, 0] * target.radii_m.min() / left.radius_px
    p = np.where(np.isfinite(rays), rays * np.clip(distance, *DEPTHS_M)[:, None], [0.0, 0.0, 1.0])
    J = _by_rig(rig, p)
    p_right = transform(inverse(rig.T_left_right), p)
    uv_right = rig.right.project(p_right)
    gone = np.asarray(~np.isfinite(uv_right).all(axis=1))
    there = Discs(np.where(gone[:, None], 0.0, uv_right), left.cov_uv, left.shape, left.bright)
    w = np.concatenate([lines[0].by_pixel, -_lines(rig, 1, there).by_pixel], axis=1)
    by_rig = np.einsum("ni,nip->np", w, np.where(np.isfinite(J), J, 0.0))
    return np.asarray(np.nan_to_num(np.einsum("np,pq,nq->n", by_rig, rig.cov, by_rig)))


def _by_rig(rig: StereoRig, p_left: Array) -> Array:
    """Return (N, 4, P) derivative of both images (left u, v, right u, v) of points by the rig's parameters."""
    p_right = transform(inverse(rig.T_left_right), p_left)
    _, _, K_l = rig.left.project_jacobians(p_left)
    _, J_r, K_r = rig.right.project_jacobians(p_right)
    J, n = np.zeros((len(p_left), 4, rig.parameter_count)), K_l.shape[2]
    J[:, :2, :n], J[:, 2:, n:-6] = K_l, K_r
    J[:, 2:, -6:] = np.concatenate([-J_r, J_r @ skew(p_right)], axis=2)
    return J


@numba.njit(cache=True, error_model="numpy")
def _walk(
    gate: Array, order: Ids, angle_l: Array, angle_r: Array, along_l: Array, along_r: Array, out_l: Array,
    baseline: float, scale_l: Array, scale_r: Array, radius_l: Array, slack_l: Array, radius_r: Array, slack_r: Array,
    bright_l: NDArray[np.bool_], bright_r: NDArray[np.bool_], radii: Array, bright: NDArray[np.bool_],
    t: Array, rows: Ids,
) -> int:  # fmt: skip
    """Write the possible pairs into ``rows``; return how many there are, more than its length when it overflows."""
    count = 0
    for i in range(len(angle_l)):
        if not np.isfinite(gate[i] + angle_l[i]):
            continue
        k = np.searchsorted(angle_r, angle_l[i] - gate[i])
        while k < len(order) and angle_r[k] <= angle_l[i] + gate[i]:
            j = order[k]
            k += 1
            parallax = along_l[i] - along_r[j]
            if bright_l[i] != bright_r[j] or not parallax > 0.0:
                continue
            h = baseline / parallax
            x, y, z = h * out_l[i, 0], h * out_l[i, 1], h * out_l[i, 2]
            if not DEPTHS_M[0] <= z <= DEPTHS_M[1]:
                continue
            far_l = np.sqrt(x * x + y * y + z * z)
            far_r = np.sqrt((x - t[0]) ** 2 + (y - t[1]) ** 2 + (z - t[2]) ** 2)
            for m in range(len(radii)):
                a_l, a_r = radii[m] / far_l, radii[m] / far_r
                if (
                    bright[m] == bright_l[i]
                    and radius_l[i] >= (1 - SIZE_TOLERANCE) * scale_l[i, 0] * a_l - slack_l[i]
                    and radius_l[i] <= (1 + SIZE_TOLERANCE) * scale_l[i, 1] * a_l + slack_l[i]
                    and radius_r[j] >= (1 - SIZE_TOLERANCE) * scale_r[j, 0] * a_r - slack_r[j]
                    and radius_r[j] <= (1 + SIZE_TOLERANCE) * scale_r[j, 1] * a_r + slack_r[j]
                ):
                    if count >= len(rows):
                        return len(rows) + 1
                    rows[count, 0], rows[count, 1] = i, j
                    count += 1
                    break
    return count


def _triangulated(
    rig: StereoRig, target: DiscTarget, left: Discs, right: Discs, lines: tuple[_Lines, _Lines], rows: Ids
) -> Pairs:
    """Triangulate pairs (K, 2) and keep those whose rays meet and whose size fits at the place where they do."""
    i, j = rows[:, 0], rows[:, 1]
    cov_uv = np.stack([noise(rig, left.cov_uv[i]), noise(rig, right.cov_uv[j])], axis=1)
    p, cov, by_rig = optimal_points(rig, np.stack([left.uv[i], right.uv[j]], axis=1), cov_uv)
    good = np.flatnonzero(np.isfinite(p).all(axis=1))
    i, j, p = i[good], j[good], p[good]
    root = rig_root(rig)
    w = np.concatenate([lines[0].by_pixel[i], -lines[1].by_pixel[j]], axis=1)
    gap = lines[0].angle[i] - lines[1].angle[j]
    share = np.einsum("ni,nip->np", w, _by_rig(rig, p) @ root)
    met = gap**2 <= GATE_SIGMAS**2 * (lines[0].variance[i] + lines[1].variance[j] + (share**2).sum(axis=1))
    kind = np.array(left.bright[i][:, None] == target.bright[None])
    for discs, chosen, camera, p_camera in (
        (left, i, rig.left, p),
        (right, j, rig.right, transform(inverse(rig.T_left_right), p)),
    ):
        scale = _scale(camera, p_camera)
        kind &= fits(
            discs.radius_px[chosen][:, None],
            size_sigma(discs)[chosen][:, None],
            scale[:, :1] * target.radii_m,
            scale[:, 1:] * target.radii_m,
        )
    keep = met & kind.any(axis=1)
    return Pairs(i[keep], j[keep], p[keep], cov[good][keep], by_rig[good][keep] @ root, kind[keep])


def rig_root(rig: StereoRig) -> Array:
    """Return (P, R) with root @ root.T the rig's covariance, without the directions that are exact."""
    sigma = np.sqrt(np.diag(rig.cov))
    scale = np.where(sigma > 0, sigma, 1.0)
    values, vectors = np.linalg.eigh(rig.cov / np.outer(scale, scale))
    keep = values > 1e-12
    return np.asarray(scale[:, None] * vectors[:, keep] * np.sqrt(values[keep]))
