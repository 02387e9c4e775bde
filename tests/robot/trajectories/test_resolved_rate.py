"""The resolved-rate tracker: on the path where it is free, past singularities where exact motions are rejected."""

import numpy as np
import pytest
from arm_motions import shifted, start, within

from armsight.errors import InputError
from armsight.robot.models import MODELS
from armsight.robot.trajectories import MotionRejected, line, resolved_rate
from armsight.robot.trajectories.circle import ArcPath
from armsight.robot.trajectories.line import LinePath
from armsight.robot.trajectories.trajectory import check_times

SIX_R = MODELS["six_r"]


def through_the_wrist(rotation_deg):
    """A line of the tool of six_r on which axis 5 passes zero, where axis 6 is parallel to 2, 3 and 4."""
    a, b = (np.radians([10, -100, 100, -20, q5, 5]) for q5 in (-12, 12))
    b[0] += np.radians(rotation_deg)
    return a, LinePath.between(SIX_R.forward(a), SIX_R.forward(b))


@pytest.mark.parametrize("name", ["six_r", "ur5", "irb120"])
def test_the_tool_stays_on_the_path_away_from_singularities(name):
    arm, q = MODELS[name], start(name)
    T = arm.forward(q)
    motion = resolved_rate(arm, q, LinePath.between(T, shifted(T, [0.03, 0.05, -0.03], [0.1, 0.1, 0.0])))
    Ts = arm.forward(motion.at(check_times(motion.duration_s)).q)
    share = ((Ts[:, :3, 3] - T[:3, 3]) @ [0.03, 0.05, -0.03]) / (0.03**2 * 2 + 0.05**2)
    off = np.linalg.norm(Ts[:, :3, 3] - T[:3, 3] - share[:, None] * [0.03, 0.05, -0.03], axis=1).max()
    # Midpoint steps of 1 ms leave h^3 / 24 of the third derivative a step, which the feedback holds at 1/(GAIN h) steps.
    assert off < 1e-6
    assert motion.deviation_m < 1e-6
    assert motion.deviation_rad < 1e-5
    assert motion.least_singular > 0.04
    np.testing.assert_allclose(Ts[-1], shifted(T, [0.03, 0.05, -0.03], [0.1, 0.1, 0.0]), atol=1e-5)


@pytest.fixture(scope="module")
def passed():
    """The tracker past the wrist's singularity: where it started, the path, the motion."""
    q, path = through_the_wrist(2.0)
    return q, path, resolved_rate(SIX_R, q, path, duration_s=5.0, tolerance_m=0.02)


def test_a_singularity_at_which_the_exact_line_is_rejected_is_passed(passed):
    q, path, motion = passed
    goal = path.at(np.ones(1)).T_base_tool[0]
    with pytest.raises(MotionRejected, match="a singularity: joints 2, 3, 4 and 6"):
        line(SIX_R, q, goal)
    within(SIX_R, motion)
    assert motion.least_singular < 5e-3
    J = SIX_R.jacobian(motion.at(motion.least_singular_t_s).q)
    J[:3] /= np.hypot(SIX_R.a, SIX_R.d).sum()
    assert np.linalg.svd(J, compute_uv=False)[-1] == pytest.approx(motion.least_singular, abs=1e-6)
    np.testing.assert_allclose(SIX_R.forward(motion.at(motion.duration_s).q), goal, atol=1e-4)


def test_the_deviation_is_what_the_tool_shows(passed):
    q, path, motion = passed
    p = SIX_R.forward(motion.at(check_times(motion.duration_s)).q)[:, :3, 3]
    off = np.linalg.norm(p - path.T_base_start[:3, 3] - np.outer(_share(p, path), path.step), axis=1)
    # From the reference of the moment the tool can only be further than from the line as a whole.
    assert 1e-4 < off.max() <= motion.deviation_m + 1e-9
    with pytest.raises(MotionRejected, match=r"would leave the path, by .* 0.100 mm are allowed"):
        resolved_rate(SIX_R, q, path, duration_s=5.0, tolerance_m=1e-4)


def test_without_a_duration_it_is_slowed_down_until_the_limits_hold(passed):
    q, path, _ = passed
    motion = resolved_rate(SIX_R, q, path, tolerance_m=0.02)
    within(SIX_R, motion)
    assert motion.duration_s < 5.0


def test_its_end_does_not_slow_the_whole_down():
    arm, q = (
        MODELS["irb120"],
        np.radians([0, 0, 0, 0, 60, 0]),
    )  # passes near the wrist's singularity, where it settles slowly
    T = arm.forward(q)
    goal = shifted(T, [0.0, 0.0, -0.3])
    motion = resolved_rate(arm, q, LinePath.between(T, goal))
    within(arm, motion)
    assert motion.duration_s < 2 * line(arm, q, goal).duration_s


def _share(p, path):
    return (p - path.T_base_start[:3, 3]) @ path.step / (path.step @ path.step)


def test_a_goal_out_of_reach_is_rejected_with_the_position_where_it_leaves_the_path():
    q = np.radians([0, -60, 70, -10, -90, 0])
    T = SIX_R.forward(q)
    with pytest.raises(MotionRejected, match="near a singularity the tool would leave the path") as found:
        resolved_rate(SIX_R, q, LinePath.between(T, shifted(T, [0.4, 0.0, 0.0])), duration_s=4.0)
    with pytest.raises(MotionRejected, match="leaves the reach") as exact:
        line(SIX_R, q, shifted(T, [0.4, 0.0, 0.0]))
    assert abs(found.value.share - exact.value.share) < 0.05
    assert 0 < found.value.t_s < 4.0


def test_a_joint_limit_is_rejected():
    arm, q = MODELS["ur5"], start("ur5")
    q[5] += 2 * np.pi - 0.5
    T = arm.forward(q)
    with pytest.raises(MotionRejected, match=r"joint 6 at 360.\d+ deg is outside its limits"):
        resolved_rate(arm, q, LinePath.between(T, shifted(T, [0.02, 0.0, 0.0], [0, 0, -0.6])), duration_s=3.0)


def test_a_duration_is_kept_or_rejected_with_the_limit():
    arm, q = MODELS["ur5"], start("ur5")
    T = arm.forward(q)
    path = ArcPath(T, T[:3, 3] + [0.05, 0, 0], np.array([0, 0, 3.0]), np.zeros(3))
    motion = resolved_rate(arm, q, path, duration_s=4.0)
    assert 4.0 - 1e-9 <= motion.duration_s < 4.5  # and what it takes to settle
    within(arm, motion)
    with pytest.raises(MotionRejected, match=r"joint \d would need a jerk of .* deg/s\^3, its limit is"):
        resolved_rate(arm, q, path, duration_s=0.3)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"tolerance_m": 0.0}, "tolerance_m is 0.0"),
        ({"tolerance_m": np.nan}, "tolerance_m is nan"),
        ({"duration_s": 0.0}, "positive number of seconds"),
    ],
)
def test_bad_options_are_rejected(options, said):
    q, path = through_the_wrist(2.0)
    with pytest.raises(InputError, match=said):
        resolved_rate(SIX_R, q, path, **options)


@pytest.mark.parametrize(("name", "step"), [("ur5", [-0.18, 0.03, -0.05]), ("irb120", [0.01, -0.04, 0.03])])
def test_the_limits_hold_between_the_instants_of_the_check(name, step):
    arm, q = MODELS[name], start(name)
    T = arm.forward(q)
    motion = resolved_rate(arm, q, LinePath.between(T, shifted(T, step)))
    knots, qdd = motion.spline.x, motion.spline(motion.spline.x, 2)
    # Between the spline's instants the jerk is constant and the acceleration even: this is all there is.
    assert (np.abs(np.diff(qdd, axis=0)) <= np.diff(knots)[:, None] * arm.qddd_max * (1 + 1e-6)).all()
    assert (np.abs(qdd) <= arm.qdd_max * (1 + 1e-8)).all()


def test_the_tracker_takes_up_a_line_that_is_under_way():
    arm, q = MODELS["ur5"], start("ur5")
    T = arm.forward(q)
    first = line(arm, q, shifted(T, [0.0, 0.3, 0.0]), duration_s=1.5)
    now = first.at(0.3)
    path = LinePath.between(arm.forward(now.q), shifted(T, [0.0, 0.4, 0.0]))
    motion = resolved_rate(arm, now.q, path, qd_start=now.qd, qdd_start=now.qdd)
    within(arm, motion)
    begun = motion.at(0.0)
    np.testing.assert_allclose(begun.q, now.q, atol=1e-12)
    np.testing.assert_allclose(begun.qd, now.qd, atol=1e-12)
    np.testing.assert_allclose(begun.qdd, now.qdd, atol=2e-3 * arm.qddd_max.max())  # within what two steps may change
    assert motion.deviation_m < 1e-6
    for qd, qdd in ((now.qd + 0.01, now.qdd), (now.qd, now.qdd + 0.01), (-now.qd, now.qdd)):
        with pytest.raises(InputError, match="do not carry the tool along the path"):
            resolved_rate(arm, now.q, path, qd_start=qd, qdd_start=qdd)
    near = LinePath.between(arm.forward(now.q), arm.forward(first.at(0.31).q))
    with pytest.raises(InputError, match="cannot stop at the end of the path"):
        resolved_rate(arm, now.q, near, qd_start=now.qd, qdd_start=now.qdd)


def test_a_start_off_the_path_is_rejected():
    q, path = through_the_wrist(2.0)
    for T, said in (
        (shifted(path.T_base_start, [0.0, 0.03, 0.04]), "it is 50.000 mm and 0.000 deg away"),
        (shifted(path.T_base_start, [0.0, 0.0, 0.0], [0.0, 0.0, 0.1]), "it is 0.000 mm and 5.730 deg away"),
    ):
        off = LinePath.between(T, shifted(T, [0.0, 0.0, 0.01]))
        with pytest.raises(InputError, match=f"q_start does not put the tool at the start of the path: {said}"):
            resolved_rate(SIX_R, q, off)
