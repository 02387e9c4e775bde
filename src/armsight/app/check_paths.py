"""Lines and circles of a run as rows for the judging: those run over the same ground several times, or both ways round."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np

from armsight.app.check.rows import Row, Turn
from armsight.app.check_stretch import Noise, Stretch, plain
from armsight.data import Array
from armsight.errors import InputError
from armsight.files import read_table
from armsight.geometry.pose import pose
from armsight.loop.iso9283.poses import LEAST
from armsight.loop.iso9283.paths import plane_axes

#: Paths that begin, pass and end nearer to each other are one, m.
_SAME_M = 1e-4
#: A path is judged at so many stations, seen in so many shots at least; a circle is one that goes all around, rad.
_STATIONS, _SHOTS, _ROUND = 40, 10, 2 * np.pi * 0.999
#: Between two shots further apart than so many stations nobody saw the path: the time round is left out.
_GAP = 2.5
_AHEAD_M = 1e-4
#: A joint turns back that moves by so much before and after, rad: less does not take up its backlash.
_MOVES_RAD = float(np.radians(0.5))
#: Joints that turn back within this share of the circle's time do so together.
_NEAR = 0.015


def path_rows(stretches: list[Stretch], noise: Noise) -> tuple[list[Row], set[str], list[Stretch], list[str]]:
    """Return rows of a run's paths and its circle, the motions they are of, the circle once each way, what was left out.

    Args:
        stretches: of the run.
        noise: the instrument.
    """
    paths = [s for s in stretches if s.kind in ("line", "circle")]
    seen = [s for s in paths if len(s.seen) >= _SHOTS]
    notes = [
        f"left out: {s.name}, seen in {len(s.seen)} shots; {_SHOTS} are needed" for s in paths if len(s.seen) < _SHOTS
    ]
    groups = _grouped(seen)
    circle, others = _both_ways(groups)
    notes += others
    rows: list[Row] = []
    run: set[str] = {s.name for group in circle for s in group}
    names: list[str] = []
    for group in groups:
        if group[0].name in run:
            continue
        names.append(short if (short := plain(group[0].name)) not in names else group[0].name)
        cycles, unseen = _path(names[-1], group, noise)
        notes += unseen
        if len(cycles) < LEAST:
            notes.append(f"left out: {names[-1]}, followed too seldom ({len(cycles)})")
            continue
        rows += [row for cycle in cycles for row in cycle]
        run |= {s.name for s in group}
    return rows + [row for group in circle for row in _circle(group, noise)], run, [g[0] for g in circle], notes


def _both_ways(groups: list[list[Stretch]]) -> tuple[list[list[Stretch]], list[str]]:
    """Return the two groups of the first circle that is run all around both ways; what is said of further ones."""
    whole = [g for g in groups if g[0].kind == "circle" and abs(_turned(g[0])[-1]) >= _ROUND]
    pairs = [
        (a, b)
        for a, b in combinations(whole, 2)
        if _turned(a[0])[-1] * _turned(b[0])[-1] < 0 and np.abs(_round(a[0]) - _round(b[0])).max() < _SAME_M
    ]
    if not pairs:
        return [], []
    circle = list(pairs[0])
    others = {g[0].name for pair in pairs[1:] for g in pair} - {g[0].name for g in circle}
    words = f"one circle run both ways is judged, {circle[0][0].name} and {circle[1][0].name}; also run were "
    return circle, [words + ", ".join(sorted(others))] if others else []


def _round(stretch: Stretch) -> Array:
    """Return what tells one whole circle from another (10,), m: centre, radius, and the axes of its plane that long."""
    p = stretch.wanted.Ts_base_tool[:, :3, 3]
    centre = (p.max(axis=0) + p.min(axis=0)) / 2
    radius = np.linalg.norm(p - centre, axis=1).mean()
    return np.concatenate([centre, [radius], radius * _axes(p).ravel()])


def _axes(p: Array) -> Array:
    """Return the axes (2, 3) of the plane of places (N, 3)."""
    return plane_axes(np.linalg.svd(p - p.mean(axis=0), full_matrices=False)[2][2])


def _grouped(paths: list[Stretch]) -> list[list[Stretch]]:
    """Put those together that run over the same ground."""
    groups: list[list[Stretch]] = []
    for stretch in paths:
        same = (g for g in groups if g[0].kind == stretch.kind and np.abs(_ends(g[0]) - _ends(stretch)).max() < _SAME_M)
        found = next(same, None)
        if found is None:
            groups.append([stretch])
        else:
            found.append(stretch)
    return groups


def _ends(stretch: Stretch) -> Array:
    """Return the first, a middle and the last commanded place (3, 3)."""
    p = stretch.wanted.Ts_base_tool[:, :3, 3]
    return p[[0, len(p) // 3, -1]]


def _path(name: str, group: list[Stretch], noise: Noise) -> tuple[list[list[Row]], list[str]]:
    """Return a path's rows, time by time, and what is left out: the times of which a part was not seen.

    There is a row for every station of the command: where the attained path crosses the plane square to it.
    """
    p = group[0].wanted.Ts_base_tool[:, :3, 3]
    gone = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])
    keep = np.concatenate([[True], np.diff(gone) > 0])
    p, gone, since = p[keep], gone[keep], group[0].wanted.t_s[keep] - group[0].wanted.t_s[0]
    stations = np.linspace(0.0, gone[-1], _STATIONS + 2)[1:-1]
    cycles, notes = [], []
    for cycle, stretch in enumerate(group, start=1):
        s = np.interp(stretch.seen.t_s - stretch.wanted.t_s[0], since, gone)
        s, off = _off(p, gone, stretch.seen.Ts_base_tool[:, :3, 3], s)
        if unseen := _unseen(s, stations):
            notes.append(f"left out: {stretch.name}, {unseen}")
            continue
        at = np.clip(np.searchsorted(s, stations), 1, len(s) - 1)
        share = (stations - s[at - 1]) / (s[at] - s[at - 1])
        between = off[at - 1] + share[:, None] * (off[at] - off[at - 1])
        weight, own = (1 - share) ** 2 + share**2, noise.moving(stretch)
        rows = []
        for k, place in enumerate(_on(p, gone, stations)):
            T, T_command = pose(np.eye(3), place + between[k]), pose(np.eye(3), place)
            rows.append(Row("path", str(k + 1), str(cycle), name, None, T, T_command, weight[k] * own, noise.common))
        cycles.append(rows)
    return cycles, notes


def _unseen(s: Array, stations: Array) -> str:
    """Say which part of a path nobody saw, of how far along it was seen (N,) and its stations (S,), m; nothing if none."""
    step = float(stations[1] - stations[0])
    if len(s) < 2 or s[0] > stations[0] or s[-1] < stations[-1]:
        return "not seen from its first station to its last"
    widest = float(np.diff(s).max())
    if widest > _GAP * step:
        return f"not seen over {1e3 * widest:.1f} mm; {1e3 * _GAP * step:.1f} mm are the most: slower, or in view"
    return ""


def _on(p: Array, gone: Array, s: Array) -> Array:
    """Return places (N, 3) on a path (M, 3) so far along it."""
    return np.stack([np.interp(s, gone, p[:, i]) for i in range(3)], axis=1)


def _off(p: Array, gone: Array, was: Array, s: Array) -> tuple[Array, Array]:
    """Return how far along a path places (N, 3) are, rising, and their offset from it (N, 3); s is about how far."""
    for _ in range(4):  # to the foot on the path: when the tool was there does not count
        ahead = _on(p, gone, s + _AHEAD_M) - _on(p, gone, s - _AHEAD_M)
        ahead /= np.maximum(np.linalg.norm(ahead, axis=1), 1e-12)[:, None]
        s = np.clip(s + ((was - _on(p, gone, s)) * ahead).sum(axis=1), 0.0, gone[-1])
    s, first = np.unique(s, return_index=True)
    return s, was[first] - _on(p, gone, s)


def _turned(stretch: Stretch) -> Array:
    """Return how far a circle was to have turned (N,), rad, counter-clockwise."""
    p = stretch.wanted.Ts_base_tool[:, :3, 3]
    flat = (p - (p.max(axis=0) + p.min(axis=0)) / 2) @ _axes(p).T
    angle = np.unwrap(np.arctan2(flat[:, 1], flat[:, 0]))
    return np.asarray(angle - angle[0])


def _circle(group: list[Stretch], noise: Noise) -> list[Row]:
    """Return a circle's rows: the middle turn of each time round, without its start and end."""
    rows = []
    for cycle, stretch in enumerate(group, start=1):
        turned = _turned(stretch)
        there = np.interp(stretch.seen.t_s, stretch.wanted.t_s, turned)
        way, own = "1" if turned[-1] > 0 else "-1", noise.moving(stretch)
        for k in np.flatnonzero(np.abs(there - turned[-1] / 2) <= np.pi):
            T = stretch.wanted.at(stretch.seen.t_s[k : k + 1])[0]
            t_s = float(stretch.seen.t_s[k])
            attained = stretch.seen.Ts_base_tool[k]
            rows.append(
                Row("circle", f"{np.degrees(there[k]):.2f}", str(cycle), way, t_s, attained, T, own, noise.common)
            )
    return rows


def turns_of(folder: Path, circle: list[Stretch]) -> list[Turn]:
    """Return where joints were to turn back on a circle, by a run's joints.csv; none where it has none.

    Args:
        folder: of the run.
        circle: the circle once each way.
    """
    file = folder / "joints.csv"
    if not circle or not file.is_file():
        return []
    names = ["t_s", *(f"q{joint}_wanted_rad" for joint in range(1, 7))]
    table = read_table(file)
    try:
        at = [table[0].index(name) for name in names]
        values = np.array([[float(row[k]) for k in at] for row in table[1:]])
    except (ValueError, IndexError):
        raise InputError(f"{file}: not a run's joints: {', '.join(names)} are needed, numbers in every line") from None
    turns = []
    for stretch in circle:
        turned = _turned(stretch)
        rows = values[(values[:, 0] > stretch.wanted.t_s[0]) & (values[:, 0] < stretch.wanted.t_s[-1])]
        for t_s, joints in _together(rows):
            here = float(np.interp(t_s, stretch.wanted.t_s, turned)) - turned[-1] / 2
            if abs(here) <= np.pi:
                turns.append(Turn(joints, float(np.sign(turned[-1])), stretch.wanted.at(np.array([t_s]))[0, :3, 3]))
    return turns


def _together(rows: Array) -> list[tuple[float, tuple[int, ...]]]:
    """Return when joints turn back, s, and which, of times and angles (N, 1 + 6); those at about the same time are one."""
    each = sorted((t_s, joint) for joint in range(1, 7) for t_s in _turn_times(rows[:, 0], rows[:, joint]))
    near = _NEAR * float(np.ptp(rows[:, 0])) if len(rows) else 0.0
    found: list[tuple[float, tuple[int, ...]]] = []
    for t_s, joint in each:
        if found and t_s - found[-1][0] < near:
            found[-1] = (found[-1][0], (*found[-1][1], joint))
        else:
            found.append((t_s, (joint,)))
    return found


def _turn_times(t_s: Array, q: Array) -> list[float]:
    """Return when a joint turns back that moves by enough before and after it, s, of times and angles (N,), rad.

    Where it stands in between, as it does between equal readings, it turns back in the middle of that.
    """
    if not len(q):
        return []
    steps = np.diff(q)
    moves = np.flatnonzero(steps)
    turns = np.flatnonzero(np.diff(np.sign(steps[moves])))
    ends = [0, *((moves[turns] + 1 + moves[turns + 1]) // 2).tolist(), len(q) - 1]
    enough = np.abs(np.diff(q[ends])) > _MOVES_RAD
    return [float(at) for at in t_s[ends[1:-1]][enough[:-1] & enough[1:]]]
