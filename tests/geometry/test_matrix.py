"""Matrices inside kernels against numpy's: the Python that is compiled."""

import numpy as np
import pytest

from armsight.geometry import matrix

rng = np.random.default_rng(0)


def test_products_are_numpys():
    A, B, x = rng.normal(size=(7, 5)), rng.normal(size=(7, 4)), rng.normal(size=7)
    # Sums of seven products, each to half a unit of the last digit of numbers below 4.
    tolerance = 7 * np.spacing(16.0)
    np.testing.assert_allclose(matrix.product.__wrapped__(A.T, B), A.T @ B, rtol=0, atol=tolerance)
    np.testing.assert_allclose(matrix.applied.__wrapped__(A.T, x), A.T @ x, rtol=0, atol=tolerance)
    assert matrix.dot.__wrapped__(x, A[:, 0]) == pytest.approx(x @ A[:, 0], abs=tolerance)


def test_a_solution_needs_pivots_and_a_singular_matrix_has_none():
    A, B = rng.normal(size=(6, 6)), rng.normal(size=(6, 3))
    A[0, 0] = 0.0
    bound = 6 * np.finfo(float).eps * np.linalg.cond(A) * np.abs(np.linalg.solve(A, B)).max()
    np.testing.assert_allclose(matrix.solved.__wrapped__(A, B), np.linalg.solve(A, B), rtol=0, atol=bound)
    A[:, 3] = 0.0
    assert np.isnan(matrix.solved.__wrapped__(A, B)).all()
