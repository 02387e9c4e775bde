"""Pairs of board images in, a calibrated rig and its held-out errors out.

1. Correct boards named in another order, start from nothing (``start.py``), reject gross errors (``screen.py``).
2. Adjust cameras, relative pose, poses of the board and the board itself jointly. A print is distorted and bowed by a
   tenth of a millimetre; if it is not estimated, it biases the cameras (Strobl and Hirzinger, ICCV workshops 2011). A
   board in the hand before cameras that are not synchronised moves between the exposures of a pair; where that is
   significant, every pair has a motion of its own (``motion.py``).
3. Choose the distortion model by held-out error, never by the fit (:class:`LensModelSearch`).

The noise of the corners, the tolerance of the print and the motion between the exposures are estimated together with
what they blur (empirical Bayes), so a perfect board stays perfect.
"""

from __future__ import annotations

import contextlib
import itertools
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Body, Detections, Ids, Missed, Record
from armsight.errors import CalibrationError
from armsight.geometry.pose import inverse
from armsight.vision.calibrate import FOLDS, MODELS, heldout
from armsight.vision.calibrate.motion import ExposureMotion, other_size
from armsight.vision.calibrate.result import BOARD_DEGREE, Calibration, HeldOutErrors, RejectedPair
from armsight.vision.calibrate.screen import LEAST_CORNERS, MOTION_EASE, Screened, noise_px, robust_sigma, screen
from armsight.vision.calibrate.start import agreed_symmetries, fits, imitated, residual_rms_px, start_board
from armsight.vision.camera import DISTORTION_MODELS, Camera
from armsight.vision.markers.circles import unseen_row
from armsight.vision.markers.marker import CalibrationBoard
from armsight.vision.match import join, renamed
from armsight.vision.pose.bundle import NEAR, BundleModel, BundleSolution, BundleState, Observations, minimise, promised
from armsight.vision.pose.measure import seen_radius
from armsight.vision.pose.pnp import body_poses
from armsight.vision.pose.projection import smooth
from armsight.vision.pose.shutter import TimedShot, aligned, at_one_time, estimate_shutters
from armsight.vision.rig import Shutters, StereoRig

#: A later model must lower the held-out error by this share to be preferred; a fisheye, which other programs do not
#: use for an ordinary lens, by more.
WORTH = {"brown4": 0.0, "brown5": 0.01, "brown8": 0.03, "fisheye": 0.05}
#: Motion between the exposures must lower the corners' noise by this share to be accepted: a fifth less is a sigma that
#: was 1.25 times too large. Synchronised cameras lower it by a hundredth, by chance; what a lens model lacks, by a
#: tenth.
MOTION_WORTH = 0.2
#: Prior standard deviation of a board from its drawing at first, RMS of one mode, as a share of its diagonal.
BOARD_SIGMA_SHARE = 1e-3
_START_PX = 0.1  # sigma of a detection before its residuals show it; half, double: a round more
#: A start that leaves more than this, px RMS, is no minimum to draw conclusions from: names of a symmetric board may
#: contradict each other, the lens may be another.
_MISNAMED_PX = 2.0
_RADIUS_ROUNDS = 2  # of the discs' radius and the poses; half: 5e-4 off, double: the same
#: Cameras that are less than so many sigmas apart, or than this share of the boards' distance, are one camera.
_BASELINE_SIGMAS, _BASELINE_SHARE = 5.0, 1e-3
#: Rounds of skew and cameras, alternately; the skew has settled where it changes by less than this share of its sigma.
#: In the first rounds only the relative pose of the cameras is adjusted.
_SKEW_ROUNDS, _SETTLED, _POSE_ROUNDS = 40, 0.03, 2
#: Least sigma of a detection meanwhile, px: with a smaller one the robust loss would give up on shots that move far. What
#: the detections scatter by is measured.
_SKEW_PX = 0.3
#: Largest sigma of a skew that counts as found, as a share of the time between shots (without an estimate it is 0.29), and
#: the sigmas beyond which there is one.
_SKEW_UNSURE, _SKEW_SIGMAS = 0.1, 3.0
#: Beyond this share of the time between shots the left frame is paired with the right camera's one before or behind.
_REPAIR = 0.6
#: Most pairs of a recording that are adjusted, spread over it, and most shots in a row that the skew is found from.
_PAIRS_MOST, _SKEW_SHOTS = 100, 300


def rigid_board(points: Array) -> BundleModel:
    """Return the model of a board without tolerance, points (M, 3) of the drawing, m."""
    return BundleModel(points, np.zeros((0, len(points), 3)), 1.0, True)


def printed_board(points: Array) -> BundleModel:
    """Return the model of a board with the tolerance of a print, points (M, 3) of the drawing, m."""
    diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
    return BundleModel(points, smooth(points, BOARD_DEGREE), BOARD_SIGMA_SHARE * diagonal, True)


def with_second_print(
    model: BundleModel, observations: Observations, pair_count: int
) -> tuple[BundleModel, Observations]:
    """Let the images of one camera alone show another print of the drawing than the pairs do: points of both, one body.

    A sheet on a desk and the plate that the arm carries bow differently; one shape for both would bend the cameras. The
    detections of one camera alone come last, after those of ``pair_count`` shots.
    """
    none = np.zeros_like(model.modes)
    modes = np.block([[[model.modes], [none]], [[none], [model.modes]]])
    point = observations.point + len(model.points) * (observations.shot >= pair_count)
    both = replace(model, points=np.vstack([model.points, model.points]), modes=modes)
    return both, replace(observations, point=point)


def motion_of(model: BundleModel, screened: Screened, count: int) -> tuple[ExposureMotion, dict[int, str]] | None:
    """Test whether the board moved between the exposures: each camera agrees with itself better than with the other.

    Return a first motion for all ``count`` pairs before screening, and the pair that moved furthest, with the reason to
    reject it should it be the only one; None where no motion is significant.
    """
    guess = ExposureMotion.guessed(model.points, len(screened.kept))
    still, observations = screened.solution, screened.observations
    before = noise_px(still, observations, heldout.freed(model, still))
    moving = replace(model, motion_sigmas=guess.sigmas)
    solution = minimise(moving, still.state, observations, before, least_decrease=heldout.ROUGHLY)
    motion, taken = guess.updated(solution)
    if noise_px(solution, observations, heldout.freed(model, solution) + taken) > (1 - MOTION_WORTH) * before:
        return None
    furthest = int(np.argmin(motion.weights))
    way = solution.state.motions[furthest]
    why = (
        f"the images show the board {1e3 * np.linalg.norm(way[:3]):.2f} mm and {np.degrees(np.linalg.norm(way[3:])):.2f} "
        "degrees apart, as in no other pair: wrong corners, or a board that moved between the two images"
    )
    return replace(motion, weights=np.ones(count)), {int(screened.kept[furthest]): why}


def _padded(cameras: tuple[Camera, Camera], distortion: str) -> tuple[Camera, Camera]:
    """Return cameras with another number of distortion coefficients, those that are new zero."""
    count = DISTORTION_MODELS[distortion]
    left, right = (
        Camera(c.image_size_px, distortion, c.intrinsics, np.append(c.distortion, np.zeros(count))[:count])
        for c in cameras
    )
    return left, right


def _may_gain(model: BundleModel, solution: BundleSolution, observations: Observations, distortion: str) -> bool:
    """Return whether another lens may lower the error of an adjustment by its WORTH.

    A larger model lowers held-out errors by less than the fit's, and that by about what its first step promises. What a
    fisheye lens does otherwise than a plain one, the largest plain one would take up in part.
    """
    if solution.state.cameras[0].model == "fisheye":
        return True
    wider = _padded(solution.state.cameras, "brown8" if distortion == "fisheye" else distortion)
    share = promised(model, replace(solution.state, cameras=wider), observations, solution.sigma_px)
    return not share < 1 - (1 - WORTH[distortion]) ** 2  # of squares; NaN may


Progress = Callable[[str], None]
#: Calls a function with arguments in another process, and returns what it returns.
Second = Callable[..., Any]


def _silent(message: str) -> None:
    """Take a line of progress and show it nowhere."""


@dataclass(frozen=True, eq=False)
class LensModelSearch(Record):
    """The choice of the distortion model by held-out error."""

    model: BundleModel  #: the board
    motion: ExposureMotion | None  #: first motion of the board between the exposures; None where it stands still
    screened: Screened  #: the detections to fit, and those to evaluate on
    folds: int  #: how many parts the pairs are split into
    sizes: tuple[tuple[int, int], tuple[int, int]]  #: image size of the left and of the right camera, px
    progress: Callable[[str], None]  #: called with a line about what is being done

    def best(
        self, models: tuple[str, ...], second: Second | None = None
    ) -> tuple[heldout.Trial, dict[str, HeldOutErrors]]:
        """Return the first model that no later one beats by more than WORTH, and the held-out errors of those tried.

        After the first, only those that may be worth it are tried.
        """
        self.progress(f"evaluating distortion model {models[0]} on held-out pairs")
        first = self.trial(models[0])
        seen = self.screened.observations
        later = tuple(m for m in models[1:] if first is None or _may_gain(first.model, first.solution, seen, m))
        found = {models[0]: first, **self._trials(later, second)}
        trials = {name: trial for name in models if (trial := found.get(name)) is not None}
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

    def _trials(self, models: tuple[str, ...], second: Second | None) -> dict[str, heldout.Trial | None]:
        """Return the trial of each model; a second process takes the next one as soon as it is free, as this one does."""
        waiting, found = deque(models), dict[str, heldout.Trial | None]()

        def take(trial: Callable[[str], heldout.Trial | None]) -> None:
            while True:
                try:
                    name = waiting.popleft()
                except IndexError:  # none is left
                    return
                self.progress(f"evaluating distortion model {name} on held-out pairs")
                found[name] = trial(name)

        if second is None or len(models) < 2:
            take(self.trial)
            return found
        quiet = replace(self, progress=_silent)
        with ThreadPoolExecutor(1) as beside:
            others = beside.submit(take, lambda name: second(LensModelSearch.trial, quiet, name))
            try:
                take(self.trial)
            finally:
                waiting.clear()
            others.result()
        return found

    def trial(self, distortion: str) -> heldout.Trial | None:
        """Adjust and cross-validate one distortion model; None where its adjustment fails."""
        try:
            model, motion, solution = heldout.adjusted(
                self.model, self._converted(distortion), self.screened.observations, _START_PX, self.motion
            )
            errors = heldout.cross_validate(
                lambda rows: self._fold(model, motion, solution, rows),
                model.points,
                self.screened.unscreened,
                self.folds,
                model.disc_radius_m,
            )
        except (CalibrationError, np.linalg.LinAlgError):
            return None
        return heldout.Trial(model, motion, solution, errors, heldout.summary(errors, self.folds, motion))

    def _converted(self, distortion: str) -> BundleState:
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
        return replace(state, cameras=_padded(state.cameras, distortion))

    def _fold(
        self, model: BundleModel, motion: ExposureMotion | None, full: BundleSolution, rows: NDArray[np.intp]
    ) -> tuple[StereoRig, Array, ExposureMotion | None]:
        """Adjust to some of the shots, from the start that all of them gave; their motion is estimated from them alone."""
        state = replace(full.state, Ts_left_body=full.state.Ts_left_body[rows])
        if motion is not None:
            motion = motion.shots(rows)
            model, state = replace(model, motion_sigmas=motion.sigmas), replace(state, motions=state.motions[rows])
        seen = self.screened.observations.shots(rows)
        solution = minimise(
            model, state, seen, full.sigma_px, max_steps=heldout.STEPS, least_decrease=heldout.ROUGHLY, damping=NEAR
        )
        if motion is not None:
            motion = motion.updated(solution)[0]
        return heldout.rig_of(solution), model.body(solution.state.shape), motion


LEAST_PAIRS = 3


@dataclass(frozen=True, eq=False)
class Pair(Record):
    """One pair of images after detection."""

    name: str  #: what the pair is called
    left: Detections  #: detections in the left image
    right: Detections  #: detections in the right image


def calibrate_boards(
    board: CalibrationBoard,
    pairs: Sequence[Pair],
    sizes: tuple[tuple[int, int], tuple[int, int]],
    *,
    models: tuple[str, ...] = MODELS,
    flat: bool = False,
    folds: int = FOLDS,
    singles: Sequence[Pair] = (),
    moving: bool = False,
    progress: Progress = _silent,
    second: Second | None = None,
) -> Calibration:
    """Calibrate two cameras from pairs of images of one board.

    Args:
        board: the board's drawing and its symmetries.
        pairs: detections of every pair of images.
        sizes: image size of the left and of the right camera, px.
        models: distortion models to choose from by held-out error.
        flat: hold the board to its drawing.
        folds: how many parts the pairs are split into for the held-out errors.
        singles: detections of further images by one camera alone, the other side empty and with a reason: they help to
            determine what is inside the camera. Their board has the same drawing, and may be another print.
        moving: the board moves on from pair to pair, so that errors of neighbours are alike: whether the cameras changed
            meanwhile cannot be tested.
        progress: called with a line about what is being done.
        second: calls a function in another process, which takes its share of the distortion models; None without one.

    Returns:
        The rig, its held-out errors, and what was rejected.

    Raises:
        CalibrationError: fewer than three usable pairs, or views that do not determine the cameras.
    """
    heldout.require_choice(folds, models)
    points = board.body.points
    usable, rejected = _usable(pairs)
    _enough(len(usable), len(pairs), rejected)
    pair_count = len(usable)
    alone, without_board = _usable_alone(singles)
    usable, rejected = usable + alone, rejected + without_board
    progress("estimating poses of cameras and boards")
    first, usable, notes = _start(board, usable, sizes, models)
    observations = Observations.from_shots([join(pair.left, pair.right) for pair in usable])
    if (other := other_size(rigid_board(points), first, observations, pair_count)) is not None:
        row, factor = other
        raise CalibrationError(
            f"from {usable[row].name} on the board is {factor:.3g} times as large as in the pairs before: another board or "
            f"print, or cameras that were moved? Images do not show which: calibrate from the pairs before it, or "
            "from those from there on, alone"
        )
    progress("looking for gross errors")
    model = rigid_board(points) if flat else printed_board(points)
    radius_m, first = _disc_radius(board, usable, first, observations)
    model = replace(model, disc_radius_m=radius_m or 0.0)
    if alone and not flat:
        model, observations = with_second_print(model, observations, pair_count)
    selection = _Selection(
        model, observations, tuple(pair.name for pair in usable), sizes, folds, pair_count, len(pairs), progress
    )
    screened, trial, tried = selection.chosen(first.state, models, second)
    lens = trial.solution.state.cameras[0].model
    if lens != first.state.cameras[0].model and (screened.rejected or screened.notes):
        # Pairs rejected under a simple lens may fit the one that was chosen.
        progress(f"looking for gross errors again, under {lens}")
        with contextlib.suppress(CalibrationError):
            chosen = trial.solution.state
            start = replace(first.state, cameras=chosen.cameras, T_left_right=chosen.T_left_right)
            again, trial_again, _ = selection.chosen(start, (lens,))
            if len(again.observations.shot) > len(screened.observations.shot):
                screened, trial = again, trial_again
                tried = {**tried, lens: trial.heldout}
    rejected += screened.rejected
    names = tuple(usable[j].name for j in screened.kept if j < pair_count)
    calibration = heldout.concluded(
        board.body,
        trial,
        screened.observations,
        models=tried,
        pairs=names,
        pairs_found=len(pairs),
        rejected=tuple(rejected),
        notes=(*notes, *screened.notes, *unseen_row(board, _shown(pairs))),
        disc_radius_m=radius_m,
        moving=moving,
    )
    _apart(calibration.rig, trial.solution.state)
    return calibration


def _apart(rig: StereoRig, state: BundleState) -> None:
    """Raise a CalibrationError where both cameras stand at one position, so that nothing can be triangulated."""
    distance_m = float(np.median(np.linalg.norm(state.Ts_left_body[:, :3, 3], axis=1)))
    if rig.baseline_m < max(_BASELINE_SIGMAS * rig.baseline_sigma_m, _BASELINE_SHARE * distance_m):
        raise CalibrationError(
            f"the cameras are {1e3 * rig.baseline_m:.0f} ± {1e3 * rig.baseline_sigma_m:.0f} mm apart, which is no "
            "baseline: are left and right images of one camera, or of different moments?"
        )


def _disc_radius(
    board: CalibrationBoard, usable: list[Pair], first: BundleSolution, observations: Observations
) -> tuple[float | None, BundleSolution]:
    """Return the radius of a board's discs, m, None where it has none, and an adjustment with their perspective bias.

    The images show a radius: the areas of the ellipses against the spacing of the discs, at the poses found.
    CalibrationError: it is not the one that the board is said to have.
    """
    seen = [
        (side, j, d) for j, pair in enumerate(usable) for side, d in enumerate((pair.left, pair.right)) if len(d.shape)
    ]
    if not seen:
        return None, first
    about_m, problem = None, None
    for _ in range(_RADIUS_ROUNDS):
        state = first.state
        T_cameras = np.eye(4), inverse(state.T_left_right)
        views = [(state.cameras[side], T_cameras[side] @ state.Ts_left_body[j], found) for side, j, found in seen]
        about_m, problem = seen_radius(board, views, about_m)
        model = replace(rigid_board(board.body.points), disc_radius_m=about_m)
        first = minimise(model, state, observations, 1.0, max_steps=heldout.STEPS, least_decrease=heldout.ROUGHLY)
    if problem is not None:
        raise CalibrationError(problem)
    return board.disc_radius_m or about_m, first


def _usable(pairs: Sequence[Pair]) -> tuple[list[Pair], list[RejectedPair]]:
    """Split the pairs into those that show the board in both images and those that do not, with reasons."""
    usable, rejected = list[Pair](), []
    first: dict[tuple[str, bytes, bytes], str] = {}  # the pair of each image that was seen
    for pair in pairs:
        common = np.intersect1d(pair.left.ids, pair.right.ids)
        problems = [f"{side}: {d.problem}" for side, d in (("left", pair.left), ("right", pair.right)) if d.problem]
        if problems:
            rejected.append(RejectedPair(pair.name, "; ".join(problems)))
        elif len(common) < LEAST_CORNERS:
            rejected.append(
                RejectedPair(pair.name, f"{len(common)} points seen by both cameras, {LEAST_CORNERS} are needed")
            )
        elif (repeated := _repeated(first, pair)) is not None:
            rejected.append(RejectedPair(pair.name, repeated))
        else:
            usable.append(pair)
    return usable, rejected


def _repeated(first: dict[tuple[str, bytes, bytes], str], pair: Pair) -> str | None:
    """Say which image of a pair is an earlier one's, to the last digit of its detections; remember both where none is."""
    keys = [(name, d.uv.tobytes(), d.cov_uv.tobytes()) for name, d in (("left", pair.left), ("right", pair.right))]
    same = [(key[0], first[key]) for key in keys if key in first]
    if len(same) == 2 and same[0][1] == same[1][1]:
        return f"both images are those of {same[0][1]}: a frame that repeats shows nothing new"
    if same:
        images = " and ".join(f"the {side} image is that of {name}" for side, name in same)
        return f"{images}: a frame that repeats is of another moment than its pair"
    first |= dict.fromkeys(keys, pair.name)
    return None


def _usable_alone(singles: Sequence[Pair]) -> tuple[list[Pair], list[RejectedPair]]:
    """Split images of one camera alone into those that show the board and those that do not, with reasons."""
    usable, rejected = [], []
    for single in singles:
        seen = max(single.left, single.right, key=lambda found: len(found.ids))
        if len(seen.ids) >= LEAST_CORNERS:
            usable.append(single)
        else:
            rejected.append(RejectedPair(single.name, single.left.problem or single.right.problem or "too few points"))
    return usable, rejected


def _enough(usable: int, given: int, rejected: list[RejectedPair]) -> None:
    """Raise unless there are enough pairs, with the first reasons why not."""
    if usable >= LEAST_PAIRS:
        return
    shown = sorted(
        rejected, key=lambda r: r.reason.startswith(("left:", "right:"))
    )  # what both cameras saw comes first
    why = "; ".join(f"{r.pair}: {r.reason}" for r in shown[:2])
    more = f" (and {len(rejected) - 2} more)" if len(rejected) > 2 else ""
    raise CalibrationError(
        f"{usable} of {given} pairs are usable, at least {LEAST_PAIRS} are needed, 15 or more are better"
        + (f": {why}{more}" if why else "")
        + ". Is --target the board in the images (columns x rows, of a chessboard the inner corners)?"
        + (
            " Does a driver mirror the images of one camera?"
            if any("gross errors" in r.reason for r in rejected)
            else ""
        )
    )


def _start(
    board: CalibrationBoard, usable: list[Pair], sizes: tuple[tuple[int, int], tuple[int, int]], models: tuple[str, ...]
) -> tuple[BundleSolution, list[Pair], list[str]]:
    """Start from nothing, under a plain and a fisheye lens where both are allowed, and correct boards named in reverse."""
    families = dict.fromkeys("fisheye" if model == "fisheye" else "brown4" for model in models)
    points = board.body.points

    def attempt(pairs: list[Pair]) -> BundleSolution:
        observations = Observations.from_shots([join(pair.left, pair.right) for pair in pairs])
        found: list[BundleSolution] = []
        for family in families:
            found.append(start_board(points, sizes, observations, family))
            near = residual_rms_px(found[-1]) < _MISNAMED_PX and family != "fisheye"
            if fits(found[-1]) or (near and not _may_gain(rigid_board(points), found[-1], observations, "fisheye")):
                break
        return min(found, key=lambda s: s.cost)

    if not board.symmetries:
        return attempt(usable), usable, []
    observations = Observations.from_shots([join(pair.left, pair.right) for pair in usable])
    orders = agreed_symmetries(points, sizes, observations, board.symmetries, next(iter(families)))
    named = [replace(p, right=renamed(p.right, orders[j])) if j in orders else p for j, p in enumerate(usable)]
    notes = [f"{usable[j].name}: the right image names the corners in another order; corrected" for j in orders]
    if 2 * len(orders) > len(usable):
        notes = [f"{len(orders)} right images name the corners in another order; corrected"]
    return attempt(named), named, notes


@dataclass(frozen=True, eq=False)
class _Selection(Record):
    """Screening and the choice of the model, from a start."""

    model: BundleModel
    observations: Observations
    names: tuple[str, ...]
    sizes: tuple[tuple[int, int], tuple[int, int]]
    folds: int
    pair_count: int
    given: int
    progress: Progress

    def chosen(
        self, start: BundleState, models: tuple[str, ...], second: Second | None = None
    ) -> tuple[Screened, heldout.Trial, dict[str, HeldOutErrors]]:
        """Reject gross errors, then return the best model's trial and the held-out errors of all."""
        start = replace(start, shape=np.zeros(len(self.model.modes)))
        screened, motion = self._screened(self.model, start), None
        found = motion_of(self.model, screened, self.observations.shot_count)
        if found is not None and (still := self._without(start, screened, found[1])) is not None:
            screened, found = still, None
        if found is not None:
            # A board that moved between the exposures looks like gross errors under the assumption that it stood still.
            moving, _ = found
            self.progress("looking for gross errors again: the board moved between the exposures")
            eased = replace(self.model, motion_sigmas=MOTION_EASE * moving.sigmas)
            screened = self._screened(eased, start, robust_sigma(screened.solution))
            motion = moving.shots(screened.kept)
        folds = min(self.folds, self._pairs(screened))
        search = LensModelSearch(self.model, motion, screened, folds, self.sizes, self.progress)
        return screened, *search.best(models, second)

    def _without(self, start: BundleState, screened: Screened, furthest: dict[int, str]) -> Screened | None:
        """Return the detections without the pair that moved furthest where no motion is significant in the others.

        In few pairs one alone makes a motion significant, and would hide behind it.
        """
        if self._pairs(screened) <= LEAST_PAIRS:
            return None
        rows = np.flatnonzero(~np.isin(screened.kept, list(furthest)))
        with contextlib.suppress(CalibrationError):
            if self._moves(screened, rows):
                return None
            others = self._screened(self.model, start, known=furthest)
            return others if motion_of(self.model, others, self.observations.shot_count) is None else None
        return None

    def _moves(self, screened: Screened, rows: NDArray[np.intp]) -> bool:
        """Return whether a motion is significant in some of the shots screened, as they are."""
        old, seen = screened.solution, screened.observations.shots(rows)
        state = replace(old.state, Ts_left_body=old.state.Ts_left_body[rows])
        solution = minimise(self.model, state, seen, old.sigma_px, damping=NEAR, least_decrease=heldout.ROUGHLY)
        some = replace(screened, observations=seen, kept=screened.kept[rows], solution=solution)
        return motion_of(self.model, some, self.observations.shot_count) is not None

    def _screened(
        self, model: BundleModel, start: BundleState, sigma_px: float = 1.0, known: Mapping[int, str] | None = None
    ) -> Screened:
        """Reject gross errors; too few pairs are an error."""
        screened = screen(model, start, self.observations, self.names, sigma_px=sigma_px, known=known)
        _enough(self._pairs(screened), self.given, list(screened.rejected))
        return screened

    def _pairs(self, screened: Screened) -> int:
        """Return how many pairs remain; images of one camera alone come after them and do not count."""
        return int((screened.kept < self.pair_count).sum())


def calibrate_recording(
    board: CalibrationBoard,
    pairs: Sequence[Pair],
    t_s: Array,
    sizes: tuple[tuple[int, int], tuple[int, int]],
    *,
    models: tuple[str, ...] = MODELS,
    flat: bool = False,
    folds: int = FOLDS,
    singles: Sequence[Pair] = (),
    progress: Progress = lambda message: None,
) -> Calibration:
    """Calibrate two cameras that may expose at different times, from a recording of a board that moves.

    Skew and cameras are estimated alternately (:mod:`armsight.vision.pose.shutter`), then every detection is moved to
    the time of its left image, and the pairs are calibrated as simultaneous ones. Alternating leaves the sigma of the skew
    at given cameras; with rho its correlation with them an error shrinks by rho^2 each round, so the sigma of both is that
    over sqrt(1 - shrinkage).

    Returns as :func:`calibrate_boards`, with the skew in the rig where there is one; a note says so, or why it was not
    found. ``pairs`` are in the order of ``t_s``, (N,) the times of the shots, s, rising. Raises CalibrationError: fewer
    than three usable pairs, or views that do not determine the cameras; InputError: the times do not rise.
    """
    seen = [pair for pair in pairs if min(len(pair.left.ids), len(pair.right.ids)) >= LEAST_CORNERS]
    if len(seen) < LEAST_PAIRS:
        _enough(len(seen), len(pairs), _usable(pairs)[1])
    given, several = _spread(seen), tuple(m for m in ("brown4", "fisheye") if m in models) or models[:1]
    first = calibrate_boards(
        board, given, sizes, models=several, flat=flat, folds=2, singles=singles, moving=True, progress=progress
    )
    progress("looking for the skew of the cameras")
    found = _Recording(board, tuple(pairs), t_s, first, not singles).one_time()
    shutters = None
    if isinstance(found, Missed):
        said = f"no skew of the cameras is taken into account: {found.reason}"
    else:
        shutters, moved = found
        given = _spread(moved)
        said = f"the cameras do not expose at one time: {shutters}; the detections were moved to one time"
    calibration = calibrate_boards(
        board, given, sizes, models=models, flat=flat, folds=folds, singles=singles, moving=True, progress=progress
    )
    used = f"{len(seen)} of {len(pairs)} shots show the board to both cameras; {len(given)} were used"
    calibration = replace(
        calibration,
        rig=replace(calibration.rig, shutters=shutters),
        notes=(*calibration.notes, used, said),
        recorded=True,
    )
    return heldout.assessed(calibration)


def _shown(pairs: Sequence[Pair]) -> list[Ids]:
    """Return the points that each image shows which shows the board."""
    return [seen.ids for pair in pairs for seen in (pair.left, pair.right) if len(seen.ids)]


def _spread(pairs: Sequence[Pair]) -> list[Pair]:
    """Return at most _PAIRS_MOST pairs, evenly spread."""
    return [pairs[k] for k in np.linspace(0, len(pairs) - 1, min(len(pairs), _PAIRS_MOST)).round().astype(int)]


@dataclass(frozen=True, eq=False)
class _Recording(Record):
    """A recording of a moving board, and the cameras as they seem where all its shots are taken as simultaneous."""

    board: CalibrationBoard
    pairs: tuple[Pair, ...]
    t_s: Array
    first: Calibration
    free_cameras: bool

    @property
    def body(self) -> Body:
        """The board as found."""
        return self.first.body

    def one_time(self) -> tuple[Shutters, list[Pair]] | Missed:
        """Return the skew and the pairs with every detection moved to the time of its left image, or why there is none."""
        rig = replace(self.first.rig, sigma_px=max(self.first.solution.sigma_px, _SKEW_PX))
        interval = float(np.median(np.diff(self.t_s))) if len(self.t_s) > 1 else 1.0
        later, steps = 0, [0.0]
        shots = self.shots(rig, later)
        found = Shutters(0.0, 0.0, np.zeros((2, 2)))
        for step in range(_SKEW_ROUNDS):
            some = list(_busiest(shots).values())
            estimate = estimate_shutters(rig, self.body, some, known=found, sigma_most=np.inf, calibrated=False)
            if isinstance(estimate, Missed):
                return estimate
            steps.append(estimate.skew_s - found.skew_s)
            found = estimate
            settled = abs(steps[-1]) < _SETTLED * found.sigmas[0]
            if abs(found.skew_s + later * interval) > _REPAIR * interval and not self.board.symmetries:
                later = -round(found.skew_s / interval)
                shots = self.shots(rig, later)
                if abs(later) * 4 > len(self.pairs) or len(shots) < LEAST_PAIRS:
                    return Missed("the shots do not agree with one skew: are these recordings of one time?")
            elif settled and step > _POSE_ROUNDS:
                break
            else:
                rig = self.adjusted(
                    rig, _busiest(shots), found, free_cameras=self.free_cameras and step >= _POSE_ROUNDS
                )
        shutters = replace(found, cov=found.cov / (1.0 - _shrinkage(steps, float(found.sigmas[0]))))
        sigma = float(shutters.sigmas[0])
        if sigma > _SKEW_UNSURE * interval:
            return Missed(
                f"it comes out as {1e3 * shutters.skew_s:.0f} ± {1e3 * sigma:.0f} ms, with {1e3 * interval:.0f} ms between "
                "two shots: record more shots a second, or move the board less abruptly and for longer"
            )
        if abs(shutters.skew_s) < _SKEW_SIGMAS * sigma and shutters.jitter_s == 0:
            return Missed(f"they expose at one time within {1e3 * (abs(shutters.skew_s) + 2 * sigma):.2g} ms")
        return shutters, self.moved(rig, shots, later, shutters)

    def shots(self, rig: StereoRig, later: int) -> dict[int, TimedShot]:
        """Return the shots of left frames with right ones ``later`` frames behind, with the left camera's pose to begin."""
        found = {}
        for k, (t, pair) in enumerate(zip(self.t_s, self.pairs, strict=True)):
            if not 0 <= k + later < len(self.pairs):
                continue
            left, right = pair.left, self.pairs[k + later].right
            if min(len(left.ids), len(right.ids)) < LEAST_CORNERS:
                continue
            poses = body_poses(self.body.points[left.ids], rig.left, left.uv)
            if poses:
                apart_s = float(self.t_s[k + later] - t)
                found[k] = TimedShot(float(t), join(left, right), poses[0][0], apart_s)
        return found

    def adjusted(
        self, rig: StereoRig, shots: dict[int, TimedShot], shutters: Shutters, *, free_cameras: bool
    ) -> StereoRig:
        """Return the cameras adjusted to the shots that can be moved to one time."""
        known = aligned(rig, self.body, list(shots.values()), shutters)
        chosen = [
            (at_one_time(rig, self.body, shot.seen, a, shutters), a.T_left_body)
            for shot, a in zip(shots.values(), known, strict=True)
            if a.motion is not None and a.motion.centred
        ]
        observations = Observations.from_shots([seen for seen, _ in chosen])
        radius_m = self.first.disc_radius_m or 0.0
        model = replace(rigid_board(self.body.points), disc_radius_m=radius_m, free_cameras=free_cameras)
        state = BundleState(rig.cameras, rig.T_left_right, np.array([T for _, T in chosen]), np.zeros(0))
        state = minimise(
            model, state, observations, rig.sigma_px, max_steps=heldout.STEPS, least_decrease=heldout.ROUGHLY
        ).state
        return replace(rig, left=state.cameras[0], right=state.cameras[1], T_left_right=state.T_left_right)

    def moved(self, rig: StereoRig, shots: dict[int, TimedShot], later: int, shutters: Shutters) -> list[Pair]:
        """Return the pairs at one time; without those whose motion is not seen from both sides."""
        pairs = []
        for (k, shot), a in zip(shots.items(), aligned(rig, self.body, list(shots.values()), shutters), strict=True):
            if a.motion is None or not a.motion.centred:
                continue
            right, now = self.pairs[k + later].right, at_one_time(rig, self.body, shot.seen, a, shutters)
            uv = now.uv[np.searchsorted(now.ids, right.ids), 1]
            if np.isfinite(uv).all():
                pairs.append(replace(self.pairs[k], right=replace(right, uv=uv)))
        return pairs


def _busiest(shots: dict[int, TimedShot]) -> dict[int, TimedShot]:
    """Return at most _SKEW_SHOTS shots in a row: those in which the board moves furthest."""
    if len(shots) <= _SKEW_SHOTS:
        return shots
    at = np.array([shot.T_left_body[:3, 3] for shot in shots.values()])
    ways = np.minimum(np.linalg.norm(np.diff(at, axis=0), axis=1), 0.1)  # an abrupt change is another pose, no motion
    first = int(np.argmax(np.convolve(ways, np.ones(_SKEW_SHOTS - 1), "valid")))
    return dict(list(shots.items())[first : first + _SKEW_SHOTS])


def _shrinkage(steps: list[float], sigma_s: float) -> float:
    """Return by what an error of the skew shrinks from round to round: the last ratio of steps that are no noise."""
    ratios = [abs(b / a) for a, b in itertools.pairwise(steps) if abs(a) > 0.1 * sigma_s]
    return float(np.clip(ratios[-1], 0.0, 0.95)) if ratios else 0.0
