"""The arm: joint readings beside what vision measures, the motions in open and closed loop, and a stop that always works.

In: the arm's board, the session's cameras, rig and body. Out: an :class:`ArmState` at any time, and the folder of a run as
``armsight run`` writes it. One thread has the board: it reads the joints, runs the experiment, and carries out a stop
within a period of the loop; nobody else touches the board. A stop is answered with the state that the board itself reports.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from armsight.app.live.capture import CameraCapture
from armsight.app.live.measuring import MeasureStep
from armsight.app.live.quality import Note
from armsight.app.live.simulated import SimulatedCameras
from armsight.app.report.plotting import require_matplotlib
from armsight.app.run.calibrate import handeye_poses
from armsight.app.run.experiment import RunResult, require_start, run_experiment
from armsight.app.run.folder import Finished, finish, make_room
from armsight.app.run.loop import Loop
from armsight.app.run.motion_file import MotionPlan, read_motions
from armsight.app.run.record import require_pyarrow
from armsight.app.run.setup import HostClock, Setup, setup_of
from armsight.data import Array, Missed, PoseEstimate, Shot
from armsight.errors import ArmsightError, DeviceError, InputError
from armsight.files import read_text, write_text
from armsight.loop.estimators import Mounting
from armsight.robot.arm import Arm
from armsight.robot.boards.board import Board
from armsight.robot.boards.codes import STATE_TEXTS, BoardState, Command, Fault
from armsight.robot.boards.opening import open_board
from armsight.vision.follow.follower import follows
from armsight.vision.markers.targets import Composite, open_target

#: How long a stop waits for the board's answer, and how often the board is asked meanwhile, s.
ANSWER_S, _ASK_S = 1.0, 0.002
_IDLE_S = 0.004
_HANDEYE_POSES = {False: 30, True: 14}
_CHART = 400


@dataclass(frozen=True)
class ArmOptions:
    """What the arm is.

    Attributes:
        arm: the nominal arm.
        arm_spec: its name or file.
        board: the controller board's spec, such as serial:/dev/ttyACM0; None without one.
        motion: file of the motions.
        rate_hz: rate of the cameras, Hz.
        sync_s: standard deviation of the time between the two exposures of a shot, s.
        source: spec of the cameras.
    """

    arm: Arm
    arm_spec: str
    board: str | None
    motion: Path
    rate_hz: float
    sync_s: float
    source: str


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
        stopped: whether the board is in its emergency stop.
        faults: latched faults.
        q_deg: joint angles by the potentiometers, degrees.
        vision_deg: joint angles that explain the pose that vision measures, less those, degrees; empty while unknown.
        running: what is being done; None while nothing is.
        phase: calibration, open_loop, closed_loop, rest; empty while nothing runs.
        motion: name of the motion.
        error_mm: (time, s; distance of the tool, as the loop estimates it, from the reference, mm; whether the loop is
            closed).
        handeye: the hand-eye calibration in words.
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
    faults: tuple[str, ...] = ()
    q_deg: tuple[float, ...] = ()
    vision_deg: tuple[float, ...] = ()
    running: str | None = None
    phase: str = ""
    motion: str = ""
    error_mm: tuple[tuple[float, float, bool], ...] = ()
    handeye: str = ""
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
        self._board: Board | None = None
        self._thread: threading.Thread | None = None
        self._closing, self._stop, self._answered = threading.Event(), threading.Event(), threading.Event()
        self._hold: str | None = None
        self._requested: bool | None = None  # to run; whether the loop is closed
        self._clear = False
        self._writing = ThreadPoolExecutor(1, thread_name_prefix="write")
        self._q: Array | None = None
        self._mounting: Mounting | None = None
        self._running: str | None = None
        self._loop: Loop | None = None
        self._seen = 0
        self._chart: deque[tuple[float, float, bool]] = deque(maxlen=_CHART)
        self._handeye, self._results, self._run_folder = "", (), None

    _results: tuple[str, ...]
    _run_folder: Path | None

    @property
    def busy(self) -> bool:
        """Whether a motion runs."""
        return self._running is not None

    @property
    def owns_cameras(self) -> bool:
        """Whether the thread reads the cameras: those of the workcell, whose time passes on the board."""
        return self._simulated is not None and self._board is not None

    def open(self) -> None:
        """Connect to the board; its drives stay as they are.

        Raises:
            InputError: no board was named.
            DeviceError: it does not answer.
        """
        if self._board is not None:
            return
        if self._simulated is not None:
            self.capture.pause()
            board = self._simulated.workcell.board
            if not isinstance(board, Board):
                raise InputError(
                    f"{board.welcome.board} keeps its own controller; the page moves arms with our firmware"
                )
            self._board = board
        elif self.options.board is None:
            raise InputError("no board was named: start with --board serial:/dev/ttyACM0 (docs/howto/board.md)")
        else:
            self._board = open_board(self.options.board)
        self._thread = threading.Thread(target=self._work, name="arm", daemon=True)
        self._thread.start()

    def stop(self) -> StopAnswer:
        """Stop in an emergency, and return what the board says of itself; may be called from any thread."""
        began = time.perf_counter()
        if self._board is None:
            return StopAnswer(False, "no board is connected: nothing moves by this page", 0.0)
        self._answered.clear()
        self._stop.set()
        self._answered.wait(ANSWER_S)
        board = self._board
        state = None if board is None else board.status.state
        took = 1e3 * (time.perf_counter() - began)
        if state is None:
            return StopAnswer(False, "the board is gone: it reacts to the silence itself", took)
        return StopAnswer(state is BoardState.STOPPED, STATE_TEXTS[state], took)

    def hold(self, why: str) -> None:
        """Bring the arm to rest and hold it, if it moves."""
        if self._running is not None:
            self._hold = why

    def run(self, *, closed: bool) -> None:
        """Calibrate hand and eye and make the motions.

        Raises:
            InputError: something is missing or a motion runs already.
        """
        if missing := self._lacking():
            raise InputError(missing)
        if self._running is not None or self._requested is not None:
            raise InputError("a motion runs already: hold or stop it first")
        require_matplotlib()
        require_pyarrow()
        self._hold = None
        self._requested = closed

    def clear_stop(self) -> None:
        """Allow the drives again after a stop."""
        if self._board is None:
            raise InputError("no board is connected")
        self._clear = True

    def close(self) -> None:
        """Hold the arm, end the thread, close the board."""
        self.hold("the session has ended")
        self._closing.set()
        if self._thread is not None:
            self._thread.join(5.0)
        self._writing.shutdown(wait=True)
        if self._board is not None and self._simulated is None:
            self._board.close()

    def _lacking(self) -> str:
        """Return what is missing for a run; empty where nothing is."""
        measuring = self._measuring
        if self._board is None:
            return "the board is not connected"
        if measuring.rig is None:
            return "no calibrated rig yet: finish the calibration first, or give --rig"
        if measuring.target_spec is None:
            return "no body yet: choose one in the step Body"
        if not follows(open_target(measuring.target_spec)):
            return f"{measuring.target_spec} cannot be followed: the loop needs a body of three discs or more"
        return ""

    def _work(self) -> None:
        """Read the board until the session ends."""
        board = self._board
        assert board is not None
        due = time.monotonic()
        try:
            while not self._closing.is_set():
                if self._stop.is_set():
                    self._stop_now()
                elif self._clear:
                    self._clear = False
                    board.confirm(board.command(Command.CLEAR_STOP))
                elif self._requested is not None:
                    self._run(closed=self._requested)
                    due = time.monotonic()
                elif self._simulated is not None and self._simulated.workcell.source.rendering:
                    time.sleep(_ASK_S)  # its time waits for the images, and a stop does not
                    continue
                states = board.receive(_IDLE_S)
                if len(states.q):
                    self._q = states.q[-1]
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
        finally:
            self._answered.set()

    def _gone(self, board: Board, why: str) -> None:
        """Give the board up."""
        self._say(Note("error", f"the board is disconnected: {why}"))
        self._board, self._running = None, None
        if self._simulated is None:
            board.close()
        else:
            self.capture.resume()

    def _look(self, poll: Callable[[], Shot | None]) -> Shot | None:
        """Return the newest shot of the workcell, and show it; a camera that is gone is only shown."""
        try:
            shot = poll()
        except DeviceError as error:
            self.capture.problem = str(error)
            if self._running is not None:
                raise
            return None
        if shot is not None:
            self.capture.offer(shot)
            newest = self.capture.newest
            return None if newest is None else newest.shot
        return None

    def _stop_now(self) -> None:
        """Send the stop, and wait until the board reports it."""
        board = self._board
        assert board is not None
        board.stop()
        began = time.monotonic()
        while board.status.state is not BoardState.STOPPED and time.monotonic() - began < ANSWER_S:
            board.receive(_ASK_S)
        self._stop.clear()
        self._answered.set()
        self._say(Note("warn", f"stop: {STATE_TEXTS[board.status.state]}"))

    def _run(self, *, closed: bool) -> None:
        """Run the experiment, and write its folder in another thread."""
        began, measuring = time.perf_counter(), self._measuring
        self._requested, self._running, self._seen = None, "preparing", 0
        self._chart.clear()
        rig, spec = measuring.rig, measuring.target_spec
        assert rig is not None
        assert spec is not None
        try:
            target = open_target(spec)
            assert isinstance(target, Composite)
            setup = self._setup(target)
            plan, targets = self._plan()
            require_start(setup, plan, targets)
            folder = self._fresh()
            make_room(folder)
            write_text(folder / "motion.toml", read_text(self.options.motion))
            write_text(folder / "body.toml", read_text(spec))
            rig.save(folder / "rig.json")
            outcome = run_experiment(
                setup, rig, plan, targets, progress=self._progress, close_loop=closed, begun=self._begun
            )
        except ArmsightError as error:
            self._say(Note("error", str(error)))
            return
        finally:
            self._running, self._loop = None, None
            if self._stop.is_set():
                self._stop_now()
        if outcome.ended_text is not None:
            self._say(Note("warn", f"the run has ended early: {outcome.ended_text}; what was measured is written"))
        self._take(outcome)
        properties = {"arm": setup.arm.name, "board": setup.board.welcome.board}
        finished = Finished(setup.arm, rig, outcome, plan, None, properties, began, [], None)
        self._run_folder = folder
        self._writing.submit(self._write, finished, folder)

    def _write(self, finished: Finished, folder: Path) -> None:
        try:
            summary = finish(finished, folder)
        except ArmsightError as error:
            if finished.outcome.ended_text is None:
                self._say(Note("error", f"{folder}: {error}"))
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
            return replace(setup_of(simulated.workcell), target=target, poll=lambda: self._look(simulated.poll_now))
        return Setup(
            options.arm,
            board,
            self.capture.poll,
            target,
            lambda q: np.zeros(6),
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
        if self._stop.is_set():
            self._stop_now()
            raise DeviceError("stopped by a person: the drives are off")
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
            self._handeye = f"hand-eye: held out {1e3 * position_m:.2f} mm, {np.degrees(angle_rad):.3f} deg RMS"
            lines.append(self._handeye)
        if outcome.delay_found:
            lines.append(f"delay of the images: {1e3 * outcome.delay.delay_s:.1f} ms")
        for name, closed in (("potentiometers alone", False), ("loop closed on vision", True)):
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
        measuring = self._measuring
        command = (
            f"armsight run --source {options.source} --board {options.board or 'serial:PORT'} --rig {measuring.rig_path} "
            f"--target {measuring.target_spec} --arm {options.arm_spec} --motion {options.motion} -o run"
        )
        if board is None:
            return ArmState(options.arm.name, missing=self._lacking(), command=command)
        status, q = board.status, self._q
        segment = None if loop is None else loop.segment
        vision, scene = self._vision(q)
        state, faults = STATE_TEXTS[status.state], tuple(str(fault) for fault in status.faults)
        if status.state is BoardState.HOLDING and all(each.fault is Fault.HOST_SILENT for each in status.faults):
            state, faults = "held at rest by the board since the last motion", ()
        return ArmState(
            options.arm.name,
            board.welcome.board,
            self._lacking(),
            state,
            status.drives_on,
            status.state is BoardState.STOPPED,
            faults,
            () if q is None else tuple(float(x) for x in np.degrees(q)),
            vision,
            self._running,
            "" if segment is None else segment.phase,
            "" if segment is None else segment.motion,
            tuple((round(t, 3), round(e, 4), c) for t, e, c in list(self._chart)),
            self._handeye,
            self._results,
            None if self._run_folder is None else str(self._run_folder),
            scene,
            command,
        )

    def _vision(self, q: Array | None) -> tuple[tuple[float, ...], tuple[tuple[float, ...], ...]]:
        """Return vision's joint angles less the readings, degrees, and the arm's joints in the left camera's frame, m."""
        mounting, newest, arm = self._mounting, self._measuring.newest, self.options.arm
        if mounting is None or q is None:
            return (), ()
        T_left_base = np.linalg.inv(mounting.T_base_rig)
        frames = np.concatenate([arm.T_base_0[None], arm.links(q), arm.forward(q)[None]])
        scene = tuple(tuple(round(float(x), 4) for x in T[:3, 3]) for T in T_left_base @ frames)
        if newest is None or isinstance(newest[1], Missed):
            return (), scene
        T = mounting.pose_measurement(newest[1], newest[0].shot.t_s or 0.0).T_base_tool
        seen = arm.inverse(T, near=q).best
        return () if seen is None else tuple(float(x) for x in np.degrees(seen - q)), scene
