"""Sub-pixel X corners (chessboards, charuco) by a model fit, each with the covariance its own residuals support.

A grey image, rough corners and the shape of the squares around them go in; pixel positions and covariances come out.
Around a corner the image is modelled as the product of two edges under an illumination that varies linearly,

    I(x) = (1 + k . d) (a + b M),   M = E1(u1) E2(u2) + C(u1, u2),   d = x - c,   u_i = n_i . (d - h_i t_i^2).

u_i is the distance from edge i, h_i t_i^2 the edge's bow from lens distortion (known from the neighbouring corners). E_i is
a step seen through Gaussian blur s_i and a pixel: across the edge a pixel is a box as wide as the longer of its two
shadows, and the shorter one joins the blur. Sharp cameras blur by less than a pixel, so this matters. C corrects the
product where the edges are not square to each other: the expectation of sgn(u1 + e1) sgn(u2 + e2) for blur of correlation
rho = n1 . n2 by the first terms of Mehler's series (Abramowitz and Stegun 26.3.29). Levenberg-Marquardt finds c, the edges'
angles, s, a, b and k; the covariance of c is that of the linearised fit with the noise that the residuals at the edges
show. An X corner has a point symmetry that gamma, bleeding print, blur and sharpening keep, so none of them moves it.

First the window about a corner: which pixels a fit uses, and the moments of those on plain squares. Then the fit of
every corner of an image; its kernels are in ``crossing.py``.
"""

from __future__ import annotations

from dataclasses import dataclass
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Ids, Record
from armsight.kernels import kernel
from armsight.vision.markers.crossing import (
    GREY,
    LAGS,
    MOMENTS,
    PARAMETERS,
    ROOM,
    WORK,
    Work,
    Y,
    edge_noise,
    first_guess,
    fit_crossing,
    rough_noise,
)
from armsight.vision.normal import SIMD_WIDTH

#: How far the window extends along each square's side, as a share of the side, and at most in px. The next corners stay
#: outside with their blur.
WINDOW_SHARE, WINDOW_MAX_PX = 0.42, 12.0
#: Where squares carry a print, this much more room is left beside it, px, for its blur.
ARM_GAP_PX = 1.5
#: A fit with many more pixels near edges than this is first made with about so many.
PIXELS_FIRST = 64


@kernel
def gather(
    image: NDArray[np.uint8],
    c: Array,
    square: Array,
    bow: Array,
    arm: float,
    most: float,
    near: Array,
    w: Work,
    flat: Array,
) -> int:
    """Collect the pixels of the window about a corner: those near an edge into w, the others into the moments.

    Args:
        image: (H, W) grey image.
        c: (2,) the corner; pixel positions are relative to the nearest whole pixel.
        square: (2, 2) the sides of the square at it, px.
        bow: (2, 2) how the edges bow, 1/px.
        arm: as in ``refine_corners``.
        most: how far the window extends along the sides at most, px.
        near: (2,) distance from each edge below which a pixel counts as near it, px.
        w: (WORK,) receives x, y and grey of the pixels near the edges.
        flat: (2, MOMENTS) receives the moments of those of plain squares.

    Returns:
        The number of pixels near the edges.
    """
    height, width = image.shape
    s1, s2 = np.hypot(square[0, 0], square[0, 1]), np.hypot(square[1, 0], square[1, 1])
    m1, m2 = min(WINDOW_SHARE, most / s1), min(WINDOW_SHARE, most / s2)
    arm1, arm2 = max(0.5 * arm, arm - ARM_GAP_PX / s1), max(0.5 * arm, arm - ARM_GAP_PX / s2)
    det = square[0, 0] * square[1, 1] - square[0, 1] * square[1, 0]
    # Along the sides: u = ux dx + uy dy, v = vx dx + vy dy; edge 1 runs along the first side, where v is 0.
    ux, uy, vx, vy = square[1, 1] / det, -square[1, 0] / det, -square[0, 1] / det, square[0, 0] / det
    near_v = (near[0] + np.hypot(bow[0, 0], bow[0, 1]) * (m1 * s1) ** 2) * s1 / abs(det)
    near_u = (near[1] + np.hypot(bow[1, 0], bow[1, 1]) * (m2 * s2) ** 2) * s2 / abs(det)
    x0, y0 = int(np.rint(c[0])), int(np.rint(c[1]))
    cx, cy = c[0] - x0, c[1] - y0
    ry = m1 * abs(square[0, 1]) + m2 * abs(square[1, 1])
    flat[:] = 0.0
    n = 0
    for y in range(max(-y0, int(np.ceil(cy - ry))), min(height - 1 - y0, int(np.floor(cy + ry))) + 1):
        u0, v0 = uy * (y - cy) - ux * cx, vy * (y - cy) - vx * cx
        low, high = -float(x0), float(width - 1 - x0)
        for slope, middle, reach in ((ux, u0, m1), (vx, v0, m2)):
            if abs(slope) > 1e-9:
                half, centre = reach / abs(slope), -middle / slope
                low, high = max(low, centre - half), min(high, centre + half)
            elif abs(middle) > reach:
                high = low - 1.0
        row = image[y0 + y]
        p_n = p_x = p_xx = p_i = p_ix = p_ii = m_n = m_x = m_xx = m_i = m_ix = m_ii = 0
        for x in range(int(np.ceil(low)), int(np.floor(high)) + 1):
            u, v = u0 + ux * x, v0 + vx * x
            grey: Any = np.int64(row[x0 + x])
            if abs(v) < near_v or abs(u) < near_u:
                if n < ROOM - SIMD_WIDTH and (abs(u) <= arm1 or abs(v) <= arm2):
                    w[n], w[Y + n], w[GREY + n] = x, y, grey
                    n += 1
            elif abs(u) <= arm1 or abs(v) <= arm2:
                if u * v > 0.0:
                    p_n, p_x, p_xx, p_i = p_n + 1, p_x + x, p_xx + x * x, p_i + grey
                    p_ix, p_ii = p_ix + x * grey, p_ii + grey * grey
                else:
                    m_n, m_x, m_xx, m_i = m_n + 1, m_x + x, m_xx + x * x, m_i + grey
                    m_ix, m_ii = m_ix + x * grey, m_ii + grey * grey
        _add_row(flat[0], y, p_n, p_x, p_xx, p_i, p_ix, p_ii)
        _add_row(flat[1], y, m_n, m_x, m_xx, m_i, m_ix, m_ii)
    return n


@kernel(forceinline=True)
def _add_row(m: Array, y: int, n: int, x: int, xx: int, i: int, ix: int, ii: int) -> None:
    """Add the sums of a row of pixels to the moments m, in the order of crossing.MOMENTS."""
    m[0] += n
    m[1] += x
    m[2] += n * y
    m[3] += xx
    m[4] += x * y
    m[5] += n * y * y
    m[6] += i
    m[7] += ix
    m[8] += i * y
    m[9] += ii


@kernel
def thin(n: int, w: Work, flat: Array) -> int:
    """Keep a share of the pixels; return their number."""
    step = max(1, n // PIXELS_FIRST)
    few = (n + step - 1) // step
    for i in range(few):
        w[i], w[Y + i], w[GREY + i] = w[i * step], w[Y + i * step], w[GREY + i * step]
    flat /= step
    return few


@kernel
def fill_up(n: int, w: Work) -> None:
    """Repeat the last pixel to the end of a SIMD vector."""
    for i in range(n, n + SIMD_WIDTH):
        w[i], w[Y + i], w[GREY + i] = w[n - 1], w[Y + n - 1], w[GREY + n - 1]


@kernel
def reach_px(square: Array) -> float:
    """Return how far the window extends along the shorter side of a square, px."""
    shorter = min(np.hypot(square[0, 0], square[0, 1]), np.hypot(square[1, 0], square[1, 1]))
    return float(min(WINDOW_SHARE * shorter, WINDOW_MAX_PX))


#: How far the window of a first fit extends at most, px.
WINDOW_ROUGH_PX = 8.0
#: The blur that the first fit of an image starts with, and the least for which a window is sized.
START_BLUR_PX = 1.0
#: Pixels further from an edge than so many sigmas of its blur, plus these px, are on plain squares. The remaining error
#: is 5e-4 of the contrast at the most; a rough position needs more room.
NEAR_SIGMAS, NEAR_PX, NEAR_ROUGH_PX = 3.5, 0.25, 0.75
#: A fit ends with the step that lowers the sum of squares by less than this share of one pixel's noise, a first one by
#: less than this; or that moves the edges and their blur by less than this share of the blur.
STOP, STOP_ROUGH = 0.05, 20.0
SLIGHT, SLIGHT_ROUGH = 0.1, 0.3
#: Fewer pixels near the edges than this do not determine a corner.
_FEWEST = 16
#: A window whose opposite quadrants differ by less, grey levels, shows no corner.
PLAIN = 1.0
#: A start further off than this leaves the window off centre; the window is gathered again about the corner.
RECENTRE_PX = 0.5
#: A fit that ends further from its start is not of this corner: share of the shorter side, and px.
MOVED_SHARE, MOVED_MAX_PX = 0.25, 3.0
#: Fewest grey levels between a corner's dark and bright squares.
CONTRAST_MIN = 8.0
#: Largest residual as a share of the contrast (half the step). Camera noise of 10 grey levels on a contrast of 50
#: gives 0.4; half a window of the wrong colour gives 0.9. Where those of most corners of an image are large, as the halos
#: of sharpening make them, it is the image that is so: up to so many times their median is usual then.
MISFIT_MAX, MISFIT_RATIO = 0.45, 1.5

#: Why a corner was not kept; the index is the code in :attr:`CornerFits.outcome`.
OUTCOMES = (
    "kept",
    "too near the image border",
    "no convergence",
    "moved",
    "low contrast",
    "does not look like a corner",
)
#: Fewer corners do not show what of their residuals is odd, nor how the noise of neighbouring pixels is correlated.
_MANY = 8
#: Least share of the noise's variance that is taken to move a corner where neighbours' noise is opposite.
_EFFECTIVE = 0.5
_KEPT, _BORDER, _DIVERGED, _MOVED, _FAINT, _MISFIT = range(6)


@dataclass(frozen=True, eq=False)
class CornerFits(Record):
    """The fit of each corner."""

    #: (N, 10) the model's parameters: c (2), the angles of the edges' normals (2), squared blurs (2), a, b, k (2)
    models: Array
    #: (N, 2, 2) covariance from each fit's own residuals; from those of all, what part of them can move a corner, and
    #: the correlation of neighbours, px^2
    cov_uv: Array
    residual: Array  #: (N,) standard deviation of the residuals at the edges, grey levels
    outcome: Ids  #: (N,) index into OUTCOMES; 0 is kept

    @property
    def uv(self) -> Array:
        """(N, 2) refined corners, raw pixels; meaningless where the outcome is not 0."""
        return self.models[:, :2]

    @property
    def contrast(self) -> Array:
        """(N,) signed half step between the squares, grey levels.

        The sign gives the colours: positive where the square between the first and the second side is bright.
        """
        return self.models[:, 7]

    @property
    def kept(self) -> NDArray[np.bool_]:
        """(N,) whether a corner's fit is good."""
        return np.asarray(self.outcome == _KEPT)


@kernel
def _fit_one(
    image: NDArray[np.uint8],
    start: Array,
    square: Array,
    bow: Array,
    arm: float,
    rough: bool,
    known: bool,
    blur: float,
    w: Work,
    q: Array,
    L: Array,
    origin: Array,
) -> int:
    """Fit one corner, from q where that is known, else from a given blur; q, w and L are left at the solution.

    origin (2,) is the pixel to which w is relative. Return the number of fitted pixels near the edges, or minus the
    outcome.
    """
    if not np.isfinite(start[0] + start[1] + square.sum()):
        return -_BORDER
    sides, centre, near, flat = np.empty((2, 2)), np.empty(2), np.empty(2), np.empty((2, MOMENTS))
    for j in range(2):
        sides[j] = square[j] / np.hypot(square[j, 0], square[j, 1])
    if not known:  # a share of the pixels finds the corner faster; all of them refine it
        near[:] = NEAR_SIGMAS * np.sqrt(START_BLUR_PX**2 + 1.0 / 12.0) + NEAR_ROUGH_PX
        n = gather(image, start, square, bow, arm, WINDOW_ROUGH_PX, near, w, flat)
        if n < _FEWEST or n + flat[0, 0] + flat[1, 0] < 3 * PARAMETERS:
            return -_BORDER
        n = thin(n, w, flat)
        fill_up(n, w)
        x0, y0 = np.rint(start[0]), np.rint(start[1])
        first_guess(n, w, flat, x0, y0, start, square, blur, q)
        if abs(q[7]) < PLAIN:
            return -_FAINT
        if not fit_crossing(n, w, flat, x0, y0, q, sides, bow, L, STOP_ROUGH, SLIGHT_ROUGH):
            return -_DIVERGED
        if rough:
            return n
    for _ in range(2):
        centre[:] = q[:2]
        if not (abs(centre[0] - start[0]) + abs(centre[1] - start[1]) < 2.0 * WINDOW_MAX_PX):
            return -_DIVERGED
        for j in range(2):
            near[j] = NEAR_SIGMAS * np.sqrt(q[4 + j] + 1.0 / 12.0) + NEAR_PX
        n = gather(image, centre, square, bow, arm, WINDOW_MAX_PX, near, w, flat)
        if n < _FEWEST or n + flat[0, 0] + flat[1, 0] < 3 * PARAMETERS:
            return -_DIVERGED
        fill_up(n, w)
        origin[0], origin[1] = np.rint(centre[0]), np.rint(centre[1])
        if not fit_crossing(n, w, flat, origin[0], origin[1], q, sides, bow, L, STOP, SLIGHT):
            return -_DIVERGED
        if np.hypot(q[0] - centre[0], q[1] - centre[1]) < RECENTRE_PX:
            break
    return n


@kernel(
    "const u1[:, ::1], f8[:, ::1], f8[:, :, ::1], f8[:, :, ::1], f8, b1, b1[::1], f8[:, ::1], f8[:, :, ::1], "
    "f8[:, :, :, ::1], f8[:, :, ::1], f8[::1], i8[::1]"
)
def _refine(
    image: NDArray[np.uint8],
    uv0: Array,
    squares: Array,
    bows: Array,
    arm: float,
    rough: bool,
    known: NDArray[np.bool_],
    models: Array,
    cov: Array,
    noise: Array,
    gains: Array,
    residual: Array,
    outcome: Ids,
) -> None:
    """Fit every corner; models (N, PARAMETERS) holds the starts of those that are known, and receives the solutions."""
    w, L, blur = np.zeros(WORK, np.float32), np.zeros((PARAMETERS, PARAMETERS)), START_BLUR_PX
    origin = np.zeros(2)
    for i in range(uv0.shape[0]):
        q = models[i]
        n = _fit_one(image, uv0[i], squares[i], bows[i], arm, rough, known[i], blur, w, q, L, origin)
        if n < 0:
            outcome[i] = -n
            continue
        if rough:
            residual[i] = np.sqrt(rough_noise(n, w))
        else:
            residual[i] = np.sqrt(edge_noise(n, w, L, q[:2] - origin, cov[i], noise[i], gains[i]))
        reach = reach_px(squares[i])
        moved = np.hypot(q[0] - uv0[i, 0], q[1] - uv0[i, 1])
        if not moved <= min(MOVED_SHARE / WINDOW_SHARE * reach, MOVED_MAX_PX):
            outcome[i] = _MOVED
        elif not abs(q[7]) >= 0.5 * CONTRAST_MIN:
            outcome[i] = _FAINT
        elif np.sqrt(max(q[4], q[5])) > reach:
            outcome[i] = _MISFIT
        else:
            outcome[i] = _KEPT
            blur = np.sqrt(0.5 * (q[4] + q[5]))  # the next one's is about the same


def _pixels(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return an image in the form that all kernels expect: contiguous and read-only, so that they are compiled once."""
    pixels = np.ascontiguousarray(image).view()
    pixels.flags.writeable = False
    return pixels


def crossing_signs(image: NDArray[np.uint8], uv: Array, squares: Array) -> Array:
    """Find where squares of two colours may meet crosswise, by a quick test.

    ``image``: (H, W) grey image; ``uv``: (N, 2) raw pixels, right to a quarter of a square; ``squares``: (N, 2, 2) the two
    sides of the square at each position, px. Returns (N,) 1 where a patch in the square between the first and the second
    side, and one in the opposite square, are both brighter than those in the other two, -1 where they are darker, 0
    elsewhere.
    """
    out = np.zeros(len(uv))
    _quick_signs(_pixels(image), uv, squares, out)
    return out


@kernel("const u1[:, ::1], f8[:, ::1], f8[:, :, ::1], f8[::1]", "const u1[:, ::1], f8[:, ::1], f8[:, :, :], f8[::1]")
def _quick_signs(image: NDArray[np.uint8], uv: Array, squares: Array, out: Array) -> None:
    """Fill what :func:`crossing_signs` returns, out (N,) being zero."""
    means = np.empty((2, 2))
    for n in range(len(uv)):
        inside = np.isfinite(uv[n].sum() + squares[n].sum())
        for i in range(2 if inside else 0):
            for j in range(2):
                p = uv[n] + 0.25 * ((1 - 2 * i) * squares[n, 0] + (1 - 2 * j) * squares[n, 1])
                x, y = int(np.rint(p[0])), int(np.rint(p[1]))
                if not (1 <= x < image.shape[1] - 1 and 1 <= y < image.shape[0] - 1):
                    inside = False
                    continue
                means[i, j] = image[y - 1 : y + 2, x - 1 : x + 2].sum()
        if inside and min(means[0, 0], means[1, 1]) > max(means[0, 1], means[1, 0]):
            out[n] = 1.0
        elif inside and max(means[0, 0], means[1, 1]) < min(means[0, 1], means[1, 0]):
            out[n] = -1.0


def refine_corners(
    image: NDArray[np.uint8],
    uv: Array,
    squares: Array,
    bows: Array | None = None,
    *,
    arm: float = 1.0,
    rough: bool = False,
    like: CornerFits | None = None,
) -> CornerFits:
    """Fit X corners, rough at uv (N, 2) to a few pixels and a quarter of a square, in their order.

    Args:
        image: (H, W) grey image.
        uv: (N, 2) raw pixels.
        squares: (N, 2, 2) the two sides of the square at each corner, px: along the columns, along the rows.
        bows: (N, 2, 2) of the edges, 1/px: a point t px along one lies ``t^2 * bow`` off its tangent; straight by default.
        arm: how far from the edges squares are plain, as a share of a side (of charuco boards, along their sides only).
        rough: fit a share of the pixels, in half the time; good to some hundredths of a pixel, without covariance.
        like: earlier fits at uv, from which those start that it kept, in half the time.
    """
    n = len(uv)
    uv, squares = np.ascontiguousarray(uv, dtype=np.float64), np.ascontiguousarray(squares, dtype=np.float64)
    bows = np.zeros((n, 2, 2)) if bows is None else np.ascontiguousarray(bows, dtype=np.float64)
    if like is None:
        known, models = np.zeros(n, np.bool_), np.zeros((n, PARAMETERS))
        models[:, :2] = uv
    else:
        known, models = like.kept, np.array(like.models)
    cov, residual, outcome = np.zeros((n, 2, 2)), np.zeros(n), np.zeros(n, np.int64)
    noise, gains = np.zeros((n, 3, LAGS + 1, 2 * LAGS + 1)), np.zeros((n, LAGS + 1, 2 * LAGS + 1))
    _refine(_pixels(image), uv, squares, bows, arm, rough, known, models, cov, noise, gains, residual, outcome)
    lost = ~np.isfinite(residual)  # no pixel, or hardly one, determines these
    outcome[lost], residual[lost], cov[lost] = _DIVERGED, 0.0, 0.0
    share, good = residual / np.maximum(np.abs(models[:, 7]), 1e-9), outcome == _KEPT
    usual = 0.0 if rough or good.sum() < _MANY else median(share[good].tolist())
    outcome[good & (share > max(MISFIT_MAX, MISFIT_RATIO * usual))] = _MISFIT
    good = (outcome == _KEPT) & np.isfinite(noise).all(axis=(1, 2, 3))
    if not rough and good.sum() >= _MANY:
        variances = np.maximum(_effective(noise[good].sum(axis=0), gains), 1.0 / 12.0)
        cov *= (variances / np.mean(residual[good] ** 2))[:, None, None]
    return CornerFits(models, cov, residual, outcome)


def _effective(noise: Array, gains: Array) -> Array:
    """Return the variance of white noise that would move each corner as far as the image's noise does, grey levels squared.

    What the fits absorb of the noise lowers the residuals' products at all lags; white noise shows by how much.
    ``noise`` and the corners' ``gains`` as :func:`~armsight.vision.markers.crossing.edge_noise` fills them.
    """
    both = np.full(gains.shape[1:], 2.0)  # each lag below the first row is that of two neighbours, above and below
    both[0, :LAGS], both[0, LAGS] = 0.0, 1.0
    found, white = both * noise[0::2] / np.maximum(noise[1], 1e-300)
    least = _EFFECTIVE * found[0, LAGS] / max(white[0, LAGS], 1e-300)
    seen, expected = (gains * found).sum(axis=(1, 2)), (gains * white).sum(axis=(1, 2))
    return np.asarray(np.maximum(seen / np.maximum(expected, 0.1 * white[0, LAGS]), least))
