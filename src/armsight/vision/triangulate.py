"""Optimal triangulation of matched points on raw pixels, through the distortion.

Minimises the covariance-weighted pixel distance in both images (the maximum-likelihood point; Hartley and Sturm,
"Triangulation", 1997, here by Gauss-Newton so that any distortion and any covariance is allowed).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Body, Correspondences, Dropped, Ids, Points
from armsight.geometry.pose import inverse
from armsight.kernels import kernel
from armsight.vision.camera import distort, pair_arguments
from armsight.vision.rig import StereoRig

_STEPS = 10
#: A minimum is reached by a step that lowers chi-square by less than this: a thousandth of a standard deviation; the
#: step after it would be a hundred times smaller at least.
_REACHED = 1e-6
#: A pivot of the normal equations below this share of its diagonal leaves a direction undetermined.
_SINGULAR = 1e-15
#: Cosine of the angle, 8 degrees, within which a point must lie of the ray of its pixel.
_LOOKING = 0.99


def midpoints(rig: StereoRig, uv_left: Array, uv_right: Array) -> Array:
    """Return the points halfway between the two rays of each pair of raw pixels.

    ``uv_left``: (N, 2) raw pixels; ``uv_right``: (N, 2) raw pixels of the same points. Returns (N, 3) points, m, left
    frame; NaN where the rays are parallel or come closest behind a camera.
    """
    p = np.empty((len(uv_left), 3))
    _between(rig.left.unproject(uv_left), rig.right.unproject(uv_right), np.array(rig.T_left_right), p)
    return p


@kernel("f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1]")
def _between(rays_left: Array, rays_right: Array, T: Array, p: Array) -> None:
    """Fill p (N, 3) with the points halfway between rays (N, 3), each in its camera's frame; T is T_left_right."""
    for n in range(len(p)):
        a = rays_left[n]
        b0, b1, b2 = rays_right[n]
        bx = T[0, 0] * b0 + T[0, 1] * b1 + T[0, 2] * b2
        by = T[1, 0] * b0 + T[1, 1] * b1 + T[1, 2] * b2
        bz = T[2, 0] * b0 + T[2, 1] * b1 + T[2, 2] * b2
        tx, ty, tz = T[0, 3], T[1, 3], T[2, 3]
        ab = a[0] * bx + a[1] * by + a[2] * bz
        at, bt = a[0] * tx + a[1] * ty + a[2] * tz, bx * tx + by * ty + bz * tz
        along_a, along_b = (at - ab * bt) / (1.0 - ab * ab), (ab * at - bt) / (1.0 - ab * ab)
        if along_a > 0.0 and along_b > 0.0 and np.isfinite(along_a + along_b):
            p[n, 0] = (along_a * a[0] + tx + along_b * bx) / 2.0
            p[n, 1] = (along_a * a[1] + ty + along_b * by) / 2.0
            p[n, 2] = (along_a * a[2] + tz + along_b * bz) / 2.0
        else:
            p[n] = np.nan


def optimal_points(rig: StereoRig, uv: Array, cov_uv: Array) -> tuple[Array, Array, Array]:
    """Triangulate pairs of raw pixels uv (N, 2, 2), point and camera, of positive definite cov_uv (N, 2, 2, 2), px^2.

    Returns (N, 3) points, m, left frame, NaN where the rays do not meet before both cameras; (N, 3, 3) covariance from the
    pixel noise, m^2; (N, 3, P) derivative by the rig's parameters.
    """
    T, n = np.array(rig.T_left_right), len(uv)
    rays = rig.left.unproject(uv[:, 0]), rig.right.unproject(uv[:, 1])
    counts = np.array([camera.distortion.size for camera in rig.cameras])
    p, cov, by_rig = np.empty((n, 3)), np.full((n, 3, 3), np.nan), np.full((n, 3, rig.parameter_count), np.nan)
    _between(*rays, T, p)
    _minimise(
        *pair_arguments(rig.cameras), counts, inverse(T), np.ascontiguousarray(uv, dtype=np.float64),
        np.ascontiguousarray(cov_uv, dtype=np.float64), *rays, p, cov, by_rig,
    )  # fmt: skip
    return p, cov, by_rig


@kernel(forceinline=True)
def _to_right(T_right_left: Array, p: Array, q: Array) -> None:
    """Fill q (3,), a point p (3,) of the left frame in the right one."""
    for i in range(3):
        q[i] = T_right_left[i, 0] * p[0] + T_right_left[i, 1] * p[1] + T_right_left[i, 2] * p[2] + T_right_left[i, 3]


@kernel(forceinline=True)
def _linearise(
    fisheye: NDArray[np.bool_], k: Array, d: Array, T_right_left: Array, p: Array, uv: Array, r: Array, J: Array, q: Array,
    xy: Array, J_p: Array, J_d: Array,
) -> None:  # fmt: skip
    """Fill the residuals r (2, 2) of a point p of the left frame and their Jacobian J (2, 2, 3) by it.

    Of both cameras: q (2, 3) the point in the camera's own frame, xy (2, 2) its projection in focal lengths, J_p (2, 2,
    3) pixel by q, J_d (2, 2, 8) by the distortion. Residuals are NaN behind a camera.
    """
    q[0] = p
    _to_right(T_right_left, p, q[1])
    for c in range(2):
        if q[c, 2] <= 0.0 and not fisheye[c]:
            r[c] = np.nan
            continue
        distort(fisheye[c], d[c], q[c], xy[c], J_p[c], J_d[c])
        for i in range(2):
            r[c, i] = uv[c, i] - (k[c, i] * xy[c, i] + k[c, 2 + i])
            J_p[c, i] *= k[c, i]
            J_d[c, i] *= k[c, i]
            for j in range(3):
                J[c, i, j] = J_p[c, i, j]
                if c == 1:
                    J[c, i, j] = 0.0
                    for m in range(3):
                        J[c, i, j] += J_p[c, i, m] * T_right_left[m, j]


@kernel(forceinline=True)
def _step(weight: Array, r: Array, J: Array, JW: Array, H: Array, L: Array, g: Array, step: Array) -> bool:
    """Fill the normal equations of one point and solve them; False where they do not determine it."""
    for j in range(3):
        for c in range(2):
            for m in range(2):
                JW[j, 2 * c + m] = J[c, 0, j] * weight[c, 0, m] + J[c, 1, j] * weight[c, 1, m]
    for j in range(3):
        g[j] = 0.0
        for c in range(2):
            for i in range(2):
                g[j] += JW[j, 2 * c + i] * r[c, i]
        for m in range(3):
            H[j, m] = 0.0
            for c in range(2):
                for i in range(2):
                    H[j, m] += JW[j, 2 * c + i] * J[c, i, m]
    for j in range(3):
        for m in range(j + 1):
            s = H[j, m]
            for i in range(m):
                s -= L[j, i] * L[m, i]
            if j != m:
                L[j, m] = s / L[m, m]
            elif s > _SINGULAR * H[j, j]:
                L[j, j] = np.sqrt(s)
            else:
                return False
    _back(L, g, step)
    return bool(np.isfinite(step.sum()))


@kernel(forceinline=True)
def _back(L: Array, g: Array, x: Array) -> None:
    """Solve L L^T x = g of three unknowns."""
    x[0] = g[0] / L[0, 0]
    x[1] = (g[1] - L[1, 0] * x[0]) / L[1, 1]
    x[2] = (g[2] - L[2, 0] * x[0] - L[2, 1] * x[1]) / (L[2, 2] * L[2, 2])
    x[1] = (x[1] - L[2, 1] * x[2]) / L[1, 1]
    x[0] = (x[0] - L[1, 0] * x[1] - L[2, 0] * x[2]) / L[0, 0]


@kernel(
    "b1[::1], f8[:, ::1], f8[:, ::1], i8[::1], f8[:, ::1], const f8[:, :, ::1], const f8[:, :, :, ::1], "
    "f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, :, ::1], f8[:, :, ::1]"
)
def _minimise(
    fisheye: NDArray[np.bool_], k: Array, d: Array, counts: Ids, T_right_left: Array, uv: Array, cov_uv: Array,
    rays_left: Array, rays_right: Array, p: Array, cov: Array, by_rig: Array,
) -> None:  # fmt: skip
    """Move points p from their start to the minimum, NaN where there is none, and fill covariances and derivatives."""
    r, J, q, xy = np.empty((2, 2)), np.empty((2, 2, 3)), np.empty((2, 3)), np.empty((2, 2))
    J_p, J_d = np.empty((2, 2, 3)), np.empty((2, 2, 8))
    weight, JW, H, L = np.empty((2, 2, 2)), np.empty((3, 4)), np.empty((3, 3)), np.empty((3, 3))
    g, step, J_rig = np.empty(3), np.empty(3), np.empty((4, by_rig.shape[2]))
    for n in range(len(p)):
        for c in range(2):
            C = cov_uv[n, c]
            det = C[0, 0] * C[1, 1] - C[0, 1] * C[1, 0]
            weight[c, 0, 0], weight[c, 1, 1] = C[1, 1] / det, C[0, 0] / det
            weight[c, 0, 1], weight[c, 1, 0] = -C[0, 1] / det, -C[1, 0] / det
        good = False
        for _ in range(_STEPS + 1):
            _linearise(fisheye, k, d, T_right_left, p[n], uv[n], r, J, q, xy, J_p, J_d)
            if not (np.isfinite(r.sum()) and _step(weight, r, J, JW, H, L, g, step)):
                good = False
                break
            good = g[0] * step[0] + g[1] * step[1] + g[2] * step[2] <= _REACHED
            p[n] += step
            if good:
                break
        if not (good and _ahead(p[n], rays_left[n], q[1], rays_right[n])):
            p[n] = np.nan
            continue
        for j in range(3):
            g[:] = 0.0
            g[j] = 1.0
            _back(L, g, cov[n, j])
        _rig_jacobian(counts, q[1], xy, J_p, J_d, J_rig)
        for j in range(3):
            by_rig[n, j] = 0.0
            for i in range(4):
                gain = cov[n, j, 0] * JW[0, i] + cov[n, j, 1] * JW[1, i] + cov[n, j, 2] * JW[2, i]
                for m in range(J_rig.shape[1]):
                    by_rig[n, j, m] -= gain * J_rig[i, m]


@kernel("b1[::1], f8[:, ::1], f8[:, ::1], i8[::1], f8[:, ::1], const f8[:, ::1], f8[:, :, ::1]")
def _by_rig(
    fisheye: NDArray[np.bool_], k: Array, d: Array, counts: Ids, T_right_left: Array, p: Array, out: Array
) -> None:
    """Fill what :func:`pixels_by_rig` returns."""
    r, J, q, xy = np.empty((2, 2)), np.empty((2, 2, 3)), np.empty((2, 3)), np.empty((2, 2))
    J_p, J_d, uv = np.empty((2, 2, 3)), np.empty((2, 2, 8)), np.zeros((2, 2))
    for n in range(len(p)):
        _linearise(fisheye, k, d, T_right_left, p[n], uv, r, J, q, xy, J_p, J_d)
        if np.isfinite(r.sum()):
            _rig_jacobian(counts, q[1], xy, J_p, J_d, out[n])
        else:
            out[n] = np.nan


def pixels_by_rig(rig: StereoRig, p_left: Array) -> Array:
    """Return (N, 4, P) derivative of both images (left u, v, right u, v) of points by the rig's parameters; NaN unseen."""
    counts = np.array([camera.distortion.size for camera in rig.cameras])
    out = np.empty((len(p_left), 4, rig.parameter_count))
    _by_rig(*pair_arguments(rig.cameras), counts, inverse(rig.T_left_right), np.ascontiguousarray(p_left), out)
    return out


@kernel
def _rig_jacobian(counts: Ids, q: Array, xy: Array, J_p: Array, J_d: Array, J_rig: Array) -> None:
    """Fill J_rig (4, P), the pixels of a point, q (3,) in the right frame, by the rig's parameters."""
    J_rig[:] = 0.0
    start = 0
    for c in range(2):
        for i in range(2):
            row = J_rig[2 * c + i]
            row[start + i], row[start + 2 + i] = xy[c, i], 1.0
            row[start + 4 : start + 4 + counts[c]] = J_d[c, i, : counts[c]]
        start += 4 + counts[c]
    for i in range(2):
        a, b, c_ = J_p[1, i]
        row = J_rig[2 + i]
        row[start], row[start + 1], row[start + 2] = -a, -b, -c_
        row[start + 3], row[start + 4], row[start + 5] = b * q[2] - c_ * q[1], c_ * q[0] - a * q[2], a * q[1] - b * q[0]


@kernel
def _ahead(p: Array, ray_left: Array, q: Array, ray_right: Array) -> bool:
    """Whether a point lies along the rays of its pixels, not behind a camera or where the distortion folds back."""
    left = ray_left[0] * p[0] + ray_left[1] * p[1] + ray_left[2] * p[2]
    right = ray_right[0] * q[0] + ray_right[1] * q[1] + ray_right[2] * q[2]
    far = np.sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2]), np.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2])
    return bool(left > _LOOKING * far[0] and right > _LOOKING * far[1])


def triangulate(rig: StereoRig, body: Body, seen: Correspondences) -> Points:
    """Triangulate one shot's matched points.

    ``rig``: the calibrated pair; its ``sigma_px`` adds to the detections' covariance. ``body``: names the points. ``seen``:
    the correspondences of both cameras, gated. Returns the points with their covariance; a point that does not lie before
    both cameras is dropped by name, and its detections with it.
    """
    rows = np.flatnonzero(seen.paired)
    cov_uv = seen.cov_uv[rows] + max(rig.sigma_px, 1e-6) ** 2 * np.eye(2)
    p, cov, by_rig = optimal_points(rig, seen.uv[rows], cov_uv)
    good = np.isfinite(p[:, 0])
    if good.all():
        return Points(seen.ids[rows], p, cov, by_rig, seen, seen.dropped)
    dropped = tuple(
        Dropped(body.point_names[i], "its rays do not meet before both cameras", contradicts=True)
        for i in seen.ids[rows[~good]]
    )
    keep = ~np.isin(seen.ids, seen.ids[rows[~good]])
    kept = Correspondences(seen.ids[keep], seen.uv[keep], seen.cov_uv[keep], seen.dropped + dropped, seen.common)
    return Points(seen.ids[rows[good]], p[good], cov[good], by_rig[good], kept, kept.dropped)
