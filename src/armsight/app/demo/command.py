"""``armsight demo``: the whole experiment in the simulated workcell."""

from __future__ import annotations

import gc
from pathlib import Path

import click

from armsight.app.options import JSON, REFERENCES, SEED, declared, option, out
from armsight.app.show.messages import require


@click.command("demo")
@declared
def command(
    output: Path = out("DIR", "Folder of the run.", default="demo", report=True),
    seed: int = SEED,
    arm: str = option(
        "The simulated arm: nominal, used, worn, or a TOML file (docs/howto/workcell.md).", default="worn"
    ),
    model: str = option(
        "The simulated arm's model: so101 and ar4 with controllers of their own, or six joints with our firmware.",
        default="six_r",
    ),
    cameras: str | None = option(
        "[NAME:]WIDTHxHEIGHT@HZ or NAME: webcams, a camera preset such as webcam-good-light, or its TOML file "
        "(docs/concepts/camera.md).",
        show_default="1280x720@60; @30 for so101 and ar4",
    ),
    board: str = option(
        "The controller: emulated:unicorn, emulated:qemu or emulated:host.", default="emulated:unicorn"
    ),
    layout: str = option("Layout of the cameras.", default="parallel", choices=["parallel", "verging"]),
    nominal_arm: str | None = option(
        "The arm model to compute with, such as corrected.toml of armsight identify; by default the nominal table.",
        metavar="FILE",
    ),
    sync_led: bool = option("Put an LED on the board's clock in view: it gives delay and skew."),
    references: Path | None = REFERENCES,
    quick: bool = option("Fewer calibration shots and motions, no studies."),
    as_json: bool = JSON,
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
