"""Build the firmware's core with whatever C compiler this machine has."""

import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path

FIRMWARE = Path(__file__).resolve().parents[2] / "firmware"
CORE = sorted((FIRMWARE / "core").glob("*.c"))
HOST = [*CORE, FIRMWARE / "boards" / "host" / "host.c"]
SHARED = ("-O2", "-shared", "-fPIC")
CORTEX_M4F = ("-target", "thumb-freestanding-eabihf", "-mcpu=cortex_m4+vfp4d16sp", "-fno-unwind-tables")


def compilers() -> dict[str, list[str]]:
    """The compilers found, by name: the machine's own, and the one that comes from PyPI."""
    found = {}
    own = next((path for name in ("gcc", "cc") if (path := shutil.which(name))), None)
    if own:
        found["own"] = [own]
    if importlib.util.find_spec("ziglang"):
        found["zig"] = [sys.executable, "-m", "ziglang", "cc"]
    return found


def compile_c(compiler: list[str], target: Path, sources: list[Path], *flags: str) -> subprocess.CompletedProcess[str]:
    """Compile ``sources`` into ``target`` with the firmware's flags; ARMSIGHT_FIRMWARE_CFLAGS adds to them."""
    command = [*compiler, f"@{FIRMWARE / 'cflags.txt'}", *flags, f"-I{FIRMWARE / 'core'}"]
    command += os.environ.get("ARMSIGHT_FIRMWARE_CFLAGS", "").split()
    return subprocess.run([*command, "-o", target, *sources], capture_output=True, text=True, check=False)


def build_host(compiler: list[str], folder: Path) -> Path:
    """Build the shared library of the host board into ``folder``."""
    library = folder / "firmware_host.so"
    done = compile_c(compiler, library, HOST, *SHARED)
    assert done.returncode == 0, done.stderr
    return library
