"""Poses as 4x4 matrices: ``T_a_b`` maps b's coordinates to a's, and inner letters cancel.

A tangent vector is [translation; rotation] and perturbs on the right: ``T = T_hat @ exp_se3(xi)``. Formulas: Sola, "A
micro Lie theory", 2018, section D.
"""

from __future__ import annotations

import numpy as np

from armsight.geometry.rotation import Array, log_so3, nearest_rotation, skew


def pose(R: Array, t: Array) -> Array:
    """Assemble transforms (..., 4, 4) from rotations (..., 3, 3) and translations (..., 3)."""
    T = np.zeros((*np.shape(R)[:-2], 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R, t, 1.0
    return T


def inverse(T: Array) -> Array:
    """Invert transforms (..., 4, 4) in closed form."""
    out = np.zeros(T.shape)
    Rt = T[..., :3, :3].swapaxes(-1, -2)
    out[..., :3, :3] = Rt
    out[..., :3, 3:] = -(Rt @ T[..., :3, 3:])
    out[..., 3, 3] = 1.0
    return out


def transform(T_a_b: Array, p_b: Array) -> Array:
    """Map points (..., 3) from b to a: ``p_a = T_a_b @ p_b``; leading axes broadcast."""
    return np.asarray((T_a_b[..., :3, :3] @ p_b[..., None])[..., 0] + T_a_b[..., :3, 3])


def adjoint(T: Array) -> Array:
    """Return the adjoints Ad (..., 6, 6) of transforms (..., 4, 4): ``T exp(xi) T^-1 = exp(Ad xi)``."""
    R = T[..., :3, :3]
    out = np.zeros((*T.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = R
    out[..., :3, 3:] = skew(T[..., :3, 3]) @ R
    return out


def small_adjoint(xi: Array) -> Array:
    """Return ad(xi) (..., 6, 6) of tangent vectors (..., 6): ``Ad(exp(xi)) = expm(ad(xi))``."""
    out = np.zeros((*xi.shape[:-1], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = skew(xi[..., 3:])
    out[..., :3, 3:] = skew(xi[..., :3])
    return out


def left_jacobian(phi: Array) -> Array:
    """Return the left Jacobian V (..., 3, 3) of SO(3) at rotation vectors (..., 3), rad.

    ``exp(phi + d) = exp(V d) exp(phi)`` to first order, and the translation of exp_se3([rho; phi]) is V rho.
    """
    angle = np.linalg.norm(phi, axis=-1)[..., None, None]
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    S = skew(phi)
    a = np.where(small, 0.5 - angle**2 / 24, (1 - np.cos(safe)) / safe**2)
    b = np.where(small, 1 / 6 - angle**2 / 120, (safe - np.sin(safe)) / safe**3)
    return np.asarray(np.eye(3) + a * S + b * (S @ S))


def exp_se3(xi: Array) -> Array:
    """Convert tangent vectors (..., 6), [translation; rotation], into transforms (..., 4, 4)."""
    phi = xi[..., 3:]
    square = (phi * phi).sum(axis=-1)[..., None, None]
    small = square < 1e-8
    safe = np.where(small, 1.0, square)
    angle = np.sqrt(safe)
    s, c = np.sin(angle), np.cos(angle)
    S = skew(phi)
    SS = S @ S
    sine = np.where(small, 1 - square / 6, s / angle)
    cosine = np.where(small, 0.5 - square / 24, (1 - c) / safe)
    rest = np.where(small, 1 / 6 - square / 120, (angle - s) / (safe * angle))
    T = np.zeros((*xi.shape[:-1], 4, 4))
    T[..., :3, :3] = np.eye(3) + sine * S + cosine * SS
    T[..., :3, 3] = xi[..., :3] + ((cosine * S + rest * SS) @ xi[..., :3, None])[..., 0]
    T[..., 3, 3] = 1.0
    return T


def log_se3(T: Array) -> Array:
    """Convert transforms (..., 4, 4) into tangent vectors (..., 6), [translation; rotation]."""
    phi = log_so3(np.ascontiguousarray(T[..., :3, :3]))
    rho = np.linalg.solve(left_jacobian(phi), T[..., :3, 3, None])[..., 0]
    return np.concatenate([rho, phi], axis=-1)


def mean_pose(Ts: Array) -> Array:
    """Return the mean (4, 4) of transforms (N, 4, 4): mean translation, chordal mean rotation."""
    return pose(nearest_rotation(Ts[:, :3, :3].sum(axis=0)), Ts[:, :3, 3].mean(axis=0))


def left_axes(T_left_body: Array, cov: Array) -> Array:
    """Return the covariance (6, 6) of the right tangent of a pose as one along the left camera's axes."""
    R = T_left_body[:3, :3]
    blocks = cov.reshape(2, 3, 2, 3).swapaxes(1, 2)
    return np.asarray((R @ blocks @ R.T).swapaxes(1, 2).reshape(6, 6))
