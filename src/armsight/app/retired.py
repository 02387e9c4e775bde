"""Options that are retired: command lines that have them go on working, and say what is written today."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from typing import NamedTuple

from armsight.errors import InputError

#: Puts a value into the arguments; returns the option it went to, and what is written today where that is its own words.
Rule = Callable[[list[str], str], tuple[str, str]]


class Retired(NamedTuple):
    """A retired option."""

    option: str
    commands: tuple[str, ...]  #: that had it; () all
    rule: Rule
    is_flag: bool = False


def _into(option: str, form: str = "{}", *, many: bool = True) -> Rule:
    """Return the rule of an option whose value another one, or none, takes, which may be given several times, or not."""

    def rule(arguments: list[str], value: str) -> tuple[str, str]:
        if not many and option in arguments:
            raise InputError(
                f"{option} {_value(arguments, option)} says the same as what is retired: give one of the two"
            )
        arguments += (new := [*filter(None, [option]), form.format(value)])
        return option, f"write {shlex.join(new)}"

    return rule


def _behind(option: str, form: str) -> Rule:
    """Return the rule of an option whose value stands behind that of another one."""

    def rule(arguments: list[str], value: str) -> tuple[str, str]:
        if option not in arguments[:-1]:
            raise InputError(f"{value} is of a board: give it behind one, {option} BOARD{form.format(value)}")
        arguments[arguments.index(option) + 1] += form.format(value)
        return option, ""

    return rule


def _value(arguments: list[str], option: str) -> str:
    """Return what stands behind an option."""
    return "".join(arguments[arguments.index(option) + 1 :][:1])


def _part(option: str, k: int, default: str, *, before: str = "", mark: str = ",") -> Rule:
    """Return the rule of the first (0) or the second (1) one of two values behind one option, with a mark between."""

    def rule(arguments: list[str], value: str) -> tuple[str, str]:
        both = default
        if option in arguments[:-1]:
            at = arguments.index(option)
            if not arguments[at + 1].startswith(before):
                raise InputError(f"{option} {arguments[at + 1]} says the same as what is retired: give one of the two")
            both = arguments[at + 1].removeprefix(before)
            del arguments[at : at + 2]
        parts = [*both.rsplit(mark, 1), default.rsplit(mark, 1)[1]][:2]
        parts[k] = value
        arguments += [option, before + mark.join(parts)]
        return option, ""

    return rule


_OF_ARMS = ("--arm", "--model", "--nominal-arm")


def _link(arguments: list[str], link: str) -> tuple[str, str]:
    """Put the tool's link behind the arm: what an option names, or the first argument of ``arm`` that is no option."""
    named = [k + 1 for k, each in enumerate(arguments[:-1]) if each in _OF_ARMS]
    if arguments[0] == "arm":  # arm COMMAND ARM; options of its commands but flags have values
        own = [k for k, each in enumerate(arguments) if k > 1 and not each.startswith("-")]
        named += [k for k in own if not _has_value(arguments[k - 1])]
    if not named:
        raise InputError(f"--tool-link {link}: give the arm it is a link of, ARM.urdf#{link}")
    arguments[named[0]] += f"#{link}"
    return "", f"write {shlex.quote(arguments[named[0]])}"


def _has_value(argument: str) -> bool:
    """Return whether an argument of ``arm`` is an option with a value behind it."""
    return argument.startswith("-") and argument not in ("--json", "--yes")


def _nothing(why: str) -> Rule:
    """Return the rule of an option that nothing needs any more, and why."""
    return lambda arguments, value: ("", why)


_SEEN_BY_TWO = ("calibrate", "measure", "handeye")
#: All of them.
RETIRED = (
    Retired("--tool-link", (), _link),
    Retired("--baud", ("board",), _behind("--board", ",baud={}")),
    Retired("--calibration", ("board", "run"), _behind("--board", ",{}")),
    Retired("--cell", ("measure", "run", "live", "record", "replay"), _into("--stream", "cell:{}")),
    Retired("--left", _SEEN_BY_TWO, _part("--source", 0, ",", before="pairs:")),
    Retired("--right", _SEEN_BY_TWO, _part("--source", 1, ",", before="pairs:")),
    Retired("--images", ("handeye",), _into("--source", many=False)),
    Retired("--left-intrinsics", ("calibrate",), _part("--alone", 0, ",")),
    Retired("--right-intrinsics", ("calibrate",), _part("--alone", 1, ",")),
    Retired("--detections", ("calibrate", "measure"), _into("--source", "detections:{}", many=False)),
    Retired("--body", ("calibrate",), _into("--target", many=False)),
    Retired("--units", ("handeye",), _into("--columns", "units={}")),
    Retired("--seen-units", ("handeye",), _into("--columns", "seen:units={}")),
    Retired("--detect-units", ("handeye",), _into("--columns", "units=detect"), is_flag=True),
    Retired("--rotation", ("handeye", "identify"), _into("--columns", "rotation={}")),
    Retired("--seen-rotation", ("handeye",), _into("--columns", "seen:rotation={}")),
    Retired("--frames", ("handeye",), _into("--columns", "frames={}")),
    Retired("--scheduler", ("batch",), _into("--workers", many=False)),
    Retired("--run", ("budget",), _into("--rig", many=False)),
    Retired("--baseline", ("budget",), _into("", "baseline={}")),
    Retired("--ar4-offsets", ("board",), _into("--board", "ar4:{}", many=False)),
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
    if not any(argument.partition("=")[0] in known for argument in arguments):
        return arguments, []
    kept, found, rest = list[str](), list[tuple[Retired, str]](), iter(arguments)
    for argument in rest:
        name, equals, value = argument.partition("=")
        retired = known.get(name)
        if retired is not None:
            found.append((retired, value if equals or retired.is_flag else next(rest, "")))
        else:  # the rules look for options by themselves
            kept += [name, value] if equals and name.startswith("--") else [argument]
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
