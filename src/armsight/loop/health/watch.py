"""One watch over cameras and body: which cause of the table explains what the shots leave, since when, by how much.

In: measured poses with the detections they came from. Out: findings, and the covariance that what may have changed adds to
poses. Once a second the sums of the shots are tested: of each cause and each beginning the evidence
(:mod:`~armsight.estimate.change`), with what was seen before the beginning as the reference. Beyond the chi-square that
chance exceeds in 1e-4 of all minutes the cause of the largest evidence is said, with those that are needed besides it. In
the second before the first one after a change shots are of both times: it is left out.

Before they are certain, hypotheses that together are more probable than no change widen poses by the second moment of their
mixture. Shots that fit worst, a quarter of them, do not count, and no single shot does: what changed shows in all that
follow. A reflection stays in the scene or in the image while the body rotates: a point, or the shape of the body, counts
only in two tests, seen from directions that differ, and a point where the median of single shots agrees.

What passes is compared with it (:mod:`~armsight.loop.health.passing`, :mod:`~armsight.loop.health.unrest`), and what the
camera models cannot express: polynomials of the position in an image.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from armsight.data import Array, Body, Ids, PoseEstimate, Record
from armsight.estimate.change import Change, Sums, changed, evidence_of_width, explained
from armsight.geometry.pose import adjoint, inverse, log_se3
from armsight.loop.finding import COSTS_M, LEVER_M, HealthFinding, alarm_limit
from armsight.loop.health.causes import (
    FOCAL,
    Cause,
    Found,
    Kind,
    Table,
    breathing_finding,
    findings,
    focal_changes,
    lens_finding,
    nod_finding,
    of_one_pose,
)
from armsight.loop.health.passing import Apart, Leftover, Passing, apart, coefficients, eliminate, nodding
from armsight.loop.health.shots import LENS, ShotModel, ShotResiduals, differ, free_directions, summed
from armsight.loop.health.unrest import Unrest
from armsight.vision.rig import StereoRig

#: While nothing is suspected, shots closer in time than this are left out, s, and those that hardly differ from the newest:
#: they would cost time and add little.
_LEAST_S, _LIKE_S = 0.025, 0.1
#: The test is made after so long, s, or so many shots.
TEST_S, TEST_SHOTS = 1.0, 60
#: Of so many stays the one that fits worst does not count; half: a reflection in each third shot counts, double: none does.
_ODD = 4
#: Tests that are kept; older ones are forgotten with this time constant, in tests. Half: an older change is not dated any
#: more, double: the tests take twice the memory.
_KEPT, _SETTLED = 30, 30.0
#: So many newest tests, together, may be those after a change, or all; a change is dated anew in so many after an alarm.
_AFTER, _FRESH = (1, 2, 4, 8, 16), 6
#: A change matters that moves a pose by so many of its claimed sigmas, of so many newest poses.
_MATTERS, _POSES = 2.0, 60
#: Log-evidences that differ by less are not distinguished; a cause is needed besides another beyond this chance.
_ALIKE, _NECESSARY = 6.0, 1e-4
#: A smooth deformation is said from this log-evidence on; chance exceeds it in one of a thousand bodies at most (Markov),
#: as a body's shape is the same in all tests. Half: one of thirty, double: a shear of 0.3 % widens poses without a word.
_CERTAIN = float(np.log(1e3))
#: What passes is looked for where the log-evidence of a change in the newest test exceeds this; half: costs time, double:
#: cameras are blamed for late images for a second.
_DOUBTFUL = 2.0
#: Less than this of a point is not reported, m: paint and glue are not more exact.
_LEAST_M = 1e-4
#: Single shots agree with all together if the median of their share of the displacement is between these; so many of the
#: newest are asked, at the least so many. Directions must differ from their mean by so much, rad, and be so many.
_AGREE, _ASKED, _LEAST_SHOTS, _VIEWS_RAD, _LEAST_POSES = (0.5, 2.0), 30, 8, 0.05, 6
#: The newest test agrees with all together unless chance explains their difference more rarely than this.
_UNLIKE = 0.01
#: Shots whose detections are remembered, to know the same images again; half: a shorter loop of images counts as new.
_IMAGES = 4096
#: Standard deviations of the prior of what the camera models lack that are tried, px.
_LENS_SCALES_PX = np.array([2.0**k for k in range(-6, 2)])
#: It is tested in every so many tests, from so many poses that differ; its chi-square of an alarm; and it is named where it
#: explains so much more than a change of the cameras, as a share of what that explains.
_LENS_TESTS, _LENS_POSES, _LENS_SHARE = 4, 8, 0.5
_LENS_ALARM = alarm_limit(LENS, 1.0 / (TEST_S * _LENS_TESTS))
#: Rows of the directions that are cameras, body or time, and of them all that are no smooth deformation.
_SEVEN, _ALL = slice(0, 7), slice(0, -27)
_PARTS: dict[Kind, Ids] = {"rig": np.arange(5), "body": np.array([5]), "time": np.array([6])}


@dataclass(frozen=True, eq=False)
class LensError(Record):
    """What the camera models lack.

    Attributes:
        beta: (M,) coefficients of its polynomials, px.
        cov: (M, M) their covariance.
        size_px: RMS of the residuals that it explains, px, and its standard deviation.
        chi_square: by how much it explains more than a change of the cameras does.
        needed: which causes are needed besides.
    """

    beta: Array
    cov: Array
    size_px: tuple[float, float]
    chi_square: float
    needed: tuple[Kind, ...]


class _Test(NamedTuple):
    """A test: sums of the parameters without what images leave, and with it; of its worst shot; directions of view."""

    sums: Sums
    plain: Sums
    worst: Sums | None
    views: tuple[Array, ...]


class _Weighed(NamedTuple):
    """What the tests from one on say: sums of the directions, the Birge ratio, and of each cause what it explains."""

    begin: int
    sums: Sums
    excess: float
    changes: tuple[Change, ...]


class CameraWatch:
    """Watches the calibrated pose of the cameras, their lenses and times, and the size and shape of the body.

    Args:
        rig: the calibrated pair; without a covariance nothing can be tested.
        body: the body that is measured.
        sync_s: standard deviation of the time between the two exposures of a shot, s.
        printed: whether the body is a print whose shape a calibration found: it is not tested.

    Attributes:
        rig: the pair.
        found: what the newest test found for certain.
        lens: what the camera models lack, where that is certain and matters.
        noise: (6, 6) what of the covariance that the newest shot was given differs from shot to shot.
        passing: what changed from shot to shot, or from test to test.
        unrest: what moves to and fro: the right camera's rotation (3), rad, and a focal length.
    """

    def __init__(self, rig: StereoRig, body: Body, sync_s: float, *, printed: bool = False) -> None:
        self.rig, self._body, self.shots = rig, body, ShotModel(rig, body, sync_s)
        self._table, K = Table.of(self.shots, body, printed=printed), self.shots.size
        L, F = self.shots.prior, self._table.F
        values, vectors = np.linalg.eigh(L @ L.T + F[:, _ALL] @ F[:, _ALL].T)
        wide = vectors * np.sqrt(np.maximum(values, 0.0))
        self._leftover = Leftover(wide, np.hstack([L, F[:, FOCAL : FOCAL + 2]]), F[:, _SEVEN])
        last, (apart_f, both_f) = rig.parameter_count, focal_changes(self.shots).T
        self._to_and_fro = np.column_stack([np.eye(K)[:, last - 3 : last], apart_f])
        self._alone = np.column_stack([apart_f - 0.5 * both_f, apart_f + 0.5 * both_f])
        begins = len(_AFTER) + 1
        count = sum(len(each.hypotheses.rows) for each in self._table.causes if each.kind == "point") + 5
        # Half of the alarms are for what is wrong from the beginning.
        self._limits = [
            {freedom: alarm_limit(freedom, 1.0 / TEST_S, 2 * each) for freedom in (1, 3, 5)}
            for each in (count, count * begins)
        ]
        self.passing, self.unrest, self.noise = Passing(), Unrest(4), np.zeros((6, 6))
        self._images: dict[bytes, None] = {}  # detections of shots that were summed, the newest last
        self._count, self._timed, self._taken_s = 0, False, -np.inf
        self._began: Array | None = None
        self._stays: list[list[ShotResiduals]] = []  # shots of the running test
        self._views: list[Array] = []  # directions of view of the running test, and the newest
        self._view: Array | None = None
        self._asked: deque[Array] = deque(maxlen=_ASKED)  # rows of single shots
        # The response of the newest poses to everything, measured as they were and with all points, and their covariances.
        self._effects: deque[tuple[Array, Array, Array]] = deque(maxlen=_POSES)
        self._counted: list[Array] = []  # log-evidences of the newest tests, which the leftover is given later
        self.lens: LensError | None = None
        self.found: Found | None = None
        self._said: Found | None = None
        self._forget()

    def _forget(self) -> None:
        """Begin the sums anew."""
        K = self.shots.size
        self._tests: deque[_Test] = deque(maxlen=_KEPT)
        self._settled, self._settled_plain = Sums.empty(K), Sums.empty(K)
        self._whole, self._poses, self._alarms = Sums.empty(K + LENS), 0, 0
        self._changed_s: float | None = None  # since when something may have changed
        self._suspect: Found | None = None  # what the test before showed, or this one
        self._moment: Array | None = None  # second moment of what may have changed, (D, D)
        self.found = self._said = None

    def take(self, estimate: PoseEstimate, t_s: float | None) -> Array:
        """Take a measured pose.

        Args:
            estimate: the pose.
            t_s: time of its shot, s; None where it has none.

        Returns:
            (6, 6) what the suspected errors add to the pose's covariance; zero while nothing is suspected.
        """
        now_s, self._timed = (float(self._count), False) if t_s is None else (t_s, True)
        self._count += 1
        T, is_new = estimate.T_left_body, self._is_new(estimate)
        if self._redundant(T, now_s):
            self.shots.passed(T, now_s)
            return np.zeros((6, 6))
        self._taken_s = now_s
        found = self.shots.residuals(estimate, now_s, timed=self._timed)
        if found is None:
            return np.zeros((6, 6))
        self._effects.append((found.response, found.response_with_all, estimate.cov))
        if is_new:
            self._sum(found, T)
        self.noise = self._nodding(found.response, T)
        added = self._added(found) + self.noise
        if added.any():  # of a body that is far off more than what is linear
            off = log_se3(inverse(T) @ self.shots.linear_about(estimate)[1])
            added += np.outer(off, off)
        return added

    def _is_new(self, estimate: PoseEstimate) -> bool:
        """Return whether a shot's detections differ from those of the shots before: the same images say nothing new."""
        seen = estimate.points.seen.uv.tobytes()
        known = seen in self._images
        self._images[seen] = None
        if len(self._images) > _IMAGES:
            del self._images[next(iter(self._images))]
        return not known

    def _redundant(self, T: Array, now_s: float) -> bool:
        """Return whether a shot adds too little to what was taken just before it."""
        passed_s = now_s - self._taken_s
        if self.suspicious or not self._timed or not 0.0 <= passed_s < _LIKE_S:
            return False
        return passed_s < _LEAST_S or (self._began is not None and not differ(self._began, T))

    @property
    def suspicious(self) -> bool:
        """Whether anything is found or suspected now."""
        return (
            self._moment is not None
            or self.found is not None
            or self.lens is not None
            or self.passing.now
            or bool(self.unrest.cov.any())
        )

    def _added(self, found: ShotResiduals) -> Array:
        """Return what the suspected errors add to the covariance (6, 6) of a pose."""
        by, by_lens = found.response[:, : self.shots.size] @ self._table.F, found.response[:, self.shots.size :]
        added = np.zeros((6, 6))
        if self.passing.now:
            added += self.passing.added(found.exposed, by[:, FOCAL])
        if self.lens is not None:
            shift = by_lens @ self.lens.beta
            added += np.outer(shift, shift) + by_lens @ self.lens.cov @ by_lens.T
        if self._moment is not None and (self.lens is None or self.lens.needed):
            added += by @ self._moment @ by.T
        return added

    def _sum(self, shot: ShotResiduals, T: Array) -> None:
        """Add a shot to the stay it belongs to, which counts as one shot; test when it is time."""
        moved = self._began is None or differ(self._began, T)
        if moved or not self._stays:
            self._stays.append([])
            self._began = T
        if moved:  # else it rests, and says the same again
            self._asked.append(shot.rows)
            view = T[:3, :3].T @ T[:3, 3]
            view /= np.linalg.norm(view)
            if self._view is None or np.linalg.norm(view - self._view) > _VIEWS_RAD / _LEAST_POSES:
                self._views.append(view)
                self._view = view
        self._stays[-1].append(shot)
        if shot.t_s - self._stays[0][0].t_s >= (TEST_S if self._timed else TEST_SHOTS):
            self._decide()

    # -- what moves to and fro

    def _nodding(self, response: Array, T: Array) -> Array:
        """Return the covariance (6, 6) that a camera which nods or a lens that breathes adds to a pose (4, 4).

        Either camera may be the one; by a rotation of the left one, in whose frame poses are, the body moves as well.
        """
        cov, response = self.unrest.cov, response[:, : self.shots.size]
        if not cov.any():
            return np.zeros((6, 6))
        by_rotation, by_focal = response @ self._to_and_fro[:, :3], response @ self._alone
        by_right = np.column_stack([by_rotation, by_focal[:, 0]])
        by_rotation = by_rotation + adjoint(inverse(T))[:, 3:] @ self.rig.T_left_right[:3, :3]
        by_left = np.column_stack([by_rotation, by_focal[:, 1]])
        return np.asarray(0.5 * (by_right @ cov @ by_right.T + by_left @ cov @ by_left.T))

    def _moving(self, rows: Array) -> Array:
        """Return the derivatives (n, 4) of a shot's rows by what moves to and fro."""
        return np.asarray(rows[:, 1 : 1 + self.shots.size] @ self._to_and_fro)

    def _take_unrest(self, shots: Sequence[ShotResiduals]) -> None:
        """Compare what the shots of a test say of the right camera's rotation and a focal length."""
        J, r = [self._moving(each.rows) for each in shots], [each.rows[:, 0] for each in shots]
        H, b = np.array([each.T @ each for each in J]), np.array([j.T @ e for j, e in zip(J, r, strict=True)])
        cov = np.linalg.inv(H)
        d = np.einsum("nij,nj->ni", cov, b)
        freedom = sum(map(len, r)) - 10.0 * len(shots)
        excess = (sum(float(e @ e) for e in r) - float(np.vdot(b, d))) / max(freedom, 1.0)
        rested = not self.unrest.cov.any()
        self.unrest.take(np.array([each.t_s for each in shots]), d, cov, max(excess, 1.0))
        if rested and self.unrest.cov.any():  # sums so far do not have it in their noise
            self._forget()

    def _unrest_weighed(self, rows: Array, other: Array | None = None) -> Array:
        """Return rows of a shot, or others (n, K) of it, with what moves to and fro in their noise.

        That is (I + J V J^T)^-1/2 times them.
        """
        given = rows if other is None else other
        if not self.unrest.cov.any():
            return given
        values, vectors = np.linalg.eigh(self.unrest.cov)
        J = self._moving(rows) @ (vectors * np.sqrt(np.maximum(values, 0.0)))
        squares, axes = np.linalg.eigh(J.T @ J)
        squares = np.maximum(squares, 1e-12)
        J = J @ axes
        return np.asarray(given - J @ (((1.0 - 1.0 / np.sqrt(1.0 + squares)) / squares)[:, None] * (J.T @ given)))

    # -- the sums of a test

    def _summed(self, stays: Sequence[Sequence[ShotResiduals]], own: Apart | None = None) -> Sums:
        """Return the sums of stays, of each the mean of its shots, without times of exposure that are given."""
        sums = Sums.empty(self.shots.size + LENS, stays[0][0].t_s if stays else 0.0)
        single = [self._unrest_weighed(stay[0].rows) for stay in stays if len(stay) == 1]
        if single:  # those of one shot are summed at once
            sums.take(np.concatenate(single), float(sum(len(rows) - 6 for rows in single)))
        for stay in stays:
            if len(stay) > 1:
                summed(sums, ((self._unrest_weighed(each.rows), len(each.rows)) for each in stay), len(stay))
        if own is not None:
            eliminate(own, self._exposures(stays), sums)
        return sums

    def _exposures(self, stays: Sequence[Sequence[ShotResiduals]]) -> list[tuple[Array, Array, float]]:
        """Return of each shot its rows, what the times of its exposures do to them (n, 10), and its weight."""
        return [
            (self._unrest_weighed(each.rows), self._unrest_weighed(each.rows, self.shots.moved(each)), 1.0 / len(stay))
            for stay in stays
            for each in stay
        ]

    def _directions(self, sums: Sums, before: Sums | None = None) -> Sums:
        """Return what sums of the parameters say of the directions, with those from before as a reference."""
        return changed(sums, before or Sums.empty(self.shots.size), self.shots.prior, self._table.F)

    def _evidence(self, sums: Sums, excess: float) -> tuple[float, float]:
        """Return the log-evidence of the best cause in sums of the directions but times, and that of one focal length."""
        causes = [each for each in self._table.causes if each.kind not in ("time", "seven")]
        every = {each.kind: float(explained(sums, each.hypotheses, excess).evidence.max()) for each in causes}
        return max(every.values()), every["focal"]

    def _decide(self, *, ends: bool = False) -> None:
        """Make a test of the shots since the last one, and decide."""
        stays, self._stays = self._stays, []
        if not stays:
            return
        self._poses += len(stays)
        ordered = sorted(stays, key=lambda stay: sum(each.misfit for each in stay) / len(stay))
        # Once something is found all count: those that show it most would be missing of its size.
        used = ordered if self._suspect is not None else ordered[: len(stays) - len(stays) // _ODD]
        raw, own = self._without_passing(used)
        noise, evidence = self._leftover.seen(raw, len(stays) / sum(map(len, stays)))
        sums = self._leftover.without(raw, noise)
        worst = None
        if len(used) == len(stays) and len(used[-1]) == 1 and not self.passing.now and self._suspect is None:
            worst = self._leftover.without(self._summed(used[-1:]), noise)
        self._leftover.passed(sums)
        # A point that is displaced looks like it, for some tests before it is found.
        self._counted = [] if self.found is not None and self.found.lasting else [*self._counted, evidence]
        if len(self._counted) > 3:
            self._leftover.take(self._counted.pop(0))
        self._whole = self._whole + raw.over(noise)
        self._whole.begin_s = 0.0
        self._keep(_Test(sums, raw.of(self.shots.size).over(noise), worst, tuple(self._views)))
        self._views = []
        self._find(ends=ends)
        if self._timed and own is None:
            self._take_unrest([each for stay in stays for each in stay])
        due = 0 < self._alarms <= _FRESH or len(self._tests) % _LENS_TESTS == 0
        if due and self._tests and self._poses >= _LENS_POSES:
            self.lens = self._lens()

    def _without_passing(self, stays: Sequence[Sequence[ShotResiduals]]) -> tuple[Sums, Apart | None]:
        """Return the sums of stays without what passes, and times of exposure that explain them."""
        raw, K = self._summed(stays), self.shots.size
        test = self._directions(raw.of(K))
        doubt = max(float(explained(test, each.hypotheses, 1.0).evidence.max()) for each in self._table.causes)
        if not self.passing.now and doubt < _DOUBTFUL:
            return raw, None
        found, rest = None, None
        if self._timed:
            parts = self._exposures(stays)
            found = apart([(rows[:, 0], moved, weight) for rows, moved, weight in parts])
            nods = nodding([(rows[:, 0], self._moving(rows), weight) for rows, _, weight in parts])
            if found is not None and nods > found.gained - found.occam:
                found = None
        if found is not None:
            without = self._summed(stays, found)
            rest = self._directions(without.of(K))

        def field(excess: float) -> float:
            M = coefficients(raw.over(excess), self.shots.prior)
            return float(evidence_of_width(M[1:, 1:], M[1:, 0], _LENS_SCALES_PX).max())

        focal = FOCAL, float(self._table.wide[FOCAL])
        passes = self.passing.decide(test, self._evidence, focal, found, rest, field)
        if passes == "time":
            return without, found
        if passes == "lens":
            return raw.without(np.append(self._table.F[:, FOCAL], np.zeros(LENS))), None
        return raw, None

    def _keep(self, test: _Test) -> None:
        """Keep a test; the oldest one becomes a reference, unless something may have changed before it."""
        if len(self._tests) == _KEPT:
            second, oldest = self._tests[1].sums.begin_s, self._tests[0]
            if self._changed_s is None or second < self._changed_s:
                kept = float(np.exp(-1.0 / _SETTLED))
                self._settled = self._settled * kept + oldest.sums
                self._settled_plain = self._settled_plain * kept + oldest.plain
        self._tests.append(test)

    # -- what changed

    def _since(self, begin: int, *, plain: bool = False) -> tuple[Sums, Sums]:
        """Return the sums of the tests from one on, and of those before: the one between may be of both times."""
        tests = [each.plain if plain else each.sums for each in self._tests]
        after, before = tests[begin], self._settled_plain if plain else self._settled
        for each in tests[begin + 1 :]:
            after = after + each
        for each in tests[: max(begin - 1, 0)]:
            before = before + each
        return after, before

    def _weighed(self, begin: int) -> _Weighed:
        """Return what the tests from one on say of each cause."""
        after, before = self._since(begin)
        worst = [each.worst for each in list(self._tests)[begin:] if each.worst is not None]
        if worst and self._poses > 1:  # no change rests on one shot
            after = after - max(worst, key=lambda each: each.square)
        sums = self._directions(after, before)
        H, b = sums.H[_ALL, _ALL], sums.b[_ALL]
        gained = float(b @ np.linalg.solve(H + np.eye(len(b)), b))
        excess = max((sums.square - gained) / max(sums.freedom, 1.0), 1.0)
        return _Weighed(
            begin, sums, excess, tuple(explained(sums, each.hypotheses, excess) for each in self._table.causes)
        )

    def _find(self, *, ends: bool) -> None:
        """Decide what the tests show."""
        n, before = len(self._tests), self._suspect
        counts = [count for count in _AFTER if count < n] + [n]
        weighed = [self._weighed(n - count) for count in counts]
        if before is not None:
            later = max(sum(each.sums.begin_s >= before.begin_s for each in self._tests), 1)
            weighed = [self._weighed(n - later)]
        shown = next(filter(None, map(self._shown, sorted(weighed, key=_most, reverse=True))), None)
        self._alarms = 0 if shown is None else self._alarms + 1
        if shown is not None and self._alarms <= _FRESH:
            shown = self._dated(shown) or shown
        elif shown is not None and before is not None:
            shown = shown._replace(begin_s=before.begin_s)  # though the tests of that time are no longer kept
        again = before is not None and shown is not None and before.kinds[0] == shown.kinds[0]
        self._suspect = shown
        self.found = shown if shown is not None and (not shown.lasting or again or (ends and n == 1)) else None
        self._said = self.found or self._said
        mixtures = [self._mixture(each) for each in weighed]
        best = max(range(len(mixtures)), key=lambda k: mixtures[k][0])
        evidence, moment = mixtures[best]
        self._moment = moment if evidence > np.log(2.0) else None
        if self.found is not None:
            self._changed_s = self.found.begin_s
        elif self._moment is None:
            self._changed_s = None
        elif self._changed_s is None:
            self._changed_s = weighed[best].sums.begin_s

    def _mixture(self, weighed: _Weighed) -> tuple[float, Array]:
        """Return the log-evidence that anything changed, and the second moment (D, D) of what did.

        Nothing is one of the hypotheses, and its evidence is 1.
        """
        causes = self._table.causes
        logs = [
            np.log(cause.chance(begins=weighed.begin > 0) / len(each.evidence)) + each.evidence
            for cause, each in zip(causes, weighed.changes, strict=True)
        ]
        evidence = float(np.logaddexp.reduce(np.concatenate([*logs, [0.0]])))
        moment = np.zeros_like(weighed.sums.H)
        for cause, log, each in zip(causes, logs, weighed.changes, strict=True):
            rows, moments = cause.hypotheses.rows, each.size[:, :, None] * each.size[:, None, :] + each.cov
            np.add.at(moment, (rows[:, :, None], rows[:, None, :]), np.exp(log - evidence)[:, None, None] * moments)
        return evidence, moment

    def _said_best(self, changes: Sequence[Change]) -> Iterator[tuple[float, float, Cause, int]]:
        """Yield of causes that may be said their log-evidence, chi-square, row of the table and best hypothesis."""
        for cause, change in zip(self._table.causes, changes, strict=True):
            if cause.said:
                rows = range(len(change.evidence)) if cause.kind == "point" else [int(change.evidence.argmax())]
                for k in rows:
                    yield float(change.evidence[k]), float(change.chi_square[k]), cause, k

    def _shown(self, weighed: _Weighed) -> Found | None:
        """Return what the tests from one on show for certain; None where that is nothing."""
        tests = list(self._tests)[weighed.begin :]
        # A smooth deformation, which has many numbers, is ahead where it is distinguished from all others.
        ranked = sorted(
            self._said_best(weighed.changes), key=lambda each: (_ALIKE if each[2].kind == "smooth" else 0.0) - each[0]
        )
        most, chi_square, cause, k = ranked[0]
        rows = cause.hypotheses.rows[k]
        if cause.kind == "smooth":
            if most < _CERTAIN:
                return None
        elif chi_square < self._limits[weighed.begin > 0][len(rows)]:
            return None
        views = [view for each in tests for view in each.views]
        if cause.lasting and (len(views) < _LEAST_POSES or not _differ(np.array(views))):
            return None
        if cause.kind == "point" and not self._steady(weighed, rows):
            return None
        kinds, columns = [(cause.kind, k if cause.kind == "point" else 0)], rows
        # The velocity by which times show is off by a share, which looks like other causes.
        while cause.kind not in ("smooth", "time") and (more := self._besides(weighed, kinds, columns)) is not None:
            kinds.append(more[0])
            columns = np.append(columns, more[1])
        value, cov = self._values(weighed, columns, cause, k)
        if not self._costs(value, certain=cause.lasting or weighed.begin == 0):
            return None
        if cause.kind == "point" and np.linalg.norm(value[rows]) < _LEAST_M:
            return None
        alike = [(each.kind, n if each.kind == "point" else 0) for log, _, each, n in ranked[1:] if log > most - _ALIKE]
        return Found(tuple(kinds), value, cov, weighed.sums.begin_s, tuple(alike), 2.0 * most, cause.lasting)

    def _values(self, weighed: _Weighed, columns: Ids, cause: Cause, k: int) -> tuple[Array, Array]:
        """Return the sizes (D,) of directions that changed together, and their covariance (D, D)."""
        wide, widths = self._table.wide, np.ones(len(columns))
        if cause.kind == "smooth":
            widths *= cause.hypotheses.widths[k]
        sums = weighed.sums
        if cause.kind == "point":  # whatever else changed
            for row in range(_SEVEN.stop):
                sums = sums.without(np.eye(len(wide))[row])
        H, b = sums.H[np.ix_(columns, columns)], sums.b[columns]
        inner = np.linalg.inv(H / weighed.excess + np.diag(widths**-2.0))
        value, cov = np.zeros(len(wide)), np.zeros((len(wide), len(wide)))
        value[columns] = wide[columns] * (inner @ b) / weighed.excess
        cov[np.ix_(columns, columns)] = inner * np.outer(wide[columns], wide[columns])
        return value, cov

    def _besides(
        self, weighed: _Weighed, kinds: Sequence[tuple[Kind, int]], columns: Ids
    ) -> tuple[tuple[Kind, int], Ids] | None:
        """Return the cause that explains most besides others, and its directions; None where none is needed."""
        M, rows = weighed.sums.M, 1 + columns
        inner = M[np.ix_(rows, rows)] + np.eye(len(rows))
        rest = Sums(M - M[:, rows] @ np.linalg.solve(inner, M[rows]), weighed.sums.freedom)
        changes = [explained(rest, each.hypotheses, weighed.excess) for each in self._table.causes]
        for _, chi_square, cause, k in sorted(self._said_best(changes), key=lambda each: -each[0]):
            one, more = (cause.kind, k if cause.kind == "point" else 0), cause.hypotheses.rows[k]
            if cause.kind in ("smooth", "focals") or one in kinds or chi_square < chdtri(len(more), _NECESSARY):
                continue
            if cause.kind == "point" and (kinds[0][0] != "point" or len(kinds) >= len(self._table.names) // 2):
                continue
            value = np.zeros(len(self._table.wide))
            value[more] = self._table.wide[more] * np.linalg.solve(
                rest.H[np.ix_(more, more)] + np.eye(len(more)), rest.b[more]
            )
            if self._steady(weighed, more) if cause.kind == "point" else self._costs(value, certain=True):
                return one, more
        return None

    def _costs(self, value: Array, *, certain: bool) -> bool:
        """Return whether a change of the directions displaces one of the newest poses by what matters.

        Were it measured with all points, and where the calibration alone is the reference (``certain``), by more than its
        claimed sigmas.
        """
        effect = self._table.F @ (value / self._table.wide)
        if self._cost_m(effect) < COSTS_M and self._cost_m(effect, with_all=True) < COSTS_M:
            return False
        if not certain:
            return True
        responses, covs = np.array([each[1] for each in self._effects]), np.array([each[2] for each in self._effects])
        shift = responses[:, :, : self.shots.size] @ effect
        squares = np.einsum("ni,ni->n", shift, np.linalg.solve(covs, shift[..., None])[..., 0])
        return float(np.max(squares)) > _MATTERS**2

    def _cost_m(self, by: Array, *, with_all: bool = False) -> float:
        """Return by how much a change of the first parameters displaces one of the newest poses at most, m."""
        shifts = np.array([each[with_all] for each in self._effects])[:, :, : len(by)] @ by
        return float(np.max(np.linalg.norm(shifts[:, :3], axis=1) + LEVER_M * np.linalg.norm(shifts[:, 3:], axis=1)))

    def _steady(self, weighed: _Weighed, columns: Ids) -> bool:
        """Return whether the newest test, and the median of single shots, agree on a point with all tests together."""
        newest = self._directions(self._tests[-1].sums)

        def one(sums: Sums) -> tuple[Array, Array]:
            cov: Array = np.linalg.inv(sums.H[np.ix_(columns, columns)] + np.eye(len(columns)))
            return cov @ sums.b[columns], cov

        (d, cov), (now, cov_now) = one(weighed.sums), one(newest)
        gained = float(newest.b[columns] @ now)
        excess = max((newest.square - gained) / max(newest.freedom, 1.0), 1.0)
        if float((now - d) @ np.linalg.solve(cov + cov_now, now - d)) > excess * chdtri(len(d), _UNLIKE):
            return False
        if len(self._asked) < _LEAST_SHOTS:
            return False
        begins = np.cumsum([0, *map(len, self._asked)])[:-1]
        rows = np.concatenate(self._asked)
        along = rows[:, 1 : 1 + self.shots.size] @ (self._table.F[:, columns] @ d)
        squares, right = (np.add.reduceat(along * other, begins) for other in (along, rows[:, 0]))
        shares = right[squares > 0.0] / squares[squares > 0.0]
        return len(shares) >= _LEAST_SHOTS and bool(_AGREE[0] < np.median(shares) < _AGREE[1])

    def _dated(self, shown: Found) -> Found | None:
        """Return what is shown from the beginning on that leaves least unexplained."""
        columns = np.flatnonzero(shown.value) if shown.lasting else np.arange(_SEVEN.stop)
        lefts = list[float]()
        for k in range(len(self._tests)):
            sums = self._directions(*self._since(k))
            H, b = sums.H[np.ix_(columns, columns)], sums.b[columns]
            mixed = self._tests[k - 1].sums.freedom if k else 0.0
            lefts.append(sums.square - float(b @ np.linalg.solve(H + np.eye(len(b)), b)) + mixed)
        return self._shown(self._weighed(int(np.argmin(lefts))))

    # -- what the camera models lack

    def _lens(self) -> LensError | None:
        """Return what the camera models lack; None where a change of the cameras explains as much, or it hardly matters."""
        K = self.shots.size
        L, F = np.vstack([self.shots.prior, np.zeros((LENS, K))]), np.zeros((K + LENS, 7 + LENS))
        F[:K, :7], F[K:, 7:] = self._table.F[:, _SEVEN], np.eye(LENS)
        sums, every = changed(self._whole, Sums.empty(K + LENS), L, F), np.arange(7 + LENS)

        def gained(rows: Ids) -> float:
            return float(sums.b[rows] @ np.linalg.solve(sums.H[np.ix_(rows, rows)] + np.eye(len(rows)), sums.b[rows]))

        most, by_lens, by_change = gained(every), gained(every[7:]), gained(every[:7])
        excess = max((sums.square - most) / max(sums.freedom, 1.0), 1.0)
        if by_lens - by_change < _LENS_ALARM * excess:
            return None
        # Than a change at any time; a lens that lacks a little is not to blame where the cameras moved.
        more = (self._least_left() - (sums.square - by_lens)) / excess
        if more < max(_LENS_ALARM, _LENS_SHARE * by_change / excess):
            return None
        needed = tuple(
            part
            for part, rows in _PARTS.items()
            if (most - gained(np.delete(every, rows))) / excess > chdtri(len(rows), _NECESSARY)
        )
        chi_square = by_lens / excess
        size = self.shots.noise_px * float(np.sqrt(2.0 * excess * chi_square / max(sums.freedom, 1.0)))
        sigma = size * float(np.sqrt(LENS / 2.0 + chi_square)) / chi_square
        H, b = sums.H[7:, 7:] / excess, sums.b[7:] / excess
        width = _LENS_SCALES_PX[evidence_of_width(H, b, _LENS_SCALES_PX).argmax()]
        cov = np.linalg.inv(H + np.eye(LENS) / width**2)
        found = LensError(cov @ b, cov, (size, sigma), more, needed)
        responses, covs = np.array([each[0] for each in self._effects]), np.array([each[2] for each in self._effects])
        shifts = responses[:, :, K:] @ found.beta
        squares = np.einsum("ni,ni->n", shifts, np.linalg.solve(covs, shifts[..., None])[..., 0])
        return found if self.alarm or float(np.max(squares)) > _MATTERS**2 else None

    def _least_left(self) -> float:
        """Return the sum of squares that a change of the cameras, at its best beginning, leaves."""
        lefts = list[float]()
        for k in range(len(self._tests)):
            sums = self._directions(*self._since(k, plain=True)).of(7)
            mixed = self._tests[k - 1].sums.freedom if k else 0.0
            lefts.append(sums.square - float(sums.b @ np.linalg.solve(sums.H + np.eye(7), sums.b)) + mixed)
        return min(lefts)

    # -- what is said

    @property
    def alarm(self) -> bool:
        """Whether the newest test found that cameras, the size of the body or times changed."""
        return self.found is not None and not self.found.lasting

    @property
    def wrong_at_rest(self) -> bool:
        """Whether what is found makes poses wrong also where nothing moves."""
        if self.found is None:
            return False
        points = [row for kind, row in self.found.kinds if kind == "point"]
        used = bool((self.shots.used_s[points] > self._taken_s - TEST_S).any())  # else poses are of the other points
        return used or any(kind not in ("point", "time") for kind, _ in self.found.kinds)

    def copied(self) -> CameraWatch:
        """Return a copy that says what was found so far; this one goes on."""
        other = copy(self)
        other._tests, other._asked, other._effects = self._tests.copy(), self._asked.copy(), self._effects.copy()
        other._stays, other._counted = [stay.copy() for stay in self._stays], self._counted.copy()
        other.passing, other.unrest, other._leftover = copy(self.passing), self.unrest.copied(), copy(self._leftover)
        return other

    def moved_since_s(self) -> float | None:
        """Return since when the cameras alone are found to have moved, s.

        None where nothing or more was found, or only the newest test shows it.
        """
        if self.found is None or not self._timed or self.lens is not None or self.found.kinds != (("rig", 0),):
            return None
        return None if self.only_newest() else self.found.begin_s

    def only_newest(self) -> bool:
        """Return whether only the newest test shows a change: cameras may have moved within it, so the next one decides."""
        tests = self._tests
        return self.found is not None and len(tests) > 1 and self.found.begin_s >= tests[-1].sums.begin_s

    def findings(self) -> tuple[HealthFinding, ...]:
        """Return what was found so far, the shots of the running test included: nothing where no test gave an alarm."""
        ended = self.copied()
        ended._decide(ends=True)
        return self.passing.among(ended._stays_changed(), timed=self._timed)

    def _stays_changed(self) -> tuple[HealthFinding, ...]:
        """Return what changed and stays."""
        said, lens = self._said, self.lens
        if said is not None and (lens is None or (said.lasting and said.evidence > lens.chi_square)):
            said_of = self._of(said, said.begin_s if self._timed else None)
            several = self._poses > 1 or (self._timed and self._count > 1)
            return (*(said_of if several else map(of_one_pose, said_of)), *self._nods())
        if lens is not None:
            shifts = np.array([each[0] for each in self._effects])[:, :, self.shots.size :] @ lens.beta
            cost_m = float(
                (np.linalg.norm(shifts[:, :3], axis=1) + LEVER_M * np.linalg.norm(shifts[:, 3:], axis=1)).max()
            )
            return (lens_finding(lens.size_px, lens.needed, cost_m),) if cost_m > COSTS_M else ()
        return self._nods()

    def _of(self, found: Found, since_s: float | None) -> list[HealthFinding]:
        """Return the findings of causes."""

        def cost_mm(rows: Sequence[int]) -> float:
            return 1e3 * self._cost_m(self._table.F[:, rows] @ (found.value / self._table.wide)[rows])

        return findings(found, self._table, since_s, cost_mm)

    def _nods(self) -> tuple[HealthFinding, ...]:
        """Return the finding of a camera that nods or a lens that breathes, where that displaces poses by what matters."""
        cov = self.unrest.cov
        if not cov.any() or not self._effects:
            return ()
        covs = self.noise
        cost_m = float(np.sqrt(np.trace(covs[:3, :3]))) + LEVER_M * float(np.sqrt(np.trace(covs[3:, 3:])))
        if cost_m < COSTS_M:
            return ()
        # The one that displaces points in the images by more.
        seen = np.diag(cov) * np.array([1.0, 1.0, 0.0, np.square(self.shots.half_views).sum(axis=1).mean()])
        return (breathing_finding(cov, cost_m) if seen[3] > seen[:3].sum() else nod_finding(cov[:3, :3], cost_m),)

    def explained(self, estimates: Sequence[PoseEstimate]) -> tuple[StereoRig, Body, HealthFinding]:
        """Return the rig and the body with the change that poses show, which are known to be wrong, and what it is."""
        sums, self._poses = self.shots.information(estimates)
        one = self._directions(sums)
        said = self._said_best([explained(one, each.hypotheses, 1.0) for each in self._table.causes])
        (most, _, cause, k), (other, _, second, _) = sorted(
            (each for each in said if each[2].kind in ("rig", "body")), key=lambda each: -each[0]
        )
        weighed = _Weighed(0, one, max(one.square / max(one.freedom, 1.0), 1.0), ())
        value, cov = self._values(weighed, cause.hypotheses.rows[k], cause, k)
        alike = ((second.kind, 0),) if other > most - _ALIKE else ()
        change = Found(((cause.kind, 0),), value, cov, 0.0, alike, most, False)
        found = replace(findings(change, self._table, None, lambda rows: 0.0)[0], cost_mm=None)
        rig = self.rig.perturbed(free_directions(self.rig) @ value[:5])
        body = replace(self._body, points=(1.0 + value[5]) * self._body.points)
        return rig, body, found if self._poses > 1 else of_one_pose(found)


def _most(weighed: _Weighed) -> float:
    """Return the largest log-evidence of any cause."""
    return max(float(each.evidence.max()) for each in weighed.changes)


def _differ(views: Array) -> bool:
    """Return whether directions (N, 3) differ enough from their mean."""
    mean = views.mean(axis=0)
    return bool(np.min(views @ mean) < np.cos(_VIEWS_RAD) * np.linalg.norm(mean))
