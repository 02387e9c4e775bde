"""What cameras that do not expose at the same instant add to the covariance of a moving body's pose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from armsight.data import Array, PoseEstimate
from armsight.vision.rig import StereoRig

#: Two poses further apart than this, s, tell no speed.
APART_S = 0.5


class Skew:
    """Widens poses of a body by how fast it moves.

    Between the exposures it moves v dt along the baseline, which is taken for disparity: the depth is off by Z / B v dt
    along the line of sight.

    Args:
        rig: the calibrated pair.
        sync_s: standard deviation of the time between the two exposures of a shot, s.
    """

    def __init__(self, rig: StereoRig, sync_s: float) -> None:
        self._rig, self._sync_s = rig, sync_s
        self._last: tuple[float, Array] | None = None

    def widened(self, pose: PoseEstimate, t_s: float) -> PoseEstimate:
        """Return a pose with its covariance widened; poses come in order of time."""
        p = pose.T_left_body[:3, 3]
        last, self._last = self._last, (t_s, p)
        if last is None or not 0.0 < t_s - last[0] < APART_S:
            return pose
        baseline = self._rig.T_left_right[:3, 3]
        along = float((p - last[1]) @ baseline) / (t_s - last[0]) / float(np.linalg.norm(baseline))
        off = pose.T_left_body[:3, :3].T @ p * (self._sync_s * along / np.linalg.norm(baseline))
        extra = np.zeros((6, 6))
        extra[:3, :3] = np.outer(off, off)
        return replace(pose, cov=pose.cov + extra, cov_noise=pose.cov_noise + extra)
