"""Pairs of board images in, a calibrated rig and its held-out errors out.

1. Start from nothing (start), mend boards named in another order, throw out gross errors (screen).
2. Adjust cameras, relative pose, poses of the board and the board itself jointly. A print is stretched and bowed by a
   tenth of a millimetre, several times what a good corner is off; left out of the adjustment it ends up in the cameras
   (Strobl and Hirzinger, ICCV workshops 2011). A board in the hand before cameras that are not synchronised moves
   between the exposures of a pair; where that shows, every pair has a motion of its own (motion).
3. Choose the distortion model by held-out error, never by the fit (choose).
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from armsight.data import Detections, Record
from armsight.errors import CalibrationError
from armsight.geometry.pose import transform
from armsight.geometry.rigid import fit_rigid
from armsight.vision.bundle import Model, Observations, Solution, State
from armsight.vision.calibrate.choose import Search, Trial, drawn, motion_of, shaped
from armsight.vision.calibrate.heldout import residual_epipolar_rms, rig_of, scaled, unfinished
from armsight.vision.calibrate.result import Calibration, HeldOut, Rejected
from armsight.vision.calibrate.screen import LEAST_CORNERS, MOTION_EASE, Screened, mend_flips, robust_sigma, screen
from armsight.vision.calibrate.start import fits, start_board
from armsight.vision.calibrate.weak import weaknesses
from armsight.vision.markers.board import Board
from armsight.vision.match import join, renamed

#: Distortion models tried, simplest first.
MODELS = ("brown4", "brown5", "brown8", "fisheye")
LEAST_PAIRS = 3
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
    model = drawn(points) if flat else shaped(points)
    judge = _Judge(model, observations, tuple(pair.name for pair in usable), sizes, folds, len(pairs), progress)
    screened, trial, tried = judge.chosen(first.state, models)
    lens = trial.solution.state.cameras[0].model
    if lens != first.state.cameras[0].model and (screened.rejected or screened.notes):
        # What was thrown out under a simple lens may fit the one that was chosen.
        progress(f"looking for gross errors again, under {lens}")
        with contextlib.suppress(CalibrationError):
            chosen = trial.solution.state
            start = replace(first.state, cameras=chosen.cameras, T_left_right=chosen.T_left_right)
            again, trial_again, _ = judge.chosen(start, (lens,))
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
        (*notes, *screened.notes, *unfinished(trial.solution)),
        (),
        None if trial.motion is None else trial.motion.scaled(trial.heldout.normalised_rms),
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
        found: list[Solution] = []
        for family in families:
            found.append(start_board(points, sizes, observations, family))
            if fits(found[-1]):
                break
        return min(found, key=lambda s: s.cost)

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

    def chosen(self, start: State, models: tuple[str, ...]) -> tuple[Screened, Trial, dict[str, HeldOut]]:
        """Throw out gross errors, then return the best model's trial and the held-out errors of all."""
        start = replace(start, shape=np.zeros(len(self.model.modes)))
        screened, motion = self._screened(self.model, start), None
        if (moving := motion_of(self.model, screened, self.observations.shot_count)) is not None:
            # A board that moved between the exposures looks like gross errors to who believes that it stood still.
            self.progress("looking for gross errors again: the board moved between the exposures")
            eased = replace(self.model, motion_sigmas=MOTION_EASE * moving.sigmas)
            screened = self._screened(eased, start, robust_sigma(screened.solution))
            motion = moving.shots(screened.kept)
        folds = min(self.folds, len(screened.kept))
        search = Search(self.model, motion, screened, folds, self.sizes, self.progress)
        return screened, *search.best(models)

    def _screened(self, model: Model, start: State, sigma_px: float = 1.0) -> Screened:
        """Throw out gross errors; too few pairs are no calibration."""
        screened = screen(model, start, self.observations, self.names, sigma_px=sigma_px)
        _enough(len(screened.kept), self.given, list(screened.rejected))
        return screened
