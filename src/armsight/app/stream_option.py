"""The options ``--stream`` and ``--cell`` of every command that publishes, which gets both as one tuple."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import click

_Command = TypeVar("_Command", bound=Callable[..., Any])
#: What a cell is called among the streams.
CELL = "cell:"
_HELP = (
    "Publish meanwhile: foxglove:PORT, json+tcp:PORT, json+udp:HOST:PORT, igtl:PORT or ros2:PORT; may be repeated "
    "(docs/howto/recordings.md)."
)


def _kept(ctx: click.Context, _: click.Parameter, spec: str | None) -> None:
    """Read who the cell is, so that a mistake is said before anything begins."""
    if spec is not None:
        from armsight.app.stream.cell_file import read_cell

        read_cell(spec)
        ctx.meta[CELL] = (CELL + spec,)


def stream_options(name: str = "stream") -> Callable[[_Command], _Command]:
    """Give a command ``--stream`` and ``--cell``; its argument ``name`` is the tuple of all that is published to."""
    stream = click.option("--stream", name, multiple=True, metavar="STREAM", callback=_joined, help=_HELP)
    cell = click.option(
        "--cell",
        metavar="NAME[@HUB]",
        callback=_kept,
        expose_value=False,
        is_eager=True,
        help="Report to the hub of the site as this cell, or as cell.toml says (docs/howto/cells.md).",
    )
    return lambda command: stream(cell(command))


def _joined(ctx: click.Context, _: click.Parameter, streams: tuple[str, ...]) -> tuple[str, ...]:
    return (*streams, *ctx.meta.get(CELL, ()))
