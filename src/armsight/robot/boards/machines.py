"""The machines that run the emulated board's firmware, by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from armsight import firmware
from armsight.errors import InputError
from armsight.robot.boards.host import HostMachine
from armsight.robot.boards.machine import Machine
from armsight.robot.boards.qemu import QemuMachine
from armsight.robot.boards.unicorn import UnicornMachine

#: Name -> what makes the machine of a file, and the file the package carries for it.
MACHINES: Mapping[str, tuple[Callable[[Path], Machine], Callable[[], Path]]] = {
    "unicorn": (UnicornMachine, firmware.image),
    "qemu": (QemuMachine, firmware.image),
    "host": (HostMachine, firmware.host_library),
}


def open_machine(name: str, image: Path | None = None) -> Machine:
    """Start a machine on a fresh board: nothing is stored on it.

    Args:
        name: one of :data:`MACHINES`.
        image: another image (for host: library) than the package's.

    Raises:
        InputError: there is no such machine, or what it needs is not installed.
        DeviceError: the firmware was not built.
    """
    if name not in MACHINES:
        raise InputError(f"no machine {name!r}; there are {', '.join(MACHINES)}")
    make, built = MACHINES[name]
    return make(image or built())
