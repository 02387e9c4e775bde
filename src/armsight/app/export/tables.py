"""A run as tables: CSV, Parquet, and TUM's text (time, position, quaternion x y z w), which evo reads."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from armsight.app.replay.recorded import RecordedRun
from armsight.app.replay.tables import Cell, Table, live_table
from armsight.app.run.tracks import NAMES
from armsight.app.show.messages import require
from armsight.errors import InputError
from armsight.files import made_folder, replacing, table_text, write_text
from armsight.loop.running.data import JointsDatum, ShotDatum
from armsight.vision.pose.shot_pose import UPPER

#: A column of a datum -> its key, and the names of its parts; a key without parts is one column.
_SHOT: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("shot", ()),
    ("status", ()),
    ("reason", ()),
    ("t_s", ()),
    ("sigma_t_s", ()),
    ("arrival_s", ()),
    ("age_s", ()),
    ("position_m", ("x_m", "y_m", "z_m")),
    ("quaternion_wxyz", ("qw", "qx", "qy", "qz")),
    ("points", ()),
    ("misfit", ()),
    ("reprojection_rms_px", ()),
    ("residual_rms_m", ()),
    ("outcome", ()),
)
_MATRICES = (
    ("covariance", "cov"),
    ("covariance_precision", "cov_precision"),
    ("covariance_calibration", "cov_calibration"),
)


def tables_of(run: RecordedRun) -> dict[str, Table]:
    """Return the tables of a run by name: poses, live, joints; those without rows are left out."""
    found: dict[str, Table] = {
        "poses": _poses(run),
        "live": live_table(each.content for each in run.of(JointsDatum)),
        "joints": _joints(run),
    }
    return {name: table for name, table in found.items() if table[1]}


def _poses(run: RecordedRun) -> Table:
    header = [part for key, parts in _SHOT for part in (parts or (key,))]
    header += [f"{short}_{i}{j}" for _, short in _MATRICES for i, j in UPPER]
    rows: list[list[Cell]] = []
    for each in run.of(ShotDatum):
        row: list[Cell] = []
        for key, parts in _SHOT:
            value = each.content.get(key)
            row += [value] if not parts else ([None] * len(parts) if value is None else value)
        for key, _ in _MATRICES:
            matrix = each.content.get(key)
            row += [None if matrix is None else matrix[i][j] for i, j in UPPER]
        rows.append(row)
    return header, rows


def _joints(run: RecordedRun) -> Table:
    rows: list[list[Cell]] = [
        [t_s, *q]
        for each in run.of(JointsDatum)
        for t_s, q in zip(each.content["t_s"], each.content["q_rad"], strict=True)
    ]
    count = max((len(row) for row in rows), default=1)
    return ["t_s", *(f"q{k}_rad" for k in range(1, count))], rows


def write_csv(run: RecordedRun, folder: Path) -> list[Path]:
    """Write a CSV a table; return the files."""
    files = []
    for name, (header, rows) in _some(run, tables_of(run)).items():
        files.append(made_folder(folder) / f"{name}.csv")
        write_text(files[-1], table_text(header, rows))
    return files


def write_parquet(run: RecordedRun, folder: Path) -> list[Path]:
    """Write a Parquet file a table, and one of each track whose CSV lies beside run.mcap; return the files."""
    require("an export", "run", "pyarrow")
    import pyarrow as pa
    from pyarrow import parquet
    from pyarrow.csv import read_csv

    files, found = [], dict[str, Any]()
    for name, (header, rows) in _some(run, tables_of(run)).items():
        columns = list(zip(*rows, strict=True))
        found[name] = pa.table({key: pa.array(column) for key, column in zip(header, columns, strict=True)})
    for track in (run.path.with_name(f"{name}.csv") for name in NAMES):
        if track.is_file() and track.stem not in found:
            found[track.stem] = read_csv(track)
    for name, table in found.items():
        files.append(made_folder(folder) / f"{name}.parquet")
        with replacing(files[-1], "wb") as file:
            parquet.write_table(table, file)
    return files


def write_tum(run: RecordedRun, folder: Path) -> list[Path]:
    """Write body.tum, the body in the left camera's frame, and tool.tum, the tool in the base; return the files."""
    tables = {name: table for name, table in tables_of(run).items() if name in ("poses", "live")}
    files = []
    for name, (header, rows) in _some(run, tables).items():
        at = [header.index(key) for key in ("t_s", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")]
        lines = [" ".join(repr(row[k]) for k in at) for row in rows if all(row[k] is not None for k in at)]
        if lines:
            files.append(made_folder(folder) / {"poses": "body.tum", "live": "tool.tum"}[name])
            write_text(files[-1], "\n".join(lines) + "\n")
    if not files:
        raise InputError(f"{run.path}: holds no pose with a time")
    return files


def _some(run: RecordedRun, tables: dict[str, Table]) -> dict[str, Table]:
    """Return tables, of which there must be one."""
    if not tables:
        raise InputError(f"{run.path}: holds no shot and no joint reading")
    return tables
