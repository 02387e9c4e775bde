"""Forward kinematics of an arm that is not what its table says, and the derivative by everything that can be off.

A row of the table is Rz(theta) Tz(d) Tx(a) Rx(alpha) Ry(beta), modified Rx(alpha) Tx(a) Ry(beta) Rz(theta) Tz(d). Beta is
Hayati's angle ("Robot arm geometric link parameter estimation", CDC 1983): between neighbouring axes that are parallel, d
says nothing and only beta can tilt the second axis about the common normal's perpendicular. The derivative of a point by an
elementary turn about axis u through o is u x (p - o), by a shift u.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from armsight.data import Array
from armsight.geometry.rotation import exp_so3
from armsight.robot.arm import Arm

#: Columns of a table of lengths and angles, (6, 5).
COLUMNS = ("offset", "d", "a", "alpha", "beta")
OFFSET, D, A, ALPHA, BETA = range(5)
_STANDARD = (OFFSET, D, A, ALPHA, BETA)
_MODIFIED = (ALPHA, A, BETA, OFFSET, D)
#: Column -> the axis it turns about or shifts along.
_AXIS = {OFFSET: 2, D: 2, A: 0, ALPHA: 0, BETA: 1}
_SHIFTS = (D, A)


class Motion(NamedTuple):
    """Where an arm's last frame is, and how it moves with each number of the table.

    Attributes:
        R: (N, 3, 3) turn of frame 6 in the rig.
        o: (N, 3) its origin.
        axis: (6, 5, N, 3) the axes that each number turns about or shifts along.
        through: (6, 5, N, 3) points on those axes.
    """

    R: Array
    o: Array
    axis: Array
    through: Array


def nominal_table(arm: Arm) -> Array:
    """Return the table (6, 5) of an arm, by COLUMNS."""
    return np.stack([arm.offset, arm.d, arm.a, arm.alpha, np.zeros(6)], axis=1)


def motion(table: Array, theta: Array, modified: bool, R_rig_0: Array, o_rig_0: Array) -> Motion:
    """Carry a frame along the chain.

    Args:
        table: (6, 5) by COLUMNS, m and rad.
        theta: (N, 6) what each joint turns beside its offset, rad.
        modified: whether the table follows the modified convention.
        R_rig_0: (3, 3) turn of frame 0 in the rig.
        o_rig_0: (3,) its origin.
    """
    n = len(theta)
    R, o = np.broadcast_to(R_rig_0, (n, 3, 3)).copy(), np.broadcast_to(o_rig_0, (n, 3)).copy()
    axis, through = np.empty((6, 5, n, 3)), np.empty((6, 5, n, 3))
    for i in range(6):
        for column in _MODIFIED if modified else _STANDARD:
            k = _AXIS[column]
            axis[i, column], through[i, column] = R[:, :, k], o
            value = table[i, column]
            if column in _SHIFTS:
                o += value * R[:, :, k]
            elif column == OFFSET:
                _turn(R, k, value + theta[:, i])
            elif value != 0.0:
                _turn(R, k, np.full(n, value))
    return Motion(R, o, axis, through)


def _turn(R: Array, k: int, angle: Array) -> None:
    """Turn frames (N, 3, 3) in place about their own axis ``k``."""
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    u, v = R[:, :, (k + 1) % 3].copy(), R[:, :, (k + 2) % 3].copy()
    R[:, :, (k + 1) % 3] = c * u + s * v
    R[:, :, (k + 2) % 3] = c * v - s * u


def point_derivative(m: Motion, p: Array) -> Array:
    """Return the derivative (6, 5, N, 3) of points p (N, 3), rig, by every number of the table."""
    out = np.cross(m.axis, p - m.through)
    out[:, _SHIFTS] = m.axis[:, _SHIFTS]
    return out


def turn_derivative(m: Motion) -> Array:
    """Return the derivative (6, 5, N, 3) of the turn of frame 6, as a rotation vector in the rig's axes."""
    out = m.axis.copy()
    out[:, _SHIFTS] = 0.0
    return out


def turned(start: Array, by: Array) -> Array:
    """Return exp(by) @ start for a rotation vector (3,)."""
    return np.asarray(exp_so3(by) @ start)
