"""What a run happens at: an arm with its board, two cameras that look at the body on its tool. Real, or the workcell."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

from armsight.data import Array, Shot
from armsight.errors import ArmsightError, DeviceError
from armsight.robot.arm import Arm
from armsight.robot.boards.board import Board
from armsight.vision.markers.targets import Composite
from armsight.vision.sources.source import Source

_JOIN_S = 2.0
#: Crystals of host and board drift apart by less: 50 ppm each, and what the host's clock is slewed by.
DRIFT = 2e-4
#: A live image's stamp lies no further from now, s.
_LIVE_S = 10.0


class HostClock:
    """Brings times of the host's clock, which stamps images, to the board's, which stamps readings.

    A reading that is heard at h of the host's clock and stamped b by the board gives h - b: the offset of the clocks and
    the time it was under way. The least of these is the offset and the shortest way; that is the same for all of a run, and
    is taken up by the cameras' delay, which is measured afterwards. Between two such the least may rise as fast as clocks
    drift: so it follows them, and one reading that came quickly is enough to bring it back.

    Args:
        now: the host's clock, s; the one that stamps the images.
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        self._least_s: float | None = None
        self._heard_s = 0.0

    def heard(self, board_s: float) -> None:
        """Take the board's time of the newest reading, which has come just now."""
        now = self._now()
        offset = now - board_s
        if self._least_s is not None:
            offset = min(offset, self._least_s + DRIFT * (now - self._heard_s))
        self._least_s, self._heard_s = offset, now

    def on_board(self, shot: Shot) -> Shot:
        """Return a shot with its time on the board's clock; a reading must have been heard before.

        Raises:
            DeviceError: no live camera stamped it, by this computer's clock.
        """
        assert self._least_s is not None
        if shot.t_s is None and shot.problem is not None:
            return shot
        if shot.t_s is None or abs(self._now() - shot.t_s) > _LIVE_S:
            said = (
                "has no time" if shot.t_s is None else f"was taken {self._now() - shot.t_s:.0f} s ago by its own time"
            )
            raise DeviceError(
                f"shot {shot.name} {said}: is it of a recording? A run needs live cameras (usb:..., url:...)"
            )
        return replace(shot, t_s=shot.t_s - self._least_s)


@dataclass(frozen=True)
class Setup:
    """Where a run happens.

    Attributes:
        arm: the nominal arm.
        board: its joints' board, drives off.
        poll: returns the newest shot not handed out yet, or None.
        target: the body on the tool.
        gravity: gives the duty (6,) that carries the arm's weight at joint angles (6,); zeros where nobody knows.
        rate_hz: of the cameras.
        sync_s: standard deviation of the time between the two exposures of a shot, s.
        clock: of the computer that stamps the shots, and on which time passes by itself; None in lock-step, where shots are
            on the board's clock and its time passes only in ``receive``.
    """

    arm: Arm
    board: Board
    poll: Callable[[], Shot | None]
    target: Composite
    gravity: Callable[[Array], Array]
    rate_hz: float
    sync_s: float
    clock: HostClock | None = None


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
            except Exception as error:  # noqa: BLE001 - whatever it is, it is told by poll: nobody watches this thread
                self._failure = DeviceError(f"reading the cameras failed: {type(error).__name__}: {error}")
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
