"""Sums of the squared residuals of measured poses: the normal equations of what explains them."""

from __future__ import annotations

import numpy as np


class ResidualSums:
    """Information (K, K), right side (K,), sum of squares and degrees of freedom of residuals, and when they began."""

    def __init__(self, size: int, begin_s: float) -> None:
        self.H, self.b, self.square, self.freedom = np.zeros((size, size)), np.zeros(size), 0.0, 0.0
        self.begin_s = begin_s

    def add(self, other: ResidualSums, weight: float) -> None:
        """Add another's."""
        self.H += other.H if weight == 1.0 else weight * other.H
        self.b += weight * other.b
        self.square += weight * other.square
        self.freedom += weight * other.freedom

    def of(self, size: int) -> ResidualSums:
        """Return those of the first parameters alone."""
        found = ResidualSums(size, self.begin_s)
        found.H, found.b = self.H[:size, :size].copy(), self.b[:size].copy()
        found.square, found.freedom = self.square, self.freedom
        return found

    def less(self, other: ResidualSums) -> ResidualSums:
        """Return these sums without another's."""
        rest = ResidualSums(len(self.b), self.begin_s)
        rest.add(self, 1.0)
        rest.add(other, -1.0)
        return rest
