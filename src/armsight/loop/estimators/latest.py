"""The newest pose measured by vision as it is: no filter, no joints in between, as a loop on vision alone would have it."""

from __future__ import annotations

import numpy as np

from armsight.data import Array, JointStates
from armsight.geometry.pose import inverse
from armsight.loop.estimators.armerror import Prior
from armsight.loop.estimators.estimator import ArmEstimate, Delay, Outcome, PoseMeasurement, Track
from armsight.loop.estimators.kalman import KalmanEstimator
from armsight.robot.kinematics.arm import Arm


class LatestEstimator:
    """Holds the newest measurement until the next; potentiometers alone before the first."""

    def __init__(self, arm: Arm, *, prior: Prior | None = None, delay: Delay) -> None:
        self._arm, self._delay = arm, delay
        self._alone = KalmanEstimator(arm, prior=prior, delay=delay)  # never sees anything: potentiometers alone
        self._newest: PoseMeasurement | None = None
        self._offset = np.eye(4)

    def joints(self, states: JointStates) -> None:
        """Take readings of the potentiometers, in order of time."""
        self._alone.joints(states)

    def vision(self, pose_measurement: PoseMeasurement) -> Outcome:
        """Take a pose measurement; one older than the newest is not used."""
        if self._newest is not None and pose_measurement.t_s <= self._newest.t_s:
            return Outcome.TOO_LATE
        seen_s = float(np.clip(pose_measurement.t_s - self._delay.delay_s, *self._alone.span_s))
        at = self._alone.estimate(seen_s)
        self._newest = pose_measurement
        self._offset = inverse(self._arm.forward(at.q)) @ pose_measurement.T_base_tool
        return Outcome.USED

    def estimate(self, t_s: float | None = None) -> ArmEstimate:
        """Return the newest measurement, whatever has moved since."""
        return self.track(np.array([self._alone.span_s[1] if t_s is None else t_s]))[0]

    def track(self, t_s: Array) -> Track:
        """Return the newest measurement at (N,) times."""
        alone = self._alone.track(t_s)
        if self._newest is None:
            return alone
        many, own = (len(t_s), 1, 1), self._newest.cov_noise
        age = t_s - (self._newest.t_s - self._delay.delay_s)
        Ts, covs, covs_own = (
            np.tile(part, many) for part in (self._newest.T_base_tool, own + self._newest.cov_common, own)
        )
        return Track(alone.t_s, Ts, covs, covs_own, alone.q, alone.qd, age)

    def tool(self, q: Array, qd: Array, *, pressed: bool = False) -> Array:
        """Return T_base_tool if the potentiometers read q (N, 6): the table's, moved as the newest measurement was."""
        return np.asarray(self._arm.forward(q) @ self._offset)
