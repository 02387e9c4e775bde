#!/bin/sh
# kinpy 0.6.1: a URDF joint without <axis> rotates about z; URDF's default is x. Nothing says so.
#
# URDF (wiki.ros.org/urdf/XML/joint) leaves the axis out where it is (1, 0, 0), and hand-written files do. yourdfpy
# rotates about x. kinpy takes the default of its own Joint, (0, 0, 1); its MJCF reader shares
# that class, and there z is right. pytorch-kinematics 0.10.0, whose readers are related, has the same lines (not run).
#
# Seen: a tool 0.1 m along y from such a joint at 90 degrees: yourdfpy (0, 0, 0.1), kinpy (-0.1, 0, 0).
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.4.6 kinpy==0.6.1 yourdfpy==0.0.60
cd "$folder"
cat >arm.urdf <<'XML'
<robot name="arm">
  <link name="base"/>
  <link name="upper"/>
  <link name="tool"/>
  <joint name="shoulder" type="revolute">
    <parent link="base"/>
    <child link="upper"/>
    <limit lower="-3" upper="3" effort="1" velocity="1"/>
  </joint>
  <joint name="end" type="fixed">
    <parent link="upper"/>
    <child link="tool"/>
    <origin xyz="0 0.1 0"/>
  </joint>
</robot>
XML
"$folder/venv/bin/python" - <<'PYTHON'
import math
from pathlib import Path

import kinpy
import numpy as np
import yourdfpy

text, angle = Path("arm.urdf").read_text(), math.pi / 2
arm = yourdfpy.URDF.load("arm.urdf", load_meshes=False)
arm.update_cfg({"shoulder": angle})
right = arm.get_transform("tool", "base")[:3, 3]
named = text.replace('<limit lower', '<axis xyz="1 0 0"/><limit lower')
left_out, given = (
    kinpy.build_serial_chain_from_urdf(one, "tool").forward_kinematics([angle]).pos for one in (text, named)
)
for name, p in (("yourdfpy", right), ("kinpy, axis given", given), ("kinpy, axis left out", left_out)):
    print(f"{name}: {np.round(p, 6) + 0.0}")
assert np.allclose(right, [0, 0, 0.1]) and np.allclose(given, right)
assert np.allclose(left_out, [-0.1, 0, 0])
PYTHON
