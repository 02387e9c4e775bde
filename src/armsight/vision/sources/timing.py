"""When two free-running cameras are close enough in time to be one shot.

In: the time stamps of each stream, s. Out: its frame period, and the largest skew at which a left and a right frame
still belong together: half a period, since of two streams of one rate the nearest frames are never further apart.
"""

from __future__ import annotations

import itertools
import statistics
from collections import deque

#: Time stamps a period is taken from: long enough that a late frame does not move the median, short enough to follow
#: a camera that lengthens its exposure in the dark.
_STAMPS = 10


class Rhythm:
    """The frame period of one stream, learnt from its time stamps."""

    def __init__(self) -> None:
        self._stamps: deque[float] = deque(maxlen=_STAMPS)

    def tick(self, t_s: float) -> None:
        """Take the time stamp of one more frame, s."""
        self._stamps.append(t_s)

    @property
    def period_s(self) -> float | None:
        """Median interval of the recent frames, s; None before the second frame."""
        stamps = list(self._stamps)
        return statistics.median(b - a for a, b in itertools.pairwise(stamps)) if len(stamps) > 1 else None


def allowed_skew(left: Rhythm, right: Rhythm) -> float:
    """Return half the period of the faster stream, s; 0 while neither period is known."""
    return min((r.period_s for r in (left, right) if r.period_s is not None), default=0.0) / 2
