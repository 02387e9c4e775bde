"""The streams that a user names: ``--stream KIND:...`` in, a publisher out."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from armsight.app.show.http import host_and_port
from armsight.app.stream.cell import open_cell
from armsight.app.stream.datum import Published
from armsight.app.stream.igtl import IgtlSink
from armsight.app.stream.network import TcpSink, UdpSink
from armsight.app.stream.sink import Sink
from armsight.app.stream.websocket import FoxgloveSink
from armsight.app.stream.zenoh import Ros2Sink
from armsight.errors import InputError
from armsight.files import as_input_error
from armsight.loop.running.data import Fanout

#: Kind -> the sink of ``KIND:[HOST:]PORT``; another kind is one line here. ``cell:`` is opened by itself.
STREAMS: dict[str, Callable[[Published, str, int], Sink]] = {
    "foxglove": FoxgloveSink,
    "json+tcp": TcpSink,
    "json+udp": UdpSink,
    "igtl": IgtlSink,
    "ros2": Ros2Sink,
}


def open_stream(spec: str, published: Published) -> Sink:
    """Open the stream that a text names; it is to be started."""
    kind, _, rest = spec.partition(":")
    if kind == "cell":
        return open_cell(rest, published)
    if kind not in STREAMS:
        raise InputError(f"--stream {spec}: unknown kind {kind!r}; known are {', '.join((*STREAMS, 'cell'))}")
    with as_input_error(f"--stream {spec}: expected {kind}:[HOST:]PORT, such as {kind}:8766", InputError):
        address = host_and_port(rest if ":" in rest else f"127.0.0.1:{rest}", "--stream")
    return STREAMS[kind](published, *address)


class Streams(Fanout):
    """Publishes to several streams; with none it does nothing."""

    def __init__(self, sinks: dict[str, Sink], say: Callable[[str], None]) -> None:
        super().__init__(sinks.values())
        self._named, self._say = sinks, say

    def close(self) -> None:
        """Close every stream; a second call has no effect."""
        named, self._named, self.sinks = self._named, {}, ()
        for name, sink in named.items():
            sink.close()
            if sink.problem is not None:
                self._say(f"note: --stream {name} ended early: {sink.problem}")
            if sink.dropped:
                self._say(f"note: --stream {name}: {sink.dropped} data were dropped, a reader was too slow")


def open_streams(specs: Sequence[str], published: Published, say: Callable[[str], None]) -> Streams:
    """Open the streams that a user names, and start them."""
    sinks: dict[str, Sink] = {}
    try:
        for spec in specs:
            sinks[spec] = open_stream(spec, published)
            sinks[spec].start()
    except InputError:
        for sink in sinks.values():
            sink.close()
        raise
    return Streams(sinks, say)
