"""``armsight live``: from two cameras that nobody has calibrated to a closed loop, on one page."""

from __future__ import annotations

import secrets
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from armsight.app.options import ARM, CELL, FOLLOW_RIG, JSON, SEED, SIM, STREAM, declared, option, out
from armsight.app.show.messages import print_answer, require, say
from armsight.errors import InputError

if TYPE_CHECKING:
    from armsight.app.live.step import SessionOptions


@dataclass(frozen=True)
class LiveOptions:
    """The options that a session has (:class:`~armsight.app.live.step.SessionOptions`)."""

    source: str | None = option("The cameras, such as usb:0,1 (armsight record -h); sim: is the simulated workcell.")
    rig: Path | None = option("A calibrated rig; begins with measuring.", metavar="RIG.json")
    target: str | None = option("The body that is measured: a body file or a board.", metavar="SPEC|BODY")
    calibration_board: str | None = option("The calibration board, such as chessboard:9x6:25mm.", metavar="SPEC")
    board: str | None = option(
        "The arm's controller: serial:PORT, feetech:PORT,LEROBOT.json, ar4:PORT; poses:FILE where another moves it."
    )
    arm: str = ARM
    servo_calibration: Path | None = option(
        "LeRobot's calibration file of a servo bus, whose port the page finds.", "--calibration", metavar="FILE.json"
    )
    motion: Path | None = option("The motions (docs/howto/run.md).", metavar="MOTION.toml")
    folder: Path = out("DIR", "Folder of the session.", default="live")
    follow_rig: bool = FOLLOW_RIG
    seed: int = SEED
    streams: tuple[str, ...] = STREAM


@click.command("live")
@declared
def command(
    given: LiveOptions,
    sync_ms: float = option("Sigma of the time between a shot's exposures, ms.", min=0.0, max=1000.0, default=1.0),
    http: str = option(
        "Where the page is; 0.0.0.0:8722 for other computers, too; port 0 takes a free one.",
        default="127.0.0.1:8722",
        metavar="HOST:PORT",
    ),
    as_json: bool = JSON,
) -> None:
    """Open a page in the browser that leads from two uncalibrated cameras to a closed loop, step by step.

    The steps: cameras, board, calibration, body, measuring, arm, recorded, health; each shows its command line.

    The page is for this computer alone. With --http 0.0.0.0:8722 it is opened from another one, by the address with the
    token that is printed. The button on the page and the space key stop the arm; the wired stop is the safety device.
    """
    require("the page", "live", "websockets")

    from armsight.app.live.server import LiveServer
    from armsight.app.live.session import LiveSession
    from armsight.app.live.step import SessionOptions
    from armsight.app.show.http import HERE, host_and_port
    from armsight.app.stream.datum import Published
    from armsight.app.stream.streams import open_streams
    from armsight.files import alone_in
    from armsight.vision.sources import check_source
    from armsight.vision.sources.usb import is_one, parsed_usb

    host, port = host_and_port(http, "--http")
    options = _with_calibration(SessionOptions(**vars(given), sync_s=1e-3 * sync_ms))
    source = options.source or ""
    if options.source is not None and not source.startswith(SIM):
        check_source(source)
    if source.startswith("usb:") and not is_one(source.removeprefix("usb:")):
        parsed_usb(source.removeprefix("usb:"))  # cameras may come later, their names may not; one alone the page says
    tried = [each for each in options.streams if not each.startswith(CELL)]  # a mistake is said now; a cell's was
    open_streams(tried, Published(), say).close()
    session = LiveSession(options)
    with alone_in(session.folder, "live"):
        server = LiveServer(session, host, port, None if host in HERE else secrets.token_urlsafe(18))
        try:
            server.start()
            session.start()
            answer = {"address": server.address, "directory": str(session.folder)}
            line = f"open {server.address} in a browser; all is stored in {session.folder}; Ctrl-C ends the session"
            print_answer(as_json, answer, line)
            shown = 0
            while True:
                for event in session.events(shown):
                    shown = event.number
                    click.echo(f"{event.at} {event.text}", err=True)
                time.sleep(0.2)
        finally:
            server.close()
            session.close()


def _with_calibration(options: SessionOptions) -> SessionOptions:
    """Return options whose servo bus, where --board names one, has the file of --calibration."""
    from armsight.robot.board_registry import FEETECH, calibration_of
    from armsight.robot.boards.feetech.calibration import read_calibration

    file, board = options.servo_calibration, options.board
    if file is None:
        return options
    read_calibration(file)
    if board is None:
        return options
    if not board.startswith(FEETECH):
        raise InputError(f"--calibration {file}: belongs to a servo bus, --board {FEETECH}PORT, not to {board}")
    if calibration_of(board) is not None:
        raise InputError(f"--calibration {file}: --board {board} has a calibration file already; give one of them")
    return replace(options, board=f"{board},{file}")
