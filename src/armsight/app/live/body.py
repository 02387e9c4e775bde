"""What is printed: the calibration board, and the body that is measured; drawn to scale, the body checked before."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from armsight.app.body.check import assess
from armsight.app.body.draw import draw_body, is_board_spec
from armsight.app.body.text import body_report
from armsight.app.live.calibration import CalibrationStep
from armsight.app.live.capture import LiveShot
from armsight.app.live.measuring import MeasureStep
from armsight.app.live.records import asked
from armsight.app.live.step import PageStep, S, Shared
from armsight.errors import ArmsightError, InputError
from armsight.vision.calibrate.guide import CalibrationAim
from armsight.vision.image import grey
from armsight.vision.markers.board import BOARDS, board_in_view, open_board
from armsight.vision.markers.targets import open_target, read_layout
from armsight.vision.pose.predict import plain_rig
from armsight.vision.rig import StereoRig

_DISTANCES_M = (0.6, 0.8, 1.2)
_BAR_MM = 100.0  # the bar on a drawing
_LOOK_S = 2.0  # between two searches for an unknown board; half: one core is busy with it, double: a person waits


class _Drawn(PageStep[S]):
    def draw(self, target: str, name: str, paper: str) -> None:
        self.later("the drawing cannot be made", self._draw, target, self.folder / f"{name}.pdf", paper)

    def _draw(self, target: str, path: Path, paper: str) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        for note in draw_body([target], path, paper=paper, split=True).notes:
            self.say("hint", note)
        self.say("good", f"drawn to {path}: print at 100%, and measure the bar")
        self.show(drawing=str(path))


@dataclass(frozen=True)
class BoardChoice:
    """The calibration board."""

    spec: str = ""  # as it is used
    size_mm: tuple[float, float] = (0.0, 0.0)  # from the first to the last point
    points: int = 0
    drawing: str | None = None
    measured_mm: float | None = None  # length of the bar on the print; None where nobody measured it
    seen: str = ""  # the board that both cameras show, with usual lengths; empty where none was recognised
    used: bool = False  # it is the one in use
    forms: tuple[str, ...] = tuple(form for form, _ in BOARDS.values())  # how boards are named
    command: str = ""  # the command line that draws it


class BoardStep(_Drawn[BoardChoice]):
    """Chooses the board, and has the calibration by it; ``changed`` is called with a rig once it is written."""

    def __init__(self, shared: Shared, spec: str, changed: Callable[[StereoRig, Path], None]) -> None:
        super().__init__(shared, BoardChoice())
        self._changed = changed
        self._named = shared.options.calibration_board is not None or shared.simulated is not None
        self._last, self._looked_s = "", 0.0
        self.calibration = self._begin(spec, CalibrationAim())

    def _begin(self, spec: str, aim: CalibrationAim) -> CalibrationStep:
        step = CalibrationStep(self.shared, spec, aim, self._changed)
        width, height, _ = 1e3 * np.ptp(step.board.body.points, axis=0)
        command = f"armsight body draw {spec} -o {self.folder}/board.pdf"
        self.show(spec=spec, size_mm=(width, height), points=len(step.board.body.points), command=command)
        return step

    @asked("board", rest=True)
    def use_board(self, spec: str, measured_mm: float = 0.0) -> None:
        """Use another calibration board; ``measured_mm`` is the length of the printed bar, 0 where nobody measured it."""
        board = open_board(spec)
        if measured_mm and not 0.8 * _BAR_MM < measured_mm < 1.2 * _BAR_MM:
            raise InputError(f"the printed bar is {_BAR_MM:g} mm long as drawn; {measured_mm:g} mm cannot be right")
        self._named = True
        self._use(scaled_spec(spec, measured_mm / _BAR_MM) if measured_mm else spec)
        self.show(measured_mm=measured_mm or None)
        self.say("good", f"board: {board.body.name}")

    def _use(self, spec: str) -> None:
        before = self.calibration
        self.calibration = self._begin(spec, before.aim)
        before.close()

    def look(self, live: LiveShot) -> None:
        """Find out which board both cameras show, and use it where nobody named one. Called from one thread."""
        left, right = live.shot.left, live.shot.right
        if left is None or right is None or live.arrived_s - self._looked_s < _LOOK_S:
            return
        boards = [board_in_view(grey(image)) for image in (left, right)]
        self._looked_s = time.monotonic()
        names = {"" if board is None else board.body.name for board in boards}
        seen, before = names.pop() if len(names) == 1 else "", self._last
        self._last = seen
        if seen != before:
            return
        if seen and not self._named and not _alike(seen, self.calibration.board.body.name):
            self._use(seen)
            self.say("hint", f"{seen} is in view and used; its lengths cannot be seen: measure and correct them")
        self.show(seen=seen, used=_alike(seen, self.calibration.board.body.name))

    @asked("board")
    def draw_board(self, paper: str = "a4") -> None:
        """Draw the calibration board as a PDF to scale."""
        self.draw(self.shown.spec, "board", paper)

    def close(self) -> None:
        """End the threads."""
        super().close()
        self.calibration.close()


def _alike(spec: str, other: str) -> bool:
    """Return whether two boards are of one kind and have as many points along their sides."""
    (kind, counts), (other_kind, other_counts) = ((*each.split(":"), "")[:2] for each in (spec, other))
    return kind == other_kind and sorted(counts.split("x")) == sorted(other_counts.split("x"))


def scaled_spec(spec: str, factor: float) -> str:
    """Return a board's spec with its lengths multiplied: as it was printed."""
    kind, *fields = spec.split(":")
    scaled = []
    for field in fields:
        for unit in ("mm", "cm", "in", "m"):
            number = field.removesuffix(unit)
            if field.endswith(unit) and number.replace(".", "", 1).isdigit():
                field = f"{float(number) * factor:.6g}{unit}"
                break
        scaled.append(field)
    return ":".join((kind, *scaled))


@dataclass(frozen=True)
class BodyState:
    """What a page shows of the body."""

    target: str | None = None  # body file or spec of a board
    points: int = 0
    size_mm: tuple[float, ...] = ()  # its extent along its axes
    working: str | None = None  # what is being computed
    lines: tuple[str, ...] = ()  # the assessment, as ``armsight body check`` prints it
    grade: str = ""  # usable, weak or bad; empty where nothing was assessed
    drawing: str | None = None
    command: str = ""  # the command lines that do the same


class BodyStep(_Drawn[BodyState]):
    """Assesses and draws one body, and has it measured."""

    def __init__(self, shared: Shared, measuring: MeasureStep) -> None:
        super().__init__(shared, BodyState())
        self._measuring = measuring

    @asked("body", rest=True)
    def use_body(self, target: str) -> None:
        """Use a body file, or the board, as what is measured; it is assessed in the background."""
        points = open_target(target).body.points
        self._measuring.use_target(target)
        size = tuple(float(1e3 * x) for x in np.ptp(points, axis=0))
        draw, rig_path = f"armsight body draw {target} -o {self.folder}/body.pdf", self._measuring.rig_path
        if is_board_spec(target):
            self.shown = BodyState(target, len(points), size, command=draw)
            return
        at = "" if rig_path is None else f" --rig {rig_path}"
        command = f"armsight body check {target}{at}; {draw}"
        self.shown = BodyState(target, len(points), size, "assessing", command=command)
        self.later("the body was not assessed", self._assess, target, self._measuring.rig, rig_path)

    def _assess(self, target: str, rig: StereoRig | None, path: Path | None) -> None:
        lines: list[str]
        try:
            layout, cameras = read_layout(target), plain_rig() if rig is None else rig
            found = assess(layout, cameras, _DISTANCES_M)
            lines = body_report(target, layout, cameras, None if rig is None else str(path), found).text().splitlines()
            grade = str(found.grade)
        except ArmsightError as error:
            lines, grade = [str(error)], "bad"
        with self.lock:
            if self.shown.target == target:  # no other one was chosen meanwhile
                self.shown = replace(self.shown, working=None, lines=tuple(lines), grade=grade)

    @asked("body")
    def draw_body(self, paper: str = "a4") -> None:
        """Draw the body as a PDF to scale."""
        if self.shown.target is None:
            raise InputError("no body yet: choose one first")
        self.draw(self.shown.target, "body", paper)
