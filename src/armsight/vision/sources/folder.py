"""A folder of stored shots: what ``armsight record`` wrote, or just left and right images.

In: a folder. Out: its shots, in the order of the index. A recording has an index, ``shots.csv``, one line a shot: its
name, the time of the grab, the two files and, where there are none, why. Without an index the images are left* and
right* in the folder, or all images in its subfolders left and right, paired by sorted name. Images of other names show
left and right side by side.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator
from pathlib import Path

from armsight.errors import InputError
from armsight.files import natural_key, read_text
from armsight.vision.sources.pairs import IMAGES, StoredPair, StoredSource, halves, match, names_of

#: The index of a recording, and its columns; t_s is empty where the source has no clock, left and right where the shot
#: has a problem.
INDEX = "shots.csv"
COLUMNS = ("shot", "t_s", "left", "right", "problem")


class FolderSource(StoredSource):
    """The shots stored in a folder."""

    @staticmethod
    def open(directory: str | Path) -> FolderSource:
        """Read the index or match the names; InputError where there are no shots, or images that do not pair up."""
        folder = Path(directory).expanduser()
        if not folder.is_dir():
            raise InputError(f"{directory}: no such folder")
        return FolderSource(_indexed(folder) if (folder / INDEX).exists() else _matched(folder))


def _matched(folder: Path) -> tuple[StoredPair, ...]:
    """Pair the images of a folder without an index."""
    sides = []
    for side in ("left", "right"):
        below = folder / side
        files = below.iterdir() if below.is_dir() else folder.glob(f"{side}*")
        sides.append(
            (
                [file for file in files if file.suffix.lower() in IMAGES],
                below if below.is_dir() else folder / f"{side}*",
            )
        )
    (left, said_left), (right, said_right) = sides
    if not left and not right:
        both = sorted((file for file in folder.iterdir() if file.suffix.lower() in IMAGES), key=natural_key)
        if not both:
            raise InputError(
                f"{folder}: holds no shots: expected {INDEX}, images left* and right*, folders left and right, or images "
                "that show left and right side by side"
            )
        halves(both[0])  # images of single cameras, whose names do not say which, are no pairs
        return tuple(StoredPair(name, file, file) for name, file in zip(names_of(both), both, strict=True))
    return match(left, right, str(said_left), str(said_right))


def _indexed(folder: Path) -> list[StoredPair]:
    index = folder / INDEX
    rows = _rows(index)
    if next(rows, ("", []))[1] != list(COLUMNS):
        raise InputError(f"{index}: line 1: expected the columns {','.join(COLUMNS)}")
    pairs: dict[str, StoredPair] = {}
    for where, row in rows:
        if len(row) != len(COLUMNS):
            raise InputError(f"{where}: expected {len(COLUMNS)} fields, found {len(row)}")
        name, t_s, left, right, problem = row
        if name in pairs:
            raise InputError(f"{where}: shot {name!r} a second time")
        if not problem and not (left and right):
            raise InputError(f"{where}: shot {name!r} has no images and no reason why")
        files = [folder / file if file and not problem else None for file in (left, right)]
        pairs[name] = StoredPair(name, files[0], files[1], _seconds(t_s, where), problem or None)
    if not pairs:
        raise InputError(f"{index}: holds no shots")
    return list(pairs.values())


def _rows(index: Path) -> Iterator[tuple[str, list[str]]]:
    """Yield where a line stands, for messages, and its fields."""
    reader = csv.reader(io.StringIO(read_text(index), newline=""))
    try:
        for row in reader:
            yield f"{index}: line {reader.line_num}", row
    except csv.Error as error:
        raise InputError(f"{index}: line {reader.line_num}: {error}") from None


def _seconds(text: str, where: str) -> float | None:
    """Read a time stamp, s; empty is None."""
    try:
        t_s = float(text) if text else None
    except ValueError:
        raise InputError(f"{where}: t_s must be a number of seconds or empty, got {text!r}") from None
    if t_s is not None and not math.isfinite(t_s):
        raise InputError(f"{where}: t_s must be finite, got {text}")
    return t_s
