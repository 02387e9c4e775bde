"""Rows of the inverse's answer: what their columns are, limits, whole turns, doubles and order."""

from __future__ import annotations

import numba
import numpy as np

from armsight.data import Array

#: Most solutions that are looked for: eight where there is a closed form; a general arm has up to sixteen.
MOST = 16
#: Columns of a row: six joint angles, position error, orientation error, shoulder, elbow, wrist (+-1, or 0 where the arm
#: has no structure), state, and the key by which rows are ordered.
POSITION, ANGLE, CONFIGURATION, STATE, KEY, WIDTH = 6, 7, 8, 11, 12, 13
#: Bit of a row's state beside those of ``closed``: a joint is beyond its limits.
OUTSIDE = 8

#: Two solutions that differ less than this in every joint, rad, are one.
_SAME_RAD = 1e-7
_TURN = 2.0 * np.pi
#: Added to the key of a row outside the limits: more than any distance.
_LAST = 1e9

_kernel = numba.njit(cache=True, error_model="numpy", fastmath={"contract", "nsz"})


@_kernel
def wrap(q: float) -> float:
    """Bring an angle into (-pi, pi]."""
    turns: float = np.ceil((q - np.pi) / _TURN)
    return q - _TURN * turns


@_kernel
def placed(q: float, low: float, high: float, goal: float) -> tuple[float, bool]:
    """Return the angle, whole turns apart, that lies within the limits and nearest a goal; and whether there is one."""
    least, most = (np.ceil((low - q) / _TURN - 1e-13), np.floor((high - q) / _TURN + 1e-13))
    wanted = np.floor((goal - q) / _TURN + 0.5)
    inside = least <= most
    held = min(most, max(least, wanted))
    turned = q + _TURN * (held if inside else wanted)
    # A joint that rounding put over its limit is put on it.
    return (min(high, max(low, turned)) if inside else turned), inside


@_kernel
def known(rows: Array, count: int) -> bool:
    """Say whether row ``count`` stands among the rows before it."""
    for k in range(count):
        same = True
        for i in range(6):
            apart = abs(wrap(rows[k, i] - rows[count, i]))
            if apart > _SAME_RAD:
                same = False
                break
        if same:
            return True
    return False


@_kernel
def place(limits: Array, near: Array, ordered: bool, row: Array) -> None:
    """Turn a row's joints within the limits, and write its state and key."""
    outside, distance = False, 0.0
    for i in range(6):
        row[i], inside = placed(row[i], limits[0, i], limits[1, i], near[i])
        outside = outside or not inside
        distance += (row[i] - near[i]) ** 2
    if outside:
        row[STATE] += OUTSIDE
    row[KEY] = (distance if ordered else 0.0) + (_LAST if outside else 0.0)


@_kernel
def sort(rows: Array, count: int) -> None:
    """Order rows by their keys; equal ones keep their order."""
    for k in range(1, count):
        j = k
        while j > 0 and rows[j - 1, KEY] > rows[j, KEY]:
            for i in range(WIDTH):
                rows[j - 1, i], rows[j, i] = rows[j, i], rows[j - 1, i]
            j -= 1
