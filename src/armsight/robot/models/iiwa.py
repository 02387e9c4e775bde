"""KUKA LBR iiwa 14 R820: seven joints; the tool is the media flange's face.

Lengths and ranges: KUKA, "LBR iiwa 7 R800, LBR iiwa 14 R820: specification", with the flange 126 mm from the wrist, as in
iiwa_stack (github.com/IFL-CAMP/iiwa_stack). Accelerations and jerks are chosen: the specification gives none.
"""

import numpy as np

from armsight.robot.arm import Arm

ARM = Arm(
    name="iiwa",
    a=np.zeros(7),
    d=np.array([0.36, 0.0, 0.42, 0.0, 0.4, 0.0, 0.126]),
    alpha=np.deg2rad([-90.0, 90.0, 90.0, -90.0, -90.0, 90.0, 0.0]),
    home=np.deg2rad([0.0, 30.0, 0.0, -90.0, 0.0, 60.0, 0.0]),  # chosen: elbow bent, tool down
    q_min=np.deg2rad([-170.0, -120.0, -170.0, -120.0, -170.0, -120.0, -175.0]),
    q_max=np.deg2rad([170.0, 120.0, 170.0, 120.0, 170.0, 120.0, 175.0]),
    qd_max=np.deg2rad([85.0, 85.0, 100.0, 75.0, 130.0, 135.0, 135.0]),
    qdd_max=np.deg2rad([340.0, 340.0, 400.0, 300.0, 520.0, 540.0, 540.0]),  # chosen: full speed in 0.25 s
    qddd_max=np.deg2rad([3400.0, 3400.0, 4000.0, 3000.0, 5200.0, 5400.0, 5400.0]),  # chosen: in 0.1 s
    source="KUKA specification LBR iiwa 14 R820; accelerations and jerks are chosen",
)
