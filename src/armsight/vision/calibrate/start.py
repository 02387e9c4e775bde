"""Where bundle adjustment begins: focal lengths, poses and the relative pose of the cameras, from nothing.

Every focal length of a logarithmic ladder is tried and the poses of all shots are solved under it, so that no view has
to be frontal, tilted or complete; several good starts are then adjusted and the lowest minimum wins.
"""

from __future__ import annotations

import itertools

import numpy as np

from armsight.data import Array
from armsight.errors import CalibrationError
from armsight.geometry.pose import inverse, log_se3
from armsight.vision.bundle import Model, Observations, Solution, State, minimise
from armsight.vision.camera import DISTORTION_MODELS, Camera
from armsight.vision.pnp import MIN_POINTS, body_poses

#: Focal lengths tried, in units of the image's longer side: fields of view from 115 to 11 degrees.
_FOCAL_LADDER = np.geomspace(0.32, 5.0, 18)
_STARTS_KEPT = 3


def pinhole(image_size_px: tuple[int, int], focal_px: float, model: str) -> Camera:
    """Return an undistorted camera with its principal point in the middle of the image."""
    width, height = image_size_px
    intrinsics = np.array([focal_px, focal_px, (width - 1) / 2, (height - 1) / 2])
    return Camera(image_size_px, model, intrinsics, np.zeros(DISTORTION_MODELS[model]))


def _views(observations: Observations, side: int) -> list[Array]:
    """Return per shot the rows of one camera's detections."""
    return [
        np.flatnonzero((observations.shot == j) & (observations.camera == side)) for j in range(observations.shot_count)
    ]


def _focal_candidates(
    points: Array, size: tuple[int, int], observations: Observations, side: int, model: str
) -> list[float]:
    """Return the focal lengths, px, under which one camera's views fit best, best first."""
    views = [rows for rows in _views(observations, side) if len(rows) >= MIN_POINTS]
    scores = []
    for focal in _FOCAL_LADDER * max(size):
        camera = pinhole(size, focal, model)
        errors = []
        for rows in views:
            candidates = body_poses(points[observations.point[rows]], camera, observations.uv[rows])
            errors.append(candidates[0][1] if candidates else max(size))
        scores.append((float(np.mean(np.square(errors))) if errors else np.inf, focal))
    return [focal for _, focal in sorted(scores)[:_STARTS_KEPT]]


def relative_pose(
    left: list[list[Array]], right: list[list[Array]], scale_m: float
) -> tuple[Array, list[Array | None]]:
    """Choose the relative pose of two cameras that most shots agree on.

    Args:
        left: per shot, candidate poses T_left_body.
        right: per shot, candidate poses T_right_body.
        scale_m: typical distance of the body, m: makes rotations and translations comparable.

    Returns:
        (4, 4) T_left_right, and per shot the T_left_body that agrees best with it (None where there is no candidate).

    Raises:
        CalibrationError: no shot has candidates in both cameras.
    """
    pairs = [
        (j, Tl, Tl @ inverse(Tr))
        for j, (ls, rs) in enumerate(zip(left, right, strict=True))
        for Tl, Tr in itertools.product(ls, rs)
    ]
    if not pairs:
        raise CalibrationError("no pair shows enough of the body in both cameras to place one camera against the other")
    weights = np.r_[np.ones(3) / scale_m, np.ones(3)]
    shots = np.array([j for j, _, _ in pairs])
    Ts = np.stack([T for _, _, T in pairs])
    costs = np.empty(len(pairs))
    distances = np.empty((len(pairs), len(pairs)))
    for i, T in enumerate(Ts):
        distances[i] = np.linalg.norm(log_se3(inverse(T) @ Ts) * weights, axis=1)
        best = np.full(len(left), np.inf)
        np.minimum.at(best, shots, distances[i])
        costs[i] = np.median(best[np.isfinite(best)]) + 1e-3 * np.minimum(best[np.isfinite(best)], 1.0).mean()
    winner = int(np.argmin(costs))
    chosen: list[Array | None] = []
    for j in range(len(left)):
        rows = np.flatnonzero(shots == j)
        if len(rows):
            chosen.append(pairs[rows[np.argmin(distances[winner, rows])]][1])
        elif left[j]:
            chosen.append(left[j][0])
        else:
            chosen.append(Ts[winner] @ right[j][0] if right[j] else None)
    return Ts[winner], chosen


def _assemble(points: Array, cameras: tuple[Camera, Camera], observations: Observations) -> State | None:
    """Build a state from two cameras: poses of all shots and the relative pose; None where a shot cannot be placed."""
    candidates: list[list[list[Array]]] = []
    for side, camera in enumerate(cameras):
        candidates.append(
            [
                [T for T, _ in body_poses(points[observations.point[rows]], camera, observations.uv[rows])]
                for rows in _views(observations, side)
            ]
        )
    depths = [T[2, 3] for views in candidates for view in views for T in view]
    if not depths:
        return None
    T_left_right, poses = relative_pose(candidates[0], candidates[1], float(np.median(depths)))
    if any(T is None for T in poses):
        return None
    return State(cameras, T_left_right, np.stack([T for T in poses if T is not None]), np.zeros(0))


def start_board(
    points: Array, sizes: tuple[tuple[int, int], tuple[int, int]], observations: Observations, model: str
) -> Solution:
    """Calibrate two cameras from nothing, roughly: the start for every later adjustment.

    Args:
        points: (M, 3) points of the board, m.
        sizes: image size of the left and of the right camera, px.
        observations: the detections of all shots; every shot has four or more in both cameras.
        model: distortion model of the adjustment.

    Returns:
        The best minimum found, under a noise of one pixel.

    Raises:
        CalibrationError: no start leads anywhere.
    """
    focals = [_focal_candidates(points, sizes[side], observations, side, model) for side in (0, 1)]
    plain = Model(points, np.zeros((0, len(points), 3)), 1.0, True)
    best: Solution | None = None
    for left, right in zip(*focals, strict=True):
        cameras = (pinhole(sizes[0], left, model), pinhole(sizes[1], right, model))
        state = _assemble(points, cameras, observations)
        if state is None:
            continue
        solution = _staged(plain, state, observations)
        if solution is not None and (best is None or solution.cost < best.cost):
            best = solution
    if best is None:
        raise CalibrationError("no start of the calibration fits the detections: are all images of the same board?")
    return best


def _staged(model: Model, state: State, observations: Observations) -> Solution | None:
    """Adjust focal lengths first, then everything, each from wide to narrow noise; None where it leads nowhere."""
    sizes = [camera.parameters.size for camera in state.cameras]
    focal = np.zeros(sum(sizes) + 6, bool)
    focal[[0, 1, sizes[0], sizes[0] + 1]] = True
    focal[-6:] = True
    try:
        first = minimise(model, state, observations, 5.0, free=focal, max_steps=15)
        second = minimise(model, first.state, observations, 3.0, max_steps=15)
        return minimise(model, second.state, observations, 1.0, max_steps=25)
    except (CalibrationError, np.linalg.LinAlgError):
        return None
