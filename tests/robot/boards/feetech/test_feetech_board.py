"""An emulated SO-101: what it does is what was measured of one, and what is wrong with a bus is one line."""

import json

import numpy as np
import pytest

from armsight.data import JointCommand
from armsight.errors import DeviceError, InputError
from armsight.robot.boards.codes import Alarm, BoardState, Command
from armsight.robot.boards.feetech.board import FeetechBoard
from armsight.robot.boards.feetech.bus import ServoBus
from armsight.robot.boards.feetech.calibration import NAMES, read_calibration, write_offsets
from armsight.robot.boards.feetech.registers import MIDDLE, MODE, MODEL, POSITION_MODE, RAD_PER_COUNT, STS3215, TORQUE
from armsight.sim.boards.device import SteppedLink
from armsight.sim.boards.so101 import So101Bus, So101Mechanics
from armsight.tables.columns import degree_columns
from noisy_device import NoisyDevice

REST = np.zeros(5)


def opened(device, calibration=None):
    link = SteppedLink(device)
    return FeetechBoard.connect(ServoBus(link, "feetech:PORT", now=link.now), calibration), link


def goto(board, q, wait_s):
    board.send(JointCommand(q, REST, REST, 0.005))
    return board.receive(wait_s)


def unloaded(q):
    return np.zeros(6)


@pytest.fixture
def folded():
    """A board with its torque on, and its device."""
    device = So101Bus.made()
    board, _ = opened(device)
    board.enable()
    return board, device


def test_it_says_who_it_is_and_what_it_cannot_do():
    board, _ = opened(So101Bus.made())
    assert board.abilities.joints == 5
    assert not board.abilities.takes_duty
    assert board.abilities.own_controller
    assert all(name in board.welcome.board for name in NAMES)
    assert board.status.state is BoardState.DISABLED


def test_readings_are_the_shafts_in_counts_on_the_hosts_clock(folded):
    board, device = folded
    states = board.receive(0.1)
    assert len(states.t_s) >= 15
    assert (np.diff(states.t_s) > 0).all()
    counts = states.q / RAD_PER_COUNT
    assert np.abs(counts - np.round(counts)).max() < 1e-9
    assert np.abs(states.q[-1] - device.servos.shaft[:5]).max() <= RAD_PER_COUNT
    assert board.status.supply_v == pytest.approx(12.1, abs=0.2)
    assert board.joints.temperature_c == pytest.approx(30, abs=1)


def test_the_gripper_is_left_alone(folded):
    board, device = folded
    table = bytes(device.tables[5][40:50])
    goto(board, board.receive(0.0).q[-1] + 0.05, 0.3)
    assert not device.servos.on[5]
    assert bytes(device.tables[5][40:50]) == table


def test_droop_backlash_and_dead_zone_are_those_that_were_measured():
    load = np.array([0.0, 1.04, 0.0, 0.0, 0.0, 0.0])
    device = So101Bus.made(load=lambda q: load, q=np.zeros(6))
    board, _ = opened(device)
    board.enable()
    q = goto(board, REST, 1.0).q[-1]
    assert 1.8 <= np.degrees(-q[1]) <= 2.6
    assert board.joints.duty[1] == pytest.approx(1.04 / 2.9, abs=0.03)
    reached = []
    for hand in (0.02, -0.02):  # as a hand finds it: pushed to one end of the gap and to the other
        device.servos.push(0, hand)
        reached.append(device.servos.shaft[0])
    assert np.degrees(np.ptp(reached)) == pytest.approx(1.0, abs=0.05)
    # A goal of one count away is within the dead zone.
    still = goto(board, board.receive(0.5).q[-1], 0.5).q[-1]
    assert (goto(board, still + RAD_PER_COUNT, 0.5).q[-1][4]) == still[4]


def test_a_command_shows_in_the_state_after_100_to_130_ms():
    device = So101Bus.made(load=unloaded)
    board, _ = opened(device)
    board.enable()
    begin, sent, read = board.receive(0.5).q[-1], [], []
    for k in range(400):
        ahead = np.radians(10.0) * np.sin(2 * np.pi * 0.4 * k * 0.005)
        sent.append(ahead)
        read.append(goto(board, begin + np.array([ahead, 0, 0, 0, 0]), 0.005).q[-1][0] - begin[0])
    sent, read = np.array(sent), np.array(read)
    lag = min(range(60), key=lambda d: np.std(read[100:] - sent[100 - d : 400 - d]))
    assert 0.100 <= lag * 0.005 <= 0.130


def test_torque_goes_on_where_the_arm_is_and_off_at_once(folded):
    board, device = folded
    assert device.servos.on[:5].all()
    begin = device.servos.shaft.copy()
    board.receive(0.5)
    assert np.degrees(np.abs(device.servos.shaft - begin)).max() < 3.0  # droop, and no motion to an old goal
    board.stop()
    board.receive(0.01)
    assert not device.servos.on.any()
    assert board.status.state is BoardState.DISABLED
    board.confirm(board.command(Command.ENABLE))
    assert board.status.state is BoardState.ENABLED


def test_a_goal_that_was_not_sent_is_not_reported(folded, monkeypatch):
    board, _ = folded
    q = board.receive(0.1).q[-1]
    goto(board, q, 0.1)

    def gone(*_):
        raise DeviceError("the bus is gone")

    monkeypatch.setattr(board.bus, "write_all", gone)
    with pytest.raises(DeviceError, match="the bus is gone"):
        board.send(JointCommand(q + 0.05, REST, REST, 0.005))
    assert board.joints.reference_rad == pytest.approx(q)


def test_an_alarm_is_named_with_its_joint(folded):
    board, device = folded
    answer = device._answer

    def overloaded(answers):
        at = len(device._out)
        answer(answers)
        if answers[0][0] == 2 and len(device._out) > at:
            due, text = device._out[-1]
            body = bytes((text[2], text[3], 0x20)) + text[5:-1]
            device._out[-1] = (due, b"\xff\xff" + body + bytes((~sum(body) & 0xFF,)))

    device._answer = overloaded
    board.receive(0.01)
    (fault,) = board.status.faults
    assert (fault.fault, fault.joint) == (Alarm.OVERLOAD, 2)
    assert "joint 3: overload" in str(fault)
    assert board.status.state is BoardState.FAULTED
    with pytest.raises(DeviceError, match="cannot be enabled: joint 3: overload"):
        board.enable()


@pytest.mark.parametrize(
    ("ids", "powered", "said"),
    [
        ([1, 2, 9, 4, 5, 6], True, "no servo answers as id 3 (found 1, 2, 4, 5, 6, 9)"),
        ([1, 2, 2, 4, 5, 6], True, "answers of id 2 collide and none answers as 3: two servos share an id"),
        ([1, 2, 3, 4, 5, 5], True, "answers of id 5 collide: two servos share an id"),
        ([21, 22, 23, 24, 25, 26], True, "no servo answers: is their own power supply on"),
        ([1, 2, 3, 4, 5, 6], False, "no servo answers: is their own power supply on"),
    ],
)
def test_a_bus_that_is_not_whole_is_one_line_and_no_hang(ids, powered, said):
    device = So101Bus.made(ids=ids, powered=powered)
    with pytest.raises(DeviceError) as raised:
        opened(device)
    assert said in str(raised.value)
    assert "\n" not in str(raised.value)
    assert device.t_s < 5.0


def test_another_model_and_another_mode_are_named():
    device = So101Bus.made()
    device.tables[1][3:5] = (1284).to_bytes(2, "little")
    with pytest.raises(DeviceError, match="id 2 is of model 1284; an STS3215 is 777"):
        opened(device)
    device = So101Bus.made()
    device.tables[3][33] = 1
    with pytest.raises(DeviceError, match="id 4 is in mode 1; 0 is needed, a position servo"):
        opened(device)


def test_a_servo_that_falls_silent_is_one_line(folded):
    board, device = folded
    device.ids[2] = 200
    before = device.t_s
    with pytest.raises(DeviceError, match="no servo answers as id 3"):
        board.receive(0.1)
    assert device.t_s - before < 5.0


def test_some_noise_is_asked_again_and_never_read_as_an_angle():
    device = So101Bus.made(load=unloaded)
    board, _ = opened(NoisyDevice(device, 0.002, seed=4))
    board.enable()
    states = board.receive(2.0)
    assert board.broken_messages > 0
    assert np.ptp(states.q, axis=0).max() <= 2 * RAD_PER_COUNT


def test_too_much_noise_is_one_line():
    noisy = NoisyDevice(device := So101Bus.made(), 0.4, seed=1)
    noisy.write = device.write  # questions come through
    with pytest.raises(DeviceError, match="feetech:PORT: bytes come, but no whole answer"):
        opened(noisy)


class LateDevice:
    """A device whose answers arrive late, all by as much: a busy computer, a slow adapter."""

    def __init__(self, device, late_s):
        self.device, self.late_s, self._coming = device, late_s, []

    t_s = property(lambda self: self.device.t_s)
    write = property(lambda self: self.device.write)

    def read(self):
        self._coming.append((self.t_s + self.late_s, self.device.read()))
        come = [data for due, data in self._coming if due <= self.t_s]
        self._coming = [each for each in self._coming if each[0] > self.t_s]
        return b"".join(come)

    def step(self):
        self.device.step()


@pytest.mark.parametrize("late_s", [0.035, 0.07, 0.1, 0.15])
def test_late_answers_are_no_fault_and_answer_no_other_question(late_s):
    device = So101Bus.made(load=unloaded)
    board, _ = opened(late := LateDevice(device, 0.0))
    board.enable()
    late.late_s = late_s
    for _ in range(4):
        counts = board.bus.states(board.calibration.ids).counts
        assert counts - MIDDLE == pytest.approx(device.servos.shaft[:5] / RAD_PER_COUNT, abs=1.0)
        assert board.bus.read(1, MODEL) == STS3215
        assert [board.bus.read(1, each) for each in (MODE, TORQUE)] == [POSITION_MODE, 1]
    assert board.broken_messages > 0


@pytest.mark.parametrize("late_s", [0.0, 0.035, 0.07, 0.1, 0.15])
def test_late_answers_of_a_moving_joint_are_stamped_between_their_question_and_their_coming(late_s):
    """A servo reads its angle when it is asked: the middle is late_s / 2 later, however often it was asked before."""
    device = So101Bus.made(load=unloaded)
    late = LateDevice(device, 0.0)
    board = FeetechBoard.connect(ServoBus(SteppedLink(late), "feetech:PORT", now=lambda: device.t_s), begin_s=0.0)
    board.enable()
    times, true, step, begin = [], [], device.step, device.servos.shaft[0]

    def carried():
        device.servos.goal(0, begin + 0.5 * np.sin(2.0 * device.t_s), 5.0)
        step()
        times.append(device.t_s)
        true.append(device.servos.shaft[0])

    device.step, late.late_s = carried, late_s
    states = [board.receive(0.1) for _ in range(8)]
    t_s, q = (np.concatenate(each) for each in ([s.t_s for s in states], [s.q[:, 0] for s in states]))
    off = np.abs(np.interp(t_s - late_s / 2, times, true) - q)
    assert np.ptp(q) > 0.4
    assert off.max() < RAD_PER_COUNT + 0.004 * np.abs(np.gradient(true, times)).max()
    assert (board.broken_messages > 0) == (late_s > 0)


def lerobot(tmp_path, **changes):
    """A calibration as lerobot-calibrate writes it."""
    entries = {
        name: {"id": k + 1, "drive_mode": 0, "homing_offset": 0, "range_min": 800 + 10 * k, "range_max": 3300}
        for k, name in enumerate((*NAMES, "gripper"))
    }
    for name, fields in changes.items():
        entries[name] |= fields
    path = tmp_path / "follower.json"
    path.write_text(json.dumps(entries))
    return path


def test_a_calibration_makes_the_middle_of_the_range_the_zero(tmp_path):
    calibration = read_calibration(lerobot(tmp_path))
    assert calibration.names == NAMES
    assert calibration.ids == (1, 2, 3, 4, 5)
    assert calibration.angles(np.array([2050.0, 2055, 2060, 2065, 2070])) == pytest.approx(0.0, abs=1e-12)
    q = np.array([0.1, -0.2, 0.3, 0.4, -0.5])
    assert np.abs(calibration.angles(calibration.counts(q)) - q).max() <= RAD_PER_COUNT / 2
    board, _ = opened(So101Bus.made(), calibration)
    low, high = board.soft_limits()
    assert high == pytest.approx(-low)
    board.enable()
    with pytest.raises(InputError, match=r"joint 2 \(shoulder_lift\) is to go to -120.0 deg; its servo is allowed"):
        board.send(JointCommand(np.radians([5, -120.0, 60, 20, 0]), REST, REST, 0.005))


def test_a_calibration_of_another_arm_is_found_by_its_offsets(tmp_path):
    calibration = read_calibration(lerobot(tmp_path, elbow_flex={"homing_offset": -986}))
    with pytest.raises(DeviceError, match=r"elbow_flex \(id 3\) has homing offset 0, its calibration -986"):
        opened(So101Bus.made(), calibration)


@pytest.mark.parametrize(
    ("name", "fields", "said"),
    [
        ("elbow_flex", {"id": 2}, "id 2 stands twice"),
        ("elbow_flex", {"homing_offset": 3000}, "elbow_flex: homing_offset is 3000; allowed is -2047 to 2047"),
        ("elbow_flex", {"drive_mode": 1}, "elbow_flex: drive_mode is 1; allowed is 0"),
        ("elbow_flex", {"range_min": 3500}, "elbow_flex: range_min 3500 is not below range_max 3300"),
        ("elbow_flex", {"range_max": None}, "elbow_flex: range_max is None; a whole number is needed"),
    ],
)
def test_a_broken_calibration_is_named(tmp_path, name, fields, said):
    with pytest.raises(InputError) as raised:
        read_calibration(lerobot(tmp_path, **{name: fields}))
    assert said in str(raised.value)
    assert "follower.json" in str(raised.value)


@pytest.mark.parametrize(
    ("text", "said"), [("{", "not JSON"), ("[1]", "no calibration of LeRobot"), ("{}", "has no joint")]
)
def test_what_is_no_calibration_is_named(tmp_path, text, said):
    path = tmp_path / "a.json"
    path.write_text(text)
    with pytest.raises(InputError, match=said):
        read_calibration(path)


def test_new_offsets_change_nothing_else_in_the_file(tmp_path):
    source = lerobot(tmp_path)
    write_offsets(tmp_path / "new.json", source, {2: -12})
    before, after = json.loads(source.read_text()), json.loads((tmp_path / "new.json").read_text())
    assert after["shoulder_lift"].pop("homing_offset") == -12
    assert before["shoulder_lift"].pop("homing_offset") == 0
    assert before == after


def test_the_mechanics_hold_their_zero_apart():
    device = So101Bus.made(So101Mechanics(zero_rad=(0.01, 0, 0, 0, 0, 0)))
    assert device.servos.true_q[0] - device.servos.shaft[0] == pytest.approx(0.01)


def test_columns_of_lerobot_are_degrees_where_no_percent_can_be():
    joints = ("elbow_flex", "shoulder_pan", "shoulder_lift", "wrist_flex", "wrist_roll", "gripper")
    head = ["t_s", *(f"{name}.pos" for name in joints)]
    rows = [head, ["0.0", "90.5", "1", "2", "3", "-101.5", "30"]]
    read = degree_columns("log.csv", rows)
    assert read[0] == ["t_s", "q3_deg", "q1_deg", "q2_deg", "q4_deg", "q5_deg", "gripper.pos"]
    counts = np.array([2047.0, -1024, 0, 3, -1155])  # off the middles; LeRobot 0.4.4 writes 360/4095 degrees for each
    log = [head, ["0.0", *(repr(count * 360 / 4095) for count in counts.tolist()), ""]]
    read = degree_columns("log.csv", log)
    assert (read[1][0], read[1][-1]) == ("0.0", "")
    np.testing.assert_allclose(np.array(read[1][1:-1], float), counts * 360 / 4096, rtol=1e-12)
    with pytest.raises(
        InputError, match=r"degrees, or percent of each joint's range.* by 4095/4096 .* name them q1_deg"
    ):
        degree_columns("log.csv", [head, ["0.0", "90.5", "1", "2", "3", "-99.5", "300"]])
    with pytest.raises(InputError, match=r"read are those of one SO-100 or SO-101.* by 4095/4096 and name them q1_deg"):
        degree_columns("log.csv", [["left_elbow_flex.pos", *head], ["1", *rows[1]]])
    for names in (
        ["q1_deg"],
        ["q1_deg", "left_shoulder_pan.pos", *head],
        ["q1", "tcp.pos"],
    ):  # named already, or others'
        table = [names, ["1"] * len(names)]
        assert degree_columns("log.csv", table) == table


def test_a_reading_is_stamped_in_the_middle_of_the_servos_answers(folded):
    _, device = folded
    link = SteppedLink(device)
    board = FeetechBoard.connect(ServoBus(link, "feetech:PORT", now=lambda: device.t_s), begin_s=0.0)
    board.enable()
    times, true, step = [], [], device.step

    def noted():
        step()
        times.append(device.t_s)
        true.append(device.truth[0].copy())

    device.step = noted
    q, begin = board.receive(0.0).q[-1], device.t_s
    read_s, read = [], []
    while device.t_s < begin + 3.0:
        ahead = np.radians(15.0) * np.sin(np.pi * (device.t_s - begin))
        board.send(JointCommand(q + ahead, REST, REST, 0.005))
        states = board.receive(0.004)
        read_s, read = [*read_s, *states.t_s], [*read, *states.q]
    true, late = np.array(true), []
    for k in range(5):
        speed = np.interp(read_s, times, np.gradient(true[:, k], times))
        off = np.interp(read_s, times, true[:, k]) - np.array(read)[:, k]
        late.append((off @ speed) / (speed @ speed))
    assert (np.diff(late) < 0).all()  # one after the other
    assert abs(np.mean(late)) < 2e-4
