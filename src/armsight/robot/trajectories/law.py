"""How fast a path is travelled: the share of its way over time, jerk-limited, as fast as the joints allow.

In: an arm's limits and the joints along a path (:class:`~armsight.robot.trajectories.lookahead.Walk`). Out: a
:class:`Law`, the share of the way (0 to 1), its speed and its acceleration over time.

The share moves under limits of its own speed, acceleration and jerk. Several proportions of these are tried, and each is
scaled as time is (1/k, 1/k^2, 1/k^3) until the fastest joint, by speed, acceleration or jerk, is just at its limit; from
rest that is exact, because the whole motion then is the same one, k times slower.

A path with bends is travelled faster on its straight parts and at a steady pace through each bend (:class:`ChainLaw`).
Every straight part has limits of its own for the share's speed, acceleration and jerk, every bend a speed. They begin at
what the joints could do at most; whichever part brings a joint over a limit is slowed down, and a bend also where the
straight part beside it is too short to brake or to gain speed, until all limits hold.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise, product
from operator import attrgetter
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from armsight.data import Array
from armsight.errors import InputError
from armsight.robot.trajectories.limits import ROUNDING, time_scales, worst
from armsight.robot.trajectories.lookahead import Walk, columns
from armsight.robot.trajectories.profile import Profile, plan_profile
from armsight.robot.trajectories.trajectory import CHECK_RATE_HZ, Joints, check_times, clamped

if TYPE_CHECKING:
    from armsight.robot.kinematics.arm import Arm

ROUNDS = 12  # rounds of scaling a law until its limits hold; from rest the second is exact up to where samples fall
#: Relative distance from its limit to which the fastest joint is brought; smaller: faster motions, more rounds.
CLOSE = 1e-3
#: Proportions of speed, acceleration and jerk, of what the joints could do at most, that are tried for a motion from rest.
SHAPES = tuple(product((1.0, 0.7, 0.5, 0.3), (1.0, 0.6, 0.3), (1.0, 0.5, 0.2)))
INSTANTS = 200  # instants at which each of these proportions is evaluated
#: From a moving start every proportion is tried at these time scales too: below 1 is slower.
SCALES = (1.03, 1.0, 0.97, 0.93, 0.87, 0.8, 0.7, 0.6, 0.5, 0.4)
TRIED = 20  # at most so many laws from a moving start, the shortest first, are checked at 1 kHz by inverse kinematics
#: Where none of these keeps the limits: speeds, as shares of what the joints could do at most, that are tried.
SPEEDS = np.array([4.0, 1.0, 0.7, 0.5, 0.3])
#: Accelerations, as shares likewise, that are tried with each of these speeds.
ACCELERATIONS = np.array([4.0, 1.0, 0.6, 0.3])
#: Relative amount by which the start's own speed and acceleration are widened before they are tried as limits.
ALIKE = 1e-7
#: Powers of one factor by which speed, acceleration and jerk are raised: the jerk alone, or all three as time is scaled.
JERK_ONLY, ALL_LIMITS = np.array([0.0, 0.0, 1.0]), np.array([1.0, 2.0, 3.0])
HARDEST = 2.0  # the largest such factor that is tried
#: Halvings of the interval from 0 to :data:`HARDEST` in which the largest factor that keeps the limits is found.
HARDER = 14
#: Relative error of the walk's derivatives between its points: how far within the limits a law must stay there.
HAIR = 2e-4
FIRST_S = 5e-3  # how long a start's own state, which may be at a limit, may last, s
EVERY = 2  # a moving start's laws are evaluated at every so many-th instant of the later check at 1 kHz
HALVINGS = 40  # halvings of a duration that find when a share is reached
CHAIN_ROUNDS = 40  # rounds in which the parts of a chain are slowed down
GENTLER = 0.9  # factor by which a bend's speed is reduced when the straight part beside it is too short
#: How far within the limits, relative, a chain from a moving start stays: its duration cannot be scaled afterwards.
MARGIN = 0.01
TOUCHING = 1e-6  # bends nearer to each other than this share of the way are passed as one


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
    """One jerk-limited rise of the share."""

    start: Joints  #: (1,) the share to start from, its speed and acceleration
    limits: Array  #: (3,) of the share's speed, acceleration and jerk
    profile: Profile  #: the share over time

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
        time_scale = worst(arm, t_s, along(guide, law, t_s)).time_scale
        if 1 - CLOSE <= time_scale <= 1:
            break
        law = law.slower(time_scale / (1 - CLOSE / 2))
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
    """Return whether a law from a moving start keeps the limits by the walk's derivatives.

    They are known to :data:`HAIR` there, so the joints must stay that far within the limits, but for the first instants:
    the start may be at a limit, and is looked at exactly afterwards.
    """
    t_s = np.linspace(0, law.duration_s, max(2, int(np.ceil(law.duration_s * CHECK_RATE_HZ / EVERY))))
    needed = time_scales(arm, t_s, along(guide, law, t_s))
    return bool((needed <= np.where(t_s < FIRST_S, 1 + HAIR, 1 - HAIR)).all())


def slower(limits: Array, k: float) -> Array:
    """Return limits (3,) of speed, acceleration and jerk under which a motion from rest takes ``k`` times as long."""
    return np.asarray(limits / np.array([k, k**2, k**3]))


def single_law(start: Joints, limits: Array, duration_s: float | None = None) -> SingleLaw:
    """Return the share over time under limits (3,) of its speed, acceleration and jerk.

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
    """Return the joints (N, n) at times (N,), between the points of the walk by interpolation; angles are left at 0."""
    share, speed, acceleration = (part[:, :1] for part in law.at(t_s))
    q1, q2 = (columns(share[:, 0], guide.share, part) for part in (guide.q1, guide.q2))
    return Joints(np.zeros_like(q1), q1 * speed, q1 * acceleration + q2 * speed**2)


def _tried(arm: Arm, guide: Walk, start: Joints, limits: Array) -> tuple[float, Array]:
    """Return how long a motion from rest takes once it is slow enough, s, and its limits."""
    law = single_law(start, limits)
    t_s = np.linspace(0, law.duration_s, INSTANTS)
    time_scale = worst(arm, t_s, along(guide, law, t_s)).time_scale
    return law.duration_s * time_scale, slower(limits, time_scale)


@dataclass(frozen=True, eq=False)
class ChainLaw:
    """Profiles of the share of the way, one after another."""

    parts: tuple[Profile, ...]  #: the profiles
    time_scale: float = 1.0  #: how many times slower they are run; 1 as planned

    @property
    def duration_s(self) -> float:
        """How long the motion takes, s."""
        return self.time_scale * sum(part.duration_s for part in self.parts)

    def at(self, t_s: float | Array) -> Joints:
        """Return the share, its speed and its acceleration, (1,) or (N, 1), ``t_s`` seconds after the start."""
        times = clamped(t_s, self.duration_s) / self.time_scale
        begins = np.cumsum([0.0, *(part.duration_s for part in self.parts[:-1])])
        which = np.searchsorted(begins[1:], times, side="right")
        out = np.empty((3, *times.shape, 1))
        for i, part in enumerate(self.parts):
            if (here := which == i).any():
                out[:, here] = np.array(part.at(times[here] - begins[i]))
        return Joints(out[0], out[1] / self.time_scale, out[2] / self.time_scale**2)

    def slower(self, k: float) -> ChainLaw:
        """Return the law of the same motion from rest, ``k`` times as long."""
        return replace(self, time_scale=self.time_scale * k)


class _Plan(NamedTuple):
    """What a chain is made from."""

    edges: Array  #: (2 G + 2,) shares at which parts begin and end: straight, bend, straight, ..., straight
    limits: Array  #: (G + 1, 3) of the straight parts
    speeds: Array  #: (G,) of the bends


def fit_chain(arm: Arm, guide: Walk, start: Joints, cruises: Array) -> Law:
    """Return the share over time that just keeps the limits by the walk's derivatives.

    Args:
        arm: the arm, for its limits.
        guide: the joints along the way.
        start: (1,) the share to start from, its speed and acceleration.
        cruises: (C, 2) shares between which the bends lie.

    Raises:
        InputError: a moving start cannot reach the pace of the first bend.
    """
    moving = bool(start.qd.any() or start.qdd.any())
    within = 1 - (MARGIN if moving else CLOSE / 2)
    most = _first(arm, guide, cruises)
    plan = most._replace(limits=most.limits.copy(), speeds=most.speeds.copy())
    for _ in range(CHAIN_ROUNDS):
        plan, chain = _built(plan)
        t_s = check_times(chain.duration_s)
        needed = time_scales(arm, t_s, along(guide, chain, t_s))
        if needed.max() <= within:
            break
        part = np.searchsorted(plan.edges[1:-1], chain.at(t_s).q[:, 0])
        for i in range(len(plan.edges) - 1):
            slow = float(needed[part == i].max(initial=0.0)) / (within - CLOSE / 2)
            if slow > 1 and i % 2:
                plan.speeds[i // 2] /= slow
            elif slow > 1:
                plan.limits[i // 2] = slower(plan.limits[i // 2], slow)
    if moving:
        return replace(chain, parts=(_taken_up(arm, guide, start, plan, most.limits[0]), *chain.parts[1:]))
    return chain.slower(max(1.0, float(needed.max())))


def _taken_up(arm: Arm, guide: Walk, start: Joints, plan: _Plan, most: Array) -> Profile:
    """Return the shortest first part, of many tried, that leads from a moving start into the first bend; or InputError."""
    best = None
    for shape, scale in product(SHAPES, SCALES):
        part = _straight(start, plan.edges[:2], slower(most * shape, 1 / scale), plan.speeds[:1])
        if part is None or (best is not None and part.duration_s >= best.duration_s):
            continue
        if keeps(arm, guide, part):
            best = part
    if best is None:
        raise InputError(
            "from this moving start the tool cannot reach the pace of the first bend within the arm's limits"
        )
    return best


def _first(arm: Arm, guide: Walk, cruises: Array) -> _Plan:
    """Return what the joints could do at most on each part, bends that touch taken together."""
    bends: list[list[float]] = []
    for begin, end in cruises.tolist():
        if bends and begin - bends[-1][1] < TOUCHING:
            bends[-1][1] = end
        else:
            bends.append([begin, end])
    edges = np.array([0.0, *(edge for bend in bends for edge in bend), 1.0])
    limits, speeds = [], []
    for i, (begin, end) in enumerate(pairwise(edges.tolist())):
        # The points of the walk on this part, the next ones outside it included; the last where it ends before.
        first = max(int(np.searchsorted(guide.share, begin, side="right")) - 1, 0)
        rows = slice(first, int(np.searchsorted(guide.share, end)) + 1)
        found = bounds(arm, Walk(*(part[rows] for part in guide)))
        if i % 2:
            speeds.append(found[0])
        else:
            limits.append(found)
    return _Plan(edges, np.array(limits), np.array(speeds))


def _built(plan: _Plan) -> tuple[_Plan, ChainLaw]:
    """Return a plan whose bends are slow enough for the parts beside them, and its chain from rest."""
    speeds = np.minimum(plan.speeds, np.minimum(plan.limits[:-1, 0], plan.limits[1:, 0]))
    while True:
        parts, short = _parts(plan._replace(speeds=speeds))
        if short is None:
            return plan._replace(speeds=speeds), ChainLaw(tuple(parts))
        before, after = np.concatenate([[0.0], speeds, [0.0]])[short : short + 2]
        speeds[short if after > before else short - 1] *= GENTLER


def _parts(plan: _Plan) -> tuple[list[Profile], int | None]:
    """Return the profiles of a plan, and which straight part is too short for the speeds at its ends; None for none."""
    parts: list[Profile] = []
    none = np.zeros(1)
    state = Joints(none, none, none)
    for i, limits in enumerate(plan.limits):
        speed = plan.speeds[i : i + 1] if i < len(plan.speeds) else none
        part = _straight(state, plan.edges[2 * i : 2 * i + 2], limits, speed)
        if part is None:
            return parts, i
        parts.append(part)
        if i < len(plan.speeds):
            end, after = plan.edges[2 * i + 1 : 2 * i + 2], plan.edges[2 * i + 2 : 2 * i + 3]
            bound = (speed, limits[1:2], limits[2:])
            parts.append(plan_profile(Joints(end, speed, none), after, *bound, goal_speed=speed))
            state = Joints(after, speed, none)
    return parts, None


def _straight(state: Joints, edges: Array, limits: Array, speed: Array) -> Profile | None:
    """Return the profile of a straight part between edges (2,), arriving with a speed (1,); None where it is too short."""
    part = plan_profile(state, edges[1:], np.maximum(limits[:1], speed), limits[1:2], limits[2:], goal_speed=speed)
    low, high = part.extrema(0)
    return None if low < edges[0] - ROUNDING or high > edges[1] + ROUNDING else part
