"""Metrics of a run: the error of each track against the truth, and what closing the loop gained. SI units.

Distances are of the tool's origin, angles of the whole rotation between two orientations. Without a truth (a real arm) the
fused track stands in for it where motions are evaluated, and nothing is said about the errors of the tracks themselves.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import chdtri

from armsight.app.run.tracks import Part, ToolTrack, Tracks, errors
from armsight.data import Array, Record
from armsight.estimate.chance import squares_of
from armsight.loop.servo import CORRECTED_ABOVE
from armsight.robot.kinematics.arm import Arm

#: Kinds of motion that are evaluated along their path in space.
PATHS = ("line", "circle")
_SETTLED_S = 0.2  # at the end of a rest
#: A path's points lie so close, m, that the distance to the nearest one is the distance to the path.
_PATH_STEP_M = 2e-5


@dataclass(frozen=True, eq=False)
class Study(Record):
    """The error of the position as a function of one quantity."""

    name: str  #: the quantity
    unit: str  #: its unit
    values: Array  #: (N,) its values
    position_rms_m: Array  #: (N,) measured RMS error of the position, m
    low_m: Array  #: (N,) lower end of its 95% interval, from the number of shots, m
    high_m: Array  #: (N,) upper end, m
    predicted_m: Array  #: (N,) error predicted by the covariance, m
    missed: Array  #: (N,) number of shots without a pose


@dataclass(frozen=True)
class TrackMetrics:
    """Errors of a track against the truth; what the covariances claim is None where it has none."""

    position_rms_m: float  #: RMS of the position error, m
    position_max_m: float  #: its maximum, m
    orientation_rms_rad: float  #: RMS of the orientation error, rad
    orientation_max_rad: float  #: its maximum, rad
    rows: int  #: number of poses
    position_sigma_rms_m: float | None = None  #: RMS of the claimed position sigma (root of the trace), m
    orientation_sigma_rms_rad: float | None = None  #: RMS of the claimed orientation sigma, rad
    nees_mean: float | None = None  #: mean normalised estimation error squared; 6 where the covariances are right
    inside_95_share: float | None = None  #: share of the rows whose truth lies inside the claimed 95% region
    rest_position_rms_m: float | None = None  #: RMS of the position error at rest, m; None where it was not evaluated


@dataclass(frozen=True)
class Spread:
    """Percentiles of values: median, 99th, 99.9th, maximum; in their unit."""

    p50: float
    p99: float
    p999: float
    max: float


def track_metrics(track: ToolTrack, truth: ToolTrack) -> TrackMetrics:
    """Return the errors of a track; the truth covers at least the same time."""
    error = errors(track, truth)
    position, angle = np.linalg.norm(error[:, :3], axis=1), np.linalg.norm(error[:, 3:], axis=1)
    claimed: tuple[float, ...] = ()
    if track.covs is not None:
        nees = squares_of(error, track.covs)
        variance = np.einsum("nii->ni", track.covs)
        sigmas = (rms(np.sqrt(variance[:, part].sum(axis=1))) for part in (slice(0, 3), slice(3, 6)))
        claimed = *sigmas, float(nees.mean()), float((nees <= chdtri(6, 0.05)).mean())
    return TrackMetrics(rms(position), float(position.max()), rms(angle), float(angle.max()), len(track), *claimed)


@dataclass(frozen=True)
class PassErrors:
    """Distance of the tool from its reference in one pass of the motions, m."""

    #: RMS over the last fifth of a second of each rest as long, by motion; apart where the arm is nearly singular.
    rests: Mapping[str, float] = field(default_factory=dict)
    singular: Mapping[str, float] = field(default_factory=dict)
    #: for each motion along a path (line, circle) times since its start, s, and distances from the path.
    paths: Mapping[str, tuple[Array, Array]] = field(default_factory=dict)

    @property
    def rest_m(self) -> float | None:
        """RMS over the rests, m; None without any."""
        return rms(np.array(list(self.rests.values()))) if self.rests else None

    @property
    def path_m(self) -> float | None:
        """RMS along all paths, m; None without any."""
        return rms(np.concatenate([m for _, m in self.paths.values()])) if self.paths else None


def pass_errors(tracks: Tracks, span_s: tuple[float, float], singular: Sequence[str]) -> PassErrors:
    """Return the errors of the pass from one time to another, s; rests at singular poses stand apart."""
    rests, paths = dict[str, float](), dict[str, tuple[Array, Array]]()
    for segment in tracks.between(*span_s).segments:
        begin_s, end_s = segment.begin_s, segment.end_s
        rest = segment.phase == "rest"
        if rest and (not segment.motion or end_s - begin_s < _SETTLED_S - 1e-6):
            continue
        if not rest and segment.kind not in PATHS:
            continue
        part = tracks.between(end_s - _SETTLED_S if rest else begin_s, end_s)
        reference = part.reference
        if not len(reference):
            continue
        attained = tracks.between(part.begin_s - _SETTLED_S, end_s + _SETTLED_S).attained
        p, p_ref = attained.at(reference.t_s)[:, :3, 3], reference.Ts_base_tool[:, :3, 3]
        if rest:
            rests[segment.motion] = float(np.sqrt(((p - p_ref) ** 2).sum(axis=1).mean()))
        else:
            paths[segment.motion] = reference.t_s - begin_s, path_distances(p, p_ref)
    apart = {name: rests.pop(name) for name in singular if name in rests}
    return PassErrors(rests, apart, paths)


def hidden(track: ToolTrack, covered_s: tuple[float, float] | None) -> NDArray[np.bool_]:
    """Return (N,) which rows lie where the body was hidden on purpose, or just after."""
    if covered_s is None:
        return np.zeros(len(track), bool)
    return np.asarray((track.t_s > covered_s[0] - 0.01) & (track.t_s < covered_s[1] + 0.05))


def against_truth(before: Part, covered_s: tuple[float, float] | None) -> dict[str, TrackMetrics]:
    """Return the errors of each track in motion and at rest, while the body was not hidden; empty without a truth."""
    found: dict[str, TrackMetrics] = {}
    if before.truth is None:
        return found
    for name in ("vision", "potentiometers", "fused", "live"):
        track: ToolTrack = getattr(before, name)
        seen = ~hidden(track, covered_s)
        moving, resting = (track.phase == "open_loop") & seen, (track.phase == "rest") & seen
        if moving.any() and resting.any():
            at_rest = track_metrics(track[resting], before.truth).position_rms_m
            values = vars(track_metrics(track[moving], before.truth)) | {"rest_position_rms_m": at_rest}
            found[name] = TrackMetrics(**values)
    return found


def partly_uncorrected(arm: Arm, q: Array) -> bool:
    """Return whether the servo corrects the tool only in part at joint angles (n,), rad, as the arm is nearly singular.

    The least singular value of the Jacobian, linear rows over the arm's size, is below ``CORRECTED_ABOVE`` there.
    """
    J = arm.jacobian(q) / np.array([arm.size_m] * 3 + [1.0, 1.0, 1.0])[:, None]
    return bool(np.linalg.svd(J, compute_uv=False)[-1] < CORRECTED_ABOVE)


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
