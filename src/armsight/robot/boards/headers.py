"""What the firmware's headers say: its records as numpy has them, their ranges, its codes with their texts.

In: ``core/types.h``, ``core/config.h`` and ``boards/pil/frame.h`` of the C sources, which come with the package. Out: what
Python knows of them, so that it is written once. A record has a field a line, and the range of a number is the first
``LOW to HIGH`` of the field's comment.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Iterator

import numpy as np

from armsight.files import read_text
from armsight.firmware.build import source_folder

_KINDS = {"float": "<f4", "uint32_t": "<u4", "uint16_t": "<u2", "int32_t": "<i4", "uint8_t": "u1"}
_FIELD = re.compile(r"(?m)^    (\w+) (\w+)(?:\[(\w+)\])?;(.*)$")
_END = r"(-?[\d.]+(?:e-?\d+)?|[A-Z_]+(?: - 1)?)"
_RANGE = re.compile(rf"(?<!\S){_END} to {_END}")


@functools.cache
def _text() -> str:
    names = ("core/types.h", "core/config.h", "boards/pil/frame.h")
    return "\n".join(read_text(source_folder() / name) for name in names)


def _found(pattern: str) -> str:
    match = re.search(pattern, _text(), flags=re.DOTALL)
    assert match is not None, pattern
    return match[1]


def number(name: str) -> int:
    """Return what a name is defined as."""
    return int(_found(rf"#define {name} (\w+?)u?\s"), 0)


def _fields(record: str) -> Iterator[tuple[str, str, str, str]]:
    """Yield type, name, length and comment of each field of a record."""
    yield from _FIELD.findall(_found(rf"typedef struct {record} \{{\n(.*?)\}} {record};"))


@functools.cache
def record(name: str) -> np.dtype[np.void]:
    """Return a record as numpy has it."""
    listed = [(kind, field, (number(length),) if length else ()) for kind, field, length, _ in _fields(name)]
    return np.dtype([(field, _KINDS.get(kind) or record(kind), shape) for kind, field, shape in listed])


def ranges(name: str) -> dict[str, tuple[float, float]]:
    """Return the smallest and largest value of each number of a record that has a range."""
    found = {field: _RANGE.search(said) for _, field, length, said in _fields(name) if not length}
    return {field: (_value(match[1]), _value(match[2])) for field, match in found.items() if match}


def _value(text: str) -> float:
    name, less, _ = text.partition(" - ")
    return number(name) - bool(less) if name.isupper() else float(name)


def listed(name: str) -> dict[str, tuple[int, str]]:
    """Return the entries of a list of codes, FAULT_LIST and so on: name -> code and text."""
    body = _found(rf"#define {name}_LIST\(X\)(.*?[^\\])\n")
    return {each: (int(code), said) for each, code, said in re.findall(r'X\((\w+), (\d+),[^"]*"([^"]*)"\)', body)}
