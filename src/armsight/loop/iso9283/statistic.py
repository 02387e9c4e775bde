"""The metric of a test: as measured, without what is only noise, its interval, and the least the test can resolve."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.special import chdtri, ndtri, stdtrit

from armsight.data import Array

#: Intervals contain the true metric so often; what is called resolvable is so by chance in half of the rest.
INSIDE = 0.95
_LOW, HIGH = (1 - INSIDE) / 2, (1 + INSIDE) / 2
WIDE = float(ndtri(HIGH))
#: Random errors that are sampled.
SAMPLES = 1000


@dataclass(frozen=True)
class Metric:
    """One metric of the standard."""

    raw: float  #: as the standard computes it, m or rad
    clean: float | None  #: without the noise; None where it cannot be resolved
    #: end of the 95 % interval of the true metric; where it cannot be resolved, 0, or of backlash, which has a sign,
    #: still the end of its interval. None where the noise is not known.
    low: float | None
    #: the other end; where the metric cannot be resolved, its upper bound. None where the noise is not known.
    high: float | None
    #: the smallest metric that this test can distinguish from noise. None where the noise is not known.
    resolvable: float | None
    #: standard deviation that belongs to the interval; None where the metric cannot be resolved or has none
    sigma: float | None = field(init=False)

    def __post_init__(self) -> None:
        known = None not in (self.clean, self.low, self.high)
        object.__setattr__(self, "sigma", ((self.high or 0.0) - (self.low or 0.0)) / (2 * WIDE) if known else None)


def beyond_noise(statistic: Callable[[Array], Array], value: Array, errors: Array) -> Metric:
    """Return a statistic of a measured value without what the value's error adds to it.

    The error is added a second time: what that does to the statistic, the first time did too (basic bootstrap; Davison and
    Hinkley, "Bootstrap methods and their application", 1997, 5.2). The errors alone give what could have been resolved.

    Args:
        statistic: of arrays (B, ...) returns (B,), not negative, 0 for none.
        value: (...) as measured.
        errors: (B, ...) samples of its error.
    """
    raw = float(statistic(value[None])[0])
    again, alone = statistic(value + errors), statistic(errors)
    resolvable = float(np.quantile(alone, HIGH))
    low, high = (float(v) for v in np.quantile(again, [_LOW, HIGH]))
    if raw <= resolvable:
        return Metric(raw, None, 0.0, max(high, resolvable), resolvable)
    return Metric(raw, max(2 * raw - float(again.mean()), 0.0), max(2 * raw - high, 0.0), 2 * raw - low, resolvable)


def lengths(vectors: Array) -> Array:
    """Return the greatest length (B,) of vectors (B, k, d)."""
    return np.asarray(np.linalg.norm(vectors, axis=-1).max(axis=-1))


def mean_errors(values: Array, rng: np.random.Generator) -> Array:
    """Sample errors (B, ...) of the mean of values (n, ...), from their own scatter: also where parts go together."""
    n = len(values)
    if n < 2:
        return np.zeros((SAMPLES, *values.shape[1:]))
    wider = float(stdtrit(n - 1, HIGH)) / WIDE
    weights = rng.normal(0, wider / np.sqrt(n * (n - 1)), (SAMPLES, n))
    return np.asarray(np.tensordot(weights, values - values.mean(axis=0), axes=1))


def group_errors(within: Array, counts: Array, rng: np.random.Generator) -> Array:
    """Sample errors (B, k, 3) of the means of k groups of so many values that scatter alike, as ``mean_errors``.

    ``within``: (n, 3) all values less their group's mean. ``counts``: (k,) how many each group has.
    """
    freedom = len(within) - len(counts)
    if freedom < 1:
        return np.zeros((SAMPLES, len(counts), 3))
    wider = float(stdtrit(freedom, HIGH)) / WIDE
    weights = rng.normal(0, wider / np.sqrt(freedom), (SAMPLES, len(counts), len(within)))
    return np.asarray(weights @ within / np.sqrt(counts)[:, None])


def sampled_errors(cov: Array, rng: np.random.Generator) -> Array:
    """Sample normal errors (B, ..., 3) of covariances (..., 3, 3)."""
    values, vectors = np.linalg.eigh(cov)
    root = vectors * np.sqrt(np.maximum(values, 0))[..., None, :]
    return np.asarray((root @ rng.normal(size=(SAMPLES, *cov.shape[:-1], 1)))[..., 0])


def scatter(S: Array, noise: Array, n: int, statistic: Callable[[Array], Array], ratio: float) -> Metric:
    """Return a metric of a scatter without the instrument's part of it.

    The trace of S is taken as a chi square with the degrees of freedom that the metric of such a scatter shows by trial;
    the interval of the trace, less the noise, scales the metric.

    ``S``: (d, d) covariance of n values. ``noise``: (d, d) the instrument's. ``statistic``: the metric of covariances
    (..., d, d); proportional to their root. ``ratio``: of the metric as measured to ``statistic(S)``.
    """
    total, own = float(np.trace(S)), float(np.trace(noise))
    raw = ratio * float(statistic(S))
    alone = (n - 1) * own**2 / max(float(np.trace(noise @ noise)), 1e-300)
    resolvable = float(statistic(noise)) * np.sqrt(float(chdtri(alone, 1 - HIGH)) / alone - 1) if own > 0 else 0.0
    if total <= 0:  # rows all alike: rounded, or copied; they show less than the noise would
        return Metric(raw, None if own > 0 else 0.0, 0.0, resolvable, resolvable)
    freedom, bias = _freedom(S, n, statistic)
    low, high = (total * freedom / float(chdtri(freedom, 1 - p)) - own for p in (HIGH, _LOW))
    left = _positive(S - noise)
    left = left if np.any(left) else S  # of nothing left the shape is not known
    unit = float(statistic(left)) / np.sqrt(float(np.trace(left)))
    high = unit / bias * float(np.sqrt(max(high, 0.0)))
    if low <= 0:
        return Metric(raw, None, 0.0, max(high, resolvable), resolvable)
    low = unit / bias * float(np.sqrt(low))
    # The few values' own shape, which the ratio is of, may carry the metric out of the interval.
    return Metric(raw, min(max(ratio * unit * float(np.sqrt(total - own)), low), high), low, high, resolvable)


def _freedom(S: Array, n: int, statistic: Callable[[Array], Array]) -> tuple[float, float]:
    """Return the degrees of freedom of a metric of a scatter (d, d), by trial, and the factor by which it is biased."""
    x = sampled_errors(np.broadcast_to(_whole(S), (n, 3, 3)), np.random.default_rng(0))[..., : len(S)]
    x = x - x.mean(axis=1, keepdims=True)
    tried = np.log(statistic(x.swapaxes(1, 2) @ x / (n - 1)) / statistic(S))
    return float(np.clip(1 / (2 * tried.var()), 1.0, 3.0 * (n - 1))), float(np.exp(tried.mean()))


def _whole(S: Array) -> Array:
    """Return a covariance (d, d) as one (3, 3), the rest zero."""
    out = np.zeros((3, 3))
    out[: len(S), : len(S)] = S
    return out


def _positive(S: Array) -> Array:
    """Return the part of a symmetric matrix (d, d) that is positive semidefinite."""
    values, vectors = np.linalg.eigh(S)
    return np.asarray((vectors * np.maximum(values, 0)) @ vectors.T)
