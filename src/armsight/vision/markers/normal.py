"""Normal equations of small least-squares fits, compiled: assemble, factor, solve, invert."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from armsight.data import Array

Floats = NDArray[np.float32]

#: Pixels are worked on by so many at once: what is summed by :func:`products` is filled up to a multiple of it with zeros.
LANES = 32
_ZERO = np.float32(0.0)


@numba.njit(cache=True, error_model="numpy", fastmath=True)
def products(n: int, rows: Floats, sums: Array) -> None:
    """Fill the lower half of sums (12, 12) with the products of each two of the rows (12, N), summed over n pixels.

    Two rows by four at a time: eight sums under way keep the processor busy, one alone waits for itself.
    """
    for i in range(0, 12, 2):
        a0, a1 = rows[i, :n], rows[i + 1, :n]
        for j in range(0, i + 2, 4):
            b0, b1, b2, b3 = rows[j, :n], rows[j + 1, :n], rows[j + 2, :n], rows[j + 3, :n]
            s0, s1, s2, s3, t0, t1, t2, t3 = _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO
            for m in range(n):
                s0 += a0[m] * b0[m]
                s1 += a0[m] * b1[m]
                s2 += a0[m] * b2[m]
                s3 += a0[m] * b3[m]
                t0 += a1[m] * b0[m]
                t1 += a1[m] * b1[m]
                t2 += a1[m] * b2[m]
                t3 += a1[m] * b3[m]
            sums[i, j], sums[i, j + 1], sums[i, j + 2], sums[i, j + 3] = s0, s1, s2, s3
            sums[i + 1, j], sums[i + 1, j + 1], sums[i + 1, j + 2], sums[i + 1, j + 3] = t0, t1, t2, t3


@numba.njit(cache=True, error_model="numpy", fastmath=True)
def normal_equations(n: int, J: Array, r: Array, A: Array, g: Array) -> None:
    """Fill A = J J^T and g = J r."""
    for i in range(len(J)):
        for j in range(i + 1):
            s = 0.0
            for m in range(n):
                s += J[i, m] * J[j, m]
            A[i, j] = s
            A[j, i] = s
        s = 0.0
        for m in range(n):
            s += J[i, m] * r[m]
        g[i] = s


@numba.njit(cache=True, error_model="numpy")
def factor(A: Array, damping: float, L: Array) -> bool:
    """Cholesky-factor A, as far as L reaches, its diagonal raised by ``damping``; False if it is not positive definite.

    Divisions are dear: L's diagonal is filled with its own inverse.
    """
    for i in range(len(L)):
        for j in range(i):
            s = A[i, j]
            for m in range(j):
                s -= L[i, m] * L[j, m]
            L[i, j] = s * L[j, j]
        s = A[i, i] * (1.0 + damping)
        for m in range(i):
            s -= L[i, m] * L[i, m]
        if not s > 1e-12 * A[i, i]:
            return False
        L[i, i] = 1.0 / np.sqrt(s)
    return True


@numba.njit(cache=True, error_model="numpy")
def solve(L: Array, g: Array, x: Array) -> None:
    """Solve L L^T x = g with the factor that :func:`factor` fills."""
    for i in range(len(L)):
        s = g[i]
        for m in range(i):
            s -= L[i, m] * x[m]
        x[i] = s * L[i, i]
    for i in range(len(L) - 1, -1, -1):
        s = x[i]
        for m in range(i + 1, len(L)):
            s -= L[m, i] * x[m]
        x[i] = s * L[i, i]


@numba.njit(cache=True, error_model="numpy")
def invert(L: Array, inverse: Array) -> None:
    """Fill the inverse of L L^T, L as :func:`factor` fills it."""
    unit, x = np.zeros(len(L)), np.empty(len(L))
    for i in range(len(L)):
        unit[:] = 0.0
        unit[i] = 1.0
        solve(L, unit, x)
        inverse[i] = x


@numba.njit(cache=True, error_model="numpy", fastmath=True)
def edge_noise(n: int, J: Array, r: Array, inverse: Array, first: int, second: int) -> float:
    """Estimate the variance of the noise from residuals r (n,) where it matters to two parameters, those of place.

    The mean squared residual, each divided by what the fit leaves of it (1 - leverage) and weighted by how much its
    pixel says about the two parameters: flat areas, saturated ones above all, must not speak for the edges. No image is
    known better than its quantisation.
    """
    leverage = np.zeros(n)
    for i in range(len(J)):
        for j in range(i + 1):
            share = inverse[i, i] if i == j else 2.0 * inverse[i, j]
            for m in range(n):
                leverage[m] += share * J[i, m] * J[j, m]
    weight, power = 0.0, 0.0
    for m in range(n):
        w = J[first, m] ** 2 + J[second, m] ** 2
        weight += w * (1.0 - leverage[m])
        power += w * r[m] ** 2
    return float(max(power / weight, 1.0 / 12.0))
