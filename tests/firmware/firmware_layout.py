"""The records and codes of the firmware's headers as ctypes, read from the headers so that they cannot drift apart."""

import ctypes
import re
from types import SimpleNamespace

from firmware_build import FIRMWARE

HEADERS = ("core/types.h", "core/config.h", "boards/pil/frame.h")
BASIC = {
    "float": ctypes.c_float,
    "uint32_t": ctypes.c_uint32,
    "uint16_t": ctypes.c_uint16,
    "uint8_t": ctypes.c_uint8,
    "int32_t": ctypes.c_int32,
}
HEADER = "".join((FIRMWARE / path).read_text(encoding="utf-8") for path in HEADERS)
HEADER = re.sub(r"/\*.*?\*/", "", HEADER, flags=re.DOTALL)
NUMBERS = {name: int(value, 0) for name, value in re.findall(r"#define (\w+) +(\d\w*)u *\n", HEADER)}


def _listed(which: str) -> dict[str, int]:
    body = re.search(rf"#define {which}_LIST\(X\)(.*?[^\\])\n", HEADER, flags=re.DOTALL)
    assert body
    return {name: int(code) for name, code in re.findall(r"X\((\w+), (\d+),", body[1])}


def _enumerated() -> dict[str, int]:
    bodies = re.findall(r"enum \{([^{}]*)\}", HEADER)
    return {name: int(value) for body in bodies for name, value in re.findall(r"(\w+) = (\d+)", body)}


def _records() -> dict[str, type[ctypes.Structure]]:
    known: dict[str, type] = dict(BASIC)
    for name, body in re.findall(r"typedef struct (\w+) \{(.*?)\}", HEADER, flags=re.DOTALL):
        fields = []
        for kind, field, length in re.findall(r"(\w+) (\w+)(?:\[(\w+)\])?;", body):
            fields.append((field, known[kind] * NUMBERS[length] if length else known[kind]))
        known[name] = type(name, (ctypes.Structure,), {"_fields_": fields})
    return {name: record for name, record in known.items() if name not in BASIC}


FAULTS, STATES, REJECTIONS = _listed("FAULT"), _listed("STATE"), _listed("REJECTION")
REACTIONS = dict(re.findall(r"X\((\w+), \d+, (RELEASE|HOLD|CHOSEN|YIELD|JOINT|SLEEP),", HEADER))
RECORDS = _records()

#: Records by name (``c.core_inputs``), numbers by name (``c.JOINTS``, ``c.COMMAND_MOVE``, ``c.FAULT_STALL``).
c = SimpleNamespace(
    **RECORDS,
    **NUMBERS,
    **_enumerated(),
    **{f"FAULT_{name}": code for name, code in FAULTS.items()},
    **{f"STATE_{name}": code for name, code in STATES.items()},
    **{f"REJECTION_{name}": code for name, code in REJECTIONS.items()},
)
