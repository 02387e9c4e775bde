"""Reads the cameras in a thread and keeps the newest shot; nobody waits for a camera, and no camera waits for anybody.

A camera that is gone is opened again every few seconds: a cable that is put back continues the work.
"""

from __future__ import annotations

import contextlib
import statistics
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

from armsight.data import Record, Shot
from armsight.errors import ArmsightError
from armsight.vision.source import LIVE_S
from armsight.vision.sources import Source

#: s between two tries of opening cameras; half: a core is busy, double: a person waits.
_REOPEN_S = 2.0
_UNTIMED_S, _LONGEST_PAUSE_S = 0.1, 1.0  # between shots of a recording without times; at most


@dataclass(frozen=True, eq=False)
class LiveShot(Record):
    """A shot, left and right as the user has them; its number in this capture, from 1; when it came, time.monotonic, s."""

    shot: Shot
    number: int
    arrived_s: float

    def age_s(self, now_s: float) -> float:
        """Return how old the images are, s: since their stamp if it is on this computer's clock, else since they came."""
        stamp = self.shot.t_s
        live = stamp is not None and 0.0 <= self.arrived_s - stamp < LIVE_S
        return now_s - (stamp if live and stamp is not None else self.arrived_s)


class CameraCapture:
    """The cameras of a session; ``failed`` is called with why there are no images, once for each cause."""

    def __init__(self, opening: Callable[[], Source], failed: Callable[[str], None] = lambda problem: None) -> None:
        self._opening, self._say = opening, failed
        self.newest: LiveShot | None = None
        self.swapped = False  # left and right are exchanged
        self.problem: str | None = None  # why there are no images now
        self._changed = threading.Condition()
        self._polled = 0
        self._intervals: deque[float] = deque(maxlen=30)
        self._ended, self._paused, self._idle = threading.Event(), threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="capture", daemon=True)

    def start(self) -> None:
        """Start reading."""
        self._thread.start()

    @property
    def rate_hz(self) -> float | None:
        """Shots a second; None before three of them."""
        intervals = list(self._intervals)
        middle = statistics.median(intervals) if len(intervals) > 1 else 0.0
        return 1.0 / middle if middle > 0 else None

    @property
    def slowest_s(self) -> float:
        """The longest interval of the last second or so, s."""
        return max(self._intervals, default=0.0)

    def after(self, number: int, patience_s: float) -> LiveShot | None:
        """Wait for a shot newer than the one of a number; None where none comes in time."""
        with self._changed:
            newer = self._changed.wait_for(lambda: self.newest is not None and self.newest.number > number, patience_s)
            return self.newest if newer else None

    def poll(self) -> Shot | None:
        """Return the newest shot not returned yet, for a control loop."""
        newest = self.newest
        if newest is not None and newest.number > self._polled:
            self._polled = newest.number
            return newest.shot
        return None

    def offer(self, shot: Shot) -> None:
        """Take a shot that somebody else read."""
        if self.swapped:
            encoded = None if shot.encoded is None else (shot.encoded[1], shot.encoded[0])
            shot = replace(shot, left=shot.right, right=shot.left, encoded=encoded)
        now = time.monotonic()
        with self._changed:
            before = self.newest
            if before is not None:
                self._intervals.append(now - before.arrived_s)
            self.newest = LiveShot(shot, 1 if before is None else before.number + 1, now)
            self.problem = None
            self._changed.notify_all()

    def pause(self) -> None:
        """Read nothing until :meth:`resume`; somebody else reads the source meanwhile. Waits for a read that has begun."""
        self._paused.set()
        self._idle.wait(5.0)

    def resume(self) -> None:
        """Read again."""
        self._paused.clear()

    def close(self) -> None:
        """Stop reading, and close the source."""
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join(5.0)

    def _run(self) -> None:
        while not self._ended.is_set():
            try:
                with contextlib.closing(self._opening()) as source:
                    self._read(source)
                problem = "the recording has ended; it is shown again"
            except ArmsightError as error:
                problem = str(error)
            except Exception as error:  # noqa: BLE001 - nobody else watches this thread
                problem = f"reading the cameras failed: {type(error).__name__}: {error}"
            if not self._ended.is_set():
                self._failed(problem)

    def _read(self, source: Source) -> None:
        before: Shot | None = None
        while not self._ended.is_set():
            if self._paused.is_set():
                self._idle.set()
                time.sleep(0.02)
                continue
            self._idle.clear()
            if (shot := source.read()) is None:
                return
            if shot.problem is not None:
                self.problem = shot.problem
                continue
            self._pace(before, shot)
            before = shot
            self.offer(shot)

    def _pace(self, before: Shot | None, shot: Shot) -> None:
        """Wait until a recorded shot is due: a recording is shown at its own pace."""
        newest, now = self.newest, time.monotonic()
        if before is None or newest is None or (shot.t_s is not None and 0.0 <= now - shot.t_s < LIVE_S):
            return
        apart_s = _UNTIMED_S if shot.t_s is None or before.t_s is None else shot.t_s - before.t_s
        self._ended.wait(min(max(newest.arrived_s + apart_s - now, 0.0), _LONGEST_PAUSE_S))

    def _failed(self, problem: str) -> None:
        if problem != self.problem:
            self._say(problem)
        self.problem = problem
        self._intervals.clear()
        self._idle.set()
        self._ended.wait(_REOPEN_S)
