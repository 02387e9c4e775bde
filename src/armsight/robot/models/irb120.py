"""ABB IRB 120-3/0.6.

Lengths (290, 270, 70, 302, 72 mm), working range and axis speeds: ABB, "Product specification IRB 120" (3HAC035960).
At all zeros the upper arm is upright, the forearm level, and the flange looks along base +X as ABB's tool0 does.
Accelerations and jerks are chosen: the specification gives none.
"""

import numpy as np

from armsight.robot.arm import Arm

ARM = Arm(
    name="irb120",
    a=np.array([0.0, 0.270, 0.070, 0.0, 0.0, 0.0]),
    d=np.array([0.290, 0.0, 0.0, 0.302, 0.0, 0.072]),
    alpha=np.deg2rad([-90.0, 0.0, -90.0, 90.0, -90.0, 0.0]),
    offset=np.deg2rad([0.0, -90.0, 0.0, 0.0, 0.0, 180.0]),
    home=np.deg2rad([0.0, 0.0, 0.0, 0.0, 30.0, 0.0]),  # chosen: off the wrist's singularity at zero
    q_min=np.deg2rad([-165.0, -110.0, -110.0, -160.0, -120.0, -400.0]),
    q_max=np.deg2rad([165.0, 110.0, 70.0, 160.0, 120.0, 400.0]),
    qd_max=np.deg2rad([250.0, 250.0, 250.0, 320.0, 320.0, 420.0]),
    qdd_max=np.deg2rad([1000.0, 1000.0, 1000.0, 1280.0, 1280.0, 1680.0]),  # chosen: full speed in 0.25 s
    qddd_max=np.deg2rad([10000.0, 10000.0, 10000.0, 12800.0, 12800.0, 16800.0]),  # chosen: full acceleration in 0.1 s
    source="ABB product specification IRB 120 (3HAC035960); accelerations and jerks are chosen",
)
