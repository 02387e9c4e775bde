"""Tables of poses as robots, cameras and people write them.

In: a file of any form that ``cells.py`` reads. Out: :class:`PoseTable`. The columns are those of ``columns.py``, in any
order: ``x_m y_m z_m`` (or ``x_mm``, or ``x`` with ``unit``); ``qw qx qy qz``; or ``rx_deg ry_deg rz_deg`` (or ``rx_rad``,
or ``rx``); or ``r11 .. r33``; or joints ``q1_deg ..`` (``q1_rad``) of an arm, also by their names. ``t_s`` is a time,
``image`` the image that belongs to a row, ``name`` (``shot`` in what ``armsight measure`` writes) a name that both tables
share. A row whose pose is empty, not finite, a word or a rotation of zeros, or whose ``status`` is not ok, was missed: it
counts where rows of two tables belong together by their order, and is left out. Without names: 16 (or 12) numbers a row, a
matrix; 7: x, y, z and a quaternion; 6: x, y, z and three numbers of a rotation, whose convention ``rotation`` names.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Record
from armsight.errors import InputError, some
from armsight.files import columns_unused
from armsight.geometry.pose import pose
from armsight.tables.cells import Cells, Renames, Rows, read_cells, read_columns
from armsight.tables.columns import COLUMNS, UNITLESS, Columns, degree_columns, joint_columns, understood
from armsight.tables.lengths import REACH, UNITS_M
from armsight.tables.nested import PREFIX
from armsight.tables.rotations import CONVENTIONS

#: Lengths beyond this, m, are no robot's: they are mm; below the other, all of them, they are m taken for mm.
_, NEAR_M, FAR_M = REACH
#: No arm here reaches further, m; half: a large KUKA in cm is taken for mm alone, double: small ones in inches are named.
REACH_M = 3.0
MOST_DEG = 360.0  # an angle in degrees is not larger
MIXED = 200.0  # lengths that differ by more than this factor in one table are not in one unit
_MEASURED = {"status", "reason", "x_m"}  # columns of what `armsight measure` writes


class ArmJoints(Protocol):
    """What a table needs of an arm: its name, its joints' names, and where the flange is at joint angles."""

    @property
    def name(self) -> str:
        """Its name."""

    @property
    def joint_names(self) -> tuple[str, ...]:
        """The names of its joints."""

    def forward(self, q: Array) -> Array:
        """Return the flange (N, 4, 4) at joint angles (N, J), rad."""


@dataclass(frozen=True, eq=False)
class PoseTable(Record):
    """The poses of a file."""

    path: Path  #: the file
    lines: NDArray[np.int64]  #: (N,) the line of each row
    Ts: Array  #: (N, 4, 4) the poses, m
    #: (N, K) the numbers of the rotations as in the file; K is 0 for matrices and joints
    numbers: Array = field(default_factory=lambda: np.zeros((0, 0)))
    #: (N, 6) or (N, 7) position and rotation as in the file, where its columns have this order; (N, 0) else
    written: Array = field(default_factory=lambda: np.zeros((0, 0)))
    convention: str = ""  #: what they were taken for, as ``rotation``; "" for matrices and joints
    q: Array | None = None  #: (N, J) joint angles, rad; None where there are none
    t_s: Array | None = None  #: (N,) times, s; None where there are none
    names: tuple[str, ...] | None = None  #: of the rows, or of their images; None where there are none
    unit_m: float = 1.0  #: the unit that lengths were read in, m
    notes: tuple[str, ...] = ()  #: what was found out while reading
    missed: tuple[str, ...] = ()  #: (N,) why a row has no pose, and another's stands there; "" where it has one
    of_joints: bool = False  #: whether the poses are those of the joints by the model
    unused: tuple[str, ...] = ()  #: the columns that were not read
    located: bool = False  #: whether there are columns of positions, read or not

    def without_missed(self) -> PoseTable:
        """Return the rows that have a pose, with a note on the others."""
        if not any(self.missed):
            return self
        gone = [f"line {line} ({why})" for line, why in zip(self.lines, self.missed, strict=True) if why]
        kept = np.array([not why for why in self.missed])
        note = f"{self.path}: {len(gone)} of {len(kept)} rows have no pose, and are left out: {some(gone)}"
        return replace(
            self,
            lines=self.lines[kept],
            Ts=self.Ts[kept],
            numbers=self.numbers[kept],
            written=self.written[kept],
            q=None if self.q is None else self.q[kept],
            t_s=None if self.t_s is None else self.t_s[kept],
            names=None if self.names is None else tuple(itertools.compress(self.names, kept)),
            notes=(*self.notes, note),
            missed=("",) * int(kept.sum()),
        )


def read_pose_table(
    path: str | Path,
    *,
    rotation: str | None = None,
    unit: str | None = None,
    detect_units: bool = False,
    columns: Renames | None = None,
    arm: ArmJoints | None = None,
    only_joints: bool = False,
    side: str = "robot",
    keep_missed: bool = False,
) -> PoseTable:
    """Read a table of poses.

    Args:
        path: the file.
        rotation: what three or four numbers of a rotation are: "wxyz", "xyzw", "rotvec", or the order of the axes, "zyx"
            about fixed ones, "ZYX" about those that rotate; None: what the columns' names say.
        unit: "m" or "mm" for lengths whose columns do not name one; None: m.
        detect_units: whether lengths that cannot be metres are taken for millimetres, with a note.
        columns: a mapping of names ("x_mm", "qw", "q1_deg") to the file's, as text NAME=THEIRS,... or the names of all in
            their order.
        arm: the model whose joints the table has.
        only_joints: whether positions are passed over: the poses are then those of the joints.
        side: "robot" or "seen": whose poses are read where a file holds both; "tool": the robot's, never of joints.
        keep_missed: whether rows without a pose stay, marked by ``missed``, so that rows of another table fit; else they
            are left out, with a note.

    Raises:
        InputError: the file, the line and what was expected.
    """
    path = Path(path)
    rotation_given, whose, side = rotation, side, side.replace("tool", "robot")
    table, rotation, notes = _table(path, rotation, unit, columns, arm, side)
    names = table.joint_names(*((len(arm.joint_names), arm.name) if arm is not None else (None, "")))
    q = table.joints(names) if names else None
    if only_joints and q is None:
        raise InputError(
            f"{path}: line 1: no joint angles: q1_deg .. or q1_rad .. are needed; there are {table.near('q1_deg')}"
        )
    nothing = np.zeros((len(table.rows), 0))
    numbers, written, convention, unit_m, of_joints = nothing, nothing, "", 1.0, False
    located = bool(table.at.keys() & {"x", "x_m", "x_mm"})
    if q is None or (located and not (only_joints and arm is not None)):
        p, unit_m, found_out = _positions(table, unit, detect_units, side)
        notes = (*notes, *found_out)
        R, numbers, convention, written = table.rotations(rotation, PREFIX[side])
        written = np.hstack([p / unit_m, written]) if written.shape[1] else written
        Ts = pose(R, p)
    else:
        Ts, of_joints = _of_joints(path, q, arm, whose), True
    t_s, row_names, lines = table.times(), table.names(), np.array([line for line, _ in table.rows])
    passed = table.used | {"_0", "_1", "_2", "_3"}
    unused = tuple(table.given[k] for name, k in table.at.items() if name not in passed)
    if arm is not None and q is None:
        notes = (*notes, f"{path}: has no joint angles: --model {arm.name} is not used")
    if not only_joints:
        useless = rotation_given if rotation_given != convention else None
        notes = (*notes, *_not_used(path, side, useless, () if set(table.at) >= _MEASURED else unused))
    missed = tuple(table.missed or ())
    rows, how = (lines, Ts, numbers, written), (of_joints, unused, located)
    found = PoseTable(path, *rows, convention, q, t_s, row_names, unit_m, notes, missed, *how)
    return found if keep_missed else found.without_missed()


def _of_joints(path: Path, q: Array, arm: ArmJoints | None, side: str) -> Array:
    """Return the arm's poses (N, 4, 4) at joints (N, n), rad; InputError without an arm, or where cameras' are needed."""
    if side != "robot":
        of = {"seen": "that cameras saw", "tool": "of the tool"}[side]
        raise InputError(
            f"{path}: holds joint angles alone, no poses {of}: x_m y_m z_m or x_mm y_mm z_mm are needed, and rotations"
        )
    if arm is None:
        raise InputError(f"{path}: joint angles need the arm: give --model, a name (armsight arm list) or a .urdf file")
    return np.asarray(arm.forward(q))


def _not_used(path: Path, side: str, rotation: str | None, columns: tuple[str, ...]) -> list[str]:
    """Return notes of an option and of columns that are not used."""
    option = f"--columns {PREFIX[side]}rotation={rotation}"
    notes = [f"{path}: {option} is not used: its columns say what its rotations are"] if rotation is not None else []
    return [*notes, f"{path}: {columns_unused(columns)}"] if columns else notes


def _table(
    path: Path,
    rotation: str | None,
    unit: str | None,
    columns: Renames | None,
    arm: ArmJoints | None,
    side: str,
) -> tuple[Columns, str | None, tuple[str, ...]]:
    """Return the columns of a file, the convention of its rotations, and notes."""
    if rotation is not None and rotation not in CONVENTIONS:
        raise InputError(f"the rotation convention is {rotation!r}; known are {', '.join(CONVENTIONS)}")
    links = () if arm is None else arm.joint_names
    cells = read_cells(path, read_columns(columns, (*COLUMNS, *joint_columns(links), "pose")), side)
    if cells.listed:
        notes = _notes_of_lists(path, cells.rows[0], arm, unit, rotation)
        names = ["x", "y", "z", "rx_rad", "ry_rad", "rz_rad"] if len(cells.head) == 6 else cells.head
        cells = cells._replace(head=names, notes=(*cells.notes, *notes))
    table, rotation, notes = columns_in(path, cells, links, unit, rotation)
    table.missed = [""] * len(table.rows)
    if set(table.at) >= _MEASURED:
        table.used |= {"status", "reason"}
        said = zip(table.texts("status"), table.texts("reason"), strict=True)
        table.missed = ["" if status == "ok" else reason or status or "no status" for status, reason in said]
    return table, rotation, notes


def columns_in(
    path: Path, cells: Cells, links: Sequence[str], unit: str | None, rotation: str | None
) -> tuple[Columns, str | None, tuple[str, ...]]:
    """Return the columns of a file's cells by our names, the convention of its rotations, and notes.

    ``links``: names of the joints of an arm. ``unit``: of lengths whose columns name none. ``rotation``: the convention
    where it is given.
    """
    head, *body = degree_columns(path, [cells.head, *(row for _, row in cells.rows)])
    head, convention, notes = understood(path, head, links, unit, rotation or cells.rotation)
    rows: Rows = [(line, row) for (line, _), row in zip(cells.rows, body, strict=True)]
    return Columns(path, head, rows, links, cells.head), convention, (*cells.notes, *notes)


def _notes_of_lists(
    path: Path, first: tuple[int, list[str]], arm: ArmJoints | None, unit: str | None, rotation: str | None
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


def _positions(table: Columns, unit: str | None, detect: bool, side: str) -> tuple[Array, float, tuple[str, ...]]:
    """Return positions (N, 3), m, the unit they were read in, and notes."""
    suffix, option = _suffix(table), f"--columns {PREFIX[side]}"
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
                f"give {'' if suffix else f'{option}units=mm or '}{option}units=detect{_or_else(table, far, side)}"
            )
        return 1e-3 * p, 1e-3, (f"{table.path}: positions read as millimetres: as metres they would reach {far:.0f} m",)
    if unit_m == 1e-3 and far < NEAR_M:
        if not detect:
            raise InputError(
                f"{table.path}: positions of at most {1e3 * far:.2g} mm: are they metres? name the columns x_m y_m z_m, or "
                f"give {'' if suffix else f'{option}units=m or '}{option}units=detect"
            )
        within = f"as millimetres they would stay within {1e3 * far:.2g} mm"
        return p, 1.0, (f"{table.path}: positions read as metres: {within}",)
    return unit_m * p, unit_m, ()


def _suffix(table: Columns) -> str:
    suffix = next((s for s in ("_m", "_mm", "") if f"x{s}" in table.at), None)
    if suffix is not None:
        return suffix
    if any(UNITLESS.fullmatch(name.lower()) for name in table.at):
        raise InputError(
            f"{table.path}: line 1: joints without a unit: name them q1_deg .. or q1_rad .., and give --model"
        )
    raise InputError(
        f"{table.path}: line 1: no positions: x_m y_m z_m or x_mm y_mm z_mm are needed, or, with --model, joints q1_rad .. "
        f"or q1_deg ..; there are {table.near('x_m')}: --columns x_m=NAME,... gives yours"
    )


def _or_else(table: Columns, far: float, side: str) -> str:
    """Return what else lengths that are too large for metres may be: of another unit, or the angles of six numbers."""
    others = [name for name in ("cm", "inches") if far * UNITS_M[name] <= REACH_M < far]
    said = f"; or in {' or '.join(others)}? write those in m or mm" if others else ""
    if "n1" not in table.at or "n4" in table.at or far > MOST_DEG:
        return said
    if not NEAR_M < np.linalg.norm(table.numbers(["n1", "n2", "n3"]), axis=1).max() < FAR_M:
        return said
    option = f"--columns {PREFIX[side]}rx,ry,rz,x,y,z"
    return f"{said}; or are they degrees, and the rotation comes before the position? then {option}"
