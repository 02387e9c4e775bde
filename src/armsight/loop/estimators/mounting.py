"""How cameras and marker body are mounted: converts measured poses of the body into pose measurements of the tool."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from armsight.data import Array, PoseEstimate, Record
from armsight.errors import InputError
from armsight.geometry.check import checked
from armsight.geometry.matrix import product
from armsight.geometry.pose import adjoint, inverse
from armsight.kernels import kernel
from armsight.loop.estimators.estimator import PoseMeasurement
from armsight.robot.kinematics.arm import Arm

if TYPE_CHECKING:
    from armsight.loop.handeye.handeye import HandEye


@dataclass(frozen=True, eq=False)
class Mounting(Record):
    """A rig that stands still and a body that the tool carries."""

    T_base_rig: Array  #: (4, 4) the rig in the base, m
    T_tool_body: Array  #: (4, 4) the body at the tool, m
    cov: Array  #: (12, 12) covariance of the right tangents of the two, in this order

    @staticmethod
    def of(handeye: HandEye, arm: Arm) -> Mounting:
        """Return what a hand-eye calibration (eye to hand) of an arm found."""
        return Mounting(handeye.T_base_rig, inverse(arm.T_flange_tool) @ handeye.T_flange_body, handeye.cov)

    @cached_property
    def _parts(self) -> tuple[Array, Array, Array, Array]:
        """T_base_rig, T_body_tool, the adjoint of T_tool_body and the covariance, as :func:`_carry` takes them."""
        parts = self.T_base_rig, inverse(self.T_tool_body), adjoint(self.T_tool_body), self.cov
        a, b, c, d = (np.ascontiguousarray(part, float) for part in parts)
        return a, b, c, d

    def body(self, T_base_tool: Array) -> Array:
        """Return T_left_body (4, 4) with the tool at a pose (4, 4), m."""
        return np.asarray(inverse(self.T_base_rig) @ T_base_tool @ self.T_tool_body)

    def pose_measurement(self, pose: PoseEstimate, t_s: float) -> PoseMeasurement:
        """Carry what vision measured over to the tool.

        T_base_tool = T_base_rig T_rig_body T_tool_body^-1; with right tangents z of the first, b of the second and x of
        T_tool_body its own is Ad(T_tool_body) (Ad(T_rig_body^-1) z + b - x).

        ``pose``: where the body is in the rig. ``t_s``: the middle of the exposure as the camera stamps it, s.

        Raises:
            InputError: ``t_s`` is no number.
        """
        if not math.isfinite(t_s):
            raise InputError(f"t_s is {t_s}; a measurement needs the time of its exposure, s")
        T_rig_body = np.ascontiguousarray(checked(pose.T_left_body, (4, 4), "T_left_body"))
        common = np.subtract(pose.cov, pose.cov_noise, order="C")
        if not _is_positive(common):
            values, vectors = np.linalg.eigh((common + common.T) / 2)  # without what rounding made negative
            common = np.ascontiguousarray((vectors * np.maximum(values, 0.0)) @ vectors.T)
        T, noise, shared = np.empty((4, 4)), np.empty((6, 6)), np.empty((6, 6))
        _carry(T_rig_body, np.ascontiguousarray(pose.cov_noise), common, *self._parts, T, noise, shared)
        return PoseMeasurement(t_s, T, noise, shared)


@kernel("f8[:, ::1]")
def _is_positive(C: Array) -> bool:
    """Return whether a covariance (6, 6) is positive definite: whether it has Cholesky's factor."""
    L = np.zeros((6, 6))
    for i in range(6):
        for j in range(i + 1):
            rest = C[i, j]
            for k in range(j):
                rest -= L[i, k] * L[j, k]
            if i == j and not rest > 0.0:
                return False
            L[i, j] = math.sqrt(rest) if i == j else rest / L[j, j]
    return True


@kernel(
    "const f8[:, ::1], const f8[:, ::1], f8[:, ::1], const f8[:, ::1], const f8[:, ::1], const f8[:, ::1], "
    "const f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1]"
)
def _carry(
    T_rig_body: Array, cov_noise: Array, common: Array, T_base_rig: Array, T_body_tool: Array, to_tool: Array,
    cov: Array, T: Array, noise: Array, shared: Array,
) -> None:  # fmt: skip
    """Write what :meth:`Mounting.pose_measurement` computes to T, noise and shared; the covariance common is used up."""
    by_mounting = np.zeros((6, 12))  # [Ad(T_rig_body^-1), -I]
    for i in range(3):
        for j in range(3):
            by_mounting[i, j] = by_mounting[3 + i, 3 + j] = T_rig_body[j, i]
            # t x row j of the identity, in the axes of the body
            k, m = (j + 1) % 3, (j + 2) % 3
            by_mounting[i, 3 + j] = T_rig_body[k, i] * -T_rig_body[m, 3] + T_rig_body[m, i] * T_rig_body[k, 3]
    for i in range(6):
        by_mounting[i, 6 + i] = -1.0
    common += product(product(by_mounting, cov), by_mounting.T)
    T[:] = product(product(T_base_rig, T_rig_body), T_body_tool)
    noise[:] = product(product(to_tool, cov_noise), to_tool.T)
    shared[:] = product(product(to_tool, common), to_tool.T)
