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


def _part(option: str, k: int, default: str, *, before: str = "", mark: str = ",") -> Rule:
    """Return the rule of the first (0) or the second (1) one of two values behind one option, with a mark between."""

    def rule(arguments: list[str], value: str) -> None:
        both = default
        if option in arguments[:-1]:
            at = arguments.index(option)
            both = arguments[at + 1].removeprefix(before)
            del arguments[at : at + 2]
        parts = both.rsplit(mark, 1)
        parts[k] = value
        arguments += [option, before + mark.join(parts)]

    return rule


def _link(arguments: list[str], link: str) -> None:
    """Put the tool's link behind the arm: a URDF's file, else what an option or the first argument of `arm` names."""
    named = [k for k, each in enumerate(arguments) if each.lower().endswith((".urdf", ".xml"))]
    named += [k + 1 for k, each in enumerate(arguments[:-1]) if each in ("--arm", "--model", "--nominal-arm")]
    named += [2] if arguments[0] == "arm" and len(arguments) > 2 else []
    for k in named[:1]:
        arguments[k] += f"#{link}"


def _nothing(arguments: list[str], value: str) -> None:
    """Leave an option out that nothing needs any more."""


_EMULATED = "emulated:unicorn"  # the board of commands that are given none
_FEETECH, _PAIRS = "write --board feetech:PORT,FILE.json", "write --source pairs:LEFT,RIGHT"
_SEEN_BY_TWO = ("calibrate", "measure", "handeye")
#: All of them.
RETIRED = (
    Retired("--tool-link", (), "write ARM.urdf#LINK", _link),
    Retired("--baud", ("board",), "write --board serial:PORT,baud=N", _behind("--board", ",baud={}", _EMULATED)),
    Retired("--calibration", ("board", "run", "live"), _FEETECH, _behind("--board", ",{}", _EMULATED)),
    Retired(
        "--cell", ("measure", "run", "live", "record", "replay"), "--stream cell:NAME", _into("--stream", "cell:{}")
    ),
    Retired("--left", _SEEN_BY_TWO, _PAIRS, _part("--source", 0, ",", before="pairs:")),
    Retired("--right", _SEEN_BY_TWO, _PAIRS, _part("--source", 1, ",", before="pairs:")),
    Retired("--images", ("handeye",), "write --source GLOB", _into("--source")),
    Retired("--left-intrinsics", ("calibrate",), "write --alone LEFT,RIGHT", _part("--alone", 0, ",")),
    Retired("--right-intrinsics", ("calibrate",), "write --alone LEFT,RIGHT", _part("--alone", 1, ",")),
    Retired(
        "--detections", ("calibrate", "measure"), "write --source detections:FILE", _into("--source", "detections:{}")
    ),
    Retired("--body", ("calibrate",), "write --target BODY.csv", _into("--target")),
    Retired("--units", ("handeye",), "write --columns units=mm", _into("--columns", "units={}")),
    Retired("--seen-units", ("handeye",), "write --columns seen:units=mm", _into("--columns", "seen:units={}")),
    Retired(
        "--detect-units", ("handeye",), "write --columns units=detect", _into("--columns", "units=detect"), is_flag=True
    ),
    Retired("--rotation", ("handeye", "identify"), "write --columns rotation=xyz", _into("--columns", "rotation={}")),
    Retired(
        "--seen-rotation", ("handeye",), "write --columns seen:rotation=xyz", _into("--columns", "seen:rotation={}")
    ),
    Retired("--frames", ("handeye",), "write --columns frames=BASE:FLANGE", _into("--columns", "frames={}")),
    Retired("--scheduler", ("batch",), "write --workers tcp://HOST:PORT", _into("--workers")),
    Retired("--run", ("budget",), "write --rig RUN", _into("--rig")),
    Retired("--ar4-offsets", ("board",), "write --board ar4:FILE.yaml", _into("--board", "ar4:{}")),
    Retired("--follow-rig", ("demo",), "in the demo no rig moves", _nothing, is_flag=True),
    Retired("--rectified", ("dense",), "a pair without a RIG.json is rectified", _nothing, is_flag=True),
    Retired("--rate", ("run", "live"), "the rate of the cameras is measured", _nothing),
    Retired("--host", ("live",), "write --http HOST:PORT", _part("--http", 0, "127.0.0.1:8722", mark=":")),
    Retired("--host", ("hub",), "write --hub HOST:PORT", _part("--hub", 0, "127.0.0.1:7447", mark=":")),
    Retired("--port", ("live",), "write --http HOST:PORT", _part("--http", 1, "127.0.0.1:8722", mark=":")),
    Retired("--port", ("hub",), "write --hub HOST:PORT", _part("--hub", 1, "127.0.0.1:7447", mark=":")),
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
    return kept, [f"{retired.option} is retired: {retired.now}" for retired, _ in found]
