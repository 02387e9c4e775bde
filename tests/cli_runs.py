"""Runs of the command line in this process, and the manners a mistake must have."""

import json
import os
import signal
import sys
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path

import pytest

from armsight.app.main import main

KEYS = Path(__file__).with_name("json_keys.json")


@dataclass(frozen=True)
class Said:
    """What one run of the command line printed, and how it ended."""

    code: int
    out: str
    err: str

    def done(self):
        """Return the same, of a command that must have succeeded."""
        assert self.code == 0, self.err
        return self

    @property
    def one(self):
        """The one JSON object of a command that must have succeeded."""
        (found,) = self.done().lines
        return found

    @property
    def lines(self):
        """The JSON objects on stdout, one a line; NaN and infinity are no JSON."""
        return [json.loads(line, parse_constant=_not_json) for line in self.out.splitlines()]


def _not_json(text):
    raise AssertionError(f"{text} is not JSON")


def objects_of(value, at=""):
    """Yield path and keys of each object in a JSON value, such as ``poses[]``; names out of the input are ``*``."""
    if isinstance(value, list):
        for each in value:
            yield from objects_of(each, f"{at}[]")
    elif isinstance(value, dict):
        names = {k: k if k.isidentifier() and (k.islower() or "_" in k) else "*" for k in value}
        yield at, set(names.values()) - {"*"}
        for key, name in names.items():
            yield from objects_of(value[key], f"{at}.{name}")


def hold_keys(arguments, out, kind=""):
    """Hold JSON to the keys that programs read, those of each kind of a sensor by themselves.

    After new ones: ``rm json_keys.json; ARMSIGHT_KEYS=1 pytest -n 0 app``.
    """
    command = " ".join([*takewhile(str.isalpha, map(str, arguments)), kind]).strip()
    known = json.loads(KEYS.read_text()) if KEYS.exists() else {}
    held = known.setdefault(command, {})
    new = "ARMSIGHT_KEYS" in os.environ
    for at, keys in (found for line in out.splitlines() for found in objects_of(json.loads(line))):
        held[at] = sorted(keys.intersection(held.get(at, keys))) if new else held.get(at, [])
        assert keys.issuperset(held[at]), f"armsight {command} --json: {at} has {sorted(keys)}, not {held[at]}"
    if new:
        KEYS.write_text(json.dumps(known, indent=1, sort_keys=True) + "\n")


def run(*arguments):
    """Run ``armsight`` with arguments in this process and return its exit code."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["armsight", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            main()
    return end.value.code


def said_of(capsys, *arguments, kind=""):
    """Run ``armsight`` and return what it printed; its JSON must have the keys that are known."""
    capsys.readouterr()
    said = Said(run(*arguments), *capsys.readouterr())
    if "--json" in arguments and said.code in (0, 3):
        hold_keys(arguments, said.out, kind)
    return said


def assert_has(text, *words):
    """Hold a text to words that stand in it."""
    assert [word for word in words if word not in text] == [], text


def assert_rejected(said, *words):
    """Hold a run to the manners of a mistake: code 2, one line on stderr that has the words, nothing on stdout."""
    assert said.code == 2, said
    lines = said.err.splitlines()
    assert len(lines) == 1, said.err
    assert lines[0].startswith("armsight: error: ")
    assert "Traceback" not in said.err
    assert said.out == ""
    assert_has(said.err, *map(str, words))


def listening():
    """Run in a child before it starts: hear an interrupt even where the tests themselves run with it ignored."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
