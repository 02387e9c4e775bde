"""A run's folder: its tables, its summary, its report. Files are put in place whole; what a broken run measured is kept."""

from __future__ import annotations

import contextlib
import json
import math
import shutil
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from armsight.app.run.experiment import Outcome
from armsight.app.interrupts import uninterrupted
from armsight.app.run.motion_file import MotionPlan
from armsight.app.measure.poses import csv_text, pose_record
from armsight.app.run_data import RunData, assembled, cut, joints_of
from armsight.app.run_files import joint_columns, write_handeye, write_shots
from armsight.app.run.report import (FIGURES, PAGE, RunReport, write_run_report)
from armsight.app.run_summary import summary_of
from armsight.app.run_tracks import ToolTrack, write_columns, write_track
from armsight.app.demo.studies import Study
from armsight.data import Array, Image, Missed, PoseEstimate
from armsight.errors import ArmsightError, InputError
from armsight.files import write_text
from armsight.robot.arm import Arm
from armsight.vision.image import grey
from armsight.vision.rig import StereoRig

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
        keep(write_columns, folder, "joints", joint_columns(run.t_s, run.q, run.q_wanted))
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
    names = [f"{name}.png" for name in (*FIGURES, "pose", "cell")]
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
