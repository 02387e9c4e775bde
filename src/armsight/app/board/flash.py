"""Build a board's firmware and put it on the board with a programmer the user has.

In: a board's name. Out: the ELF image, its pieces of flash memory as .bin files, which program wrote them. Only what the
image fills is written: what a board stores between its pieces (its configuration) stays.
"""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from shutil import which

from armsight import firmware
from armsight.errors import DeviceError, InputError
from armsight.files import check_folder, made_folder, read_text, replacing
from armsight.firmware import build
from armsight.firmware.elf import read_elf

FLASHED = ("stm32f4", "blackpill")  # boards a programmer can write; the emulated one needs none


@dataclass(frozen=True)
class Built:
    """A board's firmware."""

    board: str  #: its name
    compiler: str  #: what built it
    image: Path  #: the ELF file
    pieces: tuple[tuple[int, Path], ...]  #: what goes where in flash memory: (address, .bin file)
    flash_bytes: int  #: its size
    ram_bytes: int  #: of its variables, without the stack
    hard_float: bool  #: whether it is built for the processor's floating-point unit


def package_build() -> Built:
    """Return armsight's own build, as emulated boards run it."""
    elf = read_elf(firmware.image())
    about = json.loads(read_text(firmware.BUILT / "build.json"))
    return Built("pil", about["compiler"], firmware.image(), (), elf.flash_bytes, elf.ram_bytes, elf.hard_float)


def build_firmware(board: str, folder: Path, compiler: str | None = None) -> Built:
    """Build a board's image and its .bin files into a folder, which is made where it is missing."""
    chosen = build.open_compiler(compiler)
    if board not in build.boards():
        raise InputError(f"no board {board!r}; there are {', '.join(build.boards())}")
    check_folder(folder, problem="cannot be made a folder of firmware")
    image = build.build_board(board, made_folder(folder) / f"{board}.elf", chosen)
    elf = read_elf(image)
    pieces = []
    for segment in elf.segments:
        if segment.data:
            piece = folder / f"{board}-{segment.load_address:08x}.bin"
            with replacing(piece, "wb") as file:
                file.write(segment.data)
            pieces.append((segment.load_address, piece))
    return Built(board, chosen.name, image, tuple(pieces), elf.flash_bytes, elf.ram_bytes, elf.hard_float)


def _st_flash(built: Built) -> list[list[str]]:
    writes = [["st-flash", "write", str(piece), f"{address:#x}"] for address, piece in built.pieces]
    return [*writes, ["st-flash", "reset"]]


def _openocd(built: Built) -> list[list[str]]:
    done = f"program {{{built.image}}} verify reset exit"
    return [["openocd", "-f", "interface/stlink.cfg", "-f", "target/stm32f4x.cfg", "-c", done]]


def _dfu_util(built: Built) -> list[list[str]]:
    last = len(built.pieces) - 1
    return [
        ["dfu-util", "-a", "0", "-s", f"{address:#x}{':leave' if k == last else ''}", "-D", str(piece)]
        for k, (address, piece) in enumerate(built.pieces)
    ]


_Calls = Callable[[Built], list[list[str]]]
#: Programmer -> what to call; the first one installed is taken.
PROGRAMMERS: Mapping[str, _Calls] = {"st-flash": _st_flash, "openocd": _openocd, "dfu-util": _dfu_util}


def flash(built: Built, programmer: str | None = None) -> str:
    """Write a board's firmware to it and return which programmer did; a DeviceError says where the image is."""
    if built.board not in FLASHED:
        raise InputError(f"{built.board} is no board to plug in; there is {', '.join(FLASHED)}")
    name = programmer or next((each for each in PROGRAMMERS if which(each)), None)
    lies = ", ".join(f"{piece} (to {address:#010x})" for address, piece in built.pieces)
    if name is None or which(name) is None:
        missing = f"{name} is not installed" if name else f"none of {', '.join(PROGRAMMERS)} is installed"
        raise DeviceError(f"{missing}: apt install stlink-tools, openocd or dfu-util; the firmware lies in {lies}")
    for command in PROGRAMMERS[name](built):
        ran = subprocess.run(command, capture_output=True, text=True, check=False)
        if ran.returncode:
            said = (ran.stderr.strip() or ran.stdout.strip() or "nothing said").splitlines()[-1]
            raise DeviceError(
                f"{name} could not write the board ({said}): is it plugged in? The firmware lies in {lies}"
            )
    return name
