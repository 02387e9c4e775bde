"""Images: how they are built and read, what is said when that fails, and how much memory they need."""

import sys

import firmware_stack as stack
import numpy as np
import pytest
from firmware_build import FIRMWARE, board_image
from firmware_layout import c
from firmware_pil import Host

from armsight import firmware
from armsight.errors import DeviceError, InputError
from armsight.firmware import build
from armsight.firmware.elf import read_elf
from armsight.robot.boards.emulators import open_emulator

#: What every board's linker script keeps free for the stack.
STACK_BYTES = 8 * 1024
PAINT = 0xA5


@pytest.fixture
def compiler():
    try:
        return build.open_compiler()
    except InputError as missing:
        pytest.skip(str(missing))


@pytest.mark.parametrize("board", [each for each in build.boards() if build.drivers(each) == each])
def test_the_stack_of_every_board_has_a_bound_that_fits(board):
    if "gcc" not in build.compilers():
        pytest.skip("needs arm-none-eabi-gcc")
    use = stack.stack_use(board)
    assert use.total_bytes < STACK_BYTES
    assert use.main.functions[0] == stack.MAIN
    assert stack.TICK in use.tick.functions
    above = (use.tick, *use.nested)
    assert use.total_bytes == use.main.stack_bytes + sum(chain.stack_bytes + stack.INTERRUPT_BYTES for chain in above)
    if board == "stm32f4":  # the millisecond's count comes on top of the tick
        assert [chain.functions[0] for chain in use.nested] == ["systick_interrupt"]


@pytest.mark.parametrize("name", ["gcc", "zig"])
def test_a_run_takes_no_more_stack_than_the_bound(tmp_path, name):
    """The stack is painted before a run through every kind of message; what is no longer paint was used."""
    found = build.compilers()
    if name not in found or "gcc" not in found:
        pytest.skip(f"needs {name}, and gcc for the bound")
    image = board_image("pil", name)
    try:
        emulator = open_emulator("unicorn", image)
    except InputError as missing:
        pytest.skip(str(missing))
    top = read_elf(image).symbols["stack_top"]
    emulator.uc.mem_write(top - STACK_BYTES, bytes([PAINT]) * STACK_BYTES)
    for request in requests():
        emulator.tick(request)
    left = bytes(emulator.uc.mem_read(top - STACK_BYTES, STACK_BYTES))
    used = len(left.lstrip(bytes([PAINT])))
    use = stack.stack_use("pil")
    bound = max(use.main.stack_bytes, use.tick.stack_bytes)
    # 64: what calls them. zig's frames are its own: it inlines what gcc calls, and is held to half of the stack.
    assert 1000 < used <= (bound + 64 if name == "gcc" else 3 * 1024)
    emulator.close()


def requests():
    """Frames that carry one message of each kind a host sends, greeted, and some noise."""
    host = Host(None)
    said = [host.hello(), host.move(), host.command(c.COMMAND_DISABLE), host.pack("gains", host.next(), 0, [0.1] * 48)]
    said += [
        host.pack("config_part", 0, 100, 200, [0] * 200),
        host.store(b""),
        host.pack("timesync", 0, 1),
        b"\xfd\xff" * 90,
    ]
    said += [host.pack("config_read", 0), host.stop()]
    for tick, data in enumerate([*said, *[b""] * 30]):
        request = c.pil_request(magic=c.FRAME_REQUEST, version=c.FRAME_VERSION, tick=tick, length=len(data))
        request.bytes[: len(data)] = data
        yield bytes(request)


def test_an_unknown_board_is_named_with_those_there_are(tmp_path, compiler):
    with pytest.raises(InputError, match=r"no board 'arduino'; there are blackpill, pil, stm32f4"):
        build.build_board("arduino", tmp_path / "x.elf", compiler)


def test_an_unknown_compiler_is_named_with_those_there_are(monkeypatch):
    with pytest.raises(
        InputError, match=r"no firmware compiler 'tcc' \(.*\); zig needs pip install 'armsight\[build\]'"
    ):
        build.open_compiler("tcc")
    monkeypatch.setenv(build.COMPILER_VARIABLE, "tcc")
    with pytest.raises(InputError, match="no firmware compiler 'tcc'"):
        build.open_compiler()


def test_no_compiler_at_all_is_reported(monkeypatch):
    monkeypatch.setattr(build, "compilers", dict)
    monkeypatch.delenv(build.COMPILER_VARIABLE, raising=False)
    with pytest.raises(InputError, match=r"no firmware compiler \(none found\)"):
        build.open_compiler()


def test_what_a_compiler_says_is_passed_on(tmp_path, compiler):
    wrong = tmp_path / "wrong.c"
    wrong.write_text("int forgotten(void) { return 1 }\n")
    with pytest.raises(InputError, match=r"(?s)could not build wrong\.o:.*wrong\.c:1"):
        build.compile_c(compiler.host, tmp_path / "wrong.o", [str(wrong)], "-c")


def test_a_failed_build_leaves_the_last_one(tmp_path, compiler, monkeypatch):
    built = tmp_path / "built"
    built.mkdir()
    (built / firmware.IMAGE).write_bytes(b"the last one")

    def fail(*_given):
        raise InputError("no")

    monkeypatch.setattr(build, "build_host", fail)
    with pytest.raises(InputError):
        build.build_package(built, compiler)
    assert [path.name for path in tmp_path.iterdir()] == ["built"]
    assert (built / firmware.IMAGE).read_bytes() == b"the last one"


def test_firmware_that_is_not_built_is_reported_with_what_to_do(tmp_path, monkeypatch):
    monkeypatch.setattr(firmware, "BUILT", tmp_path)
    for find in (firmware.image, firmware.host_library, firmware.dialect):
        with pytest.raises(DeviceError, match=r"not built; run python -m armsight\.firmware\.build"):
            find()


@pytest.mark.parametrize("content", [b"", b"\x7fELF", b"MZ" * 50, b"\x7fELF\x02\x01" + bytes(60)])
def test_a_file_that_is_no_image_is_rejected(tmp_path, content):
    path = tmp_path / "x.elf"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"x\.elf: not a"):
        read_elf(path)


def test_an_image_cut_short_is_rejected(tmp_path):
    whole = firmware.image().read_bytes()
    for length in (60, len(whole) // 2):
        path = tmp_path / "x.elf"
        path.write_bytes(whole[:length])
        with pytest.raises(InputError, match=r"x\.elf: not a whole ELF image"):
            read_elf(path)


def test_a_board_is_built_from_the_command_line(tmp_path, capsys):
    if not build.compilers():
        pytest.skip("needs ziglang or arm-none-eabi-gcc")
    assert build.main(["--board", "pil", "-o", str(tmp_path)]) == 0
    assert str(tmp_path / "pil.elf") in capsys.readouterr().out
    assert read_elf(tmp_path / "pil.elf").hard_float
    assert build.main(["--board", "nano"]) == 2
    assert capsys.readouterr().err.startswith("error: no board 'nano'")


def test_without_pymavlink_it_is_said_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pymavlink.generator", None)
    with pytest.raises(InputError, match=r"needs pymavlink: pip install 'armsight\[build\]'"):
        build.generate("Python3", tmp_path / "dialect.py")


def test_a_dialect_that_is_wrong_is_rejected(tmp_path, monkeypatch):
    pytest.importorskip("pymavlink", reason="needs pymavlink")
    source = tmp_path / "source" / "wire"
    source.mkdir(parents=True)
    good = (FIRMWARE / "wire" / "armsight.xml").read_text(encoding="utf-8")
    (source / "armsight.xml").write_text(good.replace('type="uint32_t"', 'type="uint31_t"', 1), encoding="utf-8")
    monkeypatch.setattr(build, "source_folder", lambda: tmp_path / "source")
    with pytest.raises(InputError, match=r"armsight\.xml"):
        build.generate("Python3", tmp_path / "dialect.py")


@pytest.mark.parametrize("name", ["gcc", "zig"])
def test_memory_is_copied_and_filled_at_any_address_and_length(tmp_path, name):
    found = build.compilers()
    if name not in found:
        pytest.skip(f"needs {name} for a Cortex-M4F")
    image = board_image("pil", name)
    try:
        emulator = open_emulator("unicorn", image)
    except InputError as missing:
        pytest.skip(str(missing))
    arm = pytest.importorskip("unicorn.arm_const")
    symbols, uc = read_elf(image).symbols, emulator.uc
    memory, space, back = 0x20008000, 256, 0x3FFE0
    rng = np.random.default_rng(3)

    def call(function, *arguments):
        for register, value in zip((arm.UC_ARM_REG_R0, arm.UC_ARM_REG_R1, arm.UC_ARM_REG_R2), arguments, strict=False):
            uc.reg_write(register, value)
        uc.reg_write(arm.UC_ARM_REG_SP, symbols["stack_top"])
        uc.reg_write(arm.UC_ARM_REG_LR, back | 1)
        uc.emu_start(symbols[function] | 1, back)

    for length in [*range(40), 63, 64, 65, 100]:
        for to, source in ((0, 128), (4, 132), (1, 128), (0, 131), (3, 129)):
            before = bytearray(rng.bytes(space))
            uc.mem_write(memory, bytes(before))
            call("memcpy" if "memcpy" in symbols else "__aeabi_memcpy", memory + to, memory + source, length)
            before[to : to + length] = before[source : source + length]
            if "memset" in symbols:
                call("memset", memory + to + 104, 0x1A5, length)
            else:  # an image keeps those it calls
                call("__aeabi_memclr", memory + to + 104, length)
            before[to + 104 : to + 104 + length] = (b"\xa5" if "memset" in symbols else b"\0") * length
            assert bytes(uc.mem_read(memory, space)) == bytes(before), (length, to, source)
    emulator.close()
