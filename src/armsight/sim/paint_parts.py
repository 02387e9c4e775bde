"""What cells and discs are painted with: pixels cast on to a plane, pixels split into parts, straight cuts through squares.

See ``paint``. numba's cache on disk looks at the age of the file that calls: after a change here, or in another of the
painter's files, delete the cache of all of them.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from armsight.data import Array

#: Parts of an edge pixel along each side.
SUB = 4

Slots = NDArray[np.int32]
Box = tuple[int, int, int, int]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def half(c: float, u: float, v: float) -> float:
    """Return in which share of the square with sides from -1/2 to 1/2 the plane c + u x + v y is above zero."""
    u, v = abs(u), abs(v)
    if u < v:
        u, v = v, u
    if 2 * abs(c) >= u + v:
        return 1.0 if c > 0.0 else 0.0
    if 2 * abs(c) <= u - v:
        return 0.5 + c / u
    corner = 0.5 * (u + v) - abs(c)
    share = corner * corner / (2 * u * v)
    return 1.0 - share if c > 0.0 else share


@numba.njit(cache=True, nogil=True, error_model="numpy")
def square_of(top: Array, bottom: Array, k: int, out: Array) -> None:
    """Write out (4, 3), what interpolates the area between points k and k + 1 of two lines: middle, slopes, twist."""
    for c in range(3):
        a, b, d, e = top[c, k], top[c, k + 1], bottom[c, k], bottom[c, k + 1]
        out[0, c] = 0.25 * (a + b + d + e)
        out[1, c] = 0.5 * (b - a + e - d)
        out[2, c] = 0.5 * (d - a + e - b)
        out[3, c] = a - b - d + e


@numba.njit(cache=True, nogil=True, error_model="numpy")
def plane_row(rays: Array, M: Array, v: int, u0: int, n: int, out: Array) -> bool:
    """Cast n pixel corners of row v from column u0 on to the plane of M, out (3, n) homogeneous; tell if all see it."""
    least = np.inf
    for k in range(n):
        x, y, z = rays[v, u0 + k, 0], rays[v, u0 + k, 1], rays[v, u0 + k, 2]
        for c in range(3):
            out[c, k] = M[c, 0] * x + M[c, 1] * y + M[c, 2] * z
        least = min(least, out[2, k])
    return least > 0.0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def ahead_of(top: Array, bottom: Array, k: int) -> bool:
    """Tell whether points k and k + 1 of two lines see the plane before them."""
    return bool(min(min(top[2, k], top[2, k + 1]), min(bottom[2, k], bottom[2, k + 1])) > 0.0)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def open_parts(v: int, u: int, coarse: Array, slot: Slots, fine: Array, count: int) -> tuple[Array, int, int]:
    """Return the parts of a pixel, making them from its one value where it has none yet: parts, slot, count."""
    if slot[v, u] >= 0:
        return fine, slot[v, u], count
    if count == fine.shape[0]:
        grown = np.empty((2 * count, SUB, SUB))
        grown[:count] = fine
        fine = grown
    for a in range(SUB):  # numba is slow at filling such a small part of an array
        for b in range(SUB):
            fine[count, a, b] = coarse[v, u]
    slot[v, u] = count
    return fine, count, count + 1
