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
    offset, read, shot = np.float32(sensor[0]), np.float32(sensor[1]), np.float32(sensor[2])
    width = out.shape[1]
    for v in range(out.shape[0]):
        inside = window[1] <= v < window[3]
        for u in range(width):
            grey = still[v, u]
            if inside and window[0] <= u < window[2]:
                grey = light[v - window[1], u - window[0]] * gain[v, u]
            noise = strip[start + v * width + u]
            sigma = np.sqrt(read * read + shot * max(grey, np.float32(0.0))) if shot > 0.0 else read
            level = np.rint(grey + offset + sigma * noise)
            out[v, u] = np.uint8(min(max(level, np.float32(0.0)), np.float32(255.0)))


def noise_strip(seed: int, image_size_px: tuple[int, int]) -> Radiance:
    """Return standard normal numbers, enough for every image to begin at another one of millions."""
    width, height = image_size_px
    return np.random.default_rng([seed, 3]).standard_normal(_STRIP + width * height, dtype=np.float32)


def noise_start(seed: int, side: int, shot: int) -> int:
    """Return where in the strip an image's noise begins."""
    return int(np.random.default_rng([seed, 4, side, shot]).integers(_STRIP))
