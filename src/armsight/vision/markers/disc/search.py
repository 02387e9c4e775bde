"""Where in an image discs may be: every third row in steps of eight pixels, then an outline around each candidate.

A disc is brighter (or darker) than the pixel eight to its left. Eight pixels are compared at a time, in one 64-bit
word; the least contrast that counts follows from the image's own noise. Around each candidate :func:`outline` measures
a chord through the pixel, the chord across it, and sixteen rays outwards; their ends give an ellipse to start the fit
from (:mod:`~armsight.vision.markers.disc.fit`), or the reason why there is none.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array
from armsight.kernels import kernel
from armsight.vision.markers.disc.common import common, correct
from armsight.vision.markers.disc.fit import (
    CUT,
    FAINT,
    FOUND_TWICE,
    HILLY,
    LEAST_RATIO,
    NO_RIM,
    NOT_ELLIPSE,
    NOT_UNIFORM,
    OPEN,
    PARAMETERS,
    SMALL,
    UNEVEN,
    FitBuffers,
    factor,
    fit,
    narrow,
    shape_of,
    solve,
)

#: Longest half chord, px: half of the largest disc of a search, blur and all. Larger ones are searched in smaller copies.
REACH = 44
_RAYS = 16
#: From one ray to the next one followed: those along a stripe, which has no end there, are met early.
_STRIDE = 5
_COS = np.cos(2 * np.pi * np.arange(_RAYS) / _RAYS)
_SIN = np.sin(2 * np.pi * np.arange(_RAYS) / _RAYS)
#: Lengths and levels along rays are integers, in 2^-20 px and 2^-40 grey levels.
_BITS, _FRACTION = 20, (1 << 20) - 1
_FINE_COS, _FINE_SIN = np.rint(_COS * (1 << _BITS)).astype(np.int64), np.rint(_SIN * (1 << _BITS)).astype(np.int64)

#: Rounds in which the level of an outline settles.
_ROUNDS = 4
#: Rays are followed so many times as far as the longest half axis of a disc with the same two chords; more: outlines in
#: wood take up to half as long again.
_LONGER = 2.0
#: The contrast across a rim is that of pixels so far from it, px and a share of the smaller half axis. Its standard
#: deviation over its mean is at most the third: of discs before strong textures 1 % have 0.25, of their outlines 0.2 % more
#: than 0.8, of those that a fit rejects 30 to 80 %. At 0.6 a fifth to a half fewer are fitted, and a disc in 3,000 is lost.
_ACROSS_PX, _ACROSS, _UNEVEN = 1.0, 0.2, 0.8
#: The ring on which the inside is compared, as a share of the half axes, and the smaller half axis below which it is not,
#: px: blur reaches it there. Sixteen pixels of noise exceed the third times its variance in one ring of 14,000.
_INSIDE, _INSIDE_PX, _CHANCE = 0.5, 4.0, 3.0
#: The ends of the rays are at most so far from their ellipse, RMS, px and a share of the smaller half axis; one ray that
#: went astray is left out. Noise ends rays of outlines that are less than so many times as strong as the least: there the
#: limit is so many times as high. Half: outlines of 9 discs in 2,500, not of 5, are rejected; double: twice as many of
#: bricks and wood are fitted.
_ROUND_PX, _ROUND, _CLEAR, _UNCLEAR = 0.5, 0.03, 2.5, 3.0
#: Corners are so far from the middle of chords, as a share of these, which have so many pixels at least: one of an ellipse
#: is 1 px or more beyond its rim.
_CORNER, _BOX_PX = 0.45, 12
#: With so many times the contrast across the rim in the middle of what is no ellipse, something else lies there.
_IN_MIDDLE = 3.0
#: Reasons of candidates whose ellipse is known.
OUTLINED = (NOT_ELLIPSE, FAINT, HILLY, NOT_UNIFORM)
#: Steps from a pixel of a blurred rim onto the disc, at most, and the least difference of grey that is a step.
_CLIMB, _CLIMB_GREY = 8, 5

Grey = NDArray[np.uint8]
Room: TypeAlias = tuple[Array, Array, Array, Array, Array, Array]


@kernel
def _walk(image: Grey, x: int, y: int, dx: int, dy: int, half: int, sign: int, reach: int) -> int:
    """Count pixels from (x, y) along (dx, dy) on the disc's side of ``half``; -1 where there is no end in 2 ``reach``."""
    height, width = image.shape
    end = x if dx < 0 else width - 1 - x if dx > 0 else y if dy < 0 else height - 1 - y
    for k in range(1, min(2 * reach - 1, end) + 1):
        if sign * (np.int64(image[np.uint64(y + k * dy), np.uint64(x + k * dx)]) - half) <= 0:
            return k - 1
    return -1


@kernel
def _uphill(image: Grey, x: int, y: int, sign: int) -> tuple[int, int]:
    """Return the pixel that is reached from (x, y), on a disc's rim perhaps, by steps to a neighbour more like a disc."""
    height, width = image.shape
    for _ in range(_CLIMB):
        u, v, most = x, y, sign * np.int64(image[y, x]) + _CLIMB_GREY
        for i, j in ((x - 1, y), (x + 1, y), (x, y - 1), (x, y + 1)):
            if 0 <= i < width and 0 <= j < height and sign * np.int64(image[j, i]) > most:
                u, v, most = i, j, sign * np.int64(image[j, i])
        if u == x and v == y:
            break
        x, y = u, v
    return x, y


@kernel
def _beyond(image: Grey, x: int, y: int, across: int, down: int, sign: int) -> int:
    """Return the surround's level, beyond the ends of two chords through (x, y): the second most unlike the disc."""
    height, width = image.shape
    i, j = across // 2 + 4, down // 2 + 4
    first = sign * np.int64(image[y, max(x - i, 0)])
    second = sign * np.int64(image[y, min(x + i, width - 1)])
    if second < first:
        first, second = second, first
    for k in range(2):
        level = sign * np.int64(image[max(y - j, 0) if k == 0 else min(y + j, height - 1), x])
        if level < first:
            first, second = level, first
        elif level < second:
            second = level
    return int(sign * second)


@kernel
def _ray(image: Grey, x: int, y: int, k: int, first: int, reach: int, half: int, sign: int) -> float:
    """How far from (x, y), beyond ``first`` px, ray k is on the disc's side of ``half``; -1: no end, -2: image border."""
    height, width = image.shape
    c, s, middle = _FINE_COS[k], _FINE_SIN[k], np.int64(half) << 2 * _BITS
    before = np.int64(image[y, x]) << 2 * _BITS  # pixels nearer than the first step are on the disc
    for step in range(first + 1, reach):
        u, v = step * c, step * s
        i, j, u, v = x + (u >> _BITS), y + (v >> _BITS), u & _FRACTION, v & _FRACTION
        if i < 0 or j < 0 or i >= width - 1 or j >= height - 1:
            return -2.0
        top, below = np.int64(image[j, i]), np.int64(image[j + 1, i])
        top = (top << _BITS) + u * (np.int64(image[j, i + 1]) - top)
        below = (below << _BITS) + u * (np.int64(image[j + 1, i + 1]) - below)
        level = (top << _BITS) + v * (below - top)
        if sign * (level - middle) <= 0:
            return float(step - 1.0 + (before - middle) / (before - level))
        before = level
    return -1.0


@kernel
def _chords(
    image: Grey, x: int, y: int, low: int, sign: int, reach: int
) -> tuple[int, int, int, int, int, int]:  # fmt: skip
    """Centre a pixel in its chords along the row and the column; ``low`` is the surround's level.

    Return column and row; the level half-way between disc and surround; the lengths of both chords, -1 where one has no
    end, and the shortest of their four parts, px.
    """
    half, across, down, shortest = 0, -1, -1, 0
    for round_ in range(_ROUNDS):
        half = (low + int(image[y, x])) // 2
        left, right = _walk(image, x, y, -1, 0, half, sign, reach), _walk(image, x, y, 1, 0, half, sign, reach)
        if left < 0 or right < 0:
            return x, y, half, -1, -1, 0
        x += (right - left) // 2
        up, below = _walk(image, x, y, 0, -1, half, sign, reach), _walk(image, x, y, 0, 1, half, sign, reach)
        if up < 0 or below < 0:
            return x, y, half, -1, -1, 0
        y += (below - up) // 2
        across, down, shortest = left + right, up + below, min(min(left, right), min(up, below))
        if round_ > 0:
            # The first pixel may have been noise beside the disc: is the level half-way between disc and surround?
            low = _beyond(image, x, y, across, down, sign)
            contrast = int(image[y, x]) - low
            if 8 * abs(2 * half - low - int(image[y, x])) < sign * contrast or sign * contrast <= 0:  # or a ring's hole
                break
    return x, y, half, across, down, shortest


@kernel
def _ellipse(radii: Array, room: Room, without: int) -> tuple[float, float, float]:
    """Fit an ellipse p . (u^2, 2 u v, v^2, u, v) = 1 to the ends of rays (16,) but one; p is the solution of ``room``.

    With weights 1 / radius^2 the normal equations are sums of powers of the radii, times those of the rays' directions.

    Returns Its centre, from that of the rays, px; 1 + the centre's distance in it, squared, -1 where there is no ellipse.
    """
    H, g, _, L, scale, p = room
    q0, q1, q2, q3, q4, c0, c1, c2, c3, g3, g4 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    s0, s1, s2 = 0.0, 0.0, 0.0
    for k in range(_RAYS):
        if k == without:
            continue
        c, s, r = _COS[k], _SIN[k], radii[k]
        u, v, uu, uv, vv = r * c, r * s, c * c, c * s, s * s
        q0 += u * u * uu
        q1 += u * u * uv
        q2 += u * u * vv
        q3 += v * v * uv
        q4 += v * v * vv
        c0 += u * uu
        c1 += u * uv
        c2 += u * vv
        c3 += v * vv
        g3 += c / r
        g4 += s / r
        s0 += uu
        s1 += uv
        s2 += vv
    H[0, 0], H[1, 0], H[1, 1], H[2, 0], H[2, 1], H[2, 2] = q0, 2 * q1, 4 * q2, q2, 2 * q3, q4
    H[3, 0], H[3, 1], H[3, 2], H[3, 3], H[4, 0], H[4, 1], H[4, 2] = c0, 2 * c1, c2, s0, c1, 2 * c2, c3
    H[4, 3], H[4, 4], g[0], g[1], g[2], g[3], g[4] = s1, s2, s0, 2 * s1, s2, g3, g4
    if not factor(H, L, scale):
        return 0.0, 0.0, -1.0
    solve(L, scale, g, p)
    if not p[0] > 0.0 or narrow(p[0], p[1], p[2]):
        return 0.0, 0.0, -1.0
    det = p[0] * p[2] - p[1] * p[1]
    u, v = -0.5 * (p[2] * p[3] - p[1] * p[4]) / det, -0.5 * (p[0] * p[4] - p[1] * p[3]) / det
    return u, v, 1.0 + p[0] * u * u + 2 * p[1] * u * v + p[2] * v * v


@kernel
def _off(radii: Array, p: Array, without: int) -> tuple[float, int]:
    """Return how far the ends of rays (16,) but one are from the ellipse p, RMS, px, and which one is farthest."""
    square, most, worst = 0.0, 0.0, 0
    for k in range(_RAYS):
        if k == without:
            continue
        u, v = radii[k] * _COS[k], radii[k] * _SIN[k]
        a, b = p[0] * u + p[1] * v, p[1] * u + p[2] * v
        value, slope_u, slope_v = a * u + b * v + p[3] * u + p[4] * v - 1.0, 2.0 * a + p[3], 2.0 * b + p[4]
        off = value * value / (slope_u * slope_u + slope_v * slope_v)
        square += off
        if off > most:
            most, worst = off, k
    return float(np.sqrt(square / (_RAYS - 5 - (without >= 0)))), worst


@kernel
def _across(image: Grey, theta: Array) -> tuple[float, float]:
    """Return the mean contrast across an ellipse's rim, in sixteen directions, and its standard deviation over that."""
    height, width = image.shape
    u0, v0, m11, m12, m22 = theta[0], theta[1], theta[2], theta[3], theta[4]
    minor = 1.0 / np.sqrt(0.5 * (m11 + m22) + np.sqrt(0.25 * (m11 - m22) ** 2 + m12 * m12))
    far, total, square = min(_ACROSS_PX + _ACROSS * minor, 0.6 * minor), 0.0, 0.0
    for k in range(_RAYS):
        c, s = _COS[k], _SIN[k]
        mu, mv = m11 * c + m12 * s, m12 * c + m22 * s
        radius, per = 1.0 / np.sqrt(c * mu + s * mv), far / np.sqrt(mu * mu + mv * mv)
        u, v, du, dv = u0 + radius * c, v0 + radius * s, per * mu, per * mv
        i, j = min(max(int(u + du + 0.5), 0), width - 1), min(max(int(v + dv + 0.5), 0), height - 1)
        contrast = -np.float64(image[j, i])
        i, j = min(max(int(u - du + 0.5), 0), width - 1), min(max(int(v - dv + 0.5), 0), height - 1)
        contrast += image[j, i]
        total += contrast
        square += contrast * contrast
    return abs(total) / _RAYS, float(np.sqrt(max(_RAYS * square / max(total * total, 1.0) - 1.0, 0.0)))


@kernel
def _hilly(image: Grey, noise: float, theta: Array) -> bool:
    """Whether a ring inside an ellipse varies as no disc's inside may, beyond the noise's chance in sixteen pixels."""
    height, width = image.shape
    m11, m12, m22, total, square = theta[2], theta[3], theta[4], 0.0, 0.0
    if 0.5 * (m11 + m22) + np.sqrt(0.25 * (m11 - m22) ** 2 + m12 * m12) > _INSIDE_PX**-2:
        return False
    for k in range(_RAYS):
        c, s = _COS[k], _SIN[k]
        radius = _INSIDE / np.sqrt(c * (m11 * c + m12 * s) + s * (m12 * c + m22 * s))
        i, j = int(theta[0] + radius * c + 0.5), int(theta[1] + radius * s + 0.5)
        level = np.float64(image[min(max(j, 0), height - 1), min(max(i, 0), width - 1)])
        total += level
        square += level * level
    variance = (square - total * total / _RAYS) / (_RAYS - 1)
    return bool(variance > _CHANCE * noise * noise + (UNEVEN * theta[6]) ** 2)


@kernel
def _box(image: Grey, x: int, y: int, half: int, across: int, down: int, sign: int) -> float:
    """Return the contrast of a box with chords through its middle (x, y); 0 where not all is like a disc up to its corners.

    An ellipse p u^2 + 2 q u v + r v^2 = 1 with half chords a and b has a mean of 2 at the corners (+-a, +-b). What is
    bright beside a disc, beyond a thin ring, is not joined to it: the diagonals' outer halves are followed.
    """
    if min(across, down) < _BOX_PX:
        return 0.0
    u, v, most = int(_CORNER * (across + 1) + 0.5), int(_CORNER * (down + 1) + 0.5), 0.0
    steps = max(u, v)
    for k in range(steps, steps // 2, -1):
        i, j = u * k // steps, v * k // steps
        for a, b in ((x - i, y - j), (x + i, y - j), (x - i, y + j), (x + i, y + j)):
            gap = sign * (np.float64(image[b, a]) - half)
            if gap <= 0.0:
                return 0.0
            if k == steps:
                most = max(most, gap)
    return 2.0 * sign * min(most, sign * (np.float64(image[y, x]) - half))  # a disc may lie on it


@kernel
def outline(
    image: Grey, x: int, y: int, low: int, sign: int, theta: Array, room: Room, reach: int, least: float
) -> int:
    """Estimate a disc's ellipse around one of its pixels (x, y), as the start of its fit: theta (10,) is filled.

    ``low``: grey of the surround; ``sign``: 1 for a bright disc, -1 for a dark one; ``reach``: longest half chord, px;
    ``least``: mean contrast across the rim, grey levels. Return 0, or the reason why there is no disc
    (``fit.REASONS``); for those of OUTLINED, too, theta is filled.
    """
    height, width = image.shape
    x, y = _uphill(image, x, y, sign)
    x, y, half, across, down, shortest = _chords(image, x, y, low, sign, reach)
    if across < 0:
        return OPEN
    if min(across, down) < 2 or across + down < 6:
        return SMALL
    theta[6] = _box(image, x, y, half, across, down, sign)
    if theta[6] != 0.0:
        theta[0], theta[1], theta[2], theta[3], theta[4] = x, y, 4.0 / across**2, 0.0, 4.0 / down**2
        return NOT_ELLIPSE
    radii, p = room[2], room[5]
    within, start = 0.0, int(0.6 * shortest)
    # Half chords at right angles, a and b, have 1 / a^2 + 1 / b^2 of the half axes, and these are at most so unlike.
    longest = across * down / (LEAST_RATIO * np.sqrt(4.0 * (across * across + down * down)))
    reach = min(reach, int(_LONGER * longest) + 3)
    for ray in range(_RAYS):
        k = _STRIDE * ray % _RAYS
        radii[k] = _ray(image, x, y, k, start, reach, half, sign)
        if radii[k] < 0.0:
            return OPEN if radii[k] > -1.5 else CUT
        within += radii[k] * radii[k] / _RAYS
    without, code, contrast = -1, 0, 2.0 * abs(int(image[y, x]) - half)
    for _ in range(2):
        cu, cv, size = _ellipse(radii, room, without)
        if not (size > 0.0 and cu * cu + cv * cv < within):
            return NO_RIM
        minor = np.sqrt(size / (0.5 * (p[0] + p[2]) + np.sqrt(0.25 * (p[0] - p[2]) ** 2 + p[1] * p[1])))
        off, without = _off(radii, p, without)
        most = (_ROUND_PX + _ROUND * minor) * (1.0 if contrast > _CLEAR * least else _UNCLEAR)
        code = 0 if off <= most else NOT_ELLIPSE
        if code == 0:
            break
    theta[0], theta[1] = x + cu, y + cv
    theta[2], theta[3], theta[4] = p[0] / size, p[1] / size, p[2] / size
    theta[5] = 0.9
    # Levels: at the centre, and on a ring outside.
    inside, outside = np.float64(image[y, x]), 0.0
    far = 1.25 * np.sqrt(within) + 2.0
    for k in range(0, _RAYS, 2):
        i, j = int(np.rint(theta[0] + far * _COS[k])), int(np.rint(theta[1] + far * _SIN[k]))
        outside += image[min(max(j, 0), height - 1), min(max(i, 0), width - 1)] / (_RAYS / 2)
    theta[6], theta[7], theta[8], theta[9] = inside - outside, outside, 0.0, 0.0
    if not sign * theta[6] > 0.0:
        theta[6] = 2.0 * (inside - half)
        theta[7] = half - (inside - half)
    contrast, uneven = _across(image, theta)
    if code != 0:
        middle = 2.0 * abs(inside - half)
        theta[6] = sign * (middle if middle < _IN_MIDDLE * contrast else contrast)
        return code
    return NOT_UNIFORM if uneven > _UNEVEN else FAINT if contrast < least else 0


def workspace() -> Room:
    """Return the buffers of :func:`outline`."""
    return np.empty((5, 5)), np.empty(5), np.empty(_RAYS), np.empty((5, 5)), np.empty(5), np.empty(5)


#: Step between the rows that are searched; the smallest disc, 5 px across, crosses one at least.
_ROW_STEP = 3
#: Rows of the image whose searched rows are tested together first.
_TOGETHER = 8 * _ROW_STEP
#: Words of a row that are tested together next: half doubles the tests, double has twice as many words marked in vain.
_BLOCK = 16
#: Least contrast, grey levels, and in standard deviations of the noise of a difference.
LEAST_CONTRAST = 10.0
_CONTRAST_SIGMAS = 5.0
#: Of that the mean across a rim, at least: the most blurred disc that a fit accepts shows 0.55. Half: twice as many stripes
#: of a texture are fitted; double: of discs below 10 standard deviations 4 % are lost.
_FAINT = 0.5
#: A candidate this near to the rim of a known disc is that disc, px, unless its contrast is so many times as large: then a
#: disc lies on something faint, or beside something that is no ellipse.
_RIM_PX, _FAINTER, _FAINTER_BESIDE = 3.0, 4.0, 1.5
_HIGH = np.uint64(0x8080808080808080)
_SIX = np.uint64(0x3F3F3F3F3F3F3F3F)
_EVERY_BYTE = np.uint64(0x0101010101010101)
_TWO, _MARK = np.uint64(2), np.uint64(0x80)
_PAIRS, _FOURS = np.uint64(0x00FF00FF00FF00FF), np.uint64(0x0000FFFF0000FFFF)
_EMPTY = np.uint64(0)

Words64 = NDArray[np.uint64]


@kernel("const u1[:, ::1]")
def noise_of(image: Grey) -> float:
    """Estimate the standard deviation of an image's noise, grey levels: the median difference of neighbours.

    A tenth of a level at the least; pixels that are black or saturated are ignored.
    """
    height, width = image.shape
    counts = np.zeros(256, np.int64)
    total = 0
    length = min(32, width - 1)
    for k in range(16):
        # Short runs of pixels, spread over the image as a lattice of coprime steps spreads them.
        y = ((2 * k + 1) * height) // 32
        first = ((k * 7) % 16) * (width - 1 - length) // 15
        for x in range(first, first + length):
            a, b = np.int64(image[y, x]), np.int64(image[y, x + 1])
            if 0 < a < 255 and 0 < b < 255:
                counts[abs(a - b)] += 1
                total += 1
    if total < 100:
        return 1.0
    half, below = 0.5 * total, 0
    for d in range(256):
        if below + counts[d] >= half:
            # Differences are whole levels: the median lies within its bin, which reaches from d - 1/2 to d + 1/2.
            low = d - 0.5 if d > 0 else 0.0
            median = low + (half - below) / counts[d] * (d + 0.5 - low)
            return float(max(median / 0.954, 0.1))
        below += counts[d]
    return 1.0


@kernel(forceinline=True)
def _quarter(word: np.uint64) -> np.uint64:
    """Divide the bytes of a word by four."""
    return (word >> _TWO) & _SIX


@kernel
def _marks(a: np.uint64, b: np.uint64, t: np.uint64) -> np.uint64:
    """Mark, with the high bit of its byte, each pixel of b that is brighter than that of a by t times four levels."""
    return ((_quarter(b) | _HIGH) - _quarter(a) - t) & _HIGH


@kernel(forceinline=True)
def _apart(row: Words64, i: int, t: np.uint64) -> np.uint64:
    """Mark, with the high bits of bytes, the pixels of word i of a row that differ from those eight further on."""
    gap = (_quarter(row[i + 1]) | _HIGH) - _quarter(row[i])  # 128 more than the difference
    return (gap - t) | ~(gap + t - _EVERY_BYTE)


@kernel
def differs(row: Words64, t: np.uint64) -> bool:
    """Return whether any two pixels of a row (W / 8,), eight apart, differ by t units of four levels."""
    every = _EMPTY
    for i in range(len(row) - 1):
        every |= _apart(row, i, t)
    return bool(every & _HIGH != _EMPTY)


@kernel(forceinline=True)
def _halves(word: np.uint64) -> np.uint64:
    """Add the bytes of a word in pairs: four sums of 16 bits."""
    return (word & _PAIRS) + ((word >> np.uint64(8)) & _PAIRS)


@kernel
def any_differs(words: Words64, y: int, t: np.uint64, sums: Words64) -> bool:
    """Return whether any two pixels of the eight searched rows from y differ as in :func:`differs`.

    All eight rows' cache lines are waited for at once. ``sums`` (W / 8,): of quarters of a cell's 64 pixels, filled.
    """
    every = _EMPTY
    a, b, c, d = words[y], words[y + _ROW_STEP], words[y + 2 * _ROW_STEP], words[y + 3 * _ROW_STEP]
    y += 4 * _ROW_STEP
    e, f, g, h = words[y], words[y + _ROW_STEP], words[y + 2 * _ROW_STEP], words[y + 3 * _ROW_STEP]
    for i in range(len(a) - 1):
        every |= _apart(a, i, t) | _apart(b, i, t) | _apart(c, i, t) | _apart(d, i, t)
        every |= _apart(e, i, t) | _apart(f, i, t) | _apart(g, i, t) | _apart(h, i, t)
        s = _halves(_quarter(a[i]) + _quarter(b[i]) + _quarter(c[i]) + _quarter(d[i]))
        s += _halves(_quarter(e[i]) + _quarter(f[i]) + _quarter(g[i]) + _quarter(h[i]))
        s = (s & _FOURS) + ((s >> np.uint64(16)) & _FOURS)
        sums[i] = (s + (s >> np.uint64(32))) & np.uint64(0xFFFF)
    return bool(every & _HIGH != _EMPTY)


@kernel
def _large(sums: Words64) -> bool:
    """Whether the means of two cells of a row (W / 8,), 32 or 64 px apart, differ by half the least contrast."""
    limit, least, most, n = np.int64(8.0 * LEAST_CONTRAST), np.int64(sums[0]), np.int64(sums[0]), len(sums) - 1
    for i in range(n):
        least, most = min(least, np.int64(sums[i])), max(most, np.int64(sums[i]))
    if most - least <= limit:
        return False
    most = np.int64(0)
    for apart in (4, 8):
        for i in range(n - apart):
            most = max(most, abs(np.int64(sums[i]) - np.int64(sums[i + apart])))
    return bool(most > limit)


@kernel
def _known(x: int, y: int, gap: int, starts: Array, codes: NDArray[np.int64], cells: NDArray[np.int16]) -> bool:
    """Whether a pixel, ``gap`` grey levels from that to its left, was examined before or lies on a disc that was found."""
    n = cells[y >> 3, x >> 3]
    if n < 0:
        return False
    if codes[n] != 0 and codes[n] not in OUTLINED:
        return True
    if gap > (_FAINTER_BESIDE if codes[n] == NOT_ELLIPSE else _FAINTER) * abs(starts[n, 6]):
        return False
    u, v = x - starts[n, 0], y - starts[n, 1]
    q = starts[n, 2] * u * u + 2 * starts[n, 3] * u * v + starts[n, 4] * v * v
    return bool(np.sqrt(q) < 1.0 + _RIM_PX * np.sqrt(starts[n, 2] + starts[n, 4]))


@kernel
def _note(n: int, starts: Array, cells: NDArray[np.int16]) -> None:
    """Enter a disc into the cells that it covers, with a margin."""
    height, width = cells.shape
    det = starts[n, 2] * starts[n, 4] - starts[n, 3] ** 2
    half_w, half_h = np.sqrt(starts[n, 4] / det) + _RIM_PX, np.sqrt(starts[n, 2] / det) + _RIM_PX
    left, right = max(int(starts[n, 0] - half_w), 0) >> 3, min(int(starts[n, 0] + half_w) >> 3, width - 1)
    top, bottom = max(int(starts[n, 1] - half_h), 0) >> 3, min(int(starts[n, 1] + half_h) >> 3, height - 1)
    for y in range(top, bottom + 1):
        for x in range(left, right + 1):
            cells[y, x] = n


@kernel
def _strongest(image: Grey, y: int, i: int, sign: int, left: np.uint64) -> tuple[np.uint64, int, int]:
    """Take the first run of marked pixels of word i of a row, which is one candidate.

    Returns the marks that are left; the column where the two pixels, eight apart, differ most, and by how many levels.
    """
    byte, best, x = 0, -1, 0
    while (left >> np.uint64(8 * byte)) & _MARK == _EMPTY:
        byte += 1
    while byte < 8 and (left >> np.uint64(8 * byte)) & _MARK != _EMPTY:
        left &= ~(_MARK << np.uint64(8 * byte))
        gap = sign * (int(image[y, 8 * i + byte + 8]) - int(image[y, 8 * i + byte]))
        if gap > best:
            best, x = gap, 8 * i + byte + 8
        byte += 1
    return left, x, best


@kernel(
    "const u1[:, ::1], const u8[:, ::1], f8, b1, b1, f8[:, ::1], i8[::1], i8[::1], "
    "(f8[:, ::1], f8[::1], f8[::1], f8[:, ::1], f8[::1], f8[::1])"
)
def search(
    image: Grey, words: Words64, noise: float, bright: bool, dark: bool, starts: Array, codes: NDArray[np.int64],
    signs: NDArray[np.int64], room: Room,
) -> tuple[int, bool]:  # fmt: skip
    """Look for discs in a grey image (H, W), W a multiple of eight; ``words`` (H, W / 8) are its memory as 64-bit words.

    starts (N, 10), codes (N,), 0 or the reason why there is no disc, and signs (N,), 1 for bright ones, -1 for dark
    ones, are filled; ``noise`` in grey levels. Return the number of candidates examined, at most N; whether there may
    be a disc that is too large.
    """
    height, width = image.shape
    contrast = max(LEAST_CONTRAST, _CONTRAST_SIGMAS * 1.4142 * noise)
    least = min(int(np.ceil(contrast / 4.0)), 60)
    t = np.uint64(least) * _EVERY_BYTE
    cells = np.empty((2, height // 8 + 1, width // 8 + 1), np.int16)
    n, plain, begun, large, sums = 0, False, False, False, np.zeros(width // 8, np.uint64)
    for y in range(1, height - 1, _ROW_STEP):
        if (y - 1) % _TOGETHER == 0:
            plain = y + _TOGETHER < height and not any_differs(words, y, t, sums)
            large |= _large(sums)
        for first in range(0, 0 if plain else width // 8 - 1, _BLOCK):
            row = words[y, first : first + _BLOCK + 1]
            if not differs(row, t):
                continue
            if not begun:
                cells[:], begun = -1, True
            for i in range(len(row) - 1):
                for sign in (1, -1):
                    if not (bright if sign > 0 else dark):
                        continue
                    left = _marks(row[i], row[i + 1], t) if sign > 0 else _marks(row[i + 1], row[i], t)
                    mine = cells[(1 - sign) // 2]
                    while left != _EMPTY:
                        left, x, gap = _strongest(image, y, first + i, sign, left)
                        if _known(x, y, gap, starts, codes, mine):
                            continue
                        if n == len(starts):
                            return n, True  # the rest was not looked at
                        low, signs[n] = int(image[y, x - 8]), sign
                        codes[n] = outline(image, x, y, low, sign, starts[n], room, REACH, _FAINT * contrast)
                        if codes[n] == 0 and _hilly(image, noise, starts[n]):
                            codes[n] = HILLY
                        if codes[n] == 0 or codes[n] in OUTLINED:
                            _note(n, starts, mine)
                        else:
                            starts[n, 0], starts[n, 1] = x, y
                            mine[y >> 3, x >> 3] = n
                        n += 1
    return n, large


@kernel
def _again(n: int, starts: Array, signs: NDArray[np.int64], cells: NDArray[np.int16]) -> bool:
    """Whether disc n repeats one in the cells of 8 px; two in one cell, smaller than 5 px, are not checked."""
    x, y = int(starts[n, 0]) >> 3, int(starts[n, 1]) >> 3
    for j in range(max(y - 1, 0), min(y + 2, cells.shape[0])):
        for i in range(max(x - 1, 0), min(x + 2, cells.shape[1])):
            m = cells[j, i]
            if m < 0 or signs[m] != signs[n]:
                continue
            if (starts[m, 0] - starts[n, 0]) ** 2 + (starts[m, 1] - starts[n, 1]) ** 2 < 4.0:
                return True
    return False


@kernel(
    "const u1[:, ::1], const u8[:, ::1], b1, b1, i8, i8, i8, f8[:, ::1], i8[::1], i8[::1], f8[:, :, ::1], f8[:, ::1], "
    "(f8[:, ::1], f8[::1], f8[::1], f8[:, ::1], f8[::1], f8[::1]), FitBuffers"
)
def find(
    image: Grey, words: Words64, bright: bool, dark: bool, good: int, first: int, n: int, starts: Array,
    codes: NDArray[np.int64], signs: NDArray[np.int64], cov: Array, shape: Array, room: Room, work: FitBuffers,
) -> tuple[int, int, bool, float]:  # fmt: skip
    """Search an image as :func:`search` does and fit every candidate; or fit further candidates, which are given.

    The first ``good`` of ``starts``, ``codes``, ``signs`` are fitted discs already, those from ``first`` to ``n`` are not;
    with ``n`` 0 the image is searched for them. In the end the discs come first, then the rejected candidates; ``cov`` (N,
    2, 2) are the covariances of the discs' centres, px^2, and ``shape`` (N, 3) their ellipses, px^2.

    Returns the number of discs, and of candidates in all; whether the search found that there may be a disc too large for
    it; the image's noise, grey levels.
    """
    noise, large = noise_of(image), False
    if n == 0:
        n, large = search(image, words, noise, bright, dark, starts, codes, signs, room)
    cells = np.full((image.shape[0] // 8 + 1, image.shape[1] // 8 + 1), -1, np.int16)
    for i in range(good):
        cells[int(starts[i, 1]) >> 3, int(starts[i, 0]) >> 3] = i
    for i in range(first, n):
        if codes[i] == 0 and _again(i, starts, signs, cells):
            codes[i] = FOUND_TWICE
        if codes[i] == 0:
            codes[i] = fit(image, noise, starts[i], cov[good], work)
        if codes[i] != 0:
            continue
        for a in range(starts.shape[1]):
            starts[good, a], starts[i, a] = starts[i, a], starts[good, a]
        codes[good], codes[i] = codes[i], codes[good]
        signs[good], signs[i] = signs[i], signs[good]
        if _again(good, starts, signs, cells):
            codes[good] = FOUND_TWICE
        else:
            cells[int(starts[good, 1]) >> 3, int(starts[good, 0]) >> 3] = good
            shape_of(starts[good], shape[good])
            work.discs[good, :] = work.shown
            good += 1
    return good, n, large, noise


@kernel("const u1[:, ::1], f8, i8, f8[:, ::1], f8[:, :, ::1], f8[::1], FitBuffers")
def correct_all(
    image: Grey, noise: float, good: int, starts: Array, cov: Array, shared: Array, work: FitBuffers
) -> None:  # fmt: skip
    """Find what the discs of an image (H, W) grey have in common, and correct each one by it.

    ``starts`` (N, 10), ``work`` and ``noise``, grey levels, are as :func:`find` leaves them, ``good`` the number of discs.
    The discs and ``cov`` (N, 2, 2), of their centres, px^2, are corrected; ``shared`` (SHARED,) is filled, see
    :func:`~armsight.vision.markers.disc.common.common`.
    """
    common(image, good, work, shared)
    for i in range(good):
        correct(image, noise, work.discs[i], shared, cov[i], work)
        for a in range(starts.shape[1]):
            starts[i, a] = work.discs[i, PARAMETERS + a]
