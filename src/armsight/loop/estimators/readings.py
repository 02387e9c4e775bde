"""The potentiometers' readings of the last seconds: smoothed, with speeds, and with what hysteresis depends on.

In: JointStates. Out: joint angles and speeds at any time kept, and what smoothing leaves of a reading's noise. At a time t
a parabola is laid through the readings around it, or before it where it is the newest (``parabola``). Beside each reading
stands how far every joint has travelled and on which side of its backlash it should be, twice: if friction decides on it,
the backlash operator (Krasnosel'skii and Pokrovskii, "Systems with hysteresis", 1989), behind a dead zone that
the readings' noise does not cross; if gravity and inertia do, where its link floats (``backlash_dynamics``).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, JointStates
from armsight.errors import InputError
from armsight.geometry.check import checked
from armsight.kernels import kernel
from armsight.loop.estimators.backlash_dynamics import float_on, loose, masses
from armsight.loop.estimators.parabola import LONG_SPAN_S, PARABOLA, SPAN_S, fit, span, window
from armsight.robot.kinematics.arm import Arm

#: A joint that shows no motion within this time stands still, s, and is averaged over it.
STILL_SPAN_S = 0.3
#: What counts as motion, in standard deviations: of the two halves' means, and of parabola and mean.
_MOTION = 3.0
#: Readings kept, s.
KEPT_S = 2.0
#: Dead zone before a joint counts as moved, sigmas of a reading; half: noise changes sides, double: sides change late.
_DEAD = 5.0
#: Within the dead zone a joint's position settles to its readings with this time constant, s.
_SETTLE_S = 0.3
#: Travel over which a joint changes the side of its backlash until that is known, rad: the middle of what gears have.
GAP_RAD = np.deg2rad(0.2)
#: The least of it, rad: narrower, noise would change it.
MIN_GAP_RAD = np.deg2rad(0.05)
#: What counts as motion of an arm, in standard deviations of a speed; while it stands, its links do.
_STILL = 4.0
#: So often links float anew through the rows that are not settled yet, s.
_AGAIN_S = 0.012
#: Residuals show motion that no parabola follows where their squares exceed the mean by so many sigmas, and are no
#: noise.
_MISFIT, _WHITE = 4.0, 1.5
#: The period that counts where a reading stands alone, s.
_MIN_PERIOD_S = 1e-3
#: So long the error of rounding lasts at most, s: a joint at rest.
_LONGEST_S = 100.0
#: Rows of the memory; at 1 kHz twice what is kept.
_ROWS = 4096

# Kernels of some microseconds keep the interpreter: to get it back from a busy thread takes longer.


class Smoothed(NamedTuple):
    """The joints at (N,) times."""

    q: Array  #: (N, n) angles, rad
    qd: Array  #: (N, n) speeds, rad/s
    variance: Array  #: (N, n) what is left of a reading's variance
    lasts_s: Array  #: (N, n) how long what is left of the noise lasts, s: the time constant of its correlation
    #: (N, 3, n) what the links' angles beyond their shafts depend on. First the side of the backlash if friction
    #: decides on it, -1 to 1: 1 when the joint came up from below; then if gravity and inertia do; then the lever of
    #: what inertia does to a unit load, m
    unseen: Array
    travel: Array  #: (N, n) how far the joint has moved in all, rad
    flips: Array  #: (N, 2, n) how far the two sides have moved in all

    def rows(self, begin: int, end: int) -> Smoothed:
        """Return those at some of the times."""
        return Smoothed(*(part[begin:end] for part in self))


@kernel
def _take(t: Array, q: Array, memory: Array, first: int, begin: int, end: int, dead: float, gap: Array) -> None:
    """Write travel, flips, side, and the position behind the dead zone, of rows begin to end into memory (N, 8, n)."""
    motion = np.empty((3, q.shape[1]))
    angles = motion[0]
    for k in range(begin, end):
        low, high = window(t, first, k - first + 1, t[k], SPAN_S)
        fit(t, q, low, high, t[k], motion)
        for i in range(q.shape[1]):
            if k == first:
                memory[k, :3, i] = 0.0
                memory[k, 3, i] = angles[i]
                continue
            was, side = memory[k - 1, 3, i], memory[k - 1, 2, i]
            moved = min(max(was, angles[i] - 0.5 * dead), angles[i] + 0.5 * dead)
            moved += (angles[i] - moved) * min((t[k] - t[k - 1]) / _SETTLE_S, 1.0)
            now = min(max(side + 2 * (moved - was) / gap[i], -1.0), 1.0)
            memory[k, 0, i] = memory[k - 1, 0, i] + abs(moved - was)
            memory[k, 1, i] = memory[k - 1, 1, i] + abs(now - side)
            memory[k, 2, i], memory[k, 3, i] = now, moved


@kernel
def _rest(
    t: Array, q: Array, low: int, high: int, at: float, sigma: float, angles: Array, speeds: Array, variance: Array,
    noise: Array,
) -> None:  # fmt: skip
    """Replace fitted angles (n,) by the means of rows low to high for joints that stand still meanwhile.

    Also for joints that drift a little, as far as the rows lie around the time: there drift does not move the mean.
    """
    half, n = (high - low + 1) // 2, high - low + 1
    aside = abs(2 * at - t[low] - t[high]) / (t[high] - t[low])
    for i in range(q.shape[1]):
        early = late = 0.0
        for k in range(half):
            early += q[low + k, i]
            late += q[high - k, i]
        mean, drift = (early + late) / (2 * half), (late - early) / half
        chance = _MOTION * sigma * math.sqrt(2.0 / half)
        stands = abs(drift) * aside <= chance and abs(drift) <= max(chance, sigma)
        if stands and abs(angles[i] - mean) < _MOTION * sigma * math.sqrt(variance[i]):
            angles[i], variance[i], noise[i] = mean, 1.0 / n, 1.0
            speeds[i] = 2 * drift / (t[high] - t[low]) if abs(drift) > chance else 0.0


@kernel
def _misfit(
    t: Array, q: Array, i: int, low: int, high: int, at: float, sigma: float, motion: Array
) -> tuple[bool, float]:
    """Return whether joint ``i`` moved otherwise from row low to high than by the parabola of ``motion`` (3, n) at a time.

    And the variance of its residuals, in those of a reading, where it is more by more than chance; 1 where not.
    The ratio of the two sums is that of von Neumann (Ann. Math. Statist. 12, 1941): noise of any size is no misfit.
    """
    square = apart = before = 0.0
    for k in range(low, high + 1):
        u = t[k] - at
        left = q[k, i] - (motion[0, i] + (motion[1, i] + 0.5 * motion[2, i] * u) * u)
        square += left * left
        if k > low:
            apart += (left - before) ** 2
        before = left
    free = max(high - low - 2, 1)
    if square <= sigma**2 * (free + _MISFIT * math.sqrt(2.0 * free)):
        return False, 1.0
    return apart < _WHITE * square, square / (sigma**2 * free)


@kernel
def _shortened(
    t: Array, q: Array, first: int, count: int, at: float, length: float, sigma: float, motion: Array, variance: Array,
    noise: Array,
) -> None:  # fmt: skip
    """Replace angles ``motion[0]`` and ``variance`` (n,) of joints whose motion no parabola follows over a span of time, s.

    Those of parabolas over half of the span, a quarter of it and so on, and at last of a line between the two readings
    around the time. Speeds stay those of the whole span. ``noise`` (n,) becomes what residuals show.
    """
    noise[:] = 1.0
    low, high = window(t, first, count, at, length)
    bad = 0
    for i in range(q.shape[1]):
        if high - low + 1 >= PARABOLA:
            misfit, noise[i] = _misfit(t, q, i, low, high, at, sigma, motion)
            variance[i] = -1.0 if misfit else variance[i] * noise[i]
            bad += 1 if misfit else 0
    short = np.empty_like(motion)
    while bad:
        length *= 0.5
        low, high = window(t, first, count, at, length)
        if high - low + 1 < PARABOLA:
            break
        share = fit(t, q, low, high, at, short)
        for i in range(q.shape[1]):
            if variance[i] < 0.0:
                misfit, noise[i] = _misfit(t, q, i, low, high, at, sigma, short)
                if not misfit:
                    motion[0, i], variance[i], bad = short[0, i], share * noise[i], bad - 1
    if bad:
        k = first + min(max(int(np.searchsorted(t[first : first + count], at, side="right")), 1), count - 1)
        part = (at - t[k - 1]) / (t[k] - t[k - 1])
        for i in range(q.shape[1]):
            if variance[i] < 0.0:
                step = q[k, i] - q[k - 1, i]  # where between them the joint was is known no better
                motion[0, i], noise[i] = q[k - 1, i] + part * step, 1.0 + (step / sigma) ** 2 / 12.0
                variance[i] = noise[i]


@kernel
def _round(variance: Array, lasts: Array, speeds: Array, step: float, sigma: float) -> None:
    """Add to variances (n,) and times (n,) that noise lasts what rounding readings to whole steps leaves of its own.

    Its error is a sawtooth of the angle. Slow ones pass a parabola, as that of a joint at rest does; of one that passes D
    steps meanwhile about 1 / (1 + 40 D^4) of the variance is left. It lasts until the joint has moved by a step.
    """
    if step == 0.0:
        return
    for i in range(len(variance)):
        speed, white = abs(speeds[i]), variance[i]
        steps = 2.0 * lasts[i] * speed / step  # in the time over which the mean is taken
        rounded = (step / sigma) ** 2 / 12.0 / (1.0 + 40.0 * steps**4)
        until = min(step / max(speed, 1e-9), _LONGEST_S)
        lasts[i] = (white * lasts[i] + rounded * until) / (white + rounded)
        variance[i] = white + rounded


@kernel(
    "f8[::1], f8[:, ::1], f8[:, :, ::1], i8, i8, f8[::1], f8, f8, f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], "
    "f8[:, :, ::1], f8[:, ::1], f8[:, :, ::1]"
)
def _smooth(
    t: Array, q: Array, memory: Array, first: int, count: int, at: Array, sigma: float, step: float, qs: Array,
    qds: Array, variance: Array, lasts: Array, unseen: Array, travel: Array, flips: Array,
) -> bool:  # fmt: skip
    """Write the joints at times (N,) into the parts of a :class:`Smoothed`; return whether all are within those kept."""
    motion, noise, newest = np.empty((3, q.shape[1])), np.empty(q.shape[1]), t[first + count - 1]
    for n in range(len(at)):
        if not t[first] <= at[n] <= newest:
            return False
        length = span(at[n], newest)
        low, high = window(t, first, count, at[n], length)
        variance[n] = fit(t, q, low, high, at[n], motion)
        _shortened(t, q, first, count, at[n], length, sigma, motion, variance[n], noise)
        qs[n], qds[n] = motion[0], motion[1]
        period = (t[high] - t[low]) / max(high - low, 1)
        low, high = window(t, first, count, at[n], STILL_SPAN_S)
        if high - low > 4 * PARABOLA:
            _rest(t, q, low, high, at[n], sigma, qs[n], qds[n], variance[n], noise)
        # The correlation's integral over all lags is, of any weights w that sum to one, the period over the sum of w^2.
        lasts[n] = 0.5 * max(period, _MIN_PERIOD_S) * noise / variance[n]
        _round(variance[n], lasts[n], qds[n], step, sigma)
        k = first + max(np.searchsorted(t[first : first + count], at[n], side="right") - 1, 0)
        for i in range(q.shape[1]):
            unseen[n, 0, i], unseen[n, 1, i], unseen[n, 2, i] = memory[k, 2, i], -memory[k, 4, i], memory[k, 7, i]
            travel[n, i] = memory[k, 0, i]
            flips[n, 0, i], flips[n, 1, i] = memory[k, 1, i], memory[k, 6, i]
    return True


@kernel("f8[::1], f8[:, ::1], f8[:, :, ::1], i8, i8, i8, i8, f8, f8[::1], const f8[::1], f8[:, ::1], f8[:, ::1], f8")
def _take_on(
    t: Array, q: Array, memory: Array, first: int, settled: int, begin: int, end: int, dead: float, gap: Array,
    table: Array, points: Array, beside: Array, still: float,
) -> int:  # fmt: skip
    """Update the memory by new rows begin to end, links from row ``settled`` on; return the first unsettled row."""
    _take(t, q, memory, first, begin, end, dead, gap)
    float_on(t, q, memory[:, 4:], first, settled, end, table, points, beside, still, gap)
    return max(int(np.searchsorted(t[:end], t[end - 1] - 0.5 * LONG_SPAN_S)), settled)


@kernel("f8[::1], f8[:, ::1], i8, i8, f8")
def _rising(t: Array, q: Array, begin: int, end: int, before: float) -> bool:
    """Return whether rows begin to end are numbers and their times rise from the one before."""
    for k in range(begin, end):
        if not before < t[k] < np.inf:
            return False
        before = t[k]
        for i in range(q.shape[1]):
            if not abs(q[k, i]) < np.inf:
                return False
    return True


class Readings:
    """The last seconds of the potentiometers.

    Args:
        arm: whose joints they are.
        rounded_rad: what readings are rounded to where their noise does not exceed it, rad; 0: to nothing.
    """

    def __init__(self, sigma_rad: float, arm: Arm, rounded_rad: float = 0.0) -> None:
        # The variance that a parabola leaves at its end is 9/N.
        self._dead = _DEAD * sigma_rad * np.sqrt(9 / (SPAN_S * 1000))
        self._gap, self._sigma, self._joints = np.full(arm.joints, GAP_RAD), sigma_rad, arm.joints
        self._step = rounded_rad
        # Beside each reading: travel, flips, side, position behind the dead zone; then what ``backlash_dynamics`` writes.
        self._t, self._q, self._memory = (
            np.empty(_ROWS),
            np.empty((_ROWS, arm.joints)),
            np.zeros((_ROWS, 8, arm.joints)),
        )
        self._first = self._count = self._settled = 0
        self._gone_s = -np.inf
        # The variance that a parabola leaves of its slope at its end is 192/(N SPAN^2).
        self._still = float(_STILL * sigma_rad * np.sqrt(192 / (SPAN_S * 1000)) / SPAN_S)
        self._table, (self._points, self._beside) = arm.table, masses(arm)

    @property
    def span_s(self) -> tuple[float, float]:
        """The oldest and the newest time kept, s.

        Raises:
            InputError: no reading has come yet.
        """
        if not self._count:
            raise InputError("the estimator has no potentiometer readings yet; give it joints() first")
        return float(self._t[self._first]), float(self._t[self._first + self._count - 1])

    def loose(self, q: Array) -> NDArray[np.bool_]:
        """Return which links (n,) stay where they are in their backlash, unloaded by gravity, at angles (n,), rad."""
        out = np.empty(self._joints)
        loose(self._table, self._points, self._beside, q, out)
        return out > 0.0

    def set_backlash(self, width_rad: Array) -> None:
        """Set the width of each joint's backlash (n,), rad, for the readings from here on."""
        self._gap = np.maximum(width_rad, MIN_GAP_RAD)

    def add(self, states: JointStates) -> None:
        """Take readings; wrong shapes, NaN, or times that do not rise are an InputError."""
        t, q = np.asarray(states.t_s, dtype=float), np.asarray(states.q, dtype=float)
        if t.ndim != 1 or q.shape != (len(t), self._joints):
            checked(t, (None,), "JointStates.t_s")
            checked(q, (len(t), self._joints), "JointStates.q")
        half = _ROWS // 2
        for part in range(0, len(t), half):
            self._append(t[part : part + half], q[part : part + half])

    def _append(self, t: Array, q: Array) -> None:
        end = self._first + self._count
        before = self._t[end - 1] if self._count else -np.inf
        if end + len(t) > _ROWS:
            keep = max(int(np.searchsorted(self._t[:end], self._t[end - 1] - KEPT_S)), end - _ROWS // 2)
            for memory in (self._t, self._q, self._memory):
                memory[: end - keep] = memory[keep:end].copy()
            self._first, self._count, end, self._settled = 0, end - keep, end - keep, max(self._settled - keep, 0)
        begin, end = end, end + len(t)
        self._t[begin:end], self._q[begin:end] = t, q
        if not _rising(self._t, self._q, begin, end, before):
            checked(t, (None,), "JointStates.t_s")
            checked(q, (len(t), self._joints), "JointStates.q")
            raise InputError("potentiometer readings must come in order of time; the times given do not rise")
        self._count += len(t)
        # Only the very first row starts the hysteresis; later ones carry on from the row before.
        # The newest rows are smoothed by what came before them alone; when more has come, they are gone through again.
        again = self._t[end - 1] - self._gone_s >= _AGAIN_S
        rows = self._first, self._settled if again else begin, begin, end
        links = self._table, self._points, self._beside
        settled = _take_on(self._t, self._q, self._memory, *rows, self._dead, self._gap, *links, self._still)
        if again:
            self._gone_s, self._settled = self._t[end - 1], settled

    def at(self, t_s: Array) -> Smoothed:
        """Return the joints at (N,) times within those kept.

        Raises:
            InputError: not within them.
        """
        oldest, newest = self.span_s
        at, n, j = np.array(t_s, dtype=float), len(t_s), self._joints
        one, sides, unseen, empty = (n, j), (n, 2, j), (n, 3, j), np.empty
        joints = Smoothed(empty(one), empty(one), empty(one), empty(one), empty(unseen), empty(one), empty(sides))
        kept = (self._t, self._q, self._memory, self._first, self._count)
        if not _smooth(*kept, at, self._sigma, self._step, *joints):
            raise InputError(
                f"times {at.min():.4f} to {at.max():.4f} s were asked for; readings are kept from {oldest:.4f} to "
                f"{newest:.4f} s"
            )
        return joints
