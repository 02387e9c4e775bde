"""How fast a path is travelled: the share of its way over time, jerk-limited, as fast as the joints allow.

The share moves under limits of its own speed, acceleration and jerk. Several proportions of these are tried, and each is
scaled as time is (1/k, 1/k^2, 1/k^3) until the fastest joint, by speed, acceleration or jerk, is just at its limit; from
rest that is exact, because the whole motion then is the same one, k times slower.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from operator import attrgetter
from typing import TYPE_CHECKING, Protocol

import numpy as np

from armsight.data import Array
from armsight.errors import InputError
from armsight.robot.trajectories.limits import ROUNDING, stretches, worst
from armsight.robot.trajectories.lookahead import Walk, columns
from armsight.robot.trajectories.profile import Profile, plan_profile
from armsight.robot.trajectories.trajectory import CHECK_RATE_HZ, Joints, check_times

if TYPE_CHECKING:
    from armsight.robot.arm import Arm

#: Rounds of scaling; from rest the second is exact up to where the samples fall.
ROUNDS = 12
#: How near to its limit the fastest joint is brought.
CLOSE = 1e-3
#: From a moving start these scales are tried too, and at most so many of what is found are looked at closely.
SCALES, TRIED = (1.03, 1.0, 0.97, 0.93, 0.87, 0.8, 0.7, 0.6, 0.5, 0.4), 20
#: Where none of these will do: speeds and accelerations as shares of what the joints could do at most, beside the start's
#: own, which are a little widened; what is made harder, the jerk alone or all limits as time is scaled; up to what, and in
#: how many halvings.
SPEEDS, ACCELERATIONS, ALIKE = np.array([4.0, 1.0, 0.7, 0.5, 0.3]), np.array([4.0, 1.0, 0.6, 0.3]), 1e-7
JERK_ONLY, ALL_LIMITS, HARDEST, HARDER = np.array([0.0, 0.0, 1.0]), np.array([1.0, 2.0, 3.0]), 2.0, 14
#: How exactly the walk's derivatives are known between its places, how long a start's own state may last, s, and at every
#: how many-th instant of the later check a moving start's laws are judged.
HAIR, FIRST_S, EVERY = 2e-4, 5e-3, 2
#: Halvings of a duration that find an instant.
HALVINGS = 40
#: Proportions of speed, acceleration and jerk that are tried, and at how many instants each is judged.
SHAPES, INSTANTS = tuple(product((1.0, 0.7, 0.5, 0.3), (1.0, 0.6, 0.3), (1.0, 0.5, 0.2))), 200


class Law(Protocol):
    """The share of the way over time."""

    @property
    def duration_s(self) -> float:
        """How long the motion takes, s."""

    def at(self, t_s: float | Array) -> Joints:
        """Return the share, its speed and its acceleration, (1,) or (N, 1), ``t_s`` seconds after the start."""

    def slower(self, k: float) -> Law:
        """Return the law of the same motion from rest, ``k`` times as long."""


@dataclass(frozen=True, eq=False)
class SingleLaw:
    """One jerk-limited rise of the share.

    Attributes:
        start: (1,) the share to start from, its speed and acceleration.
        limits: (3,) of the share's speed, acceleration and jerk.
        profile: the share over time.
    """

    start: Joints
    limits: Array
    profile: Profile

    @property
    def duration_s(self) -> float:
        """How long the motion takes, s."""
        return self.profile.duration_s

    def at(self, t_s: float | Array) -> Joints:
        """Return the share, its speed and its acceleration ``t_s`` seconds after the start."""
        return self.profile.at(t_s)

    def slower(self, k: float) -> SingleLaw:
        """Return the law of the same motion from rest, ``k`` times as long."""
        return single_law(self.start, slower(self.limits, k))


def fit_law(arm: Arm, guide: Walk) -> SingleLaw:
    """Return the share over time, from rest, that just keeps the limits by the walk's derivatives."""
    start = Joints(np.zeros(1), np.zeros(1), np.zeros(1))
    limits = bounds(arm, guide)
    limits = min((_tried(arm, guide, start, limits * shape) for shape in SHAPES), key=lambda found: found[0])[1]
    law = single_law(start, limits)
    for _ in range(ROUNDS):
        t_s = check_times(law.duration_s)
        stretch = worst(arm, t_s, along(guide, law, t_s)).stretch
        if 1 - CLOSE <= stretch <= 1:
            break
        law = law.slower(stretch / (1 - CLOSE / 2))
    return law


def moving_laws(arm: Arm, guide: Walk, start: Joints, duration_s: float | None) -> Iterator[SingleLaw]:
    """Yield shares over time from a moving start that keep the limits by the walk's derivatives, the shortest first.

    Args:
        arm: the arm, for its limits.
        guide: the joints along the way.
        start: (1,) the share to start from, its speed and acceleration.
        duration_s: how long it is to take, s; None for as short as possible.

    Raises:
        InputError: none of those tried does.
    """
    rest = Joints(start.q, np.zeros(1), np.zeros(1))
    found = []
    for shape in SHAPES:
        _, limits = _tried(arm, guide, rest, bounds(arm, guide) * shape)
        for scale in SCALES:
            try:
                law = single_law(start, slower(limits, 1 / scale), duration_s)
            except InputError:
                continue
            if keeps(arm, guide, law):
                found.append(law)
    by_length = attrgetter("duration_s")
    yield from sorted(found, key=by_length)[:TRIED]
    hard_pressed = _hard_pressed(arm, guide, start, duration_s)
    yield from sorted(hard_pressed, key=by_length)[:TRIED]
    if not (found or hard_pressed):
        asked = "" if duration_s is None else f" in {duration_s:g} s"
        raise InputError(f"from this moving start no motion to the end of the path{asked} keeps the arm's limits")


def _hard_pressed(arm: Arm, guide: Walk, start: Joints, duration_s: float | None) -> list[SingleLaw]:
    """Return what :func:`moving_laws` does, for a start that leaves hardly any choice: each as hard as can be.

    A motion taken up where it speeds up or brakes at a limit can go on in little else than the way it began: what is
    gentler runs past the end, what is less gentle passes the limit.
    """
    most, found = bounds(arm, guide), []
    now = np.abs([start.qd[0], start.qdd[0]]) * (1 + ALIKE)
    speeds, accelerations = (*(most[0] * SPEEDS), now[0]), (*(most[1] * ACCELERATIONS), now[1])
    rays = [(np.array([*pair, most[2]]), JERK_ONLY) for pair in product(speeds, accelerations)]
    for base, powers in rays + [(most * shape, ALL_LIMITS) for shape in SHAPES]:
        gentle, hard, best = 0.0, HARDEST, None
        for _ in range(HARDER):
            middle = (gentle + hard) / 2
            try:
                law = single_law(start, base * middle**powers, duration_s)
            except InputError:
                gentle = middle
                continue
            if keeps(arm, guide, law):
                gentle, best = middle, law
            else:
                hard = middle
        if best is not None:
            found.append(best)
    return found


def keeps(arm: Arm, guide: Walk, law: Law | Profile) -> bool:
    """Say whether a law from a moving start keeps the limits by the walk's derivatives.

    They are known to :data:`HAIR` there, so the joints must stay that far within the limits, but for the first instants:
    the start may be at a limit, and is looked at exactly afterwards.
    """
    t_s = np.linspace(0, law.duration_s, max(2, int(np.ceil(law.duration_s * CHECK_RATE_HZ / EVERY))))
    needed = stretches(arm, t_s, along(guide, law, t_s))
    return bool((needed <= np.where(t_s < FIRST_S, 1 + HAIR, 1 - HAIR)).all())


def slower(limits: Array, k: float) -> Array:
    """Return limits (3,) of speed, acceleration and jerk under which a motion from rest takes ``k`` times as long."""
    return np.asarray(limits / np.array([k, k**2, k**3]))


def single_law(start: Joints, limits: Array, duration_s: float | None = None) -> SingleLaw:
    """Return the share over time under limits (3,) of its speed, acceleration and jerk.

    Raises:
        InputError: a moving start cannot stop on the path, or the duration cannot be met.
    """
    profile = plan_profile(start, np.ones(1), limits[:1], limits[1:2], limits[2:], duration_s)
    low, high = profile.extrema(0)
    if low < -ROUNDING or high > 1 + ROUNDING:
        raise InputError("from this moving start the tool cannot stop at the end of the path within the arm's limits")
    return SingleLaw(start, limits, profile)


def time_of(law: Law, share: float) -> float:
    """Return when a share of the way that only rises is reached, s."""
    early, late = 0.0, law.duration_s
    for _ in range(HALVINGS):
        middle = (early + late) / 2
        early, late = (middle, late) if law.at(middle).q[0] < share else (early, middle)
    return late


def bounds(arm: Arm, guide: Walk) -> Array:
    """Return limits (3,) that no motion along the way can use up altogether."""
    one, two = np.abs(guide.q1), np.abs(guide.q2)
    with np.errstate(divide="ignore"):
        speed = min(float((arm.qd_max / one).min()), float(np.sqrt(arm.qdd_max / two).min()))
        acceleration, jerk = float((arm.qdd_max / one).min()), float((arm.qddd_max / one).min())
    return np.array([speed, acceleration, jerk])


def along(guide: Walk, law: Law | Profile, t_s: Array) -> Joints:
    """Return the joints (N, 6) at times (N,), between the places of the walk by interpolation; angles are left at 0."""
    share, speed, acceleration = (part[:, :1] for part in law.at(t_s))
    q1, q2 = (columns(share[:, 0], guide.share, part) for part in (guide.q1, guide.q2))
    return Joints(np.zeros_like(q1), q1 * speed, q1 * acceleration + q2 * speed**2)


def _tried(arm: Arm, guide: Walk, start: Joints, limits: Array) -> tuple[float, Array]:
    """Return how long a motion from rest takes once it is slow enough, s, and its limits."""
    law = single_law(start, limits)
    t_s = np.linspace(0, law.duration_s, INSTANTS)
    stretch = worst(arm, t_s, along(guide, law, t_s)).stretch
    return law.duration_s * stretch, slower(limits, stretch)
