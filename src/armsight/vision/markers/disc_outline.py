"""A start for the fit of a disc: the chord through a pixel on it, the chord across that, and sixteen rays outwards.

Where they end gives an ellipse, or the reason why there is none.
"""

from __future__ import annotations

from typing import TypeAlias

import numba
import numpy as np
from numpy.typing import NDArray

from armsight.data import Array
from armsight.vision.markers.disc_model import factor, solve

#: Longest half chord, px: half of the largest disc, blur and all.
_REACH = 44
_RAYS = 16
_COS = np.cos(2 * np.pi * np.arange(_RAYS) / _RAYS)
_SIN = np.sin(2 * np.pi * np.arange(_RAYS) / _RAYS)

Grey = NDArray[np.uint8]
Room: TypeAlias = tuple[Array, Array, Array, Array, Array, Array]


@numba.njit(cache=True, error_model="numpy")
def _walk(image: Grey, x: int, y: int, dx: int, dy: int, half: int, sign: int) -> int:
    """Return how many pixels from (x, y) along (dx, dy) are on the disc's side of ``half``; -1 where there is no end."""
    height, width = image.shape
    for k in range(1, 2 * _REACH):
        x += dx
        y += dy
        if x < 0 or y < 0 or x >= width or y >= height:
            return -1
        if sign * (np.int64(image[y, x]) - half) <= 0:
            return k - 1
    return -1


@numba.njit(cache=True, error_model="numpy")
def outline(image: Grey, x: int, y: int, low: int, sign: int, theta: Array, room: Room) -> int:
    """Look around a pixel on a disc and make a start for the fit of it.

    Args:
        image: (H, W) grey.
        x: column of a pixel that is on the disc.
        y: its row.
        low: grey level of the surround.
        sign: 1 for a bright disc, -1 for a dark one.
        theta: (10,) filled: centre, M, blur, contrast, base, gradient.
        room: what :func:`workspace` returns.

    Returns:
        0, or why there is no disc (disc_fit.REASONS).
    """
    height, width = image.shape
    half = 0
    for _ in range(2):
        half = (low + int(image[y, x])) // 2
        left, right = _walk(image, x, y, -1, 0, half, sign), _walk(image, x, y, 1, 0, half, sign)
        if left < 0 or right < 0:
            return 9
        x += (right - left) // 2
        up, down = _walk(image, x, y, 0, -1, half, sign), _walk(image, x, y, 0, 1, half, sign)
        if up < 0 or down < 0:
            return 9
        y += (down - up) // 2
    if left + right < 2 or up + down < 2 or left + right + up + down + 2 < 8:
        return 7
    H, g, a, L, scale, p = room
    H[:, :] = 0.0
    g[:] = 0.0
    within = 0.0
    start = int(0.6 * min(min(left, right), min(up, down)))
    for k in range(_RAYS):
        c, s = _COS[k], _SIN[k]
        before = np.float64(image[y, x])  # nearer pixels than the first step are on the disc
        radius = -1.0
        for step in range(start + 1, _REACH):
            u, v = x + step * c, y + step * s
            if u < 0.0 or v < 0.0 or u >= width - 1.0 or v >= height - 1.0:
                return 1
            i, j = int(u), int(v)
            fu, fv = u - i, v - j
            level = (1 - fv) * ((1 - fu) * image[j, i] + fu * image[j, i + 1]) + fv * (
                (1 - fu) * image[j + 1, i] + fu * image[j + 1, i + 1]
            )
            if sign * (level - half) <= 0.0:
                radius = step - 1.0 + (before - half) / (before - level)
                break
            before = level
        if radius < 0.0:
            return 9
        u, v = radius * c, radius * s
        within += radius * radius
        a[0], a[1], a[2], a[3], a[4] = u * u, 2 * u * v, v * v, u, v
        # Each ray is weighed so that the algebraic distance becomes one along the ray.
        w = 1.0 / (radius * radius)
        for m in range(5):
            g[m] += w * a[m]
            for n in range(m + 1):
                H[m, n] += w * a[m] * a[n]
    for m in range(5):
        for n in range(m):
            H[n, m] = H[m, n]
    if not factor(H, L, scale):
        return 2
    solve(L, scale, g, p)
    det = p[0] * p[2] - p[1] * p[1]
    if not (p[0] > 0.0 and det > 1e-3 * p[0] * p[2]):
        return 2
    cu, cv = -0.5 * (p[2] * p[3] - p[1] * p[4]) / det, -0.5 * (p[0] * p[4] - p[1] * p[3]) / det
    size = 1.0 + p[0] * cu * cu + 2 * p[1] * cu * cv + p[2] * cv * cv
    if not (size > 0.0 and cu * cu + cv * cv < within / _RAYS):
        return 2
    theta[0], theta[1] = x + cu, y + cv
    theta[2], theta[3], theta[4] = p[0] / size, p[1] / size, p[2] / size
    theta[5] = 0.9
    # Levels: at the centre, and on a ring outside.
    inside, outside = np.float64(image[y, x]), 0.0
    for k in range(0, _RAYS, 2):
        reach = 1.25 * np.sqrt(within / _RAYS) + 2.0
        i, j = int(np.rint(theta[0] + reach * _COS[k])), int(np.rint(theta[1] + reach * _SIN[k]))
        outside += image[min(max(j, 0), height - 1), min(max(i, 0), width - 1)] / (_RAYS / 2)
    theta[6], theta[7], theta[8], theta[9] = inside - outside, outside, 0.0, 0.0
    if not sign * theta[6] > 0.0:
        theta[6] = 2.0 * (inside - half)
        theta[7] = half - (inside - half)
    return 0


def workspace() -> Room:
    """Return the arrays that :func:`outline` works in."""
    return np.empty((5, 5)), np.empty(5), np.empty(5), np.empty((5, 5)), np.empty(5), np.empty(5)
