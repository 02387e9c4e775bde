"""The host's end of a board: the hello, commands and their fate, telemetry, and what is said when the board is gone."""

import numpy as np
import pytest
from board_rigs import ScriptedLink, Speaker, hold, host_board, keep_on

from armsight.data import JointCommand
from armsight.errors import DeviceError, InputError
from armsight.robot.boards.board import Board
from armsight.robot.boards.codes import BoardState, Command, ConfigSource, Fault, Limited, Rejection
from armsight.robot.boards.configuration import CONFIG, gains_array, lab_configuration
from armsight.robot.boards.emulated import EmulatedLink
from armsight.robot.boards.emulators import open_emulator
from armsight.sim.joints import JointPlant, PotFault

ZERO = np.zeros(6)


def talking(speaker, **welcome):
    """A far side that answers the hello, sends its configuration's end, and then says nothing."""

    def answer(data):
        if data[7] == 0x28 and data[8] == 0xA0:  # HELLO, message 41000
            return speaker.welcome(**welcome) + speaker.status() + speaker.joints()
        reaction = (250).to_bytes(4, "little") + (2).to_bytes(4, "little")
        return speaker.config_part(CONFIG.fields["silence_ticks"][1], reaction) if data[7] == 0x36 else b""

    return answer


def test_a_hello_says_who_the_board_is():
    board, _, _ = host_board()
    assert (board.welcome.board, board.welcome.ticks_per_s, board.welcome.baud) == ("pil", 1000, 921600)
    assert board.welcome.config_source == ConfigSource.NEWEST
    assert board.status.state == BoardState.DISABLED
    assert not board.status.drives_on
    assert board.status.faults == ()


def test_a_fresh_board_runs_on_factory_values_and_cannot_be_enabled():
    board = Board.connect(EmulatedLink(open_emulator("host"), JointPlant()))
    assert board.welcome.config_source == ConfigSource.FACTORY
    assert [each.fault for each in board.status.faults] == [Fault.CONFIG]
    with pytest.raises(DeviceError, match="rejected the command: not in this state"):
        board.enable()


@pytest.mark.parametrize("versions", [{"dialect_version": 99}, {"config_version": 7}])
def test_a_board_of_another_version_is_rejected_by_name(versions):
    link = ScriptedLink(talking(Speaker(), **versions))
    with pytest.raises(DeviceError) as raised:
        Board.connect(link, name="/dev/ttyACM0")
    text = str(raised.value)
    for word in ("/dev/ttyACM0", "stm32f4", "9.9.9", "armsight board flash", *map(str, versions.values())):
        assert word in text
    assert len(link.written) == 1  # the hello, and no command
    assert link.closed


@pytest.mark.parametrize(
    ("answer", "said", "waited_s"),
    [
        (lambda data: b"", r"no board answers .nothing comes.: is it the right port", 1.0),  # 20 hellos, 50 ms each
        (lambda data: b"Marlin 2.1\nok\n\xfd\x00\xff", "bytes come, but no answer", 1.0),
        (lambda data: Speaker().welcome(), "answers the hello, but sends no telemetry", 3.01),
    ],
)
def test_a_wire_without_a_board_is_reported_as_such(answer, said, waited_s):
    link = ScriptedLink(answer)
    with pytest.raises(DeviceError, match=said):
        Board.connect(link)
    assert link.closed
    assert link.waited_s == pytest.approx(waited_s)


def test_motion_is_followed_and_every_reading_arrives_in_order():
    board, link, plant = host_board()
    board.enable()
    board.receive(0.0)
    for k in range(50):
        board.send(hold([0.002 * (k + 1)] * 6))
        board.receive(0.0 if k % 2 else 0.02)
    states = board.receive(0.05)
    assert states.q.shape == (len(states.t_s), 6)
    assert np.allclose(np.diff(states.t_s), 1e-3)  # 1 kHz at this baud rate, nothing lost
    assert abs(states.t_s[-1] - link.t_s) < 0.005
    # The potentiometer's noise has a sigma of 4 counts of 11343 per rad: 6 sigma are 2.1 mrad.
    assert np.abs(states.q[-1] - plant.q).max() < 6 * 4 / 11343
    assert board.status.state == BoardState.ENABLED


def test_readings_that_come_while_waiting_are_not_lost():
    board, _, _ = host_board()
    board.receive()
    board.enable()
    board.configuration()
    states = board.receive()
    assert len(states.t_s) > 50
    assert np.allclose(np.diff(states.t_s), 1e-3)


def test_reports_say_how_joints_are_driven():
    board, link, _ = host_board()
    board.enable()
    for _ in range(30):
        board.send(JointCommand([2.9] * 6, ZERO, ZERO, 0.01))
        board.receive(0.01)
    reported, core = board.joints, link.answer["outputs"]
    assert abs(reported.t_s - link.t_s) < 0.02
    assert np.abs(reported.reference_rad - core["reference_rad"]).max() < 0.05
    assert (reported.speed_rad_s > 0.5).all()
    assert (reported.duty > 0.1).all()
    assert all(each & Limited.SPEED and each & Limited.SOFT for each in reported.limited)


@pytest.mark.parametrize(
    ("command", "said"),
    [
        (JointCommand(np.zeros(5), ZERO, ZERO, 0.01), r"q_ref is of shape \(5,\)"),
        (JointCommand(ZERO, [0, 0, np.nan, 0, 0, 0], ZERO, 0.01), "qd_ref of joint 3 is nan"),
        (JointCommand(ZERO, ZERO, [0, np.inf, 0, 0, 0, 0], 0.01), "gravity_duty of joint 2 is inf"),
        (JointCommand(ZERO, ZERO, ZERO, 0.0105), "duration_s is 0.0105; a whole number of the board's ticks"),
        (JointCommand(ZERO, ZERO, ZERO, 0.0), "duration_s is 0.0"),
        (JointCommand(ZERO, ZERO, ZERO, 11.0), "10000 at most"),
        (JointCommand(ZERO, ZERO, ZERO, float("nan")), "duration_s is nan"),
    ],
)
def test_a_command_that_is_none_is_not_sent(command, said):
    board, link, _ = host_board()
    link.read()
    before = bytes(link._to_board)
    with pytest.raises(InputError, match=said):
        board.send(command)
    assert bytes(link._to_board) == before


def test_the_fate_of_each_command_is_known():
    board, _, _ = host_board()
    first = board.send(hold(ZERO))
    board.receive(0.03)
    assert (board.status.rejected_sequence, board.status.rejection) == (first, Rejection.WRONG_STATE)
    board.enable()
    second = board.send(hold(ZERO))
    board.receive(0.03)
    assert board.status.acknowledged_sequence == second == first + 2
    board.confirm(second)
    with pytest.raises(DeviceError, match="rejected the command: not in this state"):
        board.confirm(board.command(Command.CLEAR_STOP))


def test_numbers_go_on_behind_those_of_an_earlier_host():
    board, link, _ = host_board()
    board.enable()
    for _ in range(5):
        last = board.send(hold(ZERO))
    board.receive(0.02)
    other = Board.connect(link)
    assert [str(fault) for fault in other.status.faults] == [Fault.TAKEN_OVER.text]
    assert other.command(Command.CLEAR_FAULTS) == last + 1
    other.receive(0.05)
    assert other.status.acknowledged_sequence == last + 1


def test_an_emergency_stop_survives_a_disturbed_copy_of_itself():
    class Spoils:
        left = 1

        def to_board(self, tick, data):
            spoiled, self.left = bytearray(data), self.left - 1
            if self.left >= 0:
                spoiled[12] ^= 4
            return bytes(spoiled)

        def to_host(self, tick, data):
            return data

    board, link, _ = host_board()
    board.enable()
    link._faults = Spoils()
    board.stop()
    board.receive(0.02)
    assert board.status.state == BoardState.STOPPED
    assert board.status.crc_errors == 1
    with pytest.raises(DeviceError, match="not in this state"):
        board.enable()
    board.confirm(board.command(Command.CLEAR_STOP))
    board.enable()


def test_gains_are_taken_whole_or_rejected_by_name():
    board, _, _ = host_board()
    gains = gains_array(board.configuration())
    gains[2, 1] = 40.0
    board.confirm(board.set_gains(gains))
    assert np.array_equal(gains_array(board.configuration()), gains.astype(np.float32))
    gains[4, 0] = 100.5
    with pytest.raises(InputError, match=r"joint 5: kp_per_rad is 100\.5; 0 to 100 is allowed; nothing was changed"):
        board.set_gains(gains)
    with pytest.raises(DeviceError, match="a number is outside its range"):
        board.confirm(board.set_gains(gains, checked=False))
    with pytest.raises(InputError, match=r"of shape \(8,\)"):
        board.set_gains(gains[0])


def test_a_stored_configuration_is_in_use_after_the_next_start():
    board, link, _ = host_board()
    config = board.configuration()
    assert config.tobytes() == lab_configuration().tobytes()
    config["joint"]["soft_max_rad"][2] = 1.25
    board.store(config)
    assert board.configuration()["joint"]["soft_max_rad"][2] == pytest.approx(2.4)
    link.restart()
    board = Board.connect(link)
    assert board.configuration().tobytes() == config.tobytes()


def test_a_configuration_is_not_stored_with_the_drives_on():
    board, _, _ = host_board()
    board.enable()
    with pytest.raises(DeviceError, match="rejected the command"):
        board.store(lab_configuration())
    broken = lab_configuration()
    broken["joint"]["duty_limit"][1] = 1.5
    with pytest.raises(InputError, match=r"joint 2: duty_limit is 1\.5; 0 to 1 is allowed; nothing was changed"):
        board.store(broken)


def test_faults_are_reported_with_their_joint_and_text():
    board, _, plant = host_board()
    plant.break_pot(3, PotFault.OPEN)
    board.receive(0.05)
    assert str(board.status.first_fault) == "joint 4: potentiometer open: the reading is above its band"
    assert [(each.fault, each.joint) for each in board.status.faults] == [(Fault.POT_OPEN, 3)]
    plant.supply_mv = 5000
    board.receive(0.05)
    assert [(each.fault, each.joint) for each in board.status.faults] == [(Fault.POT_OPEN, 3), (Fault.SUPPLY_LOW, None)]
    assert board.status.supply_v == 5.0


@pytest.mark.parametrize(("reaction", "does"), [(1, "slows down and holds the arm"), (2, "switches the drives off")])
def test_a_silent_board_is_reported_with_what_its_arm_does(reaction, does):
    config = lab_configuration()
    config["silence_reaction"], config["silence_ticks"] = reaction, 250
    board, link, _ = host_board(config)

    class Mute:
        def to_board(self, tick, data):
            return b""

        def to_host(self, tick, data):
            return b""

    board.receive(0.01)
    link._faults = Mute()
    with pytest.raises(DeviceError, match=f"has sent nothing for .* cable pulled.* the board {does}.* after 250 ms"):
        keep_on(board)


def test_a_link_that_breaks_is_reported_with_what_the_arm_does():
    board, link, _ = host_board()

    def gone(*_):
        raise DeviceError("/dev/ttyACM0 is gone")

    link.read = gone
    with pytest.raises(DeviceError, match="ttyACM0 is gone; without commands the board slows down and holds"):
        board.receive(0.01)
    link.write = gone
    with pytest.raises(DeviceError, match="ttyACM0 is gone; without commands"):
        board.send(hold(ZERO))


def test_a_board_that_restarted_is_reported():
    board, link, _ = host_board()
    link.restart(watchdog=True)
    with pytest.raises(DeviceError, match="has restarted: its drives are off; connect to it again"):
        keep_on(board, sends=hold(ZERO), times=5)
    assert [each.fault for each in Board.connect(link).status.faults] == [Fault.WATCHDOG]


def test_a_clock_that_starts_again_is_reported():
    speaker = Speaker()
    link = ScriptedLink(talking(speaker, tick=50_000))
    board = Board.connect(link)
    link.waiting = speaker.angles(50_100) + speaker.angles(50_099)
    assert board.receive().t_s.tolist() == [50.1, 50.099]
    link.waiting = speaker.angles(3)
    with pytest.raises(DeviceError, match="has restarted"):
        board.receive()


def test_the_clock_runs_on_where_ticks_wrap():
    speaker = Speaker()
    link = ScriptedLink(talking(speaker, tick=2**32 - 3))
    board = Board.connect(link)
    link.waiting = b"".join(speaker.angles(tick) for tick in (2**32 - 2, 2**32 - 1, 0, 1))
    assert np.allclose(np.diff(board.receive().t_s), 1e-3)


def test_telemetry_is_found_behind_every_disturbed_byte():
    """Whatever single byte of a message is disturbed, all messages behind it arrive."""
    speaker = Speaker()
    link = ScriptedLink(talking(speaker))
    board = Board.connect(link)
    whole = speaker.angles(10)
    tail = b"".join(speaker.angles(tick) for tick in range(11, 31))
    for at in range(len(whole)):
        spoiled = bytearray(whole)
        spoiled[at] ^= 0x80
        broken = board.broken_messages
        link.waiting = bytes(spoiled) + tail
        times = board.receive().t_s * 1000
        assert set(range(11, 31)) <= set(np.round(times).astype(int)), at
        assert board.broken_messages > broken


def test_a_message_whose_code_nobody_knows_counts_as_broken():
    speaker = Speaker()
    link = ScriptedLink(talking(speaker))
    board = Board.connect(link)
    before = board.broken_messages
    link.waiting = speaker.status(5, state=77) + speaker.angles(6)
    assert len(board.receive().t_s) == 1
    assert board.broken_messages == before + 1
    assert board.status.state == BoardState.DISABLED


def test_a_board_is_closed_with_its_block():
    link = ScriptedLink(talking(Speaker()))
    with Board.connect(link) as board:
        assert board.welcome.board == "stm32f4"
    assert link.closed
