"""Residuals near a state, with the sources of their errors.

A source is independent (every measurement has its own errors, by its own map) or shared (constant errors that all
measurements see, each through its columns: a link of an arm, or a smooth function of time or pose by a factor of its
kernel). Each source has one unknown variance; one of variance zero is not there.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Record

MAX_RANK, LEAST_LEFT = 24, 1e-3  # columns of a kernel's factor at most, and the share of its trace that is left out


@dataclass(frozen=True, eq=False)
class Linear(Record):
    """Residuals near a state: e + J x, and what their errors come from."""

    e: Array  #: (N, m) residuals
    J: Array  #: (N, m, P) their derivative by the unknowns
    given: Array  #: (N, m, m) covariance that is known
    own: dict[str, Array]  #: source -> (N, m, k) what k unit errors of a measurement alone do to it
    shared: dict[str, Array]  #: source -> (N, m, c) what c unit errors that all measurements share do to each
    known: Array  #: (P,) information about each unknown beside the residuals, zero for most
    at: Array  #: (P,) where each unknown is, from where that information has it

    @property
    def sources(self) -> tuple[str, ...]:
        """Names of all sources, independent ones first."""
        return (*self.own, *self.shared)

    def of(self, names: Collection[str]) -> Linear:
        """Return the same residuals with these sources alone."""
        own, shared = ({k: M for k, M in of.items() if k in names} for of in (self.own, self.shared))
        return replace(self, own=own, shared=shared)

    def rows(self, rows: NDArray[np.int64]) -> Linear:
        """Return a part of the measurements."""
        own, shared = ({k: M[rows] for k, M in of.items()} for of in (self.own, self.shared))
        return replace(self, e=self.e[rows], J=self.J[rows], given=self.given[rows], own=own, shared=shared)


def factor(kernel: Array) -> Array:
    """Return F (N, c) with F F^T near a kernel (N, N), by Cholesky with pivots (Harbrecht et al., APNUM 62, 2012)."""
    left, F = np.diag(kernel).copy(), np.zeros((len(kernel), 0))
    least = LEAST_LEFT * left.sum()
    while F.shape[1] < min(MAX_RANK, len(kernel)) and left.sum() > least:
        k = int(left.argmax())
        column = (kernel[:, k] - F @ F[k]) / np.sqrt(left[k])
        F, left = np.column_stack([F, column]), np.maximum(left - column**2, 0.0)
    return F


def spread(F: Array, M: Array) -> Array:
    """Return the columns (N, m, c k) of errors (N, c) of each of the k columns of a map M (N, m, k)."""
    return np.asarray(np.einsum("nc,nmk->nmck", F, M).reshape(*M.shape[:2], -1))
