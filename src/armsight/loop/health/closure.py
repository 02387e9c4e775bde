"""What changed since the arm was first watched: rig, body on the tool, a joint; by closure over a whole run.

Nothing is followed: the errors x of the arm's model are constants of the run. Against the model as it was at the beginning
the residuals are e = H x + h f(t - s) d + n: a change d at a time s of some of the model's own parameters (h; f: a step, or
a ramp). Residuals are averaged over blocks of time and travel. The covariance of the blocks' errors n is
estimated from the blocks, as the errors of an arm that no model explains are larger than the noise of a measurement. x is
eliminated, and the chi-square of d against zero is the test. A pose that is visited again says the most: x cancels. Jumps
of linear models: Willsky and Jones, "A generalized likelihood ratio approach to the detection and estimation of jumps in
linear systems", 1976.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from armsight.data import Array
from armsight.loop.estimators import Innovation
from armsight.loop.estimators.armerror import layout
from armsight.loop.finding import LEVER_M, alarm_limit
from armsight.loop.health.change import (
    MARGIN,
    RAMPS,
    Change,
    Suspect,
    ToolView,
    changing,
    happened_besides,
    ranked,
    suspects,
    widths,
)

#: A block lasts so long, s, and until all joints have travelled so far, rad, but at most so long, s.
BLOCK_S, TRAVEL_RAD, MOST_S = 0.7, 0.1, 10.0
#: Travel in which the filter forgets what no joint explains, rad.
_POSE_TRAVEL_RAD = 1.0
#: Blocks before the first test; their errors are estimated anew after so many more, and no more after so many.
_LEAST_BLOCKS, _AGAIN, _MOST_BLOCKS = 12, 4, 64
#: Beginnings that are tried; the newer, the closer.
_BEGINS = 12
#: Blocks that are kept, older ones merged in pairs. half: an old beginning is known half as closely, double: 2 MB more.
_MOST_KEPT = 160
#: Errors of a block before any is seen (m, rad), and how many blocks that counts.
_BLOCK_SIGMA, _BLOCKS = np.repeat([1.2e-4, np.radians(0.012)], 3), 8.0
#: A motion that displaces the tool by less, m, is not reported, nor a smaller angle, rad: links in their backlash.
_LEAST_M, _LEAST_RAD = 2e-4, float(np.radians(0.3))
#: By so much the chi-square of a drift must exceed that of a jump.
_RARER = 5.0
#: Of a change that was found so many beginnings are tried at most; and of one that lacks at most this share of the limit.
_FINE, _NEAR = 8, 0.5


@lru_cache
def _limits(joints: int) -> dict[int, float]:
    """Return chi-square beyond which a change of so many parameters is reported; all suspects share the false alarms."""
    hypotheses = len(suspects(joints)) * _BEGINS
    return {freedom: MARGIN * alarm_limit(freedom, 1.0 / BLOCK_S, hypotheses) for freedom in (1, 4, 6, 7, 10, 12)}


@lru_cache
def _unsure(joints: int, blocks: int) -> dict[int, float]:
    """Return by how much chi-square must exceed its limit before a change of so many parameters is reported at first.

    A side of a backlash that is wrongly known displaces some blocks along one joint: what one number explains has the
    tails of Student's t.
    """
    hypotheses = len(suspects(joints)) * _BEGINS
    single = MARGIN * alarm_limit(1, 1.0 / BLOCK_S, hypotheses, blocks)
    return {1: single - _limits(joints)[1], 4: 0.0, 6: 0.0}


class _Tested(NamedTuple):
    """A hypothesis at its best beginning, a block; what it leaves unexplained, over what the blocks leave without it."""

    suspect: Suspect
    begin: int
    size: Array
    cov: Array
    chi_square: float
    above: float
    left: float


class _Block:
    def __init__(self, begin_s: float, size: int) -> None:
        self.begin_s, self.count, self.kept = begin_s, 0, 1.0
        self.t, self.e, self.H, self.clock_s = 0.0, np.zeros(6), np.zeros((6, size)), 0.0


class ClosureWatch:
    """Watches a whole run for changes.

    Args:
        sigmas: (K,) standard deviations of the filter's state before anything was measured.
        joints: how many the arm has.
        seen: who sees the tool; None where that is not known.
    """

    def __init__(self, sigmas: Array, joints: int, seen: ToolView | None = None) -> None:
        self._parts, self._seen = layout(joints), seen
        # The arm's model: all that motion does not make it forget, and the delay that the sweep found, to its sigma.
        self._model = np.append(np.arange(self._parts.rest), self._parts.delay)
        self._sigmas = sigmas[self._model]
        self._block: _Block | None = None
        self._t: list[float] = []
        self._e: list[Array] = []
        self._H: list[Array] = []
        self._clock_s: list[float] = []
        self._merged: list[int] = []  # how many blocks each one is of
        self._newest: Innovation | None = None
        self._wide = widths(joints)
        self._cov, self._unsure = np.diag(_BLOCK_SIGMA**2), _unsure(joints, int(_BLOCKS))
        self._clear()
        #: the hypotheses that explain best what was found, the best first; empty while all is well
        self.changes: tuple[Change, ...] = ()
        #: the same by the newest test, also where it is smaller than is reported: what another test reports
        self.explained: tuple[Change, ...] = ()
        #: of these what is as certain as what is reported at first: poses are widened by it
        self.certain: tuple[Change, ...] = ()
        self.strongest = 0.0  #: of all tests the largest chi-square over its limit

    def _clear(self) -> None:
        size = len(self._model)
        self._N, self._b, self._square = np.eye(size), np.zeros(size), 0.0
        # Up to each block: the information between the model and what may change (steps, then these times the time), that
        # among what may change, and its right side.
        self._sums: list[tuple[Array, Array, Array]] = []

    def take(self, agreed: Sequence[Innovation]) -> None:
        """Take what the estimator did with a measurement, in order of time, and those before it that it accepted now."""
        self._newest = agreed[-1]
        for each in agreed:
            self._add(each)

    def _add(self, innovation: Innovation) -> None:
        """Add a measurement to its block; test when the block is full."""
        if innovation.reference is None:
            return
        (e, H), clock = innovation.reference(), innovation.clock
        if clock is not None:
            e = e - clock.offset_s * H[:, self._parts.delay]
        block = self._block = self._block or _Block(innovation.t_s, self._parts.size)
        block.clock_s += 0.0 if clock is None else clock.sigma_s
        block.count += 1
        block.kept *= float(innovation.kept[self._parts.pose])
        block.t += innovation.t_s
        block.e += e
        block.H += H
        passed = innovation.t_s - block.begin_s
        moved = block.kept < np.exp(-TRAVEL_RAD / _POSE_TRAVEL_RAD)
        if passed >= MOST_S or (passed >= BLOCK_S and moved):
            self._close(block)
            self._block = None

    def _close(self, block: _Block) -> None:
        self._t.append(block.t / block.count)
        self._e.append(block.e / block.count)
        self._H.append(block.H / block.count)
        self._clock_s.append(block.clock_s / block.count)
        self._merged.append(1)
        count = len(self._t)
        self._sum(slice(count - 1, count))
        if _LEAST_BLOCKS <= count <= _MOST_BLOCKS and count % _AGAIN == 0:
            self._estimate_noise()
        if count >= _LEAST_BLOCKS:
            self._decide()
        if count >= _MOST_KEPT:
            self._merge()

    def _merge(self) -> None:
        """Merge the older half of the blocks in pairs, but for those about a change; what is summed stays as it is."""
        t = np.array(self._t)
        near = np.any([np.abs(t - each.begin_s) < MOST_S for each in self.changes] or [np.zeros(len(t), bool)], axis=0)
        for k in reversed(range(0, len(t) // 2, 2)):
            if near[k] or near[k + 1]:
                continue
            n, m = self._merged[k : k + 2]
            every: tuple[list[Any], ...] = (self._t, self._e, self._H, self._clock_s)
            for values in every:
                values[k : k + 2] = [(n * values[k] + m * values[k + 1]) / (n + m)]
            self._merged[k : k + 2] = [n + m]
            self._sums[k : k + 2] = [self._sums[k + 1]]

    def _whitened(self, blocks: slice) -> tuple[Array, Array, Array]:
        """Return of B blocks the derivatives (B, 6, K) by the model, by what may change (B, 6, D), and residuals (B, 6)."""
        # What is not known of a clock that is followed is an error along the velocity that a whole block has in common.
        H, e = np.array(self._H[blocks]), np.array(self._e[blocks])
        late = np.array(self._clock_s[blocks])[:, None] * H[:, :, self._parts.delay]
        own = self._cov / np.array(self._merged[blocks])[:, None, None]
        white = np.linalg.inv(np.linalg.cholesky(own + late[:, :, None] * late[:, None, :]))
        model, changes = H[:, :, self._model] * self._sigmas, changing(self._parts, H, self._seen)
        return white @ model, white @ changes, (white @ e[..., None])[..., 0]

    def _sum(self, blocks: slice) -> None:
        H, changes, e = self._whitened(blocks)
        flat = H.reshape(-1, H.shape[2])
        self._N += flat.T @ flat
        self._b += flat.T @ e.ravel()
        self._square += float(np.vdot(e, e))
        changes = np.concatenate([changes, np.array(self._t[blocks])[:, None, None] * changes[:, :, :RAMPS]], axis=2)
        changes_T = np.swapaxes(changes, 1, 2)
        new = np.swapaxes(H, 1, 2) @ changes, changes_T @ changes, changes_T @ e[..., None]
        for across, inner, right in zip(*new, strict=True):
            before = self._sums[-1] if self._sums else (0.0, 0.0, 0.0)
            self._sums.append((before[0] + across, before[1] + inner, before[2] + right[:, 0]))

    def _since(self, begins: Array) -> tuple[Array, Array, Array]:
        """Return (S, ...) the same sums of steps at beginnings (S,), and of ramps from the blocks before them until now."""
        across, inner, right = (
            last - np.array([self._sums[k - 1][n] for k in begins]) for n, last in enumerate(self._sums[-1])
        )
        starts_s = np.array(self._t)[begins - 1, None]
        lengths_s, count, ramps = self._t[-1] - starts_s, right.shape[1], np.arange(RAMPS)
        by = np.tile(np.eye(count), (len(begins), 1, 1))  # of a ramp: (time - start) / length
        by[:, ramps, count - RAMPS + ramps] = -starts_s / lengths_s
        by[:, count - RAMPS + ramps, count - RAMPS + ramps] = 1.0 / lengths_s
        return across @ by, np.swapaxes(by, 1, 2) @ inner @ by, np.einsum("sc,scd->sd", right, by)

    def _estimate_noise(self) -> None:
        """Estimate the covariance of the blocks' errors from what the model leaves of them; sum all blocks anew with it."""
        blocks, errors = np.array(self._H)[:, :, self._model] * self._sigmas, np.array(self._e)
        for _ in range(2):
            # Akaike's criterion: by as much as it explains, less what its parameters explain by chance.
            begins = _begins(len(errors))
            tested = self._tested(begins)
            best = max(tested, key=lambda each: each.chi_square - 2.0 * len(each.size))
            A, e, numbers = blocks.copy(), errors.copy(), errors.size
            closest = max(self._closest(begins, tested), key=lambda each: each.above, default=best)
            if closest.above > 0.0:  # the block into which it fell has errors of its own
                best = closest
                A[best.begin - 1], e[best.begin - 1], numbers = 0.0, 0.0, numbers - 6
            A = np.concatenate([A, self._by_change(best)], axis=2)
            whiten = np.linalg.cholesky(np.linalg.inv(self._cov)).T
            flat = (whiten @ A).reshape(len(A) * 6, -1)
            whole = flat.T @ flat
            N = whole + np.eye(len(whole))
            x = np.linalg.solve(N, flat.T @ (e @ whiten.T).ravel())
            freedom = max(numbers - float(np.trace(np.linalg.solve(N, whole))), 0.0)
            left = e - A @ x
            own = (_BLOCKS * np.diag(_BLOCK_SIGMA**2) + left.T @ left) / (_BLOCKS + freedom / 6.0)
            along = left @ np.linalg.cholesky(np.linalg.inv(own))
            # Neighbours of like errors count as fewer (first-order autoregression).
            rho = float(np.vdot(along[1:], along[:-1]) / np.vdot(along, along))
            alike = max((1.0 + rho) / (1.0 - rho), 1.0)
            self._cov = own * alike
            self._unsure = _unsure(self._parts.joints, int(_BLOCKS + freedom / 6.0 / alike))
            self._clear()
            self._sum(slice(0, len(e)))

    def _closest(self, begins: Array, found: Sequence[_Tested]) -> list[_Tested]:
        """Return all hypotheses at beginnings between the neighbours of those at which some come near their limits.

        The block into which a change falls has an error that no beginning explains, beside which the others look small.
        """
        limits = _limits(self._parts.joints)
        near = [each for each in found if each.above > -_NEAR * limits[each.suspect.freedom]]
        if not near:
            return []
        rows = {int(np.searchsorted(begins, each.begin)) for each in near}
        between = np.unique(np.concatenate([self._between(begins, row) for row in rows]))
        finest = self._finest_of(between)
        first = max(finest, key=lambda each: each.above).begin
        beside = [k for k in (first - 1, first + 1) if 1 <= k < len(self._t) and k not in between]
        if beside:
            pairs = zip(finest, self._finest_of(np.array(beside)), strict=True)
            finest = [max(pair, key=lambda each: each.above) for pair in pairs]
        return finest

    def _by_change(self, found: _Tested) -> Array:
        """Return the derivative (N, 6, D) of the blocks by a change, over the width of its prior."""
        t, part = np.array(self._t), found.suspect.columns
        begin_s = t[found.begin - 1]
        after = (t > begin_s).astype(float)
        if found.suspect.slow:
            after *= (t - begin_s) / (t[-1] - begin_s)
        columns = changing(self._parts, np.array(self._H), self._seen)[:, :, part]
        return np.asarray(columns * self._wide[part] * after[:, None, None])

    def _decide(self) -> None:
        """Test what explains the blocks best, and report it where it is certain and matters."""
        changes, certain = self._best()
        self.explained, self.certain = changes, changes if certain else ()
        # Once something was reported, what explains it best replaces it, also where it is smaller than is reported first.
        if changes and (self.changes or (certain and _matters(changes[0]))):
            # What was reported before is not undone by something else that began later.
            first = tuple(each for each in self.changes if each.besides) or self.changes
            self.changes = (*changes, *happened_besides(first, changes[0]))

    def _best(self) -> tuple[tuple[Change, ...], bool]:
        """Test all hypotheses at some beginnings, the best of them at those between; return whether they are certain."""
        begins = _begins(len(self._t))
        found = self._tested(begins)
        limits = _limits(self._parts.joints)
        at_first = {n: limits[n] + more for n, more in self._unsure.items()}
        self.strongest = max(self.strongest, *(each.chi_square / at_first[each.suspect.freedom] for each in found))
        finest = self._closest(begins, found)
        if not finest:
            return (), False
        # The errors are what the best one leaves, not what is left while nothing is taken to have changed.
        best = max(finest, key=lambda each: each.above)
        # Where none is above its limit with all blocks, the block that is left out is six more numbers that explain.
        clear = max(each.above for each in found) > 0.0
        if best.above <= (0.0 if clear else limits[best.suspect.freedom + 6] - limits[best.suspect.freedom]):
            return (), False
        certain = best.above > self._unsure[best.suspect.freedom]
        return ranked([self._change(each, best.left) for each in finest]), certain

    def _finest_of(self, between: Array) -> list[_Tested]:
        """Return all hypotheses, each at the best of some beginnings, the block into which the change fell left out."""
        solved = np.linalg.solve(np.linalg.cholesky(self._N), self._b)
        with_all = self._square - float(solved @ solved)
        tested = [self._tested(np.array([k]), (k - 1, with_all)) for k in between]
        return [max(each, key=lambda one: one.above) for each in zip(*tested, strict=True)]

    def _between(self, begins: Array, row: int) -> Array:
        """Return blocks between the neighbours of a beginning, those at the newest finding's among them."""
        first, last = begins[max(row - 1, 0)], begins[min(row + 1, len(begins) - 1)]
        near = int(np.searchsorted(self._t, self.changes[0].begin_s)) if self.changes else begins[row]
        some = np.linspace(first, last, _FINE).round().astype(int)
        some = np.concatenate([some, near + np.arange(-1, 3)])
        return np.asarray(some[(some >= 1) & (some < len(self._t))])

    def _change(self, found: _Tested, left: float) -> Change:
        """Return a hypothesis as a record; the errors' variance is so many times what it was tested with."""
        assert self._newest is not None
        assert self._newest.reference is not None
        # What the sizes were estimated with: the filter's own state may have followed the change, base against zeros.
        effect = changing(self._parts, self._newest.reference()[1], self._seen)[:, found.suspect.columns]
        begin_s = (self._t[found.begin - 1] + self._t[found.begin]) / 2
        end_s, T = self._t[-1], self._newest.T_base_tool
        limit = _limits(self._parts.joints)[found.suspect.freedom]
        score, chi_square = (found.above + limit) / left - limit, found.chi_square / left
        size, cov = found.size, left * found.cov
        return Change(found.suspect, begin_s, end_s, size, cov, chi_square, score, effect, T, seen=self._seen)

    def _tested(self, begins: Array, without: tuple[int, float] | None = None) -> list[_Tested]:
        """Test all hypotheses at beginnings (S,); return each at the one of largest chi-square.

        ``without``: a block that is left out, as the change fell into it, and what the model leaves unexplained with
        it; what leaving it out explains counts for the beginning.
        """
        N, b, square, gained = self._N, self._b, self._square, 0.0
        if without is not None:
            k, gained = without
            (H,), _, (e,) = self._whitened(slice(k, k + 1))
            N, b, square = N - H.T @ H, b - H.T @ e, square - float(e @ e)
        L = np.linalg.cholesky(N)
        across, C, right = self._since(begins)
        whole = np.moveaxis(across, 1, 0).reshape(len(self._model), -1)
        solved = np.linalg.solve(L, np.column_stack([whole, b]))
        b, white = solved[:, -1], np.moveaxis(solved[:, :-1].reshape(len(self._model), len(begins), -1), 1, 0)
        # What the model leaves beyond the blocks' errors widens them.
        left = square - float(b @ b)
        numbers = 6.0 * sum(self._merged)
        excess = max(left / numbers, 1.0)
        gained = 0.0 if without is None else (gained - left) / excess
        limits, found = _limits(self._parts.joints), list[_Tested]()
        wide = np.append(self._wide, self._wide[:RAMPS])
        right = (right - b @ white) * wide / excess
        first = len(self._wide)  # of the ramps
        # Of single numbers, whose information is one number each.
        own = (np.einsum("scc->sc", C) - np.einsum("skc,skc->sc", white, white)) * (wide**2 / excess) + 1.0
        best = np.argmax(right**2 / own, axis=0)
        for each in suspects(self._parts.joints):
            part = slice(each.columns.start + first * each.slow, each.columns.stop + first * each.slow)
            by = wide[part]
            if len(by) == 1:
                n = int(best[part.start])
                cov = (by**2 / own[n, part])[:, None]
            else:
                G, inner = white[:, :, part], C[:, part, part]
                inner = (inner - np.swapaxes(G, 1, 2) @ G) * (by[:, None] * (by / excess)) + np.eye(len(by))
                solved = np.linalg.solve(inner, right[:, part, None])[..., 0]
                n = int(np.argmax(np.einsum("sc,sc->s", right[:, part], solved)))
                cov = np.linalg.inv(inner[n]) * (by[:, None] * by)
            size = cov @ (right[n, part] / by)
            chi_square = float(right[n, part] @ (size / by))
            above = chi_square + gained - limits[each.freedom] - (_RARER if each.slow else 0.0)
            rest = (left / excess - chi_square) / numbers
            share = max(rest, 1.0 / excess)  # the errors are no smaller than the blocks'
            found.append(_Tested(each, int(begins[n]), size, cov, chi_square, above, share))
        return found


def _matters(change: Change) -> bool:
    if change.suspect.cause == "time":
        return True
    if change.suspect.moves:
        lever_m = LEVER_M * float(np.linalg.norm(change.size[:3])) if change.suspect.kind == "bend" else 0.0
        return float(np.linalg.norm(change.newest[0][:3])) > _LEAST_M or lever_m > _LEAST_M / 2.0
    return float(np.linalg.norm(change.size)) > _LEAST_RAD


def _begins(count: int) -> Array:
    """Return the blocks (S,) at which a change may begin: close to each other where they are new."""
    ages = np.unique(np.geomspace(1, count - 1, _BEGINS).round().astype(int))
    return np.asarray(count - ages[::-1])
