"""The health monitor: every measured pose goes through it, and it says at the end what no longer holds."""

from __future__ import annotations

from dataclasses import replace

from armsight.data import Body, PoseEstimate
from armsight.loop.health.record import HealthFinding
from armsight.loop.health.rig import RigWatch
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

    def findings(self) -> tuple[HealthFinding, ...]:
        """Return what was found so far; nothing while all is well."""
        return () if self._rig is None else self._rig.findings()
