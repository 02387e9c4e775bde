"""``armsight board config``: the configuration as a file, compared, changed and stored."""

import json

from cli_runs import assert_rejected

HOST = ("--board", "emulated:host")


def test_a_configuration_goes_to_a_file_and_back(armsight, tmp_path):
    path = tmp_path / "board.toml"
    assert armsight("board", "config", "get", *HOST, "-o", str(path)).code == 0
    assert 'board = "pil"' in path.read_text(encoding="utf-8")
    assert armsight("board", "config", "diff", str(path), *HOST).code == 0
    said = armsight("board", "config", "store", str(path), *HOST)
    assert (said.code, said.err.strip()) == (0, "stored: in use after the board's next start")


def test_what_differs_is_printed_value_by_value(armsight, tmp_path):
    path = tmp_path / "board.toml"
    text = armsight("board", "config", "get", *HOST).out
    path.write_text(text.replace("soft_max_rad = 2.4", "soft_max_rad = 1.25", 1), encoding="utf-8")
    said = armsight("board", "config", "diff", str(path), *HOST)
    assert (said.code, said.out.strip()) == (1, f"joint.1.soft_max_rad: 2.4 on the board, 1.25 in {path}")
    found = json.loads(armsight("board", "config", "diff", str(path), *HOST, "--json").out)
    assert found == {"joint.1.soft_max_rad": [2.4, 1.25]}


def test_single_values_are_set(armsight):
    said = armsight("board", "config", "set", "joint.3.soft_max_rad=1.2", "arm.silence_ticks=200", *HOST, "--json")
    assert (said.code, json.loads(said.out)) == (0, {"stored": True})


def test_mistakes_are_one_line_and_change_nothing(armsight, tmp_path):
    path = tmp_path / "board.toml"
    path.write_text(armsight("board", "config", "get", *HOST).out.replace('"pil"', '"other"', 1), encoding="utf-8")
    assert_rejected(armsight("board", "config", "store", str(path), *HOST), "is for board other; this one is pil")
    assert_rejected(
        armsight("board", "config", "set", "joint.3.soft_max=1.2", *HOST),
        "nothing is called joint.3.soft_max; is it joint.3.soft_max_rad?",
    )
    assert_rejected(armsight("board", "config", "set", "joint.3.soft_max_rad=9", *HOST), "soft limits must lie within")
    assert_rejected(
        armsight("board", "config", "set", "arm.silence_ticks=", *HOST), "a path, = and a number are needed"
    )
