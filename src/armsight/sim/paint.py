"""Paint flat patterns into an image by exact area sampling.

The corners of all pixels are cast as rays through the full camera model. A ray meets a pattern's plane at homogeneous
coordinates that are linear in the ray, so inside a pixel they are interpolated linearly from its four corners (exact
for a pinhole, good to 1e-4 px for any lens); every straight edge of the pattern is a straight cut through the pixel,
and a circle cuts a line through the pixel where a quadratic vanishes. A pixel that lies in one cell takes its value.
A pixel that an edge crosses is split into SUB x SUB parts; each part is clipped by the edges (Sutherland and Hodgman,
CACM 17(1), 1974) or scanned across the circle, and its value is exact in area. The parts are kept, so that the blur of
the lens can be laid over what is really there and not over whole pixels.

All compiled functions that call each other stay in this file: numba's cache on disk looks at one file's age only.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from armsight.data import Array

#: Parts of an edge pixel along each side.
SUB = 4
_LINES = 4  # scan lines through a part that a circle crosses
_VERTICES = 12  # a square cut by two pairs of lines has at most 8 corners

Slots = NDArray[np.int32]
Box = tuple[int, int, int, int]
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
def _cells(points: Array, n: int, xe: Array, ye: Array, out: Slots) -> None:
    """Return in out (n, 2) the column and the row of the cell in which each of n homogeneous plane points lies."""
    i = j = 0
    for k in range(n):
        i, j = _cell(xe, points[k, 0], points[k, 2], i), _cell(ye, points[k, 1], points[k, 2], j)
        out[k, 0], out[k, 1] = i, j


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _span(a: Slots, b: Slots, k: int) -> Span:
    """Return the first and last column and row of the cells of points k and k + 1 of two lines a, b (n, 2)."""
    return (
        min(min(a[k, 0], a[k + 1, 0]), min(b[k, 0], b[k + 1, 0])),
        max(max(a[k, 0], a[k + 1, 0]), max(b[k, 0], b[k + 1, 0])),
        min(min(a[k, 1], a[k + 1, 1]), min(b[k, 1], b[k + 1, 1])),
        max(max(a[k, 1], a[k + 1, 1]), max(b[k, 1], b[k + 1, 1])),
    )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _one_cell(a: Slots, b: Slots, k: int) -> bool:
    """Tell whether points k and k + 1 of two lines a, b (n, 2) lie in one cell: most do."""
    i, j = a[k, 0], a[k, 1]
    same = a[k + 1, 0] == i and b[k, 0] == i and b[k + 1, 0] == i
    return bool(same and a[k + 1, 1] == j and b[k, 1] == j and b[k + 1, 1] == j)


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
def _inside_line(p: Array, q: Array, x: float, y: float, radius: float) -> float:
    """Return which share of the way from p to q (homogeneous plane points) lies in a circle."""
    ax, ay, aw = p[0] - x * p[2], p[1] - y * p[2], radius * p[2]
    bx, by, bw = q[0] - x * q[2] - ax, q[1] - y * q[2] - ay, radius * q[2] - aw
    c = ax * ax + ay * ay - aw * aw
    b = ax * bx + ay * by - aw * bw
    a = bx * bx + by * by - bw * bw
    disc = b * b - a * c
    if not (a > 0.0 and disc > 0.0):
        return 1.0 if c + b < 0.0 else 0.0
    root = np.sqrt(disc)
    return float(max(0.0, min(1.0, (root - b) / a) - max(0.0, (-root - b) / a)))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _circle_share(c: Array, disc: Array, lines: int, buffer: Array) -> float:
    """Return which share of the area between four corners c (4, 3), in turn around it, a disc covers.

    Found with so many scan lines; with none, an area on the rim is told by 0.5.
    """
    x, y, radius = disc[0], disc[1], disc[2]
    mx = my = reach = 0.0
    for n in range(4):
        mx += 0.25 * (c[n, 0] / c[n, 2] - x)
        my += 0.25 * (c[n, 1] / c[n, 2] - y)
    for n in range(4):
        reach = max(reach, np.hypot(c[n, 0] / c[n, 2] - x - mx, c[n, 1] / c[n, 2] - y - my))
    distance = np.hypot(mx, my)
    if distance - reach >= radius or distance + reach <= radius:
        return 1.0 if distance < radius else 0.0
    if lines == 0:
        return 0.5
    # Scan lines run across the rim: along whichever side of the area points more nearly to the disc's centre.
    along_u = abs((c[1, 0] - c[0, 0]) * mx + (c[1, 1] - c[0, 1]) * my)
    along_v = abs((c[3, 0] - c[0, 0]) * mx + (c[3, 1] - c[0, 1]) * my)
    near, far = (3, 1) if along_u > along_v else (1, 3)
    p, q, share = buffer[6, 0], buffer[6, 1], 0.0
    for line in range(lines):
        t = (line + 0.5) / lines
        for k in range(3):
            p[k] = c[0, k] + t * (c[near, k] - c[0, k])
            q[k] = c[far, k] + t * (c[2, k] - c[far, k])
        share += _inside_line(p, q, x, y, radius)
    return share / lines


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _plane_row(rays: Array, M: Array, v: int, u0: int, out: Array) -> None:
    """Cast the pixel corners of row v from column u0 on to the plane of M: out (n, 3) homogeneous."""
    for k in range(out.shape[0]):
        x, y, z = rays[v, u0 + k, 0], rays[v, u0 + k, 1], rays[v, u0 + k, 2]
        for c in range(3):
            out[k, c] = M[c, 0] * x + M[c, 1] * y + M[c, 2] * z


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _open_parts(v: int, u: int, coarse: Array, slot: Slots, fine: Array, count: int) -> tuple[Array, int, int]:
    """Return the parts of a pixel, making them from its one value where it has none yet: parts, slot, count."""
    if slot[v, u] >= 0:
        return fine, slot[v, u], count
    if count == fine.shape[0]:
        grown = np.empty((2 * count, SUB, SUB))
        grown[:count] = fine
        fine = grown
    fine[count] = coarse[v, u]
    slot[v, u] = count
    return fine, count, count + 1


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _part_corners(top: Array, bottom: Array, k: int, out: Array) -> None:
    """Interpolate the corners of a pixel's parts, out (SUB + 1, SUB + 1, 3), from those of pixel k of a row."""
    for a in range(SUB + 1):
        t = a / SUB
        for b in range(SUB + 1):
            s = b / SUB
            for c in range(3):
                upper = top[k, c] + s * (top[k + 1, c] - top[k, c])
                lower = bottom[k, c] + s * (bottom[k + 1, c] - bottom[k, c])
                out[a, b, c] = upper + t * (lower - upper)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _corners(top: Array, bottom: Array, k: int, c: Array) -> None:
    """Gather c (4, 3), in turn around it, the corners of the area between points k and k + 1 of two lines (n, 3)."""
    for n in range(3):
        c[0, n], c[1, n], c[2, n], c[3, n] = top[k, n], top[k + 1, n], bottom[k + 1, n], bottom[k, n]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _paint_parts(fan: Array, cells: Slots, grid: Grid, disc: Array, parts: Array, buffer: Array) -> None:
    """Repaint the parts (SUB, SUB) of a pixel whose part corners lie at fan (SUB + 1, SUB + 1, 3) of the plane."""
    xe, ye, values = grid
    c = buffer[5, :4, :3]
    for a in range(SUB + 1):
        if disc.size == 0:
            _cells(fan[a], SUB + 1, xe, ye, cells[a])
    for a in range(SUB):
        for b in range(SUB):
            if disc.size > 0:
                _corners(fan[a], fan[a + 1], b, c)
                parts[a, b] += _circle_share(c, disc, _LINES, buffer) * (disc[3] - parts[a, b])
                continue
            span = _span(cells[a], cells[a + 1], b)
            if not _uniform(values, span):
                _corners(fan[a], fan[a + 1], b, c)
                parts[a, b] = _clip(c, grid, span, parts[a, b], buffer)
            elif values[span[2], span[0]] >= 0.0:
                parts[a, b] = values[span[2], span[0]]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def paint(
    rays: Array, Ms: Array, box: Box, grid: Grid, disc: Array, coarse: Array, slot: Slots, fine: Array, count: int
) -> tuple[Array, int]:
    """Paint a grid of cells, or one disc.

    Args:
        rays: (H + 1, W + 1, 3) rays through the corners of the pixels, camera frame.
        Ms: (1 or H, 3, 3) from rays to homogeneous plane coordinates, for all rows or for each.
        box: first column, first row, end column, end row of what may be covered, px.
        grid: borders (nx + 1,), (ny + 1,) and values (ny + 2, nx + 2) of the cells; values have a clear rim.
        disc: (4,) centre x, y, radius and value of a disc to paint instead of the cells, or empty.
        coarse: (H, W) pixel values, painted in place; a cell's value below zero is clear and leaves them.
        slot: (H, W) which row of ``fine`` holds a pixel's parts, -1 where it has one value.
        fine: (capacity, SUB, SUB) the parts.
        count: rows of ``fine`` in use.

    Returns:
        ``fine`` (a larger one where it was full) and the new count.
    """
    xe, ye, values = grid
    u0, v0, u1, v1 = box
    n = u1 - u0
    top, bottom = np.empty((n + 1, 3)), np.empty((n + 1, 3))
    top_cells, bottom_cells = np.zeros((n + 1, 2), np.int32), np.zeros((n + 1, 2), np.int32)
    c, fan, fan_cells = np.empty((4, 3)), np.empty((SUB + 1, SUB + 1, 3)), np.zeros((SUB + 1, SUB + 1, 2), np.int32)
    buffer = np.empty((7, _VERTICES, 5))
    for v in range(v0, v1):
        M = Ms[min(v, Ms.shape[0] - 1)]
        if v == v0 or Ms.shape[0] > 1:  # each row of a rolling shutter sees its own plane
            _plane_row(rays, M, v, u0, bottom)
            _cells(bottom, n + 1, xe, ye, bottom_cells)
        top, bottom, top_cells, bottom_cells = bottom, top, bottom_cells, top_cells
        _plane_row(rays, M, v + 1, u0, bottom)
        _cells(bottom, n + 1, xe, ye, bottom_cells)
        for k in range(n):
            if not (top[k, 2] > 0.0 and top[k + 1, 2] > 0.0 and bottom[k, 2] > 0.0 and bottom[k + 1, 2] > 0.0):
                continue
            if disc.size > 0:
                _corners(top, bottom, k, c)
                share = _circle_share(c, disc, 0, buffer)
                if share == 0.0:
                    continue
                whole, value = share == 1.0, disc[3]
            elif _one_cell(top_cells, bottom_cells, k):
                whole, value = True, values[top_cells[k, 1], top_cells[k, 0]]
            else:
                span = _span(top_cells, bottom_cells, k)
                whole, value = _uniform(values, span), values[span[2], span[0]]
            if not whole:
                fine, s, count = _open_parts(v, u0 + k, coarse, slot, fine, count)
                _part_corners(top, bottom, k, fan)
                _paint_parts(fan, fan_cells, grid, disc, fine[s], buffer)
            elif value >= 0.0:
                coarse[v, u0 + k] = value
                slot[v, u0 + k] = -1
    return fine, count
