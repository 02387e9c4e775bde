"""The next pose of a guided calibration: its prediction is that of bundle adjustment, and guided shots beat random ones."""

from dataclasses import replace

import numpy as np
import pytest

from armsight.app.live import calibration
from armsight.app.live.calibration import quick_look
from armsight.data import Detections
from armsight.geometry.pose import transform
from armsight.sim.example_rig import board_poses, example_rig
from armsight.sim.render.scene import chessboard
from armsight.vision.calibrate.boards import Pair, calibrate_boards
from armsight.vision.calibrate.guide import CalibrationAim, Guide, Knowledge, error_weights, guessed_rig, working_points
from armsight.vision.calibrate.result import corner_variance_px2
from armsight.vision.markers.board import open_board
from armsight.vision.triangulate import optimal_points

SIGMA_PX = 0.05
BOARD = open_board("chessboard:9x6:30mm")
RIG = example_rig((640, 360), 450.0, model="brown5")
SIZES = (RIG.left.image_size_px, RIG.right.image_size_px)


def seen(T, name, rng):
    """What both cameras detect of the board at a pose, with noise."""
    p, count = transform(T, BOARD.body.points), len(BOARD.body.points)
    cov = np.tile(SIGMA_PX**2 * np.eye(2), (count, 1, 1))
    return Pair(
        name, *(Detections(np.arange(count), uv + rng.normal(0, SIGMA_PX, uv.shape), cov) for uv in RIG.project(p))
    )


def calibrated(Ts, seed=1):
    rng = np.random.default_rng(seed)
    pairs = [seen(T, f"{n}", rng) for n, T in enumerate(Ts)]
    return calibrate_boards(BOARD, pairs, SIZES, models=("brown5",), folds=4)


@pytest.fixture(scope="module")
def poses():
    return board_poses(np.random.default_rng(3), RIG, chessboard(9, 6, 0.030), 7)


@pytest.fixture(scope="module")
def five(poses):
    return calibrated(poses[:5])


def test_what_is_predicted_of_a_shot_is_what_it_leaves(five, poses):
    knowledge = Knowledge.of(five, BOARD, CalibrationAim())
    predicted = knowledge.errors_after_m(poses[5:6])[0]
    assert knowledge.after(poses[5]).error_m == pytest.approx(predicted, rel=1e-6)
    # The adjustment of six shots itself: the same information, up to noise and to what the prior of the print learns.
    found = Knowledge.of(calibrated(poses[:6]), BOARD, CalibrationAim()).error_m
    assert 0.5 < predicted / found < 2.0
    assert predicted < 0.9 * knowledge.error_m


def test_the_predicted_error_is_that_of_triangulated_points(five):
    # 200 rigs drawn from the covariance: the RMS error of points of the volume is the predicted one.
    knowledge, rig = Knowledge.of(five, BOARD, CalibrationAim()), five.rig
    points = working_points(rig, 0.8)
    weights, rng = error_weights(rig, points), np.random.default_rng(0)
    uv = np.stack(rig.project(points), axis=1)
    cov_uv = np.tile(np.eye(2), (len(uv), 2, 1, 1))
    drawn = [
        ((optimal_points(rig.perturbed(d), uv, cov_uv)[0] - points) ** 2).sum(axis=1).mean()
        for d in rng.multivariate_normal(np.zeros(rig.parameter_count), 0.01 * rig.cov, 200)
    ]
    assert np.sqrt(np.mean(drawn)) == pytest.approx(0.1 * knowledge.error_m, rel=0.15)
    assert np.sqrt(np.trace(weights @ rig.cov)) == pytest.approx(knowledge.error_m, rel=1e-6)


def test_guided_shots_beat_random_ones(five, poses):
    guide, knowledge, rig = Guide(BOARD), Knowledge.of(five, BOARD, CalibrationAim()), five.rig
    guided = random = knowledge
    for T in poses[5:7]:
        guided, random = guided.after(guide.best(guided, rig).T_left_board), random.after(T)
    assert guided.error_m < 0.9 * random.error_m


def test_candidates_and_first_poses_are_in_view_of_both_cameras():
    guide = Guide(BOARD)
    Ts = guide.candidates(RIG)
    assert len(Ts) > 40
    rig = guessed_rig(SIZES, RIG.T_left_right)
    first = [guide.first(n, rig).T_left_board for n in range(5)]
    for cameras, shown in ((RIG, Ts), (rig, np.array(first))):
        views = cameras.project(transform(shown[:, None], BOARD.body.points[None]).reshape(-1, 3))
        for camera, uv in zip(cameras.cameras, views, strict=True):
            assert ((uv > 0) & (uv < np.array(camera.image_size_px) - 1)).all()


def test_shots_that_are_missing_are_counted(five):
    guide, knowledge = Guide(BOARD), Knowledge.of(five, BOARD, CalibrationAim())
    for share, least, most in ((1.01, 0, 0), (0.6, 1, 6)):
        missing = guide.shots_missing(replace(knowledge, goal_m=share * knowledge.error_m), five.rig)
        assert least <= missing <= most
    assert guide.shots_missing(replace(knowledge, goal_m=1e-7), five.rig) is None


def test_good_enough_is_an_error_as_small_as_the_noise_of_a_point(five):
    """Against the scatter of points triangulated from noisy pixels, 1.5 % for 100 draws of 70 points (3 sigma: 5 %)."""
    rig, rng = five.rig, np.random.default_rng(2)
    points = working_points(rig, 0.8)
    uv, variance = np.stack(rig.project(points), axis=1), corner_variance_px2(five)
    cov_uv = np.broadcast_to(variance[:, None, None] * np.eye(2), (len(points), 2, 2, 2))
    noisy = [
        optimal_points(rig, uv + rng.normal(size=uv.shape) * np.sqrt(variance)[:, None], cov_uv)[0] for _ in range(100)
    ]
    seen = np.sqrt(((np.array(noisy) - points) ** 2).sum(axis=-1).mean())
    assert Knowledge.of(five, BOARD, CalibrationAim()).goal_m == pytest.approx(seen, rel=0.05)
    assert Knowledge.of(five, BOARD, CalibrationAim(3e-4)).goal_m == 3e-4


def test_a_board_that_opencv_overlooks_is_found_and_none_is_found_quickly(monkeypatch):

    squares = (np.indices((7, 10)).sum(axis=0) % 2).astype(np.uint8)
    image = np.full((360, 640), 200, np.uint8)
    image[60:270, 150:450] = np.kron(40 + 180 * squares, np.ones((30, 30), np.uint8))
    monkeypatch.setattr(calibration.cv2, "checkChessboard", lambda *_: False)
    assert quick_look(BOARD, image, thorough=False).problem is None
    assert "not in view" in quick_look(BOARD, np.full((360, 640), 200, np.uint8), thorough=False).problem
