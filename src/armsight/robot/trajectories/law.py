"""How fast a path is travelled: the share of its way over time, jerk-limited, as fast as the joints allow.

In: an arm's limits and the joints along a path (:class:`~armsight.robot.trajectories.lookahead.Walk`). Out: a
:class:`Law`, the share of the way (0 to 1), its speed and its acceleration over time.

The share moves under limits of its own speed, acceleration and jerk. Several proportions of these are tried, and each is
run slower until the fastest joint, by speed, acceleration or jerk, is just at its limit: that is exact, as the whole motion
from rest then is the same one.

A path with bends is travelled faster on its straight parts and at a steady pace through each bend (:class:`Law`).
Every straight part has limits of its own for the share's speed, acceleration and jerk, every bend a speed. They begin at
what the joints could do at most; whichever part brings a joint over a limit is slowed down, and a bend also where the
straight part beside it is too short to brake or to gain speed, until all limits hold.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise, product
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from armsight.data import Array
from armsight.robot.trajectories.limits import ROUNDING, time_scales, worst
from armsight.robot.trajectories.lookahead import HALVINGS, Walk, columns
from armsight.robot.trajectories.profile import Profile, plan_profile
from armsight.robot.trajectories.trajectory import Joints, check_times, clamped

if TYPE_CHECKING:
    from armsight.robot.kinematics.arm import Arm

ROUNDS = 12  # rounds of scaling a law until its limits hold; the second is exact up to where samples fall
#: Relative distance from its limit to which the fastest joint is brought; smaller: faster motions, more rounds.
CLOSE = 1e-3
#: Proportions of speed, acceleration and jerk, of what the joints could do at most, that are tried.
SHAPES = tuple(product((1.0, 0.7, 0.5, 0.3), (1.0, 0.6, 0.3), (1.0, 0.5, 0.2)))
INSTANTS = 200  # instants at which each of these proportions is evaluated
CHAIN_ROUNDS = 40  # rounds in which the parts of a chain are slowed down
GENTLER = 0.9  # factor by which a bend's speed is reduced when the straight part beside it is too short
TOUCHING = 1e-6  # bends nearer to each other than this share of the way are passed as one

_REST = Joints(np.zeros(1), np.zeros(1), np.zeros(1))  # at the begin of the way


@dataclass(frozen=True, eq=False)
class Law:
    """The share of the way over time: jerk-limited profiles of it, one after another."""

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

    def slower(self, k: float) -> Law:
        """Return the law of the same motion from rest, ``k`` times as long."""
        return replace(self, time_scale=self.time_scale * k)


def fit_law(arm: Arm, guide: Walk) -> Law:
    """Return the share over time, from rest, that just keeps the limits by the walk's derivatives."""
    most = bounds(arm, guide)
    law = min((_tried(arm, guide, most * shape) for shape in SHAPES), key=lambda tried: tried.duration_s)
    for _ in range(ROUNDS):
        t_s = check_times(law.duration_s)
        time_scale = worst(arm, t_s, along(guide, law, t_s)).time_scale
        if 1 - CLOSE <= time_scale <= 1:
            break
        law = law.slower(time_scale / (1 - CLOSE / 2))
    return law


def slower(limits: Array, k: float) -> Array:
    """Return limits (3,) of speed, acceleration and jerk under which a motion from rest takes ``k`` times as long."""
    return np.asarray(limits / np.array([k, k**2, k**3]))


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


def along(guide: Walk, law: Law, t_s: Array) -> Joints:
    """Return the joints (N, n) at times (N,), between the points of the walk by interpolation; angles are left at 0."""
    share, speed, acceleration = (part[:, :1] for part in law.at(t_s))
    q1, q2 = (columns(share[:, 0], guide.share, part) for part in (guide.q1, guide.q2))
    return Joints(np.zeros_like(q1), q1 * speed, q1 * acceleration + q2 * speed**2)


def _tried(arm: Arm, guide: Walk, limits: Array) -> Law:
    """Return the law under limits (3,) of the share's speed, acceleration and jerk, made so slow that the joints' hold."""
    law = Law((plan_profile(_REST, np.ones(1), limits[:1], limits[1:2], limits[2:]),))
    t_s = np.linspace(0, law.duration_s, INSTANTS)
    return law.slower(worst(arm, t_s, along(guide, law, t_s)).time_scale)


class _Plan(NamedTuple):
    """What a chain is made from."""

    edges: Array  #: (2 G + 2,) shares at which parts begin and end: straight, bend, straight, ..., straight
    limits: Array  #: (G + 1, 3) of the straight parts
    speeds: Array  #: (G,) of the bends


def fit_chain(arm: Arm, guide: Walk, cruises: Array) -> Law:
    """Return the share over time, from rest, that just keeps the limits by the walk's derivatives.

    ``guide``: the joints along the way; ``cruises``: (C, 2) shares between which the bends lie.
    """
    within, plan = 1 - CLOSE / 2, _first(arm, guide, cruises)
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
    return chain.slower(max(1.0, float(needed.max())))


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


def _built(plan: _Plan) -> tuple[_Plan, Law]:
    """Return a plan whose bends are slow enough for the parts beside them, and its chain from rest."""
    speeds = np.minimum(plan.speeds, np.minimum(plan.limits[:-1, 0], plan.limits[1:, 0]))
    while True:
        parts, short = _parts(plan._replace(speeds=speeds))
        if short is None:
            return plan._replace(speeds=speeds), Law(tuple(parts))
        before, after = np.concatenate([[0.0], speeds, [0.0]])[short : short + 2]
        speeds[short if after > before else short - 1] *= GENTLER


def _parts(plan: _Plan) -> tuple[list[Profile], int | None]:
    """Return the profiles of a plan, and which straight part is too short for the speeds at its ends; None for none."""
    parts: list[Profile] = []
    none, state = np.zeros(1), _REST
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
