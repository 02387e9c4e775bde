"""The lens and the sensor: from painted areas to the grey levels a camera returns.

The blur is a Gaussian of the image plane, integrated exactly over the pixel that receives and the pixel, or the part
of an edge pixel, that sends: a pixel of one value is spread exactly, and an edge is first located to a part of a pixel.

Noise and rounding are the last step, for a whole image at once. The noise of the workcell's images comes from a long strip
that is sampled once; each image begins somewhere else in it, at an index that its number and the seed determine. So an
image does not depend on which others were taken, and two threads share nothing that changes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from armsight.data import Array, Image
from armsight.errors import InputError
from armsight.kernels import kernel
from armsight.sim.render.paint import SUB, Slots

Radiance = NDArray[np.float32]

#: An edge rendered in parts of a pixel is as wide as this variance already, px^2 (mean over where in a part it lies).
_PARTS_VARIANCE = 1 / (6 * SUB**2)


@dataclass(frozen=True)
class Optics:
    """The lens and the light."""

    psf_sigma_px: float = 0.7  #: standard deviation of the Gaussian blur, px; 0 for none
    #: how much darker the image's corners are than its centre, 0 to 1, falling with the square of radius
    vignetting: float = 0.0
    #: relative change of the light across the image's full width and height
    light_gradient: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Sensor:
    """How a sensor converts light into numbers: grey levels of a reflectance of one, ``gain``, and of black, ``offset``.

    ``read_noise``: sigma that is always there; ``shot_noise``: variance of the light's own noise per grey level of
    light, 0.02 in a lit room; ``jpeg_quality``: 1 to 100, None for none.
    """

    gain: float = 255.0
    offset: float = 0.0
    read_noise: float = 2.0
    shot_noise: float = 0.0
    jpeg_quality: int | None = None


def _integral_of_step(x: Array, sigma: float) -> Array:
    """Integrate the Gaussian's distribution function up to x."""
    return np.asarray(x * ndtr(x / sigma) + sigma * np.exp(-0.5 * (x / sigma) ** 2) / math.sqrt(2 * math.pi))


@lru_cache(maxsize=16)
def psf_taps(sigma: float, parts: int) -> Array:
    """Return how much light of a Gaussian blur, px, goes from each part of a pixel to its neighbours, in one direction.

    (parts, 2 radius + 1) shares; a row belongs to one part (sums to one), a column to a receiving pixel.
    """
    radius = math.ceil(4.5 * sigma + 0.5)
    pixel: Array = np.arange(-radius, radius + 1.0)
    left: Array = (np.arange(parts) / parts - 0.5)[:, None]

    def upto(edge: Array) -> Array:
        """Share of the light of [left, left + 1 / parts] that falls below an edge."""
        return (_integral_of_step(edge - left, sigma) - _integral_of_step(edge - left - 1 / parts, sigma)) * parts

    taps = upto(pixel + 0.5) - upto(pixel - 0.5)
    return np.asarray(taps / taps.sum(axis=1, keepdims=True))


@kernel("i4[:, ::1], f8[:, :, ::1], f4[:, ::1], f8, f8[:, ::1], f4[:, ::1]", nogil=True)
def gather_parts(slot: Slots, fine: Array, taps: Radiance, weight: float, coarse: Array, across: Radiance) -> None:
    """Give every edge pixel the mean of its parts, and spread across each line of parts what these send beyond it.

    fine (n, SUB, SUB): the parts, their rows in slot (H, W), -1 where there are none; ``weight`` times what is spread
    is added to across (SUB H, W + columns of taps - 1), whose columns begin half of that before the image's.
    """
    t0, t1, t2, t3 = taps[0], taps[1], taps[2], taps[3]
    for v in range(slot.shape[0]):
        for u in range(slot.shape[1]):
            s = slot[v, u]
            if s < 0:
                continue
            parts, mean = fine[s], 0.0
            for a in range(SUB):
                mean += parts[a, 0] + parts[a, 1] + parts[a, 2] + parts[a, 3]
            mean /= SUB * SUB
            coarse[v, u] = mean
            for a in range(SUB):
                p0, p1 = np.float32(weight * (parts[a, 0] - mean)), np.float32(weight * (parts[a, 1] - mean))
                p2, p3 = np.float32(weight * (parts[a, 2] - mean)), np.float32(weight * (parts[a, 3] - mean))
                line = across[SUB * v + a, u : u + t0.size]
                for c in range(t0.size):
                    line[c] += p0 * t0[c] + p1 * t1[c] + p2 * t2[c] + p3 * t3[c]


@kernel("f4[:, ::1], f4[:, ::1], f4[:, ::1]", nogil=True)
def spread_down(across: Radiance, taps: Radiance, out: Radiance) -> None:
    """Add to an image (H, W) what :func:`gather_parts` has gathered, spread down."""
    radius = taps.shape[1] // 2
    for v in range(out.shape[0]):
        row = out[v]
        for r in range(max(v - radius, 0), min(v + radius + 1, out.shape[0])):
            for a in range(SUB):
                tap, line = taps[a, v - r + radius], across[SUB * r + a, radius : radius + out.shape[1]]
                for u in range(row.size):
                    row[u] += tap * line[u]


def blurred(coarse: Array, slot: Slots, fine: Array, sigma: float) -> Radiance:
    """Lay the lens's blur over a painted image.

    ``coarse``: (H, W) values of pixels; those of edge pixels are overwritten with the mean of their parts. ``slot``: (H, W)
    row of ``fine`` that holds an edge pixel's parts, -1 where there are none. ``fine``: (n, SUB, SUB) the parts. ``sigma``:
    of the blur, px; 0 for none. Returns (H, W) light on each pixel; beyond the image's border the world is taken to go on
    as at the border.
    """
    taps = part_taps(sigma)
    across = np.zeros((SUB * slot.shape[0], slot.shape[1] + taps.shape[1] - 1), np.float32)
    gather_parts(slot, fine, taps, 1.0, coarse, across)
    image = spread(coarse.astype(np.float32), sigma)
    spread_down(across, taps, image)
    return image


@lru_cache(maxsize=16)
def part_taps(sigma: float) -> Radiance:
    """Return the :func:`psf_taps` of a lens for parts of edge pixels, over SUB; none gives light away without blur."""
    taps = psf_taps(_narrowed(sigma), SUB) / SUB if sigma > 0 else np.zeros((SUB, 1))
    return taps.astype(np.float32)


def spread(image: Radiance, sigma: float) -> Radiance:
    """Lay the lens's blur over an image (H, W) without edge pixels; see :func:`blurred`."""
    if sigma <= 0:
        return image
    whole = psf_taps(_narrowed(sigma), 1)[0]
    return np.asarray(cv2.sepFilter2D(image, cv2.CV_32F, whole, whole, borderType=cv2.BORDER_REPLICATE))


def _narrowed(sigma: float) -> float:
    """Return the blur that is left to lay over what is as wide as a part of a pixel already."""
    return math.sqrt(max(sigma**2 - _PARTS_VARIANCE, 0.5 * sigma**2))


def shaded(radiance: Radiance, optics: Optics) -> Radiance:
    """Darken the corners and tilt the light across an image (H, W)."""
    if optics.vignetting == 0 and optics.light_gradient == (0.0, 0.0):
        return radiance
    height, width = radiance.shape
    x = (np.arange(width, dtype=np.float32) - (width - 1) / 2) / width
    y = ((np.arange(height, dtype=np.float32) - (height - 1) / 2) / height)[:, None]
    corner = np.float32(optics.vignetting / (0.25 * (width**2 + height**2)))
    fall = 1 - corner * ((x * width) ** 2 + (y * height) ** 2)
    light = 1 + x * optics.light_gradient[0] + y * optics.light_gradient[1]
    return np.asarray(radiance * fall * np.maximum(light, 0), dtype=np.float32)


def exposed(radiance: Radiance, sensor: Sensor, rng: np.random.Generator | None) -> Image:
    """Convert light (H, W) into grey levels, uint8: gain, noise unless ``rng`` is None, saturation, rounding, JPEG.

    InputError: JPEG does not know the requested quality.
    """
    grey = radiance * np.float32(sensor.gain)
    if rng is not None and (sensor.read_noise > 0 or sensor.shot_noise > 0):
        noise = rng.standard_normal(grey.shape, dtype=np.float32)
        if sensor.shot_noise > 0:
            noise *= np.sqrt(np.float32(sensor.read_noise**2) + np.float32(sensor.shot_noise) * np.maximum(grey, 0))
        else:
            noise *= np.float32(sensor.read_noise)
        grey = grey + noise
    image: Image = np.clip(np.rint(grey + np.float32(sensor.offset)), 0, 255).astype(np.uint8)
    if sensor.jpeg_quality is None:
        return image
    if not 1 <= sensor.jpeg_quality <= 100:
        raise InputError(f"JPEG quality must be 1 to 100, got {sensor.jpeg_quality}")
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, sensor.jpeg_quality])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE))


Window = tuple[int, int, int, int]
_STRIP = 1 << 22  # indices where an image's noise may begin
_STEP, _MASK = 0x9E3779B97F4A7C15, (1 << 64) - 1  # of the hash that chooses one


@kernel(nogil=True)
def _rounded(grey: Radiance, noise: Radiance, sensor: tuple[float, float, float], out: Image) -> None:
    """Write the grey levels of a part of a row."""
    offset, read, shot = np.float32(sensor[0]), np.float32(sensor[1]), np.float32(sensor[2])
    zero, most = np.float32(0.0), np.float32(255.0)
    if shot > zero:
        for u in range(out.size):
            sigma = np.sqrt(read * read + shot * max(grey[u], zero))
            out[u] = np.uint8(min(max(np.rint(grey[u] + offset + sigma * noise[u]), zero), most))
    else:
        for u in range(out.size):
            out[u] = np.uint8(min(max(np.rint(grey[u] + offset + read * noise[u]), zero), most))


@kernel(
    "f4[:, ::1], f4[:, ::1], (i8, i8, i8, i8), (i8, i8, i8, i8), f4[:, ::1], f4[::1], i8, (f8, f8, f8), u1[:, ::1]",
    nogil=True,
)
def exposed_window(
    still: Radiance,
    light: Radiance,
    window: Window,
    core: Window,
    gain: Radiance,
    strip: Radiance,
    start: int,
    sensor: tuple[float, float, float],
    out: Image,
) -> None:
    """Write grey levels: ``still`` has its gain already, ``light`` of the window, shown in its core alone, has not.

    ``sensor`` is offset, read_noise and shot_noise, see :class:`~armsight.sim.render.optics.Sensor`.
    """
    (u0, v0, u1, v1), (height, width) = core, out.shape
    for v in range(height):
        noise = strip[start + v * width : start + (v + 1) * width]
        if not v0 <= v < v1:
            _rounded(still[v], noise, sensor, out[v])
            continue
        _rounded(still[v, :u0], noise[:u0], sensor, out[v, :u0])
        row = light[v - window[1], u0 - window[0] : u1 - window[0]]
        _rounded(row * gain[v, u0:u1], noise[u0:u1], sensor, out[v, u0:u1])
        _rounded(still[v, u1:], noise[u1:], sensor, out[v, u1:])


@lru_cache(maxsize=2)
def noise_strip(seed: int, image_size_px: tuple[int, int]) -> Radiance:
    """Return standard normal numbers, enough for every image to begin at another one of millions; 20 MB, kept."""
    width, height = image_size_px
    return np.random.default_rng([seed, 3]).standard_normal(_STRIP + width * height, dtype=np.float32)


def noise_start(seed: int, side: int, shot: int) -> int:
    """Return where in the strip an image's noise begins: a hash (Steele, Lea and Flood, OOPSLA 2014, section 5)."""
    state = 0
    for number in (seed, side, shot):
        state = (state + number + _STEP) & _MASK
        state = ((state ^ (state >> 30)) * 0xBF58476D1CE4E5B9) & _MASK
        state = ((state ^ (state >> 27)) * 0x94D049BB133111EB) & _MASK
        state ^= state >> 31
    return state % _STRIP
