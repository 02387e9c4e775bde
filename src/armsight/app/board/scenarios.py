"""The scenarios that every board must pass: motion, a bad wire, a silent host, bad sensors, emergency stop, new gains.

A scenario is a function of a :class:`BoardTestRig`: it moves the board as a host would, disturbs its wire, and notes on
the rig what is not as it must be. Those in :data:`DRIVEN` switch the drives on; those in :data:`AT_REST` never do: for a
real board, whose arm is not to move.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping

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


class SpoiledLink:
    """A link whose bytes to the board can be spoiled on their way."""

    def __init__(self, link: Link) -> None:
        self._link = link
        #: What happens to the bytes of one write; None leaves them alone.
        self.spoil: Callable[[bytes], bytes] | None = None

    def write(self, data: bytes) -> None:
        """Send bytes, spoiled."""
        self._link.write(data if self.spoil is None else self.spoil(bytes(data)))

    def read(self, wait_s: float = 0.0) -> bytes:
        """Return what has come, after waiting."""
        return self._link.read(wait_s)

    def close(self) -> None:
        """Let go of the link."""
        self._link.close()


class BoardTestRig:
    """A board, what it drives, and what was found wrong with it; :meth:`connect` makes one.

    Args:
        wire: the link to it.
        board: the board, connected over this link.
        plant: the emulated arm; None where the board is a real one.
        problems: filled with what is not as it must be.
        amplitude_rad: how far the joints swing from their home, at most.
        home_rad: (6,) joint angles that they swing about.

    Attributes:
        board: the board.
        plant: the emulated arm, if there is one.
        home_rad: (6,) joint angles that the joints swing about.
        wire: the link, whose bytes to the board can be spoiled.
    """

    def __init__(
        self,
        wire: SpoiledLink,
        board: Board,
        plant: JointPlant | None,
        problems: list[str],
        *,
        amplitude_rad: float,
        home_rad: Array,
    ) -> None:
        self.wire = wire
        self.board = board
        self.plant = plant
        self._problems = problems
        self._amplitude_rad = amplitude_rad
        self.home_rad = home_rad
        self._start_rad, self._side = np.zeros(JOINTS), np.ones(JOINTS)
        self._t_s = 0.0
        self._driven = False

    @classmethod
    def connect(
        cls,
        link: Link,
        plant: JointPlant | None,
        problems: list[str],
        *,
        amplitude_rad: float = 0.4,
        home_rad: Array | None = None,
        name: str = "the emulated board",
    ) -> BoardTestRig:
        """Connect to a board.

        Args:
            link: the wire to it.
            plant: the emulated arm; None where the board is a real one.
            problems: filled with what is not as it must be.
            amplitude_rad: how far the joints swing from their home, at most.
            home_rad: (6,) where that is; where they are at first, without it.
            name: of the board, in error messages.

        Raises:
            DeviceError: the board does not answer, or is of another version.
        """
        wire = SpoiledLink(link)
        board = Board.connect(wire, name=name)
        here = cls(wire, board, plant, problems, amplitude_rad=amplitude_rad, home_rad=np.zeros(JOINTS))
        here.home_rad = here.readings(0.02)[-1] if home_rad is None else home_rad
        return here

    def expect(self, holds: bool, what: str) -> None:
        """Note what is wrong where something does not hold."""
        if not holds:
            self._problems.append(what)

    def expect_state(self, state: BoardState, when: str) -> None:
        """Note it where the board is in another state, or has faults in a state without."""
        status = self.board.status
        faults = "; ".join(map(str, status.faults)) or "no fault"
        self.expect(status.state == state, f"{when}: {status.state.name} ({faults}), not {state.name}")
        if state in (BoardState.DISABLED, BoardState.ENABLED):
            self.expect(not status.faults, f"{when}: {faults}")

    def enable(self) -> None:
        """Switch the drives on; the joints will swing from where they are to the side of their home."""
        self._start_rad = self.readings(0.02)[-1]
        self._driven = True
        self._side = np.where(self._start_rad > self.home_rad, -1.0, 1.0)
        self._t_s = 0.0
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
        at, half = rate * self._t_s, self._amplitude_rad / 2 * self._side
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

    def clear(self) -> None:
        """Clear the emergency stop and the faults, and end with the drives off."""
        if self.board.status.state == BoardState.STOPPED:
            self.board.confirm(self.board.command(Command.CLEAR_STOP))
        if self.board.status.faults:
            self.board.confirm(self.board.command(Command.CLEAR_FAULTS))
        if self.board.status.drives_on:
            self.disable()

    def disable(self) -> None:
        """Switch the drives off."""
        self.board.confirm(self.board.command(Command.DISABLE))

    def end(self) -> None:
        """Let go of a real board; where its drives were used, leave them off and its faults cleared, if it listens."""
        with contextlib.suppress(ArmsightError):
            if self._driven:
                self.clear()
        self.board.close()


Scenario = Callable[[BoardTestRig], None]

#: The joints stay this near to their commanded angles while they swing, rad.
_NEAR_RAD = 0.1
#: How long an arm may take to come to rest without a host, and what its board is then.
_REST_S = 3.0
_AT_REST_STATES = (BoardState.HOLDING, BoardState.FAULTED)


def nominal(test_rig: BoardTestRig) -> None:
    """Enable, swing, disable: the joints follow, no command is rejected."""
    test_rig.enable()
    errors = test_rig.swing(1.0)
    test_rig.expect_state(BoardState.ENABLED, "while swinging")
    test_rig.expect(
        float(np.abs(errors).max()) < _NEAR_RAD, f"joints are up to {np.abs(errors).max():.3f} rad off their way"
    )
    test_rig.expect(test_rig.board.status.rejected_count == 0, "a command was rejected")
    test_rig.disable()
    test_rig.readings(0.1)
    test_rig.expect_state(BoardState.DISABLED, "after the command to disable")
    test_rig.expect(not test_rig.board.joints.duty.any(), "a duty stays on with the drives off")


def crc_faults(test_rig: BoardTestRig) -> None:
    """Swing while every sixth message to the board is disturbed: those are dropped and counted, the others acknowledged."""
    test_rig.enable()
    _disturb(test_rig, lambda: test_rig.swing(1.0))
    test_rig.expect_state(BoardState.ENABLED, "on a disturbed wire")
    _whole_again(test_rig)
    test_rig.disable()


def host_loss(test_rig: BoardTestRig) -> None:
    """Fall silent in motion: the board brings the arm to rest by itself and goes on when commanded to."""
    silence_s = float(test_rig.board.configuration()["silence_ticks"]) / test_rig.board.welcome.ticks_per_s
    test_rig.enable()
    test_rig.swing(0.4)
    test_rig.readings(silence_s)
    for _ in range(round(_REST_S / PERIOD_S)):
        if test_rig.board.status.state in _AT_REST_STATES:
            break
        test_rig.readings(PERIOD_S)
    status = test_rig.board.status
    test_rig.expect([f.fault for f in status.faults] == [Fault.HOST_SILENT], f"silence is reported as {status.faults}")
    test_rig.expect(status.state in _AT_REST_STATES, f"without a host it is {status.state.name}")
    moved = np.ptp(test_rig.readings(0.1), axis=0).max()
    test_rig.expect(float(moved) < _NEAR_RAD / 4, f"the arm still moves by {moved:.3f} rad in 0.1 s")
    test_rig.clear()
    test_rig.enable()
    test_rig.swing(0.2)
    test_rig.expect_state(BoardState.ENABLED, "after the silence was cleared")
    test_rig.disable()


def sensor_faults(test_rig: BoardTestRig) -> None:
    """Break a potentiometer in motion in each way, then the supply: each is reported by its name, and lets go."""
    plant = test_rig.plant
    if plant is None:
        return
    for joint, (broken, fault) in enumerate(_POT_FAULTS.items()):
        if broken == PotFault.INVERTED:  # a mistake of the wiring: so from the beginning
            plant.break_pot(joint, broken)
            test_rig.readings(0.1)
        test_rig.enable()
        test_rig.swing(0.4)
        if broken != PotFault.INVERTED:
            plant.break_pot(joint, broken)
        test_rig.swing(0.5)
        _expect_fault(test_rig, fault, joint)
        plant.break_pot(joint, PotFault.NONE)
        test_rig.readings(0.3)
        test_rig.clear()
    for supply_mv, fault in ((8000, Fault.SUPPLY_LOW), (16000, Fault.SUPPLY_HIGH)):
        test_rig.enable()
        test_rig.swing(0.1)
        plant.supply_mv, whole_mv = supply_mv, plant.supply_mv
        test_rig.swing(0.1)
        _expect_fault(test_rig, fault, None)
        plant.supply_mv = whole_mv
        test_rig.readings(0.05)
        test_rig.clear()


def e_stop(test_rig: BoardTestRig) -> None:
    """Stop in motion, by message and by button: the drives go off and stay off until the stop is cleared."""
    for press in _stops(test_rig):
        test_rig.enable()
        test_rig.swing(0.3)
        press(True)
        test_rig.readings(0.05)
        test_rig.expect_state(BoardState.STOPPED, "after the emergency stop")
        _stopped(test_rig)
        press(False)
        test_rig.clear()
    test_rig.enable()
    test_rig.swing(0.1)
    test_rig.expect_state(BoardState.ENABLED, "after the stop was cleared")
    test_rig.disable()


def gain_change(test_rig: BoardTestRig) -> None:
    """Change the gains in motion: taken whole without a jump of the duty, or rejected whole."""
    gains = gains_array(test_rig.board.configuration())
    changed = gains * [1.5, 0.5, 1.2, 1.0, 1.0, 1.0, 1.0, 1.0]
    test_rig.enable()
    test_rig.swing(0.35)
    before = test_rig.board.joints.duty
    number = test_rig.board.set_gains(changed)
    test_rig.swing(PERIOD_S)
    jump = float(np.abs(test_rig.board.joints.duty - before).max())
    test_rig.expect(jump < 0.25, f"new gains move the duty by {jump:.2f}")
    test_rig.swing(0.4)
    test_rig.expect(test_rig.board.status.rejected_sequence != number, "good gains were rejected")
    _bad_gains(test_rig, changed)
    test_rig.expect_state(BoardState.ENABLED, "with other gains")
    test_rig.disable()
    test_rig.expect(_has_gains(test_rig, changed), "the gains are not those that were sent last and acknowledged")
    test_rig.board.confirm(test_rig.board.set_gains(gains))


def nominal_at_rest(test_rig: BoardTestRig) -> None:
    """Drives off: telemetry comes, a motion command is rejected."""
    angles = test_rig.readings(0.5)
    test_rig.expect(len(angles) > 5, f"{len(angles)} readings in 0.5 s")
    test_rig.expect(not test_rig.board.status.drives_on, "the drives are on, though nobody switched them on")
    test_rig.expect(
        _rejection(test_rig) == Rejection.WRONG_STATE, "a motion command with the drives off was not rejected"
    )
    test_rig.expect(not test_rig.board.joints.duty.any(), "a duty is on with the drives off")


def crc_faults_at_rest(test_rig: BoardTestRig) -> None:
    """Drives off: disturbed messages are dropped and counted, the next whole one is answered."""
    _disturb(test_rig, lambda: [_rejection(test_rig) for _ in range(30)])
    _whole_again(test_rig)


def e_stop_at_rest(test_rig: BoardTestRig) -> None:
    """Drives off: the stop is taken by message, keeps the drives from being enabled, and is cleared."""
    test_rig.board.stop()
    test_rig.readings(0.1)
    test_rig.expect_state(BoardState.STOPPED, "after the emergency stop")
    _stopped(test_rig)
    test_rig.board.confirm(test_rig.board.command(Command.CLEAR_STOP))


def gain_change_at_rest(test_rig: BoardTestRig) -> None:
    """Drives off: the board's own gains are taken again, wrong ones rejected."""
    gains = gains_array(test_rig.board.configuration())
    test_rig.board.confirm(test_rig.board.set_gains(gains))
    _bad_gains(test_rig, gains)
    test_rig.expect(_has_gains(test_rig, gains), "a rejected gain set changed the gains")


DRIVEN: Mapping[str, Scenario] = {
    "nominal": nominal,
    "crc_faults": crc_faults,
    "host_loss": host_loss,
    "sensor_faults": sensor_faults,
    "e_stop": e_stop,
    "gain_change": gain_change,
}
#: What needs an arm whose sensors can be broken.
EMULATED_ONLY = ("sensor_faults",)
AT_REST: Mapping[str, Scenario] = {
    "nominal": nominal_at_rest,
    "crc_faults": crc_faults_at_rest,
    "e_stop": e_stop_at_rest,
    "gain_change": gain_change_at_rest,
}
_POT_FAULTS = {
    PotFault.OPEN: Fault.POT_OPEN,
    PotFault.SHORT: Fault.POT_SHORT,
    PotFault.FROZEN: Fault.POT_FROZEN,
    PotFault.JUMP: Fault.POT_JUMP,
    PotFault.INVERTED: Fault.POT_INVERTED,
}


def _disturb(test_rig: BoardTestRig, run: Callable[[], object]) -> None:
    """Run something with every sixth message disturbed, each time at another byte and bit."""
    sent = 0

    def flip(data: bytes) -> bytes:
        nonlocal sent
        sent += 1
        if sent % 6:
            return data
        spoiled = bytearray(data)
        spoiled[sent * 7 % len(data)] ^= 1 << sent // 6 % 8
        return bytes(spoiled)

    before = test_rig.board.status
    test_rig.wire.spoil = flip
    run()
    test_rig.wire.spoil = None
    test_rig.readings(0.05)
    after = test_rig.board.status
    noticed = after.crc_errors + after.lost_bytes - before.crc_errors - before.lost_bytes
    test_rig.expect(noticed > 0, "no disturbed message was counted")
    new = [fault for fault in after.faults if fault not in before.faults]
    test_rig.expect(not new, f"a disturbed wire led to {'; '.join(map(str, new))}")


def _whole_again(test_rig: BoardTestRig) -> None:
    """Expect the next gains to be taken at the first try."""
    try:
        test_rig.board.confirm(test_rig.board.set_gains(gains_array(test_rig.board.configuration())))
    except DeviceError as error:
        test_rig.expect(False, f"the wire does not come back: {error}")


def _rejection(test_rig: BoardTestRig) -> Rejection:
    """Send a command to stay where the joints are and return why it was rejected."""
    here = test_rig.readings(PERIOD_S)[-1]
    number = test_rig.board.send(JointCommand(here, np.zeros(6), np.zeros(6), PERIOD_S))
    test_rig.readings(0.05)
    status = test_rig.board.status
    return status.rejection if status.rejected_sequence == number else Rejection.NONE


def _expect_fault(test_rig: BoardTestRig, fault: Fault, joint: int | None) -> None:
    status = test_rig.board.status
    first = status.first_fault
    reported = "nothing" if first is None else str(first)
    test_rig.expect(
        first is not None and (first.fault, first.joint) == (fault, joint), f"{fault.name} is reported as: {reported}"
    )
    if joint is None:
        test_rig.expect(not status.drives_on, f"{fault.name} leaves the drives on")
    else:
        driven = bool(test_rig.board.joints.duty[joint])
        test_rig.expect(not driven, f"{fault.name} leaves the drive of joint {joint + 1} on")


def _stops(test_rig: BoardTestRig) -> list[Callable[[bool], None]]:
    """Return the ways to stop: by message, and where there is one by button."""

    def message(pressed: bool) -> None:
        if pressed:
            test_rig.board.stop()

    def button(pressed: bool) -> None:
        assert test_rig.plant is not None
        test_rig.plant.stop_pressed = pressed
        test_rig.readings(PERIOD_S)

    return [message] if test_rig.plant is None else [message, button]


def _stopped(test_rig: BoardTestRig) -> None:
    """Expect a stopped board to reject motion and enabling."""
    test_rig.expect(_rejection(test_rig) == Rejection.WRONG_STATE, "a stopped board took a motion command")
    try:
        test_rig.board.enable()
    except DeviceError:
        return
    test_rig.expect(False, "a stopped board was enabled")


def _bad_gains(test_rig: BoardTestRig, gains: Array) -> None:
    """Send gains a board must reject, past the host's own check."""
    for value, rejection in ((101.0, Rejection.OUT_OF_RANGE), (np.nan, Rejection.NOT_FINITE)):
        wrong = gains.copy()
        wrong[3, 0] = value
        number = test_rig.board.set_gains(wrong, checked=False)
        test_rig.swing(0.05) if test_rig.board.status.drives_on else test_rig.readings(0.05)
        status = test_rig.board.status
        given = status.rejection if status.rejected_sequence == number else Rejection.NONE
        test_rig.expect(given == rejection, f"a gain of {value} is rejected as {given.name}, not as {rejection.name}")


def _has_gains(test_rig: BoardTestRig, gains: Array) -> bool:
    return bool(np.array_equal(gains_array(test_rig.board.configuration()), gains.astype(np.float32)))
