"""Local matching: the least cost summed over a window, winner takes all.

By default the cost is census with absolute differences over a square window, which a running sum and vectors make fast
(``window.py``). The other costs and supports of the chapter's survey work on one disparity at a time (``support.py``):
absolute differences, zero-mean normalised correlation, windows shaped by arms of alike pixels (Zhang, Lu and Lafruit
2009) and the guided filter (Hosni et al., PAMI 35(2), 2013).
"""

from __future__ import annotations

from dataclasses import dataclass

from armsight.data import Image
from armsight.errors import InputError
from armsight.vision.dense.method import Disparity, Search
from armsight.vision.dense.postprocess import Trust, finished
from armsight.vision.dense.support import COSTS, SUPPORTS, match_planes
from armsight.vision.dense.window import look, make_room, match_windows
from armsight.vision.dense.winner import Found, make_found, on_strips

_STRIP_ROWS = 384
#: The largest window whose sum of raw costs still fits two bytes.
_REACH_MAX = 24
#: See finish.py.
_TRUST = Trust(0.17, 0.09)


@dataclass(frozen=True)
class Block:
    """Local matching.

    Attributes:
        cost: a key of COSTS, or "census" for the fast one.
        support: a key of SUPPORTS.
        reach: pixels to either side of the middle: the window is 2 reach + 1 wide, a shaped one at most.
    """

    cost: str = "census"
    support: str = "box"
    reach: int = 4

    def __post_init__(self) -> None:
        """Check the names and the size."""
        if self.cost not in ("census", *COSTS):
            raise InputError(f"unknown matching cost {self.cost!r}; known are census, {', '.join(COSTS)}")
        if self.support not in SUPPORTS:
            raise InputError(f"unknown support {self.support!r}; known are {', '.join(SUPPORTS)}")
        if not 1 <= self.reach <= _REACH_MAX:
            raise InputError(f"a window reaches 1 to {_REACH_MAX} px to either side, not {self.reach}")

    def match(self, left: Image, right: Image, search: Search) -> Disparity:
        """Match a pair; see :class:`~armsight.vision.dense.method.Method`."""
        return finished(self.search(left, right, search), left, search, _TRUST)

    def search(self, left: Image, right: Image, search: Search) -> Found:
        """Find disparities, without judging, smoothing or filling them."""
        if self.cost != "census" or self.support != "box":
            return match_planes(left, right, search, self.cost, self.support, self.reach)
        pad = search.last + 1
        looks, found = look(left, right, self.reach, pad), make_found(*left.shape)

        def work(begin: int, end: int) -> None:
            room = make_room(left.shape[1], self.reach, pad, search.count)
            match_windows(looks, begin, end, self.reach, search.first, search.count, pad, room, found)

        on_strips(left.shape[0], _STRIP_ROWS, work)
        return found
