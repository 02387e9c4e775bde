"""The poses to take next: those that lower the sigma of the mounting most.

In: a calibration and its poses. Out: poses of the flange, and the sigma after each. Candidates are views like those seen
(as far away, as far from the axis) with the body rotated further; the flange stays within its space, a fifth more.
Each next pose is the one whose information, given those before, lowers the trace of the mounting's covariance most (a
radian counting as 0.3 m).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armsight.data import Array, Record
from armsight.geometry.pose import exp_se3, inverse, transform
from armsight.geometry.rotation import exp_so3
from armsight.loop.handeye.handeye import LEVER_M, Poses, residuals
from armsight.loop.handeye.noise import STRUCTURES, error_maps
from armsight.loop.handeye.structured import StructuredHandEye

#: Candidates, how far a body is rotated from how it was seen, rad, and how much larger the flange's space may become.
CANDIDATES, ROTATED_RAD, WIDER = 1500, np.radians(50), 0.2
#: Sigmas taken where a structure has none for the noise: m and rad.
LEAST_M, LEAST_RAD = 1e-5, 1e-5


@dataclass(frozen=True, eq=False)
class PosePlan(Record):
    """Poses to take.

    Attributes:
        Ts_base_flange: (K, 4, 4) the poses.
        sigma_m: (K,) sigma of the mounting's translation along its worst axis after each, m.
        sigma_rad: (K,) the same of its rotation, rad.
        before: the two sigmas now.
    """

    Ts_base_flange: Array
    sigma_m: Array
    sigma_rad: Array
    before: tuple[float, float]


def plan_poses(found: StructuredHandEye, poses: Poses, count: int, seed: int = 0) -> PosePlan:
    """Choose the next poses.

    Args:
        found: the calibration.
        poses: the poses it was made from.
        count: how many to choose.
        seed: of the candidates.
    """
    rng = np.random.default_rng(seed)
    A, B = _candidates(found, poses.rows(found.used), rng)
    candidates = Poses(A, B, np.zeros((len(A), 6, 6)), poses.in_hand, poses.centre)
    _, J, carry = residuals(candidates, found.T_base_still, found.T_flange_held)
    maps = error_maps(candidates, np.zeros((len(candidates.A), 6)), carry, None)
    C = np.mean(poses.cov, axis=0) + np.zeros((len(A), 6, 6))
    for name in STRUCTURES[found.structure]:
        if name in maps:
            C = C + found.sigmas[name] ** 2 * maps[name] @ np.swapaxes(maps[name], 1, 2)
    C = C + np.diag(np.repeat([LEAST_M**2, LEAST_RAD**2], 3))
    informations = np.swapaxes(J, 1, 2) @ np.linalg.solve(C, J)
    weights = np.concatenate([np.zeros(6), np.repeat([1.0, LEVER_M**2], 3)])
    total = np.linalg.inv(found.cov)
    chosen, sigmas = [], []
    for _ in range(count):
        after = np.linalg.inv(total + informations)
        k = int(np.argmin(np.einsum("i,nii->n", weights, after)))
        total = total + informations[k]
        chosen.append(k)
        sigmas.append(worst_sigmas(after[k]))
        informations[k] = 0.0
    sigma = np.array(sigmas)
    return PosePlan(A[chosen], sigma[:, 0], sigma[:, 1], worst_sigmas(found.cov))


def worst_sigmas(cov: Array) -> tuple[float, float]:
    """Return the sigmas of the mounting along its worst axes, m and rad, of a covariance (12, 12)."""
    return (
        float(np.sqrt(np.linalg.eigvalsh(cov[6:9, 6:9])[-1])),
        float(np.sqrt(np.linalg.eigvalsh(cov[9:, 9:])[-1])),
    )


def _candidates(found: StructuredHandEye, poses: Poses, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return poses of the flange and of the body as it would be seen there."""
    p = transform(poses.B, poses.centre)
    distance = np.linalg.norm(p, axis=1)
    off_axis = float(np.max(np.linalg.norm(p[:, :2], axis=1) / distance))
    k = rng.integers(0, len(p), CANDIDATES)
    rotated = np.concatenate(
        [np.zeros((CANDIDATES, 3)), rng.uniform(-ROTATED_RAD, ROTATED_RAD, (CANDIDATES, 3))], axis=1
    )
    around = np.eye(4)
    around[:3, 3] = poses.centre
    B = poses.B[k] @ around @ exp_se3(rotated) @ inverse(around)
    roll = exp_so3(np.outer(rng.uniform(-np.pi, np.pi, CANDIDATES), [0.0, 0.0, 1.0]))
    B[:, :3] = roll @ B[:, :3]  # the whole view, about the camera's axis
    B[:, :3, 3] *= rng.uniform(distance.min(), distance.max(), CANDIDATES)[:, None] / distance[k, None]
    Z, X = found.T_base_still, found.T_flange_held
    A = Z @ inverse(X @ B) if poses.in_hand else Z @ B @ inverse(X)
    seen = transform(B, poses.centre)
    low, high = poses.A[:, :3, 3].min(axis=0), poses.A[:, :3, 3].max(axis=0)
    margin = WIDER * (high - low) + 0.02
    facing = np.einsum("ni,ni->n", B[:, :3, 2], seen) / np.linalg.norm(seen, axis=1)
    faced = np.einsum("ni,ni->n", poses.B[:, :3, 2], p) / distance
    good = (
        (np.linalg.norm(seen[:, :2], axis=1) / np.linalg.norm(seen, axis=1) <= off_axis + 0.02)
        & (A[:, :3, 3] >= low - margin).all(axis=1)
        & (A[:, :3, 3] <= high + margin).all(axis=1)
        & (facing * np.sign(np.median(faced)) > min(0.6, float(np.abs(faced).min())))
    )
    if not good.any():
        return poses.A, poses.B
    return A[good], B[good]
