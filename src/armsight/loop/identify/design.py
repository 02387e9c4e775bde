"""Choosing poses that together tell most: greedy, then exchanged joint by joint.

In: what is known before (a covariance), what is wanted (linear in the unknowns), and what each pose tells (its whitened
Jacobian). The criterion is the mean variance of what is wanted, I-optimal. The greedy choice among random candidates is
improved by coordinate exchange (Meyer and Nachtsheim, Technometrics 37, 1995): every joint of every pose in turn goes to
the best of some levels, as long as it pays.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from armsight.data import Array
from armsight.loop.identify.fit import Mask

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
