"""The errors armsight raises: one root, few children.

A message says what was given, what is allowed and what to do; the command line prints it as one line and exits with
code 2. What is expected to go wrong now and then (a marker out of view) is a value, :class:`armsight.data.Missed`.
"""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches

#: Names that a message lists; of more, those that are spelt most alike. Half: a joint's six columns are not all shown;
#: double: lines of 300 characters.
_LISTED = 10


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


def nearest(name: object, known: Iterable[str]) -> str:
    """Return the known names as text; of many those nearest to an unknown one, and how many more there are."""
    names = list(known)
    if len(names) <= _LISTED:
        return ", ".join(names) or "none"
    near = get_close_matches(str(name), names, _LISTED // 2, 0.0)
    return f"{', '.join(near)} and {len(names) - len(near)} more"
