import json

import numpy as np
import pytest
from scipy.stats import chi2

from armsight.app import demo
from armsight.app.cli import demo as command
from armsight.sim.bench import demo_recording
from armsight.vision.rig import StereoRig


@pytest.fixture
def small(monkeypatch):
    """Make the demo's recording small: eight pairs of the board and six shots."""

    def recording(folder, *, seed=0):
        return demo_recording(folder, seed=seed, image_size_px=(640, 360), boards=8, shots=6, rate_hz=2.0)

    monkeypatch.setattr(demo, "demo_recording", recording)


def test_the_demo_does_the_main_job_and_tells_the_error(small, armsight, tmp_path, monkeypatch):
    monkeypatch.setattr(command, "write_report", lambda calibration, folder: folder.mkdir())  # it has its own tests
    said = armsight("demo", "-o", tmp_path / "demo", "--json")
    assert said.code == 0, said.err
    (s,) = said.lines
    assert s["measured"] == s["shots"] == 6
    # Each squared error in sigmas is chi-square of three degrees of freedom, the calibration's share common to all.
    for kind in ("position", "orientation"):
        unit = "m" if kind == "position" else "rad"
        rms, sigma, worst = (s[f"{kind}_{what}_{unit}"] for what in ("rms", "sigma_rms", "max"))
        assert rms <= worst
        assert rms < np.sqrt(chi2.ppf(0.9999, 3) / 3) * sigma
    assert 0 < s["heldout_epipolar_rms_px"] < 0.05
    true, rig = (StereoRig.load(tmp_path / "demo" / name) for name in ("board/truth_rig.json", "rig.json"))
    assert s["baseline_error_m"] == pytest.approx(rig.baseline_m - true.baseline_m, abs=1e-15)
    assert s["focal_error_px"] == pytest.approx(rig.left.intrinsics[0] - true.left.intrinsics[0], abs=1e-12)
    for name in ("demo.png", "pose.png", "poses.csv", "plate.toml", "arm/shots.csv"):
        assert (tmp_path / "demo" / name).stat().st_size > 0
    assert len((tmp_path / "demo" / "poses.csv").read_text().splitlines()) == 7
    # What it wrote is a recording: the commands a user would type next run on it.
    again = armsight(
        "measure", tmp_path / "demo" / "rig.json", "--target", tmp_path / "demo" / "plate.toml", "--source",
        tmp_path / "demo" / "arm", "--json",
    )  # fmt: skip
    assert [json.dumps(line["position_m"]) for line in again.lines]
    assert all(line["status"] == "ok" for line in again.lines)


def test_people_read_millimetres(armsight, tmp_path, monkeypatch):
    summary = {
        "shots": 4, "measured": 4, "inside_95_share": 1.0, "heldout_epipolar_rms_px": 0.01, "heldout_rigid_rms_m": 2e-5,
        "baseline_error_m": -1e-5, "focal_error_px": 0.1,
        **{f"position_{k}_m": 1.25e-4 for k in ("rms", "max", "sigma_rms")},
        **{f"orientation_{k}_rad": np.pi / 180 for k in ("rms", "max", "sigma_rms")},
    }  # fmt: skip

    class Result:
        calibration = None

        def summary(self):
            return summary

    monkeypatch.setattr(command, "run_demo", lambda folder, **options: Result())
    monkeypatch.setattr(command, "write_report", lambda *arguments: None)
    monkeypatch.setattr(command, "write_figure", lambda *arguments: None)
    said = armsight("demo", "-o", tmp_path)
    assert said.code == 0
    assert "0.1250 mm" in said.out
    assert "1.0000 deg" in said.out
    assert "baseline off by -0.0100 mm" in said.out


def test_a_demo_where_a_file_stands(armsight, tmp_path):
    (tmp_path / "demo").write_text("mine")
    said = armsight("demo", "-o", tmp_path / "demo")
    assert said.code == 2
    assert len(said.err.splitlines()) == 1
    assert str(tmp_path / "demo") in said.err
    assert (tmp_path / "demo").read_text() == "mine"


@pytest.mark.parametrize("options", [("--seed", "-1"), ("--seed", "many"), ("--speed", "9")])
def test_options_typed_wrong(armsight, options):
    assert armsight("demo", *options).code == 2
