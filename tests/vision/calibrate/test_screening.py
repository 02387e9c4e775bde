from dataclasses import replace

import numpy as np
import pytest

from armsight.data import Array
from armsight.errors import CalibrationError
from armsight.geometry.pose import inverse, log_se3
from armsight.geometry.rotation import exp_so3
from armsight.vision.calibrate.boards import calibrate_boards, rigid_board
from armsight.vision.calibrate.heldout import cross_validate, pair_errors, residual_epipolar_rms, summary
from armsight.vision.calibrate.screen import merged_notes, noise_px, robust_sigma, screen
from armsight.vision.calibrate.start import agreed_symmetries, pinhole, relative_poses, start_board
from armsight.vision.calibrate.weak import coverage, require_order, weaknesses
from armsight.vision.match import join, renamed
from armsight.vision.pose.bundle import BundleState, Observations, minimise
from board_views import SIZES, board_pairs, rig_and_board


def observed(pairs):
    return Observations.from_shots([join(p.left, p.right) for p in pairs])


def truth(rig, Ts):
    return BundleState(rig.cameras, rig.T_left_right, np.array(Ts), np.zeros(0))


# Starting from nothing.


@pytest.mark.parametrize(
    ("model", "true_model", "focal_px"),
    [("brown4", "brown4", 450.0), ("brown4", "none", 900.0), ("fisheye", "fisheye", 230.0)],
)
def test_cameras_are_found_from_nothing(model, true_model, focal_px):
    true, board, Ts = rig_and_board(true_model, focal_px, 8)
    found = start_board(board.body.points, SIZES, observed(board_pairs(true, board.body.points, Ts)), model)
    for camera, real in zip(found.state.cameras, true.cameras, strict=True):
        # Eight boards fix the focal length to half a percent or better; the start's job is the right minimum.
        assert camera.intrinsics[:2] == pytest.approx(real.intrinsics[:2], rel=0.02)
    assert np.linalg.norm(log_se3(inverse(found.state.T_left_right) @ true.T_left_right)) < 0.02


def test_a_pinhole_looks_from_the_middle():
    camera = pinhole((640, 360), 500.0, "brown8")
    assert camera.intrinsics.tolist() == [500, 500, 319.5, 179.5]
    assert camera.distortion.tolist() == [0] * 8


def test_most_shots_decide_the_relative_pose():
    rng, (true, _, Ts) = np.random.default_rng(0), rig_and_board()
    left = [[T] for T in Ts[:10]]
    right = [[inverse(true.T_left_right) @ T] for T in Ts[:10]]
    for j in (1, 4, 7):  # three shots are wrong
        right[j] = [
            right[j][0] @ np.block([[exp_so3(rng.normal(size=3)), rng.normal(size=(3, 1))], [np.zeros((1, 3)), 1]])
        ]
    for j in (0, 3):  # two have a mirror solution in front
        left[j].insert(0, Ts[j + 1])
    best = relative_poses(left, right)[0]
    assert best == pytest.approx(true.T_left_right, abs=1e-9)
    assert relative_poses([[], []], [[], []]) == []


# Screening.


def test_the_noise_is_read_off_the_residuals():
    true, board, Ts = rig_and_board()
    observations = observed(board_pairs(true, board.body.points, Ts, sigma=0.2))
    solution = minimise(rigid_board(board.body.points), truth(true, Ts), observations, 0.2)
    # 4320 residuals: sqrt(1 / 8640) is 1.1%; four times that. The median is 1.44 times as vague as the mean square.
    assert noise_px(solution, observations, 24) == pytest.approx(0.2, rel=0.045)
    assert robust_sigma(solution) == pytest.approx(0.2, rel=0.065)


def test_only_what_is_wrong_is_thrown_out():
    true, board, Ts = rig_and_board()
    pairs = board_pairs(true, board.body.points, Ts)
    observations = observed(pairs)
    names = tuple(p.name for p in pairs)
    clean = screen(rigid_board(board.body.points), truth(true, Ts), observations, names)
    assert clean.rejected == clean.notes == ()
    assert clean.kept.tolist() == list(range(len(pairs)))
    uv = np.array(observations.uv)
    rows = np.flatnonzero((observations.shot == 6) & (observations.camera == 1))
    uv[rows] += 8.0 * np.random.default_rng(0).normal(size=(len(rows), 2))
    single = int(np.flatnonzero((observations.shot == 2) & (observations.camera == 0))[11])
    uv[single] += (5.0, 0.0)
    dirty = screen(rigid_board(board.body.points), truth(true, Ts), replace(observations, uv=uv), names)
    assert [r.pair for r in dirty.rejected] == ["p06"]
    assert dirty.notes == ("p02: 1 of 108 points of both images dropped as gross errors",)
    assert 6 not in dirty.kept
    many = [f"p0{k}: {k + 1} of 108 points dropped as gross errors" for k in range(6)]
    assert merged_notes(["p09: corrected", *many[:5]]) == ["p09: corrected", *many[:5]]
    merged = merged_notes(["p09: corrected", *many])
    assert merged[0] == "p09: corrected"
    most = "p05 (6), p04 (5), p03 (4), p02 (3), p01 (2)"
    assert merged[1].startswith(f"21 points in 6 pairs dropped as gross errors; most in {most};")
    assert dirty.observations.shot_count == len(pairs) - 1
    assert len(dirty.observations.shot) == len(observations.shot) - 108 - 1


def test_a_reversed_board_is_found_by_shot():
    true, board, Ts = rig_and_board(spec="chessboard:9x7:25mm")
    pairs = board_pairs(true, board.body.points, Ts[:4])
    pairs[2] = replace(pairs[2], right=renamed(pairs[2].right, board.symmetries[0]))
    found = agreed_symmetries(board.body.points, SIZES, observed(pairs), board.symmetries, "brown4")
    assert list(found) == [2]
    assert (found[2] == board.symmetries[0]).all()


# Held-out errors.


def test_a_perfect_rig_has_no_error_and_a_large_board_shows_as_scale():
    true, board, Ts = rig_and_board(count=6)
    points = board.body.points
    exact = summary(pair_errors(true, points, observed(board_pairs(true, points, Ts, sigma=0.0))), 1)
    assert exact.epipolar_rms_px < 1e-6
    assert exact.rigid_rms_m < 1e-9
    assert abs(exact.scale_error) < 1e-8
    middle = points.mean(axis=0)
    large = middle + 1.01 * (points - middle)
    errors = pair_errors(true, points, observed(board_pairs(true, large, Ts, sigma=0.0)))
    assert errors.scale == pytest.approx(np.full(len(Ts), 1.01), abs=1e-8)
    assert errors.rigid_m == pytest.approx(
        np.full(len(Ts), 0.01 * np.sqrt(((points - middle) ** 2).sum(axis=1).mean())), rel=1e-6
    )
    assert errors.weight.tolist() == [54.0] * len(Ts)


def test_the_epipolar_error_is_that_of_the_noise():
    true, board, Ts = rig_and_board()
    observations = observed(board_pairs(true, board.body.points, Ts, sigma=0.1))
    # Either image's distance from its line holds both images' noise: sqrt(2) times 0.1 px where the scales are equal.
    assert residual_epipolar_rms(true, observations) == pytest.approx(0.1 * np.sqrt(2), rel=0.06)


def test_every_shot_is_held_out_once_and_never_fitted_then():
    true, board, Ts = rig_and_board(count=7)
    observations, asked = observed(board_pairs(true, board.body.points, Ts)), []

    def fit(rows):
        asked.append(rows.tolist())
        return true, board.body.points, None

    errors = cross_validate(fit, board.body.points, observations, 3)
    assert errors.pair.tolist() == list(range(7))
    held = [sorted(set(range(7)) - set(rows)) for rows in asked]
    assert held == [[0, 3, 6], [1, 4], [2, 5]]
    direct = pair_errors(true, board.body.points, observations)
    assert errors.epipolar_px == pytest.approx(direct.epipolar_px, rel=1e-12)


# What is weak, as sentences.


@pytest.fixture(scope="module")
def calibration():
    true, board, Ts = rig_and_board()
    return calibrate_boards(
        board, board_pairs(true, board.body.points, Ts), SIZES, models=("brown5",), folds=3, flat=True
    )


def said(calibration, texts):
    return any(texts in w for w in weaknesses(calibration))


def test_coverage_counts_every_detection(calibration):
    for side in (0, 1):
        assert coverage(calibration, side, 8).sum() == (calibration.observations.camera == side).sum()


def test_each_weakness_is_reported_where_it_is_and_only_there(calibration):
    c = calibration
    assert not said(c, "pairs were")
    assert said(replace(c, pairs=c.pairs[:5]), "only 5 pairs were used")
    assert said(replace(c, pairs_found=40), "20 of 40 pairs were rejected")
    assert not said(c, "too few tilts")
    facing: Array = np.array(c.solution.state.Ts_left_body)
    facing[:, :3, :3] = np.eye(3)
    facing[:, :2, 3] = 0.0
    assert said(replace(c, solution=replace(c.solution, state=replace(c.solution.state, Ts_left_body=facing))), "tilts")
    corner = replace(c.observations, uv=0.3 * c.observations.uv)
    assert said(replace(c, observations=corner), "% of the left image never saw the board")
    blurred = np.array(c.solution.residuals_px)
    blurred[c.observations.camera == 1] *= 3
    assert not said(c, "out of focus")
    assert said(replace(c, solution=replace(c.solution, residuals_px=blurred)), "the right camera's corners are")
    late = np.array(c.errors.epipolar_px)
    late[4] *= 6
    assert not said(c, "unsynchronised")
    assert said(replace(c, errors=replace(c.errors, epipolar_px=late)), "p04")
    assert not said(c, "exchanged")
    assert not said(c, "the square size")
    large = replace(c.errors, scale=c.errors.scale + 0.03)
    wrong = replace(c, errors=large, held_out=replace(c.held_out, scale_error=0.03))
    assert said(wrong, "3.00% too large")
    assert said(replace(c, rig=replace(c.rig, cov=900 * c.rig.cov)), "the focal length is known to")


def test_exchanged_cameras_are_rejected():
    true, board, Ts = rig_and_board()
    pairs = [replace(p, left=p.right, right=p.left) for p in board_pairs(true, board.body.points, Ts[:8])]
    c = calibrate_boards(board, pairs, SIZES, models=("brown4",), folds=2, flat=True)
    with pytest.raises(CalibrationError, match="left and right are exchanged"):
        require_order(c)
    assert c.rig.baseline_m == pytest.approx(true.baseline_m, rel=0.02)
