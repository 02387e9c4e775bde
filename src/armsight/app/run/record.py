"""The record of a run: the log of the loop, and the tracks (tool pose over time) that are made from it and written.

In order: :class:`ToolTrack`, and its CSV and Parquet files; :class:`Skew`, which adds the cameras' exposure skew to a
covariance; :class:`Log` with its segments, which the loop appends to; :class:`RunData`, all tracks on the board's clock,
which :func:`assembled` makes from a log.

Columns of a track's file: ``t_s, x_m, y_m, z_m, qw, qx, qy, qz``, the pose of the tool in the base frame (quaternion
wxyz); where the track has a covariance, ``sigma_x_m .. sigma_z_m`` along the base's axes and ``sigma_rx_rad ..
sigma_rz_rad`` about them; ``phase`` and ``motion``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from armsight.data import Array, JointCommand, JointStates, Missed, PoseEstimate, Record
from armsight.errors import InputError
from armsight.files import replacing
from armsight.geometry.pose import inverse, log_se3
from armsight.loop.estimators import ArmEstimate, Delay, Mounting, Outcome, PoseMeasurement
from armsight.loop.health.change import Change, widened
from armsight.loop.health.follow import RigCorrection
from armsight.robot.kinematics.arm import Arm
from armsight.robot.trajectories import Trajectory
from armsight.tables.columns import Columns
from armsight.vision.rig import StereoRig

_COLUMNS = ("t_s", "x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")
#: Phases of a run.
PHASES = ("calibration", "open_loop", "closed_loop", "rest")
_DIGITS = 9  # decimals of m, s and rad in files


@dataclass(frozen=True, eq=False)
class ToolTrack(Record):
    """Poses of the tool at N times.

    Attributes:
        t_s: (N,) times on the board's clock, s, rising.
        Ts_base_tool: (N, 4, 4) poses of the tool in the base frame.
        phase: (N,) names out of PHASES.
        motion: (N,) names of the motions, "" between them.
        covs: (N, 6, 6) covariances of the right tangents [m; rad]; None where they are not known.
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
    """Raise an InputError with what to install unless pyarrow can be imported."""
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
        file: a CSV as :func:`write_track` writes it.
        more: names of further columns of numbers.

    Returns:
        The track, and those columns (N, k).

    Raises:
        InputError: unreadable, a column missing, no rows, a cell that is no finite number, or times that fall; the message
            names the line.
    """
    table = Columns.of_csv(file)
    for name in ("phase", "motion"):
        table.require(name)
    numbers = table.numbers((*_COLUMNS, *more))
    if not len(numbers):
        raise InputError(f"{file}: no rows")
    falls = np.flatnonzero(np.diff(numbers[:, 0]) < 0)
    if len(falls):
        line, _ = table.rows[falls[0] + 1]
        raise InputError(f"{file}: line {line}: t_s is less than in the line before; times must rise")
    if not np.linalg.norm(numbers[:, 4:8], axis=1).all():
        raise InputError(f"{file}: a quaternion qw .. qz is zero")
    Ts = np.tile(np.eye(4), (len(numbers), 1, 1))
    Ts[:, :3, 3], Ts[:, :3, :3] = numbers[:, 1:4], Rotation.from_quat(numbers[:, [5, 6, 7, 4]]).as_matrix()
    return ToolTrack(numbers[:, 0], Ts, *(np.array(table.texts(n), str) for n in ("phase", "motion"))), numbers[:, 8:]


#: Two poses further apart than this, s, give no speed.
APART_S = 0.5


class Skew:
    """Adds the effect of the cameras' exposure skew to the covariance of a moving body's pose.

    Between the two exposures of a shot the body moves by v dt along the baseline. Triangulation takes that for disparity:
    the depth Z is wrong by Z / B v dt along the line of sight, with B the baseline.

    Args:
        rig: the calibrated pair.
        sync_s: standard deviation of the time between the two exposures of a shot, s.
    """

    def __init__(self, rig: StereoRig, sync_s: float) -> None:
        baseline = rig.T_left_right[:3, 3]
        length = float(np.linalg.norm(baseline))
        self._along, self._by_speed_s = baseline / length, sync_s / length
        self._last: tuple[float, Array] | None = None

    def widened(self, pose: PoseEstimate, t_s: float) -> PoseEstimate:
        """Return a pose with the skew in its covariance; the poses are given in order of time.

        Args:
            pose: of the body in the left camera's frame.
            t_s: time of its shot, s.
        """
        p = pose.T_left_body[:3, 3]
        last, self._last = self._last, (t_s, p)
        if last is None or not 0.0 < t_s - last[0] < APART_S:
            return pose
        speed = float((p - last[1]) @ self._along) / (t_s - last[0])
        sigma = p @ pose.T_left_body[:3, :3] * (self._by_speed_s * speed)
        cov, cov_noise, extra = pose.cov.copy(), pose.cov_noise.copy(), sigma[:, None] * sigma
        cov[:3, :3] += extra
        cov_noise[:3, :3] += extra
        return replace(pose, cov=cov, cov_noise=cov_noise)


@dataclass(frozen=True)
class RunSegment:
    """An interval of a run: a motion, or the rest at its end.

    Attributes:
        phase: calibration, open_loop, closed_loop or rest.
        motion: name of the motion, or of the one at whose end the arm rests; "" before the first.
        kind: joints, home, line or circle: the kind of that motion.
        closed: whether the loop was closed on vision.
        begin_s: begin, board's clock, s.
        end_s: end, board's clock, s.
        trajectory: reference of the joints from ``begin_s`` on; None where nothing was planned.
    """

    phase: str
    motion: str
    kind: str
    closed: bool
    begin_s: float = 0.0
    end_s: float = 0.0
    trajectory: Trajectory | None = None


@dataclass
class Log:
    """All that a run measured and commanded, in the order it came.

    Attributes:
        joints: readings of the potentiometers, batch by batch.
        fused: the estimated tool track, smoothed with measurements up to RECORD_LAG_S later, batch by batch.
        live: the estimate at the newest reading, iteration by iteration: what the loop uses.
        poses: name, time stamp (what a clock that was followed was off removed) and pose of each shot (the cameras' skew in
            its covariance; without what a wrong calibration does to its points, which is most of it), or why there is none.
        outcomes: what the estimator did with each pose measurement: used, or rejected for which reason.
        commanded_s: time of each command, s.
        command: the newest one; None before the first.
        modes: the basis of each command: planned, vision, bridged.
        latency_s: computing time from an image in which the body was followed to the command that depends on it, s.
        search_s: the same of images in which the body was searched; commands continued meanwhile.
        segments: motions and rests with their times.
        corrections: what was put right of the rig, in order of time.
        mountings: from when on which mounting was used, s, where there was more than one: those after a correction.
    """

    joints: list[JointStates] = field(default_factory=list)
    fused: list[ToolTrack] = field(default_factory=list)
    live: list[ArmEstimate] = field(default_factory=list)
    poses: list[tuple[str, float, PoseEstimate | Missed]] = field(default_factory=list)
    outcomes: list[Outcome] = field(default_factory=list)
    commanded_s: list[float] = field(default_factory=list)
    command: JointCommand | None = None
    modes: list[str] = field(default_factory=list)
    latency_s: list[float] = field(default_factory=list)
    search_s: list[float] = field(default_factory=list)
    segments: list[RunSegment] = field(default_factory=list)
    corrections: list[RigCorrection] = field(default_factory=list)
    mountings: list[tuple[float, Mounting]] = field(default_factory=list)

    def mounting_at(self, t_s: float, first: Mounting) -> Mounting:
        """Return the mounting that was used for a shot of a time, s; the first one before any correction."""
        return next((mounting for since_s, mounting in reversed(self.mountings) if t_s >= since_s), first)


@dataclass(frozen=True, eq=False)
class RunData(Record):
    """The tracks and tables of a run, all on the board's clock.

    Attributes:
        t_s: (N,) times of the potentiometers' readings, s.
        q: (N, n) joint angles from the potentiometers, rad.
        q_ref: (N, n) reference joint angles, rad; NaN where nothing was planned.
        potentiometers: tool track by the nominal arm's forward kinematics of ``q``.
        vision: tool track measured by vision, one row a shot.
        fused: estimated tool track, smoothed, with vision before and after each time.
        live: estimated tool track as it was known at each time: what the loop used.
        reference: reference tool track, at the times something was planned.
        truth: true tool track; None for a real arm.
        segments: motions and rests with their times.
        latency_s: computing time from each image in which the body was followed to the command that depends on it, s.
        search_s: the same of the images in which it was searched.
        modes: (M,) basis of each command.
        missed: number of shots that gave no pose.
        rejected: number of pose measurements that the estimator rejected.
        reopened: how many times measurements contradicted what the estimator had learned, so that it opened it again.
        misfit_max: the largest misfit of a measured pose; 1 without one.
    """

    t_s: Array
    q: Array
    q_ref: Array
    potentiometers: ToolTrack
    vision: ToolTrack
    fused: ToolTrack
    live: ToolTrack
    reference: ToolTrack
    truth: ToolTrack | None
    segments: tuple[RunSegment, ...]
    latency_s: Array
    search_s: Array
    modes: NDArray[np.str_]
    missed: int
    rejected: int
    reopened: int
    misfit_max: float


def assembled(
    log: Log,
    arm: Arm,
    mounting: Mounting,
    delay: Delay,
    truth: tuple[Array, Array] | None = None,
    changes: Sequence[Change] = (),
) -> RunData:
    """Make the tracks of a run from its log.

    Args:
        log: of the run.
        arm: the nominal arm.
        mounting: poses of cameras and body on the arm.
        delay: of the cameras' time stamps. Its uncertainty adds to the covariance of the pose of a moving tool.
        truth: times (N,), s, and poses (N, 4, 4) of the tool in the base frame, where they are known.
        changes: what may have moved rig or body; it adds to the covariance of vision from its beginning on.
    """
    t_s, q, q_ref = joints_of(log)
    planned = np.isfinite(q_ref).all(axis=1)
    named = _SegmentNames(log.segments)
    seen = [
        log.mounting_at(t, mounting).pose_measurement(p, t - delay.delay_s)
        for _, t, p in log.poses
        if isinstance(p, PoseEstimate)
    ]
    seen = [widened(each, changes) for each in seen]
    fused = [part for part in log.fused if part.covs is not None]
    return RunData(
        t_s,
        q,
        q_ref,
        named.track(t_s, arm.forward(q)),
        named.track(
            np.array([s.t_s for s in seen]),
            np.array([s.T_base_tool for s in seen]).reshape(-1, 4, 4),
            np.array([s.cov_noise + s.cov_common for s in seen]).reshape(-1, 6, 6) + _mistimed(seen, delay),
        ),
        named.track(
            np.concatenate([part.t_s for part in fused]),
            np.concatenate([part.Ts_base_tool for part in fused]),
            np.concatenate([part.covs for part in fused if part.covs is not None]),
        ),
        named.track(
            np.array([e.t_s for e in log.live]),
            np.array([e.T_base_tool for e in log.live]),
            np.array([e.cov for e in log.live]),
        ),
        named.track(t_s[planned], arm.forward(q_ref[planned])),
        None if truth is None else named.track(*truth),
        tuple(log.segments),
        np.array(log.latency_s),
        np.array(log.search_s),
        np.array(log.modes),
        len(log.poses) - len(seen),
        sum(outcome in (Outcome.OUTLIER, Outcome.TOO_LATE) for outcome in log.outcomes),
        log.outcomes.count(Outcome.REOPENED),
        max((pose.misfit for _, _, pose in log.poses if isinstance(pose, PoseEstimate)), default=1.0),
    )


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


def joints_of(log: Log) -> tuple[Array, Array, Array]:
    """Return the times (N,) of a log's readings, s, the joints (N, n), and their reference, rad; NaN where none is."""
    t_s = np.concatenate([s.t_s for s in log.joints])
    q = np.concatenate([s.q for s in log.joints])
    q_ref = np.full_like(q, np.nan)
    for segment in log.segments:
        rows = (t_s > segment.begin_s) & (t_s <= segment.end_s)
        if segment.trajectory is not None and rows.any():
            since = t_s[rows] - segment.begin_s
            q_ref[rows] = segment.trajectory.at(since + (segment.trajectory.duration_s if _rests(segment) else 0.0)).q
    return t_s, q, q_ref


def _rests(segment: RunSegment) -> bool:
    """Return whether the arm stands at the end of its trajectory."""
    return segment.phase == "rest"


class _SegmentNames:
    """Finds the phase and the motion that a time belongs to."""

    def __init__(self, segments: list[RunSegment]) -> None:
        self._begins = np.array([s.begin_s for s in segments])
        self._phase = np.array([s.phase for s in segments] + ["calibration"])
        self._motion = np.array([s.motion for s in segments] + [""])

    def track(self, t_s: Array, Ts_base_tool: Array, covs: Array | None = None) -> ToolTrack:
        """Return a track with its phases and motions; times before the first segment belong to the calibration."""
        at = np.searchsorted(self._begins, t_s, side="left") - 1
        return ToolTrack(t_s, Ts_base_tool, self._phase[at], self._motion[at], covs)


def cut(run: RunData, begin_s: float, end_s: float) -> RunData:
    """Return the rows of all tracks between two times, board's clock, s."""

    def within(track: ToolTrack) -> ToolTrack:
        return track[(track.t_s > begin_s) & (track.t_s <= end_s)]

    rows = (run.t_s > begin_s) & (run.t_s <= end_s)
    return replace(
        run,
        t_s=run.t_s[rows],
        q=run.q[rows],
        q_ref=run.q_ref[rows],
        potentiometers=within(run.potentiometers),
        vision=within(run.vision),
        fused=within(run.fused),
        live=within(run.live),
        reference=within(run.reference),
        segments=tuple(s for s in run.segments if s.begin_s >= begin_s - 1e-9 and s.end_s <= end_s + 1e-9),
    )
