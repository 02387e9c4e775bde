"""Calibration boards by their spec, such as ``chessboard:9x6:25mm``.

To add a kind of board: write one file with a class that fulfils :class:`CalibrationBoard`, and add one line to BOARDS.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from armsight.errors import InputError
from armsight.vision.markers.aprilgrid import AprilGrid
from armsight.vision.markers.charuco import Charuco
from armsight.vision.markers.chessboard import Chessboard
from armsight.vision.markers.circles import CircleGrid
from armsight.vision.markers.marker import Target
from armsight.vision.markers.spec import Fields


class CalibrationBoard(Target, Protocol):
    """A flat target whose points lie in z = 0, the first at the origin, x along the columns; m, board frame.

    ``symmetries`` is empty for a board that shows which way up it is.
    """

    @property
    def y_up(self) -> bool:
        """Whether y runs up and z points out of its face, as on Kalibr's boards; else they run down and into it."""
        ...

    @property
    def codes(self) -> tuple[str, int]:
        """The family of its tags, which have the ids from 0 on, and how many there are; "" and 0 where it has none."""
        ...


#: Kind -> (form, maker).
BOARDS: dict[str, tuple[str, Callable[[Fields], CalibrationBoard]]] = {
    "chessboard": (Chessboard.form, Chessboard.from_fields),
    "charuco": (Charuco.form, Charuco.from_fields),
    "circles": (CircleGrid.form, CircleGrid.from_fields),
    "acircles": (CircleGrid.staggered_form, CircleGrid.staggered_from_fields),
    "aprilgrid": (AprilGrid.form, AprilGrid.from_fields),
}


def open_board(spec: str) -> CalibrationBoard:
    """Make the board that a spec names.

    Args:
        spec: kind and fields, separated by colons; lengths carry a unit (mm, cm, m, in).

    Raises:
        InputError: unknown kind or malformed fields; the message shows the form and the known kinds.
    """
    kind, *values = spec.strip().split(":")
    if kind not in BOARDS:
        raise InputError(f"unknown board {spec!r}; known are {'; '.join(form for form, _ in BOARDS.values())}")
    form, make = BOARDS[kind]
    return make(Fields(spec, form, tuple(values)))
