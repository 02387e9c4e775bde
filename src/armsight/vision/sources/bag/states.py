"""Joints and poses that a recording holds beside its images: /joint_states, /tf and /tf_static.

In: a :class:`~.reader.Bag`. Out: :class:`JointStream` and :class:`PoseTrack`, on the clock of the stamps, in the order of
time. A pose of one frame in another is composed over the tree of transforms, at the times of the transforms between them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from armsight.data import Array, Record
from armsight.errors import InputError
from armsight.geometry.pose import inverse
from armsight.vision.sources.bag.reader import S_NS, Bag, Decoded

JOINTS = ("sensor_msgs/JointState", "foxglove.JointStates")
TRANSFORMS = ("tf2_msgs/TFMessage", "tf/tfMessage", "foxglove.FrameTransforms", "foxglove.FrameTransform")


@dataclass(frozen=True, eq=False)
class JointStream(Record):
    """Joint angles q (N, n), rad, of named joints at rising times (N,), s; ``notes``: what was left out."""

    names: tuple[str, ...]
    t_s: Array
    q: Array
    notes: tuple[str, ...] = ()

    def at(self, t_s: Array) -> Array:
        """Return angles (M, n) at times (M,), interpolated; NaN outside the stream."""
        return np.column_stack([np.interp(t_s, self.t_s, column, np.nan, np.nan) for column in self.q.T])


@dataclass(frozen=True, eq=False)
class PoseTrack(Record):
    """Poses Ts (N, 4, 4), m, of one frame in another at rising times (N,), s."""

    t_s: Array
    Ts: Array

    def at(self, t_s: Array) -> Array:
        """Return poses (M, 4, 4) at times (M,), interpolated; the nearest end outside."""
        if len(self.t_s) == 1:
            return np.repeat(self.Ts, len(t_s), axis=0)
        inside = np.clip(t_s, self.t_s[0], self.t_s[-1])
        T = np.tile(np.eye(4), (len(t_s), 1, 1))
        T[:, :3, :3] = Slerp(self.t_s.copy(), Rotation.from_matrix(self.Ts[:, :3, :3]))(inside).as_matrix()
        for k in range(3):
            T[:, k, 3] = np.interp(inside, self.t_s, self.Ts[:, k, 3])
        return T


def read_joints(bag: Bag, names: tuple[str, ...] | None = None) -> JointStream | None:
    """Read the joint angles of a recording; None where it holds none, InputError where one of ``names`` is never in it.

    By default all of the first message. ``elbow`` is ``elbow_joint`` too, and ``left_elbow_joint`` where only one joint
    is called so.
    """
    topics = [topic.name for topic in bag.of_kind(*JOINTS)]
    rows: list[tuple[float, list[float]]] = []
    partial, known, theirs = 0, set[str](), None
    for message in bag.messages(topics):
        found = _positions(message.decode())
        names = tuple(found) if names is None else names
        known |= found.keys()
        here = [_called(name, found) for name in names]
        if not all(each in found and np.isfinite(found[each]) for each in here):
            partial += 1
            continue
        if theirs is not None and here != theirs:
            raise InputError(
                f"{bag.path}: two arms have the joints {', '.join(names)}: {', '.join(theirs)} and {', '.join(here)};"
                " record one, or give --columns frames=BASE:FLANGE"
            )
        theirs = here
        stamp = message.stamp_ns()
        rows.append(((stamp if stamp > 0 else message.arrival_ns) / S_NS, [found[each] for each in theirs]))
    if not rows or names is None:
        if partial and names is not None:
            raise InputError(
                f"{bag.path}: no message of {', '.join(topics)} holds the joints {', '.join(names)}; there are"
                f" {', '.join(sorted(known))}"
            )
        return None
    t_s, first = np.unique([t for t, _ in rows], return_index=True)
    notes = (f"{partial} joint states do not hold all of {', '.join(names)}: left out",) if partial else ()
    return JointStream(names, t_s, np.array([rows[k][1] for k in first]), notes)


def _positions(decoded: Decoded) -> dict[str, float]:
    """Return the joints' positions by name: of a controller's state, or of JointState."""
    if hasattr(decoded, "joints"):
        return {str(joint.name): float(joint.position) for joint in decoded.joints}
    return {str(name): float(q) for name, q in zip(decoded.name, decoded.position, strict=False)}


def _called(name: str, among: Mapping[str, float]) -> str:
    """Return what a joint is called among others: its name, or the only one that has it between a prefix and ``_joint``."""
    if name in among:
        return name
    bare = {each: each.removesuffix("_joint") for each in among}
    alike = [each for each, text in bare.items() if text == name or text.endswith(f"_{name}")]
    return alike[0] if len(alike) == 1 else name


def read_transforms(bag: Bag) -> dict[str, tuple[str, PoseTrack]]:
    """Read the transforms of a recording: child frame -> its parent, and its poses in it over time.

    Of a transform that is sent as static the last one holds at all times, as in tf2.
    """
    rows: dict[tuple[str, str], list[tuple[float, Array]]] = {}
    for message in bag.messages([topic.name for topic in bag.of_kind(*TRANSFORMS)]):
        for stamp_ns, parent, child, T in _transforms(message.decode()):
            sent = rows.setdefault((parent, child), [])
            if message.topic.endswith("tf_static"):
                sent.clear()
            sent.append(((stamp_ns or message.arrival_ns) / S_NS, T))
    tree: dict[str, tuple[str, PoseTrack]] = {}
    for (parent, child), poses in rows.items():
        t_s, first = np.unique([t for t, _ in poses], return_index=True)
        tree.setdefault(child, (parent, PoseTrack(t_s, np.array([poses[k][1] for k in first]))))
    return tree


def _transforms(message: Decoded) -> Iterator[tuple[int, str, str, Array]]:
    """Yield stamp, ns, parent, child and pose (4, 4) of each transform of a message."""
    for each in getattr(message, "transforms", [message]):
        if hasattr(each, "parent_frame_id"):
            stamp_ns = int(each.timestamp.seconds) * S_NS + int(each.timestamp.nanos)
            parent, child, t, r = each.parent_frame_id, each.child_frame_id, each.translation, each.rotation
        else:
            stamp_ns = int(each.header.stamp.sec) * S_NS + int(each.header.stamp.nanosec)
            parent, child = each.header.frame_id, each.child_frame_id
            t, r = each.transform.translation, each.transform.rotation
        quaternion = np.array([r.x, r.y, r.z, r.w], float)
        if not np.isfinite(quaternion).all() or not np.linalg.norm(quaternion) > 0.5:
            continue
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = Rotation.from_quat(quaternion).as_matrix(), (t.x, t.y, t.z)
        yield stamp_ns, str(parent).lstrip("/"), str(child).lstrip("/"), T


def read_track(bag: Bag, frame: str, of: str) -> PoseTrack:
    """Return the poses of frame ``of`` in ``frame`` over time; InputError where they are missing or not connected."""
    tree = read_transforms(bag)
    chains = [_chain(tree, each) for each in (frame, of)]
    known = sorted({*tree, *(parent for parent, _ in tree.values())})
    for each in (frame, of):
        if each not in known:
            raise InputError(f"{bag.path}: no frame {each!r} in its transforms; there are {', '.join(known) or 'none'}")
    common = next((name for name in chains[1] if name in chains[0]), None)
    if common is None:
        raise InputError(f"{bag.path}: frames {frame!r} and {of!r} are in two trees that no transform connects")
    links = [[tree[name][1] for name in chain[: chain.index(common)]] for chain in chains]
    moving = [track for side in links for track in side if len(track.t_s) > 1]
    times = min(moving, key=lambda track: len(track.t_s)).t_s if moving else np.zeros(1)
    for track in moving:
        times = times[(times >= track.t_s[0]) & (times <= track.t_s[-1])]

    def composed(tracks: list[PoseTrack]) -> Array:
        T = np.tile(np.eye(4), (len(times), 1, 1))
        for track in tracks:
            T = track.at(times) @ T
        return T

    up, down = composed(links[0]), composed(links[1])
    return PoseTrack(times, inverse(up) @ down)


def _chain(tree: dict[str, tuple[str, PoseTrack]], frame: str) -> list[str]:
    """Return a frame and its parents up to the root."""
    chain = [frame]
    while chain[-1] in tree and tree[chain[-1]][0] not in chain:
        chain.append(tree[chain[-1]][0])
    return chain
