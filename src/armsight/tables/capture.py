"""Exports of motion capture programs: OptiTrack's Motive, Qualisys' QTM, Vicon's Tracker and Nexus.

In: the text of a file. Out: the times and poses of one rigid body under our names. Lines above the names of the columns say
whose they are and in which unit. Quaternions and matrices mean one thing alone, three angles do not: those are rejected.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from armsight.errors import InputError, some
from armsight.tables.lengths import NO_NUMBER, number
from armsight.tables.nested import PREFIX
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
_Bodies = dict[str, dict[str, int]]  # name of a body -> our name -> its column
_Line = tuple[int, list[str]]  # its number and its cells


class _Export(NamedTuple):
    """What a file is: whose, the columns of its bodies, the unit of lengths, its frames, frames a second."""

    program: str
    bodies: _Bodies
    unit: str
    frames: list[_Line]
    rate_hz: float | None = None  # where the lines have the numbers of frames, and no times


def capture_rows(path: Path, text: str, side: str, whose: str | None) -> ProgramPoints | None:
    """Return the times and poses of a rigid body; None where the text is no such export.

    The cells of frames that lack it are empty; lines that are damaged are left out, and named.

    ``whose``: the name of the body; None: the only one. ``side``: "robot" or "seen", for the option in messages.

    Raises:
        InputError: no rigid body, rotations that are not unambiguous, or several bodies; the program and what to export.
            Frames without a rate, or none that is readable.
    """
    if (export := _export(path, text)) is None:
        return None
    program, said = export.program, f"{path}: an export of {export.program}"
    at = _body(said, export, side, whose)
    rotation = next((names for names in (_QUATERNION, _MATRIX) if set(names) <= set(at)), None)
    if rotation is None:
        raise InputError(f"{said} whose rotations are three numbers: {_ADVICE[program]}")
    if (unit_m := _UNITS_M.get(export.unit.lower())) is None:
        raise InputError(f"{said} with lengths in {export.unit!r}; known are {', '.join(_UNITS_M)}")
    columns = [at[name] for name in (*_POSITION, *rotation)]
    read = [(line, _pose(row, columns, unit_m, export.rate_hz)) for line, row in export.frames]
    rows = [(line, cells) for line, cells in read if cells]
    if not rows:
        raise InputError(f"{said}: none of its {len(read)} frames is readable: export it again")
    note = f"{path}: read as {program}'s, lengths in {export.unit}"
    if damaged := [str(line) for line, cells in read if not cells]:
        note += f"; damaged: line {some(damaged)}"
    return ProgramPoints(["t_s", *_POSITION, *rotation], rows, None, (note,))


def _body(said: str, export: _Export, side: str, whose: str | None) -> dict[str, int]:
    """Return the columns of the body ``whose``, or of the only one; InputError as :func:`capture_rows`."""
    bodies = {name: at for name, at in export.bodies.items() if {*_POSITION} <= set(at)}
    if not bodies:
        raise InputError(f"{said} without the poses of a rigid body: {_ADVICE[export.program]}")
    first = next(iter(bodies))
    if (name := whose or (first if len(bodies) == 1 else "")) not in bodies:
        option = f"--columns {PREFIX[side]}pose={first}"
        raise InputError(f"{said} with the poses of {', '.join(bodies)}: say which, {option}")
    return bodies[name]


def _pose(row: list[str], columns: list[int], unit_m: float, rate_hz: float | None) -> list[str] | None:
    """Return a frame's time, position, m, and rotation, empty without the body; None where the line is damaged."""
    cells = [row[k] if k < len(row) else "" for k in columns]
    seen = [cell for cell in cells if cell.lower() not in NO_NUMBER]
    found = [value for cell in (*row[:2], *seen) if (value := number(cell)) is not None and math.isfinite(value)]
    if len(found) < 2 + len(seen):
        return None
    t_s = found[1] if rate_hz is None else found[0] / rate_hz
    if len(seen) < len(cells) or not any(found[5:]):
        return [repr(t_s), *[""] * len(cells)]
    return [repr(t_s), *(repr(unit_m * value) for value in found[2:5]), *cells[3:]]


def _export(path: Path, text: str) -> _Export | None:
    """Return what a text is; None where it is no such export."""
    found = _HEADER.search(text, 0, 200_000)
    end, mark = (found.end(), found[1]) if found is not None else (0, ",")
    *above, head = [_cells(line, mark) for line in text[:end].split("\n")]
    rows = text[end + 1 :].split("\n") if found is not None else []
    below = [(line, _cells(row, mark)) for line, row in enumerate(rows, len(above) + 2)]
    if text.startswith("Format Version,"):
        return _Export(_MOTIVE, *_of_motive(above, head), list(_frames(below)))
    if text.startswith("NO_OF_FRAMES\t"):
        return _Export(_QTM, _of_qtm(above, head), "mm", list(_frames(below)))
    if head[1:2] == ["Sub Frame"]:
        rate = above[1][0] if len(above) > 1 and above[1] else ""
        if not 0 < (rate_hz := number(rate) or 0.0) < math.inf:
            raise InputError(
                f"{path}: line 2: {rate[:40]!r} frames a second; expected a positive number: export it again"
            )
        return _Export(_VICON, *_of_vicon(above, head, below[0][1]), list(_frames(below[1:])), rate_hz)
    return None


def _cells(line: str, mark: str) -> list[str]:
    """Return the cells of a line; a quote that stays open ends with it."""
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=mark), [])]
    except csv.Error:  # a cell longer than any
        return [line[:40]]


def _frames(lines: Iterable[_Line]) -> Iterator[_Line]:
    """Yield the lines that are not empty, up to a title beneath an empty one, a word alone: of what else was exported."""
    empty = False
    for line, row in lines:
        if empty and sum(map(bool, row)) == 1 and number(row[0]) is None:
            return
        empty = not any(row)
        if not empty:
            yield line, row


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


def _of_vicon(above: list[list[str]], head: list[str], below: list[str]) -> tuple[_Bodies, str]:
    """Return the objects and the unit of Vicon's CSV: names stand above an object's first column, units beneath all."""
    bodies: _Bodies = {}
    names, name = above[-1] if above else [], ""
    ours = {f"T{axis}": f"{axis.lower()}_m" for axis in "XYZ"} | {f"R{axis}": f"q{axis.lower()}" for axis in "XYZW"}
    for k, cell in enumerate(head):
        name = (names[k] if k < len(names) else "") or name
        if cell in ours:
            bodies.setdefault(name, {})[ours[cell]] = k
    units = [cell for cell, theirs in zip(below, head, strict=False) if theirs == "TX"]
    return bodies, units[0] if units else ""
