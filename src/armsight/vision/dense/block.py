"""Local matching: the least cost summed over a square window, winner takes all.

The cost is census with absolute differences; a running sum and SIMD vectors make it fast (``window.py``).
"""

from __future__ import annotations

from dataclasses import dataclass

from armsight.data import Image
from armsight.errors import InputError
from armsight.vision.dense.method import Disparity, Search
from armsight.vision.dense.postprocess import SigmaModel, finished
from armsight.vision.dense.window import make_buffers, match_windows, prepare_planes
from armsight.vision.dense.winner import Winners, for_each_strip, make_winners

_STRIP_ROWS = 384
#: The largest window whose sum of raw costs still fits two bytes.
_REACH_MAX = 24
#: See postprocess.py.
_SIGMA_MODEL = SigmaModel(0.17, 0.09)


@dataclass(frozen=True)
class Block:
    """Local matching.

    Attributes:
        reach: pixels to either side of the middle: the window is 2 reach + 1 wide.
    """

    reach: int = 4

    def __post_init__(self) -> None:
        """Check the size."""
        if not 1 <= self.reach <= _REACH_MAX:
            raise InputError(f"a window reaches 1 to {_REACH_MAX} px to either side, not {self.reach}")

    def match(self, left: Image, right: Image, search: Search) -> Disparity:
        """Match a pair; see :class:`~armsight.vision.dense.method.Method`."""
        return finished(self.search(left, right, search), left, search, _SIGMA_MODEL)

    def search(self, left: Image, right: Image, search: Search) -> Winners:
        """Find disparities, without rejecting, smoothing or filling any."""
        pad = search.last + 1
        planes, found = prepare_planes(left, right, self.reach, pad), make_winners(*left.shape)

        def work(begin: int, end: int) -> None:
            buffers = make_buffers(left.shape[1], self.reach, pad, search.count)
            match_windows(planes, begin, end, self.reach, search.first, search.count, pad, buffers, found)

        for_each_strip(left.shape[0], _STRIP_ROWS, work)
        return found
