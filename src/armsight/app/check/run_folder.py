"""What a run's folder says about a test: where vision saw the tool at each commanded pose and along each path.

In: wanted.csv (where the tool was to be), vision.csv, motion.toml. Out: rows for the judging. A rest belongs to the pose
that was commanded there, wherever else in the motion that pose comes again; a line or circle to those over the same ground.

A run's folder cut into its motions and rests: what was commanded in each, what vision saw, and how noisy that is.

The instrument's noise is half the mean square of the steps from one shot of a rest to the next: a slower motion of the arm
is not in it, a faster one is, so it is rather too large. What vision.csv claims beyond it is common to all shots.

Lines and circles of a run as rows for the judging: those run over the same ground several times, or both ways round.
"""

from __future__ import annotations

import re
import tomllib
from collections import Counter
from dataclasses import dataclass
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from armsight.app.check.rows import SAME_M, Attained, Row, Turn, natural
from armsight.app.run.record import ToolTrack, read_track
from armsight.data import Array
from armsight.errors import InputError
from armsight.files import read_table, read_text
from armsight.geometry.pose import mean_pose, pose
from armsight.loop.iso9283.paths import plane_axes
from armsight.loop.iso9283.poses import LEAST

#: An arm that stands is judged by the end of its rest, s.
WINDOW_S = 0.3
_SIGMAS = ("sigma_x_m", "sigma_y_m", "sigma_z_m")


@dataclass(frozen=True)
class Stretch:
    """A motion, or the rest at its end.

    Attributes:
        name: of the motion.
        kind: joints, home, line, circle; rest.
        wanted: where the tool was to be.
        seen: where vision saw it.
        sigma: (N, 3) what vision claims, m.
    """

    name: str
    kind: str
    wanted: ToolTrack
    seen: ToolTrack
    sigma: Array


@dataclass(frozen=True)
class Noise:
    """The instrument.

    Attributes:
        own: (3, 3) covariance of one shot of an arm at rest, base's axes, m^2.
        common: (3, 3) that of the error that all shots share.
        claimed: (3,) variances that vision claims at rest, all in.
    """

    own: Array
    common: Array
    claimed: Array

    def moving(self, stretch: Stretch) -> Array:
        """Return the covariance (3, 3) of one shot in a motion: vision claims more there, as both eyes are not at one."""
        return self.own + np.diag(np.maximum((stretch.sigma**2).mean(axis=0) - self.claimed, 0.0))


def segments_of(folder: Path, closed: bool) -> list[Stretch]:
    """Cut a run into its motions and rests of one pass, in their order."""
    for name in ("wanted.csv", "vision.csv", "motion.toml"):
        if not (folder / name).is_file():
            raise InputError(f"{folder}: is no run, {name} is missing: give a folder of armsight run or demo, or a CSV")
    wanted, _ = read_track(folder / "wanted.csv", ())
    seen, sigma = read_track(folder / "vision.csv", _SIGMAS)
    kinds = _kinds(folder / "motion.toml")
    named = np.char.add(np.char.add(wanted.phase, "/"), wanted.motion)
    ends = [0, *(np.flatnonzero(named[1:] != named[:-1]) + 1).tolist(), len(named)]
    found, now = [], "calibration"
    for first, last in pairwise(ends):
        phase, name = str(wanted.phase[first]), str(wanted.motion[first])
        now = now if phase == "rest" else phase
        if now != ("closed_loop" if closed else "open_loop"):
            continue
        part = wanted[np.arange(first, last)]
        rows = (seen.t_s > part.t_s[0]) & (seen.t_s <= part.t_s[-1])
        kind = "rest" if phase == "rest" else kinds.get(name, "joints")
        found.append(Stretch(name, kind, part, seen[rows], sigma[rows]))
    return found


def _kinds(file: Path) -> dict[str, str]:
    """Return the kind of every motion of a motion file by its name."""
    try:
        entries: Any = tomllib.loads(read_text(file)).get("motion", [])
        return {str(e.get("name", f"{e['kind']} {n}")): str(e["kind"]) for n, e in enumerate(entries, start=1)}
    except (tomllib.TOMLDecodeError, AttributeError, KeyError, TypeError):
        raise InputError(f"{file}: not a motion file (docs/run.md)") from None


def stood(stretch: Stretch) -> tuple[Array, Array]:
    """Return poses (n, 4, 4) and sigmas (n, 3) of the shots at the end of a rest."""
    rows = stretch.seen.t_s > stretch.wanted.t_s[-1] - WINDOW_S
    return stretch.seen.Ts_base_tool[rows], stretch.sigma[rows]


def noise_of(stretches: list[Stretch]) -> Noise:
    """Return the instrument's noise as the rests show it."""
    steps, sigmas = [np.zeros((0, 3))], [np.zeros((0, 3))]
    for stretch in stretches:
        if stretch.kind == "rest":
            Ts, sigma = stood(stretch)
            steps.append(np.diff(Ts[:, :3, 3], axis=0))
            sigmas.append(sigma)
    d, sigma = np.concatenate(steps), np.concatenate(sigmas)
    if len(d) < LEAST:
        raise InputError("the arm was hardly seen at rest: rests of half a second in view of both cameras are needed")
    own = d.T @ d / (2 * len(d))
    claimed = (sigma**2).mean(axis=0)
    return Noise(own, np.diag(np.maximum(claimed - np.diag(own), 0.0)), claimed)


def plain(name: str) -> str:
    """Return the name of a motion without its cycle."""
    return re.sub(r" cycle \d+$", "", name)


#: Paths that begin, pass and end nearer to each other are one, m.
_SAME_M = 1e-4
#: A path is judged at so many stations, seen in so many shots at least; a circle is one that goes all around, rad.
_STATIONS, _PATH_SHOTS, _ROUND = 40, 10, 2 * np.pi * 0.999
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
    seen = [s for s in paths if len(s.seen) >= _PATH_SHOTS]
    notes = [
        f"left out: {s.name}, seen in {len(s.seen)} shots; {_SHOTS} are needed"
        for s in paths
        if len(s.seen) < _PATH_SHOTS
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


#: A rest is judged that was seen in so many shots.
_SHOTS = 3


def attained_in(folder: Path, *, closed: bool) -> Attained:
    """Return what a run attained.

    Args:
        folder: of the run.
        closed: take the motions with the loop closed on vision instead of those with potentiometers alone.

    Raises:
        InputError: no run, or none of its motions comes again.
    """
    stretches = segments_of(folder, closed)
    if not stretches:
        which = "with the loop closed" if closed else "with potentiometers alone"
        raise InputError(f"{folder}: the run has no motions {which}; run.log says how far it came")
    noise = noise_of(stretches)
    paths, run, circle, notes = path_rows(stretches, noise)
    rows, more = _rests([s for s in stretches if s.kind == "rest"], run, noise)
    return Attained(rows + paths, more + notes, turns_of(folder, circle))


def _rests(stretches: list[Stretch], run: set[str], noise: Noise) -> tuple[list[Row], list[str]]:
    """Return a row for every rest at a pose, but those at the ends of paths that are judged, and what was left out."""
    names: list[tuple[Array, str]] = []
    visits: dict[tuple[str, str], list[Row]] = {}
    times: Counter[str] = Counter()
    before, unseen = "the start", 0
    for stretch in stretches:
        T = stretch.wanted.Ts_base_tool[-1]
        name = next((n for at, n in names if np.abs(at - T).max() < SAME_M), None)
        if stretch.name in run:
            before = name or plain(stretch.name)
            continue
        if name is None:
            short = plain(stretch.name).removeprefix("to ")
            name = short if all(short != n for _, n in names) else stretch.name
            names.append((T, name))
        way = (name, before)
        times[name] += 1
        Ts, _ = stood(stretch)
        if len(Ts) >= _SHOTS:
            t_s = float(stretch.wanted.t_s[-1])
            seen = Row("pose", name, str(times[name]), before, t_s, mean_pose(Ts), T, noise.own / len(Ts), noise.common)
            visits.setdefault(way, []).append(seen)
        unseen += len(Ts) < _SHOTS
        before = name
    notes = [f"{unseen} rests were not seen, and are left out"] if unseen else []
    often = any(len(came) >= LEAST for came in visits.values())
    attained: Counter[str] = Counter()
    for (name, _), came in visits.items():
        attained[name] += len(came)
    rows = []
    for (name, before), came in visits.items():
        if often and len(came) < LEAST <= attained[name]:
            notes.append(f"left out: {name} come to from {before}, too seldom ({len(came)})")
        else:
            rows += came
    return sorted(rows, key=lambda row: (natural(row.pose), row.t_s)), notes
