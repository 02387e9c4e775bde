"""The Nucleo's image, built once per compiler by the package's own build."""

import atexit
import functools
import tempfile
from pathlib import Path

import pytest
from stm32f4_emulator import Emulator
from stm32f4_registers import BLACK_PILL, NUCLEO

from armsight.firmware.build import build_board, compilers

BOARDS = {"stm32f4": NUCLEO, "blackpill": BLACK_PILL}
COMPILERS = ("zig", "gcc")
_folder = tempfile.TemporaryDirectory(prefix="armsight-stm32f4-")
atexit.register(_folder.cleanup)


@functools.cache
def image(compiler: str, board: str = "stm32f4") -> Path:
    """Return the ELF this compiler makes, or skip where there is none."""
    found = compilers()
    if compiler not in found:
        pytest.skip(f"no {compiler} for ARM: pip install ziglang, or apt-get install gcc-arm-none-eabi gcc")
    return build_board(board, Path(_folder.name) / f"{board}-{compiler}.elf", found[compiler])


def fresh(compiler: str, board: str = "stm32f4") -> Emulator:
    """Return an emulated board with its image in it, before its reset."""
    return Emulator(image(compiler, board), BOARDS[board])
