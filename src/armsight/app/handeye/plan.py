"""The poses to take next: those that lower the sigma of the mounting most.

In: a calibration and its poses. Out: poses of the flange, the sigma after each, and what each is for. Candidates lie near
poses that the arm has taken: each rotates one of them about the target's middle, by no more than ``NEAR_RAD``, the flange
stays within its space, a fifth more, and the target within the part of the image and the distances in which it was seen.
Each next pose is the one whose information, given those before, lowers the trace of the mounting's covariance most (a
radian counting as 0.3 m).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Record
from armsight.geometry.pose import inverse, log_se3, transform
from armsight.geometry.rotation import exp_so3
from armsight.loop.handeye.handeye import HandEye
from armsight.loop.handeye.poses import LEVER_M, Poses

#: Candidates, how far the flange is rotated at most from the nearest pose it had, rad, how much larger its space may
#: become, and by how much the target may leave the part of the image in which its middle was seen, as a tangent.
CANDIDATES, NEAR_RAD, WIDER, BESIDE = 1500, np.radians(25), 0.2, 0.02
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
        nearest: (K,) the pose, of those given, from which the flange rotates least.
        rotated_rad: (K,) by how much, rad.
        moved_m: (K,) the distance from it, m.
        reasons: what each pose lowers most.
    """

    Ts_base_flange: Array
    sigma_m: Array
    sigma_rad: Array
    before: tuple[float, float]
    nearest: NDArray[np.int64]
    rotated_rad: Array
    moved_m: Array
    reasons: tuple[str, ...]


def plan_poses(found: HandEye, poses: Poses, count: int, seed: int = 0) -> PosePlan:
    """Choose the next poses.

    Args:
        found: the calibration.
        poses: the poses it was made from.
        count: how many to choose.
        seed: of the candidates.
    """
    rng = np.random.default_rng(seed)
    A, B = _candidates(found, poses.rows(found.used), rng)
    candidates = Poses(A, B, np.tile(poses.cov.mean(axis=0), (len(A), 1, 1)), poses.in_hand, poses.centre)
    informations = found.informations(candidates)
    weights = np.concatenate([np.zeros(6), np.repeat([1.0, LEVER_M**2], 3)])
    total, before = np.linalg.inv(found.cov), found.cov
    chosen, sigmas, reasons = [], [], []
    for _ in range(count):
        after = np.linalg.inv(total + informations)
        k = int(np.argmin(np.einsum("i,nii->n", weights, after)))
        total = total + informations[k]
        chosen.append(k)
        sigmas.append(worst_sigmas(after[k]))
        reasons.append(_lowered(before[6:, 6:], after[k][6:, 6:], found.T_flange_held[:3, :3]))
        before, informations[k] = after[k], 0.0
    sigma = np.array(sigmas)
    way = log_se3(inverse(poses.A)[None] @ A[chosen][:, None])
    angle = np.linalg.norm(way[..., 3:], axis=2)
    nearest = np.argmin(angle, axis=1)
    moved = np.linalg.norm(A[chosen][:, :3, 3] - poses.A[nearest, :3, 3], axis=1)
    rotated = angle[np.arange(count), nearest]
    return PosePlan(
        A[chosen], sigma[:, 0], sigma[:, 1], worst_sigmas(found.cov), nearest, rotated, moved, tuple(reasons)
    )


def _lowered(before: Array, after: Array, R: Array) -> str:
    """Say which sigma of the mounting falls most, of covariances (6, 6) of its right tangent, m and rad.

    Args:
        before: without the pose.
        after: with it.
        R: (3, 3) from the axes of the mounting to the flange's.
    """
    falls = []
    for part, unit, times, size in ((slice(0, 3), "mm", 1e3, 1.0), (slice(3, 6), "deg", np.degrees(1.0), LEVER_M)):
        values, vectors = np.linalg.eigh(before[part, part] - after[part, part])
        axis = vectors[:, -1]
        named = R @ axis * np.sign((R @ axis)[np.argmax(np.abs(R @ axis))])
        sigmas = [times * float(np.sqrt(axis @ C[part, part] @ axis)) for C in (before, after)]
        along = "along" if unit == "mm" else "about"
        said = f"{along} [{' '.join(f'{v:.1f}' for v in named)}] {sigmas[0]:.3g} to {sigmas[1]:.3g} {unit}"
        falls.append((size**2 * float(values[-1]), said))
    return max(falls)[1]


def worst_sigmas(cov: Array) -> tuple[float, float]:
    """Return the sigmas of the mounting along its worst axes, m and rad, of a covariance (12, 12)."""
    return (float(np.sqrt(np.linalg.eigvalsh(cov[6:9, 6:9])[-1])), float(np.sqrt(np.linalg.eigvalsh(cov[9:, 9:])[-1])))


def _candidates(found: HandEye, poses: Poses, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return poses of the flange and of the body as it would be seen there."""
    p = transform(poses.B, poses.centre)
    distance = np.linalg.norm(p, axis=1)
    k, other = rng.integers(0, len(p), (2, CANDIDATES))
    axis = rng.standard_normal((CANDIDATES, 3))
    angle = NEAR_RAD * rng.uniform(0, 1, CANDIDATES) ** (1 / 3)
    R = exp_so3(axis * (angle / np.linalg.norm(axis, axis=1))[:, None]) @ poses.B[k, :3, :3]
    middle = p[other] * (rng.uniform(distance.min(), distance.max(), CANDIDATES) / distance[other])[:, None]
    B = np.tile(np.eye(4), (CANDIDATES, 1, 1))
    B[:, :3, :3], B[:, :3, 3] = R, middle - R @ poses.centre
    Z, X = found.T_base_still, found.T_flange_held
    A = Z @ inverse(X @ B) if poses.in_hand else Z @ B @ inverse(X)
    seen, was = middle[:, :2] / middle[:, 2:], p[:, :2] / p[:, 2:]
    low, high = poses.A[:, :3, 3].min(axis=0), poses.A[:, :3, 3].max(axis=0)
    margin = WIDER * (high - low) + 0.02
    facing = np.einsum("ni,ni->n", B[:, :3, 2], middle) / np.linalg.norm(middle, axis=1)
    faced = np.einsum("ni,ni->n", poses.B[:, :3, 2], p) / distance
    good = (
        (seen >= was.min(axis=0) - BESIDE).all(axis=1)
        & (seen <= was.max(axis=0) + BESIDE).all(axis=1)
        & (A[:, :3, 3] >= low - margin).all(axis=1)
        & (A[:, :3, 3] <= high + margin).all(axis=1)
        & (facing * np.sign(np.median(faced)) > min(0.6, float(np.abs(faced).min())))
    )
    if not good.any():
        return poses.A, poses.B
    return A[good], B[good]
