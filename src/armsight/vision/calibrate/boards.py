"""Pairs of board images in, a calibrated rig and its held-out errors out.

1. Start from nothing (start), mend boards named in another order, throw out gross errors (screen).
2. Adjust cameras, relative pose, poses of the board and the board itself jointly. A print is stretched and bowed by a
   tenth of a millimetre, several times what a good corner is off; left out of the adjustment it ends up in the cameras
   (Strobl and Hirzinger, ICCV workshops 2011). How far boards of this print may differ from the drawing, and how noisy
   the corners are, is read off the residuals (empirical Bayes), so a perfect board stays perfect.
3. Choose the distortion model by held-out error, never by the fit.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Detections, Record
from armsight.errors import CalibrationError
from armsight.geometry.pose import transform
from armsight.geometry.rigid import fit_rigid
from armsight.vision.bundle import Model, Observations, Solution, State, minimise
from armsight.vision.calibrate.heldout import cross_validate, residual_epipolar_rms, rig_of, scaled, summary
from armsight.vision.calibrate.result import Calibration, HeldOut, PairErrors, Rejected
from armsight.vision.calibrate.screen import LEAST_CORNERS, Screened, mend_flips, noise_px, screen
from armsight.vision.calibrate.start import start_board
from armsight.vision.calibrate.weak import weaknesses
from armsight.vision.camera import DISTORTION_MODELS, Camera
from armsight.vision.markers.board import Board
from armsight.vision.match import join, renamed
from armsight.vision.rig import StereoRig
from armsight.vision.shape import smooth

#: Distortion models tried, simplest first.
MODELS = ("brown4", "brown5", "brown8", "fisheye")
#: A later model must lower the held-out error by this share to be preferred; a fisheye, which no other program takes for
#: an ordinary lens, by more.
WORTH = {"brown4": 0.0, "brown5": 0.01, "brown8": 0.03, "fisheye": 0.05}
#: Degree of the polynomials in which a printed board may differ from its drawing.
BOARD_DEGREE = 4
#: How far a board is thought to differ from its drawing at first, RMS of one mode, as a share of its diagonal, and the
#: least it may, m.
BOARD_SIGMA_SHARE, BOARD_SIGMA_LEAST_M = 1e-3, 1e-7
LEAST_PAIRS = 3
_NOISE_ROUNDS = 4
FOLDS = 5
Progress = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Pair(Record):
    """One pair of images after detection.

    Attributes:
        name: what the pair is called.
        left: detections in the left image.
        right: detections in the right image.
    """

    name: str
    left: Detections
    right: Detections


def calibrate_boards(
    board: Board,
    pairs: Sequence[Pair],
    sizes: tuple[tuple[int, int], tuple[int, int]],
    *,
    models: tuple[str, ...] = MODELS,
    flat: bool = False,
    folds: int = FOLDS,
    progress: Progress = lambda message: None,
) -> Calibration:
    """Calibrate two cameras from pairs of images of one board.

    Args:
        board: the board's drawing and its symmetries.
        pairs: detections of every pair of images.
        sizes: image size of the left and of the right camera, px.
        models: distortion models to choose from by held-out error.
        flat: hold the board to its drawing.
        folds: how many parts the pairs are split into for the held-out errors.
        progress: called with a line about what is being done.

    Returns:
        The rig, its held-out errors, and what was thrown away.

    Raises:
        CalibrationError: fewer than three usable pairs, or views that do not determine the cameras.
    """
    points = board.body.points
    usable, rejected = _usable(pairs)
    _enough(len(usable), len(pairs), rejected)
    progress("placing cameras and boards")
    first, usable, notes = _start(board, usable, sizes, models)
    observations = Observations.from_shots([join(pair.left, pair.right) for pair in usable])
    progress("looking for gross errors")
    model = _drawn(points) if flat else _shaped(points)
    judge = _Judge(model, observations, tuple(pair.name for pair in usable), sizes, folds, len(pairs), progress)
    screened, trial, tried = judge.chosen(first.state, models)
    lens = trial.solution.state.cameras[0].model
    if lens != first.state.cameras[0].model and (screened.rejected or screened.notes):
        # What was thrown out under a simple lens may fit the one that was chosen.
        progress(f"looking for gross errors again, under {lens}")
        with contextlib.suppress(CalibrationError):
            again, trial_again, _ = judge.chosen(start_board(points, sizes, observations, lens).state, (lens,))
            if len(again.observations.shot) > len(screened.observations.shot):
                screened, trial = again, trial_again
                tried = {**tried, lens: trial.heldout}
    rejected += screened.rejected
    names = tuple(usable[j].name for j in screened.kept)
    rig = scaled(rig_of(trial.solution), trial.heldout)
    state = trial.solution.state
    found = trial.model.body(state.shape)
    found = transform(fit_rigid(found, points), found)
    calibration = Calibration(
        rig,
        replace(board.body, points=found),
        float(np.sqrt(((found - points) ** 2).sum(axis=1).mean())),
        names,
        len(pairs),
        screened.observations,
        trial.solution,
        residual_epipolar_rms(rig, screened.observations),
        trial.heldout,
        trial.errors,
        tried,
        tuple(rejected),
        (*notes, *screened.notes),
        (),
    )
    return replace(calibration, weaknesses=weaknesses(calibration))


def _usable(pairs: Sequence[Pair]) -> tuple[list[Pair], list[Rejected]]:
    """Split the pairs into those that show the board in both images and those that do not, with reasons."""
    usable, rejected = [], []
    for pair in pairs:
        common = np.intersect1d(pair.left.ids, pair.right.ids)
        problems = [f"{side}: {d.problem}" for side, d in (("left", pair.left), ("right", pair.right)) if d.problem]
        if problems:
            rejected.append(Rejected(pair.name, "; ".join(problems)))
        elif len(common) < LEAST_CORNERS:
            rejected.append(
                Rejected(pair.name, f"{len(common)} points seen by both cameras, {LEAST_CORNERS} are needed")
            )
        else:
            usable.append(pair)
    return usable, rejected


def _enough(usable: int, given: int, rejected: list[Rejected]) -> None:
    """Raise unless there are enough pairs, with the first reasons why not."""
    if usable >= LEAST_PAIRS:
        return
    why = "; ".join(f"{r.pair}: {r.reason}" for r in rejected[:2])
    more = f" (and {len(rejected) - 2} more)" if len(rejected) > 2 else ""
    raise CalibrationError(
        f"{usable} of {given} pairs are usable, at least {LEAST_PAIRS} are needed, 15 or more are better"
        + (f": {why}{more}" if why else "")
        + ". Is --board the board in the images (inner corners, columns x rows)?"
    )


def _start(
    board: Board, usable: list[Pair], sizes: tuple[tuple[int, int], tuple[int, int]], models: tuple[str, ...]
) -> tuple[Solution, list[Pair], list[str]]:
    """Start from nothing, under a plain and a fisheye lens where both are allowed, and mend boards named in reverse."""
    families = dict.fromkeys("fisheye" if model == "fisheye" else "brown4" for model in models)
    points = board.body.points

    def attempt(pairs: list[Pair]) -> Solution:
        observations = Observations.from_shots([join(pair.left, pair.right) for pair in pairs])
        return min((start_board(points, sizes, observations, family) for family in families), key=lambda s: s.cost)

    first = attempt(usable)
    observations = Observations.from_shots([join(pair.left, pair.right) for pair in usable])
    mended = mend_flips(points, first.state, observations, board.flips)
    if not mended:
        return first, usable, []
    notes = [f"{usable[j].name}: the right image names the corners in another order; mended" for j in sorted(mended)]
    usable = [
        replace(pair, right=renamed(pair.right, mended[j])) if j in mended else pair for j, pair in enumerate(usable)
    ]
    return attempt(usable), usable, notes


def _drawn(points: Array) -> Model:
    """The board as drawn."""
    return Model(points, np.zeros((0, len(points), 3)), 1.0, True)


def _shaped(points: Array) -> Model:
    """The board as it may have been printed."""
    diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
    return Model(points, smooth(points, BOARD_DEGREE), BOARD_SIGMA_SHARE * diagonal, True)


@dataclass(frozen=True, eq=False)
class _Judge(Record):
    """Screening and the choice of the model, from a start."""

    model: Model
    observations: Observations
    names: tuple[str, ...]
    sizes: tuple[tuple[int, int], tuple[int, int]]
    folds: int
    given: int
    progress: Progress

    def chosen(self, start: State, models: tuple[str, ...]) -> tuple[Screened, _Trial, dict[str, HeldOut]]:
        """Throw out gross errors, then return the best model's trial and the held-out errors of all."""
        start = replace(start, shape=np.zeros(len(self.model.modes)))
        screened = screen(self.model, start, self.observations, self.names)
        _enough(len(screened.kept), self.given, list(screened.rejected))
        search = _Search(
            self.model,
            screened.observations,
            screened.unscreened,
            screened.solution.state,
            min(self.folds, len(screened.kept)),
            self.sizes,
            self.progress,
        )
        return screened, *search.best(models)


@dataclass(frozen=True, eq=False)
class _Trial(Record):
    """One way to model cameras and board, adjusted to all pairs and judged on held-out ones."""

    model: Model
    solution: Solution
    errors: PairErrors
    heldout: HeldOut


@dataclass(frozen=True, eq=False)
class _Search(Record):
    """The choice of the distortion model by held-out error."""

    model: Model
    observations: Observations
    unscreened: Observations
    state: State
    folds: int
    sizes: tuple[tuple[int, int], tuple[int, int]]
    progress: Progress

    def best(self, models: tuple[str, ...]) -> tuple[_Trial, dict[str, HeldOut]]:
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

    def trial(self, distortion: str) -> _Trial | None:
        """Adjust and cross-validate one distortion model; None where its adjustment fails."""
        self.progress(f"judging distortion model {distortion} on held-out pairs")
        try:
            model, solution = self._adjusted(self._converted(distortion))
            errors = cross_validate(
                lambda rows: self._fold(model, solution, rows), model.points, self.unscreened, self.folds
            )
        except (CalibrationError, np.linalg.LinAlgError):
            return None
        return _Trial(model, solution, errors, summary(errors, self.folds))

    def _converted(self, distortion: str) -> State:
        """Return the screened state with cameras of another distortion model."""
        state = self.state
        if state.cameras[0].model == distortion:
            return state
        if "fisheye" in (distortion, state.cameras[0].model):
            start = start_board(self.model.points, self.sizes, self.observations, distortion).state
            return replace(start, shape=state.shape)
        cameras = []
        for camera in state.cameras:
            d = np.zeros(DISTORTION_MODELS[distortion])
            n = min(len(d), camera.distortion.size)
            d[:n] = camera.distortion[:n]
            cameras.append(Camera(camera.image_size_px, distortion, camera.intrinsics, d))
        return replace(state, cameras=(cameras[0], cameras[1]))

    def _adjusted(self, state: State) -> tuple[Model, Solution]:
        """Adjust with the noise that the residuals show and the board's tolerance that its estimate shows."""
        model, sigma, modes = self.model, 0.1, len(self.model.modes)
        for _ in range(_NOISE_ROUNDS):
            solution = minimise(model, state, self.observations, sigma)
            state, variance = solution.state, np.diag(solution.cov_shared)
            freed = float((variance > 0).sum() - modes)
            if modes:
                posterior = variance[-modes:]
                freed += float(modes - posterior.sum() / model.shape_sigma_m**2)
                tolerance = float(np.sqrt(np.mean(state.shape**2 + posterior)))
                model = replace(model, shape_sigma_m=max(tolerance, BOARD_SIGMA_LEAST_M))
            sigma = noise_px(solution, self.observations, freed)
        return model, minimise(model, state, self.observations, sigma)

    def _fold(self, model: Model, full: Solution, rows: NDArray[np.intp]) -> tuple[StereoRig, Array]:
        """Adjust to some of the shots, from the start that all of them gave."""
        state = replace(full.state, Ts_left_body=full.state.Ts_left_body[rows])
        solution = minimise(model, state, self.observations.shots(rows), full.sigma_px)
        return rig_of(solution), model.body(solution.state.shape)
