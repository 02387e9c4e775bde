"""Messages over a link: the generated dialect packs, parses and checks them; here they are sent and searched for.

A frame that fails its check is not thrown away whole: the search goes on at the byte after its false beginning, so that
one disturbed length does not swallow the frames behind it.
"""

from __future__ import annotations

from typing import Any, Protocol

from armsight.firmware import dialect
from armsight.robot.boards.link import Link

_BAD = "BAD_DATA"
_COUNTS = 256
_MARKERS = (0xFD, 0xFE)  # MAVLink 2, and 1, which the parser knows as well


class Message(Protocol):
    """A message as the generated dialect gives it: its fields are attributes."""

    def get_type(self) -> str:
        """Return the message's name."""
        ...

    def __getattr__(self, name: str) -> Any: ...  # noqa: ANN401


class Wire:
    """Sends and receives the dialect's messages over a link.

    Attributes:
        heard: whether any byte came at all.
        broken: places in what came that are no message.
        lost: messages that are missing in the count of the frames.
    """

    def __init__(self, link: Link) -> None:
        self._link = link
        self._mav = dialect().MAVLink(link)
        self._mav.robust_parsing = True
        self._close = link.close
        self.heard = False
        self.broken = self.lost = 0
        self._count: int | None = None

    def send(self, kind: str, *fields: object) -> None:
        """Send a message of this kind (lower case) with its fields in the order of the dialect."""
        getattr(self._mav, f"{kind}_send")(*fields)

    def receive(self, wait_s: float) -> list[Message]:
        """Let ``wait_s`` pass and return the whole messages that came."""
        data = self._link.read(wait_s)
        self.heard = self.heard or bool(data)
        found: list[Message] = []
        message = self._mav.parse_char(data)
        while message is not None:
            if message.get_type() == _BAD:
                self.broken += 1
                if message.data[0] in _MARKERS:
                    self._search_on(message.data)
            else:
                self._count_frame(message.get_seq())
                found.append(message)
            message = self._mav.parse_char(b"")
        return found

    def close(self) -> None:
        """Let go of the link."""
        self._close()

    def _count_frame(self, number: int) -> None:
        if self._count is not None:
            self.lost += (number - self._count) % _COUNTS
        self._count = (number + 1) % _COUNTS

    def _search_on(self, false_frame: bytes) -> None:
        """Put a false frame back into the parser's buffer, without its first byte."""
        mav = self._mav
        mav.buf = bytearray(false_frame[1:]) + mav.buf[mav.buf_index :]
        mav.buf_index = 0
