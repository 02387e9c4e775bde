"""Paint all flat patterns that a camera sees in one exposure, before and behind what is there, in one go.

An exposure is a sum of steps; in each, patterns are painted over one another, the farthest first (``paint`` and
``paint_disc``), and what was there and is nearer is put back.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from armsight.data import Array, Ids, Image
from armsight.kernels import kernel, kernel_types
from armsight.sim.render.optics import Radiance, Window, gather_parts, spread_down
from armsight.sim.render.paint import SUB, Slots, paint, paint_disc
from armsight.sim.render.scene import CLEAR, Pattern


@kernel_types("f8[::1], f8[::1], f8[::1], f8[:, ::1], i8[:, ::1]")
class Palette(NamedTuple):
    """Patterns as the painter takes them, end to end: borders, m, cells with a clear rim, row by row, discs (K, 4).

    ``first`` (P + 1, 4): where each pattern's begin in these.
    """

    x_edges: Array
    y_edges: Array
    values: Array
    discs: Array
    first: Ids


@lru_cache(maxsize=64)
def palette(patterns: tuple[Pattern, ...]) -> Palette:
    """Return patterns laid end to end."""
    padded = [np.pad(pattern.values, 1, constant_values=CLEAR).ravel() for pattern in patterns]
    counts = [
        (len(pattern.x_edges), len(pattern.y_edges), len(values), len(pattern.discs))
        for pattern, values in zip(patterns, padded, strict=True)
    ]
    return Palette(
        np.concatenate([pattern.x_edges for pattern in patterns]),
        np.concatenate([pattern.y_edges for pattern in patterns]),
        np.concatenate(padded),
        np.concatenate([pattern.discs for pattern in patterns]),
        np.concatenate([np.zeros((1, 4), np.int64), np.cumsum(counts, axis=0)]),
    )


@kernel_types("Palette, f8[::1], i8[:, ::1], f8[:, :, :, :, ::1], i8[:, ::1]")
class Exposure(NamedTuple):
    """What is painted in an exposure of S steps, of P patterns with K discs; each step has a share (S,) of the light.

    ``order`` (S, P): of the patterns, -1 for those that do not face the camera; Ms (S, P, 1 or H, 3, 3): from rays to
    homogeneous coordinates of each plane, for all rows or for each; the third is 1 / depth along the ray; boxes (P + K,
    4): pixels that each pattern, then each disc, can cover: first column and row, end column and row, from the crop's
    corner.
    """

    palette: Palette
    weights: Array
    order: Ids
    Ms: Array
    boxes: Ids

    def shown(self) -> Ids:
        """Return the boxes (N, 4) of the patterns that face the camera."""
        seen = np.unique(self.order[self.order >= 0])
        return np.asarray(self.boxes[self.palette.first[seen, 3] + seen])


@kernel(nogil=True)
def _nearness(rays: Radiance, M: Array, v: int, u: int) -> float:
    """Return 1 / distance, 1/m, at which a pixel's ray meets a pattern's plane."""
    return float(M[2, 0] * rays[0, v, u] + M[2, 1] * rays[1, v, u] + M[2, 2] * rays[2, v, u])


@kernel(nogil=True)
def _put_back(
    rays: Radiance,
    Ms: Array,
    box: Window,
    corner: tuple[int, int],
    behind: tuple[Radiance, Radiance, Image],
    nearest: Radiance,
    coarse: Array,
    slot: Slots,
) -> None:
    """Put back what is nearer than a pattern that was painted over it; ``nearest`` (H,) is how near that is in each row."""
    light, depth, ids = behind
    u0, v0, u1, v1 = box
    for v in range(v0, v1 if u0 < u1 else v0):
        M, y = Ms[min(v, Ms.shape[0] - 1)], v + corner[1]
        # It has no least within the row: that is at an end.
        if min(_nearness(rays, M, y, u0 + corner[0]), _nearness(rays, M, y, u1 - 1 + corner[0])) * nearest[v] >= 1.0:
            continue
        for u in range(u0, u1):
            if ids[v, u] != 0 and _nearness(rays, M, y, u + corner[0]) * depth[v, u] < 1.0:
                coarse[v, u] = light[v, u]
                slot[v, u] = -1


@kernel(nogil=True, fastmath={"nnan", "nsz"})
def _nearest(depth: Radiance, ids: Image, out: Radiance) -> None:
    """Write how near the nearest pixel that has an id is in each row (H,), m."""
    for v in range(out.size):
        least = np.float32(np.inf)
        for u in range(depth.shape[1]):
            there = depth[v, u] if ids[v, u] != 0 else np.float32(np.inf)
            least = there if there < least else least
        out[v] = least


@kernel(
    "f8[:, :, ::1], f4[:, :, ::1], Exposure, (i8, i8), (f4[:, :], f4[:, :], i2[:, :]), f4[:, ::1], f4[:, ::1], "
    "f4[:, ::1]",
    nogil=True,
)
def paint_faces(
    corners: Array,
    rays: Radiance,
    exposure: Exposure,
    corner: tuple[int, int],
    behind: tuple[Radiance, Radiance, Image],
    taps: Radiance,
    total: Radiance,
    edges: Radiance,
) -> None:
    """Paint an exposure of flat patterns over an image (H, W), a crop of the camera's that begins at ``corner``.

    ``corners``: rays through the corners of all pixels, camera's frame; ``rays`` (3, ...): unit rays of the pixels;
    ``behind``: light, distance, m, and ids of what is there, each (H, W), which is behind all patterns where it has no
    id. Written are ``total`` (H, W), the light on each pixel before the lens, and added to ``edges`` (H, W) what the
    lens adds to the blur of that, for edges lie within pixels.
    """
    palette, weights, order, every_M, boxes = exposure
    light, depth, ids = behind
    shape, count, nearest = light.shape, 0, np.empty(light.shape[0], np.float32)
    _nearest(depth, ids, nearest)
    coarse, slot, fine = np.empty(shape), np.empty(shape, np.int32), np.empty((1 << 11, SUB, SUB))
    across = np.zeros((SUB * shape[0], shape[1] + taps.shape[1] - 1), np.float32)
    total[:] = np.float32(0.0)
    for step in range(len(weights)):
        coarse[:], slot[:], count = light, -1, 0
        for p in order[step]:
            if p < 0:
                continue
            (x0, y0, value0, disc0), (x1, y1, value1, disc1) = palette.first[p], palette.first[p + 1]
            values = palette.values[value0:value1].reshape((y1 - y0 + 1, x1 - x0 + 1))
            grid, Ms = (palette.x_edges[x0:x1], palette.y_edges[y0:y1], values), every_M[step, p]
            at = p + disc0
            box = (boxes[at, 0], boxes[at, 1], boxes[at, 2], boxes[at, 3])
            fine, count = paint(corners, Ms, box, corner, grid, coarse, slot, fine, count)
            for k in range(disc0, disc1):
                at += 1
                round_box = (boxes[at, 0], boxes[at, 1], boxes[at, 2], boxes[at, 3])
                disc = palette.discs[k]
                fine, count = paint_disc(corners, Ms, round_box, corner, disc, coarse, slot, fine, count)
            _put_back(rays, Ms, box, corner, behind, nearest, coarse, slot)
        gather_parts(slot, fine, taps, weights[step], coarse, across)
        for v in range(shape[0]):
            for u in range(shape[1]):
                total[v, u] += np.float32(weights[step] * coarse[v, u])
    spread_down(across, taps, edges)
