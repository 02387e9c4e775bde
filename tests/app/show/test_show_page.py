"""Pages of reports."""

import pytest

from armsight.app.show.page import table


def test_every_cell_of_a_table_is_shown_or_the_row_is_an_error():
    assert table(("", "a", "b"), [("row", "1", "2")]).count("<td") == 2
    for cells in (("row", "1"), ("row", "1", "2", "3")):
        with pytest.raises(ValueError, match="zip"):
            table(("", "a", "b"), [cells])
