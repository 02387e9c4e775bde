"""Joint angles and the tool's measured positions or poses, from any file that :mod:`armsight.tables` reads.

Columns, in any order; others are ignored: joints q1_rad .. (or q1_deg .., or the arm's own names); then tracked points
p1_x_mm, p1_y_mm, p1_z_mm, p2_x_mm, .. (or _m), or one, x_m, y_m, z_m (or _mm), with rx_deg, ry_deg, rz_deg where an
instrument gives angles and their convention is given; or full poses x_m, y_m, z_m, qw, qx, qy, qz (or r11 .. r33), with
cov_00 .. cov_55 as ``armsight measure`` writes them; approach1 .. (1, -1, 0). The joints may be in a table of their own.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array
from armsight.errors import InputError
from armsight.loop.handeye.recording import matched_rows
from armsight.loop.identify.measured import Measured, Read
from armsight.robot.kinematics.arm import Arm
from armsight.robot.kinematics.table import FEWEST_JOINTS, MOST_JOINTS
from armsight.tables.cells import Cells, Renames, Rows, column_parts, read_cells, read_columns
from armsight.tables.columns import COLUMNS as _COLUMNS
from armsight.tables.columns import NAMES, TIMES, Columns, joint_columns
from armsight.tables.lengths import number
from armsight.tables.poses import ArmJoints, PoseTable, columns_in, read_pose_table
from armsight.tables.rotations import ROTATIONS

_UPPER = [(i, j) for i in range(6) for j in range(i, 6)]
_COV = [f"cov_{i}{j}" for i, j in _UPPER]
#: The names that ``columns`` may say the file's own for.
COLUMNS = (
    *_COLUMNS,
    *(f"p{k}_{axis}_{unit}" for k in range(1, 10) for axis in "xyz" for unit in ("mm", "m")),
    *_COV,
    *(f"approach{i}" for i in range(1, MOST_JOINTS + 1)),
)
#: Joined by time, a shot counts where no joint reads further from its angle than this, rad, so long before and after,
#: s.
REST_RAD, REST_S = 3e-3, 0.2


def read_poses(
    path: str | Path, *, rotation: str | None = None, columns: Renames | None = None, arm: ArmJoints | None = None
) -> Read:
    """Read joint angles and the poses measured at them: a table with names in line 1, a row a pose.

    Joints are q1_rad .. or q1_deg .., positions x_m y_m z_m or x_mm .., rotations qw qx qy qz, or rx_deg .. with
    ``rotation``. docs/reference/pose_tables.md lists all columns.

    Args:
        path: the file.
        rotation: the convention of rx_deg, ry_deg, rz_deg, such as "zyx"; None: they are not used; a wrong one: the error
            lists all.
        columns: a mapping of these names to the file's, as text NAME=THEIRS,... or the names of all in order.
        arm: whose joints they are, where that is known.

    Raises:
        InputError: unreadable, columns missing, fields that are no numbers, or hardly a row without gaps.
    """
    known = (*COLUMNS, *joint_columns(() if arm is None else arm.joint_names), "pose")
    return _poses_in(Path(path), read_cells(Path(path), read_columns(columns, known)), rotation, arm)


def read_measured(
    data: Path, arm: Arm, joints: Path | None = None, *, rotation: str | None = None, columns: Renames | None = None
) -> Read:
    """Read measured poses with their joint angles, of one file or of two.

    Args:
        data: the poses; with their joint angles if ``joints`` is None.
        arm: whose joints they are.
        joints: a table of joint angles, joined to the poses by the names of their rows (``image``, ``name``, ``shot``), by
            order where there are none, or by time (``t_s``) where the tables have other numbers of rows.
        rotation: as in :func:`read_poses`.
        columns: as in :func:`read_poses`; joints, times and names may be those of ``joints``.

    Raises:
        InputError: either file, or they do not fit together.
    """
    if joints is None:
        return read_poses(data, rotation=rotation, columns=columns, arm=arm)
    parts = column_parts(columns)
    own = (*NAMES, *joint_columns(arm.joint_names))
    theirs = [part for part in parts if part.partition("=")[0].strip() in own or re.match(r"\s*q\d+_", part)]
    table = read_pose_table(joints, columns=theirs, arm=arm, only_joints=True, keep_missed=True)
    ours = [part for part in parts if part not in theirs]
    cells, notes = _with_joints(data, read_cells(data, read_columns(ours, COLUMNS), "seen"), table)
    read = _poses_in(data, cells, rotation)
    return read._replace(notes=(*table.notes, *notes, *read.notes))


def _with_joints(data: Path, read: Cells, table: PoseTable) -> tuple[Cells, list[str]]:
    """Return a table's cells with the joint angles of each row, without those that have none or no pose, and notes."""
    assert table.q is not None
    head = read.head
    if own := next((name for name in head if re.fullmatch(r"q\d+_(rad|deg)", name)), None):
        raise InputError(f"{data}: line 1: has joint angles of its own ({own}): leave them out, or --joints")
    understood = columns_in(data, read, (), None, None)[0]
    positions = understood.numbers([name for point in _points(understood)[0] for name in point], gaps=True)
    good = np.asarray(np.isfinite(positions).all(axis=1))
    shown = {line for (line, _), there in zip(read.rows, good, strict=True) if there}
    angles, notes = _angles(data, head, read.rows, shown, table)
    if len(shown) < len(read.rows):
        notes.append(f"{len(read.rows) - len(shown)} of {len(read.rows)} shots were missed, and are left out")
    joined = [(line, [*row, *map(repr, angles[line].tolist())]) for line, row in read.rows if line in angles]
    return read._replace(head=[*head, *(f"q{k}_rad" for k in range(1, table.q.shape[1] + 1))], rows=joined), notes


def _angles(
    data: Path, head: list[str], rows: Rows, shown: Collection[int], table: PoseTable
) -> tuple[dict[int, Array], list[str]]:
    """Return the joint angles (J,), rad, of the ``shown`` rows by their lines, paired by time, name or order; and notes."""
    assert table.q is not None
    timed = [k for k, name in enumerate(head) if name in TIMES]
    if table.names is None and len(table.q) != len(rows) and table.t_s is not None and timed:
        at = [(line, row[timed[0]]) for line, row in rows if line in shown]
        return _at_rest(data, at, table.without_missed())
    return _by_rows(data, head, rows, shown, table)


def _by_rows(
    data: Path, head: list[str], rows: Rows, shown: Collection[int], table: PoseTable
) -> tuple[dict[int, Array], list[str]]:
    """Return what :func:`_angles` does, paired by name or order."""
    assert table.q is not None
    key = next((name for name in NAMES if name in head), None)
    if table.names is not None and key is None:
        raise InputError(
            f"{data}: line 1: no column {', '.join(NAMES)}, by which {table.path} names its rows; there are "
            f"{', '.join(head)}"
        )
    names = [f"line {line}" if key is None else row[head.index(key)] for line, row in rows]
    missed = ["" if line in shown else "no pose" for line, _ in rows]
    pairs = {rows[i][0]: row for row, i in zip(*matched_rows(table, names, missed), strict=True)}
    angles = {line: table.q[row] for line, row in pairs.items() if line in shown and not table.missed[row]}
    alone = len(shown) - len(angles)
    return angles, [f"{alone} of {len(rows)} poses have no row in {table.path}, and are left out"] if alone else []


def _at_rest(data: Path, shots: list[tuple[int, str]], table: PoseTable) -> tuple[dict[int, Array], list[str]]:
    """Return the joint angles (J,), rad, at the middle shot of each rest, by its line, and notes; shots: lines, times."""
    assert table.t_s is not None
    assert table.q is not None
    order = np.argsort(table.t_s, kind="stable")
    t_s, q = table.t_s[order], table.q[order]
    rests, inside = list[list[tuple[int, Array]]](), 0
    for line, cell in shots:
        at = number(cell)
        if at is None:
            raise InputError(f"{data}: line {line}: t_s is {cell!r}, must be a number, s")
        if not t_s[0] <= at <= t_s[-1]:
            continue
        inside += 1
        near = q[max(np.searchsorted(t_s, at - REST_S) - 1, 0) : np.searchsorted(t_s, at + REST_S, side="right") + 1]
        here = np.array([np.interp(at, t_s, column) for column in q.T])
        if np.abs(near - here).max() > REST_RAD:
            continue
        if not rests or np.abs(rests[-1][0][1] - here).max() > REST_RAD:
            rests.append([])
        rests[-1].append((line, here))
    if not inside:
        raise InputError(
            f"{data}: no time t_s is within those of {table.path}, {t_s[0]:.1f} to {t_s[-1]:.1f} s: other clocks? name the "
            f"rows of both tables instead ({', '.join(NAMES)})"
        )
    if not rests:
        raise InputError(
            f"{data}: the arm never rests at a shot, by {table.path}: let it rest {2 * REST_S:g} s and more at each pose"
        )
    notes = [f"{len(rests)} rests of the arm, by {table.path}; of each the middle shot counts, of {len(shots)} shots"]
    return dict(rest[len(rest) // 2] for rest in rests), notes


def _poses_in(path: Path, cells: Cells, rotation: str | None, arm: ArmJoints | None = None) -> Read:
    """Read the cells of a file as :func:`read_poses` does; blank rows are passed over."""
    if rotation is not None and rotation not in ROTATIONS:
        raise InputError(f"the rotation convention is {rotation!r}; known are {', '.join(ROTATIONS)}")
    cells, links = (
        cells._replace(rows=[row for row in cells.rows if any(row[1])]),
        () if arm is None else arm.joint_names,
    )
    table, convention, notes = columns_in(path, cells, links, None, rotation)
    joints = _joints(table, arm)
    points, unit = _points(table)
    rotated, unused = _rotation_columns(table, convention)
    covariance = _COV if rotated and not rotated[0].startswith("rx") and "cov_00" in table.at else []
    approach = [f"approach{i + 1}" for i in range(len(joints))] if "approach1" in table.at else []
    requested = [*joints, *(name for point in points for name in point), *rotated, *covariance, *approach]
    numbers = table.numbers(requested, gaps=True)
    good = np.array(np.isfinite(numbers).all(axis=1))
    notes = (*notes, *unused, *_gaps(table, requested, numbers), *_repeated(table, numbers, good))
    rows = [row for row, kept in zip(table.rows, good, strict=True) if kept]
    table = Columns(path, table.head, rows, links, table.given)
    p, q = np.stack([unit * table.numbers(point) for point in points], axis=1), table.joints(joints)
    measured = Measured(q, p, approach=_sides(table, approach))
    if rotated:
        measured = _rotated(table, measured, rotated, convention)
    return Read(measured, np.array([line for line, _ in table.rows], float), notes)


def _sides(table: Columns, columns: list[str]) -> Array | None:
    """Return from which side each joint came, (N, n); None without the columns."""
    sides = table.numbers(columns) if columns else None
    if sides is not None and not np.isin(sides, (-1, 0, 1)).all():
        raise InputError(
            f"{table.path}: a direction of approach must be 1 (the angle grew), -1 (it fell) or 0 (not known)"
        )
    return sides


def _rotated(table: Columns, measured: Measured, rotated: list[str], convention: str | None) -> Measured:
    """Return the poses with the body's rotations, and its covariance where the table has one."""
    if measured.points != 1:
        raise InputError(f"{table.path}: angles go with one point, p1; there are {measured.points}")
    R, angles, used, _ = table.rotations(convention)
    if rotated[0].startswith("rx"):
        return replace(measured, R_rig_body=R, angles_deg=angles, rotation=used)
    return replace(measured, R_rig_body=R, cov=_covariance(table, R) if "cov_00" in table.at else None)


def _joints(table: Columns, arm: ArmJoints | None) -> list[str]:
    joints = table.joint_names() if arm is None else table.joint_names(len(arm.joint_names), arm.name)
    if not joints:
        most = 6 if arm is None else len(arm.joint_names)
        raise InputError(
            f"{table.path}: line 1: no joint angles; columns q1_rad .. q{most}_rad or q1_deg .. q{most}_deg are needed, "
            f"there are {table.near('q1_deg')}; --columns q1_deg=COLUMN,... says which they are"
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
        for unit, metres in (("mm", 1e-3), ("m", 1.0)):
            points: list[list[str]] = []
            while f"p{len(points) + 1}_x_{unit}" in table.at:
                points.append([f"p{len(points) + 1}_{axis}_{unit}" for axis in "xyz"])
            if points:
                return points, metres
    for suffix, metres in (("_m", 1.0), ("_mm", 1e-3), ("", 1.0)):
        if f"x{suffix}" in table.at:
            return [[f"{axis}{suffix}" for axis in "xyz"]], metres
    raise InputError(
        f"{table.path}: line 1: no point 1; columns p1_x_mm .. p1_z_mm, or x_m .. z_m, are needed, there are "
        f"{table.near('p1_x_mm')}: --columns p1_x_mm=NAME,... gives yours"
    )


def _rotation_columns(table: Columns, convention: str | None) -> tuple[list[str], tuple[str, ...]]:
    for names in (["qw", "qx", "qy", "qz"], [f"r{i}{j}" for i in "123" for j in "123"]):
        if names[0] in table.at:
            return names, ()
    unit = next((unit for unit in ("_deg", "_rad", "") if f"rx{unit}" in table.at), None)
    if unit is None:
        if convention is not None:
            table.require("rx_deg", "ry_deg", "rz_deg")
        return [], ()
    if convention is None:
        return [], (f"rx{unit}, ry{unit}, rz{unit} are not used: say their convention, --columns rotation=xyz ..",)
    return [f"r{axis}{unit}" for axis in "xyz"], ()


def _gaps(table: Columns, requested: list[str], numbers: Array) -> tuple[str, ...]:
    """Return a note on rows with gaps; reject a file that has hardly another."""
    gaps = np.flatnonzero(~np.isfinite(numbers).all(axis=1))
    named = [(table.line(k), requested[int(np.argmin(np.isfinite(numbers[k])))]) for k in gaps[:5]]
    if len(gaps) > len(numbers) - len(gaps):
        line, name = named[0]
        raise InputError(
            f"{table.path}: {len(gaps)} of {len(numbers)} rows have gaps; the first is line {line}: {name}"
        )
    if len(numbers) == 0:
        raise InputError(f"{table.path}: no rows; one line a pose is needed")
    where = ", ".join(f"line {line} ({name})" for line, name in named) + (", .." if len(gaps) > 5 else "")
    return (f"{len(gaps)} rows left out, empty or no finite number: {where}",) if named else ()


def _repeated(table: Columns, numbers: Array, good: NDArray[np.bool_]) -> tuple[str, ...]:
    """Leave rows that repeat another to the last digit out of the good ones: they are no further evidence; note them."""
    rows = np.flatnonzero(good)
    again = np.delete(rows, np.unique(numbers[rows], axis=0, return_index=True)[1])
    good[again] = False
    where = ", ".join(f"line {table.line(k)}" for k in again[:5]) + (", .." if len(again) > 5 else "")
    return (f"{len(again)} rows repeat another to the last digit, and are left out: {where}",) if len(again) else ()


def _covariance(table: Columns, R: Array) -> Array:
    """Return covariances of the right tangent from those along the rig's axes that ``armsight measure`` writes."""
    C = np.zeros((len(R), 6, 6))
    for (i, j), column in zip(_UPPER, table.numbers(_COV).T, strict=True):
        C[:, i, j] = C[:, j, i] = column
    back = np.kron(np.eye(2), R.swapaxes(1, 2))
    C = back @ C @ back.swapaxes(1, 2)
    if np.linalg.eigvalsh(C).min() < 0:
        raise InputError(f"{table.path}: cov_00 .. cov_55 are no covariance: an eigenvalue is negative")
    return np.asarray(C)
