"""An emulated AR4: homing, motion, what its encoders do not see; and what is wrong with a line is one line."""

import numpy as np
import pytest

from armsight.data import JointCommand
from armsight.errors import DeviceError, InputError
from armsight.robot.boards.ar4.board import Ar4Board
from armsight.robot.boards.codes import Alarm, BoardState, Command
from armsight.sim.boards.ar4 import Ar4Mechanics, Ar4Teensy
from armsight.sim.boards.device import SteppedLink
from noisy_device import NoisyDevice

REST = np.zeros(6)


def opened(device, **options):
    link = SteppedLink(device)
    return Ar4Board.connect(link, name="ar4:PORT", now=link.now, **options), link


@pytest.fixture
def homed():
    """A board whose arm is homed and enabled, and its device."""
    device = Ar4Teensy(homing_s=1.0)
    board, _ = opened(device)
    board.home()
    board.enable()
    return board, device


def follow(board, q, wait_s):
    """Go to joint angles, rad, in steps that the board takes."""
    begin = board.receive(0.0).q[-1]
    steps = int(np.ceil(np.degrees(np.abs(q - begin).max()) / 10)) or 1
    for k in range(1, steps + 1):
        board.send(JointCommand(begin + (q - begin) * k / steps, REST, REST, 0.02))
        board.receive(0.5)
    return board.receive(wait_s).q[-1]


def off(board, device, q):
    """Return true less reported angles, degrees, after a motion."""
    reported = np.degrees(follow(board, q, 1.0))
    return device.true_deg - reported


def test_it_says_who_it_is_and_what_it_cannot_do():
    board, _ = opened(Ar4Teensy())
    assert board.welcome.board == "ar4 mk3"
    assert board.welcome.firmware == "2.1.0"
    assert not board.abilities.releases
    assert "cannot switch its drives off" in board.abilities.missing
    assert board.status.state is BoardState.DISABLED
    assert np.isnan(board.status.supply_v)


def test_an_arm_that_was_not_homed_does_not_move():
    board, _ = opened(Ar4Teensy())
    for action in (board.enable, lambda: board.send(JointCommand(REST, REST, REST, 0.02))):
        with pytest.raises(InputError, match="not homed since it was switched on"):
            action()


def test_homing_is_off_by_what_the_switches_are_and_the_encoders_do_not_see_it(homed):
    board, device = homed
    assert board.receive(0.02).q[-1] == pytest.approx(0.0, abs=np.radians(0.05))
    off = device.true_deg - np.array(device.mechanics.homing_deg)
    assert np.abs(off).max() < 0.25  # backlash and the scatter of the switches
    assert np.abs(device.true_deg).max() > 0.8


def test_goals_are_reached_by_the_encoders_within_their_dead_steps(homed):
    board, _ = homed
    q = np.radians([12.0, -8.0, 15.0, 20.0, -10.0, 25.0])
    assert np.degrees(np.abs(follow(board, q, 1.0) - q)).max() < 0.15
    speeds = board.joints.speed_rad_s
    assert np.abs(speeds).max() < 0.05


def test_a_motion_follows_the_ramps(homed):
    board, _ = homed
    board.send(JointCommand(np.radians([15.0, 0, 0, 0, 0, 0]), REST, REST, 0.02))
    states = board.receive(2.0)
    speed = np.diff(np.degrees(states.q[:, 0])) / np.diff(states.t_s)
    assert 15 < speed.max() < 24  # sqrt(30 deg/s^2 x 15 deg) = 21
    assert np.degrees(states.q[-1, 0]) == pytest.approx(15.0, abs=0.1)


def test_steps_that_a_motor_loses_are_made_up_for_and_a_slipped_belt_is_not(homed):
    board, device = homed
    q = np.radians([10.0, 0, 0, 0, 0, 0])
    begin = off(board, device, q)
    device.lose_steps(0, -20)
    assert np.degrees(board.receive(0.02).q[-1][0]) == pytest.approx(10.0 - 20 / 44.44, abs=0.1)
    board.receive(1.0)
    after = off(board, device, q)
    assert after == pytest.approx(begin, abs=0.2)
    device.lose(1, -0.7)
    after = off(board, device, q)
    assert after[1] - begin[1] == pytest.approx(-0.7, abs=0.1)


def test_backlash_is_between_motor_and_joint():
    device = Ar4Teensy(homing_s=0.5, mechanics=Ar4Mechanics(backlash_deg=(0.4,) * 6, scatter_deg=0.0))
    board, _ = opened(device)
    board.home()
    board.enable()
    goal, off = np.radians([5.0, 0, 0, 0, 0, 0]), []
    for beside in (-3.0, 3.0):
        follow(board, goal + np.radians([beside, 0, 0, 0, 0, 0]), 0.5)
        reads = follow(board, goal, 0.5)
        off.append(device.true_deg[0] - np.degrees(reads[0]))
    assert off[1] - off[0] == pytest.approx(0.4, abs=0.02)


def test_the_emergency_stop_stops_is_named_and_is_reset_when_it_is_out(homed):
    board, device = homed
    board.send(JointCommand(np.radians([15.0, 0, 0, 0, 0, 0]), REST, REST, 0.02))
    board.receive(0.3)
    device.press(True)
    board.receive(0.3)
    assert board.status.state is BoardState.STOPPED
    assert board.status.faults[0].fault is Alarm.EMERGENCY_STOP
    with pytest.raises(DeviceError, match="still pressed"):
        board.command(Command.CLEAR_STOP)
    device.press(False)
    board.command(Command.CLEAR_STOP)
    assert board.status.state is not BoardState.STOPPED
    with pytest.raises(InputError, match="drives stay on"):
        board.command(Command.DISABLE)


def test_stop_brings_the_arm_to_rest(homed):
    board, _ = homed
    board.send(JointCommand(np.radians([19.0, 0, 0, 0, 0, 0]), REST, REST, 0.02))
    board.receive(0.6)
    board.stop()
    board.receive(1.5)
    q = board.receive(0.5).q
    assert np.ptp(q, axis=0).max() < 1e-9
    assert np.degrees(q[-1][0]) < 18.0


def test_a_switch_that_is_not_reached_is_the_teensys_word():
    board, _ = opened(Ar4Teensy(homing_s=1.0, stuck=3))
    with pytest.raises(DeviceError, match=r"the Teensy reports: Failed to move to limit switches\."):
        board.home()
    with pytest.raises(InputError, match="4 joints at once are not possible"):
        board.home(at_once=4)


def test_an_older_firmware_of_the_same_kind_is_spoken_to_and_another_is_not():
    board, _ = opened(Ar4Teensy(version="2.0.4"))
    assert board.welcome.firmware == "2.0.4"
    with pytest.raises(DeviceError, match=r"firmware is version 1\.0\.0; this armsight knows 2\.1\.0"):
        opened(Ar4Teensy(version="1.0.0"))
    with pytest.raises(InputError, match="no AR4 'mk9'; there are mk1, mk2, mk3"):
        opened(Ar4Teensy(), model="mk9")


class Silent(Ar4Teensy):
    """A port at which nothing answers."""

    def write(self, data):
        pass


class Chatty(Silent):
    """Something else at the port."""

    def read(self):
        return b"temp=21.5\r\n"


@pytest.mark.parametrize(
    ("device", "said"),
    [
        (Silent(), "ar4:PORT: nothing answers ST: is the Teensy switched on"),
        (Chatty(), "ar4:PORT: bytes come, but no answer to ST"),
    ],
)
def test_a_port_without_a_teensy_is_one_line_and_no_hang(device, said):
    with pytest.raises(DeviceError) as raised:
        opened(device)
    assert said in str(raised.value)
    assert device.t_s < 5.0


def test_a_restart_is_found(homed):
    board, device = homed
    follow(board, np.radians([10.0, 5, 0, 0, 0, 0]), 0.1)
    device.restart()
    with pytest.raises(DeviceError, match="nothing answers JP"):
        board.receive(0.1)


def test_disturbed_readings_are_not_taken_for_angles():
    device = Ar4Teensy(homing_s=0.5)
    noisy = NoisyDevice(device, 0.0, seed=2)
    board, _ = opened(noisy)
    board.home()
    noisy.share = 0.002
    states = board.receive(4.0)
    assert board.broken_messages > 0
    assert np.degrees(np.ptp(states.q, axis=0)).max() < 10.0  # without a checksum a digit is not found


@pytest.mark.parametrize("steps", [-2, 1])
def test_a_goal_that_changes_at_rest_within_the_dead_steps_is_reached_in_the_sense_of_the_change(homed, steps):
    board, device = homed
    device.mechanics = Ar4Mechanics((2.5 / board.model.steps_per_deg[0], *(0.0,) * 5), (0.0,) * 6, 0.0)  # 2.5 steps
    arrived = np.radians([3.0, 10.0, -15.0, 5.0, 20.0, 5.0])
    follow(board, arrived, 1.0)
    states = board.receive(1.2)
    steps_off = np.degrees(states.q[-1] - arrived) * board.model.steps_per_deg
    assert np.abs(steps_off).max() < 0.6  # in motion the firmware stops up to two steps short
    step = np.radians(1 / board.model.steps_per_deg) * np.eye(6)[0] * np.sign(steps)
    angles = []
    for goal in (arrived + 7 * step, arrived + (7 + abs(steps)) * step):
        for _ in range(35):
            board.send(JointCommand(goal, REST, REST, 0.02))
            board.receive(0.02)
        angles.append(device.true_deg)
    moved = (angles[1] - angles[0]) * board.model.steps_per_deg
    np.testing.assert_allclose(moved, [steps, 0.0, 0.0, 0.0, 0.0, 0.0], atol=1e-6)  # no backlash was taken up anew


def test_a_motion_that_begins_right_after_such_a_goal_is_followed_by_all_joints(homed):
    board, _ = homed
    q = np.radians([3.0, 10.0, -15.0, 5.0, 20.0, 5.0])
    follow(board, q, 1.5)
    reached = {}
    for steps in (0, 1):
        step = np.radians(steps / board.model.steps_per_deg) * np.eye(6)[0]
        for _ in range(60):
            board.send(JointCommand(q, REST, REST, 0.02))
            board.receive(0.02)
        board.send(JointCommand(q + step, REST, REST, 0.02))
        board.receive(0.02)
        for k in range(1, 13):
            ramp = np.radians(15.0) * (0.02 * k) ** 2 * np.eye(6)[3]
            board.send(JointCommand(q + step + ramp, ramp / (0.01 * k), REST, 0.02))
            reached[steps] = np.degrees(board.receive(0.02).q[-1][3] - q[3])
        follow(board, q, 1.5)
    assert reached[0] > 0.2
    assert reached[1] == pytest.approx(reached[0], abs=0.1)


def test_a_reading_is_stamped_when_the_encoders_were_read_and_not_when_the_answer_had_come():
    device = Ar4Teensy(homing_s=1.0)
    board, _ = opened(device)
    board.home()
    board.enable()
    angles, step = {}, device.step

    def noted():
        step()
        angles[round(1e3 * device.t_s)] = device.truth[0][0]

    device.step = noted
    board.send(JointCommand(np.radians([15.0, 0, 0, 0, 0, 0]), REST, REST, 0.02))
    read = board.receive(3.0)
    times, true = 1e-3 * np.array(list(angles)), np.array(list(angles.values()))
    zero = true[-1] - read.q[-1, 0]
    steepest = np.abs(np.diff(read.q[:, 0])).argmax()  # 15 deg/s and more: 1 ms is 0.015 deg, a step 0.022
    rows = slice(steepest - 3, steepest + 4)
    late = np.interp(read.t_s[rows], times, true) - zero - read.q[rows, 0]
    speed = np.ptp(read.q[rows, 0]) / np.ptp(read.t_s[rows])
    assert abs(np.median(late) / speed) < 1.5e-3
