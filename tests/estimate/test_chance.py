"""Limits of chance against SciPy's."""

import pytest
from scipy.special import chdtrc, chdtri

from armsight.estimate.chance import chi_square_chance, chi_square_limit

CHANCES = (1e-300, 1e-30, 1e-12, 1e-4, 0.01, 0.5, 0.975, 1 - 1e-9)


@pytest.mark.parametrize("freedom", [0.5, 1, 2, 3, 6, 7, 12, 100.5, 1000, 100_000])
def test_chi_square_limits_are_scipys(freedom):
    for chance in CHANCES:
        # The chance itself is near 1 but for 1e-16, which is all that is known of its distance from 1.
        rel = 1e-10 if chance < 0.99 else 2e-6
        assert chi_square_limit(freedom, chance) == pytest.approx(float(chdtri(freedom, chance)), rel=rel)


@pytest.mark.parametrize("freedom", [0.7, 6, 123.4])
def test_chances_are_scipys(freedom):
    for square in (-1e-3, 0.0, 0.1 * freedom, freedom, 1.2 * freedom, 9.0 * freedom):
        known = 1.0 if square <= 0.0 else float(chdtrc(freedom, square))
        assert chi_square_chance(freedom, square) == pytest.approx(known, rel=1e-10)
