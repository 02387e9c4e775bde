"""Where matched points are: optimal triangulation on raw pixels, through the distortion.

Minimises the covariance-weighted pixel distance in both images (the maximum-likelihood point; Hartley and Sturm,
"Triangulation", 1997, here by Gauss-Newton so that any distortion and any covariance is allowed).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Body, Correspondences, Dropped, Points
from armsight.geometry.pose import inverse, transform
from armsight.geometry.rotation import skew
from armsight.vision.rig import StereoRig

_STEPS = 10
_DONE = 1e-12  # relative to the depth
#: A minimum is reached when one more step would gain less than this, in units of chi-square.
_REACHED = 1e-6
#: Cosine of the angle, 8 degrees, within which a point must lie of the ray of its pixel.
_LOOKING = 0.99


def midpoints(rig: StereoRig, uv_left: Array, uv_right: Array) -> Array:
    """Return the points halfway between the two rays of each pair of raw pixels.

    Args:
        rig: the calibrated pair.
        uv_left: (N, 2) raw pixels.
        uv_right: (N, 2) raw pixels of the same points.

    Returns:
        (N, 3) points, m, left frame; NaN where the rays are parallel or come closest behind a camera.
    """
    a, b = rig.left.unproject(uv_left), rig.right.unproject(uv_right) @ rig.T_left_right[:3, :3].T
    t = rig.T_left_right[:3, 3]
    ab = np.einsum("ni,ni->n", a, b)
    with np.errstate(divide="ignore", invalid="ignore"):
        along_a = (a @ t - ab * (b @ t)) / (1 - ab**2)
        along_b = (ab * (a @ t) - b @ t) / (1 - ab**2)
        p = (along_a[:, None] * a + t + along_b[:, None] * b) / 2
    p[~((along_a > 0) & (along_b > 0) & np.isfinite(p).all(axis=1))] = np.nan
    return np.asarray(p)


def optimal_points(rig: StereoRig, uv: Array, cov_uv: Array) -> tuple[Array, Array, Array]:
    """Triangulate pairs of raw pixels.

    Args:
        rig: the calibrated pair.
        uv: (N, 2, 2) point, camera, raw pixel.
        cov_uv: (N, 2, 2, 2) covariance of each pixel, px^2, positive definite.

    Returns:
        (N, 3) points, m, left frame, NaN where the rays do not meet before both cameras; (N, 3, 3) covariance from the
        pixel noise, m^2; (N, 3, P) derivative by the rig's parameters.
    """
    p = midpoints(rig, uv[:, 0], uv[:, 1])
    weight = np.asarray(np.linalg.inv(cov_uv), np.float64)
    for _ in range(_STEPS):
        g, H, _, _ = _normal(rig, p, uv, weight)
        step = _solve(H, g)
        p = p + step
        if not (np.abs(step) > _DONE * np.abs(p[:, 2:])).any():
            break
    g, H, JW, J_rig = _normal(rig, p, uv, weight)
    good = (np.einsum("ni,ni->n", g, _solve(H, g)) <= _REACHED) & _ahead(rig, p, uv)
    cov, by_rig = np.full((len(p), 3, 3), np.nan), np.full((len(p), 3, J_rig.shape[2]), np.nan)
    cov[good] = np.linalg.inv(H[good])
    by_rig[good] = -cov[good] @ JW[good] @ J_rig[good]
    p[~good] = np.nan
    return p, cov, by_rig


def _ahead(rig: StereoRig, p_left: Array, uv: Array) -> NDArray[np.bool_]:
    """(N,) whether points lie where their pixels look, and not behind a camera or where the distortion folds back."""
    p_right = transform(inverse(rig.T_left_right), p_left)
    rays_left, rays_right = rig.left.unproject(uv[:, 0]), rig.right.unproject(uv[:, 1])
    along_left, along_right = np.einsum("ni,ni->n", rays_left, p_left), np.einsum("ni,ni->n", rays_right, p_right)
    left = along_left > _LOOKING * np.linalg.norm(p_left, axis=1)
    return np.asarray(left & (along_right > _LOOKING * np.linalg.norm(p_right, axis=1)))


def _normal(rig: StereoRig, p: Array, uv: Array, weight: Array) -> tuple[Array, Array, Array, Array]:
    """Return the normal equations at p (N, 3): (N, 3) gradient, (N, 3, 3) H, (N, 3, 4) J^T W, and J by the rig."""
    residual, J, J_rig = _linearise(rig, p, uv)
    JW = np.einsum("ncij,ncik->njck", J, weight).reshape(len(p), 3, 4)
    return np.einsum("nij,nj->ni", JW, residual.reshape(len(p), 4)), JW @ J.reshape(len(p), 4, 3), JW, J_rig


def _solve(H: Array, g: Array) -> Array:
    """Solve (N, 3, 3) systems; NaN where a point has left the cameras' view."""
    step = np.full_like(g, np.nan)
    good = np.asarray(np.isfinite(H).all(axis=(1, 2)) & np.isfinite(g).all(axis=1))
    good[good] = np.linalg.cond(H[good]) < 1e15
    step[good] = np.linalg.solve(H[good], g[good][..., None])[..., 0]
    return step


def _linearise(rig: StereoRig, p_left: Array, uv: Array) -> tuple[Array, Array, Array]:
    """Return residuals (N, 2, 2), their Jacobian by the point (N, 2, 2, 3) and by the rig (N, 4, P)."""
    T_right_left = inverse(rig.T_left_right)
    p_right = transform(T_right_left, p_left)
    uv_l, J_l, K_l = rig.left.project_jacobians(p_left)
    uv_r, J_r, K_r = rig.right.project_jacobians(p_right)
    n_left, n = K_l.shape[2], K_l.shape[2] + K_r.shape[2]
    J_rig = np.zeros((len(p_left), 4, n + 6))
    J_rig[:, :2, :n_left], J_rig[:, 2:, n_left:n] = K_l, K_r
    J_rig[:, 2:, n:] = np.concatenate([-J_r, J_r @ skew(p_right)], axis=2)
    return uv - np.stack([uv_l, uv_r], axis=1), np.stack([J_l, J_r @ T_right_left[:3, :3]], axis=1), J_rig


def triangulate(rig: StereoRig, body: Body, seen: Correspondences) -> Points:
    """Triangulate one shot's matched points.

    Args:
        rig: the calibrated pair; its ``sigma_px`` adds to what the image tells.
        body: names the points.
        seen: what both cameras saw, gated.

    Returns:
        The points with their covariance; what does not lie before both cameras is dropped by name, and its detections
        with it.
    """
    rows = np.flatnonzero(seen.paired)
    cov_uv = seen.cov_uv[rows] + max(rig.sigma_px, 1e-6) ** 2 * np.eye(2)
    p, cov, by_rig = optimal_points(rig, seen.uv[rows], cov_uv)
    good = np.isfinite(p).all(axis=1)
    dropped = tuple(
        Dropped(body.point_names[i], "its rays do not meet before both cameras") for i in seen.ids[rows[~good]]
    )
    keep = ~np.isin(seen.ids, seen.ids[rows[~good]])
    kept = Correspondences(seen.ids[keep], seen.uv[keep], seen.cov_uv[keep], seen.dropped + dropped)
    return Points(seen.ids[rows[good]], p[good], cov[good], by_rig[good], kept, kept.dropped)
