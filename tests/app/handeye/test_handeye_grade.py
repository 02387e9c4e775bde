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
    how = {"cov": None, "held_out": held_out, "held_out_geometry": None, "sigmas": {}}
    run = SimpleNamespace(found=SimpleNamespace(used=np.ones(used, bool), **how))
    found, sentence = report.assess(run, [])
    assert found == grade
    assert report.assess(run, [], weak=True)[0] == "fair"
    assert f"{1e3 * off_m:.2f} mm" in sentence


def test_transforms_of_the_true_arm_are_not_called_usable_with_its_nominal_model(monkeypatch):
    monkeypatch.setattr(report, "names", lambda run: ("T_base_rig", "T_tool_body"))
    monkeypatch.setattr(report, "worst_sigmas", lambda cov: (1e-4, 1e-4))
    nominal, geometry = (SimpleNamespace(rms=lambda m=m: (m, 0.0)) for m in (15e-3, 1e-3))
    how = {"cov": None, "held_out": nominal, "held_out_geometry": geometry, "sigmas": {"link_m": 3e-3}}
    found = SimpleNamespace(used=np.ones(30, bool), **how)
    for weak in (False, True):
        grade, sentence = report.assess(SimpleNamespace(found=found), [], weak=weak)
        assert grade == "fair"
        assert sentence.startswith("Usable only once armsight identify has corrected the arm's model, and not with")
        assert "off by 15.00 mm" in sentence
        assert "geometry found, 1.00 mm" in sentence
