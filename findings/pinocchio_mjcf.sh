#!/bin/sh
# pin 4.1.0: buildModelFromMJCF builds another arm than MuJoCo 4.0.0 does of the same file, and says nothing.
#
# Both read MJCF; four ways to write the same thing are read in another way by pinocchio:
#   axisangle="0 3 4 40"   MuJoCo normalises the axis; pinocchio does not: the "rotation" is none, and links fly off
#   eulerseq="ZYX"         capitals are rotations about fixed axes in MuJoCo; pinocchio reads them as about rotated ones
#   <frame><body ..>       a body within <frame> (also <replicate>) is dropped, with its joints and its mass
#   limited="false"        a range that is switched off is still the joint's limit
# Lower-case eulerseq, unit axes, quaternions that are not unit, zaxis, xyaxes, joint ref and pos are alike in both.
#
# Seen, the second body at zero angles, off from MuJoCo's by: plain 0.000 m 0.0 degrees; axisangle 7.054 m; eulerseq 0.041 m
# 12.0 degrees; frame: 2 joints in MuJoCo, 1 in pinocchio; limited="false": -1.571 to 0.785 rad in pinocchio.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.3.5 pin==4.1.0 mujoco==4.0.0
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
from pathlib import Path

import mujoco
import numpy as np
import pinocchio

MODEL = """<mujoco>
  <compiler SETTING/>
  <worldbody>
    <body name="a" pos="0 0 0.1" ORIENTATION>
      <joint name="j1" axis="0 0 1" LIMIT/>
      <geom size="0.01"/>
      BEFORE
      <body name="b" pos="0.2 0 0">
        <joint name="j2" axis="0 1 0"/>
        <geom size="0.01"/>
      </body>
      AFTER
    </body>
  </worldbody>
</mujoco>"""


def built(setting="", orientation="", limit="", before="", after=""):
    text = MODEL
    for word, part in zip(
        ("SETTING", "ORIENTATION", "LIMIT", "BEFORE", "AFTER"), (setting, orientation, limit, before, after), strict=True
    ):
        text = text.replace(word, part)
    Path("arm.xml").write_text(text)
    return mujoco.MjModel.from_xml_path("arm.xml"), pinocchio.buildModelFromMJCF("arm.xml")


def off(model, other):
    """How far body b is from MuJoCo's, m and degrees, at zero angles."""
    data, other_data = mujoco.MjData(model), other.createData()
    mujoco.mj_kinematics(model, data)
    pinocchio.framesForwardKinematics(other, other_data, np.zeros(2))
    found = other_data.oMf[other.getFrameId("b")]
    cosine = (np.trace(data.body("b").xmat.reshape(3, 3).T @ found.rotation) - 1) / 2
    return np.linalg.norm(data.body("b").xpos - found.translation), np.degrees(np.arccos(np.clip(cosine, -1, 1)))


for name, given, expected in (
    ("plain", {}, (0.0, 0.0)),
    ("axis of unit length", {"orientation": 'axisangle="0 0.6 0.8 40"'}, (0.0, 0.0)),
    ("axis of length 5", {"orientation": 'axisangle="0 3 4 40"'}, (7.054, None)),
    ("eulerseq zyx", {"setting": 'eulerseq="zyx"', "orientation": 'euler="10 20 30"'}, (0.0, 0.0)),
    ("eulerseq ZYX", {"setting": 'eulerseq="ZYX"', "orientation": 'euler="10 20 30"'}, (0.041, 12.0)),
):
    found = off(*built(**given))
    print(f"{name:19} off by {found[0]:.3f} m, {found[1]:.1f} degrees")
    assert abs(found[0] - expected[0]) < 2e-3
    assert expected[1] is None or abs(found[1] - expected[1]) < 0.1

model, other = built(before="<frame>", after="</frame>")
masses = model.body_subtreemass[0], sum(each.mass for each in other.inertias)
print(f"in a frame: joints {model.nq} and {other.nq}, mass {masses[0]:.4f} and {masses[1]:.4f} kg")
assert (model.nq, other.nq) == (2, 1)
assert masses[1] < 0.6 * masses[0]

model, other = built(limit='limited="false" range="-90 45"')
print(f"limited=false: MuJoCo {model.jnt_limited[0]}, pinocchio {other.lowerPositionLimit[0]:.3f} {other.upperPositionLimit[0]:.3f}")
assert not model.jnt_limited[0]
assert np.allclose([other.lowerPositionLimit[0], other.upperPositionLimit[0]], np.radians([-90, 45]))
PYTHON
