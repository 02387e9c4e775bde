"""Open an arm: by the name of a built-in model, from a .toml file, or from a .urdf file.

A .toml file is one of two. It holds a table as data sheets print it, a row for each of four to seven joints, with each
number's unit in its name::

    name = "rokae"
    convention = "modified"        # or "standard"
    [[joint]]                      # four to seven of them
    a_mm = 85.0                    # or a_m; 0 where it is not given
    d_mm = 0.0                     # or d_m
    alpha_deg = -90.0              # or alpha_rad
    offset_deg = -90.0             # or offset_rad: theta = direction q + offset
    direction = 1                  # or -1
    min_deg = -170.0               # or min_rad; limits where they are known
    max_deg = 170.0
    name = "shoulder"

Where one motor moves several joints, ``coupling`` at the top has a row for each joint: what each motor's angle adds to it.
``coupling = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 1, 1, 0], [0, 0, 0, 1]]`` is J3' = J3 + J2 for four joints; min and max are
those of the motors.

Or it is a corrected.toml, as ``armsight identify`` writes it: the identified table with Hayati's angles beta, base and
body. An :class:`Arm` has no room for the error sources beyond the table (gains, waves, backlash, compliance), so the
reader passes over them: the board and :func:`~armsight.loop.identify.corrected.open_corrected` apply those.
"""

from __future__ import annotations

import difflib
import logging
import os
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from armsight.data import Array
from armsight.errors import InputError
from armsight.files import read_toml, require_version
from armsight.geometry.pose import pose
from armsight.geometry.rotation import from_quaternion_wxyz
from armsight.robot.kinematics.arm import Arm, Convention
from armsight.robot.kinematics.table import FEWEST_JOINTS, MOST_JOINTS
from armsight.robot.models import MODELS
from armsight.robot.urdf.read import parse_urdf, read_urdf
from armsight.robot.urdf.write import urdf_text

_LOG = logging.getLogger(__name__)
#: Column of an identified table -> its unit; beta is Hayati's angle.
_COLUMNS = {"offset": "rad", "d": "m", "a": "m", "alpha": "rad", "beta": "rad"}
#: Attribute of an arm that identification leaves as it was -> its unit; corrected.toml has them, so that it is a whole arm.
LIMITS = {"q_min": "rad", "q_max": "rad", "qd_max": "rad_s", "qdd_max": "rad_s2", "qddd_max": "rad_s3", "home": "rad"}
#: How far corrected.toml puts the tool from the nominal arm's all over the joint limits, RMS, and its sigma; m.
MOVED = ("tool_moved_m", "sigma_tool_moved_m")
#: Version of corrected.toml. Version 1, which said no version, had [[cause]] tables and other names of the kinds of
#: gravity; version 2 had no ranges of the readings and no nominal table.
VERSION = 3
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
_LONGEST = 20.0  # a longer link is rejected as a mistake of units, m


def open_arm(name_or_path: str | Path) -> Arm:
    """Return the arm of a built-in model's name, of a .toml file or of a .urdf file.

    ``name_or_path``: such as "six_r", "my_arm.toml", "my_arm.urdf", or "my_arm.urdf#tool0" where the link tool0 is the
    tool; without it the chain's last link is. Raises InputError: the name is unknown (the error lists all that are
    known), the file is unreadable or holds no arm, or a tool link for what is no .urdf file.
    """
    text = str(name_or_path)
    path, link = split_arm(text)
    if path.lower().endswith((".urdf", ".xml")) or ("/" in path and not path.lower().endswith(".toml")):
        return read_urdf(path, tool_link=link)
    if link is not None:
        raise InputError(f"{text}: a link behind # belongs to .urdf files; {path} is none")
    if text.lower().endswith(".toml"):
        return read_arm_toml(text)
    if text not in MODELS:
        near = difflib.get_close_matches(text, MODELS, 2)
        meant = f": did you mean {' or '.join(near)}?" if near else ";"
        raise InputError(f"arm {text!r} is unknown{meant} known are {', '.join(MODELS)}, or give a .toml or .urdf file")
    return MODELS[text]


def split_arm(name_or_path: str) -> tuple[str, str | None]:
    """Return the file or name of an arm, and the link that is its tool, or None: "arm.urdf#tool0" has both."""
    path, mark, link = name_or_path.rpartition("#")
    return (path, link) if mark and link and not os.path.isfile(name_or_path) else (name_or_path, None)


def read_arm_toml(path: str | Path) -> Arm:
    """Read an arm from a TOML file; InputError names a key or number that is not allowed."""
    given = read_toml(path)
    if "identified" in given:
        return _identified(path, given)
    rows = joint_rows(path, given.pop("joint", None))
    name, convention = given.pop("name", Path(path).stem), _convention(path, given.pop("convention", None))
    source, coupling = given.pop("source", str(path)), given.pop("coupling", None)
    if given:
        known = "name, convention, source, coupling, joint"
        raise InputError(f"{path}: unknown key {next(iter(given))!r}; known are {known}")
    read = [_row(f"{path}: joint {i + 1}", row) for i, row in enumerate(rows)]
    at = {key: np.array([row[key] for row in read]) for key in (*_NUMBERS, "direction")}
    return Arm(
        name=str(name),
        a=at["a"],
        d=at["d"],
        alpha=at["alpha"],
        q_min=at["min"],
        q_max=at["max"],
        qd_max=np.full(len(rows), _SPEED),
        qdd_max=np.full(len(rows), _ACCELERATION),
        qddd_max=np.full(len(rows), _JERK),
        offset=at["offset"],
        direction=at["direction"],
        convention=convention,
        coupling=np.eye(len(rows)) if coupling is None else _matrix(path, coupling, len(rows)),
        joint_names=tuple(str(row["name"] or f"joint{i + 1}") for i, row in enumerate(read)),
        source=str(source),
    )


def _convention(path: str | Path, given: object) -> Convention:
    if given not in ("standard", "modified"):
        raise InputError(f'{path}: convention = "standard" or "modified" is needed, got {given!r}')
    return "standard" if given == "standard" else "modified"


def joint_rows(path: str | Path, rows: object) -> list[dict[str, Any]]:
    """Return the [[joint]] tables of an arm's file, or raise InputError: there are too few or too many."""
    there = rows if isinstance(rows, list) and all(isinstance(row, dict) for row in rows) else []
    if not FEWEST_JOINTS <= len(there) <= MOST_JOINTS:
        raise InputError(
            f"{path}: {FEWEST_JOINTS} to {MOST_JOINTS} [[joint]] tables are needed, there are {len(there)}"
        )
    return there


def _matrix(path: str | Path, given: object, joints: int) -> Array:
    """Return a coupling (n, n)."""
    try:
        matrix = np.array(given, dtype=np.float64)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.shape != (joints, joints) or not np.isfinite(matrix).all():
        raise InputError(f"{path}: coupling must be {joints} rows of {joints} numbers, one row for each joint")
    return matrix


def _row(where: str, row: dict[str, Any]) -> dict[str, Any]:
    row = dict(row)
    out: dict[str, Any] = {"name": row.pop("name", None)}
    out["direction"] = _number(where, "direction", row.pop("direction", 1))
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
    """Return the arm of a parsed corrected.toml, its tool the body that the cameras measured; InputError names a key."""
    arm, beta = identified_table(path, given)
    if not beta.any():
        return arm
    return replace(parse_urdf(tilted_urdf(arm, beta), path), source=arm.source)


def identified_table(path: str | Path, given: dict[str, Any]) -> tuple[Arm, Array]:
    """Return the arm of a parsed corrected.toml without Hayati's angles, and these (n,), rad; InputError names a key."""
    require_version(path, "corrected arm", given.get("version"), VERSION)
    rows = joint_rows(path, given.get("joint"))
    at = {column: joint_numbers(path, rows, f"{column}_{unit}") for column, unit in _COLUMNS.items()}
    limits = {key: joint_numbers(path, rows, f"{key}_{unit}") for key, unit in LIMITS.items()}
    arm = Arm(
        name=str(given.get("name", Path(path).stem)),
        a=at["a"],
        d=at["d"],
        alpha=at["alpha"],
        offset=at["offset"],
        direction=joint_numbers(path, rows, "direction"),
        convention=_convention(path, given.get("convention")),
        T_base_0=file_transform(path, given, "T_base_0"),
        T_flange_tool=file_transform(path, given, "T_flange_body"),
        joint_names=tuple(str(row.get("name", f"joint{i + 1}")) for i, row in enumerate(rows)),
        coupling=np.eye(len(rows)) if "coupling" not in given else _matrix(path, given["coupling"], len(rows)),
        source=f"identified: {path}",
        **limits,
    )
    if weak := undetermined(*tool_moved(path, given)):
        _LOG.warning("%s: %s", path, weak)
    return arm, at["beta"]


def tool_moved(path: str | Path, given: dict[str, Any]) -> tuple[float, float]:
    """Return what a corrected.toml says of MOVED, m; NaN where it says nothing, InputError where that is no number."""
    moved, sigma = (_number(str(path), key, given[key]) if key in given else np.nan for key in MOVED)
    return moved, sigma


def undetermined(moved_m: float, sigma_m: float) -> str:
    """Return that poses do not determine an arm all over its joint limits, or "" where they do, or where it is not known.

    The nominal arm is off by moved^2 - sigma^2 on the mean, the corrected one by sigma^2: from here on it is no better.

    ``moved_m``: how far the identified arm puts its tool from the nominal one's, RMS over the joint limits, m; ``sigma_m``:
    sigma of that, m.
    """
    if not 2 * sigma_m**2 > moved_m**2:
        return ""
    return (
        f"no better than the nominal arm away from its poses: it moves the tool by {1e3 * moved_m:.2f} mm there, sigma "
        f"{1e3 * sigma_m:.2f} mm; armsight identify plan chooses more poses"
    )


def joint_numbers(path: str | Path, rows: list[dict[str, Any]], key: str) -> Array:
    """Return a number (n,) that every [[joint]] of a corrected.toml has, or InputError."""
    return np.array([_number(f"{path}: joint {i + 1}", key, row.get(key)) for i, row in enumerate(rows)])


def file_transform(path: str | Path, given: dict[str, Any], name: str) -> Array:
    """Return a pose (4, 4) that a corrected.toml has as a position and a quaternion wxyz, or InputError."""
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
    """Return an arm as URDF text, with Hayati's angles beta (n,), rad, about y after each row of its table, exactly."""
    robot = ET.fromstring(urdf_text(arm))
    modified = arm.convention == "modified"
    for i in range(arm.joints):
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
