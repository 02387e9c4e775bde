"""Corners of square code markers (AprilTag, ArUco) by a fit of the whole printed pattern, with covariance.

A grey image, a marker's cells and its rough corners go in; its four corners and their covariance come out. The marker is
modelled as what it is, a grid of dark and bright cells in a white surround, seen through a homography, blur and pixels:

    I(x) = (1 + k . d) (a + b M + c (1 - M^2)),   M = sum of the cells' colours, each edge blurred as in ``normal.py``.

Every edge of the pattern is measured, not the outline alone, so the corners of small markers are several times more
accurate than from their outline. The homography is corrected by a displacement field that is quadratic over the marker:
its affine and perspective parts are free, the others model the bow that lens distortion gives to lines, which is small
(prior). c models print that bleeds and the camera's gamma, which make all dark cells look smaller or larger and would
move an outline's corners inward or outward. Method: Levenberg-Marquardt; the covariance is that of the linearised fit
with the noise that its own residuals show. Pixels are processed in blocks that stay in the processor's cache.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Ids, Record
from armsight.geometry.matrix import dot, product, solved
from armsight.kernels import kernel
from armsight.vision.markers.crossing import BLUR2_MIN, BLUR2_PRIOR
from armsight.vision.markers.quads import square_to_quad
from armsight.vision.normal import edge, factor, invert, solve

FIELD = 12  # coefficients of the quadratic field over the marker
PARAMETERS = FIELD + 6  # ..., squared blur, b, c, a, k (2)
_STEPS, _STALL, _LAMBDA = 40, 0.05, 1e-2  # as in corner.py
#: A step is the last when it lowers the cost by less than so many times one pixel's noise; in the first fit by so many.
_STOP, _STOP_FIRST = 0.5, 20.0  # the step is taken: what is left is a hundredth of it
_BLOCK = 128  # pixels


@kernel(fastmath=True, forceinline=True)
def _displaced(q: Array, x: float, y: float) -> tuple[float, float]:
    """Return where the field moves the marker's coordinates x, y in -1..1: affine, perspective (6, 7), bow (8 to 11)."""
    xx, xy, yy = x * x, x * y, y * y
    u = x + q[0] + q[1] * x + q[2] * y + (q[6] + q[10]) * xx + (q[7] + q[11]) * xy + q[8] * yy
    v = y + q[3] + q[4] * x + q[5] * y + (q[6] - q[10]) * xy + (q[7] - q[11]) * yy + q[9] * xx
    return u, v


@kernel(fastmath=True, forceinline=True)
def _by_field(x: float, y: float, a: float, b: float, out: Array) -> None:
    """Fill the derivatives (12,) by the field at x, y of a times the displacement along x plus b times that along y."""
    ax, ay, bx, by = a * x, a * y, b * x, b * y
    out[0], out[1], out[2], out[3], out[4], out[5] = a, ax, ay, b, bx, by
    out[6], out[7], out[8], out[9] = (ax + by) * x, (ax + by) * y, ay * y, bx * x
    out[10], out[11] = (ax - by) * x, (ax - by) * y


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
    gain, step_x, step_y = 0.0, 2.0 * kx / cells, 2.0 * ky / cells
    first_x, first_y = (u + 1.0) * kx - (cx + 1) * step_x, (v + 1.0) * ky - (cy + 1) * step_y
    slopes[:] = 0.0
    for j in range(max(int(np.ceil((first_y - 4.0) / step_y)), 0), min(int(np.floor((first_y + 4.0) / step_y)), 2) + 1):
        zy, row = first_y - j * step_y, cy + 3 + j
        for i in range(
            max(int(np.ceil((first_x - 4.0) / step_x)), 0), min(int(np.floor((first_x + 4.0) / step_x)), 2) + 1
        ):
            zx, col = first_x - i * step_x, cx + 3 + i
            step = grid[row, col] - grid[row, col - 1] - grid[row - 1, col] + grid[row - 1, col - 1]
            if step == 0.0:
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
def _fill(first: int, n: int, px: Array, grid: Array, q: Array, J: Array) -> None:
    """Fill derivatives and residuals J (19, _BLOCK) of n pixels from the first at parameters q (18,); zeros after them.

    px: (N, 8) grey, marker coordinates x, y, per axis the length of a unit in pixels and the pixel's width, and the cosine
    between the axes' gradients. grid: (N + 4, N + 4), the cells as -1 and 1 with two rings of white around.
    """
    cells = len(grid) - 4
    wx, wy, extra = np.empty((3, 4)), np.empty((3, 4)), np.empty(3)
    b, c, a = q[FIELD + 1], q[FIELD + 2], q[FIELD + 3]
    spread = 1.0 / np.sqrt(q[FIELD] + 1.0 / 12.0)
    J[:, n:] = 0.0
    for i in range(n):
        p = px[first + i]
        x, y = p[1], p[2]
        u, v = _displaced(q, x, y)
        blur_x = np.sqrt(q[FIELD] + (1.0 - p[5] ** 2) / 12.0)
        blur_y = np.sqrt(q[FIELD] + (1.0 - p[6] ** 2) / 12.0)
        cx = _shares(u, cells, p[3], p[5], blur_x, wx)
        cy = _shares(v, cells, p[4], p[6], blur_y, wy)
        M, mx, my, sx, sy = 0.0, 0.0, 0.0, 0.0, 0.0
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
            sx += wy[0, k] * s
            sy += wy[2, k] * w
        M += _skewed(u, v, cells, p, spread, grid, cx, cy, extra)
        mx += extra[0]
        my += extra[1]
        ms = 0.5 * (sx / blur_x + sy / blur_y) + extra[2]
        light = 1.0 + q[FIELD + 4] * x + q[FIELD + 5] * y
        level = a + b * M + c * (1.0 - M * M)
        slope = (b - 2.0 * c * M) * light
        _by_field(x, y, slope * mx, slope * my, J[:FIELD, i])
        J[FIELD, i] = slope * ms
        J[FIELD + 1, i] = light * M
        J[FIELD + 2, i] = light * (1.0 - M * M)
        J[FIELD + 3, i] = light
        J[FIELD + 4, i] = level * x
        J[FIELD + 5, i] = level * y
        J[PARAMETERS, i] = p[0] - light * level


@kernel(fastmath=True)
def _assemble(n: int, px: Array, grid: Array, prior: Array, q: Array, J: Array, A: Array) -> float:
    """Fill the normal equations at q, A (19, 19), the last row their right side; return the cost.

    A blur that is at its lower bound is held.
    """
    A[:, :] = 0.0
    for block in range((n + _BLOCK - 1) // _BLOCK):
        here = J[block]
        _fill(block * _BLOCK, min(_BLOCK, n - block * _BLOCK), px, grid, q, here)
        for i in range(PARAMETERS + 1):
            for j in range(i + 1):
                s = 0.0
                for m in range(_BLOCK):
                    s += here[i, m] * here[j, m]
                A[i, j] += s
    cost, g = A[PARAMETERS, PARAMETERS], A[PARAMETERS]
    for i in range(FIELD + 3):
        A[i, i] += prior[i, 1]
        g[i] += prior[i, 1] * (prior[i, 0] - q[i])
        cost += (q[i] - prior[i, 0]) ** 2 * prior[i, 1]
    if q[FIELD] < 1.001 * BLUR2_MIN and g[FIELD] < 0.0:
        A[FIELD, FIELD] *= 1e9
        g[FIELD] = 0.0
    return float(cost)


@kernel
def _minimise(n: int, px: Array, grid: Array, prior: Array, stop: float, q: Array, J: Array, inverse: Array) -> bool:
    """Minimise from q (18,) by Levenberg-Marquardt, px and grid as in ``_fill``; whether it settles.

    prior (15, 2): mean and weight; ``stop``: a step is the last when it lowers the cost by less, in one pixel's noise.
    Filled are J (blocks, 19, _BLOCK), derivatives and residuals, and inverse (18, 18), of the normal matrix.
    """
    A, T = np.empty((PARAMETERS + 1, PARAMETERS + 1)), np.empty((PARAMETERS + 1, PARAMETERS + 1))
    L, step, trial = np.zeros((PARAMETERS, PARAMETERS)), np.empty(PARAMETERS), np.empty(PARAMETERS)
    cost, damping, current = _assemble(n, px, grid, prior, q, J, A), _LAMBDA, True
    for _ in range(_STEPS):
        if not factor(A, damping, L):
            return False
        g = A[PARAMETERS, :PARAMETERS]
        solve(L, g, step)
        gain = dot(step, g)
        trial[:] = q + step
        trial[FIELD] = max(trial[FIELD], BLUR2_MIN)
        if current and damping <= 1.0 and gain < stop * cost / n:  # derivatives stay what they are
            step[:], q[:] = trial - q, trial
            for here in J:
                for i in range(PARAMETERS):
                    for m in range(_BLOCK):
                        here[PARAMETERS, m] -= step[i] * here[i, m]
            return _inverted(A, L, inverse)
        new = _assemble(n, px, grid, prior, trial, J, T)
        done = max(gain, abs(new - cost)) < _STALL * cost / n
        if new > cost and not done:
            damping, current = max(damping * 10.0, 1e-4), False
            if damping > 1e8:
                return False
            continue
        if cost - new > 0.5 * gain:
            damping = max(damping * 0.1, 1e-9)
        elif cost - new < 0.2 * gain:
            damping = max(damping * 3.0, 1e-2)
        q[:] = trial
        A[:, :], cost, current = T, new, True
        if done:
            return _inverted(A, L, inverse)
    return False


@kernel
def _inverted(A: Array, L: Array, inverse: Array) -> bool:
    """Fill the inverse (18, 18) of a normal matrix, L (18, 18) with its factor; whether there is one."""
    if not factor(A, 0.0, L):
        return False
    invert(L, inverse)
    return True


@kernel(fastmath=True)
def _noise(n: int, inverse: Array, by_middle: Array, J: Array, left: Array) -> float:
    """Return the variance of the noise, and fill ``left`` (n + 1, 4): 1, the residual, and by how much it moves the middle.

    The mean squared residual of the pixels that determine the position, each divided by 1 - leverage and weighted by its
    pixel's information about it: flat areas, saturated ones above all, must not count for the edges. No image is known
    better than its quantisation. by_middle: (2, FIELD) derivatives of the middle.
    """
    gains, leverage = product(by_middle, inverse[:FIELD]), np.empty(_BLOCK)
    weight, power = 0.0, 0.0
    for block in range((n + _BLOCK - 1) // _BLOCK):
        first, here = block * _BLOCK, J[block]
        count = min(_BLOCK, n - first)
        leverage[:] = 0.0
        for i in range(PARAMETERS):
            for j in range(i + 1):
                share = inverse[i, i] if i == j else 2.0 * inverse[i, j]
                for m in range(_BLOCK):
                    leverage[m] += share * here[i, m] * here[j, m]
        for m in range(count):
            w = here[0, m] ** 2 + here[3, m] ** 2
            weight += w * (1.0 - leverage[m])
            power += w * here[PARAMETERS, m] ** 2
            p = left[first + m]
            p[0], p[1], p[2], p[3] = 1.0, here[PARAMETERS, m], 0.0, 0.0
            for i in range(PARAMETERS):
                p[2] += gains[0, i] * here[i, m]
                p[3] += gains[1, i] * here[i, m]
    left[n] = 0.0
    return float(max(power / weight, 1.0 / 12.0))


#: How far the window extends beyond the outline, in cells, and its distance, px, from the end of the white around a
#: marker, which is one cell wide by the families' definitions.
MARGIN_CELLS, MARGIN_GAP_PX = (0.2, 0.6), 1.5
#: More pixels than this are thinned evenly, in the first fit, which only finds the position, and in the last.
PIXELS_FIRST, PIXELS_LAST = 300, 3000
#: An edge is seen so many sigmas of its blur away, and px more; share of the pixels further away that is used.
_NEAR_SIGMAS, _NEAR_PX, _FLAT = 3.0, 0.5, 0.25
#: Blur at the start of the first fit, cells, so that corners that are off by most of a cell still converge.
START_BLUR_CELLS = 0.4
#: A corner that ends further than this many cells from where it was found belongs to something else.
MOVED_MAX_CELLS = 2.0
#: The fit is repeated about its own result until no corner moves by more than this, cells and px.
SETTLED_CELLS, SETTLED_PX = 0.1, 0.3
#: Largest residual as a share of the contrast (half the step between dark and bright).
MISFIT_MAX = 0.5

_ROUNDS = 5
#: Bow of a line by lens distortion: its deviation is about this times the squared length in px (a webcam near its
#: corner).
_BOW_PER_PX = 1e-4
_BLEED_SHARE = 0.3  # c as a share of b, about
_PRIOR_NOISE = 2.0  # grey levels of noise that the priors on bow and c are weighted against

#: Neighbours of pixels, px, between which noise is looked at.
_NEIGHBOURS = 4
#: Why a marker is not fitted; the index is what :func:`fit_marker` returns.
PROBLEMS = (
    None,
    "too small or too near the image border",
    "no convergence",
    "the pattern does not fit",
    "its corners are not where they were found",
)


@kernel
def _edge_near(grid: Array, x: float, y: float, near_x: float, near_y: float) -> bool:
    """Whether the cells about a point of a marker, so far along its axes, have two colours."""
    half = 0.5 * (len(grid) - 4)
    left, right = int((x - near_x + 1.0) * half + 2.0), int((x + near_x + 1.0) * half + 2.0)
    top, bottom = int((y - near_y + 1.0) * half + 2.0), int((y + near_y + 1.0) * half + 2.0)
    left, top = max(left, 0), max(top, 0)
    for j in range(top, min(bottom + 1, len(grid))):
        for i in range(left, min(right + 1, len(grid))):
            if grid[j, i] != grid[top, left]:
                return True
    return False


@kernel
def _gather(
    image: NDArray[np.uint8], corners: Array, inverse: Array, grid: Array, whole: bool, most: int, near: float, px: Array,
    at: Ids,
) -> int:  # fmt: skip
    """Collect up to ``most`` pixels of a marker and its margin, px (N, 8) as in ``_fill``; return their number.

    Those from which no edge of a cell is near, within ``near`` px, are thinned. corners (4, 2); inverse (3, 3)
    homography from the image to the marker, its scale positive before the horizon; ``whole``: pixels beyond the corners
    count; at (N, 2) receives columns and rows.
    """
    area, size_of = 0.0, np.array([image.shape[1], image.shape[0]])
    for k in range(4):
        i = (k + 1) % 4
        area += 0.5 * (corners[k, 0] * corners[i, 1] - corners[k, 1] * corners[i, 0])
    size = len(grid) - 4
    cell = np.sqrt(abs(area)) / size
    reach = 1.0 + 2.0 * min(max(1.0 - MARGIN_GAP_PX / max(cell, 1e-9), MARGIN_CELLS[0]), MARGIN_CELLS[1]) / size
    low, high, back = np.full(2, np.inf), np.full(2, -np.inf), solved(inverse, np.eye(3))
    for k in range(4):
        x, y = (reach if k in (1, 2) else -reach), (reach if k > 1 else -reach)
        w = back[2, 0] * x + back[2, 1] * y + back[2, 2]
        for m in range(2):
            end = (back[m, 0] * x + back[m, 1] * y + back[m, 2]) / w
            if not abs(end) < 1e6:
                return 0
            low[m], high[m] = min(low[m], end), max(high[m], end)
    for m in range(2):
        low[m], high[m] = max(np.floor(low[m]), 0.0), min(np.ceil(high[m]), size_of[m] - 1.0)
    n, share, due = 0, min(1.0, most / max(reach * reach * abs(area), 1.0)), 1.0
    for v in range(int(low[1]), int(high[1]) + 1):
        for u in range(int(low[0]), int(high[0]) + 1):
            w = inverse[2, 0] * u + inverse[2, 1] * v + inverse[2, 2]
            x = (inverse[0, 0] * u + inverse[0, 1] * v + inverse[0, 2]) / w
            y = (inverse[1, 0] * u + inverse[1, 1] * v + inverse[1, 2]) / w
            if not (w > 0.0 and abs(x) <= reach and abs(y) <= reach) or (not whole and abs(x) > 1.0 and abs(y) > 1.0):
                continue
            a, b = (inverse[0, 0] - x * inverse[2, 0]) / w, (inverse[0, 1] - x * inverse[2, 1]) / w
            c, d = (inverse[1, 0] - y * inverse[2, 0]) / w, (inverse[1, 1] - y * inverse[2, 1]) / w
            steep_x, steep_y = np.sqrt(a * a + b * b), np.sqrt(c * c + d * d)
            due += share if _edge_near(grid, x, y, near * steep_x, near * steep_y) else _FLAT * share
            if due < 1.0 or n == len(px):
                continue
            due -= 1.0
            px[n, 0], px[n, 1], px[n, 2], px[n, 3], px[n, 4] = image[v, u], x, y, 1.0 / steep_x, 1.0 / steep_y
            px[n, 5], px[n, 6] = max(abs(a), abs(b)) / steep_x, max(abs(c), abs(d)) / steep_y
            px[n, 7] = (a * c + b * d) / (steep_x * steep_y)
            at[n, 0], at[n, 1] = u, v
            n += 1
    return n


@kernel
def _corners(q: Array, H: Array, uv: Array, by_field: Array) -> None:
    """Fill the corners uv (4, 2) and their derivatives by_field (8, FIELD); H: marker to image."""
    for k in range(4):
        x, y = (1.0 if k in (1, 2) else -1.0), (1.0 if k > 1 else -1.0)
        s, t = x, y
        for _ in range(10):  # the point that the field maps onto the corner; the field is small, so this converges
            u, v = _displaced(q, s, t)
            s, t = s + x - u, t + y - v
        w = H[2, 0] * s + H[2, 1] * t + H[2, 2]
        for m in range(2):
            uv[k, m] = (H[m, 0] * s + H[m, 1] * t + H[m, 2]) / w
            a, b = (uv[k, m] * H[2, 0] - H[m, 0]) / w, (uv[k, m] * H[2, 1] - H[m, 1]) / w
            _by_field(s, t, a, b, by_field[2 * k + m])


@kernel(fastmath=True)
def _correlated(n: int, at: Ids, left: Array) -> float:
    """Return by how much the variance of a fit's result grows because the noise of neighbouring pixels is correlated.

    at (N, 2): columns and rows; left (N + 1, 4): one, the residuals, and derivatives of two results by grey levels. The
    mean over both, one at least; the autocovariance is that of the residuals, over up to four pixels.
    """
    x0, y0, x1, y1 = at[0, 0], at[0, 1], at[0, 0], at[n - 1, 1]
    for i in range(n):
        x0, x1 = min(x0, at[i, 0]), max(x1, at[i, 0])
    width = 2 * _NEIGHBOURS + 1
    index, sums = (
        np.full((y1 - y0 + 1 + _NEIGHBOURS, x1 - x0 + width), n, np.int32),
        np.zeros((_NEIGHBOURS + 1, width, 4)),
    )
    for i in range(n):
        index[at[i, 1] - y0, at[i, 0] - x0 + _NEIGHBOURS] = i
    for i in range(n):
        x, y, here = at[i, 0] - x0, at[i, 1] - y0, left[i]
        for dy in range(_NEIGHBOURS + 1):
            for dx in range(width):
                there = left[index[y + dy, x + dx]]
                for k in range(4):
                    sums[dy, dx, k] += here[k] * there[k]
    total, none = 0.0, sums[0, _NEIGHBOURS]
    for dy in range(_NEIGHBOURS + 1):
        for dx in range(width):
            s = sums[dy, dx]
            if (dy > 0 or dx >= _NEIGHBOURS) and s[0] > 0.0:  # the others are these mirrored
                rho = s[1] / s[0] / max(none[1] / none[0], 1e-12)
                total += (1.0 if dy == 0 and dx == _NEIGHBOURS else 2.0) * rho * 0.5 * (s[2] / none[2] + s[3] / none[3])
    return float(max(1.0, total))


@kernel
def _fit_from(
    image: NDArray[np.uint8], corners: Array, grid: Array, whole: bool, most: int, q: Array, px: Array, at: Ids, uv: Array,
    cov: Array,
) -> int:  # fmt: skip
    """Fit one marker's field over the homography of given corners, starting at parameters q; return the problem."""
    H, inverse = np.empty((3, 3)), np.empty((PARAMETERS, PARAMETERS))
    square_to_quad(corners, H)
    back = solved(H, np.eye(3))
    back /= back[2, 0] * corners[:, 0].mean() + back[2, 1] * corners[:, 1].mean() + back[2, 2]
    n = _gather(
        image, corners, back, grid, whole, most, _NEAR_SIGMAS * np.sqrt(q[FIELD] + 1.0 / 12.0) + _NEAR_PX, px, at
    )
    if n < 3 * PARAMETERS:
        return 1
    if q[FIELD + 1] == 0.0:
        levels = np.sort(px[:n, 0])
        low, high = levels[n // 20], levels[n - 1 - n // 20]
        q[FIELD + 1], q[FIELD + 3] = 0.5 * (high - low), 0.5 * (high + low)
    side = 0.0
    for k in range(4):
        side += 0.25 * np.hypot(corners[k, 0] - corners[k - 1, 0], corners[k, 1] - corners[k - 1, 1])
    prior, J = np.zeros((FIELD + 3, 2)), np.empty(((n + _BLOCK - 1) // _BLOCK, PARAMETERS + 1, _BLOCK))
    prior[8:FIELD, 1] = (_PRIOR_NOISE * 0.5 / (_BOW_PER_PX * side)) ** 2
    prior[FIELD, 0], prior[FIELD, 1] = BLUR2_PRIOR[0], BLUR2_PRIOR[1] ** -2.0
    prior[FIELD + 2, 1] = (_PRIOR_NOISE / (_BLEED_SHARE * max(q[FIELD + 1], 1.0))) ** 2
    if not _minimise(n, px, grid, prior, _STOP if most == PIXELS_LAST else _STOP_FIRST, q, J, inverse):
        return 2
    by_field, by_middle, left = np.empty((8, FIELD)), np.zeros((2, FIELD)), np.empty((n + 1, 4))
    _corners(q, H, uv, by_field)
    for k in range(8):
        by_middle[k % 2] += 0.25 * by_field[k]
    variance = _noise(n, inverse, by_middle, J, left)
    if not np.sqrt(variance) <= MISFIT_MAX * q[FIELD + 1]:
        return 3
    if most < PIXELS_LAST:
        return 0
    of_field = variance * inverse[:FIELD, :FIELD]
    all_corners, middle = (
        product(product(by_field, of_field), by_field.T),
        product(product(by_middle, of_field), by_middle.T),
    )
    # The corners of one fit have errors in common. Whoever takes them as independent finds the middle as it is then.
    total = 0.0
    for k in range(8):
        total += 0.25 * all_corners[k, k]
    wider = max(1.0, 4.0 * (middle[0, 0] + middle[1, 1]) / total) * _correlated(n, at, left)
    for k in range(4):
        for i in range(2):
            for j in range(2):
                cov[k, i, j] = wider * all_corners[2 * k + i, 2 * k + j]
    return 0


@kernel("const u1[:, ::1], const f8[:, ::1], const f8[:, ::1], b1, f8[:, ::1], f8[:, :, ::1]")
def fit_marker(image: NDArray[np.uint8], corners: Array, grid: Array, whole: bool, uv: Array, cov: Array) -> int:
    """Fit one marker.

    Args:
        image: (H, W) grey.
        corners: (4, 2) rough corners, px.
        grid: (N + 4, N + 4) its cells as -1 and 1, and two rings around.
        whole: whether the colour beyond the corners is known.
        uv: (4, 2) filled with the corners.
        cov: (4, 2, 2) filled with their covariances, px^2.

    Returns:
        An index into PROBLEMS.
    """
    px, at, here = np.empty((PIXELS_LAST, 8)), np.empty((PIXELS_LAST, 2), np.int64), corners.copy()
    cell = 0.0
    for k in range(4):
        cell += 0.25 * np.hypot(corners[k, 0] - corners[k - 1, 0], corners[k, 1] - corners[k - 1, 1]) / (len(grid) - 4)
    q, pixels = np.zeros(PARAMETERS), PIXELS_FIRST
    q[FIELD] = max(1.0, START_BLUR_CELLS * cell) ** 2
    for _ in range(_ROUNDS):
        problem = _fit_from(image, here, grid, whole, pixels, q, px, at, uv, cov)
        if problem != 0:
            return problem
        off, moved = 0.0, 0.0
        for k in range(4):
            off = max(off, np.hypot(uv[k, 0] - corners[k, 0], uv[k, 1] - corners[k, 1]))
            moved = max(moved, np.hypot(uv[k, 0] - here[k, 0], uv[k, 1] - here[k, 1]))
        if not off <= max(MOVED_MAX_CELLS * cell, 1.0):
            return 4
        if moved < max(SETTLED_CELLS * cell, SETTLED_PX) and pixels == PIXELS_LAST:
            return 0
        here[:], q[:8], pixels = uv, 0.0, PIXELS_LAST  # the homography takes over what is affine or perspective
    return 2


@dataclass(frozen=True, eq=False)
class SquareFit(Record):
    """Fitted corners uv (4, 2), raw pixels, cov_uv (4, 2, 2), px^2, of one marker, or the problem: why not to use them."""

    uv: Array
    cov_uv: Array
    problem: str | None


def fit_square(
    image: NDArray[np.uint8], corners: Array, cells: NDArray[np.int8], diagonal: int | None = None
) -> SquareFit:
    """Fit one marker from rough corners (4, 2), raw px: upper left, upper right, lower right, lower left of its cells.

    cells (N, N): 1 bright, -1 dark, the border included; ``diagonal``: the colour beyond the corners, ignored if None.
    """
    grid = np.pad(cells.astype(np.float64), 2, constant_values=1.0)
    grid[np.ix_((0, 1, -2, -1), (0, 1, -2, -1))] = 1.0 if diagonal is None else diagonal
    uv, cov, rough = np.zeros((4, 2)), np.zeros((4, 2, 2)), np.ascontiguousarray(corners, np.float64)
    problem = fit_marker(np.ascontiguousarray(image), rough, grid, diagonal is not None, uv, cov)
    return SquareFit(uv, cov, PROBLEMS[problem])
