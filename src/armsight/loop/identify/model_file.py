"""Read an arm from a TOML file, as it is printed in data sheets: six rows of a table, each number's unit in its name.

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
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np

from armsight.errors import InputError
from armsight.files import read_text
from armsight.loop.identify.identified_file import identified_arm
from armsight.robot.arm import Arm
from armsight.robot.models import open_arm
from armsight.robot.urdf import read_urdf

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
#: What an arm is given where a file says nothing: speeds are not used by what is done with it here.
_SPEED, _ACCELERATION, _JERK = 1.0, 5.0, 50.0
#: The longest link that is believed, m.
_LONGEST = 20.0


def open_model(model: str) -> Arm:
    """Return the arm of a name, a .toml or a .urdf file.

    Raises:
        InputError: unknown, unreadable or not an arm.
    """
    lower = model.lower()
    if lower.endswith(".toml"):
        return read_model(model)
    return read_urdf(model) if lower.endswith((".urdf", ".xml")) or "/" in model else open_arm(model)


def read_model(path: str | Path) -> Arm:
    """Read an arm from a TOML file.

    Raises:
        InputError: unreadable, or a key or number that is not allowed; the message names it.
    """
    try:
        given = tomllib.loads(read_text(path))
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: not TOML: {error}") from None
    if "identified" in given:
        return identified_arm(path, given)
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
