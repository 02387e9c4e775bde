#!/bin/sh
# robodk 6.0.2: numpy.array of a pose is its transpose, and SaveMat writes that; .rows, indices and SaveCSV do not.
#
# Mat has __getitem__ with a row first. It has no __array__: numpy iterates over it, and iterating gives columns.
# numpy.array(pose)[:3, :3] is the inverse rotation, [:3, 3] is 0 and not the position, and no shape says so; of a pose
# without a position (rotz, a tool that is only rotated) even the last row is 0 0 0 1. SciPy takes a Mat in the same way:
# Rotation.from_matrix(pose.Rot33()).
#
# Seen, transl(100, 200, 300) * rotz(30 deg): mat[0, 1] -0.5, numpy's [0, 1] +0.5; column 3: 100 200 300, numpy's 0 0 0.
# SciPy of Rot33(): -30.0 deg about z. Files: SaveCSV's first row ends with 100, SaveMat's with 0.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.3.5 scipy==1.16.3
"$folder/venv/bin/pip" install --quiet --no-deps robodk==6.0.2
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import math
from pathlib import Path

import numpy as np
from robodk import robomath
from scipy.spatial.transform import Rotation

pose = robomath.transl(100, 200, 300) * robomath.rotz(math.radians(30))
array = np.array(pose)
print("[0, 1]:", round(pose[0, 1], 3), "numpy's", round(array[0, 1], 3), "; position", pose.Pos(), "numpy's", array[:3, 3])
assert array.shape == (4, 4) and not hasattr(pose, "__array__")
assert np.array(robomath.rotz(1.0))[3].tolist() == [0, 0, 0, 1]
np.testing.assert_allclose(array, np.array(pose.rows).T, atol=1e-15)
assert abs(pose[0, 1] + 0.5) < 1e-12 and pose.Pos() == [100, 200, 300]

angle = Rotation.from_matrix(pose.Rot33()).as_rotvec(degrees=True)[2]
print(f"SciPy takes its rotation for {angle:.1f} degrees about z")
assert abs(angle + 30) < 1e-9

pose.SaveMat("mat.csv")
pose.SaveCSV("csv.csv")
ends = [float(Path(name).read_text().splitlines()[0].split(",")[3]) for name in ("csv.csv", "mat.csv")]
print("the first row ends with", ends[0], "by SaveCSV and with", ends[1], "by SaveMat")
assert ends == [100.0, 0.0]
PYTHON
