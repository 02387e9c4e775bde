"""Emulated controllers at a pseudo-terminal, as any program opens them: our own boards, and the command line.

Time is real here, so nothing is asserted on it.
"""

import sys

import numpy as np
import pytest

from armsight.errors import DeviceError
from armsight.robot.board_registry import open_motion_board
from armsight.robot.boards.ar4 import board as ar4
from armsight.robot.boards.feetech import bus as feetech
from armsight.sim.boards.ar4 import Ar4Teensy
from armsight.sim.boards.device import serve
from armsight.sim.boards.so101 import So101Bus
from cli_runs import assert_rejected

pytestmark = [
    pytest.mark.real_time,
    pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo-terminals"),
]


@pytest.fixture
def so101():
    """An emulated SO-101 at a port; nothing pulls at it, so that it stays without torque."""
    with serve(So101Bus.made(load=lambda q: np.zeros(6)), feetech.BAUD) as port:
        yield port


@pytest.fixture
def teensy():
    """An emulated AR4 at a port."""
    with serve(Ar4Teensy(homing_s=0.2), ar4.BAUD) as port:
        yield port


def test_monitor_watches_a_servo_bus(armsight, so101):
    said = armsight(
        "board", "monitor", "--board", f"feetech:{so101.name}", "--seconds", 0.1, "--every", 0.05, "--json"
    ).done()
    assert "takes no duty: gravity is not compensated; keeps its own controller" in said.err
    assert len(said.lines) == 2
    for line in said.lines:
        assert len(line["q_rad"]) == 5
        assert line["state"] == "DISABLED"
        assert len(line["temperature_c"]) == 5
        assert line["supply_v"] == pytest.approx(12.1, abs=0.3)


def test_an_ar4_is_homed_watched_and_cleared(armsight, teensy):
    name = f"ar4:{teensy.name}"
    assert_rejected(armsight("board", "home", "--board", "emulated:host"), "emulated:host has no limit switches")
    assert "not homed: its readings" in armsight("board", "monitor", "--board", name, "--seconds", 0.05).err
    said = armsight("board", "home", "--board", name, "--yes", "--json").done()
    assert said.lines[0]["q_rad"] == pytest.approx([0.0] * 6, abs=1e-3)
    said = armsight("board", "monitor", "--board", name, "--seconds", 0.05, "--json").done()
    assert "not homed" not in said.err
    assert said.lines[-1]["supply_v"] is None
    assert said.lines[-1]["q_rad"] == pytest.approx([0.0] * 6, abs=1e-3)
    said = armsight("board", "clear", "--board", name, "--json")
    assert said.lines == [{"state": "DISABLED", "faults": []}]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("gains", "--board", "feetech:PORT"), "feetech:PORT keeps its own controller: it has no gains"),
        (("selftest", "--board", "ar4:PORT"), "ar4:PORT keeps its own controller"),
        (("monitor", "--board", "ar4:PORT,a,b"), "expected ar4:PORT"),
        (("monitor", "--board", "serial:PORT,baud=fast"), "such as baud=115200"),
        (("monitor", "--board", "serial:PORT,a.json"), "belongs to feetech:PORT or ar4:PORT"),
        (("monitor", "--board", "feetch:PORT"), "feetech:PORT and ar4:PORT"),
        (("monitor", "--board", "feetech:/dev/ttyNONE"), "/dev/ttyNONE: no such port"),
        (("monitor", "--board", "ar4:/dev/ttyNONE"), "/dev/ttyNONE: no such port"),
    ],
)
def test_what_such_a_board_cannot_do_is_one_line(armsight, arguments, words):
    assert_rejected(armsight("board", *arguments), words)


def test_a_wrong_baud_rate_is_one_line(so101, teensy):
    with pytest.raises(DeviceError, match=r"is 115200 the servos' baud rate|are they set to 115200 baud"):
        open_motion_board(f"feetech:{so101.name},baud=115200")
    with pytest.raises(DeviceError, match=r"nothing answers ST|bytes come, but no answer to ST"):
        open_motion_board(f"ar4:{teensy.name},baud=9600")


def test_a_pulled_cable_is_one_line(so101, teensy):
    for port, name in ((so101, "feetech"), (teensy, "ar4")):
        with open_motion_board(f"{name}:{port.name}") as board:
            board.receive(0.01)
            port.pull()
            with pytest.raises(DeviceError, match=r"is gone: was the cable pulled|answers"):
                board.receive(0.2)


@pytest.mark.parametrize(("arm", "kind"), [("so101", "feetech"), ("ar4", "ar4")])
def test_emulate_serves_an_arm_and_names_its_port(armsight, arm, kind):
    said = armsight("board", "emulate", arm, "--seconds", 0.01, "--json").done()
    assert said.lines[0]["board"].startswith(f"{kind}:/dev/")
