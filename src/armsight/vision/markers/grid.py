"""Grids of points on a plane: where they sit, which rotations leave them in place, and the local shape of their image."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter
from scipy.spatial import KDTree

from armsight.data import Array, Ids


def grid_points(columns: int, rows: int, pitch_m: float) -> Array:
    """Return (rows * columns, 3) points, m, row by row: x along the columns, y along the rows, z = 0."""
    y, x = np.mgrid[:rows, :columns]
    return np.stack([x.ravel() * pitch_m, y.ravel() * pitch_m, np.zeros(rows * columns)], axis=1)


def rotations(points: Array) -> tuple[tuple[int, Ids], ...]:
    """Find the quarter turns in the plane that lay a set of points (M, 3) on itself.

    Returns:
        Pairs of how many quarter turns (1, 2, 3) and the permutation (M,): point i comes to lie where point perm[i] was.
    """
    p = points[:, :2] - 0.5 * (points[:, :2].min(axis=0) + points[:, :2].max(axis=0))
    tree = KDTree(p)
    tolerance = 0.1 * float(np.asarray(tree.query(p, k=2)[0])[:, 1].min())
    found, turned = [], p
    for turns in (1, 2, 3):
        turned = turned @ np.array([[0.0, 1.0], [-1.0, 0.0]])
        distance, nearest = tree.query(turned)
        if np.max(distance) < tolerance:
            found.append((turns, np.asarray(nearest, dtype=np.int64)))
    return tuple(found)


def _neighbours(uv: Array, axis: int) -> tuple[Array, Array]:
    """Return the steps from each point of uv (rows, columns, 2) to the next and from the previous one; NaN off the grid."""
    gap = np.diff(uv, axis=axis)
    none = np.full_like(np.take(uv, [0], axis=axis), np.nan)
    return np.concatenate([gap, none], axis=axis), np.concatenate([none, gap], axis=axis)


def local_squares(uv: Array) -> tuple[Array, Array]:
    """Read the shape of the squares around each point of a seen grid from its neighbours.

    Args:
        uv: (rows, columns, 2) places, px; NaN where a point is not known.

    Returns:
        (rows, columns, 2, 2) the vectors to the next column and to the next row, as long as the shorter of the two
        sides that meet, from a homography where neighbours are missing; (rows, columns, 2, 2) the bow of the grid's
        lines, 1/px: a point t px along a line lies ``t^2 * bow`` off its tangent; zero where it is not known.
    """
    squares, bows = np.empty((*uv.shape, 2)).swapaxes(-1, -2), np.zeros((*uv.shape[:2], 2, 2))
    for side, axis in enumerate((1, 0)):
        after, before = _neighbours(uv, axis)
        steps = np.stack([after, before])
        known = np.isfinite(steps[..., 0])
        length = np.where(known, np.linalg.norm(steps, axis=-1), np.inf).min(axis=0)
        direction = np.where(known[..., None], steps, 0.0).sum(axis=0)
        norm = np.linalg.norm(direction, axis=-1)
        with np.errstate(invalid="ignore", divide="ignore"):
            unit = direction / norm[..., None]
            squares[..., side, :] = np.where(np.isfinite(length)[..., None], unit * length[..., None], np.nan)
            bend = after - before
            bend -= (bend * unit).sum(axis=-1, keepdims=True) * unit
            bow = bend / (np.linalg.norm(steps, axis=-1) ** 2).sum(axis=0)[..., None]
        bows[..., side, :] = _smoothed(_extended(bow, axis))
    missing = ~np.isfinite(squares).all(axis=(-1, -2)) & np.isfinite(uv[..., 0])
    if missing.any():
        squares[missing] = _homography_squares(uv, missing)
    return squares, bows


def _extended(bow: Array, axis: int) -> Array:
    """Give the ends of each line the bow of the point beside them."""
    bow = np.array(np.moveaxis(bow, axis, 0))
    if len(bow) >= 3:
        bow[0], bow[-1] = bow[1], bow[-2]
    return np.moveaxis(bow, 0, axis)


def _smoothed(bow: Array) -> Array:
    """Average bow (rows, columns, 2) over each point and its known neighbours: lenses bow lines slowly over the image."""
    known = np.isfinite(bow[..., :1]).astype(np.float64)
    total, count = (
        uniform_filter(array, size=(3, 3, 1), mode="constant") for array in (np.nan_to_num(bow, nan=0.0), known)
    )
    return np.asarray(np.divide(total, count, out=np.zeros_like(total), where=count > 1e-9))


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
    wanted = np.argwhere(where)
    H = _homography(uv)
    if H is None:
        return np.full((len(wanted), 2, 2), np.nan)
    p = np.column_stack([wanted[:, 1], wanted[:, 0], np.ones(len(wanted))]) @ H.T
    out = np.empty((len(wanted), 2, 2))
    for side in range(2):
        out[:, side] = (H[:2, side] - (p[:, :2] / p[:, 2:]) * H[2, side]) / p[:, 2:]
    return out
