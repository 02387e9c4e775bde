"""What pages and a session say to each other: commands, events and drawings; and records as JSON.

A command is a frozen record of plain values, made from the method of a step that does it (:func:`asked`);
:func:`command_of` reads one from JSON and rejects everything else with one line that lists what is known.
"""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

import numpy as np

from armsight.app.show.encode import json_of
from armsight.app.show.messages import Level
from armsight.data import Array
from armsight.errors import InputError
from armsight.files import as_input_error

F = TypeVar("F", bound=Callable[..., None])
#: The steps in their order, by the names that commands and states use.
STEPS = ("cameras", "board", "calibrate", "body", "measure", "arm", "recorded", "health")
LONGEST = 4096  # characters of a command; half: a long list of devices is rejected, double: nothing


@dataclass(frozen=True)
class Event:
    """Something that happened: its number in the session, time of day, level and one line."""

    number: int
    at: str
    level: Level
    text: str


@dataclass(frozen=True)
class Drawn:
    """Lines to be drawn over an image."""

    side: int  # 0 left, 1 right
    kind: str  # next (the outline to be reached), seen (what was found), body, second, axis0, axis1, axis2
    lines: tuple[tuple[tuple[float, float], ...], ...]  # of (column, row), raw pixels; a line of one point is a dot


def polyline(uv: Array, *, closed: bool = False) -> tuple[tuple[float, float], ...]:
    """Return points (N, 2) as a polyline, to a tenth of a pixel; without those that are not finite."""
    good = uv[np.isfinite(uv).all(axis=1)]
    points = [(round(float(u), 1), round(float(v), 1)) for u, v in good]
    return (*points, *(points[:1] if closed else []))


def dots(kind: str, views: tuple[Array, Array]) -> tuple[Drawn, ...]:
    """Return points (N, 2) of both views as dots."""
    return tuple(Drawn(side, kind, tuple(polyline(p[None]) for p in uv)) for side, uv in enumerate(views))


#: Name -> record of the command.
COMMANDS: dict[str, type[PageCommand]] = {}


@dataclass(frozen=True)
class PageCommand:
    """What the page asks for; records of single commands are made by :func:`asked`."""

    at: ClassVar[str]  # the step that does it, an attribute of the session; empty: the session itself
    rest: ClassVar[bool]  # whether the arm must not move meanwhile
    method: ClassVar[str]


def asked(at: str, *, rest: bool = False) -> Callable[[F], F]:
    """Let pages ask for a method of a step: its command has its name in CamelCase, its parameters and its docstring."""

    def known(method: F) -> F:
        name = method.__name__.title().replace("_", "")
        given = list(inspect.signature(method).parameters.values())[1:]
        fields = [(p.name, p.annotation, *([] if p.default is p.empty else [p.default])) for p in given]
        of = {"at": at, "rest": rest, "method": method.__name__, "__doc__": method.__doc__, "__module__": __name__}
        COMMANDS[name] = dataclasses.make_dataclass(name, fields, bases=(PageCommand,), namespace=of, frozen=True)
        return method

    return known


def __getattr__(name: str) -> Any:  # noqa: ANN401 - a class
    """Return the record of a command, as in ``records.Calibrate``."""
    if name[:1].isupper():
        importlib.import_module("armsight.app.live.session")  # the steps, whose methods they are
    if name in COMMANDS:
        return COMMANDS[name]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


_KINDS = {"str": str, "float": float, "bool": bool}


def command_of(text: str) -> PageCommand:
    """Read a command such as ``{"command": "UseBoard", "spec": "chessboard:9x6:25mm"}``."""
    if len(text) > LONGEST:
        raise InputError(f"a command has {LONGEST} characters at most, this one {len(text)}")
    with as_input_error("a command is JSON", json.JSONDecodeError, RecursionError, why=True):
        given = json.loads(text)
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
