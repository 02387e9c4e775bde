"""Data that do not fit, read in other ways: a unit, order, sign, convention, frame, row or arm that is wrong.

In: rows of a hand-eye recording (:func:`require_plausible`), poses to identify an arm from (:func:`check_plausible`), or a
table of an arm that a loop is to be closed with (:func:`require_fitting`). Out: nothing where they fit; else an error in
one line that names the reading that makes the subject's own closed form fit, and what to do.

Two quantiles of hand-eye residuals decide, or the linear placement; of equal readings the simplest is named.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array
from armsight.errors import CalibrationError, InputError
from armsight.estimate.change import StateChange
from armsight.geometry.pose import inverse, log_se3, mean_pose
from armsight.geometry.rotation import log_so3, nearest_rotation
from armsight.loop.handeye.handeye import CONTRADICTS, evenly, rotations_of, scale_between
from armsight.loop.handeye.poses import LEVER_M, Poses, kronecker, residuals, starts
from armsight.loop.handeye.recording import PairedPoses
from armsight.loop.identify.fit import SIGMA, prior_sigma, robust_noise
from armsight.loop.identify.measured import Measured
from armsight.loop.identify.model import Model
from armsight.loop.identify.placement import linear_placement, rigid_placement, with_placement
from armsight.loop.identify.selection import PLACEMENT, change_at, change_text
from armsight.robot.kinematics import chain
from armsight.robot.kinematics.arm import Arm
from armsight.robot.models import MODELS
from armsight.tables.misread import misreadings
from armsight.tables.poses import MIXED
from armsight.tables.rotations import ROTATIONS, rotations_by

Rows = NDArray[np.int64]
#: Of hand-eye residuals: the median, and what nine of ten are below; below this median, m, data are taken as they are.
QUANTILES, FITS_M = (0.5, 0.9), 2e-3
BETTER, PLAUSIBLE_M = 4.0, 0.02  # another reading must fit better by this factor, and be below this, m
#: A reading is preferred to those before it where its residual is smaller by this: xyz and ZYX are the same.
SMALLER = 0.99
EVALUATED = 60  # poses that a reading is evaluated by at most
#: Rows in common at least where they are shifted, and shifts that are tried: those for which both sides rotate alike.
COMMON, SHIFTS = 6, 4
PART, TRIED = 6, 12  # rows at least on either side of where something may have been displaced, and rows that are tried
ZERO_DEG = 30  # between zeros of a joint that are tried; half: twice the time, double: the best may be missed
ORDERS = 12  # orders of the joints that are looked at: the angles between poses do not distinguish parallel axes
MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])  # mirrors one axis; the other two are this one rotated
#: Units that lengths may be in, m; scales that differ from a unit's by less than this part are the unit.
UNITS = {"millimetres": 1e-3, "centimetres": 1e-2, "inches": 0.0254, "metres": 1.0}
A_UNIT = 0.1


class _Reading(NamedTuple):
    """The rows read in another way."""

    poses: Poses  #: what they are then
    said: str  #: what it would mean, and what to do
    path: Path | None = None  #: the file that it is about; None: the robot's table
    of_length: float = 1.0  #: how long 1 m of the robot's is in this reading, m
    of_units: bool = False  #: whether all lengths of one side are in another unit: they can be converted


def require_plausible(
    recording: PairedPoses, arm: Arm | None, *, detect_units: bool = False, scale: bool = False, streams: bool = False
) -> PairedPoses:
    """Reject rows that fit far better read in another way.

    ``arm``: the model, where the robot's poses come from joints. ``detect_units``: convert lengths in another unit, with a
    note, in place of an error. ``scale``: the target's size is fitted, and may be anything. ``streams``: the clocks of the
    rows agree roughly only: they are not shifted then.

    Raises:
        InputError: what is likely wrong, and what to do.
    """
    p, path = recording.poses, recording.robot.path
    given = misfit(p, scale=scale)
    if given[0] < FITS_M and given[1] < PLAUSIBLE_M:
        return recording
    found = _best(recording, arm, given, scale, streams)
    if found is not None and detect_units and found.of_units:
        note = f"{found.said.partition(':')[0]}; converted"
        return replace(recording, poses=found.poses, notes=(*recording.notes, note))
    as_given = f"{1e3 * given[0]:.1f} mm, nine of ten {1e3 * given[1]:.1f}"
    if found is not None:
        off = misfit(found.poses, scale=scale)
        raise InputError(
            f"{found.path or path}: {found.said} (half of the rows then within {1e3 * off[0]:.1f} mm, nine of ten "
            f"{1e3 * off[1]:.1f}; as given {1e3 * given[0]:.1f} and {1e3 * given[1]:.1f})"
        )
    if not _determined(p):  # the calibration says so
        return recording
    if not scale and (displaced := _displaced(p, given)) is not None:
        first, what = displaced
        raise InputError(
            f"{path}: the rows up to {recording.names[first - 1]} and those from {recording.names[first]} on fit one "
            f"mounting each, but not the same (as given, half of the rows are within {as_given}): {what} about there: "
            "use one of both parts"
        )
    off_by = f"{path}: half of the rows are off by more than {1e3 * given[0]:.0f} mm in any mounting"
    unknown_arm = float(np.median(_sizes(log_se3(inverse(mean_pose(p.B)) @ p.B))))  # what an unknown arm would leave
    if given[0] > max(PLAUSIBLE_M, unknown_arm / BETTER):
        raise InputError(
            f"{off_by}, and no other reading fits: robot and images are not of the same motion, or which row belongs to "
            "which, a rotation or the joints are read wrongly; check one row by hand, or take the poses again"
        )
    notes = _nearer_models(recording, arm, given[0], scale=scale)
    notes += [f"{off_by}, and no other reading fits: check one row by hand"] if given[0] > PLAUSIBLE_M else []
    return replace(recording, notes=(*recording.notes, *notes))


def require_mounting(p: Poses) -> None:
    """Reject poses that fit far better with the other mounting of the eye, as Python's callers give them.

    Raises:
        InputError: they do; or one of both lists holds inverse transforms.
    """
    given, (was, other) = misfit(p), ("in_hand", "to_hand") if p.in_hand else ("to_hand", "in_hand")
    if len(p.A) < COMMON or (given[0] < FITS_M and given[1] < PLAUSIBLE_M):
        return
    if _better(off := misfit(replace(p, in_hand=not p.in_hand)), given):
        raise InputError(
            f'these poses fit eye="{other}", not "{was}": half of them within {1e3 * off[0]:.1f} mm, as given '
            f"{1e3 * given[0]:.1f}; or one of the lists holds inverse transforms: invert them"
        )


def misfit(poses: Poses, *, scale: bool = False) -> Array:
    """Return the quantiles (2,) of the residuals, m, of the best closed form; with scale, of a target as large as fits."""
    _, e = _evaluated(_sized(poses, scale_between(poses)) if scale else poses)
    return np.quantile(_sizes(e), QUANTILES) if len(e) else np.full(2, np.inf)


def _evaluated(poses: Poses) -> tuple[Poses, Array]:
    """Return the poses that are looked at, and their residuals (N, 6) of the best closed form, (0, 6) if there is none."""
    part = poses.rows(evenly(np.arange(len(poses.A)), EVALUATED))
    found = starts(part.A, part.right_side)
    return part, residuals(part, *found[0][::-1])[0] if found else np.zeros((0, 6))


def _determined(poses: Poses) -> bool:
    """Return whether the flange rotates about two axes, as a calibration demands: closed forms say nothing otherwise."""
    part, e = _evaluated(poses)
    if not len(e):
        return True
    spread, _, noise, least = rotations_of(part, e)
    return bool(noise > CONTRADICTS or spread[1] >= least)


def _better(off: Array, given: Array, length: float = 1.0) -> bool:
    """Return whether quantiles (2,), m, are those of data that fit, and far smaller than as given, by ``length`` shrunk."""
    fits = (off < PLAUSIBLE_M) & (off / length < given / BETTER)
    return bool(fits.any() and off[0] < max(FITS_M, given[0]))


def _sizes(e: Array) -> Array:
    """Return by how much tangents (N, 6) move a point at 0.3 m, (N,), m."""
    return np.asarray(np.hypot(np.linalg.norm(e[:, :3], axis=1), LEVER_M * np.linalg.norm(e[:, 3:], axis=1)))


def _longer(Ts: Array, by: float) -> Array:
    out = Ts.copy()
    out[:, :3, 3] *= by
    return out


def resized(Ts: Array, before: Array, after: Array) -> Array:
    """Return poses with their lengths converted as those of others were, (N, 4, 4) all."""
    return _longer(Ts, float(np.linalg.norm(after[:, :3, 3]) / max(float(np.linalg.norm(before[:, :3, 3])), 1e-12)))


def _sized(p: Poses, by: float) -> Poses:
    """Return the poses with the target's lengths multiplied."""
    unit = np.repeat([by, 1.0], 3)
    common = None if p.common is None else unit[:, None] * p.common
    return replace(p, B=_longer(p.B, by), cov=p.cov * np.outer(unit, unit), centre=by * p.centre, common=common)


def _angles(Ts: Array) -> Array:
    return np.asarray(np.linalg.norm(log_se3(inverse(Ts[:-1]) @ Ts[1:])[:, 3:], axis=1))


def _nearer_models(recording: PairedPoses, arm: Arm | None, given: float, *, scale: bool) -> list[str]:
    """Return notes of models of other arms that fit better by half: a generation of an arm differs little from the next."""
    q, p = _joints_of(recording, arm), recording.poses
    found = {} if q is None else {one: misfit(replace(p, A=A), scale=scale)[0] for one, A in _models(arm, q)}
    best = min(found, key=lambda other: found[other], default="")
    if arm is None or not best or found[best] > given / 2:
        return []
    return [
        f"{recording.robot.path}: the joints fit --model {best} better than {arm.name}: half of the rows are within "
        f"{1e3 * found[best]:.1f} mm, not {1e3 * given:.1f}: which is it?"
    ]


def _joints_of(recording: PairedPoses, arm: Arm | None) -> Array | None:
    """Return the joints (N, J), rad, that the poses are of; None where they are a table's own."""
    table = recording.robot
    return None if arm is None or table.q is None or table.numbers.shape[1] else table.q[recording.rows]


def _models(arm: Arm | None, q: Array) -> Iterator[tuple[str, Array]]:
    """Yield the names of other models of as many joints, and the flange (N, 4, 4) by them."""
    for other in MODELS.values():
        if arm is not None and len(other.joint_names) == q.shape[1] and other.name != arm.name:
            yield other.name, np.asarray(other.forward(q))


def _best(recording: PairedPoses, arm: Arm | None, given: Array, scale: bool, streams: bool) -> _Reading | None:
    """Return the reading that fits best of those that fit far better than as given; None where none does."""
    best, found = np.inf, None
    for reading in _readings(recording, arm, streams):
        try:
            off = misfit(reading.poses, scale=scale)
        except np.linalg.LinAlgError:
            continue
        left = (off[0] + min(off[1], PLAUSIBLE_M)) / reading.of_length
        if _better(off, given, reading.of_length) and left < SMALLER * best and _determined(reading.poses):
            best, found = left, reading
    return found


def _displaced(p: Poses, given: Array) -> tuple[int, str] | None:
    """Return the first row of another mounting and what was displaced, where either part alone fits far better."""
    n = len(p.A)

    def parts(k: int) -> tuple[Poses, Poses]:
        return p.rows(np.arange(k)), p.rows(np.arange(k, n))

    def worse(k: int) -> Array:
        return np.maximum(*map(misfit, parts(k)))

    if n < 2 * PART:
        return None
    tried = np.linspace(PART, n - PART, min(TRIED, n - 2 * PART + 1)).round().astype(int).tolist()
    best = min(tried, key=lambda k: float(worse(k).sum()))
    (X, Z), (X_after, Z_after) = (starts(part.A, part.right_side)[0] for part in parts(best))
    before, after = (_sizes(residuals(p, *both)[0]) for both in ((Z, X), (Z_after, X_after)))
    first = PART + int(np.argmin(np.append(0.0, np.cumsum(before - after))[PART : n - PART + 1]))
    if not _better(worse(first), given):
        return None
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
    """Yield other readings of the same rows, with what they would mean."""
    p = recording.poses
    if not streams:
        yield from _other_rows(recording)
    given, other = ("in-hand", "to-hand") if p.in_hand else ("to-hand", "in-hand")
    yield _Reading(
        replace(p, in_hand=not p.in_hand),
        f"these poses fit --eye {other}, not {given}: either the mounting is the other one, or one of the tables holds "
        "inverse transforms (base in flange, as easy_handeye saves them for a camera that stands still; or rig in target): "
        "invert it",
    )
    units = list(_scaled(recording))
    yield from units
    if all(abs(np.log(scale_between(one.poses))) > A_UNIT for one in units):
        whose, size = "" if arm is None else f", and --model {arm.name} the arm", scale_between(p)
        said = f"the target seems to be {size:.3g} times as large as given: is --target's size right{whose}?"
        yield _Reading(_sized(p, size), f"{said} --scale fits it")
    yield _Reading(
        replace(p, A=MIRROR @ p.A @ MIRROR),
        "one of the tables is of a left-handed frame: one axis is mirrored, in positions and rotations; robot and camera "
        "poses are right-handed: change the sign of one axis, and of the rotations about the two others",
    )
    hands = {one.kind: one for one in misreadings(recording.robot, recording.rows, p.A, "")}
    seen = recording.seen.table
    eyes = {} if seen is None else {one.kind: one for one in misreadings(seen, recording.matched, p.B, "seen:")}
    yield from (_Reading(replace(p, A=one.Ts), one.said, one.path) for one in hands.values())
    yield from (_Reading(replace(p, B=one.Ts), one.said, one.path) for one in eyes.values())
    for kind in hands.keys() & eyes.keys():  # what one program wrote wrongly it may have written wrongly in both tables
        hand, eye = hands[kind], eyes[kind]
        said = hand.said if hand.said == eye.said else f"{hand.said}; and in {eye.path}: {eye.said}"
        yield _Reading(replace(p, A=hand.Ts, B=eye.Ts), said)
    q = _joints_of(recording, arm)
    if arm is not None and q is not None:
        yield from (_Reading(replace(p, A=np.asarray(A)), said) for A, said in _joints(p, arm, q))


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


def _shifted(p: Poses, shift: int) -> tuple[Rows, Rows, int] | None:
    """Return rows of robot and images that belong together where later rows are shifted, and how many rows are not."""
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
    target = (1.0, "--target's size", None) if seen is None else (seen.unit_m, "seen:units", seen.path)
    sides = [("A", "robot", robot.unit_m, "units", robot.path), ("B", "target", *target)]
    for side, whose, unit_m, option, path in sides[robot.of_joints :]:
        T = np.array(getattr(p, side))
        lengths = np.linalg.norm(T[:, :3, 3], axis=1)
        if (short := lengths < lengths.max() / MIXED).any():
            T[short, :3, 3] *= 1e3
            said = f"{short.sum()} of {len(short)} rows of the {whose} are in metres, the others in mm: correct them"
            yield _Reading(replace(p, A=T) if side == "A" else replace(p, B=T), said, path)
        given = next(name for name, length in UNITS.items() if length == unit_m)
        for name, length in UNITS.items():
            by = length / unit_m
            said = (
                f"the {whose}'s lengths are {name} taken for {given}: correct {option}, or give --columns units=detect"
            )
            if name != given and side == "A":
                yield _Reading(replace(p, A=_longer(p.A, by)), said, path, by, of_units=True)
            elif name != given:
                yield _Reading(_sized(p, by), said, path, of_units=True)


def _joints(p: Poses, arm: Arm, q: Array) -> Iterator[tuple[Array, str]]:
    """Yield the flange (N, 4, 4) by other readings of the joints: another unit, sense, zero or order, or another arm."""
    if np.abs(radians := np.degrees(q)).max() < 2 * np.pi:
        yield arm.forward(radians), "the joints are in radians, not degrees: name their columns q1_rad .."
    for joint, one in enumerate(np.eye(arm.joints)):
        said = f"joint {joint + 1} ({arm.joint_names[joint]})"
        way = f"{said} counts the other way than {arm.name}'s: change the sign of q{joint + 1}"
        yield arm.forward(q * (1 - 2 * one)), way
    rows = evenly(np.arange(len(q)), EVALUATED)
    some = p.rows(rows)
    for read, said in _one_joint(arm, q, lambda read: float(misfit(replace(some, A=arm.forward(read[rows])))[0])):
        yield arm.forward(read), said
    for at in _orders(p, arm, q):
        named = ", ".join(f"q{k + 1}" for k in at)
        yield arm.forward(q[:, at]), f"the joints are in another order: {arm.name}'s are {named} here"
    for other, A in _models(arm, q):
        yield A, f"the joints fit --model {other}, not {arm.name}"


def _one_joint(arm: Arm, q: Array, off: Callable[[Array], float]) -> Iterator[tuple[Array, str]]:
    """Yield joints (N, n), one of them in another unit, coupled to another or of another zero, and what each means.

    ``off``: says of joints how badly they fit. Of zeros, with and without the other sense, that which fits best counts.
    """
    from scipy.optimize import minimize_scalar  # takes a tenth of a second, which data that fit never need

    for joint, one in enumerate(np.eye(arm.joints)):
        column, said = f"q{joint + 1}", f"joint {joint + 1} ({arm.joint_names[joint]})"
        for factor, unit in ((np.degrees(1.0), "radians"), (np.radians(1.0), "degrees")):
            if np.abs(read := q * (1 + (factor - 1) * one)).max() < chain.MOST_RADIANS:
                yield read, f"{said} alone is in {unit}: convert {column}"
        for other in set(range(arm.joints)) - {joint}:
            for sign, do in ((1, f"add q{other + 1} to"), (-1, f"subtract q{other + 1} from")):
                coupled = f"{said} is given together with joint {other + 1}: {do} {column}"
                yield q + sign * q[:, other, None] * one, coupled
        if not 0 < joint < arm.joints - 1:
            continue  # base and tool hold zeros of the first and the last
        for sign, way, do in (
            (1, "", ""),
            (-1, "counts the other way, and ", f"change the sign of {column}, and then "),
        ):

            def read_at(zero_deg: float, q: Array = q * (1 + (sign - 1) * one), one: Array = one) -> Array:
                return np.asarray(q + np.radians(zero_deg) * one)

            grid = [(off(read_at(zero_deg)), zero_deg) for zero_deg in range(-180, 180, ZERO_DEG)]
            found = [
                minimize_scalar(
                    lambda zero_deg: off(read_at(zero_deg)), bounds=(near - ZERO_DEG, near + ZERO_DEG), method="bounded"
                )
                for k, (at, near) in enumerate(grid)
                if at <= min(grid[k - 1][0], grid[(k + 1) % len(grid)][0])
            ]
            best = min(found, key=lambda each: each.fun)
            zero = round(float((best.x + 180.0) % 360.0 - 180.0), 1)
            yield read_at(zero), f"{said} {way}has another zero than {arm.name}'s: {do}add {zero:g} deg to {column}"


def _orders(p: Poses, arm: Arm, q: Array) -> list[Rows]:
    """Return the orders of the joints that the angles between poses support best."""
    given = tuple(range(q.shape[1]))
    rows = evenly(np.arange(len(q)), EVALUATED)
    seen = _angles(p.right_side[rows])
    if len(given) <= 6:
        orders = [order for order in itertools.permutations(given) if order != given]
    else:
        orders = [tuple({i: j, j: i}.get(k, k) for k in given) for i, j in itertools.combinations(given, 2)]
        orders.append(given[::-1])
    off = [np.median(np.abs(_angles(np.asarray(arm.forward(q[rows][:, order]))) - seen)) for order in orders]
    return [np.array(orders[k]) for k in np.argsort(off, kind="stable")[:ORDERS]]


#: Errors of a cheap arm: a single mistake of the table is looked for beyond them. m and rad, RMS;
#: half: ordinary arms are searched, double: a joint that is off by a few degrees is not.
_USUAL = 0.015, float(np.radians(2.0))
#: Nothing moves by a table that is off by more, m and rad. Half: an SO-101 with zeros off by 3 degrees is rejected;
#: double: a wrist with a wrong sign passes.
_GROSS = 0.04, float(np.radians(8.0))
#: Mistakes that fit within this factor of the best are named, too; half: exact ties alone, double: weak ones as well.
_ALIKE = 1.25
_LEAST_M = 0.002  # lengths that differ by less are not exchanged, m


def require_fitting(arm: Arm, q: Array, Ts_rig_body: Array) -> None:
    """Reject a table with which no loop may be closed, by joint angles q (N, n), rad, and poses of the body, m.

    Raises:
        CalibrationError: the poses contradict the table by far more than a cheap arm's errors.
    """

    def off_by(arm: Arm, X: Array, Z: Array) -> tuple[float, float]:
        e = log_se3(inverse(Z @ Ts_rig_body) @ arm.forward(q) @ X)
        parts = (np.linalg.norm(part, axis=1) for part in (e[:, :3], e[:, 3:]))
        shift, angle = (float(np.sqrt(np.mean(each[each <= 3.0 * np.median(each)] ** 2))) for each in parts)
        return shift, angle

    def size(off: tuple[float, float]) -> float:
        return float(np.hypot(off[0], LEVER_M * off[1]))

    off = off_by(arm, *starts(arm.forward(q), Ts_rig_body)[0])
    if off[0] <= _USUAL[0] and off[1] <= _USUAL[1]:
        return
    sizes = {name: size(off_by(one, *kronecker(one.forward(q), Ts_rig_body))) for name, one in _mistakes(arm)}
    best = min(sizes.values())
    explained = size(off) > BETTER * best
    if not explained and off[0] <= _GROSS[0] and off[1] <= _GROSS[1]:
        return
    names = " or ".join(name for name in sorted(sizes, key=lambda name: sizes[name]) if sizes[name] < _ALIKE * best)
    advice = (
        "no single sign, zero or pair of lengths explains it: check the table and the joint angles of several poses "
    )
    advice += "(armsight identify)"
    if explained:
        advice = f"they fit within {1e3 * best:.1f} mm if {names}: correct the table"
    raise CalibrationError(
        f"the table of {arm.name} contradicts the measured poses by {1e3 * off[0]:.0f} mm and {np.degrees(off[1]):.1f} deg "
        f"RMS, with which no loop is closed: {advice}"
    )


def _mistakes(arm: Arm) -> Iterator[tuple[str, Arm]]:
    """Yield tables that differ by a single mistake, and what that is."""
    for i, name in enumerate(arm.joint_names):
        signs = 1 - 2 * (np.arange(arm.joints) == i)
        if abs(np.sin(arm.alpha[i])) > 0.1:
            yield f"alpha of {name} has the other sign", replace(arm, alpha=signs * arm.alpha)
        for key in ("a", "d"):
            if abs(getattr(arm, key)[i]) > _LEAST_M:
                yield f"{key} of {name} has the other sign", replace(arm, **{key: signs * getattr(arm, key)})
        yield f"{name} rotates the other way", replace(arm, direction=signs * arm.direction)
        for deg in (90, -90, 180):
            yield (
                f"the zero of {name} is off by {deg} deg",
                replace(arm, offset=arm.offset + np.radians(deg) * (signs < 0)),
            )
    lengths = np.concatenate([arm.a, arm.d])
    names = [f"{key} of {name}" for key in ("a", "d") for name in arm.joint_names]
    for i, k in itertools.combinations(range(len(lengths)), 2):
        if abs(lengths[i] - lengths[k]) > _LEAST_M:
            other = lengths.copy()
            other[[i, k]] = lengths[[k, i]]
            a, d = np.split(other, 2)
            yield f"{names[i]} and {names[k]} are exchanged", replace(arm, a=a, d=d)


#: Worse than this part of the points' spread (RMS), and this many m, is another arm: a cheap one is off by 10 to 15 mm.
BAD_SHARE, BAD_M = 0.08, 0.015
#: Only what fits this many times better is preferred to something simpler: by chance a wrong sign does at 3.4 sigma.
CLEAR = 2.0
#: Fits better than this, m and rad, are alike: files are rounded, instruments resolve hundredths of a degree.
ALIKE_M, ALIKE_RAD = 1e-6, np.deg2rad(0.01)
SCALE_OFF = 0.2  # a scale off by more than this is a unit
#: Rotations off by more than this, rad, are not of this arm: twice the prior of zeros and twists of six joints.
BAD_RAD = 2 * np.sqrt(6) * np.hypot(SIGMA["offset"], SIGMA["alpha"])
#: Poses looked at, those that every order and sign is tried on, and the fewest that shifted rows do not fit by chance.
POSES, FEW, FEWEST = 80, 24, 12
#: Rows so many times as far off as the median are gross, up to this share of all; half: ordinary rows, double: some stay.
GROSS, GROSS_SHARE = 5.0, 0.2
TRIMS = 30  # concentration steps at most; half: nothing, double: nothing
LEAST_M = 2e-4  # RMS, m, from which a change makes poses useless; half: of a fine tracker, too, double: 0.3 mm do not
MAX_JOINT_ORDERS = 40  # orders whose signs are tried, best first
_SCALES = {1e-3: "m, not mm", 1e3: "mm, not m", 1e-1: "dm or cm", 10.0: "cm", 1 / 25.4: "inches", 25.4: "inches"}


class Off(NamedTuple):
    """How far points are off an arm, RMS, m: in a right-handed frame, in a left-handed one; and the points' scale."""

    right: float
    left: float
    scale: float

    @property
    def sized(self) -> bool:
        """Whether the points are as large as the arm's motions."""
        return bool(abs(np.log(self.scale)) < np.log1p(SCALE_OFF))


class Mistakes(NamedTuple):
    """A guess at the mistakes in the data, and how well it fits."""

    joint_order: tuple[int, ...]  #: the column of the data that each joint is in
    signs: tuple[int, ...]  #: of each joint
    left: bool  #: whether the instrument's frame is left-handed
    off: float  #: RMS distance of the points from the arm under this guess, m

    @property
    def number(self) -> int:
        """How many mistakes these are: signs, a frame, and exchanges of two columns that make the order."""
        exchanges, order = 0, list(self.joint_order)
        for i in range(len(order)):
            while (k := order[i]) != i:
                order[i], order[k], exchanges = order[k], k, exchanges + 1
        return self.signs.count(-1) + self.left + exchanges

    @property
    def text(self) -> str:
        """The mistakes as text."""
        frame = "two of the instrument's axes are exchanged, or one has the wrong sign (its frame is left-handed)"
        texts, given = [frame] * self.left, range(len(self.signs))
        if self.joint_order != tuple(given):
            texts.append("the joints' order is " + ", ".join(f"q{i + 1}" for i in self.joint_order))
        if -1 in self.signs:
            texts.append("the sign is wrong of joint " + ", ".join(str(i + 1) for i in given if self.signs[i] < 0))
        return " and ".join(texts)


def check_plausible(arm: Arm, measured: Measured) -> None:
    """Reject data that cannot be of this arm, and say what would make them fit.

    Raises:
        InputError: with the unit, the order, the signs, the frame or the reading of angles that fit, or that none does.
    """
    if measured.q.shape[1] != arm.joints:
        raise InputError(
            f"these data have {measured.q.shape[1]} joint angles a row, {arm.name} has {arm.joints} joints: is it the "
            "right model? a gripper's angle is none of the arm's: leave it out"
        )
    if np.abs(measured.q).max() > chain.MOST_RADIANS:
        row, joint = divmod(int(np.argmax(np.abs(measured.q))), measured.q.shape[1])
        raise InputError(
            f"joint {joint + 1} of row {row + 1} is at {measured.q[row, joint]:g} rad, further than any joint rotates: are "
            "the angles in degrees? name the columns q1_deg .. q6_deg"
        )
    rows = np.linspace(0, len(measured) - 1, min(POSES, len(measured))).astype(int)
    rows = rows[_agreeing(arm, measured.q[rows], measured.p_rig[rows])]
    q, p = measured.q[rows], measured.p_rig[rows]
    at, limit = points_off(arm, q, p), max(BAD_SHARE * _span(p), BAD_M)
    T = arm.forward(q) @ np.linalg.inv(arm.T_flange_tool)
    rigid = rigid_placement(T[:, :3, :3], T[:, :3, 3], p)[3]
    if rigid < limit and rigid < BETTER * at.right:  # where few joints move, the motions leave the scale open
        at = Off(rigid, np.inf, 1.0)
    good = at.right < (limit if at.sized else max(limit, BAD_M * at.scale))
    if good and at.sized:
        _check_rotations(arm, measured, rows)
        flipped = [points_off(arm, q * (1 - 2 * one), p).right for one in np.eye(arm.joints)]
        if (least := min(flipped)) * (CLEAR if len(q) >= FEW else BETTER) < at.right:
            raise InputError(
                f"the data fit this arm if the sign is wrong of joint {int(np.argmin(flipped)) + 1} (off by "
                f"{1e3 * at.right:.1f} mm as they are, {1e3 * least:.1f} mm so): put the columns right"
            )
        found = placed_change(arm, measured)
        if found is not None and found[1].sure and found[1].left < found[1].before / CLEAR:
            model, change = found
            raise InputError(
                f"the first {change.row} poses and those from there on are of different states, which fit "
                f"{change.before / change.left:.1f} times as well: {change_text(model, change)}; use one of both parts"
            )
        return
    for q_read, p_read, said in _readings_of(measured, rows):
        off = points_off(arm, q_read, p_read)
        if off.sized and off.right < min(at.right / BETTER, max(BAD_SHARE * _span(p_read), BAD_M)):
            raise InputError(
                said.replace("OFF", f"off by {1e3 * at.right:.0f} mm as they are, {1e3 * off.right:.1f} mm so")
            )
    if not good:
        raise InputError(_proposal(arm, q, p, at.right))
    near = min(_SCALES, key=lambda s: abs(np.log(at.scale / s)))
    if abs(np.log(at.scale / near)) < np.log1p(SCALE_OFF):
        raise InputError(
            f"the points are {at.scale:.4g} times as large as the arm's motions: are they in {_SCALES[near]}? "
            "name the columns by their unit: p1_x_m or p1_x_mm"
        )
    raise InputError(
        f"the points are {at.scale:.3g} times as large as this arm's motions: is it the right model, in the right unit?"
    )


def without_tool(arm: Arm) -> Arm:
    """Return the arm with its tool at the flange: the tool's pose on the flange is estimated from the data."""
    return replace(arm, T_flange_tool=np.eye(4))


def _agreeing(arm: Arm, q: Array, p_rig: Array) -> Rows:
    """Return the rows of points (N, K, 3) without gross ones, by the least trimmed squares of the others; or all.

    Least squares of all would be pulled off by a few: the fit is to the share that fits best, until it stays the same.
    """
    T = arm.forward(q) @ np.linalg.inv(arm.T_flange_tool)
    least = max(FEWEST, int(np.ceil((1 - GROSS_SHARE) * len(q))))
    rows = np.arange(len(q))
    for _ in range(TRIMS):
        M, c, t = linear_placement(T[rows, :3, :3], T[rows, :3, 3], p_rig[rows])
        off = np.linalg.norm(p_rig @ M.T + c - _points(T, t), axis=2).max(axis=1)
        before, rows = rows, np.sort(np.argsort(off)[:least])
        if np.array_equal(before, rows):
            break
    good = np.flatnonzero(off <= GROSS * max(float(np.median(off[rows])), ALIKE_M))
    return good if len(good) >= least else np.arange(len(q))


def points_off(arm: Arm, q: Array, p_rig: Array) -> Off:
    """Return how far points (N, K, 3) are off an arm at q (N, n), with base and tool free, in frames of either hand."""
    T = arm.forward(q) @ np.linalg.inv(arm.T_flange_tool)
    M, _, t = linear_placement(T[:, :3, :3], T[:, :3, 3], p_rig)
    scale = float(np.cbrt(abs(np.linalg.det(M))))
    if not scale > 1e-12:
        return Off(np.inf, np.inf, 1.0)
    offs = []
    for mirrored in (False, True):
        e = p_rig @ (nearest_rotation(M, mirrored=mirrored) * scale).T - _points(T, t)
        e -= e.mean(axis=(0, 1))
        offs.append(float(np.sqrt(np.mean(np.sum(e**2, axis=2)))) / scale)
    return Off(offs[0], offs[1], 1 / scale)


def _readings_of(measured: Measured, rows: Rows) -> Iterator[tuple[Array, Array, str]]:
    """Yield joints and points by other readings, and what each means: rows shifted, poses inverse, other units."""
    n, q = len(measured), measured.q[rows]
    for shift in (1, -1, 2, -2, 3, -3):
        if n - abs(shift) >= FEWEST:
            some = np.linspace(0, n - abs(shift) - 1, min(POSES, n - abs(shift))).astype(int)
            hand, seen = max(shift, 0), max(-shift, 0)
            said = (
                f"the rows are shifted by {abs(shift)}: the joint angles of row {1 + hand} belong to the pose of row "
            )
            said += f"{1 + seen} (OFF); remove what is too much at either end, or join the tables by names or times"
            yield measured.q[some + hand], measured.p_rig[some + seen], said
    if measured.R_rig_body is not None:
        said = (
            "the poses are inverse transforms: they fit as those of the instrument in the body (OFF): invert them; the "
        )
        said += "body in the instrument's frame is needed"
        yield q, -np.einsum("nji,nkj->nki", measured.R_rig_body[rows], measured.p_rig[rows]), said
    for read, unit in (
        (np.radians(q), "degrees; name the columns q1_deg .. q6_deg"),
        (np.degrees(q), "radians; name the columns q1_rad .. q6_rad"),
    ):
        if np.abs(read).max() < chain.MOST_RADIANS:
            yield read, measured.p_rig[rows], f"the motions fit if the joint angles are in {unit} (OFF)"


def _proposal(arm: Arm, q: Array, p: Array, off: float) -> str:
    """Return the frame, the order and the signs that make the data fit, or the reading of one joint, or that none does."""
    unit = min((1.0, 1e-3, 1e3), key=lambda u: abs(np.log(_span(p) / _span(arm.forward(q)[:, None, :3, 3]) / u)))
    p = p / unit
    # Not the larger of the two, as for data as they are given: of thousands of ways some fit roughly by chance.
    limit = min(off / BETTER, BAD_M, BAD_SHARE * _span(p))
    alike = _search(arm, q, p, limit)

    def right(q: Array) -> float:
        return points_off(arm, q, p).right

    least, said = min((right(read), said) for read, said in _one_joint(arm, q, right))
    if least < limit and (not alike or CLEAR * least < alike[0].off):
        return f"{said} (off by {1e3 * off:.0f} mm as they are, {1e3 * least:.1f} mm so)"
    if not alike:
        return (
            f"these data are not of this arm: with base and tool fitted it is off by {1e3 * off:.0f} mm; no unit, frame, "
            "order or sign of the joints corrects it. Is it the right model, with the table's right convention?"
        )
    best = alike[0]
    text = (
        f"the data fit this arm if {best.text}{'' if unit == 1.0 else f' and the points are in {_SCALES[unit]}'} (off by "
        f"{1e3 * off:.0f} mm as they are, {1e3 * best.off:.1f} mm so): put the columns right"
    )
    other = next((m for m in alike if m.left != best.left and m.number <= best.number + 1), None)
    if other is not None:
        text += f"; these data fit as well, and do not show which is true, if {other.text}"
    flipped = [tuple(-s if i == j else s for i, s in enumerate(best.signs)) for j in range(arm.joints)]
    alike_ways = {m[:3] for m in alike}
    either = [str(j + 1) for j in range(arm.joints) if (best.joint_order, flipped[j], best.left) in alike_ways]
    return text + (f"; they do not show whether the sign of joint {', '.join(either)} is right" if either else "")


def _span(p: Array) -> float:
    """Return how far points (N, K, 3) spread about their middle, RMS."""
    return float(np.sqrt(np.mean(np.sum((p - p.mean(axis=0)) ** 2, axis=2))))


def _search(arm: Arm, q: Array, p: Array, limit: float) -> list[Mistakes]:
    """Return what fits within a limit, and as well as anything does, fewest mistakes first."""
    few = np.linspace(0, len(q) - 1, min(FEW, len(q))).astype(int)
    given = tuple(range(arm.joints))
    signs = list(itertools.product((1, -1), repeat=arm.joints))
    tried = _tried(arm, q[few], p[few], ((given, s) for s in signs))
    orders = _tried(arm, q[few], p[few], ((o, signs[0]) for o in itertools.permutations(given)))
    found = _fitting(arm, q, p, [*tried, *orders], limit)
    if not found:
        best = list(dict.fromkeys(m.joint_order for m in sorted(orders, key=lambda m: m.off)))[:MAX_JOINT_ORDERS]
        found = _fitting(arm, q, p, _tried(arm, q[few], p[few], itertools.product(best, signs)), limit)
    return found


def _tried(arm: Arm, q: Array, p: Array, ways: Iterable[tuple[tuple[int, ...], tuple[int, ...]]]) -> list[Mistakes]:
    """Return how far off the points are in each order and with each signs, in frames of either hand."""
    found = (((order, signs), points_off(arm, q[:, order] * signs, p)) for order, signs in ways)
    return [Mistakes(*way, left, at[left]) for way, at in found if at.sized for left in (False, True)]


def _fitting(arm: Arm, q: Array, p: Array, tried: list[Mistakes], limit: float) -> list[Mistakes]:
    """Return those that fit all poses within a limit and about as well as the best, fewest mistakes first."""
    near = CLEAR * max(min((m.off for m in tried), default=np.inf), ALIKE_M)
    every = _tried(arm, q, p, dict.fromkeys(m[:2] for m in tried if m.off < CLEAR * min(near, limit)))
    best = max(min((m.off for m in every), default=np.inf), ALIKE_M)
    return sorted((m for m in every if best <= limit and m.off < CLEAR * best), key=lambda m: (m.number, m.off))


def placed_change(arm: Arm, measured: Measured) -> tuple[Model, StateChange] | None:
    """Return how base, tool or a joint's zero changed in the order of the rows, and the model it is of.

    Base, tool and zeros are fitted to all, linearised; None where one state of them fits all.
    """
    rows = np.linspace(0, len(measured) - 1, min(POSES, len(measured))).astype(int)
    model, x = with_placement(Model.of(arm, measured, backlash=False).with_features(()), measured.rows(rows))
    free = np.array([p.kind in (*PLACEMENT, "offset") for p in model.parameters])
    part = replace(measured.rows(rows), cov=None)
    noise = robust_noise(model.residuals(x, part))
    change = change_at(model, x, part, free, prior_sigma(model), noise)
    if change is None or change.before * noise[0] < LEAST_M:
        return None
    return model, replace(change, row=int(rows[change.row]))


def _points(T: Array, t: Array) -> Array:
    """Return points t (K, 3) of frames (N, 4, 4): (N, K, 3)."""
    return np.asarray(T[:, None, :3, 3] + (T[:, :3, :3] @ t.T).swapaxes(1, 2))


def _check_rotations(arm: Arm, measured: Measured, rows: Rows) -> None:
    """Reject rotations of the body that are not those of the arm, where its positions fit."""
    if measured.R_rig_body is None:
        return
    q, p, R = measured.q[rows], measured.p_rig[rows], measured.R_rig_body[rows]
    off = _rotations_off(arm, q, R)
    if off <= ALIKE_RAD:
        return
    _check_convention(arm, measured, rows, off)

    def rotated(q: Array) -> float:
        return _rotations_off(arm, q, R)

    near = CLEAR * max(points_off(arm, q, p).right, ALIKE_M)
    signs = itertools.product((1, -1), repeat=arm.joints)
    ways = [m for m in _tried(arm, q, p, ((tuple(range(arm.joints)), s) for s in signs)) if not m.left and m.off < near]
    fits = {m: rotated(q * m.signs) for m in ways}
    least, limit = max(min(fits.values(), default=np.inf), ALIKE_RAD), min(off / BETTER, BAD_RAD)
    if off > BAD_RAD:
        one, said = min((max(rotated(read), ALIKE_RAD), said) for read, said in _one_joint(arm, q, rotated))
        if one <= limit and CLEAR * one < least:
            raise InputError(
                f"the rotations fit if {said} (off by {np.degrees(off):.1f} deg as they are, {np.degrees(one):.2f} deg so)"
            )
    if least <= limit:
        simplest = min((m for m, at in fits.items() if at < CLEAR * least), key=lambda m: (m.number, fits[m]))
        raise InputError(
            f"the rotations fit this arm if {simplest.text} (off by {np.degrees(off):.1f} deg as they are, "
            f"{np.degrees(fits[simplest]):.2f} deg so): put the columns right"
        )
    if off <= BAD_RAD:
        return
    raise InputError(
        f"these rotations are not of this arm, whose positions fit: they are off by {np.degrees(off):.0f} deg, and no "
        "convention and no sign of a joint corrects it; leave them out, or put them right"
    )


def _check_convention(arm: Arm, measured: Measured, rows: Rows, off: float) -> None:
    """Reject angles that fit by another convention."""
    if measured.angles_deg is None:
        return
    q, angles = measured.q[rows], measured.angles_deg[rows]
    offs = {name: _rotations_off(arm, q, rotations_by(angles, name, Path())) for name in ROTATIONS}
    reversed_off = _rotations_off(arm, q, rotations_by(angles[:, ::-1], "ZYZ", Path()))
    offs["ZYZ"] = min(offs["ZYZ"], reversed_off)  # Doosan's A, B, C read as KUKA's
    best = min(offs, key=lambda name: offs[name])
    if max(offs[best], ALIKE_RAD) <= min(off / CLEAR, BAD_RAD):
        same = [name for name in ROTATIONS if abs(offs[name] - offs[best]) < 1e-9]  # xyz and ZYX are one
        raise InputError(
            f"the rotations fit this arm if rx_deg, ry_deg, rz_deg are meant as {' or '.join(same)}, not as "
            f"{measured.rotation} (off by {np.degrees(off):.2f} deg as they are, {np.degrees(offs[best]):.2f} deg so): "
            f"give --columns rotation={same[0]}"
        )


def _rotations_off(arm: Arm, q: Array, R_rig_body: Array) -> float:
    """Return how far rotations (N, 3, 3) are off an arm at q (N, n), with base and tool free: the median angle, rad."""
    A = arm.forward(q)
    B = np.tile(np.eye(4), (len(q), 1, 1))
    B[:, :3, :3] = R_rig_body
    X, Z = kronecker(A, B)
    off = log_so3((A[:, :3, :3] @ X[:3, :3]).swapaxes(1, 2) @ Z[:3, :3] @ R_rig_body)
    return float(np.median(np.linalg.norm(off, axis=1)))
