"""JSON lines over the network: one object a line, ``kind`` says what it is of, the other keys are those of the datum.

``json+tcp:PORT`` listens: every reader that connects is sent each datum from then on. ``json+udp:HOST:PORT`` sends one
datagram a datum. A TCP reader that is too slow is not waited for: of what waits for it the oldest lines are dropped.
"""

from __future__ import annotations

import json
import socket
from collections import deque

from armsight.app.stream.datum import Published, json_text
from armsight.app.stream.sink import Sink
from armsight.files import as_input_error
from armsight.loop.running.data import Datum, EventDatum, JointsDatum, NoteDatum, ShotDatum

#: Lines that may wait for one reader.
_WAITING = 256
#: A datagram holds no more, bytes.
_DATAGRAM = 60_000
_KINDS = {ShotDatum: "shot", JointsDatum: "joints", EventDatum: "event", NoteDatum: "log"}


def json_line(datum: Datum, published: Published) -> bytes:
    """Return a datum as one line of JSON."""
    found = {"kind": _KINDS[type(datum)]} | ({"t_s": datum.time_s} if isinstance(datum, EventDatum) else {})
    return json_text(found | datum.to_json(published.body)) + b"\n"


class _Connected:
    def __init__(self, connection: socket.socket) -> None:
        connection.setblocking(False)
        self.connection = connection
        self.waiting: deque[bytes] = deque()
        self.rest = b""  # of the line that is being sent: it must be completed

    def send(self) -> bool:
        """Send as much as the reader takes; return False once it is gone."""
        try:
            while self.rest or self.waiting:
                self.rest = self.rest or self.waiting.popleft()
                self.rest = self.rest[self.connection.send(self.rest) :]
        except BlockingIOError:
            return True
        except OSError:
            return False
        return True


class TcpSink(Sink):
    """Sends bytes to every reader that has connected."""

    kind = "json+tcp"

    def __init__(self, published: Published, host: str, port: int) -> None:
        super().__init__(images=False)
        self.published = published
        with as_input_error(f"--stream {self.kind}:{port}: cannot listen there"):
            self._listener = socket.create_server((host, port))
        self._listener.setblocking(False)
        self._readers: list[_Connected] = []

    @property
    def port(self) -> int:
        """The port that it listens on."""
        return int(self._listener.getsockname()[1])

    def encoded(self, datum: Datum) -> list[bytes]:
        """Return a datum as the messages that are sent, each whole or not at all."""
        return [json_line(datum, self.published)]

    def write(self, datum: Datum) -> None:
        """Send a datum to every reader."""
        self.tick()
        if not self._readers:
            return
        for data in self.encoded(datum):
            for reader in self._readers:
                if len(reader.waiting) >= _WAITING:
                    reader.waiting.popleft()
                    self.dropped += 1
                reader.waiting.append(data)
        self._send()

    def tick(self) -> None:
        """Accept new readers, and send what waits."""
        while True:
            try:
                connection, _ = self._listener.accept()
            except BlockingIOError:
                break
            self._readers.append(_Connected(connection))
        self._send()

    def _send(self) -> None:
        for reader in list(self._readers):
            if not reader.send():
                reader.connection.close()
                self._readers.remove(reader)

    def finish(self) -> None:
        """Close all connections."""
        for reader in self._readers:
            reader.connection.close()
        self._listener.close()


class UdpSink(Sink):
    """Sends one datagram a datum; one that is too large goes without its points."""

    def __init__(self, published: Published, host: str, port: int) -> None:
        super().__init__(images=False)
        self._published, self._address = published, (host, port)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)

    def write(self, datum: Datum) -> None:
        """Send a datum."""
        data = json_line(datum, self._published)
        if len(data) > _DATAGRAM:
            content = json.loads(data)
            content.pop("points_m", None)
            data = json.dumps(content).encode() + b"\n"
        try:
            self._socket.sendto(data, self._address)
        except OSError:  # nobody listens, or the network is full
            self.dropped += 1

    def finish(self) -> None:
        """Close the socket."""
        self._socket.close()
