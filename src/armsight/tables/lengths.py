"""Numbers as any program writes them, and whether a length can be one.

The unit of a file is its author's, and a wrong one is a factor of 1000 in every result.
"""

from __future__ import annotations

import re
from typing import NamedTuple

from armsight.errors import InputError

#: Units that people write lengths in, m; in the order in which they are tried.
UNITS_M = {"mm": 1e-3, "m": 1.0, "cm": 1e-2, "inches": 0.0254}


class Usual(NamedTuple):
    """What a kind of length may be."""

    what: str  #: its name in messages: "baseline"
    least_m: float  #: m
    most_m: float  #: m


#: Two cameras that measure together; a stereo endoscope has 4 mm.
BASELINE = Usual("baseline", 1e-3, 20.0)  # half, double: none of the rigs of docs/measured.md is near either end
#: The farthest of the positions of an arm's flange, or of a target before cameras.
REACH = Usual("farthest position", 0.02, 20.0)  # half, double: likewise
#: A body of markers, or a field of them, along its longest side.
BODY = Usual("size of the body", 2e-3, 20.0)  # half, double: likewise


def fitting_unit(length_m: float, unit_m: float, usual: Usual) -> str | None:
    """Return the unit in which a length that cannot be one would be ordinary; None where it is, or none makes it so.

    Args:
        length_m: as it was read, m.
        unit_m: the unit that it was read in, m.
        usual: what it is of.
    """
    if usual.least_m <= length_m <= usual.most_m:
        return None
    return next(
        (name for name, other_m in UNITS_M.items() if usual.least_m <= length_m / unit_m * other_m <= usual.most_m),
        None,
    )


def check_length(length_m: float, unit_m: float, usual: Usual, advice: str = "--unit-m {unit_m:g}") -> None:
    """Reject a length that cannot be one.

    Args:
        length_m: as it was read, m.
        unit_m: the unit that it was read in, m.
        usual: what it is of.
        advice: the option that names the right unit; ``{unit_m}`` stands for it, m.

    Raises:
        InputError: what was found, what is expected, and the option that would do.
    """
    if usual.least_m <= length_m <= usual.most_m:
        return
    name = next((name for name, other_m in UNITS_M.items() if other_m == unit_m), f"units of {unit_m:g} m")
    found = f"{usual.what} {metric(length_m)}, with the file's lengths in {name}"
    expected = f"expected {metric(usual.least_m)} to {metric(usual.most_m)}"
    fits = fitting(length_m / unit_m, usual, f"give {advice}")
    raise InputError(f"{found}; {expected}{f'. {fits}' if fits else ': is the file damaged, or its unit another one?'}")


def fitting(length: float, usual: Usual, advice: str = "--unit-m {unit_m:g}") -> str:
    """Return what a length is in each unit in which it can be one, and the option; empty where it can be in none."""
    return ". ".join(
        f"If the file is in {unit}, it is {metric(length * m)}: {advice.format(unit_m=m)}"
        for unit, m in UNITS_M.items()
        if usual.least_m <= length * m <= usual.most_m
    )


def metric(length_m: float) -> str:
    """Return a length for people: mm below a metre, else m."""
    return f"{1e3 * length_m:.4g} mm" if length_m < 1 else f"{length_m:.4g} m"


#: A number in a pattern; Fortran's 1D-3 and the minus of a typesetter among them.
NUMBER = r"[+\-\u2212]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eEdD][+\-\u2212]?\d+)?"
_NUMBER = re.compile(NUMBER)


#: What stands where a number is missing, in small letters: pandas', SQL's and people's.
NO_NUMBER = ("", "nan", "null", "none", "na", "n/a", "<na>", "-", "--")


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
