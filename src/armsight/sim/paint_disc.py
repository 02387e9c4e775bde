"""Paint discs as ``paint`` paints cells: a rim is straight within a part of a pixel but for its mean bend there."""

from __future__ import annotations

import numba
import numpy as np

from armsight.data import Array
from armsight.sim.paint_parts import SUB, Box, Slots, ahead_of, half, open_parts, part, plane_row, square_of


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _chord(c: float, u: float, v: float) -> tuple[float, float, float, float]:
    """Return the ends of the line c + u x + v y = 0 within the square of :func:`half`; its middle where it misses."""
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
    return half(c - max(square - c * c, 0.0) / (2 * away), u, v)


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
            part(square, a, b, at)
            parts[a, b] += _inside_rim(at, disc) * (disc[3] - parts[a, b])


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
            ahead = plane_row(rays, M, v, u0, bottom)
            _inside(bottom, disc, inside_bottom)
        top, bottom, inside_top, inside_bottom = bottom, top, inside_bottom, inside_top
        all_ahead = ahead
        ahead = plane_row(rays, M, v + 1, u0, bottom)
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
                _paint_rim(square, disc, at, fine[s])
    return fine, count
