"""Paint flat patterns into an image by exact area sampling.

The corners of all pixels are cast as rays through the full camera model. A ray meets a pattern's plane at homogeneous
coordinates that are linear in the ray, so inside a pixel they are interpolated linearly from its four corners (exact
for a pinhole, good to 1e-4 px for any lens); every straight edge of the pattern is a straight cut through the pixel.
A pixel that lies in one cell takes its value. A pixel that an edge crosses is split into SUB x SUB parts, and the value
of each is exact in area: one edge, or the rim of a disc, cuts a square in two, whose areas have a closed form (a rim is
straight within a part but for its mean bend there); where several edges meet, a part is clipped by half planes (Sutherland
and Hodgman, CACM 17(1), 1974). The parts are kept, so that the lens's blur is applied to the parts and not to whole pixels.

In this order: pixels cast on to a plane and split into parts; cells of a grid and areas clipped by cells; discs; the
painters :func:`paint_disc` and :func:`paint`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array
from armsight.kernels import kernel

#: Parts of an edge pixel along each side.
SUB = 4

Slots = NDArray[np.int32]
Box = tuple[int, int, int, int]


@kernel(nogil=True)
def half(c: float, u: float, v: float) -> float:
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


@kernel(nogil=True)
def square_of(top: Array, bottom: Array, k: int, out: Array) -> None:
    """Write out (4, 3), what interpolates the area between points k and k + 1 of two lines: middle, slopes, twist."""
    for c in range(3):
        a, b, d, e = top[c, k], top[c, k + 1], bottom[c, k], bottom[c, k + 1]
        out[0, c] = 0.25 * (a + b + d + e)
        out[1, c] = 0.5 * (b - a + e - d)
        out[2, c] = 0.5 * (d - a + e - b)
        out[3, c] = a - b - d + e


@kernel(nogil=True)
def plane_row(rays: Array, M: Array, v: int, u0: int, n: int, out: Array) -> bool:
    """Cast n pixel corners of row v from column u0 on to the plane of M, out (3, n) homogeneous; return if all see it."""
    least = np.inf
    for k in range(n):
        x, y, z = rays[v, u0 + k, 0], rays[v, u0 + k, 1], rays[v, u0 + k, 2]
        for c in range(3):
            out[c, k] = M[c, 0] * x + M[c, 1] * y + M[c, 2] * z
        least = min(least, out[2, k])
    return least > 0.0


@kernel(nogil=True)
def ahead_of(top: Array, bottom: Array, k: int) -> bool:
    """Return whether points k and k + 1 of two lines see the plane before them."""
    return bool(min(min(top[2, k], top[2, k + 1]), min(bottom[2, k], bottom[2, k + 1])) > 0.0)


@kernel(nogil=True)
def open_parts(v: int, u: int, coarse: Array, slot: Slots, fine: Array, count: int) -> tuple[Array, int, int]:
    """Return the parts of a pixel, making them from its one value where it has none yet: parts, slot, count."""
    if slot[v, u] >= 0:
        return fine, slot[v, u], count
    if count == fine.shape[0]:
        forward_selection = np.empty((2 * count, SUB, SUB))
        forward_selection[:count] = fine
        fine = forward_selection
    for a in range(SUB):  # filling such a small part of an array at once is slow
        for b in range(SUB):
            fine[count, a, b] = coarse[v, u]
    slot[v, u] = count
    return fine, count, count + 1


#: A square cut by two pairs of lines has at most 8 corners.
VERTICES = 12

Grid = tuple[Array, Array, Array]
Span = tuple[int, int, int, int]


@kernel(nogil=True)
def _area(p: Array, n: int) -> float:
    """Return the area of the polygon p (n, 5) in its first two columns."""
    twice = 0.0
    for i in range(n):
        j = i + 1 if i + 1 < n else 0
        twice += p[i, 0] * p[j, 1] - p[j, 0] * p[i, 1]
    return 0.5 * abs(twice)


@kernel(nogil=True)
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


@kernel(nogil=True)
def cell_of(edges: Array, x: float, w: float, i: int) -> int:
    """Return which cell x / w lies in, starting to look at i: 0 before the first edge, len(edges) past the last."""
    while i > 0 and x < edges[i - 1] * w:
        i -= 1
    while i < edges.size and x >= edges[i] * w:
        i += 1
    return i


@kernel(nogil=True)
def cells_of(points: Array, xe: Array, ye: Array, n: int, out: Slots) -> None:
    """Write out (n,) in which cell each homogeneous plane point (3, n) lies: its row times the columns, and its column."""
    i = j = 0
    for k in range(n):
        i, j = cell_of(xe, points[0, k], points[2, k], i), cell_of(ye, points[1, k], points[2, k], j)
        out[k] = j * (xe.size + 1) + i


@kernel(nogil=True)
def span_of(a: Slots, b: Slots, k: int, columns: int) -> Span:
    """Return the first and last column and row of the cells of points k and k + 1 of two lines a, b (n,)."""
    i0, i1 = min(a[k] % columns, a[k + 1] % columns), max(a[k] % columns, a[k + 1] % columns)
    j0, j1 = min(a[k], a[k + 1]), max(a[k], a[k + 1])
    for m in (k, k + 1):
        i0, i1 = min(i0, b[m] % columns), max(i1, b[m] % columns)
        j0, j1 = min(j0, b[m]), max(j1, b[m])
    return i0, i1, j0 // columns, j1 // columns


@kernel(nogil=True)
def uniform(values: Array, span: Span) -> bool:
    """Return whether all cells of a span have one value."""
    i0, i1, j0, j1 = span
    first = values[j0, i0]
    for j in range(j0, j1 + 1):
        for i in range(i0, i1 + 1):
            if values[j, i] != first:
                return False
    return True


@kernel(nogil=True)
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


@kernel(nogil=True)
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


@kernel(nogil=True)
def _corners(top: Array, bottom: Array, k: int, c: Array) -> None:
    """Gather c (4, 3), the corners, in cyclic order, of the area between points k and k + 1 of two lines (3, n)."""
    for n in range(3):
        c[0, n], c[1, n], c[2, n], c[3, n] = top[n, k], top[n, k + 1], bottom[n, k + 1], bottom[n, k]


@kernel(nogil=True)
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


Line = tuple[float, float, float]


@kernel(nogil=True)
def _chord(c: float, u: float, v: float) -> tuple[float, float, float, float]:
    """Return the ends of the line c + u x + v y = 0 within the square of :func:`half`; its middle where it misses."""
    steep = abs(u) < abs(v)
    if steep:
        u, v = v, u
    if 2 * abs(c) >= abs(u) + abs(v) or u == 0.0:
        return 0.0, 0.0, 0.0, 0.0
    per = 1.0 / u
    x0, y0, x1, y1 = (0.5 * v - c) * per, -0.5, (-0.5 * v - c) * per, 0.5
    if abs(x0) > 0.5:
        x0 = 0.5 if x0 > 0.0 else -0.5
        y0 = -(c + u * x0) / v
    if abs(x1) > 0.5:
        x1 = 0.5 if x1 > 0.0 else -0.5
        y1 = -(c + u * x1) / v
    return (y0, x0, y1, x1) if steep else (x0, y0, x1, y1)


@kernel(nogil=True)
def _inside_rim(x: Line, y: Line, w: Line) -> float:
    """Return in which share of an area a disc is whose rim is nearly straight there.

    x, y: offset from the disc's centre, homogeneous, in the area's middle, and its slopes across and down; w: of the
    radius.
    """
    away = max(np.sqrt(x[0] * x[0] + y[0] * y[0]), 1e-3 * w[0])
    per = 1.0 / away
    u, v = w[1] - (x[0] * x[1] + y[0] * y[1]) * per, w[2] - (x[0] * x[2] + y[0] * y[2]) * per
    c = w[0] - away
    # The rim bends away from its tangent, by the mean square of the way along it within the area, over its diameter.
    su, sv, eu, ev = _chord(c, u, v)
    sx, sy, ex, ey = su * x[1] + sv * x[2], su * y[1] + sv * y[2], eu * x[1] + ev * x[2], eu * y[1] + ev * y[2]
    way = (sx * (sx + ex) + ex * ex + sy * (sy + ey) + ey * ey) / 3
    return half(c - 0.5 * max(way - c * c, 0.0) * per, u, v)


@kernel(nogil=True)
def _inside(points: Array, disc: Array, out: Array) -> None:
    """Write out (n,), above zero where homogeneous plane points (3, n) lie in a disc: squares of distances within."""
    for k in range(out.size):
        x, y = points[0, k] - disc[0] * points[2, k], points[1, k] - disc[1] * points[2, k]
        w = disc[2] * points[2, k]
        out[k] = w * w - x * x - y * y


@kernel(nogil=True)
def _bulge(square: Array, disc: Array) -> float:
    """Return twice by how much a point in a pixel may be further in a disc, as :func:`_inside` counts, than its corners."""
    total = 0.0
    for k in range(1, 3):
        x, y = square[k, 0] - disc[0] * square[k, 2], square[k, 1] - disc[1] * square[k, 2]
        total += 0.5 * (x * x + y * y)
    return total


@kernel(nogil=True)
def _about(square: Array, n: int, scale: float, offset: float) -> tuple[float, float, float, float]:
    """Return ``scale`` times coordinate n of a pixel less ``offset`` times its last: middle, slopes, twist."""
    return (
        scale * square[0, n] - offset * square[0, 2],
        scale * square[1, n] - offset * square[1, 2],
        scale * square[2, n] - offset * square[2, 2],
        scale * square[3, n] - offset * square[3, 2],
    )


@kernel(nogil=True)
def _paint_rim(square: Array, disc: Array, fine: Array, s: int) -> None:
    """Repaint the parts fine[s] (SUB, SUB) of a pixel that a disc's rim crosses."""
    x, y, w = _about(square, 0, 1.0, disc[0]), _about(square, 1, 1.0, disc[1]), _about(square, 2, disc[2], 0.0)
    # By how much the square of the distance within may change in half a part, at most.
    steep = abs(w[0] * w[1] - x[0] * x[1] - y[0] * y[1]) + abs(w[0] * w[2] - x[0] * x[2] - y[0] * y[2])
    most = (steep + 2 * (x[1] * x[1] + x[2] * x[2] + y[1] * y[1] + y[2] * y[2])) / SUB
    for a in range(SUB):
        down = (a + 0.5) / SUB - 0.5
        for b in range(SUB):
            across = (b + 0.5) / SUB - 0.5
            both = across * down
            px = x[0] + across * x[1] + down * x[2] + both * x[3]
            py = y[0] + across * y[1] + down * y[2] + both * y[3]
            pw = w[0] + across * w[1] + down * w[2] + both * w[3]
            inside = pw * pw - px * px - py * py
            if inside > most:
                fine[s, a, b] = disc[3]
            elif inside > -most:
                share = _inside_rim(
                    (px, (x[1] + down * x[3]) / SUB, (x[2] + across * x[3]) / SUB),
                    (py, (y[1] + down * y[3]) / SUB, (y[2] + across * y[3]) / SUB),
                    (pw, (w[1] + down * w[3]) / SUB, (w[2] + across * w[3]) / SUB),
                )
                fine[s, a, b] += share * (disc[3] - fine[s, a, b])


@kernel(
    "f8[:, :, ::1], f8[:, :, ::1], (i8, i8, i8, i8), (i8, i8), f8[::1], f8[:, ::1], i4[:, ::1], f8[:, :, ::1], i8",
    nogil=True,
)
def paint_disc(
    rays: Array,
    Ms: Array,
    box: Box,
    corner: tuple[int, int],
    disc: Array,
    coarse: Array,
    slot: Slots,
    fine: Array,
    count: int,
) -> tuple[Array, int]:
    """Paint a disc (4,): centre x, y, radius and value; all else as in :func:`paint`."""
    u0, v0, u1, v1 = box
    n = u1 - u0
    if n <= 0:
        return fine, count
    top, bottom = np.empty((3, n + 1)), np.empty((3, n + 1))
    inside_top, inside_bottom = np.empty(n + 1), np.empty(n + 1)
    square, ahead = np.empty((4, 3)), False
    for v in range(v0, v1):
        M = Ms[min(v, Ms.shape[0] - 1)]
        if v == v0 or Ms.shape[0] > 1:
            ahead = plane_row(rays, M, v + corner[1], u0 + corner[0], n + 1, bottom)
            _inside(bottom, disc, inside_bottom)
        top, bottom, inside_top, inside_bottom = bottom, top, inside_bottom, inside_top
        all_ahead = ahead
        ahead = plane_row(rays, M, v + 1 + corner[1], u0 + corner[0], n + 1, bottom)
        _inside(bottom, disc, inside_bottom)
        all_ahead = all_ahead and ahead
        square_of(top, bottom, n // 2, square)
        bulge = _bulge(square, disc)
        for k in range(n):
            if not all_ahead and not ahead_of(top, bottom, k):
                continue
            low = min(min(inside_top[k], inside_top[k + 1]), min(inside_bottom[k], inside_bottom[k + 1]))
            high = max(max(inside_top[k], inside_top[k + 1]), max(inside_bottom[k], inside_bottom[k + 1]))
            if low > 0.0:
                coarse[v, u0 + k] = disc[3]
                slot[v, u0 + k] = -1
            elif high > -bulge:
                fine, s, count = open_parts(v, u0 + k, coarse, slot, fine, count)
                square_of(top, bottom, k, square)
                _paint_rim(square, disc, fine, s)
    return fine, count


_TILE = 8  # pixels on a side that are passed over together

Corners = tuple[float, float, float, float]


@kernel(nogil=True)
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


@kernel(nogil=True)
def _past(rays: Array, M: Array, at: tuple[int, int], axis: int, edge: float, out: Array) -> None:
    """Write how far past an edge, homogeneous, the pixel corners are that follow ``at`` (row, column), out (n,)."""
    x, y, z = M[axis, 0] - edge * M[2, 0], M[axis, 1] - edge * M[2, 1], M[axis, 2] - edge * M[2, 2]
    for k in range(out.size):
        out[k] = x * rays[at[0], at[1] + k, 0] + y * rays[at[0], at[1] + k, 1] + z * rays[at[0], at[1] + k, 2]


@kernel(nogil=True)
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


@kernel(nogil=True)
def _reach(rays: Array, Ms: Array, tile: Box, corner: tuple[int, int], grid: Grid) -> tuple[bool, Span]:
    """Return whether all of a tile of pixels sees the plane before it, and between which cells it lies at most.

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


Scratch = tuple[Array, Array, Slots, Slots, Array, Array, Slots]


@kernel(nogil=True)
def _paint_cells(
    rays: Array,
    Ms: Array,
    tile: Box,
    corner: tuple[int, int],
    grid: Grid,
    scratch: Scratch,
    coarse: Array,
    slot: Slots,
    fine: Array,
    count: int,
) -> tuple[Array, int]:
    """Paint a tile of pixels in which several edges meet; see :func:`paint`."""
    xe, ye, values = grid
    u0, v0, u1, v1 = tile
    top, bottom, top_cells, bottom_cells, buffer, fan, fan_cells = scratch
    flat, ahead, columns, span = values.reshape(-1), False, xe.size + 1, (0, 0, 0, 0)
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


@kernel(
    "f8[:, :, ::1], f8[:, :, ::1], (i8, i8, i8, i8), (i8, i8), (f8[::1], f8[::1], f8[:, ::1]), f8[:, ::1], "
    "i4[:, ::1], f8[:, :, ::1], i8",
    nogil=True,
)
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
    """Paint a grid of cells: borders (nx + 1,), (ny + 1,) and values (ny + 2, nx + 2), with a clear rim.

    rays (H' + 1, W' + 1, 3): through the corners of the camera's pixels, its frame; Ms (1 or H, 3, 3): from rays to
    homogeneous plane coordinates, for all rows or for each; ``box``: what may be covered; ``corner``: where in the
    camera's image ``box``, coarse (H, W) and slot (H, W) begin. A value below zero is clear. ``count`` rows of fine
    (capacity, SUB, SUB) are in use; return ``fine``, a larger one where it was full, and the new count.
    """
    xe, ye, values = grid
    scratch = (
        np.empty((3, _TILE + 1)),
        np.empty((3, _TILE + 1)),
        np.zeros(_TILE + 1, np.int32),
        np.zeros(_TILE + 1, np.int32),
        np.empty((6, VERTICES, 5)),
        np.empty((SUB + 1, 3, SUB + 1)),
        np.zeros((SUB + 1, SUB + 1), np.int32),
    )
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
        fine, count = _paint_cells(rays, Ms, (u0, v0, u1, v1), corner, grid, scratch, coarse, slot, fine, count)
    return fine, count
