"""Where in an image discs may be: every third row in steps of eight pixels, then a look around each find.

A disc is brighter (or darker) than what lies eight pixels to its left and right. Eight pixels are compared at a time, in
one 64-bit word; the least contrast that counts follows from the image's own noise. From a find, the chord through it, the
chord across that and sixteen rays outwards give an ellipse to start the fit from, or the reason why there is none.
"""

from __future__ import annotations

from typing import TypeAlias

import numba
import numpy as np
from numpy.typing import NDArray

from armsight.data import Array
from armsight.vision.markers.disc_model import factor, solve

#: Rows between those looked at; the smallest disc, 5 px across, shows on one at least.
_ROW_STEP = 3
#: Least contrast, grey levels, and in standard deviations of the noise of a difference.
LEAST_CONTRAST = 10.0
_CONTRAST_SIGMAS = 5.0
#: Longest half chord, px: half of the largest disc, blur and all.
_REACH = 44
_RAYS = 16
#: A find so near to the rim of a known disc is that disc, px.
_RIM_PX = 3.0
_HIGH = np.uint64(0x8080808080808080)
_SIX = np.uint64(0x3F3F3F3F3F3F3F3F)
_LANES = np.uint64(0x0101010101010101)
_TWO = np.uint64(2)
_EMPTY = np.uint64(0)
_COS = np.cos(2 * np.pi * np.arange(_RAYS) / _RAYS)
_SIN = np.sin(2 * np.pi * np.arange(_RAYS) / _RAYS)

Words = NDArray[np.uint64]
Grey = NDArray[np.uint8]
Room: TypeAlias = tuple[Array, Array, Array, Array, Array, Array]


@numba.njit(cache=True, error_model="numpy")
def noise_of(image: Grey) -> float:
    """Estimate the standard deviation of an image's noise, grey levels: the median difference of neighbours.

    A tenth of a level at the least; pixels without light or with too much say nothing.
    """
    height, width = image.shape
    counts = np.zeros(256, np.int64)
    total = 0
    length = min(32, width - 1)
    for k in range(24):
        # Short runs of pixels, spread over the image as a lattice of coprime steps spreads them.
        y = ((2 * k + 1) * height) // 48
        first = ((k * 7) % 24) * (width - 1 - length) // 23
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


@numba.njit(cache=True, error_model="numpy")
def scan_row(row: Words, least: int, sign: int, marks: Words) -> bool:
    """Mark the pixels whose neighbour eight to the right is brighter (sign 1) or darker (-1) by ``least`` x 4 levels.

    Args:
        row: (W / 8,) a row of pixels.
        least: contrast, in units of four grey levels.
        sign: 1 or -1.
        marks: (W / 8,) filled: the high bit of each pixel's byte.

    Returns:
        Whether any is marked.
    """
    t = np.uint64(least) * _LANES
    every = _EMPTY
    if sign > 0:
        for i in range(len(row) - 1):
            a, b = (row[i] >> _TWO) & _SIX, (row[i + 1] >> _TWO) & _SIX
            marks[i] = ((b | _HIGH) - a - t) & _HIGH
            every |= marks[i]
    else:
        for i in range(len(row) - 1):
            a, b = (row[i] >> _TWO) & _SIX, (row[i + 1] >> _TWO) & _SIX
            marks[i] = ((a | _HIGH) - b - t) & _HIGH
            every |= marks[i]
    marks[len(row) - 1] = _EMPTY
    return bool(every != _EMPTY)


@numba.njit(cache=True, error_model="numpy")
def _walk(image: Grey, x: int, y: int, dx: int, dy: int, half: int, sign: int) -> int:
    """Return how many pixels from (x, y) along (dx, dy) are on the disc's side of ``half``; -1 where there is no end."""
    height, width = image.shape
    for k in range(1, 2 * _REACH):
        x += dx
        y += dy
        if x < 0 or y < 0 or x >= width or y >= height:
            return -1
        if sign * (np.int64(image[y, x]) - half) <= 0:
            return k - 1
    return -1


@numba.njit(cache=True, error_model="numpy")
def outline(image: Grey, x: int, y: int, low: int, sign: int, theta: Array, room: Room) -> int:
    """Look around a pixel on a disc and make a start for the fit of it.

    Args:
        image: (H, W) grey.
        x: column of a pixel that is on the disc.
        y: its row.
        low: grey level of the surround.
        sign: 1 for a bright disc, -1 for a dark one.
        theta: (10,) filled: centre, M, blur, contrast, base, gradient.
        room: what :func:`workspace` returns.

    Returns:
        0, or why there is no disc (disc_fit.REASONS).
    """
    height, width = image.shape
    half = 0
    for _ in range(2):
        half = (low + int(image[y, x])) // 2
        left, right = _walk(image, x, y, -1, 0, half, sign), _walk(image, x, y, 1, 0, half, sign)
        if left < 0 or right < 0:
            return 9
        x += (right - left) // 2
        up, down = _walk(image, x, y, 0, -1, half, sign), _walk(image, x, y, 0, 1, half, sign)
        if up < 0 or down < 0:
            return 9
        y += (down - up) // 2
    if left + right < 2 or up + down < 2 or left + right + up + down + 2 < 8:
        return 7
    H, g, a, L, scale, p = room
    H[:, :] = 0.0
    g[:] = 0.0
    within = 0.0
    start = int(0.6 * min(min(left, right), min(up, down)))
    for k in range(_RAYS):
        c, s = _COS[k], _SIN[k]
        before = np.float64(image[y, x])  # nearer pixels than the first step are on the disc
        radius = -1.0
        for step in range(start + 1, _REACH):
            u, v = x + step * c, y + step * s
            if u < 0.0 or v < 0.0 or u >= width - 1.0 or v >= height - 1.0:
                return 1
            i, j = int(u), int(v)
            fu, fv = u - i, v - j
            level = (1 - fv) * ((1 - fu) * image[j, i] + fu * image[j, i + 1]) + fv * (
                (1 - fu) * image[j + 1, i] + fu * image[j + 1, i + 1]
            )
            if sign * (level - half) <= 0.0:
                radius = step - 1.0 + (before - half) / (before - level)
                break
            before = level
        if radius < 0.0:
            return 9
        u, v = radius * c, radius * s
        within += radius * radius
        a[0], a[1], a[2], a[3], a[4] = u * u, 2 * u * v, v * v, u, v
        # Each ray is weighed so that the algebraic distance becomes one along the ray.
        w = 1.0 / (radius * radius)
        for m in range(5):
            g[m] += w * a[m]
            for n in range(m + 1):
                H[m, n] += w * a[m] * a[n]
    for m in range(5):
        for n in range(m):
            H[n, m] = H[m, n]
    if not factor(H, L, scale):
        return 2
    solve(L, scale, g, p)
    det = p[0] * p[2] - p[1] * p[1]
    if not (p[0] > 0.0 and det > 1e-3 * p[0] * p[2]):
        return 2
    cu, cv = -0.5 * (p[2] * p[3] - p[1] * p[4]) / det, -0.5 * (p[0] * p[4] - p[1] * p[3]) / det
    size = 1.0 + p[0] * cu * cu + 2 * p[1] * cu * cv + p[2] * cv * cv
    if not (size > 0.0 and cu * cu + cv * cv < within / _RAYS):
        return 2
    theta[0], theta[1] = x + cu, y + cv
    theta[2], theta[3], theta[4] = p[0] / size, p[1] / size, p[2] / size
    theta[5] = 0.9
    # Levels: at the centre, and on a ring outside.
    inside, outside = np.float64(image[y, x]), 0.0
    for k in range(0, _RAYS, 2):
        reach = 1.25 * np.sqrt(within / _RAYS) + 2.0
        i, j = int(np.rint(theta[0] + reach * _COS[k])), int(np.rint(theta[1] + reach * _SIN[k]))
        outside += image[min(max(j, 0), height - 1), min(max(i, 0), width - 1)] / (_RAYS / 2)
    theta[6], theta[7], theta[8], theta[9] = inside - outside, outside, 0.0, 0.0
    if not sign * theta[6] > 0.0:
        theta[6] = 2.0 * (inside - half)
        theta[7] = half - (inside - half)
    return 0


@numba.njit(cache=True, error_model="numpy")
def search(
    image: Grey, words: Words, noise: float, sign: int, starts: Array, codes: NDArray[np.int64], room: Room
) -> int:
    """Look for discs in a whole image.

    Args:
        image: (H, W) grey, W a multiple of eight.
        words: (H, W / 8) the same memory.
        noise: standard deviation of the image's noise, grey levels.
        sign: 1 for bright discs, -1 for dark ones.
        starts: (N, 10) filled with starts for the fit; where there is no disc, with the place that was looked at.
        codes: (N,) filled with 0 or why there is no disc.
        room: what :func:`workspace` returns.

    Returns:
        How many were looked at, at most N.
    """
    height, width = image.shape
    contrast = max(LEAST_CONTRAST, _CONTRAST_SIGMAS * 1.4142 * noise)
    least = min(int(np.ceil(contrast / 4.0)), 60)
    found = np.empty(width // 8, np.uint64)
    cells = np.full((height // 8 + 1, width // 8 + 1), -1, np.int16)
    n = 0
    for y in range(1, height - 1, _ROW_STEP):
        if not scan_row(words[y], least, sign, found):
            continue
        previous = _EMPTY
        for i in range(len(found)):
            marks = found[i]
            if marks == _EMPTY:
                previous = _EMPTY
                continue
            # Only where a run of marked pixels begins: its byte is marked and the one before is not.
            begins = marks & ~((marks << np.uint64(8)) | (previous >> np.uint64(56)))
            previous = marks
            while begins != _EMPTY:
                lane = 0
                while (begins >> np.uint64(8 * lane)) & np.uint64(0x80) == _EMPTY:
                    lane += 1
                begins &= begins - np.uint64(1)
                x = 8 * i + lane
                low = int(image[y, x])
                x += 8
                for k in range(x + 1, min(x + 5, width)):
                    if sign * (np.int64(image[y, k]) - np.int64(image[y, x])) > 0:
                        x = k
                known = cells[y >> 3, x >> 3]
                if known >= 0:
                    if codes[known] != 0:
                        continue
                    u, v = x - starts[known, 0], y - starts[known, 1]
                    q = starts[known, 2] * u * u + 2 * starts[known, 3] * u * v + starts[known, 4] * v * v
                    if np.sqrt(q) < 1.0 + _RIM_PX * np.sqrt(starts[known, 2] + starts[known, 4]):
                        continue
                if n == len(starts):
                    return n
                code = outline(image, x, y, low, sign, starts[n], room)
                codes[n] = code
                if code != 0:
                    starts[n, 0], starts[n, 1] = x, y
                    cells[y >> 3, x >> 3] = n
                else:
                    det = starts[n, 2] * starts[n, 4] - starts[n, 3] ** 2
                    half_w, half_h = np.sqrt(starts[n, 4] / det), np.sqrt(starts[n, 2] / det)
                    half_w, half_h = half_w + _RIM_PX, half_h + _RIM_PX
                    first, last = (
                        max(int(starts[n, 0] - half_w), 0) >> 3,
                        min(int(starts[n, 0] + half_w), width - 1) >> 3,
                    )
                    top, end = max(int(starts[n, 1] - half_h), 0) >> 3, min(int(starts[n, 1] + half_h), height - 1) >> 3
                    for cy in range(top, end + 1):
                        for cx in range(first, last + 1):
                            cells[cy, cx] = n
                n += 1
    return n


def workspace() -> Room:
    """Return the arrays that :func:`outline` works in."""
    return np.empty((5, 5)), np.empty(5), np.empty(5), np.empty((5, 5)), np.empty(5), np.empty(5)
