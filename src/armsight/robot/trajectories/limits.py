"""An arm's limits: which start states may be moved on from, and whether a motion keeps within them at 1 kHz."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from armsight.data import Array
from armsight.errors import InputError
from armsight.geometry.check import checked
from armsight.robot.trajectories.trajectory import Joints, MotionRejected, Trajectory, check_times, pieces

if TYPE_CHECKING:
    from armsight.robot.kinematics.arm import Arm

ROUNDING = 1e-9  # relative excess of a limit that is rounding and no motion


class Worst(NamedTuple):
    """Where a motion comes nearest to a limit, or passes it furthest."""

    ratio: float  #: the value over its limit; at most 1 within it
    time_scale: float  #: how many times longer the motion would have to take to be just at that limit
    what: str  #: the limited quantity in words, with its values
    t_s: float  #: when, s


def start_state(arm: Arm, q: ArrayLike, qd: ArrayLike | None, qdd: ArrayLike | None) -> Joints:
    """Return a start state within the arm's limits, at rest where no speeds are given; or InputError."""
    zero, shape = np.zeros(arm.joints), (arm.joints,)
    start = Joints(
        inside(arm, q, "q_start"),
        zero if qd is None else checked(qd, shape, "qd_start"),
        zero if qdd is None else checked(qdd, shape, "qdd_start"),
    )
    # The speed still gains this while the acceleration is taken back at full jerk.
    gain = np.where(start.qdd == 0, 0.0, start.qdd * np.abs(start.qdd) / (2 * arm.qddd_max))
    for name, value, limit, unit in (
        ("qdd_start", start.qdd, arm.qdd_max, "deg/s^2"),
        ("qd_start", start.qd, arm.qd_max, "deg/s"),
        ("qd_start with what qdd_start adds to it", start.qd + gain, arm.qd_max, "deg/s"),
    ):
        over = np.abs(value) > limit * (1 + ROUNDING)
        if over.any():
            i = int(np.argmax(over))
            raise InputError(
                f"{name}: joint {i + 1} has {np.degrees(value[i]):.3f} {unit}, its limit is {np.degrees(limit[i]):.3f}"
            )
    return start


def inside(arm: Arm, q: ArrayLike, name: str) -> Array:
    """Return joint angles (n,), rad, that have been found within the arm's limits; or InputError."""
    angles = checked(q, (arm.joints,), name)
    arm.forward(angles)  # rejects degrees with a hint
    if (reason := outside(arm, angles)) is not None:
        raise InputError(f"{name}: {reason}")
    return angles


def outside(arm: Arm, q: Array) -> str | None:
    """Return which joint (n,) is beyond its limits, in words; None where none is."""
    over = np.maximum(arm.q_min - q, q - arm.q_max)
    i = int(np.argmax(over))
    if over[i] <= ROUNDING:
        return None
    low, high = np.degrees(arm.q_min[i]), np.degrees(arm.q_max[i])
    return f"joint {i + 1} at {np.degrees(q[i]):.3f} deg is outside its limits {low:.3f} to {high:.3f} deg"


def worst(arm: Arm, t_s: Array, joints: Joints) -> Worst:
    """Return where samples (N, n) at times (N,) come nearest to a limit of speed, acceleration or jerk."""
    found = []
    for order, (name, unit, ratios, limit) in enumerate(_ratios(arm, t_s, joints), start=1):
        row, i = np.unravel_index(int(np.argmax(ratios)), ratios.shape)
        ratio, most = float(ratios[row, i]), float(np.degrees(limit[i]))
        what = f"joint {i + 1} would need a {name} of {ratio * most:.4g} {unit}, its limit is {most:.4g}"
        found.append(Worst(ratio, ratio ** (1 / order), what, float(t_s[row])))
    return max(found, key=lambda w: w.time_scale)


def time_scales(arm: Arm, t_s: Array, joints: Joints) -> Array:
    """Return how many times longer the motion would have to take for each of its samples (N,) to be at a limit."""
    ratios = [ratios.max(axis=1) ** (1 / order) for order, (_, _, ratios, _) in enumerate(_ratios(arm, t_s, joints), 1)]
    return np.asarray(np.max(ratios, axis=0))


def _ratios(arm: Arm, t_s: Array, joints: Joints) -> list[tuple[str, str, Array, Array]]:
    """Return name, unit, ratio (N, n) to the limit, and limit (n,), of speed, acceleration and jerk."""
    steps = np.diff(t_s)
    full = steps > 0.5 * np.median(steps) if len(steps) else np.zeros(0, bool)  # the last one may be a sliver
    jerk = np.zeros_like(joints.qdd)
    jerk[:-1][full] = np.diff(joints.qdd, axis=0)[full] / steps[full, None]
    return [
        ("speed", "deg/s", np.abs(joints.qd) / arm.qd_max, arm.qd_max),
        ("acceleration", "deg/s^2", np.abs(joints.qdd) / arm.qdd_max, arm.qdd_max),
        ("jerk", "deg/s^3", np.abs(jerk) / arm.qddd_max, arm.qddd_max),
    ]


def check_limits(arm: Arm, trajectory: Trajectory) -> None:
    """Check a motion in joints against every limit of the arm at 1 kHz.

    Raises MotionRejected: at the first instant outside the joint limits, or where another limit is passed.
    """
    for t_s in pieces(check_times(trajectory.duration_s)):
        joints = trajectory.at(t_s)
        over = np.maximum(arm.q_min - joints.q, joints.q - arm.q_max).max(axis=1) > ROUNDING
        if over.any():
            row = int(np.argmax(over))
            raise _rejection(arm, trajectory, str(outside(arm, joints.q[row])), float(t_s[row]))
        most = worst(arm, t_s, joints)
        if most.ratio > 1 + ROUNDING:
            raise _rejection(arm, trajectory, most.what, most.t_s)


def _rejection(arm: Arm, trajectory: Trajectory, reason: str, t_s: float) -> MotionRejected:
    share = t_s / trajectory.duration_s if trajectory.duration_s > 0 else 0.0
    return MotionRejected(reason, share=share, t_s=t_s, p_base=arm.forward(trajectory.at(t_s).q)[:3, 3])
