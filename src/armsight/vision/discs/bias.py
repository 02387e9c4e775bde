"""The image of a disc: an ellipse whose centre is not the image of the disc's centre (perspective bias).

A disc of radius r around P (camera's frame) with unit normal n has the dual conic r^2 (I - n n^T) - P P^T (Hartley and
Zisserman, "Multiple View Geometry", 2nd ed., 8.3: the dual of the image of a conic). Its last column is the pole of the
line at infinity, so a pinhole shows the ellipse's centre where it shows the point

    Q = P + (r^2 / P_z) (n_z n - e_z)

and Q replaces P in every projection. A lens that distorts bends the ellipse; the centre of the ellipse that
fits its rim best moves by the curvature of the distortion over the ellipse, to second order

    1/8 (tr G_k + 2 sum_l G_l,kl)     (k, l: axes in which the ellipse is a unit circle, G_l: Hessians of the distortion).

:func:`expect` predicts what both cameras see of a body's discs at a pose, with that bias and its derivatives;
:func:`centred` subtracts it. The bias depends on the orientation of the disc, so it is known once the pose is. For a
disc of unknown normal only its distribution is known: the centre seems to move by -(r^2 / z) times the part of the
optical axis e that lies in the disc, e - (n e) n, which over all directions n has the second moments 1/15 across e and
8/15 along it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Correspondences, Record
from armsight.geometry.check import checked
from armsight.geometry.pose import inverse, transform
from armsight.geometry.rotation import skew
from armsight.kernels import kernel
from armsight.vision.camera import Camera, distort
from armsight.vision.markers.disc.target import DiscTarget
from armsight.vision.rig import StereoRig

_STEP = 1e-4  # for the Hessian of the distortion, focal lengths


@kernel
def disc_image(
    fisheye: bool,
    k: Array,
    d: Array,
    P: Array,
    n: Array,
    radius: float,
    uv: Array,
    shape: Array,
    J_P: Array,
    J_n: Array,
) -> bool:
    """Project one disc; see :func:`project_discs`. Fills uv (2,), shape (3,), J_P (2, 3), J_n (2, 3).

    Returns:
        False where the disc is not all in front of the camera, or is seen edge-on; nothing is filled then.
    """
    if not P[2] > radius:
        return False
    f = radius * radius / P[2]
    Q = np.empty(3)
    for i in range(3):
        Q[i] = P[i] + f * n[2] * n[i]
    Q[2] -= f
    # The pinhole's ellipse, focal lengths: S = c c^T - C / C_33.
    c33 = radius * radius * (1.0 - n[2] * n[2]) - P[2] * P[2]
    x, y = Q[0] / Q[2], Q[1] / Q[2]
    s11 = x * x - (radius * radius * (1.0 - n[0] * n[0]) - P[0] * P[0]) / c33
    s12 = x * y - (-radius * radius * n[0] * n[1] - P[0] * P[1]) / c33
    s22 = y * y - (radius * radius * (1.0 - n[1] * n[1]) - P[1] * P[1]) / c33
    if not (s11 > 0.0 and s22 > 0.0 and s11 * s22 - s12 * s12 > 1e-6 * s11 * s22):
        return False
    xy, J, J_d = np.empty(2), np.empty((2, 3)), np.empty((2, 8))
    moved, J_x, J_y, at = np.empty(2), np.empty((2, 3)), np.empty((2, 3)), np.empty(3)
    distort(fisheye, d, Q, xy, J, J_d)
    at[0], at[1], at[2] = x + _STEP, y, 1.0
    distort(fisheye, d, at, moved, J_x, J_d)
    at[0], at[1] = x, y + _STEP
    distort(fisheye, d, at, moved, J_y, J_d)
    # The derivative of the distortion by x and y of the plane z = 1 is Q_z times that by the point's own x and y.
    a00, a01, a10, a11 = J[0, 0] * Q[2], J[0, 1] * Q[2], J[1, 0] * Q[2], J[1, 1] * Q[2]
    h = np.empty((2, 2, 2))  # Hessians: of distorted axis i by a and b
    for i in range(2):
        h[i, 0, 0] = (J_x[i, 0] - J[i, 0] * Q[2]) / _STEP
        h[i, 1, 1] = (J_y[i, 1] - J[i, 1] * Q[2]) / _STEP
        h[i, 0, 1] = h[i, 1, 0] = ((J_x[i, 1] - J[i, 1] * Q[2]) + (J_y[i, 0] - J[i, 0] * Q[2])) / (2 * _STEP)
    # L L^T = S makes the pinhole's ellipse a unit circle; B = A L the distorted one, to first order.
    l11 = np.sqrt(s11)
    l21 = s12 / l11
    l22 = np.sqrt(s22 - l21 * l21)
    b00, b01, b10, b11 = a00 * l11 + a01 * l21, a01 * l22, a10 * l11 + a11 * l21, a11 * l22
    det = b00 * b11 - b01 * b10
    if not abs(det) > 0.0:
        return False
    g = np.empty((2, 2, 2))
    for a in range(2):
        # H[L e_i, L e_j] of each distorted axis, then the axes in which the distorted ellipse is a unit circle.
        g[a, 0, 0] = h[a, 0, 0] * l11 * l11 + 2 * h[a, 0, 1] * l11 * l21 + h[a, 1, 1] * l21 * l21
        g[a, 0, 1] = g[a, 1, 0] = h[a, 0, 1] * l11 * l22 + h[a, 1, 1] * l21 * l22
        g[a, 1, 1] = h[a, 1, 1] * l22 * l22
    for i in range(2):
        for j in range(2):
            first, second = g[0, i, j], g[1, i, j]
            g[0, i, j] = (b11 * first - b01 * second) / det
            g[1, i, j] = (b00 * second - b10 * first) / det
    e0 = (g[0, 0, 0] + g[0, 1, 1] + 2 * (g[0, 0, 0] + g[1, 0, 1])) / 8
    e1 = (g[1, 0, 0] + g[1, 1, 1] + 2 * (g[0, 0, 1] + g[1, 1, 1])) / 8
    uv[0] = k[0] * (xy[0] + b00 * e0 + b01 * e1) + k[2]
    uv[1] = k[1] * (xy[1] + b10 * e0 + b11 * e1) + k[3]
    shape[0] = k[0] * k[0] * (b00 * b00 + b01 * b01)
    shape[1] = k[0] * k[1] * (b00 * b10 + b01 * b11)
    shape[2] = k[1] * k[1] * (b10 * b10 + b11 * b11)
    for i in range(2):
        normal_z = 0.0
        for j in range(3):
            J_P[i, j] = k[i] * J[i, j]
            normal_z += J[i, j] * n[j]
        for j in range(3):
            J_n[i, j] = k[i] * f * n[2] * J[i, j]
        J_n[i, 2] += k[i] * f * normal_z
        J_P[i, 2] -= k[i] * f / P[2] * (n[2] * normal_z - J[i, 2])
    return True


@kernel(
    "b1, const f8[::1], const f8[::1], f8[:, ::1], f8[:, ::1], const f8[::1], f8[:, ::1], f8[:, ::1], "
    "f8[:, :, ::1], f8[:, :, ::1]",
)
def _each(
    fisheye: bool,
    k: Array,
    d: Array,
    P: Array,
    n: Array,
    radius: Array,
    uv: Array,
    shape: Array,
    J_P: Array,
    J_n: Array,
) -> None:
    """Project discs one after the other; NaN where one has no image."""
    for i in range(len(P)):
        if not disc_image(fisheye, k, d, P[i], n[i], radius[i], uv[i], shape[i], J_P[i], J_n[i]):
            uv[i] = np.nan
            shape[i] = np.nan
            J_P[i] = np.nan
            J_n[i] = np.nan


def project_discs(camera: Camera, p: Array, normals: Array, radii_m: Array) -> tuple[Array, Array, Array, Array]:
    """Project discs to the ellipses that a camera shows, and their centres.

    Args:
        camera: the camera.
        p: (N, 3) centres of the discs, m, camera's frame.
        normals: (N, 3) unit normals of the discs, camera's frame; the sign does not matter.
        radii_m: (N,) radii, m.

    Returns:
        (N, 2) centres of the ellipses, raw px; (N, 3) S11, S12, S22 of the ellipses, px^2; (N, 2, 3) derivative of the
        centres by p; (N, 2, 3) by the normals. NaN where a disc is not all in front of the camera or seen edge-on. To
        second order in the size of the ellipse where the lens distorts, exact where it does not.
    """
    p = checked(p, (None, 3), "disc centres")
    normals = checked(normals, p.shape, "disc normals")
    radii_m = checked(radii_m, (len(p),), "disc radii")
    fisheye, k, d = camera.kernel_arguments()
    out = np.empty((len(p), 2)), np.empty((len(p), 3)), np.empty((len(p), 2, 3)), np.empty((len(p), 2, 3))
    _each(fisheye, k, d, p, normals, radii_m, *out)
    return out


#: A disc is not found where the cosine between its normal and the direction to the camera is below this.
LEAST_FACING = 0.09
#: Points count as coplanar where their third singular value is below this share of the first.
_FLAT = 1e-3


@dataclass(frozen=True, eq=False)
class Expected(Record):
    """What both cameras should see of M discs at a pose; camera 0 is left, 1 right. NaN where a disc has no image.

    Attributes:
        uv: (M, 2, 2) disc, camera: centres of the ellipses, raw px.
        bias: (M, 2, 2) centres of the ellipses less images of the centres, px.
        shape: (M, 2, 3) S11, S12, S22 of the ellipses, px^2; as if facing the camera where the normal is not known.
        radius_px: (M, 2) longer half axes of the ellipses, px.
        facing: (M, 2) cosine between a disc's normal and its direction to the camera; NaN where the normal is unknown.
        J: (M, 2, 2, 6) derivative of ``uv`` by the tangent of the pose.
        J_bias: (M, 2, 2, 6) derivative of ``bias`` by the tangent of the pose.
        J_rig: (M, 2, 2, P) derivative of ``uv`` by the rig's parameters.
        cov_bias: (M, 2, 2, 2) covariance of the bias where the normal is not known, px^2; zero where it is.
    """

    uv: Array
    bias: Array
    shape: Array
    radius_px: Array
    facing: Array
    J: Array
    J_bias: Array
    J_rig: Array
    cov_bias: Array


def bias_normals(target: DiscTarget) -> Array:
    """Return normals for the perspective bias, for which their sign does not matter.

    Returns:
        (M, 3) those given; where none is given, that of the plane of all discs; NaN where they are not coplanar.
    """
    normals = np.array(target.normals)
    unknown = np.isnan(normals[:, 0])
    centred = target.body.points - target.body.points.mean(axis=0)
    if unknown.any() and len(centred) >= 3:
        _, spread, axes = np.linalg.svd(centred)
        if spread[1] > _FLAT * spread[0] and spread[2] <= _FLAT * spread[0]:
            normals[unknown] = axes[2]
    return normals


def expect(rig: StereoRig, target: DiscTarget, T_left_body: Array) -> Expected:
    """Predict what both cameras see of a body's discs.

    Args:
        rig: the calibrated pair.
        target: the discs.
        T_left_body: (4, 4) pose of the body.
    """
    points, normals = target.body.points, bias_normals(target)
    known = np.isfinite(normals[:, 0])
    T_right_left, count = inverse(rig.T_left_right), len(points)
    uv, bias, shape = np.empty((count, 2, 2)), np.empty((count, 2, 2)), np.empty((count, 2, 3))
    facing, J, J_bias = np.empty((count, 2)), np.empty((count, 2, 2, 6)), np.empty((count, 2, 2, 6))
    J_rig, cov = np.zeros((count, 2, 2, rig.parameter_count)), np.zeros((count, 2, 2, 2))
    first = 0
    for side, camera in enumerate(rig.cameras):
        T = T_left_body if side == 0 else T_right_left @ T_left_body
        R, p = T[:3, :3], transform(T, points)
        facing[:, side] = -np.einsum("mi,mi->m", p, target.normals @ R.T) / np.linalg.norm(p, axis=1)
        n = np.where(known[:, None], normals, 0.0) @ R.T
        n[~known] = p[~known] / np.linalg.norm(p[~known], axis=1, keepdims=True)
        centre, J_p, J_camera = camera.project_jacobians(p)
        uv[:, side], shape[:, side], J_P, J_n = project_discs(camera, p, n, target.radii_m)
        uv[~known, side] = centre[~known]
        J_P[~known], J_n[~known] = J_p[~known], 0.0
        by_position = np.concatenate([np.broadcast_to(R, (count, 3, 3)), -R @ skew(points)], axis=2)
        J[:, side] = J_P @ by_position
        J[:, side, :, 3:] -= J_n @ (R @ skew(np.where(known[:, None], normals, 0.0)))
        bias[:, side], J_bias[:, side] = uv[:, side] - centre, J[:, side] - J_p @ by_position
        reach2 = (target.radii_m**2 / p[:, 2]) ** 2
        moved = reach2[:, None, None] * np.diag([1.0, 1.0, 8.0]) / 15
        cov[~known, side] = (J_p @ moved @ np.swapaxes(J_p, 1, 2))[~known]
        J_rig[:, side, :, first : first + J_camera.shape[2]] = J_camera
        first += J_camera.shape[2]
        if side == 1:
            J_rig[:, side, :, first:] = np.concatenate([-J_p, J_p @ skew(p)], axis=2)
    mean, half = (shape[..., 0] + shape[..., 2]) / 2, (shape[..., 0] - shape[..., 2]) / 2
    radius = np.sqrt(mean + np.hypot(half, shape[..., 1]))
    return Expected(uv, bias, shape, radius, facing, J, J_bias, J_rig, cov)


def centred(
    rig: StereoRig, target: DiscTarget, T_left_body: Array, cov_pose: Array, seen: Correspondences
) -> Correspondences:
    """Convert centres of ellipses to images of the discs' centres: subtract the perspective bias.

    Args:
        rig: the calibrated pair.
        target: the discs; ``seen.ids`` are rows of its body.
        T_left_body: (4, 4) approximate pose of the body.
        cov_pose: (6, 6) covariance of its tangent; it adds to the covariance of the bias.
        seen: centres of ellipses.

    Returns:
        The same correspondences less the bias, with the covariance of both. Detections whose disc would have no image
        at the pose become NaN.
    """
    expected = expect(rig, target, T_left_body)
    J = expected.J_bias[seen.ids]
    cov = seen.cov_uv + J @ cov_pose @ np.swapaxes(J, 2, 3) + expected.cov_bias[seen.ids]
    uv = seen.uv - expected.bias[seen.ids]
    return Correspondences(seen.ids, uv, np.where(np.isfinite(uv)[..., None], cov, 0.0), seen.dropped)


def visible(rig: StereoRig, expected: Expected) -> NDArray[np.bool_]:
    """(M, 2) whether a disc's ellipse lies wholly in a camera's image and its face, where known, faces it enough."""
    size = np.array([camera.image_size_px for camera in rig.cameras])
    low, high = expected.uv - expected.radius_px[..., None], expected.uv + expected.radius_px[..., None]
    inside = ((low >= -0.5) & (high <= size - 0.5)).all(axis=2)
    return np.asarray(inside & ~(expected.facing < LEAST_FACING))
