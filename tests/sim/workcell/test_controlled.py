"""Arms of the workcell with controllers of their own, and a servo that closes the loop over joints that droop."""

from types import SimpleNamespace

import numpy as np
import pytest

from armsight.app.demo.demo import motions_of
from armsight.data import JointCommand
from armsight.errors import InputError
from armsight.loop.servo import JointLoops, LoopTiming, PoseServo
from armsight.robot.arm_file import open_arm
from armsight.robot.board_registry import slowed
from armsight.robot.models import MODELS
from armsight.robot.trajectories import point_to_point
from armsight.sim.workcell.arm import PRESETS
from armsight.sim.workcell.controlled import CONTROLLED, ZERO_DEG, standing
from armsight.sim.workcell.workcell import Workcell, workcell_poses


def opened(name, preset="worn", seed=2):
    own = CONTROLLED[name]
    model = slowed(standing(open_arm(name)), own.board)
    return model, *own.open(model, PRESETS[preset], seed)


@pytest.mark.parametrize("name", list(CONTROLLED))
def test_an_arm_stands_at_home_as_its_sensors_have_it_and_is_driven_by_its_board(name):
    model, arm, board = opened(name)
    np.testing.assert_allclose(arm.device.truth[0], model.home, atol=np.radians(3.0))
    off = np.degrees(arm.path[-1, model.joints :] - board.receive(0.0).q[-1])
    assert 0.05 < np.abs(off).max() < ZERO_DEG + 0.3
    before, t_s = arm.path[-1].copy(), arm.t_s
    goal = model.home + np.radians(4.0) * np.eye(model.joints)[1]
    for _ in range(30):
        board.send(JointCommand(goal, np.zeros(model.joints), np.zeros(model.joints), 0.02))
        board.receive(0.05)
    assert np.degrees(arm.path[-1] - before)[1] == pytest.approx(4.0, abs=1.5)
    assert arm.t_s == pytest.approx(t_s + 1.5, abs=0.1)
    assert len(arm.path) == round(1000 * arm.t_s) + 1


def test_the_same_seed_is_the_same_arm_and_a_nominal_one_has_true_zeros():
    _, one, _ = opened("so101")
    _, two, _ = opened("so101")
    _, true, _ = opened("so101", "nominal")
    np.testing.assert_array_equal(one.path, two.path)
    np.testing.assert_array_equal(true.path[:, :5], true.path[:, 5:])


@pytest.mark.parametrize("name", [name for name in MODELS if open_arm(name).joints == 6 or name in CONTROLLED])
def test_poses_and_motions_of_the_demo_are_within_reach(name, tmp_path):
    own = CONTROLLED.get(name)
    model = standing(open_arm(name))
    model = model if own is None else slowed(model, own.board)
    poses = workcell_poses(model, default=False)
    _, plan = motions_of(model, poses, tmp_path / "motion.toml", quick=True, slow=True)
    assert [motion.kind for motion in plan.motions] == ["joints", "line", "circle"]


def test_an_arm_that_the_workcell_does_not_take_is_one_line():
    with pytest.raises(
        InputError, match="iiwa has 7 joints; the workcell takes arms of 6 with our firmware, and so101"
    ):
        Workcell.open(model=open_arm("iiwa"), cameras="320x240@30")


def test_the_loop_closes_over_joints_that_rest_off_their_commands():
    """Five joints whose controllers leave an error that depends on the pose, and readings that show it."""
    arm = open_arm("so101")
    servo = PoseServo(arm, LoopTiming(0.01, 0.03, 0.03, 0.1), JointLoops((np.radians(0.001),) * 5, 0.35))
    goal = np.radians([10.0, -20.0, 25.0, 5.0, 15.0])
    motion, off = point_to_point(arm, goal, goal + 1e-9), np.radians([0.1, -1.5, 1.0, 0.5, 0.0])
    q, zero = goal.copy(), np.radians([0.0, 0.5, -0.4, 0.3, 0.0])  # what the sensors do not show
    past, T_goal = [goal + off] * 10, arm.forward(goal)

    class Seen:
        """What an estimator says that sees the tool, and has learned nothing of the arm."""

        def estimate(self):
            T, q = arm.forward(self.read + zero), self.read
            return SimpleNamespace(T_base_tool=T, q=q, qd=np.zeros(5), vision_age_s=0.03, cov_own=1e-10 * np.eye(6))

        def tool(self, q, qd, *, pressed=False):
            return arm.forward(q)

    seen = Seen()
    for k in range(600):
        past.append(q + off)
        seen.read = past[-10]  # a tenth of a second late
        q = servo.step(servo.aim(motion, 1.0 + 0.01 * k), seen).command.q_ref
    assert np.linalg.norm((arm.forward(q + off + zero) - T_goal)[:3, 3]) < 2e-5
