"""The health monitor: every measured pose goes through it, and it says at the end what no longer holds."""

from __future__ import annotations

from dataclasses import replace

from armsight.data import Body, PoseEstimate
from armsight.loop.estimators import KalmanEstimator, PoseMeasurement
from armsight.loop.estimators.armerror import layout
from armsight.loop.health.fixed import BaseMotion, FixedWatch
from armsight.loop.health.record import HealthFinding
from armsight.loop.health.rig import RigWatch
from armsight.robot.arm import Arm
from armsight.vision.rig import StereoRig


class HealthMonitor:
    """Watches a measurement.

    Args:
        rig: the calibrated pair; the pose of its cameras cannot be tested if it has no covariance.
        body: the body that is measured.
        sync_s: standard deviation of the time between the two exposures of a shot, s.
    """

    def __init__(self, rig: StereoRig, body: Body, sync_s: float) -> None:
        self._rig = RigWatch(rig, body, sync_s) if rig.cov.any() else None
        self._fixed: FixedWatch | None = None

    def measured(self, pose: PoseEstimate, t_s: float | None) -> PoseEstimate:
        """Take a measured pose, in order of time; return it with what is suspected added to its covariance.

        Args:
            pose: as it was measured.
            t_s: time of its shot, s; None where it has none.
        """
        if self._rig is None:
            return pose
        suspected = self._rig.take(pose, t_s)
        return replace(pose, cov=pose.cov + suspected) if suspected.any() else pose

    def follow(self, estimator: KalmanEstimator, arm: Arm) -> None:
        """Watch from now on whether the rig stands still in the base of an arm, by what an estimator makes of the poses."""
        self._fixed = FixedWatch(arm.T_base_0, layout(arm.joints).size)
        estimator.on_innovation = self._fixed.take

    @property
    def moved(self) -> BaseMotion | None:
        """The motion of the rig against the base that was found; None where none was."""
        return None if self._fixed is None else self._fixed.moved

    def widened(self, measurement: PoseMeasurement) -> PoseMeasurement:
        """Return a pose measurement of the tool with a motion of the rig against the base in its common covariance."""
        moved = self.moved
        if moved is None or measurement.t_s < moved.begin_s:
            return measurement
        return replace(measurement, cov_common=measurement.cov_common + moved.suspected)

    def findings(self) -> tuple[HealthFinding, ...]:
        """Return what was found so far; nothing while all is well."""
        watches = (self._rig, self._fixed)
        return tuple(found for watch in watches if watch is not None for found in watch.findings())
