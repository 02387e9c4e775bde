"""Whether what a pose was fitted to is the body at all: its size, its shape, and whether chance explains what is left."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.special import chdtri

from armsight.data import Array, Body, Points
from armsight.geometry.rigid import fit_rigid, fit_scale
from armsight.vision.posefit import PoseFit, Sightings
from armsight.vision.rig import StereoRig

_COLLINEAR = 1e-3
#: Residuals beyond chance and beyond this share of the body's apparent size are of something else than the body: a square
#: of a wrong size, wrong names. A bent or badly printed body is a few hundredths off.
_ALIKE = 0.2
#: A body whose points are this much too far apart or too close together, and by so many standard deviations, is another.
_SIZE_TOLERANCE, _SIZE_SIGMAS = 0.02, 6.0
#: Residuals beyond this quantile of their chi-square distribution are a misfit, not chance.
_MISFIT_QUANTILE = 0.999


def on_one_line(points: Array) -> bool:
    """Whether points (N, 3), N >= 3, lie on one line, which can turn about itself unseen."""
    centred = points - points.mean(axis=0)
    spread = np.linalg.eigvalsh(centred.T @ centred)
    return bool(spread[1] <= _COLLINEAR**2 * spread[2])


def unbelievable(rig: StereoRig, body: Body, points: Points, fit: PoseFit, used: Sightings, rigid: Array) -> str | None:
    """Say why a fit is no measurement of the body, or None.

    Args:
        rig: the calibrated pair.
        body: the body's points, m.
        points: triangulated points, three or more, not all on one line.
        fit: the pose's plain fit.
        used: the sightings that went in, all of the points' or fewer.
        rigid: (4, 4) T_left_body of the rigid fit to all points.
    """
    everything = len(used.point) == np.count_nonzero(points.seen.seen)
    count = np.bincount(used.point, minlength=len(body.points))
    if not everything and on_one_line(body.points[count > 0]):
        return "the points that agree with one pose of the body lie on one line"
    if fit.cost > misfit_limit(2 * len(used.point) - 6) and (reason := _unlike(body, points, fit, used)) is not None:
        return reason
    if everything:
        return _wrong_size(rig, body, points, rigid)
    both = count[points.ids] == 2
    if both.sum() < 3 or on_one_line(body.points[points.ids[both]]):
        return None
    arrays = (points.ids[both], points.p_left[both], points.cov[both], points.calibration[both])
    return _wrong_size(rig, body, Points(*arrays, points.seen), fit_rigid(body.points[arrays[0]], arrays[1]))


def _unlike(body: Body, points: Points, fit: PoseFit, used: Sightings) -> str | None:
    """Say that the detections a pose was fitted to are further off it than those of a bent body would be, or None."""
    sides = [used.uv[used.camera == c] for c in (0, 1)]
    size = np.sqrt(np.mean(np.concatenate([((uv - uv.mean(axis=0)) ** 2).sum(axis=1) for uv in sides if len(uv)])))
    off = np.sqrt((fit.residuals_px**2).sum(axis=1).mean())
    if off <= _ALIKE * size:
        return None
    scale = fit_scale(body.points[points.ids], points.p_left)
    return (
        f"the detections are not those of the body: {off:.1f} px off at an apparent size of {size:.0f} px, and "
        f"{scale:.2f} times as far apart as its points"
    )


def _wrong_size(rig: StereoRig, body: Body, points: Points, T_left_body: Array) -> str | None:
    """Say that the points are closer together or further apart than the body's, beyond what the rig can be wrong, or None.

    The scale is that of a similarity fit, ``T_left_body`` being the rigid one; its sigma holds pixel noise and the rig's
    calibration.
    """
    p_body = body.points[points.ids]
    p = (p_body - p_body.sum(axis=0) / len(p_body)) @ T_left_body[:3, :3].T
    spread = float(np.vdot(p, p))
    scale = float(np.vdot(p, points.p_left)) / spread
    if abs(scale - 1) <= _SIZE_TOLERANCE:
        return None
    by_rig = np.einsum("ni,nip->p", p, points.calibration) / spread
    variance = float(np.einsum("ni,nij,nj->", p, points.cov, p)) / spread**2 + float(by_rig @ rig.cov @ by_rig)
    if abs(scale - 1) <= _SIZE_SIGMAS * np.sqrt(variance):
        return None
    return (
        f"its points lie {scale:.3f} times as far apart as those of {body.name}: is the size in the target right (of a "
        "square, a tag, the body file's unit), and is it the target the rig sees?"
    )


@lru_cache(maxsize=256)
def misfit_limit(freedom: int) -> float:
    """Sum of squares beyond which residuals are a misfit, not chance."""
    return float(chdtri(freedom, 1 - _MISFIT_QUANTILE)) if freedom > 0 else np.inf
