"""Read joint angles and the tool's measured positions or poses from a CSV file.

Columns, in any order; others are ignored: q1_rad .. q6_rad (or q1_deg ..); then tracked points p1_x_mm, p1_y_mm,
p1_z_mm, p2_x_mm, .. (or _m), with rx_deg, ry_deg, rz_deg where an instrument gives angles and their convention is given;
or full poses x_m, y_m, z_m, qw, qx, qy, qz, with cov_00 .. cov_55 as ``armsight measure`` writes them; approach1 ..
approach6 (1, -1, 0).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from armsight.data import Array
from armsight.errors import InputError
from armsight.files import read_columns, read_table
from armsight.loop.identify import ROTATIONS
from armsight.loop.identify.measured import Measured
from armsight.robot.boards.feetech.calibration import degree_columns
from armsight.robot.kinematics.table import FEWEST_JOINTS, MOST_JOINTS

_UPPER = [(i, j) for i in range(6) for j in range(i, 6)]
#: The joints that a file may have.
_JOINTS = range(1, MOST_JOINTS + 1)
#: The names that ``columns`` may say the file's own for.
COLUMNS = (
    *(f"q{i}_{unit}" for i in _JOINTS for unit in ("rad", "deg")),
    *("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz", "rx_deg", "ry_deg", "rz_deg"),
    *(f"p{k}_{axis}_{unit}" for k in range(1, 10) for axis in "xyz" for unit in ("mm", "m")),
    *(f"cov_{i}{j}" for i, j in _UPPER),
    *(f"approach{i}" for i in _JOINTS),
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


def read_poses(path: str | Path, *, rotation: str | None = None, columns: str | None = None) -> Read:
    """Read a file.

    Args:
        path: a CSV file.
        rotation: the convention of rx_deg, ry_deg, rz_deg, one of ROTATIONS; None: they are not used.
        columns: what the file calls its columns, NAME=THEIRS,... with names of COLUMNS.

    Raises:
        InputError: unreadable, columns missing, fields that are no numbers, or hardly a row without gaps.
    """
    return poses_in(path, read_table(path, read_columns(columns, COLUMNS)), rotation=rotation)


def poses_in(path: str | Path, rows: list[list[str]], *, rotation: str | None = None) -> Read:
    """Read the rows of a file as :func:`read_poses` does; blank rows are passed over.

    Args:
        path: the file, for errors.
        rows: its cells, names first.
        rotation: as in :func:`read_poses`.

    Raises:
        InputError: as :func:`read_poses`.
    """
    if rotation is not None and rotation not in ROTATIONS:
        raise InputError(f"the rotation convention is {rotation!r}; known are {', '.join(ROTATIONS)}")
    rows = degree_columns(path, rows)
    if len(rows) < 2:
        raise InputError(f"{path}: no rows; a first line of column names and one line a pose are needed")
    header = [name.strip() for name in rows[0]]
    if len(set(header)) != len(header):
        raise InputError(f"{path}: line 1 names a column twice: {_twice(header)}")
    there = {name: i for i, name in enumerate(header)}
    requested = _requested(path, there, rotation)
    table, lines, notes = _numbers(path, rows, there, requested)
    at = {name: table[:, i] for i, name in enumerate(requested)}
    unused = rotation is None and "rx_deg" in there and "qw" not in there
    if unused:
        notes = (*notes, "rx_deg, ry_deg, rz_deg are not used: give their convention with --rotation")
    return Read(_measured(path, at, rotation), lines, notes)


def _twice(header: list[str]) -> str:
    return next(name for name in header if header.count(name) > 1)


def _requested(path: str | Path, columns: dict[str, int], rotation: str | None) -> list[str]:
    """Return the columns to read."""
    beyond = next((f"q{k}_{unit}" for k in range(8, 10) for unit in ("rad", "deg") if f"q{k}_{unit}" in columns), None)
    if beyond is not None:
        raise InputError(f"{path}: line 1: column {beyond}: an arm here has at most {MOST_JOINTS} joints")
    angles = {unit: [i for i in _JOINTS if f"q{i}_{unit}" in columns] for unit in ("rad", "deg")}
    joints = max(FEWEST_JOINTS, *(max(there, default=0) for there in angles.values())) if any(angles.values()) else 6
    ways = [[f"q{i + 1}_{unit}" for i in range(joints)] for unit in angles]
    requested = _alternative(path, columns, ways, "joint angles")
    poses = ["x_m", "y_m", "z_m", "qw", "qx", "qy", "qz"]
    if "qw" in columns:
        requested += _alternative(path, columns, [poses], "full poses")
        requested += [f"cov_{i}{j}" for i, j in _UPPER] if "cov_00" in columns else []
    else:
        k = 1
        while k == 1 or any(f"p{k}_x_{unit}" in columns for unit in ("mm", "m")):
            sets = [[f"p{k}_{axis}_{unit}" for axis in "xyz"] for unit in ("mm", "m")]
            requested += _alternative(path, columns, sets, f"point {k}")
            k += 1
        if rotation is not None:
            requested += _alternative(path, columns, [["rx_deg", "ry_deg", "rz_deg"]], "angles")
    if "approach1" in columns:
        requested += _alternative(
            path, columns, [[f"approach{i + 1}" for i in range(joints)]], "directions of approach"
        )
    missing = [name for name in requested if name not in columns]
    if missing:
        raise InputError(f"{path}: line 1: column {missing[0]} is missing")
    return requested


def _alternative(path: str | Path, columns: dict[str, int], sets: list[list[str]], what: str) -> list[str]:
    """Return the first set of names that is there as a whole."""
    for names in sets:
        if all(name in columns for name in names):
            return names
    begun = next((names for names in sets if any(name in columns for name in names)), None)
    if begun is not None:
        gone = next(name for name in begun if name not in columns)
        raise InputError(f"{path}: line 1: column {gone} is missing ({what})")
    ways = " or ".join(f"{names[0]} .. {names[-1]}" for names in sets)
    raise InputError(f"{path}: line 1: no {what}; columns {ways} are needed, there are {', '.join(list(columns)[:8])}")


def _numbers(
    path: str | Path, rows: list[list[str]], columns: dict[str, int], requested: list[str]
) -> tuple[Array, Array, tuple[str, ...]]:
    """Return the requested fields (N, C), the lines (N,) they are from, and notes on what was left out."""
    table, lines, gaps = [], [], []
    for number, row in enumerate(rows[1:], start=2):
        if not any(text.strip() for text in row):
            continue
        values = [_number(path, number, name, row, columns[name]) for name in requested]
        if np.isfinite(values).all():
            table.append(values)
            lines.append(number)
        else:
            gaps.append((number, requested[int(np.argmin(np.isfinite(values)))]))
    if len(gaps) > len(table):
        line, name = gaps[0]
        raise InputError(
            f"{path}: {len(gaps)} of {len(gaps) + len(table)} rows have gaps; the first is line {line}: {name}"
        )
    if not table:
        raise InputError(f"{path}: no rows; one line a pose is needed")
    where = ", ".join(f"line {line} ({name})" for line, name in gaps[:5]) + (", .." if len(gaps) > 5 else "")
    notes = (f"{len(gaps)} rows left out, empty or no finite number: {where}",) if gaps else ()
    return np.array(table), np.array(lines, float), notes


def _number(path: str | Path, line: int, name: str, row: list[str], at: int) -> float:
    text = row[at].strip() if at < len(row) else ""
    try:
        return float(text) if text else float("nan")
    except ValueError:
        raise InputError(f"{path}: line {line}: {name} is {text!r}, must be a number") from None


def _measured(path: str | Path, at: dict[str, Array], rotation: str | None) -> Measured:
    """Assemble the columns, in SI units."""
    unit = "rad" if "q1_rad" in at else "deg"
    joints = [i for i in _JOINTS if f"q{i}_{unit}" in at]
    q = np.stack([at[f"q{i}_{unit}"] for i in joints], axis=1) * (1.0 if unit == "rad" else np.pi / 180)
    approach = np.stack([at[f"approach{i}"] for i in joints], axis=1) if "approach1" in at else None
    if approach is not None and not np.isin(approach, (-1, 0, 1)).all():
        raise InputError(f"{path}: a direction of approach must be 1 (the angle grew), -1 (it fell) or 0 (not known)")
    if "qw" in at:
        p, R = np.stack([at[f"{axis}_m"] for axis in "xyz"], axis=1), _rotations(path, at)
        cov = _covariance(path, at, R) if "cov_00" in at else None
        return Measured(q, p[:, None], R, cov, approach)
    points, k = [], 1
    while f"p{k}_x_mm" in at or f"p{k}_x_m" in at:
        mm = f"p{k}_x_mm" in at
        points.append(
            np.stack([at[f"p{k}_{axis}_{'mm' if mm else 'm'}"] for axis in "xyz"], axis=1) * (1e-3 if mm else 1)
        )
        k += 1
    p = np.stack(points, axis=1)
    if rotation is None:
        return Measured(q, p, None, None, approach)
    if p.shape[1] != 1:
        raise InputError(f"{path}: angles go with one point, p1; there are {p.shape[1]}")
    angles = np.stack([at[f"r{axis}_deg"] for axis in "xyz"], axis=1)
    return AnglesMeasured(q, p, rotations_of(angles, rotation), None, approach, angles_deg=angles, rotation=rotation)


def _rotations(path: str | Path, at: dict[str, Array]) -> Array:
    quaternions = np.stack([at[name] for name in ("qx", "qy", "qz", "qw")], axis=1)
    size = np.linalg.norm(quaternions, axis=1)
    if (np.abs(size - 1) > 1e-3).any():
        raise InputError(
            f"{path}: a quaternion qw, qx, qy, qz must have length 1; one has {size[np.argmax(np.abs(size - 1))]:.4g}"
        )
    return np.asarray(Rotation.from_quat(quaternions).as_matrix())


def rotations_of(angles_deg: Array, rotation: str) -> Array:
    """Return the rotations (N, 3, 3) of angles rx, ry, rz (N, 3), degrees, in one of the conventions of ROTATIONS."""
    if rotation == "rotvec":
        return np.asarray(Rotation.from_rotvec(np.radians(angles_deg)).as_matrix())
    given = np.radians(angles_deg[:, ["xyz".index(axis) for axis in rotation.lower()]])
    return np.asarray(Rotation.from_euler(rotation, given).as_matrix())


def _covariance(path: str | Path, at: dict[str, Array], R: Array) -> Array:
    """Return covariances of the right tangent from those along the rig's axes that ``armsight measure`` writes."""
    C = np.zeros((len(R), 6, 6))
    for i, j in _UPPER:
        C[:, i, j] = C[:, j, i] = at[f"cov_{i}{j}"]
    back = np.zeros_like(C)
    back[:, :3, :3] = back[:, 3:, 3:] = R.swapaxes(1, 2)
    C = back @ C @ back.swapaxes(1, 2)
    if np.linalg.eigvalsh(C).min() < 0:
        raise InputError(f"{path}: cov_00 .. cov_55 are no covariance: an eigenvalue is negative")
    return np.asarray(C)
