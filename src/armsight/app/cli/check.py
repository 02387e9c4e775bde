"""``armsight check``: judge an arm as robots are judged (ISO 9283), or say which poses to go to for it."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

import click
import numpy as np

from armsight.app import check_run
from armsight.errors import InputError
from armsight.files import check_writable, write_text
from armsight.geometry.rotation import quaternion_wxyz
from armsight.loop.identify.model_file import open_model
from armsight.loop.iso9283_plan import CYCLES, CheckPlan, plan_check


@click.command("check")
@click.argument("data", required=False, metavar="[RUN|POSES.csv]", type=click.Path(path_type=Path))
@click.option("--plan", "model", metavar="MODEL", help="Do not judge: choose the poses to go to with this arm.")
@click.option("--wide", is_flag=True, help="With --plan: 100 poses all over the cube instead of the standard's five.")
@click.option("--centre", nargs=3, type=float, metavar="X Y Z", help="With --plan: the cube's centre in the base, mm.")
@click.option(
    "-o", "--out", metavar="FILE", type=click.Path(path_type=Path), help="To write: figures (JSON) or plan (CSV)."
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object, SI units.")
def command(
    data: Path | None,
    model: str | None,
    wide: bool,
    centre: tuple[float, float, float] | None,
    out: Path | None,
    as_json: bool,
) -> None:
    """Compute pose accuracy and repeatability, distance, path, drift and circle from attained poses.

    Figures stand without the instrument's own noise; what is below it is called not resolvable. Columns: docs/check.md.
    """
    if (data is None) == (model is None):
        raise InputError("give a run folder or a CSV to judge, or --plan MODEL to choose the poses of a test")
    if out is not None:
        check_writable(out, apart_from=(data,))
    if model is not None:
        middle = None if centre is None else np.array(centre) / 1e3
        _plan(plan_check(open_model(model), centre=middle, wide=wide), out, as_json)
        return
    if wide or centre is not None:
        raise InputError("--wide and --centre go with --plan")
    facts = check_run.judge(check_run.read_check(data)) if data is not None else {}
    if out is not None:
        write_text(out, json.dumps(facts, indent=1) + "\n")
    click.echo(json.dumps(facts) if as_json else check_run.text(facts))


def _plan(plan: CheckPlan, out: Path | None, as_json: bool) -> None:
    """Print or write a plan."""
    if out is not None:
        write_text(out, _plan_csv(plan))
    if as_json:
        facts = {"poses": list(plan.names), "q_rad": plan.q.tolist(), "T_base_tool": plan.Ts_base_tool.tolist()}
        click.echo(json.dumps({**facts, "side_m": plan.side_m, "cycles": 1 if len(plan.names) > 5 else CYCLES}))
        return
    cycles = "once and in several directions" if len(plan.names) > 5 else f"{CYCLES} times, always in the same order"
    middle = " ".join(f"{1e3 * v:.0f}" for v in plan.centre)
    click.echo(
        f"{len(plan.names)} poses in a cube of {1e3 * plan.side_m:.0f} mm about {middle} mm; go to them {cycles}"
    )


def _plan_csv(plan: CheckPlan) -> str:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    names = [f"command_{n}" for n in ("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")]
    writer.writerow(["pose", *(f"q{i}_rad" for i in range(1, 7)), *names])
    for name, q, T in zip(plan.names, plan.q, plan.Ts_base_tool, strict=True):
        writer.writerow([name, *(f"{v:.9f}" for v in (*q, *T[:3, 3], *quaternion_wxyz(T[:3, :3])))])
    return out.getvalue()
