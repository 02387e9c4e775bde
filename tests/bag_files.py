"""Recordings as other programs write them: ROS 1 bags, ROS 2 bags of sqlite3 and MCAP, Foxglove's MCAP.

One list of :class:`Sent` goes in, a file of the container that is asked for comes out, written by ``rosbags`` or ``mcap``.
"""

from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

CONTAINERS = ("ros1", "sqlite3", "mcap", "foxglove")
#: A nanosecond count of a plausible day.
EPOCH_NS = 1_700_000_000_000_000_000


@dataclass
class Sent:
    """One message: its topic, time stamp and arrival, ns, and what it is of."""

    topic: str
    stamp_ns: int
    content: object
    arrival_ns: int | None = None
    options: dict = field(default_factory=dict)

    @property
    def logged_ns(self):
        return self.stamp_ns if self.arrival_ns is None else self.arrival_ns


@dataclass
class Pixels:
    """A raw image; or with ``format`` jpeg or png, a compressed one, from a file's bytes where given."""

    image: np.ndarray
    format: str | None = None
    data: bytes | None = None

    def encoded(self):
        return self.data or cv2.imencode(f".{self.format}", self.image)[1].tobytes()


@dataclass
class Info:
    """A camera_info: size, model, D, K, R, P."""

    size: tuple
    model: str
    D: np.ndarray
    K: np.ndarray
    R: np.ndarray
    P: np.ndarray
    binning: tuple = (0, 0)
    roi: tuple = (0, 0, 0, 0)


@dataclass
class Joints:
    """A joint state."""

    names: list
    q: list


@dataclass
class Transforms:
    """Transforms as (parent, child, T (4, 4))."""

    of: list


@dataclass
class Tags:
    """Detected tags as (id, corners (4, 2)), in the AprilTag library's order of corners."""

    of: list
    family: str = "tag36h11"


TAGS_MSG = """std_msgs/Header header
apriltag_msgs/AprilTagDetection[] detections
================================================================================
MSG: apriltag_msgs/AprilTagDetection
string family
int32 id
int32 hamming
float32 goodness
float32 decision_margin
apriltag_msgs/Point centre
apriltag_msgs/Point[4] corners
float64[9] homography
================================================================================
MSG: apriltag_msgs/Point
float64 x
float64 y
"""


def write_bag(path: Path, container: str, sent: list[Sent], compression: str | None = None) -> Path:
    """Write a recording and return what a reader is given: the file, or the folder of a ROS 2 bag."""
    if container == "foxglove":
        return _foxglove(path.with_suffix(".mcap"), sent)
    return _ros(path, container, sent, compression)


def quaternion(R):
    from armsight.geometry.rotation import quaternion_wxyz

    w, x, y, z = quaternion_wxyz(np.asarray(R))
    return x, y, z, w


def _ros(path, container, sent, compression):
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    ros1 = container == "ros1"
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(TAGS_MSG, "apriltag_msgs/msg/AprilTagDetectionArray"))
    if "tf2_msgs/msg/TFMessage" not in store.types:
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
    if ros1:
        writer = Writer1(path.with_suffix(".bag"))
        if compression:
            writer.set_compression(Writer1.CompressionFormat[compression.upper()])
    else:
        plugin = StoragePlugin.SQLITE3 if container == "sqlite3" else StoragePlugin.MCAP
        writer = Writer2(path, version=9, storage_plugin=plugin)
        if compression:
            writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for each in sent:
            message, kind = _ros_message(store, each, ros1)
            if each.topic not in connections:
                connections[each.topic] = writer.add_connection(each.topic, kind, typestore=store)
            data = (store.serialize_ros1 if ros1 else store.serialize_cdr)(message, kind)
            writer.write(connections[each.topic], each.logged_ns, data)
    return path.with_suffix(".bag") if ros1 else path


def _ros_message(store, sent, ros1):
    types = store.types
    time = types["builtin_interfaces/msg/Time"](*divmod(sent.stamp_ns, 1_000_000_000))
    frame = sent.options.get("frame", "camera")
    header = types["std_msgs/msg/Header"](*([0] if ros1 else []), time, frame)
    what = sent.content
    if isinstance(what, Pixels) and what.format:
        data = np.frombuffer(what.encoded(), np.uint8)
        return types["sensor_msgs/msg/CompressedImage"](header, what.format, data), "sensor_msgs/msg/CompressedImage"
    if isinstance(what, Pixels):
        image = np.ascontiguousarray(what.image)
        encoding = sent.options.get("encoding") or (
            "bgr8" if image.ndim == 3 else {1: "mono8", 2: "mono16"}[image.itemsize]
        )
        h, w = image.shape[:2]
        kind = "sensor_msgs/msg/Image"
        return types[kind](header, h, w, encoding, 0, image.nbytes // h, image.view(np.uint8).ravel()), kind
    if isinstance(what, Info):
        kind = "sensor_msgs/msg/CameraInfo"
        roi = types["sensor_msgs/msg/RegionOfInterest"](*what.roi, False)
        arrays = [np.asarray(x, float).ravel() for x in (what.D, what.K, what.R, what.P)]
        return types[kind](header, what.size[1], what.size[0], what.model, *arrays, *what.binning, roi), kind
    if isinstance(what, Joints):
        none = np.zeros(0)
        kind = "sensor_msgs/msg/JointState"
        return types[kind](header, what.names, np.asarray(what.q, float), none, none), kind
    if isinstance(what, Transforms):
        kind = "tf2_msgs/msg/TFMessage"
        transforms = []
        for parent, child, T in what.of:
            head = types["std_msgs/msg/Header"](*([0] if ros1 else []), time, parent)
            transform = types["geometry_msgs/msg/Transform"](
                types["geometry_msgs/msg/Vector3"](*map(float, T[:3, 3])),
                types["geometry_msgs/msg/Quaternion"](*map(float, quaternion(T[:3, :3]))),
            )
            transforms.append(types["geometry_msgs/msg/TransformStamped"](head, child, transform))
        return types[kind](transforms), kind
    assert isinstance(what, Tags)
    kind = "apriltag_msgs/msg/AprilTagDetectionArray"
    point = types["apriltag_msgs/msg/Point"]
    found = [
        types["apriltag_msgs/msg/AprilTagDetection"](
            what.family,
            number,
            0,
            0.0,
            50.0,
            point(*map(float, np.mean(corners, axis=0))),
            [point(*map(float, c)) for c in corners],
            np.eye(3).ravel(),
        )
        for number, corners in what.of
    ]
    return types[kind](header, found), kind


def _foxglove(path, sent):
    from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
    from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
    from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
    from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
    from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
    from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
    from google.protobuf.timestamp_pb2 import Timestamp
    from mcap_protobuf.writer import Writer

    with path.open("wb") as file, Writer(file, chunk_size=100_000) as writer:
        for each in sent:
            seconds, nanos = divmod(each.stamp_ns, 1_000_000_000)
            stamp, what = Timestamp(seconds=seconds, nanos=nanos), each.content
            if isinstance(what, Pixels) and what.format:
                message = CompressedImage(timestamp=stamp, data=what.encoded(), format=what.format)
            elif isinstance(what, Pixels):
                image = np.ascontiguousarray(what.image)
                encoding = "bgr8" if image.ndim == 3 else {1: "mono8", 2: "mono16"}[image.itemsize]
                h, w = image.shape[:2]
                message = RawImage(
                    timestamp=stamp, width=w, height=h, encoding=encoding, step=image.nbytes // h, data=image.tobytes()
                )
            elif isinstance(what, Info):
                arrays = {key: np.asarray(getattr(what, key), float).ravel().tolist() for key in "DKRP"}
                message = CameraCalibration(
                    timestamp=stamp, width=what.size[0], height=what.size[1], distortion_model=what.model, **arrays
                )
            elif isinstance(what, Joints):
                message = JointStates(timestamp=stamp)
                for name, q in zip(what.names, what.q, strict=True):
                    message.joints.add(name=name, position=q)
            else:
                message = FrameTransforms()
                for parent, child, T in what.of:
                    x, y, z, w = quaternion(T[:3, :3])
                    one = FrameTransform(timestamp=stamp, parent_frame_id=parent, child_frame_id=child)
                    one.translation.x, one.translation.y, one.translation.z = map(float, T[:3, 3])
                    one.rotation.x, one.rotation.y, one.rotation.z, one.rotation.w = x, y, z, w
                    message.transforms.append(one)
            writer.write_message(each.topic, message, log_time=each.logged_ns, publish_time=each.stamp_ns)
    return path


@dataclass
class Disordered:
    """A recording out of order, and what is in it: frame numbers of the whole pairs in order, and how much is left."""

    spec: str
    pairs: list[int]
    others: int


def disordered(folder: Path, container: str, seed: int) -> Disordered:
    """Write a recording in 2 to 15 files whose messages are shuffled, doubled, missing, late and without a stamp.

    A frame's number is in its first two pixels. Messages come up to 0.3 s late, some by 3 s, one topic by a burst; files
    overlap in time; where stamps are missing, messages come at once, so that their arrival says it. metadata.yaml,
    where the container has one, names the files in their order.
    """
    rng = np.random.default_rng(seed)
    count, parts = int(rng.integers(25, 90)), int(rng.integers(2, 16))
    step_ns = int(1e9 / rng.choice([10.0, 29.97, 60.0]))
    sent, halves, others = [], [], 0
    unstamped = rng.random() < 0.5
    for side, topic in enumerate(("/stereo/left/image_raw", "/stereo/right/image_raw")):
        burst = range(*sorted(rng.integers(0, count, 2))) if rng.random() < 0.5 else ()
        there = set()
        for k in range(count):
            if rng.random() < 0.08:
                continue
            there.add(k)
            image = rng.integers(0, 255, (12, 16), np.uint8)
            image[0, :2] = k, side
            true = EPOCH_NS + k * step_ns + (side and int(1e6)) + int(rng.normal(0, 0.04 * step_ns))
            late = int(rng.choice([1e6, 3e8 * rng.random(), 3e9], p=[0.8, 0.17, 0.03]))
            late = int(rng.uniform(1e6, 3e6)) if unstamped else late + 2 * 10**9 * (k in burst)
            stamp = 0 if unstamped and rng.random() < 0.05 else true
            one = Sent(topic, stamp, Pixels(image), true + late)
            sent.append(one)
            if stamp and rng.random() < 0.05:
                sent.append(Sent(topic, stamp, Pixels(image), true + late + int(rng.integers(0, 10**9))))
                others += 1
        halves.append(there)
    order = np.argsort([each.logged_ns for each in sent], kind="stable")
    if container != "sqlite3":  # it is read in the order of arrival, whatever was written first
        order = np.argsort(order.argsort() + rng.uniform(0, 12, len(order)))
    pieces = [[sent[k] for k in part] for part in np.array_split(order, parts)]
    written = [write_bag(folder / f"part_{n}", container, piece) for n, piece in enumerate(pieces)]
    bag = folder / "bag"
    bag.mkdir()
    names = []
    for n, each in enumerate(written):
        file = next(each.glob("*.db3" if container == "sqlite3" else "*.mcap")) if each.is_dir() else each
        names.append(f"bag_{n}{file.suffix}")
        file.rename(bag / names[-1])
    if container in ("sqlite3", "mcap"):
        listed = "".join(f"  - {name}\n" for name in names)
        (bag / "metadata.yaml").write_text(f"rosbag2_bagfile_information:\n  relative_file_paths:\n{listed}")
    return Disordered(f"bag:{bag}", sorted(halves[0] & halves[1]), others + len(halves[0] ^ halves[1]))


def pairs_found(spec: str):
    """Return the frame numbers of the shots of :func:`disordered` as they come, and the problems of the others."""
    from armsight.vision.sources import open_source

    source = open_source(spec)
    found, problems = [], []
    while (shot := source.read()) is not None:
        if shot.problem is not None:
            problems.append(shot.problem)
            continue
        (left, is_left), (right, is_right) = shot.left[0, :2], shot.right[0, :2]
        found.append(int(left) if left == right and (is_left, is_right) == (0, 1) else -1)
    return found, problems
