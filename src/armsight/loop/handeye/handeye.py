"""Hand-eye calibration: where the cameras are to the arm, from motions of the arm while they watch.

In: poses of the flange in the base (from the joints) and of the body in the rig (from vision, with covariance), pairwise.
Out: :class:`HandEye` with both unknown transforms, their covariance, and the error on poses left out of the fit. Eye to
hand, T_base_flange T_flange_body = T_base_rig T_rig_body; eye in hand, T_base_flange T_flange_rig T_rig_body =
T_base_body. Both are A_i X = Z B_i. Equations: docs/howto/handeye.md. The file in order:

1. Maximum likelihood (:func:`fit`). The residual of a pose is the tangent of the motion left over, in the axes of what the
   camera measured. Its covariance is the one given, plus that of an unknown share (``SHARES``): of the flange, about the
   flange, or of the measured body, about its middle, mapped by the adjoint. The sigmas of position and rotation are those
   of the greatest restricted likelihood (Patterson and Thompson, Biometrika 58, 1971).
2. Closed-form starts (:func:`starts`), from all poses and from small parts of them: rotations by the leading singular
   vectors of the Kronecker sum, translations by linear least squares (Shah, "Solving the robot-world/hand-eye calibration
   problem using the Kronecker product", J. Mechanisms Robotics 5(3), 2013). OpenCV's solvers are tried beside it where the
   installed OpenCV has them (5.0 has not).
3. The calibration (:func:`calibrate_handeye`): input checks, starts, fits, held-out errors.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize
from scipy.special import chdtri

from armsight.data import Array, Record
from armsight.errors import CalibrationError, InputError
from armsight.geometry.check import checked
from armsight.geometry.pose import adjoint, exp_se3, inverse, log_se3, mean_pose, pose, small_adjoint, transform
from armsight.geometry.rotation import nearest_rotation, skew

#: A pose whose residual has a smaller chance than this is taken for a mistake and left out.
CHANCE = 1e-5
#: Gauss-Newton steps at most, and the step (m, rad) below which it has converged.
STEPS, CONVERGED = 30, 1e-10
#: Poses that the sigmas are estimated from at most, spread evenly.
MAX_SIGMA_POSES = 200
#: The sigmas are looked for between these, m and rad: beyond, they are zero, or no arm.
MIN_SIGMA, MAX_SIGMA = 1e-7, 0.1


Sigmas = tuple[float, float, float, float]
Share = Literal["flange", "seen", "positions"]
#: What the error beyond the covariance given is attributed to: the flange (its joints); the measured body ("seen"); or the
#: measured body's positions, with hardly any weight on its rotations: an arm's rotations and its positions may contradict
#: each other by more than either scatters.
SHARES: tuple[Share, ...] = ("flange", "seen", "positions")
#: Sigma of rotations that have hardly any weight, rad: enough to determine what positions leave open.
HARDLY = 0.005


@dataclass(frozen=True, eq=False)
class Poses(Record):
    """What a hand-eye calibration is made from.

    Attributes:
        A: (N, 4, 4) T_base_flange, m.
        B: (N, 4, 4) T_rig_body, m.
        cov: (N, 6, 6) covariance of B, right tangent, zero where unknown.
        in_hand: whether the rig is on the flange and the body stands still; else the body is on the flange.
        centre: (3,) the middle of what is seen of the body, body frame, m.
        common: (N, 6, K) what K independent errors that all poses share (the rig's calibration), of one sigma each, do to
            B, right tangent; None where unknown.
    """

    A: Array
    B: Array
    cov: Array
    in_hand: bool
    centre: Array
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


@dataclass(frozen=True, eq=False)
class Fit(Record):
    """The unknown transforms of A_i X = Z B_i.

    Attributes:
        Z: (4, 4) what stands still, in the base.
        X: (4, 4) what the flange carries, in the flange.
        cov: (12, 12) covariance of the right tangents of Z and X, in this order.
        sigma: sigmas along or about one axis: the flange's position, m, and rotation, rad; those of the body's middle,
            beyond the covariance given.
        used: (N,) whether a pose was used.
    """

    Z: Array
    X: Array
    cov: Array
    sigma: Sigmas
    used: NDArray[np.bool_]


def residuals(poses: Poses, Z: Array, X: Array) -> tuple[Array, Array, Array]:
    """Return residuals, their derivative, and the adjoints that map an error of the flange to them.

    Returns:
        (N, 6) residuals e in the axes of the body, (N, 6, 12) their derivative by the right tangents of Z and X, exact to
        the square of e, and (N, 6, 6).
    """
    if poses.in_hand:
        M, last = X @ poses.B, poses.B  # E = Z^-1 A X B
        E = inverse(Z) @ poses.A @ M
        by_x = adjoint(inverse(last))
    else:
        M = np.broadcast_to(X, poses.A.shape)  # E = B^-1 Z^-1 A X
        E = inverse(Z @ poses.B) @ poses.A @ M
        by_x = np.broadcast_to(np.eye(6), (len(poses.A), 6, 6))
    # A change of Z acts from the left of what follows it.
    by_z = -adjoint(inverse(E) if poses.in_hand else inverse(poses.A @ M) @ Z)
    e = log_se3(E)
    bend = np.eye(6) + 0.5 * small_adjoint(e)  # the right Jacobian's inverse, to first order
    return e, np.concatenate([bend @ by_z, bend @ by_x], axis=2), adjoint(inverse(M))


def covariances(poses: Poses, carry: Array, sigma: Sigmas) -> Array:
    """Return the covariance (N, 6, 6) of residuals: what is given, the flange's carried over, and the body's."""
    flange, body = np.repeat(np.square(sigma[:2]), 3), np.repeat(np.square(sigma[2:]), 3)
    about = np.eye(6)
    about[:3, 3:] = skew(poses.centre)  # the adjoint of the translation from the body's origin to its middle
    return np.asarray(poses.cov + (carry * flange) @ np.swapaxes(carry, 1, 2) + (about * body) @ about.T)


def fit(poses: Poses, start: tuple[Array, Array], share: Share) -> Fit:
    """Fit both transforms, the unknown sigmas, and which poses are mistakes.

    Args:
        poses: at least three.
        start: X and Z near the answer.
        share: who has the share of the error that is not given.
    """
    X, Z = start
    sigma = _robust_sigma(poses, Z, X, share)
    used = np.ones(len(poses.A), bool)
    for _ in range(8):
        e, _, carry = residuals(poses, Z, X)
        far = _squares(e, covariances(poses, carry, sigma))
        keep = far < chdtri(6, CHANCE)
        if keep.sum() < max(3, len(keep) // 2):  # no half can be a mistake: then the sigmas are what is wrong
            keep = far <= np.sort(far)[max(3, len(keep) // 2) - 1]
        part = poses.rows(keep)
        Z, X = _newton(part, Z, X, sigma)
        sigma_new = _variance(part, Z, X, sigma, share)
        settled = bool((keep == used).all()) and bool(np.allclose(sigma_new, sigma, rtol=0.02, atol=1e-8))
        used, sigma = keep, sigma_new
        if settled:
            break
    part = poses.rows(used)
    Z, X = _newton(part, Z, X, sigma)
    return Fit(Z, X, np.asarray(np.linalg.inv(information(part, Z, X, sigma))), sigma, used)


def information(poses: Poses, Z: Array, X: Array, sigma: Sigmas) -> Array:
    """Return the information (12, 12) about the right tangents of Z and X."""
    _, J, carry = residuals(poses, Z, X)
    WJ = np.linalg.solve(covariances(poses, carry, sigma), J)
    return np.asarray(np.einsum("nki,nkj->ij", J, WJ))


def _squares(e: Array, cov: Array) -> Array:
    """Return the squared Mahalanobis lengths (N,)."""
    return np.asarray(np.einsum("ni,ni->n", e, np.linalg.solve(cov, e[..., None])[..., 0]))


def _shared(position: float, rotation: float, share: Share) -> Sigmas:
    """Return the four sigmas of a share."""
    if share == "flange":
        return position, rotation, 0.0, 0.0
    return 0.0, 0.0, position, rotation if share == "seen" else HARDLY


def _robust_sigma(poses: Poses, Z: Array, X: Array, share: Share) -> Sigmas:
    """Return sigmas along one axis from the median residual, which mistakes do not reach."""
    e, _, _ = residuals(poses, Z, X)
    middle = np.sqrt(chdtri(3, 0.5))
    position, rotation = (float(np.median(np.linalg.norm(part, axis=1))) / middle for part in (e[:, :3], e[:, 3:]))
    return _shared(max(position, MIN_SIGMA), max(rotation, MIN_SIGMA), share)


def _newton(poses: Poses, Z: Array, X: Array, sigma: Sigmas) -> tuple[Array, Array]:
    """Minimise the weighted squares over both transforms."""
    for _ in range(STEPS):
        e, J, carry = residuals(poses, Z, X)
        WJ = np.linalg.solve(covariances(poses, carry, sigma), J)
        step = -np.linalg.lstsq(np.einsum("nki,nkj->ij", J, WJ), np.einsum("nki,nk->i", WJ, e), rcond=1e-15)[0]
        Z, X = Z @ exp_se3(step[:6]), X @ exp_se3(step[6:])
        if np.abs(step).max() < CONVERGED:
            break
    return Z, X


def _variance(poses: Poses, Z: Array, X: Array, sigma: Sigmas, share: Share) -> Sigmas:
    """Return the sigmas of the greatest restricted likelihood."""
    if len(poses.A) > MAX_SIGMA_POSES:
        poses = poses.rows(np.linspace(0, len(poses.A) - 1, MAX_SIGMA_POSES).astype(np.int64))
    e, _, carry = residuals(poses, Z, X)
    freedom = max(1 - 12 / e.size, 1 / e.size)  # what the fit has left of the residuals'
    low, high = np.log(MIN_SIGMA), np.log(MAX_SIGMA)

    def shared(logs: Array) -> Sigmas:
        position, rotation = np.exp(np.clip(logs, low, high))
        return _shared(float(position), float(rotation), share)

    def cost(logs: Array) -> float:
        C = covariances(poses, carry, shared(logs))
        return float(freedom * np.linalg.slogdet(C)[1].sum() + _squares(e, C).sum())

    start = np.log(np.maximum(sigma[:2] if share == "flange" else sigma[2:], MIN_SIGMA))
    best = minimize(cost, start, method="Nelder-Mead", options={"xatol": 1e-2, "fatol": 1e-3})
    return shared(best.x)


#: OpenCV as it is at run time: its type stubs are those of one version.
_CV: Any = cv2
#: Parts of this many poses are tried too, so that some of them are free of gross errors.
PART = 6
#: How many parts: with 20 % gross errors all of them would hold one with a chance of (1 - 0.8^6)^24, 0.1 %.
PARTS = 24
#: Share of the poses that must be good: the scale of residuals is that of the best so many. A median breaks down where half
#: are blunders.
MIDDLE = 0.4
#: Share of the pairs of rows that count as agreeing: where half of the rows are good, a quarter does. With more rows than
#: this none are looked for.
AGREE, MOST_AGREEING = 0.15, 300
#: Weight of a rotation in the score, m/rad: 1 mrad counts as 0.3 mm, as it does at a tool 0.3 m from the wrist.
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
    if len(rows := _agreeing(A, B)) >= MIN_POSES:
        found.append(kronecker(A[rows], B[rows]))
    found = [
        (X, Z) for X, Z in found if np.isfinite(X).all() and np.isfinite(Z).all() and _is_rigid(X) and _is_rigid(Z)
    ]
    return sorted(found, key=lambda XZ: _score(A, B, *XZ))


def _agreeing(A: Array, B: Array) -> NDArray[np.int64]:
    """Return the rows that agree with that with which most do: between two rows both sides rotate by one angle.

    Blunders hardly agree with anything, so these are good ones though half of the rows are not.
    """
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
    return nearest_rotation(M * np.sign(np.linalg.det(M)))


def _opencv(A: Array, B: Array) -> Iterator[tuple[Array, Array]]:
    """Yield what OpenCV's solvers find, where it has them and they accept the poses."""
    back = inverse(B)
    for name in _OPENCV_MOTIONS if hasattr(cv2, "calibrateHandEye") else ():
        with contextlib.suppress(cv2.error):
            R, t = _CV.calibrateHandEye(*_parts(A), *_parts(back), method=getattr(cv2, name))
            X = pose(R, t.ravel())
            if np.isfinite(X).all():  # OpenCV 4 answers degenerate poses with NaN
                yield X, mean_pose(A @ X @ back)
    for name in _OPENCV if hasattr(cv2, "calibrateRobotWorldHandEye") else ():
        with contextlib.suppress(cv2.error):
            RX, tX, RZ, tZ = _CV.calibrateRobotWorldHandEye(*_parts(A), *_parts(B), method=getattr(cv2, name))
            yield pose(RX, tX.ravel()), pose(RZ, tZ.ravel())


def _parts(Ts: Array) -> tuple[list[Array], list[Array]]:
    return [T[:3, :3] for T in Ts], [T[:3, 3] for T in Ts]


def _is_rigid(T: Array) -> bool:
    """Return whether a solver's answer is a rigid motion at all."""
    return bool(np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() < 1e-6 and np.linalg.det(T[:3, :3]) > 0)


def _score(A: Array, B: Array, X: Array, Z: Array) -> float:
    """Return the size of the residual motions below which the share MIDDLE is, m."""
    e = log_se3(inverse(Z @ B) @ A @ X)
    sizes = np.hypot(np.linalg.norm(e[:, :3], axis=1), LEVER_M * np.linalg.norm(e[:, 3:], axis=1))
    return float(np.quantile(sizes, MIDDLE))


Eye = Literal["to_hand", "in_hand"]
#: Parts into which the poses are cut for the held-out error.
FOLDS = 10
#: Fewest poses: three determine both transforms, and what is left out must leave three.
MIN_POSES = 4
#: Starts that are refined; the best of them by likelihood is kept.
REFINED = 3
#: Another share than the first must lower the held-out error by this factor: less is chance with tens of poses.
CLEARLY = 1.1
#: A direction worse determined than this (sigma, m or rad, for an arm that is off by 1 mm and 1 mrad) is not determined.
UNDETERMINED = 1.0


@dataclass(frozen=True, eq=False)
class HeldOut(Record):
    """Prediction errors of poses left out of the fit.

    Attributes:
        position_m: (N,) distance between the body's middle measured and predicted; NaN where a pose was not used.
        angle_rad: (N,) angle between the body's rotations measured and predicted.
    """

    position_m: Array
    angle_rad: Array

    def mean(self) -> tuple[float, float]:
        """Return the means, m and rad."""
        return float(np.nanmean(self.position_m)), float(np.nanmean(self.angle_rad))

    def rms(self) -> tuple[float, float]:
        """Return the root mean squares, m and rad."""
        return float(np.sqrt(np.nanmean(self.position_m**2))), float(np.sqrt(np.nanmean(self.angle_rad**2)))

    def most(self) -> tuple[float, float]:
        """Return the greatest, m and rad."""
        return float(np.nanmax(self.position_m)), float(np.nanmax(self.angle_rad))


@dataclass(frozen=True, eq=False)
class HandEye(Record):
    """A hand-eye calibration.

    Attributes:
        eye: "to_hand": the rig stands still and the flange carries the body; "in_hand": the other way round.
        T_base_still: (4, 4) what stands still, in the base: the rig, or in_hand the body.
        T_flange_held: (4, 4) what the flange carries: the body, or in_hand the rig.
        cov: (12, 12) covariance of the right tangents of T_base_still and T_flange_held, in this order, m and rad.
        sigma_flange_m: error of the flange by the joints, sigma along one axis, m.
        sigma_flange_rad: the same of its rotation about one axis, rad.
        sigma_seen_m: error of the measured body beyond its covariance, sigma of its middle along one axis, m.
        sigma_seen_rad: the same of its rotation about one axis, rad.
        share: what the error beyond the covariance given was attributed to, one of ``SHARES``.
        held_out: the error on poses left out of the fit.
        used: (N,) whether a pose was used, and not taken for a mistake.
    """

    eye: Eye
    T_base_still: Array
    T_flange_held: Array
    cov: Array
    sigma_flange_m: float
    sigma_flange_rad: float
    sigma_seen_m: float
    sigma_seen_rad: float
    share: Share
    held_out: HeldOut
    used: NDArray[np.bool_]

    @property
    def T_base_rig(self) -> Array:
        """(4, 4) the rig in the base; eye to hand only."""
        return self._of("to_hand", "T_base_rig", self.T_base_still)

    @property
    def T_flange_body(self) -> Array:
        """(4, 4) the body on the flange; eye to hand only."""
        return self._of("to_hand", "T_flange_body", self.T_flange_held)

    @property
    def T_flange_rig(self) -> Array:
        """(4, 4) the rig on the flange; eye in hand only."""
        return self._of("in_hand", "T_flange_rig", self.T_flange_held)

    @property
    def T_base_body(self) -> Array:
        """(4, 4) the body in the base; eye in hand only."""
        return self._of("in_hand", "T_base_body", self.T_base_still)

    def _of(self, eye: Eye, name: str, T: Array) -> Array:
        if self.eye != eye:
            raise InputError(f"{name} is not constant with the eye {self.eye!r}; it belongs to {eye!r}")
        return T

    def predict(self, Ts_base_flange: Array) -> Array:
        """Return T_rig_body (..., 4, 4) at poses of the flange (..., 4, 4)."""
        if self.eye == "in_hand":
            return np.asarray(inverse(Ts_base_flange @ self.T_flange_held) @ self.T_base_still)
        return np.asarray(inverse(self.T_base_still) @ Ts_base_flange @ self.T_flange_held)


def calibrate_handeye(
    Ts_base_flange: ArrayLike,
    Ts_rig_body: ArrayLike,
    covs: ArrayLike | None = None,
    *,
    eye: Eye = "to_hand",
    centre: ArrayLike | None = None,
    folds: int = FOLDS,
    shares: tuple[Share, ...] = SHARES,
    progress: Callable[[str], None] = lambda line: None,
) -> HandEye:
    """Calibrate the two constant transforms of rig, body and arm.

    Args:
        Ts_base_flange: (N, 4, 4) the flange in the base, from the joints, m; it must rotate about two axes at least.
        Ts_rig_body: (N, 4, 4) the body in the rig at the same instants, m (``PoseEstimate.T_left_body``).
        covs: (N, 6, 6) covariance of the latter, right tangent (``PoseEstimate.cov``); None: not known.
        eye: "to_hand" where the rig stands still and the arm carries the body, "in_hand" where the arm carries the rig.
        centre: (3,) the middle of the body's points, body frame, m: errors of vision rotate the body about it.
            None: the body's origin.
        folds: parts for the held-out error; each is predicted by a fit to the others.
        shares: what the error beyond the covariance given may be attributed to; the held-out position error decides.
        progress: called with the name of each step as it begins.

    Raises:
        InputError: wrong shapes, NaN, no rigid motions, fewer than 4 poses.
        CalibrationError: the motions leave a direction undetermined.
    """
    poses = _poses(Ts_base_flange, Ts_rig_body, covs, eye, np.zeros(3) if centre is None else centre)
    progress("hand-eye: fitting")
    candidates = starts(poses.A, poses.right_side)[:REFINED]
    found: list[HandEye] = []
    for share in shares:
        result = _best(poses, candidates, share)
        _require_determined(poses, result)
        progress(f"hand-eye: errors on poses left out ({share})")
        held_out = _held_out(poses, result, folds, share)
        found.append(HandEye(eye, result.Z, result.X, result.cov, *result.sigma, share, held_out, result.used))
    return min(found, key=lambda h: h.held_out.rms()[0] * (1.0 if h.share == shares[0] else CLEARLY))


def _poses(A: ArrayLike, B: ArrayLike, covs: ArrayLike | None, eye: Eye, centre: ArrayLike) -> Poses:
    """Check the input, once."""
    if eye not in ("to_hand", "in_hand"):
        raise InputError(f"eye is {eye!r}; known are to_hand, in_hand")
    Ts_base_flange = checked(A, (None, 4, 4), "Ts_base_flange")
    Ts_rig_body = checked(B, (len(Ts_base_flange), 4, 4), "Ts_rig_body")
    for name, Ts in (("Ts_base_flange", Ts_base_flange), ("Ts_rig_body", Ts_rig_body)):
        R = Ts[:, :3, :3]
        off = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).reshape(-1, 9).max(axis=1)
        bad = (off > 1e-4) | (np.linalg.det(R) < 0) if len(Ts) else np.zeros(0, bool)
        if bad.any():
            raise InputError(f"{name}: pose {int(np.argmax(bad))} is no rigid motion: its 3x3 part is no rotation")
    n = len(Ts_base_flange)
    if n < MIN_POSES:
        raise InputError(f"hand-eye calibration needs {MIN_POSES} or more poses, got {n}; 15 and more are advised")
    cov = np.zeros((n, 6, 6)) if covs is None else checked(covs, (n, 6, 6), "covs")
    return Poses(Ts_base_flange, Ts_rig_body, cov, eye == "in_hand", checked(centre, (3,), "centre"))


def _best(poses: Poses, candidates: list[tuple[Array, Array]], share: Share) -> Fit:
    """Return the fit that uses most poses, and of those the one with the smallest sigmas."""
    fits = [fit(poses, candidate, share) for candidate in candidates]
    return min(fits, key=lambda f: (-int(f.used.sum()), sum(f.sigma)))


def _require_determined(poses: Poses, result: Fit) -> None:
    """Reject motions that leave a direction of the twelve undetermined."""
    H = information(poses.rows(result.used), result.Z, result.X, (1e-3, 1e-3, 0.0, 0.0))
    values, vectors = np.linalg.eigh(H)
    if values[0] > 1 / UNDETERMINED**2:
        return
    names = [
        f"{what} {kind} {axis}"
        for what in (_still(poses), _held(poses))
        for kind in ("translation", "rotation")
        for axis in "xyz"
    ]
    most = ", ".join(names[i] for i in np.argsort(-np.abs(vectors[:, 0]))[:2])
    raise CalibrationError(
        f"the motions do not determine the hand-eye calibration ({most} can be anything): the flange must rotate about "
        "two axes that are not parallel, by 20 degrees and more; rotate the wrist between poses"
    )


def _still(poses: Poses) -> str:
    return "base-body" if poses.in_hand else "base-rig"


def _held(poses: Poses) -> str:
    return "flange-rig" if poses.in_hand else "flange-body"


def _held_out(poses: Poses, result: Fit, folds: int, share: Share) -> HeldOut:
    """Predict every used pose by a fit to the other parts."""
    used = np.flatnonzero(result.used)
    position, angle = np.full(len(poses.A), np.nan), np.full(len(poses.A), np.nan)
    order = np.random.default_rng(0).permutation(used)
    for part in np.array_split(order, min(max(folds, 2), len(used))):
        others = np.setdiff1d(used, part)
        f = fit(poses.rows(others), (result.X, result.Z), share)
        A, B = poses.A[part], poses.B[part]
        seen = A @ f.X @ B if poses.in_hand else A @ f.X
        predicted = np.broadcast_to(f.Z, B.shape) if poses.in_hand else f.Z @ B
        position[part] = np.linalg.norm(transform(seen, poses.centre) - transform(predicted, poses.centre), axis=1)
        angle[part] = np.linalg.norm(log_se3(inverse(predicted) @ seen)[:, 3:], axis=1)
    return HeldOut(position, angle)
