"""OpenCV's video capture without its log: errors are reported by armsight, in one line, and not by OpenCV on stderr.

Of two free-running captures, a left and a right frame belong together within half a frame period: of two streams of one
rate the nearest frames are never further apart.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import statistics
import threading
from collections import deque
from collections.abc import Iterator, Sequence

import cv2

from armsight.data import Image

#: Read by OpenCV when it first uses them; what the user has set stays.
_ENVIRONMENT = {
    "OPENCV_FFMPEG_LOGLEVEL": "-8",  # FFmpeg's level for quiet
    "OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT": "2",  # s; instead of 10, so that a camera's stall is seen in time
}
STALL_S = 5.0  # without data for that long a camera or stream has stalled; half: slow starts fail, double: a user waits
#: Time stamps a period is taken from: long enough that a late frame does not move the median, short enough to follow
#: a camera that lengthens its exposure in the dark.
_STAMPS = 10


class _Silence:
    """Switches OpenCV's log off while at least one thread is inside; OpenCV has one level for the process."""

    def __init__(self) -> None:
        self._lock, self._inside, self._level = threading.Lock(), 0, 0

    @contextlib.contextmanager
    def __call__(self) -> Iterator[None]:
        """Keep the log off for a block, unless the user has set its level."""
        if "OPENCV_LOG_LEVEL" in os.environ:
            yield
            return
        with self._lock:
            if self._inside == 0:
                self._level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
            self._inside += 1
        try:
            yield
        finally:
            with self._lock:
                self._inside -= 1
                if self._inside == 0:
                    cv2.utils.logging.setLogLevel(self._level)


_silent = _Silence()


class QuietCapture:
    """A ``cv2.VideoCapture`` whose calls do not log; the log's level is as before after each of them."""

    def __init__(self, capture: cv2.VideoCapture) -> None:
        self._capture = capture

    def set(self, prop: int, value: float, /) -> bool:
        """Set a property."""
        with _silent():
            return self._capture.set(prop, value)

    def get(self, prop: int, /) -> float:
        """Read a property."""
        with _silent():
            return self._capture.get(prop)

    def grab(self) -> bool:
        """Take the next frame, undecoded; False when none came."""
        with _silent():
            return self._capture.grab()

    def retrieve(self) -> tuple[bool, Image]:
        """Decode the grabbed frame."""
        with _silent():
            return self._capture.retrieve()

    def release(self) -> None:
        """Close the file, stream or device."""
        with _silent():
            self._capture.release()


def open_capture(what: str, api: int = cv2.CAP_ANY, parameters: Sequence[int] = ()) -> QuietCapture | None:
    """Open a file, an address or a device; None if OpenCV cannot."""
    for name, value in _ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    with _silent():
        capture = cv2.VideoCapture(what, api, parameters)
        return QuietCapture(capture) if capture.isOpened() else None


class Rhythm:
    """The frame period of one stream, learnt from its time stamps."""

    def __init__(self) -> None:
        self._stamps: deque[float] = deque(maxlen=_STAMPS)

    def tick(self, t_s: float) -> None:
        """Take the time stamp of one more frame, s."""
        self._stamps.append(t_s)

    @property
    def period_s(self) -> float | None:
        """Median interval of the recent frames, s; None before the second frame."""
        stamps = list(self._stamps)
        return statistics.median(b - a for a, b in itertools.pairwise(stamps)) if len(stamps) > 1 else None


def allowed_skew(left: Rhythm, right: Rhythm) -> float:
    """Return half the period of the faster stream, s; 0 while neither period is known."""
    return min((r.period_s for r in (left, right) if r.period_s is not None), default=0.0) / 2
