"""Read an arm from URDF, the XML in which ROS describes robots (wiki.ros.org/urdf/XML).

In: a URDF file with four to seven rotary joints (revolute or continuous) in a row, and fixed ones anywhere; which joints of
its tree are the arm's: :mod:`armsight.robot.urdf.tree`. Masses and shapes are ignored. An origin's rotation is ``rpy``, or
from URDF 1.1 on ``quat_xyzw``: urdfdom 6.0.0 reads that where ``<robot version>`` is 1.1 or later and ignores it where it
is older or missing, so here the latter is rejected. Out: an :class:`Arm` with a standard Denavit-Hartenberg table. What is
written, and where that goes beyond plain URDF, stands in :mod:`armsight.robot.urdf.write`.

From a chain of axes to the table: between two axes in space there is always Rz(beta) Tz(d) Tx(a) Rx(alpha) Tz(e) Rz(gamma):
along the first to the foot of their common normal, over it, and along the second. Rz(gamma) Tz(e) stands at the next
joint's own axis and goes into its offset and d. What is free (either sense of the normal, its position between parallel
axes) is chosen so that gamma and e vanish where they can, which gives a table back that was written as URDF.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from itertools import dropwhile
from pathlib import Path
from typing import NamedTuple

import numpy as np

from armsight.data import Array
from armsight.errors import InputError
from armsight.files import read_text
from armsight.geometry.pose import pose
from armsight.geometry.rotation import exp_so3, from_quaternion_wxyz
from armsight.robot.kinematics.arm import Arm
from armsight.robot.kinematics.table import exact_cos_sin
from armsight.robot.urdf.tree import MOVING, Joint, Tree
from armsight.tables.lengths import REACH, fitting_unit, metric

#: What an arm is given where its URDF has no accelerations and jerks: full speed in 0.25 s, full acceleration in 0.1 s.
TO_SPEED_S, TO_ACCELERATION_S = 0.25, 0.1
EXACT = 1e-9  # two frames differ by rounding below this, m and rad: numbers written with ten digits
#: A common normal further away than this many times the chain's length leaves no digits to hold the chain exactly. Nearer
#: ones do: an identified arm's axes are a little off parallel, and are meant to be.
FAR = 1e6
PROBES = 16  # random poses at which the table is compared with the chain
#: A continuous joint has no limits: here it goes a revolution either way, at this speed where the file gives none, rad/s.
_REVOLUTION, _SPEED = 2 * np.pi, 1.0
#: The largest angle of an origin, rad: none writes two revolutions; half: some write one; double: 20 deg passes.
_MOST_RPY = 4 * np.pi


def read_urdf(path: str | Path, *, tool_link: str | None = None) -> Arm:
    """Read an arm from a URDF file, with a standard table; ``tool_link`` is needed where several end the chain.

    InputError: unreadable, malformed, no chain of four to seven revolute joints, or one that no table holds exactly.
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
    version = re.fullmatch(r"([0-9]{1,9})\.([0-9]{1,9})", robot.get("version", "1.0"))
    quaternions = version is not None and tuple(map(int, version.groups())) >= (1, 1)
    joints = [_joint(path, element, quaternions) for element in robot.findall("joint")]
    chain = Tree(path, [element.get("name") for element in robot.findall("link")], joints).chain(tool_link)
    _check_units(path, list(dropwhile(lambda joint: not joint.rotary, chain)))
    return _arm(path, robot, chain, [joint for joint in chain if joint.rotary])


def _check_units(path: str | Path, chain: list[Joint]) -> None:
    """Reject an arm whose lengths cannot be metres, or whose angles cannot be radians, which URDF's are."""
    for joint in chain:
        where, origin = f"{path}: joint {joint.name!r}", joint.element.find("origin")
        xyz, rpy = (_vector(where, origin, key, "0 0 0") for key in ("xyz", "rpy"))
        if (length := float(np.linalg.norm(xyz))) > REACH.most_m:
            unit = fitting_unit(length, 1.0, REACH)
            raise InputError(
                f"{where}: its <origin> is {metric(length)} from its parent; expected are metres, at most {REACH.most_m:g}"
                + (f": these look like {unit}; write metres" if unit else "")
            )
        if (angle := float(np.abs(rpy).max())) > _MOST_RPY:
            raise InputError(f"{where}: its <origin> has the angle {angle:g} in rpy; expected are radians: write these")


def _joint(path: str | Path, element: ET.Element, quaternions: bool) -> Joint:
    """Read what every joint has; ``quaternions``: the file's version has them."""
    name = element.get("name")
    if name is None:
        raise InputError(f"{path}: a <joint> has no name")
    kind, where = element.get("type", ""), f"{path}: joint {name!r}"
    if kind not in (*MOVING, "fixed"):
        raise InputError(f"{where}: type {kind!r} is unknown; known are {', '.join((*MOVING, 'fixed'))}")
    links = []
    for tag in ("parent", "child"):
        found = element.find(tag)
        link = None if found is None else found.get("link")
        if link is None:
            raise InputError(f'{where}: no <{tag} link="...">')
        links.append(link)
    origin = element.find("origin")
    xyz, rpy = (_vector(where, origin, key, "0 0 0") for key in ("xyz", "rpy"))
    R = rotation_of(rpy)
    if origin is not None and "quat_xyzw" in origin.attrib:
        if "rpy" in origin.attrib or not quaternions:
            raise InputError(
                f'{where}: <origin> has quat_xyzw, which needs <robot version="1.1"> or later and no rpy beside it: other '
                "programs would read another rotation"
            )
        q = _vector(where, origin, "quat_xyzw", "0 0 0 1")
        if not q.any():
            raise InputError(f"{where}: <origin> has a quat_xyzw of length zero")
        R = from_quaternion_wxyz(q[[3, 0, 1, 2]])
    return Joint(name, kind, links[0], links[1], pose(R, xyz), element)


def rotation_of(rpy: Array) -> Array:
    """Return the rotation of URDF's roll, pitch, yaw, exact at multiples of 90 degrees."""
    (cx, cy, cz), (sx, sy, sz) = exact_cos_sin(rpy)
    Rz = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1.0]])
    Ry = np.array([[cy, 0, sy], [0, 1.0, 0], [-sy, 0, cy]])
    Rx = np.array([[1.0, 0, 0], [0, cx, -sx], [0, sx, cx]])
    return np.asarray(Rz @ Ry @ Rx)


def _vector(where: str, element: ET.Element | None, key: str, default: str) -> Array:
    text = default if element is None else element.get(key, default)
    tag = "" if element is None else element.tag
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.zeros(0)
    if len(values) != len(default.split()) or not np.isfinite(values).all():
        raise InputError(f'{where}: <{tag} {key}="{text}"> must be {len(default.split())} numbers')
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


def _arm(path: str | Path, robot: ET.Element, chain: list[Joint], revolute: list[Joint]) -> Arm:
    links = [ChainLink(np.eye(4), np.zeros(3))]
    for joint in chain:
        if joint.rotary:
            axis = _vector(f"{path}: joint {joint.name!r}", joint.element.find("axis"), "xyz", "1 0 0")
            length = float(np.linalg.norm(axis))
            if length == 0:
                raise InputError(f"{path}: joint {joint.name!r}: <axis> is zero; it must be a direction")
            links[-1] = ChainLink(links[-1].T_before @ joint.T_parent_joint, axis / length)
            links.append(ChainLink(np.eye(4), np.zeros(3)))
        else:
            links[-1] = ChainLink(links[-1].T_before @ joint.T_parent_joint, np.zeros(3))
    first_fixed = chain[chain.index(revolute[-1]) + 1].T_parent_joint if chain[-1] is not revolute[-1] else np.eye(4)
    rows = arm_rows(f"{path}", [joint.name for joint in revolute], links, first_fixed)
    extra = robot.find("armsight")
    limits = [_limits(f"{path}: joint {joint.name!r}", joint.element) for joint in revolute]
    q_min, q_max, qd, qdd, qddd = (np.array(column) for column in zip(*limits, strict=True))
    joints = len(revolute)
    home = np.zeros(joints) if extra is None else _written(f"{path}: <armsight>", extra, "home_rad", joints)
    matrix = extra is not None and extra.get("coupling") is not None
    coupling = (
        _written(f"{path}: <armsight>", extra, "coupling", joints**2)
        if extra is not None and matrix
        else np.eye(joints)
    )
    try:
        arm = Arm(
            name=robot.get("name", "") or Path(path).stem,
            q_min=q_min,
            q_max=q_max,
            qd_max=qd,
            qdd_max=qdd,
            qddd_max=qddd,
            home=home,
            **rows._asdict(),
            joint_names=tuple(joint.name for joint in revolute),
            coupling=coupling.reshape(joints, joints),
            source=(extra.get("source", "") if extra is not None else "") or f"URDF {Path(path).name}",
        )
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    check_same(f"{path}", arm, links)
    return arm


def _written(where: str, element: ET.Element, key: str, count: int) -> Array:
    """Read so many numbers of an attribute that :mod:`armsight.robot.urdf.write` writes."""
    text = element.get(key, "")
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.zeros(0)
    if values.shape != (count,) or not np.isfinite(values).all():
        raise InputError(f'{where}: {key}="{text}" must be {count} numbers')
    return values


def _limits(where: str, element: ET.Element) -> tuple[float, float, float, float, float]:
    """Read lower, upper, speed, acceleration and jerk of a joint."""
    limit = element.find("limit")
    if element.get("type") == "continuous":
        speed = (None if limit is None else _number(where, limit, "velocity")) or _SPEED
        return -_REVOLUTION, _REVOLUTION, speed, speed / TO_SPEED_S, speed / TO_SPEED_S / TO_ACCELERATION_S
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


class ChainLink(NamedTuple):
    """A joint of the chain, or its end."""

    T_before: Array  #: (4, 4) where the joint stands in the frame that rotates with the joint before
    axis: Array  #: (3,) its unit axis there; zero for the chain's end


class TableRows(NamedTuple):
    """A standard table with what stands before and after it, as in :class:`Arm`."""

    a: Array
    d: Array
    alpha: Array
    offset: Array
    direction: Array
    T_base_0: Array
    T_flange_tool: Array


class Decomposition(NamedTuple):
    """A transform as Rz(beta) Tz(d) Tx(a) Rx(alpha) Tz(e) Rz(gamma), rad and m."""

    beta: float
    d: float
    a: float
    alpha: float
    e: float
    gamma: float


def arm_rows(where: str, names: list[str], links: list[ChainLink], first_fixed: Array) -> TableRows:
    """Find the table of a chain of n joints and its end, n + 1 links; ``where`` is for errors.

    ``first_fixed`` (4, 4): the first fixed joint after the last revolute one: the flange, where it can be row 6.
    InputError: two axes are so nearly parallel that no sensible table holds them.
    """
    size_m = float(sum(np.linalg.norm(link.T_before[:3, 3]) for link in links)) + EXACT
    upright = [_upright(link.axis) for link in links]
    between = [np.linalg.inv(upright[i][0]) @ links[i + 1].T_before @ upright[i + 1][0] for i in range(len(links) - 2)]
    steps = []
    for i, C in enumerate(between):
        steps.append(decompose(C))
        if max(abs(steps[-1].d), abs(steps[-1].e)) > FAR * size_m:
            apart = abs(np.degrees(np.arctan2(np.hypot(C[0, 2], C[1, 2]), abs(C[2, 2]))))
            raise InputError(
                f"{where}: the axes of joints {names[i]!r} and {names[i + 1]!r} are {apart:.2g} deg from parallel, "
                "which no table holds sensibly; were angles rounded? write pi/2 as 1.5707963267948966"
            )
    after = np.linalg.inv(upright[-2][0])
    last = decompose(after @ first_fixed)
    if abs(last.e) > EXACT or abs(last.gamma) > EXACT:
        last = Decomposition(0, 0, 0, 0, 0, 0)
    steps.append(last)
    carried = [0.0, *(step.gamma for step in steps[:-1])], [0.0, *(step.e for step in steps[:-1])]
    flange = after @ links[-1].T_before
    return TableRows(
        np.array([step.a for step in steps]),
        np.array([step.d for step in steps]) + carried[1],
        np.array([step.alpha for step in steps]),
        _wrapped(np.array([step.beta for step in steps]) + carried[0]),
        np.array([way for _, way in upright[:-1]]),
        links[0].T_before @ upright[0][0],
        np.linalg.inv(_motion(last)) @ flange,
    )


def check_same(where: str, arm: Arm, links: list[ChainLink]) -> None:
    """Compare an arm with the chain it was read from, or raise InputError: they differ by more than rounding."""
    for q in np.random.default_rng(0).uniform(-np.pi, np.pi, (PROBES, arm.joints)):
        T = np.eye(4)
        for link, angle in zip(links, [*(arm.coupling @ q), 0.0], strict=True):
            T = T @ link.T_before @ pose(exp_so3(link.axis * angle), np.zeros(3))
        off = float(np.abs(arm.forward(q) - T).max())
        if off > EXACT:
            raise InputError(
                f"{where}: no table holds this chain exactly: the nearest is {off:.2g} m or rad off; are angles such "
                "as pi/2 rounded? write them as 1.5707963267948966"
            )


def decompose(C: Array) -> Decomposition:
    """Split a transform (4, 4) between two joints whose axes are z."""
    x, y, z = C[:3, 3]
    sine = float(np.hypot(C[0, 2], C[1, 2]))
    if sine < EXACT:
        return _parallel(C)
    options = []
    for sense in (1.0, -1.0):
        beta = float(np.arctan2(sense * C[0, 2], -sense * C[1, 2]))
        c, s = np.cos(beta), np.sin(beta)
        alpha = float(np.arctan2(sense * sine, C[2, 2]))
        e = float((s * x - c * y) / (sense * sine))
        gamma = _gamma(C, beta, alpha)
        options.append(Decomposition(beta, float(z - e * C[2, 2]), float(c * x + s * y), alpha, e, gamma))
    return min(options, key=lambda step: (abs(step.gamma) > EXACT, abs(step.beta)))


def _parallel(C: Array) -> Decomposition:
    """Split a transform between parallel axes; e is chosen as 0."""
    x, y, z = C[:3, 3]
    alpha = 0.0 if C[2, 2] > 0 else np.pi
    whole = float(np.arctan2(C[1, 0], C[0, 0]))  # what stays when gamma is 0
    foot = float(np.arctan2(y, x))
    for beta in (whole, foot, foot - np.copysign(np.pi, foot)):
        c, s = np.cos(beta), np.sin(beta)
        if abs(c * y - s * x) < EXACT:
            break
    return Decomposition(beta, float(z), float(c * x + s * y), alpha, 0.0, _gamma(C, beta, alpha))


def _gamma(C: Array, beta: float, alpha: float) -> float:
    R = _motion(Decomposition(beta, 0, 0, alpha, 0, 0))[:3, :3].T @ C[:3, :3]
    return float(np.arctan2(R[1, 0], R[0, 0]))


def _motion(step: Decomposition) -> Array:
    """Return Rz(beta) Tz(d) Tx(a) Rx(alpha), without what comes after."""
    R = exp_so3(np.array([[0, 0, step.beta], [step.alpha, 0, 0]]))
    return pose(R[0] @ R[1], R[0] @ np.array([step.a, 0, 0]) + np.array([0, 0, step.d]))


def _upright(axis: Array) -> tuple[Array, float]:
    """Return a rotation (4, 4) W and a direction with W z direction = axis; none where the axis is z or -z, or zero."""
    if not axis.any() or np.hypot(axis[0], axis[1]) < EXACT**1.5:
        return np.eye(4), -1.0 if axis[2] < 0 else 1.0
    rotation = np.array([-axis[1], axis[0], 0.0])
    size = np.linalg.norm(rotation)
    return pose(exp_so3(rotation / size * np.arctan2(size, axis[2])), np.zeros(3)), 1.0


def _wrapped(angle: Array) -> Array:
    """Return angles within (-pi, pi], half a revolution as +pi."""
    wrapped = np.remainder(angle + np.pi, 2 * np.pi) - np.pi
    return np.where(np.abs(wrapped + np.pi) < EXACT, np.pi, wrapped)
