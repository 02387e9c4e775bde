"""Write an arm as URDF, so that what is read back is the same arm to the last digit.

A link's frame sits at its joint and rotates with it, so that joint i + 1 stands at Rz(offset_i) Tz(d_i) Tx(a_i) Rx(alpha_i)
of link i, which is what a URDF origin holds without loss. Accelerations and jerks stand in ``limit`` as URDF 1.2 has them;
the home pose, the source and what couples motors stand in an element ``armsight`` that other programs ignore.

An arm's table says nothing of shapes, masses and motors, and programs such as MuJoCo and Gazebo need them. So each link is
a solid bar from its joint to the next, with a drum at the joint: both as visuals, and as mass and inertia. The greatest
effort is a multiple of what holds those masses held straight out. These are stand-ins, and the file says so; replace them
before you simulate forces. What armsight reads back does not depend on them.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np

from armsight.data import Array
from armsight.files import write_text
from armsight.geometry.pose import pose
from armsight.robot.kinematics.arm import Arm
from armsight.robot.kinematics.table import exact_cos_sin

#: Radius of the bars, as a share of the arm's length along its links, its bounds, m, and how it shrinks from link to link.
_RADIUS, _THINNEST_M, _THICKEST_M, _TAPER = 0.04, 0.01, 0.08, 0.9
_DENSITY = 1500.0  # density of the bars, kg/m^3: a hollow aluminium casting with its motors
#: Length of a joint's drum, in radii; greatest effort, in torques that hold the straight arm; its least, N m.
_DRUM, _EFFORT, _LEAST_EFFORT_NM = 2.4, 3.0, 1.0
_GRAVITY_M_S2 = 9.81
_INERTIA = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


def urdf_text(arm: Arm) -> str:
    """Return an arm as URDF text."""
    robot = ET.Element("robot", name=arm.name)
    extra = ET.SubElement(robot, "armsight", home_rad=_numbers(arm.home), source=arm.source)
    n = arm.joints
    if (arm.coupling != np.eye(n)).any():
        extra.set("coupling", _numbers(arm.coupling.ravel()))
        robot.append(ET.Comment(" the joints here are behind the motors' coupling; limits are the motors' own "))
    names = ["base", *(f"link{i + 1}" for i in range(n)), "flange", "tool"]
    robot.append(ET.Comment(" masses, inertias, efforts and shapes are stand-ins: the arm's table does not have them "))
    origins = [_origin(arm, i)[0] for i in range(n + 2)]
    radii = _radii(origins)
    for i, name in enumerate(names):
        link = ET.SubElement(robot, "link", name=name)
        if i <= n:
            _solid(link, origins[i], radii[i], moves=i > 0)
    efforts = _efforts(origins, radii)
    for i in range(n + 2):
        fixed = i >= n
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
            "effort": efforts[i],
            "acceleration": arm.qdd_max[i],
            "deceleration": arm.qdd_max[i],
            "jerk": arm.qddd_max[i],
        }
        ET.SubElement(joint, "limit", {key: repr(float(value)) for key, value in limits.items()})
    ET.indent(robot)
    return ET.tostring(robot, encoding="unicode", xml_declaration=False) + "\n"


def _radii(origins: list[Array]) -> list[float]:
    """Return the radius of the bar of each link from the base to the last, m."""
    length = float(sum(np.linalg.norm(origin) for origin in origins))
    first = float(np.clip(_RADIUS * length, _THINNEST_M, _THICKEST_M))
    return [first * _TAPER**i for i in range(len(origins) - 1)]


def _mass(origin: Array, radius: float) -> float:
    """Return the mass of a link, kg: a bar to the next joint, no shorter than a drum."""
    return float(_DENSITY * np.pi * radius**2 * max(float(np.linalg.norm(origin)), _DRUM * radius))


def _efforts(origins: list[Array], radii: list[float]) -> list[float]:
    efforts = []
    for joint in range(len(radii) - 1):
        reach = torque = 0.0
        for i in range(joint + 1, len(radii)):
            length = float(np.linalg.norm(origins[i]))
            torque += _mass(origins[i], radii[i]) * _GRAVITY_M_S2 * (reach + length / 2)
            reach += length
        efforts.append(round(max(_EFFORT * torque, _LEAST_EFFORT_NM), 1))
    return efforts


def _solid(link: ET.Element, origin: Array, radius: float, *, moves: bool) -> None:
    """Give a link its shapes, and one that moves its mass and inertia (of a solid cylinder about its middle)."""
    length = float(np.linalg.norm(origin))
    along = _along(origin) if length > radius else np.zeros(3)
    middle = origin / 2 if length > radius else np.zeros(3)
    if moves:
        mass, tall = _mass(origin, radius), max(length, _DRUM * radius)
        across = mass * (3 * radius**2 + tall**2) / 12
        inertial = ET.SubElement(link, "inertial")
        ET.SubElement(inertial, "origin", xyz=_numbers(middle), rpy=_numbers(along))
        ET.SubElement(inertial, "mass", value=repr(mass))
        moments = {"ixx": across, "iyy": across, "izz": mass * radius**2 / 2}
        ET.SubElement(inertial, "inertia", {key: repr(moments.get(key, 0.0)) for key in _INERTIA})
    cylinders = [(np.zeros(3), np.zeros(3), _DRUM * radius, radius)] if moves else []
    if length > radius:
        cylinders.append((middle, along, length, 0.8 * radius))
    for xyz, rpy, tall, thick in cylinders:
        visual = ET.SubElement(link, "visual")
        ET.SubElement(visual, "origin", xyz=_numbers(xyz), rpy=_numbers(rpy))
        ET.SubElement(ET.SubElement(visual, "geometry"), "cylinder", radius=repr(thick), length=repr(tall))


def _along(vector: Array) -> Array:
    """Return roll, pitch, yaw, rad, of a frame whose z axis is along a vector (3,)."""
    x, y, z = vector
    return np.array([0.0, np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)])


def write_urdf(arm: Arm, path: str | Path) -> None:
    """Write an arm as a URDF file, or raise InputError: it cannot be written."""
    write_text(path, '<?xml version="1.0"?>\n' + urdf_text(arm))


def _origin(arm: Arm, i: int) -> tuple[Array, Array]:
    """Return xyz, m, and roll, pitch, yaw in URDF's order, rad, of joint ``i`` of the written chain."""
    if i in (0, arm.joints + 1):
        T = arm.T_base_0 if i == 0 else arm.T_flange_tool
        if i == 0 and arm.convention == "modified":
            T = T @ _step(0.0, 0.0, arm.a[0], arm.alpha[0])
        return T[:3, 3], roll_pitch_yaw(T[:3, :3])
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


def roll_pitch_yaw(R: Array) -> Array:
    """Return URDF's roll, pitch, yaw, rad, of a rotation (3, 3): R = Rz(yaw) Ry(pitch) Rx(roll), at any pitch."""
    yaw = np.arctan2(R[1, 0], R[0, 0])
    s, c = np.sin(yaw), np.cos(yaw)
    pitch = np.arctan2(-R[2, 0], c * R[0, 0] + s * R[1, 0])
    return np.array([np.arctan2(s * R[0, 2] - c * R[1, 2], c * R[1, 1] - s * R[0, 1]), pitch, yaw])


def _numbers(values: Array) -> str:
    return " ".join(repr(float(value)) for value in values)
