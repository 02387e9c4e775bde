"""Which port is the arm's, and which cameras are left and right: by moving a joint, unplugging a cable, covering a lens."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterable, Sequence

import cv2
import numpy as np

from armsight.data import Array
from armsight.errors import ArmsightError, DeviceError, InputError
from armsight.robot.board_registry import open_motion_board
from armsight.robot.boards.contract import MotionBoard
from armsight.robot.boards.serial import list_ports
from armsight.vision.sources.capture import open_capture
from armsight.vision.sources.v4l2 import VideoDevice, find_cameras

#: s; between two looks at the ports; half: nothing, double: a plug that is moved fast is not seen.
_LOOK_S = 0.2
#: A covered lens: its view is this much darker, and no other by so much; half: hands are not enough, double: clouds
#: are.
COVERED, NOT_COVERED = 0.45, 0.75
_MOVED_RAD = np.radians(3.0)  # by a hand; half: backlash and noise pass for it, double: a stiff joint is pushed far
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
    """Return the source of two cameras; ``covered`` asks a person to cover a lens, and returns once it is."""
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
            if share[darkest] < COVERED and share[others[0]] > NOT_COVERED and darkest not in found:
                found.append(darkest)
                break
            ask = f"No view became dark, or more than one, or the same as before. Cover the {side} lens alone"
    return "usb:" + ",".join(device.removeprefix("/dev/video") for device in found)


def check_arm(board: str) -> None:
    """Raise an error where another kind of arm, or nothing, answers at a port such as ``feetech:/dev/ttyACM0``."""
    kind, _, port = board.partition(",")[0].partition(":")
    try:
        open_motion_board(board).close()
    except ArmsightError as error:
        if found := _opened(port, [other for other in KINDS if other != f"{kind}:"]):
            name, opened = found
            opened.close()
            what, arm = _kind(name)
            raise InputError(f"{port}: {what} answers, not {_kind(board)[0]}: armsight setup {arm}") from error
        raise


def check_model(board: str, arm: str) -> None:
    """Raise an error where a board such as ``ar4:/dev/ttyACM0`` cannot be of the arm that is called so."""
    what, its = _kind(board)
    if its and arm != its and arm in [each for _, each in KINDS.values()]:
        raise InputError(f"{board.partition(':')[2]}: {what} answers, and {arm} is chosen: choose {its}")


def _kind(board: str) -> tuple[str, str]:
    """Return what stands behind a board's name, and the arm whose page has it; "" of what is at no port."""
    return KINDS.get(f"{board.partition(':')[0]}:", ("", ""))


def _opened(port: str, kinds: Iterable[str] = KINDS) -> tuple[str, MotionBoard] | None:
    """Return the board that answers at a port, with its name; None where none does."""
    for kind in kinds:
        with contextlib.suppress(ArmsightError):
            return f"{kind}{port}", open_motion_board(f"{kind}{port}")
    return None


def find_board(say: Callable[[str], None], ports: Callable[[], Sequence[str]] = list_ports) -> str:
    """Return the arm's board, as in ``feetech:/dev/ttyACM0``: the only one, or that whose joint or cable a person moves."""
    say("Looking at the ports.")
    there = ports()
    found = dict(each for port in there if (each := _opened(port)) is not None)
    try:
        if len(found) > 1:
            say(f"{len(found)} arms answer: move a joint of yours by hand, or unplug it.")
            return _back(_moved(found, lambda: set(there) - set(ports())), say, ports)
    finally:
        for board in found.values():
            board.close()
    if found:
        return next(iter(found))
    port = find_port(say, ports)
    if (plugged := _opened(port)) is None:
        raise DeviceError(f"{port}: nothing answers: is the arm switched on?")
    plugged[1].close()
    return plugged[0]


def _back(name: str, say: Callable[[str], None], ports: Callable[[], Sequence[str]]) -> str:
    """Return the name of a board once it is plugged in, with the port that it then has."""
    kind, _, port = name.partition(":")
    there = set(ports())
    if port not in there:
        say("Plug the arm's USB cable in again.")
        port = (_other(there, ports, gone=False) - there).pop()
    return f"{kind}:{port}"


def _moved(boards: dict[str, MotionBoard], gone: Callable[[], set[str]]) -> str:
    """Return the name of the board of which a joint moves, or whose port is gone."""
    first: dict[str, Array] = {}
    while True:
        for name, board in boards.items():
            try:
                q = board.receive(_LOOK_S / len(boards)).q
            except DeviceError:
                return name
            if name.partition(":")[2] in gone():
                return name
            if len(q) and np.abs(q[-1] - first.setdefault(name, q[0])).max() > _MOVED_RAD:
                return name
