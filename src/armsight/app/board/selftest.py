"""The board's self-test: the scenarios that every board must pass, a hash of its answers, its speed and its size.

A scenario is a function of a :class:`BoardTestRig`: it moves the board as a host would, disturbs its wire, and notes on the
rig what is not as it must be. Those in :data:`AT_REST` also run where the drives of a real board must stay off.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from armsight import firmware
from armsight.data import Array, JointCommand
from armsight.errors import ArmsightError, DeviceError
from armsight.firmware.elf import read_elf
from armsight.robot.board_registry import SERIAL, configured, emulator_name, serial_port
from armsight.robot.boards.board import Board
from armsight.robot.boards.codes import BoardState, Command, Fault, Rejection
from armsight.robot.boards.configuration import JOINTS, gains_array
from armsight.robot.boards.emulated import EmulatedLink
from armsight.robot.boards.emulators import open_emulator
from armsight.robot.boards.link import Emulator, Link
from armsight.robot.boards.serial import BAUD, SerialLink
from armsight.sim.joints import JointPlant, PotFault

PERIOD_S = 0.01  # the host's period, s
_SINE_HZ = 0.5  # frequency of the swing, Hz
_NEAR_RAD = 0.1  # the joints stay this near to their commanded angles while they swing, rad
#: How long an arm may take to come to rest without a host, and what its board is then.
_REST_S = 3.0
_AT_REST_STATES = (BoardState.HOLDING, BoardState.FAULTED)


class SpoiledLink:
    """A link whose bytes to the board can be spoiled on their way."""

    def __init__(self, link: Link) -> None:
        self.read, self.close, self._write = link.read, link.close, link.write
        #: What happens to the bytes of one write; None leaves them alone.
        self.spoil: Callable[[bytes], bytes] | None = None

    def write(self, data: bytes) -> None:
        """Send bytes, spoiled."""
        self._write(data if self.spoil is None else self.spoil(bytes(data)))


@dataclass
class BoardTestRig:
    """A board, what it drives, and what was found wrong with it; :meth:`connect` makes one."""

    wire: SpoiledLink  #: the link, whose bytes to the board can be spoiled
    board: Board  #: the board, connected over this link
    plant: JointPlant | None  #: the emulated arm; None where the board is a real one
    problems: list[str]  #: filled with what is not as it must be
    amplitude_rad: float  #: how far the joints swing from their home, at most
    driven: bool  #: whether the drives may be switched on
    home_rad: Array = field(default_factory=lambda: np.zeros(JOINTS))  #: (6,) joint angles that they swing about
    _start_rad: Array = field(default_factory=lambda: np.zeros(JOINTS))
    _side: Array = field(default_factory=lambda: np.ones(JOINTS))
    _t_s: float = 0.0

    @classmethod
    def connect(
        cls,
        link: Link,
        plant: JointPlant | None,
        problems: list[str],
        *,
        amplitude_rad: float = 0.4,
        home_rad: Array | None = None,
        driven: bool = True,
        name: str = "the emulated board",
    ) -> BoardTestRig:
        """Connect to a board: ``name`` is what errors call it, home is where the joints are at first, if not given."""
        wire = SpoiledLink(link)
        here = cls(wire, Board.connect(wire, name=name), plant, problems, amplitude_rad, driven)
        here.home_rad = here.readings(0.02)[-1] if home_rad is None else home_rad
        return here

    def expect(self, holds: bool, what: str) -> None:
        """Note what is wrong where something does not hold."""
        if not holds:
            self.problems.append(what)

    def expect_state(self, state: BoardState, when: str) -> None:
        """Note it where the board is in another state, or has faults in a state without."""
        status = self.board.status
        faults = "; ".join(map(str, status.faults)) or "no fault"
        self.expect(status.state == state, f"{when}: {status.state.name} ({faults}), not {state.name}")
        if state in (BoardState.DISABLED, BoardState.ENABLED):
            self.expect(not status.faults, f"{when}: {faults}")

    def enable(self) -> None:
        """Switch the drives on, if they may be; the joints will swing from where they are to the side of their home."""
        self._start_rad = self.readings(0.02)[-1]
        self._side, self._t_s = np.where(self._start_rad > self.home_rad, -1.0, 1.0), 0.0
        if self.driven:
            self.board.enable()

    def readings(self, wait_s: float) -> Array:
        """Let time pass and return the angles (N, 6) that came, at least one row."""
        q = self.board.receive(wait_s).q
        while not len(q):
            q = self.board.receive(PERIOD_S).q
        return q

    def command(self) -> JointCommand:
        """Return the next command of the swing: where the joints are to be a period later."""
        self._t_s += PERIOD_S
        rate = 2 * math.pi * _SINE_HZ
        at, half = rate * self._t_s, self.amplitude_rad / 2 * self._side
        # 1 - cos begins at rest.
        q = self._start_rad + half * (1 - math.cos(at))
        return JointCommand(q, half * rate * math.sin(at), np.zeros(JOINTS), PERIOD_S)

    def swing(self, duration_s: float) -> Array:
        """Swing on for so long; returns how far the readings (N, 6) were from their commanded angles."""
        errors = []
        for _ in range(round(duration_s / PERIOD_S)):
            command = self.command()
            self.board.send(command)
            errors.append(self.readings(PERIOD_S)[-1] - command.q_ref)
        return np.array(errors)

    @contextlib.contextmanager
    def swinging(self, duration_s: float) -> Iterator[None]:
        """Enable and swing for so long, and switch the drives off after the block; with the drives off let time pass."""
        self.enable()
        self.swing(duration_s) if self.driven else self.readings(duration_s)
        yield
        self.disable()

    def clear(self) -> None:
        """Clear the emergency stop, and of a driven rig the faults, and end with the drives off."""
        if self.board.status.state == BoardState.STOPPED:
            self.board.confirm(self.board.command(Command.CLEAR_STOP))
        if self.driven and self.board.status.faults:
            self.board.confirm(self.board.command(Command.CLEAR_FAULTS))
        if self.board.status.drives_on:
            self.disable()

    def disable(self) -> None:
        """Switch the drives off."""
        if self.driven:
            self.board.confirm(self.board.command(Command.DISABLE))

    def end(self) -> None:
        """Let go of a real board; where its drives were used, leave them off and its faults cleared, if it listens."""
        with contextlib.suppress(ArmsightError):
            if self.driven:
                self.clear()
        self.board.close()


Scenario = Callable[[BoardTestRig], None]


def nominal(rig: BoardTestRig) -> None:
    """Enable, swing, disable: the joints follow, no command is rejected; at rest telemetry comes, one is rejected."""
    rig.enable()
    if rig.driven:
        off = float(np.abs(rig.swing(1.0)).max())
        rig.expect_state(BoardState.ENABLED, "while swinging")
        rig.expect(off < _NEAR_RAD, f"joints are up to {off:.3f} rad off their way")
        rig.expect(rig.board.status.rejected_count == 0, "a command was rejected")
        rig.disable()
        rig.readings(0.1)
        rig.expect_state(BoardState.DISABLED, "after the command to disable")
    else:
        came = len(rig.readings(0.5))
        rig.expect(came > 5, f"{came} readings in 0.5 s")
        rig.expect(not rig.board.status.drives_on, "the drives are on, though nobody switched them on")
        _expect_rejected(rig, "a motion command with the drives off was not rejected")
    rig.expect(not rig.board.joints.duty.any(), "a duty is on with the drives off")


def crc_faults(rig: BoardTestRig) -> None:
    """Disturb every sixth message to the board, each at another byte and bit: dropped and counted, the others taken."""
    sent = 0

    def flip(data: bytes) -> bytes:
        nonlocal sent
        sent += 1
        if sent % 6:
            return data
        spoiled = bytearray(data)
        spoiled[sent * 7 % len(data)] ^= 1 << sent // 6 % 8
        return bytes(spoiled)

    rig.enable()
    before = rig.board.status
    rig.wire.spoil = flip
    if rig.driven:
        rig.swing(1.0)
    else:
        for _ in range(30):
            _rejection(rig)
    rig.wire.spoil = None
    rig.readings(0.05)
    after = rig.board.status
    noticed = after.crc_errors + after.lost_bytes - before.crc_errors - before.lost_bytes
    rig.expect(noticed > 0, "no disturbed message was counted")
    new = [fault for fault in after.faults if fault not in before.faults]
    rig.expect(not new, f"a disturbed wire led to {'; '.join(map(str, new))}")
    if rig.driven:
        rig.expect_state(BoardState.ENABLED, "on a disturbed wire")
    try:
        rig.board.confirm(rig.board.set_gains(gains_array(rig.board.configuration())))
    except DeviceError as error:
        rig.expect(False, f"the wire does not come back: {error}")
    rig.disable()


def host_loss(rig: BoardTestRig) -> None:
    """Fall silent in motion: the board brings the arm to rest by itself and goes on when commanded to."""
    silence_s = float(rig.board.configuration()["silence_ticks"]) / rig.board.welcome.ticks_per_s
    rig.enable()
    rig.swing(0.4)
    rig.readings(silence_s)
    for _ in range(round(_REST_S / PERIOD_S)):
        if rig.board.status.state in _AT_REST_STATES:
            break
        rig.readings(PERIOD_S)
    status = rig.board.status
    rig.expect([f.fault for f in status.faults] == [Fault.HOST_SILENT], f"silence is reported as {status.faults}")
    rig.expect(status.state in _AT_REST_STATES, f"without a host it is {status.state.name}")
    moved = float(np.ptp(rig.readings(0.1), axis=0).max())
    rig.expect(moved < _NEAR_RAD / 4, f"the arm still moves by {moved:.3f} rad in 0.1 s")
    rig.clear()
    with rig.swinging(0.2):
        rig.expect_state(BoardState.ENABLED, "after the silence was cleared")


def sensor_faults(rig: BoardTestRig) -> None:
    """Break a potentiometer in motion in each way, then the supply: each is reported by its name, and lets go."""
    plant = rig.plant
    if plant is None:
        return
    for joint, (broken, fault) in enumerate(_POT_FAULTS.items()):
        if broken == PotFault.INVERTED:  # a mistake of the wiring: so from the beginning
            plant.break_pot(joint, broken)
            rig.readings(0.1)
        rig.enable()
        rig.swing(0.4)
        if broken != PotFault.INVERTED:
            plant.break_pot(joint, broken)
        rig.swing(0.5)
        _expect_fault(rig, fault, joint)
        plant.break_pot(joint, PotFault.NONE)
        rig.readings(0.3)
        rig.clear()
    for supply_mv, fault in ((8000, Fault.SUPPLY_LOW), (16000, Fault.SUPPLY_HIGH)):
        rig.enable()
        rig.swing(0.1)
        plant.supply_mv, whole_mv = supply_mv, plant.supply_mv
        rig.swing(0.1)
        _expect_fault(rig, fault, None)
        plant.supply_mv = whole_mv
        rig.readings(0.05)
        rig.clear()


def e_stop(rig: BoardTestRig) -> None:
    """Stop, by message and by button: the drives go off, and stay off until the stop is cleared."""
    for press in [None] if rig.plant is None else [None, rig.plant]:
        rig.enable()
        rig.swing(0.3) if rig.driven else None
        if press is None:
            rig.board.stop()
        else:
            press.stop_pressed = True
            rig.readings(PERIOD_S)
        rig.readings(0.05 if rig.driven else 0.1)
        rig.expect_state(BoardState.STOPPED, "after the emergency stop")
        _expect_rejected(rig, "a stopped board took a motion command")
        with contextlib.suppress(DeviceError):
            rig.board.enable()
            rig.expect(False, "a stopped board was enabled")
        if press is not None:
            press.stop_pressed = False
            rig.readings(PERIOD_S)
        rig.clear()
    if rig.driven:
        with rig.swinging(0.1):
            rig.expect_state(BoardState.ENABLED, "after the stop was cleared")


def gain_change(rig: BoardTestRig) -> None:
    """Change the gains in motion: taken whole without a jump of the duty, or rejected whole; at rest the board's own."""
    gains = gains_array(rig.board.configuration())
    changed = gains * [1.5, 0.5, 1.2, 1.0, 1.0, 1.0, 1.0, 1.0] if rig.driven else gains
    with rig.swinging(0.35):
        before = rig.board.joints.duty
        number = rig.board.set_gains(changed)
        if rig.driven:
            rig.swing(PERIOD_S)
            jump = float(np.abs(rig.board.joints.duty - before).max())
            rig.expect(jump < 0.25, f"new gains move the duty by {jump:.2f}")
            rig.swing(0.4)
            rig.expect(rig.board.status.rejected_sequence != number, "good gains were rejected")
        else:
            rig.board.confirm(number)
        for value, reason in ((101.0, Rejection.OUT_OF_RANGE), (np.nan, Rejection.NOT_FINITE)):
            wrong = changed.copy()
            wrong[3, 0] = value
            number = rig.board.set_gains(wrong, checked=False)  # past the host's own check
            rig.swing(0.05) if rig.driven else rig.readings(0.05)
            given = _rejection_of(rig, number)
            rig.expect(given == reason, f"a gain of {value} is rejected as {given.name}, not as {reason.name}")
        if rig.driven:
            rig.expect_state(BoardState.ENABLED, "with other gains")
    same = np.array_equal(gains_array(rig.board.configuration()), changed.astype(np.float32))
    rig.expect(same, "the gains are not those that were sent last and acknowledged")
    rig.board.confirm(rig.board.set_gains(gains))


DRIVEN: Mapping[str, Scenario] = {
    each.__name__: each for each in (nominal, crc_faults, host_loss, sensor_faults, e_stop, gain_change)
}
#: What needs an arm whose sensors can be broken, and what also runs with the drives off.
EMULATED_ONLY, AT_REST = ("sensor_faults",), ("nominal", "crc_faults", "e_stop", "gain_change")
_POT_FAULTS = {PotFault[name]: Fault[f"POT_{name}"] for name in ("OPEN", "SHORT", "FROZEN", "JUMP", "INVERTED")}


def _rejection(rig: BoardTestRig) -> Rejection:
    here = rig.readings(PERIOD_S)[-1]
    number = rig.board.send(JointCommand(here, np.zeros(JOINTS), np.zeros(JOINTS), PERIOD_S))
    rig.readings(0.05)
    return _rejection_of(rig, number)


def _rejection_of(rig: BoardTestRig, number: int) -> Rejection:
    status = rig.board.status
    return status.rejection if status.rejected_sequence == number else Rejection.NONE


def _expect_rejected(rig: BoardTestRig, otherwise: str) -> None:
    rig.expect(_rejection(rig) == Rejection.WRONG_STATE, otherwise)


def _expect_fault(rig: BoardTestRig, fault: Fault, joint: int | None) -> None:
    status = rig.board.status
    first = status.first_fault
    named = first is not None and (first.fault, first.joint) == (fault, joint)
    rig.expect(named, f"{fault.name} is reported as: {'nothing' if first is None else first}")
    driven, which = status.drives_on, "drives"
    if joint is not None:
        driven, which = bool(rig.board.joints.duty[joint]), f"drive of joint {joint + 1}"
    rig.expect(not driven, f"{fault.name} leaves the {which} on")


_SMALL_RAD = 0.05  # a real arm swings by this much where it may move, rad: less than 3 degrees
#: Over how much the speed is measured: of an emulated board ticks, of a real one s.
_SPEED_TICKS, _SPEED_S = 4000, 1.0
#: Of an emulated image: flash memory, its variables without the stack, whether it is built for the floating-point unit.
_SIZES = ("flash_bytes", "ram_bytes", "hard_float")


@dataclass(frozen=True)
class ScenarioResult:
    """What one scenario found."""

    problems: tuple[str, ...]  #: what was not as it must be; empty where it passed
    trace_sha256: str | None  #: of every answer frame of the run, by time; None on a real board, which has none


@dataclass(frozen=True)
class SelftestResult:
    """What the self-test found."""

    board: str  #: its name
    scenarios: Mapping[str, ScenarioResult]  #: by name
    ticks_per_s: float  #: how fast the board runs, plant and telemetry with it; a real one by this computer's clock
    elf: dict[str, int | bool | None]  #: sizes of the emulated image, None where it is not known

    @property
    def passed(self) -> bool:
        """Whether every scenario passed."""
        return not any(each.problems for each in self.scenarios.values())

    def record(self) -> dict[str, Any]:
        """Return it ready for JSON."""
        found = {n: {"passed": not s.problems, "trace_sha256": s.trace_sha256} for n, s in self.scenarios.items()}
        return {"board": self.board, "scenarios": found, "ticks_per_s": round(self.ticks_per_s, 1), "elf": self.elf}


def run_scenario(scenario: Scenario, emulator: Emulator) -> ScenarioResult:
    """Run a scenario on a fresh emulated board; the emulator is closed after it."""
    trace, plant, problems = hashlib.sha256(), JointPlant(), list[str]()
    link = EmulatedLink(emulator, plant, watch=trace.update)
    try:
        configured(link)
        scenario(BoardTestRig.connect(link, plant, problems))
    except ArmsightError as error:
        problems.append(str(error))
    finally:
        link.close()
    return ScenarioResult(tuple(problems), trace.hexdigest())


def speed(emulator: Emulator, ticks: int = _SPEED_TICKS) -> float:
    """Return how many ticks a second an emulated board runs, plant and telemetry with it; the emulator is closed."""
    link = EmulatedLink(emulator, JointPlant())
    try:
        configured(link)
        start = time.perf_counter()
        link.step(ticks)
        return ticks / (time.perf_counter() - start)
    finally:
        link.close()


def selftest(board: str, *, drives: bool = False, progress: Callable[[str], None] = print) -> SelftestResult:
    """Run the scenarios on a board."""
    scenarios = {}
    if board.startswith(SERIAL):
        (port, baud, _), home_rad = serial_port(board, BAUD), None
        for name in [each for each in DRIVEN if (each not in EMULATED_ONLY if drives else each in AT_REST)]:
            progress(name)
            scenarios[name], home_rad = _on_real(port, baud, DRIVEN[name], drives, home_rad)
        progress("speed")
        return SelftestResult(board, scenarios, _ticks_per_s(port, baud), dict.fromkeys(_SIZES))
    emulator = emulator_name(board)
    for name, scenario in DRIVEN.items():
        progress(name)
        scenarios[name] = run_scenario(scenario, open_emulator(emulator))
    progress("speed")
    elf = read_elf(firmware.image())
    sizes = {name: getattr(elf, name) for name in _SIZES}
    return SelftestResult(board, scenarios, speed(open_emulator(emulator)), sizes)


def _on_real(
    port: str, baud: int, scenario: Scenario, drives: bool, home_rad: Array | None
) -> tuple[ScenarioResult, Array]:
    """Run a scenario on a real board, its drives off afterwards; returns where its joints are at home, too."""
    problems, link = list[str](), SerialLink.open(port, baud)
    how: Any = {"amplitude_rad": _SMALL_RAD, "home_rad": home_rad, "driven": drives, "name": port}
    rig = BoardTestRig.connect(link, None, problems, **how)
    try:
        scenario(rig)
    except ArmsightError as error:
        problems.append(str(error))
    finally:
        rig.end()
    return ScenarioResult(tuple(problems), None), rig.home_rad


def _ticks_per_s(port: str, baud: int) -> float:
    with Board.connect(SerialLink.open(port, baud), name=port) as board:
        board.receive(0.1)
        start, from_s = time.perf_counter(), board.joints.t_s
        board.receive(_SPEED_S)
        return (board.joints.t_s - from_s) * board.welcome.ticks_per_s / (time.perf_counter() - start)
