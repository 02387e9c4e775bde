"""How cameras and marker body are mounted: converts measured poses of the body into pose measurements of the tool."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from armsight.data import Array, PoseEstimate, Record
from armsight.errors import InputError
from armsight.geometry.check import checked
from armsight.geometry.pose import adjoint, inverse
from armsight.loop.estimators.estimator import PoseMeasurement
from armsight.loop.handeye.handeye import HandEye
from armsight.robot.arm import Arm


@dataclass(frozen=True, eq=False)
class Mounting(Record):
    """A rig that stands still and a body that the tool carries.

    Attributes:
        T_base_rig: (4, 4) the rig in the base, m.
        T_tool_body: (4, 4) the body at the tool, m.
        cov: (12, 12) covariance of the right tangents of the two, in this order.
    """

    T_base_rig: Array
    T_tool_body: Array
    cov: Array

    @staticmethod
    def of(handeye: HandEye, arm: Arm) -> Mounting:
        """Return what a hand-eye calibration (eye to hand) of an arm found."""
        return Mounting(handeye.T_base_rig, inverse(arm.T_flange_tool) @ handeye.T_flange_body, handeye.cov)

    @cached_property
    def _to_tool(self) -> Array:
        return adjoint(self.T_tool_body)

    @cached_property
    def _T_body_tool(self) -> Array:
        return inverse(self.T_tool_body)

    def body(self, T_base_tool: Array) -> Array:
        """Return T_left_body (4, 4) with the tool at a pose (4, 4), m."""
        return np.asarray(inverse(self.T_base_rig) @ T_base_tool @ self.T_tool_body)

    def pose_measurement(self, pose: PoseEstimate, t_s: float) -> PoseMeasurement:
        """Carry what vision measured over to the tool.

        T_base_tool = T_base_rig T_rig_body T_tool_body^-1; with right tangents z of the first, b of the second and x of
        T_tool_body its own is Ad(T_tool_body) (Ad(T_rig_body^-1) z + b - x).

        Args:
            pose: where the body is in the rig.
            t_s: the middle of the exposure as the camera stamps it, s.

        Raises:
            InputError: ``t_s`` is no number.
        """
        if not np.isfinite(t_s):
            raise InputError(f"t_s is {t_s}; a measurement needs the time of its exposure, s")
        T_rig_body, to_tool = checked(pose.T_left_body, (4, 4), "T_left_body"), self._to_tool
        common = _positive(pose.cov - pose.cov_noise)
        if self.cov.any():
            by_mounting = np.concatenate([adjoint(inverse(T_rig_body)), -np.eye(6)], axis=1)
            common = by_mounting @ self.cov @ by_mounting.T + common
        return PoseMeasurement(
            t_s,
            self.T_base_rig @ T_rig_body @ self._T_body_tool,
            to_tool @ pose.cov_noise @ to_tool.T,
            to_tool @ common @ to_tool.T,
        )


def _positive(cov: Array) -> Array:
    """Return a covariance (6, 6) without what rounding made negative."""
    try:
        np.linalg.cholesky(cov)
        return cov
    except np.linalg.LinAlgError:
        pass
    values, vectors = np.linalg.eigh((cov + cov.T) / 2)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)
