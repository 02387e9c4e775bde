"""A sensor's stream before anything is calibrated: its clock, its gaps, values that are stuck, and its noise at rest.

In: times and values of a recording. Out: what is wrong with them, and the Allan deviation with its five coefficients (IEEE
Std 952-1997, annex C; overlapping estimate: Riley, NIST SP 1065, 2008).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from armsight.data import Array, Record
from armsight.errors import InputError

#: A pause of so many periods is a gap.
GAP = 3.0
#: The same value in all columns so many times in a row is frozen.
FROZEN = 10
#: The greatest or least value of a column so many times in a row is its limit.
SATURATED = 5
#: A rest: blocks of this length, s, whose spread is at most so many times that of the quietest fifth, for so long, s.
BLOCK_S, QUIET, REST_S = 0.25, 2.0, 1.0
#: Means of neighbouring blocks of a rest differ by at most so many sigmas of chance.
STEADY = 6.0
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
    """What a stream is like.

    Attributes:
        rate_hz: readings a second, by the median period.
        jitter_s: spread of the periods: half the width of their middle 68 %, s.
        gaps: pauses.
        longest_gap_s: the longest pause, s.
        doubled: share of the rows that repeat the row before.
        frozen_s: the longest time in which no column changed, s.
        saturated: columns that stand at their greatest or least value for a while.
        rest: rows of the longest rest; empty where there is none.
    """

    rate_hz: float
    jitter_s: float
    gaps: int
    longest_gap_s: float
    doubled: float
    frozen_s: float
    saturated: tuple[int, ...]
    rest: slice


def check_stream(t_s: Array, z: Array, source: str) -> StreamCheck:
    """Return what a stream is like.

    Args:
        t_s: (N,) times, s.
        z: (N, k) values.
        source: its file, for messages.

    Raises:
        InputError: too short, no numbers, or times that run backwards.
    """
    if len(t_s) < 20:
        raise InputError(f"{source}: {len(t_s)} readings; 20 at least are needed")
    if not (np.isfinite(t_s).all() and np.isfinite(z).all()):
        row = int(np.flatnonzero(~np.isfinite(np.column_stack([t_s, z])).all(axis=1))[0])
        raise InputError(f"{source}: reading {row + 1} is no number; leave such rows out")
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
    ends = [max(_longest(column == column.max()), _longest(column == column.min())) for column in z.T]
    saturated = tuple(k for k, run in enumerate(ends) if run >= SATURATED and np.ptp(z[:, k]) > 0.0)
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
        _rest(z, period),
    )


def _longest(flags: NDArray[np.bool_]) -> int:
    """Return the length of the longest run."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]])))
    return int((edges[1::2] - edges[::2]).max(initial=0))


def _rest(z: Array, period: float) -> slice:
    """Return the rows of the longest rest."""
    size = max(round(BLOCK_S / period), 4)
    count = len(z) // size
    if count < 2:
        return slice(0, 0)
    blocks = z[: count * size].reshape(count, size, -1)
    spread, means = blocks.std(axis=1), blocks.mean(axis=1)
    typical = np.maximum(np.quantile(spread, 0.2, axis=0), 1e-12)
    quiet = (spread <= QUIET * typical).all(axis=1)
    steady = (np.abs(np.diff(means, axis=0)) <= STEADY * typical * np.sqrt(2.0 / size)).all(axis=1)
    runs, begin = [(0, 0)], None
    for k in range(count + 1):
        if k < count and quiet[k] and (begin is None or steady[k - 1]):
            begin = k if begin is None else begin
            continue
        if begin is not None:
            runs.append((begin, k))
        begin = k if k < count and quiet[k] else None
    first, end = max(runs, key=lambda run: run[1] - run[0])
    return slice(first * size, end * size) if (end - first) * size * period >= REST_S else slice(0, 0)


def allan(z: Array, period_s: float) -> tuple[Array, Array, Array]:
    """Return averaging times (K,), s, overlapping Allan variances (K, k) of values (N, k), and their degrees of freedom."""
    count = len(z)
    most = max(int(LONGEST * count), 2)
    steps = np.unique(np.round(np.logspace(0, np.log10(most), int(A_DECADE * np.log10(most)) + 2)).astype(int))
    sums = np.concatenate([np.zeros((1, z.shape[1])), np.cumsum(z - z.mean(axis=0), axis=0)])
    variances = []
    for m in steps:
        means = (sums[m:] - sums[:-m]) / m
        variances.append(0.5 * np.mean((means[m:] - means[:-m]) ** 2, axis=0))
    return steps * period_s, np.array(variances), count / steps - 1.0


def coefficients(tau_s: Array, variance: Array, freedom: Array) -> dict[str, float]:
    """Return the five coefficients of one column's Allan variances (K,): the best sum of their shares, none negative."""
    weight = np.sqrt(np.maximum(freedom, 1.0) / 2) / np.maximum(variance, 1e-300)
    shares = np.column_stack([share(tau_s) for share in COEFFICIENTS.values()])
    scale = np.maximum((shares * weight[:, None]).max(axis=0), 1e-300)
    found, _ = nnls(shares * weight[:, None] / scale, variance * weight)
    return dict(zip(COEFFICIENTS, map(float, np.sqrt(found / scale)), strict=True))
