"""How fast a path is travelled: the share of its way over time, jerk-limited, as fast as the joints allow.

The share moves under limits of its own speed, acceleration and jerk. Several proportions of these are tried, and each is
scaled as time is (1/k, 1/k^2, 1/k^3) until the fastest joint, by speed, acceleration or jerk, is just at its limit; from
rest that is exact, because the whole motion then is the same one, k times slower.
"""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from armsight.data import Array
from armsight.errors import InputError
from armsight.robot.trajectories.limits import ROUNDING, Worst, worst
from armsight.robot.trajectories.profile import Profile, plan_profile
from armsight.robot.trajectories.trajectory import Joints, check_times
from armsight.robot.trajectories.walk import Walk, columns

if TYPE_CHECKING:
    from armsight.robot.arm import Arm

#: Rounds of scaling; from rest the second is exact up to where the samples fall.
ROUNDS = 12
#: How near to its limit the fastest joint is brought.
CLOSE = 1e-3
#: Halvings of a duration that find an instant.
HALVINGS = 40
#: Proportions of speed, acceleration and jerk that are tried, and at how many instants each is judged.
SHAPES, INSTANTS = tuple(product((1.0, 0.7, 0.5, 0.3), (1.0, 0.6, 0.3), (1.0, 0.5, 0.2))), 200


def fit_law(arm: Arm, guide: Walk, start: Joints, duration_s: float | None) -> tuple[Profile, Array]:
    """Return the share over time that just keeps the limits by the walk's derivatives, and its own limits (3,).

    Args:
        arm: the arm, for its limits.
        guide: the joints along the way.
        start: (1,) the share to start from, its speed and acceleration.
        duration_s: how long it is to take, s; None for as short as possible.

    Raises:
        InputError: the duration is too short, or a moving start cannot stop on the path.
    """
    limits = _bounds(arm, guide)
    if not start.qd.any() and not start.qdd.any():
        limits = min((_tried(arm, guide, start, limits * shape) for shape in SHAPES), key=lambda found: found[0])[1]
    law = share_law(start, limits)
    for _ in range(ROUNDS):
        stretch = _worst(arm, guide, law, check_times(law.duration_s)).stretch
        if 1 - CLOSE <= stretch <= 1:
            break
        limits = slower(limits, stretch / (1 - CLOSE / 2))
        law = share_law(start, limits)
    if duration_s is None:
        return law, limits
    if duration_s < law.duration_s:
        shortest = f"within the arm's limits this motion takes {law.duration_s:.6g} s"
        raise InputError(f"duration_s is {duration_s:.6g}; {shortest}")
    limits = slower(limits, duration_s / law.duration_s)
    return share_law(start, limits, duration_s), limits


def slower(limits: Array, k: float) -> Array:
    """Return limits (3,) of speed, acceleration and jerk under which a motion from rest takes ``k`` times as long."""
    return np.asarray(limits / np.array([k, k**2, k**3]))


def share_law(start: Joints, limits: Array, duration_s: float | None = None) -> Profile:
    """Return the share over time under limits (3,) of its speed, acceleration and jerk.

    Raises:
        InputError: a moving start cannot stop on the path, or the duration cannot be met.
    """
    law = plan_profile(start, np.ones(1), limits[:1], limits[1:2], limits[2:], duration_s)
    low, high = law.extrema(0)
    if low < -ROUNDING or high > 1 + ROUNDING:
        raise InputError("from this moving start the tool cannot stop at the end of the path within the arm's limits")
    return law


def time_of(law: Profile, share: float) -> float:
    """Return when a share of the way that only rises is reached, s."""
    early, late = 0.0, law.duration_s
    for _ in range(HALVINGS):
        middle = (early + late) / 2
        early, late = (middle, late) if law.at(middle).q[0] < share else (early, middle)
    return late


def _bounds(arm: Arm, guide: Walk) -> Array:
    """Return limits (3,) that no motion along the way can use up altogether."""
    one, two = np.abs(guide.q1), np.abs(guide.q2)
    with np.errstate(divide="ignore"):
        speed = min(float((arm.qd_max / one).min()), float(np.sqrt(arm.qdd_max / two).min()))
        acceleration, jerk = float((arm.qdd_max / one).min()), float((arm.qddd_max / one).min())
    return np.array([speed, acceleration, jerk])


def _tried(arm: Arm, guide: Walk, start: Joints, limits: Array) -> tuple[float, Array]:
    """Return how long a motion from rest takes once it is slow enough, s, and its limits."""
    law = share_law(start, limits)
    stretch = _worst(arm, guide, law, np.linspace(0, law.duration_s, INSTANTS)).stretch
    return law.duration_s * stretch, slower(limits, stretch)


def _worst(arm: Arm, guide: Walk, law: Profile, t_s: Array) -> Worst:
    """Return where the joints come nearest to a limit, between the places of the walk by interpolation."""
    share, speed, acceleration = (part[:, :1] for part in law.at(t_s))
    q1, q2 = (columns(share[:, 0], guide.share, part) for part in (guide.q1, guide.q2))
    return worst(arm, t_s, Joints(q1, q1 * speed, q1 * acceleration + q2 * speed**2))
