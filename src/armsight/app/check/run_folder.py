"""A run's folder to the rows of a test: where vision saw the tool at each commanded pose and along each path.

In: reference.csv (where the tool was commanded to be), vision.csv, motion.toml, and joints.csv where it exists. Out: rows
for the evaluation. The run is cut into segments: its motions, and the rest at the end of each.

- A rest belongs to the pose that was commanded there, wherever else in the motion that pose comes again, and to the visits
  whose joints came from the same sides: on the other side of a joint's backlash it is another approach.
- A line or circle belongs with those along the same commanded path; of a circle, both directions are needed.
- The instrument's noise is half the mean square of the steps from one shot of a rest to the next: slower motion of the arm
  is not in it, faster motion is, so it is an upper estimate. What vision.csv claims beyond it is common to all shots.

From top to bottom: reading and segments, noise, rests, paths, circle, joint reversals.
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from armsight.app.check.rows import SAME_M, Attained, Reversal, Row, first_few, natural
from armsight.app.run.tracks import ToolTrack, read_track
from armsight.data import Array, Record
from armsight.errors import InputError
from armsight.files import read_toml
from armsight.geometry.pose import mean_pose, pose
from armsight.loop.iso9283.paths import plane_axes
from armsight.loop.iso9283.poses import MIN_POSES
from armsight.robot.kinematics.table import MOST_JOINTS
from armsight.tables.columns import Columns

#: A rest is evaluated over its last part, this long, s: longer averages more shots, and more of the settling.
WINDOW_S = 0.3
#: A rest is evaluated that was seen in this many shots.
_REST_SHOTS = 3
#: Paths whose first, middle and last positions are this near to each other are one path, m.
_SAME_M = 1e-4
#: Path points at which a path is evaluated.
_PATH_POINTS = 40
#: A path is evaluated that was seen in this many shots.
_PATH_SHOTS = 10
#: A circle is whole from this angle on, rad.
_WHOLE_RAD = 2 * np.pi * 0.999
#: Between two shots further apart than this many path points the path was not seen: the cycle is left out.
_GAP = 2.5
#: Half of the length over which a path's direction is taken, m.
_AHEAD_M = 1e-4
#: A joint reverses where it moves by this much before and after, rad: less does not take up its backlash.
_MOVES_RAD = float(np.radians(0.5))
#: Joints that reverse within this share of the circle's time do so together.
_NEAR = 0.015
#: From here on a joint was elsewhere, rad: what it was off by less does not take up its backlash.
_AWAY_RAD = float(np.radians(0.3))
#: Columns of joints.csv in version 1 of a run's folder -> their present names; both are read.
_VERSION_1 = {f"q{joint}_wanted_rad": f"q{joint}_ref_rad" for joint in range(1, MOST_JOINTS + 1)}
_SIGMAS = ("sigma_x_m", "sigma_y_m", "sigma_z_m")


@dataclass(frozen=True)
class PathSegment:
    """A motion, or the rest at its end.

    Attributes:
        name: of the motion.
        kind: joints, home, line, circle; rest.
        reference: commanded poses of the tool.
        seen: poses of the tool that vision measured.
        sigma: (N, 3) what vision claims, m.
    """

    name: str
    kind: str
    reference: ToolTrack
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

    def moving(self, segment: PathSegment) -> Array:
        """Return the covariance (3, 3) of one shot in a motion: vision claims more there, as the cameras expose apart."""
        return self.own + np.diag(np.maximum((segment.sigma**2).mean(axis=0) - self.claimed, 0.0))


@dataclass(frozen=True, eq=False)
class JointTrack(Record):
    """Readings and commands of the joints.

    Attributes:
        t_s: (N,) board's clock, s.
        q: (N, n) readings, rad; NaN where the file has commands alone.
        q_ref: (N, n) commands, rad.
    """

    t_s: Array
    q: Array
    q_ref: Array

    def sides(self, t_s: float) -> Array:
        """Return how each joint came to its command at a time, s (n,): 1 with rising angle, -1 with falling, 0 unmoved."""
        q = self.q_ref[: max(int(np.searchsorted(self.t_s, t_s, side="right")), 1)]
        away = np.abs(q - q[-1]) > _AWAY_RAD
        last = len(q) - 1 - np.argmax(away[::-1], axis=0)
        return np.where(away.any(axis=0), np.sign(q[-1] - q[last, np.arange(q.shape[1])]), 0.0)


def joint_track(folder: Path, joints: int | None = None) -> JointTrack:
    """Read joints.csv of a run.

    Args:
        folder: of the run.
        joints: how many the arm has, whose readings are needed; None: as many as there are.

    Raises:
        InputError: missing, not a run's, or of an arm of another number of joints.
    """
    file = folder / "joints.csv"
    table = Columns.of_csv(file)
    table.at = {_VERSION_1.get(name, name): k for name, k in table.at.items()}
    count = joints or sum(re.fullmatch(r"q\d+_ref_rad", name) is not None for name in table.at) or 6
    names = ["t_s", *(f"q{i + 1}_ref_rad" for i in range(count)), *(f"q{i + 1}_rad" for i in range(count))]
    if joints is not None and (set(names) - set(table.at) or f"q{joints + 1}_rad" in table.at):
        raise InputError(f"{file}: is not of an arm of {joints} joints: give the arm of the run with --arm")
    needed = names if set(names) <= set(table.at) else names[: count + 1]
    values = table.numbers(needed, gaps=True)  # nothing is commanded before the first motion
    if not len(values):
        raise InputError(f"{file}: no readings")
    q_ref = values[:, 1 : count + 1]
    return JointTrack(values[:, 0], values[:, count + 1 :] if needed is names else np.full_like(q_ref, np.nan), q_ref)


def attained_in(folder: Path, *, closed: bool) -> Attained:
    """Return what a run attained.

    Args:
        folder: of the run.
        closed: take the motions with the loop closed on vision instead of those with potentiometers alone.

    Raises:
        InputError: no run, or no motion of it is repeated.
    """
    segments = segments_of(folder, closed)
    if not segments:
        which = "with the loop closed" if closed else "with the joint sensors alone"
        raise InputError(f"{folder}: the run has no motions {which}; run.log says how far it came")
    noise = noise_of(segments)
    paths, run, circle, notes = path_rows(segments, noise)
    track = joint_track(folder) if (folder / "joints.csv").is_file() else None
    rows, more = _rests(segments, run, noise, track)
    return Attained(rows + paths, more + notes, [] if track is None else reversals_of(track, circle))


def is_run(folder: Path) -> bool:
    """Return whether a folder holds a run."""
    return _reference_file(folder).is_file()


def _reference_file(folder: Path) -> Path:
    """Return the file of the commanded poses: by its present name, unless the folder has it by that of version 1 alone."""
    file, old = (folder / name for name in ("reference.csv", "wanted.csv"))
    return old if old.is_file() and not file.is_file() else file


def segments_of(folder: Path, closed: bool) -> list[PathSegment]:
    """Cut a run into its motions and rests, by time: those with the loop closed, or those without.

    Raises:
        InputError: no run's folder, or a file of it cannot be read.
    """
    file = _reference_file(folder)
    for name in (file.name, "vision.csv", "motion.toml"):
        if not (folder / name).is_file():
            if (folder / "summary.json").is_file():
                raise InputError(f"{folder}: {name} is missing: the run ended before its motions; run it to the end")
            raise InputError(f"{folder}: is no run, {name} is missing: give a folder of armsight run or demo, or a CSV")
    reference, _ = read_track(file, ())
    seen, sigma = read_track(folder / "vision.csv", _SIGMAS)
    kinds = _kinds(folder / "motion.toml")
    named = np.char.add(np.char.add(reference.phase, "/"), reference.motion)
    ends = [0, *(np.flatnonzero(named[1:] != named[:-1]) + 1).tolist(), len(named)]
    found, now = [], "calibration"
    for first, last in pairwise(ends):
        phase, name = str(reference.phase[first]), str(reference.motion[first])
        now = now if phase == "rest" else phase
        if now != ("closed_loop" if closed else "open_loop"):
            continue
        part = reference[np.arange(first, last)]
        rows = (seen.t_s > part.t_s[0]) & (seen.t_s <= part.t_s[-1])
        kind = "rest" if phase == "rest" else kinds.get(name, "joints")
        found.append(PathSegment(name, kind, part, seen[rows], sigma[rows]))
    return found


def _kinds(file: Path) -> dict[str, str]:
    """Return the kind of every motion of a motion file by its name."""
    try:
        entries: Any = read_toml(file).get("motion", [])
        return {str(e.get("name", f"{e['kind']} {n}")): str(e["kind"]) for n, e in enumerate(entries, start=1)}
    except (AttributeError, KeyError, TypeError):
        raise InputError(f"{file}: not a motion file (docs/howto/motions.md)") from None


def plain(name: str) -> str:
    """Return the name of a motion without its cycle."""
    return re.sub(r" cycle \d+$", "", name)


def noise_of(segments: list[PathSegment]) -> Noise:
    """Return the instrument's noise as the rests show it."""
    steps, sigmas = [np.zeros((0, 3))], [np.zeros((0, 3))]
    for segment in segments:
        if segment.kind == "rest":
            Ts, sigma = at_rest(segment)
            steps.append(np.diff(Ts[:, :3, 3], axis=0))
            sigmas.append(sigma)
    d, sigma = np.concatenate(steps), np.concatenate(sigmas)
    if len(d) < MIN_POSES:
        raise InputError("the arm was hardly seen at rest: rests of half a second in view of both cameras are needed")
    own = d.T @ d / (2 * len(d))
    claimed = (sigma**2).mean(axis=0)
    return Noise(own, np.diag(np.maximum(claimed - np.diag(own), 0.0)), claimed)


def at_rest(segment: PathSegment) -> tuple[Array, Array]:
    """Return poses (n, 4, 4) and sigmas (n, 3) of the shots at the end of a rest."""
    rows = segment.seen.t_s > segment.reference.t_s[-1] - WINDOW_S
    return segment.seen.Ts_base_tool[rows], segment.sigma[rows]


def _rests(
    segments: list[PathSegment], run: set[str], noise: Noise, track: JointTrack | None
) -> tuple[list[Row], list[str]]:
    """Return a row for every rest at a pose, but those at the ends of paths that are evaluated, and what was left out."""
    names = _pose_names(segments, run)
    visits: dict[tuple[str, str], list[Row]] = {}
    times: Counter[str] = Counter()
    before, here, unseen = "the start", "the start", 0
    for segment in segments:
        if segment.kind != "rest":
            before, here = here, plain(segment.name)
            continue
        T, t_s = segment.reference.Ts_base_tool[-1], float(segment.reference.t_s[-1])
        name = next((n for at, n in names if np.abs(at - T).max() < SAME_M), None)
        here = name or here
        if segment.name in run or name is None:
            continue
        # Where commands of the joints are not known, where the last motion began says from which side they came.
        came = before
        if track is not None and t_s >= track.t_s[0]:
            came = "sides " + "".join("-0+"[int(side) + 1] for side in track.sides(t_s))
        times[name] += 1
        Ts, _ = at_rest(segment)
        if len(Ts) >= _REST_SHOTS:
            seen = Row("pose", name, str(times[name]), came, t_s, mean_pose(Ts), T, noise.own / len(Ts), noise.common)
            visits.setdefault((name, came), []).append(seen)
        unseen += len(Ts) < _REST_SHOTS
    notes = [f"{unseen} rests were not seen, and are left out"] if unseen else []
    often = any(len(came) >= MIN_POSES for came in visits.values())
    attained: Counter[str] = Counter()
    for (name, _), group in visits.items():
        attained[name] += len(group)
    rows, rare = [], []
    for (name, came), group in visits.items():
        if often and len(group) < MIN_POSES <= attained[name]:
            rare.append(f"left out: {name} approached from {came}, too seldom ({len(group)})")
        else:
            rows += group
    notes += first_few(rare, "approaches, too seldom")
    return sorted(rows, key=lambda row: (natural(row.pose), row.t_s)), notes


def _pose_names(segments: list[PathSegment], run: set[str]) -> list[tuple[Array, str]]:
    """Return every pose at which the arm rested, (4, 4), with a name of its own: that by which it was commanded most."""
    found: list[tuple[Array, Counter[str]]] = []
    for segment in segments:
        if segment.kind == "rest" and segment.name not in run:
            T = segment.reference.Ts_base_tool[-1]
            called = next((each for at, each in found if np.abs(at - T).max() < SAME_M), None)
            if called is None:
                found.append((T, called := Counter()))
            called[plain(segment.name).removeprefix("to ")] += 1
    names: dict[str, Array] = {}
    for T, called in found:
        name = called.most_common(1)[0][0]
        names[name if name not in names else f"{name} ({len(names) + 1})"] = T
    return [(T, name) for name, T in names.items()]


def path_rows(segments: list[PathSegment], noise: Noise) -> tuple[list[Row], set[str], list[PathSegment], list[str]]:
    """Return the rows of a run's paths and of its circle.

    Args:
        segments: of the run.
        noise: the instrument.

    Returns:
        The rows; the names of the motions that they are of; one segment of the circle in each direction; notes on what was
        left out.
    """
    paths = [s for s in segments if s.kind in ("line", "circle")]
    seen = [s for s in paths if len(s.seen) >= _PATH_SHOTS]
    notes = [
        f"left out: {s.name}, seen in {len(s.seen)} shots; {_PATH_SHOTS} are needed"
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
        if len(cycles) < MIN_POSES:
            notes.append(f"left out: {names[-1]}, followed too seldom ({len(cycles)})")
            continue
        rows += [row for cycle in cycles for row in cycle]
        run |= {s.name for s in group}
    return rows + [row for group in circle for row in _circle(group, noise)], run, [g[0] for g in circle], notes


def _grouped(paths: list[PathSegment]) -> list[list[PathSegment]]:
    """Group segments that have the same commanded path."""
    groups: list[list[PathSegment]] = []
    for segment in paths:
        same = (g for g in groups if g[0].kind == segment.kind and np.abs(_ends(g[0]) - _ends(segment)).max() < _SAME_M)
        found = next(same, None)
        if found is None:
            groups.append([segment])
        else:
            found.append(segment)
    return groups


def _ends(segment: PathSegment) -> Array:
    """Return the first, a middle and the last commanded position (3, 3)."""
    p = segment.reference.Ts_base_tool[:, :3, 3]
    return p[[0, len(p) // 3, -1]]


def _path(name: str, group: list[PathSegment], noise: Noise) -> tuple[list[list[Row]], list[str]]:
    """Return a path's rows, cycle by cycle, and what is left out: the cycles of which a part was not seen.

    There is a row for every path point of the command: where the attained path crosses the plane square to it.
    """
    p = group[0].reference.Ts_base_tool[:, :3, 3]
    gone = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])
    keep = np.concatenate([[True], np.diff(gone) > 0])
    p, gone, since = p[keep], gone[keep], group[0].reference.t_s[keep] - group[0].reference.t_s[0]
    points = np.linspace(0.0, gone[-1], _PATH_POINTS + 2)[1:-1]
    cycles, notes = [], []
    for cycle, segment in enumerate(group, start=1):
        s = np.interp(segment.seen.t_s - segment.reference.t_s[0], since, gone)
        s, off = _off(p, gone, segment.seen.Ts_base_tool[:, :3, 3], s)
        if unseen := _unseen(s, points):
            notes.append(f"left out: {segment.name}, {unseen}")
            continue
        at = np.clip(np.searchsorted(s, points), 1, len(s) - 1)
        share = (points - s[at - 1]) / (s[at] - s[at - 1])
        between = off[at - 1] + share[:, None] * (off[at] - off[at - 1])
        factor, own = (1 - share) ** 2 + share**2, noise.moving(segment)
        rows = []
        for k, p_base in enumerate(_on(p, gone, points)):
            T, T_command = pose(np.eye(3), p_base + between[k]), pose(np.eye(3), p_base)
            rows.append(Row("path", str(k + 1), str(cycle), name, None, T, T_command, factor[k] * own, noise.common))
        cycles.append(rows)
    return cycles, notes


def _unseen(s: Array, points: Array) -> str:
    """Say which part of a path was not seen; an empty string where all of it was.

    Args:
        s: (N,) arc lengths at which the path was seen, m, rising.
        points: (S,) arc lengths of the path points, m.
    """
    step = float(points[1] - points[0])
    if len(s) < 2 or s[0] > points[0] or s[-1] < points[-1]:
        return "not seen from its first path point to its last"
    widest = float(np.diff(s).max())
    if widest > _GAP * step:
        return f"not seen over {1e3 * widest:.1f} mm; {1e3 * _GAP * step:.1f} mm are the most: slower, or in view"
    return ""


def _on(p: Array, gone: Array, s: Array) -> Array:
    """Return positions (N, 3) on a path p (M, 3), of arc lengths gone (M,), at arc lengths s (N,), m."""
    return np.stack([np.interp(s, gone, p[:, i]) for i in range(3)], axis=1)


def _off(p: Array, gone: Array, was: Array, s: Array) -> tuple[Array, Array]:
    """Project attained positions onto a path.

    Args:
        p: (M, 3) the commanded path, m.
        gone: (M,) its arc lengths, m.
        was: (N, 3) attained positions, m.
        s: (N,) first guesses of their arc lengths, m.

    Returns:
        Arc lengths (N,), rising, and offsets from the path (N, 3), m.
    """
    for _ in range(4):  # to the foot of the perpendicular: the time of the shot has no effect
        ahead = _on(p, gone, s + _AHEAD_M) - _on(p, gone, s - _AHEAD_M)
        ahead /= np.maximum(np.linalg.norm(ahead, axis=1), 1e-12)[:, None]
        s = np.clip(s + ((was - _on(p, gone, s)) * ahead).sum(axis=1), 0.0, gone[-1])
    s, first = np.unique(s, return_index=True)
    return s, was[first] - _on(p, gone, s)


def _both_ways(groups: list[list[PathSegment]]) -> tuple[list[list[PathSegment]], list[str]]:
    """Return the two groups of the first circle that is run all around both ways; what is said of further ones."""
    whole = [g for g in groups if g[0].kind == "circle" and abs(_angle_of(g[0])[-1]) >= _WHOLE_RAD]
    pairs = [
        (a, b)
        for a, b in combinations(whole, 2)
        if _angle_of(a[0])[-1] * _angle_of(b[0])[-1] < 0 and np.abs(_round(a[0]) - _round(b[0])).max() < _SAME_M
    ]
    if not pairs:
        return [], []
    circle = list(pairs[0])
    others = {g[0].name for pair in pairs[1:] for g in pair} - {g[0].name for g in circle}
    note = f"one circle run both ways is evaluated, {circle[0][0].name} and {circle[1][0].name}; also run were "
    return circle, [note + ", ".join(sorted(others))] if others else []


def _round(segment: PathSegment) -> Array:
    """Return what distinguishes one whole circle from another (10,), m: centre, radius, plane axes times radius."""
    p = segment.reference.Ts_base_tool[:, :3, 3]
    centre = (p.max(axis=0) + p.min(axis=0)) / 2
    radius = np.linalg.norm(p - centre, axis=1).mean()
    return np.concatenate([centre, [radius], radius * _axes(p).ravel()])


def _axes(p: Array) -> Array:
    """Return the axes (2, 3) of the plane of positions (N, 3)."""
    return plane_axes(np.linalg.svd(p - p.mean(axis=0), full_matrices=False)[2][2])


def _angle_of(segment: PathSegment) -> Array:
    """Return the commanded angle of a circle since its start (N,), rad, counter-clockwise."""
    p = segment.reference.Ts_base_tool[:, :3, 3]
    flat = (p - (p.max(axis=0) + p.min(axis=0)) / 2) @ _axes(p).T
    angle = np.unwrap(np.arctan2(flat[:, 1], flat[:, 0]))
    return np.asarray(angle - angle[0])


def _circle(group: list[PathSegment], noise: Noise) -> list[Row]:
    """Return a circle's rows: the middle revolution of each cycle, without its start and end."""
    rows = []
    for cycle, segment in enumerate(group, start=1):
        angle = _angle_of(segment)
        there = np.interp(segment.seen.t_s, segment.reference.t_s, angle)
        way, own = "1" if angle[-1] > 0 else "-1", noise.moving(segment)
        for k in np.flatnonzero(np.abs(there - angle[-1] / 2) <= np.pi):
            T = segment.reference.at(segment.seen.t_s[k : k + 1])[0]
            t_s = float(segment.seen.t_s[k])
            attained = segment.seen.Ts_base_tool[k]
            rows.append(
                Row("circle", f"{np.degrees(there[k]):.2f}", str(cycle), way, t_s, attained, T, own, noise.common)
            )
    return rows


def reversals_of(track: JointTrack, circle: list[PathSegment]) -> list[Reversal]:
    """Return where joints were commanded to reverse on a circle.

    Args:
        track: commands of the joints.
        circle: the circle, one cycle of each direction.
    """
    values = np.column_stack([track.t_s, track.q_ref])
    reversals = []
    for segment in circle:
        angle = _angle_of(segment)
        rows = values[(values[:, 0] > segment.reference.t_s[0]) & (values[:, 0] < segment.reference.t_s[-1])]
        for t_s, reversed_joints in _together(rows):
            here = float(np.interp(t_s, segment.reference.t_s, angle)) - angle[-1] / 2
            if abs(here) <= np.pi:
                reversals.append(
                    Reversal(
                        reversed_joints, float(np.sign(angle[-1])), segment.reference.at(np.array([t_s]))[0, :3, 3]
                    )
                )
    return reversals


def _together(rows: Array) -> list[tuple[float, tuple[int, ...]]]:
    """Return (time, joints) of every reversal, s; joints that reverse at about the same time are one.

    ``rows``: (N, n + 1) times, s, and commanded joint angles, rad.
    """
    each = sorted(
        (t_s, joint) for joint in range(1, rows.shape[1]) for t_s in _reversal_times(rows[:, 0], rows[:, joint])
    )
    near = _NEAR * float(np.ptp(rows[:, 0])) if len(rows) else 0.0
    found: list[tuple[float, tuple[int, ...]]] = []
    for t_s, joint in each:
        if found and t_s - found[-1][0] < near:
            found[-1] = (found[-1][0], (*found[-1][1], joint))
        else:
            found.append((t_s, (joint,)))
    return found


def _reversal_times(t_s: Array, q: Array) -> list[float]:
    """Return the times at which a joint reverses that moves by enough before and after, s.

    Where it stands in between, as it does between equal readings, it reverses in the middle of that.
    ``t_s``: (N,) times, s; ``q``: (N,) angles, rad.
    """
    if not len(q):
        return []
    steps = np.diff(q)
    moves = np.flatnonzero(steps)
    reversals = np.flatnonzero(np.diff(np.sign(steps[moves])))
    ends = [0, *((moves[reversals] + 1 + moves[reversals + 1]) // 2).tolist(), len(q) - 1]
    enough = np.abs(np.diff(q[ends])) > _MOVES_RAD
    return [float(at) for at in t_s[ends[1:-1]][enough[:-1] & enough[1:]]]
