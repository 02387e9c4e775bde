"""The last step of a camera's image: noise and rounding, of a whole image at once.

Noise comes from a long strip drawn once; each image begins somewhere else in it, which its number and the seed tell. So
an image does not depend on which others were taken, and two threads share nothing that changes.
"""

from __future__ import annotations

import numba
import numpy as np

from armsight.data import Image
from armsight.sim.render.optics import Radiance

Window = tuple[int, int, int, int]
_STRIP = 1 << 22  # places where an image's noise may begin
_STEP, _MASK = 0x9E3779B97F4A7C15, (1 << 64) - 1  # of the hash that chooses one


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


def noise_strip(seed: int, image_size_px: tuple[int, int]) -> Radiance:
    """Return standard normal numbers, enough for every image to begin at another one of millions."""
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
