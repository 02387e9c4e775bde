"""The motions of a run, once with potentiometers alone and once with vision in the loop."""

from __future__ import annotations

from collections.abc import Callable

from armsight.app.run.motion_file import MotionPlan
from armsight.app.run.record import Segment
from armsight.app.run.loop import Controller, Loop
from armsight.app.run.controllers import Closed, Planned
from armsight.data import Array
from armsight.loop.servo import PoseServo
from armsight.robot.trajectories import Tabled, Trajectory

#: Without a loop to settle the arm need not stand longer, s.
OPEN_REST_S = 0.5
#: Makes a controller of a trajectory that begins at a time of the board's clock.
Control = Callable[[Trajectory, float], Controller]


def drive(
    loop: Loop,
    plan: MotionPlan,
    control: Control,
    *,
    closed: bool,
    progress: Callable[[str], None],
    started: Callable[[str, str, float], None] = lambda motion, kind, duration_s: None,
) -> None:
    """Drive all motions of a plan, with its rests.

    Args:
        loop: to run them in; the arm stands at the plan's start.
        plan: the motions.
        control: what commands the joints.
        closed: whether that closes the loop on vision.
        progress: called with a line about what is being done.
        started: called with name, kind and duration of each motion as it begins.

    Raises:
        DeviceError: the board or a camera failed.
    """
    phase = "closed_loop" if closed else "open_loop"
    for motion in plan.motions:
        progress(f"{'loop closed on vision' if closed else 'potentiometers alone'}: {motion.name}")
        controller = control(Tabled(motion.trajectory), loop.t_s)
        segment = Segment(phase, motion.name, motion.kind, closed, trajectory=motion.trajectory)
        started(motion.name, motion.kind, motion.trajectory.duration_s)
        loop.run(controller, motion.trajectory.duration_s, segment)
        rest = Segment("rest", motion.name, motion.kind, closed, trajectory=motion.trajectory)
        loop.run(controller, motion.rest_s if closed else min(motion.rest_s, OPEN_REST_S), rest)


def planned(gravity: Callable[[Array], Array]) -> Control:
    """Return what follows the plan with potentiometers alone."""
    return lambda trajectory, start_s: Planned(trajectory, start_s, gravity)


def closed_on(servo: PoseServo, gravity: Callable[[Array], Array]) -> Control:
    """Return what follows the plan with the loop closed on vision."""
    return lambda trajectory, start_s: Closed(servo, trajectory, start_s, gravity)
