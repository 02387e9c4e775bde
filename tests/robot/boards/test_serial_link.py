"""A real port: what is said of one that cannot be used, and the host build behind a pseudo-terminal as a real board.

Time is real here, so nothing is asserted on it: whatever is waited for is waited for until it comes.
"""

import errno
import os
import pty
import sys

import numpy as np
import pytest
import serial
from board_rigs import PtyBoard, hold, keep_on

from armsight.app.board.selftest import selftest
from armsight.errors import DeviceError, InputError
from armsight.robot.board_registry import open_board
from armsight.robot.boards.codes import BoardState, Fault
from armsight.robot.boards.serial import SerialLink, list_ports
from armsight.sim.joints import PotFault

pytestmark = [
    pytest.mark.real_time,
    pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo-terminals"),
]


@pytest.fixture
def cable():
    """A board behind a pseudo-terminal."""
    board = PtyBoard()
    yield board
    board.close()


@pytest.mark.parametrize(
    ("port", "said"),
    [
        ("/dev/ttyNONE", "/dev/ttyNONE: no such port; no board is plugged in"),
        ("", "'': no such port"),
        ("/dev/null", "/dev/null: not a serial port"),
        ("/etc/passwd", "/etc/passwd: not a serial port"),
        ("/tmp", "/tmp: not a serial port"),
    ],
)
def test_a_wrong_port_is_reported(monkeypatch, port, said):
    monkeypatch.setattr("armsight.robot.boards.serial.list_ports", list)
    with pytest.raises(DeviceError) as raised:
        SerialLink.open(port)
    assert said in str(raised.value)


def test_ports_that_are_there_are_named(monkeypatch):
    monkeypatch.setattr("armsight.robot.boards.serial.list_ports", lambda: ["/dev/ttyACM1", "/dev/ttyUSB0"])
    with pytest.raises(DeviceError, match="no such port; there is /dev/ttyACM1, /dev/ttyUSB0"):
        SerialLink.open("/dev/ttyACM0")
    assert all(isinstance(port, str) for port in list_ports())


@pytest.mark.parametrize(
    ("code", "said"),
    [
        (errno.EACCES, "no permission; `sudo usermod -aG dialout .USER`, then log out and in again"),
        (errno.EBUSY, "in use by another program; close it first"),
        (errno.EIO, "cannot be opened"),
    ],
)
def test_a_port_that_is_rejected_is_reported(monkeypatch, code, said):
    def reject(*_, **__):
        raise serial.SerialException(code, os.strerror(code))

    monkeypatch.setattr(serial, "Serial", reject)
    with pytest.raises(DeviceError, match=f"/dev/ttyACM0: {said}"):
        SerialLink.open("/dev/ttyACM0")


def test_a_missing_pyserial_is_reported(monkeypatch):
    monkeypatch.setitem(sys.modules, "serial", None)
    with pytest.raises(InputError, match=r"pip install 'armsight.board.'"):
        SerialLink.open("/dev/ttyACM0")


def test_a_port_belongs_to_one_program():
    master, slave = pty.openpty()
    link = SerialLink.open(os.ttyname(slave))
    with pytest.raises(DeviceError, match="in use by another program"):
        SerialLink.open(os.ttyname(slave))
    os.write(master, b"abc")
    assert link.read(0.01) == b"abc"
    link.write(b"xyz")
    assert os.read(master, 8) == b"xyz"
    link.close()
    link.close()
    with pytest.raises(DeviceError, match="is closed"):
        link.read()
    with pytest.raises(DeviceError, match="is closed"):
        link.write(b"x")
    os.close(slave)
    os.close(master)


def until(board, holds, send=None):
    """Receive, and send each time, until something holds."""
    for _ in range(2000):
        if holds():
            return
        if send is not None:
            board.send(send)
        board.receive(0.005)
    raise AssertionError(board.status)


def test_a_board_behind_a_port_follows_as_one_in_lock_step(cable):
    with open_board(f"serial:{cable.port}") as board:
        assert board.welcome.board == "pil"
        board.enable()
        until(board, lambda: np.abs(board.joints.reference_rad - 0.1).max() < 1e-4, hold([0.1] * 6))
        assert board.status.acknowledged_count > 0
        until(board, lambda: np.abs(cable.plant.q - 0.1).max() < 0.02, hold([0.1] * 6))
        states = board.receive(0.02)
        assert len(states.t_s)
        assert (np.diff(states.t_s) > 0).all()


def test_a_cable_pulled_in_motion_is_reported_and_the_arm_stops_by_itself(cable):
    board = open_board(f"serial:{cable.port}")
    board.enable()
    far = hold([2.0] * 6, 1.0)
    until(board, lambda: board.joints.reference_rad_s.min() > 0.3, far)
    cable.pull()
    expected = (
        f"{cable.port} is gone: was the cable pulled.*without commands the board slows down and holds.* after 100 ms"
    )
    with pytest.raises(DeviceError, match=expected):
        keep_on(board, sends=far, wait_s=0.001)
    board.close()
    # The board knows nothing of cables: it hears nothing for 100 ms and then slows the arm down and holds it.
    moved = cable.plant.q.copy()
    cable.link.step(100)
    assert (cable.plant.q > moved).all()
    cable.link.step(500)
    outputs = cable.link.answer["outputs"]
    assert outputs["state"] == BoardState.HOLDING
    assert outputs["first_fault"] == Fault.HOST_SILENT
    held = cable.plant.q.copy()
    cable.link.step(300)
    assert np.abs(cable.plant.q - held).max() < 0.3 * 0.01  # 0.01 rad/s in the mean


def test_the_self_test_of_a_real_board_keeps_its_drives_off(cable):
    on = []
    cable.link._watch = lambda _: on.append(bool(cable.link.answer["outputs"]["drives_on"]))
    start = cable.plant.q.copy()
    result = selftest(f"serial:{cable.port}", progress=lambda _: None)
    assert {name: each.problems for name, each in result.scenarios.items()} == {
        "nominal": (),
        "crc_faults": (),
        "e_stop": (),
        "gain_change": (),
    }
    assert on
    assert not any(on)
    assert np.array_equal(cable.plant.q, start)
    assert result.record()["elf"] == {"flash_bytes": None, "ram_bytes": None, "hard_float": None}
    assert result.record()["scenarios"]["nominal"] == {"passed": True, "trace_sha256": None}


def test_a_bare_board_passes_at_rest():
    """Nothing stored and no potentiometer wired: what a board looks like on its first day."""
    cable = PtyBoard(fresh=True)
    for joint in range(6):
        cable.plant.break_pot(joint, PotFault.OPEN)
    try:
        result = selftest(f"serial:{cable.port}", progress=lambda _: None)
    finally:
        cable.close()
    assert [each.problems for each in result.scenarios.values()] == [()] * 4


def test_a_board_of_another_baud_rate_or_none_at_all_is_reported():
    master, slave = pty.openpty()
    os.write(master, b"\xfd\x03garbage")
    with pytest.raises(DeviceError, match="no board answers"):
        open_board(f"serial:{os.ttyname(slave)}")
    os.close(slave)
    os.close(master)
