"""Paint flat patterns into an image by exact area sampling.

The corners of all pixels are cast as rays through the full camera model. A ray meets a pattern's plane at homogeneous
coordinates that are linear in the ray, so inside a pixel they are interpolated linearly from its four corners (exact
for a pinhole, good to 1e-4 px for any lens); every straight edge of the pattern is a straight cut through the pixel.
A pixel that lies in one cell takes its value. A pixel that an edge crosses is split into SUB x SUB parts, and the value
of each is exact in area: one edge, or the rim of a disc, cuts a square in two, whose areas have a closed form (a rim is
straight within a part but for a bend that is put in by its mean); where several edges meet, a part is clipped by them
(Sutherland and Hodgman, CACM 17(1), 1974). The parts are kept, so that the blur of the lens can be laid over what is
really there and not over whole pixels.
"""

from __future__ import annotations

import numba
import numpy as np

from armsight.data import Array
from armsight.sim.paint_parts import SUB, Box, Slots, ahead_of, open_parts, plane_row, square_of
from armsight.sim.scene import CLEAR

_VERTICES = 12  # a square cut by two pairs of lines has at most 8 corners
_TILE = 8  # pixels on a side that are passed over together

Grid = tuple[Array, Array, Array]
Span = tuple[int, int, int, int]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _area(p: Array, n: int) -> float:
    """Return the area of the polygon p (n, 5) in its first two columns."""
    twice = 0.0
    for i in range(n):
        j = i + 1 if i + 1 < n else 0
        twice += p[i, 0] * p[j, 1] - p[j, 0] * p[i, 1]
    return 0.5 * abs(twice)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _split(p: Array, n: int, axis: int, edge: float, low: Array, high: Array) -> tuple[int, int]:
    """Split the convex polygon p (n, 5) where homogeneous coordinate ``axis`` equals ``edge``; return both counts."""
    n_low = n_high = 0
    for i in range(n):
        j = i + 1 if i + 1 < n else 0
        g_i = p[i, axis] - edge * p[i, 4]
        g_j = p[j, axis] - edge * p[j, 4]
        for c in range(5):
            if g_i < 0.0:
                low[n_low, c] = p[i, c]
            else:
                high[n_high, c] = p[i, c]
        n_low, n_high = n_low + int(g_i < 0.0), n_high + int(not g_i < 0.0)
        if (g_i < 0.0) != (g_j < 0.0):
            t = g_i / (g_i - g_j)
            for c in range(5):
                cut = p[i, c] + t * (p[j, c] - p[i, c])
                low[n_low, c] = cut
                high[n_high, c] = cut
            n_low += 1
            n_high += 1
    return n_low, n_high


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _cell(edges: Array, x: float, w: float, i: int) -> int:
    """Return which cell x / w lies in, starting to look at i: 0 before the first edge, len(edges) past the last."""
    while i > 0 and x < edges[i - 1] * w:
        i -= 1
    while i < edges.size and x >= edges[i] * w:
        i += 1
    return i


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _cells(points: Array, xe: Array, ye: Array, n: int, out: Slots) -> None:
    """Write out (n,) in which cell each homogeneous plane point (3, n) lies: its row times the columns, and its column."""
    i = j = 0
    for k in range(n):
        i, j = _cell(xe, points[0, k], points[2, k], i), _cell(ye, points[1, k], points[2, k], j)
        out[k] = j * (xe.size + 1) + i


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _span(a: Slots, b: Slots, k: int, columns: int) -> Span:
    """Return the first and last column and row of the cells of points k and k + 1 of two lines a, b (n,)."""
    i0, i1 = min(a[k] % columns, a[k + 1] % columns), max(a[k] % columns, a[k + 1] % columns)
    j0, j1 = min(a[k], a[k + 1]), max(a[k], a[k + 1])
    for m in (k, k + 1):
        i0, i1 = min(i0, b[m] % columns), max(i1, b[m] % columns)
        j0, j1 = min(j0, b[m]), max(j1, b[m])
    return i0, i1, j0 // columns, j1 // columns


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _uniform(values: Array, span: Span) -> bool:
    """Tell whether all cells of a span have one value."""
    i0, i1, j0, j1 = span
    first = values[j0, i0]
    for j in range(j0, j1 + 1):
        for i in range(i0, i1 + 1):
            if values[j, i] != first:
                return False
    return True


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _clip(c: Array, grid: Grid, span: Span, old: float, b: Array) -> float:
    """Return the mean value over the area between corners c (4, 3) that spans several cells; ``old`` where clear."""
    xe, ye, values = grid
    i0, i1, j0, j1 = span
    rest, spare, strip, spare_strip, piece = b[0], b[1], b[2], b[3], b[4]
    for n in range(4):
        # In the area's own square coordinates the corners are (0, 0), (1, 0), (1, 1), (0, 1).
        rest[n, 0] = 1.0 if n in (1, 2) else 0.0
        rest[n, 1] = 1.0 if n >= 2 else 0.0
        for k in range(3):
            rest[n, 2 + k] = c[n, k]
    total, n_rest = 0.0, 4
    for i in range(i0, i1 + 1):
        n_strip, n_rest = _split(rest, n_rest, 2, xe[i] if i < i1 else np.inf, strip, spare)
        rest, spare = spare, rest
        for j in range(j0, j1 + 1):
            n_piece, n_strip = _split(strip, n_strip, 3, ye[j] if j < j1 else np.inf, piece, spare_strip)
            strip, spare_strip = spare_strip, strip
            total += _area(piece, n_piece) * (values[j, i] if values[j, i] >= 0.0 else old)
    return total


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _paint_edge(square: Array, grid: Grid, span: Span, parts: Array) -> None:
    """Repaint the parts (SUB, SUB) of a pixel that one edge crosses, between two columns or two rows of cells."""
    xe, ye, values = grid
    i0, i1, j0, j1 = span
    axis, edge = (0, xe[i0]) if i1 > i0 else (1, ye[j0])
    before, after = values[j0, i0], values[j1, i1]
    # How far past the edge: in the pixel's middle, its slopes (to a thousandth those of all parts) and twist.
    c, u = square[0, axis] - edge * square[0, 2], square[1, axis] - edge * square[1, 2]
    v, uv = square[2, axis] - edge * square[2, 2], square[3, axis] - edge * square[3, 2]
    steep, flat = max(abs(u), abs(v)) / SUB, min(abs(u), abs(v)) / SUB
    flat = max(flat, 1e-4 * steep)
    far, near, scale = 0.5 * (steep + flat), 0.5 * (steep - flat), 0.5 / (steep * flat)
    for a in range(SUB):
        y = (a + 0.5) / SUB - 0.5
        for b in range(SUB):
            x = (b + 0.5) / SUB - 0.5
            p = c + x * u + y * v + x * y * uv
            s0, s1, s2, s3 = max(p + far, 0.0), max(p + near, 0.0), max(p - near, 0.0), max(p - far, 0.0)
            share = ((s0 * s0 - s1 * s1) - (s2 * s2 - s3 * s3)) * scale  # see half; without branches
            old = parts[a, b]
            low, high = before if before >= 0.0 else old, after if after >= 0.0 else old
            parts[a, b] = low + share * (high - low)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _part_corners(top: Array, bottom: Array, k: int, out: Array) -> None:
    """Interpolate the corners of a pixel's parts, out (SUB + 1, 3, SUB + 1), from those of pixel k of a row."""
    for a in range(SUB + 1):
        t = a / SUB
        for b in range(SUB + 1):
            s = b / SUB
            for c in range(3):
                upper = top[c, k] + s * (top[c, k + 1] - top[c, k])
                lower = bottom[c, k] + s * (bottom[c, k + 1] - bottom[c, k])
                out[a, c, b] = upper + t * (lower - upper)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _corners(top: Array, bottom: Array, k: int, c: Array) -> None:
    """Gather c (4, 3), in turn around it, the corners of the area between points k and k + 1 of two lines (3, n)."""
    for n in range(3):
        c[0, n], c[1, n], c[2, n], c[3, n] = top[n, k], top[n, k + 1], bottom[n, k + 1], bottom[n, k]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _paint_parts(fan: Array, cells: Slots, grid: Grid, parts: Array, buffer: Array) -> None:
    """Repaint the parts (SUB, SUB) of a pixel whose part corners lie at fan (SUB + 1, 3, SUB + 1) of the plane."""
    xe, ye, values = grid
    c = buffer[5, :4, :3]
    for a in range(SUB + 1):
        _cells(fan[a], xe, ye, SUB + 1, cells[a])
    for a in range(SUB):
        for b in range(SUB):
            span = _span(cells[a], cells[a + 1], b, xe.size + 1)
            if not _uniform(values, span):
                _corners(fan[a], fan[a + 1], b, c)
                parts[a, b] = _clip(c, grid, span, parts[a, b], buffer)
            elif values[span[2], span[0]] >= 0.0:
                parts[a, b] = values[span[2], span[0]]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _one_value(rays: Array, Ms: Array, tile: Box, corner: tuple[int, int], grid: Grid) -> float:
    """Return the value that all of a tile of pixels has; a NaN where that is not sure.

    Cells are convex: what lies between the corners of an area lies in the cell they lie in. The area is a pixel larger all
    around, for lenses bend lines.
    """
    xe, ye, values = grid
    u0, v0, u1, v1 = tile
    i0 = i1 = j0 = j1 = -1
    for n in range(4):
        v = max(v0 - 1 + corner[1], 0) if n < 2 else min(v1 + 1 + corner[1], rays.shape[0] - 1)
        u = max(u0 - 1 + corner[0], 0) if n % 2 == 0 else min(u1 + 1 + corner[0], rays.shape[1] - 1)
        M, d = Ms[min(v0 if n < 2 else v1 - 1, Ms.shape[0] - 1)], rays[v, u]
        w = M[2, 0] * d[0] + M[2, 1] * d[1] + M[2, 2] * d[2]
        if w <= 0.0:
            return np.nan
        i = _cell(xe, M[0, 0] * d[0] + M[0, 1] * d[1] + M[0, 2] * d[2], w, max(i0, 0))
        j = _cell(ye, M[1, 0] * d[0] + M[1, 1] * d[1] + M[1, 2] * d[2], w, max(j0, 0))
        i0, i1 = (i, i) if n == 0 else (min(i0, i), max(i1, i))
        j0, j1 = (j, j) if n == 0 else (min(j0, j), max(j1, j))
    if i1 == 0 or j1 == 0 or i0 == xe.size or j0 == ye.size:
        return CLEAR
    return values[j0, i0] if i0 == i1 and j0 == j1 else np.nan


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
    square, buffer = np.empty((4, 3)), np.empty((6, _VERTICES, 5))
    fan, fan_cells = np.empty((SUB + 1, 3, SUB + 1)), np.zeros((SUB + 1, SUB + 1), np.int32)
    ahead, columns, span = False, xe.size + 1, (0, 0, 0, 0)
    across, lines = (box[2] - box[0] + _TILE - 1) // _TILE, (box[3] - box[1] + _TILE - 1) // _TILE
    for tile in range(max(across, 0) * max(lines, 0)):
        u0, v0 = box[0] + tile % across * _TILE, box[1] + tile // across * _TILE
        u1, v1 = min(u0 + _TILE, box[2]), min(v0 + _TILE, box[3])
        value = _one_value(rays, Ms, (u0, v0, u1, v1), corner, grid)
        if value >= 0.0:
            coarse[v0:v1, u0:u1] = value
            slot[v0:v1, u0:u1] = -1
        if not np.isnan(value):
            continue
        n = u1 - u0
        for v in range(v0, v1):
            M = Ms[min(v, Ms.shape[0] - 1)]
            if v == v0 or Ms.shape[0] > 1:  # each row of a rolling shutter sees its own plane
                ahead = plane_row(rays, M, v + corner[1], u0 + corner[0], n + 1, bottom)
                _cells(bottom, xe, ye, n + 1, bottom_cells)
            top, bottom, top_cells, bottom_cells = bottom, top, bottom_cells, top_cells
            all_ahead = ahead
            ahead = plane_row(rays, M, v + 1 + corner[1], u0 + corner[0], n + 1, bottom)
            _cells(bottom, xe, ye, n + 1, bottom_cells)
            all_ahead = all_ahead and ahead
            for k in range(n):
                if not all_ahead and not ahead_of(top, bottom, k):
                    continue
                cell = top_cells[k]
                whole = top_cells[k + 1] == cell and bottom_cells[k] == cell and bottom_cells[k + 1] == cell
                if not whole:
                    span = _span(top_cells, bottom_cells, k, columns)
                    whole = _uniform(values, span)
                if whole:
                    value = flat[cell]
                    if value >= 0.0:
                        coarse[v, u0 + k] = value
                        slot[v, u0 + k] = -1
                    continue
                fine, s, count = open_parts(v, u0 + k, coarse, slot, fine, count)
                if span[1] - span[0] + span[3] - span[2] == 1:
                    square_of(top, bottom, k, square)
                    _paint_edge(square, grid, span, fine[s])
                else:
                    _part_corners(top, bottom, k, fan)
                    _paint_parts(fan, fan_cells, grid, fine[s], buffer)
    return fine, count
