"""The same trace, bit for bit, from every compiler on every emulator; what the image needs, and its size."""

import json
import shutil

import pytest
from firmware_build import FIRMWARE, board_image, build_host, compilers
from firmware_layout import c

from armsight import firmware
from armsight.app.board.selftest import DRIVEN, run_scenario
from armsight.errors import DeviceError, InputError
from armsight.firmware import build
from armsight.firmware.elf import read_elf
from armsight.robot.boards.emulators import open_emulator

#: What a small Cortex-M4F has; the board's linker script gives the image no more.
FLASH_BYTES, RAM_BYTES = 64 * 1024, 32 * 1024
IMAGES = ("gcc", "zig")


class Recorder:
    """A emulator that keeps what goes in and out."""

    def __init__(self, emulator):
        self.emulator, self.frames = emulator, []

    def tick(self, request: bytes) -> bytes:
        answer = self.emulator.tick(request)
        self.frames.append((bytes(request), answer))
        return answer

    def close(self) -> None:
        self.emulator.close()


@pytest.fixture(scope="module")
def traces(library_files):
    """What the host build takes and gives in every scenario: those that drive the arm, each from power-up on."""
    found = {}
    for name, scenario in DRIVEN.items():
        emulator = Recorder(open_emulator("host", next(iter(library_files.values()))))
        assert run_scenario(scenario, emulator).problems == (), name
        found[name] = emulator.frames
    return found


@pytest.fixture(scope="module")
def images():
    """The image as each compiler makes it, by name."""
    return {name: board_image("pil", name) for name in IMAGES if name in build.compilers()}


def image_of(images, name):
    if name not in images:
        pytest.skip(f"needs {name} for a Cortex-M4F")
    return images[name]


def emulator_of(name, image):
    try:
        return open_emulator(name, image)
    except InputError as missing:
        pytest.skip(str(missing))


@pytest.mark.parametrize("emulator", ["unicorn", "qemu"])
@pytest.mark.parametrize("compiler", IMAGES)
def test_the_processor_gives_the_hosts_bits_in_every_scenario(traces, images, compiler, emulator):
    image = image_of(images, compiler)
    for name, frames in traces.items():
        running = emulator_of(emulator, image)
        for number, (request, answer) in enumerate(frames):
            assert running.tick(request) == answer, f"{name}, tick {number}"
        running.close()


def test_every_host_build_gives_the_same_bits(traces, mavlink, tmp_path):
    for name, compiler in compilers().items():
        library = build_host(compiler, tmp_path, mavlink)
        for scenario, frames in traces.items():
            running = open_emulator("host", library)
            assert [running.tick(request) for request, _ in frames] == [answer for _, answer in frames], (
                name,
                scenario,
            )


@pytest.mark.parametrize("compiler", IMAGES)
def test_the_image_computes_in_hardware_and_is_small(images, compiler):
    elf = read_elf(image_of(images, compiler))
    assert elf.hard_float
    assert not elf.undefined
    assert elf.flash_bytes < FLASH_BYTES
    assert elf.ram_bytes < RAM_BYTES


def test_an_image_that_computes_in_software_is_rejected(tmp_path):
    """Plain cortex_m4 has no floating-point unit: zig then calls helpers."""
    zig = build.compilers().get("zig")
    if zig is None:
        pytest.skip("needs ziglang")
    soft = tuple(
        {"-mcpu=cortex_m4+vfp4d16sp": "-mcpu=cortex_m4", "thumb-freestanding-eabihf": "thumb-freestanding-eabi"}.get(
            f, f
        )
        for f in zig.arm
    )
    source, target = tmp_path / "soft.c", tmp_path / "soft.o"
    source.write_text("float reset(float a, float b); float reset(float a, float b) { return a * b + a / b; }\n")
    build.compile_c(soft, target, [str(source)], "-O2", "-c")
    assert not read_elf(target).hard_float


def test_what_the_package_carries_is_built_from_these_sources():
    """A stale build would be tested instead of the sources: run python -m armsight.firmware.build."""
    about = json.loads((firmware.BUILT / "build.json").read_text())
    assert about["sources_sha256"] == build.fingerprint()
    assert about["compiler"] in IMAGES


def test_a_board_whose_memory_is_overwritten_stops_and_is_restarted_by_its_watchdog(images, traces):
    """A word of the core's guard is changed from outside: drives off at once, then a start that says why."""
    emulator = emulator_of("unicorn", next(iter(images.values())))
    elf = read_elf(next(iter(images.values())))
    frames = traces["nominal"]
    driven = next(k for k, (_, answer) in enumerate(frames) if outputs_of(answer).drives_on) + 50
    for request, answer in frames[:driven]:
        assert emulator.tick(request) == answer
    assert outputs_of(answer).drives_on
    guard = elf.symbols["loop"] + 4  # the core follows a pointer
    assert emulator.uc.mem_read(guard, 4) == b"\x5a\x96\xc3\xa5"
    emulator.uc.mem_write(guard, b"\0\0\0\0")
    after = [outputs_of(emulator.tick(request)) for request, _ in frames[driven : driven + 20]]
    assert (after[0].drives_on, list(after[0].duty), after[0].feed_watchdog) == (0, [0.0] * 6, 0)
    fault = [outputs.first_fault for outputs in after].index(c.FAULT_WATCHDOG)
    assert fault == 10
    assert after[-1].state == c.STATE_FAULTED
    emulator.close()


def outputs_of(answer: bytes):
    return c.pil_answer.from_buffer_copy(answer).outputs


def test_an_image_that_receives_nonsense_says_so_on_every_emulator(images, library_files):
    """No tick is run on it, and the next frame is served."""
    good = c.pil_request(magic=c.FRAME_REQUEST, version=c.FRAME_VERSION, supply_mv=12000)
    image = next(iter(images.values()))
    for name in ("host", "unicorn", "qemu"):
        emulator = emulator_of(name, next(iter(library_files.values())) if name == "host" else image)
        rejected = c.pil_answer.from_buffer_copy(emulator.tick(bytes(592)))
        assert (rejected.magic, rejected.version) == (c.FRAME_REJECTED, c.FRAME_VERSION), name
        assert c.pil_answer.from_buffer_copy(emulator.tick(bytes(good))).magic == c.FRAME_ANSWER, name
        emulator.close()


@pytest.mark.parametrize("compiler", IMAGES)
def test_a_floating_point_register_lost_in_the_interrupt_ends_the_emulation(compiler, tmp_path, monkeypatch):
    """The main loop's registers are compared after each tick: here the interrupt is made to spoil one."""
    found = build.compilers()
    if compiler not in found:
        pytest.skip(f"needs {compiler} for a Cortex-M4F")
    sources = tmp_path / "firmware"
    shutil.copytree(FIRMWARE, sources)
    startup, call = sources / "boards" / "pil" / "startup.c", "        pil_control();\n"
    text = startup.read_text(encoding="utf-8")
    assert call in text
    startup.write_text(text.replace(call, call + '        __asm__ volatile("vmov s20, r0");\n'), encoding="utf-8")
    monkeypatch.setattr(build, "source_folder", lambda: sources)
    emulator = emulator_of("qemu", build.build_board("pil", tmp_path / "pil.elf", found[compiler]))
    with pytest.raises(DeviceError, match="broke down"):
        emulator.tick(bytes(c.pil_request(magic=c.FRAME_REQUEST, version=c.FRAME_VERSION)))
    emulator.close()
