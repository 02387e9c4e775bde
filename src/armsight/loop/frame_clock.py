"""When the frames of a camera were exposed, from stamps that jitter.

In: the stamp of each frame, as driver or computer wrote it: late by a constant delay and by a jitter of its own. Out: the
stamp without most of the jitter. A camera that runs freely exposes periodically, to a few parts in a million; the jitter is
that of buses, drivers and schedulers. So time and period are the states of a Kalman filter whose memory fades over
``MEMORY`` frames, so that it follows a period that drifts with temperature.

Frames that were lost, or not asked for, are counted by the period; after a gap in which they cannot be, the time begins at
the next stamp, and the period is kept. A single stamp far from the prediction gets the predicted time; several mean that
the camera's rate has changed (auto exposure does that), and the filter begins again.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

#: Frames that the filter remembers: about 2 / MEMORY of the jitter's variance stays.
MEMORY = 80
#: Frames in a row that begin the filter, and as many that prove it; stamps that do not fit, among as many, until it begins
#: again.
_LEAST, _STRANGE = 8, 3
#: Two frames follow each other if their interval is at most so many of the shortest.
_NEXT = 1.6
#: A stamp does not fit beyond so many standard deviations, and so many seconds.
_GATE, _GATE_S = 5.0, 5e-4
#: With a sigma above this share of the period frames cannot be counted.
_COUNTABLE = 0.15


class FrameClock:
    """Tracks the time of one camera's frames.

    Attributes:
        period_s: time between two frames, s; 0 before it is known.
        jitter_s: standard deviation of the stamps about their prediction, s; 0 before it is known.
    """

    def __init__(self) -> None:
        self.period_s = self.jitter_s = 0.0
        self._first: list[float] = []  # stamps in a row, until there are enough
        self._newest_s = -math.inf
        self._t_s = math.nan
        # Covariance of time and period, s^2.
        self._tt = self._tp = self._pp = 0.0
        self._strange: deque[bool] = deque(maxlen=_LEAST)

    def time(self, stamp_s: float) -> float:
        """Return the time of a frame, s.

        Args:
            stamp_s: its stamp, s. Stamps come in their order; one that does not rise begins anew.
        """
        if not stamp_s > self._newest_s:
            self._begin()
        self._newest_s = stamp_s
        if self.period_s == 0.0:
            return self._begun(stamp_s)
        since = stamp_s - self._t_s
        n = max(round(since / self.period_s), 1)
        tt, tp = self._tt + 2 * n * self._tp + n * n * self._pp, self._tp + n * self._pp
        if tt > (_COUNTABLE * self.period_s) ** 2:  # the time begins here, the period is kept
            self._t_s, self._tt, self._tp = stamp_s, self.jitter_s**2, 0.0
            return stamp_s
        variance = tt + self.jitter_s**2
        gap = since - n * self.period_s
        odd = abs(gap) > max(_GATE * math.sqrt(variance), _GATE_S)
        self._strange.append(odd)
        if sum(self._strange) >= _STRANGE or self.jitter_s > _COUNTABLE * self.period_s:
            self._begin()
            return self._begun(stamp_s)
        if odd:
            return stamp_s - gap if len(self._strange) == _LEAST else stamp_s
        self._t_s = stamp_s - gap * (1.0 - tt / variance)
        self.period_s += tp / variance * gap
        fade = 1.0 + 2.0 / MEMORY
        self._pp = fade * (self._pp - tp * tp / variance)
        self._tp, self._tt = fade * tp * self.jitter_s**2 / variance, fade * tt * self.jitter_s**2 / variance
        self.jitter_s *= math.sqrt(1.0 + (gap * gap / variance - 1.0) / MEMORY)
        return self._t_s

    def _begin(self) -> None:
        """Forget everything."""
        self._first.clear()
        self._strange.clear()
        self.period_s = self.jitter_s = 0.0

    def _begun(self, stamp_s: float) -> float:
        """Take one of the stamps that begin: the line through enough of them in a row."""
        self._first.append(stamp_s)
        intervals = np.diff(self._first)
        if len(intervals) and intervals.max() > _NEXT * intervals.min():
            del self._first[: int(np.flatnonzero(intervals > _NEXT * intervals.min())[-1]) + 1]
        if len(self._first) < _LEAST:
            return stamp_s
        X = np.column_stack([np.ones(_LEAST), np.arange(1.0 - _LEAST, 1.0)])
        (t_s, period_s), (squares,), *_ = np.linalg.lstsq(X, np.array(self._first))
        variance = float(squares) / (_LEAST - 2)
        if variance > (_COUNTABLE * period_s) ** 2:  # no period
            del self._first[0]
            return stamp_s
        cov = variance * np.linalg.inv(X.T @ X)
        self._t_s, self.period_s, self.jitter_s = float(t_s), float(period_s), math.sqrt(variance)
        self._tt, self._tp, self._pp = float(cov[0, 0]), float(cov[0, 1]), float(cov[1, 1])
        return self._t_s
