"""What changes and does not stay: exposures that are not when they are said to be, focal lengths that oscillate.

In: the residuals of the shots of one test, and by how much the times of their exposures move each. Out: the sums of the
test with that eliminated, where it explains them better than anything that changed once and stays (a camera, the body), and
the findings of time and lens. Model of a shot, its pose eliminated:

    r = B d + C c + n,    d ~ N(0, s^2)

B d is what displacing the body in the right image does, and a displacement that grows with the row in either image (the
rows of a rolling shutter are exposed one after the other): the body's velocity times a time that each shot has of its own,
and a share of the speed in any direction, since the velocity is that of measured poses. C are those of its columns that are
times alone, c their values that all shots of the test share. Late exposures, another rate, dropped images and rolling
shutters are all of this form. A focal length has one value in each test. Hypotheses are compared by their evidence (MacKay,
1992), which takes off what chance explains: of numbers that each shot has anew it is much.

A camera that nods, or a lens that breathes, has another rotation or focal length in each shot, and looks much the same:
times explain a test only where their evidence is larger than that of these four of each shot (``nodding``).

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
from numpy.typing import NDArray

from armsight.data import Array
from armsight.loop.finding import HealthFinding
from armsight.loop.health.shape import ResidualSums, eliminated

#: Standard deviations that are tried of the times that each shot has of its own, s, and that of the times that all share.
_APART_S, _SHARED_S = (0.0, *(1e-3 * 2.0**k for k in range(-2, 7))), 0.03
#: Standard deviations that are tried of what is anew in each shot: rotations about an axis, rad, a focal length's share.
#: Half: a nod of 0.1 deg counts for less against times, double: one of 0.3 deg counts, too, in which poses are not linear.
_NOD_RAD = tuple(1e-5 * 2.0**k for k in range(9))
#: The velocity of measured poses is off by this share of the speed in any direction; half: rig and body are blamed for what
#: is left of late images, double: less of them is seen.
_UNKNOWN_SHARE = 0.2
#: The body's motion at a shot is that of so many newest ones, if these are of so short a time, s.
TRACK, _LONGEST_S = 5, 1.0
#: Log-evidence by which a hypothesis must be ahead of all others to be taken; half: chance takes one of 100 tests for it.
_AHEAD = math.log(1e4)
#: Hypotheses whose log-evidence is nearer than this are not distinguished: 12 of chi-square.
_ALIKE = 6.0
#: Times are another in each shot where their own part is this share of what all have in common at the least.
_CONSTANT = 0.4
#: Tests that must show something before it is said: one in which a camera moved is of both times, and looks alike.
_LEAST = 2
#: Of the columns of a shot those of times: of the right camera, of the rows of the right and of the left one; acceleration.
_TIMES = [0, 7, 8, 9]
#: An acceleration moves the body like so many seconds of it, where times are of a second.
_BENT_S = 0.1
#: Standard deviation of the focal length of a test, as a share: so wide that it decides nothing beside the column's own.
_FOCAL = 0.05
#: Standard deviations of coefficients that are tried, px; 0 is none.
_TAU_PX = np.array([0.0, *(1e-3 * 2.0**k for k in range(7))])
#: Before anything is seen none is so much more probable than any other; half: fine noise counts as it, double: what some
#: webcams leave is known later.
_NONE = 30.0
#: This share of tests says nothing of it: what changed within them looks alike. half: one counts by 0.7 more, double: less.
_ODD = 0.02
#: So many residuals of unit variance are assumed before those of a test; half: tests of few poses scatter more.
_USUAL = 30.0


def velocity(before: Array, after: Array, seconds: float) -> Array:
    """Return the velocity (6,) in the body's axes, 1/s, that takes a pose (4, 4) to another, by a small angle."""
    R = before[:3, :3].T @ after[:3, :3]
    rotation = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    shift = after[:3, :3].T @ (after[:3, 3] - before[:3, 3])
    return np.asarray(np.concatenate([shift, rotation]) / seconds)


class ExposedShot(NamedTuple):
    """By how much the times of exposure move the residuals of a shot.

    Attributes:
        A: (n, 6) derivative of the residuals by the pose, in standard deviations; rows u, v of the left image and of the
            right one, point by point.
        roll: (n,) the row of the image, from -1 at its top to 1.
        track: times, s, and poses T_left_body (4, 4) of the newest shots up to this one.
    """

    A: Array
    roll: Array
    track: tuple[tuple[float, Array], ...]

    def of(self, rows: NDArray[np.bool_]) -> ExposedShot:
        """Return that of some rows."""
        return self._replace(A=self.A[rows], roll=self.roll[rows])

    def motion(self) -> tuple[Array, Array]:
        """Return velocity and acceleration (6,) of the body in its axes, 1/s and 1/s^2; zero where they are unknown.

        They are those of each second shot: what a shot has of its own and the next one not leaves them right.
        """
        if len(self.track) < TRACK:
            return np.zeros(6), np.zeros(6)
        (first_s, first), (middle_s, middle), (last_s, last) = self.track[0], self.track[TRACK // 2], self.track[-1]
        if not first_s < middle_s < last_s < first_s + _LONGEST_S:
            return np.zeros(6), np.zeros(6)
        early, late = velocity(first, middle, middle_s - first_s), velocity(middle, last, last_s - middle_s)
        return 1.5 * late - 0.5 * early, (late - early) * 2.0 / (last_s - first_s)

    def moved(self) -> Array:
        """Return what (n, 10) moves the residuals.

        1 s later in the right image, other motions there (6), 1 s at the edge of the right and of the left one; and what
        the first lacks of a body that accelerates.
        """
        right = np.arange(len(self.A)) % 4 >= 2
        by_right, (along, acceleration) = self.A * right[:, None], self.motion()
        speeds = np.repeat(np.linalg.norm(along.reshape(2, 3), axis=1) / math.sqrt(3.0), 3)
        rolled = self.roll * (self.A @ along)
        skew, bent = by_right @ along, _BENT_S * (by_right @ acceleration)
        return np.column_stack([skew, _UNKNOWN_SHARE * speeds * by_right, rolled * right, rolled * ~right, bent])

    def without_pose(self) -> Array:
        """Return the same (n, 10) with the pose eliminated."""
        Q, moved = np.linalg.qr(self.A)[0], self.moved()
        return np.asarray(moved - Q @ (Q.T @ moved))

    def response(self) -> Array:
        """Return what (6, 10) these do to the pose."""
        return np.asarray(np.linalg.lstsq(self.A, self.moved(), rcond=None)[0])


@dataclass(frozen=True)
class Apart:
    """How the exposures of the shots of a test are apart.

    Attributes:
        apart_s: standard deviation of the times that each shot has of its own, s.
        rms_s: RMS of the times by which the right camera is late, s.
        gained: sum of squares that all explain.
        occam: twice the logarithm of what chance explains with them.
        shared_s: (4,) what all shots share: by how much the right camera is late, the last row of the right and of the left
            one against the middle, s; and what the first lacks of an acceleration.
        information: (4, 4) inverse of its covariance.
    """

    apart_s: float
    rms_s: float
    gained: float
    occam: float
    shared_s: Array
    information: Array


def _normal(shots: Sequence[tuple[Array, Array, float]]) -> tuple[Array, Array, Array]:
    """Return information (N, K, K), right sides (N, K) and weights (N,) of residuals (n,) and their derivatives (n, K)."""
    parts = [(B.T @ B, B.T @ r, weight) for r, B, weight in shots]
    W, b, weights = (np.array(part) for part in zip(*parts, strict=True))
    return W, b, weights


def apart(shots: Sequence[tuple[Array, Array, float]]) -> Apart | None:
    """Return the times of exposure that explain residuals (n,) of shots best; None where none do.

    Args:
        shots: residuals, what times of exposure do to them (n, 10), and weights.
    """
    W, b, weights = _normal(shots)
    found = [_apart(each, W, b, weights) for each in _APART_S]
    best = max(found, key=lambda each: each.gained - each.occam)
    return best if best.gained > best.occam else None


def nodding(shots: Sequence[tuple[Array, Array, float]]) -> float:
    """Return twice the log-evidence of a camera that has another rotation or focal length in each shot, against none.

    Args:
        shots: residuals (n,), their derivatives by these (n, 4), and weights.
    """
    W, b, weights = _normal(shots)

    def evidence(sigma_rad: float) -> float:
        K = np.eye(W.shape[1]) + sigma_rad**2 * W
        gained = sigma_rad**2 * np.einsum("ni,ni->n", b, np.linalg.solve(K, b[..., None])[..., 0])
        return float(weights @ (gained - np.linalg.slogdet(K)[1]))

    return max(map(evidence, _NOD_RAD))


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


def eliminate(found: Apart, shots: Sequence[tuple[Array, Array, float]], sums: ResidualSums) -> None:
    """Take what times of exposure explain out of sums.

    Args:
        found: they.
        shots: whitened rows (n, 1 + K), what times of exposure do to them (n, 10), and weights.
        sums: those of the rows.
    """
    shared = np.zeros((len(_TIMES), len(sums.M)))
    for rows, B, weight in shots:
        G, K = B.T @ rows, np.eye(B.shape[1]) + found.apart_s**2 * (B.T @ B)
        left = np.linalg.solve(K, G)
        shared += weight * left[_TIMES]
        sums.M -= weight * found.apart_s**2 * (G.T @ left)
        sums.freedom -= weight * (len(K) - float(np.trace(np.linalg.inv(K))))
    sums.M -= shared.T @ np.linalg.solve(found.information, shared)


@dataclass
class Passing:
    """What was found that changes and does not stay; one of a watch.

    Attributes:
        apart: of the tests in which the exposures were apart, since when, s.
        focal: the changes of one focal length against the other of the tests in which that explained most, since when, s.
        apart_s: standard deviation of the times in the newest test, those that its shots share included, s.
        focal_share: the focal length's change in it.
        unsure: causes that explained the newest doubtful test nearly as well as what was taken.
    """

    apart: tuple[float, tuple[Apart, ...]] = (math.inf, ())
    focal: tuple[float, tuple[float, ...]] = (math.inf, ())
    apart_s: float = 0.0
    focal_share: float = 0.0
    unsure: tuple[str, ...] = field(default=())

    @property
    def now(self) -> bool:
        """Whether the newest test showed something."""
        return self.apart_s > 0.0 or self.focal_share != 0.0

    def decide(
        self,
        every: ResidualSums,
        evidence: Callable[[ResidualSums, float], tuple[float, float]],
        size: int,
        found: Apart | None,
        sums: ResidualSums | None,
    ) -> Literal["time", "lens"] | None:
        """Decide what explains a test best, and return it: None where it is something that stays.

        Args:
            every: the sums of the test: parameters, seven numbers, candidates, the first of which is a focal length.
            evidence: returns the log-evidence of what stays, and of the focal length, of sums and a variance of the noise.
            size: K, how many parameters there are.
            found: times of exposure that explain it.
            sums: those with these eliminated.
        """
        # What the test before showed goes on, more likely than that it ended and something else began.
        by_lens, by_apart = (-_AHEAD if shown else 0.0 for shown in (self.focal_share, self.apart_s))
        self.apart_s = self.focal_share = 0.0
        cost = float(eliminated(every.M[: 1 + size, : 1 + size], slice(1, 1 + size))[0, 0])
        M = eliminated(every.M, slice(1, 1 + size))
        all_explain = (
            cost - float(M[0, 0]) + float(M[0, 1:] @ np.linalg.solve(M[1:, 1:] + np.eye(len(M) - 1), M[1:, 0]))
        )
        by_time, left = 0.0, cost - all_explain
        if found is not None and sums is not None:
            by_time = cost - float(eliminated(sums.M[: 1 + size, : 1 + size], slice(1, 1 + size))[0, 0])
            left = min(left, cost - by_time)
        excess = max(left / max(every.freedom, 1.0), 1.0)
        stays, lens = evidence(every, excess)
        time = alone = -math.inf
        if found is not None and sums is not None:  # what stays may have happened besides
            alone = 0.5 * (by_time / excess - found.occam)
            time = alone + max(evidence(sums, excess)[0], 0.0)
        first = max(time, lens)
        self.unsure = tuple(
            cause
            for cause, each in (("time", alone), ("lens", lens))
            if each > max(stays - _ALIKE, _AHEAD) and each <= stays
        )
        # A focal length is one of what stays, too: it need not be ahead of itself.
        if first < _AHEAD or (time < stays + (by_apart or _AHEAD) if time >= lens else lens < stays + by_lens - 1e-9):
            return None
        if time >= lens:
            assert found is not None
            self.apart_s = math.hypot(found.apart_s, float(np.linalg.norm(found.shared_s[:3])))
            self.apart = min(self.apart[0], every.begin_s), (*self.apart[1], found)
            return "time"
        M = eliminated(every.M, slice(1, 1 + size))
        self.focal_share = _FOCAL * float(M[0, 8] / (M[8, 8] + 1.0))
        self.focal = min(self.focal[0], every.begin_s), (*self.focal[1], self.focal_share)
        return "lens"

    def added(self, exposed: ExposedShot, by_focal: Array) -> Array:
        """Return the covariance (6, 6) of a pose by what is passing now.

        Args:
            exposed: its shot.
            by_focal: (6,) its response to a focal length, in units of ``_FOCAL``.
        """
        added = np.zeros((6, 6))
        if self.apart_s:
            by = self.apart_s * exposed.response()
            added += by @ by.T
        if self.focal_share:
            spread = math.sqrt(float(np.mean(np.square(self.focal[1]))))
            added += (spread / _FOCAL) ** 2 * np.outer(by_focal, by_focal)
        return added

    def among(self, stays: tuple[HealthFinding, ...], *, timed: bool) -> tuple[HealthFinding, ...]:
        """Return what was found, with findings of what stays: of one cause once; what explains it as well is named."""
        times, focals = len(self.apart[1]), len(self.focal[1])
        if max(times, focals) < _LEAST:
            unsure = [each for each in ("time", "lens") if each in self.unsure]
            return tuple(_besides(each, unsure) if each.cause in ("rig", "body") else each for each in stays)
        found = self._time_finding(timed=timed) if times >= focals else self._lens_finding(timed=timed)
        if focals > times:  # one that stays is sized better
            found = next((each for each in stays if each.cause == "lens"), found)
        # What is left of it looks like what stays: that cannot be excluded.
        before = [each for each in stays if found.since_s and each.since_s and each.since_s < found.since_s - 1.0]
        others = [each.cause for each in stays if each not in before]
        return (*before, _besides(found, [*others, *(("lens",) if 0 < focals <= times else ())]))

    def _time_finding(self, *, timed: bool) -> HealthFinding:
        """Return the finding of exposures that are apart."""
        since_s, tests = self.apart
        information = np.sum([each.information for each in tests], axis=0)
        mean_s = np.linalg.solve(information, np.sum([each.information @ each.shared_s for each in tests], axis=0))
        sigmas_s = np.sqrt(np.diag(np.linalg.inv(information)))
        own_s = math.sqrt(float(np.mean([each.apart_s**2 for each in tests])))
        k = int(np.argmax(np.abs(mean_s[:3])))
        # What the velocity lacks is lacking in all shots alike.
        size, sigma = (
            1e3 * float(mean_s[k]),
            1e3 * math.hypot(float(sigmas_s[k]), 0.5 * _UNKNOWN_SHARE * float(mean_s[k])),
        )
        if own_s > _CONSTANT * abs(mean_s[k]):
            size = 1e3 * math.sqrt(float(np.mean([each.rms_s**2 for each in tests])))
            sigma = size / math.sqrt(2.0 * len(tests))
            what = (
                f"the two exposures of a shot are about {size:.1f} ms apart, and by another time in each shot: one camera "
                "has another rate or drops images, or images of different moments are paired"
            )
        elif k:
            size, sigma = 2.0 * size, 2.0 * sigma
            what = (
                f"the rows of the {('right', 'left')[k - 1]} camera are exposed one after the other, over {abs(size):.1f} "
                "ms more than is known: a rolling shutter"
            )
        else:
            later = "later" if size > 0 else "earlier"
            what = f"the right camera exposes {abs(size):.2f} ms {later} than is known, against the left one"
        return HealthFinding(
            "time",
            what,
            since_s if timed else None,
            size,
            sigma,
            "ms",
            "trigger both cameras together, with one rate and the same exposure; in a recording --skew find moves the "
            "detections to one time, and finds rolling shutters",
        )

    def _lens_finding(self, *, timed: bool) -> HealthFinding:
        """Return the finding of a focal length that changes."""
        since_s, shares = self.focal
        size = 100.0 * math.sqrt(float(np.mean(np.square(shares))))
        what = f"the focal length of one camera changes against that of the other by {size:.3f} % (RMS), within seconds"
        return HealthFinding(
            "lens",
            what,
            since_s if timed else None,
            size,
            size / math.sqrt(2.0 * len(shares)),
            "%",
            "switch autofocus and image stabilisation off, fasten focus and zoom of both lenses, calibrate the rig again",
            ("rig",),
        )


def _besides(found: HealthFinding, causes: Sequence[str]) -> HealthFinding:
    """Return a finding with other causes that cannot be excluded."""
    more = [each for each in causes if each != found.cause]
    return replace(found, alternatives=tuple(dict.fromkeys((*found.alternatives, *more))))  # type: ignore[arg-type]


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

        Args:
            sums: of all that may have changed, in units of its priors, and of the coefficients, px, which stand last.
            lens: how many coefficients there are.
            points: how many numbers before them are of single points: these are as before for the evidence.
            seven: which of the sums are the seven numbers: for the evidence they are those of the test before.
            share: of the shots those that differ from each other.
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
        values, V = np.linalg.eigh(M[1:, 1:])
        variances = np.square(_TAU_PX)[:, None]
        ratio = 1.0 + variances * np.maximum(values, 0.0)
        return noise, 0.5 * (variances * np.square(V.T @ M[1:, 0]) / ratio - np.log(ratio)).sum(axis=1)

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
        found, across = sums.of(first - 1), sums.M[first:, :first]
        found.M -= variance * across.T @ np.linalg.solve(variance * sums.M[first:, first:] + np.eye(lens), across)
        return found.over(noise)
