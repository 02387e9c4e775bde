"""The attached cameras and what each can do, by Linux's V4L2.

In: /sys/class/video4linux and the devices' own answers (ioctls). Out: one :class:`VideoDevice` for each camera: name,
stable path, pixel formats, sizes and frame rates. Structures as in the kernel's videodev2.h.
"""

from __future__ import annotations

import dataclasses
import enum
import errno
import fcntl
import os
import struct
from collections.abc import Callable, Iterator
from pathlib import Path

from armsight.files import natural_key

#: Unit of exposure_time_absolute, ms.
EXPOSURE_UNIT_MS = 0.1

#: (device, request, buffer) -> the buffer the driver filled in; OSError when it has no answer.
Ioctl = Callable[[int, int, bytes], bytes]


@enum.unique
class V4l2Request(enum.IntEnum):
    """Requests of videodev2.h, _IOWR('V', n, struct ...); each says how many bytes it takes."""

    QUERYCAP = 0x80685600
    ENUM_FMT = 0xC0405602
    QUERYCTRL = 0xC0445624
    ENUM_FRAMESIZES = 0xC02C564A
    ENUM_FRAMEINTERVALS = 0xC034564B


@enum.unique
class Control(enum.IntEnum):
    """Controls of v4l2-controls.h."""

    EXPOSURE = 0x009A0902
    GAIN = 0x00980913


@enum.unique
class ExposureMode(enum.IntEnum):
    """Values of the control auto_exposure."""

    MANUAL = 1
    AUTO = 3  # aperture priority mode


@enum.unique
class Capability(enum.IntFlag):
    """What a device can do; DEVICE_CAPS: its own capabilities are given beside the driver's."""

    CAPTURE = 0x00000001
    DEVICE_CAPS = 0x80000000


_DISABLED = 0x0001  # V4L2_CTRL_FLAG_DISABLED
_BUF_TYPE_VIDEO_CAPTURE = 1
_DISCRETE = 1  # V4L2_FRMSIZE_TYPE_DISCRETE, V4L2_FRMIVAL_TYPE_DISCRETE


@dataclasses.dataclass(frozen=True)
class Size:
    """A frame size; where a driver scales freely, the largest one, with the smallest in ``from_px``."""

    width_px: int
    height_px: int
    fps: tuple[float, ...]
    from_px: tuple[int, int] | None = None


@dataclasses.dataclass(frozen=True)
class Format:
    """A pixel format and its sizes."""

    fourcc: str
    description: str
    sizes: tuple[Size, ...]


@dataclasses.dataclass(frozen=True)
class VideoDevice:
    """One attached camera; ``problem`` is the reason why it did not answer.

    ``exposure_ms`` and ``gain`` are the smallest and the largest value that its driver takes, None where it takes none.
    """

    device: str
    name: str
    stable: tuple[str, ...]
    driver: str = ""
    bus: str = ""
    formats: tuple[Format, ...] = ()
    problem: str | None = None
    exposure_ms: tuple[float, float] | None = None
    gain: tuple[float, float] | None = None


def capability(buffer: bytes) -> tuple[str, str, str, bool]:
    """Read struct v4l2_capability: driver, card, bus, and whether this device delivers images."""
    driver, card, bus, _, capabilities, device = struct.unpack_from("=16s32s32sIII", buffer)
    mine = device if capabilities & Capability.DEVICE_CAPS else capabilities
    return _text(driver), _text(card), _text(bus), bool(mine & Capability.CAPTURE)


def pixel_format(buffer: bytes) -> tuple[str, str]:
    """Read struct v4l2_fmtdesc: four-character code and description."""
    description, fourcc = struct.unpack_from("=12x32s4s", buffer)
    return _text(fourcc), _text(description)


def frame_size(buffer: bytes) -> tuple[int, int, tuple[int, int] | None]:
    """Read struct v4l2_frmsizeenum: width and height, px, and where sizes go in steps the smallest."""
    kind, *n = struct.unpack_from("=8x7I", buffer)
    return (n[0], n[1], None) if kind == _DISCRETE else (n[1], n[4], (n[0], n[3]))


def frame_rates(buffer: bytes) -> tuple[float, ...]:
    """Read struct v4l2_frmivalenum: frames per second; where they go in steps the slowest and the fastest."""
    kind, *n = struct.unpack_from("=16x5I", buffer)
    intervals = [n[0:2]] if kind == _DISCRETE else [n[2:4], n[0:2]]
    return tuple(round(below / above, 3) for above, below in intervals if above)


def describe(device: int, ioctl: Ioctl) -> tuple[Format, ...]:
    """Ask an open device for its formats, sizes and frame rates."""
    formats = []
    for found in _each(device, ioctl, V4l2Request.ENUM_FMT, struct.Struct("=2I56x"), _BUF_TYPE_VIDEO_CAPTURE):
        fourcc, description = pixel_format(found)
        code = fourcc.ljust(4).encode("latin1")
        sizes = []
        for size in _each(device, ioctl, V4l2Request.ENUM_FRAMESIZES, struct.Struct("=I4s36x"), code):
            width, height, smallest = frame_size(size)
            rates = _each(
                device, ioctl, V4l2Request.ENUM_FRAMEINTERVALS, struct.Struct("=I4s2I36x"), code, width, height
            )
            sizes.append(Size(width, height, tuple(fps for rate in rates for fps in frame_rates(rate)), smallest))
        formats.append(Format(fourcc, description, tuple(sizes)))
    return tuple(formats)


def control_range(device: int, ioctl: Ioctl, control: int, unit: float = 1.0) -> tuple[float, float] | None:
    """Ask an open device for the smallest and the largest value of a control; None where it has none, or it is disabled."""
    try:
        answer = ioctl(device, V4l2Request.QUERYCTRL, struct.pack("=I64x", control))
    except OSError:
        return None
    low, high, _, _, flags = struct.unpack_from("=40x4iI", answer)
    return None if flags & _DISABLED else (round(low * unit, 6), round(high * unit, 6))


def find_cameras(sys: Path = Path("/sys/class/video4linux"), dev: Path = Path("/dev")) -> list[VideoDevice]:
    """List the attached cameras; devices that deliver no images (metadata, output) are left out."""
    cameras = []
    for node in sorted(sys.glob("video*"), key=natural_key) if sys.is_dir() else []:
        path = dev / node.name
        links = [link for kind in ("by-id", "by-path") for link in sorted((dev / "v4l" / kind).glob("*"))]
        stable = tuple(str(link) for link in links if link.resolve() == path.resolve())
        name_file = node / "name"
        entry = VideoDevice(str(path), name_file.read_text().strip() if name_file.exists() else node.name, stable)
        try:
            handle = os.open(path, os.O_RDWR | os.O_NONBLOCK)
        except OSError as error:
            cameras.append(dataclasses.replace(entry, problem=_why(error)))
            continue
        try:
            driver, card, bus, captures = capability(_ioctl(handle, V4l2Request.QUERYCAP, bytes(104)))
            if captures:
                entry = dataclasses.replace(entry, name=card, driver=driver, bus=bus, formats=describe(handle, _ioctl))
                exposure_ms = control_range(handle, _ioctl, Control.EXPOSURE, EXPOSURE_UNIT_MS)
                gain = control_range(handle, _ioctl, Control.GAIN)
                cameras.append(dataclasses.replace(entry, exposure_ms=exposure_ms, gain=gain))
        except OSError as error:
            cameras.append(dataclasses.replace(entry, problem=_why(error)))
        finally:
            os.close(handle)
    return cameras


def _each(device: int, ioctl: Ioctl, request: int, layout: struct.Struct, *arguments: int | bytes) -> Iterator[bytes]:
    """Ask for entry 0, 1, 2, ... of a list until the driver says there are no more."""
    index = 0
    while True:
        try:
            answer = ioctl(device, request, layout.pack(index, *arguments))
        except OSError as error:
            if error.errno in (errno.EINVAL, errno.ENOTTY):  # the end of the list; a driver without such a list
                return
            raise
        yield answer
        index += 1


def _ioctl(device: int, request: int, buffer: bytes) -> bytes:
    return fcntl.ioctl(device, request, buffer)


def _text(raw: bytes) -> str:
    """Read a fixed-length string of a structure."""
    return raw.split(b"\0")[0].decode("utf-8", "replace")


def _why(error: OSError) -> str:
    """Return why a device does not answer, and what to do."""
    if error.errno in (errno.EACCES, errno.EPERM):
        return "no permission; join the group video: sudo usermod -aG video $USER, then log in again"
    return f"does not answer: {error.strerror}"
