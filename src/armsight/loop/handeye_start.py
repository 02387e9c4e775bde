"""Closed-form starts for hand-eye calibration: A_i X = Z B_i, from all poses and from small parts of them.

In: poses of the flange in the base and of what is seen. Out: candidates for (X, Z), best first. Own: rotations by the
leading singular vectors of the Kronecker sum, translations by linear least squares (Shah, "Solving the robot-world/
hand-eye calibration problem using the Kronecker product", J. Mechanisms Robotics 5(3), 2013). OpenCV's solvers are tried
beside it where the installed OpenCV has them (5.0 has not).
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np

from armsight.data import Array
from armsight.geometry.pose import inverse, log_se3, mean_pose, pose

#: OpenCV as it is at run time: its type stubs are those of one version.
_CV: Any = cv2
#: Parts of this many poses are tried too, so that some of them are free of gross errors.
PART = 6
#: How many parts: with 20 % gross errors all of them would hold one with a chance of (1 - 0.8^6)^24, 0.1 %.
PARTS = 24
#: What a turn counts in the score, m: 1 mrad as much as 0.3 mm, as it does at a tool 0.3 m from the wrist.
LEVER_M = 0.3
#: OpenCV's solvers of A X = Z B, by the names it gives them; 5.0 has none of them.
_OPENCV = ("CALIB_ROBOT_WORLD_HAND_EYE_SHAH", "CALIB_ROBOT_WORLD_HAND_EYE_LI")
_OPENCV_MOTIONS = (
    "CALIB_HAND_EYE_TSAI",
    "CALIB_HAND_EYE_PARK",
    "CALIB_HAND_EYE_HORAUD",
    "CALIB_HAND_EYE_ANDREFF",
    "CALIB_HAND_EYE_DANIILIDIS",
)


def starts(A: Array, B: Array, seed: int = 0) -> list[tuple[Array, Array]]:
    """Return candidates for X and Z of ``A_i X = Z B_i``, smallest median residual first.

    Args:
        A: (N, 4, 4) poses, N >= 3.
        B: (N, 4, 4) poses.
        seed: of the choice of parts.
    """
    rng = np.random.default_rng(seed)
    found = [kronecker(A, B), *_opencv(A, B)]
    if len(A) > PART:
        for _ in range(PARTS):
            rows = rng.choice(len(A), PART, replace=False)
            found.append(kronecker(A[rows], B[rows]))
    found = [(X, Z) for X, Z in found if np.isfinite(X).all() and np.isfinite(Z).all() and _turns(X) and _turns(Z)]
    return sorted(found, key=lambda XZ: _score(A, B, *XZ))


def kronecker(A: Array, B: Array) -> tuple[Array, Array]:
    """Solve ``A_i X = Z B_i`` in closed form: rotations first, then translations.

    With column-stacked matrices, R_A R_X R_B^T = R_Z reads (R_B kron R_A) vec(R_X) = vec(R_Z) for every i, so both are the
    leading singular vectors of the sum of the Kronecker products.

    Returns:
        (4, 4) X and (4, 4) Z.
    """
    RA, RB = A[:, :3, :3], B[:, :3, :3]
    K = np.einsum("nij,nkl->ikjl", RB, RA).reshape(9, 9)
    U, _, Vt = np.linalg.svd(K)
    RX, RZ = _rotation(Vt[0].reshape(3, 3, order="F")), _rotation(U[:, 0].reshape(3, 3, order="F"))
    # R_A t_X - t_Z = R_Z t_B - t_A
    M = np.concatenate([RA, np.broadcast_to(-np.eye(3), RA.shape)], axis=2).reshape(-1, 6)
    right = (B[:, :3, 3] @ RZ.T - A[:, :3, 3]).ravel()
    t = np.linalg.lstsq(M, right, rcond=None)[0]
    return pose(RX, t[:3]), pose(RZ, t[3:])


def _rotation(M: Array) -> Array:
    """Return the rotation nearest to a multiple, of either sign, of a rotation (3, 3)."""
    U, _, Vt = np.linalg.svd(M * np.sign(np.linalg.det(M)))
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)


def _opencv(A: Array, B: Array) -> Iterator[tuple[Array, Array]]:
    """Yield what OpenCV's solvers find, where it has them and they take what they are given."""
    back = inverse(B)
    for name in _OPENCV_MOTIONS if hasattr(cv2, "calibrateHandEye") else ():
        with contextlib.suppress(cv2.error):
            R, t = _CV.calibrateHandEye(*_parts(A), *_parts(back), method=getattr(cv2, name))
            X = pose(R, t.ravel())
            yield X, mean_pose(A @ X @ back)
    for name in _OPENCV if hasattr(cv2, "calibrateRobotWorldHandEye") else ():
        with contextlib.suppress(cv2.error):
            RX, tX, RZ, tZ = _CV.calibrateRobotWorldHandEye(*_parts(A), *_parts(B), method=getattr(cv2, name))
            yield pose(RX, tX.ravel()), pose(RZ, tZ.ravel())


def _parts(Ts: Array) -> tuple[list[Array], list[Array]]:
    return [T[:3, :3] for T in Ts], [T[:3, 3] for T in Ts]


def _turns(T: Array) -> bool:
    """Say whether a solver's answer is a rigid motion at all."""
    return bool(np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() < 1e-6 and np.linalg.det(T[:3, :3]) > 0)


def _score(A: Array, B: Array, X: Array, Z: Array) -> float:
    """Return the median size of the residual motions, m."""
    e = log_se3(inverse(Z @ B) @ A @ X)
    return float(np.median(np.hypot(np.linalg.norm(e[:, :3], axis=1), LEVER_M * np.linalg.norm(e[:, 3:], axis=1))))
