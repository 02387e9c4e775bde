"""A board on the bench: moves it as a host would, disturbs its wire, and notes what is not as it must be."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable

import numpy as np

from armsight.data import Array, JointCommand
from armsight.errors import ArmsightError
from armsight.robot.boards.board import Board
from armsight.robot.boards.codes import Order, State
from armsight.robot.boards.link import Link
from armsight.sim.joints import JointPlant

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
        self.board = Board(self.wire, name=name)
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
            self.board.confirm(self.board.order(Order.CLEAR_STOP))
        if self.board.status.faults:
            self.board.confirm(self.board.order(Order.CLEAR_FAULTS))
        if self.board.status.drives_on:
            self.disable()

    def disable(self) -> None:
        """Switch the drives off."""
        self.board.confirm(self.board.order(Order.DISABLE))

    def end(self) -> None:
        """Let go of a real board; where its drives were used, leave them off and its faults cleared, if it listens."""
        with contextlib.suppress(ArmsightError):
            if self._driven:
                self.clear()
        self.board.close()
