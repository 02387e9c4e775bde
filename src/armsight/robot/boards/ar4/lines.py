"""The lines of the AR4's Teensy: two letters, then values each behind its own letter from A on.

Source: ar4_ros_driver by Yizhou Cheng (github.com/ycheng517/ar4_ros_driver, MIT), firmware 2.1.0, ``AR4_teensy.ino``; every
line is in docs/reference/ar4.md. A line to the Teensy ends with LF, one from it with CR LF. Angles are degrees of the
encoders, without the offset of the joint's zero.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

JOINTS = 6
LETTERS = "ABCDEF"
_NUMBER = r"([+-]?\d+(?:\.\d+)?)"
_SIX = re.compile("".join(letter + _NUMBER for letter in LETTERS))
_START = re.compile(r"A([01])B([^C]*)C([01])D(.*)")
LONGEST = 200  # longest line, characters: six values of 13, and errors in words


class Heading(Enum):
    """The first two letters of a line from the Teensy."""

    START = "ST"
    POSITIONS = "JP"
    SPEEDS = "JV"
    HOMED = "JC"
    STOPPED = "ES"
    ERROR = "ER"
    WARNING = "WN"
    DEBUG = "DB"


@dataclass(frozen=True)
class Ar4Start:
    """Answer to the start."""

    version_matches: bool  #: whether the version that the host named is the firmware's
    version: str  #: the firmware's
    model_matches: bool  #: whether the firmware knows the model that the host named
    model: str  #: mk1, mk2 or mk3; empty before one was accepted


@dataclass(frozen=True)
class Ar4Values:
    """Six numbers: positions (degrees), speeds (degrees/s) or encoder counts at the limit switches."""

    heading: Heading  #: which of these
    values: tuple[float, ...]  #: joint by joint


@dataclass(frozen=True)
class Ar4Stopped:
    """Whether the emergency stop was pressed since the last reset."""

    pressed: bool


@dataclass(frozen=True)
class Ar4Text:
    """An error, a warning or a remark in words."""

    heading: Heading  #: which of these
    text: str  #: the words


Ar4Answer = Ar4Start | Ar4Values | Ar4Stopped | Ar4Text


#: What is asked: the joints' positions, their speeds, to reset the emergency stop where its button is out again.
POSITIONS, SPEEDS, RESET_STOP = b"JP\n", b"JV\n", b"RE\n"


def start(version: str, model: str) -> bytes:
    """Return the line that names the host's version and the arm's model; nothing else is answered before."""
    return f"STA{version}B{model}\n".encode("ascii")


def home(sequence: str) -> bytes:
    """Return the line that homes joints in groups: seven digits, how many at once, then the joints' numbers from 0."""
    return f"JC{sequence}\n".encode("ascii")


def move(values: Sequence[float], *, speeds: bool = False) -> bytes:
    """Return the line that moves six joints to positions, degrees of the encoders, or with speeds, degrees/s."""
    assert all(map(math.isfinite, values))
    six = "".join(f"{letter}{value:.6f}" for letter, value in zip(LETTERS, values, strict=True))
    return f"{'MV' if speeds else 'MT'}{six}\n".encode()


def read_line(line: str) -> Ar4Answer | None:
    """Return what a line from the Teensy says; None of one that is disturbed."""
    try:
        heading = Heading(line[:2])
    except ValueError:
        return None
    rest = line[2:]
    if heading is Heading.START:
        found = _START.fullmatch(rest)
        return found and Ar4Start(found[1] == "1", found[2], found[3] == "1", found[4])
    if heading is Heading.STOPPED:
        return Ar4Stopped(rest == "1") if rest in ("0", "1") else None
    if heading in (Heading.ERROR, Heading.WARNING, Heading.DEBUG):
        return Ar4Text(heading, rest.lstrip(": "))
    six = _SIX.fullmatch(rest)
    return six and Ar4Values(heading, tuple(map(float, six.groups())))


class LineReader:
    """Cuts a stream of bytes into lines of text; ``broken`` counts those that were none, or too long."""

    def __init__(self) -> None:
        self._data = bytearray()
        self.broken = 0

    def take(self, data: bytes) -> list[str]:
        """Return the lines that are complete with these bytes."""
        self._data += data
        *lines, rest = self._data.split(b"\n")
        self._data = bytearray(rest[-LONGEST - 1 :])  # one more than a line has: broken, whatever follows
        found = []
        for line in lines:
            if len(line) <= LONGEST and line.isascii():
                found.append(line.decode("ascii").strip("\r"))
            else:
                self.broken += 1
        return found

    def clear(self) -> None:
        """Drop an incomplete line."""
        self._data.clear()
