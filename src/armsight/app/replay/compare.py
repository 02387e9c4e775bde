"""What changed between two results: the tables of the same name in two folders, row by row."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from armsight.app.replay.tables import LIVE, POSES
from armsight.errors import InputError
from armsight.tables.columns import Columns
from armsight.tables.number import number


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


def _difference(one: str, other: str) -> float:
    """Return the difference of two cells; NaN where one is no number."""
    x, y = number(one), number(other)
    return np.nan if x is None or y is None else x - y


def _poses(path: Path) -> Columns:
    """Read a table of poses."""
    table = Columns.of_csv(path)
    if next(iter(table.at), None) not in ("shot", "t_s"):
        raise InputError(f"{path}: line 1: expected a table of poses whose first column is shot or t_s")
    return table


def _compared(first: Path, second: Path) -> TableDifference:
    tables = [_poses(path) for path in (first, second)]
    a, b = ({row[0]: row for _, row in table.rows} for table in tables)
    columns = [name for name in list(tables[0].at)[1:] if name in tables[1].at]
    both = [(a[key], b[key]) for key in a if key in b]
    cells = {name: [(x[tables[0].at[name]], y[tables[1].at[name]]) for x, y in both] for name in columns}
    same = all(x == y for pairs in cells.values() for x, y in pairs)
    status_changed = sum(x != y for x, y in cells.get("status", ()))
    deltas = {name: np.array([_difference(*pair) for pair in pairs]) for name, pairs in cells.items()}
    largest = {name: float(np.nanmax(np.abs(each), initial=0.0)) for name, each in deltas.items()}
    axes = [deltas[f"{axis}_m"] for axis in "xyz" if f"{axis}_m" in deltas]
    squares = np.sum(np.square(axes), axis=0) if len(axes) == 3 else np.zeros(0)
    squares = squares[np.isfinite(squares)]
    rms = float(np.sqrt(squares.mean())) if len(squares) else None
    alone = len(a) - len(both), len(b) - len(both)
    return TableDifference(first.name, len(both), *alone, same, status_changed, largest, rms)
