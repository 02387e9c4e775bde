"""What a disc's fit leaves tells discs from what looks like one: its rim, its inside, gradients it did not know of."""

from __future__ import annotations

import numba
import numpy as np

from armsight.data import Array
from armsight.vision.markers.disc_model import UNKNOWNS, F, Work, solve

#: Parts that the rim is judged in.
SECTORS = 16
_ZERO = F(0.0)


@numba.njit(cache=True, error_model="numpy", fastmath=True)
def spread(n: int, work: Work, flat: Array) -> None:
    """Fill the mean squares of the residuals inside and outside, away from the rim, and their counts (4,)."""
    residual, inside = work.residual, work.inside
    square_in, square_out, count_in, count_out = F(0.0), F(0.0), F(0.0), F(0.0)
    for i in range(n):
        square = residual[i] * residual[i]
        disc = F(1.0) if inside[i] > F(0.995) else F(0.0)
        surround = F(1.0) if inside[i] < F(0.005) else F(0.0)
        square_in += disc * square
        square_out += surround * square
        count_in += disc
        count_out += surround
    flat[0], flat[1] = square_in / max(count_in, F(1.0)), square_out / max(count_out, F(1.0))
    flat[2], flat[3] = count_in, count_out


@numba.njit(cache=True, error_model="numpy", fastmath=True)
def clipped(n: int, work: Work) -> int:
    """Count the pixels that are black or white to the last level."""
    level, count = work.level, np.int32(0)
    for i in range(n):
        count += np.int32(1) if level[i] <= F(0.0) or level[i] >= F(255.0) else np.int32(0)
    return int(count)


@numba.njit(cache=True, error_model="numpy", fastmath=True)
def _stepped(n: int, work: Work) -> None:
    """Fill ``work.left``, the residuals after the last step; ``work.residual`` is before it."""
    residual, J, left = work.residual, work.J, work.left
    x0, x1, x2, x3, x4, x5, x6, x7, x8, x9 = work.x.astype(np.float32)
    for i in range(n):
        shape = x2 * J[2, i] + x3 * J[3, i] + x4 * J[4, i] + x5 * J[5, i]
        light = x6 * J[6, i] + x7 * J[7, i] + x8 * J[8, i] + x9 * J[9, i]
        left[i] = residual[i] - x0 * J[0, i] - x1 * J[1, i] - shape - light


@numba.njit(cache=True, error_model="numpy")
def rim(n: int, theta: Array, x0: float, y0: float, work: Work, sectors: Array) -> None:
    """Fill, for each sixteenth of the rim, how far it lies outside the ellipse, px, and the weight of that (2, 16)."""
    px, py, J, inside = work.px, work.py, work.J, work.inside
    sectors[:, :] = 0.0
    cx, cy = F(theta[0] - x0), F(theta[1] - y0)
    left = work.left
    _stepped(n, work)
    for i in range(n):
        if F(0.03) < inside[i] < F(0.97):
            square = J[0, i] * J[0, i] + J[1, i] * J[1, i]
            u, v = px[i] - cx, py[i] - cy
            a, b = abs(u), abs(v)
            k = 8 * (u > F(0.0)) + 4 * (v > F(0.0)) + 2 * (a > b) + (min(a, b) > F(0.41421356) * max(a, b))
            sectors[0, k] += np.sqrt(square) * left[i]
            sectors[1, k] += square
    for k in range(SECTORS):
        sectors[0, k] /= max(sectors[1, k], 1e-12)


@numba.njit(cache=True, error_model="numpy")
def texture_factor(n: int, blur: float, texture: float, work: Work) -> float:
    """Return how many times larger the centre's variance is because neighbouring pixels of a texture are alike.

    The correlation of neighbours, k, gives (1 + k) / (1 - k) pixels that vary as one along the rim, and at most the width
    of the edge across it; it counts by the share that the texture has in what tells the centre.
    """
    px, py, J, residual, inside = work.px, work.py, work.J, work.residual, work.inside
    square, product = 0.0, 0.0
    by_texture, by_all = 0.0, 1e-12
    for i in range(n):
        if inside[i] < F(0.005):
            square += residual[i] * residual[i]
            if i + 1 < n and py[i + 1] == py[i] and px[i + 1] == px[i] + F(1.0):
                product += residual[i] * residual[i + 1]
        tells = J[0, i] * J[0, i] + J[1, i] * J[1, i]
        rest = 1.0 - inside[i]
        by_texture += tells * texture * rest * rest / (1.0 + texture * rest * rest)
        by_all += tells
    k = min(max(product / max(square, 1e-12), 0.0), 0.95)
    along = (1.0 + k) / (1.0 - k)
    return 1.0 + (along * min(along, 1.0 + 2.0 * blur) - 1.0) * by_texture / by_all


@numba.njit(cache=True, error_model="numpy")
def of_centre(work: Work, cov: Array) -> None:
    """Fill the (2, 2) block of H^-1 that is the centre's."""
    g, L, scale, x = work.g, work.L, work.scale, work.x
    for a in range(2):
        g[:] = 0.0
        g[a] = 1.0
        solve(L, scale, g, x)
        cov[a, 0], cov[a, 1] = x[0], x[1]


@numba.njit(cache=True, error_model="numpy", fastmath=True)
def _inside_products(n: int, cx: np.float32, cy: np.float32, work: Work, out: Array) -> None:
    """Fill the products of the columns of a gradient of the disc's own, u and v times its share.

    Args:
        n: pixels.
        cx: the centre, as the pixels have it.
        cy: see cx.
        work: the pixels, linearised.
        out: (2, 13) filled: with each column of J, with the residual, with u and with v.
    """
    px, py, J, residual = work.px, work.py, work.J, work.residual
    uu, uv, vv, ru, rv = _ZERO, _ZERO, _ZERO, _ZERO, _ZERO
    for i in range(n):
        share = J[6, i]
        u, v = share * (px[i] - cx), share * (py[i] - cy)
        ru += u * residual[i]
        rv += v * residual[i]
        uu += u * u
        uv += u * v
        vv += v * v
    for a in range(UNKNOWNS):
        total_u, total_v = _ZERO, _ZERO
        for i in range(n):
            weighed = J[6, i] * J[a, i]
            total_u += weighed * (px[i] - cx)
            total_v += weighed * (py[i] - cy)
        out[0, a], out[1, a] = total_u, total_v
    out[0, 10], out[1, 10] = ru, rv
    out[0, 11], out[0, 12], out[1, 11], out[1, 12] = uu, uv, uv, vv


@numba.njit(cache=True, error_model="numpy")
def slope_inside(n: int, theta: Array, x0: float, y0: float, work: Work) -> float:
    """Return what chi-square would gain from a gradient of the disc's own, in units of the noise's variance."""
    g, L, scale, x, out = work.g, work.L, work.scale, work.x, work.products
    _inside_products(n, F(theta[0] - x0), F(theta[1] - y0), work, out)
    s0, s1 = out[0, 10], out[1, 10]
    k00, k01, k11 = out[0, 11], out[0, 12], out[1, 12]
    # The residual is the one before the last step x = H^-1 g; then the columns as far as J does not explain them.
    for a in range(UNKNOWNS):
        s0 -= out[0, a] * x[a]
        s1 -= out[1, a] * x[a]
    g[:] = out[0, :UNKNOWNS]
    solve(L, scale, g, x)
    for a in range(UNKNOWNS):
        k00 -= out[0, a] * x[a]
        k01 -= out[1, a] * x[a]
    g[:] = out[1, :UNKNOWNS]
    solve(L, scale, g, x)
    for a in range(UNKNOWNS):
        k11 -= out[1, a] * x[a]
    det = k00 * k11 - k01 * k01
    if not det > 0.0:
        return 0.0
    return float((k11 * s0 * s0 - 2 * k01 * s0 * s1 + k00 * s1 * s1) / det)


@numba.njit(cache=True, error_model="numpy")
def slope_outside(theta: Array, work: Work) -> float:
    """Return what chi-square would lose without the surround's gradient, in units of the noise's variance."""
    L, a, b = work.L, theta[8] / work.scale[8], theta[9] / work.scale[9]
    # Of the last two unknowns the factor's last corner is that of their information, the others' share taken out.
    return float((a / L[8, 8] + b * L[9, 8]) ** 2 + (b / L[9, 9]) ** 2)
