"""The cameras: which ones are open, which of them is left, and what is wrong with their images."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from armsight.app.live.capture import CameraCapture, LiveShot
from armsight.app.live.records import asked
from armsight.app.live.step import PageStep, Shared
from armsight.app.options import SIM
from armsight.app.setup.finding import COVERED, NOT_COVERED
from armsight.app.show.messages import Level, Note
from armsight.errors import DeviceError, InputError
from armsight.sim.workcell.person import ACTIONS
from armsight.vision.image import grey
from armsight.vision.quality import (
    BLURRED_PX,
    DARK_MEAN,
    SATURATED_SHARE,
    SHARP_PX,
    FlickerWatch,
    ImageQuality,
    image_quality,
    same_camera,
)
from armsight.vision.sources import Source, open_source
from armsight.vision.sources.usb import parsed_usb
from armsight.vision.sources.v4l2 import VideoDevice, find_cameras

#: How often the images' quality is looked at, s; images older than this are late, s.
_QUALITY_S, _LATE_S = 0.5, 0.5
_SLOW = 0.8  # share of the requested rate below which cameras are slow


def quality_notes(quality: ImageQuality) -> tuple[Note, ...]:
    """Return what is wrong with an image, in words."""
    edge_px, white = quality.edge_px or 0.0, 100 * quality.saturated
    wide, lower, longer = f"edges are {edge_px:.1f} px wide", "lower exposure or gain", "more light, or longer exposure"
    found: tuple[tuple[bool, Level, str], ...] = (
        (edge_px > BLURRED_PX, "error", f"out of focus: {wide}; focus until below {SHARP_PX:g}"),
        (SHARP_PX < edge_px <= BLURRED_PX, "hint", f"a little soft: {wide}; {SHARP_PX:g} or less is sharp"),
        (quality.saturated > SATURATED_SHARE, "warn", f"saturated: {white:.0f}% of the pixels are white; {lower}"),
        (quality.mean < DARK_MEAN, "warn", f"too dark: mean grey level {quality.mean:.0f} of 255; {longer}"),
    )
    return tuple(Note(level, text) for there, level, text in found if there)


def flicker_note(watch: FlickerWatch) -> Note | None:
    """Return the flicker in words; None where there is none."""
    found = watch.found()
    if found is None:
        return None
    amplitude, hz = found
    exposure = "10 or 20 ms" if hz == 100.0 else "8.3 or 16.7 ms"
    return Note("warn", f"flicker: lamps at {hz:.0f} Hz, the light varies by {100 * amplitude:.1f}%; expose {exposure}")


@dataclass(frozen=True)
class ViewState:
    """One camera's view: size of its images, figures of the newest one, and what is wrong with it."""

    size_px: tuple[int, int] | None = None
    quality: ImageQuality | None = None
    notes: tuple[Note, ...] = ()


@dataclass(frozen=True)
class CamerasState:
    """The cameras."""

    source: str = ""
    found: tuple[VideoDevice, ...] = ()  # the attached cameras
    problem: str | None = None  # why there are no images now
    rate_hz: float | None = None
    age_ms: float | None = None  # of the newest shot
    views: tuple[ViewState, ViewState] = (ViewState(), ViewState())
    notes: tuple[Note, ...] = ()  # what concerns both
    finding_left: str = ""  # what to do to find out which camera is left; empty while nobody asks
    swapped: bool = False
    left_known: bool = False  # a person said which camera is left
    simulated: tuple[str, ...] = ()  # what the simulated person can do
    command: str = ""  # the command line that records the same


class CamerasStep(PageStep[CamerasState]):
    """Chooses the cameras, and looks at their images."""

    def __init__(self, shared: Shared) -> None:
        super().__init__(shared, CamerasState())
        simulated = (shared.options.source or "").startswith(SIM)
        self._found = [] if simulated else find_cameras()
        shared.source = _best_source(self._found) if shared.options.source is None else shared.options.source
        shared.capture = CameraCapture(self._open, partial(self.say, "error"))
        self._flicker: tuple[FlickerWatch, FlickerWatch] | None = None
        self._bright: tuple[float, ...] | None = None  # mean grey levels when a person was asked to cover a lens
        self._quality_s = 0.0

    @asked("cameras", rest=True)
    def use_cameras(self, source: str) -> None:
        """Open other cameras."""
        shared = self.shared
        if shared.simulated is not None or source.startswith(SIM):
            raise InputError("the workcell and real cameras are chosen when the session starts: --source")
        if source.startswith("usb:"):
            parsed_usb(source.removeprefix("usb:"))  # else those that are open would be closed for nothing
        shared.capture.close()
        shared.source, shared.capture = source, CameraCapture(self._open, partial(self.say, "error"))
        shared.capture.start()
        self._flicker = None
        self.show(left_known=False)
        self.say("good", f"cameras: {source}")

    @asked("cameras")
    def find_left(self) -> None:
        """Find out which view is the left camera's: a person covers it."""
        quality = [view.quality for view in self.shown.views]
        if None in quality:
            raise InputError("there are no images yet")
        self._bright = tuple(each.mean for each in quality if each is not None)
        self.show(finding_left="Cover the lens of the LEFT camera with a hand.")

    @asked("cameras", rest=True)
    def swap(self) -> None:
        """Exchange left and right."""
        capture = self.shared.capture
        capture.swapped = not capture.swapped
        self._left_is_known("left and right are exchanged" if capture.swapped else "left and right as they came")

    @asked("cameras")
    def person_action(self, action: str) -> None:
        """Let the simulated person act: cover_left, cover_right, uncover, unplug, plug, board, no_board."""
        if self.shared.simulated is None:
            raise InputError("these cameras are real: do it yourself")
        self.shared.simulated.person.act(action)

    def _left_is_known(self, text: str) -> None:
        self._bright = None
        self.show(finding_left="", left_known=True)
        self.say("good", text)

    def look(self, live: LiveShot, *, chosen: bool) -> bool:
        """Look at a shot; whether its quality is due. The flicker of lamps is looked for only while cameras are chosen."""
        shot, rate = live.shot, self.shared.capture.rate_hz
        if shot.left is None or shot.right is None:
            return False
        if chosen and (self._flicker is not None or rate is not None):
            self._flicker = self._flicker or (FlickerWatch(rate or 0.0), FlickerWatch(rate or 0.0))
            for watch, image in zip(self._flicker, (shot.left, shot.right), strict=True):
                watch.take(grey(image))
        return live.arrived_s - self._quality_s > _QUALITY_S

    def look_well(self, live: LiveShot) -> None:
        """Find out what is wrong with the images of a shot."""
        shot, self._quality_s = live.shot, live.arrived_s
        assert shot.left is not None
        assert shot.right is not None
        images, views = (grey(shot.left), grey(shot.right)), []
        for side, image in enumerate(images):
            quality = image_quality(image)
            flicker = None if self._flicker is None else flicker_note(self._flicker[side])
            notes = (*quality_notes(quality), *([] if flicker is None else [flicker]))
            views.append(ViewState((image.shape[1], image.shape[0]), quality, notes))
        self.show(views=tuple(views), notes=tuple(self._of_both(images)))
        if self._bright is not None:
            left, right = (
                (0.0 if view.quality is None else view.quality.mean) / max(before, 1.0)
                for view, before in zip(views, self._bright, strict=True)
            )
            if left < COVERED and right > NOT_COVERED:
                self._left_is_known("the left view is the left camera's")
            elif right < COVERED and left > NOT_COVERED:
                self.swap()

    def _of_both(self, images: tuple[np.ndarray, np.ndarray]) -> list[Note]:
        notes, newest, source = [], self.shared.capture.newest, self.shared.source
        if same_camera(*images):
            notes.append(Note("error", "both views look like one camera: choose two different ones"))
        if images[0].shape != images[1].shape:
            notes.append(Note("hint", "the two cameras have images of different sizes"))
        age = 0.0 if newest is None else newest.age_s(newest.arrived_s)
        if age > _LATE_S:
            notes.append(Note("warn", f"images are {1e3 * age:.0f} ms old when they come"))
        if not source.startswith("usb:"):
            return notes
        if "exposure=" not in source or "exposure=auto" in source:
            notes.append(Note("hint", "automatic exposure is on: set an exposure for measuring, such as 5 ms"))
        named = parsed_usb(source.removeprefix("usb:"))[1].values()
        asked_hz = next((float(value) for name, value in named if "per second" in name), 0.0)
        rate = self.shared.capture.rate_hz
        if rate is not None and rate < _SLOW * asked_hz:
            text = f"{rate:.1f} shots a second come, {asked_hz:g} were requested: USB 2 carries two such cameras only "
            notes.append(Note("warn", f"{text}on two ports of their own, or in format MJPG"))
        return notes

    def now(self) -> CamerasState:
        """Return what is shown, with how the cameras do."""
        capture, simulated, shown = self.shared.capture, self.shared.simulated is not None, self.shown
        newest, source = capture.newest, self.shared.source
        age_ms = None if newest is None else 1e3 * newest.age_s(time.monotonic())
        shown = replace(shown, source=source, found=tuple(self._found), problem=capture.problem, age_ms=age_ms)
        command = "armsight demo" if simulated else f"armsight record {source or 'usb:LEFT,RIGHT'} -o shots"
        shown = replace(shown, simulated=ACTIONS if simulated else (), command=command)
        return replace(shown, rate_hz=capture.rate_hz, swapped=capture.swapped)

    def _open(self) -> Source:
        shared = self.shared
        if shared.simulated is not None:
            return shared.simulated
        if not shared.source:
            self._found = find_cameras()
            shared.source = _best_source(self._found)
        if not shared.source:
            name = f" ({self._found[0].name})" if len(self._found) == 1 else ""
            have = f"one camera is attached{name}" if len(self._found) == 1 else "no camera is attached"
            raise DeviceError(f"{have}; two are needed: plug them in. `armsight cameras` lists them")
        return open_source(shared.source)


def _best_source(found: list[VideoDevice]) -> str:
    """Return the source of the first two cameras that answer; empty where there are not two."""
    usable = [camera.device for camera in found if camera.problem is None]
    return f"usb:{usable[0]},{usable[1]}" if len(usable) > 1 else ""
