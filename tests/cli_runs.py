"""Runs of the command line in this process, and the manners a mistake must have."""

import json
import signal
import sys
from dataclasses import dataclass

import pytest

from armsight.app.main import main


@dataclass(frozen=True)
class Said:
    """What one run of the command line printed, and how it ended."""

    code: int
    out: str
    err: str

    @property
    def lines(self):
        """The JSON objects on stdout, one a line; NaN and infinity are no JSON."""
        return [json.loads(line, parse_constant=_not_json) for line in self.out.splitlines()]


def _not_json(text):
    raise AssertionError(f"{text} is not JSON")


def run(*arguments):
    """Run ``armsight`` with arguments in this process and return its exit code."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["armsight", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            main()
    return end.value.code


def assert_rejected(said, *words):
    """Hold a run to the manners of a mistake: code 2, one line on stderr that has the words, nothing on stdout."""
    assert said.code == 2, said
    lines = said.err.splitlines()
    assert len(lines) == 1, said.err
    assert lines[0].startswith("armsight: error: ")
    assert "Traceback" not in said.err
    assert said.out == ""
    for word in words:
        assert str(word) in said.err, said.err


def listening():
    """Run in a child before it starts: hear an interrupt even where the tests themselves run with it ignored."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
