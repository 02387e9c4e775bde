"""Which detections belong to one body, where names do not settle it: two bodies of one kind in view, wrong names.

Poses that several detections of one camera agree on are carried into the other camera, adjusted to both, and the one
that explains most detections takes them; what is left may be another body.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Correspondences, Detections, Ids
from armsight.geometry.pose import inverse
from armsight.vision.camera import Camera
from armsight.vision.detections import SeenShot
from armsight.vision.match import join
from armsight.vision.pose.pnp import Candidate, agreeing, consensus_poses
from armsight.vision.pose.posefit import PixelObservations, fit_pose
from armsight.vision.rig import StereoRig

#: Fewest detections, both cameras together, that make a body: where names settle it, and where they do not.
LEAST_DETECTIONS, LEAST_AMBIGUOUS = 4, 6
_POLISH_SIGMA_PX = 2.0


def plain(shot: SeenShot) -> Correspondences | None:
    """Return a shot's correspondences by name, or None where a name occurs twice in one image."""
    if any(len(np.unique(ids)) < len(ids) for ids in shot.ids):
        return None
    return joined(shot, [np.arange(len(ids)) for ids in shot.ids])


def joined(shot: SeenShot, rows: Sequence[Ids]) -> Correspondences:
    """Return some of a shot's detections, rows of each camera that name a point once; their covariance is unknown."""
    sides = []
    for ids, uv, some in zip(shot.ids, shot.uv, rows, strict=True):
        order = some[np.argsort(ids[some])]
        sides.append(Detections(ids[order], uv[order], np.zeros((len(order), 2, 2))))
    return join(*sides)


def candidates(
    points: Array, cameras: tuple[Camera, Camera], shot: SeenShot
) -> tuple[list[Candidate], list[Candidate]]:
    """Return the poses that each camera of one shot alone allows."""
    left, right = (consensus_poses(points, camera, shot.ids[i], shot.uv[i]) for i, camera in enumerate(cameras))
    return left, right


def instances(
    points: Array, rig: StereoRig, shot: SeenShot, found: tuple[list[Candidate], list[Candidate]] | None = None
) -> list[tuple[Array, Correspondences]]:
    """Find the bodies in one shot.

    ``points``: (M, 3) points of the body, m; ``rig``: the cameras and their relative pose; ``shot``: the detections of both
    cameras; ``found``: what :func:`candidates` returns, where it is known. Returns T_left_body (4, 4) and the
    correspondences of every body, the one with most detections first; no detection is used twice.
    """
    left, right = candidates(points, rig.cameras, shot) if found is None else found
    starts = [c.T_camera_body for c in left] + [rig.T_left_right @ c.T_camera_body for c in right]
    poses = [T for start in starts if (T := _polished(points, rig, shot, start)) is not None]
    free = [np.ones(len(ids), bool) for ids in shot.ids]
    least = LEAST_AMBIGUOUS if plain(shot) is None else LEAST_DETECTIONS
    bodies: list[tuple[Array, Correspondences]] = []
    while poses:
        agreed = [_agreeing(points, rig, shot, T, free) for T in poses]
        best = max(range(len(poses)), key=lambda k: (sum(map(len, agreed[k][0])), -agreed[k][1]))
        rows = agreed[best][0]
        if sum(map(len, rows)) < least:
            break
        bodies.append((poses[best], joined(shot, rows)))
        for side, taken in enumerate(rows):
            free[side][taken] = False
    return bodies


def _agreeing(
    points: Array, rig: StereoRig, shot: SeenShot, T_left_body: Array, free: Sequence[NDArray[np.bool_]]
) -> tuple[list[Ids], float]:
    """Return per camera the free detections that agree with a pose, and their summed squared distance, px^2."""
    rows, cost = [], 0.0
    for side, camera in enumerate(rig.cameras):
        T = T_left_body if side == 0 else inverse(rig.T_left_right) @ T_left_body
        row, rms = agreeing(points, camera, T, shot.ids[side], shot.uv[side], free[side])
        if not np.isfinite(rms):
            return [np.zeros(0, np.int64), np.zeros(0, np.int64)], np.inf
        rows.append(row)
        cost += len(row) * rms**2
    return rows, cost


def _polished(points: Array, rig: StereoRig, shot: SeenShot, T: Array) -> Array | None:
    """Adjust a pose to what agrees with it in both cameras, twice, for the first time only roughly."""
    for _ in range(2):
        rows, _ = _agreeing(points, rig, shot, T, [np.ones(len(ids), bool) for ids in shot.ids])
        if sum(map(len, rows)) < 3:
            return None
        seen = PixelObservations.of(joined(shot, rows), _POLISH_SIGMA_PX)
        fit = fit_pose(rig.cameras, rig.T_left_right, points, seen, T, robust=True)
        if fit is None:
            return None
        T = fit.T_left_body
    return T
