"""A run as tables: its log brought onto one axis of time, beside what was wanted and, in the workcell, the truth."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from armsight.app.run.record import Log, Segment
from armsight.app.run_skew import APART_S
from armsight.app.run_tracks import ToolTrack
from armsight.data import Array, PoseEstimate, Record
from armsight.geometry.pose import inverse, log_se3
from armsight.loop.estimators import Delay, Mounting, Sighting, Verdict
from armsight.robot.arm import Arm


@dataclass(frozen=True, eq=False)
class RunData(Record):
    """A run.

    Attributes:
        t_s: (N,) times of the potentiometers' readings, board's clock.
        q: (N, 6) what they said, rad.
        q_wanted: (N, 6) what the planned motions wanted, rad; NaN where nothing was planned.
        potentiometers: where the table of the arm has the tool with them.
        vision: where each used shot saw it.
        fused: where the estimator has it, a little later, with vision on both sides of each time.
        live: where the estimator had it at once: what the loop goes by.
        wanted: where it was to be, at the times something was planned.
        truth: where it was; None for a real arm.
        segments: what happened when.
        latency_s: from each image to the command that knows it, our time, s.
        modes: (M,) what each command was based on.
        missed: shots that gave no pose.
        outliers: sightings that the estimator did not believe.
    """

    t_s: Array
    q: Array
    q_wanted: Array
    potentiometers: ToolTrack
    vision: ToolTrack
    fused: ToolTrack
    live: ToolTrack
    wanted: ToolTrack
    truth: ToolTrack | None
    segments: tuple[Segment, ...]
    latency_s: Array
    modes: NDArray[np.str_]
    missed: int
    outliers: int


def assembled(
    log: Log, arm: Arm, mounting: Mounting, delay: Delay, truth: tuple[Array, Array] | None = None
) -> RunData:
    """Bring a log onto one axis of time.

    Args:
        log: of the run.
        arm: the nominal arm.
        mounting: where cameras and body are.
        delay: how late the camera's stamps are: what is not known of that, too, spoils the pose of a tool that moves.
        truth: times (N,) and poses (N, 4, 4) of the tool, where they are known.
    """
    t_s, q, q_wanted = joints_of(log)
    planned = np.isfinite(q_wanted).all(axis=1)
    named = _Named(log.segments)
    seen = [mounting.sighting(p, t - delay.delay_s) for _, t, p in log.poses if isinstance(p, PoseEstimate)]
    fused = [part for part in log.fused if part.covs is not None]
    return RunData(
        t_s,
        q,
        q_wanted,
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
        named.track(t_s[planned], arm.forward(q_wanted[planned])),
        None if truth is None else named.track(*truth),
        tuple(log.segments),
        np.array(log.latency_s),
        np.array(log.modes),
        len(log.poses) - len(seen),
        sum(verdict in (Verdict.OUTLIER, Verdict.TOO_LATE) for verdict in log.verdicts),
    )


def _mistimed(seen: list[Sighting], delay: Delay) -> Array:
    """Return what the stamps' errors add to the covariances (N, 6, 6) of poses of a moving tool."""
    if len(seen) < 2:
        return np.zeros((len(seen), 6, 6))
    t_s, Ts = np.array([s.t_s for s in seen]), np.array([s.T_base_tool for s in seen])
    apart_s = np.diff(t_s)
    tells = ((apart_s > 0.0) & (apart_s < APART_S)).astype(float)
    speeds = tells[:, None] * log_se3(inverse(Ts[:-1]) @ Ts[1:]) / np.maximum(apart_s, 1e-9)[:, None]
    # The mean of the speeds before and after a pose, as far as there are such.
    v, count = np.zeros((len(seen), 6)), np.zeros((len(seen), 1))
    for rows in (slice(None, -1), slice(1, None)):
        v[rows] += speeds
        count[rows] += tells[:, None]
    v /= np.maximum(count, 1.0)
    return np.asarray((delay.sigma_s**2 + delay.jitter_s**2) * v[:, :, None] * v[:, None, :])


def joints_of(log: Log) -> tuple[Array, Array, Array]:
    """Return a log's times (N,) of readings, the joints (N, 6) then, and as planned, rad; NaN where nothing was."""
    t_s = np.concatenate([s.t_s for s in log.joints])
    q = np.concatenate([s.q for s in log.joints])
    q_wanted = np.full_like(q, np.nan)
    for segment in log.segments:
        rows = (t_s > segment.begin_s) & (t_s <= segment.end_s)
        if segment.trajectory is not None and rows.any():
            since = t_s[rows] - segment.begin_s
            q_wanted[rows] = segment.trajectory.at(
                since + (segment.trajectory.duration_s if _rests(segment) else 0.0)
            ).q
    return t_s, q, q_wanted


def _rests(segment: Segment) -> bool:
    """Whether the arm stands at the end of its trajectory."""
    return segment.phase == "rest"


class _Named:
    """Tells for any time which phase and motion it belongs to."""

    def __init__(self, segments: list[Segment]) -> None:
        self._begins = np.array([s.begin_s for s in segments])
        self._phase = np.array([s.phase for s in segments] + ["calibration"])
        self._motion = np.array([s.motion for s in segments] + [""])

    def track(self, t_s: Array, Ts_base_tool: Array, covs: Array | None = None) -> ToolTrack:
        """Return a track with its phases and motions; what lies before the first segment belongs to the calibration."""
        at = np.searchsorted(self._begins, t_s, side="left") - 1
        return ToolTrack(t_s, Ts_base_tool, self._phase[at], self._motion[at], covs)


def cut(run: RunData, begin_s: float, end_s: float) -> RunData:
    """Return what lies between two times of all tracks."""

    def within(track: ToolTrack) -> ToolTrack:
        return track[(track.t_s > begin_s) & (track.t_s <= end_s)]

    rows = (run.t_s > begin_s) & (run.t_s <= end_s)
    return replace(
        run,
        t_s=run.t_s[rows],
        q=run.q[rows],
        q_wanted=run.q_wanted[rows],
        potentiometers=within(run.potentiometers),
        vision=within(run.vision),
        fused=within(run.fused),
        live=within(run.live),
        wanted=within(run.wanted),
        segments=tuple(s for s in run.segments if s.begin_s >= begin_s - 1e-9 and s.end_s <= end_s + 1e-9),
    )
