"""Open a board by its name: ``emulated:NAME``, ``serial:PORT``, ``feetech:PORT[,FILE.json]`` or ``ar4:PORT[,mk2]``.

``,baud=N`` behind a port is its baud rate, where that is not its kind's; FILE.json is LeRobot's calibration of the servos.

Here is the registry of the arms that keep their own controller.
:func:`open_board` opens a board with our firmware, whose gains and configuration can be changed;
:func:`open_motion_board` any that moves an arm.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from armsight.errors import InputError
from armsight.robot.boards.ar4 import board as ar4_board
from armsight.robot.boards.ar4.board import Ar4Board
from armsight.robot.boards.ar4.models import ar4_model
from armsight.robot.boards.board import Board
from armsight.robot.boards.configuration import Configuration, lab_configuration
from armsight.robot.boards.contract import MotionBoard
from armsight.robot.boards.emulated import EmulatedLink
from armsight.robot.boards.emulators import EMULATORS, open_emulator
from armsight.robot.boards.feetech import board as feetech_board
from armsight.robot.boards.feetech import bus as feetech_bus
from armsight.robot.boards.feetech.board import FeetechBoard
from armsight.robot.boards.feetech.bus import ServoBus
from armsight.robot.boards.feetech.calibration import read_calibration
from armsight.robot.boards.link import Plant
from armsight.robot.boards.serial import BAUD, SerialLink, require_port
from armsight.robot.kinematics.arm import Arm

EMULATED, SERIAL = "emulated:", "serial:"
FEETECH, AR4 = "feetech:", "ar4:"
#: Kinds of boards with a controller of their own -> what follows.
OWN_CONTROLLERS: Mapping[str, str] = {FEETECH: "PORT", AR4: "PORT (ar4:PORT,mk2 for another model than mk3)"}


def is_real(name: str) -> bool:
    """Return whether a board of this name is at a port: time passes by itself."""
    return name.startswith((SERIAL, *OWN_CONTROLLERS))


def open_motion_board(name: str, plant: Plant | None = None) -> MotionBoard:
    """Open any board that moves an arm by its name; emulated, with the arm at its motors and the lab's configuration.

    InputError: there is no such kind of board, or something is behind its port that it does not take. DeviceError: it
    does not answer, or is of another kind.
    """
    if name.startswith(FEETECH):
        port, baud, file = serial_port(name, feetech_bus.BAUD)
        servos = read_calibration(Path(file)) if file else None
        return FeetechBoard.connect(ServoBus(SerialLink.open(port, baud), port, baud), servos)
    if name.startswith(AR4):
        port, baud, model = serial_port(name, ar4_board.BAUD)
        return Ar4Board.connect(SerialLink.open(port, baud), name=port, model=model or "mk3")
    return open_board(name, plant)


def check_board(name: str) -> None:
    """Reject the name of a board that cannot be right, without opening it.

    InputError: as :func:`open_motion_board`. DeviceError: there is no such port.
    """
    if not is_real(name):
        emulator_name(name)
        return
    port, baud, other = serial_port(name, BAUD)
    if name.startswith(FEETECH) and other:
        read_calibration(Path(other))
    if name.startswith(AR4) and other:
        ar4_model(other)
    require_port(port, baud)


def serial_port(name: str, baud: int) -> tuple[str, int, str]:
    """Return the port of a board's name, its baud rate, and what else stands behind it."""
    port, *given = name.partition(":")[2].split(",")
    rates = [each.removeprefix("baud=") for each in given if each.startswith("baud=")]
    others = [each for each in given if not each.startswith("baud=")]
    if len(rates) > 1 or len(others) > 1 or not all(each.isdecimal() and int(each) > 0 for each in rates):
        raise InputError(f"{name}: expected {name.partition(':')[0]}:PORT[,..][,baud=N], such as baud=115200")
    if others and name.startswith(SERIAL):
        raise InputError(
            f"{name}: {others[0]} belongs to {FEETECH}PORT or {AR4}PORT; this board has armsight's firmware"
        )
    return port, int(rates[0]) if rates else baud, others[0] if others else ""


def calibration_of(name: str) -> Path | None:
    """Return the calibration file behind the port of a servo bus's name; None where none is given."""
    file = serial_port(name, 0)[2]
    return Path(file) if file else None


def slowed(arm: Arm, name: str) -> Arm:
    """Return an arm whose motions are planned no faster than the board of this name follows them."""
    own = {FEETECH: feetech_board.ABILITIES, AR4: ar4_board.ABILITIES}
    return next((abilities.slowed(arm) for kind, abilities in own.items() if name.startswith(kind)), arm)


def open_board(name: str, plant: Plant | None = None, *, config: Configuration | None = None) -> Board:
    """Open a board with our firmware, an emulated one with a configuration (the lab's without) that waits for ``receive``.

    Raises InputError: there is no such kind of board, it has another controller, or an emulated one has no plant;
    DeviceError: it does not answer, or is of another version.
    """
    if name.startswith(SERIAL):
        port, baud, _ = serial_port(name, BAUD)
        return Board.connect(SerialLink.open(port, baud), name=port)
    emulator = emulator_name(name)
    if plant is None:
        raise InputError(f"{name} needs a plant: the arm at its motors, such as armsight.sim.joints.JointPlant()")
    return configured(EmulatedLink(open_emulator(emulator), plant), config)


def emulator_name(name: str) -> str:
    """Return the emulator of an emulated board's name; InputError names those there are."""
    if name.startswith(tuple(OWN_CONTROLLERS)):
        raise InputError(
            f"{name} keeps its own controller: it has no gains, no configuration and no self-test of armsight's firmware"
        )
    emulator = name.removeprefix(EMULATED) or next(iter(EMULATORS))
    if not name.startswith(EMULATED) or emulator not in EMULATORS:
        known = ", ".join(f"{EMULATED}{each}" for each in EMULATORS)
        own = " and ".join(f"{kind}{follows}" for kind, follows in OWN_CONTROLLERS.items())
        raise InputError(f"no board {name!r}; there are {known}, {SERIAL}PORT, such as serial:/dev/ttyACM0, {own}")
    return emulator


def configured(link: EmulatedLink, config: Configuration | None = None) -> Board:
    """Store a configuration (the lab's without) on a fresh emulated board, restart it, and return it.

    Raises InputError: a value of the configuration is outside its range.
    """
    board = Board.connect(link, name="the emulated board")
    try:
        board.store(lab_configuration() if config is None else config)
    except BaseException:
        board.close()
        raise
    link.restart()
    return Board.connect(link, name="the emulated board")
