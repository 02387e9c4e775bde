"""A number as any program writes it."""

from __future__ import annotations

import re

#: A number in a pattern; Fortran's 1D-3 and the minus of a typesetter among them.
NUMBER = r"[+\-\u2212]?(?:\d+\.?\d*|\.\d+)(?:[eEdD][+\-\u2212]?\d+)?"
_NUMBER = re.compile(NUMBER)


def number(text: str) -> float | None:
    """Return a number; NaN and infinities too; None where it is none."""
    try:
        return float(text) if text.isascii() and "_" not in text else _unusual(text)
    except ValueError:
        return _unusual(text)


def _unusual(text: str) -> float | None:
    """Return a number that is not Python's."""
    text = text.strip()
    return float(re.sub("[dD]", "e", text.replace("\u2212", "-"))) if _NUMBER.fullmatch(text) else None
