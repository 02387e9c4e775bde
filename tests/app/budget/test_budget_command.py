"""``armsight budget``: what a small plan says, its page, and what is rejected."""

import json

import numpy as np
import pytest

from armsight.app.budget import report
from armsight.app.budget.chart import marker_noise
from armsight.app.budget.plan import RigPlan, catalogue, planned
from armsight.errors import InputError
from armsight.sim.camera.stages import CameraPipeline
from cli_runs import assert_rejected

#: Of the highest price: no better class is tried.
SMALL = ("--volume", "0.1x0.1x0.1m", "--distance", "0.7m", "--camera", "machine-vision-2mp")


def test_answer_table_and_page(armsight, tmp_path, monkeypatch):
    few = ("measure at rest", "twice as many pairs of the board")
    monkeypatch.setattr(report, "_CHANGES", {name: report._CHANGES[name] for name in few})
    given = (*SMALL, "--want", "0.5mm", "--speed", "0.2m/s", "--arm", "ar4", "-o", tmp_path / "out")
    said = armsight("budget", *given, "--json")
    found = json.loads(said.out)
    assert said.code == 0
    assert found["results"]["moving"]["level_m"] > found["results"]["at_rest"]["level_m"] > 0
    assert found["results"]["closed_loop_at_rest"]["level_m"] > found["results"]["at_rest"]["level_m"]
    shares = sum(cause["share"] for cause in found["causes"])
    assert shares == pytest.approx(1.0, abs=0.05)  # skew and readout share a velocity; here neither is there
    page = (tmp_path / "out" / "report.html").read_text()
    assert "requested 0.5 mm" in page
    assert len(page) < 1_000_000
    assert json.loads((tmp_path / "out" / "budget.json").read_text())["causes"] == found["causes"]


def test_a_file_says_the_same_as_options(tmp_path):
    path = tmp_path / "plan.toml"
    path.write_text('volume = "100x100x100mm"\ndistance = "70cm"\ncamera = "global-shutter-1mp"\npairs = 12\n')
    by_file, by_option = (
        RigPlan.read(str(path)),
        RigPlan(volume="0.1x0.1x0.1m", distance="0.7m", camera="global-shutter-1mp", pairs=12),
    )
    np.testing.assert_allclose(planned(by_file).cov(), planned(by_option).cov())
    path.write_text("pair = 12\n")
    with pytest.raises(InputError, match="did you mean pairs"):
        RigPlan.read(str(path))


def test_noise_is_what_the_detector_shows():
    # White noise alone: the fit's sigma falls as the rim grows, with the root of the diameter.
    clean = CameraPipeline.load("clean")
    small, large = marker_noise(clean, "disc", 9.0), marker_noise(clean, "disc", 36.0)
    assert small / large == pytest.approx(2.0, rel=0.25)
    assert marker_noise(CameraPipeline.load("cheap-webcam"), "disc", 16.0) > 5 * marker_noise(clean, "disc", 16.0)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"volume": "400x400x300m"}, "is it in mm"),
        ({"volume": "0.4x0.4"}, "width x height x depth"),
        ({"volume": "0.2x0.2x0.8m", "distance": "0.3m"}, "behind the cameras; a distance above 0.4 m"),
        ({"distance": "800"}, "with its unit"),
        ({"speed": "300m/s"}, "is it in mm/s"),
        ({"want": "0.1"}, "expected"),
        ({"camera": "webcam-720"}, "did you mean webcam-720p"),
        ({"volume": "0.01x0.01x0.01m", "distance": "0.2m"}, "does not focus nearer than 0.3 m"),
        ({"volume": "1x1x0.1m"}, "the field of view is"),
        ({"volume": "0.1x0.1x0.1m", "verging_deg": 90.0}, "look past each other"),
        ({"volume": "0.1x0.1x0.1m", "baseline": "3m"}, "the arm would cross it"),
        ({"volume": "0.1x0.1x0.1m", "distance": "3m"}, "at least 8 are needed"),
        ({"exposure_ms": 50.0}, "longer than a frame at 30 Hz"),
        ({"camera": "machine-vision-5mp", "rate_hz": 60.0}, "one USB controller carries .* at 34.7 Hz at most"),
        ({"volume": "0.1x0.1x0.1m", "pairs": 2}, "pairs is 2: expected 3 to 1000"),
    ],
)
def test_what_cannot_be_built_is_rejected_with_the_nearest(given, message):
    with pytest.raises(InputError, match=message) as said:
        RigPlan(**given).check()
    assert "\n" not in str(said.value)


def test_wrong_units_are_one_line(armsight):
    assert_rejected(armsight("budget", "--volume", "400x400x300m"), "is it in mm")


@pytest.mark.parametrize("name", sorted(catalogue()))
def test_every_class_can_be_built(name):
    RigPlan(volume="0.05x0.05x0.05m", distance="0.8m", camera=name).check()


@pytest.mark.parametrize(
    ("key", "value"), [("rate_hz", "0"), ("body_scale", "0"), ("warming_k", "nan"), ("pairs", "2"), ("skew_ms", "-5")]
)
def test_numbers_that_no_rig_has_are_named(armsight, tmp_path, key, value):
    (tmp_path / "plan.toml").write_text(f"{key} = {value}\n")
    assert_rejected(armsight("budget", tmp_path / "plan.toml"), key)


def test_a_length_with_two_points_is_named(armsight):
    assert_rejected(armsight("budget", "--distance", "0..8m"), "0..8m")


def test_what_was_given_is_not_said_to_be_chosen(armsight):
    said = armsight("budget", *SMALL)
    chosen = next(line for line in said.err.splitlines() if "chosen" in line)
    assert "distance" not in chosen
    assert "camera" not in chosen
    assert "baseline 200mm" in chosen
