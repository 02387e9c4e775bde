"""Joint angles and the tool's measured positions or poses, from any file that :mod:`armsight.tables` reads.

Columns, in any order; others are ignored: joints q1_rad .. (or q1_deg .., or the arm's own names); then tracked points
p1_x_mm, p1_y_mm, p1_z_mm, p2_x_mm, .. (or _m), or one, x_m, y_m, z_m (or _mm), with rx_deg, ry_deg, rz_deg where an
instrument gives angles and their convention is given; or full poses x_m, y_m, z_m, qw, qx, qy, qz (or r11 .. r33), with
cov_00 .. cov_55 as ``armsight measure`` writes them; approach1 .. (1, -1, 0).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array
from armsight.errors import InputError
from armsight.loop.identify.measured import Measured
from armsight.robot.kinematics.table import FEWEST_JOINTS, MOST_JOINTS
from armsight.tables.cells import Cells, read_cells, read_columns
from armsight.tables.columns import COLUMNS as _COLUMNS
from armsight.tables.columns import Columns, degree_columns, understood
from armsight.tables.poses import ArmJoints
from armsight.tables.rotations import ROTATIONS, rotations_by

_UPPER = [(i, j) for i in range(6) for j in range(i, 6)]
_COV = [f"cov_{i}{j}" for i, j in _UPPER]
_QUATERNION = ["qw", "qx", "qy", "qz"]
_MATRIX = [f"r{i}{j}" for i in "123" for j in "123"]
_METRES = {"mm": 1e-3, "m": 1.0, "": 1.0}
#: The names that ``columns`` may say the file's own for.
COLUMNS = (
    *_COLUMNS,
    *(f"p{k}_{axis}_{unit}" for k in range(1, 10) for axis in "xyz" for unit in ("mm", "m")),
    *_COV,
    *(f"approach{i}" for i in range(1, MOST_JOINTS + 1)),
)


@dataclass(frozen=True, eq=False, kw_only=True)
class AnglesMeasured(Measured):
    """Full poses whose rotations came as three angles, which may follow another convention than was given.

    Attributes:
        angles_deg: (N, 3) rx, ry, rz as in the file, degrees.
        rotation: the convention given for them, one of ROTATIONS.
    """

    angles_deg: Array
    rotation: str


class Read(NamedTuple):
    """The contents of a file.

    Attributes:
        measured: its good rows.
        lines: (N,) the line of the file that each row comes from.
        notes: what was left out, and why, as text.
    """

    measured: Measured
    lines: Array
    notes: tuple[str, ...]


def read_poses(
    path: str | Path, *, rotation: str | None = None, columns: str | None = None, arm: ArmJoints | None = None
) -> Read:
    """Read a file.

    Args:
        path: the file.
        rotation: the convention of rx_deg, ry_deg, rz_deg, one of ROTATIONS; None: they are not used.
        columns: what the file calls its columns, NAME=THEIRS,... with names of COLUMNS, or the names of all in order.
        arm: whose joints they are, where that is known.

    Raises:
        InputError: unreadable, columns missing, fields that are no numbers, or hardly a row without gaps.
    """
    cells = read_cells(Path(path), read_columns(columns, (*COLUMNS, "pose")))
    return poses_in(path, cells, rotation=rotation, arm=arm)


def poses_in(path: str | Path, cells: Cells, *, rotation: str | None = None, arm: ArmJoints | None = None) -> Read:
    """Read the cells of a file as :func:`read_poses` does; blank rows are passed over.

    Args:
        path: the file, for errors.
        cells: its names and rows.
        rotation: as in :func:`read_poses`.
        arm: likewise.

    Raises:
        InputError: as :func:`read_poses`.
    """
    if rotation is not None and rotation not in ROTATIONS:
        raise InputError(f"the rotation convention is {rotation!r}; known are {', '.join(ROTATIONS)}")
    rows = [(line, row) for line, row in cells.rows if any(row)]
    joint_names = () if arm is None else arm.joint_names
    head, *body = degree_columns(path, [cells.head, *(row for _, row in rows)])
    head, convention, notes = understood(Path(path), head, joint_names, None, rotation or cells.rotation)
    table = Columns(Path(path), head, [(line, row) for (line, _), row in zip(rows, body, strict=True)], joint_names)
    joints = _joints(table, arm)
    points, unit = _points(table)
    rotated, notes_of = _rotation_columns(table, convention)
    covariance = _COV if rotated is not None and "cov_00" in table.at else []
    approach = [f"approach{i + 1}" for i in range(len(joints))] if "approach1" in table.at else []
    requested = [*joints, *(name for point in points for name in point), *(rotated or []), *covariance, *approach]
    numbers = table.numbers(requested, gaps=True)
    good = np.array(np.isfinite(numbers).all(axis=1))
    notes = (*cells.notes, *notes, *notes_of, *_gaps(table, requested, numbers), *_repeated(table, numbers, good))
    table = Columns(table.path, head, [row for row, kept in zip(table.rows, good, strict=True) if kept], joint_names)
    p = np.stack([unit * table.numbers(point) for point in points], axis=1)
    sides = _sides(table, approach)
    lines = np.array([line for line, _ in table.rows], float)
    return Read(_measured(table, joints, p, rotated, convention, sides), lines, notes)


def _sides(table: Columns, columns: list[str]) -> Array | None:
    """Return from which side each joint came, (N, n); None without the columns."""
    sides = table.numbers(columns) if columns else None
    if sides is not None and not np.isin(sides, (-1, 0, 1)).all():
        raise InputError(
            f"{table.path}: a direction of approach must be 1 (the angle grew), -1 (it fell) or 0 (not known)"
        )
    return sides


def _joints(table: Columns, arm: ArmJoints | None) -> list[str]:
    """Return the columns of the joints."""
    joints = table.joint_names() if arm is None else table.joint_names(len(arm.joint_names), arm.name)
    if not joints:
        most = 6 if arm is None else len(arm.joint_names)
        raise InputError(
            f"{table.path}: line 1: no joint angles; columns q1_rad .. q{most}_rad or q1_deg .. q{most}_deg are needed, "
            f"there are {', '.join(list(table.at)[:8])}"
        )
    if not FEWEST_JOINTS <= len(joints) <= MOST_JOINTS:
        raise InputError(
            f"{table.path}: line 1: columns {joints[0]} .. {joints[-1]}: an arm here has {FEWEST_JOINTS} to "
            f"{MOST_JOINTS} joints"
        )
    return joints


def _points(table: Columns) -> tuple[list[list[str]], float]:
    """Return the columns of the points, or of the one position, and their unit, m."""
    if "qw" not in table.at and "r11" not in table.at:
        for unit in ("mm", "m"):
            points: list[list[str]] = []
            while f"p{len(points) + 1}_x_{unit}" in table.at:
                points.append([f"p{len(points) + 1}_{axis}_{unit}" for axis in "xyz"])
            if points:
                return points, _METRES[unit]
    for unit in ("m", "mm", ""):
        names = [f"{axis}_{unit}".rstrip("_") for axis in "xyz"]
        if names[0] in table.at:
            return [names], _METRES[unit]
    raise InputError(
        f"{table.path}: line 1: no point 1; columns p1_x_mm .. p1_z_mm, or x_m .. z_m, are needed, there are "
        f"{', '.join(list(table.at)[:8])}: --columns p1_x_mm=NAME,... gives yours"
    )


def _rotation_columns(table: Columns, convention: str | None) -> tuple[list[str] | None, tuple[str, ...]]:
    """Return the columns of the rotation, None where there are none that are used, and a note then."""
    for names in (_QUATERNION, _MATRIX):
        if names[0] in table.at:
            return names, ()
    unit = next((unit for unit in ("_deg", "_rad", "") if f"rx{unit}" in table.at), None)
    if unit is None:
        if convention is not None:
            table.numbers(["rx_deg", "ry_deg", "rz_deg"])
        return None, ()
    if convention is None:
        return None, (f"rx{unit}, ry{unit}, rz{unit} are not used: give their convention with --rotation",)
    return [f"r{axis}{unit}" for axis in "xyz"], ()


def _gaps(table: Columns, requested: list[str], numbers: Array) -> tuple[str, ...]:
    """Return a note on rows with gaps; reject a file that has hardly another."""
    gaps = np.flatnonzero(~np.isfinite(numbers).all(axis=1))
    named = [(table.rows[k][0], requested[int(np.argmin(np.isfinite(numbers[k])))]) for k in gaps]
    if len(gaps) > len(numbers) - len(gaps):
        line, name = named[0]
        raise InputError(
            f"{table.path}: {len(gaps)} of {len(numbers)} rows have gaps; the first is line {line}: {name}"
        )
    if len(numbers) == 0:
        raise InputError(f"{table.path}: no rows; one line a pose is needed")
    where = ", ".join(f"line {line} ({name})" for line, name in named[:5]) + (", .." if len(gaps) > 5 else "")
    return (f"{len(gaps)} rows left out, empty or no finite number: {where}",) if named else ()


def _repeated(table: Columns, numbers: Array, good: NDArray[np.bool_]) -> tuple[str, ...]:
    """Leave rows that repeat another to the last digit out of the good ones: they are no further evidence; note them."""
    rows = np.flatnonzero(good)
    again = np.delete(rows, np.unique(numbers[rows], axis=0, return_index=True)[1])
    good[again] = False
    where = ", ".join(f"line {table.rows[k][0]}" for k in again[:5]) + (", .." if len(again) > 5 else "")
    return (f"{len(again)} rows repeat another to the last digit, and are left out: {where}",) if len(again) else ()


def _measured(
    table: Columns,
    joints: list[str],
    p: Array,
    rotated: list[str] | None,
    convention: str | None,
    approach: Array | None,
) -> Measured:
    """Assemble the columns, in SI units."""
    q = table.joints(joints)
    if rotated is None:
        return Measured(q, p, None, None, approach)
    if p.shape[1] != 1:
        raise InputError(f"{table.path}: angles go with one point, p1; there are {p.shape[1]}")
    R, angles, used, _ = table.rotations(convention)
    if rotated[0].startswith("rx"):
        return AnglesMeasured(q, p, R, None, approach, angles_deg=angles, rotation=used)
    return Measured(q, p, R, _covariance(table, R) if "cov_00" in table.at else None, approach)


def rotations_of(angles_deg: Array, rotation: str) -> Array:
    """Return the rotations (N, 3, 3) of angles rx, ry, rz (N, 3), degrees, in one of the conventions of ROTATIONS."""
    return rotations_by(angles_deg, rotation, Path())


def _covariance(table: Columns, R: Array) -> Array:
    """Return covariances of the right tangent from those along the rig's axes that ``armsight measure`` writes."""
    C = np.zeros((len(R), 6, 6))
    for (i, j), column in zip(_UPPER, table.numbers(_COV).T, strict=True):
        C[:, i, j] = C[:, j, i] = column
    back = np.zeros_like(C)
    back[:, :3, :3] = back[:, 3:, 3:] = R.swapaxes(1, 2)
    C = back @ C @ back.swapaxes(1, 2)
    if np.linalg.eigvalsh(C).min() < 0:
        raise InputError(f"{table.path}: cov_00 .. cov_55 are no covariance: an eigenvalue is negative")
    return np.asarray(C)
