"""Compile the firmware for tests: the build's own flags, and whatever the test adds to them."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from armsight.firmware import build
from made_once import made_once

FIRMWARE = build.source_folder()
HERE = Path(__file__).parent
CORE = [source for source in build.host_sources() if source.startswith("core/")]
WIRE = [source for source in build.host_sources() if source.startswith("wire/")]
HOST = build.host_sources()
SHARED = ("-O2", "-shared", "-fPIC")
HOST_FILE = "firmware_host.so"


def own_compiler() -> list[str] | None:
    """This computer's own C compiler."""
    path = shutil.which("gcc") or shutil.which("cc")
    return [path] if path else None


#: More flags, for the computer's own compiler alone.
MORE_FLAGS = os.environ.get("ARMSIGHT_FIRMWARE_CFLAGS", "").split()


def compilers() -> dict[str, list[str]]:
    """The compilers for this computer, by name: its own, and the one that comes from PyPI."""
    own, found = own_compiler(), build.compilers()
    with_zig = "zig" in found and not MORE_FLAGS
    return ({"own": own} if own else {}) | ({"zig": [*found["zig"].host]} if with_zig else {})


def is_gcc(compiler: list[str] | None) -> bool:
    """Return whether a compiler is GNU's."""
    if compiler is None:
        return False
    return "Free Software Foundation" in subprocess.check_output([*compiler, "--version"], text=True)


def compile_c(compiler, target, sources, *flags, mavlink=None) -> subprocess.CompletedProcess[str]:
    """Compile ``sources`` into ``target`` with the firmware's flags; ARMSIGHT_FIRMWARE_CFLAGS adds to them.

    ``mavlink`` is the folder of the generated headers, for sources that need them.
    """
    seen = build.includes(mavlink or HERE, "boards/pil", "boards/cortex_m")
    command = [*compiler, "@cflags.txt", *flags, *seen, *MORE_FLAGS]
    command += ["-o", str(target), *map(str, sources)]
    return subprocess.run(command, cwd=FIRMWARE, capture_output=True, text=True, check=False)


def build_host(compiler, folder: Path, mavlink: Path) -> Path:
    """Build the shared library of the host board into ``folder``."""
    library = folder / HOST_FILE
    done = compile_c(compiler, library, HOST, *SHARED, mavlink=mavlink)
    assert done.returncode == 0, done.stderr
    return library


def board_image(board: str, compiler: str) -> Path:
    """Return the ELF that the package's own build makes of a board with a compiler, or skip where there is none."""
    found = build.compilers()
    if compiler not in found:
        pytest.skip(f"no {compiler} for ARM: pip install ziglang, or apt-get install gcc-arm-none-eabi gcc")
    file = f"{board}.elf"
    return (
        made_once(f"{board}-{compiler}", lambda folder: build.build_board(board, folder / file, found[compiler])) / file
    )
