#!/bin/sh
# piper-sdk 0.6.2: forward kinematics within 0.81 degrees of a horizontal gripper give one orientation, exactly 90 degrees.
#
# AgileX' GetFK and C_PiperForwardKinematics.CalFK give x y z and roll, pitch, yaw of the flange. At a pitch of +-90 degrees yaw and
# roll are one angle, and one of them may be chosen. The SDK chooses wherever the sine is beyond 0.9999, and sets the pitch to
# 90 degrees as well: all poses within acos(0.9999) = 0.81 degrees are given one orientation. All joints at zero have a pitch of 85;
# joint 5 at 5 degrees is a horizontal gripper, the pose most work is done in. The position is right. Logged poses show a
# resolution of 0.001 degrees and are wrong by up to 0.8: 2.5 mm at a tool of 180 mm; a hand-eye calibration takes it for noise.
#
# Compared with the product of the SDK's own Denavit-Hartenberg rows, joints 20 0 0 0 q5 0.
#
# Seen, q5: pitch, off by, degrees: 4.0: 89.00 0.00; 4.2: 90.00 0.80; 4.5: 90.00 0.50; 5.0: 90.00 0.00; 5.5: 90.00 0.50;
# 5.8: 90.00 0.80; 6.0: 89.00 0.00. The position is off by less than 1e-9 mm.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.3.5 scipy==1.16.3 piper-sdk==0.6.2
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import numpy as np
from piper_sdk import C_PiperForwardKinematics
from scipy.spatial.transform import Rotation

arm = C_PiperForwardKinematics()


def by_rows(q):
    """Return the flange before the base (4, 4), mm, by Craig's product of the SDK's own rows."""
    T = np.eye(4)
    for angle, alpha, a, theta, d in zip(q, arm._alpha, arm._a, arm._theta, arm._d, strict=True):
        step = np.eye(4)
        step[:3, :3] = (Rotation.from_euler("x", alpha) * Rotation.from_euler("z", angle + theta)).as_matrix()
        step[:3, 3] = a, -np.sin(alpha) * d, np.cos(alpha) * d
        T = T @ step
    return T


expected = {4.0: (89.0, 0.0), 4.2: (90.0, 0.8), 4.5: (90.0, 0.5), 5.0: (90.0, 0.0), 5.5: (90.0, 0.5), 5.8: (90.0, 0.8), 6.0: (89.0, 0.0)}
for q5, (pitch, off) in expected.items():
    q = np.radians([20.0, 0.0, 0.0, 0.0, q5, 0.0])
    pose, true = np.array(arm.CalFK(q.tolist())[-1]), by_rows(q)
    found = np.degrees((Rotation.from_euler("xyz", pose[3:], degrees=True).inv() * Rotation.from_matrix(true[:3, :3])).magnitude())
    print(f"q5 {q5:.1f}: roll {pose[3]:8.3f} pitch {pose[4]:.3f} yaw {pose[5]:8.3f}, off by {found:.3f} degrees")
    assert np.allclose(pose[:3], true[:3, 3], atol=1e-9)
    assert abs(pose[4] - pitch) < 1e-6
    assert abs(found - off) < 1e-6
PYTHON
