"""The centre of one disc to the limit that the image's noise sets, and the reasons why something is not a disc.

A disc's image is modelled as

    I(x) = B + C Phi(d(x) / s) + g (x - c) k(x)

with d the distance inside the rim of the ellipse (x - c)^T M (x - c) = 1 (to first order, Sampson 1982), Phi the normal
distribution that models the blur of the edge by lens and pixel, B the surround's level, C the contrast and g a
gradient. There are ten unknowns: c, M, s, C, B, g. A surround that is uneven itself leaves the disc flat (k = 1 - Phi),
uneven light slopes disc and surround in proportion to their levels, veiling glare slopes both alike (k = 1).

The method is Gauss-Newton: a first step on a third of the rows, then all rows until the centre converges. Where the
surround is textured, its own variance reduces the weight of its pixels. The fit takes the disc as flat and reports what a
gradient of its own would change (a score test); :mod:`~armsight.vision.markers.disc.common` compares the discs of an
image. The residuals reject look-alikes: those of the rim, those of the inside, and gradients that the model lacks.

The file follows the fit: the work space, the model and its derivatives, the normal equations, the choice of pixels
(those near the rim determine the position; of the rows that cross flat areas, which determine only levels and gradient,
one in three to eighteen is used in full), the measures of the residuals, and last :func:`fit` itself.

Loops run over one array of float32 for each quantity, so that the compiler can vectorise them (SIMD).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array
from armsight.kernels import kernel, kernel_types
from armsight.vision.normal import SIMD_WIDTH, products

#: Most pixels that one fit takes; of larger discs every second, third ... row is.
MOST_PIXELS = 3072
#: Most discs of an image.
MOST_DISCS = 16384
#: Unknowns: c (2), M (3), s, C, B, g (2).
UNKNOWNS = 10
#: What a fit shows of noise and light, and where its parameters are in it, what a skewed edge and a level surround do.
PARAMETERS = 14
SKEWED, LEVELLED, SHOWN = (PARAMETERS + UNKNOWNS + more for more in (0, 3, 9))
#: Floats in a cache line.
_LINE = 16

#: Kinds of gradient; GLARE is light that is added to disc and surround alike.
LIGHT, SURROUND, GLARE = range(3)

F = np.float32
_E0, _E1, _E2, _E3, _E4, _E5 = (F(x) for x in (1.0, -1 / 16, 1 / 512, -1 / 24576, 1 / 1572864, -1 / 125829120))
_P = F(0.2316419)
_B1, _B2, _B3, _B4, _B5 = (F(x) for x in (0.31938153, -0.356563782, 1.781477937, -1.821255978, 1.330274429))
_ROOT = F(0.3989422804014327)
_ZERO, _HALF, _ONE, _FIVE = F(0.0), F(0.5), F(1.0), F(5.0)

Floats = NDArray[np.float32]


@kernel_types(
    "f4[::1], f4[::1], f4[::1], f4[:, ::1], f4[::1], f4[::1], f4[::1], f8[:, ::1], f8[::1], f8[:, ::1], "
    "f8[::1], f8[::1], f4[::1], f8[:, ::1], f8[:, ::1], f8[::1], f8[::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[::1], "
    "f8[:, ::1]"
)
class FitBuffers(NamedTuple):
    """The buffers of a fit; one set for each thread.

    Attributes:
        px: (MOST_PIXELS,) columns of the pixels, relative to the nearest pixel of the centre.
        py: (MOST_PIXELS,) their rows.
        level: (MOST_PIXELS,) their grey.
        J: (12, MOST_PIXELS + SIMD_WIDTH) whitened derivatives, residuals, an empty row.
        residual: (MOST_PIXELS + SIMD_WIDTH,) the row of J that holds the residuals, whitened.
        left: (MOST_PIXELS,) the residuals after the last step.
        inside: (MOST_PIXELS,) share of disc.
        H: (10, 10) normal matrix.
        g: (10,) right side.
        L: (10, 10) factor of H.
        scale: (10,) inverse square roots of its diagonal.
        x: (10,) solution.
        at: (10,) parameters, the centre relative to the pixels' origin.
        shapes: (4, 5) ellipses.
        sectors: (2, 16) of the rim.
        trial: (10,) trial parameters.
        start: (10,) parameters at the start.
        products: (2, 13) of a gradient inside.
        solved: (2, 10) solutions of :func:`solve_two`.
        sums: (12, 12) products of the rows of J.
        shown: (SHOWN,) what the last fit shows of noise and light: its rim (power, see :func:`rim_power`; mean
            square of the sectors' deviations beyond white noise, px^2; 1 / power of white noise), a gradient inside
            (9, see :func:`slope_inside`), :func:`texture_factor` of a textured surround (0 of another),
            by how much the other unknowns enlarge the variance of the centre, its parameters (10), a skewed edge (3, see
            :func:`skewed_edge`), a level surround (6, see :func:`levelled`).
        discs: (MOST_DISCS, SHOWN) the same for each disc of an image.
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
    solved: Array
    sums: Array
    shown: Array
    discs: Array


def _aligned(rows: int, columns: int) -> Floats:
    """Return zeros (rows, columns) aligned to a cache line: SIMD vectors across two lines take half as long again."""
    room = np.zeros(rows * columns + _LINE, np.float32)
    first = -room.ctypes.data // 4 % _LINE
    return room[first : first + rows * columns].reshape(rows, columns)


def workspace() -> FitBuffers:
    """Return the buffers for fits."""
    n = UNKNOWNS
    px, py, level, left, inside = _aligned(5, MOST_PIXELS)
    J = _aligned(n + 2, MOST_PIXELS + SIMD_WIDTH)
    return FitBuffers(
        px, py, level, J, J[n], left, inside,
        np.empty((n, n)), np.empty(n), np.empty((n, n)), np.empty(n), np.empty(n), np.empty(n, np.float32),
        np.empty((4, 5)), np.empty((2, 16)), np.empty(n), np.empty(n), np.empty((2, 13)), np.empty((2, n)),
        np.empty((n + 2, n + 2)), np.empty(SHOWN), np.empty((MOST_DISCS, SHOWN)),
    )  # fmt: skip


@kernel(fastmath=True)
def linearise(n: int, slope: int, texture: float, work: FitBuffers) -> float:
    """Fill whitened residual, J and share of disc of the first n pixels at ``work.at``; return the sum of squares.

    ``slope``: LIGHT, SURROUND or GLARE; ``texture``: variance of the surround beyond the noise's, over that; below
    zero: that of the disc, for shot noise.
    """
    px, py, level, J, residual, inside = work.px, work.py, work.level, work.J, work.residual, work.inside
    cx, cy, m11, m12, m22, blur, contrast, base, gx, gy = work.at
    i_blur = _ONE / blur
    square = _ZERO
    v_texture, v_disc = F(max(texture, 0.0)), F(max(-texture, 0.0))
    most = max(abs(base), abs(base + contrast), _ONE)
    k_out = base / most if slope == LIGHT else _ONE
    k_in = (base + contrast) / most if slope == LIGHT else (_ONE if slope == GLARE else _ZERO)
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
        w = _ONE / np.sqrt(_ONE + v_texture * rest * rest + v_disc * share)
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


@kernel
def normal_equations(n: int, work: FitBuffers) -> None:
    """Fill H = J J^T (10, 10), its lower half, and g = J residual (10,), of the first n pixels."""
    J, H, g, sums = work.J, work.H, work.g, work.sums
    full = (n + SIMD_WIDTH - 1) // SIMD_WIDTH * SIMD_WIDTH
    for a in range(UNKNOWNS + 1):
        J[a, n:full] = _ZERO
    products(full, J, sums)
    for a in range(UNKNOWNS):
        g[a] = sums[UNKNOWNS, a]
        for b in range(a + 1):
            H[a, b] = sums[a, b]


@kernel
def factor(H: Array, L: Array, scale: Array) -> bool:
    """Factor H as D L L^T D; False where it is not positive definite.

    Divisions are slow: ``scale`` (n,) receives the inverse of D's diagonal, and L's diagonal its own inverse.
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


@kernel
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


@kernel
def solve_two(L: Array, scale: Array, g: Array, x: Array) -> None:
    """Solve as :func:`solve` does for two right sides, the first columns of g (2, .), at once: x (2, n)."""
    n = len(scale)
    for a in range(n):
        p, q = g[0, a] * scale[a], g[1, a] * scale[a]
        for k in range(a):
            p -= L[a, k] * x[0, k]
            q -= L[a, k] * x[1, k]
        x[0, a], x[1, a] = p * L[a, a], q * L[a, a]
    for a in range(n - 1, -1, -1):
        p, q = x[0, a], x[1, a]
        for k in range(a + 1, n):
            p -= L[k, a] * x[0, k]
            q -= L[k, a] * x[1, k]
        x[0, a], x[1, a] = p * L[a, a], q * L[a, a]
    for a in range(n):
        x[0, a] *= scale[a]
        x[1, a] *= scale[a]


#: Distance from the rim, in blurs, within which pixels depend on it; width, px, of a ring beyond that shows the
#: surround.
_NEAR, _RING_PX = 3.4, 4.0


@kernel
def _chord(v: float, s: Array) -> tuple[float, float]:
    """Return middle and half length of the chord at height v of an ellipse of :func:`_enlarged`; half < 0: none."""
    rest = s[2] - v * v
    if rest <= 0.0:
        return 0.0, -1.0
    return s[3] * v, s[4] * np.sqrt(rest)


@kernel
def _enlarged(shape: Array, by: float, out: Array) -> None:
    """Fill the ellipse with half axes longer by ``by``, not below zero: S11, S12, S22, slope and length of its chords."""
    mean, half = (shape[0] + shape[2]) / 2, (shape[0] - shape[2]) / 2
    root = np.sqrt(half * half + shape[1] * shape[1])
    major, minor = np.sqrt(mean + root), np.sqrt(max(mean - root, 1e-6))
    a, b = max(major + by, 0.01) ** 2, max(minor + by, 0.01) ** 2
    c, s = (half / root, shape[1] / root) if root > 1e-9 * mean else (1.0, 0.0)
    out[0], out[1], out[2] = (a + b + (a - b) * c) / 2, (a - b) * s / 2, (a + b - (a - b) * c) / 2
    out[3], out[4] = out[1] / out[2], np.sqrt(a * b) / out[2]


@kernel(forceinline=True)
def _append(image: NDArray[np.uint8], y: int, first: int, end: int, x0: int, y0: int, n: int, work: FitBuffers) -> int:
    """Append the pixels first <= x < end of a row; return the new count."""
    count = max(min(end - first, MOST_PIXELS - n), 0)
    px, py, level, line = work.px[n : n + count], work.py[n : n + count], work.level[n : n + count], image[y, first:end]
    row, column = F(y - y0), np.int32(first - x0)
    for i in range(count):
        px[i] = F(column + np.int32(i))
        py[i] = row
        level[i] = F(line[i])
    return n + count


@kernel
def gather(image: NDArray[np.uint8], theta: Array, work: FitBuffers) -> tuple[int, int]:
    """Collect the pixels of a disc, theta (10,): px, py from the nearest pixel of the centre, and their grey.

    Return their number, -1 where the disc and its rim are not completely inside the image; and how many of them, the
    first, are of every third row, enough for a first step.
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
    _enlarged(s, near, outer)
    _enlarged(s, near + _RING_PX, ring)
    _enlarged(s, -near, hole)
    size = np.sqrt(np.sqrt(s[0] * s[2] - s[1] * s[1]))
    # Of every third row, one in so many is taken with its flat pixels.
    flat = 1 if size < 7.0 else (2 if size < 12.0 else 3 if size < 18.0 else 6)
    stride = 1 + int(6.3 * (2 * size * near + 0.25 * size * size / flat) / MOST_PIXELS)
    reach = int(np.sqrt(ring[2]))
    top, bottom = max(0, y0 - reach), min(height - 1, y0 + reach)
    n = 0
    for third in range(3):
        for y in range(top + third * stride, bottom + 1, 3 * stride):
            whole = third == 0 and ((y - top) // stride) % flat == 0
            v = y - theta[1]
            middle, half = _chord(v, ring if whole else outer)
            if half < 0.0:
                continue
            first, end = max(0, int(theta[0] + middle - half) + 1), min(width, int(theta[0] + middle + half) + 1)
            middle, half = _chord(v, hole)
            if whole or half < 2.0:
                n = _append(image, y, first, end, x0, y0, n, work)
            else:
                n = _append(image, y, first, int(theta[0] + middle - half) + 1, x0, y0, n, work)
                n = _append(image, y, int(theta[0] + middle + half), end, x0, y0, n, work)
        if third == 0:
            sample = n
    return n, sample


#: Sectors in which the rim is evaluated.
SECTORS = 16


@kernel(fastmath=True)
def spread(n: int, work: FitBuffers, flat: Array) -> None:
    """Fill the mean squares of the residuals inside and outside, away from the rim, and their counts (4,)."""
    residual, inside = work.residual, work.inside
    square_in, square_out, count_in, count_out = F(0.0), F(0.0), F(0.0), F(0.0)
    for i in range(n):
        square = residual[i] * residual[i]
        disc = F(1.0) if inside[i] > F(0.995) else F(0.0)
        surround = F(1.0) if inside[i] < F(0.005) else F(0.0)
        square_in += disc * square
        square_out += surround * square
        count_in += disc
        count_out += surround
    flat[0], flat[1] = square_in / max(count_in, F(1.0)), square_out / max(count_out, F(1.0))
    flat[2], flat[3] = count_in, count_out


@kernel
def inside_noise(n: int, work: FitBuffers) -> float:
    """Return the variance of the noise inside the disc, from the differences of the residuals of neighbours in a row."""
    px, py, residual, inside = work.px, work.py, work.residual, work.inside
    square, count = 0.0, 0
    for i in range(n - 1):
        if inside[i] > F(0.995) and inside[i + 1] > F(0.995) and py[i + 1] == py[i] and px[i + 1] == px[i] + _ONE:
            step = residual[i + 1] - residual[i]
            square += step * step
            count += 1
    return 0.5 * square / max(count, 1)


@kernel(fastmath=True)
def clipped(n: int, work: FitBuffers) -> int:
    """Count the pixels that are black or white to the last level."""
    level, count = work.level, np.int32(0)
    for i in range(n):
        count += np.int32(1) if level[i] <= F(0.0) or level[i] >= F(255.0) else np.int32(0)
    return int(count)


@kernel(fastmath=True)
def _stepped(n: int, work: FitBuffers) -> None:
    """Fill ``work.left``, the residuals after the last step; ``work.residual`` is before it."""
    residual, J, left = work.residual, work.J, work.left
    x0, x1, x2, x3, x4, x5, x6, x7, x8, x9 = work.x.astype(np.float32)
    for i in range(n):
        shape = x2 * J[2, i] + x3 * J[3, i] + x4 * J[4, i] + x5 * J[5, i]
        light = x6 * J[6, i] + x7 * J[7, i] + x8 * J[8, i] + x9 * J[9, i]
        left[i] = residual[i] - x0 * J[0, i] - x1 * J[1, i] - shape - light


@kernel
def rim(n: int, theta: Array, x0: float, y0: float, work: FitBuffers, sectors: Array) -> None:
    """Fill, for each sixteenth of the rim, its distance outside the ellipse, px, and the weight of that (2, 16)."""
    px, py, J, inside = work.px, work.py, work.J, work.inside
    sectors[:, :] = 0.0
    cx, cy = F(theta[0] - x0), F(theta[1] - y0)
    left = work.left
    _stepped(n, work)
    for i in range(n):
        if F(0.03) < inside[i] < F(0.97):
            square = J[0, i] * J[0, i] + J[1, i] * J[1, i]
            u, v = px[i] - cx, py[i] - cy
            a, b = abs(u), abs(v)
            k = 8 * (u > F(0.0)) + 4 * (v > F(0.0)) + 2 * (a > b) + (min(a, b) > F(0.41421356) * max(a, b))
            sectors[0, k] += np.sqrt(square) * left[i]
            sectors[1, k] += square
    for k in range(SECTORS):
        sectors[0, k] /= max(sectors[1, k], 1e-12)


@kernel
def off_ellipse(variance: float, work: FitBuffers) -> tuple[float, float, int]:
    """Compare the deviations of the rim's sectors, as :func:`rim` fills them, with white noise of a variance.

    Return the sum of the squared deviations beyond white noise, px^2; its variance; number of sectors.
    """
    sectors, off, chance, count = work.sectors, 0.0, 0.0, 0
    for k in range(SECTORS):
        if sectors[1, k] > 0.0:
            expected = variance / sectors[1, k]
            off += sectors[0, k] ** 2 - expected
            chance += 2.0 * expected * expected
            count += 1
    return off, chance, count


#: Harmonics of the rim that :func:`rim_power` adds, two degrees of freedom each: 3, 5 and 7.
HARMONICS = 3
#: Blur of the noise along a rim over that of its edge, squared: the lens blurs the edge only, the processing both; and the
#: most by which it is made up for.
_NOISE_BLUR, _MOST_BLURRED = 0.25, 1.0


@kernel(fastmath=True)
def rim_power(n: int, theta: Array, x0: float, y0: float, variance: float, work: FitBuffers) -> tuple[float, float]:
    """Measure by how much the rim deviates from the ellipse in its harmonics 3, 5 and 7.

    The centre moves with the first harmonic of what noise does along the rim. The odd ones after the ellipse's own (0, 1
    and 2) show how much of that there is where noise is correlated between neighbours, by a demosaic, a filter, a
    compression, or depends on how the rim lies on their grid. The even ones do not count: the pixel grid has them, in all
    discs alike, and moves no centre with them. What exceeds white noise, of ``variance`` as the residuals have it, is
    raised where it is shorter than the noise's blur.

    Returns Their power, px^3: the variance of the rim's displacement, px^2, times the length of rim that moves as one, but
    for a factor; and how many times smaller it is than the variance of the residuals where they are white, 1/px^3.
    """
    px, py, J, left = work.px, work.py, work.J, work.left
    cx, cy, r00 = F(theta[0] - x0), F(theta[1] - y0), F(np.sqrt(theta[2]))
    r01 = F(theta[3]) / r00
    r11 = F(np.sqrt(theta[4] - r01 * r01))
    c3, s3, c5, s5, c7, s7, white = _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO
    for i in range(n):
        x = r00 * (px[i] - cx) + r01 * (py[i] - cy)
        y = r11 * (py[i] - cy)
        scale = _ONE / np.sqrt(x * x + y * y + F(1e-12))
        x *= scale
        y *= scale
        square = J[0, i] * J[0, i] + J[1, i] * J[1, i]
        a = np.sqrt(square) * left[i]
        white += square
        x2, y2 = x * x - y * y, F(2.0) * x * y
        x3, y3 = x2 * x - y2 * y, x2 * y + y2 * x
        x5, y5 = x3 * x2 - y3 * y2, x3 * y2 + y3 * x2
        c3 += a * x3
        s3 += a * y3
        c5 += a * x5
        s5 += a * y5
        c7 += a * (x5 * x2 - y5 * y2)
        s7 += a * (x5 * y2 + y5 * x2)
    radius = (theta[2] * theta[4] - theta[3] * theta[3]) ** -0.25
    blurred, total = _NOISE_BLUR * (theta[5] / radius) ** 2, 0.0
    for h, square in ((3, c3 * c3 + s3 * s3), (5, c5 * c5 + s5 * s5), (7, c7 * c7 + s7 * s7)):
        total += square + (np.exp(min(blurred * h * h, _MOST_BLURRED)) - 1.0) * (square - variance * white)
    white = max(white, F(1e-12))
    return float(total / (white * white)) * radius / HARMONICS, float(white) / radius


@kernel
def texture_factor(n: int, blur: float, texture: float, work: FitBuffers) -> float:
    """Return the factor by which the centre's variance grows because neighbouring pixels of a texture are correlated.

    The correlation of neighbours, k, gives (1 + k) / (1 - k) pixels that vary as one along the rim, and at most the
    width of the edge across it; it counts by the texture's share in the information about the centre.
    """
    px, py, J, residual, inside = work.px, work.py, work.J, work.residual, work.inside
    square, product = 0.0, 0.0
    by_texture, by_all = 0.0, 1e-12
    for i in range(n):
        if inside[i] < F(0.005):
            square += residual[i] * residual[i]
            if i + 1 < n and py[i + 1] == py[i] and px[i + 1] == px[i] + F(1.0):
                product += residual[i] * residual[i + 1]
        information = J[0, i] * J[0, i] + J[1, i] * J[1, i]
        rest = 1.0 - inside[i]
        by_texture += information * texture * rest * rest / (1.0 + texture * rest * rest)
        by_all += information
    k = min(max(product / max(square, 1e-12), 0.0), 0.95)
    along = (1.0 + k) / (1.0 - k)
    return 1.0 + (along * min(along, 1.0 + 2.0 * blur) - 1.0) * by_texture / by_all


@kernel
def of_centre(work: FitBuffers, cov: Array) -> None:
    """Fill the centre's (2, 2) block of H^-1; its rows are in ``work.solved``."""
    work.products[:] = 0.0
    work.products[0, 0], work.products[1, 1] = 1.0, 1.0
    solve_two(work.L, work.scale, work.products, work.solved)
    cov[:, :] = work.solved[:, :2]


@kernel(fastmath=True)
def _inside_products(n: int, cx: np.float32, cy: np.float32, work: FitBuffers, out: Array) -> None:
    """Fill the products of the columns of a gradient inside the disc, u and v times its share, about (cx, cy).

    out (2, 13): with each column of J, with the residual, with u and with v.
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


#: Least grey level of a disc for relative gradients.
_LEAST_LEVEL = 8.0


@kernel
def slope_inside(n: int, theta: Array, x0: float, y0: float, variance: float, work: FitBuffers) -> None:
    """Estimate a gradient inside the disc beside the ten unknowns, and what it would do to the centre.

    One step of the twelve unknowns, in which the model is nearly linear (Schur complement of the two that are new).
    ``work.shown`` is filled from 3 on: the gradient over the disc's level, 1/px (2); its information, px^2, as
    elements 00, 01, 11 (3); by how much the fitted centre is off for each of it, px^2 (2, 2). Without information: zeros.
    ``theta``: (10,) converged; (x0, y0): the pixels' origin; ``variance``: of the noise, as the residuals have it;
    ``work``: the n pixels, linearised, with the last step in ``work.x``.
    """
    x, solved, out, shown = work.x, work.solved, work.products, work.shown
    _inside_products(n, F(theta[0] - x0), F(theta[1] - y0), work, out)
    s0, s1 = out[0, 10], out[1, 10]
    k00, k01, k11 = out[0, 11], out[0, 12], out[1, 12]
    # The residual is the one before the last step x = H^-1 g; then the part of the columns that J does not explain.
    for a in range(UNKNOWNS):
        s0 -= out[0, a] * x[a]
        s1 -= out[1, a] * x[a]
    level = max(theta[6] + theta[7], _LEAST_LEVEL)
    solve_two(work.L, work.scale, out, solved)
    shown[8], shown[9], shown[10], shown[11] = (
        level * solved[0, 0],
        level * solved[0, 1],
        level * solved[1, 0],
        level * solved[1, 1],
    )
    for a in range(UNKNOWNS):
        k00 -= out[0, a] * solved[0, a]
        k01 -= out[1, a] * solved[0, a]
        k11 -= out[1, a] * solved[1, a]
    det = k00 * k11 - k01 * k01
    if not det > 0.0:
        shown[3:12] = 0.0
        return
    shown[3], shown[4] = (k11 * s0 - k01 * s1) / (det * level), (k00 * s1 - k01 * s0) / (det * level)
    information = level * level / variance
    shown[5], shown[6], shown[7] = k00 * information, k01 * information, k11 * information


@kernel(fastmath=True)
def _skew_products(n: int, work: FitBuffers) -> None:
    """Fill ``work.products`` with the products of the two columns of :func:`skewed_edge`, as for a gradient inside.

    The columns are (z^2 - 1) times the derivatives by the centre. The pixels' grey levels are overwritten.
    """
    J, left, weight, out = work.J, work.left, work.level, work.products
    for i in range(n):
        weight[i] = J[5, i] * J[5, i] / (J[0, i] * J[0, i] + J[1, i] * J[1, i] + F(1e-12)) - _ONE
    for a in range(UNKNOWNS):
        total_u, total_v = _ZERO, _ZERO
        for i in range(n):
            weighed = weight[i] * J[a, i]
            total_u += weighed * J[0, i]
            total_v += weighed * J[1, i]
        out[0, a], out[1, a] = total_u, total_v
    uu, uv, vv, ru, rv = _ZERO, _ZERO, _ZERO, _ZERO, _ZERO
    for i in range(n):
        u, v = weight[i] * J[0, i], weight[i] * J[1, i]
        ru += u * left[i]
        rv += v * left[i]
        uu += u * u
        uv += u * v
        vv += v * v
    out[0, 10], out[1, 10] = ru, rv
    out[0, 11], out[0, 12], out[1, 11], out[1, 12] = uu, uv, uv, vv


@kernel
def skewed_edge(n: int, variance: float, work: FitBuffers) -> None:
    """Estimate by how much the centre would move if the edge's profile were skewed towards one side of the image.

    A lens with coma, a shaken exposure or a lens model that the rim bends makes the edge steeper on one side. To first
    order (Edgeworth) the profile Phi(z) then has -k (z^2 - 1) phi(z) besides, with k the part of a vector along the rim's
    normal. One step of the twelve unknowns, as in :func:`slope_inside`. ``work.shown`` is filled from SKEWED on: the
    centre's shift, px (2); by how much chi-square falls, in the noise's variance.
    """
    x, out, shown = work.solved, work.products, work.shown
    _skew_products(n, work)
    s0, s1, k00, k01, k11 = out[0, 10], out[1, 10], out[0, 11], out[0, 12], out[1, 12]
    solve_two(work.L, work.scale, out, x)
    for a in range(UNKNOWNS):
        k00 -= out[0, a] * x[0, a]
        k01 -= out[1, a] * x[0, a]
        k11 -= out[1, a] * x[1, a]
    det = k00 * k11 - k01 * k01
    shown[SKEWED:] = 0.0
    if det > 0.0:
        along, across = (k11 * s0 - k01 * s1) / det, (k00 * s1 - k01 * s0) / det
        for a in range(2):
            shown[SKEWED + a] = -(x[0, a] * along + x[1, a] * across)
        shown[SKEWED + 2] = (along * s0 + across * s1) / variance


@kernel
def levelled(theta: Array, variance: float, work: FitBuffers) -> None:
    """Find out what the fit would be with a level surround: without a gradient g, whose estimate noise has moved, too.

    Centre and gradient have errors in common, V_cg: the centre of the eight other unknowns alone is c - V_cg V_gg^-1 g.
    ``work.shown`` is filled from LEVELLED on: chi-square of g in the noise's variance; V_cg V_gg^-1 g, px (2); by how much
    the centre's covariance falls, V_cg V_gg^-1 V_gc, px^2, as elements 00, 01, 11 (3). ``theta``: (10,) converged;
    ``variance``: of the noise, grey levels^2; ``work``: as :func:`of_centre` leaves it.
    """
    L, scale, x, out = work.L, work.scale, work.solved, work.shown[LEVELLED:]
    # The last corner of the factor is that of the last two unknowns' information, the others marginalised.
    a, b = theta[8] / scale[8], theta[9] / scale[9]
    p, q = a / L[8, 8] + b * L[9, 8], b / L[9, 9]
    out[0] = (p * p + q * q) / variance
    u8, u9 = x[0, 8] / scale[8], x[0, 9] / scale[9]
    u8, u9 = u8 / L[8, 8] + u9 * L[9, 8], u9 / L[9, 9]
    v8, v9 = x[1, 8] / scale[8], x[1, 9] / scale[9]
    v8, v9 = v8 / L[8, 8] + v9 * L[9, 8], v9 / L[9, 9]
    out[1], out[2] = u8 * p + u9 * q, v8 * p + v9 * q
    out[3], out[4], out[5] = (
        variance * (u8 * u8 + u9 * u9),
        variance * (u8 * v8 + u9 * v9),
        variance * (v8 * v8 + v9 * v9),
    )


_STEPS = 8
#: Least variance of a surround, grey levels^2, and how many times more that of a disc may be, for the weights.
_LEAST_VARIANCE, _MOST_SHOT_NOISE = 0.1, 10.0
#: A step of the centre after which the next one is negligible (a tenth of it at the most): px, and standard deviations
#: of the centre.
_SMALL_STEP_PX, _SMALL_STEP_SIGMAS = 0.02, 1.0
_BLUR_LEAST_PX = 0.2
#: A step of the centre after which the residuals away from the rim give the surround's variance, px.
_WEIGH_PX = 0.3

#: Why a candidate is not a disc: code -> text. 0 is a disc.
CUT, NO_RIM, BLURRED, NARROW, NOT_ELLIPSE, FAINT, SMALL, HILLY, OPEN, NOT_UNIFORM, FOUND_TWICE = range(1, 12)
REASONS = {
    CUT: "cut by the image's border",
    NO_RIM: "no ellipse fits its rim",
    BLURRED: "its rim is not sharp enough for its size",
    NARROW: "too narrow for a disc seen at less than 75 degrees",
    NOT_ELLIPSE: "its rim is not that of an ellipse",
    FAINT: "too faint against the noise",
    SMALL: "smaller than 4 px across",
    HILLY: "its inside is not uniform: motion blur, or not a disc",
    OPEN: "open on one side",
    NOT_UNIFORM: "its surround is not uniform: text, a ring, a square of a board",
    FOUND_TWICE: "a duplicate of another disc",
}
#: Reasons of candidates that have a closed rim, those that look most like a disc first.
LOOK_ALIKES = (NOT_ELLIPSE, HILLY, CUT, NOT_UNIFORM, BLURRED, NARROW, FAINT)
_MOST_BLUR = 0.8  # of the smaller half axis
#: Smaller half axis over the larger one, at least.
LEAST_RATIO = 0.22
#: How far the sixteenths of the rim may deviate from the ellipse beyond noise, RMS: px, share of the size, and share of
#: the blur for each share of the contrast that residuals have beyond noise (a textured surround moves the rim).
_RIM_PX, _RIM_SHARE, _RIM_TEXTURE = 0.05, 0.005, 1.5
#: Standard deviations of that beyond which it is significant.
RIM_CHANCE = 4.0
#: Largest residuals beyond the image's noise, as a share of the contrast.
_MOST_RESIDUAL = 0.1
#: A centre that a textured surround makes less certain than this is rejected, px.
_MOST_SIGMA_PX = 0.2
#: Largest variation of the inside beyond the image's noise, as a share of the contrast.
UNEVEN = 0.12
_LEAST_SNR = 3.0


@kernel
def narrow(m11: float, m12: float, m22: float) -> bool:
    """Whether a matrix M, while it is fitted, is that of no ellipse, or its determinant is half the narrowest disc's."""
    return bool(not m11 * m22 - m12 * m12 > 0.5 * (LEAST_RATIO * (m11 + m22)) ** 2)


@kernel
def _step(
    n: int, theta: Array, x0: float, y0: float, slope: int, texture: float, work: FitBuffers
) -> tuple[float, float]:
    """Make one Gauss-Newton step on the first n pixels.

    Returns how far the centre moved, px, -1 where no step is possible; the sum of the squared residuals after the step.
    """
    H, g, L, scale, x, at = work.H, work.g, work.L, work.scale, work.x, work.at
    for a in range(UNKNOWNS):
        at[a] = theta[a]
    at[0], at[1] = theta[0] - x0, theta[1] - y0
    square = linearise(n, slope, texture, work)
    normal_equations(n, work)
    if not factor(H, L, scale):
        return -1.0, square
    solve(L, scale, g, x)
    shift = np.sqrt(x[0] * x[0] + x[1] * x[1])
    shrink = 1.0
    for a in (2, 4, 5):  # a blur or a shape at most halves or doubles
        if abs(x[a]) > 0.5 * theta[a]:
            shrink = min(shrink, 0.5 * theta[a] / abs(x[a]))
    if not shift * shift * (theta[2] + theta[4]) < 1.0:
        return -1.0, square
    for a in range(UNKNOWNS):
        theta[a] += shrink * x[a]
        square -= x[a] * g[a]
    theta[5] = max(theta[5], _BLUR_LEAST_PX)
    blurred = theta[5] * theta[5] * (theta[2] + theta[4]) > 2.0  # by more than its half axes' mean
    if blurred or narrow(theta[2], theta[3], theta[4]) or theta[6] * at[6] <= 0.0:
        return -1.0, square
    return (shift if shrink == 1.0 else max(shift, 1.0)), square


@kernel
def minimise(
    n: int, theta: Array, x0: float, y0: float, slope: int, noise_sigma: float, weigh: bool, texture: float,
    work: FitBuffers,
) -> tuple[float, float]:  # fmt: skip
    """Step until the centre converges; return the sum of squared residuals, -1 without a minimum, and the texture.

    ``weigh``: where surround or disc varies more than the other, reduce its weight; ``texture``: how it is reduced before.
    """
    flat, H = work.sectors[0], work.H
    weighed = not weigh
    for _ in range(_STEPS):
        shift, square = _step(n, theta, x0, y0, slope, texture, work)
        if shift < 0.0 or _LEAST_SNR * square > n * theta[6] * theta[6]:
            return -1.0, 0.0
        if shift < _WEIGH_PX and not weighed:
            weighed = True
            spread(n, work, flat)
            v_in = flat[0] if flat[2] >= 30.0 else noise_sigma * noise_sigma
            v_in = max(v_in, 0.05, 1e-4 * theta[6] * theta[6])
            v_out = max(flat[1], _LEAST_VARIANCE)
            chance = 2.0 + 6.0 * np.sqrt(2.0 / max(flat[2], 30.0) + 2.0 / max(flat[3], 4.0))
            if flat[1] > chance * v_in:
                texture = flat[1] / v_in - 1.0
                continue
            if flat[2] >= 30.0 and flat[0] > chance * v_out:
                v_in = inside_noise(n, work)  # light that slopes over the disc is no noise
                if v_in > chance * v_out:
                    texture = -min(v_in / v_out - 1.0, _MOST_SHOT_NOISE)
                    continue
        if shift < _SMALL_STEP_PX or shift * shift * (H[0, 0] + H[1, 1]) * n < _SMALL_STEP_SIGMAS**2 * 2 * square:
            return square, texture
    return -1.0, 0.0


@kernel
def fit(image: NDArray[np.uint8], noise_sigma: float, theta: Array, cov: Array, work: FitBuffers) -> int:
    """Fit one disc.

    ``image``: (H, W) grey. ``noise_sigma``: the image's noise as far as it is known beforehand, grey levels; used to reject
    what is not a disc. ``theta``: (10,) start: centre (raw px), M (1/px^2), blur (px), contrast, base, gradient (1/px);
    replaced by the result. ``cov``: (2, 2) covariance of the centre, px^2; filled. ``work``: what :func:`workspace`
    returns; ``work.shown`` is filled. Returns 0, or the reason why it is not a disc (REASONS).
    """
    sectors = work.sectors
    n, sample = gather(image, theta, work)
    if n < 0:
        return CUT
    if n < 4 * UNKNOWNS:
        return SMALL
    x0, y0 = np.rint(theta[0]), np.rint(theta[1])
    shift, square = _step(sample, theta, x0, y0, SURROUND, 0.0, work)
    if shift < 0.0 or _LEAST_SNR * square > sample * theta[6] * theta[6]:
        return NO_RIM
    square, texture = minimise(n, theta, x0, y0, SURROUND, noise_sigma, True, 0.0, work)
    if square < 0.0:
        return NO_RIM
    # Clipped pixels have no noise and do not count for it.
    variance = square / max(n - clipped(n, work) - UNKNOWNS, UNKNOWNS)
    det = theta[2] * theta[4] - theta[3] * theta[3]
    half = (theta[2] + theta[4]) / 2
    root = np.sqrt(max(half * half - det, 0.0))
    minor, major = 1.0 / np.sqrt(half + root), 1.0 / np.sqrt(max(half - root, 1e-12))
    if theta[5] > _MOST_BLUR * minor:
        return BLURRED
    if minor < LEAST_RATIO * major:
        return NARROW
    if not abs(theta[6]) > _LEAST_SNR * np.sqrt(variance):
        return FAINT
    excess = np.sqrt(max(variance - noise_sigma * noise_sigma, 0.0)) / abs(theta[6])
    if excess > _MOST_RESIDUAL:
        return NOT_UNIFORM
    rim(n, theta, x0, y0, work, sectors)
    off, chance, count = off_ellipse(variance, work)
    allowed = _RIM_PX + _RIM_SHARE * np.sqrt(major * minor) + _RIM_TEXTURE * theta[5] * excess
    if off > count * allowed * allowed + RIM_CHANCE * np.sqrt(chance):
        return NOT_ELLIPSE
    spread(n, work, sectors[0])
    v_in = sectors[0, 0] * (1.0 + max(-texture, 0.0))
    if sectors[0, 2] > 10.0 and np.sqrt(max(v_in - noise_sigma * noise_sigma, 0.0)) > UNEVEN * abs(theta[6]):
        return HILLY
    slope_inside(n, theta, x0, y0, variance, work)
    power, information = rim_power(n, theta, x0, y0, variance, work)
    work.shown[0], work.shown[1], work.shown[2] = power, off / max(count, 1), information / variance
    work.shown[PARAMETERS : PARAMETERS + UNKNOWNS] = theta
    skewed_edge(n, variance, work)
    of_centre(work, cov)
    radius = det**-0.25
    work.shown[13] = max(0.25 * (cov[0, 0] + cov[1, 1]) * information * radius, 1.0)
    work.shown[12] = 0.0
    if texture > 0.0:
        work.shown[12] = texture_factor(n, theta[5], texture, work)
        variance *= work.shown[12]
        if variance * (cov[0, 0] + cov[1, 1]) > 2.0 * _MOST_SIGMA_PX * _MOST_SIGMA_PX:
            return NOT_UNIFORM
    levelled(theta, variance, work)
    for a in range(2):
        for b in range(2):
            cov[a, b] *= variance
    return 0


@kernel
def shape_of(theta: Array, shape: Array) -> None:
    """Fill S11, S12, S22 of a fitted ellipse, px^2.

    Blur moves the half-way level of a curved edge inwards by blur^2 / (2 radius); that is corrected here.
    """
    det = theta[2] * theta[4] - theta[3] * theta[3]
    wider = (1.0 + 0.5 * theta[5] * theta[5] * np.sqrt(det)) ** 2 / det
    shape[0], shape[1], shape[2] = wider * theta[4], -wider * theta[3], wider * theta[2]
