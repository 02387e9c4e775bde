"""The Nucleo's wire: DMA into a ring, DMA out in pieces, and bytes nobody took in time."""

import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from stm32f4_build import COMPILERS, fresh
from stm32f4_emulator import RAM
from stm32f4_registers import NAMED

RING = 1024
PIECE = 256
BYTES, COUNT = RAM + 64, RAM + 2048


def started(compiler):
    emulator = fresh(compiler)
    emulator.power_up("clock_start", "pins_start", "uart_start")
    return emulator


@pytest.fixture(params=COMPILERS)
def emulator(request):
    return started(request.param)


def take(emulator, room: int = 128) -> tuple[bytes, int]:
    """Take what came in, as a pass of the main loop does; return it and how many bytes were lost."""
    emulator.uc.mem_write(COUNT, bytes(4))
    length = emulator.call("uart_receive", BYTES, room, COUNT)
    return bytes(emulator.uc.mem_read(BYTES, length)), struct.unpack("<I", emulator.uc.mem_read(COUNT, 4))[0]


def give(emulator, data: bytes) -> int:
    emulator.uc.mem_write(BYTES, data)
    return emulator.call("uart_send", BYTES, len(data))


def test_eight_bits_no_parity_one_stop_and_the_streams_of_the_manuals_table(emulator):
    chip = emulator.chip
    assert chip["USART2.CR1"] == 1 << 13 | 1 << 3 | 1 << 2
    assert chip["USART2.CR2"] == 0
    assert chip["USART2.CR3"] == 1 << 7 | 1 << 6
    assert chip["USART2.BRR"] == 49
    assert chip["DMA1.S5CR"] == 4 << 25 | 2 << 16 | 1 << 10 | 1 << 8 | 1  # channel 4, high, memory counts, circle, on
    assert chip["DMA1.S5PAR"] == 0x40004404
    assert chip.first("DMA1.S5CR", 1) < chip.first("USART2.CR1")  # it listens once somebody takes the bytes


@pytest.mark.parametrize("compiler", COMPILERS)
@given(pieces=st.lists(st.tuples(st.binary(max_size=700), st.integers(1, 900)), max_size=12))
@settings(max_examples=15)
def test_what_comes_in_goes_out_in_order(compiler, pieces):
    emulator = started(compiler)
    waiting = b""
    for data, room in pieces:
        data = data[: RING - 1 - len(waiting)]
        emulator.chip.receive(data)
        waiting += data
        got, lost = take(emulator, room)
        assert (got, lost) == (waiting[:room], 0)
        waiting = waiting[room:]
    assert emulator.chip.wrongs == []


def test_a_ring_that_came_round_is_reported_and_read_on_afresh(emulator):
    emulator.chip.receive(b"a" * 700)
    assert take(emulator, 1000) == (b"a" * 700, 0)
    emulator.chip.receive(b"b" * (RING + 100))
    assert take(emulator, 1000) == (b"", RING)
    emulator.chip.receive(b"next")
    assert take(emulator, 1000) == (b"next", 0)


def test_a_ring_just_full_is_lost_as_it_cannot_be_distinguished_from_an_empty_one(emulator):
    emulator.chip.receive(bytes(RING))
    assert take(emulator, 2000) == (b"", RING)


def test_a_wrap_between_two_passes_is_not_taken_for_a_loss(emulator):
    for k in range(40):
        data = bytes([k]) * 92
        emulator.chip.receive(data)
        assert take(emulator) == (data, 0)


def test_a_wrap_just_while_the_ring_is_looked_at_is_no_loss(emulator):
    """Bytes come in between the reading of the flag and that of the position: the flag seen next time is an old one."""
    chip, late = emulator.chip, [b"b" * 100]
    chip.receive(b"a" * 1000)
    assert take(emulator, 1000) == (b"a" * 1000, 0)
    read = chip.read

    def read_late(address, size):
        value = read(address, size)
        if address == NAMED["DMA1.HISR"] and late:
            chip.receive(late.pop())
        return value

    chip.read = read_late
    assert take(emulator, 1000) == (b"b" * 100, 0)
    chip.receive(b"c" * 50)
    assert take(emulator, 1000) == (b"c" * 50, 0)


def test_a_byte_the_receiver_lost_is_counted_and_the_flag_cleared(emulator):
    emulator.chip["USART2.SR"] = 1 << 3
    assert take(emulator) == (b"", 1)
    assert take(emulator) == (b"", 0)


def test_a_piece_goes_out_and_the_next_waits_for_its_end(emulator):
    chip = emulator.chip
    assert give(emulator, b"first") == 5
    assert (
        chip["DMA1.S6CR"] == 4 << 25 | 2 << 16 | 1 << 10 | 1 << 6 | 1
    )  # channel 4, high, memory counts, from memory, on
    assert chip.send(3) == b"fir"
    assert give(emulator, b"second") == 0
    assert chip.send(92) == b"st"
    assert give(emulator, b"second") == 6
    assert chip.send(92) == b"second"
    assert chip.wrongs == []


def test_nothing_to_send_starts_nothing(emulator):
    assert give(emulator, b"") == 0
    assert emulator.chip.written("DMA1.S6CR") == []


def test_a_long_message_is_taken_in_parts(emulator):
    data = bytes(range(256)) + b"the rest"
    assert give(emulator, data) == PIECE
    assert emulator.chip.send(1000) == data[:PIECE]
    assert give(emulator, data[PIECE:]) == 8
    assert emulator.chip.send(1000) == b"the rest"
