"""What many commands have: ``-o`` and ``--stream``, and the kinds of sources and boards that commands open themselves."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

_Command = TypeVar("_Command", bound=Callable[..., Any])
#: A file or a folder.
PATH = click.Path(path_type=Path)
#: The simulated workcell as cameras.
SIM = "sim:"
#: A file of what was detected in images, or bag:FILE for tags in a recording, in place of images.
DETECTIONS = "detections:"
#: Joint angles that another program logged: ``--board poses:FILE``.
LOGGED = "poses:"
#: What every line about a board beside the cameras begins with; a loss is an error, a fault a warning, its end an info.
BOARD = "board: "
#: What a cell is called among the streams.
CELL = "cell:"
_HELP = (
    "Publish meanwhile: foxglove:PORT, json+tcp:PORT, json+udp:HOST:PORT, igtl:PORT or ros2:PORT; cell:NAME[@HUB] or "
    "cell:FILE.toml reports to the hub of the site; may be repeated (docs/howto/recordings.md, docs/howto/cells.md)."
)


def output(metavar: str, text: str, *name: str, **attributes: Any) -> Callable[..., Any]:  # noqa: ANN401 - click's own
    """Return the option ``-o``: what is written, what its help says, and the parameter's name where it is another."""
    shown = "default" in attributes
    return click.option(
        "-o", "--output", *name, metavar=metavar, type=PATH, help=text, show_default=shown, **attributes
    )


def references_option() -> Callable[[_Command], _Command]:
    """Give a command ``--references``."""
    said = "Fuse an inertial unit, or compare a magnetometer (docs/howto/references.md)."
    return click.option("--references", metavar="REFERENCES.toml", type=PATH, help=said)


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
