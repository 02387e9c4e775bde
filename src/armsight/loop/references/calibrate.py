"""Calibrate a reference: all its parameters and its delay, from readings while the tool's motion is known.

In: readings, and where the tool was and how it moved (by vision or by an arm). Out: the reference with its parameters and
their covariance, how large its noise is beside what was said, which readings are blunders, and the error of readings that
the fit has not seen: blocks of time, each left out in turn. Gauss-Newton on ``estimate``'s one solver.

The tool's motion from measured poses (:class:`PosePath`): about the pose sought the poses nearby are a polynomial of time
in its right tangent (Savitzky and Golay, 1964, on SE(3)); its derivatives there are the twist and the acceleration.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Generic, NamedTuple, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Record
from armsight.errors import InputError
from armsight.estimate.chance import squares_of
from armsight.estimate.linear import Linear
from armsight.estimate.solve import Solved, by_chance, left_out, solve
from armsight.estimate.variance import restricted
from armsight.geometry.pose import exp_se3, inverse, log_se3
from armsight.loop.references.reference import Reading, Reference, ToolMotion

R = TypeVar("R", bound=Reference)

#: A reading less likely than this among the others is a blunder; half, double: one in a million more or fewer.
CHANCE = 1e-6
#: Gauss-Newton steps at most, and halvings of one that does not lower the cost; half: far starts do not arrive.
STEPS, HALVINGS = 30, 8
#: A step that lowers the cost by less than this has arrived; half, double: nothing.
ARRIVED = 1e-6
#: Rounds of blunders and variances; half: a few blunders stay in, double: nothing.
ROUNDS = 4
#: Blocks of time that are left out in turn.
BLOCKS = 8
#: A parameter that the readings left at more than this share of its sigma before is open; half: known ones are called open.
OPEN = 0.9
#: The noise of a channel may be this many times less, or more, than was said.
LEAST, MOST = 1e-3, 1e3

#: Degree of the polynomial; half: corners are cut by 2 %, double: noise of the acceleration ten times as large.
DEGREE = 5
#: Poses that one is laid through at least, on both sides together, and the least span, s.
LEAST_POSES, SPAN_S = 10, 0.08
#: Longest gap between poses that is bridged, s.
GAP_S = 0.5


class Carrier(ABC):
    """What carries the tool, with errors of its own that the readings show too: an arm."""

    sigma: Array  #: (K,) how far each error may be
    scatter: Array  #: (K,) one sigma, about, by which each differs from reading to reading; how much is found

    @abstractmethod
    def at(self, t_s: float) -> tuple[ToolMotion, Array]:
        """Return the tool's motion at a time, s, and the derivative (6, K) of its pose by the errors."""

    @abstractmethod
    def moved(self, step: Array) -> Self:
        """Return it with errors moved by a step (K,)."""


class Known(Carrier):
    """A motion that is known, but for the covariance of its poses."""

    sigma = scatter = np.zeros(0)

    def __init__(self, motion: Callable[[float], ToolMotion]) -> None:
        self._motion = motion

    def at(self, t_s: float) -> tuple[ToolMotion, Array]:
        """Return the motion, and no errors."""
        return self._motion(t_s), np.zeros((6, 0))

    def moved(self, step: Array) -> Self:
        """Return itself."""
        return self


class _State(NamedTuple, Generic[R]):
    """Where a fit is: reference and carrier, and the step (Q,) of all unknowns from where it began."""

    reference: R
    carrier: Carrier
    total: Array


@dataclass(frozen=True, eq=False)
class ReferenceCalibration(Record, Generic[R]):
    """A calibrated reference, and how far to believe it."""

    reference: R  #: with its parameters, their covariance, its delay and that's sigma
    noise: dict[str, float]  #: channel, or "carrier" -> how many times larger its noise is than said
    used: NDArray[np.bool_]  #: (N,) whether a reading was used; the others are blunders
    left_out: Array  #: (N, m) error of the readings predicted by fits to the other blocks, measured minus predicted
    squares: Array  #: (N,) their squared Mahalanobis distance over m: 1 on average where the covariance is honest
    open: tuple[str, ...]  #: parameters that the readings do not determine
    carrier: Carrier  #: with its errors
    cov_carrier: Array  #: (K, K) their covariance


def calibrate(
    reference: R,
    readings: Sequence[Reading],
    motion: Callable[[float], ToolMotion] | Carrier,
    *,
    fit_delay: bool = False,
) -> ReferenceCalibration[R]:
    """Fit all parameters of a reference.

    Args:
        reference: where to begin; its ``cov`` says how far its parameters may be off (the variances count).
        readings: in order of time. Those that share one error (samples of one rest) should be one reading, their mean.
        motion: returns the tool's motion at a time, s; or what carries the tool, whose errors then are fitted too.
        fit_delay: whether the delay is fitted too, from ``sigma_delay_s`` on; the motions then must not all be rests.

    Raises:
        InputError: fewer numbers than parameters.
    """
    fit = _SensorFit(reference, readings, motion if isinstance(motion, Carrier) else Known(motion), fit_delay)
    at, linear = fit.begin, fit.linear(fit.begin)
    numbers, seen = linear.e.size, int((linear.J != 0.0).any(axis=(0, 1)).sum())
    if numbers <= seen:
        raise InputError(f"{reference.name}: {numbers} numbers were read, {seen} parameters need more of them")
    used, variances = np.ones(len(readings), np.bool_), np.ones(len(fit.names))
    for _ in range(ROUNDS):
        at, linear = fit.solved(at, linear, variances, used)
        before, factors = used, _factors(linear, variances, used)
        used = _plausible(linear, factors, used, fit.channel)
        variances = restricted(linear.rows(np.flatnonzero(used)), factors, LEAST, MOST)
        if (used == before).all():
            break
    at, linear = fit.solved(at, linear, variances, used)
    s = solve(linear.rows(np.flatnonzero(used)), variances)
    cov = s.root[: fit.unknowns] @ s.root[: fit.unknowns].T
    errors, squares = _held_out(linear, variances, used)
    cov *= max(1.0, float(squares[used].mean()))  # what lasts, such as a bias that warms up, shows in times left out
    sigma, names = np.sqrt(np.diag(cov)), (*reference.parameters, *(["delay_s"] if fit_delay else []))
    unknown = tuple(name for name, a, b in zip(names, sigma, fit.sigma, strict=False) if a > OPEN * b)
    noise = {name: float(np.sqrt(v)) for name, v in zip(fit.names, variances, strict=True)}
    beside = slice(fit.unknowns - len(at.carrier.sigma), None)
    found = fit.reference(at, cov), noise, used, errors, squares, unknown
    return ReferenceCalibration(*found, at.carrier, cov[beside, beside])


class _SensorFit(Generic[R]):
    """Residuals of readings, predicted minus measured, near a step from where the fit began."""

    def __init__(self, reference: R, readings: Sequence[Reading], carrier: Carrier, fit_delay: bool) -> None:
        self._first, self._readings, self._delays = reference, readings, fit_delay
        self.channel = np.array([reading.channel for reading in readings])
        late = [reference.sigma_delay_s] * fit_delay
        self.sigma = np.concatenate([np.sqrt(np.diag(reference.cov)), late, carrier.sigma])
        self.unknowns, self.begin = len(self.sigma), _State(reference, carrier, np.zeros(len(self.sigma)))
        noise = np.linalg.cholesky(np.array([reading.cov for reading in readings]))
        kinds, self._scattered = np.unique(self.channel), np.flatnonzero(carrier.scatter)
        self.names = [reference.channels[k] for k in kinds] + ["carrier"] * bool(self._scattered.size)
        self._own = [noise * (self.channel == k)[:, None, None] for k in kinds]

    def reference(self, at: _State[R], cov: Array) -> R:
        """Return the reference of a state with the covariance (Q, Q) of its unknowns."""
        P = len(self._first.cov)
        late = float(np.sqrt(cov[P, P])) if self._delays else self._first.sigma_delay_s
        return replace(at.reference, cov=cov[:P, :P], sigma_delay_s=late)

    def moved(self, at: _State[R], step: Array) -> _State[R]:
        """Return a state moved by a step (Q,)."""
        P = len(self._first.cov)
        late = at.reference.delay_s + (float(step[P]) if self._delays else 0.0)
        carrier = at.carrier.moved(step[len(step) - len(at.carrier.sigma) :])
        return _State(replace(at.reference.moved(step[:P]), delay_s=late), carrier, at.total + step)

    def linear(self, at: _State[R]) -> Linear:
        """Return the residuals near a state."""
        e, J, given, own = [], [], [], []
        for reading in self._readings:
            motion, errors = at.carrier.at(reading.t_s - at.reference.delay_s)
            expected = at.reference.expected(motion, reading.channel)
            delay = [-expected.rate(motion)] if self._delays else []
            e.append(expected.z - reading.z)
            J.append(np.column_stack([expected.by_parameters, *delay, expected.by_tool @ errors]))
            given.append(expected.by_tool @ motion.cov @ expected.by_tool.T)
            own.append(expected.by_tool @ (errors * at.carrier.scatter)[:, self._scattered])
        sources = dict(zip(self.names, (*self._own, np.array(own)), strict=False))
        return Linear(np.array(e), np.array(J), np.array(given), sources, {}, self.sigma**-2.0, at.total)

    def solved(
        self, at: _State[R], linear: Linear, variances: Array, used: NDArray[np.bool_]
    ) -> tuple[_State[R], Linear]:
        """Return the best state for the variances (K,) and the readings that are used (N,), and the residuals there."""
        rows = np.flatnonzero(used)
        s = solve(linear.rows(rows), variances)
        for _ in range(STEPS):
            step, cost = s.x[: self.unknowns], _cost(linear.rows(rows), s)
            for _ in range(HALVINGS):
                near = self.moved(at, step)
                tried = self.linear(near)
                if _cost(tried.rows(rows), s) < cost:
                    break
                step = step / 2
            else:
                return at, linear
            gained = cost - _cost(tried.rows(rows), s)
            at, linear, s = near, tried, solve(tried.rows(rows), variances)
            if gained < ARRIVED * cost:
                break
        return at, linear


def _cost(linear: Linear, s: Solved) -> float:
    """Return the weighted squares of residuals, and of how far the unknowns are from where their priors have them."""
    return float(np.einsum("ni,nij,nj->", linear.e, s.W, linear.e) + (linear.known * linear.at**2).sum())


def _apart(linear: Linear, variances: Array, used: NDArray[np.bool_]) -> Array:
    """Return the squared Mahalanobis distance (N,) of each reading from what the other used ones predict."""
    s, squares = solve(linear.rows(np.flatnonzero(used)), variances), np.empty(len(used))
    squares[used] = squares_of(*left_out(s))
    if not used.all():
        squares[~used] = squares_of(*_predicted(s, linear.rows(np.flatnonzero(~used)), variances))
    return squares


def _predicted(s: Solved, out: Linear, variances: Array) -> tuple[Array, Array]:
    """Return errors (N, m) and covariances (N, m, m) of readings that a solution has not seen."""
    JR = out.J @ s.root[: out.J.shape[2]]
    own = np.linalg.inv(solve(out, variances).W)
    return -(out.e + out.J @ s.x[: out.J.shape[2]]), own + JR @ np.swapaxes(JR, 1, 2)


def _factors(linear: Linear, variances: Array, used: NDArray[np.bool_]) -> Array:
    """Return variances (K,) to begin at that a few blunders cannot raise: from the medians of the squares left out."""
    from scipy.special import chdtri

    squares = _apart(linear, variances, used)
    median = chdtri(linear.e.shape[1], 0.5)
    mine = [np.abs(M).sum(axis=(1, 2)) > 0.0 for M in linear.own.values()]
    each = [v * np.median(squares[rows]) / median for v, rows in zip(variances, mine, strict=True)]
    return np.asarray(np.clip(each, LEAST**2, MOST**2))


def _plausible(
    linear: Linear, variances: Array, used: NDArray[np.bool_], channel: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """Return which readings (N,) chance explains, among those of their channel."""
    squares = _apart(linear, variances, used)
    out = np.ones(len(squares), np.bool_)
    for k in np.unique(channel):
        out[channel == k] = by_chance(squares[channel == k], linear.e.shape[1], CHANCE)
    return out


def _held_out(linear: Linear, variances: Array, used: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Return errors (N, m) and squares (N,) of each reading under the fit to the other blocks of time."""
    count, m = linear.e.shape
    errors, squares = np.empty((count, m)), np.empty(count)
    for block in np.array_split(np.arange(count), min(BLOCKS, count)):
        others = np.setdiff1d(np.flatnonzero(used), block)
        errors[block], covs = _predicted(solve(linear.rows(others), variances), linear.rows(block), variances)
        squares[block] = squares_of(errors[block], covs) / m
    return errors, squares


class PosePath:
    """Poses over time.

    Args:
        t_s: (N,) times, rising, s.
        Ts_base_tool: (N, 4, 4) the tool's poses, m.
        cov: (6, 6) covariance of each pose's right tangent [m; rad]; None: exact.

    Raises:
        InputError: fewer than ``LEAST_POSES`` poses, or times that do not rise.
    """

    def __init__(self, t_s: Array, Ts_base_tool: Array, cov: Array | None = None) -> None:
        if len(t_s) < LEAST_POSES or not (np.diff(t_s) > 0.0).all():
            raise InputError(f"{len(t_s)} poses were given; {LEAST_POSES} at least are needed, at times that rise")
        self._t, self._Ts, self._cov = t_s, Ts_base_tool, np.zeros((6, 6)) if cov is None else cov

    def covers(self, t_s: float, apart_s: float) -> bool:
        """Return whether there are poses around a time and so long before and after it."""
        low, high = np.searchsorted(self._t, [t_s - apart_s, t_s + apart_s])
        inside = self._t[0] <= t_s - apart_s and t_s + apart_s <= self._t[-1]
        return bool(inside and np.diff(self._t[max(low - 1, 0) : high + 1]).max(initial=0.0) <= GAP_S)

    def __call__(self, t_s: float) -> ToolMotion:
        """Return the motion at a time, s."""
        t = self._t
        k = int(np.searchsorted(t, t_s))
        first = min(max(k - LEAST_POSES // 2, 0), len(t) - LEAST_POSES)
        low, high = np.searchsorted(t, [t_s - SPAN_S / 2, t_s + SPAN_S / 2])
        low, high = min(low, first), max(high, first + LEAST_POSES)
        if not t[0] <= t_s <= t[-1] or np.diff(t[max(k - 1, 0) : k + 1]).max(initial=0.0) > GAP_S:
            raise InputError(f"no pose within {GAP_S:g} s of {t_s:.3f} s; they are from {t[0]:.3f} to {t[-1]:.3f} s")
        u, T = t[low:high] - t_s, self._Ts[min(k, len(t) - 1)]
        powers = np.vander(u, DEGREE + 1, increasing=True)
        fit = np.linalg.pinv(powers)
        for _ in range(2):  # the second about the pose itself
            c = fit @ log_se3(inverse(T) @ self._Ts[low:high])
            T = T @ exp_se3(c[0])
        return ToolMotion(T, c[1], 2 * c[2], self._cov * float((fit[0] ** 2).sum()))
