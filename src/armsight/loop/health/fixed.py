"""What jumped or drifts: found at once in the innovations of the estimator.

In: what the estimator did with each pose measurement. Out: the hypotheses that explain it best. The generalised likelihood
ratio test of Willsky and Jones ("A generalized likelihood ratio approach to the detection and estimation of jumps in
linear systems", 1976): a change d of some numbers of the filter's state at a time s (base: the rig moved; tool: the body
slipped; a zero: a potentiometer slipped; delay: the clock jumped); what a filter that does not know of it leaves of that,
F, and its signature G in the innovations follow from the filter's own gains,

    G_k = H_k kept_k F_k-1,    F_k = kept_k F_k-1 - K_k G_k,    F_s = I in the rows of what changed

so that z_k = G_k d + noise; a drift adds its speed to F in every step. For each s the sums C = sum G^T S^-1 G and
b = sum G^T S^-1 z give d = C^-1 b, and the chi-square b^T C^-1 b. Many beginnings are tried at once, the older the coarser.
A motion of the base gives the alarm: with six numbers it explains most of what the others do. The likelihoods of all decide
which of them is named.

What moves to and fro within a second: a mount that nods, a stand that shakes; it averages out where a mean is tested.

Of each second a parabola is removed (calibrations and arms are off by what changes slowly with the pose). The rest
is compared with its expectation in the axes of the noise (principal axes of one covariance relative to another); an axis
counts where chance does not explain its variance. Moments of a component of variance: Searle, Casella, McCulloch,
"Variance Components", 1992.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from armsight.data import Array, Ids
from armsight.estimate.chance import chi_square_chance
from armsight.loop.estimators import Innovation, Outcome
from armsight.loop.estimators.armerror import layout
from armsight.loop.finding import (
    COSTS_M,
    FALSE_ALARMS_PER_MINUTE,
    SUSPECTED,
    HealthFinding,
    alarm_limit,
    displacement_m,
    make_finding,
)
from armsight.loop.health.change import RAMPS, Change, Suspect, changing, ranked, suspects, thinned, widths

#: A beginning is tried every so often, s; older than this many seconds their distances grow with their age.
EVERY_S, _FINE_S, _RATIO = 0.2, 1.0, 1.4
#: At most so many beginnings; half: old ones are dated half as well, double: twice the time.
MOST = 20
#: Errors of the arm's model last about so long, s: innovations closer than that count as one.
CORRELATED_S = 0.1
#: A drift must explain so much more than a jump to be preferred.
_RARER = 10.0
_LIMITS = {freedom: alarm_limit(freedom, 1.0 / EVERY_S, 2 * MOST) for freedom in (1, 6)}


class _Fitted(NamedTuple):
    """A change at S beginnings: size (S, D), information (S, D, D) over the priors, Birge ratios and chi-squares (S,)."""

    size: Array
    information: Array
    excess: Array
    chi_squares: Array


class FixedWatch:
    """Watches whether rig, body, potentiometers and clock stay as they are.

    Args:
        joints: how many the arm has.
    """

    def __init__(self, joints: int) -> None:
        at = self._parts = layout(joints)
        self._size = at.size
        # A column for each step: base, delay, tool, zeros after the first; then one for each ramp.
        rows = [*range(6), at.delay, *range(6 * at.joints, 6 * at.joints + 6), *at.zeros[1:]]
        self._steps = np.zeros((at.size, len(rows)))
        self._steps[rows, np.arange(len(rows))] = 1.0
        wide = widths(joints)[: len(rows)]
        self._wide, self._columns = np.append(wide, wide[:RAMPS]), len(rows) + RAMPS
        self._suspects = tuple(each for each in suspects(at.joints) if each.kind not in ("backlash", "bend", "zoom"))
        self._begins = np.zeros(0)
        # In single precision, which is enough and takes half the time: it is by far the largest array.
        self._F = np.zeros((at.size, 0, self._columns), np.float32)
        self._C, self._b = np.zeros((0, self._columns, self._columns)), np.zeros((0, self._columns))
        self._squares, self._weights = np.zeros(0), np.zeros(0)
        self._ramp_rows = np.array(rows[:RAMPS])
        # Since the newest beginning, each so long after the one before, s.
        self._shots = list[tuple[Innovation, float]]()
        self._newest: Innovation | None = None
        self._last_s = -np.inf
        #: the hypotheses of the test that found the clearest change, the best first; empty where none was found
        self.changes: tuple[Change, ...] = ()
        #: how many times the estimator dropped what it had learned, and when it first did, s
        self.reopened: tuple[int, float] = (0, np.inf)

    def _of(self, suspect: Suspect) -> Ids:
        """Return the columns (D,) of a suspect."""
        first = self._steps.shape[1] if suspect.slow else 0
        return first + np.arange(suspect.columns.start, suspect.columns.stop)

    def take(self, agreed: Sequence[Innovation]) -> None:
        """Take what the estimator did with a measurement, in order of time, and those before it that it accepted now."""
        newest = agreed[-1]
        if newest.outcome is Outcome.REOPENED:
            self.reopened = (self.reopened[0] + 1, min(self.reopened[1], newest.t_s))
            if len(agreed) > 1:
                self._begin(agreed[0].t_s)
        for each in agreed:
            self._add(each)

    def _add(self, innovation: Innovation) -> None:
        """Add an innovation; where a new beginning is due, test with those before it."""
        t_s = innovation.t_s
        passed = t_s - self._last_s
        if not passed > 0.0:
            return
        if not len(self._begins) or t_s - self._begins[-1] >= EVERY_S:
            self._begin(t_s)
            if self._newest is not None:
                self._decide(self._newest)
        self._shots.append((innovation, passed))
        self._last_s, self._newest = t_s, innovation

    def _sum(self) -> None:
        """Add the measurements since the newest beginning to the sums of all: (I + L) G = A F + Q, G stacked, whitened."""
        shots, self._shots = self._shots, []
        if not shots:
            return
        seen, n, steps = [innovation for innovation, _ in shots], 6 * len(shots), self._steps.shape[1]
        weights = np.array([min(passed / CORRELATED_S, 1.0) for _, passed in shots])
        spread = np.linalg.cholesky(np.array([each.cov for each in seen]) / weights[:, None, None])
        white = np.linalg.inv(spread)
        z = np.array([each.z if each.clock is None else each.z - each.clock.in_z for each in seen])
        z = (white @ z[..., None]).ravel()
        H = white @ np.array([each.by_state for each in seen])
        gains = np.array([each.gain for each in seen]) @ spread
        kept, ramps = np.ones(self._size), np.zeros(RAMPS)
        U, L, A, Q = np.zeros((self._size, n)), np.eye(n), np.zeros((n, self._size)), np.zeros((n, RAMPS))
        for k, (innovation, passed) in enumerate(shots):
            at, keeps = slice(6 * k, 6 * k + 6), innovation.kept
            kept = keeps * kept
            ramps = keeps[self._ramp_rows] * (ramps + (passed if np.isfinite(passed) else 0.0))
            U[:, : at.start] *= keeps[:, None]
            L[at, : at.start], A[at], Q[at] = H[k] @ U[:, : at.start], H[k] * kept, H[k][:, self._ramp_rows] * ramps
            U[:, at] = gains[k]
        AQ = np.linalg.solve(L, np.column_stack([A, Q]))
        G = (AQ[:, : self._size].astype(np.float32) @ self._F.reshape(self._size, -1)).reshape(n, -1, self._columns)
        G[:, :, steps:] += AQ[:, None, self._size :]
        left = (U.astype(np.float32) @ G.reshape(n, -1)).reshape(self._F.shape)
        self._F = kept.astype(np.float32)[:, None, None] * self._F - left
        self._F[self._ramp_rows, :, steps + np.arange(RAMPS)] += ramps[:, None]
        signature = np.moveaxis(G, 0, 1).astype(float)
        self._C += np.swapaxes(signature, 1, 2) @ signature
        self._b += z @ signature
        self._squares += float(z @ z)
        self._weights += weights.sum()

    def _begin(self, t_s: float) -> None:
        """Try a new beginning, and drop the ones that the age makes needless."""
        self._sum()
        rows = np.array(thinned(self._begins.tolist(), t_s, _FINE_S, _RATIO), int)
        rows = rows if len(rows) < MOST else np.delete(rows, 1)
        new = np.zeros((self._size, 1, self._columns), np.float32)
        new[:, 0, : self._steps.shape[1]] = self._steps
        self._begins = np.append(self._begins[rows], t_s)
        self._F = np.concatenate([self._F[:, rows], new], axis=1)
        self._C = np.concatenate([self._C[rows], np.zeros((1, self._columns, self._columns))])
        self._b = np.concatenate([self._b[rows], np.zeros((1, self._columns))])
        self._squares, self._weights = np.append(self._squares[rows], 0.0), np.append(self._weights[rows], 0.0)

    def _decide(self, innovation: Innovation) -> None:
        """Test all beginnings; the hypotheses are what they are at the newest measurement."""
        moving = [each for each in self._suspects if each.cause == "fixed"]
        explained = np.array([self._fitted(each).chi_squares for each in moving])
        alarms = explained - _RARER * np.array([[each.slow] for each in moving])
        kind, n = np.unravel_index(int(np.argmax(alarms)), alarms.shape)
        found = float(explained[kind, n])
        strongest = max((each.chi_square for each in self.changes if each.suspect.cause == "fixed"), default=0.0)
        if found <= max(_LIMITS[6], strongest):
            return
        near = slice(max(int(n) - 1, 0), int(n) + 2)
        columns, changes = changing(self._parts, innovation.by_state), list[Change]()
        for each in self._suspects:
            d, C, excess, chi_squares = self._fitted(each)
            k = near.start + int(np.argmax(chi_squares[near]))
            wide = self._wide[self._of(each)]
            cov = excess[k] * np.linalg.inv(C[k]) * np.outer(wide, wide)
            begin_s, chi_square = float(self._begins[k]), float(chi_squares[k])
            length = (innovation.t_s - begin_s) if each.slow else 1.0
            score = chi_square - _LIMITS[d.shape[1]] - (_RARER if each.slow else 0.0)
            effect, T = columns[:, each.columns], innovation.T_base_tool
            size, spread = length * d[k], length**2 * cov
            changes.append(Change(each, begin_s, innovation.t_s, size, spread, chi_square, score, effect, T))
        self.changes = ranked(changes)

    def _fitted(self, suspect: Suspect) -> _Fitted:
        rows = self._of(suspect)
        wide = self._wide[rows]
        C = self._C[:, rows[:, None], rows] * np.outer(wide, wide) + np.eye(len(rows))
        b = self._b[:, rows] * wide
        d = np.linalg.solve(C, b[..., None])[..., 0]
        gained = np.einsum("nk,nk->n", b, d)
        excess = np.maximum((self._squares - gained) / np.maximum(6.0 * self._weights, 1.0), 1.0)
        return _Fitted(wide * d, C, excess, gained / excess)

    def findings(self) -> tuple[HealthFinding, ...]:
        """Return that the estimator dropped what it had learned; nothing where it did not."""
        count, first_s = self.reopened
        if not count:
            return ()
        return (make_finding("reopened", (float(count), 0.0), first_s, words={"plural": "s" * (count != 1)}),)


#: Terms of the polynomial that is removed of each window; half: arms' errors shake, double: below 4 Hz nothing does.
_TERMS = 3
#: Shots of a window at the least; half: the polynomial takes most of what they show, double: slow cameras are not watched.
_LEAST = 8
#: Newest windows that count, without the share that varies most (a jump), and how many there must be.
#: Half: a jump counts for as long as a window does, double: shaking is found after twice the time.
_NEWEST, _ODD, _FEWEST = 20, 0.25, 4

#: Length of a window, s; half: shaking below 4 Hz (2 at rest) is taken for the arm, double: the arm for shaking.
_WINDOW_S = 1.0
#: A window ends where the arm may have wandered by so many sigmas of a shot; half: an arm that creeps is not watched,
#: double: its wandering hides what shakes.
_WANDERED = 1.0


class Unrest:
    """Estimates how much values of D numbers vary within a window beyond their noise.

    Attributes:
        cov: (D, D) covariance of what they vary beyond it; zero while chance explains it.
        suspected: the same by the newest window alone, while nothing is certain.
    """

    def __init__(self, size: int, terms: int = _TERMS) -> None:
        self._terms = terms  # of the polynomial that is removed of each window
        self._windows = tuple[tuple[Any, ...], ...]()  # replaced, never changed: a copy goes on alone
        self.cov = self.suspected = np.zeros((size, size))

    def take(self, t_s: Array, values: Array, covs: Array, excess: float = 1.0) -> None:
        """Take a window.

        ``t_s``: (N,) times, s. ``values``: (N, D) of its shots. ``covs``: (N, D, D) covariances of their noise.
        ``excess``: by how much the variance of the noise is larger than they say.
        """
        if len(t_s) < _LEAST or not np.ptp(t_s) > 0.0:
            return
        Q = np.linalg.qr(np.vander((t_s - t_s.mean()) / np.ptp(t_s), self._terms))[0]
        kept = np.eye(len(t_s)) - Q @ Q.T
        left, noise = kept @ values, np.einsum("nk,kij->nij", kept**2, excess * covs)
        # A shot says of a variance as much as the square of its information.
        sizes = np.trace(np.linalg.solve(covs.mean(axis=0), noise), axis1=1, axis2=2)
        shares = 1.0 / sizes**2
        sums = (left.T * shares) @ left, np.einsum("n,nij->ij", shares, noise), shares.sum(), np.square(shares).sum()
        window = float(np.trace(np.linalg.solve(sums[1], sums[0]))), len(t_s), *sums
        self._windows = (*self._windows, window)[-_NEWEST:]
        self.cov = self.suspected = np.zeros_like(self.cov)
        if len(self._windows) >= _FEWEST:
            usual = sorted(self._windows, key=lambda each: each[0])[: -max(round(_ODD * len(self._windows)), 1)]
            self.cov = self._beyond(usual, FALSE_ALARMS_PER_MINUTE / 60.0)
        if not self.cov.any():
            self.suspected = self._beyond([self._windows[-1]], SUSPECTED)

    def _beyond(self, windows: Sequence[tuple[Any, ...]], chance: float) -> Array:
        """Return the covariance (D, D) of what windows vary beyond their noise, in axes of less than a chance."""
        _, counts, seen, expected, once, twice = (sum(part) for part in zip(*windows, strict=True))
        freedom = float(once**2 / twice) * (1.0 - self._terms * len(windows) / counts)
        L = np.linalg.cholesky(expected / once)
        inner = np.linalg.solve(L, np.linalg.solve(L, seen / once).T)
        values, vectors = np.linalg.eigh((inner + inner.T) / 2.0)
        chances = np.array([chi_square_chance(freedom, freedom * value) for value in values])
        axes = L @ vectors
        return np.asarray((axes * np.where(chances * len(values) < chance, values - 1.0, 0.0)) @ axes.T)


def _outgrown(wander: Array, noise: Array) -> bool:
    """Return whether an arm may have wandered, covariance (6, 6), by more than a shot's noise (6, 6)."""
    return bool(np.trace(np.linalg.solve(noise, wander)) > len(noise) * _WANDERED**2)


class ShakeWatch:
    """Watches whether rig and arm shake against each other.

    While the arm stands, by poses against the model as it was learned: the estimator would follow what shakes. In motion,
    where the arm wanders as much, by what the estimator leaves.
    """

    def __init__(self) -> None:
        self._standing, self._moving = Unrest(6, terms=1), Unrest(6)
        self._windows: tuple[list[tuple[float, Array, Array]], ...] = ([], [])
        self._wandered: Array | float = 0.0  # variances (K,) of the arm's error since the standing window began
        self.change: Change | None = None

    def take(self, innovation: Innovation) -> None:
        """Take what the estimator did with a measurement, in order of time."""
        noise, added, more = innovation.noise, innovation.added, innovation.wandered
        if innovation.outcome is not Outcome.USED or noise is None or added is None:
            return
        R = np.kron(np.eye(2), innovation.T_base_tool[:3, :3])
        standing, moving = self._windows
        if self._late(moving, innovation):
            self._decide(self._moving, moving, innovation)
        left = noise + (innovation.by_state * added) @ innovation.by_state.T
        moving.append((innovation.t_s, R @ innovation.z, R @ left @ R.T))
        if innovation.reference is None or more is None:
            return
        e, H = innovation.reference()
        wandered = self._wandered * innovation.kept**2 + more
        wander = (H * wandered) @ H.T
        if self._late(standing, innovation) or (standing and _outgrown(wander, noise)):
            self._decide(self._standing, standing, innovation)
            wandered, wander = 0.0 * wandered, 0.0 * wander
        self._wandered = wandered
        # About its mean a random walk varies by a third of what it does about its begin.
        standing.append((innovation.t_s, R @ e, R @ (noise + wander / 3.0) @ R.T))

    @staticmethod
    def _late(window: list[tuple[float, Array, Array]], innovation: Innovation) -> bool:
        return bool(window) and not 0.0 <= innovation.t_s - window[0][0] < _WINDOW_S

    def _decide(self, unrest: Unrest, window: list[tuple[float, Array, Array]], newest: Innovation) -> None:
        """Compare a window with its noise, and empty it."""
        t_s, z, noise = map(np.array, zip(*window, strict=True))
        window.clear()
        unrest.take(t_s, z, noise)
        cov = max(self._standing.cov, self._moving.cov, key=np.trace)
        R = np.kron(np.eye(2), newest.T_base_tool[:3, :3])
        self.change = None
        if cov.any():
            now, effect = R.T @ cov @ R, np.eye(6)
            shakes = Suspect("shake", -1, slice(0, 6))
            self.change = Change(shakes, -np.inf, newest.t_s, np.zeros(6), now, 0.0, 0.0, effect, newest.T_base_tool)

    def findings(self) -> tuple[HealthFinding, ...]:
        """Return what was found, where it displaces the tool by what matters."""
        if self.change is None:
            return ()
        shift, angle = (float(np.sqrt(np.trace(self.change.cov[part, part]))) for part in (slice(0, 3), slice(3, 6)))
        cost_m = float(displacement_m(np.sqrt(np.diag(self.change.cov))))
        if cost_m < COSTS_M:
            return ()
        return (make_finding("shake", (shift, 0.1 * shift), cost_m=cost_m, words={"angle_deg": np.degrees(angle)}),)
