"""The pose of a body from detections of two known cameras: one compiled Levenberg-Marquardt.

The same cost as :mod:`~armsight.vision.pose.bundle` with everything but one pose held, for the functions that solve it
thousands of times: locating, trying mirror solutions, distinguishing bodies.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Correspondences, Ids, Record
from armsight.geometry.matrix import product, solved_vector
from armsight.geometry.pose import inverse
from armsight.kernels import kernel
from armsight.vision.camera import Camera, distort, pair_arguments
from armsight.vision.pose.bundle import CAUCHY_SCALE

_STEPS = 40
_DONE = 1e-8  # relative decrease of the cost


@dataclass(frozen=True, eq=False)
class PixelObservations(Record):
    """Detections of one body in one shot, one row each."""

    camera: Ids  #: (N,) 0 left, 1 right
    point: Ids  #: (N,) row of the body's points
    uv: Array  #: (N, 2) raw pixels
    cov_uv: Array  #: (N, 2, 2) their covariance, px^2, positive definite

    @staticmethod
    def of(seen: Correspondences, sigma_px: float) -> PixelObservations:
        """Flatten a shot's correspondences; ``sigma_px`` adds to the image's own covariance."""
        rows, sides = np.nonzero(seen.seen)
        cov = seen.cov_uv[rows, sides] + max(sigma_px, 1e-6) ** 2 * np.eye(2)
        return PixelObservations(sides.astype(np.int64), seen.ids[rows], seen.uv[rows, sides], cov)

    def select(self, keep: NDArray[np.bool_]) -> PixelObservations:
        """Return the rows where ``keep`` (N,) is true."""
        return PixelObservations(self.camera[keep], self.point[keep], self.uv[keep], self.cov_uv[keep])


@dataclass(frozen=True, eq=False)
class PoseFit(Record):
    """The minimum of a pose fit."""

    T_left_body: Array  #: (4, 4) the pose
    residuals_px: Array  #: (N, 2) detection minus projection
    distance2: Array  #: (N,) squared distance in standard deviations
    information: Array  #: (6, 6) of the tangent [translation m; rotation rad], perturbation on the right
    cost: float  #: the minimum: the sum of the squared distances, or their Cauchy loss


def fit_pose(
    cameras: tuple[Camera, Camera],
    T_left_right: Array,
    points: Array,
    observations: PixelObservations,
    start: Array,
    *,
    robust: bool,
    steps: int = _STEPS,
) -> PoseFit | None:
    """Minimise the whitened pixel distance of all observations over the pose of the body.

    Args:
        cameras: left and right.
        T_left_right: (4, 4) pose of the right camera in the left one's frame.
        points: (M, 3) points of the body, m.
        observations: N detections.
        start: (4, 4) T_left_body at the start.
        robust: Cauchy loss as in bundle adjustment, else plain least squares.
        steps: iterations at the most.

    Returns:
        The minimum next to the start, or None where the start puts a point behind its camera or the
        observations do not determine a pose.
    """
    T, p = np.array(start), points[observations.point]
    n = len(p)
    residuals, d2, H = np.empty((n, 2)), np.empty(n), np.empty((6, 6))
    cost = _fit(
        *pair_arguments(cameras), inverse(T_left_right), p, observations.camera, observations.uv,
        observations.cov_uv, T, robust, steps, residuals, d2, H,
    )  # fmt: skip
    return PoseFit(T, residuals, d2, H, cost) if np.isfinite(cost) else None


def whitened(
    cameras: tuple[Camera, Camera],
    T_left_right: Array,
    points: Array,
    observations: PixelObservations,
    T_left_body: Array,
) -> tuple[Array, Array, Array]:
    """Differentiate the projections of all observations, in standard deviations of each.

    ``T_left_right``: (4, 4) pose of the right camera in the left one's frame; ``points``: (M, 3) points of the body, m;
    ``observations``: N detections; ``T_left_body``: (4, 4) the pose, with every point before its camera. Returns (N, 2, 2)
    matrices W, W^T W being the inverse of a detection's covariance; (2N, 6) W times the derivative by the pose's tangent
    (perturbation on the right); (2N, P) W times that by the parameters of the rig.
    """
    n, counts = len(observations.point), np.array([camera.distortion.size for camera in cameras])
    W, by_pose, by_rig = np.zeros((n, 2, 2)), np.empty((2 * n, 6)), np.zeros((2 * n, 8 + counts.sum() + 6))
    differentiate(
        *pair_arguments(cameras), counts, inverse(T_left_right), points[observations.point], observations.camera,
        observations.uv, observations.cov_uv, np.array(T_left_body),
        W, np.empty((n, 2)), by_pose, by_rig,
    )  # fmt: skip
    return W, by_pose, by_rig


@kernel
def _invert(cov: Array, weight: Array) -> None:
    """Fill the inverses of covariances (N, 2, 2)."""
    for n in range(len(cov)):
        det = cov[n, 0, 0] * cov[n, 1, 1] - cov[n, 0, 1] * cov[n, 1, 0]
        weight[n, 0, 0], weight[n, 1, 1] = cov[n, 1, 1] / det, cov[n, 0, 0] / det
        weight[n, 0, 1], weight[n, 1, 0] = -cov[n, 0, 1] / det, -cov[n, 1, 0] / det


@kernel(inline="always")
def _to_camera(M: Array, p: Array, q: Array) -> None:
    """Fill q (3,), a point p (3,) of the body in the frame of the camera with T_camera_body M (4, 4)."""
    for i in range(3):
        q[i] = M[i, 0] * p[0] + M[i, 1] * p[1] + M[i, 2] * p[2] + M[i, 3]


@kernel(inline="always")
def _by_rotation(J: Array, p: Array) -> None:
    """Fill the last three of J (6,), a pixel's derivative by the rotation of the body, from the first three."""
    J[3] = J[2] * p[1] - J[1] * p[2]
    J[4] = J[0] * p[2] - J[2] * p[0]
    J[5] = J[1] * p[0] - J[0] * p[1]


@kernel(
    "b1[::1], f8[:, ::1], f8[:, ::1], i8[::1], f8[:, ::1], f8[:, ::1], const i8[::1], const f8[:, ::1], "
    "const f8[:, :, ::1], f8[:, ::1], f8[:, :, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1]"
)
def differentiate(
    fisheye: NDArray[np.bool_], k: Array, d: Array, counts: Ids, T_right_left: Array, p: Array, camera: Ids, uv: Array,
    cov: Array, T: Array, W: Array, residuals: Array, by_pose: Array, by_rig: Array,
) -> bool:  # fmt: skip
    """Fill what :func:`whitened` returns, and the residuals (N, 2), px; return whether all points are before them."""
    xy, J_p, J_d, q = np.empty(2), np.empty((2, 3)), np.empty((2, 8)), np.empty(3)
    Ts, starts, rig = np.stack((T, product(T_right_left, T))), (0, 4 + counts[0]), 8 + counts[0] + counts[1]
    for n in range(len(p)):
        c = camera[n]
        M = Ts[c]
        _to_camera(M, p[n], q)
        if q[2] <= 0.0:
            return False
        distort(fisheye[c], d[c], q, xy, J_p, J_d)
        pose, shared = by_pose[2 * n : 2 * n + 2], by_rig[2 * n : 2 * n + 2]
        for i in range(2):
            residuals[n, i] = uv[n, i] - k[c, i] * xy[i] - k[c, 2 + i]
            J_p[i] *= k[c, i]
            for j in range(3):
                pose[i, j] = J_p[i, 0] * M[0, j] + J_p[i, 1] * M[1, j] + J_p[i, 2] * M[2, j]
            _by_rotation(pose[i], p[n])
            start = starts[c]
            shared[i, start + i], shared[i, start + 2 + i] = xy[i], 1.0
            for j in range(counts[c]):
                shared[i, start + 4 + j] = k[c, i] * J_d[i, j]
            if c == 1:
                for j in range(3):
                    shared[i, rig + j] = -J_p[i, j]
                shared[i, rig + 3] = J_p[i, 1] * q[2] - J_p[i, 2] * q[1]
                shared[i, rig + 4] = J_p[i, 2] * q[0] - J_p[i, 0] * q[2]
                shared[i, rig + 5] = J_p[i, 0] * q[1] - J_p[i, 1] * q[0]
        first = np.sqrt(cov[n, 0, 0])  # the Cholesky factor of the covariance, inverted
        across = cov[n, 1, 0] / first
        second = np.sqrt(cov[n, 1, 1] - across * across)
        W[n, 0, 0], W[n, 1, 0], W[n, 1, 1] = 1.0 / first, -across / (first * second), 1.0 / second
        for J in (pose, shared):
            for j in range(J.shape[1]):
                J[1, j] = W[n, 1, 0] * J[0, j] + W[n, 1, 1] * J[1, j]
                J[0, j] *= W[n, 0, 0]
    return True


@kernel
def _assemble(
    fisheye: NDArray[np.bool_], k: Array, d: Array, T_right_left: Array, p: Array, camera: Ids, uv: Array, weight: Array,
    T: Array, robust: bool, residuals: Array, d2: Array, H: Array, g: Array,
) -> float:  # fmt: skip
    """Fill residuals, squared distances, normal equations; return the cost, infinite behind a camera."""
    H[:, :] = 0.0
    g[:] = 0.0
    cost, c2 = 0.0, CAUCHY_SCALE * CAUCHY_SCALE
    xy, J_p, J_d, q, J = np.empty(2), np.empty((2, 3)), np.empty((2, 8)), np.empty(3), np.empty((2, 6))
    Ts = np.stack((T, product(T_right_left, T)))
    for n in range(p.shape[0]):
        c = camera[n]
        M = Ts[c]
        _to_camera(M, p[n], q)
        if q[2] <= 0.0:
            return np.inf
        distort(fisheye[c], d[c], q, xy, J_p, J_d)
        for i in range(2):
            residuals[n, i] = uv[n, i] - k[c, i] * xy[i] - k[c, 2 + i]
            for j in range(3):
                J[i, j] = k[c, i] * (J_p[i, 0] * M[0, j] + J_p[i, 1] * M[1, j] + J_p[i, 2] * M[2, j])
            _by_rotation(J[i], p[n])
        r0, r1 = residuals[n, 0], residuals[n, 1]
        w00, w01, w11 = weight[n, 0, 0], weight[n, 0, 1], weight[n, 1, 1]
        d2[n] = w00 * r0 * r0 + 2 * w01 * r0 * r1 + w11 * r1 * r1
        s = 1.0 / (1.0 + d2[n] / c2) if robust else 1.0
        cost += c2 * np.log1p(d2[n] / c2) if robust else d2[n]
        for i in range(6):
            a0 = s * (w00 * J[0, i] + w01 * J[1, i])
            a1 = s * (w01 * J[0, i] + w11 * J[1, i])
            g[i] += a0 * r0 + a1 * r1
            for j in range(i + 1):
                H[i, j] += a0 * J[0, j] + a1 * J[1, j]
    for i in range(6):
        for j in range(i):
            H[j, i] = H[i, j]
    return cost


@kernel("const f8[:, ::1], f8[::1], f8[:, ::1]")
def moved(T: Array, xi: Array, out: Array) -> None:
    """Move a pose by a tangent, on the right: T exp(xi) to first order, and an exact rotation matrix."""
    angle = np.sqrt(xi[3] * xi[3] + xi[4] * xi[4] + xi[5] * xi[5])
    a = np.sin(angle) / angle if angle > 1e-8 else 1.0
    b = (1.0 - np.cos(angle)) / (angle * angle) if angle > 1e-4 else 0.5
    x, y, z = xi[3], xi[4], xi[5]
    E = np.array(
        [
            [1 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y],
            [b * x * y + a * z, 1 - b * (x * x + z * z), b * y * z - a * x],
            [b * x * z - a * y, b * y * z + a * x, 1 - b * (x * x + y * y)],
        ]
    )
    for i in range(3):
        out[i, 3] = T[i, 3] + T[i, 0] * xi[0] + T[i, 1] * xi[1] + T[i, 2] * xi[2]
        for j in range(3):
            out[i, j] = T[i, 0] * E[0, j] + T[i, 1] * E[1, j] + T[i, 2] * E[2, j]
    out[3, :] = T[3, :]


@kernel(
    "b1[::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], const i8[::1], const f8[:, ::1], const f8[:, :, ::1], "
    "f8[:, ::1], b1, i8, f8[:, ::1], f8[::1], f8[:, ::1]"
)
def _fit(
    fisheye: NDArray[np.bool_], k: Array, d: Array, T_right_left: Array, p: Array, camera: Ids, uv: Array, cov: Array,
    T: Array, robust: bool, steps: int, residuals: Array, d2: Array, H: Array,
) -> float:  # fmt: skip
    """Levenberg-Marquardt; T is replaced by the minimum; residuals, distances and information are those of the result."""
    g, damped, trial = np.empty(6), np.empty((6, 6)), np.empty((4, 4))
    weight = np.empty(cov.shape)
    _invert(cov, weight)
    new_H, new_g, new_r, new_d2 = np.empty((6, 6)), np.empty(6), np.empty_like(residuals), np.empty_like(d2)
    cost = _assemble(fisheye, k, d, T_right_left, p, camera, uv, weight, T, robust, residuals, d2, H, g)
    damping = 1e-4
    for _ in range(steps):
        if not np.isfinite(cost) or damping > 1e12:
            break
        damped[:, :] = H
        for i in range(6):
            damped[i, i] += damping * H[i, i] + 1e-300
        xi = solved_vector(damped, g)
        if np.isnan(xi[0]):
            return np.inf
        moved(T, xi, trial)
        new = _assemble(fisheye, k, d, T_right_left, p, camera, uv, weight, trial, robust, new_r, new_d2, new_H, new_g)
        if new <= cost:
            done = cost - new <= _DONE * new
            T[:, :], residuals[:, :], d2[:], H[:, :], g[:] = trial, new_r, new_d2, new_H, new_g
            cost, damping = new, max(damping / 10, 1e-12)
            if done:
                break
        else:
            damping *= 10
    return cost
