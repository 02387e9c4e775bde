"""Paint flat patterns into an image by exact area sampling.

The corners of all pixels are cast as rays through the full camera model. A ray meets a pattern's plane at homogeneous
coordinates that are linear in the ray, so inside a pixel they are interpolated linearly from its four corners (exact
for a pinhole, good to 1e-4 px for any lens); every straight edge of the pattern is a straight cut through the pixel.
A pixel that lies in one cell takes its value. A pixel that an edge crosses is split into SUB x SUB parts, and the value
of each is exact in area: one edge, or the rim of a disc, cuts a square in two, whose areas have a closed form (a rim is
straight within a part but for a bend that is put in by its mean); where several edges meet, a part is clipped by them
(Sutherland and Hodgman, CACM 17(1), 1974). The parts are kept, so that the blur of the lens can be laid over what is
really there and not over whole pixels.

All compiled functions that call each other stay in this file: numba's cache on disk looks at one file's age only.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from armsight.data import Array

#: Parts of an edge pixel along each side.
SUB = 4
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
def _cells(points: Array, xe: Array, ye: Array, out: Slots) -> None:
    """Write out (n,) in which cell each homogeneous plane point (3, n) lies: its row times the columns, and its column."""
    i = j = 0
    for k in range(out.size):
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
def _half(c: float, u: float, v: float) -> float:
    """Return in which share of the square with sides from -1/2 to 1/2 the plane c + u x + v y is above zero."""
    u, v = abs(u), abs(v)
    if u < v:
        u, v = v, u
    if 2 * abs(c) >= u + v:
        return 1.0 if c > 0.0 else 0.0
    if 2 * abs(c) <= u - v:
        return 0.5 + c / u
    corner = 0.5 * (u + v) - abs(c)
    share = corner * corner / (2 * u * v)
    return 1.0 - share if c > 0.0 else share


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _square(top: Array, bottom: Array, k: int, out: Array) -> None:
    """Write out (4, 3), what interpolates the area between points k and k + 1 of two lines: middle, slopes, twist."""
    for c in range(3):
        a, b, d, e = top[c, k], top[c, k + 1], bottom[c, k], bottom[c, k + 1]
        out[0, c] = 0.25 * (a + b + d + e)
        out[1, c] = 0.5 * (b - a + e - d)
        out[2, c] = 0.5 * (d - a + e - b)
        out[3, c] = a - b - d + e


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _part(square: Array, a: int, b: int, out: Array) -> None:
    """Write out (3, 3), middle and slopes of the part in row a and column b of a square (4, 3)."""
    x, y = (b + 0.5) / SUB - 0.5, (a + 0.5) / SUB - 0.5
    for c in range(3):
        out[0, c] = square[0, c] + x * square[1, c] + y * square[2, c] + x * y * square[3, c]
        out[1, c] = (square[1, c] + y * square[3, c]) / SUB
        out[2, c] = (square[2, c] + x * square[3, c]) / SUB


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _chord(c: float, u: float, v: float) -> tuple[float, float, float, float]:
    """Return the ends of the line c + u x + v y = 0 within the square of :func:`_half`; its middle where it misses."""
    turned = abs(u) < abs(v)
    if turned:
        u, v = v, u
    if 2 * abs(c) >= abs(u) + abs(v) or u == 0.0:
        return 0.0, 0.0, 0.0, 0.0
    x0, y0, x1, y1 = (0.5 * v - c) / u, -0.5, (-0.5 * v - c) / u, 0.5
    if abs(x0) > 0.5:
        x0 = 0.5 if x0 > 0.0 else -0.5
        y0 = -(c + u * x0) / v
    if abs(x1) > 0.5:
        x1 = 0.5 if x1 > 0.0 else -0.5
        y1 = -(c + u * x1) / v
    return (y0, x0, y1, x1) if turned else (x0, y0, x1, y1)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _inside_rim(at: Array, disc: Array) -> float:
    """Return in which share of an area, its middle and slopes at (3, 3), a disc is: its rim is nearly straight there."""
    x0, y0, radius = disc[0], disc[1], disc[2]
    x, xu, xv = at[0, 0] - x0 * at[0, 2], at[1, 0] - x0 * at[1, 2], at[2, 0] - x0 * at[2, 2]
    y, yu, yv = at[0, 1] - y0 * at[0, 2], at[1, 1] - y0 * at[1, 2], at[2, 1] - y0 * at[2, 2]
    away = max(np.sqrt(x * x + y * y), 1e-3 * radius * at[0, 2])
    u, v = radius * at[1, 2] - (x * xu + y * yu) / away, radius * at[2, 2] - (x * xv + y * yv) / away
    c = radius * at[0, 2] - away
    # The rim bends away from its tangent, by the mean square of the way along it within the area, over its diameter.
    su, sv, eu, ev = _chord(c, u, v)
    sx, sy, ex, ey = su * xu + sv * xv, su * yu + sv * yv, eu * xu + ev * xv, eu * yu + ev * yv
    square = (sx * (sx + ex) + ex * ex + sy * (sy + ey) + ey * ey) / 3
    return _half(c - max(square - c * c, 0.0) / (2 * away), u, v)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _inside(points: Array, disc: Array, out: Array) -> None:
    """Write out (n,), above zero where homogeneous plane points (3, n) lie in a disc: squares of distances within."""
    for k in range(out.size):
        x, y = points[0, k] - disc[0] * points[2, k], points[1, k] - disc[1] * points[2, k]
        w = disc[2] * points[2, k]
        out[k] = w * w - x * x - y * y


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _bulge(square: Array, disc: Array) -> float:
    """Return twice by how much a place in a pixel may be further in a disc, as :func:`_inside` counts, than its corners."""
    total = 0.0
    for k in range(1, 3):
        x, y = square[k, 0] - disc[0] * square[k, 2], square[k, 1] - disc[1] * square[k, 2]
        total += 0.5 * (x * x + y * y)
    return total


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _paint_rim(square: Array, disc: Array, at: Array, parts: Array) -> None:
    """Repaint the parts (SUB, SUB) of a pixel that a disc's rim crosses."""
    for a in range(SUB):
        for b in range(SUB):
            _part(square, a, b, at)
            parts[a, b] += _inside_rim(at, disc) * (disc[3] - parts[a, b])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _paint_edge(square: Array, grid: Grid, span: Span, at: Array, parts: Array) -> None:
    """Repaint the parts (SUB, SUB) of a pixel that one edge crosses, between two columns or two rows of cells."""
    xe, ye, values = grid
    i0, i1, j0, j1 = span
    axis, edge = (0, xe[i0]) if i1 > i0 else (1, ye[j0])
    before, after = values[j0, i0], values[j1, i1]
    for a in range(SUB):
        for b in range(SUB):
            _part(square, a, b, at)
            c, u, v = at[0, axis] - edge * at[0, 2], at[1, axis] - edge * at[1, 2], at[2, axis] - edge * at[2, 2]
            share, old = _half(c, u, v), parts[a, b]
            low, high = before if before >= 0.0 else old, after if after >= 0.0 else old
            parts[a, b] = low + share * (high - low)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _plane_row(rays: Array, M: Array, v: int, u0: int, out: Array) -> bool:
    """Cast the pixel corners of row v from column u0 on to the plane of M, out (3, n) homogeneous; tell if all see it."""
    least = np.inf
    for k in range(out.shape[1]):
        x, y, z = rays[v, u0 + k, 0], rays[v, u0 + k, 1], rays[v, u0 + k, 2]
        for c in range(3):
            out[c, k] = M[c, 0] * x + M[c, 1] * y + M[c, 2] * z
        least = min(least, out[2, k])
    return least > 0.0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _ahead(top: Array, bottom: Array, k: int) -> bool:
    """Tell whether points k and k + 1 of two lines see the plane before them."""
    return bool(min(min(top[2, k], top[2, k + 1]), min(bottom[2, k], bottom[2, k + 1])) > 0.0)


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
        _cells(fan[a], xe, ye, cells[a])
    for a in range(SUB):
        for b in range(SUB):
            span = _span(cells[a], cells[a + 1], b, xe.size + 1)
            if not _uniform(values, span):
                _corners(fan[a], fan[a + 1], b, c)
                parts[a, b] = _clip(c, grid, span, parts[a, b], buffer)
            elif values[span[2], span[0]] >= 0.0:
                parts[a, b] = values[span[2], span[0]]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def paint(
    rays: Array, Ms: Array, box: Box, grid: Grid, coarse: Array, slot: Slots, fine: Array, count: int
) -> tuple[Array, int]:
    """Paint a grid of cells.

    Args:
        rays: (H + 1, W + 1, 3) rays through the corners of the pixels, camera frame.
        Ms: (1 or H, 3, 3) from rays to homogeneous plane coordinates, for all rows or for each.
        box: first column, first row, end column, end row of what may be covered, px.
        grid: borders (nx + 1,), (ny + 1,) and values (ny + 2, nx + 2) of the cells; values have a clear rim.
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
    top, bottom = np.empty((3, n + 1)), np.empty((3, n + 1))
    top_cells, bottom_cells = np.zeros(n + 1, np.int32), np.zeros(n + 1, np.int32)
    square, at = np.empty((4, 3)), np.empty((3, 3))
    fan, fan_cells = np.empty((SUB + 1, 3, SUB + 1)), np.zeros((SUB + 1, SUB + 1), np.int32)
    buffer, ahead, columns, span = np.empty((6, _VERTICES, 5)), False, xe.size + 1, (0, 0, 0, 0)
    for v in range(v0, v1):
        M = Ms[min(v, Ms.shape[0] - 1)]
        if v == v0 or Ms.shape[0] > 1:  # each row of a rolling shutter sees its own plane
            ahead = _plane_row(rays, M, v, u0, bottom)
            _cells(bottom, xe, ye, bottom_cells)
        top, bottom, top_cells, bottom_cells = bottom, top, bottom_cells, top_cells
        all_ahead = ahead
        ahead = _plane_row(rays, M, v + 1, u0, bottom)
        _cells(bottom, xe, ye, bottom_cells)
        all_ahead = all_ahead and ahead
        for k in range(n):
            if not all_ahead and not _ahead(top, bottom, k):
                continue
            cell = top_cells[k]
            whole = top_cells[k + 1] == cell and bottom_cells[k] == cell and bottom_cells[k + 1] == cell
            if not whole:
                span = _span(top_cells, bottom_cells, k, columns)
                whole = _uniform(values, span)
            if whole:
                value = values[cell // columns, cell % columns]
                if value >= 0.0:
                    coarse[v, u0 + k] = value
                    slot[v, u0 + k] = -1
                continue
            fine, s, count = _open_parts(v, u0 + k, coarse, slot, fine, count)
            if span[1] - span[0] + span[3] - span[2] == 1:
                _square(top, bottom, k, square)
                _paint_edge(square, grid, span, at, fine[s])
            else:
                _part_corners(top, bottom, k, fan)
                _paint_parts(fan, fan_cells, grid, fine[s], buffer)
    return fine, count


@numba.njit(cache=True, nogil=True, error_model="numpy")
def paint_disc(
    rays: Array, Ms: Array, box: Box, disc: Array, coarse: Array, slot: Slots, fine: Array, count: int
) -> tuple[Array, int]:
    """Paint a disc.

    Args:
        rays: see :func:`paint`.
        Ms: see there.
        box: see there.
        disc: (4,) centre x, y, radius and value.
        coarse: see there.
        slot: see there.
        fine: see there.
        count: see there.

    Returns:
        As there.
    """
    u0, v0, u1, v1 = box
    n = u1 - u0
    if n <= 0:
        return fine, count
    top, bottom = np.empty((3, n + 1)), np.empty((3, n + 1))
    inside_top, inside_bottom = np.empty(n + 1), np.empty(n + 1)
    square, at, ahead = np.empty((4, 3)), np.empty((3, 3)), False
    for v in range(v0, v1):
        M = Ms[min(v, Ms.shape[0] - 1)]
        if v == v0 or Ms.shape[0] > 1:
            ahead = _plane_row(rays, M, v, u0, bottom)
            _inside(bottom, disc, inside_bottom)
        top, bottom, inside_top, inside_bottom = bottom, top, inside_bottom, inside_top
        all_ahead = ahead
        ahead = _plane_row(rays, M, v + 1, u0, bottom)
        _inside(bottom, disc, inside_bottom)
        all_ahead = all_ahead and ahead
        _square(top, bottom, n // 2, square)
        bulge = _bulge(square, disc)
        for k in range(n):
            if not all_ahead and not _ahead(top, bottom, k):
                continue
            low = min(min(inside_top[k], inside_top[k + 1]), min(inside_bottom[k], inside_bottom[k + 1]))
            high = max(max(inside_top[k], inside_top[k + 1]), max(inside_bottom[k], inside_bottom[k + 1]))
            if low > 0.0:
                coarse[v, u0 + k] = disc[3]
                slot[v, u0 + k] = -1
            elif high > -bulge:
                fine, s, count = _open_parts(v, u0 + k, coarse, slot, fine, count)
                _square(top, bottom, k, square)
                _paint_rim(square, disc, at, fine[s])
    return fine, count
