"""The streams that a user names: ``--stream KIND:...`` in, a publisher out."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from armsight.app.stream.cell import open_cell
from armsight.app.stream.datum import Published
from armsight.app.stream.igtl import open_igtl
from armsight.app.stream.network import open_json_tcp, open_json_udp
from armsight.app.stream.sink import Sink
from armsight.app.stream.websocket import open_foxglove
from armsight.app.stream.zenoh import open_ros2
from armsight.errors import InputError
from armsight.loop.running.data import Datum

#: Kind -> what opens the rest of the text; another kind is one line here.
STREAMS: dict[str, Callable[[str, Published], Sink]] = {
    "foxglove": open_foxglove,
    "json+tcp": open_json_tcp,
    "json+udp": open_json_udp,
    "igtl": open_igtl,
    "ros2": open_ros2,
    "cell": open_cell,
}


class Streams:
    """Publishes to several streams; with none it does nothing."""

    def __init__(self, sinks: dict[str, Sink], say: Callable[[str], None]) -> None:
        self._sinks, self._say = sinks, say

    def put(self, datum: Datum) -> None:
        """Hand a datum to every stream."""
        for sink in self._sinks.values():
            sink.put(datum)

    def pause(self) -> None:
        """Pause every stream."""
        for sink in self._sinks.values():
            sink.pause()

    def resume(self) -> None:
        """Resume every stream."""
        for sink in self._sinks.values():
            sink.resume()

    def close(self) -> None:
        """Close every stream; a second call has no effect."""
        sinks, self._sinks = self._sinks, {}
        for name, sink in sinks.items():
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
            kind, _, rest = spec.partition(":")
            if kind not in STREAMS:
                raise InputError(f"--stream {spec}: unknown kind {kind!r}; known are {', '.join(STREAMS)}")
            sinks[spec] = STREAMS[kind](rest, published)
            sinks[spec].start()
    except InputError:
        for sink in sinks.values():
            sink.close()
        raise
    return Streams(sinks, say)
