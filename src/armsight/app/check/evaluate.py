"""Evaluate an arm from the poses it attained: sort the rows into the standard's tests and compute the metrics of each."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from armsight.app.check import DRIFT_CYCLES
from armsight.app.check.result import (
    CheckResult,
    CircleResult,
    DistanceResult,
    DriftResult,
    JumpResult,
    WorkspaceResult,
)
from armsight.app.check.rows import SAME_M, TESTS, Attained, Reversal, Row, first_few, natural, read_rows
from armsight.app.check.run_folder import attained_in
from armsight.data import Array
from armsight.errors import InputError
from armsight.loop.iso9283 import poses as iso9283
from armsight.loop.iso9283.paths import PathMetrics, circle_metrics, path_metrics, plane_axes
from armsight.loop.iso9283.statistic import Metric

#: Where no pose was attained often enough for a repeatability: this many poses and more give errors over the workspace.
_WIDE = 10
#: A pose attained fewer times than this is not searched for outliers.
_OUTLIER_ROWS = 10
#: A row is named an outlier where its distance from the median position is more than this many times the median distance.
#: Smaller names more rows. Normal scatter along a line, the longest-tailed case, does so in one pose of 200 with ten rows,
#: in one of 30,000 with thirty.
_OUTLIER_RATIO = 12.0
#: The median distance counts as this much at least, m: tables are rounded to about that, and rows that agree to the last
#: digit would make every other row an outlier.
_OUTLIER_LEAST_M = 1e-5


def read_check(path: Path, *, closed: bool = False, columns: str | None = None) -> Attained:
    """Read what was attained, from a run's folder (or the check.csv in it) or from a CSV.

    Args:
        path: folder or file.
        closed: of a run, take the motions with the loop closed on vision.
        columns: of a CSV, what its columns are called, as the option --columns has it.

    Raises:
        InputError: it cannot be read, or holds nothing that can be evaluated.
    """
    if path.is_dir() and not (path / "check.csv").exists():
        if columns is not None:
            raise InputError(f"{path}: --columns goes with a table of attained poses; this is a run's folder")
        return attained_in(path, closed=closed)
    if closed:
        raise InputError(f"{path}: --closed goes with a run's folder; this is a table of attained poses")
    rows = read_rows(path / "check.csv" if path.is_dir() else path, columns)
    unknown = not any(row.cov.any() for row in rows)
    return Attained(
        rows, ["no sigma_x_m .. are given: the instrument's noise is taken for none"] if unknown else [], []
    )


def evaluate(attained: Attained) -> CheckResult:
    """Return all metrics that the rows allow, SI units.

    Args:
        attained: the rows, and what was left out of them: the error message says so where nothing is left.

    Raises:
        InputError: too few rows for any metric.
    """
    by_test = {test: [row for row in attained.rows if row.test == test] for test in TESTS}
    rows = by_test["pose"]
    seldom = _too_seldom(rows)
    often, said = ({}, []) if seldom else _often(rows)
    poses = {name: _pose(group) for name, group in often.items()}
    workspace = _workspace(rows) if rows and not often and not seldom else None
    paths = _groups(by_test["path"], lambda row: row.approach or "path")
    followed = {name: _path(name, group) for name, group in paths.items()}
    circle = _circle(by_test["circle"], attained.reversals) if by_test["circle"] else None
    notes = [*attained.notes, *said]
    if not (poses or workspace or followed or circle):
        raise InputError("; ".join(["nothing can be evaluated", *([seldom] if seldom else []), *notes]))
    notes += [f"left out: all poses, as none was attained {iso9283.MIN_POSES} times"] if seldom else []
    distance, drift = _distance(often), _drift_of_first(often)
    return CheckResult(poses, _several_ways(often), workspace, distance, drift, followed, circle, notes)


def _often(rows: list[Row]) -> tuple[dict[str, list[Row]], list[str]]:
    """Return the rows of each pose that was attained often enough, and what is said of the others and of outliers."""
    groups = _groups(rows, lambda row: row.pose)
    often = {name: groups[name] for name in sorted(groups, key=natural) if len(groups[name]) >= iso9283.MIN_POSES}
    rare = [f"left out: {n}, attained too seldom ({len(group)})" for n, group in groups.items() if n not in often]
    said = first_few(rare, "poses, attained too seldom") if often else []
    return often, said + [note for group in often.values() for note in _outliers(group)]


def _several_ways(often: dict[str, list[Row]]) -> dict[str, Metric]:
    """Return vAP of each pose that was approached repeatedly from more than one direction."""
    by_way = {name: _groups(rows, lambda row: row.approach).values() for name, rows in often.items()}
    ways = {name: [way for way in each if len(way) > 1] for name, each in by_way.items()}
    return {n: iso9283.multi_directional([_positions(w) for w in each]) for n, each in ways.items() if len(each) > 1}


def _too_seldom(rows: list[Row]) -> str | None:
    """Return why there is neither a repeatability nor enough of the workspace; None where there is, or no pose at all."""
    counts = Counter(row.pose for row in rows).values()
    if not rows or max(counts) >= iso9283.MIN_POSES or len(counts) >= _WIDE:
        return None
    return (
        f"{len(counts)} poses, none attained {iso9283.MIN_POSES} times and more (the most: {max(counts)}), so there is no "
        f"repeatability: 30 times are the standard's, or {_WIDE} poses and more once (armsight check plan)"
    )


def _groups(rows: list[Row], key: Callable[[Row], str]) -> dict[str, list[Row]]:
    out: dict[str, list[Row]] = {}
    for row in rows:
        out.setdefault(key(row), []).append(row)
    return out


def _positions(rows: list[Row]) -> Array:
    return np.array([row.T[:3, 3] for row in rows])


def _commands(rows: list[Row]) -> Array:
    return np.array([row.T_command[:3, 3] for row in rows])


def _common(rows: list[Row]) -> Array:
    return np.asarray(np.mean([row.cov_common for row in rows], axis=0))


def _covs(rows: list[Row]) -> Array:
    return np.array([row.cov for row in rows])


def _workspace(rows: list[Row]) -> WorkspaceResult:
    """Return the errors over the workspace."""
    mean, largest = iso9283.anywhere(_positions(rows) - _commands(rows), _covs(rows), _common(rows))
    return WorkspaceResult(len(rows), mean, largest)


def _drift_of_first(often: dict[str, list[Row]]) -> DriftResult | None:
    """Return the drift of the first pose; None where too few of its rows have a time."""
    if not often:
        return None
    name, rows = next(iter(often.items()))
    timed = [row for row in rows if row.t_s is not None]
    if len(timed) < DRIFT_CYCLES:
        return None
    times, wander, largest = iso9283.drift(np.array([row.t_s for row in timed]), _positions(timed))
    return DriftResult(name, times, wander, largest)


def _outliers(rows: list[Row]) -> list[str]:
    """Name the rows of a pose that lie far from the others."""
    p = _positions(rows)
    away = np.linalg.norm(p - np.median(p, axis=0), axis=1)
    usual = max(float(np.median(away)), _OUTLIER_LEAST_M)
    return [
        f"{row.pose}, {f'cycle {row.cycle}' if row.cycle else f'row {n + 1} of it'}: {1e3 * off:.2f} mm from the middle of "
        f"them all, half of which are within {1e3 * usual:.2f} mm of it; it counts, unless you take it out"
        for n, (row, off) in enumerate(zip(rows, away, strict=True))
        if len(rows) >= _OUTLIER_ROWS and off > _OUTLIER_RATIO * usual
    ]


def _pose(rows: list[Row]) -> iso9283.PoseMetrics:
    """Return the metrics of a pose; None for what needs rotations that are not known."""
    ways = [row.approach for row in rows]
    if min(Counter(ways).values()) < iso9283.MIN_POSES:  # of a table whose approaches are too many for a scatter
        ways = [""] * len(rows)
    _, way = np.unique(ways, return_inverse=True)
    T = np.array([row.T for row in rows])
    metrics = iso9283.pose_metrics(T, rows[0].T_command, _covs(rows), _common(rows), way)
    measured = all(row.measured_rotation for row in rows)
    commanded = measured and all(row.commanded_rotation for row in rows)
    return replace(
        metrics,
        AP_rotation_rad=metrics.AP_rotation_rad if commanded else None,
        RP_rotation_rad=metrics.RP_rotation_rad if measured else None,
    )


def _distance(often: dict[str, list[Row]]) -> DistanceResult | None:
    """Return AD and RD from the second pose to the fourth, the standard's P2 and P4, in the cycles that have both."""
    if len(often) <= 2:
        return None
    (first, rows), *_, (last, last_rows) = list(often.items())[1:4]
    there = {row.cycle: row for row in last_rows}
    pairs = [(row, there[row.cycle]) for row in rows if row.cycle and row.cycle in there]
    if len(pairs) < iso9283.MIN_POSES:
        return None
    a, b = (_positions([p[k] for p in pairs]) for k in (0, 1))
    commanded = float(np.linalg.norm((rows[0].T_command - last_rows[0].T_command)[:3, 3]))
    AD, RD = iso9283.distance_metrics(a, b, commanded, _covs([p[0] for p in pairs]))
    return DistanceResult(first, last, commanded, AD, RD)


def _path(name: str, rows: list[Row]) -> PathMetrics:
    """Return AT and RT of a path; every cycle along it has the path points of the first."""
    cycles = _groups(rows, lambda row: row.cycle)
    (first_cycle, first), *others = cycles.items()
    for cycle, group in others:
        same = [row.pose for row in group] == [row.pose for row in first]
        if not same or np.abs(_commands(group) - _commands(first)).max() > SAME_M:
            raise InputError(
                f"path {name}: every cycle must have the same path points, with the same commanded positions, in the same "
                f"sequence; cycle {cycle or 'without a name'} ({len(group)} rows) differs from {first_cycle} ({len(first)})"
            )
    attained = np.array([_positions(group) for group in cycles.values()])
    cov = np.array([_covs(group) for group in cycles.values()])
    try:
        return path_metrics(attained, _commands(first), cov, _common(rows))
    except InputError as error:
        raise InputError(f"path {name}: {error}") from None


def _circle(rows: list[Row], reversals: list[Reversal]) -> CircleResult:
    ways = _groups(rows, lambda row: row.approach)
    if set(ways) != {"1", "-1"}:
        raise InputError(
            "circle: approach must be 1 for counter-clockwise and -1 for clockwise, and both must be there"
        )
    command = _commands(rows)
    axes = plane_axes(np.linalg.svd(command - command.mean(axis=0), full_matrices=False)[2][2])
    middle = (command.max(axis=0) + command.min(axis=0)) / 2
    flat = np.array([reversal.p - middle for reversal in reversals]).reshape(-1, 3) @ axes.T
    at = (np.degrees(np.arctan2(flat[:, 1], flat[:, 0])) % 360).tolist()
    asked = [(angle, reversal.way) for angle, reversal in zip(at, reversals, strict=True)]
    metrics = circle_metrics(_positions(ways["1"]), _positions(ways["-1"]), axes, _covs(rows).mean(axis=0), asked)
    jumps = [
        JumpResult(reversal.joints, reversal.way, angle, jump)
        for reversal, angle, jump in zip(reversals, at, metrics.jumps_m, strict=True)
    ]
    return CircleResult(axes, metrics, jumps)
