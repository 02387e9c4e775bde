"""The contract of an estimator: potentiometer readings and pose measurements go in, the tool's pose comes out.

A member of this family takes the joints' readings as they come and vision's pose measurements, which may be late and out of
order, and returns an estimate for any time within the last second or two. To write a new one: a class with the five
methods of :class:`Estimator`; :class:`~armsight.loop.estimators.readings.Readings` keeps and smooths the joints for
you; add it to the registry in ``__init__``. All times are on one clock, the board's (``JointStates.t_s``). Poses are
``T_base_tool``, covariances of their right tangent [translation m; rotation rad].
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Any, NamedTuple, Protocol

import numpy as np

from armsight.data import Array, JointStates, Record


@dataclass(frozen=True, eq=False)
class PoseMeasurement(Record):
    """A pose of the tool measured by vision."""

    t_s: float  #: the middle of the exposure as the camera stamps it, s; the camera's delay is still in it
    T_base_tool: Array  #: (4, 4) pose of the tool, m
    cov_noise: Array  #: (6, 6) covariance from what differs from shot to shot: pixel noise
    cov_common: Array  #: (6, 6) covariance from what all shots share: the rig's calibration and the hand-eye's

    def __post_init__(self) -> None:
        """Lay the arrays out row by row, as kernels take them."""
        fields = self.__dict__
        for name in ("T_base_tool", "cov_noise", "cov_common"):
            fields[name] = np.ascontiguousarray(fields[name], np.float64)
        super().__post_init__()


class ClockEffect(NamedTuple):
    """What an error of the camera's clock did to an innovation, as far as it is known."""

    offset_s: float  #: by how much the stamp was later than the filter took it to be, s
    in_z: Array  #: (6,) what that made of the innovation, [m; rad]; the filter has adapted to it in part
    change: Array | None  #: (K,) what was added to the filter's state as stamps were corrected; None where they are not
    sigma_s: float  #: standard deviation of the offset, s


class Outcome(Enum):
    """The outcome of a pose measurement given to an estimator."""

    USED = "used"
    WAITING = "waiting: newer than the newest potentiometer reading, used when that comes"
    OUTLIER = "outlier: too far from where the arm can be"
    REOPENED = "used: several agree against what was learned, so its uncertainty was reset"
    TOO_LATE = "too late: older than what is kept"


@dataclass(frozen=True, eq=False)
class Innovation(Record):
    """What a filter did with a pose measurement: what a monitor of its consistency needs.

    Of a reading of a reference beside vision (:meth:`KalmanEstimator.take`) z has its m numbers in place of 6, measured
    minus predicted, and ``T_base_tool`` is the predicted pose.
    """

    t_s: float  #: time of the measurement, s, the delay removed
    T_base_tool: Array  #: (4, 4) the measured pose of the tool, m
    z: Array  #: (6,) right tangent from the predicted pose of the tool to the measured one, [m; rad]
    cov: Array  #: (6, 6) covariance of z, what all measurements share included
    by_state: Array  #: (6, K) derivative of the prediction by the filter's state
    kept: Array  #: (K,) share of the state that was kept since the measurement before
    gain: Array  #: (K, 6) what of z was added to the state; zero where the measurement was rejected
    outcome: Outcome  #: what became of it
    clock: ClockEffect | None = None  #: what is known of an error of the camera's clock; None where nothing is
    #: returns (6,) as z, from the pose predicted by a state that stays, and its derivative (6, K), where they are asked
    #: for; None where none is kept (:meth:`KalmanEstimator.keep_reference`).
    reference: Callable[[], tuple[Array, Array]] | None = None
    #: (K,) variances that were added to the state since the measurement before; None where nobody needs them
    added: Array | None = None
    #: (6, 6) covariance of z without the state's and without what all measurements share; None likewise
    noise: Array | None = None
    #: (K,) what the arm's motion alone added; the filter, which learns, counts more. None where no reference is kept
    wandered: Array | None = None


@dataclass(frozen=True)
class Delay:
    """How late a camera's stamps are on the board's clock: the exposure was at ``t_s - delay_s``."""

    delay_s: float  #: the delay, s
    sigma_s: float  #: its standard deviation, common to all shots, s
    jitter_s: float = 0.0  #: standard deviation of each shot's own, s


@dataclass(frozen=True, eq=False)
class Track(Record):
    """Poses of the tool at N times."""

    t_s: Array  #: (N,) times, s
    Ts_base_tool: Array  #: (N, 4, 4) poses of the tool, m
    covs: Array  #: (N, 6, 6) their covariance, everything included
    covs_own: Array  #: (N, 6, 6) the same without what all measurements share (``PoseMeasurement.cov_common``).
    q: Array  #: (N, 6) potentiometers, smoothed, rad
    qd: Array  #: (N, 6) their speeds, rad/s
    vision_age_s: Array  #: (N,) time since the newest measurement used, s; infinite before the first

    def __len__(self) -> int:
        """Return N."""
        return len(self.t_s)

    def __getitem__(self, row: int) -> ArmEstimate:
        """Return one of them."""
        parts: list[Any] = [float(each[row]) if each.ndim == 1 else each[row] for each in vars(self).values()]
        return ArmEstimate(*parts)


@dataclass(frozen=True, eq=False)
class ArmEstimate(Record):
    """The pose of the tool at one time."""

    t_s: float  #: when, s
    T_base_tool: Array  #: (4, 4) pose of the tool, m
    cov: Array  #: (6, 6) its covariance, everything included
    cov_own: Array  #: (6, 6) the same without what all measurements share (``PoseMeasurement.cov_common``).
    q: Array  #: (6,) potentiometers, smoothed, rad
    qd: Array  #: (6,) their speeds, rad/s
    vision_age_s: float  #: time since the newest measurement used, s; infinite before the first


@dataclass(frozen=True, eq=False)
class Learned(Record):
    """What a filter has learned about an arm."""

    joint_offset: Array  #: (6,) true joint angles minus readings where the joints are now, rad
    sigma_joint_offset: Array  #: (6,) standard deviations; wide where two joints' errors look alike to vision
    backlash: Array  #: (6,) widths between potentiometer and link, rad
    sigma_backlash: Array  #: (6,) standard deviations
    side: Array  #: (6,) where each joint is in it, -1 to 1: 1 when it came up from below
    delay: Delay  #: how late the camera's stamps are


class Estimator(Protocol):
    """Estimates the pose of the tool from potentiometers and vision."""

    def joints(self, states: JointStates) -> None:
        """Take readings of the potentiometers, in order of time."""

    def vision(self, pose_measurement: PoseMeasurement) -> Outcome:
        """Take a pose measurement, in any order of time; return what became of it."""

    def estimate(self, t_s: float | None = None) -> ArmEstimate:
        """Return the pose of the tool at a time, by default that of the newest reading.

        Raises:
            InputError: no reading has come yet, or ``t_s`` is not within those kept.
        """

    def track(self, t_s: Array) -> Track:
        """Return the same at (N,) times: the fast way to an output at 1 kHz."""

    def tool(self, q: Array, qd: Array, *, pressed: bool = False) -> Array:
        """Return T_base_tool (N, 4, 4) if the potentiometers read q (N, 6) moving at qd (N, 6), by what is known now.

        With ``pressed``, joints that move have moved far enough for their gears to push also links that gravity does
        not load.
        """
