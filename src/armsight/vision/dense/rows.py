"""Rows that were matched by themselves vote.

Birchfield and Tomasi, IJCV 35(3), 1999, section 4, let disparities that many rows agree on spread over those that few
agree on, up to where the light changes. Here every pixel takes the disparity that most of its column near it holds,
those that look like it counting more, and then the same along its row: no thresholds, and a streak is outvoted where it
is thin.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from armsight.data import Image
from armsight.vision.dense.strips import on_strips

Whole = NDArray[np.int16]
#: How far to either side, px, and the grey level difference that halves a vote.
_REACH, _ALIKE = 10, 8
_STRIP_ROWS = 96


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _vote(
    d: Whole, image: Image, weights: NDArray[np.float32], dy: int, dx: int, count: int, begin: int, end: int, out: Whole
) -> None:
    """Vote along columns (dy of 1) or rows (dx of 1)."""
    height, width = d.shape
    votes = np.zeros(count, np.float32)
    for y in range(begin, end):
        for x in range(width):
            here = dy * y + dx * x
            low, high = max(-_REACH, -here), min(_REACH, (dy * height + dx * width) - 1 - here)
            best, most = np.int16(-1), np.float32(0)
            for k in range(low, high + 1):
                held = d[y + k * dy, x + k * dx]
                if held >= 0:
                    votes[held] += weights[abs(np.int32(image[y + k * dy, x + k * dx]) - np.int32(image[y, x]))]
                    if votes[held] > most:
                        best, most = held, votes[held]
            for k in range(low, high + 1):
                held = d[y + k * dy, x + k * dx]
                if held >= 0:
                    votes[held] = 0
            out[y, x] = best


def vote(whole: Whole, image: Image, count: int) -> Whole:
    """Let rows vote.

    Args:
        whole: (H, W) disparities from the search's first on, -1 where a pixel was skipped.
        image: (H, W) uint8, the left image.
        count: how many disparities there are.

    Returns:
        (H, W) what they agree on; -1 where there is nobody to vote.
    """
    weights = (_ALIKE / (_ALIKE + np.arange(256))).astype(np.float32)
    size = -(-count // 64) * 64
    for dy, dx in ((1, 0), (0, 1)):
        source, whole = whole, np.empty_like(whole)

        def work(begin: int, end: int, source: Whole = source, out: Whole = whole, dy: int = dy, dx: int = dx) -> None:
            _vote(source, image, weights, dy, dx, size, begin, end, out)

        on_strips(whole.shape[0], _STRIP_ROWS, work)
    return whole


@numba.njit(cache=True, nogil=True, error_model="numpy")
def seen(d: Whole, first: int) -> NDArray[np.bool_]:
    """Tell which pixels (H, W) the right camera sees: no nearer pixel of the row is matched to the same place."""
    height, width = d.shape
    out = np.zeros((height, width), np.bool_)
    nearest = np.empty(width, np.int16)
    for y in range(height):
        nearest[:] = -1
        for x in range(width):
            right = x - d[y, x] - first
            if d[y, x] >= 0 and right >= 0:
                nearest[right] = max(nearest[right], d[y, x])
        for x in range(width):
            right = x - d[y, x] - first
            if d[y, x] >= 0 and right >= 0:
                out[y, x] = nearest[right] <= d[y, x] + 1
    return out
