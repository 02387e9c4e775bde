"""The devices that the command line names, opened as a loop takes them: real ones, or the workcell instead of them."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import click
import numpy as np

from armsight.app.options import SIM
from armsight.app.run.readings import LiveReadings
from armsight.errors import InputError
from armsight.loop.references.file import Entry
from armsight.loop.references.inertial import INERTIAL_CLASSES
from armsight.loop.running.beside import Fused
from armsight.loop.running.setup import HostClock, LiveShots, Setup
from armsight.robot.board_registry import EMULATED, check_board, emulator_name, open_motion_board, slowed
from armsight.robot.boards.board import Board
from armsight.robot.boards.contract import MotionBoard
from armsight.robot.kinematics.arm import Arm
from armsight.sim.references.inertial import InertialErrors, InertialUnit
from armsight.vision.markers.targets import Composite
from armsight.vision.sources import open_source

if TYPE_CHECKING:
    from armsight.sim.workcell.workcell import Workcell

#: The workcell's arm and cameras where ``sim:`` names none: those of ``armsight demo``.
_SIM_ARM, _SIM_CAMERAS = "worn", "1280x720@60"
_UNIT_HZ = 1000.0  # of an inertial unit in the workcell whose table does not say
_RATE_HZ = 60.0  # of cameras whose times show none; half: the loop expects shots late, double: early


def setup_of(workcell: Workcell) -> Setup:
    """Return the setup of a workcell: the interface that real devices have as well."""
    timing = workcell.timing
    sync_s = float(np.hypot(timing.sync_s / np.sqrt(3), timing.skew_s))
    return Setup(
        workcell.model,
        workcell.board,
        workcell.poll,
        workcell.target,
        workcell.gravity_duty,
        timing.rate_hz,
        sync_s,
        sync_led_bit_s=sync_led_bit_s(workcell.board, "the workcell") if workcell.source.shows_led else None,
    )


def simulated_unit(workcell: Workcell, entry: Entry, seed: int) -> Fused:
    """Return an inertial unit of a class on the workcell's tool, with errors beyond what its calibration knows."""
    c, rng = INERTIAL_CLASSES[entry.sensor_class], np.random.default_rng([seed, 77])
    drawn = (c.gyro_noise, c.noise), (c.gyro_bias, c.bias), c.scale, c.g_sensitivity, rng
    errors = InertialErrors.typical(*drawn, good=entry.sensor_class == "icm-42688", rate_hz=entry.rate_hz or _UNIT_HZ)
    return Fused(entry, workcell.carry(InertialUnit(errors, rng)))


def sync_led_bit_s(board: MotionBoard, name: str) -> float:
    """Return how long each bit of the code lasts that a board's sync LED blinks, s; ``name``: what the user calls it.

    Raises:
        InputError: it has no LED.
    """
    if not isinstance(board, Board):
        raise InputError(f"--sync-led: {name} keeps its own controller, which drives no LED on its clock")
    config = board.configuration()
    if not config["sync_led_pin"]:
        raise InputError(
            f"--sync-led: {name} drives no LED: choose its pin with armsight board config set arm.sync_led_pin=PB13,"
            " and start the board anew"
        )
    return int(config["sync_led_ticks"]) / board.welcome.ticks_per_s


@dataclass(frozen=True)
class Devices:
    """The devices as the command line names them."""

    source: str  #: the cameras, such as usb:0,1; or sim:
    board: str  #: the controller board, such as serial:/dev/ttyACM0; or emulated:
    arm: Arm  #: the nominal arm
    target: Composite  #: the body on the tool
    sync_s: float  #: standard deviation of the time between the two exposures of a shot, s
    sync_led: bool = False  #: whether an LED on the board's clock is in view
    reference: Entry | None = None  #: an inertial unit that is fused and recorded


def require_joints(board: MotionBoard, name: str, arm: Arm) -> None:
    """Raise an InputError if a board drives another number of joints than the arm has."""
    if board.abilities.joints != len(arm.a):
        raise InputError(
            f"--board {name} has {board.abilities.joints} joints, --arm {arm.name} {len(arm.a)}: give the arm that is at"
            " the board (armsight arm list)"
        )


def planned_for(arm: Arm, board: str) -> Arm:
    """Return an arm whose motions its board of this name follows; in the workcell it stands where the cameras see it."""
    if not board.startswith(EMULATED):
        return slowed(arm, board)
    from armsight.sim.workcell.controlled import CONTROLLED, standing

    own = CONTROLLED.get(arm.name)
    return standing(arm) if own is None else slowed(standing(arm), own.board)


@contextlib.contextmanager
def open_devices(devices: Devices) -> Iterator[Setup]:
    """Open the devices, or the workcell instead of them, and close them at the end of the block."""
    source, board = devices.source, devices.board
    if source.startswith(SIM) != board.startswith(EMULATED):
        raise InputError(
            f"--source {source} --board {board}: {SIM} and {EMULATED} are one workcell and go together; real ones are "
            "usb:0,1 and serial:/dev/ttyACM0, feetech:PORT or ar4:PORT"
        )
    with contextlib.ExitStack() as stack:
        if source.startswith(SIM):
            from armsight.sim.workcell.workcell import Workcell

            emulator = "unicorn" if board == EMULATED else emulator_name(board)
            cameras = source.removeprefix(SIM) or _SIM_CAMERAS
            led = devices.sync_led
            workcell = stack.enter_context(
                Workcell.open(arm=_SIM_ARM, cameras=cameras, emulator=emulator, model=devices.arm, sync_led=led)
            )
            beside = None if devices.reference is None else simulated_unit(workcell, devices.reference, 0)
            yield replace(setup_of(workcell), target=devices.target, beside=beside)
            return
        check_board(board)  # a mistake is said before the cameras are waited for
        shots = LiveShots(open_source(source))
        stack.callback(shots.close)
        shots.start()
        rate_hz = shots.rate_hz()  # before the board is opened: what it says meanwhile would pile up
        if rate_hz is None:
            click.echo(f"note: the times of the shots show no rate of the cameras: {_RATE_HZ:g} Hz is taken", err=True)
        opened = stack.enter_context(open_motion_board(board))
        require_joints(opened, board, devices.arm)
        bit_s = sync_led_bit_s(opened, f"--board {board}") if devices.sync_led else None
        beside, clock = None, HostClock()
        if devices.reference is not None:
            readings = LiveReadings(devices.reference, clock)
            stack.callback(readings.close)
            beside = Fused(devices.reference, readings)
        yield Setup(
            devices.arm,
            opened,
            shots.poll,
            devices.target,
            np.zeros_like,
            rate_hz or _RATE_HZ,
            devices.sync_s,
            clock,
            sync_led_bit_s=bit_s,
            beside=beside,
        )
