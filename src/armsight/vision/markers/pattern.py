"""The compiled image model of a square marker's pattern and its fit; what it means is told in ``square.py``."""

from __future__ import annotations

import numba
import numpy as np

from armsight.data import Array
from armsight.vision.markers.normal import edge, edge_noise, factor, invert, normal_equations, solve

FIELD = 12  # coefficients of the quadratic field over the marker
PARAMETERS = FIELD + 6  # ..., squared blur, b, c, a, k (2)
_STEPS, _STOP, _STALL, _LAMBDA = 40, 0.05, 0.05, 1e-2  # as in corner.py
_BLUR2_MIN = 0.03  # px^2, as in corner.py


@numba.njit(cache=True, error_model="numpy")
def field(x: float, y: float, phi: Array) -> None:
    """Fill the displacement basis phi (12, 2) at the marker's coordinates x, y in -1..1."""
    phi[:, :] = 0.0
    phi[0, 0], phi[1, 0], phi[2, 0] = 1.0, x, y
    phi[3, 1], phi[4, 1], phi[5, 1] = 1.0, x, y
    phi[6, 0], phi[6, 1] = x * x, x * y  # perspective
    phi[7, 0], phi[7, 1] = x * y, y * y
    phi[8, 0], phi[9, 1] = y * y, x * x  # bow
    phi[10, 0], phi[10, 1] = x * x, -x * y
    phi[11, 0], phi[11, 1] = x * y, -y * y


@numba.njit(cache=True, error_model="numpy", fastmath=True)
def _weights(x: float, cells: int, px: float, width: float, blur: float, out: Array) -> int:
    """Fill the shares of the four cells about x along one axis, out (3, 4): shares, derivative by x and by blur.

    x runs over -1..1; px is how many pixels that unit is long here; return the first cell.
    """
    near = int(np.floor((x + 1.0) * 0.5 * cells + 0.5))
    near = min(max(near, 0), cells)
    e_before, d_before, s_before = 1.0, 0.0, 0.0
    for i in range(4):
        if i < 3:
            e, d, s = edge((x + 1.0 - 2.0 * (near - 1 + i) / cells) * px, blur, width)
        else:
            e, d, s = -1.0, 0.0, 0.0
        out[0, i] = 0.5 * (e_before - e)
        out[1, i] = 0.5 * (d_before - d) * px
        out[2, i] = 0.5 * (s_before - s)
        e_before, d_before, s_before = e, d, s
    return near - 2


@numba.njit(cache=True, error_model="numpy", fastmath=True)
def _skewed(
    u: float, v: float, cells: int, px: Array, spread: float, grid: Array, cx: int, cy: int, slopes: Array
) -> float:
    """Return what M gains at the cells' corners because the marker's axes are not square to each other in the image.

    As C in ``corner.py``, weighted with how the four cells at a corner differ; slopes receives the derivatives by u, v
    and the squared blur.
    """
    rho = px[7]
    kx, ky = px[3] * spread, px[4] * spread
    gain = 0.0
    slopes[:] = 0.0
    for j in range(3):
        zy = (v + 1.0 - 2.0 * (cy + 1 + j) / cells) * ky
        if abs(zy) > 4.0:
            continue
        for i in range(3):
            zx = (u + 1.0 - 2.0 * (cx + 1 + i) / cells) * kx
            row, col = cy + 3 + j, cx + 3 + i
            step = grid[row, col] - grid[row, col - 1] - grid[row - 1, col] + grid[row - 1, col - 1]
            if step == 0.0 or abs(zx) > 4.0:
                continue
            ff = step * (0.5 / np.pi) * np.exp(-0.5 * (zx * zx + zy * zy))
            wx, wy = zx * zx - 1.0, zy * zy - 1.0
            series = rho + 0.5 * rho * rho * zx * zy + rho * rho * rho / 6.0 * wx * wy
            gx = ff * (0.5 * rho * rho * zy + rho * rho * rho / 3.0 * zx * wy - zx * series)
            gy = ff * (0.5 * rho * rho * zx + rho * rho * rho / 3.0 * zy * wx - zy * series)
            gain += ff * series
            slopes[0] += gx * kx
            slopes[1] += gy * ky
            slopes[2] -= 0.5 * (gx * zx + gy * zy) * spread * spread
    return gain


@numba.njit(cache=True, error_model="numpy", fastmath=True)
def _evaluate(n: int, px: Array, grid: Array, prior: Array, q: Array, J: Array, r: Array) -> float:
    """Fill residuals r and derivatives J (18, n) of pixels px (8, n) at parameters q (18,); return the cost.

    px: grey, marker coordinates x, y, per axis the pixels a unit is long and the pixel's width, and the cosine between
    the axes' gradients. grid: (N + 4, N + 4)
    the cells as -1 and 1 with two rings of white around.
    """
    cells = len(grid) - 4
    phi, wx, wy, extra = np.empty((FIELD, 2)), np.empty((3, 4)), np.empty((3, 4)), np.empty(3)
    b, c, a = q[FIELD + 1], q[FIELD + 2], q[FIELD + 3]
    cost = 0.0
    for i in range(FIELD + 3):
        cost += (q[i] - prior[i, 0]) ** 2 * prior[i, 1]
    for i in range(n):
        x, y = px[1, i], px[2, i]
        field(x, y, phi)
        u, v = x, y
        for j in range(FIELD):
            u += q[j] * phi[j, 0]
            v += q[j] * phi[j, 1]
        blur_x = np.sqrt(q[FIELD] + (1.0 - px[5, i] ** 2) / 12.0)
        blur_y = np.sqrt(q[FIELD] + (1.0 - px[6, i] ** 2) / 12.0)
        cx = _weights(u, cells, px[3, i], px[5, i], blur_x, wx)
        cy = _weights(v, cells, px[4, i], px[6, i], blur_y, wy)
        M, mx, my, ms = 0.0, 0.0, 0.0, 0.0
        for k in range(4):
            w, d, s = 0.0, 0.0, 0.0
            for m in range(4):
                colour = grid[cy + 2 + k, cx + 2 + m]
                w += wx[0, m] * colour
                d += wx[1, m] * colour
                s += wx[2, m] * colour
            M += wy[0, k] * w
            mx += wy[0, k] * d
            my += wy[1, k] * w
            ms += 0.5 * (wy[0, k] * s / blur_x + wy[2, k] * w / blur_y)
        spread = 1.0 / np.sqrt(q[FIELD] + 1.0 / 12.0)
        skew = _skewed(u, v, cells, px[:, i], spread, grid, cx, cy, extra)
        M += skew
        mx += extra[0]
        my += extra[1]
        ms += extra[2]
        light = 1.0 + q[FIELD + 4] * x + q[FIELD + 5] * y
        level = a + b * M + c * (1.0 - M * M)
        slope = (b - 2.0 * c * M) * light
        for j in range(FIELD):
            J[j, i] = slope * (mx * phi[j, 0] + my * phi[j, 1])
        J[FIELD, i] = slope * ms
        J[FIELD + 1, i] = light * M
        J[FIELD + 2, i] = light * (1.0 - M * M)
        J[FIELD + 3, i] = light
        J[FIELD + 4, i] = level * x
        J[FIELD + 5, i] = level * y
        r[i] = px[0, i] - light * level
        cost += r[i] * r[i]
    return float(cost)


@numba.njit(cache=True, error_model="numpy")
def _assemble(n: int, q: Array, prior: Array, J: Array, r: Array, A: Array, g: Array) -> None:
    """Fill the normal equations with the prior, and hold a blur that is at its bound."""
    normal_equations(n, J, r, A, g)
    for i in range(FIELD + 3):
        A[i, i] += prior[i, 1]
        g[i] += prior[i, 1] * (prior[i, 0] - q[i])
    if q[FIELD] < 1.001 * _BLUR2_MIN and g[FIELD] < 0.0:
        A[FIELD, FIELD] *= 1e9
        g[FIELD] = 0.0


@numba.njit(cache=True, error_model="numpy")
def fit_pattern(n: int, px: Array, grid: Array, prior: Array, q: Array, inverse: Array) -> float:
    """Minimise from q by Levenberg-Marquardt; fill ``inverse`` (18, 18); return the noise variance, -1 if unsettled."""
    J, r, A, L = (
        np.empty((PARAMETERS, n)),
        np.empty(n),
        np.empty((PARAMETERS, PARAMETERS)),
        np.zeros((PARAMETERS, PARAMETERS)),
    )
    g, step, trial = np.empty(PARAMETERS), np.empty(PARAMETERS), np.empty(PARAMETERS)
    cost, damping = _evaluate(n, px, grid, prior, q, J, r), _LAMBDA
    _assemble(n, q, prior, J, r, A, g)
    for _ in range(_STEPS):
        if not factor(A, damping, L):
            return -1.0
        solve(L, g, step)
        gain = np.dot(step, g)
        done = damping <= 1.0 and gain < _STOP * cost / n
        trial[:] = q + step
        trial[FIELD] = max(trial[FIELD], _BLUR2_MIN)
        new = _evaluate(n, px, grid, prior, trial, J, r)
        done |= max(gain, abs(new - cost)) < _STALL * cost / n
        if new > cost and not done:
            damping = max(damping * 10.0, 1e-4)
            if damping > 1e8:
                return -1.0
            continue
        if cost - new > 0.5 * gain:
            damping = max(damping * 0.1, 1e-9)
        elif cost - new < 0.2 * gain:
            damping = max(damping * 3.0, 1e-2)
        q[:] = trial
        cost = new
        _assemble(n, q, prior, J, r, A, g)
        if done:
            if not factor(A, 0.0, L):
                return -1.0
            invert(L, inverse)
            return edge_noise(n, J, r, inverse, 0, 3)
    return -1.0
