"""Calibrated tables of single arms, as their makers' ROS drivers keep them: Universal Robots' and UFACTORY's YAML.

Both are one form: ``kinematics:`` with x, y, z, m, and roll, pitch, yaw, rad, for every joint: where its frame stands in
the frame of the joint before; it rotates about its z axis. UR's joints are called shoulder, upper_arm, forearm and wrist_1
to wrist_3 (``ur_calibration``, beside a ``hash``), the xArm's joint1 to joint7 (``gen_kinematics_params.py``). UR's
controller keeps ``calibration.conf``: delta_theta, delta_a, delta_d, delta_alpha, m and rad, are added to the table.

In: such a file and the nominal arm, whose limits, names and tool hold. Out: an :class:`Arm`, exactly, axes that are a
little off parallel included. And back: any arm, such as an identified one, as such a file, its joints' frames as near to
those of the nominal table as its axes allow; and how far the two arms put their tools apart.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from armsight.data import Array
from armsight.errors import InputError
from armsight.files import read_text, read_toml, write_text
from armsight.geometry.pose import inverse, pose
from armsight.geometry.rotation import log_so3
from armsight.robot.arm_file import file_transform
from armsight.robot.kinematics.arm import Arm
from armsight.robot.urdf.read import ChainLink, arm_rows, check_same, rotation_of
from armsight.robot.urdf.write import roll_pitch_yaw
from armsight.tables.document import read_yaml

#: What Universal Robots call their joints here.
UR_NAMES = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
_KEYS = ("x", "y", "z", "roll", "pitch", "yaw")
#: Seeded poses within the limits over which two arms are compared, and a tool further off than this is not of this arm, m.
_POSES, _FAR_M = 1000, 0.1


class Difference(NamedTuple):
    """How far apart two arms put their tools at the same joint angles, over poses within the limits."""

    mean_m: float  #: mean distance, m
    most_m: float  #: greatest, m
    mean_rad: float  #: mean angle between the tools, rad
    most_rad: float  #: greatest, rad
    #: (n,) what the second arm's link lengths are more, m; NaN where a row's axes are no longer parallel or have become
    #: so, and lengths cannot be compared
    a_m: Array
    d_m: Array  #: (n,) link offsets likewise, m
    alpha_rad: Array  #: (n,) twists, rad
    offset_rad: Array  #: (n,) zeros, rad


def read_calibration(path: str | Path, nominal: Arm) -> Arm:
    """Return a single arm as a YAML or .conf file has it; ``nominal`` is the maker's table of this kind of arm.

    InputError: unreadable, not of this form or not of this arm; the message names the joint.
    """
    if Path(path).suffix.lower() == ".conf":
        return _checked(path, nominal, _with_deltas(path, nominal))
    links = [ChainLink(T, np.array([0.0, 0.0, 1.0])) for T in _origins(path, nominal)]
    links.append(ChainLink(nominal.T_flange_tool, np.zeros(3)))
    rows = arm_rows(f"{path}", list(nominal.joint_names), links, np.eye(4))
    arm = replace(
        nominal,
        name=f"{nominal.name}_calibrated",
        convention="standard",
        **rows._asdict(),
        source=f"calibration {Path(path).name}; nominal: {nominal.source}",
    )
    check_same(f"{path}", arm, links)
    return _checked(path, nominal, arm)


def _checked(path: str | Path, nominal: Arm, arm: Arm) -> Arm:
    """Return an arm if it is about the nominal one."""
    if (far := difference(nominal, arm).mean_m) > _FAR_M:
        raise InputError(
            f"{path}: its tool is {1e3 * far:.0f} mm from that of {nominal.name} on the mean: is it the calibration of "
            "another kind of arm, or in mm?"
        )
    return arm


def _with_deltas(path: str | Path, nominal: Arm) -> Arm:
    """Return the nominal arm with what UR's calibration.conf adds to its table, m and rad."""
    lines = dict(re.findall(r"^\s*(\w+)\s*=\s*\[([^\]]*)\]", read_text(path), re.MULTILINE))
    if _names(nominal) != UR_NAMES:
        raise InputError(f"{path}: a .conf is a calibration of Universal Robots; {nominal.name} is none of theirs")
    added = {}
    for row, key in {"offset": "theta", "a": "a", "d": "d", "alpha": "alpha"}.items():
        try:
            added[row] = np.array([float(cell) for cell in lines[f"delta_{key}"].split(",")])
        except (KeyError, ValueError):
            added[row] = np.zeros(0)
        if added[row].shape != (nominal.joints,) or not np.isfinite(added[row]).all():
            raise InputError(
                f"{path}: holds {', '.join(lines) or 'no lists'}; expected delta_{key} = [{nominal.joints} numbers], as in "
                "UR's calibration.conf"
            )
    return replace(
        nominal,
        name=f"{nominal.name}_calibrated",
        source=f"calibration {Path(path).name}; nominal: {nominal.source}",
        **{row: getattr(nominal, row) + delta for row, delta in added.items()},
    )


def _origins(path: str | Path, nominal: Arm) -> list[Array]:
    """Return where each joint's frame stands in that of the joint before (4, 4)."""
    document = read_yaml(path)
    kinematics = document.get("kinematics")
    if not isinstance(kinematics, Mapping):
        held = ", ".join(map(str, list(document)[:6])) or "nothing"
        raise InputError(f"{path}: holds {held}; expected kinematics:, as ur_calibration and xarm_ros write them")
    names = _names(nominal)
    missing = [name for name in names if not isinstance(kinematics.get(name), Mapping)]
    if missing:
        there = ", ".join(str(name) for name in kinematics)
        raise InputError(
            f"{path}: kinematics: {missing[0]} is missing; {nominal.name} has {', '.join(names)}, there are {there}"
        )
    if f"joint{len(names) + 1}" in kinematics:
        raise InputError(f"{path}: kinematics: has joint{len(names) + 1}; {nominal.name} has {len(names)} joints")
    out = []
    for name in names:
        values = [kinematics[name].get(key) for key in _KEYS]
        for key, value in zip(_KEYS, values, strict=True):
            if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
                raise InputError(f"{path}: kinematics: {name}: {key} is {value!r}, must be a number")
        x, y, z, *angles = values
        out.append(pose(rotation_of(np.array(angles)), np.array([x, y, z])))
    return out


def _names(arm: Arm) -> tuple[str, ...]:
    return (
        UR_NAMES
        if arm.joint_names[0] == "shoulder_pan" and arm.joints == 6
        else tuple(f"joint{i + 1}" for i in range(arm.joints))
    )


def calibration_text(arm: Arm, nominal: Arm) -> tuple[str, float, float]:
    """Return an arm as a YAML file of its maker's, with the frames of the nominal one, and what that cannot hold.

    That is by how much the file's flange is off the arm's, m and rad: zero where axis n goes through the origin of the
    flange along its z, as in the makers' tables. InputError: another number of joints, a joint that rotates the other
    way, or coupled motors.
    """
    if arm.joints != nominal.joints:
        raise InputError(f"{arm.name} has {arm.joints} joints, {nominal.name} {nominal.joints}")
    if ((arm.direction < 0).any() and (nominal.direction > 0).all()) or (arm.coupling != np.eye(arm.joints)).any():
        raise InputError(f"{arm.name}: such a file cannot hold joints that rotate the other way, or coupled motors")
    frames, before = _frames(arm, nominal), np.eye(4)
    lines = ["kinematics:"]
    for name, F in zip(_names(nominal), frames, strict=True):
        T = inverse(before) @ F
        lines.append(f"  {name}:")
        for key, value in zip(_KEYS, (*T[:3, 3], *roll_pitch_yaw(T[:3, :3])), strict=True):
            lines.append(f"    {key}: {float(value)!r}")
        before = F
    if _names(nominal) == UR_NAMES:
        lines.append("  hash: armsight")
    left = inverse(frames[-1]) @ arm.links(np.zeros(arm.joints))[-2]
    return "\n".join(lines) + "\n", float(np.linalg.norm(left[:3, 3])), float(np.linalg.norm(log_so3(left[:3, :3])))


def write_calibration(arm: Arm, nominal: Arm, path: str | Path) -> tuple[float, float]:
    """Write an arm as a calibration file; arguments and what is rerotated as of :func:`calibration_text`."""
    text, off_m, off_rad = calibration_text(arm, nominal)
    write_text(path, text)
    return off_m, off_rad


def _axes(arm: Arm) -> tuple[Array, Array]:
    """Return points on the joints' axes and their directions (n, 3), base, with all joints at zero."""
    T, modified = arm.links(np.zeros(arm.joints)), arm.convention == "modified"
    frames = T[1:-1] if modified else T[:-2]
    return frames[:, :3, 3], frames[:, :3, 2] * arm.direction[:, None]


def _frames(arm: Arm, nominal: Arm) -> list[Array]:
    """Return the joints' frames (4, 4) at zero, on the axes of an arm, else as near as can be to the nominal ones."""
    T, zero = nominal.links(np.zeros(nominal.joints)), np.zeros(3)
    out = []
    for i, (point, z) in enumerate(zip(*_axes(arm), strict=True)):
        if nominal.convention == "modified":
            c, s = np.cos(nominal.offset[i]), np.sin(nominal.offset[i])
            F = T[i + 1] @ pose(np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]]), zero)
        else:
            F = T[i] @ pose(np.eye(3), np.array([0.0, 0.0, nominal.d[i]]))
        if i == arm.joints - 1:
            F = arm.links(np.zeros(arm.joints))[-2]  # the last frame is the flange
        origin = point + z * (z @ (F[:3, 3] - point))
        x = F[:3, 0] - z * (z @ F[:3, 0])
        x /= np.linalg.norm(x)
        out.append(pose(np.stack([x, np.cross(z, x), z], axis=1), origin))
    return out


def with_tool_of(arm: Arm, path: str | Path, nominal: Arm) -> Arm:
    """Return the arm of a corrected.toml, whose tool is the measured body, with the nominal arm's tool on its flange."""
    T_flange_body = file_transform(path, read_toml(path), "T_flange_body")
    return replace(arm, T_flange_tool=arm.T_flange_tool @ inverse(T_flange_body) @ nominal.T_flange_tool)


def difference(first: Arm, second: Arm) -> Difference:
    """Return how far apart two arms of the same joints (else InputError) put their tools."""
    if first.joints != second.joints:
        raise InputError(f"{first.name} has {first.joints} joints, {second.name} {second.joints}")
    q = np.random.default_rng(0).uniform(first.q_min, first.q_max, (_POSES, first.joints))
    A, B = first.forward(q), second.forward(q)
    far = np.linalg.norm(A[:, :3, 3] - B[:, :3, 3], axis=1)
    rotated = np.linalg.norm(log_so3(np.swapaxes(A[:, :3, :3], 1, 2) @ B[:, :3, :3]), axis=1)
    changes = {name: getattr(second, name) - getattr(first, name) for name in ("a", "d", "alpha", "offset")}
    for name in ("alpha", "offset"):
        changes[name] = np.remainder(changes[name] + np.pi, 2 * np.pi) - np.pi
    parallel = [np.abs(np.sin(arm.alpha)) < 1e-12 for arm in (first, second)]
    unlike = (parallel[0] != parallel[1]) | (first.convention != second.convention)
    unlike = unlike | np.append(False, unlike[:-1])  # the next row takes back what a far normal put into this one
    rows = [np.where(unlike, np.nan, changes[name]) for name in ("a", "d", "alpha", "offset")]
    return Difference(float(far.mean()), float(far.max()), float(rotated.mean()), float(rotated.max()), *rows)
