"""``armsight board offsets``: the zeros where an arm keeps them, corrected by what ``armsight identify`` found.

The zeros are in register 31 of the servos of a bus, and LeRobot's calibration file beside it; in the ``joint_offsets`` file
of ar4_ros_driver; in the tables of the potentiometers on a board with our firmware: each is :class:`Zeros`. The old ones
are written to a file first; ``--restore`` writes that back.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np

from armsight.data import Array
from armsight.errors import InputError
from armsight.files import as_input_error, check_outputs, check_writable, read_json, read_text, read_toml, write_text
from armsight.loop.identify.corrected import open_corrected
from armsight.robot.arm_file import open_arm
from armsight.robot.boards.ar4.models import SENSE
from armsight.robot.boards.board import Board
from armsight.robot.boards.board_file import configuration_text, read_configuration
from armsight.robot.boards.codes import Command
from armsight.robot.boards.configuration import JOINTS, Configuration, check_configuration
from armsight.robot.boards.feetech.board import FeetechBoard
from armsight.robot.boards.feetech.calibration import read_calibration, write_offsets
from armsight.robot.boards.feetech.offsets import corrected_offsets, doubts, require_released, write_changes
from armsight.robot.boards.feetech.registers import MOST_OFFSET, RAD_PER_COUNT, TORQUE
from armsight.robot.kinematics.arm import Arm

#: Zeros of joints that home, or have a potentiometer, are off by a few degrees; more looks like a mistake, degrees.
USUAL_CHANGE_DEG = 10.0
#: Tables of one arm under two names, such as its URDF's, differ by less, m and rad. Half: an arm without nominal table that
#: is off by 6 mm counts as another; double: a UR3 and its UR3e count as one.
_SAME = 0.01
#: A line of a joint_offsets file of ar4_ros_driver.
_AR4_LINE = re.compile(r"(?m)^(?P<head>joint_(?P<joint>[1-6])[ \t]*:[ \t]*)(?P<value>[+-]?\d+(?:\.\d*)?)")


def further_of(identified: str, nominal: Arm) -> Array:
    """Return by how much each joint really is further than it reports (n,), rad: the offsets that were identified.

    Those of a corrected.toml stand beside the angles beta of parallel axes: as an arm without them, it would have others.
    """
    if Path(identified).is_file() and "identified" in read_toml(Path(identified)):
        found = open_corrected(identified)
        arm, zeros = found.model.arm, found.zeros_rad()
    else:
        arm, zeros = open_arm(identified), None
    if len(arm.a) != len(nominal.a) or not np.array_equal(arm.direction, nominal.direction):
        raise InputError(f"{arm.name} and {nominal.name} are different arms: other joints, or other directions")
    same = all(np.allclose(getattr(arm, k), getattr(nominal, k), atol=_SAME) for k in ("a", "d", "alpha"))
    if arm.name != nominal.name and not same:
        raise InputError(f"{identified} is of {arm.name}, not {nominal.name}: give --arm as in identify")
    further = (arm.offset - nominal.offset) * nominal.direction if zeros is None else zeros
    return np.asarray((further + np.pi) % (2 * np.pi) - np.pi)


def parsed_degrees(text: str) -> Array:
    """Return angles, rad, of a text such as 0.5,-1.2,0,0,0 in degrees."""
    with as_input_error(f"--further {text}: expected numbers of degrees with commas between, one a joint", ValueError):
        return np.radians([float(each) for each in text.split(",")])


@dataclass(frozen=True)
class Zeros:
    """The zeros where an arm keeps them, and what would be written there."""

    question: str  #: before it is written
    json: list[dict[str, Any]]  #: the changes, a joint each
    text: str  #: the same as a table
    doubts: list[str]  #: what looks like a mistake, a sentence each
    write: Callable[[Path], None]  #: keeps the old ones in a new file, then writes the new ones


class ZeroChange(NamedTuple):
    """The zero of a joint, where it is an angle."""

    name: str  #: of the joint
    old_deg: float  #: what is added to the AR4's reported position, or the angle of a potentiometer's first node
    new_deg: float  #: what it is to be


def _of_angles(changes: list[ZeroChange], restored: bool, write: Callable[[Path], None]) -> Zeros:
    """Return zeros that are angles; of old ones that come back, large changes are no mistakes."""
    lines = [f"{'joint':16}{'old, deg':>12}{'new, deg':>12}{'change':>14}"]
    lines += [f"{c.name:16}{c.old_deg:12.4f}{c.new_deg:12.4f}{c.new_deg - c.old_deg:10.4f} deg" for c in changes]
    said = [
        f"{c.name}: {abs(c.new_deg - c.old_deg):.1f} deg is more than zeros are usually off by, {USUAL_CHANGE_DEG:g} deg:"
        " a wrong number, radians or another arm, or an arm that was not homed"
        for c in changes
        if not restored and abs(c.new_deg - c.old_deg) > USUAL_CHANGE_DEG
    ]
    return Zeros("write the new zeros?", [c._asdict() for c in changes], "\n".join(lines), said, write)


def ar4_zeros(file: Path, further_rad: Array | None, restore: Path | None, keep: Path) -> Zeros:
    """Return the zeros of a ``joint_offsets`` file of ar4_ros_driver: corrected (6,), rad, or of a file that was kept."""
    check_outputs([keep], [file, restore])
    check_writable(file)
    none = np.zeros(len(SENSE))
    text, changes = ar4_changes(file, none if further_rad is None else further_rad)
    if restore is not None:
        text, new = ar4_changes(restore, none)
        deg = {each.name: each.new_deg for each in new}
        changes = [each._replace(new_deg=deg[each.name]) for each in changes]

    def write(keep: Path) -> None:
        keep_old(keep, read_text(file))
        write_text(file, text)

    return _of_angles(changes, restore is not None, write)


def pot_zeros(board: Board, further_rad: Array | None, restore: Path | None) -> Zeros:
    """Return the zeros of the potentiometers of a board with our firmware: corrected (6,), rad, or of a file."""
    config, none = board.configuration(), np.zeros(JOINTS)
    old = configuration_text(config, board.welcome.board)
    changes = pot_changes(config, none if further_rad is None else further_rad)
    if restore is not None:
        config = read_configuration(restore)[0]
        new = pot_changes(config, none)
        changes = [a._replace(new_deg=b.new_deg) for a, b in zip(changes, new, strict=True)]

    def write(keep: Path) -> None:
        keep_old(keep, old)
        board.store(config)

    return _of_angles(changes, restore is not None, write)


def offer_release(board: FeetechBoard, *, changes: bool, yes: bool) -> None:
    """Switch the drives off after asking, if a torque is on where zeros change; with ``yes`` nobody can be asked."""
    if changes and not yes and any(board.bus.read(id, TORQUE) for id in board.calibration.ids):
        click.confirm("the drives are on, and off the arm sinks: is it supported?", abort=True, err=True)
        board.confirm(board.command(Command.DISABLE))


def servo_zeros(board: FeetechBoard, further_rad: Array | None, restore: Path | None, lerobot: Path | None) -> Zeros:
    """Return the homing offsets of the servos of a bus, and of LeRobot's file where there is one; torques must be off."""
    none, bus = np.zeros(board.abilities.joints), board.bus
    changes = corrected_offsets(bus, board.calibration, none if further_rad is None else further_rad)
    said = doubts(changes, board.calibration) if restore is None else []
    if restore is not None:
        wished = _kept_offsets(board, restore)
        changes = [each._replace(new=wished[each.id]) for each in changes]
    require_released(bus, changes)

    def write(keep: Path) -> None:
        check_outputs([keep], [lerobot])
        if lerobot is not None:
            read_calibration(lerobot)
            check_writable(lerobot)
        old = {"homing_offsets": {str(c.id): c.old for c in changes}, "names": [c.name for c in changes]}
        keep_old(keep, json.dumps(old, indent=1) + "\n")
        write_changes(bus, changes)
        if lerobot is not None:
            write_offsets(lerobot, lerobot, {c.id: c.new for c in changes})

    deg, lines = np.degrees(RAD_PER_COUNT), [f"{'joint':16}{'id':>4}{'old':>8}{'new':>8}{'change':>12}"]
    lines += [f"{c.name:16}{c.id:4}{c.old:8}{c.new:8}{deg * (c.new - c.old):8.2f} deg" for c in changes]
    shown = [{"name": c.name, "id": c.id, "old_counts": c.old, "new_counts": c.new} for c in changes]
    return Zeros("write the new offsets to the servos?", shown, "\n".join(lines), said, write)


def _kept_offsets(board: FeetechBoard, path: Path) -> dict[int, int]:
    what = f"{path}: not a file of old offsets that `armsight board offsets` kept"
    with as_input_error(what, KeyError, TypeError, ValueError, AttributeError):
        wished = {int(id): int(value) for id, value in read_json(path)["homing_offsets"].items()}
    for id, value in wished.items():
        if abs(value) > MOST_OFFSET:
            holds = f"the register holds -{MOST_OFFSET} to {MOST_OFFSET}"
            raise InputError(f"{path}: the offset of id {id} is {value}; {holds}")
    if set(wished) != set(board.calibration.ids):
        raise InputError(f"{path}: its offsets are of ids {sorted(wished)}, the arm's {sorted(board.calibration.ids)}")
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
        raise InputError(f"{path}: no joint_offsets of ar4_ros_driver: each of joint_1: to joint_6: once, degrees")
    return text, changes


def pot_changes(config: Configuration, further_rad: Array) -> list[ZeroChange]:
    """Shift the potentiometers' tables of a configuration by the angles (6,), rad, by which joints really are further."""
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
    """Write what was there before into a new file, or raise InputError: it exists, or cannot be written."""
    check_writable(keep)
    if keep.exists():
        raise InputError(f"{keep}: exists; old offsets are never written over: name another file with --keep")
    write_text(keep, text)
