"""The build: no warning, no undefined behaviour, the same bits from every compiler, and a core that needs nothing."""

import ctypes
import re

import pytest
from firmware_arm import LabArm, declare
from firmware_build import CORE, FIRMWARE, HOST, SHARED, compile_c, compilers
from firmware_layout import c

from armsight.firmware import build
from armsight.firmware.elf import read_elf


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


@pytest.mark.parametrize("optimise", ["-O0", "-O3"])
def test_no_optimisation_changes_a_bit(library, tmp_path, mavlink, optimise):
    compiler = next(iter(compilers().values()))
    target = tmp_path / "firmware_other.so"
    done = compile_c(compiler, target, HOST, *SHARED[1:], optimise, mavlink=mavlink)
    assert done.returncode == 0, done.stderr
    assert trace(declare(ctypes.CDLL(str(target)))) == trace(library)


@pytest.mark.parametrize("name", ["zig", "gcc"])
def test_for_a_cortex_m4f_the_core_needs_only_memory_copies(name, tmp_path):
    """No division or double-precision helpers either: the processor does all the arithmetic by itself."""
    compiler = build.compilers().get(name)
    if compiler is None:
        pytest.skip(f"needs {name} for a Cortex-M4F")
    own = {word for header in (FIRMWARE / "core").glob("*.h") for word in re.findall(r"\b(\w+)\(", header.read_text())}
    expected = set()
    for source in CORE:
        build.compile_c(compiler.arm, tmp_path / "core.o", [source], "-O2", "-Icore", "-c")
        expected |= read_elf(tmp_path / "core.o").undefined
    # ARM's run-time ABI has names of its own for copying and clearing.
    foreign = {re.sub(r"^__aeabi_(mem[a-z]+?)[48]?$", r"\1", word) for word in expected - own}
    assert foreign <= {"memcpy", "memset", "memclr"}


def test_no_public_header_or_source_names_a_double_or_a_library():
    for path in (FIRMWARE / "core").iterdir():
        text = re.sub(r"/\*.*?\*/", "", path.read_text(encoding="utf-8"), flags=re.DOTALL)
        assert "double" not in text
        for line in text.splitlines():
            if line.startswith("#include <"):
                assert line[10:-1] in {"stdint.h", "stdbool.h", "stddef.h", "float.h"}, path.name
