"""What stands in the cell: table, floor, wall, clutter, the arm's links; where a camera sees each of them.

All in the base frame: x runs away from the wall, towards the cameras; z up; the table's top is z = 0.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Ids, Image, Record
from armsight.geometry.pose import inverse, transform
from armsight.sim.workcell import raycast as cell_rays
from armsight.sim.workcell.raycast import (BOX, BUNCH, GRAIN, PLAIN, PRINT, TILES)
from armsight.sim.cell_solids import Solids
from armsight.vision.camera import Camera

#: Where the lamp hangs, m.
LAMP_BASE = np.array([1.5, -1.1, 2.2])
#: Albedo of the links and of the joints' housings.
LINK_ALBEDO, HOUSING_ALBEDO = 0.62, 0.30
_EDGE = 0.02  # light that changes by more from a pixel to its neighbours is looked at more closely
_TILE = math.isqrt(BUNCH)
_SAMPLES = ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25))


@dataclass(frozen=True, eq=False)
class View(Record):
    """What stands still before a camera.

    Attributes:
        light: (H, W) light on each pixel before the lens.
        depth: (H, W) distance of the surface, m.
        ids: (H, W) which surface it is.
    """

    light: NDArray[np.float32]
    depth: NDArray[np.float32]
    ids: Image


def block(
    middle: tuple[float, float, float],
    size: tuple[float, float, float],
    turn_deg: float = 0.0,
    albedo: float = 0.5,
    texture: int = PLAIN,
) -> Array:
    """Return a row of boxes (BOX,): middle and size, m; turn about z; albedo and texture."""
    turn = np.radians(turn_deg)
    return np.array([*middle, *(0.5 * s for s in size), np.cos(turn), np.sin(turn), albedo, texture])


def _standing(x: float, y: float, height: float, radius: float) -> tuple[Array, float]:
    """Return a round thing on the table."""
    return np.array([[x, y, radius], [x, y, max(height - radius, radius)]]), radius


def furniture(seed: int) -> tuple[Array, tuple[Array, Array, Array]]:
    """Return what stands still: boxes (N, BOX), and capsules as the rays take them.

    Args:
        seed: of where the clutter stands.
    """
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


def corner_rays(camera: Camera) -> Array:
    """Return the rays (H + 1, W + 1, 3) of depth one through the corners of a camera's pixels."""
    width, height = camera.image_size_px
    v, u = np.mgrid[: height + 1, : width + 1] - 0.5
    rays = camera.unproject(np.stack([u.ravel(), v.ravel()], axis=1)).reshape(height + 1, width + 1, 3)
    return np.asarray(rays / rays[..., 2:])


def pixel_rays(corners: Array) -> Array:
    """Return the unit rays (H, W, 3) of pixels from those of their corners, good to a thousandth of a pixel."""
    rays = corners[1:, 1:] + corners[:-1, 1:] + corners[1:, :-1] + corners[:-1, :-1]
    return np.asarray(rays / np.linalg.norm(rays, axis=2, keepdims=True))


def view(camera: Camera, rays: Array, T_base_camera: Array, seed: int, foot: Solids, more: Array | None = None) -> View:
    """Return what stands still before a camera: a ray a pixel, four more where light changes.

    Args:
        camera: the camera.
        rays: (H, W, 3) its pixels'.
        T_base_camera: (4, 4) where it is, m.
        seed: of the clutter.
        foot: the arm's solids; its base stands still.
        more: boxes (N, BOX) that stand there besides.
    """
    boxes, (ends, radius, albedo) = furniture(seed)
    if more is not None:
        boxes = np.concatenate([boxes, more])
    still = foot.link == 0
    ends, radius = np.concatenate([ends, foot.ends[still]]), np.append(radius, foot.radius[still])
    capsules = (ends, radius, np.append(albedo, np.full(int(still.sum()), HOUSING_ALBEDO)))
    R, p = np.ascontiguousarray(T_base_camera[:3, :3]), np.ascontiguousarray(T_base_camera[:3, 3])

    def cast(some: Array) -> tuple[NDArray[np.float32], NDArray[np.float32], Image]:
        out = (np.empty(len(some), np.float32), np.empty(len(some), np.float32), np.empty(len(some), np.int16))
        cell_rays.still(some, R, p, boxes, capsules, LAMP_BASE, *out)
        return out

    height, width = rays.shape[:2]
    order = _tiled(height, width)
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    light, depth, ids = (flat[place].reshape(height, width) for flat in cast(rays.reshape(-1, 3)[order]))
    square = np.ones((3, 3), np.uint8)
    again = (cv2.dilate(light, square) - cv2.erode(light, square) > _EDGE).ravel()
    edges = order[again[order]]
    v, u = np.divmod(edges, width)
    light[v, u] = np.mean([cast(camera.unproject(np.stack([u + x, v + y], axis=1)))[0] for x, y in _SAMPLES], axis=0)
    return View(light, depth, ids)


def _tiled(height: int, width: int) -> Ids:
    """Return the pixels (H W,) of an image, row after row, in the order of small tiles: neighbours follow each other."""
    rows = np.arange(height * width).reshape(height, width)
    tiles = itertools.product(range(0, height, _TILE), range(0, width, _TILE))
    return np.concatenate([rows[v : v + _TILE, u : u + _TILE].ravel() for v, u in tiles])


def arm_capsules(parts: Solids, Ts_base_link: Array, T_base_camera: Array) -> tuple[Array, Array, Array]:
    """Return the arm's moving solids, but its load, as the rays take them, in a camera's frame.

    Args:
        parts: what the arm is made of.
        Ts_base_link: (7, 4, 4) row frames.
        T_base_camera: (4, 4) where the camera is, m.
    """
    shown = np.flatnonzero(parts.link > 0)[:-1]
    Ts = inverse(T_base_camera) @ Ts_base_link[parts.link[shown]]
    ends = transform(Ts[:, None], parts.ends[shown])
    return ends, parts.radius[shown].copy(), np.where(parts.housing[shown], HOUSING_ALBEDO, LINK_ALBEDO)


_CUBE = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])


def capsule_boxes(camera: Camera, ends: Array, radius: Array) -> Ids:
    """Return (K, 4) the pixels that capsules can cover: first column, first row, end column, end row.

    Args:
        camera: the camera.
        ends: (K, 2, 3), m, its frame.
        radius: (K,) m.
    """
    corners = ends[:, :, None] + radius[:, None, None, None] * _CUBE
    size = np.array(camera.image_size_px)
    uv = camera.project(corners.reshape(-1, 3)).reshape(len(radius), 2 * len(_CUBE), 2)
    near = ~(corners[..., 2] > 0.05).all(axis=(1, 2))  # too close to be bounded by its corners
    low = np.clip(np.floor(np.nan_to_num(uv.min(axis=1))) - 1, 0, size)
    high = np.clip(np.ceil(np.nan_to_num(uv.max(axis=1))) + 2, 0, size)
    low[near], high[near] = 0, size
    return np.concatenate([low, high], axis=1).astype(np.int64)
