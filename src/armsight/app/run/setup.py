"""The setup of a run: an arm with its board, and two cameras that see the body on its tool; real devices or the workcell.

:class:`Setup` is the record that the loop is given. Two helpers are for real devices, whose time passes by itself:
:class:`HostClock` converts image times from the computer's clock to the board's, and :class:`LiveShots` reads the cameras
in a thread. :func:`setup_of` makes the setup of a workcell; :func:`open_devices` opens what the command line names.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from armsight.data import Array, Shot
from armsight.errors import ArmsightError, DeviceError, InputError
from armsight.robot.board_registry import EMULATED, emulator_name, open_motion_board, slowed
from armsight.robot.boards.board import Board
from armsight.robot.boards.contract import MotionBoard
from armsight.robot.kinematics.arm import Arm
from armsight.vision.markers.marker import Target
from armsight.vision.markers.targets import Composite
from armsight.vision.sources import Source, open_source

if TYPE_CHECKING:
    from armsight.sim.workcell.workcell import Workcell

_JOIN_S = 2.0
_SIM = "sim:"
#: The workcell's arm and cameras where ``sim:`` names none: those of ``armsight demo``.
_SIM_ARM, _SIM_CAMERAS = "worn", "1280x720@60"
#: Bound on the relative drift of the two clocks: 50 ppm for each crystal, and the slewing of the host's clock.
DRIFT = 2e-4
#: The clocks' rate is that of so many seconds; the least transmission times of two seconds differ by about this, s.
_WINDOW_S, _SCATTER_S = 60, 1e-3
#: A live image's time stamp differs from the present time by at most this, s.
_LIVE_S = 10.0


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
        assert self._least_s is not None
        if shot.t_s is None and shot.problem is not None:
            return shot
        # The clock of cameras that were live may jump.
        if shot.t_s is None or (abs(self._now() - shot.t_s) > _LIVE_S and not self._live):
            problem = (
                "has no time" if shot.t_s is None else f"was taken {self._now() - shot.t_s:.0f} s ago by its own time"
            )
            raise DeviceError(
                f"shot {shot.name} {problem}: is it of a recording? A run needs live cameras (usb:..., url:...)"
            )
        self._live = True
        return replace(shot, t_s=shot.t_s - self._least_s)


@dataclass(frozen=True)
class Setup:
    """The devices of a run, and what is known of them.

    Attributes:
        arm: the nominal arm.
        board: the controller board of its joints, drives off.
        poll: returns the newest shot not returned yet, or None.
        target: the body on the tool.
        gravity: returns the duty (n,) that compensates the gravity torque at joint angles (n,), rad; zeros where it is
            unknown.
        rate_hz: rate of the cameras, Hz.
        sync_s: standard deviation of the time between the two exposures of a shot, s.
        clock: converts times of the computer, which stamps the shots, to the board's; None in lock-step simulation, where
            shots are on the board's clock and time passes only in ``board.receive``.
        fixed: bodies in view that do not move.
        sync_led_bit_s: how long each bit of the sync LED's code lasts, s; None where no LED is to be looked for.
    """

    arm: Arm
    board: MotionBoard
    poll: Callable[[], Shot | None]
    target: Composite
    gravity: Callable[[Array], Array]
    rate_hz: float
    sync_s: float
    clock: HostClock | None = None
    fixed: tuple[Target, ...] = ()
    sync_led_bit_s: float | None = None


class LiveShots:
    """Reads a source in a thread and keeps the newest shot, so that the control loop never waits for a camera.

    Nothing is read before :meth:`start`.

    Args:
        source: the cameras; :meth:`close` closes them.
    """

    def __init__(self, source: Source) -> None:
        self._source = source
        self._lock = threading.Lock()
        self._newest: Shot | None = None
        self._failure: ArmsightError | None = None
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
            self._thread.join(_JOIN_S)
        self._source.close()


def setup_of(workcell: Workcell) -> Setup:
    """Return the setup of a workcell: the interface that real devices have as well."""
    timing = workcell.timing
    sync_s = float(np.hypot(timing.sync_s / np.sqrt(3), timing.skew_s))
    return Setup(
        workcell.model,
        workcell.board,
        workcell.poll,
        workcell.target,
        workcell.gravity_duty,
        timing.rate_hz,
        sync_s,
        sync_led_bit_s=sync_led_bit_s(workcell.board, "the workcell") if workcell.source.shows_led else None,
    )


def sync_led_bit_s(board: MotionBoard, name: str) -> float:
    """Return how long each bit of the code lasts that a board's sync LED blinks, s.

    Args:
        board: the board.
        name: what the user calls it.

    Raises:
        InputError: it has no LED.
    """
    if not isinstance(board, Board):
        raise InputError(f"--sync-led: {name} keeps its own controller, which drives no LED on its clock")
    config = board.configuration()
    if not config["sync_led_pin"]:
        raise InputError(
            f"--sync-led: {name} drives no LED: choose its pin with armsight board config set arm.sync_led_pin=PB13,"
            " and start the board anew"
        )
    return int(config["sync_led_ticks"]) / board.welcome.ticks_per_s


@dataclass(frozen=True)
class Devices:
    """The devices as the command line names them.

    Attributes:
        source: the cameras, such as usb:0,1; or sim:.
        board: the controller board, such as serial:/dev/ttyACM0; or emulated:.
        arm: the nominal arm.
        target: the body on the tool.
        rate_hz: rate of the cameras, Hz.
        sync_s: standard deviation of the time between the two exposures of a shot, s.
        calibration: LeRobot's calibration file of a servo bus; None without.
        sync_led: whether an LED on the board's clock is in view.
    """

    source: str
    board: str
    arm: Arm
    target: Composite
    rate_hz: float
    sync_s: float
    calibration: Path | None = None
    sync_led: bool = False


def require_joints(board: MotionBoard, name: str, arm: Arm) -> None:
    """Raise an InputError if a board drives another number of joints than the arm has."""
    if board.abilities.joints != len(arm.a):
        raise InputError(
            f"--board {name} has {board.abilities.joints} joints, --arm {arm.name} {len(arm.a)}: give the arm that is at"
            " the board (armsight arm list)"
        )


def planned_for(arm: Arm, board: str) -> Arm:
    """Return an arm whose motions its board of this name follows; in the workcell it stands where the cameras see it."""
    if not board.startswith(EMULATED):
        return slowed(arm, board)
    from armsight.sim.workcell.controlled import CONTROLLED, standing

    own = CONTROLLED.get(arm.name)
    return standing(arm) if own is None else slowed(standing(arm), own.board)


@contextlib.contextmanager
def open_devices(devices: Devices) -> Iterator[Setup]:
    """Open the devices, or the workcell instead of them, and close them at the end of the block."""
    source, board = devices.source, devices.board
    if source.startswith(_SIM) != board.startswith(EMULATED):
        raise InputError(
            f"--source {source} --board {board}: {_SIM} and {EMULATED} are one workcell and go together; real ones are "
            "usb:0,1 and serial:/dev/ttyACM0, feetech:PORT or ar4:PORT"
        )
    with contextlib.ExitStack() as stack:
        if source.startswith(_SIM):
            from armsight.sim.workcell.workcell import Workcell

            emulator = "unicorn" if board == EMULATED else emulator_name(board)
            cameras = source.removeprefix(_SIM) or _SIM_CAMERAS
            led = devices.sync_led
            workcell = stack.enter_context(
                Workcell.open(arm=_SIM_ARM, cameras=cameras, emulator=emulator, model=devices.arm, sync_led=led)
            )
            yield replace(setup_of(workcell), target=devices.target)
            return
        opened = stack.enter_context(open_motion_board(board, calibration=devices.calibration))
        require_joints(opened, board, devices.arm)
        bit_s = sync_led_bit_s(opened, f"--board {board}") if devices.sync_led else None
        shots = LiveShots(open_source(source))
        stack.callback(shots.close)
        shots.start()
        yield Setup(
            devices.arm,
            opened,
            shots.poll,
            devices.target,
            np.zeros_like,
            devices.rate_hz,
            devices.sync_s,
            HostClock(),
            sync_led_bit_s=bit_s,
        )
