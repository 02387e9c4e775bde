"""Joint angles that another program logged: ``--board poses:FILE``, for an arm that armsight does not move.

In: a file that :mod:`armsight.tables` reads, with a column a joint, ``q1_rad`` or ``q1_deg`` and so on, and ``shot`` (or
``image``, ``name``) or ``t_s`` (the clock of the images; rows between are interpolated); without either a row a shot, in
their order. Out: :class:`LoggedAngles`, and the angles at each shot.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from armsight.data import Array, Record
from armsight.errors import InputError
from armsight.files import columns_unused
from armsight.robot.kinematics.arm import Arm
from armsight.tables.poses import read_pose_table

#: Angles at the time of a shot are interpolated between rows at most so far apart, s.
MOST_GAP_S = 0.25


@dataclass(frozen=True, eq=False)
class LoggedAngles(Record):
    """The rows of a file."""

    path: Path  #: of the file, for errors
    q: Array  #: (N, n) joint angles, rad; NaN in a row without, which is kept where rows belong together by order
    shots: tuple[str, ...] | None  #: names of the shots the rows belong to; None where no column has them
    t_s: Array | None  #: (N,) times of the rows, s, rising; None where no column has them
    notes: tuple[str, ...] = ()  #: what was found out while reading

    def at(self, names: Sequence[str], times_s: Sequence[float | None]) -> list[Array | None]:
        """Return the joint angles (n,), rad, at each shot; None at a shot that no row belongs to."""
        if self.shots is not None:
            rows = dict(zip(self.shots, self.q, strict=True))
            if not any(name in rows for name in names):
                first = f"the first row's shot is {self.shots[0]!r}, the first shot {names[0]!r}"
                raise InputError(f"{self.path}: no row is of one of the shots: {first}")
            return [rows.get(name) for name in names]
        if self.t_s is not None:
            return self._interpolated(times_s)
        if len(names) != len(self.q):
            give = "give a column shot or t_s, or a row for each shot"
            raise InputError(f"{self.path}: {len(self.q)} rows, but {len(names)} shots: {give}")
        return [q if np.isfinite(q).all() else None for q in self.q]

    def _interpolated(self, times_s: Sequence[float | None]) -> list[Array | None]:
        assert self.t_s is not None
        known = [t for t in times_s if t is not None]
        if not known:
            raise InputError(f"{self.path}: t_s says when rows are, but the shots have no times: give a column shot")
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
            when = f"rows from {self.t_s[0]:.3f} to {self.t_s[-1]:.3f} s, shots from {min(known):.3f} to {max(known):.3f} s"
            raise InputError(f"{self.path}: no shot was taken while angles were logged: {when}: they need one clock")
        return found


def read_angles(path: str | Path, arm: Arm) -> LoggedAngles:
    """Read the logged joint angles of an arm; an InputError says what is wrong with them."""
    kept = read_pose_table(Path(path), arm=arm, only_joints=True, keep_missed=True)
    table = kept.without_missed()
    assert kept.q is not None
    assert table.q is not None
    t_s = table.t_s if table.names is None else None
    by_order = table.names is None and t_s is None
    q = np.where(np.array([[not why] for why in kept.missed]), kept.q, np.nan) if by_order else table.q
    if t_s is not None and len(fallen := np.flatnonzero(np.diff(t_s) <= 0)):
        raise InputError(f"{path}: line {table.lines[fallen[0] + 1]}: t_s does not rise: {t_s[fallen[0] + 1]:g} s")
    notes = (f"{path}: {columns_unused(table.unused)}",) if table.unused else ()
    return LoggedAngles(table.path, q, table.names, t_s, (*table.notes, *notes))
