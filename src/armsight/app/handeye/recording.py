"""Both sides of a hand-eye calibration brought together: row by row, by time, or as two streams.

In: a table of robot poses, or a recording of them, and what was seen. Out: :class:`PairedPoses`, rows that belong together,
with their names.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PureWindowsPath

import numpy as np
from numpy.typing import NDArray

from armsight.app.handeye.images import Seen, upright
from armsight.data import Array, Record
from armsight.errors import InputError
from armsight.geometry.pose import adjoint, inverse, log_se3, mean_pose
from armsight.loop.handeye.poses import MIN_POSES, Poses
from armsight.loop.handeye.streams import GAP_S
from armsight.robot.kinematics.arm import Arm
from armsight.tables.poses import PoseTable
from armsight.vision.sources.bag import Bag
from armsight.vision.sources.bag.reader import SUFFIXES
from armsight.vision.sources.bag.states import PoseTrack, read_joints, read_track

#: Files, and the file in a folder, that are recordings of ROS or Foxglove.
RECORDING_INDEX = "metadata.yaml"
#: An arm that moves further than this in LATE_S, m, at half of the shots moves on while images are on their way.
LATE_S, MOVING_M = 0.02, 1e-3
#: An arm is taken to rest between two poses of a recording that differ by less, m and rad.
STILL_M, STILL_RAD = 1e-4, 1e-3
#: So many rows of one very pose are a log that stopped, where the target was seen this far apart, m.
STOPPED, STOPPED_M = 3, 0.01
#: Poses of one TCP agree within this, m and rad, with a constant transform from the model's flange.
TCP_M, TCP_RAD = 5e-3, 0.02
#: Step of a joint for differences, rad.
STEP_RAD = 1e-6


@dataclass(frozen=True, eq=False)
class PairedPoses(Record):
    """Rows of both sides.

    Attributes:
        poses: the rows that have both sides.
        rows: (N,) the row of the robot's table that each is from.
        names: what each is called in messages.
        t_s: (N,) times, s, on one clock; None where there are none.
        robot: the robot's table.
        seen: what was seen.
        matched: (N,) the row of ``seen`` that each is from.
        notes: what was found out.
    """

    poses: Poses
    rows: NDArray[np.int64]
    names: tuple[str, ...]
    t_s: Array | None
    robot: PoseTable
    seen: Seen
    matched: NDArray[np.int64]
    notes: tuple[str, ...]


def seen_in_table(table: PoseTable) -> Seen:
    """Return the target's poses of a table as what was seen."""
    n = len(table.Ts)
    names = table.names or tuple(f"line {line}" for line in table.lines)
    return Seen(table.Ts, np.zeros((n, 6, 6)), names, table.missed, table.t_s, np.zeros(3), table=table)


def recording_of(robot: Path) -> Path | None:
    """Return the path of a recording given as the robot's poses, bag:FILE or the file; None where it is a table."""
    text = str(robot)
    if text.startswith("bag:"):
        return Path(text[4:])
    return robot if robot.suffix in SUFFIXES or (robot / RECORDING_INDEX).is_file() else None


def robot_in_recording(path: Path, frames: str | None, arm: Arm | None) -> PoseTable:
    """Read the poses of the flange that a recording holds, a row for each of its messages.

    Args:
        path: a ROS 1 or ROS 2 bag, or MCAP.
        frames: BASE:FLANGE, of its transforms; None: the poses are those of the joints.
        arm: the model whose joints are read, by their names.

    Raises:
        InputError: no such recording, frames that it does not have, or joints of other names.
    """
    bag = Bag(path)
    notes: tuple[str, ...] = ()
    joints = None
    if arm is not None:
        joints = read_joints(bag, arm.joint_names)
        if joints is None:
            raise InputError(f"{path}: no joint states for --model {arm.name}; it holds {bag.holds()}")
        notes = joints.notes
    if frames is not None:
        base, _, flange = frames.partition(":")
        if not base or not flange:
            raise InputError(f"--frames {frames}: two frames are needed, such as base_link:tool0")
        track = read_track(bag, base, flange)
        q = None if joints is None else joints.at(track.t_s)
    elif joints is not None and arm is not None:
        track, q = PoseTrack(joints.t_s, np.asarray(arm.forward(joints.q))), joints.q
    else:
        raise InputError(
            f"{path}: a recording needs --frames BASE:FLANGE, frames of its transforms such as base_link:tool0, or --model,"
            " the arm whose joint states it holds"
        )
    there: NDArray[np.bool_] = np.ones(len(track.t_s), bool)
    if q is not None:
        there = np.asarray(np.isfinite(q).all(axis=1))
    n = int(there.sum())
    if n < len(there):
        notes = (
            *notes,
            f"{path}: {len(there) - n} of {len(there)} transforms have no joint states around them: left out",
        )
    if n < MIN_POSES:
        raise InputError(
            f"{path}: {frames or 'the joints'}: {n} poses over time, {MIN_POSES} and more are needed: is it a fixed"
            " transform, or have the joint states other times?"
        )
    return PoseTable(
        path=path,
        lines=1 + np.flatnonzero(there),
        Ts=track.Ts[there],
        numbers=np.zeros((n, 0)),
        written=np.zeros((n, 0)),
        convention="",
        q=None if q is None else q[there],
        t_s=track.t_s[there],
        names=None,
        unit_m=1.0,
        notes=(*bag.notes, *notes),
        missed=("",) * n,
        of_joints=frames is None,
    )


def at_shots(robot: PoseTable, seen: Seen) -> PoseTable:
    """Return the poses of a recording at the times of the shots, interpolated; shots beside it, or in a gap, get no row.

    Raises:
        InputError: the shots have no times, or none is within the recording.
    """
    assert robot.t_s is not None
    if seen.t_s is None:
        raise InputError(f"{robot.path}: pairs by time, and the images have none: --source bag:FILE reads its own")
    inside = np.flatnonzero((seen.t_s >= robot.t_s[0]) & (seen.t_s <= robot.t_s[-1]))
    if not len(inside):
        raise InputError(
            f"{robot.path}: its poses are from {robot.t_s[0]:.1f} to {robot.t_s[-1]:.1f} s, the images from"
            f" {seen.t_s[0]:.1f} to {seen.t_s[-1]:.1f} s: two recordings, or clocks that differ; --streams finds their"
            " offset"
        )
    after = np.clip(np.searchsorted(robot.t_s, seen.t_s[inside]), 1, len(robot.t_s) - 1)
    moved = log_se3(inverse(robot.Ts[after - 1]) @ robot.Ts[after])
    apart = (np.linalg.norm(moved[:, :3], axis=1) > STILL_M) | (np.linalg.norm(moved[:, 3:], axis=1) > STILL_RAD)
    lost = (robot.t_s[after] - robot.t_s[after - 1] > GAP_S) & apart
    holes = (
        (f"{robot.path}: {int(lost.sum())} shots are in gaps of over {GAP_S:g} s in which the arm moved: left out",)
        if lost.any()
        else ()
    )
    inside = inside[~lost]
    t_s, track = seen.t_s[inside], PoseTrack(robot.t_s, robot.Ts)
    Ts = track.at(t_s)
    moved = np.linalg.norm(track.at(t_s + LATE_S)[:, :3, 3] - Ts[:, :3, 3], axis=1)
    late = (
        (
            f"{robot.path}: in half of the shots the arm moves by {1e3 * np.median(moved):.1f} mm and more in"
            f" {1e3 * LATE_S:.0f} ms, and images come later than their stamps say: --streams finds by how much",
        )
        if len(moved) and np.median(moved) > MOVING_M
        else ()
    )
    n = len(inside)
    return replace(
        robot,
        lines=1 + inside,
        Ts=Ts,
        numbers=np.zeros((n, 0)),
        written=np.zeros((n, 0)),
        q=None if robot.q is None else np.stack([np.interp(t_s, robot.t_s, each) for each in robot.q.T], axis=1),
        t_s=t_s,
        names=tuple(seen.names[k] for k in inside),
        notes=(*robot.notes, *holes, *late),
        missed=("",) * n,
    )


def paired(robot: PoseTable, seen: Seen, in_hand: bool, arm: Arm | None) -> PairedPoses:
    """Bring the rows together: by name where the robot's table has names that were seen, else by order.

    Raises:
        InputError: rows and images do not pair up, or hardly one shows the target.
    """
    notes = [*robot.notes, *seen.notes]
    rows, matched = matched_rows(robot, seen.names)
    notes += _alone(robot, seen, rows, matched)
    rows, matched = _once(robot, seen, rows, matched, notes)
    shown = np.array([not seen.missed[k] for k in matched])
    lost = [f"{seen.names[k]} ({seen.missed[k]})" for k in matched[~shown]]
    if lost:
        more = f" and {len(lost) - 3} more" if len(lost) > 3 else ""
        notes.append(f"no target in {', '.join(lost[:3])}{more}")
    rows, matched = rows[shown], matched[shown]
    if len(rows) < MIN_POSES:
        raise InputError(f"{len(rows)} poses have both sides; {MIN_POSES} and more are needed, 15 are advised")
    A, B, covs = robot.Ts[rows], seen.Ts[matched], seen.covs[matched]
    common = None if seen.common is None else seen.common[matched]
    if seen.symmetries:
        B, rotated = upright(A, B, seen.symmetries, in_hand)
        for k in np.flatnonzero(rotated >= 0):
            Ad = adjoint(inverse(seen.symmetries[rotated[k]]))
            covs[k] = Ad @ covs[k] @ Ad.T
            if common is not None:
                common[k] = Ad @ common[k]
        if (rotated >= 0).any():
            notes.append(
                f"the board looks the same rotated: {int((rotated >= 0).sum())} of {len(B)} were rotated to agree"
            )
    _require_moving(robot, rows, B)
    both_clocks = robot.t_s is not None and seen.t_s is not None
    t_s = robot.t_s[rows] if robot.t_s is not None and (both_clocks or seen.t_s is None) else None
    names = tuple(f"line {robot.lines[r]} ({seen.names[k]})" for r, k in zip(rows, matched, strict=True))
    notes += _tcp(robot, arm)
    poses = Poses(A, B, covs, in_hand, seen.centre, common)
    return PairedPoses(poses, rows, names, t_s, robot, seen, matched, tuple(notes))


def _require_moving(robot: PoseTable, rows: NDArray[np.int64], B: Array) -> None:
    """Raise an InputError where rows of the table hold one pose while the target was seen in several."""
    same = np.unique(robot.Ts[rows].reshape(-1, 16), axis=0, return_inverse=True)[1].ravel()
    for k in np.flatnonzero(np.bincount(same) >= STOPPED):
        stopped = np.flatnonzero(same == k)
        apart_m = float(np.linalg.norm(B[stopped, :3, 3] - B[stopped[0], :3, 3], axis=1).max())
        if apart_m > STOPPED_M:
            lines = robot.lines[rows[stopped]]
            raise InputError(
                f"{robot.path}: lines {lines.min()} to {lines.max()}: {len(lines)} rows hold the very same pose, while the"
                f" target was seen up to {1e3 * apart_m:.0f} mm apart: a log that stopped? Leave these rows out"
            )


def matched_rows(robot: PoseTable, seen: Sequence[str]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the rows of both sides that belong together: by name where the robot's table has names, else by order.

    Args:
        robot: the robot's table.
        seen: names of what was seen, one a row.

    Raises:
        InputError: no name is among those seen, or other numbers of rows.
    """
    if robot.names is not None:
        there = {name: k for k, name in enumerate(seen)} | {Path(name).stem: k for k, name in enumerate(seen)}
        paths = [PureWindowsPath(name) for name in robot.names]  # its separators are / too
        keys = [
            next((key for key in (name, path.name, path.stem) if key in there), None)
            for name, path in zip(robot.names, paths, strict=True)
        ]
        found = [(r, there[key]) for r, key in enumerate(keys) if key is not None]
        if not found:
            raise InputError(
                f"{robot.path}: none of its names ({robot.names[0]}, ...) is among those seen ({seen[0]}, ...): write in "
                "that column what the images are called"
            )
        rows, matched = (np.array(part) for part in zip(*found, strict=True))
        return rows, matched
    if len(robot.Ts) != len(seen):
        raise InputError(
            f"{robot.path}: {len(robot.Ts)} robot poses, but {len(seen)} images or target poses: give it a column "
            "image (or name), or t_s on both sides and --streams, so that they can be determined apart"
        )
    return np.arange(len(robot.Ts)), np.arange(len(seen))


def _alone(robot: PoseTable, seen: Seen, rows: NDArray[np.int64], matched: NDArray[np.int64]) -> list[str]:
    """Return notes of rows and images that have no other side."""
    sides = (
        (np.setdiff1d(np.arange(len(robot.Ts)), rows), robot.names or (), f"rows of {robot.path} without an image"),
        (np.setdiff1d(np.arange(len(seen.names)), matched), seen.names, f"images without a row in {robot.path}"),
    )
    return [
        f"{len(alone)} {what}, left out: {', '.join(names[k] for k in alone[:3])}{', ...' if len(alone) > 3 else ''}"
        for alone, names, what in sides
        if len(alone)
    ]


def _once(
    robot: PoseTable, seen: Seen, rows: NDArray[np.int64], matched: NDArray[np.int64], notes: list[str]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the rows without those that repeat another on both sides; views that repeat while the arm moved are noted."""
    hands = np.unique(robot.Ts[rows].reshape(-1, 16), axis=0, return_inverse=True)[1].ravel()
    eyes = np.unique(seen.Ts[matched].reshape(-1, 16), axis=0, return_inverse=True)[1].ravel()
    eyes = np.where([bool(seen.missed[k]) for k in matched], len(eyes) + np.arange(len(eyes)), eyes)
    first = np.sort(np.unique(np.stack([hands, eyes], axis=1), axis=0, return_index=True)[1])
    if len(first) < len(rows):
        again = [seen.names[k] for k in np.delete(matched, first)]
        more = ", ..." if len(again) > 3 else ""
        notes.append(f"{len(again)} rows repeat another, pose and view, and are left out: {', '.join(again[:3])}{more}")
    rows, matched, eyes = rows[first], matched[first], eyes[first]
    frozen = [k for k in range(len(eyes)) if (eyes == eyes[k]).sum() > 1]
    if frozen:
        named = ", ".join(seen.names[matched[k]] for k in frozen[:4])
        notes.append(f"the very same view in {named}, while the robot moved: a copied or frozen image?")
    return rows, matched


def _tcp(robot: PoseTable, arm: Arm | None) -> list[str]:
    """Return a note where the poses are those of a TCP, not of the model's flange."""
    if arm is None or robot.q is None or robot.of_joints:
        return []
    offset = inverse(np.asarray(arm.forward(robot.q))) @ robot.Ts
    mean = mean_pose(offset)
    left = log_se3(inverse(mean) @ offset)
    if (
        np.median(np.linalg.norm(left[:, :3], axis=1)) > TCP_M
        or np.median(np.linalg.norm(left[:, 3:], axis=1)) > TCP_RAD
    ):
        return [
            f"{robot.path}: its poses are not those of the joints by {arm.name}, at no constant offset; the poses count"
        ]
    p = np.round(1e3 * mean[:3, 3], 1) + 0.0  # without the sign of a zero
    angle = float(np.degrees(np.linalg.norm(log_se3(mean)[3:])))
    if np.linalg.norm(p) < 1.0 and angle < 0.5:
        return []
    return [
        f"{robot.path}: its poses are of a TCP at [{p[0]:.1f} {p[1]:.1f} {p[2]:.1f}] mm, {angle:.1f} deg from the flange "
        f"of {arm.name}: the transform found is from this TCP, not from the flange"
    ]


def links_of(recording: PairedPoses, arm: Arm) -> Array | None:
    """Return T_link_flange (N, L, 4, 4) of all links by the joints of the table; None where it has none."""
    if recording.robot.q is None:
        return None
    q, T_flange_tcp = _joints_of(recording.robot, arm, recording.robot.q)
    frames = np.array([arm.links(one) for one in q[recording.rows]])
    return np.asarray(inverse(frames) @ frames[:, -1:] @ T_flange_tcp)


def _joints_of(robot: PoseTable, arm: Arm, q: Array) -> tuple[Array, Array]:
    """Return joints that give the table's very poses, and the TCP (4, 4) that these are of, in the flange.

    Poses that scatter against their joints would otherwise be explained by errors of links, as what the joints show of it.
    """
    if robot.of_joints:
        return q, np.eye(4)
    T_flange_tcp = mean_pose(inverse(np.asarray(arm.forward(q))) @ robot.Ts)
    goal, q = robot.Ts @ inverse(T_flange_tcp), q.copy()
    for _ in range(2):
        back = inverse(np.asarray(arm.forward(q)))
        by = [log_se3(back @ np.asarray(arm.forward(q + STEP_RAD * one))) / STEP_RAD for one in np.eye(q.shape[1])]
        off = log_se3(back @ goal)
        q += np.einsum("nji,ni->nj", np.linalg.pinv(np.stack(by, axis=2), rcond=1e-2), off)
    return q, T_flange_tcp


def links_between(robot: PoseTable, arm: Arm) -> Callable[[Array], Array] | None:
    """Return what gives T_link_flange (N, L, 4, 4) at times (N,), robot's clock, s; None where the table has no joints."""
    if robot.q is None or robot.t_s is None:
        return None
    t_s, rows = np.unique(robot.t_s, return_index=True)
    q, T_flange_tcp = _joints_of(robot, arm, robot.q)
    q = q[rows]

    def links(times: Array) -> Array:
        between = np.stack([np.interp(times, t_s, column) for column in q.T], axis=1)
        frames = np.array([arm.links(one) for one in between])
        return np.asarray(inverse(frames) @ frames[:, -1:] @ T_flange_tcp)

    return links


def of_streams(
    robot: PoseTable, seen: Seen, sides: tuple[Array, Array], t_s: Array, offset_s: float, in_hand: bool
) -> PairedPoses:
    """Return the rows of two streams that belong together.

    Args:
        robot: the flange's stream.
        seen: the eye's.
        sides: (M, 4, 4) the flange, interpolated, and (M, 4, 4) the target at the eye's times.
        t_s: (M,) these times, eye's clock, s.
        offset_s: added to them, they are the flange's.
        in_hand: whether the arm carries the eye.
    """
    assert robot.t_s is not None
    assert seen.t_s is not None
    rows = np.clip(np.searchsorted(robot.t_s, t_s + offset_s), 0, len(robot.t_s) - 1)
    matched = np.searchsorted(seen.t_s, t_s)
    poses = Poses(*sides, np.zeros((len(t_s), 6, 6)), in_hand, seen.centre)
    names = tuple(f"t {t:.3f} s" for t in t_s)
    return PairedPoses(poses, rows, names, t_s, robot, seen, matched, (*robot.notes, *seen.notes))
