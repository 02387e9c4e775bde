"""Pages of reports."""

import pytest

from armsight.app.show.page import bullets, table


def test_every_cell_of_a_table_is_shown_or_the_row_is_an_error():
    assert table(("", "a", "b"), [("row", "1", "2")]).count("<td") == 2
    for cells in (("row", "1"), ("row", "1", "2", "3")):
        with pytest.raises(ValueError, match="zip"):
            table(("", "a", "b"), [cells])


def test_what_is_to_be_typed_is_code_on_a_page():
    listed = bullets(["type `armsight check <RUN>`, or a ` alone"])
    assert "type <code>armsight check &lt;RUN&gt;</code>, or a ` alone" in listed
