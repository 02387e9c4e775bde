"""``armsight arm plan`` and ``arm report``: injected zeros, droop and drift are found, parts sum up, mistakes are named."""

import json
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from armsight.app.arm import evaluate
from armsight.app.arm import report as arm_report
from armsight.app.arm.evaluate import evaluate_arm, plan_report
from armsight.app.arm.report import write_report
from armsight.app.check.evaluate import evaluate as evaluate_check
from armsight.app.check.run_folder import attained_in
from armsight.app.run.motion_file import read_motions
from armsight.app.run.tracks import ToolTrack, columns, joint_columns, write_columns
from armsight.geometry.pose import exp_se3
from armsight.loop.identify.identify import identify
from armsight.loop.identify.measured import Measured
from armsight.loop.identify.model import gravity_levers
from armsight.robot.arm_file import open_arm
from armsight.sim.workcell.arm import Imperfections, sample_arm
from cli_runs import assert_rejected
from cli_runs import run as cli_run

ARM = open_arm("so101")
ZERO_DEG, DROOP_DEG_PER_M, DRIFT_MM_PER_H = np.array([0.0, 0.8, -1.1, 0.6, 0.0]), 8.0, 8.0
SIGMA = np.repeat([2e-5, 1e-4], 3)
STEP_S, MOVES, RESTS = 0.04, 5, 15


def everywhere(Ts):
    return np.ones(len(Ts), bool)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The folder of a run with the motions that were planned, with zeros that are off, joints that droop, and noise."""
    folder, rng = tmp_path_factory.mktemp("run"), np.random.default_rng(3)
    around = ARM.home + np.vstack([np.zeros(5), rng.uniform(-1.0, 1.0, (12, 5))])
    (folder / "motion.toml").write_text(plan_report(ARM, around, everywhere, poses=9, cycles=6)[0])
    plan = read_motions(ARM, folder / "motion.toml")
    q_ref, phase, name = [], [], []
    for motion in plan.motions:
        rests = RESTS if motion.rest_s > 0 else 0
        ends = motion.trajectory.at(np.array([0.0, motion.trajectory.duration_s])).q
        q_ref += [ends[0] + share * (ends[1] - ends[0]) for share in np.linspace(0, 1, MOVES)] + rests * [ends[1]]
        phase += MOVES * ["open_loop"] + rests * ["rest"]
        name += (MOVES + rests) * [motion.name]
    q_ref, phase, name = np.array(q_ref), np.array(phase), np.array(name)
    t_s = 5.0 + STEP_S * np.arange(len(q_ref))
    q = q_ref + np.radians(DROOP_DEG_PER_M) * gravity_levers(ARM, q_ref)
    T = ARM.forward(q + np.radians(ZERO_DEG)) @ exp_se3(SIGMA * rng.normal(size=(len(q), 6)))
    T[:, 0, 3] += 1e-3 * DRIFT_MM_PER_H * t_s / 3600.0
    covs = np.tile(np.diag(SIGMA**2), (len(q), 1, 1))
    write_columns(folder, "vision", [columns(ToolTrack(t_s, T, phase, name, covs))])
    write_columns(folder, "reference", [columns(ToolTrack(t_s, ARM.forward(q_ref), phase, name))])
    write_columns(folder, "joints", [joint_columns(t_s, q, q_ref)])
    (folder / "summary.json").write_text(json.dumps({"nominal_arm": "so101", "board": "feetech", "health": []}))
    return folder


@pytest.fixture(scope="module")
def report(run):
    return evaluate_arm(run, ARM)


def test_zeros_droop_and_drift_are_found_within_three_sigma(run, report):
    for k in (1, 2, 3):
        value, sigma = report.joints[k].zero_deg
        assert abs(value - ZERO_DEG[k]) < 3 * sigma < 0.3
        slope, sigma = report.joints[k].droop_deg_per_m
        assert (
            abs(slope - DROOP_DEG_PER_M) < 3 * sigma + 0.01 * DROOP_DEG_PER_M
        )  # the lever at the reading is a little another
    rate, sigma = report.drift_mm_per_h
    assert abs(rate - DRIFT_MM_PER_H) < 3 * sigma < DRIFT_MM_PER_H
    assert report.cycles >= 6
    poses = evaluate_check(attained_in(run, closed=False)).poses.values()
    RP, AP = ([1e3 * getattr(p, name).raw for p in poses] for name in ("RP_m", "AP_m"))
    assert len(RP) == 5
    assert report.pose_accuracy_mm == pytest.approx(np.mean(AP), rel=0.01)
    assert report.one_side_mm == pytest.approx(np.mean(RP), rel=0.05)  # as armsight check has it, less vision's noise
    assert report.one_side_mm < 0.2
    assert report.both_sides_mm[1] < 0.2
    assert report.latency_s < 0.02


def test_what_a_length_that_was_not_selected_moves_a_zero_by_is_in_its_sigma():
    rng = np.random.default_rng(603)
    true = sample_arm(ARM, Imperfections(length_m=1e-3, angle_rad=np.radians(0.3)), 603).arm
    zeros_deg = rng.uniform(-1, 1, 5) * [0, 1, 1, 1, 0]
    q = ARM.home + np.radians(rng.uniform(-12, 12, (40, 5)))
    sigma = np.repeat([3e-5, 2e-4], 3)
    T = true.forward(q + np.radians(zeros_deg)) @ exp_se3(sigma * rng.normal(size=(40, 6)))
    covs = np.tile(np.diag(sigma**2), (40, 1, 1))
    found = identify(ARM, Measured(q, T[:, None, :3, 3], T[:, :3, :3], covs))
    for i in (1, 2, 3):
        zero, sigma_deg = evaluate._zero(ARM, i, SimpleNamespace(q=q, approach=None), found)
        assert abs(zero - zeros_deg[i]) < 2 * sigma_deg < 0.6


def test_the_whole_error_is_split_and_a_remedy_takes_its_part_away(run, report):
    assert sum(part.share for part in report.parts.values()) == pytest.approx(1.0, abs=1e-9)
    rests = evaluate.rests_of(run, ARM)
    at, ref, true = (ARM.forward(q)[:, :3, 3] for q in (rests.q, rests.q_ref, rests.q + np.radians(ZERO_DEG)))
    for name, moved in (("controller", at - ref), ("zeros", true - at)):
        part, size = report.parts[name], 1e3 * np.sqrt((moved**2).sum(axis=1).mean())
        assert abs(part.rms_mm - size) < 3 * part.sigma_mm + 0.01 * size
        assert part.determined
        assert part.without_mm < report.accuracy_mm[0]
    assert report.parts["rest"].rms_mm < 0.02 * report.accuracy_mm[0]
    assert not report.parts["backlash"].determined
    assert re.search(r"^backlash .*not determined", arm_report.arm_report(report, {}).text(), re.MULTILINE)


def test_page_pdf_and_json_are_written_and_another_arm_is_compared(armsight, run, report, tmp_path, monkeypatch):
    monkeypatch.setattr(evaluate, "evaluate_arm", lambda folder, arm, *, progress: report)
    out = tmp_path / "owner"
    armsight("arm", "report", run, "-o", out).done()
    assert (out / "report.pdf").read_bytes().startswith(b"%PDF")
    assert "so101" in (out / "report.html").read_text()
    written = json.loads((out / "report.json").read_text())
    assert written["kind"] == "arm report"
    keys = {"share", "rms_mm", "sigma_mm", "without_mm", "remedy", "determined"}
    assert keys == set(written["parts"]["zeros"])
    assert written["joints"][1]["sigma_zero_deg"] > 0
    again = armsight("arm", "report", run, "--compare", out / "report.json", "--json")
    assert json.loads(again.out) == written


def test_mistakes_are_one_line(armsight, run, tmp_path):
    assert_rejected(armsight("arm", "report", tmp_path / "no.json"), "no.json: no such folder")
    assert_rejected(armsight("arm", "report", tmp_path), "does not name its arm")
    assert_rejected(armsight("arm", "report", tmp_path, "--arm", "so101"), "is no run")
    (tmp_path / "summary.json").write_text("{}")
    assert_rejected(armsight("arm", "report", tmp_path, "--arm", "so101"), "the run ended before its motions")
    assert_rejected(armsight("arm", "report", run, "--arm", "six_r"), "is not of an arm of 6 joints")
    (tmp_path / "other.json").write_text("{}")
    assert_rejected(armsight("arm", "report", run, "--compare", tmp_path / "other.json"), "no report of an arm")
    plan = ("arm", "plan", "so101", "--around", tmp_path, "-o", tmp_path / "plan.toml")
    assert_rejected(armsight(*plan), "handeye_poses.csv")
    assert not (tmp_path / "plan.toml").exists()


@pytest.mark.parametrize("joints", [4, 5, 6, 7])
def test_every_joint_of_any_arm_has_its_figure(joints, report, tmp_path):
    several = replace(
        report,
        joints=(2 * report.joints)[:joints],
        lever=np.tile(report.lever, 2)[:, :joints],
        lag=np.tile(report.lag, 2)[:, :joints],
    )
    assert len(arm_report._figure(several, "joints").axes) == joints
    if joints == 7:
        write_report(arm_report.arm_report(several, {}), several, tmp_path)
        assert (tmp_path / "report.pdf").read_bytes().startswith(b"%PDF")


def test_what_was_found_is_printed_and_stored_though_it_cannot_be_drawn(run, report, tmp_path, monkeypatch, capsys):
    report = replace(report, drift_mm_per_h=None)
    monkeypatch.setattr(evaluate, "evaluate_arm", lambda folder, arm, *, progress: report)
    monkeypatch.setattr(arm_report, "_figures_page", lambda report: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        cli_run("arm", "report", run, "-o", tmp_path / "out")
    printed, numbers = capsys.readouterr().out, report.to_json()
    assert "What the arm does" in printed
    known = [numbers.get(key) is not None for _, key, _ in arm_report._NUMBERS]
    assert 0 < sum(known) < len(known)
    assert [title in printed for title, *_ in arm_report._NUMBERS] == known
    assert json.loads((tmp_path / "out" / "report.json").read_text())["kind"] == "arm report"
