"""LeRobot's calibration file of an SO-100 or SO-101: which counts are which joint angles.

In: the JSON that ``lerobot-calibrate`` writes: by joint name ``id``, ``drive_mode``, ``homing_offset``, ``range_min``,
``range_max``. Out: :class:`ServoCalibration`. A joint is at 0 in the middle of its range, as LeRobot has it in degrees
(``motors_bus.py``, ``MotorNormMode.DEGREES``) and the SO-101's URDF; a count is 360/4096 degree, which LeRobot takes as
360/4095. The gripper is left out: it is no joint of the arm.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from armsight.data import Array, Record
from armsight.errors import InputError
from armsight.files import read_json, write_text
from armsight.robot.boards.feetech.registers import COUNTS, MIDDLE, MOST_OFFSET, RAD_PER_COUNT
from armsight.tables.columns import LEROBOT

#: The joints of an SO-100 or SO-101 from the base on; ids 1 to 5.
NAMES = LEROBOT
GRIPPER = "gripper"
_FIELDS = {"id": (0, 253), "drive_mode": (0, 0), "homing_offset": (-MOST_OFFSET, MOST_OFFSET)}
_FIELDS |= {"range_min": (0, COUNTS - 1), "range_max": (0, COUNTS - 1)}


@dataclass(frozen=True, eq=False)
class ServoCalibration(Record):
    """Which servo drives which joint, and at which counts."""

    names: tuple[str, ...]  #: (n,) of the joints, from the base on
    ids: tuple[int, ...]  #: (n,) of their servos
    middle: Array  #: (n,) counts at 0 rad
    lowest: Array  #: (n,) counts that a joint must not go below
    highest: Array  #: (n,) counts that it must not exceed
    #: (n,) homing offsets that the counts were taken with; None where nobody says
    offsets: tuple[int, ...] | None = None

    def angles(self, counts: Array) -> Array:
        """Return joint angles (..., n), rad, of counts."""
        return (np.asarray(counts, float) - self.middle) * RAD_PER_COUNT

    def counts(self, q: Array) -> Array:
        """Return counts (..., n), whole ones, of joint angles, rad."""
        return np.round(np.asarray(q, float) / RAD_PER_COUNT + self.middle)


def uncalibrated(lowest: Array, highest: Array) -> ServoCalibration:
    """Return the calibration of an arm without a file: 0 is count 2048, the limits are the servos' own, counts (5,)."""
    count = len(NAMES)
    return ServoCalibration(NAMES, tuple(range(1, count + 1)), np.full(count, float(MIDDLE)), lowest, highest)


def read_calibration(path: str | Path) -> ServoCalibration:
    """Read LeRobot's calibration file; InputError says which joint and which number."""
    entries = _entries(path)
    names = tuple(name for name in entries if name != GRIPPER)
    rows = [_row(path, name, entries[name]) for name in names]
    ids = [row["id"] for row in rows]
    if doubled := {id for id in ids if ids.count(id) > 1}:
        raise InputError(f"{path}: id {min(doubled)} stands twice; each servo has its own")
    order = np.argsort(ids)
    rows, names = [rows[k] for k in order], tuple(names[k] for k in order)
    lowest, highest = (np.array([row[field] for row in rows], float) for field in ("range_min", "range_max"))
    for name, low, high in zip(names, lowest, highest, strict=True):
        if low >= high:
            raise InputError(f"{path}: {name}: range_min {low:.0f} is not below range_max {high:.0f}")
    return ServoCalibration(
        names,
        tuple(row["id"] for row in rows),
        (lowest + highest) / 2,
        lowest,
        highest,
        tuple(row["homing_offset"] for row in rows),
    )


def write_offsets(path: str | Path, source: str | Path, offsets: dict[int, int]) -> None:
    """Write a calibration file with other homing offsets, by id of the servo, everything else as in LeRobot's ``source``.

    InputError: the source is none, an offset is none that a servo holds, or the file cannot be written.
    """
    read_calibration(source)
    entries = _entries(source)
    for name, entry in entries.items():
        entry["homing_offset"] = offsets.get(entry["id"], entry["homing_offset"])
        if name != GRIPPER:
            _row(path, name, entry)
    write_text(path, json.dumps(entries, indent=4) + "\n")


def _entries(path: str | Path) -> dict[str, dict[str, Any]]:
    entries = read_json(path)
    if not isinstance(entries, dict) or not all(isinstance(each, dict) for each in entries.values()):
        raise InputError(f"{path}: no calibration of LeRobot: an object of joints is needed, each with id and range")
    if not set(entries) - {GRIPPER}:
        raise InputError(f"{path}: has no joint")
    return entries


def _row(path: str | Path, name: str, entry: dict[str, Any]) -> dict[str, int]:
    for field, (low, high) in _FIELDS.items():
        value = entry.get(field)
        if type(value) is not int:
            raise InputError(
                f"{path}: {name}: {field} is {value!r}; a whole number is needed, as lerobot-calibrate writes it"
            )
        if not low <= value <= high:
            allowed = "0 (LeRobot itself ignores 1 in degrees)" if low == high else f"{low} to {high}"
            raise InputError(f"{path}: {name}: {field} is {value}; allowed is {allowed}")
    return {field: entry[field] for field in _FIELDS}
