"""Paint flat patterns into an image by exact area sampling.

The corners of all pixels are cast as rays through the full camera model. A ray meets a pattern's plane at homogeneous
coordinates that are linear in the ray, so inside a pixel they are interpolated linearly from its four corners (exact
for a pinhole, good to 1e-4 px for any lens); every straight edge of the pattern is a straight cut through the pixel.
A pixel that lies in one cell takes its value. A pixel that an edge crosses is split into SUB x SUB parts, and the value
of each is exact in area: one edge, or the rim of a disc, cuts a square in two, whose areas have a closed form (a rim is
straight within a part but for a bend that is put in by its mean); where several edges meet, a part is clipped by them
(``paint_clip``). The parts are kept, so that the blur of the lens can be laid over what is
really there and not over whole pixels.
"""

from __future__ import annotations

import numba
import numpy as np

from armsight.data import Array
from armsight.sim.paint_clip import VERTICES, Grid, Span, cell_of, cells_of, clip_parts, part_corners, span_of, uniform
from armsight.sim.paint_parts import SUB, Box, Slots, ahead_of, open_parts, plane_row

_TILE = 8  # pixels on a side that are passed over together

Corners = tuple[float, float, float, float]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _cut(corners: Corners, before: float, after: float, parts: Array) -> None:
    """Repaint the parts (SUB, SUB) of a pixel that one edge crosses.

    ``corners`` is how far past the edge the pixel's corners are, homogeneous: upper left and right, lower left and right.
    """
    a, b, d, e = corners
    c, u, v, uv = 0.25 * (a + b + d + e), 0.5 * (b - a + e - d), 0.5 * (d - a + e - b), a - b - d + e
    # Slopes of a part, to a thousandth those of all; the share of a part past the edge is as in half, without branches.
    steep, flat = max(abs(u), abs(v)) / SUB, min(abs(u), abs(v)) / SUB
    flat = max(flat, 1e-4 * steep)
    far, near, scale = 0.5 * (steep + flat), 0.5 * (steep - flat), 0.5 / (steep * flat)
    for m in range(SUB):
        y = (m + 0.5) / SUB - 0.5
        for n in range(SUB):
            x = (n + 0.5) / SUB - 0.5
            p = c + x * u + y * v + x * y * uv
            s0, s1, s2, s3 = max(p + far, 0.0), max(p + near, 0.0), max(p - near, 0.0), max(p - far, 0.0)
            share = ((s0 * s0 - s1 * s1) - (s2 * s2 - s3 * s3)) * scale
            old = parts[m, n]
            low, high = before if before >= 0.0 else old, after if after >= 0.0 else old
            parts[m, n] = low + share * (high - low)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _past(rays: Array, M: Array, at: tuple[int, int], axis: int, edge: float, out: Array) -> None:
    """Write how far past an edge, homogeneous, the pixel corners are that follow ``at`` (row, column), out (n,)."""
    x, y, z = M[axis, 0] - edge * M[2, 0], M[axis, 1] - edge * M[2, 1], M[axis, 2] - edge * M[2, 2]
    for k in range(out.size):
        out[k] = x * rays[at[0], at[1] + k, 0] + y * rays[at[0], at[1] + k, 1] + z * rays[at[0], at[1] + k, 2]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _paint_edge(
    rays: Array,
    Ms: Array,
    tile: Box,
    corner: tuple[int, int],
    grid: Grid,
    span: Span,
    coarse: Array,
    slot: Slots,
    fine: Array,
    count: int,
) -> tuple[Array, int]:
    """Paint a tile of pixels that one edge crosses, between two columns or two rows of cells; see :func:`paint`."""
    xe, ye, values = grid
    i0, i1, j0, j1 = span
    u0, v0, u1, v1 = tile
    axis, edge = (0, xe[i0]) if i1 > i0 else (1, ye[j0])
    before, after = values[j0, i0], values[j1, i1]
    top, bottom = np.empty(u1 - u0 + 1), np.empty(u1 - u0 + 1)
    for v in range(v0, v1):
        M = Ms[min(v, Ms.shape[0] - 1)]
        if v == v0 or Ms.shape[0] > 1:  # each row of a rolling shutter sees its own plane
            _past(rays, M, (v + corner[1], u0 + corner[0]), axis, edge, bottom)
        top, bottom = bottom, top
        _past(rays, M, (v + 1 + corner[1], u0 + corner[0]), axis, edge, bottom)
        for k in range(u1 - u0):
            corners = top[k], top[k + 1], bottom[k], bottom[k + 1]
            low = min(min(corners[0], corners[1]), min(corners[2], corners[3]))
            high = max(max(corners[0], corners[1]), max(corners[2], corners[3]))
            if low < 0.0 <= high:
                fine, s, count = open_parts(v, u0 + k, coarse, slot, fine, count)
                _cut(corners, before, after, fine[s])
                continue
            value = before if low < 0.0 else after
            if value >= 0.0:
                coarse[v, u0 + k] = value
                slot[v, u0 + k] = -1
    return fine, count


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _reach(rays: Array, Ms: Array, tile: Box, corner: tuple[int, int], grid: Grid) -> tuple[bool, Span]:
    """Tell whether all of a tile of pixels sees the plane before it, and between which cells it lies at most.

    Cells are convex: what lies between the corners of an area lies between the cells they lie in. The area is a pixel
    larger all around, for lenses bend lines.
    """
    xe, ye, _ = grid
    u0, v0, u1, v1 = tile
    i0 = i1 = j0 = j1 = 0
    for n in range(4):
        v = max(v0 - 1 + corner[1], 0) if n < 2 else min(v1 + 1 + corner[1], rays.shape[0] - 1)
        u = max(u0 - 1 + corner[0], 0) if n % 2 == 0 else min(u1 + 1 + corner[0], rays.shape[1] - 1)
        m, x, y, z = min(v0 if n < 2 else v1 - 1, Ms.shape[0] - 1), rays[v, u, 0], rays[v, u, 1], rays[v, u, 2]
        w = Ms[m, 2, 0] * x + Ms[m, 2, 1] * y + Ms[m, 2, 2] * z
        if w <= 0.0:
            return False, (0, 0, 0, 0)
        i = cell_of(xe, Ms[m, 0, 0] * x + Ms[m, 0, 1] * y + Ms[m, 0, 2] * z, w, i0)
        j = cell_of(ye, Ms[m, 1, 0] * x + Ms[m, 1, 1] * y + Ms[m, 1, 2] * z, w, j0)
        i0, i1 = (i, i) if n == 0 else (min(i0, i), max(i1, i))
        j0, j1 = (j, j) if n == 0 else (min(j0, j), max(j1, j))
    return True, (i0, i1, j0, j1)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def paint(
    rays: Array,
    Ms: Array,
    box: Box,
    corner: tuple[int, int],
    grid: Grid,
    coarse: Array,
    slot: Slots,
    fine: Array,
    count: int,
) -> tuple[Array, int]:
    """Paint a grid of cells.

    Args:
        rays: (H' + 1, W' + 1, 3) rays through the corners of the camera's pixels, its frame.
        Ms: (1 or H, 3, 3) from rays to homogeneous plane coordinates, for all rows or for each.
        box: first column, first row, end column, end row of what may be covered, px.
        corner: column and row of the camera's image that ``box``, ``coarse`` and ``slot`` begin at.
        grid: borders (nx + 1,), (ny + 1,) and values (ny + 2, nx + 2) of the cells; values have a clear rim.
        coarse: (H, W) pixel values, painted in place; a cell's value below zero is clear and leaves them.
        slot: (H, W) which row of ``fine`` holds a pixel's parts, -1 where it has one value.
        fine: (capacity, SUB, SUB) the parts.
        count: rows of ``fine`` in use.

    Returns:
        ``fine`` (a larger one where it was full) and the new count.
    """
    xe, ye, values = grid
    flat = values.reshape(-1)
    top, bottom = np.empty((3, _TILE + 1)), np.empty((3, _TILE + 1))
    top_cells, bottom_cells = np.zeros(_TILE + 1, np.int32), np.zeros(_TILE + 1, np.int32)
    buffer = np.empty((6, VERTICES, 5))
    fan, fan_cells = np.empty((SUB + 1, 3, SUB + 1)), np.zeros((SUB + 1, SUB + 1), np.int32)
    ahead, columns = False, xe.size + 1
    across, lines = (box[2] - box[0] + _TILE - 1) // _TILE, (box[3] - box[1] + _TILE - 1) // _TILE
    for tile in range(max(across, 0) * max(lines, 0)):
        u0, v0 = box[0] + tile % across * _TILE, box[1] + tile // across * _TILE
        u1, v1 = min(u0 + _TILE, box[2]), min(v0 + _TILE, box[3])
        all_ahead, span = _reach(rays, Ms, (u0, v0, u1, v1), corner, grid)
        if all_ahead and (span[1] == 0 or span[3] == 0 or span[0] == xe.size or span[2] == ye.size):
            continue  # it is all to one side of the grid
        cuts = span[1] - span[0] + span[3] - span[2]
        if all_ahead and cuts == 0:
            value = values[span[2], span[0]]
            if value >= 0.0:
                coarse[v0:v1, u0:u1] = value
                slot[v0:v1, u0:u1] = -1
            continue
        if all_ahead and cuts == 1:
            fine, count = _paint_edge(rays, Ms, (u0, v0, u1, v1), corner, grid, span, coarse, slot, fine, count)
            continue
        n = u1 - u0
        for v in range(v0, v1):
            M = Ms[min(v, Ms.shape[0] - 1)]
            if v == v0 or Ms.shape[0] > 1:  # each row of a rolling shutter sees its own plane
                ahead = plane_row(rays, M, v + corner[1], u0 + corner[0], n + 1, bottom)
                cells_of(bottom, xe, ye, n + 1, bottom_cells)
            top, bottom, top_cells, bottom_cells = bottom, top, bottom_cells, top_cells
            all_ahead = ahead
            ahead = plane_row(rays, M, v + 1 + corner[1], u0 + corner[0], n + 1, bottom)
            cells_of(bottom, xe, ye, n + 1, bottom_cells)
            all_ahead = all_ahead and ahead
            for k in range(n):
                if not all_ahead and not ahead_of(top, bottom, k):
                    continue
                cell = top_cells[k]
                whole = top_cells[k + 1] == cell and bottom_cells[k] == cell and bottom_cells[k + 1] == cell
                if not whole:
                    span = span_of(top_cells, bottom_cells, k, columns)
                    whole = uniform(values, span)
                if whole:
                    value = flat[cell]
                    if value >= 0.0:
                        coarse[v, u0 + k] = value
                        slot[v, u0 + k] = -1
                    continue
                fine, s, count = open_parts(v, u0 + k, coarse, slot, fine, count)
                if span[1] - span[0] + span[3] - span[2] == 1:
                    axis, edge = (0, xe[span[0]]) if span[1] > span[0] else (1, ye[span[2]])
                    past = (
                        top[axis, k] - edge * top[2, k],
                        top[axis, k + 1] - edge * top[2, k + 1],
                        bottom[axis, k] - edge * bottom[2, k],
                        bottom[axis, k + 1] - edge * bottom[2, k + 1],
                    )
                    _cut(past, values[span[2], span[0]], values[span[3], span[1]], fine[s])
                else:
                    part_corners(top, bottom, k, fan)
                    clip_parts(fan, fan_cells, grid, fine[s], buffer)
    return fine, count
