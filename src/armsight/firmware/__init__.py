"""The board's firmware as the package carries it: what was built at install, and where to find it.

In: the C sources in ``firmware/``. Out: ``built/``, which holds the emulated board's image, the host library and the
dialect's Python module; here are their paths.

- ``build``: makes them from the C sources, at install and by ``armsight board build``;
- ``elf``: reads images.
"""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from types import ModuleType

from armsight.errors import DeviceError

BUILT = Path(__file__).parent / "built"
#: The files of ``built/``, by what they are.
IMAGE = "pil.elf"
HOST_LIBRARIES = {"linux": "host.so", "win32": "host.dll", "darwin": "host.dylib"}
HOST_LIBRARY = HOST_LIBRARIES.get(sys.platform, "host.so")
DIALECT = "dialect.py"


def image() -> Path:
    """Return the emulated board's ELF image. Raises :class:`~armsight.errors.DeviceError` if it was not built."""
    return _built(IMAGE)


def host_library() -> Path:
    """Return the firmware as a shared library of this computer, ``image``'s twin."""
    return _built(HOST_LIBRARY)


def dialect() -> ModuleType:
    """Return the wire's dialect: the module pymavlink generated from ``firmware/wire/armsight.xml``."""
    _built(DIALECT)
    return importlib.import_module("armsight.firmware.built.dialect")


def _built(name: str) -> Path:
    path = BUILT / name
    if not path.is_file():
        raise DeviceError(f"{path}: the firmware is not built; run python -m armsight.firmware.build")
    return path
