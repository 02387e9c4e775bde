"""A session of ``armsight live``: the cameras, the steps, and what a person wants of them; it knows nothing of a page.

Capture, looking at images, and the arm have a thread each; none waits for another, nor for who shows the state.
"""

from __future__ import annotations

import contextlib
import json
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from armsight.app.live.arm import ArmStep, StopAnswer
from armsight.app.live.body import BoardStep, BodyStep
from armsight.app.live.calibration import CalibrationStep
from armsight.app.live.cameras import CamerasStep
from armsight.app.live.capture import CameraCapture
from armsight.app.live.measuring import MeasureState, MeasureStep
from armsight.app.live.recorded import RecordedStep
from armsight.app.live.records import STEPS, Event, PageCommand, asked
from armsight.app.live.step import SessionOptions, Shared, why
from armsight.app.options import SIM
from armsight.app.run.motion_file import DEFAULT_MOTION, QUICK
from armsight.app.show.messages import Level, Note
from armsight.errors import ArmsightError, InputError
from armsight.files import as_input_error, check_folder, read_json, require_version, unused, write_text
from armsight.robot.arm_file import open_arm
from armsight.robot.board_registry import EMULATED, slowed
from armsight.sim.workcell.person import SimulatedCameras
from armsight.sim.workcell.workcell import CHESSBOARD
from armsight.vision.rig import StereoRig

#: The workcell's cameras where ``sim:`` names none, and its arm.
_SIM_CAMERAS, _SIM_ARM, _EMULATOR = "1280x720@15", "worn", "unicorn"
_DEFAULT_BOARD = "chessboard:9x6:20mm"
#: All that was said, in the folder of the session.
LOG = "session.log"
#: What was chosen, by name, in the folder of the session; its version, and the longest name, characters.
SETTINGS, VERSION, _NAME = "session.json", 1, 60
_NUMBERS = ("error_mm", "distance_m")  # of what is kept; all else is text, or null where nothing is chosen
_BEHIND = 1.5  # intervals between shots that a pose may take


@dataclass(frozen=True)
class HealthState:
    """Whether everything is as it should be."""

    latency_ms: tuple[float, float] | None  # p50 and p99
    of: str  # what the latency is of
    measured: int
    missed: tuple[tuple[str, int], ...]  # by reason
    findings: tuple[str, ...]  # what no longer holds since the calibration
    slowest_ms: float  # the longest interval between shots lately
    notes: tuple[Note, ...]  # what is slow or late
    command: str


@dataclass(frozen=True)
class Overview:
    """Where the session is."""

    step: str
    steps: tuple[str, ...]
    folder: str
    moving: bool  # the arm moves by this session
    held: str = ""  # why the arm was held, until it is moved again
    offer: str = ""  # the rig that was there, until a person has said whether to use it
    settings: tuple[str, ...] = ()  # names of those that were kept


class LiveSession:
    """Cameras to closed loop, driven by commands; an ArmsightError where something that is named is not there."""

    def __init__(self, options: SessionOptions) -> None:
        self.folder = check_folder(options.folder, problem="the session cannot be written here").absolute()
        self._settings = self._kept()
        self._number, self._events, self._lock = 0, deque[Event](maxlen=200), threading.Lock()
        self.shared = shared = Shared(options, self.folder, self.say, hold=lambda why: self.arm.hold_for(why))
        self.cameras = CamerasStep(shared)
        model, simulated = open_arm(options.arm), shared.source.startswith(SIM)
        ArmStep.check_board(options.board, shared.source, model)
        if simulated:
            if options.board is not None and not options.board.startswith(EMULATED):
                raise InputError(f"--board {options.board}: {SIM} has the emulated board; leave out --board")
            cameras = shared.source.removeprefix(SIM) or _SIM_CAMERAS
            person = shared.simulated = SimulatedCameras(cameras, _SIM_ARM, options.seed, _EMULATOR, model)
            person.outline = lambda: self.calibration.outline_uv if self.calibration.shown.running else None
            shared.options = replace(options, board=options.board or f"{EMULATED}{_EMULATOR}")
        shared.motion = options.motion or (QUICK if simulated else DEFAULT_MOTION)
        self.measuring = MeasureStep(shared)
        spec = options.calibration_board or (CHESSBOARD if simulated else _DEFAULT_BOARD)
        self.board = BoardStep(shared, spec, self._calibrated)
        self.body = BodyStep(shared, self.measuring)
        self.arm = ArmStep(shared, self.measuring, slowed(model, shared.options.board or ""))
        self.recorded = RecordedStep(shared)
        self._step, self._offer = "cameras", ""
        self.cameras.show(left_known=simulated)
        self._closing = threading.Event()
        self._eye = threading.Thread(target=self._see, name="eye", daemon=True)
        self._begin(options)

    @property
    def calibration(self) -> CalibrationStep:
        """The guided calibration by the board that is in use."""
        return self.board.calibration

    @property
    def capture(self) -> CameraCapture:
        """The cameras that are open."""
        return self.shared.capture

    def _begin(self, options: SessionOptions) -> None:
        """Take what the command line names, and begin with the first step that lacks something."""
        simulated, target = self.shared.simulated, options.target
        if simulated is not None and target is None:
            self.folder.mkdir(parents=True, exist_ok=True)
            target = str(self.folder / "body.toml")
            write_text(target, simulated.workcell.body_text)
        stored = self.folder / "rig.json"
        if options.rig is not None:
            self._use_rig(options.rig)
        elif stored.exists():
            try:
                self._use_rig(stored)
                self._offer = _offer(stored)
                self.say("good", f"the rig stored in {stored} is used; calibrate again where the cameras moved")
                self.arm.handeye.recall(stored)
            except InputError as error:
                self.say("warn", f"the stored rig is not used: {error}")
        if target is not None:
            self.body.use_body(target)

    def _kept(self) -> dict[str, dict[str, Any]]:
        file = self.folder / SETTINGS
        found = read_json(file) if file.exists() else {"settings": {}}
        settings = found.get("settings") if isinstance(found, dict) else None
        if not isinstance(settings, dict):
            raise InputError(f"{file}: not written by `armsight live`: move it away")
        require_version(file, "session", found.get("version"), VERSION)
        for name, each in settings.items():
            if not isinstance(each, dict):
                raise InputError(f"{file}: settings {name!r}: expected an object, got {each!r:.40}: move it away")
            for key, value in each.items():
                kind, words = ((int, float), "a number") if key in _NUMBERS else (str, "a text")
                if value is not None and (isinstance(value, bool) or not isinstance(value, kind)):
                    raise InputError(f"{file}: settings {name!r}: {key} must be {words}, got {value!r:.40}")
        return settings

    @asked("")
    def keep_settings(self, name: str) -> None:
        """Keep what is chosen on the page now by a name; what had this name before is replaced."""
        if not 0 < len(name.strip()) <= _NAME:
            raise InputError(f"a name of 1 to {_NAME} characters is needed")
        aim, options = self.calibration.aim, self.shared.options
        chosen = {"cameras": self.shared.source, "board": self.calibration.spec, "body": self.measuring.target_spec}
        chosen |= {"arm": options.arm, "arm_board": options.board, "motion": str(self.shared.motion)}
        numbers = {"error_mm": 1e3 * aim.error_m, "distance_m": aim.distance_m}
        self._settings[name.strip()] = {**chosen, **numbers}
        kept = {"version": VERSION, "settings": self._settings}
        write_text(self.folder / SETTINGS, json.dumps(kept, indent=1) + "\n")
        self.say("good", f"settings kept: {name.strip()}")

    @asked("", rest=True)
    def use_settings(self, name: str) -> None:
        """Choose what was kept by a name; what cannot be chosen now is said, and stays as it is."""
        if name not in self._settings:
            raise InputError(f"no settings {name[:_NAME]!r}; there are {', '.join(self._settings) or 'none'}")
        kept, options = self._settings[name], self.shared.options
        if not self.arm.connected and self.shared.simulated is None:
            self.shared.options = replace(options, board=kept.get("arm_board") or options.board)
        choose: dict[str, tuple[object, Callable[[Any], None]]] = {
            "cameras": (self.shared.source, self.cameras.use_cameras),
            "board": (self.calibration.spec, self.board.use_board),
            "distance_m": (None, lambda far: self.calibration.set_aim(kept.get("error_mm") or 0.0, far)),
            "body": (self.measuring.target_spec, self.body.use_body),
            "arm": (options.arm, self.arm.use_arm),
            "motion": (str(self.shared.motion), self.arm.use_motion),
        }
        for key, (now, use) in choose.items():
            if kept.get(key) not in (None, "", now):
                try:
                    use(kept[key])
                except ArmsightError as error:
                    self.say("warn", f"{name}: {key}: {error}")
        self.say("good", f"settings: {name}")

    @asked("")
    def keep_rig(self) -> None:
        """Go on with the rig that was in the folder."""
        self._offer = ""

    @asked("", rest=True)
    def begin_anew(self) -> None:
        """Put the rig that was in the folder aside, and begin with the cameras."""
        stored = self.folder / "rig.json"
        aside = unused(stored.with_name(f"rig-{time.strftime('%Y%m%d-%H%M%S')}.json"))
        with as_input_error(f"{stored} cannot be put aside"):
            stored.rename(aside)
        self.measuring.use_rig(None, None)
        self.arm.forget_rig()
        self._step, self._offer = "cameras", ""
        self.say("good", f"the rig is kept as {aside}")

    def _use_rig(self, path: Path) -> None:
        self.measuring.use_rig(StereoRig.load_trusted(path), path)
        self._step = "measure"
        self.cameras.show(left_known=True)

    def _calibrated(self, rig: StereoRig, path: Path) -> None:
        self.measuring.use_rig(rig, path)
        if self.shared.simulated is not None:
            self.shared.simulated.person.holds = False

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
        for step in (self.cameras, self.board, self.measuring, self.body, self.recorded):
            step.close()
        if self.shared.simulated is not None:
            self.shared.simulated.end()

    def stop(self) -> StopAnswer:
        """Stop the arm in an emergency; the answer is the board's own. Any thread may call it."""
        return self.arm.stop()

    def say(self, level: Level, text: str) -> None:
        """Add an event."""
        with self._lock:
            self._number += 1
            self._events.append(Event(self._number, time.strftime("%H:%M:%S"), level, text))
            with contextlib.suppress(OSError):  # a full disk ends no session
                self.folder.mkdir(parents=True, exist_ok=True)
                with (self.folder / LOG).open("a", encoding="utf-8", errors="backslashreplace") as log:
                    log.write(f"{time.strftime('%Y-%m-%dT%H:%M:%S')} {level}: {text}\n")

    def events(self, after: int = 0) -> tuple[Event, ...]:
        """Return the events after a number."""
        with self._lock:
            return tuple(event for event in self._events if event.number > after)

    def execute(self, command: PageCommand) -> None:
        """Carry out a command, in the background what takes long; after an ArmsightError nothing has changed."""
        if command.rest and self.arm.busy:
            raise InputError("the arm moves: hold it first")
        step = getattr(self, command.at) if command.at else self
        getattr(step, command.method)(**vars(command))

    @asked("")
    def go_to(self, step: str) -> None:
        """Go to a step; the one before can be left at any time."""
        if step not in STEPS:
            raise InputError(f"no step {step[:40]!r}; there are {', '.join(STEPS)}")
        self._step = step

    @asked("", rest=True)
    def calibrate(self) -> None:
        """Begin the guided calibration, or continue it."""
        if self.shared.simulated is not None:
            if self.calibration.spec != CHESSBOARD:
                raise InputError(f"the simulated person holds {CHESSBOARD}; choose that board")
            self.shared.simulated.person.holds = True
        self._step = "calibrate"
        self.calibration.start()

    def _see(self) -> None:
        number, capture = 0, self.capture
        while not self._closing.is_set():
            if capture is not self.capture:
                capture, number = self.capture, 0
            live = capture.after(number, 0.2)
            if live is None:
                continue
            number = live.number
            try:
                if self.cameras.look(live, chosen=self._step == "cameras"):
                    self.arm.between_shots()
                    self.cameras.look_well(live)
                if self._step == "board":
                    self.board.look(live)
                elif self._step == "calibrate":
                    self.calibration.look(live)
                elif not self.arm.busy and self._step in ("measure", "arm", "health"):
                    self.measuring.look(live)
            except Exception as error:  # noqa: BLE001 - nobody else watches this thread
                self.say("error", f"looking at an image failed: {why(error)}")
                time.sleep(1.0)

    def sections(self) -> dict[str, object]:
        """Return the state, section by section: records of this package."""
        arm, measure, settings = self.arm, self.measuring.state, tuple(self._settings)
        overview = Overview(self._step, STEPS, str(self.folder), arm.busy, arm.held, self._offer, settings)
        found: dict[str, object] = {"overview": overview, "measure": measure, "health": self._health(measure)}
        steps = {name: getattr(self, name).state for name in ("cameras", "board", "body", "arm", "recorded")}
        return found | steps | {"calibrate": self.calibration.state}

    def _health(self, measure: MeasureState) -> HealthState:
        latency, of = measure.latency_ms, "from an image's arrival to its pose"
        if (loop := self.arm.latency_s) is not None:
            latency, of = (1e3 * loop[0], 1e3 * loop[1]), "from an image to its command in the loop"
        notes, rate, problem = [], self.capture.rate_hz, self.capture.problem
        if problem is not None:
            notes.append(Note("error", problem))
        if latency is not None and rate is not None and latency[0] > _BEHIND * 1e3 / rate:
            text = f"a pose takes {latency[0]:.0f} ms, a shot comes every {1e3 / rate:.0f} ms: "
            notes.append(Note("warn", f"{text}this computer is too busy, or the images are too large"))
        command = measure.command
        if (run := self.arm.shown.folder) is not None:
            command = f"armsight check {run}; armsight rig update {run} -o rig2.json"
        slowest_ms, found = 1e3 * self.capture.slowest_s, measure.health
        return HealthState(latency, of, measure.measured, measure.missed, found, slowest_ms, tuple(notes), command)


def _offer(stored: Path) -> str:
    """Return of when a rig is and how good, as it is offered: rig of yesterday 21:33, 0.024 mm."""
    made, now = datetime.fromtimestamp(stored.stat().st_mtime), datetime.now()
    days = {now.date(): "today", now.date() - timedelta(days=1): "yesterday"}
    heldout_m = StereoRig.load_trusted(stored).provenance.get("heldout_rigid_rms_m")
    error = f", {1e3 * heldout_m:.3f} mm" if isinstance(heldout_m, float) else ""
    return f"rig of {days.get(made.date(), made.date().isoformat())} {made:%H:%M}{error}"
