"""Offset and rate of the camera's clock against the joints', followed beside the filter.

In: what the filter did with each pose measurement. Out: by how much the stamps are later than the delay says, and how fast
that changes, with covariance. The filter itself does not estimate the delay: what its model lacks of the backlash would be
taken for delay. Instead this is the second stage of Friedland's filter ("Treatment of bias in recursive filtering", 1969).
A bias b = (offset now, rate) that the filter does not know of leaves V b in its state, and G b in its innovations,

    V = kept V,    G = H V,    V = V - K G,    V = (1, 0) in the row of the delay

so that z = G b + noise: a Kalman filter of two states. Nothing is corrected until an offset is certain and matters; from
then on stamps and state are corrected after every measurement. What the innovations do not confirm widens the covariance: a
clock may jump, or wander.
"""

from __future__ import annotations

import math

import numpy as np

from armsight.data import Array
from armsight.estimate.chance import chi_square_limit
from armsight.geometry.matrix import product, solved
from armsight.kernels import kernel
from armsight.loop.estimators.estimator import ClockEffect, Innovation, Outcome

#: Standard deviation of the rate before anything is measured; two crystals differ by less, computers' stamps by more.
RATE = 2e-4
#: Random walks of the offset, s per root of a second, and of the rate, 1 per root of a second.
_WALK, _RATE_WALK = 3e-5, 3e-6
#: What the model of the backlash lacks looks like an offset of so much, s (standard deviation): found on simulated motions.
SYSTEMATIC_S = 3e-4
#: An offset of more seconds is corrected, at this chi-square, for so long, s; beyond so many sigmas of its rate.
_LEAST_S, _CERTAIN, _STAYS_S, _CERTAIN_SIGMAS = 5e-4, 30.0, 0.5, 3.0
#: From this chi-square on an offset is said to who watches the innovations: below, it is noise.
_SAID = 14.0
#: A measurement that an offset leaves less likely than this says nothing of it: something else is wrong.
_GATE = chi_square_limit(6, 1e-3)
#: Residuals are compared over so long, s; beyond so many sigmas the offset walks, less and less with this time
#: constant, s; residuals that determine an offset no better than so, s, say nothing.
_WINDOW_S, _SURPRISING, _CALM_S, _SEEN_S = 2.0, 3.0, 10.0, 1e-3
#: Innovations whose mean square exceeds their covariance widen it: mean over about this time, s.
_EXCESS_S = 4.0


class ClockFollower:
    """Follows offset and rate of the camera's clock.

    Args:
        size: of the filter's state.
        delay: row of the delay in it.
        sigma_s: standard deviation of the delay at the beginning, s.
    """

    def __init__(self, size: int, delay: int, sigma_s: float) -> None:
        self._V, self._delay = np.zeros((size, 2)), delay
        self._V[delay, 0] = 1.0
        self._b, self._M = np.zeros(2), np.diag([sigma_s**2, RATE**2])
        self._corrected, self._t_s = np.zeros(2), np.nan
        self._score = self._information = 0.0
        self._excess, self._unrest = 1.0, 0.0
        self._certain_s = np.inf  # since when the offset is
        #: time of the measurement from which on stamps are corrected, s; None while they are not
        self.since_s: float | None = None

    def remembered(self) -> Array:
        """Return all that is known now (2 K + 14,), for :meth:`restore`; NaN stands for what is not."""
        since_s = math.nan if self.since_s is None else self.since_s
        known = (self._score, self._information, self._excess, self._unrest, self._t_s, since_s)
        return np.concatenate([known, self._b, self._corrected, self._M.ravel(), self._V.ravel()])

    def restore(self, state: Array | None, forgotten: slice) -> None:
        """Go on from an earlier state; rows of the filter's state that are unknown then have no bias."""
        if state is None:
            self._V[:] = 0.0
            self._V[self._delay, 0] = 1.0
            return
        self._score, self._information, self._excess, self._unrest, self._t_s, since_s = state[:6].tolist()
        self.since_s = None if math.isnan(since_s) else since_s
        self._b, self._corrected = state[6:8].copy(), state[8:10].copy()
        self._M, self._V = state[10:14].reshape(2, 2).copy(), state[14:].reshape(-1, 2).copy()
        self._V[forgotten] = 0.0
        self._certain_s = np.inf

    def jumped(self, t_s: float, sigma_s: float) -> None:
        """Correct stamps from a time, s, on: they were put right, to a standard deviation, s."""
        self._M[0, 0] += sigma_s**2
        self.since_s = t_s

    def offset_s(self, t_s: float) -> float:
        """Return by how much later than its delay says a stamp is about a time, s, as far as that is corrected."""
        if self.since_s is None:
            return 0.0
        return float(self._corrected[0] + self._corrected[1] * (t_s - self._t_s))

    @property
    def rate(self) -> tuple[float, float]:
        """The rate of the camera's clock against the joints', less 1, and its standard deviation."""
        return float(self._corrected[1] + self._b[1]), float(np.sqrt(self._M[1, 1]))

    @property
    def sigma_s(self) -> float:
        """Standard deviation of the offset, s."""
        return float(np.hypot(np.sqrt(self._M[0, 0]), SYSTEMATIC_S))

    def take(self, innovation: Innovation) -> ClockEffect | None:
        """Take what the filter did with a measurement that it used, in order of time; return what the clock did to it."""
        passed = innovation.t_s - self._t_s
        first = not np.isfinite(passed)
        if not (first or passed > 0.0):
            return None
        self._t_s = innovation.t_s
        if first:
            passed = 0.0
        self._predict(passed)
        G = np.empty((6, 2))
        _signature(self._V, self._delay, passed, innovation.kept, innovation.by_state, G)
        if not first and innovation.outcome is Outcome.USED:
            self._update(innovation, G, passed)
        _absorb(self._V, self._delay, innovation.gain, G)
        offset_s, chi_square = float(self._b[0]), self._chi_square
        if not self._corrects(chi_square):
            return ClockEffect(offset_s, G @ self._b, None, self.sigma_s) if chi_square > _SAID else None
        in_z = G @ self._b
        change = self._V @ self._b
        change[self._delay] = 0.0
        self._corrected += self._b
        self._b = np.zeros(2)
        return ClockEffect(offset_s, in_z, change, self.sigma_s)

    @property
    def _chi_square(self) -> float:
        (offset, rate), ((a, b), (_, c)) = self._b.tolist(), self._M.tolist()
        a += SYSTEMATIC_S**2
        return float((c * offset**2 - 2.0 * b * offset * rate + a * rate**2) / (a * c - b * b))

    def _corrects(self, chi_square: float) -> bool:
        """Return whether stamps are corrected, with the chi-square of offset and rate."""
        if self.since_s is None:
            certain = chi_square > _CERTAIN
            certain |= self._unrest > 0.0 and self._b[0] ** 2 > _CERTAIN_SIGMAS**2 * (self._M[0, 0] + SYSTEMATIC_S**2)
            certain &= abs(self._b[0]) > _LEAST_S
            self._certain_s = min(self._certain_s, self._t_s) if certain else np.inf
            self.since_s = self._t_s if self._t_s - self._certain_s >= _STAYS_S else None
        return self.since_s is not None

    def _predict(self, passed: float) -> None:
        """Predict offset and rate over a time, s."""
        self._b[0] += passed * self._b[1]
        self._corrected[0] += passed * self._corrected[1]
        self._unrest *= math.exp(-passed / _CALM_S)
        self._unrest = self._unrest if self._unrest > _WALK else 0.0
        (a, b), (_, c) = self._M.tolist()
        a += passed * (2.0 * b + passed * c + _WALK**2 + self._unrest**2)
        b += passed * c
        c += passed * (_RATE_WALK**2 + (self._unrest / _WINDOW_S) ** 2)
        self._M = np.array([[a, b], [b, c]])

    def _update(self, innovation: Innovation, G: Array, passed: float) -> None:
        """Update offset and rate by an innovation with its derivative G (6, 2) by them."""
        weights = np.empty((3, 3))
        _weigh(innovation.cov, innovation.z, G, self._b, weights)
        left = float(weights[0, 0])
        self._excess += min(passed / _EXCESS_S, 1.0) * (left / 6.0 - self._excess)
        excess = max(self._excess, 1.0)
        score, information = weights[1:, 0] / excess, weights[1:, 1:] / excess
        fade = math.exp(-passed / _WINDOW_S)
        self._score = fade * self._score + float(score[0])
        self._information = fade * self._information + float(information[0, 0])
        M = _inverted(_inverted(self._M) + information)
        step = M @ score
        left -= float(step @ (2.0 * score - information @ step)) * excess
        if self.since_s is None and left > _GATE * excess:
            return
        self._b, self._M = self._b + step, M
        if self._information * _SEEN_S**2 < 1.0:
            return
        surprise = self._score / self._information
        if surprise**2 > _SURPRISING**2 * (1.0 / self._information + self._M[0, 0]):
            self._unrest = max(self._unrest, abs(surprise) / math.sqrt(_WINDOW_S))
            self._score = self._information = 0.0


@kernel("f8[:, ::1], i8, f8, const f8[::1], const f8[:, ::1], f8[:, ::1]")
def _signature(V: Array, delay: int, passed: float, kept: Array, H: Array, G: Array) -> None:
    """Propagate V (K, 2) over a time, s, in which the filter kept a share (K,) of its state; write H V (6, 2) to G."""
    G[:] = 0.0
    for k in range(V.shape[0]):
        V[k, 1] = kept[k] * (V[k, 1] - passed * V[k, 0])
        V[k, 0] *= kept[k]
        if k == delay:
            V[k, 0], V[k, 1] = 1.0, 0.0
        for row in range(6):
            G[row, 0] += H[row, k] * V[k, 0]
            G[row, 1] += H[row, k] * V[k, 1]


@kernel("f8[:, ::1], i8, const f8[:, ::1], f8[:, ::1]")
def _absorb(V: Array, delay: int, gain: Array, G: Array) -> None:
    """Subtract from V (K, 2) what the filter adapts to: gain (K, 6) times G (6, 2)."""
    V -= product(gain, G)
    V[delay, 0], V[delay, 1] = 1.0, 0.0


@kernel("const f8[:, ::1], const f8[::1], f8[:, ::1], f8[::1], f8[:, ::1]")
def _weigh(cov: Array, z: Array, G: Array, b: Array, weights: Array) -> None:
    """Write A' cov^-1 A (3, 3) to weights, A = [z - G b, G]: the square, the score and the information of a residual."""
    A = np.empty((6, 3))
    for row in range(6):
        A[row, 0] = z[row] - G[row, 0] * b[0] - G[row, 1] * b[1]
        A[row, 1], A[row, 2] = G[row, 0], G[row, 1]
    weights[:] = product(A.T, solved(cov, A))


def _inverted(A: Array) -> Array:
    """Return the inverse of a symmetric matrix (2, 2)."""
    (a, b), (_, c) = A.tolist()
    determinant = a * c - b * b
    return np.array([[c / determinant, -b / determinant], [-b / determinant, a / determinant]])
