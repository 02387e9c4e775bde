"""Motions in joints: limits by finite differences, times by the closed form of a jerk-limited move."""

from dataclasses import replace

import numpy as np
import pytest
from arm_motions import within
from hypothesis import given
from hypothesis import strategies as st

from armsight.errors import InputError
from armsight.robot.models import MODELS
from armsight.robot.trajectories import MotionRejected, point_to_point
from armsight.robot.trajectories.trajectory import check_times

SIX_R = MODELS["six_r"]
EVEN = replace(SIX_R, q_min=np.full(6, -3.0), q_max=np.full(6, 3.0), qd_max=np.ones(6))


def shortest_s(way, speed, acceleration, jerk):
    """Return how long one jerk-limited move from rest to rest takes (Biagiotti and Melchiorri, 2008, section 3.4)."""
    ramp = min(acceleration / jerk, np.sqrt(speed / jerk))
    early = jerk * ramp < acceleration * (1 - 1e-12)  # the speed is reached before the acceleration is
    rise = 2 * ramp if early else speed / acceleration + ramp
    if way >= speed * rise:
        return way / speed + rise
    if way >= 2 * acceleration * (acceleration / jerk) ** 2:
        t = acceleration / jerk
        return t + np.sqrt(t**2 + 4 * way / acceleration)
    return 4 * (way / (2 * jerk)) ** (1 / 3)


@pytest.mark.parametrize("name", MODELS)
def test_a_motion_keeps_every_limit_and_arrives_at_rest(name):
    arm = MODELS[name]
    rng = np.random.default_rng(4)
    for _ in range(5):
        a, b = rng.uniform(arm.q_min, arm.q_max, (2, arm.joints))
        motion = point_to_point(arm, a, b)
        within(arm, motion)
        for t, q in ((0.0, a), (motion.duration_s, b), (-1.0, a), (motion.duration_s + 9.0, b)):
            at = motion.at(t)
            np.testing.assert_allclose(at.q, q, atol=1e-9)
            np.testing.assert_allclose([at.qd, at.qdd], 0, atol=1e-9)


def test_joints_move_in_proportion_from_rest():
    a, b = np.zeros(6), np.array([0.3, -0.5, 1.0, 0.2, -0.1, 0.0])
    motion = point_to_point(SIX_R, a, b)
    q = motion.at(check_times(motion.duration_s)).q
    np.testing.assert_allclose(q, q[:, [2]] * b, atol=1e-9)


@given(st.integers(0, 5), st.floats(1e-4, 5.9))
def test_the_slowest_joint_takes_the_time_of_the_closed_form(joint, way):
    a, b = np.full(6, -2.95), np.full(6, -2.95)
    b[joint] += way
    motion = point_to_point(EVEN, a, b)
    limits = EVEN.qd_max[joint], EVEN.qdd_max[joint], EVEN.qddd_max[joint]
    assert motion.duration_s == pytest.approx(shortest_s(way, *limits), abs=1e-8)


def test_a_duration_is_met_and_one_too_short_is_rejected():
    a, b = np.zeros(6), np.full(6, 0.4)
    fastest = point_to_point(SIX_R, a, b).duration_s
    slow = point_to_point(SIX_R, a, b, duration_s=3.0)
    assert slow.duration_s == pytest.approx(3.0, abs=1e-8)
    within(SIX_R, slow)
    with pytest.raises(InputError, match=f"allow {fastest:.6g} s"):
        point_to_point(SIX_R, a, b, duration_s=0.9 * fastest)
    for bad in (0.0, -1.0, np.nan):
        with pytest.raises(InputError, match="positive number of seconds"):
            point_to_point(SIX_R, a, b, duration_s=bad)


@given(st.integers(0, 2**32 - 1))
def test_a_moving_start_is_taken_over(seed):
    rng = np.random.default_rng(seed)
    a, b = rng.uniform(-1.0, 0.7, (2, 6))
    qd = 0.5 * SIX_R.qd_max * rng.uniform(-1, 1, 6)
    qdd = 0.3 * SIX_R.qdd_max * rng.uniform(-1, 1, 6)
    motion = point_to_point(SIX_R, a, b, qd_start=qd, qdd_start=qdd)
    for got, want in zip(motion.at(0.0), (a, qd, qdd), strict=True):
        np.testing.assert_allclose(got, want, atol=1e-9)
    np.testing.assert_allclose(motion.at(motion.duration_s).q, b, atol=1e-9)
    within(SIX_R, motion)


def test_a_motion_in_the_middle_of_another_goes_on_without_a_step():
    first = point_to_point(SIX_R, np.zeros(6), np.full(6, 0.5))
    now = first.at(0.3)
    second = point_to_point(SIX_R, now.q, np.full(6, -0.5), qd_start=now.qd, qdd_start=now.qdd)
    for before, after in zip(first.at(0.3), second.at(0.0), strict=True):
        np.testing.assert_allclose(before, after, atol=1e-9)


def test_a_start_that_cannot_reverse_before_a_limit_says_which_joint_and_when():
    q = np.zeros(6)
    q[1] = np.deg2rad(44.0)
    qd = np.zeros(6)
    qd[1] = np.deg2rad(60.0)
    with pytest.raises(
        MotionRejected, match=r"joint 2 at 45\.\d+ deg is outside its limits -180.000 to 45.000"
    ) as found:
        point_to_point(SIX_R, q, np.zeros(6), qd_start=qd)
    # One degree at 60 deg/s, while full jerk only begins to brake: 1/60 s and a little.
    assert 1 / 60 < found.value.t_s < 1.2 / 60
    at = q.copy()
    at[1] = np.deg2rad(45)
    np.testing.assert_allclose(found.value.p_base, SIX_R.forward(at)[:3, 3], atol=2e-3 * SIX_R.qd_max[1])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"q_start": np.zeros(5)}, r"q_start has shape \(5,\)"),
        ({"q_start": [0, 0, 0, 0, 0, np.nan]}, "q_start contains NaN"),
        ({"q_start": ["a"] * 6}, "q_start must be numbers"),
        ({"q_goal": [0, 90, 0, 0, 0, 0]}, "degrees"),
        ({"q_goal": np.full(6, 2.9)}, "q_goal: joint 2 at 166.158 deg is outside its limits"),
        ({"qd_start": [9, 0, 0, 0, 0, 0]}, "qd_start: joint 1 has 515.662 deg/s, its limit is 90.000"),
        ({"qdd_start": [0, 0, 99, 0, 0, 0]}, r"qdd_start: joint 3 has .* deg/s\^2, its limit is 480"),
        (
            {"qd_start": [1.5, 0, 0, 0, 0, 0], "qdd_start": [6, 0, 0, 0, 0, 0]},
            "qd_start with what qdd_start adds to it: joint 1",
        ),
    ],
)
def test_bad_states_are_rejected_in_one_line(change, said):
    given_ = {"q_start": np.zeros(6), "q_goal": np.full(6, 0.1), **change}
    with pytest.raises(InputError, match=said) as found:
        point_to_point(SIX_R, **given_)
    assert "\n" not in str(found.value)


def test_a_time_that_is_no_number_is_rejected():
    motion = point_to_point(SIX_R, np.zeros(6), np.full(6, 0.1))
    with pytest.raises(InputError, match="t_s is nan"):
        motion.at(np.nan)


def test_nothing_to_do_takes_no_time():
    motion = point_to_point(SIX_R, np.zeros(6), np.zeros(6))
    assert motion.duration_s == 0
    assert (motion.at(0.0).q == 0).all()
