"""Rotations: vectors, matrices, quaternions (wxyz) and Euler angles about z, y, x.

Rotation matrices go in and out. Formulas: Sola, "A micro Lie theory", 2018; quaternions of matrices: Shepperd, J. Guidance
and Control 1(3), 1978; Euler angles: equations 18.15 and 18.16 of "Application of Stereo Vision and ARM Processor for
Motion Control".
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Below this cos(pitch) only roll -+ yaw is determined (Euler angles are singular at +-90 degrees).
SINGULAR_COS_PITCH = 1e-7
#: Sine of half an angle below which it is that angle, to the last digit; half, double: nothing.
_SMALL = 1e-9


def skew(v: Array) -> Array:
    """Return the matrices (..., 3, 3) of vectors v (..., 3): ``skew(v) @ w == cross(v, w)``."""
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2] = -v[..., 2], v[..., 1]
    out[..., 1, 0], out[..., 1, 2] = v[..., 2], -v[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -v[..., 1], v[..., 0]
    return out


def exp_so3(phi: Array) -> Array:
    """Convert rotation vectors (..., 3), rad, into rotation matrices (..., 3, 3)."""
    half = np.linalg.norm(phi, axis=-1, keepdims=True) / 2
    return from_quaternion_wxyz(np.concatenate([np.cos(half), phi / 2 * np.sinc(half / np.pi)], axis=-1))


def log_so3(R: Array) -> Array:
    """Convert rotation matrices (..., 3, 3) into rotation vectors (..., 3), rad, of length at most pi."""
    q = quaternion_wxyz(R)
    v = q[..., 1:]
    sine = np.linalg.norm(v, axis=-1, keepdims=True)
    small = sine < _SMALL
    return v * np.where(small, 2.0, 2 * np.arctan2(sine, q[..., :1]) / np.where(small, 1.0, sine))


def nearest_rotation(M: Array, *, mirrored: bool = False) -> Array:
    """Project matrices (..., 3, 3) of rank two or more onto SO(3): the rotations nearest in the Frobenius norm.

    ``mirrored``: the nearest orthogonal matrices of determinant -1 instead, reflections.
    """
    U, _, Vt = np.linalg.svd(M)
    U[..., 2] *= (-1.0 if mirrored else 1.0) * np.linalg.det(U @ Vt)[..., None]
    return np.asarray(U @ Vt)


def quaternion_wxyz(R: Array) -> Array:
    """Convert rotation matrices (..., 3, 3) into unit quaternions (..., 4), w x y z, with w >= 0."""
    R = np.asarray(R)
    x, y, z = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    by_w, by_x = R - np.swapaxes(R, -1, -2), R + np.swapaxes(R, -1, -2)
    a, b, c = by_w[..., 2, 1], by_w[..., 0, 2], by_w[..., 1, 0]  # 4 w times x, y, z
    d, e, f = by_x[..., 0, 1], by_x[..., 0, 2], by_x[..., 1, 2]  # 4 times xy, xz, yz
    rows = np.array(
        [[1 + x + y + z, a, b, c], [a, 1 + x - y - z, d, e], [b, d, 1 - x + y - z, f], [c, e, f, 1 - x - y + z]]
    )
    best = np.argmax(rows[range(4), range(4)], axis=0)  # of the four squares, so that nothing small is divided by
    q = np.take_along_axis(np.moveaxis(rows, (0, 1), (-2, -1)), best[..., None, None], axis=-2)[..., 0, :]
    return np.asarray(q * (np.copysign(1.0, q[..., :1]) / np.linalg.norm(q, axis=-1, keepdims=True)))


def from_quaternion_wxyz(q: Array) -> Array:
    """Convert quaternions (..., 4), w x y z, of any length but zero, into rotation matrices (..., 3, 3)."""
    q = np.asarray(q) / np.linalg.norm(q, axis=-1, keepdims=True)
    S = skew(q[..., 1:])
    return np.asarray(np.eye(3) + 2 * (q[..., :1, None] * S + S @ S))


def from_euler_zyx(roll: float, pitch: float, yaw: float) -> Array:
    """Return R_z(roll) R_y(pitch) R_x(yaw), (3, 3), from Euler angles about z, y, x, rad (equation 18.15: phi, theta, psi).

    Roll is about z and yaw about x, as in the source; ROS's roll is about x.
    """
    (sz, sy, sx), (cz, cy, cx) = np.sin([roll, pitch, yaw]), np.cos([roll, pitch, yaw])
    return np.array(
        [
            [cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx],
            [sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx],
            [-sy, cy * sx, cy * cx],
        ]
    )


def euler_zyx(R: Array) -> tuple[Array, bool]:
    """Split a rotation into Euler angles about z, y, x (18.16 with atan2).

    docs/concepts/method.md calls them roll, pitch, yaw; in ROS roll is the one about x.

    Args:
        R: (3, 3) rotation, R_z(roll) R_y(pitch) R_x(yaw).

    Returns:
        (3,) roll, pitch, yaw in rad, and whether the pitch is singular (+-90 degrees): then yaw is set to zero and roll
        carries what is determined, roll - yaw at +90 degrees, roll + yaw at -90.
    """
    cos_pitch = float(np.hypot(R[0, 0], R[1, 0]))
    pitch = np.arctan2(-R[2, 0], cos_pitch)
    if cos_pitch < SINGULAR_COS_PITCH:
        return np.array([np.arctan2(-R[0, 1], R[1, 1]), pitch, 0.0]), True
    roll = np.arctan2(R[1, 0], R[0, 0])
    # atan2(R21, R22) near +-90 degrees would not fit this roll; after taking the roll off, it does.
    s, c = np.sin(roll), np.cos(roll)
    yaw = np.arctan2(s * R[0, 2] - c * R[1, 2], c * R[1, 1] - s * R[0, 1])
    return np.array([roll, pitch, yaw]), False


def euler_zyx_sigmas(R: Array, cov: Array) -> Array:
    """Return (3,) one sigma of the angles of :func:`euler_zyx`, rad; NaN at the singularity.

    A rotation by the vector w along the outer axes changes the angles by J^-1 w; the columns of J are the axes of rotation
    of the three angles.

    Args:
        R: (3, 3) the rotation.
        cov: (3, 3) covariance of w along the outer axes, rad^2.
    """
    angles, singular = euler_zyx(R)
    if singular:
        return np.full(3, np.nan)
    (sz, sy, _), (cz, cy, _) = np.sin(angles), np.cos(angles)
    back = np.linalg.inv(np.array([[0.0, -sz, cz * cy], [0.0, cz, sz * cy], [1.0, 0.0, -sy]]))
    return np.asarray(np.sqrt(np.diag(back @ cov @ back.T)))
