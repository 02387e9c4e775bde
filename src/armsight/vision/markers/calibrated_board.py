"""Board files: a printed board as a calibration found it, its points measured instead of drawn.

A board's spec and the positions of its points go to a TOML file, and a target that is found as the board of that spec and
measured against those positions comes back. A sheet of paper differs from its drawing by tenths of a millimetre; measured
against the drawing, that is a residual in every shot. The format::

    version = 2
    board = "chessboard:9x6:25mm"
    points_mm = [[0.0, 0.0, 0.0], [25.02, 0.01, -0.1], ...]   # board frame, in the order of the drawing's points
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Body, Detections, Ids, Record
from armsight.errors import InputError, naming
from armsight.files import read_toml, write_text
from armsight.geometry.check import checked
from armsight.vision.markers.board import open_board
from armsight.vision.markers.body_file import VERSION
from armsight.vision.markers.marker import CalibrationBoard, Target

#: A point further from its drawing than this share of the board's size is a mistake in the file, not a bent sheet.
_MOST_OFF = 0.1


@dataclass(frozen=True, eq=False)
class EstimatedBoard(Record, Target):
    """The board of a spec, ``drawing``, whose points (M, 3), m, board frame, are where a calibration found them."""

    drawing: CalibrationBoard
    points: Array

    @cached_property
    def body(self) -> Body:
        """The board with its estimated points."""
        drawn = self.drawing.body
        return Body(f"{drawn.name}, as calibrated", drawn.point_names, self.points)

    @property
    def symmetries(self) -> tuple[Ids, ...]:
        """Those of the drawing: in one image the board looks the same all the same."""
        return self.drawing.symmetries

    @property
    def disc_radius_m(self) -> float | None:
        """That of the drawing."""
        return self.drawing.disc_radius_m

    def detect(self, image: NDArray[np.uint8]) -> Detections:
        """Find the board in one grey image; see :class:`~armsight.vision.markers.marker.Target`."""
        return self.drawing.detect(image)


def save_board_file(path: str | Path, spec: str, points: Array) -> None:
    """Write a board file of points (M, 3), m, board frame, to the nanometre; InputError if it cannot be written."""
    rows = ",\n".join(f"  [{', '.join(f'{1e3 * x + 0.0:.6f}' for x in row)}]" for row in points.tolist())
    head = f"# The board as armsight calibrate found it: armsight measure --target {Path(path).name}\nversion = {VERSION}\n"
    write_text(path, f"{head}board = {json.dumps(spec)}\npoints_mm = [\n{rows},\n]\n")


def load_board_file(path: str | Path) -> EstimatedBoard:
    """Read a board file; InputError where it is missing, malformed or its points are not those of the board."""
    document = read_toml(path)
    if unknown := document.keys() - {"version", "board", "points_mm"}:
        raise InputError(f"{path}: unknown key {min(unknown)!r}; a board file has version, board and points_mm")
    version, spec = document.get("version", 1), document["board"]
    if type(version) is not int or not 1 <= version <= VERSION:
        raise InputError(f"{path}: version {version!r}; this program reads board files of version 1 to {VERSION}")
    if not isinstance(spec, str):
        raise InputError(f'{path}: board must be a spec in quotes, such as board = "chessboard:9x6:25mm"')
    with naming(path):
        drawing = open_board(spec)
    drawn = drawing.body.points
    points = 1e-3 * checked(document.get("points_mm", []), drawn.shape, f"{path}: points_mm of {spec}")
    off = np.linalg.norm(points - drawn, axis=1)
    if off.max() > _MOST_OFF * np.ptp(drawn, axis=0).max():
        worst = int(np.argmax(off))
        raise InputError(
            f"{path}: point {worst} is {1e3 * off[worst]:.3g} mm from its position on {spec}: are points_mm in mm, and "
            "in the order of the board's points?"
        )
    return EstimatedBoard(drawing, points)


def is_print(target: Target) -> bool:
    """Whether a target is a calibration board: a print whose shape a calibration finds, if it is not flat."""
    return isinstance(target, EstimatedBoard) or hasattr(target, "y_up")
