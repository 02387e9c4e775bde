"""Judge an arm from a CSV of attained poses: read, sort into the standard's tests, compute, say it in words.

Columns: test (pose, path or circle), pose (its name; at a path or circle the station), cycle, x_m, y_m, z_m, qw, qx, qy, qz
attained in the base; command_x_m .. command_qz commanded; sigma_x_m, sigma_y_m, sigma_z_m of the instrument; t_s and
approach where they are known. Angles of a circle count from x towards y of the base unless the commands say otherwise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from armsight.data import Array
from armsight.errors import InputError
from armsight.files import read_table
from armsight.geometry.pose import pose
from armsight.geometry.rotation import from_quaternion_wxyz
from armsight.loop import iso9283
from armsight.loop.iso9283 import Figure
from armsight.loop.iso9283_path import circle_figures, path_figures

TESTS = ("pose", "path", "circle")
_PLACE, _TURN = ("x_m", "y_m", "z_m"), ("qw", "qx", "qy", "qz")
_TEXTS = ("test", "pose", "cycle", "approach")


@dataclass(frozen=True)
class Row:
    """One attained pose of a file."""

    line: int
    test: str
    pose: str
    cycle: str
    approach: str
    numbers: dict[str, float]

    def T(self, prefix: str = "") -> Array:
        """Return the attained pose, or with the prefix "command_" the commanded one."""
        n = self.numbers
        q = np.array([n.get(prefix + name, float(name == "qw")) for name in _TURN])
        if not 0.999 < np.linalg.norm(q) < 1.001:
            raise InputError(
                f"line {self.line}: quaternion {prefix}qw .. {prefix}qz has length {np.linalg.norm(q):.4g}, not 1"
            )
        return pose(from_quaternion_wxyz(q), np.array([n[prefix + name] for name in _PLACE]))

    def cov(self) -> Array:
        """Return the instrument's covariance (3, 3) of the place."""
        return np.diag([self.numbers.get(f"sigma_{name}", 0.0) ** 2 for name in _PLACE])


def read_check(path: Path) -> list[Row]:
    """Read a file, or check.csv of a run folder.

    Raises:
        InputError: unreadable, a column missing, or a cell that is no number; the message names the line.
    """
    file = path / "check.csv" if path.is_dir() else path
    table = read_table(file)
    if not table:
        raise InputError(f"{file}: empty; a first line of column names is needed")
    header = [name.strip() for name in table[0]]
    needed = ("pose", *_PLACE, *(f"command_{name}" for name in _PLACE))
    missing = [name for name in needed if name not in header]
    if missing:
        raise InputError(f"{file}: line 1: column {missing[0]} is missing; needed are {', '.join(needed)}")
    rows = []
    for line, cells in enumerate(table[1:], start=2):
        if any(cell.strip() for cell in cells):
            rows.append(_row(file, line, dict(zip(header, (cell.strip() for cell in cells), strict=False))))
    if not rows:
        raise InputError(f"{file}: no rows; one line an attained pose is needed")
    return rows


def _row(file: Path, line: int, cells: dict[str, str]) -> Row:
    texts = {name: cells.get(name, "") for name in _TEXTS}
    test = texts["test"] or "pose"
    if test not in TESTS:
        raise InputError(f"{file}: line {line}: test is {test!r}; known are {', '.join(TESTS)}")
    numbers = {}
    for name, cell in cells.items():
        if name in _TEXTS or not cell:
            continue
        try:
            numbers[name] = float(cell)
        except ValueError:
            raise InputError(f"{file}: line {line}: {name} is {cell!r}, must be a number") from None
        if not np.isfinite(numbers[name]):
            raise InputError(f"{file}: line {line}: {name} is {cell}, must be a finite number")
    for name in (*_PLACE, *(f"command_{name}" for name in _PLACE)):
        if name not in numbers:
            raise InputError(f"{file}: line {line}: {name} is empty")
    return Row(line, test, texts["pose"], texts["cycle"], texts["approach"], numbers)


def judge(rows: list[Row]) -> dict[str, Any]:
    """Return all figures that the rows allow, SI units: poses, multi_directional, distance, drift, path, circle."""
    by_test = {test: [row for row in rows if row.test == test] for test in TESTS}
    facts: dict[str, Any] = {}
    if by_test["pose"]:
        facts |= _poses(by_test["pose"])
    if by_test["path"]:
        facts["path"] = _path(by_test["path"])
    if by_test["circle"]:
        facts["circle"] = _circle(by_test["circle"])
    return facts


def _groups(rows: list[Row], key: Callable[[Row], str]) -> dict[str, list[Row]]:
    out: dict[str, list[Row]] = {}
    for row in rows:
        out.setdefault(key(row), []).append(row)
    return out


def _places(rows: list[Row]) -> Array:
    return np.array([row.T()[:3, 3] for row in rows])


def _poses(rows: list[Row]) -> dict[str, Any]:
    facts: dict[str, Any] = {"poses": {}}
    groups = _groups(rows, lambda row: row.pose)
    several = {}
    for name, group in groups.items():
        figures = iso9283.pose_figures(
            np.array([row.T() for row in group]), group[0].T("command_"), np.array([row.cov() for row in group])
        )
        facts["poses"][name] = {
            "count": figures.count,
            "AP_m": _figure(figures.accuracy),
            "AP_xyz_m": figures.accuracy_xyz.tolist(),
            "AP_turn_rad": figures.accuracy_turn.tolist(),
            "RP_m": _figure(figures.repeatability),
            "RP_turn_rad": figures.repeatability_turn.tolist(),
        }
        ways = _groups([row for row in group if row.approach], lambda row: row.approach)
        if len(ways) > 1:
            several[name] = _figure(iso9283.multi_directional([_places(way) for way in ways.values()]))
    if several:
        facts["vAP_m"] = several
    names = list(groups)
    distance = _distance(groups[names[1]], groups[names[-1]]) if len(names) > 2 else None
    if distance:
        facts["distance"] = {"from": names[1], "to": names[-1], **distance}
    timed = [row for row in groups[names[0]] if "t_s" in row.numbers]
    if len(timed) >= 10:
        times, wander = iso9283.drift(np.array([row.numbers["t_s"] for row in timed]), _places(timed))
        facts["drift"] = {"pose": names[0], "t_s": times.tolist(), "dAP_m": wander.tolist()}
    return facts


def _distance(first: list[Row], last: list[Row]) -> dict[str, Any] | None:
    """Return AD and RD between two poses, in the cycles that have both."""
    there = {row.cycle: row for row in last}
    pairs = [(row, there[row.cycle]) for row in first if row.cycle and row.cycle in there]
    if len(pairs) < iso9283.LEAST:
        return None
    a, b = _places([p[0] for p in pairs]), _places([p[1] for p in pairs])
    commanded = float(np.linalg.norm(first[0].T("command_")[:3, 3] - last[0].T("command_")[:3, 3]))
    AD, RD = iso9283.distance_figures(a, b, commanded, np.array([p[0].cov() for p in pairs]))
    return {"commanded_m": commanded, "AD_m": _figure(AD), "RD_m": _figure(RD)}


def _path(rows: list[Row]) -> dict[str, Any]:
    cycles = _groups(rows, lambda row: row.cycle)
    lengths = {len(group) for group in cycles.values()}
    if len(lengths) != 1:
        raise InputError(
            f"path: every cycle must have the same stations; there are {', '.join(map(str, sorted(lengths)))}"
        )
    attained = np.array([_places(group) for group in cycles.values()])
    cov = np.array([[row.cov() for row in group] for group in cycles.values()])
    command = np.array([row.T("command_")[:3, 3] for row in next(iter(cycles.values()))])
    figures = path_figures(attained, command, cov)
    return {"AT_m": figures.accuracy, "RT_m": _figure(figures.repeatability), "off_m": figures.off.tolist()}


def _circle(rows: list[Row]) -> dict[str, Any]:
    ways = _groups(rows, lambda row: row.approach)
    if set(ways) != {"1", "-1"}:
        raise InputError(
            "circle: approach must be 1 for counter-clockwise and -1 for clockwise, and both must be there"
        )
    axes = np.eye(3)[:2]
    figures = circle_figures(_places(ways["1"]), _places(ways["-1"]), axes)
    return {
        "centre_m": figures.centre.tolist(),
        "radius_m": figures.radius_m,
        "circularity_m": figures.circularity_m,
        "hysteresis_m": figures.hysteresis_m,
        "backlash_m": figures.backlash_m.tolist(),
        "sigma_backlash_m": figures.sigma_backlash_m,
    }


def _figure(figure: Figure) -> dict[str, float | None]:
    return asdict(figure)


def figure_text(figure: dict[str, float | None]) -> str:
    """Return a figure as a person reads it, mm."""
    raw, clean, sigma, least = (figure[key] for key in ("raw", "clean", "sigma", "resolvable"))
    if clean is None:
        least_mm = 1e3 * (least or 0)
        return f"{1e3 * (raw or 0):.3f} mm as measured: not resolvable, the instrument could tell {least_mm:.3f} mm"
    return f"{1e3 * clean:.3f} +- {1e3 * (sigma or 0):.3f} mm ({1e3 * (raw or 0):.3f} with the instrument's noise)"


def text(facts: dict[str, Any]) -> str:
    """Return all figures in words."""
    lines = []
    for name, p in facts.get("poses", {}).items():
        lines.append(f"{name} ({p['count']} times)")
        lines.append(f"  accuracy AP       {figure_text(p['AP_m'])}")
        lines.append(f"  repeatability RP  {figure_text(p['RP_m'])}")
        if name in facts.get("vAP_m", {}):
            lines.append(f"  directions vAP    {figure_text(facts['vAP_m'][name])}")
    if "distance" in facts:
        d = facts["distance"]
        lines.append(f"distance {d['from']} to {d['to']}, {1e3 * d['commanded_m']:.1f} mm")
        lines += [f"  accuracy AD       {figure_text(d['AD_m'])}", f"  repeatability RD  {figure_text(d['RD_m'])}"]
    if "drift" in facts:
        lines.append(f"drift of {facts['drift']['pose']}: {1e3 * max(facts['drift']['dAP_m']):.3f} mm largest")
    if "path" in facts:
        lines.append(f"path accuracy AT {1e3 * facts['path']['AT_m']:.3f} mm")
        lines.append(f"path repeatability RT {figure_text(facts['path']['RT_m'])}")
    if "circle" in facts:
        c = facts["circle"]
        lines.append(f"circle of radius {1e3 * c['radius_m']:.3f} mm: circularity {1e3 * c['circularity_m']:.3f} mm")
        play = " and ".join(f"{1e3 * b:.3f}" for b in c["backlash_m"])
        lines.append(f"  play along x and y {play} mm, +- {1e3 * c['sigma_backlash_m']:.3f}")
    return "\n".join(lines)
