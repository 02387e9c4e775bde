"""Options that are retired: command lines that have them go on working, and say what is written today.

In: the arguments of a command line. Out: the same in today's options. A rule puts the value of a retired option where it
belongs now.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

Rule = Callable[[list[str], str], None]  # puts a value into the arguments


class Retired(NamedTuple):
    """A retired option."""

    option: str
    commands: tuple[str, ...]  #: that had it; () all
    now: str  #: what is written today
    rule: Rule
    is_flag: bool = False


def _into(option: str, form: str = "{}") -> Rule:
    """Return the rule of an option whose value another one takes."""

    def rule(arguments: list[str], value: str) -> None:
        arguments += [option, form.format(value)]

    return rule


def _behind(option: str, form: str, default: str) -> Rule:
    """Return the rule of an option whose value stands behind that of another one, which has a default."""

    def rule(arguments: list[str], value: str) -> None:
        if option not in arguments[:-1]:
            arguments += [option, default]
        arguments[arguments.index(option) + 1] += form.format(value)

    return rule


def _side(option: str, form: str, side: int) -> Rule:
    """Return the rule of the left (0) or the right (1) one of a pair, LEFT,RIGHT behind one option."""

    def rule(arguments: list[str], value: str) -> None:
        sides = ["", ""]
        if option in arguments[:-1]:
            at = arguments.index(option)
            sides = arguments[at + 1].removeprefix(form).rsplit(",", 1)
            del arguments[at : at + 2]
        sides[side] = value
        arguments += [option, form + ",".join(sides)]

    return rule


def _link(arguments: list[str], link: str) -> None:
    """Put the tool's link behind the arm: a URDF's file, else what an option or the first argument of `arm` names."""
    named = [k for k, each in enumerate(arguments) if each.lower().endswith((".urdf", ".xml"))]
    named += [k + 1 for k, each in enumerate(arguments[:-1]) if each in ("--arm", "--model", "--nominal-arm")]
    named += [2] if arguments[0] == "arm" and len(arguments) > 2 else []
    for k in named[:1]:
        arguments[k] += f"#{link}"


_EMULATED = "emulated:unicorn"  # the board of commands that are given none
_FEETECH, _PAIRS = "--board feetech:PORT,FILE.json", "--source pairs:LEFT,RIGHT"
_SEEN_BY_TWO = ("calibrate", "measure", "handeye")
#: All of them.
RETIRED = (
    Retired("--tool-link", (), "ARM.urdf#LINK", _link),
    Retired("--baud", ("board",), "--board serial:PORT,baud=N", _behind("--board", ",baud={}", _EMULATED)),
    Retired("--calibration", ("board", "run", "live"), _FEETECH, _behind("--board", ",{}", _EMULATED)),
    Retired(
        "--cell", ("measure", "run", "live", "record", "replay"), "--stream cell:NAME", _into("--stream", "cell:{}")
    ),
    Retired("--left", _SEEN_BY_TWO, _PAIRS, _side("--source", "pairs:", 0)),
    Retired("--right", _SEEN_BY_TWO, _PAIRS, _side("--source", "pairs:", 1)),
    Retired("--images", ("handeye",), "--source GLOB", _into("--source")),
    Retired("--left-intrinsics", ("calibrate",), "--alone LEFT,RIGHT", _side("--alone", "", 0)),
    Retired("--right-intrinsics", ("calibrate",), "--alone LEFT,RIGHT", _side("--alone", "", 1)),
    Retired("--detections", ("calibrate", "measure"), "--source detections:FILE", _into("--source", "detections:{}")),
    Retired("--body", ("calibrate",), "--target BODY.csv", _into("--target")),
    Retired("--units", ("handeye",), "--columns units=mm", _into("--columns", "units={}")),
    Retired("--seen-units", ("handeye",), "--columns seen:units=mm", _into("--columns", "seen:units={}")),
    Retired("--detect-units", ("handeye",), "--columns units=detect", _into("--columns", "units=detect"), is_flag=True),
    Retired("--rotation", ("handeye", "identify"), "--columns rotation=xyz", _into("--columns", "rotation={}")),
    Retired("--seen-rotation", ("handeye",), "--columns seen:rotation=xyz", _into("--columns", "seen:rotation={}")),
    Retired("--frames", ("handeye",), "--columns frames=BASE:FLANGE", _into("--columns", "frames={}")),
)


def in_todays_options(arguments: list[str]) -> tuple[list[str], list[str]]:
    """Return a command line in today's options, and a line for each one in it that is retired."""
    command = next(iter(arguments), "")
    known = {each.option: each for each in RETIRED if command in (each.commands or (command,))}
    kept, found, rest = list[str](), list[tuple[Retired, str]](), iter(arguments)
    for argument in rest:
        name, equals, value = argument.partition("=")
        retired = known.get(name)
        if retired is None:
            kept.append(argument)
        else:
            found.append((retired, value if equals or retired.is_flag else next(rest, "")))
    for retired, value in found:
        retired.rule(kept, value)
    return kept, [f"{retired.option} is retired: write {retired.now}" for retired, _ in found]
