"""A run as another recording: MCAP compressed with zstd, or a ROS 2 bag."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

from armsight.app.show.messages import require
from armsight.app.stream.ros import TO_ROS, ros_name
from armsight.errors import InputError
from armsight.files import opened, replacing
from armsight.vision.sources.bag import Bag


def write_mcap(file: Path, output: Path) -> list[Path]:
    """Write the messages of an MCAP file compressed, with an index; return the file."""
    require(f"{file}: MCAP", "record", "mcap.writer")
    from mcap.records import Channel, Message, Metadata, Schema
    from mcap.stream_reader import StreamReader
    from mcap.writer import CompressionType, Writer

    Bag(file)  # names what is wrong with it
    with replacing(output, "wb") as out, opened(file) as stream:
        writer = Writer(out, compression=CompressionType.ZSTD)
        writer.start(profile="", library="armsight")
        schemas: dict[int, int] = {0: 0}
        channels: dict[int, int] = {}
        try:
            for record in StreamReader(stream).records:
                if isinstance(record, Schema) and record.id not in schemas:
                    schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
                elif isinstance(record, Channel) and record.id not in channels:
                    channels[record.id] = writer.register_channel(
                        record.topic, record.message_encoding, schemas[record.schema_id], record.metadata
                    )
                elif isinstance(record, Metadata):
                    writer.add_metadata(record.name, record.metadata)
                elif isinstance(record, Message):
                    at = channels[record.channel_id]
                    writer.add_message(at, record.log_time, record.data, record.publish_time, record.sequence)
        except Exception as error:  # noqa: BLE001 - a file whose writer was killed ends anywhere; what was before is kept
            if not channels:
                raise InputError(f"{file}: {error}") from None
        writer.finish()
    return [output]


def write_ros2(file: Path, output: Path) -> list[Path]:
    """Write a ROS 2 bag of MCAP; return its folder. Nothing is left behind where it fails."""
    require(f"{file}: a ROS bag", "ros", "rosbags")
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    bag = Bag(file)
    topics = [topic.name for topic in bag.topics.values() if topic.kind in TO_ROS]
    if not topics:
        raise InputError(f"{file}: holds nothing that ROS has a message for; it holds {bag.holds()}")
    store = get_typestore(Stores.ROS2_HUMBLE)
    if output.exists():
        output.rmdir()  # empty: the library makes it
    try:
        with Writer(output, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            connections: dict[str, Any] = {}
            for message in bag.messages(topics):
                kind, made = TO_ROS[message.kind](store.types, message.decode())
                if message.topic not in connections:
                    connections[message.topic] = writer.add_connection(ros_name(message.topic), kind, typestore=store)
                data = store.serialize_cdr(made, kind)
                writer.write(connections[message.topic], message.arrival_ns, data)
    except Exception as error:
        shutil.rmtree(output, ignore_errors=True)
        if isinstance(error, OSError):
            raise InputError(f"{output}: cannot be written: {error.strerror or error}") from None
        raise
    return [output]
