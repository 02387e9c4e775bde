"""Open a board by its name: ``emulated:unicorn``, ``emulated:qemu``, ``emulated:host`` or ``serial:PORT``."""

from __future__ import annotations

from armsight.errors import InputError
from armsight.robot.boards.board import Board
from armsight.robot.boards.configuration import Configuration, lab_configuration
from armsight.robot.boards.emulated import EmulatedLink
from armsight.robot.boards.machine import Plant
from armsight.robot.boards.machines import MACHINES, open_machine
from armsight.robot.boards.serial import BAUD, SerialLink

EMULATED, SERIAL = "emulated:", "serial:"


def open_board(
    name: str, plant: Plant | None = None, *, config: Configuration | None = None, baud: int = BAUD
) -> Board:
    """Open a board; time with an emulated one passes by ``receive`` alone.

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
        return Board(SerialLink(port, baud), name=port)
    machine = emulated_machine(name)
    if plant is None:
        raise InputError(f"{name} needs a plant: the arm at its motors, such as armsight.sim.joints.JointPlant()")
    return configured(EmulatedLink(open_machine(machine), plant), config)


def emulated_machine(name: str) -> str:
    """Return the machine of an emulated board's name.

    Raises:
        InputError: there is no such board; the message names those there are.
    """
    machine = name.removeprefix(EMULATED)
    if not name.startswith(EMULATED) or machine not in MACHINES:
        known = ", ".join(f"{EMULATED}{machine}" for machine in MACHINES)
        raise InputError(f"no board {name!r}; there are {known} and {SERIAL}PORT, such as serial:/dev/ttyACM0")
    return machine


def configured(link: EmulatedLink, config: Configuration | None = None) -> Board:
    """Store a configuration (the lab's without) on a fresh emulated board, start it anew, and return it.

    Raises:
        InputError: a value of the configuration is outside its range.
    """
    board = Board(link, name="the emulated board")
    try:
        board.store(lab_configuration() if config is None else config)
    except BaseException:
        board.close()
        raise
    link.restart()
    return Board(link, name="the emulated board")
