"""The rigid motion that best maps one set of points on another.

Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI 13(4), 1991.
"""

from __future__ import annotations

import numpy as np

from armsight.errors import InputError
from armsight.geometry.pose import pose
from armsight.geometry.rotation import Array

#: Points lie on one line where their second singular value is below this share of the first: the rotation of such a body
#: about the line is unobservable. Half: badly determined poses pass, double: narrow bodies are rejected.
COLLINEAR = 1e-3


def collinear(points: Array) -> bool:
    """Whether points (N, 3), N >= 3, lie on one line or at one position."""
    centred = points - points.sum(axis=0) / len(points)
    spread = np.linalg.eigvalsh(centred.T @ centred)
    return bool(spread[1] <= COLLINEAR**2 * spread[2])


def fit_rigid(p_b: Array, p_a: Array) -> Array:
    """Fit ``T_a_b`` with ``p_a ~ T_a_b @ p_b`` in least squares.

    Args:
        p_b: (..., N, 3) points in b, N >= 3, not all on one line.
        p_a: (..., N, 3) the same points in a.

    Returns:
        (..., 4, 4) T_a_b.

    Raises:
        InputError: fewer than three points.
    """
    if p_b.shape[-2] < 3 or p_b.shape != p_a.shape:
        raise InputError(f"a rigid fit needs 3 or more matched points, got {p_b.shape[-2]} and {p_a.shape[-2]}")
    mean_b, mean_a = p_b.mean(axis=-2), p_a.mean(axis=-2)
    U, _, Vt = np.linalg.svd((p_a - mean_a[..., None, :]).swapaxes(-1, -2) @ (p_b - mean_b[..., None, :]))
    U[np.linalg.det(U @ Vt) < 0, :, 2] *= -1.0  # a mirror image fits better: flip the direction of least spread
    R = U @ Vt
    return pose(R, mean_a - (R @ mean_b[..., None])[..., 0])


def fit_scale(p_b: Array, p_a: Array) -> float:
    """Return how many times larger ``p_a`` (N, 3) is than ``p_b`` (N, 3), by their spread about a rigid fit."""
    T = fit_rigid(p_b, p_a)
    b = (p_b - p_b.mean(axis=0)) @ T[:3, :3].T
    a = p_a - p_a.mean(axis=0)
    return float(np.sum(a * b) / np.sum(b * b))
