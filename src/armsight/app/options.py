"""How commands declare their options: as the defaults of a function's parameters, or of a record's fields.

    @click.command("record")
    @declared
    def command(source: str = argument(), shots: int | None = option("Stop after so many shots."), as_json: bool = JSON):

A parameter's name is the option's, its annotation says what is read: ``Path``, a number, ``bool`` a flag, ``tuple[X, ...]``
what may be repeated; without ``| None`` or default it is required. One declaration may serve many commands. Also here: what
many commands have, and the kinds of sources and boards that commands open themselves.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass
from functools import partial, wraps
from inspect import signature
from pathlib import Path
from types import UnionType
from typing import Any, get_args, get_type_hints

import click

from armsight.app.show.messages import note
from armsight.errors import InputError

#: What is in a rig's file, for :func:`out`.
IS_RIG = '"armsight-rig"'
#: A file or a folder.
PATH = click.Path(path_type=Path)
#: The simulated workcell as cameras.
SIM = "sim:"
#: A file of what was detected in images, or bag:FILE for tags in a recording, in place of images.
DETECTIONS = "detections:"
#: Joint angles that another program logged: ``--board poses:FILE``.
LOGGED = "poses:"
#: What every line about a board beside the cameras begins with; a loss is an error, a fault a warning, its end an info.
BOARD = "board: "
#: What a cell is called among the streams.
CELL = "cell:"
_TYPES = {Path: PATH, int: click.INT, float: click.FLOAT}  # others are texts
#: Titles of reports of version 0.2 -> their command; the report of an arm had the arm's name.
_TITLES = {
    "Bring-up": "board bringup",
    "bring-up": "board bringup",
    "calibration report": "calibrate",
    "hand-eye calibration": "handeye",
    "identification of an arm": "identify",
}
_LISTED = 8  # replaced files by name; half: a budget's are counted, double: a run's fill the screen
_KINDS = {int: "N", float: "X"}  #: in help; a file or a text is called as its option, where no better is declared


@dataclass(frozen=True, eq=False)
class Declaration:
    """An option or an argument: its names, where they do not follow from the parameter's, and click's attributes."""

    names: tuple[str, ...]
    attributes: Mapping[str, Any]
    is_argument: bool = False

    def parameter(self, name: str, kind: Any) -> click.Parameter:  # noqa: ANN401 - an annotation
        """Return it as click's, for a parameter of this name and annotation."""
        kinds = [each for each in get_args(kind) if each is not type(None)] if isinstance(kind, UnionType) else [kind]
        many = Ellipsis in get_args(kinds[0])
        single = get_args(kinds[0])[0] if many else kinds[0]
        given: dict[str, Any] = {"type": _TYPES.get(single), **self.attributes}
        if limits := {key: given.pop(key) for key in ("min", "max", "min_open") if key in given}:
            given["type"] = {int: click.IntRange, float: click.FloatRange}[single](**limits)
        if "choices" in given:
            given["type"] = click.Choice(list(given.pop("choices")))
        if self.is_argument:
            return click.Argument([name], **{"nargs": -1 if many else 1, **given})
        names = [name, *(self.names or (f"--{name.replace('_', '-')}",))]
        if single is not bool and not isinstance(given["type"], click.Choice):
            given["metavar"] = given.get("metavar") or _KINDS.get(single) or names[-1].strip("-").upper()
        if single is bool:
            return _Option(self, names, is_flag=True, help=given["help"])
        needed = not (isinstance(kind, UnionType) or many or "default" in given)
        implied = {"multiple": many, "required": needed, "show_default": given.get("default") is not None}
        return _Option(self, names, **{**implied, **given})


class _Option(click.Option):
    """An option that knows its declaration, which others may share."""

    def __init__(self, declaration: Declaration, *given: Any, **attributes: Any) -> None:  # noqa: ANN401 - click's
        super().__init__(*given, **attributes)
        self.declaration = declaration


def option(text: str, *names: str, **attributes: Any) -> Any:  # noqa: ANN401 - the default of a parameter
    """Declare an option by its help; ``names`` such as ``-n`` where the parameter's name is not its own."""
    return Declaration(names, {"help": text, **attributes})


def argument(metavar: str | None = None, **attributes: Any) -> Any:  # noqa: ANN401 - as above
    """Declare an argument."""
    return Declaration((), {"metavar": metavar, **attributes}, True)


def out(metavar: str, text: str, *names: str, report: bool = False, kind: str = "", **attributes: Any) -> Any:  # noqa: ANN401
    """Declare what is written, ``-o`` or of another name.

    ``report``: a folder that is not another command's. ``kind``: a pattern that a file must hold to be replaced.
    """
    callback = partial(kept, report=report, kind=kind)
    return option(text, *(names or ("-o", "--output")), metavar=metavar, callback=callback, **attributes)


def kept(context: click.Context, _: click.Parameter, given: Any, kind: str = "", *, report: bool = False) -> Any:  # noqa: ANN401
    """Reject a folder of another command's report, or a file of another kind; say at the end what was replaced."""
    own = {"demo": "run"}.get(command := _command(context), command)
    for path in given if isinstance(given, tuple) else [given] if given is not None else []:
        file = Path(path).expanduser()
        if os.path.isdir(file):
            if report and (theirs := _written_by(file)) not in ("", own):
                raise InputError(
                    f"{path}: holds a report of {theirs}, which would be written over; choose another folder"
                )
        elif os.path.isfile(file) and kind:
            with contextlib.suppress(OSError), open(file, encoding="latin-1") as there:
                if (head := there.read(5000)) and not re.search(kind, head, re.MULTILINE):
                    raise InputError(f"{path}: holds something else, which would be written over; choose another name")
        if own not in ("hub", "live"):  # which add to their files
            if "before" not in context.meta:
                context.meta["before"] = {}
                context.call_on_close(partial(_say_replaced, context.meta["before"]))
            if os.path.isdir(file) or not report:  # beside a folder that is not there yet lies nothing of it
                context.meta["before"] |= _state(os.path.expanduser(path))
    return given


def _command(context: click.Context) -> str:
    """Return the words of a command without the program's, which has another name where it is called otherwise."""
    return "" if context.parent is None else f"{_command(context.parent)} {context.info_name}".strip()


def _written_by(folder: Path) -> str:
    """Return the command whose report is in a folder, also of version 0.2; empty where there is none."""
    import html  # `measure` starts without it

    if (folder / "summary.json").is_file():
        return "run"
    with contextlib.suppress(OSError), open(folder / "report.html", encoding="utf-8", errors="replace") as report:
        found = re.search(r"<title>(?:armsight:? |(?=Bring-up))([^<]*)", report.read(500))
        title = html.unescape(found[1]) if found else "another program"
        with contextlib.suppress(OSError, ValueError):
            arms = json.loads((folder / "report.json").read_text(encoding="utf-8"))
            if isinstance(arms, dict) and arms.get("arm") == title:
                return "arm report"
        return _TITLES.get(title, title)
    return ""


def _state(path: str) -> dict[str, tuple[int, int]]:
    """Return inode and time, ns, of a file and of those named after it, or of the files of a folder."""
    folder, name = (path, "") if os.path.isdir(path) else os.path.split(path)
    beside = re.compile(rf"{re.escape(name)}$|{re.escape(os.path.splitext(name)[0])}[.-]" if name else "")
    with contextlib.suppress(OSError):
        files = [os.path.join(folder, each) for each in os.listdir(folder or ".") if beside.match(each)]
        return {each: (at.st_ino, at.st_mtime_ns) for each in files if os.path.isfile(each) for at in [os.stat(each)]}
    return {}


def _say_replaced(before: Mapping[str, tuple[int, int]]) -> None:
    there = ((file, os.stat(file)) for file in sorted(before) if os.path.exists(file))
    if changed := [file for file, now in there if (now.st_ino, now.st_mtime_ns) != before[file]]:
        more = f" and {len(changed) - _LISTED} more" if len(changed) > _LISTED else ""
        note(f"replaced: {', '.join(changed[:_LISTED])}{more}")


def _parameters(of: Any) -> Iterator[click.Parameter]:  # noqa: ANN401 - a function or a class
    """Yield the parameters of a function or a record; a parameter that is a record is all of its fields."""
    kinds = get_type_hints(of)
    names = [each.name for each in fields(of)] if is_dataclass(of) else list(signature(of).parameters)
    defaults = vars(of) if is_dataclass(of) else {k: v.default for k, v in signature(of).parameters.items()}
    for name in names:
        if isinstance(declaration := defaults.get(name), Declaration):
            yield declaration.parameter(name, kinds[name])
        elif is_dataclass(kinds[name]):
            yield from _parameters(kinds[name])


def declared(function: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command the parameters that its function declares, in their order."""
    kinds = get_type_hints(function)
    records = {name: kinds[name] for name in signature(function).parameters if is_dataclass(kinds[name])}

    @wraps(function)
    def call(*context: Any, **given: Any) -> Any:  # noqa: ANN401 - click's
        for name, kind in records.items():
            given[name] = kind(**{each.name: given.pop(each.name) for each in fields(kind)})
        return function(*context, **given)

    call.__click_params__ = list(reversed(list(_parameters(function))))  # type: ignore[attr-defined]
    return call


def _checked(_: click.Context, __: click.Parameter, streams: tuple[str, ...]) -> tuple[str, ...]:
    """Read who the cell is, so that a mistake is said before anything begins."""
    for spec in streams:
        if spec.startswith(CELL):
            from armsight.app.stream.cell_file import read_cell

            read_cell(spec.removeprefix(CELL))
    return streams


JSON = option("Print JSON; units are in the keys, else SI.", "--json")
STREAM = option(
    "Publish meanwhile: foxglove:PORT, json+tcp:PORT, json+udp:HOST:PORT, igtl:PORT or ros2:PORT; cell:NAME[@HUB] or "
    "cell:FILE.toml reports to the hub of the site; may be repeated (docs/howto/recordings.md, docs/howto/cells.md).",
    "--stream",
    metavar="STREAM",
    callback=_checked,
)
REFERENCES = option(
    "Fuse an inertial unit or a range, or compare a magnetometer (docs/howto/references.md).", metavar="REFERENCES.toml"
)
FIXED = option(
    "A body in view that does not move; may be repeated. It shows cameras that move.", "--fixed", metavar="BODY"
)
ARM = option("The arm: a name (armsight arm list), a .toml or a .urdf file.", "--arm", default="six_r", metavar="ARM")
FOLLOW_RIG = option("Put the rig right during a run where its cameras, or both, moved (docs/concepts/health.md).")
ESTIMATOR = option("How poses become one estimate.", choices=("kalman", "latest"), default="kalman")
SEED = option("Seed of all random numbers.", min=0, default=0)
SECONDS = option("Stop after this many seconds.", min=0, min_open=True)
