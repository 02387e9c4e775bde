"""One pair of images to a pose, in one compiled call: windows, centres, pose, points and covariances.

Everything is searched where a predicted pose says, so a pair costs what its few discs cost. Windows and centres are found
here; the pose is :mod:`~armsight.vision.discs.pose`'s.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from armsight.data import Array
from armsight.vision.discs.bias import disc_image
from armsight.vision.discs.pose import (
    SEEN,
    Found,
    Scene,
    believable,
    settle,
    sum_squares,
    triangulated,
    uncertainty,
    velocity,
)
from armsight.vision.markers.disc.fit import Work, fit, shape_of
from armsight.vision.markers.disc.search import Room, outline
from armsight.vision.posefit import moved

#: What came of one disc in one image, beside SEEN and the codes of disc_fit.REASONS.
TURNED_AWAY, OUTSIDE, NOT_THERE, OTHER_SIZE = 20, 21, 22, 23
#: Cosine between a disc's normal and its direction to the camera below which it is not looked for: 78 degrees.
_FACING = 0.2
#: How much larger or smaller than predicted a disc may look.
_SIZE = 1.35
#: A step that changes the cost by less than this share is the last.
_REACHED = 1e-5


@numba.njit(cache=True, error_model="numpy")
def _surround(image: NDArray[np.uint8], x: int, y: int, shape: Array) -> float:
    """Return the mean level of eight places on a ring around an ellipse at (x, y)."""
    height, width = image.shape
    grow = 1.3 + 2.5 / np.sqrt(np.sqrt(max(shape[0] * shape[2] - shape[1] * shape[1], 1.0)))
    l11 = np.sqrt(shape[0])
    l21 = shape[1] / l11
    l22 = np.sqrt(max(shape[2] - l21 * l21, 0.0))
    total = 0.0
    for k in range(8):
        c, s = np.cos(0.7853981633974483 * k), np.sin(0.7853981633974483 * k)
        i, j = int(np.rint(x + grow * l11 * c)), int(np.rint(y + grow * (l21 * c + l22 * s)))
        total += image[min(max(j, 0), height - 1), min(max(i, 0), width - 1)]
    return total / 8


@numba.njit(cache=True, error_model="numpy")
def _seek(
    image: NDArray[np.uint8], uv: Array, shape: Array, margin: float, least: float, contrast: float, sign: int,
    theta: Array, room: Room,
) -> int:  # fmt: skip
    """Find a disc near its predicted place and make a start for its fit."""
    height, width = image.shape
    x, y = int(np.rint(uv[0])), int(np.rint(uv[1]))
    reach_x, reach_y = margin + np.sqrt(shape[0]), margin + np.sqrt(shape[2])
    if x < 0 or y < 0 or x >= width or y >= height:
        return OUTSIDE
    code = NOT_THERE
    low = _surround(image, x, y, shape)
    if sign * (image[y, x] - low) >= least:
        code = outline(image, x, y, int(low), sign, theta, room)
        if code == 0 and (theta[0] - uv[0]) ** 2 + (theta[1] - uv[1]) ** 2 <= margin * margin:
            return 0
    # Not there: of the pixels in the window that stand out by half the contrast, the one nearest to the prediction.
    det = shape[0] * shape[2] - shape[1] * shape[1]
    step = max(1, int(0.7 * np.sqrt(det / max(shape[0], shape[2]))))
    beyond = max(least, 0.5 * contrast)
    best, x1, y1 = np.inf, -1, -1
    for j in range(max(0, int(y - reach_y)), min(height, int(y + reach_y) + 1), step):
        for i in range(max(0, int(x - reach_x)), min(width, int(x + reach_x) + 1), step):
            far = (i - uv[0]) ** 2 + (j - uv[1]) ** 2
            if far < best and sign * (image[j, i] - low) >= beyond:
                best, x1, y1 = far, i, j
    if x1 < 0:
        return code
    low = _surround(image, x1, y1, shape)
    code = outline(image, x1, y1, int(low), sign, theta, room)
    if code == 0 and (theta[0] - uv[0]) ** 2 + (theta[1] - uv[1]) ** 2 > margin * margin:
        return NOT_THERE
    return code


@numba.njit(cache=True, error_model="numpy")
def look(
    image: NDArray[np.uint8], side: int, scene: Scene, margin: float, noise: float, least: float, found: Found, work: Work,
    room: Room,
) -> None:  # fmt: skip
    """Find the discs of one image around where the pose ``found.T`` has them; ``found.codes`` says what came of each."""
    T = scene.T_right_left @ found.T if side == 1 else found.T
    P, n = np.empty(3), np.empty(3)
    theta, expected, J_P, J_n = np.empty(10), np.empty(3), np.empty((2, 3)), np.empty((2, 3))
    for m in range(len(scene.radii)):
        for i in range(3):
            P[i] = T[i, 3]
            n[i] = 0.0
            for j in range(3):
                P[i] += T[i, j] * scene.points[m, j]
                n[i] += T[i, j] * scene.normals[m, j]
        uv = found.predicted[m, side]
        distance = np.sqrt(P[0] * P[0] + P[1] * P[1] + P[2] * P[2])
        if scene.faces[m] and -(P[0] * n[0] + P[1] * n[1] + P[2] * n[2]) < _FACING * distance:
            found.codes[m, side] = TURNED_AWAY
            continue
        if not disc_image(
            scene.fisheye[side], scene.k[side], scene.d[side], P, n, scene.radii[m], uv, expected, J_P, J_n
        ):
            found.codes[m, side] = TURNED_AWAY
            continue
        code = _seek(image, uv, expected, margin, least, found.contrast[m, side], scene.signs[m], theta, room)
        if code == 0:
            code = fit(image, noise, theta, found.cov_uv[m, side], work)
        if code == 0:
            shape = found.shape[m, side]
            shape_of(theta, shape)
            ratio = (shape[0] * shape[2] - shape[1] * shape[1]) / (
                expected[0] * expected[2] - expected[1] * expected[1]
            )
            if not 1.0 / _SIZE**4 < ratio < _SIZE**4:
                code = OTHER_SIZE
        found.codes[m, side] = code
        if code == 0:
            found.uv[m, side, 0], found.uv[m, side, 1] = theta[0], theta[1]
            found.contrast[m, side] = abs(theta[6])


@numba.njit(cache=True, error_model="numpy")
def follow_pair(
    left: NDArray[np.uint8], right: NDArray[np.uint8], T: Array, twist: Array, seconds: float, scene: Scene,
    margin: float, noise: float, least: float, limits: Array, found: Found, cov_noise: Array, work: Work, room: Room,
) -> tuple[int, float, float]:  # fmt: skip
    """Measure one pair around a predicted pose.

    Args:
        left: (H, W) grey.
        right: (H, W) grey.
        T: (4, 4) last pose.
        twist: (6,) of the body since; in the end its velocity between that pose and this.
        seconds: since the last pose.
        scene: what does not change.
        margin: how far a disc may be from where it is predicted, px.
        noise: standard deviation of the images' noise, grey levels.
        least: least contrast of a disc, grey levels.
        limits: (2 M + 1,) by how many ellipses were seen, chi-square above which the residuals are a misfit.
        found: room for the result.
        cov_noise: (6, 6) filled with the covariance from the pixel noise alone.
        work: room for fits.
        room: room for outlines.

    Returns:
        How many ellipses were seen, 0 where they give no pose to be believed; chi-square of the residuals as
        :func:`uncertainty` has it; how far off the prediction was at the most, px.
    """
    xi = twist * seconds
    moved(T, xi, found.T)
    look(left, 0, scene, margin, noise, least, found, work, room)
    look(right, 1, scene, margin, noise, least, found, work, room)
    both, seen, wrong = 0, 0, 0.0
    for m in range(len(scene.radii)):
        both += found.codes[m, 0] == SEEN and found.codes[m, 1] == SEEN
        for side in range(2):
            if found.codes[m, side] == SEEN:
                seen += 1
                gap = found.uv[m, side] - found.predicted[m, side]
                wrong = max(wrong, np.sqrt(gap[0] * gap[0] + gap[1] * gap[1]))
    if both < 3:
        return 0, np.inf, wrong
    cost = settle(scene, found)
    if not np.isfinite(cost) or not believable(scene, found):
        return 0, np.inf, wrong
    chi_square = uncertainty(scene, found, cov_noise, cost, limits[seen])
    triangulated(scene, found)
    sum_squares(scene, found)
    velocity(T, found.T, seconds, twist)
    return seen, chi_square, wrong
