"""Estimators: the pose of the tool at 1 kHz, from potentiometers and vision.

``estimator`` is the contract of the family; its members are ``kalman`` (fuses both) and ``latest`` (vision alone). The
Kalman filter's model is in ``armerror`` (what makes potentiometers wrong, as one vector) and ``errormodel`` (how motion
changes it); ``readings`` and ``parabola`` smooth the potentiometers, ``backlash_dynamics`` follows links inside their
backlash, and ``smoothing`` computes a track in retrospect. Equations: docs/concepts/loop.md.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from armsight.loop.estimators.armerror import Prior
    from armsight.loop.estimators.estimator import (
        ArmEstimate,
        Delay,
        Estimator,
        Innovation,
        Learned,
        Outcome,
        PoseMeasurement,
        Track,
    )
    from armsight.loop.estimators.kalman import KalmanEstimator, Remembered
    from armsight.loop.estimators.latest import LatestEstimator
    from armsight.loop.estimators.mounting import Mounting

__all__ = [
    "ArmEstimate",
    "Delay",
    "Estimator",
    "Innovation",
    "KalmanEstimator",
    "LatestEstimator",
    "Learned",
    "Mounting",
    "Outcome",
    "PoseMeasurement",
    "Prior",
    "Remembered",
    "Track",
]
#: Name -> its module, where that is not ``estimator``; each is imported on first use: who measures images has no filter.
_HOME = {
    "Prior": "armerror",
    "KalmanEstimator": "kalman",
    "Remembered": "kalman",
    "LatestEstimator": "latest",
    "Mounting": "mounting",
}


def __getattr__(name: str) -> Any:  # noqa: ANN401 - a module's names are of any type
    """Import a name on its first use (PEP 562)."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME.get(name, 'estimator')}"), name)
