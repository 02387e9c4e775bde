"""The emulators: what a trace is made of, and what is said where one cannot run (their bits: test_pil_emulators)."""

import contextlib
import hashlib
import shutil

import pytest
from firmware_build import board_image

from armsight.errors import DeviceError, InputError
from armsight.firmware import build
from armsight.robot.boards import emulators
from armsight.robot.boards.emulated import EmulatedLink
from armsight.robot.boards.emulators import HostEmulator, QemuEmulator, UnicornEmulator, open_emulator
from armsight.robot.boards.frames import ANSWER, REQUEST
from armsight.sim.joints import JointPlant

COMPILERS = ("zig", "gcc")


@pytest.fixture(scope="module")
def images():
    """The emulated board's image by compiler, of this checkout's sources."""
    return {name: board_image("pil", name) for name in COMPILERS if name in build.compilers()}


def test_one_bit_of_a_potentiometer_is_another_trace():
    """What the hashes are made of is all that the firmware does: the smallest difference shows."""

    class Nudged(JointPlant):
        def sense(self):
            sensed = super().sense()
            if self.nudge:
                sensed.counts.flags.writeable = True
                sensed.counts[5] ^= 4
            self.nudge = False
            return sensed

    traces = []
    for nudge in (False, True):
        trace, plant = hashlib.sha256(), Nudged()
        plant.nudge = nudge
        link = EmulatedLink(open_emulator("host"), plant, watch=trace.update)
        link.step(3)
        traces.append(trace.digest())
    assert traces[0] != traces[1]


def test_two_host_boards_do_not_share_anything():
    first, second = (EmulatedLink(open_emulator("host"), JointPlant(seed=seed)) for seed in (1, 2))
    first.step(5)
    second.step(1)
    assert first.answer["tick"] == 5
    assert second.answer["tick"] == 1


def test_a_missing_qemu_is_reported(monkeypatch, images):
    monkeypatch.setenv("PATH", "")
    with pytest.raises(InputError, match="qemu-system-arm is not installed: apt install qemu-system-arm, or use"):
        QemuEmulator.open(next(iter(images.values())))


def test_an_emulation_that_ends_is_reported_with_its_own_text(tmp_path):
    if not shutil.which(emulators.PROGRAM):
        pytest.skip(f"{emulators.PROGRAM} is not installed")
    broken = tmp_path / "none.elf"
    broken.write_bytes(b"\x7fELF nothing more")
    emulator = QemuEmulator.open(broken)
    with pytest.raises(DeviceError, match="the emulated board broke down: qemu-system-arm ended"):
        list(map(emulator.tick, [bytes(REQUEST.itemsize)] * 3))
    emulator.close()
    emulator.close()


def test_a_request_that_is_none_runs_no_tick(images):
    emulator = UnicornEmulator.open(images[next(iter(images))])
    answer = emulator.tick(bytes(REQUEST.itemsize))
    assert len(answer) == ANSWER.itemsize
    assert answer[:4] == b"ASNO"


def test_an_image_that_breaks_down_is_reported(images):
    emulator = UnicornEmulator.open(images[next(iter(images))])
    emulator._tick = 0x2000F001  # into the RAM, where zeros are instructions that run off its end
    with pytest.raises(DeviceError, match="the emulated board broke down"):
        emulator.tick(bytes(REQUEST.itemsize))


def test_code_cannot_write_to_the_flash_and_can_to_the_ram(images):
    for store, breaks in (("40f20001c0f20001", True), ("40f20001c2f20001", False)):  # movw, movt: r1 = 0; 0x20000000
        emulator = UnicornEmulator.open(images[next(iter(images))])
        emulator.uc.mem_write(0x3F000, bytes.fromhex(store + "08607047"))  # str r0, [r1]; bx lr
        emulator._tick = 0x3F001
        with pytest.raises(DeviceError, match="broke down") if breaks else contextlib.nullcontext():
            emulator.tick(bytes(REQUEST.itemsize))


@pytest.mark.parametrize("emulator", [UnicornEmulator, HostEmulator])
def test_a_file_that_is_no_firmware_is_named(emulator, tmp_path):
    wrong = tmp_path / "wrong.so"
    wrong.write_bytes(b"nothing")
    with pytest.raises(InputError, match=r"wrong\.so"):
        emulator.open(wrong)
