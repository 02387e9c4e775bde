"""A run's folder when the disk is full, the keyboard interrupts, or a figure is not known."""

import csv
import json
import os
import signal
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from armsight.app.demo import demo
from armsight.app.run import folder as run_folder
from armsight.app.run.experiment import RunResult
from armsight.app.run.folder import finish, make_room, open_folder, run_in, write_shots
from armsight.app.run.report import report_of
from armsight.app.stream.streams import Streams
from armsight.data import Body, JointStates, Missed, Shot
from armsight.errors import ArmsightError, DeviceError, InputError
from armsight.loop.health import HealthFinding
from armsight.robot.arm_file import open_arm
from armsight.sim.example_rig import example_rig
from cli_runs import assert_rejected

BODY = Body("plate", ("A", "B", "C"), np.eye(3))


ARM = open_arm("six_r")
SETUP = SimpleNamespace(arm=ARM, target=SimpleNamespace(body=BODY), beside=None)
PROPERTIES = {"arm": "six_r", "sigma_m": float("nan"), "values": [1.0, float("inf")], "count": 3, "said": True}


def broken_off(readings=400, **said):
    """A run that was broken off before the cameras were found."""
    result = RunResult(SETUP, None, None, PROPERTIES)
    if readings:
        t_s = 1e-3 * np.arange(readings)
        result.log.read(JointStates(t_s, np.random.default_rng(0).standard_normal((readings, 6))))
        result.log.seen("000000", 0.1, Missed("nothing is seen"))
    for name, value in said.items():
        setattr(result, name, value)
    return result


def finished(folder, *given, **said):
    return finish(broken_off(*given, **said), folder)


def test_what_is_not_known_is_null(tmp_path):
    summary = finished(tmp_path).json()
    text = (tmp_path / "summary.json").read_text()
    assert json.loads(text, parse_constant=pytest.fail) == summary
    assert summary["sigma_m"] is None
    assert summary["values"] == [1.0, None]
    assert summary["count"] == 3
    assert summary["said"] is True
    assert summary["ended_by"] is None
    own = {"version", "notes", "weak", "health", "fixed_unseen", "rig_corrections", "rig_not_corrected", "wall_s"}
    assert set(summary) == own | {"ended_by"} | set(PROPERTIES)


def test_nothing_measured_at_all_is_a_folder_all_the_same(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        finished(tmp_path, 0, interrupted=True)
    assert json.loads((tmp_path / "summary.json").read_text())["ended_by"] == "interrupted"


def test_a_full_disk_is_one_line_and_keeps_what_fits(small_disk):
    disk, gone = small_disk("96k"), DeviceError("left camera: gone")
    with pytest.raises(InputError) as caught:
        finished(disk, 4000, ended_by=gone)
    said = str(caught.value)
    assert "\n" not in said
    assert said.startswith("left camera: gone; the arm was stopped, and not all could be written: ")
    assert f"{disk / 'joints.csv'}: cannot be written: No space left on device" in said
    assert said.endswith(f"what was written before is in {disk}")
    assert json.loads((disk / "summary.json").read_text())["ended_by"] == "left camera: gone"
    assert list(csv.reader((disk / "poses.csv").read_text().splitlines()))
    assert {path.name for path in disk.iterdir()} == {"summary.json", "poses.csv"}


FOUND = HealthFinding("rig", "a camera is rotated", 1.5, 0.05, 0.001, "deg", "calibrate again")


def test_what_must_not_be_trusted_is_in_the_summary_and_in_the_error(tmp_path):
    gone = DeviceError("left camera: gone")
    with pytest.raises(
        ArmsightError, match=r"gone; .*; do not trust this result: rig: a camera is rotated since 1\.5 s;"
    ):
        finished(tmp_path, ended_by=gone, health=(FOUND,))
    (found,) = json.loads((tmp_path / "summary.json").read_text())["health"]
    assert found == json.loads(json.dumps(FOUND.to_json()))


@pytest.mark.parametrize("found", [(), (FOUND,)])
def test_the_exit_code_says_whether_the_result_can_be_trusted(tmp_path, monkeypatch, armsight, found):
    report = replace(report_of(broken_off(health=found), None), values={"wall_s": 1.0})
    monkeypatch.setattr(demo, "run_demo", lambda given, progress: report)
    said = armsight("demo", "--quick", "-o", tmp_path / "demo")
    assert said.code == (3 if found else 0)
    assert ("do not trust this result: rig: a camera is rotated" in said.err) is bool(found)
    again = armsight("demo", "--json", "-o", tmp_path / "demo")
    assert [each["health"] for each in again.lines] == [json.loads(json.dumps([each.to_json() for each in found]))]


def test_the_report_begins_with_what_must_not_be_trusted():
    page = report_of(broken_off(health=(FOUND,)), None).page({})
    assert 0 < page.index("Do not trust this result") < page.index("a camera is rotated")


def shots(count):
    rng = np.random.default_rng(1)
    return [Shot(f"{n:06d}", *(rng.integers(0, 255, (2, 60, 80), np.uint8)), 0.1 * n) for n in range(count)]


def test_shots_are_a_recording_or_are_not_there(small_disk, tmp_path):
    disk = small_disk("96k")
    write_shots(tmp_path / "shots", shots(3))
    assert len((tmp_path / "shots" / "shots.csv").read_text().splitlines()) == 4
    with pytest.raises(InputError, match=rf"{disk}/shots/\S+\.png: cannot be written: No space left"):
        write_shots(disk / "shots", shots(30))
    assert list(disk.iterdir()) == []
    write_shots(tmp_path / "none", [])
    assert not (tmp_path / "none").exists()


def test_an_interrupt_while_shots_are_written_leaves_none_by_half(tmp_path, monkeypatch):
    def interrupted(source, folder):
        folder.mkdir()
        (folder / "left000000.png").write_bytes(b"half")
        return SimpleNamespace(directory=folder, interrupted=True, stopped="interrupted")

    monkeypatch.setattr(run_folder, "record", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_shots(tmp_path / "shots", shots(1))
    assert list(tmp_path.iterdir()) == []


def test_an_interrupt_while_writing_waits_until_what_was_measured_is_there(tmp_path, monkeypatch):
    write = run_folder.write_columns

    def interrupted(*arguments):
        os.kill(os.getpid(), signal.SIGINT)
        write(*arguments)

    monkeypatch.setattr(run_folder, "write_columns", interrupted)
    with pytest.raises(KeyboardInterrupt):
        finished(tmp_path)
    assert {"joints.csv", "poses.csv", "summary.json"} == {path.name for path in tmp_path.iterdir()}


def test_the_message_about_what_ended_a_run_names_the_folder(tmp_path):
    with pytest.raises(ArmsightError) as caught:
        finished(tmp_path, ended_by=DeviceError("the board is gone"))
    assert str(caught.value) == f"the board is gone; the arm was stopped; what was measured until then is in {tmp_path}"


def test_an_earlier_runs_files_make_room_and_a_strangers_stay(tmp_path):
    of_a_run = ("report.html", "vision.csv", "vision.parquet", "reference.csv", "workcell.png", "summary.json")
    of_version_1 = ("wanted.csv", "wanted.parquet", "cell.png")
    for name in (*of_a_run, *of_version_1, "mine.txt", "rig.json"):
        (tmp_path / name).write_text("x")
    (tmp_path / "shots").mkdir()
    (tmp_path / "shots" / "shots.csv").write_text("x")
    make_room(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"mine.txt", "rig.json"}


def test_a_run_of_a_real_arm_is_never_written_over_and_a_simulated_one_is(tmp_path):
    (tmp_path / "summary.json").write_text("{}")
    with open_folder(tmp_path):  # angles were logged beside a recording: nothing moved
        (tmp_path / "motion.toml").write_text("")
    with pytest.raises(
        InputError, match="holds an earlier run of an arm; move it away, or name another folder with -o"
    ):
        open_folder(tmp_path).__enter__()
    (tmp_path / "truth.csv").write_text("t_s")
    with open_folder(tmp_path):
        pass


def test_what_a_killed_demo_left_is_written_over_and_what_a_run_measured_is_not(tmp_path):
    (tmp_path / "run.mcap").write_bytes(b"measured")
    with pytest.raises(InputError, match=r"holds run\.mcap"):
        open_folder(tmp_path, simulated=True).__enter__()  # a stranger's
    (tmp_path / "in_use.lock").write_text("run")  # a process that is killed leaves it
    with pytest.raises(InputError, match=r"holds run\.mcap"):
        open_folder(tmp_path).__enter__()
    with open_folder(tmp_path, simulated=True):
        pass


def test_two_runs_into_one_folder_at_the_same_time_are_rejected(tmp_path, armsight):
    with open_folder(tmp_path / "here"):
        said = armsight("demo", "--quick", "-o", tmp_path / "here")
    assert_rejected(said, f"{tmp_path / 'here'}: another run uses it: give this one another folder, -o FOLDER")
    assert not (tmp_path / "here").exists()


def test_what_cannot_make_room_is_named(tmp_path):
    (tmp_path / "run.log").mkdir()  # a folder instead of a file
    (tmp_path / "summary.json").write_text("{}")
    with pytest.raises(InputError, match=r"run\.log: an earlier run's file cannot be removed"):
        make_room(tmp_path)
    assert (tmp_path / "summary.json").exists()


def test_a_hold_after_the_motions_does_not_keep_the_report_from_being_written(tmp_path, monkeypatch):
    opened, sent = [], []
    monkeypatch.setattr(run_folder.os, "kill", lambda *what: sent.append(what))
    monkeypatch.setattr(
        run_folder, "open_streams", lambda specs, about, say: (opened.append(about), Streams({}, say))[1]
    )
    monkeypatch.setattr(run_folder, "run_experiment", lambda *_, **__: (opened[0].hold("smoke"), broken_off())[1])
    board = SimpleNamespace(welcome=SimpleNamespace(board="f4"))
    setup = SimpleNamespace(**vars(SETUP) | {"board": board})
    files = {"body.toml": 'name = "plate"'}
    run_in(tmp_path / "run", setup, example_rig(), None, None, files, command="run", say=pytest.fail)
    assert sent == [(os.getpid(), signal.SIGINT)]
    with pytest.raises(InputError, match="nothing moves any more"):
        opened[0].hold("smoke")
    assert len(sent) == 1


def test_what_was_lost_of_a_reference_is_said():
    beside = SimpleNamespace(
        entry=SimpleNamespace(reference=SimpleNamespace(name="imu")), losses=("it was lost: gone",)
    )
    result = broken_off()
    result.setup = SimpleNamespace(**vars(SETUP) | {"beside": beside})
    assert [note.text for note in report_of(result, None, ()).notes] == ["imu: it was lost: gone"]
