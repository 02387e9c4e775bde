"""TheRobotStudio SO-101 follower: five joints; the gripper's jaw is no joint of the arm.

From the makers' URDF (github.com/TheRobotStudio/SO-ARM100, Simulation/SO101/so101_new_calib.urdf): joint angles are 0 in
the
middle of their ranges, as LeRobot calibrates them. The tool is at the URDF's gripperframe, between the tips, with its axes
as usual for grippers: z ahead, where the gripper points, and x as there. The same kinematics but for the gripper has the
SO-100. Speeds, accelerations and jerks are chosen: the URDF gives stand-ins.
"""

import numpy as np

from armsight.geometry.pose import pose
from armsight.robot.arm import Arm

#: From joint 2 to joint 3 and from joint 3 to joint 4, along and across the printed parts, m; and the angles between.
_UPPER, _FORE = (0.11257, 0.028), (0.1349, 0.0052)
_UPPER_BEND, _FORE_BEND = (np.arctan2(across, along) for along, across in (_UPPER, _FORE))

ARM = Arm(
    name="so101",
    a=np.array([-0.0303992, np.hypot(*_UPPER), np.hypot(*_FORE), 0.0, 0.0]),
    d=np.array([-0.0542, -0.0182778, 0.0, 0.0181, -0.0611]),
    alpha=np.deg2rad([-90.0, 0.0, 0.0, -90.0, 0.0]),
    offset=np.array(
        [0.0, np.pi / 2 + _UPPER_BEND, np.pi / 2 - _UPPER_BEND - _FORE_BEND, np.pi / 2 + _FORE_BEND, np.pi]
    ),
    T_base_0=pose(
        np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]), np.array([0.0207909, -0.0230745, 0.0948817])
    ),
    T_flange_tool=pose(
        np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]), np.array([-0.0079, -0.000218121, -0.0981274])
    ),
    home=np.zeros(5),
    q_min=np.array([-1.91986, -1.74533, -1.69, -1.65806, -2.79253]),
    q_max=np.array([1.91986, 1.74533, 1.69, 1.65806, 2.79253]),
    qd_max=np.full(5, 3.0),  # chosen: the servo turns 4.7 rad/s without load at 7.4 V
    qdd_max=np.full(5, 15.0),  # chosen
    qddd_max=np.full(5, 150.0),  # chosen: full acceleration in 0.1 s
    joint_names=("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll"),
    source="SO-ARM100 repository, so101_new_calib.urdf; speeds and beyond are chosen",
)
