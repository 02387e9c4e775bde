"""HD test images of discs with truth, exact in area, made independently of armsight's painter and of its fit.

A lens's Gaussian blur and a pixel's square make one kernel K(x) K(y) that is known in closed form. By Gauss' theorem the
light that a region sends to a pixel is an integral along its border, of H(x) K(y) dy with H the integral of K; along a
smooth closed border the trapezoid rule converges faster than any power, so a few nodes a pixel are exact to 1e-9. A
border may be anything: an ellipse, a disc seen through a lens, a tag's square. ``python benchmarks/disc_images.py`` holds
it against 64 x 64 samples a pixel.

Levels are grey levels, lengths px, pixel (0, 0) is the centre of the top-left one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from scipy.ndimage import gaussian_filter1d

from disc_surround import TEXTURES

WIDTH, HEIGHT = 1280, 720
#: Contour nodes are this many blur sigmas apart at most: the trapezoid rule's error is exp(-2 pi^2 / 0.6^2).
SPACING = 0.6
_REACH = 6.0  # sigmas after which the kernel is none


@numba.njit(cache=True, error_model="numpy")
def _kernels(s: float, sigma: float) -> tuple[float, float, float]:
    """Return the Gaussian's distribution function, its integral and that one's integral up to s."""
    z = s / sigma
    below = 0.5 * math.erfc(-z / math.sqrt(2.0))
    density = math.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi)
    return below, s * below + sigma * density, 0.5 * (s * s + sigma * sigma) * below + 0.5 * s * sigma * density


@numba.njit(cache=True, error_model="numpy")
def cover(
    x: np.ndarray, y: np.ndarray, dy: np.ndarray, sigma: float, u0: int, v0: int, about: np.ndarray, out: np.ndarray
) -> None:
    """Say which share of its light each pixel of a window gets from inside a border, and its first moments.

    Args:
        x: (N,) nodes of the border.
        y: (N,) the same; the border runs so that the integral of x dy is positive.
        dy: (N,) weights of the rule: derivative of y times step.
        sigma: of the blur.
        u0: first column of the window.
        v0: first row.
        about: (2,) where the moments are about.
        out: (3, h, w) filled with the share, and the share's moments (x - about_x), (y - about_y) before the blur.
    """
    h, w = out.shape[1:]
    out[:] = 0.0
    reach = _REACH * sigma + 0.5
    size = 2 * math.ceil(reach) + 3
    row, drop, rest = np.empty(size), np.empty(size), np.empty(size)
    for n in range(x.size):
        first_v, last_v = math.ceil(y[n] - reach), math.floor(y[n] + reach)
        first_u, last_u = math.ceil(x[n] - reach) - 1, math.floor(x[n] + reach) + 1
        if last_v < v0 or first_v >= v0 + h or last_u < u0:
            continue
        for v in range(first_v, last_v + 1):
            row[v - first_v] = dy[n] * (_kernels(v + 0.5 - y[n], sigma)[0] - _kernels(v - 0.5 - y[n], sigma)[0])
        _, S, Q = _kernels(x[n] - first_u + 0.5, sigma)
        for u in range(first_u, last_u + 1):
            _, S1, Q1 = _kernels(x[n] - u - 0.5, sigma)
            _, S2, _ = _kernels(x[n] - u - 1.5, sigma)
            drop[u - first_u] = (S - S1) - (S1 - S2)
            rest[u - first_u] = (x[n] - u) * (S - S1) - (Q - Q1)
            S, Q = S1, Q1
        moment = y[n] - about[1]
        for v in range(max(first_v, v0), min(last_v, v0 + h - 1) + 1):
            k = row[v - first_v]
            for u in range(max(first_u, u0), last_u + 1):
                i = min(u - u0, w - 1)
                out[0, v - v0, i] += k * drop[u - first_u]
                out[2, v - v0, i] += k * moment * drop[u - first_u]
                if u - u0 < w:
                    out[1, v - v0, i] += k * rest[u - first_u]
    for v in range(h):
        for i in range(w - 2, -1, -1):
            out[0, v, i] += out[0, v, i + 1]
            out[2, v, i] += out[2, v, i + 1]
        for i in range(w):
            out[1, v, i] += (u0 + i - about[0]) * out[0, v, i]


@numba.njit(cache=True, error_model="numpy")
def ellipse_border(
    u: float, v: float, a: float, b: float, angle: float, sigma: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return nodes x, y and weights dy (N,) of an ellipse's border; ``angle`` rotates its axis a from u towards v, rad."""
    count = max(64, math.ceil(2 * math.pi * max(a, b) / (SPACING * sigma)))
    x, y, dy = np.empty(count), np.empty(count), np.empty(count)
    c, s, step = math.cos(angle), math.sin(angle), 2 * math.pi / count
    for n in range(count):
        p, q = a * math.cos(n * step), b * math.sin(n * step)
        dp, dq = -a * math.sin(n * step) * step, b * math.cos(n * step) * step
        x[n], y[n], dy[n] = u + c * p - s * q, v + s * p + c * q, s * dp + c * dq
    return x, y, dy


def closed_border(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return nodes and weights of a smooth closed border given by points (N, 2) at even steps of its parameter."""
    x, y = np.ascontiguousarray(points[:, 0]), np.ascontiguousarray(points[:, 1])
    k = np.fft.rfftfreq(len(points), 1 / len(points))
    dy = np.fft.irfft(1j * k * np.fft.rfft(y), len(points)) * (2 * np.pi / len(points))
    return (x, y, dy) if x @ dy > 0 else (x, y, -dy)


def polygon_border(corners: np.ndarray, sigma: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return nodes and weights of a polygon (M, 2): panels of a blur sigma at most, five Gauss nodes on each."""
    nodes, weights = np.polynomial.legendre.leggauss(5)
    out = []
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        panels = max(1, math.ceil(np.linalg.norm(end - start) / sigma))
        t = ((np.arange(panels)[:, None] + 0.5 * (nodes + 1)) / panels).ravel()
        w = np.tile(0.5 * weights / panels, panels)
        p = start + t[:, None] * (end - start)
        out.append(np.column_stack([p, w * (end - start)[1]]))
    x, y, dy = (np.ascontiguousarray(c) for c in np.concatenate(out).T)
    return (x, y, dy) if x @ dy > 0 else (x, y, -dy)


def shape_of(a: np.ndarray, b: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return S11, S12, S22 (N, 3) of ellipses: the rim is centre + x with x^T S^-1 x = 1."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([(a * c) ** 2 + (b * s) ** 2, (a**2 - b**2) * c * s, (a * s) ** 2 + (b * c) ** 2], axis=-1)


def window(points_low: np.ndarray, points_high: np.ndarray, margin: float) -> tuple[int, int, int, int]:
    """Return u0, v0, w, h of the window that holds a box and a margin, within the image."""
    low = np.clip(np.floor(points_low - margin), 0, (WIDTH - 1, HEIGHT - 1)).astype(int)
    high = np.clip(np.ceil(points_high + margin), 0, (WIDTH - 1, HEIGHT - 1)).astype(int)
    return int(low[0]), int(low[1]), int(high[0] - low[0] + 1), int(high[1] - low[1] + 1)


def add_region(
    image: np.ndarray,
    border: tuple[np.ndarray, ...],
    sigma: float,
    step: float,
    slope: np.ndarray | None = None,
    about: np.ndarray | None = None,
) -> None:
    """Add ``step`` + ``slope`` . (x - about) inside a border to a linear image (HEIGHT, WIDTH); blurred; overwrites it."""
    x, y, dy = border
    u0, v0, w, h = window(np.array([x.min(), y.min()]), np.array([x.max(), y.max()]), _REACH * sigma + 1)
    about = np.array([x.mean(), y.mean()]) if about is None else about
    out = np.empty((3, h, w))
    cover(x, y, dy, sigma, u0, v0, about, out)
    part = step * out[0] if slope is None else step * out[0] + slope[0] * out[1] + slope[1] * out[2]
    image[v0 : v0 + h, u0 : u0 + w] += part


@dataclass(frozen=True)
class Picture:
    """One image and what is on it.

    Attributes:
        image: (HEIGHT, WIDTH) uint8.
        uv: (N, 2) centres.
        axes: (N, 2) half axes a, b.
        angle: (N,) of axis a, rad.
        inside: (N,) level of a disc at its centre.
        outside: (N,) level of the surround at the disc's centre.
        slope: (2,) of the surround, levels a px.
        lit: whether the slope is the light's, which tilts the discs in proportion too; else discs are flat.
        blur: sigma of the lens.
        noise: sigma of the sensor's constant noise; ``shot`` adds its share of the level to the variance.
        shot: variance per level.
        kind: of surround.
    """

    image: np.ndarray
    uv: np.ndarray
    axes: np.ndarray
    angle: np.ndarray
    inside: np.ndarray
    outside: np.ndarray
    slope: np.ndarray
    lit: bool
    blur: float
    noise: float
    shot: float = 0.0
    kind: str = "plain"

    @property
    def shape(self) -> np.ndarray:
        """(N, 3) S11, S12, S22."""
        return shape_of(self.axes[:, 0], self.axes[:, 1], self.angle)


def exposed(light: np.ndarray, noise: float, shot: float, rng: np.random.Generator) -> np.ndarray:
    """Add noise to a linear image and round it to 8 bits."""
    spread = noise if shot == 0 else np.sqrt(noise**2 + shot * np.maximum(light, 0)).astype(np.float32)
    grey = light.astype(np.float32) + spread * rng.standard_normal(light.shape, dtype=np.float32)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def scatter(radius: np.ndarray, gap: float, rng: np.random.Generator, tries: int = 60) -> np.ndarray:
    """Return which discs found room and where, (N, 2) with NaN for those that did not: no two nearer than ``gap``."""
    uv = np.full((len(radius), 2), np.nan)
    for i in np.argsort(-radius):
        margin = radius[i] + gap / 2 + 2
        for spot in rng.uniform((margin, margin), (WIDTH - 1 - margin, HEIGHT - 1 - margin), (tries, 2)):
            distance = np.hypot(uv[:, 0] - spot[0], uv[:, 1] - spot[1])
            if not (distance < radius + radius[i] + gap).any():
                uv[i] = spot
                break
    return uv


def disc_picture(
    rng: np.random.Generator,
    *,
    count: int = 130,
    radius: tuple[float, float] = (4.0, 20.0),
    contrast: tuple[float, float] = (40.0, 200.0),
    tilt_deg: tuple[float, float] = (0.0, 60.0),
    blur: float | None = None,
    noise: float | None = None,
    shot: float = 0.0,
    bright: bool | None = None,
    kind: str = "plain",
    amplitude: float | None = None,
) -> Picture:
    """Make one picture of discs that do not touch.

    Args:
        rng: source of everything.
        count: how many discs at the most.
        radius: of the longer half axis, sampled uniformly.
        contrast: inside against outside, sampled uniformly as far as 8 bits leave room.
        tilt_deg: the shorter half axis is the longer one's cosine of it.
        blur: sigma, or sampled from 0.5 to 1.5.
        noise: sigma, or sampled from 1 to 4.
        shot: variance of shot noise per level.
        bright: bright or dark discs, or random.
        kind: of the surround: plain, gradient (the surround's own; discs are flat), light (uneven light: surround and
            discs in proportion), or one of TEXTURES.
        amplitude: standard deviation of a texture after the blur, levels; 3 to 8 by default.
    """
    blur = float(rng.uniform(0.5, 1.5)) if blur is None else blur
    noise = float(rng.uniform(1.0, 4.0)) if noise is None else noise
    bright = bool(rng.random() < 0.5) if bright is None else bright
    r = rng.uniform(*radius, count)
    uv = scatter(r, 8 * blur + 8, rng)
    found = np.isfinite(uv[:, 0])
    uv, r = uv[found], r[found]
    n = len(uv)
    axes = np.stack([r, r * np.cos(np.radians(rng.uniform(*tilt_deg, n)))], axis=1)
    angle = rng.uniform(0, np.pi, n)
    light, slope, textured = _surround(rng, kind, bright, blur, amplitude)
    outside = light[HEIGHT // 2, WIDTH // 2] + (uv - (WIDTH // 2, HEIGHT // 2)) @ slope
    if textured:
        outside = np.full(n, light.mean())
    room = (236.0 - outside) if bright else (outside - 19.0)
    inside = outside + (1 if bright else -1) * rng.uniform(contrast[0], np.clip(room, contrast[0], contrast[1]))
    lit = kind == "light"
    for i in range(n):
        border = ellipse_border(*uv[i], *axes[i], angle[i], blur)
        if textured:
            _cover_texture(light, border, blur, inside[i])
            continue
        tilt = slope * (inside[i] - outside[i]) / outside[i] if lit else -slope
        add_region(light, border, blur, inside[i] - outside[i], tilt, uv[i])
    image = exposed(light, noise, shot, rng)
    return Picture(image, uv, axes, angle, inside, outside, slope, lit, blur, noise, shot, kind)


def _surround(
    rng, kind: str, bright: bool, blur: float, amplitude: float | None
) -> tuple[np.ndarray, np.ndarray, bool]:
    """Return the surround's light (HEIGHT, WIDTH), its slope (2,), and whether it is a texture."""
    if kind in TEXTURES:
        spread = float(rng.uniform(3.0, 8.0)) if amplitude is None else amplitude
        base = rng.uniform(45.0, 75.0) if bright else rng.uniform(180.0, 210.0)
        light = TEXTURES[kind](rng, blur)
        return base + spread * (light - light.mean()) / light.std(), np.zeros(2), True
    if kind == "plain":
        return (
            np.full((HEIGHT, WIDTH), rng.uniform(20.0, 60.0) if bright else rng.uniform(195.0, 235.0)),
            np.zeros(2),
            False,
        )
    base = rng.uniform(60.0, 90.0) if bright else rng.uniform(165.0, 195.0)
    direction = rng.uniform(0, 2 * np.pi)
    slope = np.array([np.cos(direction), np.sin(direction)])
    across = abs(slope) @ (WIDTH, HEIGHT)
    slope *= rng.uniform(40.0, 70.0) / across
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    return base + slope[0] * (u - WIDTH // 2) + slope[1] * (v - HEIGHT // 2), slope, False


def _cover_texture(light: np.ndarray, border: tuple[np.ndarray, ...], blur: float, inside: float) -> None:
    """Lay a flat disc over a texture: what the blurred disc leaves of each pixel still shows the texture's own level."""
    x, y, dy = border
    u0, v0, w, h = window(np.array([x.min(), y.min()]), np.array([x.max(), y.max()]), _REACH * blur + 1)
    out = np.empty((3, h, w))
    cover(x, y, dy, blur, u0, v0, np.zeros(2), out)
    part = light[v0 : v0 + h, u0 : u0 + w]
    part += out[0] * (inside - part)


def brute(
    u: float, v: float, a: float, b: float, angle: float, sigma: float, size: int, samples: int = 64
) -> np.ndarray:
    """Return the share (size, size) of an ellipse by samples x samples a pixel and a convolution of the fine image."""
    margin = int(np.ceil(6 * sigma))
    fine = (np.arange((size + 2 * margin) * samples) + 0.5) / samples - 0.5 - margin
    du, dv = fine[None] - u, fine[:, None] - v
    c, s = np.cos(angle), np.sin(angle)
    share = ((((c * du + s * dv) / a) ** 2 + ((c * dv - s * du) / b) ** 2) < 1).astype(np.float64)
    for axis in (0, 1):
        share = gaussian_filter1d(share, sigma * samples, axis=axis, truncate=6, mode="constant")
    n = size + 2 * margin
    return share.reshape(n, samples, n, samples).mean(axis=(1, 3))[margin:-margin, margin:-margin]


def check(cases: int = 6, seed: int = 0) -> tuple[float, float]:
    """Hold the border integral against 64 x 64 samples a pixel: largest shift of a disc, px, and largest difference."""
    rng = np.random.default_rng(seed)
    shift = difference = 0.0
    for _ in range(cases):
        a, sigma, angle = rng.uniform(4, 9), rng.uniform(0.5, 1.5), rng.uniform(0, np.pi)
        b = a * np.cos(np.radians(rng.uniform(0, 60)))
        size = int(2 * (a + 4 * sigma + 2))
        u, v = size / 2 + rng.uniform(-1, 1, 2)
        exact, slow = np.empty((3, size, size)), brute(u, v, a, b, angle, sigma, size)
        cover(*ellipse_border(u, v, a, b, angle, sigma), sigma, 0, 0, np.zeros(2), exact)
        gv, gu = np.gradient(slow)
        A = np.stack([-gu.ravel(), -gv.ravel()], axis=1)
        shift = max(shift, float(np.abs(np.linalg.lstsq(A, (exact[0] - slow).ravel(), rcond=None)[0]).max()))
        difference = max(difference, float(np.abs(exact[0] - slow).max()))
    return shift, difference


if __name__ == "__main__":
    print(
        "border integral against 64 x 64 samples a pixel: shift {:.1e} px, largest difference {:.1e}".format(*check())
    )
