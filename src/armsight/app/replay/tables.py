"""The tables of a replay, poses.csv and live.csv, with all digits; and what differs between those in two folders."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from armsight.app.replay.run import Replayed
from armsight.data import Array
from armsight.errors import InputError
from armsight.files import table_text, write_text
from armsight.tables.columns import Columns
from armsight.tables.lengths import number
from armsight.vision.pose.shot_pose import UPPER, rows_of

POSES, LIVE = "poses.csv", "live.csv"
#: Columns of live.csv.
LIVE_COLUMNS = (
    *("t_s", "status", "vision_age_s", "x_m", "y_m", "z_m", "qw", "qx", "qy", "qz"),
    *(f"cov_{i}{j}" for i, j in UPPER),
)
Cell = str | float | int | None
Table = tuple[list[str], list[list[Cell]]]


def live_table(contents: Iterable[Mapping[str, Any]]) -> Table:
    """Return the table of the live track: the estimates in the JSON of batches of joint readings."""
    rows: list[list[Cell]] = []
    for content in contents:
        if "tool_position_m" in content:
            age_s, cov = content["vision_age_s"], content["tool_covariance"]
            row: list[Cell] = [content["t_s"][-1], content["status"], age_s if content["status"] == "ok" else None]
            row += [*content["tool_position_m"], *content["tool_quaternion_wxyz"], *(cov[i][j] for i, j in UPPER)]
            rows.append(row)
    return [*LIVE_COLUMNS], rows


def write_tables(folder: Path, replayed: Replayed) -> None:
    """Write the tables to a folder, which is made; that of poses with the joint angles at the time of each, if known."""
    folder.mkdir(parents=True, exist_ok=True)
    names, rows = rows_of(replayed.poses)
    if (joints := replayed.joints) is not None and all(pose.t_s is not None for pose in replayed.poses):
        q = joints.at(np.array([pose.t_s for pose in replayed.poses], float))
        names = (*names, *(f"q{k + 1}_rad" for k in range(q.shape[1])))
        rows = [
            row + ["" if angle != angle else angle for angle in at] for row, at in zip(rows, q.tolist(), strict=True)
        ]
    write_text(folder / POSES, table_text(names, rows))
    if replayed.live:
        live = live_table(datum.to_json(replayed.body) for datum in replayed.live)
        write_text(folder / LIVE, table_text(*live))


@dataclass(frozen=True)
class TableDifference:
    """What differs between two tables."""

    table: str  #: name of the file
    rows: int  #: how many rows both have, by shot or by time
    only_first: int  #: how many rows only the first has
    only_second: int  #: how many rows only the second has
    same: bool  #: whether all cells of the common rows are the same to the last digit
    status_changed: int  #: how many rows have another status: measured in one and missed in the other
    largest: dict[str, float]  #: column -> largest absolute difference
    position_rms_m: float | None  #: RMS distance of the positions, m; None where there are none

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
    """Compare the tables of the same name in two folders, row by row."""
    names = [name for name in (POSES, LIVE) if (first / name).is_file() and (second / name).is_file()]
    if not names:
        raise InputError(f"{second}: has no {POSES} or {LIVE} to compare with those of {first}")
    return [_compared(first / name, second / name) for name in names]


def _pose_table(path: Path) -> Columns:
    table = Columns.of_csv(path)
    if next(iter(table.at), None) not in ("shot", "t_s"):
        raise InputError(f"{path}: line 1: expected a table of poses whose first column is shot or t_s")
    return table


def _position_rms_m(deltas: Mapping[str, Array]) -> float | None:
    """Return the RMS distance of positions by the differences of their columns, m; None where there are none."""
    axes = [deltas[f"{axis}_m"] for axis in "xyz" if f"{axis}_m" in deltas]
    squares = np.sum(np.square(axes), axis=0) if len(axes) == 3 else np.zeros(0)
    squares = squares[np.isfinite(squares)]
    return float(np.sqrt(squares.mean())) if len(squares) else None


def _compared(*paths: Path) -> TableDifference:
    tables = [_pose_table(path) for path in paths]
    a, b = ({row[0]: row for _, row in table.rows} for table in tables)
    columns = [name for name in list(tables[0].at)[1:] if name in tables[1].at]
    both = [(a[key], b[key]) for key in a if key in b]
    cells = {name: [(x[tables[0].at[name]], y[tables[1].at[name]]) for x, y in both] for name in columns}
    same = all(x == y for pairs in cells.values() for x, y in pairs)
    status_changed = sum(x != y for x, y in cells.get("status", ()))
    values = {name: [[number(cell) for cell in pair] for pair in pairs] for name, pairs in cells.items()}
    deltas = {name: np.subtract(*np.array(each, float).reshape(-1, 2).T) for name, each in values.items()}
    largest = {name: float(np.nanmax(np.abs(each), initial=0.0)) for name, each in deltas.items()}
    alone = len(a) - len(both), len(b) - len(both)
    return TableDifference(paths[0].name, len(both), *alone, same, status_changed, largest, _position_rms_m(deltas))
