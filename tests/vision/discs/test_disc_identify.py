"""Names of uncoded discs: right, or missed with the reason; never wrong."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from armsight.data import Discs, Missed, Rejected
from armsight.geometry.pose import inverse, log_se3, pose
from armsight.geometry.rotation import exp_so3
from armsight.vision.discs.identify import ERROR_ODDS, IdentifiedDiscs, identify
from disc_views import PLATE, discs_of, hd_rig, someplace, views

SIX = discs_of([[0, 0, 0], [0.06, 0, 0], [0.06, 0.05, 0], [-0.02, 0.07, 0], [0.03, -0.04, 0.02], [-0.05, 0.02, 0.03]])
SCALENE = discs_of([[-0.055, 0, 0], [0.055, 0, 0], [0.02, 0.085, 0]])


def wrong(result, owner, bodies=(0,)):
    """Detections that a result names wrongly."""
    return [
        (m, side)
        for side in (0, 1)
        for m, row in enumerate(result.rows[:, side])
        if row >= 0 and not (owner[side][row][0] in bodies and owner[side][row][1] == m)
    ]


def looked(target, seeds, *, clutter=0, bodies=1, rig=None, true=None, z=(0.6, 1.2), **options):
    """Identify a body in seeded views; yields seed, result, owners, and the poses."""
    rig = hd_rig() if rig is None else rig
    for seed in seeds:
        rng = np.random.default_rng([17, seed])
        Ts = [someplace(rng, z=z) for _ in range(bodies)]
        left, right, owner = views(rig if true is None else true(rng), target, Ts, rng, clutter=clutter, **options)
        yield seed, identify(rig, target, left, right), owner, Ts


def whole(owner, count):
    """Whether both cameras see every disc of body 0."""
    return all((o[:, 0] == 0).sum() == count for o in owner)


def test_no_pose_in_a_thousand_images_of_clutter():
    """The requirement: 0 accepted. Discs of the sizes the plate's would have, 200 in each image."""
    for _, result, _, _ in looked(PLATE, range(1000), clutter=200, bodies=0, radii=(5.0, 15.0)):
        assert isinstance(result, Missed)


@pytest.mark.parametrize(("target", "count", "least"), [(PLATE, 100, 0.95), (SIX, 40, 0.98)])
def test_none_is_wrong_and_few_are_missed_in_clutter(target, count, least):
    found = seen = 0
    for _, result, owner, _ in looked(target, range(count), clutter=200):
        if isinstance(result, IdentifiedDiscs):
            assert wrong(result, owner) == []
            assert result.log_odds >= np.log(ERROR_ODDS)
        if whole(owner, len(target.radii_m)):
            found, seen = found + isinstance(result, IdentifiedDiscs), seen + 1
    # A binomial share lies within three standard deviations of its mean.
    assert found / seen > least - 3 * np.sqrt(least * (1 - least) / seen)


def test_a_plain_view_is_always_named_whatever_the_calibration_is_off_by():
    """True rigs sampled from the calibration's covariance, which leaves 0.3 px and more between epipolar lines."""
    rig = hd_rig()
    root = np.linalg.cholesky(rig.cov)

    def true(rng):
        return rig.perturbed(root @ rng.normal(size=22))

    for _, result, owner, _ in looked(PLATE, range(100), rig=rig, true=true, clutter=10):
        assert isinstance(result, IdentifiedDiscs)
        assert wrong(result, owner) == []


def test_the_pose_is_within_its_covariance():
    """The covariance holds 0.1 px and 0.28 mm that are not there, so it must be too wide, and not by an order."""
    nees = []
    for _, result, _, (T,) in looked(PLATE, range(60)):
        e = log_se3(inverse(result.T_left_body) @ T)
        nees.append(e @ np.linalg.solve(result.cov, e))
    assert max(nees) < chi2.ppf(1 - 1e-4, 6)
    assert 0.05 < np.mean(nees) < 6


def test_one_missing_disc_of_more_than_three_is_no_loss():
    for seed, result, owner, _ in looked(SIX, range(30), clutter=30, hidden=[(0, 2, 0), (0, 2, 1), (0, 4, 1)]):
        assert isinstance(result, IdentifiedDiscs), seed
        assert wrong(result, owner) == []
        assert (result.rows[2] < 0).all()
        assert result.rows[4, 0] >= 0
        assert result.rows[4, 1] < 0


def test_a_body_of_three_needs_all_three():
    for _, result, _, _ in looked(PLATE, range(30), clutter=20, hidden=[(0, 1, 1)]):
        assert isinstance(result, Missed)


def test_two_of_a_kind_are_ambiguous_and_both_positions_are_reported():
    rig, rng = hd_rig(), np.random.default_rng(0)
    Ts = [pose(exp_so3(np.array([0.1, 0.2, a])), np.array([x, 0.0, 0.9])) for x, a in ((0.0, 0.3), (0.25, 2.0))]
    left, right, _ = views(rig, SIX, Ts, rng)
    result = identify(rig, SIX, left, right)
    assert isinstance(result, Missed)
    assert result.reason.startswith("ambiguous: plate may be at (")
    for position in ("(-0 ", "(0 "), ("(250 ",):
        assert any(text in result.reason for text in position)
    for target in (PLATE, SIX):
        for _, many, _, _ in looked(target, range(30), bodies=2, clutter=10):
            # Where one of them is partly out of view the other one is named.
            assert isinstance(many, Missed) or min(len(many.seen.ids), 6) == len(target.radii_m)


def test_another_body_is_not_confused_with_it():
    """A plate 5% larger, alone and beside the right one."""
    rig, larger = hd_rig(), discs_of(1.05 * PLATE.body.points)
    for seed in range(40):
        rng = np.random.default_rng(seed)
        Ts = [pose(someplace(rng)[:3, :3], np.array([x, 0.0, rng.uniform(0.7, 1.0)])) for x in (0.0, 0.25)]
        views_ = [views(rig, target, [T], rng) for target, T in ((PLATE, Ts[0]), (larger, Ts[1]))]
        left, right = (
            Discs(
                *(np.concatenate([getattr(v[s], name) for v in views_]) for name in ("uv", "cov_uv", "shape", "bright"))
            )
            for s in (0, 1)
        )
        assert isinstance(identify(rig, PLATE, views_[1][0], views_[1][1]), Missed)
        result = identify(rig, PLATE, left, right)
        assert isinstance(result, IdentifiedDiscs)
        assert wrong(result, views_[0][2]) == []  # its rows come first


def test_the_twin_of_an_isosceles_triangle_is_settled_by_the_faces():
    unturned = replace(PLATE, normals=np.full((3, 3), np.nan))
    for _, result, owner, _ in looked(PLATE, range(30)):
        assert isinstance(result, IdentifiedDiscs)
        assert wrong(result, owner) == []
    for _, result, _, _ in looked(unturned, range(10)):
        assert result.reason in (
            "ambiguous: the same discs may be P1 P2 P3 of plate, or P2 P1 P3",
            "ambiguous: the same discs may be P2 P1 P3 of plate, or P1 P2 P3",
        )
    for _, result, owner, _ in looked(discs_of(SCALENE.body.points, normal=None), range(30), clutter=20):
        assert isinstance(result, IdentifiedDiscs)
        assert wrong(result, owner) == []


def test_a_body_seen_from_behind_is_reported():
    # Discs painted through a plate, say: the right distances, the wrong side.
    backwards = replace(SCALENE, normals=-SCALENE.normals)
    rig, rng = hd_rig(), np.random.default_rng(3)
    left, right, _ = views(rig, SCALENE, [someplace(rng)], rng)
    assert "seen from behind" in identify(rig, backwards, left, right).reason


def test_nearly_isosceles_is_right_or_ambiguous():
    named = []
    for off in (0.5e-3, 1e-3, 2e-3, 4e-3):
        target = discs_of([[-0.055, 0, 0], [0.055, 0, 0], [off, 0.085, 0]], normal=None)
        results = [(result, owner) for _, result, owner, _ in looked(target, range(25))]
        assert all(wrong(result, owner) == [] for result, owner in results if isinstance(result, IdentifiedDiscs))
        named.append(sum(isinstance(result, IdentifiedDiscs) for result, _ in results))
    assert named[0] < 12 < 22 < named[-1]


def test_a_body_with_symmetry_and_a_wall_of_discs_are_ambiguous():
    square = discs_of([[0, 0, 0], [0.06, 0, 0], [0.06, 0.06, 0], [0, 0.06, 0]])
    for _, result, _, _ in looked(square, range(10)):
        assert result.reason.startswith("ambiguous: the same discs may be P")
    wall = discs_of([[0.03 * x - 0.15, 0.03 * y - 0.1, 0] for x in range(11) for y in range(8)])
    rig, rng = hd_rig(), np.random.default_rng(0)
    left, right, _ = views(rig, wall, [pose(exp_so3(np.array([0.1, 0.2, 0.3])), np.array([0.1, 0, 1.0]))], rng)
    corner = discs_of([[0, 0, 0], [0.06, 0, 0], [0.06, 0.03, 0]])
    result = identify(rig, corner, left, right)
    assert result.reason == (
        "ambiguous: 88 discs in the left and 88 discs in the right image show plate at more than 64 poses"
    )


def test_bodies_of_many_discs_are_named_all_around():
    """A ball of 16 discs of one size, of which a camera sees six to eight, from all sides."""
    k = np.arange(16) + 0.5
    z, rotation = 1 - k / 8, np.pi * (1 + np.sqrt(5)) * k
    out = np.column_stack([np.sqrt(1 - z**2) * np.cos(rotation), np.sqrt(1 - z**2) * np.sin(rotation), z])
    points = 0.06 * out + 0.004 * np.random.default_rng(0).normal(size=(16, 3))
    ball, rng, named = discs_of(points, radius=0.006, normal=out), np.random.default_rng(1), 0
    rig = hd_rig()
    for _ in range(15):
        R = exp_so3(rng.normal(size=3) * 2)
        left, right, owner = views(rig, ball, [pose(R, np.array([0.1, 0.0, rng.uniform(0.5, 0.8)]))], rng, clutter=10)
        result = identify(rig, ball, left, right)
        if isinstance(result, IdentifiedDiscs):
            assert wrong(result, owner) == []
            named += 1
    assert named >= 13


def test_radii_and_brightness_name_discs_that_distances_do_not():
    points = [[0, 0, 0], [0.06, 0, 0], [0.06, 0.06, 0], [0, 0.06, 0]]
    for target in (
        discs_of(points, radius=[0.012, 0.008, 0.008, 0.008]),
        discs_of(points, bright=[True, False, False, False]),
    ):
        for _, result, owner, _ in looked(target, range(20), clutter=20):
            assert isinstance(result, IdentifiedDiscs)
            assert wrong(result, owner) == []


def test_thousands_of_discs_are_a_miss_that_says_so():
    for target in (PLATE, SIX):
        for _, result, _, _ in looked(target, range(1), clutter=5000, radii=(5.0, 12.0)):
            assert isinstance(result, Missed)
            assert "500" in result.reason


def test_misses_count_what_was_found():
    rig, rng = hd_rig(), np.random.default_rng(0)
    left, right, _ = views(rig, PLATE, [someplace(rng)], rng)
    two = Discs(left.uv[:2], left.cov_uv[:2], left.shape[:2], left.bright[:2], (Rejected((3.0, 4.0), "glint"),))
    assert identify(rig, PLATE, two, right).reason == (
        "left: 2 discs found (1 other candidate rejected; the most likely: glint); right: 3 discs found; plate has 3"
    )
    nothing = Discs(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros((0, 3)), np.zeros(0, bool))
    assert identify(rig, PLATE, nothing, nothing).reason == "left: 0 discs found; right: 0 discs found; plate has 3"
    elsewhere = Discs(right.uv + np.array([0.0, 40.0]), right.cov_uv, right.shape, right.bright)
    assert "no three have its distances" in identify(rig, PLATE, left, elsewhere).reason


def test_a_disc_found_twice_is_one():
    rig, rng = hd_rig(), np.random.default_rng(0)
    left, right, owner = views(rig, PLATE, [someplace(rng)], rng)
    twice = Discs(
        np.vstack([left.uv, left.uv[:2] + 0.01]),
        *(np.concatenate([a, a[:2]]) for a in (left.cov_uv, left.shape, left.bright)),
    )
    result = identify(rig, PLATE, twice, right)
    assert isinstance(result, IdentifiedDiscs)
    assert wrong(result, owner) == []


@pytest.mark.parametrize("points", [[[0, 0, 0], [0.1, 0, 0]], [[0, 0, 0], [0.05, 0, 0], [0.1, 0, 0]]])
def test_a_body_that_fixes_no_pose_is_reported(points):
    rig, rng = hd_rig(), np.random.default_rng(0)
    left, right, _ = views(rig, PLATE, [someplace(rng)], rng)
    assert "do not determine a pose" in identify(rig, discs_of(points), left, right).reason


def test_a_wrong_radius_and_a_wrong_size_are_reported():
    rig, rng = hd_rig(known=True), np.random.default_rng(21)
    T = someplace(rng, z=(0.7, 0.8), tilt=0.3)
    left, right, _ = views(rig, PLATE, [T], rng)
    points = PLATE.body.points
    result = identify(rig, discs_of(points, radius=0.0105), left, right)
    assert isinstance(result, Missed)
    assert "radius of about 8.1 mm" in result.reason  # sizes are seen to 2%
    assert "10.5 mm" in result.reason
    result = identify(rig, discs_of(1.036 * points), left, right)
    assert isinstance(result, Missed)
    assert "0.965 times as far apart" in result.reason
