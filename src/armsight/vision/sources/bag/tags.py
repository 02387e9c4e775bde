"""Tag corners that a recording holds instead of images.

In: a recording with two topics of AprilTag detections, one a camera, and the body that carries the tags. Out: one
:class:`~armsight.vision.detections.SeenShot` a pair of messages. Read are types that hold corners: apriltag_msgs'
ApriltagArrayStamped and AprilTagDetectionArray, and isaac_ros's. apriltag_ros of ROS 1 publishes poses alone.

Order of the corners: counter-clockwise in the image is the AprilTag library's, from the lower left; clockwise is OpenCV's,
from the upper left. The library's pixels count from the corner of the first one, so 0.5 px is subtracted where its corners
are sent as they are: by apriltag_ros of ROS 2 (AprilTagNode.cpp, 011db4ee) as apriltag_msgs' AprilTagDetectionArray. The
detectors behind the other types may refine corners by OpenCV, whose pixels are ours. A body's points are called as
:mod:`~armsight.vision.markers.tag` calls them, NAME.0 to NAME.3 from the upper left; a body of points (CSV) calls a tag by
its number: 12.0 to 12.3.
"""

from __future__ import annotations

import numpy as np

from armsight.data import Array, Body, Ids
from armsight.errors import InputError
from armsight.vision.detections import SeenShot
from armsight.vision.markers.marker import Target
from armsight.vision.markers.tag import TagTarget
from armsight.vision.markers.targets import Composite
from armsight.vision.sources.bag.images import parsed, stamps_of_topics, two_topics
from armsight.vision.sources.bag.pairing import pair, planned_shots
from armsight.vision.sources.bag.reader import Bag, BagMessage, Decoded

#: Types of messages that hold a camera's detected tags, with corners.
TAGS = (
    "apriltag_msgs/ApriltagArrayStamped",
    "apriltag_msgs/AprilTagDetectionArray",
    "isaac_ros_apriltag_interfaces/AprilTagDetectionArray",
)
#: That of apriltag_ros, which sends what the AprilTag library finds, and what its pixels count more than ours, px.
_LIBRARY, _LIBRARY_MORE = "apriltag_msgs/AprilTagDetectionArray", 0.5
#: Types that hold their poses alone.
_WITHOUT_CORNERS = ("apriltag_ros/AprilTagDetectionArray", "apriltag_ros_msgs/AprilTagDetectionArray")


def read_tags(spec: str, target: Target | Body) -> tuple[list[SeenShot], tuple[str, ...]]:
    """Read the detected tags of a body in ``bag:FILE[,left=TOPIC,right=TOPIC]``, and what was left out.

    One record a pair of messages, and one with a problem a message without a partner. InputError: not a recording, no
    tags in it, of one camera only, or none of the body's.
    """
    path, named = parsed(spec.removeprefix("bag:"))
    bag = Bag(path)
    if not bag.of_kind(*TAGS) and (poses := bag.of_kind(*_WITHOUT_CORNERS)):
        raise InputError(
            f"{path}: {poses[0].name} holds poses of tags and no corners, which one camera measured: record the images, or "
            "apriltag_msgs"
        )
    topics = two_topics(bag, named, [topic.name for topic in bag.of_kind(*TAGS)], "detected tags")
    stamps = stamps_of_topics(bag, topics)
    pairing = pair(*stamps)
    points = _points(target)
    unknown: dict[str, int] = {}
    found: tuple[list[tuple[Ids, Array]], list[tuple[Ids, Array]]] = ([], [])
    for message in bag.messages(topics):
        found[topics.index(message.topic)].append(_corners(message, points, unknown))
    nothing = (np.zeros(0, np.int64), np.zeros((0, 2)))
    shots = []
    for number, planned in enumerate(planned_shots(pairing, stamps)):
        problem = planned.problem
        seen = [nothing if n is None else of[n] for n, of in zip(planned.messages, found, strict=True)]
        (left, uv_left), (right, uv_right) = seen
        if problem is None and not len(left) and not len(right):
            problem = "no tag of the body was detected"
        shots.append(SeenShot(f"{number:06d}", (left, right), (uv_left, uv_right), planned.t_s, problem))
    if not any(len(ids) for shot in shots for ids in shot.ids):
        raise InputError(f"{path}: no tag of body {_name(target)} is in it; it has {_listed(unknown) or 'none'}")
    notes = [*bag.notes, *pairing.notes]
    if unknown:
        notes.append(f"tags that are not on the body were left out: {_listed(unknown)}")
    return shots, tuple(notes)


def _name(target: Target | Body) -> str:
    return target.name if isinstance(target, Body) else target.body.name


def _listed(unknown: dict[str, int]) -> str:
    most = sorted(unknown.items(), key=lambda item: -item[1])
    return ", ".join(f"{name} ({count} times)" for name, count in most[:8]) + (" ..." if len(most) > 8 else "")


def _points(target: Target | Body) -> dict[int, int]:
    """Return number of a tag -> row of its first corner in the body's points."""
    body = target if isinstance(target, Body) else target.body
    parts = target.parts if isinstance(target, Composite) else (target,)
    tags = [tag for part in parts if isinstance(part, TagTarget) for tag in part.tags]
    if tags:
        return {tag.identity: body.point_names.index(f"{tag.name}.0") for tag in tags}
    rows = {name: row for row, name in enumerate(body.point_names)}
    numbers = sorted({int(name.partition(".")[0]) for name in rows if name.partition(".")[0].isdecimal()})
    whole = [n for n in numbers if all(f"{n}.{k}" in rows and rows[f"{n}.{k}"] == rows[f"{n}.0"] + k for k in range(4))]
    if not whole:
        raise InputError(
            f"body {body.name} carries no tags: expected a body file with tags, or a CSV whose points are called "
            "NUMBER.0 to NUMBER.3, a tag's corners from the upper left, clockwise"
        )
    return {n: rows[f"{n}.0"] for n in whole}


def _corners(message: BagMessage, points: dict[int, int], unknown: dict[str, int]) -> tuple[Ids, Array]:
    """Return rows of the body's points and their pixels (N, 2); tags that are not on it are counted."""
    decoded = message.decode()
    ids, uv = [], []
    for tag in getattr(decoded, "apriltags", None) or getattr(decoded, "detections", None) or ():
        number = int(tag.id)
        if number not in points:
            name = f"{tag.family} {number}".strip()
            unknown[name] = unknown.get(name, 0) + 1
            continue
        corners = _ordered(tag, _LIBRARY_MORE if message.kind == _LIBRARY else 0.0)
        if np.isfinite(corners).all():
            ids.append(points[number] + np.arange(4))
            uv.append(corners)
    if not ids:
        return np.zeros(0, np.int64), np.zeros((0, 2))
    return np.concatenate(ids), np.concatenate(uv)


def _ordered(tag: Decoded, more: float) -> Array:
    """Return corners (4, 2) from the upper left, clockwise as one looks at the tag; the library's less ``more``, px."""
    corners = np.array([[float(point.x), float(point.y)] for point in tag.corners])
    ahead = np.roll(corners, -1, axis=0)
    clockwise = float(np.sum(corners[:, 0] * ahead[:, 1] - corners[:, 1] * ahead[:, 0])) > 0.0  # rows count downwards
    return corners if clockwise else corners[::-1] - more
