"""``armsight check``: judge an arm as robots are judged (ISO 9283), or plan the motions of such a test."""

from __future__ import annotations

import json
from pathlib import Path

import click
import numpy as np

from armsight.app.calibrate.report import report_folder
from armsight.app.check.evaluate import judge, read_check
from armsight.app.check.plan import CYCLES, PlannedTest, plan_csv, plan_test
from armsight.app.check.report import PAGE, text, write_check
from armsight.errors import InputError
from armsight.files import check_writable, write_text
from armsight.loop.identify.model_file import open_model

_KINDS = (".toml", ".csv")


class _Check(click.Group):
    """``armsight check DATA`` and ``armsight check plan``: what is no subcommand is data to judge."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        return super().parse_args(ctx, args if args and args[0] in self.commands else ["judge", *args])

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        name, found, rest = super().resolve_command(ctx, args)
        return ("" if name == "judge" else name), found, rest  # as it is called


@click.group("check", cls=_Check)
def command() -> None:
    """Judge an arm as robots are judged."""


@command.command("judge")
@click.argument("data", metavar="RUN|POSES.csv", type=click.Path(path_type=Path))
@click.option("--closed", is_flag=True, help="Of a run: judge the motions with the loop closed on vision.")
@click.option(
    "-o", "--out", metavar="DIR", type=click.Path(path_type=Path), help="Folder for report.html, check.json, figures."
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object, SI units.")
def judged(data: Path, closed: bool, out: Path | None, as_json: bool) -> None:
    """Judge an arm by ISO 9283: accuracy and repeatability of poses, distance, paths, drift, and a circle.

    DATA is a run's folder (armsight run, armsight demo) or a CSV (docs/check.md). Figures stand without the instrument's
    own noise; what is below it is called not resolvable. The motions of a test: armsight check plan --help.
    """
    if out is not None and out.is_dir():
        if (out / "wanted.csv").exists():
            raise InputError(f"{out}: holds a run, whose report would be written over; choose another folder")
        if (out / PAGE).exists() and not (out / "check.json").exists():
            raise InputError(
                f"{out}: holds another command's {PAGE}, which would be written over; choose another folder"
            )
        check_writable(out / "check.csv", apart_from=(data, data / "check.csv"))
    attained = read_check(data, closed=closed)
    facts = judge(attained)
    if out is not None:
        write_check(facts, attained.rows, data, report_folder(out))
    for note in facts["notes"]:
        click.echo(f"note: {note}", err=True)
    if as_json:
        click.echo(json.dumps(facts))
        return
    click.echo(text(facts))
    if out is not None:
        click.echo(f"\nwritten: {out}/report.html with its figures as PNG, check.json, check.csv")


@command.command("plan")
@click.option(
    "--model", required=True, metavar="MODEL", help="The arm: a name (armsight arm list), a .toml or a .urdf."
)
@click.option(
    "--test",
    "name",
    type=click.Choice(list(CYCLES)),
    default="poses",
    show_default=True,
    help="Five poses in a cube; a hundred all over it; a line across it; a circle both ways.",
)
@click.option("--cycles", type=click.IntRange(1, 1000), help="How many times: 30 for poses, 1 wide, 10 line, 3 circle.")
@click.option("--centre", nargs=3, type=float, metavar="X Y Z", help="The cube's centre in the base, mm.")
@click.option("--speed", type=click.FloatRange(1.0, 1e4), default=100.0, show_default=True, help="On paths, mm/s.")
@click.option(
    "--seen-in", metavar="RUN", type=click.Path(path_type=Path), help="An earlier run: its cameras must see all of it."
)
@click.option(
    "-o",
    "--out",
    metavar="FILE",
    type=click.Path(path_type=Path),
    help="check.toml for armsight run --motion; .csv: the poses alone.",
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object, SI units.")
def plan(
    model: str,
    name: str,
    cycles: int | None,
    centre: tuple[float, float, float] | None,
    speed: float,
    seen_in: Path | None,
    out: Path | None,
    as_json: bool,
) -> None:
    """Plan a test in the largest cube the arm reaches, clear of its limits and of singularities.

    Poses and paths lie in the cube's diagonal plane, as ISO 9283 has it. Look at them in your cell before you run them.
    """
    if out is not None:
        check_writable(out)
        if out.suffix not in _KINDS or (out.suffix == ".csv" and name in ("line", "circle")):
            raise InputError(f"{out}: a plan is written as .toml, motions to run, or, of poses, as .csv")
    middle = None if centre is None else np.array(centre) / 1e3
    test = plan_test(open_model(model), name, cycles, middle, speed / 1e3, seen_in)
    if out is not None:
        write_text(out, test.motions if out.suffix == ".toml" else plan_csv(test.plan))
    if as_json:
        click.echo(json.dumps(_facts(test)))
        return
    at = " ".join(f"{1e3 * v:.0f}" for v in test.plan.centre)
    what = {"line": "a line", "circle": "a circle"}.get(name, f"{len(test.plan.names)} poses")
    click.echo(f"{what} in a cube of {1e3 * test.plan.side_m:.0f} mm about {at} mm, cycles: {test.cycles}")
    if out is not None and out.suffix == ".toml":
        click.echo(f"written: {out}; run it: armsight run --motion {out} ... -o RUN; then: armsight check RUN")


def _facts(test: PlannedTest) -> dict[str, object]:
    """Return a plan for programs."""
    return {
        "test": test.name,
        "cycles": test.cycles,
        "side_m": test.plan.side_m,
        "centre_m": test.plan.centre.tolist(),
        "poses": list(test.plan.names),
        "q_rad": test.plan.q.tolist(),
        "T_base_tool": test.plan.Ts_base_tool.tolist(),
    }
