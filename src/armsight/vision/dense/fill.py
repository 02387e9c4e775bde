"""What stands where nothing was measured, told apart by why.

The right camera cannot see what lies behind a nearer surface or beyond its image; what it cannot see continues the
farther of the surfaces beside it in its row. Where a pixel could have been seen and was not matched, the same is a
guess.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from armsight.vision.dense.method import FILLED, MEASURED, OCCLUDED
from armsight.vision.dense.winner import Singles

#: A right pixel that a measured pixel claims, nearer than this, px, hides what is farther.
_HIDES = np.float32(1.0)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _fill_row(d: Singles, state: NDArray[np.uint8], nearest: Singles) -> bool:
    """Fill a row from its measured neighbours, and say what was hidden; False where it holds nothing measured."""
    width, last = d.shape[0], np.float32(np.inf)
    any_measured = False
    nearest[:] = -1
    for x in range(width):
        if state[x] == MEASURED:
            last, any_measured = d[x], True
            right = int(np.floor(x - d[x] + np.float32(0.5)))
            if 0 <= right < width:
                nearest[right] = max(nearest[right], d[x])
        else:
            d[x] = last
    last = np.float32(np.inf)
    for x in range(width - 1, -1, -1):
        if state[x] == MEASURED:
            last = d[x]
            continue
        d[x] = min(d[x], last)
        if any_measured:
            right = int(np.floor(x - d[x] + np.float32(0.5)))
            hidden = right < 0 or nearest[right] > d[x] + _HIDES
            state[x] = OCCLUDED if hidden else FILLED
    return any_measured


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _fill(d: Singles, state: NDArray[np.uint8]) -> None:
    """Fill all rows; a row without anything measured is like the nearest one that has something."""
    height, width = d.shape
    nearest = np.empty(width, np.float32)
    held = np.zeros(height, np.bool_)
    for y in range(height):
        held[y] = _fill_row(d[y], state[y], nearest)
    for y in range(height):
        if not held[y]:
            for k in range(1, height):
                if y - k >= 0 and held[y - k]:
                    d[y] = d[y - k]
                    break
                if y + k < height and held[y + k]:
                    d[y] = d[y + k]
                    break
            state[y] = FILLED


def filled(disparity: Singles) -> tuple[Singles, NDArray[np.uint8]]:
    """Fill what was not measured.

    Args:
        disparity: (H, W) px; NaN where nothing was measured, but not everywhere.

    Returns:
        (H, W) px without NaN, and (H, W) the state of every pixel.
    """
    out, state = disparity.copy(), np.where(np.isnan(disparity), np.uint8(FILLED), np.uint8(MEASURED))
    _fill(out, state)
    return out, state
