"""Commands of pages: what is well-formed becomes a record, everything else one line."""

import dataclasses
import json
import random
import string
from pathlib import Path

import numpy as np
import pytest

from armsight.app.live import records, session
from armsight.app.live.records import COMMANDS, command_of, json_of, json_text, polyline
from armsight.errors import InputError

EXAMPLES = {"str": "x", "float": 1.5, "bool": True}


assert session  # its steps have the commands


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_is_read_from_json(name):
    fields = {each.name: EXAMPLES[str(each.type)] for each in dataclasses.fields(COMMANDS[name])}
    assert command_of(json.dumps({"command": name, **fields})) == COMMANDS[name](**fields)
    assert COMMANDS[name].__doc__


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "JSON"),
        ("[" * 3000, "JSON"),
        ("[1]", "object"),
        ('{"command": 3}', "object"),
        ('{"command": "Explode"}', "known are .*GoTo"),
        ('{"command": "GoTo"}', "needs the field 'step'"),
        ('{"command": "GoTo", "step": 3}', "step must be a finite str"),
        ('{"command": "GoTo", "step": "a", "more": 1}', "no field 'more'"),
        ('{"command": "SetAim", "error_mm": NaN, "distance_m": 1}', "error_mm must be a finite float"),
        ('{"command": "SetAim", "error_mm": true, "distance_m": 1}', "error_mm must be a finite float"),
        ('{"command": "RunMotions", "closed": 1}', "closed must be a finite bool"),
        ("x" * 5000, "4096 characters"),
    ],
)
def test_everything_else_is_one_line(text, said):
    with pytest.raises(InputError, match=said.replace("(", "\\(")) as error:
        command_of(text)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 700


def test_ten_thousand_malformed_messages_raise_nothing_else():
    rng, good = (
        random.Random(0),
        [json.dumps({"command": "UseBoard", "spec": "a", "measured_mm": 3}), '{"command": "Zero"}'],
    )
    read = 0
    for _ in range(10_000):
        text = list(rng.choice(good))
        for _ in range(rng.randint(1, 6)):
            text[rng.randrange(len(text))] = rng.choice(string.printable + "é\x00")
        try:
            read += isinstance(command_of("".join(text)), tuple(COMMANDS.values()))
        except InputError:
            continue
    assert read < 5000


def test_records_become_json():
    shown = json_of({"a": records.Drawn(0, "seen", (((1.0, 2.0),),)), "b": np.array([1.0, np.nan]), "c": np.int64(3)})
    assert shown == {"a": {"side": 0, "kind": "seen", "lines": [[[1.0, 2.0]]]}, "b": [1.0, None], "c": 3}
    assert json.loads(json.dumps(shown)) == shown
    state = {
        "a": records.Drawn(1, "body", (((0.1, 2.0),),)),
        "b": np.array([[1.0]]),
        "c": np.float64(3),
        "d": Path("x"),
    }
    for more in ({}, {"e": (np.nan, np.int64(2))}):  # the second is not all finite
        assert json.loads(json_text(state | more)) == json_of(state | more)
    uv = np.array([[0.04, 1.0], [np.nan, 1.0], [2.0, 3.0]])
    assert polyline(uv, closed=True) == ((0.0, 1.0), (2.0, 3.0), (0.0, 1.0))
