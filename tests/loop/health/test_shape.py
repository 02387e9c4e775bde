"""Points that moved on the body and focal lengths that changed: named and sized, and what does not last is not named."""

from dataclasses import replace

import faults
import numpy as np
import pytest
from faults import BODY, RATE_HZ, SIGMA_PX, SIGMAS, SYNC_S, TRUE, measured, watched_body

from armsight.geometry.pose import inverse, log_se3, pose
from armsight.geometry.rotation import exp_so3
from armsight.loop.health import HealthMonitor
from armsight.loop.health.residuals import History, Onset, ResidualSums
from armsight.loop.health.rig import RigWatch
from armsight.vision.pose.locate import locate
from armsight.vision.triangulate import triangulate
from views import both_pixels

DISC = 2


def watched(seed, *, shift=None, image_px=None, true=TRUE, printed=False, seconds=4.0, rests_s=np.inf):
    """Watch a moving body as vision gates it.

    Args:
        shift: (N, 3) displacement of its points, m.
        image_px: what of a time, s, displaces the disc in both images, px.
        true: the cameras as they are.
        rests_s: from when on it rests.

    Returns:
        The findings, and in which share of the shots the disc was left out.
    """
    rng = np.random.default_rng(seed)
    given = TRUE.perturbed(SIGMAS * rng.normal(size=len(SIGMAS)))
    given = replace(given, cov=np.diag(SIGMAS**2), sigma_px=0.0)
    points = BODY.points + 2e-5 * rng.normal(size=BODY.points.shape) + (0.0 if shift is None else shift)
    monitor, dropped = HealthMonitor(given, BODY, SYNC_S, printed=printed), []
    rates, phases = rng.uniform(0.1, 0.2, 6), rng.uniform(0, 2 * np.pi, 6)
    for k in range(round(seconds * RATE_HZ)):
        u = np.sin(2 * np.pi * rates * min(k / RATE_HZ, rests_s) + phases)
        T = pose(exp_so3(0.3 * u[3:]), np.array([0.1, 0.0, 0.9]) + np.array([0.12, 0.08, 0.12]) * u[:3])
        uv = both_pixels(true, points @ T[:3, :3].T + T[:3, 3]) + SIGMA_PX * rng.normal(size=(len(points), 2, 2))
        if image_px is not None:
            uv[DISC] += image_px(k / RATE_HZ)
        estimate = locate(given, BODY, triangulate(given, BODY, measured(given, BODY, T, uv).points.seen))
        dropped.append(DISC not in estimate.points.ids)
        monitor.measured(estimate, k / RATE_HZ)
    return monitor.findings(), np.mean(dropped)


def displaced(mm, disc=DISC):
    """A displacement of a disc along x."""
    shift = np.zeros(BODY.points.shape)
    shift[disc, 0] = 1e-3 * mm
    return shift


def test_a_disc_that_moved_is_named_and_sized_though_poses_are_measured_without_it():
    (found,), dropped = watched(51, shift=displaced(1.0))
    assert dropped > 0.9
    assert (found.cause, found.unit) == ("body", "mm")
    assert found.what.startswith(f"{BODY.point_names[DISC]} is displaced")
    assert abs(found.size - 1.0) < 3 * found.sigma < 0.25


def test_the_same_disc_on_a_print_whose_shape_was_calibrated_is_not_named():
    assert watched(51, shift=displaced(1.0), printed=True)[0] == ()


def nees(shots, from_s, to_s=np.inf):
    """Mean squared errors over the covariance, 6 degrees of freedom, of poses as measured and as given out."""
    squares = []
    for _, t_s, T, measured_pose, given in shots:
        if from_s < t_s < to_s:
            off = log_se3(inverse(T) @ given.T_left_body)
            squares.append([off @ np.linalg.solve(each.cov, off) for each in (measured_pose, given)])
    return np.mean(squares, axis=0)


def test_the_covariance_covers_a_disc_that_moved_before_it_is_named():
    """All discs are used for the poses; the first whole test after the move ends 2 s after it at the latest."""
    shots = []
    for monitor, t_s, T, measured_pose, given in watched_body(55, shift=displaced(1.0), at_s=5.0, seconds=7.3):
        shots.append((monitor, t_s, T, measured_pose, given))
        assert given is measured_pose or t_s >= 5.0
        assert monitor._rig._shape.found is None
    before, after = nees(shots, 7.0)
    assert before > 30.0
    assert after < 12.0


def test_a_disc_that_moves_by_a_few_tolerances_is_named_by_what_the_body_was_before_however_long_ago():
    """By 0.3 mm, where a point may be off by 0.05 mm: alone, the shots after it do not show it.

    After half a minute the tests of before are no longer among the newest thirty.
    """
    shots = list(watched_body(5501, shift=displaced(0.3, 1), at_s=5.0, seconds=45.0))
    (found,) = shots[-1][0].findings()
    assert (found.cause, found.unit) == ("body", "mm")
    assert found.what.startswith(f"{BODY.point_names[1]} is displaced")
    assert abs(found.size - 0.3) < 3 * found.sigma < 0.15
    assert abs(found.since_s - 5.0) < 1.5
    for span in ((7.0, 10.0), (38.0, 45.0)):
        measured, given = nees(shots, *span)
        assert measured > 20.0
        assert given < 10.0


def test_a_bent_body_is_named_with_several_points():
    (found,), _ = watched(52, shift=5e-4 * np.outer(np.arange(len(BODY.points)) % 2, [0, 0, 1]), seconds=6.0)
    assert found.cause == "body"
    assert "bent" in found.what


@pytest.mark.parametrize(
    "image_px",
    [
        lambda t: np.array([2.0, 0.0]) if t % 1.0 < 0.2 else np.zeros(2),  # a reflection now and then
        lambda t: 3.0 * np.array([np.cos(3 * t), 0.0]),  # another light that passes by
        lambda t: np.array([[0.0, 3.0], [0.0, -3.0]]),  # the cameras see two different things
    ],
)
def test_what_does_not_stay_on_the_body_is_not_named(image_px):
    assert watched(53, image_px=image_px)[0] == ()


def test_a_reflection_on_a_body_that_rests_after_some_motion_is_not_named():
    """All tests together are of several poses, but the shots that show the reflection are of one."""
    reflected, _ = watched(57, image_px=lambda t: np.array([0.7, 0.0]) * (t > 0.9), seconds=9.0, rests_s=1.5)
    assert reflected == ()


def test_the_focal_length_of_one_camera_is_distinguished_from_its_rotation():
    k = np.array(TRUE.left.intrinsics)
    k[:2] *= 1.001
    (found,), _ = watched(54, true=replace(TRUE, left=replace(TRUE.left, intrinsics=k)), seconds=10.0)
    assert (found.cause, found.alternatives, found.unit) == ("lens", ("rig",), "%")
    assert "left camera" in found.what
    assert abs(found.size - 0.1) < 4 * found.sigma


def test_focal_lengths_that_grew_alike_widen_the_poses(monkeypatch):
    """They compress depth, by 4 mm at 0.9 m, and nothing else: no other hypothesis explains what they leave."""
    longer = [replace(each, intrinsics=np.array(each.intrinsics) * [1.005, 1.005, 1, 1]) for each in TRUE.cameras]
    longer_both, squares = replace(TRUE, left=longer[0], right=longer[1]), []
    monkeypatch.setattr(faults, "both_pixels", lambda true, p: both_pixels(TRUE if true is TRUE else longer_both, p))
    for _, t_s, T, _, given in watched_body(7803, rotated=np.zeros(3), at_s=4.0, seconds=10.0):
        if t_s > 6.0:
            off = log_se3(inverse(given.T_left_body) @ T)
            squares.append(off @ np.linalg.solve(given.cov, off))
    assert np.mean(squares) < 20.0


def test_points_that_do_not_fit_change_nothing_of_the_other_tests():
    rig = replace(TRUE, cov=np.diag(SIGMAS**2), sigma_px=0.0)
    T = pose(exp_so3(np.array([0.1, 0.2, 0.0])), np.array([0.1, 0.0, 0.9]))
    uv = both_pixels(TRUE, BODY.points @ T[:3, :3].T + T[:3, 3])
    uv[DISC] += [2.0, 0.0]
    estimate = locate(rig, BODY, triangulate(rig, BODY, measured(rig, BODY, T, uv).points.seen))
    assert DISC not in estimate.points.ids
    watch = RigWatch(rig, BODY, SYNC_S)
    found = watch.reader.read(estimate, 0.0)
    column = 1 + rig.parameter_count + 1 + 3 * DISC
    assert not found.rows[:, column : column + 3].any()
    assert found.every[:, column : column + 3].any()


def test_a_focal_length_that_drifts_is_said_to_go_on_and_poses_are_widened():
    """The newest NEES is that of a change as large as it is now: 27 where a step since its beginning is taken."""
    *run, (monitor, *_) = watched_body(71, focal=lambda t: (1e-3 * t / 15.0, 0.0), at_s=5.0, seconds=20.0)
    (found,) = monitor.findings()
    assert (found.cause, found.unit) == ("lens", "%")
    assert "goes on" in found.what
    assert found.size == pytest.approx(0.1, abs=3.0 * found.sigma)
    offs = [(log_se3(inverse(given.T_left_body) @ T), given.cov) for _, _, T, _, given in run[-150:]]
    assert np.mean([off @ np.linalg.solve(cov, off) for off, cov in offs]) < 12.0


@pytest.mark.parametrize(("begin", "end"), [(1, 1), (1, 3), (2, 6), (5, 6)])
def test_sums_of_what_grows_are_those_of_its_own_columns(begin, end):
    """Of rows whose last columns are multiplied by the share of a test's time, added up one by one.

    The test before the beginning is left out, and those before it say of the first columns what they did.
    """
    rng = np.random.default_rng(8)
    rows, begins_s = rng.normal(size=(7, 9, 6)), np.array([2.0, 3.0, 4.5, 5.0, 7.0, 8.5, 9.0])
    tests, slow = History(3, 5), np.zeros((6, 6))
    since = np.clip((begins_s - begins_s[begin]) / max(begins_s[end] - begins_s[begin], 1e-9), 0.0, 1.0)
    shares = np.where(begins_s >= begins_s[end], 1.0, since)
    for k, (each, begin_s) in enumerate(zip(rows, begins_s, strict=True)):
        tests.keep(ResidualSums(each.T @ each, 9.0, begin_s), np.inf)
        scaled = each * np.append(np.ones(4), np.full(2, shares[k]))
        slow += (k != begin - 1) * scaled.T @ scaled
    found = tests.since(Onset(begins_s[begin], begins_s[end]))
    np.testing.assert_allclose(found.M, slow, rtol=1e-9, atol=1e-9)
    assert found.freedom == 9.0 * 6
    if end == 6:
        np.testing.assert_array_equal(tests.since(Onset(begins_s[begin])).M, found.M)


def test_what_is_no_longer_kept_says_of_the_parameters_what_it_did():
    """Tests of before a change settle, with less weight the older they are, until it began; those after it do not."""
    rng, tests, kept = np.random.default_rng(9), History(3, 5), np.zeros((4, 4))
    for k in range(45):
        rows = rng.normal(size=(9, 6))
        sums = ResidualSums(rows.T @ rows, 9.0, float(k))
        tests.keep(sums, 12.0)
        if k < 11:  # the eleventh may be of both times
            kept = np.exp(-1.0 / 30.0) * kept + sums.M[:4, :4]
    found = tests.since(Onset(12.0, 12.0))
    after = sum(each.M for each in tests.kept)
    np.testing.assert_allclose(found.M[:4, :4] - after[:4, :4], kept, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.M[4:], after[4:])


def test_a_focal_length_that_grew_and_stands_still_is_as_large_as_it_is():
    (found,) = faults.ended(71, focal=lambda t: (min(t, 10.0) * 1e-4, 0.0), at_s=5.0, seconds=22.0)
    assert (found.cause, found.unit) == ("lens", "%")
    assert "goes on" not in found.what
    assert found.size == pytest.approx(0.1, abs=3.0 * found.sigma)
    assert found.sigma < 0.02
