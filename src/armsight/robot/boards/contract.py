"""The contract of what a run can drive: our own :class:`~armsight.robot.boards.board.Board`, and other controllers.

To add one: a folder beside ``feetech/`` and ``ar4/`` with a codec and a class that fulfils :class:`MotionBoard`, and a line
in ``board_registry``. A board says in its :class:`Abilities` what it cannot do, so that a caller rejects a request with one
line instead of sending what nobody acts on. What controllers of their own have in common is :class:`PolledBoard`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, Self

import numpy as np

from armsight.data import Array, JointCommand, JointStates
from armsight.errors import InputError
from armsight.robot.boards.codes import BoardState, Command, Limited
from armsight.robot.boards.reports import BoardStatus, JointFault, JointReport, Welcome
from armsight.robot.kinematics.arm import Arm

WRAP = 1 << 32  # ticks and numbers of commands count modulo this
#: What stops an arm goes out so many times: a disturbed byte must not swallow it; half: one may, double: longer to send.
STOPS = 3


@dataclass(frozen=True)
class Abilities:
    """What a board can do, and what it cannot."""

    joints: int  #: how many joints it drives
    rate_hz: float  #: readings a second, at most
    latency_s: float = 0.0  #: by how much the arm lags behind a motion within the two limits below; 0: the tick's
    response_s: float = 0.05  #: from a small change of the command at rest to the joints having made it, s
    steps_rad: tuple[float, ...] = ()  #: (n,) what each joint is moved by at least; empty where there is no such step
    rest_rad_s: float = 0.055  #: a joint at rest is measured slower than this, rad/s
    most_speed_rad_s: float = math.inf  #: fastest motion that the controller follows with this lag, rad/s
    most_acceleration_rad_s2: float = math.inf  #: the same of its acceleration, rad/s^2
    takes_duty: bool = True  #: whether ``gravity_duty`` of a command reaches the motors
    own_controller: bool = False  #: whether armsight cannot tune, configure or test what controls the joints
    releases: bool = True  #: whether the drives can be switched off
    reading_age_s: tuple[float, float] = (0.0, 0.0)  #: how much older a reading is than its stamp, and its sigma, s
    rounded_rad: float = 0.0  #: what readings are rounded to where their noise does not exceed it; 0: nothing

    def slowed(self, arm: Arm) -> Arm:
        """Return an arm whose motions are planned no faster than the controller follows them."""
        return replace(
            arm,
            qd_max=np.minimum(arm.qd_max, self.most_speed_rad_s),
            qdd_max=np.minimum(arm.qdd_max, self.most_acceleration_rad_s2),
        )

    @property
    def missing(self) -> tuple[str, ...]:
        """What it cannot do, as texts."""
        texts = {
            "takes no duty: gravity is not compensated": not self.takes_duty,
            "keeps its own controller: no gains, no configuration, no self-test": self.own_controller,
            "cannot switch its drives off": not self.releases,
        }
        return tuple(text for text, holds in texts.items() if holds)


class Closing(Protocol):
    """What ``with`` closes at its end."""

    def close(self) -> None:
        """Close it."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class MotionBoard(Closing, Protocol):
    """What drives the joints of an arm and reads them; time passes in :meth:`receive` and in what waits."""

    @property
    def abilities(self) -> Abilities:
        """What it can do."""

    @property
    def welcome(self) -> Welcome:
        """Who it is."""

    @property
    def status(self) -> BoardStatus:
        """Its newest status; counts that it does not keep are 0."""

    @property
    def joints(self) -> JointReport:
        """Its newest report of how the joints are driven."""

    @property
    def broken_messages(self) -> int:
        """Number of broken or missing messages from it."""

    @property
    def homed(self) -> bool:
        """False where it is known that its readings are not the arm's angles: it is not homed."""

    def soft_limits(self) -> tuple[Array, Array]:
        """Return the lower and the upper limits (n,) that it keeps the joints within, rad."""

    def send(self, command: JointCommand) -> int:
        """Send a motion command and return its number.

        Raises InputError: a shape, a number that is not finite, or what the board rejects at once; DeviceError: the board
        is gone.
        """

    def command(self, command: Command) -> int:
        """Send a command other than motion and return its number."""

    def confirm(self, sequence: int, wait_s: float = 0.5) -> None:
        """Wait until the board acknowledged the command of this number; DeviceError where it was rejected, or is silent."""

    def enable(self, *, inward: bool = False) -> None:
        """Switch the drives on, at the present position, and wait until they are."""

    def stop(self) -> None:
        """Stop in an emergency."""

    def receive(self, wait_s: float = 0.0) -> JointStates:
        """Let ``wait_s`` pass and return all readings since the last call, or raise DeviceError: the board is gone."""

    def close(self) -> None:
        """Close the link; a driven arm then does what its board does without commands."""


#: A goal further from the present position than this is a mistake, not a step of a motion.
MOST_STEP_RAD = float(np.radians(20.0))


class PolledBoard(Closing):
    """An arm's own controller that is asked for every reading: takes angles alone, and has no clock and no watchdog.

    A member says how it is read (``_read``, which sets ``_t_s``), how time passes (``_wait``) and where its joints are.
    """

    def __init__(self, name: str, abilities: Abilities, welcome: Welcome, now: Callable[[], float]) -> None:
        self.name, self.abilities, self.welcome, self._now = name, abilities, welcome, now
        self._sent, self._enabled, self._t_s = 0, False, 0.0
        self._goal, self._goal_speed = np.zeros(abilities.joints), np.zeros(abilities.joints)

    @property
    def homed(self) -> bool:
        """Whether its readings are the arm's angles; sensors that are absolute need no homing."""
        return True

    def _wait(self, wait_s: float) -> None:
        raise NotImplementedError

    def _read(self) -> object:
        raise NotImplementedError

    def _q(self) -> Array:
        raise NotImplementedError

    def _status(self, state: BoardState, faults: tuple[JointFault, ...], supply_v: float) -> BoardStatus:
        """Return a status without our firmware's counts; what was sent counts as acknowledged."""
        first = faults[0] if faults else None
        return BoardStatus(self._t_s, state, faults, first, supply_v, self._sent, self._sent)

    def _report(self, speed_rad_s: Array, duty: Array, temperature_c: Array | None = None) -> JointReport:
        none = (Limited(0),) * self.abilities.joints
        return JointReport(self._t_s, speed_rad_s, self._goal, self._goal_speed, duty, none, temperature_c)

    def _checked_goal(
        self, command: JointCommand, who: str, names: Sequence[str] | None = None, margin_rad: float = 1e-8
    ) -> tuple[Array, Array]:
        """Return a command's angles and speeds (n,), rad: near, and within limits but for a margin; else InputError."""
        q_ref, here = np.asarray(command.q_ref, dtype=float), self._q()
        if q_ref.shape != here.shape:
            raise InputError(
                f"q_ref is of shape {q_ref.shape}; this board has {len(here)} joints: is it the right arm?"
            )
        for k in np.flatnonzero(~np.isfinite(q_ref))[:1]:
            raise InputError(f"q_ref of joint {k + 1} is {q_ref[k]}; it must be finite")
        low, high = self.soft_limits()
        of = [f"joint {k + 1}" + (f" ({names[k]})" if names else "") for k in range(len(here))]
        for k in np.flatnonzero((q_ref < low - margin_rad) | (q_ref > high + margin_rad))[:1]:
            goal, least, most = np.degrees([q_ref[k], low[k], high[k]])
            raise InputError(f"{of[k]} is to go to {goal:.1f} deg; {who} is allowed {least:.1f} to {most:.1f}")
        for k in np.flatnonzero(np.abs(q_ref - here) > MOST_STEP_RAD)[:1]:
            at, goal, step = np.degrees([here[k], q_ref[k], MOST_STEP_RAD])
            far = f"{step:.0f} at most: send goals step by step"
            raise InputError(f"{of[k]} is at {at:.1f} deg and is to go to {goal:.1f} at once; {far}")
        return q_ref, np.asarray(command.qd_ref, float)

    def _count(self) -> int:
        self._sent += 1
        return self._sent

    def soft_limits(self) -> tuple[Array, Array]:
        """Return the lower and the upper limits (n,) that it keeps the joints within, rad."""
        raise NotImplementedError

    def command(self, command: Command) -> int:
        """Send a command other than motion and return its number."""
        raise NotImplementedError

    def confirm(self, sequence: int, wait_s: float = 0.5) -> None:
        """Do nothing: it answers as it is asked, or :meth:`command` raises."""

    def enable(self, *, inward: bool = False) -> None:
        """Take the arm over where it is; InputError if its angles are not known, DeviceError while an alarm stands."""
        self.command(Command.ENABLE)

    def receive(self, wait_s: float = 0.0) -> JointStates:
        """Read the joints, as often as the rate allows and once at least, and let the rest of ``wait_s`` pass.

        DeviceError: it does not answer any more, has restarted, or reports an error.
        """
        begin, times, read = self._now(), [], []
        for k in range(1 + int(wait_s * self.abilities.rate_hz)):
            if k:
                self._wait(max(0.0, begin + k / self.abilities.rate_hz - self._now()))
                if self._now() - begin >= wait_s:
                    break
            self._read()
            times.append(self._t_s)
            read.append(self._q())
        self._wait(max(0.0, begin + wait_s - self._now()))
        return JointStates(np.array(times), np.array(read))

    def close(self) -> None:
        """Close the port; the arm goes to its last goal and is held there, where its drives are on."""
        raise NotImplementedError
