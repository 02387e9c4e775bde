"""Shots from the image topics of a recording.

In: a :class:`~.reader.Bag`. Out: :class:`BagSource`. The topics are found by type; where there are more than two, their
names say which are left and right, or the user does: ``bag:FILE,left=/a/image_raw,right=/b/image_raw``.

Images of sensor_msgs/Image are taken as they are (8 or 16 bits, grey, BGR, RGB with or without alpha, Bayer, YUV 4:2:2 and
4:2:0), compressed ones are decoded by OpenCV; ROS's compressed_image_transport compresses Bayer mosaics as they are, and
says so in the format. Distances of depth cameras are no images.
"""

from __future__ import annotations

import re
from collections.abc import Generator, Sequence
from pathlib import Path

import cv2
import numpy as np

from armsight import MOST_PIXELS
from armsight.data import SIDES, Image, Shot
from armsight.errors import InputError
from armsight.vision.image import decoded
from armsight.vision.source import PlayedSource
from armsight.vision.sources.bag.pairing import Pairing, Stamps, pair, planned_shots, stamps_of
from armsight.vision.sources.bag.reader import Bag, BagMessage, Decoded

#: Types of messages that hold one image.
IMAGES = ("sensor_msgs/Image", "sensor_msgs/CompressedImage", "foxglove.RawImage", "foxglove.CompressedImage")
#: Encoding -> type, channels, and OpenCV's conversion to grey or BGR.
_ENCODINGS: dict[str, tuple[str, int, int | None]] = {
    "mono8": ("u1", 1, None),
    "8UC1": ("u1", 1, None),
    "mono16": ("u2", 1, None),
    "16UC1": ("u2", 1, None),
    "bgr8": ("u1", 3, None),
    "8UC3": ("u1", 3, None),
    "rgb8": ("u1", 3, cv2.COLOR_RGB2BGR),
    "bgra8": ("u1", 4, cv2.COLOR_BGRA2BGR),
    "rgba8": ("u1", 4, cv2.COLOR_RGBA2BGR),
    "bgr16": ("u2", 3, None),
    "rgb16": ("u2", 3, cv2.COLOR_RGB2BGR),
    **{
        f"bayer_{pattern}{bits}": (f"u{bits // 8}", 1, code)
        for bits in (8, 16)
        for pattern, code in (  # OpenCV names a pattern by its second row and column: ROS's RGGB is its BG.
            *(("rggb", cv2.COLOR_BayerBG2BGR), ("bggr", cv2.COLOR_BayerRG2BGR)),
            *(("gbrg", cv2.COLOR_BayerGR2BGR), ("grbg", cv2.COLOR_BayerGB2BGR)),
        )
    },
    "yuyv": ("u1", 2, cv2.COLOR_YUV2BGR_YUY2),
    "yuv422_yuy2": ("u1", 2, cv2.COLOR_YUV2BGR_YUY2),
    "uyvy": ("u1", 2, cv2.COLOR_YUV2BGR_UYVY),
    "yuv422": ("u1", 2, cv2.COLOR_YUV2BGR_UYVY),
    "nv12": ("u1", 1, cv2.COLOR_YUV2BGR_NV12),
    "nv21": ("u1", 1, cv2.COLOR_YUV2BGR_NV21),
}
#: Of these half as many rows of colours follow those of the luminance.
_PLANAR = ("nv12", "nv21")
_FLOATING = re.compile(r"(32|64)FC\d|(8|16|32)SC\d")
#: Topics that hold distances.
_DEPTH = re.compile(r"depth|disparity", re.IGNORECASE)
_NO_PICTURE = (
    "holds distances of a depth camera, or numbers whose range it does not say, and no picture: record image_raw"
)
_COMPRESSED = re.compile(r"/(compressed|image_compressed)$")
#: Words of a topic's name that say which camera it is of, left ones first.
_NAMED = (("left", "right"), ("cam0", "cam1"), ("camera0", "camera1"), ("infra1", "infra2"), ("fisheye1", "fisheye2"))
#: Of several topics of one camera the first of these is taken: raw before rectified or processed images.
_PREFERRED = ("image_raw", "image", "image_mono", "image_color")
#: Messages that wait until they are due, MB; half: a recording far from the order of time is read more often; double: twice
#: the memory.
_HELD_MB = 128
_SAMPLED = 61  # of so many bytes one distinguishes messages of a stamp; half: 20 us an image more, double: less


class BagSource(PlayedSource):
    """The stereo images of a recording in the order of time; an image without a partner is a shot with a problem.

    ``topics``: of the left and of the right images.
    """

    def __init__(self, bag: Bag, topics: tuple[str, str], pairing: Pairing, stamps: tuple[Stamps, Stamps]) -> None:
        self.topics, self._bag, self._planned = topics, bag, planned_shots(pairing, stamps)
        super().__init__(self._read, len(self._planned), (*bag.notes, *pairing.notes))

    def _read(self, every: int) -> Generator[Shot]:
        plan = self._planned[::every]
        whole = [tuple(enumerate(planned.messages)) if planned.problem is None else () for planned in plan]
        due = {key: k for k, needed in enumerate(whole) for key in needed}
        held: dict[tuple[int, int | None], BagMessage] = {}
        messages, passes, size = self._bag.messages(self.topics), 0, 0
        for number, (planned, needed) in enumerate(zip(plan, whole, strict=True)):
            name = f"{number:06d}"
            while any(key not in held for key in needed) and passes <= number + 1:
                message = next(messages, None)
                if message is None:  # the recording's order is far from that of time: once more from its beginning
                    messages, passes = self._bag.messages(self.topics), passes + 1
                    continue
                key = (self.topics.index(message.topic), message.index)
                if due.get(key, -1) >= number:
                    held[key] = message
                    size += len(message.data)
                if size > _HELD_MB * 1e6 and len(held) > 2:
                    size -= len(held.pop(max(held, key=lambda each: due[each])).data)
            if planned.problem is not None:
                yield Shot(name, None, None, planned.t_s, planned.problem)
            elif any(key not in held for key in needed):
                yield Shot(
                    name, None, None, planned.t_s, "an image cannot be read a second time: has the file changed?"
                )
            else:
                size -= sum(len(held[key].data) for key in needed)
                # Kept here no longer than the reader keeps it: new memory for each image takes longer than to read it.
                yield _shot(name, planned.t_s, [held.pop(key) for key in needed])


def _shot(name: str, t_s: float, pair_: Sequence[BagMessage]) -> Shot:
    """Decode two messages; one that cannot be decoded makes a shot with a problem."""
    images: list[Image] = []
    encoded: list[bytes] = []
    for side, message in zip(SIDES, pair_, strict=True):
        try:
            image, data = decoded_image(message.kind, message.decode())
        except InputError as error:
            return Shot(name, None, None, t_s, f"{side} image: {error}")
        images.append(image)
        if data is not None:
            encoded.append(data)
    return Shot(name, images[0], images[1], t_s, None, (encoded[0], encoded[1]) if len(encoded) == 2 else None)


def decoded_image(kind: str, message: Decoded) -> tuple[Image, bytes | None]:
    """Return the image of a message, (H, W) or (H, W, 3) BGR, and the file it was, where it was one.

    InputError: an unknown encoding, or data that do not fit its size.
    """
    if "Compressed" in kind:
        if "compresseddepth" in str(message.format).lower():
            raise InputError(f"its {message.format} {_NO_PICTURE}")
        data = bytes(message.data)
        image = decoded(data, f"its {message.format or 'compressed'} data")
        encoding, _, _ = str(message.format).partition(";")  # "bayer_rggb8; jpeg compressed ": it is a mosaic still
        if encoding.startswith("bayer_") and encoding in _ENCODINGS and image.ndim == 2:
            return cv2.cvtColor(image, _ENCODINGS[encoding][2] or 0), None
        return image, data
    if _FLOATING.fullmatch(message.encoding):
        raise InputError(f"its {message.encoding} {_NO_PICTURE}")
    if message.encoding not in _ENCODINGS:
        raise InputError(f"encoding {message.encoding!r} is not read; known are {', '.join(_ENCODINGS)}")
    kind_, channels, convert = _ENCODINGS[message.encoding]
    bigendian = bool(getattr(message, "is_bigendian", False))
    dtype = np.dtype(f"{'>' if bigendian else '<'}{kind_}")
    height, width, step = int(message.height), int(message.width), int(message.step)
    height = height * 3 // 2 if message.encoding in _PLANAR else height
    raw = np.frombuffer(message.data, np.uint8)
    row = width * channels * dtype.itemsize
    if (
        height < 1
        or width < 1
        or step < row
        or width * height > MOST_PIXELS * 2
        or raw.size < step * (height - 1) + row
    ):
        raise InputError(
            f"{width}x{height} {message.encoding} with rows of {step} bytes needs {step * height} bytes, it has {raw.size}"
        )
    if raw.size < step * height:  # the last row's padding may be left out
        raw = np.concatenate([raw, np.zeros(step * height - raw.size, np.uint8)])
    bytes_ = np.ascontiguousarray(raw[: step * height].reshape(height, step)[:, :row])
    pixels = np.require(bytes_.view(dtype), dtype.newbyteorder("="), "A")
    image = pixels.reshape(height, width, channels) if channels > 1 else pixels.reshape(height, width)
    return (image if convert is None else cv2.cvtColor(image, convert)), None


def open_bag_source(rest: str) -> BagSource:
    """Open ``FILE[,left=TOPIC][,right=TOPIC]``; InputError without images of both, or where topics are ambiguous."""
    path, named = parsed(rest)
    bag = Bag(path)
    return source_of(bag, image_topics(bag, named))


def source_of(bag: Bag, topics: tuple[str, str]) -> BagSource:
    """Return the shots of two image topics."""
    stamps = stamps_of_topics(bag, topics)
    return BagSource(bag, topics, pair(*stamps), stamps)


def stamps_of_topics(bag: Bag, topics: tuple[str, str]) -> tuple[Stamps, Stamps]:
    """Read the stamps of two topics."""
    found: dict[str, tuple[list[int], list[int], list[int]]] = {topic: ([], [], []) for topic in topics}
    for message in bag.messages(topics):
        found[message.topic][0].append(message.stamp_ns())
        found[message.topic][1].append(message.arrival_ns)
    if any(header and max(header) <= 0 for header, _, _ in found.values()):  # both cameras by one clock
        found = {topic: ([0] * len(arrival), arrival, []) for topic, (_, arrival, _) in found.items()}
    if any(len({*header}) < len(header) for header, _, _ in found.values()):
        for message in bag.messages(topics):
            found[message.topic][2].append(hash(message.data[::_SAMPLED]))
    left, right = (stamps_of(topic, *found[topic]) for topic in topics)
    for each in (left, right):
        if not each.t_ns:
            raise InputError(f"{bag.path}: {each.topic} holds no message that can be read")
    return left, right


def parsed(rest: str) -> tuple[str, dict[str, str]]:
    """Read the text after ``bag:``: the path, and the topics by side."""
    if Path(rest).expanduser().exists():
        return rest, {}
    path, *options = rest.split(",")
    named: dict[str, str] = {}
    for option in options:
        key, equals, topic = option.partition("=")
        if key not in SIDES or not equals or not topic:
            raise InputError(f"bag:{rest}: expected bag:FILE[,left=TOPIC,right=TOPIC]; got {option!r}")
        named[key] = topic
    if len(named) == 1:
        raise InputError(f"bag:{rest}: name both topics, left=TOPIC,right=TOPIC, or none")
    return path, named


def image_topics(bag: Bag, named: dict[str, str]) -> tuple[str, str]:
    """Return the topics of the left and of the right images."""
    topics = [t.name for t in bag.of_kind(*IMAGES)]
    pictures = [name for name in topics if not _DEPTH.search(name)] or topics
    return two_topics(bag, named, topics if named else pictures, "images")


def two_topics(bag: Bag, named: dict[str, str], bag_topics: list[str], what: str) -> tuple[str, str]:
    """Return the left and the right one of a recording's topics of one sort; InputError where it is not clear."""
    if named:
        for topic in named.values():
            if topic not in bag_topics:
                raise InputError(
                    f"{bag.path}: {topic} is no topic of {what}; there are {', '.join(bag_topics) or 'none'}"
                )
        if named["left"] == named["right"]:
            raise InputError(f"{bag.path}: {named['left']} is given as both left and right")
        return named["left"], named["right"]
    if not bag_topics:
        raise InputError(f"{bag.path}: holds no {what}; it holds {bag.holds()}")
    chosen = _one_each(bag_topics)
    for left_word, right_word in _NAMED:
        pairs = [(t, p) for t in chosen if (p := _renamed(t, left_word, right_word)) in chosen and p != t]
        if len(pairs) == 1:
            return pairs[0]
    if len(chosen) == 2:
        return chosen[0], chosen[1]
    if len(chosen) == 1:
        raise InputError(f"{bag.path}: {what} of one camera only, {chosen[0]}; two are needed")
    raise InputError(
        f"{bag.path}: which {what} are left and right? name them, bag:{bag.path},left=TOPIC,right=TOPIC; there are "
        f"{', '.join(chosen)}"
    )


def _renamed(topic: str, left: str, right: str) -> str:
    return re.sub(rf"(?<![a-zA-Z]){left}(?![a-zA-Z0-9])", right, topic)


def _one_each(topics: list[str]) -> list[str]:
    """Return one topic a camera: not both the raw and the compressed, or rectified, images of one."""
    cameras: dict[str, list[str]] = {}
    for topic in topics:
        camera, _, last = _COMPRESSED.sub("", topic).rpartition("/")
        known = last in _PREFERRED or last.startswith("image_rect")
        cameras.setdefault(camera if known else f"{camera}/{last}", []).append(topic)

    def rank(topic: str) -> tuple[int, bool]:
        last = _COMPRESSED.sub("", topic).rpartition("/")[2]
        return (_PREFERRED.index(last) if last in _PREFERRED else len(_PREFERRED), bool(_COMPRESSED.search(topic)))

    return sorted(min(group, key=rank) for group in cameras.values())
