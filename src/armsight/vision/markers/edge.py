"""The profile of a straight step from dark to bright as a blurred lens and square pixels show it.

Compiled pieces for the model fits of corners and tags. Gaussian blur and the pixel's width are both integrated exactly:
across an edge a pixel is a box as wide as the longer of its two shadows, and the shorter one joins the blur. Twice:
from tables, and in single precision without tables or branches, so that a loop over pixels fills the processor's vectors.
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


_f = np.float32
_ZERO, _HALF, _ONE, _TWO = _f(0.0), _f(0.5), _f(1.0), _f(2.0)
_DENSITY = _f(1.0 / np.sqrt(2.0 * np.pi))
_MINUS_LOG2_E, _FAR = _f(-1.0 / np.log(2.0)), _f(60.0)
#: 2^f over 0 <= f < 1.
_P1, _P2, _P3, _P4, _P5 = _f(0.6931531), _f(0.2401536), _f(0.0558263), _f(0.0089893), _f(0.0018775)
_BIAS, _MANTISSA = np.int32(127), np.int32(23)
#: Abramowitz and Stegun 7.1.26, in units of sigma.
_T, _A1, _A2 = _f(0.3275911 / np.sqrt(2.0)), _f(0.254829592), _f(-0.284496736)
_A3, _A4, _A5 = _f(1.421413741), _f(-1.453152027), _f(1.061405429)


@numba.njit(cache=True, error_model="numpy", fastmath=True, forceinline=True)
def decay_single(y: np.float32) -> np.float32:
    """Return exp(-y) for y >= 0 to 1e-6: a power of two put together from its bits, times a polynomial."""
    t = _MINUS_LOG2_E * min(y, _FAR)
    whole: np.float32 = np.floor(t)
    f = t - whole
    p = _ONE + f * (_P1 + f * (_P2 + f * (_P3 + f * (_P4 + f * _P5))))
    power: np.float32 = np.int32((np.int32(whole) + _BIAS) << _MANTISSA).view(np.float32)
    return p * power


@numba.njit(cache=True, error_model="numpy", fastmath=True, forceinline=True)
def edge_single(
    u: np.float32, per_s: np.float32, two_s: np.float32, half_w: np.float32, per_w: np.float32
) -> tuple[np.float32, np.float32, np.float32]:
    """As :func:`edge`, to 1e-6, from 1 / s, 2 s, w / 2 and 1 / w."""
    high, low = u + half_w, u - half_w
    z1, z0 = high * per_s, low * per_s
    g1, g0 = decay_single(_HALF * z1 * z1), decay_single(_HALF * z0 * z0)
    t1, t0 = _ONE / (_ONE + _T * abs(z1)), _ONE / (_ONE + _T * abs(z0))
    e1 = _ONE - t1 * (_A1 + t1 * (_A2 + t1 * (_A3 + t1 * (_A4 + t1 * _A5)))) * g1
    e0 = _ONE - t0 * (_A1 + t0 * (_A2 + t0 * (_A3 + t0 * (_A4 + t0 * _A5)))) * g0
    fall = _DENSITY * (g1 - g0)
    profile = (abs(high) * e1 - abs(low) * e0 + two_s * fall) * per_w  # a distance times its erf has no sign
    e1 = e1 if z1 > _ZERO else -e1
    e0 = e0 if z0 > _ZERO else -e0
    return profile, (e1 - e0) * per_w, _TWO * fall * per_w
