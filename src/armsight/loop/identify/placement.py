"""Initial placement: base in the rig and tool on the flange, in closed form, so that nobody has to give a start.

Points: with M = R^T and c unknown, M p_i + c = o_i + R_i t is linear in M (nine numbers, not yet a rotation), c and the
point t in frame 6; M contains the scale, too. The rotation that fits best is then found among all of them. Full poses:
A_i X = Z B_i, solved by :func:`~armsight.loop.handeye.poses.starts`. Lengths: the anchor by linear trilateration of the
flange, and its mirror image about the flange's best plane, which fits nearly as well where the flange moves in one.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.linalg import orth
from scipy.spatial.transform import Rotation

from armsight.data import Array
from armsight.geometry.pose import inverse, pose
from armsight.geometry.rotation import exp_so3, skew
from armsight.loop.handeye.poses import starts
from armsight.loop.identify.measured import Measured
from armsight.loop.identify.model import Model


def with_placement(model: Model, measured: Measured) -> tuple[Model, Array]:
    """Return the model and vector of the nominal arm with base and tool estimated from the poses.

    Returns:
        The model with the placement's rotations as its ``R_start`` and ``R_tool``, and the vector x (P,).
    """
    x = model.nominal()
    m = model.motion(x, measured.q, model.feature_values(measured.q, measured.approach))
    if measured.R_rig_body is not None:
        A, B = pose(m.R, m.o), pose(measured.R_rig_body, measured.p_rig[:, 0])
        X, Z = starts(A, B)[0]  # A: frame 6 in the base; Z: the rig in the base; X: the body on frame 6
        T = inverse(Z)
        model, t = replace(model, R_start=T[:3, :3], R_tool=X[:3, :3]), X[None, :3, 3]
        x[:3] = T[:3, 3]
    elif measured.length_m is not None:
        x[:3], t = -_anchors(m.o, measured.length_m)[0], np.zeros((1, 3))
    else:
        M, c, t, _ = rigid_placement(m.R, m.o, measured.p_rig)
        R = M.T
        model = replace(model, R_start=R)
        x[:3] = -R @ c
    x[model.tool_at : model.tool_at + t.size] = t.ravel()
    return model, x


def _anchors(p: Array, length: Array) -> Array:
    """Return the anchor (2, 3) that points p (N, 3) have distances (N,) from, by median residuals, and its mirror image."""
    centre = p.mean(axis=0)
    _, _, axes = np.linalg.svd(p - centre, full_matrices=False)
    A, squares = np.column_stack([-2 * (p - centre), np.ones(len(p))]), length**2 - ((p - centre) ** 2).sum(axis=1)
    keep = np.ones(len(p), bool)
    for _ in range(_ROUNDS):
        a = np.linalg.lstsq(A[keep], squares[keep], rcond=None)[0][:3]
        off = np.abs(np.linalg.norm(p - centre - a, axis=1) - length)
        keep = off <= 2 * np.median(off)
    both = np.array([a, a - 2 * (a @ axes[2]) * axes[2]])
    off = np.median(np.abs(np.linalg.norm(p - centre - both[:, None], axis=2) - length), axis=1)
    return np.asarray(centre + both[np.argsort(off)])


#: Rounds of trilateration, each by the lengths that fit better than twice the median before; half: blunders pull longer.
_ROUNDS = 6


def linear_placement(R: Array, o: Array, p_rig: Array) -> tuple[Array, Array, Array]:
    """Solve M p_ik + c = o_i + R_i t_k in least squares.

    Returns:
        (3, 3) M, a rotation over the scale where all is well, (3,) c, and (K, 3) t.
    """
    G, right, centre = _linear_system(R, o, p_rig)
    s = _solved(G, right)
    M = s[:9].reshape(3, 3)
    return M, s[9:12] - M @ centre, s[12:].reshape(-1, 3)


def rigid_placement(R: Array, o: Array, p_rig: Array) -> tuple[Array, Array, Array, float]:
    """Solve M p_ik + c = o_i + R_i t_k in least squares for a rotation M: also where the motions leave nine numbers open.

    With c and t eliminated the squares are a quadratic form of M, which is minimised over the rotations from many starts.

    Returns:
        (3, 3) M, (3,) c, (K, 3) t, and the RMS distance that is left, m.
    """
    G, right, centre = _linear_system(R, o, p_rig)
    span = np.linalg.qr(G[:, 9:])[0] if np.linalg.matrix_rank(G[:, 9:]) == G.shape[1] - 9 else orth(G[:, 9:])
    A, b = (values - span @ (span.T @ values) for values in (G[:, :9], right))
    Q, triangle = np.linalg.qr(A)
    M = _nearest(triangle, Q.T @ b)
    left = right - G[:, :9] @ M.ravel()
    s = _solved(G[:, 9:], left)
    off = left - G[:, 9:] @ s
    rms = float(np.sqrt(off @ off / (len(off) / 3)))
    return M, s[:3] - M @ centre, s[3:].reshape(-1, 3), rms


def _nearest(A: Array, b: Array) -> Array:
    """Return the rotation M (3, 3) with the least squares of A vec(M) - b, A (9, 9): Gauss-Newton from starts all over."""
    M = Rotation.create_group("O").as_matrix()
    for _ in range(_STEPS):
        e = np.einsum("ij,nj->ni", A, M.reshape(-1, 9)) - b
        by = np.stack([(M @ skew(axis)).reshape(-1, 9) @ A.T for axis in np.eye(3)], axis=2)
        H = by.swapaxes(1, 2) @ by
        H = H + _DAMPED * np.trace(H, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 1e-300 * np.eye(3)
        M = M @ exp_so3(-np.linalg.solve(H, by.swapaxes(1, 2) @ e[..., None])[..., 0])
    cost = np.sum((np.einsum("ij,nj->ni", A, M.reshape(-1, 9)) - b) ** 2, axis=1)
    return np.asarray(M[int(np.argmin(cost))])


#: Gauss-Newton steps of a rotation, and the share of the mean curvature that is added to directions that are open.
_STEPS, _DAMPED = 30, 1e-6


def _linear_system(R: Array, o: Array, p_rig: Array) -> tuple[Array, Array, Array]:
    """Return the matrix of (M, c, t), the right-hand side, and the points' middle, about which M rotates them."""
    n, K = p_rig.shape[:2]
    centre = p_rig.mean(axis=(0, 1))
    G = np.zeros((K, n, 3, 12 + 3 * K))
    for k in range(K):
        for row in range(3):
            G[k, :, row, 3 * row : 3 * row + 3] = p_rig[:, k] - centre
            G[k, :, row, 9 + row] = 1.0
        G[k, :, :, 12 + 3 * k : 15 + 3 * k] = -R
    return G.reshape(-1, G.shape[-1]), np.broadcast_to(o, (K, n, 3)).ravel(), centre


def _solved(G: Array, right: Array) -> Array:
    size = np.linalg.norm(G, axis=0) + 1e-300
    return np.asarray(np.linalg.lstsq(G / size, right, rcond=1e-12)[0] / size)
