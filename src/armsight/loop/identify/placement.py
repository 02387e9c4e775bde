"""Initial placement: base in the rig and tool on the flange, in closed form, so that nobody has to give a start.

Points: with M = R^T and c unknown, M p_i + c = o_i + R_i t is linear in M (nine numbers, not yet a rotation), c and the
point t in frame 6; M contains the scale, too. Full poses: A_i X = Z B_i, solved by
:func:`~armsight.loop.handeye.handeye.starts`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from armsight.data import Array
from armsight.geometry.pose import inverse
from armsight.geometry.rotation import log_so3, nearest_rotation
from armsight.loop.handeye.handeye import starts
from armsight.loop.identify.measured import Measured
from armsight.loop.identify.model import Model


def with_placement(model: Model, measured: Measured) -> tuple[Model, Array]:
    """Return the model and vector of the nominal arm with base and tool estimated from the poses.

    Args:
        model: the arm with every parameter.
        measured: the poses.

    Returns:
        The model with the placement's rotations as its ``R_start`` and ``R_tool``, and the vector x (P,).
    """
    x = model.nominal()
    m = model.motion(x, measured.q, model.feature_values(measured.q, measured.approach))
    if measured.R_rig_body is not None:
        A, B = _stacked(m.R, m.o), _stacked(measured.R_rig_body, measured.p_rig[:, 0])
        X, Z = starts(A, B)[0]  # A: frame 6 in the base; Z: the rig in the base; X: the body on frame 6
        T = inverse(Z)
        model, t = replace(model, R_start=T[:3, :3], R_tool=X[:3, :3]), X[None, :3, 3]
        x[:3] = T[:3, 3]
    else:
        M, c, t = linear_placement(m.R, m.o, measured.p_rig)
        R = nearest_rotation(M).T
        model = replace(model, R_start=R)
        x[:3] = -R @ c
    x[model.tool_at : model.tool_at + t.size] = t.ravel()
    return model, x


def linear_placement(R: Array, o: Array, p_rig: Array) -> tuple[Array, Array, Array]:
    """Solve M p_ik + c = o_i + R_i t_k in least squares.

    Returns:
        (3, 3) M, a rotation over the scale where all is well, (3,) c, and (K, 3) t.
    """
    n, K = p_rig.shape[:2]
    centre = p_rig.mean(axis=(0, 1))
    G = np.zeros((K, n, 3, 12 + 3 * K))
    for k in range(K):
        for row in range(3):
            G[k, :, row, 3 * row : 3 * row + 3] = p_rig[:, k] - centre
            G[k, :, row, 9 + row] = 1.0
        G[k, :, :, 12 + 3 * k : 15 + 3 * k] = -R
    size = np.linalg.norm(G.reshape(-1, G.shape[-1]), axis=0) + 1e-300
    right = np.broadcast_to(o, (K, n, 3)).ravel()
    s = np.linalg.lstsq(G.reshape(-1, G.shape[-1]) / size, right, rcond=1e-12)[0] / size
    M = s[:9].reshape(3, 3)
    return M, s[9:12] - M @ centre, s[12:].reshape(K, 3)


def _stacked(R: Array, o: Array) -> Array:
    T = np.zeros((len(R), 4, 4))
    T[:, :3, :3], T[:, :3, 3], T[:, 3, 3] = R, o, 1.0
    return T


def angle_between(R_a: Array, R_b: Array) -> Array:
    """Return the angles (N,) between rotations (N, 3, 3), rad."""
    return np.asarray(np.linalg.norm(log_so3(R_a.swapaxes(-1, -2) @ R_b), axis=-1))
