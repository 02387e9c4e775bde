#!/bin/sh
# scikit-kinematics 0.10.4: of four ways to the angles of a rotation three give those of another one; yaw ends at 90 degrees.
#
# quat.quat2seq(q), "nautical" by default, takes yaw and roll by arcsin: yaw 120 comes out as 60, roll -100 as -80. With "Euler"
# its first angle is 180 degrees less the right one, for the sign of a matrix element is missing: right where that angle is 90,
# as in the documentation's example. rotmat.sequence(R, "Euler") sets a middle angle below zero to zero, for what is
# small is tested without its sign. rotmat.sequence(R, "nautical") alone is right. None warns, and all four are documented
# for the same angles, which the package's own rotmat.seq2quat takes back. A tool that points backwards has other angles.
#
# 500 rotations (seed 0); degrees from the rotation to what SciPy makes of the angles.
#
# Seen, share that is off by more than 0.01: nautical: quat2seq 0.75, sequence 0.00; Euler: quat2seq 1.00, sequence 0.87.
# Yaw 120 pitch 10 roll 5: 60 10 5 and 120 10 5; Euler's 30 40 20: 150 40 20 and 30 40 20; 30 -40 20 by sequence: 0 0 44.2.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.3.5 scipy==1.16.3 scikit-kinematics==0.10.4
"$folder/venv/bin/python" -W ignore - <<'PYTHON'
import numpy as np
from scipy.spatial.transform import Rotation
from skinematics import quat, rotmat


def quat2seq(rotation, name):
    return np.ravel(quat.quat2seq(rotation.as_quat(scalar_first=True), name))


def sequence(rotation, name):
    return np.degrees(np.ravel(rotmat.sequence(rotation.as_matrix(), name)))


AXES = {"nautical": "ZYX", "Euler": "ZXZ"}
EXPECTED = {("quat2seq", "nautical"): 0.75, ("sequence", "nautical"): 0, ("quat2seq", "Euler"): 1, ("sequence", "Euler"): 0.87}
rotations = Rotation.from_quat(np.random.default_rng(0).normal(size=(500, 4)))
for way in (quat2seq, sequence):
    for name, axes in AXES.items():
        again = Rotation.from_euler(axes, [way(each, name) for each in rotations], degrees=True)
        off = np.degrees((rotations.inv() * again).magnitude())
        share = np.mean(off > 0.01)
        print(f"{way.__name__} {name}: {share:.2f} off by more than 0.01 degrees, at most by {off.max():.0f}")
        assert abs(share - EXPECTED[way.__name__, name]) < 0.02

for name, angles, by_quat2seq, by_sequence in (
    ("nautical", (120, 10, 5), (60, 10, 5), (120, 10, 5)),
    ("Euler", (30, 40, 20), (150, 40, 20), (30, 40, 20)),
    ("Euler", (30, -40, 20), None, (0, 0, 44.17)),
):
    one = Rotation.from_euler(AXES[name], angles, degrees=True)
    print(f"{name} {angles}: quat2seq {quat2seq(one, name).round(2)}, sequence {sequence(one, name).round(2)}")
    # The package's own way back agrees with SciPy about what the angles mean.
    back = Rotation.from_quat(np.ravel(rotmat.seq2quat(np.array([angles], float), name)), scalar_first=True)
    assert np.degrees((one.inv() * back).magnitude()) < 1e-6
    assert by_quat2seq is None or np.allclose(quat2seq(one, name), by_quat2seq, atol=0.01)
    assert np.allclose(sequence(one, name), by_sequence, atol=0.01)
PYTHON
