"""The controllers of a run: open loop (:class:`Planned`), closed on vision (:class:`Closed`); and what they follow.

:class:`Planned` sends a trajectory as it is: the board then controls the joints by their potentiometers alone.
:class:`Closed` corrects it by the tool pose that vision measures. :class:`Sweep` is the trajectory that the cameras'
delay is measured with. :func:`drive` makes all motions of a plan with either controller.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from armsight.app.run.loop import PERIOD_S, Controller, Loop
from armsight.app.run.motion_file import MotionPlan
from armsight.app.run.record import RunSegment
from armsight.data import Array, JointCommand
from armsight.loop.estimators import Estimator
from armsight.loop.health import HealthMonitor, Trust
from armsight.loop.servo import Aim, PoseServo
from armsight.robot.kinematics.arm import Arm
from armsight.robot.trajectories import Joints, Tabled, Trajectory

#: A joint that lifts the tool by more than this, m per rad, carries a gravity load.
LOADED_M = 0.15


class Planned:
    """Sends a trajectory to the board as it was planned; stands at its end.

    Args:
        trajectory: joint angles over time.
        start_s: when it begins, board's clock, s.
        gravity: returns the duty (n,) that compensates the gravity torque at joint angles (n,), rad.
    """

    def __init__(self, trajectory: Trajectory, start_s: float, gravity: Callable[[Array], Array]) -> None:
        self._trajectory, self._start_s, self._gravity = trajectory, start_s, gravity
        self._next: JointCommand | None = None

    def prepare(self, t_s: float) -> None:
        """Compute the reference of the joints one period from now."""
        ahead = self._trajectory.at(t_s + PERIOD_S - self._start_s)
        self._next = JointCommand(ahead.q, ahead.qd, self._gravity(ahead.q), PERIOD_S)

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
        reach_rad: amplitude, rad.
        duration_s: duration, s.
    """

    def __init__(self, arm: Arm, q_middle: Array, reach_rad: float = 0.12, *, duration_s: float) -> None:
        self.duration_s, self._middle = duration_s, q_middle
        lifts = np.abs(arm.jacobian(q_middle)[2])  # of the tool by each joint, m/rad
        self._reach = reach_rad * (lifts > LOADED_M)
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


class Closed:
    """Sends a trajectory corrected by the tool pose that vision measures.

    Args:
        servo: the outer loop; one for all motions, as its correction continues from one to the next.
        health: returns what says how far vision may be relied on.
        trajectory: joint angles over time.
        start_s: when it begins, board's clock, s.
        gravity: returns the duty (n,) that compensates the gravity torque at joint angles (n,), rad.
        rest_s: how long the arm rests at its end, s.
    """

    def __init__(
        self,
        servo: PoseServo,
        health: Callable[[], HealthMonitor],
        trajectory: Trajectory,
        start_s: float,
        gravity: Callable[[Array], Array],
        rest_s: float = math.inf,
    ) -> None:
        self._servo, self._health, self._trajectory, self._start_s = servo, health, trajectory, start_s
        self._gravity, self._rest_s = gravity, rest_s
        self._aim: Aim | None = None

    def prepare(self, t_s: float) -> None:
        """Compute the reference of the tool one period from now."""
        self._aim = self._servo.aim(self._trajectory, t_s - self._start_s, self._gravity, rest_s=self._rest_s)

    def command(self, estimator: Estimator) -> tuple[JointCommand, str]:
        """Return the corrected reference of the joints, and its basis: vision, bridged, planned."""
        assert self._aim is not None
        health = self._health()
        trust = health.trust
        before = health.before if trust is Trust.NONE else None
        step = self._servo.step(self._aim, estimator, trust, before)
        return step.command, step.mode.name.lower()


#: Longest rest in open loop, s, beyond what the board lags: there is no correction that has to settle.
OPEN_REST_S = 0.5
#: Makes a controller from a trajectory, the time at which it begins, board's clock, s, and how long the arm then rests, s.
Control = Callable[[Trajectory, float, float], Controller]


def drive(
    loop: Loop,
    plan: MotionPlan,
    control: Control,
    *,
    closed: bool,
    progress: Callable[[str], None],
    started: Callable[[str, str, float], None] = lambda motion, kind, duration_s: None,
) -> None:
    """Make all motions of a plan, with its rests.

    Args:
        loop: runs them; the arm stands at the plan's start.
        plan: the motions.
        control: makes the controller of each motion.
        closed: whether that closes the loop on vision.
        progress: called with a line about what is being done.
        started: called with name, kind and duration (s) of each motion as it begins.

    Raises:
        DeviceError: the board or a camera failed.
    """
    phase = "closed_loop" if closed else "open_loop"
    open_s = OPEN_REST_S + 2.0 * loop.setup.board.abilities.latency_s
    for motion in plan.motions:
        progress(f"{'loop closed on vision' if closed else 'joint sensors alone'}: {motion.name}")
        controller = control(Tabled(motion.trajectory), loop.t_s, motion.rest_s)
        segment = RunSegment(phase, motion.name, motion.kind, closed, trajectory=motion.trajectory)
        started(motion.name, motion.kind, motion.trajectory.duration_s)
        loop.run(controller, motion.trajectory.duration_s, segment)
        rest = RunSegment("rest", motion.name, motion.kind, closed, trajectory=motion.trajectory)
        loop.run(controller, motion.rest_s if closed else min(motion.rest_s, open_s), rest)


def planned(gravity: Callable[[Array], Array]) -> Control:
    """Return the control that follows the plan with potentiometers alone."""
    return lambda trajectory, start_s, rest_s: Planned(trajectory, start_s, gravity)


def closed_on(servo: PoseServo, health: Callable[[], HealthMonitor], gravity: Callable[[Array], Array]) -> Control:
    """Return the control that follows the plan with the loop closed on vision, as far as that may be relied on."""
    return lambda trajectory, start_s, rest_s: Closed(servo, health, trajectory, start_s, gravity, rest_s)
