"""Parabolas through readings of joints around a time: angles, speeds and accelerations.

Local polynomial fit (Savitzky and Golay, Anal. Chem. 36, 1964), for readings at any times.
"""

from __future__ import annotations

import numpy as np

from armsight.data import Array
from armsight.kernels import kernel

#: Readings within this time are smoothed together, s; a jerk of 60 rad/s^3 leaves 6e-5 rad at its end.
SPAN_S = 0.049
#: Where as many follow as went before it is up to this, s: jerk does not move a centred parabola.
LONG_SPAN_S = 2 * SPAN_S
#: Fewest readings for a parabola; fewer are averaged.
PARABOLA = 5


@kernel
def span(at: float, newest: float) -> float:
    """Return the span of readings, s, that are smoothed for a time when the newest reading is of another, s."""
    return min(max(2 * (newest - at), SPAN_S), LONG_SPAN_S)


@kernel
def window(t: Array, first: int, count: int, at: float, length: float) -> tuple[int, int]:
    """Return the rows of a span of time around a time, s: around it as far as there are any, else before or after."""
    last = first + count - 1
    late = min(max(at + 0.5 * length, t[first] + length), t[last])
    low = first + np.searchsorted(t[first : last + 1], late - length)
    high = first + np.searchsorted(t[first : last + 1], late, side="right") - 1
    return min(low, high), high


@kernel
def fit(t: Array, q: Array, low: int, high: int, at: float, motion: Array) -> float:
    """Lay parabolas through rows low to high of q (N, n); write motion (3, n) at a time, return the variance left."""
    n = high - low + 1
    s1 = s2 = s3 = s4 = 0.0
    for k in range(low, high + 1):
        u = t[k] - at
        s1, s2, s3, s4 = s1 + u, s2 + u * u, s3 + u * u * u, s4 + u * u * u * u
    # The inverse of the normal equations' matrix [n s1 s2; s1 s2 s3; s2 s3 s4]: scale [a b c; b d e; c e f].
    a, b, c = s2 * s4 - s3 * s3, s2 * s3 - s1 * s4, s1 * s3 - s2 * s2
    d, e, f = n * s4 - s2 * s2, s1 * s2 - n * s3, n * s2 - s1 * s1
    if n < PARABOLA:
        a, b, c, d, e, f, scale = 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0 / n
    else:
        scale = 1.0 / (n * a + s1 * b + s2 * c)
    motion[:] = 0.0
    for k in range(low, high + 1):
        u = t[k] - at
        value = scale * (a + (b + c * u) * u)
        slope = scale * (b + (d + e * u) * u)
        bend = 2 * scale * (c + (e + f * u) * u)
        for i in range(q.shape[1]):
            motion[0, i] += value * q[k, i]
            motion[1, i] += slope * q[k, i]
            motion[2, i] += bend * q[k, i]
    return scale * a
