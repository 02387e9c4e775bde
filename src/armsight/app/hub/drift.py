"""Whether a number of a cell drifts: a straight line through its recent means, against their scatter about it.

The scatter of neighbours hangs together (air, lamps, a warm board), so the sigma of the slope is widened by what the
lag-one autocorrelation of the residuals makes of it, and the chance is Student's with as many degrees of freedom as
are left.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtr

from armsight.data import Array

#: Chance of one look at one number; a look a minute at two numbers is 20,160 a week, so a false one a cell and week at
#: most. Half: a drift is named later, double: two false alarms a week.
CHANCE = 1 / (7 * 24 * 60 * 2)
#: means that a line needs; half: chance has too few degrees of freedom to say anything, double: ten minutes without a
#: word.
_LEAST = 12
#: highest autocorrelation that is reckoned with: beyond it the residuals are a drift themselves; half: warm air is
#: called a drift, closer to 1: nothing is named.
_MOST_LAG = 0.9


@dataclass(frozen=True)
class Drift:
    """A line through recent means.

    Attributes:
        per_h: its slope an hour, in the number's unit.
        sigma_per_h: one sigma of it.
        chance: how probable a slope as steep is where nothing drifts.
    """

    per_h: float
    sigma_per_h: float
    chance: float


def drift(t_s: Array, mean: Array) -> Drift | None:
    """Fit a line.

    Args:
        t_s: (N,) times of the means, s.
        mean: (N,) the means.

    Returns:
        The line; None where too few means are there.
    """
    n = len(t_s)
    if n < _LEAST:
        return None
    t = (t_s - t_s.mean()) / 3600.0
    spread = float(t @ t)
    slope = float(t @ mean) / spread
    r = mean - mean.mean() - slope * t
    variance = float(r @ r) / (n - 2)
    if not variance > 0.0:
        return None
    lag = float(
        np.clip(r[1:] @ r[:-1] / (r @ r) + 4.0 / n, 0.0, _MOST_LAG)
    )  # residuals of a line: biased down by about 4 / n
    wider = (1.0 + lag) / (1.0 - lag)
    sigma = math.sqrt(variance / spread * wider)
    freedom = max(n / wider - 2.0, 1.0)
    return Drift(slope, sigma, float(2.0 * stdtr(freedom, -abs(slope) / sigma)))
