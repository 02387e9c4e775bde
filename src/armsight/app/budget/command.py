"""``armsight budget``: the answer first, then the causes, then what would change it most for least money."""

from __future__ import annotations

from pathlib import Path

import click

from armsight.errors import InputError


@click.command("budget")
@click.argument("path", required=False, default="", metavar="[PLAN.toml]")
@click.option("--volume", metavar="WxHxD|MOTION.toml", help="Seen by the cameras: 0.4x0.4x0.3m; or a motion file.")
@click.option("--distance", metavar="LENGTH", help="From the cameras to the volume's middle: 0.8m.")
@click.option("--speed", metavar="SPEED", help="Of the body: 0.3m/s, or 0.3m/s,20deg/s.")
@click.option("--want", metavar="ERROR", help="What 95 % of the errors are to be within: 0.1mm, or 0.1mm,0.05deg.")
@click.option("--camera", metavar="CLASS", help="A class of the catalogue, such as webcam-720p.")
@click.option("--baseline", metavar="LENGTH", help="Between the cameras: 200mm.")
@click.option(
    "--rig",
    metavar="RIG.json|RUN",
    help="The budget of a rig that there is, or of a run's, beside what the run measured.",
)
@click.option("--arm", metavar="ARM", help="For the closed loop: a model's name or a file.")
@click.option(
    "--best", "optimise", is_flag=True, help="Choose what is left out so that it measures best, for each class."
)
@click.option("-o", "--output", metavar="DIR", help="Write report.html, budget.json, the rig and the body to print.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
def command(path: str, optimise: bool, output: str | None, as_json: bool, **given: str | None) -> int:
    """Say before a rig is bought what it will measure, what limits it, and what would make it better.

    What is left out is chosen, and said. PLAN.toml has the same keys and more: docs/howto/budget.md. Exit code 1: what
    --want asks for is not reached.
    """
    from armsight.app.budget.report import REPORT_FILES, budget_report, to_build
    from armsight.app.progress import steps
    from armsight.files import check_folder
    from armsight.sim.budget.plan import RigPlan, planned
    from armsight.sim.budget.result import RigBudget, best, chosen

    if output is not None:
        check_folder(
            output, holding=REPORT_FILES, apart_from=(path, *(given[key] for key in ("rig", "arm") if given[key]))
        )
    run = given.pop("rig") if Path(given["rig"] or "rig.json").is_dir() else None
    if run is not None and optimise:
        raise InputError(f"--rig {run}: a run's rig is chosen already: leave out --best")
    if (motion := given["volume"] or "").endswith(".toml"):
        if not given["arm"]:
            raise InputError(f"volume {motion}: the arm that moves so is needed, too: --arm ar4")
        from armsight.app.budget.run import motion_volume  # here and below: what a plan alone does not need

        given |= motion_volume(Path(motion), given["arm"]) | ({"speed": given["speed"]} if given["speed"] else {})
    with steps() as progress:
        if run is None:
            plan = RigPlan.read(path, **given)
        else:
            from armsight.app.budget.run import run_plan

            plan = run_plan(Path(run), path, **given)
        alternatives = best(plan, progress) if optimise else ()
        found = chosen(alternatives) if alternatives else RigBudget(plan, planned(plan))
        progress("what would change it")
        report = budget_report(found, alternatives, Path(run) if run else None)
    written = None
    if output is not None:
        files = to_build(found)
        written = str(report.write(Path(output), {"budget.json": report.json_text(), **files}))
        if "body.toml" in files:
            from armsight.app.body.draw import draw_body

            draw_body([Path(output) / "body.toml"], Path(output) / "body.pdf", split=True)
    return report.echo(as_json=as_json, written=written) or int(not found.reached(found.moving))
