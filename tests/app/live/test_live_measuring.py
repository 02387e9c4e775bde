"""Measuring on the page: two bodies relative to each other, and a tip found by pivoting."""

from types import SimpleNamespace

import numpy as np
import pytest

from armsight.app.live.measuring import MeasureStep, relative_pose
from armsight.app.live.step import SessionOptions, Shared
from armsight.data import Detections, Missed, Shot
from armsight.errors import InputError
from armsight.geometry.pose import adjoint, exp_se3, inverse, log_se3, pose, transform
from armsight.geometry.rotation import exp_so3
from armsight.sim.example_rig import example_rig
from armsight.vision.markers.board import open_board
from armsight.vision.pose.locate import by_rig
from armsight.vision.pose.measure import measure_detections
from armsight.vision.rig import StereoRig

BOARD = open_board("chessboard:5x4:20mm").body
SIGMA_PX = 0.05


def detected(rig, T, noise):
    p, n = transform(T, BOARD.points), len(BOARD.points)
    cov = np.tile(SIGMA_PX**2 * np.eye(2), (n, 1, 1))
    return [Detections(np.arange(n), uv + e, cov) for uv, e in zip(rig.project(p), noise, strict=True)]


@pytest.fixture(scope="module")
def rig():
    exact = example_rig((1280, 720), 900.0)
    sigma = np.full(exact.parameter_count, 1e-4)
    sigma[[0, 1, 2, 3]] = sigma[[*range((len(sigma) - 6) // 2, (len(sigma) - 6) // 2 + 4)]] = 0.5
    sigma[-6:] = [1e-4, 1e-4, 1e-4, 2e-4, 2e-4, 2e-4]
    return StereoRig(exact.left, exact.right, exact.T_left_right, np.diag(sigma**2), exact.sigma_px)


POSES = (
    pose(exp_so3(np.array([0.1, 0.3, 0.0])), np.array([-0.06, 0.02, 0.7])),
    pose(exp_so3(np.array([-0.2, 0.1, 0.4])), np.array([0.12, -0.03, 0.85])),
)


def test_the_covariance_of_a_relative_pose_is_the_scatter(rig):
    rng, n = np.random.default_rng(3), len(BOARD.points)
    truth = inverse(POSES[0]) @ POSES[1]
    off, of_noise = [], np.eye(6)
    for _ in range(80):
        noise = SIGMA_PX * rng.standard_normal((2, 2, n, 2))
        first, second = (
            measure_detections(rig, BOARD, *detected(rig, T, e)) for T, e in zip(POSES, noise, strict=True)
        )
        T, cov = relative_pose(rig, first, second)
        J = by_rig(second) - adjoint(inverse(T)) @ by_rig(first)
        off.append(log_se3(inverse(truth) @ T))
        of_noise = cov - J @ rig.cov @ J.T
    normalised = np.einsum("ni,ij,nj->n", off, np.linalg.inv(of_noise), off)
    assert normalised.mean() == pytest.approx(6.0, rel=0.25)


def test_what_the_calibration_does_to_both_bodies_alike_cancels(rig):
    """The derivative by the rig is what measuring with a wrong rig does, and most of it is common to both bodies."""
    exact = [measure_detections(rig, BOARD, *detected(rig, T, np.zeros((2, 1, 1)))) for T in POSES]
    step = np.zeros(rig.parameter_count)
    step[-5], step[0] = 1e-5, 0.05
    left, right = rig.cameras
    moved = StereoRig(
        type(left)(left.image_size_px, left.model, left.intrinsics + 0.05 * np.eye(4)[0], left.distortion),
        right,
        rig.T_left_right @ exp_se3(step[-6:]),
        rig.cov,
        rig.sigma_px,
    )
    wrong = [measure_detections(moved, BOARD, *detected(rig, T, np.zeros((2, 1, 1)))) for T in POSES]
    for right_one, wrong_one in zip(exact, wrong, strict=True):
        there = log_se3(inverse(right_one.T_left_body) @ wrong_one.T_left_body)
        assert by_rig(right_one) @ step == pytest.approx(there, rel=0.1, abs=2e-6)
    T, cov = relative_pose(rig, *exact)
    assert np.abs(T - inverse(POSES[0]) @ POSES[1]).max() < 1e-6
    alone = np.sqrt(np.trace(exact[1].cov[:3, :3] - exact[1].cov_noise[:3, :3]))
    assert np.sqrt(np.trace(cov[:3, :3])) < alone


def live(number):
    return SimpleNamespace(shot=Shot(str(number), None, None), number=number, arrived_s=0.0, age_s=lambda now: 0.0)


@pytest.fixture
def step(rig, tmp_path):
    made = MeasureStep(Shared(SessionOptions(tmp_path), tmp_path, lambda level, text: None, "usb:0,1"))
    made.use_rig(rig, tmp_path / "rig.json")
    made.use_target("chessboard:5x4:20mm")
    yield made
    made.close()


def test_a_tip_is_found_by_pivoting(step, rig):
    rng, p_tip, p_stands = np.random.default_rng(5), np.array([0.02, 0.01, -0.12]), np.array([0.0, 0.05, 0.75])
    with pytest.raises(InputError, match="no pose is measured yet"):
        step.pivot_tip()

    def show(k):
        R = exp_so3(rng.uniform(-0.35, 0.35, 3))
        noise = SIGMA_PX * rng.standard_normal((2, len(BOARD.points), 2))
        step.take(live(k), measure_detections(rig, BOARD, *detected(rig, pose(R, p_stands - R @ p_tip), noise)))

    show(0)
    step.pivot_tip()
    assert step.state.pivoting
    for k in range(1, 30):
        show(k)
    assert "rotated by up to" in step.state.pivot
    step.pivot_tip()
    at, sigma = step.state.tip_mm
    assert np.linalg.norm(np.array(at) - 1e3 * p_stands) < 4.0 * np.linalg.norm(sigma)
    assert not step.state.pivoting


def test_a_second_body_is_another_one_and_says_why_it_is_missed(step, rig):
    with pytest.raises(InputError, match="must be another one"):
        step.use_second_body("chessboard:5x4:20mm")
    step.use_second_body("chessboard:9x6:25mm")
    first, second = (measure_detections(rig, BOARD, *detected(rig, T, np.zeros((2, 1, 1)))) for T in POSES)
    step.take(live(1), first)
    assert step.state.second.reason == "no shot yet"
    step._second.newest = live(1), Missed("left: the board is not in view")
    assert step.state.second.reason == "left: the board is not in view"
    step._second.newest = live(1), second
    shown = step.state.second
    assert shown.reason is None
    assert shown.distance_mm[0] == pytest.approx(1e3 * np.linalg.norm((inverse(POSES[0]) @ POSES[1])[:3, 3]), abs=0.01)
    step.use_second_body("")
    assert step.state.second is None
