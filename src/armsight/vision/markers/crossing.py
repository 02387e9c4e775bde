"""The compiled image model of two crossing edges and its fit; the model is defined in ``corner.py``.

Pixels near an edge are evaluated one by one, in single precision and without branches so that they fill the processor's
vectors (SIMD): grey levels have eight bits, single precision has 24. Pixels further off lie on a plain square, M is 1
or -1 there, and all their information about the light is in their moments: they cost nothing however many they are.
Last come the noise at the edges, from the residuals, and the covariance of the corner's position.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array
from armsight.geometry.matrix import dot
from armsight.kernels import kernel
from armsight.vision.normal import SIMD_WIDTH, decay_single, edge_single, factor, products, solve

Work = NDArray[np.float32]

PARAMETERS = 10  # c (2), edge angles (2), squared blurs (2), a, b, k (2)
#: Length of a row of the work space: the most pixels a window has near its edges, and some to fill the last SIMD
#: vector.
ROOM = 1424
#: Rows of the work space: x, y, grey, the derivatives by the parameters, the residual, one to fill the last tile.
Y, GREY, JACOBIAN, RESIDUAL = ROOM, 2 * ROOM, 3 * ROOM, (3 + PARAMETERS) * ROOM
WORK = (5 + PARAMETERS) * ROOM
#: Moments of the pixels of plain squares of one colour: n, x, y, xx, xy, yy, I, Ix, Iy, II.
MOMENTS = 10
_STEPS = 25
#: Neighbours up to so many pixels away have correlated noise; pixels of a window are at most so far from its origin.
LAGS, REACH = 3, 20
_LAMBDA = 1e-3
BLUR2_MIN = 0.03  # px^2; below it a pixel's width hides the blur, and the cost gets kinks
#: Weak prior on a squared blur, mean and sigma, px^2, as strong as one pixel with a noise of one grey level. It acts
#: only on what the pixels do not determine: the blur of an edge that falls between two pixels.
BLUR2_PRIOR = (0.25, 0.25)

#: Lever arm by which the rotation of an edge is converted to a shift, px.
_ARM_PX = 10.0

_f = np.float32
_ZERO, _HALF, _ONE, _TWO = _f(0.0), _f(0.5), _f(1.0), _f(2.0)
_TWO_OVER_PI, _THIRD = _f(2.0 / np.pi), _f(1.0 / 3.0)


@kernel("i8, f4[::1], f8, f8, f8[::1], f8[:, ::1], f8[:, ::1]", fastmath=True)
def evaluate(n: int, w: Work, x0: float, y0: float, q: Array, sides: Array, bow: Array) -> None:
    """Fill residuals and derivatives of the n pixels in the work space w at parameters q.

    The pixels' x and y are counted from x0, y0.
    """
    # Everything constant is a local: what is read from an array in the loop is read again for every pixel.
    cx, cy, middle, half, kx, ky = _f(q[0] - x0), _f(q[1] - y0), _f(q[6]), _f(q[7]), _f(q[8]), _f(q[9])
    n1x, n1y, n2x, n2y = _f(np.cos(q[2])), _f(np.sin(q[2])), _f(np.cos(q[3])), _f(np.sin(q[3]))
    s1x, s1y, s2x, s2y = _f(sides[0, 0]), _f(sides[0, 1]), _f(sides[1, 0]), _f(sides[1, 1])
    b1x, b1y, b2x, b2y = _f(bow[0, 0]), _f(bow[0, 1]), _f(bow[1, 0]), _f(bow[1, 1])
    # A pixel's shadows across each edge, from the edges' first directions: constants of the fit.
    width1, width2 = max(abs(s1x), abs(s1y)), max(abs(s2x), abs(s2y))
    blur1 = _f(np.sqrt(q[4] + (1.0 - width1 * width1) / 12.0))
    blur2 = _f(np.sqrt(q[5] + (1.0 - width2 * width2) / 12.0))
    per_s1, per_s2, two_s1, two_s2 = _ONE / blur1, _ONE / blur2, _TWO * blur1, _TWO * blur2
    half_w1, half_w2, per_w1, per_w2 = _HALF * width1, _HALF * width2, _ONE / width1, _ONE / width2
    half_per_s1, half_per_s2 = _HALF * per_s1, _HALF * per_s2
    rho, drho = _f(np.cos(q[2] - q[3])), _f(np.sin(q[3] - q[2]))
    rho2, rho3 = _HALF * rho * rho, rho * rho * rho * _HALF * _THIRD
    k1, k2 = _f(1.0 / np.sqrt(q[4] + 1.0 / 12.0)), _f(1.0 / np.sqrt(q[5] + 1.0 / 12.0))
    bow1 = _TWO * (n1x * b1x + n1y * b1y)
    bow2 = _TWO * (n2x * b2x + n2y * b2y)
    for i in range(n):
        dx, dy = w[i] - cx, w[Y + i] - cy
        t1 = dx * s1x + dy * s1y
        t2 = dx * s2x + dy * s2y
        x1, y1 = dx - b1x * t1 * t1, dy - b1y * t1 * t1
        x2, y2 = dx - b2x * t2 * t2, dy - b2y * t2 * t2
        u1, u2 = n1x * x1 + n1y * y1, n2x * x2 + n2y * y2
        e1, d1, f1 = edge_single(u1, per_s1, two_s1, half_w1, per_w1)
        e2, d2, f2 = edge_single(u2, per_s2, two_s2, half_w2, per_w2)
        light = _ONE + kx * dx + ky * dy
        scale = half * light
        z1, z2 = u1 * k1, u2 * k2
        w1, w2 = z1 * z1 - _ONE, z2 * z2 - _ONE
        ff = _TWO_OVER_PI * decay_single(_HALF * (z1 * z1 + z2 * z2))
        series = rho + rho2 * z1 * z2 + rho3 * w1 * w2
        M = e1 * e2 + ff * series
        c1 = ff * k1 * (rho2 * z2 + _TWO * rho3 * z1 * w2 - z1 * series)
        c2 = ff * k2 * (rho2 * z1 + _TWO * rho3 * z2 * w1 - z2 * series)
        g1, g2 = scale * (d1 * e2 + c1), scale * (d2 * e1 + c2)
        h = ff * (_ONE + rho * z1 * z2 + rho2 * w1 * w2) * drho * scale
        level = middle + half * M
        w[RESIDUAL + i] = w[GREY + i] - light * level
        w[JACOBIAN + i] = -g1 * (n1x - bow1 * t1 * s1x) - g2 * (n2x - bow2 * t2 * s2x) - kx * level
        w[JACOBIAN + ROOM + i] = -g1 * (n1y - bow1 * t1 * s1y) - g2 * (n2y - bow2 * t2 * s2y) - ky * level
        w[JACOBIAN + 2 * ROOM + i] = g1 * (n1x * y1 - n1y * x1) + h
        w[JACOBIAN + 3 * ROOM + i] = g2 * (n2x * y2 - n2y * x2) - h
        w[JACOBIAN + 4 * ROOM + i] = scale * (half_per_s1 * f1 * e2 - _HALF * c1 * z1 * k1)
        w[JACOBIAN + 5 * ROOM + i] = scale * (half_per_s2 * f2 * e1 - _HALF * c2 * z2 * k2)
        w[JACOBIAN + 6 * ROOM + i] = light
        w[JACOBIAN + 7 * ROOM + i] = light * M
        w[JACOBIAN + 8 * ROOM + i] = level * dx
        w[JACOBIAN + 9 * ROOM + i] = level * dy


@kernel
def rows(w: Work) -> Work:
    """Return (12, ROOM) derivatives, residuals and an empty row of the work space."""
    return w[JACOBIAN:].reshape(PARAMETERS + 2, ROOM)


@kernel(fastmath=True)
def _add_plain(flat: Array, x0: float, y0: float, q: Array, H: Array) -> None:
    """Add the plain squares to H: there the image is linear in x and y, so moments are sufficient."""
    cx, cy, kx, ky, B = q[0] - x0, q[1] - y0, q[8], q[9], np.zeros((PARAMETERS, 3))
    light = 1.0 - kx * cx - ky * cy  # where x and y are zero
    for k in range(2):
        count, x, y, xx, xy, yy, grey, grey_x, grey_y, grey_grey = flat[k]
        sign = 1.0 - 2.0 * k
        level = q[6] + sign * q[7]
        B[0, 0], B[1, 0] = -kx * level, -ky * level
        B[6, 0], B[6, 1], B[6, 2] = light, kx, ky
        B[7, 0], B[7, 1], B[7, 2] = sign * light, sign * kx, sign * ky
        B[8, 0], B[8, 1], B[9, 0], B[9, 2] = -cx * level, level, -cy * level, level
        sum0, sum1, sum2 = count * light + x * kx + y * ky, x * light + xx * kx + xy * ky, y * light + xy * kx + yy * ky
        H[PARAMETERS, PARAMETERS] += grey_grey - 2.0 * level * (light * grey + kx * grey_x + ky * grey_y)
        H[PARAMETERS, PARAMETERS] += level * level * (light * sum0 + kx * sum1 + ky * sum2)
        g0, g1, g2 = grey - level * sum0, grey_x - level * sum1, grey_y - level * sum2
        for i in (0, 1, 6, 7, 8, 9):
            v0 = B[i, 0] * count + B[i, 1] * x + B[i, 2] * y
            v1 = B[i, 0] * x + B[i, 1] * xx + B[i, 2] * xy
            v2 = B[i, 0] * y + B[i, 1] * xy + B[i, 2] * yy
            H[PARAMETERS, i] += B[i, 0] * g0 + B[i, 1] * g1 + B[i, 2] * g2
            for j in (0, 1, 6, 7, 8, 9):
                if j <= i:
                    H[i, j] += v0 * B[j, 0] + v1 * B[j, 1] + v2 * B[j, 2]


@kernel("i8, f4[::1], f8[:, ::1], f8, f8, f8[::1], f8[:, ::1], f8[:, ::1], f8[:, ::1]")
def _assemble(
    n: int, w: Work, flat: Array, x0: float, y0: float, q: Array, sides: Array, bow: Array, H: Array
) -> float:
    """Fill the normal equations at q: H (12, 12), lower half, row 10 the gradient; return the cost."""
    full = (n + SIMD_WIDTH - 1) // SIMD_WIDTH * SIMD_WIDTH
    evaluate(full, w, x0, y0, q, sides, bow)
    for i in range(PARAMETERS + 1):
        for m in range(JACOBIAN + i * ROOM + n, JACOBIAN + i * ROOM + full):
            w[m] = _ZERO
    products(full, rows(w), H)
    _add_plain(flat, x0, y0, q, H)
    mean, weight = BLUR2_PRIOR[0], 1.0 / BLUR2_PRIOR[1] ** 2
    cost = H[PARAMETERS, PARAMETERS]
    for i in (4, 5):
        H[i, i] += weight
        H[PARAMETERS, i] += weight * (mean - q[i])
        cost += weight * (mean - q[i]) ** 2
        if q[i] < 1.001 * BLUR2_MIN and H[PARAMETERS, i] < 0.0:  # at its bound: held there for this step
            H[i, i] *= 1e9
            H[PARAMETERS, i] = 0.0
    return float(cost)


@kernel
def first_guess(
    n: int, w: Work, flat: Array, x0: float, y0: float, c: Array, square: Array, blur: float, q: Array
) -> None:
    """Set the parameters from the squares' shape and the mean grey of opposite quadrants."""
    q[:] = 0.0
    q[0], q[1], q[4], q[5] = c[0], c[1], blur * blur, blur * blur
    hand = 1.0 if square[0, 0] * square[1, 1] - square[0, 1] * square[1, 0] > 0 else -1.0
    q[2] = np.arctan2(hand * square[0, 0], -hand * square[0, 1])  # the normal of side 0 points to side 1
    q[3] = np.arctan2(-hand * square[1, 0], hand * square[1, 1])  # and the other way round
    n1x, n1y, n2x, n2y = np.cos(q[2]), np.sin(q[2]), np.cos(q[3]), np.sin(q[3])
    cx, cy = c[0] - x0, c[1] - y0
    count, total, signed = flat[0, 0] + flat[1, 0] + n, flat[0, 6] + flat[1, 6], flat[0, 6] - flat[1, 6]
    for i in range(n):
        dx, dy, grey = w[i] - cx, w[Y + i] - cy, w[GREY + i]
        total += grey
        signed += grey if (n1x * dx + n1y * dy) * (n2x * dx + n2y * dy) > 0 else -grey
    q[6], q[7] = total / count, signed / count


@kernel
def _slight(x: Array, q: Array, share: float) -> bool:
    """Whether a step x from q moves and blurs the edges so little that the residuals change linearly."""
    blur2 = min(q[4], q[5]) + 1.0 / 12.0
    moved = abs(x[0]) + abs(x[1]) + _ARM_PX * max(abs(x[2]), abs(x[3]))
    return bool(moved < share * np.sqrt(blur2) and max(abs(x[4]), abs(x[5])) < share * blur2)


@kernel(fastmath=True)
def _carry(n: int, w: Work, x: Array) -> None:
    """Update the residuals for a step x, linearly."""
    left = w[RESIDUAL : RESIDUAL + n]
    for i in range(PARAMETERS):
        share, o = _f(x[i]), JACOBIAN + i * ROOM
        row = w[o : o + n]
        for m in range(n):
            left[m] -= share * row[m]


@kernel
def fit_crossing(
    n: int, w: Work, flat: Array, x0: float, y0: float, q: Array, sides: Array, bow: Array, L: Array, stop: float,
    slight: float,
) -> bool:  # fmt: skip
    """Minimise from q by Levenberg-Marquardt; the work space and L are left at the solution. False if it does not settle.

    Args:
        n: number of pixels near the edges.
        w: (WORK,) work space; x, y from x0, y0 and grey of those pixels in its first rows.
        flat: (2, MOMENTS) moments of the pixels of plain squares, those where M is 1 and where it is -1.
        x0: origin of x, px.
        y0: origin of y, px.
        q: (PARAMETERS,) start, and solution.
        sides: (2, 2) unit vectors along the edges.
        bow: (2, 2) the bow of each edge, 1/px.
        L: (PARAMETERS, PARAMETERS) receives the Cholesky factor of the information, from ``normal.factor``.
        stop: a step is the last when it lowers the cost by less than this share of one pixel's noise,
        slight: or when it moves the edges and their blur by less than this share of the blur: the next would be that
            share of it.
    """
    H, T = np.empty((PARAMETERS + 2, PARAMETERS + 2)), np.empty((PARAMETERS + 2, PARAMETERS + 2))
    x, trial = np.empty(PARAMETERS), np.empty(PARAMETERS)
    pixels = n + flat[0, 0] + flat[1, 0]
    cost, damping, current = _assemble(n, w, flat, x0, y0, q, sides, bow, H), _LAMBDA, True
    for _ in range(_STEPS):
        if not factor(H, damping, L):
            return False
        g = H[PARAMETERS, :PARAMETERS]
        solve(L, g, x)
        trial[:] = q + x
        trial[4], trial[5] = max(trial[4], BLUR2_MIN), max(trial[5], BLUR2_MIN)
        gain = dot(x, g)  # how much lower the cost should get, or a little more
        x[:] = trial - q
        done = damping <= 1.0 and (gain < stop * cost / pixels or _slight(x, q, slight))
        if done and current:  # derivatives stay what they are
            q[:] = trial
            _carry(n, w, x)
            return factor(H, 0.0, L)
        new = _assemble(n, w, flat, x0, y0, trial, sides, bow, T)
        done |= max(gain, abs(new - cost)) < stop * cost / pixels
        if new > cost and not done:
            damping, current = max(damping * 10.0, 1e-4), False
            if damping > 1e8:
                return False
            continue
        if cost - new > 0.5 * gain:
            damping = max(damping * 0.1, 1e-9)
        elif cost - new < 0.2 * gain:  # the step went over a kink: sharp edges between two pixels have them
            damping = max(damping * 3.0, 1e-2)
        q[:], H[:], cost, current = trial, T, new, True
        if done:
            return factor(H, 0.0, L)
    return False


@kernel(fastmath=True)
def rough_noise(n: int, w: Work) -> float:
    """Return the variance of the residuals of the n pixels near the edges."""
    r, power = w[RESIDUAL : RESIDUAL + n], np.float32(0.0)
    for m in range(n):
        power += r[m] * r[m]
    return float(power / (n - PARAMETERS))


@kernel(fastmath=True)
def edge_noise(n: int, w: Work, L: Array, middle: Array, cov: Array, noise: Array, gain: Array) -> float:
    """Return the variance of the residuals and fill cov (2, 2), the covariance of the corner; derivatives are overwritten.

    The noise is that of the pixels that determine the corner, as in ``square.py``. Leverage is the squared
    length of L^-1 times a pixel's derivatives, so its weighted sum needs only the weighted products of the derivatives.

    An X corner has a point symmetry: what a camera's processing does to both sides alike (the halo of sharpening, a tone
    curve) is even under reflection in the corner and cannot move it, for the derivatives by its position are odd. The noise
    that moves it is the odd part of the residuals, (r(d) - r(-d)) / 2, which has half of white noise's variance.

    Args:
        n: number of pixels near the edges.
        w: their columns, rows, grey levels, derivatives and residuals.
        L: (PARAMETERS, PARAMETERS) Cholesky factor of the normal equations.
        middle: (2,) the corner, as the pixels relative to the window's origin.
        cov: (2, 2) receives the covariance for white noise of the residuals' variance.
        noise: (3, LAGS + 1, 2 LAGS + 1) to whose first part the weighted products of odd residuals at lags (row, column)
            are added, to the second the weights, to the third the products that white noise of unit variance leaves
            after the fit.
        gain: (LAGS + 1, 2 LAGS + 1) receives the autocorrelation of the corner's derivatives by grey levels, 1 at lag 0.
    """
    H, inverse = np.empty((PARAMETERS + 2, PARAMETERS + 2)), np.zeros((PARAMETERS, PARAMETERS))
    for j in range(PARAMETERS):
        inverse[j, j] = L[j, j]
        for i in range(j + 1, PARAMETERS):
            s = 0.0
            for m in range(j, i):
                s -= L[i, m] * inverse[m, j]
            inverse[i, j] = s * L[i, i]
    A = np.zeros((PARAMETERS, PARAMETERS))
    for i in range(PARAMETERS):
        for j in range(PARAMETERS):
            for m in range(max(i, j), PARAMETERS):
                A[i, j] += inverse[m, i] * inverse[m, j]
    _odd_noise(n, w, A, middle, noise, gain)
    n = (n + SIMD_WIDTH - 1) // SIMD_WIDTH * SIMD_WIDTH  # derivatives and residuals are zero to the end of a vector
    jx, jy, root = w[JACOBIAN : JACOBIAN + n], w[JACOBIAN + ROOM : JACOBIAN + ROOM + n], w[:n]
    weight = np.float32(0.0)
    for m in range(n):
        v = jx[m] * jx[m] + jy[m] * jy[m]
        weight += v
        root[m] = np.sqrt(v)  # overwrites the columns, which are no longer needed
    for i in range(PARAMETERS + 1):
        o = JACOBIAN + i * ROOM
        row = w[o : o + n]
        for m in range(n):
            row[m] *= root[m]
    products(n, rows(w), H)
    leverage = 0.0
    for i in range(PARAMETERS):
        for j in range(i + 1):
            leverage += (2.0 if j < i else 1.0) * A[i, j] * H[i, j]
    variance = max(H[PARAMETERS, PARAMETERS] / (float(weight) - leverage), 1.0 / 12.0)
    for i in range(2):
        for j in range(2):
            cov[i, j] = variance * A[i, j]
    return float(variance)


@kernel(fastmath=True)
def _odd_noise(n: int, w: Work, A: Array, middle: Array, noise: Array, gain: Array) -> None:
    """Add to ``noise`` and fill ``gain`` as in :func:`edge_noise`; A (PARAMETERS, PARAMETERS) inverts the normal matrix.

    A pixel's partner is the one nearest to its reflection. With S the projection on odd fields and P that on the
    derivatives by the odd parameters (position and gradient), the odd residuals of white noise have covariance S - P.
    """
    at = np.full((2 * REACH + 1, 2 * REACH + 1), -1, np.int64)
    for i in range(n):
        x, y = int(w[i]) + REACH, int(w[Y + i]) + REACH
        if 0 <= x <= 2 * REACH and 0 <= y <= 2 * REACH:
            at[y, x] = i
    x2, y2 = int(np.rint(2.0 * middle[0])), int(np.rint(2.0 * middle[1]))
    odd, root, g, partner = np.zeros(n), np.zeros(n), np.zeros((4, n)), np.full(n, -1, np.int64)
    for i in range(n):
        for a in range(4):
            for m in range(PARAMETERS):
                g[a, i] += A[a if a < 2 else PARAMETERS - 4 + a, m] * w[JACOBIAN + m * ROOM + i]
        x, y = x2 - int(w[i]) + REACH, y2 - int(w[Y + i]) + REACH
        if not (0 <= x <= 2 * REACH and 0 <= y <= 2 * REACH) or at[y, x] < 0:
            continue
        partner[i] = at[y, x]
        odd[i] = 0.5 * (w[RESIDUAL + i] - w[RESIDUAL + at[y, x]])
        root[i] = np.sqrt(w[JACOBIAN + i] ** 2 + w[JACOBIAN + ROOM + i] ** 2)
    for dy in range(LAGS + 1):
        for dx in range(-LAGS, LAGS + 1):
            found, weights, white, gains = 0.0, 0.0, 0.0, 0.0
            for i in range(n):
                x, y = int(w[i]) + REACH + dx, int(w[Y + i]) + REACH + dy
                if not (0 <= x <= 2 * REACH and 0 <= y <= 2 * REACH):
                    continue
                j = at[y, x]
                if j < 0:
                    continue
                gains += g[0, i] * g[0, j] + g[1, i] * g[1, j]
                both = root[i] * root[j]
                expected = 0.5 * (i == j) - 0.5 * (j == partner[i])
                for a in range(4):
                    expected -= w[JACOBIAN + (a if a < 2 else PARAMETERS - 4 + a) * ROOM + i] * g[a, j]
                found += both * odd[i] * odd[j]
                weights += both
                white += both * expected
            noise[0, dy, LAGS + dx] += found
            noise[1, dy, LAGS + dx] += weights
            noise[2, dy, LAGS + dx] += white
            gain[dy, LAGS + dx] = gains
    gain /= max(gain[0, LAGS], 1e-300)
