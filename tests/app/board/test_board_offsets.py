"""``armsight board offsets``: asked first, old values kept, and a joint that then reports where it really is."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest

from armsight.app.board.offsets import further_of, pot_changes
from armsight.errors import DeviceError, InputError
from armsight.loop.identify.corrected import Corrected, table_text
from armsight.loop.identify.model import Model
from armsight.robot.arm_file import open_arm
from armsight.robot.boards.configuration import lab_configuration
from armsight.robot.boards.feetech import bus as feetech
from armsight.robot.boards.feetech.bus import ServoBus
from armsight.robot.boards.feetech.calibration import NAMES, read_calibration, uncalibrated, write_offsets
from armsight.robot.boards.feetech.offsets import OffsetChange, corrected_offsets, doubts, write_changes
from armsight.robot.boards.feetech.registers import RAD_PER_COUNT
from armsight.sim.boards.device import SteppedLink, serve
from armsight.sim.boards.so101 import So101Bus, So101Mechanics
from cli_runs import assert_rejected

ZERO_DEG = (1.5, -0.8, 0.0, 2.2, -0.3, 0.0)
pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo-terminals")


def made(**options):
    mechanics = So101Mechanics(zero_rad=tuple(np.radians(ZERO_DEG)))
    return So101Bus.made(mechanics, load=lambda q: np.zeros(6), **options)


@pytest.fixture
def arm():
    """An SO-101 whose zeros are off, at a port, and the port's name as a board."""
    device = made()
    with serve(device, feetech.BAUD) as port:
        yield device, f"feetech:{port.name}"


def registers(device):
    words = [int.from_bytes(table[31:33], "little") for table in device.tables]
    return [-(word & 0x7FF) if word & 0x800 else word for word in words]


def lerobot(path):
    entries = {
        name: {"id": k + 1, "drive_mode": 0, "homing_offset": 0, "range_min": 700, "range_max": 3396}
        for k, name in enumerate((*NAMES, "gripper"))
    }
    path.write_text(json.dumps(entries))
    return path


FURTHER = ",".join(map(str, ZERO_DEG[:5]))


def test_offsets_are_printed_and_nothing_is_written(armsight, arm, tmp_path):
    device, name = arm
    found = armsight("board", "offsets", "--board", name, "--json").one
    assert not found["written"]
    assert [each["id"] for each in found["joints"]] == [1, 2, 3, 4, 5]
    assert registers(device) == [0] * 6


def test_a_correction_makes_joints_report_where_they_are_and_is_taken_back(armsight, arm, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    device, name = arm
    file, keep = lerobot(tmp_path / "follower.json"), tmp_path / "old.json"
    options = ("--board", f"{name},{file}", "--yes", "--json")
    said = armsight("board", "offsets", *options, "--further", FURTHER, "--keep", keep).done()
    assert "the old offsets are in" in said.err
    counts = [-round(np.radians(each) / RAD_PER_COUNT) for each in ZERO_DEG]
    assert registers(device) == counts
    assert [each["homing_offset"] for each in json.loads(file.read_text()).values()] == [*counts[:5], 0]
    assert json.loads(keep.read_text())["homing_offsets"] == {str(k): 0 for k in range(1, 6)}
    assert all(table[55] == 1 for table in device.tables)  # locked again
    said = armsight("board", "monitor", "--board", f"{name},{file}", "--seconds", 0.05, "--json")
    assert said.lines[-1]["q_rad"] == pytest.approx(device.servos.true_q[:5], abs=1.1 * RAD_PER_COUNT)
    for name in ("old_offsets.json", "old_offsets-2.json"):  # without --keep nothing is in the way
        said = armsight("board", "offsets", *options, "--restore", keep).done()
        assert (tmp_path / name).exists()
    assert registers(device) == [0] * 6


def test_it_asks_first(armsight, arm, tmp_path, monkeypatch):
    device, name = arm
    monkeypatch.setattr("click.confirm", lambda text, abort, err: (_ for _ in ()).throw(KeyboardInterrupt))
    said = armsight("board", "offsets", "--board", name, "--further", FURTHER, "--keep", tmp_path / "old.json")
    assert said.code == 130
    assert "shoulder_pan" in said.err
    assert registers(device) == [0] * 6
    assert not (tmp_path / "old.json").exists()


def test_mistakes_are_one_line_and_nothing_is_written(armsight, arm, tmp_path, monkeypatch):
    device, name = arm
    options, keep = ("--board", name, "--yes"), tmp_path / "old.json"
    assert_rejected(armsight("board", "offsets", *options, "--further", "1,2"), "5 corrections are needed")
    assert_rejected(armsight("board", "offsets", *options, "--further", "a"), "numbers of degrees")
    assert_rejected(
        armsight("board", "offsets", *options, "--further", "185,0,0,0,0", "--keep", keep),
        "shoulder_pan (id 1): its offset would be -2105; the register holds -2047 to 2047",
    )
    assert_rejected(armsight("board", "offsets", *options, "--identified", "six_r"), "give one of --identified")
    assert_rejected(armsight("board", "offsets", "--board", "ar4:/dev/none"), "an AR4 keeps no zeros")
    keep.write_text("{}")
    assert_rejected(
        armsight("board", "offsets", *options, "--further", FURTHER, "--keep", keep), "exists; old offsets are never"
    )
    assert_rejected(armsight("board", "offsets", *options, "--restore", keep), "not a file of old offsets")
    device.servos.switch(1, True)
    device.tables[1][40] = 1
    assert_rejected(
        armsight("board", "offsets", *options, "--further", FURTHER, "--keep", tmp_path / "new.json"),
        "the torque of shoulder_lift (id 2) is on",
    )
    assert registers(device) == [0] * 6
    device.servos.switch(1, True)
    questions = []
    monkeypatch.setattr("click.confirm", lambda text, abort, err: questions.append(text))
    said = armsight("board", "offsets", "--board", name, "--further", FURTHER, "--keep", tmp_path / "new.json").done()
    assert ["the drives are on" in text for text in questions] == [True, False]
    assert registers(device) != [0] * 6
    device.servos.switch(1, True)
    said = armsight("board", "release", "--board", name)
    assert said.out == "DISABLED\n", said.err
    assert not device.servos.on.any()


def test_a_correction_that_looks_like_a_mistake_is_asked_about_and_never_written_with_yes(
    armsight, arm, tmp_path, monkeypatch
):
    device, name = arm
    options = ("--board", name, "--further", "0,179.9,0,0,0", "--keep", tmp_path / "old.json")
    tooth = "shoulder_lift (id 2): 179.9 deg is more than a tooth of the horn (14.4 deg)"
    assert_rejected(armsight("board", "offsets", *options, "--yes"), tooth)
    assert registers(device) == [0] * 6
    assert not (tmp_path / "old.json").exists()
    asked = []
    monkeypatch.setattr("click.confirm", lambda text, abort, err: asked.append(text))
    said = armsight("board", "offsets", *options).done()
    assert asked
    assert f"note: {tooth}" in said.err
    assert registers(device) == [0, -2047, 0, 0, 0, 0]
    restored = armsight(
        "board", "offsets", *options[:2], "--restore", options[-1], "--keep", tmp_path / "2.json", "--yes"
    )
    assert restored.code == 0, restored.err  # as large, but what was there before
    assert registers(device) == [0] * 6
    options[-1].write_text(json.dumps({"homing_offsets": {str(k): 3000 for k in range(1, 6)}}))
    assert_rejected(
        armsight("board", "offsets", *options[:2], "--restore", options[-1], "--yes"),
        "the offset of id 1 is 3000; the register holds -2047 to 2047",
    )


def test_an_offset_at_the_end_of_its_register_and_a_count_that_would_jump_are_said(tmp_path):
    calibration = read_calibration(lerobot(tmp_path / "follower.json"))  # counts 700 to 3396
    assert doubts([OffsetChange("elbow_flex", 3, 2040, 2040), OffsetChange("wrist_flex", 4, 0, 100)], calibration) == []
    assert doubts([OffsetChange("elbow_flex", 3, 2047, 2030)], calibration) == []  # away from the end
    (end,) = doubts([OffsetChange("elbow_flex", 3, -2000, -2030)], calibration)
    assert "its offset -2030 is at the end of what the register holds, -2047 to 2047" in end
    narrow = uncalibrated(np.full(5, 20.0), np.full(5, 3000.0))
    (jump,) = doubts([OffsetChange("elbow_flex", 3, 0, 50)], narrow)
    assert "its lower end would be at count -30; counts are 0 to 4095" in jump
    assert doubts([OffsetChange("wrist_roll", 5, 0, 50)], uncalibrated(np.zeros(5), np.full(5, 4095.0))) == []
    with pytest.raises(InputError, match="elbow_flex: homing_offset is 2048; allowed is -2047 to 2047"):
        write_offsets(tmp_path / "new.json", tmp_path / "follower.json", {3: 2048})
    assert not (tmp_path / "new.json").exists()


def test_where_one_servo_fails_the_others_get_their_old_offsets_back():
    device = made()
    link = SteppedLink(device)
    bus = ServoBus(link, "bus", now=link.now)
    calibration = uncalibrated(np.zeros(5), np.full(5, 4095.0))
    changes = corrected_offsets(bus, calibration, np.radians(ZERO_DEG[:5]))
    store = device._store

    def broken(servo, address, data):
        if not (servo == 3 and address == 31):
            store(servo, address, data)

    device._store = broken
    with pytest.raises(DeviceError, match="id 4 keeps 0 in register 31 instead of -25"):
        write_changes(bus, changes)
    assert registers(device) == [0] * 6


def test_an_identified_arm_gives_the_correction(tmp_path):
    """Its axes 2 and 3 are not quite parallel: as an arm without beta its joint 2 would be 20 degrees and more further."""
    nominal, further = open_arm("six_r"), np.radians([0.5, -0.4, 0.0, 0.2, 0.1, -1.0])
    model = Model(nominal, 1, True, (), np.eye(3), np.eye(3), np.array([0.0, 0.0, 1.0]))
    x = model.nominal()
    table = x[model.table_at : model.sources_at].reshape(6, 5)  # a view
    table[:, 0] += nominal.direction * further  # theta = direction q + offset
    table[1] += [0.0, 0.0, 0.0, 3e-4, -2e-4]
    path = tmp_path / "corrected.toml"
    path.write_text(table_text(Corrected(model, x, np.zeros(len(x)))))
    assert further_of(str(path), nominal) == pytest.approx(further)
    assert further_of("six_r", nominal) == pytest.approx(np.zeros(6))
    with pytest.raises(InputError, match="are different arms"):
        further_of(str(path), replace(nominal, direction=-nominal.direction))
    further_of(str(path), replace(nominal, name="the_urdf"))
    other = replace(nominal, name="ur10", a=nominal.a + 0.1)
    with pytest.raises(InputError, match=r"corrected\.toml is of six_r, not ur10: give --arm"):
        further_of(str(path), other)


AR4 = """# measured in May
joint_1: 170.0
joint_2: -42.0
joint_3: -89.0  # new switch
joint_4: -180.0
joint_5: -105.0
joint_6: -180.0
"""


def test_the_ar4_drivers_offsets_are_corrected_in_their_file_and_the_old_file_is_kept(armsight, tmp_path):
    file, keep = tmp_path / "mk3.yaml", tmp_path / "old.yaml"
    file.write_text(AR4)
    options = ("board", "offsets", "--board", f"ar4:{file}", "--keep", keep, "--yes")
    assert json.loads(armsight(*options[:4], "--json").out)["joints"][0] == {
        "name": "joint_1",
        "old_deg": 170.0,
        "new_deg": 170.0,
    }
    assert not keep.exists()
    armsight(*options, "--further", "1,0.5,-0.25,0,0,2").done()
    assert keep.read_text() == AR4
    assert "joint_1: 169.0\n" in file.read_text()  # its sense is the opposite of the maker's table
    assert "joint_3: -89.25  # new switch\n" in file.read_text()
    assert "joint_6: -178.0\n" in file.read_text()
    assert armsight(*options[:5], tmp_path / "again.yaml", "--yes", "--restore", keep).code == 0
    assert file.read_text() == AR4
    again = (*options[:5], tmp_path / "more.yaml", "--yes", "--further")
    assert_rejected(armsight(*again, "0,0,57.3,0,0,0"), "joint_3: 57.3 deg is more than zeros are usually off by")
    assert not (tmp_path / "more.yaml").exists()
    assert_rejected(armsight(*options, "--further", "1,2,3"), "6 corrections are needed")
    file.write_text("joint_1: 1.0\n")
    assert_rejected(armsight(*options[:4]), "no joint_offsets of ar4_ros_driver")


@pytest.mark.parametrize("direction", [1, -1])
def test_the_potentiometers_of_our_board_are_shifted_by_what_was_found(direction):
    config = lab_configuration()
    config["joint"]["pot"]["direction"] = direction
    before = config["joint"].copy()
    count = int(config["joint"][1]["pot"]["node_count"])
    further = np.radians([0.0, 1.5, 0.0, -0.5, 0.0, 0.0])
    changes = pot_changes(config, further)
    shifted = config["joint"]["pot"]["angle_rad"][1, :count] - before["pot"]["angle_rad"][1, :count]
    np.testing.assert_allclose(direction * shifted, further[1], atol=1e-6)  # the board multiplies the table by it
    assert changes[3].new_deg - changes[3].old_deg == pytest.approx(-0.5, abs=1e-5)
    for limit in ("soft_min_rad", "soft_max_rad"):  # the arm's stops stay where they are
        np.testing.assert_allclose(config["joint"][limit] - before[limit], further, atol=1e-6)
