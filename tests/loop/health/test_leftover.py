"""What processed images leave in positions is in the noise of each test; what changed is found beside it."""

import numpy as np
import pytest
from faults import watched_body

from armsight.loop.health.passing import Leftover
from armsight.loop.health.residuals import ResidualSums

OTHERS, LENS, ROWS, SEVEN = 9, 20, 400, slice(3, 10)  # of the rows, the residual is the first


def sums_of(rng, tau_px, noise, change, count=12):
    """Sums of tests: derivatives of what may have changed, of coefficients that are others in each test, and noise."""
    for _ in range(count):
        A, L = rng.normal(size=(ROWS, OTHERS)), 30.0 * rng.normal(size=(ROWS, LENS))
        r = A @ change + L @ rng.normal(0.0, tau_px, LENS) + np.sqrt(noise) * rng.normal(size=ROWS)
        rows = np.column_stack([r, A, L])
        yield ResidualSums(rows.T @ rows, float(ROWS))


@pytest.mark.parametrize("tau_px", [0.0, 0.008, 0.03])
@pytest.mark.parametrize("noise", [1.0, 6.0])
@pytest.mark.parametrize("change", [0.0, 1.5])
def test_its_size_and_the_noise_are_found_whatever_changed(tau_px, noise, change):
    left, noises = Leftover(), []
    for sums in sums_of(np.random.default_rng(3), tau_px, noise, np.full(OTHERS, change)):
        found, evidence = left.seen(sums, LENS, 0, SEVEN, 1.0)
        left.passed(left.without(sums, LENS, found))
        left.take(evidence)
        noises.append(found)
    assert np.mean(noises) == pytest.approx(noise, rel=0.1)  # at least 1; 12 tests of 375 numbers scatter by 2 %
    assert left.tau_px == pytest.approx(tau_px, rel=0.3, abs=2e-3)  # among powers of two


def test_without_it_a_change_has_the_covariance_of_what_it_leaves():
    """Estimates of no change, over their covariances, of many tests: chi-square."""
    left, squares = Leftover(), []
    for k, sums in enumerate(sums_of(np.random.default_rng(4), 0.016, 4.0, np.zeros(OTHERS), 200)):
        noise, evidence = left.seen(sums, LENS, 0, SEVEN, 1.0)
        left.take(evidence)
        rest = left.without(sums, LENS, noise)
        if k > 20:
            squares.append(rest.b @ np.linalg.solve(rest.H, rest.b))
    assert np.mean(squares) == pytest.approx(OTHERS, abs=4 * np.sqrt(2 * OTHERS / len(squares)))


def test_one_test_whose_points_scatter_much_does_not_hide_the_others():
    """Its sums count by its own noise."""
    left = Leftover()
    (calm,), (wild,) = (sums_of(np.random.default_rng(5), 0.0, noise, np.zeros(OTHERS), 1) for noise in (1.0, 100.0))
    rest = [left.without(each, LENS, left.seen(each, LENS, 0, SEVEN, 1.0)[0]) for each in (calm, wild)]
    assert np.trace(rest[1].H) < 0.02 * np.trace(rest[0].H)


def test_what_was_said_of_times_is_forgotten_once_they_are_found():
    *_, (monitor, *_) = watched_body(7401, row_s=2e-5, seconds=6.0)
    assert "time" in [each.cause for each in monitor.findings()]
    monitor.times_found()
    assert monitor.findings() == ()
