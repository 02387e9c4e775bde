"""Paint discs as ``paint`` paints cells: a rim is straight within a part of a pixel but for its mean bend there."""

from __future__ import annotations

import numba
import numpy as np

from armsight.data import Array
from armsight.sim.paint_parts import SUB, Box, Slots, ahead_of, half, open_parts, plane_row, square_of

Line = tuple[float, float, float]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _chord(c: float, u: float, v: float) -> tuple[float, float, float, float]:
    """Return the ends of the line c + u x + v y = 0 within the square of :func:`half`; its middle where it misses."""
    turned = abs(u) < abs(v)
    if turned:
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
    return (y0, x0, y1, x1) if turned else (x0, y0, x1, y1)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _inside_rim(x: Line, y: Line, w: Line) -> float:
    """Return in which share of an area a disc is whose rim is nearly straight there.

    Args:
        x: offset from the disc's centre, homogeneous: in the area's middle, and its slopes across and down.
        y: the same down.
        w: the same of the radius.
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
def _about(square: Array, n: int, scale: float, offset: float) -> tuple[float, float, float, float]:
    """Return ``scale`` times coordinate n of a pixel less ``offset`` times its last: middle, slopes, twist."""
    return (
        scale * square[0, n] - offset * square[0, 2],
        scale * square[1, n] - offset * square[1, 2],
        scale * square[2, n] - offset * square[2, 2],
        scale * square[3, n] - offset * square[3, 2],
    )


@numba.njit(cache=True, nogil=True, error_model="numpy")
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


@numba.njit(cache=True, nogil=True, error_model="numpy")
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
    """Paint a disc.

    Args:
        rays: see :func:`paint`.
        Ms: see there.
        box: see there.
        corner: see there.
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
