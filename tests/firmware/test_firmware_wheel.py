"""The wheel, built from a clean copy: it carries image, host library, dialect and sources, for one platform."""

import shutil
import subprocess
import sys
import zipfile
from importlib import metadata, util

import pytest
from firmware_build import FIRMWARE

from armsight import firmware

ROOT = FIRMWARE.parent
PARTS = ("pyproject.toml", "setup.py", "MANIFEST.in", "README.md", "LICENSE")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel, built without a network: by the build requirements this environment has."""
    if int(metadata.version("setuptools").split(".")[0]) < 77 or not util.find_spec("ziglang"):
        pytest.skip("needs setuptools 77 or newer and ziglang, as pyproject.toml names them")
    pytest.importorskip("pymavlink", reason="needs pymavlink")
    copy, out = tmp_path_factory.mktemp("sources"), tmp_path_factory.mktemp("wheel")
    for part in PARTS:
        shutil.copy(ROOT / part, copy)
    left_out = shutil.ignore_patterns("built", "__pycache__", "*.egg-info")
    shutil.copytree(ROOT / "src", copy / "src", ignore=left_out)
    shutil.copytree(FIRMWARE, copy / "firmware")
    kept = ROOT / "build" / "kernels"  # compiled kernels: minutes otherwise
    if kept.is_dir():
        shutil.copytree(kept, copy / "build" / "kernels")
    command = [
        sys.executable,
        "-m",
        "pip",
        "wheel",
        "--no-build-isolation",
        "--no-deps",
        "-q",
        "-w",
        str(out),
        str(copy),
    ]
    ran = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    (made,) = out.glob("*.whl")
    return made


def test_the_wheel_carries_what_runs_a_board(wheel):
    with zipfile.ZipFile(wheel) as file:
        names = {name.removeprefix("armsight/firmware/") for name in file.namelist()}
    carried = {f"built/{name}" for name in (firmware.IMAGE, firmware.HOST_LIBRARY, firmware.DIALECT, "build.json")}
    assert carried <= names
    assert {"source/cflags.txt", "source/wire/armsight.xml", "source/core/pid.c"} <= names


def test_the_wheel_is_for_this_platform_and_any_python_3(wheel):
    python, binary, platform = wheel.stem.split("-")[-3:]
    assert (python, binary) == ("cp311", "abi3")
    assert platform != "any"


def test_what_is_unpacked_from_the_wheel_runs_and_builds(wheel, tmp_path):
    """Without a package beside it, in another folder: the host library ticks, and the image is built again."""
    with zipfile.ZipFile(wheel) as file:
        file.extractall(tmp_path)
    script = (
        "import ctypes, pathlib; from armsight import firmware; from armsight.firmware import build, elf;"
        "assert pathlib.Path(firmware.__file__).is_relative_to(pathlib.Path.cwd());"
        "ctypes.CDLL(str(firmware.host_library())).pil_start();"
        "assert elf.read_elf(firmware.image()).hard_float;"
        "assert firmware.dialect().ARMSIGHT_DIALECT_VERSION == 5;"
        "made = build.build_board('pil', pathlib.Path('again.elf'), build.open_compiler('zig'));"
        "assert made.read_bytes() == firmware.image().read_bytes()"
    )
    alone = {"PYTHONPATH": str(tmp_path), "HOME": str(tmp_path), "PATH": ""}
    ran = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, env=alone, capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stderr
