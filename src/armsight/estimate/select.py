"""Forward selection: which unknowns lower the error on measurements left out, scored on one linearisation.

In: :class:`~armsight.estimate.linear.Linear` with the variances of its own sources, and the fold of every measurement. Out:
the held-out losses of every choice of unknowns, of one more (:class:`Folds`), or of one less (:class:`Removal`).

With each fold's H = J^T J and g = J^T e, a fit to the other folds and its squared error on this one are a few small matrix
products. One factorisation scores all candidates of a step, by Schur complements to add and by rows of the inverse to
remove, so that hundreds of models cost little more than one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array
from armsight.estimate.linear import Linear
from armsight.estimate.solve import whitened

Mask = NDArray[np.bool_]
#: An error source is added where it lowers the held-out squares by this many standard errors of the fall over the folds.
MIN_GAIN = 1.0
SURE = 8.0  # parameters further from nominal than this many sigmas are kept without trying their removal
ROUNDING = 1e-6  # a fall by less than this part is rounding's
#: Mean squared errors, in squared sigmas of the noise, below which an error is no longer noise but rounding: (1e-4)^2.
NOISELESS = 1e-8
_NONE = 1e-200  # added to squares, so that the logarithm of none is a number
_ROUNDED = 1e-10  # a difference of large numbers below this part of them is rounding


class Folds(NamedTuple):
    """Normal equations of every fold at one linearisation."""

    H: Array  #: (F, P, P) each fold's J^T J
    g: Array  #: (F, P) each fold's J^T e
    c: Array  #: (F,) its squared residuals
    numbers: Array  #: (F,) how many numbers were measured in it
    pull: Array  #: (P,) information that the priors add
    home: Array  #: (P,) where they pull to, from the linearisation

    @staticmethod
    def of(linear: Linear, variances: Array, labels: NDArray[np.int64]) -> Folds:
        """Sum up the normal equations, of residuals without shared sources, by fold: labels (N,) from 0."""
        e, J = whitened(linear, variances)
        parts = [labels == k for k in range(int(labels.max()) + 1)]
        rows = [(e[part].ravel(), J[part].reshape(-1, J.shape[2])) for part in parts]
        H, g = np.array([Jk.T @ Jk for _, Jk in rows]), np.array([Jk.T @ ek for ek, Jk in rows])
        c, numbers = (np.array(values, float) for values in zip(*((ek @ ek, ek.size) for ek, _ in rows), strict=True))
        return Folds(H, g, c, numbers, linear.known, -linear.at)

    def losses(self, free: Mask) -> Array:
        """Return the mean squared error of every fold (F,) under a fit of ``free`` to the others."""
        return np.asarray(self.losses_at(self.fits(free)[0][..., None])[0])

    def losses_at(self, delta: Array) -> Array:
        """Return the mean squared error of every fold (C, F) at each fold's vectors (F, P, C), from the linearisation."""
        by_slope = 2 * (self.g[:, None] @ delta)[:, 0]
        by_bend = np.einsum("fpc,fpc->fc", delta, self.H @ delta)
        # Poses without noise: below this a difference of large numbers is rounding.
        least = _ROUNDED * (self.c[:, None] + np.abs(by_slope) + np.abs(by_bend))
        return np.asarray((np.maximum(self.c[:, None] + by_slope + by_bend, least) / self.numbers[:, None]).T)

    def fits(self, free: Mask, beyond: Mask | None = None) -> tuple[Array, Array, Array]:
        """Fit ``free`` to all but each fold.

        Args:
            free: (P,) the S parameters to fit; the others are nominal.
            beyond: (P,) R others; None: none.

        Returns:
            The vectors (F, P), from the linearisation; the inverses (F, S, S) of the information about ``free``; and (F,
            S, R) by how much the fit of each free parameter falls with one unit of each of the others.
        """
        rows = np.flatnonzero(free)
        others = np.flatnonzero(beyond) if beyond is not None else rows[:0]
        fixed = np.where(free, 0.0, self.home)  # from the linearisation back to nominal
        H, g = self.H.sum(axis=0) - self.H, self.g.sum(axis=0) - self.g
        A = H[:, rows[:, None], rows] + np.diag(self.pull[rows])
        scale = 1 / np.sqrt(np.einsum("fii->fi", A))
        C = np.linalg.inv(A * scale[:, :, None] * scale[:, None]) * scale[:, :, None] * scale[:, None]
        b = g[:, rows] + H[:, rows] @ fixed - (self.pull * self.home)[rows]
        delta = np.broadcast_to(fixed, self.g.shape).copy()
        delta[:, rows] = -(C @ b[..., None])[..., 0]
        return delta, C, C @ H[:, rows[:, None], others]

    def losses_with(self, kept: Mask, groups: Mapping[str, Mask]) -> dict[str, Array]:
        """Return the losses (F,) under a fit of ``kept`` and each group: one factorisation for all of the groups.

        With A the information, S the parameters kept and G a group, the information about G beyond S is Schur's complement
        A_GG - A_GS A_SS^-1 A_SG.
        """
        beyond = np.any(list(groups.values()), axis=0) & ~kept
        delta, _, X = self.fits(kept, beyond)
        rows, others = np.flatnonzero(kept), np.flatnonzero(beyond)
        H, g = self.H.sum(axis=0) - self.H, self.g.sum(axis=0) - self.g
        schur = H[:, others[:, None], others] + np.diag(self.pull[others]) - H[:, others[:, None], rows] @ X
        slope = g[:, others] + (H[:, others] @ delta[..., None])[..., 0]
        tried = np.repeat(delta[..., None], len(groups), axis=2)
        for c, mask in enumerate(groups.values()):
            at = np.flatnonzero(mask[others])
            A = schur[:, at[:, None], at]
            scale = 1 / np.sqrt(np.einsum("fii->fi", A))
            z = (
                np.linalg.solve(A * scale[:, :, None] * scale[:, None], (-slope[:, at] * scale)[..., None])
                * scale[..., None]
            )
            tried[:, others[at], c] += z[..., 0]
            tried[:, rows, c] -= (X[:, :, at] @ z)[..., 0]
        return dict(zip(groups, self.losses_at(tried), strict=True))

    def rms(self, losses: Array) -> float:
        """Return the RMS of all folds: the geometric mean of theirs, which one pose that nothing explains cannot rule."""
        return float(np.exp(0.5 * self.score(losses) / self.numbers.sum()))

    def score(self, losses: Array) -> float:
        """Return the held-out squares' logarithms, summed over the measured numbers: minus twice a log likelihood."""
        return float(np.sum(np.log(losses + _NONE) * self.numbers))

    def improves(self, without: Array, with_it: Array) -> bool:
        """Return whether the fall of the held-out squares' logarithms is more than chance over the folds."""
        fall = np.log(np.maximum(without, NOISELESS) / np.maximum(with_it, NOISELESS)) * self.numbers
        return bool(fall.sum() > max(MIN_GAIN * np.sqrt(len(fall)) * fall.std(ddof=1), ROUNDING * self.numbers.sum()))


class Removal:
    """Fits of what is kept to all but each fold, from which groups are removed one after the other.

    The fit without a group G follows from that with it: with C = A^-1, the free numbers move by C_:G C_GG^-1 times what
    brings those of G back to nominal, and C falls by C_:G C_GG^-1 C_G:.
    """

    def __init__(self, folds: Folds, kept: Mask) -> None:
        self.folds, self.kept = folds, kept.copy()
        self.rows = np.flatnonzero(kept)
        self.delta, self.C, _ = folds.fits(kept)

    def losses(self) -> Array:
        """Return the losses (F,) of what is kept."""
        return np.asarray(self.folds.losses_at(self.delta[..., None])[0])

    def losses_without(self, groups: Sequence[Mask]) -> Array:
        """Return the losses (G, F) without each group."""
        tried = np.repeat(self.delta[..., None], len(groups), axis=2)
        for c, mask in enumerate(groups):
            tried[:, self.rows, c] += self._moved(np.flatnonzero(mask[self.rows]))
        return self.folds.losses_at(tried)

    def _moved(self, at: NDArray[np.int64]) -> Array:
        """Return by how much the free numbers (F, S) move when those ``at`` come back to nominal."""
        back = (self.folds.home - self.delta)[:, self.rows[at]]
        return np.asarray((self.C[:, :, at] @ np.linalg.solve(self.C[:, at[:, None], at], back[..., None]))[..., 0])

    def doubtful(self, groups: Sequence[Mask]) -> list[Mask]:
        """Return the groups so near their nominal values that leaving them there may cost nothing."""
        folds, rows = self.folds, self.rows
        A = folds.H.sum(axis=0)[np.ix_(rows, rows)] + np.diag(folds.pull[rows])
        scale = 1 / np.sqrt(np.diag(A))
        cov = np.linalg.inv(scale[:, None] * A * scale) * np.outer(scale, scale)
        fixed = np.where(self.kept, 0.0, folds.home)
        b = folds.g.sum(axis=0)[rows] + folds.H.sum(axis=0)[rows] @ fixed - (folds.pull * folds.home)[rows]
        off = -cov @ b - folds.home[rows]
        found = []
        for mask in groups:
            at = np.flatnonzero(mask[rows])
            if off[at] @ np.linalg.solve(cov[np.ix_(at, at)], off[at]) < SURE**2 * len(at):
                found.append(mask)
        return found

    def remove(self, mask: Mask) -> None:
        """Remove a group."""
        at = np.flatnonzero(mask[self.rows])
        self.delta[:, self.rows] += self._moved(at)
        self.delta[:, self.rows[at]] = self.folds.home[self.rows[at]]
        stay = np.flatnonzero(~mask[self.rows])
        fall = np.linalg.solve(self.C[:, at[:, None], at], self.C[:, at[:, None], stay])
        self.C = self.C[:, stay[:, None], stay] - self.C[:, stay[:, None], at] @ fall
        self.rows, self.kept = self.rows[stay], self.kept & ~mask
