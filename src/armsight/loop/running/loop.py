"""The control loop: receive joint readings, measure the newest shot, estimate, command; and log all of it.

In: a :class:`~armsight.loop.running.setup.Setup` and controllers. Out: a :class:`~armsight.loop.running.log.Log`.

Simulation and hardware have one interface: a board in whose ``receive`` time passes, and a function that returns the newest
shot. Time is the board's. On hardware it passes by itself, and a board that receives nothing for 100 ms stops its arm: long
computations (:func:`beside`) and the detection in images (:class:`Watch`) run in threads, and the loop continues meanwhile.
"""

from __future__ import annotations

import contextlib
import gc
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import replace
from typing import TypeVar

import numpy as np

from armsight.data import Array, JointCommand, JointStates, Missed, PoseEstimate, Shot
from armsight.errors import ArmsightError, DeviceError
from armsight.geometry.pose import inverse, log_se3
from armsight.loop.estimators import KalmanEstimator, Mounting, Remembered
from armsight.loop.estimators.smoothing import Interval
from armsight.loop.frame_clock import FrameClock
from armsight.loop.health import HealthMonitor
from armsight.loop.health.follow import RigCorrection, RigFollower, remeasured
from armsight.loop.running.controllers import PERIOD_S, Controller, Planned, Still
from armsight.loop.running.data import (
    EventDatum,
    Fanout,
    HealthNotes,
    JointsDatum,
    NoteDatum,
    Publisher,
    ShotDatum,
    estimator_event,
    mounting_event,
    remeasured_event,
    restored_event,
)
from armsight.loop.running.log import NEWEST_SHOTS, Log, RunSegment, Skew
from armsight.loop.running.setup import Setup
from armsight.loop.sync_led import SyncLedWatch
from armsight.robot.boards.codes import BoardState
from armsight.robot.trajectories import Trajectory
from armsight.vision.follow.follower import Follower, measurer
from armsight.vision.markers.calibrated_board import is_print
from armsight.vision.pose.shutter import Motion, TimedShot, measure_with_motion
from armsight.vision.rig import Shutters, StereoRig

#: How long one thread may hold the interpreter lock, s: an iteration takes it about twelve times.
SWITCH_S = 2e-4
_Result = TypeVar("_Result")


def beside(work: Callable[[], _Result], meanwhile: Callable[[Callable[[], bool]], None]) -> _Result:
    """Return the result of a long computation in a thread; run something else in this thread until it is done.

    ``meanwhile`` is called with a function that returns whether the work is done, and returns once it is. What either of
    them raises is raised; where ``meanwhile`` or the keyboard raised it, the work is not waited for.
    """
    pool = ThreadPoolExecutor(1)
    try:
        done = pool.submit(work)
        meanwhile(done.done)
        return done.result()
    finally:
        pool.shutdown(wait=False)


class Watch:
    """Measures shots in a thread: a search of the whole image takes longer than the loop may pause.

    :meth:`take` waits ``patience_s`` for a result, s; a later one is returned in the next iteration.
    """

    def __init__(self, measure: Callable[[Shot], PoseEstimate | Missed], patience_s: float) -> None:
        self._measure, self._patience_s = measure, patience_s
        self._pool = ThreadPoolExecutor(1)
        self._work: Future[PoseEstimate | Missed] | None = None
        self._shot: Shot | None = None

    def take(self, poll: Callable[[], Shot | None]) -> tuple[Shot, PoseEstimate | Missed] | None:
        """Begin to measure the newest shot if none is being measured; return a shot and its result once there is one."""
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
        """Whether a shot is being measured."""
        return self._work is not None

    def forget(self) -> None:
        """Discard the result of the shot that is being measured."""
        self._shot = None


@contextlib.contextmanager
def steady(*, in_time: bool) -> Iterator[None]:
    """Configure the interpreter for a control loop within the block.

    The cyclic garbage collector is off: a full collection visits every object of the process and takes 0.1 s or more, and a
    board that receives no command for 100 ms stops its arm. The loop's records form no reference cycles. Where time passes
    by itself (``in_time``), threads alternate more often (``SWITCH_S``), at some cost.
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


#: Without a shot for so long the cameras have stalled, s.
STALLED_S = 0.5
#: Upper bound of the time to search an image for the body, on a computer under load, s.
SEARCH_S = 2.0
#: What a search of two images takes in a simulation, s: on hardware 0.02 to 0.06, and commands continue beside it.
SIMULATED_SEARCH_S = 0.06
#: Lag of the fused track, s: measurements about a time have arrived then, even of a body hidden for half a second.
RECORD_LAG_S = 0.6
_RECORD_EVERY_S = 0.02  # interval of the fused track that is noted at once: cheaper than every iteration
_WRITE_EVERY_S = 0.1  # interval that is computed at once, after a command was sent: cheaper still
#: Live estimates within so long, s, make the body's motion about an exposure; their scatter shows this share of errors.
_MOTION_S, _SCATTER_SHARE = 0.03, 0.25
#: Searches for the sync LED before it is given up, two steps each, and the longest time for them, s.
_LED_TRIES, _LED_S = 4, 60.0
_STOP_S = 0.3  # in which an interrupted motion comes to rest
_FIXED_EVERY_S = 0.2  # in which fixed bodies are measured, and the background is looked at
#: Where a rig is followed: how often it is looked whether it can be put right, s.
_RIG_EVERY_S = 0.25
_HEALTH_EVERY_S = 1.0  # in which findings are published; half: nothing, double: a person sees them later
_LEAST_WAIT_S = 0.001  # for the board, even when the loop is late: a lost board is detected by a timeout


class Loop:
    """Runs controllers on a board, with cameras.

    The constructor receives nothing; :meth:`open` returns a loop that has its first reading. It takes a setup, what
    measures the body, the log to append to, and what estimates the pose of the tool.
    """

    def __init__(self, setup: Setup, follower: Follower, log: Log, estimator: KalmanEstimator) -> None:
        self.board, self.setup, self.follower = setup.board, setup, follower
        self.estimator, self.log = estimator, log
        #: poses of cameras and body on the arm; None: the estimator has the joints alone
        self.mounting: Mounting | None = None
        self.delay_s: float | None = None  #: delay of the images, s; None before it was measured
        self.shutters: Shutters | None = follower.rig.shutters  #: when the cameras expose, where not at one time
        #: called with each shot and its result, after the command that follows from it was sent
        self.on_shot: Callable[[Shot, PoseEstimate | Missed], None] = lambda shot, result: None
        #: called in every period before its command; what it raises ends the motion
        self.on_period: Callable[[], None] = lambda: None
        self.segment: RunSegment | None = None  #: what is running, with its begin; None before the first
        self.t_s = 0.0  #: time of the newest reading, board's clock, s
        self.publisher: Publisher = Fanout()
        self._datum: ShotDatum | None = None
        self._known: Mounting | None = None  # the mounting that was published
        self._shot_s = -np.inf
        self._impacts = self._losses = 0  # that were published
        self._stamp_s: float | None = None  # of the shot that is measured, as it was stamped
        self.health = HealthMonitor(follower.rig, setup.target.body, setup.sync_s, printed=is_print(setup.target))
        self._frames = self.health.stamps = FrameClock()
        self.rig_follower: RigFollower | None = None  #: decides when the rig can be put right; None: it is not followed
        self._rig_work: Future[RigCorrection | None] | None = None
        self._rig_s = -np.inf
        self._skew = Skew(follower.rig, setup.sync_s)
        self.health.watch_fixed([each.body.name for each in setup.fixed])
        self._measure_fixed = [measurer(follower.rig, each) for each in setup.fixed]
        bit_s = setup.sync_led_bit_s
        self.led = None if bit_s is None else SyncLedWatch(bit_s, setup.board.abilities.reading_age_s)
        self._led_work: Future[None] | None = None
        self._fixed_pool = ThreadPoolExecutor(1)
        self._fixed_work: Future[None] | None = None
        self._fixed_s = self._health_s = -np.inf
        self._health_notes = HealthNotes()
        # Of the fused track: up to when intervals are noted, and computed; those noted alone; readings not noted.
        self._noted_s = self._written_s = -np.inf
        self._noted: list[Interval] = []
        self._read = deque[Array]()
        self._watch = Watch(self._measured, PERIOD_S)
        # Of a lost body in the shot that is measured: its predicted pose and its velocity.
        self._expected: Array | None = None
        self._twist: Array | None = None
        #: In lock-step: what was measured, when the search will be over, board's clock, and when it ended, host's clock, s.
        self._search: tuple[Shot, PoseEstimate | Missed, float, float] | None = None
        # Of the host's clock, s: when the next iteration is due, and when the measurement of the newest shot began.
        self._due = self._taken_s = 0.0

    @classmethod
    def open(
        cls, setup: Setup, follower: Follower, log: Log, estimator: KalmanEstimator, publisher: Publisher | None = None
    ) -> Loop:
        """Return a loop that has received the first joint reading; arguments as for the class, and a publisher.

        Raises:
            DeviceError: the board sends none.
        """
        loop = cls(setup, follower, log, estimator)
        loop.publisher = publisher or Fanout()
        while not log.joints:
            loop.pass_time(PERIOD_S)
        return loop

    def begin(self, estimator: KalmanEstimator) -> None:
        """Replace the estimator, after the new one has processed everything measured so far."""
        assert self.mounting is not None
        mounting = self.mounting
        seen = deque((t_s, pose) for _, t_s, pose in self.log.poses if isinstance(pose, PoseEstimate))

        def learn(batches: Sequence[JointStates]) -> None:
            for states in batches:
                estimator.joints(states)
                while seen and seen[0][0] <= states.t_s[-1]:
                    t_s, pose = seen.popleft()
                    estimator.vision(mounting.pose_measurement(pose, t_s))

        self.publisher.put(EventDatum(self.t_s, estimator_event(estimator, anew=True)))
        received = list(self.log.joints)
        self.compute(lambda: learn(received))
        learn(self.log.joints[len(received) :])  # what arrived meanwhile
        self._write()
        self.estimator = estimator  # its memory covers what is not recorded yet
        self.log.settle()
        self.health.follow(estimator, self.setup.arm, mounting)

    def compute(self, work: Callable[[], _Result]) -> _Result:
        """Return the result of a long computation, which uses nothing that the loop changes.

        On hardware the loop continues meanwhile and holds the arm: a DeviceError is raised where the board fails.
        """
        if self.setup.clock is None:
            return work()
        held = Still(self._at_rest(PERIOD_S))
        return beside(work, lambda done: self._iterate(held, done, RunSegment(), watch=False))

    def pass_time(self, wait_s: float) -> None:
        """Let time pass, receive the joint readings, and update the estimator with them."""
        states = self.board.receive(wait_s)
        if not len(states.t_s):
            return
        self.t_s = float(states.t_s[-1])
        if self.setup.clock is not None:
            self.setup.clock.heard(self.t_s)
        self.log.read(states)
        self._read.append(states.t_s)
        self.estimator.joints(states)
        beside = self.setup.beside
        samples = None if beside is None else beside.poll(self.estimator, self.t_s)
        felt = None if beside is None or samples is None else (beside.entry.reference.name, samples)
        if beside is not None and len(beside.impacts) > self._impacts:
            self._impacts = len(beside.impacts)
            said = (
                f"{beside.entry.reference.name}: an impact that joints do not explain: a knock, or links in their gaps"
            )
            self.publisher.put(NoteDatum(beside.impacts[-1], said, "warning"))
        if beside is not None and len(losses := beside.losses) > self._losses:
            for loss in losses[self._losses :]:
                self.publisher.put(NoteDatum(self.t_s, f"{beside.entry.reference.name}: {loss}", "warning"))
            self._losses = len(losses)
        estimate = self.estimator.estimate()
        self.log.estimated(estimate)
        self.publisher.put(JointsDatum(states, estimate.T_base_tool, estimate.cov, estimate.vision_age_s, felt))
        if self.t_s - RECORD_LAG_S - self._noted_s >= _RECORD_EVERY_S:
            self._note(self.t_s - RECORD_LAG_S)  # with pose measurements on both sides of a time

    def _note(self, upto_s: float) -> None:
        """Note the intervals of the fused track up to a time, board's clock, s."""
        parts = list[Array]()
        while self._read and self._read[0][0] <= upto_s:
            parts.append(self._read[0])
            if self._read[0][-1] > upto_s:
                break
            self._read.popleft()
        t_s = np.concatenate([*parts, np.zeros(0)])
        t_s = t_s[(t_s > self._noted_s) & (t_s <= upto_s)]
        if len(t_s):
            self._noted += self.estimator.intervals(t_s)
            self._noted_s = float(t_s[-1])

    def _write(self) -> None:
        """Compute the fused poses at the readings that are noted, and record them."""
        if self._noted:
            self.log.smoothed(self.estimator.blended(self._noted))
            self._noted, self._written_s = [], self._noted_s

    def close_record(self) -> None:
        """Record the fused track up to now: nothing more will be measured."""
        self._note(min(self.t_s, self.estimator.span_s[1]))  # after an interrupt it may lack the newest reading
        self._write()

    def look(self) -> tuple[Shot, float, PoseEstimate | Missed] | None:
        """Measure the newest shot; return it, when its measurement began, host's clock, s, and the result, if any."""
        measured = self._in_lock_step() if self.setup.clock is None else self._watch.take(self._newest)
        if measured is not None or self._watch.busy or self._search is not None:
            self._shot_s = self.t_s
        if measured is None:
            return None
        shot, result = measured
        outcome, T_base_rig, T_base_tool, suspected = None, None, None, None
        if shot.t_s is None:
            result = Missed("the shot has no time")
        elif isinstance(result, PoseEstimate):
            result = self._at_one_time(result, shot.t_s)
        if isinstance(result, PoseEstimate) and shot.t_s is not None:
            result = self.health.received(result, shot.t_s)
            if self.mounting is not None:
                plain = self.mounting.pose_measurement(result, shot.t_s)
                suspected = self.health.suspected(plain)
                measurement = plain if suspected is None else replace(plain, cov_common=plain.cov_common + suspected)
                outcome = self.estimator.vision(measurement)
                T_base_rig, T_base_tool = self.mounting.T_base_rig, measurement.T_base_tool
                self.log.outcomes[outcome] += 1
        stamped_s = np.nan if shot.t_s is None else shot.t_s - self.estimator.clock_offset_s(shot.t_s)
        self.log.seen(shot.name, stamped_s, result)
        self._datum = ShotDatum(
            shot,
            result,
            self.t_s,
            self.setup.sync_s,
            None if outcome is None else outcome.value,
            T_base_rig,
            T_base_tool,
            suspected,
        )
        return shot, self._taken_s, result

    def _at_one_time(self, result: PoseEstimate, t_s: float) -> PoseEstimate | Missed:
        """Move what the cameras saw at several times to the time of a shot, s; what is not known of the skew widens it."""
        motion = None if self.shutters is None else self._motion(t_s)
        if self.shutters is None or motion is None:
            return self._skew.widened(result, t_s)
        seen = TimedShot(t_s, result.points.seen, result.T_left_body)
        return measure_with_motion(self.follower.rig, self.setup.target.body, seen, motion, self.shutters)

    def _motion(self, t_s: float) -> Motion | None:
        """Return the motion of the body about the exposure of a shot that is stamped ``t_s``; None where it is unknown."""
        if self.mounting is None or self.delay_s is None:
            return None
        exposed_s = t_s - self.delay_s - self.estimator.clock_offset_s(t_s)
        near = [live for live in self.log.live if abs(live.t_s - exposed_s) <= _MOTION_S]
        if len(near) < 8:
            return None
        tau = np.array([live.t_s for live in near]) - exposed_s
        Ts = np.array([live.T_base_tool for live in near]) @ self.mounting.T_tool_body
        xi = log_se3(inverse(Ts[np.argmin(np.abs(tau))]) @ Ts)
        X = (tau[:, None] / _MOTION_S) ** np.arange(4)
        fit = np.linalg.pinv(X)
        coefficients = fit @ xi
        variance = ((xi - X @ coefficients) ** 2).sum(axis=0) / (len(near) - 4) / _SCATTER_SHARE**2
        twist, acceleration = coefficients[1] / _MOTION_S, 2.0 * coefficients[2] / _MOTION_S**2
        return Motion(twist, acceleration, np.diag(variance) * float(fit[1] @ fit[1]) / _MOTION_S**2, True)

    def _publish(self) -> None:
        if self._datum is None:
            return
        mounting = self.mounting
        if mounting is not None and mounting is not self._known and self._datum.outcome is not None:
            self._known = mounting
            self.publisher.put(EventDatum(self.t_s, mounting_event(mounting)))
        self.publisher.put(self._datum)
        self._datum = None

    def _in_lock_step(self) -> tuple[Shot, PoseEstimate | Missed] | None:
        """Measure the newest shot of a simulation; the result of a search is returned ``SIMULATED_SEARCH_S`` later."""
        if self._search is None:
            shot = self._newest()
            if shot is None:
                return None
            result = self._measured(shot)
            if self.follower.way == "followed":
                return shot, result
            self._search = shot, result, self.t_s + SIMULATED_SEARCH_S, time.perf_counter()
        shot, result, over_s, found_s = self._search
        if self.t_s < over_s:
            return None
        self._search = None
        self._taken_s += time.perf_counter() - found_s  # to simulate that time is no part of the search
        return shot, result

    def _measured(self, shot: Shot) -> PoseEstimate | Missed:
        return self.follower.measure(shot, self._expected, self._twist)

    def _newest(self) -> Shot | None:
        shot, clock = self.setup.poll(), self.setup.clock
        self._taken_s = time.perf_counter()
        self._expected = self._twist = None
        shot = shot if shot is None or clock is None else clock.on_board(shot)
        if shot is not None and shot.t_s is not None:
            self._stamp_s, self._shot_s = shot.t_s, self.t_s
            sane_s = self._frames.time(shot.t_s, self.t_s)
            if self.health.stamps_ran:
                self.close_record()
                self._restored(self.health.stamps_right())
            if sane_s is None:
                return None
            shot = replace(shot, t_s=sane_s)
        if shot is not None and self.mounting is not None and self.follower.way == "lost":
            self._expected = self.mounting.body(self.estimator.estimate().T_base_tool)
            motion = None if shot.t_s is None else self._motion(shot.t_s)
            self._twist = None if motion is None else motion.twist
        return shot

    def run(self, controller: Controller, duration_s: float, segment: RunSegment, *, watch: bool = True) -> None:
        """Let a controller command the joints for some time, s; the segment is logged with its times.

        ``controller``: computes the commands. ``duration_s``: how long, s. ``segment``: the entry of the log.
        ``watch``: whether shots are measured.

        Raises:
            DeviceError: the board left the enabled state (the message has its faults), the cameras stalled, or a device
                was disconnected.
        """
        begin_s = self.t_s
        self._iterate(controller, lambda: self.t_s - begin_s >= duration_s - 1e-9, segment, watch=watch)

    def go(
        self, way: Trajectory, rest_s: float, segment: RunSegment, *, late_s: float = 0.0, watch: bool = True
    ) -> None:
        """Do as :meth:`run` with a trajectory as planned, which begins so late, s, and a rest at its end, s."""
        controller = Planned(way, self.t_s + late_s, self.setup.gravity)
        self.run(controller, way.duration_s + rest_s, replace(segment, trajectory=way), watch=watch)

    def run_until_seen(self, controller: Controller, duration_s: float, segment: RunSegment) -> None:
        """Do as :meth:`run`, and continue (at most ``SEARCH_S``) until a first shot has been measured."""
        begin_s, before = self.t_s, self.log.shots

        def over() -> bool:
            late_s = self.t_s - begin_s - duration_s + 1e-9
            return late_s >= 0.0 and (self.log.shots > before or late_s >= SEARCH_S)

        self._iterate(controller, over, segment, watch=True)

    def _iterate(self, controller: Controller, over: Callable[[], bool], segment: RunSegment, *, watch: bool) -> None:
        """Let a controller command the joints, period by period, until ``over`` returns True."""
        begin_s = self.t_s
        self.segment = replace(segment, begin_s=begin_s)
        self._due = 0.0
        self._watch.forget()
        self._search = None
        try:
            while not over():
                self.pass_time(self._rest_of_period())
                self.publisher.pause()
                self.on_period()
                self._check_board()
                controller.prepare(self.t_s)  # before the image is measured, so that its command need not wait for it
                measured = self.look() if watch else None
                if watch:
                    self._check_cameras(begin_s)
                command, mode = controller.command(self.estimator)
                self.board.send(command)
                sent_s = time.perf_counter()
                self.log.commanded(self.t_s, command, mode)
                self._publish()
                self.publisher.resume()
                if measured is not None:
                    shot, began, result = measured
                    if self.mounting is not None:  # before, no command depended on images
                        times_s = self.log.latency_s if self.follower.way == "followed" else self.log.search_s
                        times_s.append(sent_s - began)
                    self.log.write()
                    self.on_shot(shot, result)
                    self._look_at_fixed(shot)
                    self._look_at_led(shot)
                    self.health.work()
                    self._note_health()
                    self._follow_rig()
                if self._noted_s - self._written_s >= _WRITE_EVERY_S:
                    self._write()
        finally:
            self.publisher.resume()
            self.log.segments.append(replace(segment, begin_s=begin_s, end_s=self.t_s))

    def _note_health(self) -> None:
        """Publish what the health monitor finds, and what it takes back, if it is time."""
        if self.t_s - self._health_s >= _HEALTH_EVERY_S:
            self._health_s = self.t_s
            for note in self._health_notes.of(self.t_s, self.health.findings(ends=False)):
                self.publisher.put(note)

    def _look_at_fixed(self, shot: Shot) -> None:
        """Look at the background and measure the fixed bodies in a shot, if it is time; on hardware in a thread."""
        if self.t_s - self._fixed_s < _FIXED_EVERY_S:
            return
        if self._fixed_work is not None:
            if not self._fixed_work.done():
                return
            self._fixed_work.result()
        self._fixed_s = now_s = self.t_s

        def look() -> None:
            self.health.scene_seen(shot, now_s)
            for row, measure in enumerate(self._measure_fixed):
                if isinstance(measured := measure(shot), PoseEstimate):
                    self.health.fixed_measured(row, measured, shot.t_s)

        if self.setup.clock is None:
            look()
        else:
            self._fixed_work = self._fixed_pool.submit(look)

    def _follow_rig(self) -> None:
        """Put the rig right once the evidence suffices; on hardware that is computed in a thread."""
        if self._fixed_work is not None and not self._fixed_work.done():
            return
        if self._rig_work is not None and self._rig_work.done():
            correction, self._rig_work = self._rig_work.result(), None
            if correction is not None:
                self._put_right(replace(correction, at_s=self.t_s))
        if self.rig_follower is None or self.mounting is None or not self.health.follows or self._rig_work is not None:
            return
        if self.t_s - self._rig_s < _RIG_EVERY_S:
            return
        self._rig_s = self.t_s
        work = self.rig_follower.look(self.health, self._newest_poses, self.mounting.T_base_rig, self.t_s)
        if work is None:
            return
        if self.setup.clock is not None:
            self._rig_work = self._fixed_pool.submit(work)
        elif (found := work()) is not None:
            self._put_right(found)

    def _newest_poses(self) -> list[tuple[float, PoseEstimate]]:
        """Return time and pose of the newest shots, measured with the rig as it is."""
        since_s = max((each.at_s for each in self.log.corrections if each.update is not None), default=-np.inf)
        newest = self.log.poses[-NEWEST_SHOTS:]
        return [(t_s, pose) for _, t_s, pose in newest if isinstance(pose, PoseEstimate) and t_s >= since_s]

    def _put_right(self, correction: RigCorrection) -> None:
        """Go on with a rig that was put right; the estimator goes on from what it knew before the change."""
        assert self.mounting is not None
        self.close_record()  # the estimator's memory does not reach further back afterwards
        self.mounting = correction.mounting(self.mounting)
        if correction.update is not None:
            self._recalibrate(correction.update.rig)
        self._restored(self.health.put_right(correction))
        if self.rig_follower is not None:
            self.rig_follower.put_right(correction)
        self.log.corrections.append(correction)
        self.log.mountings.append((self.t_s, self.mounting))

    def _restored(self, state: Remembered | None) -> None:
        """Publish what the estimator goes on from, if it was brought back to that."""
        if state is not None:
            self.publisher.put(EventDatum(self.t_s, restored_event(state)))

    def _recalibrate(self, rig: StereoRig) -> None:
        self.follower.recalibrate(rig)
        self._skew = Skew(rig, self.setup.sync_s)
        self._measure_fixed = [measurer(rig, each) for each in self.setup.fixed]

    def put_cameras_right(self) -> bool:
        """Put the cameras right before anything depends on their poses; return whether logged poses were measured anew."""
        watch = None if self.rig_follower is None else self.health.cameras_moved()
        since_s = None if watch is None else watch.moved_since_s()
        if self.rig_follower is None or since_s is None:
            return False
        poses, follower, body = self._newest_poses(), self.rig_follower, self.setup.target.body
        found = self.compute(lambda: follower.cameras(since_s, poses, self.t_s))
        if found is None or found.update is None:
            return False
        rig = found.update.rig
        self._recalibrate(rig)
        again = list[tuple[float, PoseEstimate | Missed]]()
        for k, (name, t_s, pose) in enumerate(self.log.poses):
            if isinstance(pose, PoseEstimate) and t_s >= since_s:
                again.append((t_s, remeasured(rig, body, pose)))
                self.log.poses[k] = (name, *again[-1])
        self.publisher.put(EventDatum(self.t_s, remeasured_event(again)))
        self.health.recalibrated(found)
        self.log.corrections.append(replace(found, at_s=since_s))
        return True

    def _look_at_led(self, shot: Shot) -> None:
        """Look at the sync LED in a shot; what takes long is computed in a thread on hardware."""
        work = None if self.led is None else self.led.take(replace(shot, t_s=self._stamp_s))
        if work is None:
            return
        if self._led_work is not None:
            self._led_work.result()
        if self.setup.clock is None:
            work()
        else:
            self._led_work = self._fixed_pool.submit(work)

    def find_led(self) -> None:
        """Hold the arm until the sync LED was found by both cameras, where there is to be one.

        Raises:
            ArmsightError: it was not found; the message says why.
        """
        led, begin_s = self.led, self.t_s
        if led is None:
            return

        def over() -> bool:
            return bool(led.estimates) or led.tried >= _LED_TRIES or self.t_s - begin_s > _LED_S

        self._iterate(Still(self._at_rest(PERIOD_S)), over, RunSegment(), watch=True)
        if not led.estimates:
            reason = led.reason or f"no image in {_LED_S:g} s shows it"
            raise ArmsightError(
                f"the sync LED is not seen ({reason}): bring it into the view of both cameras, near the base, or leave out"
                " --sync-led"
            )

    def _rest_of_period(self) -> float:
        """Return how long to wait for the next iteration, s: what the last one has left of its period."""
        if self.setup.clock is None:
            return PERIOD_S
        now = time.monotonic()
        if self._due > 0.0:
            self.health.period_began(self.t_s, now - self._due - PERIOD_S)
        self._due = max(self._due + PERIOD_S, now + _LEAST_WAIT_S)
        return self._due - now

    def stop(self) -> None:
        """Bring the arm to rest at its present position, where the board holds it."""
        if self.board.status.state is not BoardState.ENABLED or self.log.command is None:
            return
        still = replace(self._at_rest(_STOP_S), q_ref=self.board.joints.reference_rad)
        periods = 1 if self.setup.clock is None else round(_STOP_S / PERIOD_S)
        for period in range(periods):
            self.board.send(replace(still, duration_s=_STOP_S * (1 - period / periods)))
            self.pass_time(_STOP_S / periods)

    def _at_rest(self, duration_s: float) -> JointCommand:
        """Return the command to be at rest at the reference of the newest command."""
        newest = self.log.command
        assert newest is not None
        return JointCommand(newest.q_ref, np.zeros_like(newest.q_ref), newest.gravity_duty, duration_s)

    def _check_board(self) -> None:
        status = self.board.status
        if status.state is BoardState.ENABLED:
            return
        faults = "; ".join(str(fault) for fault in status.faults) or "no fault is latched"
        raise DeviceError(f"the board changed to {status.state.name} at {status.t_s:.3f} s: {faults}")

    def _check_cameras(self, since_s: float) -> None:
        silent_s = self.t_s - max(self._shot_s, since_s)
        if silent_s > STALLED_S + 2.0 / self.setup.rate_hz:
            raise DeviceError(f"no shot has come for {silent_s:.1f} s: the cameras have stalled")
