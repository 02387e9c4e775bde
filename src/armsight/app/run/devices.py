"""The devices that the command line names, opened as a loop takes them: real ones, or the workcell instead of them."""

from __future__ import annotations

import contextlib
import json
import math
import re
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from armsight.app.options import SIM
from armsight.app.show.messages import note, require
from armsight.data import Array
from armsight.errors import DeviceError, InputError
from armsight.loop.references.distance import Distance
from armsight.loop.references.file import COLUMNS, Entry, columns_of
from armsight.loop.references.inertial import INERTIAL_CLASSES, Inertial
from armsight.loop.running.beside import Fused, fused
from armsight.loop.running.setup import HostClock, LiveShots, Setup
from armsight.robot.board_registry import EMULATED, check_board, emulator_name, open_motion_board, slowed
from armsight.robot.boards.board import Board
from armsight.robot.boards.contract import MotionBoard
from armsight.robot.boards.serial import BAUD
from armsight.robot.kinematics.arm import Arm
from armsight.sim.references.distance import DrawWire
from armsight.sim.references.heading import MagneticUnit
from armsight.sim.references.inertial import InertialErrors, InertialUnit
from armsight.vision.markers.targets import Composite
from armsight.vision.sources import open_source

if TYPE_CHECKING:
    from armsight.sim.workcell.workcell import Workcell

#: The workcell's arm and cameras where ``sim:`` names none: those of ``armsight demo``.
_SIM_ARM, _SIM_CAMERAS = "worn", "1280x720@60"
_UNIT_HZ, _FIELDS_HZ = 1000.0, 50.0  # of an inertial unit, a magnetometer in the workcell whose table does not say
_RATE_HZ = 60.0  # of cameras whose times show none; half: the loop expects shots late, double: early


#: A first reading is waited for so long, s; half: slow sensors are missed, double: a wrong port is said late.
FIRST_S = 3.0
_WAIT_S = 0.1  # for a line: so soon a thread sees that it is to end
_LINES_BYTES = 65_536
#: s: stamps so far off their arrival, for so long, are of a clock that jumped; half: stalls are, double: more is lost.
JUMP_S = 1.0
#: Stamps that fall by more, or are later than now, s, are of a clock that jumped; half: overtaken ones are, double:
#: few.
STEP_S = 0.05


class LiveReadings:
    """Reads a sensor in a thread. Its clock is converted as the board's is: by what came fastest.

    A line that is no reading, or whose stamp is off by ``JUMP_S``, is left out. Where all are off for ``JUMP_S``, the clock
    jumped, as with a sensor that began anew: it is converted anew.

    Raises:
        InputError: the table does not say, or what comes is not its readings.
        DeviceError: the port cannot be opened, or nothing comes.
    """

    def __init__(self, entry: Entry, clock: HostClock, now: Callable[[], float] = time.monotonic) -> None:
        self._where, self._kind = f"[{entry.reference.name}]: live", type(entry.reference)
        self._names = list[tuple[str, float]]()  # of the time and the values in a line, and the factors to SI
        self._board, self._own, self._now = clock, HostClock(now), now
        self._lock, self._ended, self._problem = threading.Lock(), threading.Event(), ""
        self._rows: list[tuple[float, list[float]]] = []  # time, s, on the computer's clock; values
        self._newest_s = self._stamp_s = -np.inf  # the newest time, board's clock, and stamp
        self._heard_s, self._off_s = now(), np.inf  # when the newest reading came, and the first after it that is off
        self.losses = Counter[str]()
        self._closing = contextlib.ExitStack()
        self._read = self._opened(entry.live or "")
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        begun = now()
        while not self._rows and now() - begun < FIRST_S:
            time.sleep(0.01)
        if not self._rows:
            self.close()
            if self._problem:
                raise InputError(f"{self._where}: {self._problem}")
            raise DeviceError(f"{self._where}: nothing came from {entry.live} within {FIRST_S:g} s; is it sending?")

    def _opened(self, spec: str) -> Callable[[], bytes]:
        if match := re.fullmatch(r"udp:(?:(.+):)?(\d{1,5})", spec):
            receiver = self._closing.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            receiver.settimeout(_WAIT_S)
            try:
                receiver.bind((match[1] or "127.0.0.1", int(match[2])))
            except (OSError, OverflowError) as error:
                raise DeviceError(f"{self._where}: {spec} cannot be opened: {error}") from None
            return lambda: receiver.recv(_LINES_BYTES) + b"\n"
        if match := re.fullmatch(r"serial:([^,]+)(?:,(\d+))?", spec):
            require(f"{self._where}: {spec}", "board", "serial")
            import serial

            try:
                port = self._closing.enter_context(serial.Serial(match[1], int(match[2] or BAUD), timeout=_WAIT_S))
            except (OSError, ValueError) as error:
                raise DeviceError(f"{self._where}: {spec} cannot be opened: {error}") from None
            return lambda: bytes(port.readline())
        raise InputError(f"{self._where} is {spec!r}; expected udp:[HOST:]PORT or serial:PORT[,BAUD]")

    def _run(self) -> None:
        rest = b""
        silent_s = self._now()
        while not self._ended.is_set():
            if self._now() - max(self._heard_s, silent_s) > FIRST_S:
                silent_s = self._now()
                self.losses[f"no reading came for {FIRST_S:g} s"] += 1
            try:
                rest += self._read()
            except TimeoutError:
                continue
            except OSError as error:  # it was disconnected: a run goes on without it
                self._problem = f"it was lost: {error}"
                self.losses[self._problem] += 1
                return
            *lines, rest = rest.split(b"\n")
            for line in filter(bytes.strip, lines):
                self._take(line)
            rest = rest[-_LINES_BYTES:]

    def _take(self, line: bytes) -> None:
        now = self._now()
        try:
            record = {**json.loads(line)}
            if not self._names or any(name not in record for name, _ in self._names):
                self._names = columns_of(self._kind, list(record), f"{line[:40]!r}")
            t_s, *values = (factor * float(record[name]) for name, factor in self._names)
        except (InputError, ValueError, TypeError, OverflowError, RecursionError) as error:
            expected = f"expected lines of JSON with t_s, {', '.join(COLUMNS[self._kind])}"
            missing = str(error) if isinstance(error, InputError) else f"{line[:40]!r} is no JSON object of numbers"
            self._problem = f"{expected}; {missing}"
            self.losses["a line was no reading"] += 1
            return
        # No time is known of a stamp whose last digit is longer than JUMP_S; NaN and infinity are among them.
        if not (np.isfinite(values).all() and math.ulp(t_s) < JUMP_S):
            self.losses["a line was no reading"] += 1
            return
        with self._lock:
            if self._stamp_s == -np.inf:
                self.losses.clear()  # the first line of a port may be cut
            elif abs(late_s := now - self._own.offset_s - t_s) > JUMP_S and now - self._off_s < JUMP_S:
                self._off_s = min(self._off_s, now)
                self.losses[f"a stamp was more than {JUMP_S:g} s off"] += 1
                return
            elif abs(late_s) > JUMP_S or max(self._stamp_s - t_s, -late_s) > STEP_S:
                self._own, self._stamp_s = HostClock(self._now), -np.inf
                self.losses["its clock jumped"] += 1
            self._heard_s, self._off_s = now, np.inf
            if t_s > self._stamp_s:  # repeated ones are left out
                self._stamp_s = t_s
                self._own.heard(t_s)
                self._rows.append((t_s + self._own.offset_s, values))

    def __call__(self, end_s: float) -> tuple[Array, Array]:
        """Return times (N,), s, on the board's clock, and readings (N, 6) that came since the last call."""
        with self._lock:
            rows, self._rows = self._rows, []
        t_s = np.array([t for t, _ in rows]) - (self._board.offset_s if rows else 0.0)
        rising = t_s > np.maximum.accumulate(np.append(self._newest_s, t_s))[:-1]
        self._newest_s = max(self._newest_s, t_s.max(initial=-np.inf))
        return t_s[rising], np.array([values for _, values in rows]).reshape(-1, len(COLUMNS[self._kind]))[rising]

    def close(self) -> None:
        """Stop reading."""
        self._ended.set()
        self._thread.join(1.0)
        self._closing.close()


def setup_of(workcell: Workcell) -> Setup:
    """Return the setup of a workcell: the interface that real devices have as well."""
    w, timing = workcell, workcell.timing
    sync_s = float(np.hypot(timing.sync_s / np.sqrt(3), timing.skew_s))
    bit_s = sync_led_bit_s(w.board, "the workcell") if w.source.shows_led else None
    devices = w.model, w.board, w.poll, w.target, w.gravity_duty
    return Setup(*devices, timing.rate_hz, sync_s, sync_led_bit_s=bit_s)


def simulated_unit(workcell: Workcell, entry: Entry, seed: int) -> Fused:
    """Return a sensor on the workcell's tool, a unit as its class is, with errors beyond what its calibration knows."""
    rng = np.random.default_rng([seed, 77])
    if not isinstance(entry.reference, Inertial):
        simulated = DrawWire if isinstance(entry.reference, Distance) else MagneticUnit
        return fused(entry, workcell.carry(simulated(rng, entry.rate_hz or _FIELDS_HZ)))
    c = INERTIAL_CLASSES[entry.sensor_class]
    drawn = (c.gyro_noise, c.noise), (c.gyro_bias, c.bias), c.scale, c.g_sensitivity, rng
    errors = InertialErrors.typical(*drawn, good=entry.sensor_class == "icm-42688", rate_hz=entry.rate_hz or _UNIT_HZ)
    return fused(entry, workcell.carry(InertialUnit(errors, rng)))


def sync_led_bit_s(board: MotionBoard, name: str) -> float:
    """Return how long each bit of the code lasts that a board's sync LED blinks, s; an InputError says that it has none."""
    if not isinstance(board, Board):
        raise InputError(f"--sync-led: {name} keeps its own controller, which drives no LED on its clock")
    config = board.configuration()
    if not config["sync_led_pin"]:
        how = "choose its pin with armsight board config set arm.sync_led_pin=PB13, and start the board anew"
        raise InputError(f"--sync-led: {name} drives no LED: {how}")
    return int(config["sync_led_ticks"]) / board.welcome.ticks_per_s


@dataclass(frozen=True)
class Devices:
    """The devices as the command line names them."""

    source: str  #: the cameras, such as usb:0,1; or sim:
    board: str  #: the controller board, such as serial:/dev/ttyACM0; or emulated:
    arm: Arm  #: the nominal arm
    target: Composite  #: the body on the tool
    sync_s: float  #: standard deviation of the time between the two exposures of a shot, s
    sync_led: bool = False  #: whether an LED on the board's clock is in view
    reference: Entry | None = None  #: an inertial unit that is fused and recorded


def require_joints(board: MotionBoard, name: str, arm: Arm) -> None:
    """Close a board that drives another number of joints than the arm has, and raise an InputError."""
    if board.abilities.joints != len(arm.a):
        board.close()
        other = f"--arm {arm.name} {len(arm.a)}: give the arm that is at the board (armsight arm list)"
        raise InputError(f"--board {name} has {board.abilities.joints} joints, {other}")


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
    if source.startswith(SIM) != board.startswith(EMULATED):
        real = "real ones are usb:0,1 and serial:/dev/ttyACM0, feetech:PORT or ar4:PORT"
        raise InputError(f"--source {source} --board {board}: {SIM} and {EMULATED} go together; {real}")
    with contextlib.ExitStack() as stack:
        if source.startswith(SIM):
            from armsight.sim.workcell.workcell import Workcell

            cameras = source.removeprefix(SIM) or _SIM_CAMERAS
            how: Any = {"model": devices.arm, "sync_led": devices.sync_led, "target": devices.target}
            opened = Workcell.open(arm=_SIM_ARM, cameras=cameras, emulator=emulator_name(board), **how)
            workcell = stack.enter_context(opened)
            beside = None if devices.reference is None else simulated_unit(workcell, devices.reference, 0)
            yield replace(setup_of(workcell), target=devices.target, beside=beside)
            return
        check_board(board)  # a mistake is said before the cameras are waited for
        shots = LiveShots(open_source(source))
        stack.callback(shots.close)
        shots.start()
        rate_hz, stamped = shots.rate_hz()  # before the board is opened: what it says meanwhile would pile up
        if not stamped:
            taken = f"{_RATE_HZ:g} Hz is taken" if rate_hz is None else f"they come at {rate_hz:.1f} Hz, which is taken"
            note(f"the times of the shots show no rate of the cameras: {taken}")
        controller = stack.enter_context(open_motion_board(board))
        require_joints(controller, board, devices.arm)
        bit_s = sync_led_bit_s(controller, f"--board {board}") if devices.sync_led else None
        beside, clock = None, HostClock()
        if devices.reference is not None:
            readings = LiveReadings(devices.reference, clock)
            stack.callback(readings.close)
            beside = fused(devices.reference, readings, readings.losses)
        has = devices.arm, controller, shots.poll, devices.target, np.zeros_like, rate_hz or _RATE_HZ
        yield Setup(*has, devices.sync_s, clock, sync_led_bit_s=bit_s, beside=beside)
