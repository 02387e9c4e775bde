"""Options that are retired: command lines that have them go on working, and say what is written today.

In: the arguments of a command line. Out: the same in today's options. A rule puts the value of a retired option where it
belongs now.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable
from typing import NamedTuple

#: Puts a value into the arguments; returns the option it went to, and what is written today where that is its own words.
Rule = Callable[[list[str], str], tuple[str, str]]


class Retired(NamedTuple):
    """A retired option."""

    option: str
    commands: tuple[str, ...]  #: that had it; () all
    rule: Rule
    is_flag: bool = False


def _into(option: str, form: str = "{}") -> Rule:
    """Return the rule of an option whose value another one takes."""

    def rule(arguments: list[str], value: str) -> tuple[str, str]:
        arguments += [option, form.format(value)]
        return option, f"write {shlex.join(arguments[-2:])}"

    return rule


def _behind(option: str, form: str, default: str) -> Rule:
    """Return the rule of an option whose value stands behind that of another one, which has a default."""

    def rule(arguments: list[str], value: str) -> tuple[str, str]:
        if option not in arguments[:-1]:
            arguments += [option, default]
        arguments[arguments.index(option) + 1] += form.format(value)
        return option, ""

    return rule


def _part(option: str, k: int, default: str, *, before: str = "", mark: str = ",") -> Rule:
    """Return the rule of the first (0) or the second (1) one of two values behind one option, with a mark between."""

    def rule(arguments: list[str], value: str) -> tuple[str, str]:
        both = default
        if option in arguments[:-1]:
            at = arguments.index(option)
            both = arguments[at + 1].removeprefix(before)
            del arguments[at : at + 2]
        parts = both.rsplit(mark, 1)
        parts[k] = value
        arguments += [option, before + mark.join(parts)]
        return option, ""

    return rule


def _link(arguments: list[str], link: str) -> tuple[str, str]:
    """Put the tool's link behind the arm: a URDF's file, else what an option or the first argument of `arm` names."""
    named = [k for k, each in enumerate(arguments) if each.lower().endswith((".urdf", ".xml"))]
    named += [k + 1 for k, each in enumerate(arguments[:-1]) if each in ("--arm", "--model", "--nominal-arm")]
    named += [2] if arguments[0] == "arm" and len(arguments) > 2 else []
    for k in named[:1]:
        arguments[k] += f"#{link}"
    return "", f"write {shlex.quote(arguments[named[0]]) if named else f'ARM.urdf#{link}'}"


def _nothing(why: str) -> Rule:
    """Return the rule of an option that nothing needs any more, and why."""
    return lambda arguments, value: ("", why)


_EMULATED = "emulated:unicorn"  # the board of commands that are given none
_SEEN_BY_TWO = ("calibrate", "measure", "handeye")
#: All of them.
RETIRED = (
    Retired("--tool-link", (), _link),
    Retired("--baud", ("board",), _behind("--board", ",baud={}", _EMULATED)),
    Retired("--calibration", ("board", "run", "live"), _behind("--board", ",{}", _EMULATED)),
    Retired("--cell", ("measure", "run", "live", "record", "replay"), _into("--stream", "cell:{}")),
    Retired("--left", _SEEN_BY_TWO, _part("--source", 0, ",", before="pairs:")),
    Retired("--right", _SEEN_BY_TWO, _part("--source", 1, ",", before="pairs:")),
    Retired("--images", ("handeye",), _into("--source")),
    Retired("--left-intrinsics", ("calibrate",), _part("--alone", 0, ",")),
    Retired("--right-intrinsics", ("calibrate",), _part("--alone", 1, ",")),
    Retired("--detections", ("calibrate", "measure"), _into("--source", "detections:{}")),
    Retired("--body", ("calibrate",), _into("--target")),
    Retired("--units", ("handeye",), _into("--columns", "units={}")),
    Retired("--seen-units", ("handeye",), _into("--columns", "seen:units={}")),
    Retired("--detect-units", ("handeye",), _into("--columns", "units=detect"), is_flag=True),
    Retired("--rotation", ("handeye", "identify"), _into("--columns", "rotation={}")),
    Retired("--turns", ("identify",), _into("--columns", "rotation={}")),
    Retired("--seen-rotation", ("handeye",), _into("--columns", "seen:rotation={}")),
    Retired("--frames", ("handeye",), _into("--columns", "frames={}")),
    Retired("--scheduler", ("batch",), _into("--workers")),
    Retired("--run", ("budget",), _into("--rig")),
    Retired("--ar4-offsets", ("board",), _into("--board", "ar4:{}")),
    Retired("--follow-rig", ("demo",), _nothing("in the demo no rig moves"), is_flag=True),
    Retired("--rectified", ("dense",), _nothing("a pair without a RIG.json is rectified"), is_flag=True),
    Retired("--rate", ("run", "live"), _nothing("the rate of the cameras is measured")),
    Retired("--host", ("live",), _part("--http", 0, "127.0.0.1:8722", mark=":")),
    Retired("--host", ("hub",), _part("--hub", 0, "127.0.0.1:7447", mark=":")),
    Retired("--port", ("live",), _part("--http", 1, "127.0.0.1:8722", mark=":")),
    Retired("--port", ("hub",), _part("--hub", 1, "127.0.0.1:7447", mark=":")),
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
    said = dict[str, tuple[list[str], str]]()
    for retired, value in found:
        option, text = retired.rule(kept, value)
        options, _ = said.get(text or option, ([], ""))
        said[text or option] = [*options, retired.option], text or option
    final = {
        text: text if text not in kept else f"write {shlex.join(kept[(at := kept.index(text)) : at + 2])}"
        for text in said
    }
    return kept, [
        f"{', '.join(opts)} {'are' if len(opts) > 1 else 'is'} retired: {final[text]}" for opts, text in said.values()
    ]
