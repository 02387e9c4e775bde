"""What a test shows: records whose fields are the keys of check.json (docs/howto/iso9283.md), SI units, and their list."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from armsight.data import Array
from armsight.loop.iso9283.paths import CircleMetrics, PathMetrics
from armsight.loop.iso9283.poses import PoseMetrics
from armsight.loop.iso9283.statistic import Metric


@dataclass(frozen=True)
class WorkspaceResult:
    """Errors of poses all over the workspace, each attained too seldom for a repeatability.

    Attributes:
        count: attained poses.
        mean_m: mean distance from the command.
        max_m: largest distance.
    """

    count: int
    mean_m: Metric
    max_m: Metric


@dataclass(frozen=True)
class DistanceResult:
    """Metrics of the distance between two poses, by their names: what was commanded, AD and RD."""

    first: str
    last: str
    commanded_m: float
    AD_m: Metric
    RD_m: Metric


@dataclass(frozen=True)
class DriftResult:
    """Drift of one pose over the time of the test.

    Attributes:
        pose: its name.
        t_s: (K,) middle of each part of the time.
        dAP_m: (K,) distance of that part's mean position from the first part's.
        max_m: the largest of them.
    """

    pose: str
    t_s: Array
    dAP_m: Array
    max_m: Metric


@dataclass(frozen=True)
class JumpResult:
    """Jump of the circle's radius where joints reverse.

    Attributes:
        joints: numbers of the joints, 1 to 6.
        way: 1 counter-clockwise, -1 clockwise.
        angle_deg: where on the circle.
        jump_m: of the radius, outwards positive.
    """

    joints: tuple[int, ...]
    way: float
    angle_deg: float
    jump_m: Metric


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
        vAP_m: by name of the pose, of those that were approached repeatedly from several directions.
        anywhere: where no pose was attained often.
        distance: between two poses.
        drift: of the first pose.
        paths: by name of the path.
        circle: run both ways.
        notes: what was left out or is remarkable, as text.
    """

    poses: dict[str, PoseMetrics] = field(default_factory=dict)
    vAP_m: dict[str, Metric] = field(default_factory=dict)
    anywhere: WorkspaceResult | None = None
    distance: DistanceResult | None = None
    drift: DriftResult | None = None
    paths: dict[str, PathMetrics] = field(default_factory=dict)
    circle: CircleResult | None = None
    notes: Sequence[str] = ()

    def values(self) -> dict[str, Any]:
        """Return what check.json has; what is not known is absent."""
        found = {name: value for name, value in vars(self).items() if value}
        if (d := self.distance) is not None:
            ends = {"from": d.first, "to": d.last}
            found["distance"] = {**ends, "commanded_m": d.commanded_m, "AD_m": d.AD_m, "RD_m": d.RD_m}
        if (c := self.circle) is not None:
            found["circle"] = {
                **{k: v for k, v in c.metrics._asdict().items() if k != "jumps_m"},
                "axes": c.axes,
                "reversals": c.reversals,
            }
        return found


#: Short name of every metric -> its name and what it is.
MEANINGS = {
    "AP": "pose accuracy: from the command to the mean of the attained positions",
    "RP": "pose repeatability: mean distance from that mean, plus three standard deviations",
    "vAP": "multi-directional pose accuracy variation: largest distance between the means of several approaches",
    "AD": "distance accuracy: error of the mean distance between two poses",
    "RD": "distance repeatability: three standard deviations of it",
    "dAP": "drift: how far the mean wanders over five parts of the time",
    "mean error": "mean distance from the command over all poses",
    "largest error": "the largest of them",
    "AT": "path accuracy: largest distance of the mean path from the commanded one",
    "RT": "path repeatability: the largest along it",
    "circularity": "largest less smallest radius",
    "hysteresis": "largest difference of the radii of both ways",
    "backlash": "how much the radius jumps where the motion along that direction reverses",
    "jump": "the same where a joint reverses: what its backlash does to the radius there",
}


class MetricLine(NamedTuple):
    """One metric as it is listed.

    Attributes:
        name: short, a key of MEANINGS.
        what: what it is of.
        metric: its value, interval and resolution, m.
    """

    name: str
    what: str
    metric: Metric


def metric_lines(result: CheckResult) -> Iterator[MetricLine]:
    """Give all metrics of a test in the sequence of the standard."""
    for name, p in result.poses.items():
        yield MetricLine("AP", f"{name}, {p.count} times", p.AP_m)
        yield MetricLine("RP", f"{name}, {p.count} times", p.RP_m)
        if name in result.vAP_m:
            yield MetricLine("vAP", name, result.vAP_m[name])
    if (w := result.anywhere) is not None:
        yield MetricLine("mean error", f"{w.count} poses", w.mean_m)
        yield MetricLine("largest error", f"{w.count} poses", w.max_m)
    if (d := result.distance) is not None:
        what = f"{d.first} to {d.last}, {1e3 * d.commanded_m:.1f} mm"
        yield MetricLine("AD", what, d.AD_m)
        yield MetricLine("RD", what, d.RD_m)
    if (f := result.drift) is not None:
        yield MetricLine("dAP", f"{f.pose}, {np.ptp(f.t_s):.0f} s", f.max_m)
    for name, path in result.paths.items():
        yield MetricLine("AT", f"{name}, {path.count} times", path.AT_m)
        yield MetricLine("RT", f"{name}, {path.count} times", path.RT_m)
    if result.circle is not None:
        c = result.circle.metrics
        what = f"radius {1e3 * c.radius_m:.1f} mm"
        yield MetricLine("circularity", what, c.circularity_m)
        yield MetricLine("hysteresis", what, c.hysteresis_m)
        for axis, backlash in zip(result.circle.axes, c.backlash_m, strict=True):
            yield MetricLine("backlash", f"along {direction(axis)}", backlash)
        for reversal in result.circle.reversals:
            yield MetricLine("jump", _reversal_text(reversal), reversal.jump_m)


def _reversal_text(reversal: JumpResult) -> str:
    """Return which joints reverse where, as text."""
    way = "counter-clockwise" if reversal.way > 0 else "clockwise"
    joints = ", ".join(map(str, reversal.joints))
    return f"{'joints' if len(reversal.joints) > 1 else 'joint'} {joints} at {reversal.angle_deg:.0f} deg, {way}"


def direction(axis: Array) -> str:
    """Return a direction (3,) as text: x, or the numbers where it is along no axis of the base."""
    near = int(np.argmax(np.abs(axis)))
    return "xyz"[near] if axis[near] > 1 - 1e-6 else "({:.2f}, {:.2f}, {:.2f})".format(*(np.round(axis, 2) + 0.0))
