"""Cast rays at capsules and boxes: what stands still around an arm looks like, without GL.

Surfaces are dull: a lamp's light falls off with the cosine, and some comes from everywhere (Lambert).
Capsules are met as in the closed form for a swept sphere: the cylinder's quadratic, or that of the nearer end.

All compiled functions that call each other stay in this file: numba's cache on disk looks at one file's age only.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from armsight.data import Array

#: Share of the light that comes from everywhere, and of the lamp's.
AMBIENT, LAMP = 0.45, 0.75
#: Columns of a box: middle 0-2, half sides 3-5, cosine and sine of its turn about z 6, 7; albedo 8, texture 9.
BOX = 10
PLAIN, TILES, GRAIN, PRINT = 0, 1, 2, 3
_FAR = 1e9
_NOTHING = np.float32(0.25)  # light from where nothing is
_STEP = 1e-4  # a shadow's ray starts so far off its surface, m

Light = NDArray[np.float32]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _capsule(o: Array, d: Array, a: Array, b: Array, radius: float) -> float:
    """Return how far along the unit ray d (3,) from o a capsule between a and b is met; _FAR where it is not."""
    bax, bay, baz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    oax, oay, oaz = o[0] - a[0], o[1] - a[1], o[2] - a[2]
    baba = bax * bax + bay * bay + baz * baz
    bard = bax * d[0] + bay * d[1] + baz * d[2]
    baoa = bax * oax + bay * oay + baz * oaz
    rdoa = oax * d[0] + oay * d[1] + oaz * d[2]
    oaoa = oax * oax + oay * oay + oaz * oaz
    upper = False
    if baba > 1e-12:
        A, B = baba - bard * bard, baba * rdoa - baoa * bard
        C = baba * oaoa - baoa * baoa - radius * radius * baba
        if 1e-12 * baba < A:
            h = B * B - A * C
            if h < 0.0:
                return _FAR
            t = (-B - np.sqrt(h)) / A
            y = baoa + t * bard
            if 0.0 < y < baba:
                return t if t > 0.0 else _FAR
            upper = y >= baba
        else:
            upper = bard < 0.0
    if upper:
        oax, oay, oaz = oax - bax, oay - bay, oaz - baz
    B = oax * d[0] + oay * d[1] + oaz * d[2]
    h = B * B - (oax * oax + oay * oay + oaz * oaz - radius * radius)
    t = -B - np.sqrt(h) if h >= 0.0 else _FAR
    return t if t > 0.0 else _FAR


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _capsule_normal(p: Array, a: Array, b: Array, radius: float, out: Array) -> None:
    """Write the outward unit normal of a capsule at a point of its surface."""
    baba = along = 0.0
    for i in range(3):
        baba += (b[i] - a[i]) ** 2
        along += (p[i] - a[i]) * (b[i] - a[i])
    t = min(max(along / baba, 0.0), 1.0) if baba > 0.0 else 0.0
    for i in range(3):
        out[i] = (p[i] - a[i] - t * (b[i] - a[i])) / radius


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _box(o: Array, d: Array, box: Array) -> tuple[float, int]:
    """Return how far along a ray a box is met and through which face (1, 2, 3, negative: the lower); _FAR, 0 if not."""
    c, s = box[6], box[7]
    x, y, z = o[0] - box[0], o[1] - box[1], o[2] - box[2]
    along = x * d[0] + y * d[1] + z * d[2]
    if x * x + y * y + z * z - along * along > box[3] * box[3] + box[4] * box[4] + box[5] * box[5]:
        return _FAR, 0  # past the ball around it
    local_o = (c * x + s * y, c * y - s * x, z)
    local_d = (c * d[0] + s * d[1], c * d[1] - s * d[0], d[2])
    near, far, face = -_FAR, _FAR, 0
    for i in range(3):
        half = box[3 + i]
        if abs(local_d[i]) < 1e-12:
            if abs(local_o[i]) > half:
                return _FAR, 0
            continue
        way = 1.0 if local_d[i] > 0.0 else -1.0
        t0, t1 = (-way * half - local_o[i]) / local_d[i], (way * half - local_o[i]) / local_d[i]
        if t0 > near:
            near, face = t0, -(i + 1) if way > 0.0 else i + 1
        far = min(far, t1)
    return (near, face) if 0.0 < near < far else (_FAR, 0)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _hash(i: int, j: int, k: int) -> float:
    """Return a number from 0 to 1 that looks drawn."""
    n = (i * 374761393 + j * 668265263 + k * 974711) & 0x7FFFFFFF
    n = ((n ^ (n >> 13)) * 1274126177) & 0x7FFFFFFF
    return float((n ^ (n >> 16)) & 0xFFFF) / 65535.0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _smooth(x: float, y: float, k: int) -> float:
    """Return noise, 0 to 1, that changes smoothly over a distance of one."""
    i, j = int(np.floor(x)), int(np.floor(y))
    u, v = x - i, y - j
    u, v = u * u * (3 - 2 * u), v * v * (3 - 2 * v)
    low = _hash(i, j, k) + u * (_hash(i + 1, j, k) - _hash(i, j, k))
    high = _hash(i, j + 1, k) + u * (_hash(i + 1, j + 1, k) - _hash(i, j + 1, k))
    return low + v * (high - low)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _texture(kind: int, x: float, y: float) -> float:
    """Return by how much a surface is brighter or darker at a place on it, m."""
    if kind == TILES:
        joint = min(abs(x / 0.4 - np.rint(x / 0.4)), abs(y / 0.4 - np.rint(y / 0.4)))
        return (0.9 + 0.2 * _hash(int(np.floor(x / 0.4)), int(np.floor(y / 0.4)), 1)) * (0.7 if joint < 0.01 else 1.0)
    if kind == GRAIN:  # boards of wood
        plank = int(np.floor(y / 0.15))
        seam = abs(y / 0.15 - np.rint(y / 0.15)) < 0.012
        rings = _smooth(x * 6.0 + 7.0 * plank, y * 90.0, plank)
        return (0.86 + 0.2 * rings + 0.1 * _hash(plank, 0, 5)) * (0.75 if seam else 1.0)
    if kind == PRINT:  # lines of words
        line, column = int(np.floor(y / 0.022)), int(np.floor(x / 0.007))
        on = (y / 0.022 - line) < 0.45 and _hash(line, column // 5, 3) > 0.25 and _hash(line, column, 9) > 0.2
        return 0.35 if on else 1.0
    return 0.97 + 0.06 * _smooth(x * 8.0, y * 8.0, 2)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _meet(o: Array, d: Array, boxes: Array, ends: Array, radius: Array) -> tuple[float, int, int]:
    """Return how far along a ray the first surface is, its number (boxes, then capsules; -1 none) and a box's face."""
    best, which, face = _FAR, -1, 0
    for k in range(boxes.shape[0]):
        t, side = _box(o, d, boxes[k])
        if t < best:
            best, which, face = t, k, side
    for k in range(ends.shape[0]):
        t = _capsule(o, d, ends[k, 0], ends[k, 1], radius[k])
        if t < best:
            best, which, face = t, boxes.shape[0] + k, 0
    return best, which, face


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _surface(p: Array, which: int, face: int, boxes: Array, ends: Array, radius: Array, n: Array) -> float:
    """Write a surface's normal at a point into n (3,) and return its texture's factor."""
    count = boxes.shape[0]
    if which >= count:
        k = which - count
        _capsule_normal(p, ends[k, 0], ends[k, 1], radius[k], n)
        return 1.0
    box = boxes[which]
    c, s = box[6], box[7]
    axis, way = abs(face) - 1, 1.0 if face > 0 else -1.0
    x, y, z = p[0] - box[0], p[1] - box[1], p[2] - box[2]
    x, y = c * x + s * y, c * y - s * x
    n[0], n[1], n[2] = 0.0, 0.0, 0.0
    if axis == 0:
        n[0], n[1] = way * c, way * s
        return _texture(int(box[9]), y, z)
    if axis == 1:
        n[0], n[1] = -way * s, way * c
        return _texture(int(box[9]), x, z)
    n[2] = way
    return _texture(int(box[9]), x, y)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def still(
    rays: Array,
    R_base_camera: Array,
    p_base: Array,
    boxes: Array,
    capsules: tuple[Array, Array, Array],
    lamp_base: Array,
    light: Light,
    depth: Light,
    ids: NDArray[np.int16],
) -> None:
    """Cast one ray a pixel at things that stand still, with the lamp's shadows.

    Args:
        rays: (H, W, 3) unit rays of the pixels, camera frame.
        R_base_camera: (3, 3) the camera's axes.
        p_base: (3,) where it is, m.
        boxes: (N, BOX).
        capsules: ends (K, 2, 3), m; radii (K,), m; albedos (K,).
        lamp_base: (3,) where the lamp is, m.
        light: (H, W) the light that comes from each pixel.
        depth: (H, W) distance of the surface, m.
        ids: (H, W) which surface it is: boxes, then capsules; -1 where there is none.
    """
    ends, radius, albedo = capsules
    d, p, n, way = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for v in range(rays.shape[0]):
        for u in range(rays.shape[1]):
            for i in range(3):
                d[i] = (
                    R_base_camera[i, 0] * rays[v, u, 0]
                    + R_base_camera[i, 1] * rays[v, u, 1]
                    + R_base_camera[i, 2] * rays[v, u, 2]
                )
            t, which, face = _meet(p_base, d, boxes, ends, radius)
            depth[v, u], ids[v, u] = t, which
            if which < 0:
                light[v, u] = _NOTHING
                continue
            far = 0.0
            for i in range(3):
                p[i] = p_base[i] + t * d[i]
                way[i] = lamp_base[i] - p[i]
                far += way[i] * way[i]
            factor = _surface(p, which, face, boxes, ends, radius, n)
            own = boxes[which, 8] if which < boxes.shape[0] else albedo[which - boxes.shape[0]]
            far = np.sqrt(far)
            cosine = 0.0
            for i in range(3):
                way[i] /= far
                cosine += n[i] * way[i]
                p[i] += _STEP * n[i]
            if cosine > 0.0 and _meet(p, way, boxes, ends, radius)[0] < far:
                cosine = 0.0
            light[v, u] = np.float32(own * factor * (AMBIENT + LAMP * max(cosine, 0.0)))
