"""What a cloud says about a body's outline, as the camera sees it.

The planes of a body's faces do not hold it sideways where a view shows little but one face; its outline does. A ray that
ended on the body must meet it, and a ray that went past must miss it: every measured point on the wrong side of the
outline, of a body whose pose is a little off, says how far the outline is to move there. Both kinds are needed: a rim
where nothing was measured then pulls to neither side.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from armsight.data import Array
from armsight.geometry.pose import inverse, transform

#: Cells of the picture the outline is drawn in, for each step from ray to ray; cells at most to a side; bits of a cell's
#: fraction that OpenCV draws with.
_CELLS, _MOST_CELLS, _SHIFT = 2, 1500, 4
#: Nearest depth that a triangle may have to be drawn, m, and points on the wrong side at least, to conclude anything.
_NEAREST_M, _LEAST = 0.01, 10
#: Rays that their step is measured at.
_LOOKED_AT = 2000


def tangents(p: Array) -> Array:
    """Return where (N, 2) the rays to points (N, 3) meet the plane at unit depth."""
    return np.asarray(p[:, :2] / p[:, 2:])


def ray_step(p: Array) -> float:
    """Return the step between neighbouring rays of a cloud (N, 3), at unit depth: a pixel of the camera's."""
    rays = tangents(p)
    some = rays[:: max(1, len(rays) // _LOOKED_AT)]
    return float(np.median(np.asarray(cKDTree(rays).query(some, k=2)[0])[:, 1]))


def _drawn(flat: Array, step: float, margin: float) -> tuple[NDArray[np.uint8], Array, float]:
    """Draw triangles (T, 3, 2) at unit depth: the picture, the place of its first cell, and a cell's size."""
    low, high = flat.min(axis=(0, 1)) - margin, flat.max(axis=(0, 1)) + margin
    cell = max(step / _CELLS, float((high - low).max()) / _MOST_CELLS)
    columns, rows = np.ceil((high - low) / cell).astype(int) + 1
    picture = np.zeros((int(rows), int(columns)), np.uint8)
    for triangle in np.rint((flat - low) / cell * 2**_SHIFT).astype(np.int32):
        cv2.fillConvexPoly(picture, triangle, 1, cv2.LINE_8, _SHIFT)
    return picture, low, cell


def _beyond(picture: NDArray[np.uint8], uv: Array, limit: float) -> tuple[NDArray[np.bool_], Array, Array]:
    """Tell how far places (N, 2), cells, are outside a drawn body.

    Returns:
        (N,) which of them are within a limit of its outline, and of those (M,) how far outside, cells, less than zero
        inside, and (M, 2) the unit direction outward.
    """
    outside, inside = (cv2.distanceTransform(m, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) for m in (1 - picture, picture))
    far = np.where(picture > 0, 0.5 - inside, outside - 0.5).astype(np.float32)
    smooth = cv2.GaussianBlur(far, (0, 0), 1.5)
    slopes = [cv2.Sobel(smooth, cv2.CV_32F, *along, ksize=3, scale=1 / 8) for along in ((1, 0), (0, 1))]
    k = np.rint(uv).astype(int)
    near = np.asarray(((k >= 0) & (k < np.array(picture.shape[::-1]))).all(axis=1))
    u, v = k[near].T
    out = np.stack([s[v, u] for s in slopes], axis=1).astype(np.float64)
    size = np.linalg.norm(out, axis=1)
    clear = (np.abs(far[v, u]) < limit) & (size > 0.5)  # at a body's middle line no side is nearer than the other
    out = out[clear] / size[clear][:, None]
    near[near] = clear
    return near, far[v, u][clear] + np.einsum("ni,ni->n", out, uv[near] - k[near]), out


def outline_pull(
    corners: Array, surface: tuple[Array, Array], p: Array, T: Array, step: float, reach_m: float, sigma_m: float
) -> tuple[Array, Array]:
    """Let points on the wrong side of a body's outline pull it.

    Args:
        corners: (T, 3, 3) triangles of all of the body's surface, m, body frame, counter-clockwise seen from outside.
        surface: (S, 3) points of it and their (S, 3) normals, body frame: how deep the outline is.
        p: (N, 3) the cloud around the body, whatever it lies on, m, camera frame.
        T: (4, 4) the body's pose in the camera frame.
        step: of the cloud's rays.
        reach_m: how far the outline may be off, m; what is so much behind it is background.
        sigma_m: how well a point tells the outline, m.

    Returns:
        (6, 6) information and (6,) gradient; zero where there is nothing to conclude.
    """
    H, g, eye = np.zeros((6, 6)), np.zeros(6), inverse(T)[:3, 3]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    seen = transform(T, corners[np.einsum("ni,ni->n", normals, eye - corners[:, 0]) > 0].reshape(-1, 3))
    samples = transform(T, surface[0][np.einsum("ni,ni->n", surface[1], eye - surface[0]) > 0])
    if not len(seen) or not len(samples) or seen[:, 2].min() <= _NEAREST_M:
        return H, g
    around = 1.5 * reach_m / float(np.median(samples[:, 2]))
    picture, low, cell = _drawn(tangents(seen).reshape(-1, 3, 2), step, around)
    places = (tangents(p) - low) / cell
    near, beyond, out = _beyond(picture, places, around / cell)
    rim = (places[near] - beyond[:, None] * out) * cell + low
    z = samples[cKDTree(tangents(samples)).query(rim)[1], 2]
    behind = p[near, 2] - z
    wrong = np.where(beyond > 0, np.abs(behind) < reach_m, behind > reach_m)
    if np.count_nonzero(wrong) < _LEAST:
        return H, g
    rim, z, out, off = rim[wrong], z[wrong], out[wrong], (beyond * cell * z)[wrong]
    # A body that moves by t moves its outline by (t_xy - rim t_z) / z.
    n = np.column_stack([out, -np.einsum("ni,ni->n", out, rim)]) @ T[:3, :3]
    q = transform(inverse(T), np.column_stack([rim * z[:, None], z]))
    J = -np.concatenate([n, np.cross(q, n)], axis=1)
    weight = np.clip(1 - (off / reach_m) ** 2, 0, None) ** 2 / sigma_m**2
    return J.T @ (weight[:, None] * J), J.T @ (weight * off)
