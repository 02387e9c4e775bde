"""Circles and arcs of the tool in space, its orientation rotating evenly about one axis."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from armsight.data import Array, Record
from armsight.errors import InputError
from armsight.geometry.check import checked
from armsight.geometry.rotation import exp_so3, log_so3
from armsight.robot.trajectories.cartesian import PathMotion, follow
from armsight.robot.trajectories.path import PathPoints, checked_pose

if TYPE_CHECKING:
    from armsight.robot.kinematics.arm import Arm

TOO_SMALL = 1e-6  # a radius, m, or the sine of an angle below which three points say nothing about a circle


@dataclass(frozen=True, eq=False)
class ArcPath(Record):
    """A rotation of the tool's position about an axis in space, with an even rotation of its orientation."""

    T_base_start: Array  #: (4, 4) where it starts
    center_base: Array  #: (3,) a point of the axis, m
    sweep: Array  #: (3,) the axis times the angle travelled, rad, base axes
    rotation_base: Array  #: (3,) how far the tool rotates, rad, base axes

    def at(self, share: Array) -> PathPoints:
        """Return the path at shares (N,)."""
        arm_base = exp_so3(share[:, None] * self.sweep) @ (self.T_base_start[:3, 3] - self.center_base)
        T = np.tile(self.T_base_start, (len(share), 1, 1))
        T[:, :3, 3] = self.center_base + arm_base
        T[:, :3, :3] = exp_so3(share[:, None] * self.rotation_base) @ self.T_base_start[:3, :3]
        speed = np.cross(self.sweep, arm_base)
        twist = np.hstack([speed, np.tile(self.rotation_base, (len(share), 1))])
        return PathPoints(T, twist, np.hstack([np.cross(self.sweep, speed), np.zeros((len(share), 3))]))


def circle(
    arm: Arm,
    q_start: ArrayLike,
    center_base: ArrayLike,
    axis_base: ArrayLike,
    angle_rad: float = 2 * np.pi,
    *,
    rotation_base: ArrayLike = (0.0, 0.0, 0.0),
    duration_s: float | None = None,
) -> PathMotion:
    """Plan a circle of the tool about an axis in space, from where it is.

    Args:
        arm: the arm.
        q_start: (n,) angles to start from, rad; their configuration is kept.
        center_base: (3,) a point of the axis, m, base frame: the centre where it lies in the circle's plane.
        axis_base: (3,) direction of the axis, any length, base frame; the tool moves about it by the right hand.
        angle_rad: how far round, rad; a full circle by default, negative for the other way.
        rotation_base: (3,) rotation vector the orientation goes through on the way, rad, base axes; zero keeps it, the
            axis times ``angle_rad`` rotates the tool with the circle.
        duration_s: how long it is to take, s; None for as short as the limits allow.

    Raises:
        MotionRejected: the circle leaves the reach or the joint limits, or meets a singularity.
        InputError: bad numbers, the tool on the axis, or a duration that cannot be met.
    """
    center, axis = checked(center_base, (3,), "center_base"), checked(axis_base, (3,), "axis_base")
    if not np.linalg.norm(axis) > 0:
        raise InputError("axis_base is zero; it must be the direction of the circle's axis")
    if not (np.isfinite(angle_rad) and angle_rad != 0):
        raise InputError(f"angle_rad is {angle_rad}; it must be a number other than zero")
    axis = axis / np.linalg.norm(axis)
    T_base_start = arm.forward(q_start)
    if np.linalg.norm(np.cross(axis, T_base_start[:3, 3] - center)) < TOO_SMALL:
        raise InputError("the tool is on the circle's axis: there is no circle to travel")
    path = ArcPath(T_base_start, center, axis * angle_rad, checked(rotation_base, (3,), "rotation_base"))
    return follow(arm, path, q_start, duration_s=duration_s)


def arc(
    arm: Arm, q_start: ArrayLike, via_base: ArrayLike, T_base_goal: ArrayLike, *, duration_s: float | None = None
) -> PathMotion:
    """Plan the arc of the tool from where it is through a point to a pose, the orientation rotating evenly (slerp).

    ``q_start``: (n,) angles to start from, rad; their configuration is kept. ``via_base``: (3,) a point on the arc between
    start and goal, m, base frame. ``T_base_goal``: (4, 4) pose of the tool to end at. ``duration_s``: how long it is to
    take, s; None for as short as the limits allow. Raises MotionRejected: the arc leaves the reach or the joint limits, or
    meets a singularity; InputError: bad numbers, three points on one line, or a duration that cannot be met.
    """
    T_base_start = arm.forward(q_start)
    goal = checked_pose(T_base_goal, "T_base_goal")
    center, sweep = through(T_base_start[:3, 3], checked(via_base, (3,), "via_base"), goal[:3, 3])
    rotation_base = log_so3(np.ascontiguousarray(goal[:3, :3] @ T_base_start[:3, :3].T))
    return follow(arm, ArcPath(T_base_start, center, sweep, rotation_base), q_start, duration_s=duration_s)


def through(a: Array, via: Array, b: Array) -> tuple[Array, Array]:
    """Return the centre (3,) and the sweep (3,), axis times angle, of the arc from ``a`` over ``via`` to ``b``.

    InputError: the points coincide or lie on one line.
    """
    u, v = via - a, b - a
    normal = np.cross(u, v)
    size = float(np.linalg.norm(normal))
    if size <= TOO_SMALL * max(float(np.linalg.norm(u)), TOO_SMALL) * max(float(np.linalg.norm(v)), TOO_SMALL):
        raise InputError("start, via_base and goal lie on one line or coincide: no arc goes through them; plan a line")
    # The centre is equally far from all three: in their plane, on the bisectors of u and v.
    center = a + np.cross((u @ u) * v - (v @ v) * u, normal) / (2 * size**2)
    axis = normal / size
    from_center, to_center = a - center, b - center
    angle = float(np.arctan2(axis @ np.cross(from_center, to_center), from_center @ to_center)) % (2 * np.pi)
    return center, axis * angle
