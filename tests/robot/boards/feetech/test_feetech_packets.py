"""The bytes of the servo bus: worked examples, the maker's SDK as oracle, and a stream with anything in it."""

import hypothesis.strategies as st
import pytest
from hypothesis import given, settings

from armsight.robot.boards.feetech.packets import (
    Instruction,
    PacketReader,
    packet,
    sign_magnitude,
    signed,
    sync_read,
    sync_write,
)
from armsight.robot.boards.feetech.registers import GOAL_POSITION, HOMING_OFFSET, LOAD, POSITION, STATE_BYTES


class Port:
    """The SDK's port, which keeps what is written and answers what it is given."""

    is_using = False

    def __init__(self, answer=b""):
        self.written, self.answer = b"", answer

    def clearPort(self):
        pass

    def writePort(self, data):
        self.written += bytes(data)
        return len(data)

    def readPort(self, length):
        data, self.answer = self.answer[:length], self.answer[length:]
        return data

    def setPacketTimeout(self, length):
        pass

    def isPacketTimeout(self):
        return not self.answer


@pytest.fixture(scope="module")
def sdk():
    """Feetech's own SDK."""
    return pytest.importorskip("scservo_sdk", reason="pip install feetech-servo-sdk")


def test_the_ping_of_the_manual():
    assert packet(1, Instruction.PING) == bytes((0xFF, 0xFF, 1, 2, 1, 0xFB))


def test_instructions_are_the_sdks(sdk):
    handler, port = sdk.PacketHandler(0), Port()
    handler.ping(port, 5)
    assert port.written == packet(5, Instruction.PING)
    port = Port()
    handler.write2ByteTxOnly(port, 3, HOMING_OFFSET.address, sign_magnitude(-1365, 11))
    assert port.written == packet(3, Instruction.WRITE, bytes((31,)) + HOMING_OFFSET.encode(-1365))
    port = Port()
    reader = sdk.GroupSyncRead(port, handler, POSITION.address, STATE_BYTES)
    for servo in (1, 2, 6):
        reader.addParam(servo)
    reader.txPacket()
    assert port.written == sync_read(POSITION.address, STATE_BYTES, (1, 2, 6))
    port = Port()
    goals = {1: 2048, 4: 1000}
    writer = sdk.GroupSyncWrite(port, handler, GOAL_POSITION.address, 2)
    for servo, goal in goals.items():
        writer.addParam(servo, [goal & 0xFF, goal >> 8])
    writer.txPacket()
    assert port.written == sync_write(
        GOAL_POSITION.address, {servo: GOAL_POSITION.encode(goal) for servo, goal in goals.items()}
    )


@pytest.mark.parametrize("count", [0, 40, 2047, 4095])
def test_answers_are_read_as_the_sdk_reads_them(sdk, count):
    answer = packet(2, 0, count.to_bytes(2, "little"))
    value, result, error = sdk.PacketHandler(0).read2ByteTxRx(Port(answer), 2, POSITION.address)
    assert (result, error) == (sdk.COMM_SUCCESS, 0)
    (ours,) = PacketReader().take(answer)
    assert (ours.id, ours.error, POSITION.decode(ours.parameters)) == (2, 0, value)


@pytest.mark.parametrize(
    ("value", "bit", "word"), [(0, 11, 0), (1365, 11, 1365), (-1365, 11, 1365 | 2048), (-3, 15, 32771)]
)
def test_signs_stand_in_a_bit_as_in_the_sdk(sdk, value, bit, word):
    assert sign_magnitude(value, bit) == word == sdk.SCS_TOSCS(value, bit)
    assert signed(word, bit) == value == sdk.SCS_TOHOST(word, bit)


@pytest.mark.parametrize(("register", "value"), [(HOMING_OFFSET, 2048), (HOMING_OFFSET, -2048), (LOAD, 1024)])
def test_what_does_not_fit_a_register_is_rejected(register, value):
    with pytest.raises(OverflowError):
        register.encode(value)


def test_load_has_a_sign_of_its_own():
    assert LOAD.decode((1024 | 300).to_bytes(2, "little")) == -300


servos = st.integers(0, 252)
answers = st.tuples(servos, st.integers(0, 0x7F), st.binary(max_size=20))


@settings(deadline=None, max_examples=60)
@given(st.lists(answers, max_size=6), st.binary(max_size=12).filter(lambda noise: 0xFF not in noise), st.integers(1, 9))
def test_packets_are_found_whatever_comes_between_them_and_however_it_is_cut(packets, noise, size):
    stream = b"".join(noise + packet(*each) for each in packets)
    reader, found = PacketReader(), []
    for at in range(0, len(stream), size):
        found += reader.take(stream[at : at + size])
    assert [tuple(each) for each in found] == packets
    assert reader.broken == 0
    assert reader.skipped == len(noise) * len(packets)


@settings(deadline=None, max_examples=60)
@given(answers, st.data())
def test_a_changed_byte_is_never_read_as_the_packet(one, data):
    text = bytearray(packet(*one))
    at = data.draw(st.integers(2, len(text) - 1))
    text[at] ^= data.draw(st.integers(1, 255))
    assert all(tuple(each) != one for each in PacketReader().take(bytes(text)))


@settings(deadline=None, max_examples=60)
@given(st.binary(max_size=200))
def test_noise_raises_nothing(noise):
    PacketReader().take(noise)
