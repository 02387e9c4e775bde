"""A run as another recording: MCAP compressed with zstd, or a ROS 2 bag.

Foxglove's messages become ROS's: CompressedImage, CameraInfo, Odometry and PoseStamped, JointState, TFMessage, and Log as
rcl_interfaces/Log. Annotations and scenes have no counterpart and are left out.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from armsight.errors import InputError
from armsight.files import replacing
from armsight.vision.sources.bag import Bag
from armsight.vision.sources.bag.reader import Decoded

_Types: TypeAlias = Any
_Made: TypeAlias = tuple[str, Any]


def write_mcap(file: Path, output: Path) -> list[Path]:
    """Write the messages of an MCAP file compressed, with an index; return the file."""
    try:
        from mcap.records import Channel, Message, Metadata, Schema
        from mcap.stream_reader import StreamReader
        from mcap.writer import CompressionType, Writer
    except ImportError:
        raise InputError(f'{file}: MCAP needs mcap, which is not installed: pip install "armsight[record]"') from None
    Bag(file)  # names what is wrong with it
    with replacing(output, "wb") as out, file.open("rb") as stream:
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
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise InputError(
            f'{file}: ROS bags need rosbags, which is not installed: pip install "armsight[ros]"'
        ) from None
    bag = Bag(file)
    topics = [topic.name for topic in bag.topics.values() if topic.kind in _ROS]
    if not topics:
        raise InputError(f"{file}: holds nothing that ROS has a message for; it holds {bag.holds()}")
    store = get_typestore(Stores.ROS2_HUMBLE)
    if output.exists():
        output.rmdir()  # empty: the library makes it
    try:
        with Writer(output, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            connections: dict[str, Any] = {}
            for message in bag.messages(topics):
                kind, made = _ROS[message.kind](store.types, message.decode())
                if message.topic not in connections:
                    connections[message.topic] = writer.add_connection(_ros_name(message.topic), kind, typestore=store)
                data = store.serialize_cdr(made, kind)
                writer.write(connections[message.topic], message.arrival_ns, data)
    except Exception as error:
        shutil.rmtree(output, ignore_errors=True)
        if isinstance(error, OSError):
            raise InputError(f"{output}: cannot be written: {error.strerror or error}") from None
        raise
    return [output]


def _ros_name(topic: str) -> str:
    """Return the name by which ROS's tools find a topic."""
    return {
        "/left/image": "/left/image_raw/compressed",
        "/right/image": "/right/image_raw/compressed",
        "/left/calibration": "/left/camera_info",
        "/right/calibration": "/right/camera_info",
        "/joints": "/joint_states",
        "/log": "/rosout",
    }.get(topic, topic)


def _header(types: _Types, message: Decoded, frame: str) -> Any:  # noqa: ANN401 - a message of the library
    stamp = types["builtin_interfaces/msg/Time"](int(message.timestamp.seconds), int(message.timestamp.nanos))
    return types["std_msgs/msg/Header"](stamp, frame)


def _vector(types: _Types, kind: str, v: Decoded) -> Any:  # noqa: ANN401 - as above
    return types[f"geometry_msgs/msg/{kind}"](v.x, v.y, v.z)


def _rotation(types: _Types, q: Decoded) -> Any:  # noqa: ANN401 - as above
    return types["geometry_msgs/msg/Quaternion"](q.x, q.y, q.z, q.w)


def _pose(types: _Types, pose: Decoded) -> Any:  # noqa: ANN401 - as above
    position = _vector(types, "Point", pose.position)
    return types["geometry_msgs/msg/Pose"](position, _rotation(types, pose.orientation))


def _image(types: _Types, m: Decoded) -> _Made:
    kind = "sensor_msgs/msg/CompressedImage"
    return kind, types[kind](_header(types, m, m.frame_id), m.format, np.frombuffer(m.data, np.uint8))


def _info(types: _Types, m: Decoded) -> _Made:
    kind = "sensor_msgs/msg/CameraInfo"
    region = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    D, K, R, P = (np.array(values, float) for values in (m.D, m.K, m.R, m.P))
    header = _header(types, m, m.frame_id)
    return kind, types[kind](header, m.height, m.width, m.distortion_model, D, K, R, P, 0, 0, region)


def _odometry(types: _Types, m: Decoded) -> _Made:
    kind = "nav_msgs/msg/Odometry"
    pose = types["geometry_msgs/msg/PoseWithCovariance"](_pose(types, m.pose), np.array(m.pose_covariance, float))
    zero = types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
    twist = types["geometry_msgs/msg/TwistWithCovariance"](types["geometry_msgs/msg/Twist"](zero, zero), np.zeros(36))
    return kind, types[kind](_header(types, m, m.frame_id), m.body_frame_id, pose, twist)


def _stamped(types: _Types, m: Decoded) -> _Made:
    kind = "geometry_msgs/msg/PoseStamped"
    return kind, types[kind](_header(types, m, m.frame_id), _pose(types, m.pose))


def _joints(types: _Types, m: Decoded) -> _Made:
    kind = "sensor_msgs/msg/JointState"
    names, q = [joint.name for joint in m.joints], np.array([joint.position for joint in m.joints], float)
    return kind, types[kind](_header(types, m, ""), names, q, np.zeros(0), np.zeros(0))


def _tf(types: _Types, m: Decoded) -> _Made:
    kind = "tf2_msgs/msg/TFMessage"
    found = []
    for each in m.transforms:
        transform = types["geometry_msgs/msg/Transform"](
            _vector(types, "Vector3", each.translation), _rotation(types, each.rotation)
        )
        header = _header(types, each, each.parent_frame_id)
        found.append(types["geometry_msgs/msg/TransformStamped"](header, each.child_frame_id, transform))
    return kind, types[kind](found)


def _log(types: _Types, m: Decoded) -> _Made:
    kind = "rcl_interfaces/msg/Log"
    stamp = types["builtin_interfaces/msg/Time"](int(m.timestamp.seconds), int(m.timestamp.nanos))
    return kind, types[kind](stamp, 10 * int(m.level), m.name, m.message, m.file, "", m.line)


#: Type of Foxglove -> what makes ROS's type and message of one.
_ROS: dict[str, Callable[[_Types, Decoded], _Made]] = {
    "foxglove.CompressedImage": _image,
    "foxglove.CameraCalibration": _info,
    "foxglove.Odometry": _odometry,
    "foxglove.PoseInFrame": _stamped,
    "foxglove.JointStates": _joints,
    "foxglove.FrameTransforms": _tf,
    "foxglove.Log": _log,
}
