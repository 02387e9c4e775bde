"""A run's folder to the rows of a test: where vision saw the tool at each commanded pose and along each path.

In: reference.csv (where the tool was commanded to be), vision.csv, motion.toml, and joints.csv where it exists. Out: rows
for the evaluation. The run is cut into segments: its motions, and the rest at the end of each.

- A rest belongs to the pose that was commanded there, wherever else in the motion that pose comes again, and to the visits
  whose joints came from the same sides: on the other side of a joint's backlash it is another approach.
- A line or circle belongs with those along the same commanded path; of a circle, both directions are needed.
- The instrument's noise is half the mean square of the steps from one shot of a rest to the next: slower motion of the arm
  is not in it, faster motion is, so it is an upper estimate. What vision.csv claims beyond it is common to all shots.
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from armsight.app.check.rows import SAME_M, Attained, Reversal, Row, first_few
from armsight.app.run.report import VERSION
from armsight.app.run.tracks import ToolTrack, read_track
from armsight.data import Array, Record
from armsight.errors import InputError
from armsight.files import as_input_error, natural_key, read_json, read_toml, require_version
from armsight.geometry.pose import mean_pose, pose
from armsight.loop.iso9283.paths import plane_axes
from armsight.loop.iso9283.poses import MIN_POSES
from armsight.robot.kinematics.table import MOST_JOINTS
from armsight.tables.columns import Columns

#: A rest is evaluated over its last part, this long, s: longer averages more shots, and more of the settling.
WINDOW_S = 0.3
#: A rest is evaluated that was seen in this many shots, a path at so many path points.
_REST_SHOTS, _PATH_POINTS = 3, 40
#: A path is evaluated that was seen in this many shots; half: its middle is interpolated, double: fast paths are left out.
_PATH_SHOTS = 10
#: Paths whose first, middle and last positions are this near to each other are one path, m; half: commands
#: rounded to 0.1 mm part cycles of one path, double: paths 0.2 mm apart are one.
_SAME_M = 1e-4
#: m; a path's direction is taken so far to either side of a point; half, double: nothing.
_AHEAD_M = 1e-4
#: A circle is whole from this angle on, rad.
_WHOLE_RAD = 2 * np.pi * 0.999
#: Between two shots further apart than this many path points the path was not seen: the cycle is left out.
_GAP = 2.5
#: A joint reverses where it moves by this much before and after, rad: less does not take up its backlash.
_MOVES_RAD = float(np.radians(0.5))
#: Joints that reverse within this share of the circle's time do so together.
_NEAR = 0.015
#: From here on a joint was elsewhere, rad: what it was off by less does not take up its backlash.
_AWAY_RAD = float(np.radians(0.3))
_LOOK_ROWS = 4096  # that are looked through at once; half, double: so much memory
#: Columns of joints.csv in version 1 of a run's folder -> their present names; both are read.
_VERSION_1 = {f"q{joint}_wanted_rad": f"q{joint}_ref_rad" for joint in range(1, MOST_JOINTS + 1)}


@dataclass(frozen=True)
class PathSegment:
    """A motion, or the rest at its end."""

    name: str  #: of the motion
    kind: str  #: joints, home, line, circle; rest
    reference: ToolTrack  #: commanded poses of the tool
    seen: ToolTrack  #: poses of the tool that vision measured
    sigma: Array  #: (N, 3) what vision claims, m

    @property
    def p_ref(self) -> Array:
        """(M, 3) commanded positions of the tool, m."""
        return self.reference.Ts_base_tool[:, :3, 3]

    @property
    def called(self) -> str:
        """The name of the motion without its cycle."""
        return re.sub(r" cycle \d+$", "", self.name)

    def at_rest(self) -> tuple[Array, Array]:
        """Return poses (n, 4, 4) and sigmas (n, 3) of the shots at the end of a rest."""
        rows = self.seen.t_s > self.reference.t_s[-1] - WINDOW_S
        return self.seen.Ts_base_tool[rows], self.sigma[rows]


@dataclass(frozen=True)
class Noise:
    """The instrument."""

    own: Array  #: (3, 3) covariance of one shot of an arm at rest, base's axes, m^2
    common: Array  #: (3, 3) that of the error that all shots share
    claimed: Array  #: (3,) variances that vision claims at rest, all in

    def moving(self, segment: PathSegment) -> Array:
        """Return the covariance (3, 3) of one shot in a motion: vision claims more there, as the cameras expose apart."""
        return self.own + np.diag(np.maximum((segment.sigma**2).mean(axis=0) - self.claimed, 0.0))


@dataclass(frozen=True, eq=False)
class JointTrack(Record):
    """Readings and commands of the joints."""

    t_s: Array  #: (N,) board's clock, s
    q: Array  #: (N, n) readings, rad; NaN where the file has commands alone
    q_ref: Array  #: (N, n) commands, rad

    def sides(self, t_s: float) -> Array:
        """Return how each joint came to its command at a time, s (n,): 1 with rising angle, -1 with falling, 0 unmoved."""
        end = max(int(np.searchsorted(self.t_s, t_s, side="right")), 1)
        here = self.q_ref[end - 1]
        sides = np.zeros(len(here))
        for stop in range(end, 0, -_LOOK_ROWS):  # backwards: what the joints did before their last motion is of no use
            gone = here - self.q_ref[max(stop - _LOOK_ROWS, 0) : stop][::-1]
            far = np.abs(gone) > _AWAY_RAD
            came = np.take_along_axis(np.where(far, np.sign(gone), 0.0), far.argmax(axis=0)[None], axis=0)[0]
            sides = np.where(sides == 0, came, sides)
            if sides.all():
                break
        return sides


def joint_track(folder: Path, joints: int | None = None) -> JointTrack:
    """Read joints.csv of a run."""
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
    """Return what a run attained."""
    segments = segments_of(folder, closed)
    if not segments:
        which = "with the loop closed" if closed else "with the joint sensors alone"
        raise InputError(f"{folder}: the run has no motions {which}; run.log says how far it came")
    noise = noise_of(segments)
    paths, run, circle, notes = _paths(segments, noise)
    track = joint_track(folder) if (folder / "joints.csv").is_file() else None
    rows, more = _rests(segments, run, noise, track)
    return Attained(rows + paths, more + notes, [] if track is None else reversals_of(track, circle))


def require_known(folder: Path) -> None:
    """Reject a run's folder that a newer armsight wrote; one that says no version is read."""
    summary = folder / "summary.json"
    found = read_json(summary) if summary.is_file() else {}
    require_version(summary, "run", found.get("version") if isinstance(found, dict) else None, VERSION)


def segments_of(folder: Path, closed: bool) -> list[PathSegment]:
    """Cut a run into its motions and rests, by time: those with the loop closed, or those without."""
    require_known(folder)
    file, old, motions = (folder / name for name in ("reference.csv", "wanted.csv", "motion.toml"))
    file = old if old.is_file() and not file.is_file() else file  # its name in version 1
    for name in (file.name, "vision.csv", motions.name):
        if not (folder / name).is_file():
            if (folder / "summary.json").is_file():
                raise InputError(f"{folder}: {name} is missing: the run ended before its motions; run it to the end")
            raise InputError(f"{folder}: is no run, {name} is missing: give a folder of armsight run or demo, or a CSV")
    reference, _ = read_track(file, ())
    seen, sigma = read_track(folder / "vision.csv", ("sigma_x_m", "sigma_y_m", "sigma_z_m"))
    with as_input_error(f"{motions}: not a motion file (docs/howto/motions.md)", AttributeError, KeyError, TypeError):
        entries: Any = read_toml(motions).get("motion", [])
        kinds = {str(e.get("name", f"{e['kind']} {n}")): str(e["kind"]) for n, e in enumerate(entries, start=1)}
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


def noise_of(segments: list[PathSegment]) -> Noise:
    """Return the instrument's noise as the rests show it."""
    rests = [segment.at_rest() for segment in segments if segment.kind == "rest"]
    d = np.concatenate([np.zeros((0, 3)), *(np.diff(Ts[:, :3, 3], axis=0) for Ts, _ in rests)])
    if len(d) < MIN_POSES:
        raise InputError("the arm was hardly seen at rest: rests of half a second in view of both cameras are needed")
    own, claimed = d.T @ d / (2 * len(d)), (np.concatenate([sigma for _, sigma in rests]) ** 2).mean(axis=0)
    return Noise(own, np.diag(np.maximum(claimed - np.diag(own), 0.0)), claimed)


def _rests(
    segments: list[PathSegment], run: set[str], noise: Noise, track: JointTrack | None
) -> tuple[list[Row], list[str]]:
    """Return a row for every rest at a pose, but those at the ends of paths that are evaluated, and what was left out."""
    names = _pose_names([s for s in segments if s.kind == "rest" and s.name not in run])
    visits: dict[tuple[str, str], list[Row]] = {}
    times: Counter[str] = Counter()
    before, here, unseen = "the start", "the start", 0
    for segment in segments:
        if segment.kind != "rest":
            before, here = here, segment.called
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
        Ts, _ = segment.at_rest()
        unseen += len(Ts) < _REST_SHOTS
        if len(Ts) >= _REST_SHOTS:
            seen = Row("pose", name, str(times[name]), came, t_s, mean_pose(Ts), T, noise.own / len(Ts), noise.common)
            visits.setdefault((name, came), []).append(seen)
    rare = _rare(visits)
    rows = [row for at, group in visits.items() if at not in rare for row in group]
    said = [f"left out: {name} approached from {_in_words(came)}, too seldom ({n})" for (name, came), n in rare.items()]
    notes = [f"{unseen} rests were not seen, and are left out"] if unseen else []
    notes += first_few(said, "approaches, too seldom")
    return sorted(rows, key=lambda row: (natural_key(row.pose), row.t_s)), notes


def _in_words(came: str) -> str:
    """Say which joints came from which side; any other approach is returned as it is."""
    ways = (("+", "smaller"), ("-", "larger"))
    each = ((angles, [str(n) for n, s in enumerate(came[6:], 1) if s == sign]) for sign, angles in ways)
    said = " and ".join(f"{angles} angles of joint {', '.join(joints)}" for angles, joints in each if joints)
    return (said or "the start") if came.startswith("sides ") else came


def _rare(visits: dict[tuple[str, str], list[Row]]) -> dict[tuple[str, str], int]:
    attained = Counter(name for (name, _), group in visits.items() for _ in group)
    often = any(len(group) >= MIN_POSES for group in visits.values())
    return {at: len(rows) for at, rows in visits.items() if often and len(rows) < MIN_POSES <= attained[at[0]]}


def _pose_names(rests: list[PathSegment]) -> list[tuple[Array, str]]:
    """Return every pose at which the arm rested, (4, 4), with a name of its own: that by which it was commanded most."""
    found: list[tuple[Array, Counter[str]]] = []
    for rest in rests:
        T = rest.reference.Ts_base_tool[-1]
        called = next((each for at, each in found if np.abs(at - T).max() < SAME_M), None)
        if called is None:
            found.append((T, called := Counter()))
        called[rest.called.removeprefix("to ")] += 1
    names: dict[str, Array] = {}
    for T, called in found:
        name = called.most_common(1)[0][0]
        names[name if name not in names else f"{name} ({len(names) + 1})"] = T
    return [(T, name) for name, T in names.items()]


def _paths(segments: list[PathSegment], noise: Noise) -> tuple[list[Row], set[str], list[PathSegment], list[str]]:
    """Return the rows of paths and circle, the names of their motions, a segment of the circle each way, and notes."""
    groups, notes = list[list[PathSegment]](), list[str]()
    for segment in segments:
        if segment.kind not in ("line", "circle"):
            continue
        if len(segment.seen) < _PATH_SHOTS:
            notes.append(f"left out: {segment.name}, seen in {len(segment.seen)} shots; {_PATH_SHOTS} are needed")
            continue
        ends = _ends(segment)
        same = (g for g in groups if g[0].kind == segment.kind and np.abs(_ends(g[0]) - ends).max() < _SAME_M)
        if (found := next(same, None)) is None:
            groups.append(found := [])
        found.append(segment)
    circle, others = _both_ways(groups)
    rows, notes = list[Row](), notes + others
    run = {segment.name for group in circle for segment in group}
    names: list[str] = []
    for group in groups:
        if group[0].name in run:
            continue
        names.append(group[0].called if group[0].called not in names else group[0].name)
        cycles = _path(names[-1], group, noise, notes)
        if len(cycles) < MIN_POSES:
            notes.append(f"left out: {names[-1]}, followed too seldom ({len(cycles)})")
            continue
        rows += [row for cycle in cycles for row in cycle]
        run |= {segment.name for segment in group}
    return rows + [row for group in circle for row in _circle(group, noise)], run, [g[0] for g in circle], notes


def _ends(segment: PathSegment) -> Array:
    return segment.p_ref[[0, len(segment.p_ref) // 3, -1]]


def _path(name: str, group: list[PathSegment], noise: Noise, notes: list[str]) -> list[list[Row]]:
    """Return a path's rows, cycle by cycle, and note the cycles of which a part was not seen."""
    p = group[0].p_ref
    gone = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])  # arc lengths, m
    keep = np.concatenate([[True], np.diff(gone) > 0])
    p, gone, since = p[keep], gone[keep], group[0].reference.t_s[keep] - group[0].reference.t_s[0]
    points = np.linspace(0.0, gone[-1], _PATH_POINTS + 2)[1:-1]

    def on(s: Array) -> Array:
        return np.stack([np.interp(s, gone, p[:, i]) for i in range(3)], axis=1)

    cycles, commanded, widest = [], on(points), _GAP * float(points[1] - points[0])
    for cycle, segment in enumerate(group, start=1):
        was = segment.seen.Ts_base_tool[:, :3, 3]
        s = np.interp(segment.seen.t_s - segment.reference.t_s[0], since, gone)
        for _ in range(4):  # to the foot of the perpendicular: the time of the shot has no effect
            ahead = on(s + _AHEAD_M) - on(s - _AHEAD_M)
            ahead /= np.maximum(np.linalg.norm(ahead, axis=1), 1e-12)[:, None]
            s = np.clip(s + ((was - on(s)) * ahead).sum(axis=1), 0.0, gone[-1])
        s, first = np.unique(s, return_index=True)
        off = was[first] - on(s)
        if len(s) < 2 or s[0] > points[0] or s[-1] < points[-1]:
            notes.append(f"left out: {segment.name}, not seen from its first path point to its last")
            continue
        if (gap := float(np.diff(s).max())) > widest:
            most = f"{1e3 * widest:.1f} mm are the most: slower, or in view"
            notes.append(f"left out: {segment.name}, not seen over {1e3 * gap:.1f} mm; {most}")
            continue
        at = np.clip(np.searchsorted(s, points), 1, len(s) - 1)
        share = (points - s[at - 1]) / (s[at] - s[at - 1])
        attained = commanded + off[at - 1] + share[:, None] * (off[at] - off[at - 1])
        covs = ((1 - share) ** 2 + share**2)[:, None, None] * noise.moving(segment)
        rows = [
            Row("path", str(k + 1), str(cycle), name, None, pose(np.eye(3), a), pose(np.eye(3), c), cov, noise.common)
            for k, (a, c, cov) in enumerate(zip(attained, commanded, covs, strict=True))
        ]
        cycles.append(rows)
    return cycles


def _both_ways(groups: list[list[PathSegment]]) -> tuple[list[list[PathSegment]], list[str]]:
    """Return the two groups of the first circle that is run all around both ways; what is said of further ones."""
    rounds = [(group, *_round(group[0])) for group in groups if group[0].kind == "circle"]
    whole = [(group, shape, angle[-1]) for group, shape, angle in rounds if abs(angle[-1]) >= _WHOLE_RAD]
    each = [(a, b) for a, b in combinations(whole, 2) if a[2] * b[2] < 0]
    pairs = [(a[0], b[0]) for a, b in each if np.abs(a[1] - b[1]).max() < _SAME_M]
    if not pairs:
        return [], []
    circle = list(pairs[0])
    others = {g[0].name for pair in pairs[1:] for g in pair} - {g[0].name for g in circle}
    note = f"one circle run both ways is evaluated, {circle[0][0].name} and {circle[1][0].name}; also run were "
    return circle, [note + ", ".join(sorted(others))] if others else []


def _round(segment: PathSegment) -> tuple[Array, Array]:
    """Return a circle's shape (10,), m: centre, radius, axes times radius; and its angle from the start (N,), rad."""
    p = segment.p_ref
    centre = (p.max(axis=0) + p.min(axis=0)) / 2
    axes = plane_axes(np.linalg.svd(p - p.mean(axis=0), full_matrices=False)[2][2])
    radius, flat = np.linalg.norm(p - centre, axis=1).mean(), (p - centre) @ axes.T
    angle = np.unwrap(np.arctan2(flat[:, 1], flat[:, 0]))
    return np.concatenate([centre, [radius], radius * axes.ravel()]), angle - angle[0]


def _circle(group: list[PathSegment], noise: Noise) -> list[Row]:
    """Return a circle's rows: the middle revolution of each cycle, without its start and end."""
    rows = []
    for cycle, segment in enumerate(group, start=1):
        _, angle = _round(segment)
        there = np.interp(segment.seen.t_s, segment.reference.t_s, angle)
        way, own, common = "1" if angle[-1] > 0 else "-1", noise.moving(segment), noise.common
        middle = np.flatnonzero(np.abs(there - angle[-1] / 2) <= np.pi)
        for k, T_ref in zip(middle, segment.reference.at(segment.seen.t_s[middle]), strict=True):
            T, t_s, at = segment.seen.Ts_base_tool[k], float(segment.seen.t_s[k]), f"{np.degrees(there[k]):.2f}"
            rows.append(Row("circle", at, str(cycle), way, t_s, T, T_ref, own, common))
    return rows


def reversals_of(track: JointTrack, circle: list[PathSegment]) -> list[Reversal]:
    """Return where joints were commanded to reverse on a circle; those that reverse at about the same time are one."""
    reversals = []
    for segment in circle:
        reference, (_, angle) = segment.reference, _round(segment)
        rows = (track.t_s > reference.t_s[0]) & (track.t_s < reference.t_s[-1])
        t, q_ref = track.t_s[rows], track.q_ref[rows]
        each = sorted((t_s, k) for k in range(q_ref.shape[1]) for t_s in _reversal_times(t, q_ref[:, k]))
        together: list[tuple[float, tuple[int, ...]]] = []
        for t_s, joint in each:
            if together and t_s - together[-1][0] < _NEAR * float(np.ptp(t)):
                together[-1] = (together[-1][0], (*together[-1][1], joint + 1))
            else:
                together.append((t_s, (joint + 1,)))
        for t_s, joints in together:
            if abs(float(np.interp(t_s, reference.t_s, angle)) - angle[-1] / 2) <= np.pi:
                p = reference.at(np.array([t_s]))[0, :3, 3]
                reversals.append(Reversal(joints, float(np.sign(angle[-1])), p))
    return reversals


def _reversal_times(t_s: Array, q: Array) -> list[float]:
    """Return the times at which a joint reverses that moves by enough before and after, s; where it stands, the middle."""
    if not len(q):
        return []
    steps = np.diff(q)
    moves = np.flatnonzero(steps)
    reversals = np.flatnonzero(np.diff(np.sign(steps[moves])))
    ends = [0, *((moves[reversals] + 1 + moves[reversals + 1]) // 2).tolist(), len(q) - 1]
    enough = np.abs(np.diff(q[ends])) > _MOVES_RAD
    return [float(at) for at in t_s[ends[1:-1]][enough[:-1] & enough[1:]]]
