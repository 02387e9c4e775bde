"""The errors armsight raises: one root, few children.

A message says what was given, what is allowed and what to do; the command line prints it as one line and exits with
code 2. What is expected to go wrong now and then (a marker out of view) is a value, :class:`armsight.data.Missed`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from difflib import get_close_matches

#: Names that a message lists, in their order; of more, those near what was given, NAMED at most. Half: the columns of a
#: table of poses are not all shown; double: lines of 300 characters.
_LISTED, NAMED = 15, 5


class ArmsightError(Exception):
    """Anything a user can correct; the message is the one line they read."""


class InputError(ArmsightError):
    """A file, an option or an array is not what it must be."""


class DeviceError(ArmsightError):
    """A camera, a stream or a board does not answer as it must."""


class CalibrationError(ArmsightError):
    """The recordings do not determine what was asked for."""


def require(call: str, name: str, value: object, fits: bool, expected: str) -> None:
    """Raise the InputError of an argument of a wrong type, which names what opens a right one."""
    if not fits:
        raise InputError(f"{call}: {name} is a {type(value).__name__}; expected {expected}")


@contextmanager
def naming(where: object) -> Iterator[None]:
    """Put the name of a file, or of a part of it, before any error about its content."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


@contextmanager
def noted(notes: Sequence[str]) -> Iterator[None]:
    """Add what was found while data were read to the errors of a block: it is often their cause."""
    try:
        yield
    except ArmsightError as error:
        if notes:
            error.args = (f"{error} ({'; '.join(notes)})",)
        raise


def some(names: Iterable[object]) -> str:
    """Return names as text, of many the first few and how many more there are."""
    listed = list(map(str, names))
    more = f" and {len(listed) - NAMED} more" if len(listed) > NAMED else ""
    return ", ".join(listed[:NAMED]) + more


def nearest(name: object, known: Iterable[str]) -> str:
    """Return the known names as text: of many those that begin so or are spelt alike, else the first; how many more."""
    names, text = list(known), str(name)
    if len(names) <= _LISTED:
        return ", ".join(names) or "none"
    near = [each for each in names if text and each.startswith(text)][:NAMED] or get_close_matches(text, names, NAMED)
    listed = near or names[:_LISTED]
    return f"{', '.join(listed)} and {len(names) - len(listed)} more"
