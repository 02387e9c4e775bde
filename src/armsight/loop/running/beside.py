"""A reference beside vision in a running loop: its readings go into the estimator, and whether it agrees is said.

In: a table of references.toml, and where its readings come from. Out: a :class:`FusedRow`. A reference that is not
calibrated yet gives its readings for the record alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from armsight.data import Array
from armsight.errors import InputError
from armsight.estimate.solve import squares_of
from armsight.loop.estimators.estimator import Estimator, Innovation, Outcome
from armsight.loop.estimators.kalman import KalmanEstimator
from armsight.loop.references.file import Entry, read_recording
from armsight.loop.references.inertial import INERTIAL_CLASSES
from armsight.loop.references.strapdown import GAP_S, Samples

#: Residuals over their sigma below which a unit agrees (as links count as loose, 1/3 is usual), and the share of outliers;
#: half: chance is a fault, double: a loose mount agrees.
HONEST, OUTLIERS = 1.0, 0.01
#: Samples that are given at once at most: older ones are of before the estimator began.
MOST = 1000
#: Returns times (N,), s, and readings (N, 6) up to a time, s, that were not returned before.
Source = Callable[[float], tuple[Array, Array]]


@dataclass(frozen=True)
class FusedRow:
    """What a reference beside vision did to the estimates of a run."""

    name: str  #: of the reference
    windows: int  #: of its readings that were used or rejected
    outliers: int  #: of them rejected
    begin_s: float  #: since when it was used, s: before, the camera's delay is learned
    residual_over_sigma: (
        float  #: root mean square; 1/3 is usual, as links count as loose; from ``HONEST`` on it disagrees
    )
    agrees: bool  #: whether it agrees with joints and vision
    rejected_s: float | None  #: when it was dropped as images contradict it, s; None where it was not
    moved_rms_m: float | None  #: distance of the estimates from those recorded before, m; None where there are none
    sigma_rms_m: float  #: of the position with it, root of the trace, m
    sigma_without_rms_m: float | None  #: and of those before, m

    @property
    def line(self) -> str:
        """It as a line for people."""
        found = "agrees" if self.agrees else "disagrees"
        moved = without = dropped = ""
        if self.moved_rms_m is not None and self.sigma_without_rms_m is not None:
            moved = f"the estimates move by {1e3 * self.moved_rms_m:.3f} mm RMS, "
            without = f", without {1e3 * self.sigma_without_rms_m:.3f}"
        if self.rejected_s is not None:
            dropped = f"; it was dropped at {self.rejected_s:.1f} s: images contradict it"
        return (
            f"with {self.name} from {self.begin_s:.1f} s on: {moved}sigma {1e3 * self.sigma_rms_m:.3f} mm{without}; it "
            f"{found} with joints and vision: residuals {self.residual_over_sigma:.2f} of their sigma, {self.outliers} of "
            f"{self.windows} windows are outliers{dropped}"
        )


class Fused:
    """A unit in an estimator.

    Args:
        entry: its table.
        source: where its readings come from.

    Attributes:
        entry: as given.
        windows: used so far, outliers included.
        outliers: of them.
        begin_s: time of the first window, s.
        rejected_s: when images contradicted it so that it was used no more, s; None where they did not.
    """

    def __init__(self, entry: Entry, source: Source = lambda end_s: (np.empty(0), np.empty((0, 6)))) -> None:
        self.entry, self._sensor, self._source = entry, entry.reference, source
        kind = INERTIAL_CLASSES[entry.sensor_class]
        self._density = np.repeat([kind.gyro_noise, kind.noise], 3)
        self._squares, self.windows, self.outliers = 0.0, 0, 0
        self.begin_s = np.inf
        self.rejected_s: float | None = None
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
            estimator.on_reading = self._heard
            outcome = estimator.take(self._sensor, samples)
            if outcome is Outcome.OUTLIER and self.rejected_s is None:
                self.rejected_s = float(t_s[-1])
        return samples

    def _heard(self, name: str, innovation: Innovation) -> None:
        """Take a window's residual."""
        z, self.begin_s = innovation.z, min(self.begin_s, innovation.t_s)
        self.windows += 1
        self.outliers += innovation.outcome is Outcome.OUTLIER
        if innovation.outcome is not Outcome.OUTLIER:
            self._squares += float(squares_of(z[None], innovation.cov[None])[0]) / len(z)

    def row(self, covs: Array, before: tuple[float, float] | None = None) -> FusedRow:
        """Return what it did to estimates with covariances (N, 6, 6) since the first window.

        ``before``: how far these are from others without it, and the sigma of those, RMS, m.

        Raises:
            InputError: it was never used; the message says why.
        """
        if not self.windows or not len(covs):
            raise InputError(f"[{self._sensor.name}]: {self._unused()}")
        ratio = float(np.sqrt(self._squares / max(self.windows - self.outliers, 1)))
        agrees = self.outliers < OUTLIERS * self.windows and self.rejected_s is None and ratio < HONEST
        sigma = float(np.sqrt(np.einsum("nii->ni", covs)[:, :3].sum(axis=1).mean()))
        moved, without = (None, None) if before is None else before
        said = self.windows, self.outliers, self.begin_s, ratio, agrees, self.rejected_s
        return FusedRow(self._sensor.name, *said, moved, sigma, without)

    def _unused(self) -> str:
        """Return why no window was used."""
        if not self.entry.calibrated:
            return "was recorded alone: armsight references calibrate finds its parameters"
        if np.isnan(self._newest_s):
            return "no reading is of the run's times; do both have one clock?"
        if self._apart_s > GAP_S:
            return (
                f"samples are {1e3 * self._apart_s:.0f} ms apart, at most {1e3 * GAP_S:.0f} are integrated over; record "
                "faster"
            )
        return "the run ended before its mounting and the camera's delay were known; a unit is used from then on"


def recorded(entry: Entry) -> Fused:
    """Return a unit whose readings are those of its recording.

    Raises:
        InputError: it is not calibrated, or its recording cannot be read.
    """
    if not entry.calibrated or entry.source is None:
        lacks = "source" if entry.calibrated else "parameters"
        raise InputError(
            f"[{entry.reference.name}]: has no {lacks}; armsight references calibrate writes a file that has them"
        )
    t_s, z = read_recording(entry.source)
    at = 0

    def source(end_s: float) -> tuple[Array, Array]:
        nonlocal at
        end = int(np.searchsorted(t_s, end_s, side="right"))
        first, at = max(at, end - MOST), end
        return t_s[first:end], z[first:end]

    return Fused(entry, source)


def the_one(entries: list[Entry], where: object) -> Entry:
    """Return the one reference that is fused.

    Raises:
        InputError: there are several.
    """
    first, *others = entries
    if others:
        raise InputError(
            f"{where}: [{others[0].reference.name}]: one inertial unit is fused; leave one table in the file"
        )
    return first
