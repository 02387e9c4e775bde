"""Calibration boards by their spec, such as ``chessboard:9x6:25mm``.

To add a kind of board: write one file with a class that fulfils :class:`CalibrationBoard`, and add one line to BOARDS.
"""

from __future__ import annotations

from collections.abc import Callable
from difflib import get_close_matches
from functools import partial
from pathlib import Path

from armsight.errors import InputError
from armsight.geometry.check import checked
from armsight.vision.camera_file import described, stranger
from armsight.vision.markers.aprilgrid import AprilGrid
from armsight.vision.markers.charuco import Charuco
from armsight.vision.markers.chessboard import Chessboard
from armsight.vision.markers.circles import CircleGrid
from armsight.vision.markers.disc.search import Grey
from armsight.vision.markers.marker import CalibrationBoard
from armsight.vision.markers.spec import Fields

#: Kind -> (form, maker).
BOARDS: dict[str, tuple[str, Callable[[Fields], CalibrationBoard]]] = {
    "chessboard": (Chessboard.form, Chessboard.from_fields),
    "charuco": (Charuco.form, Charuco.from_fields),
    "circles": (CircleGrid.form, partial(CircleGrid.from_fields, staggered=False)),
    "acircles": (CircleGrid.staggered_form, partial(CircleGrid.from_fields, staggered=True)),
    "aprilgrid": (AprilGrid.form, AprilGrid.from_fields),
}

#: Boards in an image of which nothing is known: how each kind is looked for, tags first, since they hide in no other kind;
#: and its side of a square or tag, or its pitch, m, which no image shows.
IN_VIEW: tuple[tuple[Callable[[Grey, float], CalibrationBoard | None], float], ...] = (
    (AprilGrid.in_view, 0.088),
    (Charuco.in_view, 0.020),
    (CircleGrid.in_view, 0.020),
    (Chessboard.in_view, 0.020),
)
WHOLE = 0.8  # share of its points that a named board shows; half: a part passes for a board, double: a glint hides it

#: Suffixes of Kalibr's target files.
KALIBR = (".yaml", ".yml")
#: Kalibr's target_type -> the kind here, and its keys: columns, rows, lengths, m.
_TARGETS: dict[str, tuple[str, tuple[str, ...]]] = {
    "aprilgrid": ("aprilgrid", ("tagCols", "tagRows", "tagSize", "tagSpacing")),
    "checkerboard": ("chessboard", ("targetCols", "targetRows", "rowSpacingMeters", "colSpacingMeters")),
    "circlegrid": ("circles", ("targetCols", "targetRows", "spacingMeters")),
}


def board_in_view(image: Grey) -> CalibrationBoard | None:
    """Return the board that a grey image (H, W) shows whole, its kind and counts; its lengths are usual ones.

    What a kind takes it for is looked for as such a board; None where none is found with nearly all of its points.
    """
    for look, length_m in IN_VIEW:
        board = look(image, length_m)
        if board is not None and len(board.detect(image).ids) >= WHOLE * len(board.body.points):
            return board
    return None


def kalibr_spec(path: str) -> str:
    """Return the spec of the board that one of Kalibr's target files describes.

    Raises InputError: missing, no target file, or one whose squares are no squares; the message names file and key.
    """
    from armsight.tables.document import read_document  # not above: YAML takes as long to import as a pair of images

    document = read_document(path)
    kind = document.get("target_type")
    if kind not in _TARGETS:
        said = stranger(document) or f"there are {described(document)}"
        got = f"target_type is {kind!r}" if kind is not None else said
        raise InputError(f"{path}: no target: {got}; expected Kalibr's target_type, one of {', '.join(_TARGETS)}")
    board, keys = _TARGETS[kind]
    if missing := [key for key in keys if key not in document]:
        raise InputError(f"{path}: {kind} has no {missing[0]}; needed are {', '.join(keys)}")
    numbers = checked([document[key] for key in keys], (len(keys),), f"{path}: {', '.join(keys)}")
    if (numbers[:2] != numbers[:2].round()).any():
        raise InputError(
            f"{path}: {keys[0]} and {keys[1]} must be whole numbers, got {numbers[0]:g} and {numbers[1]:g}"
        )
    if kind == "checkerboard" and numbers[2] != numbers[3]:
        raise InputError(
            f"{path}: its squares are {1e3 * numbers[3]:g} x {1e3 * numbers[2]:g} mm; those of chessboards here are square"
        )
    if not numbers[2] <= 2.0:
        raise InputError(f"{path}: {keys[2]} is {numbers[2]:g} m; Kalibr's lengths are in metres: is it in mm?")
    if kind == "circlegrid" and document.get("asymmetricGrid"):
        board = "acircles"
    tail = f":{numbers[3]:g}" if kind == "aprilgrid" else ""
    return f"{board}:{numbers[0]:.0f}x{numbers[1]:.0f}:{numbers[2]:.9g}m{tail}"


def open_board(spec: str | Path) -> CalibrationBoard:
    """Make the board that a spec names.

    ``spec``: kind and fields, separated by colons; lengths carry a unit (mm, cm, m, in); or the name of Kalibr's target
    file (.yaml). Raises InputError: unknown kind or malformed fields; the message shows the form and the known kinds.
    """
    spec = str(spec)
    if Path(spec).suffix.lower() in KALIBR and Path(spec).suffix != spec:
        spec = kalibr_spec(spec)
    kind, *values = spec.strip().split(":")
    if kind not in BOARDS:
        near = get_close_matches(kind, BOARDS, 1)
        forms = "; ".join(BOARDS[each][0] for each in near or BOARDS)
        raise InputError(f"unknown board {spec!r}; {'did you mean' if near else 'known are'} {forms}")
    form, make = BOARDS[kind]
    return make(Fields(spec, form, tuple(values)))
