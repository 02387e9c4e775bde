"""The figures of a run: how far each track is from the truth, and what closing the loop gained. SI units.

Distances are of the tool's origin, angles of the whole turn. Without a truth (a real arm) the fused track stands in for
it where motions are judged, and nothing is said about the error of the tracks themselves.
"""

from __future__ import annotations

import numpy as np
from armsight.app.run.record import RunData, ToolTrack, errors
from armsight.data import Array
from armsight.loop.servo import EASY
from armsight.robot.arm import Arm
from scipy.spatial import cKDTree
from scipy.special import chdtri
from typing import Any

#: Kinds of motion whose path in space is what counts.
PATHS = ("line", "circle")
_SETTLED_S = 0.2  # at the end of a rest
#: A path's points are taken so close that the distance to the nearest is the distance to the path.
_PATH_STEP_M = 2e-5


def track_metrics(track: ToolTrack, truth: ToolTrack) -> dict[str, Any]:
    """Return how far a track is from the truth.

    Args:
        track: what was measured.
        truth: what was.
    """
    error = errors(track, truth)
    position, angle = np.linalg.norm(error[:, :3], axis=1), np.linalg.norm(error[:, 3:], axis=1)
    found: dict[str, Any] = {
        "position_rms_m": rms(position),
        "position_max_m": float(position.max()),
        "orientation_rms_rad": rms(angle),
        "orientation_max_rad": float(angle.max()),
        "rows": len(track),
    }
    if track.covs is not None:
        nees = np.einsum("ni,ni->n", error, np.linalg.solve(track.covs, error[..., None])[..., 0])
        variance = np.einsum("nii->ni", track.covs)
        found |= {
            "position_sigma_rms_m": rms(np.sqrt(variance[:, :3].sum(axis=1))),
            "orientation_sigma_rms_rad": rms(np.sqrt(variance[:, 3:].sum(axis=1))),
            "nees_mean": float(nees.mean()),
            "inside_95_share": float((nees <= chdtri(6, 0.05)).mean()),
        }
    return found


def rest_errors(run: RunData, truth: ToolTrack) -> dict[str, float]:
    """Return how far from its goal the tool stood in the last fifth of a second of each rest, RMS, m."""
    found = {}
    for segment in run.segments:
        rows = (run.wanted.t_s > segment.end_s - _SETTLED_S) & (run.wanted.t_s <= segment.end_s)
        if segment.phase == "rest" and segment.motion and rows.any():
            off = truth.at(run.wanted.t_s[rows])[:, :3, 3] - run.wanted.Ts_base_tool[rows, :3, 3]
            found[segment.motion] = float(np.sqrt((off**2).sum(axis=1).mean()))
    return found


def path_errors(run: RunData, truth: ToolTrack) -> dict[str, tuple[Array, Array]]:
    """Return for each motion along a path (line, circle) times since its start and distances from the path, m."""
    found = {}
    for segment in run.segments:
        if segment.phase == "rest" or segment.kind not in PATHS:
            continue
        rows = (run.wanted.t_s > segment.begin_s) & (run.wanted.t_s <= segment.end_s)
        if rows.any():
            was = truth.at(run.wanted.t_s[rows])[:, :3, 3]
            away = path_distances(was, run.wanted.Ts_base_tool[rows, :3, 3])
            found[segment.motion] = (run.wanted.t_s[rows] - segment.begin_s, away)
    return found


def singular(arm: Arm, q: Array) -> bool:
    """Say whether an arm at joint angles (6,) cannot move its tool in some direction, as far as the loop corrects it."""
    J = arm.jacobian(q) / np.array([arm.size_m] * 3 + [1.0, 1.0, 1.0])[:, None]
    return bool(np.linalg.svd(J, compute_uv=False)[-1] < EASY)


def judge(run: RunData) -> ToolTrack:
    """Return what the run is judged by: the truth, or on a real arm the fused estimate."""
    return run.fused if run.truth is None else run.truth


def path_distances(was: Array, wanted: Array) -> Array:
    """Return (N,) how far points (N, 3) are from a path through points (M, 3), m: time along it does not count."""
    steps = np.linalg.norm(np.diff(wanted, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    keep = np.concatenate([[True], steps > 0])
    fine = np.linspace(0.0, along[-1], max(2, int(along[-1] / _PATH_STEP_M) + 1))
    path = np.stack([np.interp(fine, along[keep], wanted[keep, i]) for i in range(3)], axis=1)
    return np.asarray(cKDTree(path).query(was)[0])


def rms(values: Array) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else float("nan")


def spread(values: Array) -> dict[str, float]:
    """Return p50, p99 and max."""
    p50, p99 = np.percentile(values, [50, 99])
    return {"p50": float(p50), "p99": float(p99), "max": float(np.max(values))}
