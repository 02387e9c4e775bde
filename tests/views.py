"""What two cameras see of a body, by OpenCV's projection: tests do not lean on the camera they test."""

import cv2
import numpy as np

from armsight.data import Body, Correspondences
from armsight.geometry.pose import pose
from armsight.geometry.rotation import exp_so3


def pixels(camera, p):
    """Project points (N, 3) of the camera's frame to raw pixels (N, 2)."""
    p = np.ascontiguousarray(p, dtype=np.float64).reshape(-1, 1, 3)
    d = np.array(camera.distortion) if camera.distortion.size else None
    project = cv2.fisheye.projectPoints if camera.model == "fisheye" else cv2.projectPoints
    return project(p, np.zeros(3), np.zeros(3), camera.matrix, d)[0].reshape(-1, 2)


def both_pixels(rig, p_left):
    """Project points (N, 3), left frame, into both cameras: (N, 2, 2) point, camera, pixel."""
    R, t = rig.T_left_right[:3, :3], rig.T_left_right[:3, 3]
    return np.stack([pixels(rig.left, p_left), pixels(rig.right, (p_left - t) @ R)], axis=1)


def seen(rig, points, T_left_body, *, sigma=0.0, rng=None, hidden=()):
    """Let both cameras see a body with noise; ``hidden`` lists (point, camera) that is not seen."""
    uv = both_pixels(rig, points @ T_left_body[:3, :3].T + T_left_body[:3, 3])
    if rng is not None:
        uv = uv + sigma * rng.normal(size=uv.shape)
    for point, camera in hidden:
        uv[point, camera] = np.nan
    return Correspondences(np.arange(len(points)), uv, np.zeros((len(points), 2, 2, 2)))


def board(columns=6, rows=5, pitch=0.03):
    """Points (columns * rows, 3) of a flat board about its middle, row by row."""
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    p = pitch * np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    return p - p.mean(axis=0)


def body_of(points):
    """Name points P0, P1, ..."""
    return Body("body", tuple(f"P{i}" for i in range(len(points))), points)


def somewhere(rng, middle=(0.1, 0.0, 0.6), spread=(0.1, 0.07, 0.1), tilt=(0.35, 0.35, 0.6)):
    """Draw a pose before both cameras of strategies.ordinary_rig."""
    return pose(
        exp_so3(np.array(tilt) * rng.normal(size=3)), np.array(middle) + np.array(spread) * rng.uniform(-1, 1, 3)
    )
