"""What a report of a hand-eye calibration calls good."""

from types import SimpleNamespace

import numpy as np
import pytest

from armsight.app.handeye import report


@pytest.mark.parametrize(("off_m", "used", "grade"), [(1e-3, 30, "good"), (3e-3, 30, "fair"), (1e-3, 8, "fair")])
def test_millimetres_on_poses_left_out_are_not_called_good(monkeypatch, off_m, used, grade):
    monkeypatch.setattr(report, "names", lambda run: ("T_base_rig", "T_tool_body"))
    monkeypatch.setattr(report, "worst_sigmas", lambda cov: (1e-4, 1e-4))
    held_out = SimpleNamespace(rms=lambda: (off_m, 0.0))
    run = SimpleNamespace(found=SimpleNamespace(used=np.ones(used, bool), cov=None, held_out=held_out))
    found, sentence = report.assess(run, [])
    assert found == grade
    assert report.assess(run, [], weak=True)[0] == "fair"
    assert f"{1e3 * off_m:.2f} mm" in sentence
