"""The arm: joint readings beside what vision measures, the motions in open and closed loop, and a stop that always works.

In: the arm's board, the session's cameras, rig and body. Out: an :class:`ArmState` at any time, and the folder of a run as
``armsight run`` writes it. One thread drives the board: it reads the joints and runs the experiment. A stop goes to the
board from its own thread (:class:`~armsight.app.live.board.StoppableBoard`), and is answered with the state that the board
itself reports. With ``poses:FILE`` nothing is driven: another program moves the arm, and logged its joint angles.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from armsight.app.live.board import StoppableBoard
from armsight.app.live.capture import CameraCapture
from armsight.app.live.handeye import HandEyeGuide, HandEyeState, likely_joint_errors, visit_poses
from armsight.app.live.identification import IdentifyState, IdentifyStep
from armsight.app.live.measuring import MeasureStep
from armsight.app.live.simulated import SimulatedCameras
from armsight.app.run.angles import LoggedAngles, read_angles
from armsight.app.run.calibrate import VisitedPose, handeye_poses
from armsight.app.run.controllers import Planned
from armsight.app.run.experiment import (
    RunResult,
    passed,
    require_followed,
    require_range,
    require_start,
    run_experiment,
    run_visits,
    start_rad,
)
from armsight.app.run.folder import Finished, finish, make_room
from armsight.app.run.loop import Loop
from armsight.app.run.motion_file import MotionPlan, read_motions
from armsight.app.run.record import RunSegment, require_pyarrow
from armsight.app.run.setup import HostClock, Setup, require_joints, setup_of
from armsight.app.show.messages import Note
from armsight.app.show.plotting import require_matplotlib
from armsight.app.stream.datum import Published
from armsight.app.stream.mcap_file import LazyMcap, properties
from armsight.data import Array, Missed, PoseEstimate, Shot
from armsight.errors import ArmsightError, DeviceError, InputError
from armsight.files import read_text, write_text
from armsight.geometry.pose import inverse
from armsight.loop.estimators import Mounting
from armsight.robot.arm_file import open_arm
from armsight.robot.board_registry import emulator_name, is_real, open_motion_board, slowed
from armsight.robot.boards.codes import STATE_TEXTS, BoardState, Fault
from armsight.robot.kinematics.arm import Arm
from armsight.robot.trajectories import point_to_point
from armsight.vision.markers.targets import Composite, open_target
from armsight.vision.rig import StereoRig

#: Joint angles that another program logged: ``--board poses:FILE``.
LOGGED = "poses:"
_IDLE_S, _ASK_S = 0.004, 0.002
#: A pose of the hand-eye calibration is the mean of so long, s; joints, rad, and body, m, that move more do not rest.
_REST_S, _REST_RAD, _REST_M = 0.6, float(np.radians(0.3)), 1.5e-3
_FEWEST_SEEN = 2
_HANDEYE_POSES, _CHART = {False: 30, True: 14}, 400
#: For a command of the loop, by whoever shows something, s; a loop that answered no shot for so long watches none, s.
_PATIENCE_S, _WATCHES_S = 0.1, 1.0
_SLOWLY = 0.25  # share of the arm's limits on the way to the start


@dataclass(frozen=True)
class ArmOptions:
    """What the arm is.

    Attributes:
        arm: the nominal arm.
        arm_spec: its name or file.
        board: the controller board's spec, such as serial:/dev/ttyACM0, feetech:PORT or poses:FILE; None without one.
        motion: file of the motions.
        rate_hz: rate of the cameras, Hz.
        sync_s: standard deviation of the time between the two exposures of a shot, s.
        source: spec of the cameras.
        calibration: LeRobot's calibration file of a servo bus; None without.
        follow_rig: whether a rig that moves during a run is put right.
    """

    arm: Arm
    arm_spec: str
    board: str | None
    motion: Path
    rate_hz: float
    sync_s: float
    source: str
    calibration: Path | None = None
    follow_rig: bool = False


@dataclass(frozen=True)
class StopAnswer:
    """The answer to a stop.

    Attributes:
        stopped: whether the board itself says that it stopped.
        state: the board's state, in words.
        took_ms: from the request to the board's state, ms.
    """

    stopped: bool
    state: str
    took_ms: float


@dataclass(frozen=True)
class ArmState:
    """What a page shows of the arm.

    Attributes:
        arm: its name.
        board: name of the board; None while it is not connected.
        missing: what is missing, one line.
        state: the board's state, in words.
        drives_on: whether the motors are driven.
        stopped: whether the board is in its emergency stop, or a person stopped it.
        moves: whether this page can move the arm.
        lacks: what this board cannot do.
        faults: latched faults.
        q_deg: joint angles by the potentiometers, degrees.
        vision_deg: joint angles that explain the pose that vision measures, less those, degrees; empty while unknown.
        running: what is being done; None while nothing is.
        phase: calibration, open_loop, closed_loop, rest; empty while nothing runs.
        motion: name of the motion.
        error_mm: (time, s; distance of the tool, as the loop estimates it, from the reference, mm; whether the loop is
            closed).
        handeye: the guided hand-eye calibration.
        identify: the identification.
        motion_file: the file of the motions.
        away: whether the arm is elsewhere than where the motions start.
        results: the results of the last run, line by line.
        folder: of the last run.
        scene: (N, 3) the arm's joints in the left camera's frame, m; empty before the hand-eye calibration.
        command: the command line that does the same.
    """

    arm: str
    board: str | None = None
    missing: str = ""
    state: str = "not connected"
    drives_on: bool = False
    stopped: bool = False
    moves: bool = False
    lacks: tuple[str, ...] = ()
    faults: tuple[str, ...] = ()
    q_deg: tuple[float, ...] = ()
    vision_deg: tuple[float, ...] = ()
    running: str | None = None
    phase: str = ""
    motion: str = ""
    error_mm: tuple[tuple[float, float, bool], ...] = ()
    handeye: HandEyeState = field(default_factory=HandEyeState)
    identify: IdentifyState = field(default_factory=IdentifyState)
    motion_file: str = ""
    away: bool = False
    results: tuple[str, ...] = ()
    folder: str | None = None
    scene: tuple[tuple[float, ...], ...] = ()
    command: str = ""


class ArmStep:
    """The arm's board, in a thread of its own.

    Args:
        folder: of the session; runs go to ``run``, ``run-2``, ... in it.
        options: what the arm is.
        capture: the session's cameras.
        measuring: has rig and body; is given the poses that the loop measures.
        simulated: the workcell where it stands for the devices; else None.
        say: called with a note for the person.

    Attributes:
        capture: the session's cameras.
        options: what the arm is.
        handeye: the guided hand-eye calibration.
        identify: the identification.
    """

    def __init__(
        self,
        folder: Path,
        options: ArmOptions,
        capture: CameraCapture,
        measuring: MeasureStep,
        simulated: SimulatedCameras | None,
        say: Callable[[Note], None],
    ) -> None:
        self.folder, self.options, self._say = folder, options, say
        self.capture, self._measuring, self._simulated = capture, measuring, simulated
        self._board: StoppableBoard | None = None
        self._logged: LoggedAngles | None = None
        self._thread: threading.Thread | None = None
        self._closing = threading.Event()
        self._hold: str | None = None
        self._requested: Callable[[], None] | None = None
        self.handeye = HandEyeGuide(folder, options.arm, options.arm_spec, say)
        self.identify = IdentifyStep(folder, say)
        self._lately: deque[tuple[float, Array]] = deque(maxlen=1000)
        self._writing = ThreadPoolExecutor(1, thread_name_prefix="write")
        self._q: Array | None = None
        self._mounting: Mounting | None = None
        self._running: str | None = None
        self._loop: Loop | None = None
        self._answered, self._answered_s = threading.Event(), -np.inf  # a command has followed from a shot
        self._seen = 0
        self._chart: deque[tuple[float, float, bool]] = deque(maxlen=_CHART)
        self._results, self._run_folder, self._start = (), None, None

    _results: tuple[str, ...]
    _run_folder: Path | None
    _start: Array | None

    @property
    def busy(self) -> bool:
        """Whether a motion runs, or is about to."""
        return self._running is not None or self._requested is not None

    @staticmethod
    def check_board(name: str | None, source: str, arm: Arm) -> None:
        """Reject the name of a board that cannot be right.

        Raises:
            InputError: the message names those there are, or what is wrong with the file of joint angles.
        """
        if name is None or is_real(name):
            return
        if name.startswith(LOGGED) and name != LOGGED:
            read_angles(name.removeprefix(LOGGED), arm)
            return
        if emulator_name(name) and not source.startswith("sim:"):
            raise InputError(f"--board {name}: the emulated board and the workcell go together: --source sim:")

    def open(self) -> None:
        """Connect to the board; its drives stay as they are.

        Raises:
            InputError: no board was named.
            DeviceError: it does not answer.
        """
        if self._board is not None or self._logged is not None:
            return
        options = self.options
        if self._simulated is not None:
            self.capture.pause()
            self._board = StoppableBoard(self._simulated.workcell.board)
        elif options.board is None:
            raise InputError(
                "no board was named: start with --board serial:/dev/ttyACM0, feetech:PORT, ar4:PORT (docs/howto/board.md), "
                "or poses:FILE where another program moves the arm"
            )
        elif options.board.startswith(LOGGED):
            angles = read_angles(options.board.removeprefix(LOGGED), options.arm)
            if angles.shots is None and angles.t_s is None:
                raise InputError(
                    f"{angles.path}: has neither a column shot nor t_s: which image does each row belong to?"
                )
            self._logged = angles
            return
        else:
            board = StoppableBoard(open_motion_board(options.board, calibration=options.calibration))
            try:
                require_joints(board, options.board, options.arm)
            except InputError:
                board.close()
                raise
            self._board = board
        try:
            self._start = read_motions(options.arm, options.motion).start
        except InputError as error:
            self._say(Note("warn", f"{error}: name a file with motions of this arm"))
        self._thread = threading.Thread(target=self._work, name="arm", daemon=True)
        self._thread.start()

    def stop(self) -> StopAnswer:
        """Stop in an emergency, and return what the board says of itself; may be called from any thread."""
        began, board = time.perf_counter(), self._board
        if board is None:
            return StopAnswer(False, "no board is connected: nothing moves by this page", 0.0)
        try:
            board.stop()
        except ArmsightError as error:
            took = 1e3 * (time.perf_counter() - began)
            return StopAnswer(False, f"the board is gone, it reacts to the silence itself: {error}", took)
        answer = StopAnswer(board.rests, _state_text(board), 1e3 * (time.perf_counter() - began))
        self._say(Note("warn", f"stop: {answer.state}"))
        return answer

    def hold(self, why: str) -> None:
        """Bring the arm to rest and hold it, if it moves."""
        if self.busy:
            self._hold = why

    def run(self, *, closed: bool) -> None:
        """Make the motions; calibrate hand and eye before, unless it was done.

        Raises:
            InputError: something is missing or a motion runs already.
        """
        self._require_ready()
        if self.handeye.state.fitting:
            raise InputError("the hand-eye calibration is being computed: a moment")
        require_matplotlib()
        require_pyarrow()
        self._hold = None
        self._requested = lambda: self._run(closed=closed)

    def guide_handeye(self) -> None:
        """Let the arm visit the poses of the guided hand-eye calibration by itself, until it is good.

        Raises:
            InputError: as for :meth:`run`.
        """
        self._require_ready()
        self._hold = None
        self._requested = self._visit

    def go_to_start(self) -> None:
        """Move the arm slowly to where the motions start.

        Raises:
            InputError: as for :meth:`run`.
        """
        self._require_ready()
        self._hold = None
        self._requested = self._to_start

    def take_pose(self) -> None:
        """Take the pose in which the arm rests now for the hand-eye calibration.

        Raises:
            InputError: no joints are read, the body is not seen, something moves, or a pose like it was taken.
        """
        if self._running is not None:
            raise InputError("the arm takes its poses by itself now: hold it first")
        seen = self._measuring.lately(_REST_S if self._logged is None else np.inf)
        if len(seen) < (_FEWEST_SEEN if self._logged is None else 1):
            raise InputError(self._measuring.why_missed or "the body is not seen now")
        if self._logged is not None:
            seen, q = seen[-1:], self._logged_q()
            if q is None:
                raise InputError(f"{self._logged.path}: no row belongs to this image")
        else:
            now = time.monotonic()
            qs = np.array([q for at, q in list(self._lately) if now - at < _REST_S])
            if not len(qs):
                raise InputError("no joints are read: connect the board first")
            if np.ptp(qs, axis=0).max() > _REST_RAD:
                raise InputError("a joint moves: take poses at rest")
            q = qs.mean(axis=0)
        p = np.array([pose.T_left_body[:3, 3] for pose in seen])
        if np.ptp(p, axis=0).max() > _REST_M:
            raise InputError("the body moves: take poses at rest")
        self.handeye.add(VisitedPose.of(q, seen, np.zeros_like(q)))
        if self.handeye.next_q is None and self._measuring.rig is not None:
            self.handeye.begin(q[None], None, self._measuring.rig)
        self.handeye.fit_soon()

    def identify_arm(self) -> None:
        """Identify the arm from the poses of the hand-eye calibration, or of the last run.

        Raises:
            InputError: there are none.
        """
        poses = self.handeye.poses_file
        if poses is None and self._run_folder is not None:
            poses = self._run_folder / "handeye_poses.csv"
        self.identify.start(self.options.arm_spec, poses)

    def use_arm(self, spec: str) -> None:
        """Take another model of the arm, such as the corrected one; the hand-eye calibration is made anew from its poses.

        Raises:
            InputError: it cannot be opened, or it has another number of joints.
        """
        self._require_rest()
        arm = slowed(open_arm(spec), self.options.board or "")
        if arm.joints != self.options.arm.joints:
            raise InputError(f"{spec} has {arm.joints} joints, {self.options.arm.name} {self.options.arm.joints}")
        self.options = replace(self.options, arm=arm, arm_spec=spec)
        self._mounting = None
        self.handeye.use_arm(arm, spec)
        self._say(Note("good", f"arm: {arm.name} ({spec})"))

    def use_motion(self, path: str) -> None:
        """Take the motions of another file.

        Raises:
            InputError: it cannot be read, or the arm cannot make a motion.
        """
        self._require_rest()
        plan = read_motions(self.options.arm, path)
        self.options, self._start = replace(self.options, motion=Path(path)), plan.start
        self._say(Note("good", f"motions: {', '.join(each.name for each in plan.motions)} ({path})"))

    def clear_stop(self) -> None:
        """Allow the drives again after a stop.

        Raises:
            InputError: no board is connected.
            DeviceError: the board rejects it.
        """
        if self._board is None:
            raise InputError("no board is connected")
        self._board.clear_stop()

    def _require_rest(self) -> None:
        if self.busy:
            raise InputError("a motion runs already: hold or stop it first")

    def _require_ready(self) -> None:
        if missing := self._lacking():
            raise InputError(missing)
        self._require_rest()
        if self._board is not None and self._stopped():
            raise InputError("the arm was stopped: allow the drives again first")

    def _stopped(self) -> bool:
        board = self._board
        return board is not None and (board.stopped or board.status.state is BoardState.STOPPED)

    def close(self) -> None:
        """Hold the arm, end the thread, close the board."""
        self.hold("the session has ended")
        self._closing.set()
        if self._thread is not None:
            self._thread.join(5.0)
        self._writing.shutdown(wait=True)
        self.handeye.close()
        self.identify.close()
        if self._board is not None and self._simulated is None:
            self._board.close()

    def _lacking(self) -> str:
        """Return what is missing for a run; empty where nothing is."""
        measuring = self._measuring
        if self._logged is not None:
            return f"{self.options.board} commands no motion: another program moves the arm"
        if self._board is None:
            return "the board is not connected"
        if measuring.rig is None:
            return "no calibrated rig yet: finish the calibration first, or give --rig"
        if measuring.target_spec is None:
            return "no body yet: choose one in the step Body"
        if not measuring.followed:
            return f"{measuring.target_spec} cannot be followed: the loop needs a body of three discs or more"
        return ""

    def _work(self) -> None:
        """Read the board until the session ends."""
        board = self._board
        assert board is not None
        due = time.monotonic()
        try:
            while not self._closing.is_set():
                if self._requested is not None:
                    self._requested()
                    due = time.monotonic()
                elif self._simulated is not None and self._simulated.workcell.source.rendering:
                    time.sleep(_ASK_S)  # its time waits for the images, and a stop does not
                    continue
                states = board.receive(_IDLE_S)
                if len(states.q):
                    self._q = states.q[-1]
                    self._lately.append((time.monotonic(), states.q[-1]))
                if self._simulated is not None:
                    simulated = (
                        self._simulated
                    )  # polled in every period, so that no image is rendered while a stop waits
                    self._look(simulated.poll if simulated.person.holds else simulated.poll_now)
                    due = max(due + _IDLE_S, time.monotonic() - 0.1)
                    time.sleep(max(0.0, due - time.monotonic()))
        except ArmsightError as error:
            self._gone(board, str(error))
        except Exception as error:  # noqa: BLE001 - nobody else watches this thread; the board reacts to the silence itself
            self._gone(board, f"{type(error).__name__}: {error}")

    def _gone(self, board: StoppableBoard, why: str) -> None:
        """Give the board up."""
        self._say(Note("error", f"the board is disconnected: {why}"))
        self._board, self._running, self._requested = None, None, None
        if self._simulated is None:
            board.close()
        else:
            self.capture.resume()

    def _look(self, poll: Callable[[], Shot | None]) -> Shot | None:
        """Return the newest shot of the workcell, and show it; a camera that is gone is only shown."""
        try:
            shot = poll()
        except DeviceError as error:
            if self.capture.problem != str(error):
                self._say(Note("error", str(error)))
            self.capture.problem = str(error)
            if self._running is not None:
                raise
            return None
        if shot is not None:
            self.capture.offer(shot)
            newest = self.capture.newest
            return None if newest is None else newest.shot
        return None

    def _run(self, *, closed: bool) -> None:
        """Run the experiment, and write its folder in another thread."""
        began, handeye = time.perf_counter(), self.handeye.run
        self._chart.clear()
        folder: Path | None = None
        finished: Finished | None = None

        def work(setup: Setup, rig: StereoRig, plan: MotionPlan, targets: Array) -> RunResult:
            nonlocal folder, finished
            if self.options.follow_rig:
                require_followed(rig, Path(self._measuring.rig_path or "rig.json"))
            folder = self._fresh()
            make_room(folder)
            write_text(folder / "motion.toml", read_text(self.options.motion))
            body_text = read_text(str(self._measuring.target_spec))
            write_text(folder / "body.toml", body_text)
            rig.save(folder / "rig.json")
            texts = properties(rig, body_text, setup.arm, command="live")
            published = Published(rig, setup.target.body, setup.arm, texts)
            warn = lambda line: self._say(Note("warn", line.removeprefix("note: ")))  # noqa: E731
            with contextlib.closing(LazyMcap(folder, published, warn)) as file:
                outcome = run_experiment(
                    setup,
                    rig,
                    plan,
                    targets,
                    progress=self._progress,
                    close_loop=closed,
                    begun=self._begun,
                    handeye=handeye,
                    publisher=file,
                    follow_rig=self.options.follow_rig,
                )
            of_run = {"arm": setup.arm.name, "board": setup.board.welcome.board}
            finished = Finished(setup.arm, rig, outcome, plan, None, of_run, began, [], None)
            return outcome

        outcome = self._moving(work)
        if outcome is None or finished is None or folder is None:
            return
        if outcome.ended_text is not None:
            self._say(
                Note("warn", f"the run has ended early: {outcome.ended_text}; what was measured is being written")
            )
        self._take(outcome)
        self._run_folder = folder
        self._writing.submit(self._write, finished, folder)

    def _visit(self) -> None:
        """Visit the poses of the guided hand-eye calibration."""

        def work(setup: Setup, rig: StereoRig, plan: MotionPlan, targets: Array) -> RunResult:
            self.handeye.clear()
            self.handeye.begin(np.vstack([plan.start, targets]), setup.board.soft_limits(), rig)
            return run_visits(
                setup,
                rig,
                plan,
                lambda loop: visit_poses(loop, self.handeye, plan.start, self._progress),
                progress=self._progress,
                begun=self._begun,
            )

        outcome = self._moving(work)
        if outcome is not None and outcome.ended_text is not None:
            self._say(Note("warn", f"the hand-eye calibration has ended early: {outcome.ended_text}"))
        elif outcome is not None and (run := self.handeye.run) is not None:
            self._mounting = run.mounting
            mm = 1e3 * run.found.held_out.rms()[0]
            self._say(Note("good", f"hand-eye: {len(run.q)} poses, held out {mm:.2f} mm RMS"))

    def _to_start(self) -> None:
        """Move slowly from where the arm is to the start."""

        def work(setup: Setup, rig: StereoRig, plan: MotionPlan, targets: Array) -> RunResult:
            q = setup.board.receive(_REST_S).q.mean(axis=0)
            slow = replace(setup.arm, qd_max=_SLOWLY * setup.arm.qd_max, qdd_max=_SLOWLY * setup.arm.qdd_max)
            here = np.clip(q, *setup.board.soft_limits())
            way = point_to_point(slow, np.clip(here, slow.q_min, slow.q_max), plan.start)
            require_range(setup, passed(way))

            def move(loop: Loop) -> None:
                self._running = "to the start"
                segment = RunSegment("calibration", "to the start", "joints", False, trajectory=way)
                loop.run(Planned(way, loop.t_s, setup.gravity), way.duration_s + 0.3, segment, watch=False)

            return run_visits(setup, rig, plan, move, progress=self._progress, begun=self._begun, look=False)

        outcome = self._moving(work, at_start=False)
        if outcome is not None and outcome.ended_text is not None:
            self._say(Note("warn", f"the way to the start has ended early: {outcome.ended_text}"))

    def _moving(
        self, work: Callable[[Setup, StereoRig, MotionPlan, Array], RunResult], *, at_start: bool = True
    ) -> RunResult | None:
        """Do something that moves the arm, once all is there that it needs; None where it could not begin."""
        measuring = self._measuring
        self._running, self._seen = "preparing", 0
        self._requested = None
        rig, spec = measuring.rig, measuring.target_spec
        assert rig is not None
        assert spec is not None
        try:
            target = open_target(spec)
            assert isinstance(target, Composite)
            setup = self._setup(target)
            plan, targets = self._plan()
            if at_start:
                require_start(setup, plan, targets)
            return work(setup, rig, plan, targets)
        except ArmsightError as error:
            self._say(Note("error", str(error)))
            return None
        finally:
            self._running, self._loop = None, None

    def _write(self, finished: Finished, folder: Path) -> None:
        try:
            summary = finish(finished, folder)
        except Exception as error:  # noqa: BLE001 - nobody else watches this thread
            why = str(error) if isinstance(error, ArmsightError) else f"not written: {type(error).__name__}: {error}"
            self._say(Note("error", f"{folder}: {why}"))
            return
        self._say(Note("good", f"the run is written to {folder}: report.html, summary.json"))
        if summary.health:
            self._say(Note("error", f"do not trust this run: {summary.health[0].line()}"))

    def _setup(self, target: Composite) -> Setup:
        """Return the devices as the loop takes them."""
        board, options = self._board, self.options
        assert board is not None
        if self._simulated is not None:
            simulated = self._simulated
            poll = lambda: self._look(simulated.poll_now)  # noqa: E731
            return replace(setup_of(simulated.workcell), arm=options.arm, board=board, target=target, poll=poll)
        return Setup(
            options.arm,
            board,
            self.capture.poll,
            target,
            np.zeros_like,
            self.capture.rate_hz or options.rate_hz,
            options.sync_s,
            HostClock(),
        )

    def _plan(self) -> tuple[MotionPlan, Array]:
        """Return the motions, and the joint angles (N, 6) of the hand-eye poses, rad."""
        arm = self.options.arm
        plan = read_motions(arm, self.options.motion)
        ends = [plan.start, *(m.trajectory.at(m.trajectory.duration_s).q for m in plan.motions)]
        if self._simulated is not None:
            ends = list(np.vstack([arm.home, self._simulated.workcell.poses]))
        return plan, handeye_poses(arm, np.array(ends), _HANDEYE_POSES[self._simulated is not None], 0)

    def _fresh(self) -> Path:
        number, path = 1, self.folder / "run"
        while path.exists():
            number += 1
            path = self.folder / f"run-{number}"
        return path

    def _progress(self, line: str) -> None:
        self._running = line

    def _begun(self, loop: Loop) -> None:
        self._loop = loop
        loop.on_period = lambda: self._period(loop)

    def _period(self, loop: Loop) -> None:
        """Look after a running loop, once a period: stop, hold, and what is to be shown.

        Raises:
            DeviceError: a person stopped or held the arm.
        """
        if self._board is not None and self._board.stopped:
            raise DeviceError(f"stopped by a person: {_state_text(self._board)}")
        if self._closing.is_set() or self._hold is not None:
            why, self._hold = self._hold or "the session has ended", None
            raise DeviceError(f"the arm is held: {why}")
        if len(loop.log.joints):
            self._q = loop.log.joints[-1].q[-1]
        if len(loop.log.poses) == self._seen:
            return
        self._seen = len(loop.log.poses)
        name, _, result = loop.log.poses[-1]
        newest = self.capture.newest
        if newest is not None and newest.shot.name == name:
            self._measuring.take(newest, result)
        if isinstance(result, PoseEstimate) and loop.mounting is not None:
            self._mounting = loop.mounting
            self._note_error(loop)
        self._answered_s = time.monotonic()
        self._answered.set()

    def between_shots(self) -> None:
        """Wait, while a loop watches shots, until a command has followed from one, 0.1 s at most.

        The loop shares the interpreter with all other threads; what is computed in the time from there to the next shot
        delays no image's command.
        """
        if self._loop is not None and time.monotonic() - self._answered_s < _WATCHES_S:
            self._answered.clear()
            self._answered.wait(_PATIENCE_S)

    def _note_error(self, loop: Loop) -> None:
        """Append the distance of the tool, as the loop estimates it now, from its reference to the chart."""
        segment, now = loop.segment, loop.log.live[-1]
        if segment is None or segment.trajectory is None or segment.phase == "calibration":
            return
        way = segment.trajectory
        since = way.duration_s if segment.phase == "rest" else now.t_s - segment.begin_s
        reference = self.options.arm.forward(way.at(since).q)
        away = now.T_base_tool[:3, 3] - reference[:3, 3]
        self._chart.append((now.t_s, 1e3 * float(np.linalg.norm(away)), segment.closed))

    def _take(self, outcome: RunResult) -> None:
        """Take in what a run found."""
        lines = []
        if outcome.handeye is not None:
            self._mounting, (position_m, angle_rad) = outcome.handeye.mounting, outcome.handeye.found.held_out.rms()
            lines.append(f"hand-eye: held out {1e3 * position_m:.2f} mm, {np.degrees(angle_rad):.3f} deg RMS")
        if outcome.delay_found:
            lines.append(f"delay of the images: {1e3 * outcome.delay.delay_s:.1f} ms")
        for name, closed in (("joint sensors alone", False), ("loop closed on vision", True)):
            errors = [e for _, e, c in self._chart if c is closed]
            if errors:
                rms = float(np.sqrt(np.mean(np.square(errors))))
                lines.append(
                    f"{name}: {rms:.2f} mm RMS from the reference, as the loop estimates at {len(errors)} shots"
                )
        if len(outcome.log.latency_s):
            p50, p99 = 1e3 * np.percentile(outcome.log.latency_s, (50, 99))
            lines.append(f"image to command: p50 {p50:.1f} ms, p99 {p99:.1f} ms")
        self._results = tuple(lines)

    @property
    def latency_s(self) -> tuple[float, float] | None:
        """p50 and p99 from an image to its command in the loop that runs, s; None where none does."""
        loop = self._loop
        if loop is None or not loop.log.latency_s:
            return None
        p50, p99 = np.percentile(list(loop.log.latency_s), (50, 99))
        return float(p50), float(p99)

    @property
    def state(self) -> ArmState:
        """What to show now."""
        options, board, loop = self.options, self._board, self._loop
        plain = ArmState(
            options.arm.name,
            missing=self._lacking(),
            handeye=self.handeye.state,
            identify=self.identify.state,
            motion_file=str(options.motion),
            command=self._command(),
        )
        q = self._q if self._logged is None else self._logged_q()
        vision, scene = self._vision(q)
        plain = replace(
            plain, q_deg=() if q is None else tuple(float(x) for x in np.degrees(q)), vision_deg=vision, scene=scene
        )
        if self._logged is not None:
            return replace(plain, board=options.board, state="joint angles of another program")
        if board is None:
            return plain
        status = board.status
        segment = None if loop is None else loop.segment
        state, faults = _state_text(board), tuple(str(fault) for fault in status.faults)
        if all(each.fault is Fault.HOST_SILENT for each in status.faults):  # as after every motion
            state = "held at rest by the board since the last motion" if status.state is BoardState.HOLDING else state
            faults = ()
        return replace(
            plain,
            board=board.welcome.board,
            state=state,
            drives_on=status.drives_on,
            stopped=self._stopped(),
            moves=True,
            lacks=board.abilities.missing,
            faults=faults,
            running=self._running,
            away=q is not None
            and self._start is not None
            and bool(np.abs(q - self._start).max() > start_rad(board.abilities)),
            phase="" if segment is None else segment.phase,
            motion="" if segment is None else segment.motion,
            error_mm=tuple((round(t, 3), round(e, 4), c) for t, e, c in list(self._chart)),
            results=self._results,
            folder=None if self._run_folder is None else str(self._run_folder),
        )

    def _command(self) -> str:
        """The command that runs the same."""
        options, measuring = self.options, self._measuring
        motion = f" --motion {options.motion}{' --follow-rig' * options.follow_rig}" if self._logged is None else ""
        return (
            f"armsight run --source {options.source} --board {options.board or 'serial:PORT'} --rig "
            f"{measuring.rig_path or 'rig.json'} --target {measuring.target_spec or 'body.toml'} "
            f"--arm {options.arm_spec}{motion} -o run"
        )

    def _logged_q(self) -> Array | None:
        """Return the joint angles (n,), rad, that were logged at the newest shot; None where no row belongs to it."""
        newest = self._measuring.newest
        if newest is None or self._logged is None:
            return None
        shot = newest[0].shot
        try:
            return self._logged.at([shot.name], [shot.t_s])[0]
        except InputError:
            return None

    def _vision(self, q: Array | None) -> tuple[tuple[float, ...], tuple[tuple[float, ...], ...]]:
        """Return vision's joint angles less the readings, degrees, and the arm's joints in the left camera's frame, m."""
        run = self.handeye.run
        mounting = run.mounting if run is not None and self._loop is None else self._mounting
        newest, arm = self._measuring.newest, self.options.arm
        if mounting is None or q is None:
            return (), ()
        T_left_base = inverse(mounting.T_base_rig)
        frames = np.concatenate([arm.T_base_0[None], arm.links(q), arm.forward(q)[None]])
        scene = tuple(tuple(round(float(x), 4) for x in T[:3, 3]) for T in T_left_base @ frames)
        if newest is None or isinstance(newest[1], Missed):
            return (), scene
        T = mounting.pose_measurement(newest[1], newest[0].shot.t_s or 0.0).T_base_tool
        return tuple(float(x) for x in np.degrees(likely_joint_errors(arm, q, T))), scene


def _state_text(board: StoppableBoard) -> str:
    """Return a board's state in words."""
    if board.stopped and not board.abilities.releases:
        return "stopped: the drives hold the joints at rest, this controller cannot switch them off"
    return STATE_TEXTS[board.status.state]
