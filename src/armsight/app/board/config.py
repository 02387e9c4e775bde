"""``armsight board config``: the whole configuration of a board, as a file and value by value."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from armsight.robot.boards.board import Board

_FILE = click.argument("file", type=click.Path(path_type=Path))


def config_group(
    options: Callable[..., Any], as_json: Callable[..., Any], open_board: Callable[[str, int], Board]
) -> click.Group:
    """Return the group; ``options`` name a board, ``as_json`` asks for JSON, and ``open_board`` opens the board."""

    @click.group("config")
    def group() -> None:
        """Read, compare, change and store a board's whole configuration, also as a file: board.toml."""

    @group.command()
    @options
    @click.option("-o", "--output", metavar="FILE", type=click.Path(path_type=Path), help="Write it there.")
    @as_json
    def get(name: str, baud: int, output: Path | None, as_json: bool) -> None:
        """Print the configuration in use as a board.toml, or write it to a file."""
        from armsight.files import write_text
        from armsight.robot.boards.board_file import configuration_text, entries

        with open_board(name, baud) as board:
            config = board.configuration()
            text = configuration_text(config, board.welcome.board)
        if output is not None:
            write_text(output, text)
        if as_json:
            click.echo(json.dumps(dict(entries(config))))
        elif output is None:
            click.echo(text, nl=False)

    @group.command()
    @_FILE
    @options
    @as_json
    def diff(file: Path, name: str, baud: int, as_json: bool) -> int:
        """Print what differs between a board.toml and the board; exit code 1 where anything does."""
        from armsight.robot.boards.board_file import entries, read_configuration

        ours, board_name = read_configuration(file)
        with open_board(name, baud) as board:
            _same_board(file, board_name, board)
            theirs = dict(entries(board.configuration()))
        found = {path: [theirs.get(path), value] for path, value in entries(ours) if theirs.get(path) != value}
        if as_json:
            click.echo(json.dumps(found))
        for path, (on_board, in_file) in found.items():
            if not as_json:
                click.echo(f"{path}: {on_board} on the board, {in_file} in {file}")
        return 1 if found else 0

    @group.command()
    @_FILE
    @options
    @as_json
    def store(file: Path, name: str, baud: int, as_json: bool) -> None:
        """Store a board.toml on the board, with the drives off; it is in use after the board's next start."""
        from armsight.robot.boards.board_file import read_configuration

        config, board_name = read_configuration(file)
        with open_board(name, baud) as board:
            _same_board(file, board_name, board)
            board.store(config)
        _stored(as_json)

    @group.command("set")
    @click.argument("changes", nargs=-1, required=True, metavar="PATH=VALUE...")
    @options
    @as_json
    def set_(changes: tuple[str, ...], name: str, baud: int, as_json: bool) -> None:
        """Change single values and store them, such as joint.3.soft_max_rad=1.2 or arm.silence_ticks=200."""
        import tomllib

        from armsight.errors import InputError
        from armsight.robot.boards.board_file import put

        with open_board(name, baud) as board:
            config = board.configuration()
            seen: set[str] = set()
            for change in changes:
                path, _, text = change.partition("=")
                if path.strip() in seen:
                    raise InputError(f"{path.strip()} is given twice; nothing was changed")
                seen.add(path.strip())
                try:
                    value = tomllib.loads(f"value = {text}")["value"]
                except tomllib.TOMLDecodeError:
                    if path.strip().endswith(
                        (".sync_led_pin", ".encoder.sensor")
                    ):  # a name, which a shell takes the quotes from
                        put(config, path.strip(), text.strip())
                        continue
                    raise InputError(f"{change}: a path, = and a number are needed: joint.3.soft_max_rad=1.2") from None
                put(config, path.strip(), value)
            board.store(config)
        _stored(as_json)

    return group


def _same_board(file: Path, name: str, board: Board) -> None:
    """Raise InputError where a file is for another board."""
    from armsight.errors import InputError

    if name != board.welcome.board:
        raise InputError(f"{file} is for board {name}; this one is {board.welcome.board}; nothing was changed")


def _stored(as_json: bool) -> None:
    if as_json:
        click.echo(json.dumps({"stored": True}))
    click.echo("stored: in use after the board's next start", err=True)
