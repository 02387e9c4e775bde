"""The image of a disc: an ellipse whose centre is not the image of the disc's centre (perspective bias).

A disc of radius r around P (camera's frame) with unit normal n has the dual conic r^2 (I - n n^T) - P P^T (Hartley and
Zisserman, "Multiple View Geometry", 2nd ed., 8.3: the dual of the image of a conic). Its last column is the pole of the
line at infinity, so a pinhole shows the ellipse's centre where it shows the point

    Q = P + (r^2 / P_z) (n_z n - e_z)

and Q replaces P in every projection. A lens that distorts bends the ellipse; the centre of the ellipse that
fits its rim best moves by the curvature of the distortion over the ellipse, to second order

    1/8 (tr G_k + 2 sum_l G_l,kl)     (k, l: axes in which the ellipse is a unit circle, G_l: Hessians of the distortion).

Where that is more than _BENT_PX, :func:`project_discs` fits the ellipse to points of the projected rim instead.

:func:`expect` predicts what both cameras see of a body's discs at a pose, with that bias and its derivatives;
:func:`centred` subtracts it. The bias depends on the orientation of the disc, so it is known once the pose is. For a
disc of unknown normal only its distribution is known: the centre seems to move by -(r^2 / z) times the part of the
optical axis e that lies in the disc, e - (n e) n, which over all directions n has the second moments 1/15 across e and
8/15 along it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Correspondences, Record
from armsight.geometry.check import checked
from armsight.geometry.matrix import applied, dot
from armsight.geometry.pose import inverse, transform
from armsight.kernels import kernel
from armsight.vision.camera import Camera, distort, pair_arguments
from armsight.vision.markers.disc.fit import factor, solve
from armsight.vision.markers.discs import DiscTarget
from armsight.vision.rig import StereoRig

_STEP = 1e-4  # for the Hessian of the distortion, focal lengths
#: A share of the lens in the bias beyond which second order is not enough, px; points of the rim, and steps of its fit.
_BENT_PX, _RIM, _RIM_STEPS = 0.05, 24, 3
#: A fisheye's disc is projected where the cosine between its normal and its direction is above this.
_LEAST_SIDEWAYS = 0.05
_RIM_COS, _RIM_SIN = np.cos(2 * np.pi * np.arange(_RIM) / _RIM), np.sin(2 * np.pi * np.arange(_RIM) / _RIM)


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
    """Project one disc as :func:`project_discs` does, into uv (2,), shape (3,), J_P (2, 3), J_n (2, 3), and return True.

    Nothing is filled where the disc is not all in front of the camera, or is seen edge-on.
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


@kernel
def _sideways(k: Array, d: Array, P: Array, n: Array, radius: float, uv: Array, shape: Array, J_P: Array) -> bool:
    """Project a disc that only a fisheye sees, 90 degrees off the axis or more, to first order; False if it is edge-on."""
    distance = np.sqrt(P[0] * P[0] + P[1] * P[1] + P[2] * P[2])
    facing = abs(P[0] * n[0] + P[1] * n[1] + P[2] * n[2]) / distance
    if not (distance > 2.0 * radius and facing > _LEAST_SIDEWAYS and np.hypot(P[0], P[1]) > radius):
        return False
    xy, J_d = np.empty(2), np.empty((2, 8))
    distort(True, d, P, xy, J_P, J_d)
    for i in range(2):
        uv[i] = k[i] * xy[i] + k[2 + i]
        for j in range(3):
            J_P[i, j] *= k[i]
    for i in range(2):
        for j in range(i, 2):  # S = r^2 J (I - n n^T) J^T
            total, along_i, along_j = 0.0, 0.0, 0.0
            for m in range(3):
                total += J_P[i, m] * J_P[j, m]
                along_i += J_P[i, m] * n[m]
                along_j += J_P[j, m] * n[m]
            shape[i + j] = radius * radius * (total - along_i * along_j)
    return True


@kernel
def _refine(fisheye: bool, k: Array, d: Array, P: Array, n: Array, radius: float, uv: Array, shape: Array) -> None:
    """Fit the ellipse uv (2,), shape (3,) to the projected rim, point by point, as the image's fit does: by distance."""
    a, b, rim, xy, at = np.zeros(3), np.empty(3), np.empty((_RIM, 2)), np.empty(2), np.empty(3)
    J_p, J_d = np.empty((2, 3)), np.empty((2, 8))
    least = 0
    for i in range(1, 3):
        least = i if abs(n[i]) < abs(n[least]) else least
    for i in range(3):
        a[i] = (1.0 if i == least else 0.0) - n[least] * n[i]
    length = np.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])
    for i in range(3):
        a[i] /= length
    for i in range(3):
        b[i] = n[(i + 1) % 3] * a[(i + 2) % 3] - n[(i + 2) % 3] * a[(i + 1) % 3]
    for m in range(_RIM):
        for i in range(3):
            at[i] = P[i] + radius * (_RIM_COS[m] * a[i] + _RIM_SIN[m] * b[i])
        distort(fisheye, d, at, xy, J_p, J_d)
        rim[m, 0], rim[m, 1] = k[0] * xy[0] + k[2], k[1] * xy[1] + k[3]
    H, g, L, scale, x, J = np.empty((5, 5)), np.empty(5), np.empty((5, 5)), np.empty(5), np.empty(5), np.empty(5)
    for _ in range(_RIM_STEPS):
        det = shape[0] * shape[2] - shape[1] * shape[1]
        m11, m12, m22 = shape[2] / det, -shape[1] / det, shape[0] / det
        H[:, :] = 0.0
        g[:] = 0.0
        for m in range(_RIM):
            u, v = rim[m, 0] - uv[0], rim[m, 1] - uv[1]
            before, after = rim[m - 1], rim[(m + 1) % _RIM]
            weight = np.hypot(after[0] - before[0], after[1] - before[1])  # the rim's length
            mu, mv = m11 * u + m12 * v, m12 * u + m22 * v
            s, slope = np.sqrt(u * mu + v * mv), np.hypot(mu, mv)
            inside = (1.0 - s) * s / slope
            J[0], J[1], J[2], J[3] = mu / slope, mv / slope, -u * u / (2 * slope), -u * v / slope
            J[4] = -v * v / (2 * slope)
            for i in range(5):
                g[i] -= weight * J[i] * inside
                for j in range(i + 1):
                    H[i, j] += weight * J[i] * J[j]
        if not factor(H, L, scale):
            return
        solve(L, scale, g, x)
        m11, m12, m22 = m11 + x[2], m12 + x[3], m22 + x[4]
        det = m11 * m22 - m12 * m12
        if not (m11 > 0.0 and det > 0.0):
            return
        uv[0] += x[0]
        uv[1] += x[1]
        shape[0], shape[1], shape[2] = m22 / det, -m12 / det, m11 / det


@kernel(
    "b1, const f8[::1], const f8[::1], f8[:, ::1], f8[:, ::1], const f8[::1], f8[:, ::1], f8[:, ::1], "
    "f8[:, :, ::1], f8[:, :, ::1]"
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
    xy, J_p, J_d, Q = np.empty(2), np.empty((2, 3)), np.empty((2, 8)), np.empty(3)
    for i in range(len(P)):
        if not disc_image(fisheye, k, d, P[i], n[i], radius[i], uv[i], shape[i], J_P[i], J_n[i]):
            if fisheye and _sideways(k, d, P[i], n[i], radius[i], uv[i], shape[i], J_P[i]):
                _refine(fisheye, k, d, P[i], n[i], radius[i], uv[i], shape[i])
                J_n[i] = 0.0
                continue
            uv[i] = np.nan
            shape[i] = np.nan
            J_P[i] = np.nan
            J_n[i] = np.nan
            continue
        f = radius[i] * radius[i] / P[i, 2]
        for j in range(3):
            Q[j] = P[i, j] + f * n[i, 2] * n[i, j]
        Q[2] -= f
        distort(fisheye, d, Q, xy, J_p, J_d)
        if np.hypot(uv[i, 0] - k[0] * xy[0] - k[2], uv[i, 1] - k[1] * xy[1] - k[3]) > _BENT_PX:
            _refine(fisheye, k, d, P[i], n[i], radius[i], uv[i], shape[i])


def project_discs(camera: Camera, p: Array, normals: Array, radii_m: Array) -> tuple[Array, Array, Array, Array]:
    """Project discs to the ellipses that a camera shows, and their centres.

    ``p``: (N, 3) centres of the discs, m, camera's frame. ``normals``: (N, 3) unit normals of the discs, camera's frame;
    the sign does not matter. ``radii_m``: (N,) radii, m. Returns (N, 2) centres of the ellipses, raw px; (N, 3) S11, S12,
    S22 of the ellipses, px^2; (N, 2, 3) derivative of the centres by p; (N, 2, 3) by the normals. NaN where a disc is not
    all in front of the camera or seen edge-on. The derivatives leave out the lens's curvature over the ellipse.
    """
    p = checked(p, (None, 3), "disc centres")
    normals = checked(normals, p.shape, "disc normals")
    radii_m = checked(radii_m, (len(p),), "disc radii")
    fisheye, k, d = camera.kernel_arguments()
    out = np.empty((len(p), 2)), np.empty((len(p), 3)), np.empty((len(p), 2, 3)), np.empty((len(p), 2, 3))
    _each(fisheye, k, d, p, normals, radii_m, *out)
    return out


def disc_bias(camera: Camera, T_camera_board: Array, points: Array, radius_m: float) -> Array:
    """Return by how much the centres of the ellipses of a board's discs are off the images of their middles.

    ``T_camera_board``: (4, 4) pose of the board, whose discs face along z; ``points``: (N, 3) the discs' middles, m, board
    frame. Returns (N, 2) px; zero where a disc has no ellipse.
    """
    p = transform(T_camera_board, points)
    normals = np.tile(T_camera_board[:3, 2], (len(p), 1))
    return np.nan_to_num(project_discs(camera, p, normals, np.full(len(p), radius_m))[0] - camera.project(p))


def apparent_radii(camera: Camera, T_camera_board: Array, points: Array, shape: Array, about_m: float) -> Array:
    """Return (N,) which radius, m, the ellipse of each disc of a board has according to its area.

    ``T_camera_board``: (4, 4) pose of the board, whose discs face along z; ``points``: (N, 3) the discs' middles, m, board
    frame; ``shape``: (N, 3) S11, S12, S22 of the ellipses, px^2; ``about_m``: a radius of about the right size.
    """
    p = transform(T_camera_board, points)
    normals = np.tile(T_camera_board[:3, 2], (len(p), 1))
    expected = project_discs(camera, p, normals, np.full(len(p), about_m))[1]
    areas2 = [s[:, 0] * s[:, 2] - s[:, 1] ** 2 for s in (shape, expected)]
    return np.asarray(about_m * (areas2[0] / areas2[1]) ** 0.25)


#: A disc is not found where the cosine between its normal and the direction to the camera is below this.
LEAST_FACING = 0.09


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
        cov_bias: (M, 2, 2, 2) covariance of the bias where the normal is not known, px^2; zero where it is.
    """

    uv: Array
    bias: Array
    shape: Array
    radius_px: Array
    facing: Array
    J: Array
    cov_bias: Array


@kernel(
    "b1[::1], f8[:, ::1], f8[:, ::1], f8[:, :, ::1], const f8[:, ::1], const f8[:, ::1], const f8[:, ::1], const f8[::1], "
    "f8[:, :, ::1], f8[:, :, ::1], f8[:, :, ::1], f8[:, ::1], f8[:, ::1], f8[:, :, :, ::1], f8[:, :, :, ::1]"
)
def _expect(
    fisheye: NDArray[np.bool_], k: Array, d: Array, Ts: Array, points: Array, faces: Array, normals: Array, radii: Array,
    uv: Array, bias: Array, shape: Array, radius_px: Array, facing: Array, J: Array, cov: Array,
) -> None:  # fmt: skip
    """Fill :class:`Expected` camera by camera, whose poses of the body are Ts (2, 4, 4).

    ``faces``: the discs' normals, NaN where unknown; ``normals``: those for the bias.
    """
    count, xy, J_p, J_d = len(points), np.empty(2), np.empty((2, 3)), np.empty((2, 8))
    P, n, J_P, J_n = np.empty((count, 3)), np.empty((count, 3)), np.empty((count, 2, 3)), np.empty((count, 2, 3))
    for side in range(2):
        R, focal, where = Ts[side, :3, :3].copy(), k[side, :2], k[side, 2:]
        for m in range(count):
            P[m] = applied(R, points[m]) + Ts[side, :3, 3]
            far = np.sqrt(dot(P[m], P[m]))
            facing[side, m] = -dot(P[m], applied(R, faces[m])) / far
            n[m] = applied(R, normals[m]) if np.isfinite(normals[m, 0]) else P[m] / far
        _each(fisheye[side], k[side], d[side], P, n, radii, uv[side], shape[side], J_P, J_n)
        for m in range(count):
            p, b, c = points[m], np.zeros(3), shape[side, m]
            distort(fisheye[side], d[side], P[m], xy, J_p, J_d)
            for i in range(2):
                scale = focal[i] if fisheye[side] or P[m, 2] > 0.0 else np.nan
                J_p[i] *= scale
                xy[i] = scale * xy[i] + where[i]
            cov[side, m] = 0.0
            if np.isfinite(normals[m, 0]):
                b[:] = normals[m]
            else:
                uv[side, m], J_P[m], J_n[m] = xy, J_p, 0.0
                reach2 = (radii[m] * radii[m] / P[m, 2]) ** 2 / 15.0
                for i in range(2):
                    for j in range(2):
                        across = J_p[i, 0] * J_p[j, 0] + J_p[i, 1] * J_p[j, 1]
                        cov[side, m, i, j] = reach2 * (across + 8.0 * J_p[i, 2] * J_p[j, 2])
            radius_px[side, m] = np.sqrt((c[0] + c[2]) / 2 + np.hypot((c[0] - c[2]) / 2, c[1]))
            for i in range(2):
                bias[side, m, i] = uv[side, m, i] - xy[i]
                g, e, by = applied(R.T, J_P[m, i]), applied(R.T, J_n[m, i]), J[side, m, i]
                by[:3] = g
                by[3] = g[2] * p[1] - g[1] * p[2] + e[2] * b[1] - e[1] * b[2]
                by[4] = g[0] * p[2] - g[2] * p[0] + e[0] * b[2] - e[2] * b[0]
                by[5] = g[1] * p[0] - g[0] * p[1] + e[1] * b[0] - e[0] * b[1]


def expect(rig: StereoRig, target: DiscTarget, T_left_body: Array) -> Expected:
    """Predict what both cameras see of a body's discs at a pose (4, 4)."""
    points, faces, radii = (np.ascontiguousarray(a) for a in (target.body.points, target.normals, target.radii_m))
    Ts = np.stack([T_left_body, inverse(rig.T_left_right) @ T_left_body])
    out = [np.empty((2, len(radii), *shape)) for shape in ((2,), (2,), (3,), (), (), (2, 6), (2, 2))]
    _expect(*pair_arguments(rig.cameras), Ts, points, faces, target.bias_normals, radii, *out)
    return Expected(*(np.swapaxes(filled, 0, 1) for filled in out))


def centred(rig: StereoRig, target: DiscTarget, T_left_body: Array, seen: Correspondences) -> Correspondences:
    """Convert centres of ellipses to images of the discs' centres: subtract the perspective bias.

    ``target``: the discs; ``seen.ids`` are rows of its body. ``T_left_body``: (4, 4) pose of the body, the one that is
    estimated from the result: an error of it is none of the detections', for the bias follows the estimate. ``seen``:
    centres of ellipses. Returns the same correspondences less the bias, with the covariance of both, as far as the normals
    are not known. Detections whose disc would have no image at the pose become NaN.
    """
    expected = expect(rig, target, T_left_body)
    cov = seen.cov_uv + expected.cov_bias[seen.ids]
    uv = seen.uv - expected.bias[seen.ids]
    return replace(seen, uv=uv, cov_uv=np.where(np.isfinite(uv)[..., None], cov, 0.0))


def visible(rig: StereoRig, expected: Expected) -> NDArray[np.bool_]:
    """(M, 2) whether a disc's ellipse lies wholly in a camera's image and its face, where known, faces it enough."""
    size = np.array([camera.image_size_px for camera in rig.cameras])
    low, high = expected.uv - expected.radius_px[..., None], expected.uv + expected.radius_px[..., None]
    inside = ((low >= -0.5) & (high <= size - 0.5)).all(axis=2)
    return np.asarray(inside & ~(expected.facing < LEAST_FACING))
