"""The typed records of a session: commands that it takes, events and drawings that it gives out; and both as JSON.

A command is a frozen record of plain values; :func:`command_of` reads one from JSON and rejects everything else with one
line that lists what is known. States are the records of the steps (``CalibrationState`` and so on); :func:`json_text` makes
JSON of any of these records: arrays become lists, and numbers that are not finite become null.
"""

from __future__ import annotations

import dataclasses
import json
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from armsight.app.show.encode import json_of
from armsight.app.show.messages import Level
from armsight.data import Array
from armsight.errors import InputError

#: The steps in their order, by the names that commands and states use.
STEPS = ("cameras", "board", "calibrate", "body", "measure", "arm", "health")
#: No command is longer, characters.
LONGEST = 4096


@dataclass(frozen=True)
class Event:
    """Something that happened.

    Attributes:
        number: counts the events of a session from 1.
        at: time of day, HH:MM:SS.
        level: good, hint, warn, error.
        text: one line.
    """

    number: int
    at: str
    level: Level
    text: str


@dataclass(frozen=True)
class Drawn:
    """Lines to be drawn over an image.

    Attributes:
        side: 0 left, 1 right.
        kind: next (the outline to be reached), seen (what was found), body, second, axis0, axis1, axis2.
        lines: polylines of (column, row), raw pixels; a line of one point is a dot.
        label: a word beside the first point; may be empty.
    """

    side: int
    kind: str
    lines: tuple[tuple[tuple[float, float], ...], ...]
    label: str = ""


def polyline(uv: Array, *, closed: bool = False) -> tuple[tuple[float, float], ...]:
    """Return points (N, 2) as a polyline, to a tenth of a pixel; without those that are not finite."""
    good = uv[np.isfinite(uv).all(axis=1)]
    points = [(round(float(u), 1), round(float(v), 1)) for u, v in good]
    return (*points, *(points[:1] if closed else []))


#: Name -> command.
COMMANDS: dict[str, type[PageCommand]] = {}


@dataclass(frozen=True)
class PageCommand:
    """What the page asks for."""

    def __init_subclass__(cls) -> None:
        """Make the command known by its name."""
        COMMANDS[cls.__name__] = cls


@dataclass(frozen=True)
class GoTo(PageCommand):
    """Go to a step; the one before can be left at any time."""

    step: str


@dataclass(frozen=True)
class UseCameras(PageCommand):
    """Open other cameras."""

    source: str


class FindLeft(PageCommand):
    """Find out which view is the left camera's: a person covers it."""


class Swap(PageCommand):
    """Exchange left and right."""


@dataclass(frozen=True)
class UseBoard(PageCommand):
    """Use another calibration board; ``measured_mm`` is the length of the printed bar, 0 where nobody measured it."""

    spec: str
    measured_mm: float = 0.0


@dataclass(frozen=True)
class DrawBoard(PageCommand):
    """Draw the calibration board as a PDF to scale."""

    paper: str = "a4"


class Calibrate(PageCommand):
    """Begin the guided calibration, or continue it."""


class PauseCalibration(PageCommand):
    """Take no more shots for now."""


class TakeShot(PageCommand):
    """Take a shot of the board as it is now."""


@dataclass(frozen=True)
class DropShot(PageCommand):
    """Leave out a shot."""

    name: str


class FinishCalibration(PageCommand):
    """Choose the lens model by held-out errors, and write rig.json."""


@dataclass(frozen=True)
class SetAim(PageCommand):
    """Say what the calibration is to be good for."""

    error_mm: float
    distance_m: float


@dataclass(frozen=True)
class UseBody(PageCommand):
    """Use a body file, or the board, as what is measured."""

    target: str


@dataclass(frozen=True)
class DrawBody(PageCommand):
    """Draw the body as a PDF to scale."""

    paper: str = "a4"


class Zero(PageCommand):
    """Show poses relative to the present one."""


class ClearZero(PageCommand):
    """Show poses in the left camera's frame again."""


class PivotTip(PageCommand):
    """Collect poses for the calibration of a tip that stands still; a second time: compute it."""


class MarkPosition(PageCommand):
    """Mark the present position: distances are measured from it."""


class RecordPoses(PageCommand):
    """Write every measured pose to a new file; a second time: stop."""


class OpenArm(PageCommand):
    """Connect to the arm's board; the drives stay as they are."""


@dataclass(frozen=True)
class RunMotions(PageCommand):
    """Calibrate hand and eye and make the motions; ``closed``: a second time with the loop closed on vision."""

    closed: bool = True


@dataclass(frozen=True)
class UseSecondBody(PageCommand):
    """Measure a second body too, and each relative to the other; an empty ``target`` ends it."""

    target: str


class TakePose(PageCommand):
    """Take the pose in which the arm rests now for the hand-eye calibration."""


class GuideHandEye(PageCommand):
    """Let the arm visit the poses of the hand-eye calibration by itself."""


class GoToStart(PageCommand):
    """Move the arm slowly to where the motions start, as after a stop."""


class ClearHandEye(PageCommand):
    """Forget the hand-eye calibration and its poses."""


class Identify(PageCommand):
    """Identify the arm from the poses of the hand-eye calibration."""


@dataclass(frozen=True)
class UseArm(PageCommand):
    """Use another model of the arm: a name, a TOML or a URDF file, such as the corrected one."""

    arm: str


@dataclass(frozen=True)
class UseMotion(PageCommand):
    """Use the motions of another file."""

    path: str


class Hold(PageCommand):
    """Bring the arm to rest and hold it."""


class ClearStop(PageCommand):
    """Allow the drives again after a stop; they stay off until the next motion."""


@dataclass(frozen=True)
class PersonAction(PageCommand):
    """What the simulated person does: cover_left, cover_right, uncover, unplug, plug, knock, board, no_board."""

    action: str


_KINDS = {"str": str, "float": float, "bool": bool}


def command_of(text: str) -> PageCommand:
    """Read a command.

    Args:
        text: JSON such as ``{"command": "UseBoard", "spec": "chessboard:9x6:25mm"}``.

    Raises:
        InputError: anything else; the message says what.
    """
    if len(text) > LONGEST:
        raise InputError(f"a command has {LONGEST} characters at most, this one {len(text)}")
    try:
        given = json.loads(text)
    except (json.JSONDecodeError, RecursionError) as error:
        raise InputError(f"a command is JSON: {error}") from None
    if not isinstance(given, dict) or not isinstance(given.get("command"), str):
        raise InputError('a command is an object with the key "command"')
    name = given.pop("command")
    if name not in COMMANDS:
        raise InputError(f"no command {name[:40]!r}; known are {', '.join(COMMANDS)}")
    kind = COMMANDS[name]
    fields = {each.name: each for each in dataclasses.fields(kind)}
    if unknown := sorted(given.keys() - fields.keys()):
        raise InputError(f"{name} has no field {unknown[0][:40]!r}; it has {', '.join(fields) or 'none'}")
    values = {key: _value(name, key, str(fields[key].type), value) for key, value in given.items()}
    missing = [key for key, each in fields.items() if key not in values and each.default is dataclasses.MISSING]
    if missing:
        raise InputError(f"{name} needs the field {missing[0]!r}")
    return kind(**values)


def _value(name: str, key: str, kind: str, value: object) -> Any:  # noqa: ANN401 - of the field's type
    """Return a field's value, checked."""
    if kind == "float" and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if type(value) is not _KINDS[kind] or (isinstance(value, float) and not math.isfinite(value)):
        raise InputError(f"{name}: {key} must be a finite {kind}, not {str(value)[:40]!r}")
    return value


def json_text(value: object) -> str:
    """Return records, arrays and paths as JSON; as :func:`json_of` says, and several times faster where all is finite."""
    try:
        return json.dumps(value, default=_plain, allow_nan=False)
    except ValueError:
        return json.dumps(json_of(value))


def _plain(value: object) -> object:
    """Return what the JSON encoder does not know as what it knows."""
    if dataclasses.is_dataclass(value):
        return vars(value)
    if isinstance(value, np.ndarray):
        return value.tolist()
    return value.item() if isinstance(value, np.generic) else json_of(value)
