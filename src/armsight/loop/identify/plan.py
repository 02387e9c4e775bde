"""Where to look next: the poses that tell most about an arm, and what so many more of them buy.

Greedy choice among candidates that can be reached and seen: each next pose is the one that lowers most the predicted
position error over the workspace (the trace of what the parameters' covariance does there, I-optimal, to first order; the
noise amplification of what is wanted, not of numbers that nobody asks for). A pose brings the information J^T C^-1 J with
the vision's covariance C there; the covariance is updated by the Woodbury identity, so that thousands of candidates cost
little.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Record
from armsight.errors import InputError
from armsight.loop.identify.fit import Mask, weighted
from armsight.loop.identify.growth import PLACEMENT
from armsight.loop.identify.measured import Measured
from armsight.loop.identify.model import Model
from armsight.loop.identify.observable import observed

#: Candidates drawn, and places of the workspace at which the error is predicted.
CANDIDATES, PROBES = 1500, 200
#: Links must stay this far above the base's plane, m, and parts of the arm that are not neighbours this far apart.
FLOOR_M, APART_M = 0.02, 0.06
#: What nothing is known of at first: base and tool, m and rad.
UNKNOWN = 0.1
#: Candidates weighed at once: bounds the memory.
_BATCH = 250


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
    seed: int = 0,
) -> Plan:
    """Choose the poses that tell most.

    Args:
        model: the arm with every parameter.
        x: (P,) where its base and tool are, at least roughly.
        prior: (P,) prior sigmas.
        noise: sigmas of place, m, and turn, rad, of the instrument, where ``cov`` does not say.
        n: how many poses.
        done: what was measured already.
        visible: says which poses T_rig_body (N, 4, 4) the cameras can see.
        cov: gives the covariance (N, M, M) of what is seen of poses T_rig_body (N, 4, 4).
        seed: of the candidates.

    Raises:
        InputError: fewer candidates than ``n`` can be reached and seen.
    """
    rng = np.random.default_rng(seed)
    q, approach, seen = _candidates(model, x, rng, visible, cov)
    if len(q) < n:
        raise InputError(f"only {len(q)} of {CANDIDATES} poses can be reached and seen; {n} were asked for")
    J = _whitened(model, x, seen, noise)
    free = observed(model, x, seen, prior, noise).possible
    P = _prior_covariance(model, prior, free)
    if done is not None:
        Jd = _whitened(model, x, done, noise)[:, :, free].reshape(-1, int(free.sum()))
        P = np.asarray(np.linalg.inv(np.linalg.inv(P) + Jd.T @ Jd))
    J = J[:, :, free]
    wanted = _wanted(model, x, seen, free, rng)
    chosen, sigma = _greedy(J, P, wanted, n)
    _, drawn = _greedy(J[rng.permutation(len(J))[: 4 * n]], P, wanted, min(4 * n, len(J)), in_order=True)
    return Plan(q[chosen], approach[chosen], sigma, drawn)


def _candidates(
    model: Model,
    x: Array,
    rng: np.random.Generator,
    visible: Callable[[Array], NDArray[np.bool_]],
    cov: Callable[[Array], Array] | None,
) -> tuple[Array, Array, Measured]:
    """Return joint angles, directions of approach and what would be seen, of poses that are reachable, free and visible."""
    arm = model.arm
    q = rng.uniform(np.maximum(arm.q_min, -np.pi), np.minimum(arm.q_max, np.pi), (4 * CANDIDATES, 6))
    q = q[free_of_collision(model, q)]
    approach = rng.choice([-1.0, 1.0], q.shape)
    T = model.T_rig_base(x) @ model.tool_in_base(x, q, approach)
    rows = np.flatnonzero(visible(T))[:CANDIDATES]
    q, approach, T = q[rows], approach[rows], T[rows]
    points = model.tool_points(x)
    m = model.motion(x, q, model.feature_values(q, approach))
    p = m.o[:, None] + (m.R @ points.T).swapaxes(1, 2)
    R = T[:, :3, :3] if model.full else None
    return q, approach, Measured(q, p, R, None if cov is None else cov(T), approach)


def free_of_collision(model: Model, q: Array) -> Mask:
    """Say which joint angles (N, 6) keep the arm above the base's plane and apart from itself.

    Links are the straight lines between the axes' frames; the first two and neighbours are not compared.
    """
    out = np.zeros(len(q), bool)
    for n, angles in enumerate(q):
        o = model.arm.links(angles)[:, :3, 3]
        along = (o - model.arm.T_base_0[:3, 3]) @ model.up_base
        high = bool((along[2:] > FLOOR_M).all())
        out[n] = high and _segments_apart(o)
    return out


def _segments_apart(o: Array) -> bool:
    """Say whether the base's column and the links from the elbow on stay apart, looked at in steps along them."""
    steps = np.linspace(0, 1, 9)[:, None]
    column = o[0] + steps * (o[1] - o[0])
    for i in range(3, len(o) - 1):
        line = o[i] + steps * (o[i + 1] - o[i])
        for other in (column, o[1] + steps[:5] * (o[2] - o[1])):
            if np.linalg.norm(line[:, None] - other, axis=2).min() < APART_M:
                return False
    return True


def _whitened(model: Model, x: Array, measured: Measured, noise: tuple[float, float]) -> Array:
    phi = model.feature_values(measured.q, measured.approach)
    return weighted(model, x, measured, phi, noise)[1]


def _prior_covariance(model: Model, prior: Array, free: Mask) -> Array:
    sigma = np.where(np.isfinite(prior), prior, UNKNOWN)[free]
    return np.asarray(np.diag(sigma**2))


def _wanted(model: Model, x: Array, seen: Measured, free: Mask, rng: np.random.Generator) -> Array:
    """Return the derivative (PROBES * 3, F) of places in the base at poses over the workspace."""
    rows = rng.choice(len(seen), min(PROBES, len(seen)), replace=False)
    part = seen.rows(rows)
    _, J = model.linearised(x, part, model.feature_values(part.q, part.approach))
    J = J[:, :3].copy()
    J[:, :, [p.kind == PLACEMENT[0] for p in model.parameters]] = 0.0  # where the base is in the rig is not the arm's
    return J[:, :, free].reshape(-1, int(free.sum()))


def _greedy(J: Array, P: Array, wanted: Array, n: int, *, in_order: bool = False) -> tuple[Array, Array]:
    """Return rows chosen one by one, and the predicted RMS position error before and after each."""
    P = P.copy()
    left = np.ones(len(J), bool)
    chosen: list[int] = []
    W = wanted.T @ wanted
    points = len(wanted) / 3

    def rms() -> float:
        return float(np.sqrt(np.einsum("ij,ji->", W, P) / points))

    sigma = [rms()]
    for k in range(n):
        if in_order:
            best = k
        else:
            rows = np.flatnonzero(left)
            best = int(rows[np.argmax(_gains(J[rows], P, W))])
        G = P @ J[best].T
        S = np.eye(J.shape[1]) + J[best] @ G
        P = P - G @ np.linalg.solve(S, G.T)
        P = (P + P.T) / 2
        left[best] = False
        chosen.append(best)
        sigma.append(rms())
    return np.array(chosen), np.array(sigma)


def _gains(J: Array, P: Array, W: Array) -> Array:
    """Return by how much each pose lowers trace(W P): trace(S^-1 J P W P J^T)."""
    PWP = P @ W @ P
    out = np.empty(len(J))
    for at in range(0, len(J), _BATCH):
        part = J[at : at + _BATCH]
        S = np.eye(J.shape[1]) + part @ P @ part.swapaxes(1, 2)
        out[at : at + _BATCH] = np.einsum("nii->n", np.linalg.solve(S, part @ PWP @ part.swapaxes(1, 2)))
    return out
