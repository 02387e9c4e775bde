"""The metrics of a test, as records, and the JSON document made of them (docs/howto/iso9283.md has its keys)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from armsight.data import Array
from armsight.loop.iso9283.paths import CircleMetrics, PathMetrics
from armsight.loop.iso9283.statistic import Metric


@dataclass(frozen=True)
class PoseResult:
    """Metrics of one commanded pose.

    Attributes:
        count: how many times the pose was attained.
        accuracy: AP, m.
        accuracy_xyz: (3,) attained mean less command, base, m.
        accuracy_rotation: (3,) rotation of the attained mean against the command, rad; None where a rotation is unknown.
        repeatability: RP, m.
        repeatability_rotation: (3,) rad; None where the attained rotations are unknown.
        multi_directional: vAP, m; None where the pose was approached repeatedly from one direction only.
    """

    count: int
    accuracy: Metric
    accuracy_xyz: Array
    accuracy_rotation: Array | None
    repeatability: Metric
    repeatability_rotation: Array | None
    multi_directional: Metric | None


@dataclass(frozen=True)
class WorkspaceResult:
    """Errors of poses all over the workspace, each attained too seldom for a repeatability.

    Attributes:
        count: attained poses.
        mean: mean distance from the command, m.
        largest: largest distance, m.
    """

    count: int
    mean: Metric
    largest: Metric


@dataclass(frozen=True)
class DistanceResult:
    """Metrics of the distance between two poses.

    Attributes:
        first: name of the first pose.
        last: name of the second pose.
        commanded_m: commanded distance, m.
        accuracy: AD, m.
        repeatability: RD, m.
    """

    first: str
    last: str
    commanded_m: float
    accuracy: Metric
    repeatability: Metric


@dataclass(frozen=True)
class DriftResult:
    """Drift of one pose over the time of the test.

    Attributes:
        pose: its name.
        t_s: (K,) middle of each part of the time, s.
        dAP_m: (K,) distance of that part's mean position from the first part's, m.
        largest: the largest of them, m.
    """

    pose: str
    t_s: Array
    dAP_m: Array
    largest: Metric


@dataclass(frozen=True)
class PathResult:
    """Metrics of one path.

    Attributes:
        count: how many times the path was followed.
        metrics: AT, RT and the mean path's distance from the command at every path point.
    """

    count: int
    metrics: PathMetrics


@dataclass(frozen=True)
class JumpResult:
    """Jump of the circle's radius where joints reverse.

    Attributes:
        joints: numbers of the joints, 1 to 6.
        way: 1 counter-clockwise, -1 clockwise.
        angle_deg: where on the circle.
        jump: of the radius, outwards positive, m.
    """

    joints: tuple[int, ...]
    way: float
    angle_deg: float
    jump: Metric


@dataclass(frozen=True)
class CircleResult:
    """Metrics of a circle run both ways.

    Attributes:
        axes: (2, 3) unit vectors of the circle's plane, base.
        metrics: circularity, hysteresis, backlash and the curves.
        reversals: jumps of the radius where joints reverse.
    """

    axes: Array
    metrics: CircleMetrics
    reversals: Sequence[JumpResult]


@dataclass(frozen=True)
class CheckResult:
    """All metrics that the rows of a test allow; what they do not allow is empty or None.

    Attributes:
        poses: by name of the pose.
        workspace: where no pose was attained often.
        distance: between two poses.
        drift: of the first pose.
        paths: by name of the path.
        circle: run both ways.
        notes: what was left out or is remarkable, as text.
    """

    poses: dict[str, PoseResult] = field(default_factory=dict)
    workspace: WorkspaceResult | None = None
    distance: DistanceResult | None = None
    drift: DriftResult | None = None
    paths: dict[str, PathResult] = field(default_factory=dict)
    circle: CircleResult | None = None
    notes: Sequence[str] = ()


def check_json(result: CheckResult) -> dict[str, Any]:
    """Return metrics as check.json has them, SI units; what is not known is absent or null."""
    document: dict[str, Any] = {}
    if result.workspace is not None:
        w = result.workspace
        document["anywhere"] = {"count": w.count, "mean_m": _metric_json(w.mean), "max_m": _metric_json(w.largest)}
    if result.poses:
        document["poses"] = {name: _pose_json(p) for name, p in result.poses.items()}
        several = {n: p.multi_directional for n, p in result.poses.items() if p.multi_directional is not None}
        document |= {"vAP_m": {name: _metric_json(metric) for name, metric in several.items()}} if several else {}
    if result.distance is not None:
        d = result.distance
        document["distance"] = {
            "from": d.first,
            "to": d.last,
            "commanded_m": d.commanded_m,
            "AD_m": _metric_json(d.accuracy),
            "RD_m": _metric_json(d.repeatability),
        }
    if result.drift is not None:
        f = result.drift
        times, dAP_m = f.t_s.tolist(), f.dAP_m.tolist()
        document["drift"] = {"pose": f.pose, "t_s": times, "dAP_m": dAP_m, "max_m": _metric_json(f.largest)}
    if result.paths:
        document["paths"] = {name: _path_json(path) for name, path in result.paths.items()}
    if result.circle is not None:
        document["circle"] = _circle_json(result.circle)
    return document | {"notes": list(result.notes)}


def _metric_json(metric: Metric) -> dict[str, float | None]:
    return {**asdict(metric), "sigma": metric.sigma}


def _pose_json(p: PoseResult) -> dict[str, Any]:
    return {
        "count": p.count,
        "AP_m": _metric_json(p.accuracy),
        "AP_xyz_m": p.accuracy_xyz.tolist(),
        "AP_rotation_rad": None if p.accuracy_rotation is None else p.accuracy_rotation.tolist(),
        "RP_m": _metric_json(p.repeatability),
        "RP_rotation_rad": None if p.repeatability_rotation is None else p.repeatability_rotation.tolist(),
    }


def _path_json(path: PathResult) -> dict[str, Any]:
    return {
        "count": path.count,
        "AT_m": _metric_json(path.metrics.accuracy),
        "RT_m": _metric_json(path.metrics.repeatability),
        "off_m": path.metrics.off.tolist(),
    }


def _circle_json(circle: CircleResult) -> dict[str, Any]:
    metrics = circle.metrics
    return {
        "centre_m": metrics.centre.tolist(),
        "radius_m": metrics.radius_m,
        "axes": circle.axes.tolist(),
        "circularity_m": _metric_json(metrics.circularity),
        "hysteresis_m": _metric_json(metrics.hysteresis),
        "steps_m": metrics.steps_m.tolist(),
        "backlash_m": [_metric_json(metric) for metric in metrics.backlash],
        "reversals": [
            {"joints": list(r.joints), "way": r.way, "angle_deg": r.angle_deg, "jump_m": _metric_json(r.jump)}
            for r in circle.reversals
        ],
        "angle_deg": metrics.angle_deg.tolist(),
        "radii_m": metrics.radii_m.tolist(),
    }
