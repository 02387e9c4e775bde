"""What the columns of a table are: our names for those of ROS, of robots' makers, of LeRobot and of spreadsheets.

In: names of a file, and the option ``--columns``. Out: names such as x_mm, qw, rx_deg, r11, q1_rad, t_s, name; and
:class:`Columns`, which gives numbers by these names.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import re
import sys
from collections import Counter
from collections.abc import Container, Generator, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np

from armsight.data import Array
from armsight.errors import InputError, nearest
from armsight.files import is_long, long_rows, read_table
from armsight.geometry.check import PRINTED, off_rotation
from armsight.geometry.rotation import nearest_rotation
from armsight.tables.cells import Rows, renamed
from armsight.tables.lengths import NO_NUMBER, number
from armsight.tables.rotations import QUATERNION_OFF, rotations_by

NAMES = ("image", "name", "shot")  # columns whose cells name the rows
TIMES = ("t_s", "__time")  # ours and PlotJuggler's
MOST_JOINTS = 7  # joints that an arm may have
#: Names that ``--columns`` may give the file's own for.
COLUMNS = (
    *(f"{axis}{unit}" for axis in "xyz" for unit in ("", "_m", "_mm")),
    *("qw", "qx", "qy", "qz"),
    *(f"r{axis}{unit}" for axis in "xyz" for unit in ("", "_deg", "_rad")),
    *(f"r{i}{j}" for i in "123" for j in "123"),
    *(f"q{i}_{unit}" for i in range(1, MOST_JOINTS + 1) for unit in ("rad", "deg")),
    *("t_s", *NAMES),
)
MOST_RAD = 4 * np.pi  # no joint rotates further, rad; larger numbers of radians are degrees
#: LeRobot's names of an SO-100's or SO-101's joints, from the base on; its position columns end so; percent reach this.
LEROBOT = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
_LEROBOT_POSITION, _LEROBOT_GRIPPER, _MOST_PERCENT = ".pos", "gripper", 100.001
#: ROS's messages as columns, in metres (REP 103): pose.position.x, field.pose.orientation.w, transform.translation.x ...
_ROS = re.compile(r"(?:.*[./_])?(?:(position|translation)|orientation|rotation)[./_]([xyzw])")
#: Names of recorders: PlotJuggler's time, and of Universal Robots' RTDE the TCP's pose, a rotation vector, and joints.
_RECORDED = {"__time": "t_s"} | {f"actual_q_{k}": f"q{k + 1}_rad" for k in range(6)}
_RTDE = ("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad")
_RECORDED |= {f"actual_tcp_pose_{k}": name for k, name in enumerate(_RTDE)}
#: Names of others for ours, in small letters; roll, pitch and yaw rotate about the fixed x, y and z.
_THEIRS = {"tx": "x", "ty": "y", "tz": "z", "roll": "rx", "pitch": "ry", "yaw": "rz"}
#: Angles of robots' makers: the columns beside X, Y and Z, mm, whose rotations they are, degrees, and about which axes.
_MAKERS = {
    "KUKA": ("c", "b", "a", "xyz"),
    "Fanuc": ("w", "p", "r", "xyz"),
    "Kawasaki": ("o", "a", "t", "ZYZ"),
    "Doosan": ("a", "b", "c", "ZYZ"),
}
_OF_A_MAKER = re.compile(r"(?:([xyz])(?:_(m|mm))?|([abcoprtw])(?:_(deg|rad))?)")  # a column of theirs, in small letters
UNITLESS = re.compile(r"(?:q|j|joint)_?([1-7])")  # a joint without a unit
_JOINT = re.compile(r"q(\d+)_(rad|deg)")
_SUFFIX = re.compile(r"_joint(?=(_deg|_rad)?$)")  # behind a joint's name in ROS, of some models too
_JOINT_UNITS = ("", "_rad", "_deg")  # that may stand behind an arm's own name of a joint; ROS's has none, and means rad
#: Numbers that are read of one table; half: half an hour of a run at 1 kHz is rejected, double: 800 MB.
_MOST_NUMBERS = 50_000_000


def joint_columns(joint_names: Sequence[str]) -> tuple[str, ...]:
    """Return the names by which ``--columns`` may know the joints of an arm, beside q1_rad .. and q1_deg .."""
    return tuple(name + unit for name in joint_names for unit in _JOINT_UNITS)


def understood(
    path: Path, head: list[str], joint_names: Sequence[str], unit: str | None, rotation: str | None
) -> tuple[list[str], str | None, tuple[str, ...]]:
    """Return our names for those of ROS, of robots' makers and of spreadsheets.

    Args:
        path: the file.
        head: its names.
        joint_names: of the arm whose joints it may name.
        unit: of lengths whose columns name none; None: ROS's, m, and the makers', mm.
        rotation: its convention where it is given.

    Returns:
        The names; the convention, the usual one where none is given, None where there is none either; and a note where
        something was taken for granted.
    """
    bare = [name.strip().strip('"').strip().lower().replace("°", "deg") for name in head]
    bare = [re.sub(r"\s*[\[(](mm|m|deg|rad|s)[\])]$", r"_\1", name) for name in bare]
    ours = zip(_of_ros(bare, joint_names, unit or "m"), head, strict=True)
    out = [one if one in COLUMNS else name.strip().strip('"').strip() for one, name in ours]
    theirs, about, said = _of_a_maker(bare, out, unit or "mm", rotation)
    out = [theirs.get(k, name) for k, name in enumerate(out)]
    if len(set(out)) < len(out):
        return head, rotation, ()
    if theirs:
        return out, rotation or about, (f"{path}: {said}; --columns says otherwise",)
    if rotation is None and any(name.startswith("roll") for name in bare):
        note = (
            f"{path}: roll, pitch, yaw read as rotations about fixed x, y and z; --columns rotation=.. says otherwise"
        )
        return out, "xyz", (note,)
    return out, rotation, ()


def _of_ros(bare: Sequence[str], joint_names: Sequence[str], unit: str) -> list[str]:
    """Return our names for those of ROS, of an arm's joints and of spreadsheets; others as they are."""
    ros = [_ROS.fullmatch(name) for name in bare]
    parts = {found[2] for found in ros if found and not found[1]}  # without w they are no quaternion
    links = {
        f"{name.lower()}{unit}": f"q{k}{unit or '_rad'}"
        for k, name in enumerate(joint_names, 1)
        for unit in _JOINT_UNITS
    }
    links = {_SUFFIX.sub("", name): ours for name, ours in links.items()} | links
    recorded = _RECORDED | ({"timestamp": "t_s"} if any(name.startswith("actual_") for name in bare) else {})
    out = []
    for name, found in zip(bare, ros, strict=True):
        axis, mark, rest = name.partition("_")
        if found and (found[1] or parts == set("xyzw")):
            out.append(f"{found[2]}_{unit}" if found[1] else f"q{found[2]}")
        else:
            whole = re.sub(r"^.*/(?=[^/]+$)", "", name.removesuffix("/position"))
            joint = links.get(whole) or links.get(_SUFFIX.sub("", whole))
            out.append(joint or recorded.get(name, _THEIRS.get(axis, axis) + mark + rest))
    return out


def _of_a_maker(bare: list[str], ours: list[str], unit: str, rotation: str | None) -> tuple[dict[int, str], str, str]:
    """Return our names for the six columns of a maker, by their positions, the convention, and what they are read as.

    A, B and C are KUKA's, but Doosan's where the rotations are given as ZYZ. Other columns may stand beside them, but for
    another rotation: which one counts would be a guess.
    """
    found = {
        one[1] or one[3]: (k, one[2] or one[4]) for k, name in enumerate(bare) if (one := _OF_A_MAKER.fullmatch(name))
    }
    makers = [
        (maker, angles, convention)
        for maker, (*angles, convention) in _MAKERS.items()
        if {*"xyz", *angles} <= set(found) and maker != ("KUKA" if rotation == "ZYZ" else "Doosan")
    ]
    if len(makers) != 1 or {"qw", "r11", "rx", "rx_deg", "rx_rad"} & set(ours):
        return {}, "", ""
    ((maker, angles, convention),) = makers
    lengths, angle_unit = found["x"][1] or unit, found[angles[0]][1] or "deg"
    names = {found[axis][0]: f"{axis}_{found[axis][1] or unit}" for axis in "xyz"}
    names |= {found[name][0]: f"r{axis}_{found[name][1] or 'deg'}" for name, axis in zip(angles, "xyz", strict=True)}
    axes = ("z", "y'", "z''") if convention == "ZYZ" else "xyz"
    about = ", ".join(f"{name.upper()} about {axis}" for name, axis in zip(angles, axes, strict=True))
    degrees = "degrees" if angle_unit == "deg" else "radians"
    return names, convention, f"read as {maker}'s: {lengths}; {degrees}, {about}"


def degree_columns(path: str | Path, rows: list[list[str]]) -> list[list[str]]:
    """Return a table with ``q1_deg ..`` for LeRobot's names of an SO-100's or SO-101's joints, ``shoulder_pan.pos`` ...

    LeRobot records degrees or, with ``use_degrees`` off, percent of each joint's range, -100 to 100; its data do not say
    which. Beyond 100 they are degrees, of which it counts 360 for 4095 of a servo's 4096 counts (0.4.4, motors_bus.py).

    Raises:
        InputError: other joints than these, or no value beyond 100: both are possible.
    """
    head = [cell.strip() for cell in next(iter(rows), [])]
    known, gripper = [f"{name}{_LEROBOT_POSITION}" for name in LEROBOT], _LEROBOT_GRIPPER + _LEROBOT_POSITION
    theirs = [name for name in head if name.endswith(_LEROBOT_POSITION) and name != gripper]
    if not set(known) & set(theirs) or {"q1_deg", "q1_rad"} & set(head):
        return rows
    if sorted(theirs) != sorted(known):
        raise InputError(
            f"{path}: line 1: LeRobot's columns {', '.join(theirs)}; read are those of one SO-100 or SO-101, "
            f"{', '.join(known)}; multiply degrees by 4095/4096 and name them q1_deg .. in your arm's order"
        )
    at = {head.index(name): k for k, name in enumerate(known, 1)}
    cells = (row[column] for row in rows[1:] for column in at if column < len(row))
    if not any(_MOST_PERCENT < abs(number(cell) or 0.0) < np.inf for cell in cells):
        raise InputError(
            f"{path}: {known[0]} .. {known[-1]}: degrees, or percent of each joint's range? LeRobot's data do not say, and "
            "no value is beyond 100; where use_degrees was on, multiply them by 4095/4096 (LeRobot's scale) and name them "
            "q1_deg .. q5_deg, else record with it on"
        )
    return [
        [f"q{at[k]}_deg" if k in at else name for k, name in enumerate(head)],
        *(_degrees(row, at) for row in rows[1:]),
    ]


def _degrees(row: list[str], at: Container[int]) -> list[str]:
    """Return a row whose cells at some columns are in LeRobot's degrees, with these in degrees."""
    values = [number(cell) if k in at else None for k, cell in enumerate(row)]
    return [cell if value is None else repr(value * 4095 / 4096) for cell, value in zip(row, values, strict=True)]


def _padded(row: list[str], head: list[str]) -> list[str]:
    return row + [""] * (len(head) - len(row))


class _StoredRows(Sequence[tuple[int, list[str]]]):
    """Lines and rows of a long table, which stay in its file: each look at them all reads it again.

    Rows that a program appends meanwhile are not read.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._count = path, sys.maxsize
        with contextlib.closing(long_rows(path)) as rows:
            self.head = [cell.strip() for cell in next(rows, [])]
        self._count = sum(1 for _ in self)

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Generator[tuple[int, list[str]]]:
        lines = ((line, row) for line, row in enumerate(long_rows(self._path), 1) if line > 1 and any(row))
        count = 0
        for line, row in itertools.islice(lines, self._count):
            count += 1
            yield line, _padded([cell.strip() for cell in row], self.head)
        if count < self._count < sys.maxsize:
            raise InputError(f"{self._path}: became shorter while it was read")

    def __getitem__(self, row: Any) -> Any:  # noqa: ANN401 - the line and the row; a slice of none is asked for
        with contextlib.closing(iter(self)) as rows:
            return next(itertools.islice(rows, row, None))


class Columns:
    """Columns of a table by their names; ``given`` are the file's own, for messages."""

    def __init__(
        self, path: Path, head: list[str], rows: Rows, links: Sequence[str] = (), given: Sequence[str] = ()
    ) -> None:
        self.path, self.head, self.rows, self.given = path, head, rows, list(given) or head
        self.at = {name: k for k, name in enumerate(head) if name}
        self.used: set[str] = set()
        self.links = links
        #: Why each row has no pose, "" where it has one: such hold another row's numbers; None: they are rejected.
        self.missed: list[str] | None = None

    @classmethod
    def of_csv(cls, path: Path, columns: Mapping[str, str] | Sequence[str] = ()) -> Columns:
        """Return the columns of a CSV as they are named there, blank lines left out; a line may end early.

        Args:
            path: the file.
            columns: names for the file's own, as :func:`read_columns` returns them.

        Raises:
            InputError: no table, a column named twice, or one that is not there.
        """
        rows: Rows
        if is_long(path):
            rows = _StoredRows(path)
            head = rows.head
        else:
            head, *cells = [[cell.strip() for cell in row] for row in read_table(path)] or [[]]
            rows = [(line, _padded(row, head)) for line, row in enumerate(cells, 2) if any(row)]
        if twice := next((name for name in head if name and head.count(name) > 1), None):
            raise InputError(f"{path}: line 1 names a column twice: {twice}")
        return cls(path, renamed(path, head, columns), rows)

    def line(self, row: int | np.integer[Any]) -> int:
        """Return which line of the file, or record, a row is."""
        return self.rows[int(row)][0]

    def require(self, *names: str) -> None:
        """Raise an InputError where a column is missing; those that are there count as used."""
        for name in names:
            if name not in self.at:
                raise InputError(f"{self.path}: line 1: column {name} is missing; there are {self.near(name)}")
        self.used.update(names)

    def near(self, name: str) -> str:
        """Return the file's own names, those like ``name`` first, for messages."""
        return nearest(name, [each for each in self.given if each])

    def texts(self, name: str) -> list[str]:
        """Return the cells of a column (N,), "" where there is no such column."""
        at = self.at.get(name)
        return ["" if at is None else sys.intern(row[at]) for _, row in self.rows]

    def numbers(self, names: Sequence[str], *, gaps: bool = False, empty: bool = False, text: bool = False) -> Array:
        """Return columns (N, K); NaN with ``empty`` where a cell is empty, ``gaps`` also not finite, ``text`` no number.

        Where ``missed`` says why rows have no pose, those with gaps are added to it.
        """
        self.require(*names)
        if len(self.rows) * len(names) > _MOST_NUMBERS:
            raise InputError(
                f"{self.path}: {len(self.rows)} rows of {len(names)} numbers are too many: split the table"
            )
        out = np.full((len(self.rows), len(names)), np.nan)
        columns = [self.at[name] for name in names]
        for i, (line, row) in enumerate(self.rows):
            cells = [row[k] if k < len(row) else "" for k in columns]
            values = [math.nan if value is None else value for value in map(number, cells)]
            if not all(map(math.isfinite, values)):
                if not text:
                    lax = gaps or self.missed is not None
                    self._check(line, dict(zip(names, cells, strict=True)), gaps=lax, empty=empty or lax)
                values = [value if math.isfinite(value) else math.nan for value in values]
            out[i] = values
        return out if gaps or empty or text else self._filled(names, out)

    def _filled(self, names: Sequence[str], numbers: Array) -> Array:
        """Return numbers (N, K) with those of some row in rows that have gaps, or a rotation of zeros; note why."""
        if self.missed is None:
            return numbers
        good = np.asarray(np.isfinite(numbers).all(axis=1))
        if {"r11", "qw", "n4"} & set(names):
            good &= np.asarray(numbers.any(axis=1))
        for row in np.flatnonzero(~good).tolist():
            name = names[int(np.argmin(np.isfinite(numbers[row])))]
            why = f"{self.given[self.at[name]]} is {self.rows[row][1][self.at[name]] or 'empty'}"
            why = "the rotation is all zeros" if np.isfinite(numbers[row]).all() else why
            self.missed[row] = self.missed[row] or why
        if not good.any():
            raise InputError(f"{self.path}: none of {len(good)} rows has a pose; line {self.line(0)}: {self.missed[0]}")
        return np.asarray(np.where(good[:, None], numbers, numbers[np.argmax(good)]))

    def _check(self, line: int, cells: Mapping[str, str], *, gaps: bool, empty: bool) -> None:
        """Reject a row's cell that is no number, or with no ``gaps`` not finite; ``empty``: it may be empty."""
        if self.missed is not None and len(cells) > 1 and all(number(cell) is None for cell in cells.values()):
            return  # a word instead of all numbers says that there are none
        for name, cell in cells.items():
            value = number(cell)
            blank = cell.lower() in NO_NUMBER if gaps else empty and not cell
            if not blank and (value is None or not (gaps or math.isfinite(value))):
                raise InputError(
                    f"{self.path}: line {line}: {self.given[self.at[name]]} is {cell[:40]!r}, not a number; finite numbers "
                    "are needed: correct or remove the line"
                )

    def joint_names(self, joint_count: int | None = None, arm: str = "") -> list[str]:
        """Return the names of the columns of joint angles, from the first joint on; [] where there are none.

        Args:
            joint_count: how many joints there are to be; None: as many as there are columns.
            arm: whose they are, for messages.

        Raises:
            InputError: another number of joints, or not numbered from 1 on in one unit.
        """
        there = [name for name in self.at if _JOINT.fullmatch(name)]
        names = sorted(there, key=lambda name: (int(name[1:-4]), name))
        if joint_count is not None and names and len(names) != joint_count:
            raise InputError(
                f"{self.path}: line 1: {len(names)} joints ({names[0]}..{names[-1]}); {arm} has {joint_count}"
                + self._near(names, joint_count)
            )
        for k, name in enumerate(names, 1):
            if name != f"q{k}_{names[0][-3:]}":
                raise InputError(
                    f"{self.path}: line 1: has {name} where q{k}_{names[0][-3:]} is expected: joints are numbered from 1 "
                    "on, each once, all in degrees or all in radians"
                )
        return names

    def _near(self, names: list[str], count: int) -> str:
        if len(names) == count + 1:
            return "; is the last one a gripper? remove its column"
        joints = [name for name in COLUMNS if _JOINT.fullmatch(name) and name[-3:] == names[0][-3:]]
        known = [*self.links, *(f"{name}_joint" for name in self.links), *joints]
        for unknown in (name for name in self.at if name and name not in COLUMNS):
            if near := get_close_matches(unknown, known, 1, 0.5):  # q6 is half of what q6_rad and it have
                return f"; column {unknown!r} is not known: is it {near[0]}?"
        gone = {f"q{k}" for k in range(1, count + 1)} - {name[:2] for name in names}
        return f"; column {min(gone)}{names[0][2:]} is missing" if gone else ""

    def joints(self, names: Sequence[str], *, gaps: bool = False) -> Array:
        """Return joint angles (N, J), rad."""
        q = self.numbers(names, gaps=gaps)
        if names[0].endswith("_rad") and np.nanmax(np.abs(q), initial=0.0) > MOST_RAD:
            row, joint = np.unravel_index(int(np.nanargmax(np.abs(q))), q.shape)
            raise InputError(
                f"{self.path}: line {self.line(row)}: q{joint + 1}_rad is {q[row, joint]:g}: are these degrees? name "
                "the columns q1_deg .."
            )
        return np.radians(q) if names[0].endswith("_deg") else q

    def times(self) -> Array | None:
        """Return the times (N,), s."""
        known = "t_s" in self.at and any(row[self.at["t_s"]] for _, row in self.rows)
        return self.numbers(["t_s"])[:, 0] if known else None

    def names(self) -> tuple[str, ...] | None:
        """Return the names of the rows, or of their images."""
        key = next((key for key in NAMES if key in self.at), None)
        if key is None:
            return None
        self.used.add(key)
        found = tuple(row[self.at[key]] for _, row in self.rows)
        for row, name in enumerate(found):
            if not name and not (self.missed and self.missed[row]):
                raise InputError(
                    f"{self.path}: line {self.line(row)}: {key} is empty: name the row, or leave out {key}"
                )
        twice = next((name for name, count in Counter(filter(None, found)).items() if count > 1), None)
        if twice is not None:
            raise InputError(f"{self.path}: {key} {twice!r} names two rows; a row belongs to one image")
        return found

    def rotations(self, rotation: str | None, prefix: str = "") -> tuple[Array, Array, str, Array]:
        """Return the rotations (N, 3, 3), the numbers they come from, degrees, their convention, and them as written.

        ``prefix``: what stands before what ``--columns`` says of this table: "" or "seen:".
        """
        if "r11" in self.at:
            R = self.numbers([f"r{i}{j}" for i in "123" for j in "123"]).reshape(-1, 3, 3)
            return self._checked(R), np.zeros((len(R), 0)), "", np.zeros((len(R), 0))
        if "qw" in self.at:
            found = written = self.numbers(["qw", "qx", "qy", "qz"])
            convention = "wxyz"
        elif "n4" in self.at:
            found, convention = self._quaternions(rotation, prefix)
            written = found
        else:
            found, convention, written = self._angles(rotation, prefix)
        lines = [line for line, _ in self.rows]
        return self._checked(rotations_by(found, convention, self.path, lines)), found, convention, written

    def _quaternions(self, rotation: str | None, prefix: str) -> tuple[Array, str]:
        """Return four numbers (N, 4) without names, and their convention; reject those that stand before the position."""
        if rotation not in ("wxyz", "xyzw"):
            raise InputError(
                f"{self.path}: which of the four numbers of a quaternion is w? "
                f"give --columns {prefix}rotation=wxyz or {prefix}rotation=xyzw"
            )
        last, first = self.numbers(["n1", "n2", "n3", "n4"]), self.numbers([*"xyz", "n1"])
        off, other = (float(np.abs(np.linalg.norm(four, axis=1) - 1).max()) for four in (last, first))
        if off > QUATERNION_OFF > other:
            raise InputError(
                f"{self.path}: the last four numbers are no quaternions, the first four are: the rotation comes before the "
                "position: name the columns in their order, --columns qx,qy,qz,qw,x,y,z or qw,qx,qy,qz,x,y,z"
            )
        return last, rotation

    def _angles(self, rotation: str | None, prefix: str) -> tuple[Array, str, Array]:
        """Return three numbers of a rotation (N, 3), degrees, their convention, and them as written."""
        unit = next((u for u in ("_rad", "_deg", "") if f"rx{u}" in self.at), None)
        names = ["n1", "n2", "n3"] if "n1" in self.at else [f"r{axis}{unit}" for axis in "xyz"]
        if unit is None and "n1" not in self.at:
            raise InputError(
                f"{self.path}: line 1: no rotation: qw qx qy qz, rx_deg ry_deg rz_deg, or r11 .. r33 are needed; there are "
                f"{self.near('qw')}"
            )
        found = self.numbers(names)
        convention = rotation or ("rotvec" if unit == "_rad" else None)
        if convention is None or convention in ("wxyz", "xyzw"):
            raise InputError(
                f"{self.path}: what do the three numbers of a rotation mean? give --columns {prefix}rotation=rotvec, or "
                "the order of the angles: xyz (about fixed axes), XYZ (about the rotated axes), zyx ..."
            )
        if unit == "_rad" and np.abs(found).max() > MOST_RAD:
            row, column = np.unravel_index(int(np.abs(found).argmax()), found.shape)
            raise InputError(
                f"{self.path}: line {self.line(row)}: {names[column]} is {found[row, column]:g}: are these degrees? "
                "name the columns rx_deg ry_deg rz_deg"
            )
        radians = unit == "_rad" or (unit != "_deg" and bool((np.abs(found) <= 2 * np.pi + 1e-3).all()))
        return (np.degrees(found) if radians else found), convention, found

    def _checked(self, R: Array) -> Array:
        for (line, _), one in zip(self.rows, R, strict=True):
            off = off_rotation(one)
            if off < PRINTED and np.linalg.det(one) < 0:
                raise InputError(
                    f"{self.path}: line {line}: the 3x3 part is left-handed (determinant -1): an axis is mirrored; robot "
                    "and camera poses are right-handed: exchange no axes without a sign"
                )
            if off >= PRINTED:
                raise InputError(
                    f"{self.path}: line {line}: the 3x3 part is no rotation (R R^T differs from 1 by {off:.2g})"
                )
        return np.asarray([nearest_rotation(one) for one in R])
