"""The filter's model at work: the tool's poses by a state, and what motion makes the state forget.

In: the vector of ``armerror`` with its covariance, and the joints as ``readings`` has them. Out: poses with derivatives,
and what first-order Gauss-Markov processes in travel keep and add. Equations: docs/loop.md.
"""

from __future__ import annotations

from typing import NamedTuple

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
        self._arm, self._prior, self.sigmas = arm, prior, prior.sigmas(sigma_delay_s)

    def poses(self, x: Array, q: Array, unseen: Array) -> tuple[Array, Array]:
        """Return the tool's poses (N, 4, 4) and their derivatives (N, 6, SIZE); x may be one for all."""
        Ts, Hs = np.empty((len(q), 4, 4)), np.empty((len(q), 6, SIZE))
        armerror.poses_and_derivatives(self._arm.table, np.broadcast_to(x, (len(q), SIZE)).copy(), q, unseen, Ts, Hs)
        return Ts, Hs

    def moved(self, state: State, joints: Smoothed, t_s: Array, *, learning: float = 1.0) -> Step:
        """Return what motion and time (N,) since a state, or before it, do to it: factors and variances (N, SIZE).

        Changes of side leave the joints ``learning`` times as uncertain as they are.
        """
        prior = self._prior
        travel = np.maximum(joints.travel - state.travel, 0.0)
        flips = np.maximum(joints.flips - state.flips, 0.0)
        kept, added = np.ones((len(travel), SIZE)), np.zeros((len(travel), SIZE))
        rest, free = slice(REST, REST + 6), slice(POSE, POSE + 6)
        kept[:, rest] = np.exp(-travel / prior.rest_travel_rad)
        kept[:, free] = np.exp(-travel.sum(axis=1, keepdims=True) / prior.pose_travel_rad)
        for part in (rest, free):
            added[:, part] = self.sigmas[part] ** 2 * (1 - kept[:, part] ** 2)
        added[:, rest] += prior.creep_rad**2 * np.minimum(np.abs(t_s - state.t_s), LONGEST_CREEP_S)[:, None]
        # A whole change of side moves it from -1 to 1.
        flipped = 0.5 * (prior.flip_rad**2 * flips[:, 0] + prior.flip_float_rad**2 * flips[:, 1])
        added[:, rest] += learning**2 * flipped
        return Step(kept, added)

    def reading_noise(self, Hs: Array, joints: Smoothed) -> Array:
        """Return the covariances (N, 6, 6) of poses from the readings' noise."""
        J = Hs[:, :, ZEROS]
        return np.asarray(self._prior.reading_rad**2 * (J * joints.variance[:, None, :]) @ np.swapaxes(J, 1, 2))


def shared(sighting: Sighting | None, Ts: Array) -> Array:
    """Return what all sightings share, (N, 6, 6), seen in the axes of poses (N, 4, 4)."""
    if sighting is None:
        return np.zeros((len(Ts), 6, 6))
    turn = np.zeros((len(Ts), 6, 6))
    turn[:, :3, :3] = turn[:, 3:, 3:] = np.swapaxes(Ts[:, :3, :3], 1, 2) @ sighting.T_base_tool[:3, :3]
    return np.asarray(turn @ sighting.cov_common @ np.swapaxes(turn, 1, 2))
