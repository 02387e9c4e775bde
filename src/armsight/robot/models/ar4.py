"""Annin Robotics AR4-MK3.

Lengths: the maker's Denavit-Hartenberg table (anninrobotics.com, AR4 software), in the arm's own joint angles. Limits and
the greatest speed: ar4_ros_driver (github.com/ycheng517/ar4_ros_driver), ar_description/config/mk3.yaml and ar_macro.xacro,
which has the same lengths, but stands rotated by -90 degrees, turns joint 1 the other way and moves the forearm 7 mm
sideways. Accelerations and jerks are chosen.
"""

import numpy as np

from armsight.robot.arm import Arm

ARM = Arm(
    name="ar4",
    a=np.array([0.0642, 0.305, 0.0, 0.0, 0.0, 0.0]),
    d=np.array([0.16977, 0.0, 0.0, 0.22263, 0.0, 0.041]),
    alpha=np.deg2rad([-90.0, 0.0, -90.0, 90.0, -90.0, 0.0]),
    offset=np.deg2rad([0.0, -90.0, 0.0, 0.0, 0.0, 180.0]),
    home=np.deg2rad([0.0, 0.0, 0.0, 0.0, 30.0, 0.0]),  # chosen: off the wrist's singularity at zero
    q_min=np.deg2rad([-170.0, -42.0, -89.0, -180.0, -105.0, -180.0]),
    q_max=np.deg2rad([170.0, 90.0, 52.0, 180.0, 105.0, 180.0]),
    qd_max=np.full(6, 1.0472),
    qdd_max=np.full(6, np.deg2rad(240.0)),  # chosen: full speed in 0.25 s
    qddd_max=np.full(6, np.deg2rad(2400.0)),  # chosen: full acceleration in 0.1 s
    source="Annin Robotics' table of the AR4-MK3; limits ar4_ros_driver; accelerations and jerks are chosen",
)
