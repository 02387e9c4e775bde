"""The lock-step frames of the emulated boards as numpy sees them: ``firmware/boards/pil/frame.h`` and ``core_outputs``.

A test reads the headers and holds the layouts to them.
"""

from __future__ import annotations

import struct

import numpy as np

JOINTS = 6
REQUEST_MAGIC, ANSWER_MAGIC, VERSION = 0x51525341, 0x4E415341, 3
#: What a request may do before its tick.
RESTART_POWER, RESTART_WATCHDOG = 1, 2
#: Most bytes of the wire either way in one tick.
WIRE_BYTES = 512

REQUEST = np.dtype(
    [
        ("magic", "<u4"),
        ("version", "<u4"),
        ("tick", "<u4"),
        ("restart", "<u4"),
        ("overrun", "<u4"),
        ("stop_pressed", "<u4"),
        ("supply_mv", "<u4"),
        ("counts", "<u4", JOINTS),
        ("current_ma", "<i4", JOINTS),
        ("length", "<u4"),
        ("bytes", "u1", WIRE_BYTES),
    ]
)
OUTPUTS = np.dtype(
    [
        ("tick", "<u4"),
        ("drives_on", "<u4"),
        ("windings_shorted", "<u4"),
        ("brakes_open", "<u4"),
        ("feed_watchdog", "<u4"),
        ("state", "<u4"),
        ("faults", "<u4"),
        ("joint_faults", "<u4", JOINTS),
        ("first_fault", "<u4"),
        ("first_joint", "<u4"),
        ("acknowledged_sequence", "<u4"),
        ("acknowledged_count", "<u4"),
        ("rejected_sequence", "<u4"),
        ("rejected_count", "<u4"),
        ("rejection", "<u4"),
        ("limited", "<u4", JOINTS),
        ("duty", "<f4", JOINTS),
        ("angle_rad", "<f4", JOINTS),
        ("speed_rad_s", "<f4", JOINTS),
        ("reference_rad", "<f4", JOINTS),
        ("reference_rad_s", "<f4", JOINTS),
    ]
)
ANSWER = np.dtype(
    [
        ("magic", "<u4"),
        ("version", "<u4"),
        ("tick", "<u4"),
        ("outputs", OUTPUTS),
        ("sync_led", "<u4"),
        ("length", "<u4"),
        ("bytes", "u1", WIRE_BYTES),
    ]
)


def _at(frame: np.dtype[np.void], name: str) -> int:
    """Return where a field lies in a frame, bytes."""
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
