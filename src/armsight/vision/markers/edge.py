"""The profile of a straight step from dark to bright as a blurred lens and square pixels show it.

Compiled pieces for the model fits of corners and tags. Gaussian blur and the pixel's width are both integrated exactly:
across an edge a pixel is a box as wide as the longer of its two shadows, and the shorter one joins the blur.
"""

from __future__ import annotations

import numba
import numpy as np
from scipy.special import erf

_TABLE_STEP, REACH = 1.0 / 256.0, 4.0
_z = np.arange(0.0, REACH + 2 * _TABLE_STEP, _TABLE_STEP)
#: erf(z / sqrt 2) and the normal density over z >= 0; linear interpolation is good to 1e-6.
_ERF, _PHI = erf(_z / np.sqrt(2.0)), np.exp(-0.5 * _z * _z) / np.sqrt(2.0 * np.pi)


@numba.njit(cache=True, error_model="numpy", fastmath=True)
def _normal(z: float) -> tuple[float, float]:
    """Return erf(z / sqrt 2) and the normal density at z."""
    x = abs(z)
    if x >= REACH:
        return (1.0 if z > 0 else -1.0), 0.0
    x /= _TABLE_STEP
    i = int(x)
    f = x - i
    e = _ERF[i] + f * (_ERF[i + 1] - _ERF[i])
    return (e if z > 0 else -e), _PHI[i] + f * (_PHI[i + 1] - _PHI[i])


@numba.njit(cache=True, error_model="numpy", fastmath=True)
def edge(u: float, s: float, w: float) -> tuple[float, float, float]:
    """Return the profile of a step at distance u, blurred by s and a box of width w, px; and its derivatives by u, s."""
    if abs(u) > REACH * s + 0.5:
        return (1.0 if u > 0 else -1.0), 0.0, 0.0
    high, low = u + 0.5 * w, u - 0.5 * w
    e1, f1 = _normal(high / s)
    e0, f0 = _normal(low / s)
    return (high * e1 - low * e0 + 2.0 * s * (f1 - f0)) / w, (e1 - e0) / w, 2.0 * (f1 - f0) / w
