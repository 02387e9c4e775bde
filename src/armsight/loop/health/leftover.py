"""What images leave in the positions of markers beyond their noise: estimated from what a rig itself shows.

In: the sums of each test. Out: the same sums with this in their noise. Cameras that sharpen, compress and denoise displace
all that is near each other in an image, for a while, by nearly the same. A test's residuals, the pose eliminated, are

    r = J p + L beta + n,    beta ~ N(0, tau^2),    n ~ N(0, kappa)

with p all that may have changed and L polynomials of the position in each image, whose coefficients are others in each
test. The variance kappa of the noise is that of the test, tau that of all tests: the one of the largest evidence (MacKay,
1992), p being free. So a camera that rotated makes neither of them larger, and is found where it does more than they do.
"""

from __future__ import annotations

import numpy as np

from armsight.data import Array
from armsight.loop.health.shape import ResidualSums, eliminated

#: Standard deviations of coefficients that are tried, px; 0 is none.
_TAU_PX = np.array([0.0, *(1e-3 * 2.0**k for k in range(7))])
#: Before anything is seen none is so much more probable than any other; half, double: no test or figure differs.
_NONE = 1e3
#: So many residuals of unit variance are assumed before those of a test; half: tests of few poses scatter more.
_USUAL = 30.0


class Leftover:
    """What images leave beyond their noise, of all tests so far.

    Attributes:
        tau_px: standard deviation of a polynomial's coefficient in a test, px.
    """

    def __init__(self) -> None:
        self._evidence = np.log([_NONE, *np.ones(len(_TAU_PX) - 1)])
        self.tau_px = 0.0

    def seen(self, sums: ResidualSums, lens: int, share: float) -> tuple[float, Array]:
        """Return of a test the variance of its noise, kappa, and the log-evidence of each tau that is tried.

        Args:
            sums: of all that may have changed, in units of its priors, and of the coefficients, px, which stand last.
            lens: how many coefficients there are.
            share: of the shots those that differ from each other.
        """
        first = len(sums.M) - lens
        H, M = sums.H[: first - 1, : first - 1], eliminated(sums.M, slice(1, first))
        G, V = np.linalg.eigh(M[1:, 1:])
        G, squares, most = np.maximum(G, 0.0), np.square(V.T @ M[1:, 0]), float(_TAU_PX[-1]) ** 2
        explained = float(np.trace(np.linalg.solve(H + np.eye(len(H)), H))) + float((most * G / (1.0 + most * G)).sum())
        left = float(M[0, 0]) - float((squares * most / (1.0 + most * G)).sum())
        noise = max((_USUAL + left) / (_USUAL + max(sums.freedom - share * explained, 0.0)), 1.0)
        variances = np.square(_TAU_PX)[:, None]
        ratio = 1.0 + variances * G / noise
        return noise, 0.5 * (variances * squares / noise**2 / ratio - np.log(ratio)).sum(axis=1)

    def take(self, evidence: Array) -> None:
        """Count a test's log-evidence."""
        self._evidence = self._evidence + evidence
        likely = np.exp(self._evidence - self._evidence.max())
        self.tau_px = float(np.sqrt(likely @ np.square(_TAU_PX) / likely.sum()))

    def without(self, sums: ResidualSums, lens: int, noise: float) -> ResidualSums:
        """Return sums without the coefficients, which are eliminated, and over the variance of the noise."""
        first, variance = len(sums.M) - lens, self.tau_px**2 / noise
        found, across = sums.of(first - 1), sums.M[first:, :first]
        found.M -= variance * across.T @ np.linalg.solve(variance * sums.M[first:, first:] + np.eye(lens), across)
        return found.over(noise)
