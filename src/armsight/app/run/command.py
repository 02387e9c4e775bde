"""``armsight run``: the experiment on real devices, or in the workcell as ``sim:``."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import click
import numpy as np

from armsight.app.progress import steps
from armsight.app.report.plotting import require_matplotlib
from armsight.app.run.calibrate import handeye_poses
from armsight.app.run.experiment import Progress, require_start, run_experiment
from armsight.app.run.folder import Finished, finish, make_room, open_folder
from armsight.app.run.motion_file import DEFAULT_MOTION, MotionPlan, read_motions
from armsight.app.run.record import require_pyarrow
from armsight.app.run.setup import HostClock, LiveShots, Setup, setup_of
from armsight.app.run.summary import RunSummary, print_summary
from armsight.data import Array
from armsight.errors import InputError
from armsight.files import read_text, write_text
from armsight.robot.arm import Arm
from armsight.robot.arm_file import open_arm
from armsight.robot.boards.opening import EMULATED, emulator_name, open_board
from armsight.sim.workcell.workcell import Workcell
from armsight.vision.follow.follower import follows
from armsight.vision.markers.targets import Composite, open_target
from armsight.vision.rig import StereoRig
from armsight.vision.sources import open_source

_HANDEYE_POSES = 30
_SIM = "sim:"
#: The workcell's arm and cameras where ``sim:`` names none: those of ``armsight demo``.
_SIM_ARM, _SIM_CAMERAS = "worn", "1280x720@60"


@dataclass(frozen=True)
class Devices:
    """The devices as the command line names them.

    Attributes:
        source: the cameras, such as usb:0,1; or sim:.
        board: the controller board, such as serial:/dev/ttyACM0; or emulated:.
        arm: the nominal arm.
        target: the body on the tool.
        rate_hz: rate of the cameras, Hz.
        sync_s: standard deviation of the time between the two exposures of a shot, s.
    """

    source: str
    board: str
    arm: Arm
    target: Composite
    rate_hz: float
    sync_s: float


@dataclass(frozen=True)
class RunPlan:
    """What is to be run.

    Attributes:
        rig: the calibrated cameras.
        motions: the motions.
        targets: (N, 6) joint angles of the hand-eye poses, rad.
        close_loop: whether the motions are made a second time with the loop closed.
        began: when the command began, by ``time.perf_counter``, s.
    """

    rig: StereoRig
    motions: MotionPlan
    targets: Array
    close_loop: bool
    began: float


@click.command("run")
@click.option(
    "--source",
    "source_spec",
    required=True,
    help="Where shots come from, such as usb:0,1 (docs/howto/sources.md); sim: is the simulated workcell.",
)
@click.option(
    "--board",
    "board_spec",
    required=True,
    help="The controller: serial:PORT (docs/howto/board.md); emulated: with sim:.",
)
@click.option("--rig", "rig_path", required=True, type=click.Path(path_type=Path), help="The calibrated rig, rig.json.")
@click.option("--target", "target_spec", required=True, help="The body on the tool: a body file of discs.")
@click.option(
    "--arm",
    "arm_spec",
    default="six_r",
    show_default=True,
    help="The arm: a name (armsight arm list), a .toml or a .urdf file.",
)
@click.option(
    "--motion",
    type=click.Path(path_type=Path),
    default=DEFAULT_MOTION,
    help="The motions (TOML, docs/howto/run.md); by default five poses, a line and a circle.",
)
@click.option(
    "--rate",
    type=click.FloatRange(min=0.1, max=10_000.0),
    default=60.0,
    show_default=True,
    help="Rate of the cameras, Hz; sim: knows its own.",
)
@click.option(
    "--sync-ms",
    type=click.FloatRange(min=0.0, max=1_000.0),
    default=0.1,
    show_default=True,
    help="Sigma of the time between the two exposures of a shot, ms; sim: knows its own.",
)
@click.option("--open-loop", is_flag=True, help="Control by the potentiometers alone; do not close the loop on vision.")
@click.option(
    "-o",
    "--output",
    default="run",
    show_default=True,
    metavar="DIR",
    type=click.Path(path_type=Path),
    help="Folder of the run.",
)
@click.option("--json", "as_json", is_flag=True, help="Print the summary as one JSON object.")
def command(
    source_spec: str,
    board_spec: str,
    rig_path: Path,
    target_spec: str,
    arm_spec: str,
    motion: Path,
    rate: float,
    sync_ms: float,
    open_loop: bool,
    output: Path,
    as_json: bool,
) -> None:
    """Run the experiment on a real arm: hand-eye calibration, the motions, the loop closed on vision.

    The arm moves on its own: hand-eye poses around those of the motion, a sweep, the motions twice. Keep the emergency stop
    at hand. Ctrl-C stops the arm first and then saves what was measured.
    """
    require_matplotlib()
    require_pyarrow()
    arm, rig, target = open_arm(arm_spec), StereoRig.load(rig_path), open_target(target_spec)
    if not follows(target):
        raise InputError(
            f"{target_spec}: {target.body.name} cannot be followed: a body of three discs or more is needed"
        )
    motions = _motions(arm, arm_spec, motion)
    ends: list[Array] = [motions.start, *(m.trajectory.at(m.trajectory.duration_s).q for m in motions.motions)]
    targets = handeye_poses(arm, np.array(ends), _HANDEYE_POSES, 0)
    files = {"motion.toml": read_text(motion), "body.toml": read_text(target_spec)}
    open_folder(output)
    plan = RunPlan(rig, motions, targets, not open_loop, time.perf_counter())
    devices = Devices(source_spec, board_spec, arm, target, rate, 1e-3 * sync_ms)
    with steps() as progress:
        progress("opening the devices")
        with _opened(devices) as setup:
            require_start(setup, motions, targets)
            make_room(output)
            for name, text in files.items():
                write_text(output / name, text)
            rig.save(output / "rig.json")
            try:
                summary = _run(setup, plan, output, progress)
            except KeyboardInterrupt:
                click.echo(f"the arm was stopped; what was measured until then is in {output}", err=True)
                raise
    if as_json:
        click.echo(json.dumps(summary.to_json()))
    else:
        print_summary(summary, output)


def _motions(arm: Arm, arm_spec: str, path: Path) -> MotionPlan:
    """Plan the motions; where an arm cannot make the built-in ones, say which option gives others."""
    try:
        return read_motions(arm, path)
    except InputError as error:
        if path != DEFAULT_MOTION:
            raise
        reason = str(error).removeprefix(f"{path}: ")
        raise InputError(
            f"--arm {arm_spec}: the built-in motion is made for six_r ({reason}); give this arm's own with --motion FILE "
            "(docs/howto/run.md), or plan one: armsight check plan"
        ) from None


@contextlib.contextmanager
def _opened(devices: Devices) -> Iterator[Setup]:
    """Open the devices, or the workcell instead of them, and close them at the end of the block."""
    source, board = devices.source, devices.board
    if source.startswith(_SIM) != board.startswith(EMULATED):
        raise InputError(
            f"--source {source} --board {board}: {_SIM} and {EMULATED} are one workcell and go together; real ones are "
            "usb:0,1 and serial:/dev/ttyACM0"
        )
    with contextlib.ExitStack() as stack:
        if source.startswith(_SIM):
            emulator = "unicorn" if board == EMULATED else emulator_name(board)
            cameras = source.removeprefix(_SIM) or _SIM_CAMERAS
            workcell = stack.enter_context(
                Workcell.open(arm=_SIM_ARM, cameras=cameras, emulator=emulator, model=devices.arm)
            )
            yield replace(setup_of(workcell), target=devices.target)
            return
        opened = stack.enter_context(open_board(board))
        shots = LiveShots(open_source(source))
        stack.callback(shots.close)
        shots.start()
        yield Setup(
            devices.arm,
            opened,
            shots.poll,
            devices.target,
            lambda q: np.zeros(6),
            devices.rate_hz,
            devices.sync_s,
            HostClock(),
        )


def _run(setup: Setup, plan: RunPlan, output: Path, progress: Progress) -> RunSummary:
    """Run and write; raises what ended the run early after everything is written."""
    outcome = run_experiment(setup, plan.rig, plan.motions, plan.targets, progress=progress, close_loop=plan.close_loop)
    progress("writing and plotting")
    properties = {"arm": setup.arm.name, "board": setup.board.welcome.board}
    return finish(Finished(setup.arm, plan.rig, outcome, plan.motions, None, properties, plan.began, [], None), output)
