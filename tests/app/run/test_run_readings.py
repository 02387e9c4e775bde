"""Readings of a unit that come over UDP or a serial port: their time on the board's clock, and bad input."""

import json
import os
import socket
import sys
import time
from dataclasses import replace

import numpy as np
import pytest

from armsight.app.run.devices import LiveReadings
from armsight.errors import ArmsightError
from armsight.loop.references.file import INERTIAL_COLUMNS, Entry
from armsight.loop.references.inertial import Inertial
from armsight.loop.running.setup import HostClock

ENTRY = Entry(Inertial.of("imu"), "inertial", "mpu-6050", None, None, None, False)


def line(t_s, value=1.0):
    return json.dumps({"t_s": t_s} | dict.fromkeys(INERTIAL_COLUMNS, value)).encode()


def free_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        return taken.getsockname()[1]


def collected(readings, count):
    """Return times and values once there are so many."""
    parts = []
    for _ in range(500):
        parts.append(readings(np.inf))
        if sum(len(t) for t, _ in parts) >= count:
            break
        time.sleep(0.01)
    return np.concatenate([t for t, _ in parts]), np.concatenate([z for _, z in parts])


@pytest.fixture
def board():
    """The board's clock: 5 s behind the computer's, which stands still."""
    clock = HostClock(lambda: 105.0)
    clock.heard(100.0)
    return clock


def test_udp_lines_are_on_the_boards_clock_and_rise(board, monkeypatch):
    """The first line, of 7 s, comes at 105 s of the computer's clock, which is 100 of the board's; the others come late."""
    port, now = free_port(), [105.0]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        wait, send = time.sleep, lambda data: sender.sendto(data, ("127.0.0.1", port))
        monkeypatch.setattr("armsight.app.run.devices.time.sleep", lambda s: (wait(s), send(line(7.0))))
        readings = LiveReadings(replace(ENTRY, live=f"udp:{port}"), board, lambda: now[0])
        now[0] = 105.02
        for data in (line(7.001) + b"\n" + line(7.002), line(7.001), b"[1]", line(np.nan), line(7.003, 2.0)):
            send(data)
        t_s, z = collected(readings, 4)
        readings.close()
    np.testing.assert_allclose(t_s, [100.0, 100.001, 100.002, 100.003], atol=1e-5)  # clocks drift by 2e-4 at most
    assert z[-1].tolist() == [2.0] * 6


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo-terminals")
def test_lines_of_a_serial_port_may_be_cut(board, monkeypatch):
    controller, port = os.openpty()
    import tty

    tty.setraw(port)
    wait, cut = time.sleep, line(1.0)[20:] + b"\n" + line(2.0) + b"\n" + line(2.001)[:30]
    monkeypatch.setattr("armsight.app.run.devices.time.sleep", lambda s: (wait(s), os.write(controller, cut)))
    readings = LiveReadings(replace(ENTRY, live=f"serial:{os.ttyname(port)}"), board)
    monkeypatch.undo()
    os.write(controller, line(2.001)[30:] + b"\n")
    t_s, _ = collected(readings, 2)
    readings.close()
    assert len(t_s) == 2
    os.close(controller)
    os.close(port)


@pytest.mark.parametrize(
    ("live", "sent", "said"),
    [
        (None, b"", r"\[imu\]: live is ''; expected udp:\[HOST:\]PORT or serial:PORT"),
        ("usb:1", b"", "live is 'usb:1'; expected udp"),
        ("serial:/dev/none", b"", "serial:/dev/none cannot be opened"),
        ("udp:{}", b"", "nothing came from udp:.* within 0.3 s"),
        ("udp:{}", b'{"t_s": 1}', "expected lines of JSON with t_s, gyro_x_rad_s.* gyro_x_rad_s is missing"),
        ("udp:{}", b"1,2,3", "is no JSON object of numbers"),
    ],
)
def test_bad_input_is_one_line(board, monkeypatch, live, sent, said):
    monkeypatch.setattr("armsight.app.run.devices.FIRST_S", 0.3)
    port = free_port()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        wait = time.sleep

        def sleep(s):
            wait(s)
            if sent:
                sender.sendto(sent, ("127.0.0.1", port))

        monkeypatch.setattr("armsight.app.run.devices.time.sleep", sleep)
        with pytest.raises(ArmsightError, match=said):
            LiveReadings(replace(ENTRY, live=live and live.format(port)), board)
