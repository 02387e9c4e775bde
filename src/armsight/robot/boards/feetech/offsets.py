"""The homing offsets on the servos (register 31): what is there, what a correction makes of it, and writing it.

A servo reports ``actual - offset``. A joint that really is further by an angle than it reports needs an offset that is
smaller by as many counts. The register holds -2047 to 2047. The torque must be off: an offset that changes under torque
moves the joint. What looks like a mistake is said first (:func:`doubts`): a correction larger than a tooth of the horn, or
a count that would jump within the joint's travel.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from armsight.data import Array
from armsight.errors import InputError
from armsight.robot.boards.feetech.bus import ServoBus
from armsight.robot.boards.feetech.calibration import ServoCalibration
from armsight.robot.boards.feetech.registers import COUNTS, HOMING_OFFSET, MOST_OFFSET, RAD_PER_COUNT, TORQUE

#: The horn's teeth: a joint's zero is off by less than one, unless the horn is mounted wrongly; and in counts.
HORN_TEETH = 25
TOOTH_COUNTS = COUNTS / HORN_TEETH
SPARE_COUNTS = 23  # counts that are to be left to the end of the register: two degrees, for the next correction


class OffsetChange(NamedTuple):
    """The homing offset of a joint."""

    name: str  #: of the joint
    id: int  #: of its servo
    old: int  #: what its register holds, counts
    new: int  #: what it is to hold


def corrected_offsets(bus: ServoBus, calibration: ServoCalibration, further_rad: Array) -> list[OffsetChange]:
    """Return the offsets that make joints report what they really are at; nothing is written.

    ``calibration``: which servo drives which joint; ``further_rad``: (n,) true angle less reported one of each joint, rad.
    Raises InputError: a correction that is no number, or one that the register does not hold; DeviceError: a servo does not
    answer.
    """
    further = np.asarray(further_rad, float)
    count = len(calibration.ids)
    if further.shape != (count,) or not np.isfinite(further).all():
        raise InputError(f"{count} corrections are needed, one a joint ({', '.join(calibration.names)})")
    changes = []
    for name, id, angle in zip(calibration.names, calibration.ids, further.tolist(), strict=True):
        old = bus.read(id, HOMING_OFFSET)
        new = old - round(angle / RAD_PER_COUNT)
        if abs(new) > MOST_OFFSET:
            raise InputError(
                f"{name} (id {id}): its offset would be {new}; the register holds -{MOST_OFFSET} to {MOST_OFFSET}: mount"
                " the horn by some teeth further round, and calibrate anew"
            )
        changes.append(OffsetChange(name, id, old, new))
    return changes


def doubts(changes: list[OffsetChange], calibration: ServoCalibration) -> list[str]:
    """Return why changes look like mistakes, a sentence each; none where they do not.

    ``changes``: of the offsets. ``calibration``: the ranges of the joints, counts. One that has the whole revolution has no
    ends that are known.
    """
    said = []
    for change in changes:
        lower, of = change.old - change.new, f"{change.name} (id {change.id})"  # by so many counts it reports more
        row = calibration.ids.index(change.id)
        low, high = calibration.lowest[row], calibration.highest[row]
        if abs(lower) > TOOTH_COUNTS:
            said.append(
                f"{of}: {np.degrees(lower * RAD_PER_COUNT):.1f} deg is more than a tooth of the horn"
                f" ({360 / HORN_TEETH:.1f} deg): a wrong number, or a horn to be mounted anew"
            )
        elif abs(change.new) > max(abs(change.old), MOST_OFFSET - SPARE_COUNTS):
            said.append(
                f"{of}: its offset {change.new} is at the end of what the register holds, -{MOST_OFFSET} to {MOST_OFFSET}:"
                " mount the horn by some teeth further round, and calibrate anew"
            )
        if lower and high - low < COUNTS - 1 and not 0 <= low + lower <= high + lower <= COUNTS - 1:
            end, where = (low, "lower") if low + lower < 0 else (high, "upper")
            said.append(
                f"{of}: its {where} end would be at count {end + lower:.0f}; counts are 0 to {COUNTS - 1}, and its reading"
                " would jump by a revolution there"
            )
    return said


def require_released(bus: ServoBus, changes: list[OffsetChange]) -> None:
    """Raise an InputError if the torque of a servo whose offset changes is on."""
    for change in changes:
        if change.new != change.old and bus.read(change.id, TORQUE):
            raise InputError(
                f"{bus.name}: the torque of {change.name} (id {change.id}) is on; support the arm, then"
                " `armsight board release`"
            )


def write_changes(bus: ServoBus, changes: list[OffsetChange]) -> None:
    """Write the offsets that change, and read each back; where one fails, those before it get their old values again.

    Raises InputError: a torque is on; nothing was written. DeviceError: a servo does not answer, or does not keep the
    value.
    """
    require_released(bus, changes)
    written: list[OffsetChange] = []
    try:
        for change in changes:
            if change.new != change.old:
                written.append(change)
                bus.unlocked_write(change.id, HOMING_OFFSET, change.new)
    except BaseException:
        for change in reversed(written):
            bus.unlocked_write(change.id, HOMING_OFFSET, change.old)
        raise
