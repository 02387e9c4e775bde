"""``armsight budget``: the answer first, then the causes, then what would change it most for least money."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from armsight.app.options import JSON, argument, declared, option, out
from armsight.errors import InputError
from armsight.files import as_input_error, check_folder

if TYPE_CHECKING:
    from armsight.sim.budget.plan import RigPlan


@dataclass(frozen=True)
class PlanOptions:
    """The options that are keys of a plan, too."""

    volume: str | None = option("Seen by the cameras: 0.4x0.4x0.3m; or a motion file.", metavar="WxHxD|MOTION.toml")
    distance: str | None = option("From the cameras to the volume's middle: 0.8m.", metavar="LENGTH")
    speed: str | None = option("Of the body: 0.3m/s, or 0.3m/s,20deg/s.", metavar="SPEED")
    want: str | None = option("What 95 % of the errors are to be within: 0.1mm, or 0.1mm,0.05deg.", metavar="ERROR")
    camera: str | None = option("A class of the catalogue, such as webcam-720p.", metavar="CLASS")
    body: str | None = option("What is measured: a body file, or chessboard:9x6:25mm.", metavar="FILE|BOARD")
    rig: str | None = option("A rig that there is, or a run's, beside what the run measured.", metavar="RIG.json|RUN")
    arm: str | None = option("For the closed loop: a model's name or a file.", metavar="ARM")


@click.command("budget")
@declared
def command(
    options: PlanOptions,
    plan: tuple[str, ...] = argument("[PLAN.toml] [KEY=VALUE]..."),
    optimise: bool = option("Choose what is left out, for each class of cameras.", "--best"),
    output: str | None = out("DIR", "Write report.html, budget.json, the rig and the body to print.", report=True),
    as_json: bool = JSON,
) -> int:
    """Say before a rig is bought what it will measure, what limits it, and what would make it better.

    What is left out is chosen, and said. PLAN.toml has the same keys and more (docs/howto/budget.md); KEY=VALUE replaces
    one: baseline=150mm. Exit code 1: what --want asks for is not reached.
    """
    from armsight.app.budget.report import REPORT_FILES, budget_report, to_build
    from armsight.app.progress import steps
    from armsight.sim.budget.plan import planned
    from armsight.sim.budget.result import RigBudget, best, chosen

    path, given = _given(plan, vars(options))
    if output is not None:
        used = [path, *filter(None, map(given.get, ("rig", "arm", "body")))]
        check_folder(output, holding=REPORT_FILES, apart_from=used)
    run = given.pop("rig") if Path(given["rig"] or "rig.json").is_dir() else None
    if run is not None and optimise:
        raise InputError(f"--rig {run}: a run's rig is chosen already: leave out --best")
    with steps() as progress:
        asked = _asked(path, run, given)
        alternatives = best(asked, progress) if optimise else ()
        found = chosen(alternatives) if alternatives else RigBudget(asked, planned(asked))
        found.check()
        progress("computing what would change it")
        report = budget_report(found, alternatives, Path(run) if run else None)
    written = None
    if output is not None:
        from armsight.app.body.draw import draw_body

        written = str(report.write(Path(output), {"budget.json": report.json_text(), **to_build(found)}))
        draw_body([found.plan.body or Path(output) / "body.toml"], Path(output) / "body.pdf", split=True)
        Path(written).touch()  # last, as what is newer was changed since
    return report.echo(as_json=as_json, written=written) or int(not found.reached(found.moving))


def _given(plan: Sequence[str], options: Mapping[str, str | None]) -> tuple[str, dict[str, Any]]:
    """Return the path of the plan, "" without one, and what KEY=VALUE and options say, each key once."""
    from armsight.sim.budget.plan import KEYS

    settings = [each for each in plan if "=" in each and "/" not in each.partition("=")[0]]  # not runs/exp=3/plan.toml
    path, *more = [each for each in plan if each not in settings] or [""]
    if keys := {*KEYS} & {path, *more}:
        raise InputError(f"{path} {' '.join(more)}: expected {min(keys)}=VALUE")
    if more:
        raise InputError(f"{more[0]}: {path} is the plan already: expected one PLAN.toml, and KEY=VALUE")
    found = dict[str, Any].fromkeys(options)
    said = [(key, value) for key, value in options.items() if value is not None]
    for key, value in (*(each.partition("=")[::2] for each in settings), *said):
        if found.get(key) is not None:
            raise InputError(f"{key}={value}: {key} is given twice; give it once")
        with as_input_error(f"{key}={value}: expected a number", ValueError):
            found[key] = value if KEYS.get(key, str) is str else float(value)
    return path, found


def _asked(path: str, run: str | None, given: dict[str, str | None]) -> RigPlan:
    """Return the plan of a file and options: a motion gives volume and speed, a run what it measured."""
    from armsight.sim.budget.plan import RigPlan

    moves = (motion := given["volume"] or "").endswith(".toml")
    if not moves and run is None:
        return RigPlan.read(path, **given)
    from armsight.app.budget.run import motion_volume, run_plan  # not above: what a plan alone does not need

    if moves:
        if not given["arm"]:
            raise InputError(f"volume {motion}: the arm that moves so is needed, too: --arm ar4")
        given |= motion_volume(Path(motion), given["arm"]) | ({"speed": given["speed"]} if given["speed"] else {})
    return RigPlan.read(path, **given) if run is None else run_plan(Path(run), path, **given)
