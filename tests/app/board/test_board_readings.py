"""Joint readings beside live cameras: a board that is lost and comes back, said once; nothing is commanded."""

import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

from armsight.app.board import readings
from armsight.app.board.command import NOT_HOMED
from armsight.app.board.readings import BoardReadings
from armsight.data import JointStates
from armsight.errors import DeviceError, InputError
from armsight.loop.running.data import JointsDatum
from armsight.robot.boards.ar4.board import Ar4Board
from armsight.sim.boards.ar4 import Ar4Teensy
from armsight.sim.boards.device import SteppedLink
from cli_runs import assert_rejected


class FakeBoard:
    """Reads twice, with what it is given as faults, and is then gone; its clock begins at 0 with each."""

    homed = True

    def __init__(self, faults=()):
        self.status = SimpleNamespace(faults=faults, joints_not_homed=[])
        self.reads, self.closed = 0, False

    def receive(self, wait_s):
        self.reads += 1
        if self.reads > 2:
            raise DeviceError("the port is gone")
        return JointStates(np.array([0.1, 0.2]) + self.reads, np.full((2, 5), 0.5))

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.closed = True


def test_a_lost_board_is_opened_again_and_each_loss_is_said_once(monkeypatch):
    """Two tries fail while it is gone; its readings stay on the clock of the cameras."""
    boards, done, opened = [FakeBoard(), FakeBoard(("joint 2: hot",))], threading.Event(), []

    def open_any(name):
        opened.append(name)
        if len(opened) in (1, 4):
            return boards[len(opened) // 4]
        if len(opened) > 4:
            done.set()
        raise DeviceError(f"no such port, try {len(opened)}")

    monkeypatch.setattr(readings, "open_any", open_any)
    monkeypatch.setattr(readings, "is_real", lambda name: True)
    monkeypatch.setattr(readings, "_PAUSE_S", 0.001)
    data, lines, began = [], [], time.monotonic()
    board = BoardReadings("feetech:/dev/none")
    board.start(data.append, lines.append)
    assert done.wait(20)
    board.close()
    gone = "board: the port is gone; trying again"
    assert lines == ["board: connected", gone, "board: connected", "board: joint 2: hot", gone]
    joints = [each for each in data if isinstance(each, JointsDatum)]
    t_s = np.concatenate([each.states.t_s for each in joints])
    assert len(joints) >= 3  # the second board's own time begins anew, and the last of the first is not repeated
    assert (np.diff(t_s) > 0).all()
    assert began - 3 < t_s[0] < t_s[-1] < time.monotonic() + 3
    assert [each.level for each in data if not isinstance(each, JointsDatum)] == [
        "info",
        "error",
        "info",
        "warning",
        "error",
    ]
    assert all(each.closed for each in boards)


def test_an_arm_that_is_not_homed_gives_no_angles_until_it_is(monkeypatch):
    """Its port is free meanwhile for who homes it; a Teensy that restarts has lost its zeros again."""
    teensy, data, lines, opened = Ar4Teensy(homing_s=0.2), [], [], []

    def connect():
        link = SteppedLink(teensy)
        return Ar4Board.connect(link, now=link.now)

    def open_any(name):
        opened.append(sum(isinstance(each, JointsDatum) for each in data))
        if len(opened) == 4:
            with connect() as board:
                board.home()
        return connect()

    def put(datum):
        data.append(datum)
        if isinstance(datum, JointsDatum):
            teensy.restart()
        elif len(opened) == 5:
            again.set()

    again = threading.Event()
    monkeypatch.setattr(readings, "open_any", open_any)
    monkeypatch.setattr(readings, "is_real", lambda name: True)
    monkeypatch.setattr(readings, "_PAUSE_S", 0.001)
    board = BoardReadings("ar4:/dev/none")
    board.start(put, lines.append)
    assert again.wait(20)
    board.close()
    unhomed = f"board: ar4:/dev/none: {NOT_HOMED}; trying again"
    assert "nothing answers" in lines[2]  # no model is set in a Teensy that begins
    assert lines == [unhomed, "board: connected", lines[2], unhomed]
    assert opened[:5] == [0, 0, 0, 0, 1]
    q = np.vstack([each.states.q for each in data if isinstance(each, JointsDatum)])
    assert np.abs(q).max() < np.radians(0.1)  # at rest after homing; unhomed it reads up to -170 degrees


def test_a_board_that_loses_its_zero_while_it_is_read_gives_no_more_angles(monkeypatch):
    class Losing(FakeBoard):
        homed = property(lambda self: self.reads < 2)

    boards, said, data, lines = [Losing()], threading.Event(), [], []

    def open_any(name):
        if not boards:
            said.set()
            raise InputError("gone")
        return boards.pop()

    monkeypatch.setattr(readings, "open_any", open_any)
    monkeypatch.setattr(readings, "is_real", lambda name: True)
    monkeypatch.setattr(readings, "_PAUSE_S", 0.001)
    board = BoardReadings("feetech:/dev/none")
    board.start(data.append, lines.append)
    assert said.wait(20)
    board.close()
    assert lines == ["board: connected", f"board: feetech:/dev/none: {NOT_HOMED}; trying again"]
    assert sum(isinstance(each, JointsDatum) for each in data) == 1


def test_an_emulated_board_is_read_in_real_time_until_it_is_closed():
    data, lines, some = [], [], threading.Event()
    board = BoardReadings("emulated:host")
    board.start(lambda datum: (data.append(datum), isinstance(datum, JointsDatum) and some.set()), lines.append)
    assert some.wait(20)
    board.close()
    assert lines == ["board: connected"]
    assert next(each for each in data if isinstance(each, JointsDatum)).states.q.shape[1] == 6


def test_a_wrong_name_and_recordings_are_rejected(armsight, rendered):
    with pytest.raises(InputError, match="no board 'usb:0'"):
        BoardReadings("usb:0")
    arguments = ("measure", rendered.rig, "--target", rendered.plate, "--board", "emulated:host")
    for more in (("--source", rendered.folder / "arm", "--stream", "json+udp:9"), ("--source", "usb:0,1")):
        assert_rejected(armsight(*arguments, *more), "beside live cameras: give --stream, and --source usb: or url:")
