"""A length that cannot be one is rejected with the unit in which it would be."""

import pytest

from armsight.errors import InputError
from armsight.tables.lengths import BASELINE, REACH, check_length, fitting_unit


@pytest.mark.parametrize(
    ("number", "unit_m", "fits"),
    [(60.0, 1.0, "mm"), (0.06, 1e-3, "m"), (0.06, 1.0, None), (60.0, 1e-3, None), (25.0, 1.0, "mm"), (3.14, 1.0, None)],
)
def test_the_unit_of_a_baseline(number, unit_m, fits):
    assert fitting_unit(number * unit_m, unit_m, BASELINE) == fits
    if fits is None:
        check_length(number * unit_m, unit_m, BASELINE)
    else:
        with pytest.raises(
            InputError, match=rf"expected 1 mm to 20 m. If the file is in {fits}, it is .*give --unit-m"
        ):
            check_length(number * unit_m, unit_m, BASELINE)


def test_what_no_unit_makes_ordinary_is_rejected_without_one():
    with pytest.raises(InputError, match=r"farthest position 1e.09 m.*is the file damaged"):
        check_length(1e9, 1.0, REACH)


def test_the_message_names_what_was_found_what_is_expected_and_the_option():
    with pytest.raises(InputError) as caught:
        check_length(60.0, 1.0, BASELINE)
    assert str(caught.value) == (
        "baseline 60 m, with the file's lengths in m; expected 1 mm to 20 m. If the file is in mm, it is 60 mm: give "
        "--unit-m 0.001. If the file is in cm, it is 600 mm: give --unit-m 0.01. If the file is in inches, it is 1.524 m: "
        "give --unit-m 0.0254"
    )
