"""Hand-eye calibration: where the cameras are to the arm, from motions of the arm while they watch.

In: poses of the flange in the base (from the joints) and of the body in the rig (from vision, with covariance), pairwise.
Out: :class:`HandEye` with both unknown transforms, their covariance, and the error on poses left out of the fit. Eye to
hand, T_base_flange T_flange_body = T_base_rig T_rig_body; eye in hand, T_base_flange T_flange_rig T_rig_body =
T_base_body. Closed-form starts, then maximum likelihood; equations in docs/handeye.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from armsight.data import Array, Record
from armsight.errors import CalibrationError, InputError
from armsight.geometry.check import checked
from armsight.geometry.pose import inverse, log_se3, transform
from armsight.loop.handeye_fit import SHARES, Fit, Poses, Share, fit, information
from armsight.loop.handeye_start import starts

Eye = Literal["to_hand", "in_hand"]
#: Parts into which the poses are cut for the held-out error.
FOLDS = 10
#: Fewest poses: three determine both transforms, and what is left out must leave three.
LEAST = 4
#: Starts that are refined; the best of them by likelihood is kept.
REFINED = 3
#: Another share than the first must lower the held-out error by this factor: less is chance with tens of poses.
CLEARLY = 1.1
#: A direction worse determined than this (sigma, m or rad, for an arm that is off by 1 mm and 1 mrad) is not determined.
UNDETERMINED = 1.0


@dataclass(frozen=True, eq=False)
class HeldOut(Record):
    """How far poses left out of the fit were predicted wrong.

    Attributes:
        position_m: (N,) distance between the body's middle seen and predicted; NaN where a pose was not used.
        angle_rad: (N,) angle between the body's turns seen and predicted.
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
        sigma_flange_m: how far the flange is off what the joints say, sigma along one axis, m.
        sigma_flange_rad: the same of its turn about one axis, rad.
        sigma_seen_m: how far what is seen is off beyond its covariance, sigma of the body's middle along one axis, m.
        sigma_seen_rad: the same of its turn about one axis, rad.
        share: who was found to have the share of the error that was not given, one of ``handeye_fit.SHARES``.
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
    """Find where the rig is to the arm.

    Args:
        Ts_base_flange: (N, 4, 4) the flange in the base, from the joints, m; the turns must differ about two axes at least.
        Ts_rig_body: (N, 4, 4) the body in the rig at the same instants, m (``PoseEstimate.T_left_body``).
        covs: (N, 6, 6) covariance of the latter, right tangent (``PoseEstimate.cov``); None: not known.
        eye: "to_hand" where the rig stands still and the arm carries the body, "in_hand" where the arm carries the rig.
        centre: (3,) the middle of the body's points, body frame, m: what is seen turns about it where vision is off.
            None: the body's origin.
        folds: parts for the held-out error; each is predicted by a fit to the others.
        shares: who may have the share of the error that is not given; the held-out error of place chooses.
        progress: is told what is being done.

    Raises:
        InputError: wrong shapes, NaN, no rigid motions, fewer than 4 poses.
        CalibrationError: the motions leave a direction undetermined.
    """
    poses = _poses(Ts_base_flange, Ts_rig_body, covs, eye, np.zeros(3) if centre is None else centre)
    progress("hand-eye: fitting")
    candidates = starts(poses.A, poses.turned)[:REFINED]
    found: list[HandEye] = []
    for share in shares:
        result = _best(poses, candidates, share)
        _require_determined(poses, result)
        progress(f"hand-eye: errors on poses left out ({share})")
        held_out = _held_out(poses, result, folds, share)
        found.append(HandEye(eye, result.Z, result.X, result.cov, *result.sigma, share, held_out, result.used))
    return min(found, key=lambda h: h.held_out.rms()[0] * (1.0 if h.share == shares[0] else CLEARLY))


def _poses(A: ArrayLike, B: ArrayLike, covs: ArrayLike | None, eye: Eye, centre: ArrayLike) -> Poses:
    """Check what is given once."""
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
    if n < LEAST:
        raise InputError(f"hand-eye calibration needs {LEAST} or more poses, got {n}; 15 and more are advised")
    cov = np.zeros((n, 6, 6)) if covs is None else checked(covs, (n, 6, 6), "covs")
    return Poses(Ts_base_flange, Ts_rig_body, cov, eye == "in_hand", checked(centre, (3,), "centre"))


def _best(poses: Poses, candidates: list[tuple[Array, Array]], share: Share) -> Fit:
    """Return the fit that uses most poses, and of those the one with the smallest sigmas."""
    fits = [fit(poses, candidate, share) for candidate in candidates]
    return min(fits, key=lambda f: (-int(f.used.sum()), sum(f.sigma)))


def _require_determined(poses: Poses, result: Fit) -> None:
    """Refuse motions that leave a direction of the twelve open."""
    H = information(poses.rows(result.used), result.Z, result.X, (1e-3, 1e-3, 0.0, 0.0))
    values, vectors = np.linalg.eigh(H)
    if values[0] > 1 / UNDETERMINED**2:
        return
    names = [
        f"{what} {kind} {axis}"
        for what in (_still(poses), _held(poses))
        for kind in ("shift", "turn")
        for axis in "xyz"
    ]
    most = ", ".join(names[i] for i in np.argsort(-np.abs(vectors[:, 0]))[:2])
    raise CalibrationError(
        f"the motions do not determine the hand-eye calibration ({most} can be anything): the flange must turn about two "
        "axes that are not parallel, by 20 degrees and more; turn the wrist between poses"
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
        wanted = np.broadcast_to(f.Z, B.shape) if poses.in_hand else f.Z @ B
        position[part] = np.linalg.norm(transform(seen, poses.centre) - transform(wanted, poses.centre), axis=1)
        angle[part] = np.linalg.norm(log_se3(inverse(wanted) @ seen)[:, 3:], axis=1)
    return HeldOut(position, angle)
