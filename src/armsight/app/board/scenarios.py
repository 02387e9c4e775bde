"""The scenarios that every board must pass: motion, a bad wire, a silent host, bad sensors, emergency stop, new gains.

A scenario is a function of a :class:`BoardTestRig`: it moves the board as a host would, disturbs its wire, and notes on
the rig what is not as it must be. Those in :data:`DRIVEN` switch the drives on, those in :data:`AT_REST` only on a rig that
may: the drives of a real board whose arm is not to move stay off.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from armsight.data import Array, JointCommand
from armsight.errors import ArmsightError, DeviceError
from armsight.robot.boards.board import Board
from armsight.robot.boards.codes import BoardState, Command, Fault, Rejection
from armsight.robot.boards.configuration import gains_array
from armsight.robot.boards.link import Link
from armsight.sim.joints import JointPlant, PotFault

#: The host's period, s.
PERIOD_S = 0.01
#: Frequency of the swing, Hz.
_SINE_HZ = 0.5
JOINTS = 6
#: The joints stay this near to their commanded angles while they swing, rad.
_NEAR_RAD = 0.1
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
        """Connect to a board: ``name`` is what errors call it, home is where the joints are at first, if not given.

        Raises:
            DeviceError: the board does not answer, or is of another version.
        """
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
    "nominal": nominal,
    "crc_faults": crc_faults,
    "host_loss": host_loss,
    "sensor_faults": sensor_faults,
    "e_stop": e_stop,
    "gain_change": gain_change,
}
#: What needs an arm whose sensors can be broken, and what also runs with the drives off.
EMULATED_ONLY, AT_REST = ("sensor_faults",), ("nominal", "crc_faults", "e_stop", "gain_change")
_POT_FAULTS = {
    PotFault.OPEN: Fault.POT_OPEN,
    PotFault.SHORT: Fault.POT_SHORT,
    PotFault.FROZEN: Fault.POT_FROZEN,
    PotFault.JUMP: Fault.POT_JUMP,
    PotFault.INVERTED: Fault.POT_INVERTED,
}


def _rejection(rig: BoardTestRig) -> Rejection:
    """Send a command to stay where the joints are and return why it was rejected."""
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
    if joint is None:
        rig.expect(not status.drives_on, f"{fault.name} leaves the drives on")
    else:
        driven = bool(rig.board.joints.duty[joint])
        rig.expect(not driven, f"{fault.name} leaves the drive of joint {joint + 1} on")
