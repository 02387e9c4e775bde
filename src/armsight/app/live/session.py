"""A session of ``armsight live``: the cameras, the steps, and what a person wants of them; it knows nothing of a page.

In: :class:`SessionOptions`, and commands (:mod:`~armsight.app.live.records`). Out: sections of state, events, the newest
shot, and the folder of the session. CameraCapture, what looks at the images, and the arm have a thread each; none waits
for another, and none of them for whoever shows the state.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from armsight.app.live import records
from armsight.app.live.arm import ArmOptions, ArmState, ArmStep, StopAnswer
from armsight.app.live.body import BodyState, BodyStep
from armsight.app.live.calibration import CalibrationState, CalibrationStep
from armsight.app.live.capture import CameraCapture, LiveShot
from armsight.app.live.guide import CalibrationAim
from armsight.app.live.measuring import MeasureState, MeasureStep
from armsight.app.live.quality import FlickerWatch, ImageQuality, image_quality, quality_notes, same_camera
from armsight.app.live.records import Event, PageCommand
from armsight.app.live.simulated import ACTIONS, SimulatedCameras
from armsight.app.run.motion_file import DEFAULT_MOTION, QUICK
from armsight.app.show.messages import Note
from armsight.data import Record, Shot
from armsight.errors import ArmsightError, DeviceError, InputError
from armsight.files import check_folder, write_text
from armsight.robot.arm_file import open_arm
from armsight.robot.board_registry import EMULATED, slowed
from armsight.sim.workcell.workcell import CHESSBOARD
from armsight.vision.image import grey
from armsight.vision.markers.board import open_board
from armsight.vision.markers.targets import open_target
from armsight.vision.rig import StereoRig
from armsight.vision.sources import Source, open_source
from armsight.vision.sources.usb import parsed_usb
from armsight.vision.sources.v4l2 import VideoDevice, find_cameras

SIM = "sim:"
#: The workcell's cameras where ``sim:`` names none, and its arm.
_SIM_CAMERAS, _SIM_ARM, _EMULATOR = "1280x720@15", "worn", "unicorn"
_DEFAULT_BOARD = "chessboard:9x6:25mm"
_EVENTS = 200
#: How often the images' quality is looked at, s; images older than this are late, s.
_QUALITY_S, _LATE_S = 0.5, 0.5
#: A lens is covered when its view is this much darker than before, and the other is not.
_COVERED, _NOT_COVERED = 0.45, 0.75
_SLOW = 0.8  # share of the requested rate below which cameras are slow
_BAR_MM = 100.0  # the bar on a drawing
_BEHIND = 1.5  # intervals between shots that a pose may take


@dataclass(frozen=True)
class SessionOptions:
    """What the command line says.

    Attributes:
        folder: everything is written there.
        source: the cameras; None to look for them.
        rig: a calibrated rig, to begin with measuring.
        target: the body that is measured.
        calibration_board: the calibration board.
        board: the arm's controller board.
        arm: the nominal arm, a name or a file.
        motion: file of the motions.
        rate_hz: rate of the cameras, Hz.
        sync_s: standard deviation of the time between the two exposures of a shot, s.
        seed: of a simulated workcell.
        servo_calibration: LeRobot's calibration file of a servo bus.
        streams: what every measured shot is published to.
        follow_rig: whether a rig that moves during a run is put right.
    """

    folder: Path
    source: str | None = None
    rig: Path | None = None
    target: str | None = None
    calibration_board: str | None = None
    board: str | None = None
    arm: str = "six_r"
    motion: Path | None = None
    rate_hz: float = 30.0
    sync_s: float = 1e-3
    seed: int = 0
    servo_calibration: Path | None = None
    streams: tuple[str, ...] = ()
    follow_rig: bool = False


@dataclass(frozen=True)
class ViewState:
    """One camera's view.

    Attributes:
        size_px: width and height of its images; None before the first.
        quality: figures of its newest image; None before.
        notes: what is wrong with it.
    """

    size_px: tuple[int, int] | None = None
    quality: ImageQuality | None = None
    notes: tuple[Note, ...] = ()


@dataclass(frozen=True)
class FoundCamera:
    """An attached camera.

    Attributes:
        device: its path.
        name: its name.
        problem: why it does not answer; empty where it does.
        modes: sizes and rates it delivers, such as 1280x720@30, the largest first.
        exposure_ms: the shortest and the longest exposure its driver takes, ms; None where it takes none.
        gain: the smallest and the largest gain its driver takes; None where it takes none.
    """

    device: str
    name: str
    problem: str = ""
    modes: tuple[str, ...] = ()
    exposure_ms: tuple[float, float] | None = None
    gain: tuple[float, float] | None = None

    @classmethod
    def of(cls, camera: VideoDevice) -> FoundCamera:
        """Return a camera as it is shown."""
        sizes = {
            (size.width_px * size.height_px, f"{size.width_px}x{size.height_px}@{fps:g}")
            for form in camera.formats
            for size in form.sizes
            for fps in size.fps
        }
        modes = tuple(name for _, name in sorted(sizes, key=lambda each: (-each[0], each[1])))
        return cls(camera.device, camera.name, camera.problem or "", modes, camera.exposure_ms, camera.gain)


@dataclass(frozen=True)
class CamerasState:
    """The cameras.

    Attributes:
        source: what is open.
        found: the attached cameras.
        problem: why there are no images now; None while there are.
        rate_hz: shots a second.
        age_ms: age of the newest shot, ms.
        views: left and right.
        notes: what concerns both.
        finding_left: what a person should do to find out which camera is left; empty while nobody asks.
        swapped: whether left and right are exchanged.
        left_known: whether a person said which camera is left.
        simulated: what the simulated person can do; empty with real cameras.
        command: the command line that records the same.
    """

    source: str
    found: tuple[FoundCamera, ...] = ()
    problem: str | None = None
    rate_hz: float | None = None
    age_ms: float | None = None
    views: tuple[ViewState, ViewState] = (ViewState(), ViewState())
    notes: tuple[Note, ...] = ()
    finding_left: str = ""
    swapped: bool = False
    left_known: bool = False
    simulated: tuple[str, ...] = ()
    command: str = ""


@dataclass(frozen=True)
class BoardChoice:
    """The calibration board.

    Attributes:
        spec: of the board as it is used.
        size_mm: its extent from the first to the last point, mm.
        points: number of its points.
        drawing: the PDF; None before it is drawn.
        measured_mm: measured length of the bar on the print, mm; None where nobody measured it.
        command: the command line that draws it.
    """

    spec: str
    size_mm: tuple[float, float]
    points: int
    drawing: str | None
    measured_mm: float | None
    command: str


@dataclass(frozen=True)
class HealthState:
    """Whether everything is as it should be.

    Attributes:
        latency_ms: p50 and p99 from an image to its pose, or in a loop to its command, ms.
        of: what the latency is of.
        measured: poses so far.
        missed: misses by reason.
        findings: what no longer holds since the calibration.
        slowest_ms: the longest interval between shots lately, ms.
        notes: what is slow or late.
        command: the command line that does the same.
    """

    latency_ms: tuple[float, float] | None
    of: str
    measured: int
    missed: tuple[tuple[str, int], ...]
    findings: tuple[str, ...]
    slowest_ms: float
    notes: tuple[Note, ...]
    command: str


@dataclass(frozen=True)
class Overview:
    """Where the session is.

    Attributes:
        step: the step that is open.
        steps: all steps.
        folder: of the session.
        moving: whether the arm moves by this session.
        held: why the arm was held, until it is moved again; empty where it was not.
    """

    step: str
    steps: tuple[str, ...]
    folder: str
    moving: bool
    held: str = ""


@dataclass(frozen=True, eq=False)
class _Look(Record):
    """What the thread that looks at images keeps of a camera."""

    flicker: FlickerWatch
    bright: float


class LiveSession:
    """Cameras to closed loop, driven by commands.

    Args:
        options: what the command line says.

    Raises:
        ArmsightError: something that was named is not there.
    """

    def __init__(self, options: SessionOptions) -> None:
        self.folder = check_folder(options.folder, problem="the session cannot be written here").absolute()
        self._options, self._number = options, 0
        self._events: deque[Event] = deque(maxlen=_EVENTS)
        self._lock = threading.Lock()
        simulated = options.source is not None and options.source.startswith(SIM)
        self._found = [] if simulated else find_cameras()
        self.source = options.source if options.source is not None else _best_source(self._found)
        arm = open_arm(options.arm)
        ArmStep.check_board(options.board, self.source, arm)
        if simulated and options.board is not None and not options.board.startswith(EMULATED):
            raise InputError(f"--board {options.board}: {SIM} has the emulated board; leave out --board")
        self._simulated = self._workcell(options) if simulated else None
        spec = options.calibration_board or (CHESSBOARD if simulated else _DEFAULT_BOARD)
        self.measuring = MeasureStep(
            self.folder, "usb:LEFT,RIGHT" if simulated else self.source, self.say, options.streams, options.sync_s
        )
        self.capture = CameraCapture(self._open, self._camera_failed)
        self.calibration = self._calibration(spec, CalibrationAim())
        self.body = BodyStep(self.folder, self.say)
        motion = options.motion or (QUICK if simulated else DEFAULT_MOTION)
        board = options.board or (f"{EMULATED}{_EMULATOR}" if simulated else None)
        self.arm = ArmStep(
            self.folder,
            ArmOptions(
                slowed(arm, board or ""),
                options.arm,
                board,
                motion,
                options.rate_hz,
                options.sync_s,
                self.source,
                options.servo_calibration,
                options.follow_rig,
            ),
            self.capture,
            self.measuring,
            self._simulated,
            self.say,
        )
        self._held = ""
        self._step, self._drawing, self._bar_mm = "cameras", None, None
        self._views = (ViewState(), ViewState())
        self._notes: tuple[Note, ...] = ()
        self._looks: tuple[_Look, _Look] | None = None
        self._covering: tuple[float, float] | None = None
        self._left_known = simulated
        self._closing = threading.Event()
        self._eye = threading.Thread(target=self._see, name="eye", daemon=True)
        self._begin()

    _drawing: str | None
    _bar_mm: float | None

    def _workcell(self, options: SessionOptions) -> SimulatedCameras:
        assert options.source is not None
        cameras = options.source.removeprefix(SIM) or _SIM_CAMERAS
        simulated = SimulatedCameras(cameras, _SIM_ARM, options.seed, _EMULATOR, open_arm(options.arm))
        simulated.outline = lambda: self.calibration.outline_uv if self.calibration.state.running else None
        return simulated

    def _begin(self) -> None:
        """Take what the command line names, and begin with the first step that lacks something."""
        options = self._options
        if self._simulated is not None and options.target is None:
            self.folder.mkdir(parents=True, exist_ok=True)
            write_text(self.folder / "body.toml", self._simulated.workcell.body_text)
            options = replace(options, target=str(self.folder / "body.toml"))
        stored = self.folder / "rig.json"
        if options.rig is not None:
            self._use_rig(options.rig)
        elif stored.exists():
            try:
                self._use_rig(stored)
                self.say(Note("good", f"the rig stored in {stored} is used; calibrate again where the cameras moved"))
                self.arm.handeye.recall(stored)
            except InputError as error:
                self.say(Note("warn", f"the stored rig is not used: {error}"))
        if options.target is not None:
            self.measuring.use_target(options.target)
            self.body.use(options.target, self._rig())

    def _use_rig(self, path: Path) -> None:
        """Begin with measuring by a calibrated rig."""
        self.measuring.use_rig(StereoRig.load_trusted(path), path)
        self._step, self._left_known = "measure", True

    def start(self) -> None:
        """Start reading and looking."""
        self.capture.start()
        self._eye.start()

    def close(self) -> None:
        """Hold the arm, and end all threads."""
        self._closing.set()
        self.arm.close()
        self.capture.close()
        if self._eye.is_alive():
            self._eye.join(5.0)
        self.calibration.close()
        self.measuring.close()
        self.body.close()
        if self._simulated is not None:
            self._simulated.end()

    def stop(self) -> StopAnswer:
        """Stop the arm in an emergency; the answer is the board's own. Any thread may call it."""
        return self.arm.stop()

    def hold(self, why: str) -> None:
        """Bring the arm to rest and hold it, if it moves."""
        if self.arm.busy:
            self.arm.hold(why)
            self._held = why
            self.say(Note("warn", f"the arm is held: {why}"))

    def say(self, note: Note) -> None:
        """Add an event."""
        with self._lock:
            self._number += 1
            self._events.append(Event(self._number, time.strftime("%H:%M:%S"), note.level, note.text))

    def events(self, after: int = 0) -> tuple[Event, ...]:
        """Return the events after a number."""
        with self._lock:
            return tuple(event for event in self._events if event.number > after)

    def execute(self, command: PageCommand) -> None:
        """Carry out a command; what takes long is done in the background, and events say how it ended.

        Raises:
            ArmsightError: it cannot be done now; nothing has changed.
        """
        self._actions()[type(command)](command)
        if isinstance(command, records.RunMotions | records.GuideHandEye | records.GoToStart):
            self._held = ""

    def _actions(self) -> dict[type[PageCommand], Callable[..., None]]:
        """Return what each command does."""
        calibration, measuring, arm = self.calibration, self.measuring, self.arm
        return {
            records.GoTo: lambda c: self._go(c.step),
            records.UseCameras: lambda c: self._use_cameras(c.source),
            records.FindLeft: lambda c: self._find_left(),
            records.Swap: lambda c: self._swap(),
            records.UseBoard: lambda c: self._use_board(c.spec, c.measured_mm),
            records.DrawBoard: lambda c: self._draw_board(c.paper),
            records.Calibrate: lambda c: self._calibrate(),
            records.PauseCalibration: lambda c: calibration.pause(),
            records.TakeShot: lambda c: calibration.force(),
            records.DropShot: lambda c: calibration.drop(c.name),
            records.FinishCalibration: lambda c: self._finish(),
            records.SetAim: lambda c: calibration.set_aim(CalibrationAim(1e-3 * c.error_mm, c.distance_m)),
            records.UseBody: lambda c: self._use_body(c.target),
            records.DrawBody: lambda c: self._draw_body(c.paper),
            records.Zero: lambda c: measuring.zero(),
            records.ClearZero: lambda c: measuring.clear_zero(),
            records.PivotTip: lambda c: measuring.pivot(),
            records.MarkPosition: lambda c: measuring.mark(),
            records.RecordPoses: lambda c: measuring.record(),
            records.OpenArm: lambda c: arm.open(),
            records.RunMotions: lambda c: arm.run(closed=c.closed),
            records.UseSecondBody: lambda c: measuring.use_second(c.target),
            records.TakePose: lambda c: arm.take_pose(),
            records.GuideHandEye: lambda c: arm.guide_handeye(),
            records.GoToStart: lambda c: arm.go_to_start(),
            records.ClearHandEye: lambda c: self._clear_handeye(),
            records.Identify: lambda c: arm.identify_arm(),
            records.UseArm: lambda c: arm.use_arm(c.arm),
            records.UseMotion: lambda c: arm.use_motion(c.path),
            records.Hold: lambda c: self.hold("a person requested it"),
            records.ClearStop: lambda c: arm.clear_stop(),
            records.PersonAction: lambda c: self._person(c.action),
        }

    def _go(self, step: str) -> None:
        if step not in records.STEPS:
            raise InputError(f"no step {step[:40]!r}; there are {', '.join(records.STEPS)}")
        self._step = step

    def _require_rest(self) -> None:
        if self.arm.busy:
            raise InputError("the arm moves: hold it first")

    def _use_cameras(self, source: str) -> None:
        self._require_rest()
        if self._simulated is not None or source.startswith(SIM):
            raise InputError("the workcell and real cameras are chosen when the session starts: --source")
        if source.startswith("usb:"):
            parsed_usb(source.removeprefix("usb:"))  # else those that are open would be closed for nothing
        self.capture.close()
        self.source, self.capture = source, CameraCapture(self._open, self._camera_failed)
        self.arm.capture, self.arm.options = self.capture, replace(self.arm.options, source=source)
        self._left_known = False
        self.capture.start()
        self.measuring.source = source
        self._looks = None
        self.say(Note("good", f"cameras: {source}"))

    def _find_left(self) -> None:
        quality = [view.quality for view in self._views]
        if quality[0] is None or quality[1] is None:
            raise InputError("there are no images yet")
        self._covering = quality[0].mean, quality[1].mean

    def _swap(self) -> None:
        self._require_rest()
        self.capture.swapped = not self.capture.swapped
        self._covering, self._left_known = None, True
        self.say(
            Note("good", "left and right are exchanged" if self.capture.swapped else "left and right as they came")
        )

    def _use_board(self, spec: str, measured_mm: float) -> None:
        self._require_rest()
        board = open_board(spec)
        if measured_mm and not 0.8 * _BAR_MM < measured_mm < 1.2 * _BAR_MM:
            raise InputError(
                f"the bar on the print is {_BAR_MM:g} mm long by the drawing; {measured_mm:g} mm cannot be right"
            )
        if measured_mm:
            spec = scaled_spec(spec, measured_mm / _BAR_MM)
            board = open_board(spec)
        self._bar_mm = measured_mm or None
        aim = self.calibration.aim
        self.calibration.close()
        self.calibration = self._calibration(spec, aim)
        self.say(Note("good", f"board: {board.body.name}"))

    def _calibration(self, spec: str, aim: CalibrationAim) -> CalibrationStep:
        step = CalibrationStep(self.folder, spec, aim, self.say)
        step.changed = self._calibrated
        return step

    def _calibrated(self, rig: StereoRig, path: Path) -> None:
        """Take a new rig."""
        self.measuring.use_rig(rig, path)
        if self._simulated is not None:
            self._simulated.person.holds = False

    def _draw_board(self, paper: str) -> None:
        self.body.draw(self.calibration.spec, "board", paper)
        self._drawing = str(self.folder / "board.pdf")

    def _calibrate(self) -> None:
        self._require_rest()
        if self._simulated is not None:
            if self.calibration.spec != CHESSBOARD:
                raise InputError(f"the simulated person holds {CHESSBOARD}; choose that board")
            self._simulated.person.holds = True
        self._step = "calibrate"
        self.calibration.start()

    def _finish(self) -> None:
        self.calibration.finish()
        if self._simulated is not None:
            self._simulated.person.holds = False

    def _rig(self) -> tuple[StereoRig, Path] | None:
        rig, path = self.measuring.rig, self.measuring.rig_path
        return None if rig is None or path is None else (rig, path)

    def _use_body(self, target: str) -> None:
        self._require_rest()
        open_target(target)
        self.measuring.use_target(target)
        self.body.use(target, self._rig())

    def _draw_body(self, paper: str) -> None:
        target = self.body.state.target
        if target is None:
            raise InputError("no body yet: choose one first")
        self.body.draw(target, "body", paper)

    def _clear_handeye(self) -> None:
        self._require_rest()
        self.arm.handeye.clear()

    def _person(self, action: str) -> None:
        if self._simulated is None:
            raise InputError("these cameras are real: do it yourself")
        self._simulated.person.act(action)

    def _camera_failed(self, problem: str) -> None:
        self.say(Note("error", problem))

    def _open(self) -> Source:
        """Open the cameras, in the thread that reads them."""
        if self._simulated is not None:
            return self._simulated
        if not self.source:
            self._found = find_cameras()
            self.source = _best_source(self._found)
        if not self.source:
            count = len(self._found)
            name = f" ({self._found[0].name})" if count == 1 else ""
            have = f"one camera is attached{name}" if count == 1 else "no camera is attached"
            raise DeviceError(
                f"{have}; two are needed. Plug them in: they are looked for again. `armsight cameras` lists them"
            )
        return open_source(self.source)

    def _see(self) -> None:
        """Look at every newest image, in a thread of its own."""
        number, quality_s, capture = 0, 0.0, self.capture
        while not self._closing.is_set():
            if capture is not self.capture:
                capture, number = self.capture, 0
            live = capture.after(number, 0.2)
            if live is None:
                continue
            number = live.number
            try:
                self._flicker(live.shot)
                if live.arrived_s - quality_s > _QUALITY_S:
                    quality_s = live.arrived_s
                    self.between_shots()
                    self._qualities(live.shot)
                if self._step == "calibrate":
                    self.calibration.look(live)
                elif not self.arm.busy and self._step in ("measure", "arm", "health"):
                    self.measuring.look(live)
            except ArmsightError as error:
                self.say(Note("error", str(error)))
                time.sleep(1.0)
            except Exception as error:  # noqa: BLE001 - nobody else watches this thread
                self.say(Note("error", f"looking at an image failed: {type(error).__name__}: {error}"))
                time.sleep(1.0)

    def _flicker(self, shot: Shot) -> None:
        """Keep the brightness of the images' rows; only while cameras are chosen."""
        if self._step != "cameras" or shot.left is None or shot.right is None:
            return
        if self._looks is None:
            rate = self.capture.rate_hz
            if rate is None:
                return
            self._looks = (_Look(FlickerWatch(rate), 0.0), _Look(FlickerWatch(rate), 0.0))
        for look, image in zip(self._looks, (shot.left, shot.right), strict=True):
            look.flicker.take(grey(image))

    def _qualities(self, shot: Shot) -> None:
        """Look at what is wrong with the newest images."""
        if shot.left is None or shot.right is None:
            return
        images = grey(shot.left), grey(shot.right)
        views = []
        for side, image in enumerate(images):
            quality = image_quality(image)
            notes = quality_notes(quality)
            if self._looks is not None and (note := self._looks[side].flicker.note()) is not None:
                notes = (*notes, note)
            views.append(ViewState((image.shape[1], image.shape[0]), quality, notes))
        self._views = (views[0], views[1])
        self._notes = tuple(self._both(images))
        if self._covering is not None:
            self._check_covered(self._covering)

    def _both(self, images: tuple[np.ndarray, np.ndarray]) -> list[Note]:
        """Return what is wrong with both cameras together."""
        notes, rate = [], self.capture.rate_hz
        if same_camera(*images):
            notes.append(Note("error", "both views look like one camera: choose two different ones"))
        if images[0].shape != images[1].shape:
            notes.append(Note("hint", "the two cameras have images of different sizes"))
        newest = self.capture.newest
        age = 0.0 if newest is None else newest.age_s(newest.arrived_s)
        if age > _LATE_S:
            notes.append(Note("warn", f"images are {1e3 * age:.0f} ms old when they come"))
        if self.source.startswith("usb:"):
            notes += self._usb_notes(rate)
        return notes

    def _usb_notes(self, rate: float | None) -> list[Note]:
        """Return what is wrong with two USB cameras by what was requested of them."""
        notes = []
        if "exposure=" not in self.source or "exposure=auto" in self.source:
            notes.append(Note("hint", "automatic exposure is on: set an exposure for measuring, such as 5 ms"))
        requested = [
            float(value)
            for name, value in parsed_usb(self.source.removeprefix("usb:"))[1].values()
            if "per second" in name
        ]
        if rate is not None and requested and rate < _SLOW * requested[0]:
            text = (
                f"{rate:.1f} shots a second come, {requested[0]:g} were requested: USB 2 carries two such cameras only "
            )
            notes.append(Note("warn", f"{text}on two ports of their own, or in format MJPG"))
        return notes

    def _check_covered(self, before: tuple[float, float]) -> None:
        """Find out which lens is covered."""
        now = [view.quality.mean if view.quality is not None else 0.0 for view in self._views]
        share = [value / max(then, 1.0) for value, then in zip(now, before, strict=True)]
        if share[0] < _COVERED and share[1] > _NOT_COVERED:
            self._covering, self._left_known = None, True
            self.say(Note("good", "the left view is the left camera's"))
        elif share[1] < _COVERED and share[0] > _NOT_COVERED:
            self._swap()

    @property
    def newest(self) -> LiveShot | None:
        """The newest shot, to be shown."""
        return self.capture.newest

    def between_shots(self) -> None:
        """Wait, while a loop moves the arm, until no image waits for its command (:meth:`ArmStep.between_shots`)."""
        self.arm.between_shots()

    def sections(self) -> dict[str, object]:
        """Return the state, section by section: records of this package."""
        measure = self.measuring.state
        return {
            "overview": Overview(self._step, records.STEPS, str(self.folder), self.arm.busy, self._held),
            "cameras": self._cameras(),
            "board": self._board(),
            "calibrate": self.calibration.state,
            "body": self.body.state,
            "measure": measure,
            "arm": self.arm.state,
            "health": self._health(measure),
        }

    def _cameras(self) -> CamerasState:
        newest, now = self.capture.newest, time.monotonic()
        finding = ""
        if self._covering is not None:
            finding = "Cover the lens of the LEFT camera with a hand."
        found = tuple(FoundCamera.of(camera) for camera in self._found)
        return CamerasState(
            self.source,
            found,
            self.capture.problem,
            self.capture.rate_hz,
            None if newest is None else 1e3 * newest.age_s(now),
            self._views,
            self._notes,
            finding,
            self.capture.swapped,
            self._left_known,
            ACTIONS if self._simulated is not None else (),
            "armsight demo"
            if self._simulated is not None
            else f"armsight record {self.source or 'usb:LEFT,RIGHT'} -o shots",
        )

    def _board(self) -> BoardChoice:
        board, spec = self.calibration.board, self.calibration.spec
        size = 1e3 * np.ptp(board.body.points, axis=0)
        drawing = None if self._drawing is None or not Path(self._drawing).exists() else self._drawing
        command = f"armsight body draw {spec} -o {self.folder}/board.pdf"
        return BoardChoice(
            spec, (float(size[0]), float(size[1])), len(board.body.points), drawing, self._bar_mm, command
        )

    def _health(self, measure: MeasureState) -> HealthState:
        latency, of = measure.latency_ms, "from an image's arrival to its pose"
        if (loop := self.arm.latency_s) is not None:
            latency, of = (1e3 * loop[0], 1e3 * loop[1]), "from an image to its command in the loop"
        notes, rate = [], self.capture.rate_hz
        if self.capture.problem is not None:
            notes.append(Note("error", self.capture.problem))
        if latency is not None and rate is not None and latency[0] > _BEHIND * 1e3 / rate:
            text = (
                f"a pose takes {latency[0]:.0f} ms, a shot comes every {1e3 / rate:.0f} ms: this computer is too busy"
            )
            notes.append(Note("warn", f"{text}, or the images are too large"))
        if (run := self.arm.state.folder) is not None:
            command = f"armsight check {run}; armsight rig update {run} -o rig2.json"
        else:
            command = f"armsight measure {measure.rig or 'rig.json'} --target {measure.target or 'body.toml'} --source "
            command += self.measuring.source
        slowest_ms = 1e3 * self.capture.slowest_s
        return HealthState(
            latency, of, measure.measured, measure.missed, measure.health, slowest_ms, tuple(notes), command
        )


#: Sections of :meth:`LiveSession.sections` and their records.
SECTIONS = {
    "overview": Overview,
    "cameras": CamerasState,
    "board": BoardChoice,
    "calibrate": CalibrationState,
    "body": BodyState,
    "measure": MeasureState,
    "arm": ArmState,
    "health": HealthState,
}


def _best_source(found: list[VideoDevice]) -> str:
    """Return the source of the first two cameras that answer; empty where there are not two."""
    usable = [camera for camera in found if camera.problem is None]
    if len(usable) < 2:
        return ""
    return f"usb:{usable[0].device},{usable[1].device}"


def scaled_spec(spec: str, factor: float) -> str:
    """Return a board's spec with its lengths multiplied: as it was printed."""
    kind, *fields = spec.split(":")
    scaled = []
    for field in fields:
        for unit in ("mm", "cm", "in", "m"):
            number = field.removesuffix(unit)
            if field.endswith(unit) and number.replace(".", "", 1).isdigit():
                field = f"{float(number) * factor:.6g}{unit}"
                break
        scaled.append(field)
    return ":".join((kind, *scaled))
