"""The bytes of Feetech's protocol 0: instructions to servos, and the status packets they answer with.

A packet is ``FF FF id length code parameters checksum``: length counts what follows it, code is the instruction or, in an
answer, the error bits; the checksum is the inverted sum of everything between header and checksum. Words are little-endian,
negative ones sign and magnitude. Source: Feetech, "STS3215 communication protocol" and memory table of the STS series;
docs/reference/feetech.md has both.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from enum import IntEnum
from typing import NamedTuple

HEADER = b"\xff\xff"
BROADCAST = 0xFE
#: Length of an answer without parameters, bytes: header, id, length, error, checksum.
SHORTEST = 6
_LONGEST = 250


class Instruction(IntEnum):
    """What a servo is asked to do."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83


class StatusPacket(NamedTuple):
    """A servo's answer."""

    id: int  #: which servo
    error: int  #: its error bits
    parameters: bytes  #: what it was asked for


def checksum(body: bytes) -> int:
    """Return the checksum of a packet's bytes between header and checksum."""
    return ~sum(body) & 0xFF


def packet(id: int, code: int, parameters: bytes = b"") -> bytes:
    """Return a packet: ``code`` is an instruction, or the error bits of an answer."""
    body = bytes((id, len(parameters) + 2, code)) + parameters
    return HEADER + body + bytes((checksum(body),))


def sync_read(address: int, count: int, ids: Iterable[int]) -> bytes:
    """Return the instruction to all servos of ``ids`` to answer, each with ``count`` bytes from an address."""
    return packet(BROADCAST, Instruction.SYNC_READ, bytes((address, count, *ids)))


def sync_write(address: int, values: Mapping[int, bytes]) -> bytes:
    """Return the instruction that writes to each servo its own bytes, equally many, from an address on; nobody answers."""
    (count,) = {len(each) for each in values.values()}
    data = b"".join(bytes((id, *each)) for id, each in values.items())
    return packet(BROADCAST, Instruction.SYNC_WRITE, bytes((address, count)) + data)


def signed(word: int, bit: int) -> int:
    """Return the number of a sign-and-magnitude word whose sign is this bit."""
    magnitude = word & ((1 << bit) - 1)
    return -magnitude if word >> bit & 1 else magnitude


def sign_magnitude(value: int, bit: int) -> int:
    """Return the sign-and-magnitude word of a number; its size must be below ``1 << bit``."""
    return value if value >= 0 else -value | 1 << bit


class PacketReader:
    """Finds packets in a stream of bytes, over whatever is not one.

    Attributes:
        broken: packets whose checksum was wrong.
        skipped: bytes that belonged to no packet.
    """

    def __init__(self) -> None:
        self._data = bytearray()
        self.broken = self.skipped = 0

    def take(self, data: bytes) -> list[StatusPacket]:
        """Return the packets that are complete with these bytes."""
        self._data += data
        found: list[StatusPacket] = []
        while True:
            self._skip(self._start())
            if len(self._data) < SHORTEST:
                return found
            length = self._data[3]
            if not 2 <= length <= _LONGEST or self._data[2] == 0xFF:
                self._skip(1)
                continue
            if len(self._data) < length + 4:
                return found
            body = bytes(self._data[2 : length + 3])
            if checksum(body) != self._data[length + 3]:
                self.broken += 1
                self._skip(1)
                continue
            found.append(StatusPacket(body[0], body[2], body[3:]))
            del self._data[: length + 4]

    def clear(self) -> None:
        """Drop an incomplete packet."""
        self.skipped += len(self._data)
        self._data.clear()

    def _start(self) -> int:
        """Return how many bytes come before the next header."""
        at = self._data.find(HEADER)
        if at >= 0:
            return at
        return len(self._data) - self._data.endswith(HEADER[:1])

    def _skip(self, count: int) -> None:
        self.skipped += count
        del self._data[:count]
