"""The ``armsight`` command: the group of commands, and how errors are reported.

Every command takes ``--json`` (JSON on stdout); progress and warnings go to stderr. A mistake in the input
is one line on stderr and exit code 2; a result that must not be trusted is exit code 3; an interrupt is exit code 130.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import os
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import click

from armsight.app.interrupts import terminate_as_interrupt
from armsight.app.retired import in_todays_options
from armsight.app.show.messages import UNANSWERED, colour, note, print_error, print_notes, silence_stdout
from armsight.errors import ArmsightError

#: What a person is about -> the commands with the first sentence of their help; each has a folder of its name.
SECTIONS: dict[str, dict[str, str]] = {
    "See it live": {
        "live": "Open a page in the browser that leads from two uncalibrated cameras to a closed loop, step by step."
    },
    "Calibrate cameras": {
        "budget": "Say before a rig is bought what it will measure, what limits it, and what would make it better.",
        "calibrate": "Calibrate two cameras, and evaluate the calibration on pairs held out of the fit.",
        "cameras": "List the attached cameras and their modes.",
        "record": "Store the shots of SOURCE in a folder, with their time stamps; the folder is then a source itself.",
        "rig": "Show a rig file, import a rig of another program, export one, or update one from what a run saw.",
    },
    "Measure": {
        "measure": "Measure the pose of a target in the left camera's frame, with its uncertainty.",
        "handeye": "Calibrate hand and eye from your own data: robot poses, and images or poses of a target.",
        "body": "Check a body file's geometry before the body is built, and print its markers to scale.",
        "replay": "Measure and estimate again what was recorded, also with another rig, body, arm or estimator.",
        "export": "Write the tables of a run or a recording in another form: CSV, Parquet, MCAP, TUM or a ROS 2 bag.",
        "references": "Check and calibrate inertial units, magnetometers and ranges, named in a file references.toml.",
        "batch": "Measure many recordings, on all cores or on a cluster; started again it goes on where it was.",
        "serve": "Keep `armsight measure` going for days.",
        "hub": "Show many cells on one page, first the one that needs a look; keep their events and history.",
        "dense": "Find a disparity for every pixel of a pair, or evaluate the methods on scenes with a truth.",
    },
    "Operate an arm": {
        "setup": "Walk through ARM's page, from the cameras to the corrected arm; setup.json remembers how far it came.",
        "arm": "Print an arm's table and kinematics: mm and degrees here, m and rad in --json.",
        "board": "Build and flash the arm's firmware, watch a board, tune its gains, test it.",
        "run": "Run the experiment on a real arm: hand-eye calibration, the motions, the loop closed on vision.",
    },
    "Check and identify an arm": {
        "check": "Evaluate an arm by ISO 9283: accuracy and repeatability.",
        "identify": "Identify an arm: its kinematic table, joint zeros, sensor errors, backlash and compliance, "
        "each with sigma.",
    },
    "Simulate": {
        "demo": "Calibrate, measure the moving arm, compare the tracks, and close the loop, in a simulated workcell."
    },
}
COMMANDS = tuple(sorted(name for names in SECTIONS.values() for name in names))
#: Options of one command -> what others call the same.
_ALSO = {
    "--model": ("--arm", "--lens-model"),
    "--arm": ("--model", "--robot"),
    "--robot": ("--arm", "--model"),
    "--board": ("--target",),
    "--body": ("--target",),
    "--target": ("--body",),
    "--images": ("--source",),
    "--cameras": ("--source",),
    "--folder": ("--source",),
    "--port": ("--board", "--source", "--http"),
}


class _Kind(NamedTuple):
    """A kind of files: in words, what its beginning matches, the options and commands that take it, usual ones first."""

    what: str
    begins: str
    takers: tuple[str, ...]


_KINDS = (
    _Kind("a rig", r'\s*\{\s*"format": "armsight-rig"', ("--rig", "measure", "rig", "budget", "dense")),
    _Kind("a recording", r"\x89MCAP|SQLite format 3|#ROSBAG", ("--source", "replay", "--robot", "export", "record")),
    _Kind("an image", r"\x89PNG|\xff\xd8\xff|BM|II\*\0|MM\0\*", ("--source", "dense")),
    _Kind("an arm's model (URDF)", r"(<\?xml[^>]*>|\s|<!--.*?-->)*<robot\b", ("--arm", "--model", "arm")),
    _Kind("a file of sensors", r'(?ms).*^kind *= *"(inertial|magnetometer|range)"', ("--references", "references")),
    _Kind("a motion file", r"(?ms).*^\[\[motion\]\]", ("--motion", "--volume")),
    _Kind(
        "a body file", r"(?ms).*^\[\[(markers|tags|boards|grids|discs)\]\]", ("--target", "body", "--fixed", "budget")
    ),
    _Kind("a board file", r"(?ms).*^board *= *\"\w+:", ("--target", "body")),
    _Kind("an arm file", r"(?ms).*^\[\[joint\]\]", ("--arm", "--model", "--identified", "arm")),
    _Kind("a service's file", r"(?ms).*^\[measure\]", ("serve",)),
    _Kind(
        "a table",
        r"([^\n={}\[\]<>\0,;\t]*[,;\t][^\n={}\[\]<>\0]*(\n|$)){2}",
        ("--data", "--robot", "--seen", "--joints", "--poses", "check", "body check", "--target"),
    ),
)
_RUN = _Kind("a run's folder", "", ("check", "replay", "export", "batch", "--rig"))
_SHOTS = _Kind("a folder of images", "", ("--source", "record", "replay", "dense", "batch"))
_BOTH = _RUN._replace(takers=_RUN.takers + _SHOTS.takers)
_TAKERS = {"--board"}.union(*(kind.takers for kind in (*_KINDS, _BOTH)))
_OTHERS = {"rig import", "rig update", "arm calibrated", "arm report"}  # take more kinds than their group's others
_READ = 5000  # bytes that say what a file is; half: a long comment may hide it, double: the same
_NAMED = 3  # takers that a message names; half: the right one may lack, double: a longer line


class _Sections(click.Group):
    """A group that lists its commands by section, and imports a command's module only when that command is requested."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        longest = max(map(len, COMMANDS))
        for title, commands in SECTIONS.items():
            with formatter.section(title):
                formatter.write_dl([(name.ljust(longest), text) for name, text in commands.items()])

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        # Matrices are small and many here: OpenBLAS's threads wait for each other at every one of them, which on a busy
        # computer costs ten times the time. It reads its setting when numpy is imported; a user's own setting stands.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        module = importlib.import_module(f"armsight.app.{cmd_name}.command")
        command: click.Command = module.command
        return command

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Read the command line, with today's options for those that are retired."""
        args, notes = in_todays_options(args)
        note(*notes)
        return super().parse_args(ctx, args)

    def invoke(self, ctx: click.Context) -> object:
        """Run a command; an interrupt leaves as Abort, before click prints an empty line; `| head` is no error."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            raise click.exceptions.Abort from None
        except BrokenPipeError:  # click would exit with 1
            silence_stdout()
            raise click.exceptions.Exit(0) from None


@click.group(cls=_Sections, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="armsight")
def group() -> None:
    """Measure the pose of a robot arm's end-effector with two USB cameras, in millimetres, with its uncertainty."""


def main() -> None:
    """Run the command line and exit: 0 done, 2 a mistake in the input (one line on stderr), 130 Ctrl-C or SIGTERM."""
    gc.set_threshold(100_000)  # what is imported stays: collections that look at it again and again take 20 ms
    terminate_as_interrupt()
    print_notes()
    sys.exit(run(sys.argv[1:]))


def run(arguments: list[str]) -> int:
    """Run a command and return its exit code; what is wrong is said on stderr."""
    at_exit: list[Callable[[int, str], None]] = []
    code, wrong = 1, "a mistake in armsight"
    try:
        code, wrong = _run(arguments, at_exit)
        if wrong:
            print_error(wrong)
    finally:
        try:
            for call in at_exit:
                call(code, wrong)
        except KeyboardInterrupt:  # while a hub is awaited that does not answer
            click.echo("armsight: interrupted", err=True)
            code = 130
    return code


def _run(arguments: list[str], at_exit: list[Callable[[int, str], None]]) -> tuple[int, str]:
    """Run a command and return its exit code, and what is wrong."""
    try:
        code = group.main(arguments, prog_name="armsight", standalone_mode=False, color=colour(), obj=at_exit)
        if sys.stdout is not None:
            sys.stdout.flush()
        return code if isinstance(code, int) else 0, ""
    except (click.exceptions.Abort, KeyboardInterrupt) as error:
        if isinstance(error.__context__, EOFError):
            click.echo(err=True)  # the question stands in this line
            return 2, f"{UNANSWERED}, or with --yes where there is one"
        answered_no = isinstance(error, click.exceptions.Abort) and error.__context__ is None
        click.echo("armsight: the answer is no: not done" if answered_no else "armsight: interrupted", err=True)
        return 130, ""
    except click.exceptions.NoArgsIsHelpError as error:  # a group by itself: its help
        error.show()
    except click.ClickException as error:
        return 2, _usage_text(error)
    except ArmsightError as error:
        return 2, f"{error}{_mistaken(str(error), arguments)}"
    except BrokenPipeError:
        silence_stdout()
        return 0, ""
    except OSError as error:  # errors of files and devices are ArmsightErrors: only the output is left
        silence_stdout()
        return 2, f"{error.filename or 'the output'}: cannot be written: {error.strerror or error}"
    return 2, ""


def _kind_of(path: Path) -> _Kind | None:
    """Return what a file or a folder is; None where that is not known."""
    if path.is_dir():
        names = {each.name for each in path.iterdir()}
        shots = any(name == "shots.csv" or name.endswith((".png", ".jpg", ".tif", ".tiff")) for name in names)
        if names & {"run.mcap", "reference.csv"}:
            return _BOTH if shots else _RUN
        return _SHOTS if shots else None
    if not path.is_file():  # a port or a pipe: whoever opens it may wait forever
        return None
    with path.open("rb") as file:
        text = file.read(_READ).decode("latin-1").removeprefix("\xef\xbb\xbf")
    text = re.sub(r"(?m)^[ \t]*#(?!ROSBAG).*\n?", "", text)
    return next((kind for kind in _KINDS if re.match(kind.begins, text)), None)


def _mistaken(problem: str, arguments: Sequence[str]) -> str:
    """Return what the file is that a problem is about, where the option that names it takes another kind; "" else."""
    option = ""
    for argument in arguments:
        given, equals, value = argument.partition("=") if argument.startswith("-") else (option, "", argument)
        option = "" if equals or given is option else given
        name = re.sub(r"^(bag|video|folder|feetech|ar4|serial):([^,]*,)?", "", value)
        with contextlib.suppress(OSError):
            if name and name in problem and Path(name).exists() and (kind := _kind_of(Path(name))) is not None:
                by = {given} if given not in ("", "--json") else {arguments[0], " ".join(arguments[:2])}
                if by & _TAKERS and not by & _OTHERS.union(kind.takers):
                    *first, last = [each if each[0] == "-" else f"armsight {each}" for each in kind.takers[:_NAMED]]
                    who = f"{', '.join(first)} and {last} take" if first else f"{last} takes"
                    return f"; {name} is {kind.what}, which {who}"
    return ""


def _usage_text(error: click.ClickException) -> str:
    """Return what click found wrong with the command line, as one line that ends with what to do."""
    text = " ".join(error.format_message().split()).replace("'. (", "' (").rstrip(".")
    text = text[:1].lower() + text[1:]
    text = re.sub("a valid float( range)?", "a number", re.sub("a valid integer( range)?", "a whole number", text))
    context = error.ctx if isinstance(error, click.UsageError) else None
    if context is not None and isinstance(error, click.NoSuchOption):
        text = f"no such option: {error.option_name}{_meant_option(error.option_name, context)}"
    if context is not None and (extra := re.search(r"unexpected extra arguments? \((.+)\)$", text)):
        text += _meant_extra(extra[1].split(), context)
    if context is not None and (unknown := re.match(r"no such command '(.*?)'", text)):
        text = unknown[0] + _meant(unknown[1], context)
    return text if context is None else f"{text}; the usage is in: {' '.join(context.command_path.split())} -h"


def _meant(name: str, context: click.Context) -> str:
    """Return what was likely meant by a word that is no command: a near one, or a file, which follows an option."""
    known = context.command.list_commands(context) if isinstance(context.command, click.Group) else []
    import difflib

    if near := difflib.get_close_matches(name, known, 1):
        return f": did you mean {near[0]}?"
    options = [option.opts[0] for option in context.command.params if isinstance(option.type, click.Path)]
    if options and ("." in name or os.sep in name):
        return f": a file follows an option, {options[0]} {name}"
    return f"; known are {', '.join(known)}" if context.parent is not None else ""


def _meant_extra(extra: list[str], context: click.Context) -> str:
    """Return what was likely meant by arguments too many: images without an option, or a glob that the shell expanded."""
    source = _option(context, "--source")
    if source is None:
        return ""
    given = str(context.params.get(source.name or "") or "")
    if not given:
        return f": images follow an option, --source {extra[0]}"
    if {os.path.splitext(each)[1] for each in extra} == {os.path.splitext(given)[1]}:
        return "; quote a glob, --source 'pairs:DIR/left*.png,DIR/right*.png', or the shell puts every file name there"
    return ""


def _option(context: click.Context, name: str) -> click.Option | None:
    """Return a command's option, or None where it has none of this name."""
    return next((p for p in context.command.params if isinstance(p, click.Option) and name in p.opts), None)


def _meant_option(name: str, context: click.Context) -> str:
    """Return what was likely meant by an option that a command does not have: another name of it, or one spelt alike."""
    for each in context.command.params:
        if isinstance(each, click.Argument) and (given := each.metavar or "").lower().startswith(name.lstrip("-")):
            return f": {given} is given without an option"
    known = [o for p in context.command.params if isinstance(p, click.Option) for o in p.opts if o.startswith("--")]
    also = [other for other in _ALSO.get(name, ()) if other in known]
    import difflib

    alike = difflib.get_close_matches(name.lstrip("-"), [each.lstrip("-") for each in known], 1)
    near = [*also, *(f"--{each}" for each in alike)]
    return f": did you mean {near[0]}?" if near else ""
