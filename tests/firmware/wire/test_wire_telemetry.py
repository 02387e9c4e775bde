"""What the board says by itself: how often, how soon, and never more than the wire carries."""

from collections import Counter

import numpy as np
import pytest
from firmware_layout import c
from firmware_wire import BITS_PER_BYTE, BareWire, declare_wire

#: On the wire, with MAVLink's header and checksum and no zeros left out.
FRAME = 12
BYTES = {"ANGLES": 28 + FRAME, "JOINTS": 106 + FRAME, "BOARD_STATUS": 93 + FRAME}


def load_bytes_per_s(periods) -> float:
    every = {"ANGLES": periods.angles, "JOINTS": periods.joints, "BOARD_STATUS": periods.status}
    return sum(BYTES[kind] * c.TICKS_PER_S / every[kind] for kind in BYTES)


def test_the_lengths_are_the_dialects(fresh):
    _, host = fresh
    for kind, length in BYTES.items():
        assert getattr(host.dialect, f"MAVLink_{kind.lower()}_message").unpacker.size + FRAME == length


@pytest.mark.parametrize(
    ("baud", "angles", "joints", "status"),
    [
        (3_000_000, 1, 10, 20),
        (921_600, 1, 10, 20),
        (460_800, 2, 20, 20),
        (230_400, 4, 40, 20),
        (115_200, 9, 90, 36),
        (57_600, 17, 170, 68),
        (9_600, 102, 1020, 408),
        (900, 1000, 10000, 4000),
    ],
)
def test_telemetry_is_as_fast_as_four_fifths_of_the_wire_carry(library, baud, angles, joints, status):
    declare_wire(library)
    periods = library.wire_periods_at(baud)
    assert (periods.angles, periods.joints, periods.status) == (angles, joints, status)
    if angles < 1000:  # no slower than one a second
        assert load_bytes_per_s(periods) <= 0.8 * baud / BITS_PER_BYTE
    if 1 < angles < 1000:
        faster = type(periods)(angles - 1, 10 * (angles - 1), max(20, 4 * (angles - 1)))
        assert load_bytes_per_s(faster) > 0.8 * baud / BITS_PER_BYTE - 3, "less would have done"


@pytest.mark.parametrize("baud", [921_600, 230_400, 115_200, 57_600])
def test_a_second_of_telemetry(library, baud):
    wire = BareWire(library, baud)
    rng = np.random.default_rng(1)
    for record in (wire.outputs.angle_rad, wire.outputs.speed_rad_s, wire.outputs.duty, wire.outputs.reference_rad):
        record[:] = list(rng.normal(size=6))
    wire.receive(wire.host.hello())
    wire.tick(200)
    wire.host.listen()
    wire.tick(1000)
    bytes_sent = len(wire.sent)
    messages = wire.host.listen()
    counts = Counter(message.get_type() for message in messages)
    periods = library.wire_periods_at(baud)
    assert counts["ANGLES"] == pytest.approx(1000 / periods.angles, abs=1.5)
    assert counts["JOINTS"] == pytest.approx(1000 / periods.joints, abs=1.5)
    assert counts["BOARD_STATUS"] == pytest.approx(1000 / periods.status, abs=1.5)
    assert bytes_sent <= 0.8 * baud / BITS_PER_BYTE + BYTES["JOINTS"]
    angles = [message for message in messages if message.get_type() == "ANGLES"]
    waits = 0 if baud > 100_000 else 10_000 * BYTES["JOINTS"] / baud  # for a JOINTS before it, where that takes long
    assert np.abs(np.diff([message.tick for message in angles]) - periods.angles).max() <= waits
    assert angles[-1].angle_rad == list(wire.outputs.angle_rad)


def test_a_change_of_state_is_reported_in_its_own_tick(working):
    board, host = working
    board.run(37)
    host.listen()
    tick = board.request.tick
    board.run(3, host.command(c.COMMAND_ENABLE))
    first = next(message for message in host.listen() if message.get_type() == "BOARD_STATUS")
    assert (first.tick, first.state, first.acknowledged_sequence) == (tick, c.STATE_ENABLED, 1)


def test_moves_alone_ask_for_no_status_out_of_schedule(working):
    board, host = working
    board.run(3, host.command(c.COMMAND_ENABLE))
    host.listen()
    for _ in range(100):
        board.run(4, host.move())
    kinds = Counter(message.get_type() for message in host.listen())
    assert kinds["BOARD_STATUS"] == pytest.approx(20, abs=2)
    assert host.newest("BOARD_STATUS").acknowledged_count >= 95


def test_a_flood_of_rejected_commands_leaves_room_for_the_angles(working):
    board, host = working
    for _ in range(500):
        board.run(1, host.command(99))
    kinds = Counter(message.get_type() for message in host.listen())
    assert kinds["ANGLES"] >= 450
    assert 90 <= kinds["BOARD_STATUS"] <= 105


def test_a_flood_of_questions_does_not_choke_the_wire(working):
    board, host = working
    for _ in range(100):
        board.run(1, host.pack("timesync", 0, 1) * 3)
    for _ in range(20):
        board.run(1, host.pack("config_read", 0) * 4)
    board.run(50)
    host.listen()
    board.run(100)
    kinds = Counter(message.get_type() for message in host.listen())
    assert (kinds["ANGLES"], kinds["JOINTS"]) == (100, 10)


def test_a_telemetry_message_says_what_the_core_said(working):
    board, host = working
    board.run(3, host.command(c.COMMAND_ENABLE))
    seen = {}
    for _ in range(60):
        board.run(1, host.move(0.3))
        outputs = c.core_outputs.from_buffer_copy(bytes(board.answer.outputs))
        seen[outputs.tick] = outputs
        for message in host.listen():
            kind, core = message.get_type(), seen.get(getattr(message, "tick", None))
            if core is None:
                continue
            if kind == "ANGLES":
                assert message.angle_rad == list(core.angle_rad)
            elif kind == "JOINTS":
                for field in ("speed_rad_s", "reference_rad", "reference_rad_s", "duty", "limited"):
                    assert list(getattr(message, field)) == list(getattr(core, field)), field
            elif kind == "BOARD_STATUS":
                for field in ("state", "faults", "first_fault", "first_joint", "acknowledged_sequence", "rejection"):
                    assert getattr(message, field) == getattr(core, field), field
                assert message.supply_mv == 12000
    assert host.newest("JOINTS").duty != [0.0] * 6


def test_faults_are_reported_with_their_joint(working):
    board, host = working
    board.request.counts[4] = 65535
    board.run(30)
    status = host.newest("BOARD_STATUS")
    assert (status.first_fault, status.first_joint) == (c.FAULT_POT_OPEN, 4)
    assert list(status.joint_faults) == [0, 0, 0, 0, 1 << c.FAULT_POT_OPEN, 0]


def test_no_more_goes_out_in_a_tick_than_the_wire_carries(working):
    board, host = working
    sizes = []
    for k in range(500):
        board.run(1, host.pack("config_read", 0) if k % 50 == 0 else b"")
        sizes.append(board.answer.length)
    assert max(sizes) <= 93
    assert sum(sizes) <= 500 * 92.16 + 93
