"""The arm: joint readings beside what vision measures, the motions in open and closed loop, and a stop that always works.

In: the arm's board, the session's cameras, rig and body. Out: an :class:`ArmState`, and runs as ``armsight run`` writes
them. One thread drives the board. A stop goes to it from its own thread, and is answered with the state that the board
itself reports. With ``poses:FILE`` nothing is driven: another program moves the arm, and logged its joint angles.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from armsight.app.board.command import not_homed
from armsight.app.live.handeye import HandEyeGuide, HandEyeState, IdentifyState, IdentifyStep, go, visit_poses
from armsight.app.live.measuring import MeasureStep
from armsight.app.live.records import asked
from armsight.app.live.step import PageStep, Shared, why
from armsight.app.options import LOGGED, SIM
from armsight.app.run.devices import require_joints, setup_of
from armsight.app.run.experiment import (
    RunResult,
    passed,
    require_followed,
    require_range,
    require_start,
    run_visits,
    start_rad,
)
from armsight.app.run.folder import finish, run_in
from armsight.app.run.logged import LoggedAngles, read_angles
from armsight.app.run.motion_file import MotionPlan, read_motions
from armsight.app.setup.finding import check_arm, check_model, find_board
from armsight.app.show.messages import require
from armsight.app.show.plotting import require_matplotlib
from armsight.data import Array, Missed, PoseEstimate, Shot
from armsight.errors import ArmsightError, DeviceError, InputError
from armsight.files import read_text, unused
from armsight.geometry.pose import inverse
from armsight.loop.estimators import Mounting
from armsight.loop.running.calibrate import VisitedPose, handeye_poses
from armsight.loop.running.log import NEWEST_SHOTS
from armsight.loop.running.loop import Loop
from armsight.loop.running.setup import HostClock, Setup
from armsight.loop.servo import likely_joint_errors
from armsight.robot.arm_file import open_arm
from armsight.robot.board_registry import FEETECH, emulator_name, is_real, open_motion_board, slowed
from armsight.robot.boards.codes import STATE_TEXTS, BoardState, Fault
from armsight.robot.boards.serial import list_ports
from armsight.robot.boards.stoppable import StoppableBoard
from armsight.robot.kinematics.arm import Arm
from armsight.robot.models import MODELS
from armsight.robot.trajectories import point_to_point
from armsight.vision.markers.targets import Composite, open_target
from armsight.vision.rig import StereoRig

_IDLE_S, _ASK_S = 0.004, 0.002
#: A pose of the hand-eye calibration is the mean of so long, s; joints, rad, and body, m, that move more do not rest.
_REST_S, _REST_RAD, _REST_M = 0.6, float(np.radians(0.3)), 1.5e-3
_HANDEYE_POSES = {False: 30, True: 14}
#: For a command of the loop, by whoever shows something, s; a loop that answered no shot for so long watches none, s.
_PATIENCE_S, _WATCHES_S = 0.1, 1.0
_SLOWLY = 0.25  # share of the arm's limits on the way to the start


@dataclass(frozen=True)
class StopAnswer:
    """The answer to a stop: whether the board itself says that it stopped, its state in words, and how long it took."""

    stopped: bool
    state: str
    took_ms: float


@dataclass(frozen=True)
class ArmState:
    """What a page shows of the arm."""

    arm: str = ""  # name or file
    arms: tuple[str, ...] = tuple(MODELS)  # the names that there are
    named: bool = False  # its port is known
    finding: str = ""  # what to do while the arm's port is looked for
    board: str | None = None  # None while it is not connected
    missing: str = ""
    state: str = "not connected"  # the board's, in words
    stopped: bool = False  # the board is in its emergency stop, or a person stopped it
    moves: bool = False  # this page can move the arm
    lacks: tuple[str, ...] = ()  # what this board cannot do
    faults: tuple[str, ...] = ()
    q_deg: tuple[float, ...] = ()  # joint angles by the potentiometers
    vision_deg: tuple[float, ...] = ()  # those that explain the pose that vision measures, less q_deg
    running: str | None = None  # what is being done
    error_mm: tuple[tuple[float, float, bool], ...] = ()  # time, s; tool from its reference, mm; loop closed
    handeye: HandEyeState = field(default_factory=HandEyeState)
    identify: IdentifyState = field(default_factory=IdentifyState)
    motion_file: str = ""
    away: bool = False  # the arm is elsewhere than where the motions start
    results: tuple[str, ...] = ()  # of the last run
    folder: str | None = None  # of the last run
    scene: tuple[tuple[float, ...], ...] = ()  # (N, 3) the joints in the left camera's frame, m
    command: str = ""  # the command line that does the same


class ArmStep(PageStep[ArmState]):
    """The arm's board, in a thread of its own; runs go to ``run``, ``run-2``, ...; ``held``: why it was held."""

    def __init__(self, shared: Shared, measuring: MeasureStep, model: Arm) -> None:
        super().__init__(shared, ArmState())
        self.model, self._measuring, self._simulated = model, measuring, shared.simulated
        self.handeye = HandEyeGuide(shared, model, shared.options.arm)
        self._identifying = IdentifyStep(shared, IdentifyState())
        self.held = ""
        self._board: StoppableBoard | None = None
        self._logged: LoggedAngles | None = None
        self._thread: threading.Thread | None = None
        self._closing = threading.Event()
        self._hold: str | None = None
        self._requested: Callable[[], None] | None = None
        self._lately: deque[tuple[float, Array]] = deque(maxlen=1000)
        self._q: Array | None = None
        self._mounting: Mounting | None = None
        self._loop: Loop | None = None
        self._answered, self._answered_s = threading.Event(), -np.inf  # a command has followed from a shot
        self._seen = 0
        self._chart: deque[tuple[float, float, bool]] = deque(maxlen=400)
        self._start: Array | None = None

    @property
    def busy(self) -> bool:
        """Whether a motion runs, or is about to."""
        return self.shown.running is not None or self._requested is not None

    @property
    def connected(self) -> bool:
        """Whether a board is connected, or its joint angles come from a file."""
        return self._board is not None or self._logged is not None

    @staticmethod
    def check_board(name: str | None, source: str, arm: Arm) -> None:
        """Reject the name of a board that cannot be right; the InputError names those there are, or the file's fault."""
        if name is None or is_real(name):
            return
        if name.startswith(LOGGED) and name != LOGGED:
            read_angles(name.removeprefix(LOGGED), arm)
        elif emulator_name(name) and not source.startswith(SIM):
            raise InputError(f"--board {name}: the emulated board and the workcell go together: --source sim:")

    @asked("arm")
    def open_arm(self) -> None:
        """Connect to the arm's board; the drives stay as they are."""
        name = self.shared.options.board
        if self.connected:
            return
        if name is None:
            self.find_arm()
            return
        if name.startswith(LOGGED):
            angles = read_angles(name.removeprefix(LOGGED), self.model)
            if angles.shots is None and angles.t_s is None:
                raise InputError(f"{angles.path}: has neither a column shot nor t_s: which image is each row of?")
            self._logged = angles
            return
        if self._simulated is not None:
            self.shared.capture.pause()
            self._board = StoppableBoard(self._simulated.workcell.board)
        else:
            check_model(name, self.shared.options.arm)
            try:
                board = StoppableBoard(open_motion_board(name))
            except DeviceError:
                check_arm(name)
                raise
            require_joints(board, name, self.model)
            self._board = board
        try:
            self._start = read_motions(self.model, self.shared.motion).start
        except InputError as error:
            self.say("warn", f"{error}: name a file with motions of this arm")
        self._thread = threading.Thread(target=self._work, args=(self._board,), name="arm", daemon=True)
        self._thread.start()

    @asked("arm")
    def find_arm(self) -> None:
        """Find the arm's port, and connect: the only arm that answers, or the one whose joint or cable a person moves."""
        if self.connected or self._simulated is not None:
            raise InputError("the arm's board is known: connect it")
        if not self.shown.finding:
            self.show(finding="Looking at the ports.")
            self.later("the arm was not found", self._find)

    def _find(self) -> None:
        try:
            name = find_board(lambda text: self.show(finding=text), self._ports)
        finally:
            self.show(finding="")
        self.say("good", f"the arm is at {name}")
        if name.startswith(FEETECH) and (file := self.shared.options.servo_calibration) is not None:
            name = f"{name},{file}"
        self.shared.options = replace(self.shared.options, board=name)
        self.open_arm()

    def _ports(self) -> list[str]:
        if self._closing.is_set():
            raise DeviceError("the session has ended")
        return list_ports()

    def stop(self) -> StopAnswer:
        """Stop in an emergency, and return what the board says of itself; may be called from any thread."""
        began, board = time.perf_counter(), self._board
        if board is None:
            return StopAnswer(False, "no board is connected: nothing moves by this page", 0.0)
        try:
            board.stop()
            stopped, state = board.rests, _state_text(board)
            self.say("warn", f"stop: {state}")
        except ArmsightError as error:
            stopped, state = False, f"the board is gone, it reacts to the silence itself: {error}"
        return StopAnswer(stopped, state, 1e3 * (time.perf_counter() - began))

    def hold_for(self, reason: str) -> None:
        """Bring the arm to rest and hold it, if it moves."""
        if self.busy:
            self._hold = self.held = reason
            self.say("warn", f"the arm is held: {reason}")

    @asked("arm")
    def hold(self) -> None:
        """Bring the arm to rest and hold it."""
        self.hold_for("a person requested it")

    @asked("arm")
    def run_motions(self, closed: bool = True) -> None:
        """Calibrate hand and eye and make the motions; ``closed``: a second time with the loop closed on vision."""
        if self.handeye.state.fitting:
            raise InputError("the hand-eye calibration is being computed: a moment")
        require_matplotlib()
        require("a run", "run", "pyarrow")
        self._move(partial(self._run, closed))

    @asked("arm")
    def guide_hand_eye(self) -> None:
        """Let the arm visit the poses of the hand-eye calibration by itself, until it is good."""
        self._move(self._visit)

    @asked("arm")
    def go_to_start(self) -> None:
        """Move the arm slowly to where the motions start, as after a stop."""
        self._move(self._to_start)

    def _move(self, work: Callable[[], None]) -> None:
        if missing := self._lacking():
            raise InputError(missing)
        if self.busy:
            raise InputError("a motion runs already: hold or stop it first")
        if self._stopped():
            raise InputError("the arm was stopped: allow the drives again first")
        self._hold, self.held = None, ""
        self._requested = work

    @asked("arm")
    def take_pose(self) -> None:
        """Take the pose in which the arm rests now for the hand-eye calibration."""
        if self.shown.running is not None:
            raise InputError("the arm takes its poses by itself now: hold it first")
        logged = self._logged
        seen = self._measuring.lately(_REST_S if logged is None else np.inf)
        if len(seen) < (2 if logged is None else 1):
            raise InputError(self._measuring.why_missed or "the body is not seen now")
        if logged is not None:
            seen, q = seen[-1:], self._logged_q()
            if q is None:
                raise InputError(f"{logged.path}: no row belongs to this image")
        else:
            now = time.monotonic()
            qs = np.array([q for at, q in list(self._lately) if now - at < _REST_S])
            if not len(qs):
                missing = "" if self._board is None else not_homed(self._board)
                raise InputError(missing or "no joints are read: connect the board first")
            if np.ptp(qs, axis=0).max() > _REST_RAD:
                raise InputError("a joint moves: take poses at rest")
            q = qs.mean(axis=0)
        if np.ptp([pose.T_left_body[:3, 3] for pose in seen], axis=0).max() > _REST_M:
            raise InputError("the body moves: take poses at rest")
        self.handeye.add(VisitedPose.of(q, seen, np.zeros_like(q)))
        if self.handeye.next_q is None and self._measuring.rig is not None:
            self.handeye.begin(q[None], None, self._measuring.rig)
        self.handeye.fit_soon()

    def forget_rig(self) -> None:
        """Forget what was found with a rig that is put aside: the hand-eye calibration, its poses and the mounting."""
        self.handeye.clear()
        self._mounting = None

    @asked("arm", rest=True)
    def clear_hand_eye(self) -> None:
        """Forget the hand-eye calibration and its poses."""
        self.handeye.clear()

    @asked("arm")
    def identify(self) -> None:
        """Identify the arm from the poses of the hand-eye calibration, or of the last run."""
        poses, folder = self.handeye.poses_file, self.shown.folder
        if poses is None and folder is not None:
            poses = Path(folder) / "handeye_poses.csv"
        self._identifying.start(self.shared.options.arm, poses)

    @asked("arm", rest=True)
    def use_arm(self, arm: str) -> None:
        """Use another arm: a name, a TOML or URDF file; hand and eye are calibrated anew from their poses."""
        model = slowed(open_arm(arm), self.shared.options.board or "")
        if self.connected:
            check_model(self.shared.options.board or "", arm)
        if model.joints != self.model.joints:
            if self.connected:
                raise InputError(f"{arm} has {model.joints} joints, {self.model.name} {self.model.joints}")
            self.handeye.clear()
        self.shared.options, self.model, self._mounting = replace(self.shared.options, arm=arm), model, None
        self.handeye.use_arm(model, arm)
        self.say("good", f"arm: {model.name} ({arm})")

    @asked("arm", rest=True)
    def use_motion(self, path: str) -> None:
        """Use the motions of another file."""
        plan = read_motions(self.model, path)
        self.shared.motion, self._start = Path(path), plan.start
        self.say("good", f"motions: {', '.join(each.name for each in plan.motions)} ({path})")

    @asked("arm")
    def clear_stop(self) -> None:
        """Allow the drives again after a stop; they stay off until the next motion."""
        if self._board is None:
            raise InputError("no board is connected")
        self._board.clear_stop()

    def _stopped(self) -> bool:
        board = self._board
        return board is not None and (board.stopped or board.status.state is BoardState.STOPPED)

    def close(self) -> None:
        """Hold the arm, end the thread, close the board."""
        self.hold_for("the session has ended")
        self._closing.set()
        if self._thread is not None:
            self._thread.join(5.0)
        self._pool.shutdown(wait=True)  # a run is being written
        self.handeye.close()
        self._identifying.close()
        if self._board is not None and self._simulated is None:
            self._board.close()

    def _lacking(self) -> str:
        if self._logged is not None:
            return f"{self.shared.options.board} commands no motion: another program moves the arm"
        if self._board is None:
            return "the board is not connected"
        if missing := not_homed(self._board):
            return missing
        if lacking := self._measuring.lacking:
            return lacking
        if not self._measuring.followed:
            return f"{self._measuring.target_spec} cannot be followed: the loop needs a body of three discs or more"
        return ""

    def _work(self, board: StoppableBoard) -> None:
        due, simulated = time.monotonic(), self._simulated
        try:
            while not self._closing.is_set():
                if self._requested is not None:
                    self._requested()
                    due = time.monotonic()
                elif simulated is not None and simulated.workcell.source.rendering:
                    time.sleep(_ASK_S)  # its time waits for the images, and a stop does not
                    continue
                states = board.receive(_IDLE_S)
                if not board.homed:  # what it reads are no angles of the arm
                    self._q = None
                    self._lately.clear()
                elif len(states.q):
                    self._q = states.q[-1]
                    self._lately.append((time.monotonic(), states.q[-1]))
                if simulated is not None:  # polled in every period, so that no image is rendered while a stop waits
                    self._look(simulated.poll if simulated.person.holds else simulated.poll_now)
                    due = max(due + _IDLE_S, time.monotonic() - 0.1)
                    time.sleep(max(0.0, due - time.monotonic()))
        except Exception as error:  # noqa: BLE001 - nobody else watches this thread; the board reacts to the silence itself
            self.say("error", f"the board is disconnected: {why(error)}")
            self._board = self._requested = None
            self.show(running=None)
            if simulated is None:
                board.close()
            else:
                self.shared.capture.resume()

    def _look(self, poll: Callable[[], Shot | None]) -> Shot | None:
        """Return the newest shot of the workcell, and show it; a camera that is gone is only shown."""
        capture = self.shared.capture
        try:
            shot = poll()
        except DeviceError as error:
            if capture.problem != str(error):
                self.say("error", str(error))
            capture.problem = str(error)
            if self.shown.running is not None:
                raise
            return None
        if shot is not None:
            capture.offer(shot)
        return None if shot is None or capture.newest is None else capture.newest.shot

    def _run(self, closed: bool) -> None:
        handeye, follow, folder = self.handeye.run, self.shared.options.follow_rig, unused(self.folder / "run")
        self._chart.clear()

        def work(setup: Setup, rig: StereoRig, plan: MotionPlan, targets: Array) -> RunResult:
            if follow:
                require_followed(rig, Path(self._measuring.rig_path or "rig.json"))
            body = read_text(str(self._measuring.target_spec))
            files = {"motion.toml": read_text(self.shared.motion), "body.toml": body}
            how: Any = {"close_loop": closed, "handeye": handeye, "follow_rig": follow, "begun": self._begun}
            how |= {"command": "live", "say": self.warn, "progress": self._progress}
            return run_in(folder, setup, rig, plan, targets, files, **how)

        outcome = self._moving("the run has ended early: {}; what was measured is being written", work)
        if outcome is not None:
            self.show(results=self._results(outcome), folder=str(folder))
            self.later(str(folder), self._write, outcome, folder)

    def _write(self, outcome: RunResult, folder: Path) -> None:
        finish(outcome, folder)
        self.say("good", f"the run is written to {folder}: report.html, summary.json")
        if outcome.health:
            self.say("error", f"do not trust this run: {outcome.health[0].line()}")

    def _visit(self) -> None:

        def work(setup: Setup, rig: StereoRig, plan: MotionPlan, targets: Array) -> RunResult:
            self.handeye.clear()
            self.handeye.begin(np.vstack([plan.start, targets]), setup.board.soft_limits(), rig)
            visit = lambda loop: visit_poses(loop, self.handeye, plan.start, self._progress)  # noqa: E731
            return run_visits(RunResult(setup, rig, plan), visit, self._progress, self._begun)

        outcome = self._moving("the hand-eye calibration has ended early: {}", work)
        if outcome is not None and outcome.ended_text is None and (run := self.handeye.run) is not None:
            self._mounting = run.mounting
            self.say("good", f"hand-eye: {len(run.q)} poses, held out {1e3 * run.found.held_out.rms()[0]:.2f} mm RMS")

    def _to_start(self) -> None:

        def work(setup: Setup, rig: StereoRig, plan: MotionPlan, targets: Array) -> RunResult:
            q = setup.board.receive(_REST_S).q.mean(axis=0)
            slow = replace(setup.arm, qd_max=_SLOWLY * setup.arm.qd_max, qdd_max=_SLOWLY * setup.arm.qdd_max)
            here = np.clip(q, *setup.board.soft_limits())
            way = point_to_point(slow, np.clip(here, slow.q_min, slow.q_max), plan.start)
            require_range(setup, passed(way))
            move = lambda loop: go(loop, way, self._progress)  # noqa: E731
            return run_visits(RunResult(setup, rig, plan), move, self._progress, self._begun, look=False)

        self._moving("the way to the start has ended early: {}", work, at_start=False)

    def _moving(
        self, ended: str, work: Callable[[Setup, StereoRig, MotionPlan, Array], RunResult], *, at_start: bool = True
    ) -> RunResult | None:
        """Do something that moves the arm; None where it could not begin; ``ended`` is said where it ends early."""
        self.show(running="preparing")
        self._seen, self._requested = 0, None
        rig, spec = self._measuring.rig, self._measuring.target_spec
        try:
            assert rig is not None
            target = open_target(str(spec))
            assert isinstance(target, Composite)
            setup = self._setup(target)
            plan, targets = self._plan()
            if at_start:
                require_start(setup, plan, targets)
            outcome = work(setup, rig, plan, targets)
        except ArmsightError as error:
            self.say("error", str(error))
            return None
        finally:
            self._loop = None
            self.show(running=None)
        if outcome.ended_text is not None:
            self.say("warn", ended.format(outcome.ended_text))
        return outcome

    def _setup(self, target: Composite) -> Setup:
        board, options, cameras = self._board, self.shared.options, self.shared.capture
        assert board is not None
        if self._simulated is not None:
            poll = partial(self._look, self._simulated.poll_now)
            return replace(setup_of(self._simulated.workcell), arm=self.model, board=board, target=target, poll=poll)
        if (rate_hz := cameras.rate_hz) is None:
            raise InputError("the rate of the cameras is not known yet: wait for a few images")
        return Setup(self.model, board, cameras.poll, target, np.zeros_like, rate_hz, options.sync_s, HostClock())

    def _plan(self) -> tuple[MotionPlan, Array]:
        arm = self.model
        plan, simulated = read_motions(arm, self.shared.motion), self._simulated
        ends = plan.ends if simulated is None else np.vstack([arm.home, simulated.workcell.poses])
        return plan, handeye_poses(arm, ends, _HANDEYE_POSES[simulated is not None], 0)

    def _progress(self, line: str) -> None:
        self.shown = replace(self.shown, running=line)  # the loop waits for no lock

    def _begun(self, loop: Loop) -> None:
        self._loop = loop
        loop.on_period = lambda: self._period(loop)

    def _period(self, loop: Loop) -> None:
        """Look after a running loop, once a period: end it by a DeviceError after a stop or a hold; and show it."""
        if self._board is not None and self._board.stopped:
            raise DeviceError(f"stopped by a person: {_state_text(self._board)}")
        if self._closing.is_set() or self._hold is not None:
            reason, self._hold = self._hold or "the session has ended", None
            raise DeviceError(f"the arm is held: {reason}")
        if len(loop.log.joints):
            self._q = loop.log.joints[-1].q[-1]
        if loop.log.shots == self._seen:
            return
        self._seen = loop.log.shots
        name, _, result = loop.log.poses[-1]
        newest = self.shared.capture.newest
        if newest is not None and newest.shot.name == name:
            self._measuring.take(newest, result)
        if isinstance(result, PoseEstimate) and loop.mounting is not None:
            self._mounting = loop.mounting
            self._note_error(loop)
        self._answered_s = time.monotonic()
        self._answered.set()

    def between_shots(self) -> None:
        """Wait, while a loop watches shots, until a command followed from one, 0.1 s at most: it shares the process."""
        if self._loop is not None and time.monotonic() - self._answered_s < _WATCHES_S:
            self._answered.clear()
            self._answered.wait(_PATIENCE_S)

    def _note_error(self, loop: Loop) -> None:
        """Append the distance of the tool, as the loop estimates it now, from its reference to the chart."""
        segment, now = loop.segment, loop.log.live[-1]
        if segment is None or (way := segment.trajectory) is None or segment.phase == "calibration":
            return
        since = way.duration_s if segment.phase == "rest" else now.t_s - segment.begin_s
        away = (now.T_base_tool - self.model.forward(way.at(since).q))[:3, 3]
        self._chart.append((now.t_s, 1e3 * float(np.linalg.norm(away)), segment.closed))

    def _results(self, outcome: RunResult) -> tuple[str, ...]:
        lines = []
        if outcome.handeye is not None:
            self._mounting, (position_m, angle_rad) = outcome.handeye.mounting, outcome.handeye.found.held_out.rms()
            lines.append(f"hand-eye: held out {1e3 * position_m:.2f} mm, {np.degrees(angle_rad):.3f} deg RMS")
        if outcome.delay_found:
            lines.append(f"delay of the images: {1e3 * outcome.delay.delay_s:.1f} ms")
        for name, closed in (("joint sensors alone", False), ("loop closed on vision", True)):
            if errors := [e for _, e, c in self._chart if c is closed]:
                rms = float(np.sqrt(np.mean(np.square(errors))))
                lines.append(f"{name}: {rms:.2f} mm RMS from the reference, estimated at {len(errors)} shots")
        if len(outcome.log.latency_s):
            p50, p99 = 1e3 * np.percentile(outcome.log.latency_s.array(1), (50, 99))
            lines.append(f"image to command: p50 {p50:.1f} ms, p99 {p99:.1f} ms")
        return tuple(lines)

    @property
    def latency_s(self) -> tuple[float, float] | None:
        """p50 and p99 from an image to its command in the loop that runs, s; None where none does."""
        loop = self._loop
        if loop is None or not len(loop.log.latency_s):
            return None
        p50, p99 = np.percentile(loop.log.latency_s.array(1)[-NEWEST_SHOTS:], (50, 99))
        return float(p50), float(p99)

    def now(self) -> ArmState:
        """Return what is shown, with what joints and vision say now."""
        options, board = self.shared.options, self._board
        q = self._q if self._logged is None else self._logged_q()
        vision, scene = self._vision(q)
        shown = replace(self.shown, arm=options.arm, named=options.board is not None, missing=self._lacking())
        shown = replace(shown, handeye=self.handeye.state, identify=self._identifying.state, command=self._command())
        shown = replace(shown, motion_file=str(self.shared.motion), vision_deg=vision, scene=scene)
        shown = replace(shown, q_deg=() if q is None else tuple(np.degrees(q).tolist()))
        if self._logged is not None:
            return replace(shown, board=options.board, state="joint angles of another program")
        if board is None:
            return shown
        status = board.status
        state, faults = _state_text(board), tuple(str(fault) for fault in status.faults)
        if all(each.fault is Fault.HOST_SILENT for each in status.faults):  # as after every motion
            state = "held at rest by the board since the last motion" if status.state is BoardState.HOLDING else state
            faults = ()
        off = 0.0 if q is None or self._start is None else float(np.abs(q - self._start).max())
        chart = tuple((round(t, 3), round(e, 4), c) for t, e, c in list(self._chart))
        shown = replace(shown, lacks=board.abilities.missing, away=off > start_rad(board.abilities), error_mm=chart)
        shown = replace(shown, board=board.welcome.board, state=state, faults=faults)
        return replace(shown, stopped=self._stopped(), moves=True)

    def _command(self) -> str:
        options, measuring = self.shared.options, self._measuring
        board = options.board or ("serial:PORT" if self._simulated is None else "emulated:")
        motion = f" --motion {self.shared.motion}{' --follow-rig' * options.follow_rig}" if self._logged is None else ""
        what = f"--rig {measuring.rig_path or 'rig.json'} --target {measuring.target_spec or 'body.toml'}"
        return f"armsight run --source {self.shared.source} --board {board} {what} --arm {options.arm}{motion} -o run"

    def _logged_q(self) -> Array | None:
        """Return the joint angles (n,), rad, that were logged at the newest shot; None where no row belongs to it."""
        newest = self._measuring.newest
        with contextlib.suppress(InputError):
            if newest is not None and self._logged is not None:
                return self._logged.at([newest[0].shot.name], [newest[0].shot.t_s])[0]
        return None

    def _vision(self, q: Array | None) -> tuple[tuple[float, ...], tuple[tuple[float, ...], ...]]:
        """Return vision's joint angles less the readings, degrees, and the arm's joints in the left camera's frame, m."""
        run = self.handeye.run
        mounting = run.mounting if run is not None and self._loop is None else self._mounting
        newest, arm = self._measuring.newest, self.model
        if mounting is None or q is None:
            return (), ()
        T_left_base = inverse(mounting.T_base_rig)
        frames = np.concatenate([arm.T_base_0[None], arm.links(q), arm.forward(q)[None]])
        scene = tuple(map(tuple, (T_left_base @ frames)[:, :3, 3].round(4).tolist()))
        if newest is None or isinstance(newest[1], Missed):
            return (), scene
        T = mounting.pose_measurement(newest[1], newest[0].shot.t_s or 0.0).T_base_tool
        return tuple(np.degrees(likely_joint_errors(arm, q, T)).tolist()), scene


def _state_text(board: StoppableBoard) -> str:
    if board.stopped and not board.abilities.releases:
        return "stopped: the drives hold the joints at rest, this controller cannot switch them off"
    return STATE_TEXTS[board.status.state]
