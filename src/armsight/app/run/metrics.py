"""Metrics of a run: the error of each track against the truth, and what closing the loop gained. SI units.

In: the tracks of a run (:class:`~armsight.app.run.record.RunData`). Out: records of numbers, which
:mod:`~armsight.app.run.summary` writes. Distances are of the tool's origin, angles those of the whole rotation between two
orientations. Without a truth (a real arm) the fused track stands in for it where motions are evaluated, and nothing is said
about the errors of the tracks themselves.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import chdtri

from armsight.app.run.record import RunData, ToolTrack, errors
from armsight.data import Array, Record
from armsight.loop.servo import CORRECTED_ABOVE
from armsight.robot.kinematics.arm import Arm

#: Kinds of motion that are evaluated along their path in space.
PATHS = ("line", "circle")
_SETTLED_S = 0.2  # at the end of a rest
#: A path's points lie so close, m, that the distance to the nearest one is the distance to the path.
_PATH_STEP_M = 2e-5


@dataclass(frozen=True, eq=False)
class Study(Record):
    """The error of the position as a function of one quantity.

    Attributes:
        name: the quantity.
        unit: its unit.
        values: (N,) its values.
        position_rms_m: (N,) measured RMS error of the position, m.
        low_m: (N,) lower end of its 95% interval, from the number of shots, m.
        high_m: (N,) upper end, m.
        predicted_m: (N,) error predicted by the covariance, m.
        missed: (N,) number of shots without a pose.
    """

    name: str
    unit: str
    values: Array
    position_rms_m: Array
    low_m: Array
    high_m: Array
    predicted_m: Array
    missed: Array


@dataclass(frozen=True)
class ClaimedMetrics:
    """How well a track's covariances describe its errors.

    Attributes:
        position_sigma_rms_m: RMS of the claimed position sigma (root of the trace), m.
        orientation_sigma_rms_rad: RMS of the claimed orientation sigma, rad.
        nees_mean: mean normalised estimation error squared; 6 where the covariances are right.
        inside_95_share: share of the rows whose truth lies inside the claimed 95% region.
    """

    position_sigma_rms_m: float
    orientation_sigma_rms_rad: float
    nees_mean: float
    inside_95_share: float


@dataclass(frozen=True)
class TrackMetrics:
    """Errors of a track against the truth.

    Attributes:
        position_rms_m: RMS of the position error, m.
        position_max_m: its maximum, m.
        orientation_rms_rad: RMS of the orientation error, rad.
        orientation_max_rad: its maximum, rad.
        rows: number of poses.
        claimed: metrics of the covariances; None where the track has none.
        rest_position_rms_m: RMS of the position error at rest, m; None where it was not evaluated.
    """

    position_rms_m: float
    position_max_m: float
    orientation_rms_rad: float
    orientation_max_rad: float
    rows: int
    claimed: ClaimedMetrics | None = None
    rest_position_rms_m: float | None = None


@dataclass(frozen=True)
class Spread:
    """Percentiles of values: median, 99th, 99.9th, maximum; in their unit."""

    p50: float
    p99: float
    p999: float
    max: float


def track_metrics(track: ToolTrack, truth: ToolTrack) -> TrackMetrics:
    """Return the errors of a track.

    Args:
        track: what was measured.
        truth: the true poses, over at least the same time.
    """
    error = errors(track, truth)
    position, angle = np.linalg.norm(error[:, :3], axis=1), np.linalg.norm(error[:, 3:], axis=1)
    claimed = None
    if track.covs is not None:
        nees = np.einsum("ni,ni->n", error, np.linalg.solve(track.covs, error[..., None])[..., 0])
        variance = np.einsum("nii->ni", track.covs)
        claimed = ClaimedMetrics(
            rms(np.sqrt(variance[:, :3].sum(axis=1))),
            rms(np.sqrt(variance[:, 3:].sum(axis=1))),
            float(nees.mean()),
            float((nees <= chdtri(6, 0.05)).mean()),
        )
    return TrackMetrics(rms(position), float(position.max()), rms(angle), float(angle.max()), len(track), claimed)


def rest_errors(run: RunData, truth: ToolTrack) -> dict[str, float]:
    """Return the RMS distance of the tool from its reference over the last fifth of a second of each rest as long, m."""
    found = {}
    for segment in run.segments:
        rows = (run.reference.t_s > segment.end_s - _SETTLED_S) & (run.reference.t_s <= segment.end_s)
        long = segment.end_s - segment.begin_s >= _SETTLED_S - 1e-6
        if segment.phase == "rest" and segment.motion and long and rows.any():
            off = truth.at(run.reference.t_s[rows])[:, :3, 3] - run.reference.Ts_base_tool[rows, :3, 3]
            found[segment.motion] = float(np.sqrt((off**2).sum(axis=1).mean()))
    return found


def path_errors(run: RunData, truth: ToolTrack) -> dict[str, tuple[Array, Array]]:
    """Return for each motion along a path (line, circle) times since its start, s, and distances from the path, m."""
    found = {}
    for segment in run.segments:
        if segment.phase == "rest" or segment.kind not in PATHS:
            continue
        rows = (run.reference.t_s > segment.begin_s) & (run.reference.t_s <= segment.end_s)
        if rows.any():
            attained = truth.at(run.reference.t_s[rows])[:, :3, 3]
            distances = path_distances(attained, run.reference.Ts_base_tool[rows, :3, 3])
            found[segment.motion] = (run.reference.t_s[rows] - segment.begin_s, distances)
    return found


def partly_uncorrected(arm: Arm, q: Array) -> bool:
    """Return whether the servo corrects the tool only in part at joint angles (n,), rad, as the arm is nearly singular.

    That is where the least singular value of the Jacobian (linear rows divided by the arm's size) is below
    ``CORRECTED_ABOVE``, a tuning of the servo: from there on it reduces its correction in that direction. Rests there are
    reported apart.
    """
    J = arm.jacobian(q) / np.array([arm.size_m] * 3 + [1.0, 1.0, 1.0])[:, None]
    return bool(np.linalg.svd(J, compute_uv=False)[-1] < CORRECTED_ABOVE)


def evaluated_track(run: RunData) -> ToolTrack:
    """Return the track that motions are evaluated by: the truth, or on a real arm the fused estimate."""
    return run.fused if run.truth is None else run.truth


def path_distances(points: Array, path: Array) -> Array:
    """Return the distances (N,) of points (N, 3) from a path through points (M, 3), m; the time along it does not count."""
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    keep = np.concatenate([[True], steps > 0])
    fine = np.linspace(0.0, along[-1], max(2, int(along[-1] / _PATH_STEP_M) + 1))
    dense = np.stack([np.interp(fine, along[keep], path[keep, i]) for i in range(3)], axis=1)
    return np.asarray(cKDTree(dense).query(points)[0])


def rms(values: Array) -> float:
    """Return the root mean square; NaN of no values."""
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else float("nan")


def spread(values: Array) -> Spread:
    """Return median, 99th and 99.9th percentile and maximum."""
    p50, p99, p999 = np.percentile(values, [50, 99, 99.9])
    return Spread(float(p50), float(p99), float(p999), float(np.max(values)))
