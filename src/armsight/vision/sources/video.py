"""Video files: one for each camera, or one with both images side by side.

In: file names. Out: one shot a frame, with the file's own time stamps. Frames are paired by time stamp, so that a frame
one recorder dropped costs one shot and does not shift the rest.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from armsight.data import Array, Image, Shot
from armsight.errors import InputError
from armsight.vision.sources.capture import QuietCapture, open_capture

#: Two rates that differ by more than this share are said.
_RATES = 0.01
#: Of how many rows and columns one is compared between frames.
_EVERY = 4
#: A frame repeats the one before if its mean squared difference from it is below this share of those nearby, in as many
#: frames before it and after it; re-encoding leaves some difference. Where frames nearby differ by less, nothing changes,
#: grey levels squared.
_REPEAT_SHARE, _NEARBY, _LEAST_CHANGE = 1 / 16, 3, 0.25
#: Repeated frames are said from this share on: what moves and stops has a few that look like it.
_REPEATS_SAID = 0.15


class VideoSource:
    """Two video files, or one side-by-side file."""

    count: int | None = None  # what a container promises is an estimate

    def __init__(self, files: Sequence[_File]) -> None:
        self._files = list(files)
        first, last = self._files[0], self._files[-1]
        rates = [1 / file.period_s for file in (first, last)]
        self._rates: tuple[str, ...] = ()
        if min(rates) > 0 and abs(rates[0] - rates[1]) > _RATES * max(rates):
            self._rates = (
                f"{first.path} has {rates[0]:.4g} frames a second and {last.path} {rates[1]:.4g}: only those of nearly the "
                "same time are paired, up to half a frame apart; set both cameras to one rate, or use what stands still",
            )
        self._shots = 0
        self._ended = False

    @property
    def notes(self) -> tuple[str, ...]:
        """What is odd about the files: different rates, and frames that repeat among those that were read."""
        return (*self._rates, *(said for file in self._files if (said := file.repeats()) is not None))

    @staticmethod
    def open(left: str | Path, right: str | Path | None = None) -> VideoSource:
        """Open the files.

        Args:
            left: the left camera's file, or with no ``right`` the side-by-side file.
            right: the right camera's file.

        Raises:
            InputError: a file is missing or not a video, both are the same, or a side-by-side frame has an odd width.
        """
        if right is not None and Path(left).resolve() == Path(right).resolve():
            raise InputError(f"{left}: given as both left and right video; a side-by-side video is video:{left}")
        files = [_File.open(path) for path in (left, right) if path is not None]
        width = int(files[0].capture.get(cv2.CAP_PROP_FRAME_WIDTH))
        if right is None and width % 2:
            files[0].capture.release()
            raise InputError(f"{left}: a side-by-side video must have an even width, this one is {width} px wide")
        return VideoSource(files)

    def read(self) -> Shot | None:
        """Return the next shot, or None where the shorter file ends."""
        if self._ended:
            return None
        name = f"{self._shots:06d}"
        self._shots += 1
        grabbed = [file.grab() for file in self._files]
        if not all(grabbed):
            self._ended = True
            problem = self._unexpected_end(grabbed)
            return Shot(name, None, None, None, problem) if problem else None
        first, last = self._files[0], self._files[-1]
        if abs(first.t_s - last.t_s) > first.period_s / 2:
            early, late = sorted((first, last), key=lambda file: file.t_s)
            late.held = True
            problem = (
                f"{late.path} has no frame for {early.path}'s at {early.t_s:.3f} s: its next is at {late.t_s:.3f} s"
            )
            return Shot(name, None, None, early.t_s, problem)
        images = [file.image() for file in self._files]
        for file, image in zip(self._files, images, strict=True):
            if image is None:
                return Shot(
                    name, None, None, first.t_s, f"{file.path}: the frame at {file.t_s:.3f} s cannot be decoded"
                )
        left, right = images if len(images) == 2 else np.split(np.asarray(images[0]), 2, axis=1)
        return Shot(name, left, right, first.t_s)

    def close(self) -> None:
        """Close the files."""
        self._ended = True
        for file in self._files:
            file.capture.release()

    def _unexpected_end(self, grabbed: list[bool]) -> str | None:
        """Return what is wrong with the end of the files; None where nothing is."""
        for file, ok in zip(self._files, grabbed, strict=True):
            if not ok and file.frames < file.promised - 1:  # some containers only estimate the number: one less is fine
                return f"{file.path} is damaged or cut short: it ends after {file.frames} of {file.promised} frames"
        if any(grabbed):
            short, long = sorted(self._files, key=lambda file: file.frames)
            return f"{short.path} ends after {short.frames} frames, {long.path} goes on: stopped there"
        return None


class _File:
    """One open video file and its current frame."""

    @staticmethod
    def open(path: str | Path) -> _File:
        """Open a file.

        Raises:
            InputError: it is missing or not a video.
        """
        if not os.path.isfile(path):
            raise InputError(f"{path}: no such file")
        capture = open_capture(str(path))
        if capture is None:
            raise InputError(f"{path}: not a video file that OpenCV can read")
        return _File(str(path), capture)

    def __init__(self, path: str, capture: QuietCapture) -> None:
        self.path, self.capture = path, capture
        fps = self.capture.get(cv2.CAP_PROP_FPS)
        self.period_s = 1 / fps if fps > 0 else np.inf
        self.promised = int(self.capture.get(cv2.CAP_PROP_FRAME_COUNT))
        self.frames = 0
        self.t_s = 0.0
        self.held = False  # the current frame waits for a partner: the next grab keeps it
        self._before: Array | None = None
        self._changes: list[float] = []  # mean squared differences from the frame before, grey levels squared

    def grab(self) -> bool:
        """Go to the next frame; False at the end."""
        if not self.held:
            if not self.capture.grab():
                return False
            self.frames += 1
            self.t_s = self.capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
        self.held = False
        return True

    def image(self) -> Image | None:
        """Decode the current frame; None if that fails."""
        ok, image = self.capture.retrieve()
        if not ok:
            return None
        some = np.asarray(image[::_EVERY, ::_EVERY], np.float64)
        if self._before is not None:
            self._changes.append(float(np.mean((some - self._before) ** 2)))
        self._before = some
        return np.asarray(image)

    def repeats(self) -> str | None:
        """Return what to say where frames repeat the ones before them, as a slower camera's do in a faster file."""
        changes = np.array(self._changes)
        if len(changes) <= 2 * _NEARBY:
            return None
        runs = np.lib.stride_tricks.sliding_window_view(changes, _NEARBY).max(axis=1)
        nearby = np.minimum(runs[: -_NEARBY - 1], runs[_NEARBY + 1 :])
        changing = nearby > _LEAST_CHANGE
        same = changing & (changes[_NEARBY:-_NEARBY] < _REPEAT_SHARE * nearby)
        if same.sum() <= _REPEATS_SAID * max(changing.sum(), 1):
            return None
        share = float(same.sum() / changing.sum())
        given, rate = (1 - share) / self.period_s, 1 / self.period_s
        return (
            f"{self.path}: {100 * share:.0f} % of the frames repeat the one before: the camera gave about {given:.0f} "
            f"images a second and the file has {rate:.0f}; a repeated image is no new measurement, and its time is late"
        )


def open_video(rest: str) -> VideoSource:
    """Open ``LEFT.mp4,RIGHT.mp4`` or ``SIDE_BY_SIDE.mp4``."""
    names = [rest] if os.path.isfile(rest) else rest.split(",")
    if len(names) > 2 or not all(names):
        raise InputError(f"video:{rest}: expected video:LEFT.mp4,RIGHT.mp4 or video:SIDE_BY_SIDE.mp4")
    return VideoSource.open(*names)
