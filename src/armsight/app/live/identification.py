"""Kinematic identification on the page: from the poses of the hand-eye calibration to a corrected arm.

In: the nominal arm and a table of poses. Out: an :class:`IdentifyState`, and the files of ``armsight identify`` in the
folder of the session. It runs in a thread of its own.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

from armsight.app.identify.report import identify_report, write_results
from armsight.app.identify.run import run_identify
from armsight.app.show.messages import Note
from armsight.app.show.plotting import require_matplotlib
from armsight.errors import ArmsightError, InputError
from armsight.loop.identify.read import read_poses
from armsight.robot.arm_file import open_arm


@dataclass(frozen=True)
class IdentifyState:
    """What a page shows of the identification.

    Attributes:
        working: what is being done; None while nothing is.
        headline: held-out errors of the nominal and of the identified arm, one line; empty before.
        lines: the result as ``armsight identify`` prints it.
        corrected: the corrected arm's file; None before.
        command: the command line that does the same.
    """

    working: str | None = None
    headline: str = ""
    lines: tuple[str, ...] = ()
    corrected: str | None = None
    command: str = ""


class IdentifyStep:
    """Identifies one arm at a time.

    Args:
        folder: of the session; results go to ``identify``, ``identify-2``, ... in it.
        say: called with a note for the person.
    """

    def __init__(self, folder: Path, say: Callable[[Note], None]) -> None:
        self.folder, self._say = folder, say
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="identify")
        self.state = IdentifyState()

    def start(self, arm_spec: str, poses: Path | None) -> None:
        """Identify an arm from a table of poses, in the background.

        Raises:
            InputError: there are no poses yet, or an identification runs.
        """
        if poses is None:
            raise InputError("no poses yet: make the hand-eye calibration first, its poses are used")
        if self.state.working is not None:
            raise InputError("an identification runs already")
        require_matplotlib()
        number, out = 1, self.folder / "identify"
        while out.exists():
            number += 1
            out = self.folder / f"identify-{number}"
        self.state = IdentifyState("reading", command=f"armsight identify --arm {arm_spec} --data {poses} -o {out}")
        self._pool.submit(self._identify, arm_spec, poses, out)

    def _progress(self, line: str) -> None:
        self.state = replace(self.state, working=line)

    def _identify(self, arm_spec: str, poses: Path, out: Path) -> None:
        try:
            read = read_poses(poses)
            run = run_identify(
                open_arm(arm_spec), read.measured, read.lines, None, notes=read.notes, progress=self._progress
            )
            report = identify_report(run)
            write_results(run, report, out)
            lines = (*(f"note: {note}" for note in run.notes), *report.text().splitlines()[1:])
            corrected = str(out / "corrected.toml")
            self.state = replace(self.state, headline=report.headline, lines=lines, corrected=corrected)
            report.write(out)  # last: what was found is shown and stored before anything is drawn
        except Exception as error:  # noqa: BLE001 - nobody else watches this thread
            why = str(error) if isinstance(error, ArmsightError) else f"{type(error).__name__}: {error}"
            what = "the report was not drawn" if self.state.corrected else "no arm was identified"
            self._say(Note("error", f"{what}: {why}"))
            self.state = replace(self.state, working=None)
            return
        self.state = replace(self.state, working=None)
        self._say(Note("good", f"identified: {report.headline}; written to {out}"))

    def close(self) -> None:
        """End the thread."""
        self._pool.shutdown(wait=False, cancel_futures=True)
