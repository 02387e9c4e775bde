"""A recorded inertial unit given to an estimator, and whether it agrees with joints and vision.

In: an entry of ``references.toml`` with a recording, and the times up to which an estimator has come. Out: its samples in
the estimator, and how large the residuals of its windows are beside what the filter expects.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from armsight.errors import InputError
from armsight.loop.estimators import Innovation, KalmanEstimator, Outcome
from armsight.loop.references.file import Entry, read_recording, read_references
from armsight.loop.references.inertial import INERTIAL_CLASSES
from armsight.loop.references.strapdown import Samples

#: Residuals over their sigma up to which a unit agrees, and the share of outliers; half: chance is a fault, double: a mount
#: rotated by a degree agrees.
HONEST, OUTLIERS = 1.5, 0.01
#: Samples that are given at once at most: older ones are of before the estimator began.
MOST = 1000


class Fused:
    """A recorded unit in an estimator.

    Args:
        entry: calibrated, with its recording.

    Attributes:
        windows: used so far, outliers included.
        outliers: of them.
        begin_s: time of the first window, s.

    Raises:
        InputError: it is not calibrated, or its recording cannot be read.
    """

    def __init__(self, entry: Entry) -> None:
        self.sensor, name = entry.reference, entry.reference.name
        if not entry.calibrated or entry.source is None:
            lacks = "source" if entry.calibrated else "parameters"
            raise InputError(f"[{name}]: has no {lacks}; armsight references calibrate writes a file that has them")
        self._t_s, self._z = read_recording(entry.source)
        kind = INERTIAL_CLASSES[entry.sensor_class]
        self._density = np.repeat([kind.gyro_noise, kind.noise], 3)
        self._next, self._squares = 0, 0.0
        self.windows = self.outliers = 0
        self.begin_s = np.inf

    @staticmethod
    def of(path: Path) -> Fused:
        """Return the one of a file.

        Raises:
            InputError: the file has several.
        """
        first, *others = read_references(path)
        if others:
            raise InputError(
                f"{path}: [{others[0].reference.name}]: one inertial unit is fused; leave one table in the file"
            )
        return Fused(first)

    def give(self, estimator: KalmanEstimator, end_s: float) -> None:
        """Give an estimator the samples up to a time, s, as the unit stamps them."""
        end = int(np.searchsorted(self._t_s, end_s, side="right"))
        first, self._next = max(self._next, end - MOST), end
        if end > first:
            estimator.on_reading = self._heard
            estimator.take(self.sensor, Samples(self._t_s[first:end], self._z[first:end], self._density))

    def _heard(self, name: str, innovation: Innovation) -> None:
        """Take a window's residual."""
        z, self.begin_s = innovation.z, min(self.begin_s, innovation.t_s)
        self.windows += 1
        self.outliers += innovation.outcome is Outcome.OUTLIER
        if innovation.outcome is not Outcome.OUTLIER:
            self._squares += float(z @ np.linalg.solve(innovation.cov, z)) / len(z)

    @property
    def ratio(self) -> float:
        """Root mean square of the residuals that were used, over their sigma; 1 is right."""
        return float(np.sqrt(self._squares / max(self.windows - self.outliers, 1)))

    @property
    def agrees(self) -> bool:
        """Whether the residuals are as small as the filter expects."""
        return self.windows > 0 and self.ratio < HONEST and self.outliers < OUTLIERS * self.windows
