"""Exports of motion capture programs: OptiTrack's Motive, Qualisys' QTM, Vicon's Tracker and Nexus.

In: the text of a file. Out: the times and poses of one rigid body under our names. Lines above the names of the columns say
whose they are and in which unit. Quaternions and matrices mean one thing alone, three angles do not: those are rejected.
"""

from __future__ import annotations

import csv
import io
import itertools
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from armsight.errors import InputError
from armsight.tables.lengths import number
from armsight.tables.programs import ProgramPoints

#: The line with the names of the columns.
_HEADER = re.compile(r'^"?Frame"?([,\t;])(?:"?Time|"?Sub Frame).*$', re.MULTILINE)
_POSITION, _QUATERNION = ["x_m", "y_m", "z_m"], ["qx", "qy", "qz", "qw"]
_MATRIX = [f"r{i}{j}" for i in "123" for j in "123"]
_MOTIVE, _QTM, _VICON = "OptiTrack's Motive", "Qualisys' QTM", "Vicon"
#: Program -> what to export with it.
_ADVICE = {
    _MOTIVE: "export CSV with Rigid Bodies, and Rotation Type Quaternion",
    _QTM: "export TSV with 6D data, time and the column header",
    _VICON: "export objects or segments with quaternions, RX RY RZ RW",
}
#: Motive's names of units, and Vicon's.
_UNITS_M = {"meters": 1.0, "centimeters": 0.01, "millimeters": 1e-3, "inches": 0.0254, "m": 1.0, "cm": 0.01, "mm": 1e-3}
_NONE = ("", "null", "nan")  # a cell, in small letters, of a frame in which the body was not seen
_Bodies = dict[str, dict[str, int]]  # name of a body -> our name -> its column
_Line = tuple[int, list[str]]  # its number and its cells


class _Export(NamedTuple):
    """What a file is: whose, the columns of its bodies, the unit of lengths, its lines from which on, frames a second."""

    program: str
    bodies: _Bodies
    unit: str
    lines: list[list[str]]
    first_line: int
    rate_hz: float | None = None  # where the lines have the numbers of frames, and no times


def capture_rows(path: Path, text: str, side: str, whose: str | None) -> ProgramPoints | None:
    """Return the times and poses of a rigid body, without the frames that lack it; None where the text is no such export.

    ``whose``: the name of the body; None: the only one. ``side``: "robot" or "seen", for the option in messages.

    Raises:
        InputError: no rigid body, rotations that are not unambiguous, or several bodies; the program and what to export.
    """
    if (export := _export(text)) is None:
        return None
    program, said = export.program, f"{path}: an export of {export.program}"
    bodies = {name: at for name, at in export.bodies.items() if {*_POSITION} <= set(at)}
    if not bodies:
        raise InputError(f"{said} without the poses of a rigid body: {_ADVICE[program]}")
    first = next(iter(bodies))
    if (name := whose or (first if len(bodies) == 1 else "")) not in bodies:
        option = f"--columns {'' if side == 'robot' else 'seen:'}pose={first}"
        raise InputError(f"{said} with the poses of {', '.join(bodies)}: say which, {option}")
    at = bodies[name]
    rotation = next((names for names in (_QUATERNION, _MATRIX) if set(names) <= set(at)), None)
    if rotation is None:
        raise InputError(f"{said} whose rotations are three numbers: {_ADVICE[program]}")
    if (unit_m := _UNITS_M.get(export.unit.lower())) is None:
        raise InputError(f"{said} with lengths in {export.unit!r}; known are {', '.join(_UNITS_M)}")
    lines = itertools.dropwhile(lambda line: not _is_frame(line), enumerate(export.lines, export.first_line))
    frames = list(itertools.takewhile(_is_frame, lines))  # up to the empty one before what else was exported
    rows = list(_rows(path, export, [at[name] for name in (*_POSITION, *rotation)], unit_m, frames))
    if not rows:
        raise InputError(f"{said}: none of its {len(frames)} frames has a pose of the body")
    note = f"{path}: read as {program}'s, lengths in {export.unit}"
    if len(rows) < len(frames):
        note += f"; the body is in {len(rows)} of {len(frames)} frames, the others are left out"
    return ProgramPoints(["t_s", *_POSITION, *rotation], rows, None, (note,))


def _rows(path: Path, export: _Export, columns: list[int], unit_m: float, frames: list[_Line]) -> Iterator[_Line]:
    """Yield the lines with a time, a position, m, and a rotation of those frames that have the body."""
    for line, row in frames:
        cells = [row[k].strip() if k < len(row) else "" for k in columns]
        if any(cell.lower() in _NONE for cell in cells) or not any(number(cell) != 0 for cell in cells[3:]):
            continue
        p = [unit_m * value for cell in cells[:3] if (value := number(cell)) is not None]
        if len(p) < 3:
            raise InputError(f"{path}: line {line}: {' '.join(cells[:3])[:60]!r} is no position")
        t_s = row[1].strip() if export.rate_hz is None else repr(float(row[0]) / export.rate_hz)
        yield line, [t_s, *map(repr, p), *cells[3:]]


def _export(text: str) -> _Export | None:
    """Return what a text is; None where it is no such export."""
    found = _HEADER.search(text, 0, 200_000)
    end, mark = (found.end(), found[1]) if found is not None else (0, ",")
    *above, head = list(csv.reader(io.StringIO(text[:end]), delimiter=mark)) or [[]]
    lines = list(csv.reader(io.StringIO(text[end + 1 :]), delimiter=mark)) if found is not None else []
    first_line = text.count("\n", 0, end) + 2
    if text.startswith("Format Version,"):
        return _Export(_MOTIVE, *_of_motive(above, head), lines, first_line)
    if text.startswith("NO_OF_FRAMES\t"):
        return _Export(_QTM, _of_qtm(above, head), "mm", lines, first_line)
    if head[1:2] == ["Sub Frame"]:
        rate_hz = number(above[1][0]) if len(above) > 1 and above[1] else None
        return _Export(_VICON, *_of_vicon(above, head, lines), lines, first_line, rate_hz)
    return None


def _is_frame(line: _Line) -> bool:
    return bool(line[1]) and number(line[1][0]) is not None


def _of_motive(above: list[list[str]], head: list[str]) -> tuple[_Bodies, str]:
    """Return the bodies and the unit of Motive's CSV: names and values in line 1, then rows of kinds, names, .., what."""
    bodies: _Bodies = {}
    said = dict(zip(above[0][::2], above[0][1::2], strict=False)) if above else {}
    kinds = next((k for k, row in enumerate(above[:-1]) if "Rigid Body" in row), None)
    if kinds is not None:
        for k, (kind, name, what, axis) in enumerate(
            zip(above[kinds], above[kinds + 1], above[-1], head, strict=False)
        ):
            if kind == "Rigid Body" and axis and what in ("Position", "Rotation"):
                bodies.setdefault(name, {})[f"{axis.lower()}_m" if what == "Position" else f"q{axis.lower()}"] = k
    return bodies, said.get("Length Units", "")


def _of_qtm(above: list[list[str]], head: list[str]) -> _Bodies:
    """Return the bodies of QTM's TSV, mm; Rot[0] .. Rot[8] are a matrix column by column."""
    names = next((row[1:] for row in above if row and row[0] == "BODY_NAMES"), [])
    ours = {axis: f"{axis.lower()}_m" for axis in "XYZ"} | {f"Rot[{i}]": f"r{i % 3 + 1}{i // 3 + 1}" for i in range(9)}
    begins = [k for k, cell in enumerate(head) if cell == "X" or cell.endswith(" X")]
    bodies: _Bodies = {}
    for name, begin, end in zip(names, begins, [*begins[1:], len(head)], strict=False):
        at = {head[k].removeprefix(f"{name} "): k for k in range(begin, end)}
        bodies[name] = {ours[theirs]: k for theirs, k in at.items() if theirs in ours}
    return bodies


def _of_vicon(above: list[list[str]], head: list[str], below: list[list[str]]) -> tuple[_Bodies, str]:
    """Return the objects and the unit of Vicon's CSV: names stand above an object's first column, units beneath all."""
    bodies: _Bodies = {}
    names, name = above[-1] if above else [], ""
    ours = {f"T{axis}": f"{axis.lower()}_m" for axis in "XYZ"} | {f"R{axis}": f"q{axis.lower()}" for axis in "XYZW"}
    for k, cell in enumerate(head):
        name = (names[k] if k < len(names) else "") or name
        if cell in ours:
            bodies.setdefault(name, {})[ours[cell]] = k
    units = [cell for row in below[:1] for cell, theirs in zip(row, head, strict=False) if theirs == "TX"]
    return bodies, units[0] if units else ""
