"""Paths of the tool in space: position and orientation as the share of the way goes from 0 to 1, without time.

Every path here is twice continuously differentiable, so that a jerk-limited share of the way gives joint accelerations
without steps.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from armsight.data import Array
from armsight.errors import InputError
from armsight.geometry.check import RIGID, checked, off_rotation
from armsight.geometry.rotation import log_so3

#: A rotation of one radian counts as this length, m, where the length of a way with rotation and translation is measured:
#: about what a tool's tip sweeps.
ROTATION_M = 0.25


class PathPoints(NamedTuple):
    """A path at N shares of its way."""

    T_base_tool: Array  #: (N, 4, 4) poses of the tool
    twist: Array  #: (N, 6) their derivative by the share: [position m; rotation rad], base axes
    bend: Array  #: (N, 6) the derivative of the twist by the share


class Path(Protocol):
    """A way of the tool, from share 0 to share 1."""

    def at(self, share: Array) -> PathPoints:
        """Return the path at shares (N,)."""


def checked_pose(T: object, name: str) -> Array:
    """Return a pose (4, 4) that has been found to be one; or InputError."""
    pose = checked(T, (4, 4), name)  # type: ignore[arg-type]
    R = pose[:3, :3]
    if off_rotation(R) > RIGID or np.linalg.det(R) < 0 or np.abs(pose[3] - [0, 0, 0, 1]).max() > RIGID:
        raise InputError(f"{name} is no pose: its 3x3 must be a rotation, its last row 0 0 0 1")
    return pose


def way(T_a: Array, T_b: Array) -> tuple[Array, Array, float]:
    """Return what lies between two poses: (3,) m in base axes, (3,) rad in the tool's, and the length of both, m.

    The rotation is the shorter one; of two half revolutions either.
    """
    step = T_b[:3, 3] - T_a[:3, 3]
    rotation = log_so3(np.ascontiguousarray(T_a[:3, :3].T @ T_b[:3, :3]))
    return step, rotation, float(max(np.linalg.norm(step), ROTATION_M * np.linalg.norm(rotation)))
