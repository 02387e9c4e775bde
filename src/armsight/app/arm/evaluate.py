"""What a run shows of an arm, for ``armsight arm report``: a folder of ``armsight run`` in, numbers out; and its motions.

:func:`plan_report` writes the motions of the recording. :func:`evaluate_arm` evaluates its rests in open loop: where vision
saw the tool, what the joints' own sensors read, and what was commanded. The error of a rest, seen less commanded, is split

    error = controller + base and tool + the arm's error sources + rest,

in the frames of the run. The controller's part is what readings and commands put apart by the nominal table. The others
are what a fit of all that may be off (``loop.identify``) says that each moves the tool by; a joint's zero has the mean of
its other sources. Their sigmas are large where these poses do not distinguish two of them. A part's share is its component
along the error, over the error: shares sum to 1, and one that cancels others is negative.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armsight.app.check.evaluate import evaluate
from armsight.app.check.run_folder import WINDOW_S, JointTrack, Noise, attained_in, joint_track, noise_of, segments_of
from armsight.app.run.motion_file import motion_text
from armsight.app.run.tracks import read_track
from armsight.app.show.encode import json_of
from armsight.data import Array, Record
from armsight.errors import InputError, some
from armsight.estimate.solve import regression
from armsight.files import as_input_error, read_json, read_toml
from armsight.geometry.pose import mean_pose
from armsight.geometry.rotation import log_so3
from armsight.loop.identify.backlash import joint_backlashes
from armsight.loop.identify.identify import Identified, identify
from armsight.loop.identify.measured import Measured
from armsight.loop.identify.model import SENSOR, gravity_levers
from armsight.loop.iso9283.poses import MIN_POSES
from armsight.loop.iso9283.statistic import Metric
from armsight.robot.arm_file import open_arm
from armsight.robot.kinematics.arm import Arm
from armsight.tables.columns import Columns

VERSION = 1  # version of report.json
#: Fewest rests, and shots of one.
MIN_RESTS, _SHOTS = 12, 2
_SIGMAS = tuple(f"sigma_{name}" for name in ("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad"))
#: Delays that are tried, s; a joint's least motion that shows its delay, rad; how much of a rest counts, s; motions.
_DELAYS_S, _MOVED_RAD, _AFTER_S, _MOTIONS = np.arange(0.0, 1.2, 0.005), np.radians(2.0), 0.5, 60
_SAME_RAD = 1e-6  # poses that are at most this far apart by their commands, rad, are one pose
#: Part of the error -> the kinds of parameters that make it, and its remedy.
_PARTS = {
    "base and tool": (("base", "tool"), "calibrate hand and eye anew, over more of the room"),
    "zeros": (("offset",), "set the zeros of the joints (armsight board offsets, or corrected.toml)"),
    "lengths and angles": (("d", "a", "alpha", "beta"), "use the identified table (armsight identify)"),
    "sensors' curves": (("gain", "wave", "ripple"), "correct the sensors' curves (zeros.toml of armsight identify)"),
    "backlash": (("backlash", "gravity_backlash"), "approach from one side, or take the backlash out of the gears"),
    "compliance": (("compliance",), "correct the compliance under gravity (corrected.toml)"),
}
#: A part, or a number, is determined where it is more than so many of its sigmas.
SURE = 2.0
CONTROLLER, REST = "controller", "rest"
#: Harmonics of a sensor beyond the second are left to ``armsight identify``: the recording is too short for them.
_PRIORS = {"ripple": 0.0}


@dataclass(frozen=True, eq=False)
class RestPoses(Record):
    """The rests of a run in open loop that vision saw."""

    t_s: Array  #: (N,) their ends, board's clock, s
    T_seen: Array  #: (N, 4, 4) mean poses of the tool at their ends, in the base of the run
    T_ref: Array  #: (N, 4, 4) commanded ones
    cov: Array  #: (N, 6, 6) covariances of what was seen, right tangents [m; rad]
    q: Array  #: (N, n) mean readings, rad
    q_ref: Array  #: (N, n) commands, rad
    approach: Array  #: (N, n) from which side each joint came: 1 with rising angle, -1 with falling, 0 unmoved
    noise: Noise  #: of one shot

    def __len__(self) -> int:
        """Return N."""
        return len(self.t_s)

    def measured(self) -> Measured:
        """Return what an identification is given."""
        return Measured(self.q, self.T_seen[:, None, :3, 3], self.T_seen[:, :3, :3].copy(), self.cov, self.approach)

    def rows(self, rows: NDArray[np.bool_]) -> RestPoses:
        """Return some of the rests."""
        names = [each.name for each in fields(self) if each.name != "noise"]
        return replace(self, **{name: getattr(self, name)[rows] for name in names})

    def visits(self) -> tuple[NDArray[np.int64], int]:
        """Return which pose each rest was at (N,), and how many there are."""
        _, which = np.unique(np.round(self.q_ref / _SAME_RAD), axis=0, return_inverse=True)
        return np.asarray(which.ravel(), np.int64), int(which.max()) + 1

    def groups(self, which: NDArray[np.int64], *, by_side: bool) -> list[NDArray[np.int64]]:
        """Return the rows of each pose, of each with the sides it was approached from where asked for."""
        key = np.column_stack([which, self.approach]) if by_side else which[:, None]
        _, group = np.unique(key, axis=0, return_inverse=True)
        return [np.flatnonzero(group.ravel() == k) for k in range(int(group.max()) + 1)]


def rests_of(folder: Path, arm: Arm) -> RestPoses:
    """Read the rests of a run's motions in open loop."""
    segments = segments_of(folder, closed=False)
    track = joint_track(folder, arm.joints)
    seen, sigmas = read_track(folder / "vision.csv", _SIGMAS)
    rows = list[tuple[Any, ...]]()
    for segment in (each for each in segments if each.kind == "rest"):
        end_s, begin_s = float(segment.reference.t_s[-1]), float(segment.reference.t_s[0])
        looked = np.flatnonzero((seen.t_s > max(end_s - WINDOW_S, begin_s)) & (seen.t_s <= end_s))
        read = np.flatnonzero((track.t_s > end_s - WINDOW_S) & (track.t_s <= end_s))
        if len(looked) < _SHOTS or not len(read):
            continue
        T, variance, cov = mean_pose(seen.Ts_base_tool[looked]), (sigmas[looked] ** 2).mean(axis=0), np.zeros((6, 6))
        for part in (slice(0, 3), slice(3, 6)):
            cov[part, part] = T[:3, :3].T @ np.diag(variance[part]) @ T[:3, :3]
        q_ref = track.q_ref[read[-1]]
        rows.append((end_s, T, arm.forward(q_ref), cov, track.q[read].mean(axis=0), q_ref, track.sides(end_s)))
    if len(rows) < MIN_RESTS:
        needed = f"{MIN_RESTS} at least are needed: armsight arm plan writes the motions of such a recording"
        raise InputError(f"{folder}: {len(rows)} rests were seen in open loop, {needed}")
    t_s, T_seen, T_ref, cov, q, q_ref, came = (np.array(part) for part in zip(*rows, strict=True))
    return RestPoses(t_s, T_seen, T_ref, cov, q, q_ref, came, noise_of(segments))


@dataclass(frozen=True)
class JointFigures:
    """What a run shows of one joint; None where it does not. Pairs are a value and its sigma."""

    name: str  #: of the joint
    zero_deg: tuple[float, float] | None  #: true angle less reading, mean; None of those that are base and tool
    backlash_deg: tuple[float, float] | None  #: behind the sensor, stop to stop
    backlash_how: str  #: what showed it, or why it does not show
    hysteresis_deg: tuple[float, float] | None  #: reading against command: from above less from below, mean
    droop_deg_per_m: tuple[float, float] | None  #: reading less command for a metre of the gravity load's lever
    droop_deg: float | None  #: that at the greatest lever of these poses
    once_per_revolution_deg: tuple[float, float] | None  #: amplitude of the sensor's error once per revolution
    latency_s: float | None  #: from command to reading in motion


@dataclass(frozen=True)
class ErrorPart:
    """A part of the error."""

    share: float  #: of the mean square error; all sum to 1
    rms_mm: float  #: what it moves the tool by, RMS
    sigma_mm: float  #: sigma of that: the RMS of its own error
    without_mm: float  #: RMS error that its remedy alone would leave
    remedy: str  #: what would take it away; empty where nothing does

    @property
    def determined(self) -> bool:
        """Whether these poses show it at all."""
        return self.rms_mm > SURE * self.sigma_mm


@dataclass(frozen=True, eq=False)
class ArmReport(Record):
    """An arm in numbers; None where the run does not show it."""

    arm: str  #: its model
    board: str  #: its controller, as the run names it
    poses: int  #: number of different poses
    rests: int  #: number of rests that were seen
    hours: float  #: from the first rest to the last
    placed_mm: float  #: RMS distance from the command after base and tool were fitted to these poses
    pose_accuracy_mm: float | None  #: accuracy AP (ISO 9283) of the poses of ``one_side_mm``, mean
    one_side_mm: float | None  #: repeatability RP (ISO 9283) of poses that came three times from the same side
    cycles: int  #: how often the pose came that came most often
    latency_s: float | None  #: median of the joints'
    noise_mm: float  #: of vision at rest, one shot
    accuracy_mm: tuple[float, float]  #: RMS and largest distance from the command in the frames of the run
    both_sides_mm: tuple[float, float] | None  #: mean and largest distance between a pose from either side
    drift_mm_per_h: tuple[float, float] | None  #: of the pose that came most often, and its sigma
    joints: tuple[JointFigures, ...]  #: of each joint
    parts: dict[str, ErrorPart]  #: of the error, by name
    health: tuple[str, ...]  #: what the run's health monitor found, as text
    notes: tuple[str, ...]  #: what could not be evaluated, and why
    at: Array  #: (N, 3) commanded positions of the rests, m
    off: Array  #: (N, 3) the errors there after base and tool were fitted, m
    lever: Array  #: (N, n) levers of the gravity load, m
    lag: Array  #: (N, n) readings less commands there, rad
    drift: Array  #: (C, 2) time, h, and distance from the first visit, mm, of the pose that came most often

    def to_json(self) -> dict[str, Any]:
        """Return the object of report.json: pairs are a value and its sigma, or as the key says."""
        names = [each.name for each in fields(self)]
        shown: dict[str, Any] = {"version": VERSION, "kind": "arm report"}
        shown |= {name: getattr(self, name) for name in names[: names.index("accuracy_mm")]}
        for name, keys in _PAIRS.items():
            shown |= zip(keys, getattr(self, name) or (None, None), strict=True)
        shown["joints"] = [_with_sigmas(asdict(joint)) for joint in self.joints]
        shown["parts"] = {n: {**asdict(part), "determined": part.determined} for n, part in self.parts.items()}
        shown["health"], shown["notes"] = self.health, self.notes
        shown["map"] = [{"at_m": p, "error_mm": e} for p, e in zip(self.at, 1e3 * self.off, strict=True)]
        known: dict[str, Any] = json_of(shown)
        return known


#: Pairs of the report -> their keys in JSON.
_PAIRS = {
    "accuracy_mm": ("accuracy_rms_mm", "accuracy_max_mm"),
    "both_sides_mm": ("both_sides_mean_mm", "both_sides_max_mm"),
    "drift_mm_per_h": ("drift_mm_per_h", "drift_sigma_mm_per_h"),
}


def _with_sigmas(values: dict[str, Any]) -> dict[str, Any]:
    shown = {name: value[0] if isinstance(value, tuple) else value for name, value in values.items()}
    return shown | {f"sigma_{name}": value[1] for name, value in values.items() if isinstance(value, tuple)}


def evaluate_arm(folder: Path, arm: Arm, *, progress: Callable[[str], None] = lambda line: None) -> ArmReport:
    """Evaluate a run."""
    progress("reading the run")
    rests, summary = rests_of(folder, arm), _summary(folder)
    progress("identifying the arm")
    measured = rests.measured()
    found = identify(arm, measured, priors=_PRIORS, progress=progress)
    progress("evaluating")
    kept = rests.rows(found.solution.used)
    notes = []
    if len(found.left_out):
        times = some(f"{t:.0f}" for t in rests.t_s[found.left_out])
        notes.append(f"left out as mistakes: {len(found.left_out)} of {len(rests.q)} rests, at {times} s")
    off, parts = _split(arm, kept, found)
    lever, backlash, latencies = gravity_levers(arm, kept.q), joint_backlashes(found, measured), _latencies(folder, arm)
    joints = [_joint(arm, i, kept, found, lever[:, i], backlash[i]._asdict(), latencies[i]) for i in range(arm.joints)]
    distance = np.linalg.norm(rests.T_seen[:, :3, 3] - rests.T_ref[:, :3, 3], axis=1)
    which, visits = rests.visits()
    drift, per_h = _drift(kept)
    known = [each for each in latencies if each is not None]
    attained, both = evaluate(attained_in(folder, closed=False)).poses.values(), _both_sides(rests, which)
    accuracy, one = (_mean_mm([getattr(p, name) for p in attained]) for name in ("AP_m", "RP_m"))
    if one is None:
        notes.append(f"no pose was approached {MIN_POSES} times from one side: no repeatability")
    if both is None:
        notes.append("no pose was approached from both sides")
    return ArmReport(
        arm=arm.name,
        board=str(summary.get("board", "unknown")),
        poses=visits,
        rests=len(rests),
        hours=float(np.ptp(rests.t_s)) / 3600.0,
        placed_mm=_rms_mm(off),
        pose_accuracy_mm=accuracy,
        one_side_mm=one,
        cycles=len(drift),
        latency_s=float(np.median(known)) if known else None,
        noise_mm=1e3 * float(np.sqrt(np.trace(rests.noise.own))),
        accuracy_mm=(1e3 * float(np.sqrt((distance**2).mean())), 1e3 * float(distance.max())),
        both_sides_mm=both,
        drift_mm_per_h=per_h,
        joints=tuple(joints),
        parts=parts,
        health=tuple(str(each.get("what")) for each in summary.get("health", [])),
        notes=tuple(notes),
        at=kept.T_ref[:, :3, 3],
        off=off,
        lever=lever,
        lag=kept.q - kept.q_ref,
        drift=drift,
    )


def _summary(folder: Path) -> dict[str, Any]:
    path = folder / "summary.json"
    found = read_json(path) if path.is_file() else {}
    return found if isinstance(found, dict) else {}


def _split(arm: Arm, rests: RestPoses, found: Identified) -> tuple[Array, dict[str, ErrorPart]]:
    """Return the errors (N, 3), m, after base and tool were fitted, and the parts of the whole error."""
    error = rests.T_seen[:, :3, 3] - rests.T_ref[:, :3, 3]
    square = max(float((error**2).sum()), 1e-30)

    def part(values: Array, sigma_mm: float, remedy: str) -> ErrorPart:
        without = _rms_mm(error - values) if remedy else _rms_mm(error)
        return ErrorPart(float((values * error).sum()) / square, _rms_mm(values), sigma_mm, without, remedy)

    J, constant, off = _displacements(arm, rests, found)
    kinds = np.array([p.kind for p in found.model.parameters])
    left = error - (controller := arm.forward(rests.q)[:, :3, 3] - rests.T_ref[:, :3, 3])
    shown = {CONTROLLER: part(controller, 0.0, "command what is missing: close the loop")}
    for name, (of, remedy) in _PARTS.items():
        by = J * np.isin(kinds, of) + constant * (float("offset" in of) - np.isin(kinds, of))
        moved = by @ off
        sigma = 1e3 * float(np.sqrt(np.einsum("nip,pq,niq->n", by, found.cov_everything, by).mean()))
        shown[name], left = part(moved, sigma, remedy), left - moved
    shown[REST] = part(left, 0.0, "")
    placed = np.linalg.qr(J[:, :, np.isin(kinds, ("base", "tool"))].reshape(error.size, -1))[0]
    flat = error.ravel()
    return np.asarray((flat - placed @ (placed.T @ flat)).reshape(-1, 3)), shown


def _displacements(arm: Arm, rests: RestPoses, found: Identified) -> tuple[Array, Array, Array]:
    """Return the derivative of the tool's position (N, 3, P), the same by the error sources' means, and what is off (P,).

    Base and tool are off the frames of the run; the derivative is that in the middle, right to the second order.
    """
    model, x = found.model, found.solution.x - found.moved
    T_tool, T_base, T_body = arm.T_flange_tool, model.T_rig_base(x), model.T_6_body(x)
    model = replace(model, R_start=np.eye(3), R_tool=T_tool[:3, :3])
    nominal, true, at = model.nominal(), x.copy(), model.table_at
    nominal[model.tool_at : at - 3] = T_tool[:3, 3]
    true[3:6], true[at - 3 : at] = log_so3(T_base[:3, :3]), log_so3(T_tool[:3, :3].T @ T_body[:3, :3])
    measured, phi = rests.measured(), model.feature_values(rests.q, rests.approach)
    middle, R = 0.5 * (nominal + true), rests.T_seen[:, :3, :3]
    J, constant = (R @ model.linearised(middle, measured, p)[1][:, :3] for p in (phi, 0 * phi + phi.mean(axis=0)))
    constant[:, :, : model.sources_at] = 0.0
    return J, constant, true - nominal


def _rms_mm(values: Array) -> float:
    return 1e3 * float(np.sqrt((values**2).sum(axis=1).mean()))


def _joint(
    arm: Arm, i: int, rests: RestPoses, found: Identified, lever: Array, backlash: dict[str, Any], latency: float | None
) -> JointFigures:
    deg, zero, once = float(np.degrees(1.0)), _zero(arm, i, rests, found), None
    waves = [f"wave{i + 1}_{phase}1" for phase in ("sin", "cos")]
    free = [w for w in waves if w in found.model.names and found.solution.free[found.model.names.index(w)]]
    if free:
        value, sigma = deg * np.linalg.norm([found.value(wave) for wave in free], axis=0)
        once = (float(value), float(sigma))
    gap = None if not np.isfinite(backlash["value_rad"]) else (deg * backlash["value_rad"], deg * backlash["sigma_rad"])
    lag, side = rests.q[:, i] - rests.q_ref[:, i], rests.approach[:, i]
    loaded = float(np.abs(lever).max()) > _LEVER_M
    columns = [np.ones(len(lag)), *([side] if side.any() else []), *([lever] if loaded else [])]
    fitted, sigmas = regression(np.column_stack(columns), lag, rests.groups(rests.visits()[0], by_side=False))
    hysteresis = (-2 * deg * fitted[1], 2 * deg * sigmas[1]) if side.any() else None
    droop = (deg * fitted[-1], deg * sigmas[-1]) if loaded else None
    most = None if droop is None else droop[0] * float(lever[np.argmax(np.abs(lever))])
    return JointFigures(arm.joint_names[i], zero, gap, str(backlash["how"]), hysteresis, droop, most, once, latency)


def _zero(arm: Arm, i: int, rests: RestPoses, found: Identified) -> tuple[float, float] | None:
    """Return by how much a joint really is further than it reads, deg, on the mean over the rests, and its sigma.

    The mean of the sensor's curve counts with the zero; sigma has how far leaving out the others has moved it.
    """
    model, solution = found.model, found.solution
    weight, at = np.zeros(len(solution.x)), model.names.index(f"offset{i + 1}")
    if not solution.free[at]:
        return None
    weight[at] = arm.direction[i]
    phi = model.feature_values(rests.q, rests.approach).mean(axis=0)
    for k, feature in enumerate(model.features):
        if feature.joint == i and feature.kind in SENSOR:
            weight[model.sources_at + k] = phi[k]
    value = float(weight @ (solution.x - model.nominal()))
    sigma = np.hypot(np.sqrt(weight @ solution.cov @ weight), weight @ found.moved)
    return float(np.degrees(value)), float(np.degrees(sigma))


_LEVER_M = 0.02  # a joint whose gravity load has a lever below this at all poses carries none, m


def _mean_mm(metrics: list[Metric]) -> float | None:
    return 1e3 * float(np.mean([m.raw if m.clean is None else m.clean for m in metrics])) if metrics else None


def _both_sides(rests: RestPoses, which: NDArray[np.int64]) -> tuple[float, float] | None:
    """Return mean and largest distance, mm, between a pose approached from one side and from the opposite one."""
    apart = []
    for rows in rests.groups(which, by_side=False):
        sides = rests.approach[rows]
        for k in range(len(rows)):
            opposite = [m for m in range(k) if (sides[m] == -sides[k]).all() and sides[k].any()]
            apart += [rests.T_seen[rows[k], :3, 3] - rests.T_seen[rows[m], :3, 3] for m in opposite]
    if not apart:
        return None
    distance = 1e3 * np.linalg.norm(apart, axis=1)
    return float(distance.mean()), float(distance.max())


def _drift(rests: RestPoses) -> tuple[Array, tuple[float, float] | None]:
    """Return times, h, and distances from the first visit, mm, of the pose that came most often, and its drift, mm/h."""
    which, _ = rests.visits()
    rows = max(rests.groups(which, by_side=True), key=len)
    hours, p = (rests.t_s[rows] - rests.t_s[rows[0]]) / 3600.0, rests.T_seen[rows, :3, 3]
    track = np.column_stack([hours, 1e3 * np.linalg.norm(p - p[0], axis=1)])
    if len(rows) < 2 * MIN_POSES or hours[-1] <= 0:
        return track, None
    columns = np.column_stack([np.ones(len(hours)), hours])
    slopes, sigmas = np.array([regression(columns, 1e3 * y, None) for y in p.T])[:, :, 1].T
    rate = float(np.linalg.norm(slopes))
    return track, (rate, float(np.linalg.norm(slopes * sigmas)) / max(rate, 1e-12))


def _latencies(folder: Path, arm: Arm) -> list[float | None]:
    """Return the delay from command to reading of each joint in the motions, s: the shift that leaves the least."""
    track = joint_track(folder, arm.joints)
    moving = np.zeros(len(track.t_s), bool)
    for segment in segments_of(folder, closed=False):
        if segment.kind != "rest":
            moving |= (track.t_s > segment.reference.t_s[0]) & (track.t_s <= segment.reference.t_s[-1])
    ends = np.flatnonzero(np.diff(moving.astype(int)))
    spans = [
        np.flatnonzero((track.t_s > track.t_s[a]) & (track.t_s < min(track.t_s[b] + _AFTER_S, track.t_s[c])))
        for a, b, c in zip(ends[::2], ends[1::2], np.append(ends[2::2], len(track.t_s) - 1), strict=False)
    ]
    found: list[float | None] = []
    for i in range(arm.joints):
        moved = [rows for rows in spans if len(rows) and np.ptp(track.q_ref[rows, i]) > _MOVED_RAD]
        moved = [rows for rows in moved if np.isfinite(_left(track, i, rows, _DELAYS_S[-1]))][:_MOTIONS]
        best = int(np.argmin([sum(_left(track, i, rows, delay) for rows in moved) for delay in _DELAYS_S]))
        found.append(float(_DELAYS_S[best]) if moved and best < len(_DELAYS_S) - 1 else None)
    return found


def _left(track: JointTrack, i: int, rows: NDArray[np.int64], delay_s: float) -> float:
    off = track.q[rows, i] - np.interp(track.t_s[rows] - delay_s, track.t_s, track.q_ref[:, i])
    return float(((off - off.mean()) ** 2).sum())


def plan_report(
    arm: Arm, around: Array, visible: Callable[[Array], NDArray[np.bool_]], *, poses: int, cycles: int, seed: int = 0
) -> tuple[str, Array]:
    """Return the motions of the recording that a report needs, as a motion file, and the space (3,) it covers, m.

    ``around``: (M, n) joint angles at which the body was seen, rad; the arm stands at the first. ``visible``: whether it
    is seen at poses (N, 4, 4) of the tool. Each of ``poses`` comes from both sides, five of them for ``cycles``.
    """
    rng, found = np.random.default_rng([seed, 40]), list[tuple[Array, Array]]()
    low, high = arm.q_min + 2 * _ASIDE_RAD, arm.q_max - 2 * _ASIDE_RAD
    for _ in range(_TRIES * poses):
        if len(found) == poses:
            break
        q = rng.dirichlet(np.full(len(around), 0.3)) @ around
        side = rng.choice([-1.0, 1.0], arm.joints)
        both = np.stack([q, q - _ASIDE_RAD * side, q + _ASIDE_RAD * side])
        if (q > low).all() and (q < high).all() and visible(arm.forward(both)).all():
            found.append((q, side))
    if len(found) < max(poses // 2, _LEAST_POSES):
        raise InputError(f"the body is seen at {len(found)} of {poses} poses: bring the cameras further from the arm")
    extent = np.ptp(arm.forward(np.array([q for q, _ in found]))[:, :3, 3], axis=0)
    text = f"# armsight arm plan: {arm.name}, {len(found)} poses from both sides, {cycles} cycles of five.\n"
    text += f"start_deg = {np.degrees(around[0]).round(4).tolist()}\n"
    every, done, motions = max(1, round(len(found) / max(cycles, 1))), 0, list[tuple[str, Array, float]]()
    for n, (q, side) in enumerate(found, start=1):
        for sign, word in ((1.0, "one side"), (-1.0, "the other")):
            motions += [(f"W{n} aside, {word}", q - sign * _ASIDE_RAD * side, 0.0), (f"W{n} from {word}", q, _REST_S)]
        if n % every == 0 or n == len(found):
            due = round(cycles * n / len(found))
            for cycle in range(done + 1, due + 1):
                motions.append((f"before cycle {cycle}", found[4][0], 0.0))  # P1 always comes from P5, as the others do
                motions += [(f"P{k} cycle {cycle}", pose, _REST_S) for k, (pose, _) in enumerate(found[:5], start=1)]
            done = due
    each = [motion_text("joints", name, {"q_deg": np.degrees(q), "rest_s": rest_s}) for name, q, rest_s in motions]
    return "".join([text, *each]), extent


#: How far a joint goes aside before it comes to a pose, rad; rest at a pose, s; candidates for a pose; fewest poses.
_ASIDE_RAD, _REST_S, _TRIES, _LEAST_POSES = np.radians(3.0), 1.0, 60, 8


def nominal_arm(folder: Path, name: str | None) -> Arm:
    """Return the nominal arm of a run: the one of this name, or the one that the run names."""
    if not folder.is_dir():
        raise InputError(f"{folder}: {'no' if folder.exists() else 'no such'} folder: give one of armsight run or demo")
    if name is not None:
        return open_arm(name)
    summary = _summary(folder)
    if not (named := str(summary.get("nominal_arm", summary.get("arm", "")))):
        raise InputError(f"{folder}: the run does not name its arm: give --arm")
    return open_arm(named)


def seen_angles(folder: Path, arm: Arm) -> Array:
    """Return the joint angles (M, n) at which a run saw the body, rad: where its motions start, then its hand-eye poses."""
    path = folder / "handeye_poses.csv"
    table = Columns.of_csv(path)
    names = [f"q{i + 1}_rad" for i in range(arm.joints)]
    if not set(names) <= set(table.at) or f"q{arm.joints + 1}_rad" in table.at:
        raise InputError(f"{path}: is not of an arm of {arm.joints} joints")
    seen = table.numbers(names)
    with as_input_error(f"{folder / 'motion.toml'}: is not of an arm of {arm.joints} joints", ValueError):
        start = read_toml(folder / "motion.toml").get("start_deg", np.degrees(arm.home).tolist())
        return np.vstack([np.radians(np.array(start, float)), seen])
