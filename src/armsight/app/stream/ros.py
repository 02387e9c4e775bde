"""Foxglove's messages as ROS 2's: for a bag (``app/export/bags.py``), and for a ROS 2 system (``zenoh.py``).

In: a decoded message of a Foxglove type. Out: the ROS type and a message of it, made with the classes of rosbags;
annotations and scenes have no counterpart. And readings of an inertial unit as ``sensor_msgs/msg/Imu`` in CDR.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator
from typing import Any, TypeAlias

import numpy as np

from armsight.loop.references.strapdown import Samples
from armsight.vision.sources.bag.reader import Decoded

_Types: TypeAlias = Any
_Made: TypeAlias = tuple[str, Any]
#: Foxglove's names of lens models -> ROS's (sensor_msgs/distortion_models.hpp), where they differ.
_MODELS = {"kannala_brandt": "equidistant"}


def ros_name(topic: str) -> str:
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
    header, model = _header(types, m, m.frame_id), _MODELS.get(m.distortion_model, m.distortion_model)
    return kind, types[kind](header, m.height, m.width, model, D, K, R, P, 0, 0, region)


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
        way, rotation = _vector(types, "Vector3", each.translation), _rotation(types, each.rotation)
        transform, header = (
            types["geometry_msgs/msg/Transform"](way, rotation),
            _header(types, each, each.parent_frame_id),
        )
        found.append(types["geometry_msgs/msg/TransformStamped"](header, each.child_frame_id, transform))
    return kind, types[kind](found)


def _log(types: _Types, m: Decoded) -> _Made:
    kind = "rcl_interfaces/msg/Log"
    stamp = types["builtin_interfaces/msg/Time"](int(m.timestamp.seconds), int(m.timestamp.nanos))
    return kind, types[kind](stamp, 10 * int(m.level), m.name, m.message, m.file, "", m.line)


#: Type of Foxglove -> what makes ROS's type and message of one.
TO_ROS: dict[str, Callable[[_Types, Decoded], _Made]] = {
    "foxglove.CompressedImage": _image,
    "foxglove.CameraCalibration": _info,
    "foxglove.Odometry": _odometry,
    "foxglove.PoseInFrame": _stamped,
    "foxglove.JointStates": _joints,
    "foxglove.FrameTransforms": _tf,
    "foxglove.Log": _log,
}

_PARTS = {
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z",
}
_IMU = """std_msgs/Header header
geometry_msgs/Quaternion orientation
float64[9] orientation_covariance
geometry_msgs/Vector3 angular_velocity
float64[9] angular_velocity_covariance
geometry_msgs/Vector3 linear_acceleration
float64[9] linear_acceleration_covariance"""
_FIELD = """std_msgs/Header header
geometry_msgs/Vector3 magnetic_field
float64[9] magnetic_field_covariance"""
_RANGE = """std_msgs/Header header
uint8 radiation_type
float32 field_of_view
float32 min_range
float32 max_range
float32 range
float32 variance"""
#: Numbers of a run's readings -> their topic, type, and what encoding "ros2msg" has: the type, and those it is made of.
READINGS = {
    count: (topic, kind, fields + "".join(f"\n{'=' * 80}\nMSG: {name}\n{text}" for name, text in _PARTS.items()))
    for count, topic, kind, fields in (
        (6, "/imu", "sensor_msgs/msg/Imu", _IMU),
        (3, "/magnetic_field", "sensor_msgs/msg/MagneticField", _FIELD),
        (1, "/range", "sensor_msgs/msg/Range", _RANGE),
    )
}
#: Orientation, which is not measured (its covariance begins with -1), then the rest; covariances are not known.
_BEFORE, _ZERO = (0.0, 0.0, 0.0, 1.0, -1.0, *[0.0] * 8), (0.0,) * 9


def reading_messages(name: str, samples: Samples) -> Iterator[tuple[int, bytes]]:
    """Yield the time, ns, and the bytes of the message of each sample; ``name`` is its frame."""
    frame = name.encode() + b"\0"
    frame = struct.pack("<I", len(frame)) + frame
    # Numbers stand at multiples of their size from the stamp on.
    infrared = frame + b"\1" + b"\0" * (-(9 + len(frame)) % 4)
    frame += b"\0" * (-(8 + len(frame)) % 8)
    for t_ns, z in zip(np.round(1e9 * samples.t_s).astype(np.int64).tolist(), samples.z.tolist(), strict=True):
        stamp = struct.pack("<4siI", b"\0\1\0\0", *divmod(t_ns, 1_000_000_000))
        if len(z) == 1:  # field of view, least and greatest range and variance are not known
            yield t_ns, stamp + infrared + struct.pack("<5f", 0.0, 0.0, math.inf, *z, 0.0)
            continue
        numbers = (*z, *_ZERO) if len(z) == 3 else (*_BEFORE, *z[:3], *_ZERO, *z[3:], *_ZERO)
        yield t_ns, stamp + frame + struct.pack(f"<{len(numbers)}d", *numbers)
