"""Controllers: open loop (:class:`Planned`), closed on vision (:class:`Closed`), at rest (:class:`Still`).

:class:`Planned` sends a trajectory as it is, and the board controls the joints by their sensors alone; :class:`Closed`
corrects it by the tool pose that vision measures. :class:`Sweep` is the trajectory that shows the delay of the cameras.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from armsight.data import Array, JointCommand
from armsight.loop.estimators import Estimator
from armsight.loop.health import HealthMonitor, Trust
from armsight.loop.servo import Aim, PoseServo
from armsight.robot.kinematics.arm import Arm
from armsight.robot.trajectories import Joints, Trajectory

#: Period of the loop and so of the commands, s.
PERIOD_S = 0.004
#: A joint that lifts the tool by more than this, m per rad, carries a gravity load.
LOADED_M = 0.15
#: Amplitude of the joints in a sweep, rad: with half, the delay is known half as well; with twice, the body leaves view.
REACH_RAD = 0.12


class Controller(Protocol):
    """Computes the next joint command, in two steps, so that little is left to do after an image was measured."""

    def prepare(self, t_s: float) -> None:
        """Compute what the command at time ``t_s`` (board's clock, s) needs and no image changes."""
        ...

    def command(self, estimator: Estimator) -> tuple[JointCommand, str]:
        """Return the command that was prepared, and its basis: planned, vision, bridged."""
        ...


@dataclass
class Still:
    """A controller that repeats one command."""

    held: JointCommand

    def prepare(self, t_s: float) -> None:
        """Do nothing: the command is fixed."""

    def command(self, estimator: Estimator) -> tuple[JointCommand, str]:
        """Return the command, and "planned" as its basis."""
        return self.held, "planned"


@dataclass
class Planned:
    """Sends a trajectory to the board as it was planned; stands at its end."""

    trajectory: Trajectory  #: joint angles over time
    start_s: float  #: when it begins, board's clock, s
    #: returns the duty (n,) that compensates the gravity torque at joint angles (n,), rad.
    gravity: Callable[[Array], Array]
    _next: JointCommand | None = None

    def prepare(self, t_s: float) -> None:
        """Compute the reference of the joints one period from now."""
        ahead = self.trajectory.at(t_s + PERIOD_S - self.start_s)
        self._next = JointCommand(ahead.q, ahead.qd, self.gravity(ahead.q), PERIOD_S)

    def command(self, estimator: Estimator) -> tuple[JointCommand, str]:
        """Return the reference, and "planned" as its basis."""
        assert self._next is not None
        return self._next, "planned"


class Sweep:
    """A trajectory that moves the joints back and forth with varying speed, to measure the delay of the cameras.

    Only joints with a gravity load move: the load keeps their backlash on one side. A joint without load lags by its
    backlash after every reversal, which looks like a delay: 0.1 degree at 30 degrees a second are 3 ms.

    Args:
        arm: the nominal arm, its base upright.
        q_middle: (n,) joint angles about which they move, rad; the trajectory begins and ends there.
        duration_s: duration, s.
    """

    def __init__(self, arm: Arm, q_middle: Array, *, duration_s: float) -> None:
        self.duration_s, self._middle = duration_s, q_middle
        lifts = np.abs(arm.jacobian(q_middle)[2])  # of the tool by each joint, m/rad
        self._reach = REACH_RAD * (lifts > LOADED_M)
        self._rates = 2 * np.pi * np.array([0.9, 0.7, 1.1, 1.3, 0.8, 1.0, 1.2])[: arm.joints]

    def at(self, t_s: float | Array) -> Joints:
        """Return angles, speeds and accelerations of the joints ``t_s`` seconds after the start."""
        t = np.clip(np.asarray(t_s, float), 0.0, self.duration_s)[..., None]
        x = np.pi * t / self.duration_s
        window, window_d = np.sin(x) ** 2, np.pi / self.duration_s * np.sin(2 * x)
        window_dd = 2 * (np.pi / self.duration_s) ** 2 * np.cos(2 * x)
        s, c, w = np.sin(self._rates * t), np.cos(self._rates * t), self._rates
        q = self._middle + self._reach * window * s
        qd = self._reach * (window_d * s + window * w * c)
        qdd = self._reach * (window_dd * s + 2 * window_d * w * c - window * w**2 * s)
        return Joints(q, qd, qdd)


@dataclass
class Closed:
    """Sends a trajectory corrected by the tool pose that vision measures."""

    servo: PoseServo  #: the outer loop; one for all motions, as its correction continues from one to the next
    health: Callable[[], HealthMonitor]  #: returns what says how far vision may be relied on
    trajectory: Trajectory  #: joint angles over time
    start_s: float  #: when it begins, board's clock, s
    #: returns the duty (n,) that compensates the gravity torque at joint angles (n,), rad.
    gravity: Callable[[Array], Array]
    rest_s: float  #: how long the arm rests at its end, s
    _aim: Aim | None = None

    def prepare(self, t_s: float) -> None:
        """Compute the reference of the tool one period from now."""
        self._aim = self.servo.aim(self.trajectory, t_s - self.start_s, self.gravity, rest_s=self.rest_s)

    def command(self, estimator: Estimator) -> tuple[JointCommand, str]:
        """Return the corrected reference of the joints, and its basis: vision, bridged, planned."""
        assert self._aim is not None
        health = self.health()
        trust = health.trust
        before = health.before if trust is Trust.NONE else None
        step = self.servo.step(self._aim, estimator, trust, before)
        return step.command, step.mode.name.lower()
