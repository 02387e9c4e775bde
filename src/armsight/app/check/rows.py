"""What a test of ISO 9283 attained, row by row: read from a CSV and written as one (columns: docs/howto/iso9283.md)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from armsight.data import Array, Record
from armsight.errors import NAMED, InputError
from armsight.files import table_text
from armsight.geometry.pose import pose
from armsight.geometry.rotation import from_quaternion_wxyz, quaternion_wxyz
from armsight.tables.cells import read_columns
from armsight.tables.columns import Columns

TESTS = ("pose", "path", "circle")
_TEXTS = ("test", "pose", "cycle", "approach")
_POSITION, _QUATERNION = ("x_m", "y_m", "z_m"), ("qw", "qx", "qy", "qz")
_COMMAND = tuple(f"command_{name}" for name in (*_POSITION, *_QUATERNION))
_SIGMA, _COMMON = (tuple(f"{kind}_{name}" for name in _POSITION) for kind in ("sigma", "sigma_common"))
NEEDED = ("pose", *_POSITION, *_COMMAND[:3])
#: Groups of columns: a row has all of a group or none of it.
_TOGETHER = (_QUATERNION, _COMMAND[3:], _SIGMA, _COMMON)
#: Half of the rows further off their commands than this, m, are an error: units or frames are mixed up.
_FAR_M = 0.1
#: Commands of one pose differ by rounding at most: by this much, m, and in their rotation matrices.
SAME_M = 1e-5
_NUMBERS = ("t_s", *_POSITION, *_QUATERNION, *_COMMAND, *_SIGMA, *_COMMON)
_COLUMNS = (*_TEXTS, *_NUMBERS)


@dataclass(frozen=True, eq=False)
class Row(Record):
    """One attained pose."""

    test: str  #: pose, path or circle
    pose: str  #: its name; on a path the number of the path point, on a circle the angle, deg
    cycle: str  #: which repetition
    approach: str  #: where the arm came from; of a path its name; on a circle 1 counter-clockwise, -1 clockwise
    t_s: float | None  #: when, s; None where that is not known
    T: Array  #: (4, 4) attained, base
    T_command: Array  #: (4, 4) commanded
    cov: Array  #: (3, 3) covariance of the position by the instrument, base's axes, m^2: what differs from row to row
    cov_common: Array  #: (3, 3) that of the instrument's constant error
    measured_rotation: bool = True  #: whether the attained rotation is known
    commanded_rotation: bool = True  #: whether the commanded rotation is known


class Reversal(NamedTuple):
    """Joints reverse on the circle."""

    joints: tuple[int, ...]  #: their numbers, from 1
    way: float  #: 1 counter-clockwise, -1 clockwise
    p: Array  #: (3,) where the tool is commanded then, base, m


class Attained(NamedTuple):
    """What a test attained."""

    rows: list[Row]  #: all that is evaluated
    notes: list[str]  #: what was left out, as text
    reversals: list[Reversal]  #: where joints reverse on the circle, as far as that is known


def read_rows(file: Path, columns: str | None = None) -> list[Row]:
    """Read a CSV; ``columns``: what they are called there, as --columns has it; None where they have our names."""
    table = Columns.of_csv(file, read_columns(columns, _COLUMNS))
    if not table.at:
        raise InputError(f"{file}: empty; a first line of column names is needed")
    missing = [name for name in NEEDED if name not in table.at]
    if missing:
        hint = "; of a run give the folder" if "phase" in table.at else ""
        raise InputError(f"{file}: line 1: column {missing[0]} is missing; needed are {', '.join(NEEDED)}{hint}")
    known = [name for name in _NUMBERS if name in table.at]
    numbers, texts = table.numbers(known, empty=True), zip(*map(table.texts, _TEXTS), strict=True)
    rows = list[Row]()
    for (line, _), values, cells in zip(table.rows, numbers, texts, strict=True):
        given = {name: float(value) for name, value in zip(known, values, strict=True) if not np.isnan(value)}
        rows.append(_row(f"{file}: line {line}", dict(zip(_TEXTS, cells, strict=True)), given))
    if not rows:
        raise InputError(f"{file}: no rows; one line an attained pose is needed")
    _require_sense(file, rows)
    return rows


def _require_sense(file: Path, rows: list[Row]) -> None:
    """Raise InputError where rows cannot be what an arm attained: twice the same, or nowhere near the commands."""
    seen: set[tuple[object, ...]] = set()
    sent: dict[str, Array] = {}
    for row in rows:
        what = (row.test, row.pose, row.cycle, row.approach, row.t_s, *row.T[:3].ravel())
        if row.cycle and what in seen:
            raise InputError(f"{file}: pose {row.pose} stands there twice, in cycle {row.cycle}, to the last digit")
        seen.add(what)
        apart = row.T_command - sent.setdefault(row.pose, row.T_command) if row.test == "pose" else np.zeros(1)
        if np.abs(apart).max() > SAME_M:
            raise InputError(f"{file}: pose {row.pose} has several commands; give each position a name of its own")
    off_m = float(np.median([np.linalg.norm(row.T[:3, 3] - row.T_command[:3, 3]) for row in rows]))
    if off_m > _FAR_M:
        mend = "both must be in m, in one frame, and each column under its own name"
        raise InputError(f"{file}: half of the rows are more than {1e3 * off_m:.0f} mm from their commands: {mend}")


def _row(where: str, entries: dict[str, str], numbers: dict[str, float]) -> Row:
    test = entries["test"] or "pose"
    if test not in TESTS:
        raise InputError(f"{where}: test is {test!r}; known are {', '.join(TESTS)}")
    if not entries["pose"]:
        raise InputError(f"{where}: pose is empty; it needs a name")
    if empty := [name for name in NEEDED[1:] if name not in numbers]:
        raise InputError(f"{where}: {empty[0]} is empty")
    for part in _TOGETHER:
        lost = [name for name in part if name not in numbers]
        if 0 < len(lost) < len(part):
            raise InputError(f"{where}: {lost[0]} is missing, though others of {', '.join(part)} are there")
    sigmas = {name: numbers.get(name, 0.0) for name in (*_SIGMA, *_COMMON)}
    if below := [name for name, sigma in sigmas.items() if sigma < 0.0]:
        raise InputError(f"{where}: {below[0]} is {sigmas[below[0]]:g}; a standard deviation is never below zero")
    Ts = [_pose(where, numbers, prefix) for prefix in ("", "command_")]
    covs = [np.diag([sigmas[name] ** 2 for name in names]) for names in (_SIGMA, _COMMON)]
    name, cycle, approach = (entries[key] for key in _TEXTS[1:])
    known, known_ref = _QUATERNION[0] in numbers, _COMMAND[3] in numbers
    t_s = numbers.get("t_s")
    return Row(test, name, cycle, approach, t_s, Ts[0], Ts[1], covs[0], covs[1], known, known_ref)


def _pose(where: str, numbers: dict[str, float], prefix: str) -> Array:
    """Return a pose (4, 4); without a rotation it has that of the base."""
    q = np.array([numbers.get(prefix + name, float(name == "qw")) for name in _QUATERNION])
    if not 0.999 < (length := np.linalg.norm(q)) < 1.001:
        raise InputError(f"{where}: quaternion {prefix}qw .. {prefix}qz has length {length:.4g}, not 1")
    return pose(from_quaternion_wxyz(q / length), np.array([numbers[prefix + name] for name in _POSITION]))


def first_few(notes: list[str], what: str) -> list[str]:
    """Return the first notes on what was left out, and how many more there are."""
    more = [f"left out: {len(notes) - NAMED} more {what}"] if len(notes) > NAMED else []
    return notes[:NAMED] + more


def rows_csv(rows: list[Row]) -> str:
    """Return rows as the CSV that they can be read from again; of a covariance its diagonal."""
    out = []
    for row in rows:
        entries = [row.test, row.pose, row.cycle, row.approach, "" if row.t_s is None else f"{row.t_s:.6f}"]
        numbers: list[float | None] = []
        for T, known in ((row.T, row.measured_rotation), (row.T_command, row.commanded_rotation)):
            numbers += [*T[:3, 3], *(quaternion_wxyz(T[:3, :3]) if known else [None] * len(_QUATERNION))]
        numbers += [*np.sqrt(np.diag(row.cov)), *np.sqrt(np.diag(row.cov_common))]
        out.append(entries + ["" if number is None else f"{number:.9f}" for number in numbers])
    return table_text(_COLUMNS, out)
