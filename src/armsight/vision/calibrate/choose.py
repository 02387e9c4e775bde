"""How cameras, board and hand are modelled: the lens by held-out error, the rest read off the residuals.

How noisy corners are, how far boards of this print may differ from the drawing and how far the board moves between the
exposures of a pair are learned together with what they blur (empirical Bayes), so a perfect board stays perfect.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Record
from armsight.errors import CalibrationError
from armsight.vision.bundle import Model, Solution, State, minimise
from armsight.vision.calibrate.heldout import cross_validate, rig_of, summary
from armsight.vision.calibrate.motion import Motion
from armsight.vision.calibrate.result import HeldOut, PairErrors
from armsight.vision.calibrate.screen import Screened, noise_px
from armsight.vision.calibrate.start import imitated, start_board
from armsight.vision.camera import DISTORTION_MODELS, Camera
from armsight.vision.projection import smooth
from armsight.vision.rig import StereoRig

#: A later model must lower the held-out error by this share to be preferred; a fisheye, which no other program takes for
#: an ordinary lens, by more.
WORTH = {"brown4": 0.0, "brown5": 0.01, "brown8": 0.03, "fisheye": 0.05}
#: What only tells a noise or a held-out error does not follow the long valleys of the rational model to their ends.
_ROUGHLY, _STEPS = 1e-6, 25
#: Motion between the exposures must lower the corners' noise by this share to be believed: a fifth less is a sigma that
#: was 1.25 times too large. Synchronised cameras lower it by a hundredth, by chance; what a lens model lacks, by a tenth.
MOTION_WORTH = 0.2
#: Degree of the polynomials in which a printed board may differ from its drawing.
BOARD_DEGREE = 4
#: How far a board is thought to differ from its drawing at first, RMS of one mode, as a share of its diagonal, and the
#: least it may, m.
BOARD_SIGMA_SHARE, BOARD_SIGMA_LEAST_M = 1e-3, 1e-7
#: Rounds in which noise and tolerances settle; motion, which two of them compete to explain, takes longer.
_NOISE_ROUNDS, _MOTION_ROUNDS = 4, 8


def drawn(points: Array) -> Model:
    """Return the model of a board exactly as drawn, points (M, 3), m."""
    return Model(points, np.zeros((0, len(points), 3)), 1.0, True)


def shaped(points: Array) -> Model:
    """Return the model of a board as it may have been printed, points (M, 3) of the drawing, m."""
    diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
    return Model(points, smooth(points, BOARD_DEGREE), BOARD_SIGMA_SHARE * diagonal, True)


def motion_of(model: Model, screened: Screened, count: int) -> Motion | None:
    """Tell whether the board moved between the exposures: each camera agrees with itself better than with the other.

    Args:
        model: the board.
        screened: what is left under the belief that it stood still.
        count: how many pairs there were.

    Returns:
        A motion to begin with for all ``count`` pairs, or None where it is not worth it.
    """
    guess = Motion.guessed(model.points, len(screened.kept))
    still, observations = screened.solution, screened.observations
    before = noise_px(still, observations, _freed(model, still))
    moving = replace(model, motion_sigmas=guess.sigmas)
    solution = minimise(moving, still.state, observations, before)
    motion, taken = guess.updated(solution)
    if noise_px(solution, observations, _freed(model, solution) + taken) > (1 - MOTION_WORTH) * before:
        return None
    return replace(motion, weights=np.ones(count))


def _freed(model: Model, solution: Solution) -> float:
    """Count the shared parameters that the detections determined; a shape that its prior holds counts in part."""
    variance, modes = np.diag(solution.cov_shared), len(model.modes)
    freed = float((variance > 0).sum() - modes)
    return freed + float(modes - variance[len(variance) - modes :].sum() / model.shape_sigma_m**2)


@dataclass(frozen=True, eq=False)
class Trial(Record):
    """One way to model cameras and board, adjusted to all pairs and judged on held-out ones.

    Attributes:
        model: the board, its tolerance and its motion as learned.
        motion: how far the board moved between the exposures; None where it stood still.
        solution: the adjustment to all pairs.
        errors: held-out errors of every pair.
        heldout: their summary.
    """

    model: Model
    motion: Motion | None
    solution: Solution
    errors: PairErrors
    heldout: HeldOut


@dataclass(frozen=True, eq=False)
class Search(Record):
    """The choice of the distortion model by held-out error.

    Attributes:
        model: the board.
        motion: how far the board moves between the exposures, to begin with; None where it stands still.
        screened: the detections to fit, and those to judge on.
        folds: how many parts the pairs are split into.
        sizes: image size of the left and of the right camera, px.
        progress: called with a line about what is being done.
    """

    model: Model
    motion: Motion | None
    screened: Screened
    folds: int
    sizes: tuple[tuple[int, int], tuple[int, int]]
    progress: Callable[[str], None]

    def best(self, models: tuple[str, ...]) -> tuple[Trial, dict[str, HeldOut]]:
        """Return the first model that no later one beats by more than WORTH, and the held-out errors of all."""
        trials = {name: trial for name in models if (trial := self.trial(name)) is not None}
        if not trials:
            raise CalibrationError("no distortion model could be adjusted to the detections")
        reference = next(iter(trials.values())).heldout
        chosen, least = next(iter(trials.values())), np.sqrt(2.0)
        for name, trial in trials.items():
            h = trial.heldout
            score = np.hypot(h.epipolar_rms_px / reference.epipolar_rms_px, h.rigid_rms_m / reference.rigid_rms_m)
            if score < least * (1 - WORTH[name]):
                chosen, least = trial, score
        return chosen, {name: trial.heldout for name, trial in trials.items()}

    def trial(self, distortion: str) -> Trial | None:
        """Adjust and cross-validate one distortion model; None where its adjustment fails."""
        self.progress(f"judging distortion model {distortion} on held-out pairs")
        try:
            model, motion, solution = self._adjusted(self._converted(distortion))
            errors = cross_validate(
                lambda rows: self._fold(model, motion, solution, rows),
                model.points,
                self.screened.unscreened,
                self.folds,
            )
        except (CalibrationError, np.linalg.LinAlgError):
            return None
        return Trial(model, motion, solution, errors, summary(errors, self.folds, motion))

    def _converted(self, distortion: str) -> State:
        """Return the screened state with cameras of another distortion model."""
        state = self.screened.solution.state
        if state.cameras[0].model == distortion:
            return state
        if "fisheye" in (distortion, state.cameras[0].model):
            seen = self.screened.observations
            sides = [seen.uv[seen.camera == side] for side in (0, 1)]
            left, right = (imitated(c, distortion, uv) for c, uv in zip(state.cameras, sides, strict=True))
            if left is not None and right is not None:
                return replace(state, cameras=(left, right))
            return replace(start_board(self.model.points, self.sizes, seen, distortion).state, shape=state.shape)
        cameras = []
        for camera in state.cameras:
            d = np.zeros(DISTORTION_MODELS[distortion])
            n = min(len(d), camera.distortion.size)
            d[:n] = camera.distortion[:n]
            cameras.append(Camera(camera.image_size_px, distortion, camera.intrinsics, d))
        return replace(state, cameras=(cameras[0], cameras[1]))

    def _adjusted(self, state: State) -> tuple[Model, Motion | None, Solution]:
        """Adjust with the noise that the residuals show and the tolerances of board and hand that their estimates show."""
        model, motion, sigma, modes = self.model, self.motion, 0.1, len(self.model.modes)
        observations = self.screened.observations
        for _ in range(_NOISE_ROUNDS if motion is None else _MOTION_ROUNDS):
            if motion is not None:
                model = replace(model, motion_sigmas=motion.sigmas)
            solution = minimise(model, state, observations, sigma, max_steps=_STEPS, least_decrease=_ROUGHLY)
            state, freed = solution.state, _freed(model, solution)
            if modes:
                posterior = np.diag(solution.cov_shared)[-modes:]
                tolerance = float(np.sqrt(np.mean(state.shape**2 + posterior)))
                model = replace(model, shape_sigma_m=max(tolerance, BOARD_SIGMA_LEAST_M))
            if motion is not None:
                motion, taken = motion.updated(solution)
                freed += taken
            sigma = noise_px(solution, observations, freed)
        return model, motion, minimise(model, state, observations, sigma)

    def _fold(
        self, model: Model, motion: Motion | None, full: Solution, rows: NDArray[np.intp]
    ) -> tuple[StereoRig, Array, Motion | None]:
        """Adjust to some of the shots, from the start that all of them gave; their motion is judged by them alone."""
        state = replace(full.state, Ts_left_body=full.state.Ts_left_body[rows])
        if motion is not None:
            motion = motion.shots(rows)
            model, state = replace(model, motion_sigmas=motion.sigmas), replace(state, motions=state.motions[rows])
        seen = self.screened.observations.shots(rows)
        solution = minimise(model, state, seen, full.sigma_px, max_steps=_STEPS, least_decrease=_ROUGHLY)
        if motion is not None:
            motion = motion.updated(solution)[0]
        return rig_of(solution), model.body(solution.state.shape), motion
