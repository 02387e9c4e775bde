"""The file of ``armsight serve``: tables ``measure`` of options by their long names, ``board`` and ``serve``."""

from __future__ import annotations

import contextlib
import difflib
import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from armsight.errors import InputError, naming
from armsight.files import read_toml, unused

#: Keys of the table ``serve`` that are texts, and numbers.
_TEXTS, _NUMBERS = ("http", "log"), ("log_mb", "log_files", "stale_s", "retry_s")
#: Options that the service itself needs, or that would let memory grow.
_OWN = {
    "json": "the service reads what the command publishes",
    "help": "type it on the command line",
    "save_rig": "it is written when the command ends",
    "view": "pictures of days fill the disk",
    "board": "it is the port of the table [board]",
}


@dataclass(frozen=True)
class ServeConfig:
    """What is kept going, and how."""

    arguments: tuple[str, ...]  #: of `armsight measure`, without --output; --board is among them where one is watched
    folder: Path  #: where relative paths begin: that of the file
    http: str = "127.0.0.1:9110"  #: where /healthz and /metrics are, ``host:port``; empty for nowhere
    log: str = ""  #: file of the log, empty for stderr
    log_mb: float = 10.0  #: size at which it is begun anew, MB
    log_files: int = 5  #: older logs that are kept
    stale_s: float = 10.0  #: time without a shot after which the command is started again, s
    retry_s: float = 3.0  #: longest time between two tries, s
    output: str = ""  #: file of the poses, empty for none

    def started(self) -> tuple[str, ...]:
        """Return the arguments of the next start: its poses go into a file of their own, poses.csv, poses-2.csv ..."""
        return self.arguments + ((f"--output={unused(self.folder / self.output)}",) if self.output else ())


def read_config(path: Path) -> ServeConfig:
    """Read a file of ``armsight serve``; its relative paths begin at its own folder."""
    document = read_toml(path)
    if "run" in document:
        raise InputError(f"{path}: [run] is not served: an arm must not begin to move again by itself after a loss")
    if unknown := sorted(document.keys() - {"measure", "board", "serve"}):
        raise InputError(f"{path}: unknown table [{unknown[0]}]; known are [measure], [board] and [serve]")
    given = document.get("measure")
    if not isinstance(given, dict):
        raise InputError(
            f"{path}: expected a table [measure], with the options of `armsight measure` by their long names"
        )
    service = _table(path, "serve", document, _TEXTS, _NUMBERS)
    board = _table(path, "board", document, ("port",))
    if "board" in document and "port" not in board:
        raise InputError(f"{path}: [board] has no port, such as feetech:/dev/ttyACM0")
    folder = path.expanduser().resolve().parent
    command: click.Command = importlib.import_module("armsight.app.measure.command").command
    arguments = _arguments(path, command, given) + tuple(f"--board={each}" for each in board.values())
    try:
        command.make_context("measure", list(arguments)).close()
    except click.UsageError as error:
        raise InputError(f"{path}: [measure]: {error.format_message()}") from None
    with naming(path), contextlib.chdir(folder):
        _check(given, board)
    each_start = tuple(each for each in arguments if not each.startswith("--output="))
    return ServeConfig(each_start, folder, **service, output=str(given.get("output", "")))


def _table(
    path: Path, name: str, document: dict[str, Any], texts: tuple[str, ...], numbers: tuple[str, ...] = ()
) -> dict[str, Any]:
    given = document.get(name, {})
    if not isinstance(given, dict):
        raise InputError(f"{path}: {name} is {given!r}: expected a table [{name}]")
    found: dict[str, Any] = {}
    for key, value in given.items():
        if key not in texts and key not in numbers:
            raise InputError(f"{path}: [{name}] has an unknown key {key!r}{_near(key, [*texts, *numbers])}")
        if key in texts and not isinstance(value, str):
            raise InputError(f"{path}: [{name}] {key} is {value!r}: expected a text")
        if key in numbers and (isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < 1e6):
            raise InputError(f"{path}: [{name}] {key} is {value!r}: expected a number above 0")
        if key == "log_files" and value != int(value):
            raise InputError(f"{path}: [{name}] log_files is {value!r}: expected a whole number above 0")
        found[key] = int(value) if key == "log_files" else value
    return found


def _arguments(path: Path, command: click.Command, given: dict[str, Any]) -> tuple[str, ...]:
    known = {_key(each): each for each in command.params}
    out: list[str] = []
    for key, value in given.items():
        if key in _OWN:
            raise InputError(f"{path}: [measure] {key}: not for a service: {_OWN[key]}")
        if key not in known:
            raise InputError(
                f"{path}: [measure] has an unknown key {key!r}{_near(key, [k for k in known if k not in _OWN])}"
            )
        option = known[key]
        values = value if isinstance(value, list) else [value]
        if not all(isinstance(each, str | int | float) for each in values) or (len(values) > 1 and not option.multiple):
            raise InputError(f"{path}: [measure] {key} is {value!r}: expected one text, number or true")
        for each in values:
            if isinstance(option, click.Argument):
                out.insert(0, str(each))
            elif not isinstance(each, bool):
                out.append(f"{max(option.opts, key=len)}={each}")
            elif each:
                out.append(max(option.opts, key=len))
    return tuple(out)


def _key(parameter: click.Parameter) -> str:
    """Return what a file calls a parameter: its longest option, with underscores."""
    return max(parameter.opts, key=len).lstrip("-").replace("-", "_")


def _near(key: str, known: list[str]) -> str:
    """Return which known key is meant, or all of them."""
    near = difflib.get_close_matches(key, known, 1)
    return f": did you mean {near[0]}?" if near else f"; known are {', '.join(sorted(known))}"


def _check(given: dict[str, Any], board: dict[str, Any]) -> None:
    """Open rig and target, and look at the port: a mistake in them ends the service before it begins."""
    from armsight.robot.board_registry import check_board
    from armsight.vision.markers.targets import open_target
    from armsight.vision.sources import LIVE, open_rig

    if board and not (given.get("stream") and str(given.get("source", "")).startswith(LIVE)):
        raise InputError("[board] is published beside live cameras: give [measure] stream, and source usb: or url:")
    open_rig(str(given["rig"]))
    open_target(str(given["target"]))
    for each in board.values():
        check_board(each)
