"""Locate a body: the maximum-likelihood pose over all of its detections, with covariance.

The triangulated points give the start (rigid fit); the estimate minimises the covariance-weighted pixel distance of all
detections, those of one camera included. One bad point is found by a robust fit and dropped by name; the covariance
is that of plain least squares on the others, plus the rig's own covariance propagated through the same fit. Where the
body fits worse than the pixel noise allows (a print that deviates from its drawing, a body that moved between the two
images) the noise is that of the residuals (Birge ratio), and the estimate reports the ratio as ``misfit``.

The checks of plausibility come first: whether the detections are those of the body at all, by its size, its shape, and
the chi-square of the residuals.
"""

from __future__ import annotations

import math
from collections import Counter
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from armsight.data import SIDES, Array, Body, Dropped, Missed, Points, PoseEstimate
from armsight.errors import some
from armsight.estimate.chance import MISTAKE, chi_square_limit
from armsight.geometry.pose import inverse, pose, transform
from armsight.geometry.rigid import collinear, fit_rigid, fit_scale
from armsight.geometry.rotation import skew
from armsight.vision.match import SIGMAS
from armsight.vision.pose.pnp import consensus_poses
from armsight.vision.pose.posefit import PixelObservations, PoseFit, fit_pose, whitened
from armsight.vision.rig import StereoRig

#: Residuals beyond chance and beyond this share of the body's apparent size are implausible: a wrong size, wrong names.
#: A bent or badly printed body deviates by a few hundredths.
_ALIKE = 0.2
#: A body whose points are too far apart or too close together by this share, and by so many sigmas, is another body.
_SIZE_TOLERANCE = 0.02
#: Residuals beyond this quantile of their chi-square distribution are a misfit, not chance.
_MISFIT_QUANTILE = 0.999


def implausible(
    rig: StereoRig, body: Body, points: Points, fit: PoseFit, used: PixelObservations, rigid: Array
) -> str | None:
    """Return the reason why a fit is not a plausible measurement of the body, or None.

    ``body``: the body's points, m; ``points``: triangulated points, three or more, not all on one line; ``fit``: the pose's
    plain fit; ``used``: the observations that were fitted, all of the points' or fewer; ``rigid``: (4, 4) T_left_body of
    the rigid fit to all points.
    """
    everything = len(used.point) == np.count_nonzero(points.seen.seen)
    count = np.bincount(used.point, minlength=len(body.points))
    if not everything and collinear(body.points[count > 0]):
        return "the points that agree with one pose of the body lie on one line"
    if fit.cost > misfit_limit(2 * len(used.point) - 6) and _unlike(fit, used):
        return _another(body, points)
    if everything:
        return _wrong_size(rig, body, points, rigid)
    both = count[points.ids] == 2
    if both.sum() < 3 <= _AGREEING * len(points.ids):
        return (
            f"the images of both cameras contradict each other: {both.sum()} of {len(points.ids)} points agree with one"
            " pose in both; a frozen camera, or images of different moments?"
        )
    if both.sum() < 3 or collinear(body.points[points.ids[both]]):
        return None
    arrays = (points.ids[both], points.p_left[both], points.cov[both], points.calibration[both])
    return _wrong_size(rig, body, Points(*arrays, points.seen), fit_rigid(body.points[arrays[0]], arrays[1]))


def _unlike(fit: PoseFit, used: PixelObservations) -> bool:
    """Whether the fitted detections are further off the pose than those of a bent body would be."""
    sides = [used.uv[used.camera == c] for c in (0, 1)]
    size = np.sqrt(np.mean(np.concatenate([((uv - uv.mean(axis=0)) ** 2).sum(axis=1) for uv in sides if len(uv)])))
    return bool(np.sqrt((fit.residuals_px**2).sum(axis=1).mean()) > _ALIKE * size)


def _another(body: Body, points: Points) -> str:
    scale = fit_scale(body.points[points.ids], points.p_left)
    return (
        f"the detections are not those of the body: no pose fits, and they lie {scale:.2f} times as far apart as its points"
        " (is its size right, and its unit?)"
    )


def _wrong_size(rig: StereoRig, body: Body, points: Points, T_left_body: Array) -> str | None:
    """Report that the points are closer together or further apart than the body's, beyond the rig's errors, or None.

    Markers of another size, at the right positions, change the whole by less than themselves: these are named then.
    """
    scale, sigma = _scale(rig, body.points[points.ids], points, T_left_body)
    if wrong := _wrong_markers(rig, body, points, T_left_body, scale):
        return f"markers of {body.name} have another size than its file says: {some(wrong)}; correct the file"
    if abs(scale - 1) <= max(_SIZE_TOLERANCE, SIGMAS * sigma):
        return None
    off = f"its points lie {scale:.3f} times as far apart as those of {body.name}"
    moved = (
        f"it moved by about {1e3 * abs(scale - 1) * rig.baseline_m:.2g} mm along the baseline between the two exposures"
    )
    return (
        f"{off}: is the size in the target right (of a square, a tag, the body file's unit), is it the target the rig sees"
        f", are the images as the calibration had them, not cropped, shifted or scaled since, or is it that {moved}"
        " (one trigger for both cameras prevents that)?"
    )


def _wrong_markers(rig: StereoRig, body: Body, points: Points, T_left_body: Array, whole: float) -> list[str]:
    """Return what each marker measures (points NAME.0, NAME.1, ...) whose size is neither its own nor the whole's."""
    wrong, markers = list[str](), [body.point_names[i].rpartition(".")[0] for i in points.ids]
    for name, count in Counter(markers).items():
        if not name or not 3 <= count < len(markers):  # the only marker is the whole
            continue
        rows = np.array([each == name for each in markers])
        arrays = (points.ids[rows], points.p_left[rows], points.cov[rows], points.calibration[rows])
        scale, sigma = _scale(rig, body.points[points.ids[rows]], Points(*arrays, points.seen), T_left_body)
        least = max(_SIZE_TOLERANCE, SIGMAS * sigma)
        if min(abs(scale - 1), abs(scale - whole)) > least:
            first, second, *_ = (k for k, each in enumerate(body.point_names) if each.rpartition(".")[0] == name)
            apart = 1e3 * float(np.linalg.norm(body.points[second] - body.points[first]))
            wrong.append(f"{name} {scale * apart:.4g} mm instead of {apart:.4g}")
    return wrong


def _scale(rig: StereoRig, p_body: Array, points: Points, T_left_body: Array) -> tuple[float, float]:
    """Return by how many times points (N) lie further apart than p_body (N, 3), m, and its sigma, the rig's included.

    The scale is that of a similarity fit, ``T_left_body`` being the rigid one.
    """
    p = (p_body - p_body.sum(axis=0) / len(p_body)) @ T_left_body[:3, :3].T
    spread = float(np.vdot(p, p))
    by_rig = p.ravel() @ points.calibration.reshape(p.size, -1) / spread
    variance = float(np.vdot(p, (points.cov @ p[..., None])[..., 0])) / spread**2 + float(by_rig @ rig.cov @ by_rig)
    return float(np.vdot(p, points.p_left)) / spread, float(np.sqrt(variance))


@lru_cache(maxsize=256)
def misfit_limit(freedom: int) -> float:
    """Sum of squares beyond which residuals are a misfit, not chance."""
    return chi_square_limit(freedom, 1 - _MISFIT_QUANTILE) if freedom > 0 else np.inf


#: Whitened squared distance from a robust fit beyond which a detection is an outlier; that of half of them.
_LIMIT, _MEDIAN = chi_square_limit(2, MISTAKE), chi_square_limit(2, 0.5)
#: A shot in which less than this share of the detections agrees with one pose is missed.
_AGREEING = 0.5
#: With this many matched points the rigid fit alone is a safe start; with fewer, its mirror image is tried too, and where
#: it leaves outliers every pose that one camera allows.
_SAFE_POINTS = 8
#: A robust fit whose median squared distance is this many times the expected one may be in a wrong minimum: then rigid
#: fits of so many triples are compared, and the best few tried.
_SUSPECT, _TRIPLES, _TRIED = 4.0, 60, 3


def locate(rig: StereoRig, body: Body, points: Points) -> PoseEstimate | Missed:
    """Estimate the pose of a body in one shot.

    ``body``: the body's points, m; ``points``: the shot's triangulated points, with the correspondences they came from.
    Returns the pose of the body in the left camera's frame, or why there is none: fewer than three points, points on one
    line, no pose that most detections agree with, or detections that do not look like the body.
    """
    reason = _unlocatable(body, points)
    if reason is not None:
        return Missed(reason)
    observations = PixelObservations.of(points.seen, rig.sigma_px)
    rigid = fit_rigid(body.points[points.ids], points.p_left)
    best = _best(rig, body, observations, [rigid])
    if len(points.ids) < _SAFE_POINTS:
        best = _best(rig, body, observations, _starts(rig, body, points, best), best)
    if best is None or _median(best.distance2) > _SUSPECT * _MEDIAN:
        best = _best(rig, body, observations, _agreed_starts(body, points), best)
    if best is None:
        return Missed(_another(body, points))
    good, fit = _without_outliers(rig, body, best, observations)
    if fit is None:
        return Missed(f"only {good.sum()} of {len(good)} detections agree with one pose of the body")
    reason = implausible(rig, body, points, fit, _chosen(observations, good), rigid)
    return _estimate(rig, body, points, fit, observations, good) if reason is None else Missed(reason)


def by_rig(pose: PoseEstimate) -> Array:
    """Return the derivative (6, P) of a pose (right tangent) by the rig's parameters, of the points both cameras saw."""
    points, R = pose.points, pose.T_left_body[:3, :3]
    p_body = transform(inverse(pose.T_left_body), points.p_left)
    J = np.concatenate([np.tile(R, (len(p_body), 1, 1)), np.array([-R @ skew(p) for p in p_body])], axis=2)
    WJ = np.linalg.solve(points.cov, J)
    return np.asarray(
        np.linalg.solve(np.einsum("nki,nkj->ij", WJ, J), np.einsum("nki,nkp->ip", WJ, points.calibration))
    )


def _unlocatable(body: Body, points: Points) -> str | None:
    """Return the reason why a pose cannot be determined, or None."""
    if len(points.ids) < 3:
        lost = f"; dropped: {_listed(points.dropped)}" if points.dropped else ""
        return f"{len(points.ids)} matched points, 3 are needed{lost}"
    return "the matched points lie on one line" if collinear(body.points[points.ids]) else None


def _listed(dropped: tuple[Dropped, ...]) -> str:
    """Name up to three dropped points."""
    shown = ", ".join(f"{d.point} ({d.reason})" for d in dropped[:3])
    return shown + (f" and {len(dropped) - 3} more" if len(dropped) > 3 else "")


def _agrees(distance2: Array) -> NDArray[np.bool_]:
    """Return which of N squared distances, in standard deviations, are no outliers; all are larger on a bent body."""
    return np.asarray(distance2 <= _LIMIT * max(1.0, _median(distance2) / _MEDIAN))


def _mirrored(body: Body, points: Points, T: Array) -> Array:
    """Return the pose nearest to a body's mirror image in the plane across the line of sight (Necker's reversal)."""
    p = body.points[points.ids]
    middle = p.sum(axis=0) / len(p)
    normal = np.linalg.eigh((p - middle).T @ (p - middle))[1][:, 0]
    there = T[:3, :3] @ middle + T[:3, 3]
    R = T[:3, :3] - np.outer(2 * there / (there @ there), there @ T[:3, :3])
    R -= np.outer(2 * R @ normal, normal)
    return pose(R, there - R @ middle)


def _starts(rig: StereoRig, body: Body, points: Points, first: PoseFit | None) -> list[Array]:
    """Return what else the pose of few points may be: a good first fit's mirror image, or all that one camera allows."""
    if first is not None and _median(first.distance2) <= _SUSPECT * _MEDIAN and _agrees(first.distance2).all():
        return [_mirrored(body, points, first.T_left_body)]
    starts, seen = list[Array](), points.seen
    for side, camera in enumerate(rig.cameras):
        rows = seen.seen[:, side]
        to_left = np.eye(4) if side == 0 else rig.T_left_right
        found = consensus_poses(body.points, camera, seen.ids[rows], seen.uv[rows, side])
        starts += [to_left @ candidate.T_camera_body for candidate in found]
    return starts


def _agreed_starts(body: Body, points: Points) -> list[Array]:
    """Return the rigid fits of three points, of a seeded choice of triples, that half of the points agree with best.

    One point that is far off pulls the fit of all away from the minimum, but no fit of three others.
    """
    p_body = body.points[points.ids]
    sigma = np.sqrt(np.trace(points.cov, axis1=1, axis2=2))
    rng = np.random.default_rng(0)
    fits = []
    for _ in range(_TRIPLES):
        rows = rng.choice(len(p_body), 3, replace=False)
        T = fit_rigid(p_body[rows], points.p_left[rows])
        gap = np.linalg.norm(points.p_left - transform(T, p_body), axis=1)
        fits.append((float(np.median(gap / sigma)), T))
    return [T for _, T in sorted(fits, key=lambda fit: fit[0])[:_TRIED]]


def _best(
    rig: StereoRig, body: Body, observations: PixelObservations, starts: list[Array], first: PoseFit | None = None
) -> PoseFit | None:
    """Minimise robustly from every start and return the lowest, ``first`` included; None where no start leads anywhere."""
    fits = [fit_pose(rig.cameras, rig.T_left_right, body.points, observations, start, robust=True) for start in starts]
    fits = [first, *fits]
    return min((fit for fit in fits if fit is not None), key=lambda fit: fit.cost, default=None)


def _without_outliers(
    rig: StereoRig, body: Body, robust: PoseFit, observations: PixelObservations
) -> tuple[NDArray[np.bool_], PoseFit | None]:
    """Drop the outliers of the robust fit, and fit the rest by plain least squares."""
    d2, T = robust.distance2, robust.T_left_body
    good, fit = np.ones(len(d2), bool), None
    for _ in range(3):
        now = _agrees(d2)
        if now.sum() < max(3, _AGREEING * len(now)) or np.count_nonzero(np.bincount(observations.point[now])) < 3:
            return now, None
        if fit is not None and (now == good).all():
            break
        good = now
        fit = fit_pose(rig.cameras, rig.T_left_right, body.points, _chosen(observations, good), T, robust=False)
        if fit is None:
            return good, None
        T = fit.T_left_body
        d2 = fit.distance2 if good.all() else _distances(rig, body, T, observations)[1]
    return good, fit


def _distances(rig: StereoRig, body: Body, T: Array, observations: PixelObservations) -> tuple[Array, Array]:
    """Return (N,) distances of all observations from a pose's projections, px, and their squares in standard deviations."""
    fit = fit_pose(rig.cameras, rig.T_left_right, body.points, observations, T, robust=False, steps=0)
    if fit is None:
        return np.full(len(observations.point), np.inf), np.full(len(observations.point), np.inf)
    return np.linalg.norm(fit.residuals_px, axis=1), fit.distance2


def _estimate(
    rig: StereoRig, body: Body, points: Points, fit: PoseFit, observations: PixelObservations, good: NDArray[np.bool_]
) -> PoseEstimate:
    """Assemble the estimate with its covariance: pixel noise; calibration and common shifts through the same fit."""
    used, T = _chosen(observations, good), fit.T_left_body
    W, A, B = whitened(rig.cameras, rig.T_left_right, body.points, used, T)
    cov: Array = np.asarray(np.linalg.inv(fit.information), np.float64)
    gain, cov_rig, misfit = cov @ (A.T @ B), rig.cov_with(points.seen.common), 1.0
    if fit.cost > misfit_limit(2 * len(used.point) - 6):
        misfit = _misfit((W @ fit.residuals_px[..., None]).ravel(), B - A @ gain, cov_rig)
        cov = misfit * cov
    points, dropped = (points, ()) if good.all() else _thinned(rig, body, points, T, observations, good)
    gap = points.p_left - (body.points[points.ids] @ T[:3, :3].T + T[:3, 3])
    rms, dropped = (_rms(gap), _rms(fit.residuals_px)), points.dropped + dropped
    return PoseEstimate(T, cov + gain @ cov_rig @ gain.T, cov, *rms, math.sqrt(misfit), points, dropped)


def _thinned(
    rig: StereoRig, body: Body, points: Points, T: Array, observations: PixelObservations, good: NDArray[np.bool_]
) -> tuple[Points, tuple[Dropped, ...]]:
    """Return the points whose detections are all good, and the others' names with their distances."""
    distance = _distances(rig, body, T, observations)[0]
    dropped = tuple(
        Dropped(
            body.point_names[observations.point[i]],
            f"{distance[i]:.1f} px off the body in the {SIDES[observations.camera[i]]} image",
            contradicts=True,
        )
        for i in np.flatnonzero(~good)
    )
    kept = ~np.isin(points.ids, observations.point[~good])
    arrays = (points.ids[kept], points.p_left[kept], points.cov[kept], points.calibration[kept])
    return Points(*arrays, points.seen, points.dropped), dropped


def _chosen(observations: PixelObservations, good: NDArray[np.bool_]) -> PixelObservations:
    return observations if good.all() else observations.select(good)


def _misfit(residuals: Array, by_rig: Array, cov_rig: Array) -> float:
    """Return by how much the variance of a fit's residuals exceeds what pixel noise and calibration explain; 1 by chance.

    (M,) whitened residuals of six parameters, weighted by the inverse of I + by_rig cov_rig by_rig^T (Woodbury).
    """
    freedom, v = len(residuals) - 6, by_rig.T @ residuals
    explained = v @ np.linalg.solve(np.eye(len(cov_rig)) + cov_rig @ (by_rig.T @ by_rig), cov_rig @ v)
    chi_square = float(residuals @ residuals - explained)
    return chi_square / freedom if chi_square > misfit_limit(freedom) else 1.0


def _rms(gaps: Array) -> float:
    """Return the root mean square length of gaps (N, K); NaN of none."""
    return math.sqrt(float(np.vdot(gaps, gaps)) / len(gaps)) if len(gaps) else math.nan


def _median(values: Array) -> float:
    """Return the median of (N,) values, N > 0; numpy's own takes as long as fitting a pose."""
    values_sorted, half = np.sort(values), len(values) // 2
    return float(values_sorted[half] + values_sorted[-1 - half]) / 2
