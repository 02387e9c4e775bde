"""Forward selection: which unknowns lower the error on measurements left out, scored on one linearisation.

In: :class:`~armsight.estimate.linear.Linear` with the variances of its own sources, and the fold of every measurement. Out:
the held-out losses of every choice of unknowns, of one more (:class:`Folds`), or of one less (:class:`Removal`).

With each fold's H = J^T J and g = J^T e, a fit to the other folds and its squared error on this one are a few small matrix
products. One factorisation scores all candidates of a step, by Schur complements to add and by rows of the inverse to
remove, so that hundreds of models cost little more than one.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Record
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


@dataclass(frozen=True, eq=False)
class Folds(Record):
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

    @cached_property
    def others(self) -> tuple[Array, Array]:
        """(F, P, P), (F, P): the sums over all folds but each."""
        return self.H.sum(axis=0) - self.H, self.g.sum(axis=0) - self.g

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
        H, g = self.others
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
        rows, others, (H, g) = np.flatnonzero(kept), np.flatnonzero(beyond), self.others
        slope = g[:, others] + (H[:, others] @ delta[..., None])[..., 0]
        tried = np.repeat(delta[..., None], len(groups), axis=2)
        for c, mask in enumerate(groups.values()):
            at = np.flatnonzero(mask[others])
            own = others[at]
            A = H[:, own[:, None], own] + np.diag(self.pull[own]) - H[:, own[:, None], rows] @ X[:, :, at]
            scale = 1 / np.sqrt(np.einsum("fii->fi", A))
            z = (
                np.linalg.solve(A * scale[:, :, None] * scale[:, None], (-slope[:, at] * scale)[..., None])
                * scale[..., None]
            )
            tried[:, own, c] += z[..., 0]
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
    """Fits of what is kept to all but each fold and, last, to all, from which groups are removed one after the other.

    The fit without a group G follows from that with it: with C = A^-1, the free numbers move by C_:G C_GG^-1 times what
    brings those of G back to nominal, and C falls by C_:G C_GG^-1 C_G:.
    """

    def __init__(self, folds: Folds, kept: Mask) -> None:
        self.folds, self.kept = folds, kept.copy()
        self.rows = np.flatnonzero(kept)
        nothing = np.zeros_like(folds.H[:1]), np.zeros_like(folds.g[:1])  # without it all measurements are fitted
        H, g = (np.concatenate(both) for both in zip((folds.H, folds.g), nothing, strict=True))
        self.delta, self.C, _ = replace(folds, H=H, g=g).fits(kept)

    def losses(self) -> Array:
        """Return the losses (F,) of what is kept."""
        return np.asarray(self.folds.losses_at(self.delta[:-1, :, None])[0])

    def losses_without(self, groups: Sequence[Mask]) -> Array:
        """Return the losses (G, F) without each group."""
        tried = np.repeat(self.delta[:-1, :, None], len(groups), axis=2)
        for some, at in self._by_size(groups):
            pull = self._pull(at, slice(-1))[1]
            tried[:, self.rows[:, None], some] += np.einsum("fsgk,fgk->fsg", self.C[:-1, :, at], pull)
        return self.folds.losses_at(tried)

    def _by_size(self, groups: Sequence[Mask]) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
        """Yield which groups have one size, and where their numbers (G, k) stand among the free ones."""
        at = [np.flatnonzero(mask[self.rows]) for mask in groups]
        for size in sorted({len(each) for each in at}):
            some = np.array([c for c, each in enumerate(at) if len(each) == size])
            yield some, np.array([at[c] for c in some])

    def _pull(self, at: NDArray[np.int64], fits: slice) -> tuple[Array, Array]:
        """Return by how much groups ``at`` (G, k) are off nominal in fits (F, G, k), and what brings them back."""
        back = (self.folds.home - self.delta[fits])[:, self.rows[at]]
        C = self.C[fits, at[..., None], at[:, None]]
        return back, np.asarray(np.linalg.solve(C, back[..., None])[..., 0], np.float64)

    def doubtful(self, groups: Sequence[Mask]) -> list[Mask]:
        """Return the groups so near their nominal values, in the fit to all, that leaving them there may cost nothing."""
        near = np.zeros(len(groups), bool)
        for some, at in self._by_size(groups):
            back, pull = self._pull(at, slice(-1, None))
            near[some] = (back * pull).sum(axis=2)[0] < SURE**2 * at.shape[1]
        return [mask for mask, doubt in zip(groups, near, strict=True) if doubt]

    def remove(self, mask: Mask) -> None:
        """Remove a group."""
        at = np.flatnonzero(mask[self.rows])
        pull = self._pull(at[None], slice(None))[1][:, 0]
        self.delta[:, self.rows] += (self.C[:, :, at] @ pull[..., None])[..., 0]
        self.delta[:, self.rows[at]] = self.folds.home[self.rows[at]]
        stay = np.flatnonzero(~mask[self.rows])
        fall = np.linalg.solve(self.C[:, at[:, None], at], self.C[:, at[:, None], stay])
        self.C = self.C[:, stay[:, None], stay] - self.C[:, stay[:, None], at] @ fall
        self.rows, self.kept = self.rows[stay], self.kept & ~mask
