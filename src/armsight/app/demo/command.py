"""``armsight demo``: the whole experiment in the simulated workcell."""

from __future__ import annotations

import click
import json
from armsight.app.demo.demo import Demo, run_demo
from armsight.app.progress import steps
from armsight.app.report.plotting import require_matplotlib
from armsight.app.run.record import require_pyarrow
from armsight.app.run.text import tell
from armsight.loop.identify.model_file import open_model
from pathlib import Path


@click.command("demo")
@click.option("-o", "--out", default="demo", show_default=True, metavar="DIR", type=click.Path(path_type=Path))
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Of everything that is drawn.")
@click.option(
    "--arm", default="worn", show_default=True, help="nominal, used, worn, or a TOML file (docs/workcell.md)."
)
@click.option("--cameras", default="1280x720@60", show_default=True, help="WIDTHxHEIGHT@HZ, or webcams.")
@click.option(
    "--board", default="emulated:unicorn", show_default=True, help="emulated:unicorn, emulated:qemu or emulated:host."
)
@click.option("--rig", default="parallel", show_default=True, type=click.Choice(["parallel", "verging"]))
@click.option(
    "--model",
    metavar="FILE",
    help="The table the arm is believed to have, as corrected.toml of armsight identify; else the one it was built to.",
)
@click.option("--quick", is_flag=True, help="Fewer calibration shots and motions, no studies.")
@click.option("--json", "as_json", is_flag=True, help="Print the summary as one JSON object.")
def command(
    out: Path, seed: int, arm: str, cameras: str, board: str, rig: str, model: str | None, quick: bool, as_json: bool
) -> None:
    """Calibrate, measure the moving arm, show who is right, and close the loop, in a simulated workcell.

    Real physics, rendered cameras, and the real ARM firmware under emulation; needs no hardware. DIR receives the run:
    report.html, summary.json, every track as CSV and Parquet (docs/run.md).
    """
    require_matplotlib()
    require_pyarrow()
    machine = board.removeprefix("emulated:")
    if machine == board:
        raise click.UsageError(
            f"--board {board}: the workcell's board is emulated:unicorn, emulated:qemu or emulated:host"
        )
    believed = None if model is None else open_model(model)
    try:
        with steps() as progress:
            summary = run_demo(Demo(out, arm, cameras, seed, machine, rig, quick, believed, model), progress=progress)
    except KeyboardInterrupt:
        click.echo(f"the arm was stopped; what was measured until then is in {out}", err=True)
        raise
    if as_json:
        click.echo(json.dumps(summary))
    else:
        tell(summary, out)
