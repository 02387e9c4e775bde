#!/bin/sh
# eaik 1.2.2: the tool of a UrdfRobot is at the file's last joint and parallel to the base at zero angles, not the file's link.
#
# UrdfRobot(path) takes the joints' axes and places from the URDF, and the unit matrix for the orientation at zero: fwdKin
# gives the last link's position with another rotation than the URDF's forward kinematics, and IK takes poses in that frame.
# Solutions of IK for a pose of the URDF's link put the link elsewhere, by the rotation that it has at zero: 90 degrees for
# Universal Robots'. A fixed joint behind the last one, flange or tool, is left out. DhRobot of the same arm gives the
# flange as DH does. Neither README nor docstring names the frame. Multiply poses from the right by the transposed
# rotation of the last link at zero before IK.
#
# Seen, of a UR5, q 0.3 -0.9 1.1 0.4 0.7 -0.5: fwdKin off by 0.0 mm, 90.0 degrees from the last link; 8 solutions for its
# pose, each 90.0 degrees off; with a tool 0.1 m further: off by 100 mm; DhRobot off by 0.0 mm, 0.0 degrees.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.4.6 scipy==1.17.1 eaik==1.2.2 urchin==0.0.30
cd "$folder"
"$folder/venv/bin/python" -W ignore - <<'PYTHON'
from pathlib import Path

import numpy as np
from eaik.IK_DH import DhRobot
from eaik.IK_URDF import UrdfRobot
from scipy.spatial.transform import Rotation

HALF = np.pi / 2
ORIGINS = [  # x y z, m, and roll pitch yaw, rad, of the six joints; all rotate about their z
    ([0, 0, 0.089], [0, 0, 0]),
    ([0, 0, 0], [HALF, 0, 0]),
    ([-0.425, 0, 0], [0, 0, 0]),
    ([-0.392, 0, 0.109], [0, 0, 0]),
    ([0, -0.0947, 0], [HALF, 0, 0]),
    ([0, 0.0823, 0], [HALF, np.pi, np.pi]),
]
JOINT = """<joint name="j{0}" type="revolute"><parent link="l{0}"/><child link="l{1}"/><origin xyz="{2}" rpy="{3}"/>
<axis xyz="0 0 1"/><limit lower="-6.28" upper="6.28" effort="1" velocity="1"/></joint><link name="l{1}"/>"""
TOOL = '<joint name="f" type="fixed"><parent link="l6"/><child link="t"/><origin xyz="0 0 0.1"/></joint><link name="t"/>'
arm = "".join(JOINT.format(i, i + 1, *(" ".join(map(str, each)) for each in origin)) for i, origin in enumerate(ORIGINS))
Path("arm.urdf").write_text(f'<robot name="ur5"><link name="l0"/>{arm}</robot>')
Path("with_tool.urdf").write_text(f'<robot name="ur5"><link name="l0"/>{arm}{TOOL}</robot>')


def moved(xyz, rotation):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation.as_matrix(), xyz
    return T


def link(q):
    """Return the last link's pose by URDF's definition."""
    T = np.eye(4)
    for (xyz, rpy), angle in zip(ORIGINS, q, strict=True):
        T = T @ moved(xyz, Rotation.from_euler("xyz", rpy)) @ moved([0, 0, 0], Rotation.from_rotvec([0, 0, angle]))
    return T


def flange(q, alpha, a, d):
    """Return the flange's pose by Denavit-Hartenberg's definition."""
    T = np.eye(4)
    for each, angle in enumerate(q):
        T = T @ moved([0, 0, d[each]], Rotation.from_rotvec([0, 0, angle]))
        T = T @ moved([a[each], 0, 0], Rotation.from_rotvec([alpha[each], 0, 0]))
    return T


def off(T, other):
    """How far two poses are apart, mm and degrees."""
    rotation = Rotation.from_matrix(T[:3, :3].T @ other[:3, :3])
    return 1000 * np.linalg.norm(T[:3, 3] - other[:3, 3]), np.degrees(rotation.magnitude())


q = np.array([0.3, -0.9, 1.1, 0.4, 0.7, -0.5])
robot = UrdfRobot("arm.urdf")
forward = off(link(q), robot.fwdKin(q))
inverse = np.array([off(link(q), link(solution)) for solution in robot.IK(link(q)).Q])
tool = off(link(q) @ moved([0, 0, 0.1], Rotation.identity()), UrdfRobot("with_tool.urdf").fwdKin(q))
parameters = np.array([HALF, 0, 0, HALF, -HALF, 0]), np.array([0, -0.425, -0.392, 0, 0, 0]), np.array([0.089, 0, 0, 0.109, 0.0947, 0.0823])
by_dh = off(flange(q, *parameters), DhRobot(*parameters).fwdKin(q))
print(f"UrdfRobot.fwdKin off by {forward[0]:.1f} mm, {forward[1]:.1f} degrees; with a tool by {tool[0]:.1f} mm, {tool[1]:.1f} degrees")
print(f"{len(inverse)} solutions of IK, off by {inverse[:, 0].max():.1f} mm, {inverse[:, 1].min():.1f} to {inverse[:, 1].max():.1f} degrees")
print(f"DhRobot off by {by_dh[0]:.1f} mm, {by_dh[1]:.1f} degrees")
assert np.allclose([forward, tool], [(0, 90), (100, 90)], atol=0.01)
assert len(inverse) > 0
assert np.allclose(inverse, [0, 90], atol=0.01)
assert np.allclose(by_dh, 0, atol=1e-5)
# The way around: the frame that is parallel to the base at zero.
solutions = robot.IK(link(q) @ moved([0, 0, 0], Rotation.from_matrix(link(np.zeros(6))[:3, :3]).inv())).Q
assert np.allclose([off(link(q), link(solution)) for solution in solutions], 0, atol=1e-4)
PYTHON
