"""The folder of a run: :func:`finish` writes all that a run measured, and raises what ended the run early.

In: a :class:`Finished` run. Out: tracks and joints as CSV and Parquet, the hand-eye calibration, the kept shots,
summary.json, run.log, the report and its figures. Each file is complete or not there at all; a run that ended early has
everything that was measured until then. :func:`open_folder` and :func:`make_room` prepare a folder before the run,
:func:`run_in` runs on real devices.
"""

from __future__ import annotations

import contextlib
import csv
import io
import json
import os
import shutil
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from armsight.app.interrupts import uninterrupted
from armsight.app.record.recording import record
from armsight.app.run.calibrate import HandEyeRun
from armsight.app.run.experiment import RunResult, run_experiment
from armsight.app.run.metrics import Study
from armsight.app.run.motion_file import MotionPlan
from armsight.app.run.record import Log, RunData, ToolTrack, assembled, cut, joints_of, write_columns, write_track
from armsight.app.run.report import NAMES, Beside, RunReport, drawn_beside, write_run_report
from armsight.app.run.setup import Setup
from armsight.app.run.summary import RunSummary, summary_of
from armsight.app.show.page import PAGE, writable_folder
from armsight.app.stream.datum import Published
from armsight.app.stream.mcap_file import RUN_MCAP, LazyMcap, properties
from armsight.app.stream.sink import Fanout
from armsight.app.stream.streams import open_streams
from armsight.data import Array, Correspondences, Image, Missed, PoseEstimate, Shot
from armsight.errors import ArmsightError, InputError
from armsight.files import check_folder, write_text
from armsight.geometry.pose import inverse, log_se3
from armsight.geometry.rotation import quaternion_wxyz
from armsight.loop.estimators import Mounting
from armsight.loop.health import health_lines, unseen_lines
from armsight.loop.health.follow import correction_lines
from armsight.robot.kinematics.arm import Arm
from armsight.vision.detections import detections_text
from armsight.vision.image import grey
from armsight.vision.pose.shot_pose import UPPER, ShotPose, csv_text, left_axes, shot_pose
from armsight.vision.rig import StereoRig
from armsight.vision.sources import Source


def joint_columns(t_s: Array, q: Array, q_ref: Array) -> dict[str, Any]:
    """Return the columns of joints.csv: times (N,), s, measured and reference angles (N, n), rad."""
    named: dict[str, Any] = {"t_s": np.round(t_s, 6)}
    for joint in range(q.shape[1]):
        named[f"q{joint + 1}_rad"] = np.round(q[:, joint], 9)
        named[f"q{joint + 1}_ref_rad"] = np.round(q_ref[:, joint], 9)
    return named


def write_handeye(folder: Path, run: HandEyeRun, corrected: Sequence[tuple[float, Mounting]] = ()) -> None:
    """Write the hand-eye calibration, and the poses it was made from as ``armsight identify`` reads them.

    Args:
        folder: of the run.
        run: the calibration.
        corrected: mountings of a rig that was put right, and from when on, s: the last one is written as the current one.
    """
    found, (position, angle) = run.found, run.found.held_out.rms()
    newest = corrected[-1][1] if corrected else run.mounting
    calibration: dict[str, Any] = {
        "T_base_rig": newest.T_base_rig.tolist(),
        "T_tool_body": newest.T_tool_body.tolist(),
        "cov": (found.cov + newest.cov - run.mounting.cov).tolist(),
        "held_out_position_rms_m": position,
        "held_out_angle_rms_rad": angle,
        "sigma_flange_m": found.sigma_flange[0],
        "sigma_flange_rad": found.sigma_flange[1],
        "structure": found.structure,
        "poses": len(run.q),
        "missed": list(run.missed),
    }
    if corrected:
        calibration |= {"since_s": corrected[-1][0], "T_base_rig_before": run.mounting.T_base_rig.tolist()}
    write_text(folder / "handeye.json", json.dumps(calibration, indent=1) + "\n")
    T = run.Ts_left_body
    covs = [left_axes(one, cov) for one, cov in zip(T, run.covs, strict=True)]
    named = {f"q{i + 1}_rad": run.q[:, i] for i in range(run.q.shape[1])}
    named |= {f"{axis}_m": T[:, i, 3] for i, axis in enumerate("xyz")}
    quaternions = np.array([quaternion_wxyz(one[:3, :3]) for one in T])
    named |= {f"q{axis}": quaternions[:, i] for i, axis in enumerate("wxyz")}
    named |= {f"cov_{i}{j}": np.array([cov[i, j] for cov in covs]) for i, j in UPPER}
    named |= {f"approach{i + 1}": run.approach[:, i].astype(int) for i in range(run.q.shape[1])}
    output = io.StringIO()
    writer = csv.writer(output, lineterminator="\n")
    writer.writerow(named)
    writer.writerows(zip(*named.values(), strict=True))
    write_text(folder / "handeye_poses.csv", output.getvalue())


def write_shots(folder: Path, shots: Sequence[Shot]) -> None:
    """Write the kept shots as a recording; it is complete or not there at all.

    Args:
        folder: to be made.
        shots: the shots; without any no folder is made.

    Raises:
        InputError: it cannot be written, the disk is full.
        KeyboardInterrupt: the keyboard interrupted the writing.
    """
    left = iter(shots)

    class Kept(Source):
        count = len(shots)

        def read(self) -> Shot | None:
            return next(left, None)

        def close(self) -> None:
            pass

    if not shots:
        return
    try:
        with tempfile.TemporaryDirectory(prefix=f".{folder.name}.", dir=folder.parent) as temporary:
            stored = record(Kept(), Path(temporary) / folder.name)
            if stored.interrupted:
                raise KeyboardInterrupt
            if stored.stopped is not None:
                raise InputError(stored.stopped.replace(str(stored.directory), str(folder)))
            os.replace(stored.directory, folder)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written: {error.strerror}") from None


#: Files of tracks, and the fields of RunData they hold.
_TRACKS = ("truth", "potentiometers", "vision", "fused", "live", "reference")
#: Those of runs of version 1.
_OLD_TRACKS, _OLD_FIGURES = ("wanted",), ("cell",)
_SHOTS = "shots"
#: File of the detections of a run, for `armsight rig update`: at most so many shots, whose poses differ by so much, m, rad.
_FOLLOWED = "rig_followed.json"
DETECTIONS, _MOST_SHOTS, _DIFFERENT = "detections.csv", 400, 0.01
#: Basis of a command -> its text in run.log.
_BASED = {
    "planned": "as planned",
    "vision": "on vision",
    "bridged": "on the model while vision was missing",
    "potentiometers": "with the last correction, vision lost",
    "held": "with the correction held, as vision contradicted what was learned",
    "distrusted": "on the joint sensors, with what was learned before, as vision was wrong",
}


@dataclass(frozen=True)
class Finished:
    """A run that has ended.

    Attributes:
        arm: the nominal arm.
        rig: the calibrated cameras.
        outcome: what was measured.
        plan: the motions.
        truth: times (N,), s, and poses (N, 4, 4) of the tool in the base frame; None for a real arm.
        properties: what the run was of, as summary.json names it: arm, board, seed.
        began: when it began, by ``time.perf_counter``, s.
        studies: made after it.
        overview: returns an image (H, W, 3) BGR of the workcell from aside, waiting until it is rendered; None for a real
            arm.
        second: calls a function in another process, which draws about half of the figures; None without one.
    """

    arm: Arm
    rig: StereoRig
    outcome: RunResult
    plan: MotionPlan
    truth: tuple[Array, Array] | None
    properties: Mapping[str, Any]
    began: float
    studies: Sequence[Study]
    overview: Callable[[], Image] | None
    second: Callable[..., Any] | None = None


def run_in(
    folder: Path,
    setup: Setup,
    rig: StereoRig,
    plan: MotionPlan,
    targets: Array,
    files: Mapping[str, str],
    *,
    command: str,
    say: Callable[[str], None],
    streams: Sequence[str] = (),
    **how: Any,  # noqa: ANN401 - options of run_experiment
) -> Finished:
    """Run the experiment on real devices, with run.mcap in its folder and streams beside.

    ``files`` are the texts of motion.toml and body.toml, which are written first; run.mcap says which ``command`` made it;
    ``say`` is given what could not be recorded or published; ``how`` and the rest is as :func:`run_experiment` takes it.
    """
    began = time.perf_counter()
    make_room(folder)
    for name, text in files.items():
        write_text(folder / name, text)
    rig.save(folder / "rig.json")
    texts = properties(rig, files["body.toml"], setup.arm, command=command)
    published = Published(rig, setup.target.body, setup.arm, texts)
    with contextlib.ExitStack() as stack:
        file = stack.enter_context(contextlib.closing(LazyMcap(folder, published, say)))
        beside = stack.enter_context(contextlib.closing(open_streams(streams, published, say)))
        outcome = run_experiment(setup, rig, plan, targets, publisher=Fanout((file, beside)), **how)
    of_run = {"arm": setup.arm.name, "board": setup.board.welcome.board}
    return Finished(setup.arm, rig, outcome, plan, None, of_run, began, [], None)


def finish(finished: Finished, folder: Path) -> RunSummary:
    """Write everything a run measured, and raise what ended it early.

    Returns:
        The summary.

    Raises:
        ArmsightError: what ended the run early, or that not all files could be written; those that were are complete.
        KeyboardInterrupt: the keyboard interrupted the run, or the writing.
    """
    outcome = finished.outcome
    ended = f"{outcome.ended_text}; the arm was stopped" if outcome.ended_text is not None else ""
    try:
        summary = write_run(finished, folder)
    except InputError as error:
        reason = f"{ended}, and not all could be written: " if ended else ""
        raise InputError(f"{reason}{error}; what was written before is in {folder}") from None
    if outcome.ended_by is not None:
        suspected = "".join(f"; {line}" for line in health_lines(outcome.health))
        raise ArmsightError(f"{ended}; what was measured until then is in {folder}{suspected}")
    if outcome.interrupted:
        raise KeyboardInterrupt
    return summary


def write_run(finished: Finished, folder: Path) -> RunSummary:
    """Write everything a run measured; an interrupt waits until all files but the report are written.

    Returns:
        The summary.

    Raises:
        InputError: a file cannot be written; the others are complete.
        KeyboardInterrupt: the keyboard interrupted the writing.
    """
    with uninterrupted() as came:
        summary, report, beside = _write_measured(finished, folder)
    if came:
        raise KeyboardInterrupt
    if report is not None:
        write_run_report(report, folder, beside)
        summary = replace(summary, wall_s=_wall_s(finished))  # with the time that plotting took
        _write_summary(folder, summary)
    return summary


def _write_measured(finished: Finished, folder: Path) -> tuple[RunSummary, RunReport | None, Beside | None]:
    """Write the tables and the summary.

    Returns:
        The summary; the contents of the report, if there is enough for one; what waits for the figures that the second
        process draws meanwhile.
    """
    outcome, wall_s = finished.outcome, _wall_s(finished)
    with _as_much_as_fits() as keep:
        keep(write_text, folder / "poses.csv", csv_text(_shot_poses(finished)))
        if drawn := _drawn_shots(outcome.log):
            keep(write_text, folder / DETECTIONS, detections_text(drawn, outcome.body))
        if updates := [each.update for each in outcome.log.corrections if each.update is not None]:
            made = {"command": "run --follow-rig", "before": dict(finished.rig.provenance)}
            keep(replace(updates[-1].rig, provenance=made).save, folder / _FOLLOWED)
        if outcome.handeye is None:
            if outcome.log.joints:
                keep(write_columns, folder, "joints", joint_columns(*joints_of(outcome.log)))
            summary = RunSummary(
                finished.properties,
                wall_s,
                outcome.ended_text,
                {},
                health=outcome.health,
                fixed_unseen=outcome.fixed_unseen,
                corrections=outcome.log.corrections,
                not_corrected=outcome.not_corrected,
                sync_led=None if outcome.led is None else outcome.led.to_json(),
            )
            keep(_write_summary, folder, summary)
            return summary, None, None
        keep(write_handeye, folder, outcome.handeye, outcome.log.mountings)
        if outcome.shutters is not None:
            keep(replace(finished.rig, shutters=outcome.shutters).save, folder / "rig.json")
        mounting = outcome.handeye.mounting
        run = assembled(outcome.log, finished.arm, mounting, outcome.delay, finished.truth, outcome.changes)
        before, after = (None if span is None else cut(run, *span) for span in (outcome.open_s, outcome.closed_s))
        summary = summary_of(
            finished.arm, outcome, finished.plan, run, before, after, finished.studies, finished.properties, wall_s
        )
        notes = _notes(finished, run)
        shown = run if outcome.open_s is None else cut(run, outcome.open_s[0], run.t_s[-1])
        report = RunReport(summary, shown, before, after, _picture(finished), None, notes)
        beside = None if finished.second is None else drawn_beside(report, finished.second)
        keep(write_columns, folder, "joints", joint_columns(run.t_s, run.q, run.q_ref))
        for name, track in _tracks(run).items():
            keep(write_track, folder, name, track)
        keep(_write_summary, folder, summary)
        keep(write_text, folder / "run.log", "\n".join([*notes, *_segment_lines(run)]) + "\n")
        keep(write_shots, folder / _SHOTS, outcome.kept)
    overview = None if finished.overview is None else finished.overview()
    return summary, replace(report, workcell=overview), beside


@contextlib.contextmanager
def _as_much_as_fits() -> Iterator[Callable[..., None]]:
    """Write file after file, also after one that could not be written; the first error is raised at the end.

    The block is given a function that writes a file: it calls its first argument with the others, in a thread.
    """
    asked: list[Future[object]] = []
    with ThreadPoolExecutor(1) as writer:
        yield lambda write, *arguments: asked.append(writer.submit(write, *arguments))
    failed = [error for each in asked if (error := each.exception()) is not None]
    for error in failed:
        if not isinstance(error, InputError | OSError):
            raise error
    if failed and isinstance(failed[0], OSError):
        raise InputError(f"{failed[0].filename or 'the run'}: cannot be written: {failed[0].strerror}")
    if failed:
        raise failed[0]


def _wall_s(finished: Finished) -> float:
    """Return how long the run has taken by now, s."""
    return time.perf_counter() - finished.began


def _write_summary(folder: Path, summary: RunSummary) -> None:
    """Write summary.json."""
    write_text(folder / "summary.json", json.dumps(summary.to_json(), indent=1, allow_nan=False) + "\n")


def make_room(folder: Path) -> None:
    """Make a run's folder; remove the files of an earlier run from it, so that they are not mixed with those of this run.

    Raises:
        InputError: the folder cannot be made or written to, or a file cannot be removed.
    """
    writable_folder(folder, "no run")
    names = [f"{name}.png" for name in (*NAMES, "pose", "workcell", *_OLD_FIGURES)]
    names += [f"{name}.{kind}" for name in (*_TRACKS, *_OLD_TRACKS, "joints") for kind in ("csv", "parquet")]
    names += [PAGE, "run.log", "poses.csv", DETECTIONS, _FOLLOWED, "handeye.json", "handeye_poses.csv", RUN_MCAP]
    try:
        if (folder / _SHOTS).is_dir():
            shutil.rmtree(folder / _SHOTS)
        for name in (*names, "summary.json"):  # last, as an earlier run is recognised by it
            (folder / name).unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{error.filename}: an earlier run's file cannot be removed: {error.strerror}") from None


def _tracks(run: RunData) -> dict[str, ToolTrack]:
    """Return the tracks that are written, by the name of their file."""
    tracks = {name: getattr(run, name) for name in _TRACKS}
    return {name: track for name, track in tracks.items() if track is not None}


def _shot_poses(finished: Finished) -> list[ShotPose]:
    """Return what vision measured shot by shot, in the left camera's frame, as ``measure`` writes it."""
    body = finished.outcome.body
    return [shot_pose(name, float(t), body, result) for name, t, result in finished.outcome.log.poses]


def _drawn_shots(log: Log) -> list[tuple[str, float | None, Correspondences]]:
    """Return name, time and detections of shots whose poses differ: others say little more about the cameras."""
    kept: list[tuple[str, float | None, Correspondences]] = []
    last: Array | None = None
    for name, t_s, pose in log.poses:
        if not isinstance(pose, PoseEstimate):
            continue
        if last is None or np.abs(log_se3(inverse(last) @ pose.T_left_body)).max() > _DIFFERENT:
            last = pose.T_left_body
            kept.append((name, t_s if np.isfinite(t_s) else None, pose.points.seen))
    return kept[:: -(-len(kept) // _MOST_SHOTS) or 1]


def _picture(finished: Finished) -> Image | None:
    """Return the left image of the first shot in motion with its pose overlaid."""
    if finished.outcome.picture is None:
        return None
    shot, pose = finished.outcome.picture
    assert shot.left is not None
    return overlaid(finished.rig, grey(shot.left), pose)


def _notes(finished: Finished, run: RunData) -> list[str]:
    """Return lines on what was used, and what was left out and why."""
    outcome = finished.outcome
    assert outcome.handeye is not None
    position, angle = outcome.handeye.found.held_out.rms()
    reasons = Counter(p.reason for _, _, p in outcome.log.poses if isinstance(p, Missed))
    modes = Counter(run.modes.tolist())
    return [
        *health_lines(outcome.health),
        *unseen_lines(outcome.fixed_unseen),
        *correction_lines(outcome.log.corrections, outcome.not_corrected),
        f"hand-eye: {len(outcome.handeye.q)} poses used, {len(outcome.handeye.missed)} missed; left out, a pose is "
        f"predicted to {1e3 * position:.2f} mm, {np.degrees(angle):.3f} deg RMS: the error of the arm's nominal table",
        *outcome.handeye.missed,
        f"delay of the images, by {'a sweep' if outcome.led is None else 'the sync LED'}:"
        f" {1e3 * outcome.delay.delay_s:.2f} ms, sigma {1e3 * outcome.delay.sigma_s:.2f} ms"
        if outcome.delay_found
        else f"the delay of the images was not measured: {1e3 * outcome.delay.delay_s:g} ms assumed",
        *(
            []
            if outcome.shutters is None
            else [f"exposures: {outcome.shutters}; detections were moved to one time by the motion of the arm"]
        ),
        *([] if outcome.led is None else [str(outcome.led)]),
        f"{len(run.vision)} shots measured, {run.missed} missed, {run.rejected} rejected by the estimator",
        *(f"{count} missed: {reason}" for reason, count in reasons.most_common(5)),
        "commands: " + ", ".join(f"{count} {_BASED.get(mode, f'on {mode}')}" for mode, count in modes.most_common()),
        *([] if outcome.ended_text is None else [f"ended early: {outcome.ended_text}"]),
    ]


def _segment_lines(run: RunData) -> list[str]:
    """Return a line for every motion and rest, with its times."""
    return [f"{s.begin_s:9.3f} s to {s.end_s:9.3f} s  {s.phase:12s} {s.motion}" for s in run.segments]


def overlaid(rig: StereoRig, image: Image, estimate: PoseEstimate, axis_m: float = 0.05) -> Image:
    """Overlay a measured pose on the left image: the points as circles, the body's axes red, green, blue (x, y, z).

    Args:
        rig: the calibrated pair.
        image: (H, W) grey.
        estimate: the measured pose.
        axis_m: length of the axes, m.

    Returns:
        (H, W, 3) BGR image.
    """
    canvas = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    T, shift = estimate.T_left_body, 4
    ends = np.concatenate([T[:3, 3][None], T[:3, 3] + axis_m * T[:3, :3].T, estimate.points.p_left])
    uv = np.round(rig.left.project(ends) * 2**shift).astype(int)
    for i, colour in enumerate(((60, 60, 230), (80, 200, 80), (230, 120, 40)), start=1):
        cv2.arrowedLine(canvas, tuple(uv[0].tolist()), tuple(uv[i].tolist()), colour, 2, cv2.LINE_AA, shift, 0.12)
    for p in uv[4:]:
        cv2.circle(canvas, tuple(p.tolist()), 3 << shift, (0, 220, 255), 1, cv2.LINE_AA, shift)
    return canvas


def open_folder(folder: Path) -> None:
    """Check that a run can be written to a folder, before the long work begins; it is not made yet.

    Raises:
        InputError: it cannot be made or written to, or holds shots that are not of a run and would be overwritten.
    """
    check_folder(folder, problem="no run can be written here")
    if (folder / _SHOTS).exists() and not (folder / "summary.json").exists():
        raise InputError(f"{folder}: holds shots that are not of an earlier run; choose another folder")
