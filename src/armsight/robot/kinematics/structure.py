"""Which closed-form inverse an arm has, read off its table.

Two structures are known, both with axis 1 perpendicular to axes 2 and 3, which are parallel, and two right angles at the
wrist:

- PARALLEL: axes 2, 3 and 4 are parallel, and axes 5 and 6 meet (``six_r``, Universal Robots);
- SPHERICAL: axes 4, 5 and 6 meet in one point (PUMA 560, IRB 120, most industrial arms).

A table that has neither exactly but is close to one, such as an identified table, still gets the solutions of the close
one as starting points. What is neither, the iterative inverse solves.
"""

from __future__ import annotations

import numpy as np

from armsight.data import Array
from armsight.geometry.pose import inverse
from armsight.robot.kinematics.table import ACROSS, BEND, FOREARM, KIND, TOOL, UNTOOL, link

NEITHER, PARALLEL, SPHERICAL = range(3)

#: How far a table may be from a structure for that to give starting points: angle, rad, and length, m.
_NEAR_RAD, _NEAR_M = np.deg2rad(3.0), 0.005
#: Links shorter than this, m, leave no elbow to bend.
_SHORTEST_M = 1e-3
_A, _D, _COS, _SIN, _OFFSET, _DIRECTION = range(6)


def recognised(table: Array) -> tuple[Array, bool]:
    """Find the structure of a table.

    ``table``: (102,) packed table. Returns (102,) the table that the closed-form inverse works on, its kind at KIND
    (NEITHER where there is none): the same arm written with its parallel axes pointing one way, or the nearest that has a
    structure; and whether it is exact.
    """
    for near_rad, near_m, exact in ((1e-12, 1e-12, True), (_NEAR_RAD, _NEAR_M, False)):
        squared = _squared(table, near_rad)
        rows = squared[:36].reshape(6, 6)
        for kind in (SPHERICAL, PARALLEL):
            if _fits(rows, kind, near_m):
                return _finished(squared, kind), exact
    return table.copy(), False


def _squared(table: Array, near_rad: float) -> Array:
    """Round twists close to right angles, and reverse joints so that no twist of links 2 and 3 is 180 degrees.

    ``Rx(pi) Rz(theta) Tz(d) Tx(a) Rx(alpha) = Rz(-theta) Tz(-d) Tx(a) Rx(alpha + pi)`` carries it one link further.
    """
    out = table.copy()
    rows = out[:36].reshape(6, 6)
    for row in rows:
        quarter = np.rint(np.arctan2(row[_SIN], row[_COS]) / (np.pi / 2))
        if abs(np.arctan2(row[_SIN], row[_COS]) - quarter * np.pi / 2) <= near_rad:
            row[_COS], row[_SIN] = np.rint(np.cos(quarter * np.pi / 2)), np.rint(np.sin(quarter * np.pi / 2))
    for i in (1, 2):
        if rows[i, _COS] == -1.0:
            rows[i, _COS] = 1.0
            rows[i + 1, [_D, _COS, _SIN, _OFFSET, _DIRECTION]] *= -1.0
    return out


def _fits(rows: Array, kind: int, near_m: float) -> bool:
    """Return whether squared rows have a structure, lengths within ``near_m``."""
    right = np.abs(rows[:, _SIN]) == 1.0
    along = rows[:, _COS] == 1.0
    if not (right[0] and along[1] and right[3] and right[4] and abs(rows[1, _A]) > _SHORTEST_M):
        return False
    if kind == SPHERICAL:
        forearm = np.hypot(rows[2, _A], rows[3, _D] * rows[2, _SIN])
        vanish = np.array([rows[3, _A], rows[4, _A], rows[4, _D]])
    else:
        forearm = abs(rows[2, _A]) if along[2] else 0.0
        vanish = rows[4, [_A]]
    return bool(forearm > _SHORTEST_M and np.abs(vanish).max() <= near_m)


def _finished(squared: Array, kind: int) -> Array:
    """Write what the closed form needs into a squared table whose small lengths vanish."""
    out = squared.copy()
    rows = out[:36].reshape(6, 6)
    along, across = rows[2, _A], 0.0
    rows[4, _A] = 0.0
    shift = rows[1, _D] + rows[2, _D] + rows[3, _D]
    if kind == SPHERICAL:
        rows[3, _A] = rows[4, _D] = 0.0
        across = -rows[3, _D] * rows[2, _SIN]
        shift = rows[1, _D] + rows[2, _D] + rows[3, _D] * rows[2, _COS]
    out[KIND], out[FOREARM] = kind, np.hypot(along, across)
    out[ACROSS] = shift * rows[0, _SIN]
    bend = np.arctan2(across, along)
    out[BEND : BEND + 3] = bend, np.cos(bend), np.sin(bend)
    T_6_tool = np.vstack([out[TOOL : TOOL + 12].reshape(3, 4), [0, 0, 0, 1]])
    out[UNTOOL : UNTOOL + 12] = inverse(link(*rows[5, :4]) @ T_6_tool)[:3].ravel()
    return out
