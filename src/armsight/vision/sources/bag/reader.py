"""Messages of a recording, whatever its container: ROS 1 bag, ROS 2 bag of sqlite3 or MCAP, Foxglove's MCAP.

In: a path. Out: :class:`Topic` and, message by message, :class:`BagMessage`. ROS 1 and sqlite3 are read by ``rosbags``.
MCAP is read by ``mcap`` record by record, from the front: so a file whose writer was killed, which has no index, is read
as far as it goes.
"""

from __future__ import annotations

import contextlib
import os
import re
import sqlite3
import struct
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

from armsight.errors import InputError
from armsight.files import check_readable, opened, read_text

#: A message as its library decodes it; what it holds is checked where it is used.
Decoded: TypeAlias = Any
#: A record of the library mcap.
_McapRecord: TypeAlias = Any
#: A reader of the library rosbags.
_RosReader: TypeAlias = Any
#: Topic of a message, time of its arrival, ns, encoding, bytes, and what decodes them.
_Raw: TypeAlias = tuple[str, int, str, bytes, Callable[[], Decoded]]

_MCAP_MAGIC = b"\x89MCAP0\r\n"
_COMPRESSIONS = ("", "lz4", "zstd")
#: Largest record of an MCAP file, MB: a message of raw 33 Mpx in colour; half: 16 Mpx; double: as much more memory.
_CHUNK_MB = 100
#: Bytes before the stamp of a message that begins with a header: ROS 1 has a sequence number, CDR says its byte order.
_BEFORE_STAMP = 4
S_NS = 1_000_000_000
#: Suffixes of recordings; in a folder files of the first that is there are one recording.
SUFFIXES = (".mcap", ".db3", ".bag")
_INSTALL = 'pip install "armsight[ros]"'


@dataclass(frozen=True)
class Topic:
    """One topic of a recording, its ``kind`` without ROS 2's ``/msg/``: sensor_msgs/Image; ``count`` messages."""

    name: str
    kind: str
    count: int


@dataclass(frozen=True)
class BagMessage:
    """One message, number ``index`` on its topic, of a kind as in :class:`Topic`.

    ``arrival_ns``: when it was recorded, clock of the recorder; ``encoding``: of its bytes: ros1, cdr, protobuf or
    json; ``decode`` returns it decoded, or raises InputError.
    """

    topic: str
    kind: str
    index: int
    arrival_ns: int
    encoding: str
    data: bytes
    decode: Callable[[], Decoded]

    def stamp_ns(self) -> int:
        """Return the time stamp of its header, ns; 0 where the sender set none."""
        if self.encoding == "protobuf":
            stamp = self.decode().timestamp
            return int(stamp.seconds) * S_NS + int(stamp.nanos)
        if self.encoding not in ("ros1", "cdr") or len(self.data) < _BEFORE_STAMP + 8:
            return 0
        big = self.encoding == "cdr" and not self.data[1] & 1  # second byte of CDR: its byte order
        seconds, nanoseconds = struct.unpack_from(">iI" if big else "<iI", self.data, _BEFORE_STAMP)
        return int(seconds) * S_NS + int(nanoseconds)


class Bag:
    """A recording that is read from its beginning as often as one likes; ``path`` as the user gave it.

    ``notes``: what could not be read, a line each, more may come while messages are read; ``topics`` by name;
    ``metadata``: texts that its writer stored beside the messages, MCAP alone.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = path
        self.notes: list[str] = []
        self.metadata: dict[str, dict[str, str]] = {}
        files = _files(path, self.notes)
        read = _McapFiles(path, files, self.notes, self.metadata) if _is_mcap(files[0]) else None
        self._container: _McapFiles | _RosFiles = read or _RosFiles(path, files, self.notes)
        self.topics = {topic.name: topic for topic in self._container.topics()}

    def messages(self, topics: Collection[str]) -> Iterator[BagMessage]:
        """Yield the messages of some topics in the order they were recorded; InputError where no more can be read."""
        if not topics:
            return
        counts = dict.fromkeys(topics, 0)
        for topic, arrival_ns, encoding, data, decode in self._container.messages(set(topics)):
            kind = self.topics[topic].kind
            yield BagMessage(
                topic, kind, counts[topic], arrival_ns, encoding, data, partial(self._decoded, kind, decode)
            )
            counts[topic] += 1

    def _decoded(self, kind: str, decode: Callable[[], Decoded]) -> Decoded:
        """Decode a message; whatever a library finds wrong with it becomes one line."""
        try:
            return decode()
        except InputError:
            raise
        except Exception as error:  # noqa: BLE001 - a damaged message fails in many ways
            text = " ".join(str(error).split())
            raise InputError(f"{self.path}: a message of type {kind} cannot be decoded: {text}") from None

    def of_kind(self, *kinds: str) -> list[Topic]:
        """Return the topics of some types that hold messages, by name."""
        return sorted((t for t in self.topics.values() if t.kind in kinds and t.count), key=lambda t: t.name)

    def holds(self) -> str:
        """Return what a recording holds, for messages."""
        listed = [f"{t.name} ({t.kind}, {t.count})" for t in sorted(self.topics.values(), key=lambda t: t.name)]
        text = ", ".join(listed[:12]) + (f" and {len(listed) - 12} more" if len(listed) > 12 else "") or "nothing"
        return "; ".join([text, *self.notes])


def _files(path: str | Path, notes: list[str]) -> list[Path]:
    """Return the files of a recording in the order of its metadata.yaml; or a folder, of one that is compressed as a whole.

    InputError: nothing is there, or a folder holds no bag.
    """
    given = Path(path).expanduser()
    if not given.is_dir():
        if not given.exists():
            raise InputError(
                f"{path}: no such recording; expected a .bag, .db3 or .mcap file, or the folder of a ROS 2 bag"
            )
        check_readable(given)
        return [given]
    metadata = given / "metadata.yaml"
    about = read_text(metadata) if metadata.exists() else ""
    if re.search(r"^ *compression_mode: *.?(file|message)", about, re.MULTILINE | re.IGNORECASE):
        return [given]
    listed = re.search(r"^ *relative_file_paths:((?: *\n *- .*)+)", about, re.MULTILINE)
    named = [Path(name.strip("- '\"")).name for name in listed[1].split("\n") if name.strip()] if listed else []
    there = next((found for suffix in SUFFIXES if (found := [*given.glob(f"*{suffix}")])), [])
    if not there:
        raise InputError(f"{path}: this folder holds no recording: expected {', '.join(SUFFIXES)} files")
    return _in_order(there, named, metadata, notes)


def _in_order(there: list[Path], named: list[str], metadata: Path, notes: list[str]) -> list[Path]:
    """Return files in the order that metadata names them in; those that it does not name come last."""
    there.sort(key=lambda each: [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", each.name)])
    here = {each.name: each for each in there}
    notes += [f"{metadata} names {name}, which is missing: the rest is read" for name in named if name not in here]
    more = [name for name in here if name not in named]
    if named and more:
        notes.append(f"{metadata} does not name {', '.join(more)}: read after the others")
    return [here[name] for name in (*(name for name in named if name in here), *more)]


def _is_mcap(path: Path) -> bool:
    if path.is_dir():
        return False
    with opened(path) as file:
        return file.read(len(_MCAP_MAGIC)) == _MCAP_MAGIC


def _plain(kind: str) -> str:
    """Return the name of a type without ROS 2's middle part."""
    return kind.replace("/msg/", "/")


class _RosFiles:
    """A ROS 1 bag or the files of a ROS 2 bag of sqlite3, read one after the other; each is open only while it is read."""

    def __init__(self, path: str | Path, files: list[Path], notes: list[str]) -> None:
        try:
            import rosbags.highlevel  # noqa: F401 - only whether it is there
        except ImportError:
            raise InputError(f"{path}: a ROS bag is read with rosbags, which is not installed: {_INSTALL}") from None
        self._path, self._files = path, []
        counts: dict[tuple[str, str], int] = {}
        for file in files:
            try:
                with self._opened(file) as reader:
                    self._is_cdr = bool(reader.is2)
                    for each in reader.connections:
                        key = (each.topic, _plain(each.msgtype))
                        counts[key] = counts.get(key, 0) + each.msgcount
            except InputError as error:
                if len(files) == 1:
                    raise
                notes.append(f"{file.name}: left out: {error}")
                continue
            self._files.append(file)
        if not self._files:
            raise InputError(f"{path}: none of its {len(files)} files can be read; {notes[-1]}")
        self._topics = [Topic(name, kind, count) for (name, kind), count in counts.items()]

    @contextlib.contextmanager
    def _opened(self, file: Path) -> Iterator[_RosReader]:
        """Open a file for a block; whatever the library finds wrong with it becomes one line."""
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore

        try:
            if not file.is_dir():
                _check_magic(self._path, file)
            with AnyReader([file], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
                yield reader
        except (InputError, GeneratorExit):
            raise
        except Exception as error:  # noqa: BLE001 - a damaged file fails in many ways
            raise InputError(f"{self._path}: {_ros_problem(self._path, error)}") from None

    def topics(self) -> list[Topic]:
        return self._topics

    def messages(self, topics: Collection[str]) -> Iterator[_Raw]:
        encoding = "cdr" if self._is_cdr else "ros1"
        for file in self._files:
            with self._opened(file) as reader:
                connections = [each for each in reader.connections if each.topic in topics]
                for connection, arrival_ns, data in reader.messages(connections) if connections else ():
                    content, store = bytes(data), reader.typestore
                    decode = store.deserialize_cdr if self._is_cdr else store.deserialize_ros1
                    yield connection.topic, arrival_ns, encoding, content, partial(decode, content, connection.msgtype)


def _check_magic(path: str | Path, file: Path) -> None:
    """Reject a file that does not begin as its kind does: the library looks for an end of line in all of it."""
    magic = {".bag": b"#ROSBAG V", ".mcap": _MCAP_MAGIC}.get(file.suffix, b"SQLite format 3\0")
    with opened(file) as stream:
        found = stream.read(len(magic))
    if found != magic:
        raise InputError(
            f"{path}: damaged, cut short, or not a ROS bag (File magic is invalid: it begins with {found!r}, expected is "
            f"{magic!r})"
        )


def _ros_problem(path: str | Path, error: Exception) -> str:
    """Return what is wrong with a ROS bag, and what to do."""
    text = " ".join(str(error).split()) or type(error).__name__
    if "index" in text.lower():
        return f"has no index ({text}): it was not closed; rebuild it: rosbag reindex {path}"
    if isinstance(error, sqlite3.Error) or "metadata" in text.lower() or os.path.isdir(Path(path).expanduser()):
        return f"damaged, or not a ROS bag ({text}); a ROS 2 bag that was not closed: ros2 bag reindex {path}"
    return f"damaged, cut short, or not a ROS bag ({text})"


class _McapFiles:
    """MCAP files of one recording, read one after the other, each from its front."""

    def __init__(
        self, path: str | Path, files: list[Path], notes: list[str], metadata: dict[str, dict[str, str]]
    ) -> None:
        try:
            import mcap.stream_reader  # noqa: F401 - only whether it is there
        except ImportError:
            raise InputError(f"{path}: MCAP is read with mcap, which is not installed: {_INSTALL}") from None
        self._path, self._files, self._notes, self._metadata = path, files, notes, metadata
        self._chunks = dict[Path, int]()  # of each file so many are whole

    def topics(self) -> list[Topic]:
        counts: dict[tuple[str, str], int] = {}
        for file in self._files:
            for schema, channel, _ in self._records(file, set(), note=True):
                key = (channel.topic, _plain(schema.name if schema else channel.message_encoding))
                counts[key] = counts.get(key, 0) + 1
        return [Topic(name, kind, count) for (name, kind), count in counts.items()]

    def messages(self, topics: Collection[str]) -> Iterator[_Raw]:
        for file in self._files:
            decoders: dict[int, Callable[[bytes], Decoded]] = {}
            for schema, channel, message in self._records(file, topics):
                decode = partial(_mcap_decoded, schema, channel, message.data, decoders)
                yield channel.topic, message.log_time, channel.message_encoding, message.data, decode

    def _records(
        self, file: Path, topics: Collection[str], *, note: bool = False
    ) -> Iterator[tuple[_McapRecord, _McapRecord, _McapRecord]]:
        """Yield schema, channel and message of a file's messages, all where no topics are named."""
        from mcap import records

        schemas: dict[int, _McapRecord] = {0: None}
        channels: dict[int, _McapRecord] = {}
        try:
            for record in self._unpacked(file, note=note):
                if isinstance(record, records.Schema):
                    schemas[record.id] = record
                elif isinstance(record, records.Channel):
                    channels[record.id] = record
                elif isinstance(record, records.Metadata) and note:
                    self._metadata[record.name] = dict(record.metadata)
                elif isinstance(record, records.Message):
                    channel = channels[record.channel_id]
                    if not topics or channel.topic in topics:
                        yield schemas[channel.schema_id], channel, record
        except InputError:
            raise
        except OSError as error:
            raise InputError(f"{self._path}: cannot be read: {error.strerror or error}") from None
        except Exception as error:  # noqa: BLE001 - a file that was cut anywhere fails in many ways; what was read stands
            if note:
                text = " ".join(str(error).split()) or type(error).__name__
                self._notes.append(f"{file}: cut short or damaged ({text}): what was before is read")

    def _unpacked(self, file: Path, *, note: bool) -> Iterator[_McapRecord]:
        """Yield the records of a file, those in its chunks too; again, as far as the first time."""
        from mcap.records import Chunk
        from mcap.stream_reader import StreamReader, breakup_chunk

        chunks = 0
        try:
            with opened(file) as stream:
                for record in StreamReader(stream, emit_chunks=True, record_size_limit=_CHUNK_MB * 1_000_000).records:
                    if not isinstance(record, Chunk):
                        yield record
                        continue
                    if not note and chunks == self._chunks[file]:
                        return
                    if record.compression not in _COMPRESSIONS:
                        raise InputError(
                            f"{self._path}: its chunks are compressed with {record.compression!r}; lz4 and zstd are read: "
                            f"mcap compress --compression zstd {file} -o OUT.mcap"
                        )
                    yield from breakup_chunk(_decompressed(record), validate_crc=note)  # once
                    chunks += 1
        finally:
            if note:
                self._chunks[file] = chunks


def _decompressed(chunk: _McapRecord) -> _McapRecord:
    """Return a chunk decompressed; one that is larger than it says, or than any is, raises a ValueError before it is."""
    size = chunk.uncompressed_size
    if size > _CHUNK_MB * 1_000_000:
        raise ValueError(f"a chunk of {size / 1e6:.0f} MB, more than {_CHUNK_MB}")
    data = chunk.data
    if chunk.compression == "lz4":
        import lz4.frame

        data = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
    elif chunk.compression == "zstd":
        import zstandard

        data = zstandard.ZstdDecompressor(max_window_size=_CHUNK_MB * 1_000_000).stream_reader(data).read(size + 1)
    if len(data) != size:
        raise ValueError(f"a chunk that says {size} bytes and has {len(data)}, or more")
    return replace(chunk, compression="", data=data)


def _mcap_decoded(
    schema: _McapRecord, channel: _McapRecord, data: bytes, decoders: dict[int, Callable[[bytes], Decoded]]
) -> Decoded:
    """Decode a message; what decodes those of its channel is kept in ``decoders``."""
    if channel.id not in decoders:
        decoders[channel.id] = _mcap_decoder(schema, channel)
    return decoders[channel.id](data)


def _mcap_decoder(schema: _McapRecord, channel: _McapRecord) -> Callable[[bytes], Decoded]:
    if channel.message_encoding == "protobuf":
        from mcap_protobuf.decoder import DecoderFactory

        decode: Callable[[bytes], Decoded] | None = DecoderFactory().decoder_for("protobuf", schema)
        assert decode is not None
        return decode
    if channel.message_encoding == "json":
        import json

        return json.loads
    if channel.message_encoding in ("cdr", "ros1"):
        try:
            from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
        except ImportError:
            raise InputError(f"ROS messages are decoded with rosbags, which is not installed: {_INSTALL}") from None
        store = get_typestore(Stores.EMPTY)
        text, kind = schema.data.decode(), schema.name
        if "/msg/" not in kind:
            kind = "/msg/".join(kind.split("/"))
        store.register(get_types_from_idl(text) if schema.encoding == "ros2idl" else get_types_from_msg(text, kind))
        ros1 = channel.message_encoding == "ros1"
        return lambda data: (store.deserialize_ros1 if ros1 else store.deserialize_cdr)(data, kind)
    raise InputError(f"messages encoded as {channel.message_encoding!r} are not read; protobuf, json, cdr and ros1 are")
