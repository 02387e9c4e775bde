"""Options that many commands have: a path, and ``-o``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

#: A file or a folder.
PATH = click.Path(path_type=Path)


def output(metavar: str, text: str, *name: str, **attributes: Any) -> Callable[..., Any]:  # noqa: ANN401 - click's own
    """Return the option ``-o``: what is written, what its help says, and the parameter's name where it is another."""
    shown = "default" in attributes
    return click.option(
        "-o", "--output", *name, metavar=metavar, type=PATH, help=text, show_default=shown, **attributes
    )
