"""``armsight arm``: look at an arm, ask where its tool is, how it moves, and which joints bring it somewhere."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
import numpy as np

from armsight.app.arm import description as arm_facts
from armsight.app.arm.figure import write_arm_figure
from armsight.data import Array
from armsight.errors import InputError
from armsight.files import check_writable
from armsight.geometry.pose import pose
from armsight.geometry.rotation import from_euler_zyx
from armsight.robot.arm import Arm
from armsight.robot.arm_file import open_arm
from armsight.robot.kinematics.chain import MOST_RADIANS
from armsight.robot.models import MODELS
from armsight.robot.urdf_write import write_urdf

#: A minus before a number is no option.
_NUMBERS = {"ignore_unknown_options": True}
_JSON = click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
_POSE = ("x", "y", "z", "roll", "pitch", "yaw")


def _model(command: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command the argument MODEL and the option that belongs to URDF files."""
    link = click.option(
        "--tool-link", metavar="LINK", help="The tool's link in a .urdf file where several end the chain."
    )
    return click.argument("model", metavar="MODEL")(link(command))


@click.group()
def command() -> None:
    """Look at a robot arm and ask its kinematics: mm and degrees here, m and rad in --json.

    MODEL is a name that `armsight arm list` prints, or a .urdf file of six revolute joints.
    """


@command.command("list")
@_JSON
def list_(as_json: bool) -> None:
    """Print the arms that come with armsight."""
    click.echo(json.dumps(arm_facts.listed(MODELS)) if as_json else arm_facts.list_text(MODELS))


@command.command()
@_model
@click.option("-o", "--output", metavar="ARM.png", type=click.Path(path_type=Path), help="Draw the arm at home.")
@_JSON
def show(model: str, tool_link: str | None, output: Path | None, as_json: bool) -> None:
    """Print an arm's table, limits and reach."""
    arm = open_arm(model, tool_link=tool_link)
    if output is not None:
        check_writable(output, apart_from=(model,))
        write_arm_figure(arm, output)
    facts = arm_facts.shown(arm)
    click.echo(json.dumps(facts) if as_json else arm_facts.show_text(arm, facts))


@command.command(context_settings=_NUMBERS)
@_model
@click.argument("angles", nargs=-1, metavar="Q1 .. Q6")
@_JSON
def fk(model: str, tool_link: str | None, angles: tuple[str, ...], as_json: bool) -> None:
    """Print where the tool is at six joint angles, in degrees."""
    arm = open_arm(model, tool_link=tool_link)
    q = _joints(arm, angles)
    facts = arm_facts.forward(arm, q)
    click.echo(json.dumps(facts) if as_json else arm_facts.forward_text(facts))


@command.command(context_settings=_NUMBERS)
@_model
@click.argument("angles", nargs=-1, metavar="Q1 .. Q6")
@_JSON
def jacobian(model: str, tool_link: str | None, angles: tuple[str, ...], as_json: bool) -> None:
    """Print the Jacobian of the tool's point in base axes at six joint angles, in degrees."""
    arm = open_arm(model, tool_link=tool_link)
    q = _joints(arm, angles)
    facts = arm_facts.jacobian(arm, q)
    click.echo(json.dumps(facts) if as_json else arm_facts.jacobian_text(facts))


@command.command(context_settings=_NUMBERS)
@_model
@click.argument("numbers", nargs=-1, metavar="X Y Z ROLL PITCH YAW")
@_JSON
def ik(model: str, tool_link: str | None, numbers: tuple[str, ...], as_json: bool) -> int:
    """Print every set of joint angles that brings the tool to a pose: x y z in mm, roll pitch yaw in degrees.

    The rotation is Rz(roll) Ry(pitch) Rx(yaw). Exit code 1 where no joint angles within the limits reach the pose: then the
    reason and the nearest pose that can be reached are the answer.
    """
    arm = open_arm(model, tool_link=tool_link)
    if len(_no_options(numbers)) != len(_POSE):
        raise InputError(f"a pose is six numbers, {' '.join(_POSE)} (mm, degrees); {len(numbers)} were given")
    x, y, z, roll, pitch, yaw = (_number(text, name) for text, name in zip(numbers, _POSE, strict=True))
    T = pose(from_euler_zyx(*np.radians([roll, pitch, yaw])), np.array([x, y, z]) / 1e3)
    facts = arm_facts.inverse(arm, T)
    click.echo(json.dumps(facts) if as_json else arm_facts.inverse_text(facts))
    return 0 if any(solution["within_limits"] for solution in facts["solutions"]) else 1


@command.command()
@_model
@click.option("-o", "--output", required=True, metavar="ARM.urdf", type=click.Path(path_type=Path), help="To write.")
def urdf(model: str, tool_link: str | None, output: Path) -> None:
    """Write an arm as a URDF file."""
    check_writable(output, apart_from=(model,))
    write_urdf(open_arm(model, tool_link=tool_link), output)
    click.echo(str(output))


def _no_options(texts: tuple[str, ...]) -> tuple[str, ...]:
    """Return texts none of which was meant as an option."""
    for text in texts:
        if text.startswith("--"):
            raise InputError(f"no such option: {text}")
    return texts


def _number(text: str, name: str) -> float:
    """Read one number."""
    try:
        value = float(text)
    except ValueError:
        raise InputError(f"{name} is {text!r}; it must be a number") from None
    if not np.isfinite(value):
        raise InputError(f"{name} is {text}; it must be a finite number")
    return value


def _joints(arm: Arm, texts: tuple[str, ...]) -> Array:
    """Read six joint angles in degrees, and say on stderr which are beyond the limits."""
    if len(_no_options(texts)) != 6:
        raise InputError(f"{arm.name} has six joints; {len(texts)} angles were given, in degrees: q1 q2 q3 q4 q5 q6")
    degrees = np.array([_number(text, f"q{i + 1}") for i, text in enumerate(texts)])
    most = np.floor(np.degrees(MOST_RADIANS))
    if np.abs(degrees).max() > most:
        i = int(np.argmax(np.abs(degrees)))
        raise InputError(f"q{i + 1} is {texts[i]} degrees; no joint turns further than {most:.0f}")
    for note in arm_facts.beyond(arm, np.radians(degrees)):
        click.echo(f"note: {note}", err=True)
    return np.asarray(np.radians(degrees))
