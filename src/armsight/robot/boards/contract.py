"""The contract of what a run can drive: our own :class:`~armsight.robot.boards.board.Board`, and other controllers.

To add one: a folder beside ``feetech/`` and ``ar4/`` with a codec and a class that fulfils :class:`MotionBoard`, and a line
in ``opening``. A board says in its :class:`Abilities` what it cannot do, so that a caller rejects a request with one line
instead of sending what nobody acts on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Protocol, Self

import numpy as np

from armsight.data import Array, JointCommand, JointStates
from armsight.errors import InputError
from armsight.robot.boards.codes import Command
from armsight.robot.boards.reports import BoardStatus, JointReport, Welcome
from armsight.robot.kinematics.arm import Arm


@dataclass(frozen=True)
class Abilities:
    """What a board can do, and what it cannot.

    Attributes:
        joints: how many joints it drives.
        rate_hz: readings a second, at most.
        latency_s: by how much the arm lags behind a motion within the two limits below, s; 0 where it is the tick's.
        response_s: from a small change of the command at rest to the joints having made it, s.
        steps_rad: (n,) what each joint is moved by at least, by a controller of its own; empty where it has no such step.
        rest_rad_s: a joint at rest is measured slower than this, rad/s.
        most_speed_rad_s: fastest motion that the controller follows with this lag, rad/s.
        most_acceleration_rad_s2: the same of its acceleration, rad/s^2.
        takes_duty: whether ``gravity_duty`` of a command reaches the motors.
        own_controller: whether the joints are controlled by a controller that armsight cannot tune, configure or test.
        releases: whether the drives can be switched off.
        reading_age_s: by how much a reading is older than its stamp, and its standard deviation, s.
        rounded_rad: what readings are rounded to where their noise does not exceed it, rad; 0: to nothing that matters.
    """

    joints: int
    rate_hz: float
    latency_s: float = 0.0
    response_s: float = 0.05
    steps_rad: tuple[float, ...] = ()
    rest_rad_s: float = 0.055
    most_speed_rad_s: float = math.inf
    most_acceleration_rad_s2: float = math.inf
    takes_duty: bool = True
    own_controller: bool = False
    releases: bool = True
    reading_age_s: tuple[float, float] = (0.0, 0.0)
    rounded_rad: float = 0.0

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
        texts = []
        if not self.takes_duty:
            texts.append("takes no duty: gravity is not compensated")
        if self.own_controller:
            texts.append("keeps its own controller: no gains, no configuration, no self-test")
        if not self.releases:
            texts.append("cannot switch its drives off")
        return tuple(texts)


class MotionBoard(Protocol):
    """What drives the joints of an arm and reads them; time passes in :meth:`receive` and in what waits."""

    @property
    def abilities(self) -> Abilities:
        """What it can do."""
        ...

    @property
    def welcome(self) -> Welcome:
        """Who it is."""
        ...

    @property
    def status(self) -> BoardStatus:
        """Its newest status; counts that it does not keep are 0."""
        ...

    @property
    def joints(self) -> JointReport:
        """Its newest report of how the joints are driven."""
        ...

    @property
    def broken_messages(self) -> int:
        """Number of broken or missing messages from it."""
        ...

    def soft_limits(self) -> tuple[Array, Array]:
        """Return the lower and the upper limits (n,) that it keeps the joints within, rad."""
        ...

    def send(self, command: JointCommand) -> int:
        """Send a motion command and return its number.

        Raises:
            InputError: a shape, a number that is not finite, or what the board rejects at once.
            DeviceError: the board is gone.
        """
        ...

    def command(self, command: Command) -> int:
        """Send a command other than motion and return its number."""
        ...

    def confirm(self, sequence: int, wait_s: float = 0.5) -> None:
        """Wait until the board acknowledged the command of this number.

        Raises:
            DeviceError: it was rejected, or nothing was heard of it.
        """
        ...

    def enable(self, *, inward: bool = False) -> None:
        """Switch the drives on, at the present position, and wait until they are."""
        ...

    def stop(self) -> None:
        """Stop in an emergency."""
        ...

    def receive(self, wait_s: float = 0.0) -> JointStates:
        """Let ``wait_s`` pass and return all readings since the last call.

        Raises:
            DeviceError: the board is gone.
        """
        ...

    def close(self) -> None:
        """Close the link; a driven arm then does what its board does without commands."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...


def checked_goals(command: JointCommand, count: int) -> Array:
    """Return the joint angles (count,) of a command to a board without duty, rad.

    Raises:
        InputError: another number of joints, or an angle that is not finite.
    """
    q_ref = np.asarray(command.q_ref, dtype=float)
    if q_ref.shape != (count,):
        raise InputError(f"q_ref is of shape {q_ref.shape}; this board has {count} joints: is it the right arm?")
    if not np.isfinite(q_ref).all():
        joint = int(np.argmin(np.isfinite(q_ref)))
        raise InputError(f"q_ref of joint {joint + 1} is {q_ref[joint]}; it must be finite")
    return q_ref
