"""Calibrate two cameras from the images of a source.

from armsight import calibrate calibration = calibrate("chessboard:9x6:25mm", "recording") calibration.rig.save("rig.json")
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from armsight.errors import InputError
from armsight.vision.calibrate import FOLDS, MODELS
from armsight.vision.calibrate.boards import Pair, calibrate_boards
from armsight.vision.calibrate.result import Calibration
from armsight.vision.image import grey
from armsight.vision.markers.board import open_board
from armsight.vision.markers.marker import CalibrationBoard
from armsight.vision.pose.measure import require_arguments
from armsight.vision.sources import Source, lent


def calibrate(
    board: CalibrationBoard | str,
    source: Source | str | Path,
    *,
    models: tuple[str, ...] = MODELS,
    flat: bool = False,
    folds: int = FOLDS,
    progress: Callable[[str], None] = lambda line: None,
) -> Calibration:
    """Calibrate two cameras from pairs of images of a board that is held still while each is taken.

    ``armsight calibrate`` looks for the skew of a recording's moving board as well.

    ``board``: the board, or its text as the command line takes it. ``source``: the pairs, or what
    :func:`~armsight.vision.sources.open_source` opens; a source that was open stays open. ``models``: distortion models to
    choose from by held-out error. ``flat``: hold the board to its drawing. ``folds``: how many parts the pairs are split
    into for the held-out errors. Returns the rig, its held-out errors, and what was rejected. Raises InputError: a text is
    wrong, or images that cannot be read or differ in size; CalibrationError: fewer than three usable pairs, or views that
    do not determine the cameras.
    """
    if isinstance(board, str | Path):
        if Path(board).is_dir():
            raise InputError(
                f'calibrate(board, source): board is the folder {board}; expected a board such as "chessboard:9x6:25mm": '
                "are the two exchanged?"
            )
        board = open_board(board)
    pairs, sizes, problem = list[Pair](), None, "no shot is left in it: open it again, or take source[:]"
    with lent(source) as shots:
        require_arguments("calibrate(board, source)", board=board, source=shots)
        for shot in iter(shots.read, None):
            if shot.left is None or shot.right is None:
                problem = f"shot {shot.name}: {shot.problem}"
                continue
            now = tuple((image.shape[1], image.shape[0]) for image in (shot.left, shot.right))
            if sizes is not None and now != sizes:
                raise InputError(f"shot {shot.name}: images of {now} px, those before have {sizes}: one size is needed")
            sizes = now
            pairs.append(Pair(shot.name, *(board.detect(grey(image)) for image in (shot.left, shot.right))))
            progress(f"{shot.name}: {len(pairs[-1].left.ids)} and {len(pairs[-1].right.ids)} points")
    if sizes is None:
        raise InputError(f"the source has no pair of images: {problem}")
    return calibrate_boards(
        board, pairs, (sizes[0], sizes[1]), models=models, flat=flat, folds=folds, progress=progress
    )
