"""``armsight demo``: calibrate and measure a rendered recording, and print the error against its truth."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.table import Table

from armsight.app.cli.progress import steps
from armsight.app.demo import run_demo
from armsight.app.demo_figure import write_figure
from armsight.app.report import write_report
from armsight.app.report_draw import require_matplotlib


@click.command("demo")
@click.option("-o", "--out", default="demo", show_default=True, metavar="DIR", type=click.Path(path_type=Path))
@click.option(
    "--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Of poses, background and noise."
)
@click.option("--json", "as_json", is_flag=True, help="Print the figures as one JSON object.")
def command(out: Path, seed: int, as_json: bool) -> None:
    """Render what two cameras see of a board and of an end-effector, calibrate, measure, and compare with the truth.

    Needs no hardware. DIR receives the recording, the rig, the poses, a report and figures.
    """
    require_matplotlib()
    started = time.perf_counter()
    with steps() as progress:
        result = run_demo(out, seed=seed, progress=progress)
        progress("drawing")
        write_report(result.calibration, out / "report")
        write_figure(result, out / "demo.png")
    summary = {**result.summary(), "seed": seed, "wall_s": time.perf_counter() - started, "folder": str(out)}
    if as_json:
        click.echo(json.dumps(summary))
    else:
        _tell(summary, out)


def _tell(s: dict[str, Any], out: Path) -> None:
    """Print the figures in mm and degrees."""
    console = Console(highlight=False, soft_wrap=True)
    table = Table(title=f"End-effector measured in {s['measured']} of {s['shots']} rendered shots, against the truth")
    for column in ("", "RMS", "max", "predicted sigma"):
        table.add_column(column, justify="left" if not column else "right")
    degrees = 180 / 3.141592653589793
    for name, key, factor, unit in (("position", "position", 1e3, "m"), ("orientation", "orientation", degrees, "rad")):
        shown = "mm" if unit == "m" else "deg"
        values = [f"{factor * s[f'{key}_{kind}_{unit}']:.4f} {shown}" for kind in ("rms", "max", "sigma_rms")]
        table.add_row(name, *values)
    console.print(table)
    console.print(
        f"the truth lies in the predicted 95% ellipsoid in {100 * s['inside_95_share']:.0f}% of the shots (one calibration "
        f"serves all, so they err together); held-out calibration: "
        f"epipolar {s['heldout_epipolar_rms_px']:.3f} px, board {1e3 * s['heldout_rigid_rms_m']:.4f} mm; baseline off by "
        f"{1e3 * s['baseline_error_m']:+.4f} mm, focal length by {s['focal_error_px']:+.3f} px"
    )
    console.print(
        f"{out / 'demo.png'} shows the run, {out / 'report' / 'index.html'} the calibration, {out / 'poses.csv'} every "
        f"pose; {s['wall_s']:.1f} s"
    )
