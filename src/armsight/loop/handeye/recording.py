"""Both sides of a hand-eye calibration brought together: row by row, by time, or as two streams."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PureWindowsPath

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Record
from armsight.errors import InputError
from armsight.geometry.pose import adjoint, inverse, log_se3, mean_pose
from armsight.loop.handeye.poses import MIN_POSES, Poses
from armsight.loop.handeye.streams import GAP_S
from armsight.robot.kinematics.arm import Arm
from armsight.tables.poses import PoseTable
from armsight.vision.sources.bag import Bag
from armsight.vision.sources.bag.reader import SUFFIXES
from armsight.vision.sources.bag.states import JointStream, PoseTrack, read_joints, read_track

Rows = NDArray[np.int64]
#: An arm that moves further than this in LATE_S, m, at half of the shots moves on while images are on their way.
LATE_S, MOVING_M = 0.02, 1e-3
#: An arm is taken to rest between two poses of a recording that differ by less, m and rad.
STILL_M, STILL_RAD = 1e-4, 1e-3
#: So many rows of one very pose are a log that stopped, where the target was seen this far apart, m.
STOPPED, STOPPED_M = 3, 0.01
#: Poses of one TCP agree within this, m and rad, with a constant transform from the model's flange.
TCP_M, TCP_RAD = 5e-3, 0.02


@dataclass(frozen=True, eq=False)
class Seen(Record):
    """Poses of the target."""

    Ts: Array  #: (N, 4, 4) T_rig_body, m; where the target was not found, the identity
    covs: Array  #: (N, 6, 6) their covariance, right tangent; zero where it is not known
    names: tuple[str, ...]  #: of the images
    missed: tuple[str, ...]  #: (N,) why there is no pose; "" where there is one
    t_s: Array | None  #: (N,) times, s; None where there are none
    centre: Array  #: (3,) the middle of the target's points, body frame, m
    symmetries: tuple[Array, ...] = ()  #: motions (4, 4) of the body that change nothing to see
    scatter_px: float = 0.0  #: RMS of the reprojection; 0 where there are no images
    notes: tuple[str, ...] = ()  #: what was found out
    #: (N, 6, K) what K independent errors of the rig of one sigma do to the poses; None where unknown
    common: Array | None = None
    table: PoseTable | None = None  #: the table that the poses are from; None where they are from images


@dataclass(frozen=True, eq=False)
class PairedPoses(Record):
    """Rows of both sides."""

    poses: Poses  #: the rows that have both sides
    rows: Rows  #: (N,) the row of the robot's table that each is from
    names: tuple[str, ...]  #: what each is called in messages
    t_s: Array | None  #: (N,) times, s, on one clock; None where there are none
    robot: PoseTable  #: the robot's table
    seen: Seen  #: what was seen
    matched: Rows  #: (N,) the row of ``seen`` that each is from
    notes: tuple[str, ...]  #: what was found out


def seen_in_table(table: PoseTable) -> Seen:
    """Return the target's poses of a table as what was seen."""
    names = table.names or tuple(f"line {line}" for line in table.lines)
    covs = np.zeros((len(table.Ts), 6, 6))
    return Seen(table.Ts, covs, names, table.missed, table.t_s, np.zeros(3), table=table)


def recording_of(robot: Path) -> Path | None:
    """Return the path of a recording given as the robot's poses, bag:FILE or the file; None where it is a table."""
    text = str(robot)
    if text.startswith("bag:"):
        return Path(text[4:])
    return robot if robot.suffix in SUFFIXES or (robot / "metadata.yaml").is_file() else None


def robot_in_recording(path: Path, frames: str | None, arm: Arm | None) -> PoseTable:
    """Read the poses of the flange that a recording holds, a row for each of its messages.

    ``path``: a ROS 1 or ROS 2 bag, or MCAP. ``frames``: BASE:FLANGE, of its transforms; None: the poses are those of
    the joints. ``arm``: the model whose joints are read, by their names.

    Raises:
        InputError: no such recording, frames that it does not have, or joints of other names.
    """
    bag = Bag(path)
    joints = None if arm is None else read_joints(bag, arm.joint_names)
    if arm is not None and joints is None:
        raise InputError(f"{path}: no joint states for --model {arm.name}; it holds {bag.holds()}")
    notes = () if joints is None else joints.notes
    if frames is not None:
        base, _, flange = frames.partition(":")
        if not base or not flange:
            raise InputError(f"--columns frames={frames}: two frames are needed, such as base_link:tool0")
        track = read_track(bag, base, flange)
        q = None if joints is None else joints.at(track.t_s)
    elif joints is not None and arm is not None:
        track, q = PoseTrack(joints.t_s, np.asarray(arm.forward(joints.q))), joints.q
    else:
        raise InputError(
            f"{path}: a recording needs --columns frames=BASE:FLANGE, frames of its transforms such as base_link:tool0, "
            "or --model, the arm whose joint states it holds"
        )
    there = np.asarray(np.isfinite(np.zeros((len(track.t_s), 0)) if q is None else q).all(axis=1))
    n = int(there.sum())
    if n < len(there):
        notes += (f"{path}: {len(there) - n} of {len(there)} transforms have no joint states around them: left out",)
    if n < MIN_POSES:
        raise InputError(
            f"{path}: {frames or 'the joints'}: {n} poses over time, {MIN_POSES} and more are needed: is it a fixed"
            " transform, or have the joint states other times?"
        )
    return PoseTable(
        path=path,
        lines=1 + np.flatnonzero(there),
        Ts=track.Ts[there],
        q=None if q is None else q[there],
        t_s=track.t_s[there],
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
    notes, inside = list(robot.notes), inside[~lost]
    if lost.any():
        notes.append(
            f"{robot.path}: {int(lost.sum())} shots are in gaps of over {GAP_S:g} s in which the arm moved: left out"
        )
    t_s, track = seen.t_s[inside], PoseTrack(robot.t_s, robot.Ts)
    Ts = track.at(t_s)
    late_m = np.linalg.norm(track.at(t_s + LATE_S)[:, :3, 3] - Ts[:, :3, 3], axis=1)
    if len(late_m) and np.median(late_m) > MOVING_M:
        notes.append(
            f"{robot.path}: in half of the shots the arm moves by {1e3 * np.median(late_m):.1f} mm and more in"
            f" {1e3 * LATE_S:.0f} ms, and images come later than their stamps say: --streams finds by how much"
        )
    return replace(
        robot,
        lines=1 + inside,
        Ts=Ts,
        q=None if robot.q is None else JointStream((), robot.t_s, robot.q).at(t_s),
        t_s=t_s,
        names=tuple(seen.names[k] for k in inside),
        notes=tuple(notes),
        missed=("",) * len(inside),
    )


def paired(robot: PoseTable, seen: Seen, in_hand: bool, arm: Arm | None) -> PairedPoses:
    """Bring the rows together: by name where the robot's table has names that were seen, else by order.

    Raises:
        InputError: rows and images do not pair up, or hardly one shows the target.
    """
    rows, matched = matched_rows(robot, seen.names, seen.missed)
    notes = [*robot.notes, *seen.notes, *_alone(robot, seen, rows, matched)]
    rows, matched = _once(robot, seen, rows, matched, notes)
    shown = np.array([not seen.missed[k] for k in matched])
    known = np.array([not robot.missed[r] for r in rows])
    notes += _named("no target in", [f"{seen.names[k]} ({seen.missed[k]})" for k in matched[~shown]])
    notes += _named(f"{robot.path}: no pose in", [f"line {robot.lines[r]} ({robot.missed[r]})" for r in rows[~known]])
    rows, matched = rows[shown & known], matched[shown & known]
    if len(rows) < MIN_POSES:
        of = f" of {len(known)}" if len(rows) < len(known) else ""
        raise InputError(f"{len(rows)}{of} poses have both sides; {MIN_POSES} and more are needed, 15 are advised")
    A, B, covs = robot.Ts[rows], seen.Ts[matched], seen.covs[matched]
    common = None if seen.common is None else seen.common[matched]
    if seen.symmetries:
        B, rotated = upright(A, B, seen.symmetries)
        flipped = np.flatnonzero(rotated >= 0)
        Ad = adjoint(inverse(np.array(seen.symmetries)))[rotated[flipped]]
        covs[flipped] = Ad @ covs[flipped] @ np.swapaxes(Ad, 1, 2)
        if common is not None:
            common[flipped] = Ad @ common[flipped]
        if len(flipped):
            notes.append(f"the board looks the same rotated: {len(flipped)} of {len(B)} were rotated to agree")
    _require_moving(robot, rows, B)
    both_clocks = robot.t_s is not None and seen.t_s is not None
    t_s = robot.t_s[rows] if robot.t_s is not None and (both_clocks or seen.t_s is None) else None
    lines = tuple(f"line {robot.lines[r]}" for r in rows)
    names = tuple(n if n == seen.names[k] else f"{n} ({seen.names[k]})" for n, k in zip(lines, matched, strict=True))
    notes += _tcp(robot, arm)
    poses = Poses(A, B, covs, in_hand, seen.centre, common)
    return PairedPoses(poses, rows, names, t_s, robot, seen, matched, tuple(notes))


def _named(what: str, left_out: Sequence[str]) -> list[str]:
    """Return a note that names the first rows that are left out, if there are any."""
    more = f" and {len(left_out) - 3} more" if len(left_out) > 3 else ""
    return [f"{what} {', '.join(left_out[:3])}{more}: left out"] if left_out else []


def upright(A: Array, B: Array, symmetries: Sequence[Array]) -> tuple[Array, Rows]:
    """Decide which way up a board was that looks the same rotated: angles between poses are the same on both sides.

    ``A``: (N, 4, 4) poses of the flange. ``B``: (N, 4, 4) poses of the body, some of them rotated by a symmetry.
    ``symmetries``: the motions of the body that change nothing to see.

    Returns:
        B with the rotated ones rotated back to agree with the first, and which symmetry was used, -1 for none.
    """

    def angles(Rs: Array, others: Array) -> Array:
        traces = np.einsum("...nab,mab->...nm", Rs[..., :3, :3], others[:, :3, :3])
        return np.asarray(np.arccos(np.clip((traces - 1) / 2, -1, 1)))

    options = np.stack([B @ S for S in (np.eye(4), *symmetries)])  # (S, N, 4, 4)
    rows, chosen, hand = np.arange(len(A)), np.zeros(len(A), np.int64), angles(A, A)
    for _ in range(20):
        cost = np.abs(angles(options, options[chosen, rows]) - hand).sum(axis=2)
        gain = cost[chosen, rows] - cost.min(axis=0)
        gain[0] = 0.0
        worst = int(np.argmax(gain))
        if gain[worst] < 1e-6:
            break
        chosen[worst] = int(np.argmin(cost[:, worst]))
    return np.asarray(options[chosen, rows]), chosen - 1


def steady(B: Array, symmetries: Sequence[Array]) -> Array:
    """Return poses B (N, 4, 4) of a stream, each rotated by the symmetry (4, 4) that is nearest to the pose before it."""
    out, choices = B.copy(), np.stack([np.eye(4), *symmetries])
    for k in range(1, len(B)):
        options = B[k] @ choices
        out[k] = options[int(np.argmax(np.einsum("ab,nab->n", out[k - 1, :3, :3], options[:, :3, :3])))]
    return out


def _require_moving(robot: PoseTable, rows: Rows, B: Array) -> None:
    """Raise an InputError where rows of the table hold one pose while the target was seen in several."""
    same = _alike(robot.Ts[rows])
    for k in np.flatnonzero(np.bincount(same) >= STOPPED):
        stopped = np.flatnonzero(same == k)
        apart_m = float(np.linalg.norm(B[stopped, :3, 3] - B[stopped[0], :3, 3], axis=1).max())
        if apart_m > STOPPED_M:
            lines = robot.lines[rows[stopped]]
            raise InputError(
                f"{robot.path}: lines {lines.min()} to {lines.max()}: {len(lines)} rows hold the very same pose, while the"
                f" target was seen up to {1e3 * apart_m:.0f} mm apart: a log that stopped? Leave these rows out"
            )


def _alike(Ts: Array) -> Rows:
    """Return a number (N,) for each pose that only the very same ones share."""
    return np.asarray(np.unique(Ts.reshape(-1, 16), axis=0, return_inverse=True)[1].ravel())


def matched_rows(robot: PoseTable, seen: Sequence[str], missed: Sequence[str]) -> tuple[Rows, Rows]:
    """Return the rows of both sides that belong together: by name where the robot's table has names, else by order.

    ``robot``: the robot's table. ``seen``: names of what was seen, one a row. ``missed``: why each has no pose, or "". Rows
    without a pose beneath the last one of the longer side are no mistake: spreadsheets leave such.

    Raises:
        InputError: no name is among those seen, or other numbers of rows.
    """
    if robot.names is not None:
        there = {name: k for k, name in enumerate(seen)} | {Path(name).stem: k for k, name in enumerate(seen)}
        keys = [
            next((key for key in (name, PureWindowsPath(name).name, PureWindowsPath(name).stem) if key in there), None)
            for name in robot.names  # Windows' separators are / too
        ]
        found = [(r, there[key]) for r, key in enumerate(keys) if key is not None]
        if not found:
            raise InputError(
                f"{robot.path}: none of its names ({robot.names[0]}, ...) is among those seen ({seen[0]}, ...): write in "
                "that column what the images are called"
            )
        rows, matched = np.array(found).T
        return rows, matched
    count = min(len(robot.Ts), len(seen))
    if not all((*robot.missed[count:], *missed[count:])):
        shown = f" (of which {missed.count('')} hold a target)" if any(missed) else ""
        raise InputError(
            f"{robot.path}: {len(robot.Ts)} rows, but {len(seen)} images or target poses{shown}: which belong "
            "together? give it a column image (or name), or t_s on both sides (handeye: with --streams)"
        )
    return np.arange(count), np.arange(count)


def _alone(robot: PoseTable, seen: Seen, rows: Rows, matched: Rows) -> list[str]:
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


def _once(robot: PoseTable, seen: Seen, rows: Rows, matched: Rows, notes: list[str]) -> tuple[Rows, Rows]:
    """Return the rows without those that repeat another on both sides; views that repeat while the arm moved are noted."""
    hands, eyes = _alike(robot.Ts[rows]), _alike(seen.Ts[matched])
    lost = [bool(seen.missed[k] or robot.missed[r]) for r, k in zip(rows, matched, strict=True)]
    eyes = np.where(lost, len(eyes) + np.arange(len(eyes)), eyes)
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
    robot = robot.without_missed()
    if arm is None or robot.q is None or robot.of_joints:
        return []
    offset = inverse(np.asarray(arm.forward(robot.q))) @ robot.Ts
    mean = mean_pose(offset)
    left = log_se3(inverse(mean) @ offset)
    off_m, off_rad = (np.median(np.linalg.norm(part, axis=1)) for part in (left[:, :3], left[:, 3:]))
    if off_m > TCP_M or off_rad > TCP_RAD:
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


def links_of(robot: PoseTable, arm: Arm | None, at: Array) -> Callable[[Array], Array] | None:
    """Return what gives T_link_flange (M, L, 4, 4) of all links between rows of a table; None without a model or joints.

    The joints are taken to give the table's very poses: such as scatter against them would be explained by errors of links.

    ``robot``: the table, N rows. ``arm``: the model. ``at``: (N,) by what the returned function knows each row: its
    number, or its time.
    """
    if arm is None or robot.q is None:
        return None
    at, robot = at[[not why for why in robot.missed]], robot.without_missed()
    assert robot.q is not None
    at, rows = np.unique(at, return_index=True)
    q, Ts, T_flange_tcp = robot.q[rows], robot.Ts[rows], np.eye(4)
    if not robot.of_joints:
        T_flange_tcp = mean_pose(inverse(np.asarray(arm.forward(q))) @ Ts)
        goal = Ts @ inverse(T_flange_tcp)
        for _ in range(2):
            back = inverse(np.asarray(arm.forward(q)))
            q = q + np.einsum("nji,ni->nj", np.linalg.pinv(arm.jacobian(q, "tool"), rcond=1e-2), log_se3(back @ goal))

    def links(between: Array) -> Array:
        joints = np.stack([np.interp(between, at, column) for column in q.T], axis=1)
        frames = np.array([arm.links(one) for one in joints])
        return np.asarray(inverse(frames) @ frames[:, -1:] @ T_flange_tcp)

    return links


def of_streams(
    robot: PoseTable, seen: Seen, sides: tuple[Array, Array], t_s: Array, offset_s: float, in_hand: bool
) -> PairedPoses:
    """Return the rows of two streams that belong together.

    ``sides``: (M, 4, 4) the flange, interpolated, and (M, 4, 4) the target at the eye's times. ``t_s``: (M,) these
    times, eye's clock, s. ``offset_s``: added to them, they are the flange's.
    """
    assert robot.t_s is not None
    assert seen.t_s is not None
    rows = np.clip(np.searchsorted(robot.t_s, t_s + offset_s), 0, len(robot.t_s) - 1)
    poses = Poses(*sides, np.zeros((len(t_s), 6, 6)), in_hand, seen.centre)
    names, notes = tuple(f"t {t:.3f} s" for t in t_s), (*robot.notes, *seen.notes)
    return PairedPoses(poses, rows, names, t_s, robot, seen, np.searchsorted(seen.t_s, t_s), notes)
