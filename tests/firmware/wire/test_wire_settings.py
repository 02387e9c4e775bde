"""The configuration over the wire, what is stored of it, and restarts."""

import copy
import math

import pytest
from firmware_arm import lab_config
from firmware_layout import c
from firmware_pil import BAUD, PART
from firmware_wire import BareWire


def send(board, host, config, *, parts=None, crc=None):
    """Bring a configuration across and ask to store it; returns the board's status some ticks later."""
    for part in host.parts(config) if parts is None else parts:
        board.run(4, part)
    board.run(40, host.store(config, crc=crc))
    return host.newest("BOARD_STATUS")


def restart(board, host, how=c.RESTART_POWER):
    """Switch off and on; returns the new welcome."""
    board.tick(restart=how)
    board.run(20, host.hello())
    return host.newest("WELCOME")


def test_a_stored_configuration_is_in_use_after_a_restart(fresh):
    board, host = fresh
    board.run(2, host.hello())
    config = lab_config(board.library)
    status = send(board, host, config)
    assert (status.acknowledged_sequence, status.config_stored, status.rejected_count) == (1, 1, 0)
    assert board.answer.outputs.faults == 1 << c.FAULT_CONFIG, "not in use yet"
    assert restart(board, host).config_source == c.CONFIG_NEWEST
    assert board.answer.outputs.faults == 0


def test_the_newest_of_several_is_in_use(working):
    board, host = working
    for limit in (1.0, 1.5, 1.25):
        config = lab_config(board.library)
        config.joint[0].soft_max_rad = limit
        host.sequence += 10
        assert send(board, host, config).rejected_count == 0
        restart(board, host)
        board.run(12, host.pack("config_read", 0))
        part = host.newest("CONFIG_PART")
        offset = c.joint_config.soft_max_rad.offset
        used = c.joint_config.from_buffer_copy(bytes(part.bytes).ljust(400, b"\0"))
        assert (used.soft_max_rad, offset < PART) == (limit, True)


def test_what_comes_incomplete_is_not_stored(working):
    board, host = working
    config = lab_config(board.library)
    config.joint[3].soft_max_rad = 1.0
    status = send(board, host, config, parts=host.parts(config)[:-1] and host.parts(config)[:3])
    assert (status.rejected_sequence, status.rejection) == (host.sequence, c.REJECTION_CONFIG_BROKEN)
    status = send(board, host, config, crc=12345)
    assert (status.rejected_sequence, status.rejection) == (host.sequence, c.REJECTION_CONFIG_BROKEN)
    assert status.config_stored == 0


@pytest.mark.parametrize("value", [math.nan, math.inf, -1.0, 1e9])
def test_a_value_outside_its_range_is_not_stored(working, value):
    board, host = working
    config = lab_config(board.library)
    config.joint[2].gains.kp_per_rad = value
    status = send(board, host, config)
    assert (status.rejected_sequence, status.rejection) == (host.sequence, c.REJECTION_OUT_OF_RANGE)
    assert restart(board, host).config_source == c.CONFIG_NEWEST


def test_nothing_is_stored_while_the_drives_are_on(working):
    board, host = working
    config = lab_config(board.library)
    for part in host.parts(config):
        board.run(4, part)
    board.run(2, host.command(c.COMMAND_ENABLE))
    board.run(30, host.store(config))
    status = host.newest("BOARD_STATUS")
    assert (status.rejected_sequence, status.rejection) == (host.sequence, c.REJECTION_WRONG_STATE)


def test_storing_keeps_its_order_among_the_commands(working):
    """Enable and store in one breath: the arm is enabled by then, and nothing is stored."""
    board, host = working
    config = lab_config(board.library)
    for part in host.parts(config):
        board.run(4, part)
    board.tick(host.command(c.COMMAND_ENABLE) + host.store(config) + host.command(c.COMMAND_DISABLE))
    board.run(30)
    status = host.newest("BOARD_STATUS")
    assert (status.rejected_sequence, status.rejection, status.config_stored) == (2, c.REJECTION_WRONG_STATE, 0)
    assert (status.acknowledged_sequence, status.state) == (3, c.STATE_DISABLED)
    board.tick(host.store(config) + host.command(c.COMMAND_ENABLE))
    board.run(30)
    status = host.newest("BOARD_STATUS")
    assert (status.acknowledged_sequence, status.state, status.config_stored) == (5, c.STATE_ENABLED, 1)


@pytest.mark.parametrize(
    ("offset", "total", "length"),
    [(0, 5, 200), (2**32 - 100, None, 200), (None, None, 200), (0, None, 201), (0, None, 255), (5000, None, 1)],
)
def test_a_part_that_does_not_fit_is_left_out(working, offset, total, length):
    board, host = working
    config = lab_config(board.library)
    size = len(bytes(config))
    spoilt = host.pack("config_part", size - 199 if offset is None else offset, total or size, length, [0xEE] * 200)
    status = send(board, host, config, parts=[*host.parts(config), spoilt])
    assert (status.config_stored, status.rejected_count) == (1, 0)


@pytest.mark.parametrize("offset", [2000, 2**31, 2**32 - 1])
def test_reading_beyond_the_end_gives_an_empty_part(working, offset):
    board, host = working
    board.run(12, host.pack("config_read", offset))
    part = host.newest("CONFIG_PART")
    assert (part.offset, part.length, part.total) == (offset, 0, len(bytes(lab_config(board.library))))


def test_a_power_cut_takes_the_motion_but_not_the_configuration(working):
    board, host = working
    board.run(2, host.command(c.COMMAND_ENABLE))
    assert board.answer.outputs.state == c.STATE_ENABLED
    board.tick(restart=c.RESTART_POWER)
    assert (board.answer.outputs.state, board.answer.outputs.faults) == (c.STATE_DISABLED, 0)
    board.run(30)
    assert host.listen()[-1].get_type() != "WELCOME"
    host.listen()
    board.run(30)
    assert host.listen() == [], "it has forgotten its host"


def test_a_restart_by_the_watchdog_is_reported_until_cleared(working):
    board, host = working
    restart(board, host, c.RESTART_WATCHDOG)
    assert (board.answer.outputs.state, board.answer.outputs.first_fault) == (c.STATE_FAULTED, c.FAULT_WATCHDOG)
    board.run(2, host.command(c.COMMAND_CLEAR_FAULTS))
    assert (board.answer.outputs.state, board.answer.outputs.faults) == (c.STATE_DISABLED, 0)


@pytest.mark.parametrize(("field", "value"), [("magic", 1), ("version", 1), ("length", 513), ("length", 2**32 - 1)])
def test_a_frame_that_is_none_is_rejected_and_no_tick_is_run(working, field, value):
    board, _ = working
    before = copy.copy(bytes(board.answer.outputs))
    kept = getattr(board.request, field)
    setattr(board.request, field, value)
    board.library.pil_tick()
    assert (board.answer.magic, board.answer.version, board.answer.length) == (c.FRAME_REJECTED, c.FRAME_VERSION, 0)
    assert bytes(board.answer.outputs) == before
    setattr(board.request, field, kept)
    board.request.magic = c.FRAME_REQUEST
    board.tick()


def test_what_could_not_be_stored_is_rejected_and_what_comes_meanwhile_waits(fresh_wire):
    """A board whose memory fails; it takes its time to say so."""
    wire, host = fresh_wire, fresh_wire.host
    wire.receive(host.hello())
    wire.tick(10)
    for part in host.parts(wire.config):
        wire.receive(part)
    wire.receive(host.store(wire.config) + host.command(c.COMMAND_DISABLE))
    spoilt = host.pack("config_part", 0, len(bytes(wire.config)), 4, [0xEE] * 200)
    assert not wire.to_store()
    wire.tick(3)
    assert wire.to_store()
    wire.receive(spoilt)
    wire.tick(20)
    assert wire.outputs.acknowledged_count == 0, "it waits behind the configuration"
    wire.stored(False)
    wire.tick(30)
    status = host.newest("BOARD_STATUS")
    assert (status.rejected_sequence, status.rejection, status.config_stored) == (1, c.REJECTION_CONFIG_BROKEN, 0)
    assert status.acknowledged_sequence == 2
    wire.receive(host.store(wire.config))
    wire.tick(3)
    assert wire.to_store(), "the part that came meanwhile was left out"


def test_a_name_may_take_all_its_bytes(library):
    wire = BareWire(library, BAUD, name=b"sixteen_letters_")
    wire.receive(wire.host.hello())
    wire.tick(5)
    assert wire.host.newest("WELCOME").board == "sixteen_letters_"
