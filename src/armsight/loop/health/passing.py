"""What changes and does not stay: exposures that are not when they are said to be, focal lengths that oscillate, nods.

In: the residuals of the shots of one test, and by how much the times of their exposures move each. Out: the sums of the
test with that eliminated, where it explains them better than anything that changed once and stays (a camera, the body), and
the findings of time and lens. What stays may have changed at once or grow from test to test. Model of a shot, its pose
eliminated:

    r = B d + C c + n,    d ~ N(0, s^2)

B d is what displacing the body in the right image does, and a displacement that grows with the row in either image (the
rows of a rolling shutter are exposed one after the other): the body's velocity times a time that each shot has of its own,
and a share of the speed in any direction, since the velocity is that of measured poses. C are those of its columns that are
times alone, c their values that all shots of the test share. Late exposures, another rate, dropped images and rolling
shutters are all of this form. A focal length has one value in each test. Hypotheses are compared by their evidence (MacKay,
1992), which takes off what chance explains: of numbers that each shot has anew it is much.

A camera that nods has another rotation in each shot, and a lens that breathes fast another focal length, which looks much
the same; but it goes on where the body rests, and as much in each test (``nodding``).

What images leave beyond their noise passes as well, and nothing is wrong then. Cameras that sharpen, compress and denoise
displace all that is near each other in an image, for a while, by nearly the same (:class:`Leftover`):

    r = J p + L beta + n,    beta ~ N(0, tau^2),    n ~ N(0, kappa)

with p all that may have changed and L polynomials of the position in each image, whose coefficients are others in each
test. The variance kappa of the noise is that of the test, p being free; tau is that of all tests: the one of the largest
evidence of each test after the one before it, in which p was the same. So a camera that rotated makes kappa no larger, and
tau in two tests at the most, which are too few.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

import numpy as np

from armsight.data import Array
from armsight.loop.finding import ALIKE, HealthFinding, displacement_m, make_finding
from armsight.loop.health.residuals import UNKNOWN_SHARE, ExposedShot, ResidualSums, eliminated, evidence_of_scales
from armsight.loop.health.shape import FOCAL_SHARE

#: Standard deviations that are tried of the times that each shot has of its own, s, and that of the times that all share.
_APART_S, _SHARED_S = (0.0, *(1e-3 * 2.0**k for k in range(-2, 7))), 0.03
#: Standard deviations that are tried of each shot's rotation about an axis, rad, or a focal length's share.
#: Half: a nod of 0.1 deg counts for less against times, double: one of 0.3 deg counts, too, in which poses are not linear.
_NOD_RAD = tuple(1e-5 * 2.0**k for k in range(9))
#: Log-evidence by which a hypothesis must be ahead of all others to be taken; half: chance takes one of 100 tests for it.
_AHEAD = math.log(1e4)
#: And by this share of the log-evidence of what stays: the test in which it began is of both times.
#: Half: a camera that rotates by 0.2 deg is a lens that breathes, double: slow breathing is a rotation.
_MODELLED = 0.05
#: Times are another in each shot where their own part is this share of what all have in common at the least.
_CONSTANT = 0.4
#: What passes and what stays began at one time where they are dated so near, s: each is known to about a test.
_DATED_S = 2.0
#: Tests that must show something before it is said: one in which a camera moved is of both times, and looks alike.
_LEAST = 2
#: Of the columns of a shot those of times: of the right camera, of the rows of the right and of the left one; acceleration.
_TIMES = [0, 7, 8, 9]
#: First rows of a camera's rotation and of a test's focal length after the parameters; the latter's share of a variance.
_ROTATION_ROW, _FOCAL_ROW, _FOCAL_VARIANCE = 2, 7, 0.01
#: Newest doubtful tests explained together; half: slow breathing is taken for a change that stays, double: more time.
TOGETHER = 12
#: Newest tests listed in which something passed; half: hours of it are sized a little worse, double: 0.3 MB more.
_LISTED = 300
#: Standard deviations of coefficients that are tried, px; 0 is none.
_TAU_PX = np.array([0.0, *(1e-3 * 2.0**k for k in range(7))])
#: None is at first so much more probable than any other; half: fine noise counts, double: webcams' is known later.
_NONE = 30.0
#: This share of tests says nothing of it: what changed within them looks alike. half: one counts by 0.7 more, double: less.
_ODD = 0.02
#: So many residuals of unit variance are assumed before those of a test; half: tests of few poses scatter more.
_USUAL = 30.0


Passes = Literal["time", "lens", "rig"]
_PASSES: tuple[Passes, ...] = ("time", "lens", "rig")
#: Mean (4,) and second moment (4, 4) of what the shots of a test say of what moves to and fro.
Swing = tuple[Array, Array]
#: A test's sums with another rotation of a camera in each shot eliminated, twice the log of what chance explains with it.
Nods = tuple[ResidualSums, float, Swing]
#: Returns the log-evidence of what stays, of sums and a variance of the noise, and whether with a skew; 0 of nothing.
Staying = Callable[[ResidualSums, float, bool], float]


@dataclass(frozen=True)
class Apart:
    """How the exposures of the shots of a test are apart."""

    apart_s: float  #: standard deviation of the times that each shot has of its own, s
    rms_s: float  #: RMS of the times by which the right camera is late, s
    gained: float  #: sum of squares that all explain
    occam: float  #: twice the logarithm of what chance explains with them
    #: (4,) what all shots share: by how much the right camera is late, the last row of the right and of the left one
    #: against the middle, s; and what the first lacks of an acceleration
    shared_s: Array
    information: Array  #: (4, 4) inverse of its covariance


def _normal(shots: Sequence[tuple[Array, Array, float]]) -> tuple[Array, Array, Array]:
    """Return information (N, K, K), right sides (N, K) and weights (N,) of residuals (n,) and their derivatives (n, K)."""
    parts = [(B.T @ B, B.T @ r, weight) for r, B, weight in shots]
    W, b, weights = (np.array(part) for part in zip(*parts, strict=True))
    return W, b, weights


def apart(shots: Sequence[tuple[Array, Array, float]]) -> Apart:
    """Return the times of exposure that best explain shots: residuals (n,), what times do to them (n, 10), and weights."""
    W, b, weights = _normal(shots)
    found = [_apart(each, W, b, weights) for each in _APART_S]
    return max(found, key=lambda each: each.gained - each.occam)


def nodding(shots: Sequence[tuple[Array, Array, float]], known: Array | None) -> tuple[Array, float, float]:
    """Return the covariance (4, 4) of what is anew in each shot, a camera's rotation or focal length, that explains most.

    Args:
        shots: residuals (n,), their derivatives by these (n, 4), and weights.
        known: the one that tests before have shown: a camera that nods goes on; None without.

    Returns:
        It; what it explains of the sum of squares, and twice the logarithm of what chance explains with it.
    """
    W, b, weights = _normal(shots)
    found = list[tuple[Array, float, float]]()
    for cov in [sigma_rad**2 * np.eye(W.shape[1]) for sigma_rad in _NOD_RAD] if known is None else [known]:
        K = np.eye(W.shape[1]) + W @ cov
        gained = np.einsum("ni,ni->n", b @ cov, np.linalg.solve(K, b[..., None])[..., 0])
        found.append((cov, float(weights @ gained), float(weights @ np.linalg.slogdet(K)[1])))
    return max(found, key=lambda each: each[1] - each[2])


def _apart(apart_s: float, W: Array, b: Array, weights: Array) -> Apart:
    """Return the times of N shots, of information W (N, 10, 10) and right sides b (N, 10), with a prior of their own, s."""
    K = np.eye(W.shape[1]) + apart_s**2 * W
    left, g = np.linalg.solve(K, W), np.linalg.solve(K, b[..., None])[..., 0]
    N, h = (np.tensordot(weights, part, 1) for part in (left[:, _TIMES][:, :, _TIMES], g[:, _TIMES]))
    information = np.asarray(N + np.eye(len(h)) / _SHARED_S**2)
    shared_s = np.asarray(np.linalg.solve(information, h))
    own_s = apart_s**2 * (g[:, 0] - left[:, 0, _TIMES] @ shared_s)
    rms_s = math.sqrt(float(weights @ (shared_s[0] + own_s) ** 2 / weights.sum()))
    gained = apart_s**2 * float(weights @ np.einsum("ni,ni->n", b, g)) + float(h @ shared_s)
    occam = float(weights @ np.linalg.slogdet(K)[1] + np.linalg.slogdet(_SHARED_S**2 * information)[1])
    return Apart(apart_s, rms_s, gained, occam, shared_s, information)


def eliminate(
    found: Apart, shots: Sequence[tuple[Array, Array, float]], sums: ResidualSums
) -> tuple[ResidualSums, Array]:
    """Return sums without what times of exposure explain, and the right sides (4, 1 + K) of the times that all shots share.

    ``shots``: whitened rows (n, 1 + K), what times of exposure do to them (n, 10), and weights.
    """
    shared, M, freedom = np.zeros((len(_TIMES), len(sums.M))), sums.M.copy(), sums.freedom
    for rows, B, weight in shots:
        G, K = B.T @ rows, np.eye(B.shape[1]) + found.apart_s**2 * (B.T @ B)
        left = np.linalg.solve(K, G)
        shared += weight * left[_TIMES]
        M -= weight * found.apart_s**2 * (G.T @ left)
        freedom -= weight * (len(K) - float(np.trace(np.linalg.inv(K))))
    M -= shared.T @ np.linalg.solve(found.information, shared)
    return replace(sums, M=M, freedom=freedom), shared


class _Rest(NamedTuple):
    """A test's sums with what passes eliminated; what that explains, and twice the log of what chance explains with it."""

    sums: ResidualSums
    gained: float
    occam: float

    @property
    def beyond(self) -> float:
        """What it explains beyond chance."""
        return self.gained - self.occam

    def shows(self, excess: float) -> bool:
        """Return whether it explains more than chance, of a noise whose variance is so many times larger."""
        return self.gained / excess > self.occam


class Times(NamedTuple):
    """Times of exposure of a test, the right sides (4, 1 + K) of those that all shots share, and its sums without them."""

    found: Apart
    shared: Array
    rest: ResidualSums


@dataclass(frozen=True)
class _Doubtful:
    """A test that something other than chance explains."""

    every: ResidualSums
    rests: dict[Passes, _Rest]
    times: Times | None  #: of exposure; None where those are not known
    focal_share: float  #: the focal length's change in it, as a share, everything else right
    swing: Swing | None = None
    counted: Passes | None = None  #: what passes, as it was counted last; None where that is what stays

    @classmethod
    def of(cls, every: ResidualSums, size: int, times: Times | None, nods: Nods | None) -> _Doubtful:
        """Return a test; ``size``: how many parameters there are, which are eliminated."""
        M, row, cost = eliminated(every.M, slice(1, 1 + size)), 1 + _FOCAL_ROW, _left(every, size)
        focal = every.without(size + _FOCAL_ROW, _FOCAL_VARIANCE * np.eye(1))
        occam = math.log1p(_FOCAL_VARIANCE * float(M[row, row]))
        rests: dict[Passes, _Rest] = {"lens": _Rest(focal, cost - _left(focal, size), occam)}
        if times is not None:
            occam = times.found.occam - _occam(times.found.information)
            rests["time"] = _Rest(times.rest, cost - _left(times.rest, size), occam)
        if nods is not None:  # of a fast nod each shot has a rotation of its own, of a slow one the test as a whole
            found = (nods[:2], _swayed(*nods[:2], size), _swayed(every, 0.0, size))
            nodded = (_Rest(rest, cost - _left(rest, size), occam) for rest, occam in found)
            rests["rig"] = max(nodded, key=lambda each: each.beyond)
        focal_share = FOCAL_SHARE * float(M[0, row] / (M[row, row] + 1.0))
        return cls(every, rests, times, focal_share, nods and nods[2])

    def shows(self, cause: Passes | None, excess: float) -> bool:
        """Return whether a cause explains more than chance, of a noise whose variance is so many times larger."""
        return cause in self.rests and (cause == "rig" or self.rests[cause].shows(excess))


def _swayed(sums: ResidualSums, occam: float, size: int) -> tuple[ResidualSums, float]:
    """Return a test's sums without a rotation of its own, and twice the log of what chance explains with that, too."""
    rotation = sums.reduced(size).among(_ROTATION_ROW + np.arange(3))
    best = int(np.argmax(evidence_of_scales(rotation.M, np.array(_NOD_RAD))))
    cov = _NOD_RAD[best] ** 2 * np.eye(3)
    occam += float(np.linalg.slogdet(np.eye(3) + cov @ rotation.H)[1])
    return sums.without(size + _ROTATION_ROW, cov), occam


def _occam(information: Array) -> float:
    """Return twice the logarithm of what chance explains with times that shots share, of information (4, 4)."""
    return float(np.linalg.slogdet(_SHARED_S**2 * information)[1])


def _without(
    tests: Sequence[_Doubtful], cause: Passes | None, excess: float, shares: Array
) -> tuple[ResidualSums, float]:
    """Return the sums of tests with a cause eliminated, and twice the logarithm of what chance explains with it.

    A focal length is another in each test, the times that shots share are the same in all.
    """
    occam, prior, summed = 0.0, np.eye(len(_TIMES)) / _SHARED_S**2, np.zeros_like(tests[0].every.M)
    information, shared = prior, np.zeros((len(_TIMES), len(summed)))
    for each, share in zip(tests, shares, strict=True):
        M = each.every.M
        if cause is not None and each.shows(cause, excess):
            M, occam = each.rests[cause].sums.M, occam + each.rests[cause].occam
            if cause == "time" and each.times is not None:
                M = M + each.times.shared.T @ np.linalg.solve(each.times.found.information, each.times.shared)
                information, shared = (
                    information + each.times.found.information - prior,
                    shared + share * each.times.shared,
                )
        summed += M if share.min() == 1.0 else share[:, None] * M * share
    if shared.any():
        summed, occam = summed - shared.T @ np.linalg.solve(information, shared), occam + _occam(information)
    return ResidualSums(summed, sum(each.every.freedom for each in tests), tests[0].every.begin_s), occam


class _Weighed(NamedTuple):
    """What doubtful tests say, all together."""

    excess: float  #: the variance of their noise, over what is expected
    stays: float  #: log-evidence of what stays
    explained: dict[Passes, float]  #: of each cause that passes, its log-evidence alone
    ahead: dict[Passes, float]  #: by how much it explains more than what stays does, which may have happened besides

    @classmethod
    def of(cls, tests: Sequence[_Doubtful], stays: Staying, size: int) -> _Weighed:
        """Weigh tests; ``size``: how many parameters there are."""
        begins_s, columns = np.array([each.every.begin_s for each in tests]), len(tests[0].every.M)
        same = np.ones((len(tests), columns))
        none = _without(tests, None, 1.0, same)[0]
        lefts = [
            _left(each, len(each.b)) for each in (none, *(_without(tests, cause, 1.0, same)[0] for cause in _PASSES))
        ]
        excess, of_none = max(min(lefts) / max(none.freedom, 1.0), 1.0), _left(none, size)
        without = {cause: _without(tests, cause, excess, same) for cause in _PASSES}
        explained = {
            each: 0.5 * ((of_none - _left(sums, size)) / excess - occam) for each, (sums, occam) in without.items()
        }
        if max(explained.values()) <= _AHEAD:
            return cls(excess, 0.0, explained, explained)
        # What stays may have changed at once or grow from test to test.
        growing = same.copy()
        growing[:, 1 + size :] = ((begins_s - begins_s[0]) / max(float(np.ptp(begins_s)), 1e-9))[:, None]

        def stay(cause: Passes | None, skewed: bool) -> float:
            both = (none if cause is None else without[cause][0], _without(tests, cause, excess, growing)[0])
            return max(stays(each, excess, skewed) for each in both[: len(tests)])

        stay_best, ahead = stay(None, True), dict[Passes, float]()
        for cause, log in explained.items():
            skewed = cause != "time"  # cameras that are apart by the same time always are no rival of times
            rival = stay_best if skewed else stay(None, False)
            ahead[cause] = log + stay(cause, skewed) - rival if log > _AHEAD else -np.inf
        return cls(excess, stay_best, explained, ahead)

    def best(self, shown: Passes | None, *, one: bool) -> Passes | None:
        """Return what passes that explains most; None where it is what stays.

        Args:
            shown: what the test before showed: it goes on, more likely than that it ended and something else began.
            one: whether it is one test. A focal length is one of what stays, too: then it need not be ahead of itself, but
                explain all alone.
        """
        best = max(_PASSES, key=self.ahead.__getitem__)
        goes_on = shown == best or (best == "lens" and one and self.explained[best] > self.stays)
        least = -_AHEAD if goes_on else _AHEAD + _MODELLED * self.stays
        return best if self.explained[best] > _AHEAD and self.ahead[best] > least else None


def _left(sums: ResidualSums, size: int) -> float:
    """Return the sum of squares that the first parameters leave."""
    return sums.square - sums.gain(np.arange(size))


@dataclass
class Passing:
    """What was found that changes and does not stay; one of a watch.

    Attributes:
        apart, focal, nods: the tests in which exposures were apart, a focal length or a camera's rotation changed:
        when, s, and how.
        apart_s: standard deviation of the times in the newest test, those that its shots share included, s.
        focal_share: the focal length's change in it.
        unsure: causes that explained the newest doubtful test nearly as well as what was taken.
        open: whether something explains much that what stays does not: the next test is looked at, too.
        cost_m: by how much a pose was displaced at most, one sigma, m.
    """

    apart: tuple[tuple[float, Apart], ...] = ()
    focal: tuple[tuple[float, float], ...] = ()
    nods: tuple[float, ...] = ()
    apart_s: float = 0.0
    focal_share: float = 0.0
    unsure: tuple[str, ...] = ()
    open: bool = False
    cost_m: float = 0.0
    _doubtful: list[_Doubtful] = field(default_factory=list)
    _counted: Passes | None = None

    @property
    def now(self) -> bool:
        """Whether the newest test showed something."""
        return self._counted is not None

    @property
    def swings(self) -> tuple[Swing, ...]:
        """What the tests say of a camera that nods now."""
        return tuple(each.swing for each in self._doubtful if self._counted == each.counted == "rig" and each.swing)

    @property
    def nodded(self) -> bool:
        """Whether a camera was found to nod."""
        return len(self.nods) >= _LEAST

    def decide(
        self, every: ResidualSums, stays: Staying, size: int, times: Times | None, nods: Nods | None
    ) -> tuple[Passes | None, tuple[float, ...]]:
        """Decide what explains the doubtful tests best, all together: what stays has one value in them, what passes many.

        What was decided of earlier ones of them is taken back where another cause explains all of them better.

        ``every``: the sums of the newest: parameters, seven numbers, candidates, the first of which is a focal length.
        ``times``: of exposure that explain it; None without. ``nods``: of a camera; None without.

        Returns:
            What explains the newest test, None where it is something that stays; and when those tests began, s, that were
            counted for something else, and are taken back.
        """
        tests = [*self._doubtful[1 - TOGETHER :], _Doubtful.of(every, size, times, nods)]
        weighed = _Weighed.of(tests, stays, size)
        cause = weighed.best(self._counted, one=len(tests) == 1)
        if cause is not None:  # a test in which something moved once is of both times, and looks like what passes
            beyond = [each.rests[cause].beyond if cause in each.rests else 0.0 for each in tests]
            for odd in {0, int(np.argmax(beyond))}:
                others = [*tests[:odd], *tests[odd + 1 :]]
                weighed = _Weighed.of(others, stays, size) if others and cause is not None else weighed
                cause = cause if others and weighed.best(self._counted, one=len(others) == 1) == cause else None
        self._counted, self.open = cause, cause is not None or max(weighed.ahead.values()) > _AHEAD
        near = max(_PASSES, key=weighed.explained.__getitem__)
        alike = weighed.explained[near] > max(_AHEAD, weighed.stays - ALIKE / 2.0)
        self.unsure = (near,) if cause is None and alike and len(tests) > 1 else ()
        self._doubtful = [replace(each, counted=cause if each.shows(cause, weighed.excess) else None) for each in tests]
        self._list(self._doubtful)
        changed = (
            now.every.begin_s
            for before, now in zip(tests[:-1], self._doubtful, strict=False)
            if now.counted not in (None, before.counted)
        )
        return self._doubtful[-1].counted, tuple(changed)

    def _list(self, tests: Sequence[_Doubtful]) -> None:
        """Take over what the doubtful tests show now; those that are no more among them stay as they were."""
        first_s = tests[0].every.begin_s
        apart = [each for each in self.apart if each[0] < first_s]
        focal = [each for each in self.focal if each[0] < first_s]
        apart += [(each.every.begin_s, each.times.found) for each in tests if each.counted == "time" and each.times]
        focal += [(each.every.begin_s, each.focal_share) for each in tests if each.counted == "lens"]
        nods = (each for each in self.nods if each < first_s)
        self.nods = (*nods, *(each.every.begin_s for each in tests if each.counted == "rig"))[-_LISTED:]
        # Of those of hours the first says since when.
        self.apart, self.focal = (*apart[:1], *apart[1:][-_LISTED:]), (*focal[:1], *focal[1:][-_LISTED:])
        newest = tests[-1]
        found = newest.times.found if newest.counted == "time" and newest.times is not None else None
        self.apart_s = 0.0 if found is None else math.hypot(found.apart_s, float(np.linalg.norm(found.shared_s[:3])))
        self.focal_share = newest.focal_share if newest.counted == "lens" else 0.0

    def added(self, exposed: ExposedShot, by_focal: Array) -> Array:
        """Return the covariance (6, 6) of a pose by what passes now; by_focal: (6,) its response, per ``FOCAL_SHARE``."""
        added = np.zeros((6, 6))
        if self.apart_s:
            by = self.apart_s * exposed.response()
            added += by @ by.T
        if self.focal_share:
            spread = math.sqrt(float(np.mean(np.square([share for _, share in self.focal]))))
            added += (spread / FOCAL_SHARE) ** 2 * np.outer(by_focal, by_focal)
        self.cost_m = max(self.cost_m, float(displacement_m(np.sqrt(np.diag(added)))))
        return added

    def among(self, stays: tuple[HealthFinding, ...], *, timed: bool) -> tuple[HealthFinding, ...]:
        """Return what was found, with findings of what stays: of one cause once; what explains it as well is named."""
        times, focals = len(self.apart), len(self.focal)
        if max(times, focals) < max(_LEAST, len(self.nods)):
            return tuple(_besides(each, self.unsure) if each.cause in ("rig", "body") else each for each in stays)
        passes = self._time_finding(timed=timed) if times >= focals else self._lens_finding(timed=timed)
        return self._once(passes, stays)

    def _once(self, seen: HealthFinding, stays: tuple[HealthFinding, ...]) -> tuple[HealthFinding, ...]:
        """Return a finding of what passes with those of what stays: those of its cause are one with it."""
        same = [each for each in stays if each.cause == seen.cause]
        if seen.cause == "lens":  # one that stays is sized better
            seen = next(iter(same), seen)
        seen = replace(seen, cost_mm=seen.cost_mm or 1e3 * self.cost_m or None)
        begins = [each.since_s for each in (seen, *same) if each.since_s is not None]
        since_s = min(begins, default=0.0)
        # What is left of it looks like what stays: that cannot be excluded, but what was found before.
        others = [each for each in stays if each not in same]
        before = [each for each in others if begins and each.since_s is not None and each.since_s < since_s - _DATED_S]
        causes = [*(each.cause for each in others if each not in before), *(("lens",) if self.focal else ())]
        return (*before, _besides(replace(seen, since_s=since_s if begins else None), causes))

    def _time_finding(self, *, timed: bool) -> HealthFinding:
        since_s, tests = self.apart[0][0] if timed else None, [each for _, each in self.apart]
        information = np.sum([each.information for each in tests], axis=0)
        mean_s = np.linalg.solve(information, np.sum([each.information @ each.shared_s for each in tests], axis=0))
        sigmas_s = np.sqrt(np.diag(np.linalg.inv(information)))
        # A body that rests shows nothing of it.
        shown = np.array([max(each.gained - each.occam, 1e-9) for each in tests])
        own_s = math.sqrt(float(np.average([each.apart_s**2 for each in tests], weights=shown)))
        k = int(np.argmax(np.abs(mean_s[:3])))
        if own_s > _CONSTANT * abs(mean_s[k]):
            size_s = math.sqrt(float(np.average([each.rms_s**2 for each in tests], weights=shown)))
            return make_finding("apart", (size_s, size_s / math.sqrt(2.0 * len(tests))), since_s)
        # What the velocity lacks is lacking in all shots alike.
        size_s, sigma_s = float(mean_s[k]), math.hypot(float(sigmas_s[k]), 0.5 * UNKNOWN_SHARE * float(mean_s[k]))
        if k:
            words = {"side": ("right", "left")[k - 1]}
            return make_finding("rolls", (2.0 * size_s, 2.0 * sigma_s), since_s, words=words)
        return make_finding("skewed", (size_s, sigma_s), since_s)

    def _lens_finding(self, *, timed: bool) -> HealthFinding:
        since_s, shares = self.focal[0][0], [share for _, share in self.focal]
        size = math.sqrt(float(np.mean(np.square(shares))))
        return make_finding("swings", (size, size / math.sqrt(2.0 * len(shares))), since_s if timed else None)


def _besides(seen: HealthFinding, causes: Sequence[str]) -> HealthFinding:
    """Return a finding with other causes that cannot be excluded."""
    more = [each for each in causes if each != seen.cause]
    return replace(seen, alternatives=tuple(dict.fromkeys((*seen.alternatives, *more))))  # type: ignore[arg-type]


class Leftover:
    """What images leave beyond their noise, of all tests so far.

    Attributes:
        tau_px: standard deviation of a polynomial's coefficient in a test, px.
    """

    def __init__(self) -> None:
        self._evidence = np.log([_NONE, *np.ones(len(_TAU_PX) - 1)])
        self.tau_px, self._before = 0.0, (np.zeros(7), np.eye(7))

    def seen(self, sums: ResidualSums, lens: int, points: int, seven: slice, share: float) -> tuple[float, Array]:
        """Return of a test the variance of its noise, kappa, and the log-evidence of each tau that is tried.

        ``sums``: of all that may have changed, in units of its priors, and of the coefficients, px, which stand last.
        ``points``: how many numbers before them are of single points: these are as before for the evidence. ``seven``:
        which of the sums are the seven numbers: for the evidence they are those of the test before. ``share``: of the
        shots those that differ from each other.
        """
        first = len(sums.M) - lens
        H, most = sums.H[: first - 1, : first - 1], float(_TAU_PX[-1])
        M = eliminated(sums.M, slice(1, first))
        G, b = most**2 * M[1:, 1:] + np.eye(lens), most * M[1:, 0]
        explained = float(np.trace(np.linalg.solve(H + np.eye(len(H)), H))) + lens - float(np.trace(np.linalg.inv(G)))
        left = float(M[0, 0]) - float(b @ np.linalg.solve(G, b))
        noise = max((_USUAL + left) / (_USUAL + max(sums.freedom - share * explained, 0.0)), 1.0)
        rows = np.delete(np.arange(len(sums.M)), slice(first - points, first))
        as_before = np.eye(len(rows))
        as_before[seven, 0], as_before[seven, seven] = self._before
        M = eliminated(as_before.T @ sums.M[np.ix_(rows, rows)] @ as_before / noise, slice(1, first - points))
        return noise, evidence_of_scales(M, _TAU_PX)

    def passed(self, test: ResidualSums) -> None:
        """Take the sums of the newest test, of the parameters and the seven numbers: what it says of these."""
        M = eliminated(test.M, slice(1, len(test.M) - 7))
        cov = np.linalg.inv(M[1:, 1:] + np.eye(7))
        self._before = -cov @ M[1:, 0], np.linalg.cholesky(cov)

    def take(self, evidence: Array) -> None:
        """Count a test's log-evidence."""
        self._evidence = self._evidence + np.logaddexp(evidence - evidence.max(), math.log(_ODD))
        self.tau_px = float(_TAU_PX[int(np.argmax(self._evidence))])

    def without(self, sums: ResidualSums, lens: int, noise: float) -> ResidualSums:
        """Return sums without the coefficients, which are eliminated, and over the variance of the noise."""
        first, variance = len(sums.M) - lens, self.tau_px**2 / noise
        across = sums.M[first:, :first]
        by_lens = variance * across.T @ np.linalg.solve(variance * sums.M[first:, first:] + np.eye(lens), across)
        return replace(sums, M=(sums.M[:first, :first] - by_lens) / noise)
