"""Where bundle adjustment begins: focal lengths, poses and the relative pose of the cameras, from nothing.

Every focal length of a logarithmic ladder is tried and the poses of all shots are solved under it, so that no view has
to be frontal, tilted or complete; several good starts are then adjusted and the lowest minimum wins.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Ids
from armsight.errors import CalibrationError
from armsight.geometry.pose import inverse, log_se3
from armsight.vision.camera import DISTORTION_MODELS, Camera
from armsight.vision.pose.bundle import BundleModel, BundleSolution, BundleState, Observations, minimise
from armsight.vision.pose.pnp import MIN_POINTS, body_poses

#: Focal lengths tried, in units of the image's longer side: fields of view from 115 to 11 degrees.
_FOCAL_LADDER = np.geomspace(0.32, 5.0, 18)
_STARTS_KEPT = 3
_FOCAL_VIEWS = 8  # spread over all, that choose the first focal lengths; half: blurred ones may choose, double: slower
#: Corners that all fit so well, px RMS, leave no doubt about the minimum: wrong ones are off by whole pixels. So does a
#: lens that imitates another one, to begin with.
_FITS_PX, _IMITATES_PX = 0.1, 1.0
_IMITATION_STEPS = 10
#: Two starts whose costs differ by less than this share lead to one minimum; half: a third is tried now and then, double:
#: nothing, as other minima cost several times as much.
_SAME_COST, _ROUGHLY = 1e-3, 1e-5  # the second: a step that lowers the cost by a smaller share is a start's last
#: Relative poses closer than this, rad or share of the distance, are one hypothesis.
_SAME_POSE = 0.1
_MOST_HYPOTHESES = 600


def pinhole(image_size_px: tuple[int, int], focal_px: float, model: str) -> Camera:
    """Return an undistorted camera with its principal point in the middle of the image."""
    width, height = image_size_px
    intrinsics = np.array([focal_px, focal_px, (width - 1) / 2, (height - 1) / 2])
    return Camera(image_size_px, model, intrinsics, np.zeros(DISTORTION_MODELS[model]))


def _views(observations: Observations, side: int) -> list[NDArray[np.intp]]:
    """Return per shot the rows of one camera's detections."""
    return [
        np.flatnonzero((observations.shot == j) & (observations.camera == side)) for j in range(observations.shot_count)
    ]


def _focal_candidates(
    points: Array, size: tuple[int, int], observations: Observations, side: int, model: str
) -> list[float]:
    """Return the focal lengths, px, under which one camera's views fit best, best first."""
    every = [rows for rows in _views(observations, side) if len(rows) >= MIN_POINTS]
    views = [every[k] for k in np.unique(np.linspace(0, len(every) - 1, min(len(every), _FOCAL_VIEWS)).astype(int))]
    scores = []
    for focal in (_FOCAL_LADDER * max(size)).tolist():
        camera = pinhole(size, focal, model)
        errors = []
        for rows in views:
            candidates = body_poses(points[observations.point[rows]], camera, observations.uv[rows])
            errors.append(candidates[0][1] if candidates else max(size))
        scores.append((float(np.mean(np.square(errors))) if errors else np.inf, focal))
    return [focal for _, focal in sorted(scores)[:_STARTS_KEPT]]


def _apart(a: Array, b: Array, scale_m: float = 1.0) -> Array:
    """Return (N, M) how far poses (N, 4, 4) and (M, 4, 4) are apart: distance over a scale, and angle in rad."""
    cosine = (np.einsum("nij,mij->nm", a[:, :3, :3], b[:, :3, :3]) - 1) / 2
    ways = np.linalg.norm(a[:, None, :3, 3] - b[None, :, :3, 3], axis=2)
    return np.asarray(np.hypot(ways / scale_m, np.arccos(np.clip(cosine, -1, 1))))


def relative_poses(left: list[list[Array]], right: list[list[Array]]) -> list[Array]:
    """Return the relative poses of two cameras that most shots agree on.

    ``left``: per shot, candidate poses T_left_body; ``right``: per shot, candidate poses T_right_body. Returns a few
    different T_left_right (4, 4), the one with the widest agreement first; none where no shot has candidates in both
    cameras.
    """
    # The usual distance of the body makes rotations and translations comparable.
    scale_m = float(np.median([T[2, 3] for views in (*left, *right) for T in views] or [1.0]))
    each = [[Tl @ inverse(Tr) for Tl in ls for Tr in rs] for ls, rs in zip(left, right, strict=True)]
    each = [of_shot for of_shot in each if of_shot]
    if not each:
        return []
    Ts = np.stack([T for of_shot in each for T in of_shot])
    tried = np.arange(len(Ts))
    if len(tried) > _MOST_HYPOTHESES:
        tried = np.random.default_rng(0).choice(tried, _MOST_HYPOTHESES, replace=False)
    first = np.cumsum([0, *(len(of_shot) for of_shot in each[:-1])])
    best = np.minimum.reduceat(_apart(Ts[tried], Ts, scale_m), first, axis=1)
    costs = np.median(best, axis=1) + 1e-3 * np.minimum(best, 1.0).mean(axis=1)
    chosen = Ts[:0]
    for i in tried[np.argsort(costs)]:
        if (_apart(chosen, Ts[i : i + 1], scale_m) > _SAME_POSE).all():
            chosen = np.concatenate([chosen, Ts[i : i + 1]])
        if len(chosen) == _STARTS_KEPT:
            break
    return list(chosen)


def _agreeing_poses(left: list[list[Array]], right: list[list[Array]], T_left_right: Array) -> list[Array] | None:
    """Return per shot the T_left_body that agrees best with a relative pose; None where a shot has no candidate."""
    chosen = []
    for ls, rs in zip(left, right, strict=True):
        if not (ls or rs):
            return None
        from_right = [T_left_right @ T for T in rs]
        best = _apart(np.stack(ls), np.stack(from_right)).min(axis=1).argmin() if ls and rs else 0
        chosen.append((ls or from_right)[best])
    return chosen


def _candidates(points: Array, camera: Camera, observations: Observations, side: int) -> list[list[Array]]:
    """Return per shot the poses T_camera_body that one camera's detections allow."""
    return [
        [T for T, _ in body_poses(points[observations.point[rows]], camera, observations.uv[rows])]
        for rows in _views(observations, side)
    ]


def _assemble(points: Array, cameras: tuple[Camera, Camera], observations: Observations) -> BundleState | None:
    """Build a state from two cameras: poses of all shots and the relative pose; None where a shot has no pose."""
    left, right = (_candidates(points, camera, observations, side) for side, camera in enumerate(cameras))
    hypotheses = relative_poses(left, right)
    if not hypotheses:
        return None
    poses = _agreeing_poses(left, right, hypotheses[0])
    return None if poses is None else BundleState(cameras, hypotheses[0], np.stack(poses), np.zeros(0))


def agreed_symmetries(
    points: Array,
    sizes: tuple[tuple[int, int], tuple[int, int]],
    observations: Observations,
    symmetries: tuple[Ids, ...],
    model: str,
) -> dict[int, Ids]:
    """Find pairs whose right image names the points in another order than the left one, even in most pairs.

    A camera that is mounted upside down sees the other end of a symmetric board as its first. One order of each pair gives
    the relative pose that the others give, too; wrong ones give another one wherever the board is.

    ``points``: (M, 3) points of the board, m; ``sizes``: image size of the left and of the right camera, px;
    ``observations``: the detections of all shots; ``symmetries``: permutations (M,) under which the board looks the same;
    ``model``: distortion model of the cameras. Returns shot -> the permutation that sorts its right detections into the
    left's order.
    """
    cameras = [
        pinhole(sizes[side], _focal_candidates(points, sizes[side], observations, side, model)[0], model)
        for side in (0, 1)
    ]
    left = _candidates(points, cameras[0], observations, 0)
    right = [  # by order
        _candidates(points[order], cameras[1], observations, 1) for order in (np.arange(len(points)), *symmetries)
    ]
    hypotheses = relative_poses(left, [[T for views in shot for T in views] for shot in zip(*right, strict=True)])
    found: dict[int, Ids] = {}
    for shot, ls in enumerate(left if hypotheses else []):
        gaps = [
            min(
                (float(np.linalg.norm(log_se3(inverse(a) @ hypotheses[0] @ b))) for a in ls for b in views[shot]),
                default=np.inf,
            )
            for views in right
        ]
        if best := int(np.argmin(gaps)):
            found[shot] = symmetries[best - 1]
    return found


def start_board(
    points: Array, sizes: tuple[tuple[int, int], tuple[int, int]], observations: Observations, model: str
) -> BundleSolution:
    """Calibrate two cameras from nothing, roughly: the start for every later adjustment.

    ``points``: (M, 3) points of the board, m. ``sizes``: image size of the left and of the right camera, px.
    ``observations``: the detections of all shots; every shot has four or more in both cameras. ``model``: distortion model
    of the adjustment. Returns the best minimum found, under a noise of one pixel. Raises CalibrationError: no start leads
    anywhere.
    """
    focals = [_focal_candidates(points, sizes[side], observations, side, model) for side in (0, 1)]
    plain = BundleModel(points, np.zeros((0, len(points), 3)), 1.0, True)
    best: BundleSolution | None = None
    begun = list[float]()
    for left, right in zip(*focals, strict=True):
        state = _assemble(points, (pinhole(sizes[0], left, model), pinhole(sizes[1], right, model)), observations)
        if state is None:
            continue
        if (first := _focused(plain, state, observations)) is None:
            continue
        if any(abs(first.cost - other) < _SAME_COST * other for other in begun):  # the same minimum follows
            break
        begun.append(first.cost)
        if (solution := _adjusted(plain, first.state, observations)) is None:
            continue
        again = best is not None and abs(solution.cost - best.cost) < _SAME_COST * best.cost
        if best is None or solution.cost < best.cost:
            best = solution
        if again or fits(best):
            break
    if best is None:
        raise CalibrationError("no start of the calibration fits the detections: are all images of the same board?")
    return best


def fits(solution: BundleSolution) -> bool:
    """Whether a solution leaves no doubt that it is the right minimum: no other start needs to be tried."""
    return residual_rms_px(solution) < _FITS_PX


def residual_rms_px(solution: BundleSolution) -> float:
    """Return the RMS distance of all detections from their projections, px."""
    return float(np.sqrt((solution.residuals_px**2).sum(axis=1).mean()))


def imitated(camera: Camera, model: str, uv: Array) -> Camera | None:
    """Approximate a camera by another distortion model at uv (N, 2), raw px, by Gauss-Newton; None if none is near."""
    rays = camera.unproject(uv)
    seen = np.isfinite(rays).all(axis=1)
    rays, uv = rays[seen], uv[seen]
    found = Camera(camera.image_size_px, model, camera.intrinsics, np.zeros(DISTORTION_MODELS[model]))
    for _ in range(_IMITATION_STEPS):
        there, _, J = found.project_jacobians(rays)
        if not np.isfinite(there).all():
            return None
        step = np.linalg.lstsq(J.reshape(2 * len(uv), -1), (uv - there).ravel(), rcond=None)[0]
        if not (np.isfinite(step).all() and (found.intrinsics[:2] + step[:2] > 0).all()):
            return None
        found = found.with_parameters(found.parameters + step)
    off = ((found.project(rays) - uv) ** 2).sum(axis=1).mean()
    return found if off < _IMITATES_PX**2 else None  # NaN is no good either


def _focused(model: BundleModel, state: BundleState, observations: Observations) -> BundleSolution | None:
    """Adjust focal lengths and poses under wide noise; None where it leads nowhere."""
    sizes = [camera.parameters.size for camera in state.cameras]
    focal = np.zeros(sum(sizes) + 6, bool)
    focal[[0, 1, sizes[0], sizes[0] + 1]] = True
    focal[-6:] = True
    try:
        return minimise(
            model, state, observations, 5.0, free=focal, max_steps=15, least_decrease=_ROUGHLY, covariance=False
        )
    except (CalibrationError, np.linalg.LinAlgError):
        return None


def _adjusted(model: BundleModel, state: BundleState, observations: Observations) -> BundleSolution | None:
    """Adjust everything from wide to narrow noise; None where it leads nowhere."""
    try:
        first = minimise(model, state, observations, 3.0, max_steps=15, least_decrease=_ROUGHLY, covariance=False)
        return minimise(model, first.state, observations, 1.0, max_steps=25, least_decrease=_ROUGHLY, covariance=False)
    except (CalibrationError, np.linalg.LinAlgError):
        return None
