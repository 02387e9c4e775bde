"""Images of boxes whose faces have a grain, with the exact depth of every pixel: what layers and flat patterns lack.

The grain is a function of the position in the body (value noise in octaves), so it moves with the body. Light is even;
each pixel is the mean of a few samples, so that edges are soft as a sensor's are.
"""

from typing import NamedTuple

import numpy as np

from armsight.geometry.pose import inverse, transform

SUB = 3  # samples along each side of a pixel, odd, so that one is the centre
BULGE_PX = 12  # around a triangle's corners that its image may bulge beyond them through distortion
FAR = 1e9


class Solid(NamedTuple):
    """A mesh: vertices (V, 3), m, triangles (T, 3); size of the coarsest grain, m, its sigma in grey levels, its seed."""

    vertices: np.ndarray
    triangles: np.ndarray
    grain_m: float = 0.02
    contrast: float = 30.0
    seed: int = 0


def box(size_m, **grain):
    """A box (3,), m, about the origin."""
    v = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * size_m
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return Solid(v, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]), **grain)


def cast(rays, corners, depth, owner, k):
    """Let rays (h, w, 3) meet a triangle (3, 3); the nearer keeps the sample (Moeller and Trumbore 1997)."""
    e1, e2, s = corners[1] - corners[0], corners[2] - corners[0], -corners[0]
    q, p = np.cross(s, e1), np.cross(rays, e2)
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v, t = (p @ s) / (p @ e1), (rays @ q) / (p @ e1), (e2 @ q) / (p @ e1)
    met = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t < depth)
    depth[met], owner[met] = t[met], k


def grain(p, grain_m, seed):
    """(N,) value noise of three octaves at points (N, 3), of unit spread about."""
    total = np.zeros(len(p))
    for octave in range(3):
        at = p * (2.0**octave / grain_m)
        low = np.floor(at).astype(np.int64)
        f = (at - low) ** 2 * (3 - 2 * (at - low))
        for d in np.ndindex(2, 2, 2):
            h = np.bitwise_xor.reduce((low + d) * (73856093, 19349663, 83492791), axis=1) ^ (seed + octave) * 2654435761
            for shift, factor in ((13, 1274126177), (16, 2246822519)):
                h = (h ^ (h >> shift)) * factor & 0xFFFFFFFF
            total += np.prod(np.where(d, f, 1 - f), axis=1) * (((h ^ (h >> 15)) & 0xFFFF) / 32767.5 - 1.0)
    return 1.6 * total


def see(camera, solids):
    """Image (H, W) of solids with their poses (4, 4) in a camera's frame, and depth of pixel centres, m, NaN beside."""
    at = (np.arange(SUB) - (SUB - 1) / 2) / SUB
    u, v = ((np.arange(side)[:, None] + at).ravel() for side in camera.image_size_px)
    rays = camera.unproject(np.stack(np.meshgrid(u, v), axis=2).reshape(-1, 2)).reshape(len(v), len(u), 3)
    size = np.array([len(u), len(v)])
    depth, owner = np.full(size[::-1], FAR), np.full(size[::-1], -1)
    for k, (solid, T) in enumerate(solids):
        p = transform(T, solid.vertices)
        uv = camera.project(p)
        for t in solid.triangles:
            low, high = (0, 0), size
            if np.isfinite(uv[t]).all() and (p[t, 2] > 0).all():
                low = np.clip((uv[t].min(axis=0) - BULGE_PX) * SUB, 0, size).astype(int)
                high = np.clip((uv[t].max(axis=0) + BULGE_PX) * SUB, 0, size).astype(int)
            part = np.s_[low[1] : high[1], low[0] : high[0]]
            cast(rays[part], p[t], depth[part], owner[part], k)
    light = np.full(depth.shape, 60.0)
    for k, (solid, T) in enumerate(solids):
        mine = owner == k
        p_solid = transform(inverse(T), rays[mine] * depth[mine][:, None])
        light[mine] = 120 + solid.contrast * grain(p_solid, solid.grain_m, solid.seed)
    image = light.reshape(len(v) // SUB, SUB, len(u) // SUB, SUB).mean(axis=(1, 3))
    middle = np.s_[SUB // 2 :: SUB, SUB // 2 :: SUB]
    z = np.where(owner[middle] >= 0, depth[middle] * rays[(*middle, 2)], np.nan)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8), z


def with_noise(image, sigma, rng):
    """An image with a sensor's noise of ``sigma`` grey levels."""
    return np.clip(np.rint(image + sigma * rng.normal(size=image.shape)), 0, 255).astype(np.uint8)
