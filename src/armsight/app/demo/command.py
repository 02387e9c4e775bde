"""``armsight demo``: the whole experiment in the simulated workcell."""

from __future__ import annotations

import gc
from pathlib import Path

import click

from armsight.app.options import output, references_option
from armsight.app.show.messages import require


@click.command("demo")
@output("DIR", "Folder of the run.", default="demo")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Seed of all random numbers.")
@click.option(
    "--arm",
    default="worn",
    show_default=True,
    help="The simulated arm: nominal, used, worn, or a TOML file (docs/howto/workcell.md).",
)
@click.option(
    "--model",
    default="six_r",
    show_default=True,
    help="The simulated arm's model: so101 and ar4 with controllers of their own, or six joints with our firmware.",
)
@click.option(
    "--cameras",
    show_default="1280x720@60; @30 for so101 and ar4",
    help="[NAME:]WIDTHxHEIGHT@HZ or NAME: webcams, a camera preset such as webcam-good-light, or its TOML file "
    "(docs/concepts/camera.md).",
)
@click.option(
    "--board",
    default="emulated:unicorn",
    show_default=True,
    help="The controller: emulated:unicorn, emulated:qemu or emulated:host.",
)
@click.option(
    "--layout",
    default="parallel",
    show_default=True,
    type=click.Choice(["parallel", "verging"]),
    help="Layout of the cameras.",
)
@click.option(
    "--nominal-arm",
    metavar="FILE",
    help="The arm model to compute with, such as corrected.toml of armsight identify; by default the nominal table.",
)
@click.option("--sync-led", is_flag=True, help="Put an LED on the board's clock in view: it gives delay and skew.")
@references_option()
@click.option("--quick", is_flag=True, help="Fewer calibration shots and motions, no studies.")
@click.option("--json", "as_json", is_flag=True, help="Print the summary as one JSON object.")
def command(
    output: Path,
    seed: int,
    arm: str,
    model: str,
    cameras: str | None,
    board: str,
    layout: str,
    nominal_arm: str | None,
    sync_led: bool,
    references: Path | None,
    quick: bool,
    as_json: bool,
) -> None:
    """Calibrate, measure the moving arm, compare the tracks, and close the loop, in a simulated workcell.

    Simulated dynamics, rendered cameras, and the real ARM firmware under emulation; needs no hardware. DIR receives the
    run: report.html, summary.json, every track as CSV (docs/howto/run.md).
    """
    emulator = board.removeprefix("emulated:")
    if emulator == board:
        raise click.UsageError(
            f"--board {board}: the workcell's board is emulated:unicorn, emulated:qemu or emulated:host"
        )

    require("the demo", "sim", "matplotlib", "pyarrow", "mujoco", *(["unicorn"] if emulator == "unicorn" else []))

    from armsight.app.demo.demo import Demo, run_demo
    from armsight.app.progress import steps
    from armsight.app.run.report import show
    from armsight.robot.arm_file import open_arm

    gc.freeze()  # what was imported stays: no collection has to look at it
    nominal = None if nominal_arm is None else open_arm(nominal_arm)
    demo = Demo(output, arm, cameras, seed, emulator, layout, model, quick, nominal, nominal_arm, sync_led, references)
    try:
        with steps() as progress:
            report = run_demo(demo, progress=progress)
    except KeyboardInterrupt:
        click.echo(f"the arm was stopped; what was measured until then is in {output}", err=True)
        raise
    show(report, output, as_json=as_json)
