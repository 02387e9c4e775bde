"""Joint bundle adjustment of two cameras, their relative pose, the body's shape and its pose in every shot.

Observations and a start go in, a maximum-likelihood state with the full covariance of the shared parameters comes out.
Levenberg-Marquardt; each shot's own parameters are eliminated from the arrow-shaped normal equations (Schur complement;
Triggs et al., "Bundle adjustment: a modern synthesis", 2000), so the cost grows linearly with the shots. Robust by
iteratively reweighted least squares with the Cauchy loss on each detection's whitened distance. Where the cameras are not
synchronised, the body may move between the two exposures of a shot: six more parameters of that shot, held by a prior.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Ids, Record
from armsight.errors import CalibrationError
from armsight.kernels import kernel
from armsight.vision.pose.projection import BundleModel, BundleState, Observations, derivatives, moved, predict


@kernel(nogil=True)
def _add(a: float, u: Array, b: float, v: Array, out: Array) -> None:
    """Add a u + b v to out, as far as it goes."""
    for j in range(out.size):
        out[j] += a * u[j] + b * v[j]


@kernel(nogil=True)
def _weights(w: Array, white: Array, c2: float, bends: bool, out: Array) -> float:
    """Write a detection's weights with the loss's into out (2, 2); return by what its whitened residual is multiplied."""
    square = white[0] ** 2 + white[1] ** 2
    root, bent = 1.0 / np.sqrt(1.0 + square / c2), 1.0
    if bends:
        bent = np.sqrt(max((c2 - square) / (c2 + square), _LEAST_BENT))
    less = (1.0 - bent) / max(square, 1e-300)
    for c in range(2):
        along = less * (white[0] * w[0, c] + white[1] * w[1, c])
        out[0, c], out[1, c] = root * (w[0, c] - along * white[0]), root * (w[1, c] - along * white[1])
    return float(root / bent)


@kernel(
    "const f8[:, :, ::1], const f8[:, :, ::1], const f8[:, ::1], (f8, b1), "
    "(const i8[::1], const i8[::1], const i8[::1]), (f8[:, :, :, ::1], f8[:, :, :, ::1], f8[:, :, :, ::1])",
    nogil=True,
)
def _accumulate(
    J: Array,
    W: Array,
    white: Array,
    loss: tuple[float, bool],
    rows: tuple[Ids, Ids, Ids],
    sums: tuple[Array, Array, Array],
) -> None:
    """Add the products of every detection's weighted derivatives, the residual being one more column.

    With the loss's own curvature along each residual (Triggs et al., 2000, section 4.3), which is smaller than the
    weight and below zero beyond the loss's scale, where it is held positive.
    J (N, 2, m), those by the point last; W (N, 2, 2) whiteners; white (N, 2) whitened residuals; ``loss``: square of
    the Cauchy loss's scale, and whether its curvature is taken; ``rows``: camera, point and shot of each, (N,). Sums:
    of each shot and camera (S, 2, m - 3, m - 2) without the point, upper triangles; of each point and camera, its three
    derivatives by all (M, 2, 3, m + 1), residual before point; of each shot its own k by each point (S, M, k, 3).
    """
    shots, points, cross = sums
    m, k = J.shape[2] - 3, cross.shape[2]
    u, v, weights = np.empty(m + 4), np.empty(m + 4), np.empty((2, 2))
    for row in range(J.shape[0]):
        side, p, s = rows[0][row], rows[1][row], rows[2][row]
        factor = _weights(W[row], white[row], loss[0], loss[1], weights)
        for c in range(m + 3):
            at = c if c < m else c + 1
            u[at] = weights[0, 0] * J[row, 0, c] + weights[0, 1] * J[row, 1, c]
            v[at] = weights[1, 0] * J[row, 0, c] + weights[1, 1] * J[row, 1, c]
        u[m], v[m] = factor * white[row, 0], factor * white[row, 1]
        for i in range(m):
            _add(u[i], u[i:], v[i], v[i:], shots[s, side, i, i:])
        for i in range(m + 1, m + 4):
            _add(u[i], u, v[i], v, points[p, side, i - m - 1])
        for i in range(k):
            _add(u[m - k + i], u[m + 1 :], v[m - k + i], v[m + 1 :], cross[s, p, i])


def _whole(upper: Array) -> Array:
    """Return symmetric matrices (..., K, K) of their upper triangles."""
    return np.asarray(np.triu(upper) + np.triu(upper, 1).swapaxes(-1, -2))


def _flat(blocks: Array) -> Array:
    """Return blocks (S, K, Q) one below the other, (S K, Q)."""
    return blocks.reshape(blocks.shape[0] * blocks.shape[1], blocks.shape[2])


#: Least diagonal element of the Cholesky factor of a scaled system that is solved by LU; half: systems of which rounding
#: leaves no digit are, double: more least-norm solutions, which take ten times as long.
_SOUND = 1e-6


@dataclass(frozen=True, eq=False)
class Arrow(Record):
    """Normal equations of Q shared parameters and K own ones of each of S shots."""

    H_shared: Array  #: (Q, Q) information of the shared parameters
    H_cross: Array  #: (S, K, Q) what couples them with every shot's own
    H_shots: Array  #: (S, K, K) information of every shot's own parameters
    g_shared: Array  #: (Q,) downhill gradient
    g_shots: Array  #: (S, K) downhill gradient
    cost: float  #: what is minimised

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

    def promises(self, shared: Array, shots: Array) -> float:
        """Return by how much a step lowers the cost if the equations hold that far and nothing damps it."""
        return float(self.g_shared @ shared + (self.g_shots * shots).sum())

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
    unit = d[:, None] * H * d
    try:
        sound = np.diag(np.linalg.cholesky(unit)).min() > _SOUND
    except np.linalg.LinAlgError:
        sound = False
    return np.asarray(d * (np.linalg.solve(unit, d * g) if sound else np.linalg.lstsq(unit, d * g, rcond=1e-14)[0]))


#: Together with the solver stands what it is about.
__all__ = [
    "CAUCHY_SCALE",
    "DAMPING",
    "NEAR",
    "BundleModel",
    "BundleSolution",
    "BundleState",
    "Observations",
    "free_parameters",
    "minimise",
    "moved",
    "predict",
    "promised",
    "whiteners",
]

#: Whitened distance at which the Cauchy loss begins to discount a detection (2.385 is 95% efficient for one residual;
#: a two-dimensional detection needs a little more).
CAUCHY_SCALE = 3.0
#: Rational distortion makes long curved valleys: from a rough start a hundred steps are needed now and then.
_MAX_STEPS = 200
_RELATIVE_DECREASE = 1e-7
#: Marquardt's damping to begin with, as a share of each parameter's own information, and near a minimum; half and double
#: change nothing, a hundred times as much costs two steps each, a hundredth makes far starts fail at first.
DAMPING, NEAR = 1e-4, 1e-9
#: Damping up to which a step is the Newton step: what it promises is what is left. Half and double change nothing.
_UNDAMPED = 1e-6
#: Square of the loss's scale without a loss: larger than that of any residual; half and double change nothing.
_NO_LOSS = 1e300
#: Least curvature of the loss along an outlier's residual, as a share of its weight; half and double: a step more or less.
_LEAST_BENT = 1e-2


@functools.cache
def _robust_excess() -> float:
    """Return how many times the inverse of the reweighted information exceeds a robust fit's covariance, without outliers.

    For an M-estimator with weight w(d^2) the covariance is E[psi^2] / E[psi']^2 times that of unit information (Huber,
    "Robust statistics", 1981, section 6.3); for the Cauchy loss in two dimensions psi' averages to w^2. The inverse of
    the reweighted information is 1 / E[w]. Half of d^2 is exponentially distributed: Gauss-Laguerre quadrature.
    """
    half_d2, density = np.polynomial.laguerre.laggauss(40)
    w = 1.0 / (1.0 + 2 * half_d2 / CAUCHY_SCALE**2)
    return float((density @ w**2) ** 2 / ((density @ (half_d2 * w**2)) * (density @ w)))


@dataclass(frozen=True, eq=False)
class BundleSolution(Record):
    """A minimum of bundle adjustment."""

    state: BundleState  #: the estimate
    residuals_px: Array  #: (N, 2) detection minus projection
    sigma_px: float  #: standard deviation of a detection beyond its image covariance, px
    cov_shared: Array  #: (Q, Q) covariance of all shared parameters, zero rows for what was held fixed, or (0, 0)
    cost: float  #: robust cost
    steps: int  #: iterations used
    converged: bool  #: whether it is a minimum; False where the last step that was allowed still lowered the cost
    cov_motions: Array  #: (S, 6, 6) covariance of the motions, or (0, 6, 6)


def whiteners(observations: Observations, sigma_px: float) -> Array:
    """(N, 2, 2) matrices W with W^T W the inverse of the detections' covariance, sigma_px included."""
    cov = observations.cov_uv
    a, b, c = cov[:, 0, 0] + sigma_px**2, cov[:, 0, 1], cov[:, 1, 1] + sigma_px**2
    W, last = np.zeros_like(cov), 1.0 / np.sqrt(c - b**2 / a)
    W[:, 0, 0], W[:, 1, 0], W[:, 1, 1] = 1.0 / np.sqrt(a), -last * b / a, last
    return W


@dataclass(frozen=True, eq=False)
class _Near(Record):
    """The problem near a state: derivatives, whitened residuals, cost; infinite where a detection is impossible."""

    state: BundleState
    residuals_px: Array
    J: Array
    white: Array
    squares: Array
    cost: float


_Loss = tuple[float, bool]  # square of the Cauchy loss's scale; whether its curvature is taken


def _near(model: BundleModel, state: BundleState, observations: Observations, W: Array, robust: bool) -> _Near:
    uv, J = derivatives(model, state, observations)
    residuals = observations.uv - uv
    white = (W @ residuals[..., None])[..., 0]
    squares = np.einsum("ni,ni->n", white, white)
    cost = np.inf
    if np.isfinite(squares).all():
        cost = float((CAUCHY_SCALE**2 * np.log1p(squares / CAUCHY_SCALE**2)).sum() if robust else squares.sum())
        cost += float((state.shape**2).sum()) / model.shape_sigma_m**2
        cost += float((model.motion_sigmas**-2.0 * state.motions**2).sum())
    return _Near(state, residuals, J, white, squares, cost)


def _normal(
    model: BundleModel, near: _Near, observations: Observations, W: Array, free: NDArray[np.bool_], loss: _Loss
) -> Arrow:
    """Assemble the normal equations with the priors of shape and motion; the shape's modes come last, once a point."""
    state, modes, J = near.state, model.modes, near.J
    sizes = [camera.parameters.size for camera in state.cameras]
    count, M, n, m = observations.shot_count, modes.shape[1], sum(sizes), J.shape[2] - 3
    own = max(sizes) + 6  # first column of the shot's own
    shots, points = np.zeros((count, 2, m, m + 1)), np.zeros((M, 2, 3, m + 4))
    by_point = np.zeros((count, M, m - own, 3))
    rows = observations.camera, observations.point, observations.shot
    _accumulate(J, W, near.white, loss, rows, (shots, points, by_point))
    H, g, H_points = np.zeros((n + 6, n + 6)), np.zeros(n + 6), np.zeros((3 * M, n + 6))
    cross = np.zeros((count, m - own, n + 6))
    for side, start in enumerate((0, sizes[0])):
        ours = np.concatenate([np.arange(sizes[side]), np.arange(own - 6, own)])
        there = np.concatenate([np.arange(start, start + sizes[side]), np.arange(n, n + 6)])
        G = shots[:, side].sum(axis=0)
        H[np.ix_(there, there)] += G[np.ix_(ours, ours)]
        g[there] += G[ours, m]
        cross[:, :, there] += shots[:, side, ours, own:m].transpose(0, 2, 1)
        H_points[:, there] += points[:, side].reshape(3 * M, -1)[:, ours]
    flat, each = modes.reshape(len(modes), 3 * M).T, points.sum(axis=1)
    by_shape = H_points.T @ flat
    H_shape = flat.T @ (each[:, :, m + 1 :] @ flat.reshape(M, 3, -1)).reshape(3 * M, -1)
    cross_shape = by_point.transpose(0, 2, 1, 3).reshape(count, m - own, 3 * M) @ flat
    H_shots, g_shots = _whole(shots[:, :, own:, own:m].sum(axis=1)), shots[:, :, own:, m].sum(axis=1)
    if len(state.motions):
        still = model.motion_sigmas**-2.0
        H_shots[:, 6:, 6:] += still[:, :, None] * np.eye(6)
        g_shots[:, 6:] -= still * state.motions
    H_shared = np.block([[_whole(H), by_shape], [by_shape.T, H_shape]]) + np.diag(_prior(model, len(free)))
    g_shared = np.concatenate([g, each[:, :, m].ravel() @ flat - state.shape / model.shape_sigma_m**2])
    H_cross = np.concatenate([cross, cross_shape], axis=2)
    if not free.all():
        H_shared, H_cross, g_shared = H_shared[np.ix_(free, free)], H_cross[:, :, free], g_shared[free]
    return Arrow(H_shared, H_cross, H_shots, g_shared, g_shots, near.cost)


def _prior(model: BundleModel, count: int) -> Array:
    """(Q,) information about each of ``count`` shared parameters before any image: the shape's."""
    return np.concatenate([np.zeros(count - len(model.modes)), np.full(len(model.modes), 1.0 / model.shape_sigma_m**2)])


def _covariance(normal: Arrow, prior: Array, robust: bool) -> Array:
    """(q, q) covariance of the free shared parameters, given their prior information (q,)."""
    S = normal.schur()
    if robust:
        S = _robust_excess() * (S - np.diag(prior)) + np.diag(prior)
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
    damping: float = DAMPING,
    covariance: bool = True,
) -> BundleSolution:
    """Find the minimum next to ``start``, where every observation lies in front of its camera, and its covariance.

    Args:
        model: the body and what is held fixed.
        start: where to begin.
        observations: N detections.
        sigma_px: standard deviation of a detection beyond its image covariance, px.
        robust: Cauchy loss, else plain least squares.
        free: (Q,) which shared parameters move, all that the model frees by default.
        max_steps: iterations at the most.
        least_decrease: a step that lowers the cost by less than this share of it is the last.
        damping: Marquardt's damping to begin with, NEAR where the start is a neighbouring problem's minimum.
        covariance: whether it is needed; without, ``cov_shared`` and ``cov_motions`` are empty.

    Raises:
        CalibrationError: the start puts a detection behind its camera, or a shot has no detections.
    """
    empty = np.flatnonzero(np.bincount(observations.shot, minlength=observations.shot_count) == 0)
    if len(empty):
        raise CalibrationError(f"shot {empty[0]} of {observations.shot_count} in the adjustment has no detections")
    W, c2 = whiteners(observations, sigma_px), CAUCHY_SCALE**2 if robust else _NO_LOSS
    free = free_parameters(model, start) if free is None else free
    now, steps, converged = _near(model, _with_motions(model, start), observations, W, robust), 0, False
    if not np.isfinite(now.cost):
        raise CalibrationError("the start of the adjustment puts a detected point behind its camera")
    normal = _normal(model, now, observations, W, free, (c2, damping <= _UNDAMPED))
    while steps < max_steps and not converged:
        steps += 1
        step, shots = normal.step(damping)
        if damping <= _UNDAMPED and normal.promises(step, shots) <= 0.5 * least_decrease * now.cost:
            converged = True
            break
        shared = np.zeros(len(free))
        shared[free] = step
        trial = _trial(now.state, shared, shots)
        there = None if trial is None else _near(model, trial, observations, W, robust)
        if there is not None and there.cost <= now.cost:
            converged = now.cost - there.cost <= least_decrease * there.cost
            now, damping = there, max(damping / 10, 1e-12)
            if not converged:
                normal = _normal(model, now, observations, W, free, (c2, damping <= _UNDAMPED))
        else:
            damping *= 10
            converged = damping >= 1e12  # not even the smallest step lowers the cost
    cov, cov_motions = np.zeros((0, 0)), np.zeros((0, 6, 6))
    if not covariance:
        return BundleSolution(now.state, now.residuals_px, sigma_px, cov, now.cost, steps, converged, cov_motions)
    normal = _normal(model, now, observations, W, free, (c2, False))
    cov = np.zeros((len(free), len(free)))
    if free.any():
        cov[np.ix_(free, free)] = _covariance(normal, _prior(model, len(free))[free], robust)
    if len(now.state.motions):
        cov_motions = normal.cov_shots(cov[np.ix_(free, free)])[:, 6:, 6:]
    return BundleSolution(now.state, now.residuals_px, sigma_px, cov, now.cost, steps, converged, cov_motions)


def promised(model: BundleModel, state: BundleState, observations: Observations, sigma_px: float) -> float:
    """Return the share of the robust cost that a Newton step from a state would remove, a score test (Rao, 1948).

    At the minimum of a smaller model this is about what a larger one with the same start can gain, without adjusting it.
    """
    W = whiteners(observations, sigma_px)
    near, free = _near(model, state, observations, W, robust=True), free_parameters(model, state)
    normal = _normal(model, near, observations, W, free, (CAUCHY_SCALE**2, True))
    return normal.promises(*normal.step(NEAR)) / near.cost


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
