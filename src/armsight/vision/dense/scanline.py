"""Dynamic programming along rows, and votes between rows.

Birchfield and Tomasi, "Depth discontinuities by pixel-to-pixel stereo", IJCV 35(3), 1999: along a row, matches keep
their order, left pixels that the right camera cannot see are skipped, every break has a penalty, and a smaller one
where the light changes, for that is where depth breaks. A break to a lesser disparity starts from the best path up to
there only: their pruning. Where they forbid a break without an edge, it has a larger penalty here, and a slant of one
disparity per pixel is allowed anywhere, for surfaces slant.

Rows that are matched independently disagree in streaks, so they vote. In section 4 of the same paper disparities that
many rows agree on spread over those that few agree on, up to where the light changes. Here every pixel takes the
disparity that most of its column near it has, similar pixels counting more, and then the same along its row: no
thresholds, and a thin streak is outvoted.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from armsight.data import Image
from armsight.kernels import kernel
from armsight.vision.dense.cost import BLOCK, ONE, Bytes, CensusPair, prepare, raw_row, smooth_row
from armsight.vision.dense.method import Disparity, Search
from armsight.vision.dense.postprocess import SigmaModel, finished
from armsight.vision.dense.winner import Winners, for_each_strip, make_winners

Whole = NDArray[np.int16]
#: How far to either side, px, and the grey level difference that halves a vote.
_REACH, _ALIKE = 10, 8


@kernel("i2[:, ::1], const u1[:, ::1], f4[::1], i8, i8, i8, i8, i8, i2[:, ::1]", nogil=True)
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
    """Let neighbouring rows, and then columns, vote on disparities (H, W), -1 where a pixel was skipped.

    Return (H, W) those with most votes, -1 where there are none; ``count``: how many disparities there are.
    """
    weights = (_ALIKE / (_ALIKE + np.arange(256))).astype(np.float32)
    size = -(-count // 64) * 64
    for dy, dx in ((1, 0), (0, 1)):
        source, whole = whole, np.empty_like(whole)

        def work(begin: int, end: int, source: Whole = source, out: Whole = whole, dy: int = dy, dx: int = dx) -> None:
            _vote(source, image, weights, dy, dx, size, begin, end, out)

        for_each_strip(whole.shape[0], work)
    return whole


@kernel("i2[:, ::1], i8", nogil=True)
def seen(d: Whole, first: int) -> NDArray[np.bool_]:
    """Return which pixels (H, W) the right camera sees: no nearer pixel of the row is matched to the same column."""
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


#: Penalties in thirds of a census bit. Of a slant; of a break at an edge in the image and without one, so high that
#: noise in a window of 25 pixels does not cause it; of a skipped pixel, the cost of an ambiguous match. An edge is a
#: step of so many grey levels within a pixel to either side, Birchfield and Tomasi's own threshold.
_SLANT, _BREAK_AT_EDGE, _BREAK, _SKIPPED = np.int16(16), np.int16(150), np.int16(250), np.int16(39)
_EDGE = 5
_HIGH, _LOW = np.int16(16000), np.int16(-16000)
#: Entries beside a pixel's disparities, never the least: before the first and after the last.
_GUARD = np.uintp(32)
#: See postprocess.py.
_SIGMA_MODEL = SigmaModel(0.38)


class Table(NamedTuple):
    """The costs of the best ways to match a row from its left end up to a pixel, less their least.

    ``matched`` (W + 2, stride): with the pixel matched, flat; pixel x is entry x + 2; ``skipping``: with pixels skipped
    just before it, the break's cost not yet added; ``taken`` (W,): what was taken off; ``best`` (W,): disparity of the
    best way.
    """

    matched: Whole
    skipping: Whole
    taken: Whole
    best: Whole


@kernel(nogil=True, inline="always")
def _skip(table: Table, at: np.uintp, stride: np.uintp, size: np.uintp, taken: np.int16) -> None:
    """Write what it costs to have skipped the pixel before: one more skipped, or the first; disparity grows by one each."""
    matched, skipping = table.matched, table.skipping
    before, earlier = at - stride - ONE, at - stride - stride - ONE
    for d in range(size):
        value = np.int16(min(skipping[before + d], matched[earlier + d]) + np.int16(_SKIPPED - taken))
        skipping[at + d] = min(max(value, _LOW), _HIGH)


@kernel(nogil=True, inline="always")
def _ways(
    table: Table,
    at: np.uintp,
    stride: np.uintp,
    size: np.uintp,
    stop: np.int16,
    best: np.int16,
    costs: Bytes,
    cost: np.uintp,
) -> np.int16:
    """Write the costs of the best ways that end in a pixel, and return their least.

    Its disparities begin ``at`` in the table, the next pixel's ``stride`` further on, its matching costs at ``cost``.
    ``stop``: of a break here; ``best``: disparity of the best way to the pixel before, whose cost is zero.
    """
    matched, skipping, before = table.matched, table.skipping, at - stride
    least = _HIGH
    for d in range(size):
        slanted = np.int16(min(matched[before + d - ONE], matched[before + d + ONE]) + _SLANT)
        nearer = np.int16(0) if np.int16(d) < best else _HIGH
        broken = np.int16(min(nearer, skipping[at + d]) + stop)
        way = np.int16(min(min(matched[before + d], slanted), broken) + np.int16(costs[cost + d]))
        matched[at + d] = way
        least = min(least, way)
    return least


@kernel(nogil=True, inline="always")
def _take_off(matched: Whole, at: np.uintp, size: np.uintp, least: np.int16) -> np.int16:
    """Take the least off a pixel's ways, and return the last disparity that has it."""
    best = np.int16(0)
    for d in range(size):
        way = np.int16(matched[at + d] - least)
        matched[at + d] = way
        best = max(best, np.int16(d) if way == 0 else np.int16(0))
    return best


@kernel(nogil=True)
def _break_cost(image: Image, y: int, x: int) -> np.int16:
    """Return what a break before column x costs: less where the row's light changes within a pixel of it."""
    width = image.shape[1]
    low, high = 255, 0
    for u in range(max(x - 2, 0), min(x + 2, width)):
        low, high = min(low, int(image[y, u])), max(high, int(image[y, u]))
    return _BREAK_AT_EDGE if high - low >= _EDGE else _BREAK


@kernel(nogil=True)
def _forward(table: Table, image: Image, y: int, costs: Bytes, size: np.uintp) -> None:
    """Fill the table for row y."""
    stride = size + _GUARD
    for x in range(image.shape[1]):
        at = _GUARD + np.uintp(x + 2) * stride
        if x == 0:  # the way may begin at any disparity
            table.matched[at - stride : at - stride + size] = 0
            table.skipping[at : at + size] = _HIGH
            stop, best = _HIGH, np.int16(0)
        else:
            _skip(table, at, stride, size, table.taken[x - 1])
            stop, best = _break_cost(image, y, x), table.best[x - 1]
        table.taken[x] = _ways(table, at, stride, size, stop, best, costs, np.uintp(x) * size)
        table.best[x] = _take_off(table.matched, at, size, table.taken[x])
        if x == 0:
            table.matched[at - stride : at - stride + size] = _HIGH


@kernel(nogil=True)
def _backward(table: Table, image: Image, y: int, costs: Bytes, size: np.uintp, out: Whole) -> None:
    """Follow the best way back and write row y's disparities, -1 where a pixel was skipped."""
    matched, skipping, stride = table.matched, table.skipping, size + _GUARD
    x = image.shape[1] - 1
    d = int(table.best[x])
    while x >= 0:
        out[x] = d
        if x == 0:
            return
        at = _GUARD + np.uintp(x + 2) * stride + np.uintp(d)
        before = at - stride
        way = matched[at] + table.taken[x] - costs[np.uintp(x) * size + np.uintp(d)]
        x -= 1
        if way == matched[before]:
            continue
        if way == matched[before - ONE] + _SLANT:
            d -= 1
        elif way == matched[before + ONE] + _SLANT:
            d += 1
        elif table.best[x] > d and way == _break_cost(image, y, x + 1):
            d = int(table.best[x])
        else:
            while x > 0 and d > 0:  # one pixel skipped for every disparity that is lost
                out[x] = -1
                x, d, at = x - 1, d - 1, at - stride - ONE
                if skipping[at + stride + ONE] == matched[at - stride] + _SKIPPED - table.taken[x + 1]:
                    break


@kernel("CensusPair, i8, i8, i8, i8, u8, i2[:, ::1]", nogil=True)
def _strip(pair: CensusPair, begin: int, end: int, first: int, count: int, size: np.uintp, out: Whole) -> None:
    """Match the rows from ``begin`` to ``end``, each by itself."""
    height, width = pair.left.shape
    n, room = np.uintp(width) * size, (width + 3) * int(size + _GUARD)
    table = Table(
        np.full(room, _HIGH, np.int16),
        np.full(room, _HIGH, np.int16),
        np.zeros(width, np.int16),
        np.zeros(width, np.int16),
    )
    raw, mixed, costs = np.empty(3 * int(n), np.uint8), np.empty(int(n), np.uint8), np.empty(int(n), np.uint8)
    for y in range(begin, end):
        for row in range(y - 1, y + 2):
            if 0 <= row < height and (y == begin or row == y + 1):
                raw_row(pair, row, first, count, size, raw, np.uintp(row % 3) * n)
        smooth_row(y, height, size, raw, mixed, costs, np.uintp(0))
        _forward(table, pair.left, y, costs, size)
        _backward(table, pair.left, y, costs, size, out[y])


@dataclass(frozen=True)
class Scanline:
    """Dynamic programming along rows."""

    def match(self, left: Image, right: Image, search: Search) -> Disparity:
        """Match a pair; see :class:`~armsight.vision.dense.method.Method`."""
        return finished(self.search(left, right, search), left, search, _SIGMA_MODEL)

    def search(self, left: Image, right: Image, search: Search) -> Winners:
        """Find disparities, without rejecting, smoothing or filling any."""
        size = np.uintp(-(-search.count // int(BLOCK)) * int(BLOCK))
        pair, whole = prepare(left, right, search.first + int(size)), np.zeros(left.shape, np.int16)

        def work(begin: int, end: int) -> None:
            _strip(pair, begin, end, search.first, search.count, size, whole)

        for_each_strip(left.shape[0], work)
        found = make_winners(*left.shape)
        whole[whole >= search.count] = -1
        voted = vote(whole, left, search.count)
        found.agreed[:] = (whole >= 0) & seen(voted, search.first)
        found.curvature[:] = 1
        found.disparity[:] = voted + np.float32(search.first)
        return found
