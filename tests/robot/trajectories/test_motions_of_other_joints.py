"""Motions of arms with five and seven joints."""

import numpy as np
import pytest
from arm_motions import shifted, within

from armsight.errors import InputError
from armsight.robot.models import MODELS
from armsight.robot.trajectories.circle import circle
from armsight.robot.trajectories.line import LinePath, line
from armsight.robot.trajectories.point_to_point import point_to_point
from armsight.robot.trajectories.resolved_rate import position_first, resolved_rate


@pytest.mark.parametrize("name", ["so101", "franka", "iiwa"])
def test_from_joints_to_joints(name):
    arm = MODELS[name]
    motion = point_to_point(arm, arm.home, arm.home + 0.2)
    within(arm, motion)
    np.testing.assert_allclose(motion.at(motion.duration_s).q, arm.home + 0.2, atol=1e-12)


@pytest.mark.parametrize("name", ["franka", "xarm7"])
def test_seven_joints_follow_a_line_and_a_circle_exactly(name):
    arm = MODELS[name]
    T = arm.forward(arm.home)
    goal = shifted(T, [0.05, 0.1, -0.08], [0.1, -0.1, 0.15])
    for motion in (line(arm, arm.home, goal), circle(arm, arm.home, T[:3, 3] + [0.03, 0, 0], [0, 0.3, 1.0], -3.0)):
        within(arm, motion)
        t = np.linspace(0, motion.duration_s, 40)
        share = motion.law.at(t).q[:, 0]
        np.testing.assert_allclose(arm.forward(motion.at(t).q), motion.path.at(share).T_base_tool, atol=1e-9)
    motion = line(arm, arm.home, goal)
    np.testing.assert_allclose(arm.forward(motion.at(motion.duration_s).q), goal, atol=1e-9)


def test_seven_joints_are_tracked_by_resolved_rate():
    arm = MODELS["iiwa"]
    T = arm.forward(arm.home)
    motion = resolved_rate(arm, arm.home, LinePath.between(T, shifted(T, [0.02, 0.05, -0.03])))
    within(arm, motion)
    assert motion.deviation_m < 1e-3


def test_five_joints_hold_no_orientation_on_a_path():
    arm = MODELS["so101"]
    with pytest.raises(InputError, match="so101 has 5 joints: it cannot move its tool along a path"):
        line(arm, arm.home, shifted(arm.forward(arm.home), [0.0, 0.01, 0.0]))


def test_five_joints_move_the_position_first():
    arm, rng = MODELS["so101"], np.random.default_rng(1)
    J, V = arm.jacobian(np.radians([10.0, -20.0, 25.0, 5.0, 15.0])), rng.normal(size=6)
    qd, least = position_first(J, V, lambda s: np.where(s > 1e-9, 1.0 / np.maximum(s, 1e-9), 0.0))
    np.testing.assert_allclose(J[:3] @ qd, V[:3], atol=1e-9)
    assert least > 0.01
    # Oracle: the rotation's least squares under the position as a constraint, by Lagrange's multipliers.
    system = np.block([[J[3:].T @ J[3:], J[:3].T], [J[:3], np.zeros((3, 3))]])
    np.testing.assert_allclose(qd, np.linalg.solve(system, np.append(J[3:].T @ V[3:], V[:3]))[:5], atol=1e-8)


def test_five_joints_are_tracked_along_a_line_with_the_position_on_it():
    arm, q = MODELS["so101"], np.radians([0.0, -20.0, 20.0, 0.0, 0.0])
    T = arm.forward(q)
    goal = shifted(T, [0.02, 0.01, -0.02], [0.0, 0.0, 0.0])
    motion = resolved_rate(arm, q, LinePath.between(T, goal), duration_s=0.6)
    p = arm.forward(motion.at(np.linspace(0, motion.duration_s, 30)).q)[:, :3, 3] - T[:3, 3]
    along = (goal - T)[:3, 3] / np.linalg.norm((goal - T)[:3, 3])
    assert np.linalg.norm(p - np.outer(p @ along, along), axis=1).max() < 1e-5
    np.testing.assert_allclose(p[-1], (goal - T)[:3, 3], atol=1e-6)
