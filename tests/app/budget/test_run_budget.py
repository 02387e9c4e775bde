"""A run beside its budget: a folder of a run whose right camera is three times as late as its plan says."""

import json

import numpy as np
import pytest

from armsight.app.budget.run import against_run, run_plan
from armsight.app.run.tracks import ToolTrack, columns, write_columns
from armsight.files import write_text
from armsight.geometry.pose import exp_se3, pose
from armsight.sim.budget import result
from armsight.sim.budget.plan import RigPlan
from armsight.sim.workcell.body import body_text
from armsight.vision.pose.posefit import PixelObservations, fit_pose
from cli_runs import assert_rejected

PLAN = RigPlan(volume="0.1x0.1x0.1m", camera="global-shutter-1mp", speed="0.1m/s")
LATE_S, NOISE_PX = 0.006, 0.02


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Return the folder: 3 s at rest, 6 s in motion, 3 s at rest at 30 Hz, the poses by the real fit."""
    folder, rng, rig = tmp_path_factory.mktemp("run"), np.random.default_rng(4), PLAN.stereo_rig
    points, count = PLAN.layout.body.points, 360
    t = np.arange(-20, count + 20) / 30.0
    swing = 0.06 * np.sin(2 * np.pi * np.clip((t - 3) / 6, 0, 1) * 3) * np.array([[1.0], [0.6], [0.8]])

    def at(late_s):
        shift = np.array([np.interp(t + late_s, t, axis) for axis in swing]).T
        return np.array([pose(np.eye(3), T0[:3, 3] + each) for each in shift])

    T0 = PLAN.views[13].T_left_body
    true, late = at(0.0), at(LATE_S)
    seen = []
    for T, T_late in zip(true[20:-20], late[20:-20], strict=True):
        uv = np.concatenate([rig.project(points @ X[:3, :3].T + X[:3, 3])[side] for side, X in enumerate((T, T_late))])
        uv += NOISE_PX * rng.standard_normal(uv.shape)
        side, row = np.repeat([0, 1], len(points)), np.tile(np.arange(len(points)), 2)
        observed = PixelObservations(side, row, uv, np.tile(np.eye(2), (len(uv), 1, 1)))
        seen.append(fit_pose(rig.cameras, rig.T_left_right, points, observed, T, robust=False).T_left_body)
    T_base_rig = exp_se3(np.array([0.3, -0.2, 0.5, 0.1, 0.4, -0.2]))
    for name, times, Ts in (("truth", t, true), ("vision", t[20:-20], np.array(seen))):
        words = np.full(len(times), "open_loop")
        write_columns(folder, name, [columns(ToolTrack(times + 1.0, T_base_rig @ Ts, words, words))])
    write_text(
        folder / "handeye.json", json.dumps({"T_base_rig": T_base_rig.tolist(), "T_tool_body": np.eye(4).tolist()})
    )
    rig.save(folder / "rig.json")
    write_text(folder / "body.toml", body_text())
    return folder


def test_the_cause_that_does_not_fit_is_named(armsight, run, monkeypatch):
    monkeypatch.setattr(result, "CHANGES", {})
    write_text(run / "plan.toml", 'camera = "global-shutter-1mp"\nskew_ms = 2.0\n')
    said = armsight("budget", run / "plan.toml", "--rig", run, "--json")
    found = {row["errors"]: row for row in json.loads(said.out)["run"]}
    motion = found["in motion"]
    assert not motion["fits"]
    assert motion["factors"] == {"skew": 3.0}
    assert found["constant at rest"]["measured_rms_m"] < found["constant at rest"]["predicted_rms_m"]


def test_causes_that_are_not_there_are_named_and_unknown_cameras_are_said(armsight, run, monkeypatch):
    monkeypatch.setattr(result, "CHANGES", {})
    write_text(run / "plan.toml", "skew_ms = 100.0\nstart_ms = 80.0\n")
    said = armsight("budget", run / "plan.toml", "--rig", run, "--json")
    motion = next(row for row in json.loads(said.out)["run"] if row["errors"] == "in motion")
    # Neither alone: the other predicts more than ten times what was measured.
    assert {"skew", "start of exposures"} <= motion["factors"].keys()
    assert all(motion["factors"][cause] <= 0.5 for cause in ("skew", "start of exposures"))
    assert "noise and exposure of the rig's cameras are not known" in said.err
    given = armsight("budget", run / "plan.toml", "--rig", run, "--camera", "global-shutter-1mp")
    assert "not known" not in given.err


def test_blur_is_of_the_speed_of_each_shot(run, monkeypatch):
    """At a plan's speed of 1 m/s, what is predicted of blur alone is that of a plan at the run's own speed."""
    found = {}
    monkeypatch.setattr("armsight.app.budget.run._rows_of", lambda budget, _: (budget, []))
    for speed in ("0.1m/s", "0.2m/s"):
        plan = run_plan(run, camera="webcam-720p", speed=speed, exposure_ms=20.0)
        found[speed] = against_run(run, plan)[0].cov(of="exposure blur")
        px = plan.conditions.noise_px["exposure blur"] / plan.speeds[0]
        found[speed] = np.sqrt(np.trace(found[speed][:, :3, :3], axis1=1, axis2=2)) / px
        assert found[speed].max() > 0
    np.testing.assert_allclose(found["0.1m/s"], found["0.2m/s"], rtol=1e-9)


def test_no_run_is_one_line(armsight, tmp_path):
    assert_rejected(armsight("budget", "--rig", tmp_path), "vision.csv")
    assert_rejected(armsight("budget", "--rig", tmp_path, "--best"), "leave out --best")
