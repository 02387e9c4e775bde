"""An error-state Kalman filter: potentiometers give the motion, vision corrects their errors.

In: readings at 1 kHz, pose measurements at camera rate, late and out of order. Out: the tool's pose at 1 kHz with
covariance. The state is not the arm's pose but the errors of its potentiometers (``armerror``); it is constant except for
what joint motion makes it forget, so between measurements there is nothing to integrate: the pose at any time is the model
at that time's readings. For a late measurement the filter returns to the state kept before it, and applies it and those
after it again. What all measurements share (calibration) is no noise and is not averaged: the state is learned as vision
measures it, and the shared covariance is added to the output (Schmidt, 1966: considered, not estimated). Equations:
docs/concepts/loop.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import copy
from dataclasses import replace
from functools import partial
from itertools import chain
from typing import NamedTuple

import numpy as np

from armsight.data import Array, JointStates
from armsight.errors import InputError
from armsight.estimate.chance import chi_square_limit
from armsight.geometry.pose import left_axes
from armsight.loop.estimators import armerror
from armsight.loop.estimators.armerror import Prior
from armsight.loop.estimators.clock_doubt import ClockDoubt, JumpingClock
from armsight.loop.estimators.considered import Considered, Shares, gained, passed
from armsight.loop.estimators.errormodel import (
    LEARNING,
    NONE_CONSIDERED,
    VISION,
    ErrorModel,
    ErrorState,
    Predicted,
    Propagation,
    StateStep,
    Taken,
    Until,
    chi_square,
    opened,
    smoothed_anew,
    tool_axes,
)
from armsight.loop.estimators.estimator import ArmEstimate, Delay, Innovation, Learned, Outcome, PoseMeasurement, Track
from armsight.loop.estimators.parabola import SPAN_S
from armsight.loop.estimators.readings import GAP_RAD, Readings, Smoothed
from armsight.loop.estimators.smoothing import Interval, blended, by_state, intervals, smoothed_back
from armsight.loop.references.inertial import Inertial
from armsight.loop.references.reference import Reading, Reference, ToolMotion
from armsight.loop.references.strapdown import Advanced, Navigated, Samples, Strapdown
from armsight.robot.kinematics.arm import Arm

#: A measurement less likely than this is an outlier.
CHANCE = 1e-6
#: So many outliers in a row that agree with each other are then used: no marker is mistaken the same way so often.
STUBBORN = 6
#: More standard deviations of base, tool, zeros or backlash are an outlier; half: rigs knocked by 40 mm are not
#: followed, double: wrong stamps take the tool twice as far.
FURTHEST = 8.0
#: States kept for late measurements, s.
HISTORY_S = 1.0
#: Newer measurements wait for readings for so long, s; half: slow boards lose some, double: more memory.
WAITING_S = 0.5
#: Measurements of so long after a time serve to smooth it, at least, s; half: worse tracks, double: half as cheap.
AHEAD_S = 0.3
_GATE = chi_square_limit(6, CHANCE)
#: The tool's acceleration is the difference of its twists so long before and after, s; half: noisier, double: bends cut.
APART_S = 0.01
#: Windows without an image are at least so long, s; half: twice the cost, double: impacts are said late.
WINDOW_S = 0.04
#: While windows are used a link is anywhere in its gap, for so long, s; half: joints overrule what was felt, double: they
#: bound it later.
LOOSE_S = 0.3
#: The gain is that of images whose noise has so many times its variance while windows are used, as errors of images in a
#: row are alike; half: the tool follows what they share, double: late speeds.
ALIKE = 5.0


def _carried(considered: Considered, step: Propagation) -> dict[str, Array]:
    """Return how the state's error hangs on parameters that are considered after motion."""
    return {name: C * step.kept[0][:, None] for name, C in considered.items()}


def _measured(beside: Navigated, kept: Array, H: Array, HP: Array, z: Array, S: Array) -> tuple[Navigated, Array]:
    """Return what is beside the arm's errors after a measurement of these, and what (B, m) of its residual was added."""
    C = beside.C * kept[:, None]
    HC = H @ C
    gain = np.asarray(np.linalg.solve(S, HC).T, np.float64)
    return Navigated(beside.t_s, beside.y + gain @ z, C - HP.T @ gain.T, beside.Y - gain @ HC), gain


class Remembered(NamedTuple):
    """What an estimator knew.

    ``x`` (K,) and ``P`` (K, K): the arm's error and its covariance; ``clock``: what the clock's follower knew, None where
    that is not known.
    """

    x: Array
    P: Array
    clock: Array | None


class KalmanEstimator:
    """Fuses potentiometers and vision.

    Args:
        learns_delay: whether the delay is corrected, as far as its sigma allows. If not, its sigma is used, and what the
            model misses of the backlash cannot be taken for delay; a clock that goes wrong is followed.
    """

    def __init__(self, arm: Arm, *, prior: Prior | None = None, delay: Delay, learns_delay: bool = True) -> None:
        self._arm, self._prior, self._delay, self._learns_delay = arm, prior or Prior(), delay, learns_delay
        self._readings = Readings(self._prior.reading_rad, arm, self._prior.rounded_rad)
        self._model = ErrorModel(arm, self._prior, delay.sigma_s)
        joints = arm.joints
        none, ones = np.zeros((1, joints)), np.ones((1, joints))
        nowhere = Smoothed(none, none, ones, ones, np.zeros((1, 3, joints)), none, np.zeros((1, 2, joints)))
        at = self._at = self._model.layout
        # The whole widths (n,) of the backlash, whatever decides on the side; the rows of what is forgotten: the rest, the
        # readings' noise and the pose, which stand side by side.
        whole = np.eye(at.size)
        self._widths = whole[at.backlash : at.floats] + whole[at.floats : at.compliance]
        # The variances (n,) of links that may be anywhere in their gaps.
        self._anywhere = self._model.sigmas[at.rest : at.reading] ** 2 + self._widths @ self._model.sigmas**2
        self._forgets, self._loose = slice(at.rest, at.delay), slice(at.rest, at.reading)
        self._opened, self._tight = opened(joints), np.zeros(joints, np.bool_)
        furthest = FURTHEST * np.sqrt(self._model.sigmas**2 + self._opened)
        self._furthest = np.where(self._opened > 0.0, furthest, np.inf)
        self._states = [ErrorState(-np.inf, np.zeros(at.size), np.diag(self._model.sigmas**2), nowhere, None)]
        #: called with what became of each pose measurement that came in order of time
        self.on_innovation: Callable[[Innovation], None] | None = None
        #: the same of readings of references, with the reference's name; their innovations have m numbers
        self.on_reading: Callable[[str, Innovation], None] | None = None
        #: follows the camera's clock; None where the delay is learned
        self.clock = None if learns_delay else JumpingClock(at.size, at.delay, delay.sigma_s)
        self._doubt = ClockDoubt(at.delay)
        self._reference: Array | None = None
        self._waiting: list[PoseMeasurement | Taken | Until] = []
        # The inertial unit, what was known without it, what contradicts it in a row, and the newest window.
        no_reference: Reference | None = None
        self._unit: Strapdown | None = None
        self._without: Remembered | None = None
        self._against, self._rejected, self._window = dict[type, int](), no_reference, Outcome.WAITING
        self._outliers, self._struck_s = list[Array](), -np.inf  # and when links were last struck
        self._offsets: list[tuple[float, float]] = []  # of the clock, s, that explain outliers, and their information
        self._back: list[ErrorState] = []  # the newest states, smoothed, while a unit is used
        self._backlash_set = True  # whether the readings have the newest estimate of the backlash
        # At the newest reading, until something is heard: the state, the joints and what came of the state, and the tool.
        self._here: tuple[ErrorState, Smoothed, Propagation] | None = None
        self._newest: ArmEstimate | None = None

    @property
    def sigmas(self) -> Array:
        """(K,) standard deviations of the state before anything was measured."""
        return self._model.sigmas

    @property
    def settings(self) -> tuple[Prior, Delay, bool]:
        """Prior, delay and whether the delay is corrected: what it was made with."""
        return self._prior, self._delay, self._learns_delay

    @property
    def span_s(self) -> tuple[float, float]:
        """The oldest and the newest time that can be estimated, s."""
        return self._readings.span_s

    def keep_reference(self) -> None:
        """Say from now on what measurements are against the state as it is now, forgotten parts left out."""
        self._reference = self._states[-1].x.copy()
        self._reference[self._forgets] = 0.0

    @property
    def reference(self) -> Array:
        """The state (K,) of :meth:`keep_reference`."""
        assert self._reference is not None
        return self._reference

    @property
    def forgets(self) -> slice:
        """Rows of the state that motion makes it forget."""
        return self._forgets

    @property
    def delay_row(self) -> int:
        """Row of the delay in the state."""
        return self._at.delay

    def remembered(self) -> Remembered:
        """Return what is known now, for :meth:`restore`."""
        newest = self._states[-1]
        return Remembered(newest.x.copy(), newest.P.copy(), None if self.clock is None else self.clock.remembered())

    def nothing_known(self) -> Remembered:
        """Return that of which :meth:`restore` makes the prior."""
        return Remembered(np.zeros(self._at.size), np.zeros((self._at.size, self._at.size)), None)

    def known_again(self, state: Remembered) -> tuple[Array, Array]:
        """Return an earlier state (K,) and its covariance (K, K) later: what motion makes it forget is unknown."""
        x, P, rows = state.x.copy(), state.P.copy(), self._forgets
        x[rows] = P[rows] = P[:, rows] = 0.0
        P[np.diag_indices(self._at.size)] += np.where(np.diag(P) > 0.0, 0.0, self._model.sigmas**2)
        return x, P

    def unit_differs(self) -> dict[str, float]:
        """Return by how many of its sigma before each parameter of the inertial unit, biases left out, is found off."""
        if self._unit is None or (beside := self._states[-1].beside) is None:
            return {}
        sensor = self._unit.sensor
        sigma = np.maximum(np.append(sensor.sigma_delay_s, np.sqrt(np.diag(sensor.cov))), 1e-12)
        found = zip(("delay_s", *sensor.parameters), (np.abs(beside.y[3:]) / sigma).tolist(), strict=True)
        return {name: off for name, off in found if "bias" not in name}

    def restore(self, state: Remembered) -> None:
        """Go on from an earlier state: what was measured since is dropped, and what motion makes it forget is unknown.

        Of a clock whose state is not known at that time what is followed now stays.
        """
        (x, P), newest = self.known_again(state), self._states[-1]
        if self.clock is not None:
            self.clock.restore(state.clock, self._forgets)
        P = P if self._unit is None else self._delay_apart(P)
        self._states = [newest._replace(x=x, P=P, taken=None, considered=NONE_CONSIDERED, beside=None)]
        self._outliers, self._offsets, self._against, self._struck_s = [], [], {}, -np.inf
        self._back, self._newest, self._here = [], None, None
        self._doubt.drop()
        self._waiting, self._backlash_set = [], False

    def as_before(self, state: Remembered) -> KalmanEstimator:
        """Return an estimator at the newest reading that knows what this one knew of the arm earlier; it takes nothing."""
        other = copy(self)
        other.clock = other.on_innovation = other.on_reading = None
        other._doubt = ClockDoubt(self._at.delay)
        other.restore(state)
        return other

    def joints(self, states: JointStates) -> None:
        """Take readings of the potentiometers, in order of time."""
        self._newest = self._here = None
        if not self._backlash_set:  # not when it was measured: a command waits for that
            self._backlash_set = True
            self._readings.set_backlash(self._backlash())
        self._readings.add(states)
        if self._waiting:
            waiting, self._waiting = self._waiting, []
            for measurement in waiting:
                self._hear(measurement)
        self._go_on()

    def vision(self, pose_measurement: PoseMeasurement) -> Outcome:
        """Take a pose measurement, in any order of time; return what became of it."""
        return self._hear(pose_measurement)

    def take(self, reference: Reference, reading: Reading | Samples) -> Outcome:
        """Take a reading of a reference beside vision, in any order of time; return what became of it.

        The reference's parameters and delay are considered by their covariance, not estimated. An outlier is never used,
        however often it comes back: which of reference and vision is wrong is not the filter's to say. Samples of an
        inertial unit come in order of time; its parameters and delay are estimated. A unit that so many images, or windows,
        in a row contradict as reopen a filter is used no more, and what was learned with it is forgotten: they are outliers
        then. While the camera's delay is learned, none are used: they would shift it by several of its sigma.

        Raises:
            InputError: the reference has no such channel, or samples are not of an inertial unit, or not in order.
        """
        if isinstance(reading, Samples):
            if not isinstance(reference, Inertial):
                raise InputError(f"{reference.name}: samples are of inertial units; give its readings one by one")
            if reference is self._rejected:
                return Outcome.OUTLIER
            if self._learns_delay:
                return Outcome.WAITING
            if self._unit is None or self._unit.sensor is not reference:
                self._unit, self._without = Strapdown(reference), self.remembered()
                self._states = [self._states[-1]._replace(P=self._delay_apart(self._states[-1].P))]
            self._unit.add(reading)
            self._newest = self._here = None
            return self._go_on()
        if not 0 <= reading.channel < len(reference.channels):
            raise InputError(
                f"{reference.name}: channel {reading.channel} of {len(reference.channels)}: {', '.join(reference.channels)}"
            )
        return self._hear(Taken(reference, reading))

    def _delay_apart(self, P: Array) -> Array:
        """Return a covariance (K, K) without the delay, whose sigma is each image's noise while a unit is used."""
        apart = P.copy()
        apart[self._at.delay] = apart[:, self._at.delay] = 0.0
        return apart

    def _go_on(self) -> Outcome:
        """Use a window of the inertial unit as far as its samples and the joints have come; waiting where it is short."""
        if self._unit is None or not np.isfinite(begin := self._states[-1].t_s):
            return Outcome.WAITING
        end = min(self._unit.newest_s, self.span_s[1])
        return self._hear(Until(end)) if end - begin >= WINDOW_S else Outcome.WAITING

    def _hear(self, measurement: PoseMeasurement | Taken | Until) -> Outcome:
        """Use a measurement after those before it in time, and use those after it again."""
        self._newest = self._here = None
        oldest, newest = self.span_s
        row = self._row(measurement)
        before = self._states[row - 1]
        seen_s = self._seen_s(measurement, before)
        if seen_s > newest:
            kept = (each for each in self._waiting if self._seen_s(each, before) > seen_s - WAITING_S)
            self._waiting = [*kept, measurement]
            return Outcome.WAITING
        if seen_s < oldest or (row == 1 and before.measurement is not None and self._after(before, measurement)):
            return Outcome.TOO_LATE
        # Of windows one follows.
        later = [state for state in self._states[row:] if not isinstance(state.measurement, Until)]
        self._window = Outcome.WAITING
        after, outcome = self._used(before, measurement, report=not later)
        contradicted = self._contradicted(Until, self._window)
        if isinstance(measurement, PoseMeasurement):
            contradicted = self._contradicted(PoseMeasurement, outcome) or contradicted
        if after is None or contradicted:
            return outcome
        self._states[row:] = [after]
        for state in later:
            again, _ = (None, None) if state.measurement is None else self._used(self._states[-1], state.measurement)
            if again is not None:
                self._states.append(again)
        self._backlash_set = False
        while len(self._states) > 2 and self._states[1].t_s < self._states[-1].t_s - HISTORY_S:
            del self._states[0]
        return outcome

    def _row(self, measurement: PoseMeasurement | Taken | Until) -> int:
        """Return the row, at least 1, that the state after a measurement has among those stored."""
        row = len(self._states)
        while row > 1 and self._after(self._states[row - 1], measurement):
            row -= 1
        return row

    def _contradicted(self, kind: type, outcome: Outcome) -> bool:
        """Count outcomes of a kind, images or windows; return whether so many are against the unit that it was dropped."""
        if self._unit is None or self._without is None or outcome is Outcome.WAITING:
            return False
        if kind is PoseMeasurement and self._offsets:  # an offset of the clock explains it as well
            return False
        self._against[kind] = 0 if outcome is Outcome.USED else self._against.get(kind, 0) + 1
        if self._against[kind] < STUBBORN:
            return False
        self._rejected, self._unit = self._unit.sensor, None
        self.restore(self._without)
        return True

    def _used(
        self, before: ErrorState, measurement: PoseMeasurement | Taken | Until, *, report: bool = False
    ) -> tuple[ErrorState | None, Outcome]:
        """Return the state after a measurement, None where it is an outlier."""
        if isinstance(measurement, Until):
            after = self._felt(before, measurement.t_s, report=report)
            after = self._alone(before, measurement.t_s) if after is before else after
            return after._replace(taken=measurement), Outcome.USED
        if isinstance(measurement, Taken):
            return self._take_reading(before, measurement, report=report)
        return self._take(before, measurement, self._report if report else None)

    def estimate(self, t_s: float | None = None) -> ArmEstimate:
        """Return the pose of the tool at a time, by default that of the newest reading."""
        if t_s is not None:
            return self.track(np.array([t_s]))[0]
        if self._newest is None:
            state, joints, step = self._now()
            (T,), covs, owns = self._model.tracked(state, step, joints)
            (cov,), (own,) = self._doubted(state, step, joints, covs, owns)
            t_s = self.span_s[1]
            self._newest = ArmEstimate(t_s, T, cov, own, joints.q[0], joints.qd[0], t_s - state.seen_s)
        return self._newest

    def _now(self) -> tuple[ErrorState, Smoothed, Propagation]:
        """Return the state after the newest measurement, the joints at the newest reading, and the propagation to it."""
        if self._here is None:
            newest = np.array([self.span_s[1]])
            state, joints = self._anew(self._felt(self._states[-1], self.span_s[1]), newest)
            self._here = state, joints, self._model.moved(state, joints, newest)
        return self._here

    def _since(self, t_s: Array) -> tuple[ErrorState, Smoothed, Propagation]:
        """Return the same at (N,) times."""
        state, joints = self._anew(self._states[-1], t_s)
        return state, joints, self._model.moved(state, joints, t_s)

    def _anew(self, state: ErrorState, t_s: Array) -> tuple[ErrorState, Smoothed]:
        """Return a state updated by the readings that have come since, and the joints at (N,) times."""
        if state.t_s < self.span_s[0]:
            return state, self._readings.at(t_s)
        joints = self._readings.at(np.concatenate([[state.t_s], t_s]))
        return smoothed_anew(state, joints.rows(0, 1)), joints.rows(1, len(t_s) + 1)

    def track(self, t_s: Array) -> Track:
        """Return the poses of the tool at (N,) times."""
        state, joints, step = self._since(np.asarray(t_s, dtype=float))
        track = by_state(self._model, state, t_s, joints, step)
        covs, own = self._doubted(state, step, joints, track.covs, track.covs_own)
        return replace(track, covs=covs, covs_own=own)

    def _doubted(self, state: ErrorState, step: Propagation, joints: Smoothed, *covs: Array) -> list[Array]:
        """Return covariances (N, 6, 6) with what a jump of the clock that is not certain does."""
        if (doubt := self._doubt.sigma) is None:
            return list(covs)
        _, Hs = self._model.poses(state.x * step.kept, joints.q, joints.unseen)
        off = np.einsum("nij,nj->ni", Hs, step.kept * doubt[: self._at.size])
        return [each + off[:, :, None] * off[:, None, :] for each in covs]

    def smoothed(self, t_s: Array) -> Track:
        """Return the poses of the tool at (N,) times, rising, with the measurements after them used, too."""
        return self.blended(self.intervals(t_s))

    def intervals(self, t_s: Array) -> list[Interval]:
        """Return times (N,), rising, grouped by the measurements around them so far: for :meth:`blended`, soon after."""
        if self._states[-1].beside is None:
            return intervals(self._states, t_s)
        if not self._back or self._back[-1].t_s < t_s[-1] + AHEAD_S:
            near = [state for state in self._states[:-1] if state.t_s > t_s[0] - HISTORY_S]
            self._back = smoothed_back([*near, self._states[-1]])
        return intervals(self._back, t_s)

    def blended(self, parts: list[Interval]) -> Track:
        """Return the poses of the tool at the times of intervals as :meth:`smoothed` does; many cost little extra."""
        return blended(self._model, self._readings, parts)

    def tool(self, q: Array, qd: Array, *, pressed: bool = False) -> Array:
        """Return T_base_tool if the potentiometers read q (N, n) moving at qd (N, n), by what is known now."""
        state, now, step = self._now()
        loose = self._readings.loose(now.q[0]) if pressed else self._tight
        return self._model.imagined(state, step, now, np.ascontiguousarray(q), np.ascontiguousarray(qd), loose)

    def learned(self) -> Learned:
        """Return what has been learned about the arm."""
        state, now, step = self._now()
        x, P = state.x * step.kept[0], state.P * np.outer(step.kept[0], step.kept[0]) + np.diag(step.added[0])
        by = np.empty((self._at.joints, self._at.size))
        armerror.offsets_by(self._arm.table, now.q[0], now.unseen[0], by)
        by[np.arange(self._at.joints), self._at.zeros] = self._arm.direction
        by[:, self._at.noise] = 0.0  # of the arm, not of the moment
        delay_s = math.sqrt(P[self._at.delay, self._at.delay])
        if self._unit is not None:  # then it is each image's noise, not in the state
            delay_s = math.hypot(delay_s, self._delay.sigma_s)
        return Learned(
            by @ x,
            np.sqrt(np.einsum("ij,jk,ik->i", by, P, by)),
            self._widths @ x,
            np.sqrt(np.diag(self._widths @ P @ self._widths.T)),
            now.unseen[0, 0],
            replace(self._delay, delay_s=self._delay_s(self.span_s[1], x), sigma_s=delay_s),
        )

    def _backlash(self) -> Array:
        """Return the backlash (n,) to use, rad: learned and typical (GAP_RAD), weighted by how well it is known."""
        state = self._states[-1]
        known = 1 - np.diag(self._widths @ state.P @ self._widths.T) / (self._widths @ self._model.sigmas**2)
        return np.asarray(known * (self._widths @ state.x) + (1 - known) * GAP_RAD)

    def _after(self, state: ErrorState, measurement: PoseMeasurement | Taken | Until) -> bool:
        """Return whether a state has used a measurement newer than this one."""
        used = state.measurement
        if isinstance(used, PoseMeasurement) and isinstance(measurement, PoseMeasurement):
            return used.t_s > measurement.t_s
        return used is not None and state.t_s > self._seen_s(measurement, state)  # their stamps are of several clocks

    def _seen_s(self, pose_measurement: PoseMeasurement | Taken | Until, state: ErrorState) -> float:
        """Return the time of a measurement, s, by a state's estimate of the delay."""
        if not isinstance(pose_measurement, PoseMeasurement):
            return pose_measurement.t_s
        return pose_measurement.t_s - self._delay_s(pose_measurement.t_s - self._delay.delay_s, state.x)

    def clock_offset_s(self, t_s: float) -> float:
        """Return by how much later than the delay says the camera's stamps are about a time, s; 0 while that is right."""
        return 0.0 if self.clock is None else self.clock.offset_s(t_s)

    def _delay_s(self, t_s: float, x: Array) -> float:
        """Return how late stamps are about a time, s, by a state's vector."""
        return self._delay.delay_s + float(x[self._at.delay]) + self.clock_offset_s(t_s)

    def _report(self, innovation: Innovation) -> Array | None:
        """Report what became of a measurement; return (size,) what a clock that is followed adds to the state, or None."""
        used = innovation.outcome is not Outcome.OUTLIER
        effect = self.clock.take(innovation) if used and self.clock is not None else None
        if effect is not None and effect.change is not None:
            self._doubt.corrected(effect.offset_s)
        if self.on_innovation is not None:
            self.on_innovation(innovation if effect is None else replace(innovation, clock=effect))
        return None if effect is None else effect.change

    def _take(
        self,
        before: ErrorState,
        pose_measurement: PoseMeasurement,
        report: Callable[[Innovation], Array | None] | None = None,
    ) -> tuple[ErrorState | None, Outcome]:
        """Return the state after a measurement, None where it is an outlier; report how it came about."""
        t_s, known = max(self._seen_s(pose_measurement, before), before.t_s), before.t_s
        times, jitter_s = np.array([t_s]), self._delay.jitter_s
        if self._unit is not None:
            jitter_s = float(np.hypot(jitter_s, self._delay.sigma_s))
        felt = self._felt(before, t_s, report=report is not None)
        steps = () if felt is before else felt.steps
        before, joints = self._anew(felt, times)
        step = self._model.moved(before, joints, times, learning=LEARNING)
        given, beside = pose_measurement, before.beside
        if self._unit is not None:
            pose_measurement = replace(given, cov_noise=ALIKE * given.cov_noise)
        at, chi = self._model.predicted(before, step, joints, pose_measurement, jitter_s)
        outcome = self._gate(at, chi)
        if report is not None and self._mistimed(at, chi, outcome):
            outcome = Outcome.OUTLIER
        if outcome is Outcome.OUTLIER:
            if report is not None:
                none = np.zeros((self._at.size, 6))
                report(self._said(times, before, joints, pose_measurement, at, step, none, outcome))
            return None, outcome
        if outcome is Outcome.REOPENED:
            at.P[np.diag_indices(self._at.size)] += self._opened
            at.HP[:] += at.H * self._opened
        K, z, H = self._model.updated(at, joints, pose_measurement, jitter_s, learns_delay=self._learns_delay)
        x, P = at.x, at.P
        if beside is not None:
            noise = pose_measurement.cov_noise + jitter_s**2 * np.outer(H[:, self._at.delay], H[:, self._at.delay])
            S = noise + at.HP @ H.T
            beside, gain = _measured(beside, step.kept[0], H, at.HP, z, S)
            by = np.hstack([H * step.kept[0], np.zeros((6, len(gain)))])
            # The gain is that of images which count less; what remains is by their own noise (Joseph's form).
            less = (pose_measurement.cov_noise - given.cov_noise) @ np.hstack([K.T, gain.T])
            whole = np.vstack([K, gain]) @ less
            P = P - whole[: len(P), : len(P)]
            beside = beside._replace(C=beside.C - whole[: len(P), len(P) :], Y=beside.Y - whole[len(P) :, len(P) :])
            last = StateStep(step.kept[0], by, np.vstack([K, gain]), z, S)
        else:
            last = StateStep(step.kept[0], H * step.kept[0], K, z, at.S)
        steps = *steps, last
        if not (np.abs(x) < self._furthest).all():  # NaN neither
            return None, Outcome.OUTLIER
        if report is not None:
            if self.clock is not None:
                between = (state.steps for state in self._states if self._doubt.t_s < state.t_s <= known)
                self._doubt.step(t_s, (*chain.from_iterable(between), *steps), at, len(x))
            change = report(self._said(times, before, joints, pose_measurement, at, step, K, outcome))
            if change is not None:
                x = x + change
            if change is not None and self.clock is not None and self._unit is None:
                by_delay = P[:, self._at.delay] / P[self._at.delay, self._at.delay]
                P += (self.clock.sigma_s**2 - P[self._at.delay, self._at.delay]) * np.outer(by_delay, by_delay)
        considered = passed(_carried(before.considered, step), K, at.H) if before.considered else NONE_CONSIDERED
        return ErrorState(t_s, x, P, joints, given, considered=considered, beside=beside, steps=steps), outcome

    def _alone(self, before: ErrorState, t_s: float, by: tuple[Smoothed, Propagation] | None = None) -> ErrorState:
        """Return the state at a time by the joints alone; ``by``: the joints then, and what the motion does to it."""
        if by is None:
            before, joints = self._anew(before, np.array([t_s]))
            by = joints, self._model.moved(before, joints, np.array([t_s]), learning=LEARNING)
        joints, step = by
        x, P = self._propagated(before, step)
        beside, considered, steps = before.beside, _carried(before.considered, step), tuple[StateStep, ...]()
        if beside is not None:
            beside, size = beside._replace(C=beside.C * step.kept[0][:, None]), len(x) + len(beside.y)
            steps = (StateStep(step.kept[0], np.zeros((0, size)), np.zeros((size, 0)), np.zeros(0), np.zeros((0, 0))),)
        return ErrorState(t_s, x, P, joints, before.pose_measurement, None, before.seen_s, considered, beside, steps)

    @staticmethod
    def _propagated(before: ErrorState, step: Propagation) -> tuple[Array, Array]:
        """Return what motion makes of the arm's error (K,) and its covariance (K, K)."""
        P = before.P * np.outer(step.kept[0], step.kept[0])
        P[np.diag_indices(len(P))] += step.added[0]
        return before.x * step.kept[0], P

    def _felt(self, before: ErrorState, t_s: float, *, report: bool = False) -> ErrorState:
        """Return the state at a time by the joints and what an inertial unit felt; as it is where that is not known."""
        window = None if self._unit is None else self._unit.window(before.t_s, t_s)
        if self._unit is None or window is None:
            return before
        before, joints = self._anew(before, np.array([t_s]))
        step, loose = self._model.moved(before, joints, np.array([t_s])), self._loose
        kept, added = step.kept[0], step.added[0]
        if not np.isfinite(window).all():  # clipped: links may be anywhere within their gaps
            kept[loose], added[loose], self._struck_s = 0.0, self._anywhere, t_s
            if report and self.on_reading is not None:
                none = np.zeros((0, 0)), np.zeros((0, len(kept))), kept, np.zeros((len(kept), 0))
                self.on_reading(self._unit.sensor.name, Innovation(t_s, np.eye(4), np.zeros(0), *none, Outcome.OUTLIER))
            return self._alone(before, t_s, (joints, step))
        share = float(np.exp(-window[0] / LOOSE_S))
        kept[loose] *= share
        added[loose] += self._apart(before, joints, share)
        ends = before.joints, joints
        q, unseen = (np.concatenate([getattr(end, part) for end in ends]) for part in ("q", "unseen"))
        got, Ts, outcome = self._advanced(self._unit, window, before, step, q, unseen)
        if report:
            self._window = outcome
        if report and self.on_reading is not None:
            said = got.z, got.S, got.by, kept.copy(), got.gain[: len(kept)], outcome
            self.on_reading(self._unit.sensor.name, Innovation(t_s, Ts[1], *said, added=added.copy()))
        if outcome is Outcome.OUTLIER:  # an impact: links may be anywhere within their gaps
            kept[loose], added[loose], self._struck_s = 0.0, self._anywhere, t_s
            got, _, again = self._advanced(self._unit, window, before, step, q, unseen)
            if again is Outcome.OUTLIER:
                return self._alone(before, t_s, (joints, step))
        apart = before.considered.items()
        considered = {name: C * kept[:, None] - got.gain[: len(C)] @ (got.by @ C) for name, C in apart}
        by, velocity = np.hstack([got.by, got.by_y]), got.velocity
        if before.beside is None or before.beside.t_s != before.t_s:  # it began with another velocity
            by[:, len(kept) : len(kept) + 3] = velocity[:, len(kept) : len(kept) + 3] = 0.0
        came = (StateStep(kept, by, got.gain, got.z, got.S, velocity),)
        last = before.pose_measurement, None, before.seen_s, considered, got.beside._replace(t_s=t_s), came
        return ErrorState(t_s, got.x, got.P, joints, *last)

    def _apart(self, before: ErrorState, joints: Smoothed, share: float) -> Array:
        """Return the variances (n,) of links in their gaps that a window adds, of whose beginning a share is left.

        A link may be anywhere between the ends (w^2 / 12), and a change of side that joints show may be early or late
        (w^2 / 4 of a whole one, which moves the side by 2).
        """
        at, P = self._at, before.P
        parts = slice(at.backlash, at.floats), slice(at.floats, at.compliance)
        squares = np.array([before.x[part] ** 2 + np.diag(P)[part] for part in parts])
        whole = squares.sum(axis=0) + 2.0 * (before.x[parts[0]] * before.x[parts[1]] + np.diag(P[parts[0], parts[1]]))
        flips = np.maximum(joints.flips - before.joints.flips, 0.0)[0]
        within = self._anywhere if before.seen_s < self._struck_s else whole / 12.0  # until images show where they are
        return np.asarray(within * (1.0 - share**2) + (squares * flips).sum(axis=0) / 8.0)

    def _advanced(
        self, unit: Strapdown, window: Array, before: ErrorState, step: Propagation, q: Array, unseen: Array
    ) -> tuple[Advanced, Array, Outcome]:
        """Return what a window does, the tool's poses (2, 4, 4) at its ends, and whether it is likely; q (2, n) there."""
        Ts, Hs = self._model.poses(np.stack([before.x, before.x * step.kept[0]]), q, unseen)
        beside = before.beside
        if beside is None or beside.t_s != before.t_s:
            twist = Hs[0][:, self._at.zeros] * self._arm.direction @ before.joints.qd[0]
            beside = unit.started(beside, before.t_s, Ts[0], twist, len(before.x))
        change = step.kept[0], step.added[0]
        got = unit.advanced(window, beside, (before.x, before.P), change, (Ts, Hs), self._at.delay)
        likely = chi_square(np.ascontiguousarray(got.S), got.z) < _GATE and (np.abs(got.x) < self._furthest).all()
        return got, Ts, Outcome.USED if likely else Outcome.OUTLIER

    def _take_reading(self, before: ErrorState, taken: Taken, *, report: bool) -> tuple[ErrorState | None, Outcome]:
        """Return the state after a reading of a reference, None where it is an outlier; report it."""
        (reference, reading), t_s = taken, max(taken.t_s, before.t_s)
        before, joints = self._anew(self._felt(before, t_s, report=report), np.array([t_s]))
        step = self._model.moved(before, joints, np.array([t_s]), learning=LEARNING)
        kept, added = step.kept[0], step.added[0]
        x, P = self._propagated(before, step)
        (T,), (by_state,) = self._model.poses(x, joints.q, joints.unseen)
        motion, cov_twist, cov_acceleration = self._motion(x, T, by_state, joints, t_s, reference.inertial)
        expected = reference.expected(motion, reading.channel)
        z, H, R = reading.z - expected.z, expected.by_tool @ by_state, np.array(reading.cov)
        if expected.by_twist is not None:
            R += expected.by_twist @ cov_twist @ expected.by_twist.T
        if expected.by_acceleration is not None:
            R += expected.by_acceleration @ cov_acceleration @ expected.by_acceleration.T
        by = np.column_stack([expected.by_parameters, -expected.rate(motion)])
        cov = np.zeros((by.shape[1], by.shape[1]))
        cov[:-1, :-1], cov[-1, -1] = reference.cov, reference.sigma_delay_s**2
        shares = {reference.name: Shares(by, cov)}
        if before.pose_measurement is not None:
            common = left_axes(before.pose_measurement.T_base_tool, before.pose_measurement.cov_common)
            shares[VISION] = Shares(expected.by_tool @ tool_axes(T), common)
        fixed = [] if self._learns_delay else [self._at.delay]
        got = gained(P, z, H, R, shares, _carried(before.considered, step), fixed)
        outcome = Outcome.USED if got.square < chi_square_limit(len(z), CHANCE) else Outcome.OUTLIER
        x = x + got.gain @ z
        if not (np.abs(x) < self._furthest).all():  # NaN neither
            outcome = Outcome.OUTLIER
        if report and self.on_reading is not None:
            gain = got.gain if outcome is Outcome.USED else np.zeros_like(got.gain)
            self.on_reading(reference.name, Innovation(t_s, T, z, got.S, H, kept, gain, outcome, None, None, added, R))
        if outcome is Outcome.OUTLIER:
            return None, outcome
        beside = before.beside
        if beside is not None:
            beside, _ = _measured(beside, kept, H, H @ P, z, got.S)
        used = before.pose_measurement, taken, before.seen_s, got.considered, beside
        return ErrorState(t_s, x, got.P, joints, *used), outcome

    def _motion(
        self, x: Array, T: Array, by_state: Array, joints: Smoothed, t_s: float, inertial: bool
    ) -> tuple[ToolMotion, Array, Array]:
        """Return how the tool moves by a state, and what the readings' noise makes of its twist and acceleration (6, 6)."""
        by_speed = by_state[:, self._at.zeros] * self._arm.direction
        # The variance that a parabola leaves of its slope at its end is 192/(9 SPAN^2) of that of its value.
        slope = (self._prior.reading_rad / SPAN_S) ** 2
        moves = np.where(joints.qd[0] == 0.0, 0.0, joints.variance[0] * 192 / 9) * slope
        cov_twist = by_speed * moves @ by_speed.T
        motion, ends = ToolMotion(T, by_speed @ joints.qd[0]), np.clip([t_s - APART_S, t_s + APART_S], *self.span_s)
        if not inertial or ends[1] <= ends[0]:
            return motion, cov_twist, np.zeros((6, 6))
        near = self._readings.at(ends)
        _, Hs = self._model.poses(x, near.q, near.unseen)
        twists = ((Hs[:, :, self._at.zeros] * self._arm.direction) @ near.qd[..., None])[..., 0]
        acceleration = (twists[1] - twists[0]) / (ends[1] - ends[0])
        return motion._replace(acceleration=acceleration), cov_twist, cov_twist * 2 / (ends[1] - ends[0]) ** 2

    def _said(
        self,
        times: Array,
        before: ErrorState,
        joints: Smoothed,
        pose_measurement: PoseMeasurement,
        at: Predicted,
        step: Propagation,
        gain: Array,
        outcome: Outcome,
    ) -> Innovation:
        """Return what became of a measurement at a time (1,): states before and at it, the propagation, gain, outcome."""
        reference, wandered = None, None
        if self._reference is not None and self.on_innovation is not None:
            wandered = self._model.moved(before, joints, times).added[0]
            reference = partial(self._model.innovation, self._reference, joints, pose_measurement, self._delay.jitter_s)
        seen = float(times[0]), pose_measurement.T_base_tool, at.z, at.S, at.H
        return Innovation(*seen, step.kept[0], gain, outcome, None, reference, step.added[0], at.R, wandered)

    def _mistimed(self, at: Predicted, chi: float, outcome: Outcome) -> bool:
        """Return whether outliers in a row are all of one offset of the clock; then that jumped, and is corrected.

        One number explains six of each image: a camera that was moved, or an arm, is not off along its motion alone.
        """
        late = at.H[:, self._at.delay]
        weighed = np.linalg.solve(at.S, late)
        information, score = max(float(late @ weighed), 1e-12), float(at.z @ weighed)
        if self.clock is None or outcome is Outcome.USED or chi - score**2 / information > _GATE:
            self._offsets = []
            return False
        self._offsets.append((score / information, information))
        offsets, weights = np.array(self._offsets).T
        mean = float(weights @ offsets / weights.sum())
        one = weights @ (offsets - mean) ** 2 < chi_square_limit(len(offsets), CHANCE)
        if outcome is Outcome.OUTLIER or not one:
            return False
        if len(offsets) >= STUBBORN:
            self.clock.jump(mean, 1.0 / float(weights.sum()))
            self._doubt.drop()
            self._offsets = []
        return True

    def _gate(self, at: Predicted, chi: float) -> Outcome:
        """Return whether an innovation, with its chi-square, is used, an outlier, or one too many to ignore."""
        z, S = at.z, at.S
        if chi < _GATE:
            self._outliers = []
            return Outcome.USED
        if self._outliers and chi_square(S, z - self._outliers[-1]) > _GATE:
            self._outliers = []
        self._outliers.append(z)
        if len(self._outliers) < STUBBORN:
            return Outcome.OUTLIER
        self._outliers = []
        return Outcome.REOPENED
