"""Cast rays at capsules and boxes: what an arm and the things around it look like, without GL.

Surfaces are dull: a lamp's light falls off with the cosine, and some comes from everywhere (Lambert; a Phong highlight on
capsules). Capsules are met as in the closed form for a swept sphere: the cylinder's quadratic, or that of the nearer end.

All compiled functions that call each other stay in this file: numba's cache on disk looks at one file's age only.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Ids, Image

#: Share of the light that comes from everywhere, of the lamp's, and of its reflection.
AMBIENT, LAMP, GLOSS = 0.45, 0.75, 0.25
#: Columns of a box: middle 0-2, half sides 3-5, cosine and sine of its turn about z 6, 7; albedo 8, texture 9.
BOX = 10
PLAIN, TILES, GRAIN, PRINT = 0, 1, 2, 3
_FAR = 1e9
_NOTHING = np.float32(0.25)  # light from where nothing is
_ORIGIN = np.zeros(3)
_TILE = 16  # pixels on a side that are passed over together
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


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _axis(a: Array, b: Array, radius: float, out: Array) -> None:
    """Write into out (11,) what of a capsule between a and b :func:`_side` and :func:`_row` ask for: all but the ray."""
    bx, by, bz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    long = max(bx * bx + by * by + bz * bz, 1e-12)  # a ball has no length
    ba = -(bx * a[0] + by * a[1] + bz * a[2])
    out[0], out[1], out[2], out[3], out[4] = bx, by, bz, long, ba
    out[5] = long * (a[0] * a[0] + a[1] * a[1] + a[2] * a[2] - radius * radius) - ba * ba
    out[6], out[7], out[8] = by * a[2] - bz * a[1], bz * a[0] - bx * a[2], bx * a[1] - by * a[0]
    out[9] = a[0] * a[0] + a[1] * a[1] + a[2] * a[2] - radius * radius
    out[10] = b[0] * b[0] + b[1] * b[1] + b[2] * b[2] - radius * radius


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _side(d: Array, a: Array, axis: Array) -> int:
    """Return on which side the unit ray d (3,) from the origin passes a cylinder without ends: 1, -1; 0 where it meets."""
    bd = axis[0] * d[0] + axis[1] * d[1] + axis[2] * d[2]
    B = -axis[3] * (a[0] * d[0] + a[1] * d[1] + a[2] * d[2]) - axis[4] * bd
    if (axis[3] - bd * bd) * axis[5] <= B * B:
        return 0
    return 1 if axis[6] * d[0] + axis[7] * d[1] + axis[8] * d[2] > 0.0 else -1


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _row(
    x: Array,
    y: Array,
    z: Array,
    a: Array,
    axis: Array,
    radius: float,
    shown: tuple[float, int],
    lamp: Array,
    light: Array,
    depth: Light,
    ids: Image,
) -> None:
    """Draw a capsule into a part of a row: its rays (n,) x, y, z; its light, depth and ids. Without branches.

    Light falls off with the cosine to the lamp, and what faces away from the viewer is a little darker: that tells one
    link from the next. ``shown`` is the capsule's albedo and its id.
    """
    bx, by, bz, long, ba, C = axis[0], axis[1], axis[2], axis[3], axis[4], axis[5]
    for u in range(x.size):
        ad = a[0] * x[u] + a[1] * y[u] + a[2] * z[u]
        bd = bx * x[u] + by * y[u] + bz * z[u]
        A, B = max(long - bd * bd, 1e-12 * long), -long * ad - ba * bd
        h = B * B - A * C
        t = (-B - np.sqrt(max(h, 0.0))) / A
        along = (ba + t * bd) / long
        end = 0.0 if along < 0.5 else 1.0
        # The ball at the nearer end, where the cylinder is met beyond it.
        ed = ad + end * bd
        ball = ed * ed - (axis[9] + end * (axis[10] - axis[9]))
        between = 0.0 < along < 1.0
        t = t if between else ed - np.sqrt(max(ball, 0.0))
        seen = (h if between else ball) >= 0.0 and 0.0 < t < depth[u]
        along = min(max((ba + t * bd) / long, 0.0), 1.0)
        nx = (t * x[u] - a[0] - along * bx) / radius
        ny = (t * y[u] - a[1] - along * by) / radius
        nz = (t * z[u] - a[2] - along * bz) / radius
        cosine = nx * lamp[0] + ny * lamp[1] + nz * lamp[2]
        away = nx * x[u] + ny * y[u] + nz * z[u]
        lamp_d = lamp[0] * x[u] + lamp[1] * y[u] + lamp[2] * z[u]
        mirror = max(2 * cosine * away - lamp_d, 0.0) if cosine > 0.0 else 0.0
        square = mirror * mirror
        square = square * square
        square = square * square
        shade = (AMBIENT + LAMP * max(cosine, 0.0)) * (0.75 - 0.25 * away) + GLOSS * square * square
        light[u] = shown[0] * shade if seen else light[u]
        depth[u] = np.float32(t) if seen else depth[u]
        ids[u] = shown[1] if seen else ids[u]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def moving(
    rays: Array,
    window: tuple[int, int, int, int],
    boxes_px: Ids,
    capsules: tuple[Array, Array, Array],
    lamp: Array,
    light: Array,
    depth: Light,
    ids: Image,
) -> None:
    """Draw capsules over an image that knows its depths; all is in the camera's frame.

    Args:
        rays: (3, H, W) unit rays of all pixels.
        window: first column, first row, end column, end row of the image that ``light``, ``depth`` and ``ids`` are of.
        boxes_px: (K, 4) the same of what each capsule can cover.
        capsules: ends (K, 2, 3), m; radii (K,), m; albedos (K,).
        lamp: (3,) unit vector to the lamp.
        light: drawn over.
        depth: distance of what is there, m; brought up to date.
        ids: the number of the capsule that is drawn, counted from 1, is written here.
    """
    ends, radius, albedo = capsules
    u_first, v_first, u_end, v_end = window
    axis, d = np.empty(11), np.empty(3)
    for k in np.argsort(ends[:, 0, 2] + ends[:, 1, 2]):  # what is near first: it hides the rest
        a, b = ends[k, 0], ends[k, 1]
        _axis(a, b, radius[k], axis)
        u0, u1 = max(boxes_px[k, 0], u_first), min(boxes_px[k, 2], u_end)
        v0, v1 = max(boxes_px[k, 1], v_first), min(boxes_px[k, 3], v_end)
        for v_tile in range(v0, v1, _TILE):
            v_last = min(v_tile + _TILE, v1)
            for u_tile in range(u0, u1, _TILE):
                u_last = min(u_tile + _TILE, u1)
                sides = 0
                for corner in range(4):
                    v, u = (v_tile if corner < 2 else v_last - 1), (u_tile if corner % 2 else u_last - 1)
                    d[0], d[1], d[2] = rays[0, v, u], rays[1, v, u], rays[2, v, u]
                    sides += _side(d, a, axis)
                if abs(sides) == 4:  # all of the tile is to one side of it
                    continue
                for v in range(v_tile, v_last):
                    x, y, z = rays[0, v, u_tile:u_last], rays[1, v, u_tile:u_last], rays[2, v, u_tile:u_last]
                    row, first, last = v - v_first, u_tile - u_first, u_last - u_first
                    parts = light[row, first:last], depth[row, first:last], ids[row, first:last]
                    _row(x, y, z, a, axis, radius[k], (albedo[k], k + 1), lamp, parts[0], parts[1], parts[2])
