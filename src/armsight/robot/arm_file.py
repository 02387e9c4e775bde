"""Open an arm: by the name of a built-in model, from a .toml file, or from a .urdf file.

A .toml file is one of two. It holds a table as data sheets print it, six rows with each number's unit in its name::

    name = "rokae"
    convention = "modified"        # or "standard"
    [[joint]]                      # six of them
    a_mm = 85.0                    # or a_m; 0 where it is not given
    d_mm = 0.0                     # or d_m
    alpha_deg = -90.0              # or alpha_rad
    offset_deg = -90.0             # or offset_rad: theta = direction q + offset
    direction = 1                  # or -1
    min_deg = -170.0               # or min_rad; limits where they are known
    max_deg = 170.0
    name = "shoulder"

Or it is a corrected.toml, as ``armsight identify`` writes it: the identified table with Hayati's angles beta, base and
body. An :class:`Arm` has no room for the error sources beyond the table (gains, waves, backlash, compliance), so the
reader passes over them: the board and :func:`~armsight.loop.identify.corrected.open_corrected` apply those.
"""

from __future__ import annotations

import tomllib
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from armsight.data import Array
from armsight.errors import InputError
from armsight.files import read_text
from armsight.geometry.pose import pose
from armsight.geometry.rotation import from_quaternion_wxyz
from armsight.robot.arm import Arm
from armsight.robot.models import MODELS
from armsight.robot.urdf import parse_urdf, read_urdf
from armsight.robot.urdf_write import urdf_text

#: Column of an identified table -> its unit; beta is Hayati's angle.
_COLUMNS = {"offset": "rad", "d": "m", "a": "m", "alpha": "rad", "beta": "rad"}
#: Attribute of an arm that identification leaves as it was -> its unit; corrected.toml has them, so that it is a whole arm.
LIMITS = {"q_min": "rad", "q_max": "rad", "qd_max": "rad_s", "qdd_max": "rad_s2", "qddd_max": "rad_s3", "home": "rad"}
_UNITS = {"mm": 1e-3, "m": 1.0, "deg": np.pi / 180, "rad": 1.0}
#: What a row may hold: name -> its units, and the value where it is not given.
_NUMBERS: dict[str, tuple[tuple[str, str], float]] = {
    "a": (("mm", "m"), 0.0),
    "d": (("mm", "m"), 0.0),
    "alpha": (("deg", "rad"), 0.0),
    "offset": (("deg", "rad"), 0.0),
    "min": (("deg", "rad"), -2 * np.pi),
    "max": (("deg", "rad"), 2 * np.pi),
}
#: Limits of speed (rad/s), acceleration and jerk of every joint, for a table that gives none.
_SPEED, _ACCELERATION, _JERK = 1.0, 5.0, 50.0
#: A longer link is rejected as a mistake of units, m.
_LONGEST = 20.0


def open_arm(name_or_path: str | Path, *, tool_link: str | None = None) -> Arm:
    """Return the arm of a built-in model's name, of a .toml file or of a .urdf file.

    Args:
        name_or_path: such as "six_r", "my_arm.toml" or "my_arm.urdf".
        tool_link: the link of a .urdf file that is the tool; None: the chain's last.

    Raises:
        InputError: the name is unknown, the file is unreadable or holds no arm, or a tool link for what is no .urdf file.
    """
    text = str(name_or_path)
    if text.lower().endswith((".urdf", ".xml")) or ("/" in text and not text.lower().endswith(".toml")):
        return read_urdf(text, tool_link=tool_link)
    if tool_link is not None:
        raise InputError(f"--tool-link belongs to .urdf files; {text} is none")
    if text.lower().endswith(".toml"):
        return read_arm_toml(text)
    if text not in MODELS:
        raise InputError(f"arm {text!r} is unknown; known are {', '.join(MODELS)}, or give a .toml or .urdf file")
    return MODELS[text]


def parsed_toml(path: str | Path) -> dict[str, Any]:
    """Return what a TOML file holds.

    Raises:
        InputError: unreadable, or not TOML.
    """
    try:
        return tomllib.loads(read_text(path))
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: not TOML: {error}") from None


def read_arm_toml(path: str | Path) -> Arm:
    """Read an arm from a TOML file.

    Raises:
        InputError: unreadable, or a key or number that is not allowed; the message names it.
    """
    given = parsed_toml(path)
    if "identified" in given:
        return _identified(path, given)
    rows = given.pop("joint", None)
    if not isinstance(rows, list) or len(rows) != 6 or not all(isinstance(row, dict) for row in rows):
        raise InputError(
            f"{path}: six [[joint]] tables are needed, there are {len(rows) if isinstance(rows, list) else 0}"
        )
    name, convention = given.pop("name", Path(path).stem), given.pop("convention", None)
    if convention not in ("standard", "modified"):
        raise InputError(f'{path}: convention = "standard" or "modified" is needed, got {convention!r}')
    source = given.pop("source", str(path))
    if given:
        raise InputError(f"{path}: unknown key {next(iter(given))!r}; known are name, convention, source, joint")
    read = [_row(f"{path}: joint {i + 1}", row) for i, row in enumerate(rows)]
    at = {key: np.array([row[key] for row in read]) for key in (*_NUMBERS, "direction")}
    return Arm(
        name=str(name),
        a=at["a"],
        d=at["d"],
        alpha=at["alpha"],
        q_min=at["min"],
        q_max=at["max"],
        qd_max=np.full(6, _SPEED),
        qdd_max=np.full(6, _ACCELERATION),
        qddd_max=np.full(6, _JERK),
        offset=at["offset"],
        direction=at["direction"],
        convention="standard" if convention == "standard" else "modified",
        joint_names=tuple(str(row["name"] or f"joint{i + 1}") for i, row in enumerate(read)),
        source=str(source),
    )


def _row(where: str, row: dict[str, Any]) -> dict[str, Any]:
    """Read one joint, in SI."""
    row = dict(row)
    out: dict[str, Any] = {
        "name": row.pop("name", None),
        "direction": _number(where, "direction", row.pop("direction", 1)),
    }
    for key, (units, default) in _NUMBERS.items():
        given = [unit for unit in units if f"{key}_{unit}" in row]
        if len(given) > 1:
            raise InputError(f"{where}: {key} is given twice, in {' and '.join(given)}")
        out[key] = default
        if given:
            out[key] = _number(where, f"{key}_{given[0]}", row.pop(f"{key}_{given[0]}")) * _UNITS[given[0]]
    if row:
        known = ", ".join(f"{key}_{unit}" for key, (units, _) in _NUMBERS.items() for unit in units)
        raise InputError(f"{where}: unknown key {next(iter(row))!r}; known are {known}, direction, name")
    for key in ("a", "d"):
        if abs(out[key]) > _LONGEST:
            raise InputError(f"{where}: {key} is {out[key]:g} m; are these mm? write {key}_mm")
    return out


def _number(where: str, key: str, value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise InputError(f"{where}: {key} is {value!r}, must be a number")
    return float(value)


def _identified(path: str | Path, given: dict[str, Any]) -> Arm:
    """Return the arm of a parsed corrected.toml; its tool is the body that the cameras measured.

    Raises:
        InputError: something is missing, or no number; the message names it.
    """
    arm, beta = identified_table(path, given)
    if not beta.any():
        return arm
    return replace(parse_urdf(tilted_urdf(arm, beta), path), source=arm.source)


def identified_table(path: str | Path, given: dict[str, Any]) -> tuple[Arm, Array]:
    """Return the arm of a parsed corrected.toml without Hayati's angles, and these angles (6,), rad.

    Raises:
        InputError: something is missing, or no number; the message names it.
    """
    rows = given.get("joint")
    if not isinstance(rows, list) or len(rows) != 6 or not all(isinstance(row, dict) for row in rows):
        raise InputError(f"{path}: six [[joint]] tables are needed")
    at = {column: joint_numbers(path, rows, f"{column}_{unit}") for column, unit in _COLUMNS.items()}
    limits = {key: joint_numbers(path, rows, f"{key}_{unit}") for key, unit in LIMITS.items()}
    convention = given.get("convention")
    if convention not in ("standard", "modified"):
        raise InputError(f'{path}: convention = "standard" or "modified" is needed, got {convention!r}')
    arm = Arm(
        name=str(given.get("name", Path(path).stem)),
        a=at["a"],
        d=at["d"],
        alpha=at["alpha"],
        offset=at["offset"],
        direction=joint_numbers(path, rows, "direction"),
        convention="modified" if convention == "modified" else "standard",
        T_base_0=file_transform(path, given, "T_base_0"),
        T_flange_tool=file_transform(path, given, "T_flange_body"),
        joint_names=tuple(str(row.get("name", f"joint{i + 1}")) for i, row in enumerate(rows)),
        source=f"identified: {path}",
        **limits,
    )
    return arm, at["beta"]


def joint_numbers(path: str | Path, rows: list[dict[str, Any]], key: str) -> Array:
    """Return a number (6,) that every [[joint]] of a corrected.toml has.

    Raises:
        InputError: it is missing, or no number.
    """
    out = np.empty(6)
    for i, row in enumerate(rows):
        value = row.get(key)
        if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
            raise InputError(f"{path}: joint {i + 1}: {key} is {value!r}, must be a number")
        out[i] = value
    return out


def file_transform(path: str | Path, given: dict[str, Any], name: str) -> Array:
    """Return a pose (4, 4) that a corrected.toml has as a position and a quaternion wxyz.

    Raises:
        InputError: it is missing, or no pose.
    """
    try:
        p, q = (np.array(given[name][key], float) for key in ("position_m", "quaternion_wxyz"))
    except (KeyError, TypeError, ValueError):
        p, q = np.zeros(0), np.zeros(0)
    if p.shape != (3,) or q.shape != (4,) or not np.isfinite([*p, *q]).all() or abs(np.linalg.norm(q) - 1) > 1e-6:
        raise InputError(
            f"{path}: {name} = {{ position_m = [3 numbers], quaternion_wxyz = [4, of length 1] }} is needed"
        )
    return pose(from_quaternion_wxyz(q / np.linalg.norm(q)), p)


def tilted_urdf(arm: Arm, beta: Array) -> str:
    """Return an arm as URDF text, with Hayati's angles beta (6,), rad, about y after each row of its table, exactly."""
    robot = ET.fromstring(urdf_text(arm))
    modified = arm.convention == "modified"
    for i in range(6):
        joint = i if modified else i + 1  # the URDF joint whose origin holds row i's angles
        if beta[i] == 0.0:
            continue
        origin = robot.findall("joint")[joint].find("origin")
        if origin is None:
            raise InputError(f"{arm.name}: a URDF joint has no origin")
        before = Rotation.from_euler("xyz", [float(angle) for angle in origin.get("rpy", "").split()])
        tilted = (before * Rotation.from_euler("y", beta[i])).as_euler("xyz")
        origin.set("rpy", " ".join(repr(float(angle)) for angle in tilted))
    ET.indent(robot)
    return '<?xml version="1.0"?>\n' + ET.tostring(robot, encoding="unicode") + "\n"
