"""Where a body is and how it is turned: maximum likelihood over every detection, with covariance.

The triangulated points give the start (rigid fit); the estimate minimises the covariance-weighted pixel distance of all
detections, those of one camera included. One bad point is found by a robust fit and dropped by name; the covariance
is that of plain least squares on what is left, plus what the rig's own covariance does to all points together. Where the
body fits worse than the pixel noise allows (a print that is not its drawing, a body that moved between the two images)
the noise is what the residuals show (Birge's ratio), and the estimate says by how much.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from armsight.data import Array, Body, Dropped, Missed, Points, PoseEstimate
from armsight.errors import CalibrationError
from armsight.geometry.pose import transform
from armsight.geometry.rigid import fit_rigid
from armsight.vision.bundle import Model, Observations, Solution, State, minimise, predict, whiteners
from armsight.vision.pnp import consensus_poses
from armsight.vision.rig import StereoRig

#: A detection whose whitened squared distance from a robust fit is beyond this share of the chi-square distribution is
#: no detection of the body.
OUTLIER_QUANTILE = 1.0 - 1e-5
#: A shot in which less than this share of the detections agrees with one pose is missed.
_AGREEING = 0.5
#: With this many matched points the rigid fit alone is a safe start; with fewer, every pose that one camera allows is
#: tried too, mirror solutions among them.
_SAFE_POINTS = 8
_COLLINEAR = 1e-3
#: Residuals beyond this quantile of their chi-square distribution are a misfit, not chance.
_MISFIT_QUANTILE = 0.999


def locate(rig: StereoRig, body: Body, points: Points) -> PoseEstimate | Missed:
    """Estimate the pose of a body in one shot.

    Args:
        rig: the calibrated pair.
        body: the body's points, m.
        points: the shot's triangulated points, with the correspondences they came from.

    Returns:
        The pose of the body in the left camera's frame, or why there is none: fewer than three points, points on one
        line, or no pose that most detections agree with.
    """
    reason = _unlocatable(body, points)
    if reason is not None:
        return Missed(reason)
    observations = Observations.from_shots([points.seen])
    model = Model(body.points, np.zeros((0, len(body.points), 3)), 1.0, False)
    free = np.zeros(rig.parameter_count, bool)
    sigma = max(rig.sigma_px, 1e-6)
    best = _best(model, rig, _starts(rig, body, points), observations, sigma, free)
    if best is None:
        return Missed("no pose of the body fits the detections")
    good, best = _without_outliers(model, best, observations, sigma, free)
    if best is None:
        return Missed(f"only {good.sum()} of {len(good)} detections agree with one pose of the body")
    used = observations.select(good)
    dropped = _dropped(body, observations, good, best, points)
    return _estimate(rig, body, points, model, best, used, dropped, good)


def _unlocatable(body: Body, points: Points) -> str | None:
    """Say why a pose cannot be determined, or None."""
    if len(points.ids) < 3:
        lost = f"; dropped: {_listed(points.dropped)}" if points.dropped else ""
        return f"{len(points.ids)} matched points, 3 are needed{lost}"
    chosen = body.points[points.ids]
    spread = np.linalg.svd(chosen - chosen.mean(axis=0), compute_uv=False)
    if spread[1] < _COLLINEAR * spread[0]:
        return "the matched points lie on one line"
    return None


def _listed(dropped: tuple[Dropped, ...]) -> str:
    """Name up to three dropped points."""
    shown = ", ".join(f"{d.point} ({d.reason})" for d in dropped[:3])
    return shown + (f" and {len(dropped) - 3} more" if len(dropped) > 3 else "")


def _starts(rig: StereoRig, body: Body, points: Points) -> list[Array]:
    """Return poses to start from: the rigid fit, and where points are few what each camera alone allows."""
    starts = [fit_rigid(body.points[points.ids], points.p_left)]
    if len(points.ids) < _SAFE_POINTS:
        seen = points.seen
        for side, camera in enumerate(rig.cameras):
            rows = seen.seen[:, side]
            to_left = np.eye(4) if side == 0 else rig.T_left_right
            found = consensus_poses(body.points, camera, seen.ids[rows], seen.uv[rows, side])
            starts += [to_left @ candidate.T_camera_body for candidate in found]
    return starts


def _best(
    model: Model,
    rig: StereoRig,
    starts: list[Array],
    observations: Observations,
    sigma: float,
    free: NDArray[np.bool_],
) -> Solution | None:
    """Minimise robustly from every start and return the lowest; None where no start leads anywhere."""
    best: Solution | None = None
    for start in starts:
        state = State(rig.cameras, rig.T_left_right, start[None], np.zeros(0))
        try:
            solution = minimise(model, state, observations, sigma, free=free)
        except (CalibrationError, np.linalg.LinAlgError):
            continue
        if best is None or solution.cost < best.cost:
            best = solution
    return best


def _without_outliers(
    model: Model, robust: Solution, observations: Observations, sigma: float, free: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], Solution | None]:
    """Drop what the robust fit leaves far off, and fit the rest by plain least squares."""
    good = np.ones(len(observations.shot), bool)
    solution: Solution = robust
    limit = chi2.ppf(OUTLIER_QUANTILE, 2)
    for _ in range(3):
        r = np.einsum("nij,nj->ni", whiteners(observations, sigma), _residuals(model, solution.state, observations))
        d2 = np.einsum("ni,ni->n", r, r)
        now = d2 <= limit * max(1.0, float(np.median(d2)) / chi2.ppf(0.5, 2))
        if now.sum() < max(3, _AGREEING * len(now)) or len(np.unique(observations.point[now])) < 3:
            return now, None
        if (now == good).all() and solution is not robust:
            break
        good = now
        solution = minimise(model, solution.state, observations.select(good), sigma, robust=False, free=free)
    return good, solution


def _residuals(model: Model, state: State, observations: Observations) -> Array:
    """(N, 2) detection minus projection, px."""
    return np.asarray(observations.uv - predict(model, state, observations)[0])


def _dropped(
    body: Body, observations: Observations, good: NDArray[np.bool_], solution: Solution, points: Points
) -> tuple[Dropped, ...]:
    """Name what was thrown away, with its distance."""
    model = Model(body.points, np.zeros((0, len(body.points), 3)), 1.0, False)
    distance = np.linalg.norm(_residuals(model, solution.state, observations), axis=1)
    sides = ("left", "right")
    return points.dropped + tuple(
        Dropped(
            body.point_names[observations.point[i]],
            f"{distance[i]:.1f} px off the body in the {sides[observations.camera[i]]} image",
        )
        for i in np.flatnonzero(~good)
    )


def _estimate(
    rig: StereoRig,
    body: Body,
    points: Points,
    model: Model,
    solution: Solution,
    used: Observations,
    dropped: tuple[Dropped, ...],
    good: NDArray[np.bool_],
) -> PoseEstimate:
    """Assemble the estimate with its covariance: pixel noise, and the rig's calibration through the same fit."""
    W = whiteners(used, solution.sigma_px)
    _, J_rig, J_pose = predict(model, solution.state, used)
    A, B = (W @ J_pose).reshape(-1, 6), (W @ J_rig).reshape(-1, rig.parameter_count)
    residual = (W @ solution.residuals_px[..., None]).ravel()
    freedom = len(residual) - 6
    misfit = float(residual @ residual / freedom) if residual @ residual > chi2.ppf(_MISFIT_QUANTILE, freedom) else 1.0
    noise = np.linalg.inv(A.T @ A) * misfit
    gain = noise / misfit @ (A.T @ B)
    T = solution.state.Ts_left_body[0]
    rows = Observations.from_shots([points.seen])
    bad = np.unique(rows.point[~good])
    kept = ~np.isin(points.ids, bad)
    points = replace(points, **{k: getattr(points, k)[kept] for k in ("ids", "p_left", "cov", "calibration")})
    gap = points.p_left - transform(T, body.points[points.ids])
    return PoseEstimate(
        T,
        noise + gain @ rig.cov @ gain.T,
        noise,
        float(np.sqrt((gap**2).sum(axis=1).mean())) if len(gap) else float("nan"),
        float(np.sqrt((solution.residuals_px**2).sum(axis=1).mean())),
        float(np.sqrt(misfit)),
        points,
        dropped,
    )
