"""UFACTORY xArm 7: seven joints; the tool is the flange.

Table: the maker's article "Kinematic and dynamic parameters of the UFACTORY xArm series" (Craig's convention). Limits:
xarm_ros2 (github.com/xArm-Developer/xarm_ros2), xarm_description. Accelerations are the maker's greatest, jerks chosen.
"""

import numpy as np

from armsight.robot.arm import Arm

ARM = Arm(
    name="xarm7",
    a=np.array([0.0, 0.0, 0.0, 0.0525, 0.0775, 0.0, 0.076]),
    d=np.array([0.267, 0.0, 0.293, 0.0, 0.3425, 0.0, 0.097]),
    alpha=np.deg2rad([0.0, -90.0, 90.0, 90.0, 90.0, 90.0, -90.0]),
    convention="modified",
    home=np.deg2rad([0.0, -30.0, 0.0, 60.0, 0.0, 90.0, 0.0]),  # chosen: elbow bent, tool down
    q_min=np.array([-2 * np.pi, -2.059, -2 * np.pi, -0.19198, -2 * np.pi, -1.69297, -2 * np.pi]),
    q_max=np.array([2 * np.pi, 2.0944, 2 * np.pi, 3.927, 2 * np.pi, np.pi, 2 * np.pi]),
    qd_max=np.full(7, np.pi),
    qdd_max=np.full(7, np.deg2rad(1145.0)),
    qddd_max=np.full(7, np.deg2rad(11450.0)),  # chosen: full acceleration in 0.1 s
    source="UFACTORY's article on kinematic parameters; limits xarm_ros2; jerks are chosen",
)
