"""Pairs of image files: two globs, matched by sorted name.

In: the file names of the left and of the right images. Out: one shot a pair. Names are sorted as a person would (left2
before left10). The numbers in the names are compared too, so that a file missing on one side is an error and does not
shift all later pairs by one.
"""

from __future__ import annotations

import glob
import os
import re
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import overload

import numpy as np

from armsight.data import Image, Shot
from armsight.errors import InputError
from armsight.files import natural_key
from armsight.vision.image import BitDepth, read_image
from armsight.vision.source import PlayedSource

#: Endings of video files, in lower case.
VIDEOS = {".avi", ".mkv", ".mov", ".mp4", ".webm"}
#: Endings of image files, in lower case.
IMAGES = {".bmp", ".jpeg", ".jpg", ".pgm", ".png", ".ppm", ".tif", ".tiff", ".webp"}


@dataclass(frozen=True)
class StoredPair:
    """The files of one shot; left and right are None where the recording has no images, and ``problem`` says why.

    One file for both holds the left image and the right one side by side.
    """

    name: str
    left: Path | None
    right: Path | None
    t_s: float | None = None
    problem: str | None = None

    def load(self) -> Shot:
        """Read both images; one that cannot be read makes a shot with a problem."""
        if self.left is None or self.right is None:
            return Shot(self.name, None, None, self.t_s, self.problem)
        try:
            if self.left == self.right:
                return Shot(self.name, *halves(self.left), self.t_s)
            return Shot(self.name, read_image(self.left), read_image(self.right), self.t_s)
        except InputError as error:
            return Shot(self.name, None, None, self.t_s, str(error))


def halves(file: Path) -> tuple[Image, Image]:
    """Return the left and the right half of an image file; InputError if it cannot be read or is too narrow for two."""
    image = read_image(file)
    height, width = image.shape[:2]
    if width % 2 or width < 2 * height:
        raise InputError(
            f"{file}: is {width}x{height}, which is not two images side by side; of two cameras name both: --source "
            f"'pairs:{file.parent}/LEFT*{file.suffix},{file.parent}/RIGHT*{file.suffix}'"
        )
    return np.ascontiguousarray(image[:, : width // 2]), np.ascontiguousarray(image[:, width // 2 :])


class StoredSource(PlayedSource):
    """A source over ``pairs`` of image files, read one by one; a part of a source has its bits, ``depth``."""

    def __init__(self, pairs: Sequence[StoredPair], depth: BitDepth | None = None) -> None:
        self.pairs = tuple(pairs)
        super().__init__(self._load, len(self.pairs), depth=depth)
        self.timed = any(pair.t_s is not None for pair in self.pairs)

    def _load(self, every: int = 1) -> Generator[Shot]:
        yield from (pair.load() for pair in self.pairs[::every])

    @property
    def files(self) -> tuple[Path, ...]:
        """The image files of all pairs."""
        return tuple(file for pair in self.pairs for file in (pair.left, pair.right) if file is not None)

    @overload
    def __getitem__(self, row: int) -> Shot: ...
    @overload
    def __getitem__(self, row: slice) -> StoredSource: ...
    def __getitem__(self, row: int | slice) -> Shot | StoredSource:
        """Load a shot by its row in the recording, or return a source of some of them; what is read next here stays."""
        if isinstance(row, slice):
            return StoredSource(self.pairs[row], self._depth)
        if not -len(self) <= row < len(self):
            raise IndexError(f"shot {row} of {len(self)}: rows begin at 0")
        return self._depth.shot(self.pairs[row].load())

    def __iter__(self) -> Iterator[Shot]:
        """Load all shots, each time from the first; ``read`` goes on where it was."""
        return map(self._depth.shot, self._load())


class PairsSource(StoredSource):
    """The image files that two globs match, paired by sorted name; a shot is called after its left file."""

    @staticmethod
    def open(left_glob: str, right_glob: str) -> PairsSource:
        """Find the files and pair them; InputError where there are none, or they do not pair up."""
        pairs = match(image_files(left_glob), image_files(right_glob), left_glob, right_glob)
        video = next((file for pair in pairs if (file := pair.left) and file.suffix.lower() in VIDEOS), None)
        if video is not None:
            raise InputError(f"{video}: is a video: give both as --source video:LEFT,RIGHT")
        return PairsSource(pairs)

    @staticmethod
    def of(text: str) -> PairsSource:
        """Open LEFT,RIGHT, as :func:`two_globs` reads it.

        Raises InputError: not two globs, no files, or files that do not pair up.
        """
        return PairsSource.open(*two_globs(text))


def two_globs(text: str) -> tuple[str, str]:
    """Return the globs of LEFT,RIGHT; else InputError."""
    if (found := split_names(text, lambda each: bool(glob.glob(os.path.expanduser(each))))) is None:
        raise InputError(f"pairs:{text}: two globs are needed: --source 'pairs:DIR/left*.png,DIR/right*.png'")
    return found


def split_names(text: str, is_there: Callable[[str], bool]) -> tuple[str, str] | None:
    """Return LEFT and RIGHT of LEFT,RIGHT; of several commas the one between two that are there, else the middle one."""
    parts = text.split(",")
    splits = [(",".join(parts[:k]), ",".join(parts[k:])) for k in range(1, len(parts))]
    there = [split for split in splits if all(map(is_there, split))] if len(splits) > 1 else []
    middle = splits[len(splits) // 2 : len(splits) // 2 + len(splits) % 2]
    return next((split for split in (there if len(there) == 1 else middle) if all(split)), None)


def match(lefts: Iterable[Path], rights: Iterable[Path], said_left: str, said_right: str) -> tuple[StoredPair, ...]:
    """Pair left and right files by sorted name; ``said_left`` and ``said_right`` are the user's texts, for messages.

    InputError: no file, unequal counts, a file without a partner, or a file that is on both sides.
    """
    left, right = (sorted(files, key=natural_key) for files in (lefts, rights))
    for files, said in ((left, said_left), (right, said_right)):
        if not files:
            raise InputError(no_files(said))
    both = {file.resolve() for file in left} & {file.resolve() for file in right}
    if both:
        raise InputError(
            f"{min(both)}: is both a left and a right image ({said_left} and {said_right}); files that hold both side by "
            "side are given as --source DIR"
        )
    alone = _without_partner(left, right)
    if alone is not None or len(left) != len(right):
        raise InputError(
            f"{said_left} and {said_right} do not pair up: {len(left)} left and {len(right)} right images; "
            f"first without a partner: {alone or max(left, right, key=len)[min(len(left), len(right))]}"
        )
    return tuple(
        StoredPair(name, file, partner) for name, file, partner in zip(names_of(left), left, right, strict=True)
    )


def no_files(said: str) -> str:
    """Return why no file is meant by the user's text, with the glob of the images that lie there."""
    path = Path(os.path.expanduser(said))
    folder = path if path.is_dir() else path.parent
    suffixes = Counter(file.suffix for file in folder.glob("*") if file.suffix.lower() in IMAGES)
    there = f"{folder}/*{suffixes.most_common(1)[0][0]}" if suffixes else None
    if path.is_dir():
        return f"{said}: is a folder; give its images as a quoted glob such as '{there or f'{said}/left*.png'}'"
    if there is not None:
        return f"{said}: no such file; the images there are '{there}'"
    return f"{said}: no such file; quote a glob such as 'DIR/left*.png' to keep the shell off it"


def image_files(pattern: str) -> list[Path]:
    """Return the files a glob matches, in no order."""
    return [Path(name) for name in glob.glob(os.path.expanduser(pattern), recursive=True) if os.path.isfile(name)]


def _without_partner(left: Sequence[Path], right: Sequence[Path]) -> Path | None:
    """Return the first file whose numbers appear on its own side alone; None where numbers are ambiguous.

    Only the positions at which a number varies within a side count: cam0_17 and cam1_17 are partners.
    """
    numbers = [[tuple(map(int, re.findall(r"\d+", file.stem))) for file in side] for side in (left, right)]
    if len({len(n) for side in numbers for n in side}) != 1:
        return None
    varying = [i for i in range(len(numbers[0][0])) if any(len({n[i] for n in side}) > 1 for side in numbers)]
    keys = [[tuple(n[i] for i in varying) for n in side] for side in numbers]
    if any(len(set(side)) != len(side) for side in keys) or not set(keys[0]) & set(keys[1]):
        return None
    files = {
        key: file for ks, side in zip(keys, (left, right), strict=True) for key, file in zip(ks, side, strict=True)
    }
    alone = set(keys[0]) ^ set(keys[1])
    return files[min(alone)] if alone else None


def names_of(files: Sequence[Path]) -> list[str]:
    """Return a short unique name a file: its stem, with the folders below the common one where stems repeat."""
    stems = [file.stem for file in files]
    if len(set(stems)) == len(stems):
        return stems
    common = os.path.commonpath([file.parent for file in files])
    return [os.path.relpath(file, common) for file in files]
