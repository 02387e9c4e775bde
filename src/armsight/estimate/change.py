"""Whether something changed between two measurements: a score test (Rao, 1948) at every split of their order.

In: residuals near the fit to all of them, in the order in which they were taken, and the ways to change. Out: between
which two the unknowns changed, and by how much; None where one state fits all. The same test in random orders shows what
chance, outliers and errors that neighbours share do (a permutation test; Good, 2005), in orders by the poses what the model
lacks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from armsight.data import Array, Record

#: Least measurements on either side of a change, and the least share of all; half: more that chance offers, double: later
#: found.
_LEAST, _LEAST_SHARE = 3, 0.15
#: Parts that splits lie between; half: the row of a change is known worse, double: four times the time.
_PARTS = 100
#: Random orders, as many by pose, and the share of the first that may look as changed; half and double: another rate of
#: false alarms.
_ORDERS, _CHANCE = 200, 0.005
_AT_ONCE = 200_000  # numbers that orders are tested with at once; half: more calls, double: twice the memory
#: Neighbours that are moved together at most, as a share of all; half: errors that they share look as a change.
_TOGETHER = 1 / 16
#: Least square of a change in sigmas, per number; half: changes that sigmas hold are named, double: fewer.
_MATTERS = 4.0
_SAME = 1e-9  # share of a gain that is rounding, as poses may split as the time does; half and double: nothing
_RIDGE = 1e-13  # of a scaled system whose measurements leave a direction open; half and double: nothing
_CAUCHY = 3.0  # sigmas from where a residual counts less; half: noise does, double: outliers pull


@dataclass(frozen=True, eq=False)
class StateChange(Record):
    """A change of the unknowns between two measurements."""

    row: int  #: the first measurement after it
    way: str  #: what changed, of the ways given
    columns: NDArray[np.intp]  #: which unknowns change so
    off: Array  #: (2, P) the unknowns before and after it, less those of one state of all
    sure: bool  #: whether it is larger than what the model lacks, which depends on the pose
    before: float  #: RMS of the residuals in one state, in sigmas
    left: float  #: the same in two

    @property
    def step(self) -> Array:
        """(P,) by how much the unknowns changed."""
        return np.asarray(self.off[1] - self.off[0])

    def to_dict(self) -> dict[str, Any]:
        """Return the row, what changed and by how much, m and rad, as JSON has it."""
        return {"row": self.row, "way": self.way, "step_m_rad": self.step[self.columns].tolist(), "sure": self.sure}

    def over_all(self, free: NDArray[np.bool_]) -> StateChange:
        """Return the same by more unknowns, of which those free (Q,) are these."""
        off = np.zeros((2, len(free)))
        off[:, free] = self.off
        return replace(self, columns=np.flatnonzero(free)[self.columns], off=off)


def robust(e: Array, J: Array) -> tuple[Array, Array]:
    """Return whitened residuals (N, m) and their derivative (N, m, P) with Cauchy's weight of each measurement."""
    weight = 1 / np.sqrt(1 + (e**2).mean(axis=1) / _CAUCHY**2)
    return e * weight[:, None], J * weight[:, None, None]


def changed(
    e: Array,
    J: Array,
    ways: dict[str, NDArray[np.intp]],
    poses: Array,
    *,
    known: Array | None = None,
    at: Array | float = 0.0,
    count: int | None = None,
) -> StateChange | None:
    """Return how the unknowns changed; None where one state fits all, or there are too few measurements.

    Args:
        e: (N, m) whitened residuals, each measurement's own parameters eliminated: e is J x, and noise.
        J: (N, m, P) their derivative.
        ways: name -> which unknowns change together.
        poses: (N, F) what the model's errors may depend on, in any unit.
        known: (P,) information about the unknowns beside the residuals.
        at: (P,) where the unknowns are, from where that information has them.
        count: the first so many are in the order of time, and the others in none; None: all are.
    """
    n = len(e) if count is None else count
    least = max(_LEAST, int(np.ceil(_LEAST_SHARE * n)))
    if n < 2 * least or not ways:
        return None
    columns = np.unique(np.concatenate(list(ways.values())))
    own = [np.searchsorted(columns, p) for p in ways.values()]
    flat, prior = J.reshape(-1, J.shape[2]), np.zeros(J.shape[2]) if known is None else known
    H = flat.T @ flat + np.diag(prior)
    unit = 1 / np.sqrt(np.maximum(np.diag(H), 1e-300))
    root = np.linalg.cholesky(unit[:, None] * H * unit + _RIDGE * np.eye(len(unit)))
    slope = solve_triangular(root, unit * (flat.T @ e.ravel() - prior * at), lower=True)
    starts = np.unique(np.linspace(0, n, min(n, _PARTS) + 1).round().astype(int))[:-1]
    J, e = J[:n] * unit, e[:n]
    some = J[:, :, columns]
    cross = (J.swapaxes(1, 2) @ some, some.swapaxes(1, 2) @ some, (e[:, None] @ some)[:, 0])
    A, B, g = (np.add.reduceat(each, starts, axis=0) for each in cross)
    A = np.asarray(solve_triangular(root, A.swapaxes(0, 1).reshape(len(root), -1), lower=True))
    A = A.reshape(len(root), len(B), -1).swapaxes(0, 1)
    g = g - slope @ A
    inner = np.flatnonzero((starts[1:] >= least) & (starts[1:] <= n - least))

    def gains(orders: NDArray[np.intp], p: NDArray[np.intp]) -> tuple[Array, Array]:
        """Return by how much a way lowers the squares (R, K), in R orders at each of K splits, and its steps (R, K, p)."""
        sums = (np.cumsum(each[orders[:, ::-1]], axis=1) for each in (A[..., p], B[:, p[:, None], p], g[:, p]))
        A_after, B_after, v = (each[:, len(starts) - 2 - inner] for each in sums)
        M = B_after - A_after.swapaxes(2, 3) @ A_after + _RIDGE * np.eye(len(p))
        steps = np.linalg.solve(M, v[..., None])[..., 0]
        return (v * steps).sum(axis=2), steps

    def most(orders: NDArray[np.intp], p: NDArray[np.intp]) -> Array:
        parts = np.array_split(orders, 1 + orders.size * A.shape[1] * len(p) // _AT_ONCE)
        return np.concatenate([gains(part, p)[0].max(axis=1) for part in parts])

    in_time = [gains(np.arange(len(starts))[None], p) for p in own]
    found = np.concatenate([gain for gain, _ in in_time])
    random = _random_orders(len(starts), np.random.default_rng(0))
    by_chance = np.array([most(random, p) for p in own])
    usual = by_chance.mean(axis=1)[:, None]
    if (found - usual).max() <= np.quantile((by_chance - usual).max(axis=0), 1 - _CHANCE):
        return None
    way, k = np.unravel_index(int(np.argmax(found - usual)), found.shape)
    split, p, gain = int(inner[k]), own[way], found[way, k]
    middle = np.add.reduceat(poses[:n], starts, axis=0) / np.diff(np.append(starts, n))[:, None]
    sure = gain > (1 + _SAME) * most(_orders_by(middle, np.random.default_rng(1)), p).max()
    step = np.zeros(len(unit))
    step[columns[p]] = in_time[way][1][0, k]
    by_fit = -A[split + 1 :].sum(axis=0)[:, p] @ step[columns[p]]
    at_all = solve_triangular(root, by_fit, lower=True, trans="T")
    squares = float((e**2).sum() - slope @ slope)
    before, left = (np.sqrt(each / e.size) for each in (squares, max(squares - gain, 0.0)))
    return StateChange(
        int(starts[split + 1]),
        list(ways)[way],
        columns[p],
        np.stack([at_all, at_all + step]) * unit,
        bool(sure),
        float(before),
        float(left),
    )


def matters(change: StateChange, cov: Array) -> bool:
    """Return whether a change is more than a covariance (P, P) of the unknowns, zero of those not fitted, holds."""
    fitted = np.diag(cov) > 0
    off, cov = change.off[:, fitted], cov[np.ix_(fitted, fitted)]
    unit = 1 / np.sqrt(np.diag(cov))
    off, inverse = off * unit, np.linalg.pinv(unit[:, None] * cov * unit, hermitian=True)
    return bool(((off @ inverse) * off).sum(axis=1).max() >= _MATTERS * len(change.columns))


def _random_orders(n: int, random: np.random.Generator) -> NDArray[np.intp]:
    """Return orders (K, n) of n parts in which neighbours stay together, in pieces of 1 to n / 16."""
    pieces = [np.arange(n) // (1 + k % max(int(_TOGETHER * n), 1)) for k in range(_ORDERS)]
    return np.array([np.argsort(random.permutation(piece[-1] + 1)[piece], kind="stable") for piece in pieces])


def _orders_by(poses: Array, random: np.random.Generator) -> NDArray[np.intp]:
    """Return orders (K, N) of poses (N, F) by each of their numbers, and by mixtures."""
    poses = (poses - poses.mean(axis=0)) / np.maximum(poses.std(axis=0), 1e-300)
    mixtures = random.standard_cauchy((_ORDERS - poses.shape[1], poses.shape[1]))
    return np.argsort(np.concatenate([np.eye(poses.shape[1]), mixtures]) @ poses.T, axis=1)
