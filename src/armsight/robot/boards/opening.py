"""Open a board by its name: ``emulated:unicorn``, ``emulated:qemu``, ``emulated:host`` or ``serial:PORT``.

Here is the registry of the emulators that run the firmware.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from armsight import firmware
from armsight.errors import InputError
from armsight.robot.boards.board import Board
from armsight.robot.boards.configuration import Configuration, lab_configuration
from armsight.robot.boards.emulated import EmulatedLink
from armsight.robot.boards.host import HostEmulator
from armsight.robot.boards.link import Emulator, Plant
from armsight.robot.boards.qemu import QemuEmulator
from armsight.robot.boards.serial import BAUD, SerialLink
from armsight.robot.boards.unicorn import UnicornEmulator

#: Name -> what opens the emulator of a file, and the file the package carries for it.
EMULATORS: Mapping[str, tuple[Callable[[Path], Emulator], Callable[[], Path]]] = {
    "unicorn": (UnicornEmulator.open, firmware.image),
    "qemu": (QemuEmulator.open, firmware.image),
    "host": (HostEmulator.open, firmware.host_library),
}


def open_emulator(name: str, image: Path | None = None) -> Emulator:
    """Start an emulator with a fresh board: nothing is stored on it.

    Args:
        name: one of :data:`EMULATORS`.
        image: another image (for host: library) than the package's.

    Raises:
        InputError: there is no such emulator, or what it needs is not installed.
        DeviceError: the firmware was not built.
    """
    if name not in EMULATORS:
        raise InputError(f"no emulator {name!r}; there are {', '.join(EMULATORS)}")
    make, built = EMULATORS[name]
    return make(image or built())


EMULATED, SERIAL = "emulated:", "serial:"


def open_board(
    name: str, plant: Plant | None = None, *, config: Configuration | None = None, baud: int = BAUD
) -> Board:
    """Open a board; the time of an emulated one passes in ``receive`` only.

    Args:
        name: see the module.
        plant: the arm at an emulated board's motors.
        config: of an emulated board; the lab's without. A serial board keeps its own.
        baud: of a serial port.

    Raises:
        InputError: there is no such kind of board, or an emulated one has no plant.
        DeviceError: it does not answer, or is of another version.
    """
    if name.startswith(SERIAL):
        port = name.removeprefix(SERIAL)
        return Board.connect(SerialLink.open(port, baud), name=port)
    emulator = emulator_name(name)
    if plant is None:
        raise InputError(f"{name} needs a plant: the arm at its motors, such as armsight.sim.joints.JointPlant()")
    return configured(EmulatedLink(open_emulator(emulator), plant), config)


def emulator_name(name: str) -> str:
    """Return the emulator of an emulated board's name.

    Raises:
        InputError: there is no such board; the message names those there are.
    """
    emulator = name.removeprefix(EMULATED)
    if not name.startswith(EMULATED) or emulator not in EMULATORS:
        known = ", ".join(f"{EMULATED}{each}" for each in EMULATORS)
        raise InputError(f"no board {name!r}; there are {known} and {SERIAL}PORT, such as serial:/dev/ttyACM0")
    return emulator


def configured(link: EmulatedLink, config: Configuration | None = None) -> Board:
    """Store a configuration (the lab's without) on a fresh emulated board, restart it, and return it.

    Raises:
        InputError: a value of the configuration is outside its range.
    """
    board = Board.connect(link, name="the emulated board")
    try:
        board.store(lab_configuration() if config is None else config)
    except BaseException:
        board.close()
        raise
    link.restart()
    return Board.connect(link, name="the emulated board")
