"""The filter's model at work: the tool's poses by a state, and what motion makes the state forget.

In: the vector of ``armerror`` with its covariance, and the joints as ``readings`` has them. Out: poses with derivatives,
and what first-order Gauss-Markov processes in travel keep and add. Equations: docs/loop.md.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np

from armsight.data import Array
from armsight.loop.estimators import armerror
from armsight.loop.estimators.armerror import POSE, REST, SIZE, ZEROS, Prior
from armsight.loop.estimators.estimator import Sighting
from armsight.loop.estimators.readings import Smoothed
from armsight.robot.arm import Arm

#: After so long a joint has crept wherever it could, s.
LONGEST_CREEP_S = 4.0
#: So many times as uncertain a joint is after a change of side to those who learn from it. What comes some hundredths of a
#: second early or late would be taken for a narrower backlash else.
LEARNING = 6.0


class State(NamedTuple):
    """The filter right after a sighting, or before the first.

    ``x`` (SIZE,) and ``P`` (SIZE, SIZE): the arm's error and its covariance; ``t_s``, ``travel`` (6,), ``flips`` (2, 6):
    when that was and how far the joints had come; ``sighting``: what went in last.
    """

    t_s: float
    x: Array
    P: Array
    travel: Array
    flips: Array
    sighting: Sighting | None


class Step(NamedTuple):
    """What motion does to the state: factors (SIZE,) by which it is remembered, and variances (SIZE,) that are added."""

    kept: Array
    added: Array


class ErrorModel:
    """An arm and what makes its potentiometers wrong.

    Args:
        arm: the arm, as its table says it is.
        prior: how far it may be off.
        sigma_delay_s: how far the camera's delay may be.

    Attributes:
        sigmas: (SIZE,) standard deviations of the vector before anything is seen.
    """

    def __init__(self, arm: Arm, prior: Prior, sigma_delay_s: float) -> None:
        self._table, self._prior, self.sigmas = arm.table, prior, prior.sigmas(sigma_delay_s)
        sides = prior.flip_rad, prior.flip_float_rad
        self._forgets = np.array([prior.rest_travel_rad, prior.pose_travel_rad, prior.creep_rad, *sides])

    def poses(self, x: Array, q: Array, unseen: Array) -> tuple[Array, Array]:
        """Return the tool's poses (N, 4, 4) and their derivatives (N, 6, SIZE); x may be one for all."""
        Ts, Hs, xs = np.empty((len(q), 4, 4)), np.empty((len(q), 6, SIZE)), np.empty((len(q), SIZE))
        xs[:] = x
        armerror.poses_and_derivatives(self._table, xs, q, unseen, Ts, Hs)
        return Ts, Hs

    def moved(self, state: State, joints: Smoothed, t_s: Array, *, learning: float = 1.0) -> Step:
        """Return what motion and time (N,) since a state, or before it, do to it: factors and variances (N, SIZE).

        Changes of side leave the joints ``learning`` times as uncertain as they are.
        """
        time_s = np.asarray(t_s, dtype=float) - state.t_s
        return self.carried(time_s, joints.travel - state.travel, joints.flips - state.flips, learning=learning)

    def carried(self, time_s: Array, travel: Array, flips: Array, *, learning: float = 1.0) -> Step:
        """Return the same for times (N,), how far joints (N, 6) and how far sides (N, 2, 6) have come."""
        kept, added = np.ones((len(time_s), SIZE)), np.zeros((len(time_s), SIZE))
        _forget(time_s, travel, flips, self.sigmas, self._forgets, learning, kept, added)
        return Step(kept, added)

    def covariances(self, state: State, step: Step, Hs: Array, joints: Smoothed) -> Array:
        """Return the covariances (N, 6, 6) of poses that a state tells, a step on, without what all sightings share."""
        own = np.empty((len(Hs), 6, 6))
        _covariances(Hs, step.kept, step.added, state.P, joints.variance, self._prior.reading_rad**2, own)
        return own

    def reading_noise(self, Hs: Array, joints: Smoothed) -> Array:
        """Return the covariances (N, 6, 6) of poses from the readings' noise."""
        J = Hs[:, :, ZEROS]
        return np.asarray(self._prior.reading_rad**2 * (J * joints.variance[:, None, :]) @ np.swapaxes(J, 1, 2))


@numba.njit(cache=True, error_model="numpy")
def _forget(
    time: Array,
    travel: Array,
    flips: Array,
    sigmas: Array,
    forgets: Array,
    learning: float,
    kept: Array,
    added: Array,
) -> None:
    """Write into kept and added (N, SIZE), ones and zeros before, what times (N,), travel (N, 6) and flips (N, 2, 6) do."""
    rest_travel, pose_travel, creep, flip, flip_float = forgets
    for n in range(len(time)):
        whole, crept = 0.0, creep**2 * min(abs(time[n]), LONGEST_CREEP_S)
        for i in range(6):
            way, k = max(travel[n, i], 0.0), REST + i
            whole += way
            kept[n, k] = math.exp(-way / rest_travel)
            # A whole change of side moves it from -1 to 1.
            flipped = flip**2 * max(flips[n, 0, i], 0.0) + flip_float**2 * max(flips[n, 1, i], 0.0)
            added[n, k] = sigmas[k] ** 2 * (1.0 - kept[n, k] ** 2) + crept + 0.5 * learning**2 * flipped
        for k in range(POSE, POSE + 6):
            kept[n, k] = math.exp(-whole / pose_travel)
            added[n, k] = sigmas[k] ** 2 * (1.0 - kept[n, k] ** 2)


@numba.njit(cache=True, error_model="numpy", fastmath={"contract"})
def _covariances(Hs: Array, kept: Array, added: Array, P: Array, variance: Array, reading: float, own: Array) -> None:
    """Write H (K P K + A) H' + r J V J' into own (N, 6, 6): Hs (N, 6, SIZE), kept, added (N, SIZE), variance (N, 6).

    A has the rest and the pose alone (:func:`_forget`), J are the columns of the joints, r is a reading's variance.
    """
    by, moved = np.empty((SIZE, 6)), np.empty((6, SIZE))
    for n in range(len(Hs)):
        H = Hs[n]
        moved[:], own[n] = 0.0, 0.0
        for k in range(SIZE):
            for row in range(6):
                by[k, row] = H[row, k] * kept[n, k]
        for row in range(6):
            for k in range(SIZE):
                factor = by[k, row]
                if factor != 0.0:
                    for j in range(SIZE):
                        moved[row, j] += factor * P[k, j]
        for k in range(SIZE):
            for row in range(6):
                for column in range(6):
                    own[n, row, column] += moved[row, k] * by[k, column]
        for k in range(REST, POSE + 6):
            for row in range(6):
                for column in range(6):
                    own[n, row, column] += H[row, k] * added[n, k] * H[column, k]
        for i in range(6):
            k = 6 * i + 5  # as ZEROS has it
            for row in range(6):
                for column in range(6):
                    own[n, row, column] += reading * H[row, k] * variance[n, i] * H[column, k]


@numba.njit(cache=True, error_model="numpy")
def symmetric(P: Array) -> None:
    """Put the mean of a covariance (N, N) and its transpose in its place."""
    for i in range(len(P)):
        for j in range(i):
            P[i, j] = P[j, i] = (P[i, j] + P[j, i]) / 2


@numba.njit(cache=True, error_model="numpy")
def chi_square(S: Array, z: Array) -> float:
    """Return z' S^-1 z of an innovation (6,) with covariance (6, 6), by Cholesky's factors; NaN where S is none."""
    L, y, total = np.zeros((6, 6)), np.empty(6), 0.0
    for i in range(6):
        for j in range(i + 1):
            rest = S[i, j]
            for k in range(j):
                rest -= L[i, k] * L[j, k]
            L[i, j] = math.sqrt(rest) if i == j else rest / L[j, j]
        y[i] = z[i]
        for k in range(i):
            y[i] -= L[i, k] * y[k]
        y[i] /= L[i, i]
        total += y[i] * y[i]
    return total


def shared(sighting: Sighting | None, Ts: Array) -> Array:
    """Return what all sightings share, (N, 6, 6), seen in the axes of poses (N, 4, 4)."""
    if sighting is None:
        return np.zeros((len(Ts), 6, 6))
    turn = np.zeros((len(Ts), 6, 6))
    turn[:, :3, :3] = turn[:, 3:, 3:] = np.swapaxes(Ts[:, :3, :3], 1, 2) @ sighting.T_base_tool[:3, :3]
    return np.asarray(turn @ sighting.cov_common @ np.swapaxes(turn, 1, 2))
