"""The checks at the public door: what passes, and what each rejection says."""

import numpy as np
import pytest

from armsight.errors import InputError
from armsight.geometry.check import checked


def test_lists_of_numbers_pass():
    out = checked([[1, 2], [3, 4]], (None, 2), "points")
    assert out.dtype == np.float64
    np.testing.assert_array_equal(out, [[1, 2], [3, 4]])


@pytest.mark.parametrize(
    ("value", "shape", "message"),
    [
        (["a"], (None,), "points must be numbers"),
        ([[1, 2], [3]], (None, 2), "points must be numbers"),
        ([1, 2, 3], (2,), r"points has shape \(3,\), must be \(2\)"),
        ([1, 2, 3], (None, 3), r"points has shape \(3,\), must be \(any, 3\)"),
        ([1, np.nan], (2,), "points contains NaN or infinity"),
        ([1, -np.inf], (2,), "points contains NaN or infinity"),
    ],
)
def test_errors_say_what_is_wrong(value, shape, message):
    with pytest.raises(InputError, match=message):
        checked(value, shape, "points")
