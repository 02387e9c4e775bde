"""One pair of images to a pose, in one compiled call: windows, centres, pose, points and covariances.

Discs are searched only where a predicted pose expects them, so the time for a pair grows with its few discs and not
with the image. The pose minimises the whitened distance of the ellipses' centres to where the discs' ellipses would
have theirs: the perspective bias is in the model, not corrected afterwards.

The file follows a pair: the records (:class:`DiscScene` for what is constant, :class:`DiscMeasurement` for the result), the
minimum and its covariance, the points, then the search for each disc, and last :func:`follow_pair`, which calls them all.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array
from armsight.geometry.matrix import applied, dot, product, solved, solved_vector
from armsight.kernels import kernel, kernel_types
from armsight.vision.camera import distort
from armsight.vision.discs.bias import disc_image
from armsight.vision.markers.disc.common import FIELDS, SHARED, common, correct
from armsight.vision.markers.disc.fit import PARAMETERS, FitBuffers, factor, fit, shape_of, solve
from armsight.vision.markers.disc.search import REACH, Room, outline
from armsight.vision.match import SIGMAS
from armsight.vision.pose.posefit import moved

#: Code of a disc that was seen.
SEEN = 0
_STEPS = 8
#: A step that changes the cost by less than this share is the last.
_REACHED = 1e-5
#: A disc whose rows explain so many times the mean square of the others' is left out: half of it by chance once in 1,000
#: shots, double of it once in 10 million.
_STRANGE = 32.0


@kernel_types(
    "b1[::1], f8[:, ::1], f8[:, ::1], i8[::1], i8[::1], f8[:, ::1], f8[:, ::1], f8, f8[:, ::1], f8[:, ::1], "
    "b1[::1], f8[::1], i8[::1], f8, f8[::1]"
)
class DiscScene(NamedTuple):
    """The quantities that are constant from pair to pair."""

    fisheye: NDArray[np.bool_]  #: (2,) whether a camera is a fisheye
    k: Array  #: (2, 4) intrinsics
    d: Array  #: (2, 8) distortion
    first: NDArray[np.int64]  #: (2,) column of a camera's first parameter among the rig's
    sizes: NDArray[np.int64]  #: (2,) number of a camera's parameters
    T_right_left: Array  #: (4, 4)
    cov_rig: Array  #: (P, P) covariance of the rig's parameters
    variance: float  #: of a centre beyond that of the image, px^2
    points: Array  #: (M, 3) centres of the discs, m
    normals: Array  #: (M, 3) their normals, for the bias
    faces: NDArray[np.bool_]  #: (M,) whether the normal's side is known
    radii: Array  #: (M,) m
    signs: NDArray[np.int64]  #: (M,) 1 bright, -1 dark
    apart_s: float  #: standard deviation of the time between the two exposures, s
    factors: Array  #: (2,) by which a camera's variances are multiplied, of its discs' centres


@kernel_types(
    "i8[:, ::1], f8[:, :, ::1], f8[:, :, :, ::1], f8[:, :, ::1], f8[:, :, ::1], f8[:, ::1], f8[:, :, ::1], "
    "f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, :, ::1], f8[:, :, ::1], f8[::1], f8[:, ::1], "
    "f8[:, ::1], f8[:, :, ::1], f8[::1], f8[:, :, ::1]"
)
class DiscMeasurement(NamedTuple):
    """The measurement of one pair; M discs, two cameras."""

    codes: NDArray[np.int64]  #: (M, 2) the outcome of each: SEEN, or why it was not
    uv: Array  #: (M, 2, 2) centres of the ellipses, raw px
    cov_uv: Array  #: (M, 2, 2, 2) from the image alone, px^2
    shape: Array  #: (M, 2, 3) ellipses, px^2
    predicted: Array  #: (M, 2, 2) where they were predicted, px
    contrast: Array  #: (M, 2) grey levels, kept from pair to pair; 0 where unknown
    residual: Array  #: (M, 2, 2) of the centres at the pose, px
    T: Array  #: (4, 4) pose T_left_body; the prediction at first
    H: Array  #: (6, 6) information
    #: (6, 6) the share of the rig and of ``common`` in the covariance; the noise's share is the inverse of H
    cov: Array
    p_left: Array  #: (M, 3) points, m, of the discs that both cameras saw
    cov_p: Array  #: (M, 3, 3) their covariance from the pixel noise, m^2
    by_rig: Array  #: (M, 3, P) their derivative by the rig
    whitened: Array  #: (4 M,) residuals
    J: Array  #: (4 M, 6) whitened
    J_rig: Array  #: (4 M, P) whitened
    bias: Array  #: (M, 2, 2) centre of ellipse less image of centre, px
    squares: Array  #: (2,) sums of the points' squared distances from the body, m^2, and of the residuals, px^2
    common: Array  #: (2, 2, 3) camera; what may have moved its centres together, as in ``Discs``


@kernel
def _linearise(scene: DiscScene, T_left: Array, found: DiscMeasurement, rig: bool) -> float:
    """Fill residuals and whitened J at a pose, by the rig too if ``rig``; return the cost, inf behind a camera."""
    P, n, e = np.empty(3), np.empty(3), np.empty(3)
    uv, shape, J_P, J_n = np.empty(2), np.empty(3), np.empty((2, 3)), np.empty((2, 3))
    xy, J_p, J_d = np.empty(2), np.empty((2, 3)), np.empty((2, 8))
    cost = 0.0
    T_right = product(scene.T_right_left, T_left)
    last = scene.cov_rig.shape[0] - 6
    for m in range(len(scene.radii)):
        p, b = scene.points[m], scene.normals[m]
        for side in range(2):
            row = 4 * m + 2 * side
            found.whitened[row : row + 2] = 0.0
            found.J[row : row + 2] = 0.0
            if found.codes[m, side] != SEEN:
                continue
            T = T_right if side == 1 else T_left
            for i in range(3):
                P[i] = T[i, 0] * p[0] + T[i, 1] * p[1] + T[i, 2] * p[2] + T[i, 3]
                n[i] = T[i, 0] * b[0] + T[i, 1] * b[1] + T[i, 2] * b[2]
            k = scene.k[side]
            if not disc_image(scene.fisheye[side], k, scene.d[side], P, n, scene.radii[m], uv, shape, J_P, J_n):
                return np.inf
            # Whitening: the lower triangle of the inverse of the covariance's Cholesky factor.
            c = found.cov_uv[m, side]
            l00 = np.sqrt(c[0, 0] + scene.variance)
            l10 = c[1, 0] / l00
            l11 = np.sqrt(c[1, 1] + scene.variance - l10 * l10)
            r0, r1 = found.uv[m, side, 0] - uv[0], found.uv[m, side, 1] - uv[1]
            found.residual[m, side, 0], found.residual[m, side, 1] = r0, r1
            a = r0 / l00
            found.whitened[row], found.whitened[row + 1] = a, (r1 - l10 * a) / l11
            cost += found.whitened[row] ** 2 + found.whitened[row + 1] ** 2
            for i in range(2):
                for j in range(3):
                    by_position = J_P[i, 0] * T[0, j] + J_P[i, 1] * T[1, j] + J_P[i, 2] * T[2, j]
                    found.J[row + i, j] = by_position
                    e[j] = J_n[i, 0] * T[0, j] + J_n[i, 1] * T[1, j] + J_n[i, 2] * T[2, j]
                g = found.J[row + i]
                g[3] = g[2] * p[1] - g[1] * p[2] + e[2] * b[1] - e[1] * b[2]
                g[4] = g[0] * p[2] - g[2] * p[0] + e[0] * b[2] - e[2] * b[0]
                g[5] = g[1] * p[0] - g[0] * p[1] + e[1] * b[0] - e[0] * b[1]
            for j in range(6):
                a = found.J[row, j] / l00
                found.J[row, j] = a
                found.J[row + 1, j] = (found.J[row + 1, j] - l10 * a) / l11
            if not rig:
                continue
            distort(scene.fisheye[side], scene.d[side], P, xy, J_p, J_d)
            found.bias[m, side, 0], found.bias[m, side, 1] = uv[0] - k[0] * xy[0] - k[2], uv[1] - k[1] * xy[1] - k[3]
            first, count = scene.first[side], scene.sizes[side]
            for i in range(2):
                G = found.J_rig[row + i]
                G[:] = 0.0
                G[first + i], G[first + 2 + i] = xy[i], 1.0
                for j in range(count - 4):
                    G[first + 4 + j] = k[i] * J_d[i, j]
                if side == 1:
                    for j in range(3):
                        G[last + j] = -J_P[i, j]
                    G[last + 3] = J_P[i, 1] * P[2] - J_P[i, 2] * P[1]
                    G[last + 4] = J_P[i, 2] * P[0] - J_P[i, 0] * P[2]
                    G[last + 5] = J_P[i, 0] * P[1] - J_P[i, 1] * P[0]
            for j in range(last + 6):
                a = found.J_rig[row, j] / l00
                found.J_rig[row, j] = a
                found.J_rig[row + 1, j] = (found.J_rig[row + 1, j] - l10 * a) / l11
    return cost


@kernel
def settle(scene: DiscScene, found: DiscMeasurement) -> float:
    """Minimise over the pose ``found.T``; return the sum of the squared whitened residuals, infinite without a minimum."""
    trial, H, g, xi = np.empty((4, 4)), found.H, np.empty(6), np.empty(6)
    L, scale = np.empty((6, 6)), np.empty(6)
    cost = _linearise(scene, found.T, found, False)
    for _ in range(_STEPS):
        if not np.isfinite(cost):
            return np.inf
        H[:, :] = product(found.J.T, found.J)
        g[:] = applied(found.J.T, found.whitened)
        if not factor(H, L, scale):
            return np.inf
        solve(L, scale, g, xi)
        moved(found.T, xi, trial)
        new = _linearise(scene, trial, found, False)
        if not new <= cost + _REACHED * (1.0 + cost):
            return np.inf  # from such a prediction a full step descends; otherwise the whole image is searched
        done = abs(cost - new) <= _REACHED * (1.0 + cost)
        found.T[:, :] = trial
        cost = new
        if done:
            return _linearise(scene, found.T, found, True)
    return np.inf


@kernel
def uncertainty(scene: DiscScene, found: DiscMeasurement, cov_noise: Array, chi_square: float, limit: float) -> float:
    """Fill covariances; return the residuals' chi-square, above ``limit`` less the part that a wrong calibration explains.

    The rig's share propagates through the same fit: gain = H^-1 J^T J_rig. What moves an image's centres together is
    another principal point and focal length. Chi-square: residuals weighted by the inverse of I + B cov_rig B^T, with B the
    part of J_rig that no pose explains (Woodbury's identity), as in ``locate``.
    """
    J, J_rig, cov_rig = found.J, found.J_rig, scene.cov_rig.copy()
    for side in range(2):
        first = scene.first[side]
        for shift in found.common[side]:
            by = shift[2] * scene.k[side]
            by[2:] += shift[:2]
            for i in range(4):
                for j in range(4):
                    cov_rig[first + i, first + j] += by[i] * by[j]
    for row in range(len(found.whitened)):
        if found.codes[row // 4, (row // 2) % 2] != SEEN:
            J_rig[row] = 0.0
    found.H[:, :] = product(J.T, J)
    cov_noise[:, :] = solved(found.H, np.eye(6))
    gain = product(cov_noise, product(J.T, J_rig))
    found.cov[:, :] = product(product(gain, cov_rig), gain.T)
    if chi_square <= limit:
        return chi_square
    B = J_rig - product(J, gain)
    v = applied(B.T, found.whitened)
    M = np.eye(len(cov_rig)) + product(cov_rig, product(B.T, B))
    return chi_square - dot(v, solved_vector(M, applied(cov_rig, v)))


@kernel
def _inverse_normal(A: Array, out: Array) -> None:
    """Fill the inverse of A^T A, A (4, 3), by its adjugate."""
    a, b, c, d, e, f = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(4):
        a += A[i, 0] * A[i, 0]
        b += A[i, 0] * A[i, 1]
        c += A[i, 0] * A[i, 2]
        d += A[i, 1] * A[i, 1]
        e += A[i, 1] * A[i, 2]
        f += A[i, 2] * A[i, 2]
    out[0, 0], out[0, 1], out[0, 2] = d * f - e * e, c * e - b * f, b * e - c * d
    det = a * out[0, 0] + b * out[0, 1] + c * out[0, 2]
    out[1, 1], out[1, 2], out[2, 2] = a * f - c * c, b * c - a * e, a * d - b * b
    out[1, 0], out[2, 0], out[2, 1] = out[0, 1], out[0, 2], out[1, 2]
    for i in range(3):
        for j in range(3):
            out[i, j] /= det


@kernel("const f8[:, ::1], const f8[:, ::1], f8, f8[::1]")
def velocity(T_from: Array, T_to: Array, seconds: float, twist: Array) -> None:
    """Fill the twist (6,), per second, by which :func:`~armsight.vision.pose.posefit.moved` takes one pose to the other."""
    R = np.empty((3, 3))
    for i in range(3):
        twist[i] = 0.0
        for j in range(3):
            twist[i] += T_from[j, i] * (T_to[j, 3] - T_from[j, 3]) / seconds
            R[i, j] = T_from[0, i] * T_to[0, j] + T_from[1, i] * T_to[1, j] + T_from[2, i] * T_to[2, j]
    x, y, z = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    sine = 0.5 * np.sqrt(x * x + y * y + z * z)
    angle = np.arctan2(sine, 0.5 * (R[0, 0] + R[1, 1] + R[2, 2] - 1.0))
    k = (0.5 * angle / sine if sine > 1e-9 else 0.5) / seconds
    twist[3], twist[4], twist[5] = k * x, k * y, k * z


@kernel
def triangulated(scene: DiscScene, found: DiscMeasurement) -> None:
    """Fill the points of the discs that both cameras saw: Gauss-Newton on four whitened coordinates from the pose's."""
    xy, J_p, J_d = np.empty(2), np.empty((2, 3)), np.empty((2, 8))
    A, r, P = np.zeros((4, 3)), np.zeros(4), np.empty(3)
    R = scene.T_right_left
    for m in range(len(scene.radii)):
        if found.codes[m, 0] != SEEN or found.codes[m, 1] != SEEN:
            continue
        p = found.p_left[m]
        for i in range(3):
            p[i] = found.T[i, 3]
            for j in range(3):
                p[i] += found.T[i, j] * scene.points[m, j]
        H = found.cov_p[m]
        for step in range(3):
            for side in range(2):
                for i in range(3):
                    P[i] = p[i] if side == 0 else R[i, 0] * p[0] + R[i, 1] * p[1] + R[i, 2] * p[2] + R[i, 3]
                distort(scene.fisheye[side], scene.d[side], P, xy, J_p, J_d)
                c = found.cov_uv[m, side]
                l00 = np.sqrt(c[0, 0] + scene.variance)
                l10 = c[1, 0] / l00
                l11 = np.sqrt(c[1, 1] + scene.variance - l10 * l10)
                for i in range(2):
                    k = scene.k[side]
                    r[2 * side + i] = found.uv[m, side, i] - found.bias[m, side, i] - k[i] * xy[i] - k[2 + i]
                    for j in range(3):
                        if side == 0:
                            A[i, j] = k[i] * J_p[i, j]
                        else:
                            A[2 + i, j] = k[i] * (J_p[i, 0] * R[0, j] + J_p[i, 1] * R[1, j] + J_p[i, 2] * R[2, j])
                a = 2 * side
                r[a] /= l00
                r[a + 1] = (r[a + 1] - l10 * r[a]) / l11
                for j in range(3):
                    A[a, j] /= l00
                    A[a + 1, j] = (A[a + 1, j] - l10 * A[a, j]) / l11
            _inverse_normal(A, H)
            if step < 2:
                for i in range(3):
                    for j in range(4):
                        p[i] += (H[i, 0] * A[j, 0] + H[i, 1] * A[j, 1] + H[i, 2] * A[j, 2]) * r[j]
        for i in range(3):
            G = found.by_rig[m, i]
            G[:] = 0.0
            for j in range(4):
                gain = H[i, 0] * A[j, 0] + H[i, 1] * A[j, 1] + H[i, 2] * A[j, 2]
                for q in range(len(G)):
                    G[q] -= gain * found.J_rig[4 * m + j, q]


@kernel
def sum_squares(scene: DiscScene, found: DiscMeasurement) -> None:
    """Fill ``found.squares``."""
    T, squares = found.T, found.squares
    squares[:] = 0.0
    for m in range(len(scene.radii)):
        p = scene.points[m]
        if found.codes[m, 0] == SEEN and found.codes[m, 1] == SEEN:
            for i in range(3):
                gap = found.p_left[m, i] - T[i, 0] * p[0] - T[i, 1] * p[1] - T[i, 2] * p[2] - T[i, 3]
                squares[0] += gap * gap
        for side in range(2):
            if found.codes[m, side] == SEEN:
                squares[1] += found.residual[m, side, 0] ** 2 + found.residual[m, side, 1] ** 2


@kernel
def plausible(scene: DiscScene, found: DiscMeasurement, twist: Array) -> bool:
    """Return whether every residual is plausible: not larger than noise, calibration and exposures that differ allow."""
    C, J_rig = scene.cov_rig, found.J_rig
    for row in range(len(found.whitened)):
        r = found.whitened[row] * found.whitened[row]
        if r > SIGMAS * SIGMAS:
            apart = scene.apart_s * dot(found.J[row], twist)
            if r > SIGMAS * SIGMAS * (1.0 + apart * apart + dot(J_rig[row], applied(C, J_rig[row]))):
                return False
    return True


@kernel
def strangest(found: DiscMeasurement) -> tuple[int, float]:
    """Return the disc without which the pose fits best: r^T (1 - J H^-1 J^T)^-1 r of its own rows, the largest; and that.

    That is by how much the sum of squares falls without it (data snooping: Baarda, "A testing procedure for use in geodetic
    networks", 1968); a residual alone is small where a disc far from the others pulls the pose.
    """
    inverse = solved(product(found.J.T, found.J), np.eye(6))
    strange, most = -1, 0.0
    for m in range(len(found.codes)):
        J, r = found.J[4 * m : 4 * m + 4], found.whitened[4 * m : 4 * m + 4]
        less = np.eye(4) - product(product(J, inverse), J.T)
        explained = dot(r, solved_vector(less, r))
        if explained > most:
            strange, most = m, explained
    return strange, most


#: The outcome for one disc in one image, beside SEEN and the codes of ``disc.fit.REASONS``; ASTRAY: it was seen, but not
#: where the body's other discs say.
FACING_AWAY, OUTSIDE, NOT_THERE, OTHER_SIZE, ASTRAY = range(20, 25)
#: Cosine between a disc's normal and its direction to the camera below which it is not searched: 78 degrees.
_FACING = 0.2
#: How much larger or smaller than predicted a disc may look.
_SIZE = 1.35


@kernel
def _surround(image: NDArray[np.uint8], x: int, y: int, shape: Array) -> float:
    """Return the mean grey level of eight pixels on a ring around an ellipse at (x, y)."""
    height, width = image.shape
    scale = 1.3 + 2.5 / np.sqrt(np.sqrt(max(shape[0] * shape[2] - shape[1] * shape[1], 1.0)))
    l11 = np.sqrt(shape[0])
    l21 = shape[1] / l11
    l22 = np.sqrt(max(shape[2] - l21 * l21, 0.0))
    total = 0.0
    for k in range(8):
        c, s = np.cos(0.7853981633974483 * k), np.sin(0.7853981633974483 * k)
        i, j = int(np.rint(x + scale * l11 * c)), int(np.rint(y + scale * (l21 * c + l22 * s)))
        total += image[min(max(j, 0), height - 1), min(max(i, 0), width - 1)]
    return total / 8


@kernel
def _seek(
    image: NDArray[np.uint8], uv: Array, shape: Array, margin: float, least: float, contrast: float, sign: int,
    theta: Array, room: Room,
) -> int:  # fmt: skip
    """Find a disc near its predicted position and estimate the start of its fit; return 0 or why there is none."""
    height, width = image.shape
    x, y = int(np.rint(uv[0])), int(np.rint(uv[1]))
    reach_x, reach_y = margin + np.sqrt(shape[0]), margin + np.sqrt(shape[2])
    half_chord = max(REACH, int(1.5 * np.sqrt(max(shape[0], shape[2]))))
    if x < 0 or y < 0 or x >= width or y >= height:
        return OUTSIDE
    code = NOT_THERE
    low = _surround(image, x, y, shape)
    if sign * (image[y, x] - low) >= least:
        code = outline(image, x, y, int(low), sign, theta, room, half_chord, 0.0)
        if code == 0 and (theta[0] - uv[0]) ** 2 + (theta[1] - uv[1]) ** 2 <= margin * margin:
            return 0
    # Not there: of the pixels in the window that differ from the surround by half the contrast, the nearest one.
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
    code = outline(image, x1, y1, int(low), sign, theta, room, half_chord, 0.0)
    if code == 0 and (theta[0] - uv[0]) ** 2 + (theta[1] - uv[1]) ** 2 > margin * margin:
        return NOT_THERE
    return code


@kernel
def look(
    image: NDArray[np.uint8], side: int, scene: DiscScene, margin: float, noise: float, least: float,
    found: DiscMeasurement, work: FitBuffers, room: Room,
) -> None:  # fmt: skip
    """Find the discs of one image around where the pose ``found.T`` predicts them; ``found.codes`` holds the outcomes."""
    T = product(scene.T_right_left, found.T) if side == 1 else found.T
    P, n = np.empty(3), np.empty(3)
    theta, expected, J_P, J_n = np.empty(10), np.empty(3), np.empty((2, 3)), np.empty((2, 3))
    count = 0
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
            found.codes[m, side] = FACING_AWAY
            continue
        if not disc_image(
            scene.fisheye[side], scene.k[side], scene.d[side], P, n, scene.radii[m], uv, expected, J_P, J_n
        ):
            found.codes[m, side] = FACING_AWAY
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
            found.contrast[m, side] = abs(theta[6])
            work.discs[count, :] = work.shown
            count += 1
    shared = np.empty(SHARED)
    common(image, count, work, shared)
    found.common[side] = shared[FIELDS:].reshape(2, 3)
    count = 0
    for m in range(len(scene.radii)):
        if found.codes[m, side] == SEEN:
            correct(image, noise, work.discs[count], shared, found.cov_uv[m, side], work)
            found.uv[m, side] = work.discs[count, PARAMETERS : PARAMETERS + 2]
            for i in range(2):
                for j in range(2):
                    found.cov_uv[m, side, i, j] *= scene.factors[side]
            count += 1


@kernel(
    "const u1[:, ::1], const u1[:, ::1], const f8[:, ::1], f8[::1], f8, DiscScene, f8, f8, f8, f8[::1], "
    "DiscMeasurement, f8[:, ::1], FitBuffers, (f8[:, ::1], f8[::1], f8[::1], f8[:, ::1], f8[::1], f8[::1])"
)
def follow_pair(
    left: NDArray[np.uint8], right: NDArray[np.uint8], T: Array, twist: Array, seconds: float, scene: DiscScene,
    margin: float, noise: float, least: float, limits: Array, found: DiscMeasurement, cov_noise: Array,
    work: FitBuffers, room: Room,
) -> tuple[int, float, float]:  # fmt: skip
    """Measure one pair around a predicted pose; discs that do not fit it with the others are left out, half at most.

    Args:
        left: (H, W) grey.
        right: (H, W) grey.
        T: (4, 4) last pose.
        twist: (6,) of the body since then, per second; in the end its velocity between that pose and this.
        seconds: since the last pose.
        scene: what is constant.
        margin: largest distance of a disc from its prediction, px.
        noise: standard deviation of the images' noise, grey levels.
        least: least contrast of a disc, grey levels.
        limits: (2 M + 1,) by how many ellipses were seen, chi-square above which the residuals are a misfit.
        found: buffers for the result.
        cov_noise: (6, 6) filled with the covariance from the pixel noise alone.
        work: buffers for fits.
        room: buffers for outlines.

    Returns:
        The number of ellipses seen, 0 where they give no plausible pose; chi-square of the residuals as in
        :func:`uncertainty`; the largest error of the prediction, px.
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
    cost, least_both = settle(scene, found), max(3, (both + 1) // 2)
    while np.isfinite(cost) and cost > limits[seen]:
        m, explained = strangest(found)
        if m < 0:  # nothing is left to leave out
            return 0, np.inf, wrong
        alike = explained < _STRANGE * max((cost - explained) / max(2 * seen - 10, 1), 1.0)
        if alike and plausible(scene, found, twist):
            break
        both -= found.codes[m, 0] == SEEN and found.codes[m, 1] == SEEN
        for side in range(2):
            if found.codes[m, side] == SEEN:
                found.codes[m, side] = ASTRAY
                seen -= 1
        cost = settle(scene, found) if both >= least_both else np.inf
    if not np.isfinite(cost):
        return 0, np.inf, wrong
    chi_square = uncertainty(scene, found, cov_noise, cost, limits[seen])
    triangulated(scene, found)
    sum_squares(scene, found)
    velocity(T, found.T, seconds, twist)
    return seen, chi_square, wrong
