"""What reads the sources or runs them under guard: warnings, analysers, sanitizers, a fuzzer; what the tests reach."""

import os
import re
import shutil
import subprocess
import sys

import pytest
from firmware_build import CORE, FIRMWARE, HERE, WIRE, compile_c, is_gcc, own_compiler

from armsight.firmware import build

SANITIZE = ("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
BOARD = [*CORE, *WIRE, "boards/loop.c", "boards/pil/pil.c"]
#: Programs that run the firmware on what they draw: sources, and how many rounds. A few million ticks each.
SHAKES = {"core": [HERE / "shake.c", *CORE], "wire": [HERE / "fuzz_wire.c", *BOARD]}
FUZZ_RUNS = 12000
#: Python tests of the core; what they reach is counted.
CORE_TESTS = (
    "pid", "setpoint", "pot", "states", "faults", "commands", "config", "encoder", "random", "motor", "bridge",
)  # fmt: skip
BRANCHES_PERCENT = 95.0


def require(program: str) -> str:
    path = shutil.which(program)
    if path is None:
        pytest.skip(f"needs {program}")
    return path


@pytest.fixture(scope="module")
def gcc():
    compiler = own_compiler()
    if not is_gcc(compiler):
        pytest.skip("needs gcc")
    return compiler


def run(command, **options) -> str:
    """Run a program that must end well without a word on stderr; returns what it printed."""
    ran = subprocess.run([*map(str, command)], capture_output=True, text=True, check=False, **options)
    assert (ran.returncode, ran.stderr) == (0, ""), ran.stdout + ran.stderr
    return ran.stdout


def shaken(what, tmp_path, mavlink):
    """Run a program of SHAKES with this computer's own compiler's sanitizers; it must end without a word."""
    compiler = own_compiler()
    if compiler is None:
        pytest.skip("needs gcc or cc: ziglang brings no address sanitizer")
    probe = tmp_path / "probe.c"
    probe.write_text("int main(void) { return 0; }\n")
    if compile_c(compiler, tmp_path / "probe", [probe], *SANITIZE).returncode:
        pytest.skip("this compiler has no sanitizers")
    program = tmp_path / "shake"
    done = compile_c(compiler, program, SHAKES[what], *SANITIZE, "-DSHAKE", mavlink=mavlink)
    assert done.returncode == 0, done.stderr
    assert run([program]) == ""


def test_the_sanitizers_find_nothing_in_the_core(tmp_path, mavlink):
    shaken("core", tmp_path, mavlink)


def test_a_fuzzer_finds_nothing_in_the_wire(tmp_path, mavlink):
    """libFuzzer, with the sanitizers, on raw bytes and on messages of right frame and wrong content; else drawn ones."""
    clang = shutil.which("clang")
    program = tmp_path / "fuzz"
    guard = ("-O1", "-g", "-fsanitize=fuzzer,address,undefined", "-fno-sanitize-recover=all")
    done = compile_c([clang], program, SHAKES["wire"], *guard, mavlink=mavlink) if clang else None
    if done is None or "cannot find" in done.stderr:
        shaken("wire", tmp_path, mavlink)
        return
    assert done.returncode == 0, done.stderr
    (tmp_path / "corpus").mkdir()
    expected = int(os.environ.get("ARMSIGHT_FUZZ_RUNS", str(FUZZ_RUNS)))
    given = [program, f"-runs={expected}", "-rss_limit_mb=0", "-max_len=2048", "-seed=1", "-close_fd_mask=0", "corpus"]
    ran = subprocess.run([*map(str, given)], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr[-3000:]
    runs = re.search(r"Done (\d+) runs", ran.stderr)
    assert runs
    assert int(runs[1]) >= expected


@pytest.mark.parametrize("source", [*BOARD, "boards/host/host.c"])
def test_gcc_analyses_it_without_a_word(source, tmp_path, gcc, mavlink):
    done = compile_c(gcc, tmp_path / "analysed.o", [source], "-O2", "-fanalyzer", "-c", mavlink=mavlink)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("board", [each for each in build.boards() if build.drivers(each) == each])
def test_gcc_analyses_what_is_for_the_processor_alone(board, tmp_path, mavlink):
    compiler = build.compilers().get("gcc")
    if compiler is None:
        pytest.skip("needs arm-none-eabi-gcc")
    own = [source for source in build.board_sources(board) if source.startswith(f"boards/{board}/")]
    flags = ["-isystem", "boards/cortex_m/include", f"-Iboards/{board}"]
    for source in [*own, "boards/cortex_m/memory.c"]:
        done = compile_c(
            compiler.arm, tmp_path / "analysed.o", [source], *flags, "-O2", "-fanalyzer", "-c", mavlink=mavlink
        )
        assert (done.returncode, done.stderr) == (0, ""), source


def test_cppcheck_finds_nothing():
    cppcheck = require("cppcheck")
    folders = [FIRMWARE / "core", FIRMWARE / "wire", FIRMWARE / "boards"]
    includes = [f"-I{FIRMWARE / folder}" for folder in ("core", "wire", "boards", "boards/pil", "boards/cortex_m")]
    checks = ["--enable=warning,style,performance,portability", "--std=c11", "--inline-suppr", "--quiet"]
    # Generated headers are not read; what a board is given as a pointer it may not change, others may.
    left_out = ["--suppress=missingIncludeSystem", "--suppress=constParameterPointer"]
    assert run([cppcheck, *checks, *left_out, "--error-exitcode=1", *includes, *folders]) == ""


def test_the_tests_reach_the_branches_of_the_core(tmp_path, gcc):
    """The core's own tests, run again on a library that counts."""
    gcov = require("gcov")
    counted = tmp_path / "counted"
    counted.mkdir()
    flags = f"--coverage -fprofile-update=single -dumpdir {counted}/ -O0"
    chosen = [str(HERE / "core" / f"test_firmware_{name}.py") for name in CORE_TESTS]
    again = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--basetemp", str(tmp_path / "again")]
    counting = {**os.environ, "ARMSIGHT_FIRMWARE_CFLAGS": flags}
    ran = subprocess.run(
        [*again, *chosen], cwd=FIRMWARE.parent, env=counting, capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stdout[-3000:]
    reported = subprocess.run(
        [gcov, "-b", "-n", *map(str, counted.glob("*.gcda"))], cwd=FIRMWARE, capture_output=True, text=True, check=True
    ).stdout
    taken = total = 0.0
    for name, percent, branches in re.findall(
        r"File '(?:\./)?(core/\w+\.c)'\n.*\n.*\nTaken at least once:([\d.]+)% of (\d+)", reported
    ):
        assert name in CORE
        taken, total = taken + float(percent) / 100 * int(branches), total + int(branches)
    assert total > 100, reported
    assert 100 * taken / total >= BRANCHES_PERCENT, reported
