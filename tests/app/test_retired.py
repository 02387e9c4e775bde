"""Options that are retired: what they did is what today's do."""

from dataclasses import replace

import pytest

from armsight.app.main import group
from armsight.app.retired import RETIRED, in_todays_options
from cli_runs import assert_rejected


@pytest.mark.parametrize(
    ("before", "now"),
    [
        ("measure r.json --left a --target t --right=b", "measure r.json --target t --source pairs:a,b"),
        ("calibrate --right b --left a,c -o r", "calibrate -o r --source pairs:a,c,b"),
        ("calibrate --left-intrinsics a --target t", "calibrate --target t --alone a,"),
        ("measure r --detections bag:f", "measure r --source detections:bag:f"),
        (
            "calibrate --detections d --cameras c --body b.csv",
            "calibrate --cameras c --source detections:d --target b.csv",
        ),
        ("arm fk a.urdf --tool-link hand 0 0", "arm fk a.urdf#hand 0 0"),
        ("arm show six_r --tool-link=hand", "arm show six_r#hand"),
        ("identify plan --tool-link t --arm a.toml", "identify plan --arm a.toml#t"),
        ("board monitor --baud 9600 --board serial:p", "board monitor --board serial:p,baud=9600"),
        ("board monitor --board=serial:p --baud=9600", "board monitor --board serial:p,baud=9600"),
        ("arm fk --json six_r --tool-link hand 0", "arm fk --json six_r#hand 0"),
        ("run --rig s.xml --model=a.urdf --tool-link t", "run --rig s.xml --model a.urdf#t"),
        ("arm urdf --output n.urdf f.urdf --tool-link L", "arm urdf --output n.urdf f.urdf#L"),
        ("live --http=0.0.0.0:1 --port 80", "live --http 0.0.0.0:80"),
        ("hub keys s c --hub h.local --port 7000", "hub keys s c --hub h.local:7000"),
        ("run --calibration c.json --board feetech:p", "run --board feetech:p,c.json"),
        ("run --cell a@h:1 --stream igtl:1", "run --stream igtl:1 --stream cell:a@h:1"),
        ("hub push a b --cell a", "hub push a b --cell a"),
        ("handeye --units mm --seen-units m", "handeye --columns units=mm --columns seen:units=m"),
        ("handeye --detect-units --eye to-hand", "handeye --eye to-hand --columns units=detect"),
        ("identify --rotation zyx --columns x_m=X", "identify --columns x_m=X --columns rotation=zyx"),
        ("demo --left a", "demo --left a"),
        ("run --rate 30 --arm a", "run --arm a"),
        ("live --port 80 --host b", "live --http b:80"),
        ("hub keys s --host b", "hub keys s --hub b:7447"),
        ("board offsets --ar4-offsets m.yaml", "board offsets --board ar4:m.yaml"),
        ("budget --run r", "budget --rig r"),
        ("budget --baseline 80mm --json", "budget --json baseline=80mm"),
        ("batch check * --scheduler tcp://a:1", "batch check * --workers tcp://a:1"),
        ("", ""),
    ],
)
def test_a_command_line_of_before_is_one_of_today(before, now):
    arguments, notes = in_todays_options(before.split())
    assert arguments == now.split()
    assert bool(notes) == (before != now)


def with_commands(command):
    """A command, and those of its group."""
    return [command, *(getattr(command, "commands", {}).values())]


def test_each_is_said_in_a_line_and_none_is_an_option_any_more(armsight):
    said = armsight("measure", "none.json", "--target", "chessboard:9x6:25mm", "--left", "a", "--right", "b")
    note, error = said.err.splitlines()
    assert note == "note: --left, --right are retired: write --source pairs:a,b"
    assert "none.json" in error
    for each in RETIRED:
        for name in each.commands or group.list_commands(None):
            assert each.option not in [
                o for command in with_commands(group.get_command(None, name)) for p in command.params for o in p.opts
            ]


@pytest.mark.parametrize(
    ("before", "said"),
    [
        ("measure r --source folder:x --left a --right b", "--source folder:x says the same as what is retired"),
        ("measure r --source usb:0,1 --detections d", "--source usb:0,1 says the same"),
        ("batch check --workers 4 --scheduler tcp://a:1", "--workers 4 says the same"),
        ("budget --run r --rig r.json", "--rig r.json says the same"),
        ("board monitor --baud 9600", "give it behind one, --board BOARD,baud=9600"),
        ("demo --tool-link t", "give the arm it is a link of, ARM.urdf#t"),
    ],
)
def test_what_contradicts_or_is_incomplete_is_rejected(armsight, before, said):
    assert_rejected(armsight(*before.split()), said)


@pytest.mark.parametrize(
    ("before", "notes"),
    [
        ("identify --rotation zyx", ["--rotation is retired: write --columns rotation=zyx"]),
        ("handeye --units m --detect-units", ["--units is retired: write --columns units=m",
                                              "--detect-units is retired: write --columns units=detect"]),
        ("measure r --left l*.png --right r*.png", ["--left, --right are retired: write --source 'pairs:l*.png,r*.png'"]),
        ("run --tool-link t --arm a.urdf", ["--tool-link is retired: write 'a.urdf#t'"]),
        ("run --rate 30", ["--rate is retired: the rate of the cameras is measured"]),
        ("board monitor --baud 9600 --board serial:p", ["--baud is retired: write --board serial:p,baud=9600"]),
    ],
)  # fmt: skip
def test_what_is_said_can_be_copied(before, notes):
    assert in_todays_options(before.split())[1] == notes


def test_half_a_pair_is_rejected(armsight):
    said = armsight("calibrate", "--left", "a", "--target", "chessboard:9x6:25mm", "-o", "r.json")
    assert_rejected(replace(said, err=said.err.splitlines()[-1] + "\n"), "two globs are needed")
