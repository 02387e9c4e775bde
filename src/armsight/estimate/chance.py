"""Limits of chance: the chi-square distribution's upper tail and its quantile, and a number among its siblings.

SciPy has them too; what measures a single pair of images would take a third longer to start for them.
"""

from __future__ import annotations

import functools
import math

import numpy as np

from armsight.data import Array

#: Relative change at which a series, a fraction or Newton's steps have converged; half: nothing, double: nothing.
_DIGITS = 1e-15
#: Steps at most: of a series of so many degrees of freedom as residuals of a recording have; half: 10^5 have no limit.
_STEPS = 10_000
#: Chance below which a measurement is a mistake; half: a gate 3 % wider, double: as much narrower.
MISTAKE = 1e-5


def _log_upper_gamma(a: float, x: float) -> float:
    """Return the logarithm of the regularised upper gamma function (Abramowitz and Stegun, 6.5.29 and 6.5.31)."""
    front = a * math.log(x) - x - math.lgamma(a)
    if x < a + 1:
        term = total = 1 / a
        for n in range(1, _STEPS):
            term *= x / (a + n)
            total += term
            if term < _DIGITS * total:
                break
        return math.log1p(-math.exp(front) * total)
    # Lentz's evaluation of the continued fraction.
    b = x + 1 - a
    c, d = 1e300, 1 / b
    h = d
    for n in range(1, _STEPS):
        even = -n * (n - a)
        b += 2
        d = 1 / (even * d + b)
        c = b + even / c
        h *= c * d
        if abs(c * d - 1) < _DIGITS:
            break
    return front + math.log(h)


def squares_of(left: Array, cov: Array) -> Array:
    """Return the squared Mahalanobis distance (...,) of residuals (..., m) with covariances (..., m, m)."""
    return np.asarray(np.einsum("...i,...i->...", left, np.linalg.solve(cov, left[..., None])[..., 0]))


def chi_square_chance(freedom: float, square: float) -> float:
    """Return the probability that a sum of squares of ``freedom`` standard normal numbers exceeds ``square``."""
    return math.exp(_log_upper_gamma(freedom / 2, square / 2)) if square > 0.0 else 1.0


@functools.lru_cache(maxsize=1024)
def chi_square_limit(freedom: float, chance: float) -> float:
    """Return what a sum of squares of ``freedom`` standard normal numbers exceeds with a probability ``chance``."""
    a, t = freedom / 2, math.sqrt(-2 * math.log(min(chance, 1 - chance)))
    z = math.copysign(t - (2.30753 + 0.27061 * t) / (1 + (0.99229 + 0.04481 * t) * t), 0.5 - chance)  # (26.2.22) there
    x = max(a * (1 - 1 / (9 * a) + z * math.sqrt(1 / (9 * a))) ** 3, 1e-3 * a)  # Wilson and Hilferty, PNAS 17, 1931
    for _ in range(100):
        upper = _log_upper_gamma(a, x)
        density = (a - 1) * math.log(x) - x - math.lgamma(a)
        step = math.exp(upper - density) * (upper - math.log(chance))  # Newton's, of the logarithm
        x = x + step if x + step > 0 else x / 2
        if abs(step) < 1e-14 * x:
            break
    return 2 * x


def chance_among(value: float, others: Array, least: float = 0.0) -> tuple[float, float]:
    """Return sigma of what scatters about zero, and the probability of a value as far off: Student's.

    Args:
        value: one that is not among the others.
        others: (N,) their median size is the scale, so that a few that are far off hardly change it.
        least: sigma of the value by itself: that of the scatter is no smaller.

    Returns:
        Sigma, and the chance; 1 where sigma is 0.
    """
    from scipy.special import stdtr

    sigma = max(float(np.median(np.abs(others))) / 0.6745, least)  # of a normal variable: its sigma
    # A median of sizes has the precision of a mean square of 0.37 times as many (its efficiency for normal variables).
    freedom = max(0.37 * len(others), 1.0)
    return sigma, float(2.0 * stdtr(freedom, -abs(value) / sigma)) if sigma > 0.0 else 1.0
