"""Boards that move between the two exposures: true motions, sampled by a seed, are the oracle."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from armsight.geometry.pose import inverse, log_se3, pose, transform
from armsight.geometry.rotation import exp_so3
from armsight.vision.calibrate import boards
from armsight.vision.calibrate.boards import calibrate_boards, calibrate_recording, rigid_board
from armsight.vision.calibrate.heldout import pair_errors, summary
from armsight.vision.calibrate.motion import ExposureMotion
from armsight.vision.match import join, renamed
from armsight.vision.pose.bundle import BundleState, Observations, minimise
from armsight.vision.pose.measure import measure_detections
from armsight.vision.triangulate import optimal_points
from board_views import SIZES, board_pairs, rig_and_board, rig_error
from views import both_pixels

WAY_M, ROTATION_RAD, SIGMA_PX = 3e-4, 2e-3, 0.05


def motions_of(count, seed=11, far=()):
    """(count, 6) motions, those in ``far`` five times as long."""
    motions = np.random.default_rng(seed).normal(size=(count, 6)) * np.repeat([WAY_M, ROTATION_RAD], 3)
    motions[list(far)] *= 5
    return motions


def unsynchronised(true, board, Ts, motions, seed=0):
    """Pairs of a board that moved by ``motions`` (N, 6) before the right camera looked."""
    rng, points, pairs = np.random.default_rng(seed), board.body.points, board_pairs(true, board.body.points, Ts)
    middle = points.mean(axis=0)
    for n, (T, motion) in enumerate(zip(Ts, motions, strict=True)):
        later = (points - middle) @ exp_so3(motion[3:]).T + middle + motion[:3]
        uv = np.stack([both_pixels(true, transform(T, p))[:, side] for side, p in enumerate((points, later))])
        uv = uv + SIGMA_PX * rng.normal(size=uv.shape)
        pair = pairs[n]
        pairs[n] = replace(pair, left=replace(pair.left, uv=uv[0]), right=replace(pair.right, uv=uv[1]))
    return pairs


def test_the_one_board_that_moved_among_few_is_rejected():
    true, board, Ts = rig_and_board(count=9)
    motions = np.zeros((9, 6))
    motions[3, :3] = 1.2e-3  # a significant motion of nine pairs, and no other pair moved
    pairs = unsynchronised(true, board, Ts, motions)
    c = calibrate_boards(board, pairs, SIZES, models=("brown4",), folds=2, flat=True)
    assert [rejected.pair for rejected in c.rejected] == [pairs[3].name]
    assert c.motion is None


@pytest.fixture(scope="module")
def moved():
    true, board, Ts = rig_and_board(count=24)
    motions = motions_of(len(Ts), far=(4, 13))
    pairs = unsynchronised(true, board, Ts, motions)
    return true, motions, calibrate_boards(board, pairs, SIZES, models=("brown5",), flat=True)


def test_boards_that_stood_still_have_no_motion():
    true, board, Ts = rig_and_board()
    c = calibrate_boards(board, board_pairs(true, board.body.points, Ts), SIZES, models=("brown5",), folds=2, flat=True)
    assert c.motion is None
    assert c.held_out.motion_rms_m == c.held_out.motion_rms_rad == 0
    assert not any("synchronised" in w for w in c.weaknesses)


def test_a_rippled_lens_is_not_called_unsynchronised():
    true, board, Ts = rig_and_board(count=16)

    def rippled(side, found):
        angle = 2 * np.pi * (found.uv / SIZES[side]) @ [1.2, 0.9] + 0.4 + side
        return replace(found, uv=found.uv + 0.6 * np.stack([np.sin(angle), np.cos(angle)], axis=1))

    pairs = [
        replace(p, left=rippled(0, p.left), right=rippled(1, p.right))
        for p in unsynchronised(true, board, Ts, np.zeros((16, 6)))
    ]
    c = calibrate_boards(board, pairs, SIZES, models=("brown5",), folds=2, flat=True)
    assert c.motion is not None  # which fits as far as a motion can
    (said,) = (w for w in c.weaknesses if "exposures" in w)
    assert "depend on the position in the images" in said
    assert "synchronised" not in said


def test_motion_is_learned_and_stated(moved):
    _, motions, c = moved
    factor = c.held_out.normalised_rms
    # The far pairs make most of the mean square, which is to be met whatever a pair's weight; a way is seen to
    # 0.05 px * 0.7 m / 450 px / sqrt(54) = 0.01 mm sideways and some five times that along the line of sight.
    assert c.motion.rms_m / factor == pytest.approx(np.sqrt((motions[:, :3] ** 2).mean()), rel=0.15)
    assert c.motion.rms[1] / factor == pytest.approx(np.sqrt((motions[:, 3:] ** 2).mean()), rel=0.35)
    assert set(np.argsort(c.motion.weights)[:2]) == {4, 13}
    # 24 pairs of 54 corners of both cameras: sqrt(1 / (2 * 5184)) is 1%, and motions take a few per cent of that.
    assert c.solution.sigma_px == pytest.approx(SIGMA_PX, rel=0.05)
    assert not c.rejected
    (said,) = (w for w in c.weaknesses if "synchronised" in w)
    assert f"{1e3 * c.motion.rms_m:.2f} mm" in said
    assert c.held_out.motion_rms_m * factor == pytest.approx(c.motion.rms_m)


def test_the_rig_of_moving_boards_is_within_its_covariance_and_better_than_without(moved, monkeypatch):
    true, _, c = moved
    error, sigma = rig_error(c.rig, true), np.sqrt(np.diag(c.rig.cov))
    assert (np.abs(error) < 4 * sigma).all(), error / sigma
    monkeypatch.setattr(boards, "MOTION_WORTH", 1.0)
    true, board, Ts = rig_and_board(count=24)
    pairs = unsynchronised(true, board, Ts, motions_of(len(Ts), far=(4, 13)))
    assumed = calibrate_boards(board, pairs, SIZES, models=("brown5",), flat=True)
    assert assumed.motion is None
    for rows in (slice(0, 4), slice(-6, None)):
        assert np.linalg.norm(error[rows] / sigma[rows]) < np.linalg.norm(
            rig_error(assumed.rig, true)[rows] / sigma[rows]
        )


def test_what_is_predicted_for_other_pairs_holds_their_motion(moved):
    true, _, c = moved
    _, board, Ts = rig_and_board(count=24, seed=8)
    pairs = unsynchronised(true, board, Ts, motions_of(len(Ts), seed=12, far=(0, 9)), seed=1)
    rows = Observations.from_shots([join(p.left, p.right) for p in pairs])
    corners = replace(c.rig, sigma_px=c.solution.sigma_px)
    with_motion, without = (
        summary(pair_errors(corners, board.body.points, rows, motion=motion), 1).normalised_rms
        for motion in (c.motion, None)
    )
    assert 0.8 < with_motion < 1.25
    assert without > 2
    assert 0.8 < c.held_out.normalised_rms < 1.25
    # Who measures with the rig's file knows of no motion: its noise holds it, as if it were the corners'.
    assert 0.8 < summary(pair_errors(c.rig, board.body.points, rows), 1).normalised_rms < 1.25


def test_a_body_at_rest_is_measured_within_the_sigma_of_a_rig_of_moving_boards(moved):
    true, _, c = moved
    _, board, Ts = rig_and_board(count=24, seed=8)
    nees = []
    for T, pair in zip(Ts, unsynchronised(true, board, Ts, 0 * motions_of(len(Ts)), seed=2), strict=True):
        r = measure_detections(c.rig, board.body, pair.left, pair.right)
        e = log_se3(inverse(T) @ r.T_left_body)
        nees.append(e @ np.linalg.solve(r.cov, e))
    # Errors of one rig are common to all shots: a bound on their mean as wide as that of a single chi-square of six.
    assert np.mean(nees) < chi2.ppf(0.999, 6)


def test_a_motion_seen_from_a_camera_moves_points_as_it_does():
    true, board, Ts = rig_and_board()
    points, T = board.body.points, Ts[3]
    middle, motion = points.mean(axis=0), ExposureMotion(np.ones(2), np.ones(1), np.array([2e-6, 3e-5]))
    T_right_board = np.linalg.inv(true.T_left_right) @ T
    seen = both_pixels(true, transform(T, points))
    p, _, by_rig = optimal_points(true, seen, np.tile(np.eye(2), (len(points), 2, 1, 1)))
    by_motion = []
    for axis in np.eye(6):
        step = axis * np.repeat([2e-6, 3e-5], 3)
        M = pose(exp_so3(step[3:]), step[:3])
        later = transform(M, points - middle) + middle
        uv = np.stack([seen[:, 0], both_pixels(true, transform(T, later))[:, 1]], axis=1)
        by_motion.append(optimal_points(true, uv, np.tile(np.eye(2), (len(points), 2, 1, 1)))[0] - p)
    J = np.stack(by_motion, axis=-1).reshape(-1, 6)
    G = by_rig[..., -6:].reshape(-1, 6)
    claimed, oracle = G @ motion.seen_from(T_right_board, middle) @ G.T, J @ J.T
    # Finite steps of a thousandth of a pixel: second order is below a hundred-thousandth of the first.
    np.testing.assert_allclose(claimed, oracle, rtol=0, atol=1e-4 * oracle.max())


def test_a_board_far_apart_in_the_two_images_is_no_motion():
    true, board, Ts = rig_and_board(count=24)
    pairs = unsynchronised(true, board, Ts, motions_of(len(Ts)))
    order = np.arange(54).reshape(6, 9)[::-1, ::-1].ravel()
    pairs[7] = replace(pairs[7], right=renamed(pairs[7].right, order))
    c = calibrate_boards(board, pairs, SIZES, models=("brown5",), folds=2, flat=True)
    assert [r.pair for r in c.rejected] == ["p07"]
    assert c.motion.rms_m < 2 * WAY_M


def test_learning_ends_at_the_scale_of_what_is_plainly_seen():
    rng = np.random.default_rng(4)
    true, board, Ts = rig_and_board(count=3)
    points = board.body.points
    rows = Observations.from_shots([join(p.left, p.right) for p in board_pairs(true, points, Ts)])
    start = BundleState(true.cameras, true.T_left_right, np.array(Ts), np.zeros(0))
    solution = minimise(rigid_board(points), start, rows, 0.1)
    # Student's t of four degrees of freedom, seen without noise: EM finds its scale.
    count = 4000
    inverse_variance = rng.gamma(2.0, 0.5, size=(count, 1))
    seen = rng.normal(size=(count, 6)) * np.repeat([WAY_M, ROTATION_RAD], 3) / np.sqrt(inverse_variance)
    solution = replace(solution, state=replace(solution.state, motions=seen), cov_motions=np.zeros((count, 6, 6)))
    motion = ExposureMotion.guessed(points, count)
    for _ in range(60):
        motion, freed = motion.updated(solution)
    assert freed == 6 * count
    # A scale of 12000 draws of a heavy tail: about 1 / sqrt(2 * 12000) each, four of these and a half for the tail.
    assert motion.scales == pytest.approx([WAY_M, ROTATION_RAD], rel=0.04)
    assert motion.rms_m == pytest.approx(np.sqrt((seen[:, :3] ** 2).mean()), rel=1e-12)


def swung(t_s):
    """Poses (N, 4, 4) of a board that is swung and tilted in a hand."""
    swing = np.sin(2 * np.pi * t_s[:, None] * [0.5, 0.7, 0.3] + [0.3, 0.9, 1.7])
    tilts = swing * [0.35, 0.3, 0.2] + [0.25, -0.2, 0.1]
    return np.array(
        [pose(exp_so3(w), [-0.08, -0.06, 0.6] + s * [0.08, 0.06, 0.08]) for w, s in zip(tilts, swing, strict=True)]
    )


def recorded(skew_s, count=14, rate_hz=12.0, seed=3):
    """The true rig, the board, times and pairs of a swung board whose right images are late."""
    true, board, _ = rig_and_board()
    t_s = np.arange(count) / rate_hz
    early, late = (
        board_pairs(true, board.body.points, swung(t_s + d), sigma=SIGMA_PX, seed=s)
        for d, s in ((0.0, seed), (skew_s, seed + 1))
    )
    return true, board, t_s, [replace(a, right=b.right) for a, b in zip(early, late, strict=True)]


def test_the_skew_is_found_from_a_recording():
    skew_s = -0.055  # the right camera's next image is the nearer one
    true, board, t_s, pairs = recorded(skew_s)
    c = calibrate_recording(board, pairs, t_s, SIZES, models=("brown5",), flat=True, folds=2)
    found = c.rig.shutters
    assert found is not None, c.notes
    assert abs(found.skew_s - skew_s) < max(4 * found.sigmas[0], 1e-3)
    assert found.sigmas[0] < 1e-3
    assert c.held_out.epipolar_rms_px < 2 * SIGMA_PX
    assert abs(c.rig.baseline_m - true.baseline_m) < 1e-3
    assert any("do not expose at one time" in note for note in c.notes)
