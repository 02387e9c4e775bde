"""Kinematic identification on the page: from the poses of the hand-eye calibration to a corrected arm.

In: the nominal arm and a table of poses. Out: an :class:`IdentifyState`, and the files of ``armsight identify`` in the
folder of the session.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from armsight.app.identify.report import identify_report, write_results
from armsight.app.identify.run import run_identify
from armsight.app.live.step import PageStep
from armsight.app.show.plotting import require_matplotlib
from armsight.app.show.report import Report
from armsight.errors import InputError
from armsight.files import unused
from armsight.loop.identify.read import read_poses
from armsight.robot.arm_file import open_arm


@dataclass(frozen=True)
class IdentifyState:
    """What a page shows of the identification."""

    working: str | None = None  # what is being done
    headline: str = ""  # held-out errors of the nominal and of the identified arm
    lines: tuple[str, ...] = ()  # the result as ``armsight identify`` prints it
    corrected: str | None = None  # the corrected arm's file
    command: str = ""  # the command line that does the same


class IdentifyStep(PageStep[IdentifyState]):
    """Identifies one arm at a time; results go to ``identify``, ``identify-2``, ... in the folder of the session."""

    def start(self, arm_spec: str, poses: Path | None) -> None:
        """Identify an arm from a table of poses, in the background."""
        if poses is None:
            raise InputError("no poses yet: make the hand-eye calibration first, its poses are used")
        if self.shown.working is not None:
            raise InputError("an identification runs already")
        require_matplotlib()
        out = unused(self.folder / "identify")
        self.shown = IdentifyState("reading", command=f"armsight identify --arm {arm_spec} --data {poses} -o {out}")
        self.later("no arm was identified", self._identify, arm_spec, poses, out)

    def _identify(self, arm_spec: str, poses: Path, out: Path) -> None:
        try:
            read, arm = read_poses(poses), open_arm(arm_spec)
            progress = lambda line: self.show(working=line)  # noqa: E731
            run = run_identify(arm, read.measured, read.lines, None, notes=read.notes, progress=progress)
            report = identify_report(run)
            write_results(run, report, out)
        finally:
            self.show(working=None)
        lines = (
            *(f"note: {note}" for note in run.notes),
            *(line for line in report.text().splitlines() if line != report.headline),
        )
        self.show(headline=report.headline, lines=lines, corrected=str(out / "corrected.toml"))
        self.later("the report was not drawn", self._draw, report, out)  # what was found is shown before

    def _draw(self, report: Report, out: Path) -> None:
        report.write(out)
        self.say("good", f"identified: {report.headline}; written to {out}")
