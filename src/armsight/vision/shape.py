"""How a body may differ from its drawing: shape modes for bundle adjustment.

A body's pose in every shot takes its rigid motions, and the images cannot tell its size from the distance of the
cameras: these seven freedoms are taken out, and what remains moves one point against another.
"""

from __future__ import annotations

import numpy as np

from armsight.data import Array
from armsight.geometry.rotation import skew


def without_gauge(points: Array, modes: Array) -> Array:
    """Remove rigid motion and size from shape modes.

    Args:
        points: (M, 3) points of the body, m.
        modes: (K, M, 3) displacement fields.

    Returns:
        (L, M, 3) orthogonal modes of an RMS displacement of one over all points; where the given modes held the seven
        freedoms, L is K - 7 or, if they were not independent, less.
    """
    centred = points - points.mean(axis=0)
    generators = [np.tile(axis, (len(points), 1)) for axis in np.eye(3)]
    generators += [centred @ skew(axis).T for axis in np.eye(3)] + [centred]
    _, sizes, Q = np.linalg.svd(np.stack([g.ravel() for g in generators]), full_matrices=False)
    Q = Q[sizes > 1e-9 * sizes[0]]  # points on one line have six freedoms: turning about it moves none
    flat = modes.reshape(len(modes), -1)
    flat = flat - (flat @ Q.T) @ Q
    _, sizes, basis = np.linalg.svd(flat, full_matrices=False)
    basis = basis[sizes > 1e-9 * max(sizes[0], 1e-300)]
    return np.asarray(basis.reshape(len(basis), len(points), 3) * np.sqrt(len(points)))


def every_point(points: Array) -> Array:
    """Modes (K, M, 3) that let every point move by itself."""
    n = len(points)
    return without_gauge(points, np.eye(3 * n).reshape(3 * n, n, 3))


def smooth(points: Array, degree: int) -> Array:
    """Modes (K, M, 3) of a smoothly distorted plane: polynomials in x and y up to ``degree`` for each of x, y, z."""
    xy = points[:, :2] - points[:, :2].mean(axis=0)
    xy = xy / np.abs(xy).max()
    terms = [xy[:, 0] ** i * xy[:, 1] ** j for i in range(degree + 1) for j in range(degree + 1 - i)]
    modes = np.zeros((3 * len(terms), len(points), 3))
    for k, term in enumerate(terms):
        for axis in range(3):
            modes[3 * k + axis, :, axis] = term
    return without_gauge(points, modes)
