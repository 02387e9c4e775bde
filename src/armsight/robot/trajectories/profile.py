"""Jerk-limited profiles of one or more axes from a moving state to rest, all arriving together.

Berscheid and Kroeger, "Jerk-limited real-time trajectory generation with arbitrary target states", RSS 2021: the
time-optimal profiles of the ruckig library, run in this process.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import ruckig  # type: ignore[import-not-found, import-untyped, unused-ignore]

from armsight.data import Array
from armsight.errors import InputError
from armsight.robot.trajectories.trajectory import Joints, clamped

#: A duration asked for counts as met within this, s: profiles are solved to rounding errors of about 1e-12 s.
DURATION_TOLERANCE_S = 1e-8


@dataclass(frozen=True, eq=False)
class Profile:
    """Axes over time, exact between its instants."""

    duration_s: float  #: when all axes have arrived, s
    solved: ruckig.Trajectory  #: ruckig's solution

    def at(self, t_s: float | Array) -> Joints:
        """Return the axes' positions, speeds and accelerations, (n,) or (N, n), ``t_s`` seconds after the start."""
        times = clamped(t_s, self.duration_s)
        states = [self.solved.at_time(t) for t in times.ravel().tolist()]
        return Joints(*np.array(states).transpose(1, 0, 2).reshape(3, *times.shape, -1))

    def extrema(self, axis: int) -> tuple[float, float]:
        """Return the smallest and the largest position of an axis on the way."""
        bound = self.solved.position_extrema[axis]
        return float(bound.min), float(bound.max)


def plan_profile(
    start: Joints,
    goal: Array,
    speed: Array,
    acceleration: Array,
    jerk: Array,
    duration_s: float | None = None,
    goal_speed: Array | None = None,
) -> Profile:
    """Plan axes to arrive at a goal, together, as fast as their limits allow.

    ``start``: (n,) positions, speeds and accelerations to start from; a speed beyond its limit is braked first. ``goal``:
    (n,) positions to end at. ``speed``: (n,) limits of the speeds, and ``acceleration`` and ``jerk`` of their derivatives;
    infinite is allowed. ``duration_s``: how long it is to take instead; None for as short as possible. ``goal_speed``: (n,)
    speeds to arrive with; None for rest. Raises InputError: the duration is shorter than the limits allow, or cannot be met
    from this moving start.
    """
    n = len(goal)
    asked = ruckig.InputParameter(n)
    asked.current_position, asked.current_velocity, asked.current_acceleration = (list(map(float, x)) for x in start)
    asked.target_position = list(map(float, goal))
    if goal_speed is not None:
        asked.target_velocity = list(map(float, goal_speed))
    asked.max_velocity, asked.max_acceleration, asked.max_jerk = (
        list(map(float, limit)) for limit in (speed, acceleration, jerk)
    )
    # Straight in joint space where the start is at rest; where that cannot be, all axes still arrive together.
    asked.synchronization = ruckig.Synchronization.Phase
    if duration_s is not None:
        asked.minimum_duration = duration_s
    solved = ruckig.Trajectory(n)
    try:
        result = ruckig.Ruckig(n).calculate(asked, solved)
    except ruckig.RuckigError as error:
        raise InputError(f"no jerk-limited profile for these numbers: {error}") from None
    if result != ruckig.Result.Working:
        raise InputError(f"no jerk-limited profile was found for these numbers ({result.name})")
    if duration_s is not None and abs(solved.duration - duration_s) > DURATION_TOLERANCE_S:
        raise InputError(
            f"duration_s is {duration_s:.6g}, but the limits and the start allow {solved.duration:.6g} s and not that; "
            "ask for that, or for none"
        )
    return Profile(float(solved.duration), solved)
