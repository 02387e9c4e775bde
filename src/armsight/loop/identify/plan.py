"""Where to look next: the poses that tell most about an arm, and what so many more of them buy.

Greedy choice among candidates that can be reached and seen, then exchange joint by joint (``design``): poses that lower
most the predicted position error over the workspace (the trace of what the parameters' covariance does there, I-optimal, to
first order; the noise amplification of what is wanted, not of numbers that nobody asks for). A pose brings the information
J^T C^-1 J with the vision's covariance C there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Record
from armsight.errors import InputError
from armsight.loop.identify.design import exchanged, greedy
from armsight.loop.identify.evidence import SCALED
from armsight.loop.identify.features import FAST, RIPPLES, all_features
from armsight.loop.identify.fit import Mask, noise_cov
from armsight.loop.identify.joint_noise import by_joints
from armsight.loop.identify.measured import Measured
from armsight.loop.identify.model import Model
from armsight.loop.identify.observable import observed
from armsight.loop.identify.priors import SIGMA

#: Candidates drawn, and places of the workspace at which the error is predicted.
CANDIDATES, PROBES = 800, 200
#: Times that four times as many are drawn at most, of which those allowed become candidates.
DRAWS = 40
#: Links must stay this far above the base's plane, m, and parts of the arm that are not neighbours this far apart.
FLOOR_M, APART_M = 0.02, 0.06
#: What nothing is known of at first: base and tool, m and rad.
UNKNOWN = 0.1
#: Poses keep this far from the joints' limits, rad: a joint must have room to come from either side.
ROOM_RAD = 0.03
#: A prior sigma of a cause says how large it may be (a data sheet's limit); it mostly is this part of it.
MOSTLY = 1 / 3
#: Joints are off by chance by about this much from pose to pose, rad (0.1 mm at 1 m): friction, a sensor's noise. Else an
#: instrument of 0.03 mm would have a few poses tell everything.
CHANCE_RAD = 1e-4


@dataclass(frozen=True, eq=False)
class Plan(Record):
    """The poses to look at next, best first.

    Attributes:
        q: (n, 6) joint angles, rad.
        approach: (n, 6) from which side to come to each.
        sigma_m: (n + 1,) predicted RMS position error over the workspace, m, before and after each pose.
        random_sigma_m: (n + 1,) the same for poses drawn at random.
    """

    q: Array
    approach: Array
    sigma_m: Array
    random_sigma_m: Array

    def random_for(self, n: int) -> int | None:
        """Return how many random poses come as far as the first ``n`` planned ones; None: more than were drawn."""
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
    """Choose the poses that tell most.

    Args:
        model: the arm with every parameter.
        x: (P,) where its base and tool are, at least roughly.
        prior: (P,) prior sigmas, as of a fit.
        noise: sigmas of place, m, and turn, rad, of the instrument, where ``cov`` does not say.
        n: how many poses.
        done: what was measured already.
        visible: says which poses T_rig_body (N, 4, 4) the cameras can see.
        cov: gives the covariance (N, M, M) of what is seen of poses T_rig_body (N, 4, 4).
        floor_m: how far above the base's plane the links must stay, m.
        seed: of the candidates.

    Raises:
        InputError: fewer candidates than ``n`` can be reached and seen.
    """
    rng = np.random.default_rng(seed)
    model, x, prior = _with_curves(model, x, prior)
    scene = Scene(model, x, noise, visible, cov, floor_m)
    q, approach, seen = _candidates(scene, rng)
    if len(q) < n:
        raise InputError(f"only {len(q)} poses that can be reached and seen were found; {n} were asked for")
    prior = np.where([p.kind in SCALED for p in model.parameters], MOSTLY * prior, prior)
    free = observed(model, x, seen, prior, noise).possible
    P = _prior_covariance(prior, free)
    if done is not None:
        Jd = scene.whitened(done)[:, :, free].reshape(-1, int(free.sum()))
        P = np.asarray(np.linalg.inv(np.linalg.inv(P) + Jd.T @ Jd))
    J = scene.whitened(seen)[:, :, free]
    wanted = _wanted(model, x, seen, free, rng)

    def tells(q: Array, approach: Array) -> tuple[Array, Mask]:
        return scene.told(q, approach, free)

    chosen, _ = greedy(J, P, wanted, n)
    better, sides = exchanged(q[chosen], approach[chosen], tells, P, wanted, scene.limits, rng)
    order, sigma = greedy(tells(better, sides)[0], P, wanted, n)
    _, drawn = greedy(J[rng.permutation(len(J))[: 4 * n]], P, wanted, min(4 * n, len(J)), in_order=True)
    return Plan(better[order], sides[order], sigma, drawn)


class Scene(NamedTuple):
    """What poses would be seen as, and which can be.

    Attributes:
        model: the arm with every parameter.
        x: (P,) the vector.
        noise: sigmas of place, m, and turn, rad, beyond ``cov``.
        visible: says which poses T_rig_body (N, 4, 4) the cameras can see.
        cov: gives the covariance (N, M, M) of what is seen of them; None: ``noise`` is all.
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
        """Say which poses (N,) are free and visible."""
        out = self.visible(self.T_rig_body(q, approach))
        out[out] = free_of_collision(self.model, q[out], self.floor_m)
        return out

    def seen(self, q: Array, approach: Array) -> Measured:
        """Return what would be seen without noise."""
        model, T = self.model, self.T_rig_body(q, approach)
        m = model.motion(self.x, q, model.feature_values(q, approach))
        p = m.o[:, None] + (m.R @ model.tool_points(self.x).T).swapaxes(1, 2)
        return Measured(q, p, T[:, :3, :3] if model.full else None, None if self.cov is None else self.cov(T), approach)

    def told(self, q: Array, approach: Array, free: Mask) -> tuple[Array, Mask]:
        """Return whitened Jacobians (N, M, F) by the free parameters, and which poses (N,) are allowed.

        Of poses that are not allowed there is none (behind a camera no covariance stands for what is seen): zeros. The
        first is the pose as it was, and always told.
        """
        allowed = self.allowed(q, approach)
        rows = np.flatnonzero(allowed | (np.arange(len(q)) == 0))
        told = self.whitened(self.seen(q[rows], approach[rows]))[:, :, free]
        J = np.zeros((len(q), *told.shape[1:]))
        J[rows] = told
        return J, allowed

    def whitened(self, measured: Measured) -> Array:
        """Return the whitened Jacobians (N, M, P)."""
        phi = self.model.feature_values(measured.q, measured.approach)
        J = self.model.linearised(self.x, measured, phi)[1]
        B = CHANCE_RAD * by_joints(self.model, J)
        C = noise_cov(measured, self.noise) + B @ B.swapaxes(1, 2)
        return np.asarray(np.linalg.solve(np.linalg.cholesky(C), J))


def _candidates(scene: Scene, rng: np.random.Generator) -> tuple[Array, Array, Measured]:
    """Return joint angles, directions of approach and what would be seen, of poses that are reachable, free and visible.

    They are evenly distributed over all that is; where cameras see little of what an arm reaches, more are drawn.
    """
    angles, sides, found = [], [], 0
    for _ in range(DRAWS):
        q = rng.uniform(*scene.limits, (4 * CANDIDATES, 6))
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
    """Say which joint angles (N, 6) keep the arm above the base's plane and apart from itself.

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
    """Say whether the base's column and the links (N, 8, 3) from the elbow on stay apart, looked at in steps along them."""
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

    Few poses may not choose among them, but where a curve is not looked at it stays unknown, and poses must be spread.
    """
    backlash = any(f.kind == "backlash" for f in model.features)
    whole = model.with_features(all_features(backlash, (*RIPPLES, *FAST)))
    known = dict(zip(model.names, zip(x, prior, strict=True), strict=True))
    both = np.array([known.get(p.name, (0.0, SIGMA[p.kind])) for p in whole.parameters])
    return whole, both[:, 0], both[:, 1]


def _prior_covariance(prior: Array, free: Mask) -> Array:
    sigma = np.where(np.isfinite(prior), prior, UNKNOWN)[free]
    return np.asarray(np.diag(sigma**2))


def _wanted(model: Model, x: Array, seen: Measured, free: Mask, rng: np.random.Generator) -> Array:
    """Return the derivative (PROBES * 3, F) of places in the rig at poses over the workspace."""
    rows = rng.choice(len(seen), min(PROBES, len(seen)), replace=False)
    part = seen.rows(rows)
    _, J = model.linearised(x, part, model.feature_values(part.q, part.approach))
    return J[:, :3, free].reshape(-1, int(free.sum()))
