"""The lock-step frames of the emulated boards as numpy sees them, as ``firmware/boards/pil/frame.h`` has them."""

from __future__ import annotations

import struct

import numpy as np

from armsight.robot.boards import headers

JOINTS, WIRE_BYTES = headers.number("JOINTS"), headers.number("FRAME_BYTES")  # most bytes either way in one tick
REQUEST_MAGIC, ANSWER_MAGIC, VERSION = (headers.number(f"FRAME_{name}") for name in ("REQUEST", "ANSWER", "VERSION"))
#: What a request may do before its tick.
RESTART_POWER, RESTART_WATCHDOG = 1, 2
REQUEST, OUTPUTS, ANSWER = (headers.record(name) for name in ("pil_request", "core_outputs", "pil_answer"))


def _at(frame: np.dtype[np.void], name: str) -> int:
    fields = frame.fields
    assert fields is not None
    return int(fields[name][1])


#: The same frames for the tick itself, where a structured array costs more than the rest: a request whole, its arrays one
#: after the other, and of an answer what every tick needs: magic, version, tick, whether the
#: drives are on, the windings shorted and the brakes open, the sync LED, how many bytes.
REQUEST_FIELDS = struct.Struct(f"<7I{JOINTS}I{JOINTS}iI{WIRE_BYTES}s")
_DRIVES_AT, _LED_AT = _at(ANSWER, "outputs") + _at(OUTPUTS, "drives_on"), _at(ANSWER, "sync_led")
ANSWER_FIELDS = struct.Struct(f"<3I{_DRIVES_AT - 12}x3I{_LED_AT - _DRIVES_AT - 12}x2I")
#: Where an answer has the duties, six little-endian floats, and what is said.
DUTY_AT, BYTES_AT = _at(ANSWER, "outputs") + _at(OUTPUTS, "duty"), _at(ANSWER, "bytes")
