"""Readings of a unit that come over UDP or a serial port: their time on the board's clock, and bad input."""

import json
import os
import socket
import sys
import time
from dataclasses import replace

import numpy as np
import pytest

from armsight.app.run.devices import JUMP_S, LiveReadings
from armsight.errors import ArmsightError
from armsight.loop.references.file import COLUMNS, Entry
from armsight.loop.references.inertial import Inertial
from armsight.loop.running.beside import Fused
from armsight.loop.running.setup import HostClock

ENTRY = Entry(Inertial.of("imu"), "mpu-6050", None, None, None, False)


def line(t_s, value=1.0):
    return json.dumps({"t_s": t_s} | dict.fromkeys(COLUMNS[Inertial], value)).encode()


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


@pytest.fixture
def fed(board, monkeypatch):
    """Return what gives a sensor lines (arrival, s, line), after which its port is lost: times (N,), s, and the losses."""

    def feed(lines, values=False):
        now, left = [lines[0][0]], iter(lines)

        def read():
            now[0], data = next(left, (now[0], None))
            if data is None:
                raise OSError("unplugged")
            return data + b"\n"

        monkeypatch.setattr(LiveReadings, "_opened", lambda self, spec: read)
        readings = LiveReadings(replace(ENTRY, live="udp:1"), board, lambda: now[0])
        readings._thread.join()
        t_s, z = readings(np.inf)
        t_s += 5.0  # of the board's clock
        assert readings.losses.pop("it was lost: unplugged") == 1
        unit = Fused(ENTRY, readings, readings.losses)
        readings.close()
        return (t_s, z) if values else (t_s, unit.losses)

    return feed


@pytest.mark.parametrize(
    "wrong",
    [
        line(1.0).replace(b'"t_s": 1.0', b'"t_s": 1' + 400 * b"0"),
        line(1.0).replace(b'"t_s": 1.0', b'"t_s": 1e999'),
        line(1e300),
        line(-1e300),
        line(np.nan),
        line(1.0, np.inf),
        60_000 * b"[",
        b"\xff\x00",
        b'{"t_s": []}',
    ],
    ids=lambda wrong: str(wrong[:12]),
)
def test_a_line_that_is_no_reading_costs_itself_alone(fed, wrong):
    t_s, losses = fed([(105.0, b"0}"), (105.0, line(7.0)), (105.01, wrong), (105.02, wrong), (105.1, line(7.1))])
    np.testing.assert_allclose(t_s, [105.0, 105.1], atol=1e-4)
    assert losses == ("a line was no reading (2 times)",)  # the first line of a port may be cut


def test_one_wild_stamp_costs_itself_alone(fed):
    t_s, losses = fed([(105.0, line(7.0)), (105.1, line(100_000.2)), (105.2, line(7.2)), (105.3, line(7.3))])
    np.testing.assert_allclose(t_s, [105.0, 105.2, 105.3], atol=1e-4)
    assert losses == ("a stamp was more than 1 s off",)


@pytest.mark.parametrize("jump_s", [-7.0, -1.5, 1.5, 1e6])
def test_a_clock_that_jumps_is_converted_anew(fed, jump_s):
    """The arrivals are the oracle: nothing is late, so the time of a line is that of its arrival."""
    arrivals = 105.0 + 0.06 * np.arange(80)
    stamps = arrivals - 98.0 + np.where(arrivals > 107.0, jump_s, 0.0)
    t_s, losses = fed([(t, line(stamp)) for t, stamp in zip(arrivals, stamps, strict=True)])
    lost = (arrivals > 107.0) & (arrivals < 107.0 + JUMP_S + 0.06)
    np.testing.assert_allclose(t_s, arrivals[~lost], atol=1e-3)
    assert losses == (f"a stamp was more than 1 s off ({lost.sum()} times)", "its clock jumped")


@pytest.mark.parametrize("jump_s", [-0.4, -0.07, 0.07, 0.9])
def test_a_clock_that_jumps_by_less_than_a_second_is_said_and_costs_no_reading(fed, jump_s):
    arrivals = 105.0 + 0.002 * np.arange(1000)
    stamps = arrivals - 98.0 + np.where(arrivals > 106.0, jump_s, 0.0)
    t_s, losses = fed([(t, line(stamp)) for t, stamp in zip(arrivals, stamps, strict=True)])
    np.testing.assert_allclose(t_s, arrivals, atol=1e-3)
    assert losses == ("its clock jumped",)


def test_lines_that_are_late_do_not_move_the_clock(fed):
    late = [(109.0 + 1e-3 * n, line(9.005 + 0.1 * n)) for n in range(20)]  # after a stall of 2 s
    t_s, losses = fed([(105.0, line(7.0)), (106.9, line(8.9)), *late, (109.1, line(11.1))])
    np.testing.assert_allclose(t_s, [105.0, 106.9, *np.arange(108.105, 108.95, 0.1), 109.1], atol=2e-3)
    assert losses == ("a stamp was more than 1 s off (11 times)",)


def test_lines_may_have_the_units_of_recordings(fed):
    given = {"Gyro X (deg/s)": 180.0, "gyro_y_dps": 90.0, "gyro_z_rad_s": 1.0} | {
        f"accelerometer_{a}_g": 1 for a in "xyz"
    }
    arrivals = 105.0 + 0.01 * np.arange(5)
    sent = [(t, json.dumps({"t_ms": 1e3 * (t - 98.0), **given}).encode()) for t in arrivals]
    t_s, z = fed(sent, values=True)
    np.testing.assert_allclose(t_s, arrivals, atol=1e-3)
    np.testing.assert_allclose(z, np.tile([np.pi, np.pi / 2, 1.0, *[9.80665] * 3], (5, 1)))


def test_names_that_change_are_read_anew(fed):
    sent = [json.loads(line(7.0 + k)) for k in range(3)]
    sent[1]["t_ms"], _ = 1e3 * sent[1]["t_s"], sent[1].pop("t_s")
    del sent[2]["gyro_x_rad_s"]
    t_s, losses = fed([(105.0 + k, json.dumps(record).encode()) for k, record in enumerate(sent)])
    np.testing.assert_allclose(t_s, [105.0, 106.0], atol=1e-3)
    assert losses == ("a line was no reading",)


@pytest.mark.parametrize(
    ("live", "sent", "said"),
    [
        (None, b"", r"\[imu\]: live is ''; expected udp:\[HOST:\]PORT or serial:PORT"),
        ("usb:1", b"", "live is 'usb:1'; expected udp"),
        ("serial:/dev/none", b"", "serial:/dev/none cannot be opened"),
        ("udp:{}", b"", "nothing came from udp:.* within 0.3 s"),
        ("udp:{}", b'{"t_s": 1}', "expected lines of JSON with t_s, gyro_x_rad_s.* gyro_x_rad_s is missing"),
        ("udp:{}", line(1.0, np.inf) + b'\n{"t_s": 1}', "gyro_x_rad_s is missing"),
        ("udp:{}", b"1,2,3", "is no JSON object of numbers"),
        ("udp:{}", b"[1, 2, 3]", "is no JSON object of numbers"),
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
