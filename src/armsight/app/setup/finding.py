"""Which port is the arm's, and which cameras are left and right: by unplugging a cable and covering a lens."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import cv2
import numpy as np

from armsight.errors import ArmsightError, DeviceError, InputError
from armsight.robot.board_registry import open_motion_board
from armsight.robot.boards.serial import list_ports
from armsight.vision.sources.capture import open_capture
from armsight.vision.sources.v4l2 import VideoDevice, find_cameras

#: s; between two looks at the ports; half: nothing, double: a plug that is moved fast is not seen.
_LOOK_S = 0.2
#: A covered lens: its view is this much darker than before, and no other by so much; half: a hand before it is not enough,
#: double: a cloud is.
_COVERED, _NOT_COVERED = 0.45, 0.75
_FRAMES = 8  # until a camera's exposure has settled; half: too dark an image, double: slower
#: How boards are called -> what stands behind them, and the arm whose page has it.
KINDS = {"feetech:": ("a servo bus", "so101"), "ar4:": ("an AR4", "ar4"), "serial:": ("armsight's firmware", "six_r")}


def find_port(say: Callable[[str], None], ports: Callable[[], Sequence[str]] = list_ports) -> str:
    """Return the port that goes and comes back with the arm's cable."""
    while True:
        there = set(ports())
        unplugged = bool(there)
        if unplugged:
            say("Unplug the arm's USB cable.")
            there = _other(there, ports, gone=True)
        say("Plug the arm's USB cable in again." if unplugged else "Plug in the arm's USB cable.")
        came = _other(there, ports, gone=False) - there
        if len(came) == 1:
            return came.pop()
        say(f"{', '.join(sorted(came))} came together: unplug the arm's cable alone.")


def _other(before: set[str], ports: Callable[[], Sequence[str]], *, gone: bool) -> set[str]:
    """Return the ports once some of those before are gone, or others have come."""
    while True:
        now = set(ports())
        if before - now if gone else now - before:
            return now
        before = before | now if gone else before & now
        time.sleep(_LOOK_S)


def brightness(device: str) -> float:
    """Return the mean grey level of a camera's image."""
    capture = open_capture(device, cv2.CAP_V4L2)
    if capture is None:
        raise DeviceError(f"{device}: cannot be opened: is another program using it?")
    try:
        for _ in range(_FRAMES):
            capture.grab()
        read, image = capture.retrieve()
    finally:
        capture.release()
    if not read:
        raise DeviceError(f"{device}: no image comes")
    return float(np.mean(image))


def find_left_and_right(
    covered: Callable[[str], object],
    cameras: Callable[[], Sequence[VideoDevice]] = find_cameras,
    look: Callable[[str], float] = brightness,
) -> str:
    """Return the source of two cameras; ``covered`` asks a person to cover a lens, and returns once it is.

    Raises:
        DeviceError: there are not two cameras, or one gives no image.
    """
    devices = [camera.device for camera in cameras() if camera.problem is None]
    if len(devices) < 2:
        raise DeviceError(f"{len(devices)} cameras are attached, two are needed; `armsight cameras` lists them")
    bright, found = {device: look(device) for device in devices}, list[str]()
    for side in ("LEFT", "RIGHT"):
        ask = f"Cover the lens of the {side} camera with a hand"
        while True:
            covered(ask)
            share = {device: look(device) / max(bright[device], 1.0) for device in devices}
            darkest, *others = sorted(devices, key=share.__getitem__)
            if share[darkest] < _COVERED and share[others[0]] > _NOT_COVERED and darkest not in found:
                found.append(darkest)
                break
            ask = f"No view became dark, or more than one, or the same as before. Cover the {side} lens alone"
    return "usb:" + ",".join(device.removeprefix("/dev/video") for device in found)


def check_arm(board: str) -> None:
    """Raise an error where another kind of arm, or nothing, answers at a port such as ``feetech:/dev/ttyACM0``."""
    kind, _, port = board.partition(":")
    try:
        open_motion_board(board).close()
    except ArmsightError as error:
        for other, (what, arm) in KINDS.items():
            try:
                open_motion_board(f"{other}{port}").close()
            except ArmsightError:
                continue
            raise InputError(f"{port}: {what} answers, not {KINDS[f'{kind}:'][0]}: armsight setup {arm}") from error
        raise
