"""What moves to and fro within a second: a mount that nods, a lens that breathes; it averages out where a mean is tested.

In: values with the covariance that their noise explains, of single shots. Out: the covariance of what they scatter beyond
that. Of each second a parabola is removed, as calibrations and arms are off by what changes slowly with the pose. The rest
is compared with its expectation in the axes of the noise (principal axes of one covariance relative to another); an axis
counts where chance does not explain its variance. Moments of a component of variance: Searle, Casella, McCulloch,
"Variance Components", 1992.
"""

from __future__ import annotations

from collections import deque
from copy import copy
from typing import Any

import numpy as np
from scipy.special import chdtrc

from armsight.data import Array
from armsight.loop.finding import FALSE_ALARMS_PER_MINUTE

#: Terms of the polynomial that is removed of each window; half: the arm's own errors count as shaking, double: shaking
#: below 4 Hz does not.
_TERMS = 3
#: Shots of a window at the least; half: the polynomial takes most of what they show, double: slow cameras are not watched.
_LEAST = 8
#: Newest windows that count, without the share of them that varies most: a jump is in one of them, what shakes in all; and
#: how many there must be. Half: a jump counts for as long as a window does, double: shaking is found after twice the time.
_NEWEST, _ODD, _FEWEST = 20, 0.25, 2


class Unrest:
    """Estimates how much values of D numbers vary within a window beyond their noise.

    Attributes:
        cov: (D, D) covariance of what they vary beyond it; zero while chance explains it.
    """

    def __init__(self, size: int) -> None:
        self._windows: deque[tuple[Any, ...]] = deque(maxlen=_NEWEST)
        self.cov = np.zeros((size, size))

    def take(self, t_s: Array, values: Array, covs: Array, excess: float = 1.0) -> None:
        """Take a window.

        Args:
            t_s: (N,) times, s.
            values: (N, D) of its shots.
            covs: (N, D, D) covariances of their noise.
            excess: by how much the variance of the noise is larger than they say.
        """
        if len(t_s) < _LEAST or not np.ptp(t_s) > 0.0:
            return
        Q = np.linalg.qr(np.vander((t_s - t_s.mean()) / np.ptp(t_s), _TERMS))[0]
        kept = np.eye(len(t_s)) - Q @ Q.T
        left, noise = kept @ values, np.einsum("nk,kij->nij", kept**2, excess * covs)
        # A shot says of a variance as much as the square of its information.
        sizes = np.trace(np.linalg.solve(covs.mean(axis=0), noise), axis1=1, axis2=2)
        shares = 1.0 / sizes**2
        sums = (left.T * shares) @ left, np.einsum("n,nij->ij", shares, noise), shares.sum(), np.square(shares).sum()
        self._windows.append((float(np.trace(np.linalg.solve(sums[1], sums[0]))), len(t_s), *sums))
        self.cov = np.zeros_like(self.cov)
        if len(self._windows) < _FEWEST:
            return
        usual = sorted(self._windows, key=lambda each: each[0])[: -max(round(_ODD * len(self._windows)), 1)]
        _, counts, seen, expected, once, twice = (sum(part) for part in zip(*usual, strict=True))
        freedom = float(once**2 / twice) * (1.0 - _TERMS * len(usual) / counts)
        L = np.linalg.cholesky(expected / once)
        inner = np.linalg.solve(L, np.linalg.solve(L, seen / once).T)
        values, vectors = np.linalg.eigh((inner + inner.T) / 2.0)
        certain = chdtrc(freedom, freedom * values) * len(values) < FALSE_ALARMS_PER_MINUTE / 60.0
        axes = L @ vectors
        self.cov = (axes * np.where(certain, values - 1.0, 0.0)) @ axes.T

    def copied(self) -> Unrest:
        """Return a copy that windows can be tried on; this one goes on without them."""
        other = copy(self)
        other._windows = self._windows.copy()
        return other
