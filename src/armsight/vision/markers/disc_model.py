"""What the pixels of a disc should be, and how they change with its parameters.

A disc's image is modelled as

    I(x) = B + C Phi(d(x) / s) + g (x - c) k(x)

with d the distance inside the rim of the ellipse (x - c)^T M (x - c) = 1 (to first order, Sampson 1982), Phi the normal
distribution that lens and pixel blur the edge with, B the surround's level, C the contrast and g a gradient. Ten unknowns:
c, M, s, C, B, g. A surround that is uneven itself leaves the disc flat (k = 1 - Phi), uneven light slopes disc and
surround in proportion to their levels, stray light both alike (k = 1).

Loops run over one array of float32 for each quantity, so that the compiler makes vectors of them.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from armsight.data import Array
from armsight.vision.markers.normal import LANES, products

#: Most pixels that one fit takes; of larger discs every second, third ... row is.
MOST_PIXELS = 3072
#: Unknowns: c (2), M (3), s, C, B, g (2).
UNKNOWNS = 10
#: Floats in a cache line.
_LINE = 16

#: What a gradient may be one of.
LIGHT, SURROUND, STRAY = 0, 1, 2

F = np.float32
_E0, _E1, _E2, _E3, _E4, _E5 = (F(x) for x in (1.0, -1 / 16, 1 / 512, -1 / 24576, 1 / 1572864, -1 / 125829120))
_P = F(0.2316419)
_B1, _B2, _B3, _B4, _B5 = (F(x) for x in (0.31938153, -0.356563782, 1.781477937, -1.821255978, 1.330274429))
_ROOT = F(0.3989422804014327)
_ZERO, _HALF, _ONE, _FIVE = F(0.0), F(0.5), F(1.0), F(5.0)

Floats = NDArray[np.float32]


class Work(NamedTuple):
    """The arrays that a fit works in; one set for each thread.

    Attributes:
        px: (MOST_PIXELS,) columns of the pixels, relative to the nearest pixel of the centre.
        py: (MOST_PIXELS,) their rows.
        level: (MOST_PIXELS,) their grey.
        J: (12, MOST_PIXELS + LANES) whitened derivatives, residuals, an empty row.
        residual: (MOST_PIXELS + LANES,) the row of J that holds the residuals, whitened.
        left: (MOST_PIXELS,) what the last step leaves of the residuals.
        inside: (MOST_PIXELS,) share of disc.
        H: (10, 10) normal matrix.
        g: (10,) right side.
        L: (10, 10) factor of H.
        scale: (10,) inverse square roots of its diagonal.
        x: (10,) solution.
        at: (10,) parameters, the centre relative to the pixels' origin.
        shapes: (4, 5) ellipses.
        sectors: (2, 16) of the rim.
        trial: (10,) parameters tried.
        start: (10,) parameters begun with.
        products: (2, 13) of a gradient inside.
        sums: (12, 12) products of the rows of J.
    """

    px: Floats
    py: Floats
    level: Floats
    J: Floats
    residual: Floats
    left: Floats
    inside: Floats
    H: Array
    g: Array
    L: Array
    scale: Array
    x: Array
    at: Floats
    shapes: Array
    sectors: Array
    trial: Array
    start: Array
    products: Array
    sums: Array


def _aligned(rows: int, columns: int) -> Floats:
    """Return zeros (rows, columns) that begin with a cache line: vectors across two lines take half as long again."""
    room = np.zeros(rows * columns + _LINE, np.float32)
    first = -room.ctypes.data // 4 % _LINE
    return room[first : first + rows * columns].reshape(rows, columns)


def workspace() -> Work:
    """Return room for fits."""
    n = UNKNOWNS
    px, py, level, left, inside = _aligned(5, MOST_PIXELS)
    J = _aligned(n + 2, MOST_PIXELS + LANES)
    return Work(
        px, py, level, J, J[n], left, inside,
        np.empty((n, n)), np.empty(n), np.empty((n, n)), np.empty(n), np.empty(n), np.empty(n, np.float32),
        np.empty((4, 5)), np.empty((2, 16)), np.empty(n), np.empty(n), np.empty((2, 13)), np.empty((n + 2, n + 2)),
    )  # fmt: skip


@numba.njit(cache=True, error_model="numpy", fastmath=True)
def linearise(n: int, slope: int, texture: float, work: Work) -> float:
    """Fill whitened residual, J and share of disc of the first n pixels at ``work.at``.

    Args:
        n: how many.
        slope: what the gradient is one of: LIGHT, SURROUND, STRAY.
        texture: variance of the surround over the noise's.
        work: the pixels, and room.

    Returns:
        The sum of the squared residuals.
    """
    px, py, level, J, residual, inside = work.px, work.py, work.level, work.J, work.residual, work.inside
    cx, cy, m11, m12, m22, blur, contrast, base, gx, gy = work.at
    i_blur = _ONE / blur
    square = _ZERO
    v_texture = F(texture)
    most = max(abs(base), abs(base + contrast), _ONE)
    k_out = base / most if slope == LIGHT else _ONE
    k_in = (base + contrast) / most if slope == LIGHT else (_ONE if slope == STRAY else _ZERO)
    for i in range(n):
        u, v = px[i] - cx, py[i] - cy
        mu, mv = m11 * u + m12 * v, m12 * u + m22 * v
        q = u * mu + v * mv + F(1e-12)
        i_slope = _ONE / np.sqrt(mu * mu + mv * mv + F(1e-12))
        s = np.sqrt(q)
        z = (_ONE - s) * s * i_slope * i_blur
        z = min(max(z, -_FIVE), _FIVE)
        # exp(-z^2/2) as the 8th power of its series, the normal distribution by Abramowitz and Stegun 26.2.17.
        t = z * z
        e = _E0 + t * (_E1 + t * (_E2 + t * (_E3 + t * (_E4 + t * _E5))))
        e = e * e
        e = e * e
        e = e * e
        density = _ROOT * e
        a = abs(z)
        b = _ONE / (_ONE + _P * a)
        tail = density * b * (_B1 + b * (_B2 + b * (_B3 + b * (_B4 + b * _B5))))
        share = _HALF + np.copysign(_HALF - tail, z)
        rest = _ONE - share
        w = _ONE / np.sqrt(_ONE + v_texture * rest * rest)
        k = k_in * share + k_out * rest
        inside[i] = share
        left = w * (level[i] - base - k * (gx * u + gy * v) - contrast * share)
        residual[i] = left
        square += left * left
        steep = w * contrast * density * i_blur
        J[0, i] = steep * mu * i_slope
        J[1, i] = steep * mv * i_slope
        along = -_HALF * steep * i_slope
        J[2, i] = along * u * u
        J[3, i] = F(2.0) * along * u * v
        J[4, i] = along * v * v
        J[5, i] = -steep * z
        J[6, i] = w * share
        J[7, i] = w
        J[8, i] = w * k * u
        J[9, i] = w * k * v
    return float(square)


@numba.njit(cache=True, error_model="numpy")
def normal_equations(n: int, work: Work) -> None:
    """Fill H = J J^T (10, 10), its lower half, and g = J residual (10,), of the first n pixels."""
    J, H, g, sums = work.J, work.H, work.g, work.sums
    full = (n + LANES - 1) // LANES * LANES
    for a in range(UNKNOWNS + 1):
        J[a, n:full] = _ZERO
    products(full, J, sums)
    for a in range(UNKNOWNS):
        g[a] = sums[UNKNOWNS, a]
        for b in range(a + 1):
            H[a, b] = sums[a, b]


@numba.njit(cache=True, error_model="numpy")
def factor(H: Array, L: Array, scale: Array) -> bool:
    """Factor H as D L L^T D; False where it is not positive definite.

    Divisions are dear: ``scale`` (n,) is filled with the inverse of D's diagonal, and L's diagonal with its own inverse.
    """
    n = len(H)
    for a in range(n):
        if not H[a, a] > 0.0:
            return False
        scale[a] = 1.0 / np.sqrt(H[a, a])
    for a in range(n):
        for b in range(a):
            total = H[a, b] * scale[a] * scale[b]
            for k in range(b):
                total -= L[a, k] * L[b, k]
            L[a, b] = total * L[b, b]
        total = 1.0
        for k in range(a):
            total -= L[a, k] * L[a, k]
        if not total > 1e-9:
            return False
        L[a, a] = 1.0 / np.sqrt(total)
    return True


@numba.njit(cache=True, error_model="numpy")
def solve(L: Array, scale: Array, g: Array, x: Array) -> None:
    """Solve H x = g with the factors of :func:`factor`."""
    n = len(g)
    for a in range(n):
        total = g[a] * scale[a]
        for k in range(a):
            total -= L[a, k] * x[k]
        x[a] = total * L[a, a]
    for a in range(n - 1, -1, -1):
        total = x[a]
        for k in range(a + 1, n):
            total -= L[k, a] * x[k]
        x[a] = total * L[a, a]
    for a in range(n):
        x[a] *= scale[a]
