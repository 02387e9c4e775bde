"""Cameras that moved, expose late or have another lens than their model, a body of another size: found in residuals.

In: measured poses with the detections they came from. Out: an estimate of seven numbers that a calibration fixes: the five
degrees of freedom of the right camera's pose in the left one that do not change the scale (rotation, and translation across
the baseline), the scale of body over baseline, and the skew: by how much the right camera exposes later than is known.
Model of a shot's residuals, in standard deviations:

    r = A dT + B x + S e + D f + n,    x ~ N(0, rig.cov),  e ~ N(0, tolerance),  n ~ N(0, s^2)

with dT the pose, which is eliminated shot by shot; x the calibration's own error and e the shape of the body, which all
shots share; f the seven numbers, zero while all is well. The information of the shots is summed, test by test; f is
estimated since some of them, as a step or a ramp, with x and e eliminated (generalised least squares), of which the tests
before say what they are, too; chi-square of f against zero is the test. The part of r
that needs no body is the epipolar distance; the rest says what the body's known shape does. Size of body and length of
baseline have the same effect: which of them is wrong cannot be distinguished. The skew shows in the detections of the right
camera by the body's motion between the shots; each shot has a skew of its own besides, of a known standard deviation.

What the camera model lacks (a lens whose distortion it cannot express, a sensor that is tilted) displaces whatever appears
at the same position in an image by the same: r = ... + L beta, with L polynomials of the position, of which each camera has
its own. It is reported where beta explains more than any change of the seven numbers at any time does.

A camera that nods or a lens that breathes averages out in the sums: what single shots say of its rotation and of a focal
length is compared within each second, and what it varies beyond the noise is a covariance of its own (``fixed``); what one
second does not show whole is one where it explains the tests better than anything else (``passing``). Images
that were seen before, to the bit, say nothing new. What images leave in all that is near each other, for a second, is in
the noise of each test, as large as the rig itself shows it (:class:`~armsight.loop.health.passing.Leftover`).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from statistics import median
from typing import Literal, NamedTuple

import numpy as np

from armsight.data import Array, Body, Ids, PoseEstimate, Record
from armsight.estimate.chance import chi_square_limit
from armsight.geometry.pose import adjoint, inverse, log_se3
from armsight.loop.finding import (
    CAUSES,
    COSTS_M,
    SUSPECTED,
    HealthFinding,
    alarm_limit,
    displacement_m,
    make_finding,
    sized,
)
from armsight.loop.health.fixed import Unrest
from armsight.loop.health.passing import TOGETHER, Apart, Leftover, Passes, Passing, Times, apart, eliminate, nodding
from armsight.loop.health.residuals import (
    FRESH,
    MATTERS,
    NECESSARY,
    POSES,
    STEPS,
    History,
    Onset,
    ResidualSums,
    ShotReader,
    ShotResiduals,
    differ,
    evidence_of_scales,
    largest_square,
    noisier,
)
from armsight.loop.health.rows import LENS
from armsight.loop.health.shape import SMOOTH, ShapeWatch
from armsight.vision.rig import StereoRig

Part = Literal["rig", "body", "time"]

#: Tolerance of a body that was built and measured with care: of each point, m, and of its scale.
SHAPE_M, SCALE = 5e-5, 3e-4
#: Shots closer in time than this are left out, s, and those that hardly differ from the newest: they would add little.
_LEAST_S, _LIKE_S = 0.025, 0.1
#: One of so many shots, those that fit worst, is no usual one.
_ODD = 4
#: The test is made after so long, s, or so many shots.
TEST_S, TEST_SHOTS = 1.0, 60
#: A test counts for what images leave after so many more.
_BEFORE = 3
#: A prior so wide that it decides nothing: m, rad, scale, s.
_WIDE = np.array([0.1, 0.1, 1.0, 1.0, 1.0, 1.0, 0.1])
_ROTATIONS, _SCALED, _SKEWED = slice(2, 5), 5, 6
#: Shots whose detections are remembered, to know the same images again; half: a shorter loop of images counts as new.
_IMAGES = 4096
#: What may be wrong, and its part of the seven numbers.
_PARTS: dict[Part, slice] = {"rig": slice(0, 5), "body": slice(5, 6), "time": slice(6, 7)}
#: By how much a part must explain more than the others alone.
_NEEDED = {part: chi_square_limit(rows.stop - rows.start, NECESSARY) for part, rows in _PARTS.items()}
#: Chi-square of an alarm: of all seven numbers, and of each part alone, which share the probability of a false one.
_ALARM, _ALARMS = (
    alarm_limit(len(_WIDE), 1.0 / TEST_S, 4),
    {part: alarm_limit(rows.stop - rows.start, 1.0 / TEST_S, 4) for part, rows in _PARTS.items()},
)
#: Chi-square from which on a change that matters widens the poses.
_SUSPECTED = chi_square_limit(len(_WIDE), SUSPECTED)
#: Standard deviations of its prior that are tried: the one of the largest evidence is taken (MacKay, 1992).
_LENS_SCALES_PX = np.array([2.0**k for k in range(-6, 2)])
#: It is tested in every so many tests, from so many poses that differ; its chi-square of an alarm.
_LENS_TESTS, _LENS_POSES = 4, 8
#: It is named where it explains so much more than a change of the seven numbers, as a share of what that explains.
_LENS_SHARE = 0.5
_LENS_ALARM = alarm_limit(LENS, 1.0 / (TEST_S * _LENS_TESTS))


@dataclass(frozen=True, eq=False)
class RigChange(Record):
    """An estimate of the seven numbers."""

    #: (7,) translation of the right camera across the baseline (2), m, its rotation about its own axes (3), rad, both
    #: as tangents of T_left_right on the right; size of the body over that of its file, less 1; by how much the right
    #: camera exposes later than is known, s
    f: Array
    cov: Array  #: (7, 7) its covariance
    chi_square: float  #: of all against zero
    alone: dict[Part, float]  #: the same of each part alone, with the others right
    without: dict[Part, float]  #: the same of the others
    excess: float  #: by how much the variance of what is left exceeds the noise (Birge ratio)
    slow: bool = False  #: whether the newest tests show that it grows


@dataclass(frozen=True, eq=False)
class LensError(Record):
    """What the camera models lack."""

    beta: Array  #: (M,) coefficients of its polynomials, px
    cov: Array  #: (M, M) their covariance
    size_px: tuple[float, float]  #: RMS of the residuals that it explains, px, and its standard deviation
    chi_square: float  #: by how much it explains more than a change of the seven numbers does
    needed: tuple[Part, ...]  #: which of these are needed besides


class _Newest(NamedTuple):
    """The newest test; ``every`` is of every point, also those that do not fit."""

    whole: ResidualSums
    noise: float
    evidence: Array
    fits: tuple[ResidualSums, ResidualSums]
    every: tuple[ResidualSums, ResidualSums]
    passes: bool


class RigWatch:
    """Watches the calibrated pose of the cameras and the size and shape of the body.

    Args:
        sync_s: standard deviation of the time between the two exposures of a shot, s.
        printed: whether the body is a print whose shape a calibration found: its points are not tested.

    Attributes:
        alarm: whether the newest test found one that is certain.
        alarmed: whether any did.
        noise: (6, 6) what of the covariance that the newest shot was given differs from shot to shot.
    """

    def __init__(self, rig: StereoRig, body: Body, sync_s: float, *, printed: bool = False) -> None:
        self.rig, self._body = rig, body
        self.reader = ShotReader(rig, body, sync_s)
        self._size, rows = self.reader.size, self.reader.points
        count, shape = rig.parameter_count, 3 * len(rows)
        #: (K, K) square root of the covariance of all parameters: the rig's, scale and points of the body, readout and
        #: skew, which are what is not known of them where detections are moved to one time, else zero
        self.prior = np.zeros((self._size, self._size))
        values, vectors = np.linalg.eigh(rig.cov)
        self.prior[:count, :count] = vectors * np.sqrt(np.maximum(values, 0.0))
        rest = np.arange(count, self._size - 2)
        self.prior[rest, rest] = np.append(SCALE, np.full(shape, SHAPE_M))
        self._by_fault = _fault_directions(rig, self._size)
        names = tuple(body.point_names[k] for k in rows)
        many = len(body.points) > len(rows)
        points = np.asarray(body.points, float)[rows]
        self._focal = _focal_changes(rig, self._size)
        sizes = self._size, self._focal, count + 1
        self._shape = ShapeWatch(*sizes, points, names, SHAPE_M, TEST_S, rigid=printed or many, strained=not printed)
        # (K, K + 7 + C) what parameters, seven numbers and the shape's candidates change of the parameters, over
        # priors.
        self._scaled = np.hstack([self.prior, self._by_fault * _WIDE, self._shape.by_wide])
        # The same with the coefficients of what the camera models lack, px.
        self._with_lens = np.zeros((self._size + LENS, self._scaled.shape[1] + LENS))
        self._with_lens[: self._size, :-LENS] = self._scaled
        self._with_lens[self._size :, -LENS:] = np.eye(LENS)
        # What moves to and fro: the right camera's rotation (3), rad, a focal length against the other, of the right,
        # the left.
        last, (apart_f, both_f) = rig.parameter_count, self._focal.T
        self._to_and_fro = np.column_stack([np.eye(self._size)[:, last - 3 : last], apart_f])
        self._alone = np.column_stack([apart_f - 0.5 * both_f, apart_f + 0.5 * both_f])
        self._shots = 0
        self.passing = Passing()  #: what changed from shot to shot, or from test to test
        self._taken_s = -np.inf
        self._began: Array | None = None
        # The response of the newest poses to everything, and the covariances of these poses.
        self._effects: deque[tuple[Array, Array]] = deque(maxlen=POSES)
        self._full = self._size + LENS
        # Shots of the running test, in stays; sums since the beginning are for what the camera models lack.
        self._stays: list[list[ShotResiduals]] = []
        columns = self._scaled.shape[1]
        self._fits = History(self._size, columns), History(self._size, columns)  # of all shots, and of the usual ones
        self._every = self._fits  # the same of every point, since one did not fit
        self._wholes, self._leftover = History(self._size, columns + LENS), Leftover()  # with the lenses' coefficients
        self._counted: list[Array] = []  # log-evidences of the newest tests, which the former is given later
        self.lens: LensError | None = None  #: what the camera models lack, where that is certain and matters
        self._timed = False
        self._poses = 0  # that differ
        self.alarm = self.alarmed = False
        self._alarms = 0  # in a row
        #: the change that the newest test found, where it matters and is more likely than not; it widens poses
        self.suspected: RigChange | None = None
        # When the newest change began, and the test before it, s; and what the newest alarm found.
        self._onset, self._since_s = Onset(0.0), 0.0
        self._found: RigChange | None = None
        self.noise, self._unrest, self._newest_added = np.zeros((6, 6)), Unrest(4), np.zeros((6, 6))
        self._swung = np.zeros((4, 4))  # covariance of what moved to and fro in the newest tests that this explains
        self._images: dict[bytes, None] = {}  # detections of shots that were summed, the newest last

    def take(self, estimate: PoseEstimate, t_s: float | None) -> Array:
        """Take a measured pose with its time, s; return (6, 6) what the suspected errors add to its covariance."""
        now_s, self._timed = (float(self._shots), False) if t_s is None else (t_s, True)
        self._shots += 1
        if estimate.exposures is not None:  # skew and readout, which all shots share, are constants with a prior
            values, vectors = np.linalg.eigh(estimate.exposures.cov_shared[::-1, ::-1])
            shared = slice(self._size - 2, self._size)
            self.prior[shared, shared] = vectors * np.sqrt(np.maximum(values, 0.0))
            self._scaled[:, shared] = self._with_lens[: self._size, shared] = self.prior[:, shared]
        seen = estimate.points.seen.uv.tobytes()
        is_new = seen not in self._images  # the same images say nothing new
        self._images[seen] = None
        if len(self._images) > _IMAGES:
            del self._images[next(iter(self._images))]
        self.reader.track.append((now_s, estimate.T_left_body))
        # It adds too little to what was taken just before it, whose errors are its own, too.
        passed_s, began = now_s - self._taken_s, self._began
        alike = self._timed and 0.0 <= passed_s < _LIKE_S
        if alike and (passed_s < _LEAST_S or (began is not None and not differ(began, estimate.T_left_body))):
            return self._newest_added
        self._taken_s = now_s
        found = self.reader.read(estimate, now_s)
        if found is None:
            return np.zeros((6, 6))
        self._effects.append((found.response, estimate.cov))
        if is_new:
            self._sum(found, estimate)
        cov = self._swung if self.passing.swings else self._unrest.cov  # of what moves to and fro
        self.noise = self._nodding(found.response, estimate.T_left_body, cov if cov.any() else self._unrest.suspected)
        added = self._added(found, estimate.T_left_body) + self.noise
        if added.any():  # of a body that is far off more than what is linear
            off = log_se3(inverse(estimate.T_left_body) @ self.reader.linear_about(estimate)[1])
            added += np.outer(off, off)
        self._newest_added = added
        return added

    def _nodding(self, response: Array, T: Array, cov: Array) -> Array:
        """Return the covariance (6, 6) that a camera which nods or a lens that breathes adds to a pose (4, 4)."""
        if not cov.any():
            return np.zeros((6, 6))
        by_rotation = response[:, : self._size] @ self._to_and_fro[:, :3]
        by_focal = response[:, : self._size] @ self._alone
        by_right = np.column_stack([by_rotation, by_focal[:, 0]])
        by_rotation = by_rotation - adjoint(inverse(T))[:, 3:] @ self.rig.T_left_right[:3, :3]
        by_left = np.column_stack([by_rotation, by_focal[:, 1]])
        return np.asarray(0.5 * (by_right @ cov @ by_right.T + by_left @ cov @ by_left.T))

    def _moving(self, rows: Array) -> Array:
        """Return the derivatives (n, 4) of a shot's rows by what moves to and fro."""
        return np.asarray(rows[:, 1 : 1 + self._size] @ self._to_and_fro)

    def _scattered(self, stays: Sequence[Sequence[ShotResiduals]]) -> tuple[Array, Array, Array, float]:
        """Return of a test times (N,), s, what its shots say of what moves to and fro (N, 4), noise, and Birge's ratio."""
        shots = [shot for stay in stays for shot in stay]
        J, r = [self._moving(each.rows) for each in shots], [each.rows[:, 0] for each in shots]
        H, b = np.array([each.T @ each for each in J]), np.array([j.T @ e for j, e in zip(J, r, strict=True)])
        cov = np.linalg.inv(H)
        d = np.einsum("nij,nj->ni", cov, b)
        freedom = sum(map(len, r)) - 10.0 * len(shots)
        excess = (sum(float(e @ e) for e in r) - float(np.vdot(b, d))) / max(freedom, 1.0)
        return np.array([each.t_s for each in shots]), d, cov, max(excess, 1.0)

    def _swing(self) -> None:
        """Estimate what moves to and fro, too slowly for one second to show it, from all tests that this explains."""
        means, squares = (np.mean(each, axis=0) for each in zip(*self.passing.swings, strict=True))
        values, vectors = np.linalg.eigh(squares - np.outer(means, means))  # without the calibration's own error
        self._swung = (vectors * np.maximum(values, 0.0)) @ vectors.T

    def _unrest_weighed(self, rows: Array, other: Array | None = None, *, cov: Array | None = None) -> Array:
        """Return rows of a shot, or others (n, K) of it, with what moves to and fro in their noise."""
        given, cov = rows if other is None else other, self._unrest.cov if cov is None else cov
        if not cov.any():
            return given
        values, vectors = np.linalg.eigh(cov)
        return noisier(given, self._moving(rows) @ (vectors * np.sqrt(np.maximum(values, 0.0))))

    def _weighed_parts(
        self, stays: Sequence[Sequence[ShotResiduals]], *, every: bool
    ) -> list[tuple[Array, Array, float]]:
        """Return of each shot its rows, what the times of its exposures do to them (n, 10), and its weight."""
        weigh, parts = self._unrest_weighed, list[tuple[Array, Array, float]]()
        for shot, count in ((shot, len(stay)) for stay in stays for shot in stay):
            rows, moved = shot.every if every else shot.rows, shot.exposed[every].whitened()
            parts.append((weigh(rows), weigh(rows, moved), 1.0 / count))
        return parts

    def _added(self, found: ShotResiduals, T: Array) -> Array:
        """Return what the suspected errors add to the covariance (6, 6) of a pose (4, 4)."""
        by_parameter, by_lens = found.response[:, : self._size], found.response[:, self._size :]
        added, shape = self._shape.added(by_parameter), self._shape.found
        if self.passing.now:
            added = added + self.passing.added(found.exposed[0], by_parameter @ self._shape.by_wide[:, 0])
        known = len(_WIDE) if self.suspected is not None and (shape is None or shape.seven_needed) else 0
        if self.lens is not None:
            known = known if self.lens.needed else 0
            added += by_lens @ (np.outer(self.lens.beta, self.lens.beta) + self.lens.cov) @ by_lens.T
        elif (doubt := self._shape.doubt) is not None:
            effect = by_parameter @ self._scaled[:, self._size + known :]
            added += effect @ doubt[known:, known:] @ effect.T
        if known and self.suspected is not None:
            both = self.suspected.cov + np.outer(self.suspected.f, self.suspected.f)
            by_right = by_parameter @ self._by_fault
            by_left = by_right.copy()  # then what poses refer to moved
            by_left[:, :5] -= adjoint(inverse(T) @ self.rig.T_left_right) @ free_directions(self.rig)[-6:]
            added += 0.5 * (by_right @ both @ by_right.T + by_left @ both @ by_left.T)
        return added

    def information(self, estimates: Sequence[PoseEstimate]) -> tuple[ResidualSums, int]:
        """Return the sums of measured poses, and how many of these differ: consecutive ones that are alike count as one."""
        sums, stays = self._summed([]).of(self._size), list[list[ShotResiduals]]()
        count, began = 0, None
        for k, estimate in enumerate(estimates):
            found = self.reader.read(estimate, float(k))
            if found is None:
                continue
            if began is None or differ(began, estimate.T_left_body):
                began = estimate.T_left_body
                sums = sums.plus(self._summed(stays).of(self._size))
                stays = [[]]
                count += 1
            stays[-1].append(found)
        return sums.plus(self._summed(stays).of(self._size)), count

    def explained(self, estimates: Sequence[PoseEstimate]) -> tuple[StereoRig, Body, HealthFinding]:
        """Return the rig and the body with the change that poses show, which are known to be wrong, and what it is."""
        sums, self._poses = self.information(estimates)
        change = self._estimated(sums.by(self._scaled[:, : self._size + len(_WIDE)]).reduced(self._size))
        more = {part: change.chi_square - change.without[part] for part in ("rig", "body")}
        part: Part = max(("rig", "body"), key=lambda each: (more[each], change.alone[each]))
        sure = more[part] > _NEEDED[part]
        said = replace(_part_finding(change, part, None, alone=not sure, cost_m=0.0), cost_mm=None)
        rig = self.rig.perturbed(free_directions(self.rig) @ change.f[_PARTS["rig"]])
        body = replace(self._body, points=(1.0 + change.f[_SCALED]) * self._body.points)
        return rig, body, said if self._poses > 1 else _of_one_pose(said)

    def _sum(self, shot: ShotResiduals, estimate: PoseEstimate) -> None:
        T = estimate.T_left_body
        moved = self._began is None or differ(self._began, T)
        size = 1 + self._size
        self._shape.take(
            shot.t_s, shot.every[:, :size], T, shot.response_with_all[:, : self._size], estimate.cov, moved
        )
        if moved or not self._stays:
            self._stays.append([])
            self._began = T
        self._stays[-1].append(shot)
        if shot.t_s - self._stays[0][0].t_s >= (TEST_S if self._timed else TEST_SHOTS):
            self._decide()

    def _summed(
        self,
        stays: Sequence[Sequence[ShotResiduals]],
        *,
        every: bool = False,
        own: Apart | None = None,
        cov: Array | None = None,
    ) -> ResidualSums:
        """Return the sums of stays, each the mean of its shots, without ``own`` times of exposure and what moves."""
        M, freedom = np.zeros((1 + self._full, 1 + self._full)), 0.0
        shots = [(each.every if every else each.rows, len(stay)) for stay in stays for each in stay]
        if shots:
            rows = np.concatenate([self._unrest_weighed(each, cov=cov) / np.sqrt(count) for each, count in shots])
            M, freedom = rows.T @ rows, sum((len(each) - 6.0) / count for each, count in shots)
        sums = ResidualSums(M, freedom, stays[0][0].t_s if stays else 0.0)
        return sums if own is None else eliminate(own, self._weighed_parts(stays, every=every), sums)[0]

    def _decide(self, *, ends: bool = False) -> None:
        stays, self._stays = self._stays, []
        if not stays:
            return
        self._poses += len(stays)
        newest, change = self._tested(stays)
        self._leftover.passed(newest.fits[0].of(self._size + len(_WIDE)))
        # A point that is displaced looks like it, for some tests before it is found.
        self._counted = [*self._counted, newest.evidence] if self._shape.found is None else []
        if len(self._counted) > _BEFORE:
            self._leftover.take(self._counted.pop(0))
        self._shape.decide(*self._every, ends=ends)
        self._decided(change)
        rested = not self._unrest.cov.any()
        if self._timed and not newest.passes:
            self._unrest.take(*self._scattered(stays))
        due = 0 < self._alarms <= FRESH or self._fits[0].count % _LENS_TESTS == 0
        if rested and self._unrest.cov.any():  # the newest sums do not have what moves to and fro in their noise
            self._take_back([each.begin_s for each in self._fits[0].kept[-TOGETHER:]])
        elif due and self._poses >= _LENS_POSES:
            self.lens = self._lens()

    def _keep(self, newest: _Newest, *, again: bool) -> None:
        if newest.every is not newest.fits and self._every is self._fits:
            self._every = copy(self._fits[0]), copy(self._fits[1])
        changed_s = min(self._shape.changed_s, self._onset.begin_s if self._alarms else np.inf)
        kept = [(self._fits, newest.fits), (self._every, newest.every)][: 1 if self._every is self._fits else 2]
        for watched, sums in kept:
            for tests, each in zip(watched, sums, strict=True):
                tests.keep(each, changed_s, again=again)
        self._wholes.keep(newest.whole.over(newest.noise), changed_s, again=again)

    def _doubted(self) -> RigChange:
        """Return the change that the newest tests show most clearly, of those that began at some times."""
        tests = self._fits[0]
        windows = [self._onset] if self._alarms else tests.windows(every=self.suspected is not None)
        changes = [(self._estimated(tests.reduced(each)), each) for each in windows]
        change, self._onset = max(changes, key=lambda each: each[0].chi_square)
        return change

    def _decided(self, change: RigChange) -> None:
        """Decide whether the change that is shown is certain: the usual shots alone must show it, too."""
        costs = self._cost_m(self._of_part(change, slice(None))) > COSTS_M
        matters = change.chi_square > _SUSPECTED and self._matters(change, slice(None))
        certain = costs and matters and _certain(change)
        self.alarm = certain and _certain(self._estimated(self._fits[1].reduced(self._onset)))
        self.alarmed = self.alarmed or self.alarm
        self._alarms = self._alarms + 1 if self.alarm else 0
        if self.alarm:
            self._found = change = self._dated()
        self.suspected = change if matters else None

    def _dated(self) -> RigChange:
        """Return the change as all shots show it, dated anew while the alarm is new, and now and then."""
        tests, fresh = self._fits[0], self._alarms <= FRESH
        if fresh or tests.count % STEPS == 0:
            _, self._onset = tests.dated(len(_WIDE), None if fresh else self._onset.begin_s)
        if fresh:
            self._since_s = tests.before_s(self._onset.begin_s)
        change, (begin_s, end_s) = self._estimated(tests.reduced(self._onset)), self._onset
        if end_s > begin_s:  # it is known to a test when it began, and what that does is no noise
            off = change.f - self._estimated(tests.reduced(Onset(tests.before_s(begin_s), end_s))).f
            change = replace(change, cov=change.cov + np.outer(off, off), slow=self._onset.goes_on)
        return change

    def _tested(self, stays: Sequence[Sequence[ShotResiduals]]) -> tuple[_Newest, RigChange]:
        """Return the newest test, which is kept, what passes taken off, and the change that it shows with others."""
        newest, every = self._newest(stays, None, None)
        self._keep(newest, again=False)
        change = self._doubted()
        known = self._alarms > FRESH and self._fits[0].count % STEPS > 0  # what stays did explain some tests
        if not self.passing.open and (known or change.chi_square <= _SUSPECTED):
            return newest, change
        passes, own = self._passes(stays, every)
        if passes is not None:
            newest, _ = self._newest(stays, passes, own)
            self._keep(newest, again=True)
        return newest, self._doubted()

    def _newest(
        self, stays: Sequence[Sequence[ShotResiduals]], passes: Passes | None, own: Apart | None
    ) -> tuple[_Newest, ResidualSums]:
        """Return the test of some stays, a cause that passes eliminated, and the sums of every point."""
        own, cov = own if passes == "time" else None, self._swung if passes == "rig" else None
        # Images that do not belong together are no moved camera; newer shots that agree with them are.
        alone = self._poses > 1 and self.suspected is None and any(len(stay) == 1 for stay in stays)
        odd = sorted(stays, key=_misfit)[len(stays) - max(len(stays) // _ODD, int(alone)) :]
        left_out = any(each.every is not each.rows for stay in stays for each in stay)
        sums = list[tuple[ResidualSums, ResidualSums]]()
        for every in (False, True)[: 1 + left_out]:
            whole = self._summed(stays, every=every, own=own, cov=cov).by(self._with_lens)
            usual = (
                whole.plus(self._summed(odd, every=every, own=own, cov=cov).by(self._with_lens), -1.0) if odd else whole
            )
            if cov is not None:  # of a slow nod all shots share one rotation
                whole, usual = (each.without(self._size + _ROTATIONS.start, cov[:3, :3]) for each in (whole, usual))
            sums.append((whole, usual))
        (whole, usual), of_every = sums[0], sums[-1]
        fitting = sums[0]
        if passes == "lens":
            row = self._size + len(_WIDE)
            fitting = whole.without(row, np.eye(1)), usual.without(row, np.eye(1))
        share, seven = len(stays) / sum(map(len, stays)), slice(1 + self._size, 1 + self._size + len(_WIDE))
        noise, evidence = self._leftover.seen(fitting[0], LENS, 3 * len(self.reader.points), seven, share)
        fits = self._without_lens(fitting, noise)
        both = fits if fitting is of_every else self._without_lens(of_every, noise)
        return _Newest(whole, noise, evidence, fits, both, own is not None or passes == "rig"), of_every[0]

    def _without_lens(self, sums: tuple[ResidualSums, ResidualSums], noise: float) -> tuple[ResidualSums, ResidualSums]:
        """Return two sums with the lenses' coefficients eliminated, over the variance of the noise."""
        found = self._leftover.without(sums[0], LENS, noise)
        return found, found if sums[1] is sums[0] else self._leftover.without(sums[1], LENS, noise)

    def _passes(
        self, stays: Sequence[Sequence[ShotResiduals]], every: ResidualSums
    ) -> tuple[Passes | None, Apart | None]:
        """Return what passing cause explains a test of some sums best, and its times of exposure."""
        found, times, nods = None, None, None
        if self._timed:
            parts = self._weighed_parts(stays, every=False)
            found = apart([(rows[:, 0], moved, weight) for rows, moved, weight in parts])
            moving = [(shot.rows[:, 0], self._moving(shot.rows), 1.0 / len(stay)) for stay in stays for shot in stay]
            cov, _, occam = nodding(moving, self._swung if self.passing.swings else None)
            _, d, noise, excess = self._scattered(stays)
            swing = d.mean(axis=0), d.T @ d / len(d) - excess * noise.mean(axis=0)
            nods = self._summed(stays, cov=cov).by(self._with_lens), occam, swing
            sums, shared = eliminate(found, parts, self._summed(stays))
            shared = np.hstack([shared[:, :1], shared[:, 1:] @ self._with_lens])
            times = Times(found, shared, sums.by(self._with_lens))
        cause, taken_back = self.passing.decide(every, self._staying, self._size, times, nods)
        if taken_back:  # of a nod those between them, too, which were not looked at
            since = [each.begin_s for each in self._fits[0].kept[:-1] if each.begin_s >= taken_back[0]]
            self._take_back(since if cause == "rig" else taken_back)
        if cause == "rig":
            self._swing()
        return cause, found

    def _staying(self, sums: ResidualSums, excess: float, skewed: bool) -> float:
        """Return the log-evidence of what stays: cameras, body, or what the camera models lack; 0 where nothing does."""
        lens = sums.among(self._lens_rows(sums)).reduced(self._size).over(excess)
        most = float(evidence_of_scales(lens.M, _LENS_SCALES_PX).max())
        return max(self._shape.evidence(sums.of(len(sums.b) - LENS), excess, skewed), most)

    def _lens_rows(self, sums: ResidualSums) -> Ids:
        """Return the rows of the parameters and of the coefficients of what the camera models lack."""
        return np.append(np.arange(self._size), len(sums.b) - LENS + np.arange(LENS))

    def _take_back(self, begins: Sequence[float]) -> None:
        """Take back what was found since tests, by when they began, s, which something explains that passes."""
        for tests in {*self._fits, *self._every, self._wholes}:
            tests.forget(begins)
        self._shape.forget(begins)
        self._alarms, self.alarm, self.alarmed = 0, False, False
        self.suspected = self._found = self.lens = None

    def _lens(self) -> LensError | None:
        """Return what the camera models lack; None where a change of the seven explains as much, or it hardly matters."""
        K, sums, faults = self._size, self._wholes.since(self._wholes.always), len(_WIDE)
        every = np.arange(K + faults + LENS)
        changed, lens = every[K : K + faults], every[K + faults :]
        tested = sums.among(np.append(every[: K + faults], len(sums.b) - LENS + np.arange(LENS)))

        def gained(*without: Ids) -> float:
            return tested.gain(np.setdiff1d(every, np.concatenate([*without, np.zeros(0, int)])))

        most, by_lens = gained(), gained(changed)
        excess = sums.excess(most)
        if by_lens - gained(lens) < _LENS_ALARM * excess:
            return None
        more = (self._wholes.dated(faults)[0] - (sums.square - by_lens)) / excess  # than a change at any time
        # A lens that lacks a little is not to blame where the cameras moved: then they explain most.
        moved = gained(lens) - gained(changed, lens)
        if more < max(_LENS_ALARM, _LENS_SHARE * moved / excess):
            return None
        needed = tuple(part for part, rows in _PARTS.items() if (most - gained(changed[rows])) / excess > _NEEDED[part])
        explained = (by_lens - gained(changed, lens)) / excess
        size = self.reader.noise_px * float(np.sqrt(2.0 * excess * explained / max(sums.freedom, 1.0)))
        sigma = size * float(np.sqrt(LENS / 2.0 + explained)) / explained
        found = LensError(*self._of_lens(sums.among(self._lens_rows(sums)).over(excess)), (size, sigma), more, needed)
        matters = largest_square(self._effects, np.append(np.zeros(K), found.beta)) > MATTERS**2
        return found if self.alarm or matters else None

    def _of_lens(self, sums: ResidualSums) -> tuple[Array, Array]:
        """Return the coefficients (M,), px, by the prior of the largest evidence, and their covariance (M, M)."""
        evidence = evidence_of_scales(sums.reduced(self._size).M, _LENS_SCALES_PX)
        scales = np.append(np.ones(self._size), np.full(LENS, _LENS_SCALES_PX[int(np.argmax(evidence))]))
        both = np.outer(scales, scales)
        cov = np.asarray(np.linalg.inv(sums.H * both + np.eye(len(scales))) * both, float)
        return (cov @ sums.b)[-LENS:], cov[-LENS:, -LENS:]

    @property
    def wrong_at_rest(self) -> bool:
        """Whether what is suspected makes poses wrong also where nothing moves."""
        parts = [] if self.suspected is None else self._to_blame(self.suspected)
        shape = self._shape.found
        if shape is not None and (points := [each for each in shape.chosen if each >= 0]):
            moved = bool(
                (self.reader.used_s[points] > self.reader.track[-1][0] - TEST_S).any()
            )  # else poses are of the other points
        else:
            moved = shape is not None
        return moved or (self.alarm and not set(parts) <= {"time"})

    def _cost_m(self, by: Array) -> float:
        """Return by how much a change of the parameters (K + M,) displaces one of the newest poses at most, m."""
        return float(displacement_m(np.array([response for response, _ in self._effects]) @ by).max())

    @property
    def pose_sigma_m(self) -> float | None:
        """Standard deviation of the newest measured positions, median, m; None without any."""
        covs = [cov for _, cov in self._effects]
        return float(median(np.sqrt(np.trace(np.array(covs)[:, :3, :3], axis1=1, axis2=2)))) if covs else None

    def _of_part(self, change: RigChange, part: slice) -> Array:
        """Return the change of the parameters (K + M,) that a part of the seven numbers makes."""
        return np.append(self._by_fault[:, part] @ change.f[part], np.zeros(LENS))

    def _matters(self, change: RigChange, part: slice) -> bool:
        """Return whether a part of the seven numbers moves one of the newest poses by so many of its sigmas."""
        return largest_square(self._effects, self._by_fault[:, part] @ change.f[part]) > MATTERS**2

    def _estimated(self, sums: ResidualSums) -> RigChange:
        """Return the seven numbers from sums of them and the candidates, which are zero."""
        seven = sums.of(len(_WIDE))
        S, s = np.asarray(seven.H + np.eye(len(_WIDE)), float), seven.b
        f = np.linalg.solve(S, s)
        # What the model leaves unexplained widens the noise (Birge ratio); it never narrows it.
        excess, every = seven.excess(float(s @ f)), np.arange(len(_WIDE))
        alone = {part: seven.gain(every[rows]) / excess for part, rows in _PARTS.items()}
        without = {part: seven.gain(np.delete(every, rows)) / excess for part, rows in _PARTS.items()}
        cov = excess * np.linalg.inv(S) * np.outer(_WIDE, _WIDE)
        return RigChange(_WIDE * f, cov, float(s @ f) / excess, alone, without, excess)

    def findings(self, *, ends: bool = True) -> tuple[HealthFinding, ...]:
        """Return what was found so far, where the running test ``ends`` by that one as well: nothing without an alarm."""
        ended = self
        if ends and self._stays:  # a copy, as this one goes on with the test
            ended = self.copied()
            ended._decide(ends=True)
        return ended.passing.among(ended._stays_changed(), timed=self._timed)

    def _stays_changed(self) -> tuple[HealthFinding, ...]:
        """Return what changed and stays, where the running test has ended."""
        shape, lens = self._shape.said, self.lens
        by_shape = 0.0 if shape is None else self._cost_m(np.append(self._shape.change(shape), np.zeros(LENS)))
        if shape is not None and shape.chosen == (SMOOTH,) and by_shape < COSTS_M:
            shape = None  # a print as good as any: poses have it in their sigma
        if shape is not None and (lens is None or shape.chi_square > lens.chi_square):
            said = self._shape.finding(shape, shape.begin_s if self._timed else None, by_shape)
            return (said, *(self._changed() if self.alarmed and shape.seven_needed else ()))
        if lens is not None:
            cost_m = self._cost_m(np.append(np.zeros(self._size), lens.beta))
            unsure = "a change of the cameras, the body or their times" * bool(lens.needed)
            return (
                (make_finding("lens", lens.size_px, cost_m=cost_m, unsure=unsure, also=lens.needed),)
                if cost_m > COSTS_M
                else ()
            )
        return _once((*(self._changed() if self.alarmed else ()), *self._nods()))

    def _nods(self) -> tuple[HealthFinding, ...]:
        """Return the finding of a camera that nods or a lens that breathes, where that displaces poses by what matters."""
        cov, newest = self._unrest.cov, list(self._effects)[-1:]
        cov = self._swung if self.passing.nodded and not cov.any() else cov
        if not cov.any() or not newest:
            return ()
        covs = self._nodding(newest[0][0], self.reader.track[-1][1], cov)
        cost_m = float(displacement_m(np.sqrt(np.diag(covs))))
        if cost_m < COSTS_M:
            return ()
        # The one that displaces points in the images by more.
        focal_px = np.array([camera.intrinsics[:2] for camera in self.rig.cameras])
        seen = np.diag(cov) * np.array([1.0, 1.0, 0.0, np.square(self.reader.half_px / focal_px).sum(axis=1).mean()])
        if seen[3] > seen[:3].sum():
            size = float(np.sqrt(cov[3, 3]))
            return (make_finding("breathes", (size, 0.1 * size), cost_m=cost_m),)
        sigma = 0.1 * float(np.sqrt(np.linalg.eigvalsh(cov[:3, :3])[-1]))
        return (make_finding("nods", (float(np.sqrt(np.trace(cov[:3, :3]))), sigma), cost_m=cost_m),)

    def _changed(self) -> tuple[HealthFinding, ...]:
        """Return what the newest test found of the seven numbers."""
        change, since_s = self._found, self._since_s if self._timed else None
        assert change is not None
        parts = self._to_blame(change)
        alone = len(parts) == 1 and not self._needed(change, parts[0])
        costs = [self._cost_m(self._of_part(change, _PARTS[part])) for part in parts]
        said = tuple(
            _part_finding(change, part, since_s, alone=alone, cost_m=cost_m)
            for part, cost_m in zip(parts, costs, strict=True)
        )
        return said if self._poses > 1 or (self._timed and self._shots > 1) else tuple(map(_of_one_pose, said))

    def copied(self) -> RigWatch:
        """Return a copy that says what was found so far; this one goes on."""
        copied = copy(self)
        copied._fits = copy(self._fits[0]), copy(self._fits[1])
        copied._every = copied._fits if self._every is self._fits else (copy(self._every[0]), copy(self._every[1]))
        for name in ("_shape", "passing", "_unrest", "_wholes", "_leftover"):
            setattr(copied, name, copy(getattr(self, name)))
        copied._stays = [stay.copy() for stay in self._stays]
        return copied

    def moved_since_s(self) -> float | None:
        """Return since when the cameras alone are found to have moved, s; None where nothing, or more, was found."""
        shape = self._shape.found
        shaped = shape is not None and not shape.seven_needed  # that explains what the seven numbers would
        if not (self.alarm and self._timed and self.suspected is not None) or self.lens is not None or shaped:
            return None
        return None if self.only_newest() or self._to_blame(self.suspected) != ["rig"] else self._since_s

    def only_newest(self) -> bool:
        """Return whether only the newest test shows a change: cameras may have moved within it, so the next one decides."""
        kept = self._fits[0].kept
        return len(kept) > 1 and self._since_s >= kept[-2].begin_s

    def _needed(self, change: RigChange, part: Part) -> bool:
        """Return whether the other parts do not explain what was found."""
        rows = _PARTS[part]
        more = change.chi_square - change.without[part]
        return more > _NEEDED[part] and self._matters(change, rows)

    def _to_blame(self, change: RigChange) -> list[Part]:
        """Return the parts that are needed to explain a change; where none is, the one that explains most alone."""
        if self.lens is not None:
            return list(self.lens.needed)
        return [part for part in _PARTS if self._needed(change, part)] or [max(_PARTS, key=change.alone.__getitem__)]


def _misfit(stay: Sequence[ShotResiduals]) -> float:
    """Return by how much the squared residuals of a stay exceed their number, mean of its shots."""
    return sum(float(each.every[:, 0] @ each.every[:, 0]) - len(each.every) for each in stay) / len(stay)


def _once(found: Sequence[HealthFinding]) -> tuple[HealthFinding, ...]:
    """Return findings, those of a cause as one: the costliest, which says what the others do."""
    causes = dict[str, HealthFinding]()
    for each in found:
        less, more = sorted((causes.get(each.cause, each), each), key=lambda one: one.cost_mm or 0.0)
        causes[each.cause] = more if less is more else replace(more, what=f"{more.what}; {less.what}")
    return tuple(causes.values())


def _certain(change: RigChange) -> bool:
    """Return whether chance explains neither all seven numbers nor one of their parts."""
    return change.chi_square > _ALARM or any(change.alone[part] > limit for part, limit in _ALARMS.items())


def free_directions(rig: StereoRig) -> Array:
    """Return (P, 5) of a rig's parameters: translation of the right camera across the baseline (2), its rotation (3)."""
    free, begin = np.zeros((rig.parameter_count, 5)), rig.parameter_count - 6
    baseline = rig.T_left_right[:3, :3].T @ rig.T_left_right[:3, 3]
    free[begin : begin + 3, :2] = np.linalg.svd(baseline[None])[2][1:].T
    free[begin + 3 :, 2:] = np.eye(3)
    return free


def _fault_directions(rig: StereoRig, size: int) -> Array:
    """Return (size, 7) what a unit of each of the seven numbers changes of the parameters."""
    by_fault = np.zeros((size, len(_WIDE)))
    by_fault[: rig.parameter_count, :5] = free_directions(rig)
    by_fault[rig.parameter_count, _SCALED] = by_fault[-1, _SKEWED] = 1.0
    return by_fault


def _focal_changes(rig: StereoRig, size: int) -> Array:
    """Return (size, 2) what relative changes of the focal lengths change: against each other by half each, and of both."""
    changes, right = np.zeros((size, 2)), rig.left.parameters.size
    changes[:2], changes[right : right + 2] = rig.left.intrinsics[:2, None], rig.right.intrinsics[:2, None]
    return changes * [0.5, 1.0] * np.where(np.arange(size) < right, 1.0, [[-1.0], [1.0]]).T


def _part_finding(change: RigChange, part: Part, since_s: float | None, *, alone: bool, cost_m: float) -> HealthFinding:
    """Return the finding of a part of the seven numbers; ``alone``: nothing shows that its rival is not the cause."""
    name, rows = {
        "rig": ("rotated", _ROTATIONS),
        "body": ("scaled", _PARTS["body"]),
        "time": ("skewed", _PARTS["time"]),
    }[part]
    size, sigma = sized(change.f[rows], change.cov[rows, rows])
    size = size if part == "rig" else float(change.f[rows][0])
    unsure = CAUSES["scaled" if part == "rig" else "rotated"].name if alone else ""
    words = {"shift_mm": 1e3 * float(np.linalg.norm(change.f[:2])), "more": ", and goes on to" * change.slow}
    return make_finding(name, (size, sigma), since_s, cost_m=cost_m, unsure=unsure, words=words)


def _of_one_pose(found: HealthFinding) -> HealthFinding:
    """Return a finding that rests on one pose, with what looks the same."""
    same = (
        "or the two images do not belong together (another pair's, or the body moved between them); one pose leaves both "
        "open"
    )
    advice = f"measure more poses; if all say so, {found.advice}"
    return replace(found, what=f"{found.what}; {same}", advice=advice, alternatives=("time",))
