"""Joint angles that another program logged: ``--board poses:FILE``, for an arm that armsight does not move.

In: a CSV file with a column a joint, ``q1_rad`` or ``q1_deg`` and so on, and a column that says where each row belongs:
``shot`` (the name of the image) or ``t_s`` (on the clock of the images; rows between are interpolated). Without either the
rows belong to the shots in their order, one a shot. Out: :class:`LoggedAngles`, and the angles at each shot.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from armsight.data import Array, Record
from armsight.errors import InputError
from armsight.files import read_table
from armsight.robot.arm import Arm
from armsight.tables.columns import degree_columns

#: Angles at the time of a shot are interpolated between rows at most so far apart, s.
MOST_GAP_S = 0.25
#: No joint rotates further; larger numbers of radians are degrees.
_MOST_RAD = 4 * math.pi


@dataclass(frozen=True, eq=False)
class LoggedAngles(Record):
    """The rows of a file.

    Attributes:
        path: of the file, for errors.
        q: (N, n) joint angles, rad.
        shots: names of the shots the rows belong to; None where no column has them.
        t_s: (N,) times of the rows, s, rising; None where no column has them.
        unused: the columns that were not read.
    """

    path: Path
    q: Array
    shots: tuple[str, ...] | None
    t_s: Array | None
    unused: tuple[str, ...] = ()

    def at(self, names: Sequence[str], times_s: Sequence[float | None]) -> list[Array | None]:
        """Return the joint angles (n,), rad, at each shot; None at a shot that no row belongs to.

        Args:
            names: of the shots, in their order.
            times_s: of the shots; None where one has none.

        Raises:
            InputError: rows and shots do not belong together.
        """
        if self.shots is not None:
            rows = dict(zip(self.shots, self.q, strict=True))
            if not any(name in rows for name in names):
                raise InputError(
                    f"{self.path}: no row is of one of the shots: the first row's shot is {self.shots[0]!r}, the first shot"
                    f" {names[0]!r}"
                )
            return [rows.get(name) for name in names]
        if self.t_s is not None:
            return self._interpolated(times_s)
        if len(names) != len(self.q):
            raise InputError(
                f"{self.path}: {len(self.q)} rows, but {len(names)} shots: give a column shot or t_s, or"
                " a row for each shot"
            )
        return list(self.q)

    def _interpolated(self, times_s: Sequence[float | None]) -> list[Array | None]:
        assert self.t_s is not None
        known = [t for t in times_s if t is not None]
        if not known:
            raise InputError(
                f"{self.path}: t_s says when the rows are, but the shots have no times: give a column shot"
            )
        found: list[Array | None] = []
        for t in times_s:
            k = int(np.searchsorted(self.t_s, -np.inf if t is None else t))
            if t is not None and k < len(self.t_s) and self.t_s[k] == t:
                found.append(self.q[k])
            elif t is None or not 0 < k < len(self.t_s) or self.t_s[k] - self.t_s[k - 1] > MOST_GAP_S:
                found.append(None)
            else:
                share = (t - self.t_s[k - 1]) / (self.t_s[k] - self.t_s[k - 1])
                found.append(self.q[k - 1] + share * (self.q[k] - self.q[k - 1]))
        if all(each is None for each in found):
            raise InputError(
                f"{self.path}: no shot was taken while angles were logged: rows from {self.t_s[0]:.3f} to"
                f" {self.t_s[-1]:.3f} s,"
                f" shots from {min(known):.3f} to {max(known):.3f} s: both need the same clock"
            )
        return found


def read_angles(path: str | Path, arm: Arm) -> LoggedAngles:
    """Read the logged joint angles of an arm.

    Raises:
        InputError: unreadable, a joint is missing or too many, a field is no number, or degrees came as radians.
    """
    path = Path(path)
    rows = degree_columns(path, read_table(path))
    lines = [(line, row) for line, row in enumerate(rows[1:], 2) if any(cell.strip() for cell in row)]
    if not lines:
        raise InputError(f"{path}: no rows; a first line of column names and a line a pose are needed")
    header = [name.strip() for name in rows[0]]
    count = len(arm.a)
    columns, factor = _joint_columns(path, header, arm, count)
    q = factor * np.array([[_number(path, line, header, row, k) for k in columns] for line, row in lines])
    if factor == 1.0 and np.abs(q).max() > _MOST_RAD:
        row, joint = np.unravel_index(int(np.abs(q).argmax()), q.shape)
        raise InputError(
            f"{path}:{lines[row][0]}: q{joint + 1}_rad is {q[row, joint]:g}: are these degrees? name the columns q1_deg ..."
        )
    shots = t_s = None
    where = next((name for name in ("shot", "t_s") if name in header), None)
    unused = tuple(name for k, name in enumerate(header) if name and k not in columns and name != where)
    if "shot" in header:
        at = header.index("shot")
        shots = tuple(_cell(path, line, header, row, at) for line, row in lines)
        for k, name in enumerate(shots):
            if name in shots[:k]:
                raise InputError(f"{path}:{lines[k][0]}: shot {name!r} stands twice")
    elif "t_s" in header:
        at = header.index("t_s")
        t_s = np.array([_number(path, line, header, row, at) for line, row in lines])
        if len(fallen := np.flatnonzero(np.diff(t_s) <= 0)):
            raise InputError(f"{path}:{lines[fallen[0] + 1][0]}: t_s does not rise: {t_s[fallen[0] + 1]:g} s")
    return LoggedAngles(path, q, shots, t_s, unused)


def _joint_columns(path: Path, header: list[str], arm: Arm, count: int) -> tuple[list[int], float]:
    """Return the columns of the joints, and what makes radians of them."""
    for unit, factor in (("rad", 1.0), ("deg", math.pi / 180)):
        if f"q1_{unit}" not in header:
            continue
        beyond = [name for name in header if name.startswith("q") and name.endswith(f"_{unit}")]
        if f"q{count + 1}_{unit}" in header:
            hint = ": is the last one its gripper? leave it out" if len(beyond) == count + 1 else ""
            raise InputError(f"{path}: has q{count + 1}_{unit}, but {arm.name} has {count} joints{hint}")
        for k in range(1, count + 1):
            if f"q{k}_{unit}" not in header:
                raise InputError(f"{path}: has no column q{k}_{unit}; {arm.name} has {count} joints")
        return [header.index(f"q{k}_{unit}") for k in range(1, count + 1)], factor
    raise InputError(
        f"{path}: has no joint angles: columns q1_deg .. q{count}_deg (or _rad) are needed, and shot or t_s; it has"
        f" {', '.join(header)}"
    )


def _cell(path: Path, line: int, header: list[str], row: list[str], at: int) -> str:
    if at >= len(row) or not row[at].strip():
        raise InputError(f"{path}:{line}: {header[at]} is missing")
    return row[at].strip()


def _number(path: Path, line: int, header: list[str], row: list[str], at: int) -> float:
    text = _cell(path, line, header, row, at)
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f"{path}:{line}: {header[at]} is {text!r}; a number is needed")
    return value
