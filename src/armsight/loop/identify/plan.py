"""Where to look next: the poses that tell most about an arm, and what so many more of them buy.

Greedy choice among candidates that can be reached and seen, then exchange joint by joint (``design``): poses that lower
most the predicted position error over the workspace (the trace of what the parameters' covariance does there, I-optimal, to
first order; the noise amplification of what is wanted, not of numbers that nobody asks for). A pose brings the information
J^T C^-1 J with the vision's covariance C there.

Choosing poses that together tell most: greedy, then exchanged joint by joint.

In: what is known before (a covariance), what is wanted (linear in the unknowns), and what each pose tells (its whitened
Jacobian). The criterion is the mean variance of what is wanted, I-optimal. The greedy choice among random candidates is
improved by coordinate exchange (Meyer and Nachtsheim, Technometrics 37, 1995): every joint of every pose in turn goes to
the best of some levels, as long as it pays.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Record
from armsight.errors import InputError
from armsight.loop.identify.fit import SIGMA, Mask, noise_cov
from armsight.loop.identify.joint_noise import by_joints
from armsight.loop.identify.measured import Measured
from armsight.loop.identify.model import FAST, RIPPLES, Model, all_features
from armsight.loop.identify.observable import observed
from armsight.loop.identify.selection import SCALED

#: Candidates weighed at once: bounds the memory.
_BATCH = 250
#: Levels that a joint is tried at, from both sides; sweeps over all poses at most, and the part that one must win to go on.
LEVELS, SWEEPS, LEAST_WON = 7, 3, 0.01

#: Gives the whitened Jacobians (N, M, F) of poses q (N, 6) come to from sides (N, 6), and which of them are allowed.
#: Those of poses that are not allowed do not count, but for the first.
Tells = Callable[[Array, Array], tuple[Array, Mask]]


def greedy(J: Array, P: Array, wanted: Array, n: int, *, in_order: bool = False) -> tuple[Array, Array]:
    """Return rows chosen one by one, and the predicted RMS of what is wanted before and after each.

    Args:
        J: (N, M, F) whitened Jacobians of the candidates.
        P: (F, F) covariance before.
        wanted: (3 K, F) derivative of K places.
        n: how many to choose.
        in_order: take them as they come instead.
    """
    P = P.copy()
    left = np.ones(len(J), bool)
    chosen: list[int] = []
    W = wanted.T @ wanted
    sigma = [rms(P, W, len(wanted))]
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
        sigma.append(rms(P, W, len(wanted)))
    return np.array(chosen), np.array(sigma)


def rms(P: Array, W: Array, numbers: int) -> float:
    """Return the RMS length of the error of places whose derivatives' squares sum to W, three numbers each."""
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
    tells: Tells,
    P: Array,
    wanted: Array,
    limits: tuple[Array, Array],
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """Return poses (n, 6) and sides (n, 6) that together tell more than those given.

    Args:
        q: (n, 6) joint angles to start from, rad.
        approach: (n, 6) sides.
        tells: what poses tell, and which are allowed.
        P: (F, F) covariance before.
        wanted: (3 K, F) derivative of what is wanted.
        limits: (6,) and (6,) least and greatest angles, rad.
        rng: where the levels fall, and the order of the joints.
    """
    q, approach, W = q.copy(), approach.copy(), wanted.T @ wanted
    J, _ = tells(q, approach)
    H = np.linalg.inv(P) + np.einsum("nki,nkj->ij", J, J)
    reached = rms(np.linalg.inv(H), W, len(wanted))
    for _ in range(SWEEPS):
        for k in range(len(q)):
            others = H - J[k].T @ J[k]
            q[k], approach[k], J[k] = _best(q[k], approach[k], tells, np.linalg.inv(others), W, limits, rng)
            H = others + J[k].T @ J[k]
        before, reached = reached, rms(np.linalg.inv(H), W, len(wanted))
        if reached > (1 - LEAST_WON) * before:
            break
    return q, approach


def _best(
    q: Array,
    approach: Array,
    tells: Tells,
    P: Array,
    W: Array,
    limits: tuple[Array, Array],
    rng: np.random.Generator,
) -> tuple[Array, Array, Array]:
    """Return the best pose that changes of one joint after the other lead to, its sides, and its Jacobian."""
    low, high = limits
    for joint in rng.permutation(6):
        step = (high[joint] - low[joint]) / (LEVELS - 1)
        levels = np.clip(low[joint] + step * (np.arange(LEVELS) + rng.uniform(-0.5, 0.5)), low[joint], high[joint])
        tried, sides = np.tile(q, (2 * LEVELS + 1, 1)), np.tile(approach, (2 * LEVELS + 1, 1))
        tried[1:, joint] = np.tile(levels, 2)
        sides[1 + LEVELS :, joint] *= -1
        J, allowed = tells(tried, sides)
        allowed[0] = True  # the pose as it was: it stays where nothing is better
        best = int(np.argmax(np.where(allowed, gains(J, P, W), -np.inf)))
        q, approach, kept = tried[best], sides[best], J[best]
    return q, approach, kept


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
