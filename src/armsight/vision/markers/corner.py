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
from armsight.vision.markers.crossing import PARAMETERS, first_guess, fit_crossing
from armsight.vision.markers.normal import edge_noise, invert

#: How far the window reaches along each square's side, as a share of the side, and at most in px. The next corners
#: stay out of it with their blur.
WINDOW_SHARE, WINDOW_MAX_PX = 0.42, 12.0
#: Where squares carry a print, this much more room is left beside it, px, for its blur.
ARM_GAP_PX = 1.5
#: The blur a fit starts with.
START_BLUR_PX = 1.0
#: A fit with many more pixels than this is first made with about so many.
PIXELS_FIRST = 100
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


@numba.njit(cache=True, error_model="numpy")
def _gather(image: NDArray[np.uint8], c: Array, square: Array, arm: float, px: Array) -> int:
    """Collect the pixels of the window about c into px (3, n): x, y, grey; return how many."""
    height, width = image.shape
    s1, s2 = np.hypot(square[0, 0], square[0, 1]), np.hypot(square[1, 0], square[1, 1])
    m1, m2 = min(WINDOW_SHARE, WINDOW_MAX_PX / s1), min(WINDOW_SHARE, WINDOW_MAX_PX / s2)
    arm1, arm2 = max(0.5 * arm, arm - ARM_GAP_PX / s1), max(0.5 * arm, arm - ARM_GAP_PX / s2)
    det = square[0, 0] * square[1, 1] - square[0, 1] * square[1, 0]
    rx = m1 * abs(square[0, 0]) + m2 * abs(square[1, 0])
    ry = m1 * abs(square[0, 1]) + m2 * abs(square[1, 1])
    n = 0
    for y in range(max(0, int(np.ceil(c[1] - ry))), min(height - 1, int(c[1] + ry)) + 1):
        for x in range(max(0, int(np.ceil(c[0] - rx))), min(width - 1, int(c[0] + rx)) + 1):
            dx, dy = x - c[0], y - c[1]
            u = (dx * square[1, 1] - dy * square[1, 0]) / det
            v = (dy * square[0, 0] - dx * square[0, 1]) / det
            clean = abs(u) <= arm1 or abs(v) <= arm2
            if clean and abs(u) <= m1 and abs(v) <= m2 and n < px.shape[1]:
                px[0, n], px[1, n], px[2, n] = x, y, image[y, x]
                n += 1
    return n


@numba.njit(cache=True, error_model="numpy")
def _place(
    image: NDArray[np.uint8],
    start: Array,
    square: Array,
    bow: Array,
    arm: float,
    rough: bool,
    px: Array,
    q: Array,
    J: Array,
    r: Array,
    L: Array,
) -> int:
    """Fit one corner; q, J, r and L are left at the solution. Return how many pixels were fitted, or minus a verdict."""
    if not np.isfinite(start[0] + start[1] + square.sum()):
        return -_BORDER
    sides, centre = np.empty((2, 2)), np.empty(2)
    for j in range(2):
        sides[j] = square[j] / np.hypot(square[j, 0], square[j, 1])
    n = _gather(image, start, square, arm, px)
    if n < 3 * PARAMETERS:
        return -_BORDER
    first_guess(n, px, start, square, START_BLUR_PX, q)
    step = n // PIXELS_FIRST
    if step > 1:  # a share of the pixels finds the corner faster, and all of them place it
        few = np.empty((3, (n + step - 1) // step))
        few[:] = px[:, :n:step]
        if not fit_crossing(few.shape[1], few, q, sides, bow, J, r, L):
            return -_DIVERGED
        if rough:
            return few.shape[1]
    for _ in range(2):
        centre[:] = q[:2]
        if np.hypot(centre[0] - start[0], centre[1] - start[1]) > RECENTRE_PX:
            n = _gather(image, centre, square, arm, px)
        if n < 3 * PARAMETERS or not fit_crossing(n, px, q, sides, bow, J, r, L):
            return -_DIVERGED
        if np.hypot(q[0] - centre[0], q[1] - centre[1]) < RECENTRE_PX:
            break
    return n


@numba.njit(cache=True, error_model="numpy")
def _reach(square: Array) -> float:
    """Return how far the window reaches along the shorter side of a square, px."""
    shorter = min(np.hypot(square[0, 0], square[0, 1]), np.hypot(square[1, 0], square[1, 1]))
    return float(min(WINDOW_SHARE * shorter, WINDOW_MAX_PX))


@numba.njit(cache=True, error_model="numpy")
def _refine(
    image: NDArray[np.uint8],
    uv0: Array,
    squares: Array,
    bows: Array,
    arm: float,
    rough: bool,
    uv: Array,
    cov: Array,
    about: Array,
    verdict: Ids,
) -> None:
    """Fit every corner; about (N, 4) receives contrast, residual and the two blurs."""
    size = int((2 * WINDOW_MAX_PX + 2) ** 2 * 2)
    px, J, r = np.empty((3, size)), np.empty((PARAMETERS, size)), np.empty(size)
    L, inverse, q = np.zeros((PARAMETERS, PARAMETERS)), np.empty((PARAMETERS, PARAMETERS)), np.empty(PARAMETERS)
    for i in range(uv0.shape[0]):
        uv[i] = uv0[i]
        n = _place(image, uv0[i], squares[i], bows[i], arm, rough, px, q, J, r, L)
        if n < 0:
            verdict[i] = -n
            continue
        uv[i] = q[:2]
        invert(L, inverse)
        variance = edge_noise(n, J, r, inverse, 0, 1)
        cov[i] = variance * inverse[:2, :2]
        about[i, 1] = np.sqrt(variance)
        about[i, 0], about[i, 2], about[i, 3] = q[7], np.sqrt(q[4]), np.sqrt(q[5])
        reach = _reach(squares[i])
        moved = np.hypot(q[0] - uv0[i, 0], q[1] - uv0[i, 1])
        if not moved <= min(MOVED_SHARE / WINDOW_SHARE * reach, MOVED_MAX_PX):
            verdict[i] = _MOVED
        elif not abs(q[7]) >= 0.5 * CONTRAST_MIN:
            verdict[i] = _FAINT
        elif about[i, 1] > MISFIT_MAX * abs(q[7]) or max(about[i, 2], about[i, 3]) > reach:
            verdict[i] = _MISFIT
        else:
            verdict[i] = _KEPT


def refine_corners(
    image: NDArray[np.uint8],
    uv: Array,
    squares: Array,
    bows: Array | None = None,
    *,
    arm: float = 1.0,
    rough: bool = False,
) -> CornerFits:
    """Fit X corners.

    Args:
        image: (H, W) grey image.
        uv: (N, 2) rough places, raw pixels, right to a few pixels and a quarter of a square.
        squares: (N, 2, 2) the two sides of the square at each corner, px: along the columns, along the rows.
        bows: (N, 2, 2) how each of the two edges bows, 1/px: a point t px along it lies ``t^2 * bow`` off its tangent;
            straight by default.
        arm: how far from the edges the squares are plain, as a share of a side; what lies further from both edges is
            not looked at. The squares of a charuco board are plain only along their sides.
        rough: fit a share of the pixels only, in a third of the time; good to some hundredths of a pixel.

    Returns:
        The fits, in the order given.
    """
    n = len(uv)
    out, cov, about, verdict = np.empty((n, 2)), np.zeros((n, 2, 2)), np.zeros((n, 4)), np.zeros(n, np.int64)
    bows = np.zeros((n, 2, 2)) if bows is None else bows
    uv, squares, bows = (np.ascontiguousarray(a, dtype=np.float64) for a in (uv, squares, bows))
    _refine(np.ascontiguousarray(image), uv, squares, bows, arm, rough, out, cov, about, verdict)
    return CornerFits(out, cov, about[:, 0], about[:, 1], about[:, 2:], verdict)
