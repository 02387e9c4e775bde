"""What a step of the page is: it shows a frozen record, does what commands ask of its methods, and works in the background.

In: what all steps share. A step is one class: the methods under ``@asked`` are its commands, ``state`` is the record that
the page shows of it, :meth:`PageStep.later` does in a thread of its own what takes long.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Generic, TypeVar

from armsight.app.live.capture import CameraCapture
from armsight.app.run.motion_file import DEFAULT_MOTION
from armsight.app.show.messages import Level
from armsight.errors import ArmsightError
from armsight.sim.workcell.person import SimulatedCameras

S = TypeVar("S")


@dataclass(frozen=True)
class SessionOptions:
    """What the command line says (``armsight live -h``)."""

    folder: Path
    source: str | None = None
    rig: Path | None = None
    target: str | None = None
    calibration_board: str | None = None
    board: str | None = None
    arm: str = "six_r"
    motion: Path | None = None
    sync_s: float = 1e-3  # standard deviation of the time between the two exposures of a shot
    seed: int = 0
    servo_calibration: Path | None = None  # of a servo bus that the page finds
    streams: tuple[str, ...] = ()
    follow_rig: bool = False


@dataclass(eq=False)
class Shared:
    """What the steps of a session share: options, cameras as they are now, the workcell, and the ear of a person."""

    options: SessionOptions
    folder: Path
    say: Callable[[Level, str], None]
    source: str = ""
    capture: CameraCapture = field(init=False)
    motion: Path = DEFAULT_MOTION  # file of the motions
    simulated: SimulatedCameras | None = None
    hold: Callable[[str], None] = lambda why: None  # brings the arm to rest


class PageStep(Generic[S]):
    """One step of the page; ``shown`` is the record that it shows."""

    def __init__(self, shared: Shared, shown: S) -> None:
        self.shared, self.folder, self.say, self.shown = shared, shared.folder, shared.say, shown
        self.lock = threading.RLock()
        self._pool = ThreadPoolExecutor(1, thread_name_prefix=type(self).__name__)

    @property
    def state(self) -> S:
        """What to show now."""
        with self.lock:
            return self.now()

    def now(self) -> S:
        """Return what is shown, with what follows from the moment; called under the lock."""
        return self.shown

    def show(self, **values: Any) -> None:  # noqa: ANN401 - of the fields' types
        """Change fields of what is shown."""
        with self.lock:
            self.shown = replace(self.shown, **values)  # type: ignore[type-var]

    def warn(self, line: str) -> None:
        """Pass a line about a recording or a stream on to the person."""
        self.say("warn", line.removeprefix("note: "))

    def later(self, failure: str, work: Callable[..., None], *given: object) -> None:
        """Do something in the background; what goes wrong is said after the words ``failure``."""

        def watched() -> None:
            try:
                work(*given)
            except Exception as error:  # noqa: BLE001 - nobody else watches this thread
                self.say("error", f"{failure}: {why(error)}")

        with contextlib.suppress(RuntimeError):  # the step was closed meanwhile
            self._pool.submit(watched)

    def close(self) -> None:
        """End the thread."""
        self._pool.shutdown(wait=False, cancel_futures=True)


@dataclass(frozen=True)
class GuidedState:
    """What a page shows of a calibration that says what to measure next."""

    fitting: str | None = None  # what the fit is doing
    progress: tuple[Any, ...] = ()  # the errors after each fit
    good: bool = False  # good enough
    missing: tuple[str, ...] = ()  # what is missing until it is


G = TypeVar("G", bound=GuidedState)


class Guided(PageStep[G]):
    """A calibration that is fitted again and again in the background, while it says what to measure next."""

    what, _again = "the", False

    def fit(self) -> None:
        """Fit what was measured so far."""
        raise NotImplementedError

    def fit_soon(self) -> None:
        """Fit in the background; once more afterwards if more was measured meanwhile."""
        with self.lock:
            self._again = self.shown.fitting is not None
            if not self._again:
                self.show(fitting="fitting")
                self.later(f"{self.what} fit failed", self._fit)

    def _fit(self) -> None:
        try:
            self.fit()
        finally:
            with self.lock:
                self.show(fitting=None)
                if self._again:
                    self.fit_soon()

    def learned(self, count: int, new: Any) -> None:  # noqa: ANN401 - a record of errors
        """Show the errors of a fit to so many shots or poses; they begin with the count."""
        self.show(progress=(*(each for each in self.shown.progress if next(iter(vars(each).values())) < count), new))


def why(error: Exception) -> str:
    """Return what went wrong: the message of an error of ours, of another one its kind too."""
    return str(error) if isinstance(error, ArmsightError) else f"{type(error).__name__}: {error}"
