"""A run's folder: its tables, its summary, its report. Files are put in place whole; what a broken run measured is kept.

Single files of a run's folder: the joints, the hand-eye calibration, the shots that are kept.

The summary of a run: what summary.json holds.
"""

from __future__ import annotations

import contextlib
import csv
import cv2
import io
import json
import math
import numpy as np
import os
import shutil
import tempfile
import time
from armsight.app.demo.studies import Study
from armsight.app.interrupts import uninterrupted
from armsight.app.measure.poses import UPPER, csv_text, left_axes, pose_record
from armsight.app.record.recording import record
from armsight.app.run.calibrate import HandEyeRun
from armsight.app.run.experiment import Outcome
from armsight.app.run.metrics import judge, path_errors, rest_errors, rms, singular, spread, track_metrics
from armsight.app.run.motion_file import MotionPlan
from armsight.app.run.record import RunData, ToolTrack, assembled, cut, joints_of, write_columns, write_track
from armsight.app.run.report import NAMES, PAGE, RunReport, write_run_report
from armsight.data import Array, Image, Missed, PoseEstimate, Shot
from armsight.errors import ArmsightError, InputError
from armsight.files import write_text
from armsight.geometry.rotation import quaternion_wxyz
from armsight.robot.arm import Arm
from armsight.vision.image import grey
from armsight.vision.rig import StereoRig
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from numpy.typing import NDArray
from pathlib import Path
from typing import Any


def joint_columns(t_s: Array, q: Array, q_ref: Array) -> dict[str, Any]:
    """Return the joints' columns: measured and wanted angles."""
    named: dict[str, Any] = {"t_s": np.round(t_s, 6)}
    for joint in range(6):
        named[f"q{joint + 1}_rad"] = np.round(q[:, joint], 9)
        named[f"q{joint + 1}_wanted_rad"] = np.round(q_ref[:, joint], 9)
    return named


def write_handeye(folder: Path, run: HandEyeRun) -> None:
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


def write_shots(folder: Path, shots: Sequence[Shot]) -> None:
    """Write the kept shots as a recording; it is there whole or not at all.

    Args:
        folder: to be made.
        shots: none makes no folder.

    Raises:
        InputError: it cannot be written, the disk is full.
        KeyboardInterrupt: it came meanwhile.
    """
    left = iter(shots)

    class Kept:
        def read(self) -> Shot | None:
            return next(left, None)

        def close(self) -> None:
            pass

    if not shots:
        return
    try:
        with tempfile.TemporaryDirectory(prefix=f".{folder.name}.", dir=folder.parent) as place:
            stored = record(Kept(), Path(place) / folder.name)
            if stored.interrupted:
                raise KeyboardInterrupt
            if stored.stopped is not None:
                raise InputError(stored.stopped.replace(str(stored.directory), str(folder)))
            os.replace(stored.directory, folder)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written: {error.strerror}") from None


def summary_of(
    arm: Arm,
    outcome: Outcome,
    plan: MotionPlan,
    run: RunData,
    before: RunData | None,
    after: RunData | None,
    studies: Sequence[Study],
    facts: Mapping[str, Any],
) -> dict[str, Any]:
    """Return the figures of a run, SI units in the keys.

    Args:
        arm: the nominal arm.
        outcome: what was measured; its hand-eye calibration is there.
        plan: what was to be done.
        run: all of it.
        before: the motions with potentiometers alone; None where they were not made.
        after: the same with the loop closed; None likewise.
        studies: made after it.
        facts: what else to say.
    """
    assert outcome.handeye is not None
    position, angle = outcome.handeye.found.held_out.rms()
    summary: dict[str, Any] = {} if before is None else _against_truth(before, outcome.covered_s)
    if before is not None and after is not None:
        goals = {m.name: m.trajectory.at(m.trajectory.duration_s).q for m in plan.motions}
        summary["closed_loop"] = _closed(before, after, [n for n, q in goals.items() if singular(arm, q)])
    if len(run.latency_s):
        summary["latency_s"] = spread(run.latency_s)
    return summary | {
        "handeye": {
            "held_out_position_rms_m": position,
            "held_out_angle_rms_rad": angle,
            "poses": len(outcome.handeye.q),
        },
        "camera_delay_s": {"value": outcome.delay.delay_s, "sigma": outcome.delay.sigma_s},
        "shots": {"measured": len(run.vision), "missed": run.missed, "rejected": run.outliers},
        "studies": [_study(study) for study in studies],
        **facts,
        "ended_by": outcome.said,
    }


def _study(study: Study) -> dict[str, Any]:
    """Return a study's figures."""
    return {
        "name": study.name,
        "unit": study.unit,
        "values": study.values.tolist(),
        "position_rms_m": study.position_rms_m.tolist(),
        "predicted_m": study.predicted_m.tolist(),
    }


def _against_truth(before: RunData, covered_s: tuple[float, float] | None) -> dict[str, Any]:
    """Return how far each track of the motions is from the truth, with the body in view and hidden; empty without one."""
    found: dict[str, Any] = {}
    if before.truth is None:
        return found
    for name in ("vision", "potentiometers", "fused", "live"):
        track: ToolTrack = getattr(before, name)
        seen = ~_hidden(track, covered_s)
        moving, resting = (track.phase == "open_loop") & seen, (track.phase == "rest") & seen
        if moving.any() and resting.any():
            at_rest = track_metrics(track[resting], before.truth)["position_rms_m"]
            found[name] = {**track_metrics(track[moving], before.truth), "rest_position_rms_m": at_rest}
    if covered_s is not None and (before.t_s > covered_s[0]).any():
        found["occlusion"] = {"duration_s": float(np.ptp(covered_s))}
        for name in ("fused", "live"):
            track = getattr(before, name)
            figures = track_metrics(track[_hidden(track, covered_s)], before.truth)
            found["occlusion"] |= {
                f"{name}_position_rms_m": figures["position_rms_m"],
                f"{name}_position_max_m": figures["position_max_m"],
            }
    return found


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


#: Files of tracks, and the fields of RunData they hold.
_TRACKS = ("truth", "potentiometers", "vision", "fused", "live", "wanted")
_SHOTS = "shots"
#: What a command was based on -> how run.log says it.
_BASED = {"planned": "as planned", "vision": "on vision", "bridged": "on the model while vision was missing"}


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
        began: when it began, by ``time.perf_counter``, s.
        studies: made after it.
        cell: gives the cell seen from aside, (H, W, 3) BGR, waiting until it is drawn; None for a real one.
    """

    arm: Arm
    rig: StereoRig
    outcome: Outcome
    plan: MotionPlan
    truth: tuple[Array, Array] | None
    facts: Mapping[str, Any]
    began: float
    studies: Sequence[Study]
    cell: Callable[[], Image] | None


def finish(finished: Finished, folder: Path) -> dict[str, Any]:
    """Write everything a run measured, and raise what ended it early.

    Returns:
        The summary, as summary.json has it.

    Raises:
        ArmsightError: what ended the run early, or that not all of it could be written; what could is whole.
        KeyboardInterrupt: it was interrupted, or its writing was.
    """
    outcome = finished.outcome
    ended = f"{outcome.said}; the arm was stopped" if outcome.said is not None else ""
    try:
        summary = write_run(finished, folder)
    except InputError as error:
        told = f"{ended}, and not all could be written: " if ended else ""
        raise InputError(f"{told}{error}; what was written before is in {folder}") from None
    if outcome.ended_by is not None:
        raise ArmsightError(f"{ended}; what was measured until then is in {folder}")
    if outcome.interrupted:
        raise KeyboardInterrupt
    return summary


def write_run(finished: Finished, folder: Path) -> dict[str, Any]:
    """Write everything a run measured; an interrupt has to wait until all is there but the report.

    Returns:
        The summary.

    Raises:
        InputError: a file cannot be written; those that were stay whole.
        KeyboardInterrupt: it came meanwhile.
    """
    with uninterrupted() as came:
        summary, report = _write_measured(finished, folder)
    if came:
        raise KeyboardInterrupt
    if report is not None:
        write_run_report(report, folder)
        summary["wall_s"] = _wall_s(finished)  # drawing takes its time, too
        _write_summary(folder, summary)
    return summary


def _write_measured(finished: Finished, folder: Path) -> tuple[dict[str, Any], RunReport | None]:
    """Write the tables and the summary; returns it, and what the report is to show where there is enough for one."""
    outcome, facts = finished.outcome, {**finished.facts, "wall_s": _wall_s(finished)}
    with _as_much_as_fits() as keep:
        keep(write_text, folder / "poses.csv", csv_text(_pose_records(finished)))
        if outcome.handeye is None:
            if outcome.log.joints:
                keep(write_columns, folder, "joints", joint_columns(*joints_of(outcome.log)))
            summary = _known({**facts, "ended_by": outcome.said})
            keep(_write_summary, folder, summary)
            return summary, None
        keep(write_handeye, folder, outcome.handeye)
        mounting = outcome.handeye.mounting
        run = assembled(outcome.log, finished.arm, mounting, outcome.delay, finished.truth)
        keep(write_columns, folder, "joints", joint_columns(run.t_s, run.q, run.q_ref))
        for name, track in _tracks(run).items():
            keep(write_track, folder, name, track)
        before, after = (None if span is None else cut(run, *span) for span in (outcome.open_s, outcome.closed_s))
        figures = summary_of(finished.arm, outcome, finished.plan, run, before, after, finished.studies, facts)
        summary, notes = _known(figures), _notes(finished, run)
        keep(_write_summary, folder, summary)
        keep(write_text, folder / "run.log", "\n".join([*notes, *_segment_lines(run)]) + "\n")
        keep(write_shots, folder / _SHOTS, outcome.kept)
    shown = run if outcome.open_s is None else cut(run, outcome.open_s[0], run.t_s[-1])
    cell = None if finished.cell is None else finished.cell()
    return summary, RunReport(summary, shown, before, after, finished.studies, _picture(finished), cell, notes)


@contextlib.contextmanager
def _as_much_as_fits() -> Iterator[Callable[..., None]]:
    """Write file after file, also after one that could not be written; the first such is told at the end.

    The block is handed a function that calls what writes a file, in a thread beside what the block goes on with.
    """
    asked: list[Future[object]] = []
    with ThreadPoolExecutor(1) as writer:
        yield lambda write, *arguments: asked.append(writer.submit(write, *arguments))
    failed = [error for each in asked if (error := each.exception()) is not None]
    for error in failed:
        if not isinstance(error, InputError):
            raise error
    if failed:
        raise failed[0]


def _wall_s(finished: Finished) -> float:
    """Return how long the run has taken by now, s."""
    return time.perf_counter() - finished.began


def _write_summary(folder: Path, summary: dict[str, Any]) -> None:
    """Write summary.json."""
    write_text(folder / "summary.json", json.dumps(summary, indent=1, allow_nan=False) + "\n")


def _known(value: Any) -> Any:  # noqa: ANN401 - whatever JSON holds
    """Return a value as JSON can hold it: None, there null, for every number in it that is not known."""
    if isinstance(value, Mapping):
        return {key: _known(one) for key, one in value.items()}
    if isinstance(value, list):
        return [_known(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def make_room(folder: Path) -> None:
    """Take away what an earlier run left here: none of it is to lie beside this one's.

    Raises:
        InputError: something cannot be taken away.
    """
    names = [f"{name}.png" for name in (*NAMES, "pose", "cell")]
    names += [f"{name}.{kind}" for name in (*_TRACKS, "joints") for kind in ("csv", "parquet")]
    names += [PAGE, "run.log", "poses.csv", "handeye.json", "handeye_poses.csv"]
    try:
        if (folder / _SHOTS).is_dir():
            shutil.rmtree(folder / _SHOTS)
        for name in (*names, "summary.json"):  # by which an earlier run is known: the last to go
            (folder / name).unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{error.filename}: an earlier run's file cannot be removed: {error.strerror}") from None


def _tracks(run: RunData) -> dict[str, ToolTrack]:
    """Return the tracks that are written, by the name of their file."""
    tracks = {name: getattr(run, name) for name in _TRACKS}
    return {name: track for name, track in tracks.items() if track is not None}


def _pose_records(finished: Finished) -> list[dict[str, Any]]:
    """Return what vision measured shot by shot, in the left camera's frame, as ``measure`` writes it."""
    body = finished.outcome.body
    return [pose_record(name, float(t), body, result) for name, t, result in finished.outcome.log.poses]


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
        "commands: " + ", ".join(f"{count} {_BASED.get(mode, f'on {mode}')}" for mode, count in modes.most_common()),
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
