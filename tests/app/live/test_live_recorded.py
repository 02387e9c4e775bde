"""What was recorded: the tables in the folder, a column as a curve, and one row of it."""

import numpy as np
import pytest

from armsight.app.live import recorded
from armsight.app.live.recorded import MOST_POINTS, RecordedStep
from armsight.app.live.step import SessionOptions, Shared
from armsight.errors import InputError
from waiting import until


def test_any_column_of_any_table_in_the_folder_is_drawn_and_any_row_shown(tmp_path, monkeypatch):
    said, count = [], 2 * MOST_POINTS + 100
    monkeypatch.setattr(recorded, "_LOOK_S", 0.0)
    (tmp_path / "run").mkdir()
    rows = [f"{k},{k / 10},{'' if k == 3 else np.sin(k)},ok" for k in range(count)]
    (tmp_path / "run/vision.csv").write_text("\n".join(["shot,t_s,x_m,status", *rows]) + "\n")
    (tmp_path / "empty.csv").write_text("a,b\n")
    (tmp_path.parent / "outside.csv").write_text("a\n1\n")
    step = RecordedStep(Shared(SessionOptions(tmp_path), tmp_path, lambda level, text: said.append(text)))
    assert set(step.state.files) == {"run/vision.csv", "empty.csv"}
    with pytest.raises(InputError, match="no table"):
        step.open_recorded("../outside.csv")
    step.open_recorded("run/vision.csv")
    until(lambda: step.state.rows == count or said)
    state = step.state
    assert (state.fields, state.field, state.across) == (("shot", "x_m"), "shot", "t_s")
    assert "x='t_s', y='shot'" in state.command
    step.plot_field("x_m")
    points = step.state.points
    assert len(points) <= MOST_POINTS
    assert points[1] == (pytest.approx(0.3), None)  # every third row; the fourth has no number
    np.testing.assert_allclose([y for _, y in points[2:]], np.sin(3 * np.arange(2, len(points))))
    step.show_row(7.0)
    assert (step.state.row, step.state.at, step.state.values[3]) == (7, 0.7, ("status", "ok"))
    for wrong, words in ((lambda: step.plot_field("status"), "no column"), (lambda: step.show_row(1e9), "no row")):
        with pytest.raises(InputError, match=words):
            wrong()
    with monkeypatch.context() as patched:  # of a long table every second row and more
        patched.setattr("armsight.files.DOCUMENT_MB", 1e-6)
        patched.setattr(recorded, "_MOST_ROWS", count // 2)
        step.open_recorded("run/vision.csv")
        until(lambda: step.state.rows < count or said)
        assert count // 3 <= step.state.rows <= count // 2
        assert step.state.across == "t_s"
    step.open_recorded("empty.csv")
    until(lambda: step.state.rows == 0 or said)
    assert (step.state.field, step.state.points, said) == ("", (), [])
    step.close()
