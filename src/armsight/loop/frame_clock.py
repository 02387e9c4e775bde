"""When the frames of a camera were exposed, from stamps that jitter.

In: the stamp of each frame, as driver or computer wrote it: late by a constant delay and by a jitter of its own. Out: the
stamp without most of the jitter. A camera that runs freely exposes periodically, to a few parts in a million; the jitter is
that of buses, drivers and schedulers. So time and period are tracked by a filter of growing memory (the least-squares line
through the stamps), whose memory ends at ``MEMORY`` frames, so that it follows a period that drifts with temperature.

Frames that were lost are counted by the period. A single stamp far from the line gets the line's time; several
mean that the camera's rate has changed (auto exposure does that), and the filter begins again.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

#: Frames that the filter remembers: 4 / MEMORY of the jitter's variance stays.
MEMORY = 120
#: Frames until the line's time is given out; stamps that do not fit, among as many frames, until the filter begins again.
_LEAST, _STRANGE = 8, 3
#: A stamp does not fit beyond so many standard deviations of the jitter, and so many seconds.
_GATE, _GATE_S = 5.0, 5e-4
#: With a jitter above this share of the period frames cannot be counted: stamps are given out as they are.
_PERIODIC = 0.2


class FrameClock:
    """Tracks the time of one camera's frames.

    Attributes:
        period_s: time between two frames, s; 0 before it is known.
        jitter_s: standard deviation of the stamps about the line, s; 0 before it is known.
    """

    def __init__(self) -> None:
        self.period_s = self.jitter_s = 0.0
        self._first: list[float] = []  # the first stamps
        self._t_s = math.nan
        self._count = 0
        self._strange: deque[bool] = deque(maxlen=_LEAST)

    def time(self, stamp_s: float) -> float:
        """Return the time of a frame, s.

        Args:
            stamp_s: its stamp, s. Stamps come in their order; one that does not rise begins anew.
        """
        if self._first and not stamp_s > self._first[-1]:
            self._begin()
        if len(self._first) < _LEAST:
            return self._begun(stamp_s)
        self._first[-1] = stamp_s
        since = stamp_s - self._t_s
        frames = max(round(since / self.period_s), 1)
        gap = since - frames * self.period_s
        odd = abs(gap) > max(_GATE * self.jitter_s, _GATE_S)
        self._strange.append(odd)
        if sum(self._strange) >= _STRANGE:
            self._begin()
            return self._begun(stamp_s)
        periodic = self.jitter_s < _PERIODIC * self.period_s
        if odd:
            return stamp_s - gap if periodic else stamp_s
        k = self._count = min(self._count + 1, MEMORY)
        # The variance of the stamps about the prediction, less what the prediction itself has of it.
        self.jitter_s = math.sqrt((1.0 - 1.0 / k) * self.jitter_s**2 + gap**2 / k / (1.0 + 4.0 / (k - 1)))
        self._t_s = stamp_s - gap * (1.0 - 2.0 * (2 * k - 1) / (k * (k + 1)))
        self.period_s += 6.0 / (k * (k + 1)) * gap / frames
        return self._t_s if periodic else stamp_s

    def _begin(self) -> None:
        """Forget everything."""
        self._first.clear()
        self._strange.clear()
        self.period_s = self.jitter_s = 0.0

    def _begun(self, stamp_s: float) -> float:
        """Take one of the first stamps: the line through them, frames counted by their shortest interval."""
        self._first.append(stamp_s)
        self._count = len(self._first)
        if self._count < _LEAST:
            return stamp_s
        stamps = np.array(self._first)
        numbers = np.concatenate([[0.0], np.cumsum(np.maximum(np.round(np.diff(stamps) / np.diff(stamps).min()), 1.0))])
        (self.period_s, begin_s), (squares,), *_ = np.polyfit(numbers, stamps, 1, full=True)
        self.jitter_s = math.sqrt(float(squares) / (_LEAST - 2))
        self._t_s = float(begin_s + self.period_s * numbers[-1])
        return self._t_s if self.jitter_s < _PERIODIC * self.period_s else stamp_s
