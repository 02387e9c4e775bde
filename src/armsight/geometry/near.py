"""Points that are near each other, of some thousands: importing SciPy's trees takes longer than a pair of images."""

from __future__ import annotations

import numpy as np

from armsight.data import Array, Ids
from armsight.kernels import kernel


def pairs_within(points: Array, reach: float, most: int = 1 << 32) -> Ids:
    """Return the pairs (P, 2) of points (N, D) that are no further apart than ``reach``, i < j; so many at most."""
    order = np.argsort(points[:, 0], kind="stable")
    in_order = np.ascontiguousarray(points[order], float)
    found = np.empty((_pairs(in_order, reach, most, np.empty((0, 2), np.int64)), 2), np.int64)
    _pairs(in_order, reach, most, found)
    return np.sort(order[found], axis=1)


@kernel("f8[:, ::1], f8, i8, i8[:, ::1]")
def _pairs(points: Array, reach: float, most: int, found: Ids) -> int:
    """Fill the pairs of points (N, D), sorted by their first coordinate, where there is room; return how many there are."""
    count = 0
    for i in range(len(points)):
        for j in range(i + 1, len(points)):
            if points[j, 0] - points[i, 0] > reach or count == most:
                break
            square = 0.0
            for k in range(points.shape[1]):
                square += (points[j, k] - points[i, k]) ** 2
            if square <= reach * reach:
                if count < len(found):
                    found[count, 0], found[count, 1] = i, j
                count += 1
    return count


@kernel("const f8[:, ::1], f8[:, ::1], b1, i8[::1], f8[::1]")
def nearest(points: Array, asked: Array, own: bool, rows: Ids, squares: Array) -> None:
    """Fill the nearest of points (N, D) for each asked one (M, D): its row (M,) and the square of its distance (M,).

    ``own``: whether the point of the same row counts, where both are the same points.
    """
    for i in range(len(asked)):
        rows[i], squares[i] = -1, np.inf
        for j in range(len(points)):
            if j == i and not own:
                continue
            square = 0.0
            for k in range(points.shape[1]):
                square += (points[j, k] - asked[i, k]) ** 2
            if square < squares[i]:
                rows[i], squares[i] = j, square
