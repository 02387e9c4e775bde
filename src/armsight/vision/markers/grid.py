"""Grids of points on a plane: their positions, their rotational symmetries, and the local shape of their image."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Ids
from armsight.geometry.near import nearest
from armsight.kernels import kernel


def grid_points(columns: int, rows: int, pitch_m: float) -> Array:
    """Return (rows * columns, 3) points, m, row by row: x along the columns, y along the rows, z = 0."""
    y, x = np.mgrid[:rows, :columns]
    return np.stack([x.ravel() * pitch_m, y.ravel() * pitch_m, np.zeros(rows * columns)], axis=1)


def rotations(points: Array) -> tuple[tuple[int, Ids], ...]:
    """Find the rotations by 90, 180 and 270 degrees in the plane that map a set of points (M, 3) onto itself.

    Returns Pairs of the multiple of 90 degrees (1, 2, 3) and the permutation (M,): point i moves to where point perm[i]
    was.
    """
    p = points[:, :2] - 0.5 * (points[:, :2].min(axis=0) + points[:, :2].max(axis=0))
    rows, squares = np.empty(len(p), np.int64), np.empty(len(p))
    nearest(p, p, False, rows, squares)
    found, rotated, most = [], p, 0.01 * squares.min()  # a tenth of the least distance, squared
    for rot90 in (1, 2, 3):
        rotated = rotated @ np.array([[0.0, 1.0], [-1.0, 0.0]])
        nearest(p, rotated, True, rows, squares)
        if squares.max() < most:
            found.append((rot90, rows.copy()))
    return tuple(found)


def rightwards(points: Array, uv: Array) -> float:
    """Return the cosine between x of a board and the image's rows: points (N, 3), m, seen at uv (N, 2), px."""
    p = points[:, :2]
    (across, _), *_ = np.linalg.lstsq(p - p.mean(axis=0), uv - uv.mean(axis=0), rcond=None)
    return float(across[0] / np.hypot(*across))


def local_squares(uv: Array) -> tuple[Array, Array]:
    """Estimate the squares around each point of a detected grid uv (rows, columns, 2), NaN where unknown.

    Returns (rows, columns, 2, 2) the vectors to the next column and to the next row, as long as the shorter of the two
    sides that meet, from a homography where neighbours are missing; (rows, columns, 2, 2) the bow of the grid's lines,
    1/px: a point t px along a line lies ``t^2 * bow`` off its tangent; zero where it is not known.
    """
    squares, bows = np.empty((*uv.shape, 2)), np.empty((*uv.shape, 2))
    if _read_squares(np.ascontiguousarray(uv, dtype=np.float64), squares, bows):
        missing = np.isnan(squares.sum(axis=(2, 3))) & np.isfinite(uv[..., 0])
        squares[missing] = _homography_squares(uv, missing)
    return squares, bows


@kernel("f8[:, :, ::1], f8[:, :, :, ::1], f8[:, :, :, ::1]")
def _read_squares(uv: Array, squares: Array, bows: Array) -> bool:
    """Fill what :func:`local_squares` returns; return whether a known point has a side without a neighbour, NaN."""
    rows, columns = uv.shape[:2]
    missing = False
    bow = np.empty((2, rows, columns, 2))
    for y in range(rows):
        for x in range(columns):
            _read_side(uv, y, x, 0, 1, squares[y, x, 0], bow[0, y, x])
            _read_side(uv, y, x, 1, 0, squares[y, x, 1], bow[1, y, x])
            missing |= np.isfinite(uv[y, x, 0]) and np.isnan(squares[y, x, 0, 0] + squares[y, x, 1, 0])
    if columns >= 3:  # the ends of a line have the bow of the point beside them
        bow[0, :, 0], bow[0, :, -1] = bow[0, :, 1], bow[0, :, -2]
    if rows >= 3:
        bow[1, 0], bow[1, -1] = bow[1, 1], bow[1, -2]
    for y in range(rows):
        for x in range(columns):
            for side in range(2):
                _mean_about(bow[side], y, x, bows[y, x, side])
    return missing


@kernel
def _read_side(uv: Array, y: int, x: int, down: int, right: int, side: Array, bow: Array) -> None:
    """Fill the side (2,) of the square and the bow (2,) of the line at a point, along a row or a column; NaN if unknown."""
    rows, columns = uv.shape[:2]
    here, length, known = uv[y, x], np.inf, 0
    sx, sy, bx, by, lengths2 = 0.0, 0.0, 0.0, 0.0, 0.0
    for sign in (1, -1):
        i, j = y + sign * down, x + sign * right
        if 0 <= i < rows and 0 <= j < columns:
            dx, dy = sign * (uv[i, j, 0] - here[0]), sign * (uv[i, j, 1] - here[1])
            if np.isfinite(dx):
                sx, sy, bx, by = sx + dx, sy + dy, bx + sign * dx, by + sign * dy
                lengths2 += dx * dx + dy * dy
                length, known = min(length, np.hypot(dx, dy)), known + 1
    norm = np.hypot(sx, sy)
    ux, uy = sx / norm, sy / norm
    side[0], side[1] = (ux * length, uy * length) if known else (np.nan, np.nan)
    along = bx * ux + by * uy
    bow[0], bow[1] = ((bx - along * ux) / lengths2, (by - along * uy) / lengths2) if known == 2 else (np.nan, np.nan)


@kernel
def _mean_about(bow: Array, y: int, x: int, mean: Array) -> None:
    """Average bow (rows, columns, 2) over a point and its known neighbours: lenses bow lines slowly over the image."""
    count, across, down = 0, 0.0, 0.0
    for i in range(max(y - 1, 0), min(y + 2, bow.shape[0])):
        for j in range(max(x - 1, 0), min(x + 2, bow.shape[1])):
            if np.isfinite(bow[i, j, 0]):
                count, across, down = count + 1, across + bow[i, j, 0], down + bow[i, j, 1]
    mean[0], mean[1] = across / max(count, 1), down / max(count, 1)


def completed(uv: Array) -> Array:
    """Fill the unknown points of a seen grid (rows, columns, 2), NaN, where a homography of the known ones puts them."""
    H = _homography(uv)
    unknown = ~np.isfinite(uv[..., 0])
    if H is None or not unknown.any():
        return uv
    rows, columns = np.nonzero(unknown)
    p = np.column_stack([columns, rows, np.ones(len(rows))]) @ H.T
    out = uv.copy()
    out[unknown] = np.where(p[:, 2:] > 0, p[:, :2] / p[:, 2:], np.nan)
    return out


def _homography(uv: Array) -> Array | None:
    """Return the homography (3, 3) from column, row to the known points of a seen grid, positive before the horizon."""
    rows, columns = np.nonzero(np.isfinite(uv[..., 0]))
    if len(rows) < 4:
        return None
    H, _ = cv2.findHomography(np.stack([columns, rows], axis=1).astype(np.float64), uv[rows, columns])
    if H is None:
        return None
    return np.asarray(H * np.sign(H[2] @ [columns[0], rows[0], 1.0]), np.float64)


def _homography_squares(uv: Array, where: NDArray[np.bool_]) -> Array:
    """Return (n, 2, 2) the square's sides at the points ``where`` by the homography that fits all known points."""
    requested = np.argwhere(where)
    H = _homography(uv)
    if H is None:
        return np.full((len(requested), 2, 2), np.nan)
    p = np.column_stack([requested[:, 1], requested[:, 0], np.ones(len(requested))]) @ H.T
    out = np.empty((len(requested), 2, 2))
    for side in range(2):
        out[:, side] = (H[:2, side] - (p[:, :2] / p[:, 2:]) * H[2, side]) / p[:, 2:]
    return out
