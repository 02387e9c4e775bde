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

from armsight.data import Array, Ids, Record
from armsight.geometry.pose import inverse, transform
from armsight.geometry.rotation import skew
from armsight.vision.camera import Camera
from armsight.vision.disc_view import SIZE_TOLERANCE, DiscView
from armsight.vision.rig import StereoRig
from armsight.vision.triangulate import optimal_points

#: Nearest and farthest disc, m.
DEPTHS_M = (0.1, 10.0)
#: Two rays farther apart than so many standard deviations do not meet.
GATE_SIGMAS = 5.0
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
    found = _walk(
        gate, order, lines[0].angle, lines[1].angle[order], lines[0].along, lines[1].along, lines[0].out, baseline,
        lines[0].scale, lines[1].scale, view.radius_px[0], view.slack_px[0], view.radius_px[1], view.slack_px[1],
        left.bright, right.bright, kinds[:, 0].copy(), kinds[:, 1] > 0.5, rows,
    )  # fmt: skip
    return None if found > MOST_PAIRS else _triangulated(view, lines, rows[:found])


def _lines(rig: StereoRig, side: int, uv: Array, cov_uv: Array) -> _Lines:
    """Turn the discs of one image into epipolar planes about the baseline."""
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
    """Return (N, 2) smallest and largest half axis, px, of a disc of unit radius at points (N, 3), however it is turned."""
    good = np.asarray(np.isfinite(p).all(axis=1))
    J = camera.project_jacobians(np.where(good[:, None], p, [0.0, 0.0, 1.0]))[1]
    a, b, c = (J[:, 0] ** 2).sum(axis=1), (J[:, 0] * J[:, 1]).sum(axis=1), (J[:, 1] ** 2).sum(axis=1)
    mean, half = (a + c) / 2, np.hypot((a - c) / 2, b)
    scale = np.sqrt(np.stack([np.maximum(mean - half, 0.0), mean + half], axis=1))
    return np.asarray(np.where(good[:, None], scale, np.nan))


def _share_of_rig(view: DiscView, lines: _Lines) -> Array:
    """Return (N,) variance of the gap between the planes of a pair from the rig's covariance, rad^2, for each left disc.

    Taken where the disc would be nearest, at the smallest radius; nearer than that, no pair is.
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
    J = _by_rig(rig, p) @ view.rig_root
    share = np.einsum("ni,nir->nr", w, np.where(np.isfinite(J), J, 0.0))
    return np.asarray(np.nan_to_num((share**2).sum(axis=1)))


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
    t: Array, scale_l: Array, scale_r: Array, radius_l: Array, slack_l: Array, radius_r: Array, slack_r: Array,
    bright_l: NDArray[np.bool_], bright_r: NDArray[np.bool_], radii: Array, bright: NDArray[np.bool_],
    rows: Ids,
) -> int:  # fmt: skip
    """Write the possible pairs into ``rows``; return how many there are, more than its length when it overflows."""
    count, baseline = 0, np.sqrt(t[0] ** 2 + t[1] ** 2 + t[2] ** 2)
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


def _triangulated(view: DiscView, lines: tuple[_Lines, _Lines], rows: Ids) -> Pairs:
    """Triangulate pairs (K, 2) and keep those whose rays meet and whose size fits at the place where they do."""
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
    share = np.einsum("ni,nir->nr", w, _by_rig(rig, p) @ view.rig_root)
    met = gap**2 <= GATE_SIGMAS**2 * (lines[0].variance[i] + lines[1].variance[j] + (share**2).sum(axis=1))
    kind = np.array(discs[0].bright[i][:, None] == target.bright[None])
    for side, chosen, p_camera in ((0, i, p), (1, j, transform(inverse(rig.T_left_right), p))):
        radius, slack = view.radius_px[side][chosen][:, None], view.slack_px[side][chosen][:, None]
        scale = _scale(rig.cameras[side], p_camera)
        kind &= radius >= (1 - SIZE_TOLERANCE) * scale[:, :1] * target.radii_m - slack
        kind &= radius <= (1 + SIZE_TOLERANCE) * scale[:, 1:] * target.radii_m + slack
    keep = met & kind.any(axis=1)
    return Pairs(i[keep], j[keep], p[keep], cov[good][keep], by_rig[good][keep] @ view.rig_root, kind[keep])
