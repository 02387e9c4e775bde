"""Joint bundle adjustment of two cameras, their relative pose, the body's shape and its pose in every shot.

Observations and a start go in, a maximum-likelihood state with the full covariance of the shared parameters comes out.
Levenberg-Marquardt on the arrow-shaped normal equations: every shot's six pose parameters are eliminated (Schur
complement; Triggs et al., "Bundle adjustment: a modern synthesis", 2000), so the cost grows linearly with the shots.
Robust by iteratively reweighted least squares with the Cauchy loss on each detection's whitened distance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Correspondences, Ids, Record
from armsight.errors import CalibrationError
from armsight.geometry.pose import exp_se3, inverse, transform
from armsight.geometry.rotation import skew
from armsight.vision.camera import Camera

#: Whitened distance at which the Cauchy loss begins to discount a detection (2.385 is 95% efficient for one residual;
#: a two-dimensional detection needs a little more).
CAUCHY_SCALE = 3.0
#: Rational distortion makes long curved valleys: from a rough start a hundred steps are needed now and then.
_MAX_STEPS = 200
_RELATIVE_DECREASE = 1e-7


def _robust_excess() -> float:
    """Tell how many times the inverse of the reweighted information exceeds a robust fit's covariance, noise being clean.

    For an M-estimator with weight w(d^2) the covariance is E[psi^2] / E[psi']^2 times that of unit information (Huber,
    "Robust statistics", 1981, section 6.3); for the Cauchy loss in two dimensions psi' averages to w^2. The inverse of
    the reweighted information is 1 / E[w]. Half of d^2 is exponentially distributed: Gauss-Laguerre quadrature.
    """
    half_d2, density = np.polynomial.laguerre.laggauss(40)
    w = 1.0 / (1.0 + 2 * half_d2 / CAUCHY_SCALE**2)
    return float((density @ w**2) ** 2 / ((density @ (half_d2 * w**2)) * (density @ w)))


_ROBUST_EXCESS = _robust_excess()


@dataclass(frozen=True, eq=False)
class Observations(Record):
    """Detections of one body over many shots, one row each, sorted by shot.

    Attributes:
        shot: (N,) row of the shot.
        camera: (N,) 0 left, 1 right.
        point: (N,) row of the body's points.
        uv: (N, 2) raw pixels.
        cov_uv: (N, 2, 2) covariance the image supports, px^2.
        shot_count: how many shots there are.
    """

    shot: Ids
    camera: Ids
    point: Ids
    uv: Array
    cov_uv: Array
    shot_count: int

    @staticmethod
    def from_shots(shots: list[Correspondences]) -> Observations:
        """Flatten one record of correspondences per shot."""
        rows = [np.argwhere(c.seen) for c in shots]
        return Observations(
            np.concatenate([np.full(len(r), j) for j, r in enumerate(rows)]),
            np.concatenate([r[:, 1] for r in rows]),
            np.concatenate([c.ids[r[:, 0]] for c, r in zip(shots, rows, strict=True)]),
            np.concatenate([c.uv[r[:, 0], r[:, 1]] for c, r in zip(shots, rows, strict=True)]),
            np.concatenate([c.cov_uv[r[:, 0], r[:, 1]] for c, r in zip(shots, rows, strict=True)]),
            len(shots),
        )

    def select(self, keep: NDArray[np.bool_]) -> Observations:
        """Return the rows where ``keep`` (N,) is true; shots keep their numbers."""
        shot, camera, point = self.shot[keep], self.camera[keep], self.point[keep]
        return Observations(shot, camera, point, self.uv[keep], self.cov_uv[keep], self.shot_count)

    def shots(self, rows: NDArray[np.intp] | list[int]) -> Observations:
        """Return only the shots in ``rows``, renumbered in ascending order."""
        order = np.unique(rows)
        keep = np.isin(self.shot, order)
        chosen = self.select(keep)
        return replace(chosen, shot=np.searchsorted(order, chosen.shot), shot_count=len(order))


@dataclass(frozen=True, eq=False)
class State(Record):
    """What bundle adjustment estimates.

    Attributes:
        cameras: left and right.
        T_left_right: (4, 4) pose of the right camera in the left one's frame.
        Ts_left_body: (S, 4, 4) pose of the body in every shot.
        shape: (K,) coordinates of the body's shape along its modes, m.
    """

    cameras: tuple[Camera, Camera]
    T_left_right: Array
    Ts_left_body: Array
    shape: Array


@dataclass(frozen=True, eq=False)
class Model(Record):
    """What bundle adjustment holds fixed, and what it believes beforehand.

    The shared parameters are: left intrinsics and distortion, right intrinsics and distortion, the tangent of
    T_left_right, and the shape.

    Attributes:
        points: (M, 3) nominal points of the body, m.
        modes: (K, M, 3) shape modes: the body is ``points + shape @ modes``.
        shape_sigma_m: standard deviation of every shape coordinate before any image, m.
        free_cameras: whether intrinsics and distortion are estimated.
    """

    points: Array
    modes: Array
    shape_sigma_m: float
    free_cameras: bool

    def body(self, shape: Array) -> Array:
        """(M, 3) points of the body of a given shape, m."""
        return np.asarray(self.points + np.tensordot(shape, self.modes, axes=1))


@dataclass(frozen=True, eq=False)
class Solution(Record):
    """A minimum of bundle adjustment.

    Attributes:
        state: the estimate.
        residuals_px: (N, 2) detection minus projection.
        sigma_px: standard deviation of a detection beyond its image covariance, px.
        cov_shared: (Q, Q) covariance of all shared parameters; zero rows for what was held fixed.
        cost: robust cost.
        steps: iterations used.
    """

    state: State
    residuals_px: Array
    sigma_px: float
    cov_shared: Array
    cost: float
    steps: int


def predict(model: Model, state: State, observations: Observations) -> tuple[Array, Array, Array]:
    """Project every observation and differentiate.

    Args:
        model: the body and its modes.
        state: where everything is.
        observations: N rows.

    Returns:
        (N, 2) pixels; (N, 2, Q) derivative by the shared parameters; (N, 2, 6) derivative by the tangent of the shot's
        pose (perturbation on the right).
    """
    sizes = [camera.parameters.size for camera in state.cameras]
    n_cameras = sum(sizes)
    count = n_cameras + 6 + len(model.modes)
    uv = np.empty((len(observations.shot), 2))
    J_shared, J_pose = np.zeros((len(uv), 2, count)), np.empty((len(uv), 2, 6))
    body = model.body(state.shape)
    T_right_left = inverse(state.T_left_right)
    for side, camera in enumerate(state.cameras):
        rows = observations.camera == side
        points = observations.point[rows]
        T = state.Ts_left_body[observations.shot[rows]]
        T = T if side == 0 else T_right_left @ T
        p = transform(T, body[points])
        uv[rows], J_p, J_k = camera.project_jacobians(p)
        by_body = J_p @ T[:, :3, :3]
        J_pose[rows] = np.concatenate([by_body, -by_body @ skew(body[points])], axis=2)
        start = 0 if side == 0 else sizes[0]
        block = np.zeros((len(points), 2, count))
        block[:, :, start : start + sizes[side]] = J_k
        if side == 1:
            block[:, :, n_cameras : n_cameras + 6] = np.concatenate([-J_p, J_p @ skew(p)], axis=2)
        if len(model.modes):
            block[:, :, n_cameras + 6 :] = by_body @ model.modes[:, points].transpose(1, 2, 0)
        J_shared[rows] = block
    return uv, J_shared, J_pose


def moved(state: State, shared: Array, poses: Array) -> State:
    """Return the state moved by ``shared`` (Q,) and by one tangent a shot ``poses`` (S, 6)."""
    left, right = state.cameras
    n_left, n = left.parameters.size, left.parameters.size + right.parameters.size
    return State(
        (
            left.with_parameters(left.parameters + shared[:n_left]),
            right.with_parameters(right.parameters + shared[n_left:n]),
        ),
        state.T_left_right @ exp_se3(shared[n : n + 6]),
        state.Ts_left_body @ exp_se3(poses),
        state.shape + shared[n + 6 :],
    )


def whiteners(observations: Observations, sigma_px: float) -> Array:
    """(N, 2, 2) matrices W with W^T W the inverse of the detections' covariance, sigma_px included."""
    cov = observations.cov_uv + sigma_px**2 * np.eye(2)
    return np.linalg.inv(np.linalg.cholesky(cov))


@dataclass(frozen=True, eq=False)
class _Normal(Record):
    """Arrow-shaped normal equations: shared block, one block a shot, and what couples them."""

    H_shared: Array
    H_cross: Array
    H_poses: Array
    g_shared: Array
    g_poses: Array
    cost: float

    def step(self, damping: float) -> tuple[Array, Array]:
        """Solve for the shared step (Q,) and the pose steps (S, 6) with Marquardt's damping."""
        H = self.H_shared + np.diag(damping * np.diag(self.H_shared))
        Hp = self.H_poses + damping * self.H_poses * np.eye(6)
        gain = np.linalg.solve(Hp, self.H_cross)
        S = H - np.tensordot(self.H_cross, gain, axes=((0, 1), (0, 1)))
        g = self.g_shared - np.tensordot(gain, self.g_poses, axes=((0, 1), (0, 1)))
        shared = solve_scaled(S, g)
        poses = np.linalg.solve(Hp, (self.g_poses - self.H_cross @ shared)[..., None])[..., 0]
        return shared, np.asarray(poses, np.float64)

    def schur(self) -> Array:
        """(Q, Q) information of the shared parameters with the poses marginalised."""
        gain = np.linalg.solve(self.H_poses, self.H_cross)
        return np.asarray(self.H_shared - np.tensordot(self.H_cross, gain, axes=((0, 1), (0, 1))))


def solve_scaled(H: Array, g: Array) -> Array:
    """Solve a positive semi-definite system after scaling it to a unit diagonal; least norm where it is singular."""
    if not len(g):
        return g
    d = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300))
    return np.asarray(d * np.linalg.lstsq(d[:, None] * H * d, d * g, rcond=1e-14)[0])


def _normal(
    model: Model, state: State, observations: Observations, W: Array, free: NDArray[np.bool_], robust: bool
) -> tuple[_Normal, Array]:
    """Assemble the normal equations at a state; also return the raw residuals (N, 2), px."""
    uv, J_shared, J_pose = predict(model, state, observations)
    residuals = observations.uv - uv
    r = (W @ residuals[..., None])[..., 0]
    d2 = np.einsum("ni,ni->n", r, r)
    if not np.isfinite(d2).all():
        nothing = np.zeros(0)
        return _Normal(nothing, nothing, nothing, nothing, nothing, np.inf), residuals
    c2 = CAUCHY_SCALE**2
    weight = 1.0 / (1.0 + d2 / c2) if robust else np.ones(len(d2))
    prior = _prior(model, J_shared.shape[2])
    shape = np.concatenate([np.zeros(J_shared.shape[2] - len(state.shape)), state.shape])
    cost = float((c2 * np.log1p(d2 / c2)).sum() if robust else d2.sum()) + float(prior @ shape**2)
    root = np.sqrt(weight)[:, None]
    r = r * root
    A = (root[..., None] * W) @ J_shared[:, :, free]
    B = (root[..., None] * W) @ J_pose
    n, q = observations.shot_count, A.shape[2]
    H_cross, H_poses, g_poses = np.zeros((n, 6, q)), np.zeros((n, 6, 6)), np.zeros((n, 6))
    bounds = np.searchsorted(observations.shot, np.arange(n + 1))
    for j in range(n):
        rows = slice(bounds[j], bounds[j + 1])
        m = 2 * (bounds[j + 1] - bounds[j])
        a, b, e = A[rows].reshape(m, q), B[rows].reshape(m, 6), r[rows].reshape(m)
        H_cross[j], H_poses[j], g_poses[j] = b.T @ a, b.T @ b, b.T @ e
    flat = A.reshape(2 * len(A), q)
    H_shared = flat.T @ flat + np.diag(prior[free])
    g_shared = flat.T @ r.reshape(-1) - (prior * shape)[free]
    return _Normal(H_shared, H_cross, H_poses, g_shared, g_poses, cost), residuals


def _prior(model: Model, count: int) -> Array:
    """(Q,) information about each of ``count`` shared parameters before any image: the shape's."""
    return np.concatenate([np.zeros(count - len(model.modes)), np.full(len(model.modes), 1.0 / model.shape_sigma_m**2)])


def _covariance(normal: _Normal, prior: Array, robust: bool) -> Array:
    """(q, q) covariance of the free shared parameters, given their prior information (q,)."""
    S = normal.schur()
    if robust:
        S = _ROBUST_EXCESS * (S - np.diag(prior)) + np.diag(prior)
    d = 1.0 / np.sqrt(np.maximum(np.diag(S), 1e-300))
    return np.asarray(d[:, None] * np.linalg.pinv(d[:, None] * S * d, rcond=1e-14, hermitian=True) * d)


def free_parameters(model: Model, state: State) -> NDArray[np.bool_]:
    """(Q,) which shared parameters are estimated."""
    n_cameras = sum(camera.parameters.size for camera in state.cameras)
    return np.concatenate([np.full(n_cameras, model.free_cameras), np.ones(6 + len(model.modes), bool)])


def minimise(
    model: Model,
    start: State,
    observations: Observations,
    sigma_px: float,
    *,
    robust: bool = True,
    free: NDArray[np.bool_] | None = None,
    max_steps: int = _MAX_STEPS,
) -> Solution:
    """Find the minimum next to ``start`` for a given noise.

    Args:
        model: the body and what is held fixed.
        start: where to begin; every observation must lie in front of its camera.
        observations: N detections.
        sigma_px: standard deviation of a detection beyond its image covariance, px.
        robust: Cauchy loss, else plain least squares.
        free: (Q,) which shared parameters move, all that the model frees by default.
        max_steps: iterations at the most.

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
    state, damping, steps = start, 1e-4, 0
    normal, residuals = _normal(model, state, observations, W, free, robust)
    if not np.isfinite(normal.cost):
        raise CalibrationError("the start of the adjustment puts a detected point behind its camera")
    while steps < max_steps and damping < 1e12:
        steps += 1
        step, poses = normal.step(damping)
        shared = np.zeros(len(free))
        shared[free] = step
        trial = _trial(state, shared, poses)
        if trial is not None:
            new, new_residuals = _normal(model, trial, observations, W, free, robust)
            if new.cost <= normal.cost:
                done = normal.cost - new.cost <= _RELATIVE_DECREASE * new.cost
                state, normal, residuals, damping = trial, new, new_residuals, max(damping / 10, 1e-12)
                if done:
                    break
                continue
        damping *= 10
    cov = np.zeros((len(free), len(free)))
    if free.any():
        cov[np.ix_(free, free)] = _covariance(normal, _prior(model, len(free))[free], robust)
    return Solution(state, residuals, sigma_px, cov, normal.cost, steps)


def _trial(state: State, shared: Array, poses: Array) -> State | None:
    """Return the moved state, or None where the step leaves the possible (a focal length below zero)."""
    fx_fy = [camera.intrinsics[:2] for camera in state.cameras]
    sizes = [camera.parameters.size for camera in state.cameras]
    moves = (shared[:2], shared[sizes[0] : sizes[0] + 2])
    if not np.isfinite(shared).all() or any((f + m <= 0).any() for f, m in zip(fx_fy, moves, strict=True)):
        return None
    return moved(state, shared, poses)
