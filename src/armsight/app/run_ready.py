"""What must be so before an arm moves: code compiled, the board free of faults, the joints where the motion starts."""

from __future__ import annotations

import contextlib

import numpy as np

from armsight.app.run.motion_file import MotionPlan
from armsight.app.run.loop import PERIOD_S
from armsight.app.run.setup import Station
from armsight.data import Array, JointStates
from armsight.errors import ArmsightError, DeviceError, InputError
from armsight.loop.estimators import Delay, KalmanEstimator, Sighting
from armsight.loop.servo import PoseServo, Timing
from armsight.robot.arm import Arm
from armsight.robot.boards.board import Board
from armsight.robot.boards.codes import STATE_TEXTS, Fault, Order, State
from armsight.robot.trajectories import Trajectory, point_to_point

#: The joints must agree with where the motion is to start to so much before anything moves, rad.
START_RAD = float(np.radians(2.0))
#: A board that slows its arm down is waited for so long, s.
_SLOWS_S = 3.0
_STEP_S = 0.05
_MOVE_RAD = 0.05  # of the joints, in what is rehearsed
_REHEARSED = 400  # readings
_LOOKED = 200  # places along a motion


def enable(board: Board) -> None:
    """Switch the drives on; an arm that is held since an earlier host fell silent is taken over as it stands.

    Raises:
        DeviceError: another fault stands: that is for a person to look at. Or the board refused.
    """
    waited_s = 0.0
    while board.status.state is State.STOPPING and waited_s < _SLOWS_S:
        board.receive(_STEP_S)
        waited_s += _STEP_S
    faults = board.status.faults
    if faults and all(each.fault is Fault.HOST_SILENT for each in faults):
        board.confirm(board.order(Order.CLEAR_FAULTS))
    elif faults or board.status.state is State.STOPPED:
        causes = "; ".join(str(fault) for fault in faults) or "the emergency stop was pressed"
        raise DeviceError(
            f"the board is not ready: {STATE_TEXTS[board.status.state]} ({causes}): see to the cause, and switch the board "
            "off and on again"
        )
    if board.status.state is not State.ENABLED:  # a held arm is taken over without letting go of it
        board.enable()


def rehearse(arm: Arm) -> None:
    """Run once all that the loop runs in motion: nothing is compiled while an arm waits for its next command."""
    low, high = np.maximum(arm.home - _MOVE_RAD, arm.q_min), np.minimum(arm.home + _MOVE_RAD, arm.q_max)
    way = point_to_point(arm, low, high)
    t_s = np.linspace(1e-3, 1e-3 * _REHEARSED, _REHEARSED)
    q = way.at(t_s).q
    servo = PoseServo(arm, Timing(PERIOD_S, 0.016, 0.02))
    estimator = KalmanEstimator(arm, delay=Delay(0.02, 0.02))
    for first in range(0, _REHEARSED, 4):
        rows = slice(first, first + 4)
        estimator.joints(JointStates(t_s[rows], q[rows]))
        estimator.estimate()
        if first % 16 == 0:
            estimator.vision(Sighting(float(t_s[first]), arm.forward(q[first]), 1e-8 * np.eye(6), 1e-8 * np.eye(6)))
        with contextlib.suppress(ArmsightError):
            servo.step(servo.aim(way, float(t_s[first])), estimator)
    estimator.smoothed(t_s[-100:])


def require_start(station: Station, plan: MotionPlan, targets: Array) -> None:
    """Refuse to begin where the arm is not where the motion starts, or is no such arm at all.

    Args:
        station: the arm and its board.
        plan: the motions.
        targets: (N, 6) where else the joints will go, rad.

    Raises:
        ArmsightError: which joint is where, and where it should be.
    """
    states = station.board.receive(0.2)
    if not len(states.q):
        raise DeviceError("the board tells no joint angles: is its wire's baud rate right?")
    q = states.q[-1]
    off = np.abs(q - plan.start)
    if off.max() > START_RAD:
        joint = int(off.argmax())
        raise InputError(
            f"joint {joint + 1} reads {np.degrees(q[joint]):.1f} deg, the motion starts at "
            f"{np.degrees(plan.start[joint]):.1f}: bring the arm to the start, or give start_deg; if it is there, "
            f"--model {station.arm.name} does not match the board's potentiometers (armsight board monitor)"
        )
    _require_range(station, np.vstack([targets, *(passed(m.trajectory) for m in plan.motions)]))


def passed(way: Trajectory) -> Array:
    """Return joint angles (N, 6) that a motion passes, rad."""
    return way.at(np.linspace(0.0, way.duration_s, _LOOKED)).q


def _require_range(station: Station, q: Array) -> None:
    """Refuse joint angles (N, 6) that the board's own limits do not allow: it would hold the joint back on the way."""
    config = station.board.configuration()["joint"]
    low, high = config["soft_min_rad"].astype(float), config["soft_max_rad"].astype(float)
    beyond = np.maximum(q.max(axis=0) - high, low - q.min(axis=0))
    if beyond.max() > 1e-3:
        joint = int(beyond.argmax())
        raise InputError(
            f"joint {joint + 1} is to go from {np.degrees(q[:, joint].min()):.1f} to {np.degrees(q[:, joint].max()):.1f} "
            f"deg, the board allows {np.degrees(low[joint]):.1f} to {np.degrees(high[joint]):.1f}: change the motion or "
            f"the board's soft limits; or is --model {station.arm.name} another arm than the board's?"
        )
