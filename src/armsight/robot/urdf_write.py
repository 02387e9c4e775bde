"""Write an arm as URDF, so that what is read back is the same arm to the last digit.

A link's frame sits at its joint and rotates with it, so that joint i + 1 stands at Rz(offset_i) Tz(d_i) Tx(a_i) Rx(alpha_i)
of link i, which is what a URDF origin holds without loss. Accelerations and jerks stand in ``limit`` as URDF 1.2 has them;
the home pose and the source stand in an element ``armsight`` that other programs ignore. Efforts are not known: 0.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np

from armsight.data import Array
from armsight.files import write_text
from armsight.geometry.pose import pose
from armsight.robot.arm import Arm
from armsight.robot.kinematics.table import exact_cos_sin


def urdf_text(arm: Arm) -> str:
    """Return an arm as URDF text."""
    robot = ET.Element("robot", name=arm.name)
    ET.SubElement(robot, "armsight", home_rad=_numbers(arm.home), source=arm.source)
    names = ["base", *(f"link{i}" for i in range(1, 7)), "flange", "tool"]
    for name in names:
        ET.SubElement(robot, "link", name=name)
    for i in range(8):
        fixed = i >= 6
        name = f"{names[i]}-{names[i + 1]}" if fixed else arm.joint_names[i]
        joint = ET.SubElement(robot, "joint", name=name, type="fixed" if fixed else "revolute")
        ET.SubElement(joint, "parent", link=names[i])
        ET.SubElement(joint, "child", link=names[i + 1])
        xyz, rpy = _origin(arm, i)
        ET.SubElement(joint, "origin", xyz=_numbers(xyz), rpy=_numbers(rpy))
        if fixed:
            continue
        ET.SubElement(joint, "axis", xyz=f"0 0 {arm.direction[i]:.0f}")
        limits = {
            "lower": arm.q_min[i],
            "upper": arm.q_max[i],
            "velocity": arm.qd_max[i],
            "effort": 0.0,  # not known, and the format asks for it
            "acceleration": arm.qdd_max[i],
            "deceleration": arm.qdd_max[i],
            "jerk": arm.qddd_max[i],
        }
        ET.SubElement(joint, "limit", {key: repr(float(value)) for key, value in limits.items()})
    ET.indent(robot)
    return ET.tostring(robot, encoding="unicode", xml_declaration=False) + "\n"


def write_urdf(arm: Arm, path: str | Path) -> None:
    """Write an arm as a URDF file.

    Raises:
        InputError: it cannot be written.
    """
    write_text(path, '<?xml version="1.0"?>\n' + urdf_text(arm))


def _origin(arm: Arm, i: int) -> tuple[Array, Array]:
    """Return xyz, m, and roll, pitch, yaw in URDF's order, rad, of joint ``i`` of the written chain."""
    if i in (0, 7):
        T = arm.T_base_0 if i == 0 else arm.T_flange_tool
        if i == 0 and arm.convention == "modified":
            T = T @ _step(0.0, 0.0, arm.a[0], arm.alpha[0])
        return T[:3, 3], _roll_pitch_yaw(T[:3, :3])
    a, alpha = (
        (arm.a, arm.alpha) if arm.convention == "standard" else (np.append(x[1:], 0.0) for x in (arm.a, arm.alpha))
    )
    cos, sin = exact_cos_sin(arm.offset[i - 1 : i])
    xyz = np.array([a[i - 1] * cos[0], a[i - 1] * sin[0], arm.d[i - 1]])
    return xyz, np.array([alpha[i - 1], 0.0, arm.offset[i - 1]])


def _step(offset: float, d: float, a: float, alpha: float) -> Array:
    """Return Rz(offset) Tz(d) Tx(a) Rx(alpha)."""
    (cz, cx), (sz, sx) = exact_cos_sin(np.array([offset, alpha]))
    R = np.array([[cz, -sz * cx, sz * sx], [sz, cz * cx, -cz * sx], [0.0, sx, cx]])
    return pose(R, np.array([a * cz, a * sz, d]))


def _roll_pitch_yaw(R: Array) -> Array:
    """Return URDF's roll, pitch, yaw, rad, of a rotation (3, 3): R = Rz(yaw) Ry(pitch) Rx(roll), at any pitch."""
    yaw = np.arctan2(R[1, 0], R[0, 0])
    s, c = np.sin(yaw), np.cos(yaw)
    pitch = np.arctan2(-R[2, 0], c * R[0, 0] + s * R[1, 0])
    return np.array([np.arctan2(s * R[0, 2] - c * R[1, 2], c * R[1, 1] - s * R[0, 1]), pitch, yaw])


def _numbers(values: Array) -> str:
    return " ".join(repr(float(value)) for value in values)
