"""What changed between two results: the tables of the same name in two folders, row by row."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from armsight.app.replay.tables import LIVE, POSES
from armsight.errors import InputError
from armsight.files import read_table


@dataclass(frozen=True)
class TableDifference:
    """What differs between two tables.

    Attributes:
        table: name of the file.
        rows: how many rows both have, by shot or by time.
        only_first: how many rows only the first has.
        only_second: how many rows only the second has.
        same: whether all cells of the common rows are the same to the last digit.
        status_changed: how many rows have another status: measured in one and missed in the other.
        largest: column -> largest absolute difference.
        position_rms_m: RMS distance of the positions, m; None where there are none.
    """

    table: str
    rows: int
    only_first: int
    only_second: int
    same: bool
    status_changed: int
    largest: dict[str, float]
    position_rms_m: float | None

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON."""
        return asdict(self)

    def lines(self) -> list[str]:
        """Return it as lines for people."""
        if self.same and not self.only_first and not self.only_second:
            return [f"{self.table}: {self.rows} rows, the same to the last digit"]
        lines = [
            f"{self.table}: {self.rows} rows in both, {self.only_first} in the first only, {self.only_second} in the "
            f"second only; {self.status_changed} changed between measured and missed"
        ]
        if self.position_rms_m is not None:
            lines.append(f"  position: RMS {1e3 * self.position_rms_m:.6f} mm")
        worst = sorted(self.largest.items(), key=lambda item: -item[1])[:6]
        return [*lines, *(f"  {name}: at most {value:.6g}" for name, value in worst if value > 0)]


def compare(first: Path, second: Path) -> list[TableDifference]:
    """Compare two folders.

    Raises:
        InputError: they have no table in common.
    """
    names = [name for name in (POSES, LIVE) if (first / name).is_file() and (second / name).is_file()]
    if not names:
        raise InputError(f"{second}: has no {POSES} or {LIVE} to compare with those of {first}")
    return [_compared(first / name, second / name) for name in names]


def _compared(first: Path, second: Path) -> TableDifference:
    tables = []
    for path in (first, second):
        rows = read_table(path)
        if not rows or rows[0][0] not in ("shot", "t_s"):
            raise InputError(f"{path}: line 1: expected a table of poses whose first column is shot or t_s")
        tables.append((rows[0], {row[0]: row for row in rows[1:]}))
    (header, a), (other, b) = tables
    common = [key for key in a if key in b]
    columns = [name for name in header[1:] if name in other]
    largest = dict.fromkeys(columns, 0.0)
    same, status_changed, squares = True, 0, []
    for key in common:
        one = dict(zip(header, a[key], strict=False))
        two = dict(zip(other, b[key], strict=False))
        status_changed += one.get("status") != two.get("status")
        deltas: dict[str, float] = {}
        for name in columns:
            if one.get(name) != two.get(name):
                same = False
            try:
                deltas[name] = abs(float(one[name]) - float(two[name]))
            except (KeyError, ValueError):
                continue
            largest[name] = max(largest[name], deltas[name])
        if all(f"{axis}_m" in deltas for axis in "xyz"):
            squares.append(sum(deltas[f"{axis}_m"] ** 2 for axis in "xyz"))
    rms = float(np.sqrt(np.mean(squares))) if squares else None
    return TableDifference(
        first.name, len(common), len(a) - len(common), len(b) - len(common), same, status_changed, largest, rms
    )
