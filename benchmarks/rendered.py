"""Metrics 3a, 5 and 6 on rendered chessboards with truth."""

from __future__ import annotations

import time

import cv2
import numpy as np
from scipy.stats import chi2

from armsight.data import Missed, Shot
from armsight.geometry.pose import inverse, log_se3, pose
from armsight.geometry.rotation import exp_so3
from armsight.sim.render.optics import Sensor, exposed
from armsight.sim.render.render import radiance, render_pair
from armsight.sim.render.scene import PosedBody, chessboard
from armsight.vision.calibrate.boards import Pair, calibrate_boards
from armsight.vision.camera import Camera
from armsight.vision.markers.board import open_board
from armsight.vision.pose.measure import measure, measure_detections
from armsight.vision.rig import StereoRig
from armsight.vision.triangulate import optimal_points

SPEC, COLUMNS, ROWS, SQUARE = "chessboard:9x6:25mm", 9, 6, 0.025
SENSOR = Sensor(read_noise=2.0)


def true_rig(width: int = 640, height: int = 480, focal: float = 560.0) -> StereoRig:
    """Two cameras 0.2 m apart that look slightly inwards."""
    cameras = [
        Camera(
            (width, height),
            "brown4",
            np.array([focal * s, focal * s, width / 2 + dx, height / 2 + dy]),
            np.array([-0.12, 0.05, 4e-4, -3e-4]) * s,
        )
        for s, dx, dy in ((1.0, 4.3, -3.1), (1.01, -6.2, 2.4))
    ]
    T_left_right = pose(exp_so3(np.radians([0.3, -9.0, 0.4])), np.array([0.2, 0.002, 0.01]))
    return StereoRig(cameras[0], cameras[1], T_left_right, np.zeros((22, 22)), 0.0)


def in_view(rig: StereoRig, T: np.ndarray) -> bool:
    """Whether the board with its margin lies in both images."""
    x, y = np.meshgrid([-2 * SQUARE, (COLUMNS + 1) * SQUARE], [-2 * SQUARE, (ROWS + 1) * SQUARE])
    p = np.c_[x.ravel(), y.ravel(), np.zeros(4)] @ T[:3, :3].T + T[:3, 3]
    for camera, T_camera_left in ((rig.left, np.eye(4)), (rig.right, inverse(rig.T_left_right))):
        uv = camera.project(p @ T_camera_left[:3, :3].T + T_camera_left[:3, 3])
        w, h = camera.image_size_px
        if not (np.isfinite(uv).all() and (uv > 3).all() and (uv < (w - 4, h - 4)).all()):
            return False
    return True


def board_poses(rig: StereoRig, count: int, rng: np.random.Generator) -> list[np.ndarray]:
    """Boards tilted up to 40 degrees, 0.45 to 0.9 m away, fully in view of both cameras."""
    out = []
    centre = np.array([(COLUMNS - 1) / 2, (ROWS - 1) / 2, 0.0]) * SQUARE
    while len(out) < count:
        axis = rng.normal(size=2)
        tilt = np.radians(rng.uniform(0, 40)) * axis / np.linalg.norm(axis)
        R = exp_so3(np.r_[tilt, 0.0]) @ exp_so3(np.r_[0.0, 0.0, rng.uniform(-0.6, 0.6)])
        where = np.array([rng.uniform(-0.15, 0.35), rng.uniform(-0.2, 0.2), rng.uniform(0.45, 0.9)])
        T = pose(R, where - R @ centre)
        if in_view(rig, T):
            out.append(T)
    return out


def point_sigma(trials: int = 100, pairs: int = 14) -> None:
    """Calibrate again and again from the same scene under new noise; spread of points against their predicted sigma."""
    rig, board = true_rig(), open_board(SPEC)
    rng = np.random.default_rng(3)
    pattern = chessboard(COLUMNS, ROWS, SQUARE)
    light = []
    for T in board_poses(rig, pairs, rng):
        posed = PosedBody((pattern,), T)
        views = (posed, posed.seen_from(inverse(rig.T_left_right)))
        light.append([radiance(camera, [view], 0.4) for camera, view in zip(rig.cameras, views, strict=True)])
    grid = np.stack(np.meshgrid([-0.05, 0.1, 0.25], [-0.1, 0.1], [0.5, 0.7, 0.9]), axis=-1).reshape(-1, 3)
    T_right_left = inverse(rig.T_left_right)
    uv = np.stack(
        [rig.left.project(grid), rig.right.project(grid @ T_right_left[:3, :3].T + T_right_left[:3, 3])], axis=1
    )
    noise = 0.03
    cov_uv = np.tile(noise**2 * np.eye(2), (len(grid), 2, 1, 1))
    found, predicted, share = [], [], []
    for _ in range(trials):
        shots = []
        for j, both in enumerate(light):
            left, right = (board.detect(exposed(view, SENSOR, rng)) for view in both)
            shots.append(Pair(str(j), left, right))
        sizes = (rig.left.image_size_px, rig.right.image_size_px)
        result = calibrate_boards(board, shots, sizes, models=("brown4",)).rig
        p, cov, by_rig = optimal_points(result, uv + rng.normal(0, noise, uv.shape), cov_uv)
        calibration = by_rig @ result.cov @ by_rig.transpose(0, 2, 1)
        found.append(p)
        predicted.append(np.diagonal(cov + calibration, axis1=1, axis2=2))
        share.append(np.diagonal(calibration, axis1=1, axis2=2))
    spread = np.var(found, axis=0, ddof=1)
    bias = np.mean(found, axis=0) - grid
    ratio = np.sqrt(np.mean(predicted, axis=0) / spread)
    sem = 1 / np.sqrt(2 * (trials - 1))
    print(f"\n3a. Rendered: {trials} calibrations of {pairs} pairs each, {len(grid)} points triangulated with each")
    print(
        f"  predicted sigma over Monte Carlo: lateral {ratio[:, :2].mean():.3f}, depth {ratio[:, 2].mean():.3f}, all "
        f"{ratio.mean():.3f} (single values {ratio.min():.2f} to {ratio.max():.2f}; Monte Carlo is good to {sem:.2f})"
    )
    print(
        f"  mean predicted sigma: lateral {1e3 * np.sqrt(np.mean(predicted, axis=0)[:, :2].mean()):.4f} mm, depth "
        f"{1e3 * np.sqrt(np.mean(predicted, axis=0)[:, 2].mean()):.4f} mm; calibration's share of the variance "
        f"{100 * np.mean(share) / np.mean(predicted):.0f}%; bias over sigma {np.sqrt(np.mean(bias**2 / spread)):.2f} RMS"
    )


def calibrated(rig: StereoRig, rng: np.random.Generator, pairs: int = 14) -> StereoRig:
    """Calibrate the true rig once from rendered boards."""
    board, pattern = open_board(SPEC), chessboard(COLUMNS, ROWS, SQUARE)
    shots = []
    for j, T in enumerate(board_poses(rig, pairs, rng)):
        images = render_pair(rig.cameras, rig.T_left_right, [PosedBody((pattern,), T)], sensor=SENSOR, rng=rng)
        shots.append(Pair(str(j), *(board.detect(image) for image in images)))
    return calibrate_boards(board, shots, (rig.left.image_size_px, rig.right.image_size_px), models=("brown4",)).rig


def pose_coverage(count: int = 2000) -> None:
    """Share of rendered shots whose true pose lies in the predicted 95% ellipsoid.

    Every shot is measured with another rig, sampled from the calibration's own covariance about the true one, so that both
    shares of the covariance are put to the test.
    """
    truth, rng = true_rig(), np.random.default_rng(5)
    result = calibrated(truth, rng)
    root = np.linalg.cholesky(result.cov + 1e-30 * np.eye(len(result.cov)))
    board, pattern = open_board(SPEC), chessboard(COLUMNS, ROWS, SQUARE)
    d2, missed = [], 0
    for T in board_poses(truth, count, rng):
        images = render_pair(truth.cameras, truth.T_left_right, [PosedBody((pattern,), T)], sensor=SENSOR, rng=rng)
        sampled = truth.perturbed(root @ rng.normal(size=len(root)))
        rig = StereoRig(sampled.left, sampled.right, sampled.T_left_right, result.cov, result.sigma_px)
        estimate = measure(rig, board, Shot("", *images))
        if isinstance(estimate, Missed):
            missed += 1
            continue
        xi = log_se3(inverse(estimate.T_left_body) @ T)
        d2.append(xi @ np.linalg.solve(estimate.cov, xi))
    d2 = np.array(d2)
    print(f"\n5. {count} rendered shots, the rig sampled anew from its covariance for each ({missed} missed)")
    print(
        f"  95% ellipsoid holds {100 * (d2 <= chi2.ppf(0.95, 6)).mean():.1f}%, 50% ellipsoid "
        f"{100 * (d2 <= chi2.ppf(0.5, 6)).mean():.1f}%, mean NEES {d2.mean():.2f} (6 is honest)"
    )


def time_beside_opencv(count: int = 200) -> None:
    """Time in OpenCV's corner finder and in our stages over HD pairs of a chessboard."""
    rig, rng = true_rig(1280, 720, 900.0), np.random.default_rng(6)
    board, pattern = open_board(SPEC), chessboard(COLUMNS, ROWS, SQUARE)
    poses = board_poses(rig, 20, rng)
    pairs = [
        render_pair(rig.cameras, rig.T_left_right, [PosedBody((pattern,), T)], sensor=SENSOR, rng=rng) for T in poses
    ]
    rig = StereoRig(rig.left, rig.right, rig.T_left_right, rig.cov, 0.02)
    cv2.setNumThreads(1)
    measure(rig, board, Shot("", *pairs[0]))  # compiles
    in_finder = [0.0]
    originals = {name: getattr(cv2, name) for name in ("findChessboardCorners", "findChessboardCornersSB")}

    def timed(function):
        def wrapper(*args, **kwargs):
            start = time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                in_finder[0] += time.perf_counter() - start

        return wrapper

    for name, function in originals.items():
        setattr(cv2, name, timed(function))
    detecting = 0.0
    start = time.perf_counter()
    for i in range(count):
        begin = time.perf_counter()
        found = [board.detect(image) for image in pairs[i % len(pairs)]]
        detecting += time.perf_counter() - begin
        assert not isinstance(measure_detections(rig, board.body, *found, symmetries=board.symmetries), Missed)
    total = time.perf_counter() - start
    for name, function in originals.items():
        setattr(cv2, name, function)
    finder, ours = in_finder[0], total - in_finder[0]
    print(
        f"\n6. {count} HD pairs, one thread: OpenCV's corner finder {1e3 * finder / count:.1f} ms a pair, our stages "
        f"{1e3 * ours / count:.1f} ms (corners {1e3 * (detecting - finder) / count:.1f}, match to pose "
        f"{1e3 * (total - detecting) / count:.1f}): ratio {ours / finder:.2f}"
    )
