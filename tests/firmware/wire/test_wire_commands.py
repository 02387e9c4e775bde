"""The wire between host and core: who is listened to, in which order, and what is said of it afterwards."""

from importlib.metadata import version

import pytest
from firmware_arm import lab_config
from firmware_layout import c
from firmware_pil import Host

from armsight import firmware


def fate(host):
    """What the board said last of its commands: acknowledged, rejected, why."""
    status = host.newest("BOARD_STATUS")
    return status.acknowledged_sequence, status.rejected_sequence, status.rejection


def test_every_hello_is_answered_with_who_the_board_is(fresh):
    board, host = fresh
    board.tick()
    assert host.listen() == []
    board.tick(host.hello(nonce=4711))
    board.tick()
    welcome = host.newest("WELCOME")
    assert (welcome.dialect_version, welcome.config_version, welcome.nonce) == (5, c.CONFIG_VERSION, 4711)
    assert (welcome.board, welcome.joints, welcome.baud) == ("pil", c.JOINTS, 921600)
    assert (welcome.ticks_per_s, welcome.config_source) == (c.TICKS_PER_S, c.CONFIG_FACTORY)
    assert welcome.firmware == version("armsight")


@pytest.mark.parametrize("other", [{"dialect": 6}, {"config": 1}, {"dialect": 2}])
def test_a_host_of_another_version_learns_who_the_board_is_and_may_only_stop_it(working, other):
    board, host = working
    board.run(2, host.hello(nonce=9, **other))
    host.listen()
    board.run(30, host.command(c.COMMAND_ENABLE))
    assert host.newest("WELCOME").nonce == 9
    assert {message.get_type() for message in host.listen()} <= {"BOARD_STATUS"}
    assert fate(host) == (0, host.sequence, c.REJECTION_NO_HELLO)
    board.run(2, host.stop())
    assert board.answer.outputs.state == c.STATE_STOPPED
    board.run(2, host.hello())
    board.run(30, host.command(c.COMMAND_CLEAR_STOP))
    assert board.answer.outputs.state == c.STATE_DISABLED


@pytest.mark.parametrize("message", ["move", "command", "gains", "store"])
def test_nothing_is_acknowledged_before_a_hello(fresh, message):
    board, host = fresh
    sent = {
        "move": host.move,
        "command": lambda: host.command(c.COMMAND_DISABLE),
        "gains": lambda: host.pack("gains", host.next(), host.session, [0.0] * 48),
        "store": lambda: host.store(b""),
    }[message]()
    board.run(30, sent)
    assert fate(host) == (0, host.sequence, c.REJECTION_NO_HELLO)
    assert board.answer.outputs.acknowledged_count == 0


def test_what_asks_for_no_command_is_not_answered_before_a_hello(fresh):
    board, host = fresh
    board.run(30, host.pack("config_read", 0))
    assert host.listen() == []


def test_commands_are_acknowledged_by_number_and_old_ones_dropped(working):
    board, host = working
    board.run(2, host.command(c.COMMAND_ENABLE, sequence=5))
    assert board.answer.outputs.state == c.STATE_ENABLED
    for old in (5, 4, 1, 2**32 - 3):
        board.run(2, host.command(c.COMMAND_DISABLE, sequence=old))
    assert board.answer.outputs.state == c.STATE_ENABLED
    board.run(30)
    assert host.newest("BOARD_STATUS").stale_commands == 4
    board.run(2, host.command(c.COMMAND_DISABLE, sequence=6))
    assert board.answer.outputs.state == c.STATE_DISABLED
    assert board.answer.outputs.acknowledged_sequence == 6


def test_numbers_go_round(working):
    board, host = working
    for sequence in (2**31 - 5, 2**32 - 10, 0, 1):
        board.run(2, host.command(c.COMMAND_DISABLE, sequence=sequence))
        assert board.answer.outputs.acknowledged_sequence == sequence


def test_a_hello_begins_the_numbers_anew(working):
    board, host = working
    board.run(2, host.command(c.COMMAND_DISABLE, sequence=900))
    board.run(3, host.hello())
    board.run(2, host.command(c.COMMAND_DISABLE, sequence=1))
    assert board.answer.outputs.acknowledged_sequence == 1


def test_one_command_a_tick_in_their_order_and_only_the_newest_move(working):
    board, host = working
    host.sequence = 10
    burst = host.command(c.COMMAND_ENABLE) + host.move(0.1) + host.command(c.COMMAND_DISABLE) + host.move(0.2)
    burst += host.command(c.COMMAND_ENABLE) + host.move(0.3)
    acknowledged = []
    for data in (burst, b"", b"", b"", b""):
        outputs = board.tick(data)
        acknowledged.append((outputs.acknowledged_sequence, outputs.rejected_sequence))
    assert acknowledged == [(11, 0), (13, 0), (15, 0), (16, 0), (16, 0)]
    board.run(30)
    assert host.newest("BOARD_STATUS").stale_commands == 2


def test_more_commands_than_can_wait_are_rejected(working):
    board, host = working
    board.tick(b"".join(host.command(c.COMMAND_DISABLE) for _ in range(10)))
    board.run(30)
    assert fate(host) == (8, 10, c.REJECTION_TOO_MANY)
    assert host.newest("BOARD_STATUS").rejected_count == 2


def test_a_stop_is_taken_in_its_tick_and_drops_what_waits(working):
    board, host = working
    board.run(2, host.command(c.COMMAND_ENABLE))
    waiting = host.command(c.COMMAND_DISABLE) + host.command(c.COMMAND_ENABLE)
    outputs = board.tick(waiting + host.stop())
    assert (outputs.state, outputs.drives_on) == (c.STATE_STOPPED, 0)
    board.run(30)
    assert board.answer.outputs.state == c.STATE_STOPPED
    assert fate(host) == (host.sequence, 0, 0)
    assert host.newest("BOARD_STATUS").stale_commands == 2
    board.run(2, host.command(c.COMMAND_CLEAR_STOP))
    assert board.answer.outputs.state == c.STATE_DISABLED


def test_a_stop_is_taken_whatever_its_number_and_reported_only_when_taken(working):
    board, host = working
    board.run(2, host.command(c.COMMAND_ENABLE, sequence=100))
    board.tick(host.pack("stop", 3))
    board.run(6)
    statuses = [message for message in host.listen() if message.get_type() == "BOARD_STATUS"]
    reported = [message.state for message in statuses if message.acknowledged_sequence == 3]
    assert reported
    assert set(reported) == {c.STATE_STOPPED}
    board.run(2, host.command(c.COMMAND_CLEAR_STOP, sequence=50))
    assert board.answer.outputs.state == c.STATE_STOPPED, "an older number than 100 is stale still"


@pytest.mark.parametrize("kind", [0, c.COMMAND_MOVE, c.COMMAND_GAINS, 9, 0x100, 2**32 - 1])
def test_a_command_of_an_unknown_kind_is_rejected(working, kind):
    board, host = working
    board.run(30, host.command(kind))
    assert fate(host) == (0, host.sequence, c.REJECTION_UNKNOWN_COMMAND)


def test_a_rejection_of_the_core_is_reported_with_its_reason(working):
    board, host = working
    board.run(2, host.command(c.COMMAND_ENABLE))
    board.run(30, host.move(float("nan")))
    assert fate(host) == (1, 2, c.REJECTION_NOT_FINITE)


def test_gains_come_whole(working):
    board, host = working
    gains = [0.01 if k % 8 in (5, 6) else 1.0 + 0.1 * k for k in range(48)]
    board.run(4, host.pack("gains", host.next(), host.session, gains))
    assert board.answer.outputs.acknowledged_sequence == host.sequence
    board.run(12, host.pack("config_read", 0))
    part = host.newest("CONFIG_PART")
    config = c.core_config.from_buffer_copy(bytes(part.bytes).ljust(2000, b"\0"))
    assert list(bytes(config.joint[0].gains)) == list(bytes(c.joint_gains(*gains[:8])))


def test_a_timesync_comes_back_with_the_tick(working):
    board, host = working
    board.tick(host.pack("timesync", 0, 123456789012345))
    board.run(3)
    sync = host.newest("TIMESYNC")
    assert (sync.ts1, sync.tc1) == (123456789012345, (board.request.tick - 5) * 1_000_000)


def test_what_the_board_itself_sends_does_nothing_when_it_comes_back(working):
    board, host = working
    board.run(50)
    board.run(50, bytes(board.sent))
    board.run(30)
    status = host.newest("BOARD_STATUS")
    assert (status.acknowledged_count, status.rejected_count, status.crc_errors, status.lost_bytes) == (0, 0, 0, 0)


def test_the_dialects_version_is_the_one_the_board_knows():
    assert firmware.dialect().ARMSIGHT_DIALECT_VERSION == 5


def test_a_new_host_does_not_find_the_last_ones_commands(working):
    board, host = working
    later = Host(board)
    board.tick(host.command(c.COMMAND_DISABLE) + host.command(c.COMMAND_ENABLE) + later.hello())
    board.run(30)
    assert board.answer.outputs.acknowledged_count == 0
    assert later.newest("BOARD_STATUS").stale_commands == 2


def test_a_second_host_moves_nothing_and_the_first_one_hears_of_it(working):
    board, host = working
    board.run(2, host.command(c.COMMAND_ENABLE))
    board.run(2, host.move(0.1))
    second = Host(board)
    board.run(2, second.move(0.3, sequence=500))  # without a hello, or with a guess at the session
    assert board.answer.outputs.acknowledged_sequence == host.sequence
    host.listen()
    board.run(4, second.hello())
    assert (board.answer.outputs.first_fault, board.answer.outputs.drives_on) == (c.FAULT_TAKEN_OVER, 1)
    assert host.session != second.session
    before = board.answer.outputs.acknowledged_count
    board.run(30, host.move(0.2))
    assert board.answer.outputs.acknowledged_count == before
    assert fate(host)[2] == c.REJECTION_NOT_OWNER
    assert host.newest("BOARD_STATUS").first_fault == c.FAULT_TAKEN_OVER


def test_a_recording_played_back_moves_nothing(working):
    board, host = working
    recorded = [host.hello()]
    board.run(3, recorded[0])
    for data in (host.command(c.COMMAND_ENABLE), host.move(0.2), host.command(c.COMMAND_DISABLE)):
        recorded.append(data)
        board.run(4, data)
    assert board.answer.outputs.acknowledged_count == 3
    for data in recorded:
        board.run(4, data)
    assert (board.answer.outputs.acknowledged_count, board.answer.outputs.drives_on) == (3, 0)
    board.run(30)
    assert fate(host)[2] == c.REJECTION_NOT_OWNER


def test_another_system_has_no_part_in_the_session(working):
    board, host = working
    other = Host(board)
    other.out.srcSystem, other._session = 42, host.session
    board.run(30, other.command(c.COMMAND_ENABLE, sequence=77))
    assert board.answer.outputs.drives_on == 0
    assert fate(host) == (0, 77, c.REJECTION_NOT_OWNER)
    board.run(2, other.stop())  # the stop is everybody's
    assert board.answer.outputs.state == c.STATE_STOPPED


def test_a_lab_configuration_is_what_the_working_board_has(working):
    board, host = working
    raw = b""
    for offset in range(0, 2000, 200):
        board.run(12, host.pack("config_read", offset))
        part = host.newest("CONFIG_PART")
        assert part.offset == offset
        raw += bytes(part.bytes[: part.length])
    assert raw == bytes(lab_config(board.library))
