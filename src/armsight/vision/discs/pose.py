"""The pose of a body of discs from the ellipses that two cameras saw, compiled: minimum, covariance, points.

The pose minimises the whitened distance of the ellipses' centres to where the discs' ellipses would have theirs: the
perspective bias is in the model, not corrected afterwards.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from armsight.data import Array
from armsight.vision.camera import distort
from armsight.vision.discs.bias import disc_image
from armsight.vision.markers.disc.fit import factor, solve
from armsight.vision.posefit import moved

#: Code of a disc that was seen.
SEEN = 0
_STEPS = 8
#: A step that changes the cost by less than this share is the last.
_REACHED = 1e-5
#: A detection so many standard deviations off the pose is not believed, nor is the pose.
_OFF_SIGMAS = 6.0


class Scene(NamedTuple):
    """What does not change from pair to pair.

    Attributes:
        fisheye: (2,) whether a camera is a fisheye.
        k: (2, 4) intrinsics.
        d: (2, 8) distortion.
        first: (2,) where a camera's parameters begin in the rig's.
        sizes: (2,) how many parameters a camera has.
        T_right_left: (4, 4).
        cov_rig: (P, P) covariance of the rig's parameters.
        variance: of a centre beyond what the image tells, px^2.
        points: (M, 3) centres of the discs, m.
        normals: (M, 3) their normals, for the bias.
        faces: (M,) whether the normal's side is known.
        radii: (M,) m.
        signs: (M,) 1 bright, -1 dark.
    """

    fisheye: NDArray[np.bool_]
    k: Array
    d: Array
    first: NDArray[np.int64]
    sizes: NDArray[np.int64]
    T_right_left: Array
    cov_rig: Array
    variance: float
    points: Array
    normals: Array
    faces: NDArray[np.bool_]
    radii: Array
    signs: NDArray[np.int64]


class Found(NamedTuple):
    """What one pair gives; M discs, two cameras.

    Attributes:
        codes: (M, 2) what came of each.
        uv: (M, 2, 2) centres of the ellipses, raw px.
        cov_uv: (M, 2, 2, 2) from the image alone, px^2.
        shape: (M, 2, 3) ellipses, px^2.
        predicted: (M, 2, 2) where they were looked for.
        contrast: (M, 2) grey levels, kept from pair to pair; 0 where not known.
        residual: (M, 2, 2) of the pose, px.
        T: (4, 4) pose, begun with the prediction.
        H: (6, 6) information.
        cov: (6, 6) with the rig's share; the noise's share alone is the inverse of H.
        p_left: (M, 3) points, of those both cameras saw.
        cov_p: (M, 3, 3) their covariance from the pixel noise, m^2.
        by_rig: (M, 3, P) their derivative by the rig.
        whitened: (4 M,) residuals.
        J: (4 M, 6) whitened.
        J_rig: (4 M, P) whitened.
        bias: (M, 2, 2) centre of ellipse less image of centre, px.
        squares: (2,) sums of the points' squared distances from the body, m^2, and of the residuals, px^2.
    """

    codes: NDArray[np.int64]
    uv: Array
    cov_uv: Array
    shape: Array
    predicted: Array
    contrast: Array
    residual: Array
    T: Array
    H: Array
    cov: Array
    p_left: Array
    cov_p: Array
    by_rig: Array
    whitened: Array
    J: Array
    J_rig: Array
    bias: Array
    squares: Array


@numba.njit(cache=True, error_model="numpy")
def _linearise(scene: Scene, T_left: Array, found: Found, rig: bool) -> float:
    """Fill residuals and whitened J at a pose, by the rig too where asked; return the sum of squares or, behind, inf."""
    P, n, e = np.empty(3), np.empty(3), np.empty(3)
    uv, shape, J_P, J_n = np.empty(2), np.empty(3), np.empty((2, 3)), np.empty((2, 3))
    xy, J_p, J_d = np.empty(2), np.empty((2, 3)), np.empty((2, 8))
    cost = 0.0
    T_right = scene.T_right_left @ T_left
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


@numba.njit(cache=True, error_model="numpy")
def settle(scene: Scene, found: Found) -> float:
    """Minimise over the pose ``found.T``; return the sum of the squared whitened residuals, infinite without a minimum."""
    trial, H, g, xi = np.empty((4, 4)), found.H, np.empty(6), np.empty(6)
    L, scale = np.empty((6, 6)), np.empty(6)
    cost = _linearise(scene, found.T, found, False)
    for _ in range(_STEPS):
        if not np.isfinite(cost):
            return np.inf
        H[:, :] = found.J.T @ found.J
        g[:] = found.J.T @ found.whitened
        if not factor(H, L, scale):
            return np.inf
        solve(L, scale, g, xi)
        moved(found.T, xi, trial)
        new = _linearise(scene, trial, found, False)
        if not new <= cost + _REACHED * (1.0 + cost):
            return np.inf  # from a prediction that good a full step goes down; else the slow way is taken
        done = abs(cost - new) <= _REACHED * (1.0 + cost)
        found.T[:, :] = trial
        cost = new
        if done:
            return _linearise(scene, found.T, found, True)
    return np.inf


@numba.njit(cache=True, error_model="numpy")
def uncertainty(scene: Scene, found: Found, cov_noise: Array, chi_square: float, limit: float) -> float:
    """Fill covariances; return the residuals' chi-square, above ``limit`` less what a wrong calibration explains.

    The rig's share goes through the same fit: gain = H^-1 J^T J_rig. Chi-square: residuals weighted by the inverse of
    I + B cov_rig B^T with B the part of J_rig that no pose explains (Woodbury's identity), as in ``locate``.
    """
    J, J_rig = found.J, found.J_rig
    for row in range(len(found.whitened)):
        if found.codes[row // 4, (row // 2) % 2] != SEEN:
            J_rig[row] = 0.0
    found.H[:, :] = J.T @ J
    cov_noise[:, :] = np.linalg.inv(found.H)
    gain = cov_noise @ (J.T @ J_rig)
    found.cov[:, :] = gain @ scene.cov_rig @ gain.T
    if chi_square <= limit:
        return chi_square
    B = J_rig - J @ gain
    v = B.T @ found.whitened
    M = np.eye(len(scene.cov_rig)) + scene.cov_rig @ (B.T @ B)
    explained = v @ np.linalg.solve(M, scene.cov_rig @ v)
    return float(chi_square - explained)


@numba.njit(cache=True, error_model="numpy")
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


@numba.njit(cache=True, error_model="numpy")
def velocity(T_from: Array, T_to: Array, seconds: float, twist: Array) -> None:
    """Fill the twist (6,) that :func:`~armsight.vision.posefit.moved` carries one pose into the other with."""
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


@numba.njit(cache=True, error_model="numpy")
def triangulated(scene: Scene, found: Found) -> None:
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


@numba.njit(cache=True, error_model="numpy")
def sum_squares(scene: Scene, found: Found) -> None:
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


@numba.njit(cache=True, error_model="numpy")
def believable(scene: Scene, found: Found) -> bool:
    """Tell whether no residual is larger than noise and calibration together make it."""
    C, J_rig = scene.cov_rig, found.J_rig
    for row in range(len(found.whitened)):
        r = found.whitened[row] * found.whitened[row]
        if r > _OFF_SIGMAS * _OFF_SIGMAS and r > _OFF_SIGMAS * _OFF_SIGMAS * (1.0 + J_rig[row] @ (C @ J_rig[row])):
            return False
    return True
