"""What is read off a wire is what the dialect's own parser finds, whatever became of the bytes."""

import random

import pytest

from armsight.firmware import dialect
from armsight.robot.boards.wire import Wire


class Pipe:
    """A link that hands out what is put into it."""

    def __init__(self):
        self.waiting = b""

    def read(self, wait_s):
        data, self.waiting = self.waiting, b""
        return data

    def close(self):
        pass


def reported(message):
    kinds = {kind.msgname: kind for kind in dialect().mavlink_map.values()}
    name = message.get_type()
    if name not in kinds:
        return name, bytes(message.get_msgbuf())
    return name, *(getattr(message, field) for field in kinds[name].fieldnames)


def stream(rng, disturbed, count=100):
    """Frames of all kinds a board sends most; some missing, some with a bit flipped, some with noise before them."""
    spoken = dialect()
    mav, out = spoken.MAVLink(None), b""
    for tick in range(count):
        angles = [rng.uniform(-3, 3) if rng.random() < 0.8 else 0.0 for _ in range(6)]
        message = spoken.MAVLink_angles_message(tick, angles)
        if rng.random() < 0.2:
            message = spoken.MAVLink_joints_message(tick, angles, angles, angles, angles, [0] * 6)
        elif rng.random() < 0.1:  # its array lies between other numbers
            message = spoken.MAVLink_board_status_message(tick, 3, 0, [1, 0, 2, 0, 0, 4], *range(15))
        elif rng.random() < 0.1:  # its fields are sent in another order
            message = spoken.MAVLink_heartbeat_message(2, 8, 128, 3, 4, 3)
        elif rng.random() < 0.1:  # text is left to the parser
            message = spoken.MAVLink_statustext_message(4, b"joint 1")
        frame = bytearray(message.pack(mav))
        mav.seq = (mav.seq + 1) % 256
        if rng.random() < disturbed:
            frame[rng.randrange(len(frame))] ^= 1 << rng.randrange(8)
        if rng.random() < disturbed / 2:
            frame = rng.randbytes(rng.randrange(30)) + frame
        if rng.random() > 0.03:
            out += frame
    return out


@pytest.mark.parametrize("disturbed", [0.0, 0.1, 0.5])
def test_a_wire_hears_what_the_parser_hears(monkeypatch, disturbed):
    for seed in range(8):
        rng = random.Random(seed)
        sent, (fast, slow) = stream(rng, disturbed), (Wire(Pipe()), Wire(Pipe()))
        monkeypatch.setattr(slow, "_frames", lambda data, found: 0)  # leaves all to the parser
        while sent:
            count = rng.choice([1, 5, 40, 92, 368])
            fast._link.waiting = slow._link.waiting = sent[:count]
            sent = sent[count:]
            assert list(map(reported, fast.receive(0.0))) == list(map(reported, slow.receive(0.0)))
            assert (fast.heard, fast.broken, fast.lost) == (slow.heard, slow.broken, slow.lost)
        assert fast.broken == 0 or disturbed


def test_a_frame_whose_kind_nobody_knows_counts_as_missing():
    spoken = dialect()
    mav, wire = spoken.MAVLink(None), Wire(Pipe())
    frames = []
    for tick in range(3):
        frames.append(bytearray(spoken.MAVLink_angles_message(tick, [0.1] * 6).pack(mav)))
        mav.seq += 1
    frames[1][8] ^= 8  # in the middle of the message's number: what its CRC begins with is not known
    wire._link.waiting = b"".join(map(bytes, frames))
    assert [message.tick for message in wire.receive(0.0)] == [0, 2]
    assert (wire.broken, wire.lost) == (0, 1)
