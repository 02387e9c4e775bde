"""Cells of a grid where several edges meet in a pixel: which cell a place lies in, and areas clipped by cells.

See ``paint``; polygons are clipped by half planes (Sutherland and Hodgman, CACM 17(1), 1974).
"""

from __future__ import annotations

import numba
import numpy as np

from armsight.data import Array
from armsight.sim.paint_parts import SUB, Slots

#: A square cut by two pairs of lines has at most 8 corners.
VERTICES = 12

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
def cell_of(edges: Array, x: float, w: float, i: int) -> int:
    """Return which cell x / w lies in, starting to look at i: 0 before the first edge, len(edges) past the last."""
    while i > 0 and x < edges[i - 1] * w:
        i -= 1
    while i < edges.size and x >= edges[i] * w:
        i += 1
    return i


@numba.njit(cache=True, nogil=True, error_model="numpy")
def cells_of(points: Array, xe: Array, ye: Array, n: int, out: Slots) -> None:
    """Write out (n,) in which cell each homogeneous plane point (3, n) lies: its row times the columns, and its column."""
    i = j = 0
    for k in range(n):
        i, j = cell_of(xe, points[0, k], points[2, k], i), cell_of(ye, points[1, k], points[2, k], j)
        out[k] = j * (xe.size + 1) + i


@numba.njit(cache=True, nogil=True, error_model="numpy")
def span_of(a: Slots, b: Slots, k: int, columns: int) -> Span:
    """Return the first and last column and row of the cells of points k and k + 1 of two lines a, b (n,)."""
    i0, i1 = min(a[k] % columns, a[k + 1] % columns), max(a[k] % columns, a[k + 1] % columns)
    j0, j1 = min(a[k], a[k + 1]), max(a[k], a[k + 1])
    for m in (k, k + 1):
        i0, i1 = min(i0, b[m] % columns), max(i1, b[m] % columns)
        j0, j1 = min(j0, b[m]), max(j1, b[m])
    return i0, i1, j0 // columns, j1 // columns


@numba.njit(cache=True, nogil=True, error_model="numpy")
def uniform(values: Array, span: Span) -> bool:
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
def part_corners(top: Array, bottom: Array, k: int, out: Array) -> None:
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
def clip_parts(fan: Array, cells: Slots, grid: Grid, parts: Array, buffer: Array) -> None:
    """Repaint the parts (SUB, SUB) of a pixel whose part corners lie at fan (SUB + 1, 3, SUB + 1) of the plane."""
    xe, ye, values = grid
    c = buffer[5, :4, :3]
    for a in range(SUB + 1):
        cells_of(fan[a], xe, ye, SUB + 1, cells[a])
    for a in range(SUB):
        for b in range(SUB):
            span = span_of(cells[a], cells[a + 1], b, xe.size + 1)
            if not uniform(values, span):
                _corners(fan[a], fan[a + 1], b, c)
                parts[a, b] = _clip(c, grid, span, parts[a, b], buffer)
            elif values[span[2], span[0]] >= 0.0:
                parts[a, b] = values[span[2], span[0]]
