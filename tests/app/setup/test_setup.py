"""``armsight setup``: its table is the pages' commands, it goes on where it was, and finds ports and cameras."""

import json
import re
import sys
import threading
from pathlib import Path

import click
import pytest

from armsight.app.main import group, run
from armsight.app.setup import finding, walk
from armsight.app.setup.finding import check_arm, check_model, find_board, find_left_and_right, find_port
from armsight.app.setup.steps import ARMS, PLATE
from armsight.errors import InputError
from armsight.robot.boards.ar4 import board as ar4
from armsight.robot.boards.feetech import bus as feetech_bus
from armsight.sim.boards.ar4 import Ar4Teensy
from armsight.sim.boards.device import serve
from armsight.sim.boards.so101 import So101Bus
from armsight.vision.sources.v4l2 import VideoDevice
from cli_runs import assert_rejected

DOCS = Path(__file__).resolve().parents[3] / "docs/arms"
PAGES = {"so101": "so101", "ar4": "ar4", "six_r": "another_arm", "ur5e": "ur", "xarm6": "xarm", "franka": "franka"}


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def typed(monkeypatch):
    """Commands are parsed, and not carried out; returns those that came, and the exit codes that some shall have."""
    came, codes = [], {}

    def parsed(arguments):
        command, rest = group, list(arguments)
        while isinstance(command, click.Group):
            context = click.Context(command)
            if rest[0] not in command.list_commands(context):  # what its group does itself
                if "evaluate" not in command.commands:
                    break
                rest.insert(0, "evaluate")
            command = command.get_command(context, rest.pop(0))
        command.make_context(command.name, rest, click.Context(group, info_name="armsight")).close()
        came.append(" ".join(arguments))
        return next((code for part, code in codes.items() if came[-1].startswith(part)), 0)

    monkeypatch.setattr(walk, "run", parsed)
    return came, codes


@pytest.fixture
def person(monkeypatch):
    """Who presses Enter, unless asked for something that is in here."""
    answers = {}
    monkeypatch.setattr(
        walk, "_asked", lambda question: next((a for part, a in answers.items() if part in question), "")
    )
    monkeypatch.setattr(finding, "check_arm", lambda board: None)
    return answers


@pytest.mark.parametrize("arm", PAGES)
def test_the_page_of_an_arm_has_these_commands(arm):
    text = (DOCS / f"{PAGES[arm]}.md").read_text(encoding="utf-8")
    text = text.partition("$ pip install")[2] or text  # before it some pages try it without an arm
    on_page = re.findall(r"^\$ armsight (.*?)(?: +#.*)?$", text, re.MULTILINE)
    table = [step.command for step in ARMS[arm]]
    starts = [k for k in range(len(on_page)) if on_page[k : k + len(table)] == table]
    assert starts, (table, on_page)
    assert arm == "six_r" or len(on_page) == len(table)
    assert len(table) <= 10


def test_every_arm_has_steps_that_the_command_line_takes(armsight, typed, person):
    came, _ = typed
    for arm, steps in ARMS.items():
        (walk.FILE).unlink(missing_ok=True)
        came.clear()
        found = armsight("setup", arm, "--source", "usb:3,1", "--board", "/dev/ttyUSB9", "--json").one
        assert len(found["steps"]) == len(steps)
        assert [row["command"] for row in found["steps"] if row["state"] == "done"] == [f"armsight {c}" for c in came]
        assert not [c for c in came if "usb:0,1" in c or "ttyACM0" in c]


def test_a_file_that_is_not_there_is_left_out_of_all_commands(armsight, typed, person, folder):
    came, _ = typed
    armsight("setup", "so101", "--source", "usb:3,1", "--board", "/dev/ttyUSB9")
    assert not [c for c in came if "my_arm.json" in c]
    armsight("setup", "so101", "--from", "3")
    assert len(came) == 12
    (folder / "other").mkdir()
    (folder / "other/mine.yaml").write_text("x")
    walk.FILE.unlink()
    came.clear()
    person["your file"] = "other/mine.yaml"
    armsight("setup", "ur5e", "--source", "usb:3,1")
    assert came[2] == "arm calibrated ur5e other/mine.yaml -o my_ur5e.urdf"
    assert "--arm my_ur5e.urdf" in came[5]
    walk.FILE.unlink()
    came.clear()
    person["your file"] = ""
    said = armsight("setup", "ur5e", "--source", "usb:3,1")
    assert "left out: there is no my_ur5e_calibration.yaml" in said.err
    assert "--arm ur5e " in came[4]


def test_it_goes_on_where_it_was(armsight, typed, person):
    came, codes = typed
    codes["run"] = 130
    said = armsight("setup", "six_r", "--source", "usb:3,1", "--board", "/dev/ttyUSB9", "--json")
    assert said.code == 130
    assert [row["state"] for row in said.lines[0]["steps"]] == ["done"] * 3 + ["failed"]
    codes.clear()
    came.clear()
    said = armsight("setup", "six_r", "--json").done()  # cameras and port are remembered
    assert [c.split()[0] for c in came] == ["run", "check", "identify", "board"]
    assert "--source usb:3,1 --board serial:/dev/ttyUSB9" in came[0]
    came.clear()
    said = armsight("setup", "six_r", "--from", "6")
    assert [c.split()[0] for c in came] == ["identify", "board"]


def test_a_poor_calibration_is_done_anew(armsight, typed, person):
    came, codes = typed
    codes["calibrate"] = 3
    said = armsight("setup", "so101", "--source", "usb:3,1", "--board", "/dev/ttyUSB9")
    assert said.code == 3
    assert "must not be used, as said above; armsight setup so101 does it anew" in said.err
    came.clear()
    codes.clear()
    assert armsight("setup", "so101").code == 0
    assert came[0].startswith("calibrate ")


def test_a_recording_that_ctrl_c_ends_is_done_and_the_plate_is_at_hand(armsight, typed, person, folder):
    _, codes = typed
    codes["record"] = 130
    said = armsight("setup", "ur5e", "--source", "usb:3,1", "--json").done()
    assert [row["state"] for row in said.lines[0]["steps"]].count("failed") == 0
    assert not (folder / "examples").exists()  # nothing of these steps needs the plate
    walk.FILE.unlink()
    assert "written: examples/arm_plate.toml" in armsight("setup", "so101", "--source", "usb:3,1", "--board", "x").err
    assert (folder / PLATE).read_bytes() == (DOCS.parents[1] / PLATE).read_bytes()


def test_a_check_that_says_no_holds_nothing_up(armsight, typed, person):
    came, codes = typed
    codes["check"] = 2
    said = armsight("setup", "six_r", "--source", "usb:3,1", "--board", "/dev/ttyUSB9", "--json").done()
    assert [row["state"] for row in said.lines[0]["steps"]] == ["done"] * 4 + ["failed", "done", "done"]
    came.clear()
    codes["check"] = 130  # Ctrl-C does
    assert armsight("setup", "six_r").code == 130
    assert [c.split()[0] for c in came] == ["check"]


def test_q_ends_and_s_leaves_out(armsight, typed, person):
    came, _ = typed
    person["Enter runs it"] = "s"
    said = armsight("setup", "franka", "--source", "usb:3,1", "--json")
    assert {row["state"] for row in said.lines[0]["steps"]} == {"left out"}
    assert not came
    person["Enter runs it"] = "q"
    said = armsight("setup", "franka", "--from", "2", "--json")
    assert [row["state"] for row in said.lines[0]["steps"]] == ["left out", "open"]


@pytest.mark.parametrize("arm", ["so101", "ar4", "six_r"])
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo-terminals")
def test_on_the_simulated_arm_nobody_is_asked(armsight, typed, arm, monkeypatch):
    came, _ = typed
    monkeypatch.setattr(walk, "_asked", None)
    armsight("setup", arm, "--source", "sim:", "--board", "emulated:", "--json").done()
    assert len(came) == len(ARMS[arm]) - (arm == "ar4")  # the driver's file is not there
    assert "--source sim: --board emulated:" in next(c for c in came if c.startswith("run"))
    assert json.loads(walk.FILE.read_text())["words"] == {}


def test_the_simulated_arm_is_calibrated_and_corrected(armsight, typed, monkeypatch, quick_demo):
    """What takes minutes is typed, and its result another run's; all else is carried out."""
    came, _ = typed
    parsed = walk.run

    def carried_out(arguments):
        if arguments[0] == "run":
            Path("run").symlink_to(quick_demo / "demo")
        long = arguments[0] in ("run", "check") or arguments[1] == "bringup"
        return parsed(arguments) if long else run(arguments)

    monkeypatch.setattr(walk, "run", carried_out)
    monkeypatch.setattr("armsight.app.calibrate.run._SIM_SHOTS", 8)
    said = armsight("setup", "six_r", "--source", "sim:640x360@60", "--board", "emulated:", "--json").done()
    assert {row["state"] for row in said.lines[0]["steps"]} == {"done"}
    assert Path("print.pdf").exists()
    assert json.loads(Path("rig.json").read_text())["provenance"]["pairs_used"] == 8
    assert Path("corrected/corrected.toml").exists()
    assert Path("old_offsets.json").exists()
    assert len(came) == 3


def test_mistakes_are_one_line(armsight, folder):
    assert_rejected(armsight("setup", "kuka"), "no arm with a page; there are so101")
    assert_rejected(armsight("setup", "so101", "--source", "sim:"), "go together")
    assert_rejected(armsight("setup", "ur5e", "--source", "sim:", "--board", "emulated:"), "is not simulated")
    assert_rejected(armsight("setup", "so101", "--from", "8"), "so101 has 7 steps")
    walk.FILE.write_text('{"arm": "ar4", "words": {}, "done": {}}')
    assert_rejected(armsight("setup", "so101"), "this folder is of ar4")
    walk.FILE.write_text('{"arm": 1}')
    assert_rejected(armsight("setup", "so101"), "not written by `armsight setup`")


def test_the_port_is_the_one_that_goes_and_comes(monkeypatch):
    monkeypatch.setattr(finding, "_LOOK_S", 0.0)
    states, said = iter([["a", "b"], ["a", "b"], ["a"], ["a"], ["a", "c"]]), []
    assert find_port(said.append, lambda: next(states)) == "c"
    assert said == ["Unplug the arm's USB cable.", "Plug the arm's USB cable in again."]
    states = iter([[], [], ["x", "y"], ["x", "y"], ["y"], ["y", "z"]])
    assert find_port(said.append, lambda: next(states)) == "z"
    assert "x, y came together: unplug the arm's cable alone." in said


def test_the_cameras_are_those_that_are_covered():
    covered, said = [], []
    order = iter([[], ["/dev/video2", "/dev/video4"], ["/dev/video4"], ["/dev/video4"], ["/dev/video0"]])

    def cover(text):
        said.append(text)
        covered[:] = next(order)

    next(order)
    devices = [VideoDevice(f"/dev/video{k}", "cam", ()) for k in (0, 2, 4)]
    source = find_left_and_right(cover, lambda: devices, lambda d: 20.0 if d in covered else 100.0)
    assert source == "usb:4,0"
    assert [text.startswith("Cover") for text in said] == [True, False, True, False]


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo-terminals")
def test_the_wrong_arm_is_named():
    with (
        serve(Ar4Teensy(), ar4.BAUD) as port,
        pytest.raises(Exception, match="an AR4 answers, not a servo bus: armsight setup ar4"),
    ):
        check_arm(f"feetech:{port.name}")


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo-terminals")
def test_the_arm_is_found_alone_by_a_moved_joint_or_by_its_cable():
    said, bus, teensy = [], So101Bus.made(), Ar4Teensy()
    with serve(bus, feetech_bus.BAUD) as servos, serve(teensy, ar4.BAUD) as other:
        both = [servos.name, other.name]
        assert find_board(said.append, lambda: [servos.name]) == f"feetech:{servos.name}"

        def pushed(text):
            said.append(text)
            if "move a joint" in text:
                threading.Timer(0.5, lambda: bus.servos.push(2, 0.3)).start()

        assert find_board(pushed, lambda: both) == f"feetech:{servos.name}"
        looks = iter(
            [both, both, *[both[:1]] * 3]
        )  # the second arm is unplugged while they are watched, and comes back
        assert find_board(said.append, lambda: next(looks, both)) == f"ar4:{other.name}"
        assert said[-1] == "Plug the arm's USB cable in again."
        looks = iter([[], [], []])
        assert find_board(said.append, lambda: next(looks, [other.name])) == f"ar4:{other.name}"
    assert "2 arms answer: move a joint of yours by hand, or unplug it." in said
    assert said[-1] == "Plug in the arm's USB cable."
    with pytest.raises(InputError, match="/dev/x: an AR4 answers, and six_r is chosen: choose ar4"):
        check_model("ar4:/dev/x", "six_r")
    check_model("ar4:/dev/x", "my_ar4.urdf")


def test_a_simulated_walk_is_no_beginning_of_a_real_one(armsight, typed, person):
    assert armsight("setup", "six_r", "--source", "sim:", "--board", "emulated:").code == 0
    assert_rejected(armsight("setup", "six_r"), "this folder is of a simulated arm: take another folder")


def test_a_kind_before_the_port_and_a_space_in_a_name_are_understood(armsight, typed, person):
    came, _ = typed
    assert armsight("setup", "six_r", "--source", "usb:a b,c", "--board", "serial:/dev/ttyUSB9").code == 0
    ran = next(each for each in came if each.startswith("run "))
    assert "--source usb:a b,c --board serial:/dev/ttyUSB9 " in ran


def test_a_run_that_did_not_end_is_set_aside(armsight, typed, person, folder):
    typed[1]["run"] = 2
    armsight("setup", "six_r", "--source", "usb:3,1", "--board", "/dev/ttyUSB9")
    (folder / "run").mkdir()
    (folder / "run" / "summary.json").write_text("{}")
    (folder / "run-1").mkdir()
    said = armsight("setup", "six_r")
    assert "renamed: run of an earlier try is run-2" in said.err + said.out
    assert (folder / "run-2" / "summary.json").exists()
    assert not (folder / "run").exists()
