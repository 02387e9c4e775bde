"""The loop of a run: let a period pass, hear the joints, look, estimate, command; and keep all of it.

Sim and hardware look alike from here: a :class:`~armsight.robot.boards.board.Board`, in whose ``receive`` time passes, and
a function that hands out the newest shot there is. Time is the board's.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from armsight.app.run_station import Station
from armsight.app.run_tracks import ToolTrack
from armsight.data import Array, JointCommand, JointStates, Missed, PoseEstimate, Shot
from armsight.errors import DeviceError
from armsight.loop.estimators import ArmEstimate, Estimator, KalmanEstimator, Mounting, Verdict
from armsight.robot.boards.codes import State
from armsight.robot.trajectories import Trajectory
from armsight.vision.follow import Follower

#: Period of the loop and so of the commands, s.
PERIOD_S = 0.004
#: Without a shot for so long the cameras have stalled, s.
STALLED_S = 0.5
#: The fused track is written down so late, s: the sightings on both sides of a time have come by then. The loop does not
#: wait for that.
RECORD_LAG_S = 0.04
_RECORD_EVERY_S = 0.02  # so much of it at a time: cheaper than turn by turn
_LAST_BATCHES = 32  # of readings that hold all within lag and time
_STOP_S = 0.3  # in which an interrupted motion comes to rest


class Controller(Protocol):
    """Says what the joints are to do next."""

    def command(self, t_s: float, estimator: Estimator) -> tuple[JointCommand, str]:
        """Return the command to send at a time of the board's clock, and in a word what it is based on."""
        ...


@dataclass(frozen=True)
class Segment:
    """A stretch of a run.

    Attributes:
        phase: calibration, open_loop, closed_loop or rest.
        motion: name of the motion, or of the one whose end the arm stands at; "" before the first.
        kind: joints, home, line or circle, of that motion.
        closed: whether the loop was closed on vision.
        begin_s: on the board's clock.
        end_s: likewise.
        trajectory: what the joints were to do from ``begin_s`` on; None where nothing was planned.
    """

    phase: str
    motion: str
    kind: str
    closed: bool
    begin_s: float = 0.0
    end_s: float = 0.0
    trajectory: Trajectory | None = None


@dataclass
class Log:
    """All that a run measured, as it came.

    Attributes:
        joints: the potentiometers, batch by batch.
        fused: where the estimator has the tool at each reading, RECORD_LAG_S later, batch by batch.
        live: where it had the tool at the newest reading, turn by turn: what the loop goes by.
        poses: each shot's name, stamp and pose (the cameras' skew in its covariance), or why there is none.
        verdicts: what the estimator made of those it was given.
        commands: when each was sent, and what.
        modes: what each was based on.
        latency_s: our time from an image to the command that knows it, image by image, s.
        segments: what happened when.
    """

    joints: list[JointStates] = field(default_factory=list)
    fused: list[ToolTrack] = field(default_factory=list)
    live: list[ArmEstimate] = field(default_factory=list)
    poses: list[tuple[str, float, PoseEstimate | Missed]] = field(default_factory=list)
    verdicts: list[Verdict] = field(default_factory=list)
    commands: list[tuple[float, JointCommand]] = field(default_factory=list)
    modes: list[str] = field(default_factory=list)
    latency_s: list[float] = field(default_factory=list)
    segments: list[Segment] = field(default_factory=list)


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

    def __init__(self, station: Station, follower: Follower, log: Log, estimator: KalmanEstimator) -> None:
        self.board, self.station, self.follower = station.board, station, follower
        self.estimator, self.log = estimator, log
        self.mounting: Mounting | None = None
        self.on_shot: Callable[[Shot, PoseEstimate | Missed], None] = lambda shot, result: None
        self.t_s = 0.0
        self._shot_s = -np.inf
        self._last: tuple[float, Array] | None = None
        self._written_s = -np.inf
        while not log.joints:
            self.pass_time(PERIOD_S)

    def begin(self, estimator: KalmanEstimator) -> None:
        """Take another estimator from here on, after it has learned from everything measured so far."""
        assert self.mounting is not None
        seen = [(t_s, pose) for _, t_s, pose in self.log.poses if isinstance(pose, PoseEstimate)]
        at = 0
        for states in self.log.joints:
            estimator.joints(states)
            while at < len(seen) and seen[at][0] <= states.t_s[-1]:
                estimator.vision(self.mounting.sighting(seen[at][1], seen[at][0]))
                at += 1
        self.estimator, self._written_s = estimator, self.t_s

    def pass_time(self, wait_s: float) -> None:
        """Let time pass and hear the joints."""
        states = self.board.receive(wait_s)
        if not len(states.t_s):
            return
        self.t_s = float(states.t_s[-1])
        self.log.joints.append(states)
        self.estimator.joints(states)
        self.log.live.append(self.estimator.estimate())
        self._record()

    def _record(self) -> None:
        """Write down where the tool was, as late as RECORD_LAG_S: with the sightings on both sides of a time."""
        if self.t_s - RECORD_LAG_S - self._written_s < _RECORD_EVERY_S:
            return
        wanted = [s.t_s for s in self.log.joints[-_LAST_BATCHES:]]
        t_s = np.concatenate(wanted)
        t_s = t_s[(t_s > self._written_s) & (t_s <= self.t_s - RECORD_LAG_S)]
        if len(t_s):
            track = self.estimator.smoothed(t_s)
            none = np.full(len(t_s), "")
            self.log.fused.append(ToolTrack(track.t_s, track.Ts_base_tool, none, none, track.covs))
            self._written_s = float(t_s[-1])

    def look(self) -> tuple[Shot, float, PoseEstimate | Missed] | None:
        """Measure the newest shot, where there is one; returns it, when it was taken up, and what came of it."""
        shot = self.station.poll()
        if shot is None:
            return None
        began = time.perf_counter()
        result = self.follower.measure(shot)
        self._shot_s = self.t_s
        if shot.t_s is None:
            result = Missed("the shot has no time")
        elif isinstance(result, PoseEstimate):
            result = self._with_skew(result, shot.t_s)
            if self.mounting is not None:
                self.log.verdicts.append(self.estimator.vision(self.mounting.sighting(result, shot.t_s)))
        self.log.poses.append((shot.name, np.nan if shot.t_s is None else shot.t_s, result))
        return shot, began, result

    def _with_skew(self, pose: PoseEstimate, t_s: float) -> PoseEstimate:
        """Widen the covariance by what the cameras' unsynchronised exposures do to a moving body.

        Between the exposures it moves v dt along the baseline, which is taken for disparity: the depth is off by
        Z / B v dt along the line of sight.
        """
        p = pose.T_left_body[:3, 3]
        last, self._last = self._last, (t_s, p)
        if last is None or not 0.0 < t_s - last[0] < STALLED_S:
            return pose
        baseline = self.follower.rig.T_left_right[:3, 3]
        along = float((p - last[1]) @ baseline) / (t_s - last[0]) / float(np.linalg.norm(baseline))
        off = pose.T_left_body[:3, :3].T @ p * (self.station.sync_s * along / np.linalg.norm(baseline))
        extra = np.zeros((6, 6))
        extra[:3, :3] = np.outer(off, off)
        return replace(pose, cov=pose.cov + extra, cov_noise=pose.cov_noise + extra)

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
        try:
            while self.t_s - begin_s < duration_s - 1e-9:
                self.pass_time(PERIOD_S)
                self._check_board()
                looked = self.look() if watch else None
                if watch:
                    self._check_cameras(begin_s)
                command, mode = controller.command(self.t_s, self.estimator)
                self.board.send(command)
                self.log.commands.append((self.t_s, command))
                self.log.modes.append(mode)
                if looked is not None:
                    shot, began, result = looked
                    self.log.latency_s.append(time.perf_counter() - began)
                    self.on_shot(shot, result)
        finally:
            self.log.segments.append(replace(segment, begin_s=begin_s, end_s=self.t_s))

    def stop(self) -> None:
        """Bring the arm to rest where it is, and leave it held there."""
        if self.board.status.state is not State.ENABLED or not self.log.commands:
            return
        newest = self.log.commands[-1][1]
        self.board.send(JointCommand(self.board.joints.reference_rad, np.zeros(6), newest.gravity_duty, _STOP_S))
        self.pass_time(_STOP_S)

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
        if silent_s > STALLED_S + 2.0 / self.station.rate_hz:
            raise DeviceError(f"no shot has come for {silent_s:.1f} s: the cameras have stalled")
