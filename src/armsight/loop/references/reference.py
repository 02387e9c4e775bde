"""The contract of a reference beside vision: what a sensor would read, if the tool moved like this.

To write a new one: a frozen keyword-only dataclass derived from :class:`Reference` with what the sensor is (its mounting,
its scale), its channels, its parameters' names and values, :meth:`Reference.expected` and :meth:`Reference.moved`. The
filter chains the derivatives with its own (:meth:`~armsight.loop.estimators.kalman.KalmanEstimator.take`);
:func:`~armsight.loop.references.calibrate.calibrate` fits the parameters. The delay is common to all and no member's
business. All readings of a reference have the same count of numbers, m.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Self

import numpy as np

from armsight.data import Array, Record

_STILL, _EXACT = np.zeros(6), np.zeros((6, 6))
#: Acceleration of gravity, m/s2 (CGPM 1901), along -z of a level base; half, double: gravity is not found at rest.
STANDARD_GRAVITY_M_S2 = 9.80665


@dataclass(frozen=True, eq=False)
class Reading(Record):
    """One reading of a sensor."""

    t_s: float  #: when, s, as its clock stamps it; its delay is still in it
    channel: int  #: which of the reference's channels
    z: Array  #: (m,) what was read, SI units
    cov: Array  #: (m, m) covariance of its noise


class ToolMotion(NamedTuple):
    """Where the tool is and how it moves."""

    T_base_tool: Array  #: (4, 4) pose of the tool, m
    twist: Array = _STILL  #: (6,) [velocity of the tool's origin; angular velocity] in the tool's frame, [m/s; rad/s]
    acceleration: Array = _STILL  #: (6,) derivative of ``twist`` by time, [m/s2; rad/s2]
    cov: Array = _EXACT  #: (6, 6) covariance of the pose's right tangent [m; rad]; zero where it is exact


class ExpectedReading(NamedTuple):
    """What a sensor would read, and its derivatives."""

    z: Array  #: (m,) the reading
    by_tool: Array  #: (m, 6) by the right tangent of the tool's pose, [1/m; 1/rad]
    by_parameters: Array  #: (m, P) by the tangent of the reference's parameters
    by_twist: Array | None = None  #: (m, 6) by the tool's twist; None where it does not matter
    by_acceleration: Array | None = None  #: (m, 6) by its acceleration; None where it does not matter

    def rate(self, motion: ToolMotion) -> Array:
        """Return the derivative (m,) of the reading by time; the jerk is left out."""
        out = self.by_tool @ motion.twist
        return out if self.by_twist is None else np.asarray(out + self.by_twist @ motion.acceleration)


@dataclass(frozen=True, eq=False, kw_only=True)
class Reference(Record, ABC):
    """A sensor beside vision."""

    inertial: ClassVar[bool] = False  #: whether it feels the tool's acceleration; of the class
    name: str  #: what people call it
    cov: Array  #: (P, P) covariance of its parameters' tangent: before a calibration, how far each may be off
    delay_s: float = 0.0  #: how late its stamps are: the reading is of ``t_s - delay_s``
    sigma_delay_s: float = 0.0  #: standard deviation of that, s

    @property
    @abstractmethod
    def channels(self) -> tuple[str, ...]:
        """Names of its channels."""

    @property
    @abstractmethod
    def parameters(self) -> dict[str, float]:
        """Names (with units, as keys of JSON have them) and values of its P parameters, in the tangent's order."""

    @abstractmethod
    def expected(self, motion: ToolMotion, channel: int) -> ExpectedReading:
        """Return what a channel would read at a motion."""

    @abstractmethod
    def moved(self, step: Array) -> Self:
        """Return it with parameters moved by a tangent (P,)."""
