"""``armsight arm``: an arm's table, forward and inverse kinematics, Jacobian, URDF, its calibration and its report."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from armsight.app.options import JSON, SEED, argument, declared, option, out
from armsight.app.show.messages import note, print_answer
from armsight.errors import InputError
from armsight.files import as_input_error, check_folder, check_suffix, check_writable, read_text, read_toml, write_text

if TYPE_CHECKING:
    from armsight.app.arm.description import Shown
    from armsight.data import Array
    from armsight.robot.kinematics.arm import Arm

_NUMBERS = {"ignore_unknown_options": True}  # a minus before a number is no option
#: Over less than this, m, poses distinguish an arm's zeros badly from its base and tool. Half: fewer notes; double: more.
_NARROW_M = 0.15
_POSE = ("x", "y", "z", "euler_z", "euler_y", "euler_x")

_ARM = argument("ARM")
_ANGLES = argument("Q1 Q2 ...")


def _print(shown: Shown, as_json: bool) -> None:
    print_answer(as_json, shown[0], *shown[1])


def _open(name: str) -> Arm:
    from armsight.robot.arm_file import open_arm

    return open_arm(name)


def _check_written(output: Path, arm: str, *also: str | Path, suffix: str = "", what: str = "") -> None:
    """Check that a file can be written and is none of those that are read."""
    from armsight.robot.arm_file import split_arm

    if suffix:
        check_suffix(output, suffix, what)
    check_writable(output, apart_from=(split_arm(arm)[0], *also))


@click.group("arm")
def command() -> None:
    """Print an arm's table and kinematics: mm and degrees here, m and rad in --json.

    ARM is a name that `armsight arm list` prints, or a .toml or .urdf file of four to seven revolute joints.
    """


@command.command("list")
@declared
def list_(as_json: bool = JSON) -> None:
    """Print the arms that come with armsight."""
    from armsight.app.arm import description
    from armsight.robot.models import MODELS

    _print(description.models(MODELS), as_json)


@command.command()
@declared
def show(
    arm_name: str = _ARM,
    output: Path | None = out("ARM.png", "Draw the arm at home; needs armsight[report].", kind="PNG"),
    as_json: bool = JSON,
) -> None:
    """Print an arm's table, limits and reach."""
    if output is not None:
        _check_written(output, arm_name, suffix=".png", what="a figure of the arm")

    from armsight.app.arm import description
    from armsight.app.arm.figure import write_arm_figure

    arm = _open(arm_name)
    if output is not None:
        write_arm_figure(arm, output)
    _print(description.show(arm), as_json)


@command.command(context_settings=_NUMBERS)
@declared
def fk(arm_name: str = _ARM, angles: tuple[str, ...] = _ANGLES, as_json: bool = JSON) -> None:
    """Print the pose of the tool at joint angles, in degrees.

    Of a corrected.toml the angles are readings: curves of the sensors and compliance are corrected, too.
    """
    from armsight.app.arm import description
    from armsight.loop.identify.corrected import is_corrected, open_corrected

    arm = _open(arm_name)
    q = _joints(arm, angles)
    T = arm.forward(q)
    if is_corrected(arm_name):
        corrected = open_corrected(arm_name)
        T = corrected.forward(q[None])[0]
        sides = "with the sensors' curves and compliance; from which sides the joints came is not known"
        note(*corrected.notes, sides)
    _print(description.forward(arm, q, T), as_json)


@command.command(context_settings=_NUMBERS)
@declared
def jacobian(arm_name: str = _ARM, angles: tuple[str, ...] = _ANGLES, as_json: bool = JSON) -> None:
    """Print the Jacobian of the tool's point in base axes at joint angles, in degrees."""
    from armsight.app.arm import description

    arm = _open(arm_name)
    _print(description.jacobian(arm, _joints(arm, angles)), as_json)


@command.command(context_settings=_NUMBERS)
@declared
def ik(
    arm_name: str = _ARM, numbers: tuple[str, ...] = argument("X Y Z EULER_Z EULER_Y EULER_X"), as_json: bool = JSON
) -> int:
    """Print every set of joint angles that brings the tool to a pose: x y z in mm, Euler angles in degrees.

    The rotation is Rz(euler_z) Ry(euler_y) Rx(euler_x); ROS calls euler_x roll. Exit code 1 where no joint angles within
    the limits reach the pose: then the reason and the nearest pose that can be reached are the answer.
    """
    import numpy as np

    from armsight.app.arm import description
    from armsight.geometry.pose import pose
    from armsight.geometry.rotation import from_euler_zyx

    arm = _open(arm_name)
    if len(_no_options(numbers)) != len(_POSE):
        raise InputError(f"a pose is six numbers, {' '.join(_POSE)} (mm, degrees); {len(numbers)} were given")
    x, y, z, *euler = (_number(text, name) for text, name in zip(numbers, _POSE, strict=True))
    T = pose(from_euler_zyx(*np.radians(euler)), np.array([x, y, z]) / 1e3)
    found = arm.inverse(T)
    _print(description.inverse(arm, T, found), as_json)
    return 0 if found.within_limits.any() else 1


@command.command()
@declared
def urdf(
    arm_name: str = _ARM, output: Path = out("ARM.urdf", "The file to write.", kind="<robot"), as_json: bool = JSON
) -> None:
    """Write an arm as a URDF file."""
    _check_written(output, arm_name, suffix=".urdf", what="an arm")

    from armsight.robot.urdf.write import write_urdf

    arm = _open(arm_name)
    write_urdf(arm, output)
    _print(({"arm": arm.name, "output": str(output)}, [str(output)]), as_json)


@command.command()
@declared
def calibrated(
    arm_name: str = _ARM,
    file: str = argument("FILE"),
    output: Path | None = option(
        "Write FILE's arm: .urdf, or .yaml as the maker's driver reads it; one that exists is kept as OUT.old.",
        "-o",
        "--output",
        metavar="OUT",
    ),
    yes: bool = option("Do not ask before OUT is replaced."),
    as_json: bool = JSON,
) -> None:
    """Print how far a single arm's calibrated table puts the tool from that of its kind, ARM; convert it.

    FILE is the calibration of a Universal Robots arm (.yaml, or its controller's calibration.conf) or of an xArm (.yaml),
    a corrected.toml of `armsight identify`, or another arm's file.
    """
    from armsight.app.arm import description
    from armsight.robot.arm_file import tool_moved
    from armsight.robot.calibration_file import difference, read_calibration, with_tool_of, write_calibration
    from armsight.robot.urdf.write import write_urdf

    if output is not None:
        if output.suffix not in (".urdf", ".yaml"):
            raise InputError(f"{output}: an arm is written as .urdf or .yaml")
        _check_written(output, arm_name, file)
    nominal = _open(arm_name)
    arm = read_calibration(file, nominal) if file.lower().endswith((".yaml", ".yml", ".conf")) else _open(file)
    sigma_m = None
    if arm.source.startswith("identified:"):
        known = tool_moved(file, read_toml(file))[1]
        sigma_m = known if math.isfinite(known) else None
        arm = replace(with_tool_of(arm, file, nominal), name=f"the corrected {arm.name}")
    if output is not None and output.exists():
        _keep(output, yes)
    if output is not None and output.suffix == ".yaml":
        off_m, off_rad = write_calibration(arm, nominal, output)
        if max(off_m, off_rad) > 1e-9:
            off = f"{1e3 * off_m:.3f} mm and {math.degrees(off_rad):.3f} deg off the last joint's axis"
            note(f"{output} cannot hold the flange's {off}: give them to the tool")
    elif output is not None:
        write_urdf(arm, output)
    _print(description.difference(nominal, arm, difference(nominal, arm), sigma_m), as_json)


@command.command()
@declared
def plan(
    arm_name: str = _ARM,
    around: Path = option(
        "An earlier run of this arm before these cameras, such as with the default motion: where the body was seen.",
        metavar="RUN",
    ),
    poses: int = option("Poses, each from both sides.", min=8, max=500, default=40),
    cycles: int = option("How often five poses come again.", min=0, max=1000, default=30),
    seed: int = SEED,
    output: Path = out("FILE.toml", "The motions to write.", kind=r"^\[\[motion"),
    as_json: bool = JSON,
) -> None:
    """Plan the recording of `arm report`: motions for `armsight run --open-loop --motion FILE.toml`.

    Poses all over where the body is seen, each from both sides of every joint, and five of them again and again.
    """
    _check_written(output, arm_name, around, suffix=".toml", what="a plan of motions")

    from armsight.app.arm.evaluate import plan_report, seen_angles
    from armsight.app.check.plan import seen_by

    arm = _open(arm_name)
    text, extent = plan_report(arm, seen_angles(around, arm), seen_by(around), poses=poses, cycles=cycles, seed=seed)
    write_text(output, text)
    size = " x ".join(f"{100 * each:.0f}" for each in extent) + " cm"
    if extent.min() < _NARROW_M:
        lost = "zeros, base and tool, and lengths will hardly be distinguished"
        note(f"{around} saw the body over only {size}: {lost}; first record a run whose hand-eye poses cover more")
    answer = {"arm": arm.name, "poses": poses, "cycles": cycles, "extent_m": extent.tolist(), "output": str(output)}
    _print((answer, [f"{output}: {poses} poses over {size}"]), as_json)


@command.command()
@declared
def report(
    run: Path = argument("RUN"),
    arm_name: str | None = option("The nominal arm; by default the one that the run names.", "--arm", metavar="ARM"),
    compare: tuple[Path, ...] = option("Another arm's report.json.", metavar="FILE.json"),
    output: Path | None = out("DIR", "Folder for report.html, .pdf and .json; needs armsight[report].", report=True),
    as_json: bool = JSON,
) -> None:
    """Report what an arm does, what explains its error, and what each remedy would bring.

    RUN is a folder of `armsight run` or `demo`, best with the motions of `armsight arm plan`; its rests in open loop count.
    """
    from armsight.app.arm.evaluate import evaluate_arm, nominal_arm
    from armsight.app.arm.report import FILES, arm_report, read_report, write_report
    from armsight.app.progress import steps
    from armsight.app.show.plotting import require_matplotlib

    if output is not None:
        require_matplotlib()
        check_folder(output, holding=FILES, apart_from=(run, *compare), problem="no report can be written here")
    arm = nominal_arm(run, arm_name)
    others = {path.parent.name or path.stem: read_report(path) for path in compare}
    with steps() as progress:
        found = evaluate_arm(run, arm, progress=progress)
    shown = arm_report(found, others)
    shown.echo(as_json=as_json)
    if output is not None:  # last: what was found is printed before anything is drawn
        write_report(shown, found, output)
    if output is not None and not as_json:
        click.echo(f"\nwritten: {output}/report.html, report.pdf, report.json")


def _keep(output: Path, yes: bool) -> None:
    old = output.with_name(f"{output.name}.old")
    if old.exists():
        raise InputError(f"{old}: exists; what was kept is never written over: move it away")
    if not yes:
        click.confirm(f"replace {output}? It is kept as {old}", abort=True, err=True)
    write_text(old, read_text(output))


def _no_options(texts: tuple[str, ...]) -> tuple[str, ...]:
    """Return texts none of which was meant as an option."""
    for text in texts:
        if text.startswith("--"):
            raise InputError(f"no such option: {text}")
    return texts


def _number(text: str, name: str) -> float:
    with as_input_error(f"{name} is {text!r}; it must be a number", ValueError):
        value = float(text)
    if not math.isfinite(value):
        raise InputError(f"{name} is {text}; it must be a finite number")
    return value


def _joints(arm: Arm, texts: tuple[str, ...]) -> Array:
    """Read joint angles in degrees, and say on stderr which are beyond the limits."""
    import numpy as np

    from armsight.app.arm import description
    from armsight.robot.kinematics.chain import MOST_RADIANS

    if len(_no_options(texts)) != arm.joints:
        want = " ".join(f"q{i + 1}" for i in range(arm.joints))
        raise InputError(f"{arm.name} has {arm.joints} joints; {len(texts)} angles were given, in degrees: {want}")
    degrees = np.array([_number(text, f"q{i + 1}") for i, text in enumerate(texts)])
    most = np.floor(np.degrees(MOST_RADIANS))
    for i in np.flatnonzero(np.abs(degrees) > most)[:1]:
        raise InputError(f"q{i + 1} is {texts[i]} degrees; no joint rotates further than {most:.0f}")
    note(*description.beyond(arm, np.radians(degrees)))
    return np.asarray(np.radians(degrees))
