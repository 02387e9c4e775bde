"""By how much a rig moved against the base of an arm, once that is known to be the cause.

In: what the estimator did with each measurement, and what it knew before the motion. Out: the motion with its covariance.
The filter of the arm, with its own process noise, goes on from its state before the motion, with the motion d and its
speed as more numbers of its state:

    e_k = H_k x_k + B_k d_k + n_k,    x_k = kept_k x_k-1 + w_k,    d_k = d_k-1 + v (t_k - t_k-1)

(e: residuals against the model as it was at the beginning, H: their derivative by the state, B: its columns of the base).
The sums of closure find that the rig moved, and when; but they take what the links do within their backlash for noise of
each block, and claim too small a covariance of the motion.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from armsight.data import Array
from armsight.geometry.pose import adjoint, inverse
from armsight.loop.estimators import Innovation, KalmanEstimator, Outcome, Remembered
from armsight.loop.estimators.errormodel import NOTHING
from armsight.loop.health.change import DATED_S, WIDE

#: A measurement is kept every so often, s, and so many: those between say nearly the same of the arm.
_EVERY_S, _KEPT = 1.0 / 15.0, 900
#: A prior so wide that it decides nothing, of the speed of a motion in a second (m, rad).
_SPEED = np.repeat([5e-4, 1e-3], 3)
#: Of the poses that the arm visited at most so many are looked at.
_VISITED = 30


class KeptMeasurement(NamedTuple):
    """A measurement: what the state kept of the one before, what was added to its variance, noise and residual."""

    t_s: float
    kept: Array
    added: Array
    noise: Array
    T_base_tool: Array
    residual: Callable[[], tuple[Array, Array]]
    clock_s: tuple[float, float]  # offset that is known but not corrected, and its sigma


class Measurements:
    """Keeps some of the newest measurements that an estimator used."""

    def __init__(self) -> None:
        self._kept: deque[KeptMeasurement] = deque(maxlen=_KEPT)
        self._since: tuple[Array, Array] | None = None

    def take(self, innovation: Innovation) -> None:
        """Take what the estimator did with a measurement, in order of time."""
        if innovation.outcome is Outcome.OUTLIER or innovation.reference is None or innovation.noise is None:
            return
        kept, added = innovation.kept, innovation.added
        assert added is not None
        if self._since is not None:
            before, was_added = self._since
            kept, added = kept * before, kept**2 * was_added + added
        self._since = kept, added
        if self._kept and innovation.t_s - self._kept[-1].t_s < _EVERY_S:
            return
        clock = innovation.clock
        clock_s = (0.0, 0.0) if clock is None else (clock.offset_s, clock.sigma_s)
        seen = innovation.noise, innovation.T_base_tool, innovation.reference
        self._kept.append(KeptMeasurement(innovation.t_s, kept, added, *seen, clock_s))
        self._since = None

    def newest(self) -> tuple[KeptMeasurement, ...]:
        """Return what is kept, in order of time."""
        return tuple(self._kept)


class Moved(NamedTuple):
    """A motion of the rig: what was measured is exp(xi) times the true pose of the tool, in the base's frame."""

    xi: Array  #: (6,) tangent [m; rad]
    cov: Array  #: (6, 6) its covariance
    Ts_base_tool: tuple[Array, ...]  #: poses (4, 4) of the tool that the arm visited, the newest last

    def at(self, T_base_tool: Array) -> tuple[Array, Array]:
        """Return what it does to a measured pose of the tool (4, 4): right tangent (6,), covariance."""
        by = adjoint(inverse(T_base_tool))
        return by @ self.xi, by @ self.cov @ by.T

    @property
    def sigma_m(self) -> float:
        """Largest standard deviation of the tool's position by it, of all poses visited, in their worst directions, m."""
        covs = (self.at(T)[1][:3, :3] for T in self.Ts_base_tool)
        return max(float(np.sqrt(np.linalg.eigvalsh(cov)[-1])) for cov in covs)


class BaseMotion:
    """Estimates a motion of the rig.

    Args:
        estimator: of the arm.
        known: what it knew before the motion, and when, s.
        begin_s: when the motion began, s.
        slow: whether it goes on, else it was a jump.
    """

    def __init__(
        self, estimator: KalmanEstimator, known: tuple[float, Remembered], begin_s: float, *, slow: bool
    ) -> None:
        self.begin_s, self.slow = begin_s, slow
        self._t_s, state = known
        self._estimator, (x, P) = estimator, estimator.known_again(state)
        n, self._delay = len(x), estimator.delay_row
        self._x, self._P = np.zeros(n + 12), np.zeros((n + 12, n + 12))
        self._x[:n], self._P[:n, :n] = x - estimator.reference, P
        self._n, self._moves, self._right_s = n, False, -np.inf
        self._effect, self._Ts = np.eye(6), deque[Array](maxlen=_KEPT)

    def take(self, measurements: Sequence[KeptMeasurement]) -> None:
        """Take the measurements that are newer than those taken before."""
        for each in measurements:
            if each.t_s > self._t_s:
                self._take(each)

    def _take(self, seen: KeptMeasurement) -> None:
        """Go on to a measurement, and use it unless it is not known whether the rig had moved."""
        n, d, passed = self._n, slice(self._n, self._n + 6), seen.t_s - self._t_s
        self._t_s = seen.t_s
        self._x[:n] *= seen.kept
        self._P[:n] *= seen.kept[:, None]
        self._P[:, :n] *= seen.kept
        self._P[np.arange(n), np.arange(n)] += seen.added
        if self.slow and self._moves:
            self._x[d] += passed * self._x[n + 6 :]
            self._P[d] += passed * self._P[n + 6 :]
            self._P[:, d] += passed * self._P[:, n + 6 :]
        since_s = seen.t_s - self.begin_s
        if since_s > 0.0 and not self._moves:
            self._moves = True
            self._P[d, d] = np.diag(WIDE**2)
            if self.slow:
                self._P[n + 6 :, n + 6 :] = np.diag(_SPEED**2)
        self._Ts.append(seen.T_base_tool)
        if abs(since_s) < DATED_S or seen.t_s <= self._right_s:
            return
        e, H = seen.residual()
        late, (offset_s, sigma_s) = H[:, self._delay], seen.clock_s
        H = np.concatenate([H, H[:, :6], np.zeros((6, 6))], axis=1)
        HP = H @ self._P
        S = HP @ H.T + seen.noise + sigma_s**2 * np.outer(late, late)
        gain = np.linalg.solve(S, HP)
        self._x += (e - offset_s * late - H @ self._x) @ gain
        P = self._P - HP.T @ gain
        P[np.abs(P) < NOTHING] = 0.0
        self._P = (P + P.T) / 2.0
        self._effect = adjoint(seen.T_base_tool) @ H[:, :6]

    @property
    def moved(self) -> Moved | None:
        """The motion up to the newest measurement; None where none is known to be after its beginning."""
        if not self._moves or self._t_s - self.begin_s < DATED_S:
            return None
        d = slice(self._n, self._n + 6)
        Ts = list(self._Ts)
        visited = (*Ts[:: -(-len(Ts) // _VISITED)], Ts[-1])
        return Moved(self._effect @ self._x[d], self._effect @ self._P[d, d] @ self._effect.T, visited)

    def put_right(self, at_s: float) -> None:
        """Go on with measurements after a time, s, that are corrected by the motion as it was found.

        Those before it are not used; where the links are is not known any more.
        """
        n, d, self._right_s = self._n, slice(self._n, self._n + 6), at_s
        across = self._P[:n, n:].copy()
        x, P = self._estimator.known_again(Remembered(self._x[:n], self._P[:n, :n], None))
        across[self._estimator.forgets] = 0.0
        self._x[:n], self._x[d] = x, 0.0
        self._P[:n, :n], self._P[:n, n:], self._P[n:, :n] = P, across, across.T
