"""``armsight run`` typed wrong, and interrupted on the workcell. The whole of it there: docs/test_tutorials.py."""

import json
import os
import signal

import numpy as np
import pytest

from armsight.app.progress import steps
from armsight.sim.workcell.workcell import Workcell
from cli_runs import assert_rejected

MOTION = """
[[motion]]
kind = "joints"
name = "there"
q_deg = [10.0, -46.6, 74.2, -14.7, -104.4, 5.0]
rest_s = 0.5
"""


@pytest.fixture(scope="module")
def files(tmp_path_factory, host_firmware):
    """Files of the workcell that ``sim:`` opens, small cameras."""
    folder = tmp_path_factory.mktemp("files")
    with Workcell.open(arm="worn", cameras="640x360@12", emulator="host") as workcell:
        workcell.truth.rig.save(folder / "rig.json")
        (folder / "body.toml").write_text(workcell.body_text)
    (folder / "motion.toml").write_text(MOTION)
    return folder


def arguments(files, output, *more, source="sim:640x360@12", board="emulated:host", rig="rig.json", target="body.toml"):
    named = ("--rig", files / rig, "--target", files / target, "--motion", files / "motion.toml")
    return ("run", "--source", source, "--board", board, *named, "-o", output, *more)


@pytest.mark.parametrize(
    ("source", "board"), [("sim:", "serial:/dev/ttyACM0"), ("usb:0,1", "emulated:"), ("usb:0,1", "emulated:host")]
)
def test_workcell_and_devices_do_not_mix(armsight, files, tmp_path, source, board):
    said = armsight(*arguments(files, tmp_path / "run", source=source, board=board))
    assert_rejected(said, f"--source {source} --board {board}", "go together")


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"rig": "none.json"}, ("none.json", "no such file")),
        ({"rig": "motion.toml"}, ("motion.toml",)),
        ({"target": "none.toml"}, ("none.toml", "no such file")),
        ({"board": "emulated:cray"}, ("cray", "emulated:host")),
        ({"source": "sim:big"}, ("big", "WIDTHxHEIGHT@HZ")),
        ({"source": "usb:0,1", "board": "serial:/dev/ttyNONE"}, ("/dev/ttyNONE", "no such port")),
        ({"source": "usb:0,1", "board": "can:0"}, ("can:0", "serial:PORT")),
        ({"source": "usb:0,1", "board": "serial:/dev/none,baud=abc"}, ("serial:/dev/none,baud=abc", "baud=N")),
        ({"source": "usb:0,1", "board": "serial:/dev/null,mk2"}, ("serial:/dev/null,mk2", "ar4:PORT")),
        ({"source": "usb:0,1", "board": "feetech:/dev/null,none.json"}, ("none.json", "no such file")),
        ({"source": "usb:0,1", "board": "ar4:/dev/null,mk9"}, ("mk9", "mk1, mk2, mk3")),
        ({"source": "recorded", "board": "serial:/dev/none"}, ("/dev/none", "no such port")),
    ],
)
def test_what_is_not_there_is_named(armsight, files, tmp_path, monkeypatch, given, said):
    def opened(spec):
        raise AssertionError("a mistake is said before cameras are opened")

    monkeypatch.setattr("armsight.app.run.devices.open_source", opened)
    assert_rejected(armsight(*arguments(files, tmp_path / "run", **given)), *said)


def test_a_rig_that_was_never_calibrated(armsight, files, tmp_path):
    rig = json.loads((files / "rig.json").read_text())
    (tmp_path / "half.json").write_text(json.dumps({key: rig[key] for key in list(rig)[:2]}))
    said = armsight(*arguments(files, tmp_path / "run", rig=tmp_path / "half.json"))
    assert_rejected(said, "half.json")


def test_a_rig_that_cannot_be_followed(armsight, files, tmp_path):
    said = armsight(*arguments(files, tmp_path / "run", "--follow-rig"))  # the true rig, without covariance
    assert_rejected(said, "--follow-rig", "rig.json has no covariance")
    assert not (tmp_path / "run").exists()


def test_another_arm_than_the_boards(armsight, files, tmp_path):
    (tmp_path / "far.toml").write_text("start_deg = [40, 0, 0, 0, -90, 0]\n" + MOTION)
    said = armsight(*arguments(files, tmp_path / "run", "--motion", tmp_path / "far.toml"))
    assert_rejected(said, "joint 1 reads", "the motion starts at 40.0", "--arm six_r")


def test_a_run_where_a_file_stands_and_one_over_a_strangers_shots(armsight, files, tmp_path):
    (tmp_path / "run").write_text("mine")
    assert_rejected(armsight(*arguments(files, tmp_path / "run")), tmp_path / "run")
    (tmp_path / "other" / "shots").mkdir(parents=True)
    assert_rejected(armsight(*arguments(files, tmp_path / "other")), "holds shots that are not of an earlier run")


@pytest.mark.parametrize("stage", ["opening the devices", "preparing to follow", "hand-eye: pose 1 "])
def test_ctrl_c_before_and_in_motion(armsight, files, tmp_path, monkeypatch, stage):
    class Interrupting:
        def __enter__(self):
            self.shown = steps()
            progress = self.shown.__enter__()

            def interrupting(line):
                progress(line)
                if line.startswith(stage):
                    os.kill(os.getpid(), signal.SIGINT)

            return interrupting

        def __exit__(self, *ended):
            return self.shown.__exit__(*ended)

    monkeypatch.setattr("armsight.app.run.command.steps", Interrupting)
    said = armsight(*arguments(files, tmp_path / "run"))
    assert said.code == 130
    assert said.err.splitlines()[-1] == "armsight: interrupted"
    assert "Traceback" not in said.err
    if stage != "opening the devices":
        assert json.loads((tmp_path / "run" / "summary.json").read_text())["ended_by"] == "interrupted"
        assert f"what was measured until then is in {tmp_path / 'run'}" in said.err
    if stage.startswith("hand-eye"):
        joints = np.loadtxt(tmp_path / "run" / "joints.csv", delimiter=",", skiprows=1)
        assert len(joints) > 300
