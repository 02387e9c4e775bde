"""Parse board specs such as ``chessboard:9x6:25mm``: counts, lengths with units, messages for malformed ones."""

from __future__ import annotations

import re
from dataclasses import dataclass

from armsight.errors import InputError

_UNITS_M = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 0.0254}
_NUMBER = r"[0-9]+(?:\.[0-9]*)?(?:e-?[0-9]+)?|\.[0-9]+"


@dataclass(frozen=True)
class Fields:
    """The fields of one board spec, read in order by their kind: ``values`` are the texts between the colons after it.

    ``form``: what it must look like, up to the first space, then an explanation for messages; ``[:OPTION...]`` at its
    end where options may follow.
    """

    spec: str
    form: str
    values: tuple[str, ...]

    def __post_init__(self) -> None:
        """Check how many fields there are."""
        if len(self.values) < self._count or (len(self.values) > self._count and "[" not in self.form):
            raise self.error(f"has {len(self.values)} field{'s' * (len(self.values) != 1)} after its kind")

    @property
    def _count(self) -> int:
        """How many fields there must be."""
        return self.form.split()[0].partition("[")[0].count(":")

    def options(self, *known: str) -> dict[str, str]:
        """Read what follows the fields: names, those known with a trailing ``=`` with values (``name=value``)."""
        found: dict[str, str] = {}
        for text in self.values[self._count :]:
            name, equals, value = text.partition("=")
            if name + equals not in known or name in found or (equals and not value):
                raise self.error(f"has {text!r} where an option ({', '.join(known)}), each once, belongs")
            found[name] = value
        return found

    def error(self, what: str) -> InputError:
        """Return the error of a spec that ``what`` is wrong with."""
        return InputError(f"board {self.spec!r} {what}; expected {self.form}")

    def counts(self, index: int, least: int) -> tuple[int, int]:
        """Read columns x rows, each at least ``least``."""
        columns, rows = self.pair(self.values[index], "columns x rows such as 9x6")
        if min(columns, rows) < least or columns * rows > 10_000:
            raise self.error(
                f"has {self.values[index]}: each count must be {least} or more, and their product at most 10000"
            )
        return columns, rows

    def pair(self, text: str, what: str) -> tuple[int, int]:
        """Read two whole numbers with an x between them."""
        match = re.fullmatch(r"([0-9]{1,4})[xX]([0-9]{1,4})", text)
        if not match:
            raise self.error(f"has {text!r} where {what} belong")
        return int(match[1]), int(match[2])

    def length_m(self, index: int) -> float:
        """Read a length with its unit, m."""
        return self.length_of(self.values[index])

    def length_of(self, text: str) -> float:
        """Convert a text such as 25mm to m."""
        match = re.fullmatch(rf"({_NUMBER})\s*([A-Za-z]*)", text)
        if not match:
            raise self.error(f"has {text!r} where a length such as 25mm belongs")
        if match[2] not in _UNITS_M:
            given = f"the unit {match[2]!r}" if match[2] else "no unit"
            raise self.error(f"has {given} in {text!r}: a length needs one of {', '.join(_UNITS_M)}")
        length = float(match[1]) * _UNITS_M[match[2]]
        if not 1e-5 <= length <= 2.0:
            raise self.error(f"has the length {text}, which is not between 0.01 mm and 2 m")
        return length

    def first(self, count: int, family: str, size: int) -> int:
        """Read the option ``first=ID``, the number of the first of ``count`` tags of a family of so many; 0 without it."""
        text = self.options("first=").get("first", "0")
        if not re.fullmatch("[0-9]{1,5}", text):
            raise self.error(f"has first={text} where the id of the first tag belongs")
        if int(text) + count > size:
            raise self.error(f"needs {count} tags from id {int(text)} on, and {family} has {size}")
        return int(text)

    def ratio(self, index: int) -> float:
        """Read a plain positive number."""
        text = self.values[index]
        if not re.fullmatch(_NUMBER, text) or not 0 < float(text) < 100:
            raise self.error(f"has {text!r} where a ratio such as 0.3 belongs")
        return float(text)


def first_id(first: int) -> str:
    """Return the option of a spec that says where a board's ids begin; empty for 0."""
    return f":first={first}" if first else ""
