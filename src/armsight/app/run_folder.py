"""A run's folder: its tables, its summary, its report. Files are put in place whole; what a broken run measured is kept."""

from __future__ import annotations

import csv
import io
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

from armsight.app.experiment import Outcome
from armsight.app.motion_file import MotionPlan
from armsight.app.poses import UPPER, csv_text, left_axes, pose_record
from armsight.app.recording import record
from armsight.app.run_calibrate import HandEyeRun
from armsight.app.run_data import RunData, assembled, cut, joints_of
from armsight.app.run_report import FIGURES, PAGE, RunReport, write_run_report
from armsight.app.run_summary import summary_of
from armsight.app.run_tracks import ToolTrack, write_columns, write_track
from armsight.app.studies import Study
from armsight.data import Array, Image, Missed, PoseEstimate, Shot
from armsight.errors import InputError
from armsight.files import write_text
from armsight.geometry.rotation import quaternion_wxyz
from armsight.robot.arm import Arm
from armsight.vision.image import grey
from armsight.vision.rig import StereoRig

#: Files of tracks, and the fields of RunData they hold.
_TRACKS = ("truth", "potentiometers", "vision", "fused", "live", "wanted")
_SHOTS = "shots"


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
    _make_room(folder)
    if outcome.log.joints:
        write_columns(folder, "joints", _joint_columns(*joints_of(outcome.log)))
    write_text(folder / "poses.csv", csv_text(_pose_records(finished)))
    if outcome.handeye is not None:
        _write_handeye(folder, outcome.handeye)
    if outcome.handeye is None or not outcome.log.segments:
        summary = {**finished.facts, "ended_by": outcome.said}
        write_text(folder / "summary.json", json.dumps(summary, indent=1) + "\n")
        return summary
    mounting = outcome.handeye.mounting
    run = assembled(outcome.log, finished.arm, mounting, outcome.delay.delay_s, finished.truth)
    for name, track in _tracks(run).items():
        write_track(folder, name, track)
    _write_shots(folder / _SHOTS, outcome.kept)
    before, after = (None if span is None else cut(run, *span) for span in (outcome.open_s, outcome.closed_s))
    summary = summary_of(finished.arm, outcome, finished.plan, run, before, after, finished.studies, finished.facts)
    write_text(folder / "summary.json", json.dumps(summary, indent=1) + "\n")
    notes = _notes(finished, run)
    write_text(folder / "run.log", "\n".join([*notes, *_segment_lines(run)]) + "\n")
    shown = run if outcome.open_s is None else cut(run, outcome.open_s[0], run.t_s[-1])
    report = RunReport(summary, shown, before, after, finished.studies, _picture(finished), finished.cell, notes)
    write_run_report(report, folder)
    return summary


def _make_room(folder: Path) -> None:
    """Take away what an earlier run left here: none of it is to lie beside this one's."""
    for name in (*FIGURES, "pose", "cell"):
        (folder / f"{name}.png").unlink(missing_ok=True)
    for name in (*_TRACKS, "joints"):
        (folder / f"{name}.csv").unlink(missing_ok=True)
        (folder / f"{name}.parquet").unlink(missing_ok=True)
    for name in (PAGE, "summary.json", "run.log", "poses.csv", "handeye.json", "handeye_poses.csv"):
        (folder / name).unlink(missing_ok=True)
    if (folder / _SHOTS).is_dir():
        shutil.rmtree(folder / _SHOTS)


def _tracks(run: RunData) -> dict[str, ToolTrack]:
    """Return the tracks that are written, by the name of their file."""
    tracks = {name: getattr(run, name) for name in _TRACKS}
    return {name: track for name, track in tracks.items() if track is not None}


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
    T = run.Ts_left_body
    covs = [left_axes(one, cov) for one, cov in zip(T, run.covs, strict=True)]
    named = {f"q{i + 1}_rad": run.q[:, i] for i in range(6)}
    named |= {f"{axis}_m": T[:, i, 3] for i, axis in enumerate("xyz")}
    turns = np.array([quaternion_wxyz(one[:3, :3]) for one in T])
    named |= {f"q{axis}": turns[:, i] for i, axis in enumerate("wxyz")}
    named |= {f"cov_{i}{j}": np.array([cov[i, j] for cov in covs]) for i, j in UPPER}
    named |= {f"approach{i + 1}": run.approach[:, i].astype(int) for i in range(6)}
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(named)
    writer.writerows(zip(*named.values(), strict=True))
    write_text(folder / "handeye_poses.csv", out.getvalue())


def _write_shots(folder: Path, shots: Sequence[Shot]) -> None:
    """Write the kept shots as a recording."""
    left = iter(shots)

    class Kept:
        def read(self) -> Shot | None:
            return next(left, None)

        def close(self) -> None:
            pass

    record(Kept(), folder)


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
        f"images come {1e3 * outcome.delay.delay_s:.2f} ms late (sigma {1e3 * outcome.delay.sigma_s:.2f} ms), by a sweep"
        if outcome.delay_found
        else f"how late the images come was not found: {1e3 * outcome.delay.delay_s:g} ms taken",
        f"{len(run.vision)} shots measured, {run.missed} missed, {run.outliers} not believed by the estimator",
        *(f"{count} missed: {reason}" for reason, count in reasons.most_common(5)),
        "commands: " + ", ".join(f"{count} on {mode}" for mode, count in modes.most_common()),
        *([] if outcome.said is None else [f"ended early: {outcome.said}"]),
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
    if (folder / _SHOTS).exists() and not (folder / "summary.json").exists():
        raise InputError(f"{folder}: holds shots that are of no earlier run; choose another folder")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(f"{folder}: no run can be written here: {error.strerror}") from None
