"""What the fit of a corner leaves: the noise at its edges, and the covariance of its place."""

from __future__ import annotations

import numba
import numpy as np

from armsight.data import Array
from armsight.vision.markers.crossing import JACOBIAN, PARAMETERS, RESIDUAL, ROOM, Work, rows
from armsight.vision.markers.normal import LANES, products


@numba.njit(cache=True, error_model="numpy", fastmath=True)
def rough_noise(n: int, w: Work) -> float:
    """Return the variance of what a fit leaves of the n pixels near the edges."""
    r, power = w[RESIDUAL : RESIDUAL + n], np.float32(0.0)
    for m in range(n):
        power += r[m] * r[m]
    return float(power / (n - PARAMETERS))


@numba.njit(cache=True, error_model="numpy", fastmath=True)
def edge_noise(n: int, w: Work, L: Array, cov: Array) -> float:
    """Return the variance of the noise and fill cov (2, 2), the covariance of the place; derivatives are used up.

    The noise is that of the pixels that tell the place, as in ``normal.edge_noise``. Leverage is the squared length of
    L^-1 times a pixel's derivatives, so its weighted sum needs only the weighted products of the derivatives.
    """
    H, inverse = np.empty((PARAMETERS + 2, PARAMETERS + 2)), np.zeros((PARAMETERS, PARAMETERS))
    for j in range(PARAMETERS):
        inverse[j, j] = L[j, j]
        for i in range(j + 1, PARAMETERS):
            s = 0.0
            for m in range(j, i):
                s -= L[i, m] * inverse[m, j]
            inverse[i, j] = s * L[i, i]
    n = (n + LANES - 1) // LANES * LANES  # derivatives and residuals are zero to the end of a vector
    jx, jy, root = w[JACOBIAN : JACOBIAN + n], w[JACOBIAN + ROOM : JACOBIAN + ROOM + n], w[:n]
    weight = np.float32(0.0)
    for m in range(n):
        v = jx[m] * jx[m] + jy[m] * jy[m]
        weight += v
        root[m] = np.sqrt(v)  # where the columns were: the pixels have done their work
    for i in range(PARAMETERS + 1):
        o = JACOBIAN + i * ROOM
        row = w[o : o + n]
        for m in range(n):
            row[m] *= root[m]
    products(n, rows(w), H)
    leverage = 0.0
    for i in range(PARAMETERS):
        for j in range(i + 1):
            s = 0.5 * inverse[i, j] * H[j, j]
            for k in range(j):
                s += inverse[i, k] * H[j, k]
            leverage += 2.0 * inverse[i, j] * s
    variance = max(H[PARAMETERS, PARAMETERS] / (float(weight) - leverage), 1.0 / 12.0)
    for i in range(2):
        for j in range(2):
            s = 0.0
            for m in range(PARAMETERS):
                s += inverse[m, i] * inverse[m, j]
            cov[i, j] = variance * s
    return float(variance)
