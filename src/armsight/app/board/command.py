"""``armsight board``: build and flash the firmware, watch a board, tune its gains, test it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from armsight.app.board.config import config_group
from armsight.app.board.flash import FLASHED, PROGRAMMERS
from armsight.robot.boards.serial import BAUD

if TYPE_CHECKING:
    from armsight.robot.boards.board import Board

_JSON = click.option("--json", "as_json", is_flag=True, help="Print JSON.")
_DEFAULT = "emulated:unicorn"
#: How long an emulated board is watched where nobody says how long.
_WATCH_S = 2.0


def _board(action: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command the options that name a board."""
    baud = click.option(
        "--baud", type=click.IntRange(min=1), default=BAUD, show_default=True, help="Baud rate of a serial port."
    )
    what = "emulated:unicorn, emulated:qemu, emulated:host or serial:PORT."
    return click.option("--board", "name", default=_DEFAULT, show_default=True, metavar="BOARD", help=what)(
        baud(action)
    )


_compiler = click.option("--compiler", metavar="NAME", help="zig or gcc; by default the first one that is installed.")
_folder = click.option(
    "-o", "--output", metavar="DIR", type=click.Path(path_type=Path), default=Path("firmware-build"), show_default=True
)


@click.group("board")
def command() -> None:
    """Build and flash the arm's firmware, watch a board, tune its gains, test it.

    BOARD is emulated:unicorn (needs nothing but pip), emulated:qemu (needs qemu-system-arm), emulated:host (the same code
    without an ARM processor), or serial:PORT such as serial:/dev/ttyACM0.
    """


@command.command("build")
@click.option(
    "--board", "name", metavar="NAME", help="Build this board's image; by default the firmware that armsight emulates."
)
@_folder
@_compiler
@_JSON
def build_(name: str | None, output: Path, compiler: str | None, as_json: bool) -> None:
    """Build the firmware: for the emulated boards where armsight finds it, or a real board's image into a folder."""
    from armsight import firmware
    from armsight.app.board import text
    from armsight.app.board.flash import build_firmware
    from armsight.app.progress import steps
    from armsight.firmware import build

    with steps() as progress:
        progress("compiling")
        if name is None:
            build.build_package(firmware.BUILT, build.open_compiler(compiler))
            built = text.package_build()
        else:
            built = build_firmware(name, output, compiler)
    click.echo(json.dumps(text.built_json(built)) if as_json else text.built_text(built))


@command.command("flash")
@click.option("--board", "name", default=FLASHED[0], show_default=True, metavar="NAME", help="Which board.")
@click.option("--programmer", type=click.Choice(list(PROGRAMMERS)), help="Default: the first one that is installed.")
@_folder
@_compiler
@_JSON
def flash_(name: str, programmer: str | None, output: Path, compiler: str | None, as_json: bool) -> None:
    """Build a board's firmware and write it to the board; what the board stored stays."""
    from armsight.app.board import text
    from armsight.app.board.flash import build_firmware, flash
    from armsight.app.progress import steps

    with steps() as progress:
        progress("compiling")
        built = build_firmware(name, output, compiler)
        progress("writing")
        used = flash(built, programmer)
    answer = {**text.built_json(built), "programmer": used}
    click.echo(json.dumps(answer) if as_json else f"{built.image} is on the board, written by {used}")


@command.command()
@_board
@click.option("--seconds", type=click.FloatRange(min=0, min_open=True), help="Stop after this many seconds.")
@click.option("--every", type=click.FloatRange(min=0.01), default=0.5, show_default=True, help="Seconds between lines.")
@_JSON
def monitor(name: str, baud: int, seconds: float | None, every: float, as_json: bool) -> None:
    """Print a board's state and angles, line by line, until Ctrl-C; with --json one object per line.

    Nothing is commanded: the drives stay as they are.
    """
    from armsight.app.board import text
    from armsight.robot.boards.opening import SERIAL

    if seconds is None and not name.startswith(SERIAL):
        seconds = _WATCH_S
    with _open(name, baud) as board:
        click.echo(text.welcome_text(board.welcome), err=True)
        passed = 0.0
        while seconds is None or passed < seconds - 1e-9:
            states = board.receive(every)
            passed += every
            click.echo(json.dumps(text.status_json(board, states)) if as_json else text.status_text(board, states))


@command.command()
@_board
@click.option(
    "--set", "changes", multiple=True, metavar="JOINT:NAME=VALUE", help="Such as 3:kp_per_rad=5 or all:ki_per_rad_s=0."
)
@click.option("--store", is_flag=True, help="Keep them over a restart too; only with the drives off.")
@_JSON
def gains(name: str, baud: int, changes: tuple[str, ...], store: bool, as_json: bool) -> None:
    """Print the gains of all joints; with --set change them first.

    Changes are taken all at once, also in motion, without a jump of the duty; one that is out of range changes nothing.
    """
    from armsight.app.board import text
    from armsight.robot.boards.codes import ConfigSource
    from armsight.robot.boards.configuration import gains_array

    with _open(name, baud) as board:
        config = board.configuration()
        values = gains_array(config)
        if changes:
            values = text.changed_gains(values, changes)
            board.confirm(board.set_gains(values))
        if store:
            board.store(text.with_gains(config, values))
    click.echo(json.dumps(text.gains_json(values)) if as_json else text.gains_text(values))
    if store:
        click.echo("stored: in use after the board's next start, too", err=True)
        if board.welcome.config_source == ConfigSource.FACTORY:
            click.echo(
                "the rest of what was stored are factory values: see docs/reference/firmware.md before motors move",
                err=True,
            )


@command.command("selftest")
@_board
@click.option("--drives", is_flag=True, help="Let a real board move its arm, by less than 3 degrees.")
@_JSON
def selftest_(name: str, baud: int, drives: bool, as_json: bool) -> int:
    """Run the scenario set on a board: motion, a bad wire, a silent host, bad sensors, emergency stop, new gains.

    A real board's drives are never switched on without --drives: then it runs only what is safe at rest. Exit code 1 where
    a scenario failed.
    """
    from armsight.app.board import text
    from armsight.app.board.selftest import selftest
    from armsight.app.progress import steps
    from armsight.robot.boards.opening import SERIAL

    if name.startswith(SERIAL):
        moves = (
            "the arm will move by up to 3 degrees, keep clear of it"
            if drives
            else "drives stay off; --drives moves the arm"
        )
        click.echo(f"{name}: {moves}", err=True)
    with steps() as progress:
        result = selftest(name, drives=drives, baud=baud, progress=progress)
    click.echo(json.dumps(result.record()) if as_json else text.selftest_text(result))
    for scenario, found in result.scenarios.items():
        for problem in found.problems:
            click.echo(f"{scenario}: {problem}", err=True)
    return 0 if result.passed else 1


def _open(name: str, baud: int) -> Board:
    """Open a board; an emulated one has six free joints at its motors."""
    from armsight.robot.boards.opening import SERIAL, open_board
    from armsight.sim.joints import JointPlant

    return open_board(name, None if name.startswith(SERIAL) else JointPlant(), baud=baud)


command.add_command(config_group(_board, _JSON, _open))
