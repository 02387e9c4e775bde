"""Images of solid bodies with exact depth: triangles whose material has a grain, seen through the full camera model.

Meshes and a camera go in; an 8-bit image and the depth of every pixel's centre come out. The grain is a function of the
position in the body (value noise in octaves), so that it needs no unfolding and moves with the body. Light is even; each
pixel is the mean of a few samples, so that edges are soft as a sensor's are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Image, Record
from armsight.geometry.pose import inverse, transform
from armsight.kernels import kernel
from armsight.vision.camera import Camera

#: Samples along each side of a pixel; an odd number, so that one is the centre.
_SUB = 3
#: Pixels around a triangle's corners that its image may bulge beyond them through distortion.
_BULGE_PX = 12
_FAR = 1e9


@dataclass(frozen=True, eq=False)
class Solid(Record):
    """A mesh in its own frame.

    Attributes:
        vertices: (V, 3) m.
        triangles: (T, 3) rows of vertices.
        grain_m: size of the coarsest grain, m.
        contrast: standard deviation of the grain in grey levels, about.
        seed: of the grain.
    """

    vertices: Array
    triangles: NDArray[np.int64]
    grain_m: float = 0.02
    contrast: float = 30.0
    seed: int = 0


def box(size_m: Array, **grain: float) -> Solid:
    """Return a box (3,), m, about the origin."""
    v = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * size_m
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])  # counter-clockwise from outside
    return Solid(v, triangles, **grain)  # type: ignore[arg-type]


@kernel("f8[:, :, ::1], f8[:, ::1], (i8, i8, i8, i8), f8[:, ::1], i4[:, ::1], i8")
def _cast(
    rays: Array, corners: Array, box: tuple[int, int, int, int], depth: Array, owner: NDArray[np.int32], k: int
) -> None:
    """Let the rays (H, W, 3) of a box meet a triangle (3, 3); the nearer keeps the sample (Moeller and Trumbore 1997)."""
    e1, e2, s = corners[1] - corners[0], corners[2] - corners[0], -corners[0]
    q = np.cross(s, e1)
    for y in range(box[1], box[3]):
        for x in range(box[0], box[2]):
            r = rays[y, x]
            p = np.cross(r, e2)
            det = e1[0] * p[0] + e1[1] * p[1] + e1[2] * p[2]
            if abs(det) < 1e-15:
                continue
            u = (s[0] * p[0] + s[1] * p[1] + s[2] * p[2]) / det
            v = (r[0] * q[0] + r[1] * q[1] + r[2] * q[2]) / det
            t = (e2[0] * q[0] + e2[1] * q[1] + e2[2] * q[2]) / det
            if u >= 0 and v >= 0 and u + v <= 1 and 0 < t < depth[y, x]:
                depth[y, x], owner[y, x] = t, k


@kernel
def _lattice(x: int, y: int, z: int, seed: int) -> float:
    """Return a number of -1 to 1 for a point of a lattice: a hash."""
    h = (x * 73856093) ^ (y * 19349663) ^ (z * 83492791) ^ (seed * 2654435761)
    h = (h ^ (h >> 13)) * 1274126177 & 0xFFFFFFFF
    h = (h ^ (h >> 16)) * 2246822519 & 0xFFFFFFFF
    return ((h ^ (h >> 15)) & 0xFFFF) / 32767.5 - 1.0


@kernel("f8[:, ::1], f8, i8, f8[::1]")
def _grain(p: Array, grain_m: float, seed: int, out: Array) -> None:
    """Write value noise of three octaves at points (N, 3), of unit spread about."""
    for n in range(p.shape[0]):
        total = 0.0
        for octave in range(3):
            scale = 2.0**octave / grain_m
            a, b, c = p[n, 0] * scale, p[n, 1] * scale, p[n, 2] * scale
            i, j, k = int(np.floor(a)), int(np.floor(b)), int(np.floor(c))
            a, b, c = a - i, b - j, c - k
            a, b, c = a * a * (3 - 2 * a), b * b * (3 - 2 * b), c * c * (3 - 2 * c)
            value = 0.0
            for di in range(2):
                for dj in range(2):
                    for dk in range(2):
                        w = (a if di else 1 - a) * (b if dj else 1 - b) * (c if dk else 1 - c)
                        value += w * _lattice(i + di, j + dj, k + dk, seed + octave)
            total += value
        out[n] = total * 1.6


def _sample_rays(camera: Camera) -> Array:
    """Return unit rays (H * SUB, W * SUB, 3) through the samples of a camera's pixels."""
    width, height = camera.image_size_px
    at = (np.arange(_SUB) - (_SUB - 1) / 2) / _SUB
    u = (np.arange(width)[:, None] + at).ravel()
    v = (np.arange(height)[:, None] + at).ravel()
    uv = np.stack(np.meshgrid(u, v), axis=2).reshape(-1, 2)
    return camera.unproject(uv).reshape(len(v), len(u), 3)


def see(camera: Camera, solids: Sequence[tuple[Solid, Array]]) -> tuple[Image, Array, NDArray[np.int32]]:
    """Render what a camera sees of solids with their poses (4, 4) in its frame: (H, W) uint8.

    Also (H, W) depth along the camera's axis at pixel centres, m, NaN where there is nothing, and which solid, -1 for
    none.
    """
    rays = _sample_rays(camera)
    height, width = rays.shape[:2]
    depth, owner = np.full((height, width), _FAR), np.full((height, width), -1, np.int32)
    for k, (solid, T) in enumerate(solids):
        p = transform(T, solid.vertices)
        uv = camera.project(p)
        for t in solid.triangles:
            low, high = np.array([0, 0]), np.array([width, height])
            if np.isfinite(uv[t]).all() and (p[t, 2] > 0).all():
                low = np.clip((uv[t].min(axis=0) - _BULGE_PX) * _SUB, 0, high).astype(int)
                high = np.clip((uv[t].max(axis=0) + _BULGE_PX) * _SUB, 0, high).astype(int)
            _cast(rays, p[t], (int(low[0]), int(low[1]), int(high[0]), int(high[1])), depth, owner, k)
    light = np.full((height, width), 60.0)
    for k, (solid, T) in enumerate(solids):
        mine = owner == k
        p_solid = transform(inverse(T), rays[mine] * depth[mine][:, None])
        value = np.empty(len(p_solid))
        _grain(p_solid, solid.grain_m, solid.seed, value)
        light[mine] = 120 + solid.contrast * value
    image = light.reshape(height // _SUB, _SUB, width // _SUB, _SUB).mean(axis=(1, 3))
    middle = slice(_SUB // 2, None, _SUB)
    seen = owner[middle, middle]
    z = np.where(seen >= 0, depth[middle, middle] * rays[middle, middle, 2], np.nan)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8), z, seen


def with_noise(image: Image, sigma: float, rng: np.random.Generator) -> Image:
    """Return an image with a sensor's noise of ``sigma`` grey levels."""
    return np.clip(np.rint(image + sigma * rng.normal(size=image.shape)), 0, 255).astype(np.uint8)
