"""Errors on pairs that a rig was not fitted on: the only metrics that show whether its millimetres are right.

K folds of pairs; each fold is measured with a rig fitted on the others, by the same functions that measure later.

Then the adjustment itself: under the noise of the detections, the body's tolerance and its motion between the exposures
that it shows itself (empirical Bayes); with the held-out errors it becomes a Calibration.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Body, Correspondences, PoseEstimate, Record
from armsight.errors import CalibrationError, InputError
from armsight.geometry.pose import inverse, transform
from armsight.geometry.rigid import fit_rigid, fit_scale
from armsight.geometry.rotation import skew
from armsight.vision.calibrate import MODELS
from armsight.vision.calibrate.motion import ExposureMotion, change_of, of_shots, spread_of
from armsight.vision.calibrate.result import LEAST_SIGMA_PX, Calibration, HeldOutErrors, PairErrors, RejectedPair
from armsight.vision.calibrate.screen import noise_px
from armsight.vision.calibrate.weak import weaknesses
from armsight.vision.camera import DISTORTION_MODELS
from armsight.vision.discs.bias import disc_bias
from armsight.vision.match import epipolar_distances
from armsight.vision.pose.bundle import DAMPING, NEAR, BundleModel, BundleSolution, BundleState, Observations, minimise
from armsight.vision.pose.locate import locate
from armsight.vision.pose.projection import of_middles
from armsight.vision.rig import StereoRig
from armsight.vision.triangulate import optimal_points, triangulate

#: The perspective bias depends on the pose and the pose on the bias: it shrinks a hundredfold each round.
_BIAS_ROUNDS = 4
#: A point this many times as far from the rigid fit as the usual one is an outlier, which a measurement drops by name.
OUTLIER_RATIO = 10.0


def correspondences(observations: Observations, shot: int) -> Correspondences:
    """Return one shot of flattened observations as correspondences."""
    rows = observations.shot == shot
    ids = np.unique(observations.point[rows])
    uv, cov = np.full((len(ids), 2, 2), np.nan), np.zeros((len(ids), 2, 2, 2))
    at = np.searchsorted(ids, observations.point[rows])
    uv[at, observations.camera[rows]] = observations.uv[rows]
    cov[at, observations.camera[rows]] = observations.cov_uv[rows]
    return Correspondences(ids, uv, cov)


def pair_errors(
    rig: StereoRig,
    drawing: Array,
    observations: Observations,
    *,
    estimated: Array | None = None,
    motion: ExposureMotion | None = None,
    disc_radius_m: float = 0.0,
) -> PairErrors:
    """Measure every pair of ``observations`` with a rig and compare with the perfect body, ``drawing`` (M, 3), m.

    The uncertainty is evaluated against ``estimated`` (M, 3), the body as the calibration found it: the deviation of a
    print from its drawing is not an error of the cameras. ``motion``: expected between the two exposures. One row for
    each shot that has three or more matched points.
    """
    rows, found = [], drawing if estimated is None else estimated
    for shot in range(observations.shot_count):
        seen = correspondences(observations, shot)
        seen = Correspondences(seen.ids[seen.paired], seen.uv[seen.paired], seen.cov_uv[seen.paired])
        if disc_radius_m > 0:
            seen = middles(rig, found, seen, disc_radius_m)
        cov = seen.cov_uv + max(rig.sigma_px, LEAST_SIGMA_PX) ** 2 * np.eye(2)
        p, cov_p, by_rig = optimal_points(rig, seen.uv, cov)
        good = np.flatnonzero(np.isfinite(p).all(axis=1))
        if len(good) >= 3:
            good = good[_without_outliers(found[seen.ids[good]], p[good])]
        if len(good) < 3:
            continue
        board, body = drawing[seen.ids[good]], found[seen.ids[good]]
        p, cov_p, by_rig = p[good], cov_p[good], by_rig[good]
        gap = p - transform(fit_rigid(board, p), board)
        epipolar = epipolar_distances(rig, seen.uv[good, 0], seen.uv[good, 1])
        T_found, cov_rig = fit_rigid(body, p), np.array(rig.cov)
        if motion is not None:
            # A motion between the exposures has the effect of another position of the right camera for this one pair.
            cov_rig[-6:, -6:] += motion.seen_from(inverse(rig.T_left_right) @ T_found, found.mean(axis=0))
        row = (
            float(shot),
            float(np.sqrt((epipolar**2).mean())),
            float(np.sqrt((gap**2).sum(axis=1).mean())),
            *(fit_scale(board, p), float(len(good))),
            *_normalised(transform(T_found, body), p, cov_p, by_rig, cov_rig),
        )
        rows.append(row)
    return PairErrors(*np.array(rows, dtype=np.float64).reshape(-1, 1 + len(_FIELDS)).T)


def middles(rig: StereoRig, body: Array, seen: Correspondences, disc_radius_m: float) -> Correspondences:
    """Convert centres of the ellipses of a board's discs to images of their middles, at the pose that both cameras show.

    ``body``: (M, 3) the discs' middles, m; ``seen``: correspondences that both cameras have; ``disc_radius_m``: radius of
    the discs, m.
    """
    centres = seen
    for _ in range(_BIAS_ROUNDS):
        p, _, _ = optimal_points(rig, centres.uv, centres.cov_uv + max(rig.sigma_px, LEAST_SIGMA_PX) ** 2 * np.eye(2))
        good = np.isfinite(p).all(axis=1)
        if good.sum() < 3:
            break
        T, points = fit_rigid(body[seen.ids[good]], p[good]), body[seen.ids]
        Ts = (T, inverse(rig.T_left_right) @ T)
        bias = [disc_bias(camera, T, points, disc_radius_m) for camera, T in zip(rig.cameras, Ts, strict=True)]
        centres = replace(seen, uv=seen.uv - np.stack(bias, axis=1))
    return centres


def _without_outliers(body: Array, p: Array) -> NDArray[np.bool_]:
    """(N,) which points a measurement would keep: all but those far off what most agree on."""
    good = np.ones(len(p), bool)
    for _ in range(3):
        T = fit_rigid(body[good], p[good])
        gap = np.linalg.norm(p - transform(T, body), axis=1)
        now = gap <= OUTLIER_RATIO * np.median(gap)
        if now.sum() < 3 or (now == good).all():
            break
        good = now
    return good


def _normalised(fitted: Array, p: Array, cov: Array, by_rig: Array, cov_rig: Array) -> tuple[float, float]:
    """RMS of a rigid fit's residuals (N, 3) over their predicted sigma, less the fit: with the calibration, without it.

    The fit takes the residuals' part along six directions Q: what is left of a covariance C is (I - QQ') C (I - QQ').
    Only its diagonal is needed.
    """
    n, gap = len(p), (p - fitted).ravel()
    A = np.concatenate([np.tile(np.eye(3), (n, 1, 1)), -skew(fitted - fitted.mean(axis=0))], axis=2).reshape(3 * n, 6)
    Q = _range(A)
    noisy = (cov @ Q.reshape(n, 3, -1)).reshape(3 * n, -1)  # of each point by itself
    noise = np.einsum("nii->ni", cov).ravel() - 2 * (noisy * Q).sum(axis=1) + ((Q @ (Q.T @ noisy)) * Q).sum(axis=1)
    G = by_rig.reshape(3 * n, -1)
    G = G - Q @ (Q.T @ G)
    variance = noise + ((G @ cov_rig) * G).sum(axis=1)
    return float(np.sqrt((gap**2 / variance).mean())), float(np.sqrt((gap**2 / noise).mean()))


def _range(A: Array) -> Array:
    """Return orthonormal columns that span those of A (M, 6): fewer than six where points lie on a line."""
    U, sizes, _ = np.linalg.svd(A, full_matrices=False)
    return np.asarray(U[:, sizes > 1e-15 * sizes[0]])


def require_choice(folds: int, models: tuple[str, ...] = MODELS) -> None:
    """Raise an InputError unless there are parts to hold out, and distortion models to choose from."""
    if folds < 2:
        raise InputError(f"folds is {folds}: expected 2 or more, as each part is held out of a fit to the others")
    if not models or any(model not in DISTORTION_MODELS for model in models):
        raise InputError(f"models is {models!r}: expected some of {MODELS}")


def cross_validate(
    fit: Callable[[NDArray[np.intp]], tuple[StereoRig, Array, ExposureMotion | None]],
    drawing: Array,
    observations: Observations,
    folds: int,
    disc_radius_m: float = 0.0,
) -> PairErrors:
    """Fit on all folds but one and measure that one, for every fold.

    ``fit``: rows of the shots to use -> the rig they give, the body as they show it (M, 3), m, and how far it moved between
    the exposures; ``drawing``: (M, 3) points of the perfect body, m; ``observations``: all detections, bad ones included: a
    measurement meets them too; ``folds``: number of folds, at most the number of shots; ``disc_radius_m``: as in
    :func:`pair_errors`. Returns the held-out errors of every shot.
    """
    parts = []
    for first in range(folds):
        held = np.arange(first, observations.shot_count, folds)
        rig, estimated, motion = fit(np.setdiff1d(np.arange(observations.shot_count), held))
        errors = pair_errors(
            rig, drawing, observations.shots(held), estimated=estimated, motion=motion, disc_radius_m=disc_radius_m
        )
        fields = [getattr(errors, name) for name in _FIELDS]
        parts.append(np.stack([held[errors.pair.astype(int)].astype(float), *fields]))
    merged = np.concatenate(parts, axis=1)
    return PairErrors(*merged[:, np.argsort(merged[0])])


_FIELDS = ("epipolar_px", "rigid_m", "scale", "weight", "normalised", "over_noise")


def summary(errors: PairErrors, folds: int, motion: ExposureMotion | None = None) -> HeldOutErrors:
    """Reduce errors per pair that was left out to RMS over all points; the scale error is the mean over pairs."""
    if not len(errors.pair):
        raise CalibrationError(
            "no left-out shot has three points on which the cameras agree, so the rig cannot be evaluated: do the left and "
            "the right images belong together, one by one in this order, and were they taken at one moment? Does a driver "
            "mirror the images of one camera?"
        )
    w = errors.weight / errors.weight.sum()
    rms = {name: float(np.sqrt(w @ getattr(errors, name) ** 2)) for name in _FIELDS}
    return HeldOutErrors(
        folds,
        *(rms["epipolar_px"], rms["rigid_m"], float(errors.scale.mean() - 1), rms["normalised"], rms["over_noise"]),
        *((0.0, 0.0) if motion is None else motion.rms.tolist()),
    )


def residual_epipolar_rms(rig: StereoRig, observations: Observations) -> float:
    """RMS epipolar distance, px, of all matched detections."""
    squares = []
    for shot in range(observations.shot_count):
        seen = correspondences(observations, shot)
        uv = seen.uv[seen.paired]
        squares.append(epipolar_distances(rig, uv[:, 0], uv[:, 1]).ravel() ** 2)
    return float(np.sqrt(np.concatenate(squares).mean()))


def unfinished(solution: BundleSolution) -> tuple[str, ...]:
    """Note that an adjustment ran out of steps, if it did."""
    if solution.converged:
        return ()
    return (
        f"the adjustment stopped at its last step, {solution.steps}, while still improving: the detections hardly "
        "determine some parameter; take more pairs, or of images fix --lens-model",
    )


def rig_of(solution: BundleSolution) -> StereoRig:
    """Return the rig of an adjusted state: its covariance is that of cameras and relative pose, the shape averaged over.

    CalibrationError: the detections leave one of the rig's parameters undetermined.
    """
    left, right = solution.state.cameras
    count = left.parameters.size + right.parameters.size + 6
    cov = solution.cov_shared[:count, :count]
    rig = StereoRig(left, right, solution.state.T_left_right, np.zeros((count, count)), solution.sigma_px)
    bad = ~(np.diag(cov) >= 0)
    if bad.any():
        name = rig.parameter_names[int(np.argmax(bad))]
        raise CalibrationError(
            f"the detections do not determine {name}: take more pairs, the board or body tilted and at other distances"
        )
    return replace(rig, cov=(cov + cov.T) / 2)


def scaled(rig: StereoRig, heldout: HeldOutErrors) -> StereoRig:
    """Scale a rig's uncertainty by what the held-out pairs show; CalibrationError if they do not determine the noise.

    Up where residuals are not white, down where both cameras err alike and their points agree the better for it. Where
    boards moved between the exposures, the rig's ``sigma_px`` includes that motion as if it were noise of the
    detections: a measurement does not know whether a body moves before the cameras.
    """
    factor = heldout.normalised_rms
    if not (np.isfinite(factor) and factor > 0):
        raise CalibrationError("the left-out shots do not determine the noise of the detections: take more pairs")
    noise = factor if heldout.motion_rms_m == 0 else heldout.over_noise_rms
    return replace(rig, cov=rig.cov * factor**2, sigma_px=rig.sigma_px * noise)


#: Convergence and steps of adjustments that only estimate noise or a held-out error: the long valleys of the rational
#: model are not followed to their ends.
ROUGHLY, STEPS = 1e-5, 25
#: Least standard deviation of a body from its drawing, RMS of one mode, m.
LEAST_TOLERANCE_M = 1e-7
#: Rounds in which noise and tolerances settle; motion, which competes with them, takes longer.
_NOISE_ROUNDS, _MOTION_ROUNDS = 4, 8


def freed(model: BundleModel, solution: BundleSolution) -> float:
    """Count the shared parameters that the detections determined; a shape that its prior holds counts in part."""
    variance, modes = np.diag(solution.cov_shared), len(model.modes)
    free = float((variance > 0).sum() - modes)
    return free + float(modes - variance[len(variance) - modes :].sum() / model.shape_sigma_m**2)


def adjusted(
    model: BundleModel,
    state: BundleState,
    observations: Observations,
    sigma_px: float,
    motion: ExposureMotion | None = None,
) -> tuple[BundleModel, ExposureMotion | None, BundleSolution]:
    """Adjust with the noise of the residuals and the estimated tolerances of the body and of its motion.

    ``sigma_px`` and the tolerances of ``model`` and ``motion`` are those to begin with.
    """
    modes, damping = len(model.modes), DAMPING
    for _ in range(_NOISE_ROUNDS if motion is None else _MOTION_ROUNDS):
        if motion is not None:
            model = replace(model, motion_sigmas=motion.sigmas)
        solution = minimise(
            model, state, observations, sigma_px, max_steps=STEPS, least_decrease=ROUGHLY, damping=damping
        )
        damping, state, free = NEAR, solution.state, freed(model, solution)
        if modes:
            tolerance = float(np.sqrt(np.mean(state.shape**2 + np.diag(solution.cov_shared)[-modes:])))
            model = replace(model, shape_sigma_m=max(tolerance, LEAST_TOLERANCE_M))
        if motion is not None:
            motion, taken = motion.updated(solution)
            free += taken
        sigma_px = noise_px(solution, observations, free)
    return model, motion, minimise(model, state, observations, sigma_px, damping=NEAR)


@dataclass(frozen=True, eq=False)
class Trial(Record):
    """One way to model cameras and board, adjusted to all pairs, with its held-out ``errors`` and their summary.

    ``model`` has its tolerance and its motion as learned; ``motion`` is None where the board stood still.
    """

    model: BundleModel
    motion: ExposureMotion | None
    solution: BundleSolution
    errors: PairErrors
    heldout: HeldOutErrors


def concluded(
    body: Body,
    trial: Trial,
    observations: Observations,
    *,
    models: dict[str, HeldOutErrors],
    pairs: tuple[str, ...],
    pairs_found: int,
    rejected: tuple[RejectedPair, ...],
    notes: tuple[str, ...],
    disc_radius_m: float | None = None,
    moving: bool = False,
) -> Calibration:
    """Put a calibration together from the drawing of a body and the adjustment; the rest as in Calibration."""
    model, solution, heldout = trial.model, trial.solution, trial.heldout
    rig, state = scaled(rig_of(solution), heldout), solution.state
    each = of_shots(model, solution, observations)
    change = None if moving else change_of(model, solution, each, rig, len(pairs))
    if change is not None:  # the rig holds for a state between the two
        rig = replace(rig, cov=rig.cov + change.off.T @ change.off)
    larger = 1.0
    if change is None and not moving and (added := spread_of(model, solution, each, len(rig.cov))) is not None:
        larger = float(np.sqrt(1 + (np.diag(added) / np.maximum(np.diag(rig.cov), 1e-300)).max()))
        rig = replace(rig, cov=rig.cov + added)
    found = model.body(state.shape)[: len(body.points)]
    found = transform(fit_rigid(found, body.points), found)
    deviation_m = float(np.sqrt(((found - body.points) ** 2).sum(axis=1).mean()))
    epipolar_px = residual_epipolar_rms(rig, of_middles(model, state, observations))
    notes = (*notes, *unfinished(solution))
    motion = None if trial.motion is None else trial.motion.scaled(heldout.normalised_rms)
    drawn, by_pair = replace(body, points=found), (trial.errors, models, rejected, notes, (), motion, disc_radius_m)
    seen = (deviation_m, pairs, pairs_found, observations, solution, epipolar_px, heldout)
    return assessed(Calibration(rig, drawn, *seen, *by_pair, change=change, spread=larger))


def assessed(calibration: Calibration) -> Calibration:
    """Return a calibration with its weaknesses."""
    return replace(calibration, weaknesses=(*weaknesses(calibration), *_misfits(calibration)))


def _misfits(calibration: Calibration) -> list[str]:
    """Return a weakness where most pairs, measured with the rig, fit the board as found worse than their noise allows."""
    rig, body, found = calibration.rig, calibration.body, list[float]()
    for shot in range(len(calibration.pairs)):
        seen = correspondences(calibration.observations, shot)
        if calibration.disc_radius_m:
            seen = middles(rig, body.points, seen, calibration.disc_radius_m)
        if isinstance(pose := locate(rig, body, triangulate(rig, body, seen)), PoseEstimate):
            found.append(pose.misfit)
    if not found or (usual := float(np.median(found))) <= 1.0:
        return []
    return [
        f"most pairs fit the {body.name} as it was found worse than the noise of its points allows (a misfit of "
        f"{usual:.1f} is usual; armsight measure says it too, and enlarges its sigmas): images that are not sharp, a "
        "board that bends between pairs, or lenses that the model cannot express (of images: --lens-model)"
    ]
