"""Which pixels tell about a disc.

Pixels near the rim tell where it is; of the rows that show flat ones, which tell only levels and gradient, one in three to
eighteen is taken whole.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from armsight.data import Array
from armsight.vision.markers.disc_model import MOST_PIXELS, F, Work

#: How far from the rim pixels tell about it, in blurs; a ring beyond, px, tells the surround.
_NEAR, _RING_PX = 3.4, 4.0


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
