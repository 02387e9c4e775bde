"""Where a body may be as one camera sees it: every candidate pose, mirror solutions included (perspective-n-point)."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Ids, Record
from armsight.geometry.pose import pose, transform
from armsight.vision.camera import Camera
from armsight.vision.pose.posefit import PixelObservations, fit_pose

#: Fewest points that have one pose: three have up to four.
MIN_POINTS = 4


def body_poses(points: Array, camera: Camera, uv: Array) -> list[tuple[Array, float]]:
    """Solve for the poses of a body, points (N, 3), m, N >= 4, from where one camera saw them, uv (N, 2), raw pixels.

    Return candidates T_camera_body (4, 4) with their reprojection RMS, px, best first: both solutions of a plane; none
    where the points do not determine one.
    """
    rays = camera.unproject(uv)
    ahead = np.isfinite(rays).all(axis=1) & (rays[:, 2] > 0.1)
    if ahead.sum() < MIN_POINTS:
        return []
    xy, p = rays[ahead, :2] / rays[ahead, 2:], points[ahead]
    spread = np.linalg.svd(p - p.mean(axis=0), compute_uv=False)
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
        found += _poses(rotations, translations)
    scored = []
    for T in found:
        error = camera.project(transform(T, points)) - uv
        if np.isfinite(error).all():
            scored.append((T, float(np.sqrt((error**2).sum(axis=1).mean()))))
    return sorted(scored, key=lambda candidate: candidate[1])


def _poses(rotations: Sequence[NDArray[Any]], translations: Sequence[NDArray[Any]]) -> list[Array]:
    return [
        pose(np.asarray(cv2.Rodrigues(r)[0], np.float64), t.ravel())
        for r, t in zip(rotations, translations, strict=True)
    ]


@dataclass(frozen=True, eq=False)
class Candidate(Record):
    """A pose that some of one camera's detections agree on."""

    T_camera_body: Array  #: (4, 4) the pose
    rows: Ids  #: (K,) the detections that agree, each of another point
    rms_px: float  #: their RMS distance from the projections


#: A detection agrees with a pose within this share of the body's apparent size, and at least so many px: wide, for the
#: body may differ from its drawing; the joint adjustment is stricter.
_AGREE_SHARE, _AGREE_PX = 0.03, 2.0
_MOST_TRIPLES = 600
_SAME_ROTATION_RAD = 0.05
_MOST_CANDIDATES = 8


def consensus_poses(points: Array, camera: Camera, ids: Ids, uv: Array) -> list[Candidate]:
    """Find every pose of a body, points (M, 3), m, that three or more detections of one camera agree on.

    Every triple of differently named detections (600 seeded ones where there are more) gives up to four poses; those
    that most detections agree with are polished. Several bodies of one kind, wrong names and mirror solutions all come
    out as candidates; other views decide. ``ids`` (N,) may name a point more than once; uv (N, 2) raw pixels. Most
    agreeing detections come first, then the smallest distance.
    """
    rays = camera.unproject(uv)
    ahead = np.flatnonzero(np.isfinite(rays).all(axis=1) & (rays[:, 2] > 0.1))
    xy = rays[:, :2] / rays[:, 2:]
    scored = []
    for triple in _triples(ahead, ids):
        p = points[ids[triple]]
        if np.linalg.norm(np.cross(p[1] - p[0], p[2] - p[0])) < 1e-3 * np.ptp(points, axis=0).max() ** 2:
            continue
        _, rotations, translations = cv2.solveP3P(p, xy[triple][:, None], np.eye(3), None, flags=cv2.SOLVEPNP_AP3P)
        for T in _poses(rotations, translations):
            rows, rms = agreeing(points, camera, T, ids, uv)
            if len(rows) >= 3:
                scored.append((-len(rows), rms, T, rows))
    found: list[Candidate] = []
    for count, _, T, rows in sorted(scored, key=lambda entry: entry[:2]):
        if len(found) == _MOST_CANDIDATES:
            break
        if any(-count < len(c.rows) - 1 and np.isin(rows, c.rows).mean() > 0.5 for c in found):
            continue
        T = _polished(points[ids[rows]], camera, T, uv[rows])
        rows, rms = agreeing(points, camera, T, ids, uv)
        # ||R_1 - R_2|| = sqrt(8) sin(angle / 2)
        apart = [float(np.linalg.norm((c.T_camera_body - T)[:3, :3])) for c in found]
        if len(rows) >= 3 and min(apart, default=np.inf) > 8**0.5 * np.sin(_SAME_ROTATION_RAD / 2):
            found.append(Candidate(T, rows, rms))
    return sorted(found, key=lambda c: (-len(c.rows), c.rms_px))


def _triples(rows: Ids, ids: Ids) -> list[Ids]:
    """Return all triples of detections with different names, or a seeded choice of them."""
    triples = [t for t in itertools.combinations(rows, 3) if len({ids[i] for i in t}) == 3]
    if len(triples) > _MOST_TRIPLES:
        chosen = np.random.default_rng(0).choice(len(triples), _MOST_TRIPLES, replace=False)
        triples = [triples[i] for i in chosen]
    return [np.array(t) for t in triples]


def agreeing(
    points: Array, camera: Camera, T: Array, ids: Ids, uv: Array, free: NDArray[np.bool_] | bool = True
) -> tuple[Ids, float]:
    """Return the free detections that agree with a pose, the nearest of each name, and their RMS distance, px."""
    projected = camera.project(transform(T, points))
    if not np.isfinite(projected).all():
        return np.zeros(0, np.int64), np.inf
    size = float(np.sqrt(((projected - projected.mean(axis=0)) ** 2).sum(axis=1).mean()))
    distance = np.linalg.norm(projected[ids] - uv, axis=1)
    near = np.flatnonzero((distance <= max(_AGREE_PX, _AGREE_SHARE * size)) & free)
    near = near[np.argsort(distance[near], kind="stable")]
    _, first = np.unique(ids[near], return_index=True)
    rows = near[first]
    return rows, float(np.linalg.norm(distance[rows])) / max(len(rows), 1) ** 0.5


def _polished(p: Array, camera: Camera, T: Array, uv: Array) -> Array:
    """Minimise one camera's pixel distance from a good start."""
    n = len(p)
    observations = PixelObservations(np.zeros(n, np.int64), np.arange(n), uv, np.tile(np.eye(2), (n, 1, 1)))
    fit = fit_pose((camera, camera), np.eye(4), p, observations, T, robust=False)
    return T if fit is None else fit.T_left_body
