"""What goes on beside a loop that must not pause: long work, and looking at images."""

from __future__ import annotations

import contextlib
import gc
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import TypeVar

from armsight.data import JointCommand, Missed, PoseEstimate, Shot
from armsight.loop.estimators import Estimator

#: How long one thread may keep the interpreter, s: a turn of the loop takes it back a dozen times, and with the usual 5 ms
#: would last longer than boards wait for commands.
SWITCH_S = 2e-4
_Result = TypeVar("_Result")


class Still:
    """A controller that sends the same command again and again.

    Args:
        held: it.
    """

    def __init__(self, held: JointCommand) -> None:
        self._held = held

    def prepare(self, t_s: float) -> None:
        """Do nothing: it is ready."""

    def command(self, estimator: Estimator) -> tuple[JointCommand, str]:
        """Return the command."""
        return self._held, "planned"


def beside(work: Callable[[], _Result], meanwhile: Callable[[Callable[[], bool]], None]) -> _Result:
    """Return what some long work comes to.

    Args:
        work: done in a thread of its own.
        meanwhile: goes on in this one; it is handed a function that says whether the work is done, and returns then.

    Raises:
        Exception: what either of them raises; the work is not waited for where it was ``meanwhile`` or the keyboard.
    """
    pool = ThreadPoolExecutor(1)
    try:
        done = pool.submit(work)
        meanwhile(done.done)
        return done.result()
    finally:
        pool.shutdown(wait=False)


class Watch:
    """Measures shots in a thread: where the body has to be searched for, that takes longer than a loop may pause.

    Args:
        measure: what is seen in a shot.
        patience_s: so long a result is waited for; then it is handed out a turn later.
    """

    def __init__(self, measure: Callable[[Shot], PoseEstimate | Missed], patience_s: float) -> None:
        self._measure, self._patience_s = measure, patience_s
        self._pool = ThreadPoolExecutor(1)
        self._work: Future[PoseEstimate | Missed] | None = None
        self._shot: Shot | None = None

    def take(self, poll: Callable[[], Shot | None]) -> tuple[Shot, PoseEstimate | Missed] | None:
        """Begin with the newest shot where none is being looked at, and return what came of one, where it is known."""
        if self._work is None:
            self._shot = poll()
            if self._shot is None:
                return None
            self._work = self._pool.submit(self._measure, self._shot)
        wait([self._work], self._patience_s)
        if not self._work.done():
            return None
        work, self._work = self._work, None
        return None if self._shot is None else (self._shot, work.result())

    @property
    def busy(self) -> bool:
        """Whether a shot is being looked at."""
        return self._work is not None

    def forget(self) -> None:
        """Do not hand out what comes of the shot that is being looked at."""
        self._shot = None


@contextlib.contextmanager
def steady(*, in_time: bool) -> Iterator[None]:
    """Keep the interpreter from making a loop wait.

    The collector of garbage, which looks through all there is in 0.1 s and more, is left out: what a loop makes refers to
    nothing in circles, and goes by itself.

    Args:
        in_time: whether time passes by itself: then threads take turns often, at some cost.
    """
    before, collects = sys.getswitchinterval(), gc.isenabled()
    gc.disable()
    if in_time:
        sys.setswitchinterval(SWITCH_S)
    try:
        yield
    finally:
        sys.setswitchinterval(before)
        if collects:
            gc.enable()
