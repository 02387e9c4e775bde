"""The log of a loop: all that it measured and commanded, the newest in memory and the whole in files without names.

A loop of hours takes no more memory than one of minutes: numbers go to :class:`Rows` as they come, results of shots to a
file of pickles. Until :meth:`Log.settle`, which the loop calls once the calibrations at its beginning are made, everything
is in memory as well, as they evaluate it again.
"""

from __future__ import annotations

import pickle
import tempfile
import weakref
from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import IO

import numpy as np

from armsight.data import Array, Correspondences, JointCommand, JointStates, Missed, PoseEstimate
from armsight.geometry.pose import inverse, log_se3
from armsight.loop.estimators import ArmEstimate, Mounting, Outcome, Track
from armsight.loop.health.follow import RigCorrection
from armsight.robot.trajectories import Trajectory
from armsight.vision.rig import StereoRig

#: Name, time stamp (what a clock that was followed was off removed) and pose of a shot, or why there is none.
Seen = tuple[str, float, PoseEstimate | Missed]
#: s; two poses further apart give no speed; half: slow cameras give none, double: a curve counts as straight
APART_S = 0.5
NEWEST_SHOTS = 2000  # shots kept in memory, to put a rig right; half: 17 s at 60 Hz may not suffice, double: 16 MB more
_NEWEST_LIVE = 100  # live estimates kept, 0.4 s; half: the motion about a late exposure is unknown, double: nothing
_BLOCK = 8192  # numbers that are written together, 64 kB; half: twice as many writes, double: a longer pause for each
#: Detections kept, and by how much their poses differ, m, rad; half: more of the same
_MOST_SHOTS, _DIFFERENT = 400, 0.01
_REASONS = 200  # reasons that are counted, as some have figures; half: rare ones are named less, double: nothing


def _unnamed(owner: object, buffering: int = -1) -> IO[bytes]:
    """Return a file without a name, which is gone with its owner."""
    file = tempfile.TemporaryFile(buffering=buffering)  # noqa: SIM115 - as long as its owner
    weakref.finalize(owner, file.close)
    return file


def count(reasons: Counter[str], reason: str) -> None:
    """Count a reason; where there are too many different ones the rarer half becomes one."""
    reasons[reason] += 1
    if len(reasons) > _REASONS:
        total, kept = reasons.total(), dict(reasons.most_common(_REASONS // 2))
        reasons.clear()
        reasons.update(kept)
        reasons["other reasons"] += total - sum(kept.values())


class Rows:
    """A table of numbers that grows on disk; what does not fit there stays in memory."""

    def __init__(self) -> None:
        self._file: IO[bytes] | None = None
        self._block: list[Array] = []
        self._held = self._written = 0

    def __len__(self) -> int:
        """Return how many rows there are."""
        return self._written + sum(map(len, self._block))

    def append(self, *columns: Array | float) -> None:
        """Append a row: its numbers, in this order."""
        self.extend(np.concatenate([np.ravel(each) for each in columns])[None])

    def extend(self, rows: Array) -> None:
        """Append rows (N, w)."""
        self._block.append(rows)
        self._held += rows.size + 16  # an array takes 128 bytes by itself
        if self._held >= _BLOCK:
            self._write()

    def _write(self) -> None:
        rows = np.concatenate(self._block)
        self._block, self._held = [rows], 0
        try:
            if self._file is None:
                self._file = _unnamed(self, 0)
            end = self._written * rows.shape[1] * 8
            if self._file.write(rows.tobytes()) == rows.nbytes:
                self._written, self._block = self._written + len(rows), []
            else:
                self._file.seek(end)
        except OSError:  # the disk is full: a run goes on
            return

    def array(self, width: int) -> Array:
        """Return all rows (N, width); those on disk are read as they are used."""
        held = [*self._block, np.zeros((0, width))]
        if self._file is None or not self._written:
            return np.concatenate(held)
        stored = np.memmap(self._file, float, "r", shape=(self._written, width))
        return np.concatenate([stored, *held]) if self._block else stored


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
        """Return the pose of a shot at a time, s, with the skew in its covariance; poses come in order of time."""
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
    """An interval of a run: a motion, or the rest at its end."""

    phase: str = "calibration"  #: calibration, open_loop, closed_loop or rest
    motion: str = ""  #: name of the motion, or of the one at whose end the arm rests; "" before the first
    kind: str = ""  #: joints, home, line or circle: the kind of that motion
    closed: bool = False  #: whether the loop was closed on vision
    begin_s: float = 0.0  #: begin, board's clock, s
    end_s: float = 0.0  #: end, board's clock, s
    trajectory: Trajectory | None = None  #: reference of the joints from ``begin_s`` on; None where nothing was planned


@dataclass
class Log:
    """All that a loop measured and commanded, in the order it came."""

    #: readings of the potentiometers, batch by batch; once settled, the newest batch alone.
    joints: list[JointStates] = field(default_factory=list)
    #: the newest estimates at the newest reading, iteration by iteration: what the loop uses.
    live: deque[ArmEstimate] = field(default_factory=lambda: deque(maxlen=_NEWEST_LIVE))
    #: the shots, in covariances the cameras' skew; once settled, the newest ``NEWEST_SHOTS``.
    poses: list[Seen] = field(default_factory=list)
    shots: int = 0  #: how many shots were measured or missed in all
    readings: Rows = field(default_factory=Rows)  #: rows of time, s, and joint angles (n,), rad
    #: rows of time, s, pose (4, 4) and covariance (6, 6) of every live estimate of the tool.
    lives: Rows = field(default_factory=Rows)
    #: the same of the smoothed track, with measurements up to RECORD_LAG_S later
    fused: Rows = field(default_factory=Rows)
    #: rows of time stamp, s, T_left_body (4, 4), its covariance and that of its noise (6, 6) of every pose.
    measured: Rows = field(default_factory=Rows)
    missed: Counter[str] = field(default_factory=Counter)  #: how many shots gave no pose, by reason
    misfit_max: float = 1.0  #: the largest misfit of a measured pose; 1 without one
    outcomes: Counter[Outcome] = field(default_factory=Counter)  #: what the estimator did with the pose measurements
    modes: Counter[str] = field(default_factory=Counter)  #: how many commands had which basis: planned, vision, bridged
    command: JointCommand | None = None  #: the newest command; None before the first
    commanded_s: tuple[float, float] = (np.inf, 0.0)  #: its time, s, and the longest time between two commands, s
    #: computing time from an image in which the body was followed to the command that depends on it, s.
    latency_s: Rows = field(default_factory=Rows)
    #: the same of images in which the body was searched; commands continued meanwhile.
    search_s: Rows = field(default_factory=Rows)
    segments: list[RunSegment] = field(default_factory=list)  #: motions and rests with their times
    corrections: list[RigCorrection] = field(default_factory=list)  #: what was put right of the rig, in order of time
    #: from when on which mounting was used, s, where there was more than one: those after a correction.
    mountings: list[tuple[float, Mounting]] = field(default_factory=list)
    settled: bool = False  #: whether what was measured stays as it is
    _waiting: int = 0
    _stored: IO[bytes] | None = None
    _drawn: list[tuple[str, float | None, Correspondences]] = field(default_factory=list)
    _drawn_every: int = 1
    _drawn_seen: int = 0
    _drawn_at: Array | None = None

    def read(self, states: JointStates) -> None:
        """Append a batch of readings."""
        self.joints.append(states)
        self.readings.extend(np.column_stack([states.t_s, states.q]))

    def estimated(self, estimate: ArmEstimate) -> None:
        """Append a live estimate."""
        self.live.append(estimate)
        self.lives.append(estimate.t_s, estimate.T_base_tool, estimate.cov)

    def smoothed(self, track: Track) -> None:
        """Append to the smoothed track."""
        n = len(track.t_s)
        self.fused.extend(np.column_stack([track.t_s, track.Ts_base_tool.reshape(n, 16), track.covs.reshape(n, 36)]))

    def seen(self, name: str, t_s: float, result: PoseEstimate | Missed) -> None:
        """Append a shot."""
        self.shots += 1
        if isinstance(result, PoseEstimate):  # without what a wrong calibration does to its points, which is most of it
            points = replace(result.points, calibration=np.zeros((len(result.points.ids), 3, 0)))
            result = replace(result, points=points, exposures=None)
        self.poses.append((name, t_s, result))
        self._waiting += 1

    def commanded(self, t_s: float, command: JointCommand, mode: str) -> None:
        """Note a command at a time, s, and its basis."""
        self.command, self.commanded_s = command, (t_s, max(self.commanded_s[1], t_s - self.commanded_s[0]))
        self.modes[mode] += 1

    def settle(self) -> None:
        """Keep only the newest in memory from now on: nothing is measured again."""
        self.settled = True
        self.write()

    def write(self) -> None:
        """Write the shots that wait; it takes a tenth of a millisecond each, so that a command goes first."""
        if self.settled:
            for each in self.poses[len(self.poses) - self._waiting :]:
                self._store(each)
            self._waiting = 0
            del self.joints[:-1]
            if len(self.poses) > 1.1 * NEWEST_SHOTS:
                del self.poses[:-NEWEST_SHOTS]

    def _store(self, seen: Seen) -> None:
        """Count and keep a shot that stays as it is."""
        name, t_s, result = seen
        if isinstance(result, Missed):
            count(self.missed, result.reason)
        else:
            self.misfit_max = max(self.misfit_max, result.misfit)
            self.measured.append(t_s, result.T_left_body, result.cov, result.cov_noise)
            self._draw(name, t_s, result)
        try:
            if self._stored is None:
                self._stored = _unnamed(self)
            pickle.dump(seen, self._stored)
        except OSError:  # the disk is full: a run goes on, and poses.csv will lack the shot
            return

    def every_shot(self) -> Iterator[Seen]:
        """Yield every shot; call it after the loop."""
        self.settle()
        if self._stored is not None:
            self._stored.seek(0)
        while self._stored is not None:
            try:
                yield pickle.load(self._stored)
            except (EOFError, pickle.UnpicklingError):
                return

    def _draw(self, name: str, t_s: float, pose: PoseEstimate) -> None:
        """Keep the detections of a shot whose pose differs from the last: others say little more about the cameras."""
        before = self._drawn_at
        if before is not None and np.abs(log_se3(inverse(before) @ pose.T_left_body)).max() <= _DIFFERENT:
            return
        self._drawn_at = pose.T_left_body
        if self._drawn_seen % self._drawn_every == 0:
            self._drawn.append((name, t_s if np.isfinite(t_s) else None, pose.points.seen))
        self._drawn_seen += 1
        if len(self._drawn) >= 2 * _MOST_SHOTS:
            self._drawn, self._drawn_every = self._drawn[::2], 2 * self._drawn_every

    def detections(self) -> list[tuple[str, float | None, Correspondences]]:
        """Return name, time and detections of at most 400 shots whose poses differ."""
        self.settle()
        return self._drawn[:: -(-len(self._drawn) // _MOST_SHOTS) or 1]

    def counts(self) -> dict[str, int]:
        """Return how many shots were measured, missed and rejected, and how often contradictions reopened the estimator."""
        missed, found = sum(self.missed.values()), self.outcomes
        used = {"measured": self.shots - missed, "missed": missed}
        rejected = found[Outcome.OUTLIER] + found[Outcome.TOO_LATE]
        return used | {"rejected": rejected, "reopened": found[Outcome.REOPENED]}

    def mounting_at(self, t_s: float, first: Mounting) -> Mounting:
        """Return the mounting that was used for a shot of a time, s; the first one before any correction."""
        return next((mounting for since_s, mounting in reversed(self.mountings) if t_s >= since_s), first)
