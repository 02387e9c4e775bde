"""The window about an X corner: which pixels a fit sees, and the moments of those that lie on plain squares."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from armsight.data import Array
from armsight.vision.markers.crossing import GREY, ROOM, Work, Y
from armsight.vision.markers.normal import LANES

#: How far the window reaches along each square's side, as a share of the side, and at most in px. The next corners
#: stay out of it with their blur.
WINDOW_SHARE, WINDOW_MAX_PX = 0.42, 12.0
#: Where squares carry a print, this much more room is left beside it, px, for its blur.
ARM_GAP_PX = 1.5
#: A fit with many more pixels near edges than this is first made with about so many.
PIXELS_FIRST = 64


@numba.njit(cache=True, error_model="numpy")
def gather(
    image: NDArray[np.uint8],
    c: Array,
    square: Array,
    bow: Array,
    arm: float,
    most: float,
    near: Array,
    w: Work,
    flat: Array,
) -> int:
    """Collect the pixels of the window about a corner: those near an edge into w, the others into the moments.

    Args:
        image: (H, W) grey image.
        c: (2,) the corner; places are counted from the whole pixel next to it.
        square: (2, 2) the sides of the square at it, px.
        bow: (2, 2) how the edges bow, 1/px.
        arm: as ``refine_corners`` takes it.
        most: how far the window reaches along the sides at most, px.
        near: (2,) how far from each edge a pixel is near it, px.
        w: (WORK,) receives x, y and grey of the pixels near the edges.
        flat: (2, MOMENTS) receives the moments of those of plain squares.

    Returns:
        How many pixels are near.
    """
    height, width = image.shape
    s1, s2 = np.hypot(square[0, 0], square[0, 1]), np.hypot(square[1, 0], square[1, 1])
    m1, m2 = min(WINDOW_SHARE, most / s1), min(WINDOW_SHARE, most / s2)
    arm1, arm2 = max(0.5 * arm, arm - ARM_GAP_PX / s1), max(0.5 * arm, arm - ARM_GAP_PX / s2)
    det = square[0, 0] * square[1, 1] - square[0, 1] * square[1, 0]
    # Along the sides: u = ux dx + uy dy, v = vx dx + vy dy; edge 1 runs along the first side, where v is 0.
    ux, uy, vx, vy = square[1, 1] / det, -square[1, 0] / det, -square[0, 1] / det, square[0, 0] / det
    near_v = (near[0] + np.hypot(bow[0, 0], bow[0, 1]) * (m1 * s1) ** 2) * s1 / abs(det)
    near_u = (near[1] + np.hypot(bow[1, 0], bow[1, 1]) * (m2 * s2) ** 2) * s2 / abs(det)
    x0, y0 = int(np.rint(c[0])), int(np.rint(c[1]))
    cx, cy = c[0] - x0, c[1] - y0
    ry = m1 * abs(square[0, 1]) + m2 * abs(square[1, 1])
    flat[:] = 0.0
    n = 0
    for y in range(max(-y0, int(np.ceil(cy - ry))), min(height - 1 - y0, int(np.floor(cy + ry))) + 1):
        u0, v0 = uy * (y - cy) - ux * cx, vy * (y - cy) - vx * cx
        low, high = -float(x0), float(width - 1 - x0)
        for slope, middle, reach in ((ux, u0, m1), (vx, v0, m2)):
            if abs(slope) > 1e-9:
                half, centre = reach / abs(slope), -middle / slope
                low, high = max(low, centre - half), min(high, centre + half)
            elif abs(middle) > reach:
                high = low - 1.0
        row = image[y0 + y]
        p_n = p_x = p_xx = p_i = p_ix = p_ii = m_n = m_x = m_xx = m_i = m_ix = m_ii = 0
        for x in range(int(np.ceil(low)), int(np.floor(high)) + 1):
            u, v = u0 + ux * x, v0 + vx * x
            grey: Any = np.int64(row[x0 + x])
            if abs(v) < near_v or abs(u) < near_u:
                if n < ROOM - LANES and (abs(u) <= arm1 or abs(v) <= arm2):
                    w[n], w[Y + n], w[GREY + n] = x, y, grey
                    n += 1
            elif abs(u) <= arm1 or abs(v) <= arm2:
                if u * v > 0.0:
                    p_n, p_x, p_xx, p_i = p_n + 1, p_x + x, p_xx + x * x, p_i + grey
                    p_ix, p_ii = p_ix + x * grey, p_ii + grey * grey
                else:
                    m_n, m_x, m_xx, m_i = m_n + 1, m_x + x, m_xx + x * x, m_i + grey
                    m_ix, m_ii = m_ix + x * grey, m_ii + grey * grey
        _add_row(flat[0], y, p_n, p_x, p_xx, p_i, p_ix, p_ii)
        _add_row(flat[1], y, m_n, m_x, m_xx, m_i, m_ix, m_ii)
    return n


@numba.njit(cache=True, error_model="numpy", forceinline=True)
def _add_row(m: Array, y: int, n: int, x: int, xx: int, i: int, ix: int, ii: int) -> None:
    """Add the sums of a row of pixels to the moments m, in the order of crossing.MOMENTS."""
    m[0] += n
    m[1] += x
    m[2] += n * y
    m[3] += xx
    m[4] += x * y
    m[5] += n * y * y
    m[6] += i
    m[7] += ix
    m[8] += i * y
    m[9] += ii


@numba.njit(cache=True, error_model="numpy")
def thin(n: int, w: Work, flat: Array) -> int:
    """Leave a share of the pixels; return how many."""
    step = max(1, n // PIXELS_FIRST)
    few = (n + step - 1) // step
    for i in range(few):
        w[i], w[Y + i], w[GREY + i] = w[i * step], w[Y + i * step], w[GREY + i * step]
    flat /= step
    return few


@numba.njit(cache=True, error_model="numpy")
def fill_up(n: int, w: Work) -> None:
    """Repeat the last pixel to the end of a vector."""
    for i in range(n, n + LANES):
        w[i], w[Y + i], w[GREY + i] = w[n - 1], w[Y + n - 1], w[GREY + n - 1]


@numba.njit(cache=True, error_model="numpy")
def reach_px(square: Array) -> float:
    """Return how far the window reaches along the shorter side of a square, px."""
    shorter = min(np.hypot(square[0, 0], square[0, 1]), np.hypot(square[1, 0], square[1, 1]))
    return float(min(WINDOW_SHARE * shorter, WINDOW_MAX_PX))
