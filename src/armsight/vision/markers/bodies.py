"""Bodies as tables of named points: CSV in and out. The form: docs/targets.md."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from armsight.data import Body
from armsight.errors import InputError
from armsight.files import read_table, write_text

#: Headers that are taken; all lengths are metres. The first is the one written.
HEADERS = (
    ("marker", "x_m", "y_m", "z_m"),
    ("id", "x_m", "y_m", "z_m"),
    ("id", "x", "y", "z"),
    ("marker", "x", "y", "z"),
)
#: A body larger than this was not written in metres.
SIZE_MAX_M = 100.0


def load_body_csv(path: str | Path) -> Body:
    """Read a body from a table of its points.

    Args:
        path: CSV with a header of HEADERS and a line for each point.

    Raises:
        InputError: missing, malformed, not numbers, a name twice, fewer than three points, or a size that says the
            unit is wrong; the message names the file and the line.
    """
    rows = read_table(path)
    if not rows or tuple(cell.strip().lower() for cell in rows[0]) not in HEADERS:
        given = ",".join(rows[0]) if rows else "an empty file"
        raise InputError(f"{path}: line 1: expected the header {','.join(HEADERS[0])} (metres), got {given!r}")
    names: dict[str, int] = {}
    points = []
    for line, row in enumerate(rows[1:], start=2):
        if not any(cell.strip() for cell in row):
            continue
        if len(row) != 4:
            raise InputError(f"{path}: line {line}: expected 4 columns, got {len(row)}")
        name = row[0].strip()
        if not name:
            raise InputError(f"{path}: line {line}: the point has no name")
        if name in names:
            raise InputError(f"{path}: line {line}: the point {name!r} stands on line {names[name]} already")
        names[name] = line
        points.append([_coordinate(f"{path}: line {line}", cell) for cell in row[1:]])
    if len(points) < 3:
        raise InputError(f"{path}: a body needs 3 or more points, got {len(points)}")
    array = np.array(points)
    size = float(np.ptp(array, axis=0).max())
    if size > SIZE_MAX_M:
        raise InputError(f"{path}: the body is {size:g} m across; coordinates must be in metres")
    return Body(Path(path).stem, tuple(names), array)


def _coordinate(where: str, text: str) -> float:
    """Read one coordinate."""
    try:
        value = float(text)
    except ValueError:
        raise InputError(f"{where}: {text.strip()!r} is not a number") from None
    if not math.isfinite(value):
        raise InputError(f"{where}: {text.strip()} where a finite number of metres belongs")
    return value


def save_body_csv(body: Body, path: str | Path) -> None:
    """Write a body as a table of its points, metres, to the nanometre, in one step.

    Raises:
        InputError: the file cannot be written.
    """
    lines = [",".join(HEADERS[0])]
    lines += [
        f"{name},{x:.9f},{y:.9f},{z:.9f}"
        for name, (x, y, z) in zip(body.point_names, body.points.tolist(), strict=True)
    ]
    write_text(path, "\n".join(lines) + "\n")
