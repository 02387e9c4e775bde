"""The build: no warning, no undefined behaviour, the same bits from every compiler, and a core that needs nothing."""

import ctypes
import re
import struct
import subprocess

import pytest
from firmware_arm import LabArm, declare
from firmware_build import CORE, CORTEX_M4F, FIRMWARE, HOST, SHARED, compile_c, compilers
from firmware_layout import c

HERE = FIRMWARE.parent / "tests" / "firmware"
SANITIZE = ("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
SHAKE = [*CORE, HERE / "shake.c"]
GLOBAL = 0x10  # a symbol other objects may define


def trace(library) -> bytes:
    """Everything the core gave over a run through motion, gains, faults, the stop and back."""
    arm = LabArm(library)
    arm.enable()
    arm.wander(400)
    for joint in arm.inputs.command.gains.joint:
        joint.__init__(7.0, 3.0, 0.08, 0.1, 0.004, 15.0)
    arm.command(c.COMMAND_GAINS)
    arm.wander(405, period=27)
    arm.tick(300)
    arm.command(c.COMMAND_CLEAR_FAULTS)
    arm.move(3.0, gravity=0.1)
    arm.tick(60)
    arm.spoil = lambda arm: arm.inputs.counts.__setitem__(2, 65535)
    arm.tick(20)
    arm.inputs.stop_pressed = 1
    arm.tick(5)
    return b"".join(arm.history)


def test_every_compiler_gives_the_same_bits(libraries):
    traces = {name: trace(library) for name, library in libraries.items()}
    assert len(set(traces.values())) == 1, sorted(traces)
    faults = {c.core_outputs.from_buffer_copy(trace(libraries[name])[-360:]).first_fault for name in libraries}
    assert len(faults) == 1


@pytest.mark.parametrize("optimise", ["-O0", "-Os", "-O3"])
def test_no_optimisation_changes_a_bit(library, tmp_path, optimise):
    compiler = next(iter(compilers().values()))
    target = tmp_path / "firmware_other.so"
    done = compile_c(compiler, target, HOST, *SHARED[1:], optimise)
    assert done.returncode == 0, done.stderr
    assert trace(declare(ctypes.CDLL(str(target)))) == trace(library)


def test_the_sanitizers_find_nothing(tmp_path):
    compiler = compilers().get("own")
    if compiler is None:
        pytest.skip("needs gcc or cc: ziglang brings no address sanitizer")
    probe = tmp_path / "probe.c"
    probe.write_text("int main(void) { return 0; }\n")
    if compile_c(compiler, tmp_path / "probe", [probe], *SANITIZE).returncode:
        pytest.skip("this compiler has no sanitizers")
    program = tmp_path / "shake"
    done = compile_c(compiler, program, SHAKE, *SANITIZE)
    assert done.returncode == 0, done.stderr
    ran = subprocess.run([program], capture_output=True, text=True, check=False)
    assert (ran.returncode, ran.stderr) == (0, "")


def test_gcc_analyses_the_core_without_a_word(tmp_path):
    compiler = compilers().get("own")
    if compiler is None or "Free Software Foundation" not in subprocess.check_output(
        [*compiler, "--version"], text=True
    ):
        pytest.skip("needs gcc for -fanalyzer")
    for source in CORE:
        done = compile_c(compiler, tmp_path / "analysed.o", [source], "-O2", "-fanalyzer", "-c")
        assert (done.returncode, done.stderr) == (0, ""), source.name


def undefined_symbols(elf: bytes) -> set[str]:
    """The names a 32-bit ELF object wants from elsewhere."""
    assert elf[:5] == b"\x7fELF\x01"
    sections_at = struct.unpack_from("<I", elf, 32)[0]
    size, count = struct.unpack_from("<HH", elf, 46)
    sections = [struct.unpack_from("<10I", elf, sections_at + k * size) for k in range(count)]
    names = set()
    for _, kind, _, _, offset, length, link, _, _, entry in sections:
        if kind == 2:  # the symbol table, whose names are in the section it links to
            for at in range(offset, offset + length, entry):
                name, _, _, info, _, section = struct.unpack_from("<IIIBBH", elf, at)
                if section == 0 and info >= GLOBAL:
                    text = sections[link][4] + name
                    names.add(elf[text : elf.index(b"\0", text)].decode())
    return names


@pytest.fixture(scope="module")
def cortex_objects(tmp_path_factory):
    """The core's objects for a Cortex-M4F, by file name."""
    compiler = compilers().get("zig")
    if compiler is None:
        pytest.skip("needs ziglang from PyPI to build for a Cortex-M4F")
    folder = tmp_path_factory.mktemp("cortex")
    for source in CORE:
        done = compile_c(compiler, folder / f"{source.stem}.o", [source], *CORTEX_M4F, "-O2", "-c")
        assert done.returncode == 0, done.stderr
    return {path.stem: path.read_bytes() for path in folder.glob("*.o")}


def test_for_a_cortex_m4f_the_core_needs_only_memory_copies(cortex_objects):
    """No division or double-precision helpers either: the processor does all the arithmetic by itself."""
    headers = "".join(source.with_suffix(".h").read_text(encoding="utf-8") for source in CORE)
    own = set(re.findall(r"\b(\w+)\(", headers))
    wanted = set().union(*map(undefined_symbols, cortex_objects.values()))
    # ARM's run-time ABI has names of its own for copying and clearing.
    foreign = {re.sub(r"^__aeabi_(mem[a-z]+?)[48]?$", r"\1", name) for name in wanted - own}
    assert foreign <= {"memcpy", "memset", "memclr"}
    assert len(cortex_objects) == len(CORE)


def test_no_public_header_or_source_names_a_double_or_a_library():
    for path in (FIRMWARE / "core").iterdir():
        text = path.read_text(encoding="utf-8")
        assert "double" not in text
        for line in text.splitlines():
            if line.startswith("#include <"):
                assert line[10:-1] in {"stdint.h", "stdbool.h", "stddef.h", "float.h"}, path.name
