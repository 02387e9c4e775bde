#!/usr/bin/env bash
# robodk 6.0.2 (PyPI), robodk.robomath.Pose_2_Nachi and Nachi_2_Pose
#
# Behaviour: both are documented for a "Nachi XYZRPW target", and they take its three angles in opposite orders: a target that
# is converted to a pose and back has its first and last angle exchanged. Of the other eight makers each pair gives the
# target back. Nothing is raised, and targets whose first and last angle are equal, or small, look right.
# Consequence: an offset that is applied to a taught point (to a pose, times the offset, back) sends the tool elsewhere.
#
# Seen: 10, 20, 30 deg comes back as 30, 20, 10: a rotation that is off by 32.7 deg; the other makers' by 0.
# Exits with 1 where this is no longer so.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m pip install --quiet --disable-pip-version-check --no-deps --target "$folder" robodk==6.0.2

PYTHONPATH=$folder "${PYTHON:-python3}" - <<'PYTHON'
import math
import sys

from robodk import robomath

TARGET = [100.0, 200.0, 300.0, 10.0, 20.0, 30.0]
found = {}
for name in ("Staubli", "KUKA", "Fanuc", "Motoman", "Adept", "Comau", "Nachi", "Techman", "UR"):
    to_pose, to_target = getattr(robomath, f"{name}_2_Pose"), getattr(robomath, f"Pose_2_{name}")
    target = [*TARGET[:3], *(math.radians(angle) if name == "UR" else angle for angle in TARGET[3:])]
    pose = to_pose(list(target))
    back = to_target(pose)
    rest = robomath.invH(pose) * to_pose(list(back))
    cosine = (sum(rest[k, k] for k in range(3)) - 1) / 2
    found[name] = round(math.degrees(math.acos(max(-1.0, min(1.0, cosine)))), 1)
    print(f"{name}: {[round(angle, 4) for angle in back[3:]]}, its rotation is off by {found[name]:.1f} deg")
print("off:", {name: off for name, off in found.items() if off})
sys.exit({name: off for name, off in found.items() if off} != {"Nachi": 32.7})
PYTHON
