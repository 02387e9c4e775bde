"""Disturbed bytes on the way to the board: what is counted, and that the link is good again at once."""

import numpy as np
import pytest
from firmware_layout import c
from firmware_pil import BAUD

#: The link must be usable again so long after the last bad byte.
USABLE_TICKS = 20
COMMANDS = 6


def disables(host, count=COMMANDS) -> list[bytes]:
    """Messages whose obedience can be counted: each is acknowledged once, in any state."""
    return [host.command(c.COMMAND_DISABLE) for _ in range(count)]


def counters(board, host):
    board.run(60)
    return host.newest("BOARD_STATUS")


def settle(board, host) -> int:
    """Let a second of nothing pass, greet again, and return how many commands were acknowledged so far."""
    board.run(50)
    board.run(5, host.hello())
    host.sequence = 0
    return board.answer.outputs.acknowledged_count


def test_from_whatever_byte_it_begins_no_later_message_is_lost(working):
    """Listening begins within a message: that one is lost, all others are acknowledged."""
    board, host = working
    length = len(disables(host, 1)[0])
    for begin in range(1, length + 1):
        before = settle(board, host)
        board.run(10, b"".join(disables(host))[begin:])
        assert board.answer.outputs.acknowledged_count - before == COMMANDS - 1, begin


@pytest.mark.parametrize("kind", ["flip", "drop", "double"])
def test_a_disturbed_byte_costs_its_own_message_at_most(working, kind):
    board, host = working
    for at in range(20, 40):
        before = settle(board, host)
        stream = b"".join(disables(host))
        bent = bytes([stream[at] ^ 0x40])
        put = {"flip": bent, "drop": b"", "double": stream[at : at + 1] * 2}[kind]
        board.run(20, stream[:at] + put + stream[at + 1 :])
        # A doubled first byte of a message is one lost byte before a whole message.
        assert board.answer.outputs.acknowledged_count - before >= COMMANDS - 1, at


def test_a_flipped_bit_is_counted_as_a_wrong_checksum_with_its_bytes(working):
    board, host = working
    before = counters(board, host)
    message = bytearray(host.command(c.COMMAND_DISABLE))
    message[12] ^= 1
    board.run(2, bytes(message))
    now = counters(board, host)
    assert (now.crc_errors - before.crc_errors, now.lost_bytes - before.lost_bytes) == (1, len(message))
    assert now.acknowledged_count == before.acknowledged_count


def test_bytes_of_no_message_are_counted(working):
    board, host = working
    before = counters(board, host)
    board.run(5, bytes(range(100)) + b"\xfe" * 20)
    now = counters(board, host)
    assert (now.crc_errors - before.crc_errors, now.lost_bytes - before.lost_bytes) == (0, 120)


def test_messages_missing_in_between_are_counted_and_a_new_host_is_none(working):
    board, host = working
    before = counters(board, host)
    first, *_, last = disables(host, 5)
    board.run(4, first + last)
    assert counters(board, host).lost_messages - before.lost_messages == 3
    host.out.seq = 100
    board.run(2, host.hello())
    assert counters(board, host).lost_messages - before.lost_messages == 3


def test_a_begin_of_a_long_message_in_noise_swallows_nothing(working):
    """0xFD and a length of 255, then good messages at once: read on as 280 bytes they would all be lost."""
    board, host = working
    before = settle(board, host)
    board.run(10, b"\xfd\xff" + b"".join(disables(host)))
    assert board.answer.outputs.acknowledged_count - before == COMMANDS


@pytest.mark.parametrize(("at", "value"), [(2, 1), (2, 2), (2, 0x80), (1, 0), (1, 13), (1, 200), (1, 255)])
def test_signed_and_other_kinds_of_messages_and_lengths_that_none_has_are_rejected_at_their_header(working, at, value):
    board, host = working
    before = settle(board, host)
    stream = bytearray(b"".join(disables(host)))
    stream[at] = value
    board.run(10, bytes(stream))
    assert board.answer.outputs.acknowledged_count - before == COMMANDS - 1


@pytest.mark.parametrize("host_ticks", [1, 4, 16, 100])
@pytest.mark.parametrize("cut", [1, 9, 10, 11, 50, 90])
def test_a_cut_message_is_given_up_in_time(working, host_ticks, cut):
    """A host is cut off within a message and comes back: what it sends 20 ms later is acknowledged, however seldom."""
    board, host = working
    board.run(5, host.command(c.COMMAND_ENABLE))
    board.run(5, host.move()[:cut])
    for waited in range(USABLE_TICKS - 5, 200, host_ticks):
        before = board.answer.outputs.acknowledged_count + board.answer.outputs.rejected_count
        board.run(max(host_ticks, 2), host.command(c.COMMAND_DISABLE))
        if waited >= USABLE_TICKS:
            assert board.answer.outputs.acknowledged_count + board.answer.outputs.rejected_count == before + 1, waited


def noise(rng: np.random.Generator, host) -> bytes:
    """Some bad bytes: anything, or good messages cut, bent, and put together anew."""
    length = int(rng.integers(1, 300))
    if rng.random() < 0.3:
        return rng.bytes(length)
    stream = bytearray(b"".join([host.move(), host.pack("gains", 1, host.session, [1.0] * 48), *disables(host, 3)]))
    for at in rng.integers(0, len(stream), int(rng.integers(1, 9))):
        stream[at] = int(rng.integers(0, 256))
    begin = int(rng.integers(0, len(stream)))
    return bytes(stream[begin : begin + length])


def test_the_link_is_usable_20_ms_after_the_last_bad_byte(working):
    rng = np.random.default_rng(5)
    board, host = working
    for case in range(600):
        bad = noise(rng, host)
        board.run(len(bad) * 10_000 // BAUD + 2, bad)
        board.run(USABLE_TICKS - 2)
        # What the noise carried by chance (a whole command) may have moved the numbers: a hello begins them anew.
        board.run(4, host.hello())
        host.listen()
        before = board.answer.outputs.acknowledged_count
        board.run(2, host.command(c.COMMAND_DISABLE, sequence=1))
        assert board.answer.outputs.acknowledged_count == before + 1, case


def test_bytes_the_board_had_no_room_for_are_reported(fresh_wire):
    fresh_wire.receive(fresh_wire.host.hello(), overrun=3)
    fresh_wire.receive(b"", overrun=4)
    fresh_wire.tick(30)
    assert fresh_wire.host.newest("BOARD_STATUS").overrun_bytes == 7
