"""``armsight identify``: what an arm really is, from joint angles and where its tool was seen."""

from __future__ import annotations

import json
import time
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import click

from armsight.app.identify import run as identify_words
from armsight.app.identify.plan import plan_csv, plan_from, plan_text
from armsight.app.identify.report import write_identify_report
from armsight.app.identify.run import results_in, run_identify, summary, write_results
from armsight.app.progress import steps
from armsight.app.report.plotting import require_matplotlib
from armsight.errors import InputError
from armsight.files import check_writable, write_text
from armsight.loop.identify.model_file import open_model
from armsight.loop.identify.read import TURNS, read_poses
from armsight.vision.rig import StereoRig


@click.group(invoke_without_command=True)
@click.option("--model", metavar="MODEL", help="The nominal arm: a name (armsight arm list), a .toml or a .urdf file.")
@click.option(
    "--data", metavar="POSES.csv", type=click.Path(path_type=Path), help="Joint angles, and where the tool was seen."
)
@click.option(
    "--validate", "other", metavar="OTHER.csv", type=click.Path(path_type=Path), help="Poses to hold it against."
)
@click.option("--turns", type=click.Choice(TURNS), help="How rx_deg, ry_deg, rz_deg are meant; else they are not used.")
@click.option(
    "--prior", "priors", multiple=True, metavar="NAME=SIGMA", help="Sigma (m, rad) of a parameter or kind; 0 keeps it."
)
@click.option(
    "-o", "--out", metavar="DIR", type=click.Path(path_type=Path), help="Folder for the corrected arm and the report."
)
@click.option("-v", "--verbose", is_flag=True, help="Say also why what was not fitted was not.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object, SI units.")
@click.pass_context
def command(
    ctx: click.Context,
    model: str | None,
    data: Path | None,
    other: Path | None,
    turns: str | None,
    priors: tuple[str, ...],
    out: Path | None,
    verbose: bool,
    as_json: bool,
) -> None:
    """Find what an arm really is: its table, joint zeros, sensors' errors, backlash and sag, each with sigma.

    Formats, and what each result means: docs/identify.md.
    """
    if ctx.invoked_subcommand is not None:
        return
    if model is None or data is None:
        raise InputError("give --model and --data: armsight identify --model ur10 --data poses.csv -o corrected/")
    arm = open_model(model)
    if out is not None:
        require_matplotlib()
    started = time.perf_counter()
    with nullcontext() if out is None else results_in(out, (data, other, Path(model))), steps() as progress:
        progress("reading")
        read = read_poses(data, turns=turns)
        held = None if other is None else read_poses(other, turns=turns)
        notes = read.notes if held is None else (*read.notes, *(f"{other}: {note}" for note in held.notes))
        run = run_identify(
            arm,
            read.measured,
            read.lines,
            None if held is None else held.measured,
            priors=_priors(priors),
            notes=notes,
            progress=progress,
        )
        if out is not None:
            progress("writing")
            write_results(run, out)
            write_identify_report(run, out)
    for note in run.notes:
        click.echo(f"note: {note}", err=True)
    if as_json:
        facts: dict[str, Any] = {**summary(run), "out": None if out is None else str(out)}
        click.echo(json.dumps({**facts, "wall_s": time.perf_counter() - started}))
        return
    click.echo(identify_words.headline(run))
    click.echo(identify_words.text(run, everything=verbose))
    if out is not None:
        click.echo(
            f"\nwritten: {out}/corrected.toml, corrected.urdf, zeros.toml, parameters.csv, identify.json, report.html"
        )


@command.command()
@click.option("--model", required=True, metavar="MODEL", help="The nominal arm: a name, a .toml or a .urdf file.")
@click.option("--data", metavar="DONE.csv", type=click.Path(path_type=Path), help="What was measured already.")
@click.option(
    "--rig", metavar="RIG.json", type=click.Path(path_type=Path), help="The cameras that shall see the poses."
)
@click.option("-n", "count", type=click.IntRange(min=1, max=200), default=20, show_default=True, help="How many poses.")
@click.option("--seed", type=int, default=0, show_default=True, help="Of the candidates.")
@click.option("-o", "--out", metavar="PLAN.csv", type=click.Path(path_type=Path), help="Write the poses here.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object, SI units.")
def plan(
    model: str, data: Path | None, rig: Path | None, count: int, seed: int, out: Path | None, as_json: bool
) -> None:
    """Choose the poses that tell most about an arm, and say how many more buy how much.

    With --data the poses measured already count, and place the arm; with --rig and --data only what both cameras see is
    chosen, weighted by how well they see it. Check the poses against your cell before you move to them.
    """
    if rig is not None and data is None:
        raise InputError("--rig needs --data: without any pose measured, where the arm is to the cameras is not known")
    if out is not None:
        if out.suffix != ".csv":
            raise InputError(f"{out}: poses are written as .csv; name it so")
        check_writable(out, apart_from=(data, rig))
    with steps() as progress:
        progress("choosing poses")
        done = None if data is None else read_poses(data).measured
        chosen, _ = plan_from(open_model(model), done, None if rig is None else StereoRig.load(rig), count, seed)
    if out is not None:
        write_text(out, plan_csv(chosen))
    if as_json:
        facts = {"q_rad": chosen.q.tolist(), "approach": chosen.approach.tolist(), "sigma_m": chosen.sigma_m.tolist()}
        click.echo(json.dumps({**facts, "random_sigma_m": chosen.random_sigma_m.tolist()}))
    else:
        click.echo(plan_text(chosen))
        if out is not None:
            click.echo(f"\nwritten: {out}")


def _priors(texts: tuple[str, ...]) -> dict[str, float]:
    """Read NAME=SIGMA."""
    out = {}
    for text in texts:
        name, _, sigma = text.partition("=")
        try:
            out[name] = float(sigma)
        except ValueError:
            raise InputError(f"--prior {text!r} must be NAME=SIGMA, such as a2=0.001 or alpha=0") from None
    return out
