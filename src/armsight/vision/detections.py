"""Detections from a file: one line per marker that one camera saw in one shot.

    shot,camera,marker,u_px,v_px
    1,left,9,944.5607,2691.2178

``camera`` is left or right, pixels are raw, (0, 0) is the centre of the top-left pixel. A marker may stand twice in one
image where two bodies of the same kind are in view. Any other columns are ignored.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from armsight.data import SIDES, Array, Body, Correspondences, Ids, Record
from armsight.errors import InputError, nearest
from armsight.files import read_table
from armsight.tables.lengths import number

COLUMNS = ("shot", "camera", "marker", "u_px", "v_px")


@dataclass(frozen=True, eq=False)
class SeenShot(Record):
    """What both cameras saw in one shot, as it stands in the file."""

    name: str  #: the shot
    #: per camera (N,) rows of the body's points, in the file's order; one may stand more than once
    ids: tuple[Ids, Ids]
    uv: tuple[Array, Array]  #: per camera (N, 2) raw pixels
    t_s: float | None = None  #: its time, s; None where it has none
    problem: str | None = None  #: why the shot cannot be used; None when it can


def read_detections(path: str | Path, body: Body) -> list[SeenShot]:
    """Read a CSV file of detections of a body: one record per shot, in the file's order.

    Raises InputError: missing file or column, text or NaN where a number must be, an unknown camera or marker, no line at
    all; the message names file and line.
    """
    rows = read_table(path)
    if not rows:
        raise InputError(f"{path}: empty; expected a header {','.join(COLUMNS)}")
    header = [name.strip() for name in rows[0]]
    missing = [name for name in COLUMNS if name not in header]
    if missing:
        raise InputError(f"{path}: line 1: no column {', '.join(missing)}; expected a header {','.join(COLUMNS)}")
    at = [header.index(name) for name in COLUMNS]
    index = {name: i for i, name in enumerate(body.point_names)}
    shots: dict[str, tuple[tuple[list[int], list[int]], tuple[list[Array], list[Array]]]] = {}
    for line, row in enumerate(rows[1:], start=2):
        if not any(field.strip() for field in row):
            continue
        if len(row) != len(header):
            raise InputError(f"{path}: line {line}: {len(row)} fields, the header has {len(header)}")
        shot, camera, marker, u, v = (row[i].strip() for i in at)
        if camera not in SIDES:
            raise InputError(f"{path}: line {line}: camera {camera!r}; it must be left or right")
        if marker not in index:
            raise InputError(
                f"{path}: line {line}: unknown marker {marker!r}; body {body.name} has {nearest(marker, body.point_names)}"
            )
        uv = np.array([_number(text, path, line, name) for text, name in ((u, "u_px"), (v, "v_px"))])
        ids, pixels = shots.setdefault(shot, (([], []), ([], [])))
        side = SIDES.index(camera)
        ids[side].append(index[marker])
        pixels[side].append(uv)
    if not shots:
        raise InputError(f"{path}: no detections below the header")
    return [
        SeenShot(
            name,
            (np.array(ids[0], np.int64), np.array(ids[1], np.int64)),
            (np.reshape(np.array(uv[0], float), (-1, 2)), np.reshape(np.array(uv[1], float), (-1, 2))),
        )
        for name, (ids, uv) in shots.items()
    ]


def detections_text(shots: Iterable[tuple[str, float | None, Correspondences]], body: Body) -> str:
    """Return detections as the text of such a file: name, time, s, or None, and what both cameras saw, of each shot."""
    lines = [",".join((*COLUMNS, "t_s"))]
    for name, t_s, seen in shots:
        time = "" if t_s is None else f"{t_s:.6f}"
        for side, camera in enumerate(SIDES):
            for row in np.flatnonzero(seen.seen[:, side]):
                u, v = seen.uv[row, side]
                lines.append(f"{name},{camera},{body.point_names[seen.ids[row]]},{u:.4f},{v:.4f},{time}")
    return "\n".join(lines) + "\n"


def detection_times(path: str | Path) -> dict[str, float]:
    """Return the times of the shots of a file of detections that has the column ``t_s``, by their names; else nothing.

    Raises InputError: a time is no number.
    """
    rows = read_table(path)
    header = [name.strip() for name in rows[0]] if rows else []
    if "t_s" not in header or "shot" not in header:
        return {}
    shot, at = header.index("shot"), header.index("t_s")
    return {
        row[shot].strip(): _number(row[at].strip(), path, line, "t_s")
        for line, row in enumerate(rows[1:], start=2)
        if len(row) == len(header) and row[at].strip()
    }


def _number(text: str, path: str | Path, line: int, column: str) -> float:
    value = number(text)
    if value is None:
        raise InputError(f"{path}: line {line}: {column} is {text!r}, it must be a number")
    if not np.isfinite(value):
        raise InputError(f"{path}: line {line}: {column} is {text}, it must be a finite number of pixels")
    return value
