"""The rig that a recording's camera_info describe, where they are of a stereo pair.

In: a recording with two topics of sensor_msgs/CameraInfo or foxglove.CameraCalibration. Out: a StereoRig, its uncertainty
unknown. They hold what the two files of ``rigfiles/ros.py`` hold, and are read by it. A recording made by armsight holds
the rig file itself, with its covariance.
"""

from __future__ import annotations

from pathlib import Path

from armsight.errors import InputError
from armsight.tables.document import Foreign
from armsight.vision.rig import StereoRig
from armsight.vision.rigfiles.rigfile import ImportOptions
from armsight.vision.rigfiles.ros import rig_of
from armsight.vision.sources.bag.images import IMAGES, two_topics
from armsight.vision.sources.bag.reader import Bag, Decoded

#: Types of messages that hold a camera's calibration.
INFOS = ("sensor_msgs/CameraInfo", "foxglove.CameraCalibration")
#: Metadata of a recording made by armsight, and its key that holds the rig file.
METADATA, RIG = "armsight", "rig.json"
#: Names of models -> ROS's: Foxglove calls the equidistant one by its authors.
_MODELS = {"": "plumb_bob", "kannala_brandt": "equidistant"}


def bag_rig(bag: Bag, named: dict[str, str] | None = None) -> StereoRig:
    """Return the rig of a recording; InputError without camera_info of a stereo pair.

    ``named``: image topics by side, where the user named them: their camera_info are beside them.
    """
    if RIG in bag.metadata.get(METADATA, {}):
        return StereoRig.from_text(bag.metadata[METADATA][RIG], f"{bag.path}: {RIG}")
    topics = [topic.name for topic in bag.of_kind(*INFOS)]
    if not topics:
        raise InputError(f"{bag.path}: holds no camera_info, so no rig: give the rig file; it holds {bag.holds()}")
    if named and bag.of_kind(*IMAGES):
        named = {side: _beside(topic, topics) for side, topic in named.items()}
    left, right = two_topics(bag, named or {}, topics, "camera_info")
    documents: dict[str, dict[str, Foreign]] = {}
    for message in bag.messages((left, right)):
        if message.topic not in documents:
            documents[message.topic] = _document(message.decode())
        if len(documents) == 2:
            break
    paths = [Path(f"{bag.path}: {topic}") for topic in (left, right)]
    return rig_of([documents[left], documents[right]], paths, ImportOptions())


def _beside(image_topic: str, topics: list[str]) -> str:
    parts = image_topic.split("/")
    while parts:
        parts.pop()
        if (found := "/".join([*parts, "camera_info"])) in topics:
            return found
    raise InputError(f"{image_topic} has no camera_info beside it; there are {', '.join(topics)}")


def _document(message: Decoded) -> dict[str, Foreign]:
    """Return a message with the keys of a camera_info file; ROS 1 and Foxglove write D K R P, ROS 2 d k r p."""

    def numbers(name: str) -> list[float]:
        values = getattr(message, name) if hasattr(message, name) else getattr(message, name.lower())
        return [float(value) for value in values]

    roi = getattr(message, "roi", None)
    return {
        "binning_x": int(getattr(message, "binning_x", 0)),
        "binning_y": int(getattr(message, "binning_y", 0)),
        "roi": {key: int(getattr(roi, key, 0)) for key in ("x_offset", "y_offset", "width", "height")},
        "image_width": int(message.width),
        "image_height": int(message.height),
        "distortion_model": _MODELS.get(str(message.distortion_model), str(message.distortion_model)),
        "camera_matrix": numbers("K"),
        "distortion_coefficients": numbers("D"),
        "rectification_matrix": numbers("R"),
        "projection_matrix": numbers("P"),
    }
