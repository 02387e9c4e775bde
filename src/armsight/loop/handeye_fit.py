"""Maximum likelihood of a hand-eye calibration: poses with covariance, an arm and a vision that are off by unknown amounts.

In: poses of the flange and of what is seen, with covariance, and a start. Out: both unknown transforms, their covariance,
and how far arm and vision are off. The residual of a pose is the tangent, in the axes of what the camera measured, of the
motion left over. Its covariance is what is given, plus that of an unknown share (``SHARES``): of the flange, about the
flange, or of what is seen, about its middle, carried over by the adjoint. Its sigmas of place and turn are those of the
greatest restricted likelihood (Patterson and Thompson, Biometrika 58, 1971).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import chdtri

from armsight.data import Array, Record
from armsight.geometry.pose import exp_se3, inverse, log_se3
from armsight.geometry.rotation import skew

#: A pose whose residual has a smaller chance than this is taken for a mistake and left out.
CHANCE = 1e-5
#: Gauss-Newton steps at most, and the step (m, rad) below which it has converged.
STEPS, CONVERGED = 30, 1e-10
#: Poses that the sigmas are estimated from at most, spread evenly.
MOST = 200
#: The sigmas are looked for between these, m and rad: beyond, they are zero, or no arm.
LEAST_SIGMA, MOST_SIGMA = 1e-7, 0.1


Sigmas = tuple[float, float, float, float]
Share = Literal["flange", "seen", "places"]
#: Who has the share of the error that nobody gave: the flange (its joints), what is seen, or what is seen with its turns
#: hardly believed: an arm's turns and its places may contradict each other by more than either scatters.
SHARES: tuple[Share, ...] = ("flange", "seen", "places")
#: Sigma of turns that are hardly believed, rad: enough to determine what places leave open.
HARDLY = 0.005


def adjoint(T: Array) -> Array:
    """Return the adjoints (..., 6, 6) of transforms (..., 4, 4): T exp(xi) T^-1 = exp(Ad xi)."""
    R = T[..., :3, :3]
    out = np.zeros((*T.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = R
    out[..., :3, 3:] = skew(T[..., :3, 3]) @ R
    return out


@dataclass(frozen=True, eq=False)
class Poses(Record):
    """What a hand-eye calibration is made from.

    Attributes:
        A: (N, 4, 4) T_base_flange, m.
        B: (N, 4, 4) T_rig_body, m.
        cov: (N, 6, 6) covariance of B, right tangent, zero where unknown.
        in_hand: whether the rig is on the flange and the body stands still; else the body is on the flange.
        centre: (3,) the middle of what is seen of the body, body frame, m.
    """

    A: Array
    B: Array
    cov: Array
    in_hand: bool
    centre: Array

    def rows(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> Poses:
        """Return a part of the poses."""
        return Poses(self.A[rows], self.B[rows], self.cov[rows], self.in_hand, self.centre)

    @property
    def turned(self) -> Array:
        """(N, 4, 4) the poses that stand for B in A_i X = Z B_i."""
        return inverse(self.B) if self.in_hand else self.B


@dataclass(frozen=True, eq=False)
class Fit(Record):
    """The unknown transforms of A_i X = Z B_i.

    Attributes:
        Z: (4, 4) what stands still, in the base.
        X: (4, 4) what the flange carries, in the flange.
        cov: (12, 12) covariance of the right tangents of Z and X, in this order.
        sigma: sigmas along or about one axis: the flange's place, m, and turn, rad; the body's middle's, and turn, beyond
            the covariance given.
        used: (N,) whether a pose was used.
    """

    Z: Array
    X: Array
    cov: Array
    sigma: Sigmas
    used: NDArray[np.bool_]


def residuals(poses: Poses, Z: Array, X: Array) -> tuple[Array, Array, Array]:
    """Return what is left over, its derivative, and the adjoints that carry an error of the flange over to it.

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
    # A change of Z comes in from the left of what follows it.
    by_z = -adjoint(inverse(E) if poses.in_hand else inverse(poses.A @ M) @ Z)
    e = log_se3(E)
    bend = np.eye(6) + 0.5 * _small_adjoint(e)  # the right Jacobian's inverse, to first order
    return e, np.concatenate([bend @ by_z, bend @ by_x], axis=2), adjoint(inverse(M))


def _small_adjoint(xi: Array) -> Array:
    """Return ad(xi) (..., 6, 6) of tangents (..., 6)."""
    out = np.zeros((*xi.shape[:-1], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = skew(xi[..., 3:])
    out[..., :3, 3:] = skew(xi[..., :3])
    return out


def covariances(poses: Poses, carry: Array, sigma: Sigmas) -> Array:
    """Return the covariance (N, 6, 6) of residuals: what is given, the flange's carried over, and the body's."""
    flange, body = np.repeat(np.square(sigma[:2]), 3), np.repeat(np.square(sigma[2:]), 3)
    about = np.eye(6)
    about[:3, 3:] = skew(poses.centre)  # the adjoint of the shift from the body's origin to its middle
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


def _shared(place: float, turn: float, share: Share) -> Sigmas:
    """Return the four sigmas of a share."""
    if share == "flange":
        return place, turn, 0.0, 0.0
    return 0.0, 0.0, place, turn if share == "seen" else HARDLY


def _robust_sigma(poses: Poses, Z: Array, X: Array, share: Share) -> Sigmas:
    """Return sigmas along one axis from the median residual, which mistakes do not reach."""
    e, _, _ = residuals(poses, Z, X)
    middle = np.sqrt(chdtri(3, 0.5))
    place, turn = (float(np.median(np.linalg.norm(part, axis=1))) / middle for part in (e[:, :3], e[:, 3:]))
    return _shared(max(place, LEAST_SIGMA), max(turn, LEAST_SIGMA), share)


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
    if len(poses.A) > MOST:
        poses = poses.rows(np.linspace(0, len(poses.A) - 1, MOST).astype(np.int64))
    e, _, carry = residuals(poses, Z, X)
    freedom = max(1 - 12 / e.size, 1 / e.size)  # what the fit has left of the residuals'
    low, high = np.log(LEAST_SIGMA), np.log(MOST_SIGMA)

    def shared(logs: Array) -> Sigmas:
        place, turn = np.exp(np.clip(logs, low, high))
        return _shared(float(place), float(turn), share)

    def cost(logs: Array) -> float:
        C = covariances(poses, carry, shared(logs))
        return float(freedom * np.linalg.slogdet(C)[1].sum() + _squares(e, C).sum())

    start = np.log(np.maximum(sigma[:2] if share == "flange" else sigma[2:], LEAST_SIGMA))
    best = minimize(cost, start, method="Nelder-Mead", options={"xatol": 1e-2, "fatol": 1e-3})
    return shared(best.x)
