"""The filter's process and measurement model: what motion makes a state forget, and what a pose measurement adds to it.

In: the vector of ``armerror`` with its covariance, the joints as ``readings`` has them, pose measurements. Out: what
first-order Gauss-Markov processes in travel keep and add, states before and after a measurement, poses of the tool with
covariances. All of it is compiled: a command waits for it. Equations: docs/concepts/loop.md.
"""

from __future__ import annotations

import math
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array
from armsight.geometry.matrix import solved
from armsight.kernels import kernel
from armsight.loop.estimators import armerror
from armsight.loop.estimators.armerror import Prior, layout, pose_and_derivative, tangent
from armsight.loop.estimators.considered import Considered
from armsight.loop.estimators.estimator import PoseMeasurement
from armsight.loop.estimators.readings import Smoothed
from armsight.loop.references.reference import Reading, Reference
from armsight.loop.references.strapdown import Navigated
from armsight.robot.kinematics.arm import Arm

#: After so long a joint has crept wherever it could, s.
LONGEST_CREEP_S = 4.0
#: A joint counts as so many times as uncertain after a change of side while the filter learns: it may be early or late.
LEARNING = 6.0

#: Linearisations per measurement at most, and the change (m, rad) that ends them: it leaves about its square.
ITERATIONS, SETTLED = 4, 1e-3
#: A joint slower than this keeps its side of the backlash, rad/s.
MOVES_RAD_S = 1e-3
#: Covariances below this (of m, rad: 1e-20 of each) are set to zero: denormals take a processor a hundred times as
#: long.
NOTHING = 1e-40

#: Sigmas added when vision contradicts the state again and again, as after a bump: to base and tool, and the joints' zeros.
OPEN_M, OPEN_RAD = 10e-3, np.deg2rad(1.0)
_MIN_SHARE = 1e-9  # of a share
_NOWHERE, _NONE = np.eye(4), np.zeros((6, 6))  # where nothing was measured: a pose, and a covariance
#: Name under which what all measurements of vision share is considered, along the base's axes; and nothing considered.
VISION, NONE_CONSIDERED = "\0vision", MappingProxyType[str, Array]({})


class Taken(NamedTuple):
    """A reading of a reference beside vision."""

    reference: Reference
    reading: Reading

    @property
    def t_s(self) -> float:
        """Time of the reading, s, the delay removed."""
        return self.reading.t_s - self.reference.delay_s


class Until(NamedTuple):
    """The end of a window of an inertial unit, s."""

    t_s: float


class StateStep(NamedTuple):
    """How a state came from the one before, for the smoother: what motion kept of it, and one measurement.

    ``kept`` (K,), ``by`` (m, K + B) and ``gain`` (K + B, m), the arm's errors before what is beside: derivative of the
    residual ``z`` (m,), whose covariance is ``S``, by the state before, and what of it was added to the state;
    ``velocity`` (3, K + B): derivative of the velocity by the state before, None where it stayed.
    """

    kept: Array
    by: Array
    gain: Array
    z: Array
    S: Array
    velocity: Array | None = None


class ErrorState(NamedTuple):
    """The filter right after a pose measurement, or before the first.

    ``x`` (size,) and ``P`` (size, size): the arm's error and its covariance; ``t_s``: when that was; ``joints``: how the
    readings smoothed them then, N = 1; ``pose_measurement``: what went in last of vision. Where a reading of a reference
    went in last: ``taken``, that, and ``vision_s``, when vision's was; ``considered``: see :mod:`..references.update`;
    ``beside``: what an inertial unit adds to the state, None without one; ``steps``: how it came, then.
    """

    t_s: float
    x: Array
    P: Array
    joints: Smoothed
    pose_measurement: PoseMeasurement | None
    taken: Taken | Until | None = None
    vision_s: float | None = None
    considered: Considered = NONE_CONSIDERED
    beside: Navigated | None = None
    steps: tuple[StateStep, ...] = ()

    @property
    def measurement(self) -> PoseMeasurement | Taken | Until | None:
        """What went in last."""
        return self.pose_measurement if self.taken is None else self.taken

    @property
    def seen_s(self) -> float:
        """When vision's newest measurement was, s."""
        return self.t_s if self.vision_s is None else self.vision_s


class Propagation(NamedTuple):
    """Propagation of the state by motion: factors (size,) that multiply it, and variances (size,) that are added."""

    kept: Array
    added: Array


class Predicted(NamedTuple):
    """A state at a pose measurement, before that is used."""

    x: Array  #: (size,) the state, propagated
    P: Array  #: (size, size) its covariance
    z: Array  #: (6,) innovation
    H: Array  #: (6, size) derivative of the predicted pose by the state
    R: Array  #: (6, 6) noise of the measurement, without what all measurements share
    HP: Array  #: (6, size) the product of H and P
    S: Array  #: (6, 6) covariance of z, what all measurements share included


def opened(joints: int) -> Array:
    """Return the variances (size,) that are added when the filter of an arm of so many joints reopens."""
    at = layout(joints)
    sigmas = np.zeros(at.size)
    sigmas[:6] = sigmas[6 * joints : at.linearity] = np.repeat([OPEN_M, OPEN_RAD], 3)
    sigmas[at.zeros] = sigmas[at.backlash : at.compliance] = OPEN_RAD
    return np.asarray(sigmas**2)


def smoothed_anew(state: ErrorState, then: Smoothed) -> ErrorState:
    """Return a state after the readings about its time have been smoothed again: the joints' true angles stay the same."""
    x = state.x.copy()
    _smoothed_anew(x, state.joints.q, state.joints.unseen, then.q, then.unseen)
    return state._replace(x=x, joints=then)


def bridged(noise_at: slice, before: Array, after: Array, ahead: Propagation, back: Propagation) -> tuple[Array, Array]:
    """Return the readings' noise (N, n) between the states before and after (N, size), and what is added to variances.

    The noise is bounded by both ends, as a Gauss-Markov process is; faster vibration is known from the nearer end.
    """
    near, far = ahead.kept[:, noise_at] ** 2, back.kept[:, noise_at] ** 2
    whole = np.maximum(1.0 - near * far, _MIN_SHARE)
    noise = (before * ahead.kept)[:, noise_at] * (1.0 - far) + (after * back.kept)[:, noise_at] * (1.0 - near)
    bridge = np.minimum(ahead.added, back.added)
    bridge[:, noise_at] = np.maximum(ahead.added, back.added)[:, noise_at] * (1.0 - np.maximum(near, far)) / whole
    return noise / whole, bridge


class ErrorModel:
    """An arm and the error model of its potentiometers.

    Attributes:
        layout: of the vector.
    """

    def __init__(self, arm: Arm, prior: Prior, sigma_delay_s: float) -> None:
        self._table, self._prior, self.layout = arm.table, prior, layout(arm.joints)
        #: (size,) standard deviations of the vector before anything is measured
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
        come = joints.travel - then.travel, joints.flips - then.flips, then.variance
        return self.carried(np.asarray(t_s, dtype=float) - state.t_s, *come, joints, learning=learning)

    def carried(
        self, time_s: Array, travel: Array, flips: Array, was: Array, joints: Smoothed, *, learning: float = 1.0
    ) -> Propagation:
        """Return the same for times (N,), and how far joints (N, n) and sides (N, 2, n) have come.

        ``time_s``: (N,) since a state, s. ``travel``: (N, n) of the joints meanwhile, rad. ``flips``: (N, 2, n) of the
        sides. ``was``: (N, n) what was left of a reading's variance at the state, or (1, n) at one state for all.
        ``joints``: at the times. ``learning``: as above.
        """
        shape = len(time_s), self.layout.size
        kept, added = np.empty(shape), np.empty(shape)
        noise = joints.variance, joints.lasts_s, was
        _forget(time_s, travel, flips, *noise, self.sigmas, self._forgets, learning, kept, added)
        return Propagation(kept, added)

    def tracked(self, state: ErrorState, step: Propagation, joints: Smoothed) -> tuple[Array, Array, Array]:
        """Return the tool's poses (N, 4, 4) by a propagated state, and their covariances (N, 6, 6).

        First with everything, then without what all measurements share.
        """
        count, measured = len(joints.q), state.pose_measurement
        Ts, covs, own = np.empty((count, 4, 4)), np.empty((count, 6, 6)), np.empty((count, 6, 6))
        common = (_NOWHERE, _NONE) if measured is None else (measured.T_base_tool, measured.cov_common)
        _tracked(self._table, state.x, state.P, *step, joints.q, joints.unseen, *common, Ts, covs, own)
        if VISION in state.considered:
            _, Hs = self.poses(state.x * step.kept, joints.q, joints.unseen)
            across = (Hs * step.kept[:, None]) @ state.considered[VISION] @ np.swapaxes(tool_axes(Ts), 1, 2)
            covs += across + np.swapaxes(across, 1, 2)
        return Ts, covs, own

    def imagined(
        self, state: ErrorState, step: Propagation, now: Smoothed, q: Array, qd: Array, loose: NDArray[np.bool_]
    ) -> Array:
        """Return the tool's poses (N, 4, 4) if readings were q (N, n), rad, moving at qd (N, n), rad/s.

        ``loose``: (n,) which links that gravity does not load change their side, too, as their joints move.
        """
        Ts = np.empty((len(q), 4, 4))
        _imagined(self._table, state.x, step.kept[0], now.unseen[0], q, qd, loose, Ts)
        return Ts

    def innovation(
        self, x: Array, joints: Smoothed, pose_measurement: PoseMeasurement, jitter_s: float
    ) -> tuple[Array, Array]:
        """Return the innovation (6,) of a measurement, and the model's derivative (6, size) by x.

        ``x``: the state. ``joints``: at the measurement. ``jitter_s``: standard
        deviation of its time, s.
        """
        z, H = np.empty(6), np.empty((6, self.layout.size))
        seen = pose_measurement.T_base_tool, pose_measurement.cov_noise, jitter_s
        _innovation(self._table, x, joints.q[0], joints.qd[0], joints.unseen[0], *seen, z, H, np.empty((6, 6)))
        return z, H

    def predicted(
        self, state: ErrorState, step: Propagation, joints: Smoothed, pose_measurement: PoseMeasurement, jitter_s: float
    ) -> tuple[Predicted, float]:
        """Return a state at a measurement, and the chi-square of that; arguments as for :meth:`innovation`."""
        x, P, n = state.x.copy(), state.P.copy(), self.layout.size
        at = Predicted(x, P, np.empty(6), np.empty((6, n)), np.empty((6, 6)), np.empty((6, n)), np.empty((6, 6)))
        moved = step.kept[0], step.added[0], joints.q[0], joints.qd[0], joints.unseen[0]
        seen = pose_measurement.T_base_tool, pose_measurement.cov_noise, pose_measurement.cov_common
        return at, _predicted(self._table, *moved, *seen, jitter_s, *at)

    def updated(
        self, at: Predicted, joints: Smoothed, pose_measurement: PoseMeasurement, jitter_s: float, *, learns_delay: bool
    ) -> tuple[Array, Array, Array]:
        """Use a measurement: overwrite ``at.x`` and ``at.P`` by state and covariance after it, and ``at.HP``.

        Return the gain (size, 6), innovation (6,) and derivative (6, size) of the last linearization; ``at.HP`` is of it,
        too. The iterated update (Bell and Cathey, 1993). Other arguments as for :meth:`innovation`.

        ``at``: the state before. ``joints``: at the measurement. ``jitter_s``:
        standard deviation of its time, s. ``learns_delay``: whether the delay is corrected; if not, it stays as it is,
        and so does its variance.
        """
        K, z, H = np.empty((self.layout.size, 6)), at.z.copy(), at.H.copy()
        now = joints.q[0], joints.qd[0], joints.unseen[0]
        seen = pose_measurement.T_base_tool, pose_measurement.cov_noise, jitter_s
        _updated(self._table, *now, *seen, learns_delay, at.x, at.P, z, H, at.R, at.HP, K)
        return K, z, H


@kernel("f8[::1], f8[:, ::1], f8[:, :, ::1], f8[:, ::1], f8[:, :, ::1]")
def _smoothed_anew(x: Array, q_was: Array, was: Array, q: Array, unseen: Array) -> None:
    """Correct x (size,) for joints (1, n) and unseen (1, 3, n) that were others; see :func:`smoothed_anew`."""
    joints = q.shape[1]
    backlash = x.shape[0] - 7 - 5 * joints
    for i in range(joints):
        friction, floats = was[0, 0, i] - unseen[0, 0, i], was[0, 1, i] - unseen[0, 1, i]
        lever, k = was[0, 2, i] - unseen[0, 2, i], backlash + i
        x[k + 4 * joints] += q_was[0, i] - q[0, i]
        x[k + 3 * joints] -= 0.5 * (friction * x[k] + floats * x[k + joints])
        x[k + 3 * joints] += lever * x[k + 2 * joints]


@kernel
def _decayed(x: float) -> float:
    """Return exp(-x), and nothing where it is below 1e-20: numbers near the least that there is are slow (denormals)."""
    return math.exp(-x) if x < 46.0 else 0.0


@kernel
def _lasting(time: float, way: float) -> float:
    """Return the share that is left of what comes evenly along a way, over half its length of forgetting; all at first."""
    return (1.0 - _decayed(way)) / way if way > 1e-6 and time < math.inf else 1.0


@kernel(
    "f8[::1], f8[:, ::1], f8[:, :, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[::1], f8[::1], f8, f8[:, ::1], "
    "f8[:, ::1]"
)
def _forget(
    time: Array, travel: Array, flips: Array, variance: Array, lasts: Array, was: Array, sigmas: Array, forgets: Array,
    learning: float, kept: Array, added: Array,
) -> None:  # fmt: skip
    """Write into kept and added (N, size) what times (N,), travel (N, n) and flips (N, 2, n) do."""
    rest_travel, pose_travel, creep, flip, flip_float, reading = forgets
    joints, pose_at = travel.shape[1], sigmas.shape[0] - 7
    kept[:], added[:] = 1.0, 0.0
    for n in range(len(time)):
        before = was[min(n, len(was) - 1)]
        whole, crept = 0.0, creep**2 * min(abs(time[n]), LONGEST_CREEP_S)
        for i in range(joints):
            way, k = max(travel[n, i], 0.0), pose_at - 2 * joints + i
            whole += way
            kept[n, k] = _decayed(way / rest_travel)
            # A whole change of side moves it from -1 to 1; what that makes of the joint is forgotten as the rest is.
            flipped = flip**2 * max(flips[n, 0, i], 0.0) + flip_float**2 * max(flips[n, 1, i], 0.0)
            fresh = (crept + 0.5 * learning**2 * flipped) * _lasting(time[n], 2.0 * way / rest_travel)
            added[n, k] = sigmas[k] ** 2 * (1.0 - kept[n, k] ** 2) + fresh
            # Of two means of the same readings the one of more has the share of the other's noise that it has of readings.
            share, k = min(variance[n, i] / before[i], 1.0), pose_at - joints + i
            kept[n, k] = share * _decayed(abs(time[n]) / lasts[n, i])
            added[n, k] = reading**2 * max(variance[n, i] - kept[n, k] ** 2 * before[i], 0.0)
        for k in range(pose_at, pose_at + 6):
            kept[n, k] = _decayed(whole / pose_travel)
            added[n, k] = sigmas[k] ** 2 * (1.0 - kept[n, k] ** 2)


@kernel(fastmath={"contract"})
def _times(H: Array, P: Array, HP: Array) -> None:
    """Write the product of a derivative H (6, size) and a covariance P (size, size) to HP (6, size)."""
    size = P.shape[0]
    HP[:] = 0.0
    for row in range(6):
        for k in range(size):
            factor = H[row, k]
            if factor != 0.0:
                for j in range(size):
                    HP[row, j] += factor * P[k, j]


@kernel(fastmath={"contract", "reassoc", "nsz"})
def _add_times(HP: Array, H: Array, out: Array) -> None:
    """Add the product of HP (6, size) and the transpose of H (6, size) to out (6, 6)."""
    for row in range(6):
        for column in range(6):
            total = 0.0
            for k in range(H.shape[1]):
                total += HP[row, k] * H[column, k]
            out[row, column] += total


@kernel(
    "const f8[::1], f8[::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, :, ::1], const f8[:, ::1], "
    "const f8[:, ::1], f8[:, :, ::1], f8[:, :, ::1], f8[:, :, ::1]",
    fastmath={"contract"},
)
def _tracked(
    table: Array, x: Array, P: Array, kept: Array, added: Array, q: Array, unseen: Array, T_measured: Array,
    common: Array, Ts: Array, covs: Array, own: Array,
) -> None:  # fmt: skip
    """Write poses (N, 4, 4) by a state propagated to readings q (N, n), and H (K P K + A) H' (N, 6, 6), to Ts and own.

    K and A stand in kept and added (N, size): A has the rest, the readings' noise and the pose alone (:func:`_forget`).
    """
    size, joints = x.shape[0], q.shape[1]
    moved, H, HP = np.empty(size), np.empty((6, size)), np.empty((6, size))
    for n in range(len(q)):
        for k in range(size):
            moved[k] = x[k] * kept[n, k]
        pose_and_derivative(table, moved, q[n], unseen[n], Ts[n], H)
        own[n] = 0.0
        for k in range(size - 7 - 2 * joints, size - 1):
            for row in range(6):
                for column in range(6):
                    own[n, row, column] += H[row, k] * added[n, k] * H[column, k]
        for row in range(6):
            for k in range(size):
                H[row, k] *= kept[n, k]
        _times(H, P, HP)
        _add_times(HP, H, own[n])
        covs[n] = own[n]
        _add_shared(Ts[n], T_measured, common, covs[n])


@kernel("const f8[::1], f8[::1], f8[::1], f8[:, ::1], const f8[:, ::1], const f8[:, ::1], b1[::1], f8[:, :, ::1]")
def _imagined(
    table: Array, x: Array, kept: Array, unseen: Array, q: Array, qd: Array, loose: NDArray[np.bool_], Ts: Array
) -> None:
    """Write the poses of :meth:`ErrorModel.imagined` to Ts (N, 4, 4); what is unseen (3, n) is that of now."""
    size, joints = x.shape[0], q.shape[1]
    moved, then, at, H = x * kept, unseen.copy(), np.empty(joints), np.empty((6, size))
    moved[size - 7 - joints : size - 7] = 0.0  # noise of what was read, not of what might be
    for n in range(len(q)):
        for i in range(joints):
            at[i] = q[n, i]
            moves, side = abs(qd[n, i]) > MOVES_RAD_S, 1.0 if qd[n, i] > 0.0 else -1.0
            then[0, i] = side if moves else unseen[0, i]
            then[1, i] = side if moves and loose[i] else unseen[1, i]
        pose_and_derivative(table, moved, at, then, Ts[n], H)


@kernel
def _add_shared(T: Array, T_measured: Array, common: Array, cov: Array) -> None:
    """Add the covariance (6, 6) that all measurements share, of the tangent at one pose (4, 4), as that at another."""
    R = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for k in range(3):
                R[i, j] += T[k, i] * T_measured[k, j]
    for row in range(0, 6, 3):
        for column in range(0, 6, 3):
            for i in range(3):
                for j in range(3):
                    for k in range(3):
                        for m in range(3):
                            cov[row + i, column + j] += R[i, k] * common[row + k, column + m] * R[j, m]


@kernel("f8[:, :, ::1], const f8[:, ::1], const f8[:, ::1], f8[:, :, ::1]")
def _shared(Ts: Array, T_measured: Array, common: Array, covs: Array) -> None:
    """Write the same at poses (N, 4, 4) to covs (N, 6, 6)."""
    covs[:] = 0.0
    for n in range(len(Ts)):
        _add_shared(Ts[n], T_measured, common, covs[n])


@kernel(
    "const f8[::1], f8[::1], f8[::1], f8[::1], f8[:, ::1], const f8[:, ::1], const f8[:, ::1], f8, f8[::1], f8[:, ::1], "
    "f8[:, ::1]"
)
def _innovation(
    table: Array, x: Array, q: Array, qd: Array, unseen: Array, T_measured: Array, cov_noise: Array, jitter_s: float,
    z: Array, H: Array, R: Array,
) -> None:  # fmt: skip
    """Write the innovation (6,), the derivative (6, size) by x and the noise (6, 6) to z, H, R."""
    T, delay = np.empty((4, 4)), x.shape[0] - 1
    pose_and_derivative(table, x, q, unseen, T, H)
    tangent(T, T_measured, z)
    for row in range(6):
        velocity = 0.0
        for i in range(q.shape[0]):
            velocity += table[6 * i + 5] * H[row, 6 * i + 5] * qd[i]
        H[row, delay] = -velocity  # measured earlier by so much, the tool had not moved as far
    for row in range(6):
        for column in range(6):
            R[row, column] = cov_noise[row, column] + jitter_s**2 * H[row, delay] * H[column, delay]


@kernel(
    "const f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[:, ::1], const f8[:, ::1], const f8[:, ::1], "
    "const f8[:, ::1], f8, f8[::1], f8[:, ::1], f8[::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1]"
)
def _predicted(
    table: Array, kept: Array, added: Array, q: Array, qd: Array, unseen: Array, T_measured: Array, cov_noise: Array,
    cov_common: Array, jitter_s: float, x: Array, P: Array, z: Array, H: Array, R: Array, HP: Array, S: Array,
) -> float:  # fmt: skip
    """Propagate x and P in place, write the other parts of a :class:`Predicted`, and return the chi-square of z."""
    for k in range(x.shape[0]):
        if kept[k] != 1.0:
            x[k] *= kept[k]
            for j in range(x.shape[0]):
                P[k, j] *= kept[k]
                P[j, k] *= kept[k]
        P[k, k] += added[k]
    for k in range(x.shape[0]):
        for j in range(x.shape[0]):
            P[k, j] = P[k, j] if abs(P[k, j]) >= NOTHING else 0.0
    _innovation(table, x, q, qd, unseen, T_measured, cov_noise, jitter_s, z, H, R)
    _times(H, P, HP)
    S[:] = R
    S += cov_common
    _add_times(HP, H, S)
    return chi_square(S, z)


@kernel(
    "const f8[::1], f8[::1], f8[::1], f8[:, ::1], const f8[:, ::1], const f8[:, ::1], f8, b1, f8[::1], f8[:, ::1], "
    "f8[::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1]",
    fastmath={"contract"},
)
def _updated(
    table: Array, q: Array, qd: Array, unseen: Array, T_measured: Array, cov_noise: Array, jitter_s: float,
    learns_delay: bool, x: Array, P: Array, z: Array, H: Array, R_at: Array, HP: Array, K: Array,
) -> None:  # fmt: skip
    """Overwrite x and P by those after a measurement, write the gain to K (size, 6); z, H and HP become the last ones."""
    size = x.shape[0]
    delay = size - 1
    R, there = R_at.copy(), x.copy()
    change, last = np.zeros(size), np.zeros(size)
    for left in range(ITERATIONS, 0, -1):
        _add_times(HP, H, R)
        gain = solved(R, HP)
        if not learns_delay:
            gain[:, delay] = 0.0
        most = 0.0
        for k in range(size):
            last[k], change[k] = change[k], 0.0
            for row in range(6):
                change[k] += gain[row, k] * z[row]
            most = max(most, abs(change[k] - last[k]))
            K[k] = gain[:, k]
        if left == 1 or most < SETTLED:
            break
        for k in range(size):
            there[k] = x[k] + change[k]
        _innovation(table, there, q, qd, unseen, T_measured, cov_noise, jitter_s, z, H, R)
        # The joints were taken at the delay of x, whatever the change: that part is not in z yet.
        for row in range(6):
            for k in range(delay):
                z[row] += H[row, k] * change[k]
        _times(H, P, HP)
    for k in range(size):
        x[k] += change[k]
        for row in range(6):
            for j in range(size):
                P[k, j] -= K[k, row] * HP[row, j]
    if not learns_delay:  # its row is as it was, its column is right
        P[delay] = P[:, delay]
    symmetric(P)


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


def tool_axes(Ts: Array) -> Array:
    """Return the maps (..., 6, 6) from [translation; rotation] along the base's axes to the tangents of poses."""
    out = np.zeros((*Ts.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = np.swapaxes(Ts[..., :3, :3], -1, -2)
    return out


def shared(pose_measurement: PoseMeasurement | None, Ts: Array) -> Array:
    """Return the covariance (N, 6, 6) that all measurements share, in the axes of poses (N, 4, 4)."""
    covs = np.zeros((len(Ts), 6, 6))
    if pose_measurement is not None:
        _shared(np.ascontiguousarray(Ts), pose_measurement.T_base_tool, pose_measurement.cov_common, covs)
    return covs
