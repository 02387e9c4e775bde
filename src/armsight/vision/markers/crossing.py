"""The compiled image model of two crossing edges and its fit; what it means is told in ``corner.py``."""

from __future__ import annotations

import numba
import numpy as np

from armsight.data import Array
from armsight.vision.markers.edge import edge
from armsight.vision.markers.normal import factor, normal_equations, solve

PARAMETERS = 10  # c (2), edge angles (2), squared blurs (2), a, b, k (2)
_STEPS = 25
_STOP = 0.05  # a step is the last when it lowers the cost by less than this share of one pixel's noise
_STALL = 0.05  # the same, for a step that the cost's small kinks keep from lowering it
_LAMBDA = 1e-2
_BLUR2_MIN = 0.03  # px^2; below it a pixel's width hides the blur, and the cost gets kinks
#: Weak prior on a squared blur, mean and sigma, px^2, as strong as one pixel with a noise of one grey level. It decides
#: only what the pixels leave open: the blur of an edge that falls between two pixels.
_BLUR2_PRIOR = (0.25, 0.25)


@numba.njit(cache=True, error_model="numpy", fastmath=True)
def _evaluate(n: int, px: Array, q: Array, sides: Array, bow: Array, J: Array, r: Array) -> float:
    """Fill residuals r (n,) and derivatives J (10, n) of the pixels px (3, n) at parameters q; return the cost."""
    # Everything constant is a local: what is read from an array in the loop is read again for every pixel.
    cx, cy, _, _, _, _, middle, half, kx, ky = q
    n1x, n1y, n2x, n2y = np.cos(q[2]), np.sin(q[2]), np.cos(q[3]), np.sin(q[3])
    (s1x, s1y), (s2x, s2y) = sides
    (b1x, b1y), (b2x, b2y) = bow
    # A pixel's shadows across each edge, from the edges' first directions: constants of the fit.
    width1, width2 = np.abs(sides[0]).max(), np.abs(sides[1]).max()
    blur1 = np.sqrt(q[4] + (1.0 - width1 * width1) / 12.0)
    blur2 = np.sqrt(q[5] + (1.0 - width2 * width2) / 12.0)
    rho, drho = np.cos(q[2] - q[3]), np.sin(q[3] - q[2])
    rho2, rho3 = 0.5 * rho * rho, rho * rho * rho / 6.0
    k1, k2 = 1.0 / np.sqrt(q[4] + 1.0 / 12.0), 1.0 / np.sqrt(q[5] + 1.0 / 12.0)
    bow1 = 2.0 * (n1x * b1x + n1y * b1y)
    bow2 = 2.0 * (n2x * b2x + n2y * b2y)
    cost = ((q[4] - _BLUR2_PRIOR[0]) ** 2 + (q[5] - _BLUR2_PRIOR[0]) ** 2) / _BLUR2_PRIOR[1] ** 2
    for i in range(n):
        dx, dy = px[0, i] - cx, px[1, i] - cy
        t1 = dx * s1x + dy * s1y
        t2 = dx * s2x + dy * s2y
        x1, y1 = dx - b1x * t1 * t1, dy - b1y * t1 * t1
        x2, y2 = dx - b2x * t2 * t2, dy - b2y * t2 * t2
        u1, u2 = n1x * x1 + n1y * y1, n2x * x2 + n2y * y2
        e1, d1, f1 = edge(u1, blur1, width1)
        e2, d2, f2 = edge(u2, blur2, width2)
        light = 1.0 + kx * dx + ky * dy
        scale = half * light
        M, g1, g2, h, c1, c2 = e1 * e2, d1 * e2, d2 * e1, 0.0, 0.0, 0.0
        z1, z2 = u1 * k1, u2 * k2
        if z1 * z1 + z2 * z2 < 25.0:
            w1, w2 = z1 * z1 - 1.0, z2 * z2 - 1.0
            ff = (2.0 / np.pi) * np.exp(-0.5 * (z1 * z1 + z2 * z2))
            series = rho + rho2 * z1 * z2 + rho3 * w1 * w2
            M += ff * series
            c1 = ff * k1 * (rho2 * z2 + 2.0 * rho3 * z1 * w2 - z1 * series)
            c2 = ff * k2 * (rho2 * z1 + 2.0 * rho3 * z2 * w1 - z2 * series)
            g1 += c1
            g2 += c2
            h = ff * (1.0 + rho * z1 * z2 + 0.5 * rho * rho * w1 * w2) * drho * scale
        level = middle + half * M
        g1 *= scale
        g2 *= scale
        J[0, i] = -g1 * (n1x - bow1 * t1 * s1x) - g2 * (n2x - bow2 * t2 * s2x) - kx * level
        J[1, i] = -g1 * (n1y - bow1 * t1 * s1y) - g2 * (n2y - bow2 * t2 * s2y) - ky * level
        J[2, i] = g1 * (n1x * y1 - n1y * x1) + h
        J[3, i] = g2 * (n2x * y2 - n2y * x2) - h
        J[4, i] = scale * 0.5 * (f1 * e2 / blur1 - c1 * u1 * k1 * k1)
        J[5, i] = scale * 0.5 * (f2 * e1 / blur2 - c2 * u2 * k2 * k2)
        J[6, i] = light
        J[7, i] = light * M
        J[8, i] = level * dx
        J[9, i] = level * dy
        r[i] = px[2, i] - light * level
        cost += r[i] * r[i]
    return float(cost)


@numba.njit(cache=True, error_model="numpy")
def first_guess(n: int, px: Array, c: Array, square: Array, blur: float, q: Array) -> None:
    """Set the parameters from the squares' shape and the mean grey of opposite quadrants."""
    q[:] = 0.0
    q[0], q[1], q[4], q[5] = c[0], c[1], blur * blur, blur * blur
    turn = 1.0 if square[0, 0] * square[1, 1] - square[0, 1] * square[1, 0] > 0 else -1.0
    q[2] = np.arctan2(turn * square[0, 0], -turn * square[0, 1])  # the normal of side 0 points to side 1
    q[3] = np.arctan2(-turn * square[1, 0], turn * square[1, 1])  # and the other way round
    n1x, n1y, n2x, n2y = np.cos(q[2]), np.sin(q[2]), np.cos(q[3]), np.sin(q[3])
    total, signed = 0.0, 0.0
    for i in range(n):
        dx, dy = px[0, i] - c[0], px[1, i] - c[1]
        u1, u2 = n1x * dx + n1y * dy, n2x * dx + n2y * dy
        total += px[2, i]
        signed += px[2, i] if u1 * u2 > 0 else -px[2, i]
    q[6], q[7] = total / n, signed / n


@numba.njit(cache=True, error_model="numpy")
def _prior(q: Array, A: Array, g: Array) -> None:
    """Add the blurs' prior to the normal equations A, g, and hold a blur that is at its bound."""
    mean, weight = _BLUR2_PRIOR[0], 1.0 / _BLUR2_PRIOR[1] ** 2
    for i in (4, 5):
        A[i, i] += weight
        g[i] += weight * (mean - q[i])
        if q[i] < 1.001 * _BLUR2_MIN and g[i] < 0.0:  # at its bound: held there for this step
            A[i, i] *= 1e9
            g[i] = 0.0


@numba.njit(cache=True, error_model="numpy")
def fit_crossing(n: int, px: Array, q: Array, sides: Array, bow: Array, J: Array, r: Array, L: Array) -> bool:
    """Minimise from q by Levenberg-Marquardt; J, r, L are left at the solution. False where it does not settle."""
    A, g, x, trial = (
        np.empty((PARAMETERS, PARAMETERS)),
        np.empty(PARAMETERS),
        np.empty(PARAMETERS),
        np.empty(PARAMETERS),
    )
    cost = _evaluate(n, px, q, sides, bow, J, r)
    damping = _LAMBDA
    normal_equations(n, J, r, A, g)
    _prior(q, A, g)
    for _ in range(_STEPS):
        if not factor(A, damping, L):
            return False
        solve(L, g, x)
        trial[:] = q + x
        trial[4], trial[5] = max(trial[4], _BLUR2_MIN), max(trial[5], _BLUR2_MIN)
        gain = np.dot(x, g)  # how much lower the cost should get, or a little more
        done = damping <= 1.0 and gain < _STOP * cost / n
        new = _evaluate(n, px, trial, sides, bow, J, r)
        done |= max(gain, abs(new - cost)) < _STALL * cost / n
        if new > cost and not done:
            damping = max(damping * 10.0, 1e-4)
            if damping > 1e8:
                return False
            continue
        if cost - new > 0.5 * gain:
            damping = max(damping * 0.1, 1e-9)
        elif cost - new < 0.2 * gain:  # the step went over a kink: sharp edges between two pixels have them
            damping = max(damping * 3.0, 1e-2)
        q[:] = trial
        cost = new
        normal_equations(n, J, r, A, g)
        _prior(q, A, g)
        if done:
            return factor(A, 0.0, L)
    return False
