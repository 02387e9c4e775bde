"""The last step of a camera's image: noise and rounding, of a whole image at once.

Noise comes from a long strip drawn once; each image begins somewhere else in it, which its number and the seed tell. So
an image does not depend on which others were taken, and two threads share nothing that changes.
"""

from __future__ import annotations

import numba
import numpy as np

from armsight.data import Image
from armsight.sim.optics import Radiance

Window = tuple[int, int, int, int]
_STRIP = 1 << 22  # places where an image's noise may begin


@numba.njit(cache=True, nogil=True, error_model="numpy")
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


@numba.njit(cache=True, nogil=True, error_model="numpy")
def exposed(
    still: Radiance,
    light: Radiance,
    gain: Radiance,
    window: Window,
    strip: Radiance,
    start: int,
    sensor: tuple[float, float, float],
    out: Image,
) -> None:
    """Write grey levels: ``still`` has its gain already, ``light`` of the window has not.

    ``sensor`` is offset, read_noise and shot_noise, see :class:`~armsight.sim.optics.Sensor`.
    """
    (u0, v0, u1, v1), (height, width) = window, out.shape
    for v in range(height):
        noise = strip[start + v * width : start + (v + 1) * width]
        if not v0 <= v < v1:
            _rounded(still[v], noise, sensor, out[v])
            continue
        _rounded(still[v, :u0], noise[:u0], sensor, out[v, :u0])
        _rounded(light[v - v0] * gain[v, u0:u1], noise[u0:u1], sensor, out[v, u0:u1])
        _rounded(still[v, u1:], noise[u1:], sensor, out[v, u1:])


def noise_strip(seed: int, image_size_px: tuple[int, int]) -> Radiance:
    """Return standard normal numbers, enough for every image to begin at another one of millions."""
    width, height = image_size_px
    return np.random.default_rng([seed, 3]).standard_normal(_STRIP + width * height, dtype=np.float32)


def noise_start(seed: int, side: int, shot: int) -> int:
    """Return where in the strip an image's noise begins."""
    return int(np.random.default_rng([seed, 4, side, shot]).integers(_STRIP))
