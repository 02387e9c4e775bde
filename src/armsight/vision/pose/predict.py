"""Predict how well two cameras will measure a body before it is built: pose covariance, separation of two hypotheses.

A body is set before the cameras, its points are projected, and the information of their pixels is summed: the
covariance of the pose is its inverse (the Cramer-Rao bound), to which the share of the rig's own covariance is added.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Ids, Record
from armsight.geometry.pose import inverse, pose, transform
from armsight.geometry.rotation import exp_so3
from armsight.vision.camera import Camera
from armsight.vision.discs.symmetry import Symmetry
from armsight.vision.pose.bundle import BundleModel, BundleState, Observations, predict
from armsight.vision.pose.posefit import PixelObservations, fit_pose
from armsight.vision.rig import StereoRig

#: A face is relied on where the cosine between its normal and the direction to the camera is above this (70 degrees).
FACING = float(np.cos(np.radians(70.0)))
#: Rotations of the body at which two hypotheses are compared, besides the one that faces the cameras, rad.
_TILT = np.radians(45.0)


def plain_rig(focal_px: float = 900.0, baseline_m: float = 0.2) -> StereoRig:
    """Return two perfect HD cameras side by side."""
    camera = Camera((1280, 720), "none", np.array([focal_px, focal_px, 639.5, 359.5]), np.zeros(0))
    T_left_right = pose(np.eye(3), np.array([baseline_m, 0.0, 0.0]))
    return StereoRig(camera, camera, T_left_right, np.zeros((14, 14)), 0.0, {"source": "stated, not measured"})


@dataclass(frozen=True, eq=False)
class PredictedView(Record):
    """A body before two cameras."""

    T_left_body: Array  #: (4, 4) its pose
    forward: Array  #: (3,) unit vector from the cameras to it, left camera's frame
    #: (M, 2) whether a camera sees a point: in its image, and its face not rotated away; (M, 1): one camera alone
    seen: NDArray[np.bool_]

    @property
    def paired(self) -> Ids:
        """Rows of the points that all cameras see."""
        return np.flatnonzero(self.seen.all(axis=1))


def look_direction(points: Array, normals: Array) -> Array:
    """Return the unit vector (3,), body frame, from which most of a body's faces are seen.

    ``points``: (M, 3) points, m. ``normals``: (M, 3) out of their faces; NaN where unknown. Returns the direction from the
    body to who looks at it; where no normal is known, perpendicular to the flattest plane through the points, on the side
    of -z.
    """
    known = normals[np.isfinite(normals).all(axis=1)]
    if not len(known):
        normal = np.linalg.svd(points - points.mean(axis=0))[2][2]
        first = normal[np.abs(normal) > 1e-9][-1]
        return np.asarray(-np.sign(first) * normal)
    units = [c / np.linalg.norm(c) for c in [known.mean(axis=0), *known] if np.linalg.norm(c) > 0.1]
    return np.asarray(max(units, key=lambda v: (int((known @ v > FACING).sum()), float((known @ v).clip(0).sum()))))


def view(
    rig: StereoRig,
    points: Array,
    normals: Array,
    distance_m: float,
    rotation: tuple[float, float] = (0.0, 0.0),
    aside_m: tuple[float, float] = (0.0, 0.0),
    roll: float = 0.0,
) -> PredictedView:
    """Set a body before the cameras, its faces towards them and its middle between their axes.

    Args:
        rig: the cameras.
        points: (M, 3) points, m.
        normals: (M, 3) out of their faces; NaN where unknown.
        distance_m: from the cameras to the body's middle.
        rotation: about the horizontal and the vertical axis of the image, rad.
        aside_m: right and down, of the point between the cameras' axes.
        roll: of the body about the direction of view, rad.
    """
    towards = look_direction(points, normals)
    ahead = np.array([0.0, 0.0, distance_m, 1.0])
    middle = (ahead[:3] + (rig.T_left_right @ ahead)[:3]) / 2
    forward = middle - rig.T_left_right[:3, 3] / 2
    forward = forward / np.linalg.norm(forward)
    axes = _axes(forward, np.array([1.0, 0.0, 0.0]))
    middle = middle + axes[:, :2] @ np.array(aside_m)
    R = axes @ exp_so3(np.array([*rotation, roll])) @ face_axes(towards).T
    used = (normals @ towards > FACING) | ~np.isfinite(normals).all(axis=1)
    return view_at(rig, points, normals, pose(R, middle - R @ points[used].mean(axis=0)), forward)


def view_at(
    rig: StereoRig, points: Array, normals: Array, T_left_body: Array, forward: Sequence[float] | Array = (0, 0, 1)
) -> PredictedView:
    """Return a body, points and normals (M, 3), m, at a pose (4, 4) before the cameras, ``forward`` of them."""
    return PredictedView(T_left_body, np.array(forward), _seen(rig, T_left_body, points, normals))


def face_axes(normal: Array) -> Array:
    """Return (3, 3) axes of a face as columns, body frame: right, down, and into it, as one looks at it.

    The body's x axis runs to the right; where it is perpendicular to the face, the body's y axis runs down.
    """
    right = np.array([1.0, 0.0, 0.0]) if abs(normal[0]) < 0.9 else np.cross([0.0, 1.0, 0.0], -normal)
    return _axes(-normal, right)


def _axes(z: Array, x: Array) -> Array:
    """Return (3, 3) orthonormal axes as columns: z as given, x as near as possible to the given one."""
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def _seen(rig: StereoRig, T_left_body: Array, points: Array, normals: Array) -> NDArray[np.bool_]:
    """(M, 2) whether a camera has a point in its image, its face not rotated away."""
    columns = []
    for camera, uv in zip(rig.cameras, rig.project(transform(T_left_body, points)), strict=True):
        with np.errstate(invalid="ignore"):
            columns.append(((uv >= 0) & (uv <= np.array(camera.image_size_px) - 1)).all(axis=1))
    return np.stack(columns, axis=1) & _facing(rig, T_left_body, points, normals)


def _facing(rig: StereoRig, T_left_body: Array, points: Array, normals: Array) -> NDArray[np.bool_]:
    """(M, 2) whether a point's face is not rotated away from a camera; true where it is unknown."""
    columns = []
    for T in (T_left_body, inverse(rig.T_left_right) @ T_left_body):
        p = transform(T, points)
        cosine = -np.einsum("ni,ni->n", normals @ T[:3, :3].T, p) / np.linalg.norm(p, axis=1)
        columns.append(~(cosine <= FACING))
    return np.stack(columns, axis=1)


@dataclass(frozen=True, eq=False)
class PoseDerivatives(Record):
    """How the measured pose of a body follows from its N pixel positions, weighted alike.

    Tangents are [translation m; rotation rad], perturbation on the right.
    """

    side: Ids  #: (N,) 0 left, 1 right
    point: Ids  #: (N,) row of the body's points
    uv: Array  #: (N, 2) the projections, raw pixels
    by_uv: Array  #: (6, N, 2) derivative of the pose by the pixels
    by_rig: Array  #: (6, P) by the rig's parameters: what the pose is off by where they are
    by_point: Array  #: (6, M, 3) by the true positions of the body's points, the body's file unchanged
    uv_by_pose: Array  #: (N, 2, 6) derivative of the pixels by the pose

    def noise(self, sigma_px: float) -> Array:
        """Return the covariance (6, 6) that pixels of so many px standard deviation cause."""
        flat = sigma_px * self.by_uv.reshape(6, -1)
        return np.asarray(flat @ flat.T)

    def moved(self, late_s: Array) -> Array:
        """Return M (6, 6): a body of velocity v (6,), its own axes, seems off by M v where pixels are late (N,), s."""
        return np.asarray(np.einsum("knc,ncj,n->kj", self.by_uv, self.uv_by_pose, late_s))


def pose_derivatives(rig: StereoRig, points: Array, seen: PredictedView) -> PoseDerivatives | None:
    """Differentiate the pose that two cameras measure; None where the visible points do not determine one.

    ``points``: (M, 3) points, m; ``seen``: the body's pose and which points are visible.
    """
    rows, sides = np.nonzero(seen.seen)
    if len(seen.paired) < 3:
        return None
    state = BundleState(rig.cameras, rig.T_left_right, seen.T_left_body[None], np.zeros(3 * len(points)))
    nothing = np.zeros((len(rows), 2)), np.zeros((len(rows), 2, 2))
    observed = Observations(np.zeros(len(rows), np.int64), sides, rows, *nothing, 1)
    every = np.eye(3 * len(points)).reshape(-1, len(points), 3)
    uv, J_shared, J_pose = predict(BundleModel(points, every, 1.0, False), state, observed)
    A, B = J_pose.reshape(-1, 6), J_shared.reshape(len(rows) * 2, -1)
    information = A.T @ A
    scale = np.sqrt(np.diag(information))
    if not (scale > 0).all() or np.linalg.cond(information / np.outer(scale, scale)) > 1e12:
        return None
    gain: Array = np.linalg.solve(information, A.T).astype(np.float64)
    by_shared, P = gain @ B, rig.parameter_count
    by_point = by_shared[:, P:].reshape(6, len(points), 3)
    return PoseDerivatives(sides, rows, uv, gain.reshape(6, -1, 2), -by_shared[:, :P], by_point, J_pose)


def pose_covariance(rig: StereoRig, points: Array, seen: PredictedView, sigma_px: float) -> Array | None:
    """Predict the covariance (6, 6) of a body's pose, [translation m; rotation rad], perturbation on the right.

    ``rig``: the cameras; the share of their calibration is included where the rig's covariance is known. ``points``: (M, 3)
    points, m. ``seen``: the body's pose and which points are visible. ``sigma_px``: standard deviation of a measured pixel
    position, px. Returns the covariance, or None where the visible points do not determine a pose.
    """
    found = pose_derivatives(rig, points, seen)
    return None if found is None else found.noise(sigma_px) + found.by_rig @ rig.cov @ found.by_rig.T


def separation(
    rig: StereoRig,
    points: Array,
    normals: Array,
    symmetry: Symmetry,
    distance_m: float,
    sigma_px: float,
    hidden: int = -1,
) -> float:
    """Return the least separation of a wrong naming of the discs from the true one, sigmas, over five rotations.

    Args:
        rig: the cameras.
        points: (M, 3) positions of the discs, m.
        normals: (M, 3) out of their faces; NaN where unknown.
        symmetry: the wrong naming: which discs are taken for which.
        distance_m: of the body.
        sigma_px: standard deviation of a disc's measured centre, px.
        hidden: a disc that something hides; none where below zero.

    Returns:
        The root of the weighted sum of squares of the wrong naming's residuals; infinity where its discs would always
        be seen from behind, NaN where there is no rotation at which the discs in view are visible and no others.
    """
    seen, taken = symmetry.seen, symmetry.taken_for
    others = np.setdiff1d(np.arange(len(points)), [*seen, hidden])
    worst = np.nan
    for rotation in ((0.0, 0.0), (_TILT, 0.0), (-_TILT, 0.0), (0.0, _TILT), (0.0, -_TILT)):
        true = view(rig, points[seen], normals[seen], distance_m, rotation)
        here = np.asarray(_facing(rig, true.T_left_body, points, normals).all(axis=1))
        if not here[seen].all() or here[others].any():
            continue
        worst = np.fmin(worst, np.inf)
        start = true.T_left_body @ inverse(symmetry.T)
        if not _facing(rig, start, points[taken], normals[taken]).all():
            continue
        p = transform(true.T_left_body, points[seen])
        uv = np.concatenate(rig.project(p))
        count = len(seen)
        observations = PixelObservations(
            np.repeat([0, 1], count), np.tile(taken, 2), uv, np.tile(sigma_px**2 * np.eye(2), (2 * count, 1, 1))
        )
        fit = fit_pose(rig.cameras, rig.T_left_right, points, observations, start, robust=False)
        if fit is not None:
            worst = np.fmin(worst, np.sqrt(fit.cost))
    return float(worst)
