"""``armsight handeye``: hand-eye calibration of anyone's data."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click

from armsight.app.arm_option import arm_option
from armsight.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    from armsight.app.handeye.images import Seen
    from armsight.app.handeye.report import HandEyeAnswer
    from armsight.robot.kinematics.arm import Arm
    from armsight.tables.poses import PoseTable

_BY_RIG = "--rig with --left and --right, or with --source"


@dataclass(frozen=True)
class Options:
    """What the command line says; the names are its options'."""

    robot: Path
    frames: str | None
    eye: str
    model: str | None
    rotation: str | None
    units: str | None
    columns: tuple[str, ...]
    seen: Path | None
    seen_rotation: str | None
    seen_units: str | None
    images: str | None
    camera: str | None
    rig: Path | None
    left: str | None
    right: str | None
    source: str | None
    target: str | None
    streams: bool
    scale: bool
    detect_units: bool
    plan: int
    output: Path | None
    as_json: bool


@click.command("handeye")
@click.option(
    "--robot",
    required=True,
    metavar="POSES.csv|BAG",
    type=click.Path(path_type=Path),
    help="Poses or joints: a table, or a recording with /tf or joint states.",
)
@click.option("--frames", metavar="BASE:FLANGE", help="Frames of the recording's transforms, such as base_link:tool0.")
@click.option(
    "--eye",
    required=True,
    type=click.Choice(["in-hand", "to-hand"]),
    help="Does the arm carry the camera, or the target?",
)
@arm_option("--model", metavar="ARM", help="The arm whose joints the table has: a name, a .toml or a .urdf file.")
@click.option(
    "--rotation",
    metavar="CONVENTION",
    help="wxyz or xyzw; rotvec; or angles: xyz (fixed axes), XYZ (rotated axes), ...",
)
@click.option("--units", type=click.Choice(["m", "mm"]), help="Of lengths whose columns do not name a unit.")
@click.option(
    "--columns",
    metavar="[seen:]NAME=COLUMN,...",
    multiple=True,
    help="Names of columns in your table, such as x_mm=X,rx_deg=A, or of all in order, such as rx,ry,rz,x,y,z; with seen: "
    "of the target's table.",
)
@click.option(
    "--seen", metavar="TARGET.csv", type=click.Path(path_type=Path), help="Poses of the target in the camera."
)
@click.option("--seen-rotation", metavar="CONVENTION", help="The same for the target's table.")
@click.option("--seen-units", type=click.Choice(["m", "mm"]), help="The same for the target's table.")
@click.option("--images", metavar="GLOB", help="Images of one camera; quote the glob.")
@click.option("--camera", metavar="CAMERA|fit", help="Its calibration, .json or .yaml; fit: from these images.")
@click.option("--rig", metavar="RIG.json", type=click.Path(path_type=Path), help="A calibrated pair of cameras.")
@click.option("--left", metavar="GLOB", help="Left images of the rig; quote the glob.")
@click.option("--right", metavar="GLOB", help="Right images.")
@click.option("--source", metavar="SOURCE", help="A folder or recording instead (see armsight record -h).")
@click.option("--target", metavar="SPEC|BODY", help="A board such as chessboard:9x6:25mm, or a body file.")
@click.option("--streams", is_flag=True, help="Both tables are streams (t_s) whose clocks differ: find the offset.")
@click.option("--scale", is_flag=True, help="The target's size may be wrong: fit it.")
@click.option("--detect-units", is_flag=True, help="Take lengths that cannot be metres for millimetres, and say so.")
@click.option("--plan", metavar="N", type=click.IntRange(min=0, max=50), default=0, help="Choose the next N poses.")
@click.option(
    "-o", "--output", metavar="DIR", type=click.Path(path_type=Path), help="Folder for the page and the files."
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object, SI units.")
def command(**given: object) -> int:
    """Calibrate hand and eye from your own data: robot poses, and images or poses of a target.

    Prints both transforms with sigma, the error on poses left out, how much of it is the arm and how much the camera, which
    poses are blunders, and which direction the motion leaves open. Exit code 3: a quarter of the poses or more are
    blunders, half of them are off by more than 20 mm, or a transform is known no better: the result must not be trusted.
    Forms of tables, and examples: docs/howto/handeye.md.
    """
    options = _with_both(Options(**given))  # type: ignore[arg-type]
    _require_one_way(options)

    from armsight.app.handeye.report import handeye_report, plan_csv
    from armsight.app.progress import steps
    from armsight.app.show.plotting import require_matplotlib
    from armsight.files import check_folder

    folder = None
    if options.output is not None:
        require_matplotlib()
        folder = check_folder(options.output, problem="no report can be written here")
    with steps() as progress:
        run = calibrate(options, progress)
        report = handeye_report(run)
        files = {} if run.plan is None else {"plan.csv": plan_csv(run.plan)}
        if folder is not None:
            progress("writing")
            report.write(folder, {"handeye.json": report.json_text(), **files})
    written = None if folder is None else f"{folder}/{', '.join(['report.html', 'handeye.json', *files])}"
    return report.echo(as_json=options.as_json, written=written)


def _columns(options: Options, side: str) -> str | None:
    """Return what --columns says of one table, "robot" or "seen"."""
    seen = [text.removeprefix("seen:") for text in options.columns if text.startswith("seen:")]
    robot = [text.removeprefix("robot:") for text in options.columns if not text.startswith("seen:")]
    return ",".join(robot if side == "robot" else seen) or None


def _with_both(options: Options) -> Options:
    """Return the options with the robot's file as that of what was seen, where it holds both and nothing else is given."""
    from armsight.tables.nested import has_both

    given = (options.seen, options.images, options.camera, options.rig, options.left, options.right, options.source)
    return replace(options, seen=options.robot) if not any(given) and has_both(options.robot) else options


def _require_one_way(options: Options) -> None:
    """Reject options that do not go together."""
    from armsight.tables.nested import has_both

    ways = {
        "--seen": options.seen is not None,
        "--images with --camera": options.images is not None or options.camera is not None,
        _BY_RIG: any(given is not None for given in (options.rig, options.left, options.right, options.source)),
    }
    if options.seen is not None and options.seen.resolve() == options.robot.resolve() and not has_both(options.robot):
        raise InputError(f"{options.seen}: one file for both: --robot has the arm's poses, --seen what the camera saw")
    if sum(ways.values()) != 1:
        raise InputError(f"give what the camera saw in one way: {', or '.join(ways)}")
    if (options.images is None) != (options.camera is None):
        raise InputError("--images and --camera belong together: --camera CAMERA.json, or --camera fit")
    pair = (options.left, options.right)
    if ways[_BY_RIG] and (options.rig is None or (any(pair) if options.source is not None else not all(pair))):
        raise InputError("--rig, --left and --right belong together, or --rig and --source")
    if options.seen is None and options.target is None:
        raise InputError("images need --target, such as chessboard:9x6:25mm (inner corners, side of a square)")
    if options.streams and options.seen is None and options.source is None:
        raise InputError(
            "--streams needs times: --seen, a table of the target's poses with t_s, or --source, a recording"
        )


def calibrate(options: Options, progress: Callable[[str], None]) -> HandEyeAnswer:
    """Read both sides, look at whether they fit, calibrate.

    Raises:
        ArmsightError: the input is wrong, or the motions leave a direction open.
    """
    from armsight.app.handeye.plan import plan_poses
    from armsight.app.handeye.recording import at_shots, links_of, paired, recording_of, robot_in_recording
    from armsight.app.handeye.report import HandEyeAnswer
    from armsight.app.handeye.suspect import require_plausible
    from armsight.loop.handeye.handeye import calibrate_poses
    from armsight.robot.arm_file import open_arm
    from armsight.tables.poses import read_pose_table

    progress("reading")
    arm = None if options.model is None else open_arm(options.model)
    bag = recording_of(options.robot)
    if bag is not None:
        for name in ("rotation", "units", "columns"):
            if getattr(options, name):
                raise InputError(f"{options.robot}: a recording: --{name} belongs to tables")
        robot = robot_in_recording(bag, options.frames, arm)
    elif options.frames is not None:
        raise InputError(f"{options.robot}: a table: --frames belongs to recordings (bag:FILE)")
    else:
        robot = read_pose_table(
            options.robot,
            rotation=options.rotation,
            unit=options.units,
            detect_units=options.detect_units,
            columns=_columns(options, "robot"),
            arm=arm,
        )
    seen = _seen(options, progress)
    if options.streams:
        return _streams(options, robot, seen, arm, progress)
    if bag is not None:
        robot = at_shots(robot, seen)
    recording = paired(robot, seen, options.eye == "in-hand", arm)
    progress("looking at whether both sides fit")
    recording = require_plausible(recording, arm, detect_units=options.detect_units, scale=options.scale)
    links = None if arm is None else links_of(recording, arm)
    found = calibrate_poses(recording.poses, t_s=recording.t_s, links=links, scale=options.scale, progress=progress)
    progress("choosing poses")
    plan = plan_poses(found, recording.poses, options.plan) if options.plan else None
    return HandEyeAnswer(recording, found, None, 0.0, plan)


def _seen(options: Options, progress: Callable[[str], None]) -> Seen:
    """Read or measure the poses of the target."""
    from armsight.app.handeye.images import see_with_camera, see_with_rig
    from armsight.app.handeye.recording import seen_in_table
    from armsight.tables.poses import read_pose_table
    from armsight.vision.sources import PairsSource, Source, open_source

    if options.seen is not None:
        table = read_pose_table(
            options.seen,
            rotation=options.seen_rotation,
            unit=options.seen_units,
            detect_units=options.detect_units,
            columns=_columns(options, "seen"),
            side="seen",
        )
        return seen_in_table(table)
    target = str(options.target)
    if options.images is not None:
        return see_with_camera(options.images, str(options.camera), target, progress)
    assert options.rig is not None
    if options.source is not None:
        source: Source = open_source(options.source)
    else:
        source = PairsSource.open(str(options.left), str(options.right))
    with contextlib.closing(source):
        return see_with_rig(options.rig, source, target, progress)


def _streams(
    options: Options, robot: PoseTable, seen: Seen, arm: Arm | None, progress: Callable[[str], None]
) -> HandEyeAnswer:
    """Calibrate two streams with an unknown clock offset."""
    import numpy as np

    from armsight.app.handeye.images import steady
    from armsight.app.handeye.plan import plan_poses
    from armsight.app.handeye.recording import links_between, of_streams
    from armsight.app.handeye.report import HandEyeAnswer
    from armsight.app.handeye.suspect import require_plausible, resized
    from armsight.loop.handeye.poses import MIN_POSES
    from armsight.loop.handeye.streams import PoseStream, calibrate_streams, coarse_offset

    for path, t_s in ((options.robot, robot.t_s), (options.seen or options.source, seen.t_s)):
        if t_s is None:
            raise InputError(f"{path}: --streams needs times: a column t_s in line 1, seconds, or a recording")
    assert robot.t_s is not None
    assert seen.t_s is not None
    shown = np.array([not why for why in seen.missed])
    names = tuple(name for name, why in zip(seen.names, seen.missed, strict=True) if not why)
    t_s = seen.t_s[shown]
    seen = replace(
        seen,
        Ts=steady(seen.Ts[shown], seen.symmetries),
        covs=seen.covs[shown],
        names=names,
        missed=("",) * len(names),
        t_s=t_s,
    )
    hand = PoseStream.of(robot.t_s, robot.Ts, str(options.robot))
    eye_stream = PoseStream.of(t_s, seen.Ts, str(options.seen or options.source))
    eye: Literal["in_hand", "to_hand"] = "in_hand" if options.eye == "in-hand" else "to_hand"
    notes = (*robot.notes, *seen.notes)
    progress("looking at whether both sides fit")
    roughly_s = coarse_offset(hand, eye_stream)
    A, there = hand.at(eye_stream.t_s + roughly_s)
    if there.sum() >= MIN_POSES:
        pairs = of_streams(
            robot, seen, (A[there], eye_stream.Ts[there]), eye_stream.t_s[there], roughly_s, eye == "in_hand"
        )
        checked = require_plausible(pairs, arm, detect_units=options.detect_units, scale=options.scale, streams=True)
        notes = checked.notes
        hand, eye_stream = (
            replace(stream, Ts=resized(stream.Ts, before, after))
            for stream, before, after in (
                (hand, pairs.poses.A, checked.poses.A),
                (eye_stream, pairs.poses.B, checked.poses.B),
            )
        )
    found = calibrate_streams(
        hand,
        eye_stream,
        eye=eye,
        centre=seen.centre,
        scale=options.scale,
        links_at=None if arm is None else links_between(robot, arm),
        progress=progress,
    )
    recording = of_streams(robot, seen, (found.A, found.B), found.t_s, found.offset_s, eye == "in_hand")
    recording = replace(recording, notes=notes)
    plan = plan_poses(found.handeye, recording.poses, options.plan) if options.plan else None
    return HandEyeAnswer(recording, found.handeye, found.offset_s, found.sigma_offset_s, plan)
