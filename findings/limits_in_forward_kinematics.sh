#!/bin/sh
# compas_robots 1.0.1 and pytransform3d 3.17.0: a joint beyond its limit stands at the limit in their forward kinematics.
#
# Forward kinematics of URDFs takes measured angles, and a joint at its stop is often measured beyond the limit of its
# URDF: by play, by elasticity, or by a zero that was corrected. compas_robots clamps revolute and prismatic joints in
# forward_kinematics, which has no exception, warning or word of it; pytransform3d's set_joint clips without a warning, as its
# docstring says. yourdfpy takes what was measured.
#
# Seen: limit 1 rad, measured 1.05 rad, tool at 0.5 m: yourdfpy at 1.050 rad, the two others at 1.000: 25.0 mm apart.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.4.6 compas_robots==1.0.1 pytransform3d==3.17.0 yourdfpy==0.0.60
cd "$folder"
cat >arm.urdf <<'XML'
<robot name="arm">
  <link name="base"/>
  <link name="upper"/>
  <link name="tool"/>
  <joint name="shoulder" type="revolute">
    <parent link="base"/>
    <child link="upper"/>
    <axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/>
  </joint>
  <joint name="end" type="fixed">
    <parent link="upper"/>
    <child link="tool"/>
    <origin xyz="0.5 0 0"/>
  </joint>
</robot>
XML
"$folder/venv/bin/python" -W error::UserWarning - <<'PYTHON'
import math
from pathlib import Path

import numpy as np
import yourdfpy
from compas_robots import RobotModel
from pytransform3d.urdf import UrdfTransformManager

MEASURED, LIMIT = 1.05, 1.0
arm = yourdfpy.URDF.load("arm.urdf", load_meshes=False)
arm.update_cfg({"shoulder": MEASURED})
model = RobotModel.from_urdf_file("arm.urdf")
configuration = model.zero_configuration()
configuration["shoulder"] = MEASURED
manager = UrdfTransformManager()
manager.load_urdf(Path("arm.urdf").read_text())
manager.set_joint("shoulder", MEASURED)
tools = {
    "yourdfpy": arm.get_transform("tool", "base")[:3, 3],
    "compas_robots": np.array(model.forward_kinematics(configuration, link_name="tool").point),
    "pytransform3d": manager.get_transform("tool", "base")[:3, 3],
}
angles = {name: math.atan2(p[1], p[0]) for name, p in tools.items()}
for name, p in tools.items():
    off_mm = 1e3 * np.linalg.norm(p - tools["yourdfpy"])
    print(f"{name}: at {angles[name]:.3f} rad, {off_mm:.1f} mm from what was measured")
assert abs(angles["yourdfpy"] - MEASURED) < 1e-9
assert all(abs(angles[name] - LIMIT) < 1e-9 for name in ("compas_robots", "pytransform3d"))
assert configuration["shoulder"] == MEASURED
PYTHON
