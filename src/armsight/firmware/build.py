"""Build the firmware: boards' images, the host library, and the dialect's C headers and Python module.

    python -m armsight.firmware.build                         what the package carries, into its built/
    python -m armsight.firmware.build --board stm32f4 -o out  one board's image

Compilers are ``zig`` (``ziglang`` from PyPI) and ``gcc`` (``arm-none-eabi-gcc``, and this computer's own for the host
library).
Runs at install, beside nothing but pymavlink and a compiler: of armsight it imports what needs no other package.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import importlib.util
import io
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from armsight.errors import InputError
from armsight.firmware import BUILT, DIALECT, HOST_LIBRARY, IMAGE
from armsight.firmware.elf import read_elf

#: Names a compiler for the build at install, where no option can be given.
COMPILER_VARIABLE = "ARMSIGHT_FIRMWARE_COMPILER"
_ARM_GCC = "arm-none-eabi-gcc"
#: Boards that are a header and a linker script for the drivers in another one's folder.
_DRIVERS = {"blackpill": "stm32f4"}
_OPTIMISE = ("-O2", "-fomit-frame-pointer", "-ffunction-sections", "-fdata-sections", "-g0")
_HOST = ("-O2", "-shared", "-fPIC", "-g0")
_ZIG_M4F = ("-target", "thumb-freestanding-eabihf", "-mcpu=cortex_m4+vfp4d16sp", "-fno-unwind-tables")
_GCC_M4F = ("-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16")


@dataclass(frozen=True)
class Compiler:
    """A C compiler, "zig" or "gcc": the command that compiles for a Cortex-M4F, and for this computer's kind."""

    name: str
    arm: tuple[str, ...]
    host: tuple[str, ...]


def compilers() -> dict[str, Compiler]:
    """Return the compilers this computer has, by name, the preferred one first."""
    found = {}
    if importlib.util.find_spec("ziglang"):
        zig = (sys.executable, "-m", "ziglang", "cc")
        found["zig"] = Compiler("zig", (*zig, *_ZIG_M4F), (*zig, "-mcpu=baseline"))
    arm, host = shutil.which(_ARM_GCC), shutil.which("gcc") or shutil.which("cc")
    if arm and host:
        found["gcc"] = Compiler("gcc", (arm, *_GCC_M4F), (host,))
    return found


def open_compiler(name: str | None = None) -> Compiler:
    """Return the compiler of this name, or the preferred one; :class:`~armsight.errors.InputError` if there is none."""
    found = compilers()
    name = name or os.environ.get(COMPILER_VARIABLE) or next(iter(found), "")
    if name in found:
        return found[name]
    missing = f"no firmware compiler {name!r}" if name else "no firmware compiler"
    have = f"found: {', '.join(found)}" if found else "none found"
    raise InputError(f"{missing} ({have}); zig needs pip install 'armsight[build]', gcc needs {_ARM_GCC} and gcc")


def source_folder() -> Path:
    """Return the folder of the C sources: the package's own, or the checkout's."""
    here = Path(__file__).resolve()
    for folder in (here.parent / "source", here.parents[3] / "firmware"):
        if (folder / "cflags.txt").is_file():
            return folder
    raise InputError(f"{here.parent}: the firmware's sources are not there; install armsight again")


def boards() -> list[str]:
    """Return the names of the boards an image can be built for."""
    return sorted(
        path.parent.name for path in (source_folder() / "boards").glob("*/*.ld") if path.parent.name != "cortex_m"
    )


def generate(language: str, target: Path) -> None:
    """Generate the dialect from its XML: ``C`` headers into a folder, or the ``Python3`` module into a file."""
    try:
        from pymavlink.generator import mavgen, mavparse
    except ImportError:
        raise InputError("building firmware needs pymavlink: pip install 'armsight[build]'") from None
    options = mavgen.Opts(str(target), wire_protocol="2.0", language=language, validate=True)
    said = io.StringIO()
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            done = mavgen.mavgen(options, [str(source_folder() / "wire" / "armsight.xml")])
    except (mavparse.MAVParseError, SystemExit) as error:  # it exits where the schema is not met
        raise InputError(f"firmware/wire/armsight.xml: {error}") from error
    if not done:
        raise InputError(f"firmware/wire/armsight.xml: pymavlink rejected it: {said.getvalue().strip()}")


@contextlib.contextmanager
def headers() -> Iterator[Path]:
    """Generate the dialect's C headers into a folder that lasts as long as the context."""
    with tempfile.TemporaryDirectory() as folder:
        generate("C", Path(folder))
        yield Path(folder)


def compile_c(command: Sequence[str], target: Path, sources: Sequence[str], *flags: str) -> None:
    """Compile sources (relative to the source folder) into ``target`` with the flags every build shares."""
    target.parent.mkdir(parents=True, exist_ok=True)
    given = [*command, "@cflags.txt", *flags, "-o", str(target.resolve()), *sources]
    ran = subprocess.run(given, cwd=source_folder(), capture_output=True, text=True, check=False)
    if ran.returncode:
        raise InputError(f"{command[0]} could not build {target.name}:\n{ran.stderr.strip()}")


def includes(mavlink: Path, *folders: str) -> list[str]:
    """Return the flags that let sources find our headers and the generated ones."""
    return ["-isystem", str(mavlink), *(f"-I{folder}" for folder in ("core", "wire", "boards", *folders))]


def board_sources(board: str) -> list[str]:
    """Return the C files of a board's image."""
    return _found("core", "wire", "boards", "boards/cortex_m", f"boards/{drivers(board)}")


def drivers(board: str) -> str:
    """Return in whose folder the drivers of a board are."""
    return _DRIVERS.get(board, board)


def host_sources() -> list[str]:
    """Return the C files of the host library: the emulated board's, without the start-up of its ARM emulation."""
    return [*_found("core", "wire", "boards", "boards/host"), "boards/pil/pil.c"]


def _found(*folders: str) -> list[str]:
    root = source_folder()
    return [path.relative_to(root).as_posix() for folder in folders for path in sorted((root / folder).glob("*.c"))]


def board_flags(board: str, mavlink: Path) -> list[str]:
    """Return the flags every source of a board's image is compiled with."""
    own = [f"boards/{folder}" for folder in dict.fromkeys((board, drivers(board)))]
    return [*_OPTIMISE, "-isystem", "boards/cortex_m/include", *includes(mavlink, *own, "boards/cortex_m")]


def build_board(board: str, target: Path, compiler: Compiler) -> Path:
    """Build a board's image and return it; :class:`~armsight.errors.InputError` if it does not compute in hardware."""
    if board not in boards():
        raise InputError(f"no board {board!r}; there are {', '.join(boards())}")
    root = source_folder()
    script = next((root / "boards" / board).glob("*.ld")).relative_to(root).as_posix()
    link = ("-nostdlib", "-Wl,--gc-sections", "-Wl,-e,reset", f"-T{script}")
    with headers() as mavlink:
        compile_c(compiler.arm, target, board_sources(board), *board_flags(board, mavlink), *link)
    if not read_elf(target).hard_float:
        raise InputError(f"{target}: computes floats in software; {compiler.arm[0]} ignored its flags")
    return target


def build_host(target: Path, compiler: Compiler) -> Path:
    """Build the host library and return it."""
    with headers() as mavlink:
        made = mavlink / target.name  # beside a DLL lie an import library and debug data: they go with the headers
        compile_c(compiler.host, made, host_sources(), *_HOST, *includes(mavlink, "boards/pil"))
        target.parent.mkdir(parents=True, exist_ok=True)
        return Path(shutil.copy(made, target))


def fingerprint() -> str:
    """Return the SHA-256 of the sources of what the package carries, by which an outdated build is recognised."""
    root = source_folder()
    digest = hashlib.sha256((root / "cflags.txt").read_bytes())
    for folder in ("core", "wire", "boards", "boards/host", "boards/pil", "boards/cortex_m", "boards/cortex_m/include"):
        for path in sorted(path for path in (root / folder).iterdir() if path.is_file()):
            digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def build_package(folder: Path, compiler: Compiler, host_library: str = HOST_LIBRARY) -> None:
    """Build what the package carries into ``folder``, its ``built``; it is replaced whole, or left as it was."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent) as made_in:
        made = Path(made_in) / "built"
        build_board("pil", made / IMAGE, compiler)
        build_host(made / host_library, compiler)
        generate("Python3", made / DIALECT)
        (made / "__init__.py").write_text('"""Made by armsight.firmware.build."""\n', encoding="utf-8")
        about = {"compiler": compiler.name, "sources_sha256": fingerprint()}
        (made / "build.json").write_text(json.dumps(about, indent=2) + "\n", encoding="utf-8")
        shutil.rmtree(folder, ignore_errors=True)
        made.rename(folder)


def main(arguments: Sequence[str] | None = None) -> int:
    """Build as the command line says."""
    parser = argparse.ArgumentParser(prog="python -m armsight.firmware.build", description="Build the firmware.")
    parser.add_argument("--compiler", choices=["zig", "gcc"], help="zig if installed, otherwise gcc")
    parser.add_argument("--board", help="build this board's image only")
    parser.add_argument("-o", "--output", type=Path, default=Path(), help="folder of that image")
    given = parser.parse_args(arguments)
    try:
        compiler = open_compiler(given.compiler)
        if given.board:
            target = build_board(given.board, given.output / f"{given.board}.elf", compiler)
        else:
            target = BUILT
            build_package(target, compiler)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"{target} ({compiler.name})")
    return 0


if __name__ == "__main__":
    sys.exit(main())
