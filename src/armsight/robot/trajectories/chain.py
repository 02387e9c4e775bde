"""How fast a path with bends is travelled: faster on its straight parts, at a steady pace through each bend.

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
from armsight.errors import InputError
from armsight.robot.trajectories.law import CLOSE, SCALES, SHAPES, Law, along, bounds, keeps, slower
from armsight.robot.trajectories.limits import ROUNDING, stretches
from armsight.robot.trajectories.lookahead import Walk
from armsight.robot.trajectories.profile import Profile, plan_profile
from armsight.robot.trajectories.trajectory import Joints, check_times, clamped

if TYPE_CHECKING:
    from armsight.robot.arm import Arm

#: Rounds of slowing parts down, and by how much a bend is slowed whose neighbour is too short.
ROUNDS, GENTLER = 40, 0.9
#: How far within the limits a chain stays by the walk's derivatives where it cannot be stretched: from a moving start.
MARGIN = 0.01
#: Bends nearer to each other than this share of the way are passed as one.
TOUCHING = 1e-6


@dataclass(frozen=True, eq=False)
class Chain:
    """Profiles of the share of the way, one after another.

    Attributes:
        parts: the profiles.
        stretch: how many times slower they are run.
    """

    parts: tuple[Profile, ...]
    stretch: float = 1.0

    @property
    def duration_s(self) -> float:
        """How long the motion takes, s."""
        return self.stretch * sum(part.duration_s for part in self.parts)

    def at(self, t_s: float | Array) -> Joints:
        """Return the share, its speed and its acceleration, (1,) or (N, 1), ``t_s`` seconds after the start."""
        times = clamped(t_s, self.duration_s) / self.stretch
        begins = np.cumsum([0.0, *(part.duration_s for part in self.parts[:-1])])
        which = np.searchsorted(begins[1:], times, side="right")
        out = np.empty((3, *times.shape, 1))
        for i, part in enumerate(self.parts):
            if (here := which == i).any():
                out[:, here] = np.array(part.at(times[here] - begins[i]))
        return Joints(out[0], out[1] / self.stretch, out[2] / self.stretch**2)

    def slower(self, k: float) -> Chain:
        """Return the law of the same motion from rest, ``k`` times as long."""
        return replace(self, stretch=self.stretch * k)


class _Plan(NamedTuple):
    """What a chain is made from.

    Attributes:
        edges: (2 G + 2,) shares at which parts begin and end: straight, bend, straight, ..., straight.
        limits: (G + 1, 3) of the straight parts.
        speeds: (G,) of the bends.
    """

    edges: Array
    limits: Array
    speeds: Array


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
    for _ in range(ROUNDS):
        plan, chain = _built(plan)
        t_s = check_times(chain.duration_s)
        needed = stretches(arm, t_s, along(guide, chain, t_s))
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
    """Return the shortest first part, of many tried, that leads from a moving start into the first bend.

    Raises:
        InputError: none of those tried keeps the limits.
    """
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
        # The places of the walk on this part, the next ones outside it included; the last where it ends before.
        first = max(int(np.searchsorted(guide.share, begin, side="right")) - 1, 0)
        rows = slice(first, int(np.searchsorted(guide.share, end)) + 1)
        found = bounds(arm, Walk(*(part[rows] for part in guide)))
        if i % 2:
            speeds.append(found[0])
        else:
            limits.append(found)
    return _Plan(edges, np.array(limits), np.array(speeds))


def _built(plan: _Plan) -> tuple[_Plan, Chain]:
    """Return a plan whose bends are slow enough for the parts beside them, and its chain from rest."""
    speeds = np.minimum(plan.speeds, np.minimum(plan.limits[:-1, 0], plan.limits[1:, 0]))
    while True:
        parts, short = _parts(plan._replace(speeds=speeds))
        if short is None:
            return plan._replace(speeds=speeds), Chain(tuple(parts))
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
