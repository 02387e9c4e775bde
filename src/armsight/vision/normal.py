"""Compiled parts of the model fits of corners, tags and discs: the profile of an edge, and small normal equations.

The profile is that of a straight step from dark to bright, seen through a blurred lens and square pixels. Gaussian blur
and the pixel's width are both integrated exactly: across an edge a pixel is a box as wide as the longer of its two
shadows, and the shorter one adds to the blur. There are two versions: from tables, and in single precision without
tables or branches, so that a loop over pixels fills the processor's vectors (SIMD).

Small normal equations of a least-squares fit are Cholesky-factored, solved and inverted.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array
from armsight.kernels import kernel

_TABLE_STEP, REACH = 1.0 / 256.0, 4.0
_z = np.arange(0.0, REACH + 2 * _TABLE_STEP, _TABLE_STEP)
#: erf(z / sqrt 2) and the normal density over z >= 0; linear interpolation is good to 1e-6.
_ERF = np.array([math.erf(z / math.sqrt(2.0)) for z in _z])
_PHI = np.exp(-0.5 * _z * _z) / np.sqrt(2.0 * np.pi)


@kernel(fastmath=True)
def _normal(z: float) -> tuple[float, float]:
    """Return erf(z / sqrt 2) and the normal density at z."""
    x = abs(z)
    if x >= REACH:
        return (1.0 if z > 0 else -1.0), 0.0
    x /= _TABLE_STEP
    i = int(x)
    f = x - i
    e = _ERF[i] + f * (_ERF[i + 1] - _ERF[i])
    return (e if z > 0 else -e), _PHI[i] + f * (_PHI[i + 1] - _PHI[i])


@kernel("f8, f8, f8", fastmath=True)
def edge(u: float, s: float, w: float) -> tuple[float, float, float]:
    """Return the profile of a step at distance u, blurred by s and a box of width w, px; and its derivatives by u, s."""
    if abs(u) > REACH * s + 0.5:
        return (1.0 if u > 0 else -1.0), 0.0, 0.0
    high, low = u + 0.5 * w, u - 0.5 * w
    e1, f1 = _normal(high / s)
    e0, f0 = _normal(low / s)
    return (high * e1 - low * e0 + 2.0 * s * (f1 - f0)) / w, (e1 - e0) / w, 2.0 * (f1 - f0) / w


_f = np.float32
_ZERO, _HALF, _ONE, _TWO = _f(0.0), _f(0.5), _f(1.0), _f(2.0)
_DENSITY = _f(1.0 / np.sqrt(2.0 * np.pi))
_MINUS_LOG2_E, _FAR = _f(-1.0 / np.log(2.0)), _f(60.0)
#: 2^f over 0 <= f < 1.
_P1, _P2, _P3, _P4, _P5 = _f(0.6931531), _f(0.2401536), _f(0.0558263), _f(0.0089893), _f(0.0018775)
_BIAS, _MANTISSA = np.int32(127), np.int32(23)
#: Abramowitz and Stegun 7.1.26, in units of sigma.
_T, _A1, _A2 = _f(0.3275911 / np.sqrt(2.0)), _f(0.254829592), _f(-0.284496736)
_A3, _A4, _A5 = _f(1.421413741), _f(-1.453152027), _f(1.061405429)


@kernel(fastmath=True, forceinline=True)
def decay_single(y: np.float32) -> np.float32:
    """Return exp(-y) for y >= 0 to 1e-6: a power of two put together from its bits, times a polynomial."""
    t = _MINUS_LOG2_E * min(y, _FAR)
    whole: np.float32 = np.floor(t)
    f = t - whole
    p = _ONE + f * (_P1 + f * (_P2 + f * (_P3 + f * (_P4 + f * _P5))))
    power: np.float32 = np.int32((np.int32(whole) + _BIAS) << _MANTISSA).view(np.float32)
    return p * power


@kernel("f4, f4, f4, f4, f4", fastmath=True, forceinline=True)
def edge_single(
    u: np.float32, per_s: np.float32, two_s: np.float32, half_w: np.float32, per_w: np.float32
) -> tuple[np.float32, np.float32, np.float32]:
    """As :func:`edge`, to 1e-6, from 1 / s, 2 s, w / 2 and 1 / w."""
    high, low = u + half_w, u - half_w
    z1, z0 = high * per_s, low * per_s
    g1, g0 = decay_single(_HALF * z1 * z1), decay_single(_HALF * z0 * z0)
    t1, t0 = _ONE / (_ONE + _T * abs(z1)), _ONE / (_ONE + _T * abs(z0))
    e1 = _ONE - t1 * (_A1 + t1 * (_A2 + t1 * (_A3 + t1 * (_A4 + t1 * _A5)))) * g1
    e0 = _ONE - t0 * (_A1 + t0 * (_A2 + t0 * (_A3 + t0 * (_A4 + t0 * _A5)))) * g0
    fall = _DENSITY * (g1 - g0)
    profile = (abs(high) * e1 - abs(low) * e0 + two_s * fall) * per_w  # a distance times its erf has no sign
    e1 = e1 if z1 > _ZERO else -e1
    e0 = e0 if z0 > _ZERO else -e0
    return profile, (e1 - e0) * per_w, _TWO * fall * per_w


Floats = NDArray[np.float32]

#: Pixels are processed in blocks of this many: the input of :func:`products` is padded to a multiple of it with zeros.
SIMD_WIDTH = 32


@kernel(fastmath=True)
def products(n: int, rows: Floats, sums: Array) -> None:
    """Fill the lower half of sums (12, 12) with the products of each two of the rows (12, N), summed over n pixels.

    Two rows by four at a time: eight independent sums keep the processor busy; a single one stalls on its own result.
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


@kernel
def factor(A: Array, damping: float, L: Array) -> bool:
    """Cholesky-factor A, as far as L reaches, its diagonal raised by ``damping``; False if it is not positive definite.

    Divisions are slow, so L's diagonal receives its own inverse.
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


@kernel
def solve(L: Array, g: Array, x: Array) -> None:
    """Solve L L^T x = g with the factor from :func:`factor`."""
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


@kernel
def invert(L: Array, inverse: Array) -> None:
    """Fill the inverse of L L^T, L from :func:`factor`."""
    unit, x = np.zeros(len(L)), np.empty(len(L))
    for i in range(len(L)):
        unit[:] = 0.0
        unit[i] = 1.0
        solve(L, unit, x)
        inverse[i] = x
