"""The body that is measured: drawn to scale, and checked before it is built.

In: a body file or a board's spec. Out: a :class:`BodyState`, and a PDF in the folder of the session. What is checked is
what ``armsight body check`` checks, with the session's own rig once there is one.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from armsight.app.body.check import assess
from armsight.app.body.draw import draw_body, is_board_spec
from armsight.app.body.text import body_report
from armsight.app.show.messages import Note
from armsight.errors import ArmsightError
from armsight.vision.markers.body_layout import read_layout
from armsight.vision.markers.targets import open_target
from armsight.vision.pose.predict import plain_rig
from armsight.vision.rig import StereoRig

_DISTANCES_M = (0.6, 0.8, 1.2)


@dataclass(frozen=True)
class BodyState:
    """What a page shows of the body.

    Attributes:
        target: body file or spec of a board; None without one.
        points: how many points it has.
        size_mm: its extent along its axes, mm.
        working: what is being computed; None while nothing is.
        lines: the assessment, as ``armsight body check`` prints it.
        grade: usable, weak or bad; empty where nothing was assessed.
        drawing: the PDF; None before it is drawn.
        command: the command lines that do the same.
    """

    target: str | None = None
    points: int = 0
    size_mm: tuple[float, ...] = ()
    working: str | None = None
    lines: tuple[str, ...] = ()
    grade: str = ""
    drawing: str | None = None
    command: str = ""


class BodyStep:
    """Assesses and draws one body.

    Args:
        folder: of the session.
        say: called with a note for the person.
    """

    def __init__(self, folder: Path, say: Callable[[Note], None]) -> None:
        self.folder, self._say = folder, say
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="body")
        self._state = BodyState()

    @property
    def state(self) -> BodyState:
        """What to show now."""
        return self._state

    def use(self, target: str, rig: tuple[StereoRig, Path] | None) -> None:
        """Take a body, and assess it in the background.

        Args:
            target: a body file or the spec of a board.
            rig: the calibrated cameras and their file; two perfect HD cameras by default.

        Raises:
            InputError: it is neither.
        """
        points = open_target(target).body.points
        size = tuple(float(1e3 * x) for x in points.max(axis=0) - points.min(axis=0))
        at = f" --rig {rig[1]}" if rig is not None else ""
        check = "" if is_board_spec(target) else f"armsight body check {target}{at}; "
        command = f"{check}armsight body draw {target} -o {self.folder}/body.pdf"
        working = None if is_board_spec(target) else "assessing"
        self._state = BodyState(target, len(points), size, working, command=command)
        if working is not None:
            self._pool.submit(self._assess, target, rig)

    def _assess(self, target: str, rig: tuple[StereoRig, Path] | None) -> None:
        begun = self._state
        lines: tuple[str, ...]
        try:
            layout = read_layout(target)
            cameras = plain_rig() if rig is None else rig[0]
            found = assess(layout, cameras, _DISTANCES_M)
            report = body_report(target, layout, cameras, None if rig is None else str(rig[1]), found)
            lines, grade = tuple(report.text().splitlines()), str(found.grade)
        except ArmsightError as error:
            lines, grade = (str(error),), "bad"
        if self._state is begun:
            self._state = BodyState(
                begun.target, begun.points, begun.size_mm, None, lines, grade, begun.drawing, begun.command
            )

    def draw(self, target: str, name: str, paper: str) -> None:
        """Draw a body or a board to NAME.pdf in the background."""
        self._pool.submit(self._draw, target, self.folder / f"{name}.pdf", paper)

    def _draw(self, target: str, path: Path, paper: str) -> None:
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            drawing = draw_body(target, path, paper=paper, split=True)
        except (ArmsightError, OSError) as error:
            self._say(Note("error", f"the drawing cannot be made: {error}"))
            return
        for note in drawing.notes:
            self._say(Note("hint", note))
        self._say(Note("good", f"drawn to {path}: print at 100%, and measure the bar"))
        now = self._state
        if path.stem == "body":
            self._state = BodyState(
                now.target, now.points, now.size_mm, now.working, now.lines, now.grade, str(path), now.command
            )

    def close(self) -> None:
        """End the thread."""
        self._pool.shutdown(wait=False, cancel_futures=True)
