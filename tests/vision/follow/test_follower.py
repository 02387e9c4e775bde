"""Following: the same answers as searching, regained after a loss, jumps reported, and honest covariances."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from disc_painter import grey, light_of, pair_of

from armsight.data import Missed, PoseEstimate, Record, Shot
from armsight.errors import InputError
from armsight.geometry.pose import exp_se3, inverse, log_se3
from armsight.sim.example_rig import example_rig
from armsight.sim.workcell.body import body_target
from armsight.vision.follow.follower import Follower, follows
from armsight.vision.markers.targets import Composite
from armsight.vision.pose.measure import measure
from disc_views import PLATE, discs_of, hd_rig, someplace

RIG = hd_rig()
BODY, NINE = Composite(PLATE.body.name, (), PLATE), body_target()
TWIST = np.array([0.4, -0.2, 0.1, 0.5, -0.4, 0.8])


def shots(target, count, seed, hidden=None, start=None, rig=RIG):
    """A body that moves at constant twist, 60 shots a second."""
    rng = np.random.default_rng(seed)
    T = someplace(rng, z=(0.75, 0.85), tilt=0.4) if start is None else start
    for k in range(count):
        truth = T @ exp_se3(TWIST * k / 60)
        left, right = pair_of(rig, target, truth, rng, hidden=(hidden or {}).get(k, ()))
        yield truth, Shot(str(k), left, right, k / 60)


@cache
def seven():
    return tuple(shots(PLATE, 7, 7))


def test_following_gives_what_searching_gives():
    follower = Follower(RIG, BODY)
    ways, ratios, gaps = [], [], []
    for _, shot in shots(PLATE, 8, 0):
        result, slow = follower.measure(shot), measure(RIG, BODY, shot)
        ways.append(follower.way)
        assert isinstance(result, PoseEstimate)
        assert isinstance(slow, PoseEstimate)
        gaps.append(log_se3(inverse(slow.T_left_body) @ result.T_left_body) / np.sqrt(np.diag(slow.cov_noise)))
        ratios.append(np.sqrt(np.diag(result.cov) / np.diag(slow.cov)))
        assert np.allclose(result.points.p_left, slow.points.p_left, atol=1e-4)
        assert np.allclose(
            result.points.calibration, slow.points.calibration, atol=0.3 * np.abs(slow.points.calibration).max()
        )
        assert np.allclose(result.points.seen.uv, slow.points.seen.uv, atol=0.02)
    assert ways == ["searched"] + ["followed"] * 7
    # The same pixels but for the window's first guess, the same model: a small part of the noise apart, but where a
    # gradient is assumed in one way and not in the other.
    assert np.abs(gaps).max() < 1.5
    assert np.median(np.abs(gaps)) < 0.15
    # A centre whose gradient is assumed in one way and not in the other has another covariance; most have the same.
    assert np.abs(np.median(ratios, axis=0) - 1).max() < 0.1
    assert np.abs(np.log(ratios)).max() < np.log(3.0)


def test_large_discs_are_found_and_followed():
    rig, ways = example_rig(focal_px=1750.0, baseline_m=0.06), []
    five = discs_of([[-0.05, 0, 0], [0.05, 0.01, 0], [0, 0.07, 0], [-0.035, 0.04, 0.01], [0.04, 0.045, 0]])
    follower = Follower(rig, Composite(five.body.name, (), five))
    near = exp_se3(np.array([0.02, -0.025, 0.3, 0.1, -0.1, 0.0]))
    for truth, shot in shots(five, 3, 3, start=near, rig=rig):
        result = follower.measure(shot)
        ways.append(follower.way)
        assert isinstance(result, PoseEstimate), result.reason
        assert 1750.0 * five.radii_m.min() / truth[2, 3] > 45.0
        off = log_se3(inverse(truth) @ result.T_left_body)
        assert off @ np.linalg.solve(result.cov, off) < 25.0
    assert ways == ["searched", "followed", "followed"]


def test_lost_and_regained():
    hidden = {3: ((0, 0),), 4: ((0, 0), (0, 1)), 5: [(m, c) for m in range(3) for c in range(2)]}
    follower, ways = Follower(RIG, BODY), []
    for truth, shot in shots(PLATE, 9, 1, hidden):
        result = follower.measure(shot)
        ways.append(follower.way)
        if isinstance(result, PoseEstimate):
            assert np.linalg.norm(result.T_left_body[:3, 3] - truth[:3, 3]) < 2e-3
    assert ways[:6] == ["searched", "followed", "followed", "lost", "lost", "lost"]
    assert set(ways[6:]) <= {"searched", "followed"}


def test_one_of_four_discs_may_be_missing():
    four = discs_of([[-0.055, 0, 0], [0.055, 0, 0], [0, 0.085, 0], [0.03, 0.04, 0]], names=("A", "B", "C", "D"))
    follower = Follower(RIG, Composite("four", (), four))
    for k, (_, shot) in enumerate(shots(four, 5, 2, {3: ((1, 0),)})):
        result = follower.measure(shot)
        assert isinstance(result, PoseEstimate)
        assert follower.way == ("followed" if k else "searched")
        if k == 3:
            assert [d.point for d in result.dropped] == ["B"]
            assert result.dropped[0].reason.startswith("left: ")


@pytest.mark.parametrize(("rows", "mm"), [([1], 1.0), ([1], 3.0), ([0], 2.0), ([1, 4], 2.0)])
def test_a_body_of_which_discs_moved_is_followed_by_the_others(rows, mm):
    along = np.outer(np.isin(np.arange(len(NINE.discs.body.points)), rows), [0.6e-3 * mm, -0.8e-3 * mm, 0.0])
    moved = replace(NINE.discs, body=replace(NINE.discs.body, points=NINE.discs.body.points + along))
    follower, names = Follower(RIG, NINE), {NINE.discs.body.point_names[row] for row in rows}
    for k, (truth, shot) in enumerate(shots(moved, 6, 5)):
        result = follower.measure(shot)
        assert isinstance(result, PoseEstimate)
        assert follower.way == ("followed" if k else "searched")
        off = log_se3(inverse(truth) @ result.T_left_body)
        assert off @ np.linalg.solve(result.cov, off) < 25.0
        assert not set(rows) & set(result.points.ids)
        if k:  # a search may not even take them for discs of the body
            assert {each.point for each in result.dropped} == names
            assert all(each.contradicts for each in result.dropped)
            assert set(rows) <= set(result.points.seen.ids)  # for who looks at the body's shape


def test_a_body_of_which_more_than_half_moved_is_not_followed():
    rng = np.random.default_rng(6)
    points = NINE.discs.body.points
    bent = replace(NINE.discs, body=replace(NINE.discs.body, points=points + 3e-3 * rng.normal(size=points.shape)))
    follower = Follower(RIG, NINE)
    for _, shot in shots(NINE.discs, 3, 6):
        follower.measure(shot)
    for k, (_, shot) in enumerate(shots(bent, 6, 6)):
        if k > 3:
            follower.measure(shot)
            assert follower.way != "followed"


def test_a_jump_is_reported():
    follower = Follower(RIG, BODY)
    start = someplace(np.random.default_rng(3), z=(0.8, 0.8), tilt=0.2)
    for _, shot in shots(PLATE, 3, 3, start=start):
        follower.measure(shot)
        assert follower.jump is None
    away = start @ exp_se3(np.array([0.05, 0.04, 0.0, 0.0, 0.0, 1.5]))
    left, right = pair_of(RIG, PLATE, away, np.random.default_rng(4))
    result = follower.measure(Shot("away", left, right, 3 / 60))
    assert isinstance(result, PoseEstimate)
    assert follower.way == "searched"
    assert follower.jump is not None
    assert "jumped" in follower.jump


def test_shots_without_time_and_shots_without_images():
    follower = Follower(RIG, BODY)
    ways = []
    for k, (_, shot) in enumerate(shots(PLATE, 4, 5)):
        ways.append((follower.measure(Shot(shot.name, shot.left, shot.right)), follower.way)[1])
        if k == 1:
            assert isinstance(follower.measure(Shot("bad", None, None, problem="unplugged")), Missed)
            assert follower.way == "lost"
    assert ways == ["searched", "followed", "followed", "followed"]


@pytest.mark.parametrize(
    "times",
    [
        [0, 1, 2, np.nan, 4, 5, 6],
        [0, 1, 2, np.inf, 4, 5, 6],
        [0, 1, 2, -300, -299, -298, -297],
        [0, 1, 2, 600, 601, 602, 603],
        [0, 1, 1 + 1e-12, 3, 4, 5, 6],
        [0, 5e-324, 1e-323, 3, 4, 5, 6],
        [0, 0, 0, 0, 4, 5, 6],
    ],
)
def test_times_that_are_odd_make_no_jumps(times):
    """Times in shots: missing, standing still, going back, a pause of ten seconds."""
    follower = Follower(RIG, BODY)
    for (truth, shot), t in zip(seven(), times, strict=True):
        result = follower.measure(Shot(shot.name, shot.left, shot.right, t / 60))
        assert isinstance(result, PoseEstimate)
        assert follower.jump is None
        assert np.linalg.norm(result.T_left_body[:3, 3] - truth[:3, 3]) < 2e-3
    assert follower.way == "followed"


def arrays_of(record):
    """Copy all arrays of a record and of the records in it."""
    if isinstance(record, np.ndarray):
        return [record.copy()]
    if isinstance(record, tuple):
        return [array for part in record for array in arrays_of(part)]
    return [a for part in vars(record).values() for a in arrays_of(part)] if isinstance(record, Record) else []


def test_what_was_given_stays_as_it_was():
    """The follower works in the same arrays again and again; its records must not."""
    follower, given = Follower(RIG, BODY), []
    for _, shot in shots(PLATE, 6, 9, {4: ((2, 1),)}):
        result = follower.measure(shot)
        given.append((result, arrays_of(result)))
    assert sum(len(arrays) >= 10 for _, arrays in given) == 5
    for result, arrays in given:
        for before, after in zip(arrays, arrays_of(result), strict=True):
            np.testing.assert_array_equal(before, after)


def test_covariance_is_honest():
    """NEES of followed poses against truth, the rig exactly known, over fresh noise."""
    rig = hd_rig(known=True)
    rng, squares = np.random.default_rng(6), []
    for _ in range(4):
        T = someplace(rng, z=(0.7, 1.0), tilt=0.5)
        light = light_of(rig, PLATE, T)
        follower = Follower(rig, BODY)
        for k in range(25):
            result = follower.measure(Shot(str(k), *(grey(side, 2.0, rng) for side in light), k / 60))
            assert isinstance(result, PoseEstimate)
            xi = log_se3(inverse(result.T_left_body) @ T)
            squares.append(xi @ np.linalg.solve(result.cov, xi))
        assert follower.way == "followed"
    # Mean of 100 chi-squares of 6 degrees: 6 +- sqrt(12 / 100) = 0.35; its own search aside all are followed.
    assert abs(np.mean(squares) - 6) < 4 * 0.35


def test_what_can_be_followed():
    assert follows(BODY)
    assert not follows(Composite("two", (), discs_of([[0, 0, 0], [0.1, 0, 0]])))
    bent = discs_of([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]], normal=None)
    assert not follows(Composite("bent", (), bent))
    with pytest.raises(InputError, match="cannot be followed"):
        Follower(RIG, Composite("bent", (), bent))


def test_fast_motion_is_followed_once_two_searches_have_reported_its_velocity():
    fast = np.array(
        [1.6, -0.8, 0.3, 0.5, -0.4, 0.8]
    )  # 25 px and more a shot, past the plate's edge and its other discs
    rng = np.random.default_rng(11)
    start, follower, ways = someplace(rng, z=(0.9, 0.9), tilt=0.3), Follower(RIG, BODY), []
    for k in range(6):
        left, right = pair_of(RIG, PLATE, start @ exp_se3(fast * k / 60), rng)
        assert isinstance(follower.measure(Shot(str(k), left, right, k / 60)), PoseEstimate)
        ways.append(follower.way)
    assert ways[2:] == ["followed"] * 4


def test_where_it_is_expected_it_is_found_without_a_search_of_the_whole_image(monkeypatch):
    searches, follower = [], Follower(RIG, BODY)
    monkeypatch.setattr(
        "armsight.vision.follow.follower.measure", lambda *a: (searches.append(a[2].name), measure(*a))[1]
    )
    hidden = {k: [(m, c) for m in range(3) for c in range(2)] for k in range(2, 12)}
    off = exp_se3(np.array([0.01, -0.01, 0.01, 0.02, 0.0, 0.05]))  # some 15 px
    ways = []
    for truth, shot in shots(PLATE, 15, 6, hidden):
        result = follower.measure(shot, truth @ off)
        ways.append(follower.way)
        if isinstance(result, PoseEstimate):
            assert np.linalg.norm(result.T_left_body[:3, 3] - truth[:3, 3]) < 1e-3
        else:
            assert ("was searched shortly before" in result.reason) == (shot.name not in searches)
    assert ways == ["followed"] * 2 + ["lost"] * 10 + ["followed"] * 3
    assert searches == ["2", "10"]  # where it was lost, and once more in vain


def test_a_wrong_expectation_delays_a_search_and_no_more():
    hidden = {k: [(m, c) for m in range(3) for c in range(2)] for k in range(2, 6)}
    follower, wrong = Follower(RIG, BODY), exp_se3(np.array([0.3, 0.0, 0.0, 0.0, 0.0, 0.0]))
    ways = []
    for truth, shot in shots(PLATE, 12, 7, hidden):
        follower.measure(shot, truth @ wrong)
        ways.append(follower.way)
    assert ways[2:10] == ["lost"] * 8
    assert ways[10:] == ["searched", "followed"]
