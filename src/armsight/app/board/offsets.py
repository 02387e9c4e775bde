"""``armsight board offsets``: the zeros where an arm keeps them, corrected by what ``armsight identify`` found.

In: an identified arm or angles, and where the zeros are: register 31 of the servos of a bus, and LeRobot's calibration file
beside it; the ``joint_offsets`` file of ar4_ros_driver; the tables of the potentiometers on a board with our firmware. Out:
the same with other zeros, and a file of the old ones, written first; ``--restore`` writes that back.

Each of the three is a :class:`Zeros`: what would change, what looks like a mistake in it, how it is shown and written.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from armsight.data import Array
from armsight.errors import InputError
from armsight.files import check_outputs, check_writable, read_json, read_text, write_text
from armsight.robot.boards.ar4.models import SENSE
from armsight.robot.boards.board import Board
from armsight.robot.boards.board_file import configuration_text, read_configuration
from armsight.robot.boards.configuration import JOINTS, Configuration, check_configuration
from armsight.robot.boards.feetech.board import FeetechBoard
from armsight.robot.boards.feetech.calibration import read_calibration, write_offsets
from armsight.robot.boards.feetech.offsets import (
    OffsetChange,
    corrected_offsets,
    doubts,
    require_released,
    write_changes,
)
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


class Zeros(Protocol):
    """Where an arm keeps its zeros, with what would be written: by angles, or of a file of old zeros."""

    question: str
    doubts: list[str]

    def json(self) -> list[dict[str, Any]]:
        """Return the changes, a joint each."""
        ...

    def text(self) -> str:
        """Return the changes as a table."""
        ...

    def write(self, keep: Path) -> None:
        """Keep the old zeros in a new file, then write the new ones."""
        ...


class ZeroChange(NamedTuple):
    """The zero of a joint, where it is an angle."""

    name: str  #: of the joint
    old_deg: float  #: what is added to the AR4's reported position, or the angle of a potentiometer's first node
    new_deg: float  #: what it is to be


class _Angles:
    """Zeros that are angles."""

    question = "write the new zeros?"

    def __init__(self, changes: list[ZeroChange], restored: list[ZeroChange] | None) -> None:
        """Take what is as it is to be; of old zeros that come back, large changes are no mistakes."""
        self.changes = changes
        if restored is not None:
            self.changes = [old._replace(new_deg=new.new_deg) for old, new in zip(changes, restored, strict=True)]
        off = {} if restored is not None else {c.name: abs(c.new_deg - c.old_deg) for c in changes}
        self.doubts = [
            f"{name}: {by:.1f} deg is more than zeros are usually off by, {USUAL_CHANGE_DEG:g} deg: a wrong number,"
            " radians or another arm, or an arm that was not homed"
            for name, by in off.items()
            if by > USUAL_CHANGE_DEG
        ]

    def json(self) -> list[dict[str, Any]]:
        return [each._asdict() for each in self.changes]

    def text(self) -> str:
        lines = [f"{'joint':16}{'old, deg':>12}{'new, deg':>12}{'change':>14}"]
        lines += [
            f"{c.name:16}{c.old_deg:12.4f}{c.new_deg:12.4f}{c.new_deg - c.old_deg:10.4f} deg" for c in self.changes
        ]
        return "\n".join(lines)


class Ar4Zeros(_Angles):
    """The zeros of a ``joint_offsets`` file of ar4_ros_driver.

    Args:
        file: joint_1: 170.0 and so on.
        further_rad: (6,) true angle less reported one of each joint of ``ar4``; zeros without.
        restore: file of the old ones.
    """

    def __init__(self, file: Path, further_rad: Array | None, restore: Path | None, keep: Path) -> None:
        check_outputs([keep], [file, restore])
        check_writable(file)
        self._file = file
        self._text, changes = ar4_changes(file, np.zeros(len(SENSE)) if further_rad is None else further_rad)
        restored = None
        if restore is not None:
            self._text, restored = ar4_changes(restore, np.zeros(len(SENSE)))
            restored = [next(new for new in restored if new.name == old.name) for old in changes]
        super().__init__(changes, restored)

    def write(self, keep: Path) -> None:
        """Keep the old file, and write the new one."""
        keep_old(keep, read_text(self._file))
        write_text(self._file, self._text)


class PotZeros(_Angles):
    """The zeros of the potentiometers of a board with our firmware: see :class:`Ar4Zeros`."""

    def __init__(self, board: Board, further_rad: Array | None, restore: Path | None) -> None:
        self._board, self._new = board, board.configuration()
        self._old = configuration_text(self._new, board.welcome.board)
        changes, restored = pot_changes(self._new, np.zeros(JOINTS) if further_rad is None else further_rad), None
        if restore is not None:
            self._new = read_configuration(restore)[0]
            restored = pot_changes(self._new, np.zeros(JOINTS))
        super().__init__(changes, restored)

    def write(self, keep: Path) -> None:
        """Keep the old configuration, and store the new one."""
        keep_old(keep, self._old)
        self._board.store(self._new)


@dataclass
class ServoZeros:
    """The homing offsets of the servos of a bus, and of LeRobot's file where there is one."""

    board: FeetechBoard
    changes: list[OffsetChange]
    doubts: list[str]
    calibration: Path | None
    question: str = "write the new offsets to the servos?"

    @classmethod
    def of(
        cls, board: FeetechBoard, further_rad: Array | None, restore: Path | None, calibration: Path | None
    ) -> ServoZeros:
        """Return what changes, checked against the torques that are on; nothing is written.

        Raises:
            InputError: a correction that is none, or no file that this command kept, or one of another arm.
        """
        none, said = np.zeros(board.abilities.joints), list[str]()
        changes = corrected_offsets(board.bus, board.calibration, none if further_rad is None else further_rad)
        if restore is not None:
            wished = _kept_offsets(board, restore)
            changes = [each._replace(new=wished[each.id]) for each in changes]
        else:
            said = doubts(changes, board.calibration)
        require_released(board.bus, changes)
        return cls(board, changes, said, calibration)

    def json(self) -> list[dict[str, Any]]:
        """Return the changes, a joint each."""
        return [{"name": c.name, "id": c.id, "old_counts": c.old, "new_counts": c.new} for c in self.changes]

    def text(self) -> str:
        """Return the changes as a table."""
        lines = [f"{'joint':16}{'id':>4}{'old':>8}{'new':>8}{'change':>12}"]
        for c in self.changes:
            lines.append(f"{c.name:16}{c.id:4}{c.old:8}{c.new:8}{np.degrees((c.new - c.old) * RAD_PER_COUNT):8.2f} deg")
        return "\n".join(lines)

    def write(self, keep: Path) -> None:
        """Keep the old offsets, write the new ones to the servos, and to LeRobot's file.

        Raises:
            InputError: a file exists, or cannot be written; nothing was changed on the servos.
            DeviceError: a servo does not keep its offset; the old ones are back.
        """
        check_outputs([keep], [self.calibration])
        if self.calibration is not None:
            read_calibration(self.calibration)
            check_writable(self.calibration)
        old = {"homing_offsets": {str(c.id): c.old for c in self.changes}, "names": [c.name for c in self.changes]}
        keep_old(keep, json.dumps(old, indent=1) + "\n")
        write_changes(self.board.bus, self.changes)
        if self.calibration is not None:
            write_offsets(self.calibration, self.calibration, {c.id: c.new for c in self.changes})


def _kept_offsets(board: FeetechBoard, path: Path) -> dict[int, int]:
    """Return the offsets of a file that this command kept, by id."""
    try:
        wished = {int(id): int(value) for id, value in read_json(path)["homing_offsets"].items()}
    except (KeyError, TypeError, ValueError, AttributeError):
        raise InputError(f"{path}: not a file of old offsets that `armsight board offsets` kept") from None
    for id, value in wished.items():
        if abs(value) > MOST_OFFSET:
            holds = f"the register holds -{MOST_OFFSET} to {MOST_OFFSET}"
            raise InputError(f"{path}: the offset of id {id} is {value}; {holds}")
    if set(wished) != set(board.calibration.ids):
        raise InputError(
            f"{path}: its offsets are of ids {sorted(wished)}, the arm's are {sorted(board.calibration.ids)}"
        )
    return wished


def ar4_changes(path: Path, further_rad: Array) -> tuple[str, list[ZeroChange]]:
    """Return the text of a ``joint_offsets`` file of ar4_ros_driver with other offsets, and the changes.

    The driver's joint is at ``reported + offset``, in degrees; its joint 1 has the opposite sense of armsight's ``ar4``.

    Raises:
        InputError: it is no such file, or another number of angles (6,), rad.
    """
    further_deg = np.degrees(_checked(further_rad, len(SENSE)) * SENSE)
    changes: list[ZeroChange] = []

    def corrected(found: re.Match[str]) -> str:
        joint, old = int(found["joint"]), float(found["value"])
        changes.append(ZeroChange(f"joint_{joint}", old, round(old + float(further_deg[joint - 1]), 4)))
        return f"{found['head']}{changes[-1].new_deg!r}"

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
