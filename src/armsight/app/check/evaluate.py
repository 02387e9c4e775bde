"""Judge an arm from what it attained: sort the rows into the standard's tests and compute its figures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from armsight.app.check.rows import SAME_M, TESTS, Attained, Row, Turn, natural, read_rows
from armsight.app.check.run_folder import attained_in
from armsight.data import Array
from armsight.errors import InputError
from armsight.loop.iso9283 import poses as iso9283
from armsight.loop.iso9283.paths import circle_metrics, path_metrics, plane_axes
from armsight.loop.iso9283.statistic import Figure

#: So many poses tell something of the workspace where none was attained often enough to tell of itself.
_WIDE = 10
#: So many times must the first pose have been attained for its drift.
_DRIFTS = 10
#: Of so many rows and more one is told that lies so many times further from the middle than half of them: normal scatter
#: along a line, the longest there is, does so in one pose of 200 with ten rows, and in one of 30,000 with thirty. What is
#: usual is no less than tables are rounded to, m.
_SEVERAL, _STRAY, _LEAST_M = 10, 12.0, 1e-5


def read_check(path: Path, *, closed: bool = False) -> Attained:
    """Read what was attained, from a run's folder (or the check.csv in it) or from a CSV.

    Args:
        path: folder or file.
        closed: of a run, take the motions with the loop closed on vision.

    Raises:
        InputError: it cannot be read, or holds nothing that can be judged.
    """
    if path.is_dir() and not (path / "check.csv").exists():
        return attained_in(path, closed=closed)
    if closed:
        raise InputError(f"{path}: --closed goes with a run's folder; this is a table of attained poses")
    rows = read_rows(path / "check.csv" if path.is_dir() else path)
    unknown = not any(row.cov.any() for row in rows)
    return Attained(
        rows, ["no sigma_x_m .. are given: the instrument's noise is taken for none"] if unknown else [], []
    )


def judge(attained: Attained) -> dict[str, Any]:
    """Return all figures that the rows allow, SI units.

    Args:
        attained: the rows, and what was left out of them: that is told where nothing is left.

    Returns:
        poses (by name), anywhere (where each was attained too seldom), vAP_m, distance, drift, paths (by name), circle,
        notes.

    Raises:
        InputError: too few rows for any figure.
    """
    by_test = {test: [row for row in attained.rows if row.test == test] for test in TESTS}
    facts: dict[str, Any] = {}
    notes = list(attained.notes)
    seldom = _too_seldom(by_test["pose"])
    if by_test["pose"] and seldom is None:
        facts |= _poses(by_test["pose"], notes)
    if by_test["path"]:
        paths = _groups(by_test["path"], lambda row: row.approach or "path")
        facts["paths"] = {name: _path(name, group) for name, group in paths.items()}
    if by_test["circle"]:
        facts["circle"] = _circle(by_test["circle"], attained.turns)
    if not facts:
        raise InputError("; ".join(["nothing can be judged", *([seldom] if seldom else []), *notes]))
    notes += [f"left out: all poses, as none was attained {iso9283.LEAST} times"] if seldom else []
    return facts | {"notes": notes}


def _too_seldom(rows: list[Row]) -> str | None:
    """Say why there is neither a repeatability nor enough of the workspace; None where there is, or no pose at all."""
    counts = Counter(row.pose for row in rows).values()
    if not rows or max(counts) >= iso9283.LEAST or len(counts) >= _WIDE:
        return None
    return (
        f"{len(counts)} poses, none attained {iso9283.LEAST} times and more (the most: {max(counts)}), so there is no "
        f"repeatability: 30 times are the standard's, or {_WIDE} poses and more once (armsight check plan)"
    )


def _groups(rows: list[Row], key: Callable[[Row], str]) -> dict[str, list[Row]]:
    out: dict[str, list[Row]] = {}
    for row in rows:
        out.setdefault(key(row), []).append(row)
    return out


def _places(rows: list[Row]) -> Array:
    return np.array([row.T[:3, 3] for row in rows])


def _commands(rows: list[Row]) -> Array:
    return np.array([row.T_command[:3, 3] for row in rows])


def _off(rows: list[Row]) -> Array:
    return np.asarray(_places(rows) - _commands(rows))


def _common(rows: list[Row]) -> Array:
    return np.asarray(np.mean([row.cov_common for row in rows], axis=0))


def _covs(rows: list[Row]) -> Array:
    return np.array([row.cov for row in rows])


def _poses(rows: list[Row], notes: list[str]) -> dict[str, Any]:
    """Return the figures of poses; what is left out is added to the notes."""
    groups = _groups(rows, lambda row: row.pose)
    often = {name: groups[name] for name in sorted(groups, key=natural) if len(groups[name]) >= iso9283.LEAST}
    facts: dict[str, Any] = {}
    if not often:
        mean, largest = iso9283.anywhere(_off(rows), _covs(rows), _common(rows))
        facts["anywhere"] = {"count": len(rows), "mean_m": figure(mean), "max_m": figure(largest)}
        return facts
    notes += [
        f"left out: {name}, attained too seldom ({len(group)})" for name, group in groups.items() if name not in often
    ]
    notes += [told for group in often.values() for told in _strays(group)]
    facts["poses"] = {name: _pose(group) for name, group in often.items()}
    several = {name: _ways(group) for name, group in often.items()}
    facts |= {"vAP_m": known} if (known := {name: f for name, f in several.items() if f}) else {}
    names = list(often)
    if len(names) > 2:  # the standard's five: P2 and P4
        first, last = names[1], names[3] if len(names) > 3 else names[-1]
        distance = _distance(often[first], often[last])
        facts |= {"distance": {"from": first, "to": last, **distance}} if distance else {}
    timed = [row for row in often[names[0]] if row.t_s is not None]
    if len(timed) >= _DRIFTS:
        times, wander, largest = iso9283.drift(np.array([row.t_s for row in timed]), _places(timed))
        facts["drift"] = {"pose": names[0], "t_s": times.tolist(), "dAP_m": wander.tolist(), "max_m": figure(largest)}
    return facts


def _strays(rows: list[Row]) -> list[str]:
    """Name the rows of a pose that lie far from the others."""
    p = _places(rows)
    away = np.linalg.norm(p - np.median(p, axis=0), axis=1)
    usual = max(float(np.median(away)), _LEAST_M)
    return [
        f"{row.pose}, {f'cycle {row.cycle}' if row.cycle else f'row {n + 1} of it'}: {1e3 * off:.2f} mm from the middle of "
        f"them all, half of which are within {1e3 * usual:.2f} mm of it; it counts, unless you take it out"
        for n, (row, off) in enumerate(zip(rows, away, strict=True))
        if len(rows) >= _SEVERAL and off > _STRAY * usual
    ]


def _pose(rows: list[Row]) -> dict[str, Any]:
    """Return AP and RP of a pose; None for what asks for turns that are not known."""
    figures = iso9283.pose_metrics(np.array([r.T for r in rows]), rows[0].T_command, _covs(rows), _common(rows))
    turned = all(row.turned for row in rows)
    aimed = turned and all(row.commanded_rotation for row in rows)
    return {
        "count": figures.count,
        "AP_m": figure(figures.accuracy),
        "AP_xyz_m": figures.accuracy_xyz.tolist(),
        "AP_rotation_rad": figures.accuracy_rotation.tolist() if aimed else None,
        "RP_m": figure(figures.repeatability),
        "RP_rotation_rad": figures.repeatability_rotation.tolist() if turned else None,
    }


def _ways(rows: list[Row]) -> dict[str, float | None] | None:
    """Return vAP of a pose; None where it was come to often from one direction only."""
    ways = [way for way in _groups(rows, lambda row: row.approach).values() if len(way) > 1]
    return figure(iso9283.multi_directional([_places(way) for way in ways])) if len(ways) > 1 else None


def _distance(first: list[Row], last: list[Row]) -> dict[str, Any] | None:
    """Return AD and RD between two poses, in the cycles that have both."""
    there = {row.cycle: row for row in last}
    pairs = [(row, there[row.cycle]) for row in first if row.cycle and row.cycle in there]
    if len(pairs) < iso9283.LEAST:
        return None
    a, b = (_places([p[k] for p in pairs]) for k in (0, 1))
    commanded = float(np.linalg.norm((first[0].T_command - last[0].T_command)[:3, 3]))
    AD, RD = iso9283.distance_metrics(a, b, commanded, _covs([p[0] for p in pairs]))
    return {"commanded_m": commanded, "AD_m": figure(AD), "RD_m": figure(RD)}


def _path(name: str, rows: list[Row]) -> dict[str, Any]:
    """Return AT and RT of a path; every time along it has the stations of the first."""
    cycles = _groups(rows, lambda row: row.cycle)
    (first_cycle, first), *others = cycles.items()
    for cycle, group in others:
        same = [row.pose for row in group] == [row.pose for row in first]
        if not same or np.abs(_commands(group) - _commands(first)).max() > SAME_M:
            raise InputError(
                f"path {name}: every cycle must have the same stations, commanded to the same places and in the same "
                f"order; cycle {cycle or 'without a name'} ({len(group)} rows) differs from {first_cycle} ({len(first)})"
            )
    attained = np.array([_places(group) for group in cycles.values()])
    cov = np.array([_covs(group) for group in cycles.values()])
    try:
        figures = path_metrics(attained, _commands(first), cov, _common(rows))
    except InputError as error:
        raise InputError(f"path {name}: {error}") from None
    return {
        "count": len(attained),
        "AT_m": figure(figures.accuracy),
        "RT_m": figure(figures.repeatability),
        "off_m": figures.off.tolist(),
    }


def _circle(rows: list[Row], turns: list[Turn]) -> dict[str, Any]:
    ways = _groups(rows, lambda row: row.approach)
    if set(ways) != {"1", "-1"}:
        raise InputError(
            "circle: approach must be 1 for counter-clockwise and -1 for clockwise, and both must be there"
        )
    command = _commands(rows)
    axes = plane_axes(np.linalg.svd(command - command.mean(axis=0), full_matrices=False)[2][2])
    middle = (command.max(axis=0) + command.min(axis=0)) / 2
    flat = np.array([turn.p - middle for turn in turns]).reshape(-1, 3) @ axes.T
    at = (np.degrees(np.arctan2(flat[:, 1], flat[:, 0])) % 360).tolist()
    asked = [(angle, turn.way) for angle, turn in zip(at, turns, strict=True)]
    figures = circle_metrics(_places(ways["1"]), _places(ways["-1"]), axes, _covs(rows).mean(axis=0), asked)
    return {
        "centre_m": figures.centre.tolist(),
        "radius_m": figures.radius_m,
        "axes": axes.tolist(),
        "circularity_m": figure(figures.circularity),
        "hysteresis_m": figure(figures.hysteresis),
        "steps_m": figures.steps_m.tolist(),
        "backlash_m": [figure(f) for f in figures.backlash],
        "turns": [
            {"joints": list(turn.joints), "way": turn.way, "angle_deg": angle, "jump_m": figure(jump)}
            for turn, angle, jump in zip(turns, at, figures.jumps, strict=True)
        ],
        "angle_deg": figures.angle_deg.tolist(),
        "radii_m": figures.radii_m.tolist(),
    }


def figure(figure: Figure) -> dict[str, float | None]:
    """Return a figure as JSON has it."""
    return {**asdict(figure), "sigma": figure.sigma}
