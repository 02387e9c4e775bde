"""``armsight board offsets``: the zeros where an arm keeps them, corrected by what ``armsight identify`` found.

In: an identified arm or angles, and where the zeros are: register 31 of the servos of a bus, and LeRobot's calibration file
beside it; the ``joint_offsets`` file of ar4_ros_driver; the tables of the potentiometers on a board with our firmware. Out:
the same with other zeros, and a file of the old ones, written first; ``--restore`` writes that back.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from armsight.data import Array
from armsight.errors import InputError
from armsight.files import check_outputs, check_writable, read_json, read_text, write_text
from armsight.robot.boards.ar4.models import SENSE
from armsight.robot.boards.configuration import Configuration, check_configuration
from armsight.robot.boards.feetech.board import FeetechBoard
from armsight.robot.boards.feetech.calibration import read_calibration, write_offsets
from armsight.robot.boards.feetech.offsets import OffsetChange, corrected_offsets, require_released, write_changes
from armsight.robot.boards.feetech.registers import MOST_OFFSET, RAD_PER_COUNT
from armsight.robot.kinematics.arm import Arm

#: Zeros of joints that home, or have a potentiometer, are off by a few degrees; more looks like a mistake, degrees.
USUAL_CHANGE_DEG = 10.0
#: A line of a joint_offsets file of ar4_ros_driver.
_AR4_LINE = re.compile(r"(?m)^(?P<head>joint_(?P<joint>[1-6])[ \t]*:[ \t]*)(?P<value>[+-]?\d+(?:\.\d*)?)")


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
        kept = read_json(path)["homing_offsets"]
        wished = {int(id): int(value) for id, value in kept.items()}
    except (KeyError, TypeError, ValueError, AttributeError):
        raise InputError(f"{path}: not a file of old offsets that `armsight board offsets` kept") from None
    for id, value in wished.items():
        if abs(value) > MOST_OFFSET:
            raise InputError(
                f"{path}: the offset of id {id} is {value}; the register holds -{MOST_OFFSET} to {MOST_OFFSET}"
            )
    if set(wished) != set(board.calibration.ids):
        raise InputError(
            f"{path}: its offsets are of ids {sorted(wished)}, the arm's are {sorted(board.calibration.ids)}"
        )
    same = corrected_offsets(board.bus, board.calibration, np.zeros(len(board.calibration.ids)))
    changes = [each._replace(new=wished[each.id]) for each in same]
    require_released(board.bus, changes)
    return changes


class ZeroChange(NamedTuple):
    """The zero of a joint, where it is an angle.

    Attributes:
        name: of the joint.
        old_deg: as it is: what is added to the AR4's reported position, or the angle of a potentiometer's first node.
        new_deg: as it is to be.
    """

    name: str
    old_deg: float
    new_deg: float


def ar4_changes(path: Path, further_rad: Array) -> tuple[str, list[ZeroChange]]:
    """Return the text of a ``joint_offsets`` file of ar4_ros_driver with other offsets, and the changes.

    The driver's joint is at ``reported + offset``, in degrees; its joint 1 has the opposite sense of armsight's ``ar4``.

    Args:
        path: the file: joint_1: 170.0 and so on.
        further_rad: (6,) true angle less reported one of each joint of ``ar4``, rad.

    Raises:
        InputError: it is no such file, or another number of angles.
    """
    further_deg = _checked(further_rad, len(SENSE)) * SENSE
    changes: list[ZeroChange] = []

    def corrected(found: re.Match[str]) -> str:
        joint, old = int(found["joint"]), float(found["value"])
        new = round(old + float(np.degrees(further_deg[joint - 1])), 4)
        changes.append(ZeroChange(f"joint_{joint}", old, new))
        return f"{found['head']}{new!r}"

    text = _AR4_LINE.sub(corrected, read_text(path))
    if sorted(each.name for each in changes) != [f"joint_{k}" for k in range(1, len(SENSE) + 1)]:
        raise InputError(
            f"{path}: no joint_offsets of ar4_ros_driver: joint_1: to joint_6: are needed, once each, degrees"
        )
    return text, changes


def pot_changes(config: Configuration, further_rad: Array) -> list[ZeroChange]:
    """Shift the potentiometers' tables of a configuration by the angles (6,), rad, by which joints really are further.

    The soft limits go along: they stay where they are on the arm.

    Returns:
        The changes, by the first node of each.
    """
    further, changes = _checked(further_rad, len(config["joint"])), []
    for k, joint in enumerate(config["joint"]):
        pot, count = joint["pot"], int(joint["pot"]["node_count"])
        sign = int(pot["direction"])  # the board multiplies the table's angle by it
        old = float(np.degrees(sign * pot["angle_rad"][0]))
        pot["angle_rad"][:count] += sign * further[k]
        joint["soft_min_rad"] += further[k]  # the stops stay where they are
        joint["soft_max_rad"] += further[k]
        changes.append(ZeroChange(f"joint {k + 1}", old, float(np.degrees(sign * pot["angle_rad"][0]))))
    check_configuration(config)
    return changes


def zero_doubts(changes: list[ZeroChange]) -> list[str]:
    """Return why changes of zeros look like mistakes, a sentence each; none where they do not."""
    return [
        f"{c.name}: {abs(c.new_deg - c.old_deg):.1f} deg is more than zeros are usually off by, {USUAL_CHANGE_DEG:g} deg: a"
        " wrong number, radians or another arm, or an arm that was not homed"
        for c in changes
        if abs(c.new_deg - c.old_deg) > USUAL_CHANGE_DEG
    ]


def _checked(further_rad: Array, count: int) -> Array:
    further = np.asarray(further_rad, float)
    if further.shape != (count,):
        raise InputError(f"{count} corrections are needed, one a joint; {further.size} are given")
    if not np.isfinite(further).all():
        raise InputError("a correction is no finite number of degrees")
    return further


def keep_old(keep: Path, text: str) -> None:
    """Write what was there before into a new file.

    Raises:
        InputError: it exists, or cannot be written.
    """
    check_writable(keep)
    if keep.exists():
        raise InputError(f"{keep}: exists; old offsets are never written over: name another file with --keep")
    write_text(keep, text)


def zeros_json(changes: list[ZeroChange], written: bool) -> dict[str, Any]:
    """Return changes of angles as JSON has them."""
    return {"written": written, "joints": [each._asdict() for each in changes]}


def zeros_text(changes: list[ZeroChange]) -> str:
    """Return changes of angles as a table."""
    lines = [f"{'joint':16}{'old, deg':>12}{'new, deg':>12}{'change':>14}"]
    lines += [f"{c.name:16}{c.old_deg:12.4f}{c.new_deg:12.4f}{c.new_deg - c.old_deg:10.4f} deg" for c in changes]
    return "\n".join(lines)


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
    if calibration is not None:
        read_calibration(calibration)
        check_writable(calibration)
    old = {"homing_offsets": {str(each.id): each.old for each in changes}, "names": [each.name for each in changes]}
    keep_old(keep, json.dumps(old, indent=1) + "\n")
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
