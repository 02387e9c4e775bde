"""The filter's process and measurement model: the tool's poses by a state, and what motion makes the state forget.

In: the vector of ``armerror`` with its covariance, and the joints as ``readings`` has them. Out: poses with derivatives,
and what first-order Gauss-Markov processes in travel keep and add. Equations: docs/concepts/loop.md.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from armsight.data import Array
from armsight.kernels import kernel
from armsight.loop.estimators import armerror
from armsight.loop.estimators.armerror import Prior, layout
from armsight.loop.estimators.estimator import PoseMeasurement
from armsight.loop.estimators.readings import Smoothed
from armsight.robot.arm import Arm

#: After so long a joint has crept wherever it could, s.
LONGEST_CREEP_S = 4.0
#: A joint counts as so many times as uncertain after a change of side while the filter learns from it. Without this, a
#: change some hundredths of a second early or late would be taken for a narrower backlash.
LEARNING = 6.0

#: Sigmas added when vision contradicts the state again and again, as after a bump: to base and tool, and the joints' zeros.
OPEN_M, OPEN_RAD = 10e-3, np.deg2rad(1.0)
_MIN_SHARE = 1e-9  # of a share


class ErrorState(NamedTuple):
    """The filter right after a pose measurement, or before the first.

    ``x`` (size,) and ``P`` (size, size): the arm's error and its covariance; ``t_s``: when that was; ``joints``: how the
    readings smoothed them then, N = 1; ``pose_measurement``: what went in last.
    """

    t_s: float
    x: Array
    P: Array
    joints: Smoothed
    pose_measurement: PoseMeasurement | None


class Propagation(NamedTuple):
    """Propagation of the state by motion: factors (size,) that multiply it, and variances (size,) that are added."""

    kept: Array
    added: Array


def opened(joints: int) -> Array:
    """Return the variances (size,) that are added when the filter of an arm of so many joints reopens."""
    at = layout(joints)
    sigmas = np.zeros(at.size)
    sigmas[:6] = sigmas[6 * joints : at.linearity] = np.repeat([OPEN_M, OPEN_RAD], 3)
    sigmas[at.zeros] = OPEN_RAD
    return np.asarray(sigmas**2)


def smoothed_anew(state: ErrorState, then: Smoothed) -> ErrorState:
    """Return a state after the readings about its time have been smoothed again: the joints' true angles stay the same.

    Other smoothing leaves other noise; a link elsewhere in its backlash is off by another rest.
    """
    x, at = state.x.copy(), layout(then.q.shape[1])
    x[at.noise] += state.joints.q[0] - then.q[0]
    friction, floats, lever = state.joints.unseen[0] - then.unseen[0]
    x[at.rest : at.reading] -= 0.5 * (friction * x[at.backlash : at.floats] + floats * x[at.floats : at.compliance])
    x[at.rest : at.reading] += lever * x[at.compliance : at.rest]
    return state._replace(x=x, joints=then)


def bridged(noise_at: slice, before: Array, after: Array, ahead: Propagation, back: Propagation) -> tuple[Array, Array]:
    """Return the readings' noise (N, n) between the states before and after (N, size), and what is added to variances.

    The noise is bounded by both ends, as a Gauss-Markov process is: its mean between them, and what is left of its
    variance. The rest is known from the nearer end alone: vibration faster than the cameras' rate is not bounded by
    both ends.
    """
    near, far = ahead.kept[:, noise_at] ** 2, back.kept[:, noise_at] ** 2
    whole = np.maximum(1.0 - near * far, _MIN_SHARE)
    noise = (before * ahead.kept)[:, noise_at] * (1.0 - far) + (after * back.kept)[:, noise_at] * (1.0 - near)
    bridge = np.minimum(ahead.added, back.added)
    bridge[:, noise_at] = np.maximum(ahead.added, back.added)[:, noise_at] * (1.0 - np.maximum(near, far)) / whole
    return noise / whole, bridge


class ErrorModel:
    """An arm and the error model of its potentiometers.

    Args:
        arm: the arm, as its table says it is.
        prior: how far it may be off.
        sigma_delay_s: how far the camera's delay may be.

    Attributes:
        layout: of the vector.
        sigmas: (size,) standard deviations of the vector before anything is measured.
    """

    def __init__(self, arm: Arm, prior: Prior, sigma_delay_s: float) -> None:
        self._table, self._prior, self.layout = arm.table, prior, layout(arm.joints)
        self.sigmas = prior.sigmas(sigma_delay_s, arm.joints)
        sides = prior.flip_rad, prior.flip_float_rad
        travels = prior.rest_travel_rad, prior.pose_travel_rad
        self._forgets = np.array([*travels, prior.creep_rad, *sides, prior.reading_rad])

    def poses(self, x: Array, q: Array, unseen: Array) -> tuple[Array, Array]:
        """Return the tool's poses (N, 4, 4) and their derivatives (N, 6, size); x may be one for all."""
        Ts, Hs, xs = (
            np.empty((len(q), 4, 4)),
            np.empty((len(q), 6, self.layout.size)),
            np.empty((len(q), self.layout.size)),
        )
        xs[:] = x
        armerror.poses_and_derivatives(self._table, xs, q, unseen, Ts, Hs)
        return Ts, Hs

    def moved(self, state: ErrorState, joints: Smoothed, t_s: Array, *, learning: float = 1.0) -> Propagation:
        """Return what motion and time (N,) since a state, or before it, do to it: factors and variances (N, size).

        Changes of side leave the joints ``learning`` times as uncertain as they are.
        """
        then = state.joints
        come = joints.travel - then.travel, joints.flips - then.flips, np.repeat(then.variance, len(t_s), axis=0)
        return self.carried(np.asarray(t_s, dtype=float) - state.t_s, *come, joints, learning=learning)

    def carried(
        self, time_s: Array, travel: Array, flips: Array, was: Array, joints: Smoothed, *, learning: float = 1.0
    ) -> Propagation:
        """Return the same for times (N,), and how far joints (N, n) and sides (N, 2, n) have come.

        Args:
            time_s: (N,) since a state, s.
            travel: (N, n) of the joints meanwhile, rad.
            flips: (N, 2, n) of the sides.
            was: (N, n) what was left of a reading's variance at the state.
            joints: at the times.
            learning: as above.
        """
        kept, added = np.ones((len(time_s), self.layout.size)), np.zeros((len(time_s), self.layout.size))
        noise = joints.variance, joints.lasts_s, was
        _forget(time_s, travel, flips, *noise, self.sigmas, self._forgets, learning, kept, added)
        return Propagation(kept, added)

    def covariances(self, state: ErrorState, step: Propagation, Hs: Array) -> Array:
        """Return the covariances (N, 6, 6) of poses by a propagated state, without what all measurements share."""
        own = np.empty((len(Hs), 6, 6))
        _covariances(Hs, step.kept, step.added, state.P, own)
        return own


@kernel
def _decayed(x: float) -> float:
    """Return exp(-x), and nothing where it is below 1e-20: numbers near the least that there is are slow (denormals)."""
    return math.exp(-x) if x < 46.0 else 0.0


@kernel(
    "f8[::1], f8[:, ::1], f8[:, :, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[::1], f8[::1], f8, f8[:, ::1], "
    "f8[:, ::1]",
)
def _forget(
    time: Array,
    travel: Array,
    flips: Array,
    variance: Array,
    lasts: Array,
    was: Array,
    sigmas: Array,
    forgets: Array,
    learning: float,
    kept: Array,
    added: Array,
) -> None:
    """Write into kept and added (N, size), ones and zeros before, what times (N,), travel (N, n) and flips (N, 2, n) do.

    Of the readings' noise: ``variance`` and ``lasts`` (N, n) as in ``Smoothed``, ``was`` (N, n) the variance at the state.
    """
    rest_travel, pose_travel, creep, flip, flip_float, reading = forgets
    joints, pose_at = travel.shape[1], sigmas.shape[0] - 7
    for n in range(len(time)):
        whole, crept = 0.0, creep**2 * min(abs(time[n]), LONGEST_CREEP_S)
        for i in range(joints):
            way, k = max(travel[n, i], 0.0), pose_at - 2 * joints + i
            whole += way
            kept[n, k] = _decayed(way / rest_travel)
            # A whole change of side moves it from -1 to 1.
            flipped = flip**2 * max(flips[n, 0, i], 0.0) + flip_float**2 * max(flips[n, 1, i], 0.0)
            added[n, k] = sigmas[k] ** 2 * (1.0 - kept[n, k] ** 2) + crept + 0.5 * learning**2 * flipped
            # Of two means of the same readings the one of more has the share of the other's noise that it has of readings.
            share, k = min(variance[n, i] / was[n, i], 1.0), pose_at - joints + i
            kept[n, k] = share * _decayed(abs(time[n]) / lasts[n, i])
            added[n, k] = reading**2 * max(variance[n, i] - kept[n, k] ** 2 * was[n, i], 0.0)
        for k in range(pose_at, pose_at + 6):
            kept[n, k] = _decayed(whole / pose_travel)
            added[n, k] = sigmas[k] ** 2 * (1.0 - kept[n, k] ** 2)


@kernel("f8[:, :, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, :, ::1]", fastmath={"contract"})
def _covariances(Hs: Array, kept: Array, added: Array, P: Array, own: Array) -> None:
    """Write H (K P K + A) H' into own (N, 6, 6): Hs (N, 6, size), kept, added (N, size).

    A has the rest, the readings' noise and the pose alone (:func:`_forget`).
    """
    size = kept.shape[1]
    joints = (size - 13) // 18
    by, moved = np.empty((size, 6)), np.empty((6, size))
    for n in range(len(Hs)):
        H = Hs[n]
        moved[:], own[n] = 0.0, 0.0
        for k in range(size):
            for row in range(6):
                by[k, row] = H[row, k] * kept[n, k]
        for row in range(6):
            for k in range(size):
                factor = by[k, row]
                if factor != 0.0:
                    for j in range(size):
                        moved[row, j] += factor * P[k, j]
        for k in range(size):
            for row in range(6):
                for column in range(6):
                    own[n, row, column] += moved[row, k] * by[k, column]
        for k in range(size - 7 - 2 * joints, size - 1):
            for row in range(6):
                for column in range(6):
                    own[n, row, column] += H[row, k] * added[n, k] * H[column, k]


@kernel("f8[:, ::1]")
def symmetric(P: Array) -> None:
    """Overwrite a covariance (N, N) with the mean of it and its transpose."""
    for i in range(len(P)):
        for j in range(i):
            P[i, j] = P[j, i] = (P[i, j] + P[j, i]) / 2


@kernel("f8[:, ::1], f8[::1]")
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


def shared(pose_measurement: PoseMeasurement | None, Ts: Array) -> Array:
    """Return the covariance (N, 6, 6) that all measurements share, in the axes of poses (N, 4, 4)."""
    if pose_measurement is None:
        return np.zeros((len(Ts), 6, 6))
    rotation = np.zeros((len(Ts), 6, 6))
    rotation[:, :3, :3] = rotation[:, 3:, 3:] = np.swapaxes(Ts[:, :3, :3], 1, 2) @ pose_measurement.T_base_tool[:3, :3]
    return np.asarray(rotation @ pose_measurement.cov_common @ np.swapaxes(rotation, 1, 2))
