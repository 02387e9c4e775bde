"""Motion files: TOML in, a plan of trajectories out; all of it is checked and planned before the arm moves.

A file has ``start_deg`` (joint angles; default: the arm's home) and one table ``[[motion]]`` a motion. Its ``kind`` is
joints, home, line or circle; ``_KINDS`` lists the keys of each. Lengths are in mm, angles in degrees.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from armsight.data import Array, Record
from armsight.errors import InputError
from armsight.files import read_toml
from armsight.geometry.pose import pose
from armsight.geometry.rotation import exp_so3, from_euler_zyx
from armsight.robot.kinematics.arm import Arm
from armsight.robot.trajectories import Trajectory, circle, line, point_to_point
from armsight.robot.trajectories.circle import TOO_SMALL, ArcPath
from armsight.robot.trajectories.line import LinePath
from armsight.robot.trajectories.resolved_rate import resolved_rate

#: Five poses and home again, a straight line, a circle.
_DEFAULT_ARM, DEFAULT_MOTION = "six_r", Path(__file__).with_name("default_motion.toml")
#: One pose, a line, a circle.
QUICK = Path(__file__).with_name("quick_motion.toml")
_REST_S = 2.0
_MOST = 1e9  # of any number; NaN is not below it
_EACH = -1  # as many values as the arm has joints
#: Kind -> its own keys with the number of values of each, and the keys that are required.
_KINDS: dict[str, tuple[dict[str, int], tuple[str, ...]]] = {
    "joints": ({"q_deg": _EACH}, ("q_deg",)),
    "home": ({}, ()),
    "line": ({"by_mm": 3, "rotation_deg": 3, "to_mm": 3, "euler_zyx_deg": 3}, ()),
    "circle": ({"center_mm": 3, "axis": 3, "angle_deg": 1}, ("center_mm", "axis")),
}
_COMMON = {"kind": 0, "name": 0, "duration_s": 1, "rest_s": 1}
#: Older name of a key -> its name.
_OLD_KEYS = {"roll_pitch_yaw_deg": "euler_zyx_deg", "turn_deg": "rotation_deg"}


def motion_of(arm: str, *, simulated: bool) -> Path | None:
    """Return the file of an arm's own motions, or None; of all but the default arm simulated cameras see other poses."""
    path = DEFAULT_MOTION if arm == _DEFAULT_ARM else DEFAULT_MOTION.with_name(f"{arm}_motion.toml")
    return path if path.exists() and (not simulated or arm == _DEFAULT_ARM) else None


@dataclass(frozen=True, eq=False)
class PlannedMotion(Record):
    """One motion of a run."""

    name: str  #: its name, unique in the run
    kind: str  #: joints, home, line or circle
    trajectory: Trajectory  #: joint angles over time
    rest_s: float  #: how long the arm rests at its end, s


@dataclass(frozen=True, eq=False)
class MotionPlan(Record):
    """The motions of a run."""

    start: Array  #: (n,) joint angles before the first, rad
    motions: tuple[PlannedMotion, ...]  #: one after the other, each from where the one before ends

    @property
    def ends(self) -> Array:
        """(N, n) joint angles of the start and at the end of each motion, rad."""
        return np.array([self.start, *(m.trajectory.at(m.trajectory.duration_s).q for m in self.motions)])


def read_motions(arm: Arm, path: str | Path = DEFAULT_MOTION) -> MotionPlan:
    """Read a motion file and plan all of it for a nominal arm."""
    document = read_toml(path)
    start = _numbers(f"{path}", document.pop("start_deg", np.degrees(arm.home).tolist()), "start_deg", arm.joints)
    entries = document.pop("motion", None)
    if document:
        raise InputError(f"{path}: unknown key {next(iter(document))!r}; known are start_deg and [[motion]]")
    if not isinstance(entries, list) or not entries or not all(isinstance(e, dict) for e in entries):
        raise InputError(f"{path}: no motion; give each as a table [[motion]] with a kind: {', '.join(_KINDS)}")
    q_start = q = np.radians(start)
    motions: list[PlannedMotion] = []
    for number, entry in enumerate(entries, start=1):
        where = f"{path}: motion {number}"
        entry = {_OLD_KEYS.get(key, key): value for key, value in entry.items()}
        motions.append(_motion(where, arm, q, entry, [m.name for m in motions], number))
        q = motions[-1].trajectory.at(motions[-1].trajectory.duration_s).q
    return MotionPlan(q_start, tuple(motions))


def motion_text(kind: str, name: str, keys: Mapping[str, Any]) -> str:
    """Return a motion as a file has it."""
    text = f'\n[[motion]]\nkind = "{kind}"\nname = "{name}"\n'
    for key, value in keys.items():
        number = f"{value:.{1 if key == 'angle_deg' else 4}f}" if np.ndim(value) == 0 else ""
        text += f"{key} = {number or '[' + ', '.join(f'{v:.6f}' for v in value) + ']'}\n"
    return text


def _motion(where: str, arm: Arm, q: Array, entry: dict[str, Any], names: list[str], number: int) -> PlannedMotion:
    kind = entry.get("kind")
    if not isinstance(kind, str) or kind not in _KINDS:
        raise InputError(f"{where}: kind is {kind!r}; known are {', '.join(_KINDS)}")
    keys, needed = _KINDS[kind]
    known = {**_COMMON, **keys}
    for key in entry:
        if key not in known:
            raise InputError(f"{where} ({kind}): unknown key {key!r}; known are {', '.join(known)}")
    for key in needed:
        if key not in entry:
            raise InputError(f"{where} ({kind}): {key} is missing")
    sizes = {key: arm.joints if size == _EACH else size for key, size in known.items()}
    values = {key: _numbers(where, entry[key], key, size) for key, size in sizes.items() if size and key in entry}
    name = entry.get("name", f"{kind} {number}")
    if not isinstance(name, str) or not name or name in names:
        raise InputError(f"{where}: name is {name!r}; every motion needs a name of its own")
    duration = float(values["duration_s"][0]) if "duration_s" in values else None
    rest = float(values["rest_s"][0]) if "rest_s" in values else _REST_S
    if not 0.0 <= rest <= 60.0:
        raise InputError(f"{where}: rest_s is {rest:g}; it must be 0 to 60")
    try:
        trajectory = _planned(where, kind, arm, q, values, duration)
    except InputError as error:
        raise InputError(f"{where} ({name}): {error}" if where not in str(error) else str(error)) from None
    return PlannedMotion(name, kind, trajectory, rest)


def _planned(
    where: str, kind: str, arm: Arm, q: Array, values: dict[str, Array], duration_s: float | None
) -> Trajectory:
    if kind in ("joints", "home"):
        goal = arm.home if kind == "home" else np.radians(values["q_deg"])
        return point_to_point(arm, q, goal, duration_s=duration_s)
    T = arm.forward(q)
    if kind == "line":
        goal = _line_goal(where, T, values)
        if arm.joints < 6:  # the position on the line, the orientation as near as the joints can
            return resolved_rate(arm, q, LinePath.between(T, goal), duration_s=duration_s)
        return line(arm, q, goal, duration_s=duration_s)
    angle = float(np.radians(values["angle_deg"][0])) if "angle_deg" in values else 2 * np.pi
    if arm.joints < 6:
        return resolved_rate(arm, q, _arc(T, 1e-3 * values["center_mm"], values["axis"], angle), duration_s=duration_s)
    return circle(arm, q, 1e-3 * values["center_mm"], values["axis"], angle, duration_s=duration_s)


def _arc(T_base_tool: Array, center_base: Array, axis: Array, angle_rad: float) -> ArcPath:
    """Return the circle about an axis through a point, the tool's orientation kept."""
    length, from_center = float(np.linalg.norm(axis)), T_base_tool[:3, 3] - center_base
    if not np.linalg.norm(np.cross(axis, from_center)) > TOO_SMALL * max(length, TOO_SMALL):
        raise InputError("axis is zero, or the tool is on the circle's axis: there is no circle to travel")
    return ArcPath(T_base_tool, center_base, axis / length * angle_rad, np.zeros(3))


def _line_goal(where: str, T_base_tool: Array, values: dict[str, Array]) -> Array:
    """Return the pose (4, 4) at which a line ends: relative to the tool's pose, or a position in the base frame."""
    if ("by_mm" in values) == ("to_mm" in values):
        raise InputError(f"{where} (line): give either by_mm, a step in the base frame, or to_mm, a position in it")
    if "by_mm" in values:
        R_step = exp_so3(np.radians(values.get("rotation_deg", np.zeros(3))))
        return pose(R_step @ T_base_tool[:3, :3], T_base_tool[:3, 3] + 1e-3 * values["by_mm"])
    R = T_base_tool[:3, :3]
    if "euler_zyx_deg" in values:  # angles about z, y, x, in this order
        R = from_euler_zyx(*np.radians(values["euler_zyx_deg"]))
    return pose(R, 1e-3 * values["to_mm"])


def _numbers(where: str, value: object, key: str, size: int) -> Array:
    listed = value if isinstance(value, list) else [value]
    good = all(isinstance(n, int | float) and not isinstance(n, bool) and abs(n) < _MOST for n in listed)
    if not good or len(listed) != size or isinstance(value, list) != (size > 1):
        raise InputError(f"{where}: {key} must be {f'{size} numbers' if size > 1 else 'a number'}, got {value!r}")
    return np.array(listed, dtype=float)
