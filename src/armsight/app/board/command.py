"""``armsight board``: build and flash the firmware, watch a board, tune its gains, test it, bring it up."""

from __future__ import annotations

import contextlib
import re
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click
from click.core import ParameterSource

from armsight.app.board.flash import FLASHED, PROGRAMMERS, build_firmware, flash, package_build
from armsight.app.options import JSON, SECONDS, argument, declared, option, out
from armsight.app.progress import steps
from armsight.app.show.messages import UNTRUSTED, note, print_answer
from armsight.errors import DeviceError, InputError
from armsight.files import check_folder, unused, write_text

if TYPE_CHECKING:
    from armsight.app.board.bringup import Operator
    from armsight.app.board.offsets import Zeros
    from armsight.robot.boards.board import Board
    from armsight.robot.boards.codes import SensorKind
    from armsight.robot.boards.contract import MotionBoard

_FILE = argument()
NOT_HOMED = "not homed: its readings are not the arm's angles (armsight board home)"
#: The steps of a bring-up, in their order, and what each finds of a joint (``found.JointFound``).
STEPS = {
    "readings": "noise_counts",
    "potentiometers": "range_counts",
    "motors": "motor_direction",
    "swing": "resistance_ohm",
    "verify": "following_rms_rad",
    "store": "",
}


_BOARD = option(
    "emulated: (unicorn, qemu or host behind it), serial:PORT, feetech:PORT[,LEROBOT.json] or ar4:PORT; ,baud=N behind a "
    "port.",
    "--board",
    default="emulated:unicorn",
    metavar="BOARD",
)
_COMPILER = option("zig or gcc; by default the first one that is installed.", metavar="NAME")
_FOLDER = out("DIR", "Where the image is written.", default="firmware-build")
_YES = option("Do not ask.")


def _open(name: str) -> Board:
    """Open a board with our firmware; an emulated one has six free joints at its motors."""
    from armsight.robot.board_registry import SERIAL, open_board
    from armsight.sim.joints import JointPlant

    plant = None if name.startswith(SERIAL) else JointPlant()
    return open_board(name, plant)


def open_any(name: str) -> MotionBoard:
    """Open any board; an emulated one has six free joints at its motors."""
    from armsight.robot.board_registry import is_real, open_motion_board
    from armsight.sim.joints import JointPlant

    return open_motion_board(name, None if is_real(name) else JointPlant())


def not_homed(board: MotionBoard) -> str:
    """Return that a board is not homed, with its joints where it names them; empty where it is."""
    joints = ", ".join(map(str, board.status.joints_not_homed))
    return "" if board.homed else f"joint {joints}: {NOT_HOMED}" if joints else NOT_HOMED


@click.group("board")
def command() -> None:
    """Build and flash the arm's firmware, watch a board, tune its gains, test it.

    BOARD is emulated:unicorn (needs nothing but pip), emulated:qemu (needs qemu-system-arm), emulated:host (the same code
    without an ARM processor), or serial:PORT such as serial:/dev/ttyACM0. Arms with a controller of their own are
    feetech:PORT (SO-100, SO-101) and ar4:PORT (AR4); what they cannot do is rejected.
    """


@command.command("build")
@declared
def build_(
    name: str | None = option("This board's image; by default the one armsight emulates.", "--board", metavar="NAME"),
    output: Path = _FOLDER,
    compiler: str | None = _COMPILER,
    as_json: bool = JSON,
) -> None:
    """Build the firmware: for the emulated boards where armsight finds it, or a real board's image into a folder."""
    from armsight import firmware
    from armsight.app.board import text
    from armsight.firmware import build

    with steps() as progress:
        progress("compiling")
        if name is None:
            build.build_package(firmware.BUILT, build.open_compiler(compiler))
        built = package_build() if name is None else build_firmware(name, output, compiler)
    print_answer(as_json, text.built_json(built), text.built_text(built))


@command.command("flash")
@declared
def flash_(
    name: str = option("Which board.", "--board", default=FLASHED[0], metavar="NAME"),
    programmer: str | None = option("Default: the first one that is installed.", choices=PROGRAMMERS),
    output: Path = _FOLDER,
    compiler: str | None = _COMPILER,
    as_json: bool = JSON,
) -> None:
    """Build a board's firmware and write it to the board; what the board stored stays."""
    from armsight.app.board import text

    with steps() as progress:
        progress("compiling")
        built = build_firmware(name, output, compiler)
        progress("writing")
        used = flash(built, programmer)
    answer = {**text.built_json(built), "programmer": used}
    print_answer(as_json, answer, f"{built.image} is on the board, written by {used}")


@command.command()
@declared
def monitor(
    name: str = _BOARD,
    seconds: float | None = SECONDS,
    every: float = option("Seconds between lines.", min=0.01, default=0.5),
    as_json: bool = JSON,
) -> None:
    """Print a board's state and angles, line by line, until Ctrl-C; with --json one object per line.

    Nothing is commanded: the drives stay as they are.
    """
    from armsight.app.board import text
    from armsight.robot.board_registry import is_real

    if click.get_current_context().get_parameter_source("name") is ParameterSource.DEFAULT:
        note(f"no --board: this one is {name}, a program; --board serial:PORT is a board")
    with open_any(name) as board:
        click.echo(text.welcome_text(board), err=True)
        passed, said = 0.0, ""
        while seconds is None or passed < seconds - 1e-9:
            states = board.receive(every)
            passed += every
            if (now := not_homed(board)) != said:
                note((said := now) or "all joints are homed")
            if not is_real(name):
                time.sleep(every)  # its time passes at once
            print_answer(as_json, text.status_json(board, states), text.status_text(board, states))


@command.command()
@declared
def gains(
    name: str = _BOARD,
    changes: tuple[str, ...] = option("3:kp_per_rad=5 or all:ki_per_rad_s=0.", "--set", metavar="JOINT:NAME=VALUE"),
    store: bool = option("Keep them over a restart too; only with the drives off."),
    as_json: bool = JSON,
) -> None:
    """Print the gains of all joints; with --set change them first.

    Changes are taken all at once, also in motion, without a jump of the duty; one that is out of range changes nothing.
    """
    from armsight.app.board import text
    from armsight.robot.boards.codes import ConfigSource
    from armsight.robot.boards.configuration import gains_array

    with _open(name) as board:
        config = board.configuration()
        values = gains_array(config)
        if changes:
            values = text.changed_gains(values, changes)
            board.confirm(board.set_gains(values))
        if store:
            board.store(text.with_gains(config, values))
    print_answer(as_json, text.gains_json(values), text.gains_text(values))
    if store:
        click.echo("stored: in use after the board's next start, too", err=True)
        if board.welcome.config_source == ConfigSource.FACTORY:
            look = "see docs/reference/firmware.md before motors move"
            click.echo(f"the rest of what was stored are factory values: {look}", err=True)


@command.command("selftest")
@declared
def selftest_(
    name: str = _BOARD,
    drives: bool = option("Let a real board move its arm, by less than 3 degrees."),
    as_json: bool = JSON,
) -> int:
    """Run the scenario set on a board: motion, a bad wire, a silent host, bad sensors, emergency stop, new gains.

    A real board's drives are never switched on without --drives: then it runs only what is safe at rest. Exit code 1 where
    a scenario failed.
    """
    from armsight.app.board import text
    from armsight.app.board.selftest import selftest
    from armsight.robot.board_registry import SERIAL

    if name.startswith(SERIAL):
        keep_clear = "the arm will move by up to 3 degrees, keep clear of it"
        click.echo(f"{name}: {keep_clear if drives else 'drives stay off; --drives moves the arm'}", err=True)
    with steps() as progress:
        result = selftest(name, drives=drives, progress=progress)
    print_answer(as_json, result.record(), text.selftest_text(result))
    for scenario, found in result.scenarios.items():
        for problem in found.problems:
            click.echo(f"{scenario}: {problem}", err=True)
    return 0 if result.passed else 1


@command.command()
@declared
def bringup(
    name: str = _BOARD,
    folder: Path = out("DIR", "Folder of board.toml, report.html and what was found.", default="bringup", report=True),
    steps: tuple[str, ...] = option("Only this step; may be repeated.", "--step", choices=STEPS),
    joints: tuple[int, ...] = option("Only this joint; may be repeated.", "--joint", min=1, max=6),
    encoders: tuple[str, ...] = option(
        "A joint that an encoder reads: 2:absolute, or 3:quadrature:1 with its input; may be repeated.",
        "--encoder",
        metavar="JOINT:KIND",
    ),
    again: bool = option("Do also what was found before."),
    most_current_a: float = option("What a motor may draw, A.", "--current", min=0.05, max=30, default=2.0),
    seed: int = option("Of an emulated board's arm.", min=0, default=1),
    as_json: bool = JSON,
) -> None:
    """Bring up an arm of unknown motors and potentiometers or encoders, step by step, and store its configuration.

    Each joint is moved by hand, each motor driven by a pulse of at most 3 degrees, and then, after a yes, by a swing of 10.
    What was found is kept: the same command goes on where it ended. On an emulated board an arm and a person are drawn.
    """
    from armsight.app.board.bringup import CONFIG_FILE, FOUND_FILE, Bringup, TerminalOperator
    from armsight.app.show.page import PAGE, writable_folder
    from armsight.app.show.plotting import require_matplotlib
    from armsight.robot.board_registry import SERIAL, emulator_name
    from armsight.robot.boards.board import Board
    from armsight.robot.boards.emulated import EmulatedLink
    from armsight.robot.boards.emulators import open_emulator
    from armsight.sim.boards.workshop import WorkshopPerson, drawn_encoders, drawn_workshop

    def echo(line: str) -> None:
        click.echo(line, err=True)

    require_matplotlib()
    kinds = _encoders(encoders)
    held, signs = (CONFIG_FILE, PAGE), (FOUND_FILE,)
    check_folder(folder, holding=held, signs=signs, problem="nothing of a bring-up can be written here")
    if name.startswith(SERIAL):
        board = _open(name)
        person: Operator = TerminalOperator(echo)
    else:
        plant, _ = drawn_workshop(seed, encoders=drawn_encoders(seed, {j: kind for j, (kind, _) in kinds.items()}))
        person = WorkshopPerson(plant, seed=seed, say=echo)
        board = Board.connect(EmulatedLink(open_emulator(emulator_name(name)), plant), name="the emulated board")
    with board:
        writable_folder(folder, "nothing of a bring-up")
        chosen = [joint - 1 for joint in sorted(set(joints))] or range(6)
        session = Bringup(board, person, folder, chosen, encoders=kinds, again=again, most_current_a=most_current_a)
        session.run(steps or tuple(STEPS))
    print_answer(as_json, session.found.json())
    if session.refuted:
        click.get_current_context().exit(UNTRUSTED)


def _encoders(given: tuple[str, ...]) -> dict[int, tuple[SensorKind, int]]:
    from armsight.robot.boards.codes import SensorKind

    found: dict[int, tuple[SensorKind, int]] = {}
    for each in given:
        match = re.fullmatch(r"([1-6]):(?:(absolute)|quadrature:([1-6]))", each)
        if match is None:
            needed = "a joint and a kind are needed: 2:absolute, or 3:quadrature:1 with its input"
            raise InputError(f"--encoder {each}: {needed}")
        if int(match[1]) - 1 in found:
            raise InputError(f"--encoder {each}: joint {match[1]} has two encoders; one is needed")
        kind = SensorKind.ABSOLUTE if match[2] else SensorKind.QUADRATURE
        found[int(match[1]) - 1] = (kind, int(match[3] or 0))
    inputs = [which for kind, which in found.values() if kind == SensorKind.QUADRATURE]
    if len(set(inputs)) < len(inputs):
        raise InputError("--encoder: two quadrature encoders are at one input; each needs its own")
    return found


@command.command()
@declared
def home(
    name: str = _BOARD,
    at_once: str = option("Joints at a time.", choices=["1", "2", "3", "6"], default="6"),
    yes: bool = _YES,
    as_json: bool = JSON,
) -> None:
    """Home an AR4: its joints go to their limit switches, where the encoders are set, and then to rest at 0.

    A board with our firmware moves nothing: quadrature encoders take where the arm stands, drives off, for their home_rad.
    """
    import numpy as np

    from armsight.robot.boards.ar4.board import Ar4Board
    from armsight.robot.boards.board import Board
    from armsight.robot.boards.codes import Command, SensorKind

    with open_any(name) as board:
        if isinstance(board, Ar4Board):
            question = "the arm will move to the ends of all joints: is everything out of its reach?"
        elif isinstance(board, Board) and SensorKind.QUADRATURE in board.configuration()["joint"]["encoder"]["sensor"]:
            question = "is the arm where its encoders have home_rad, and does it stay there?"
        else:
            raise InputError(f"{name} has no limit switches to be homed at; its sensors are absolute")
        if not yes:
            click.confirm(question, abort=True, err=True)
        if not isinstance(board, Ar4Board):
            board.confirm(board.command(Command.HOME))
        else:
            try:
                board.home(at_once=int(at_once))
            except KeyboardInterrupt:
                goes_on = "the AR4 goes on homing by itself, and answers nothing until then"
                click.echo(f"{goes_on}: its emergency stop stops it", err=True)
                raise
        if not len(q := board.receive(0.05).q):
            raise DeviceError(f"{name} reports no angles after it was homed")
    degrees = [round(float(each), 3) for each in np.degrees(q[-1])]
    print_answer(as_json, {"q_rad": [round(float(each), 6) for each in q[-1]]}, f"homed, at {degrees} deg")


@command.command()
@declared
def clear(name: str = _BOARD, as_json: bool = JSON) -> None:
    """Reset the emergency stop and the faults whose causes are gone; the drives stay as they are."""
    from armsight.robot.boards.codes import BoardState, Command

    with open_any(name) as board:
        if name.startswith("ar4:") or board.status.state is BoardState.STOPPED:
            board.confirm(board.command(Command.CLEAR_STOP))
        board.confirm(board.command(Command.CLEAR_FAULTS))
        board.receive(0.05)
        state, faults = board.status.state.name, board.status.faults
    said = "; ".join(map(str, faults)) or "no fault"
    print_answer(as_json, {"state": state, "faults": [each.fault.name for each in faults]}, f"{state}: {said}")


@command.command()
@declared
def release(name: str = _BOARD, as_json: bool = JSON) -> None:
    """Switch the drives off: the arm sinks, support it."""
    from armsight.robot.boards.codes import Command

    with open_any(name) as board:
        board.confirm(board.command(Command.DISABLE))
        board.receive(0.05)
        state = board.status.state.name
    print_answer(as_json, {"state": state}, state)


@command.command()
@declared
def offsets(
    name: str = _BOARD,
    identified: str | None = option("Correct by what `armsight identify` found; needs --arm.", metavar="ARM"),
    nominal: str | None = option("The nominal arm of --identified.", "--arm", metavar="ARM"),
    further: str | None = option("Correct by these: true less reported angles, degrees.", metavar="DEG,..."),
    restore: Path | None = option("Write back what --keep has kept.", metavar="FILE"),
    keep: Path = option(
        "New file for the offsets as they were; otherwise old_offsets.json, or with -2, -3 ...",
        metavar="FILE",
        default=lambda: unused(Path("old_offsets.json")),
        show_default=False,
    ),
    yes: bool = _YES,
    as_json: bool = JSON,
) -> None:
    """Print the zeros where an arm keeps them, or correct them, after asking; the old ones are kept in a file first.

    feetech:PORT: the homing offsets of the servos (register 31); LeRobot's calibration, where given, gets the same. A board
    with armsight's firmware: the tables of its potentiometers. ar4:FILE.yaml: the joint_offsets file of ar4_ros_driver,
    such as mk3.yaml; no board is opened. The drives must be off: it asks before it switches them off. A servo's offset is
    -2047 to 2047 counts; what looks like a mistake, such as more than a tooth of the horn (14.4 degrees), is not written
    with --yes.
    """
    from armsight.app.board import offsets as kept
    from armsight.robot.arm_file import open_arm
    from armsight.robot.board_registry import calibration_of
    from armsight.robot.boards.feetech.board import FeetechBoard

    given = [each for each in (identified, further, restore) if each is not None]
    if len(given) > 1 or (identified is None) != (nominal is None):
        raise InputError("give one of --identified ARM with --arm ARM, --further DEG,... and --restore FILE")
    angles = None if further is None else kept.parsed_degrees(further)
    if identified is not None and nominal is not None:
        angles = kept.further_of(identified, open_arm(nominal))

    def offer(zeros: Zeros) -> None:
        """Show the zeros, and write them where others are given, after asking."""
        if given and zeros.doubts and yes:
            raise InputError(f"{zeros.doubts[0]}; --yes does not write this: without it you are asked")
        if given and not yes:
            click.echo("\n".join([zeros.text, *(f"note: {each}" for each in zeros.doubts)]), err=True)
            click.confirm(zeros.question, abort=True, err=True)
        if given:
            zeros.write(keep)
        print_answer(as_json, {"written": bool(given), "joints": zeros.json}, zeros.text)
        if given:
            click.echo(f"written; the old offsets are in {keep}", err=True)

    if name.startswith("ar4:"):
        if not (file := name.removeprefix("ar4:")).endswith((".yaml", ".yml")):
            raise InputError(f"{name}: an AR4 keeps no zeros; its driver's file does: --board ar4:mk3.yaml")
        offer(kept.ar4_zeros(Path(file), angles, restore, keep))
    elif name.startswith("feetech:"):
        with open_any(name) as board:
            assert isinstance(board, FeetechBoard)
            kept.offer_release(board, changes=bool(given), yes=yes)
            offer(kept.servo_zeros(board, angles, restore, calibration_of(name)))
    else:
        with _open(name) as own:
            offer(kept.pot_zeros(own, angles, restore))


@command.command()
@declared
def emulate(
    arm: str = argument(choices=["so101", "ar4"]), seconds: float | None = SECONDS, as_json: bool = JSON
) -> None:
    """Emulate an arm with its controller at a port of this computer, until Ctrl-C: to try everything without an arm.

    so101 is a servo bus with backlash and droop, for feetech:PORT; ar4 a Teensy with backlash and a homing that is off.
    """
    with emulated_arm(arm) as board:
        print_answer(as_json, {"board": board}, board)
        threading.Event().wait(seconds)


@contextlib.contextmanager
def emulated_arm(arm: str) -> Iterator[str]:
    """Emulate an SO-101 or an AR4 at a port; yields the board's name."""
    from armsight.robot.boards.ar4 import board as ar4
    from armsight.robot.boards.feetech import bus as feetech
    from armsight.sim.boards.ar4 import Ar4Teensy
    from armsight.sim.boards.device import serve
    from armsight.sim.boards.so101 import So101Bus

    servos = arm == "so101"
    with serve(So101Bus.made() if servos else Ar4Teensy(), feetech.BAUD if servos else ar4.BAUD) as port:
        yield f"{'feetech' if servos else 'ar4'}:{port.name}"


@command.group()
def config() -> None:
    """Read, compare, change and store a board's whole configuration, also as a file: board.toml."""


@config.command()
@declared
def get(
    name: str = _BOARD, output: Path | None = out("FILE", "Write it there.", kind="^board *="), as_json: bool = JSON
) -> None:
    """Print the configuration in use as a board.toml, or write it to a file."""
    from armsight.robot.boards.board_file import configuration_text, entries

    with _open(name) as board:
        used = board.configuration()
        text = configuration_text(used, board.welcome.board)
    if output is not None:
        write_text(output, text)
    print_answer(as_json, dict(entries(used)), *([text.rstrip("\n")] if output is None else []))


@config.command()
@declared
def diff(file: Path = _FILE, name: str = _BOARD, as_json: bool = JSON) -> int:
    """Print what differs between a board.toml and the board; exit code 1 where anything does."""
    from armsight.robot.boards.board_file import entries, read_configuration

    ours, board_name = read_configuration(file)
    with _open(name) as board:
        _same_board(file, board_name, board)
        theirs = dict(entries(board.configuration()))
    found = {path: [theirs.get(path), value] for path, value in entries(ours) if theirs.get(path) != value}
    lines = (f"{path}: {on_board} on the board, {in_file} in {file}" for path, (on_board, in_file) in found.items())
    print_answer(as_json, found, *lines)
    return 1 if found else 0


@config.command()
@declared
def store(file: Path = _FILE, name: str = _BOARD, as_json: bool = JSON) -> None:
    """Store a board.toml on the board, with the drives off; it is in use after the board's next start."""
    from armsight.robot.boards.board_file import read_configuration

    stored, board_name = read_configuration(file)
    with _open(name) as board:
        _same_board(file, board_name, board)
        board.store(stored)
    _stored(as_json)


@config.command("set")
@declared
def set_(
    changes: tuple[str, ...] = argument("PATH=VALUE...", required=True), name: str = _BOARD, as_json: bool = JSON
) -> None:
    """Change single values and store them, such as joint.3.soft_max_rad=1.2 or arm.silence_ticks=200."""
    import tomllib

    from armsight.robot.boards.board_file import put

    with _open(name) as board:
        changed, seen = board.configuration(), set[str]()
        for change in changes:
            path, _, text = (part.strip() for part in change.partition("="))
            if path in seen:
                raise InputError(f"{path} is given twice; nothing was changed")
            seen.add(path)
            try:
                put(changed, path, tomllib.loads(f"value = {text}")["value"])
            except tomllib.TOMLDecodeError:
                # Names, which a shell takes the quotes from.
                if not path.endswith((".sync_led_pin", ".encoder.sensor")):
                    raise InputError(f"{change}: a path, = and a number are needed: joint.3.soft_max_rad=1.2") from None
                put(changed, path, text)
        board.store(changed)
    _stored(as_json)


def _same_board(file: Path, name: str, board: Board) -> None:
    if name != board.welcome.board:
        raise InputError(f"{file} is for board {name}; this one is {board.welcome.board}; nothing was changed")


def _stored(as_json: bool) -> None:
    print_answer(as_json, {"stored": True})
    click.echo("stored: in use after the board's next start", err=True)
