"""What a test shows: records whose fields are the keys of check.json (docs/howto/iso9283.md), SI units, their list, limits.

``--limit AP=0.5mm`` holds every metric of that name, without the instrument's noise; of a metric that cannot be resolved
the upper end of its interval, as no more is known of it; without an interval the metric as measured.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from armsight.app.show.report import Fact
from armsight.data import Array
from armsight.errors import InputError
from armsight.loop.iso9283.paths import CircleMetrics, PathMetrics
from armsight.loop.iso9283.poses import PoseMetrics
from armsight.loop.iso9283.statistic import Metric

#: Unit -> how many of it are a metre.
_UNITS = {"m": 1.0, "mm": 1e3, "um": 1e6, "µm": 1e6}


@dataclass(frozen=True)
class WorkspaceResult:
    """Errors of poses all over the workspace, each attained too seldom for a repeatability."""

    count: int  #: attained poses
    mean_m: Metric  #: mean distance from the command
    max_m: Metric  #: largest distance


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
    """Drift of one pose over the time of the test."""

    pose: str  #: its name
    t_s: Array  #: (K,) middle of each part of the time
    dAP_m: Array  #: (K,) distance of that part's mean position from the first part's
    max_m: Metric  #: the largest of them


@dataclass(frozen=True)
class Jump:
    """Jump of the circle's radius where joints reverse."""

    joints: tuple[int, ...]  #: numbers of the joints, 1 to 6
    way: float  #: 1 counter-clockwise, -1 clockwise
    angle_deg: float  #: where on the circle
    jump_m: Metric  #: of the radius, outwards positive


@dataclass(frozen=True)
class CircleResult:
    """Metrics of a circle run both ways."""

    axes: Array  #: (2, 3) unit vectors of the circle's plane, base
    metrics: CircleMetrics  #: circularity, hysteresis, backlash and the curves
    reversals: Sequence[Jump]  #: jumps of the radius where joints reverse


@dataclass(frozen=True)
class CheckResult:
    """All metrics that the rows of a test allow; what they do not allow is empty or None."""

    poses: dict[str, PoseMetrics] = field(default_factory=dict)  #: by name of the pose
    vAP_m: dict[str, Metric] = field(default_factory=dict)  #: of poses approached repeatedly from several directions
    anywhere: WorkspaceResult | None = None  #: where no pose was attained often
    distance: DistanceResult | None = None  #: between two poses
    drift: DriftResult | None = None  #: of the first pose
    paths: dict[str, PathMetrics] = field(default_factory=dict)  #: by name of the path
    circle: CircleResult | None = None  #: run both ways
    notes: Sequence[str] = ()  #: what was left out or is remarkable, as text

    def values(self) -> dict[str, Any]:
        """Return what check.json has; what is not known is absent."""
        found = {name: value for name, value in vars(self).items() if value}
        if (d := self.distance) is not None:
            ends = {"from": d.first, "to": d.last}
            found["distance"] = {**ends, "commanded_m": d.commanded_m, "AD_m": d.AD_m, "RD_m": d.RD_m}
        if (c := self.circle) is not None:
            metrics = {k: v for k, v in c.metrics._asdict().items() if k != "jumps_m"}
            found["circle"] = {**metrics, "axes": c.axes, "reversals": c.reversals}
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
    """One metric as it is listed."""

    name: str  #: short, a key of MEANINGS
    what: str  #: what it is of
    metric: Metric  #: its value, interval and resolution, m


def metric_lines(result: CheckResult) -> Iterator[MetricLine]:
    """Give all metrics of a test in the sequence of the standard."""
    for what, metrics in _listed(result):
        yield from (MetricLine(name, what, metric) for name, metric in metrics.items())


def _listed(r: CheckResult) -> Iterator[tuple[str, dict[str, Metric]]]:
    """Yield what metrics are of, and these by their names."""
    for name, p in r.poses.items():
        yield f"{name}, {p.count} times", {"AP": p.AP_m, "RP": p.RP_m}
        if name in r.vAP_m:
            yield name, {"vAP": r.vAP_m[name]}
    if (w := r.anywhere) is not None:
        yield f"{w.count} poses", {"mean error": w.mean_m, "largest error": w.max_m}
    if (d := r.distance) is not None:
        yield f"{d.first} to {d.last}, {1e3 * d.commanded_m:.1f} mm", {"AD": d.AD_m, "RD": d.RD_m}
    if (f := r.drift) is not None:
        yield f"{f.pose}, {np.ptp(f.t_s):.0f} s", {"dAP": f.max_m}
    for name, path in r.paths.items():
        yield f"{name}, {path.count} times", {"AT": path.AT_m, "RT": path.RT_m}
    if r.circle is not None:
        c = r.circle.metrics
        yield f"radius {1e3 * c.radius_m:.1f} mm", {"circularity": c.circularity_m, "hysteresis": c.hysteresis_m}
        for axis, backlash in zip(r.circle.axes, c.backlash_m, strict=True):
            yield f"along {direction(axis)}", {"backlash": backlash}
        for each in r.circle.reversals:
            way = "counter-clockwise" if each.way > 0 else "clockwise"
            joints = f"joint{'s' * (len(each.joints) > 1)} {', '.join(map(str, each.joints))}"
            yield f"{joints} at {each.angle_deg:.0f} deg, {way}", {"jump": each.jump_m}


def direction(axis: Array) -> str:
    """Return a direction (3,) as text: x, or the numbers where it is along no axis of the base."""
    near = int(np.argmax(np.abs(axis)))
    return "xyz"[near] if axis[near] > 1 - 1e-6 else "({:.2f}, {:.2f}, {:.2f})".format(*(np.round(axis, 2) + 0.0))


@dataclass(frozen=True)
class LimitResult:
    """One metric against its limit; the fields are the keys of its JSON object."""

    metric: str  #: its name, a key of MEANINGS
    of: str  #: what it is of
    limit_m: float  #: the limit, m
    value_m: float  #: what is compared with it, without its sign, m
    passed: bool  #: whether it is not above the limit
    certain: bool | None  #: whether all of the 95 % interval is on that side of the limit; None without an interval

    def text(self) -> str:
        """Return the outcome as it stands behind the metric's line."""
        unsure = "" if self.certain is not False else ", within the interval"
        return f"{'PASS' if self.passed else 'FAIL'} (limit {1e3 * self.limit_m:g} mm{unsure})"


def read_limits(texts: Iterable[str]) -> dict[str, float]:
    """Read NAME=LENGTH texts, such as AP=0.5mm: name of each metric -> limit, m; an InputError says what is wrong."""
    limits: dict[str, float] = {}
    for given in texts:
        name, _, length = given.partition("=")
        name = name.strip().replace("_", " ")
        if name not in MEANINGS:
            raise InputError(f"--limit {given}: unknown metric {name!r}; known are {', '.join(MEANINGS)}")
        if name in limits:
            raise InputError(f"--limit {given}: {name} has a limit already")
        match = re.fullmatch(r"\s*(\d+\.?\d*|\.\d+)\s*(m|mm|um|µm)\s*", length)
        if match is None or not float(match[1]) > 0:
            raise InputError(f"--limit {given}: expected NAME=LENGTH with a unit, such as {name}=0.5mm")
        limits[name] = float(match[1]) / _UNITS[match[2]]
    return limits


def check_limits(lines: Sequence[MetricLine], limits: Mapping[str, float]) -> list[LimitResult | None]:
    """Compare metrics with their limits; None where one has no limit."""
    known = list(dict.fromkeys(line.name for line in lines))
    for name in limits:
        if name not in known:
            raise InputError(f"--limit {name}: this test has no such metric; it has {', '.join(known)}")
    return [_compared(line, limits[line.name]) if line.name in limits else None for line in lines]


def value_m(metric: Metric) -> float:
    """Return the size of a metric, m: where it is not resolved the bound, where that is not known as measured."""
    bound = metric.raw if metric.low is None or metric.high is None else max(abs(metric.low), abs(metric.high))
    return abs(bound if metric.clean is None else metric.clean)


def _compared(line: MetricLine, limit_m: float) -> LimitResult:
    m, certain = line.metric, None
    if m.low is not None and m.high is not None:
        smallest = 0.0 if m.low <= 0 <= m.high else min(abs(m.low), abs(m.high))
        certain = max(abs(m.low), abs(m.high)) <= limit_m or smallest > limit_m
    value = value_m(m)
    return LimitResult(line.name, line.what, limit_m, value, value <= limit_m, certain)


def all_compared(outcomes: Iterable[LimitResult | None]) -> Fact:
    """Return how many passed; nothing where there are no limits."""
    compared = [outcome for outcome in outcomes if outcome is not None]
    if not compared:
        return Fact()
    failed = sum(not each.passed for each in compared)
    said = f"\n{'FAIL' if failed else 'PASS'}: {failed} of {len(compared)} metrics with a limit are above it"
    return Fact(said, {"limits": compared, "passed": not failed})
