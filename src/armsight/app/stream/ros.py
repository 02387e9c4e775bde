"""Foxglove's messages as ROS 2's: for a bag (``app/export/bags.py``), and for a ROS 2 system (``zenoh.py``).

In: a decoded message of a Foxglove type. Out: the ROS type and a message of it, made with the classes of rosbags.
CompressedImage, CameraInfo, Odometry and PoseStamped, JointState, TFMessage, and Log as rcl_interfaces/Log. Annotations and
scenes have no counterpart.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np

from armsight.vision.sources.bag.reader import Decoded

_Types: TypeAlias = Any
_Made: TypeAlias = tuple[str, Any]


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
TO_ROS: dict[str, Callable[[_Types, Decoded], _Made]] = {
    "foxglove.CompressedImage": _image,
    "foxglove.CameraCalibration": _info,
    "foxglove.Odometry": _odometry,
    "foxglove.PoseInFrame": _stamped,
    "foxglove.JointStates": _joints,
    "foxglove.FrameTransforms": _tf,
    "foxglove.Log": _log,
}
