"""Tools that know MAVLink's common messages only: pymavlink's mavutil over a port, as its users write it.

Time is real here, so nothing is asserted on it: whatever is waited for is waited for until it comes.
"""

import sys

import numpy as np
import pytest
from board_rigs import PtyBoard

from armsight.firmware import dialect
from armsight.robot.board_registry import open_board
from armsight.robot.boards.codes import BoardState, Rejection

mavutil = pytest.importorskip("pymavlink.mavutil", reason="needs pymavlink: pip install 'armsight[test]'")
pytestmark = [
    pytest.mark.real_time,
    pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo-terminals"),
]
ARM, TERMINATE, STORAGE, REBOOT, INTERVAL = 400, 185, 245, 246, 511
ACCEPTED, DENIED, UNSUPPORTED = 0, 2, 3
OURS = (
    *("heartbeat", "sys_status", "statustext", "command_long", "command_ack", "timesync"),
    *("param_request_list", "param_request_read", "param_set", "param_value"),
)


@pytest.fixture
def cable():
    board = PtyBoard()
    yield board
    board.close()


@pytest.fixture
def tool(cable):
    """A connection as ground control's: it has heard the board and says that it is there."""
    connection = mavutil.mavlink_connection(cable.port, baud=921600, dialect="common", source_system=255)
    assert connection.wait_heartbeat(timeout=60) is not None
    connection.mav.heartbeat_send(6, 8, 0, 0, 0)
    yield connection
    connection.close()


def heard(tool, kind, holds=lambda message: True):
    """The next message of a kind that is as it must be."""
    while True:
        message = tool.recv_match(type=kind, blocking=True, timeout=60)
        assert message is not None, kind
        if holds(message):
            return message


def ordered(tool, command, *params, system=1):
    """The result of a command."""
    tool.mav.command_long_send(system, 1, command, 0, *params, *[0] * (7 - len(params)))
    return heard(tool, "COMMAND_ACK", lambda message: message.command == command).result


def put(tool, name, value):
    """The value a parameter has after it was set."""
    tool.mav.param_set_send(1, 1, name.encode(), value, 9)
    return heard(tool, "PARAM_VALUE", lambda message: message.param_id == name).param_value


@pytest.mark.parametrize("name", OURS)
def test_our_common_messages_are_mavlinks(name):
    from pymavlink.dialects.v20 import common

    theirs, ours = (getattr(each, f"MAVLink_{name}_message") for each in (common, dialect()))
    assert (ours.id, ours.crc_extra) == (theirs.id, theirs.crc_extra)
    assert theirs.fieldnames[: len(ours.fieldnames)] == ours.fieldnames


def test_a_tool_reads_and_sets_every_parameter(tool):
    tool.mav.param_request_list_send(1, 1)
    params, count = {}, 1
    while len(params) < count:
        message = heard(tool, "PARAM_VALUE")
        params[message.param_id], count = message.param_value, message.param_count
    assert count == 117
    assert params["J3_KP"] == params["J1_KP"] > 1.0
    assert params["J6_CURRENT_MA"] == 1600
    for name, value in params.items():
        new = value - 1 if name.endswith(("_MA", "_MV", "_TICKS")) else np.float32(0.99 * value + 0.001)
        assert put(tool, name, new) == new, name
    tool.mav.param_request_read_send(1, 1, b"J6_MAX", -1)
    read = heard(tool, "PARAM_VALUE", lambda message: message.param_id == "J6_MAX")
    assert read.param_value == pytest.approx(0.99 * params["J6_MAX"] + 0.001)
    for name, wrong in (("J1_KP", 1000.0), ("J1_MIN", 3.0), ("J1_CURRENT_MA", 0.5), ("J1_SPEED", np.nan)):
        assert put(tool, name, wrong) != wrong
    tool.mav.param_set_send(1, 1, b"J1_KP", -1.0, 9)
    assert "rejected: a number is outside its range" in heard(tool, "STATUSTEXT").text
    assert ordered(tool, STORAGE, 1) == ACCEPTED
    assert ordered(tool, REBOOT, 1) == ACCEPTED
    tool.mav.param_request_read_send(1, 1, b"J2_MAX", -1)
    kept = heard(tool, "PARAM_VALUE", lambda message: message.param_id == "J2_MAX").param_value
    assert kept == pytest.approx(0.99 * params["J2_MAX"] + 0.001)


def test_a_tool_arms_and_hears_of_faults_as_text(cable, tool):
    assert ordered(tool, ARM, np.nan) == ordered(tool, ARM, 2) == DENIED
    assert ordered(tool, ARM, 1) == ACCEPTED
    assert "host silent" in heard(tool, "STATUSTEXT").text  # it commands no motion: the arm is held
    beat = heard(tool, "HEARTBEAT", lambda message: message.base_mode & 128)
    assert beat.custom_mode == BoardState.HOLDING
    assert heard(tool, "SYS_STATUS").voltage_battery == 12000
    assert ordered(tool, ARM, 0) == ACCEPTED
    assert heard(tool, "HEARTBEAT", lambda message: not message.base_mode & 128).custom_mode == BoardState.DISABLED
    assert ordered(tool, TERMINATE, 1) == ACCEPTED
    assert "emergency stop" in heard(tool, "STATUSTEXT").text
    assert ordered(tool, ARM, 1) == DENIED
    assert ordered(tool, TERMINATE, 0) == ACCEPTED
    assert ordered(tool, INTERVAL, 30, 1e5) == UNSUPPORTED
    tool.mav.timesync_send(0, 77)
    assert heard(tool, "TIMESYNC", lambda message: message.ts1 == 77).tc1 > 0


def test_a_tool_neither_moves_an_arm_that_has_a_host_nor_answers_for_another_system(working_host):
    board, raw, link = working_host
    board.enable()
    raw.command_long_send(1, 1, ARM, 0, 0, 0, 0, 0, 0, 0, 0)
    raw.command_long_send(7, 1, TERMINATE, 0, 1, 0, 0, 0, 0, 0, 0)
    for name in ("ANGLES", "JOINTS"):
        raw.command_long_send(1, 1, INTERVAL, 0, getattr(dialect(), f"MAVLINK_MSG_ID_{name}"), -1, 0, 0, 0, 0, 0)
    link.step(20)
    assert len(board.receive(0.02).t_s) >= 20  # nor does it silence what its host needs
    assert link.answer["outputs"]["state"] == BoardState.ENABLED
    raw.command_long_send(1, 1, TERMINATE, 0, 1, 0, 0, 0, 0, 0, 0)
    link.step(20)
    assert link.answer["outputs"]["state"] == BoardState.STOPPED  # anybody may stop it
    assert board.status.rejection == Rejection.NONE


@pytest.fixture
def working_host():
    """A board with a host of ours, and the voice of a foreign system on the same wire."""
    from board_rigs import host_board

    board, link, _ = host_board()
    yield board, dialect().MAVLink(link, srcSystem=255), link
    board.close()


def test_a_board_that_a_tool_has_used_takes_a_host_again(cable, tool):
    assert ordered(tool, ARM, 1) == ACCEPTED
    tool.close()
    with open_board(f"serial:{cable.port}") as board:
        assert board.welcome.board == "pil"
