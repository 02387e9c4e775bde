"""Optimal choice of the next poses to measure, and the predicted position error after each.

In: the model with its priors, what was measured already, and which poses the cameras see. Out: a :class:`Plan`.

The criterion is I-optimality: the mean variance of predicted tool positions over the workspace, to first order in the
parameters' covariance. A pose adds the information J^T C^-1 J, with the covariance C of the instrument there. A greedy
choice among random candidates that can be reached and seen is improved by coordinate exchange (Meyer and Nachtsheim,
Technometrics 37, 1995): every joint of every pose, one after the other, goes to the best of some levels, as long as that
lowers the criterion.

The file in order: the choice itself, on whitened Jacobians alone; the plan for an arm; the poses that are allowed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Record
from armsight.errors import InputError
from armsight.estimate.solve import whitened
from armsight.loop.identify.fit import SIGMA, Mask, linear_of, variances_of
from armsight.loop.identify.joint_noise import by_joints
from armsight.loop.identify.measured import Measured
from armsight.loop.identify.model import FAST, RIPPLES, Model, all_features
from armsight.loop.identify.observable import observed
from armsight.loop.identify.selection import SCALED

#: Candidates compared at once: bounds the memory.
_BATCH = 250
#: Levels that a joint is tried at, from both sides; most sweeps over all poses; least relative gain of a sweep to go on.
LEVELS, SWEEPS, MIN_GAIN = 7, 3, 0.01

#: Returns the whitened Jacobians (N, M, F) of poses q (N, J) approached from sides (N, J), and which of them are allowed.
#: Those of poses that are not allowed do not count, except the first.
Information = Callable[[Array, Array], tuple[Array, Mask]]


def greedy(J: Array, P: Array, requested: Array, n: int, *, in_order: bool = False) -> tuple[Array, Array]:
    """Return rows chosen one by one, and the predicted RMS position error before and after each.

    Args:
        J: (N, M, F) whitened Jacobians of the candidates.
        P: (F, F) covariance before.
        requested: (3 K, F) derivative of K positions, whose error is to be low.
        n: how many to choose.
        in_order: take them as they come instead.
    """
    P = P.copy()
    left = np.ones(len(J), bool)
    chosen: list[int] = []
    W = requested.T @ requested
    sigma = [rms(P, W, len(requested))]
    for k in range(n):
        if in_order:
            best = k
        else:
            rows = np.flatnonzero(left)
            best = int(rows[np.argmax(gains(J[rows], P, W))])
        G = P @ J[best].T
        S = np.eye(J.shape[1]) + J[best] @ G
        P = P - G @ np.linalg.solve(S, G.T)
        P = (P + P.T) / 2
        left[best] = False
        chosen.append(best)
        sigma.append(rms(P, W, len(requested)))
    return np.array(chosen), np.array(sigma)


def rms(P: Array, W: Array, numbers: int) -> float:
    """Return the RMS length of the error of positions whose derivatives' squares sum to W, three numbers each."""
    return float(np.sqrt(3 * np.einsum("ij,ji->", W, P) / numbers))


def gains(J: Array, P: Array, W: Array) -> Array:
    """Return by how much each pose lowers trace(W P): trace(S^-1 J P W P J^T)."""
    PWP = P @ W @ P
    out = np.empty(len(J))
    for at in range(0, len(J), _BATCH):
        part = J[at : at + _BATCH]
        S = np.eye(J.shape[1]) + part @ P @ part.swapaxes(1, 2)
        out[at : at + _BATCH] = np.einsum("nii->n", np.linalg.solve(S, part @ PWP @ part.swapaxes(1, 2)))
    return out


def exchanged(
    q: Array,
    approach: Array,
    information: Information,
    P: Array,
    requested: Array,
    limits: tuple[Array, Array],
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """Return poses (n, J) and sides (n, J) that together lower the error more than those given.

    Args:
        q: (n, J) joint angles to start from, rad.
        approach: (n, J) sides.
        information: of poses, and which are allowed.
        P: (F, F) covariance before.
        requested: (3 K, F) derivative of K positions, whose error is to be low.
        limits: (6,) and (6,) least and greatest angles, rad.
        rng: sets the levels, and the order of the joints.
    """
    q, approach, W = q.copy(), approach.copy(), requested.T @ requested
    J, _ = information(q, approach)
    H = np.linalg.inv(P) + np.einsum("nki,nkj->ij", J, J)
    reached = rms(np.linalg.inv(H), W, len(requested))
    for _ in range(SWEEPS):
        for k in range(len(q)):
            others = H - J[k].T @ J[k]
            q[k], approach[k], J[k] = _best(q[k], approach[k], information, np.linalg.inv(others), W, limits, rng)
            H = others + J[k].T @ J[k]
        before, reached = reached, rms(np.linalg.inv(H), W, len(requested))
        if reached > (1 - MIN_GAIN) * before:
            break
    return q, approach


def _best(
    q: Array,
    approach: Array,
    information: Information,
    P: Array,
    W: Array,
    limits: tuple[Array, Array],
    rng: np.random.Generator,
) -> tuple[Array, Array, Array]:
    """Return the best pose that changes of one joint after the other lead to, its sides, and its Jacobian."""
    low, high = limits
    for joint in rng.permutation(len(q)):
        step = (high[joint] - low[joint]) / (LEVELS - 1)
        levels = np.clip(low[joint] + step * (np.arange(LEVELS) + rng.uniform(-0.5, 0.5)), low[joint], high[joint])
        tried, sides = np.tile(q, (2 * LEVELS + 1, 1)), np.tile(approach, (2 * LEVELS + 1, 1))
        tried[1:, joint] = np.tile(levels, 2)
        sides[1 + LEVELS :, joint] *= -1
        J, allowed = information(tried, sides)
        allowed[0] = True  # the pose as it was: it stays where nothing is better
        best = int(np.argmax(np.where(allowed, gains(J, P, W), -np.inf)))
        q, approach, kept = tried[best], sides[best], J[best]
    return q, approach, kept


#: Candidates sampled, and positions of the workspace at which the error is predicted.
CANDIDATES, PROBES = 800, 200
#: Most rounds of sampling four times as many, of which those allowed become candidates.
SAMPLING_ROUNDS = 40
#: Links must stay this far above the base's plane, m, and parts of the arm that are not neighbours this far apart.
FLOOR_M, APART_M = 0.02, 0.06
#: Prior sigma of base and tool, m and rad, which have none in a fit.
UNKNOWN = 0.1
#: Poses keep this far from the joints' limits, rad: a joint must have room to come from either side.
ROOM_RAD = 0.03
#: A prior sigma of an error source says how large it may be (a data sheet's limit); it mostly is this part of it.
TYPICAL_SHARE = 1 / 3
#: Joints scatter by about this much from pose to pose, rad (0.1 mm at 1 m): friction, a sensor's noise. Without it an
#: instrument of 0.03 mm would seem to learn everything from a few poses.
CHANCE_RAD = 1e-4


@dataclass(frozen=True, eq=False)
class Plan(Record):
    """The poses to measure next, best first.

    Attributes:
        q: (n, J) joint angles, rad.
        approach: (n, J) from which side to come to each.
        sigma_m: (n + 1,) predicted RMS position error over the workspace, m, before and after each pose.
        random_sigma_m: (n + 1,) the same for random poses.
    """

    q: Array
    approach: Array
    sigma_m: Array
    random_sigma_m: Array

    def random_for(self, n: int) -> int | None:
        """Return how many random poses reach the error of the first ``n`` planned ones; None: more than were sampled."""
        reached = np.flatnonzero(self.random_sigma_m <= self.sigma_m[n])
        return int(reached[0]) if len(reached) else None


def plan_poses(
    model: Model,
    x: Array,
    prior: Array,
    noise: tuple[float, float],
    n: int,
    *,
    done: Measured | None = None,
    visible: Callable[[Array], NDArray[np.bool_]] = lambda T_rig_body: np.ones(len(T_rig_body), bool),
    cov: Callable[[Array], Array] | None = None,
    floor_m: float = FLOOR_M,
    seed: int = 0,
) -> Plan:
    """Choose the poses that lower the position error most.

    Args:
        model: the arm with every parameter.
        x: (P,) the vector, with base and tool known at least roughly.
        prior: (P,) prior sigmas, as of a fit.
        noise: sigmas of position, m, and rotation, rad, of the instrument, where ``cov`` is None.
        n: how many poses.
        done: what was measured already.
        visible: returns which poses T_rig_body (N, 4, 4) the cameras can see.
        cov: returns the covariance (N, M, M) of the measurement of poses T_rig_body (N, 4, 4).
        floor_m: how far above the base's plane the links must stay, m.
        seed: of the candidates.

    Raises:
        InputError: fewer candidates than ``n`` can be reached and seen.
    """
    rng = np.random.default_rng(seed)
    model, x, prior = _with_curves(model, x, prior)
    scene = PlanningScene(model, x, noise, visible, cov, floor_m)
    q, approach, seen = _candidates(scene, rng)
    if len(q) < n:
        raise InputError(f"only {len(q)} poses that can be reached and seen were found; {n} were asked for")
    prior = np.where([p.kind in SCALED for p in model.parameters], TYPICAL_SHARE * prior, prior)
    free = observed(model, x, seen, prior, noise).possible
    P = _prior_covariance(prior, free)
    if done is not None:
        Jd = scene.whitened(done)[:, :, free].reshape(-1, int(free.sum()))
        P = np.asarray(np.linalg.inv(np.linalg.inv(P) + Jd.T @ Jd))
    J = scene.whitened(seen)[:, :, free]
    requested = _position_derivative(model, x, seen, free, rng)

    def information(q: Array, approach: Array) -> tuple[Array, Mask]:
        return scene.information(q, approach, free)

    chosen, _ = greedy(J, P, requested, n)
    better, sides = exchanged(q[chosen], approach[chosen], information, P, requested, scene.limits, rng)
    order, sigma = greedy(information(better, sides)[0], P, requested, n)
    _, random_sigma = greedy(J[rng.permutation(len(J))[: 4 * n]], P, requested, min(4 * n, len(J)), in_order=True)
    return Plan(better[order], sides[order], sigma, random_sigma)


class PlanningScene(NamedTuple):
    """The measurements that poses would give, and which poses are allowed.

    Attributes:
        model: the arm with every parameter.
        x: (P,) the vector.
        noise: sigmas of position, m, and rotation, rad, beyond ``cov``.
        visible: returns which poses T_rig_body (N, 4, 4) the cameras can see.
        cov: returns the covariance (N, M, M) of their measurement; None: ``noise`` is all.
        floor_m: how far above the base's plane the links must stay, m.
    """

    model: Model
    x: Array
    noise: tuple[float, float]
    visible: Callable[[Array], NDArray[np.bool_]]
    cov: Callable[[Array], Array] | None
    floor_m: float

    @property
    def limits(self) -> tuple[Array, Array]:
        """Return least and greatest joint angles (6,), rad, of a plan."""
        arm = self.model.arm
        return np.maximum(arm.q_min + ROOM_RAD, -np.pi), np.minimum(arm.q_max - ROOM_RAD, np.pi)

    def T_rig_body(self, q: Array, approach: Array) -> Array:
        """Return the body (N, 4, 4) in the rig."""
        return np.asarray(self.model.T_rig_base(self.x) @ self.model.tool_in_base(self.x, q, approach))

    def allowed(self, q: Array, approach: Array) -> Mask:
        """Return which poses (N,) are free of collision and visible."""
        out = self.visible(self.T_rig_body(q, approach))
        out[out] = free_of_collision(self.model, q[out], self.floor_m)
        return out

    def seen(self, q: Array, approach: Array) -> Measured:
        """Return the measurements of poses without noise."""
        model, T = self.model, self.T_rig_body(q, approach)
        m = model.motion(self.x, q, model.feature_values(q, approach))
        p = m.o[:, None] + (m.R @ model.tool_points(self.x).T).swapaxes(1, 2)
        return Measured(q, p, T[:, :3, :3] if model.full else None, None if self.cov is None else self.cov(T), approach)

    def information(self, q: Array, approach: Array, free: Mask) -> tuple[Array, Mask]:
        """Return whitened Jacobians (N, M, F) by the free parameters, and which poses (N,) are allowed.

        Poses that are not allowed have zeros (behind a camera there is no covariance). The first is the pose as it was, and
        always has its Jacobian.
        """
        allowed = self.allowed(q, approach)
        rows = np.flatnonzero(allowed | (np.arange(len(q)) == 0))
        part = self.whitened(self.seen(q[rows], approach[rows]))[:, :, free]
        J = np.zeros((len(q), *part.shape[1:]))
        J[rows] = part
        return J, allowed

    def whitened(self, measured: Measured) -> Array:
        """Return the whitened Jacobians (N, M, P)."""
        phi = self.model.feature_values(measured.q, measured.approach)
        everything = np.ones(len(self.x), bool)
        linear = linear_of(self.model, self.x, measured, phi, everything, np.full(len(self.x), np.inf))
        variances = np.append(variances_of(linear, self.noise), CHANCE_RAD**2)
        return whitened(replace(linear, own=linear.own | {"joints": by_joints(self.model, linear.J)}), variances)[1]


def _candidates(scene: PlanningScene, rng: np.random.Generator) -> tuple[Array, Array, Measured]:
    """Return joint angles, directions of approach and measurements of poses that are reachable, free and visible.

    They are uniform over all such joint angles; where cameras see little of what an arm reaches, more are sampled.
    """
    angles, sides, found = [], [], 0
    for _ in range(SAMPLING_ROUNDS):
        q = rng.uniform(*scene.limits, (4 * CANDIDATES, len(scene.limits[0])))
        approach = rng.choice([-1.0, 1.0], q.shape)
        rows = np.flatnonzero(scene.allowed(q, approach))[: CANDIDATES - found]
        angles.append(q[rows])
        sides.append(approach[rows])
        found += len(rows)
        if found == CANDIDATES:
            break
    q, approach = np.concatenate(angles), np.concatenate(sides)
    return q, approach, scene.seen(q, approach)


def free_of_collision(model: Model, q: Array, floor_m: float = FLOOR_M) -> Mask:
    """Return which joint angles (N, J) keep the arm above the base's plane and apart from itself.

    Links are the straight lines between the axes' frames; the first two and neighbours are not compared.
    """
    if not len(q):
        return np.zeros(0, bool)
    o = np.stack([model.arm.links(angles)[:, :3, 3] for angles in q])
    along = (o - model.arm.T_base_0[:3, 3]) @ model.up_base
    out = np.asarray((along[:, 2:] > floor_m).all(axis=1))
    out[out] = _segments_apart(o[out])
    return out


def _segments_apart(o: Array) -> Mask:
    """Return whether the base's column and the links (N, J + 2, 3) from the elbow on stay apart, at steps along them."""
    steps = np.linspace(0, 1, 9)[:, None]

    def line(i: int, points: Array) -> Array:
        return np.asarray(o[:, i, None] + points * (o[:, i + 1] - o[:, i])[:, None])

    out = np.ones(len(o), bool)
    for other in (line(0, steps), line(1, steps[:5])):
        for i in range(3, o.shape[1] - 1):
            between = line(i, steps)[:, :, None] - other[:, None]
            out &= (np.einsum("nabk,nabk->nab", between, between) > APART_M**2).all(axis=(1, 2))
    return out


def _with_curves(model: Model, x: Array, prior: Array) -> tuple[Model, Array, Array]:
    """Return a model, its vector and its priors with every harmonic of the sensors' curves.

    Few poses cannot select among them, but a curve stays unknown where it is not measured, so poses must be spread.
    """
    backlash = any(f.kind == "backlash" for f in model.features)
    whole = model.with_features(all_features(model.arm.joints, backlash, (*RIPPLES, *FAST)))
    known = dict(zip(model.names, zip(x, prior, strict=True), strict=True))
    both = np.array([known.get(p.name, (0.0, SIGMA[p.kind])) for p in whole.parameters])
    return whole, both[:, 0], both[:, 1]


def _prior_covariance(prior: Array, free: Mask) -> Array:
    sigma = np.where(np.isfinite(prior), prior, UNKNOWN)[free]
    return np.asarray(np.diag(sigma**2))


def _position_derivative(model: Model, x: Array, seen: Measured, free: Mask, rng: np.random.Generator) -> Array:
    """Return the derivative (PROBES * 3, F) of positions in the rig at poses over the workspace."""
    rows = rng.choice(len(seen), min(PROBES, len(seen)), replace=False)
    part = seen.rows(rows)
    _, J = model.linearised(x, part, model.feature_values(part.q, part.approach))
    return J[:, :3, free].reshape(-1, int(free.sum()))
