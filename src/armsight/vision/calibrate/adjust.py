"""Adjust with noise and tolerances that are learned from the residuals, and put a calibration together.

In: a model of the body, a start, detections. Out: the adjustment under the noise of the detections, the body's tolerance
and its motion between the exposures that it shows itself (empirical Bayes); with held-out errors, a Calibration.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from armsight.data import Body
from armsight.geometry.pose import transform
from armsight.geometry.rigid import fit_rigid
from armsight.vision.calibrate.heldout import residual_epipolar_rms, rig_of, scaled, unfinished
from armsight.vision.calibrate.motion import ExposureMotion
from armsight.vision.calibrate.result import Calibration, HeldOutErrors, PairErrors, RejectedPair
from armsight.vision.calibrate.screen import noise_px
from armsight.vision.calibrate.weak import weaknesses
from armsight.vision.pose.bundle import DAMPING, NEAR, BundleModel, BundleSolution, BundleState, Observations, minimise
from armsight.vision.pose.projection import of_middles

#: Convergence and steps of adjustments that only estimate noise or a held-out error: the long valleys of the rational
#: model are not followed to their ends.
ROUGHLY, STEPS = 1e-6, 25
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
            posterior = np.diag(solution.cov_shared)[-modes:]
            tolerance = float(np.sqrt(np.mean(state.shape**2 + posterior)))
            model = replace(model, shape_sigma_m=max(tolerance, LEAST_TOLERANCE_M))
        if motion is not None:
            motion, taken = motion.updated(solution)
            free += taken
        sigma_px = noise_px(solution, observations, free)
    return model, motion, minimise(model, state, observations, sigma_px, damping=NEAR)


def concluded(
    body: Body,
    model: BundleModel,
    solution: BundleSolution,
    observations: Observations,
    *,
    errors: PairErrors,
    heldout: HeldOutErrors,
    models: dict[str, HeldOutErrors],
    pairs: tuple[str, ...],
    pairs_found: int,
    rejected: tuple[RejectedPair, ...],
    notes: tuple[str, ...],
    motion: ExposureMotion | None = None,
    disc_radius_m: float | None = None,
) -> Calibration:
    """Put a calibration together from the drawing of a body, its model, and the adjustment; the rest as in Calibration."""
    rig, state = scaled(rig_of(solution), heldout), solution.state
    found = model.body(state.shape)[: len(body.points)]
    found = transform(fit_rigid(found, body.points), found)
    calibration = Calibration(
        rig,
        replace(body, points=found),
        float(np.sqrt(((found - body.points) ** 2).sum(axis=1).mean())),
        pairs,
        pairs_found,
        observations,
        solution,
        residual_epipolar_rms(rig, of_middles(model, state, observations)),
        heldout,
        errors,
        models,
        rejected,
        (*notes, *unfinished(solution)),
        (),
        motion,
        disc_radius_m,
    )
    return replace(calibration, weaknesses=weaknesses(calibration))
