"""Made-up hand-eye recordings whose truth is known."""

import numpy as np

from armsight.geometry.pose import exp_se3, inverse, log_se3
from armsight.robot.arm_file import open_arm

SIGMA_FLANGE_M, SIGMA_FLANGE_RAD = 0.5e-3, 1e-3


def recording(seed, eye="to_hand", n=30, gross=0):
    """A of the arm's joints, B seen with its covariance, and the true Z and X; ``gross`` poses are mistakes."""
    rng = np.random.default_rng(seed)
    arm = open_arm("six_r")
    A = arm.forward(arm.home + rng.uniform(-0.6, 0.6, (n, 6)))
    X, Z = exp_se3(rng.normal(0, [0.05] * 3 + [1] * 3)), exp_se3(rng.normal(0, [0.5] * 3 + [1] * 3))
    half = rng.normal(0, 1, (n, 6, 6)) * np.array([1e-4] * 3 + [5e-4] * 3)[:, None]
    cov = half @ half.swapaxes(1, 2) + 1e-12 * np.eye(6)
    true = A @ exp_se3(rng.normal(0, [SIGMA_FLANGE_M] * 3 + [SIGMA_FLANGE_RAD] * 3, (n, 6)))
    B = inverse(Z) @ true @ X if eye == "to_hand" else inverse(true @ X) @ Z
    B = B @ exp_se3((np.linalg.cholesky(cov) @ rng.normal(size=(n, 6, 1)))[..., 0])
    if gross:
        B[:gross] = B[:gross] @ exp_se3(rng.normal(0, 0.1, (gross, 6)))
    return A, B, cov, Z, X


def error(result, Z, X):
    """The right tangents of the error of Z and X, (12,)."""
    return np.concatenate([log_se3(inverse(result.T_base_still) @ Z), log_se3(inverse(result.T_flange_held) @ X)])
