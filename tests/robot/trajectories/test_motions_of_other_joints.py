"""Motions of arms with five and seven joints."""

import numpy as np
import pytest
from arm_motions import shifted, within

from armsight.errors import InputError
from armsight.robot.models import MODELS
from armsight.robot.trajectories.circle import circle
from armsight.robot.trajectories.line import LinePath, line
from armsight.robot.trajectories.point_to_point import point_to_point
from armsight.robot.trajectories.resolved_rate import resolved_rate


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


def test_five_joints_are_told_that_they_hold_no_orientation_on_a_path():
    arm = MODELS["so101"]
    with pytest.raises(InputError, match="so101 has 5 joints: it cannot move its tool along a path"):
        line(arm, arm.home, shifted(arm.forward(arm.home), [0.0, 0.01, 0.0]))
