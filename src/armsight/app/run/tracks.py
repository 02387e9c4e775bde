"""The tracks of a run: the tool's pose over time, from sensors, vision and estimates, part by part; and their CSV files.

In: a log and what the run found. Out: :class:`Tracks`; a :class:`Part` is what they are between two times, so that no run
of hours is in memory as a whole. Columns of a file: ``t_s, x_m, y_m, z_m, qw, qx, qy, qz``, the pose of the tool in the
base; with a covariance ``sigma_x_m ..`` along the base's axes and ``sigma_rx_rad ..`` about them; ``phase, motion``.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from armsight.data import Array, PoseEstimate, Record
from armsight.errors import InputError
from armsight.files import replacing
from armsight.geometry.pose import inverse, log_se3
from armsight.loop.estimators import Delay, Mounting, PoseMeasurement
from armsight.loop.health.change import Change, widened
from armsight.loop.running.data import NO_POINTS
from armsight.loop.running.log import APART_S, Log, RunSegment
from armsight.robot.kinematics.arm import Arm
from armsight.tables.columns import Columns

#: The files of tracks.
NAMES = ("truth", "potentiometers", "vision", "fused", "live", "reference")
_COLUMNS = ("t_s", "x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")
_DIGITS = 9  # decimals of m, s and rad in files
#: s; of what is in memory at once where a whole run is gone through; half: slower, double: twice the memory.
_PART_S = 60.0


@dataclass(frozen=True, eq=False)
class ToolTrack(Record):
    """Poses of the tool at N times."""

    t_s: Array  #: (N,) times on the board's clock, s, rising
    Ts_base_tool: Array  #: (N, 4, 4) poses of the tool in the base frame
    phase: NDArray[np.str_]  #: (N,) calibration, open_loop, closed_loop or rest
    motion: NDArray[np.str_]  #: (N,) names of the motions, "" between them
    covs: Array | None = None  #: (N, 6, 6) covariances of the right tangents [m; rad]; None where they are not known

    def __len__(self) -> int:
        """Return N."""
        return len(self.t_s)

    def __getitem__(self, rows: NDArray[Any]) -> ToolTrack:
        """Return some of the rows."""
        covs = None if self.covs is None else self.covs[rows]
        return ToolTrack(self.t_s[rows], self.Ts_base_tool[rows], self.phase[rows], self.motion[rows], covs)

    def at(self, t_s: Array) -> Array:
        """Return the poses (N, 4, 4) at times (N,) within the track: linear and slerp interpolation between its rows."""
        after = np.clip(np.searchsorted(self.t_s, t_s), 1, len(self) - 1)
        T0, T1, t0, t1 = (x[k] for x in (self.Ts_base_tool, self.t_s) for k in (after - 1, after))
        share = np.clip((t_s - t0) / np.maximum(t1 - t0, 1e-12), 0.0, 1.0)[:, None]
        T = T0.copy()
        T[:, :3, 3] += share * (T1 - T0)[:, :3, 3]
        rotation = Rotation.from_matrix(np.swapaxes(T0[:, :3, :3], 1, 2) @ T1[:, :3, :3]).as_rotvec()
        T[:, :3, :3] @= Rotation.from_rotvec(share * rotation).as_matrix()
        return T


def errors(track: ToolTrack, truth: ToolTrack) -> Array:
    """Return (N, 6) right tangents from each pose of a track to the true one, [m; rad], along the tool's axes."""
    T, T_true = track.Ts_base_tool, truth.at(track.t_s)
    R_tool_base = np.swapaxes(T[:, :3, :3], 1, 2)
    shift = np.einsum("nij,nj->ni", R_tool_base, T_true[:, :3, 3] - T[:, :3, 3])
    return np.hstack([shift, Rotation.from_matrix(R_tool_base @ T_true[:, :3, :3]).as_rotvec()])


@dataclass
class Tracks:
    """All tracks of a run on the board's clock."""

    log: Log  #: of the run; nothing is measured any more
    arm: Arm  #: the nominal arm
    mounting: Mounting  #: poses of cameras and body on the arm
    delay: Delay  #: of the cameras' time stamps; its uncertainty adds to the covariance of the pose of a moving tool
    #: times (N,), s, and poses (N, 4, 4) of the tool in the base frame, where they are known.
    truth: tuple[Array, Array] | None = None
    changes: Sequence[Change] = ()  #: what may have moved rig or body; it adds to the covariance of vision since then

    def __post_init__(self) -> None:
        """Read the log's tables."""
        log = self.log
        log.settle()
        self.readings = log.readings.array(1 + self.arm.joints)
        self.measured, self.fused, self.live = log.measured.array(89), log.fused.array(53), log.lives.array(53)
        self._begins = np.array([s.begin_s for s in log.segments])
        # Times before the first segment belong to the calibration.
        self._phase = np.array([s.phase for s in log.segments] + ["calibration"])
        self._motion = np.array([s.motion for s in log.segments] + [""])

    def track(self, t_s: Array, Ts_base_tool: Array, covs: Array | None = None) -> ToolTrack:
        """Return a track with its phases and motions."""
        at = np.searchsorted(self._begins, t_s, side="left") - 1
        return ToolTrack(t_s, Ts_base_tool, self._phase[at], self._motion[at], covs)

    def between(self, begin_s: float = -np.inf, end_s: float = np.inf, most: int | None = None) -> Part:
        """Return what lies between two times, s, the end included; ``most``: so many rows of a track, evenly spaced."""
        return Part(self, begin_s, end_s, most)

    def parts(self) -> Iterator[Part]:
        """Yield the whole run, a minute at a time."""
        ends = np.arange(_PART_S, self.readings[-1, 0], _PART_S) if len(self.readings) else np.zeros(0)
        for begin_s, end_s in zip([-np.inf, *ends], [*ends, np.inf], strict=True):
            yield self.between(begin_s, end_s)


class Part:
    """The tracks of a run between two times, s, the begin not included, each made when it is asked for."""

    def __init__(self, tracks: Tracks, begin_s: float, end_s: float, most: int | None) -> None:
        self._of, self.begin_s, self.end_s, self._most = tracks, begin_s, end_s, most
        #: motions and rests that lie within
        self.segments = [s for s in tracks.log.segments if s.begin_s >= begin_s - 1e-9 and s.end_s <= end_s + 1e-9]

    def _rows(self, t_s: Array, late_s: float = 0.0) -> NDArray[np.int_]:
        """Return the rows (N,) of times within, of a column of rising times."""
        first, end = (bisect_right(t_s, t + late_s) for t in (self.begin_s, self.end_s))
        count = end - first
        if self._most is None or count <= self._most:
            return np.arange(first, end)
        return first + np.linspace(0, count - 1, self._most).astype(int)

    @cached_property
    def _readings(self) -> Array:
        return np.array(self._of.readings[self._rows(self._of.readings[:, 0])])

    @property
    def t_s(self) -> Array:
        """(N,) times of the joint readings, s."""
        return self._readings[:, 0]

    @property
    def q(self) -> Array:
        """(N, n) joint angles by their sensors, rad."""
        return self._readings[:, 1:]

    @cached_property
    def q_ref(self) -> Array:
        """(N, n) reference joint angles, rad; NaN where nothing was planned."""
        return references(self._of.log.segments, self.t_s, self.q.shape[1])

    @cached_property
    def potentiometers(self) -> ToolTrack:
        """The track by the nominal arm's forward kinematics of ``q``."""
        return self._of.track(self.t_s, self._of.arm.forward(self.q))

    @cached_property
    def reference(self) -> ToolTrack:
        """The reference track, at the times something was planned."""
        planned = np.isfinite(self.q_ref).all(axis=1)
        return self._of.track(self.t_s[planned], self._of.arm.forward(self.q_ref[planned]))

    @cached_property
    def fused(self) -> ToolTrack:
        """The estimated track, smoothed, with vision before and after each time."""
        return self._estimates(self._of.fused)

    @cached_property
    def live(self) -> ToolTrack:
        """The estimated track as it was known at each time: what the loop used."""
        return self._estimates(self._of.live)

    def _estimates(self, table: Array) -> ToolTrack:
        rows = np.array(table[self._rows(table[:, 0])])
        return self._of.track(rows[:, 0], rows[:, 1:17].reshape(-1, 4, 4), rows[:, 17:].reshape(-1, 6, 6))

    @cached_property
    def vision(self) -> ToolTrack:
        """The track measured by vision, one row a shot."""
        of, table, delay = self._of, self._of.measured, self._of.delay
        rows = self._rows(table[:, 0], delay.delay_s)
        near = [max(rows[0] - 1, 0), *rows, min(rows[-1] + 1, len(table) - 1)] if len(rows) else []
        seen = []
        for stamp_s, *numbers in np.array(table[near]):
            pose, cov, noise = (np.array(numbers[a:b]) for a, b in ((0, 16), (16, 52), (52, 88)))
            given = PoseEstimate(pose.reshape(4, 4), cov.reshape(6, 6), noise.reshape(6, 6), 0.0, 0.0, 1.0, NO_POINTS)
            mounting = of.log.mounting_at(stamp_s, of.mounting)
            seen.append(widened(mounting.pose_measurement(given, stamp_s - delay.delay_s), of.changes))
        covs = np.array([s.cov_noise + s.cov_common for s in seen]).reshape(-1, 6, 6) + _mistimed(seen, delay)
        seen = seen[1:-1]
        Ts = np.array([s.T_base_tool for s in seen]).reshape(-1, 4, 4)
        return of.track(np.array([s.t_s for s in seen]), Ts, covs[1:-1])

    @cached_property
    def truth(self) -> ToolTrack | None:
        """The true track, whole, whatever the times; None for a real arm."""
        return None if self._of.truth is None else self._of.track(*self._of.truth)

    @property
    def attained(self) -> ToolTrack:
        """The track that motions are evaluated by: the truth, or on a real arm the fused estimate."""
        return self.fused if self.truth is None else self.truth

    def named(self, name: str) -> ToolTrack:
        """Return a track by the name of its file, the truth cut as the others are."""
        track: ToolTrack = getattr(self, name)
        return track if name != "truth" else track[self._rows(track.t_s)]


def references(segments: Sequence[RunSegment], t_s: Array, joints: int) -> Array:
    """Return the reference joint angles (N, n), rad, at times (N,), s; NaN where nothing was planned."""
    q_ref = np.full((len(t_s), joints), np.nan)
    for segment in segments:
        first, end = np.searchsorted(t_s, [segment.begin_s, segment.end_s], side="right")
        if segment.trajectory is not None and end > first:
            rests_s = segment.trajectory.duration_s if segment.phase == "rest" else 0.0
            q_ref[first:end] = segment.trajectory.at(t_s[first:end] - segment.begin_s + rests_s).q
    return q_ref


def _mistimed(seen: list[PoseMeasurement], delay: Delay) -> Array:
    """Return what the errors of the time stamps add to the covariances (N, 6, 6) of poses of a moving tool."""
    if len(seen) < 2:
        return np.zeros((len(seen), 6, 6))
    t_s, Ts = np.array([s.t_s for s in seen]), np.array([s.T_base_tool for s in seen])
    apart_s = np.diff(t_s)
    near = ((apart_s > 0.0) & (apart_s < APART_S)).astype(float)
    speeds = near[:, None] * log_se3(inverse(Ts[:-1]) @ Ts[1:]) / np.maximum(apart_s, 1e-9)[:, None]
    # The mean of the speeds before and after a pose, as far as they are known.
    v, count = np.zeros((len(seen), 6)), np.zeros((len(seen), 1))
    for rows in (slice(None, -1), slice(1, None)):
        v[rows] += speeds
        count[rows] += near[:, None]
    v /= np.maximum(count, 1.0)
    return np.asarray((delay.sigma_s**2 + delay.jitter_s**2) * v[:, :, None] * v[:, None, :])


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


def joint_columns(t_s: Array, q: Array, q_ref: Array) -> dict[str, NDArray[Any]]:
    """Return the columns of joints.csv: times (N,), s, measured and reference angles (N, n), rad."""
    named: dict[str, NDArray[Any]] = {"t_s": np.round(t_s, 6)}
    for joint in range(q.shape[1]):
        named[f"q{joint + 1}_rad"] = np.round(q[:, joint], _DIGITS)
        named[f"q{joint + 1}_ref_rad"] = np.round(q_ref[:, joint], _DIGITS)
    return named


def write_columns(folder: Path, name: str, parts: Iterable[dict[str, NDArray[Any]]]) -> None:
    """Write columns as NAME.csv, part by part."""
    import pyarrow as pa
    from pyarrow import csv

    with replacing(folder / f"{name}.csv", "wb") as file:
        writer = None
        for table in map(pa.table, parts):
            writer = writer or csv.CSVWriter(file, table.schema, write_options=csv.WriteOptions(quoting_style="needed"))
            writer.write(table)
        if writer is not None:
            writer.close()


def read_track(file: Path, more: tuple[str, ...] = ()) -> tuple[ToolTrack, Array]:
    """Read the CSV of a track, as :func:`write_columns` writes it, without its covariances; and more columns (N, k)."""
    table = Columns.of_csv(file)
    for name in ("phase", "motion"):
        table.require(name)
    numbers = table.numbers((*_COLUMNS, *more))
    if not len(numbers):
        raise InputError(f"{file}: no rows")
    falls = np.flatnonzero(np.diff(numbers[:, 0]) < 0)
    if len(falls):
        line = table.line(falls[0] + 1)
        raise InputError(f"{file}: line {line}: t_s is less than in the line before; times must rise")
    if not np.linalg.norm(numbers[:, 4:8], axis=1).all():
        raise InputError(f"{file}: a quaternion qw .. qz is zero")
    Ts = np.tile(np.eye(4), (len(numbers), 1, 1))
    Ts[:, :3, 3], Ts[:, :3, :3] = numbers[:, 1:4], Rotation.from_quat(numbers[:, [5, 6, 7, 4]]).as_matrix()
    return ToolTrack(numbers[:, 0], Ts, *(np.array(table.texts(n), str) for n in ("phase", "motion"))), numbers[:, 8:]
