"""The guided calibration: it says where to hold the board, takes the shots by itself, and says in mm how good they are.

In: live shots. Out: a :class:`CalibrationState` at any time, a folder of shots, and in the end rig.json. A shot is taken
when the board stands still and sharp in both views, and lowers the predicted error by at least a good part of what the
best pose would. Fits run in a thread of their own; until one is done the next pose follows from the predicted information.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from armsight.app.calibrate.assessment import advice, assess, graded_metrics
from armsight.app.calibrate.run import provenance
from armsight.app.live.capture import LiveShot
from armsight.app.live.records import Drawn, asked, dots, polyline
from armsight.app.live.step import Guided, GuidedState, Shared
from armsight.app.record.recording import ShotFolder
from armsight.data import Array, Detections, Shot
from armsight.errors import ArmsightError, CalibrationError, InputError
from armsight.files import unused
from armsight.geometry.pose import inverse, transform
from armsight.vision.calibrate import MODELS
from armsight.vision.calibrate.boards import Pair, calibrate_boards
from armsight.vision.calibrate.guide import CalibrationAim, Guide, Knowledge, NextPose, guessed_camera, guessed_rig
from armsight.vision.calibrate.result import Calibration
from armsight.vision.calibrate.weak import require_order
from armsight.vision.image import grey
from armsight.vision.markers.board import open_board
from armsight.vision.markers.chessboard import Chessboard
from armsight.vision.markers.marker import CalibrationBoard
from armsight.vision.pose.pnp import body_poses
from armsight.vision.quality import SHARP_PX, edge_spread_px
from armsight.vision.rig import StereoRig

#: The board stands still when its corners moved less than this in so long, px and s, over so many detections.
STILL_PX, STILL_S, STILL_DETECTIONS = 0.8, 0.3, 3
#: An edge spread up to this is sharp enough for a shot, px.
_SHARP_SHOT_PX = 1.7 * SHARP_PX
#: A pose is taken for this share of the best one's gain, and corners this share of the board's size from all before.
_WORTH, _OTHER_SHARE = 0.5, 0.06
#: A person who stood still for the first time, s, has done what is possible: this share is enough; then another pose.
_PATIENT_S, _PATIENT_WORTH, _OTHER_POSE_S = 3.0, 0.15, 6.0
#: First fit, fewest shots of a calibration that is called good, and folds while shots are still taken.
FIRST_FIT, LEAST_SHOTS, _FOLDS = 4, 12, 5
#: Lens models while shots are still taken: all are tried at the end.
_QUICK_MODELS = ("brown5",)
#: Columns and rows of the cells in which coverage is counted.
CELLS = (8, 5)
#: Longest side of the images in which a board is looked for quickly.
_QUICK_SIDE_PX, _QUICKER_SIDE_PX = 640, 360
#: s between two thorough searches for a board not seen quickly; half: shots are dropped, double: a far board waits.
_THOROUGH_S = 2.0
_SHOW, _GOOD = "Hold the board so that both cameras see all of it.", "Good."
_ASKS = "Good enough. Finish, or go on?"
Sizes = tuple[tuple[int, int], tuple[int, int]]


@dataclass(frozen=True)
class Progress:
    """The errors after a shot."""

    shots: int
    heldout_mm: float  # rigid RMS on held-out pairs
    floor_mm: float  # the rigid RMS that the corners' noise alone would leave
    predicted_mm: float  # predicted RMS error that the calibration leaves in the working volume


@dataclass(frozen=True)
class CalibrationState(GuidedState):
    """What a page shows of the guided calibration."""

    missing: tuple[str, ...] = ("no shot yet",)
    board: str = ""
    running: bool = False  # shots are taken
    shots: tuple[str, ...] = ()  # names of those that count
    left_out: tuple[str, ...] = ()  # those that do not, with the reason
    instruction: str = ""  # what to do now
    still: float = 0.0  # how still it stands, 0 to 1
    edge_px: float | None = None  # edge spread of the board
    coverage: tuple[tuple[tuple[int, ...], ...], ...] = ()  # each camera, rows of cells: shots with the board in it
    missing_shots: int | None = None  # predicted number of guided shots until the aim is reached
    ended: bool = False  # good enough, it ended by itself: a person says whether to go on
    aim_mm: float = 0.0  # what was asked for; 0: as small as a point's own noise
    goal_mm: float = 0.0  # the predicted error that is good enough; 0 before the first fit
    distance_m: float = 0.8
    advice: tuple[str, ...] = ()  # what is weak in the written calibration, and what to do about it
    rig: str | None = None  # the written file
    command: str = ""  # the command line that does the same with the stored shots
    drawn: tuple[Drawn, ...] = ()


def quick_look(board: CalibrationBoard, image: np.ndarray, *, thorough: bool = True) -> Detections:
    """Detect a board; a thorough search of the whole image where nothing of it is seen takes long, and may be left out."""
    if isinstance(board, Chessboard) and not thorough:
        found = cv2.checkChessboard(_shrunk(image, _QUICK_SIDE_PX), (board.columns, board.rows))  # it overlooks boards
        if not found and board.detect(_shrunk(image, _QUICKER_SIDE_PX)).problem is not None:
            return Detections.none(f"{board.body.name} is not in view")
    return board.detect(image)


def _shrunk(image: np.ndarray, side_px: int) -> np.ndarray:
    scale = min(1.0, side_px / max(image.shape))
    return cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)


def _off(now: Detections, then: Detections) -> tuple[Array, Array]:
    """Return where points seen both times were then (M, 2), px, and how far they are from there now (M,)."""
    _, a, b = np.intersect1d(now.ids, then.ids, return_indices=True)
    return then.uv[b], np.linalg.norm(now.uv[a] - then.uv[b], axis=1)


def _sees(pair: Pair) -> tuple[bool, bool]:
    return pair.left.problem is None, pair.right.problem is None


class CalibrationStep(Guided[CalibrationState]):
    """The guided calibration with one board: shots in ``calibration``, then ``rig.json``, given to ``changed``."""

    def __init__(
        self, shared: Shared, spec: str, aim: CalibrationAim, changed: Callable[[StereoRig, Path], None]
    ) -> None:
        super().__init__(shared, CalibrationState(board=spec))
        self.spec, self.aim, self._changed = spec, aim, changed
        self.board = open_board(spec)
        self._guide = Guide(self.board)
        self._result: Calibration | None = None
        self._shots: dict[str, Pair] = {}
        self._left_out: dict[str, str] = {}
        self._sizes: Sizes | None = None
        self._knowledge: Knowledge | None = None
        self._rig: StereoRig | None = None
        self._next: NextPose | None = None
        self._recent: deque[tuple[float, Pair]] = deque(maxlen=12)  # when, s, and the board in both views
        self._writer: ShotFolder | None = None
        self._forced = self._must_move = self._ended = False  # _ended: it was good enough, once
        self._first = 0  # number of the pose before the first fit
        self._thorough_s = self._rest_s = 0.0  # last thorough search; since when the board has not moved on

    @property
    def outline_uv(self) -> tuple[Array, Array] | None:
        """The board's points as the outline to be reached shows them in both views, (M, 2) each; None without."""
        with self.lock:
            if self._next is None or self._rig is None:
                return None
            return self._rig.project(transform(self._next.T_left_board, self.board.body.points))

    def start(self) -> None:
        """Take shots from now on."""
        self.show(running=True, ended=False, instruction=_SHOW)

    @asked("calibration")
    def pause_calibration(self) -> None:
        """Take no more shots for now."""
        self.show(running=False)

    @asked("calibration")
    def take_shot(self) -> None:
        """Take the next shot in which both cameras see the board, whatever its pose."""
        if not self.shown.running:
            raise InputError("the calibration is paused: continue it first")
        self._forced = True

    @asked("calibration")
    def set_aim(self, error_mm: float, distance_m: float) -> None:
        """Say what the calibration is to be good for; ``error_mm`` 0: for errors as small as a point's own noise."""
        if not (0.0 <= error_mm < 1e3 and 0.05 <= distance_m <= 20.0):
            raise InputError("the aim is an error in mm, 0 for the images' noise, and a distance from 0.05 to 20 m")
        with self.lock:
            self.aim, self._ended = CalibrationAim(1e-3 * error_mm, distance_m), False
            if self._result is not None:
                self._learned(self._result)

    @asked("calibration")
    def drop_shot(self, name: str) -> None:
        """Leave out a shot."""
        with self.lock:
            if name not in self._shots:
                raise InputError(f"no shot {name!r}; there are {', '.join(self._shots) or 'none'}")
            self._left_out[name] = "left out by hand"
            del self._shots[name]
            self.fit_soon()

    @asked("calibration")
    def finish_calibration(self) -> None:
        """Choose the lens model by held-out errors, and write rig.json, in the background."""
        with self.lock:
            if len(self._shots) < FIRST_FIT:
                raise InputError(f"{len(self._shots)} shots are too few; {LEAST_SHOTS} or more are advised")
            self.show(running=False, fitting="choosing the lens model by held-out errors")
            if self.shared.simulated is not None:
                self.shared.simulated.person.holds = False
            self.later("no rig was written", self._finished)

    def close(self) -> None:
        """End the thread and close the folder."""
        super().close()
        if self._writer is not None:
            self._writer.close()

    def look(self, live: LiveShot) -> None:
        """Look at a live shot; take it if it is worth it. Called from one thread."""
        shot, now_s = live.shot, live.arrived_s
        if not self.shown.running or shot.left is None or shot.right is None:
            return
        images = grey(shot.left), grey(shot.right)
        late = now_s - self._thorough_s > _THOROUGH_S
        self._thorough_s = now_s if late else self._thorough_s
        were = _sees(self._recent[-1][1]) if self._recent else (False, False)
        left, right = (quick_look(self.board, i, thorough=late or was) for i, was in zip(images, were, strict=True))
        with self.lock:
            (h0, w0), (h1, w1) = images[0].shape, images[1].shape
            self._sizes = (w0, h0), (w1, h1)
            pair = Pair("", left, right)
            self._recent.append((now_s, pair))
            both, still = all(_sees(pair)), self._stillness()
            self.show(edge_px=edge_spread_px(_cropped(images[0], left)) if both else None)
            if (still < 1.0 and both) or not any(_sees(pair)):
                self._rest_s = now_s
            elif now_s - self._rest_s > _OTHER_POSE_S and not self._must_move:
                self._rest_s = now_s
                self._choose(None)
            advice = self._advice(pair, still)
            self.show(instruction=advice)
            self._must_move = self._must_move and (still > 0.6 or not both)
            if both and (self._forced or (advice == _GOOD and still == 1.0)):
                self._forced = False
                self._take(shot, pair)

    def _stillness(self) -> float:
        """Return how still the board stands, 1 is still."""
        newest_s, newest = self._recent[-1]
        moved, count = 0.0, 0
        for at_s, pair in reversed(self._recent):
            if newest_s - at_s > max(3 * STILL_S, 1.0):
                break
            off = [_off(newest.left, pair.left)[1], _off(newest.right, pair.right)[1]]
            if not all(map(len, off)):
                return 0.0
            moved, count = max(moved, *map(np.median, off)), count + 1
            if count >= STILL_DETECTIONS and newest_s - at_s >= STILL_S:
                break
        return float(min(count / STILL_DETECTIONS, 1.0) * min(1.0, STILL_PX / max(moved, 1e-6)))

    def _advice(self, pair: Pair, still: float) -> str:
        sees, edge_px = _sees(pair), self.shown.edge_px
        if not any(sees):
            return _SHOW
        if not all(sees):
            side, missed = ("right", pair.right) if sees[0] else ("left", pair.left)
            more = "" if "not in view" in (missed.problem or "") else f" ({missed.problem})"
            return f"The {side} camera does not see all of the board{more}: move it into both views."
        if self._must_move:
            return "Taken. Move the board to the outline."
        if edge_px is not None and edge_px > _SHARP_SHOT_PX:
            return f"The board is not sharp ({edge_px:.1f} px): more light, shorter exposure, or focus."
        if not self._useful(pair):
            return "Move the board to the outline, in both views."
        return "Hold still." if still < 1.0 else _GOOD

    def _useful(self, pair: Pair) -> bool:
        """Return whether a shot of the board where it is now is worth taking: elsewhere than all before, and as good."""
        for before in self._shots.values():
            then, off = _off(pair.left, before.left)
            size = np.linalg.norm(np.ptp(then, axis=0)) * (1.0 if self._knowledge is None else 0.3) if len(off) else 0.0
            if len(off) and off.mean() < _OTHER_SHARE * size:  # a rotation changes the shape of the image
                return False
        if self._knowledge is None:
            return True
        T = self._pose(pair)
        if T is None or self._next is None:
            return False
        now, then_m = self._knowledge.error_m, float(self._knowledge.errors_after_m(T[None])[0])
        worth = _PATIENT_WORTH if self._recent[-1][0] - self._rest_s > _PATIENT_S else _WORTH
        return now - then_m >= worth * (now - self._next.then_m)

    def _pose(self, pair: Pair) -> Array | None:
        if self._rig is None:
            return None
        found = body_poses(self.board.body.points[pair.left.ids], self._rig.left, pair.left.uv)
        return found[0][0] if found else None

    def _know(self, pair: Pair) -> None:
        if self._knowledge is not None and (T := self._pose(pair)) is not None:
            self._knowledge = self._knowledge.after(T)

    def _take(self, shot: Shot, pair: Pair) -> None:
        name = f"{len(self._shots) + len(self._left_out) + 1:02d}"
        try:
            if self._writer is None:
                self._writer = ShotFolder(unused(self.folder / "calibration"))
            self._writer.add(shot)
        except ArmsightError as error:
            self.show(running=False)
            self.say("error", f"the shot cannot be stored, the calibration is paused: {error}")
            return
        self._shots[name] = replace(pair, name=name)
        self._must_move = True
        self._know(pair)
        self.say("good", f"shot {name} taken")
        self._choose(pair)
        self.fit_soon()

    def _choose(self, pair: Pair | None) -> None:
        """Choose the next pose; before the first fit by the cameras that a pair lets guess."""
        if self._knowledge is not None and self._rig is not None:
            self._next = self._guide.best(self._knowledge, self._rig)
            self.show(missing_shots=self._guide.shots_missing(self._knowledge, self._rig))
            return
        if pair is not None and self._sizes is not None:
            seen = zip((pair.left, pair.right), map(guessed_camera, self._sizes), strict=True)
            left, right = (body_poses(self.board.body.points[d.ids], camera, d.uv) for d, camera in seen)
            if not (left and right):
                return
            self._rig = guessed_rig(self._sizes, left[0][0] @ inverse(right[0][0]))
        if self._rig is not None:
            self._first += 1
            self._next = self._guide.first(self._first, self._rig)

    def _fitted(self, *, quick: bool) -> tuple[Calibration, set[str]]:
        with self.lock:
            pairs, sizes = list(self._shots.values()), self._sizes
        assert sizes is not None
        how: Any = {"models": _QUICK_MODELS, "folds": min(_FOLDS, len(pairs))} if quick else {"models": MODELS}
        result = calibrate_boards(self.board, pairs, sizes, **how)
        require_order(result)
        return result, {pair.name for pair in pairs}

    def _fit(self) -> None:
        super()._fit()
        with self.lock:
            shown = self.shown
            if shown.good and shown.running and shown.fitting is None and not self._ended:
                self._ended = True
                self.say("good", f"good enough for {shown.goal_mm:.2g} mm: finished; Go on takes more shots")
                self.finish_calibration()
                self.show(ended=True, instruction=_ASKS)

    def fit(self) -> None:
        """Fit the shots so far, if there are enough, and choose the next pose."""
        if len(self._shots) < FIRST_FIT:
            return
        try:
            result, names = self._fitted(quick=True)
            with self.lock:
                self._learned(result)
                for name in self._shots.keys() - names:  # that came while the others were fitted
                    self._know(self._shots[name])
                self._choose(None)
        except (CalibrationError, np.linalg.LinAlgError) as error:
            self.show(missing=(f"the shots cannot be fitted yet: {error}",), good=False)

    def _learned(self, result: Calibration) -> None:
        self._result, self._rig = result, result.rig
        self._knowledge = Knowledge.of(result, self.board, self.aim)
        h, shots, error_m = result.held_out, result.pairs_found, self._knowledge.error_m
        floor = h.rigid_rms_m / h.over_noise_rms if h.over_noise_rms > 0 else float("nan")
        self.learned(shots, Progress(shots, 1e3 * h.rigid_rms_m, 1e3 * floor, 1e3 * error_m))
        for rejected in result.rejected:
            if rejected.pair not in self._left_out:
                self.say("warn", f"shot {rejected.pair} is left out: {rejected.reason}")
                self._left_out[rejected.pair] = rejected.reason
        missing = self._lacking(result, error_m, self._knowledge.goal_m)
        self.show(missing=missing, good=not missing, goal_mm=1e3 * self._knowledge.goal_m)

    def _lacking(self, result: Calibration, error_m: float, goal_m: float) -> tuple[str, ...]:
        lines = []
        if len(result.pairs) < LEAST_SHOTS:
            more = LEAST_SHOTS - len(result.pairs)
            lines.append(f"{more} more shot{'s' * (more > 1)}, so that the held-out errors mean something")
        if error_m > goal_m:
            why = "is the aim" if self.aim.error_m else "a point has by the images' noise"
            lines.append(f"predicted error {1e3 * error_m:.2g} mm, {1e3 * goal_m:.2g} mm {why}: more shots")
        lines += [f"{row.name} {row.heldout}: {row.advice}" for row in graded_metrics(result) if row.grade == "poor"]
        return tuple(lines)

    def _finished(self) -> None:
        path = self.folder / "rig.json"
        try:
            result, _ = self._fitted(quick=False)
            rig = replace(result.rig, provenance=provenance({"target": self.spec, "command": self._command()}, result))
            rig.save(path)
        finally:
            self.show(fitting=None)
        with self.lock:
            self._learned(result)
            self.show(rig=str(path), advice=tuple(advice(result)))
        ((grade, headline), _), mm = assess(result), 1e3 * result.held_out.rigid_rms_m
        text = f"{headline} {mm:.2g} mm RMS on held-out pairs; written to {path}"
        self.say("good" if grade == "good" else "hint", text)
        self._changed(rig, path)

    def _command(self) -> str:
        at = self.folder / "calibration" if self._writer is None else self._writer.folder
        rig = self.folder / "rig.json"
        return f"armsight calibrate --source 'pairs:{at}/left*.png,{at}/right*.png' --target {self.spec} -o {rig}"

    def now(self) -> CalibrationState:
        """Return what is shown, with how the board stands now."""
        newest_s, newest = self._recent[-1] if self._recent else (0.0, None)
        if time.monotonic() - newest_s > 1.0:
            newest = None
        still = 0.0 if newest is None else self._stillness()
        left_out = tuple(f"shot {name}: {reason}" for name, reason in self._left_out.items())
        coverage, aim = () if self._sizes is None else self._coverage(self._sizes), self.aim
        shown = replace(self.shown, shots=tuple(self._shots), left_out=left_out, still=still, coverage=coverage)
        if shown.running:
            shown = replace(shown, drawn=self._drawings(newest if still > 0.15 else None))
        elif not shown.ended:
            shown = replace(shown, instruction="")
        return replace(shown, aim_mm=1e3 * aim.error_m, distance_m=aim.distance_m, command=self._command())

    def _coverage(self, sizes: Sizes) -> tuple[tuple[tuple[int, ...], ...], ...]:
        """Return, for each camera, rows of cells: in how many shots corners of the board were in it."""
        counts = np.zeros((2, *CELLS[::-1]), int)
        for pair in self._shots.values():
            for side, found in enumerate((pair.left, pair.right)):
                hit = np.zeros(CELLS[::-1], bool)
                u, v = np.clip(found.uv / sizes[side] * CELLS, 0, np.subtract(CELLS, 1)).astype(int).T
                hit[v, u] = True
                counts[side] += hit
        return tuple(tuple(map(tuple, side)) for side in counts.tolist())

    def _drawings(self, seen: Pair | None) -> tuple[Drawn, ...]:
        """Return the outline to be reached, and the corners that are seen of a board that does not move."""
        drawn: list[Drawn] = []
        if self._next is not None and self._rig is not None:
            corners = np.vstack([self._guide.outline, self.board.body.points[:1]])
            views = self._rig.project(transform(self._next.T_left_board, corners))
            lines = [(polyline(uv[:-1], closed=True), polyline(uv[-1:])) for uv in views]
            drawn += [Drawn(side, "next", both) for side, both in enumerate(lines)]
        if seen is not None:
            shown = zip(dots("seen", (seen.left.uv, seen.right.uv)), _sees(seen), strict=True)
            drawn += [each for each, there in shown if there]
        return tuple(drawn)


def _cropped(image: np.ndarray, found: Detections) -> np.ndarray:
    (left, top), (right, bottom) = found.uv.min(axis=0).astype(int), found.uv.max(axis=0).astype(int) + 1
    return image[max(top, 0) : bottom, max(left, 0) : right]
