from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from armsight.data import Detections
from armsight.errors import CalibrationError
from armsight.geometry.pose import transform
from armsight.geometry.rigid import fit_rigid, fit_scale
from armsight.vision.calibrate import MODELS
from armsight.vision.calibrate.boards import LEAST_PAIRS, Pair, calibrate_boards
from armsight.vision.match import renamed
from board_views import SIZES, board_pairs, detections, rig_and_board, rig_error


@pytest.mark.parametrize("flat", [True, False], ids=["drawing", "estimated board"])
def test_the_true_rig_is_found_within_its_covariance(flat):
    true, board, Ts = rig_and_board()
    c = calibrate_boards(board, board_pairs(true, board.body.points, Ts), SIZES, models=("brown5",), flat=flat, folds=4)
    error = rig_error(c.rig, true)
    assert (np.abs(error) < 4 * np.sqrt(np.diag(c.rig.cov))).all(), error / np.sqrt(np.diag(c.rig.cov))
    scale = 1 / np.sqrt(np.diag(c.rig.cov))
    correlation, e = c.rig.cov * np.outer(scale, scale), error * scale
    assert e @ np.linalg.solve(correlation, e) < chi2.ppf(0.9999, len(e))
    # 20 pairs of 54 corners of both cameras determine the noise to sqrt(1 / (2 * 4320)), 1.1%; four times that, and what
    # the held-out pairs say of it (a fifth as many, so twice as vague), is allowed.
    assert c.rig.sigma_px == pytest.approx(0.1, rel=0.12)
    assert c.reprojection_rms_px == pytest.approx(0.1 * np.sqrt(2), rel=0.06)
    assert 0.9 < c.held_out.normalised_rms < 1.1
    assert c.pairs == tuple(f"p{n:02d}" for n in range(len(Ts)))
    assert not c.rejected
    assert (c.deviation_m < 1e-15) == flat


def test_a_perfect_board_stays_perfect():
    true, board, Ts = rig_and_board()
    c = calibrate_boards(board, board_pairs(true, board.body.points, Ts), SIZES, models=("brown5",), folds=2)
    # One corner is triangulated from twenty pairs to 0.1 px * 0.6 m / 450 px / sqrt(40) = 0.02 mm at best.
    assert c.deviation_m < 2e-5


def bowed(points):
    """Return the board scaled by 0.2% along its rows and bowed by half a millimetre."""
    xy = points[:, :2] - points[:, :2].mean(axis=0)
    r2 = (xy**2).sum(axis=1) / (xy**2).sum(axis=1).max()
    return points + np.column_stack([0.002 * xy[:, 0], np.zeros(len(points)), 5e-4 * (1 - r2)])


def test_a_bowed_board_is_found_and_taken_out_of_the_cameras():
    true, board, Ts = rig_and_board()
    nominal = board.body.points
    printed = bowed(nominal)
    pairs = board_pairs(true, printed, Ts, sigma=0.01)
    flat, shaped = (
        calibrate_boards(board, pairs, SIZES, models=("brown5",), flat=flat, folds=2) for flat in (True, False)
    )
    assert shaped.held_out.epipolar_rms_px < 0.8 * flat.held_out.epipolar_rms_px
    assert np.linalg.norm(rig_error(shaped.rig, true)[:4]) < 0.3 * np.linalg.norm(rig_error(flat.rig, true)[:4])
    # Size cannot be distinguished from the distance of the cameras: shapes are compared at the same size.
    size = fit_scale(printed, shaped.body.points)
    found = shaped.body.points / size
    gap = np.linalg.norm(transform(fit_rigid(found, printed), found) - printed, axis=1)
    whole = np.linalg.norm(transform(fit_rigid(nominal, printed), nominal) - printed, axis=1)
    assert np.sqrt((gap**2).mean()) < 0.15 * np.sqrt((whole**2).mean())
    assert shaped.deviation_m == pytest.approx(np.sqrt((whole**2).mean()), rel=0.3)


def test_images_of_one_camera_alone_may_show_another_print_of_the_board():
    true, board, Ts = rig_and_board()
    nominal, nothing = board.body.points, Detections.none("the other camera")
    pairs, alone = board_pairs(true, nominal, Ts[:8], sigma=0.01), board_pairs(true, bowed(nominal), Ts[8:], sigma=0.01)
    singles = [replace(pair, name=f"left {pair.name}", right=nothing) for pair in alone]
    singles += [replace(pair, name=f"right {pair.name}", left=nothing) for pair in alone]
    c = calibrate_boards(board, pairs, SIZES, models=("brown5",), folds=2, singles=singles)
    assert not c.rejected
    # One shape for both prints would leave the bow of half a millimetre, 0.2 px, in the residuals, and half of it here.
    assert c.rig.sigma_px == pytest.approx(0.01, rel=0.3)
    assert c.body.points.shape == nominal.shape
    assert c.deviation_m < 3e-5
    error = rig_error(c.rig, true)
    assert (np.abs(error) < 4 * np.sqrt(np.diag(c.rig.cov))).all(), error / np.sqrt(np.diag(c.rig.cov))


@pytest.mark.parametrize(
    ("model", "focal_px", "tried"), [("fisheye", 230.0, ("brown5", "fisheye")), ("brown4", 450.0, MODELS)]
)
def test_the_model_is_chosen_on_held_out_error(model, focal_px, tried):
    true, board, Ts = rig_and_board(model, focal_px, 14)
    c = calibrate_boards(board, board_pairs(true, board.body.points, Ts, sigma=0.05), SIZES, models=tried, folds=2)
    assert c.rig.left.model == c.rig.right.model == model
    assert set(c.models) == {tried[0], model}  # others cannot be worth it: their first step promises too little
    assert c.held_out == c.models[model]
    error = rig_error(c.rig, true)
    assert (np.abs(error) < 4.5 * np.sqrt(np.diag(c.rig.cov))).all()


def test_gross_corners_and_a_wrong_pair_are_named_and_cost_nothing():
    true, board, Ts = rig_and_board()
    clean = board_pairs(true, board.body.points, Ts)
    dirty = list(clean)
    for n, corner in ((2, 7), (5, 20), (11, 50)):
        uv = np.array(clean[n].right.uv)
        uv[corner] += (9.0, -6.0)
        dirty[n] = replace(clean[n], right=detections(clean[n].right.ids, uv))
    rng = np.random.default_rng(1)
    dirty[8] = replace(clean[8], left=detections(clean[8].left.ids, rng.permutation(clean[8].left.uv)))
    without = [pair for n, pair in enumerate(clean) if n != 8]
    c, best = (calibrate_boards(board, pairs, SIZES, models=("brown5",), folds=3) for pairs in (dirty, without))
    assert [r.pair for r in c.rejected] == ["p08"]
    assert "wrong corners" in c.rejected[0].reason
    assert [note.split(":")[0] for note in c.notes] == ["p02", "p05", "p11"]
    assert all("1 of 108 points of both images dropped" in note for note in c.notes)
    # The pairs' positions in the folds shift by one, so held-out metrics differ a little whatever is done.
    assert c.held_out.epipolar_rms_px == pytest.approx(best.held_out.epipolar_rms_px, rel=0.03)
    assert c.held_out.rigid_rms_m == pytest.approx(best.held_out.rigid_rms_m, rel=0.03)
    assert c.rig.left.intrinsics == pytest.approx(best.rig.left.intrinsics, abs=0.1)


@pytest.fixture(scope="module")
def symmetric():
    """A board of odd counts, which can be read from both ends, the pairs that show it, and their calibration."""
    true, board, Ts = rig_and_board(spec="chessboard:9x7:25mm")
    assert board.symmetries
    clean = board_pairs(true, board.body.points, Ts)
    return board, clean, calibrate_boards(board, clean, SIZES, models=("brown5",), folds=2, flat=True).rig


@pytest.mark.parametrize(("numbers", "upside_down"), [((3, 9), False), ((2, 7), True)])
def test_reversed_corners_of_a_symmetric_board_are_mended_by_name(symmetric, numbers, upside_down):
    """Right images of some pairs name the other end, or those of all others: the camera is upside down."""
    board, clean, best = symmetric
    dirty = [
        replace(pair, right=renamed(pair.right, board.symmetries[0])) if (n in numbers) != upside_down else pair
        for n, pair in enumerate(clean)
    ]
    c = calibrate_boards(board, dirty, SIZES, models=("brown5",), folds=2, flat=True)
    if upside_down:
        assert any(f"{len(clean) - 2} right images name" in note for note in c.notes)
    else:
        assert [note.split(":")[0] for note in c.notes] == ["p03", "p09"]
        assert all("corrected" in note for note in c.notes)
        assert not c.rejected
    # The same observations: the two differ by where the iterations stop.
    assert (np.abs(rig_error(c.rig, best)) < 0.01 * np.sqrt(np.diag(best.cov))).all()


def test_frames_that_repeat_are_no_further_pairs():
    true, board, Ts = rig_and_board()
    pairs = board_pairs(true, board.body.points, Ts)
    pairs[3] = replace(pairs[3], right=pairs[2].right)
    pairs[5] = replace(pairs[4], name="p05")
    c = calibrate_boards(board, pairs, SIZES, models=("brown5",), folds=2, flat=True)
    assert {r.pair: r.reason for r in c.rejected} == {
        "p03": "the right image is that of p02: a frame that repeats is of another moment than its pair",
        "p05": "both images are those of p04: a frame that repeats shows nothing new",
    }
    with pytest.raises(CalibrationError, match=r"1 of 8 pairs are usable.*p1: both images are those of p0: a frame"):
        calibrate_boards(board, [replace(pairs[0], name=f"p{n}") for n in range(8)], SIZES)


def test_pairs_without_a_board_are_rejected_with_their_reason():
    true, board, Ts = rig_and_board()
    pairs = board_pairs(true, board.body.points, Ts)
    pairs[1] = replace(pairs[1], left=Detections.none("too dark"))
    few = detections(np.arange(5), pairs[4].right.uv[:5])
    pairs[4] = replace(pairs[4], right=few)
    c = calibrate_boards(board, pairs, SIZES, models=("brown5",), folds=2, flat=True)
    assert {r.pair: r.reason for r in c.rejected} == {
        "p01": "left: too dark",
        "p04": "5 points seen by both cameras, 6 are needed",
    }
    assert c.pairs_found == len(pairs)
    assert len(c.pairs) == len(pairs) - 2


def test_too_few_pairs_say_how_many_are_needed_and_why_there_are_not():
    true, board, Ts = rig_and_board()
    pairs = board_pairs(true, board.body.points, Ts[: LEAST_PAIRS - 1])
    pairs += [Pair("dark", Detections.none("too dark"), Detections.none("too dark"))]
    with pytest.raises(CalibrationError, match=r"2 of 3 pairs are usable, at least 3 are needed.*dark: left: too dark"):
        calibrate_boards(board, pairs, SIZES)


def test_corners_in_random_positions_are_no_calibration():
    _, board, Ts = rig_and_board()
    rng = np.random.default_rng(0)
    ids = np.arange(54)
    pairs = [Pair(f"p{n}", *(detections(ids, rng.uniform(0, 360, (54, 2))) for _ in "lr")) for n in range(len(Ts) // 2)]
    with pytest.raises(CalibrationError):
        calibrate_boards(board, pairs, SIZES, models=("brown4",))
