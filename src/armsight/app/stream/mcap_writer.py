"""An MCAP file, written as data come: images uncompressed, everything else in chunks of LZ4.

In: schemas, channels, metadata and messages. Out: a file of version 0 of the format (mcap.dev/spec), with the index of
chunks and messages. Images are compressed already, and LZ4 over them costs more than all else that is written; so they
have chunks of their own. That, and one ``struct`` a message, is why it stands here: the library's writer, whose records are
used for all that is rare, takes twice as long.
"""

from __future__ import annotations

import struct
import zlib
from collections import defaultdict
from typing import IO, Any, TypeAlias

#: A record of the library mcap.
_Record: TypeAlias = Any

_MAGIC = b"\x89MCAP0\r\n"
_MESSAGE, _SCHEMA, _CHANNEL, _CHUNK_INDEX, _STATISTICS, _METADATA_INDEX = 0x05, 0x03, 0x04, 0x08, 0x0B, 0x0D
#: Opcode, length of what follows, channel, sequence, log time, publish time.
_HEAD = struct.Struct("<BQHIQQ")
_HEAD_BYTES = _HEAD.size - 9  # without opcode and length
#: Bytes at which a chunk is written out.
_CHUNK_BYTES = 1 << 20


class _Chunk:
    """A chunk that is being filled."""

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
    """Writes one file."""

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
        channel = self._records.Channel(
            id=number, topic=topic, message_encoding=encoding, schema_id=schema, metadata={}
        )
        self._channels.append(channel)
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
        for chunk in self._chunks.values():
            self._finish_chunk(chunk)
        self._write(self._bytes(self._records.DataEnd(data_section_crc=0)))
        begin, offsets = self._at, []
        groups = (
            (_SCHEMA, self._schemas),
            (_CHANNEL, self._channels),
            (_STATISTICS, [self._statistics()]),
            (_CHUNK_INDEX, self._chunk_indexes),
            (_METADATA_INDEX, self._metadata_indexes),
        )
        summary = b""
        for opcode, records in groups:
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
        self._chunk_indexes.append(
            self._records.ChunkIndex(
                chunk_start_offset=at,
                chunk_length=len(record),
                message_index_offsets=offsets,
                message_index_length=len(indexes),
                compressed_size=len(stored),
                **times,
                **sizes,
            )
        )
        self._write(record)
        self._write(indexes)
        chunk.clear()

    def _statistics(self) -> _Record:
        indexes = self._chunk_indexes
        return self._records.Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=dict(self._counts),
            chunk_count=len(indexes),
            message_count=sum(self._counts.values()),
            metadata_count=len(self._metadata_indexes),
            message_start_time=min((each.message_start_time for each in indexes), default=0),
            message_end_time=max((each.message_end_time for each in indexes), default=0),
            schema_count=len(self._schemas),
        )

    def _bytes(self, record: _Record) -> bytes:
        builder = self._Builder()
        record.write(builder)
        return bytes(builder.end())

    def _write(self, data: bytes) -> None:
        self._file.write(data)
        self._at += len(data)
