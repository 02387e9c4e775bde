"""What every board must get right: a run each through motion, a bad wire, a silent host, bad sensors, the stop, new gains.

A scenario is a function of a :class:`~armsight.app.board.scenarios.Bench` that notes on it what is not as it must be.
Those in :data:`DRIVEN` switch the drives on; those in :data:`AT_REST` never do: for a real board, whose arm is not to move.

A board on the bench: moves it as a host would, disturbs its wire, and notes what is not as it must be.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping

import numpy as np

from armsight.data import Array, JointCommand
from armsight.errors import ArmsightError, DeviceError
from armsight.robot.boards.board import Board
from armsight.robot.boards.codes import Fault, Command, Rejection, State
from armsight.robot.boards.configuration import gains_array
from armsight.robot.boards.link import Link
from armsight.sim.joints import JointPlant, PotFault

#: The host's period, s; a sine's frequency, Hz.
PERIOD_S, _SINE_HZ = 0.01, 0.5
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


class Bench:
    """A board, what it drives, and what was found wrong with it.

    Args:
        link: the wire to it.
        plant: the emulated arm; None where the board is a real one.
        problems: filled with what is not as it must be.
        amplitude_rad: how far the joints swing from their home, at most.
        home_rad: (6,) where that is; where they are at first, without it.
        name: what errors call the board.

    Attributes:
        board: the board, hello said.
        plant: the emulated arm, if there is one.
        home_rad: (6,) what the joints swing about.
        wire: the link, whose bytes to the board can be spoiled.
    """

    def __init__(
        self,
        link: Link,
        plant: JointPlant | None,
        problems: list[str],
        *,
        amplitude_rad: float = 0.4,
        home_rad: Array | None = None,
        name: str = "the emulated board",
    ) -> None:
        self.wire = SpoiledLink(link)
        self.board = Board.connect(self.wire, name=name)
        self.plant = plant
        self._problems = problems
        self._amplitude_rad = amplitude_rad
        self.home_rad = self.readings(0.02)[-1] if home_rad is None else home_rad
        self._start_rad, self._side = np.zeros(JOINTS), np.ones(JOINTS)
        self._t_s = 0.0
        self._driven = False

    def expect(self, holds: bool, what: str) -> None:
        """Note what is wrong where something does not hold."""
        if not holds:
            self._problems.append(what)

    def expect_state(self, state: State, when: str) -> None:
        """Note it where the board is in another state, or has faults in a state without."""
        status = self.board.status
        told = "; ".join(map(str, status.faults)) or "no fault"
        self.expect(status.state == state, f"{when}: {status.state.name} ({told}) in place of {state.name}")
        if state in (State.DISABLED, State.ENABLED):
            self.expect(not status.faults, f"{when}: {told}")

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
        """Swing on for so long; returns how far the readings (N, 6) were from where the joints were told to be."""
        errors = []
        for _ in range(round(duration_s / PERIOD_S)):
            command = self.command()
            self.board.send(command)
            errors.append(self.readings(PERIOD_S)[-1] - command.q_ref)
        return np.array(errors)

    def clear(self) -> None:
        """Clear the emergency stop and the faults, and end with the drives off."""
        if self.board.status.state == State.STOPPED:
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


Scenario = Callable[[Bench], None]

#: How near the joints stay to where they are told to be, rad, while they swing.
_NEAR_RAD = 0.1
#: How long an arm may take to come to rest without a host, and what its board is then.
_REST_S = 3.0
_AT_REST_STATES = (State.HOLDING, State.FAULTED)


def nominal(bench: Bench) -> None:
    """Enable, swing, disable: the joints follow, nothing is refused."""
    bench.enable()
    errors = bench.swing(1.0)
    bench.expect_state(State.ENABLED, "while swinging")
    bench.expect(
        float(np.abs(errors).max()) < _NEAR_RAD, f"joints are up to {np.abs(errors).max():.3f} rad off their way"
    )
    bench.expect(bench.board.status.rejected_count == 0, "a command was refused")
    bench.disable()
    bench.readings(0.1)
    bench.expect_state(State.DISABLED, "after the command to disable")
    bench.expect(not bench.board.joints.duty.any(), "a duty stays on with the drives off")


def crc_faults(bench: Bench) -> None:
    """Swing while every sixth message to the board is disturbed: those are dropped and counted, the others acknowledged."""
    bench.enable()
    _disturb(bench, lambda: bench.swing(1.0))
    bench.expect_state(State.ENABLED, "on a disturbed wire")
    _whole_again(bench)
    bench.disable()


def host_loss(bench: Bench) -> None:
    """Fall silent in motion: the board brings the arm to rest by itself and goes on when told to."""
    silence_s = float(bench.board.configuration()["silence_ticks"]) / bench.board.welcome.ticks_per_s
    bench.enable()
    bench.swing(0.4)
    bench.readings(silence_s)
    for _ in range(round(_REST_S / PERIOD_S)):
        if bench.board.status.state in _AT_REST_STATES:
            break
        bench.readings(PERIOD_S)
    status = bench.board.status
    bench.expect([f.fault for f in status.faults] == [Fault.HOST_SILENT], f"silence is told as {status.faults}")
    bench.expect(status.state in _AT_REST_STATES, f"without a host it is {status.state.name}")
    moved = np.ptp(bench.readings(0.1), axis=0).max()
    bench.expect(float(moved) < _NEAR_RAD / 4, f"the arm still moves by {moved:.3f} rad in 0.1 s")
    bench.clear()
    bench.enable()
    bench.swing(0.2)
    bench.expect_state(State.ENABLED, "after the silence was cleared")
    bench.disable()


def sensor_faults(bench: Bench) -> None:
    """Break a potentiometer in motion in each way, then the supply: each is told by its name, and the drives go off."""
    plant = bench.plant
    if plant is None:
        return
    for joint, (broken, fault) in enumerate(_POT_FAULTS.items()):
        bench.enable()
        bench.swing(0.4)
        plant.break_pot(joint, broken)
        bench.swing(0.5)
        _expect_fault(bench, fault, joint)
        plant.break_pot(joint, PotFault.NONE)
        bench.readings(0.3)
        bench.clear()
    for supply_mv, fault in ((8000, Fault.SUPPLY_LOW), (16000, Fault.SUPPLY_HIGH)):
        bench.enable()
        bench.swing(0.1)
        plant.supply_mv, whole_mv = supply_mv, plant.supply_mv
        bench.swing(0.1)
        _expect_fault(bench, fault, None)
        plant.supply_mv = whole_mv
        bench.readings(0.05)
        bench.clear()


def e_stop(bench: Bench) -> None:
    """Stop in motion, by message and by button: the drives go off and stay off until the stop is cleared."""
    for press in _stops(bench):
        bench.enable()
        bench.swing(0.3)
        press(True)
        bench.readings(0.05)
        bench.expect_state(State.STOPPED, "after the emergency stop")
        _stopped(bench)
        press(False)
        bench.clear()
    bench.enable()
    bench.swing(0.1)
    bench.expect_state(State.ENABLED, "after the stop was cleared")
    bench.disable()


def gain_change(bench: Bench) -> None:
    """Change the gains in motion: taken whole without a jump of the duty, or refused whole."""
    gains = gains_array(bench.board.configuration())
    changed = gains * [1.5, 0.5, 1.2, 1.0, 1.0, 1.0]
    bench.enable()
    bench.swing(0.35)
    before = bench.board.joints.duty
    number = bench.board.set_gains(changed)
    bench.swing(PERIOD_S)
    jump = float(np.abs(bench.board.joints.duty - before).max())
    bench.expect(jump < 0.25, f"new gains move the duty by {jump:.2f}")
    bench.swing(0.4)
    bench.expect(bench.board.status.rejected_sequence != number, "good gains were refused")
    _bad_gains(bench, changed)
    bench.expect_state(State.ENABLED, "with other gains")
    bench.disable()
    bench.expect(_has_gains(bench, changed), "the gains are not those that were sent last and acknowledged")
    bench.board.confirm(bench.board.set_gains(gains))


def nominal_at_rest(bench: Bench) -> None:
    """Drives off: telemetry comes, a motion command is refused."""
    angles = bench.readings(0.5)
    bench.expect(len(angles) > 5, f"{len(angles)} readings in 0.5 s")
    bench.expect(not bench.board.status.drives_on, "the drives are on, though nobody switched them on")
    bench.expect(_refused(bench) == Rejection.WRONG_STATE, "a motion command with the drives off was not refused")
    bench.expect(not bench.board.joints.duty.any(), "a duty is on with the drives off")


def crc_faults_at_rest(bench: Bench) -> None:
    """Drives off: disturbed messages are dropped and counted, the next whole one is answered."""
    _disturb(bench, lambda: [_refused(bench) for _ in range(30)])
    _whole_again(bench)


def e_stop_at_rest(bench: Bench) -> None:
    """Drives off: the stop is taken by message, keeps the drives from being enabled, and is cleared."""
    bench.board.stop()
    bench.readings(0.1)
    bench.expect_state(State.STOPPED, "after the emergency stop")
    _stopped(bench)
    bench.board.confirm(bench.board.command(Command.CLEAR_STOP))


def gain_change_at_rest(bench: Bench) -> None:
    """Drives off: the board's own gains are taken again, wrong ones refused."""
    gains = gains_array(bench.board.configuration())
    bench.board.confirm(bench.board.set_gains(gains))
    _bad_gains(bench, gains)
    bench.expect(_has_gains(bench, gains), "a refused gain set changed the gains")


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


def _disturb(bench: Bench, run: Callable[[], object]) -> None:
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

    before = bench.board.status
    bench.wire.spoil = flip
    run()
    bench.wire.spoil = None
    bench.readings(0.05)
    after = bench.board.status
    noticed = after.crc_errors + after.lost_bytes - before.crc_errors - before.lost_bytes
    bench.expect(noticed > 0, "no disturbed message was counted")
    new = [fault for fault in after.faults if fault not in before.faults]
    bench.expect(not new, f"a disturbed wire led to {'; '.join(map(str, new))}")


def _whole_again(bench: Bench) -> None:
    """Expect the next gains to be taken at the first try."""
    try:
        bench.board.confirm(bench.board.set_gains(gains_array(bench.board.configuration())))
    except DeviceError as error:
        bench.expect(False, f"the wire does not come back: {error}")


def _refused(bench: Bench) -> Rejection:
    """Send a command to stay where the joints are and return why it was refused."""
    here = bench.readings(PERIOD_S)[-1]
    number = bench.board.send(JointCommand(here, np.zeros(6), np.zeros(6), PERIOD_S))
    bench.readings(0.05)
    status = bench.board.status
    return status.rejection if status.rejected_sequence == number else Rejection.NONE


def _expect_fault(bench: Bench, fault: Fault, joint: int | None) -> None:
    status = bench.board.status
    first = status.first_fault
    told = "nothing" if first is None else str(first)
    bench.expect(first is not None and (first.fault, first.joint) == (fault, joint), f"{fault.name} is told as: {told}")
    bench.expect(not status.drives_on, f"{fault.name} leaves the drives on")


def _stops(bench: Bench) -> list[Callable[[bool], None]]:
    """Return the ways to stop: by message, and where there is one by button."""

    def message(pressed: bool) -> None:
        if pressed:
            bench.board.stop()

    def button(pressed: bool) -> None:
        assert bench.plant is not None
        bench.plant.stop_pressed = pressed
        bench.readings(PERIOD_S)

    return [message] if bench.plant is None else [message, button]


def _stopped(bench: Bench) -> None:
    """Expect a stopped board to refuse motion and enabling."""
    bench.expect(_refused(bench) == Rejection.WRONG_STATE, "a stopped board took a motion command")
    try:
        bench.board.enable()
    except DeviceError:
        return
    bench.expect(False, "a stopped board was enabled")


def _bad_gains(bench: Bench, gains: Array) -> None:
    """Send gains a board must refuse, past the host's own check."""
    for value, rejection in ((101.0, Rejection.OUT_OF_RANGE), (np.nan, Rejection.NOT_FINITE)):
        wrong = gains.copy()
        wrong[3, 0] = value
        number = bench.board.set_gains(wrong, checked=False)
        bench.swing(0.05) if bench.board.status.drives_on else bench.readings(0.05)
        status = bench.board.status
        told = status.rejection if status.rejected_sequence == number else Rejection.NONE
        bench.expect(told == rejection, f"a gain of {value} is told as {told.name} in place of {rejection.name}")


def _has_gains(bench: Bench, gains: Array) -> bool:
    return bool(np.array_equal(gains_array(bench.board.configuration()), gains.astype(np.float32)))
