"""Parse board specs such as ``chessboard:9x6:25mm``: counts, lengths with units, messages for malformed ones."""

from __future__ import annotations

import re
from dataclasses import dataclass

from armsight.errors import InputError

_UNITS_M = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 0.0254}
_NUMBER = r"[0-9]+(?:\.[0-9]*)?(?:e-?[0-9]+)?|\.[0-9]+"


@dataclass(frozen=True)
class Fields:
    """The fields of one board spec, read in order by their kind.

    Attributes:
        spec: the whole spec, for messages.
        form: the form it must have, up to the first space, then an explanation for messages.
        values: the texts between the colons after the kind.
    """

    spec: str
    form: str
    values: tuple[str, ...]

    def __post_init__(self) -> None:
        """Check how many fields there are."""
        if len(self.values) != self.form.split()[0].count(":"):
            raise self.error(f"has {len(self.values)} fields after its kind")

    def error(self, what: str) -> InputError:
        """Return the error of a spec that ``what`` is wrong with."""
        return InputError(f"board {self.spec!r} {what}; expected {self.form}")

    def counts(self, index: int, least: int) -> tuple[int, int]:
        """Read columns x rows, each at least ``least``."""
        text = self.values[index]
        match = re.fullmatch(r"([0-9]{1,4})[xX]([0-9]{1,4})", text)
        if not match:
            raise self.error(f"has {text!r} where columns x rows such as 9x6 belong")
        columns, rows = int(match[1]), int(match[2])
        if min(columns, rows) < least or columns * rows > 10_000:
            raise self.error(f"has {text}: each count must be {least} or more, and their product at most 10000")
        return columns, rows

    def length_m(self, index: int) -> float:
        """Read a length with its unit, m."""
        text = self.values[index]
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

    def ratio(self, index: int) -> float:
        """Read a plain positive number."""
        text = self.values[index]
        if not re.fullmatch(_NUMBER, text) or not 0 < float(text) < 100:
            raise self.error(f"has {text!r} where a ratio such as 0.3 belongs")
        return float(text)
