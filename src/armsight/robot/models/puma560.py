"""Unimation PUMA 560, standard table with Paul's signs of alpha, frame 0 at the shoulder.

Lengths: P. I. Corke and B. Armstrong-Helouvry, "A search for consensus among model parameters reported for the PUMA 560
robot", ICRA 1994. Joint limits: L.-C. T. Wang and C. C. Chen, "A combined optimization method for solving the inverse
kinematics problem of mechanical manipulators", IEEE Trans. Robotics and Automation 7(4), 1991. Speeds, accelerations and
jerks are chosen: no measured ones are published together.
"""

import numpy as np

from armsight.robot.arm import Arm

ARM = Arm(
    name="puma560",
    a=np.array([0.0, 0.4318, 0.0203, 0.0, 0.0, 0.0]),
    d=np.array([0.0, 0.0, 0.15005, 0.4318, 0.0, 0.0]),
    alpha=np.deg2rad([90.0, 0.0, -90.0, 90.0, -90.0, 0.0]),
    home=np.deg2rad([0.0, 90.0, -90.0, 0.0, 0.0, 0.0]),  # "ready": upper arm and forearm straight up
    q_min=np.deg2rad([-160.0, -45.0, -225.0, -110.0, -100.0, -266.0]),
    q_max=np.deg2rad([160.0, 225.0, 45.0, 170.0, 100.0, 266.0]),
    qd_max=np.deg2rad([80.0, 70.0, 120.0, 220.0, 240.0, 220.0]),  # chosen
    qdd_max=np.deg2rad([320.0, 280.0, 480.0, 880.0, 960.0, 880.0]),  # chosen: full speed in 0.25 s
    qddd_max=np.deg2rad([3200.0, 2800.0, 4800.0, 8800.0, 9600.0, 8800.0]),  # chosen: full acceleration in 0.1 s
    source="Corke and Armstrong-Helouvry, ICRA 1994; limits Wang and Chen, 1991; speeds and beyond are chosen",
)
