"""Semi-global matching: the sum of the best paths from five or eight directions.

Hirschmueller, "Stereo processing by semiglobal matching and mutual information", PAMI 30(2), 2008, with census and
Birchfield and Tomasi's dissimilarity as the cost. The image is processed in strips of rows, each by itself from some
rows before it (with eight paths, behind it too): the memory is that of a strip, strips go to threads, and the
result is the same for any number of them.

The costs of the best paths that end in a pixel follow the recurrence (equation 13 of the same paper), in bytes: L(p, d)
= C(p, d) + min(L(q, d), L(q, d -+ 1) + P1, min L(q) + P2) - min L(q), with q the pixel before p on the path. With the
least of q subtracted no L is above C + P2, so a byte holds it as long as P1 + P2 plus the largest cost stays below 256;
a SIMD vector then holds twice as many disparities as with two bytes each.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from armsight.data import Image
from armsight.errors import InputError
from armsight.kernels import kernel
from armsight.vision.dense.cost import BLOCK, ONE, TWO, Bytes, CensusPair, prepare, raw_row, smooth_row
from armsight.vision.dense.method import Disparity, Search
from armsight.vision.dense.postprocess import SigmaModel, finished
from armsight.vision.dense.winner import STRIP_ROWS, Counts, Winners, choose_row, for_each_strip, make_winners

#: Bytes beyond the disparities in a slot of path costs: one before the first and one after the last are never the
#: least.
_GUARD = np.uintp(16)
#: Use of a row's path costs.
RUN_UP, WRITE, ADD = range(3)
Starts = NDArray[np.uintp]


class PathBuffers(NamedTuple):
    """The buffers of one strip of rows."""

    raw: Bytes  #: (3 * W * size,) raw costs of three rows
    mixed: Bytes  #: (W * size,) scratch
    #: slots of path costs, and a row's costs. Slots: two rows of W in three directions each, two pixels of each path
    #: along the row, and a start before which there is nothing
    arena: Bytes
    least: Bytes  #: (6 * W,) least cost of each slot of the first two rows
    total: Counts  #: (rows * W * size,) sum over the paths
    best_right: Counts  #: (W + pad,) least total of each pixel of the right row, mirrored


@kernel(nogil=True)
def make_work(width: int, size: int, pad: int, rows: int) -> PathBuffers:
    """Return room for a strip; ``rows`` totals are kept."""
    slot, n = size + int(_GUARD), width * size
    arena = np.full((6 * width + 5) * slot + n, 255, np.uint8)
    start = (6 * width + 4) * slot
    arena[start : start + size + 1] = 0
    return PathBuffers(
        np.empty(3 * n, np.uint8),
        np.empty(n, np.uint8),
        arena,
        np.zeros(6 * width, np.uint8),
        np.empty(rows * n, np.uint16),
        np.empty(width + pad, np.uint16),
    )


@kernel(nogil=True)
def cost_base(width: int, size: np.uintp) -> np.uintp:
    """Where in the arena a row's costs begin."""
    return np.uintp(6 * width + 5) * (size + _GUARD)


@kernel(nogil=True, inline="always")
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
        least_here = np.uint8(255)  # of this block alone: none waits for the one before
        for e in range(BLOCK):  # a fixed count: unrolled into whole vectors
            d = block + e
            slanted = np.uint8(min(arena[before + d], arena[before + d + TWO]) + p1)
            v = min(min(arena[before + d + ONE], slanted), jump)
            v = np.uint8(np.uint8(v - least) + arena[cost + d])
            arena[here + d + ONE] = v
            least_here = min(least_here, v)
        smallest = min(smallest, least_here)
    return smallest


@kernel(nogil=True, inline="always")
def _penalty(image: Bytes, y: int, x: int, from_y: int, from_x: int, p2: Bytes) -> np.uint8:
    """Return the penalty of a jump between two neighbouring pixels: less where the light jumps too."""
    return np.uint8(p2[abs(np.int32(image[y, x]) - np.int32(image[from_y, from_x]))])


@kernel(nogil=True, inline="always")
def _sum(arena: Bytes, slots: Starts, total: Counts, at: np.uintp, size: np.uintp, add: bool) -> None:
    """Sum four slots into a pixel's totals, or add them to what is there."""
    a, b, c, e = slots[0] + ONE, slots[1] + ONE, slots[2] + ONE, slots[3] + ONE
    for block in range(np.uintp(0), size, BLOCK):
        for k in range(BLOCK):
            d = block + k
            two = np.uint16(np.uint16(arena[a + d]) + np.uint16(arena[b + d]))
            four = np.uint16(two + np.uint16(np.uint16(arena[c + d]) + np.uint16(arena[e + d])))
            total[at + d] = np.uint16(four + total[at + d]) if add else four


@kernel(nogil=True, inline="always")
def _sum_one(arena: Bytes, slot: np.uintp, total: Counts, at: np.uintp, size: np.uintp, add: bool) -> None:
    """Write a slot to a pixel's totals, or add it to what is there."""
    for block in range(np.uintp(0), size, BLOCK):
        for k in range(BLOCK):
            d = block + k
            one = np.uint16(arena[slot + ONE + d])
            total[at + d] = np.uint16(one + total[at + d]) if add else one


@kernel(nogil=True)
def advance(
    work: PathBuffers,
    image: Bytes,
    y: int,
    from_y: int,
    keep: int,
    size: np.uintp,
    at: np.uintp,
    p1: np.uint8,
    p2: Bytes,
) -> None:
    """Advance the paths from row from_y, < 0 for none, to row y, and those along the row, right and left.

    The paths alternate pixel by pixel: those along the row depend on their own last step, and the others fill the
    waiting time. ``keep``: RUN_UP for no totals, WRITE to go along the row too and write them from ``at`` on, ADD to
    add to them; p1: penalty of a slant, p2 (256,): of a jump at each difference of grey levels.
    """
    width = image.shape[1]
    slot, costs, now = size + _GUARD, cost_base(width, size), y & 1
    start = np.uintp(6 * width + 4) * slot
    least_row, jump_row, least_left, jump_left, left = np.uint8(0), np.uint8(0), np.uint8(0), np.uint8(0), start
    s = np.full(4, start, np.uintp)
    for x in range(width):
        o = np.uintp(x) * size
        if keep == WRITE:
            to = width - 1 - x
            if x > 0:
                jump_row = _penalty(image, y, x, y, x - 1, p2)
                jump_left = _penalty(image, y, to, y, to + 1, p2)
            here = np.uintp(6 * width + (x & 1)) * slot
            least_row = _step(work.arena, s[3], here, costs + o, size, least_row, p1, jump_row)
            s[3] = here
            here, left_o = np.uintp(6 * width + 2 + (x & 1)) * slot, np.uintp(to) * size
            least_left = _step(work.arena, left, here, costs + left_o, size, least_left, p1, jump_left)
            left = here
        for side in range(-1, 2):
            from_x, to = x + side, (now * 3 + side + 1) * width + x
            before, least, jump = start, np.uint8(0), np.uint8(0)
            if from_y >= 0 and 0 <= from_x < width:
                slot_before = ((1 - now) * 3 + side + 1) * width + from_x
                before, least = np.uintp(slot_before) * slot, work.least[slot_before]
                jump = _penalty(image, y, x, from_y, from_x, p2)
            s[side + 1] = np.uintp(to) * slot
            work.least[to] = _step(work.arena, before, s[side + 1], costs + o, size, least, p1, jump)
        if keep != RUN_UP:  # of a pixel's two sums along the row the first writes, the second adds
            _sum(work.arena, s, work.total, at + o, size, keep == ADD or 2 * x >= width)
        if keep == WRITE:
            _sum_one(work.arena, left, work.total, at + left_o, size, 2 * x >= width - 1)


#: Where paths come from below too a strip's totals are kept: rows at most and bytes about.
_STRIP_ROWS_KEPT, _STRIP_BYTES = 96, 14e6
#: Rows that the paths run before they count: by then what lies further back is forgotten.
_RUN_UP = 24
#: Penalties in thirds of a census bit. P1, of a disparity that changes by one, is four bits: what noise changes in a
#: window. P2, of a jump, falls by half at an edge of _EDGE grey levels, for depth breaks where light does; the most of
#: the two and the largest cost must fit a byte.
_P1, _P2, _EDGE = 12, 80, 16
#: See postprocess.py.
_SIGMA_MODEL = SigmaModel(0.15, 0.25)


@kernel(nogil=True)
def _costs(
    pair: CensusPair, y: int, direction: int, begun: bool, first: int, count: int, size: np.uintp, work: PathBuffers
) -> None:
    """Write the costs of row y into the arena; the rows before it are there already once the strip has begun."""
    height, width = pair.left.shape
    n = np.uintp(width) * size
    for row in range(y - 1, y + 2):
        if 0 <= row < height and (not begun or row == y + direction):
            raw_row(pair, row, first, count, size, work.raw, np.uintp(row % 3) * n)
    smooth_row(y, height, size, work.raw, work.mixed, work.arena, cost_base(width, size))


@kernel("CensusPair, i8, i8, i8, i8, i8, u8, u1, u1[::1], Winners", nogil=True)
def _strip(
    pair: CensusPair,
    begin: int,
    end: int,
    paths: int,
    first: int,
    count: int,
    size: np.uintp,
    p1: np.uint8,
    p2: Bytes,
    found: Winners,
) -> None:
    height, width = pair.left.shape
    both_ways = paths == 8
    work = make_work(width, int(size), first + int(size), end - begin if both_ways else 1)
    n = np.uintp(width) * size
    top, bottom = max(0, begin - _RUN_UP), min(height, end + _RUN_UP)
    for y in range(top, end):
        at = np.uintp(y - begin if both_ways and y >= begin else 0) * n
        _costs(pair, y, 1, y > top, first, count, size, work)
        keep = WRITE if y >= begin else RUN_UP
        advance(work, pair.left, y, y - 1 if y > top else -1, keep, size, at, p1, p2)
        if y >= begin and not both_ways:
            choose_row(work.total, at, work.best_right, y, first, count, size, found)
    if both_ways:
        for y in range(bottom - 1, begin - 1, -1):
            at = np.uintp(y - begin if y < end else 0) * n
            _costs(pair, y, -1, y < bottom - 1, first, count, size, work)
            keep = ADD if y < end else RUN_UP
            advance(work, pair.left, y, y + 1 if y < bottom - 1 else -1, keep, size, at, p1, p2)
            if y < end:
                choose_row(work.total, at, work.best_right, y, first, count, size, found)


@dataclass(frozen=True)
class Semiglobal:
    """Semi-global matching over 5 or 8 paths; 5 are faster and need less memory, all from above or along the row."""

    paths: int = 8

    def __post_init__(self) -> None:
        """Check the number of paths."""
        if self.paths not in (5, 8):
            raise InputError(f"semi-global matching has 5 or 8 paths, not {self.paths}")

    def match(self, left: Image, right: Image, search: Search) -> Disparity:
        """Match a pair; see :class:`~armsight.vision.dense.method.Method`."""
        return finished(self.search(left, right, search), left, search, _SIGMA_MODEL, edges=True)

    def search(self, left: Image, right: Image, search: Search) -> Winners:
        """Find disparities, without rejecting, smoothing or filling any."""
        size = -(-search.count // int(BLOCK)) * int(BLOCK)
        pair, found = prepare(left, right, search.first + size), make_winners(*left.shape)
        steps = np.arange(256)
        p2 = np.maximum(_P2 * _EDGE // (_EDGE + steps), _P1 + 4).astype(np.uint8)

        def work(begin: int, end: int) -> None:
            _strip(pair, begin, end, self.paths, search.first, search.count, np.uintp(size), np.uint8(_P1), p2, found)

        kept = int(np.clip(_STRIP_BYTES / (2 * left.shape[1] * size), _RUN_UP, _STRIP_ROWS_KEPT))
        for_each_strip(left.shape[0], work, STRIP_ROWS if self.paths == 5 else kept)
        return found
