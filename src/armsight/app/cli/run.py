"""``armsight run``: the experiment on real devices."""

from __future__ import annotations

import contextlib
import json
import time
from pathlib import Path
from typing import Any

import click
import numpy as np

from armsight.app.cli.progress import steps
from armsight.app.cli.run_words import tell
from armsight.app.experiment import Progress, run_experiment
from armsight.app.motion_file import CHAPTER, MotionPlan, read_motions
from armsight.app.report_draw import require_matplotlib
from armsight.app.run_calibrate import handeye_poses
from armsight.app.run_folder import Finished, open_folder, write_run
from armsight.app.run_station import LiveShots, Station
from armsight.app.run_tracks import require_pyarrow
from armsight.data import Array
from armsight.errors import ArmsightError, InputError
from armsight.files import read_text, write_text
from armsight.robot.boards.opening import open_board
from armsight.robot.models import open_arm
from armsight.vision.follow import follows
from armsight.vision.markers.targets import open_target
from armsight.vision.rig import StereoRig
from armsight.vision.sources import open_source

#: The joints must agree with where the motion is to start to so much before anything moves, rad.
_START_RAD = np.radians(2.0)
_HANDEYE_POSES = 30


@click.command("run")
@click.option(
    "--source", "source_spec", required=True, help="Where shots come from, such as usb:0,1 (docs/sources.md)."
)
@click.option("--board", "board_spec", required=True, help="serial:PORT (docs/board.md).")
@click.option("--rig", "rig_path", required=True, type=click.Path(path_type=Path), help="The calibrated rig, rig.json.")
@click.option("--target", "target_spec", required=True, help="The body on the tool: a body file of discs.")
@click.option(
    "--model", default="six_r", show_default=True, help="The arm: a name (armsight arm list) or a .urdf file."
)
@click.option(
    "--motion", type=click.Path(path_type=Path), default=CHAPTER, help="What to do (TOML); the chapter's motion."
)
@click.option(
    "--rate",
    type=click.FloatRange(min=0.1, max=10_000.0),
    default=60.0,
    show_default=True,
    help="Of the cameras, Hz.",
)
@click.option(
    "--sync-ms",
    type=click.FloatRange(min=0.0, max=1_000.0),
    default=0.1,
    show_default=True,
    help="How far apart both exposures of a shot may be, sigma, ms.",
)
@click.option("--open-loop", is_flag=True, help="Only with potentiometers; do not close the loop.")
@click.option("-o", "--out", default="run", show_default=True, metavar="DIR", type=click.Path(path_type=Path))
@click.option("--json", "as_json", is_flag=True, help="Print the summary as one JSON object.")
def command(
    source_spec: str,
    board_spec: str,
    rig_path: Path,
    target_spec: str,
    model: str,
    motion: Path,
    rate: float,
    sync_ms: float,
    open_loop: bool,
    out: Path,
    as_json: bool,
) -> None:
    """Run the experiment on a real arm: find where everything is, make the motions, close the loop on vision.

    The arm moves on its own: hand-eye poses around those of the motion, a sweep, the motions twice. Keep the emergency stop
    at hand. Ctrl-C stops the arm first and then saves what was measured.
    """
    require_matplotlib()
    require_pyarrow()
    arm, rig, target = open_arm(model), StereoRig.load(rig_path), open_target(target_spec)
    if not follows(target):
        raise InputError(
            f"{target_spec}: {target.body.name} cannot be followed: a body of three discs or more is needed"
        )
    plan = read_motions(arm, motion)
    open_folder(out)
    write_text(out / "motion.toml", read_text(motion))
    rig.save(out / "rig.json")
    began = time.perf_counter()
    with contextlib.ExitStack() as stack, steps() as progress:
        board = stack.enter_context(open_board(board_spec))
        shots = LiveShots(open_source(source_spec))
        stack.callback(shots.close)
        station = Station(arm, board, shots.poll, target, lambda q: np.zeros(6), rate, 1e-3 * sync_ms)
        _require_start(station, plan)
        summary = _run(station, rig, plan, close_loop=not open_loop, out=out, began=began, progress=progress)
    if as_json:
        click.echo(json.dumps(summary))
    else:
        tell(summary, out)


def _require_start(station: Station, plan: MotionPlan) -> None:
    """Refuse to begin where the arm is not where the motion starts, or is no such arm at all."""
    states = station.board.receive(0.2)
    if not len(states.q):
        raise ArmsightError("the board tells no joint angles: is its wire's baud rate right?")
    q = states.q[-1]
    off = np.abs(q - plan.start)
    if off.max() > _START_RAD:
        joint = int(off.argmax())
        raise InputError(
            f"joint {joint + 1} reads {np.degrees(q[joint]):.1f} deg, the motion starts at "
            f"{np.degrees(plan.start[joint]):.1f}: bring the arm to the start, or give start_deg; if it is there, "
            f"--model {station.arm.name} does not match the board's potentiometers (armsight board monitor)"
        )


def _run(
    station: Station, rig: StereoRig, plan: MotionPlan, *, close_loop: bool, out: Path, began: float, progress: Progress
) -> dict[str, Any]:
    """Run and write; raises what ended the run early after everything is written."""
    ends: list[Array] = [plan.start, *(m.trajectory.at(m.trajectory.duration_s).q for m in plan.motions)]
    targets = handeye_poses(station.arm, np.array(ends), _HANDEYE_POSES, 0)
    outcome = run_experiment(station, rig, plan, targets, progress=progress, close_loop=close_loop)
    facts = {"arm": station.arm.name, "board": station.board.welcome.board, "wall_s": time.perf_counter() - began}
    summary = write_run(Finished(station.arm, rig, outcome, plan, None, facts, [], None), out)
    if outcome.ended_by is not None:
        raise ArmsightError(f"{outcome.ended_by}; the arm was stopped, what was measured until then is in {out}")
    if outcome.interrupted:
        raise KeyboardInterrupt
    return summary
