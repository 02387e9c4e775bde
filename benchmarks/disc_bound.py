"""The Cramer-Rao bound of a disc's centre: how well any unbiased finder can locate it, given the noise.

The model is the generator's own noise-free image of one disc, over all pixels of the ellipse's box, four blur sigmas and
four pixels more on every side. Ten parameters are free: the centre, the ellipse (S11, S12, S22), the blur, the levels
inside and outside and the slope of the surround (of the light, where the light is uneven). The derivatives by position,
ellipse and blur are central differences of the image; by the rest it is linear. A pixel's variance is what was
simulated plus 1/12 for rounding. The bound returned is the centre's 2 x 2 block of the inverted information.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from disc_images import HEIGHT, WIDTH, Picture, cover, ellipse_border

PARAMETERS = 10


@numba.njit(cache=True, error_model="numpy")
def _shares(p: np.ndarray, about: np.ndarray, u0: int, v0: int, out: np.ndarray) -> None:
    """Fill ``out`` (3, h, w) for the disc of p: u, v, S11, S12, S22, blur."""
    mean, half = 0.5 * (p[2] + p[4]), 0.5 * (p[2] - p[4])
    root = math.sqrt(half * half + p[3] * p[3])
    angle = 0.5 * math.atan2(p[3], half)
    x, y, dy = ellipse_border(p[0], p[1], math.sqrt(mean + root), math.sqrt(mean - root), angle, p[5])
    cover(x, y, dy, p[5], u0, v0, about, out)


@numba.njit(cache=True, error_model="numpy")
def _information(
    p: np.ndarray, inside: float, outside: float, slope: np.ndarray, lit: bool, noise: float, shot: float
) -> np.ndarray:
    """Return the information (10, 10) of u v S11 S12 S22 blur inside outside slope_u slope_v."""
    margin = 4.0 * p[5] + 4.0
    reach_u, reach_v = math.sqrt(p[2]) + margin, math.sqrt(p[4]) + margin
    u0, v0 = max(0, math.floor(p[0] - reach_u)), max(0, math.floor(p[1] - reach_v))
    w = min(WIDTH - 1, math.ceil(p[0] + reach_u)) - u0 + 1
    h = min(HEIGHT - 1, math.ceil(p[1] + reach_v)) - v0 + 1
    about = p[:2].copy()
    middle, high, low = np.empty((3, h, w)), np.empty((3, h, w)), np.empty((3, h, w))
    _shares(p, about, u0, v0, middle)
    J = np.empty((PARAMETERS, h, w))
    # The light is outside + slope . x, and inside the disc inside + slope_in . x, x from the disc's true centre.
    step = inside - outside
    gain = inside / outside if lit else 0.0
    du, dv = slope[0] * (gain - 1.0), slope[1] * (gain - 1.0)
    moved = p.copy()
    for k in range(6):
        h_k = 1e-4 if k < 2 else 1e-4 * (p[5] if k == 5 else math.sqrt(p[2] * p[4]))
        moved[k] = p[k] + h_k
        _shares(moved, about, u0, v0, high)
        moved[k] = p[k] - h_k
        _shares(moved, about, u0, v0, low)
        moved[k] = p[k]
        for v in range(h):
            for u in range(w):
                J[k, v, u] = (
                    step * (high[0, v, u] - low[0, v, u])
                    + du * (high[1, v, u] - low[1, v, u])
                    + dv * (high[2, v, u] - low[2, v, u])
                ) / (2 * h_k)
    information = np.zeros((PARAMETERS, PARAMETERS))
    g = np.empty(PARAMETERS)
    for v in range(h):
        for u in range(w):
            share, mu, mv = middle[0, v, u], middle[1, v, u], middle[2, v, u]
            x, y = u + u0 - about[0], v + v0 - about[1]
            for k in range(6):
                g[k] = J[k, v, u]
            # A lit disc's own slope is inside / outside times the surround's.
            tilt = (slope[0] * mu + slope[1] * mv) / outside if lit else 0.0
            g[6] = share + tilt
            g[7] = 1.0 - share - tilt * gain
            g[8] = x + (gain - 1.0) * mu
            g[9] = y + (gain - 1.0) * mv
            level = outside + slope[0] * x + slope[1] * y + step * share + du * mu + dv * mv
            weight = 1.0 / (noise * noise + shot * max(level, 0.0) + 1.0 / 12.0)
            for i in range(PARAMETERS):
                for j in range(i + 1):
                    information[i, j] += weight * g[i] * g[j]
    for i in range(PARAMETERS):
        for j in range(i):
            information[j, i] = information[i, j]
    return information


@numba.njit(cache=True, error_model="numpy")
def _bounds(
    uv: np.ndarray, shape: np.ndarray, blur: float, inside: np.ndarray, outside: np.ndarray, slope: np.ndarray,
    lit: bool, noise: float, shot: float, out: np.ndarray,
) -> None:  # fmt: skip
    """Fill ``out`` (N, 2, 2)."""
    p = np.empty(6)
    for i in range(len(uv)):
        p[:2], p[2:5], p[5] = uv[i], shape[i], blur
        A = _information(p, inside[i], outside[i], slope, lit, noise, shot)
        scale = np.sqrt(np.diag(A))
        out[i] = np.linalg.inv(A / np.outer(scale, scale))[:2, :2] / np.outer(scale[:2], scale[:2])


def centre_bound(
    uv: np.ndarray,
    shape: np.ndarray,
    blur: float,
    inside: np.ndarray,
    outside: np.ndarray,
    noise: float,
    *,
    slope: np.ndarray | None = None,
    lit: bool = False,
    shot: float = 0.0,
) -> np.ndarray:
    """Return the bound (N, 2, 2), px^2, of the centres of discs in one image.

    Args:
        uv: (N, 2) centres, px.
        shape: (N, 3) S11, S12, S22 of the ellipses, px^2.
        blur: sigma, px.
        inside: (N,) levels in the discs' centres.
        outside: (N,) levels of the surround there.
        noise: sigma of the constant noise, levels, without rounding.
        slope: (2,) of the surround, levels a px.
        lit: whether the discs are tilted by the same light.
        shot: variance of shot noise per level.
    """
    n = len(uv)
    out = np.empty((n, 2, 2))
    floats = (np.ascontiguousarray(np.broadcast_to(x, n), dtype=np.float64) for x in (inside, outside))
    slope = np.zeros(2) if slope is None else slope
    _bounds(
        np.ascontiguousarray(uv, dtype=np.float64),
        np.ascontiguousarray(shape, dtype=np.float64),
        float(blur),
        *floats,
        slope,
        lit,
        float(noise),
        float(shot),
        out,
    )
    return out


def picture_bound(picture: Picture) -> np.ndarray:
    """Return the bound (N, 2, 2) of every disc of a picture; over a texture it is that of a plain surround."""
    return centre_bound(
        picture.uv,
        picture.shape,
        picture.blur,
        picture.inside,
        picture.outside,
        picture.noise,
        slope=picture.slope,
        lit=picture.lit,
        shot=picture.shot,
    )
