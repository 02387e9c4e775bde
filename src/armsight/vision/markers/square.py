"""Corners of square code markers (AprilTag, ArUco) by a fit of the whole printed pattern, with covariance.

A grey image, a marker's cells and its rough corners go in; its four corners and their covariance come out. The marker
is modelled as what it is, a grid of dark and bright cells in a white surround, seen through a homography, blur and
pixels:

    I(x) = (1 + k . d) (a + b M + c (1 - M^2)),   M = sum of the cells' colours, each edge blurred as in ``normal.py``.

Every edge of the pattern is measured, not the outline alone, so the corners of small markers are several times more
accurate than from their outline. The homography is corrected by a displacement field that is quadratic over the marker:
its affine and perspective parts are free, the others model the bow that lens distortion gives to lines, which is small
(prior). c models print that bleeds and the camera's gamma, which make all dark cells look smaller or larger and would
move an outline's corners inward or outward. Method: Levenberg-Marquardt; the covariance is that of the linearised fit
with the noise that its own residuals show. The compiled image model and its fit come first, their use on an image after
them.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Ids, Record
from armsight.geometry.matrix import dot
from armsight.kernels import kernel
from armsight.vision.normal import edge, edge_noise, factor, invert, normal_equations, solve

FIELD = 12  # coefficients of the quadratic field over the marker
PARAMETERS = FIELD + 6  # ..., squared blur, b, c, a, k (2)
_STEPS, _STOP, _STALL, _LAMBDA = 40, 0.05, 0.05, 1e-2  # as in corner.py
_BLUR2_MIN = 0.03  # px^2, as in corner.py


@kernel("f8, f8, f8[:, ::1]")
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


@kernel(fastmath=True)
def _shares(x: float, cells: int, px: float, width: float, blur: float, out: Array) -> int:
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


@kernel(fastmath=True)
def _skewed(
    u: float, v: float, cells: int, px: Array, spread: float, grid: Array, cx: int, cy: int, slopes: Array
) -> float:
    """Return the correction of M at the cells' corners for axes that are not perpendicular to each other in the image.

    As C in ``corner.py``, weighted with how the four cells at a corner differ; slopes (3,) receives the derivatives by
    u, v and the squared blur.
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


@kernel(fastmath=True)
def _evaluate(n: int, px: Array, grid: Array, prior: Array, q: Array, J: Array, r: Array) -> float:
    """Fill residuals r and derivatives J (18, n) of pixels px (8, n) at parameters q (18,); return the cost.

    px: grey, marker coordinates x, y, per axis the length of a unit in pixels and the pixel's width, and the cosine
    between the axes' gradients. grid: (N + 4, N + 4), the cells as -1 and 1 with two rings of white around.
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
        cx = _shares(u, cells, px[3, i], px[5, i], blur_x, wx)
        cy = _shares(v, cells, px[4, i], px[6, i], blur_y, wy)
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


@kernel
def _assemble(n: int, q: Array, prior: Array, J: Array, r: Array, A: Array, g: Array) -> None:
    """Fill the normal equations with the prior, and hold a blur that is at its lower bound."""
    normal_equations(n, J, r, A, g)
    for i in range(FIELD + 3):
        A[i, i] += prior[i, 1]
        g[i] += prior[i, 1] * (prior[i, 0] - q[i])
    if q[FIELD] < 1.001 * _BLUR2_MIN and g[FIELD] < 0.0:
        A[FIELD, FIELD] *= 1e9
        g[FIELD] = 0.0


@kernel("i8, f8[::1, :], f8[:, ::1], f8[:, ::1], f8[::1], f8[:, ::1], f8[:, ::1], f8[::1]")
def fit_pattern(n: int, px: Array, grid: Array, prior: Array, q: Array, inverse: Array, J: Array, r: Array) -> float:
    """Minimise from q by Levenberg-Marquardt; return the noise variance, -1 if unsettled.

    ``inverse`` (18, 18), J (18, n) and r (n,), derivatives and residuals, are filled.
    """
    A, L = np.empty((PARAMETERS, PARAMETERS)), np.zeros((PARAMETERS, PARAMETERS))
    g, step, trial = np.empty(PARAMETERS), np.empty(PARAMETERS), np.empty(PARAMETERS)
    cost, damping = _evaluate(n, px, grid, prior, q, J, r), _LAMBDA
    _assemble(n, q, prior, J, r, A, g)
    for _ in range(_STEPS):
        if not factor(A, damping, L):
            return -1.0
        solve(L, g, step)
        gain = dot(step, g)
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


#: How far the window extends beyond the outline, in cells, and its distance, px, from the end of the white around a
#: marker, which is one cell wide by the families' definitions.
MARGIN_CELLS, MARGIN_GAP_PX = (0.2, 0.6), 1.5
#: More pixels than this are thinned evenly, in the first fit, which only finds the position, and in the last.
PIXELS_FIRST, PIXELS_LAST = 500, 3000
#: Blur at the start of the first fit, cells, so that corners that are off by most of a cell still converge.
START_BLUR_CELLS = 0.4
#: A corner that ends further than this many cells from where it was found belongs to something else.
MOVED_MAX_CELLS = 2.0
#: The fit is repeated about its own result until no corner moves by more than this, cells and px.
SETTLED_CELLS, SETTLED_PX = 0.1, 0.3
#: Largest residual as a share of the contrast (half the step between dark and bright).
MISFIT_MAX = 0.5

_ROUNDS = 5
#: Weak priors, as in ``corner.py``, of a squared blur, px^2: mean and sigma.
_BLUR2_PRIOR = (0.25, 0.25)
#: Bow of a line by lens distortion: its deviation is about this times the squared length in px (a webcam near its
#: corner).
_BOW_PER_PX = 1e-4
_BLEED_SHARE = 0.3  # c as a share of b, about
_PRIOR_NOISE = 2.0  # grey levels of noise that the priors on bow and c are weighted against

_CORNERS = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


@dataclass(frozen=True, eq=False)
class SquareFit(Record):
    """The fitted corners of one marker.

    Attributes:
        uv: (4, 2) corners in the same order as the rough ones, raw pixels.
        cov_uv: (4, 2, 2) covariance of each, px^2.
        problem: why the fit must not be used; None when it is good.
    """

    uv: Array
    cov_uv: Array
    problem: str | None


def fit_square(
    image: NDArray[np.uint8], corners: Array, cells: NDArray[np.int8], diagonal: int | None = None
) -> SquareFit:
    """Fit one marker.

    Args:
        image: (H, W) grey image.
        corners: (4, 2) rough corners, raw pixels: those of the cells' upper left, upper right, lower right, lower left.
        cells: (N, N) the marker's cells, its dark border included: 1 bright, -1 dark.
        diagonal: the colour beyond the marker's corners, as a cell's; unknown by default, and then ignored.

    Returns:
        The fitted corners, or why they cannot be fitted.
    """
    cell = float(np.mean(np.linalg.norm(np.diff(corners, axis=0, append=corners[:1]), axis=1))) / len(cells)
    here, blur, pixels = corners, START_BLUR_CELLS * cell, PIXELS_FIRST
    for _ in range(_ROUNDS):
        fit = _fit_from(image, here, cells, diagonal, max(1.0, blur), pixels)
        if fit.problem is not None:
            return fit
        moved = np.linalg.norm(fit.uv - here, axis=1).max()
        if not np.linalg.norm(fit.uv - corners, axis=1).max() <= max(MOVED_MAX_CELLS * cell, 1.0):
            return _bad(corners, "its corners are not where they were found")
        if moved < max(SETTLED_CELLS * cell, SETTLED_PX) and pixels == PIXELS_LAST:
            return fit
        here, blur, pixels = np.array(fit.uv), 1.0, PIXELS_LAST
    return _bad(corners, "no convergence")


def _fit_from(
    image: NDArray[np.uint8], corners: Array, cells: NDArray[np.int8], diagonal: int | None, blur: float, pixels: int
) -> SquareFit:
    """Fit one marker's field over the homography of given corners, starting at a blur in px."""
    size = len(cells)
    H: Array = cv2.getPerspectiveTransform(corners.astype(np.float32), _CORNERS.astype(np.float32)).astype(np.float64)
    gathered = _gather(image, corners, H, size, diagonal is not None, pixels)
    if gathered is None or gathered[0].shape[1] < 3 * PARAMETERS:
        return _bad(corners, "too small or too near the image border")
    px, at = gathered
    low, high = np.percentile(px[0], (5, 95))
    q, prior, inverse = np.zeros(PARAMETERS), np.zeros((FIELD + 3, 2)), np.empty((PARAMETERS, PARAMETERS))
    q[FIELD], q[FIELD + 1], q[FIELD + 3] = blur * blur, 0.5 * (high - low), 0.5 * (high + low)
    side = float(np.mean(np.linalg.norm(np.diff(corners, axis=0, append=corners[:1]), axis=1)))
    prior[8:FIELD, 1] = (_PRIOR_NOISE * 0.5 / (_BOW_PER_PX * side)) ** 2
    prior[FIELD] = _BLUR2_PRIOR[0], _BLUR2_PRIOR[1] ** -2
    prior[FIELD + 2, 1] = (_PRIOR_NOISE / (_BLEED_SHARE * max(q[FIELD + 1], 1.0))) ** 2
    grid = np.pad(cells.astype(np.float64), 2, constant_values=1.0)
    grid[np.ix_((0, 1, -2, -1), (0, 1, -2, -1))] = 1.0 if diagonal is None else diagonal
    J, r = np.empty((PARAMETERS, px.shape[1])), np.empty(px.shape[1])
    variance = fit_pattern(px.shape[1], px, grid, prior, q, inverse, J, r)
    if variance < 0.0:
        return _bad(corners, "no convergence")
    if not np.sqrt(variance) <= MISFIT_MAX * q[FIELD + 1]:
        return _bad(corners, "the pattern does not fit")
    uv, by_field = _corners(q, np.asarray(np.linalg.inv(H), np.float64))
    cov_field = variance * inverse[:FIELD, :FIELD]
    cov, middle = by_field @ cov_field @ by_field.transpose(0, 2, 1), by_field.mean(axis=0)
    # The corners of one fit have errors in common. Whoever takes them as independent finds the middle as it is then.
    together = 4.0 * np.trace(middle @ cov_field @ middle.T) / np.trace(cov.mean(axis=0))
    cov *= max(1.0, float(together)) * correlated(at, r, middle @ inverse[:FIELD] @ J)
    return SquareFit(uv, cov, None)


#: Neighbours of pixels, px, between which noise is looked at.
_NEIGHBOURS = 4


def correlated(at: Ids, residuals: Array, gains: Array) -> float:
    """Return by how much the variance of a fit's result grows because the noise of neighbouring pixels is correlated.

    Args:
        at: (N, 2) columns and rows of the pixels.
        residuals: (N,) of the fit.
        gains: (K, N) derivative of K results by the pixels' grey levels.

    Returns:
        The mean over the results, one at least. The noise's autocovariance is that of the residuals, over up to four
        pixels; gains and residuals are correlated by FFT.
    """
    x, y = at.T - at.min(axis=0)[:, None]
    shape = (int(y.max()) + 1 + _NEIGHBOURS, int(x.max()) + 1 + _NEIGHBOURS)

    def lags(values: Array) -> Array:
        """Return the autocorrelation of values (N,) on the pixels up to a few pixels."""
        plane = np.zeros(shape)
        plane[y, x] = values
        power = np.abs(np.fft.rfft2(plane)) ** 2
        near = np.arange(-_NEIGHBOURS, _NEIGHBOURS + 1)
        return np.asarray(np.fft.irfft2(power, shape)[np.ix_(near, near)])

    pairs = lags(np.ones(len(residuals)))
    rho = np.where(pairs > 0.5, lags(residuals) / np.maximum(pairs, 0.5), 0.0)
    rho /= max(float(rho[_NEIGHBOURS, _NEIGHBOURS]), 1e-12)
    factors = [float((rho * by).sum() / by[_NEIGHBOURS, _NEIGHBOURS]) for by in map(lags, gains)]
    return max(1.0, float(np.mean(factors)))


def _bad(corners: Array, problem: str) -> SquareFit:
    """Return a fit that failed."""
    return SquareFit(corners, np.zeros((4, 2, 2)), problem)


def _gather(
    image: NDArray[np.uint8], corners: Array, H: Array, size: int, whole: bool, pixels: int
) -> tuple[Array, Ids] | None:
    """Collect the pixels of a marker and its margin, (8, n) as in ``fit_pattern``, and their columns and rows (n, 2)."""
    cell = float(np.sqrt(abs(cv2.contourArea(corners.astype(np.float32))))) / size
    margin = np.clip(1.0 - MARGIN_GAP_PX / max(cell, 1e-9), *MARGIN_CELLS)
    reach = 1.0 + 2.0 * float(margin) / size
    quad = cv2.perspectiveTransform((reach * _CORNERS)[None], np.linalg.inv(H))[0]
    low = np.maximum(np.floor(quad.min(axis=0)), 0).astype(int)
    high = np.minimum(np.ceil(quad.max(axis=0)), np.array(image.shape[::-1]) - 1).astype(int)
    if not (np.isfinite(quad).all() and (high > low).all()):
        return None
    v, u = np.mgrid[low[1] : high[1] + 1, low[0] : high[0] + 1].reshape(2, -1)
    p = H / (H[2] @ [*corners.mean(axis=0), 1.0]) @ np.stack([u, v, np.ones(len(u))])  # positive before the horizon
    xy = p[:2] / p[2]
    beyond = (np.abs(xy) > 1.0).all(axis=0)  # beyond the marker's corners
    inside = (p[2] > 0) & (np.abs(xy) <= reach).all(axis=0) & (whole | ~beyond)
    chosen = np.flatnonzero(inside)
    if len(chosen) > pixels:
        chosen = chosen[np.linspace(0, len(chosen) - 1, pixels).astype(int)]
    slope = H[:2, None, :2] - xy[:, chosen][:, :, None] * H[2, :2]
    slope /= (H[2] @ [*corners.mean(axis=0), 1.0]) * p[2, chosen][None, :, None]
    steep = np.linalg.norm(slope, axis=2)
    width = np.abs(slope).max(axis=2) / steep
    cosine = (slope[0] * slope[1]).sum(axis=1) / steep.prod(axis=0)
    px = np.concatenate([image[v[chosen], u[chosen]][None], xy[:, chosen], 1.0 / steep, width, cosine[None]])
    return px, np.column_stack([u[chosen], v[chosen]])


def _corners(q: Array, H: Array) -> tuple[Array, Array]:
    """Return the corners (4, 2) and their derivatives (4, 2, FIELD) by the field; H: marker to image."""
    phi = np.empty((FIELD, 2))
    uv, by_field = np.empty((4, 2)), np.empty((4, 2, FIELD))
    for i, corner in enumerate(_CORNERS):
        at = corner.copy()
        for _ in range(10):  # the point that the field maps onto the corner; the field is small, so this converges
            field(at[0], at[1], phi)
            at = corner - q[:FIELD] @ phi
        x, y, w = H @ np.array([at[0], at[1], 1.0])
        uv[i] = x / w, y / w
        by_field[i] = (H[:2, :2] - uv[i][:, None] * H[2, :2]) / w @ -phi.T
    return uv, by_field
