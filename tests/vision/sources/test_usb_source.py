"""Two USB cameras, played by a stand-in for OpenCV's capture with a queue as V4L2's and a clock of its own."""

import os
import struct
import subprocess
import sys

import cv2
import numpy as np
import pytest

from armsight.errors import DeviceError, InputError
from armsight.vision.sources import open_source, usb

PERIOD = 1 / 30


class Clock:
    """Time that passes only when something waits."""

    def __init__(self):
        self.now = 1000.0

    def monotonic(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds


class FakeCapture:
    """A camera that takes a frame every period once it streams; the driver queues four and then drops new ones."""

    def __init__(self, clock, log, phase=0.0, period=PERIOD, stubborn=(), stamps=True, size=None, auto=3.0):
        self.clock, self.log, self.phase, self.period = clock, log, phase, period
        self.stubborn, self.stamps, self.size = stubborn, stamps, size
        self.props = {
            cv2.CAP_PROP_FRAME_WIDTH: 640.0,
            cv2.CAP_PROP_FRAME_HEIGHT: 480.0,
            cv2.CAP_PROP_FPS: 30.0,
            cv2.CAP_PROP_FOURCC: float(cv2.VideoWriter.fourcc(*"YUYV")),
            cv2.CAP_PROP_AUTO_EXPOSURE: auto,
            cv2.CAP_PROP_EXPOSURE: 156,
            cv2.CAP_PROP_GAIN: 0.0,
        }
        self.queue, self.next, self.stamp = [], None, 0.0
        self.dead = self.undecodable = False
        self.jpeg = None
        self.released = 0

    def set(self, prop, value):
        if prop not in self.stubborn:
            self.props[prop] = float(value)
        return prop not in self.stubborn

    def get(self, prop):
        if prop == cv2.CAP_PROP_POS_MSEC:
            return self.stamp * 1000 if self.stamps else 0.0
        return self.props[prop]

    def _stream(self):
        if self.next is None:  # streaming starts with the first grab; the sensor needs a while
            start = self.clock.now + 0.2 - self.phase
            self.next = np.ceil(start / self.period) * self.period + self.phase
        while self.next <= self.clock.now:
            if len(self.queue) < 4:
                self.queue.append(self.next)
            self.next += self.period

    def grab(self):
        self.log.append("grab")
        if self.dead:
            self.clock.now += 2.0  # the time OpenCV waits in select()
            return False
        self._stream()
        if not self.queue:
            self.clock.now = self.next
            self._stream()
        self.stamp = self.queue.pop(0)
        return True

    def retrieve(self):
        self.log.append("retrieve")
        if self.undecodable:
            return False, None
        size = self.size or (self.props[cv2.CAP_PROP_FRAME_WIDTH], self.props[cv2.CAP_PROP_FRAME_HEIGHT])
        # OpenCV hands out the driver's buffer as one row.
        if self.jpeg and not self.props.get(cv2.CAP_PROP_CONVERT_RGB, 1.0):
            return True, np.frombuffer(self.jpeg, np.uint8).reshape(1, -1)
        return True, np.zeros((int(size[1]), int(size[0]), 3), np.uint8)

    def release(self):
        self.released += 1


@pytest.fixture
def usb_pair(monkeypatch, tmp_path):
    """Open two cameras that are files here, and captures made to order."""

    class UsbPair:
        def __init__(self):
            self.clock, self.log = Clock(), []
            self.devices = [tmp_path / "cam0", tmp_path / "cam1"]
            self.captures = []
            for device in self.devices:
                device.touch()

        def open(self, tail="", left=None, right=None):
            orders = iter([left or {}, right or {}])

            def capture(_):
                self.captures.append(FakeCapture(self.clock, self.log, **next(orders)))
                return self.captures[-1]

            return usb.open_usb(f"{self.devices[0]},{self.devices[1]}{tail}", capture)

    made = UsbPair()
    monkeypatch.setattr(usb, "time", made.clock)
    return made


@pytest.mark.opencv
def test_both_are_grabbed_before_either_is_decoded(usb_pair):
    source = usb_pair.open()
    source.read()
    usb_pair.log.clear()
    shot = source.read()
    assert usb_pair.log == ["grab", "grab", "retrieve", "retrieve"]
    assert shot.left.shape == shot.right.shape == (480, 640, 3)
    assert shot.name == "000001"
    source.close()
    source.close()
    assert all(capture.released for capture in usb_pair.captures)


@pytest.mark.parametrize("phase", [0.0, 0.004, 0.012, 0.02, 0.03])
@pytest.mark.parametrize("pause", [0.0, 0.02, 0.05, 0.5])
def test_shots_are_fresh_and_their_frames_belong_together(usb_pair, phase, pause):
    """However the two cameras' phases lie and however slow the user is; the queues of a start-up do not stay behind."""
    source = usb_pair.open(right={"phase": phase})
    last_s = -np.inf
    for _ in range(12):
        shot = source.read()
        left, right = (capture.stamp for capture in usb_pair.captures)
        assert abs(left - right) <= PERIOD / 2 + 1e-6
        assert usb_pair.clock.now - shot.t_s <= 2.5 * PERIOD  # two periods a frame, half of one between the cameras
        assert shot.t_s == pytest.approx((left + right) / 2, abs=1e-6)
        assert shot.t_s > last_s
        last_s = shot.t_s
        usb_pair.clock.now += pause


def test_a_driver_without_time_stamps_gets_the_time_after_the_grab(usb_pair):
    source = usb_pair.open(left={"stamps": False}, right={"stamps": False})
    shot = source.read()
    assert shot.t_s == pytest.approx(usb_pair.clock.now, abs=PERIOD)


def test_cameras_of_rates_that_never_meet_are_reported(usb_pair):
    source = usb_pair.open(left={"period": PERIOD}, right={"period": PERIOD})
    usb_pair.captures[1].clock = Clock()  # the right one's stamps stand on a clock that stays behind
    usb_pair.captures[1].clock.now -= 5.0
    with pytest.raises(
        DeviceError, match=r"cam0 and .*cam1: frames stay \d\.\d+ s apart, more than half a frame period"
    ):
        source.read()


@pytest.mark.opencv
def test_all_settings_arrive_at_both_cameras(usb_pair):
    usb_pair.open("@1280x720@60,exposure=5ms,gain=20,format=MJPG")
    expected = {
        "FOURCC": cv2.VideoWriter.fourcc(*"MJPG"),
        "FRAME_WIDTH": 1280,
        "FRAME_HEIGHT": 720,
        "FPS": 60,
        "GAIN": 20,
    }
    expected |= {"AUTO_EXPOSURE": 1, "EXPOSURE": 50}  # V4L2 counts in 0.1 ms
    for capture in usb_pair.captures:
        assert {name: capture.props[getattr(cv2, f"CAP_PROP_{name}")] for name in expected} == expected


@pytest.mark.parametrize(("tail", "before", "after"), [("", 3, 3), ("", 1, 1), (",exposure=auto", 1, 3)])
def test_what_is_not_asked_for_stays(usb_pair, tail, before, after):
    usb_pair.open(tail, left={"auto": before})
    assert usb_pair.captures[0].props[cv2.CAP_PROP_EXPOSURE] == 156
    assert usb_pair.captures[0].props[cv2.CAP_PROP_AUTO_EXPOSURE] == after
    assert usb_pair.captures[0].props[cv2.CAP_PROP_FRAME_WIDTH] == 640


@pytest.mark.parametrize(
    ("tail", "stubborn", "said"),
    [
        ("", cv2.CAP_PROP_FOURCC, "did not take format MJPG, it says YUYV"),
        ("@1280x720", cv2.CAP_PROP_FRAME_WIDTH, "did not take width 1280, it says 640"),
        ("@1280x720", cv2.CAP_PROP_FRAME_HEIGHT, "did not take height 720, it says 480"),
        ("@60", cv2.CAP_PROP_FPS, "did not take 60 frames per second, it says 30"),
        (",exposure=5ms", cv2.CAP_PROP_AUTO_EXPOSURE, "did not take manual exposure (1), it says 3"),
        (",exposure=5ms", cv2.CAP_PROP_EXPOSURE, "did not take exposure 50 (x 0.1 ms), it says 156"),
        (",gain=20", cv2.CAP_PROP_GAIN, "did not take gain 20, it says 0"),
    ],
)
def test_a_setting_not_taken_is_named_and_both_cameras_let_go(usb_pair, tail, stubborn, said):
    with pytest.raises(DeviceError) as caught:
        usb_pair.open(tail, right={"stubborn": (stubborn,)})
    assert str(caught.value) == f"{usb_pair.devices[1]}: {said}; `armsight cameras` lists what it can do"
    assert [capture.released for capture in usb_pair.captures] == [1, 1]


def test_a_stall_is_reported_and_who_stalled(usb_pair):
    source = usb_pair.open()
    source.read()
    usb_pair.captures[1].dead = True
    with pytest.raises(DeviceError) as caught:
        source.read()
    assert str(caught.value) == f"{usb_pair.devices[1]}: no frame for 5 s: stalled; two cameras may need two USB ports"


def test_an_unplugged_camera_is_reported(usb_pair):
    source = usb_pair.open()
    source.read()
    usb_pair.captures[0].dead = True
    usb_pair.devices[0].unlink()
    with pytest.raises(DeviceError, match=r"cam0: the camera is gone: unplugged"):
        source.read()


def test_a_hiccup_shorter_than_a_stall_is_waited_out(usb_pair):
    source = usb_pair.open()
    source.read()
    grab, misses = usb_pair.captures[0].grab, iter([False, False])
    usb_pair.captures[0].grab = lambda: next(misses, None) is None and grab()
    assert source.read().problem is None


@pytest.mark.opencv
def test_a_frame_that_does_not_decode_is_a_shot_with_a_problem(usb_pair):
    source = usb_pair.open()
    usb_pair.captures[1].undecodable = True
    shot = source.read()
    assert (shot.left, shot.right) == (None, None)
    assert shot.problem == f"{usb_pair.devices[1]}: the frame cannot be decoded"
    usb_pair.captures[1].undecodable = False
    assert source.read().problem is None


def test_a_frame_of_another_size_is_reported(usb_pair):
    source = usb_pair.open("@1280x720", right={"size": (640, 480)})
    with pytest.raises(DeviceError, match=r"cam1: sends frames of 640x480 px, agreed on 1280x720"):
        source.read()


@pytest.mark.parametrize(
    "rest",
    ["", "0", "0,", ",1", "0,1@", "0,1@640x480@", "0,1@640x480x3", "0,1,2", "0,1,exposure=5",
     "0,1,exposure=5ms=6", "0,1,gain=x", "0,1,format=MJPEG", "0,1@30@640x480"],
)  # fmt: skip
def test_a_text_of_another_form_is_reported(rest):
    opened = []
    with pytest.raises(InputError, match=r"expected usb:LEFT,RIGHT\[@WIDTHxHEIGHT\]"):
        usb.open_usb(rest, opened.append)
    assert opened == []


def test_one_camera_twice_is_an_error(tmp_path):
    (tmp_path / "by-id").symlink_to("/dev/video0")
    for rest in ("0,0", "0,/dev/video0", f"0,{tmp_path}/by-id"):
        with pytest.raises(InputError, match="left and right are the same camera"):
            usb.open_usb(rest)


@pytest.mark.opencv
def test_real_devices_that_are_not_there_or_no_cameras(tmp_path):
    with pytest.raises(DeviceError, match=r"/dev/video97: no such camera; `armsight cameras` lists those attached"):
        open_source("usb:97,98")
    (tmp_path / "file").touch()
    with pytest.raises(DeviceError, match="cannot be opened: not a camera, or in use by another program"):
        open_source(f"usb:{tmp_path}/file,98")


@pytest.mark.opencv
@pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="Linux says which process has a file open")
def test_who_has_the_camera_is_named(tmp_path):
    (tmp_path / "file").touch()
    waits = "import sys; f = open(sys.argv[1]); print(1, flush=True); sys.stdin.read()"
    command = [sys.executable, "-c", waits, str(tmp_path / "file")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        other.stdout.readline()
        with pytest.raises(DeviceError, match=f"file: cannot be opened: in use by process {other.pid}, .*python"):
            open_source(f"usb:{tmp_path}/file,98")
        other.stdin.close()


@pytest.mark.opencv
def test_the_jpeg_of_a_camera_is_kept_as_it_came(usb_pair):
    """OpenCV hands out the driver's buffer, behind the frame the rest of an older and longer one."""
    scene = np.random.default_rng(8).integers(0, 255, (480, 640, 3), np.uint8)
    frames = [cv2.imencode(".jpg", scene[:, ::step])[1].tobytes() for step in (1, -1)]
    source = usb_pair.open(",format=MJPG")
    for capture, frame in zip(usb_pair.captures, frames, strict=True):
        capture.jpeg = frame + b"\x00\x12" + frames[0][5000:]
    shot = source.read()
    assert shot.encoded == tuple(frames)
    np.testing.assert_array_equal(shot.left, cv2.imdecode(np.frombuffer(frames[0], np.uint8), cv2.IMREAD_COLOR))
    rotated = b"Exif\0\0II*\0" + struct.pack("<IHHHIII", 8, 1, 0x0112, 3, 1, 3, 0)  # upside down, says EXIF
    usb_pair.captures[0].jpeg = (
        frames[0][:2] + b"\xff\xe1" + struct.pack(">H", len(rotated) + 2) + rotated + frames[0][2:]
    )
    np.testing.assert_array_equal(source.read().left, shot.left)
    usb_pair.captures[1].jpeg = frames[1][:4000]  # a frame that was cut short on the bus
    cut = source.read()
    assert cut.left is None
    assert "cam1: the frame cannot be decoded" in cut.problem
