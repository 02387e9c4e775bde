"""The option ``--stream`` of every command that publishes, to readers or, as a cell, to the hub of its site."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import click

_Command = TypeVar("_Command", bound=Callable[..., Any])
#: What a cell is called among the streams.
CELL = "cell:"
_HELP = (
    "Publish meanwhile: foxglove:PORT, json+tcp:PORT, json+udp:HOST:PORT, igtl:PORT or ros2:PORT; cell:NAME[@HUB] or "
    "cell:FILE.toml reports to the hub of the site; may be repeated (docs/howto/recordings.md, docs/howto/cells.md)."
)


def stream_option(name: str = "stream") -> Callable[[_Command], _Command]:
    """Give a command ``--stream``; its argument ``name`` is the tuple of all that is published to."""
    return click.option("--stream", name, multiple=True, metavar="STREAM", callback=_checked, help=_HELP)


def _checked(_: click.Context, __: click.Parameter, streams: tuple[str, ...]) -> tuple[str, ...]:
    """Read who the cell is, so that a mistake is said before anything begins."""
    for spec in streams:
        if spec.startswith(CELL):
            from armsight.app.stream.cell_file import read_cell

            read_cell(spec.removeprefix(CELL))
    return streams
