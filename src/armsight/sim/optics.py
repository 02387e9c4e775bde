"""The lens and the sensor: from painted areas to the grey levels a camera hands out.

The blur is a Gaussian of the image plane, integrated exactly over the pixel that receives and the pixel, or the part
of an edge pixel, that sends: a pixel of one value is spread exactly, and an edge is placed to a part of a pixel first.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numba
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from armsight.data import Array, Image
from armsight.errors import InputError
from armsight.sim.paint_parts import SUB, Slots

Radiance = NDArray[np.float32]

#: An edge drawn in parts of a pixel is as wide as this variance already, px^2 (mean over where in a part it lies).
_PARTS_VARIANCE = 1 / (6 * SUB**2)


@dataclass(frozen=True)
class Optics:
    """The lens and the light.

    Attributes:
        psf_sigma_px: standard deviation of the Gaussian blur, px; 0 for none.
        vignetting: how much darker the image's corners are than its centre, 0 to 1, falling with the square of radius.
        light_gradient: relative change of the light across the image's full width and height.
    """

    psf_sigma_px: float = 0.7
    vignetting: float = 0.0
    light_gradient: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Sensor:
    """What turns light into numbers.

    Attributes:
        gain: grey levels of a reflectance of one.
        offset: grey level of black.
        read_noise: standard deviation of the noise that is always there, grey levels.
        shot_noise: variance of the light's own noise per grey level of light; 0.02 is a web camera in a lit room.
        jpeg_quality: 1 to 100 to send the image through JPEG as web cameras do; None for none.
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
    """Return how much light goes from each part of a pixel to its neighbours, in one direction.

    Args:
        sigma: of the Gaussian, px.
        parts: how many parts a pixel has.

    Returns:
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


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _spread_parts(slot: Slots, fine: Array, taps: Array, out: Radiance) -> None:
    """Add to ``out`` what the parts of edge pixels send beyond the mean of their pixel."""
    n = taps.shape[1]
    radius = n // 2
    height, width = slot.shape
    rows = np.empty((SUB, n))
    for v in range(height):
        for u in range(width):
            s = slot[v, u]
            if s < 0:
                continue
            mean = fine[s].mean()
            for a in range(SUB):
                for c in range(n):
                    rows[a, c] = 0.0
                    for b in range(SUB):
                        rows[a, c] += (fine[s, a, b] - mean) / (SUB * SUB) * taps[b, c]
            c0, c1 = max(0, radius - u), min(n, width + radius - u)
            for r in range(max(0, radius - v), min(n, height + radius - v)):
                for c in range(c0, c1):
                    light = 0.0
                    for a in range(SUB):
                        light += taps[a, r] * rows[a, c]
                    out[v + r - radius, u + c - radius] += np.float32(light)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _mean_of_parts(slot: Slots, fine: Array, coarse: Array) -> None:
    """Give every edge pixel the mean of its parts."""
    for v in range(slot.shape[0]):
        for u in range(slot.shape[1]):
            if slot[v, u] >= 0:
                coarse[v, u] = fine[slot[v, u]].mean()


def blurred(coarse: Array, slot: Slots, fine: Array, sigma: float) -> Radiance:
    """Lay the lens's blur over a painted image.

    Args:
        coarse: (H, W) values of pixels; those of edge pixels are overwritten with the mean of their parts.
        slot: (H, W) row of ``fine`` that holds an edge pixel's parts, -1 where there are none.
        fine: (n, SUB, SUB) the parts.
        sigma: of the blur, px; 0 for none.

    Returns:
        (H, W) light on each pixel; beyond the image's border the world is taken to go on as at the border.
    """
    _mean_of_parts(slot, fine, coarse)
    image = spread(coarse.astype(np.float32), sigma)
    if sigma > 0:
        _spread_parts(slot, fine, psf_taps(_narrowed(sigma), SUB), image)
    return image


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
    """Turn light into grey levels: gain, noise, saturation, rounding, JPEG.

    Args:
        radiance: (H, W) light on each pixel.
        sensor: what it falls on.
        rng: source of the noise; None for a sensor without noise.

    Returns:
        (H, W) uint8.

    Raises:
        InputError: JPEG refuses the quality asked for.
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
