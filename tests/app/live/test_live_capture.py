"""The capture: the newest shot alone, a camera that is pulled out and put back, left and right exchanged."""

import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from armsight.app.live import capture as module
from armsight.app.live.capture import CameraCapture, LiveShot
from armsight.app.live.records import UseCameras
from armsight.app.live.session import LiveSession, SessionOptions
from armsight.data import PoseEstimate, Shot
from armsight.errors import DeviceError, InputError
from armsight.sim.workcell.person import SimulatedCameras
from armsight.vision.markers.targets import open_target
from armsight.vision.pose.measure import measure
from waiting import until

pytestmark = pytest.mark.real_time

LEFT, RIGHT = np.full((4, 6), 1, np.uint8), np.full((4, 6), 2, np.uint8)


class Cable:
    """A source that gives shots while it is plugged in."""

    count = None

    def __init__(self):
        self.plugged, self.opened, self.closed, self.number = threading.Event(), 0, 0, 0
        self.plugged.set()

    def open(self):
        if not self.plugged.is_set():
            raise DeviceError("/dev/video0: no such camera")
        self.opened += 1
        return self

    def read(self):
        if not self.plugged.is_set():
            raise DeviceError("/dev/video0: the camera is gone")
        time.sleep(0.005)
        self.number += 1
        return Shot(str(self.number), LEFT, RIGHT, time.monotonic())

    def close(self):
        self.closed += 1


@pytest.fixture
def cable(monkeypatch):
    monkeypatch.setattr(module, "_REOPEN_S", 0.05)
    return Cable()


@pytest.fixture
def capture(cable):
    made = CameraCapture(cable.open)
    made.start()
    yield made
    made.close()


def test_whoever_waits_gets_the_newest_shot(capture):
    first = capture.after(0, 60.0)
    until(lambda: capture.newest.number > first.number + 3)
    later = capture.after(first.number, 60.0)
    assert later.number > first.number + 3
    assert capture.after(10**9, 0.01) is None
    polled = capture.poll()
    assert int(polled.name) >= later.number
    until(lambda: capture.rate_hz is not None)
    assert 0.0 <= later.age_s(later.arrived_s) < 1.0


def test_a_camera_that_is_pulled_out_and_put_back_goes_on(capture, cable):
    before = capture.after(0, 60.0)
    cable.plugged.clear()
    until(lambda: capture.problem is not None)
    assert "the camera is gone" in capture.problem
    until(lambda: capture.problem == "/dev/video0: no such camera")
    cable.plugged.set()
    assert capture.after(before.number + 1, 60.0) is not None
    until(lambda: capture.problem is None)
    assert cable.opened == 2
    assert cable.closed == 1


def test_left_and_right_are_exchanged(capture):
    capture.swapped = True
    until(lambda: capture.newest is not None and capture.newest.shot.left[0, 0] == 2)


def test_while_it_is_paused_somebody_else_gives_the_shots(capture, cable):
    capture.after(0, 60.0)
    capture.pause()
    count = cable.number
    time.sleep(0.05)
    assert cable.number == count
    capture.offer(Shot("other", LEFT, RIGHT))
    assert capture.newest.shot.name == "other"
    capture.resume()
    until(lambda: cable.number > count)


def test_the_age_is_by_the_stamp_where_that_is_on_this_clock():
    assert LiveShot(Shot("a", LEFT, RIGHT, 99.9), 1, 100.0).age_s(100.1) == pytest.approx(0.2)
    for stamp in (None, 5.0, 200.0):  # none, or of another clock
        assert LiveShot(Shot("a", LEFT, RIGHT, stamp), 1, 100.0).age_s(100.1) == pytest.approx(0.1)


def test_the_simulated_person_holds_the_board_beside_the_body(host_firmware, tmp_path):
    """This seed once held it before the body, for good: no pose was measured any more."""
    cameras = SimulatedCameras("640x360@15", "worn", 43, "host")
    try:
        (tmp_path / "body.toml").write_text(cameras.workcell.body_text)
        cameras.person.act("board")
        cameras.person.reach(None)
        shot = cameras.person.shot(1)
        result = measure(cameras.workcell.truth.rig, open_target(str(tmp_path / "body.toml")), shot)
        assert isinstance(result, PoseEstimate), result
    finally:
        cameras.end()


def test_one_camera_alone_is_one_line_and_the_session_stays(tmp_path):
    session = LiveSession(SessionOptions(tmp_path / "live", "usb:7"))
    session.start()
    try:
        until(lambda: session.events())
        for missing in ("usb:7", "usb:7@640x480,exposure=5ms"):
            with pytest.raises(InputError, match="names one camera, two are needed"):
                session.execute(UseCameras(missing))
        session.execute(UseCameras("usb:/dev/none-left,/dev/none-right"))
        until(lambda: "none-left: no such camera" in (session.sections()["cameras"].problem or ""))
        errors = [event.text for event in session.events() if event.level == "error"]
        assert len(errors) == 2, errors
        assert errors[0].startswith("usb:7 names one camera, two are needed")
    finally:
        session.close()


def test_the_page_does_not_import_what_takes_much_memory():
    code = (
        "import armsight.app.live.session, sys; print([m for m in ('scipy.signal', 'scipy.stats') if m in sys.modules])"
    )
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert answer.stdout == "[]\n"
