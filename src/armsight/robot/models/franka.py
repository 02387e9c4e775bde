"""Franka Emika Robot (Panda, FER): seven joints; the tool is the flange.

Table (Craig's, the maker's own) and limits: Franka Control Interface documentation, "Robot and interface specifications".
"""

import numpy as np

from armsight.geometry.pose import pose
from armsight.robot.arm import Arm

ARM = Arm(
    name="franka",
    a=np.array([0.0, 0.0, 0.0, 0.0825, -0.0825, 0.0, 0.088]),
    d=np.array([0.333, 0.0, 0.316, 0.0, 0.384, 0.0, 0.0]),
    alpha=np.deg2rad([0.0, -90.0, 90.0, 90.0, -90.0, 90.0, 90.0]),
    convention="modified",
    T_flange_tool=pose(np.eye(3), np.array([0.0, 0.0, 0.107])),
    home=np.deg2rad([0.0, -45.0, 0.0, -135.0, 0.0, 90.0, 45.0]),  # "ready" in the maker's examples
    q_min=np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973]),
    q_max=np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973]),
    qd_max=np.array([2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61]),
    qdd_max=np.array([15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0]),
    qddd_max=np.array([7500.0, 3750.0, 5000.0, 6250.0, 7500.0, 10000.0, 10000.0]),
    source="Franka Control Interface documentation, robot and interface specifications",
)
