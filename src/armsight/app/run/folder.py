"""The folder of a run: :func:`finish` writes all that a run measured, and raises what ended the run early.

In: a :class:`~armsight.app.run.experiment.RunResult`. Out: tracks and joints as CSV, the hand-eye calibration, kept shots,
summary.json, run.log, the report and its figures. Each file is complete or not there at all.
"""

from __future__ import annotations

import contextlib
import csv
import json
import os
import shutil
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from armsight.app.interrupts import uninterrupted
from armsight.app.record.recording import record
from armsight.app.run.experiment import RunResult, run_experiment
from armsight.app.run.metrics import Study
from armsight.app.run.motion_file import MotionPlan
from armsight.app.run.report import notes_of, report_of
from armsight.app.run.tracks import NAMES, Part, Tracks, columns, joint_columns, references, write_columns
from armsight.app.show.page import PAGE, writable_folder
from armsight.app.show.report import Report
from armsight.app.stream.datum import Published
from armsight.app.stream.mcap_file import REFERENCES, RUN_MCAP, LazyMcap, properties
from armsight.app.stream.streams import open_streams
from armsight.data import Array, Image, PoseEstimate, Shot
from armsight.errors import ArmsightError, InputError
from armsight.files import alone_in, as_input_error, check_folder, replacing, table_text, write_text
from armsight.geometry.pose import left_axes
from armsight.geometry.rotation import quaternion_wxyz
from armsight.loop.estimators import Mounting
from armsight.loop.health import health_lines
from armsight.loop.running.calibrate import HandEyeRun
from armsight.loop.running.data import Fanout
from armsight.loop.running.setup import Setup
from armsight.vision.detections import detections_text
from armsight.vision.image import grey
from armsight.vision.pose.shot_pose import CSV_COLUMNS, UPPER, rows_of, shot_pose
from armsight.vision.rig import StereoRig
from armsight.vision.sources import Source

#: Files of an earlier run, those of version 1 and its Parquet tables among them.
_TABLES, _FIGURES = (*NAMES, "joints", "wanted"), ("joints", "path", "errors", "loop", "latency", "studies", "overview")
_SHOTS, _FOLLOWED, DETECTIONS = "shots", "rig_followed.json", "detections.csv"


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
    process: bool = False,
    **how: Any,  # noqa: ANN401 - options of run_experiment
) -> RunResult:
    """Run the experiment, with run.mcap in its folder, written by another process where asked for, and streams beside.

    ``files`` are the texts of motion.toml and body.toml, perhaps of references.toml, which are written first; run.mcap says
    which ``command`` made it; ``say`` is given what could not be recorded or published.
    """
    make_room(folder)
    for name, text in files.items():
        write_text(folder / name, text)
    rig.save(folder / "rig.json")
    more = {REFERENCES: files[REFERENCES]} if REFERENCES in files else {}
    texts = properties(rig, files["body.toml"], setup.arm, command=command, **more)
    published = Published(rig, setup.target.body, setup.arm, texts)  # for another process; functions stay in this one
    ended = threading.Event()

    def hold(_: str) -> None:
        """Stop the arm and keep what was measured, as Ctrl-C does."""
        if ended.is_set():  # it would keep the report from being written
            raise InputError("nothing moves any more")
        os.kill(os.getpid(), signal.SIGINT)

    may_hold = hold if command == "run" else None
    here = replace(published, hold=may_hold, temperatures_c=lambda: setup.board.joints.temperature_c)
    with contextlib.ExitStack() as stack:
        file = stack.enter_context(contextlib.closing(LazyMcap(folder, published, say, process=process)))
        beside = stack.enter_context(contextlib.closing(open_streams(streams, here, say)))
        try:
            result = run_experiment(setup, rig, plan, targets, publisher=Fanout((file, beside)), **how)
        finally:
            ended.set()
    result.properties = {"arm": setup.arm.name, "board": setup.board.welcome.board}
    return result


def finish(
    result: RunResult,
    folder: Path,
    *,
    truth: tuple[Array, Array] | None = None,
    studies: Sequence[Study] = (),
    workcell: Callable[[], Image] | None = None,
) -> Report:
    """Write everything a run measured, and raise what ended it early: an ArmsightError, or a KeyboardInterrupt.

    ``truth``: times (N,), s, and poses (N, 4, 4) of the tool in the base frame; ``workcell``: returns an image (H, W, 3)
    BGR from aside; both None for a real arm. If a file could not be written, those that were are complete.
    """
    ended = f"{result.ended_text}; the arm was stopped" if result.ended_text is not None else ""
    tracks, handeye = None, result.handeye

    def timed(report: Report) -> Report:
        return replace(report, values={"wall_s": time.perf_counter() - result.began})

    try:
        with uninterrupted() as came:  # until all files but the page are written
            if handeye is not None:
                tracks = Tracks(result.log, result.setup.arm, handeye.mounting, result.delay, truth, result.changes)
            report = timed(report_of(result, tracks, studies, _picture(result), workcell))
            with _as_much_as_fits() as keep:
                _write_measured(result, tracks, folder, keep)
                keep(write_text, folder / "summary.json", report.json_text())
        if came:
            raise KeyboardInterrupt
        if tracks is not None:
            report.write(folder)
            report = timed(report)  # with the time that plotting took
            write_text(folder / "summary.json", report.json_text())
    except InputError as error:
        reason = f"{ended}, and not all could be written: " if ended else ""
        raise InputError(f"{reason}{error}; what was written before is in {folder}") from None
    if result.ended_by is not None:
        suspected = "".join(f"; {line}" for line in health_lines(result.health))
        raise ArmsightError(f"{ended}; what was measured until then is in {folder}{suspected}")
    if result.interrupted:
        raise KeyboardInterrupt
    return report


def _write_measured(result: RunResult, tracks: Tracks | None, folder: Path, keep: Callable[..., None]) -> None:
    log, handeye = result.log, result.handeye
    keep(_write_poses, folder / "poses.csv", result)
    if drawn := log.detections():
        keep(write_text, folder / DETECTIONS, detections_text(drawn, result.setup.target.body))
    if updates := [each.update for each in log.corrections if each.update is not None]:
        made = {"command": "run --follow-rig", "before": dict(result.rig.provenance)}
        keep(replace(updates[-1].rig, provenance=made).save, folder / _FOLLOWED)
    if tracks is None or handeye is None:
        readings = log.readings.array(1 + result.setup.arm.joints)
        if len(readings):
            t_s, q = readings[:, 0], readings[:, 1:]
            joints = joint_columns(t_s, q, references(log.segments, t_s, q.shape[1]))
            keep(write_columns, folder, "joints", [joints])
        return
    keep(write_handeye, folder, handeye, log.mountings)
    if result.shutters is not None:
        keep(replace(result.rig, shutters=result.shutters).save, folder / "rig.json")
    keep(write_columns, folder, "joints", (joint_columns(each.t_s, each.q, each.q_ref) for each in tracks.parts()))
    for name in NAMES if tracks.truth is not None else NAMES[1:]:
        keep(write_columns, folder, name, map(partial(_columns, name), tracks.parts()))
    lines = [f"{s.begin_s:9.3f} s to {s.end_s:9.3f} s  {s.phase:12s} {s.motion}" for s in log.segments]
    keep(write_text, folder / "run.log", "\n".join([*notes_of(result), *lines]) + "\n")
    keep(write_shots, folder / _SHOTS, result.kept)


def _columns(name: str, part: Part) -> dict[str, Any]:
    return columns(part.named(name))


@contextlib.contextmanager
def _as_much_as_fits() -> Iterator[Callable[..., None]]:
    """Write file after file, also after one that could not be written; the first error is raised at the end."""
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


def _write_poses(path: Path, result: RunResult) -> None:
    """Write what vision measured shot by shot, in the left camera's frame, as ``measure`` does."""
    body = result.setup.target.body
    with replacing(path) as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(CSV_COLUMNS)
        for name, t_s, found in result.log.every_shot():
            writer.writerows(rows_of([shot_pose(name, float(t_s), body, found)])[1])


def write_handeye(folder: Path, run: HandEyeRun, corrected: Sequence[tuple[float, Mounting]] = ()) -> None:
    """Write the hand-eye calibration, and the poses it was made from as ``armsight identify`` reads them.

    ``corrected``: mountings of a rig that was put right, and from when on, s: the last one is written as the current one.
    """
    found, (position, angle) = run.found, run.found.held_out.rms()
    newest = corrected[-1][1] if corrected else run.mounting
    calibration = {name: getattr(newest, name).tolist() for name in ("T_base_rig", "T_tool_body")}
    calibration |= {"cov": (found.cov + newest.cov - run.mounting.cov).tolist()}
    calibration |= {"held_out_position_rms_m": position, "held_out_angle_rms_rad": angle}
    calibration |= zip(("sigma_flange_m", "sigma_flange_rad"), found.sigma_flange, strict=True)
    calibration |= {"structure": found.structure, "poses": len(run.q), "missed": list(run.missed)}
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
    write_text(folder / "handeye_poses.csv", table_text(named, zip(*named.values(), strict=True)))


def write_shots(folder: Path, shots: Sequence[Shot]) -> None:
    """Write kept shots as a recording in a folder to be made; it is complete or not there at all."""
    left = iter(shots)

    class Kept(Source):
        count = len(shots)

        def read(self) -> Shot | None:
            return next(left, None)

        def close(self) -> None:
            pass

    if not shots:
        return
    written, prefix = as_input_error(f"{folder}: cannot be written"), f".{folder.name}."
    with written, tempfile.TemporaryDirectory(prefix=prefix, dir=folder.parent) as temporary:
        stored = record(Kept(), Path(temporary) / folder.name)
        if stored.interrupted:
            raise KeyboardInterrupt
        if stored.stopped is not None:
            raise InputError(stored.stopped.replace(str(stored.directory), str(folder)))
        os.replace(stored.directory, folder)


@contextlib.contextmanager
def open_folder(folder: Path, *, simulated: bool = False) -> Iterator[None]:
    """Keep a folder, checked before the long work, to one run; ``simulated``: a killed run's files are written over."""
    holding = (*_names(), "rig.json", "body.toml", "motion.toml", REFERENCES)
    signs = (PAGE, "summary.json", *["in_use.lock"] * simulated)
    check_folder(folder, holding=holding, signs=signs, problem="no run can be written here")
    moved = (folder / "summary.json").exists() and (folder / "motion.toml").exists()
    if moved and not (folder / "truth.csv").exists():
        raise InputError(f"{folder}: holds an earlier run of an arm; move it away, or name another folder with -o")
    if (folder / _SHOTS).exists() and not (folder / "summary.json").exists():
        raise InputError(f"{folder}: holds shots that are not of an earlier run; choose another folder")
    with alone_in(folder, "run"):
        yield


def _names() -> list[str]:
    names = [f"{name}.png" for name in (*_FIGURES, "pose", "workcell", "cell")]
    names += [f"{name}.{kind}" for name in _TABLES for kind in ("csv", "parquet")]
    return [*names, PAGE, "run.log", "poses.csv", DETECTIONS, _FOLLOWED, "handeye.json", "handeye_poses.csv", RUN_MCAP]


def make_room(folder: Path) -> None:
    """Make a run's folder; remove the files of an earlier run from it, so that they are not mixed with this run's."""
    writable_folder(folder, "no run")
    try:
        if (folder / _SHOTS).is_dir():
            shutil.rmtree(folder / _SHOTS)
        for name in (*_names(), "summary.json"):  # last, as an earlier run is recognised by it
            (folder / name).unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{error.filename}: an earlier run's file cannot be removed: {error.strerror}") from None


def _picture(result: RunResult) -> Image | None:
    if result.picture is None:
        return None
    shot, pose = result.picture
    assert shot.left is not None
    return overlaid(result.rig, grey(shot.left), pose)


def overlaid(rig: StereoRig, image: Image, estimate: PoseEstimate) -> Image:
    """Return a left image (H, W), grey, with a pose overlaid as (H, W, 3) BGR: points as circles, axes red, green, blue."""
    canvas = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    T, shift = estimate.T_left_body, 4
    ends = np.concatenate([T[:3, 3][None], T[:3, 3] + 0.05 * T[:3, :3].T, estimate.points.p_left])
    uv = np.round(rig.left.project(ends) * 2**shift).astype(int)
    for i, colour in enumerate(((60, 60, 230), (80, 200, 80), (230, 120, 40)), start=1):
        cv2.arrowedLine(canvas, tuple(uv[0].tolist()), tuple(uv[i].tolist()), colour, 2, cv2.LINE_AA, shift, 0.12)
    for p in uv[4:]:
        cv2.circle(canvas, tuple(p.tolist()), 3 << shift, (0, 220, 255), 1, cv2.LINE_AA, shift)
    return canvas
