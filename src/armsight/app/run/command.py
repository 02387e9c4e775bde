"""``armsight run``: the experiment on real devices, or in the workcell as ``sim:``."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from armsight.app.options import ARM, FIXED, FOLLOW_RIG, JSON, LOGGED, REFERENCES, SIM, STREAM, declared, option, out
from armsight.app.progress import steps
from armsight.app.show.messages import UNTRUSTED, note, print_answer, require, say, warn
from armsight.errors import InputError
from armsight.files import read_text, write_text

if TYPE_CHECKING:
    from armsight.robot.kinematics.arm import Arm

_HANDEYE_POSES = 30
#: Of motions that are planned here: cycles, and the speed on lines, m/s, which five poses do not use.
_CYCLES, _SPEED_M_S = 3, 0.1


@click.command("run")
@declared
def command(
    source_spec: str = option(
        "Where shots come from, such as usb:0,1 (docs/howto/sources.md); sim: is the simulated workcell.", "--source"
    ),
    board_spec: str = option(
        "The controller: serial:PORT, feetech:PORT,LEROBOT.json, ar4:PORT (docs/howto/board.md); emulated: with sim:;"
        " poses:FILE where another program moves the arm and logs its angles.",
        "--board",
    ),
    rig_path: Path = option("The calibrated rig.", "--rig", metavar="RIG.json"),
    target_spec: str = option("The body on the tool: a body file of discs.", "--target", metavar="BODY"),
    fixed: tuple[str, ...] = FIXED,
    arm_spec: str = ARM,
    motion: Path | None = option(
        "The motions (TOML, docs/howto/run.md). Without: of six_r five poses, a line and a circle, of others five poses "
        "three times in the largest cube within reach (armsight check plan).",
        metavar="MOTION.toml",
    ),
    sync_ms: float = option(
        "Sigma of the time between the exposures of a shot before a sweep of the arm finds it, ms; sim: knows its own.",
        min=0.0,
        max=1_000.0,
        default=0.1,
    ),
    stream: tuple[str, ...] = STREAM,
    sync_led: bool = option("The board's sync LED (docs/howto/board.md) is in view of both cameras."),
    references: Path | None = REFERENCES,
    open_loop: bool = option("Control by the joint sensors alone; do not close the loop on vision."),
    follow_rig: bool = FOLLOW_RIG,
    output: Path = out("DIR", "Folder of the run.", default="run", report=True),
    as_json: bool = JSON,
) -> None:
    """Run the experiment on a real arm: hand-eye calibration, the motions, the loop closed on vision.

    The arm moves on its own: hand-eye poses around those of the motion, a sweep, the motions twice. Keep the emergency stop
    at hand. Ctrl-C stops the arm first and then saves what was measured.

    With --board poses:FILE nothing is commanded: FILE is a CSV of joint angles (q1_deg ..) that another program logged, by
    name of the shot or by time, for shots of a recording. Exit code 3: the result must not be trusted.
    """
    if board_spec.startswith(LOGGED):
        if motion is not None or open_loop or fixed or follow_rig or sync_led or references is not None:
            those = "--motion, --open-loop, --fixed, --follow-rig, --references and --sync-led"
            raise InputError(f"--board {board_spec} commands no motion: leave out {those}")
        _run_logged(source_spec, board_spec, rig_path, target_spec, arm_spec, output, as_json)
        return

    from armsight.app.run.devices import Devices, open_devices, planned_for
    from armsight.app.run.experiment import require_followed, require_start
    from armsight.app.run.folder import finish, open_folder, run_in
    from armsight.app.run.motion_file import read_motions
    from armsight.app.run.report import show
    from armsight.loop.references.file import read_references
    from armsight.loop.running.beside import the_one
    from armsight.loop.running.calibrate import handeye_poses
    from armsight.robot.arm_file import open_arm
    from armsight.vision.follow.follower import follows
    from armsight.vision.markers.targets import open_fixed, open_target
    from armsight.vision.rig import StereoRig

    require("a run", "run", "matplotlib", "pyarrow", *(["unicorn"] if board_spec == "emulated:unicorn" else []))
    arm = planned_for(open_arm(arm_spec), board_spec)
    rig, target = StereoRig.load_trusted(rig_path), open_target(target_spec)
    if follow_rig:
        require_followed(rig, rig_path)
    fixed_targets = open_fixed(fixed, target_spec)
    if not follows(target):
        raise InputError(f"{target_spec}: {target.body.name} cannot be followed: give a body of three discs or more")
    text = read_text(motion) if motion is not None else _motion_text(arm, simulated=source_spec.startswith(SIM))
    with tempfile.TemporaryDirectory() as name:
        if motion is None:
            write_text(motion := Path(name) / "motion.toml", text)
        motions = read_motions(arm, motion)
    targets = handeye_poses(arm, motions.ends, _HANDEYE_POSES, 0)
    files = {"motion.toml": text, "body.toml": read_text(target_spec)}
    unit = None if references is None else the_one(read_references(references))
    if references is not None:
        files["references.toml"] = read_text(references)
    devices = Devices(source_spec, board_spec, arm, target, 1e-3 * sync_ms, sync_led, unit)
    begun = False
    try:
        with open_folder(output), steps() as progress:
            progress("opening the devices")
            with open_devices(devices) as setup:
                setup = replace(setup, fixed=fixed_targets)
                require_start(setup, motions, targets)
                begun = True
                how: dict[str, Any] = {"streams": stream, "progress": progress}
                how |= {"close_loop": not open_loop, "follow_rig": follow_rig}
                result = run_in(output, setup, rig, motions, targets, files, command="run", say=say, **how)
                progress("writing and plotting")
                report = finish(result, output)
    except KeyboardInterrupt:
        if begun:  # said once the progress is off the terminal
            click.echo(f"the arm was stopped; what was measured until then is in {output}", err=True)
        raise
    show(report, output, as_json=as_json)


def _run_logged(
    source_spec: str, board_spec: str, rig_path: Path, target_spec: str, arm_spec: str, output: Path, as_json: bool
) -> None:
    import contextlib

    from armsight.app.run.folder import open_folder
    from armsight.app.run.logged import read_angles, run_logged, summary_lines, write_logged
    from armsight.app.show.plotting import require_matplotlib
    from armsight.robot.arm_file import open_arm
    from armsight.vision.markers.targets import open_target
    from armsight.vision.rig import StereoRig
    from armsight.vision.sources import open_source

    require_matplotlib()
    arm, rig, target = open_arm(arm_spec), StereoRig.load_trusted(rig_path), open_target(target_spec)
    angles = read_angles(board_spec.removeprefix(LOGGED), arm)
    note(*angles.notes)
    with open_folder(output), contextlib.closing(open_source(source_spec)) as source, steps() as progress:
        result = run_logged(source, rig, target, arm, angles, progress)
        progress("writing and plotting")
        summary = write_logged(output, result, {"arm": arm_spec, "board": board_spec})
    print_answer(as_json, summary, *summary_lines(summary, output))
    warn(*result.weak)
    if result.weak:
        click.get_current_context().exit(UNTRUSTED)


def _motion_text(arm: Arm, *, simulated: bool) -> str:
    """Return the motions of an arm where nobody gives a file: kept ones, before simulated cameras, or planned."""
    import numpy as np

    from armsight.app.check.plan import plan_test
    from armsight.app.run.motion_file import motion_of, motion_text

    if (kept := motion_of(arm.name, simulated=simulated)) is not None:
        return read_text(kept)
    if simulated:
        from armsight.sim.workcell.workcell import workcell_poses

        poses = list(enumerate(np.degrees(workcell_poses(arm, default=False)).round(2), start=1))
        there = [(f"P{n} cycle {cycle}", q) for cycle in range(1, _CYCLES + 1) for n, q in poses]
        motions = [motion_text("joints", name, {"q_deg": q}) for name, q in there]
        return f"start_deg = {np.degrees(arm.home).round(4).tolist()}\n" + "".join(motions)
    return plan_test(arm, "poses", _CYCLES, None, _SPEED_M_S, None).motions
