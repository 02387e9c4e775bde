"""Where a body may be as one camera sees it: every candidate pose, mirror solutions included (perspective-n-point)."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Ids, Record
from armsight.geometry.pose import pose, transform
from armsight.geometry.rotation import exp_so3, log_so3
from armsight.vision.camera import Camera
from armsight.vision.pose.posefit import PixelObservations, fit_pose

MIN_POINTS = 4


def body_poses(points: Array, camera: Camera, uv: Array) -> list[tuple[Array, float]]:
    """Solve for the pose of a body in one camera.

    Args:
        points: (N, 3) points of the body, m, N >= 4; planar or not.
        camera: the camera.
        uv: (N, 2) where it saw them, raw pixels.

    Returns:
        Candidate poses T_camera_body (4, 4) with their reprojection RMS, px, best first: both solutions of a plane;
        none where the points do not determine one.
    """
    rays = camera.unproject(uv)
    ahead = np.isfinite(rays).all(axis=1) & (rays[:, 2] > 0.1)
    if ahead.sum() < MIN_POINTS:
        return []
    xy, p = rays[ahead, :2] / rays[ahead, 2:], points[ahead]
    centred = p - p.mean(axis=0)
    spread = np.linalg.svd(centred, compute_uv=False)
    if spread[1] < 1e-6 * spread[0]:
        return []
    flat = spread[2] < 1e-6 * spread[0]
    flags = (cv2.SOLVEPNP_IPPE,) if flat else (cv2.SOLVEPNP_SQPNP, cv2.SOLVEPNP_EPNP)
    found = []
    for flag in flags:
        try:
            _, rotations, translations, _ = cv2.solvePnPGeneric(p, xy[:, None], np.eye(3), None, flags=flag)
        except cv2.error:
            continue
        found += [_pose(r, t) for r, t in zip(rotations, translations, strict=True)]
    scored = []
    for T in found:
        error = camera.project(transform(T, points)) - uv
        if np.isfinite(error).all():
            scored.append((T, float(np.sqrt((error**2).sum(axis=1).mean()))))
    return sorted(scored, key=lambda candidate: candidate[1])


def _pose(rotation: NDArray[Any], translation: NDArray[Any]) -> Array:
    """Return OpenCV's rotation vector and translation as a pose."""
    return pose(exp_so3(np.asarray(rotation, np.float64).ravel()), np.asarray(translation, np.float64).ravel())


@dataclass(frozen=True, eq=False)
class Candidate(Record):
    """A pose that some of one camera's detections agree on.

    Attributes:
        T_camera_body: (4, 4) the pose.
        rows: (K,) the detections that agree, each of another point.
        rms_px: their RMS distance from the projections.
    """

    T_camera_body: Array
    rows: Ids
    rms_px: float


#: A detection agrees with a pose within this share of the body's apparent size, and at least so many px: wide, for the
#: body may differ from its drawing; the joint adjustment is stricter.
AGREE_SHARE, AGREE_PX = 0.03, 2.0
_MOST_TRIPLES = 600
_SAME_ROTATION_RAD = 0.05
_MOST_CANDIDATES = 8
_POLISH_STEPS = 20


def consensus_poses(points: Array, camera: Camera, ids: Ids, uv: Array) -> list[Candidate]:
    """Find every pose of a body that three or more detections of one camera agree on.

    Every triple of differently named detections (600 seeded ones where there are more) gives up to four poses; those
    that most detections agree with are polished. Several bodies of one kind, wrong names and mirror solutions all come
    out as candidates; other views decide.

    Args:
        points: (M, 3) points of the body, m.
        camera: the camera.
        ids: (N,) rows of the points that were detected; one may stand more than once.
        uv: (N, 2) where, raw pixels.

    Returns:
        Candidates, most agreeing detections first, then the smallest distance.
    """
    rays = camera.unproject(uv)
    ahead = np.flatnonzero(np.isfinite(rays).all(axis=1) & (rays[:, 2] > 0.1))
    xy = rays[:, :2] / rays[:, 2:]
    hypotheses = []
    for triple in _triples(ahead, ids):
        p = points[ids[triple]]
        if np.linalg.norm(np.cross(p[1] - p[0], p[2] - p[0])) < 1e-3 * np.ptp(points, axis=0).max() ** 2:
            continue
        _, rotations, translations = cv2.solveP3P(p, xy[triple][:, None], np.eye(3), None, flags=cv2.SOLVEPNP_AP3P)
        hypotheses += [_pose(r, t) for r, t in zip(rotations, translations, strict=True)]
    scored = []
    for T in hypotheses:
        rows, rms = _agreeing(points, camera, T, ids, uv)
        if len(rows) >= 3:
            scored.append((-len(rows), rms, T, rows))
    scored.sort(key=lambda entry: entry[:2])
    found: list[Candidate] = []
    for count, _, T, rows in scored:
        if len(found) == _MOST_CANDIDATES:
            break
        if any(-count < len(c.rows) - 1 and np.isin(rows, c.rows).mean() > 0.5 for c in found):
            continue
        T = _polished(points[ids[rows]], camera, T, uv[rows])
        rows, rms = _agreeing(points, camera, T, ids, uv)
        angles = [np.linalg.norm(log_so3(c.T_camera_body[:3, :3].T @ T[:3, :3])) for c in found]
        if len(rows) >= 3 and all(angle > _SAME_ROTATION_RAD for angle in angles):
            found.append(Candidate(T, rows, rms))
    return sorted(found, key=lambda c: (-len(c.rows), c.rms_px))


def _triples(rows: Ids, ids: Ids) -> list[Ids]:
    """Return all triples of detections with different names, or a seeded choice of them."""
    triples = [t for t in itertools.combinations(rows, 3) if len({ids[i] for i in t}) == 3]
    if len(triples) > _MOST_TRIPLES:
        chosen = np.random.default_rng(0).choice(len(triples), _MOST_TRIPLES, replace=False)
        triples = [triples[i] for i in chosen]
    return [np.array(t) for t in triples]


def _agreeing(points: Array, camera: Camera, T: Array, ids: Ids, uv: Array) -> tuple[Ids, float]:
    """Return the detections that agree with a pose, the nearest of each name, and their RMS distance, px."""
    projected = camera.project(transform(T, points))
    if not np.isfinite(projected).all():
        return np.zeros(0, np.int64), np.inf
    size = float(np.sqrt(((projected - projected.mean(axis=0)) ** 2).sum(axis=1).mean()))
    distance = np.linalg.norm(projected[ids] - uv, axis=1)
    near = np.flatnonzero(distance <= max(AGREE_PX, AGREE_SHARE * size))
    near = near[np.argsort(distance[near], kind="stable")]
    _, first = np.unique(ids[near], return_index=True)
    rows = near[first]
    return rows, float(np.sqrt((distance[rows] ** 2).mean())) if len(rows) else np.inf


def _polished(p: Array, camera: Camera, T: Array, uv: Array) -> Array:
    """Minimise one camera's pixel distance from a good start."""
    n = len(p)
    observations = PixelObservations(np.zeros(n, np.int64), np.arange(n), uv, np.tile(np.eye(2), (n, 1, 1)))
    fit = fit_pose((camera, camera), np.eye(4), p, observations, T, robust=False, steps=_POLISH_STEPS)
    return T if fit is None else fit.T_left_body
