"""A reference beside vision in a run: its readings go into the estimator, and a row says whether it agrees.

In: readings of an :class:`~armsight.loop.references.file.Entry`. Out: a :class:`FusedRow` or a :class:`HeadingRow`.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from armsight.data import Array
from armsight.errors import InputError
from armsight.estimate.chance import squares_of
from armsight.loop.estimators.estimator import Estimator, Innovation, Outcome
from armsight.loop.estimators.kalman import KalmanEstimator
from armsight.loop.references.distance import MOST_M, Distance
from armsight.loop.references.file import Entry, read_recording
from armsight.loop.references.heading import AVERAGED_S, FIELDS_S, LEAST_T, MOST_T, NOISE_T, Magnetometer, heading_off
from armsight.loop.references.inertial import INERTIAL_CLASSES, Inertial
from armsight.loop.references.reference import Reading, ToolMotion
from armsight.loop.references.strapdown import GAP_S, Samples

#: Residuals over their sigma below which a unit agrees (half is usual), and outliers' share; half: chance is a fault,
#: double: a loose mount agrees.
HONEST, OUTLIERS = 1.0, 0.01
#: Sigmas of its calibration from which on a parameter that is found off is said; half: chance is, double: 2 ms are not.
OFF = 5.0
#: Samples that are given at once at most: older ones are of before the estimator began.
MOST = 1000
#: Outliers so close together are one impact, s; half: one that rings counts twice, double: two knocks count once.
APART_S = 0.3
_SAID = 5  # impacts in a line
#: Sigmas below which a heading agrees, and the sigma, rad, above which it then says nothing. Half: chance disagrees, few
#: magnetometers say anything; double: a base that was rotated by 15 degrees agrees.
AGREES, SAYS_RAD = 3.0, math.radians(3.0)
#: A range that stands still while it should change by so many sigma, and by so much, m; half: a coarse step is one.
STILL, LEAST_M = 8.0, 1e-3
#: Returns times (N,), s, and readings (N, 6) up to a time, s, that were not returned before.
ReadingsSource = Callable[[float], tuple[Array, Array]]


@dataclass(frozen=True)
class FusedRow:
    """What a reference beside vision did to the estimates of a run."""

    name: str  #: of the reference
    windows: int  #: of its readings that were used or rejected
    outliers: int  #: of them rejected
    begin_s: float  #: since when it was used, s: before, the camera's delay is learned
    #: root mean square; half is usual, as links count as loose; from ``HONEST`` on it disagrees
    residual_over_sigma: float
    agrees: bool  #: whether it agrees with joints and vision
    rejected_s: float | None  #: when it was dropped as images contradict it, s; None where it was not
    moved_rms_m: float | None  #: distance of the estimates from those recorded before, m; None where there are none
    sigma_rms_m: float  #: of the position with it, root of the trace, m
    sigma_without_rms_m: float | None  #: and of those before, m
    impacts_s: tuple[float, ...]  #: when the joints did not explain what was felt, s, as after a knock
    losses: tuple[str, ...]  #: what was lost of it, and why it was used no more; empty where nothing was

    @property
    def line(self) -> str:
        """It as a line for people."""
        found = "agrees" if self.agrees else "disagrees"
        moved = without = dropped = ""
        if self.moved_rms_m is not None and self.sigma_without_rms_m is not None:
            moved = f"the estimates move by {1e3 * self.moved_rms_m:.3f} mm RMS, "
            without = f", without {1e3 * self.sigma_without_rms_m:.3f}"
        if self.impacts_s:
            dropped = f"; felt impacts at {', '.join(f'{t:.2f}' for t in self.impacts_s[:_SAID])} s"
        dropped += "".join(f"; {each}" for each in self.losses)
        return (
            f"with {self.name} from {self.begin_s:.1f} s on: {moved}sigma {1e3 * self.sigma_rms_m:.3f} mm{without}; it "
            f"{found} with joints and vision: residuals {self.residual_over_sigma:.2f} of their sigma, {self.outliers} of "
            f"{self.windows} are outliers{dropped}"
        )


@dataclass(frozen=True)
class HeadingRow:
    """How the arm's heading agrees with a magnetometer's."""

    name: str  #: of the reference
    readings: int  #: that were compared, ``FIELDS_S`` apart or more
    begin_s: float  #: of the first, s
    heading_off_rad: float  #: rotation of the base about its z, or of joint 1's zero, since the calibration
    sigma_rad: float  #: of that, motors and calibration included
    agrees: bool | None  #: whether it is below ``AGREES`` sigma; None: its sigma is large, or its value stood still
    disturbance_t: float  #: median field of motors and iron, T, as far as it shows
    losses: tuple[str, ...]  #: what was lost of it; empty where nothing was

    @property
    def line(self) -> str:
        """It as a line for people."""
        disagrees = "disagrees: was the base rotated, or is a magnet near?"
        found = "says nothing" if self.agrees is None else "agrees" if self.agrees else disagrees
        return (
            f"heading by {self.name} since {self.begin_s:.1f} s: off by {np.degrees(self.heading_off_rad):.2f} deg, sigma "
            f"{np.degrees(self.sigma_rad):.2f}, motors disturb it by {1e6 * self.disturbance_t:.2g} uT; it {found}"
        ) + "".join(f"; {each}" for each in self.losses)


class Fused:
    """A unit in an estimator.

    Attributes:
        windows: used so far, outliers included.
        outliers: of them.
        impacts: times of those, s: what was felt within the 40 ms before, the joints do not explain; together within
            ``APART_S`` they are one.
        begin_s: time of the first window, s.
        rejected_s: when images contradicted it so that it was used no more, s; None where they did not.
    """

    honest = HONEST

    def __init__(
        self,
        entry: Entry,
        source: ReadingsSource = lambda end_s: (np.empty(0), np.empty((0, 6))),
        losses: Counter[str] | None = None,
    ) -> None:
        self.entry, self._source, self._losses = entry, source, Counter[str]() if losses is None else losses
        kind = INERTIAL_CLASSES[entry.sensor_class]
        self._density = np.repeat([kind.gyro_noise, kind.noise], 3)
        self._squares, self.windows, self.outliers = 0.0, 0, 0
        self.impacts, self._compared = list[float](), list[tuple[Reading, Array]]()
        self.begin_s = np.inf
        self.rejected_s: float | None = None
        self._impact_s, self._off = -np.inf, list[str]()
        self._apart_s = self._newest_s = np.nan  # the newest reading, and how long it came after the one before, s

    def poll(self, estimator: Estimator, end_s: float) -> Samples | None:
        """Give an estimator what came up to a time, s, as the unit stamps it; return that, None for nothing."""
        return self.give(estimator, *self._source(end_s))

    def give(self, estimator: Estimator, t_s: Array, z: Array) -> Samples | None:
        """Give an estimator readings (N, 6) of times (N,), s; return them, None without any."""
        if not len(t_s):
            return None
        # Whole nanoseconds, as recordings hold them: so a run is replayed to the last digit.
        samples = Samples(np.round(1e9 * t_s) / 1e9, z, self._density)
        self._apart_s, self._newest_s = float(t_s[-1] - (t_s[-2] if len(t_s) > 1 else self._newest_s)), float(t_s[-1])
        if self.entry.calibrated and isinstance(estimator, KalmanEstimator):
            self._take(estimator, samples)
        return samples

    def _take(self, estimator: KalmanEstimator, samples: Samples) -> None:
        estimator.on_reading = self._heard
        outcome = estimator.take(self.entry.reference, samples)
        if outcome is Outcome.OUTLIER and self.rejected_s is None:
            self.rejected_s = self._newest_s
            self._losses[f"it was dropped at {self.rejected_s:.1f} s: images contradict it"] += 1
        for name, off in estimator.unit_differs().items():
            if off > OFF and name not in self._off:
                self._off.append(name)
                self._losses[f"its {name} is more than {OFF:g} sigma off: calibrate it again"] += 1

    @property
    def losses(self) -> tuple[str, ...]:
        """What was lost of it, each kind once."""
        found = self._losses.copy()  # at once, as a thread may add to it
        return tuple(what if count == 1 else f"{what} ({count} times)" for what, count in found.items())

    def _heard(self, name: str, innovation: Innovation) -> None:
        """Take a window's residual."""
        z, self.begin_s = innovation.z, min(self.begin_s, innovation.t_s)
        self.windows += 1
        self.outliers += innovation.outcome is Outcome.OUTLIER
        if innovation.outcome is Outcome.OUTLIER:
            if innovation.t_s > self._impact_s + APART_S and isinstance(self.entry.reference, Inertial):
                self.impacts.append(innovation.t_s)
            self._impact_s = innovation.t_s
        else:
            self._squares += float(squares_of(z, innovation.cov)) / len(z)

    def row(self, covs: Array, before: tuple[float, float] | None = None) -> FusedRow | HeadingRow:
        """Return what it did to estimates with covariances (N, 6, 6) since the first window.

        ``before``: how far these are from others without it, and the sigma of those, RMS, m.

        Raises:
            InputError: it was never used; the message says why.
        """
        if not self.windows or not len(covs):
            raise InputError("; ".join((f"{self.entry.where}: {self._unused()}", *self.losses)))
        ratio = float(np.sqrt(self._squares / max(self.windows - self.outliers, 1)))
        agrees = self.outliers < OUTLIERS * self.windows and ratio < self.honest
        agrees = agrees and self.rejected_s is None and not self._off
        sigma = float(np.sqrt(np.einsum("nii->ni", covs)[:, :3].sum(axis=1).mean()))
        moved, without = (None, None) if before is None else before
        said = self.windows, self.outliers, self.begin_s, ratio, agrees, self.rejected_s
        return FusedRow(self.entry.reference.name, *said, moved, sigma, without, tuple(self.impacts), self.losses)

    def _unused(self) -> str:
        """Return why no window was used."""
        if not self.entry.calibrated:
            return "was recorded alone: armsight references calibrate finds its parameters"
        if np.isnan(self._newest_s):
            return "no reading is of the run's times; do both have one clock?"
        if not isinstance(self.entry.reference, Inertial):
            return f"{self.windows} of its readings could be compared; two that differ are needed"
        if self._apart_s > GAP_S:
            return (
                f"samples are {1e3 * self._apart_s:.0f} ms apart, at most {1e3 * GAP_S:.0f} are integrated over; record "
                "faster"
            )
        return "the run ended before its mounting and the camera's delay were known; a unit is used from then on"


class Witness(Fused):
    """A magnetometer: it is compared with the estimates and changes none, as motors disturb it for seconds.

    A reading is left out where it is no field in T, or where its value first came before the tool was rotated, or is known.
    """

    _looked_s, _since_s, _stuck, _value = -np.inf, -np.inf, False, np.empty(0)

    def _take(self, estimator: KalmanEstimator, samples: Samples) -> None:
        sensor, (begin, end) = self.entry.reference, estimator.span_s
        for t, z in zip(samples.t_s.tolist(), samples.z, strict=True):
            if not np.array_equal(z, self._value):
                self._value, self._since_s = z, t
            at = t - sensor.delay_s
            if not begin <= at <= end or t - self._looked_s < FIELDS_S:
                continue
            self._looked_s = t
            if not np.linalg.norm(z) < MOST_T:
                self._losses[f"a field above {1e3 * MOST_T:g} mT was left out: give T, not uT, mG or gauss"] += 1
                continue
            was, T = estimator.track(np.array([max(self._since_s - sensor.delay_s, begin), at])).Ts_base_tool
            if known := bool(self._compared) and self._compared[-1][0].t_s >= self._since_s:
                was = self._compared[-1][1]
            first, now = (sensor.expected(ToolMotion(each), 0).z for each in (was, T))
            self._stuck = bool(np.linalg.norm(now - first) > LEAST_T)
            if self._stuck:
                self._losses["its value stood still while the tool was rotated"] += 1
            if self._stuck or known:
                continue
            self._compared.append((Reading(t, 0, z, NOISE_T**2 * np.eye(3)), T))
            self.begin_s, self.windows = min(self.begin_s, at), self.windows + 1

    def row(self, covs: Array, before: tuple[float, float] | None = None) -> FusedRow | HeadingRow:
        """Return how the heading of the arm agrees with that of the field; ``before`` does not matter."""
        sensor = self.entry.reference
        if self.windows < 2 or not isinstance(sensor, Magnetometer):
            return super().row(covs[:0])
        poses = {each.t_s - sensor.delay_s: T for each, T in self._compared}
        off = heading_off(sensor, [each for each, _ in self._compared], lambda t: ToolMotion(poses[t]))
        agrees = abs(off.angle_rad) < AGREES * off.sigma_rad
        says = not self._stuck and (off.sigma_rad < SAYS_RAD or not agrees)
        disturbed = float(np.median(off.disturbance_t))
        said = off.angle_rad, off.sigma_rad, agrees if says else None, disturbed
        return HeadingRow(sensor.name, self.windows, self.begin_s, *said, self.losses)


class Ranged(Fused):
    """A range to an anchor: means over ``AVERAGED_S``, whose noise calibrate found, are fused.

    They are ``FIELDS_S`` apart, as errors of a drum and of a wire last. One that is longer than any range, or stands still
    while the tool moves away from where it came, is left out.
    """

    #: Residuals over their sigma below which it agrees; half: chance disagrees, double: a wire that hangs by a mm agrees.
    honest = 1.5
    _looked_s, _since_s, _value, _most, _near = np.inf, -np.inf, np.nan, 1, list[tuple[float, float]]()

    def _take(self, estimator: KalmanEstimator, samples: Samples) -> None:
        estimator.on_reading = self._heard
        sensor, noise_m = self.entry.reference, self.entry.noise_m
        _, _, learns_delay = estimator.settings  # as with units: a range would shift it
        # Single precision, as the message of ROS has it: so a run is replayed to the last digit.
        for t, z in zip(samples.t_s.tolist(), samples.z[:, 0].astype(np.float32).tolist(), strict=True):
            if not abs(z) < MOST_M:
                seen = f"a range above {MOST_M:g} m was left out: give m, not mm"
                self._losses[seen if math.isfinite(z) else "nothing was seen: its range is inf or NaN"] += 1
                continue
            if z != self._value:
                self._value, self._since_s = z, t
            self._near = [each for each in self._near if t - each[0] < AVERAGED_S] + [(t, z)]
            self._most, self._looked_s = max(self._most, len(self._near)), min(self._looked_s, t)
            if t - self._looked_s < FIELDS_S or learns_delay:
                continue
            self._looked_s = t
            at = np.clip(np.array([self._since_s, t]) - sensor.delay_s, *estimator.span_s)
            first, now = (sensor.expected(ToolMotion(T), 0).z for T in estimator.track(at).Ts_base_tool)
            if np.abs(now - first) > max(STILL * noise_m, LEAST_M):
                self._losses["its value stood still while the tool moved"] += 1
                continue
            (t, z), fewer = np.mean(self._near, axis=0), self._most / len(self._near)
            estimator.take(sensor, Reading(float(t), 0, np.array([z]), noise_m**2 * fewer * np.eye(1)))


def fused(entry: Entry, source: ReadingsSource | None = None, losses: Counter[str] | None = None) -> Fused:
    """Return what takes a reference's readings into a run."""
    kind = {Inertial: Fused, Magnetometer: Witness, Distance: Ranged}[type(entry.reference)]
    return kind(entry, losses=losses) if source is None else kind(entry, source, losses)


def recorded(entry: Entry) -> Fused:
    """Return a reference whose readings are those of its recording.

    Raises:
        InputError: it is not calibrated, or its recording cannot be read.
    """
    if not entry.calibrated or entry.source is None:
        lacks = "source" if entry.calibrated else "parameters"
        raise InputError(f"{entry.where}: has no {lacks}; armsight references calibrate writes a file that has them")
    t_s, z = read_recording(entry.source, type(entry.reference))
    at = 0

    def source(end_s: float) -> tuple[Array, Array]:
        nonlocal at
        end = int(np.searchsorted(t_s, end_s, side="right"))
        first, at = max(at, end - MOST), end
        return t_s[first:end], z[first:end]

    return fused(entry, source)


def the_one(entries: list[Entry]) -> Entry:
    """Return the one reference of a run.

    Raises:
        InputError: there are several.
    """
    first, *others = entries
    if others:
        raise InputError(f"{others[0].where}: a run takes one reference; leave one table in the file")
    return first
