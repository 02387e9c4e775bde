"""Shape and finiteness checks made once, at the public door."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from armsight.errors import InputError


def checked(value: ArrayLike, shape: tuple[int | None, ...], name: str) -> NDArray[np.float64]:
    """Return ``value`` as a finite float64 array of the given shape.

    Args:
        value: anything that numpy can convert into numbers.
        shape: the required shape; ``None`` stands for any length.
        name: what the array is called in the error.

    Raises:
        InputError: not numeric, another shape, or not finite.
    """
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} must be numbers: {error}") from None
    if array.ndim != len(shape) or any(s is not None and s != n for s, n in zip(shape, array.shape, strict=True)):
        want = "(" + ", ".join("any" if s is None else str(s) for s in shape) + ")"
        raise InputError(f"{name} has shape {array.shape}, must be {want}")
    if not np.isfinite(array).all():
        raise InputError(f"{name} contains NaN or infinity; every entry must be a finite number")
    return array
