"""Tables of poses as robots, cameras and people write them.

In: a CSV, TSV or text file. Out: :class:`PoseTable`. Known forms:

- no first line of names: 16 (or 12) numbers a row, a matrix row by row; 7: x, y, z and a quaternion; 6: x, y, z and three
  numbers of a rotation; the option ``rotation`` names its convention.
- Universal Robots' ``p[x, y, z, rx, ry, rz]``, metres and a rotation vector, one a line, among other text too; without the
  p the line is the list alone, with a note, and none where a model is given: it may be joints. Lists of more numbers are
  read as rows of them.
- KUKA's ``{X 1,Y 2,Z 3,A 4,B 5,C 6}`` and ``{A1 1,..,A6 6}``, one a line, among other text too (.dat files).
- columns of ROS's messages (``pose.position.x``, ``transform.rotation.w``, joints by the model's names, rad), KUKA's
  ``X,Y,Z,A,B,C``, Fanuc's ``X,Y,Z,W,P,R``, among others too, units in brackets (``x [mm]``); matrices of four lines each,
  or of three without 0 0 0 1.
- named columns: ``x_m y_m z_m`` (or ``x_mm``, or ``x`` with ``unit``); ``qw qx qy qz``; or ``rx_deg ry_deg rz_deg`` (or
  ``rx_rad``, ``rx``); or ``r11 .. r33``; or joints ``q1_deg ..`` (``q1_rad``) for a model, also by LeRobot's names. ``t_s``
  is a time, ``image`` the image that belongs to a row, ``name`` (``shot`` in what ``armsight measure`` writes) a name that
  both tables share; rows whose ``status`` is missed count as shots without a pose.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from armsight.app.measure.poses import CSV_COLUMNS, SHUTTER_COLUMNS
from armsight.data import Array, Record
from armsight.errors import InputError
from armsight.files import DECIMAL_COMMA, columns_unused, read_columns, read_table, read_text
from armsight.geometry.rotation import nearest_rotation
from armsight.loop.identify import ROTATIONS
from armsight.robot.arm import Arm
from armsight.robot.boards.feetech.calibration import degree_columns

#: What three or four numbers of a rotation may mean: quaternions in both orders, and the conventions of three angles.
CONVENTIONS = ("wxyz", "xyzw", *ROTATIONS)
#: Columns whose cells name the rows.
NAMES = ("image", "name", "shot")
#: Names that ``--columns`` may give the file's own for.
COLUMNS = (
    *(f"{axis}{unit}" for axis in "xyz" for unit in ("", "_m", "_mm")),
    *("qw", "qx", "qy", "qz"),
    *(f"r{axis}{unit}" for axis in "xyz" for unit in ("", "_deg", "_rad")),
    *(f"r{i}{j}" for i in "123" for j in "123"),
    *(f"q{i}_{unit}" for i in range(1, 8) for unit in ("rad", "deg")),
    *("t_s", *NAMES),
)
#: Lengths beyond this, m, are no robot's: they are mm; below the other, all of them, they are m taken for mm.
FAR_M, NEAR_M = 20.0, 0.02
#: Lengths that differ by more than this factor in one table are not in one unit.
MIXED = 200.0
#: No joint rotates further, rad; larger numbers of radians are degrees.
MOST_RAD = 4 * np.pi
#: How far a matrix may be from a rotation: what six digits leave.
LOOSE = 2e-3
#: Columns of the poses that `armsight measure -o` wrote.
_MEASURED = {"shot", "status", "reason", "x_m"}
_UR = re.compile(r"\bp\[([^\[\]]*)\]")
#: A point or the axes in KUKA's language: {X 1.5,Y 2, ..}, with or without the name of its type.
_KRL = re.compile(r"\{\s*(?:\w+\s*:\s*)?([A-Z]\w*\s+[-+.\deE]+(?:\s*,\s*[A-Z]\w*\s+[-+.\deE]+)*)\s*\}")
#: What of it is read: a point, mm and degrees, or its axes.
_KRL_KEYS = (("X", "Y", "Z", "A", "B", "C"), ("A1", "A2", "A3", "A4", "A5", "A6"))
#: What only points have; motions between them have other names ({VEL 100.0,ACC 100.0}).
_OF_A_POINT = {"X", "Y", "Z", *_KRL_KEYS[1]}
#: A list alone in its line.
_LIST = re.compile(r"\[([^\[\]]*)\],?")
#: ROS's messages as columns, in metres (REP 103): pose.position.x, field.pose.orientation.w, transform.translation.x ...
_ROS = re.compile(r"(?:.*[./_])?(?:(position|translation)|orientation|rotation)[._]([xyzw])")
#: Names of others for ours, in small letters; roll, pitch and yaw rotate about the fixed x, y and z.
_THEIRS = {"tx": "x", "ty": "y", "tz": "z", "roll": "rx", "pitch": "ry", "yaw": "rz"}
#: Angles of robots' makers: the columns beside X, Y and Z, mm, whose rotations about fixed x, y and z they are, degrees.
_MAKERS = {"KUKA": ("c", "b", "a"), "Fanuc": ("w", "p", "r")}
#: A column of theirs, in small letters.
_OF_A_MAKER = re.compile(r"(?:([xyz])(?:_(m|mm))?|([abcwpr])(?:_(deg|rad))?)")
#: A joint without a unit.
_UNITLESS = re.compile(r"(?:q|j|joint)_?([1-7])")
#: What begins a line of something else than a table.
_NO_TABLE = re.compile(r"[{<]|\[\s*[\[{]|- |.*(?::=|=|:$|:\s*[\[{\d-])")
_JOINT = re.compile(r"q(\d+)_(rad|deg)")


@dataclass(frozen=True, eq=False)
class PoseTable(Record):
    """The poses of a file.

    Attributes:
        path: the file.
        lines: (N,) the line of each row.
        Ts: (N, 4, 4) the poses, m.
        numbers: (N, K) the numbers of the rotations as in the file; (N, 0) for matrices and joints.
        convention: what they were taken for, one of CONVENTIONS; "" for matrices and joints.
        q: (N, J) joint angles, rad; None where there are none.
        t_s: (N,) times, s; None where there are none.
        names: of the rows, or of their images; None where there are none.
        unit_m: the unit that lengths were read in, m.
        notes: what was found out while reading.
        missed: (N,) why a shot that `armsight measure` wrote has no pose, and another's stands there; "" where it has one.
        of_joints: whether the poses are those of the joints by the model.
    """

    path: Path
    lines: NDArray[np.int64]
    Ts: Array
    numbers: Array
    convention: str
    q: Array | None
    t_s: Array | None
    names: tuple[str, ...] | None
    unit_m: float
    notes: tuple[str, ...]
    missed: tuple[str, ...]
    of_joints: bool = False


def read_pose_table(
    path: Path,
    *,
    rotation: str | None = None,
    unit: str | None = None,
    detect_units: bool = False,
    columns: str | None = None,
    arm: Arm | None = None,
    only_joints: bool = False,
) -> PoseTable:
    """Read a table of poses.

    Args:
        path: the file.
        rotation: one of CONVENTIONS; None: what the columns' names say.
        unit: "m" or "mm" for lengths whose columns do not name one; None: m.
        detect_units: whether lengths that cannot be metres are taken for millimetres, with a note.
        columns: NAME=THEIRS,... with names of COLUMNS.
        arm: the model whose joints the table has.
        only_joints: whether positions are passed over: the poses are then those of the joints.

    Raises:
        InputError: the file, the line and what was expected.
    """
    if rotation is not None and rotation not in CONVENTIONS:
        raise InputError(f"the rotation convention is {rotation!r}; known are {', '.join(CONVENTIONS)}")
    head, rows, listed = _cells(path, columns)
    if listed:
        notes = _notes_of_lists(path, rows[0], arm, unit, rotation)
    else:
        head, rotation, notes = _understood(path, head, arm, unit, rotation)
    measured = set(head) >= _MEASURED
    rows, missed = _shown(path, head, rows) if measured else (rows, ("",) * len(rows))
    table = _Columns(path, head, rows)
    if "_3" in head:
        _require_row_major(path, table, rows)
    lines = np.array([line for line, _ in rows])
    unit_m, q, of_joints = 1.0, None, False
    numbers, convention = np.zeros((len(rows), 0)), ""
    joints = sorted((int(found[1]), name) for name in head if (found := _JOINT.fullmatch(name)))
    if joints:
        q = table.joints([name for _, name in joints], arm)
    if only_joints and q is None:
        raise InputError(
            f"{path}: line 1: no joint angles: q1_deg .. or q1_rad .. are needed; there are {', '.join(head)}"
        )
    if q is not None and arm is not None and (only_joints or not table.has_position()):
        Ts, of_joints = np.asarray(arm.forward(q)), True
    elif q is not None and not table.has_position():
        raise InputError(f"{path}: joint angles need the arm: give --model, a name (armsight arm list) or a .urdf file")
    else:
        p, unit_m, found_out = _positions(table, unit, detect_units)
        notes = (*notes, *found_out)
        R, numbers, convention = table.rotations(rotation)
        Ts = stacked(R, p)
    t_s, names = table.times(), table.names()
    table.used.update((*CSV_COLUMNS, *SHUTTER_COLUMNS) if measured else ())
    unused = [name for name in head if name and name not in table.used and not re.fullmatch(r"_[0-3]", name)]
    if arm is not None and q is None:
        notes = (*notes, f"{path}: has no joint angles: --model {arm.name} is not used")
    if unused and not only_joints:
        notes = (*notes, f"{path}: {columns_unused(unused)}")
    return PoseTable(path, lines, Ts, numbers, convention, q, t_s, names, unit_m, notes, missed, of_joints)


def _shown(
    path: Path, head: list[str], rows: list[tuple[int, list[str]]]
) -> tuple[list[tuple[int, list[str]]], tuple[str, ...]]:
    """Return the rows of `armsight measure`, some pose in those without one, and why they have none."""
    status, reason, first = head.index("status"), head.index("reason"), head.index("x_m")
    some = next((row for _, row in rows if row[status] == "ok"), None)
    if some is None:
        raise InputError(f"{path}: none of {len(rows)} shots was measured; {rows[0][1][reason]}")
    missed = tuple("" if row[status] == "ok" else row[reason] or row[status] for _, row in rows)
    filled = [row[:first] + some[first:] if why else row for (_, row), why in zip(rows, missed, strict=True)]
    return [(line, row) for (line, _), row in zip(rows, filled, strict=True)], missed


def _cells(path: Path, columns: str | None) -> tuple[list[str], list[tuple[int, list[str]]], bool]:
    """Return the names of the columns, the rows with their lines, and whether they are lists."""
    text = read_text(path).removeprefix("\ufeff")
    written = [(line, row.strip()) for line, row in enumerate(text.splitlines(), 1)]
    written = [(line, row) for line, row in written if row and not row.startswith("#")]
    first = written[0][1] if written else ""
    if any(_UR.search(row) for _, row in written):
        return ["x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad"], _even(path, _poses_of_ur(path, written), 6), False
    if any(_points_in(row) for _, row in written):
        return *_points_of_krl(path, written), False
    if _LIST.fullmatch(first):
        head, rows = _without_names(path, _lists(path, written))
        return ["x", "y", "z", "rx_rad", "ry_rad", "rz_rad"] if len(head) == 6 else head, rows, True
    if _NO_TABLE.match(first):
        raise InputError(
            f"{path}: {first[:40]!r} begins no table: write one pose a line, a matrix of 16 numbers or columns such as "
            "x_mm,y_mm,z_mm,qw,qx,qy,qz"
        )
    if _has_decimal_commas(first.split()):
        cells = [line.replace(",", ".").split() for line in text.splitlines()]
    elif any(mark in first for mark in ",;\t"):
        cells = degree_columns(path, read_table(path, read_columns(columns, COLUMNS)))
    else:
        cells = [line.split() for line in text.splitlines()]
    rows = [(line, [cell.strip() for cell in row]) for line, row in enumerate(cells, 1)]
    rows = [(line, row) for line, row in rows if any(row) and not row[0].startswith("#")]
    count = len(rows[0][1]) - (rows[0][1][-1] == "") if rows else 0
    rows = [(line, row[:-1] if len(row) == count + 1 and row[-1] == "" else row) for line, row in rows]
    if not rows:
        raise InputError(f"{path}: no rows; one line a pose is needed")
    head = rows[0][1]
    if not _is_number(head[0]) or any(re.fullmatch(r"[A-Za-z_]\w*", cell) and not _is_number(cell) for cell in head):
        if len(set(head)) != len(head):
            raise InputError(f"{path}: line {rows[0][0]} names a column twice")
        return head, _even(path, rows[1:], len(head)), False
    return *_without_names(path, rows), False


def _poses_of_ur(path: Path, written: list[tuple[int, str]]) -> list[tuple[int, list[str]]]:
    """Return the numbers of the one p[...] that each line has."""
    rows = []
    for line, row in written:
        found = _UR.findall(row)
        if len(found) != 1:
            raise InputError(f"{path}: line {line}: expected one p[x, y, z, rx, ry, rz], found {row[:40]!r}")
        rows.append((line, [cell.strip() for cell in found[0].split(",")]))
    return rows


def _points_in(row: str) -> list[dict[str, str]]:
    """Return the numbers of the points of a line in KUKA's language by their names, without other structures (speeds)."""
    found = (dict(part.split() for part in re.split(r"\s*,\s*", one)) for one in _KRL.findall(row))
    return [point for point in found if _OF_A_POINT & set(point)]


def _points_of_krl(path: Path, written: list[tuple[int, str]]) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Return the columns, and the numbers of the point that a line in KUKA's language has; other lines are passed over."""
    rows = []
    for line, row in written:
        found = _points_in(row)
        if len(found) > 1:
            raise InputError(f"{path}: line {line}: has {len(found)} points; one a line is needed")
        rows += [(line, point) for point in found]
    keys = next((keys for keys in _KRL_KEYS if set(keys) <= set(rows[0][1])), None)
    if keys is None:
        raise InputError(f"{path}: line {rows[0][0]}: a point needs X, Y, Z, A, B, C, and axes A1 to A6")
    for line, point in rows:
        if missing := [key for key in keys if key not in point]:
            raise InputError(f"{path}: line {line}: {missing[0]} is missing, which line {rows[0][0]} has")
    head = [f"q{key[1]}_deg" for key in keys] if keys[0] == "A1" else list(keys)
    return head, [(line, [point[key] for key in keys]) for line, point in rows]


def _lists(path: Path, written: list[tuple[int, str]]) -> list[tuple[int, list[str]]]:
    """Return the numbers of lists, one a line."""
    rows = []
    for line, row in written:
        found = _LIST.fullmatch(row)
        if found is None:
            raise InputError(f"{path}: line {line}: expected a list [..] as before, found {row[:40]!r}")
        rows.append((line, re.split(r"\s*,\s*|\s+", found[1].strip())))
    return rows


def _notes_of_lists(
    path: Path, first: tuple[int, list[str]], arm: Arm | None, unit: str | None, rotation: str | None
) -> tuple[str, ...]:
    """Return what lists of six numbers are read as; reject those that may be the joints of an arm as well."""
    line, cells = first
    if arm is not None and rotation is None and len(cells) in (6, len(arm.joint_names)):
        raise InputError(
            f"{path}: line {line}: is this list a pose, or joint angles of {arm.name}? write poses as p[x, y, z, rx, "
            "ry, rz], or name columns of joints q1_rad .. or q1_deg .."
        )
    what = "UR's pose" if rotation is None else "poses"
    how = f"{unit or 'm'} and {rotation or 'rotation vector'}, rad"
    return (f"{path}: lists read as {what}: {how}",) if len(cells) == 6 else ()


def _without_names(path: Path, rows: list[tuple[int, list[str]]]) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Return names for columns that have none, by how many they are, and the rows."""
    matrix = [f"{letter}" for i in "123" for letter in (f"r{i}1", f"r{i}2", f"r{i}3", "xyz"[int(i) - 1])]
    forms = {
        16: [*matrix, "_0", "_1", "_2", "_3"],
        12: matrix,
        7: ["x", "y", "z", "n1", "n2", "n3", "n4"],
        6: ["x", "y", "z", "n1", "n2", "n3"],
        8: ["t_s", "x", "y", "z", "n1", "n2", "n3", "n4"],
    }
    line, first = rows[0]
    if len(first) == 4:
        rows = _matrices(path, _even(path, rows, 4))
    count = len(rows[0][1])
    if count not in forms:
        raise InputError(
            f"{path}: line {line}: {count} numbers without names; known are 16 or 12 (a matrix), 8 (time, "
            "position, quaternion), 7 (position, quaternion), 6 (position, three numbers of a rotation); or name columns"
        )
    return forms[count], _even(path, rows, count)


def _matrices(path: Path, rows: list[tuple[int, list[str]]]) -> list[tuple[int, list[str]]]:
    """Return matrices of four lines each, or of three without the last one, as a row each."""

    def is_last(row: list[str]) -> bool:
        return all(map(_is_number, row)) and np.allclose([float(cell) for cell in row], [0, 0, 0, 1], atol=1e-6)

    count = 4 if any(is_last(row) for _, row in rows) else 3  # three of [R p], whose rows have length 1, never end so
    for line, row in rows[3::4] if count == 4 else ():
        if not is_last(row):
            raise InputError(
                f"{path}: line {line}: expected 0 0 0 1, the last of a matrix's four lines, found {' '.join(row)[:40]!r}"
            )
    if len(rows) % count:
        raise InputError(
            f"{path}: line {rows[-1][0]}: ends within a matrix: four numbers a line are matrices of four lines each, the "
            "last 0 0 0 1, or of three without it"
        )
    return [(rows[k][0], [cell for _, row in rows[k : k + count] for cell in row]) for k in range(0, len(rows), count)]


def _require_row_major(path: Path, table: _Columns, rows: list[tuple[int, list[str]]]) -> None:
    """Reject matrices of 16 numbers that do not end with 0 0 0 1."""
    for (line, row), last in zip(rows, table.numbers([f"_{k}" for k in range(4)]), strict=True):
        if not np.allclose(last, [0, 0, 0, 1], atol=1e-6):
            columns = [row[k] for k in (3, 7, 11, 15)]
            transposed = all(map(_is_number, columns)) and np.allclose(
                np.array(columns, float), [0, 0, 0, 1], atol=1e-6
            )
            why = "they are written column by column: write them row by row" if transposed else "or name columns"
            raise InputError(
                f"{path}: line {line}: 16 numbers are a matrix row by row, which ends with 0 0 0 1, not "
                f"{' '.join(row[12:])[:40]}; {why}"
            )


def _understood(
    path: Path, head: list[str], arm: Arm | None, unit: str | None, rotation: str | None
) -> tuple[list[str], str | None, tuple[str, ...]]:
    """Return our names for those of ROS, of robots' makers and of spreadsheets.

    Args:
        path: the file.
        head: its names.
        arm: the model whose joints it may name.
        unit: of lengths whose columns name none; None: ROS's, m, and the makers', mm.
        rotation: its convention where it is given.

    Returns:
        The names; the convention, the usual one where none is given, None where there is none either; and a note where
        something was taken for granted.
    """
    bare = [name.strip().strip('"').strip().lower().replace("°", "deg") for name in head]
    bare = [re.sub(r"\s*[\[(](mm|m|deg|rad|s)[\])]$", r"_\1", name) for name in bare]
    ros = [_ROS.fullmatch(name) for name in bare]
    parts = {found[2] for found in ros if found and not found[1]}  # without w they are no quaternion
    links = {} if arm is None else {name.lower(): f"q{k}_rad" for k, name in enumerate(arm.joint_names, 1)}
    out = []
    for given, name, found in zip(head, bare, ros, strict=True):
        axis, mark, rest = name.partition("_")
        ours = _THEIRS.get(axis, axis) + mark + rest
        if found and (found[1] or parts == set("xyzw")):
            ours = f"{found[2]}_{unit or 'm'}" if found[1] else f"q{found[2]}"
        elif (joint := re.sub(r"_joint$", "", name)) in links:
            ours = links[joint]
        out.append(ours if ours in COLUMNS else given.strip().strip('"').strip())
    theirs, said = _of_a_maker(bare, out, unit or "mm")
    out = [theirs.get(k, name) for k, name in enumerate(out)]
    if len(set(out)) < len(out):
        return head, rotation, ()
    if theirs:
        return out, rotation or "xyz", (f"{path}: {said}; --columns says otherwise",)
    if rotation is None and any(name.startswith("roll") for name in bare):
        note = f"{path}: roll, pitch, yaw read as rotations about the fixed x, y and z; --rotation says otherwise"
        return out, "xyz", (note,)
    return out, rotation, ()


def _of_a_maker(bare: list[str], ours: list[str], unit: str) -> tuple[dict[int, str], str]:
    """Return our names for the six columns of KUKA or Fanuc, by their positions, and what they are read as.

    Other columns may stand beside them, but for another rotation: which one counts would be a guess.
    """
    found = {
        one[1] or one[3]: (k, one[2] or one[4]) for k, name in enumerate(bare) if (one := _OF_A_MAKER.fullmatch(name))
    }
    makers = [maker for maker, angles in _MAKERS.items() if {*"xyz", *angles} <= set(found)]
    if len(makers) != 1 or {"qw", "r11", "rx", "rx_deg", "rx_rad"} & set(ours):
        return {}, ""
    angles = _MAKERS[makers[0]]
    lengths, angle_unit = found["x"][1] or unit, found[angles[0]][1] or "deg"
    names = {found[axis][0]: f"{axis}_{found[axis][1] or unit}" for axis in "xyz"}
    names |= {found[name][0]: f"r{axis}_{found[name][1] or 'deg'}" for name, axis in zip(angles, "xyz", strict=True)}
    about = ", ".join(f"{name.upper()} about {axis}" for name, axis in zip(angles, "xyz", strict=True))
    degrees = "degrees" if angle_unit == "deg" else "radians"
    return names, f"read as {makers[0]}'s: {lengths}; {degrees}, {about}"


def _even(path: Path, rows: list[tuple[int, list[str]]], count: int) -> list[tuple[int, list[str]]]:
    """Return the rows if all have as many fields as there are columns."""
    for line, row in rows:
        if len(row) != count:
            commas = (
                "are there decimal commas between commas? separate by semicolons, or " if len(row) == 2 * count else ""
            )
            raise InputError(
                f"{path}: line {line}: {len(row)} fields where {count} are expected; {commas}correct or remove the line"
            )
    if not rows:
        raise InputError(f"{path}: no rows; one line a pose is needed")
    return rows


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _has_decimal_commas(cells: list[str]) -> bool:
    """Return whether cells that blanks separate are numbers with decimal commas; whole ones have none, points are none."""
    commas = [bool(DECIMAL_COMMA.fullmatch(cell)) for cell in cells]
    whole = [_is_number(cell) and "." not in cell for cell in cells]
    return len(cells) > 1 and any(commas) and all(a or b for a, b in zip(commas, whole, strict=True))


class _Columns:
    """Columns of a table by their names."""

    def __init__(self, path: Path, head: list[str], rows: list[tuple[int, list[str]]]) -> None:
        self.path, self.at, self.rows = path, {name: k for k, name in enumerate(head)}, rows
        self.used: set[str] = set()

    def has_position(self) -> bool:
        """Return whether there are positions."""
        return any(name in self.at for name in ("x", "x_m", "x_mm"))

    def numbers(self, names: list[str]) -> Array:
        """Return columns (N, K)."""
        for name in names:
            if name not in self.at:
                raise InputError(f"{self.path}: line 1: column {name} is missing; there are {', '.join(self.at)}")
        self.used.update(names)
        out = np.empty((len(self.rows), len(names)))
        for i, (line, row) in enumerate(self.rows):
            for k, name in enumerate(names):
                cell = row[self.at[name]]
                if not _is_number(cell) or not np.isfinite(float(cell)):
                    raise InputError(
                        f"{self.path}: line {line}: {name} is {cell[:40]!r}, not a number; correct or remove the line"
                    )
                out[i, k] = float(cell)
        return out

    def joints(self, names: list[str], arm: Arm | None) -> Array:
        """Return joint angles (N, J), rad."""
        if arm is not None and len(names) != len(arm.joint_names):
            advice = "; is the last one a gripper? remove its column" if len(names) == len(arm.joint_names) + 1 else ""
            known = [*arm.joint_names, *(f"{name}_joint" for name in arm.joint_names), *COLUMNS]
            unknown = next((name for name in self.at if name not in COLUMNS), None)
            if unknown is not None and not advice:
                near = get_close_matches(unknown, known, 1)
                advice = f"; column {unknown!r} is not known" + (f": is it {near[0]}?" if near else "")
            raise InputError(
                f"{self.path}: line 1: {len(names)} joints ({names[0]}..{names[-1]}); {arm.name} has "
                f"{len(arm.joint_names)}{advice}"
            )
        unit = names[0][-3:]
        for k, name in enumerate(names, 1):
            if name != f"q{k}_{unit}":
                raise InputError(
                    f"{self.path}: line 1: has {name} where q{k}_{unit} is expected: joints are numbered from 1 on, "
                    "each once, all in degrees or all in radians"
                )
        q = self.numbers(names)
        if unit == "rad" and np.abs(q).max() > MOST_RAD:
            row, joint = np.unravel_index(int(np.abs(q).argmax()), q.shape)
            raise InputError(
                f"{self.path}: line {self.rows[row][0]}: q{joint + 1}_rad is {q[row, joint]:g}: are these degrees? name "
                "the columns q1_deg .."
            )
        return np.radians(q) if unit == "deg" else q

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
        twice = next((name for name in found if found.count(name) > 1), None)
        if twice is not None:
            raise InputError(f"{self.path}: {key} {twice!r} names two rows; a row belongs to one image")
        return found

    def rotations(self, rotation: str | None) -> tuple[Array, Array, str]:
        """Return the rotations (N, 3, 3), the numbers they come from, and their convention."""
        if "r11" in self.at:
            R = self.numbers([f"r{i}{j}" for i in "123" for j in "123"]).reshape(-1, 3, 3)
            return self._checked(R), np.zeros((len(R), 0)), ""
        if "qw" in self.at:
            found, convention = self.numbers(["qw", "qx", "qy", "qz"]), "wxyz"
        elif "n4" in self.at:
            if rotation not in ("wxyz", "xyzw"):
                raise InputError(
                    f"{self.path}: which of the four numbers of a quaternion is w? give --rotation wxyz or --rotation xyzw"
                )
            found, convention = self.numbers(["n1", "n2", "n3", "n4"]), rotation
        else:
            found, convention = self._angles(rotation)
        return self._checked(rotations_by(found, convention, self.path)), found, convention

    def _angles(self, rotation: str | None) -> tuple[Array, str]:
        """Return three numbers of a rotation (N, 3), degrees, and their convention."""
        unit = next((u for u in ("_rad", "_deg", "") if f"rx{u}" in self.at), None)
        names = ["n1", "n2", "n3"] if "n1" in self.at else [f"r{axis}{unit}" for axis in "xyz"]
        if unit is None and "n1" not in self.at:
            raise InputError(
                f"{self.path}: line 1: no rotation: qw qx qy qz, rx_deg ry_deg rz_deg, or r11 .. r33 are needed; there are "
                f"{', '.join(list(self.at)[:10])}"
            )
        found = self.numbers(names)
        convention = rotation or ("rotvec" if unit == "_rad" else None)
        if convention is None or convention in ("wxyz", "xyzw"):
            raise InputError(
                f"{self.path}: what do the three numbers of a rotation mean? give --rotation rotvec, or the order of the "
                "angles: xyz (about fixed axes), XYZ (about the rotated axes), zyx ..."
            )
        if unit == "_rad" and np.abs(found).max() > MOST_RAD:
            row, column = np.unravel_index(int(np.abs(found).argmax()), found.shape)
            raise InputError(
                f"{self.path}: line {self.rows[row][0]}: {names[column]} is {found[row, column]:g}: are these degrees? "
                "name the columns rx_deg ry_deg rz_deg"
            )
        radians = unit == "_rad" or (unit != "_deg" and bool((np.abs(found) <= 2 * np.pi + 1e-3).all()))
        return (np.degrees(found) if radians else found), convention

    def _checked(self, R: Array) -> Array:
        """Return rotations, cleaned of rounding."""
        for (line, _), one in zip(self.rows, R, strict=True):
            off, determinant = float(np.abs(one @ one.T - np.eye(3)).max()), float(np.linalg.det(one))
            if off < LOOSE and determinant < 0:
                raise InputError(
                    f"{self.path}: line {line}: the 3x3 part is left-handed (determinant -1): an axis is mirrored; robot "
                    "and camera poses are right-handed: exchange no axes without a sign"
                )
            if off >= LOOSE:
                raise InputError(
                    f"{self.path}: line {line}: the 3x3 part is no rotation (R R^T differs from 1 by {off:.2g})"
                )
        return np.asarray([nearest_rotation(one) for one in R])


def rotations_by(numbers: Array, convention: str, path: Path) -> Array:
    """Return rotations (N, 3, 3) of quaternions (N, 4), or of angles (N, 3) in degrees, in a convention.

    Raises:
        InputError: a quaternion whose length is not 1.
    """
    if convention in ("wxyz", "xyzw"):
        lengths = np.linalg.norm(numbers, axis=1)
        if (np.abs(lengths - 1) > 1e-2).any():
            raise InputError(f"{path}: a quaternion has length {lengths[np.argmax(np.abs(lengths - 1))]:.4g}, not 1")
        return np.asarray(Rotation.from_quat(numbers[:, [1, 2, 3, 0]] if convention == "wxyz" else numbers).as_matrix())
    if convention == "rotvec":
        return np.asarray(Rotation.from_rotvec(np.radians(numbers)).as_matrix())
    order = ["xyz".index(axis) for axis in convention.lower()]
    return np.asarray(Rotation.from_euler(convention, np.radians(numbers[:, order])).as_matrix())


def stacked(R: Array, p: Array) -> Array:
    """Return poses (N, 4, 4) of rotations (N, 3, 3) and positions (N, 3)."""
    Ts = np.tile(np.eye(4), (len(R), 1, 1))
    Ts[:, :3, :3], Ts[:, :3, 3] = R, p
    return Ts


def _positions(table: _Columns, unit: str | None, detect: bool) -> tuple[Array, float, tuple[str, ...]]:
    """Return positions (N, 3), m, the unit they were read in, and notes."""
    suffix = next((s for s in ("_m", "_mm", "") if f"x{s}" in table.at), None)
    if suffix is None:
        if any(_UNITLESS.fullmatch(name.lower()) for name in table.at):
            raise InputError(
                f"{table.path}: line 1: joints without a unit: name them q1_deg .. or q1_rad .., and give --model"
            )
        raise InputError(
            f"{table.path}: line 1: no positions: x_m y_m z_m or x_mm y_mm z_mm are needed, or, with "
            f"--model, joints q1_rad .. or q1_deg ..; there are {', '.join(list(table.at)[:10])}: --columns x_m=NAME,... "
            "gives yours"
        )
    p = table.numbers([f"{axis}{suffix}" for axis in "xyz"])
    given = suffix[1:] or unit
    unit_m = 1e-3 if given == "mm" else 1.0
    far = float(np.abs(p).max()) * unit_m
    if unit_m == 1.0 and far > FAR_M:
        lengths = np.linalg.norm(p, axis=1)
        near = np.flatnonzero((lengths < min(lengths.max() / MIXED, FAR_M)) & (lengths > NEAR_M))
        if len(near) > 1 and (given is None or suffix == "_m"):  # one alone may be at the base's origin
            large, small = (table.rows[k][0] for k in (int(lengths.argmax()), near[0]))
            raise InputError(
                f"{table.path}: line {large} is {lengths.max():.0f} m from the base, {small} {lengths[near[0]]:.2g} m: "
                f"are some rows in millimetres? {len(near)} of {len(p)} rows are near; write all in one unit"
            )
        if not detect:
            raise InputError(
                f"{table.path}: positions of up to {far:.0f} m: are they millimetres? name the columns x_mm y_mm z_mm, or "
                f"give {'' if suffix else '--units mm, or '}--detect-units"
            )
        return 1e-3 * p, 1e-3, (f"{table.path}: positions read as millimetres: as metres they would reach {far:.0f} m",)
    if unit_m == 1e-3 and far < NEAR_M:
        if not detect:
            raise InputError(
                f"{table.path}: positions of at most {1e3 * far:.2g} mm: are they metres? name the columns x_m y_m z_m, or "
                f"give {'' if suffix else '--units m, or '}--detect-units"
            )
        return (
            p,
            1.0,
            (f"{table.path}: positions read as metres: as millimetres they would stay within {1e3 * far:.2g} mm",),
        )
    return unit_m * p, unit_m, ()
