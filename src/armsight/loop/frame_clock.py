"""When the frames of a camera were exposed, from stamps that jitter.

In: the stamp of each frame, as driver or computer wrote it: late by a constant delay and by a jitter of its own. Out: the
stamp without most of the jitter. A camera that runs freely exposes periodically, to a few parts in a million; the jitter is
that of buses, drivers and schedulers. So time and period are the states of a Kalman filter whose memory fades over
``MEMORY`` frames, so that it follows a period that drifts with temperature.

Clocks jump, restart at zero, or run fast. When an image arrived is known by another clock, that of the joints: an image
comes no sooner after its exposure than the soonest before it, and one after the other. Stamps that contradict this are not
used; once several agree, they are shifted so that images come as soon after their stamps as before. So are those of a clock
whose rate is beyond what two crystals differ by.

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
#: Frames in a row that begin the filter, and prove it; stamps that do not fit, among as many, until it begins again.
_LEAST, _STRANGE = 8, 3
#: Two frames follow each other if their interval is at most so many of the shortest.
_NEXT = 1.6
#: A stamp does not fit beyond so many standard deviations, and so many seconds.
_GATE, _GATE_S = 5.0, 5e-4
#: With a sigma above this share of the period frames cannot be counted.
_COUNTABLE = 0.15
#: So much sooner, or later than the soonest, an image contradicts its stamp, s; half: busy loops lose images, double:
#: jumps pass.
_EARLY_S, _LATE_S = 0.005, 0.25
#: So many newest images are the others; so many that contradict in a row, and agree, are a clock that jumped.
_OTHERS, _AGREE = 120, 4
#: A clock off by this rate is corrected, seen over double of so many seconds, or at once at so many times that.
_RATE, _SEEN_S, _SURE, _KEPT_S = 1e-3, 3, 3.0, 20


class FrameClock:
    """Tracks the time of one camera's frames.

    Attributes:
        period_s: time between two frames, s; 0 before it is known.
        jitter_s: standard deviation of the stamps about their prediction, s; 0 before it is known.
    """

    def __init__(self) -> None:
        #: when stamps were first shifted, s, and by how much in all, s; None while they are right
        self.stepped: tuple[float, float] | None = None
        self.rate = 0.0  #: by which share the clock runs fast
        self._shift_s = self._origin_s = 0.0
        self._broken = False
        self._late: deque[float] = deque(maxlen=_OTHERS)
        self._odd: deque[float] = deque(maxlen=_AGREE)
        self._soonest: deque[tuple[float, float]] = deque(maxlen=_KEPT_S)  # of each second: its time, how late
        self.period_s = self.jitter_s = 0.0
        self._first: list[float] = []  # stamps in a row, until there are enough
        self._newest_s = -math.inf
        self._t_s = math.nan
        # Covariance of time and period, s^2.
        self._tt = self._tp = self._pp = 0.0
        self._strange: deque[bool] = deque(maxlen=_LEAST)

    def time(self, stamp_s: float, arrived_s: float | None = None) -> float | None:
        """Return the time of a frame, s; None where its stamp contradicts when it arrived.

        Args:
            stamp_s: its stamp, s. Stamps come in their order; one that does not rise begins anew.
            arrived_s: when it arrived, s, by a clock that does not jump; None where that is not known.
        """
        if arrived_s is not None:
            sane_s = self._sane(stamp_s, arrived_s)
            if sane_s is None:
                return None
            stamp_s = sane_s
        return self._smoothed(stamp_s)

    def _shifted(self, stamp_s: float) -> float:
        """Return a stamp, s, with what is known of its clock removed."""
        return stamp_s + self._shift_s - self.rate / (1.0 + self.rate) * (stamp_s - self._origin_s)

    def _sane(self, stamp_s: float, arrived_s: float) -> float | None:
        """Return a stamp that agrees with the time of arrival, s; None where it does not."""
        if not math.isfinite(stamp_s):
            return None
        sane_s = self._shifted(stamp_s)
        late_s, soonest_s = arrived_s - sane_s, min(self._late, default=math.nan)
        # After a contradiction, or where the rhythm broke, it is to come as soon as usual.
        usual_s = sorted(self._late)[9 * len(self._late) // 10] if self._late else math.nan  # of ten, nine come as soon
        latest_s = usual_s + _EARLY_S if self._odd or self._broken else soonest_s + _LATE_S
        # A clock may have run fast, by less than its rate is corrected for, since the others came.
        early_s = _EARLY_S + (_RATE * (arrived_s - self._soonest[0][0]) if self._soonest else 0.0)
        if len(self._late) >= _AGREE and not (sane_s > self._newest_s and soonest_s - early_s < late_s < latest_s):
            self._odd.append(late_s)
            if len(self._odd) < _AGREE or max(self._odd) - min(self._odd) > 2 * _EARLY_S:
                return None
            if abs(min(self._odd) - soonest_s) >= _EARLY_S:  # else the loop was busy
                self._shift(min(self._odd) - soonest_s, arrived_s)
                return self._shifted(stamp_s)
        self._odd.clear()
        self._broken = False
        self._late.append(late_s)
        if not self._soonest or arrived_s - self._soonest[-1][0] >= 1.0:
            self._soonest.append((arrived_s, late_s))
            self._follow_rate(stamp_s)
        elif late_s < self._soonest[-1][1]:
            self._soonest[-1] = self._soonest[-1][0], late_s
        return self._shifted(stamp_s)

    def _shift(self, by_s: float, arrived_s: float) -> None:
        """Shift stamps by a time, s; to a whole number of periods from the newest frame, if arrivals agree."""
        if self.period_s > 0.0:
            since = arrived_s - min(self._odd) + by_s - self._t_s
            gap = since - round(since / self.period_s) * self.period_s
            by_s -= gap if abs(gap) < _EARLY_S else 0.0
        self._shift_s, self._broken = self._shift_s + by_s, False
        since_s, before_s = (arrived_s, 0.0) if self.stepped is None else self.stepped
        self.stepped = since_s, before_s + by_s
        self._odd.clear()
        self._soonest.clear()

    def _follow_rate(self, stamp_s: float) -> None:
        """Correct the rate of the clock where the soonest images of seconds come ever sooner or later.

        The slope is the median of those between any two seconds (Sen, 1968), of which nine in ten must agree.
        """
        if len(self._soonest) <= _SEEN_S:
            return
        t_s, late_s = np.array(self._soonest)[:-1].T
        drifts = np.diff(late_s) / np.diff(t_s)  # of a second by the joints' clock: less the rate
        newest = drifts[-2:]
        # An image that is late alone makes one of them large.
        sure = newest[0] * newest[1] > 0.0 and np.abs(newest).min() > max(_SURE * _RATE, abs(newest.mean()) / 1.5)
        first, second = np.triu_indices(len(t_s), 1)
        slopes = (late_s[second] - late_s[first]) / (t_s[second] - t_s[first])
        drift = float(newest.mean() if sure else np.median(slopes))
        least = float(np.quantile(slopes * np.sign(drift), 0.1))
        if not sure and (len(drifts) < 2 * _SEEN_S or least < (_RATE if self.rate == 0.0 else _RATE / 10.0)):
            return
        ahead_s = float(late_s[0] - late_s[-1]) - drift * float(self._soonest[-1][0] - t_s[-1])
        now_s = self._shifted(stamp_s) - ahead_s
        self.rate = (1.0 + self.rate) * (1.0 - drift) - 1.0
        self._shift_s, self._origin_s = now_s - stamp_s, stamp_s
        self.stepped = self.stepped or (float(t_s[-3 if sure else 0]), 0.0)
        self._late.clear()
        self._soonest.clear()
        self._newest_s = -math.inf

    def _smoothed(self, stamp_s: float) -> float | None:
        """Return a stamp that rises, s, without most of its jitter; None where arrivals are to say whether it jumped."""
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
            self._broken = True
            return self._begun(stamp_s)
        if odd and self._late and abs(gap) > _EARLY_S:
            return None
        if odd:
            return stamp_s - gap if len(self._strange) == _LEAST else stamp_s
        self._t_s = stamp_s - gap * (1.0 - tt / variance)
        self.period_s += tp / variance * gap
        # What is not known of time and period grows as the variance of the jitter that it follows from.
        more = 1.0 + (gap * gap / variance - 1.0) / MEMORY
        fade = (1.0 + 2.0 / MEMORY) * more
        self._pp = fade * (self._pp - tp * tp / variance)
        self._tp, self._tt = fade * tp * self.jitter_s**2 / variance, fade * tt * self.jitter_s**2 / variance
        self.jitter_s *= math.sqrt(more)
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
