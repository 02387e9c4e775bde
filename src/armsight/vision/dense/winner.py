"""Choose the winning disparity: the least total, the consistency check with the right image, the sub-pixel position.

Both kinds of matching that sum costs, local and semi-global, end here. The right image's choice is made from the same
totals: the least over all left pixels that could be its match.

:func:`for_each_strip` distributes strips of rows to threads, with the same result for any number of them.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from armsight.kernels import kernel, kernel_types


def processors() -> int:
    """Return on how many processors this process may run."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


#: Rows of a strip at most; half: what strips share is computed more often; double: fewer strips than processors.
STRIP_ROWS = 192


def for_each_strip(height: int, work: Callable[[int, int], None], rows: int = STRIP_ROWS) -> None:
    """Call ``work(begin, end)``, compiled without the interpreter's lock, for strips of all rows, on all processors.

    Strips are about equal, of ``rows`` at most, and do not depend on the number of threads.
    """
    count = -(-height // rows)
    bounds = [height * k // count for k in range(count + 1)]
    threads = min(count, processors())
    if threads == 1:
        for begin, end in pairwise(bounds):
            work(begin, end)
        return
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(work, bounds[:-1], bounds[1:]))


Singles = NDArray[np.float32]
Counts = NDArray[np.uint16]
NOWHERE = np.uint16(65535)
#: Totals are searched in blocks of so many; a total, 1,456 at most, and its number in the block fit 16 bits.
_SHORT, _BITS, _LAST = np.uintp(32), np.uint16(5), np.uintp(31)


@kernel_types("f4[:, ::1], b1[:, ::1], f4[:, ::1], f4[:, ::1]")
class Winners(NamedTuple):
    """The winning disparity of every pixel of the left image."""

    disparity: Singles  #: (H, W) px, sub-pixel; the winner even where the images do not agree
    agreed: NDArray[np.bool_]  #: (H, W) whether the right image's choice is the same to one disparity
    curvature: Singles  #: (H, W) second difference of the totals at the winner; 0 at the ends of the search
    least: Singles  #: (H, W) the winner's total


def make_winners(height: int, width: int) -> Winners:
    """Return arrays for the winners."""
    single = [np.zeros((height, width), np.float32) for _ in range(3)]
    return Winners(single[0], np.zeros((height, width), np.bool_), single[1], single[2])


@kernel(nogil=True, inline="always")
def _tried(x: int, first: int, count: int) -> np.uintp:
    """Return how many disparities lead from column x to a pixel of the right image; one where none does."""
    return np.uintp(min(max(x - first + 1, 1), count))


@kernel(nogil=True, inline="always")
def _least_of(total: Counts, at: np.uintp, count: np.uintp, best_right: Counts, right: np.uintp) -> np.uint16:
    """Return the first disparity of least total, and let every right pixel, from ``right`` on, keep its own least."""
    least, where, whole = NOWHERE, np.uintp(0), count - count % _SHORT
    for block in range(np.uintp(0), whole, _SHORT):
        first = NOWHERE
        for e in range(_SHORT):  # a fixed count: unrolled into whole vectors
            d = block + e
            t = total[at + d]
            best_right[right + d] = min(best_right[right + d], t)
            first = min(first, np.uint16((t << _BITS) | np.uint16(e)))
        if (first >> _BITS) < least:
            least, where = np.uint16(first >> _BITS), block + (np.uintp(first) & _LAST)
    for d in range(whole, count):
        t = total[at + d]
        best_right[right + d] = min(best_right[right + d], t)
        if t < least:
            least, where = t, np.uintp(d)
    return np.uint16(where)


@kernel(nogil=True)
def choose_row(
    total: Counts, at: np.uintp, best_right: Counts, y: int, first: int, count: int, size: np.uintp, found: Winners
) -> None:
    """Choose the disparities of row y from its totals, ``size`` for each pixel from ``at`` on.

    best_right (W + pad,), least total of every right pixel, mirrored, is scratch.
    """
    width = found.disparity.shape[1]
    best_right[:] = NOWHERE
    # Pixels that share no right pixel follow one another: none stalls on the last one's write.
    for phase in range(count):
        for x in range(phase, width, count):
            n, right = _tried(x, first, count), np.uintp(width - 1 - x + first)
            found.disparity[y, x] = _least_of(total, at + np.uintp(x) * size, n, best_right, right)
    for x in range(width):
        n = _tried(x, first, count)
        o, d = at + np.uintp(x) * size, np.uintp(found.disparity[y, x])
        least, offset, curvature = np.float32(total[o + d]), np.float32(0), np.float32(0)
        if np.uintp(0) < d < n - np.uintp(1):
            below, above = (
                np.float32(total[o + d - np.uintp(1)]) - least,
                np.float32(total[o + d + np.uintp(1)]) - least,
            )
            curvature = below + above
            if curvature > 0:  # two lines of equal slope, not a parabola: the totals are sums of absolute differences
                offset = np.float32(0.5) * (below - above) / max(below, above)
        found.disparity[y, x] = np.float32(first) + np.float32(d) + offset
        found.curvature[y, x] = curvature
        found.least[y, x] = least
        found.agreed[y, x] = _agreed(total, at, best_right, x, found.disparity[y, x], first, count, size, width)


@kernel(nogil=True)
def _agreed(
    total: Counts,
    at: np.uintp,
    best_right: Counts,
    x: int,
    disparity: float,
    first: int,
    count: int,
    size: np.uintp,
    width: int,
) -> bool:
    """Return whether the right pixel that x was matched with chose x, or x's neighbour at the next disparity."""
    d = int(disparity + 0.5) - first
    if x - d - first < 0:
        return False
    least = total[at + np.uintp(x) * size + np.uintp(d)]
    if d > 0 and x > 0:
        least = min(least, total[at + np.uintp(x - 1) * size + np.uintp(d - 1)])
    if d + 1 < count and x + 1 < width:
        least = min(least, total[at + np.uintp(x + 1) * size + np.uintp(d + 1)])
    return bool(least <= best_right[width - 1 - x + first + d])
