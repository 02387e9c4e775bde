"""The loop of a run: let a period pass, hear the joints, look, estimate, command; and keep all of it.

Sim and hardware look alike from here: a :class:`~armsight.robot.boards.board.Board`, in whose ``receive`` time passes, and
a function that hands out the newest shot there is. Time is the board's. Where it passes by itself, a board that hears
nothing for 100 ms stops its arm: there the loop goes on while something is computed that takes longer.

What goes on beside a loop that must not pause: long work, and looking at images.
"""

from __future__ import annotations

import contextlib
import gc
import numpy as np
import sys
import time
from armsight.app.run.record import Log, Segment, Skew, ToolTrack
from armsight.app.run.setup import Setup
from armsight.data import Array, JointCommand, JointStates, Missed, PoseEstimate, Shot
from armsight.errors import DeviceError
from armsight.loop.estimators import Estimator, KalmanEstimator, Mounting
from armsight.loop.estimators.smoothing import Stretch
from armsight.robot.boards.codes import State
from armsight.vision.follow.follower import Follower
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import replace
from typing import Protocol, TypeVar

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


#: Period of the loop and so of the commands, s.
PERIOD_S = 0.004
#: Without a shot for so long the cameras have stalled, s.
STALLED_S = 0.5
#: Searching an image for the body takes so long at most, on a computer with much else to do, s.
SEARCH_S = 2.0
#: The fused track is written down so late, s: the sightings on both sides of a time have come by then, though the body was
#: hidden for half a second. The loop does not wait for that; what it knew is the live track.
RECORD_LAG_S = 0.6
_RECORD_EVERY_S = 0.02  # so much of it at a time: cheaper than turn by turn
_WRITE_EVERY_S = 0.1  # and so much is reckoned at a time, after a command is on its way: cheaper still
_STOP_S = 0.3  # in which an interrupted motion comes to rest
_LEAST_WAIT_S = 0.001  # for the board, though the loop is late: a board that is gone is known by waiting in vain


class Controller(Protocol):
    """Says what the joints are to do next."""

    def prepare(self, t_s: float) -> None:
        """Do what the next command, to be sent at a time of the board's clock, needs and no image changes."""
        ...

    def command(self, estimator: Estimator) -> tuple[JointCommand, str]:
        """Return the command that was prepared, and in a word what it is based on."""
        ...


class Loop:
    """Runs controllers on a board with cameras beside it.

    Args:
        station: the board, the cameras.
        follower: measures the body.
        log: where all is kept.
        estimator: says where the tool is.

    Attributes:
        mounting: where cameras and body are; None before that is known: the estimator then hears the joints alone.
        on_shot: called with each shot that was looked at and what came of it, after its command is on its way.
        t_s: time of the newest reading, board's clock.
    """

    def __init__(self, setup: Setup, follower: Follower, log: Log, estimator: KalmanEstimator) -> None:
        self.board, self.setup, self.follower = setup.board, setup, follower
        self.estimator, self.log = estimator, log
        self.mounting: Mounting | None = None
        self.on_shot: Callable[[Shot, PoseEstimate | Missed], None] = lambda shot, result: None
        self.t_s = 0.0
        self._shot_s = -np.inf
        self._skew = Skew(follower.rig, setup.sync_s)
        # Of the record: up to when it is noted what was heard around each reading, up to when it is written down, what is
        # between the two, and the first batch of readings that is not all noted.
        self._noted_s = self._written_s = -np.inf
        self._noted: list[Stretch] = []
        self._first = 0
        self._watch = Watch(self._measured, PERIOD_S)
        self._expected: Array | None = None  # where a lost body should be in the shot that is looked at
        # Of the host's clock, s: when the next turn is due, and when the shot that is looked at was taken up.
        self._due = self._taken_s = 0.0
        while not log.joints:
            self.pass_time(PERIOD_S)

    def begin(self, estimator: KalmanEstimator) -> None:
        """Take another estimator from here on, after it has learned from everything measured so far."""
        assert self.mounting is not None
        mounting = self.mounting
        seen = deque((t_s, pose) for _, t_s, pose in self.log.poses if isinstance(pose, PoseEstimate))

        def learn(heard: Sequence[JointStates]) -> None:
            for states in heard:
                estimator.joints(states)
                while seen and seen[0][0] <= states.t_s[-1]:
                    t_s, pose = seen.popleft()
                    estimator.vision(mounting.pose_measurement(pose, t_s))

        heard = list(self.log.joints)
        self.compute(lambda: learn(heard))
        learn(self.log.joints[len(heard) :])  # what came meanwhile
        self._write()
        self.estimator = estimator  # it has what was not written down yet in its memory

    def compute(self, work: Callable[[], _Result]) -> _Result:
        """Return what some long work comes to. Where time passes by itself, the loop goes on meanwhile and holds the arm.

        Args:
            work: touches nothing that the loop changes.

        Raises:
            DeviceError: the board failed meanwhile; and what the work raises.
        """
        if self.setup.clock is None:
            return work()
        held, calm = Still(self._at_rest(PERIOD_S)), Segment("calibration", "", "", False)
        return beside(work, lambda done: self._turns(held, done, calm, watch=False))

    def pass_time(self, wait_s: float) -> None:
        """Let time pass and hear the joints."""
        states = self.board.receive(wait_s)
        if not len(states.t_s):
            return
        self.t_s = float(states.t_s[-1])
        if self.setup.clock is not None:
            self.setup.clock.heard(self.t_s)
        self.log.joints.append(states)
        self.estimator.joints(states)
        self.log.live.append(self.estimator.estimate())
        self._record()

    def _record(self) -> None:
        """Note where the tool was, as late as RECORD_LAG_S: with the sightings on both sides of a time."""
        if self.t_s - RECORD_LAG_S - self._noted_s >= _RECORD_EVERY_S:
            self._note(self.t_s - RECORD_LAG_S)

    def _note(self, upto_s: float) -> None:
        """Note what was heard around each reading up to a time that is not noted yet."""
        joints, parts = self.log.joints, list[Array]()
        for k in range(self._first, len(joints)):
            if joints[k].t_s[0] > upto_s:
                break
            parts.append(joints[k].t_s)
            if joints[k].t_s[-1] <= upto_s:
                self._first = k + 1
        t_s = np.concatenate([*parts, np.zeros(0)])
        t_s = t_s[(t_s > self._noted_s) & (t_s <= upto_s)]
        if len(t_s):
            self._noted += self.estimator.stretches(t_s)
            self._noted_s = float(t_s[-1])

    def _write(self) -> None:
        """Write down where the tool was at the readings that are noted."""
        if self._noted:
            track = self.estimator.blended(self._noted)
            none = np.full(len(track), "")
            self.log.fused.append(ToolTrack(track.t_s, track.Ts_base_tool, none, none, track.covs))
            self._noted, self._written_s = [], self._noted_s

    def close_record(self) -> None:
        """Write down where the tool was up to now: nothing more will be seen."""
        self._note(min(self.t_s, self.estimator.span_s[1]))  # an interrupt may have kept the newest from it
        self._write()

    def look(self) -> tuple[Shot, float, PoseEstimate | Missed] | None:
        """Measure the newest shot, where there is one; returns it, when it was taken up, and what came of it."""
        if self.setup.clock is None:
            newest = self._newest()
            looked = None if newest is None else (newest, self._measured(newest))
        else:
            looked = self._watch.take(self._newest)
        if looked is not None or self._watch.busy:
            self._shot_s = self.t_s
        if looked is None:
            return None
        shot, result = looked
        if shot.t_s is None:
            result = Missed("the shot has no time")
        elif isinstance(result, PoseEstimate):
            result = self._skew.widened(result, shot.t_s)
            if self.mounting is not None:
                self.log.verdicts.append(self.estimator.vision(self.mounting.pose_measurement(result, shot.t_s)))
        self.log.poses.append((shot.name, np.nan if shot.t_s is None else shot.t_s, result))
        return shot, self._taken_s, result

    def _measured(self, shot: Shot) -> PoseEstimate | Missed:
        return self.follower.measure(shot, self._expected)

    def _newest(self) -> Shot | None:
        """Return the newest shot, where there is one, on the board's clock."""
        shot, clock = self.setup.poll(), self.setup.clock
        self._taken_s = time.perf_counter()
        self._expected = None
        if shot is not None and self.mounting is not None and self.follower.way == "lost":
            self._expected = self.mounting.body(self.estimator.estimate().T_base_tool)
        return shot if shot is None or clock is None else clock.on_board(shot)

    def run(self, controller: Controller, duration_s: float, segment: Segment, *, watch: bool = True) -> None:
        """Let a controller command the joints for a while.

        Args:
            controller: what commands.
            duration_s: how long.
            segment: what is done; its times are filled in.
            watch: whether shots are measured.

        Raises:
            DeviceError: the board left the enabled state (its faults are told), the cameras stalled, or a device is gone.
        """
        begin_s = self.t_s
        self._turns(controller, lambda: self.t_s - begin_s >= duration_s - 1e-9, segment, watch=watch)

    def run_until_seen(self, controller: Controller, duration_s: float, segment: Segment) -> None:
        """Do as :meth:`run` does, and go on a little until the first shot has been measured."""
        begin_s, before = self.t_s, len(self.log.poses)

        def over() -> bool:
            late_s = self.t_s - begin_s - duration_s + 1e-9
            return late_s >= 0.0 and (len(self.log.poses) > before or late_s >= SEARCH_S)

        self._turns(controller, over, segment, watch=True)

    def _turns(self, controller: Controller, over: Callable[[], bool], segment: Segment, *, watch: bool) -> None:
        """Let a controller command the joints until something is over."""
        begin_s = self.t_s
        self._watch.forget()
        try:
            while not over():
                self.pass_time(self._rest_of_period())
                self._check_board()
                controller.prepare(self.t_s)  # before an image is taken up: it has not to wait for that
                looked = self.look() if watch else None
                if watch:
                    self._check_cameras(begin_s)
                command, mode = controller.command(self.estimator)
                self.board.send(command)
                self.log.commands.append((self.t_s, command))
                self.log.modes.append(mode)
                if looked is not None:
                    shot, began, result = looked
                    if self.mounting is not None:  # before, no command knew what was seen
                        self.log.latency_s.append(time.perf_counter() - began)
                    self.on_shot(shot, result)
                if self._noted_s - self._written_s >= _WRITE_EVERY_S:
                    self._write()
        finally:
            self.log.segments.append(replace(segment, begin_s=begin_s, end_s=self.t_s))

    def _rest_of_period(self) -> float:
        """Return how long to wait for the loop's next turn, s: what the last one has left of its period."""
        if self.setup.clock is None:
            return PERIOD_S
        now = time.monotonic()
        self._due = max(self._due + PERIOD_S, now + _LEAST_WAIT_S)
        return self._due - now

    def stop(self) -> None:
        """Bring the arm to rest where it is, and leave it held there."""
        if self.board.status.state is not State.ENABLED or not self.log.commands:
            return
        still = replace(self._at_rest(_STOP_S), q_ref=self.board.joints.reference_rad)
        turns = 1 if self.setup.clock is None else round(_STOP_S / PERIOD_S)
        for turn in range(turns):
            self.board.send(replace(still, duration_s=_STOP_S * (1 - turn / turns)))
            self.pass_time(_STOP_S / turns)

    def _at_rest(self, duration_s: float) -> JointCommand:
        """Return the command to be at rest where the newest command wanted the arm."""
        newest = self.log.commands[-1][1]
        return JointCommand(newest.q_ref, np.zeros(6), newest.gravity_duty, duration_s)

    def _check_board(self) -> None:
        """Raise where the board does not follow any more."""
        status = self.board.status
        if status.state is State.ENABLED:
            return
        causes = "; ".join(str(fault) for fault in status.faults) or "no fault is latched"
        raise DeviceError(f"the board went over to {status.state.name} at {status.t_s:.3f} s: {causes}")

    def _check_cameras(self, since_s: float) -> None:
        """Raise where the cameras have been silent for too long."""
        silent_s = self.t_s - max(self._shot_s, since_s)
        if silent_s > STALLED_S + 2.0 / self.setup.rate_hz:
            raise DeviceError(f"no shot has come for {silent_s:.1f} s: the cameras have stalled")
