"""What the discs of one image have in common, and what only they show together: correlated noise and vignetting.

In: what each disc's fit shows (``fit.FitBuffers.shown``). Out: corrected centres and their covariances.

Noise that is correlated between neighbouring pixels, and what processing makes of a rim as it lies on the grid, move the
first harmonic of a rim, the centre, as they move the higher odd ones, which no ellipse has: their power, over all discs of
about the same contrast, is the noise that the centres have.

A lens darkens its image with the square of the distance from the middle (cos^4, and vignetting): at x the light has the
relative gradient a (x - m), in 1/px, with m the image's middle. A disc that is fitted as flat is off by up to 0.01 px then,
and all discs of a body alike, so that it does not average out. No single disc shows the gradient; all together determine
the one unknown, a. Behind a tone curve a is another one, and the same for discs of one level. An error of a moves the
centres in proportion to their distance from the middle, as coma does: it is what they share, not each one's noise.

A fit estimates a gradient of the surround, which noise moves as well, and the centre with it. Where the gradients of an
image's discs are no larger than noise makes them, surrounds are level, and centres are those of fits without a gradient;
where they are larger, that share of the way (empirical Bayes: a normal distribution of gradients about none).

A disc whose gradient, or whose surround's, is significant beyond that, measured by the noise of the image, is fitted with
other kinds of gradient, too; they are averaged by their likelihood (model averaging). In processed images noise makes
slopes in a hundredth of the discs that white noise would not make, and a correction moves these centres away from the
truth: there, only what chance makes in a thousandth is significant.

An edge that is steeper on one side moves its disc under blur or sharpening. A shaken exposure and a lens off its axis do so
to all discs of an image alike, coma in proportion to the distance from the middle (Seidel): c + k x at pixel x. No fit of a
pose or a calibration sees such a field, which is another principal point and another focal length: it stands apart from the
discs' own covariances, and these have what a disc deviates from it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array
from armsight.estimate.chance import chi_square_limit
from armsight.geometry.matrix import solved_vector
from armsight.kernels import kernel
from armsight.vision.markers.disc.fit import (
    GLARE,
    HARMONICS,
    LEVELLED,
    LIGHT,
    PARAMETERS,
    SKEWED,
    SURROUND,
    UNKNOWNS,
    FitBuffers,
    clipped,
    gather,
    minimise,
    of_centre,
)

#: From so many discs on, vignetting and a common skew are estimated.
_LEAST_DISCS = 3
#: Contrasts of discs whose rims have the same noise, one over the other: what processing makes of a rim grows with it.
_ALIKE = 1.6
#: A power of six degrees of freedom that chance exceeds in 0.3 %, over its mean; and the most that one disc counts.
_RIM_CHANCE = chi_square_limit(2 * HARMONICS, 0.003) / (2 * HARMONICS)
#: By how much the first harmonic of the noise exceeds the later ones, as a share of what is not white: what lies along rows
#: and columns of pixels moves a long piece of the rim at once. Found with the simulated cameras.
_FIRST = 0.4
#: Degrees of freedom with which noise is taken to be white before any rim is seen.
_WHITE = 4.0
#: Vignetting as it is to be expected: standard deviation of the light that is missing in the corners.
_VIGNETTING = 0.3
#: Chi-square of two degrees from which a disc or its surround may have a gradient in white noise: chance exceeds it in 1%
#: and 10%; factor of the noise from which it is not white.
_SLOPE_INSIDE, _SLOPE_OUTSIDE, _PROCESSED = chi_square_limit(2, 0.01), chi_square_limit(2, 0.1), 1.5
#: The same in noise that is not white, and of a skewed edge: chance exceeds it in 0.1%; one that half of them exceed.
_SLOPE, _HALF = chi_square_limit(2, 0.001), chi_square_limit(2, 0.5)
#: The same of three degrees; mean weight of a spatial median in a plane times its variance; rounds until it has converged.
_FIELD, _MEDIAN, _ROUNDS = chi_square_limit(3, 0.001), 0.8, 12
#: Degrees of freedom of Student's t of slopes that are not vignetting's.
_TAIL = 4.0
#: Coma as it is to be expected: standard deviation of the shift in the corners, px.
_COMA = 0.2
#: What the discs of an image have in common, and where in it the shifts are that may have moved all of them: a field
#: c + k x of skewed edges, and one of vignetting. See :func:`common`.
LEVEL, FIELDS = range(3, 5)
VIGNETTING, SHARED = range(FIELDS + 3, FIELDS + 9, 3)
#: How likely each kind of gradient is where there is one (LIGHT, SURROUND, GLARE).
_KINDS = (0.6, 0.3, 0.1)


@kernel
def _rim_noise(n: int, discs: Array) -> None:
    """Estimate the noise along the rims of the first n discs, from all that have about the same contrast.

    Their first column, the power of a disc's rim, is replaced by its ratio to what the others show (white noise at least),
    the third by the factor of the variance of its centre over that of white noise. The power has 2 HARMONICS degrees of
    freedom for each disc; the factor contains by how much the mean inverse of so few exceeds the inverse of their mean.
    What exceeds white noise moves the rim, and the centre as the rim moves: the other unknowns, which enlarge what white
    noise does, have no part in that. It is never below that of white noise: errors of the model move centres, too.
    """
    order, first = np.argsort(-np.abs(discs[:n, PARAMETERS + 6])), 0
    while first < n:
        end = first
        least = abs(discs[order[first], PARAMETERS + 6]) / _ALIKE
        while end < n and abs(discs[order[end], PARAMETERS + 6]) >= least:
            end += 1
        alike = order[first:end]
        most, total = _RIM_CHANCE * np.median(discs[alike, 0]), 0.0
        for i in alike:
            total += min(discs[i, 0], most)
        power = max(total / (end - first), 1e-12)
        measured = 2.0 * HARMONICS * (end - first)
        freedom = measured + _WHITE
        for i in alike:
            discs[i, 0] /= max(power, 1.0 / discs[i, 2])
            factor = (_WHITE + measured * power * discs[i, 2]) / (freedom - 2.0)
            discs[i, 2] = 1.0 + (1.0 + _FIRST) * max(factor - 1.0, 0.0) / discs[i, 13]
        first = end


@kernel
def common(image: NDArray[np.uint8], n: int, work: FitBuffers, shared: Array) -> None:
    """Fill what the first n discs of ``work.discs`` have in common.

    ``image``: (H, W) grey. ``n``: number of discs. ``work``: what they show; power and its third column become ratios, see
    :func:`_rim_noise`. ``shared``: (SHARED,) filled: mean square of the deviations of the rims' sectors beyond white noise,
    px^2; the vignetting a and its standard deviation, 1/px^2; at LEVEL how level surrounds are, the share of their
    gradients that is noise, as half of them show it; from FIELDS on c (2), px, and k of the shift c + k x that skewed edges
    make together at a pixel x, one standard deviation; from VIGNETTING on the same of an error of a, for discs of about the
    same size. Medians, so that a few discs that are none do not count.
    """
    discs = work.discs
    shared[:] = 0.0
    _rim_noise(n, discs)
    if n < _LEAST_DISCS:
        return
    shared[0] = max(np.median(discs[:n, 1]), 0.0)
    _common_skew(image, n, discs, shared[FIELDS:VIGNETTING])
    square = np.empty(n)
    for i in range(n):
        square[i] = discs[i, LEVELLED] / _factor(discs[i])
    shared[LEVEL] = min(_HALF / max(np.median(square), _HALF), 1.0)
    shared[1], shared[2] = _vignetting(image, n, discs)
    shared[VIGNETTING + 2] = shared[2] * 0.5 * (np.median(discs[:n, 8]) + np.median(discs[:n, 11]))
    for axis in range(2):
        shared[VIGNETTING + axis] = -shared[VIGNETTING + 2] * 0.5 * (image.shape[1 - axis] - 1)


@kernel
def _vignetting(image: NDArray[np.uint8], n: int, discs: Array) -> tuple[float, float]:
    """Return the vignetting a that the first n discs show together, and its standard deviation, 1/px^2.

    What in the background is taken for a disc slopes by itself, and a large one shows it well. Student's t, of which the
    slopes beyond a (x - m) are samples, lets it count little (iterated least squares, from no vignetting on).
    """
    expected = 8.0 * _VIGNETTING / (image.shape[0] ** 2 + image.shape[1] ** 2)
    a, information = 0.0, 0.0
    for _ in range(_ROUNDS):
        information, sum_ = 1.0 / (expected * expected), 0.0
        for i in range(n):
            u, v, k = _from_middle(image, discs[i], 0), _from_middle(image, discs[i], 1), discs[i, 5:8] / discs[i, 2]
            p, q = discs[i, 3] - a * u, discs[i, 4] - a * v
            square = k[0] * p * p + 2 * k[1] * p * q + k[2] * q * q
            w = min((_TAIL + 2.0) / (_TAIL + square), 1.0)
            information += w * (k[0] * u * u + 2 * k[1] * u * v + k[2] * v * v)
            sum_ += w * (u * (k[0] * discs[i, 3] + k[1] * discs[i, 4]) + v * (k[1] * discs[i, 3] + k[2] * discs[i, 4]))
        a = sum_ / information
    return float(a), float(1.0 / np.sqrt(information))


@kernel
def _common_skew(image: NDArray[np.uint8], n: int, discs: Array, field: Array) -> None:
    """Fill by how much skewed edges move the first n discs together, field (3,) as in :func:`common`.

    The field is the one with the least sum of distances, each in the noise of its disc (a spatial median, by weighted least
    squares), less what chance makes of it. Faint discs, and what in the background is none, have more noise or lie far off
    it: they count little, also for its significance.
    """
    H, g, noise = np.empty((3, 3)), np.empty(3), np.empty(n)
    for i in range(n):
        noise[i] = max(discs[i, 2] * _skew_variance(discs[i]), 1e-12)
    expected = 2.0 * _COMA / np.sqrt(float(image.shape[0] ** 2 + image.shape[1] ** 2))
    middle = np.array([0.5 * (image.shape[1] - 1), 0.5 * (image.shape[0] - 1)])
    for _ in range(_ROUNDS):
        H[:, :], g[:] = 0.0, 0.0
        H[2, 2] = 1.0 / (expected * expected)
        for i in range(n):
            x, s = discs[i, PARAMETERS : PARAMETERS + 2] - middle, discs[i, SKEWED : SKEWED + 2]
            d = s - field[:2] - field[2] * x
            w = 1.0 / np.sqrt(noise[i] * (d[0] * d[0] + d[1] * d[1] + noise[i]))
            for j in range(2):
                H[j, j] += w
                H[j, 2] += w * x[j]
                H[2, j] += w * x[j]
                H[2, 2] += w * x[j] * x[j]
                g[j] += w * s[j]
                g[2] += w * x[j] * s[j]
        field[:] = solved_vector(H, g)
    square = (field[0] * g[0] + field[1] * g[1] + field[2] * g[2]) / _MEDIAN
    field[:2] -= field[2] * middle
    field *= np.sqrt(max(1.0 - _FIELD / max(square, 1e-300), 0.0))


@kernel
def _factor(disc: Array) -> float:
    """Return by how much the variances of what a disc's fit found exceed those that it says."""
    return float(
        disc[2] if disc[12] == 0.0 else max(disc[2] / disc[12], 1.0)
    )  # the power contains a texture's correlation


@kernel
def _skew_variance(disc: Array) -> float:
    """Return the variance, along itself, of a disc's shift by a skewed edge, px^2, in white noise."""
    return float((disc[SKEWED] ** 2 + disc[SKEWED + 1] ** 2) / max(disc[SKEWED + 2], 1e-12))


@kernel
def _from_middle(image: NDArray[np.uint8], disc: Array, axis: int) -> float:
    """Return how far right of the image's middle (axis 0) or below it (axis 1) a disc is, px."""
    return float(disc[PARAMETERS + axis] - 0.5 * (image.shape[1 - axis] - 1))


@kernel
def correct(
    image: NDArray[np.uint8], noise_sigma: float, disc: Array, shared: Array, cov: Array, work: FitBuffers
) -> None:
    """Correct a disc's centre by what the image's discs have in common, and enlarge its covariance.

    A rim that deviates significantly more than others, because a little of it is covered perhaps, may have shifted the
    centre as much. So may an edge that is steeper on one side: where its middle is depends on the profile, and sharpening
    or blur that is the same on all sides moves it; here as far as it moves this disc otherwise than all.

    ``image``: (H, W) grey. ``noise_sigma``: of the image, grey levels. ``disc``: (SHOWN,) what the disc's fit shows; the
    parameters in it are replaced. ``shared``: (SHARED,) of :func:`common`. ``cov``: (2, 2) covariance of the centre, px^2,
    of the fit, replaced.
    """
    theta, factor = disc[PARAMETERS : PARAMETERS + UNKNOWNS], _factor(disc)
    u, v = _from_middle(image, disc, 0), _from_middle(image, disc, 1)
    du, dv = disc[8] * u + disc[10] * v, disc[9] * u + disc[11] * v
    a, b = disc[3] - shared[1] * u, disc[4] - shared[1] * v
    own = disc[5] * a * a + 2 * disc[6] * a * b + disc[7] * b * b
    outside = disc[LEVELLED] * shared[LEVEL] > _SLOPE * factor
    white = factor < _PROCESSED
    inside = own > (_SLOPE_INSIDE if white else _SLOPE) * factor
    slopes = disc[12] == 0.0 and (inside or outside or (white and disc[LEVELLED] > _SLOPE_OUTSIDE * factor))
    if not (slopes and _average(image, noise_sigma, theta, shared[1] * du, shared[1] * dv, factor, cov, work)):
        level = 0.0 if outside else shared[LEVEL]
        theta[0] -= shared[1] * du + level * disc[LEVELLED + 1]
        theta[1] -= shared[1] * dv + level * disc[LEVELLED + 2]
        for i in range(2):
            for j in range(2):
                # Beyond white noise a gradient has no part in the factor, see _rim_noise: nothing of that is spared.
                cov[i, j] = factor * cov[i, j] - level * disc[LEVELLED + 3 + i + j]
    own_u = shared[2] * du - shared[VIGNETTING + 2] * u  # a larger disc is moved by more than the field has
    own_v = shared[2] * dv - shared[VIGNETTING + 2] * v
    cov[0, 0] += own_u * own_u
    cov[0, 1] += own_u * own_v
    cov[1, 0] += own_u * own_v
    cov[1, 1] += own_v * own_v
    off = disc[1] - shared[0]
    if off > 0.0 and disc[0] > _RIM_CHANCE:
        cov[0, 0] += off
        cov[1, 1] += off
    skew = disc[SKEWED : SKEWED + 2] - shared[FIELDS : FIELDS + 2] - shared[FIELDS + 2] * theta[:2]
    square, chance = skew[0] * skew[0] + skew[1] * skew[1], _SLOPE * factor * _skew_variance(disc)
    if square > chance:
        for i in range(2):
            for j in range(2):
                cov[i, j] += (1.0 - chance / square) * skew[i] * skew[j]


@kernel
def _average(
    image: NDArray[np.uint8], noise_sigma: float, theta: Array, shift_u: float, shift_v: float, factor: float, cov: Array,
    work: FitBuffers,
) -> bool:  # fmt: skip
    """Replace centre and covariance by the mean over the kinds of gradient, weighted by likelihood; False: not possible.

    A kind that is not distinguishable from another moves the centre by up to its own standard deviation: the spread between
    the kinds is part of the covariance. The likelihood is that of noise whose variance is ``factor`` times as large.
    """
    trial, start = work.trial, work.start
    start[:] = theta
    x0, y0 = np.rint(theta[0]), np.rint(theta[1])
    n, _ = gather(image, theta, work)
    if n < 4 * UNKNOWNS:
        return False
    results, block, least, texture = np.zeros((3, 7)), np.empty((2, 2)), np.inf, 0.0
    freedom = float(UNKNOWNS)
    for kind in (SURROUND, LIGHT, GLARE):
        trial[:] = start
        square, weighed = minimise(n, trial, x0, y0, kind, noise_sigma, kind == SURROUND, texture, work)
        results[kind, 0] = np.inf
        if square < 0.0:
            if kind == SURROUND:
                return False
            continue
        if kind == SURROUND:
            texture, freedom = weighed, float(max(n - clipped(n, work) - UNKNOWNS, UNKNOWNS))
            start[:] = trial
        of_centre(work, block)
        results[kind, 0], results[kind, 1], results[kind, 2] = square, trial[0], trial[1]
        results[kind, 3], results[kind, 4], results[kind, 5] = block[0, 0], block[0, 1], block[1, 1]
        results[kind, 3:6] *= factor * square / freedom
        least = min(least, square)
    theta[:] = start
    results[SURROUND, 1] -= shift_u
    results[SURROUND, 2] -= shift_v
    total = 0.0
    for kind in range(3):
        results[kind, 6] = _KINDS[kind] * np.exp(-0.5 * (results[kind, 0] - least) * freedom / (factor * least))
        total += results[kind, 6]
    theta[0], theta[1] = 0.0, 0.0
    for kind in range(3):
        if results[kind, 6] > 0.0:
            theta[0] += results[kind, 6] / total * results[kind, 1]
            theta[1] += results[kind, 6] / total * results[kind, 2]
    cov[:, :] = 0.0
    for kind in range(3):
        w, u, v = results[kind, 6] / total, results[kind, 1] - theta[0], results[kind, 2] - theta[1]
        if w > 0.0:
            cov[0, 0] += w * (results[kind, 3] + u * u)
            cov[0, 1] += w * (results[kind, 4] + u * v)
            cov[1, 1] += w * (results[kind, 5] + v * v)
    cov[1, 0] = cov[0, 1]
    return True
