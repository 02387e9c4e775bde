"""Semi-global matching: the sum of the best paths from four, five or eight directions.

Hirschmueller, "Stereo processing by semiglobal matching and mutual information", PAMI 30(2), 2008, with census and
Birchfield and Tomasi's dissimilarity as the cost. The image is worked on in strips of rows, each by itself from some
rows before it (with four or eight paths, behind it too): the memory is that of a strip, strips go to threads, and the
result is the same for any number of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from armsight.data import Image
from armsight.errors import InputError
from armsight.vision.dense.cost import BLOCK, Bytes, Pair, prepare, raw_row, smooth_row
from armsight.vision.dense.postprocess import Trust, finished
from armsight.vision.dense.method import Disparity, Search
from armsight.vision.dense.paths import ADD, RUN_UP, WRITE, Work, cost_base, forward, leftward, make_work
from armsight.vision.dense.strips import on_strips
from armsight.vision.dense.winner import Found, choose_row, make_found

#: Rows of a strip where all paths come from above; where they come from below too and a strip's totals are kept, rows
#: at most and bytes about.
_STRIP_ROWS, _STRIP_ROWS_KEPT, _STRIP_BYTES = 384, 96, 14e6
#: Rows that the paths run before they count: by then what lies further back is forgotten.
_RUN_UP = 24
#: Penalties in thirds of a census bit. P1, of a disparity that changes by one, is four bits: what noise changes in a
#: window. P2, of a jump, falls by half at an edge of _EDGE grey levels, for depth breaks where light does; the most of
#: the two and the largest cost must fit a byte.
_P1, _P2, _EDGE = 12, 80, 16
#: See finish.py.
_TRUST = Trust(0.15, 0.25)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _costs(pair: Pair, y: int, direction: int, begun: bool, first: int, count: int, size: np.uintp, work: Work) -> None:
    """Put the costs of row y into the arena; the rows before it are there already once the strip has begun."""
    height, width = pair.left.shape
    n = np.uintp(width) * size
    for row in range(y - 1, y + 2):
        if 0 <= row < height and (not begun or row == y + direction):
            raw_row(pair, row, first, count, size, work.raw, np.uintp(row % 3) * n)
    smooth_row(y, height, size, work.raw, work.mixed, work.arena, cost_base(width, size))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _strip(
    pair: Pair,
    begin: int,
    end: int,
    paths: int,
    first: int,
    count: int,
    size: np.uintp,
    p1: np.uint8,
    p2: Bytes,
    found: Found,
) -> None:
    """Match the rows from ``begin`` to ``end``."""
    height, width = pair.left.shape
    both_ways, sides = paths != 5, 0 if paths == 4 else 1
    work = make_work(width, int(size), first + int(size), end - begin if both_ways else 1)
    n = np.uintp(width) * size
    top, bottom = max(0, begin - _RUN_UP), min(height, end + _RUN_UP)
    for y in range(top, end):
        at = np.uintp(y - begin if both_ways and y >= begin else 0) * n
        _costs(pair, y, 1, y > top, first, count, size, work)
        keep = WRITE if y >= begin else RUN_UP
        forward(work, pair.left, y, y - 1 if y > top else -1, sides, keep, size, at, p1, p2)
        if y >= begin:
            leftward(work, pair.left, y, size, at, p1, p2)
            if not both_ways:
                choose_row(work.total, at, work.best_right, y, first, count, size, found)
    if both_ways:
        for y in range(bottom - 1, begin - 1, -1):
            at = np.uintp(y - begin if y < end else 0) * n
            _costs(pair, y, -1, y < bottom - 1, first, count, size, work)
            keep = ADD if y < end else RUN_UP
            forward(work, pair.left, y, y + 1 if y < bottom - 1 else -1, sides, keep, size, at, p1, p2)
            if y < end:
                choose_row(work.total, at, work.best_right, y, first, count, size, found)


@dataclass(frozen=True)
class Semiglobal:
    """Semi-global matching.

    Attributes:
        paths: 4, 5 or 8. Five are fastest and need the least memory, for all come from above or along the row.
        edges: whether depth breaks are drawn again where the image has its edges (``edges.py``).
    """

    paths: int = 8
    edges: bool = True

    def __post_init__(self) -> None:
        """Check the number of paths."""
        if self.paths not in (4, 5, 8):
            raise InputError(f"semi-global matching has 4, 5 or 8 paths, not {self.paths}")

    def match(self, left: Image, right: Image, search: Search) -> Disparity:
        """Match a pair; see :class:`~armsight.vision.dense.method.Method`."""
        return finished(self.search(left, right, search), left, search, _TRUST, edges=self.edges)

    def search(self, left: Image, right: Image, search: Search) -> Found:
        """Find disparities, without judging, smoothing or filling them."""
        size = -(-search.count // int(BLOCK)) * int(BLOCK)
        pair, found = prepare(left, right, search.first + size), make_found(*left.shape)
        steps = np.arange(256)
        p2 = np.maximum(_P2 * _EDGE // (_EDGE + steps), _P1 + 4).astype(np.uint8)

        def work(begin: int, end: int) -> None:
            _strip(pair, begin, end, self.paths, search.first, search.count, np.uintp(size), np.uint8(_P1), p2, found)

        kept = int(np.clip(_STRIP_BYTES / (2 * left.shape[1] * size), _RUN_UP, _STRIP_ROWS_KEPT))
        on_strips(left.shape[0], _STRIP_ROWS if self.paths == 5 else kept, work)
        return found
