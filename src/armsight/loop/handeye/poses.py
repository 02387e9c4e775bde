"""What a hand-eye calibration is made from: poses, their residuals, closed-form starts, errors of poses left out.

In: poses of the flange in the base (from the joints) and of the body in the rig (from vision), pairwise. Eye to hand,
T_base_flange T_flange_body = T_base_rig T_rig_body; eye in hand, T_base_flange T_flange_rig T_rig_body = T_base_body. Both
are A_i X = Z B_i. Equations: docs/howto/handeye.md.

The residual of a pose is the tangent of the motion left over, in the axes of what the camera measured. Starts
(:func:`starts`) come from all poses and from small parts of them: rotations by the leading singular vectors of the
Kronecker sum, translations by linear least squares (Shah, "Solving the robot-world/hand-eye calibration problem using the
Kronecker product", J. Mechanisms Robotics 5(3), 2013).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from armsight.data import Array, Record
from armsight.errors import InputError
from armsight.geometry.check import checked
from armsight.geometry.pose import adjoint, exp_se3, inverse, log_se3, pose, small_adjoint
from armsight.geometry.rotation import nearest_rotation
from armsight.tables.poses import FAR_M

CHANCE = 1e-5  # a pose whose residual has a smaller chance than this is taken for a mistake and left out


@dataclass(frozen=True, eq=False)
class Poses(Record):
    """What a hand-eye calibration is made from."""

    A: Array  #: (N, 4, 4) T_base_flange, m
    B: Array  #: (N, 4, 4) T_rig_body, m
    cov: Array  #: (N, 6, 6) covariance of B, right tangent, zero where unknown
    in_hand: bool  #: whether the rig is on the flange and the body stands still; else the body is on the flange
    centre: Array  #: (3,) the middle of what is seen of the body, body frame, m
    #: (N, 6, K) what K errors that all poses share (the rig's), of one sigma each, do to B, right tangent; None if
    #: unknown
    common: Array | None = None

    def rows(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> Poses:
        """Return a part of the poses."""
        common = None if self.common is None else self.common[rows]
        return Poses(self.A[rows], self.B[rows], self.cov[rows], self.in_hand, self.centre, common)

    def corrected(self, errors: Array) -> Poses:
        """Return the poses without shared errors (K,), in sigmas."""
        return self if self.common is None else replace(self, B=self.B @ exp_se3(self.common @ errors))

    @property
    def right_side(self) -> Array:
        """(N, 4, 4) the poses B of A_i X = Z B_i."""
        return inverse(self.B) if self.in_hand else self.B


def residuals(poses: Poses, Z: Array, X: Array) -> tuple[Array, Array, Array]:
    """Return residuals, their derivative, and the adjoints that map an error of the flange to them.

    Returns:
        (N, 6) residuals e in the axes of the body, (N, 6, 12) their derivative by the right tangents of Z and X, exact to
        the square of e, and (N, 6, 6).
    """
    if poses.in_hand:
        M = X @ poses.B  # E = Z^-1 A X B
        E = inverse(Z) @ poses.A @ M
        by_x = adjoint(inverse(poses.B))
    else:
        M = np.broadcast_to(X, poses.A.shape)  # E = B^-1 Z^-1 A X
        E = inverse(Z @ poses.B) @ poses.A @ M
        by_x = np.broadcast_to(np.eye(6), (len(poses.A), 6, 6))
    # A change of Z acts from the left of what follows it.
    by_z = -adjoint(inverse(E) if poses.in_hand else inverse(poses.A @ M) @ Z)
    e = log_se3(E)
    bend = np.eye(6) + 0.5 * small_adjoint(e)  # the right Jacobian's inverse, to first order
    return e, np.concatenate([bend @ by_z, bend @ by_x], axis=2), adjoint(inverse(M))


PART = 6  # parts of this many poses are tried too, so that some of them are free of gross errors
PARTS = 24  # how many parts: with 20 % gross errors all of them would hold one with a chance of (1 - 0.8^6)^24, 0.1 %
#: Share of the poses that must be good: the scale of residuals is that of the best so many.
MIDDLE = 0.4
#: Share of the pairs of rows that count as agreeing; with more rows than this none are looked for.
AGREE, MOST_AGREEING = 0.15, 300
#: Weight of a rotation in the score, m/rad: 1 mrad counts as 0.3 mm, as it does at a tool 0.3 m from the wrist.
LEVER_M = 0.3


def starts(A: Array, B: Array) -> list[tuple[Array, Array]]:
    """Return candidates for X and Z of ``A_i X = Z B_i``, smallest median residual first.

    ``A``: (N, 4, 4) poses, N >= 3. ``B``: (N, 4, 4) poses.
    """
    rng = np.random.default_rng(0)
    found = [kronecker(A, B)]
    if len(A) > PART:
        parts = np.array([rng.choice(len(A), PART, replace=False) for _ in range(PARTS)])
        found += zip(*kronecker(A[parts], B[parts]), strict=True)
    if len(rows := _agreeing(A, B)) >= MIN_POSES:
        found.append(kronecker(A[rows], B[rows]))
    Xs, Zs = map(np.array, zip(*found, strict=True))
    rigid = np.flatnonzero(_is_rigid(Xs) & _is_rigid(Zs))
    if not len(rigid):
        return []
    order = rigid[np.argsort(_scores(A, B, Xs[rigid], Zs[rigid]), kind="stable")]
    return [(Xs[k], Zs[k]) for k in order]


def _agreeing(A: Array, B: Array) -> NDArray[np.int64]:
    """Return the rows that agree with that with which most do: between two rows both sides rotate by one angle."""
    if len(A) > MOST_AGREEING:
        return np.zeros(0, np.int64)
    cosines = (np.einsum("iab,jab->ij", T[:, :3, :3], T[:, :3, :3]) for T in (A, B))
    angles_A, angles_B = (np.arccos(np.clip((cosine - 1) / 2, -1, 1)) for cosine in cosines)
    off = np.abs(angles_A - angles_B)
    near = off < np.quantile(off[np.triu_indices(len(A), 1)], AGREE)
    return np.flatnonzero(near[near.sum(axis=1).argmax()])


def kronecker(A: Array, B: Array) -> tuple[Array, Array]:
    """Solve ``A_i X = Z B_i`` in closed form: rotations first, then translations.

    With column-stacked matrices, R_A R_X R_B^T = R_Z reads (R_B kron R_A) vec(R_X) = vec(R_Z) for every i, so both are the
    leading singular vectors of the sum of the Kronecker products. A and B are (..., N, 4, 4), X and Z (..., 4, 4).
    """
    RA, RB = A[..., :3, :3], B[..., :3, :3]
    K = np.einsum("...nij,...nkl->...ikjl", RB, RA, optimize=True).reshape(*A.shape[:-3], 9, 9)
    U, _, Vt = np.linalg.svd(K)
    RX, RZ = _rotation(Vt[..., 0, :]), _rotation(U[..., 0])
    # R_A t_X - t_Z = R_Z t_B - t_A
    M = np.concatenate([RA, np.broadcast_to(-np.eye(3), RA.shape)], axis=-1).reshape(*A.shape[:-3], -1, 6)
    right = (B[..., :3, 3] @ np.swapaxes(RZ, -1, -2) - A[..., :3, 3]).reshape(*A.shape[:-3], -1, 1)
    t = (np.linalg.pinv(M) @ right)[..., 0]
    return pose(RX, t[..., :3]), pose(RZ, t[..., 3:])


def _rotation(columns: Array) -> Array:
    """Return the rotations nearest to multiples, of either sign, of rotations given by their columns (..., 9)."""
    M = np.swapaxes(columns.reshape(*columns.shape[:-1], 3, 3), -1, -2)
    return nearest_rotation(M * np.sign(np.linalg.det(M))[..., None, None])


def _is_rigid(Ts: Array) -> NDArray[np.bool_]:
    """Return which of a solver's answers (C, 4, 4) are finite and rigid motions at all."""
    R, finite = Ts[:, :3, :3], np.isfinite(Ts).all(axis=(1, 2))
    off = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(axis=(1, 2))
    return np.asarray(finite & (off < 1e-6) & (np.linalg.det(R) > 0))


def _scores(A: Array, B: Array, Xs: Array, Zs: Array) -> Array:
    """Return of candidates (C, 4, 4) the size of the residual motions below which the share MIDDLE is, (C,), m."""
    e = log_se3(inverse(Zs[:, None] @ B) @ A @ Xs[:, None])
    sizes = np.hypot(np.linalg.norm(e[..., :3], axis=-1), LEVER_M * np.linalg.norm(e[..., 3:], axis=-1))
    return np.asarray(np.quantile(sizes, MIDDLE, axis=1))


Eye = Literal["to_hand", "in_hand", "to-hand", "in-hand"]
MIN_POSES = 4  # fewest poses: three determine both transforms, and what is left out must leave three


class HeldOut(NamedTuple):
    """Prediction errors of poses left out of the fit."""

    #: (N,) distance between the body's middle measured and predicted, (N, K) of K points; NaN of a pose not used
    position_m: Array
    angle_rad: Array  #: (N,) angle between the body's rotations measured and predicted; empty with points only

    def mean(self) -> tuple[float, float]:
        """Return the means, m and rad; NaN where there are none, also below."""
        return self._by(np.nanmean)

    def rms(self) -> tuple[float, float]:
        """Return the root mean squares, m and rad."""
        return self._by(lambda e: np.sqrt(np.nanmean(e**2)))

    def rows(self, rows: NDArray[np.int64]) -> HeldOut:
        """Return a part of full poses."""
        return HeldOut(self.position_m[rows], self.angle_rad[rows])

    def most(self) -> tuple[float, float]:
        """Return the greatest, m and rad."""
        return self._by(np.nanmax)

    def summary(self) -> dict[str, float]:
        """Return mean_m, rms_m and max_m, and of full poses also mean_rad, rms_rad and max_rad."""
        each = {"mean": self.mean(), "rms": self.rms(), "max": self.most()}
        units = ("m", "rad") if self.angle_rad.size else ("m",)
        return {f"{name}_{unit}": values[k] for k, unit in enumerate(units) for name, values in each.items()}

    def _by(self, law: Callable[[Array], float]) -> tuple[float, float]:
        position, angle = (float(law(e)) if e.size else np.nan for e in self)
        return position, angle


def is_in_hand(eye: Eye) -> bool:
    """Return whether the rig is on the flange; InputError where it is neither that nor to hand."""
    if eye not in get_args(Eye):
        raise InputError(f"eye is {eye!r}; known are to_hand, in_hand")
    return eye in ("in_hand", "in-hand")


def checked_poses(A: ArrayLike, B: ArrayLike, covs: ArrayLike | None, eye: Eye, centre: ArrayLike) -> Poses:
    """Return poses as given, checked.

    Raises:
        InputError: wrong shapes, NaN, no rigid motions, an unknown eye.
    """
    in_hand = is_in_hand(eye)
    Ts_base_flange = checked(A, (None, 4, 4), "Ts_base_flange")
    Ts_rig_body = checked(B, (len(Ts_base_flange), 4, 4), "Ts_rig_body")
    for name, Ts in (("Ts_base_flange", Ts_base_flange), ("Ts_rig_body", Ts_rig_body)):
        R = Ts[:, :3, :3]
        off = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).reshape(-1, 9).max(axis=1)
        bad = (off > 1e-4) | (np.linalg.det(R) < 0) if len(Ts) else np.zeros(0, bool)
        if bad.any():
            raise InputError(f"{name}: pose {int(np.argmax(bad))} is no rigid motion: its 3x3 part is no rotation")
        if (bad := (np.abs(Ts[:, 3] - (0.0, 0.0, 0.0, 1.0)) > 1e-4).any(axis=1)).any():
            raise InputError(f"{name}: pose {int(np.argmax(bad))} is no rigid motion: its last row is not 0 0 0 1")
        if (far := np.abs(Ts[:, :3, 3]).max(initial=0.0)) > FAR_M:
            raise InputError(f"{name}: positions of up to {far:.0f} m: are they millimetres? give metres")
    if len(Ts_base_flange) and np.array_equal(Ts_base_flange, Ts_rig_body):
        raise InputError(
            "the robot's poses and those of what was seen are the same numbers: one is the flange in the base, by the "
            "joints, the other the body in the camera"
        )
    shape = (len(Ts_base_flange), 6, 6)
    cov = np.zeros(shape) if covs is None else checked(covs, shape, "covs")
    return Poses(Ts_base_flange, Ts_rig_body, cov, in_hand, checked(centre, (3,), "centre"))
