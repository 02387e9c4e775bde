"""The list of cameras: structures as a C compiler lays out the kernel's, and a driver that answers from a table."""

import errno
import json
import os
import struct
import sys

import pytest

from armsight.app.main import main
from armsight.vision.sources import v4l2 as cameras
from cli_runs import assert_has

# Filled in C with <linux/videodev2.h> and dumped: (hex of the head, length); the rest is zeros.
CAPTURE_NODE = (
    "757663766964656f000000000000000048442057656263616d20433532350000000000000000000000000000000000007573622d30303030"
    "3a30303a31342e302d320000000000000000000000000000000106000100808401000004",
    104,
)
METADATA_NODE = (CAPTURE_NODE[0][:168] + "0100808400008004", 104)
MJPG = ("0000000001000000010000004d6f74696f6e2d4a5045470000000000000000000000000000000000000000004d4a5047", 64)
SIZE_1280x720 = ("010000004d4a50470100000000050000d0020000", 44)
SIZE_STEPS = ("0000000047524559030000002000000080070000100000001800000038040000080000", 44)
RATE_30 = ("000000004d4a504700050000d0020000010000001516050080969800", 52)
RATE_60_TO_5 = ("0000000047524559800700003804000002000000010000003c000000010000000500000001000000010000", 52)


def buffer(canned):
    head, length = canned
    return bytes.fromhex(head).ljust(length, b"\0")


def test_structures_are_read_as_the_kernel_lays_them_out():
    assert cameras.capability(buffer(CAPTURE_NODE)) == ("uvcvideo", "HD Webcam C525", "usb-0000:00:14.0-2", True)
    assert cameras.capability(buffer(METADATA_NODE))[3] is False
    assert cameras.pixel_format(buffer(MJPG)) == ("MJPG", "Motion-JPEG")
    assert cameras.frame_size(buffer(SIZE_1280x720)) == (1280, 720, None)
    assert cameras.frame_size(buffer(SIZE_STEPS)) == (1920, 1080, (32, 24))
    assert cameras.frame_rates(buffer(RATE_30)) == (30.0,)  # 333333 / 10000000 s
    assert cameras.frame_rates(buffer(RATE_60_TO_5)) == (5.0, 60.0)


def test_requests_carry_the_size_of_their_structure():
    """_IOC packs direction, size, 'V' and number: the size must be that of the buffer handed over."""
    sizes = {"QUERYCAP": 104, "ENUM_FMT": 64, "QUERYCTRL": 68, "ENUM_FRAMESIZES": 44, "ENUM_FRAMEINTERVALS": 52}
    assert sizes.keys() == {request.name for request in cameras.V4l2Request}
    for request, size in ((cameras.V4l2Request[name], size) for name, size in sizes.items()):
        assert (request >> 16) & 0x3FFF == size
        assert (request >> 8) & 0xFF == ord("V")


class Driver:
    """Two formats: MJPG with two sizes, of which the second has two rates, and grey that scales freely."""

    def __init__(self, node=CAPTURE_NODE):
        self.node = node

    def __call__(self, device, request, asked):
        assert len(asked) == (request >> 16) & 0x3FFF
        answer = {
            cameras.V4l2Request.QUERYCAP: self.query,
            cameras.V4l2Request.ENUM_FMT: self.formats,
            cameras.V4l2Request.ENUM_FRAMESIZES: self.sizes,
            cameras.V4l2Request.ENUM_FRAMEINTERVALS: self.rates,
            cameras.V4l2Request.QUERYCTRL: self.controls,
        }[request](asked)
        if answer is None:
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
        assert len(answer) == len(asked)
        return answer

    def query(self, _):
        return buffer(self.node)

    def controls(self, asked):
        """Exposure from 0.3 to 204.7 ms; a gain that is disabled."""
        (number,) = struct.unpack_from("=I", asked)
        low, high, flags = {0x009A0902: (3, 2047, 0), 0x00980913: (0, 255, 1)}[number]
        return struct.pack("=2I32s4iI8x", number, 1, b"", low, high, 1, low, flags)

    def formats(self, asked):
        index, kind = struct.unpack_from("=2I", asked)
        assert kind == 1
        grey = bytearray(buffer(MJPG))
        grey[44:48], grey[12:44] = b"GREY", b"8-bit Greyscale".ljust(32, b"\0")
        return [buffer(MJPG), bytes(grey)][index] if index < 2 else None

    def sizes(self, asked):
        index, fourcc = struct.unpack_from("=I4s", asked)
        if fourcc == b"GREY":
            return buffer(SIZE_STEPS) if index == 0 else None
        small = bytearray(buffer(SIZE_1280x720))
        small[12:20] = struct.pack("=2I", 640, 480)
        return [bytes(small), buffer(SIZE_1280x720)][index] if index < 2 else None

    def rates(self, asked):
        index, fourcc, width, height = struct.unpack_from("=I4s2I", asked)
        if fourcc == b"GREY":
            assert (width, height) == (1920, 1080)
            return buffer(RATE_60_TO_5) if index == 0 else None
        slow = bytearray(buffer(RATE_30))
        slow[20:28] = struct.pack("=2I", 1, 15)
        known = [buffer(RATE_30), bytes(slow)] if width == 1280 else [buffer(RATE_30)]
        return known[index] if index < len(known) else None


EXPECTED = (
    cameras.Format("MJPG", "Motion-JPEG", (cameras.Size(640, 480, (30.0,)), cameras.Size(1280, 720, (30.0, 15.0)))),
    cameras.Format("GREY", "8-bit Greyscale", (cameras.Size(1920, 1080, (5.0, 60.0), (32, 24)),)),
)


def test_formats_sizes_and_rates_are_asked_for_one_by_one():
    assert cameras.describe(3, Driver()) == EXPECTED


def test_a_driver_without_lists_has_no_sizes():
    def poor(device, request, asked):
        if request != cameras.V4l2Request.ENUM_FMT:
            raise OSError(errno.ENOTTY, "no such request")
        return Driver()(device, request, asked)

    assert cameras.describe(3, poor) == (
        cameras.Format("MJPG", "Motion-JPEG", ()),
        cameras.Format("GREY", "8-bit Greyscale", ()),
    )


@pytest.fixture
def computer(tmp_path, monkeypatch):
    """A /sys and a /dev with two cameras of one model, each with its metadata node, the second not permitted."""
    sys_dir, dev = tmp_path / "sys", tmp_path / "dev"
    nodes = {"video0": CAPTURE_NODE, "video1": METADATA_NODE, "video2": CAPTURE_NODE, "video10": CAPTURE_NODE}
    for name in nodes:
        (sys_dir / name).mkdir(parents=True)
        (sys_dir / name / "name").write_text("HD Webcam C525: HD Webcam\n")
        dev.mkdir(exist_ok=True)
        (dev / name).touch()
    for kind, link, target in (
        ("by-id", "usb-046d_HD_Webcam_C525-video-index0", "video2"),
        ("by-path", "pci-0000:00:14.0-usb-0:1:1.0-video-index0", "video0"),
        ("by-path", "pci-0000:00:14.0-usb-0:2:1.0-video-index0", "video2"),
    ):
        (dev / "v4l" / kind).mkdir(parents=True, exist_ok=True)
        (dev / "v4l" / kind / link).symlink_to(f"../../{target}")
    opened, really_open = {}, os.open

    def opening(path, flags):
        if os.path.basename(path) == "video10":
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        handle = really_open(path, flags)
        opened[handle] = nodes[os.path.basename(path)]
        return handle

    monkeypatch.setattr(cameras.os, "open", opening)
    monkeypatch.setattr(cameras, "_ioctl", lambda handle, *rest: Driver(opened[handle])(handle, *rest))
    find = cameras.find_cameras
    monkeypatch.setattr(cameras, "find_cameras", lambda: find(sys_dir, dev))
    return dev


def test_cameras_are_found_with_their_stable_paths(computer):
    first, second, closed = cameras.find_cameras()
    assert first == cameras.VideoDevice(
        f"{computer}/video0",
        "HD Webcam C525",
        (f"{computer}/v4l/by-path/pci-0000:00:14.0-usb-0:1:1.0-video-index0",),
        "uvcvideo",
        "usb-0000:00:14.0-2",
        EXPECTED,
        exposure_ms=(0.3, 204.7),
    )
    assert [path.rsplit("/", 2)[1] for path in second.stable] == ["by-id", "by-path"]
    assert (closed.device, closed.name, closed.formats) == (f"{computer}/video10", "HD Webcam C525: HD Webcam", ())
    assert closed.problem == "no permission; join the group video: sudo usermod -aG video $USER, then log in again"


def test_a_device_that_does_not_answer_is_listed_with_the_reason(computer, monkeypatch):
    def gone(*_):
        raise OSError(errno.ENODEV, "No such device")

    monkeypatch.setattr(cameras, "_ioctl", gone)
    assert {camera.problem for camera in cameras.find_cameras()[:2]} == {"does not answer: No such device"}


def run(monkeypatch, capsys, *arguments):
    monkeypatch.setattr(sys, "argv", ["armsight", "cameras", *arguments])
    with pytest.raises(SystemExit) as caught:
        main()
    return caught.value.code, *capsys.readouterr()


def test_the_command_lists_for_people_and_programs(computer, monkeypatch, capsys):
    code, out, err = run(monkeypatch, capsys)
    assert (code, err) == (0, "")
    assert out.splitlines()[:7] == [
        f"{computer}/video0  HD Webcam C525  (uvcvideo, usb-0000:00:14.0-2)",
        f"  {computer}/v4l/by-path/pci-0000:00:14.0-usb-0:1:1.0-video-index0",
        "  MJPG  Motion-JPEG",
        "    640x480  30 frames per second",
        "    1280x720  30 15 frames per second",
        "  GREY  8-bit Greyscale",
        "    32x24 to 1920x1080  5 60 frames per second",
    ]
    code, out, _ = run(monkeypatch, capsys, "--json")
    assert code == 0
    listed = json.loads(out)["cameras"]
    assert [camera["device"] for camera in listed] == [f"{computer}/video{n}" for n in (0, 2, 10)]
    assert listed[0]["formats"][0]["sizes"][1] == {
        "width_px": 1280,
        "height_px": 720,
        "fps": [30.0, 15.0],
        "from_px": None,
    }


def test_no_camera_is_said_with_what_to_check(monkeypatch, capsys, tmp_path):
    find = cameras.find_cameras
    monkeypatch.setattr(cameras, "find_cameras", lambda: find(tmp_path / "none", tmp_path))
    code, out, err = run(monkeypatch, capsys)
    assert (code, err) == (0, "")
    assert out.startswith("no camera is attached\n")
    assert_has(out, "lsusb", "group video")
    code, out, _ = run(monkeypatch, capsys, "--json")
    assert (code, json.loads(out)) == (0, {"cameras": []})
