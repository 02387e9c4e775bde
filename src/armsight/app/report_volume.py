"""How well a rig knows a point in the volume both cameras see: predicted sigmas over a slice and at the boards.

A calibrated rig and the noise of a corner go in; depth and lateral sigma come out, the pixel noise and the calibration
apart and together. Same functions as in a measurement, so the picture shows what a measurement will claim.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armsight.data import Array, Record
from armsight.geometry.pose import transform
from armsight.vision.calibrate.result import Calibration
from armsight.vision.rig import StereoRig
from armsight.vision.triangulate import optimal_points

#: What a predicted sigma is made of, in the order of the first axis of every array here.
SHARES = ("pixel noise", "calibration", "both together")
#: The slice goes this much nearer and farther than the boards were, and beyond them to both sides by this share of their
#: extent, as far as both cameras see.
BEYOND, BESIDE = 0.15, 0.5
_DEEP, _WIDE = 80, 120
_WIDEST_TANGENT = 3.0  # of half the field of view: a fisheye's slice would else be infinitely wide
_FINDS_BACK = (
    1e-6  # relative to the distance: a point that triangulates elsewhere lies beyond what the lens model spans
)
_LEAST_SIGMA_PX = 1e-6


@dataclass(frozen=True, eq=False)
class Slice(Record):
    """Predicted sigmas over a plane through the cameras and the places where the boards were.

    Attributes:
        axis: 0 where the plane's sideways coordinate is X of the left camera, 1 where it is Y.
        sideways_m: (W,) coordinates along that axis, m.
        depth_m: (D,) Z of the left camera, m.
        seen: (D, W) whether both cameras see the point.
        sigma_depth_m: (3, D, W) one sigma along the line of sight, m, by SHARES; NaN where not seen.
        sigma_lateral_m: (3, D, W) one sigma across the line of sight, in the worse direction, m.
    """

    axis: int
    sideways_m: Array
    depth_m: Array
    seen: Array
    sigma_depth_m: Array
    sigma_lateral_m: Array


def corner_variance_px2(calibration: Calibration) -> Array:
    """Return (2,) the variance of a typical corner in the left and the right image, px^2: the image's and the rig's."""
    observations, base = calibration.observations, max(calibration.rig.sigma_px, _LEAST_SIGMA_PX) ** 2
    image = np.trace(observations.cov_uv, axis1=1, axis2=2) / 2
    sides = [image[observations.camera == side] for side in (0, 1)]
    return np.array([base + (float(np.median(values)) if len(values) else 0.0) for values in sides])


def predicted_sigmas(rig: StereoRig, p_left: Array, variance_px2: Array) -> tuple[Array, Array]:
    """Predict how well points would be triangulated.

    Args:
        rig: the calibrated pair.
        p_left: (N, 3) points, m, left camera's frame.
        variance_px2: (2,) variance of a detection in the left and the right image, px^2.

    Returns:
        (3, N) one sigma along the line of sight from between the cameras, m, by SHARES; (3, N) across it, in the worse
        direction, m. NaN where a point is not in both images.
    """
    uv = np.stack([camera.project(p) for camera, p in zip(rig.cameras, _by_camera(rig, p_left), strict=True)], axis=1)
    size = np.array([camera.image_size_px for camera in rig.cameras])
    with np.errstate(invalid="ignore"):
        rows = np.flatnonzero(((uv > -0.5) & (uv < size - 0.5)).all(axis=(1, 2)))
    cov_uv = np.broadcast_to(variance_px2[:, None, None] * np.eye(2), (len(rows), 2, 2, 2))
    p, noise, by_rig = optimal_points(rig, uv[rows], cov_uv)
    with np.errstate(invalid="ignore"):
        back = np.linalg.norm(p - p_left[rows], axis=1) < _FINDS_BACK * np.linalg.norm(p_left[rows], axis=1)
    calibration = by_rig @ rig.cov @ by_rig.transpose(0, 2, 1)
    depth, lateral = np.full((2, len(SHARES), len(p_left)), np.nan)
    for k, cov in enumerate((noise, calibration, noise + calibration)):
        depth[k, rows[back]], lateral[k, rows[back]] = _along_and_across(rig, p[back], cov[back])
    return depth, lateral


def _by_camera(rig: StereoRig, p_left: Array) -> tuple[Array, Array]:
    """Return points (N, 3) of the left frame in both cameras' frames."""
    return p_left, (p_left - rig.T_left_right[:3, 3]) @ rig.T_left_right[:3, :3]


def _along_and_across(rig: StereoRig, p_left: Array, cov: Array) -> tuple[Array, Array]:
    """Split covariances (N, 3, 3) into sigma along the line of sight and the larger one across it, (N,) each."""
    sight = p_left - rig.T_left_right[:3, 3] / 2
    sight = sight / np.linalg.norm(sight, axis=1, keepdims=True)
    along = np.einsum("ni,nij,nj->n", sight, cov, sight)
    flat = np.eye(3) - sight[:, :, None] * sight[:, None, :]
    across = np.linalg.eigvalsh(flat @ cov @ flat)[:, -1]
    return np.sqrt(np.maximum(along, 0)), np.sqrt(np.maximum(across, 0))


def board_points(calibration: Calibration) -> Array:
    """Return (S, M, 3) the points of the board in every pair used, m, left camera's frame."""
    Ts = calibration.solution.state.Ts_left_body
    return np.asarray(transform(Ts[:, None], calibration.body.points))


def volume_slice(calibration: Calibration) -> Slice:
    """Predict the sigmas over the plane through the boards' middle, from nearer than the nearest to beyond the farthest.

    The plane holds the left camera's X axis, or its Y axis where the cameras stand one above the other.
    """
    rig, boards = calibration.rig, board_points(calibration)
    axis = int(np.argmax(np.abs(rig.T_left_right[:2, 3])))
    z = boards[..., 2]
    depth = np.linspace((1 - BEYOND) * max(z.min(), 1e-3 * z.max()), (1 + BEYOND) * z.max(), _DEEP)
    middle = boards.mean(axis=1)
    slope = float(np.median(middle[:, 1 - axis] / middle[:, 2]))
    low, high = _view(rig, axis)
    across = boards[..., axis]
    margin = BESIDE * float(np.ptp(across))
    sideways = np.linspace(
        max(depth[-1] * low, float(across.min()) - margin), min(depth[-1] * high, float(across.max()) + margin), _WIDE
    )
    p = np.empty((_DEEP, _WIDE, 3))
    p[..., axis], p[..., 1 - axis], p[..., 2] = sideways, (slope * depth)[:, None], depth[:, None]
    along, across = predicted_sigmas(rig, p.reshape(-1, 3), corner_variance_px2(calibration))
    shape = (len(SHARES), _DEEP, _WIDE)
    along, across = along.reshape(shape), across.reshape(shape)
    return Slice(axis, sideways, depth, np.isfinite(along[0]), along, across)


def _view(rig: StereoRig, axis: int) -> tuple[float, float]:
    """Return the least and the greatest tangent at which the left camera sees, along X (axis 0) or Y (axis 1)."""
    width, height = rig.left.image_size_px
    u, v = np.linspace(-0.5, width - 0.5, 33), np.linspace(-0.5, height - 0.5, 33)
    border = [np.stack([u, np.full(33, v[k])], 1) for k in (0, -1)] + [
        np.stack([np.full(33, u[k]), v], 1) for k in (0, -1)
    ]
    rays = rig.left.unproject(np.concatenate(border))
    rays = rays[np.isfinite(rays).all(axis=1) & (rays[:, 2] > 0)]
    tangent = rays[:, axis] / rays[:, 2] if len(rays) else np.array([-1.0, 1.0])
    return max(float(tangent.min()), -_WIDEST_TANGENT), min(float(tangent.max()), _WIDEST_TANGENT)
