"""What both cameras should see of a body's discs where the body is at a given pose, and the bias of their centres.

An ellipse's centre is not the image of its disc's centre (:mod:`~armsight.vision.discs.bias`). The difference depends on how
the disc is turned, so it is known once the pose is. Of a disc whose normal nobody gave only the size of it is known: the
centre seems to move by -(r^2 / z) times the part of the optical axis e that lies in the disc, e - (n e) n, which over all
directions n has the second moments 1/15 across e and 8/15 along it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Correspondences, Record
from armsight.geometry.pose import inverse, transform
from armsight.geometry.rotation import skew
from armsight.vision.discs.bias import project_discs
from armsight.vision.markers.disc.target import DiscTarget
from armsight.vision.rig import StereoRig

#: A disc turned further away than this cosine is not found, and its back is not seen.
LEAST_FACING = 0.09
#: Points this share of their spread off a plane still count as in it.
_FLAT = 1e-3


@dataclass(frozen=True, eq=False)
class Expected(Record):
    """What both cameras should see of M discs at a pose; camera 0 is left, 1 right. NaN where a disc has no image.

    Attributes:
        uv: (M, 2, 2) disc, camera: centres of the ellipses, raw px.
        bias: (M, 2, 2) centres of the ellipses less images of the centres, px.
        shape: (M, 2, 3) S11, S12, S22 of the ellipses, px^2; as if turned to the camera where the normal is not known.
        radius_px: (M, 2) longer half axes of the ellipses, px.
        facing: (M, 2) cosine between a disc's normal and its direction to the camera; NaN where the body does not say.
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
        (M, 3) those given; where none is given, that of the plane in which all discs lie; NaN where they lie in none.
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
    """Say what both cameras should see of a body's discs.

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
        by_place = np.concatenate([np.broadcast_to(R, (count, 3, 3)), -R @ skew(points)], axis=2)
        J[:, side] = J_P @ by_place
        J[:, side, :, 3:] -= J_n @ (R @ skew(np.where(known[:, None], normals, 0.0)))
        bias[:, side], J_bias[:, side] = uv[:, side] - centre, J[:, side] - J_p @ by_place
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
    """Turn centres of ellipses into images of the discs' centres.

    Args:
        rig: the calibrated pair.
        target: the discs; ``seen.ids`` are rows of its body.
        T_left_body: (4, 4) about where the body is.
        cov_pose: (6, 6) covariance of its tangent: what is not known of the pose is not known of the bias.
        seen: centres of ellipses.

    Returns:
        The same correspondences less the bias, with the covariance of both. Detections whose disc would have no image at
        the pose become NaN.
    """
    expected = expect(rig, target, T_left_body)
    J = expected.J_bias[seen.ids]
    cov = seen.cov_uv + J @ cov_pose @ np.swapaxes(J, 2, 3) + expected.cov_bias[seen.ids]
    uv = seen.uv - expected.bias[seen.ids]
    return Correspondences(seen.ids, uv, np.where(np.isfinite(uv)[..., None], cov, 0.0), seen.dropped)


def visible(rig: StereoRig, expected: Expected) -> NDArray[np.bool_]:
    """(M, 2) whether a disc's ellipse lies wholly in a camera's image and its face, where known, is turned to it enough."""
    size = np.array([camera.image_size_px for camera in rig.cameras])
    low, high = expected.uv - expected.radius_px[..., None], expected.uv + expected.radius_px[..., None]
    inside = ((low >= -0.5) & (high <= size - 0.5)).all(axis=2)
    return np.asarray(inside & ~(expected.facing < LEAST_FACING))
