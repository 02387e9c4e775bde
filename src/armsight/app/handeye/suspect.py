"""What is wrong with hand-eye data that do not fit: other readings of the same numbers are tried.

In: a recording. Out: nothing where it fits as given; an InputError in one line where another reading fits far better: rows
shifted against the images, from the first on or from where one is missing, the other mounting or inverse transforms,
another unit, another order of angles, quaternions, axes or joints, another arm, or where something was displaced.

How well a reading fits is given by two quantiles of the residuals of the closed forms
(:func:`~armsight.loop.handeye.poses.starts`): of a position, m, or of a rotation as it moves a point at 0.3 m. The
median alone does not do: where an arm moves in equal steps, rows that are shifted by one fit another mounting but where the
steps change, a third of the rows.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations, permutations
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from armsight.app.handeye.recording import PairedPoses
from armsight.data import Array
from armsight.errors import InputError
from armsight.geometry.pose import inverse, log_se3, mean_pose
from armsight.loop.handeye.handeye import CONTRADICTS, rotations_of, scale_between
from armsight.loop.handeye.poses import LEVER_M, Poses, residuals, starts
from armsight.robot.kinematics.arm import Arm
from armsight.robot.models import MODELS
from armsight.tables.misread import Misread, misreadings
from armsight.tables.poses import MIXED

#: Of the residuals that are looked at: their median, and what nine of ten are below.
QUANTILES = (0.5, 0.9)
#: Data whose median residual is below this, m, are taken as they are, if nine of ten are plausible.
FITS_M = 2e-3
#: Another reading must fit better by this factor in either quantile, and be below this, m, in it.
BETTER, PLAUSIBLE_M = 4.0, 0.02
#: A reading is preferred to those before it where its residual is smaller by this: xyz and ZYX are the same.
SMALLER = 0.99
#: Poses that a reading is evaluated by at most.
EVALUATED = 60
#: Rows that poses and images have in common at least where they are shifted (half of them besides: few rows fit anything),
#: and shifts that are tried: those for which both sides rotate alike.
COMMON, SHIFTS = 6, 4
#: Rows at least on either side of where something may have been displaced, and rows that are tried first.
PART, TRIED = 6, 12
#: Orders of the joints that are looked at: the angles between poses do not distinguish parallel axes.
ORDERS = 12
#: Mirrors one axis; the other two are this one rotated.
MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
#: Units that lengths may be in, m.
UNITS = {"millimetres": 1e-3, "centimetres": 1e-2, "inches": 0.0254, "metres": 1.0}

#: Scales that differ from a unit's by less than this part are the unit.
A_UNIT = 0.1


class _Reading(NamedTuple):
    """The data read in another way.

    Attributes:
        poses: what they are then.
        said: what it would mean, and what to do.
        path: the file that it is about; None: the robot's table.
        of_length: how long 1 m of the robot's is in this reading, m.
        of_units: whether all lengths of one side are in another unit: they can be converted.
    """

    poses: Poses
    said: str
    path: Path | None = None
    of_length: float = 1.0
    of_units: bool = False


def misfit(poses: Poses, *, scale: bool = False) -> Array:
    """Return the quantiles (2,) of the residuals, m, of the best closed form; with scale, of a target as large as fits."""
    _, e = _evaluated(_sized(poses, scale_between(poses)) if scale else poses)
    return np.quantile(_sizes(e), QUANTILES) if len(e) else np.full(2, np.inf)


def _evaluated(poses: Poses) -> tuple[Poses, Array]:
    """Return the poses that are looked at, and their residuals (N, 6) of the best closed form, (0, 6) if there is none."""
    rows = np.linspace(0, len(poses.A) - 1, min(EVALUATED, len(poses.A))).round().astype(np.int64)
    part = poses.rows(rows)
    found = starts(part.A, part.right_side)
    return part, residuals(part, *found[0][::-1])[0] if found else np.zeros((0, 6))


def _determined(poses: Poses) -> bool:
    """Return whether the flange rotates about two axes, as a calibration demands: closed forms say nothing otherwise.

    Where the rotations of both sides contradict each other it is not the motion that is wrong.
    """
    part, e = _evaluated(poses)
    if not len(e):
        return True
    spread, _, noise, least = rotations_of(part, e)
    return bool(noise > CONTRADICTS or spread[1] >= least)


def _better(off: Array, as_given: Array, *, length: float = 1.0) -> bool:
    """Return whether other residuals are those of data that fit, and far smaller than as given.

    Args:
        off: (2,) quantiles, m.
        as_given: (2,) quantiles, m.
        length: how long 1 m of the robot's is in the other reading, m: residuals of a world that is read smaller are
            smaller.
    """
    fits = (off < PLAUSIBLE_M) & (off / length < as_given / BETTER)
    return bool(fits.any() and off[0] < max(FITS_M, as_given[0]))


def _sizes(e: Array) -> Array:
    """Return by how much tangents (N, 6) move a point at 0.3 m, (N,), m."""
    return np.asarray(np.hypot(np.linalg.norm(e[:, :3], axis=1), LEVER_M * np.linalg.norm(e[:, 3:], axis=1)))


def resized(Ts: Array, before: Array, after: Array) -> Array:
    """Return poses with their lengths converted as those of others were, (N, 4, 4) all."""
    return _longer(Ts, float(np.linalg.norm(after[:, :3, 3]) / max(float(np.linalg.norm(before[:, :3, 3])), 1e-12)))


def _longer(Ts: Array, by: float) -> Array:
    """Return poses (N, 4, 4) with their lengths multiplied."""
    out = Ts.copy()
    out[:, :3, 3] *= by
    return out


def _sized(p: Poses, by: float) -> Poses:
    """Return the poses with the target's lengths multiplied."""
    unit = np.repeat([by, 1.0], 3)
    common = None if p.common is None else unit[:, None] * p.common
    return replace(p, B=_longer(p.B, by), cov=p.cov * np.outer(unit, unit), centre=by * p.centre, common=common)


def _angles(Ts: Array) -> Array:
    """Return the angles between neighbouring poses, rad."""
    return np.asarray(np.linalg.norm(log_se3(inverse(Ts[:-1]) @ Ts[1:])[:, 3:], axis=1))


def require_plausible(
    recording: PairedPoses, arm: Arm | None, *, detect_units: bool = False, scale: bool = False, streams: bool = False
) -> PairedPoses:
    """Reject data that fit far better read in another way.

    Args:
        recording: the rows.
        arm: the model, where the robot's poses come from joints.
        scale: whether the target's size is fitted, and may be anything.
        streams: whether the rows are of streams whose clocks agree roughly only: they are not shifted then.
        detect_units: whether lengths in another unit are converted, with a note, in place of an error.

    Returns:
        The recording, its lengths converted where that was asked for and needed.

    Raises:
        InputError: what is likely wrong, and what to do.
    """
    p = recording.poses
    as_given = misfit(p, scale=scale)
    if as_given[0] < FITS_M and as_given[1] < PLAUSIBLE_M:
        return recording
    reading = _best(recording, arm, as_given, scale=scale, streams=streams)
    if reading is not None:
        if detect_units and reading.of_units:
            note = f"{reading.said.partition(':')[0]}; converted"
            return replace(recording, poses=reading.poses, notes=(*recording.notes, note))
        off = misfit(reading.poses, scale=scale)
        raise InputError(
            f"{reading.path or recording.robot.path}: {reading.said} (half of the rows then within {1e3 * off[0]:.1f} mm, "
            f"nine of ten {1e3 * off[1]:.1f}; as given {1e3 * as_given[0]:.1f} and {1e3 * as_given[1]:.1f})"
        )
    if not _determined(p):  # the calibration says so
        return recording
    displaced = _displaced(p, as_given) if not scale else None
    if displaced is not None:
        first, what = _moved(p, displaced)
        raise InputError(
            f"{recording.robot.path}: the rows up to {recording.names[first - 1]} and those from "
            f"{recording.names[first]} on fit one mounting each, but not the same (as given, half of the rows are within "
            f"{1e3 * as_given[0]:.1f} mm, nine of ten {1e3 * as_given[1]:.1f}): {what} about there: use one of both parts"
        )
    if as_given[0] > max(PLAUSIBLE_M, _spread(p) / BETTER):
        raise InputError(
            f"{recording.robot.path}: half of the rows are off by more than {1e3 * as_given[0]:.0f} mm in any mounting, "
            "and no other reading fits: robot and images are not of the same motion, or which row belongs to which, a "
            "rotation or the joints are read wrongly; check one row by hand, or take the poses again"
        )
    notes = _nearer_models(recording, arm, as_given[0], scale=scale)
    if as_given[0] > PLAUSIBLE_M:
        notes.append(
            f"{recording.robot.path}: half of the rows are off by more than {1e3 * as_given[0]:.0f} mm in any mounting, "
            "and no other reading fits: check one row by hand"
        )
    return replace(recording, notes=(*recording.notes, *notes))


def _nearer_models(recording: PairedPoses, arm: Arm | None, as_given: float, *, scale: bool) -> list[str]:
    """Return notes of models of other arms that fit better by half: a generation of an arm differs little from the next."""
    table, p = recording.robot, recording.poses
    if arm is None or table.q is None or table.numbers.shape[1]:
        return []
    q = table.q[recording.rows]
    found = {other: float(misfit(replace(p, A=A), scale=scale)[0]) for other, A in _models(arm, q)}
    best = min(found, key=lambda other: found[other], default="")
    if not best or found[best] > as_given / 2:
        return []
    return [
        f"{table.path}: the joints fit --model {best} better than {arm.name}: half of the rows are within "
        f"{1e3 * found[best]:.1f} mm, not {1e3 * as_given:.1f}: which is it?"
    ]


def _models(arm: Arm, q: Array) -> Iterator[tuple[str, Array]]:
    """Yield the names of other models of as many joints, and the flange (N, 4, 4) by them."""
    for other in MODELS.values():
        if len(other.joint_names) == q.shape[1] and other.name != arm.name:
            yield other.name, np.asarray(other.forward(q))


def _spread(p: Poses) -> float:
    """Return the median distance of the target's poses from their mean, m: what an unknown arm would leave."""
    return float(np.median(_sizes(log_se3(inverse(mean_pose(p.B)) @ p.B))))


def _best(recording: PairedPoses, arm: Arm | None, as_given: Array, *, scale: bool, streams: bool) -> _Reading | None:
    """Return the reading that fits best of those that fit far better than as given; None where none does."""
    best, found = np.inf, None
    for reading in _readings(recording, arm, streams):
        try:
            off = misfit(reading.poses, scale=scale)
        except np.linalg.LinAlgError:
            continue
        if not _better(off, as_given, length=reading.of_length):
            continue
        left = (off[0] + min(off[1], PLAUSIBLE_M)) / reading.of_length
        if left < SMALLER * best and _determined(reading.poses):
            best, found = left, reading
    return found


def _displaced(p: Poses, as_given: Array) -> int | None:
    """Return the first row after which another mounting fits, where either part alone fits far better than the whole."""
    n = len(p.A)

    def worse(k: int) -> Array:
        return np.maximum(misfit(p.rows(np.arange(k))), misfit(p.rows(np.arange(k, n))))

    def left(k: int) -> float:
        return float(found[k].sum())

    if n < 2 * PART:
        return None
    tried = np.unique(np.linspace(PART, n - PART, min(TRIED, n - 2 * PART + 1)).round().astype(int))
    found = {int(k): worse(int(k)) for k in tried}
    step = int(np.diff(tried).max()) if len(tried) > 1 else 1
    while step > 1:
        step = (step + 1) // 2
        best = min(found, key=left)
        for k in (best - step, best + step):
            if PART <= k <= n - PART and k not in found:
                found[k] = worse(k)
    best = min(found, key=left)
    return best if _better(found[best], as_given) else None


def _moved(p: Poses, row: int) -> tuple[int, str]:
    """Return the first row of another mounting, about a row, and what was displaced before it.

    That is what the flange carries, what stands still, or either.
    """
    rows = np.arange(len(p.A))
    parts = (p.rows(rows[:row]), p.rows(rows[row:]))
    (X, Z), (X_after, Z_after) = (starts(part.A, part.right_side)[0] for part in parts)
    before, after = (_sizes(residuals(p, *both)[0]) for both in ((Z, X), (Z_after, X_after)))
    costs = np.append(0.0, np.cumsum(before - after))[PART : len(rows) - PART + 1]
    first = PART + int(np.argmin(costs))
    held, still = (log_se3(inverse(T) @ T_after) for T, T_after in ((X, X_after), (Z, Z_after)))
    sizes = _sizes(np.array([held, still]))
    camera, target = ("the camera", "the target") if p.in_hand else ("the target", "the camera")
    if sizes.max() < BETTER * sizes.min():
        return first, "base, camera, target or the robot's TCP were displaced or changed"
    e, what = (held, f"{camera} on the flange was displaced, or the TCP changed,")
    if sizes[1] > sizes[0]:
        e, what = still, f"the robot's base, or {target}, was displaced"
    return first, f"{what} by {1e3 * np.linalg.norm(e[:3]):.0f} mm and {np.degrees(np.linalg.norm(e[3:])):.1f} deg"


def _readings(recording: PairedPoses, arm: Arm | None, streams: bool) -> Iterator[_Reading]:
    """Yield other readings of the same data, with what they would mean."""
    p = recording.poses
    if not streams:
        yield from _other_rows(recording)
    mountings = ("in_hand", "to_hand")
    given, other = mountings if p.in_hand else mountings[::-1]
    yield _Reading(
        replace(p, in_hand=not p.in_hand),
        f"these poses fit --eye {other.replace('_', '-')}, not {given.replace('_', '-')}: either the mounting is the other "
        "one, or one of the tables holds inverse transforms (base in flange, as easy_handeye saves them for a camera that "
        "stands still; or rig in target): invert it",
    )
    units = list(_scaled(recording))
    yield from units
    if all(abs(np.log(scale_between(one.poses))) > A_UNIT for one in units):
        whose = "" if arm is None else f", and --model {arm.name} the arm"
        size = scale_between(p)
        yield _Reading(
            _sized(p, size),
            f"the target seems to be {size:.3g} times as large as given: is --target's size right{whose}? "
            "--scale fits it",
        )
    yield _Reading(
        replace(p, A=MIRROR @ p.A @ MIRROR),
        "one of the tables is of a left-handed frame: one axis is mirrored, in positions and rotations; robot and camera "
        "poses are right-handed: change the sign of one axis, and of the rotations about the two others",
    )
    table, seen = recording.robot, recording.seen.table
    sides = [(table, recording.rows, "A", "")]
    sides += [] if seen is None else [(seen, recording.matched, "B", "seen-")]
    kinds: dict[str, list[tuple[str, Misread]]] = {}
    for one, rows, side, option in sides:
        for reading in misreadings(one, rows, getattr(p, side), option):
            kinds.setdefault(reading.kind, []).append((side, reading))
            yield _Reading(_with(p, side, reading.Ts), reading.said, one.path)
    for both in kinds.values():  # what one program wrote wrongly it may have written wrongly in both tables
        if len(both) == 2:
            (_, robots), (_, seens) = both
            said = robots.said if robots.said == seens.said else f"{robots.said}; and in {seens.path}: {seens.said}"
            yield _Reading(replace(p, A=robots.Ts, B=seens.Ts), said)
    if arm is not None and table.q is not None and table.numbers.shape[1] == 0:
        yield from (_Reading(replace(p, A=A), said) for A, said in _joints(p, arm, table.q[recording.rows]))


def _with(p: Poses, side: str, Ts: Array) -> Poses:
    """Return the poses with other ones on one side, A or B."""
    return replace(p, A=Ts) if side == "A" else replace(p, B=Ts)


def _other_rows(recording: PairedPoses) -> Iterator[_Reading]:
    """Yield rows shifted against the images, from the first on or from a later one, or in reverse."""
    p, n = recording.poses, len(recording.poses.A)
    hand, eye = _angles(p.A), _angles(p.right_side)
    shifts = [shift for k in range(1, n - max(COMMON, n // 2) + 1) for shift in (k, -k)]
    off = [np.median(np.abs(hand[max(s, 0) : n - 1 + min(s, 0)] - eye[max(-s, 0) : n - 1 - max(s, 0)])) for s in shifts]
    for shift in dict.fromkeys([*shifts[:2], *(shifts[k] for k in np.argsort(off)[:SHIFTS])]):
        if (found := _shifted(p, shift)) is None:
            continue
        hands, eyes, first = found
        where = f"{recording.robot.path.name} line {recording.robot.lines[recording.rows[hands[first]]]} belongs to "
        where += recording.seen.names[recording.matched[eyes[first]]]
        why = "a row is missing" if shift < 0 else "a row is too much"
        since = f", from {recording.names[first]} on: {why} before it" if first else ""
        todo = "add a column image" if recording.robot.names is None else "correct its column of names"
        yield _Reading(
            replace(p.rows(eyes), A=p.A[hands]),
            f"the rows are shifted by {abs(shift)} against the images{since}; {where}; remove what is too much, or {todo}",
        )
    yield _Reading(replace(p, A=p.A[::-1]), "the rows are in reverse order against the images")


def _shifted(p: Poses, shift: int) -> tuple[NDArray[np.int64], NDArray[np.int64], int] | None:
    """Return rows of the robot and of the images that belong together where later rows are shifted.

    Returns:
        Both, and how many rows at the beginning are not shifted; None where those that are do not fit better.
    """
    n, most = len(p.A), PLAUSIBLE_M
    hands = np.arange(max(shift, 0), n + min(shift, 0))
    whole = replace(p.rows(hands - shift), A=p.A[hands])
    best, first = np.inf, 0
    for part in (whole, p):
        X, Z = starts(part.A, part.right_side)[0]
        as_given, shifted = (np.minimum(_sizes(residuals(one, Z, X)[0]), most) for one in (p, whole))
        later = np.full(n, most)
        later[hands] = shifted
        costs = np.append(0.0, np.cumsum(as_given)) + np.append(np.cumsum(later[::-1])[::-1], 0.0)
        k = int(np.argmin(costs[: n - abs(shift) - 2]))
        if costs[k] < SMALLER * best and (k <= max(shift, 0) or np.median(later[k:]) < most / BETTER):
            best, first = float(costs[k]), k
    if np.isinf(best):
        return None
    first = first if first > max(shift, 0) else 0  # rows before the first that has an image are not shifted either
    later_hands = hands[hands >= first + (max(shift, 0) if first else 0)]
    earlier = np.arange(first)
    return np.append(earlier, later_hands), np.append(earlier, later_hands - shift), first


def _scaled(recording: PairedPoses) -> Iterator[_Reading]:
    """Yield readings of the robot's and of the target's lengths in other units."""
    p, robot, seen = recording.poses, recording.robot, recording.seen.table
    sides: list[tuple[str, str, float, str, Path | None]] = []
    sides += [("A", "robot", robot.unit_m, "--units", robot.path)] if not robot.of_joints else []
    sides += [("B", "target", 1.0, "--target's size", None)] if seen is None else []
    sides += [("B", "target", seen.unit_m, "--seen-units", seen.path)] if seen is not None else []
    for side, whose, unit_m, option, path in sides:
        given = next(name for name, length in UNITS.items() if length == unit_m)
        T = getattr(p, side).copy()
        lengths = np.linalg.norm(T[:, :3, 3], axis=1)
        if (short := lengths < lengths.max() / MIXED).any():
            T[short, :3, 3] *= 1e3
            said = f"{short.sum()} of {len(short)} rows of the {whose} are in metres, the others in mm: correct them"
            yield _Reading(_with(p, side, T), said, path)
        for name, length in UNITS.items():
            if name != given:
                by = length / unit_m
                yield _Reading(
                    replace(p, A=_longer(p.A, by)) if side == "A" else _sized(p, by),
                    f"the {whose}'s lengths are {name} taken for {given}: correct {option}, or give --detect-units",
                    path,
                    by if side == "A" else 1.0,
                    of_units=True,
                )


def _joints(p: Poses, arm: Arm, q: Array) -> Iterator[tuple[Array, str]]:
    """Yield the flange (N, 4, 4) by other readings of the joints: another unit, sense, zero or order, or another arm.

    Of all permutations those that the angles between poses support.
    """
    n = q.shape[1]
    if np.abs(radians := np.degrees(q)).max() < 2 * np.pi:
        yield np.asarray(arm.forward(radians)), "the joints are in radians, not degrees: name their columns q1_rad .."
    for joint, one in enumerate(np.eye(n)):
        said = f"joint {joint + 1} ({arm.joint_names[joint]})"
        yield (
            np.asarray(arm.forward(q * (1 - 2 * one))),
            f"{said} counts the other way than {arm.name}'s: change the sign of q{joint + 1}",
        )
        for degrees in (90, -90, 180) if 0 < joint < n - 1 else ():
            yield (
                np.asarray(arm.forward(q + np.radians(degrees) * one)),
                f"{said} has another zero than {arm.name}'s: add {degrees} deg to q{joint + 1}",
            )
    for named, at in _orders(p, arm, q):
        yield np.asarray(arm.forward(q[:, at])), f"the joints are in another order: {arm.name}'s are {named} here"
    for other, A in _models(arm, q):
        yield A, f"the joints fit --model {other}, not {arm.name}"


def _orders(p: Poses, arm: Arm, q: Array) -> Iterator[tuple[str, NDArray[np.int64]]]:
    """Yield the orders of the joints that the angles between poses support best, and how they are named."""
    n = q.shape[1]
    rows = np.linspace(0, len(q) - 1, min(EVALUATED, len(q))).round().astype(np.int64)
    seen = _angles(p.right_side[rows])
    orders: list[tuple[int, ...]] = [
        tuple(j if k == i else i if k == j else k for k in range(n)) for i, j in combinations(range(n), 2)
    ]
    orders.append(tuple(range(n))[::-1])
    if n <= 6:
        orders = [order for order in permutations(range(n)) if order != tuple(range(n))]
    scored: list[tuple[float, NDArray[np.int64]]] = []
    for order in orders:
        rotated = _angles(np.asarray(arm.forward(q[rows][:, order])))
        scored.append((float(np.median(np.abs(rotated - seen))), np.array(order)))
    for _, at in sorted(scored, key=lambda one: one[0])[:ORDERS]:
        yield ", ".join(f"q{k + 1}" for k in at), at
