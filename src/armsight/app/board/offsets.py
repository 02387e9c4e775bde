"""``armsight board offsets``: the homing offsets of a servo bus, corrected by what ``armsight identify`` found.

In: a bus, LeRobot's calibration file, and an identified arm or angles. Out: register 31 of each servo, LeRobot's file with
the same offsets, and a file of the old ones, written first; ``--restore`` writes that back.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from armsight.data import Array
from armsight.errors import InputError
from armsight.files import check_outputs, check_writable, read_text, write_text
from armsight.robot.arm import Arm
from armsight.robot.boards.feetech.board import FeetechBoard
from armsight.robot.boards.feetech.calibration import read_calibration, write_offsets
from armsight.robot.boards.feetech.offsets import OffsetChange, corrected_offsets, require_released, write_changes
from armsight.robot.boards.feetech.registers import MOST_OFFSET, RAD_PER_COUNT


def further_of(identified: Arm, nominal: Arm) -> Array:
    """Return by how much each joint really is further than it reports (n,), rad: the offsets that were identified.

    Raises:
        InputError: the two are different arms.
    """
    if len(identified.a) != len(nominal.a) or not np.array_equal(identified.direction, nominal.direction):
        raise InputError(f"{identified.name} and {nominal.name} are different arms: other joints, or other directions")
    further = (identified.offset - nominal.offset) * nominal.direction
    return np.asarray((further + np.pi) % (2 * np.pi) - np.pi)


def parsed_degrees(text: str) -> Array:
    """Return angles, rad, of a text such as 0.5,-1.2,0,0,0 in degrees.

    Raises:
        InputError: it is no list of numbers.
    """
    try:
        return np.radians([float(each) for each in text.split(",")])
    except ValueError:
        raise InputError(f"--further {text}: numbers of degrees with commas between are needed, one a joint") from None


def planned_changes(board: FeetechBoard, further_rad: Array) -> list[OffsetChange]:
    """Return the changes of the offsets, checked against the torques that are on; nothing is written."""
    changes = corrected_offsets(board.bus, board.calibration, further_rad)
    require_released(board.bus, changes)
    return changes


def restored_changes(board: FeetechBoard, path: Path) -> list[OffsetChange]:
    """Return the changes that bring back the offsets of a file that this command kept.

    Raises:
        InputError: it is no such file, or of another arm.
    """
    try:
        kept = json.loads(read_text(path))["homing_offsets"]
        wished = {int(id): int(value) for id, value in kept.items()}
    except (json.JSONDecodeError, KeyError, TypeError, ValueError, AttributeError):
        raise InputError(f"{path}: not a file of old offsets that `armsight board offsets` kept") from None
    if set(wished) != set(board.calibration.ids) or any(abs(value) > MOST_OFFSET for value in wished.values()):
        raise InputError(
            f"{path}: its offsets are of ids {sorted(wished)}, the arm's are {sorted(board.calibration.ids)}"
        )
    same = corrected_offsets(board.bus, board.calibration, np.zeros(len(board.calibration.ids)))
    changes = [each._replace(new=wished[each.id]) for each in same]
    require_released(board.bus, changes)
    return changes


def apply(board: FeetechBoard, changes: list[OffsetChange], keep: Path, calibration: Path | None) -> None:
    """Keep the old offsets in a file, write the new ones to the servos, and to LeRobot's file where there is one.

    Args:
        board: the servos, torque off.
        changes: what to write.
        keep: file for the old offsets; it must not exist.
        calibration: LeRobot's file; its new offsets are in it afterwards. None without.

    Raises:
        InputError: a file exists, or cannot be written; nothing was changed on the servos.
        DeviceError: a servo does not keep its offset; the old ones are back.
    """
    check_outputs([keep], [calibration])
    check_writable(keep)
    if keep.exists():
        raise InputError(f"{keep}: exists; old offsets are never written over: name another file with --keep")
    if calibration is not None:
        read_calibration(calibration)
        check_writable(calibration)
    old = {"homing_offsets": {str(each.id): each.old for each in changes}, "names": [each.name for each in changes]}
    write_text(keep, json.dumps(old, indent=1) + "\n")
    write_changes(board.bus, changes)
    if calibration is not None:
        write_offsets(calibration, calibration, {each.id: each.new for each in changes})


def changes_json(changes: list[OffsetChange], written: bool) -> dict[str, Any]:
    """Return the changes as JSON has them."""
    joints = [{"name": each.name, "id": each.id, "old_counts": each.old, "new_counts": each.new} for each in changes]
    return {"written": written, "joints": joints}


def changes_text(changes: list[OffsetChange]) -> str:
    """Return the changes as a table."""
    lines = [f"{'joint':16}{'id':>4}{'old':>8}{'new':>8}{'change':>12}"]
    for each in changes:
        degrees = np.degrees((each.new - each.old) * RAD_PER_COUNT)
        lines.append(f"{each.name:16}{each.id:4}{each.old:8}{each.new:8}{degrees:8.2f} deg")
    return "\n".join(lines)
