"""The guided hand-eye calibration: each pose it chooses lowers the error, and it says when to stop."""

import json
import os
import shutil
import time
from dataclasses import replace

import numpy as np
import pytest

from armsight.app.live import handeye
from armsight.app.live.calibration import CalibrationStep
from armsight.app.live.handeye import LEAST_POSES, MOST_POSES, HandEyeGuide
from armsight.app.live.records import command_of
from armsight.app.live.session import LiveSession
from armsight.app.live.step import SessionOptions, Shared
from armsight.errors import InputError
from armsight.geometry.pose import exp_se3, inverse, pose
from armsight.loop.identify.read import read_poses
from armsight.loop.running.calibrate import VisitedPose, handeye_poses
from armsight.robot.models import MODELS
from armsight.sim.example_rig import example_rig
from armsight.sim.workcell.cameras import rig_pose
from armsight.vision.calibrate.guide import CalibrationAim

ARM = MODELS["six_r"]
NOISE = np.repeat((5e-4, 1e-3), 3)


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    """A guide that was led to its end with a noisy arm, what it took, and the truth."""
    quick = pytest.MonkeyPatch()
    quick.setattr(handeye, "LITTLE", 0.05)
    rng = np.random.default_rng(7)
    rig, T_tool_body = example_rig((1280, 720), 900.0), pose(np.diag([-1.0, 1.0, -1.0]), np.array([0.0, 0.0, 0.03]))
    T_base_rig = rig_pose(ARM, rig, T_tool_body, 7)
    folder = tmp_path_factory.mktemp("live")
    guide = HandEyeGuide(Shared(SessionOptions(folder), folder, lambda level, text: pytest.fail(text)), ARM, "six_r")
    guide.begin(handeye_poses(ARM, ARM.home[None], 3, 1), (ARM.q_min, ARM.q_max), rig)
    while (q := guide.next_q) is not None:
        seen = inverse(T_base_rig) @ ARM.forward(q) @ exp_se3(NOISE * rng.standard_normal(6)) @ T_tool_body
        guide.add(VisitedPose(q, seen, np.diag(np.repeat((1e-9, 1e-9), 3)), np.zeros(6)))
        guide.fit()
    yield guide, T_base_rig
    guide.close()
    quick.undo()


def test_it_ends_by_itself_with_the_error_it_predicts(calibrated):
    guide, T_base_rig = calibrated
    state = guide.state
    assert state.good
    assert LEAST_POSES <= state.poses <= MOST_POSES
    # The last fit allows for what the arm may be off by in all poses alike, too; those on the way do not.
    assert state.progress[-1].predicted_mm < state.progress[0].predicted_mm
    p = guide.run.Ts_left_body[:, :3, 3]
    off = inverse(T_base_rig) @ guide.run.mounting.T_base_rig
    error_mm = 1e3 * np.sqrt(((p @ off[:3, :3].T + off[:3, 3] - p) ** 2).sum(axis=1).mean())
    assert error_mm < 3.0 * state.progress[-1].predicted_mm
    assert 0.5 < state.progress[-1].heldout_mm < 2.5  # 0.87 mm of the flange, and its rotation over the distance


def test_poses_are_written_as_the_commands_read_them(calibrated):
    guide, _ = calibrated
    assert len(read_poses(guide.poses_file).measured) == guide.state.poses
    assert (guide.folder / "joints.csv").read_text().startswith("q1_rad,")


def test_the_same_pose_again_is_rejected(calibrated):
    guide, _ = calibrated
    again = guide.run
    with pytest.raises(InputError, match="like this one was taken"):
        guide.add(VisitedPose(again.q[3], again.Ts_left_body[3], again.covs[3], np.zeros(6)))


def test_a_session_that_is_started_again_has_its_rig_and_its_poses(calibrated, tmp_path):
    guide, _ = calibrated
    shutil.copytree(guide.folder, tmp_path / "handeye")
    example_rig((1280, 720), 900.0).save(tmp_path / "rig.json")
    os.utime(tmp_path / "rig.json", (1.0, 1.0))
    session = LiveSession(SessionOptions(tmp_path, "usb:0,1"))
    try:
        again = session.arm.handeye
        again.fit()
        assert session.measuring.rig_path == tmp_path / "rig.json"
        assert again.state.poses == guide.state.poses
        np.testing.assert_allclose(again.run.mounting.T_base_rig, guide.run.mounting.T_base_rig, atol=1e-6)
        assert [event.text.split(" stored in")[0] for event in session.events()] == [
            "the rig",
            f"the {guide.state.poses} poses of the hand-eye calibration",
        ]
    finally:
        session.close()


@pytest.mark.parametrize("newer", ["rig", "other arm"])
def test_poses_seen_by_another_rig_or_arm_are_not_used(calibrated, tmp_path, newer):
    guide, _ = calibrated
    shutil.copytree(guide.folder, tmp_path / "handeye")
    (tmp_path / "rig.json").write_text("")
    if newer != "rig":
        os.utime(tmp_path / "rig.json", (1.0, 1.0))
    said = []
    shared = Shared(SessionOptions(tmp_path), tmp_path, lambda level, text: said.append(text))
    other = HandEyeGuide(shared, ARM if newer == "rig" else MODELS["so101"], "")
    other.recall(tmp_path / "rig.json")
    assert other.state.poses == 0
    assert len(said) == (newer != "rig")
    other.close()


def test_the_rig_of_an_earlier_session_is_offered_and_can_be_put_aside(tmp_path):
    stored = tmp_path / "rig.json"
    replace(example_rig(), provenance={"heldout_rigid_rms_m": 2.4e-5}).save(stored)
    os.utime(stored, ((now := time.time()), now - 24 * 3600))
    when = time.strftime("%H:%M", time.localtime(now - 24 * 3600))

    def offered(command):
        session = LiveSession(SessionOptions(tmp_path, "usb:0,1"))
        try:
            before = session.sections()["overview"]
            session.execute(command_of(json.dumps({"command": command})))
            return before.offer, session.sections()["overview"], session.measuring.rig
        finally:
            session.close()

    offer, after, rig = offered("KeepRig")
    assert offer == f"rig of yesterday {when}, 0.024 mm"
    assert (after.offer, after.step) == ("", "measure")
    assert rig is not None
    offer, after, rig = offered("BeginAnew")
    assert offer
    assert (after.offer, after.step, rig) == ("", "cameras", None)
    assert not stored.exists()
    assert len(list(tmp_path.glob("rig-*.json"))) == 1
    assert "is kept as" in (tmp_path / "session.log").read_text().splitlines()[-1]


def test_a_calibration_that_is_good_enough_ends_once_by_itself(tmp_path, monkeypatch):
    said, finished = [], []
    shared = Shared(SessionOptions(tmp_path), tmp_path, lambda level, text: said.append(text))
    step = CalibrationStep(shared, "chessboard:9x6:25mm", CalibrationAim(2e-4, 0.8), lambda rig, path: None)
    monkeypatch.setattr(step, "finish_calibration", lambda: (finished.append(1), step.show(running=False)))
    good = False
    monkeypatch.setattr(step, "fit", lambda: step.show(good=good, goal_mm=0.2))
    try:
        step.start()
        step._fit()
        assert step.shown.running
        good = True
        step._fit()
        assert (len(finished), said) == (1, ["good enough for 0.2 mm: finished; Go on takes more shots"])
        assert (step.state.ended, step.state.instruction) == (True, "Good enough. Finish, or go on?")
        step.start()  # a person goes on
        step._fit()
        assert step.shown.running
        step.set_aim(0.1, 0.8)
        step._fit()
        assert len(finished) == 2
    finally:
        step.close()


def test_settings_are_kept_by_name_and_a_newer_folder_is_rejected(tmp_path):
    options = SessionOptions(tmp_path, "usb:0,1", calibration_board="chessboard:8x5:24mm")
    session = LiveSession(options)
    try:
        session.arm.use_arm("ar4")
        session.calibration.set_aim(0.3, 0.5)
        session.keep_settings(" table ")
        with pytest.raises(InputError, match="a name of 1 to 60 characters"):
            session.keep_settings(" ")
    finally:
        session.close()
    session = LiveSession(replace(options, source="usb:2,3", calibration_board=None))
    try:
        assert session.sections()["overview"].settings == ("table",)
        with pytest.raises(InputError, match="no settings 'x'; there are table"):
            session.use_settings("x")
        session.use_settings("table")
        assert (session.shared.source, session.calibration.spec) == ("usb:0,1", "chessboard:8x5:24mm")
        assert (session.shared.options.arm, session.calibration.aim) == ("ar4", CalibrationAim(3e-4, 0.5))
    finally:
        session.close()
    file = tmp_path / "session.json"
    file.write_text(file.read_text().replace('"version": 1', '"version": 2'))
    with pytest.raises(InputError, match="session version 2, this armsight reads up to 1: update armsight"):
        LiveSession(options)
    file.write_text("[]")
    with pytest.raises(InputError, match="not written by `armsight live`"):
        LiveSession(options)


@pytest.mark.parametrize(
    ("kept", "words"),
    [
        ("1", "settings 'a': expected an object, got 1"),
        ("[[1]]", "expected an object"),
        ('{"cameras": 1}', "cameras must be a text, got 1"),
        ('{"distance_m": "0.8"}', "distance_m must be a number, got '0.8'"),
        ('{"error_mm": true}', "error_mm must be a number, got True"),
        ('{"arm": ["six_r"]}', "arm must be a text"),
    ],
)
def test_kept_settings_of_other_kinds_are_one_line(tmp_path, kept, words):
    (tmp_path / "session.json").write_text(f'{{"version": 1, "settings": {{"a": {kept}}}}}')
    with pytest.raises(InputError, match=words):
        LiveSession(SessionOptions(tmp_path, "usb:0,1"))


def test_settings_kept_without_a_port_leave_the_board_that_is_named(tmp_path):
    (tmp_path / "session.json").write_text('{"version": 1, "settings": {"a": {"arm_board": null, "error_mm": null}}}')
    session = LiveSession(SessionOptions(tmp_path, "usb:0,1", board="serial:/dev/ttyUSB7"))
    try:
        session.use_settings("a")
        assert session.shared.options.board == "serial:/dev/ttyUSB7"
    finally:
        session.close()


def test_a_name_that_is_no_unicode_is_kept_and_said(tmp_path):
    session = LiveSession(SessionOptions(tmp_path, "usb:0,1"))
    try:
        session.keep_settings("a\ud800")
        assert "settings kept: a\\ud800" in (tmp_path / "session.log").read_text()
    finally:
        session.close()
