"""The table whose closed form starts the iterative inverse of an arm with axes a little off parallel.

The common normal of two axes that are all but parallel is far away, so that such a row holds a d of many metres, the next
one takes it back, and what lies between looks like no arm. Here d is carried on to where the normal is near, and the tilt
left out.
"""

from __future__ import annotations

import itertools

import numpy as np

from armsight.data import Array
from armsight.robot.kinematics.table import BASE, link

#: Axes further apart than this, rad, are not meant to be parallel.
TILT_RAD = np.deg2rad(3.0)
_A, _D, _COS, _SIN, _OFFSET, _DIRECTION = range(6)


def untilted(table: Array) -> Array:
    """Return a packed table (96,) with axes that are all but parallel made parallel, and the rest as near as may be."""
    out = table.copy()
    rows = out[:BASE].reshape(6, 6)
    for row, after in itertools.pairwise(rows):
        if abs(row[_SIN]) > np.sin(TILT_RAD) or row[_SIN] == 0.0:
            continue
        along = -row[_D] / row[_COS]  # on the next axis, as far up as this joint stands
        turn = np.array([[np.cos(row[_OFFSET]), -np.sin(row[_OFFSET])], [np.sin(row[_OFFSET]), np.cos(row[_OFFSET])]])
        at = link(*row[:4]) @ [0.0, 0.0, along, 1.0]
        x, y = turn @ at[:2]
        facing = row[_OFFSET]  # where the next frame's x points; the tilt turns it by its square
        row[_A], row[_D] = np.hypot(x, y), 0.0
        row[_OFFSET] = np.arctan2(y, x)
        row[_COS], row[_SIN] = np.sign(row[_COS]), 0.0
        after[_D] -= along
        after[_OFFSET] += row[_COS] * (facing - row[_OFFSET])
    return out
