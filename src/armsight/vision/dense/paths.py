"""Costs of the best paths that end in a pixel: the recurrence of semi-global matching, in bytes.

L(p, d) = C(p, d) + min(L(q, d), L(q, d -+ 1) + P1, min L(q) + P2) - min L(q), with q the pixel before p on the path:
equation 13 of Hirschmueller, "Stereo processing by semiglobal matching and mutual information", PAMI 30(2), 2008. With
the least of q taken away no L is above C + P2, so a byte holds it as long as P1 + P2 plus the largest cost stays below
256; a vector then holds twice the disparities that it holds of two bytes each.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from armsight.vision.dense.cost import BLOCK, ONE, TWO, Bytes
from armsight.vision.dense.winner import Counts

#: Bytes beyond the disparities in a slot of path costs: one before the first and one after the last are never the
#: least.
_GUARD = np.uintp(16)
#: What becomes of a row's path costs.
RUN_UP, WRITE, ADD = range(3)
Starts = NDArray[np.uintp]


class Work(NamedTuple):
    """What one strip of rows needs to be worked on.

    Attributes:
        raw: (3 * W * size,) raw costs of three rows.
        mixed: (W * size,) scratch.
        arena: slots of path costs, and a row's costs. Slots: two rows of W in three directions each, two pixels of the
            path along the row, and a start before which there is nothing.
        least: (6 * W,) least cost of each slot of the first two rows.
        total: (rows * W * size,) sum over the paths.
        best_right: (W + pad,) least total of each pixel of the right row, mirrored.
    """

    raw: Bytes
    mixed: Bytes
    arena: Bytes
    least: Bytes
    total: Counts
    best_right: Counts


@numba.njit(cache=True, nogil=True, error_model="numpy")
def make_work(width: int, size: int, pad: int, rows: int) -> Work:
    """Return room for a strip; ``rows`` totals are kept."""
    slot, n = size + int(_GUARD), width * size
    arena = np.full((6 * width + 3) * slot + n, 255, np.uint8)
    start = (6 * width + 2) * slot
    arena[start : start + size + 1] = 0
    return Work(
        np.empty(3 * n, np.uint8),
        np.empty(n, np.uint8),
        arena,
        np.zeros(6 * width, np.uint8),
        np.empty(rows * n, np.uint16),
        np.empty(width + pad, np.uint16),
    )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def cost_base(width: int, size: np.uintp) -> np.uintp:
    """Where in the arena a row's costs begin."""
    return np.uintp(6 * width + 3) * (size + _GUARD)


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _step(
    arena: Bytes,
    before: np.uintp,
    here: np.uintp,
    cost: np.uintp,
    size: np.uintp,
    least: np.uint8,
    p1: np.uint8,
    p2: np.uint8,
) -> np.uint8:
    """Go one pixel along a path: write its costs and return their least."""
    jump = np.uint8(least + p2)
    smallest = np.uint8(255)
    for block in range(np.uintp(0), size, BLOCK):
        for e in range(BLOCK):  # a fixed count: unrolled into whole vectors
            d = block + e
            slanted = np.uint8(min(arena[before + d], arena[before + d + TWO]) + p1)
            v = min(min(arena[before + d + ONE], slanted), jump)
            v = np.uint8(np.uint8(v - least) + arena[cost + d])
            arena[here + d + ONE] = v
            smallest = min(smallest, v)
    return smallest


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _penalty(image: Bytes, y: int, x: int, from_y: int, from_x: int, p2: Bytes) -> np.uint8:
    """Return the penalty of a jump between two neighbouring pixels: less where the light jumps too."""
    return np.uint8(p2[abs(np.int32(image[y, x]) - np.int32(image[from_y, from_x]))])


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _sum(arena: Bytes, slots: Starts, total: Counts, at: np.uintp, size: np.uintp, add: bool) -> None:
    """Sum four slots into a pixel's totals, or add them to what is there."""
    a, b, c, e = slots[0] + ONE, slots[1] + ONE, slots[2] + ONE, slots[3] + ONE
    for block in range(np.uintp(0), size, BLOCK):
        for k in range(BLOCK):
            d = block + k
            two = np.uint16(np.uint16(arena[a + d]) + np.uint16(arena[b + d]))
            four = np.uint16(two + np.uint16(np.uint16(arena[c + d]) + np.uint16(arena[e + d])))
            total[at + d] = np.uint16(four + total[at + d]) if add else four


@numba.njit(cache=True, nogil=True, error_model="numpy")
def forward(
    work: Work,
    image: Bytes,
    y: int,
    from_y: int,
    sides: int,
    keep: int,
    size: np.uintp,
    at: np.uintp,
    p1: np.uint8,
    p2: Bytes,
) -> None:
    """Go to row y on the paths from the row before, and along it to the right.

    The paths take turns pixel by pixel: the one along the row waits for its own last step, and the others fill the
    time.

    Args:
        work: the strip's room, the row's costs in it.
        image: (H, W) left image, for the steps between pixels.
        y: this row.
        from_y: the row before, above or below; < 0 where there is none.
        sides: 1 for the diagonals too, 0 for the straight path alone.
        keep: RUN_UP for no totals, WRITE to go along the row too and write them, ADD to add to them.
        size: disparities, padded.
        at: where the row's totals begin.
        p1: penalty of a slant.
        p2: (256,) penalty of a jump at each difference of grey levels.
    """
    width = image.shape[1]
    slot, costs, now = size + _GUARD, cost_base(width, size), y & 1
    start = np.uintp(6 * width + 2) * slot
    least_row, jump_row = np.uint8(0), np.uint8(0)
    s = np.full(4, start, np.uintp)
    for x in range(width):
        o = np.uintp(x) * size
        if keep == WRITE:
            if x > 0:
                jump_row = _penalty(image, y, x, y, x - 1, p2)
            here = np.uintp(6 * width + (x & 1)) * slot
            least_row = _step(work.arena, s[3], here, costs + o, size, least_row, p1, jump_row)
            s[3] = here
        for side in range(-sides, sides + 1):
            from_x, to = x + side, (now * 3 + side + 1) * width + x
            before, least, jump = start, np.uint8(0), np.uint8(0)
            if from_y >= 0 and 0 <= from_x < width:
                slot_before = ((1 - now) * 3 + side + 1) * width + from_x
                before, least = np.uintp(slot_before) * slot, work.least[slot_before]
                jump = _penalty(image, y, x, from_y, from_x, p2)
            s[side + 1] = np.uintp(to) * slot
            work.least[to] = _step(work.arena, before, s[side + 1], costs + o, size, least, p1, jump)
        if keep != RUN_UP:
            _sum(work.arena, s, work.total, at + o, size, keep == ADD)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def leftward(
    work: Work,
    image: Bytes,
    y: int,
    size: np.uintp,
    at: np.uintp,
    p1: np.uint8,
    p2: Bytes,
) -> None:
    """Go along row y to the left, and add to the totals; arguments as :func:`forward`."""
    width = image.shape[1]
    slot, costs = size + _GUARD, cost_base(width, size)
    start = np.uintp(6 * width + 2) * slot
    s = np.full(4, start, np.uintp)
    least, jump = np.uint8(0), np.uint8(0)
    for x in range(width - 1, -1, -1):
        o, here = np.uintp(x) * size, np.uintp(6 * width + (x & 1)) * slot
        if x < width - 1:
            jump = _penalty(image, y, x, y, x + 1, p2)
        least = _step(work.arena, s[0], here, costs + o, size, least, p1, jump)
        s[0] = here
        _sum(work.arena, s, work.total, at + o, size, True)
