"""The 6R arm of "Application of Stereo Vision and ARM Processor for Motion Control", table 18.1.

Table and home pose are that text's. It gives no limits: those here are chosen, as what a table-top arm of this size with
geared DC motors plausibly has, and are to be replaced by those of the arm at hand.
"""

import numpy as np

from armsight.robot.arm import Arm

ARM = Arm(
    name="six_r",
    a=np.array([0.0365, 0.2515, 0.125, 0.092, 0.0, 0.0]),
    d=np.array([0.438, 0.0, 0.0, 0.0, 0.0, 0.1528]),
    alpha=np.deg2rad([-90.0, 0.0, 0.0, 90.0, -90.0, 0.0]),
    home=np.deg2rad([0.0, 0.0, 0.0, 0.0, -90.0, 0.0]),
    q_min=np.deg2rad([-170.0, -180.0, -150.0, -150.0, -170.0, -180.0]),  # chosen
    q_max=np.deg2rad([170.0, 45.0, 150.0, 150.0, 170.0, 180.0]),  # chosen; joint 2 downwards is positive
    qd_max=np.deg2rad([90.0, 90.0, 120.0, 150.0, 150.0, 180.0]),  # chosen
    qdd_max=np.deg2rad([360.0, 360.0, 480.0, 600.0, 600.0, 720.0]),  # chosen: full speed in 0.25 s
    qddd_max=np.deg2rad([3600.0, 3600.0, 4800.0, 6000.0, 6000.0, 7200.0]),  # chosen: full acceleration in 0.1 s
    source="Application of Stereo Vision and ARM Processor for Motion Control, table 18.1; limits are chosen",
)
