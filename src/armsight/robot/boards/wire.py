"""Messages over a link: the generated dialect packs, parses and checks them; here they are sent and searched for.

A frame that fails its check is not thrown away whole: the search goes on at the byte after its false beginning, so that
one disturbed length does not swallow the frames behind it.
"""

from __future__ import annotations

import struct
from typing import Any, NamedTuple, Protocol, cast

from armsight.firmware import dialect
from armsight.robot.boards.link import Link

_BAD = "BAD_DATA"
_COUNTS = 256
_MARKERS = (0xFD, 0xFE)  # MAVLink 2, and 1, which the parser knows as well
_HEAD = struct.Struct("<BBBBBBBHB")  # of MAVLink 2: marker, length, flags twice, number, system, component, kind
_CHECK = struct.Struct("<H")
_FRAME = _HEAD.size + _CHECK.size
#: The board's MAVLink system and component.
BOARD_SYSTEM, BOARD_COMPONENT = 1, 1


class Message(Protocol):
    """A message as the generated dialect gives it: its fields are attributes."""

    def get_type(self) -> str:
        """Return the message's name."""

    def __getattr__(self, name: str) -> Any: ...  # noqa: ANN401


class _Frame:
    """A complete message, with the attributes of the dialect's own."""

    def __init__(self, name: str, fields: dict[str, Any]) -> None:
        self.__dict__ = fields
        self.get_type = lambda: name


class _Layout(NamedTuple):
    """How a kind of message lies in its payload."""

    name: str  #: of the message
    extra: bytes  #: what its checksum counts beside its bytes
    unpacker: struct.Struct  #: of its payload
    fields: tuple[tuple[str, int | slice], ...]  #: each field's name, and its number or slice of what is unpacked

    @classmethod
    def of(cls, kind: Any) -> _Layout:  # noqa: ANN401 - a class of the generated dialect
        """Return the layout of a kind of message."""
        at, fields = 0, list[tuple[str, int | slice]]()
        for name, length in zip(kind.ordered_fieldnames, kind.lengths, strict=True):
            fields.append((name, at if length == 1 else slice(at, at + length)))
            at += length
        return cls(kind.msgname, bytes([kind.crc_extra]), kind.unpacker, tuple(fields))


class Wire:
    """Sends and receives the dialect's messages over a link; WELCOME gives the ``session`` whose commands it sends.

    ``heard``: whether any byte came; ``broken``: parts that are no message; ``lost``: messages missing in the count of
    frames.
    """

    def __init__(self, link: Link) -> None:
        self._link = link
        spoken = dialect()
        self._mav, self._crc = spoken.MAVLink(link), spoken.x25crc
        #: Of the kinds that are numbers alone; the parser takes the others, a few in a session.
        self._layouts = {
            number: _Layout.of(kind)
            for number, kind in spoken.mavlink_map.items()
            if "s" not in kind.unpacker.format and "c" not in kind.unpacker.format
        }
        self._kinds = frozenset(spoken.mavlink_map)
        self._mav.robust_parsing = True
        self.close = link.close
        self.heard = False
        self.session = 0
        self.broken = self.lost = 0
        self._count: int | None = None

    def send(self, kind: str, *values: object) -> None:
        """Send a message of the dialect by its name in small letters, with the values of its fields in order."""
        getattr(self._mav, f"{kind}_send")(*values)

    def receive(self, wait_s: float) -> list[Message]:
        """Let ``wait_s`` pass, s, and return the complete messages that came."""
        came = self._link.read(wait_s)
        self.heard = self.heard or bool(came)
        mav, found = self._mav, list[Message]()
        mav.buf += came
        while True:
            data = bytes(mav.buf[mav.buf_index :])
            mav.buf, mav.buf_index = bytearray(), 0
            message = mav.parse_char(data[self._frames(data, found) :])
            if message is None:
                return found
            if message.get_type() == _BAD:
                self.broken += 1
                if message.data[0] in _MARKERS:
                    # A false frame goes back into the parser's buffer, without its first byte.
                    mav.buf, mav.buf_index = bytearray(message.data[1:]) + mav.buf[mav.buf_index :], 0
            # Of a kind that nobody knows nothing says what its CRC begins with: it is left out, and missed in the count.
            elif message.get_msgId() in self._kinds:
                self._count_frame(message.get_seq())
                found.append(message)

    def _frames(self, data: bytes, found: list[Message]) -> int:
        """Append the frames of numbers at the beginning of the data to ``found``; return where another byte begins.

        The parser does the same in ten times as long, and there are more than a thousand a second.
        """
        at, whole = 0, len(data)
        while whole - at >= _FRAME:
            marker, length, flags, _, number, _, _, low, high = _HEAD.unpack_from(data, at)
            end = at + _HEAD.size + length
            layout = self._layouts.get(low | high << 16)
            if marker != _MARKERS[0] or flags or layout is None or end + _CHECK.size > whole:
                break
            if self._crc(data[at + 1 : end] + layout.extra).crc != _CHECK.unpack_from(data, end)[0]:
                break
            # Zeros at a payload's end are not sent; what is longer than known is of a newer dialect.
            values = layout.unpacker.unpack_from(data[at + _HEAD.size : end].ljust(layout.unpacker.size, b"\0"))
            fields = {
                name: values[where] if isinstance(where, int) else list(values[where]) for name, where in layout.fields
            }
            self._count_frame(number)
            found.append(cast(Message, _Frame(layout.name, fields)))
            at = end + _CHECK.size
        return at

    def _count_frame(self, number: int) -> None:
        if self._count is not None:
            self.lost += (number - self._count) % _COUNTS
        self._count = (number + 1) % _COUNTS
