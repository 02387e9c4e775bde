"""Which detections belong to one body, where names do not settle it: two bodies of one kind in view, wrong names.

Poses that several detections of one camera agree on are carried into the other camera, adjusted to both, and the one
that explains most detections takes them; what is left may be another body.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Correspondences, Detections, Ids
from armsight.geometry.pose import inverse
from armsight.vision.camera import Camera
from armsight.vision.detections import SeenShot
from armsight.vision.match import join
from armsight.vision.pose.pnp import Candidate, agreeing, consensus_poses
from armsight.vision.pose.posefit import PixelObservations, fit_pose

#: Fewest detections, both cameras together, that make a body: where names settle it, and where they do not.
LEAST_DETECTIONS, LEAST_AMBIGUOUS = 4, 6
_POLISH_SIGMA_PX = 2.0


def plain(shot: SeenShot) -> Correspondences | None:
    """Return a shot's correspondences by name, or None where a name occurs twice in one image."""
    if any(len(np.unique(ids)) < len(ids) for ids in shot.ids):
        return None
    return join(*(_detections(ids, uv) for ids, uv in zip(shot.ids, shot.uv, strict=True)))


def _detections(ids: Ids, uv: Array) -> Detections:
    """Sort named pixel positions into detections whose covariance is unknown."""
    order = np.argsort(ids)
    return Detections(ids[order], uv[order], np.zeros((len(ids), 2, 2)))


def candidates(
    points: Array, cameras: tuple[Camera, Camera], shot: SeenShot
) -> tuple[list[Candidate], list[Candidate]]:
    """Return the poses that each camera of one shot alone allows."""
    left, right = (consensus_poses(points, camera, shot.ids[i], shot.uv[i]) for i, camera in enumerate(cameras))
    return left, right


def instances(
    points: Array,
    cameras: tuple[Camera, Camera],
    T_left_right: Array,
    shot: SeenShot,
    found: tuple[list[Candidate], list[Candidate]],
) -> list[tuple[Array, Correspondences]]:
    """Find the bodies in one shot.

    Args:
        points: (M, 3) points of the body, m.
        cameras: left and right.
        T_left_right: (4, 4) their relative pose.
        shot: the detections of both cameras.
        found: the poses that each camera alone allows, from :func:`candidates`.

    Returns:
        T_left_body (4, 4) and the correspondences of every body, the one with most detections first; no detection is
        used twice.
    """
    starts = [c.T_camera_body for c in found[0]] + [T_left_right @ c.T_camera_body for c in found[1]]
    poses = [_polished(points, cameras, T_left_right, shot, T) for T in starts]
    free = tuple(np.ones(len(ids), bool) for ids in shot.ids)
    least = LEAST_AMBIGUOUS if plain(shot) is None else LEAST_DETECTIONS
    bodies: list[tuple[Array, Correspondences]] = []
    while True:
        best, best_rows, best_key = None, None, (0, 0.0)
        for T in poses:
            if T is None:
                continue
            rows, cost = _agreeing(points, cameras, T_left_right, shot, T, free)
            key = (sum(len(r) for r in rows), -cost)
            if key > best_key:
                best, best_rows, best_key = T, rows, key
        if best is None or best_rows is None or best_key[0] < least:
            return bodies
        seen = join(*(_detections(shot.ids[i][r], shot.uv[i][r]) for i, r in enumerate(best_rows)))
        bodies.append((best, seen))
        for side, taken in enumerate(best_rows):
            free[side][taken] = False


def _agreeing(
    points: Array,
    cameras: tuple[Camera, Camera],
    T_left_right: Array,
    shot: SeenShot,
    T_left_body: Array,
    free: tuple[NDArray[np.bool_], ...],
) -> tuple[list[Ids], float]:
    """Return per camera the free detections that agree with a pose, and their summed squared distance, px^2."""
    rows, cost = [], 0.0
    for side, camera in enumerate(cameras):
        T = T_left_body if side == 0 else inverse(T_left_right) @ T_left_body
        row, rms = agreeing(points, camera, T, shot.ids[side], shot.uv[side], free[side])
        if not np.isfinite(rms):
            return [np.zeros(0, np.int64), np.zeros(0, np.int64)], np.inf
        rows.append(row)
        cost += len(row) * rms**2
    return rows, cost


def _polished(
    points: Array, cameras: tuple[Camera, Camera], T_left_right: Array, shot: SeenShot, T: Array
) -> Array | None:
    """Adjust a pose to what agrees with it in both cameras, twice, for the first time only roughly."""
    everything = tuple(np.ones(len(ids), bool) for ids in shot.ids)
    for _ in range(2):
        rows, _ = _agreeing(points, cameras, T_left_right, shot, T, everything)
        if sum(len(r) for r in rows) < 3:
            return None
        seen = join(*(_detections(shot.ids[i][r], shot.uv[i][r]) for i, r in enumerate(rows)))
        fit = fit_pose(cameras, T_left_right, points, PixelObservations.of(seen, _POLISH_SIGMA_PX), T, robust=True)
        if fit is None:
            return None
        T = fit.T_left_body
    return T
