"""``armsight handeye``: hand-eye calibration of anyone's data."""

from __future__ import annotations

import contextlib
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from armsight.app.options import JSON, declared, option, out
from armsight.errors import InputError, noted

if TYPE_CHECKING:
    from collections.abc import Callable

    from armsight.app.handeye.report import HandEyeAnswer
    from armsight.loop.handeye.handeye import HandEye
    from armsight.loop.handeye.recording import PairedPoses, Seen
    from armsight.robot.kinematics.arm import Arm
    from armsight.tables.cells import Said
    from armsight.tables.poses import PoseTable


@dataclass(frozen=True)
class Options:
    """What the command line says; the names are its options'."""

    robot: Path = option("Poses or joints: a table, or a recording with /tf or joint states.", metavar="POSES.csv|BAG")
    eye: str = option(
        "Does the arm carry the camera, or the target?",
        choices=["in-hand", "to-hand", "in_hand", "to_hand"],
        metavar="in-hand|to-hand",
        callback=lambda context, option, eye: eye.replace("_", "-"),
    )
    model: str | None = option("The arm whose joints the table has: a name, a .toml or a .urdf file.", metavar="ARM")
    columns: tuple[str, ...] = option(
        "Names of columns in your table, such as x_mm=X,rx_deg=A, or of all in order, such as rx,ry,rz,x,y,z. Also: "
        "units=mm, or units=detect where lengths cannot be metres; rotation=rotvec, wxyz, xyzw, xyz (fixed axes), XYZ "
        "(rotated axes) ...; of a recording frames=base_link:tool0. With seen: of the target's table.",
        metavar="[seen:]NAME=COLUMN,...",
    )
    seen: Path | None = option("Poses of the target in the camera.", metavar="TARGET.csv")
    camera: str | None = option(
        "Calibration of one camera, .json or .yaml; fit: from its images.", metavar="CAMERA|fit"
    )
    rig: Path | None = option("A calibrated pair of cameras.", metavar="RIG.json")
    source: str | None = option(
        "With --camera a quoted glob of images; with --rig a folder, a recording or pairs:LEFT,RIGHT.", metavar="SOURCE"
    )
    target: str | None = option("A board such as chessboard:9x6:25mm, or a body file.", metavar="SPEC|BODY")
    streams: bool = option("Both tables are streams (t_s) whose clocks differ: find the offset.")
    scale: bool = option("The target's size may be wrong: fit it.")
    plan: int = option("Choose the next N poses.", metavar="N", min=0, max=50, default=0, show_default=False)
    output: Path | None = out("DIR", "Folder for the page and the files; needs armsight[report].", report=True)
    as_json: bool = JSON


@click.command("handeye")
@declared
def command(options: Options) -> int:
    """Calibrate hand and eye from your own data: robot poses, and images or poses of a target.

    Prints both transforms with sigma, the error on poses left out, how much of it is the arm and how much the camera, which
    poses are blunders, and which direction the motion leaves open. Exit code 3: a quarter of the poses or more are
    blunders, half of them are off by more than 20 mm, or a transform is known no better: the result must not be trusted.
    Forms of tables, and examples: docs/howto/handeye.md.
    """
    options = _checked(options)

    from armsight.app.handeye.report import handeye_report, plan_csv
    from armsight.app.progress import steps
    from armsight.app.show.page import PAGE
    from armsight.app.show.plotting import require_matplotlib
    from armsight.files import check_folder

    folder = None
    if options.output is not None:
        require_matplotlib()
        holding = ("handeye.json", "plan.csv", PAGE)
        folder = check_folder(options.output, holding=holding, problem="no report can be written here")
    with steps() as progress:
        run = calibrate(options, progress)
        report = handeye_report(run)
        files = {} if run.plan is None else {"plan.csv": plan_csv(run.plan)}
        if folder is not None:
            progress("writing")
            report.write(folder, {"handeye.json": report.json_text(), **files})
    written = None if folder is None else f"{folder}/{', '.join(['report.html', 'handeye.json', *files])}"
    return report.echo(as_json=options.as_json, written=written)


def _said(options: Options, side: str) -> Said:
    """Return what --columns says of one table, "robot" or "seen"; units=detect holds for both."""
    from armsight.tables.cells import said_columns

    parts: dict[str, list[str]] = {"robot": [], "seen": []}
    for text in options.columns:  # what follows "seen:" is of that table
        _, *pairs = re.split(r"(?:^|,)\s*(robot|seen):", f"robot:,{text}")
        for table, part in zip(pairs[::2], pairs[1::2], strict=True):
            parts[table] += filter(None, [part.strip(",")])
    said = {table: said_columns(",".join(each) or None) for table, each in parts.items()}
    return said[side]._replace(detect_units=any(each.detect_units for each in said.values()))


def _checked(options: Options) -> Options:
    """Reject options that do not go together; a robot's file that holds both sides is that of what was seen, too."""
    from armsight.tables.nested import has_both

    if not any((options.seen, options.camera, options.rig, options.source)) and has_both(options.robot):
        options = replace(options, seen=options.robot)
    if options.seen is not None and options.seen.resolve() == options.robot.resolve() and not has_both(options.robot):
        raise InputError(f"{options.seen}: one file for both: --robot has the arm's poses, --seen what the camera saw")
    ways = [options.seen is not None, options.camera is not None, options.rig is not None]
    if sum(ways) != 1 or (options.source is None) != ways[0]:
        raise InputError(
            "give what the camera saw in one way: --seen, --camera with --source (--camera CAMERA.json, or --camera fit), "
            "or --rig with --source"
        )
    if options.seen is None and options.target is None:
        raise InputError("images need --target, such as chessboard:9x6:25mm (inner corners, side of a square)")
    if options.streams and options.camera is not None:
        raise InputError(
            "--streams needs times: --seen, a table of the target's poses with t_s, or --rig with --source, a recording"
        )
    return options


def calibrate(options: Options, progress: Callable[[str], None]) -> HandEyeAnswer:
    """Read both sides, look at whether they fit, calibrate."""
    import numpy as np

    from armsight.app.handeye.report import HandEyeAnswer
    from armsight.loop.handeye.handeye import calibrate_poses
    from armsight.loop.handeye.recording import at_shots, links_of, paired, recording_of, robot_in_recording
    from armsight.loop.identify.misread import require_plausible
    from armsight.loop.identify.plan import plan_mounting
    from armsight.robot.arm_file import open_arm

    progress("reading")
    arm = None if options.model is None else open_arm(options.model)
    bag = recording_of(options.robot)
    said = _said(options, "robot")
    if bag is None and said.frames is not None:
        raise InputError(f"{options.robot}: a table: --columns frames= belongs to recordings (bag:FILE)")
    if bag is not None and (said.columns or said.unit or said.rotation):
        raise InputError(f"{options.robot}: a recording: --columns belongs to tables, all but frames=BASE:FLANGE")
    robot = _table(options, "robot", arm) if bag is None else robot_in_recording(bag, said.frames, arm)
    seen = _seen(options, progress)
    offset_s, sigma_s = None, 0.0
    with noted((*robot.notes, *seen.notes)):
        if options.streams:
            recording, found, offset_s, sigma_s = _streams(options, robot, seen, arm, progress)
        else:
            robot = robot if bag is None else at_shots(robot, seen)
            recording = paired(robot, seen, options.eye == "in-hand", arm)
            progress("looking at whether both sides fit")
            units = _said(options, "robot").detect_units
            recording = require_plausible(recording, arm, detect_units=units, scale=options.scale)
            links_at = links_of(recording.robot, arm, np.arange(len(robot.Ts), dtype=float))
            links, t_s = None if links_at is None else links_at(recording.rows.astype(float)), recording.t_s
            found = calibrate_poses(recording.poses, t_s=t_s, links=links, scale=options.scale, progress=progress)
    progress("choosing poses")
    plan = plan_mounting(found, recording.poses, options.plan) if options.plan else None
    return HandEyeAnswer(recording, found, offset_s, sigma_s, plan)


def _table(options: Options, side: str, arm: Arm | None = None) -> PoseTable:
    from armsight.tables.poses import read_pose_table

    said = _said(options, side)
    return read_pose_table(
        options.seen if side == "seen" and options.seen is not None else options.robot,
        rotation=said.rotation,
        unit=said.unit,
        detect_units=said.detect_units,
        columns=said.columns,
        arm=arm,
        side=side,
        keep_missed=True,
    )


def _seen(options: Options, progress: Callable[[str], None]) -> Seen:
    from armsight.app.handeye.images import see_with_camera, see_with_rig
    from armsight.loop.handeye.recording import seen_in_table
    from armsight.vision.sources import open_source

    target = str(options.target)
    if options.seen is not None:
        return seen_in_table(_table(options, "seen"))
    source = str(options.source)
    if options.rig is None:
        return see_with_camera(source, str(options.camera), target, progress)
    with contextlib.closing(open_source(source)) as opened:
        return see_with_rig(options.rig, opened, target, progress)


def _streams(
    options: Options, robot: PoseTable, seen: Seen, arm: Arm | None, progress: Callable[[str], None]
) -> tuple[PairedPoses, HandEye, float, float]:
    """Calibrate two streams with an unknown clock offset; return it and its sigma, s, too."""
    import numpy as np

    from armsight.loop.handeye.poses import MIN_POSES
    from armsight.loop.handeye.recording import links_of, of_streams, steady
    from armsight.loop.handeye.streams import PoseStream, calibrate_streams, coarse_offset
    from armsight.loop.identify.misread import require_plausible, resized

    eye_path, in_hand = options.seen or options.source, options.eye == "in-hand"
    for path, t_s in ((options.robot, robot.t_s), (eye_path, seen.t_s)):
        if t_s is None:
            raise InputError(f"{path}: --streams needs times: a column t_s in line 1, seconds, or a recording")
    assert robot.t_s is not None
    assert seen.t_s is not None
    robot = robot.without_missed()
    assert robot.t_s is not None
    shown = np.array([not why for why in seen.missed])
    names = tuple(name for name, why in zip(seen.names, seen.missed, strict=True) if not why)
    Ts, t_s = steady(seen.Ts[shown], seen.symmetries), seen.t_s[shown]
    seen = replace(seen, Ts=Ts, covs=seen.covs[shown], names=names, missed=("",) * len(names), t_s=t_s)
    hand, eye = PoseStream.of(robot.t_s, robot.Ts, str(options.robot)), PoseStream.of(t_s, seen.Ts, str(eye_path))
    notes = (*robot.notes, *seen.notes)
    progress("looking at whether both sides fit")
    roughly_s = coarse_offset(hand, eye)
    A, there = hand.at(eye.t_s + roughly_s)
    if there.sum() >= MIN_POSES:
        pairs = of_streams(robot, seen, (A[there], eye.Ts[there]), eye.t_s[there], roughly_s, in_hand)
        checked = require_plausible(
            pairs, arm, detect_units=_said(options, "robot").detect_units, scale=options.scale, streams=True
        )
        notes, before, after = checked.notes, pairs.poses, checked.poses
        hand = replace(hand, Ts=resized(hand.Ts, before.A, after.A))
        eye = replace(eye, Ts=resized(eye.Ts, before.B, after.B))
    found = calibrate_streams(
        hand,
        eye,
        eye="in_hand" if in_hand else "to_hand",
        centre=seen.centre,
        scale=options.scale,
        links_at=links_of(robot, arm, robot.t_s),
        progress=progress,
    )
    recording = of_streams(robot, seen, (found.A, found.B), found.t_s, found.offset_s, in_hand)
    return replace(recording, notes=notes), found.handeye, found.offset_s, found.sigma_offset_s
