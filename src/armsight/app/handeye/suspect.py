"""What is wrong with hand-eye data that do not fit: other readings of the same numbers are tried.

In: a recording. Out: nothing where it fits as given; an InputError in one line where another reading fits far better: rows
shifted against the images, the other mounting or inverse transforms, another unit, another order of angles, quaternions or
joints.

How well a reading fits is the median residual of the closed forms
(:func:`~armsight.loop.handeye.handeye.starts`): of a position, m, or of a rotation as it moves a point at 0.3 m.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations, permutations

import numpy as np
from numpy.typing import NDArray

from armsight.app.handeye.read import CONVENTIONS, rotations_by, stacked
from armsight.app.handeye.recording import PairedPoses
from armsight.data import Array
from armsight.errors import InputError
from armsight.geometry.pose import inverse, log_se3
from armsight.loop.handeye.handeye import LEVER_M, Poses, residuals, starts
from armsight.loop.handeye.structured import scale_between
from armsight.robot.arm import Arm

#: Data whose median residual is below this, m, are taken as they are.
FITS_M = 2e-3
#: Another reading must fit better by this factor, and its median residual be below this, m.
BETTER, PLAUSIBLE_M = 4.0, 0.02
#: A reading is preferred to those before it where its residual is smaller by this: xyz and ZYX are the same.
SMALLER = 0.99
#: Poses that a reading is evaluated by at most, and the rows by which poses are looked for against the images.
EVALUATED, SHIFTS = 60, (1, -1, 2, -2)
#: Rows at least on either side of where something may have been displaced, and rows that are tried first.
PART, TRIED = 6, 12
#: Orders of the joints that are looked at: the angles between poses do not distinguish parallel axes.
ORDERS = 12
#: Mirrors one axis; the other two are this one rotated.
MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
#: Scales that mistaken units make: mm for m, cm, inches.
UNITS = {
    1000.0: "millimetres taken for metres",
    100.0: "centimetres taken for metres",
    39.37: "inches taken for metres",
}


def misfit(poses: Poses) -> float:
    """Return the median residual, m, of the best closed form."""
    rows = np.linspace(0, len(poses.A) - 1, min(EVALUATED, len(poses.A))).round().astype(np.int64)
    part = poses.rows(rows)
    found = starts(part.A, part.right_side)
    if not found:
        return float("inf")
    X, Z = found[0]
    return float(np.median(_sizes(residuals(part, Z, X)[0])))


def _sizes(e: Array) -> Array:
    """Return by how much tangents (N, 6) move a point at 0.3 m, (N,), m."""
    return np.asarray(np.hypot(np.linalg.norm(e[:, :3], axis=1), LEVER_M * np.linalg.norm(e[:, 3:], axis=1)))


def resized(Ts: Array, before: Array, after: Array) -> Array:
    """Return poses with their lengths converted as those of others were, (N, 4, 4) all."""
    out = Ts.copy()
    out[:, :3, 3] *= np.linalg.norm(after[:, :3, 3]) / max(float(np.linalg.norm(before[:, :3, 3])), 1e-12)
    return out


def _resized(p: Poses) -> Poses:
    """Return the poses with the target's lengths multiplied by what fits."""
    B = p.B.copy()
    B[:, :3, 3] *= scale_between(p)
    return replace(p, B=B)


def _angles(Ts: Array) -> Array:
    """Return the angles between neighbouring poses, rad."""
    return np.asarray(np.linalg.norm(log_se3(inverse(Ts[:-1]) @ Ts[1:])[:, 3:], axis=1))


def require_plausible(
    recording: PairedPoses,
    arm: Arm | None,
    *,
    detect_units: bool = False,
    scale: bool = False,
    streams: bool = False,
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
    as_given = misfit(_resized(p) if scale else p)
    if as_given < FITS_M:
        return recording
    best, advice, converted = as_given, "", None
    units = {said for _, said in _scaled(p)}
    for poses, said in _readings(recording, arm, () if streams else SHIFTS):
        try:
            other = misfit(_resized(poses) if scale else poses)
        except np.linalg.LinAlgError:
            continue
        if other < SMALLER * best:
            best, advice = other, said
            converted = poses if said in units else None
    if best < as_given / BETTER and best < PLAUSIBLE_M:
        if detect_units and converted is not None:
            note = f"{advice.partition(':')[0]}; converted"
            return replace(recording, poses=converted, notes=(*recording.notes, note))
        raise InputError(
            f"{recording.robot.path}: {advice} (median residual {1e3 * best:.1f} mm; as given {1e3 * as_given:.1f})"
        )
    displaced = _displaced(p, as_given) if not scale else None
    if displaced is not None:
        first, what = _moved(p, displaced)
        raise InputError(
            f"{recording.robot.path}: the rows up to {recording.names[first - 1]} and those from "
            f"{recording.names[first]} on fit one mounting each, but not the same (as given, median residual "
            f"{1e3 * as_given:.1f} mm): {what} about there: use one of both parts"
        )
    if as_given > PLAUSIBLE_M:
        note = (
            f"{recording.robot.path}: half of the rows are off by more than {1e3 * as_given:.0f} mm in any mounting, and "
            "no other reading fits: what is found is no calibration; check one row by hand, or take the poses again"
        )
        return replace(recording, notes=(*recording.notes, note))
    return recording


def _displaced(p: Poses, as_given: float) -> int | None:
    """Return the first row after which another mounting fits, where either part alone fits far better than the whole."""
    n = len(p.A)

    def worse(k: int) -> float:
        return max(misfit(p.rows(np.arange(k))), misfit(p.rows(np.arange(k, n))))

    if n < 2 * PART:
        return None
    tried = np.unique(np.linspace(PART, n - PART, min(TRIED, n - 2 * PART + 1)).round().astype(int))
    found = {int(k): worse(int(k)) for k in tried}
    step = int(np.diff(tried).max()) if len(tried) > 1 else 1
    while step > 1:
        step = (step + 1) // 2
        best = min(found, key=lambda k: found[k])
        for k in (best - step, best + step):
            if PART <= k <= n - PART and k not in found:
                found[k] = worse(k)
    best = min(found, key=lambda k: found[k])
    return best if found[best] < min(as_given / BETTER, PLAUSIBLE_M) else None


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


def _readings(recording: PairedPoses, arm: Arm | None, shifts: tuple[int, ...]) -> Iterator[tuple[Poses, str]]:
    """Yield other readings of the same data, with what it would mean."""
    p = recording.poses
    n = len(p.A)
    for shift in shifts:
        if n - abs(shift) >= 6:
            first, second = (
                (slice(shift, None), slice(None, -shift)) if shift > 0 else (slice(None, shift), slice(-shift, None))
            )
            rows = np.arange(n)
            yield (
                replace(p.rows(rows[second]), A=p.A[first]),
                f"the rows are shifted by {abs(shift)} against the images: row {1 + max(shift, 0)} of the robot belongs to "
                f"image {1 + max(-shift, 0)}; remove what is too much at either end, or add a column image",
            )
    mountings = ("in_hand", "to_hand")
    given, other = mountings if p.in_hand else mountings[::-1]
    yield (
        replace(p, in_hand=not p.in_hand),
        f"these poses fit --eye {other.replace('_', '-')}, not {given.replace('_', '-')}: either the mounting is the other "
        "one, or one of the tables holds inverse transforms (base in flange, or rig in target)",
    )
    yield from _scaled(p)
    whose = "" if arm is None else f", and --model {arm.name} the arm"
    yield (
        _resized(p),
        f"the target seems to be {scale_between(p):.3g} times as large as given: is --target's size right{whose}? --scale "
        "fits it",
    )
    yield (
        replace(p, A=MIRROR @ p.A @ MIRROR),
        "one of the tables is of a left-handed frame: one axis is mirrored, in positions and rotations; robot and camera "
        "poses are right-handed: change the sign of one axis, and of the rotations about the two others",
    )
    table = recording.robot
    if table.convention:
        position = p.A[:, :3, 3]
        for convention in CONVENTIONS:
            width = 4 if convention in ("wxyz", "xyzw") else 3
            if convention == table.convention or width != table.numbers.shape[1]:
                continue
            R = rotations_by(table.numbers[recording.rows], convention, table.path)
            yield (
                replace(p, A=stacked(R, position)),
                f"the rotations are {convention}, not {table.convention}: --rotation {convention}",
            )
        if table.numbers.shape[1] == 3:
            R = rotations_by(np.degrees(table.numbers[recording.rows]), table.convention, table.path)
            yield (
                replace(p, A=stacked(R, position)),
                "the rotations are in radians, not degrees: name the columns rx_rad ry_rad rz_rad",
            )
    if arm is not None and table.q is not None and table.numbers.shape[1] == 0:
        yield from _joints(p, arm, table.q[recording.rows])


def _scaled(p: Poses) -> Iterator[tuple[Poses, str]]:
    """Yield readings of the target's lengths in other units."""
    for factor, said in UNITS.items():
        for scale, whose in (
            (factor, f"the robot's lengths are {said}"),
            (1 / factor, f"the target's lengths are {said}"),
        ):
            B = p.B.copy()
            B[:, :3, 3] *= scale
            A = p.A.copy()
            if scale > 1:
                A[:, :3, 3] /= scale
                B = p.B
            yield replace(p, A=A, B=B), f"{whose}: give --units or --seen-units, or --detect-units"


def _joints(p: Poses, arm: Arm, q: Array) -> Iterator[tuple[Poses, str]]:
    """Yield readings of the joints: in another unit, one with another sense, in another order.

    Of all permutations those that the angles between poses support.
    """
    n = q.shape[1]
    rows = np.linspace(0, len(q) - 1, min(EVALUATED, len(q))).round().astype(np.int64)
    seen = _angles(inverse(p.B[rows]) if p.in_hand else p.B[rows])
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
    if np.abs(radians := np.degrees(q)).max() < 2 * np.pi:
        yield (
            replace(p, A=np.asarray(arm.forward(radians))),
            "the joints are in radians, not degrees: name their columns q1_rad ..",
        )
    for joint in range(n):
        reversal = q * np.where(np.arange(n) == joint, -1.0, 1.0)
        yield (
            replace(p, A=np.asarray(arm.forward(reversal))),
            f"joint {joint + 1} ({arm.joint_names[joint]}) counts the other way than {arm.name}'s: change the sign of "
            f"q{joint + 1}",
        )
    for _, at in sorted(scored, key=lambda one: one[0])[:ORDERS]:
        named = ", ".join(f"q{k + 1}" for k in at)
        yield (
            replace(p, A=np.asarray(arm.forward(q[:, at]))),
            f"the joints are in another order: {arm.name}'s are {named} here",
        )
