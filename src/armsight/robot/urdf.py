"""Read an arm from URDF, the XML in which ROS describes robots (wiki.ros.org/urdf/XML).

Six revolute joints in a row are read, with fixed ones anywhere; anything else that moves is refused by name. Masses and
shapes are passed over. The table is found by :mod:`armsight.robot.urdf_table`; what is written, and where that goes beyond
plain URDF, stands in :mod:`armsight.robot.urdf_write`.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from armsight.data import Array
from armsight.errors import InputError
from armsight.files import read_text
from armsight.geometry.pose import pose
from armsight.robot.arm import Arm
from armsight.robot.kinematics.table import exact_cos_sin
from armsight.robot.urdf_table import Link, arm_rows, check_same

#: What an arm is given where its URDF has no accelerations and jerks: full speed in 0.25 s, full acceleration in 0.1 s.
TO_SPEED_S, TO_ACCELERATION_S = 0.25, 0.1
_MOVING = ("revolute", "continuous", "prismatic", "floating", "planar")


class _Joint(NamedTuple):
    """A joint element: its name, type, links, where it stands, and itself."""

    name: str
    kind: str
    parent: str
    child: str
    T_parent_joint: Array
    element: ET.Element


def read_urdf(path: str | Path, *, tool_link: str | None = None) -> Arm:
    """Read an arm from a URDF file.

    Args:
        path: the file.
        tool_link: the link that is the tool; needed where several end the chain.

    Returns:
        The arm, with a standard table.

    Raises:
        InputError: unreadable, malformed, no chain of six revolute joints, or one that no table holds exactly.
    """
    return parse_urdf(read_text(path), path, tool_link=tool_link)


def parse_urdf(text: str, path: str | Path, *, tool_link: str | None = None) -> Arm:
    """Read an arm from URDF text; ``path`` is named in errors. Else as :func:`read_urdf`."""
    try:
        robot = ET.fromstring(text)
    except ET.ParseError as error:
        raise InputError(f"{path}: not XML: {error}") from None
    if robot.tag != "robot":
        raise InputError(f"{path}: the outermost element is <{robot.tag}>, must be <robot>")
    if any("xacro" in element.tag for element in robot.iter() if isinstance(element.tag, str)):
        raise InputError(f"{path}: holds xacro macros; expand them first: xacro {Path(path).name} > arm.urdf")
    joints = [_joint(path, element) for element in robot.findall("joint")]
    chain = _chain(path, robot, joints, tool_link)
    turning = [joint for joint in chain if joint.kind == "revolute"]
    return _arm(path, robot, chain, turning)


def _joint(path: str | Path, element: ET.Element) -> _Joint:
    """Read what every joint has."""
    name = element.get("name")
    if name is None:
        raise InputError(f"{path}: a <joint> has no name")
    kind, where = element.get("type", ""), f"{path}: joint {name!r}"
    if kind not in (*_MOVING, "fixed"):
        raise InputError(f"{where}: type {kind!r} is unknown; known are {', '.join((*_MOVING, 'fixed'))}")
    links = []
    for tag in ("parent", "child"):
        found = element.find(tag)
        link = None if found is None else found.get("link")
        if link is None:
            raise InputError(f'{where}: no <{tag} link="...">')
        links.append(link)
    origin = element.find("origin")
    xyz, rpy = (_vector(where, origin, key, "0 0 0") for key in ("xyz", "rpy"))
    T = pose(_rotation(rpy), xyz)
    return _Joint(name, kind, links[0], links[1], T, element)


def _rotation(rpy: Array) -> Array:
    """Return the rotation of URDF's roll, pitch, yaw, exact at multiples of 90 degrees."""
    (cx, cy, cz), (sx, sy, sz) = exact_cos_sin(rpy)
    Rz = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1.0]])
    Ry = np.array([[cy, 0, sy], [0, 1.0, 0], [-sy, 0, cy]])
    Rx = np.array([[1.0, 0, 0], [0, cx, -sx], [0, sx, cx]])
    return np.asarray(Rz @ Ry @ Rx)


def _vector(where: str, element: ET.Element | None, key: str, default: str) -> Array:
    """Read three numbers of an attribute."""
    text = default if element is None else element.get(key, default)
    tag = "" if element is None else element.tag
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.zeros(0)
    if values.shape != (3,) or not np.isfinite(values).all():
        raise InputError(f'{where}: <{tag} {key}="{text}"> must be three numbers')
    return values


def _number(where: str, element: ET.Element, key: str) -> float | None:
    """Read one number of an attribute; None where it is not there."""
    text = element.get(key)
    if text is None:
        return None
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise InputError(f'{where}: <{element.tag} {key}="{text}"> must be a number')
    return value


def _chain(path: str | Path, robot: ET.Element, joints: list[_Joint], tool_link: str | None) -> list[_Joint]:
    """Return the joints from the base to the tool."""
    links = [element.get("name") for element in robot.findall("link")]
    called: dict[str, list[str | None]] = {"links": links, "joints": [joint.name for joint in joints]}
    for kind, names in called.items():
        if twice := [name for name in names if names.count(name) > 1]:
            raise InputError(f"{path}: two {kind} are called {twice[0]!r}")
    above: dict[str, _Joint] = {}
    for joint in joints:
        for link in (joint.parent, joint.child):
            if link not in links:
                raise InputError(f"{path}: joint {joint.name!r}: there is no link {link!r}")
        if joint.child in above:
            raise InputError(
                f"{path}: link {joint.child!r} hangs on two joints, {above[joint.child].name!r} and {joint.name!r}"
            )
        above[joint.child] = joint
    refused = [j for j in joints if j.kind in _MOVING[1:] or j.element.find("mimic") is not None]
    if refused:
        told = ", ".join(f"{j.name!r} is {'a mimic' if j.kind == 'revolute' else j.kind}" for j in refused)
        raise InputError(f"{path}: only arms of six revolute joints are read here; {told}")
    turning = [joint.name for joint in joints if joint.kind == "revolute"]
    if len(turning) != 6:
        raise InputError(f"{path}: {len(turning)} revolute joints ({', '.join(turning)}); an arm here has six")
    parents = {joint.parent for joint in joints}
    ends = {link: list(_up(path, link, above)) for link in above if link not in parents or link == tool_link}
    whole = {link: chain for link, chain in ends.items() if sum(joint.kind == "revolute" for joint in chain) == 6}
    if tool_link is not None and tool_link not in whole:
        raise InputError(
            f"{path}: link {tool_link!r} is not behind all six joints; these are: {', '.join(whole) or 'none'}"
        )
    if not whole:
        raise InputError(f"{path}: the six revolute joints do not follow one another; only serial arms are read here")
    if tool_link is None and len(whole) > 1:
        raise InputError(f"{path}: several links end the chain ({', '.join(whole)}); say which one is the tool")
    chain = whole[tool_link or next(iter(whole))]
    return chain[::-1]


def _up(path: str | Path, link: str, above: dict[str, _Joint]) -> Iterator[_Joint]:
    """Yield the joints from a link up to the base."""
    seen = set()
    while link in above:
        if link in seen:
            raise InputError(f"{path}: link {link!r} hangs on itself")
        seen.add(link)
        yield above[link]
        link = above[link].parent


def _arm(path: str | Path, robot: ET.Element, chain: list[_Joint], turning: list[_Joint]) -> Arm:
    """Put an arm together from its chain."""
    links = [Link(np.eye(4), np.zeros(3))]
    for joint in chain:
        if joint.kind == "revolute":
            axis = _vector(f"{path}: joint {joint.name!r}", joint.element.find("axis"), "xyz", "1 0 0")
            length = float(np.linalg.norm(axis))
            if length == 0:
                raise InputError(f"{path}: joint {joint.name!r}: <axis> is zero; it must be a direction")
            links[-1] = Link(links[-1].T_before @ joint.T_parent_joint, axis / length)
            links.append(Link(np.eye(4), np.zeros(3)))
        else:
            links[-1] = Link(links[-1].T_before @ joint.T_parent_joint, np.zeros(3))
    first_fixed = chain[chain.index(turning[-1]) + 1].T_parent_joint if chain[-1] is not turning[-1] else np.eye(4)
    rows = arm_rows(f"{path}", [joint.name for joint in turning], links, first_fixed)
    extra = robot.find("armsight")
    limits = [_limits(f"{path}: joint {joint.name!r}", joint.element) for joint in turning]
    q_min, q_max, qd, qdd, qddd = (np.array(column) for column in zip(*limits, strict=True))
    home = np.zeros(6) if extra is None else _home(f"{path}: <armsight>", extra)
    try:
        arm = Arm(
            name=robot.get("name", "") or Path(path).stem,
            a=rows.a,
            d=rows.d,
            alpha=rows.alpha,
            offset=rows.offset,
            direction=rows.direction,
            q_min=q_min,
            q_max=q_max,
            qd_max=qd,
            qdd_max=qdd,
            qddd_max=qddd,
            home=home,
            T_base_0=rows.T_base_0,
            T_flange_tool=rows.T_flange_tool,
            joint_names=tuple(joint.name for joint in turning),
            source=(extra.get("source", "") if extra is not None else "") or f"URDF {Path(path).name}",
        )
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    check_same(f"{path}", arm, links)
    return arm


def _home(where: str, element: ET.Element) -> Array:
    """Read the home pose."""
    text = element.get("home_rad", "")
    try:
        home = np.array([float(word) for word in text.split()])
    except ValueError:
        home = np.zeros(0)
    if home.shape != (6,) or not np.isfinite(home).all():
        raise InputError(f'{where}: home_rad="{text}" must be six numbers')
    return home


def _limits(where: str, element: ET.Element) -> tuple[float, float, float, float, float]:
    """Read lower, upper, speed, acceleration and jerk of a joint."""
    limit = element.find("limit")
    if limit is None:
        raise InputError(f"{where}: no <limit>; a revolute joint needs lower, upper and velocity")
    low, high = (_number(where, limit, key) or 0.0 for key in ("lower", "upper"))
    if not low < high:
        raise InputError(f"{where}: <limit> goes from lower={low:g} to upper={high:g}; upper must be more than lower")
    found = [_number(where, limit, key) for key in ("velocity", "acceleration", "deceleration", "jerk")]
    for key, value in zip(("velocity", "acceleration", "deceleration", "jerk"), found, strict=True):
        if value is not None and value <= 0:
            raise InputError(f"{where}: <limit> {key}={value:g} must be more than 0")
    if found[0] is None:
        raise InputError(f"{where}: <limit> has no velocity")
    speed = found[0]
    acceleration = min((value for value in found[1:3] if value is not None), default=speed / TO_SPEED_S)
    return low, high, speed, acceleration, found[3] or acceleration / TO_ACCELERATION_S
