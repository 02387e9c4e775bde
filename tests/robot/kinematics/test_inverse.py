"""Joint angles of poses: laws over every model and odd arm, singular and unreachable poses, order and limits."""

import dataclasses

import arms
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armsight.geometry.pose import exp_se3, pose
from armsight.robot.kinematics.structure import NEITHER, PARALLEL, SPHERICAL
from armsight.robot.kinematics.table import KIND
from armsight.robot.models import MODELS
from strategies import vectors

exact = pytest.mark.parametrize("arm", arms.EXACT, ids=arms.names(arms.EXACT))
UR5, PUMA, IRB, SIX = (MODELS[name] for name in ("ur5", "puma560", "irb120", "six_r"))


def check(arm, T, answer):
    """What every answer must be, whatever the pose."""
    assert np.isfinite(answer.rows).all()
    for k, q in enumerate(answer.q):
        far, rotation = arms.off(arms.forward(arm, q), T)
        assert far < 1e-9
        assert rotation < 1e-9
        assert abs(answer.residual_m[k] - far) < 1e-14
        assert abs(answer.residual_rad[k] - rotation) < 3e-8  # the chord's own rounding
        assert answer.within_limits[k] == arm.within_limits(q)
        for other in answer.q[:k]:
            assert arms.apart(q, other) > 1e-7
    assert (np.diff(answer.within_limits.astype(int)) <= 0).all()
    assert (answer.nearest is None) == answer.within_limits[:1].any()
    assert (answer.reason is None) == (answer.within_limits[:1].any() and not answer.singular.any())


@pytest.mark.parametrize(
    ("arm", "kind"),
    [
        *((arm, PARALLEL) for arm in (SIX, UR5, arms.TO_AND_FRO)),
        *((arm, SPHERICAL) for arm in (PUMA, IRB, arms.CRAIG)),
        *((arm, NEITHER) for arm in (arms.GENERAL, *arms.IDENTIFIED)),
    ],
)
def test_structure_is_read_off_the_table(arm, kind):
    assert arm.table[KIND] == kind


@exact
def test_every_solution_brings_the_tool_there_and_the_known_one_is_found(arm):
    for q in np.random.default_rng(7).uniform(-np.pi, np.pi, (50, 6)):
        T = arms.forward(arm, q)
        answer = arm.inverse(T)
        check(arm, T, answer)
        # Both halves of the way there round in the 16th digit; a Jacobian this bad is not sampled in 50.
        assert arms.apart(answer.q, q).min() < 1e-8
        assert (answer.residual_m < 1e-12).all()
        assert (answer.residual_rad < 1e-12).all()


@given(st.sampled_from(arms.EXACT), vectors(-np.pi, np.pi, 6), st.integers(0, 63))
def test_any_angles_come_back_even_with_joints_at_nothing_or_half_a_revolution(arm, q, which):
    flags = np.array([which >> i & 1 for i in range(6)], dtype=bool)
    q = np.where(flags, np.round(q / np.pi) * np.pi, q)
    T = arms.forward(arm, q)
    answer = arm.inverse(T)
    assert len(answer)
    check(arm, T, answer)


@given(st.sampled_from(arms.EXACT), vectors(-1.5, 1.5, 3), vectors(-3, 3, 3))
def test_any_pose_is_answered(arm, p, phi):
    T = exp_se3(np.concatenate([p, phi]))
    check(arm, T, arm.inverse(T))


@pytest.mark.parametrize("arm", [*arms.CLOSED.values()], ids=[*arms.CLOSED])
def test_configurations_are_all_different_and_right(arm):
    for q in np.random.default_rng(8).uniform(-np.pi, np.pi, (50, 6)):
        answer = arm.inverse(arm.forward(q))
        reported = answer.configurations
        assert len(set(reported)) == len(reported)
        for configuration, angles in zip(reported, answer.q, strict=True):
            theta = arm.direction * angles + arm.offset
            L = arm.links(angles)
            ahead = L[1][:3, 0] @ (L[5][:3, 3] - L[1][:3, 3]) + arm.a[0]
            assert configuration.shoulder == ("front" if ahead > 0 else "back")
            assert configuration.wrist == ("noflip" if np.sin(theta[4]) >= 0 else "flip")
            # The elbow is up where it lies above the line from shoulder to the planar arm's end, the wrist being ahead.
            end = L[5 if arm.table[KIND] == SPHERICAL else 3][:3, 3]
            x, z = L[1][:3, 0] * np.sign(ahead), L[0][:3, 2]
            elbow, end = (np.array([x, z]) @ (p - L[1][:3, 3]) for p in (L[2][:3, 3], end))
            assert configuration.elbow == ("up" if end[0] * elbow[1] - end[1] * elbow[0] > 0 else "down")


@exact
def test_poses_near_singularities_are_answered_as_well(arm):
    rng = np.random.default_rng(9)
    q = arms.near_singular(arm, 1500, rng)
    Ts = arm.forward(q)
    many = arm.inverse_batch(Ts)
    assert (many.count > 0).mean() > 0.999  # where wrist, elbow and shoulder are singular at once one may be lost
    there = np.arange(many.q.shape[1]) < many.count[:, None]
    assert np.isfinite(many.q).all()
    far, rotation = arms.off(arm.forward(many.q[there]), np.repeat(Ts, many.count, axis=0))
    assert far.max() < 1e-9
    assert rotation.max() < 1e-9
    for i in range(many.q.shape[1]):
        for j in range(i):
            both = there[:, i] & there[:, j]
            assert (arms.apart(many.q[both, i], many.q[both, j]) > 1e-7).all()


@pytest.mark.parametrize("arm", arms.IDENTIFIED, ids=arms.names(arms.IDENTIFIED))
def test_a_pose_that_an_identified_arm_is_in_is_hardly_ever_out_of_reach(arm):
    Ts = arm.forward(arms.near_singular(arm, 300, np.random.default_rng(11)))
    many = arm.inverse_batch(Ts)
    assert (many.count > 0).mean() > 0.99  # beside a singularity descent may end at a pose nearby
    there = np.arange(many.q.shape[1]) < many.count[:, None]
    far, rotation = arms.off(arm.forward(many.q[there]), np.repeat(Ts, many.count, axis=0))
    assert max(far.max(), rotation.max()) < 1e-9


@exact
def test_a_batch_is_its_single_calls(arm):
    Ts = arm.forward(np.random.default_rng(10).uniform(-np.pi, np.pi, (20, 6)))
    many = arm.inverse_batch(Ts)
    for k, T in enumerate(Ts):
        one = arm.inverse(T)
        assert many.count[k] == len(one)
        for name in ("q", "residual_m", "residual_rad", "within_limits", "singular", "signs"):
            # The compiler may order products differently in the loop: rounding, over the Jacobian's smallest value.
            np.testing.assert_allclose(getattr(many, name)[k, : len(one)], getattr(one, name), rtol=0, atol=1e-12)
            assert not getattr(many, name)[k, len(one) :].any()


@exact
def test_near_sorts_and_takes_whole_revolutions_within_the_limits(arm):
    rng = np.random.default_rng(11)
    for _ in range(20):
        q = rng.uniform(arm.q_min, arm.q_max)
        answer = arm.inverse(arm.forward(q), near=q)
        np.testing.assert_allclose(answer.q[0], q, rtol=0, atol=1e-8)
        np.testing.assert_array_equal(answer.best, answer.q[0])
        inside = answer.q[answer.within_limits]
        distance = np.linalg.norm(inside - q, axis=1)
        assert (np.diff(distance) >= 0).all()
        for k in range(6):  # no whole revolution would bring a joint nearer without leaving its limits
            for revolution in (-2 * np.pi, 2 * np.pi):
                other = inside[:, k] + revolution
                allowed = (other >= arm.q_min[k]) & (other <= arm.q_max[k])
                assert (np.abs(other - q[k]) > np.abs(inside[:, k] - q[k]) - 1e-9)[allowed].all()


def test_a_whole_revolution_is_taken_where_only_that_is_within_limits():
    q = np.deg2rad([10, 200, -100, 20, 30, 40])  # joint 2 of the PUMA goes from -45 to 225 degrees
    answer = PUMA.inverse(PUMA.forward(q))
    assert np.abs(answer.q[answer.within_limits] - q).max(axis=1).min() < 1e-12


@pytest.mark.parametrize("free", [None, 0.7])
@pytest.mark.parametrize("arm", [PUMA, IRB, arms.CRAIG], ids=["puma560", "irb120", "craig"])
def test_a_straight_wrist_leaves_joint_4_where_near_has_it(arm, free):
    near = None if free is None else np.full(6, free)
    q = np.array([0.3, 0.2, -0.6, 0.4, 0.0, 0.5])
    answer = arm.inverse(arm.forward(q), near)
    check(arm, arm.forward(q), answer)
    assert answer.reason.startswith("singular: wrist")
    expected = free or 0.0
    held = answer.q[answer.singular]
    assert len(held)
    np.testing.assert_allclose(held[:, 3], expected, atol=1e-12)
    # On the singularity axes 4 and 6 are one: of the known solution only the sum of both joints comes back.
    same = np.abs(held - [0.3, 0.2, -0.6, expected, 0.0, 0.9 - expected]).max(axis=1)
    assert same.min() < 1e-7


def test_axis_6_parallel_to_three_others_leaves_joint_6_where_near_has_it():
    q = np.array([0.3, -1.0, 1.2, 0.4, 0.0, 0.5])
    for near, expected in ((None, 0.0), (np.full(6, 0.2), 0.2)):
        answer = UR5.inverse(UR5.forward(q), near)
        check(UR5, UR5.forward(q), answer)
        assert "singular: wrist" in answer.reason
        np.testing.assert_allclose(answer.q[answer.singular][:, 5], expected, atol=1e-12)


def test_joint_6_gives_way_where_the_arm_would_not_reach():
    gave_way = 0
    for q4 in np.linspace(-3, 3, 13):
        q = np.array([0.3, -0.2, 0.05, q4, 0.0, 2.5])  # nearly straight
        T = UR5.forward(q)
        answer = UR5.inverse(T)
        check(UR5, T, answer)
        held = np.abs(answer.q[answer.singular & (np.abs(answer.q[:, 4]) < 1e-9), 5])
        assert held.min() < 2.5 + 1e-6  # there the arm reaches for certain
        gave_way += held.min() > 0.1
    assert gave_way


@pytest.mark.parametrize("arm", [SIX, IRB], ids=["six_r", "irb120"])
def test_a_wrist_on_axis_1_leaves_joint_1_where_near_has_it(arm):
    q = np.array([0.3, 0.0, 1.2, 0.4, 0.6, 0.5])
    q[1] = arms.over_axis1(arm, q)
    for near in (None, np.full(6, 0.31)):
        answer = arm.inverse(arm.forward(q), near)
        check(arm, arm.forward(q), answer)
        assert "singular: shoulder" in answer.reason
        if arm is IRB:
            np.testing.assert_allclose(answer.q[:, 0], 0.0 if near is None else 0.31, atol=1e-12)


def test_a_straight_elbow_is_one_solution_and_says_so():
    answer = SIX.inverse(SIX.forward(SIX.home))
    assert answer.reason.startswith("singular: elbow")
    np.testing.assert_allclose(answer.best, SIX.home, atol=1e-7)
    assert len(answer) == 1


def test_a_pose_too_far_out_is_answered_with_the_nearest():
    T = SIX.forward(SIX.home)
    T[0, 3] += 0.1
    answer = SIX.inverse(T, near=SIX.home)
    check(SIX, T, answer)
    assert len(answer) == 0
    assert answer.best is None
    assert answer.reason.startswith("unreachable: upper arm")
    nearest = answer.nearest
    # Straight out of a straight arm: the nearest pose is the straight arm itself, 100 mm short.
    assert abs(nearest.off_m - 0.1) < 1e-6
    assert nearest.off_rad < 1e-3
    np.testing.assert_allclose(nearest.T_base_tool, arms.forward(SIX, nearest.q), atol=1e-14)


def test_a_pose_inside_the_shoulders_offset_is_out_of_reach():
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, 3] = 0.05, 0.0, 0.3  # the wrist of a UR5 stays 109 mm off axis 1
    answer = UR5.inverse(T)
    check(UR5, T, answer)
    assert answer.reason.startswith("unreachable: the wrist would be nearer to axis 1")
    assert 0 < answer.nearest.off_m < 0.06


@pytest.mark.parametrize("arm", [*arms.CLOSED.values()], ids=[*arms.CLOSED])
def test_the_nearest_pose_is_no_worse_than_any_tried(arm):
    rng = np.random.default_rng(12)
    tried = arm.forward(rng.uniform(arm.q_min, arm.q_max, (20_000, 6)))
    for _ in range(5):
        T = exp_se3(np.concatenate([rng.normal(0, 1.5, 3), rng.normal(0, 1, 3)]))
        nearest = arm.inverse(T).nearest
        if nearest is None:
            continue
        far, rotation = arms.off(tried, T)
        assert np.hypot(nearest.off_m, nearest.off_rad) <= np.hypot(far, rotation).min()
        assert arm.within_limits(nearest.q)


@pytest.mark.parametrize("far_m", [1e9, 1e200])
def test_a_pose_beyond_all_bounds_is_answered_too(far_m):
    T = SIX.forward(SIX.home)
    T[0, 3] = far_m
    nearest = SIX.inverse(T).nearest
    assert nearest.off_m == pytest.approx(far_m)  # in squares the second is beyond what a number holds
    assert SIX.within_limits(nearest.q)


def test_a_pose_that_only_limits_forbid_has_its_solutions_and_the_nearest_within():
    tight = dataclasses.replace(IRB, q_min=IRB.home - 0.1, q_max=IRB.home + 0.1)
    T = IRB.forward(IRB.home + 0.3)
    answer = tight.inverse(T)
    check(tight, T, answer)
    assert len(answer) == len(IRB.inverse(T))
    assert not answer.within_limits.any()
    assert answer.reason.startswith("outside limits")
    assert tight.within_limits(answer.nearest.q)


@pytest.mark.parametrize(("arm", "nominal"), [*zip(arms.IDENTIFIED, (UR5, PUMA), strict=True)], ids=["ur5", "puma560"])
def test_an_identified_table_keeps_all_solutions_of_its_nominal_one(arm, nominal):
    rng, found = np.random.default_rng(13), 0
    for q in rng.uniform(-np.pi, np.pi, (60, 6)):
        if nominal.manipulability(q) < 2e-3:  # close to a singularity a small change may take two solutions away
            continue
        T = arm.forward(q)
        answer = arm.inverse(T)
        check(arm, T, answer)
        assert arms.apart(answer.q, q).min() < 1e-6
        found += len(answer) >= len(nominal.inverse(nominal.forward(q)))
    assert found > 0.8 * sum(nominal.manipulability(rng.uniform(-np.pi, np.pi, (60, 6))) >= 2e-3)


def test_an_arm_without_structure_is_solved_from_many_starts():
    arm = arms.GENERAL
    for q in np.random.default_rng(14).uniform(-np.pi, np.pi, (10, 6)):
        T = arm.forward(q)
        for answer in (arm.inverse(T), arm.inverse(T, near=q)):
            check(arm, T, answer)
            assert answer.configurations == (None,) * len(answer)
        assert arms.apart(answer.q, q).min() < 1e-9
    T[:3, 3] = 9.0
    answer = arm.inverse(T)
    assert answer.reason.startswith("unreachable: damped least squares found")
    assert answer.nearest.off_m > 7


def test_a_rotation_slightly_off_is_put_right():
    T = UR5.forward(UR5.home)
    T[:3, :3] += 5e-7 * np.random.default_rng(15).uniform(-0.5, 0.5, (3, 3))
    answer = UR5.inverse(T, near=UR5.home)
    assert (answer.residual_rad < 1e-12).all()
    assert np.abs(answer.best - UR5.home).max() < 1e-5


def test_solutions_print_their_angles_in_degrees():
    arm = MODELS["ur5e"]
    found = arm.inverse(arm.forward(arm.home))
    first, *rows = repr(found).splitlines()
    assert first.startswith(f"Solutions({len(found)} solutions")
    np.testing.assert_allclose(
        [[float(x) for x in row.strip(" )").split()] for row in rows], np.degrees(found.q), atol=1e-3
    )
    assert repr(arm.inverse(pose(np.eye(3), np.array([9.0, 0.0, 0.0])))).startswith(
        "Solutions(0 solutions; unreachable"
    )
