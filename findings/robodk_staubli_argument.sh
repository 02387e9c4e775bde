#!/usr/bin/env bash
# robodk 6.0.2 (PyPI), robodk.robomath.Staubli_2_Pose(xyzwpr)
#
# Behaviour: the function converts the angles of the caller's own list to radians, in the list. The second call with the
# same list takes these radians for degrees and returns another pose, without an error. Of the makers' functions beside
# it (KUKA, Fanuc, Motoman, UR, Adept, Comau, Nachi, Techman) none changes its argument.
# Consequence: targets that are converted twice (once to check, once to send) lose nearly all of their rotation.
#
# Seen: the rotation of 10, 20, 30 deg is 38.63 deg in all by the first call, 0.65 deg by the second.
# Exits with 1 where this is no longer so.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m pip install --quiet --disable-pip-version-check --no-deps --target "$folder" robodk==6.0.2

PYTHONPATH=$folder "${PYTHON:-python3}" - <<'PYTHON'
import math
import sys

from robodk import robomath

NAMES = ("Staubli", "KUKA", "Fanuc", "Motoman", "UR", "Adept", "Comau", "Nachi", "Techman")


def angle_deg(pose):
    """The angle of a rotation, deg."""
    trace = sum(pose[k, k] for k in range(3))
    return math.degrees(math.acos(max(-1.0, min(1.0, (trace - 1) / 2))))


changed = []
for name in NAMES:
    target = [100.0, 200.0, 300.0, 10.0, 20.0, 30.0]
    first = getattr(robomath, f"{name}_2_Pose")(target)
    again = getattr(robomath, f"{name}_2_Pose")(target)
    print(f"{name}_2_Pose: {angle_deg(first):.2f} deg, then {angle_deg(again):.2f} deg; the list is now {target}")
    if target != [100.0, 200.0, 300.0, 10.0, 20.0, 30.0]:
        changed.append((name, round(angle_deg(first), 2), round(angle_deg(again), 2)))
print("changed:", changed)
sys.exit(changed != [("Staubli", 38.63, 0.65)])
PYTHON
