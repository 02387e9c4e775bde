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


def _compared(first: Path, second: Path) -> TableDifference:
    tables = [Columns.of_csv(path) for path in (first, second)]
    for table in tables:
        if next(iter(table.at), None) not in ("shot", "t_s"):
            raise InputError(f"{table.path}: line 1: expected a table of poses whose first column is shot or t_s")
    a, b = ({row[0]: row for _, row in table.rows} for table in tables)
    columns = [name for name in list(tables[0].at)[1:] if name in tables[1].at]
    largest = dict.fromkeys(columns, 0.0)
    same, status_changed, squares = True, 0, []
    for key in (key for key in a if key in b):
        cells = {name: tuple(row[table.at[name]] for row, table in zip((a[key], b[key]), tables, strict=True))
                 for name in columns}  # fmt: skip
        same &= all(one == two for one, two in cells.values())
        status_changed += len(set(cells.get("status", ()))) > 1
        numbers = {name: tuple(map(number, pair)) for name, pair in cells.items()}
        deltas = {name: abs(x - y) for name, (x, y) in numbers.items() if x is not None and y is not None}
        largest |= {name: max(largest[name], delta) for name, delta in deltas.items()}
        if all(f"{axis}_m" in deltas for axis in "xyz"):
            squares.append(sum(deltas[f"{axis}_m"] ** 2 for axis in "xyz"))
    common = len(set(a) & set(b))
    rms = float(np.sqrt(np.mean(squares))) if squares else None
    return TableDifference(first.name, common, len(a) - common, len(b) - common, same, status_changed, largest, rms)
