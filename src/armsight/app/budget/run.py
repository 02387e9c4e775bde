"""A run beside its budget: what was measured at each shot, against what was predicted for it, and which cause does not fit.

In: the folder of ``armsight run`` or ``demo``, and the plan of its rig. Out: a table, and the same for programs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from armsight.app.run.motion_file import read_motions
from armsight.app.run.tracks import read_track
from armsight.app.show.table import TextTable
from armsight.data import Array
from armsight.errors import InputError
from armsight.files import parsed_json, read_text
from armsight.geometry.pose import inverse, log_se3
from armsight.robot.arm_file import open_arm
from armsight.sim.budget.plan import RigPlan
from armsight.sim.budget.result import PREDICTED
from armsight.vision.calibrate.budget import CAUSES, Budget, Gates, pose_budget
from armsight.vision.pose.predict import view, view_at
from armsight.vision.rig import StereoRig

#: How many shots of a run are compared, evenly; and the speed that divides rest from motion, m/s.
MOST_SHOTS, _SLOW = 400, 0.005
_STEP_S = 0.02  # s; over which velocities are taken; half: noisier, double: corners are cut
#: A cause's standard deviation is tried at these factors.
_FACTORS = (0.0, 0.5, 0.7, 1.4, 2.0, 3.0, 5.0, 10.0)
#: Measured over predicted that fits: of what scatters, as near as predictions are; what is constant is drawn once (95 %).
_FITS = {"precision": (1 / PREDICTED, PREDICTED), "trueness": (0.0, 2.0)}


def against_run(folder: Path, plan: RigPlan) -> tuple[TextTable, list[dict[str, Any]]]:
    """Compare what a run measured with the budget at each shot: scatter at rest, what is constant, and in motion.

    The truth is that of a simulated run, else the fused track; then what is constant cannot be seen. The causes that
    do not fit are those whose changes make the errors likeliest.
    """
    T, before, T_true, after, known = _poses(folder)
    e = np.einsum("nij,nj->ni", T[:, :3, :3], log_se3(inverse(T_true) @ T)[:, :3])
    twists = log_se3(inverse(before) @ after) / (2 * _STEP_S)
    speed, rotation = (np.linalg.norm(twists[:, part], axis=1) for part in (slice(3), slice(3, 6)))
    rig, points, normals = plan.stereo_rig, plan.layout.body.points, plan.layout.normals
    views = [view_at(rig, points, normals, each) for each in T]
    per_speed = float(np.median(rotation / np.maximum(speed, _SLOW)))
    given = replace(plan.conditions, gate=Gates(), speed_m_s=1.0, rotation_rad_s=per_speed)
    found = pose_budget(rig, points, normals, views, given)
    of_plan = plan.speeds[0]  # which its blur in px is of; all else that moves is of 1 m/s
    faster = {name: speed for name, kind in CAUSES.items() if kind.moving} | {"exposure blur": speed / (of_plan or 1.0)}
    found, still = _scaled(found, {name: each[:, None, None] for name, each in faster.items()}), speed < _SLOW
    rest = np.cumsum(np.diff(still, prepend=still[:1]))  # the number of each rest, and of each motion
    constant = np.array([e[rest == k].mean(axis=0) for k in rest])
    kinds = {
        "scatter at rest": (still, e - constant, "precision"),
        "in motion": (~still, e - (e[still].mean(axis=0) if still.any() else 0.0), "precision"),
    }
    if known:
        kinds["constant at rest"] = (still, constant, "trueness")
    return _rows_of(found, {name: kind for name, kind in kinds.items() if kind[0].sum() > 10})


def run_plan(folder: Path, path: str = "", **given: Any) -> RigPlan:  # noqa: ANN401 - keys of a plan
    """Return the plan of a run's rig and body, its volume, distance and speed as measured; ``path``: a plan with the rest.

    Raises:
        InputError: no run that came to its end.
    """
    T, before, _, after, _ = _poses(folder)
    rig = StereoRig.load(folder / "rig.json")
    across = view(rig, np.eye(3), np.full((3, 3), np.nan), 1.0).forward
    deep, size = T[:, :3, 3] @ across, np.ptp(np.percentile(T[:, :3, 3], (20, 80), axis=0), axis=0)
    speed = float(np.sqrt(((after - before)[:, :3, 3] ** 2).sum(axis=1).mean())) / (2 * _STEP_S)
    measured = {
        "volume": "x".join(f"{max(each, 1e-3):.3f}" for each in (*size[:2], np.ptp(np.percentile(deep, (20, 80))))) + "m",
        "distance": f"{float(np.median(deep)):.3f}m", "speed": f"{speed:.3f}m/s",
    }  # fmt: skip
    files = {"rig": str((folder / "rig.json").resolve()), "body": str((folder / "body.toml").resolve())}
    return RigPlan.read(path, **measured | files | {key: value for key, value in given.items() if value is not None})


def motion_volume(path: Path, model: str) -> dict[str, str]:
    """Return the volume that a motion file's tool moves in, its wider horizontal side across, and its largest speed."""
    arm = open_arm(model)
    tracks = [
        arm.forward(motion.trajectory.at(np.arange(0.0, motion.trajectory.duration_s, _STEP_S)).q)[:, :3, 3]
        for motion in read_motions(arm, path).motions
    ]
    x, y, z = np.maximum(np.ptp(np.concatenate(tracks), axis=0), 1e-3)
    speed = max(float(np.linalg.norm(np.diff(p, axis=0), axis=1).max(initial=0.0)) for p in tracks) / _STEP_S
    return {"volume": f"{max(x, y):.3f}x{z:.3f}x{min(x, y):.3f}m", "speed": f"{speed:.3f}m/s"}


def _poses(folder: Path) -> tuple[Array, Array, Array, Array, bool]:
    """Return poses (N, 4, 4) of a run's body before the left camera: by vision, and true before, then and after.

    The last says whether the truth is that of a simulated run; else it is the fused track.
    """
    simulated = (folder / "truth.csv").is_file()
    seen = read_track(folder / "vision.csv")[0]
    truth = read_track(folder / ("truth.csv" if simulated else "fused.csv"))[0]
    rows = np.flatnonzero((seen.t_s > truth.t_s[0] + _STEP_S) & (seen.t_s < truth.t_s[-1] - _STEP_S))
    if not len(rows):
        raise InputError(f"{folder}: vision and truth have no time in common: give a run that came to its end")
    seen = seen[rows[np.linspace(0, len(rows) - 1, min(len(rows), MOST_SHOTS)).astype(int)]]
    handeye = parsed_json(read_text(folder / "handeye.json"), folder / "handeye.json")
    T_rig_base, T_tool_body = inverse(np.array(handeye["T_base_rig"])), np.array(handeye["T_tool_body"])
    tracks = (seen.Ts_base_tool, *(truth.at(seen.t_s + late) for late in (-_STEP_S, 0.0, _STEP_S)))
    T, before, T_true, after = (T_rig_base @ each @ T_tool_body for each in tracks)
    return T, before, T_true, after, simulated


def _scaled(found: Budget, by: Mapping[str, float | Array]) -> Budget:
    """Return a budget whose causes' standard deviations are multiplied by factors, each one or (G, 1, 1)."""
    return replace(found, factors={name: F * by.get(name, 1.0) for name, F in found.factors.items()})


def _fit(found: Budget, which: Array, e: Array, share: str) -> tuple[float, float]:
    """Return the RMS that is predicted of errors (N, 3) of shots, m, and their mean log density but for a constant."""
    C = found.cov(of=share)[which, :3, :3] + 1e-14 * np.eye(3)
    d2 = np.einsum("ni,nij,nj->n", e, np.linalg.inv(C), e)
    return float(np.sqrt(np.trace(C, axis1=1, axis2=2).mean())), -float((d2 + np.linalg.slogdet(C)[1]).mean())


def _likeliest(found: Budget, which: Array, e: Array, share: str) -> dict[str, float]:
    """Return causes and their factors: the one that raises the likelihood most, then the next, until chance explains it."""
    changed, high = dict[str, float](), _FITS[share][1]
    chance = 3 * (high**2 - 1 - 2 * math.log(high))  # what the last factor that fits gains, in all three axes
    free = [cause for cause in found.factors if CAUSES[cause].common == (share == "trueness")]
    likely = _fit(found, which, e, share)[1]
    while len(changed) < len(free):
        tried = {
            (cause, factor): _fit(_scaled(found, {cause: factor}), which, e, share)[1]
            for cause in free
            if cause not in changed
            for factor in _FACTORS
        }
        cause, factor = max(tried, key=lambda key: tried[key])
        if tried[cause, factor] - likely < chance * bool(changed):
            break
        likely, found, changed[cause] = tried[cause, factor], _scaled(found, {cause: factor}), factor
    return changed


def _rows_of(found: Budget, kinds: dict[str, tuple[Array, Array, str]]) -> tuple[TextTable, list[dict[str, Any]]]:
    """Return the table of kinds of errors -> (which shots, errors (N, 3), precision or trueness), and the same as JSON.

    Where the RMS does not fit, causes are named by how many times as large they make the errors likeliest.
    """
    listed, rows = list[dict[str, Any]](), list[tuple[str, ...]]()
    for name, (which, errors, share) in kinds.items():
        e, (low, high) = errors[which], _FITS[share]
        measured, predicted = float(np.sqrt((e**2).sum(axis=1).mean())), _fit(found, which, errors[which], share)[0]
        fits = low <= measured / predicted < high
        changed = {} if fits else _likeliest(found, which, e, share)
        row = {"errors": name, "measured_rms_m": measured, "predicted_rms_m": predicted, "fits": fits}
        listed.append(row | {"factors": changed})
        words = ", ".join(f"{cause} {factor:g} times" for cause, factor in changed.items())
        shown = (f"{1e3 * measured:.2g} mm", f"{1e3 * predicted:.2g} mm", f"{measured / predicted:.2f}")
        rows.append((name, *shown, f"likeliest: {words} as large" if words else ""))
    columns = ("errors of the run", "measured, RMS", "predicted", "ratio", "what does not fit")
    return TextTable("the run against its budget", columns, tuple(rows)), listed
