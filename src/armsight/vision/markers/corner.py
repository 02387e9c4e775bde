"""Sub-pixel X corners (chessboards, charuco) by a model fit, each with the covariance its own residuals support.

A grey image, rough corners and the shape of the squares around them go in; places and covariances come out. Around a
corner the image is modelled as the product of two edges under an illumination that varies linearly,

    I(x) = (1 + k . d) (a + b M),   M = E1(u1) E2(u2) + C(u1, u2),   d = x - c,   u_i = n_i . (d - h_i t_i^2).

u_i is the distance from edge i, h_i t_i^2 the edge's bow from lens distortion (known from the neighbouring corners).
E_i is a step seen through Gaussian blur s_i and a pixel: across the edge a pixel is a box as wide as the longer of its
two shadows, and the shorter one joins the blur. Sharp cameras blur by less than a pixel, so this matters. C corrects
the product where the edges are not square to each other: the expectation of sgn(u1 + e1) sgn(u2 + e2) for blur of
correlation rho = n1 . n2 by the first terms of Mehler's series (Abramowitz and Stegun 26.3.29). Levenberg-Marquardt
finds c, the edges' angles, s, a, b and k; the covariance of c is that of the linearised fit with the noise that the
residuals at the edges show. An X corner has a point symmetry that gamma, bleeding print, blur and sharpening keep, so
none of them moves it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Ids, Record
from armsight.vision.markers.edge import edge
from armsight.vision.markers.normal import edge_noise, factor, invert, normal_equations, solve

#: How far the window reaches along each square's side, as a share of the side, and at most in px. The next corners
#: stay out of it with their blur.
WINDOW_SHARE, WINDOW_MAX_PX = 0.42, 12.0
#: A start further off than this leaves the window off centre; it is drawn again about the corner.
RECENTRE_PX = 0.5
#: A fit that ends further from its start has found something else: share of the shorter side, and px.
MOVED_SHARE, MOVED_MAX_PX = 0.25, 3.0
#: Fewest grey levels between a corner's dark and bright squares.
CONTRAST_MIN = 8.0
#: Largest residual as a share of the contrast (half the step). Camera noise of 10 grey levels on a contrast of 50
#: gives 0.4; half a window of wrong colour gives 0.9.
MISFIT_MAX = 0.45

#: Why a corner was not kept; the index is the code in :attr:`CornerFits.verdict`.
VERDICTS = (
    "kept",
    "too near the image border",
    "no convergence",
    "moved",
    "low contrast",
    "does not look like a corner",
)
_KEPT, _BORDER, _DIVERGED, _MOVED, _FAINT, _MISFIT = range(6)

_P = 10  # c (2), edge angles (2), squared blurs (2), a, b, k (2)
_STEPS = 25
_STOP = 3e-4  # the fit has settled when a step would lower the cost by less than this share of one pixel's noise
_STALL = 0.05  # the same, for a step that the cost's small kinks keep from lowering it
_LAMBDA = 1e-2
_BLUR2_MIN = 0.06  # px^2; below it a pixel's width hides the blur, and the cost gets kinks
#: Weak prior on a squared blur, mean and sigma, px^2, as strong as one pixel with a noise of one grey level. It decides
#: only what the pixels leave open: the blur of an edge that falls between two pixels.
_BLUR2_PRIOR = (0.25, 0.25)


@dataclass(frozen=True, eq=False)
class CornerFits(Record):
    """What became of each corner.

    Attributes:
        uv: (N, 2) refined places, raw pixels; meaningless where the verdict is not 0.
        cov_uv: (N, 2, 2) covariance from each fit's own residuals, px^2.
        contrast: (N,) signed half step between the squares, grey levels; the sign tells the colours: positive where the
            square between the first and the second side is bright.
        residual: (N,) standard deviation of the residuals at the edges, grey levels.
        blur_px: (N, 2) standard deviation of the blur across each of the two edges, the pixel's width aside.
        verdict: (N,) index into VERDICTS; 0 is kept.
    """

    uv: Array
    cov_uv: Array
    contrast: Array
    residual: Array
    blur_px: Array
    verdict: Ids

    @property
    def kept(self) -> NDArray[np.bool_]:
        """(N,) whether a corner's fit is good."""
        return np.asarray(self.verdict == _KEPT)


@numba.njit(cache=True, error_model="numpy", fastmath=True)
def _evaluate(n: int, px: Array, q: Array, sides: Array, bow: Array, J: Array, r: Array) -> float:
    """Fill residuals r (n,) and derivatives J (10, n) of the pixels px (3, n) at parameters q; return the cost."""
    n1x, n1y, n2x, n2y = np.cos(q[2]), np.sin(q[2]), np.cos(q[3]), np.sin(q[3])
    # A pixel's shadows across each edge, from the edges' first directions: constants of the fit.
    width1, width2 = np.abs(sides[0]).max(), np.abs(sides[1]).max()
    blur1 = np.sqrt(q[4] + (1.0 - width1 * width1) / 12.0)
    blur2 = np.sqrt(q[5] + (1.0 - width2 * width2) / 12.0)
    rho, drho = np.cos(q[2] - q[3]), np.sin(q[3] - q[2])
    rho2, rho3 = 0.5 * rho * rho, rho * rho * rho / 6.0
    k1, k2 = 1.0 / np.sqrt(q[4] + 1.0 / 12.0), 1.0 / np.sqrt(q[5] + 1.0 / 12.0)
    bow1 = 2.0 * (n1x * bow[0, 0] + n1y * bow[0, 1])
    bow2 = 2.0 * (n2x * bow[1, 0] + n2y * bow[1, 1])
    cost = ((q[4] - _BLUR2_PRIOR[0]) ** 2 + (q[5] - _BLUR2_PRIOR[0]) ** 2) / _BLUR2_PRIOR[1] ** 2
    for i in range(n):
        dx, dy = px[0, i] - q[0], px[1, i] - q[1]
        t1 = dx * sides[0, 0] + dy * sides[0, 1]
        t2 = dx * sides[1, 0] + dy * sides[1, 1]
        x1, y1 = dx - bow[0, 0] * t1 * t1, dy - bow[0, 1] * t1 * t1
        x2, y2 = dx - bow[1, 0] * t2 * t2, dy - bow[1, 1] * t2 * t2
        u1, u2 = n1x * x1 + n1y * y1, n2x * x2 + n2y * y2
        e1, d1, s1 = edge(u1, blur1, width1)
        e2, d2, s2 = edge(u2, blur2, width2)
        light = 1.0 + q[8] * dx + q[9] * dy
        scale = q[7] * light
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
        level = q[6] + q[7] * M
        g1 *= scale
        g2 *= scale
        J[0, i] = -g1 * (n1x - bow1 * t1 * sides[0, 0]) - g2 * (n2x - bow2 * t2 * sides[1, 0]) - q[8] * level
        J[1, i] = -g1 * (n1y - bow1 * t1 * sides[0, 1]) - g2 * (n2y - bow2 * t2 * sides[1, 1]) - q[9] * level
        J[2, i] = g1 * (n1x * y1 - n1y * x1) + h
        J[3, i] = g2 * (n2x * y2 - n2y * x2) - h
        J[4, i] = scale * 0.5 * (s1 * e2 / blur1 - c1 * u1 * k1 * k1)
        J[5, i] = scale * 0.5 * (s2 * e1 / blur2 - c2 * u2 * k2 * k2)
        J[6, i] = light
        J[7, i] = light * M
        J[8, i] = level * dx
        J[9, i] = level * dy
        r[i] = px[2, i] - light * level
        cost += r[i] * r[i]
    return float(cost)


@numba.njit(cache=True, error_model="numpy")
def _gather(image: NDArray[np.uint8], c: Array, square: Array, px: Array) -> int:
    """Collect the pixels of the window about c into px (3, n): x, y, grey; return how many."""
    height, width = image.shape
    s1, s2 = np.hypot(square[0, 0], square[0, 1]), np.hypot(square[1, 0], square[1, 1])
    m1, m2 = min(WINDOW_SHARE, WINDOW_MAX_PX / s1), min(WINDOW_SHARE, WINDOW_MAX_PX / s2)
    det = square[0, 0] * square[1, 1] - square[0, 1] * square[1, 0]
    rx = m1 * abs(square[0, 0]) + m2 * abs(square[1, 0])
    ry = m1 * abs(square[0, 1]) + m2 * abs(square[1, 1])
    n = 0
    for y in range(max(0, int(np.ceil(c[1] - ry))), min(height - 1, int(c[1] + ry)) + 1):
        for x in range(max(0, int(np.ceil(c[0] - rx))), min(width - 1, int(c[0] + rx)) + 1):
            dx, dy = x - c[0], y - c[1]
            u = (dx * square[1, 1] - dy * square[1, 0]) / det
            v = (dy * square[0, 0] - dx * square[0, 1]) / det
            if abs(u) <= m1 and abs(v) <= m2 and n < px.shape[1]:
                px[0, n], px[1, n], px[2, n] = x, y, image[y, x]
                n += 1
    return n


@numba.njit(cache=True, error_model="numpy")
def _start(n: int, px: Array, c: Array, square: Array, blur: float, q: Array) -> None:
    """Set the parameters from the squares' shape and the mean grey of opposite quadrants."""
    q[:] = 0.0
    q[0], q[1], q[4], q[5] = c[0], c[1], blur * blur, blur * blur
    turn = 1.0 if square[0, 0] * square[1, 1] - square[0, 1] * square[1, 0] > 0 else -1.0
    q[2] = np.arctan2(turn * square[0, 0], -turn * square[0, 1])  # the normal of side 0 points to side 1
    q[3] = np.arctan2(-turn * square[1, 0], turn * square[1, 1])  # and the other way round
    total, signed = 0.0, 0.0
    for i in range(n):
        dx, dy = px[0, i] - c[0], px[1, i] - c[1]
        u1, u2 = np.cos(q[2]) * dx + np.sin(q[2]) * dy, np.cos(q[3]) * dx + np.sin(q[3]) * dy
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
def _fit(n: int, px: Array, q: Array, sides: Array, bow: Array, J: Array, r: Array, L: Array) -> bool:
    """Minimise from q by Levenberg-Marquardt; J, r, L are left at the solution. False where it does not settle."""
    A, g, x, trial = np.empty((_P, _P)), np.empty(_P), np.empty(_P), np.empty(_P)
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


@numba.njit(cache=True, error_model="numpy")
def _refine(
    image: NDArray[np.uint8], uv0: Array, squares: Array, bows: Array, uv: Array, cov: Array, about: Array, verdict: Ids
) -> None:
    """Fit every corner; about (N, 4) receives contrast, residual and the two blurs."""
    size = int((2 * WINDOW_MAX_PX + 2) ** 2 * 2)
    px, J, r = np.empty((3, size)), np.empty((_P, size)), np.empty(size)
    L, inverse, q, sides = np.zeros((_P, _P)), np.empty((_P, _P)), np.empty(_P), np.empty((2, 2))
    for i in range(uv0.shape[0]):
        uv[i] = uv0[i]
        square = squares[i]
        n = _gather(image, uv0[i], square, px)
        shorter = np.inf
        for j in range(2):
            s = np.hypot(square[j, 0], square[j, 1])
            sides[j] = square[j] / s
            shorter = min(shorter, s)
        if n < 3 * _P:
            verdict[i] = _BORDER
            continue
        reach = min(WINDOW_SHARE * shorter, WINDOW_MAX_PX)
        _start(n, px, uv0[i], square, min(max(0.2 * reach, 0.7), 1.5), q)
        settled = _fit(n, px, q, sides, bows[i], J, r, L)
        if settled and np.hypot(q[0] - uv0[i, 0], q[1] - uv0[i, 1]) > RECENTRE_PX:
            n = _gather(image, q[:2].copy(), square, px)
            settled = n >= 3 * _P and _fit(n, px, q, sides, bows[i], J, r, L)
        if not settled:
            verdict[i] = _DIVERGED
            continue
        uv[i] = q[:2]
        invert(L, inverse)
        variance = edge_noise(n, J, r, inverse, 0, 1)
        cov[i] = variance * inverse[:2, :2]
        about[i, 1] = np.sqrt(variance)
        about[i, 0], about[i, 2], about[i, 3] = q[7], np.sqrt(q[4]), np.sqrt(q[5])
        moved = np.hypot(q[0] - uv0[i, 0], q[1] - uv0[i, 1])
        if not moved <= min(MOVED_SHARE * shorter, MOVED_MAX_PX):
            verdict[i] = _MOVED
        elif not abs(q[7]) >= 0.5 * CONTRAST_MIN:
            verdict[i] = _FAINT
        elif about[i, 1] > MISFIT_MAX * abs(q[7]) or max(about[i, 2], about[i, 3]) > reach:
            verdict[i] = _MISFIT
        else:
            verdict[i] = _KEPT


def refine_corners(image: NDArray[np.uint8], uv: Array, squares: Array, bows: Array | None = None) -> CornerFits:
    """Fit X corners.

    Args:
        image: (H, W) grey image.
        uv: (N, 2) rough places, raw pixels, right to a few pixels and a quarter of a square.
        squares: (N, 2, 2) the two sides of the square at each corner, px: along the columns, along the rows.
        bows: (N, 2, 2) how each of the two edges bows, 1/px: a point t px along it lies ``t^2 * bow`` off its tangent;
            straight by default.

    Returns:
        The fits, in the order given.
    """
    n = len(uv)
    out, cov, about, verdict = np.empty((n, 2)), np.zeros((n, 2, 2)), np.zeros((n, 4)), np.zeros(n, np.int64)
    bows = np.zeros((n, 2, 2)) if bows is None else bows
    uv, squares, bows = (np.ascontiguousarray(a, dtype=np.float64) for a in (uv, squares, bows))
    _refine(np.ascontiguousarray(image), uv, squares, bows, out, cov, about, verdict)
    return CornerFits(out, cov, about[:, 0], about[:, 1], about[:, 2:], verdict)
