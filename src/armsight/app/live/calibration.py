"""The guided calibration: it says where to hold the board, takes the shots by itself, and says in mm how good they are.

In: live shots. Out: a :class:`CalibrationState` at any time, a folder of shots, and in the end rig.json. A shot is taken
when the board stands still and sharp in both views, and lowers the predicted error by at least a good part of what the
best pose would. Fits run in a thread of their own; until one is done the next pose follows from the predicted information.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from armsight.app.calibrate.assessment import advice, assess, graded_metrics
from armsight.app.calibrate.run import provenance
from armsight.app.live.capture import LiveShot
from armsight.app.live.guide import CalibrationAim, Guide, Knowledge, NextPose, guessed_camera, guessed_rig
from armsight.app.live.quality import SHARP_PX, edge_spread_px
from armsight.app.live.records import Drawn, polyline
from armsight.app.record.recording import ShotFolder
from armsight.app.show.messages import Note
from armsight.data import Array, Detections, Record, Shot
from armsight.errors import ArmsightError, CalibrationError, InputError
from armsight.geometry.pose import inverse, transform
from armsight.vision.calibrate import MODELS
from armsight.vision.calibrate.boards import Pair, calibrate_boards
from armsight.vision.calibrate.result import Calibration
from armsight.vision.calibrate.weak import require_order
from armsight.vision.image import grey
from armsight.vision.markers.board import open_board
from armsight.vision.markers.chessboard import Chessboard
from armsight.vision.markers.marker import CalibrationBoard
from armsight.vision.pose.pnp import body_poses
from armsight.vision.rig import StereoRig

#: The board stands still when its corners moved less than this in so long, px and s, over so many detections.
STILL_PX, STILL_S, STILL_DETECTIONS = 0.8, 0.3, 3
#: An edge spread up to this is sharp enough for a shot, px.
_SHARP_SHOT_PX = 1.7 * SHARP_PX
#: A pose is taken if it lowers the predicted error by this share of what the best one would, and if the board's corners are
#: on average by such a share of its size elsewhere than in every shot before.
_WORTH, _OTHER_SHARE = 0.5, 0.06
#: A person who has stood still for the first time, s, has done what is possible: then this share is enough; after the
#: second another pose is chosen.
_PATIENT_S, _PATIENT_WORTH, _OTHER_POSE_S = 3.0, 0.15, 6.0
#: First fit, fewest shots of a calibration that is called good, and folds while shots are still taken.
FIRST_FIT, LEAST_SHOTS, _FOLDS = 4, 8, 5
#: Lens models while shots are still taken: all are tried at the end.
_QUICK_MODELS = ("brown5",)
#: Columns and rows of the cells in which coverage is counted.
CELLS = (8, 5)
#: Longest side of the images in which a board is looked for quickly, and how often it is searched thoroughly, s.
_QUICK_SIDE_PX, _QUICKER_SIDE_PX, _THOROUGH_S = 640, 360, 2.0
_DRAWN_STILL = 0.15
_GONE_S = 1.0


@dataclass(frozen=True)
class Progress:
    """The held-out errors after a shot.

    Attributes:
        shots: how many there were.
        heldout_mm: rigid RMS on held-out pairs, mm.
        heldout_px: epipolar RMS on held-out pairs, px.
        floor_mm: the rigid RMS that the corners' noise alone would leave, mm.
        predicted_mm: predicted RMS error that the calibration leaves in the working volume, mm.
    """

    shots: int
    heldout_mm: float
    heldout_px: float
    floor_mm: float
    predicted_mm: float


@dataclass(frozen=True)
class CalibrationState:
    """What a page shows of the guided calibration.

    Attributes:
        board: spec of the board.
        running: whether shots are taken.
        fitting: what the fit is doing; None while none runs.
        shots: names of the shots that count.
        left_out: shots that do not count, with the reason.
        instruction: what to do now, one line.
        seen: whether the left and the right camera see the board.
        still: how still it stands, 0 to 1.
        edge_px: edge spread of the board, px.
        coverage: for each camera, rows of cells: in how many shots the board covered it.
        progress: held-out errors after each fit.
        expected_mm: predicted error after the next shot, mm.
        missing_shots: predicted number of guided shots until the aim is reached; None where unknown.
        aim_mm: the error aimed at, mm.
        distance_m: at this distance, m.
        good: whether it is good enough.
        missing: what is missing, line by line.
        advice: what is weak in the written calibration, and what to do about it.
        rig: the written rig file; None before.
        command: the command line that does the same with the stored shots.
        drawn: what to draw over the views.
    """

    board: str
    running: bool = False
    fitting: str | None = None
    shots: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
    instruction: str = ""
    seen: tuple[bool, bool] = (False, False)
    still: float = 0.0
    edge_px: float | None = None
    coverage: tuple[tuple[tuple[int, ...], ...], ...] = ()
    progress: tuple[Progress, ...] = ()
    expected_mm: float | None = None
    missing_shots: int | None = None
    aim_mm: float = 0.2
    distance_m: float = 0.8
    good: bool = False
    missing: tuple[str, ...] = ()
    advice: tuple[str, ...] = ()
    rig: str | None = None
    command: str = ""
    drawn: tuple[Drawn, ...] = ()


@dataclass(frozen=True, eq=False)
class _Seen(Record):
    """The board in one shot: detections of both sides, and when, s."""

    left: Detections
    right: Detections
    at_s: float


def quick_look(board: CalibrationBoard, image: np.ndarray, *, thorough: bool = True) -> Detections:
    """Detect a board; a thorough search of the whole image where nothing of it is seen takes long, and may be left out."""
    if isinstance(board, Chessboard) and not thorough:
        small = _shrunk(image, _QUICK_SIDE_PX)
        if not cv2.checkChessboard(small, (board.columns, board.rows)):  # it overlooks boards that are there
            smaller = board.detect(_shrunk(image, _QUICKER_SIDE_PX))
            if smaller.problem is not None:
                return Detections.none(f"{board.body.name} is not in view")
    return board.detect(image)


def _shrunk(image: np.ndarray, side_px: int) -> np.ndarray:
    scale = min(1.0, side_px / max(image.shape))
    return cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)


class CalibrationStep:
    """The guided calibration of one pair of cameras with one board.

    Args:
        folder: folder of the session; shots go to ``calibration`` in it, the result to ``rig.json``.
        spec: of the board.
        aim: what the calibration is to be good for.
        say: called with a note for the person.

    Attributes:
        result: the newest calibration; None before.
        changed: called with a rig once it is written.
    """

    def __init__(self, folder: Path, spec: str, aim: CalibrationAim, say: Callable[[Note], None]) -> None:
        self.folder, self.spec, self.aim, self._say = folder, spec, aim, say
        self.board = open_board(spec)
        self._guide = Guide(self.board)
        self.result: Calibration | None = None
        self.changed: Callable[[StereoRig, Path], None] = lambda rig, path: None
        self._lock = threading.RLock()
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="fit")
        self._shots: dict[str, tuple[Shot, Pair]] = {}
        self._left_out: dict[str, str] = {}
        self._sizes: tuple[tuple[int, int], tuple[int, int]] | None = None
        self._knowledge: Knowledge | None = None
        self._rig: StereoRig | None = None
        self._next: NextPose | None = None
        self._recent: deque[_Seen] = deque(maxlen=12)
        self._writer: ShotFolder | None = None
        self._state = CalibrationState(spec, aim_mm=1e3 * aim.error_m, distance_m=aim.distance_m)
        self._running, self._fitting, self._again, self._forced = False, None, False, False
        self._first = 0  # number of the pose before the first fit
        self._thorough_s = 0.0
        self._must_move, self._rest_s = False, 0.0  # since when the board has not moved on, s
        self._instruction, self._edge_px, self._rig_path = "", None, None
        self._progress: list[Progress] = []
        self._missing_shots: int | None = None
        self._good, self._missing, self._weak = False, ("no shot yet",), ()

    _fitting: str | None
    _edge_px: float | None
    _rig_path: Path | None
    _missing: tuple[str, ...]
    _weak: tuple[str, ...]

    @property
    def state(self) -> CalibrationState:
        """What to show now."""
        with self._lock:
            return self._shown()

    @property
    def outline_uv(self) -> tuple[Array, Array] | None:
        """The board's points as the outline to be reached shows them in both views, (M, 2) each; None without."""
        with self._lock:
            if self._next is None or self._rig is None:
                return None
            return _in_views(self._rig, transform(self._next.T_left_board, self.board.body.points))

    def start(self) -> None:
        """Take shots from now on."""
        with self._lock:
            self._running = True
            self._instruction = "Hold the board so that both cameras see all of it."

    def pause(self) -> None:
        """Take no more shots for now."""
        with self._lock:
            self._running = False

    def force(self) -> None:
        """Take the next shot in which both cameras see the board, whatever its pose."""
        with self._lock:
            if not self._running:
                raise InputError("the calibration is paused: continue it first")
            self._forced = True

    def set_aim(self, aim: CalibrationAim) -> None:
        """Change what the calibration is to be good for."""
        if not (0.0 < aim.error_m < 1.0 and 0.05 <= aim.distance_m <= 20.0):
            raise InputError("the aim must be an error above 0 mm, and a distance from 0.05 to 20 m")
        with self._lock:
            self.aim = aim
            if self.result is not None:
                self._learned(self.result)

    def drop(self, name: str) -> None:
        """Leave out a shot."""
        with self._lock:
            if name not in self._shots:
                raise InputError(f"no shot {name!r}; there are {', '.join(self._shots) or 'none'}")
            self._left_out[name] = "left out by hand"
            del self._shots[name]
            self._fit_soon()

    def finish(self) -> None:
        """Choose the lens model, and write rig.json, in the background.

        Raises:
            InputError: too few shots.
        """
        with self._lock:
            if len(self._shots) < FIRST_FIT:
                raise InputError(
                    f"{len(self._shots)} shots are too few to calibrate; {LEAST_SHOTS} or more are advised"
                )
            self._running = False
            self._fitting = "choosing the lens model by held-out errors"
            self._pool.submit(self._finished)

    def close(self) -> None:
        """End the thread and close the folder."""
        self._pool.shutdown(wait=False, cancel_futures=True)
        if self._writer is not None:
            self._writer.close()

    def look(self, live: LiveShot) -> None:
        """Look at a live shot; take it if it is worth it. Called from one thread."""
        shot = live.shot
        if not self._running or shot.left is None or shot.right is None:
            return
        images = grey(shot.left), grey(shot.right)
        late = live.arrived_s - self._thorough_s > _THOROUGH_S
        if late:
            self._thorough_s = live.arrived_s
        last = self._recent[-1] if self._recent else None
        were = (False, False) if last is None else (last.left.problem is None, last.right.problem is None)
        left, right = (
            quick_look(self.board, image, thorough=late or was) for image, was in zip(images, were, strict=True)
        )
        with self._lock:
            self._sizes = tuple((image.shape[1], image.shape[0]) for image in images)  # type: ignore[assignment]
            seen = _Seen(left, right, live.arrived_s)
            self._recent.append(seen)
            both = left.problem is None and right.problem is None
            self._edge_px = edge_spread_px(_cropped(images[0], left)) if both else None
            still = self._stillness()
            if (still < 1.0 and both) or not any((left.problem is None, right.problem is None)):
                self._rest_s = live.arrived_s
            elif live.arrived_s - self._rest_s > _OTHER_POSE_S and not self._must_move:
                self._rest_s = live.arrived_s
                self._choose(None)
            self._instruction = self._advice(seen, still)
            if both and (self._forced or self._worth_it(seen, still)):
                self._forced = False
                self._take(live, seen)

    def _stillness(self) -> float:
        """Return how still the board stands, 1 is still."""
        newest = self._recent[-1]
        moved, count = 0.0, 0
        for seen in reversed(self._recent):
            if newest.at_s - seen.at_s > max(3 * STILL_S, 1.0):
                break
            for now, then in ((newest.left, seen.left), (newest.right, seen.right)):
                common, a, b = np.intersect1d(now.ids, then.ids, return_indices=True)
                if not len(common):
                    return 0.0
                moved = max(moved, float(np.median(np.linalg.norm(now.uv[a] - then.uv[b], axis=1))))
            count += 1
            if count >= STILL_DETECTIONS and newest.at_s - seen.at_s >= STILL_S:
                break
        enough = min(count / STILL_DETECTIONS, 1.0)
        return enough * min(1.0, STILL_PX / max(moved, 1e-6))

    def _advice(self, seen: _Seen, still: float) -> str:
        """Return what the person should do now."""
        sees = seen.left.problem is None, seen.right.problem is None
        if not any(sees):
            return "Hold the board so that both cameras see all of it."
        if not all(sees):
            side = "right" if sees[0] else "left"
            why = (seen.right if sees[0] else seen.left).problem or ""
            more = "" if "not in view" in why else f" ({why})"
            return f"The {side} camera does not see all of the board{more}: move it into both views."
        if self._must_move:
            return "Taken. Move the board to the outline."
        if self._edge_px is not None and self._edge_px > _SHARP_SHOT_PX:
            return f"The board is not sharp ({self._edge_px:.1f} px): more light, shorter exposure, or focus."
        if self._next is not None and not self._useful(seen):
            return "Move the board to the outline, in both views."
        return "Hold still." if still < 1.0 else "Good."

    def _useful(self, seen: _Seen) -> bool:
        """Return whether a shot of the board where it is now is worth taking."""
        if self._knowledge is None:
            return self._differs(seen)
        T = self._pose(seen)
        if T is None or self._next is None:
            return False
        now = self._knowledge.error_m
        then = float(self._knowledge.errors_after_m(T[None])[0])
        worth = _PATIENT_WORTH if seen.at_s - self._rest_s > _PATIENT_S else _WORTH
        return now - then >= worth * (now - self._next.then_m) and self._differs(seen)

    def _differs(self, seen: _Seen) -> bool:
        """Return whether the board is elsewhere than in all shots before, or rotated."""
        for _, pair in self._shots.values():
            common, a, b = np.intersect1d(seen.left.ids, pair.left.ids, return_indices=True)
            if not len(common):
                continue
            now, then = seen.left.uv[a], pair.left.uv[b]
            size = float(np.linalg.norm(np.ptp(then, axis=0))) * (1.0 if self._knowledge is None else 0.3)
            # A rotation changes the shape of the image, a motion its position.
            if np.linalg.norm(now - then, axis=1).mean() < _OTHER_SHARE * size:
                return False
        return True

    def _worth_it(self, seen: _Seen, still: float) -> bool:
        """Return whether to take this shot by itself."""
        if still < 1.0:
            self._must_move = self._must_move and still > 0.6
            return False
        if self._must_move or (self._edge_px is not None and self._edge_px > _SHARP_SHOT_PX):
            return False
        return self._useful(seen)

    def _pose(self, seen: _Seen) -> Array | None:
        """Return the board's pose in the left camera's frame as the left view shows it; None where it does not."""
        if self._rig is None:
            return None
        found = body_poses(self.board.body.points[seen.left.ids], self._rig.left, seen.left.uv)
        return found[0][0] if found else None

    def _take(self, live: LiveShot, seen: _Seen) -> None:
        """Store a shot, and go on to the next pose."""
        name = f"{len(self._shots) + len(self._left_out) + 1:02d}"
        try:
            if self._writer is None:
                self._writer = ShotFolder(_fresh(self.folder, "calibration"))
            self._writer.add(live.shot)
        except ArmsightError as error:
            self._running = False
            self._say(Note("error", f"the shot cannot be stored, the calibration is paused: {error}"))
            return
        self._shots[name] = (live.shot, Pair(name, seen.left, seen.right))
        self._must_move = True
        if self._knowledge is not None and (T := self._pose(seen)) is not None:
            self._knowledge = self._knowledge.after(T)
        self._say(Note("good", f"shot {name} taken"))
        self._choose(seen)
        self._fit_soon()

    def _choose(self, seen: _Seen | None) -> None:
        """Choose the next pose."""
        if self._knowledge is not None and self._rig is not None:
            self._next = self._guide.best(self._knowledge, self._rig)
            self._missing_shots = self._guide.shots_missing(self._knowledge, self._rig, self.aim)
        elif seen is None and self._rig is not None:
            self._first += 1
            self._next = self._guide.first(self._first, self._rig)
        elif seen is not None and self._sizes is not None:
            points = self.board.body.points
            cameras = [guessed_camera(size) for size in self._sizes]
            poses = [body_poses(points[d.ids], c, d.uv) for c, d in zip(cameras, (seen.left, seen.right), strict=True)]
            if all(poses):
                self._rig = guessed_rig(self._sizes, poses[0][0][0] @ inverse(poses[1][0][0]))
                self._first += 1
                self._next = self._guide.first(self._first, self._rig)

    def _fit_soon(self) -> None:
        """Fit all shots in the background, if there are enough; once more afterwards if shots came meanwhile."""
        if len(self._shots) < FIRST_FIT:
            return
        if self._fitting is not None:
            self._again = True
            return
        self._fitting = "fitting"
        self._pool.submit(self._fit)

    def _fit(self) -> None:
        """Fit the shots taken so far, in the thread."""
        with self._lock:
            pairs, sizes = [pair for _, pair in self._shots.values()], self._sizes
        assert sizes is not None
        try:
            result = calibrate_boards(self.board, pairs, sizes, models=_QUICK_MODELS, folds=min(_FOLDS, len(pairs)))
            require_order(result)
            with self._lock:
                self._learned(result)
                self._add_newer({pair.name for pair in pairs})
                self._choose(None)
        except (CalibrationError, np.linalg.LinAlgError) as error:
            self._missing, self._good = (f"the shots cannot be fitted yet: {error}",), False
        except Exception as error:  # noqa: BLE001 - nobody else watches this thread
            self._say(Note("error", f"the fit failed: {type(error).__name__}: {error}"))
        with self._lock:
            self._fitted()

    def _add_newer(self, fitted: set[str]) -> None:
        """Add what the shots determine that came while the others were fitted."""
        for name, (_, pair) in self._shots.items():
            T = None if name in fitted else self._pose(_Seen(pair.left, pair.right, 0.0))
            if T is not None and self._knowledge is not None:
                self._knowledge = self._knowledge.after(T)

    def _fitted(self) -> None:
        self._fitting = None
        if self._again:
            self._again = False
            self._fit_soon()

    def _learned(self, result: Calibration) -> None:
        """Take in a fit: what it determines, and how good it is."""
        self.result, self._rig = result, result.rig
        self._knowledge = Knowledge.of(result, self.board, self.aim)
        h, shots = result.heldout, result.pairs_found
        floor = h.rigid_rms_m / h.over_noise_rms if h.over_noise_rms > 0 else float("nan")
        error_m = self._knowledge.error_m
        new = Progress(shots, 1e3 * h.rigid_rms_m, h.epipolar_rms_px, 1e3 * floor, 1e3 * error_m)
        self._progress = [*(each for each in self._progress if each.shots < shots), new]
        for rejected in result.rejected:
            if rejected.pair not in self._left_out:
                self._say(Note("warn", f"shot {rejected.pair} is left out: {rejected.reason}"))
                self._left_out[rejected.pair] = rejected.reason
        self._missing = self._lacking(result, error_m)
        self._good = not self._missing

    def _lacking(self, result: Calibration, error_m: float) -> tuple[str, ...]:
        """Return what is missing until the calibration is good enough, line by line."""
        lines = []
        if len(result.pairs) < LEAST_SHOTS:
            lines.append(f"{_more(LEAST_SHOTS - len(result.pairs))}, so that the held-out errors mean something")
        if error_m > self.aim.error_m:
            lines.append(
                f"predicted error {1e3 * error_m:.2g} mm, {1e3 * self.aim.error_m:g} mm is the aim: more shots"
            )
        lines += [f"{row.name} {row.heldout}: {row.advice}" for row in graded_metrics(result) if row.grade == "poor"]
        return tuple(lines)

    def _finished(self) -> None:
        """Fit with all lens models and write the rig, in the thread."""
        with self._lock:
            pairs, sizes = [pair for _, pair in self._shots.values()], self._sizes
        assert sizes is not None
        path = self.folder / "rig.json"
        try:
            result = calibrate_boards(self.board, pairs, sizes, models=MODELS)
            require_order(result)
            record = provenance({"target": self.spec, "command": self._command()}, result)
            rig = StereoRig(
                result.rig.left, result.rig.right, result.rig.T_left_right, result.rig.cov, result.rig.sigma_px, record
            )
            rig.save(path)
        except (ArmsightError, np.linalg.LinAlgError) as error:
            self._say(Note("error", f"no rig was written: {error}"))
            with self._lock:
                self._fitting = None
            return
        with self._lock:
            self._learned(result)
            self._rig_path, self._fitting, self._weak = path, None, tuple(advice(result))
        assessment = assess(result)
        text = (
            f"{assessment.headline} {1e3 * result.heldout.rigid_rms_m:.2g} mm RMS on held-out pairs; written to {path}"
        )
        self._say(Note("good" if assessment.grade == "good" else "hint", text))
        self.changed(rig, path)

    def _command(self) -> str:
        """Return the command line that does the same with the stored shots."""
        folder = self.folder / "calibration" if self._writer is None else self._writer.folder
        out = self.folder / "rig.json"
        return f"armsight calibrate --left '{folder}/left*.png' --right '{folder}/right*.png' --target {self.spec} -o {out}"

    def _shown(self) -> CalibrationState:
        """Return the state as it is now."""
        newest = self._recent[-1] if self._recent else None
        if newest is not None and time.monotonic() - newest.at_s > _GONE_S:
            newest = None
        seen = (False, False) if newest is None else (newest.left.problem is None, newest.right.problem is None)
        expected = None if self._next is None else 1e3 * self._next.then_m
        return CalibrationState(
            self.spec,
            self._running,
            self._fitting,
            tuple(self._shots),
            tuple(f"shot {name}: {reason}" for name, reason in self._left_out.items()),
            self._instruction if self._running else "",
            seen,
            0.0 if newest is None else self._stillness(),
            self._edge_px,
            self._coverage(),
            tuple(self._progress),
            expected,
            self._missing_shots,
            1e3 * self.aim.error_m,
            self.aim.distance_m,
            self._good,
            self._missing,
            self._weak,
            None if self._rig_path is None else str(self._rig_path),
            self._command(),
            self._drawings(newest) if self._running else (),
        )

    def _coverage(self) -> tuple[tuple[tuple[int, ...], ...], ...]:
        """Return, for each camera, rows of cells: in how many shots corners of the board were in it."""
        if self._sizes is None:
            return ()
        columns, rows = CELLS
        counts = np.zeros((2, rows, columns), int)
        for _, pair in self._shots.values():
            for side, found in enumerate((pair.left, pair.right)):
                width, height = self._sizes[side]
                c = np.clip(found.uv[:, 0] / width * columns, 0, columns - 1).astype(int)
                r = np.clip(found.uv[:, 1] / height * rows, 0, rows - 1).astype(int)
                hit = np.zeros((rows, columns), bool)
                hit[r, c] = True
                counts[side] += hit
        return tuple(tuple(tuple(int(n) for n in row) for row in side) for side in counts)

    def _drawings(self, newest: _Seen | None) -> tuple[Drawn, ...]:
        """Return the outline to be reached, and the corners that are seen."""
        drawn = []
        if self._next is not None and self._rig is not None:
            views = _in_views(self._rig, transform(self._next.T_left_board, self._guide.outline))
            first = _in_views(self._rig, transform(self._next.T_left_board, self.board.body.points[:1]))
            drawn += [
                Drawn(side, "next", (polyline(uv, closed=True), polyline(dot)))
                for side, (uv, dot) in enumerate(zip(views, first, strict=True))
            ]
        if newest is not None and self._stillness() > _DRAWN_STILL:  # of a board that moves they would lag behind
            for side, found in enumerate((newest.left, newest.right)):
                if found.problem is None:
                    drawn.append(Drawn(side, "seen", tuple(polyline(uv[None]) for uv in found.uv)))
        return tuple(drawn)


def _more(count: int) -> str:
    return "1 more shot" if count == 1 else f"{count} more shots"


def _in_views(rig: StereoRig, p_left: Array) -> tuple[Array, Array]:
    """Return points (N, 3) as both cameras see them, (N, 2) each."""
    return rig.left.project(p_left), rig.right.project(transform(inverse(rig.T_left_right), p_left))


def _cropped(image: np.ndarray, found: Detections) -> np.ndarray:
    """Return the part of an image that a board covers."""
    (left, top), (right, bottom) = found.uv.min(axis=0).astype(int), found.uv.max(axis=0).astype(int) + 1
    return image[max(top, 0) : bottom, max(left, 0) : right]


def _fresh(folder: Path, name: str) -> Path:
    """Return the first of NAME, NAME-2, NAME-3 ... that is not there yet."""
    path, number = folder / name, 1
    while path.exists():
        number += 1
        path = folder / f"{name}-{number}"
    return path
