"""Progress where stderr is no terminal."""

from __future__ import annotations

import pytest

from armsight.app import progress


def test_a_line_every_few_seconds_where_stderr_is_no_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nothing within the first seconds, then the newest line each time some have passed."""
    now_s = 100.0
    monkeypatch.setattr(progress.time, "monotonic", lambda: now_s)
    with progress.steps() as say, progress.bar("shots", 9) as advance:
        for now_s in (101.0, 106.0, 107.0, 112.0):
            say(f"at {now_s:g}")
            advance()
    assert capsys.readouterr().err.splitlines() == ["at 106", "shots: 2 of 9", "at 112", "shots: 4 of 9"]
