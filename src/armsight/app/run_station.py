"""What a run happens at: an arm with its board, two cameras that look at the body on its tool. Real, or the workcell."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass

from armsight.data import Array, Shot
from armsight.errors import ArmsightError, DeviceError
from armsight.robot.arm import Arm
from armsight.robot.boards.board import Board
from armsight.vision.markers.targets import Composite
from armsight.vision.sources.source import Source

_JOIN_S = 2.0


@dataclass(frozen=True)
class Station:
    """Where a run happens.

    Attributes:
        arm: the nominal arm.
        board: its joints' board, drives off.
        poll: returns the newest shot not handed out yet, or None.
        target: the body on the tool.
        gravity: gives the duty (6,) that carries the arm's weight at joint angles (6,); zeros where nobody knows.
        rate_hz: of the cameras.
        sync_s: standard deviation of the time between the two exposures of a shot, s.
    """

    arm: Arm
    board: Board
    poll: Callable[[], Shot | None]
    target: Composite
    gravity: Callable[[Array], Array]
    rate_hz: float
    sync_s: float


class LiveShots:
    """Reads a source in a thread of its own and keeps the newest shot: a loop must not wait for a camera.

    Args:
        source: the cameras; closed with this.
    """

    def __init__(self, source: Source) -> None:
        self._source = source
        self._lock = threading.Lock()
        self._newest: Shot | None = None
        self._failure: ArmsightError | None = None
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        while not self._ended.is_set():
            try:
                shot = self._source.read()
            except ArmsightError as error:
                self._failure = error
                return
            if shot is None:
                self._failure = DeviceError("the source of images has come to its end")
                return
            with self._lock:
                self._newest = shot

    def poll(self) -> Shot | None:
        """Return the newest shot not handed out yet, or None.

        Raises:
            DeviceError: a camera is gone, or the source has ended.
        """
        with self._lock:
            shot, self._newest = self._newest, None
        if shot is None and self._failure is not None:
            raise self._failure
        return shot

    def close(self) -> None:
        """Stop reading and let go of the cameras."""
        self._ended.set()
        self._thread.join(_JOIN_S)
        self._source.close()
