"""A sensor's stream before anything is calibrated: its clock, its gaps, values that are stuck, and its noise at rest.

In: times and values of a recording. Out: what is wrong with them, the Allan deviation with its five coefficients (IEEE Std
952-1997, annex C; overlapping estimate: Riley, NIST SP 1065, 2008), and how a tool settles after it has stopped: a decaying
vibration of all axes of the accelerometer, its linear part eliminated (Golub and Pereyra, SIAM J. Numer. Anal. 10, 1973).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, nnls

from armsight.data import Array, Record
from armsight.errors import InputError

#: A pause of so many periods is a gap.
GAP = 3.0
#: The same value in all columns so many times in a row is frozen.
FROZEN = 10
#: The greatest or least value of a column so many times in a row is its limit.
SATURATED = 5
#: One number repeats because of its step where more than this share repeats, and most changes are below so many steps;
#: half: fine steps are not seen, double: coarse noise is a step.
REPEATS, STEPS = 0.05, 1.5
#: A rest: blocks of this length, s, whose spread is at most so many times that of the quietest fifth, for so long, s.
BLOCK_S, QUIET, REST_S = 0.25, 2.0, 1.0
#: So many sigmas are chance at most: between neighbouring blocks of a rest, and of a vibration against none.
STEADY = 6.0
#: One number rests where its changes from reading to reading are so large a share of its noise, 1 where that is white;
#: half: slow motion is a rest, double: nothing is.
WHITE = 0.65
#: So long, s, of a rest is fitted with the vibration before it; half: slow ones are less exact, double: slower.
TAIL_S = 1.5
#: A vibration leaves so much of its amplitude and so many times the noise at most; half: a second mode hides the first.
LEAVES, NOISE = 0.08, 1.5
#: What is damped more than this, of critical, is no vibration but how a motion ends.
MOST_DAMPED = 0.3
#: A tool has settled where the vibration's amplitude is below this, m.
SETTLED_M = 2e-5
#: A sweep is no longer, s; half: slow ranges of 20 minutes are rejected, double: 3 s whose times are in ms pass.
MOST_S = 1800.0
#: Averaging times of the Allan deviation, a decade, and the share of the recording that is the longest.
A_DECADE, LONGEST = 8, 0.2
#: The coefficients: name -> its share of the Allan variance at an averaging time.
COEFFICIENTS: dict[str, Callable[[Array], Array]] = {
    "quantization": lambda tau: 3.0 / tau**2,
    "random_walk": lambda tau: 1.0 / tau,
    "bias_instability": lambda tau: np.full_like(tau, 2.0 * np.log(2.0) / np.pi),
    "rate_random_walk": lambda tau: tau / 3.0,
    "rate_ramp": lambda tau: tau**2 / 2.0,
}


@dataclass(frozen=True, eq=False)
class StreamCheck(Record):
    """What a stream is like."""

    rate_hz: float  #: readings a second, by the median period
    jitter_s: float  #: half of what 68 % of the periods lie within
    gaps: int
    longest_gap_s: float
    doubled: float  #: share of the rows that repeat the row before
    frozen_s: float  #: the longest time in which no column changed, s
    saturated: tuple[int, ...]  #: columns that stand at their greatest or least value for a while
    rests: tuple[slice, ...]  #: rows of the rests; empty where there are none, or where one number's step hides them

    @property
    def rest(self) -> slice:
        """Rows of the longest rest; none where there are none."""
        return max(self.rests, key=lambda rows: rows.stop - rows.start, default=slice(0, 0))


class Settling(NamedTuple):
    """How a tool settles after its stops, the median of them."""

    stops: int  #: after which a vibration was seen
    frequency_hz: float
    damping: float  #: of critical
    amplitude_m: float
    time_s: float  #: from the stop until the amplitude is below ``SETTLED_M``


def check_stream(t_s: Array, z: Array, source: str) -> StreamCheck:
    """Return what a stream is like.

    Args:
        t_s: (N,) times, s.
        z: (N, k) values, finite.
        source: its file, for messages.

    Raises:
        InputError: too short, or times that run backwards.
    """
    if len(t_s) < 20:
        raise InputError(f"{source}: {len(t_s)} readings; 20 at least are needed")
    steps = np.diff(t_s)
    if (steps < 0.0).any():
        row = int(np.argmax(steps < 0.0))
        raise InputError(
            f"{source}: the clock runs backwards by {-steps[row]:.3f} s at reading {row + 2}, {t_s[row]:.3f} s; cut the "
            "recording there, or give the sensor's own time"
        )
    period = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 0.0
    if period <= 0.0:
        raise InputError(f"{source}: all readings have the time {t_s[0]:.3f} s")
    same = (np.diff(z, axis=0) == 0.0).all(axis=1)
    moves = np.abs(np.diff(z, axis=0))[~same]
    stepped = z.shape[1] == 1 and same.mean() > REPEATS and np.median(moves) < STEPS * moves.min(initial=np.inf)
    saturated = () if stepped else tuple(k for k, column in enumerate(z.T) if _saturated(column))
    low, high = np.quantile(steps, [0.16, 0.84])
    pauses = steps > GAP * period
    frozen = _longest(same)
    return StreamCheck(
        1.0 / period,
        float(high - low) / 2,
        int(pauses.sum()),
        float(steps[pauses].max(initial=0.0)),
        float(same.mean()),
        frozen * period if frozen >= FROZEN else 0.0,
        saturated,
        () if stepped else _rests(z, period),
    )


def check_seconds(t_s: Array, slowest_hz: float, source: str) -> None:
    """Raise an InputError where times (N,) last long at a lower rate than a sensor's slowest, Hz: they are not in s."""
    steps, length_s = np.diff(t_s), float(np.ptp(t_s)) if len(t_s) else 0.0
    rate_hz = 1.0 / float(np.median(steps[steps > 0.0])) if length_s > MOST_S else slowest_hz
    if rate_hz < slowest_hz:
        unit, scale = next(((u, k) for u, k in (("ms", 1e3), ("us", 1e6)) if rate_hz * k >= slowest_hz), ("ns", 1e9))
        raise InputError(
            f"{source} looks like {unit}: {rate_hz:.2g} Hz for {length_s:.3g} s, in {unit} {scale * rate_hz:.3g} Hz for "
            f"{length_s / scale:.3g} s; it must be seconds: name it t_{unit}, or cut a slow recording to {MOST_S:g} s"
        )


def _saturated(column: Array) -> bool:
    """Return whether a column (N,) stands at its greatest or least value more often than next to it: a range's end."""
    values, counts = np.unique(column, return_counts=True)
    if len(values) < 4:
        return False
    ends = ((values[0], counts[0], counts[1:3]), (values[-1], counts[-1], counts[-3:-1]))
    return any(count > beside.sum() and _longest(column == value) >= SATURATED for value, count, beside in ends)


def _longest(flags: NDArray[np.bool_]) -> int:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]])))
    return int((edges[1::2] - edges[::2]).max(initial=0))


def _rests(z: Array, period: float) -> tuple[slice, ...]:
    size = max(round(BLOCK_S / period), 4)
    count = len(z) // size
    if count < 2:
        return ()
    blocks = z[: count * size].reshape(count, size, -1)
    spread, means = blocks.std(axis=1), blocks.mean(axis=1)
    typical = np.maximum(np.quantile(spread, 0.2, axis=0), 1e-12)
    quiet = (spread <= QUIET * typical).all(axis=1)
    steady = (np.abs(np.diff(means, axis=0)) <= STEADY * typical * np.sqrt(2.0 / size)).all(axis=1)
    runs, begin = list[tuple[int, int]](), None
    for k in range(count + 1):
        if k < count and quiet[k] and (begin is None or steady[k - 1]):
            begin = k if begin is None else begin
            continue
        if begin is not None:
            runs.append((begin, k))
        begin = k if k < count and quiet[k] else None
    runs = [(a, b) for a, b in runs if (b - a) * size * period >= REST_S]
    if z.shape[1] == 1 and runs:  # no other column shows motion
        still = np.concatenate([blocks[a:b] for a, b in runs])
        if np.mean(np.diff(still, axis=1) ** 2) / 2 < WHITE * np.mean(still.var(axis=1, ddof=1)):
            return ()
    return tuple(slice(a * size, b * size) for a, b in runs)


def settling(t_s: Array, force: Array, rests: Sequence[slice]) -> Settling | None:
    """Return how a tool settles by specific forces (N, 3), m/s2, at times (N,), s, before rests; None: nothing is seen."""
    found = [one for k, rest in enumerate(rests) if (one := _stop(t_s, force, rests[k - 1].stop if k else 0, rest))]
    return Settling(len(found), *map(float, np.median(np.array(found), axis=0))) if found else None


def _stop(t_s: Array, force: Array, first: int, rest: slice) -> tuple[float, float, float, float] | None:
    """Return frequency, Hz, damping, amplitude, m, and settling time, s, of a vibration before a rest; None without one.

    Rows before ``first`` are of other stops. The stop is where a cumulated sum, backwards in time, of what the vibration
    leaves passes its limit; the vibration is fitted from where that sum begins to rise (Page, Biometrika 41, 1954).
    """
    noise = np.maximum(force[rest].std(axis=0, ddof=1), 1e-12)
    at, end, step, start = rest.start, min(np.searchsorted(t_s, t_s[rest.start] + TAIL_S), rest.stop), 8, None
    clean = 0  # row after a stop that is seen, from which on nothing speaks against the vibration
    while step and at > first:
        begin = max(at - step, first)
        found, _, left, swing, gain = _vibration(t_s[begin:end] - t_s[begin], force[begin:end] / noise, start)
        rise = np.cumsum((left**2 / (1.0 + (LEAVES * swing) ** 2) - NOISE**2).sum(axis=1)[::-1])
        passed = rise - np.minimum.accumulate(np.minimum(rise, 0.0)) > STEADY**2
        if passed.any():
            clean, step = end - 1 - int(rise[: passed.argmax() + 1].argmin()), step // 2
        else:
            at, step, start = begin, step if clean else 2 * step, found if gain > STEADY**2 else None
    rows = slice(clean or at, end)
    found, amplitudes, *_, gain = _vibration(t_s[rows] - t_s[at], force[rows] / noise, start)
    if not clean or gain < STEADY**2:
        return None
    speed, decay = map(float, np.exp(found))
    natural = float(np.hypot(speed, decay))
    amplitude_m = float(np.linalg.norm(amplitudes * noise)) / natural**2
    return natural / (2 * np.pi), decay / natural, amplitude_m, max(float(np.log(amplitude_m / SETTLED_M)) / decay, 0.0)


def _vibration(t: Array, f: Array, start: Array | None) -> tuple[Array, Array, Array, Array, float]:
    """Return the best vibration in columns (N, 3), of one sigma each, at times (N,), s.

    Logarithms of rad/s and decay (2,), amplitudes (3,) at time 0, what it leaves (N, 3), its swing (N, 1), and by how much
    the sum of squares falls because it decays, zero where it is none. Without a start, that of the spectrum.
    """
    if start is None:  # the first half has more of what decays than the second, and as much of what hums
        half, size = len(t) // 2, 4 * len(t)
        halves = np.stack([f[:half], f[half : 2 * half]]) - f[half:].mean(axis=0)
        power, later = (np.abs(np.fft.rfft(halves, size, axis=1)) ** 2).sum(axis=2)[:, 8:] + 1e-12
        speed = (((power - later) / np.sqrt(power + later)).argmax() + 8) * np.pi / (2 * (t[-1] - t[0]))
        start = np.log([speed, 0.05 * speed])

    def parts(p: Array) -> tuple[Array, Array, Array]:
        speed, decay = np.exp(p)
        fall = np.exp(-decay * t)
        by = np.column_stack([fall * np.cos(speed * t), fall * np.sin(speed * t), np.ones_like(t)])
        factors, *_ = np.linalg.lstsq(by, f, rcond=None)
        return f - by @ factors, np.hypot(factors[0], factors[1]), fall

    def residuals(p: Array) -> Array:
        return parts(p)[0].ravel()

    got: Array = least_squares(residuals, start, max_nfev=30).x
    (left, amplitudes, fall), steady = parts(got), parts(np.array([got[0], -np.inf]))[0]
    (speed, decay), span_s = np.exp(got), t[-1] - t[0]
    if decay > MOST_DAMPED * speed or not 2 * np.pi < speed * span_s < 0.8 * np.pi * len(t):  # a period at least
        return start, np.zeros(3), f - f.mean(axis=0), np.zeros((len(t), 1)), 0.0
    return got, amplitudes, left, np.linalg.norm(amplitudes) * fall[:, None], float((steady**2).sum() - (left**2).sum())


def allan(z: Array, period_s: float) -> tuple[Array, Array, Array]:
    """Return averaging times (K,), s, overlapping Allan variances (K, k) of values (N, k), and their degrees of freedom."""
    count = len(z)
    most = max(int(LONGEST * count), 2)
    steps = np.unique(np.round(np.logspace(0, np.log10(most), int(A_DECADE * np.log10(most)) + 2)).astype(int))
    sums = np.concatenate([np.zeros((1, z.shape[1])), np.cumsum(z - z.mean(axis=0), axis=0)])
    means = ((sums[m:] - sums[:-m]) / m for m in steps)
    variances = [0.5 * np.mean((x[m:] - x[:-m]) ** 2, axis=0) for m, x in zip(steps, means, strict=True)]
    return steps * period_s, np.array(variances), count / steps - 1.0


def coefficients(tau_s: Array, variance: Array, freedom: Array) -> dict[str, float]:
    """Return the five coefficients of one column's Allan variances (K,): the best sum of their shares, none negative."""
    weight = np.sqrt(np.maximum(freedom, 1.0) / 2) / np.maximum(variance, 1e-300)
    shares = np.column_stack([share(tau_s) for share in COEFFICIENTS.values()])
    scale = np.maximum((shares * weight[:, None]).max(axis=0), 1e-300)
    found, _ = nnls(shares * weight[:, None] / scale, variance * weight)
    return dict(zip(COEFFICIENTS, map(float, np.sqrt(found / scale)), strict=True))
