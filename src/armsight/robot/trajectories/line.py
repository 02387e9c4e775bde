"""A straight line of the tool in space, its orientation rotating evenly about one axis (slerp)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from armsight.data import Array, Record
from armsight.errors import InputError
from armsight.geometry.rotation import exp_so3
from armsight.robot.trajectories.cartesian import PathMotion, follow
from armsight.robot.trajectories.path import PathPoints, checked_pose, way

if TYPE_CHECKING:
    from armsight.robot.kinematics.arm import Arm


@dataclass(frozen=True, eq=False)
class LinePath(Record):
    """A straight line with an even rotation."""

    T_base_start: Array  #: (4, 4) where it starts
    step: Array  #: (3,) how far it goes, m, base axes
    rotation: Array  #: (3,) how far it rotates, rad, axes of the tool

    @staticmethod
    def between(T_base_start: Array, T_base_goal: Array) -> LinePath:
        """Return the line from one pose (4, 4) to another, or raise InputError: they are the same."""
        step, rotation, length = way(T_base_start, T_base_goal)
        if length == 0:
            raise InputError("T_base_goal is where the tool already is: there is nothing to travel")
        return LinePath(T_base_start, step, rotation)

    def at(self, share: Array) -> PathPoints:
        """Return the path at shares (N,)."""
        T = np.tile(self.T_base_start, (len(share), 1, 1))
        T[:, :3, 3] += share[:, None] * self.step
        T[:, :3, :3] = self.T_base_start[:3, :3] @ exp_so3(share[:, None] * self.rotation)
        twist = np.tile(np.concatenate([self.step, self.T_base_start[:3, :3] @ self.rotation]), (len(share), 1))
        return PathPoints(T, twist, np.zeros_like(twist))


def line(arm: Arm, q_start: ArrayLike, T_base_goal: ArrayLike, *, duration_s: float | None = None) -> PathMotion:
    """Plan a straight line of the tool from where it is.

    ``q_start``: (n,) angles to start from, rad; their configuration is kept. ``T_base_goal``: (4, 4) pose of the tool to
    end at. ``duration_s``: how long it is to take, s; None for as short as the limits allow. Raises MotionRejected: the
    line leaves the reach or the joint limits, or meets a singularity; InputError: bad numbers, nothing to travel, or a
    duration that cannot be met.
    """
    path = LinePath.between(arm.forward(q_start), checked_pose(T_base_goal, "T_base_goal"))
    return follow(arm, path, q_start, duration_s=duration_s)
