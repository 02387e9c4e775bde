"""Where the tool was, as files that anyone can compute with: one CSV and one Parquet a track.

Columns: ``t_s, x_m, y_m, z_m, qw, qx, qy, qz`` of the tool in the base frame; where a track has a covariance,
``sigma_x_m .. sigma_z_m`` along the base's axes and ``sigma_rx_rad .. sigma_rz_rad`` about them; ``phase`` and ``motion``.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from armsight.data import Array, Record
from armsight.errors import InputError
from armsight.files import read_table, replacing

_COLUMNS = ("t_s", "x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")
#: What a moment belongs to.
PHASES = ("calibration", "open_loop", "closed_loop", "rest")
_DIGITS = 9  # decimals of m, s and rad that are written


@dataclass(frozen=True, eq=False)
class ToolTrack(Record):
    """Where the tool was at N times.

    Attributes:
        t_s: (N,) times on the board's clock, s, rising.
        Ts_base_tool: (N, 4, 4) poses.
        phase: (N,) names out of PHASES.
        motion: (N,) names of the motions, "" between them.
        covs: (N, 6, 6) covariances of the right tangents; None where there are none.
    """

    t_s: Array
    Ts_base_tool: Array
    phase: NDArray[np.str_]
    motion: NDArray[np.str_]
    covs: Array | None = None

    def __len__(self) -> int:
        """Return N."""
        return len(self.t_s)

    def __getitem__(self, rows: NDArray[Any]) -> ToolTrack:
        """Return some of the rows."""
        covs = None if self.covs is None else self.covs[rows]
        return ToolTrack(self.t_s[rows], self.Ts_base_tool[rows], self.phase[rows], self.motion[rows], covs)

    def at(self, t_s: Array) -> Array:
        """Return the poses (N, 4, 4) at times within the track: straight and by slerp between its rows."""
        after = np.clip(np.searchsorted(self.t_s, t_s), 1, len(self) - 1)
        T0, T1, t0, t1 = (x[k] for x in (self.Ts_base_tool, self.t_s) for k in (after - 1, after))
        share = np.clip((t_s - t0) / np.maximum(t1 - t0, 1e-12), 0.0, 1.0)[:, None]
        out = T0.copy()
        out[:, :3, 3] += share * (T1 - T0)[:, :3, 3]
        turn = Rotation.from_matrix(np.swapaxes(T0[:, :3, :3], 1, 2) @ T1[:, :3, :3]).as_rotvec()
        out[:, :3, :3] @= Rotation.from_rotvec(share * turn).as_matrix()
        return out


def errors(track: ToolTrack, truth: ToolTrack) -> Array:
    """Return (N, 6) right tangents from each pose of a track to the true one, [m; rad], the tool's axes."""
    T, T_true = track.Ts_base_tool, truth.at(track.t_s)
    turned = np.swapaxes(T[:, :3, :3], 1, 2)
    shift = np.einsum("nij,nj->ni", turned, T_true[:, :3, 3] - T[:, :3, 3])
    return np.hstack([shift, Rotation.from_matrix(turned @ T_true[:, :3, :3]).as_rotvec()])


def columns(track: ToolTrack) -> dict[str, NDArray[Any]]:
    """Return a track's columns by name."""
    T = track.Ts_base_tool
    quaternion = Rotation.from_matrix(T[:, :3, :3]).as_quat(canonical=True)[:, [3, 0, 1, 2]]
    named = {"t_s": track.t_s}
    named |= {f"{axis}_m": T[:, i, 3] for i, axis in enumerate("xyz")}
    named |= {f"q{axis}": quaternion[:, i] for i, axis in enumerate("wxyz")}
    if track.covs is not None:
        R = T[:, :3, :3]
        for first, kind, unit in ((0, "", "m"), (3, "r", "rad")):
            part = track.covs[:, first : first + 3, first : first + 3]
            sigma = np.sqrt(np.einsum("nij,njk,nik->ni", R, part, R))
            named |= {f"sigma_{kind}{axis}_{unit}": sigma[:, i] for i, axis in enumerate("xyz")}
    return {name: np.round(values, _DIGITS) for name, values in named.items()} | {
        "phase": track.phase,
        "motion": track.motion,
    }


def require_pyarrow() -> None:
    """Raise an InputError that says what to install unless pyarrow can be imported."""
    try:
        import pyarrow  # noqa: F401 - only whether it is there
    except ImportError:
        raise InputError('a run is written with pyarrow, which is not installed: pip install "armsight[run]"') from None


def write_columns(folder: Path, name: str, named: dict[str, NDArray[Any]]) -> None:
    """Write columns of one length as NAME.csv and NAME.parquet.

    Raises:
        InputError: a file cannot be written, the disk is full; no file is left half-written.
    """
    import pyarrow as pa
    from pyarrow import csv, parquet

    table = pa.table(named)
    with replacing(folder / f"{name}.csv", "wb") as file:
        csv.write_csv(table, file, csv.WriteOptions(quoting_style="needed"))
    with replacing(folder / f"{name}.parquet", "wb") as file:
        parquet.write_table(table, file)


def write_track(folder: Path, name: str, track: ToolTrack) -> None:
    """Write a track as NAME.csv and NAME.parquet; errors as :func:`write_columns`."""
    write_columns(folder, name, columns(track))


def read_track(file: Path, more: tuple[str, ...] = ()) -> tuple[ToolTrack, Array]:
    """Read the CSV of a track, without its covariances.

    Args:
        file: as :func:`write_track` writes it.
        more: names of further columns of numbers.

    Returns:
        The track, and those columns (N, k).

    Raises:
        InputError: unreadable, a column missing, no rows, a cell that is no finite number, or times that fall; the message
            names the line.
    """
    table = read_table(file)
    header = table[0] if table else []
    columns = (*_COLUMNS, "phase", "motion", *more)
    for name in columns:
        if name not in header:
            raise InputError(f"{file}: line 1: column {name} is missing; needed are {', '.join(columns)}")
    at = [header.index(name) for name in columns]
    body = table[1:]
    try:
        numbers = np.array([[float(row[k]) for k in (*at[:8], *at[10:])] for row in body]).reshape(-1, 8 + len(more))
        texts = np.array([[row[k] for k in at[8:10]] for row in body], dtype=str).reshape(-1, 2)
    except (ValueError, IndexError):
        line = next(n for n, row in enumerate(body, start=2) if not _whole(row, at))
        raise InputError(f"{file}: line {line}: numbers are needed in {', '.join(_COLUMNS)}") from None
    bad = np.flatnonzero(~np.isfinite(numbers).all(axis=1))
    if len(bad):
        raise InputError(f"{file}: line {bad[0] + 2}: finite numbers are needed in {', '.join((*_COLUMNS, *more))}")
    falls = np.flatnonzero(np.diff(numbers[:, 0]) < 0)
    if len(falls):
        raise InputError(f"{file}: line {falls[0] + 3}: t_s is less than in the line before; times must rise")
    if not len(numbers):
        raise InputError(f"{file}: no rows")
    if not np.linalg.norm(numbers[:, 4:8], axis=1).all():
        raise InputError(f"{file}: a quaternion qw .. qz is zero")
    Ts = np.tile(np.eye(4), (len(numbers), 1, 1))
    Ts[:, :3, 3], Ts[:, :3, :3] = numbers[:, 1:4], Rotation.from_quat(numbers[:, [5, 6, 7, 4]]).as_matrix()
    return ToolTrack(numbers[:, 0], Ts, texts[:, 0], texts[:, 1]), numbers[:, 8:]


def _whole(row: list[str], at: list[int]) -> bool:
    """Say whether a line has all its cells, and numbers where they must be."""
    try:
        return bool([float(row[k]) for k in (*at[:8], *at[10:])]) and len(row) > max(at)
    except (ValueError, IndexError):
        return False
