"""The model of bundle adjustment: the observations, what is estimated, what is fixed, and the predicted pixels.

Observations and a state go in, projections with their analytic derivatives come out (:func:`predict`).

First the shape modes: how a body may deviate from its drawing. The body's pose in every shot absorbs its rigid motions,
and its size is unobservable against the distance of the cameras: these seven freedoms are removed
(:func:`without_gauge`), and the remaining modes move points relative to each other.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Correspondences, Ids, Record
from armsight.geometry.pose import exp_se3, inverse, transform
from armsight.geometry.rotation import exp_so3, skew
from armsight.kernels import kernel
from armsight.vision.camera import Camera
from armsight.vision.discs.bias import project_discs


def without_gauge(points: Array, modes: Array) -> Array:
    """Remove rigid motion and size from shape modes (K, M, 3) of points (M, 3), m.

    Return (L, M, 3) orthogonal modes of an RMS displacement of one over all points; where the given modes held the
    seven freedoms, L is K - 7 or, if they were not independent, less.
    """
    centred = points - points.mean(axis=0)
    generators = [np.tile(axis, (len(points), 1)) for axis in np.eye(3)]
    generators += [centred @ skew(axis).T for axis in np.eye(3)] + [centred]
    _, sizes, Q = np.linalg.svd(np.stack([g.ravel() for g in generators]), full_matrices=False)
    Q = Q[sizes > 1e-9 * sizes[0]]  # points on one line have six freedoms: a rotation about it moves none
    flat = modes.reshape(len(modes), -1)
    flat = flat - (flat @ Q.T) @ Q
    _, sizes, basis = np.linalg.svd(flat, full_matrices=False)
    basis = basis[sizes > 1e-9 * max(sizes[0], 1e-300)]
    return np.asarray(basis.reshape(len(basis), len(points), 3) * np.sqrt(len(points)))


def every_point(points: Array) -> Array:
    """Modes (K, M, 3) that let every point move by itself."""
    n = len(points)
    return without_gauge(points, np.eye(3 * n).reshape(3 * n, n, 3))


def smooth(points: Array, degree: int) -> Array:
    """Modes (K, M, 3) of a smoothly distorted plane: polynomials in x and y up to ``degree`` for each of x, y, z."""
    xy = points[:, :2] - points[:, :2].mean(axis=0)
    xy = xy / np.abs(xy).max()
    terms = [xy[:, 0] ** i * xy[:, 1] ** j for i in range(degree + 1) for j in range(degree + 1 - i)]
    modes = np.zeros((3 * len(terms), len(points), 3))
    for k, term in enumerate(terms):
        for axis in range(3):
            modes[3 * k + axis, :, axis] = term
    return without_gauge(points, modes)


@dataclass(frozen=True, eq=False)
class Observations(Record):
    """Detections of one body over many shots, one row each, sorted by shot."""

    shot: Ids  #: (N,) row of the shot
    camera: Ids  #: (N,) 0 left, 1 right
    point: Ids  #: (N,) row of the body's points
    uv: Array  #: (N, 2) raw pixels
    cov_uv: Array  #: (N, 2, 2) covariance the image supports, px^2
    shot_count: int  #: how many shots there are

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


def _still() -> Array:
    """(0, 6): no motion between the exposures is modelled."""
    return np.zeros((0, 6))


@dataclass(frozen=True, eq=False)
class BundleState(Record):
    """The state that bundle adjustment estimates."""

    cameras: tuple[Camera, Camera]  #: left and right
    T_left_right: Array  #: (4, 4) pose of the right camera in the left one's frame
    Ts_left_body: Array  #: (S, 4, 4) pose of the body in every shot
    shape: Array  #: (K,) coordinates of the body's shape along its modes, m
    #: (S, 6) motion of the body from the left exposure to the right one, in its own frame: translation of its middle,
    #: m, and the rotation vector about it, rad; (0, 6) where it stood still
    motions: Array = field(default_factory=_still)


@dataclass(frozen=True, eq=False)
class BundleModel(Record):
    """What bundle adjustment holds fixed, and its priors.

    The shared parameters are: left intrinsics and distortion, right intrinsics and distortion, the tangent of
    T_left_right, and the shape.
    """

    points: Array  #: (M, 3) nominal points of the body, m
    modes: Array  #: (K, M, 3) shape modes: the body is ``points + shape @ modes``
    shape_sigma_m: float  #: standard deviation of every shape coordinate before any image, m
    free_cameras: bool  #: whether intrinsics and distortion are estimated
    #: (S, 6) standard deviation of every shot's motion between the exposures before any image, m and rad, as in
    #: :class:`BundleState`; (0, 6) where the body stands still
    motion_sigmas: Array = field(default_factory=_still)
    #: radius of the discs in the plane z = 0 of which the points are the middles and the centres of their ellipses are
    #: observed, m; 0 where the points themselves are
    disc_radius_m: float = 0.0

    def body(self, shape: Array) -> Array:
        """(M, 3) points of the body of a given shape, m."""
        return np.asarray(self.points + np.tensordot(shape, self.modes, axes=1))


@kernel(nogil=True)
def _cross(a: Array, b: Array, out: Array) -> None:
    """Write the cross product of a and b (3,) into out."""
    out[0], out[1], out[2] = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@kernel(nogil=True)
def _by(row: Array, M: Array, out: Array) -> None:
    """Write a row (3,) times a matrix (3, 3) into out."""
    for c in range(3):
        out[c] = row[0] * M[0, c] + row[1] * M[1, c] + row[2] * M[2, c]


@kernel(
    "i8[::1], (i8, i8), (f8[:, :, ::1], f8[:, :, :], f8[:, :, ::1]), (f8[:, ::1], f8[:, ::1], f8[:, ::1]), "
    "(f8[:, :, :], f8[:, :, :], f8[:, :, :]), f8[:, :, ::1]",
    nogil=True,
)
def _fill(
    rows: NDArray[np.intp],
    ends: tuple[int, int],
    Js: tuple[Array, Array, Array],
    ps: tuple[Array, Array, Array],
    Rs: tuple[Array, Array, Array],
    J: Array,
) -> None:
    """Write one camera's rows of :func:`derivatives`, zero before: the chain rule, row by row.

    ``ends``: columns of a camera's parameters, and whether it is the right one. Js: derivatives by the point (n, 2, 3),
    by the camera's parameters (n, 2, c), by the disc's normal (n or 0, 2, 3). ps: the point in the camera's frame, in
    the body's and from its middle (n, 3), m. Rs (n, 3, 3): rotations to the camera's frame of the body as it stood, and
    as it has moved; right Jacobians of its motion; (0, 3, 3) where it stood still.
    """
    cameras, right = ends
    J_p, J_k, J_normal = Js
    side, by_body, by_point, normal, tilt = np.empty(3), np.empty(3), np.empty(3), np.zeros(3), np.zeros(3)
    for n in range(rows.size):
        for i in range(2):
            row = J[rows[n], i]
            for k in range(J_k.shape[2]):
                row[k] = J_k[n, i, k]
            rig, own, point = row[cameras:], row[cameras + 6 :], row[row.size - 3 :]
            _by(J_p[n, i], Rs[0][n], by_body)
            _by(J_p[n, i], Rs[1][n], by_point)
            if J_normal.shape[0]:
                _cross(J_normal[n, i], Rs[1][n, :, 2], normal)
                _by(normal, Rs[0][n], tilt)
            _cross(ps[1][n], by_body, side)
            for c in range(3):
                point[c], own[c], own[3 + c] = by_point[c], by_body[c], side[c] - tilt[c]
            if right:
                _cross(J_p[n, i], ps[0][n], side)
                for c in range(3):
                    rig[c], rig[3 + c] = -J_p[n, i, c], side[c] + normal[c]
                if Rs[2].shape[0]:
                    _cross(ps[2][n], by_point, side)
                    _by(side, Rs[2][n], own[9:])
                    for c in range(3):
                        own[6 + c] = by_body[c]


def derivatives(model: BundleModel, state: BundleState, observations: Observations) -> tuple[Array, Array]:
    """Project every observation, (N, 2) pixels, and differentiate by what it depends on, (N, 2, c + 6 + k + 3).

    By the parameters of its own camera (c of the camera that has more), by the tangent of the relative pose, by that of
    its shot's pose (perturbation on the right) and the shot's motion (k is 6, or 12 with motions), and by its point of
    the body.
    """
    most = max(camera.parameters.size for camera in state.cameras)
    uv = np.empty((len(observations.shot), 2))
    J = np.zeros((len(uv), 2, most + 9 + (12 if len(state.motions) else 6)))
    body, middle = model.body(state.shape), model.points.mean(axis=0)
    moves, still = len(state.motions) > 0, np.zeros((0, 3, 3))
    for side, camera in enumerate(state.cameras):
        rows = np.flatnonzero(observations.camera == side)
        points, shots = observations.point[rows], observations.shot[rows]
        Ts = state.Ts_left_body if side == 0 else inverse(state.T_left_right) @ state.Ts_left_body
        T, p_body = Ts[shots], body[points]
        by_body = by_point = T[:, :3, :3]
        arm, jacobians = p_body - middle, still
        if side == 1 and moves:
            Rs = exp_so3(np.array(state.motions[:, 3:]))
            p_body = (Rs[shots] @ arm[..., None])[..., 0] + middle + state.motions[shots, :3]
            by_point, jacobians = (Ts[:, :3, :3] @ Rs)[shots], _right_jacobians(state.motions[:, 3:])[shots]
        p = transform(T, p_body)
        uv[rows], J_p, J_k = camera.project_jacobians(p)
        J_normal = np.zeros((0, 2, 3))
        if model.disc_radius_m > 0:
            uv[rows], J_p, J_normal = _ellipses(camera, p, by_point[:, :, 2], model.disc_radius_m, uv[rows], J_p)
        _fill(rows, (most, side), (J_p, J_k, J_normal), (p, p_body, arm), (by_body, by_point, jacobians), J)
    return uv, J


def predict(model: BundleModel, state: BundleState, observations: Observations) -> tuple[Array, Array, Array]:
    """Project every observation and differentiate by all that is shared.

    Returns (N, 2) pixels; (N, 2, Q) derivative by the shared parameters; (N, 2, 6) derivative by the tangent of the shot's
    pose (perturbation on the right), or (N, 2, 12) by that and the shot's motion.
    """
    uv, J = derivatives(model, state, observations)
    left, right = (camera.parameters.size for camera in state.cameras)
    most, n, sides = max(left, right), left + right, observations.camera
    J_shared = np.zeros((len(uv), 2, n + 6 + len(model.modes)))
    J_shared[sides == 0, :, :left], J_shared[sides == 1, :, left:n] = J[sides == 0, :, :left], J[sides == 1, :, :right]
    J_shared[:, :, n : n + 6] = J[:, :, most : most + 6]
    J_shared[:, :, n + 6 :] = J[:, :, -3:] @ model.modes.transpose(1, 2, 0)[observations.point]
    return uv, J_shared, np.ascontiguousarray(J[:, :, most + 6 : -3])


def _ellipses(
    camera: Camera, p: Array, normals: Array, radius_m: float, uv: Array, J_p: Array
) -> tuple[Array, Array, Array]:
    """Project discs instead of their middles: centres of the ellipses (N, 2), derivatives by p and by normals (N, 2, 3).

    p (N, 3): middles, m, camera's frame; uv (N, 2): their images, which stay where a disc has no ellipse; J_p: derivative.
    """
    centres, _, J_disc, J_normal = project_discs(camera, p, np.ascontiguousarray(normals), np.full(len(p), radius_m))
    seen = np.isfinite(centres[:, 0])
    one, all_three = seen[:, None], seen[:, None, None]
    return np.where(one, centres, uv), np.where(all_three, J_disc, J_p), np.where(all_three, J_normal, 0.0)


def of_middles(model: BundleModel, state: BundleState, observations: Observations) -> Observations:
    """Return the observations that discs' middles would give: less the perspective bias at a state."""
    if not model.disc_radius_m > 0:
        return observations
    points = replace(model, disc_radius_m=0.0)
    bias = predict(model, state, observations)[0] - predict(points, state, observations)[0]
    return replace(observations, uv=observations.uv - bias)


def _right_jacobians(rotations: Array) -> Array:
    """(S, 3, 3) right Jacobians of SO(3) at rotation vectors (S, 3), rad.

    Each is the transpose of the matrix by which exp_se3 multiplies its translation.
    """
    tangents = np.concatenate(
        [np.tile(np.eye(3), (len(rotations), 1, 1)), np.repeat(rotations[:, None], 3, axis=1)], axis=2
    )
    return np.asarray(exp_se3(tangents)[..., :3, 3])


def moved(state: BundleState, shared: Array, shots: Array) -> BundleState:
    """Return the state moved by ``shared`` (Q,) and ``shots``: tangents (S, 6) of the poses, or (S, 12) with motions."""
    left, right = state.cameras
    n_left, n = left.parameters.size, left.parameters.size + right.parameters.size
    return BundleState(
        (
            left.with_parameters(left.parameters + shared[:n_left]),
            right.with_parameters(right.parameters + shared[n_left:n]),
        ),
        state.T_left_right @ exp_se3(shared[n : n + 6]),
        state.Ts_left_body @ exp_se3(shots[:, :6]),
        state.shape + shared[n + 6 :],
        state.motions + shots[:, 6:] if len(state.motions) else state.motions,
    )
