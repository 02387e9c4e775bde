"""Points of the body that are not where its file says, and focal lengths that changed: found in what seven numbers leave.

In: the sums of the shots' residuals as in :mod:`~armsight.loop.health.rig`, those of points included that a pose was
measured without because they did not fit. Out: which points moved on the body, by how much, or by how much the focal length
of one camera changed against that of the other.

Score test (Rao, 1948): with everything else estimated, the seven numbers among it, a displacement d of a point k explains
r^T S^-1 r of the sum of squares, with

    S = J^T H J - A^T C^-1 A + I / w^2,    A = M^T H J,    C = M^T H M + I,    r = J^T b - A^T C^-1 M^T b

where H and b are the sums, J selects the point, and M has the standard deviations of everything else as its columns. The
point that explains most is taken, then the next one besides it, while one explains more than chance: a body that is bent.

What may have changed and is not distinguished yet widens the poses: of each hypothesis (the seven numbers, focal lengths,
a point, all points a little) the evidence against none (MacKay, 1992), of the newest test and of some newest ones together.
Where the hypotheses together are more probable than that nothing changed, the second moment of their mixture is what poses
may be off by. Shots that fit worst, a quarter of them, do not count: what changed shows in all that follow, an edge before
the body in few. Chance exceeds an evidence of 1 / p in p of the tests at most (Markov), whatever the hypotheses.

Only what lasts is reported. A reflection, or another light of the scene that is taken for a disc, stays in the scene or in
the image while the body rotates. So a point counts only if the median of what single shots say agrees with what all say
together, seen from directions that differ.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from armsight.data import Array, Ids, Record
from armsight.estimate.chance import chi_square_limit, squares_of
from armsight.geometry.rotation import skew
from armsight.loop.finding import ALIKE, HealthFinding, alarm_limit, make_finding, sized
from armsight.loop.health.residuals import (
    FRESH,
    FURTHEST_M,
    MATTERS,
    NECESSARY,
    POSES,
    STEPS,
    UNLIKE,
    History,
    Onset,
    ResidualSums,
    eliminated,
    largest_square,
)

#: A focal length may change so much, as a share.
FOCAL_SHARE = 0.05
#: Less than this is not reported, m and as a share: paint and glue are not more exact.
_LEAST_M, _LEAST_FOCAL = 1e-4, 4e-4
#: Single shots agree with all together if the median of their share of the displacement is between these.
_AGREE = (0.5, 2.0)
#: So many of the newest shots are asked, at the least so many; all together are of so many poses that differ at the least.
_ASKED, _LEAST_SHOTS, _LEAST_POSES = 30, 8, 6
#: The directions from which the body was seen must differ from their mean by so much, rad.
_VIEWS_RAD = 0.05
#: Directions that are remembered.
_VIEWS = 1000
_BESIDES = chi_square_limit(3, NECESSARY)
#: Probability, before a test, that it is the first one after any change; that a body is strained or bent as a print is.
_RARE, _PRINTED = 1e-4, 0.1
#: A smooth deformation is said from this log-evidence on: one of a thousand bodies by chance (Markov).
#: Half: one of thirty, double: a shear of 0.3 % widens poses without a word.
_CERTAIN = float(np.log(1e3))
#: Priors' widths of strain, shear, bending, as a share of the radius; half: 0.3 % is found later, double: 0.1 % is.
_STRAINS = (1e-3, 4e-3)
#: All points may be displaced by about so much, m.
_BENT_M = (2e-4, 1e-3)
#: The seven numbers are expected to change by such shares of their priors, which are wide.
_SEVEN_SCALES = (1.0, 0.03, 0.003)


@dataclass(frozen=True, eq=False)
class ShapeError(Record):
    """Points that are displaced on the body, or focal lengths that changed."""

    #: what is wrong: rows of the tested points, in the order of what they explain, or FOCAL alone
    chosen: tuple[int, ...]
    #: (C,) of all candidates, m for each coordinate of a point, as a share for the focal lengths. Of one point that is
    #: displaced the others are zero; of a bent body they are as uncertain as the displacements are large
    value: Array
    cov: Array  #: (C, C) its covariance
    chi_square: float  #: by how much the first explains more than a change of the seven numbers does
    seven: float  #: by how much the seven numbers explain more than they all do
    alike: tuple[int, ...]  #: what explains nearly as much as the first
    onset: Onset

    @property
    def begin_s(self) -> float:
        """Since when, s."""
        return self.onset.begin_s

    @property
    def seven_needed(self) -> bool:
        """Whether a change of the seven numbers is needed besides."""
        return bool(self.seven > chi_square_limit(7, NECESSARY))


#: Stand for the focal lengths and for a smooth deformation among the rows of the points.
FOCAL, SMOOTH = -1, -2
#: Rows of the seven numbers once the parameters are eliminated.
_SEVEN = slice(1, 8)


class _Reduced(NamedTuple):
    """What sums say of the candidates: with the seven numbers eliminated, and with these zero."""

    whole: ResidualSums
    without: ResidualSums


class _Hypotheses(NamedTuple):
    """Hypotheses of D numbers each.

    Rows (N, D) of seven numbers, candidates and smooth deformations, by how much of their priors (N,), and the probability
    of all of them before anything is seen.
    """

    rows: Ids
    scales: Array
    chance: float = _RARE


class _Explained(NamedTuple):
    """Log-evidence (N,) of hypotheses against none, the sizes (N, D) of what changed, and their covariances (N, D, D)."""

    evidence: Array
    size: Array
    cov: Array


class ShapeWatch:
    """Watches the shape of the body, and the focal lengths of the cameras against each other.

    What it holds is replaced, never changed: a copy (:mod:`copy`) goes on alone.

    Args:
        focal: (K, 2) what relative changes of the focal lengths change of these: of the left one by a half and of the right
            one by minus a half, and of both.
        tolerance_m: standard deviation of each of their coordinates, m.
        rigid: whether single points are not tested.
        strained: whether the body may be elongated, sheared or bent: not a print whose shape a calibration found.
    """

    def __init__(
        self,
        size: int,
        focal: Array,
        first: int,
        points: Array,
        names: tuple[str, ...],
        tolerance_m: float,
        test_s: float,
        *,
        rigid: bool,
        strained: bool,
    ) -> None:
        K, n = size, len(names)
        self._size, self._first, self._names = K, first, names
        # (K, 2 + 3 N) what a unit of each candidate changes: focal lengths against each other, together, coordinates.
        self._by_candidate = np.zeros((K, 2 + 3 * n))
        self._by_candidate[:, :2] = focal
        self._by_candidate[first : first + 3 * n, 2:] = np.eye(3 * n)
        self._wide = np.append([FOCAL_SHARE, FOCAL_SHARE], np.full(3 * n, FURTHEST_M))
        #: (K, C) what the standard deviations of the candidates' priors change of the parameters
        self.by_wide = self._by_candidate * self._wide
        self._candidates = () if rigid else tuple(range(n))
        # What smooth deformations add to sums of the residual, the seven numbers and the candidates; in m of the latter.
        self._smooth = _smooth(points)
        # (3 N, 3 N) what takes motions of all points out of their displacements; standard deviation of their priors, m.
        motions = np.linalg.qr(np.hstack([np.tile(np.eye(3), (n, 1)), -skew(points).reshape(3 * n, 3)]))[0]
        self._apart, self._tolerance = np.eye(3 * n) - motions @ motions.T, tolerance_m
        self._with_smooth = np.hstack([np.eye(10 + 3 * n), np.vstack([np.zeros((10, 27)), self._smooth / FURTHEST_M])])
        self._hypotheses = _hypotheses(len(self._candidates), 3 * n, strained=strained)
        self._limit_focal, self._limit = (alarm_limit(size, 1.0 / test_s, 2 * (n + 1)) for size in (1, 3))
        self._view: Array | None = None  # the newest direction that differs from the one before
        self._views = tuple[tuple[float, Array], ...]()  # and of what time, s
        self._shots = tuple[Array, ...]()  # rows, as they were taken
        # The response of the newest poses to the parameters, and the covariances of these poses.
        self._effects = tuple[tuple[Array, Array], ...]()
        self.changed_s = np.inf  # since when something may have changed
        self._alarms = 0  # in a row
        self._suspect: ShapeError | None = None
        #: (7 + C, 7 + C) second moment of the seven numbers and the candidates, in units of their priors, by all that
        #: may have changed; None where that is improbable, or known: then by what the body is off within its tolerance,
        #: where that displaces poses by more than their sigma
        self.doubt: Array | None = None
        self.found: ShapeError | None = None  #: what the newest test found for certain
        self.said: ShapeError | None = None

    def take(self, t_s: float, rows: Array, T: Array, response: Array, cov: Array, moved: bool) -> None:
        """Take a shot.

        ``t_s``: its time, s. ``rows``: (n, 1 + K) its residuals and their derivatives, all points included, its pose
        eliminated. ``T``: (4, 4) pose T_left_body. ``response``: (6, K) of a pose measured with all points to the
        parameters. ``cov``: (6, 6) covariance of the pose. ``moved``: whether its pose differs from the one before;
        single shots are asked only then.
        """
        self._effects = (*self._effects, (response, cov))[-POSES:]
        if not moved:
            return
        self._shots = (*self._shots, rows)[-_ASKED:]
        view = T[:3, :3].T @ T[:3, 3]
        view /= np.sqrt(view @ view)
        if self._view is None or np.linalg.norm(view - self._view) > _VIEWS_RAD / _LEAST_POSES:  # else it rests
            self._views = (*self._views, (t_s, view))[-_VIEWS:]
            self._view = view

    def decide(self, tests: History, usual: History, *, ends: bool) -> None:
        """Test once more; the first test is enough by itself only where it ends all."""
        self._tests, self._usual, before = tests, usual, self._suspect
        doubted_s, self.doubt = self._doubted(every=ends or self.doubt is not None)
        # What is not doubtful is not certain.
        self._suspect = None if before is None and self.doubt is None else self._suspected(before)
        self._alarms = 0 if self._suspect is None else self._alarms + 1
        # What a change leaves in the test in which it began may look like a displaced point, once.
        now = self._suspect
        again = before is not None and now is not None and before.chosen[0] == now.chosen[0]
        self.found = self._suspect if again or (ends and len(tests.kept) == 1) else None
        self.said = self.found or self.said
        if self.found is not None:
            _, self.doubt = self._doubted(every=True)
            self.changed_s = self.found.begin_s
        elif self.doubt is None:
            self.changed_s = np.inf
            self.doubt = self._tolerated()
        else:
            self.changed_s = min(self.changed_s, doubted_s)

    def _suspected(self, before: ShapeError | None) -> ShapeError | None:
        """Return what the tests show now, since when; ``before`` is what they showed last time."""
        tests = self._tests
        windows = tests.windows(every=True) if before is None else [before.onset]
        shown = next(filter(None, map(self._shown, windows)), None)
        if shown is not None and (self._alarms < FRESH or tests.count % STEPS == 0):
            oldest_s = None if self._alarms < FRESH else shown.begin_s
            return self._shown(tests.dated(9 + 3 * len(self._candidates), oldest_s)[1])
        return shown

    def _doubted(self, *, every: bool) -> tuple[float, Array | None]:
        """Return since when something may have changed, s, and its second moment (7 + C, 7 + C); None where nothing."""
        if self.found is None:
            sums = [self._usual.reduced(each) for each in self._usual.windows(every=every)]
            mixtures = [self._mixture(each, self._hypotheses) for each in sums]
            best = max(range(len(sums)), key=lambda n: mixtures[n][0])
            evidence, moment = mixtures[best]
            return sums[best].begin_s, moment if evidence > np.log(2.0) else None
        if self.found.chosen != (FOCAL,):
            return self.found.begin_s, None
        # Cameras that moved cannot be excluded.
        return self.found.begin_s, self._mixture(self._usual.reduced(self.found.onset), self._hypotheses[:1])[1]

    def _tolerated(self) -> Array | None:
        """Return the second moment (7 + C, 7 + C) of the body's shape in its tolerance, where it matters, else None."""
        K, points = self._size, slice(self._first, self._first + len(self._smooth))
        usual = self._usual.since(self._usual.always)
        cov = np.linalg.inv(usual.H[:K, :K] + np.eye(K))
        of_points = self._tolerance * self._apart
        d, spread = of_points @ (cov @ usual.b[:K])[points], of_points @ cov[points, points] @ of_points.T
        if self._displaces(np.append([0.0, 0.0], d)) < 6.0:  # a pose's own squared error, all six numbers together
            return None
        moment = np.zeros((9 + len(d), 9 + len(d)))
        moment[9:, 9:] = (np.outer(d, d) + spread) / FURTHEST_M**2
        return moment

    def evidence(self, sums: ResidualSums, excess: float, skewed: bool) -> float:
        """Return the log-evidence of the best hypothesis of what changed and stays against none; 0 where none does."""
        M = self._with_smooth.T @ eliminated(sums.M, slice(1, 1 + self._size)) @ self._with_smooth
        seven, *rest = self._hypotheses
        some = seven if skewed else seven._replace(rows=seven.rows[:, :-1])
        return max(0.0, *(float(_explained(M, each, excess).evidence.max()) for each in (some, *rest)))

    def forget(self, begins: Sequence[float]) -> None:
        """Forget what was found since the first of tests, by when they began, s: another cause explains them."""
        if self.said is not None and self.said.begin_s >= min(begins):
            self.said = None
        self.found = self.doubt = self._suspect = None
        self.changed_s, self._alarms = np.inf, 0

    def _mixture(self, sums: ResidualSums, hypotheses: Sequence[_Hypotheses]) -> tuple[float, Array]:
        """Return the log-evidence that anything changed before the tests, and the second moment of what did."""
        M, excess = self._whole(sums)
        every = self._with_smooth[1:, 1:]
        moment = np.zeros((every.shape[1], every.shape[1]))
        if M is None:
            return 0.0, every @ moment @ every.T
        explained = [_explained(M, each, excess) for each in hypotheses]
        shares = zip(hypotheses, explained, strict=True)
        logs = [np.log(each.chance / len(each.scales)) + found.evidence for each, found in shares]
        evidence = float(np.logaddexp.reduce(np.concatenate([*logs, [0.0]])))
        for (rows, _, _), log, each in zip(hypotheses, logs, explained, strict=True):
            moments = each.size[:, :, None] * each.size[:, None, :] + each.cov
            np.add.at(moment, (rows[:, :, None], rows[:, None, :]), np.exp(log - evidence)[:, None, None] * moments)
        return evidence, every @ moment @ every.T

    def _whole(self, sums: ResidualSums) -> tuple[Array | None, float]:
        """Return sums of everything that may have changed, and the Birge ratio they leave; None where too little."""
        gain = sums.gain()
        if gain < 2.0:
            return None, 1.0
        return self._with_smooth.T @ sums.M @ self._with_smooth, sums.excess(gain)  # what all do not explain is noise

    def _shown(self, onset: Onset) -> ShapeError | None:
        """Return what the tests show for certain of a change that began at some time; None where that is nothing."""
        sums = self._tests.reduced(onset)
        views = np.array([view for t_s, view in self._views if t_s >= onset.begin_s])
        if len(views) < _LEAST_POSES:
            return None
        mean = views.mean(axis=0)
        if np.min(views @ mean) >= np.cos(_VIEWS_RAD) * np.linalg.norm(mean):
            return None
        found, newest = _reduced(sums), _reduced(self._tests.kept[-1].reduced(self._size))
        error = self._focal_alone(found, onset)
        if error is not None and _one_is_enough(newest):
            return error
        return self._deformed(sums, onset) or self._displaced(found, newest.whole, onset)

    def _deformed(self, sums: ResidualSums, onset: Onset) -> ShapeError | None:
        """Return a deformation that is certain, beside the seven numbers and better than a point; else None."""
        M, excess = self._whole(sums)
        smooth = [each for each in self._hypotheses if each.chance == _PRINTED]
        if M is None or not smooth:
            return None
        besides = eliminated(M, _SEVEN)
        points = [each for each in self._hypotheses[1:] if each.chance != _PRINTED]
        most, other = (
            [float(_explained(besides, each._replace(rows=each.rows - 7), excess).evidence.max()) for each in some]
            for some in (smooth, points)
        )
        if max(most) < max(_CERTAIN, max(other) + ALIKE / 2.0):
            return None
        hypothesis = smooth[int(np.argmax(most))]
        found = _explained(M, hypothesis, excess)
        row = int(found.evidence.argmax())
        columns = self._with_smooth[8:, 1:][:, hypothesis.rows[row]] * self._wide[:, None]
        value, cov = columns @ found.size[row], columns @ found.cov[row] @ columns.T
        if not self._matters(value):
            return None
        return ShapeError((SMOOTH,), value, cov, 2.0 * max(most), 0.0, (), onset)

    def _displaced(self, found: _Reduced, newest: ResidualSums, onset: Onset) -> ShapeError | None:
        """Return the points that are displaced by what all tests together say, and the newest; None where none is."""
        whole = found.whole
        if not any(whole.gain(_columns([each])) > self._limit for each in self._candidates):
            return None
        steady = [each for each in self._candidates if self._steady(whole, newest, each)]
        chosen = list[int]()
        scores = dict[int, float]()
        most = max(1, len(self._names) // 2)
        while len(chosen) < most and (left := [each for each in steady if each not in chosen]):
            now = whole.gain(_columns(chosen)) if chosen else 0.0
            gains = {each: whole.gain(_columns([*chosen, each])) for each in left}
            best = max(gains, key=gains.__getitem__)
            excess = whole.excess(gains[best])
            if (gains[best] - now) / excess <= (_BESIDES if chosen else self._limit):
                break
            scores = scores or {each: gain / excess for each, gain in gains.items()}
            chosen.append(best)
        return self._error(found, tuple(chosen), scores, onset) if chosen else None

    def _focal_alone(self, found: _Reduced, onset: Onset) -> ShapeError | None:
        """Return the focal lengths' change where that one number explains as much as the seven do; else None."""
        columns, without = _columns([FOCAL]), found.without
        gain = without.gain(columns)
        excess = without.excess(gain)
        if gain / excess < self._limit_focal or not _one_is_enough(found):
            return None
        value, cov = self._values(without, columns, 0.0)
        if abs(value[0]) < _LEAST_FOCAL:
            return None
        cov[1, 1] = (value[0] / 2.0) ** 2 / excess  # one of the two may have changed alone
        return ShapeError((FOCAL,), value, excess * cov, gain / excess, 0.0, (), onset)

    def _error(
        self, found: _Reduced, chosen: tuple[int, ...], scores: dict[int, float], onset: Onset
    ) -> ShapeError | None:
        """Return the record of what was chosen; None where it is too small to matter."""
        (whole, without), columns = found, _columns(chosen)
        gain = whole.gain(columns)
        excess = whole.excess(gain)
        value, cov = self._values(whole, columns, 0.0)
        if len(chosen) > 1:
            value, cov = self._values(whole, columns, float(np.sqrt(np.mean(value[columns] ** 2))))
        if np.linalg.norm(value[_columns(chosen[:1])]) < _LEAST_M or not self._matters(value):
            return None
        seven = (without.square - without.gain(columns) - (whole.square - gain)) / excess
        best = chosen[0]
        alike = tuple(each for each, score in scores.items() if each != best and score > scores[best] - ALIKE)
        return ShapeError(chosen, value, excess * cov, scores[best], seven, alike, onset)

    def _values(self, whole: ResidualSums, columns: Ids, others_m: float) -> tuple[Array, Array]:
        """Return the displacements (C,) of columns, and of all other points if these have a prior, and cov (C, C)."""
        wide = self._wide.copy()
        free = columns if others_m == 0.0 else np.arange(2, len(wide))
        wide[np.setdiff1d(free, columns)] = others_m
        G = whole.H
        narrow = wide / self._wide
        G, r = G * np.outer(narrow, narrow) + np.eye(len(wide)), whole.b * narrow
        value, cov = np.zeros(len(wide)), np.zeros((len(wide), len(wide)))
        inverse = np.linalg.inv(G[np.ix_(free, free)])
        value[free] = wide[free] * (inverse @ r[free])
        cov[np.ix_(free, free)] = inverse * np.outer(wide[free], wide[free])
        return value, cov

    def _steady(self, whole: ResidualSums, newest: ResidualSums, which: int) -> bool:
        """Return whether the newest test, and the median of single shots, agree on a point with all tests together."""
        columns = _columns([which])
        (d, cov), (now, cov_now) = (self._values(each, columns, 0.0) for each in (whole, newest))
        d, off = d[columns], (now - d)[columns]
        apart = float(squares_of(off, (cov + cov_now)[np.ix_(columns, columns)]))
        unlike = newest.excess(newest.gain(columns)) * chi_square_limit(len(off), UNLIKE)
        if apart > unlike or len(self._shots) < _LEAST_SHOTS:
            return False
        first = 1 + self._first + 3 * which
        begins = np.cumsum([0, *map(len, self._shots)])[:-1]
        rows = np.concatenate(self._shots)
        along = rows[:, first : first + 3] @ d
        squares, right = (np.add.reduceat(along * other, begins) for other in (along, rows[:, 0]))
        shares = right[squares > 0.0] / squares[squares > 0.0]
        return len(shares) >= _LEAST_SHOTS and bool(_AGREE[0] < np.median(shares) < _AGREE[1])

    def _matters(self, value: Array) -> bool:
        """Return whether a displacement moves a new pose by so many of its sigmas, were it measured with that point."""
        return self._displaces(value) > MATTERS**2

    def _displaces(self, value: Array) -> float:
        """Return by how much a displacement moves one of the newest poses at most, in its sigmas, squared."""
        return largest_square(self._effects, self._by_candidate @ value)

    def added(self, response: Array) -> Array:
        """Return the covariance (6, 6) of what was found, of a pose with a response (6, K) to the parameters."""
        found = self.found
        if found is None:
            return np.zeros((6, 6))
        effect = response @ self._by_candidate
        shift = effect @ found.value
        return np.asarray(np.outer(shift, shift) + effect @ found.cov @ effect.T)

    def change(self, error: ShapeError) -> Array:
        """Return the change of the parameters (K,) that was found."""
        return np.asarray(self._by_candidate @ error.value)

    def finding(self, error: ShapeError, since_s: float | None, cost_m: float) -> HealthFinding:
        """Return the finding of what was found, which displaces poses by so much, m."""
        if error.chosen[0] == FOCAL:
            share, goes_on = float(error.value[0]), " so far, and it goes on" * error.onset.goes_on
            longer, shorter = ("left", "right") if share > 0 else ("right", "left")
            words = {"longer": longer, "shorter": shorter, "more": goes_on}
            evidence = abs(share), float(np.sqrt(error.cov[0, 0]))
            return make_finding("focal", evidence, since_s, cost_m=cost_m, words=words)
        if error.chosen[0] == SMOOTH:
            return self._smooth_finding(error, since_s, cost_m)
        points = [(each, _columns([each])) for each in error.chosen]
        largest = max((rows for _, rows in points), key=lambda rows: float(np.linalg.norm(error.value[rows])))
        moved = [f"{self._names[each]} by {1e3 * np.linalg.norm(error.value[rows]):.2f} mm" for each, rows in points]
        others = " or ".join(self._names[each] for each in error.alike)
        words = {"points": ", ".join(moved), "point": self._names[error.chosen[0]]}
        words["more"] = f"; it may be {others} instead" if others else ""
        name, evidence = (
            "point" + "s" * (len(points) > 1),
            sized(error.value[largest], error.cov[np.ix_(largest, largest)]),
        )
        return make_finding(name, evidence, since_s, cost_m=cost_m, words=words)

    def _smooth_finding(self, error: ShapeError, since_s: float | None, cost_m: float) -> HealthFinding:
        """Return the finding of a body that is strained or bent: how far a point is displaced at most, motions apart."""
        basis, value = self._smooth[:, :9], error.value[2:]
        rigid = np.linalg.lstsq(basis, value, rcond=1e-9)[0].reshape(3, 3)
        spin = (basis @ (0.5 * (rigid - rigid.T)).ravel()).reshape(-1, 3)
        shifts = value.reshape(-1, 3) - spin
        shifts -= shifts.mean(axis=0)
        k = int(np.linalg.norm(shifts, axis=1).argmax())
        rows = slice(2 + 3 * k, 5 + 3 * k)
        strain = 50.0 * float(np.ptp(np.linalg.eigvalsh(rigid + rigid.T)))
        evidence, words = sized(shifts[k], error.cov[rows, rows]), {"strain": strain, "point": self._names[k]}
        return make_finding("strained", evidence, since_s, cost_m=cost_m, words=words)


def _reduced(sums: ResidualSums) -> _Reduced:
    """Return what sums of the seven numbers and the candidates say of the latter."""
    return _Reduced(sums.reduced(7), sums.among(np.arange(7, len(sums.b))))


def _smooth(points: Array) -> Array:
    """Return (3 N, 27) smooth deformations of points (N, 3), m: strains (9: by coordinate, direction) and bends (18).

    Strains multiply the points, bends are products of two coordinates; each is a share of the radius at the furthest point.
    """
    from_middle = points - points.mean(axis=0)
    radius = float(np.linalg.norm(from_middle, axis=1).max())
    u = from_middle / radius
    i, k = np.triu_indices(3)
    bends = u[:, i] * u[:, k]
    by = np.hstack([u, bends - bends.mean(axis=0)])
    return np.asarray(radius * np.einsum("nk,ij->nikj", by, np.eye(3)).reshape(3 * len(points), -1))


def _hypotheses(points: int, smooth: int, *, strained: bool) -> tuple[_Hypotheses, ...]:
    """Return what may have changed: the seven numbers, focal lengths, a point, all a little, and smooth deformations."""
    every, first = 9 + np.arange(3 * points), 9 + smooth
    strains, bends = (
        _Hypotheses(np.tile(first + np.arange(count), (len(_STRAINS), 1)), np.array(_STRAINS), _PRINTED)
        for count in (9, 27)
    )
    seven = _Hypotheses(np.tile(np.arange(7), (len(_SEVEN_SCALES), 1)), np.array(_SEVEN_SCALES))
    alone = (seven, _Hypotheses(np.array([[7], [8]]), np.ones(2)), *((strains, bends) if strained else ()))
    if not points:
        return alone
    single = _Hypotheses(every.reshape(points, 3), np.ones(points))
    return (*alone, single, _Hypotheses(np.tile(every, (len(_BENT_M), 1)), np.array(_BENT_M) / FURTHEST_M))


def _explained(M: Array, hypotheses: _Hypotheses, excess: float) -> _Explained:
    """Return what hypotheses say of sums M (1 + K, 1 + K), of a noise whose variance is so many times larger."""
    rows, scales = 1 + hypotheses.rows, hypotheses.scales[:, None]
    variances = scales[..., None] ** 2
    G = M[rows[:, :, None], rows[:, None, :]] * (variances / excess) + np.eye(rows.shape[1])
    r, inverse = M[rows, 0] * (scales / excess), np.linalg.inv(G)
    d = np.einsum("nij,nj->ni", inverse, r)
    evidence = 0.5 * np.einsum("ni,ni->n", r, d) - 0.5 * np.linalg.slogdet(G)[1]
    return _Explained(evidence, scales * d, variances * inverse)


def _columns(chosen: Sequence[int]) -> Ids:
    return np.concatenate([[0] if each == FOCAL else np.arange(2 + 3 * each, 5 + 3 * each) for each in chosen])


def _one_is_enough(found: _Reduced) -> bool:
    """Return whether the change of one focal length explains about as much as the seven numbers do."""
    whole, without = found
    gain, seven = without.gain(_columns([FOCAL])), without.square - whole.square
    return gain >= seven - ALIKE * without.excess(max(gain, seven))
