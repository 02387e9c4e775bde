"""Assertions that tests share; the one finite-difference helper every Jacobian is held against."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from armsight.errors import ArmsightError, InputError


def numeric_jacobian(f: Callable[[np.ndarray], np.ndarray], x: np.ndarray, step: np.ndarray | float) -> np.ndarray:
    """Differentiate ``f`` at ``x`` (n,) by central differences with one Richardson step: error of order step^4.

    Returns:
        (..., n) with the shape of ``f(x)`` in front.
    """
    steps = np.broadcast_to(np.asarray(step, dtype=float), x.shape)
    columns = []
    for i, h in enumerate(steps):
        e = np.zeros_like(x)
        e[i] = h
        wide, narrow = (f(x + e) - f(x - e)) / (2 * h), (f(x + e / 2) - f(x - e / 2)) / h
        columns.append((4 * narrow - wide) / 3)
    return np.stack(columns, axis=-1)


def assert_jacobian(
    analytic: np.ndarray,
    f: Callable[[np.ndarray], np.ndarray],
    x: np.ndarray,
    step: np.ndarray | float,
    rtol: float = 1e-7,
) -> None:
    """Hold an analytic derivative against finite differences, relative to the size of each column."""
    numeric = numeric_jacobian(f, np.asarray(x, dtype=float), step)
    assert analytic.shape == numeric.shape
    # What rounding of f alone leaves in a difference quotient with the halved step, per column.
    rounding = 16 * np.finfo(float).eps * np.abs(f(x)).max() / np.broadcast_to(step, np.shape(x))
    scale = np.abs(numeric).max(axis=tuple(range(numeric.ndim - 1)))
    error = np.abs(analytic - numeric).max(axis=tuple(range(numeric.ndim - 1)))
    assert (error <= rtol * scale + rounding).all(), f"columns off by {error}, allowed {rtol * scale + rounding}"


def assert_rotation(R: np.ndarray, atol: float = 1e-14) -> None:
    """Hold a matrix to be orthonormal and right-handed."""
    assert np.abs(R @ R.T - np.eye(3)).max() <= atol
    assert np.linalg.det(R) > 0


@contextmanager
def one_line(
    *texts: str, match: str | None = None, begins: object = "", error: type[ArmsightError] = InputError
) -> Iterator[None]:
    """Hold the error of a block to be one line that begins so, has some texts in it, and matches a pattern."""
    with pytest.raises(error, match=match) as caught:
        yield
    said = str(caught.value)
    assert said.startswith(str(begins))
    assert "\n" not in said
    assert [text for text in texts if text not in said] == [], said
