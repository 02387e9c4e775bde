"""``armsight check``: evaluate an arm by ISO 9283, or plan the motions of such a test."""

from __future__ import annotations

from pathlib import Path

import click

from armsight.app.check import CYCLES
from armsight.app.options import JSON, argument, declared, option, out
from armsight.app.show.messages import note, print_answer
from armsight.errors import InputError
from armsight.files import check_folder, check_writable, write_text


class _Context(click.Context):
    """The context of a command that is called without its name."""

    @property
    def command_path(self) -> str:
        return super().command_path.rstrip()


class _Evaluate(click.Command):
    """``armsight check RUN``, whose usage also names the group's other command."""

    context_class = _Context

    def format_usage(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        super().format_usage(ctx, formatter)
        formatter.write_usage(f"{ctx.command_path} plan", "[OPTIONS]", prefix="       ")


class _Check(click.Group):
    """``armsight check RUN`` and ``armsight check plan``: what is no subcommand is data to evaluate."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        return super().parse_args(ctx, args if args and args[0] in self.commands else ["evaluate", *args])

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        name, found, rest = super().resolve_command(ctx, args)
        return ("" if name == "evaluate" else name), found, rest  # as it is called


@click.group("check", cls=_Check)
def command() -> None:
    """Evaluate an arm by ISO 9283: accuracy and repeatability."""


@command.command("evaluate", cls=_Evaluate)
@declared
def evaluated(
    data: Path = argument("RUN|POSES.csv"),
    closed: bool = option("Of a run: evaluate the motions with the loop closed on vision."),
    output: Path | None = out("DIR", "Folder of report.html, check.json, plots; needs armsight[report].", report=True),
    columns: str | None = option("Columns of your CSV, such as x_m=X,command_x_m=X0.", metavar="NAME=COLUMN,..."),
    limit_texts: tuple[str, ...] = option(
        "Limit of a metric, such as AP=0.5mm: prints PASS or FAIL, exit code 1 if one fails. May be repeated.",
        "--limit",
        metavar="NAME=LENGTH",
    ),
    as_json: bool = JSON,
) -> int:
    """Evaluate an arm by ISO 9283: accuracy and repeatability of poses, distance, paths, drift, and a circle.

    RUN is a folder of armsight run or armsight demo, POSES.csv a table of attained poses (docs/howto/iso9283.md).
    Metrics are without the instrument's own noise; one below that noise is called not resolvable. The motions of a test:
    armsight check plan --help.
    """
    from armsight.app.check.evaluate import evaluate, read_check
    from armsight.app.check.report import REPORT_FILES, check_report
    from armsight.app.check.result import check_limits, metric_lines, read_limits
    from armsight.app.check.rows import rows_csv
    from armsight.app.show.plotting import require_matplotlib

    if output is not None:
        require_matplotlib()
        check_folder(
            output, holding=REPORT_FILES, apart_from=(data, data / "check.csv"), problem="no report can be written here"
        )
    limits = read_limits(limit_texts)
    attained = read_check(data, closed=closed, columns=columns)
    result = evaluate(attained)
    outcomes = check_limits(list(metric_lines(result)), limits) if limits else []
    report = check_report(result, attained.rows, data, outcomes)
    if output is not None:
        report.write(output, {"check.json": report.json_text(), "check.csv": rows_csv(list(attained.rows))})
    files = "report.html with its figures as PNG, SVG and CSV, check.json, check.csv"
    report.echo(as_json=as_json, written=None if output is None else f"{output}/{files}")
    return 1 if any(each is not None and not each.passed for each in outcomes) else 0


@command.command("plan")
@declared
def plan(
    arm_name: str = option("The arm: a name (armsight arm list), a .toml or a .urdf.", "--arm", metavar="ARM"),
    name: str = option(
        "Five poses in a cube; a hundred all over it; a line across it; a circle both ways.",
        "--test",
        choices=CYCLES,
        default="poses",
    ),
    cycles: int | None = option("Cycles; by default 30 for poses, 1 wide, 10 line, 3 circle.", min=1, max=1000),
    centre: tuple[float, float, float] | None = option(
        "The cube's centre in the base, mm.", nargs=3, type=float, metavar="X Y Z"
    ),
    speed: float = option("Speed on paths, mm/s.", min=1.0, max=1e4, default=100.0),
    visible_in: Path | None = option("An earlier run; both of its cameras must see the whole test.", metavar="RUN"),
    output: Path | None = out("FILE", "check.toml for run --motion; .csv: poses alone.", kind=r"^\[\[motion|^pose,"),
    as_json: bool = JSON,
) -> None:
    """Plan a test in the largest cube the arm reaches, clear of its limits and of singularities.

    Poses and paths lie in the cube's diagonal plane, as ISO 9283 requires. Check them in your workcell before you run them.
    """
    if output is not None:
        check_writable(output, apart_from=(arm_name, visible_in))
        if output.suffix not in (".toml", ".csv") or (output.suffix == ".csv" and name in ("line", "circle")):
            raise InputError(f"{output}: a plan is written as .toml, motions to run, or, of poses, as .csv")

    import numpy as np

    from armsight.app.check.plan import plan_csv, plan_json, plan_test
    from armsight.robot.arm_file import open_arm

    middle = None if centre is None else np.array(centre) / 1e3
    test = plan_test(open_arm(arm_name), name, cycles, middle, speed / 1e3, visible_in)
    if output is not None:
        write_text(output, test.motions if output.suffix == ".toml" else plan_csv(test.plan))
    note(*test.notes)
    at = " ".join(f"{1e3 * v:.0f}" for v in test.plan.centre)
    what = {"line": "a line", "circle": "a circle"}.get(name, f"{len(test.plan.names)} poses")
    lines = [f"{what} in a cube of {1e3 * test.plan.side_m:.0f} mm about {at} mm, cycles: {test.cycles}"]
    if output is not None and output.suffix == ".toml":
        lines.append(f"written: {output}; run it: armsight run --motion {output} ... -o RUN; then: armsight check RUN")
    print_answer(as_json, plan_json(test), *lines)
