"""Diagnosis of data that fit an arm far too badly: the likely mistake in the data, and what to do.

In: an arm and poses. Out: nothing, or an InputError that names the mistake: units, order or signs of the joints, a
left-handed frame of the instrument, angles of another convention.

The linear placement (``placement``) needs no start and yields a scale and a handedness as well; it is tried for every order
and sign of the joints on a few poses. A cheap arm is off by 10 to 15 mm; data that are off by a tenth of the space they
span are of another arm, or in another order. Of the explanations that fit equally well the one with the fewest mistakes is
reported.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import orth
from scipy.special import fdtrc

from armsight.data import Array
from armsight.errors import InputError
from armsight.geometry.rotation import nearest_rotation
from armsight.loop.handeye.poses import kronecker
from armsight.loop.identify.fit import SIGMA
from armsight.loop.identify.measured import Measured
from armsight.loop.identify.placement import angle_between, linear_placement, rigid_placement
from armsight.loop.identify.read import AnglesMeasured, rotations_of
from armsight.robot.kinematics import chain
from armsight.robot.kinematics.arm import Arm
from armsight.tables.rotations import ROTATIONS

#: Worse than this part of the space that the points span (RMS about their middle), and this many m, is another arm.
BAD_SHARE, BAD_M = 0.08, 0.015
#: A proposal must be this many times better than what was given.
BETTER = 4.0
#: Only what fits this many times better is preferred to something simpler. A wrong sign that hardly moves the tool can take
#: up a part of the arm's own errors by chance; to halve them it must lie along them to a cosine of 0.87, which, as these
#: errors have some 15 independent directions (zeros, lengths and angles), is 3.4 sigma.
CLEAR = 2.0
#: Fits better than this, m and rad, are alike: files are rounded, instruments resolve hundredths of a degree.
ALIKE_M, ALIKE_RAD = 1e-6, np.deg2rad(0.01)
#: A scale off by more than this is a unit.
SCALE_OFF = 0.2
#: Rotations off by more than this, rad, are not of this arm: twice the prior of zeros and twists of six joints.
BAD_RAD = 2 * np.sqrt(6) * np.hypot(SIGMA["offset"], SIGMA["alpha"])
#: Poses looked at, and those that every order and sign is tried on.
POSES, FEW = 80, 24
#: With fewer poses rows that are shifted may fit by chance.
FEWEST = 12
#: What joint angles may have been multiplied by.
_ANGLES = (
    (np.pi / 180, "degrees; name the columns q1_deg .. q6_deg"),
    (180 / np.pi, "radians; name the columns q1_rad .. q6_rad"),
)
#: Rows by which the two sides of a table may be shifted against each other.
SHIFTS = (1, -1, 2, -2, 3, -3)
#: Poses on either side of a step, RMS of what is looked into, m, length of a body's axes, m, and step of differences, rad.
FEWEST_A_PART, LEAST_M, AXES_M, STEP_RAD = 6, 2e-4, 0.1, 1e-6
#: One joint is preferred to the whole base where it explains all but this many times as well.
SIMPLER = 1.2
#: A step is one where chance explains as much with this probability at most, by one row and one joint.
CHANCE = 1e-8
#: Orders whose signs are tried, best first.
MAX_JOINT_ORDERS = 40
_SCALES = {1e-3: "m, not mm", 1e3: "mm, not m", 1e-1: "dm or cm", 10.0: "cm", 1 / 25.4: "inches", 25.4: "inches"}


class Off(NamedTuple):
    """How far points are off an arm, RMS, m: in a right-handed frame, in a left-handed one; and the points' scale."""

    right: float
    left: float
    scale: float


class Mistakes(NamedTuple):
    """A guess at the mistakes in the data, and how well it fits.

    Attributes:
        joint_order: the column of the data that each joint is in.
        signs: of each joint.
        left: whether the instrument's frame is left-handed.
        off: RMS distance of the points from the arm under this guess, m.
    """

    joint_order: tuple[int, ...]
    signs: tuple[int, ...]
    left: bool
    off: float

    @property
    def number(self) -> int:
        """How many mistakes these are: signs, a frame, and exchanges of two columns that make the order."""
        cycles = {frozenset(_cycle(self.joint_order, i)) for i in range(len(self.signs))}
        return self.signs.count(-1) + self.left + len(self.signs) - len(cycles)

    @property
    def text(self) -> str:
        """The mistakes as text."""
        texts = [
            "two of the instrument's axes are exchanged, or one has the wrong sign (its frame is left-handed)"
        ] * self.left
        given = range(len(self.signs))
        if self.joint_order != tuple(given):
            texts.append("the joints' order is " + ", ".join(f"q{i + 1}" for i in self.joint_order))
        if -1 in self.signs:
            texts.append("the sign is wrong of joint " + ", ".join(str(i + 1) for i in given if self.signs[i] < 0))
        return " and ".join(texts)


def _cycle(joint_order: tuple[int, ...], start: int) -> list[int]:
    """Return the columns of one cycle of a permutation, from one of them on."""
    out = [start]
    while joint_order[out[-1]] != start:
        out.append(joint_order[out[-1]])
    return out


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
    q, p = measured.q[rows], measured.p_rig[rows]
    off, _, scale = misfit(arm, q, p)
    limit, rigid = max(BAD_SHARE * _span(p), BAD_M), rigid_misfit(arm, q, p)
    if rigid < limit and rigid < BETTER * off:  # where few joints move, the motions leave the scale open
        off, scale = rigid, 1.0
    scaled = abs(np.log(scale)) > np.log1p(SCALE_OFF)
    good = off < (max(limit, BAD_M * scale) if scaled else limit)
    if good and not scaled:
        _check_rotations(arm, measured, rows)
        step = find_step(arm, measured)
        if step is not None and step.clear:
            raise InputError(
                f"the first {step.row} poses and those from there on are of different states (off by "
                f"{1e3 * step.before:.1f} mm together, {1e3 * step.left:.1f} mm so): {step.text}; use one of both parts"
            )
        return
    explanation = _shifted(arm, measured, off) or _inverse(arm, measured, rows, off) or _angles(arm, q, p, off)
    if explanation is None:
        explanation = _unit(scale) if good else _proposal(arm, q, p, off)
    raise InputError(explanation or _no_arm(off))


def misfit(arm: Arm, q: Array, p_rig: Array) -> Off:
    """Return how far points (N, K, 3) are off an arm at q (N, n), with base and tool free, in frames of either hand."""
    T = arm.forward(q) @ np.linalg.inv(arm.T_flange_tool)
    R, o = T[:, :3, :3], T[:, :3, 3]
    M, _, t = linear_placement(R, o, p_rig)
    scale = float(np.cbrt(abs(np.linalg.det(M))))
    if not scale > 1e-12:
        return Off(np.inf, np.inf, 1.0)
    there = o[:, None] + (R @ t.T).swapaxes(1, 2)
    offs = []
    for mirrored in (False, True):
        R_scaled = nearest_rotation(M, mirrored=mirrored) * scale
        e = p_rig @ R_scaled.T - there
        e -= e.mean(axis=(0, 1))
        offs.append(float(np.sqrt(np.mean(np.sum(e**2, axis=2)))) / scale)
    return Off(offs[0], offs[1], 1 / scale)


def rigid_misfit(arm: Arm, q: Array, p_rig: Array) -> float:
    """Return how far points (N, K, 3) are off an arm at q (N, n), RMS, m, with base and tool free, in their own unit."""
    T = arm.forward(q) @ np.linalg.inv(arm.T_flange_tool)
    return rigid_placement(T[:, :3, :3], T[:, :3, 3], p_rig)[3]


def _unit(scale: float) -> str:
    near = min(_SCALES, key=lambda s: abs(np.log(scale / s)))
    if abs(np.log(scale / near)) < np.log1p(SCALE_OFF):
        return (
            f"the points are {scale:.4g} times as large as the arm's motions: are they in {_SCALES[near]}? "
            "name the columns by their unit: p1_x_m or p1_x_mm"
        )
    return f"the points are {scale:.3g} times as large as this arm's motions: is it the right model, in the right unit?"


def _shifted(arm: Arm, measured: Measured, off: float) -> str | None:
    """Return by how many rows the joint angles are shifted against the poses, if the data fit so, or None."""
    n = len(measured)
    for shift in SHIFTS:
        if n - abs(shift) < FEWEST:
            continue
        q = measured.q[max(shift, 0) : n + min(shift, 0)]
        p = measured.p_rig[max(-shift, 0) : n - max(shift, 0)]
        rows = np.linspace(0, len(q) - 1, min(POSES, len(q))).astype(int)
        better, _, scale = misfit(arm, q[rows], p[rows])
        if abs(np.log(scale)) < np.log1p(SCALE_OFF) and better < min(off / BETTER, max(BAD_SHARE * _span(p), BAD_M)):
            return (
                f"the rows are shifted by {abs(shift)}: the joint angles of row {1 + max(shift, 0)} belong to the pose of "
                f"row {1 + max(-shift, 0)} (off by {1e3 * off:.0f} mm as they are, {1e3 * better:.1f} mm so); remove what "
                "is too much at either end, or join the tables by names or times"
            )
    return None


def _inverse(arm: Arm, measured: Measured, rows: Array, off: float) -> str | None:
    """Return that the poses are those of the instrument in the body, if the data fit so, or None."""
    if measured.R_rig_body is None:
        return None
    p = -np.einsum("nji,nkj->nki", measured.R_rig_body, measured.p_rig)[rows]
    better, _, scale = misfit(arm, measured.q[rows], p)
    if abs(np.log(scale)) > np.log1p(SCALE_OFF) or better > min(off / BETTER, max(BAD_SHARE * _span(p), BAD_M)):
        return None
    return (
        f"the poses are inverse transforms: they fit as those of the instrument in the body (off by {1e3 * off:.0f} mm as "
        f"they are, {1e3 * better:.1f} mm so): invert them; the body in the instrument's frame is needed"
    )


def _angles(arm: Arm, q: Array, p: Array, off: float) -> str | None:
    """Return the unit of the joint angles that makes the data fit, scale and all, or None."""
    for factor, what in _ANGLES:
        if np.abs(q * factor).max() < chain.MOST_RADIANS:
            better, _, scale = misfit(arm, q * factor, p)
            if abs(np.log(scale)) < np.log1p(SCALE_OFF) and better < off / BETTER:
                return f"the motions fit if the joint angles are in {what} (off by {1e3 * off:.0f} mm as they are)"
    return None


def _proposal(arm: Arm, q: Array, p: Array, off: float) -> str | None:
    """Return the frame, the order and the signs that make the data fit, or None."""
    unit = min((1.0, 1e-3, 1e3), key=lambda u: abs(np.log(_span(p) / _span(arm.forward(q)[:, None, :3, 3]) / u)))
    p = p / unit
    # Not the larger of the two, as for data as they are given: of thousands of ways some fit roughly by chance.
    alike = _search(arm, q, p, min(off / BETTER, BAD_M, BAD_SHARE * _span(p)))
    if not alike:
        return None
    best = alike[0]
    text = (
        f"the data fit this arm if {best.text}{'' if unit == 1.0 else f' and the points are in {_SCALES[unit]}'} (off by "
        f"{1e3 * off:.0f} mm as they are, {1e3 * best.off:.1f} mm so): put the columns right"
    )
    other = next((m for m in alike if m.left != best.left and m.number <= best.number + 1), None)
    if other is not None:
        text += f"; these data fit as well, and do not show which is true, if {other.text}"
    flipped = [tuple(-s if i == j else s for i, s in enumerate(best.signs)) for j in range(arm.joints)]
    either = [
        str(j + 1) for j in range(arm.joints) if any(m[:3] == (best.joint_order, flipped[j], best.left) for m in alike)
    ]
    return text + (f"; they do not show whether the sign of joint {', '.join(either)} is right" if either else "")


def _span(p: Array) -> float:
    """Return how far points (N, K, 3) spread about their middle, RMS."""
    return float(np.sqrt(np.mean(np.sum((p - p.mean(axis=0)) ** 2, axis=2))))


def _search(arm: Arm, q: Array, p: Array, limit: float) -> list[Mistakes]:
    """Return what fits within a limit, and as well as anything does, fewest mistakes first.

    Signs in the given order and every order with the given signs are tried, then both together where neither fits.
    """
    few = np.linspace(0, len(q) - 1, min(FEW, len(q))).astype(int)
    given = tuple(range(arm.joints))
    signs = list(itertools.product((1, -1), repeat=arm.joints))
    tried = _tried(arm, q[few], p[few], ((given, s) for s in signs))
    joint_orders = sorted(
        _tried(arm, q[few], p[few], ((o, signs[0]) for o in itertools.permutations(given))), key=lambda m: m.off
    )
    found = _fitting(arm, q, p, [*tried, *joint_orders], limit)
    if not found:
        best = list(dict.fromkeys(m.joint_order for m in joint_orders))[:MAX_JOINT_ORDERS]
        found = _fitting(arm, q, p, _tried(arm, q[few], p[few], itertools.product(best, signs)), limit)
    return found


def _tried(arm: Arm, q: Array, p: Array, ways: Iterable[tuple[tuple[int, ...], tuple[int, ...]]]) -> list[Mistakes]:
    """Return how far off the points are in each order and with each signs, in frames of either hand."""
    out = []
    for joint_order, signs in ways:
        at = misfit(arm, q[:, joint_order] * signs, p)
        if abs(np.log(at.scale)) < np.log1p(SCALE_OFF):
            out += [Mistakes(joint_order, signs, False, at.right), Mistakes(joint_order, signs, True, at.left)]
    return out


def _fitting(arm: Arm, q: Array, p: Array, tried: list[Mistakes], limit: float) -> list[Mistakes]:
    """Return those that fit all poses within a limit and about as well as the best, fewest mistakes first."""
    near = CLEAR * max(min((m.off for m in tried), default=np.inf), ALIKE_M)
    every = [
        again
        for joint_order, signs in dict.fromkeys(m[:2] for m in tried if m.off < min(CLEAR * near, CLEAR * limit))
        for again in _tried(arm, q, p, [(joint_order, signs)])
    ]
    best = max(min((m.off for m in every), default=np.inf), ALIKE_M)
    if best > limit:
        return []
    return sorted((m for m in every if m.off < CLEAR * best), key=lambda m: (m.number, m.off))


class Step(NamedTuple):
    """A change of state between two poses.

    Attributes:
        row: the first pose after it, in the order of the rows.
        text: what changed.
        before, left: RMS of the points off the arm without and with it, m.
    """

    row: int
    text: str
    before: float
    left: float

    @property
    def clear(self) -> bool:
        """Whether the poses cannot be taken together."""
        return self.left < self.before / CLEAR


def find_step(arm: Arm, measured: Measured) -> Step | None:
    """Return the pose from which on a joint's zero, or the base, is another, in the order of the rows; None without.

    Base, tool and zeros are fitted to all, linearised; then the step that explains most is looked for. It must explain
    twice what steps explain where the poses are ordered by a joint's angle: those show what else is wrong with the arm.
    """
    rows = np.linspace(0, len(measured) - 1, min(POSES, len(measured))).astype(int)
    if len(rows) < 2 * FEWEST_A_PART:
        return None
    q, p = measured.q[rows], measured.p_rig[rows]
    if measured.R_rig_body is not None:
        p = np.concatenate([p, p + AXES_M * measured.R_rig_body[rows].swapaxes(1, 2)], axis=1)
    n, K = p.shape[:2]
    T = arm.forward(q)
    M, _, t, _ = rigid_placement(T[:, :3, :3], T[:, :3, 3], p)
    here, there = p @ M.T, _points(T, t)
    here += (there - here).mean(axis=(0, 1))
    joints = [(_points(arm.forward(q + STEP_RAD * one), t) - there) / STEP_RAD for one in np.eye(arm.joints)]
    base = [*np.broadcast_to(np.eye(3)[:, None, None], (3, n, K, 3)), *(np.cross(axis, here) for axis in np.eye(3))]
    tool = [np.eye(K)[k][:, None] * T[:, None, :3, i] for k in range(K) for i in range(3)]
    common = np.stack([*base, *tool, *joints]).reshape(-1, n * K * 3).T
    Q = orth(common / np.maximum(np.linalg.norm(common, axis=0), 1e-12), rcond=1e-6)
    e = (here - there).ravel()
    e -= Q @ (Q.T @ e)
    total = float(e @ e)
    if np.sqrt(total / (n * K)) < LEAST_M:
        return None

    def explained(ways: list[Array], order: NDArray[np.int64]) -> tuple[float, int, Array]:
        best = (0.0, 0, np.zeros(len(ways)))
        for at in range(FEWEST_A_PART, n - FEWEST_A_PART + 1):
            after = np.isin(np.arange(n), order[at:])[:, None, None]
            C = np.stack([np.where(after, way, 0.0) for way in ways]).reshape(len(ways), -1).T
            C -= Q @ (Q.T @ C)
            x = np.linalg.lstsq(C, e, rcond=1e-6)[0]
            best = max(best, (float(e @ C @ x), at, x), key=lambda one: one[0])
        return best

    steps = [explained([joint], np.arange(n)) for joint in joints]
    joint = max(range(arm.joints), key=lambda k: steps[k][0])
    whole = explained(base, np.arange(n))
    one = total - steps[joint][0] < SIMPLER**2 * (total - whole[0])
    by, at, x = steps[joint] if one else whole
    free = n * min(3 * K, 6) - Q.shape[1] - len(x)
    if fdtrc(len(x), free, by / len(x) / (total - by) * free) > CHANCE:
        return None
    ways = [joints[joint]] if one else base
    if any(2 * explained(ways, np.argsort(angles))[0] > by for angles in q.T):
        return None
    text = "the base, or the instrument, was displaced"
    if one:
        either = ", or the base was rotated" if joint == 0 else ""
        text = (
            f"the zero of joint {joint + 1} changed by {np.degrees(x[0]):+.2f} deg (it slipped, or lost steps){either}"
        )
    before, left = (float(np.sqrt(squares / (n * K))) for squares in (total, total - by))
    return Step(int(rows[at]), text, before, left)


def _points(T: Array, t: Array) -> Array:
    """Return points t (K, 3) of frames (N, 4, 4): (N, K, 3)."""
    return np.asarray(T[:, None, :3, 3] + (T[:, :3, :3] @ t.T).swapaxes(1, 2))


def _check_rotations(arm: Arm, measured: Measured, rows: Array) -> None:
    """Reject rotations of the body that are not those of the arm, where its positions fit."""
    if measured.R_rig_body is None:
        return
    q, p, R = measured.q[rows], measured.p_rig[rows], measured.R_rig_body[rows]
    off = rotation_misfit(arm, q, R)
    explanation = None
    if off > ALIKE_RAD:
        if isinstance(measured, AnglesMeasured):
            explanation = _reading(arm, q, measured.angles_deg[rows], off, measured.rotation)
        explanation = explanation or _signs_by_rotations(arm, q, p, R, off)
    if explanation is None and off > BAD_RAD:
        explanation = (
            f"these rotations are not of this arm, whose positions fit: they are off by {np.degrees(off):.0f} deg, and no "
            "convention and no sign of a joint corrects it; leave them out, or put them right"
        )
    if explanation is not None:
        raise InputError(explanation)


def rotation_misfit(arm: Arm, q: Array, R_rig_body: Array) -> float:
    """Return how far rotations (N, 3, 3) are off an arm at q (N, n), with base and tool free: the median angle, rad."""
    A = arm.forward(q)
    B = np.tile(np.eye(4), (len(q), 1, 1))
    B[:, :3, :3] = R_rig_body
    X, Z = kronecker(A, B)
    return float(np.median(angle_between(A[:, :3, :3] @ X[:3, :3], Z[:3, :3] @ R_rig_body)))


def _reading(arm: Arm, q: Array, angles_deg: Array, off: float, given: str) -> str | None:
    """Return the convention of the angles that clearly fits better, or None."""
    offs = {name: rotation_misfit(arm, q, rotations_of(angles_deg, name)) for name in ROTATIONS}
    best = min(offs, key=lambda name: offs[name])
    if max(offs[best], ALIKE_RAD) > min(off / CLEAR, BAD_RAD):
        return None
    same = [name for name in ROTATIONS if abs(offs[name] - offs[best]) < 1e-9]  # xyz and ZYX are one
    return (
        f"the rotations fit this arm if rx_deg, ry_deg, rz_deg are meant as {' or '.join(same)}, not as {given} (off by "
        f"{np.degrees(off):.2f} deg as they are, {np.degrees(offs[best]):.2f} deg so): give --rotation {same[0]}"
    )


def _signs_by_rotations(arm: Arm, q: Array, p: Array, R: Array, off: float) -> str | None:
    """Return the fewest signs that make the rotations fit where the positions fit with either sign, or None."""
    near = CLEAR * max(misfit(arm, q, p).right, ALIKE_M)
    ways = _tried(arm, q, p, ((tuple(range(arm.joints)), s) for s in itertools.product((1, -1), repeat=arm.joints)))
    fits = {m: rotation_misfit(arm, q * m.signs, R) for m in ways if not m.left and m.off < near}
    best = max(min(fits.values(), default=np.inf), ALIKE_RAD)
    if best > min(off / BETTER, BAD_RAD):
        return None
    simplest = min((m for m, at in fits.items() if at < CLEAR * best), key=lambda m: (m.number, fits[m]))
    return (
        f"the rotations fit this arm if {simplest.text} (off by {np.degrees(off):.1f} deg as they are, "
        f"{np.degrees(fits[simplest]):.2f} deg so): put the columns right"
    )


def _no_arm(off: float) -> str:
    return (
        f"these data are not of this arm: with base and tool fitted it is off by {1e3 * off:.0f} mm; no unit, frame, order "
        "or sign of the joints corrects it. Is it the right model, with the table's right convention?"
    )


def without_tool(arm: Arm) -> Arm:
    """Return the arm with its tool at the flange: the tool's pose on the flange is estimated from the data."""
    return replace(arm, T_flange_tool=np.eye(4))
