"""Shape and finiteness checks made once, at the public door."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from armsight.errors import InputError

#: How far R R^T may be from 1 of a rotation that was computed, and of a printed one: three digits leave 1e-3, six 1e-6.
RIGID, PRINTED = 1e-6, 2e-3


def numbers(value: object) -> NDArray[np.float64]:
    """Return a value as an array of numbers.

    Raises:
        TypeError: no numbers.
        ValueError: no numbers, or rows of different lengths.
        InputError: an object, or a sequence that begins with one, that is no sequence and does not say its array: numpy
            iterates over it, and robodk's Mat (6.0.2) and USD's Gf.Matrix4d (26.11) come out transposed then.
    """
    array, inner = np.asarray(value, dtype=np.float64), value
    while isinstance(inner, Sequence) and not isinstance(inner, str) and len(inner):
        inner = inner[0]
    if not hasattr(inner, "__array__") and hasattr(inner, "__len__") and not isinstance(inner, Sequence | ctypes.Array):
        raise InputError(f"a {type(inner).__name__} may be read transposed; give its rows as a list")
    return array


def checked(value: ArrayLike, shape: tuple[int | None, ...], name: str) -> NDArray[np.float64]:
    """Return ``value`` as a finite float64 array of a shape, None for any length; InputError calls it ``name``."""
    try:
        array = numbers(value)
    except (TypeError, ValueError, InputError) as error:
        raise InputError(f"{name} must be numbers: {error}") from None
    if array.ndim != len(shape) or any(s is not None and s != n for s, n in zip(shape, array.shape, strict=True)):
        want = "(" + ", ".join("any" if s is None else str(s) for s in shape) + ")"
        raise InputError(f"{name} has shape {array.shape}, must be {want}")
    if not np.isfinite(array).all():
        raise InputError(f"{name} contains NaN or infinity; every entry must be a finite number")
    return array


def off_rotation(R: NDArray[np.float64]) -> float:
    """Return how far R R^T is from 1, of R (3, 3): 0 for rotations and mirrored ones, at least 3 for damaged numbers."""
    near = np.clip(R, -2.0, 2.0)  # squares of damaged numbers overflow
    return float(np.abs(near @ near.T - np.eye(3)).max())
