"""Cast rays at capsules and boxes: what stands still around the arm (table, floor, wall, clutter), without GL.

In: a camera, its pose T_base_camera and a seed. Out: a :class:`StillView`: light, depth and surface of each pixel. All is
in the base frame: x runs away from the wall, towards the cameras; z up; the table's top is z = 0.

Surfaces are dull: a lamp's light falls off with the cosine, and some comes from everywhere (Lambert). Capsules are met as
in the closed form for a swept sphere: the cylinder's quadratic, or that of the nearer end.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Ids, Image, Record
from armsight.geometry.matrix import product
from armsight.geometry.pose import inverse, transform
from armsight.kernels import kernel
from armsight.sim.workcell.motors import Solids
from armsight.vision.camera import Camera

#: Share of the light that comes from everywhere, and of the lamp's.
AMBIENT, LAMP = 0.45, 0.75
#: Columns of a box: middle 0-2, half sides 3-5, cosine and sine of its rotation about z 6, 7; albedo 8, texture 9.
BOX = 10
PLAIN, TILES, GRAIN, PRINT = 0, 1, 2, 3
_FAR = 1e9
_NOTHING = np.float32(0.25)  # light from where nothing is
_STEP = 1e-4  # a shadow's ray starts so far off its surface, m
BUNCH = 256  # rays that are cast together
_WIDER = 1e-6  # rad

Light = NDArray[np.float32]


@kernel(nogil=True)
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


@kernel(nogil=True)
def _capsule_normal(p: Array, a: Array, b: Array, radius: float, out: Array) -> None:
    """Write the outward unit normal of a capsule at a point of its surface."""
    baba = along = 0.0
    for i in range(3):
        baba += (b[i] - a[i]) ** 2
        along += (p[i] - a[i]) * (b[i] - a[i])
    t = min(max(along / baba, 0.0), 1.0) if baba > 0.0 else 0.0
    for i in range(3):
        out[i] = (p[i] - a[i] - t * (b[i] - a[i])) / radius


@kernel(nogil=True)
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


@kernel(nogil=True)
def _hash(i: int, j: int, k: int) -> float:
    """Return a number from 0 to 1 that looks random."""
    n = (i * 374761393 + j * 668265263 + k * 974711) & 0x7FFFFFFF
    n = ((n ^ (n >> 13)) * 1274126177) & 0x7FFFFFFF
    return float((n ^ (n >> 16)) & 0xFFFF) / 65535.0


@kernel(nogil=True)
def _smooth(x: float, y: float, k: int) -> float:
    """Return noise, 0 to 1, that changes smoothly over a distance of one."""
    i, j = int(np.floor(x)), int(np.floor(y))
    u, v = x - i, y - j
    u, v = u * u * (3 - 2 * u), v * v * (3 - 2 * v)
    low = _hash(i, j, k) + u * (_hash(i + 1, j, k) - _hash(i, j, k))
    high = _hash(i, j + 1, k) + u * (_hash(i + 1, j + 1, k) - _hash(i, j + 1, k))
    return low + v * (high - low)


@kernel(nogil=True)
def _texture(kind: int, x: float, y: float) -> float:
    """Return by how much a surface is brighter or darker at a point on it, m."""
    if kind == TILES:
        joint = min(abs(x / 0.4 - np.rint(x / 0.4)), abs(y / 0.4 - np.rint(y / 0.4)))
        return (0.9 + 0.2 * _hash(int(np.floor(x / 0.4)), int(np.floor(y / 0.4)), 1)) * (0.7 if joint < 0.01 else 1.0)
    if kind == GRAIN:  # boards of wood
        plank = int(np.floor(y / 0.15))
        seam = abs(y / 0.15 - np.rint(y / 0.15)) < 0.012
        rings = _smooth(x * 6.0 + 7.0 * plank, y * 90.0, plank)
        return (0.86 + 0.2 * rings + 0.1 * _hash(plank, 0, 5)) * (0.75 if seam else 1.0)
    if kind == PRINT:  # lines of print
        line, column = int(np.floor(y / 0.022)), int(np.floor(x / 0.007))
        on = (y / 0.022 - line) < 0.45 and _hash(line, column // 5, 3) > 0.25 and _hash(line, column, 9) > 0.2
        return 0.35 if on else 1.0
    return 0.97 + 0.06 * _smooth(x * 8.0, y * 8.0, 2)


@kernel(nogil=True)
def _balls(boxes: Array, ends: Array, radius: Array) -> Array:
    """Return a ball (middle, radius) around each surface, boxes, then capsules, with room for a shadow ray's step."""
    count = boxes.shape[0]
    balls = np.empty((count + ends.shape[0], 4))
    balls[:count, :3] = boxes[:, :3]
    balls[:count, 3] = np.sqrt((boxes[:, 3:6] ** 2).sum(axis=1)) + _STEP
    for k in range(ends.shape[0]):
        balls[count + k, :3] = 0.5 * (ends[k, 0] + ends[k, 1])
        balls[count + k, 3] = 0.5 * np.sqrt(((ends[k, 1] - ends[k, 0]) ** 2).sum()) + radius[k] + _STEP
    return balls


@kernel(nogil=True)
def _ahead(o: Array, ways: Array, balls: Array, keep: NDArray[np.int64]) -> int:
    """Write to keep which balls rays from o along unit vectors (N, 3) may meet, and return how many: those in a cone."""
    axis = ways.sum(axis=0)
    axis /= np.sqrt((axis**2).sum())
    narrow = 1.0
    for j in range(ways.shape[0]):
        narrow = min(narrow, axis[0] * ways[j, 0] + axis[1] * ways[j, 1] + axis[2] * ways[j, 2])
    opening, count = np.arccos(narrow) + _WIDER, 0
    for k in range(balls.shape[0]):
        x, y, z = balls[k, 0] - o[0], balls[k, 1] - o[1], balls[k, 2] - o[2]
        away = np.sqrt(x * x + y * y + z * z)
        if away > balls[k, 3]:
            cosine = (x * axis[0] + y * axis[1] + z * axis[2]) / away
            if np.arccos(min(max(cosine, -1.0), 1.0)) > opening + np.arcsin(balls[k, 3] / away):
                continue
        keep[count] = k
        count += 1
    return count


@kernel(nogil=True)
def _meet(
    o: Array, d: Array, boxes: Array, ends: Array, radius: Array, keep: NDArray[np.int64]
) -> tuple[float, int, int]:
    """Return how far along a ray the first of the surfaces in keep is, its number (-1 none) and a box's face."""
    best, which, face = _FAR, -1, 0
    for k in keep:
        if k < boxes.shape[0]:
            t, side = _box(o, d, boxes[k])
        else:
            i = k - boxes.shape[0]
            t, side = _capsule(o, d, ends[i, 0], ends[i, 1], radius[i]), 0
        if t < best:
            best, which, face = t, k, side
    return best, which, face


@kernel(nogil=True)
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


@kernel(
    "f8[:, ::1], f8[:, ::1], f8[::1], f8[:, ::1], (f8[:, :, ::1], f8[::1], f8[::1]), f8[::1], f4[::1], f4[::1], "
    "i2[::1]",
    nogil=True,
)
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

    Rays are cast in bunches: what lies outside the cone around a bunch, from the camera or from the lamp, none of it meets.

    Args:
        rays: (N, 3) unit rays of the pixels, camera frame; those that follow each other had best be close together.
        R_base_camera: (3, 3) the camera's axes.
        p_base: (3,) where it is, m.
        boxes: (M, BOX).
        capsules: ends (K, 2, 3), m; radii (K,), m; albedos (K,).
        lamp_base: (3,) where the lamp is, m.
        light: (N,) the light that comes from each pixel.
        depth: (N,) distance of the surface, m.
        ids: (N,) which surface it is: boxes, then capsules; -1 where there is none.
    """
    ends, radius, albedo = capsules
    balls, n = _balls(boxes, ends, radius), np.empty(3)
    keep, from_lamp, to_lamp = np.empty(len(balls), np.int64), np.empty((BUNCH, 3)), np.empty(3)
    p, far, faces = np.empty((BUNCH, 3)), np.empty(BUNCH), np.empty(BUNCH, np.int64)
    for begin in range(0, rays.shape[0], BUNCH):
        ways = product(rays[begin : begin + BUNCH], R_base_camera.T)
        seen, lit = keep[: _ahead(p_base, ways, balls, keep)], 0
        for j in range(ways.shape[0]):
            t, which, face = _meet(p_base, ways[j], boxes, ends, radius, seen)
            depth[begin + j], ids[begin + j] = t, which
            if which < 0:
                light[begin + j] = _NOTHING
                continue
            faces[lit], far[lit] = face, 0.0
            for i in range(3):
                p[lit, i] = p_base[i] + t * ways[j, i]
                from_lamp[lit, i] = p[lit, i] - lamp_base[i]
                far[lit] += from_lamp[lit, i] ** 2
            far[lit] = np.sqrt(far[lit])
            for i in range(3):
                from_lamp[lit, i] /= far[lit]
            lit += 1
        shade = keep[: _ahead(lamp_base, from_lamp[:lit], balls, keep)] if lit else keep[:0]
        k = 0
        for j in range(begin, begin + ways.shape[0]):
            which = ids[j]
            if which < 0:
                continue
            factor = _surface(p[k], which, faces[k], boxes, ends, radius, n)
            own = boxes[which, 8] if which < boxes.shape[0] else albedo[which - boxes.shape[0]]
            cosine = 0.0
            for i in range(3):
                to_lamp[i] = -from_lamp[k, i]
                cosine += n[i] * to_lamp[i]
                p[k, i] += _STEP * n[i]
            if cosine > 0.0 and _meet(p[k], to_lamp, boxes, ends, radius, shade)[0] < far[k]:
                cosine = 0.0
            light[j] = np.float32(own * factor * (AMBIENT + LAMP * max(cosine, 0.0)))
            k += 1


#: Where the lamp hangs, m.
LAMP_BASE = np.array([1.5, -1.1, 2.2])
#: Albedo of the links and of the joints' housings.
LINK_ALBEDO, HOUSING_ALBEDO = 0.62, 0.30
_EDGE = 0.02  # light that changes by more from a pixel to its neighbours is looked at more closely
_TILE = math.isqrt(BUNCH)
_SAMPLES = ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25))


@dataclass(frozen=True, eq=False)
class StillView(Record):
    """What stands still before a camera."""

    light: NDArray[np.float32]  #: (H, W) light on each pixel before the lens
    depth: NDArray[np.float32]  #: (H, W) distance of the surface, m
    ids: Image  #: (H, W) which surface it is


def block(
    middle: tuple[float, float, float],
    size: tuple[float, float, float],
    rotation_deg: float = 0.0,
    albedo: float = 0.5,
    texture: int = PLAIN,
) -> Array:
    """Return a row of boxes (BOX,): middle and size, m; rotation about z; albedo and texture."""
    angle = np.radians(rotation_deg)
    return np.array([*middle, *(0.5 * s for s in size), np.cos(angle), np.sin(angle), albedo, texture])


def _standing(x: float, y: float, height: float, radius: float) -> tuple[Array, float]:
    """Return a round thing on the table."""
    return np.array([[x, y, radius], [x, y, max(height - radius, radius)]]), radius


def furniture(seed: int) -> tuple[Array, tuple[Array, Array, Array]]:
    """Return what stands still: boxes (N, BOX), and capsules as the rays take them; a seed says where clutter stands."""
    rng = np.random.default_rng([seed, 5])
    boxes = [
        block((0.25, 0.0, -0.02), (1.5, 1.7, 0.04), albedo=0.55, texture=GRAIN),
        block((0.9, 0.0, -0.76), (6.0, 7.0, 0.04), albedo=0.45, texture=TILES),
        block((-1.3, 0.0, 0.8), (0.04, 7.0, 3.4), albedo=0.58),
        *(block((x, y, -0.39), (0.06, 0.06, 0.7), albedo=0.25) for x in (-0.45, 0.9) for y in (-0.78, 0.78)),
        block((-1.27, -0.75, 0.75), (0.02, 0.62, 0.8), albedo=0.75, texture=PRINT),
        block((-1.27, 0.95, 0.85), (0.02, 0.8, 0.55), albedo=0.22),
        block((-1.14, 0.3, 0.28), (0.30, 1.9, 0.03), albedo=0.35, texture=GRAIN),
        block((-1.14, -0.62, -0.25), (0.30, 0.05, 1.06), albedo=0.35),
        block((-1.14, 1.2, -0.25), (0.30, 0.05, 1.06), albedo=0.35),
        block((-0.25, 0.58, 0.16), (0.04, 0.46, 0.28), 20.0, albedo=0.12),
        block((-0.24, 0.58, 0.01), (0.16, 0.2, 0.02), 20.0, albedo=0.2),
    ]
    for y in (-0.45, -0.3, -0.2, 0.1, 0.22, 0.6, 0.95):  # on the shelf
        tall = rng.uniform(0.1, 0.32)
        size = (0.2, rng.uniform(0.05, 0.13), tall)
        boxes.append(block((-1.14, y, 0.295 + tall / 2), size, rng.uniform(-8, 8), rng.uniform(0.15, 0.8)))
    for x, y in ((-0.28, -0.45), (-0.1, -0.62), (0.12, 0.62), (0.35, -0.64)):  # on the table, out of the arm's way
        sides = rng.uniform(0.06, 0.16, 3)
        size = (float(sides[0]), float(sides[1]), float(sides[2]))
        at = (x + rng.uniform(-0.03, 0.03), y + rng.uniform(-0.03, 0.03), size[2] / 2)
        boxes.append(block(at, size, rng.uniform(0, 90), rng.uniform(0.25, 0.7), int(rng.choice([PLAIN, PRINT]))))
    round_things = [
        _standing(0.02, -0.52, 0.12, 0.04),
        _standing(-0.3, 0.2, 0.22, 0.035),
        _standing(0.3, 0.7, 0.1, 0.045),
    ]
    ends, radii = (np.array(column) for column in zip(*round_things, strict=True))
    table = np.array(boxes)
    assert table.shape[1] == BOX
    return table, (ends, radii, rng.uniform(0.3, 0.75, len(radii)))


def pixel_rays(corners: Array) -> Array:
    """Return the unit rays (H, W, 3) of pixels from those of their corners, good to a thousandth of a pixel."""
    rays = corners[1:, 1:] + corners[:-1, 1:] + corners[1:, :-1] + corners[:-1, :-1]
    return np.asarray(rays / np.linalg.norm(rays, axis=2, keepdims=True))


def view(
    camera: Camera, rays: Array, T_base_camera: Array, seed: int, foot: Solids, more: Array | None = None
) -> StillView:
    """Return what stands still before a camera: a ray a pixel, four more where light changes.

    ``rays``: (H, W, 3) its pixels'. ``T_base_camera``: (4, 4) where it is, m. ``foot``: the arm's solids; its base stands
    still. ``more``: boxes (N, BOX) that stand there besides.
    """
    boxes, (ends, radius, albedo) = furniture(seed)
    if more is not None:
        boxes = np.concatenate([boxes, more])
    fixed = foot.link == 0
    ends, radius = np.concatenate([ends, foot.ends[fixed]]), np.append(radius, foot.radius[fixed])
    capsules = (ends, radius, np.append(albedo, np.full(int(fixed.sum()), HOUSING_ALBEDO)))
    R, p = np.ascontiguousarray(T_base_camera[:3, :3]), np.ascontiguousarray(T_base_camera[:3, 3])

    def cast(some: Array) -> tuple[NDArray[np.float32], NDArray[np.float32], Image]:
        out = (np.empty(len(some), np.float32), np.empty(len(some), np.float32), np.empty(len(some), np.int16))
        still(some, R, p, boxes, capsules, LAMP_BASE, *out)
        return out

    height, width = rays.shape[:2]
    order = _tiled(height, width)
    inverse_order = np.empty_like(order)
    inverse_order[order] = np.arange(len(order))
    light, depth, ids = (flat[inverse_order].reshape(height, width) for flat in cast(rays.reshape(-1, 3)[order]))
    square = np.ones((3, 3), np.uint8)
    again = (cv2.dilate(light, square) - cv2.erode(light, square) > _EDGE).ravel()
    edges = order[again[order]]
    v, u = np.divmod(edges, width)
    light[v, u] = np.mean([cast(camera.unproject(np.stack([u + x, v + y], axis=1)))[0] for x, y in _SAMPLES], axis=0)
    return StillView(light, depth, ids)


def _tiled(height: int, width: int) -> Ids:
    """Return the pixels (H W,) of an image, row after row, in the order of small tiles: neighbours follow each other."""
    rows = np.arange(height * width).reshape(height, width)
    tiles = itertools.product(range(0, height, _TILE), range(0, width, _TILE))
    return np.concatenate([rows[v : v + _TILE, u : u + _TILE].ravel() for v, u in tiles])


def arm_capsules(parts: Solids, Ts_base_link: Array, T_base_camera: Array) -> tuple[Array, Array, Array]:
    """Return the arm's moving solids, but its load, as the rays take them, in a camera's frame.

    ``parts``: what the arm is made of; ``Ts_base_link``: (n + 1, 4, 4) row frames; ``T_base_camera``: (4, 4) where the
    camera is, m.
    """
    shown = np.flatnonzero(parts.link > 0)[:-1]
    Ts = inverse(T_base_camera) @ Ts_base_link[parts.link[shown]]
    ends = transform(Ts[:, None], parts.ends[shown])
    return ends, parts.radius[shown].copy(), np.where(parts.housing[shown], HOUSING_ALBEDO, LINK_ALBEDO)


_CUBE = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])


def capsule_boxes(camera: Camera, ends: Array, radius: Array) -> Ids:
    """Return (K, 4) the pixels that capsules can cover: first column, first row, end column, end row.

    ``ends``: (K, 2, 3), m, its frame; ``radius``: (K,) m.
    """
    corners = ends[:, :, None] + radius[:, None, None, None] * _CUBE
    size = np.array(camera.image_size_px)
    uv = camera.project(corners.reshape(-1, 3)).reshape(len(radius), 2 * len(_CUBE), 2)
    near = ~(corners[..., 2] > 0.05).all(axis=(1, 2))  # too close to be bounded by its corners
    low = np.clip(np.floor(np.nan_to_num(uv.min(axis=1))) - 1, 0, size)
    high = np.clip(np.ceil(np.nan_to_num(uv.max(axis=1))) + 2, 0, size)
    low[near], high[near] = 0, size
    return np.concatenate([low, high], axis=1).astype(np.int64)
