"""Universal Robots UR10e.

Table: the maker's article "DH parameters for calculations of kinematics and dynamics" (universal-robots.com). Limits: the
maker's user manual. Accelerations and jerks are chosen: the maker publishes none.
"""

import numpy as np

from armsight.robot.arm import Arm

ARM = Arm(
    name="ur10e",
    a=np.array([0.0, -0.6127, -0.57155, 0.0, 0.0, 0.0]),
    d=np.array([0.1807, 0.0, 0.0, 0.17415, 0.11985, 0.11655]),
    alpha=np.deg2rad([90.0, 0.0, 0.0, 90.0, -90.0, 0.0]),
    home=np.deg2rad([0.0, -90.0, 90.0, -90.0, -90.0, 0.0]),  # chosen: elbow bent, tool down
    q_min=np.full(6, -2 * np.pi),
    q_max=np.full(6, 2 * np.pi),
    qd_max=np.deg2rad([120.0, 120.0, 180.0, 180.0, 180.0, 180.0]),
    qdd_max=np.full(6, np.deg2rad(720.0)),  # chosen
    qddd_max=np.full(6, np.deg2rad(7200.0)),  # chosen: full acceleration in 0.1 s
    joint_names=("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"),
    source="Universal Robots' article on DH parameters and user manual; accelerations and jerks are chosen",
)
