"""A run's folder: its tables, its summary, its report. Files are put in place whole; what a broken run measured is kept."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from armsight.app.experiment import Outcome
from armsight.app.motion_file import MotionPlan
from armsight.app.poses import csv_text, pose_record
from armsight.app.recording import record
from armsight.app.run_calibrate import HandEyeRun
from armsight.app.run_data import RunData, assembled, cut, joints_of
from armsight.app.run_report import RunReport, write_run_report
from armsight.app.run_summary import judge, path_errors, rest_errors, rms, singular, spread, track_figures
from armsight.app.run_tracks import ToolTrack, write_columns, write_track
from armsight.app.studies import Study
from armsight.data import Array, Image, Missed, PoseEstimate, Shot
from armsight.errors import InputError
from armsight.files import write_text
from armsight.robot.arm import Arm
from armsight.vision.image import grey
from armsight.vision.rig import StereoRig


@dataclass(frozen=True)
class Finished:
    """A run that is over.

    Attributes:
        arm: the nominal arm.
        rig: the calibrated cameras.
        outcome: what was measured.
        plan: what was to be done.
        truth: times (N,) and poses (N, 4, 4) of the tool; None for a real arm.
        facts: what else the summary is to say, such as the seed.
        studies: made after it.
        cell: (H, W, 3) BGR, the cell seen from aside; None for a real one.
    """

    arm: Arm
    rig: StereoRig
    outcome: Outcome
    plan: MotionPlan
    truth: tuple[Array, Array] | None
    facts: Mapping[str, Any]
    studies: Sequence[Study]
    cell: Image | None


def write_run(finished: Finished, folder: Path) -> dict[str, Any]:
    """Write everything a run measured.

    Returns:
        The summary.

    Raises:
        InputError: a file cannot be written; those that were stay whole.
    """
    outcome = finished.outcome
    if outcome.log.joints:
        write_columns(folder, "joints", _joint_columns(*joints_of(outcome.log)))
    write_text(folder / "poses.csv", csv_text(_pose_records(finished)))
    if outcome.handeye is not None:
        _write_handeye(folder, outcome.handeye)
    if outcome.handeye is None or not outcome.log.segments:
        summary = {**finished.facts, "ended_by": str(outcome.ended_by or "interrupted")}
        write_text(folder / "summary.json", json.dumps(summary, indent=1) + "\n")
        return summary
    mounting = outcome.handeye.mounting
    run = assembled(outcome.log, finished.arm, mounting, outcome.delay.delay_s, finished.truth)
    for name, track in _tracks(run).items():
        write_track(folder, name, track)
    _write_shots(folder / "shots", outcome.kept)
    before, after = (None if span is None else cut(run, *span) for span in (outcome.open_s, outcome.closed_s))
    summary = _summary(finished, run, before, after)
    write_text(folder / "summary.json", json.dumps(summary, indent=1) + "\n")
    notes = _notes(finished, run)
    write_text(folder / "run.log", "\n".join([*notes, *_segment_lines(run)]) + "\n")
    shown = run if outcome.open_s is None else cut(run, outcome.open_s[0], run.t_s[-1])
    report = RunReport(summary, shown, before, after, finished.studies, _picture(finished), finished.cell, notes)
    write_run_report(report, folder)
    return summary


def _tracks(run: RunData) -> dict[str, ToolTrack]:
    """Return the tracks that are written, by the name of their file."""
    named = {
        "potentiometers": run.potentiometers,
        "vision": run.vision,
        "fused": run.fused,
        "live": run.live,
        "wanted": run.wanted,
    }
    return named if run.truth is None else {**named, "truth": run.truth}


def _joint_columns(t_s: Array, q: Array, q_wanted: Array) -> dict[str, Any]:
    """Return the joints' columns: measured and wanted angles."""
    named: dict[str, Any] = {"t_s": np.round(t_s, 6)}
    for joint in range(6):
        named[f"q{joint + 1}_rad"] = np.round(q[:, joint], 9)
        named[f"q{joint + 1}_wanted_rad"] = np.round(q_wanted[:, joint], 9)
    return named


def _pose_records(finished: Finished) -> list[dict[str, Any]]:
    """Return what vision measured shot by shot, in the left camera's frame, as ``measure`` writes it."""
    body = finished.outcome.body
    return [pose_record(name, float(t), body, result) for name, t, result in finished.outcome.log.poses]


def _write_handeye(folder: Path, run: HandEyeRun) -> None:
    """Write the hand-eye calibration, and the poses it was made from as ``armsight identify`` reads them."""
    found, (position, angle) = run.found, run.found.held_out.rms()
    told = {
        "T_base_rig": run.mounting.T_base_rig.tolist(),
        "T_tool_body": run.mounting.T_tool_body.tolist(),
        "cov": found.cov.tolist(),
        "held_out_position_rms_m": position,
        "held_out_angle_rms_rad": angle,
        "sigma_flange_m": found.sigma_flange_m,
        "sigma_flange_rad": found.sigma_flange_rad,
        "poses": len(run.q),
        "missed": list(run.missed),
    }
    write_text(folder / "handeye.json", json.dumps(told, indent=1) + "\n")


def _write_shots(folder: Path, shots: Sequence[Shot]) -> None:
    """Write the kept shots as a recording; one of an earlier run makes room."""
    if folder.is_dir():
        shutil.rmtree(folder)
    left = iter(shots)

    class Kept:
        def read(self) -> Shot | None:
            return next(left, None)

        def close(self) -> None:
            pass

    record(Kept(), folder)


def _summary(finished: Finished, run: RunData, before: RunData | None, after: RunData | None) -> dict[str, Any]:
    """Return the figures, SI units in the keys."""
    outcome = finished.outcome
    assert outcome.handeye is not None
    summary: dict[str, Any] = {}
    if run.truth is not None and before is not None:
        for name in ("vision", "potentiometers", "fused", "live"):
            track: ToolTrack = getattr(before, name)
            moving = (track.phase == "open_loop") & ~_hidden(track, outcome.covered_s)
            resting = (track.phase == "rest") & ~_hidden(track, outcome.covered_s)
            if moving.any() and resting.any():
                summary[name] = {
                    **track_figures(track[moving], run.truth),
                    "rest_position_rms_m": track_figures(track[resting], run.truth)["position_rms_m"],
                }
        hidden = _hidden(before.fused, outcome.covered_s)
        if outcome.covered_s is not None and hidden.any():
            found = track_figures(before.fused[hidden], run.truth)
            summary["occlusion"] = {
                "duration_s": float(np.ptp(outcome.covered_s)),
                "fused_position_rms_m": found["position_rms_m"],
                "fused_position_max_m": found["position_max_m"],
            }
    if before is not None and after is not None:
        goals = {m.name: m.trajectory.at(m.trajectory.duration_s).q for m in finished.plan.motions}
        summary["closed_loop"] = _closed(before, after, [n for n, q in goals.items() if singular(finished.arm, q)])
    if len(run.latency_s):
        summary["latency_s"] = spread(run.latency_s)
    position, angle = outcome.handeye.found.held_out.rms()
    summary |= {
        "handeye": {
            "held_out_position_rms_m": position,
            "held_out_angle_rms_rad": angle,
            "poses": len(outcome.handeye.q),
        },
        "camera_delay_s": {"value": outcome.delay.delay_s, "sigma": outcome.delay.sigma_s},
        "shots": {"measured": len(run.vision), "missed": run.missed, "not_believed": run.outliers},
        "studies": [
            {
                "name": s.name,
                "unit": s.unit,
                "values": s.values.tolist(),
                "position_rms_m": s.position_rms_m.tolist(),
                "predicted_m": s.predicted_m.tolist(),
            }
            for s in finished.studies
        ],
        **finished.facts,
        "ended_by": "interrupted"
        if outcome.interrupted
        else None
        if outcome.ended_by is None
        else str(outcome.ended_by),
    }
    return summary


def _closed(before: RunData, after: RunData, singular_at: list[str]) -> dict[str, Any]:
    """Return the error of the tool against where it was to be, with potentiometers alone and with the loop closed.

    Rests at which the arm is singular stand apart: there it cannot be moved to where it should be.
    """
    found: dict[str, Any] = {"singular_rests": {name: {} for name in singular_at}}
    for when, run in (("before", before), ("after", after)):
        rests = rest_errors(run, judge(run))
        for name in singular_at:
            if name in rests:
                found["singular_rests"][name][f"rest_error_{when}_m"] = rests.pop(name)
        paths = [away for _, away in path_errors(run, judge(run)).values()]
        if rests:
            found[f"rest_error_{when}_m"] = rms(np.array(list(rests.values())))
            found[f"rest_error_{when}_max_m"] = max(rests.values())
        if paths:
            found[f"path_error_{when}_m"] = rms(np.concatenate(paths))
    return found


def _hidden(track: ToolTrack, covered_s: tuple[float, float] | None) -> NDArray[np.bool_]:
    """Return (N,) which rows lie where the body was hidden on purpose, or just after."""
    if covered_s is None:
        return np.zeros(len(track), bool)
    return (track.t_s > covered_s[0] - 0.01) & (track.t_s < covered_s[1] + 0.05)


def _picture(finished: Finished) -> Image | None:
    """Return the left image of the first shot in motion with its pose drawn in."""
    if finished.outcome.picture is None:
        return None
    shot, pose = finished.outcome.picture
    assert shot.left is not None
    return drawn(finished.rig, grey(shot.left), pose)


def _notes(finished: Finished, run: RunData) -> list[str]:
    """Say what was used, what was thrown away and why."""
    outcome = finished.outcome
    assert outcome.handeye is not None
    position, angle = outcome.handeye.found.held_out.rms()
    reasons = Counter(p.reason for _, _, p in outcome.log.poses if isinstance(p, Missed))
    modes = Counter(run.modes.tolist())
    return [
        f"hand-eye: {len(outcome.handeye.q)} poses used, {len(outcome.handeye.missed)} missed; left out, a pose is "
        f"predicted to {1e3 * position:.2f} mm, {np.degrees(angle):.3f} deg RMS: that is how far the arm is from its table",
        *outcome.handeye.missed,
        f"images come {1e3 * outcome.delay.delay_s:.2f} ms late (sigma {1e3 * outcome.delay.sigma_s:.2f} ms), by a sweep",
        f"{len(run.vision)} shots measured, {run.missed} missed, {run.outliers} not believed by the estimator",
        *(f"{count} missed: {reason}" for reason, count in reasons.most_common(5)),
        "commands: " + ", ".join(f"{count} on {mode}" for mode, count in modes.most_common()),
        *([f"ended early: {outcome.ended_by}"] if outcome.ended_by is not None else []),
        *(["ended early: interrupted"] if outcome.interrupted else []),
    ]


def _segment_lines(run: RunData) -> list[str]:
    """Say what happened when."""
    return [f"{s.begin_s:9.3f} s to {s.end_s:9.3f} s  {s.phase:12s} {s.motion}" for s in run.segments]


def drawn(rig: StereoRig, image: Image, estimate: PoseEstimate, axis_m: float = 0.05) -> Image:
    """Draw a measured pose into the left image: the points as dots, the body's axes red, green, blue (x, y, z).

    Args:
        rig: the calibrated pair.
        image: (H, W) grey.
        estimate: the measured pose.
        axis_m: length of the axes.

    Returns:
        (H, W, 3) BGR image.
    """
    out = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    T, shift = estimate.T_left_body, 4
    ends = np.concatenate([T[:3, 3][None], T[:3, 3] + axis_m * T[:3, :3].T, estimate.points.p_left])
    uv = np.round(rig.left.project(ends) * 2**shift).astype(int)
    for i, colour in enumerate(((60, 60, 230), (80, 200, 80), (230, 120, 40)), start=1):
        cv2.arrowedLine(out, tuple(uv[0].tolist()), tuple(uv[i].tolist()), colour, 2, cv2.LINE_AA, shift, 0.12)
    for p in uv[4:]:
        cv2.circle(out, tuple(p.tolist()), 3 << shift, (0, 220, 255), 1, cv2.LINE_AA, shift)
    return out


def open_folder(folder: Path) -> None:
    """Make a run's folder, before the long work begins.

    Raises:
        InputError: it cannot be made or written to, or holds shots that are of no run and would be written over.
    """
    if (folder / "shots").exists() and not (folder / "summary.json").exists():
        raise InputError(f"{folder}: holds shots that are of no earlier run; choose another folder")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(f"{folder}: no run can be written here: {error.strerror}") from None
