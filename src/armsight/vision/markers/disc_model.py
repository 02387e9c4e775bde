"""What the pixels of a disc should be, and how they change with its parameters.

A disc's image is modelled as

    I(x) = B + C Phi(d(x) / s) + g (x - c) k(x)

with d the distance inside the rim of the ellipse (x - c)^T M (x - c) = 1 (to first order, Sampson 1982), Phi the normal
distribution that lens and pixel blur the edge with, B the surround's level, C the contrast and g a gradient. Ten unknowns:
c, M, s, C, B, g. A surround that is uneven itself leaves the disc flat (k = 1 - Phi), uneven light slopes disc and
surround in proportion to their levels, stray light both alike (k = 1).

Pixels near the rim tell c; of the rows that show flat ones, which tell B, C and g only, one in three to eighteen is taken
whole. Loops run over one array of float32 for each quantity, so that the compiler makes vectors of them.
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
#: How far from the rim pixels tell about it, in blurs; a ring beyond, px, tells the surround.
_NEAR, _RING_PX = 3.4, 4.0

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


@numba.njit(cache=True, error_model="numpy")
def _chord(v: float, s: Array) -> tuple[float, float]:
    """Return middle and half length of the chord at height v of an ellipse that :func:`_grown` filled; half < 0: none."""
    rest = s[2] - v * v
    if rest <= 0.0:
        return 0.0, -1.0
    return s[3] * v, s[4] * np.sqrt(rest)


@numba.njit(cache=True, error_model="numpy")
def _grown(shape: Array, by: float, out: Array) -> None:
    """Fill the ellipse whose half axes are longer by ``by``, not below zero: S11, S12, S22, its chords' lean and length."""
    mean, half = (shape[0] + shape[2]) / 2, (shape[0] - shape[2]) / 2
    root = np.sqrt(half * half + shape[1] * shape[1])
    major, minor = np.sqrt(mean + root), np.sqrt(max(mean - root, 1e-6))
    a, b = max(major + by, 0.01) ** 2, max(minor + by, 0.01) ** 2
    c, s = (half / root, shape[1] / root) if root > 1e-9 * mean else (1.0, 0.0)
    out[0], out[1], out[2] = (a + b + (a - b) * c) / 2, (a - b) * s / 2, (a + b - (a - b) * c) / 2
    out[3], out[4] = out[1] / out[2], np.sqrt(a * b) / out[2]


@numba.njit(cache=True, error_model="numpy", forceinline=True)
def _take(image: NDArray[np.uint8], y: int, first: int, end: int, x0: int, y0: int, n: int, work: Work) -> int:
    """Append the pixels first <= x < end of a row; return the new count."""
    count = max(min(end - first, MOST_PIXELS - n), 0)
    px, py, level, line = work.px[n : n + count], work.py[n : n + count], work.level[n : n + count], image[y, first:end]
    row, column = F(y - y0), np.int32(first - x0)
    for i in range(count):
        px[i] = F(column + np.int32(i))
        py[i] = row
        level[i] = F(line[i])
    return n + count


@numba.njit(cache=True, error_model="numpy")
def gather(image: NDArray[np.uint8], theta: Array, work: Work) -> tuple[int, int]:
    """Collect the pixels that tell about a disc: px, py relative to the nearest pixel of the centre, and their grey.

    Args:
        image: (H, W) grey.
        theta: (10,) parameters of the disc as far as they are known.
        work: room; px, py and level are filled.

    Returns:
        How many, -1 where the disc and its rim are not all inside the image; and how many of them, the first, are every
        third row, enough for a first step.
    """
    height, width = image.shape
    x0, y0 = int(np.rint(theta[0])), int(np.rint(theta[1]))
    det = theta[2] * theta[4] - theta[3] * theta[3]
    s, outer, ring, hole = work.shapes
    s[0], s[1], s[2] = theta[4] / det, -theta[3] / det, theta[2] / det
    rim = 1.5 * theta[5] + 0.5
    half_w, half_h = np.sqrt(s[0]) + rim, np.sqrt(s[2]) + rim
    if x0 < half_w or y0 < half_h or x0 + half_w > width - 1 or y0 + half_h > height - 1:
        return -1, -1
    near = _NEAR * theta[5] + 0.5
    _grown(s, near, outer)
    _grown(s, near + _RING_PX, ring)
    _grown(s, -near, hole)
    size = np.sqrt(np.sqrt(s[0] * s[2] - s[1] * s[1]))
    # Of every third row, one in so many is taken with its flat pixels.
    flat = 1 if size < 7.0 else (2 if size < 12.0 else 3 if size < 18.0 else 6)
    stride = 1 + int(6.3 * (2 * size * near + 0.25 * size * size / flat) / MOST_PIXELS)
    reach = int(np.sqrt(ring[2]))
    top, bottom = max(0, y0 - reach), min(height - 1, y0 + reach)
    n = 0
    for turn in range(3):
        for y in range(top + turn * stride, bottom + 1, 3 * stride):
            whole = turn == 0 and ((y - top) // stride) % flat == 0
            v = y - theta[1]
            middle, half = _chord(v, ring if whole else outer)
            if half < 0.0:
                continue
            first, end = max(0, int(theta[0] + middle - half) + 1), min(width, int(theta[0] + middle + half) + 1)
            middle, half = _chord(v, hole)
            if whole or half < 2.0:
                n = _take(image, y, first, end, x0, y0, n, work)
            else:
                n = _take(image, y, first, int(theta[0] + middle - half) + 1, x0, y0, n, work)
                n = _take(image, y, int(theta[0] + middle + half), end, x0, y0, n, work)
        if turn == 0:
            sample = n
    return n, sample


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


@numba.njit(cache=True, error_model="numpy", fastmath=True)
def inside_products(n: int, cx: np.float32, cy: np.float32, work: Work, out: Array) -> None:
    """Fill the products of the columns of a gradient of the disc's own, u and v times its share.

    Args:
        n: pixels.
        cx: the centre, as the pixels have it.
        cy: see cx.
        work: the pixels, linearised.
        out: (2, 13) filled: with each column of J, with the residual, with u and with v.
    """
    px, py, J, residual = work.px, work.py, work.J, work.residual
    uu, uv, vv, ru, rv = _ZERO, _ZERO, _ZERO, _ZERO, _ZERO
    for i in range(n):
        share = J[6, i]
        u, v = share * (px[i] - cx), share * (py[i] - cy)
        ru += u * residual[i]
        rv += v * residual[i]
        uu += u * u
        uv += u * v
        vv += v * v
    for a in range(UNKNOWNS):
        total_u, total_v = _ZERO, _ZERO
        for i in range(n):
            weighed = J[6, i] * J[a, i]
            total_u += weighed * (px[i] - cx)
            total_v += weighed * (py[i] - cy)
        out[0, a], out[1, a] = total_u, total_v
    out[0, 10], out[1, 10] = ru, rv
    out[0, 11], out[0, 12], out[1, 11], out[1, 12] = uu, uv, uv, vv
