"""run.mcap: everything a run publishes, in one file that Foxglove, Lichtblick and rerun open.

Beside the messages of ``foxglove.py`` it holds every datum as JSON with all digits, on ``/armsight/shot``,
``/armsight/joints`` and ``/armsight/event``, from which ``armsight replay`` reads; and, as metadata, the rig file and the
versions. What waits is written out at least every half a second: if the process is killed, no more than that is missing.
"""

from __future__ import annotations

import json
import os
import struct
import time
import zlib
from collections import defaultdict
from collections.abc import Callable
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import IO, Any, TypeAlias

import numpy as np

from armsight import __version__
from armsight.app.show.messages import require
from armsight.app.stream.datum import Published, json_text
from armsight.app.stream.foxglove import SCHEMAS, LookedAt, Messages, nanoseconds, schema_of
from armsight.app.stream.ros import READINGS, reading_messages
from armsight.app.stream.sink import Sink
from armsight.data import Shot
from armsight.errors import InputError
from armsight.files import as_input_error
from armsight.loop.running.data import Datum, EventDatum, JointsDatum, NoteDatum, ShotDatum
from armsight.processes import Process
from armsight.robot.kinematics.arm import Arm
from armsight.vision.rig import StereoRig
from armsight.vision.source import LIVE_S
from armsight.vision.sources.bag.camera_info import METADATA, RIG

#: Name of the file in the folder of a run.
RUN_MCAP = "run.mcap"
#: Keys of its metadata beside the rig file: the body file, the nominal arm, the references that are recorded.
BODY, ARM, REFERENCES = "body.toml", "arm.json", "references.toml"
#: Topics of the data as JSON, by kind.
TOPICS: dict[type, str] = {ShotDatum: "/armsight/shot", JointsDatum: "/armsight/joints", EventDatum: "/armsight/event"}
_WAKES = 64  # data that are written together, where they come fast
#: By then a process has begun to write, on a computer under load, s; so many data, of some kB each, wait for it at most.
_BEGUN_S, _WAITING = 60.0, 8192
_BATCH = 16  # data that are sent to a process at once: a third of a millisecond
_SCHEMA = json.dumps({"type": "object"}).encode()
#: A record of the library mcap.
_Record: TypeAlias = Any

_MAGIC = b"\x89MCAP0\r\n"
_MESSAGE = 0x05  # opcode of a message
#: Opcode, length of what follows, channel, sequence, log time, publish time.
_HEAD = struct.Struct("<BQHIQQ")
_HEAD_BYTES = _HEAD.size - 9  # without opcode and length
#: Bytes at which a chunk is written out.
_CHUNK_BYTES = 1 << 20


class McapSink(Sink):
    """Writes run.mcap, which must not exist; the properties of what is published become metadata."""

    def __init__(self, path: Path, published: Published) -> None:
        require("run.mcap", "record", *SCHEMAS)
        super().__init__(wakes=_WAKES)
        self.path = path
        self._published, self._messages = published, Messages(published)
        with as_input_error(f"{path}: cannot be written"):
            self._file: IO[bytes] = path.open("xb")
        self._writer = McapWriter(self._file, "armsight")
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._writer.add_metadata(METADATA, dict(published.properties))
        self._file.flush()

    def write(self, datum: Datum) -> None:
        """Write a datum: its Foxglove messages, and itself as JSON."""
        log_ns = stamp_ns = nanoseconds(datum.time_s)
        if isinstance(datum, ShotDatum) and datum.arrival_s is not None:
            log_ns = nanoseconds(datum.arrival_s)
        for topic, message in self._messages.of(datum):
            channel = self._channel(topic, "protobuf", partial(schema_of, message))
            self._writer.add_message(channel, log_ns, stamp_ns, message.SerializeToString())
        if isinstance(datum, JointsDatum) and datum.felt is not None:
            topic, kind, text = READINGS[datum.felt[1].z.shape[1]]
            channel = self._channel(topic, "cdr", lambda: (kind, "ros2msg", text.encode()))
            for read_ns, data in reading_messages(*datum.felt):
                self._writer.add_message(channel, log_ns, read_ns, data)
        if not isinstance(datum, NoteDatum):
            topic = TOPICS[type(datum)]
            channel = self._channel(topic, "json", lambda: (topic[1:].replace("/", "."), "jsonschema", _SCHEMA))
            self._writer.add_message(channel, log_ns, stamp_ns, json_text(datum.to_json(self._published.body)))

    def _channel(self, topic: str, encoding: str, schema: Callable[[], tuple[str, str, bytes]]) -> int:
        """Return the number of a topic's channel; a new one's schema is its name, encoding and text."""
        if topic not in self._channels:
            name, form, text = schema()
            if name not in self._schemas:
                self._schemas[name] = self._writer.register_schema(name, form, text)
            images = name == "foxglove.CompressedImage"
            self._channels[topic] = self._writer.register_channel(topic, encoding, self._schemas[name], images=images)
        return self._channels[topic]

    def tick(self) -> None:
        """Write the chunk out: what is in it survives the end of the process."""
        self._writer.flush()

    def finish(self) -> None:
        """Write the index and close the file."""
        try:
            if self.problem is None:
                if self.dropped:
                    self.write(_dropped(self))
                self._writer.finish()
                self._file.flush()
                os.fsync(self._file.fileno())
        finally:
            self._file.close()


class McapBeside(Sink):
    """Writes run.mcap as :class:`McapSink` does, in its own process; what is wrong with the file is its ``problem``."""

    def __init__(self, path: Path, published: Published) -> None:
        require("run.mcap", "record", *SCHEMAS)
        super().__init__(_WAITING, _WAKES, _BEGUN_S)
        self._process, self._looked_at = Process(_written, path, published), LookedAt()
        self._batch: list[Datum] = []

    def put(self, datum: Datum) -> None:
        """Take a datum without the images that are not recorded, and return at once."""
        if isinstance(datum, ShotDatum):
            shot = datum.shot
            if shot.encoded is not None or (shot.left is not None and not self._looked_at.take(shot)):
                datum = replace(datum, shot=replace(shot, left=None, right=None))
        super().put(datum)

    def write(self, datum: Datum) -> None:
        """Have a datum written, with the next ones: a call of the process takes longer than a datum."""
        self._batch.append(datum)
        if len(self._batch) >= _BATCH:
            self._send()

    def tick(self) -> None:
        """Write the chunk out."""
        self._send("tick")

    def finish(self) -> None:
        """Write the index and close the file; end the process."""
        try:
            if self.problem is None:
                if self.dropped:
                    self._batch.append(_dropped(self))
                self._send("finish")
        finally:
            self._process.close()

    def _send(self, then: str = "") -> None:
        batch, self._batch = self._batch, []
        self._process(batch, then)


def _written(path: Path, published: Published) -> Callable[[list[Datum], str], None]:
    """Return what writes data to a new file, and calls a method of it by its name."""
    sink = McapSink(path, published)

    def write(data: list[Datum], then: str) -> None:
        for datum in data:
            sink.write(datum)
        if then:
            getattr(sink, then)()

    return write


def _dropped(sink: Sink) -> NoteDatum:
    return NoteDatum(0.0, f"{sink.dropped} of {sink.taken} data were dropped: the disk is too slow", "warning")


class LazyMcap:
    """run.mcap in a folder, begun with the first datum; an earlier one is replaced; ``say`` is given what is wrong."""

    def __init__(
        self,
        folder: Path,
        published: Published,
        say: Callable[[str], None],
        name: str = RUN_MCAP,
        *,
        process: bool = False,
    ) -> None:
        self._path, self._published, self._say = folder / name, published, say
        self._began, self._writes = False, McapBeside if process else McapSink
        self.sink: McapSink | McapBeside | None = None

    def put(self, datum: Datum) -> None:
        """Take a datum and return at once."""
        if not self._began:
            self._began = True
            try:
                require("run.mcap", "record", *SCHEMAS)
            except InputError as error:
                self._say(f"note: no run.mcap is written: {error}")
                return
            with as_input_error(f"{self._path}: cannot be written"):
                self._path.parent.mkdir(parents=True, exist_ok=True)
                self._path.unlink(missing_ok=True)
            self.sink = self._writes(self._path, self._published)
            self.sink.start()
        if self.sink is not None:
            self.sink.put(datum)

    def pause(self) -> None:
        """Begin to write no other datum until :meth:`resume`."""
        if self.sink is not None:
            self.sink.pause()

    def resume(self) -> None:
        """Write again."""
        if self.sink is not None:
            self.sink.resume()

    def put_shot(self, shot: Shot) -> None:
        """Take a shot that was recorded and not measured."""
        now = time.monotonic()  # the clock of live cameras' stamps
        live = shot.t_s is not None and 0.0 <= now - shot.t_s < LIVE_S
        self.put(ShotDatum(shot, None, now if live or shot.t_s is None else None))

    def close(self) -> None:
        """Write what was taken, and end."""
        sink, self.sink = self.sink, None
        if sink is not None:
            sink.close()
            if sink.problem is not None:
                self._say(f"note: {self._path}: not complete: {sink.problem}")
            elif sink.dropped:
                self._say(f"note: {self._path}: {sink.dropped} of {sink.taken} data were dropped: the disk is too slow")


def properties(rig: StereoRig | None, body_text: str | None, arm: Arm | None = None, **more: str) -> dict[str, str]:
    """Return the metadata of a run: versions, the rig file, the body file and the nominal arm, with all digits."""
    found = {"version": __version__} | more
    if rig is not None:
        found[RIG] = rig.to_text()
    if body_text is not None:
        found[BODY] = body_text
    if arm is not None:
        values = {each.name: getattr(arm, each.name) for each in fields(arm) if each.init}
        listed = {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in values.items()}
        found[ARM] = json.dumps(listed)
    return found


def arm_of(text: str) -> Arm:
    """Return the arm of a run's metadata."""
    values: Any = json.loads(text)
    names = tuple(values.pop("joint_names"))
    arrays: Any = {k: np.array(v, float) if isinstance(v, list) else v for k, v in values.items()}
    return Arm(joint_names=names, **arrays)


class _Chunk:
    def __init__(self, compression: str) -> None:
        self.compression = compression
        self.clear()

    def clear(self) -> None:
        self.parts: list[bytes] = []
        self.size = 0
        self.index: defaultdict[int, list[tuple[int, int]]] = defaultdict(list)  # channel -> (log time, offset)
        self.first_ns, self.last_ns = 2**64 - 1, 0

    def append(self, data: bytes) -> None:
        self.parts.append(data)
        self.size += len(data)


class McapWriter:
    """Writes one file, as data come, with the index of chunks and messages: images uncompressed, all else in chunks of LZ4.

    Images are compressed already, and LZ4 over them costs more than all else that is written. That, and one ``struct`` a
    message, is why it stands here: the library's writer, whose records are used for what is rare, takes twice as long.
    """

    def __init__(self, file: IO[bytes], library: str) -> None:
        from mcap import records
        from mcap.data_stream import RecordBuilder

        self._records, self._Builder, self._file = records, RecordBuilder, file
        self._chunks = {"lz4": _Chunk("lz4"), "": _Chunk("")}
        self._schemas: list[_Record] = []
        self._channels: list[_Record] = []
        self._chunk_of: dict[int, _Chunk] = {}
        self._counts: defaultdict[int, int] = defaultdict(int)
        self._chunk_indexes: list[_Record] = []
        self._metadata_indexes: list[_Record] = []
        self._at = 0
        self._write(_MAGIC + self._bytes(records.Header("", library)))

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Add a schema; return its number."""
        self._schemas.append(self._records.Schema(id=len(self._schemas) + 1, data=data, encoding=encoding, name=name))
        return len(self._schemas)

    def register_channel(self, topic: str, encoding: str, schema: int, *, images: bool = False) -> int:
        """Add a channel; return its number; ``images``: its messages are compressed already."""
        number = len(self._channels) + 1
        how = {"topic": topic, "message_encoding": encoding, "schema_id": schema, "metadata": {}}
        self._channels.append(channel := self._records.Channel(id=number, **how))
        chunk = self._chunk_of[number] = self._chunks["" if images else "lz4"]
        # The schema stands in the chunk of each of its channels: every chunk before can be missing.
        chunk.append(self._bytes(self._schemas[schema - 1]) + self._bytes(channel))
        return number

    def add_metadata(self, name: str, texts: dict[str, str]) -> None:
        """Write texts by name."""
        data = self._bytes(self._records.Metadata(name=name, metadata=texts))
        self._metadata_indexes.append(self._records.MetadataIndex(offset=self._at, length=len(data), name=name))
        self._write(data)

    def add_message(self, channel: int, log_ns: int, publish_ns: int, data: bytes) -> None:
        """Add a message; times in ns."""
        chunk = self._chunk_of[channel]
        chunk.index[channel].append((log_ns, chunk.size))
        chunk.first_ns, chunk.last_ns = min(chunk.first_ns, log_ns), max(chunk.last_ns, log_ns)
        chunk.append(_HEAD.pack(_MESSAGE, _HEAD_BYTES + len(data), channel, 0, log_ns, publish_ns))
        chunk.append(data)
        if chunk.size > _CHUNK_BYTES:
            self._finish_chunk(chunk)

    def flush(self) -> None:
        """Write out what was added: from then on it survives the end of the process."""
        for chunk in self._chunks.values():
            self._finish_chunk(chunk)
        self._file.flush()

    def finish(self) -> None:
        """Write what was added, and the index."""
        from mcap.opcode import Opcode

        self.flush()
        self._write(self._bytes(self._records.DataEnd(data_section_crc=0)))
        begin, offsets = self._at, []
        groups = {Opcode.SCHEMA: self._schemas, Opcode.CHANNEL: self._channels, Opcode.STATISTICS: [self._statistics()]}
        groups |= {Opcode.CHUNK_INDEX: self._chunk_indexes, Opcode.METADATA_INDEX: self._metadata_indexes}
        summary = b""
        for opcode, records in groups.items():
            data = b"".join(self._bytes(record) for record in records)
            offsets.append(self._records.SummaryOffset(opcode, begin + len(summary), len(data)))
            summary += data
        offsets_at = begin + len(summary)
        summary += b"".join(self._bytes(each) for each in offsets)
        # The checksum covers the summary, and the footer as far as itself.
        crc = zlib.crc32(summary + struct.pack("<BQQQ", 0x02, 20, begin, offsets_at))
        self._write(summary + self._bytes(self._records.Footer(begin, offsets_at, crc)) + _MAGIC)
        self._file.flush()

    def _finish_chunk(self, chunk: _Chunk) -> None:
        if not chunk.index:
            return
        import lz4.frame

        data = b"".join(chunk.parts)
        stored = lz4.frame.compress(data) if chunk.compression else data
        times = {"message_start_time": chunk.first_ns, "message_end_time": chunk.last_ns}
        sizes = {"compression": chunk.compression, "uncompressed_size": len(data)}
        record = self._bytes(self._records.Chunk(data=stored, uncompressed_crc=zlib.crc32(data), **times, **sizes))
        at, offsets, indexes = self._at, {}, b""
        for channel, rows in chunk.index.items():
            offsets[channel] = at + len(record) + len(indexes)
            indexes += self._bytes(self._records.MessageIndex(channel_id=channel, records=rows))
            self._counts[channel] += len(rows)
        lengths = {"chunk_length": len(record), "message_index_length": len(indexes), "compressed_size": len(stored)}
        where = {"chunk_start_offset": at, "message_index_offsets": offsets}
        self._chunk_indexes.append(self._records.ChunkIndex(**where, **lengths, **times, **sizes))
        self._write(record + indexes)
        chunk.clear()

    def _statistics(self) -> _Record:
        indexes = self._chunk_indexes
        counts = {"channel_count": len(self._channels), "chunk_count": len(indexes), "schema_count": len(self._schemas)}
        counts |= {"attachment_count": 0, "metadata_count": len(self._metadata_indexes)}
        return self._records.Statistics(
            channel_message_counts=dict(self._counts),
            message_count=sum(self._counts.values()),
            message_start_time=min((each.message_start_time for each in indexes), default=0),
            message_end_time=max((each.message_end_time for each in indexes), default=0),
            **counts,
        )

    def _bytes(self, record: _Record) -> bytes:
        builder = self._Builder()
        record.write(builder)
        return bytes(builder.end())

    def _write(self, data: bytes) -> None:
        self._file.write(data)
        self._at += len(data)
