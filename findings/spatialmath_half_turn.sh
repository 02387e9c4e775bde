#!/bin/sh
# spatialmath-python 1.1.18: the logarithm of a rotation 1e-7 rad short of half a turn is another rotation, by up to 4 degrees.
#
# SO3.log, SE3.log, trlog, tr2angvec and eulervec take the angle by acos of the trace and divide by its sine. Exactly at half a
# turn there is a branch of its own; just beside it acos has half the digits, its sine is wrong by a tenth, and so is the
# length of the vector: rotated back by it, the pose is elsewhere. UnitQuaternion.angvec is off by up to 20 degrees there. A
# tool that points down is half a turn: with matrices of 7 digits or from floats every such pose is in this region or in the
# exact branch, by chance. Nothing is raised. UnitQuaternion of the matrix, and SciPy, are right to 1e-13 throughout.
#
# 200 axes (seed 0); the angle between the rotation and what exp makes of its log, degrees, median and largest.
#
# Seen: 1e-3 rad short of half a turn 0.00 0.00; 1e-6: 0.01 0.05; 3e-7: 0.15 0.52; 1e-7: 1.9 3.8, UnitQuaternion.angvec 5.6 21;
# 3e-8: 0.00 0.00 (the branch at half a turn).
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.3.5 scipy==1.16.3 spatialmath-python==1.1.18
"$folder/venv/bin/python" -W ignore - <<'PYTHON'
import numpy as np
from scipy.spatial.transform import Rotation
from spatialmath import SO3, UnitQuaternion

axes = np.random.default_rng(0).normal(size=(200, 3))
axes /= np.linalg.norm(axes, axis=1, keepdims=True)


def off(R, again):
    return np.degrees((Rotation.from_matrix(R).inv() * Rotation.from_matrix(again)).magnitude())


there_and_back = {
    "SO3.log": lambda R: SO3.Exp(SO3(R, check=False).log(twist=True)).R,
    "UnitQuaternion.angvec": lambda R: UnitQuaternion.AngVec(*UnitQuaternion(R).angvec()).R,
    "UnitQuaternion": lambda R: UnitQuaternion(R).R,
    "SciPy": lambda R: Rotation.from_rotvec(Rotation.from_matrix(R).as_rotvec()).as_matrix(),
}
# Short of half a turn, rad -> at least and at most the largest error of SO3.log and of angvec, degrees.
expected = {1e-3: (0, 1e-4, 0, 1e-4), 1e-6: (0.01, 0.2, 0.05, 1.0), 1e-7: (2, 8, 8, 60), 3e-8: (0, 1e-4, 0, 1e-4)}
for short, (least, most, least_angvec, most_angvec) in expected.items():
    Rs = Rotation.from_rotvec((np.pi - short) * axes).as_matrix()
    found = {name: np.array([off(R, way(R)) for R in Rs]) for name, way in there_and_back.items()}
    said = ", ".join(f"{name} {np.median(each):.2g} {each.max():.2g}" for name, each in found.items())
    print(f"{short:.0e} rad short of half a turn: {said} degrees")
    assert least <= found["SO3.log"].max() <= most
    assert least_angvec <= found["UnitQuaternion.angvec"].max() <= most_angvec
    assert max(found["UnitQuaternion"].max(), found["SciPy"].max()) < 1e-5
PYTHON
