"""The command ``armsight board``: what it prints, its JSON, and one line for every mistake."""

import os
import shutil
import stat
from dataclasses import replace

import pytest
from firmware_build import board_image

from armsight.app.board import selftest as board_selftest
from armsight.app.board.flash import FLASHED, PROGRAMMERS
from armsight.app.board.selftest import DRIVEN
from armsight.firmware import build, host_library
from armsight.robot.boards.board import Board
from armsight.robot.boards.codes import BoardState, Fault
from armsight.robot.boards.emulators import EMULATORS, HostEmulator
from cli_runs import assert_has, assert_rejected

HOST = ("--board", "emulated:host")


def test_the_self_test_prints_exactly_its_record(armsight):
    record = armsight("board", "selftest", *HOST, "--json").one
    assert list(record) == ["board", "scenarios", "ticks_per_s", "elf"]
    assert record["board"] == "emulated:host"
    assert list(record["scenarios"]) == list(DRIVEN)
    for each in record["scenarios"].values():
        assert set(each) == {"passed", "trace_sha256"}
        assert each["passed"] is True
        assert len(each["trace_sha256"]) == 64
    assert record["ticks_per_s"] > 0
    assert record["elf"]["hard_float"] is True
    assert 5000 < record["elf"]["flash_bytes"] < 64 * 1024
    assert 4000 < record["elf"]["ram_bytes"] < 64 * 1024


class Deaf:
    """A board that does not hear commands once it is driven: its arm goes where it likes."""

    def __init__(self, image):
        self.emulator, self.ticks = HostEmulator.open(host_library()), 0

    def tick(self, request):
        self.ticks += 1
        frame = bytearray(request)
        if self.ticks > 700:
            frame[:] = request[:76] + bytes(len(request) - 76)  # no byte of the wire
        return self.emulator.tick(bytes(frame))

    def close(self):
        self.emulator.close()


def test_a_board_that_fails_is_reported_with_what_is_wrong(armsight, monkeypatch):
    monkeypatch.setitem(EMULATORS, "host", (Deaf, lambda: None))
    monkeypatch.setattr(board_selftest, "DRIVEN", {"nominal": DRIVEN["nominal"], "e_stop": DRIVEN["e_stop"]})
    said = armsight("board", "selftest", *HOST, "--json")
    assert said.code == 1
    assert not any(each["passed"] for each in said.lines[0]["scenarios"].values())
    assert "nominal: while swinging: HOLDING (host silent: no motion command within the time set)" in said.err
    assert "e_stop: a stopped board took a motion command" in said.err
    assert "Traceback" not in said.err


def test_the_self_test_reads_well(armsight):
    said = armsight("board", "selftest", *HOST)
    assert [line.split()[:2] for line in said.out.splitlines()[:6]] == [[name, "passed"] for name in DRIVEN]
    assert_has(said.out, "times real time", "hardware floating point")


def test_monitor_prints_a_line_at_a_time(armsight):
    said = armsight("board", "monitor", *HOST, "--seconds", "1", "--every", "0.25", "--json").done()
    assert len(said.lines) == 4
    assert all(line["state"] == BoardState.DISABLED.name and line["faults"] == [] for line in said.lines)
    assert [line["readings"] for line in said.lines[1:]] == [250] * 3
    assert "board pil, firmware" in said.err
    text = armsight("board", "monitor", *HOST, "--seconds", "0.5")
    assert_has(text.out, "disabled", "deg")


def test_monitor_shows_faults(armsight, monkeypatch):
    class Broken(board_selftest.JointPlant):
        def __init__(self):
            super().__init__()
            self.supply_mv = 4000

    monkeypatch.setattr("armsight.sim.joints.JointPlant", Broken)
    said = armsight("board", "monitor", *HOST, "--seconds", "0.1", "--every", "0.1", "--json")
    assert said.lines[0]["faults"] == [{"fault": Fault.SUPPLY_LOW.name, "joint": None}]
    assert "SUPPLY_LOW" in armsight("board", "monitor", *HOST, "--seconds", "0.1", "--every", "0.1").out


def test_monitor_names_joints_that_are_not_homed_whenever_they_change(armsight, monkeypatch):
    bits, receive = iter([0, 0b10, 0b10, 0b1010, 0]), Board.receive

    def losing(board, wait_s=0.0):
        states = receive(board, wait_s)
        if wait_s == 0.1:
            board.status = replace(board.status, not_homed=next(bits))
        return states

    monkeypatch.setattr(Board, "receive", losing)
    said = armsight("board", "monitor", *HOST, "--seconds", "0.5", "--every", "0.1", "--json").done()
    assert [line["not_homed"] for line in said.lines] == [[], [2], [2], [2, 4], []]
    notes = [line.split(": its")[0] for line in said.err.splitlines() if "homed" in line]
    assert notes == ["note: joint 2: not homed", "note: joint 2, 4: not homed", "note: all joints are homed"]


def test_gains_are_printed_and_changed(armsight):
    said = armsight("board", "gains", *HOST, "--json")
    before = said.lines[0]
    own = before["kp_per_rad"]
    assert len(own) == 6
    assert all(each > 0 for each in own)
    changes = ("--set", "3:kp_per_rad=7.5", "--set", "all:ki_per_rad_s=0")
    after = armsight("board", "gains", *HOST, *changes, "--store", "--json").lines[0]
    assert after["kp_per_rad"] == [*own[:2], 7.5, *own[3:]]
    assert after["ki_per_rad_s"] == [0.0] * 6
    assert after["kd_s_per_rad"] == before["kd_s_per_rad"]
    table = armsight("board", "gains", *HOST, *changes).out.splitlines()
    assert table[0].split()[:2] == ["joint", "kp_per_rad"]
    assert table[3].split()[:3] == ["3", "7.5", "0"]


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (
            ("gains", *HOST, "--set", "3:kp_per_rad=700"),
            ["joint 3: kp_per_rad is 700; 0 to 100", "nothing was changed"],
        ),
        (("gains", *HOST, "--set", "3:kp_per_rad=nan"), ["joint 3: kp_per_rad is nan"]),
        (("gains", *HOST, "--set", "7:kp_per_rad=1"), ["JOINT:NAME=VALUE is needed", "derivative_filter_s"]),
        (("gains", *HOST, "--set", "1:kp=1"), ["JOINT:NAME=VALUE is needed"]),
        (("gains", *HOST, "--set", "1:kp_per_rad=much"), ["'much' is no number"]),
        (("gains", "--board", "emulated:avr"), ["no board 'emulated:avr'", "emulated:unicorn", "serial:PORT"]),
        (("monitor", "--board", "serial:/dev/ttyNONE"), ["/dev/ttyNONE: no such port"]),
        (("monitor", "--board", "serial:/dev/null"), ["/dev/null: not a serial port"]),
        (("selftest", "--board", "usb"), ["no board 'usb'"]),
        (("build", "--board", "mega"), ["no board 'mega'", "stm32f4"]),
        (("build", "--board", "stm32f4", "--compiler", "tcc"), ["no firmware compiler 'tcc'"]),
        (("build", "--board", "stm32f4", "-o", "/proc/none"), ["/proc/none: cannot be made"]),
        (("build", "--board", "stm32f4", "-o", "-"), ["-: give the name of a file or folder"]),
    ],
)
def test_a_mistake_is_one_line(armsight, arguments, parts):
    assert_rejected(armsight("board", *arguments), *parts)


def test_an_image_is_built_with_its_pieces(armsight, tmp_path):
    said = armsight("board", "build", "--board", "stm32f4", "-o", tmp_path / "out", "--json")
    (found,) = said.lines
    assert found["board"] == "stm32f4"
    assert found["hard_float"] is True
    assert found["compiler"] in build.compilers()
    assert sum(os.path.getsize(piece) for _, piece in found["pieces"]) == found["flash_bytes"]
    assert found["pieces"][0][0] == 0x08000000


@pytest.fixture(scope="module")
def stm32f4():
    """The real board's image."""
    return board_image("stm32f4", build.open_compiler().name)


@pytest.fixture
def programmers(tmp_path, monkeypatch, stm32f4):
    """Installs programmers that write down their arguments; the image they are given is built already."""
    monkeypatch.setattr(build, "build_board", lambda board, target, compiler: shutil.copyfile(stm32f4, target))
    folder = tmp_path / "bin"
    folder.mkdir()

    def install(*names, code=0):
        for name in names:
            program = folder / name
            program.write_text(
                f'#!/bin/sh\necho "{name} $@" >> {tmp_path}/arguments\necho "no probe found" >&2\nexit {code}\n'
            )
            program.chmod(program.stat().st_mode | stat.S_IXUSR)
        monkeypatch.setenv("PATH", str(folder) + os.pathsep + os.environ["PATH"])
        monkeypatch.setattr("armsight.app.board.flash.which", lambda name: name if name in names else None)

    return install


def test_without_a_programmer_the_message_says_what_to_install_and_where_the_image_lies(
    armsight, programmers, tmp_path
):
    programmers()
    said = armsight("board", "flash", "-o", tmp_path / "out")
    piece = tmp_path / "out" / "stm32f4-08000000.bin"
    assert_rejected(said, "none of st-flash, openocd, dfu-util is installed", "apt install", f"{piece} (to 0x08000000)")
    assert piece.stat().st_size > 0
    said = armsight("board", "flash", "-o", tmp_path / "again", "--programmer", "openocd")
    assert_rejected(said, "openocd is not installed")


@pytest.mark.parametrize("name", PROGRAMMERS)
def test_a_programmer_writes_every_piece_to_its_address(armsight, programmers, tmp_path, name):
    programmers(name)
    found = armsight("board", "flash", "-o", tmp_path / "out", "--json").one
    assert found["programmer"] == name
    arguments = (tmp_path / "arguments").read_text()
    if name == "openocd":
        assert f"program {{{found['image']}}} verify reset exit" in arguments
    else:
        for address, piece in found["pieces"]:
            assert piece in arguments
            assert f"{address:#x}" in arguments


def test_a_programmer_that_fails_is_reported_by_its_own_message(armsight, programmers, tmp_path):
    programmers("st-flash", code=1)
    said = armsight("board", "flash", "-o", tmp_path / "out")
    assert_rejected(
        said, "st-flash could not write the board (no probe found)", "is it plugged in", "stm32f4-08000000.bin"
    )


def test_what_was_built_reads_well(armsight, programmers, tmp_path):
    said = armsight("board", "build", "--board", "stm32f4", "-o", tmp_path)
    assert_has(said.out, "hardware floating point", f"{tmp_path}/stm32f4-08000000.bin: to 0x08000000")


def test_only_a_real_board_is_flashed(armsight, programmers, tmp_path):
    assert FLASHED == ("stm32f4", "blackpill")
    assert_rejected(armsight("board", "flash", "--board", "pil", "-o", tmp_path), "pil is no board to plug in")
