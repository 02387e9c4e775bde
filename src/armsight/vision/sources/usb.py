"""Two USB cameras: V4L2 through OpenCV.

In: two devices and the requested settings. Out: shots at the cameras' pace. Both cameras are grabbed before either
image is decoded. The time stamp is the driver's, taken when the frame arrived (OpenCV hands it on; time.monotonic's
clock), and where a driver has none, the time after the grab. Drivers queue frames, and not the same number while two
cameras start: so old frames are passed over, and whichever camera is more than half a frame period behind is grabbed
again until the two belong together.

Of cameras that send MJPEG the frames are taken from OpenCV as they came and decoded here, by the same decoder: a shot has
both the pixels and the cameras' own bytes, which a recording stores unchanged.
"""

from __future__ import annotations

import contextlib
import glob
import os
import re
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from armsight.data import Image, Shot
from armsight.errors import DeviceError, InputError
from armsight.vision.image import jpeg_in
from armsight.vision.source import Source
from armsight.vision.sources.capture import STALL_S, QuietCapture, Rhythm, allowed_skew, open_capture
from armsight.vision.sources.v4l2 import EXPOSURE_UNIT_MS, ExposureMode

_QUEUE = 4  # frames OpenCV's V4L2 lets the driver queue
_CATCH_UP = 30  # grabs after which two cameras that never come close in time are given up
_FORM = "usb:LEFT,RIGHT[@WIDTHxHEIGHT][@FPS][,exposure=5ms|auto][,gain=20][,format=MJPG]"
_MJPG = cv2.VideoWriter.fourcc(*"MJPG")

#: OpenCV's property -> its name and value in messages and the value to set; in the order in which they must be set.
Settings = dict[int, tuple[str, float]]


#: Characters of another process' command in a message; half: its configuration is cut, double: a long line.
_COMMAND = 80
#: How a camera's JPEG is decoded: unrotated, as recordings of it are read.
_FLAGS = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION


class UsbCamera:
    """One camera, set up, with its newest frame's time stamp."""

    def __init__(self, device: str, capture: QuietCapture, shape: tuple[int, int]) -> None:
        self.device, self.capture = device, capture
        self.rhythm, self.t_s = Rhythm(), 0.0
        self._shape = shape

    @staticmethod
    def set_up(device: str, settings: Settings, capture: QuietCapture) -> UsbCamera:
        """Set all properties requested, and read them back; DeviceError where the camera did not take one."""
        for key, (_, value) in settings.items():
            capture.set(key, value)
        for key, (name, value) in settings.items():
            got = capture.get(key)
            if abs(got - value) > 0.5:  # rates come back as 30.00003; all else is whole numbers
                said = int(got).to_bytes(4, "little").decode("latin1") if key == cv2.CAP_PROP_FOURCC else f"{got:g}"
                raise DeviceError(
                    f"{device}: did not take {name}, it says {said}; `armsight cameras` lists what it can do"
                )
        shape = (int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT)), int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)))
        # A driver that cannot hand out the bytes says so, and OpenCV decodes as before.
        if capture.get(cv2.CAP_PROP_FOURCC) == _MJPG:
            capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)
        return UsbCamera(device, capture, shape)

    def grab(self, stall_s: float) -> None:
        """Take the newest frame and its stamp, undecoded; DeviceError if the camera is gone or silent for ``stall_s``."""
        for _ in range(_QUEUE + 1):
            age_s = self._grab(stall_s)
            period_s = self.rhythm.period_s
            if period_s is None or age_s < 2 * period_s:  # a frame is a period old when it has arrived whole
                break

    def _grab(self, stall_s: float) -> float:
        """Take the next frame and return its age, s."""
        start = time.monotonic()
        while not self.capture.grab():
            if not os.path.exists(self.device):
                raise DeviceError(f"{self.device}: the camera is gone: unplugged, or its USB port was reset")
            if time.monotonic() - start > stall_s:
                raise DeviceError(
                    f"{self.device}: no frame for {stall_s:g} s: stalled; two cameras may need two USB ports"
                )
            time.sleep(0.01)
        now = time.monotonic()
        stamp = self.capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
        self.t_s = stamp if 0 <= now - stamp < 10 else now  # a driver without stamps says 0 or uses another clock
        self.rhythm.tick(self.t_s)
        return now - self.t_s

    def image(self) -> tuple[Image, bytes | None] | None:
        """Decode the grabbed frame: the image and the JPEG that the camera sent, if any; None if it cannot be decoded.

        DeviceError: it is not of the size agreed on.
        """
        ok, image = self.capture.retrieve()
        if not ok or image is None or image.size == 0:
            return None
        encoded: bytes | None = None
        if image.shape[:2] != self._shape and image.size == max(image.shape):  # one row or column: bytes as they came
            encoded = jpeg_in(np.asarray(image, np.uint8).tobytes())
            decoded = None if encoded is None else cv2.imdecode(np.frombuffer(encoded, np.uint8), _FLAGS)
            if decoded is None:
                return None
            image = decoded
        if image.shape[:2] != self._shape:
            (height, width), (h, w) = self._shape, image.shape[:2]
            raise DeviceError(f"{self.device}: sends frames of {w}x{h} px, agreed on {width}x{height}")
        return image, encoded


class UsbSource(Source):
    """Two USB cameras."""

    count: int | None = None

    def __init__(self, left: UsbCamera, right: UsbCamera, stall_s: float = STALL_S) -> None:
        self._left, self._right, self._stall_s = left, right, stall_s
        self._shots = 0

    def read(self) -> Shot | None:
        """Return the next shot; its time is the mean of the two time stamps."""
        left, right = self._left, self._right
        left.grab(self._stall_s)
        right.grab(self._stall_s)
        for _ in range(_CATCH_UP):
            if abs(left.t_s - right.t_s) <= allowed_skew(left.rhythm, right.rhythm):
                break
            min(left, right, key=lambda camera: camera.t_s).grab(self._stall_s)
        else:
            raise DeviceError(
                f"{left.device} and {right.device}: frames stay {abs(left.t_s - right.t_s):.3f} s apart, more than "
                "half a frame period: are both set to the same frame rate?"
            )
        name, t_s = f"{self._shots:06d}", (left.t_s + right.t_s) / 2
        self._shots += 1
        images = []
        for camera in (left, right):
            image = camera.image()
            if image is None:
                return Shot(name, None, None, t_s, f"{camera.device}: the frame cannot be decoded")
            images.append(image)
        (left_image, left_jpeg), (right_image, right_jpeg) = images
        encoded = None if left_jpeg is None or right_jpeg is None else (left_jpeg, right_jpeg)
        return Shot(name, left_image, right_image, t_s, None, encoded)

    def close(self) -> None:
        """Release both cameras."""
        self._left.capture.release()
        self._right.capture.release()


def open_usb(rest: str, capture: Callable[[str], QuietCapture] | None = None) -> UsbSource:
    """Open ``LEFT,RIGHT[@WIDTHxHEIGHT][@FPS][,exposure=5ms|auto][,gain=20][,format=MJPG]``, numbers or paths.

    ``capture`` opens a device, by default by OpenCV's V4L2. InputError: the text is not of that form. DeviceError: a
    device is missing, busy, or does not take a setting.
    """
    devices, settings = parsed_usb(rest)
    cameras: list[UsbCamera] = []
    opened: list[QuietCapture] = []
    try:
        for device in devices:
            opened.append((capture or _v4l2)(device))
            cameras.append(UsbCamera.set_up(device, settings, opened[-1]))
    except DeviceError:
        for one in opened:
            one.release()
        raise
    left, right = cameras
    return UsbSource(left, right)


def is_one(rest: str) -> bool:
    """Say whether the text after ``usb:`` names one camera alone."""
    return re.fullmatch(r"[^,@]+(@[^,]*)?(,[a-z]+=[^,]*)*", rest) is not None


def parsed_usb(rest: str) -> tuple[list[str], Settings]:
    """Read the text after ``usb:``."""
    if is_one(rest):
        raise InputError(f"usb:{rest} names one camera, two are needed: expected {_FORM}")
    form = re.fullmatch(r"([^,]+),([^,@]+)(?:@(\d+)x(\d+))?(?:@(\d+(?:\.\d+)?))?((?:,[a-z]+=[^,=]+)*)", rest)
    named = dict(part.split("=") for part in form[6].split(",")[1:]) if form else {}
    asked = named.pop("exposure", None)
    exposure = re.fullmatch(r"auto|(\d+(?:\.\d+)?)ms", asked or "auto")
    fourcc, gain = named.pop("format", "MJPG"), named.pop("gain", "")
    good_gain = re.fullmatch(r"(\d+(?:\.\d+)?)?", gain)
    if form is None or exposure is None or len(fourcc) != 4 or good_gain is None or named:
        raise InputError(f"usb:{rest}: expected {_FORM}")
    left, right, width, height, fps = form.groups()[:5]
    devices = [f"/dev/video{device}" if device.isdecimal() else device for device in (left, right)]
    if os.path.realpath(devices[0]) == os.path.realpath(devices[1]):
        raise InputError(f"usb:{rest}: left and right are the same camera")
    settings: Settings = {cv2.CAP_PROP_FOURCC: (f"format {fourcc}", cv2.VideoWriter.fourcc(*fourcc))}
    if width:
        settings[cv2.CAP_PROP_FRAME_WIDTH] = (f"width {width}", int(width))
        settings[cv2.CAP_PROP_FRAME_HEIGHT] = (f"height {height}", int(height))
    if fps:
        settings[cv2.CAP_PROP_FPS] = (f"{fps} frames per second", float(fps))
    if exposure[1]:
        settings[cv2.CAP_PROP_AUTO_EXPOSURE] = (f"manual exposure ({ExposureMode.MANUAL})", ExposureMode.MANUAL)
        units = round(float(exposure[1]) / EXPOSURE_UNIT_MS)
        settings[cv2.CAP_PROP_EXPOSURE] = (f"exposure {units} (x {EXPOSURE_UNIT_MS} ms)", units)
    elif asked:
        settings[cv2.CAP_PROP_AUTO_EXPOSURE] = (f"automatic exposure ({ExposureMode.AUTO})", ExposureMode.AUTO)
    if gain:
        settings[cv2.CAP_PROP_GAIN] = (f"gain {gain}", float(gain))
    return devices, settings


def _v4l2(device: str) -> QuietCapture:
    if not os.path.exists(device):
        raise DeviceError(f"{device}: no such camera; `armsight cameras` lists those attached")
    if not os.access(device, os.R_OK | os.W_OK):
        raise DeviceError(
            f"{device}: no permission; join the group video: sudo usermod -aG video $USER, then log in again"
        )
    capture = open_capture(device, cv2.CAP_V4L2)
    if capture is None:
        user = user_of(device)
        why = f"in use by {user}" if user else "not a camera, or in use by another program"
        raise DeviceError(f"{device}: cannot be opened: {why}")
    return capture


def user_of(device: str) -> str:
    """Return which other process has a device open, of those whose files this user may see; "" where none is known."""
    path = os.path.realpath(device)
    for handle in glob.glob("/proc/[0-9]*/fd/*"):
        process = handle.split("/")[2]
        with contextlib.suppress(OSError):
            if process != str(os.getpid()) and os.readlink(handle) == path:
                words = Path(f"/proc/{process}/cmdline").read_bytes().decode(errors="replace").split("\0")
                return f"process {process}, {' '.join(words).strip()[:_COMMAND]}"
    return ""
