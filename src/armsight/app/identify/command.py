"""``armsight identify``: kinematic identification of an arm from joint angles and measured tool poses."""

from __future__ import annotations

import time
from math import degrees
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from armsight.app.options import JSON, SEED, declared, option, out
from armsight.app.progress import steps
from armsight.app.show.messages import print_answer
from armsight.errors import InputError
from armsight.files import as_input_error, check_folder, check_writable, write_text

if TYPE_CHECKING:
    from collections.abc import Callable

    from armsight.loop.identify.measured import Read
    from armsight.loop.identify.plan import Plan
    from armsight.robot.kinematics.arm import Arm


@click.group("identify", invoke_without_command=True)
@click.pass_context
@declared
def command(
    ctx: click.Context,
    arm_name: str | None = option(
        "Required: the nominal arm, a name (armsight arm list), a .toml or a .urdf file.", "--arm", metavar="ARM"
    ),
    data: Path | None = option("Required: joint angles, and measured poses of the tool.", metavar="POSES.csv"),
    joints: Path | None = option(
        "The joint angles, where the poses have none: by name, row or time.", metavar="JOINTS.csv"
    ),
    other: Path | None = option("Poses to validate with.", "--validate", metavar="OTHER.csv"),
    columns: tuple[str, ...] = option(
        "Names of columns in your tables, such as q1_deg=J1,p1_x_mm=X; rotation=zyx: what rx_deg, ry_deg, rz_deg mean, "
        "which are not used without.",
        metavar="NAME=COLUMN,...",
    ),
    references: Path | None = option(
        "One wire's range instead of measured poses; poses of --data are the controller's.", metavar="REFERENCES.toml"
    ),
    priors: tuple[str, ...] = option(
        "Sigma (m, rad) of a parameter or kind; 0 keeps it.", "--prior", metavar="NAME=SIGMA"
    ),
    output: Path | None = out(
        "DIR", "Folder for the corrected arm and the report; needs armsight[report].", report=True
    ),
    verbose: bool = option("Print all numbers, and why the others were not fitted.", "-v", "--verbose"),
    as_json: bool = JSON,
) -> None:
    """Identify an arm: its kinematic table, joint zeros, sensor errors, backlash and compliance, each with sigma.

    Formats, and what each result means: docs/howto/identify.md.
    """
    if ctx.invoked_subcommand is not None:
        return
    if arm_name is None or data is None:
        raise InputError("give --arm and --data: armsight identify --arm ur10 --data poses.csv -o corrected/")

    if references is not None and (joints is not None or other is not None):
        raise InputError(
            "--references goes without --joints and --validate: parts of its rows are left out to validate"
        )

    from armsight.app.identify.report import identify_report, write_results
    from armsight.app.identify.run import FILES, run_identify
    from armsight.app.show.plotting import require_matplotlib
    from armsight.loop.identify.read import read_measured
    from armsight.robot.arm_file import open_arm, split_arm
    from armsight.tables.cells import said_columns

    arm = open_arm(arm_name)
    if output is not None:
        require_matplotlib()
        given = (data, joints, other, references, Path(split_arm(arm_name)[0]))
        check_folder(output, holding=FILES, apart_from=given, problem="cannot be made")
    started = time.perf_counter()
    with steps() as progress:
        progress("reading")
        said = said_columns(",".join(columns) or None, ("rotation",))
        how = {"rotation": said.rotation, "columns": said.columns}
        if references is not None:
            read, range_noise_m = _by_wire(arm, data, references, columns, progress)
        else:
            read, range_noise_m = read_measured(data, arm, joints, **how), None
        held = None if other is None else read_measured(other, arm, joints, **how)
        notes = read.notes if held is None else (*read.notes, *(f"{other}: {note}" for note in held.notes))
        validated = None if held is None else held.measured
        more: dict[str, Any] = {"priors": _priors(priors), "notes": notes, "range_noise_m": range_noise_m}
        more["progress"] = progress
        run = run_identify(arm, read.measured, read.lines, validated, other_name=str(other), **more)
        report = identify_report(run, everything=verbose)
        if output is not None:
            progress("writing")
            write_results(run, report, output)
    report.echo(as_json=as_json, output=output, wall_s=time.perf_counter() - started)
    if output is not None:  # last: what was found is printed and stored before anything is drawn
        report.write(output)
    if output is not None and not as_json:
        click.echo(f"\nwritten: {output}/{', '.join(each for each in FILES if (output / each).exists())}")


def _by_wire(
    arm: Arm, data: Path, references: Path, columns: tuple[str, ...], progress: Callable[[str], None]
) -> tuple[Read, float]:
    """Return rows with a wire's length, blunders left out and noted, and its noise, m."""
    from armsight.loop.identify.lengths import read_wire, without_blunders
    from armsight.loop.identify.measured import Read

    wire = read_wire(data, arm, references, ",".join(columns) or None)
    measured, used, blunders = without_blunders(arm, wire.q, wire.length_m, wire.p_base, progress)
    notes = [f"lines {wire.lines[rows.min()]:.0f} to {wire.lines[rows.max()]:.0f}: {why}" for rows, why in blunders]
    said = "errors are of the wire's length; one wire does not show where the base is: it stays the anchor's"
    notes = [said, *wire.notes, *(f"{each}; left out" for each in notes)]
    return Read(measured.rows(used), wire.lines[used], tuple(notes)), wire.noise_m


@command.command()
@declared
def plan(
    arm_name: str = option("The nominal arm: a name, a .toml or a .urdf file.", "--arm", metavar="ARM"),
    data: Path | None = option("Poses that were measured already.", metavar="DONE.csv"),
    rig: Path | None = option("The cameras that must see the poses.", metavar="RIG.json"),
    count: int = option("Number of poses.", "-n", min=1, max=200, default=20),
    seed: int = SEED,
    output: Path | None = out("PLAN.csv", "Write the poses here.", kind="approach1"),
    as_json: bool = JSON,
) -> None:
    """Choose the most informative poses for an identification, and predict the error after each.

    With --data the poses measured already count, and locate the arm; with --rig and --data only what both cameras see is
    chosen, weighted by how well they see it. Check the poses against your workcell before you move to them.
    """
    if rig is not None and data is None:
        raise InputError("--rig needs --data: without any pose measured, where the arm is to the cameras is not known")
    if output is not None:
        if output.suffix != ".csv":
            raise InputError(f"{output}: poses are written as .csv; name it so")
        check_writable(output, apart_from=(data, rig))

    from armsight.loop.identify.plan import plan_joints
    from armsight.loop.identify.read import read_poses
    from armsight.robot.arm_file import open_arm
    from armsight.vision.rig import StereoRig

    with steps() as progress:
        progress("choosing poses")
        done = None if data is None else read_poses(data).measured
        chosen = plan_joints(open_arm(arm_name), done, None if rig is None else StereoRig.load(rig), count, seed)
    if output is not None:
        write_text(output, _plan_csv(chosen))
    keys = {"q_rad": chosen.q, "approach": chosen.approach, "sigma_m": chosen.sigma_m}
    found = {key: each.tolist() for key, each in (keys | {"random_sigma_m": chosen.random_sigma_m}).items()}
    print_answer(as_json, found, *_plan_lines(chosen), *([] if output is None else [f"\nwritten: {output}"]))


def _plan_lines(plan: Plan) -> list[str]:
    """Return the predicted error after so many poses, then the poses, deg, as text."""
    n = len(plan.q)
    lines = ["predicted error of the tool over the workspace, RMS:"]
    for k in sorted({0, n // 4, n // 2, 3 * n // 4, n}):
        compared = f"more than {len(plan.random_sigma_m) - 1} at random would do"
        if random := plan.random_for(k):
            compared = f"as good as {random} at random"
        lines.append(f"  after {k:3d} more poses {1e3 * plan.sigma_m[k]:9.3f} mm" + (f"  ({compared})" if k else ""))
    lines.append(
        "joints, deg; approach each from the side given (+: its angle increases), over the last half degree in 1 to 2 s:"
    )
    for k, (q, sides) in enumerate(zip(plan.q, plan.approach, strict=True), 1):
        angles = (f"{degrees(v):9.2f} {'+' if s > 0 else '-'}" for v, s in zip(q, sides, strict=True))
        lines.append(f"  {k:3d} {''.join(angles)}")
    return lines


def _plan_csv(plan: Plan) -> str:
    """Return the poses as CSV: joint angles, and the direction of approach of each."""
    joints = range(1, plan.q.shape[1] + 1)
    rows = [[*(f"q{i}_rad" for i in joints), *(f"approach{i}" for i in joints), "sigma_after_mm"]]
    for q, sides, sigma in zip(plan.q, plan.approach, plan.sigma_m[1:], strict=True):
        rows.append([*(f"{v:.6f}" for v in q), *(f"{v:.0f}" for v in sides), f"{1e3 * sigma:.4f}"])
    return "".join(f"{','.join(row)}\n" for row in rows)


def _priors(texts: tuple[str, ...]) -> dict[str, float]:
    out = {}
    for given in texts:
        name, _, sigma = given.partition("=")
        with as_input_error(f"--prior {given!r} must be NAME=SIGMA, such as a2=0.001 or alpha=0", ValueError):
            out[name] = float(sigma)
    return out
