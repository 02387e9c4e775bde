"""Derivatives of a shot's residuals by all that may be wrong, and its pose eliminated: compiled."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Ids
from armsight.geometry.matrix import product, solved
from armsight.kernels import kernel
from armsight.vision.pose.posefit import differentiate

#: The polynomials of the position in an image are all products of x and y up to this degree; their count.
_DEGREE = 4
_POLYNOMIALS = (_DEGREE + 1) * (_DEGREE + 2) // 2
#: Numbers of what the camera models lack: of two cameras, along u and v; their prior is 1 px wide.
LENS = 4 * _POLYNOMIALS


@kernel
def _polynomials(x: float, y: float, values: Array) -> None:
    """Fill values (P,) of the products of Chebyshev polynomials of a position in an image with edges at -1 and 1."""
    T = np.empty((2, _DEGREE + 1))
    T[:, 0], T[0, 1], T[1, 1] = 1.0, min(max(x, -1.0), 1.0), min(max(y, -1.0), 1.0)
    for i in range(2, _DEGREE + 1):
        for axis in range(2):
            T[axis, i] = 2.0 * T[axis, 1] * T[axis, i - 1] - T[axis, i - 2]
    n = 0
    for i in range(_DEGREE + 1):
        for k in range(_DEGREE + 1 - i):
            values[n] = T[0, i] * T[1, k]
            n += 1


@kernel(
    "b1[::1], f8[:, ::1], f8[:, ::1], i8[::1], f8[:, ::1], f8[:, ::1], const f8[:, ::1], i8[::1], const i8[::1], "
    "const f8[:, :, ::1], const f8[:, :, :, ::1], f8, f8[:, ::1], f8[::1], f8[:, ::1], f8[:, ::1]"
)
def differentiated(
    fisheye: NDArray[np.bool_], k: Array, d: Array, counts: Ids, T_right_left: Array, half_px: Array, points: Array,
    row_of: Ids, ids: Ids, uv: Array, cov: Array, sigma_px: float, T: Array, velocity: Array, A: Array, rows: Array,
) -> float:  # fmt: skip
    """Fill the derivatives A (4 N, 6) by the pose, and rows (4 N, 1 + K + M), of N points in both images; they hold zeros.

    Return the mean variance of a coordinate, px^2; NaN where a point is behind a camera.
    """
    n, P = 2 * len(ids), 14 + counts[0] + counts[1]
    p, side, seen, covs = np.empty((n, 3)), np.empty(n, np.int64), np.empty((n, 2)), np.empty((n, 2, 2))
    variance = 0.0
    for i in range(n):
        side[i] = i % 2
        p[i], seen[i], covs[i] = points[ids[i // 2]], uv[i // 2, i % 2], cov[i // 2, i % 2]
        for axis in range(2):
            covs[i, axis, axis] += sigma_px * sigma_px
            variance += covs[i, axis, axis] / (2.0 * n)
    W, left, B, values = np.zeros((n, 2, 2)), np.empty((n, 2)), np.zeros((2 * n, P)), np.empty(_POLYNOMIALS)
    if not differentiate(fisheye, k, d, counts, T_right_left, p, side, seen, covs, T, W, left, A, B):
        return np.nan
    lens = rows.shape[1] - LENS
    for i in range(n):
        c, first = side[i], 2 + P + 3 * row_of[ids[i // 2]]
        _polynomials((seen[i, 0] + 0.5) / half_px[c, 0] - 1.0, (seen[i, 1] + 0.5) / half_px[c, 1] - 1.0, values)
        for axis in range(2):
            row, J = rows[2 * i + axis], A[2 * i + axis]
            row[0] = W[i, axis, 0] * left[i, 0] + W[i, axis, 1] * left[i, 1]
            row[1 : 1 + P] = B[2 * i + axis]
            for j in range(3):
                row[1 + P] += J[j] * p[i, j]
                row[first + j] = J[j]
            along = 0.0  # what the body's motion of a second does to this row: one of a later exposure
            for j in range(6):
                along += J[j] * velocity[j]
            row[lens - 2] = ((seen[i, 1] + 0.5) / (2.0 * half_px[c, 1]) - 0.5) * along
            row[lens - 1] = c * along
            for uv_axis in range(2):
                begin = lens + (2 * c + uv_axis) * _POLYNOMIALS
                for j in range(_POLYNOMIALS):
                    row[begin + j] = W[i, axis, uv_axis] * values[j]
    return variance


@kernel("f8[:, ::1], f8[:, ::1], i8, f8, f8[:, ::1]")
def eliminate_pose(A: Array, rows: Array, skew: int, sync_s: float, response: Array) -> None:
    """Eliminate the pose, of derivatives A (n, 6), and the shot's own skew from rows (n, K); fill its response (6, K).

    The skew, of column ``skew`` and standard deviation ``sync_s``, s, is eliminated by a symmetric factor of what Sherman
    and Morrison give: (1 - g u u^T)^2 = 1 - u u^T / (1 / sync_s^2 + u^T u).
    """
    gain = solved(product(A.T, A), product(A.T, rows))
    for i in range(len(rows)):
        for j in range(6):
            for c in range(rows.shape[1]):
                rows[i, c] -= A[i, j] * gain[j, c]
    response[:, :] = -gain
    u, square = rows[:, skew].copy(), 0.0
    for i in range(len(u)):
        square += u[i] * u[i]
    share = sync_s * sync_s / (1.0 + sync_s * sync_s * square)
    along = np.zeros(rows.shape[1])
    for i in range(len(u)):
        for c in range(len(along)):
            along[c] += u[i] * rows[i, c]
    along *= share / (1.0 + np.sqrt(1.0 - share * square))
    for i in range(len(u)):
        for c in range(len(along)):
            rows[i, c] -= u[i] * along[c]
