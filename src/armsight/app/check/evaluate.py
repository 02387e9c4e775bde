"""Evaluate an arm from the poses it attained: sort the rows into the standard's tests and compute the metrics of each."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from armsight.app.check import DRIFT_CYCLES
from armsight.app.check.result import CheckResult, CircleResult, DistanceResult, DriftResult, Jump, WorkspaceResult
from armsight.app.check.rows import SAME_M, TESTS, Attained, Reversal, Row, first_few, read_rows
from armsight.app.check.run_folder import attained_in
from armsight.data import Array
from armsight.errors import InputError, naming
from armsight.files import natural_key
from armsight.loop.iso9283 import poses as iso9283
from armsight.loop.iso9283.paths import PathMetrics, circle_metrics, path_metrics, plane_axes
from armsight.loop.iso9283.statistic import Metric

#: An outlier is further from the median position than so many median distances; smaller names more rows.
_OUTLIER_RATIO = 12.0
#: Rows of a pose that is searched for outliers; half: the median of few names good rows, double: few tests are searched.
_OUTLIER_ROWS = 10
#: m; the median distance counts as this at least: rows that agree to the last digit make no other an outlier; half: one
#: off by 0.06 mm is named, double: one off by 0.2 mm is not.
_OUTLIER_LEAST_M = 1e-5
#: Poses that give errors over the workspace without a repeatability; half: a corner passes for it, double: few tests do.
_WIDE_POSES = 10


def read_check(path: Path, *, closed: bool = False, columns: str | None = None) -> Attained:
    """Read what was attained, from a run's folder (or the check.csv in it) or from a CSV."""
    if path.is_dir() and not (path / "check.csv").exists():
        if columns is not None:
            raise InputError(f"{path}: --columns goes with a table of attained poses; this is a run's folder")
        return attained_in(path, closed=closed)
    if closed and path.exists():
        raise InputError(f"{path}: --closed goes with a run's folder; this is a table of attained poses")
    rows = read_rows(path / "check.csv" if path.is_dir() else path, columns)
    unknown = not any(row.cov.any() for row in rows)
    return Attained(rows, ["no sigma_x_m .. is given: the instrument's noise is taken for none"] if unknown else [], [])


def evaluate(attained: Attained) -> CheckResult:
    """Return all metrics that the rows allow, SI units."""
    by_test = {test: [row for row in attained.rows if row.test == test] for test in TESTS}
    rows, few = by_test["pose"], iso9283.MIN_POSES
    often, said = _often(rows)
    seldom, workspace = ("", None) if often or not rows else _seldom(rows)
    paths = _groups(by_test["path"], lambda row: row.approach or "path")
    followed = {name: _path(name, group) for name, group in paths.items()}
    poses, notes = {name: _pose(group) for name, group in often.items()}, [*attained.notes, *said]
    circle = _circle(by_test["circle"], attained.reversals) if by_test["circle"] else None
    if not (poses or workspace or followed or circle):
        reasons = [*filter(None, (seldom, *notes))] or ["no motion was attained"]
        reason = "; ".join(reasons[:2] + ([f"{len(reasons) - 2} more left out"] if len(reasons) > 2 else []))
        raise InputError(f"nothing can be evaluated: {reason}; run motions that repeat (armsight check plan)")
    notes += [f"left out: all poses, as none was attained {few} times"] if seldom else []
    ways = _several_ways(often)
    return CheckResult(poses, ways, workspace, _distance(often), _drift(often), followed, circle, notes)


def _seldom(rows: list[Row]) -> tuple[str, WorkspaceResult | None]:
    """Return why rows of which none repeats are too few, or what many poses say of the workspace."""
    counts = Counter(row.pose for row in rows)
    if len(counts) < _WIDE_POSES:
        most, few = max(counts.values()), iso9283.MIN_POSES
        return f"of {len(counts)} poses none was attained {few} times, the most {most}: no repeatability", None
    p, p_ref, cov, common = _stacked(rows)
    return "", WorkspaceResult(len(rows), *iso9283.anywhere(p - p_ref, cov, common))


def _often(rows: list[Row]) -> tuple[dict[str, list[Row]], list[str]]:
    """Return the rows of each pose that was attained often enough, and what is said of the others and of outliers."""
    groups = _groups(rows, lambda row: row.pose)
    often = {name: groups[name] for name in sorted(groups, key=natural_key) if len(groups[name]) >= iso9283.MIN_POSES}
    rare = [f"left out: {name}, attained too seldom ({len(groups[name])})" for name in groups if name not in often]
    said = first_few(rare, "poses, attained too seldom") if often else []
    return often, said + [note for group in often.values() for note in _outliers(group)]


class _Stacked(NamedTuple):
    """Positions (N, 3) and their commands, m, covariances (N, 3, 3) by the instrument and their common one, m^2."""

    p: Array
    p_ref: Array
    cov: Array
    common: Array


def _stacked(rows: Sequence[Row]) -> _Stacked:
    p, p_ref = (np.array([T[:3, 3] for T in Ts]) for Ts in ([row.T for row in rows], [row.T_command for row in rows]))
    return _Stacked(p, p_ref, np.array([row.cov for row in rows]), np.mean([row.cov_common for row in rows], axis=0))


def _groups(rows: list[Row], key: Callable[[Row], str]) -> dict[str, list[Row]]:
    out: dict[str, list[Row]] = {}
    for row in rows:
        out.setdefault(key(row), []).append(row)
    return out


def _several_ways(often: dict[str, list[Row]]) -> dict[str, Metric]:
    by_way = {name: _groups(rows, lambda row: row.approach).values() for name, rows in often.items()}
    ways = {name: [_stacked(way).p for way in each if len(way) > 1] for name, each in by_way.items()}
    return {name: iso9283.multi_directional(each) for name, each in ways.items() if len(each) > 1}


def _drift(often: dict[str, list[Row]]) -> DriftResult | None:
    """Return the drift of the first pose; None where too few of its rows have a time."""
    name, rows = next(iter(often.items()), ("", []))
    timed = [row for row in rows if row.t_s is not None]
    if len(timed) < DRIFT_CYCLES:
        return None
    return DriftResult(name, *iso9283.drift(np.array([row.t_s for row in timed]), _stacked(timed).p))


def _outliers(rows: list[Row]) -> list[str]:
    p = _stacked(rows).p
    away = np.linalg.norm(p - np.median(p, axis=0), axis=1)
    usual = max(float(np.median(away)), _OUTLIER_LEAST_M)
    return [
        f"{row.pose}, {f'cycle {row.cycle}' if row.cycle else f'row {n + 1} of it'}: {1e3 * off:.2f} mm from the middle of "
        f"them all, half of which are within {1e3 * usual:.2f} mm of it; it counts, unless you take it out"
        for n, (row, off) in enumerate(zip(rows, away, strict=True))
        if len(rows) >= _OUTLIER_ROWS and off > _OUTLIER_RATIO * usual
    ]


def _pose(rows: list[Row]) -> iso9283.PoseMetrics:
    ways, at = [row.approach for row in rows], _stacked(rows)
    if min(Counter(ways).values()) < iso9283.MIN_POSES:  # of a table whose approaches are too many for a scatter
        ways = [""] * len(rows)
    _, way = np.unique(ways, return_inverse=True)
    found = iso9283.pose_metrics(np.array([row.T for row in rows]), rows[0].T_command, at.cov, at.common, way)
    measured = all(row.measured_rotation for row in rows)
    commanded = measured and all(row.commanded_rotation for row in rows)
    AP, RP = found.AP_rotation_rad if commanded else None, found.RP_rotation_rad if measured else None
    return replace(found, AP_rotation_rad=AP, RP_rotation_rad=RP)


def _distance(often: dict[str, list[Row]]) -> DistanceResult | None:
    if len(often) <= 2:
        return None
    (first, rows), *_, (last, last_rows) = list(often.items())[1:4]
    there = {row.cycle: row for row in last_rows}
    pairs = [(row, there[row.cycle]) for row in rows if row.cycle and row.cycle in there]
    if len(pairs) < iso9283.MIN_POSES:
        return None
    a, b = (_stacked(each) for each in zip(*pairs, strict=True))
    commanded = float(np.linalg.norm((rows[0].T_command - last_rows[0].T_command)[:3, 3]))
    return DistanceResult(first, last, commanded, *iso9283.distance_metrics(a.p, b.p, commanded, a.cov))


def _path(name: str, rows: list[Row]) -> PathMetrics:
    """Return AT and RT of a path; every cycle along it has the path points of the first."""
    cycles = _groups(rows, lambda row: row.cycle)
    each, (first_cycle, first) = {cycle: _stacked(group) for cycle, group in cycles.items()}, next(iter(cycles.items()))
    p_ref = each[first_cycle].p_ref
    for cycle, group in cycles.items():
        same = [row.pose for row in group] == [row.pose for row in first]
        if not same or np.abs(each[cycle].p_ref - p_ref).max() > SAME_M:
            which = f"cycle {cycle or 'without a name'} ({len(group)} rows) differs from {first_cycle} ({len(first)})"
            raise InputError(f"path {name}: every cycle must have the same path points, commands and sequence; {which}")
    attained, cov = np.array([c.p for c in each.values()]), np.array([c.cov for c in each.values()])
    with naming(f"path {name}"):
        return path_metrics(attained, p_ref, cov, _stacked(rows).common)


def _circle(rows: list[Row], reversals: list[Reversal]) -> CircleResult:
    ways = _groups(rows, lambda row: row.approach)
    if set(ways) != {"1", "-1"}:
        raise InputError("circle: approach must be 1 counter-clockwise and -1 clockwise, and both must be there")
    _, p_ref, cov, _ = _stacked(rows)
    axes = plane_axes(np.linalg.svd(p_ref - p_ref.mean(axis=0), full_matrices=False)[2][2])
    middle = (p_ref.max(axis=0) + p_ref.min(axis=0)) / 2
    flat = np.array([reversal.p - middle for reversal in reversals]).reshape(-1, 3) @ axes.T
    at = (np.degrees(np.arctan2(flat[:, 1], flat[:, 0])) % 360).tolist()
    asked = [(angle, reversal.way) for angle, reversal in zip(at, reversals, strict=True)]
    metrics = circle_metrics(_stacked(ways["1"]).p, _stacked(ways["-1"]).p, axes, cov.mean(axis=0), asked)
    jumps = zip(reversals, at, metrics.jumps_m, strict=True)
    return CircleResult(axes, metrics, [Jump(each.joints, each.way, angle, jump) for each, angle, jump in jumps])
