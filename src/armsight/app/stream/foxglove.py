"""The messages of Foxglove's protobuf schemas for what a run publishes.

In: a datum. Out: (topic, message) pairs for run.mcap, and for a WebSocket. Frames: base, rig, left, right, body, tool; the
left camera's frame is the rig's. Covariances are along the axes of the frame that the pose is in, translation first.
"""

from __future__ import annotations

import functools
import importlib
from collections.abc import Iterator
from typing import Any, TypeAlias

import cv2
import numpy as np

from armsight.app.stream.datum import Published
from armsight.data import SIDES, Array, Image, Missed, PoseEstimate, Shot
from armsight.geometry.pose import left_axes
from armsight.loop.running.data import EventDatum, JointsDatum, NoteDatum, ShotDatum, quaternion
from armsight.vision.rigfiles.rigfile import rectification
from armsight.vision.sources.bag.reader import S_NS

#: A protobuf message.
Message: TypeAlias = Any
#: Images that cameras deliver as pixels are compressed here, at most one pair in this time, s: it takes long.
_COMPRESS_EVERY_S, _QUALITY = 1.0, 85
#: Joints and the tool are shown at most once in this time, s; as JSON all are published.
_JOINTS_EVERY_S = 0.02
#: The ellipsoid has this many sigmas, and at least this radius, m, to be seen.
_SIGMAS, _LEAST_M = 3.0, 2e-4
_GREEN, _RED, _YELLOW = (0.1, 0.8, 0.2, 1.0), (0.9, 0.2, 0.1, 1.0), (1.0, 0.8, 0.1, 0.4)
_LEVELS = {"info": 2, "warning": 3, "error": 4}
#: What must be there to make messages.
SCHEMAS = ("mcap_protobuf.schema", "foxglove_schemas_protobuf.Log_pb2")
_MODELS = {"fisheye": "kannala_brandt", "brown8": "rational_polynomial"}


@functools.cache
def _type(name: str) -> Message:
    return getattr(importlib.import_module(f"foxglove_schemas_protobuf.{name}_pb2"), name)


def _made(kind: str, /, **fields: object) -> Message:
    return _type(kind)(**fields)


def _log(stamp: Message, level: str, text: str) -> Message:
    return _made("Log", timestamp=stamp, level=_LEVELS[level], message=text, name="armsight")


class LookedAt:
    """Chooses of shots that are pixels those whose images are sent, to be looked at: one pair a second."""

    def __init__(self) -> None:
        self._newest_s = -np.inf

    def take(self, shot: Shot) -> bool:
        """Return whether the images of this shot are sent, and remember it."""
        if shot.t_s is not None and 0.0 <= shot.t_s - self._newest_s < _COMPRESS_EVERY_S:
            return False
        self._newest_s = -np.inf if shot.t_s is None else shot.t_s
        return True


class Messages:
    """Makes messages; it remembers what is sent once."""

    def __init__(self, published: Published) -> None:
        self._published, self._looked_at = published, LookedAt()
        self._calibrated, self._joints_s = False, -np.inf
        self._T_base_rig: Array | None = None

    def of(self, datum: ShotDatum | JointsDatum | NoteDatum | EventDatum) -> Iterator[tuple[str, Message]]:
        """Yield the topic and the message of all that a datum says."""
        from google.protobuf.timestamp_pb2 import Timestamp

        seconds, nanos = divmod(nanoseconds(datum.time_s), S_NS)
        stamp = Timestamp(seconds=seconds, nanos=nanos)
        if isinstance(datum, ShotDatum):
            yield from self._of_shot(datum, stamp)
        elif isinstance(datum, JointsDatum):
            yield from self._of_joints(datum, stamp)
        elif isinstance(datum, NoteDatum):
            yield "/log", _log(stamp, datum.level, datum.text)

    def _of_shot(self, datum: ShotDatum, stamp: Message) -> Iterator[tuple[str, Message]]:
        if not self._calibrated:
            self._calibrated = True
            yield from self._calibrations(stamp)
        yield from self._images(datum.shot, stamp)
        if datum.T_base_rig is not None:
            self._T_base_rig = datum.T_base_rig
        result = datum.result
        yield "/tf", self._transforms(stamp, result)
        if isinstance(result, PoseEstimate):
            yield from self._of_pose(result, stamp)
            for side, annotations in zip(SIDES, self._annotations(result, stamp), strict=True):
                yield f"/{side}/annotations", annotations
            if result.dropped:
                said = "; ".join(f"{each.point}: {each.reason}" for each in result.dropped)
                yield "/log", _log(stamp, "info", f"{datum.shot.name}: left out {said}")
        elif isinstance(result, Missed):
            yield "/log", _log(stamp, "warning", f"{datum.shot.name}: missed: {result.reason}")
        if datum.outcome is not None and not datum.outcome.startswith("used"):
            yield "/log", _log(stamp, "warning", f"{datum.shot.name}: {datum.outcome}")

    def _images(self, shot: Shot, stamp: Message) -> Iterator[tuple[str, Message]]:
        """Yield both images as the cameras delivered them; of pixels one pair a second, to look at, as JPEG."""
        encoded = shot.encoded
        if encoded is None and shot.left is not None and shot.right is not None and self._looked_at.take(shot):
            encoded = (_jpeg(shot.left), _jpeg(shot.right))
        if encoded is None:
            return
        for side, data in zip(SIDES, encoded, strict=True):
            kind = "png" if data.startswith(b"\x89PNG") else "jpeg"
            yield f"/{side}/image", _made("CompressedImage", timestamp=stamp, frame_id=side, data=data, format=kind)

    def _calibrations(self, stamp: Message) -> Iterator[tuple[str, Message]]:
        rig = self._published.rig
        if rig is None:
            return
        R1, R2, P1, P2, _ = rectification(rig)
        for side, camera, R, P in zip(SIDES, rig.cameras, (R1, R2), (P1, P2), strict=True):
            d, model = camera.distortion.tolist(), _MODELS.get(camera.model, "plumb_bob")
            if camera.model in ("none", "brown4"):
                d += [0.0] * (5 - len(d))
            matrices = {k: M.ravel().tolist() for k, M in (("K", camera.matrix), ("R", R), ("P", P))}
            known = dict(zip(("width", "height"), camera.image_size_px, strict=True), distortion_model=model, D=d)
            made = _made("CameraCalibration", timestamp=stamp, frame_id=side, **known, **matrices)
            yield f"/{side}/calibration", made

    def _transforms(self, stamp: Message, result: PoseEstimate | Missed | None) -> Message:
        found, rig = _made("FrameTransforms"), self._published.rig
        for parent, child, T in (
            ("base", "rig", self._T_base_rig),
            ("rig", "left", np.eye(4)),
            ("rig", "right", None if rig is None else rig.T_left_right),
            ("left", "body", result.T_left_body if isinstance(result, PoseEstimate) else None),
        ):
            if T is not None:
                self._add_transform(found, stamp, parent, child, T)
        return found

    def _add_transform(self, found: Message, stamp: Message, parent: str, child: str, T: Array) -> None:
        one = found.transforms.add(parent_frame_id=parent, child_frame_id=child, timestamp=stamp)
        _set_pose(one.translation, one.rotation, T)

    def _of_pose(self, result: PoseEstimate, stamp: Message) -> Iterator[tuple[str, Message]]:
        T = result.T_left_body
        cov = left_axes(T, result.cov)
        pose = _made("PoseInFrame", timestamp=stamp, frame_id="left")
        _set_pose(pose.pose.position, pose.pose.orientation, T)
        yield "/pose", pose
        yield "/odometry", self._odometry(stamp, "left", "body", T, cov)
        scene = _made("SceneUpdate")
        entity = scene.entities.add(timestamp=stamp, frame_id="left", id="ellipsoid", frame_locked=True)
        values, axes = np.linalg.eigh(cov[:3, :3])
        axes = axes * np.sign(np.linalg.det(axes))
        sphere = entity.spheres.add()
        E = np.eye(4)
        E[:3, :3], E[:3, 3] = axes, T[:3, 3]
        _set_pose(sphere.pose.position, sphere.pose.orientation, E)
        size = 2 * np.maximum(_SIGMAS * np.sqrt(np.maximum(values, 0.0)), _LEAST_M)
        sphere.size.x, sphere.size.y, sphere.size.z = size.tolist()
        _colour(sphere.color, _YELLOW)
        yield "/scene", scene

    def _odometry(self, stamp: Message, frame: str, body: str, T: Array, cov: Array) -> Message:
        found = _made("Odometry", timestamp=stamp, frame_id=frame, body_frame_id=body)
        _set_pose(found.pose.position, found.pose.orientation, T)
        found.pose_covariance.extend(cov.ravel().tolist())
        return found

    def _annotations(self, result: PoseEstimate, stamp: Message) -> Iterator[Message]:
        """Yield what was detected in the left and in the right image: used points green, left out ones red by name."""
        seen, names = result.points.seen, self._published.body.point_names
        reasons = {each.point: each.reason for each in result.dropped}
        for camera in range(2):
            found = _made("ImageAnnotations", timestamp=stamp)
            used = found.points.add(timestamp=stamp, type=1, thickness=6.0)
            _colour(used.outline_color, _GREEN)
            for row, (u, v) in zip(seen.ids.tolist(), seen.uv[:, camera].tolist(), strict=True):
                if u == u and names[row] not in reasons:  # a number: this camera saw the point
                    used.points.add(x=u, y=v)
            for line, (point, reason) in enumerate(reasons.items(), start=1):
                text = found.texts.add(timestamp=stamp, text=f"{point}: {reason}", font_size=12.0)
                text.position.x, text.position.y = 8.0, 16.0 * line
                _colour(text.text_color, _RED)
            yield found

    def _of_joints(self, datum: JointsDatum, stamp: Message) -> Iterator[tuple[str, Message]]:
        if 0.0 <= datum.time_s - self._joints_s < _JOINTS_EVERY_S:
            return
        self._joints_s = datum.time_s
        q = datum.states.q[-1]
        joints = _made("JointStates", timestamp=stamp)
        for k, angle in enumerate(q.tolist(), start=1):
            joints.joints.add(name=f"joint{k}", position=angle)
        yield "/joints", joints
        if datum.T_base_tool is None or datum.cov is None:
            return
        T = datum.T_base_tool
        yield "/tool/odometry", self._odometry(stamp, "base", "tool", T, left_axes(T, datum.cov))
        found = _made("FrameTransforms")
        self._add_transform(found, stamp, "base", "tool", T)
        yield "/tf", found
        if self._published.arm is not None:
            yield "/arm", self._arm(stamp, q)

    def _arm(self, stamp: Message, q: Array) -> Message:
        arm = self._published.arm
        assert arm is not None
        scene = _made("SceneUpdate")
        entity = scene.entities.add(timestamp=stamp, frame_id="base", id="arm", frame_locked=True)
        line = entity.lines.add(type=0, thickness=0.01)
        for p in arm.links(q)[:, :3, 3].tolist():
            line.points.add(x=p[0], y=p[1], z=p[2])
        line.pose.orientation.w = 1.0
        _colour(line.color, (0.6, 0.6, 0.65, 1.0))
        return scene


def nanoseconds(t_s: float) -> int:
    """Return a time in ns, at least 0, as every container needs it."""
    return max(0, round(1e9 * t_s))


def schema_of(message: Message) -> tuple[str, str, bytes]:
    """Return the name, encoding and text of the schema of a message."""
    from mcap_protobuf.schema import build_file_descriptor_set

    kind = type(message)
    return kind.DESCRIPTOR.full_name, "protobuf", build_file_descriptor_set(kind).SerializeToString()


def _jpeg(image: Image) -> bytes:
    shown = image if image.dtype == np.uint8 else (image >> 8).astype(np.uint8)
    return bytes(cv2.imencode(".jpg", shown, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes())


def _set_pose(position: Message, orientation: Message, T: Array) -> None:
    position.x, position.y, position.z = T[:3, 3].tolist()
    orientation.w, orientation.x, orientation.y, orientation.z = quaternion(T[:3, :3])


def _colour(field: Message, rgba: tuple[float, float, float, float]) -> None:
    field.r, field.g, field.b, field.a = rgba
