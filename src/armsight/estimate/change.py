"""One evidence for what changed: hypotheses of a few numbers each, compared on sums of residuals.

In: sums of whitened residuals and their derivatives by K parameters, before and after a beginning; the parameters' prior;
the directions of what may have changed. Model, with x the parameters' own error, which is the same before and after:

    r = B x + n before,    r = B (x + F f) + n after,    x ~ N(0, L L^T),    n ~ N(0, s^2)

x is eliminated (score test, Rao, 1948): what was seen before is the reference, not the prior alone. Out: of each hypothesis
its size with covariance, chi-square and evidence against no change (MacKay, 1992).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from armsight.data import Array, Ids


class Sums:
    """What whitened residuals say of K parameters: sums over rows, degrees of freedom, and when they began.

    Attributes:
        M: (1 + K, 1 + K) sum of the outer products of rows [residual; derivatives].
        freedom: degrees of freedom.
        begin_s: when the first row was, s.
    """

    def __init__(self, M: Array, freedom: float = 0.0, begin_s: float = 0.0) -> None:
        self.M, self.freedom, self.begin_s = M, freedom, begin_s

    @classmethod
    def empty(cls, size: int, begin_s: float = 0.0) -> Sums:
        """Return sums over no rows, of K parameters."""
        return cls(np.zeros((1 + size, 1 + size)), 0.0, begin_s)

    @property
    def H(self) -> Array:
        """(K, K) information."""
        return self.M[1:, 1:]

    @property
    def b(self) -> Array:
        """(K,) right side."""
        return self.M[1:, 0]

    @property
    def square(self) -> float:
        """Sum of squares of the residuals."""
        return float(self.M[0, 0])

    def __add__(self, other: Sums) -> Sums:
        """Return the sums over both; they begin when these do."""
        return Sums(self.M + other.M, self.freedom + other.freedom, self.begin_s)

    def __sub__(self, other: Sums) -> Sums:
        """Return the sums without another's."""
        return Sums(self.M - other.M, self.freedom - other.freedom, self.begin_s)

    def __mul__(self, weight: float) -> Sums:
        """Return the sums over rows that count so many times."""
        return Sums(weight * self.M, weight * self.freedom, self.begin_s)

    def take(self, rows: Array, freedom: float) -> None:
        """Add rows (N, 1 + K) in place."""
        self.M += rows.T @ rows
        self.freedom += freedom

    def of(self, size: int) -> Sums:
        """Return the sums of the first parameters alone."""
        return Sums(self.M[: 1 + size, : 1 + size], self.freedom, self.begin_s)

    def over(self, variance: float) -> Sums:
        """Return the sums of residuals whose noise has a variance."""
        return Sums(self.M / variance, self.freedom, self.begin_s)

    def left(self, x: Array) -> float:
        """Return the sum of squares that parameters (K,) leave."""
        return max(self.square - 2.0 * float(x @ self.b) + float(x @ self.H @ x), 0.0)

    def without(self, direction: Array) -> Sums:
        """Return the sums with a direction (K,) eliminated, whose prior has a variance of 1."""
        column = self.M[:, 1:] @ direction
        return Sums(self.M - np.outer(column, column) / (1.0 + direction @ column[1:]), self.freedom, self.begin_s)


def eliminated(M: Array, rows: slice | Ids) -> Array:
    """Return sums M (N, N) with parameters eliminated, of which each has a prior of variance 1."""
    across = np.delete(M[rows], rows, axis=1)
    kept = np.delete(np.delete(M, rows, axis=0), rows, axis=1)
    inner = M[rows][:, rows] + np.eye(len(across))
    return np.asarray(kept - across.T @ np.linalg.solve(inner, across))


def changed(after: Sums, before: Sums, L: Array, F: Array) -> Sums:
    """Return what sums say of a change that began between them, the parameters eliminated.

    Args:
        after: of K parameters, since the beginning.
        before: the same, before it.
        L: (K, P) square root of the covariance of the parameters' error.
        F: (K, D) directions of what may have changed.

    Returns:
        Sums of D parameters; their square is what the parameters' error leaves of both.
    """
    A = L.T @ (after.H + before.H) @ L + np.eye(L.shape[1])
    both = L.T @ np.column_stack([after.b + before.b, after.H @ F])
    M = np.empty((1 + F.shape[1], 1 + F.shape[1]))
    M[0, 0], M[0, 1:] = after.square + before.square, F.T @ after.b
    M[1:, 0], M[1:, 1:] = M[0, 1:], F.T @ after.H @ F
    return Sums(M - both.T @ np.linalg.solve(A, both), after.freedom + before.freedom, after.begin_s)


class Hypotheses(NamedTuple):
    """N hypotheses of D numbers each: rows (N, D) of what may have changed, and widths (N,) of their priors."""

    rows: Ids
    widths: Array


class Change(NamedTuple):
    """What sums say of N hypotheses: log-evidence against none, chi-square, sizes (N, D) and covariances (N, D, D)."""

    evidence: Array
    chi_square: Array
    size: Array
    cov: Array


def explained(sums: Sums, hypotheses: Hypotheses, excess: float) -> Change:
    """Return what hypotheses explain of sums, of a noise whose variance is so many times larger."""
    rows, widths = 1 + hypotheses.rows, hypotheses.widths[:, None]
    variances = widths[..., None] ** 2
    G = sums.M[rows[:, :, None], rows[:, None, :]] * (variances / excess) + np.eye(rows.shape[1])
    r, inverse = sums.M[rows, 0] * (widths / excess), np.linalg.inv(G)
    d = np.einsum("nij,nj->ni", inverse, r)
    gained = np.einsum("ni,ni->n", r, d)
    return Change(0.5 * (gained - np.linalg.slogdet(G)[1]), gained, widths * d, variances * inverse)


def evidence_of_width(H: Array, b: Array, widths: Array) -> Array:
    """Return the log-evidence (S,) of numbers of information H (M, M) and right side b (M,), of priors of S widths."""
    values, V = np.linalg.eigh(H)
    variances = np.square(widths)[:, None]
    ratio = 1.0 + variances * np.maximum(values, 0.0)
    return np.asarray(0.5 * (variances * np.square(V.T @ b) / ratio - np.log(ratio)).sum(axis=1))
