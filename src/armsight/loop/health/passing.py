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
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from armsight.data import Array
from armsight.estimate.change import Sums, changed, eliminated, evidence_of_width
from armsight.loop.finding import HealthFinding
from armsight.loop.health.shots import UNKNOWN_SHARE, ExposedShot

#: Standard deviations that are tried of the times that each shot has of its own, s, and that of the times that all share.
_APART_S, _SHARED_S = (0.0, *(1e-3 * 2.0**k for k in range(-2, 7))), 0.03
#: Standard deviations that are tried of what is anew in each shot: rotations about an axis, rad, a focal length's share.
#: Half: a nod of 0.1 deg counts for less against times, double: one of 0.3 deg counts, too, in which poses are not linear.
_NOD_RAD = tuple(1e-5 * 2.0**k for k in range(9))
#: Log-evidence by which a hypothesis must be ahead of all others to be taken; half: chance takes one of 100 tests for it.
_AHEAD = math.log(1e4)
#: Hypotheses whose log-evidence is nearer than this are not distinguished: 12 of chi-square.
_ALIKE = 6.0
#: Times are another in each shot where their own part is this share of what all have in common at the least.
_CONSTANT = 0.4
#: A focal length changed once where the mean of its tests is so many times what they scatter; half: slow breathing is taken
#: for that, double: noise is taken for breathing.
_STEADY = 3.0
#: Tests that must show something before it is said: one in which a camera moved is of both times, and looks alike.
_LEAST = 2
#: Of the columns of a shot those of times: of the right camera, of the rows of the right and of the left one; acceleration.
_TIMES = [0, 7, 8, 9]
#: Standard deviations of coefficients that are tried, px; 0 is none.
_TAU_PX = np.array([0.0, *(1e-3 * 2.0**k for k in range(7))])
#: Before anything is seen none is so much more probable than any other; half: fine noise counts as it, double: what some
#: webcams leave is known later.
_NONE = 30.0
#: This share of tests says nothing of it: what changed within them looks alike. half: one counts by 0.7 more, double: less.
_ODD = 0.02
#: So many residuals of unit variance are assumed before those of a test; half: tests of few poses scatter more.
_USUAL = 30.0


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


def eliminate(found: Apart, shots: Sequence[tuple[Array, Array, float]], sums: Sums) -> None:
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
    unsure: tuple[str, ...] = ()
    _wide: float = 1.0  # width of its prior, and its sigma
    _sigma: float = 0.0

    @property
    def now(self) -> bool:
        """Whether the newest test showed something."""
        return self.apart_s > 0.0 or self.focal_share != 0.0

    def decide(
        self,
        test: Sums,
        evidence: Callable[[Sums, float], tuple[float, float]],
        focal: tuple[int, float],
        found: Apart | None,
        rest: Sums | None,
        field: Callable[[float], float],
    ) -> Literal["time", "lens"] | None:
        """Decide what explains a test best, and return it: None where it is something that stays.

        Args:
            test: sums of the directions of what may have changed, in units of their priors.
            evidence: returns the log-evidence of what stays, and of the focal length, of sums and a variance of the noise.
            focal: which of the directions is the focal length, and the width of its prior.
            found: times of exposure that explain it.
            rest: the sums with these eliminated.
            field: returns the log-evidence of what the camera models cannot express.
        """
        # What the test before showed goes on, more likely than that it ended and something else began.
        by_lens, by_apart = (-_AHEAD if shown else 0.0 for shown in (self.focal_share, self.apart_s))
        self.apart_s = self.focal_share = 0.0
        by_time = 0.0 if rest is None else test.square - rest.square
        left = test.square - max(float(test.b @ np.linalg.solve(test.H + np.eye(len(test.b)), test.b)), by_time)
        excess = max(left / max(test.freedom, 1.0), 1.0)
        stays, lens = evidence(test, excess)
        stays = max(stays, field(excess))
        time = alone = -math.inf
        if found is not None and rest is not None:  # what stays may have happened besides
            alone = 0.5 * (by_time / excess - found.occam)
            time = alone + max(evidence(rest, excess)[0], 0.0)
        self.unsure = tuple(
            cause
            for cause, each in (("time", alone), ("lens", lens))
            if each > max(stays - _ALIKE, _AHEAD) and each <= stays
        )
        # A focal length is one of what stays, too: it need not be ahead of itself; nor times that all shots have in common.
        least = by_apart or (0.0 if found is not None and found.apart_s == 0.0 else _AHEAD)
        ahead = time < stays + least if time >= lens else lens < stays + by_lens - 1e-9
        if max(time, lens) < _AHEAD or ahead:
            return None
        if time >= lens:
            assert found is not None
            self.apart_s = math.hypot(found.apart_s, float(np.linalg.norm(found.shared_s[:3])))
            self.apart = min(self.apart[0], test.begin_s), (*self.apart[1], found)
            return "time"
        row, self._wide = focal
        self.focal_share = self._wide * float(test.b[row] / (test.H[row, row] + 1.0))
        self._sigma = self._wide / math.sqrt(test.H[row, row] + 1.0)
        self.focal = min(self.focal[0], test.begin_s), (*self.focal[1], self.focal_share)
        return "lens"

    def added(self, exposed: ExposedShot, by_focal: Array) -> Array:
        """Return the covariance (6, 6) of a pose by what is passing now.

        Args:
            exposed: its shot.
            by_focal: (6,) its response to a focal length, in units of its prior.
        """
        added = np.zeros((6, 6))
        if self.apart_s:
            by = self.apart_s * exposed.response()
            added += by @ by.T
        if self.focal_share:
            spread = math.sqrt(float(np.mean(np.square(self.focal[1]))))
            added += (spread / self._wide) ** 2 * np.outer(by_focal, by_focal)
        return added

    def among(self, stays: tuple[HealthFinding, ...], *, timed: bool) -> tuple[HealthFinding, ...]:
        """Return what was found, with findings of what stays: of one cause once; what explains it as well is named."""
        times, focals = len(self.apart[1]), len(self.focal[1])
        if max(times, focals) < _LEAST:
            unsure = [each for each in ("time", "lens") if each in self.unsure]
            return tuple(_besides(each, unsure) if each.cause in ("rig", "body") else each for each in stays)
        found = self._time_finding(timed=timed) if times >= focals else self._lens_finding(timed=timed)
        # What is left of it looks like what stays: that cannot be excluded, but what was found before.
        before = [each for each in stays if found.since_s and each.since_s and each.since_s < found.since_s - 1.0]
        if any(each.cause == found.cause for each in before):
            found, before = replace(found, since_s=min(each.since_s for each in before if each.since_s)), []
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
            1e3 * math.hypot(float(sigmas_s[k]), 0.5 * UNKNOWN_SHARE * float(mean_s[k])),
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
        mean, spread = 100.0 * float(np.mean(shares)), 100.0 * float(np.std(shares))
        if abs(mean) > _STEADY * spread:
            size, sigma = abs(mean), max(100.0 * self._sigma, spread / math.sqrt(len(shares)))
            longer, shorter = ("left", "right") if mean > 0 else ("right", "left")
            what = (
                f"the focal length of the {longer} camera is {size:.3f} % longer against that of the {shorter} one than "
                "calibrated; which of the two changed cannot be distinguished"
            )
            advice = "fasten focus and zoom of both lenses, let the cameras warm up, and calibrate the rig again"
        else:
            size = math.hypot(mean, spread)
            sigma = size / math.sqrt(2.0 * len(shares))
            what = f"the focal length of one camera changes against that of the other by {size:.3f} % (RMS), within seconds"
            advice = "switch autofocus and image stabilisation off, fasten focus and zoom of both lenses, calibrate the rig again"
        return HealthFinding("lens", what, since_s if timed else None, size, sigma, "%", advice, ("rig",))


def _besides(found: HealthFinding, causes: Sequence[str]) -> HealthFinding:
    """Return a finding with other causes that cannot be excluded."""
    more = [each for each in causes if each != found.cause]
    return replace(found, alternatives=tuple(dict.fromkeys((*found.alternatives, *more))))  # type: ignore[arg-type]


class Leftover:
    """What images leave beyond their noise, of all tests so far.

    Args:
        wide: (K, P) square root of the covariance of the parameters once everything may have changed.
        L: (K, Q) that of their own error.
        F: (K, D) directions of what is as in the test before, for the evidence.

    Attributes:
        tau_px: standard deviation of a polynomial's coefficient in a test, px.
    """

    def __init__(self, wide: Array, L: Array, F: Array) -> None:
        self._evidence = np.log([_NONE, *np.ones(len(_TAU_PX) - 1)])
        self._wide, self._L, self._F = wide, L, F
        self.tau_px, self._before = 0.0, (np.zeros(F.shape[1]), np.eye(F.shape[1]))

    def seen(self, sums: Sums, share: float) -> tuple[float, Array]:
        """Return of a test the variance of its noise, kappa, and the log-evidence of each tau that is tried.

        Args:
            sums: of the parameters and of the coefficients, px, which stand last.
            share: of the shots those that differ from each other.
        """
        K, P = self._wide.shape
        lens, most = len(sums.b) - K, float(_TAU_PX[-1])
        H = self._wide.T @ sums.H[:K, :K] @ self._wide
        M = coefficients(sums, self._wide)
        G, b = most**2 * M[1:, 1:] + np.eye(lens), most * M[1:, 0]
        explained = float(np.trace(np.linalg.solve(H + np.eye(P), H))) + lens - float(np.trace(np.linalg.inv(G)))
        left = float(M[0, 0]) - float(b @ np.linalg.solve(G, b))
        noise = max((_USUAL + left) / (_USUAL + max(sums.freedom - share * explained, 0.0)), 1.0)
        mean, root = self._before
        M = coefficients(sums.over(noise), np.hstack([self._L, self._F @ root]), self._F @ mean)
        return noise, evidence_of_width(M[1:, 1:], M[1:, 0], _TAU_PX)

    def passed(self, test: Sums) -> None:
        """Take the sums of the newest test, of the parameters: what it says of the directions."""
        one = changed(test, Sums.empty(len(test.b)), self._L, self._F)
        cov = np.linalg.inv(one.H + np.eye(len(one.b)))
        self._before = cov @ one.b, np.linalg.cholesky(cov)

    def take(self, evidence: Array) -> None:
        """Count a test's log-evidence."""
        self._evidence = self._evidence + np.logaddexp(evidence - evidence.max(), math.log(_ODD))
        self.tau_px = float(_TAU_PX[int(np.argmax(self._evidence))])

    def without(self, sums: Sums, noise: float) -> Sums:
        """Return sums without the coefficients, which are eliminated, and over the variance of the noise."""
        first, variance = 1 + len(self._wide), self.tau_px**2 / noise
        found, across = sums.of(first - 1), sums.M[first:, :first]
        inner = variance * sums.M[first:, first:] + np.eye(len(across))
        return Sums(found.M - variance * across.T @ np.linalg.solve(inner, across), sums.freedom, sums.begin_s).over(
            noise
        )


def coefficients(sums: Sums, root: Array, mean: Array | None = None) -> Array:
    """Return sums of the coefficients that stand last (1 + M, 1 + M), the first parameters eliminated.

    Their covariance has a square root (K, P), and they are about a mean (K,).
    """
    K, P = root.shape
    by = np.zeros((len(sums.M), 1 + P + len(sums.M) - 1 - K))
    by[0, 0], by[1 : 1 + K, 1 : 1 + P] = 1.0, root
    by[1 + K :, 1 + P :] = np.eye(len(sums.M) - 1 - K)
    if mean is not None:
        by[1 : 1 + K, 0] = -mean
    return eliminated(by.T @ sums.M @ by, slice(1, 1 + P))
