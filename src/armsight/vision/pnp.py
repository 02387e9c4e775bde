"""Where a body may be as one camera sees it: every candidate pose, mirror solutions included (perspective-n-point)."""

from __future__ import annotations

import cv2
import numpy as np

from armsight.data import Array
from armsight.geometry.pose import pose, transform
from armsight.geometry.rotation import exp_so3
from armsight.vision.camera import Camera

MIN_POINTS = 4


def body_poses(points: Array, camera: Camera, uv: Array) -> list[tuple[Array, float]]:
    """Solve for the pose of a body in one camera.

    Args:
        points: (N, 3) points of the body, m, N >= 4; planar or not.
        camera: the camera.
        uv: (N, 2) where it saw them, raw pixels.

    Returns:
        Candidate poses T_camera_body (4, 4) with their reprojection RMS, px, best first: both solutions of a plane;
        none where the points do not determine one.
    """
    rays = camera.unproject(uv)
    ahead = np.isfinite(rays).all(axis=1) & (rays[:, 2] > 0.1)
    if ahead.sum() < MIN_POINTS:
        return []
    xy, p = rays[ahead, :2] / rays[ahead, 2:], points[ahead]
    centred = p - p.mean(axis=0)
    spread = np.linalg.svd(centred, compute_uv=False)
    if spread[1] < 1e-6 * spread[0]:
        return []
    flat = spread[2] < 1e-6 * spread[0]
    flags = (cv2.SOLVEPNP_IPPE,) if flat else (cv2.SOLVEPNP_SQPNP, cv2.SOLVEPNP_EPNP)
    found = []
    for flag in flags:
        try:
            _, rotations, translations, _ = cv2.solvePnPGeneric(p, xy[:, None], np.eye(3), None, flags=flag)
        except cv2.error:
            continue
        found += [pose(exp_so3(r.ravel()), t.ravel()) for r, t in zip(rotations, translations, strict=True)]
    scored = []
    for T in found:
        error = camera.project(transform(T, points)) - uv
        if np.isfinite(error).all():
            scored.append((T, float(np.sqrt((error**2).sum(axis=1).mean()))))
    return sorted(scored, key=lambda candidate: candidate[1])
