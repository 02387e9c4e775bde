"""What changed since the arm was first watched: rig, body on the tool, a joint; by closure over a whole run.

In: what the estimator did with each pose measurement. Out: the change that explains the measurements best. It is one of
these: the rig jumped or drifts against the arm's base, the body slipped on the tool, the zero of a joint's potentiometer
jumped, the backlash of a joint grew.

A filter follows what changes slowly. Here nothing is followed: the errors x of the arm's model are constants of the run.
From the filter's innovations z and gains K follow the residuals of the model as it was at the beginning,

    e_k = z_k + H_k delta_k,    delta_k+1 = kept_k+1 (delta_k + K_k z_k),

and e = H x + h f(t - s) d + n: a change d at a time s of some of the model's own parameters (h: their columns of H; f: a
step, or a ramp). Residuals are averaged over blocks of time and travel. The covariance of the blocks' errors n is
estimated from the blocks, as the errors of an arm that no model explains are larger than the noise of a measurement. x is
eliminated, and the chi-square of d against zero is the test. A pose that is visited again says the most: x cancels. Jumps
of linear models: Willsky and Jones, "A generalized likelihood ratio approach to the detection and estimation of jumps in
linear systems", 1976.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

from armsight.data import Array, Record
from armsight.loop.estimators import Innovation, Outcome
from armsight.loop.estimators.armerror import ErrorLayout, layout
from armsight.loop.health.fixed import BaseMotion
from armsight.loop.health.record import HealthFinding, alarm_limit

#: A block lasts so long, s, and until all joints together have travelled so far, rad, but at most so long, s: an arm that
#: stands says the same thing again and again.
BLOCK_S, TRAVEL_RAD, MOST_S = 0.7, 0.1, 10.0
#: Travel in which the filter forgets what no joint explains, rad.
_POSE_TRAVEL_RAD = 1.0
#: Blocks before the first test; their errors are estimated anew after so many more, and no more after so many.
_LEAST_BLOCKS, _AGAIN, _MOST_BLOCKS = 12, 4, 64
#: Beginnings that are tried; the newer, the closer.
_BEGINS = 12
#: Errors of a block before any is seen (m, rad), and how many blocks that counts.
_BLOCK_SIGMA, _BLOCKS = np.repeat([1.2e-4, np.radians(0.012)], 3), 8.0
#: Priors so wide that they decide nothing: of a motion (m, rad), and of an angle, rad.
_WIDE, _WIDE_RAD = np.repeat([0.05, 0.1], 3), np.array([0.1])
#: A motion of rig or body that displaces the tool by less than this, m, is not reported, nor a smaller angle, rad.
#: What a link does within its backlash looks like a slip of a tenth of a degree.
_LEAST_M, _LEAST_RAD = 2e-4, float(np.radians(0.3))
#: The limits are higher than those of Gaussian errors by this factor: the errors of an arm have longer tails.
_MARGIN = 1.4
#: By so much the chi-square of a drift must exceed that of a jump.
_RARER = 5.0
#: Two changes whose chi-squares, less their limits, differ by less than this cannot be distinguished.
_ALIKE = 12.0
#: The parameters that may change, of the state: tangents of base and tool, zeros of the joints after the first (its own is
#: a rotation of the base), widths of the backlash. Those that may change slowly come first, so many.
_RAMPS = 6

Kind = Literal["rig", "drift", "body", "joint", "backlash"]


@dataclass(frozen=True)
class Suspect:
    """Something that may change.

    Attributes:
        kind: rig: it jumped; drift: it drifts; body: it slipped on the tool; joint: its zero jumped; backlash: it grew.
        joint: row of the joint; -1 for what is not of one.
        columns: its parameters among those that may change.
        limit: chi-square beyond which it is reported.
    """

    kind: Kind
    joint: int
    columns: slice
    limit: float


@lru_cache
def _suspects(joints: int) -> tuple[Suspect, ...]:
    """Return all of an arm of n joints; they and the beginnings that are tried share the probability of a false alarm."""
    six, one = (_MARGIN * alarm_limit(freedom, 1.0 / BLOCK_S, (2 * joints + 3) * _BEGINS) for freedom in (6, 1))
    return (
        Suspect("rig", -1, slice(0, 6), six),
        Suspect("drift", -1, slice(0, 6), six),
        Suspect("body", -1, slice(6, 12), six),
        Suspect("joint", 0, slice(5, 6), one),
        *(Suspect("joint", i, slice(11 + i, 12 + i), one) for i in range(1, joints)),
        *(Suspect("backlash", i, slice(11 + joints + i, 12 + joints + i), one) for i in range(joints)),
    )


@dataclass(frozen=True, eq=False)
class Change(Record):
    """A change that was found.

    Attributes:
        suspect: what changed.
        begin_s: when, s.
        size: (D,) by how much: tangent of base or tool [m; rad], or an angle, rad; of a drift so far.
        cov: (D, D) its covariance.
        chi_square: of the change against none.
        effect: (6, D) what a unit of it does to the newest measured pose of the tool, right tangent.
        alike: other hypotheses that explain it as well.
    """

    suspect: Suspect
    begin_s: float
    size: Array
    cov: Array
    chi_square: float
    effect: Array
    alike: tuple[Suspect, ...]

    @property
    def motion(self) -> BaseMotion | None:
        """What it does to the measured poses of the tool; None for a change of a joint, which vision measures rightly."""
        if self.suspect.kind in ("joint", "backlash"):
            return None
        shift, cov = self.effect @ self.size, self.effect @ self.cov @ self.effect.T
        return BaseMotion(self.begin_s, self.suspect.kind == "drift", shift, cov, self.chi_square)


class _Tested(NamedTuple):
    """A hypothesis at its best beginning, a block; size, covariance and chi-square."""

    suspect: Suspect
    begin: int
    size: Array
    cov: Array
    chi_square: float

    @property
    def above(self) -> float:
        """How far chi-square is above the limit; a drift must explain more than a jump to be preferred."""
        return self.chi_square - self.suspect.limit - (_RARER if self.suspect.kind == "drift" else 0.0)


class _Block:
    """Sums of the shots of one block."""

    def __init__(self, begin_s: float, size: int) -> None:
        self.begin_s, self.count, self.kept = begin_s, 0, 1.0
        self.t, self.e, self.H = 0.0, np.zeros(6), np.zeros((6, size))


class _RunningSums:
    """Running sums over blocks: what steps and ramps of the parameters that may change need, one row a block.

    A column holds the moments with 1, t and t^2, flat; the sum from a beginning on is the last row less the one before it.
    """

    def __init__(self) -> None:
        self.rows: list[tuple[Array, ...]] = []

    def add(self, t_s: float, across: Array, inner: Array, right: Array) -> None:
        """Add a block's information between the model's parameters and the changes, among the changes, and right side."""
        ramp, half, push = across[:, :_RAMPS], inner[:_RAMPS, :_RAMPS], right[:_RAMPS]
        new = (across, t_s * ramp, inner, t_s * half, t_s**2 * half, right, t_s * push)
        last = self.rows[-1] if self.rows else tuple(np.zeros_like(each) for each in new)
        self.rows.append(tuple(a + b for a, b in zip(last, new, strict=True)))

    def since(self, rows: Array, starts_s: Array, end_s: float) -> tuple[Array, ...]:
        """Return (S, ...) across, inner and right side of steps at rows (S,), then those of ramps from times (S,), s."""
        across, t_across, inner, t_inner, tt_inner, right, t_right = (
            last - np.array([self.rows[k - 1][n] for k in rows]) for n, last in enumerate(self.rows[-1])
        )
        s, length = starts_s[:, None, None], (end_s - starts_s)[:, None, None]
        half = inner[:, :_RAMPS, :_RAMPS]
        return (
            across,
            inner,
            right,
            (t_across - s * across[:, :, :_RAMPS]) / length,
            (tt_inner - 2.0 * s * t_inner + s**2 * half) / length**2,
            (t_right - s[:, 0] * right[:, :_RAMPS]) / length[:, 0],
        )


class ClosureWatch:
    """Watches a whole run for changes.

    Args:
        sigmas: (K,) standard deviations of the filter's state before anything was measured.
        joint_names: of the arm.

    Attributes:
        change: the newest change that was found; None while all is well.
        strongest: of all tests the largest chi-square over its limit.
    """

    def __init__(self, sigmas: Array, joint_names: tuple[str, ...]) -> None:
        self._parts = layout(len(joint_names))
        self._sigmas, self._names = sigmas[: self._parts.rest], joint_names
        self._delta = np.zeros(self._parts.size)
        self._block: _Block | None = None
        self._t: list[float] = []
        self._e: list[Array] = []
        self._H: list[Array] = []
        self._rejected: list[Innovation] = []
        self._cov = np.diag(_BLOCK_SIGMA**2)
        self._clear()
        self.change: Change | None = None
        self.strongest = 0.0

    def _clear(self) -> None:
        rest = self._parts.rest
        self._N, self._b, self._square, self._sums = np.eye(rest), np.zeros(rest), 0.0, _RunningSums()

    def take(self, innovation: Innovation) -> None:
        """Take what the estimator did with a measurement, in order of time; rejected ones count if later ones agree."""
        if innovation.outcome is Outcome.OUTLIER:
            self._rejected.append(innovation)
            return
        if innovation.outcome is Outcome.REOPENED:
            for rejected in self._rejected:
                self._add(rejected)
        self._rejected = []
        self._add(innovation)

    def _add(self, innovation: Innovation) -> None:
        """Add a measurement to its block; test when the block is full."""
        self._delta *= innovation.kept
        e = innovation.z + innovation.by_state @ self._delta
        self._delta += innovation.gain @ innovation.z
        if (clock := innovation.clock) is not None:
            e = e - clock.offset_s * innovation.by_state[:, self._parts.delay]
            self._delta += 0.0 if clock.change is None else clock.change
        block = self._block = self._block or _Block(innovation.t_s, self._parts.size)
        block.count += 1
        block.kept *= float(innovation.kept[self._parts.pose])
        block.t += innovation.t_s
        block.e += e
        block.H += innovation.by_state
        passed = innovation.t_s - block.begin_s
        moved = block.kept < np.exp(-TRAVEL_RAD / _POSE_TRAVEL_RAD)
        if passed >= MOST_S or (passed >= BLOCK_S and moved):
            self._close(block)
            self._block = None

    def _close(self, block: _Block) -> None:
        """Add a block, and test."""
        self._t.append(block.t / block.count)
        self._e.append(block.e / block.count)
        self._H.append(block.H / block.count)
        count = len(self._t)
        if _LEAST_BLOCKS <= count <= _MOST_BLOCKS and count % _AGAIN == 0:
            self._estimate_noise()
        else:
            self._sum(count - 1)
        if count >= _LEAST_BLOCKS:
            self._decide()

    def _sum(self, k: int) -> None:
        """Add block k to the information."""
        changes, white = _changes(self._parts, self._H[k]), np.linalg.inv(self._cov)
        H = self._H[k][:, : self._parts.rest] * self._sigmas
        e, H_white, changes_white = self._e[k], H.T @ white, changes.T @ white
        self._N += H_white @ H
        self._b += H_white @ e
        self._square += float(e @ white @ e)
        self._sums.add(self._t[k], H_white @ changes, changes_white @ changes, changes_white @ e)

    def _estimate_noise(self) -> None:
        """Estimate the covariance of the blocks' errors from what the model leaves of them; sum all blocks anew with it.

        The second time the change that explains most is fitted as well: it must not be taken for errors.
        """
        A, e = np.array(self._H)[:, :, : self._parts.rest] * self._sigmas, np.array(self._e)
        for last in (False, True):
            whiten = np.linalg.cholesky(np.linalg.inv(self._cov)).T
            flat = (whiten @ A).reshape(len(A) * 6, -1)
            whole = flat.T @ flat
            N = whole + np.eye(len(whole))
            x = np.linalg.solve(N, flat.T @ (e @ whiten.T).ravel())
            freedom = max(e.size - float(np.trace(np.linalg.solve(N, whole))), 0.0)
            left = e - A @ x
            own = (_BLOCKS * np.diag(_BLOCK_SIGMA**2) + left.T @ left) / (_BLOCKS + freedom / 6.0)
            along = left @ np.linalg.cholesky(np.linalg.inv(own))
            # Neighbours of like errors count as fewer (first-order autoregression).
            rho = float(np.vdot(along[1:], along[:-1]) / np.vdot(along, along))
            self._cov = own * max((1.0 + rho) / (1.0 - rho), 1.0)
            self._clear()
            for k in range(len(e)):
                self._sum(k)
            if not last:
                # Akaike's criterion: by as much as it explains, less what its parameters explain by chance.
                tested = self._tested(_begins(len(e)), _suspects(self._parts.joints))
                best = max(tested, key=lambda each: each.chi_square - 2.0 * len(each.size))
                A = np.concatenate([A, self._by_change(best)], axis=2)

    def _by_change(self, found: _Tested) -> Array:
        """Return the derivative (N, 6, D) of the blocks by a change, over the width of its prior."""
        t = np.array(self._t)
        begin_s = t[found.begin - 1]
        after = (t > begin_s).astype(float)
        if found.suspect.kind == "drift":
            after *= (t - begin_s) / (t[-1] - begin_s)
        columns = np.array([_changes(self._parts, H)[:, found.suspect.columns] for H in self._H])
        wide = _WIDE if columns.shape[2] == 6 else _WIDE_RAD
        return np.asarray(columns * wide * after[:, None, None])

    def _decide(self) -> None:
        """Test all hypotheses at some beginnings, and the best of them at those between."""
        begins = _begins(len(self._t))
        found = self._tested(begins, _suspects(self._parts.joints))
        self.strongest = max(self.strongest, *(each.chi_square / each.suspect.limit for each in found))
        best = max(found, key=lambda each: each.above)
        if best.above <= 0.0:
            return
        # A jump between two beginnings looks like a drift: both are tried at those between.
        either = [each for each in found if each is best or {each.suspect.kind, best.suspect.kind} == {"rig", "drift"}]
        finest = max((self._refined(each, begins) for each in either), key=lambda each: each.above)
        least = max(finest.above - _ALIKE, 0.0)
        alike = tuple(each.suspect for each in found if each.suspect is not finest.suspect and each.above > least)
        effect = _changes(self._parts, self._H[-1])[:, finest.suspect.columns]
        begin_s = (self._t[finest.begin - 1] + self._t[finest.begin]) / 2
        change = Change(finest.suspect, begin_s, finest.size, finest.cov, finest.chi_square, effect, alike)
        shift = np.zeros(3) if change.motion is None else change.motion.motion[:3]
        if change.motion is None and self._is_within_backlash(finest, found, least):
            self.change = None if self.change is None or self.change.motion is None else self.change
            return
        # Once something was reported, what explains it best replaces it, also where it is smaller than is reported first.
        if self.change is not None or change.motion is None or float(np.linalg.norm(shift)) > _LEAST_M:
            self.change = change

    @staticmethod
    def _is_within_backlash(finest: _Tested, found: Sequence[_Tested], least: float) -> bool:
        """Return whether an angle of a joint, or another of its own that explains as much, is too small to report."""
        same = [each for each in found if each.suspect.joint == finest.suspect.joint and each.above > least]
        return any(abs(float(each.size[0])) < _LEAST_RAD for each in (finest, *same) if len(each.size) == 1)

    def _refined(self, found: _Tested, begins: Array) -> _Tested:
        """Test a suspect at the beginnings between the neighbours of the one that was found for it."""
        row = int(np.searchsorted(begins, found.begin))
        between = np.arange(begins[max(row - 1, 0)], begins[min(row + 1, len(begins) - 1)] + 1)
        return self._tested(between, (found.suspect,))[0]

    def _tested(self, begins: Array, hypotheses: Sequence[Suspect]) -> list[_Tested]:
        """Test hypotheses at beginnings (S,); return each at the one of largest chi-square."""
        t = np.array(self._t)
        L = np.linalg.cholesky(self._N)
        steps, step_C, step_b, ramps, ramp_C, ramp_b = self._sums.since(begins, t[begins - 1], t[-1])
        whole = np.moveaxis(np.concatenate([steps, ramps], axis=2), 1, 0).reshape(self._parts.rest, -1)
        solved = solve_triangular(L, np.column_stack([whole, self._b]), lower=True, check_finite=False)
        b, white = solved[:, -1], np.moveaxis(solved[:, :-1].reshape(self._parts.rest, len(begins), -1), 1, 0)
        # What the model leaves beyond the blocks' errors widens them.
        excess = max((self._square - float(b @ b)) / max(6.0 * len(t), 1.0), 1.0)
        found: list[_Tested] = []
        for each in hypotheses:
            part = each.columns
            if each.kind == "drift":
                G, C, right = white[:, :, steps.shape[2] :], ramp_C, ramp_b
            else:
                G, C, right = white[:, :, part], step_C[:, part, part], step_b[:, part]
            wide = _WIDE if part.stop - part.start == 6 else _WIDE_RAD
            across = np.swapaxes(G, 1, 2)
            C = (C - across @ G) * np.outer(wide, wide) / excess + np.eye(len(wide))
            right = (right - across @ b) * wide / excess
            d = np.linalg.solve(C, right[..., None])[..., 0]
            chi_squares = np.einsum("sc,sc->s", right, d)
            n = int(np.argmax(chi_squares))
            cov = np.linalg.inv(C[n]) * np.outer(wide, wide)
            found.append(_Tested(each, int(begins[n]), wide * d[n], cov, float(chi_squares[n])))
        return found

    def findings(self) -> tuple[HealthFinding, ...]:
        """Return what was found so far; nothing while all is well."""
        return () if self.change is None else (_finding(self.change, self._names),)


def _changes(parts: ErrorLayout, H: Array) -> Array:
    """Return the columns (6, 12 + 2 n - 1) of what may change, of the derivative (6, K) of the tool's pose by the state."""
    # Of a gear that grew looser half is taken for each of the two that decide on the side: mostly they agree.
    n, tool = parts.joints, 6 * parts.joints
    widths = 0.5 * (H[:, parts.backlash : parts.backlash + n] + H[:, parts.floats : parts.floats + n])
    return np.concatenate([H[:, :6], H[:, tool : tool + 6], H[:, parts.zeros[1:]], widths], axis=1)


def _begins(count: int) -> Array:
    """Return the blocks (S,) at which a change may begin: close to each other where they are new."""
    ages = np.unique(np.geomspace(1, count - 1, _BEGINS).round().astype(int))
    return np.asarray(count - ages[::-1])


#: What else it may be.
_OTHER = {
    "rig": "a rig that moved",
    "drift": "a rig that drifts",
    "body": "a body that slipped on the tool",
    "joint": "a potentiometer of {name} that slipped",
    "backlash": "more backlash of {name}",
}


def _finding(change: Change, names: tuple[str, ...]) -> HealthFinding:
    """Return the finding of a change."""
    kind, joint = change.suspect.kind, change.suspect.joint
    others = dict.fromkeys(
        _OTHER[each.kind].format(name=names[each.joint])
        for each in change.alike
        if (each.kind, each.joint) != (kind, joint) and {each.kind, kind} != {"rig", "drift"}
    )
    unsure = f"; {' or '.join(others)} cannot be excluded" if others else ""
    if (motion := change.motion) is not None:
        return _moved_finding(change, motion, unsure)
    size, sigma = float(np.degrees(change.size[0])), float(np.degrees(np.sqrt(change.cov[0, 0])))
    if kind == "backlash":
        grew = "grew" if size > 0 else "shrank"
        what, advice = f"the backlash of {names[joint]} {grew} by {abs(size):.2f} deg", "look at the gear of this joint"
    else:
        same = ", or the rig rotated about the axis of this joint: the two look alike" if joint == 0 else ""
        what = f"the potentiometer of {names[joint]} slipped by {size:.2f} deg{same}"
        advice = "fasten the potentiometer on its shaft, and set its zero"
    return HealthFinding("joint", what + unsure, change.begin_s, size, sigma, "deg", advice)


def _moved_finding(change: Change, motion: BaseMotion, unsure: str) -> HealthFinding:
    """Return the finding of a rig or a body that moved."""
    size = float(np.linalg.norm(motion.motion[:3]))
    along = motion.motion[:3] / size
    sigma = float(np.sqrt(along @ motion.cov[:3, :3] @ along))
    so_far = " so far" if motion.drifts else ""
    by = f"displaced by {1e3 * size:.2f} mm and {np.degrees(np.linalg.norm(motion.motion[3:])):.3f} deg{so_far}{unsure}"
    if change.suspect.kind == "body":
        what, advice = "the body slipped on the tool: it is ", "fasten the body on the tool, and run again"
    else:
        how = "drifts" if motion.drifts else "moved"
        what = f"the rig {how} against the base of the arm: the tool appears "
        advice = "fasten the rig and the base of the arm, and run again: that repeats the hand-eye calibration"
    cause: Literal["body", "fixed"] = "body" if change.suspect.kind == "body" else "fixed"
    return HealthFinding(cause, what + by, change.begin_s, 1e3 * size, 1e3 * sigma, "mm", advice)
