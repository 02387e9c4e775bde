"""Whether a number of a cell drifts: the slope of its recent means, against the slopes of its past and of its siblings.

The scatter about one line does not say how steep lines are by chance: air, lamps and a warm board move means for
minutes. The slopes of windows that do not overlap, of this cell before and of the other cells now, do. Their median
size is the scale, so that a few cells that do drift hardly change it, and the chance is Student's with their number.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.special import chdtri, stdtr

#: s of a block of means, and how many blocks a slope is taken over; half: noisier, double: later named.
BLOCK_S, BLOCKS = 10.0, 60
#: blocks that a slope needs; half: two minutes are enough and noisy, double: nothing is ranked in the first five.
_LEAST = BLOCKS // 4
#: s between two looks for drifts; half: chance is checked twice as often, double: named a minute later.
LOOK_S = 60.0
#: Chance of one look at one of two numbers: a false one a cell and week at most. Half: a drift is named later, double:
#: two false alarms a week.
CHANCE = LOOK_S / (2 * 7 * 86400)
#: slopes that a scale needs; half: a scale that is a third off, double: a single cell says nothing for four hours.
_SLOPES = 8


@dataclass(frozen=True)
class Drift:
    """A slope against what slopes are by chance.

    Attributes:
        per_h: the slope an hour, in the number's unit.
        sigma_per_h: one sigma of slopes by chance; NaN while that is unknown.
        chance: how probable a slope as steep is where nothing drifts; 1 while that is unknown.
    """

    per_h: float
    sigma_per_h: float
    chance: float


@dataclass
class Slopes:
    """The recent means of one number, and the slopes of earlier windows."""

    blocks: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=BLOCKS))
    past: deque[float] = field(default_factory=lambda: deque(maxlen=144))  # of a day, of windows that do not overlap
    _number: int = 0

    def add(self, t_s: float, mean: float) -> None:
        """Take the mean of a block at its time, s."""
        self.blocks.append((t_s, mean))
        self._number += 1
        if self._number % BLOCKS == 0 and (slope := self.per_h(t_s, BLOCKS)) is not None:
            self.past.append(slope)

    def begin_anew(self) -> None:
        """Forget the window: what follows is not to be compared with it."""
        self.blocks.clear()
        self._number = 0

    def count(self, now_s: float) -> int:
        """Return how many blocks of the last window there are."""
        # The newest is half a block old when it is complete, and the next one is being filled.
        return sum(now_s - t < (BLOCKS + 2) * BLOCK_S for t, _ in self.blocks)

    def per_h(self, now_s: float, count: int) -> float | None:
        """Return the slope of a line through the newest ``count`` blocks, an hour; None where they are too few."""
        if count < _LEAST or self.count(now_s) < count:
            return None
        t, mean = np.array(self.blocks)[-count:].T
        t = (t - t.mean()) / 3600.0
        return float(t @ mean / (t @ t))


def drifts(cells: Mapping[str, Slopes], now_s: float) -> dict[str, Drift]:
    """Compare the slopes of one number of all cells, each with those of as many blocks.

    Args:
        cells: name -> its means.
        now_s: the time now, s.

    Returns:
        Name -> its drift; those of too few means are left out.
    """
    found: dict[str, Drift] = {}
    counts = {name: each.count(now_s) for name, each in cells.items()}
    for count in sorted(set(counts.values())):
        slopes = {name: each.per_h(now_s, count) for name, each in cells.items()}
        for name, slope in slopes.items():
            if slope is not None and counts[name] == count:
                siblings = [other for each, other in slopes.items() if each != name and other is not None]
                found[name] = _against(slope, siblings, list(cells[name].past) if count == BLOCKS else [])
    return found


def _against(slope: float, *sources: Sequence[float]) -> Drift:
    """Compare a slope with others: those of the source in which slopes are larger."""
    of_sigma = math.sqrt(chdtri(1, 0.5))  # the median size of a normal variable
    known = [(float(np.median(np.abs(each))) / of_sigma, len(each)) for each in sources if len(each) >= _SLOPES]
    scale, count = max(known, default=(0.0, 0))
    if not scale > 0.0:
        return Drift(slope, math.nan, 1.0)
    # A median of sizes has the precision of a mean square of 0.37 times as many (its efficiency for normal variables).
    freedom = max(0.37 * count, 1.0)
    return Drift(slope, scale, float(2.0 * stdtr(freedom, -abs(slope) / scale)))
