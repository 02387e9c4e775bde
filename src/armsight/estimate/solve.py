"""Weighted least squares whose shared errors are unknowns too (Henderson, Biometrics 31, 1975).

In: :class:`~armsight.estimate.linear.Linear` and a variance for each source. Out: the step, the covariance, the restricted
likelihood (Patterson and Thompson, Biometrika 58, 1971) with its gradient, and the prediction of measurements left out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dtrtri
from scipy.special import chdtri

from armsight.data import Array, Record
from armsight.estimate.chance import squares_of
from armsight.estimate.linear import Linear

OPEN = 1e-13  # information about a direction, as a share of each unknown's own, below which it is open


@dataclass(frozen=True, eq=False)
class Solved(Record):
    """Weighted least squares at given variances."""

    x: Array  #: (Q,) step of the P unknowns, then the shared errors
    root: Array  #: (Q, Q) root @ root.T is its covariance
    W: Array  #: (N, m, m) inverse covariance of the measurements' own errors
    left: Array  #: (N, m) what is left of the residuals
    A: Array  #: (N, m, Q) derivative by all
    of: NDArray[np.int64]  #: (Q,) of which source a column is, -1 for the unknowns
    cost: float  #: minus the restricted log-likelihood


def covariances(linear: Linear, variances: Array) -> Array:
    """Return the covariance (N, m, m) of each measurement's own errors."""
    C = np.array(linear.given)
    for v, M in zip(variances, linear.own.values(), strict=False):
        C += v * (M @ np.swapaxes(M, 1, 2))
    i = np.arange(C.shape[-1])
    C[:, i, i] = C[:, i, i] * (1 + 1e-8) + 1e-16  # positive definite in spite of rounding
    return C


def whitened(linear: Linear, variances: Array) -> tuple[Array, Array]:
    """Return residuals (N, m) and their derivative (N, m, Q) by all over the root of each measurement's own covariance."""
    half = np.linalg.inv(np.linalg.cholesky(covariances(linear, variances)))
    return (half @ linear.e[..., None])[..., 0], half @ np.concatenate([linear.J, *linear.shared.values()], axis=2)


def condensed(linear: Linear, variances: Array) -> Linear:
    """Return as few numbers as there are unknowns that say the same of them, the variances of what is own being known."""
    e, A = whitened(linear, variances)
    T = np.asarray(np.linalg.qr(np.column_stack([A.reshape(e.size, -1), e.ravel()]), mode="r"))[:, None]
    ends = np.cumsum([linear.J.shape[2], *(F.shape[2] for F in linear.shared.values())])
    J, *columns, left = np.split(T, ends, axis=2)
    shared = dict(zip(linear.shared, columns, strict=True))
    return replace(linear, e=left[..., 0], J=J, given=np.ones((len(T), 1, 1)), own={}, shared=shared)


def solve(linear: Linear, variances: Array) -> Solved:
    """Solve at the variances (K,) of ``linear.sources``."""
    first, P = len(linear.own), linear.J.shape[2]
    A = np.concatenate([linear.J, *linear.shared.values()], axis=2)
    of = np.repeat(np.arange(-1, len(linear.shared)), [P, *(F.shape[2] for F in linear.shared.values())])
    of = np.where(of >= 0, of + first, of)
    known = np.concatenate([linear.known, 1 / variances[of[P:]]])
    at = np.concatenate([linear.at, np.zeros(len(of) - P)])
    C = covariances(linear, variances)
    L = np.linalg.cholesky(C)
    half = np.linalg.inv(L)
    n, m = linear.e.shape
    white, e = (half @ A).reshape(n * m, -1), (half @ linear.e[..., None]).ravel()
    H = white.T @ white + np.diag(known)
    unit = 1 / np.sqrt(np.maximum(np.diag(H), 1e-300))
    R = np.linalg.cholesky(unit[:, None] * H * unit + OPEN * np.eye(len(unit)))
    root = unit[:, None] * dtrtri(R, lower=1)[0].T
    x = -root @ (root.T @ (white.T @ e + known * at))
    squares = float(((e + white @ x) ** 2).sum() + (known * (at + x) ** 2).sum())
    logdet = 2 * float(np.log(np.diagonal(L, axis1=1, axis2=2)).sum())
    logdet += float(2 * np.log(np.diag(R)).sum() - 2 * np.log(unit).sum() - np.log(known[P:]).sum())
    W = np.swapaxes(half, 1, 2) @ half
    return Solved(x, root, W, linear.e + A @ x, A, of, 0.5 * (logdet + squares))


def gradient(linear: Linear, variances: Array, s: Solved) -> Array:
    """Return the derivative (K,) of the cost by the logarithms of the variances (Harville, JASA 72, 1977)."""
    out = np.zeros(len(variances))
    weighted = (s.W @ s.left[..., None])[..., 0]
    WR = s.W @ (s.A @ s.root)
    G = s.W - WR @ np.swapaxes(WR, 1, 2) - weighted[:, :, None] * weighted[:, None, :]
    for k, M in enumerate(linear.own.values()):
        out[k] = 0.5 * variances[k] * float(np.einsum("nij,nik,njk->", G, M, M, optimize=True))
    for k in range(len(linear.own), len(variances)):
        of = s.of == k
        out[k] = 0.5 * float(of.sum() - ((s.root[of] ** 2).sum() + (s.x[of] ** 2).sum()) / variances[k])
    return out


def left_out(s: Solved) -> tuple[Array, Array]:
    """Return what is left (N, m) of each measurement under the fit to all others, and its covariance (N, m, m)."""
    AR = s.A @ s.root
    own = np.linalg.inv(s.W)
    kept = own - AR @ np.swapaxes(AR, 1, 2)  # covariance of what is left in the fit to all
    i = np.arange(kept.shape[-1])
    kept[:, i, i] += 1e-9 * own[:, i, i]
    gain = own @ np.linalg.inv(kept)
    return (gain @ s.left[..., None])[..., 0], np.asarray(gain @ own)


def by_chance(squares: Array, numbers: int, chance: float, least: float = 1e-300) -> NDArray[np.bool_]:
    """Return which squared distances (N,), of so many numbers each, chance explains, by the scale of their median.

    A larger one is a mistake where its chance is below ``chance``; the scale is ``least`` at least.
    """
    scale = max(float(np.median(squares)) / float(chdtri(numbers, 0.5)), least)
    return np.asarray(squares <= scale * chdtri(numbers, chance))


def log_density(left: Array, cov: Array) -> Array:
    """Return the logarithm of the normal density (N,) of residuals (N, m) with covariances (N, m, m)."""
    return np.asarray(-0.5 * (squares_of(left, cov) + np.linalg.slogdet(cov)[1] + left.shape[1] * np.log(2 * np.pi)))


def regression(A: Array, y: Array, groups: list[NDArray[np.int64]] | None) -> tuple[list[float], list[float]]:
    """Return the coefficients of a fit of y (N,) by columns A (N, P) and their sigmas, by the scatter of what is left.

    Without groups, rows of each pose, the rows are independent. What the columns lack is the same at every visit of a
    pose: visits do not average it out. The sigma is the larger one of that of independent rests and that of independent
    poses (clustered: Liang and Zeger, Biometrika 73, 1986, for G poses times G / (G - P)).
    """
    x, *_ = np.linalg.lstsq(A, y, rcond=None)
    left = y - A @ x
    inverse = np.linalg.pinv(A.T @ A)
    rests = np.diag(inverse) * float(left @ left) / max(len(y) - A.shape[1], 1)
    if groups is None:
        return x.tolist(), np.sqrt(rests).tolist()
    pulls = np.array([A[rows].T @ left[rows] for rows in groups]) @ inverse
    poses = (pulls**2).sum(axis=0) * len(groups) / max(len(groups) - A.shape[1], 1)
    return x.tolist(), np.sqrt(np.maximum(rests, poses)).tolist()
