"""Progress on stderr: a bar where that is a terminal, a line every few seconds elsewhere."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterator

import click

_EVERY_S = 5.0


def _lines() -> Callable[[str], None]:
    """Return a function that prints a line if a few seconds have passed since the last one, or since the beginning."""
    last_s = time.monotonic()

    def say(line: str) -> None:
        nonlocal last_s
        if time.monotonic() - last_s >= _EVERY_S:
            last_s = time.monotonic()
            click.echo(line, err=True)

    return say


@contextlib.contextmanager
def bar(what: str, total: int | None) -> Iterator[Callable[[], None]]:
    """Show a progress bar; the block is given a function that advances it by one."""
    say, done = _lines(), 0

    def one_more() -> None:
        nonlocal done
        done += 1
        say(f"{what}: {done}" if total is None else f"{what}: {done} of {total}")

    if not sys.stderr.isatty():
        yield one_more
        return
    from rich.console import Console  # not above: it takes longer than a pair of images
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn(what), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(what, total=total)
        yield lambda: progress.advance(task)


@contextlib.contextmanager
def steps() -> Iterator[Callable[[str], None]]:
    """Show what is being done; the block is given a function that sets the line."""
    if not sys.stderr.isatty():
        yield _lines()
        return
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("", total=None)
        yield lambda line: progress.update(task, description=line)
