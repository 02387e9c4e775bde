"""The centre of one disc to the limit that the image's noise sets, and what is no disc.

Gauss-Newton on :mod:`~armsight.vision.markers.disc_model`: a first step on a third of the rows, then on all until the
centre rests. Where the surround is not plain its own variance lowers the weight of what shows it; where the disc has a
gradient (a score test), the kind of gradient that fits best is taken. What is left tells discs from what looks like one.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from armsight.data import Array
from armsight.vision.markers.disc_model import (
    LIGHT,
    STRAY,
    SURROUND,
    UNKNOWNS,
    Work,
    factor,
    linearise,
    normal_equations,
    solve,
)
from armsight.vision.markers.disc_pixels import gather
from armsight.vision.markers.disc_residuals import (
    SECTORS,
    clipped,
    of_centre,
    rim,
    slope_inside,
    slope_outside,
    spread,
    texture_factor,
)

_STEPS = 8
#: A step of the centre after which the next one does not count: the next is a tenth of it at the most, px; and in
#: standard deviations of the centre.
_SMALL_STEP_PX, _SMALL_STEP_SIGMAS = 0.02, 1.0
_BLUR_LEAST_PX = 0.2
#: A step of the centre after which the residuals away from the rim tell the surround's variance, px.
_WEIGH_PX = 0.3
#: Chi-square of two degrees from which a disc or its surround may have a gradient: chance exceeds it in 1% and 10%.
_SLOPE_INSIDE, _SLOPE_OUTSIDE = 9.2, 4.6
#: How likely each kind of gradient is where there is one (LIGHT, SURROUND, STRAY).
_KINDS = (0.6, 0.3, 0.1)

#: Why a place is no disc: code -> words. 0 is a disc.
REASONS = {
    1: "cut by the image's border",
    2: "no ellipse fits its rim",
    3: "its rim is not sharp enough for its size",
    4: "too narrow for a disc seen at less than 75 degrees",
    5: "its rim is not that of an ellipse",
    6: "too faint against the noise",
    7: "smaller than 4 px across",
    8: "its inside is not even: smeared by motion, or no disc",
    9: "open on one side",
    10: "what surrounds it is not even: text, a ring, a square of a board",
    11: "found already",
}
FOUND_TWICE = 11
#: Reasons of places that have a closed rim, those that look most like a disc first.
LOOK_ALIKES = (5, 8, 1, 10, 3, 4, 6)
_MOST_BLUR = 0.8  # of the smaller half axis
_LEAST_RATIO = 0.22
#: How far the sixteenths of the rim may lie off the ellipse beyond what noise does, RMS: px, share of the size, and share
#: of the blur for each share of the contrast that residuals have beyond noise (a textured surround moves the rim).
_RIM_PX, _RIM_SHARE, _RIM_TEXTURE = 0.05, 0.005, 1.5
#: Standard deviations of that beyond which it is no chance.
_RIM_CHANCE = 4.0
#: What the residuals may be beyond the image's noise, as a share of the contrast.
_MOST_RESIDUAL = 0.1
#: A centre that its uneven surround leaves less certain than this is not given, px.
_MOST_SIGMA_PX = 0.08
#: How uneven the inside may be beyond the image's noise, as a share of the contrast.
_UNEVEN = 0.12
_LEAST_SNR = 3.0


@numba.njit(cache=True, error_model="numpy")
def _step(n: int, theta: Array, x0: float, y0: float, slope: int, texture: float, work: Work) -> tuple[float, float]:
    """Make one Gauss-Newton step on the first n pixels.

    Returns:
        How far the centre moved, px, -1 where no step is possible; the sum of the squared residuals after the step.
    """
    H, g, L, scale, x, at = work.H, work.g, work.L, work.scale, work.x, work.at
    for a in range(UNKNOWNS):
        at[a] = theta[a]
    at[0], at[1] = theta[0] - x0, theta[1] - y0
    square = linearise(n, slope, texture, work)
    normal_equations(n, work)
    if not factor(H, L, scale):
        return -1.0, square
    solve(L, scale, g, x)
    shift = np.sqrt(x[0] * x[0] + x[1] * x[1])
    shrink = 1.0
    for a in (2, 4, 5):  # a blur or a shape at most halves or doubles
        if abs(x[a]) > 0.5 * theta[a]:
            shrink = min(shrink, 0.5 * theta[a] / abs(x[a]))
    if not shift * shift * (theta[2] + theta[4]) < 1.0:
        return -1.0, square
    for a in range(UNKNOWNS):
        theta[a] += shrink * x[a]
        square -= x[a] * g[a]
    theta[5] = max(theta[5], _BLUR_LEAST_PX)
    if not theta[2] * theta[4] - theta[3] * theta[3] > 0.0:
        return -1.0, square
    return (shift if shrink == 1.0 else max(shift, 1.0)), square


@numba.njit(cache=True, error_model="numpy")
def _minimise(
    n: int, theta: Array, x0: float, y0: float, slope: int, noise_sigma: float, weigh: bool, work: Work
) -> tuple[float, float]:
    """Step until the centre rests; return the sum of squared residuals, -1 where there is no minimum, and the texture.

    ``weigh``: where the surround varies more than the disc, weigh it less.
    """
    flat, H = work.sectors[0], work.H
    texture, weighed = 0.0, not weigh
    for _ in range(_STEPS):
        shift, square = _step(n, theta, x0, y0, slope, texture, work)
        if shift < 0.0:
            return -1.0, 0.0
        if shift < _WEIGH_PX and not weighed:
            weighed = True
            spread(n, work, flat)
            v_in = flat[0] if flat[2] >= 30.0 else noise_sigma * noise_sigma
            v_in = max(v_in, 0.05, 1e-4 * theta[6] * theta[6])
            if flat[1] > (2.0 + 6.0 * np.sqrt(2.0 / max(flat[2], 30.0) + 2.0 / max(flat[3], 4.0))) * v_in:
                texture = flat[1] / v_in - 1.0
                continue
        if shift < _SMALL_STEP_PX or shift * shift * (H[0, 0] + H[1, 1]) * n < _SMALL_STEP_SIGMAS**2 * 2 * square:
            return square, texture
    return -1.0, 0.0


@numba.njit(cache=True, error_model="numpy")
def _average(
    n: int, theta: Array, x0: float, y0: float, noise_sigma: float, square: float, cov: Array, work: Work
) -> None:
    """Replace centre and covariance by the mean over the kinds of gradient, each by how likely it is (model averaging).

    What SURROUND gives, sum of squares and all, is what comes in. A kind that cannot be told from another pulls the centre
    by up to its own standard deviation: the spread between the kinds is part of the covariance.
    """
    trial, start = work.trial, work.start
    start[:] = theta
    results, block, least = np.zeros((3, 7)), np.empty((2, 2)), square
    results[SURROUND, 0], results[SURROUND, 1], results[SURROUND, 2] = square, theta[0], theta[1]
    results[SURROUND, 3], results[SURROUND, 4], results[SURROUND, 5] = cov[0, 0], cov[0, 1], cov[1, 1]
    for kind in (LIGHT, STRAY):
        trial[:] = start
        square, _ = _minimise(n, trial, x0, y0, kind, noise_sigma, False, work)
        results[kind, 0] = np.inf
        if square >= 0.0:
            of_centre(work, block)
            variance = square / (n - UNKNOWNS)
            results[kind, 0], results[kind, 1], results[kind, 2] = square, trial[0], trial[1]
            results[kind, 3], results[kind, 4], results[kind, 5] = block[0, 0], block[0, 1], block[1, 1]
            results[kind, 3:6] *= variance
            least = min(least, square)
    total = 0.0
    for kind in range(3):
        results[kind, 6] = _KINDS[kind] * np.exp(-0.5 * (results[kind, 0] - least) * (n - UNKNOWNS) / least)
        total += results[kind, 6]
    theta[0], theta[1] = 0.0, 0.0
    for kind in range(3):
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


@numba.njit(cache=True, error_model="numpy")
def fit(image: NDArray[np.uint8], noise_sigma: float, theta: Array, cov: Array, work: Work) -> int:
    """Fit one disc.

    Args:
        image: (H, W) grey.
        noise_sigma: the image's noise as far as it is known beforehand, grey levels; judges what is no disc.
        theta: (10,) start: centre (raw px), M (1/px^2), blur (px), contrast, base, gradient (1/px); replaced by the
            result.
        cov: (2, 2) covariance of the centre, px^2; filled.
        work: what :func:`workspace` returns.

    Returns:
        0, or why it is no disc (REASONS).
    """
    sectors = work.sectors
    n, sample = gather(image, theta, work)
    if n < 0:
        return 1
    if n < 4 * UNKNOWNS:
        return 7
    x0, y0 = np.rint(theta[0]), np.rint(theta[1])
    if _step(sample, theta, x0, y0, SURROUND, 0.0, work)[0] < 0.0:
        return 2
    square, texture = _minimise(n, theta, x0, y0, SURROUND, noise_sigma, True, work)
    if square < 0.0:
        return 2
    # Clipped pixels have no noise and say nothing of it.
    variance = square / max(n - clipped(n, work) - UNKNOWNS, UNKNOWNS)
    det = theta[2] * theta[4] - theta[3] * theta[3]
    half = (theta[2] + theta[4]) / 2
    root = np.sqrt(max(half * half - det, 0.0))
    minor, major = 1.0 / np.sqrt(half + root), 1.0 / np.sqrt(max(half - root, 1e-12))
    if theta[5] > _MOST_BLUR * minor:
        return 3
    if minor < _LEAST_RATIO * major:
        return 4
    if not abs(theta[6]) > _LEAST_SNR * np.sqrt(variance):
        return 6
    excess = np.sqrt(max(variance - noise_sigma * noise_sigma, 0.0)) / abs(theta[6])
    if excess > _MOST_RESIDUAL:
        return 10
    rim(n, theta, x0, y0, work, sectors)
    off, chance, count = 0.0, 0.0, 0
    for k in range(SECTORS):
        if sectors[1, k] > 0.0:
            off += sectors[0, k] ** 2 - variance / sectors[1, k]
            chance += 2.0 * (variance / sectors[1, k]) ** 2
            count += 1
    allowed = _RIM_PX + _RIM_SHARE * np.sqrt(major * minor) + _RIM_TEXTURE * theta[5] * excess
    if off > count * allowed * allowed + _RIM_CHANCE * np.sqrt(chance):
        return 5
    spread(n, work, sectors[0])
    if sectors[0, 2] > 10.0 and np.sqrt(max(sectors[0, 0] - noise_sigma * noise_sigma, 0.0)) > _UNEVEN * abs(theta[6]):
        return 8
    uneven = texture == 0.0 and (
        slope_inside(n, theta, x0, y0, work) > _SLOPE_INSIDE * variance
        or slope_outside(theta, work) > _SLOPE_OUTSIDE * variance
    )
    of_centre(work, cov)
    if texture > 0.0:
        variance *= texture_factor(n, theta[5], texture, work)
        if variance * (cov[0, 0] + cov[1, 1]) > 2.0 * _MOST_SIGMA_PX * _MOST_SIGMA_PX:
            return 10
    for a in range(2):
        for b in range(2):
            cov[a, b] *= variance
    if uneven:
        _average(n, theta, x0, y0, noise_sigma, square, cov, work)
    if off > _RIM_CHANCE * np.sqrt(chance):
        # A rim that is off beyond chance, a little of it covered perhaps, may have taken the centre along as far.
        cov[0, 0] += off / count
        cov[1, 1] += off / count
    return 0


@numba.njit(cache=True, error_model="numpy")
def shape_of(theta: Array, shape: Array) -> None:
    """Fill S11, S12, S22 of a fitted ellipse, px^2.

    Blur moves the half-way level of a curved edge inwards by blur^2 / (2 radius); that is put right here.
    """
    det = theta[2] * theta[4] - theta[3] * theta[3]
    wider = (1.0 + 0.5 * theta[5] * theta[5] * np.sqrt(det)) ** 2 / det
    shape[0], shape[1], shape[2] = wider * theta[4], -wider * theta[3], wider * theta[2]
