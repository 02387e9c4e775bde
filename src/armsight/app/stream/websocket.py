"""A WebSocket that Foxglove connects to: the messages of run.mcap, live.

``foxglove:PORT`` listens (8765 is the usual port); in Foxglove: Open connection, ws://HOST:PORT. The server is that of
foxglove-sdk; it drops messages for a reader that is too slow.
"""

from __future__ import annotations

from typing import Any

from armsight.app.show.messages import require
from armsight.app.stream.datum import Published, json_text
from armsight.app.stream.foxglove import SCHEMAS, Messages, nanoseconds, schema_of
from armsight.app.stream.mcap_file import TOPICS
from armsight.app.stream.sink import Sink
from armsight.files import as_input_error
from armsight.loop.running.data import Datum, NoteDatum


class FoxgloveSink(Sink):
    """Publishes to everybody who is connected."""

    def __init__(self, published: Published, host: str, port: int) -> None:
        require("--stream foxglove", "stream", "foxglove", *SCHEMAS)
        import foxglove

        super().__init__()
        self._published, self._messages = published, Messages(published)
        self._context = foxglove.Context()
        self._channels: dict[str, Any] = {}
        self._foxglove = foxglove
        with as_input_error(f"--stream foxglove:{port}: cannot listen there", OSError, RuntimeError, why=True):
            self._server = foxglove.start_server(name="armsight", host=host, port=port, context=self._context)

    @property
    def port(self) -> int:
        """The port that it listens on."""
        return int(self._server.port)

    def write(self, datum: Datum) -> None:
        """Publish the messages of a datum, and the datum itself as JSON."""
        log_ns = nanoseconds(datum.time_s)
        for topic, message in self._messages.of(datum):
            if topic not in self._channels:
                name, encoding, data = schema_of(message)
                schema = self._foxglove.Schema(name=name, encoding=encoding, data=data)
                how = {"message_encoding": "protobuf", "schema": schema, "context": self._context}
                self._channels[topic] = self._foxglove.Channel(topic, **how)
            self._channels[topic].log(message.SerializeToString(), log_time=log_ns)
        if isinstance(datum, NoteDatum):
            return
        topic = TOPICS[type(datum)]
        if topic not in self._channels:
            self._channels[topic] = self._foxglove.Channel(topic, message_encoding="json", context=self._context)
        self._channels[topic].log(json_text(datum.to_json(self._published.body)), log_time=log_ns)

    def finish(self) -> None:
        """Stop the server."""
        self._server.stop()
