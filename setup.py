"""Build the kernels and the firmware with the package: no binary is in the repository. All else is in pyproject.toml.

ARMSIGHT_TARGET=linux-aarch64 (kernels/build.py has the list) makes a wheel for another kind of machine. With
ARMSIGHT_NATIVE=later an editable installation leaves kernels and firmware to whoever asked for it: the Makefile.
"""

import dataclasses
import os
import shutil
import sys
import traceback
from pathlib import Path

from setuptools import Distribution, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_py import build_py

ROOT = Path(__file__).resolve().parent
sys.path.insert(0, str(ROOT / "src"))

from armsight.firmware import HOST_LIBRARIES  # noqa: E402 - it is found once src is in the path
from armsight.firmware import build as firmware  # noqa: E402
from armsight.kernels import build as kernels  # noqa: E402

#: The kind of machine that is built for; kernels/build.py names them.
TARGET = os.environ.get("ARMSIGHT_TARGET") or None
#: What pip and Python (sys.platform) call them; Linux needs the C library of 2014 or later.
PLATFORMS = {
    "linux-x86_64": ("manylinux_2_17_x86_64", "linux"),
    "linux-aarch64": ("manylinux_2_17_aarch64", "linux"),
    "macos-arm64": ("macosx_11_0_arm64", "darwin"),
    "windows-x86_64": ("win_amd64", "win32"),
}


class BuildNative(build_py):
    """Puts compiled kernels and ``armsight/firmware/built`` beside the modules, and the firmware's sources into a wheel."""

    def run(self) -> None:
        """Build; what fails ends the installation.

        setuptools makes a warning of any other error in an editable one (``editable_wheel._safely_run``).
        """
        try:
            self.build_all()
        except Exception:  # noqa: BLE001 - whatever it is, with all that is known of it
            sys.exit(traceback.format_exc())

    def build_all(self) -> None:
        """Copy the modules, then build."""
        if not self.editable_mode:  # what was built before may be for another target
            shutil.rmtree(self.build_lib, ignore_errors=True)
        super().run()
        if self.editable_mode and os.environ.get("ARMSIGHT_NATIVE") == "later":
            return
        package = ROOT / "src" / "armsight" if self.editable_mode else Path(self.build_lib) / "armsight"
        kernels.build(package / "kernels", TARGET)
        compiler, library = firmware.open_compiler(), HOST_LIBRARIES[PLATFORMS[TARGET or kernels.this_machine()][1]]
        if TARGET:
            host = (*compiler.host, "-target", kernels.TARGETS[TARGET].zig)
            compiler = dataclasses.replace(compiler, host=host)
        firmware.build_package(package / "firmware" / "built", compiler, library)
        if not self.editable_mode:
            shutil.rmtree(package / "firmware" / "source", ignore_errors=True)
            shutil.copytree(ROOT / "firmware", package / "firmware" / "source")


class PlatformWheel(bdist_wheel):
    """A wheel for one kind of machine and, by Python's stable binary interface, for every Python from 3.11 on."""

    def get_tag(self) -> tuple[str, str, str]:
        """Return the tags of Python, its binary interface and the platform: without a target one that no index takes.

        What is built for this very machine may not run on an older one of its kind.
        """
        platform, _ = PLATFORMS[TARGET or kernels.this_machine()]
        return "cp311", "abi3", platform if TARGET else platform.replace("manylinux_2_17", "linux")


class NativeDistribution(Distribution):
    """A distribution that is not the same on every platform."""

    def has_ext_modules(self) -> bool:
        """Tell setuptools so."""
        return True


setup(distclass=NativeDistribution, cmdclass={"build_py": BuildNative, "bdist_wheel": PlatformWheel})
