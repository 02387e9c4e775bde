"""Cameras that change while they are calibrated: what changed is named, and the rig's covariance holds both states."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from armsight.errors import CalibrationError
from armsight.geometry.pose import exp_se3
from armsight.vision.calibrate.boards import Pair, calibrate_boards
from armsight.vision.calibrate.bodies import calibrate_bodies
from armsight.vision.camera import Camera
from armsight.vision.detections import SeenShot
from board_views import SIZES, board_pairs, rig_and_board, rig_error

FROM, COUNT = 12, 20


def with_intrinsics(rig, side, change):
    camera = rig.cameras[side]
    other = Camera(camera.image_size_px, camera.model, change(camera.intrinsics), camera.distortion)
    return replace(rig, left=other) if side == 0 else replace(rig, right=other)


def refocused(rig):
    return with_intrinsics(rig, 1, lambda k: k * [1.005, 1.005, 1, 1])


def shifted(rig):
    return with_intrinsics(rig, 0, lambda k: k + np.array([0, 0, 0, 2.0]))


def knocked(rig):
    return replace(rig, T_left_right=rig.T_left_right @ exp_se3(np.array([0, 2e-3, 0, 0.01, 0, 0])))


def pairs_of(seed, change):
    """Pairs of which those from FROM on are of changed cameras: the board, both rigs, the pairs."""
    true, board, Ts = rig_and_board("brown4", count=COUNT, seed=seed)
    after = change(true)
    first, then = (board_pairs(rig, board.body.points, Ts, seed=seed) for rig in (true, after))
    return board, (true, after), first[:FROM] + then[FROM:]


@pytest.mark.parametrize(
    ("change", "what", "seed"),
    [
        (refocused, "the right focal length by +0.4", 811),
        (shifted, "the left image's position by ", 812),
        (knocked, "the relative pose of the cameras by ", 811),
        (knocked, "the relative pose of the cameras by ", 812),
    ],
)
def test_cameras_that_changed_are_named_and_their_covariance_holds_both_states(change, what, seed):
    board, rigs, pairs = pairs_of(seed, change)
    found = calibrate_boards(board, pairs, SIZES, models=("brown4",), folds=2)
    assert found.change is not None
    assert abs(found.change.row - FROM) <= 1
    assert any("the cameras changed about between" in weak and what in weak for weak in found.weaknesses)
    for rig in rigs:
        error = rig_error(found.rig, rig)
        assert error @ np.linalg.solve(found.rig.cov, error) < 4 * len(error)


@pytest.mark.parametrize(("factor", "first"), [(1.05, 6), (0.8, 14)])
def test_a_board_of_another_size_midway_is_an_error(factor, first):
    true, board, Ts = rig_and_board("brown4", count=COUNT, seed=816)
    one, other = (board_pairs(true, size * board.body.points, Ts, seed=816) for size in (1.0, factor))
    with pytest.raises(CalibrationError, match=f"from p{first:02d} on the board is {factor:.3g} times as large"):
        calibrate_boards(board, one[:first] + other[first:], SIZES, models=("brown4",), folds=2)


@pytest.mark.parametrize(("factor", "seed"), [(1.003, 817), (1.01, 816)])
def test_a_print_of_another_scale_midway_is_named_and_the_covariance_holds_both(factor, seed):
    true, board, Ts = rig_and_board("brown4", count=COUNT, seed=seed)
    one, other = (board_pairs(true, size * board.body.points, Ts, seed=seed) for size in (1.0, factor))
    found = calibrate_boards(board, one[:FROM] + other[FROM:], SIZES, models=("brown4",), folds=2)
    assert any(
        "changed about between" in weak or "mm of the baseline) about between" in weak for weak in found.weaknesses
    )
    assert any("another board or print" in weak for weak in found.weaknesses)
    assert seed != 816 or not any("synchronised" in weak for weak in found.weaknesses)  # named surely
    error = rig_error(found.rig, true)
    assert error @ np.linalg.solve(found.rig.cov, error) < 4 * len(error)


def test_boards_of_two_sizes_that_alternate_are_no_motion():
    true, board, Ts = rig_and_board("brown4", count=COUNT, seed=818)
    one, other = (board_pairs(true, size * board.body.points, Ts, seed=818) for size in (1.0, 1.02))
    mixed = [pair for both in zip(one[::2], other[1::2], strict=True) for pair in both]
    found = calibrate_boards(board, mixed, SIZES, models=("brown4",), folds=2)
    assert any("as boards of different sizes are, by" in weak for weak in found.weaknesses)
    assert not any("not synchronised" in weak for weak in found.weaknesses)


@pytest.mark.parametrize("seed", [821, 822])
def test_cameras_that_did_not_change_are_not_said_to(seed):
    board, _, pairs = pairs_of(seed, lambda rig: rig)
    assert calibrate_boards(board, pairs, SIZES, models=("brown4",), folds=2).change is None


@pytest.mark.parametrize("change", [refocused, shifted])
def test_a_change_where_the_board_goes_from_left_to_right_is_in_the_covariance(change):
    true, board, Ts = rig_and_board("brown4", count=COUNT, seed=7001)
    rigs, Ts = (true, change(true)), Ts[np.argsort(Ts[:, 0, 3] / Ts[:, 2, 3])]
    before, after = (board_pairs(rig, board.body.points, Ts, seed=7001) for rig in rigs)
    found = calibrate_boards(board, before[:FROM] + after[FROM:], SIZES, models=("brown4",), folds=2)
    assert any("fit other cameras" in weak or "the cameras changed" in weak for weak in found.weaknesses)
    for rig in rigs:
        error = rig_error(found.rig, rig)
        assert error @ np.linalg.solve(found.rig.cov, error) < 4 * len(error)


def test_a_lens_that_the_model_lacks_is_no_change_where_the_board_goes_from_left_to_right():
    true, board, Ts = rig_and_board("fisheye", count=24, seed=4024)
    pairs = board_pairs(true, board.body.points, Ts[np.argsort(Ts[:, 0, 3] / Ts[:, 2, 3])], seed=4024)
    found = calibrate_boards(board, pairs, SIZES, models=("brown4",), folds=2)
    assert found.change is None or not found.change.what
    assert not any("the cameras changed about between" in weak for weak in found.weaknesses)


def test_cameras_of_known_intrinsics_that_were_knocked_are_named():
    board, (true, _), pairs = pairs_of(831, knocked)
    shots = [SeenShot(p.name, (p.left.ids, p.right.ids), (p.left.uv, p.right.uv)) for p in pairs[FROM - 6 : FROM + 6]]
    found = calibrate_bodies(board.body, shots, true.cameras, folds=2)
    assert found.change is not None
    assert abs(found.change.row - 6) <= 1
    assert "the relative pose of the cameras" in found.change.what


def test_pairs_of_exchanged_cameras_are_rejected_and_that_they_are_all_on_one_side_is_named():
    first = 14
    true, board, Ts = rig_and_board("brown4", count=COUNT, seed=52)
    pairs = board_pairs(true, board.body.points, Ts, seed=52)
    pairs[first:] = [Pair(p.name, p.right, p.left) for p in pairs[first:]]
    found = calibrate_boards(board, pairs, SIZES, models=("brown4",), folds=2)
    assert len(found.pairs) == max(first, COUNT - first)
    assert any("all on one side" in weak for weak in found.weaknesses)


def test_a_pair_all_of_whose_corners_are_gross_errors_is_rejected():
    true, board, Ts = rig_and_board("brown4", count=COUNT, seed=53)
    pairs = board_pairs(true, board.body.points, Ts, seed=53)
    mixed = [Pair(p.name, p.left, q.right) for p, q in zip(pairs, pairs[1:] + pairs[:1], strict=True)]
    found = calibrate_boards(board, pairs[:14] + mixed[14:], SIZES, models=("brown4",), folds=2)
    assert not {p.name for p in pairs[14:]} & set(found.pairs)


@pytest.mark.parametrize(("longer", "named"), [(1.01, True), (1.0, False)])
def test_a_print_that_is_longer_one_way_is_named(longer, named):
    true, board, Ts = rig_and_board("brown4", count=COUNT, seed=901)
    pairs = board_pairs(true, board.body.points * [longer, 1, 1], Ts, seed=1)
    found = calibrate_boards(board, pairs, SIZES, models=("brown4",), folds=2)
    assert any("% longer one way, at" in weak for weak in found.weaknesses) == named


@pytest.mark.parametrize(("moved_m", "off"), [(0.0, False), (3e-4, True)])
def test_corners_of_a_pair_that_are_off_together_widen_the_sigmas_and_white_noise_does_not(moved_m, off):
    # 0.3 mm between the exposures lowers no noise by a fifth, and makes the rig's errors five times its sigmas without.
    true, board, Ts = rig_and_board("brown4", count=COUNT, seed=823)
    way, later = moved_m * np.random.default_rng(823).normal(size=(COUNT, 3)), Ts.copy()
    later[:, :3, 3] += way
    first, then = (board_pairs(true, board.body.points, each, seed=823) for each in (Ts, later))
    pairs = [Pair(a.name, a.left, b.right) for a, b in zip(first, then, strict=True)]
    found = calibrate_boards(board, pairs, SIZES, models=("brown4",), folds=2)
    assert found.motion is None
    assert (found.spread > 2) == off
    assert any("off together" in weak for weak in found.weaknesses) == off
    error = rig_error(found.rig, true)
    nees = error @ np.linalg.solve(found.rig.cov, error)
    assert chi2.ppf(1e-4, len(error)) < nees < chi2.ppf(1 - 1e-4, len(error))
    assert not off or nees * found.spread**2 > 3 * chi2.ppf(1 - 1e-4, len(error))
