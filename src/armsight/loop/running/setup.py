"""What a loop is given: an arm with its board, and two cameras that see the body on its tool.

Two helpers are for real devices, whose time passes by itself: :class:`HostClock` converts
image times from the computer's clock to the board's, and :class:`LiveShots` reads the cameras in a thread.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from armsight.data import Array, Shot
from armsight.errors import ArmsightError, DeviceError
from armsight.loop.running.beside import Fused
from armsight.robot.boards.contract import MotionBoard
from armsight.robot.kinematics.arm import Arm
from armsight.vision.markers.marker import Target
from armsight.vision.markers.targets import Composite
from armsight.vision.source import LIVE_S
from armsight.vision.sources import Source

#: Bound on the relative drift of the two clocks: 50 ppm for each crystal, and the slewing of the host's clock.
DRIFT = 2e-4
RATE_SHOTS = 12  # that show the cameras' rate; half: a stall at the start counts, double: a run begins later
RATE_S = 10.0  # they are waited for so long, s; half: slow cameras are rejected, double: a lost one is noticed late
_FEWEST_SHOTS, _RATES_HZ = 3, (0.5, 1000.0)  # that show a rate, and what it can be
#: The clocks' rate is that of so many seconds; the least transmission times of two seconds differ by about this, s.
_WINDOW_S, _SCATTER_S = 60, 1e-3


class HostClock:
    """Converts times of the host's clock, which stamps images, to the board's clock, which stamps readings.

    A reading received at time h of the host's clock with the board's stamp b gives h - b: the offset of the clocks plus
    the transmission time. The estimate is the minimum of these differences: the offset plus the shortest transmission
    time. The latter is constant over a run; it becomes part of the cameras' delay, which is measured afterwards. Between
    two readings the minimum is allowed to rise as the clocks drift apart: so it follows the drift, and one reading that
    arrives quickly restores it. How fast they drift is the slope of the line under all minima of the last ``_WINDOW_S``
    that is highest in their middle (Moon, Skelly and Towsley, "Estimation and removal of clock skew from network delay
    measurements", 1999), so that a host that is busy for seconds does not move the offset by as much as any clock drifts.

    Args:
        now: the host's clock, s; the one that stamps the images.
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        self._least_s: float | None = None
        self._live = False
        self._heard_s, self._rise = 0.0, DRIFT
        self._minima = deque[tuple[float, float]](maxlen=_WINDOW_S)  # of each second: board's time, difference

    def heard(self, board_s: float) -> None:
        """Update the offset with the board's time stamp of a reading received just now, s."""
        now = self._now()
        difference = offset = now - board_s
        if self._least_s is not None:
            offset = min(offset, self._least_s + self._rise * (now - self._heard_s))
        self._least_s, self._heard_s = offset, now
        if not self._minima or board_s >= math.floor(self._minima[-1][0]) + 1.0:
            self._rise = self._highest_rate()
            self._minima.append((board_s, difference))
        elif difference < self._minima[-1][1]:
            self._minima[-1] = board_s, difference

    @property
    def offset_s(self) -> float:
        """What is added to a time of the board for one of the host, s; a reading must have been heard before."""
        assert self._least_s is not None
        return self._least_s

    def _highest_rate(self) -> float:
        """Return how fast the offset rises, at most: the line under the minima, and what their scatter leaves open."""
        if len(self._minima) < 2:
            return DRIFT
        t_s, least_s = np.array(self._minima).T
        middle = 0.5 * (t_s[0] + t_s[-1])
        n = np.searchsorted(t_s, middle, side="right")
        rates = (least_s[n:] - least_s[:n, None]) / (t_s[n:] - t_s[:n, None])
        rate = rates.flat[np.argmin(least_s[:n, None] + rates * (middle - t_s[:n, None]))]
        return float(np.clip(rate + _SCATTER_S / (t_s[-1] - t_s[0]), -DRIFT, DRIFT))

    def on_board(self, shot: Shot) -> Shot:
        """Return a shot with its time on the board's clock; a reading must have been heard before.

        Raises:
            DeviceError: no live camera stamped it, by this computer's clock.
        """
        if shot.t_s is None and shot.problem is not None:
            return shot
        t_s = shot.t_s if shot.t_s is not None and math.isfinite(shot.t_s) else None
        # The clock of cameras that were live may jump.
        if t_s is None or (abs(self._now() - t_s) > LIVE_S and not self._live):
            problem = "has no time" if t_s is None else f"was taken {self._now() - t_s:.0f} s ago by its own time"
            raise DeviceError(
                f"shot {shot.name} {problem}: is it of a recording? A run needs live cameras (usb:..., url:...)"
            )
        self._live = True
        return replace(shot, t_s=t_s - self.offset_s)


@dataclass(frozen=True)
class Setup:
    """The devices of a run, and what is known of them."""

    arm: Arm  #: the nominal arm
    board: MotionBoard  #: the controller board of its joints, drives off
    poll: Callable[[], Shot | None]  #: returns the newest shot not returned yet, or None
    target: Composite  #: the body on the tool
    #: returns the duty (n,) that compensates the gravity torque at joint angles (n,), rad; zeros where it is unknown.
    gravity: Callable[[Array], Array]
    rate_hz: float  #: rate of the cameras, Hz
    sync_s: float  #: standard deviation of the time between the two exposures of a shot, s
    #: converts the computer's times, which stamp the shots, to the board's; None in lock-step simulation
    clock: HostClock | None = None
    fixed: tuple[Target, ...] = ()  #: bodies in view that do not move
    #: how long each bit of the sync LED's code lasts, s; None where no LED is to be looked for.
    sync_led_bit_s: float | None = None
    beside: Fused | None = None  #: a reference beside vision whose readings are fused and recorded; None without


class LiveShots:
    """Reads a source in a thread and keeps the newest shot, so that the control loop never waits for a camera."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self._lock = threading.Lock()
        self._newest: Shot | None = None
        self._failure: ArmsightError | None = None
        self._times = deque[tuple[float, float]](maxlen=RATE_SHOTS)  # when shots were taken, and when they came, s
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Start reading."""
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        while not self._ended.is_set():
            try:
                shot = self._source.read()
            except ArmsightError as error:
                self._failure = error
                return
            except Exception as error:  # noqa: BLE001 - poll raises it: nobody else watches this thread
                self._failure = DeviceError(f"reading the cameras failed: {type(error).__name__}: {error}")
                return
            if shot is None:
                self._failure = DeviceError("the source of images has ended")
                return
            with self._lock:
                self._newest = shot
            self._times.append((np.nan if shot.t_s is None else shot.t_s, time.monotonic()))

    def rate_hz(self) -> tuple[float | None, bool]:
        """Wait for the first shots, and return how many are taken a second, by the median of the times between them.

        Times that are missing or do not rise are not used. Where the others show no rate that cameras have, it is how many
        come a second, and the second is False; None where that is no such rate either.

        Raises:
            DeviceError: a camera was disconnected, or hardly a shot comes.
        """
        end = time.monotonic() + RATE_S
        while len(self._times) < RATE_SHOTS and self._failure is None and time.monotonic() < end:
            time.sleep(0.01)
        if len(times := list(self._times)) < _FEWEST_SHOTS:
            raise self._failure or DeviceError(
                f"{len(times)} shots came in {RATE_S:g} s: are both cameras there, and uncovered?"
            )
        for apart_s, stamped in zip(np.diff(times, axis=0).T, (True, False), strict=True):
            rising = apart_s[np.isfinite(apart_s) & (apart_s > 0)]
            rate = 1.0 / float(np.median(rising)) if len(rising) >= _FEWEST_SHOTS - 1 else 0.0
            if _RATES_HZ[0] <= rate <= _RATES_HZ[1]:
                return rate, stamped
        return None, False

    def poll(self) -> Shot | None:
        """Return the newest shot not returned yet, or None.

        Raises:
            DeviceError: a camera was disconnected, or the source has ended.
        """
        with self._lock:
            shot, self._newest = self._newest, None
        if shot is None and self._failure is not None:
            raise self._failure
        return shot

    def close(self) -> None:
        """Stop reading and close the cameras."""
        self._ended.set()
        if self._thread is not None:
            self._thread.join(2.0)
        self._source.close()
