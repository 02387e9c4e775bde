"""``armsight run``: the experiment on real devices."""

from __future__ import annotations

import click
import contextlib
import json
import numpy as np
import time
from armsight.app.demo.demo import setup_of
from armsight.app.progress import steps
from armsight.app.report.plotting import require_matplotlib
from armsight.app.run.calibrate import handeye_poses
from armsight.app.run.experiment import Progress, require_start, run_experiment
from armsight.app.run.folder import Finished, finish, make_room, open_folder
from armsight.app.run.motion_file import DEFAULT_MOTION, MotionPlan, read_motions
from armsight.app.run.record import require_pyarrow
from armsight.app.run.setup import HostClock, LiveShots, Setup
from armsight.app.run.text import tell
from armsight.data import Array
from armsight.errors import InputError
from armsight.files import read_text, write_text
from armsight.loop.identify.model_file import open_model
from armsight.robot.arm import Arm
from armsight.robot.boards.opening import EMULATED, emulated_machine, open_board
from armsight.sim.workcell.workcell import Workcell
from armsight.vision.follow.follower import follows
from armsight.vision.markers.targets import Composite, open_target
from armsight.vision.rig import StereoRig
from armsight.vision.sources import open_source
from dataclasses import replace
from pathlib import Path
from typing import Any

_HANDEYE_POSES = 30
_SIM = "sim:"
#: The workcell's arm and cameras where ``sim:`` names none: those of ``armsight demo``.
_SIM_ARM, _SIM_CAMERAS = "worn", "1280x720@60"


@click.command("run")
@click.option(
    "--source",
    "source_spec",
    required=True,
    help="Where shots come from, such as usb:0,1 (docs/sources.md); sim: is the simulated workcell.",
)
@click.option("--board", "board_spec", required=True, help="serial:PORT (docs/board.md); emulated: with sim:.")
@click.option("--rig", "rig_path", required=True, type=click.Path(path_type=Path), help="The calibrated rig, rig.json.")
@click.option("--target", "target_spec", required=True, help="The body on the tool: a body file of discs.")
@click.option(
    "--model", default="six_r", show_default=True, help="The arm: a name (armsight arm list), a .toml or a .urdf file."
)
@click.option(
    "--motion", type=click.Path(path_type=Path), default=DEFAULT_MOTION, help="What to do (TOML); the chapter's motion."
)
@click.option(
    "--rate",
    type=click.FloatRange(min=0.1, max=10_000.0),
    default=60.0,
    show_default=True,
    help="Of the cameras, Hz; sim: knows its own.",
)
@click.option(
    "--sync-ms",
    type=click.FloatRange(min=0.0, max=1_000.0),
    default=0.1,
    show_default=True,
    help="How far apart both exposures of a shot may be, sigma, ms; sim: knows its own.",
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
    arm, rig, target = open_model(model), StereoRig.load(rig_path), open_target(target_spec)
    if not follows(target):
        raise InputError(
            f"{target_spec}: {target.body.name} cannot be followed: a body of three discs or more is needed"
        )
    plan = read_motions(arm, motion)
    ends: list[Array] = [plan.start, *(m.trajectory.at(m.trajectory.duration_s).q for m in plan.motions)]
    targets = handeye_poses(arm, np.array(ends), _HANDEYE_POSES, 0)
    files = {"motion.toml": read_text(motion), "body.toml": read_text(target_spec)}
    open_folder(out)
    began = time.perf_counter()
    with contextlib.ExitStack() as stack, steps() as progress:
        progress("opening the devices")
        setup = _station(stack, source_spec, board_spec, arm, target, rate, 1e-3 * sync_ms)
        require_start(setup, plan, targets)
        make_room(out)
        for name, text in files.items():
            write_text(out / name, text)
        rig.save(out / "rig.json")
        try:
            summary = _run(setup, rig, plan, targets, not open_loop, out, began, progress)
        except KeyboardInterrupt:
            click.echo(f"the arm was stopped; what was measured until then is in {out}", err=True)
            raise
    if as_json:
        click.echo(json.dumps(summary))
    else:
        tell(summary, out)


def _station(
    stack: contextlib.ExitStack, source: str, board: str, arm: Arm, target: Composite, rate_hz: float, sync_s: float
) -> Setup:
    """Open the devices, or the workcell in their place; the stack closes them."""
    if source.startswith(_SIM) != board.startswith(EMULATED):
        raise InputError(
            f"--source {source} --board {board}: {_SIM} and {EMULATED} are one workcell and go together; real ones are "
            "usb:0,1 and serial:/dev/ttyACM0"
        )
    if source.startswith(_SIM):
        machine = "unicorn" if board == EMULATED else emulated_machine(board)
        cameras = source.removeprefix(_SIM) or _SIM_CAMERAS
        cell = stack.enter_context(Workcell(arm=_SIM_ARM, cameras=cameras, machine=machine, model=arm))
        return replace(setup_of(cell), target=target)
    opened = stack.enter_context(open_board(board))
    shots = LiveShots(open_source(source))
    stack.callback(shots.close)
    return Setup(arm, opened, shots.poll, target, lambda q: np.zeros(6), rate_hz, sync_s, HostClock())


def _run(
    setup: Setup,
    rig: StereoRig,
    plan: MotionPlan,
    targets: Array,
    close_loop: bool,
    out: Path,
    began: float,
    progress: Progress,
) -> dict[str, Any]:
    """Run and write; raises what ended the run early after everything is written."""
    outcome = run_experiment(setup, rig, plan, targets, progress=progress, close_loop=close_loop)
    progress("writing and drawing")
    facts = {"arm": setup.arm.name, "board": setup.board.welcome.board}
    return finish(Finished(setup.arm, rig, outcome, plan, None, facts, began, [], None), out)
