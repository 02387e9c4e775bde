"""Disparities smoothed within their own surface.

Winners come from whole disparities with a place between them, and that place is noisy where there is little texture.
Every measured pixel becomes the mean of those near it that lie within a little of it in disparity, weighted by how
alike they are in grey: along rows, then along columns, a bilateral filter taken apart (Pham and van Vliet 2005). Depth
breaks stay, for what lies across them is too far off to count.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from armsight.data import Image
from armsight.vision.dense.strips import on_strips
from armsight.vision.dense.winner import Singles

#: How far to either side, px, and the grey level difference that halves a weight.
_REACH, _ALIKE = 4, np.float32(8.0)
#: What counts as the same surface in each round, px: more than the error between two disparities, less than a break.
_ROUNDS = (1.5, 1.0)
_STRIP_ROWS = 96


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _add(
    d: Singles, grey: Image, other: Singles, other_grey: Image, tolerance: np.float32, up: Singles, down: Singles
) -> None:
    """Add neighbours to sums of weighted differences and of weights, a row at a time; NaN never counts."""
    for x in range(d.shape[0]):
        gap = other[x] - d[x]
        near = abs(gap) <= tolerance
        step = abs(np.float32(other_grey[x]) - np.float32(grey[x]))
        weight = _ALIKE / (_ALIKE + step) if near else np.float32(0)
        up[x] += weight * (gap if near else np.float32(0))
        down[x] += weight


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _rows(
    source: Singles, image: Image, tolerance: np.float32, begin: int, end: int, out: Singles, share: Singles
) -> None:
    """Smooth along rows."""
    width = source.shape[1]
    up, down = np.empty(width, np.float32), np.empty(width, np.float32)
    for y in range(begin, end):
        up[:], down[:] = 0, 0
        for k in range(1, _REACH + 1):
            a, b, g, h = source[y, k:], source[y, :-k], image[y, k:], image[y, :-k]
            _add(b, h, a, g, tolerance, up[:-k], down[:-k])
            _add(a, g, b, h, tolerance, up[k:], down[k:])
        for x in range(width):
            out[y, x] = source[y, x] + up[x] / (down[x] + np.float32(1))
            share[y, x] = down[x] / np.float32(2 * _REACH)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _columns(
    source: Singles, image: Image, tolerance: np.float32, begin: int, end: int, out: Singles, share: Singles
) -> None:
    """Smooth along columns."""
    height, width = source.shape
    up, down = np.empty(width, np.float32), np.empty(width, np.float32)
    for y in range(begin, end):
        up[:], down[:] = 0, 0
        for k in range(-_REACH, _REACH + 1):
            if k != 0 and 0 <= y + k < height:
                _add(source[y], image[y], source[y + k], image[y + k], tolerance, up, down)
        for x in range(width):
            out[y, x] = source[y, x] + up[x] / (down[x] + np.float32(1))
            share[y, x] = np.float32(0.5) * (share[y, x] + down[x] / np.float32(2 * _REACH))


def smoothed(disparity: Singles, image: Image) -> tuple[Singles, NDArray[np.float32]]:
    """Smooth measured disparities.

    Args:
        disparity: (H, W) px; NaN where nothing was measured.
        image: (H, W) uint8, the left image.

    Returns:
        (H, W) px, NaN where it was; and (H, W) the share of each pixel's neighbours, each by its weight, that lie on
        its surface.
    """
    height = disparity.shape[0]
    share, half, out = np.empty_like(disparity), np.empty_like(disparity), disparity
    for tolerance in map(np.float32, _ROUNDS):
        source, out = out, np.empty_like(disparity)

        def rows(begin: int, end: int, source: Singles = source, limit: np.float32 = tolerance) -> None:
            _rows(source, image, limit, begin, end, half, share)

        def columns(begin: int, end: int, out: Singles = out, limit: np.float32 = tolerance) -> None:
            _columns(half, image, limit, begin, end, out, share)

        on_strips(height, _STRIP_ROWS, rows)
        on_strips(height, _STRIP_ROWS, columns)
    return out, share
