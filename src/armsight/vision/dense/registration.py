"""Locate a body without markers: its known surface is registered to a point cloud.

A surface (a mesh's, or that of a reference shot), a cloud with its uncertainty and a first pose, such as the arm's, go
in; a pose with covariance comes out. The method is iterative closest points, from each measured point to the tangent
plane of the surface there (Chen and Medioni, "Object modelling by registration of multiple range images", 1992), with a
reach that shrinks to the cloud's own noise (Zhang 1994) and Tukey's weights against points that do not belong to the
body; a mesh's outline counts too.

A disparity is that of a window: where a surface bends or ends, its pixel shows a point beside. Points near an edge are
therefore uncertain sideways by about half a window, and along the normal of a face that is seen obliquely that is most
of their error; with the depth's sigma alone such faces, the worst measured ones, would outweigh all others.

The planes of a body's faces do not determine it sideways where a view shows little but one face; its outline does
(:func:`outline_pull`). A ray that ended on the body must meet it, and a ray that went past must miss it: every measured
point on the wrong side of the outline, of a body whose pose is slightly off, shows how far the outline must move there.
Both kinds are needed: an outline where nothing was measured then pulls to neither side.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from armsight.data import Array, Missed, Record
from armsight.errors import InputError
from armsight.files import read_bytes
from armsight.geometry.check import checked
from armsight.geometry.pose import exp_se3, inverse, transform

#: Pixels of the image that the outline is rendered in, for each step from ray to ray; most pixels to a side; bits of
#: the fraction of a pixel that OpenCV renders with.
_PIXELS, _MOST_PIXELS, _SHIFT = 2, 1500, 4
#: Nearest depth of a triangle that is rendered, m, and least number of points on the wrong side.
_NEAREST_M, _LEAST_OUTSIDE = 0.01, 10
#: Number of rays at which their step is measured.
_LOOKED_AT = 2000


def tangents(p: Array) -> Array:
    """Return where (N, 2) the rays to points (N, 3) meet the plane at unit depth."""
    return np.asarray(p[:, :2] / p[:, 2:])


def ray_step(p: Array) -> float:
    """Return the step between neighbouring rays of a cloud (N, 3), at unit depth: a pixel of the camera's."""
    rays = tangents(p)
    some = rays[:: max(1, len(rays) // _LOOKED_AT)]
    return float(np.median(np.asarray(cKDTree(rays).query(some, k=2)[0])[:, 1]))


def _rendered(flat: Array, step: float, margin: float) -> tuple[NDArray[np.uint8], Array, float]:
    """Render triangles (T, 3, 2) at unit depth: the mask, the position of its first pixel, and a pixel's size."""
    low, high = flat.min(axis=(0, 1)) - margin, flat.max(axis=(0, 1)) + margin
    pixel = max(step / _PIXELS, float((high - low).max()) / _MOST_PIXELS)
    columns, rows = np.ceil((high - low) / pixel).astype(int) + 1
    mask = np.zeros((int(rows), int(columns)), np.uint8)
    for triangle in np.rint((flat - low) / pixel * 2**_SHIFT).astype(np.int32):
        cv2.fillConvexPoly(mask, triangle, 1, cv2.LINE_8, _SHIFT)
    return mask, low, pixel


def _beyond(mask: NDArray[np.uint8], uv: Array, limit: float) -> tuple[NDArray[np.bool_], Array, Array]:
    """Measure how far uv (N, 2), pixels, are outside of a rendered body.

    Returns:
        (N,) which of them are within a limit of its outline, and of those (M,) the distance outside, pixels, negative
        inside, and (M, 2) the unit direction outward.
    """
    outside, inside = (cv2.distanceTransform(m, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) for m in (1 - mask, mask))
    far = np.where(mask > 0, 0.5 - inside, outside - 0.5).astype(np.float32)
    smooth = cv2.GaussianBlur(far, (0, 0), 1.5)
    slopes = [cv2.Sobel(smooth, cv2.CV_32F, *along, ksize=3, scale=1 / 8) for along in ((1, 0), (0, 1))]
    k = np.rint(uv).astype(int)
    near = np.asarray(((k >= 0) & (k < np.array(mask.shape[::-1]))).all(axis=1))
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
    """Compute how points on the wrong side of a body's outline pull its pose.

    Args:
        corners: (T, 3, 3) triangles of all of the body's surface, m, body frame, counter-clockwise seen from outside.
        surface: (S, 3) points of it and their (S, 3) normals, body frame: how deep the outline is.
        p: (N, 3) the cloud around the body, whatever it lies on, m, camera frame.
        T: (4, 4) the body's pose in the camera frame.
        step: of the cloud's rays.
        reach_m: how far the outline may be off, m; points so much behind it are background.
        sigma_m: standard deviation of a point across the outline, m.

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
    mask, low, pixel = _rendered(tangents(seen).reshape(-1, 3, 2), step, around)
    uv = (tangents(p) - low) / pixel
    near, beyond, out = _beyond(mask, uv, around / pixel)
    rim = (uv[near] - beyond[:, None] * out) * pixel + low
    z = samples[cKDTree(tangents(samples)).query(rim)[1], 2]
    behind = p[near, 2] - z
    wrong = np.where(beyond > 0, np.abs(behind) < reach_m, behind > reach_m)
    if np.count_nonzero(wrong) < _LEAST_OUTSIDE:
        return H, g
    rim, z, out, off = rim[wrong], z[wrong], out[wrong], (beyond * pixel * z)[wrong]
    # A body that moves by t moves its outline by (t_xy - rim t_z) / z.
    n = np.column_stack([out, -np.einsum("ni,ni->n", out, rim)]) @ T[:3, :3]
    q = transform(inverse(T), np.column_stack([rim * z[:, None], z]))
    J = -np.concatenate([n, np.cross(q, n)], axis=1)
    weight = np.clip(1 - (off / reach_m) ** 2, 0, None) ** 2 / sigma_m**2
    return J.T @ (weight[:, None] * J), J.T @ (weight * off)


_STL_MB = 64  # largest mesh, 1.3 million triangles; half: some scans are rejected; double: 600 MB of memory
#: Distance between the points a mesh is sampled at, m, and the neighbours that a normal of a cloud is fitted to.
_SPACING_M, _NEIGHBOURS = 0.002, 24
#: The reach begins at the largest error of the first pose and shrinks by this share each step, to so many sigmas of the
#: noise.
_SHRINK, _SIGMAS = 0.9, 10.0
#: How uncertain a point is sideways, in steps from ray to ray: near an edge, where half of the 7 x 7 px of a match
#: shows something else, as a standard deviation; and within a face.
_SIDEWAYS, _WITHIN = 2.0, 1.0
#: Distance from an edge that counts as near, in steps: half of the window and most of the smoothing's width. An edge is
#: where normals differ by more than this (cosine), among so many neighbours at most.
_NEAR_EDGE, _EDGE_COSINE, _AROUND = 6.0, 0.9, 40
#: The outline's reach is not less than so many of these.
_OUTLINE_SIGMAS = 3.0
_STEPS, _SETTLED_M = 60, 1e-5
#: Most points of a cloud (a fixed random sample), least, and how many neighbours share one error: disparities are
#: smoothed over 9 x 9 px, half of it by weight.
_MOST, _LEAST, _SHARED = 20000, 100, 40
#: A direction that the surface does not determine (a sphere's rotation): standard deviation that is too large, m or
#: rad.
_OPEN = 0.05
_NOTHING = f"fewer than {_LEAST} points of the cloud lie near the body's surface at the first pose"


@dataclass(frozen=True, eq=False)
class Surface(Record):
    """Points of a body's surface.

    Attributes:
        points: (N, 3) m, body frame.
        normals: (N, 3) unit, outward.
        corners: (T, 3, 3) triangles of all of the surface, m; None where only a part of it is known, and no outline.
    """

    points: Array
    normals: Array
    corners: Array | None = None

    @staticmethod
    def of_mesh(vertices: Array, triangles: NDArray[np.int64], spacing_m: float = _SPACING_M) -> Surface:
        """Sample a mesh evenly.

        Args:
            vertices: (V, 3) m, body frame.
            triangles: (T, 3) rows of vertices, counter-clockwise seen from outside.
            spacing_m: distance between points, about.

        Raises:
            InputError: no triangle has an area.
        """
        corners = checked(vertices, (None, 3), "vertices")[np.asarray(triangles)]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = np.linalg.norm(cross, axis=1) / 2
        if not (area > 0).any():
            raise InputError("a mesh needs triangles that have an area")
        counts = np.ceil(area / spacing_m**2).astype(int)
        owner = np.repeat(np.arange(len(corners)), counts)
        rank = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
        # A low-discrepancy sequence (Roberts' R2), folded into the triangle: even, and the same every time.
        s, t = np.modf(np.outer(rank + 0.5, (0.7548776662466927, 0.5698402909980532)))[0].T
        fold = s + t > 1
        s, t = np.where(fold, 1 - s, s), np.where(fold, 1 - t, t)
        a, b, c = corners[owner].transpose(1, 0, 2)
        points = a + s[:, None] * (b - a) + t[:, None] * (c - a)
        return Surface(points, cross[owner] / (2 * area[owner])[:, None], corners)

    @staticmethod
    def of_cloud(points: Array, towards: Array) -> Surface:
        """Use the cloud of a reference shot as the surface.

        Args:
            points: (N, 3) m, in the frame that is to be the body's.
            towards: (3,) where the camera was, same frame; normals face it.
        """
        p = checked(points, (None, 3), "points")
        near = cKDTree(p).query(p, k=min(_NEIGHBOURS, len(p)))[1]
        gathered = p[near] - p[near].mean(axis=1, keepdims=True)
        normals = np.linalg.eigh(np.einsum("nki,nkj->nij", gathered, gathered))[1][:, :, 0]
        away = np.einsum("ni,ni->n", normals, p - towards) > 0
        return Surface(p, np.where(away[:, None], -normals, normals))


@dataclass(frozen=True, eq=False)
class CloudPose(Record):
    """The pose of a body in a cloud.

    Attributes:
        T_left_body: (4, 4) its pose.
        cov: (6, 6) covariance of the tangent [translation m; rotation rad], perturbation on the right.
        rms_m: RMS distance of the points from the surface, along its normals.
        points: how many points of the cloud lie on the body.
    """

    T_left_body: Array
    cov: Array
    rms_m: float
    points: int


def locate_cloud(
    surface: Surface, p_left: Array, sigma_m: Array, T_left_body: Array, *, reach_m: float = 0.03
) -> CloudPose | Missed:
    """Find a body in a point cloud.

    Args:
        surface: the body's.
        p_left: (N, 3) measured points, m, left camera's frame; the body and whatever else is in view.
        sigma_m: (N,) standard deviation of their depths, m.
        T_left_body: (4, 4) first pose, such as the arm's.
        reach_m: largest error of the first pose, m, at the body's surface.

    Returns:
        The pose, or why there is none: nothing of the body near the first pose, or a surface that does not determine
        the pose.
    """
    T: Array = checked(T_left_body, (4, 4), "T_left_body")
    p, sigma = checked(p_left, (None, 3), "p_left"), checked(sigma_m, (None,), "sigma_m")
    tree: cKDTree = cKDTree(surface.points)
    near = _nearest(tree, transform(inverse(T), p), 2 * reach_m)[0] <= 2 * reach_m
    if np.count_nonzero(near) < _LEAST:
        return Missed(_NOTHING)
    step, around = ray_step(p[near]), p[_around(surface, p, T, reach_m)]
    sideways = _SIDEWAYS * step * float(np.median(p[near, 2]))
    p, sigma = p[near], sigma[near]
    if len(p) > _MOST:
        sampled = np.random.default_rng(0).choice(len(p), _MOST, replace=False)
        p, sigma = p[sampled], sigma[sampled]
    beside = (
        np.where(_near_edges(surface, tree, _NEAR_EDGE / _SIDEWAYS * sideways), 1.0, _WITHIN / _SIDEWAYS) * sideways
    )
    reach, shared = reach_m, max(1.0, _SHARED * len(p) / max(int(np.count_nonzero(near)), 1))
    for _ in range(_STEPS):
        fit = _planes(surface, tree, p, sigma, beside, T, reach)
        if fit is None:
            return Missed(_NOTHING)
        H, g, gaps, least_reach = fit
        if surface.corners is not None:
            within = max(reach, _OUTLINE_SIGMAS * sideways)
            samples = surface.points, surface.normals
            more = outline_pull(surface.corners, samples, around, T, step, within, sideways)
            H, g = H + more[0], g + more[1]
        if np.linalg.eigvalsh(H)[0] <= 1 / _OPEN**2:
            return Missed("the body's surface in view does not determine its pose: it can slide or rotate along itself")
        move = -np.linalg.solve(H, g)
        T = np.asarray(T @ exp_se3(np.asarray(move, np.float64)))
        settled = reach <= least_reach and np.abs(move).max() < _SETTLED_M
        reach = max(reach * _SHRINK, least_reach)
        if settled:
            break
    cov = np.linalg.inv(H) * shared * max(1.0, float(np.mean(gaps[:, 1] ** 2)))
    return CloudPose(T, np.asarray(cov), float(np.sqrt(np.mean(gaps[:, 0] ** 2))), len(gaps))


def _around(surface: Surface, p: Array, T: Array, reach_m: float) -> NDArray[np.bool_]:
    """Return which points (N, 3) a body at a first pose, and twice the reach around it, may cover or lie beside."""
    body = transform(T, surface.points)
    body = body[body[:, 2] > 0]
    if not len(body):
        return np.zeros(len(p), np.bool_)
    flat, margin = tangents(body), 2 * reach_m / float(np.median(body[:, 2]))
    with np.errstate(divide="ignore", invalid="ignore"):
        rays = tangents(p)
    return np.asarray(
        (p[:, 2] > 0) & ((rays > flat.min(axis=0) - margin) & (rays < flat.max(axis=0) + margin)).all(axis=1)
    )


def _near_edges(surface: Surface, tree: cKDTree, radius_m: float) -> NDArray[np.bool_]:
    """Return which points (N,) of a surface have others within a radius whose normals differ."""
    rows = np.asarray(tree.query(surface.points, k=_AROUND, distance_upper_bound=radius_m)[1])
    padded = np.vstack([surface.normals, np.zeros(3)])  # a neighbour that is not there has the row after the last
    cosine = np.einsum("nki,ni->nk", padded[rows], surface.normals)
    return np.asarray(((cosine < _EDGE_COSINE) & (rows < len(surface.points))).any(axis=1))


def _nearest(tree: cKDTree, p: Array, reach: float) -> tuple[Array, NDArray[np.int64]]:
    """Return how far (N,) the nearest point of the surface is, infinite beyond a reach, and its row."""
    far, rows = tree.query(p, distance_upper_bound=reach)
    return np.asarray(far, np.float64), np.asarray(rows, np.int64)


def _planes(
    surface: Surface, tree: cKDTree, p: Array, sigma: Array, beside: Array, T: Array, reach: float
) -> tuple[Array, Array, Array, float] | None:
    """Linearise the distances of points to the planes of the surface near them.

    Returns:
        (6, 6) information, (6,) gradient, (M, 2) distances of the points that count, m and in sigmas, and the reach
        that their noise asks for; None where too few count.
    """
    p_body = transform(inverse(T), p)
    far, rows = _nearest(tree, p_body, reach)
    eye = inverse(T)[:3, 3]
    found = np.isfinite(far)
    found[found] = np.einsum("ni,ni->n", surface.normals[rows[found]], eye - p_body[found]) > 0  # the side in view
    if np.count_nonzero(found) < _LEAST:
        return None
    q, n, x = surface.points[rows[found]], surface.normals[rows[found]], p_body[found]
    gap = np.einsum("ni,ni->n", n, x - q)
    view = x - eye
    slant = np.abs(np.einsum("ni,ni->n", n, view)) / np.linalg.norm(view, axis=1)
    noise = np.hypot(sigma[found] * slant, beside[rows[found]] * np.sqrt(np.clip(1 - slant**2, 0, None)))
    weight = np.clip(1 - (gap / reach) ** 2, 0, None) ** 2 / noise**2
    J = -np.concatenate([n, np.cross(x, n)], axis=1)  # of n . (exp(-xi) x - q)
    H, g = J.T @ (weight[:, None] * J), J.T @ (weight * gap)
    inside = np.abs(gap) < _SIGMAS * noise * 2
    least_reach = _SIGMAS * float(np.median(np.maximum(noise, np.abs(gap))))
    gaps = np.column_stack([gap, gap / noise])[inside] if inside.any() else np.column_stack([gap, gap / noise])
    return H, g, gaps, least_reach


def read_stl(path: str | Path, unit_m: float = 1e-3) -> tuple[Array, NDArray[np.int64]]:
    """Read a binary STL mesh: (V, 3) vertices, m, and (T, 3) triangles.

    Args:
        path: the file.
        unit_m: metres a unit of the file; STL has none, and most programs mean mm.

    Raises:
        InputError: missing, unreadable, or no binary STL.
    """
    data = read_bytes(path, _STL_MB)
    count = int.from_bytes(data[80:84], "little") if len(data) >= 84 else 0
    if count == 0 or len(data) < 84 + 50 * count:
        raise InputError(f"{path}: not a binary STL mesh (80 bytes of header, a count, 50 bytes a triangle)")
    kind = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
    corners = np.frombuffer(data, kind, count, 84)["corners"].reshape(-1, 3).astype(np.float64) * unit_m
    return corners, np.arange(3 * count).reshape(-1, 3)
