"""Where the tool is, from potentiometers and vision: estimators (estimator.py) and what they are given."""

from __future__ import annotations

from collections.abc import Callable

from armsight.loop.estimators.armerror import Prior
from armsight.loop.estimators.estimator import ArmEstimate, Delay, Estimator, Learned, PoseMeasurement, Track, Verdict
from armsight.loop.estimators.kalman import KalmanEstimator
from armsight.loop.estimators.latest import LatestEstimator
from armsight.loop.estimators.mounting import Mounting

__all__ = [
    "ESTIMATORS",
    "ArmEstimate",
    "Delay",
    "Estimator",
    "KalmanEstimator",
    "LatestEstimator",
    "Learned",
    "Mounting",
    "PoseMeasurement",
    "Prior",
    "Track",
    "Verdict",
]

#: Every estimator; each takes the arm, and by name ``prior`` and ``delay``.
ESTIMATORS: dict[str, Callable[..., Estimator]] = {"kalman": KalmanEstimator, "latest": LatestEstimator}
