"""Joint bundle adjustment of two cameras, their relative pose, the body's shape and its pose in every shot.

Observations and a start go in, a maximum-likelihood state with the full covariance of the shared parameters comes out.
Levenberg-Marquardt on the arrow-shaped normal equations (:mod:`~armsight.vision.pose.bundle`). Robust by iteratively
reweighted least squares with the Cauchy loss on each detection's whitened distance. Where the cameras are not
synchronised, the body may move between the two exposures of a shot: six more parameters of that shot, held by a prior.

Arrow-shaped normal equations: parameters that all shots share, and a few of every shot's own.

Every shot's own parameters are eliminated (Schur complement; Triggs et al., "Bundle adjustment: a modern synthesis",
2000), so the cost grows linearly with the shots.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Ids, Record
from armsight.errors import CalibrationError
from armsight.kernels import kernel
from armsight.vision.pose.projection import BundleModel, BundleState, Observations, moved, predict


def _flat(blocks: Array) -> Array:
    """Return blocks (S, K, Q) one below the other, (S K, Q)."""
    return blocks.reshape(blocks.shape[0] * blocks.shape[1], blocks.shape[2])


@dataclass(frozen=True, eq=False)
class Arrow(Record):
    """Normal equations of Q shared parameters and K own ones of each of S shots.

    Attributes:
        H_shared: (Q, Q) information of the shared parameters.
        H_cross: (S, K, Q) what couples them with every shot's own.
        H_shots: (S, K, K) information of every shot's own parameters.
        g_shared: (Q,) downhill gradient.
        g_shots: (S, K) downhill gradient.
        cost: what is minimised.
    """

    H_shared: Array
    H_cross: Array
    H_shots: Array
    g_shared: Array
    g_shots: Array
    cost: float

    @staticmethod
    def impossible() -> Arrow:
        """Return equations of infinite cost: a state that no detection allows."""
        nothing = np.zeros(0)
        return Arrow(nothing, nothing, nothing, nothing, nothing, np.inf)

    @staticmethod
    def of(A: Array, B: Array, r: Array, shot: Ids, shot_count: int, cost: float) -> Arrow:
        """Assemble from whitened residuals r (N, 2), their derivatives A (N, 2, Q), B (N, 2, K) and shots (N,), sorted."""
        q, k = A.shape[2], B.shape[2]
        counts = np.bincount(shot, minlength=shot_count)
        most = int(counts.max(initial=0))
        if most * shot_count > len(shot):  # shots of unequal size are filled up with zeros: their products come at once
            rows = np.arange(len(shot)) + np.repeat(np.arange(shot_count) * most - np.cumsum(counts) + counts, counts)
            full = [np.zeros((shot_count * most, *each.shape[1:])) for each in (A, B, r)]
            for each, given in zip(full, (A, B, r), strict=True):
                each[rows] = given
            A, B, r = full
        a, b = A.reshape(shot_count, 2 * most, q), B.reshape(shot_count, 2 * most, k).transpose(0, 2, 1)
        flat, e = A.reshape(2 * len(A), q), r.reshape(-1)
        g_shots = (b @ e.reshape(shot_count, 2 * most, 1))[..., 0]
        return Arrow(flat.T @ flat, b @ a, b @ b.transpose(0, 2, 1), flat.T @ e, g_shots, cost)

    def step(self, damping: float) -> tuple[Array, Array]:
        """Solve for the shared step (Q,) and the shots' steps (S, K) with Marquardt's damping."""
        H = self.H_shared + np.diag(damping * np.diag(self.H_shared))
        Hs = self.H_shots + damping * self.H_shots * np.eye(self.H_shots.shape[1])
        gain: Array = np.linalg.solve(Hs, self.H_cross).astype(np.float64)
        flat = _flat(gain)
        S = H - _flat(self.H_cross).T @ flat
        g = self.g_shared - self.g_shots.reshape(-1) @ flat
        shared = solve_scaled(S, g)
        shots = np.linalg.solve(Hs, (self.g_shots - self.H_cross @ shared)[..., None])[..., 0]
        return shared, np.asarray(shots, np.float64)

    def schur(self) -> Array:
        """(Q, Q) information of the shared parameters with the shots' own marginalised."""
        gain: Array = np.linalg.solve(self.H_shots, self.H_cross).astype(np.float64)
        return np.asarray(self.H_shared - _flat(self.H_cross).T @ _flat(gain))

    def cov_shots(self, cov_shared: Array) -> Array:
        """(S, K, K) covariance of the shots' own parameters, given that of the shared ones (Q, Q)."""
        gain: Array = np.linalg.solve(self.H_shots, self.H_cross).astype(np.float64)
        return np.asarray(np.linalg.inv(self.H_shots) + gain @ cov_shared @ gain.transpose(0, 2, 1))


def solve_scaled(H: Array, g: Array) -> Array:
    """Solve a positive semi-definite system after scaling it to a unit diagonal; least norm where it is singular."""
    if not len(g):
        return g
    d = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300))
    return np.asarray(d * np.linalg.lstsq(d[:, None] * H * d, d * g, rcond=1e-14)[0])


#: Together with the solver stands what it is about.
__all__ = [
    "CAUCHY_SCALE",
    "BundleModel",
    "BundleSolution",
    "BundleState",
    "Observations",
    "free_parameters",
    "minimise",
    "moved",
    "predict",
    "whiteners",
]

#: Whitened distance at which the Cauchy loss begins to discount a detection (2.385 is 95% efficient for one residual;
#: a two-dimensional detection needs a little more).
CAUCHY_SCALE = 3.0
#: Rational distortion makes long curved valleys: from a rough start a hundred steps are needed now and then.
_MAX_STEPS = 200
_RELATIVE_DECREASE = 1e-7


def _robust_excess() -> float:
    """Return how many times the inverse of the reweighted information exceeds a robust fit's covariance, without outliers.

    For an M-estimator with weight w(d^2) the covariance is E[psi^2] / E[psi']^2 times that of unit information (Huber,
    "Robust statistics", 1981, section 6.3); for the Cauchy loss in two dimensions psi' averages to w^2. The inverse of
    the reweighted information is 1 / E[w]. Half of d^2 is exponentially distributed: Gauss-Laguerre quadrature.
    """
    half_d2, density = np.polynomial.laguerre.laggauss(40)
    w = 1.0 / (1.0 + 2 * half_d2 / CAUCHY_SCALE**2)
    return float((density @ w**2) ** 2 / ((density @ (half_d2 * w**2)) * (density @ w)))


_ROBUST_EXCESS = _robust_excess()


@dataclass(frozen=True, eq=False)
class BundleSolution(Record):
    """A minimum of bundle adjustment.

    Attributes:
        state: the estimate.
        residuals_px: (N, 2) detection minus projection.
        sigma_px: standard deviation of a detection beyond its image covariance, px.
        cov_shared: (Q, Q) covariance of all shared parameters; zero rows for what was held fixed.
        cost: robust cost.
        steps: iterations used.
        converged: whether it is a minimum; False where the last step that was allowed still lowered the cost.
        cov_motions: (S, 6, 6) covariance of the motions, or (0, 6, 6).
    """

    state: BundleState
    residuals_px: Array
    sigma_px: float
    cov_shared: Array
    cost: float
    steps: int
    converged: bool
    cov_motions: Array


def whiteners(observations: Observations, sigma_px: float) -> Array:
    """(N, 2, 2) matrices W with W^T W the inverse of the detections' covariance, sigma_px included."""
    cov = observations.cov_uv + sigma_px**2 * np.eye(2)
    return np.linalg.inv(np.linalg.cholesky(cov))


def _normal(
    model: BundleModel, state: BundleState, observations: Observations, W: Array, free: NDArray[np.bool_], robust: bool
) -> tuple[Arrow, Array]:
    """Assemble the normal equations at a state; also return the raw residuals (N, 2), px."""
    uv, J_shared, J_shot = predict(model, state, observations)
    residuals = observations.uv - uv
    r = (W @ residuals[..., None])[..., 0]
    d2 = np.einsum("ni,ni->n", r, r)
    if not np.isfinite(d2).all():
        return Arrow.impossible(), residuals
    c2 = CAUCHY_SCALE**2
    weight = 1.0 / (1.0 + d2 / c2) if robust else np.ones(len(d2))
    prior = _prior(model, J_shared.shape[2])
    shape = np.concatenate([np.zeros(J_shared.shape[2] - len(state.shape)), state.shape])
    still = model.motion_sigmas**-2.0
    cost = float((c2 * np.log1p(d2 / c2)).sum() if robust else d2.sum())
    cost += float(prior @ shape**2) + float((still * state.motions**2).sum())
    root = np.sqrt(weight)[:, None]
    A, B = J_shared if free.all() else J_shared[:, :, free], J_shot
    for J in (A, B):
        _weigh(root[..., None] * W, J)
    arrow = Arrow.of(A, B, r * root, observations.shot, observations.shot_count, cost)
    H_shots, g_shots = np.array(arrow.H_shots), np.array(arrow.g_shots)
    if len(still):
        H_shots[:, 6:, 6:] += still[:, :, None] * np.eye(6)
        g_shots[:, 6:] -= still * state.motions
    H_shared, g_shared = arrow.H_shared + np.diag(prior[free]), arrow.g_shared - (prior * shape)[free]
    return replace(arrow, H_shared=H_shared, g_shared=g_shared, H_shots=H_shots, g_shots=g_shots), residuals


@kernel("f8[:, :, ::1], f8[:, :, ::1]", "f8[:, :, ::1], f8[:, :, :]")
def _weigh(W: Array, J: Array) -> None:
    """Replace matrices J (N, 2, K) by W @ J for W (N, 2, 2), where they stand."""
    for n in range(J.shape[0]):
        for k in range(J.shape[2]):
            u, v = J[n, 0, k], J[n, 1, k]
            J[n, 0, k] = W[n, 0, 0] * u + W[n, 0, 1] * v
            J[n, 1, k] = W[n, 1, 0] * u + W[n, 1, 1] * v


def _prior(model: BundleModel, count: int) -> Array:
    """(Q,) information about each of ``count`` shared parameters before any image: the shape's."""
    return np.concatenate([np.zeros(count - len(model.modes)), np.full(len(model.modes), 1.0 / model.shape_sigma_m**2)])


def _covariance(normal: Arrow, prior: Array, robust: bool) -> Array:
    """(q, q) covariance of the free shared parameters, given their prior information (q,)."""
    S = normal.schur()
    if robust:
        S = _ROBUST_EXCESS * (S - np.diag(prior)) + np.diag(prior)
    d = 1.0 / np.sqrt(np.maximum(np.diag(S), 1e-300))
    return np.asarray(d[:, None] * np.linalg.pinv(d[:, None] * S * d, rcond=1e-14, hermitian=True) * d)


def free_parameters(model: BundleModel, state: BundleState) -> NDArray[np.bool_]:
    """(Q,) which shared parameters are estimated."""
    n_cameras = sum(camera.parameters.size for camera in state.cameras)
    return np.concatenate([np.full(n_cameras, model.free_cameras), np.ones(6 + len(model.modes), bool)])


def minimise(
    model: BundleModel,
    start: BundleState,
    observations: Observations,
    sigma_px: float,
    *,
    robust: bool = True,
    free: NDArray[np.bool_] | None = None,
    max_steps: int = _MAX_STEPS,
    least_decrease: float = _RELATIVE_DECREASE,
) -> BundleSolution:
    """Find the minimum next to ``start`` for a given noise.

    Args:
        model: the body and what is held fixed.
        start: where to begin; every observation must lie in front of its camera.
        observations: N detections.
        sigma_px: standard deviation of a detection beyond its image covariance, px.
        robust: Cauchy loss, else plain least squares.
        free: (Q,) which shared parameters move, all that the model frees by default.
        max_steps: iterations at the most.
        least_decrease: a step that lowers the cost by less than this share of it is the last.

    Returns:
        The minimum with its covariance.

    Raises:
        CalibrationError: the start puts a detection behind its camera, or a shot has no detections.
    """
    empty = np.flatnonzero(np.bincount(observations.shot, minlength=observations.shot_count) == 0)
    if len(empty):
        raise CalibrationError(f"shot {empty[0]} of {observations.shot_count} in the adjustment has no detections")
    W = whiteners(observations, sigma_px)
    free = free_parameters(model, start) if free is None else free
    state, damping, steps, converged = _with_motions(model, start), 1e-4, 0, False
    normal, residuals = _normal(model, state, observations, W, free, robust)
    if not np.isfinite(normal.cost):
        raise CalibrationError("the start of the adjustment puts a detected point behind its camera")
    while steps < max_steps and not converged:
        steps += 1
        step, shots = normal.step(damping)
        shared = np.zeros(len(free))
        shared[free] = step
        trial = _trial(state, shared, shots)
        if trial is not None:
            new, new_residuals = _normal(model, trial, observations, W, free, robust)
            if new.cost <= normal.cost:
                converged = normal.cost - new.cost <= least_decrease * new.cost
                state, normal, residuals, damping = trial, new, new_residuals, max(damping / 10, 1e-12)
                continue
        damping *= 10
        converged = damping >= 1e12  # not even the smallest step lowers the cost
    cov = np.zeros((len(free), len(free)))
    if free.any():
        cov[np.ix_(free, free)] = _covariance(normal, _prior(model, len(free))[free], robust)
    cov_motions = normal.cov_shots(cov[np.ix_(free, free)])[:, 6:, 6:] if len(state.motions) else np.zeros((0, 6, 6))
    return BundleSolution(state, residuals, sigma_px, cov, normal.cost, steps, converged, cov_motions)


def _with_motions(model: BundleModel, state: BundleState) -> BundleState:
    """Return the state with a motion for every shot where the model has them, and without where it has not."""
    if len(state.motions) == len(model.motion_sigmas):
        return state
    return replace(state, motions=np.zeros_like(model.motion_sigmas))


def _trial(state: BundleState, shared: Array, shots: Array) -> BundleState | None:
    """Return the moved state, or None where the step leaves the possible (a focal length below zero)."""
    fx_fy = [camera.intrinsics[:2] for camera in state.cameras]
    sizes = [camera.parameters.size for camera in state.cameras]
    moves = (shared[:2], shared[sizes[0] : sizes[0] + 2])
    if not np.isfinite(shared).all() or any((f + m <= 0).any() for f, m in zip(fx_fy, moves, strict=True)):
        return None
    return moved(state, shared, shots)
