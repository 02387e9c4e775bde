#!/bin/sh
# URDF 1.1 with quat_xyzw: pinocchio 4.1.0 reads the rotation; MuJoCo 4.0.0 and yourdfpy 0.0.60 do not.
#
# Since URDF 1.1 an <origin> may have quat_xyzw="x y z w" in place of rpy="r p y" (urdfdom 6.0.0, which pin's wheel brings).
# The loaders that have a parser of their own read rpy alone: every such origin becomes unrotated, and the arm has another
# shape. None of them warns, or looks at <robot version>. pinocchio itself ignores quat_xyzw, without a word too, where the
# file says version="1.0" or, as nearly all files do, no version at all: then it agrees with the others.
#
# Seen: tool 0.1 m along x behind a joint whose origin is rotated by 90 degrees about z, x y of the tool, m:
# version 1.1: pinocchio 0.2 0.1, MuJoCo, yourdfpy 0.3 0.0; version 1.0: all 0.3 0.0.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.3.5 pin==4.1.0 mujoco==4.0.0 trimesh==4.8.3 networkx==3.6 lxml six
"$folder/venv/bin/pip" install --quiet --no-deps yourdfpy==0.0.60
cd "$folder"
"$folder/venv/bin/python" -W ignore - <<'PYTHON'
from pathlib import Path

import mujoco
import numpy as np
import pinocchio
import yourdfpy

INERTIAL = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
MODEL = f"""<?xml version="1.0"?>
<robot name="one" version="VERSION">
  <link name="base"/>
  <link name="arm">{INERTIAL}</link>
  <link name="tool">{INERTIAL}</link>
  <joint name="j1" type="revolute">
    <parent link="base"/>
    <child link="arm"/>
    <origin xyz="0.2 0 0" quat_xyzw="0 0 0.7071067811865476 0.7071067811865476"/>
    <axis xyz="0 0 1"/>
    <limit lower="-3" upper="3" effort="1" velocity="1"/>
  </joint>
  <joint name="j2" type="revolute">
    <parent link="arm"/>
    <child link="tool"/>
    <origin xyz="0.1 0 0"/>
    <axis xyz="0 0 1"/>
    <limit lower="-3" upper="3" effort="1" velocity="1"/>
  </joint>
</robot>
"""


def of_pinocchio(path):
    model = pinocchio.buildModelFromUrdf(path)
    data = model.createData()
    pinocchio.framesForwardKinematics(model, data, np.zeros(2))
    return data.oMf[model.getFrameId("tool")].translation


def of_mujoco(path):
    model = mujoco.MjModel.from_xml_path(path)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return data.body("tool").xpos


loaders = {
    "pinocchio": of_pinocchio,
    "MuJoCo": of_mujoco,
    "yourdfpy": lambda path: yourdfpy.URDF.load(path).get_transform("tool", "base")[:3, 3],
}
for version in ("1.1", "1.0"):
    Path("one.urdf").write_text(MODEL.replace("VERSION", version))
    for name, load in loaders.items():
        found = np.round(load("one.urdf"), 6)[:2] + 0.0
        print(f"version {version} {name:9} tool at {found[0]:.1f} {found[1]:.1f} m")
        assert np.allclose(found, (0.2, 0.1) if (version, name) == ("1.1", "pinocchio") else (0.3, 0.0), atol=1e-6)
PYTHON
