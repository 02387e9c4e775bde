"""Paint flat patterns into an image by exact area sampling.

The corners of all pixels are cast as rays through the full camera model. A ray meets a pattern's plane at homogeneous
coordinates that are linear in the ray, so inside a pixel they are interpolated linearly from its four corners (exact
for a pinhole, good to 1e-4 px for any lens) and every straight edge of the pattern is a straight cut through the pixel.
A pixel that lies in one cell takes its value. A pixel that an edge crosses is split into SUB x SUB parts, and each part
is clipped by the edges (Sutherland and Hodgman 1974) or cut by the circle; its value is exact in area. The parts are
kept, so that the blur of the lens can be laid over what is really there and not over whole pixels.
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
        if g_i < 0.0:
            low[n_low] = p[i]
            n_low += 1
        else:
            high[n_high] = p[i]
            n_high += 1
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
def _uniform(values: Array, i0: int, i1: int, j0: int, j1: int) -> bool:
    """Tell whether all cells of a range, ends included, have one value."""
    first = values[j0, i0]
    for j in range(j0, j1 + 1):
        for i in range(i0, i1 + 1):
            if values[j, i] != first:
                return False
    return True


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _cell(edges: Array, x: float, w: float, i: int) -> int:
    """Return which cell x / w lies in, starting to look at i: 0 before the first edge, len(edges) past the last."""
    while i > 0 and x < edges[i - 1] * w:
        i -= 1
    while i < edges.size and x >= edges[i] * w:
        i += 1
    return i


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _clip(
    quad: Array, xe: Array, ye: Array, values: Array, i0: int, i1: int, j0: int, j1: int, old: float, b: Array
) -> float:
    """Return the mean value over the unit square quad (4, 5): u v and homogeneous plane point; ``old`` where clear."""
    total = 0.0
    rest, n_rest = b[0], 4
    rest[:4] = quad
    spare = b[1]
    for i in range(i0, i1 + 1):
        if i < i1:
            n_strip, n_next = _split(rest, n_rest, 2, xe[i], b[2], spare)
        else:
            n_strip, n_next = n_rest, 0
            b[2][:n_rest] = rest[:n_rest]
        rest, spare = spare, rest
        n_rest = n_next
        strip, spare_y, n = b[2], b[3], n_strip
        for j in range(j0, j1 + 1):
            if j < j1:
                n_piece, n_next = _split(strip, n, 3, ye[j], b[4], spare_y)
                area = _area(b[4], n_piece)
            else:
                area, n_next = _area(strip, n), 0
            value = values[j, i]
            total += area * (value if value >= 0.0 else old)
            strip, spare_y = spare_y, strip
            n = n_next
    return total


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _plane_row(rays: Array, M: Array, v: int, u0: int, u1: int, out: Array) -> None:
    """Cast the pixel corners of row v from u0 to u1, ends included, onto the plane of M: out (n, 3) homogeneous."""
    for u in range(u0, u1 + 1):
        for c in range(3):
            out[u - u0, c] = M[c, 0] * rays[v, u, 0] + M[c, 1] * rays[v, u, 1] + M[c, 2] * rays[v, u, 2]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _open(v: int, u: int, coarse: Array, slot: Slots, fine: Array, count: int) -> tuple[Array, int, int]:
    """Return the parts of a pixel, making them from its one value where it has none yet: parts, slot, count."""
    s = slot[v, u]
    if s < 0:
        if count == fine.shape[0]:
            grown = np.empty((2 * count, SUB, SUB))
            grown[:count] = fine
            fine = grown
        s = count
        count += 1
        slot[v, u] = s
        fine[s] = coarse[v, u]
    return fine, s, count


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _sub_corners(top: Array, bottom: Array, k: int, out: Array) -> None:
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
def _part_cells(
    grid: Array, xe: Array, ye: Array, i: int, j: int, values: Array, parts: Array, quad: Array, buf: Array
) -> None:
    """Repaint the parts (SUB, SUB) of a pixel whose part corners lie at grid (SUB + 1, SUB + 1, 3) of the plane."""
    for a in range(SUB):
        for b in range(SUB):
            i0, i1, j0, j1 = xe.size, 0, ye.size, 0
            for c in range(4):
                # Corners in turn around the part, as a polygon needs them.
                p = grid[a + c // 2, b + (c == 1 or c == 2)]
                for axis in range(3):
                    quad[c, 2 + axis] = p[axis]
                i, j = _cell(xe, p[0], p[2], i), _cell(ye, p[1], p[2], j)
                i0, i1, j0, j1 = min(i0, i), max(i1, i), min(j0, j), max(j1, j)
            if _uniform(values, i0, i1, j0, j1):
                if values[j0, i0] >= 0.0:
                    parts[a, b] = values[j0, i0]
            else:
                parts[a, b] = _clip(quad, xe, ye, values, i0, i1, j0, j1, parts[a, b], buf)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def paint_cells(
    rays: Array,
    Ms: Array,
    box: tuple[int, int, int, int],
    xe: Array,
    ye: Array,
    values: Array,
    coarse: Array,
    slot: Slots,
    fine: Array,
    count: int,
) -> tuple[Array, int]:
    """Paint a grid of cells.

    Args:
        rays: (H + 1, W + 1, 3) rays through the corners of the pixels, camera frame.
        Ms: (1 or H, 3, 3) from rays to homogeneous plane coordinates, for all rows or for each.
        box: first column, first row, end column, end row of what may be covered.
        xe: (nx + 1,) borders of the columns.
        ye: (ny + 1,) borders of the rows.
        values: (ny + 2, nx + 2) the cells' values with a clear rim.
        coarse: (H, W) pixel values, painted in place.
        slot: (H, W) which row of ``fine`` holds a pixel's parts, -1 where it has one value.
        fine: (capacity, SUB, SUB) the parts.
        count: rows of ``fine`` in use.

    Returns:
        ``fine`` (a larger one where it was full) and the new count.
    """
    u0, v0, u1, v1 = box
    n = u1 - u0
    top, bottom = np.empty((n + 1, 3)), np.empty((n + 1, 3))
    cells = np.zeros((2, n + 1, 2), np.int64)
    grid = np.empty((SUB + 1, SUB + 1, 3))
    buf = np.empty((5, _VERTICES, 5))
    quad = np.zeros((4, 5))
    quad[1, 0] = quad[2, 0] = quad[2, 1] = quad[3, 1] = 1.0
    i = j = 0
    for v in range(v0, v1):
        M = Ms[min(v, Ms.shape[0] - 1)]
        again = v == v0 or Ms.shape[0] > 1  # each row of a rolling shutter sees its own plane
        for line in range(0 if again else 1, 2):
            if line == 1 and not again:
                top, bottom = bottom, top
                cells[0] = cells[1]
            points = bottom if line else top
            _plane_row(rays, M, v + line, u0, u1, points)
            for k in range(n + 1):
                w = points[k, 2]
                if w > 0.0:
                    i, j = _cell(xe, points[k, 0], w, i), _cell(ye, points[k, 1], w, j)
                    cells[line, k, 0], cells[line, k, 1] = i, j
                else:
                    cells[line, k, 0] = -1
        for k in range(n):
            i0 = min(min(cells[0, k, 0], cells[0, k + 1, 0]), min(cells[1, k, 0], cells[1, k + 1, 0]))
            if i0 < 0:
                continue
            i1 = max(max(cells[0, k, 0], cells[0, k + 1, 0]), max(cells[1, k, 0], cells[1, k + 1, 0]))
            j0 = min(min(cells[0, k, 1], cells[0, k + 1, 1]), min(cells[1, k, 1], cells[1, k + 1, 1]))
            j1 = max(max(cells[0, k, 1], cells[0, k + 1, 1]), max(cells[1, k, 1], cells[1, k + 1, 1]))
            if _uniform(values, i0, i1, j0, j1):
                if values[j0, i0] >= 0.0:
                    coarse[v, u0 + k] = values[j0, i0]
                    slot[v, u0 + k] = -1
                continue
            fine, s, count = _open(v, u0 + k, coarse, slot, fine, count)
            _sub_corners(top, bottom, k, grid)
            _part_cells(grid, xe, ye, i0, j0, values, fine[s], quad, buf)
    return fine, count


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
def _circle_share(c00: Array, c01: Array, c10: Array, c11: Array, disc: Array, p: Array, q: Array) -> float:
    """Return which share of the area between four corners (homogeneous plane points) a disc covers.

    Without room for scan lines (p and q empty) an area on the rim is told by 0.5.
    """
    x, y, radius = disc[0], disc[1], disc[2]
    mx = 0.25 * (c00[0] / c00[2] + c01[0] / c01[2] + c10[0] / c10[2] + c11[0] / c11[2]) - x
    my = 0.25 * (c00[1] / c00[2] + c01[1] / c01[2] + c10[1] / c10[2] + c11[1] / c11[2]) - y
    reach = 0.0
    for corner in (c00, c01, c10, c11):
        reach = max(reach, np.hypot(corner[0] / corner[2] - x - mx, corner[1] / corner[2] - y - my))
    distance = np.hypot(mx, my)
    if distance - reach >= radius:
        return 0.0
    if distance + reach <= radius:
        return 1.0
    if p.size == 0:
        return 0.5
    # Scan lines run across the rim, along whichever side of the part points more nearly to the disc's centre.
    along_u = abs((c01[0] - c00[0]) * mx + (c01[1] - c00[1]) * my) > abs(
        (c10[0] - c00[0]) * mx + (c10[1] - c00[1]) * my
    )
    share = 0.0
    for line in range(_LINES):
        t = (line + 0.5) / _LINES
        for c in range(3):
            if along_u:
                p[c] = c00[c] + t * (c10[c] - c00[c])
                q[c] = c01[c] + t * (c11[c] - c01[c])
            else:
                p[c] = c00[c] + t * (c01[c] - c00[c])
                q[c] = c10[c] + t * (c11[c] - c10[c])
        share += _inside_line(p, q, x, y, radius)
    return share / _LINES


@numba.njit(cache=True, nogil=True, error_model="numpy")
def paint_disc(
    rays: Array,
    Ms: Array,
    box: tuple[int, int, int, int],
    disc: Array,
    coarse: Array,
    slot: Slots,
    fine: Array,
    count: int,
) -> tuple[Array, int]:
    """Paint one disc (4,): centre x, y, radius, value; the other arguments and the result as in paint_cells."""
    u0, v0, u1, v1 = box
    n = u1 - u0
    top, bottom = np.empty((n + 1, 3)), np.empty((n + 1, 3))
    grid = np.empty((SUB + 1, SUB + 1, 3))
    p, q, nothing = np.empty(3), np.empty(3), np.empty(0)
    for v in range(v0, v1):
        M = Ms[min(v, Ms.shape[0] - 1)]
        _plane_row(rays, M, v, u0, u1, top)
        _plane_row(rays, M, v + 1, u0, u1, bottom)
        for k in range(n):
            if not (top[k, 2] > 0.0 and top[k + 1, 2] > 0.0 and bottom[k, 2] > 0.0 and bottom[k + 1, 2] > 0.0):
                continue
            share = _circle_share(top[k], top[k + 1], bottom[k], bottom[k + 1], disc, nothing, nothing)
            if share >= 1.0:
                coarse[v, u0 + k] = disc[3]
                slot[v, u0 + k] = -1
            elif share > 0.0:
                fine, s, count = _open(v, u0 + k, coarse, slot, fine, count)
                _sub_corners(top, bottom, k, grid)
                for a in range(SUB):
                    for b in range(SUB):
                        part = _circle_share(grid[a, b], grid[a, b + 1], grid[a + 1, b], grid[a + 1, b + 1], disc, p, q)
                        fine[s, a, b] += part * (disc[3] - fine[s, a, b])
    return fine, count
