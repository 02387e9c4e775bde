"""Store the shots of a source in a folder that is a source itself.

In: a source. Out: a folder with a left and a right PNG a shot, lossless, and the index ``shots.csv``, one line a shot.
A line is added after both images are complete on disk: whatever stops the recording, all files in the index are readable.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from armsight.app.interrupts import uninterrupted
from armsight.data import SIDES, Shot
from armsight.errors import ArmsightError, InputError
from armsight.files import RowFile, check_folder, made_folder, replacing
from armsight.vision.image import DeepShot
from armsight.vision.source import Source
from armsight.vision.sources.folder import COLUMNS, INDEX


@dataclass(frozen=True)
class Recording:
    """What was stored."""

    directory: Path
    shots: int
    problems: int
    stopped: str | None = None
    interrupted: bool = False


def record(
    source: Source,
    directory: str | Path,
    *,
    shots: int | None = None,
    seconds: float | None = None,
    on_shot: Callable[[Shot], None] | None = None,
) -> Recording:
    """Store shots until the source ends, enough are stored, or something stops it.

    Args:
        source: where shots come from; stays open.
        directory: a new or empty folder.
        shots: stop after this many, those with a problem included; None is no limit.
        seconds: stop at this age of the first shot, s, by the shots' own time, or by the clock for a source without one.
        on_shot: called after each shot is stored; its ``encoded`` are the files, unless the cameras delivered others.

    Raises:
        InputError: the folder is not empty, or holds a recording already.
    """
    folder = unused_folder(directory)
    writer = ShotFolder(folder)
    stopped, interrupted = None, False
    first: Shot | None = None
    started_s = time.monotonic()
    try:
        while shots is None or writer.shots < shots:
            shot = source.read()
            if shot is None:
                break
            first = first or shot
            if seconds is not None and _age_s(shot, first, started_s) >= seconds:
                break
            with uninterrupted() as came:  # no shot is stored in part
                shot = writer.add(shot)
            if came:
                raise KeyboardInterrupt
            if on_shot is not None:
                on_shot(shot)
    except KeyboardInterrupt:
        stopped, interrupted = "interrupted", True
    except ArmsightError as error:
        stopped = str(error)
    finally:
        writer.close()
    return Recording(folder, writer.shots, writer.problems, stopped, interrupted)


def _age_s(shot: Shot, first: Shot, started_s: float) -> float:
    """Return the time from the first shot to this one, s; by the clock where the first has no time."""
    if first.t_s is None:
        return time.monotonic() - started_s
    return 0.0 if shot.t_s is None else shot.t_s - first.t_s


def unused_folder(directory: str | Path) -> Path:
    """Return a folder, not made yet, to which a recording can be written."""
    folder = Path(directory).expanduser()
    try:
        names = os.listdir(folder)
    except OSError:
        names = []  # said below
    if INDEX in names:
        raise InputError(f"{folder}: already holds a recording; record into a new folder")
    if names:
        raise InputError(f"{folder}: is not empty; record into a new folder")
    return check_folder(directory, problem="no recording can be made here")


class ShotFolder:
    """A folder of shots being written; it is made with the first shot."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._index: RowFile | None = None
        self.shots = 0
        self.problems = 0

    def add(self, shot: Shot) -> Shot:
        """Store one shot, completely or not at all."""
        index = self._opened()
        files: list[Path] = []
        encoded: list[bytes] = []
        try:
            if shot.problem is None:
                for side in SIDES:
                    files.append(self.folder / f"{side}{self.shots:06d}.png")
                    image = np.asarray(shot.image(side))
                    if isinstance(shot, DeepShot) and image.dtype == np.uint16:
                        image = image >> (16 - shot.bits)  # as it came
                    _, data = cv2.imencode(".png", image)
                    with replacing(files[-1], "wb", durable=False) as file:
                        file.write(data)
                    encoded.append(data.tobytes())
            names = [file.name for file in files] or ["", ""]
            t_s = "" if shot.t_s is None else f"{shot.t_s:.6f}"
            index.add([shot.name, t_s, *names, " ".join((shot.problem or "").split())])
        except InputError:
            for path in files:
                path.unlink(missing_ok=True)
            raise
        self.shots += 1
        self.problems += shot.problem is not None
        return shot if shot.encoded is not None or not encoded else replace(shot, encoded=(encoded[0], encoded[1]))

    def close(self) -> None:
        """Close the index, and remove it if it names no shot; what it names is on the disk then."""
        if self._index is not None:
            self._index.close()
            os.sync()
            if self._index.rows == 0:
                self._index.path.unlink()

    def _opened(self) -> RowFile:
        """Return the open index; make folder and index the first time."""
        if self._index is None:
            self._index = RowFile(made_folder(self.folder, "no recording can be made here") / INDEX, COLUMNS)
        return self._index
