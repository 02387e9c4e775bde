"""Build the firmware with the package: no binary is in the repository. All else is in pyproject.toml."""

import shutil
import sys
from pathlib import Path

from setuptools import Distribution, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_py import build_py

ROOT = Path(__file__).resolve().parent
sys.path.insert(0, str(ROOT / "src"))

from armsight.firmware import build  # noqa: E402 - it is found once src is in the path


class BuildFirmware(build_py):
    """Puts ``armsight/firmware/built`` beside the modules, and the C sources into a wheel, for boards built later."""

    def run(self) -> None:
        """Copy the modules, then build."""
        super().run()
        package = ROOT / "src" / "armsight" if self.editable_mode else Path(self.build_lib) / "armsight"
        build.build_package(package / "firmware" / "built", build.open_compiler())
        if not self.editable_mode:
            shutil.rmtree(package / "firmware" / "source", ignore_errors=True)
            shutil.copytree(ROOT / "firmware", package / "firmware" / "source")


class PlatformWheel(bdist_wheel):
    """A wheel for this machine and any Python 3: the host library is native code, but no extension module."""

    def get_tag(self) -> tuple[str, str, str]:
        """Return the tags of Python, its binary interface and the platform."""
        return "py3", "none", super().get_tag()[2]


class NativeDistribution(Distribution):
    """A distribution that is not the same on every platform."""

    def has_ext_modules(self) -> bool:
        """Tell setuptools so."""
        return True


setup(distclass=NativeDistribution, cmdclass={"build_py": BuildFirmware, "bdist_wheel": PlatformWheel})
