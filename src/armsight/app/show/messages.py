"""Messages, and how they look: errors are red, weaknesses yellow; in a pipe, and with NO_COLOR, plain text."""

from __future__ import annotations

import importlib
import json
import logging
import os
import sys
from dataclasses import dataclass
from typing import Literal

import click

from armsight.errors import InputError

#: Of a result: worth knowing; worse than it could be; must not be used. Of what happens on a live page: the others.
Level = Literal["note", "weak", "untrusted", "good", "hint", "warn", "error"]
#: Exit code of a command that is done, but whose result must not be trusted (docs/concepts/health.md).
UNTRUSTED = 3
#: What is wrong where a question is asked and the standard input is closed.
UNANSWERED = "nobody answers, as the standard input is closed: run it at a terminal"


@dataclass(frozen=True)
class Note:
    """A line for a person, and how it is meant."""

    level: Level
    text: str


def colour() -> bool | None:
    """Return whether text is in colour: False with NO_COLOR (no-color.org), None where the terminal decides."""
    return False if os.environ.get("NO_COLOR") else None


def print_error(text: str) -> None:
    """Print an error as one line on stderr."""
    click.echo(click.style(f"armsight: error: {text}", fg="red"), err=True, color=colour())


def print_answer(as_json: bool, value: object, *lines: str) -> None:
    """Print what a command found: as JSON, or as lines for people."""
    if as_json or lines:
        click.echo(json.dumps(value) if as_json else "\n".join(lines))


def say(line: str) -> None:
    """Print a line on stderr."""
    click.echo(line, err=True)


def note(*lines: object) -> None:
    """Print what is worth knowing on stderr, a line each."""
    for line in lines:
        say(f"note: {line}")


def warn(*lines: str) -> None:
    """Print what is weak about a result on stderr, a line each."""
    for line in lines:
        click.echo(weak(line), err=True, color=colour())


class _Notes(logging.Handler):
    """Prints what the library logs as notes on stderr, each once."""

    def __init__(self, level: int) -> None:
        super().__init__(level)
        self._said = set[str]()

    def emit(self, record: logging.LogRecord) -> None:
        if (line := record.getMessage()) not in self._said:
            self._said.add(line)
            note(line)


def print_notes() -> None:
    """Print what reading an arm or a recording logs as notes on stderr."""
    for name in ("armsight.robot", "armsight.loop.references"):
        logger = logging.getLogger(name)
        logger.handlers[:], logger.propagate = [_Notes(logging.WARNING)], False


def weak(text: str) -> str:
    """Return a line that says what is weak about a result."""
    return click.style(f"weak: {text}", fg="yellow")


def require(what: str, extra: str, *modules: str) -> None:
    """Check that packages can be imported, and name all that cannot at once."""
    missing = list[str]()
    for name in modules:
        try:
            importlib.import_module(name)
        except ModuleNotFoundError as error:
            missing.append(error.name or name)
        except (ImportError, OSError, AttributeError) as error:  # a library beneath is missing, or of another version
            raise InputError(f"{what} needs {name}, which is installed and cannot be imported: {error}") from None
    if missing:
        names, verb = " and ".join(missing), "is" if len(missing) == 1 else "are"
        raise InputError(f'{what} needs {names}, which {verb} not installed: pip install "armsight[{extra}]"')


def silence_stdout() -> None:
    """Discard what is printed from here on, and what is still buffered: nobody reads it any more."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
