"""``armsight check`` from a CSV, and its plan."""

import csv
import json
import re

import numpy as np
import pytest

from armsight.app.check.report import assess
from armsight.app.check.result import MetricLine, check_limits
from armsight.app.run.motion_file import read_motions
from armsight.geometry.pose import pose
from armsight.loop.iso9283.statistic import Metric
from armsight.robot.arm_file import open_arm
from armsight.sim.workcell.workcell import Workcell
from cli_runs import assert_has, assert_rejected, said_of

COLUMNS = ["test", "pose", "cycle", "approach", "t_s", "x_m", "y_m", "z_m", "qw", "qx", "qy", "qz"]
COMMAND = ["command_x_m", "command_y_m", "command_z_m", "command_qw", "command_qx", "command_qy", "command_qz"]
SIGMA = ["sigma_x_m", "sigma_y_m", "sigma_z_m"]


def said(capsys, *arguments):
    return said_of(capsys, "check", *arguments)


def rows_of(sigma_arm=1e-4, noise=5e-5):
    """Five poses by 30 cycles from two directions, a path and a circle with 0.2 mm of backlash along x."""
    rng = np.random.default_rng(1)
    rows, still = [], [1, 0, 0, 0]
    commands = rng.uniform([0.3, -0.2, 0.3], [0.7, 0.2, 0.7], (5, 3))
    for cycle in range(30):
        for k, command in enumerate(commands):
            side = 1 if cycle % 2 else -1
            off = rng.normal([1e-3 + 1e-4 * side, 0, 0], np.hypot(sigma_arm, noise))
            rows.append(["pose", f"P{k + 1}", cycle, side, cycle * 5.0 + k, *(command + off), *still, *command, *still])
    for cycle in range(5):
        for s in range(20):
            command = np.array([0.3 + 0.01 * s, 0.1, 0.4])
            rows.append(["path", s, cycle, "", "", *(command + 5e-4 * np.eye(3)[1]), *still, *command, *still])
    for way in (1, -1):
        for angle in np.arange(0.5, 360, 1.0):
            a = np.radians(angle)
            command = np.array([0.5 + 0.1 * np.cos(a), 0.1 * np.sin(a), 0.4])
            lag = -0.5 * 2e-4 * np.sign(-way * np.sin(a))
            rows.append(["circle", angle, 0, way, "", *(command + lag * np.eye(3)[0]), *still, *command, *still])
    return [[*row, noise, noise, noise] for row in rows]


def file_of(path, rows):
    with open(path, "w", newline="") as file:
        csv.writer(file).writerows([[*COLUMNS, *COMMAND, *SIGMA], *rows])
    return path


def test_every_metric(tmp_path, capsys):
    (tmp_path / "run").mkdir()
    file_of(tmp_path / "run" / "check.csv", rows_of())
    answer = said(capsys, tmp_path / "run", "--json", "-o", tmp_path / "report")
    assert answer.code == 0
    (found,) = answer.lines
    assert json.loads((tmp_path / "report" / "check.json").read_text()) == found
    assert set(found["poses"]) == {f"P{k}" for k in range(1, 6)}
    for p in found["poses"].values():
        assert p["count"] == 30
        assert p["AP_m"]["clean"] == pytest.approx(1e-3, abs=1e-4)
        assert p["RP_m"]["clean"] < p["RP_m"]["raw"]
    assert found["vAP_m"]["P1"]["raw"] == pytest.approx(2e-4, abs=1.5e-4)
    assert found["distance"]["AD_m"]["raw"] < 1e-4
    assert found["paths"]["path"]["AT_m"]["raw"] == pytest.approx(5e-4, abs=1e-9)
    assert [backlash["raw"] for backlash in found["circle"]["backlash_m"]] == pytest.approx([2e-4, 0], abs=2e-5)
    assert len(found["drift"]["dAP_m"]) == 5
    page = (tmp_path / "report" / "report.html").read_text()
    for name in ("scatter", "drift", "paths", "circle"):
        assert f'id="{name}"' in page
        assert (tmp_path / "report" / f"check-{name}.png").read_bytes().startswith(b"\x89PNG")
    assert "://" not in page
    again = said(capsys, tmp_path / "report" / "check.csv", "--json")
    assert again.lines[0]["poses"]["P1"]["AP_m"]["raw"] == pytest.approx(found["poses"]["P1"]["AP_m"]["raw"], abs=2e-9)


def test_what_is_below_the_noise_is_said(tmp_path, capsys):
    rows = rows_of(sigma_arm=0.0, noise=1e-4)
    answer = said(capsys, file_of(tmp_path / "c.csv", rows), "-o", tmp_path / "report")
    assert answer.code == 0
    assert_has(answer.out, "not resolvable: below", "could have been resolved")
    assert re.search(r"^backlash +along x +0\.2\d\d mm", answer.out, re.MULTILINE)
    assert "not resolvable" in (tmp_path / "report" / "report.html").read_text()


def test_a_constant_error_of_the_instrument_is_in_the_accuracy(tmp_path, capsys):
    rows = [row for row in rows_of() if row[0] == "pose"]
    plain = said(capsys, file_of(tmp_path / "a.csv", rows), "--json").lines[0]["poses"]["P1"]
    with open(tmp_path / "b.csv", "w", newline="") as file:
        common = [f"sigma_common_{a}_m" for a in "xyz"]
        csv.writer(file).writerows([[*COLUMNS, *COMMAND, *SIGMA, *common], *([*row, 1e-4, 1e-4, 1e-4] for row in rows)])
    found = said(capsys, tmp_path / "b.csv", "--json").lines[0]["poses"]["P1"]
    assert found["AP_m"]["sigma"] == pytest.approx(np.hypot(1e-4, plain["AP_m"]["sigma"]), rel=0.1)
    assert plain["AP_m"]["sigma"] < 5e-5
    assert found["RP_m"] == plain["RP_m"]


def test_the_wide_test(tmp_path, capsys):
    rng = np.random.default_rng(3)
    rows = []
    for k in range(100):
        command = rng.uniform([0.3, -0.2, 0.3], [0.7, 0.2, 0.7])
        off = rng.normal(0, 1e-3, 3)
        rows.append(["pose", f"P{k}", 1, "", k, *(command + off), 1, 0, 0, 0, *command, 1, 0, 0, 0, 1e-5, 1e-5, 1e-5])
    answer = said(capsys, file_of(tmp_path / "wide.csv", rows), "--json", "-o", tmp_path / "report")
    (found,) = answer.lines
    assert found["anywhere"]["count"] == 100
    assert found["anywhere"]["mean_m"]["clean"] == pytest.approx(1e-3 * np.sqrt(8 / np.pi), rel=0.2)
    assert "poses" not in found
    assert (tmp_path / "report" / "check-anywhere.png").exists()
    assert not (tmp_path / "report" / "check-scatter.png").exists()


def test_the_plan(tmp_path, capsys):
    answer = said(capsys, "plan", "--arm", "six_r", "-o", tmp_path / "plan.csv")
    assert answer.code == 0
    assert "cycles: 30" in answer.out
    assert len((tmp_path / "plan.csv").read_text().splitlines()) == 6
    assert_rejected(said(capsys, "plan", "--arm", "six_r", "--centre", "5000", "0", "0"), "within reach")
    nowhere = said(capsys, "plan", "--arm", "six_r", "--test", "line", "--centre", "nan", "0", "0")
    assert_rejected(nowhere, "finite numbers")
    assert "--speed" not in nowhere.err
    assert_rejected(said(capsys, "plan", "--arm", "six_r", "--test", "line", "--speed", "9999"), "lower --speed")
    assert_rejected(said(capsys, "plan", "--arm", "six_r", "-o", tmp_path / "plan.txt"), "plan.txt", ".toml")
    assert_rejected(said(capsys, "plan", "--arm", "six_r", "--test", "line", "-o", tmp_path / "plan.csv"), ".toml")
    assert_rejected(said(capsys, "plan", "--arm", "six_r", "-o", tmp_path / "none" / "plan.toml"), "no folder")
    assert_rejected(said(capsys, "plan", "--arm", "six_r", "--visible-in", tmp_path), "rig.json", "no such file")
    assert "--test" in said(capsys, "plan", "--help").out
    assert "RUN|POSES.csv" in said(capsys, "--help").out


@pytest.mark.parametrize(
    ("test", "cycles", "count"), [("poses", 2, 1 + 2 * 5), ("wide", 1, 100), ("line", 2, 5), ("circle", 2, 5)]
)
def test_a_plan_is_a_motion_file(tmp_path, capsys, test, cycles, count):
    out = tmp_path / "check.toml"
    answer = said(capsys, "plan", "--arm", "six_r", "--test", test, "--cycles", cycles, "-o", out, "--json")
    arm, plan = open_arm("six_r"), read_motions(open_arm("six_r"), out)
    assert len(plan.motions) == count
    (found,) = answer.lines
    assert [("2 of the" in note, "fewer than 3 times" in note) for note in found["notes"]] == (
        [(True, True)] if test in ("poses", "line") else []
    )
    attained = {}
    for motion in plan.motions:
        q = motion.trajectory.at(np.linspace(0, motion.trajectory.duration_s, 100)).q
        assert arm.within_limits(q).all()
        attained.setdefault(motion.name.split(" cycle ")[0], []).append(arm.forward(q[-1]))
        p = arm.forward(q)[:, :3, 3]
        if motion.kind == "circle":
            radii = np.linalg.norm(p - found["centre_m"], axis=1)
            np.testing.assert_allclose(radii, 0.4 * found["side_m"], atol=1e-8)
            arc_m = np.linalg.norm(np.diff(p, axis=0), axis=1).sum()  # 100 chords, each shorter than its arc by 1e-3
            assert arc_m == pytest.approx(np.radians(420) * 0.4 * found["side_m"], rel=2e-3)
    if test == "poses":
        for name, T in zip(found["poses"], found["T_base_tool"], strict=True):
            np.testing.assert_allclose(attained[name], [T, T], atol=1e-7)  # angles are written to 1e-6 deg


def test_a_plan_is_seen_by_the_cameras(tmp_path, capsys):
    with Workcell.open(arm="worn", cameras="640x360@12", emulator="host") as workcell:
        workcell.truth.rig.save(tmp_path / "rig.json")
        (tmp_path / "body.toml").write_text(workcell.body_text)
        near = workcell.truth.T_base_rig @ pose(np.eye(3), np.array([0, 0, 0.6]))  # so near that not all fits in
        mounting = {"T_base_rig": near.tolist(), "T_tool_body": workcell.truth.T_tool_body.tolist()}
    (tmp_path / "handeye.json").write_text(json.dumps(mounting))
    rig, T_base_rig = workcell.truth.rig, np.array(mounting["T_base_rig"])

    def share_seen(*options):
        """Of the tool's positions in a plan, how many both cameras have in their images."""
        plan = said(capsys, "plan", "--arm", "six_r", "--test", "wide", "--json", *options).lines[0]
        p_left = (np.array(plan["T_base_tool"])[:, :3, 3] - T_base_rig[:3, 3]) @ T_base_rig[:3, :3]
        p_right = (p_left - rig.T_left_right[:3, 3]) @ rig.T_left_right[:3, :3]
        good = np.ones(len(p_left), bool)
        for camera, p in ((rig.left, p_left), (rig.right, p_right)):
            uv = camera.project(p)
            good &= (p[:, 2] > 0) & ((uv > 0) & (uv < np.array(camera.image_size_px))).all(axis=1)
        return good.mean()

    assert share_seen() < 0.95  # else it would say nothing that all of it is seen:
    assert share_seen("--visible-in", tmp_path) == 1
    (tmp_path / "handeye.json").write_text("{}")
    assert_rejected(said(capsys, "plan", "--arm", "six_r", "--visible-in", tmp_path), "handeye.json", "T_base_rig")
    (tmp_path / "handeye.json").write_text(json.dumps(mounting | {"T_tool_body": [1, 2, 3]}))
    assert_rejected(
        said(capsys, "plan", "--arm", "six_r", "--visible-in", tmp_path), "handeye.json", "T_tool_body", "(4, 4)"
    )


def test_without_a_sigma_errors_have_no_interval(tmp_path, capsys):
    rng = np.random.default_rng(3)
    with open(tmp_path / "wide.csv", "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["pose", *COLUMNS[5:8], *COMMAND[:3]])
        for k in range(20):
            command = rng.uniform(0.3, 0.7, 3)
            writer.writerow([f"P{k}", *(command + rng.normal(0, 1e-3, 3)), *command])
    answer = said(capsys, tmp_path / "wide.csv", "-o", tmp_path / "report")
    assert answer.out.count("no interval without the instrument's sigma") == 2
    found = json.loads((tmp_path / "report" / "check.json").read_text())
    assert found["anywhere"]["mean_m"]["low"] is found["anywhere"]["mean_m"]["sigma"] is None


def test_poses_attained_too_seldom_are_reported(tmp_path, capsys):
    rows = [row for row in rows_of() if row[0] == "pose" and (row[1] != "P3" or row[2] < 2)]
    (found,) = said(capsys, file_of(tmp_path / "c.csv", rows), "--json").lines
    assert found["notes"] == ["left out: P3, attained too seldom (2)"]


def test_another_reports_page_is_not_written_over(tmp_path, capsys):
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "report.html").write_text("another's")
    file = file_of(tmp_path / "c.csv", rows_of())
    assert_rejected(said(capsys, file, "-o", tmp_path / "other"), "a report of another program", "another folder")
    assert (tmp_path / "other" / "report.html").read_text() == "another's"


def test_paths_whose_path_points_differ(tmp_path, capsys):
    rows, bad = [row for row in rows_of() if row[0] == "path"], tmp_path / "bad.csv"
    moved = [[*row[:12], row[12] + 1e-3 * (row[1] == 4 and row[2] == 2), *row[13:]] for row in rows]
    assert_rejected(said(capsys, file_of(bad, moved)), "path path", "same path points", "cycle 2")
    exchanged = [[row[0], {3: 4, 4: 3}.get(row[1], row[1]) if row[2] == 1 else row[1], *row[2:]] for row in rows]
    assert_rejected(said(capsys, file_of(bad, exchanged)), "same path points", "cycle 1")
    assert_rejected(said(capsys, file_of(bad, rows[:-1])), "same path points", "19 rows")
    still = [[*row[:12], 0.4 if row[1] in (4, 5, 6) else row[12], *row[13:]] for row in rows]
    assert_rejected(said(capsys, file_of(bad, still)), "path path", "at its point 6", "does not advance")


def test_mistakes(tmp_path, capsys):
    assert said(capsys).code == 2
    assert_rejected(said(capsys, tmp_path / "none.csv"), "none.csv", "no such file")
    good = rows_of()
    assert_rejected(said(capsys, file_of(tmp_path / "a.csv", good), "--closed"), "--closed", "run's folder")
    (tmp_path / "file").write_text("")
    assert_rejected(said(capsys, tmp_path / "a.csv", "-o", tmp_path / "file"), "file", "no report")
    bad = tmp_path / "bad.csv"
    file_of(bad, [["dance", *good[0][1:]]])
    assert_rejected(said(capsys, bad), "line 2", "'dance'", "pose, path, circle")
    file_of(bad, [[*good[0][:5], "x", *good[0][6:]]])
    assert_rejected(said(capsys, bad), "line 2", "x_m")
    file_of(bad, [[*good[0][:5], "nan", *good[0][6:]]])
    assert_rejected(said(capsys, bad), "line 2", "x_m", "finite")
    file_of(bad, good[:1])
    assert_rejected(said(capsys, bad), "3 times", "repeatability")
    file_of(bad, [row for row in good if row[0] == "pose" and row[2] == 0])
    assert_rejected(said(capsys, bad, "-o", tmp_path / "none"), "5 poses", "3 times")
    assert not (tmp_path / "none").exists()
    file_of(bad, [[*good[0][:8], 2, *good[0][9:]]] * 3)
    assert_rejected(said(capsys, bad), "line 2", "quaternion")
    file_of(bad, [row for row in good if row[0] == "circle" and row[3] == 1])
    assert_rejected(said(capsys, bad), "circle", "clockwise")
    bad.write_text("pose,x_m\nP1,0\n")
    assert_rejected(said(capsys, bad), "y_m", "missing")


def changed(row, **entries):
    """A row with other entries."""
    names = [*COLUMNS, *COMMAND, *SIGMA]
    return [entries.get(name, entry) for name, entry in zip(names, row, strict=True)]


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        (lambda rows: [changed(r, sigma_y_m=-1e-4) for r in rows], ["line 2", "sigma_y_m", "below zero"]),
        (lambda rows: [changed(r, sigma_y_m="") for r in rows], ["line 2", "sigma_y_m is missing"]),
        (lambda rows: [changed(r, command_qw="") for r in rows], ["line 2", "command_qw is missing"]),
        (lambda rows: [changed(r, pose="") for r in rows[:1]] + rows[1:], ["line 2", "pose is empty"]),
        (lambda rows: [rows[0][:1], *rows[1:]], ["line 2", "pose is empty"]),
        (lambda rows: [*rows, rows[3]], ["P4", "twice", "cycle 0"]),
        (lambda rows: [changed(rows[0], command_x_m=0.5), *rows[1:]], ["P1", "several commands"]),
        (lambda rows: [changed(r, x_m=1e3 * r[5]) for r in rows], ["mm from their commands", "in m"]),
        (lambda rows: [changed(r, x_m=r[6], y_m=r[5]) for r in rows], ["mm from their commands", "frame"]),
    ],
)
def test_what_no_arm_attains_is_rejected(tmp_path, capsys, change, parts):
    rows = [row for row in rows_of() if row[0] == "pose" and row[2] < 5]
    assert_rejected(said(capsys, file_of(tmp_path / "bad.csv", change(rows))), "bad.csv", *parts)


def test_without_sigmas_it_is_said_and_rows_that_agree_to_the_last_digit_may(tmp_path, capsys):
    rows = [changed(row, cycle="", t_s="", x_m=round(row[5], 3), y_m=round(row[6], 3), z_m=round(row[7], 3))
            for row in rows_of() if row[0] == "pose" and row[2] < 5]  # fmt: skip
    answer = said(capsys, file_of(tmp_path / "round.csv", [row[: -len(SIGMA)] for row in rows]))
    assert answer.code == 0
    assert "noise is taken for none" in answer.err


def test_a_motion_file_is_distinguished_from_attained_poses(tmp_path, capsys):
    assert said(capsys, "plan", "--arm", "six_r", "--test", "line", "-o", tmp_path / "line.toml").code == 0
    assert_rejected(said(capsys, tmp_path / "line.toml"), "line.toml", "a motion file, which --motion")


def test_a_row_far_from_its_pose_is_named_and_the_sequence_of_rows_has_no_effect(tmp_path, capsys):
    rows = [row for row in rows_of() if row[0] == "pose"]
    before = said(capsys, file_of(tmp_path / "a.csv", rows), "--json").lines[0]
    assert not any("counts" in note for note in before["notes"])
    after = said(capsys, file_of(tmp_path / "b.csv", rows[::-1]), "--json").lines[0]
    assert (before["distance"]["from"], before["drift"]["pose"]) == ("P2", "P1")
    assert (after["distance"]["to"], after["drift"]["pose"]) == ("P4", "P1")
    n = next(n for n, row in enumerate(rows) if row[1] == "P3" and row[2] == 7)
    rows[n][7] += 5e-3
    notes = said(capsys, file_of(tmp_path / "c.csv", rows), "--json").lines[0]["notes"]
    (outlier,) = [note for note in notes if "counts" in note]
    assert "P3, cycle 7: 4.93 mm" in outlier
    rows = [row for row in rows_of(2e-6, 2e-6) if row[0] == "pose"]
    for row in rows:  # a table rounded so far that most agree, and an odd name
        row[1], row[5:8] = row[1].replace("P1", "P1²"), [round(float(v), 5) for v in row[5:8]]
    rounded = json.loads(said(capsys, file_of(tmp_path / "d.csv", rows), "--json").out)
    assert not [note for note in rounded["notes"] if "counts" in note]
    assert "P1²" in rounded["poses"]


def test_rotations_that_are_not_given_have_no_metrics(tmp_path, capsys):
    rotations = [n for n, name in enumerate([*COLUMNS, *COMMAND]) if "q" in name]
    for left, known in (([], (True, True)), (rotations[4:], (False, True)), (rotations, (False, False))):
        rows = [["" if n in left else v for n, v in enumerate(row)] for row in rows_of() if row[0] == "pose"]
        pose_1 = json.loads(said(capsys, file_of(tmp_path / "a.csv", rows), "--json").out)["poses"]["P1"]
        assert (pose_1["AP_rotation_rad"] is not None, pose_1["RP_rotation_rad"] is not None) == known


def test_limits_pass_and_fail(tmp_path, capsys):
    data = file_of(tmp_path / "poses.csv", rows_of())
    (plain,) = said(capsys, data, "--json").lines
    assert not {"limits", "passed"} & plain.keys()
    answer = said(capsys, data, "--limit", "AP=1.5mm", "--limit", "AT=400um", "-o", tmp_path / "out", "--json")
    assert answer.code == 1
    (found,) = answer.lines
    assert found == json.loads((tmp_path / "out" / "check.json").read_text())
    by_name = {name: [one for one in found["limits"] if one["metric"] == name] for name in ("AP", "AT")}
    # AP of the five poses is about 1 mm by construction, the path lies 0.5 mm aside.
    assert [one["passed"] for one in by_name["AP"]] == [True] * 5
    assert [one["value_m"] for one in by_name["AP"]] == [p["AP_m"]["clean"] for p in found["poses"].values()]
    assert [(one["passed"], one["certain"], one["limit_m"]) for one in by_name["AT"]] == [(False, True, 4e-4)]
    assert found["passed"] is False
    assert "FAIL (limit 0.4 mm)" in (tmp_path / "out" / "report.html").read_text()
    answer = said(capsys, data, "--limit", "AP=1.5mm", "--limit", "AT=0.6mm")
    assert answer.code == 0
    assert answer.out.count("PASS (limit 1.5 mm)") == 5
    assert "PASS: 0 of 6 metrics with a limit are above it" in answer.out
    near = [one["clean"] for one in (p["AP_m"] for p in plain["poses"].values())]
    answer = said(capsys, data, "--limit", f"AP={1e3 * np.median(near) + 1e-4:.6f}mm")
    assert answer.code == 1
    assert_has(answer.out, "PASS", "FAIL (limit ", ", within the interval)")


def test_a_metric_below_the_noise_passes_by_its_upper_bound():
    line = MetricLine("RP", "P1", Metric(1e-4, None, 0.0, 3e-4, 2e-4))
    for limit, passed, certain in ((4e-4, True, True), (2e-4, False, False)):
        (outcome,) = check_limits([line], {"RP": limit})
        assert (outcome.value_m, outcome.passed, outcome.certain) == (3e-4, passed, certain)
    unknown = MetricLine("backlash", "along x", Metric(-1e-4, None, None, None, None))
    (outcome,) = check_limits([unknown], {"backlash": 1e-4})
    assert (outcome.value_m, outcome.passed, outcome.certain) == (1e-4, True, None)


def test_limits_are_checked(tmp_path, capsys):
    data = file_of(tmp_path / "poses.csv", [row for row in rows_of() if row[0] == "pose"])
    for given, words in (
        ("APP=1mm", ["unknown metric 'APP'", "AP, RP"]),
        ("AP", ["NAME=LENGTH", "AP=0.5mm"]),
        ("AP=0.5", ["with a unit"]),
        ("AP=-1mm", ["with a unit"]),
        ("AT=1mm", ["this test has no such metric; it has AP, RP"]),
    ):
        assert_rejected(
            said(capsys, data, "--limit", given, "-o", tmp_path / "out"), f"--limit {given.split('=')[0]}", *words
        )
    assert_rejected(said(capsys, data, "--limit", "AP=1mm", "--limit", "AP=2mm"), "already")
    assert not (tmp_path / "out").exists()


def test_a_table_of_a_spreadsheet_has_the_same_metrics(tmp_path, capsys):
    rows = [row for row in rows_of() if row[0] == "pose"]
    (plain,) = said(capsys, file_of(tmp_path / "poses.csv", rows), "--json").lines
    names = ["test", "Pose no.", *COLUMNS[2:5], "X", *COLUMNS[6:], *COMMAND, *SIGMA]
    lines = [";".join(names)]
    lines += [
        ";".join(str(cell).replace(".", ",") if isinstance(cell, float) else str(cell) for cell in row) for row in rows
    ]
    (tmp_path / "semicolons.csv").write_text("\n".join(lines) + "\n")
    columns = ("--columns", "pose=Pose no.,x_m=X")
    (found,) = said(capsys, tmp_path / "semicolons.csv", "--json", *columns).lines
    assert found == plain
    assert_rejected(said(capsys, tmp_path / "semicolons.csv"), "semicolons.csv: line 1: column pose is missing")
    assert_rejected(said(capsys, tmp_path / "semicolons.csv", "--columns", "z=Z"), "--columns z=Z", "unknown name")
    (tmp_path / "run").mkdir()
    assert_rejected(said(capsys, tmp_path / "run", *columns), "--columns goes with a table")


def test_help_shows_both_usages(capsys):
    lines = said(capsys, "--help").out.splitlines()
    assert lines[:2] == ["Usage: armsight check [OPTIONS] RUN|POSES.csv", "       armsight check plan [OPTIONS]"]
    assert said(capsys, "plan", "--help").out.startswith("Usage: armsight check plan [OPTIONS]\n")


def test_the_first_sentence_says_how_good_and_what_to_do():
    def metric(clean, low, high):
        return Metric(clean or high, clean, low, high, None if low is None else 1e-5)

    sure, hidden, alone = metric(1e-3, 9e-4, 1.1e-3), metric(None, 0.0, 2e-4), Metric(1e-3, None, None, None, None)
    lines = [MetricLine("AP", "P1", sure), MetricLine("RP", "P1", metric(1e-4, 9e-5, 1.1e-4))]
    grade, said = assess(lines, [])
    assert (grade, said[:43]) == ("good", "Well resolved: AP is 1.00 mm and RP is 0.10")
    assert "armsight identify" in said
    assert assess([lines[0], MetricLine("RP", "P1", sure)], [])[1].endswith("--limit holds the arm to a figure.")
    assert assess([lines[0], MetricLine("RP", "P1", hidden)], [])[0] == "fair"
    assert "RP is 0.20 mm" in assess([lines[0], MetricLine("RP", "P1", hidden)], [])[1]
    assert assess([MetricLine("AP", "P1", alone)], [])[1].startswith("Usable with care")
    for limit, expected, words in (
        (0.9, "poor", "AP of P1 is 1.00 mm, limit 0.9"),
        (1.05, "fair", "more cycles"),
        (2, "good", "Within"),
    ):
        outcomes = check_limits(lines, {"AP": limit * 1e-3})
        grade, said = assess(lines, [each for each in outcomes if each is not None])
        assert (grade, words in said) == (expected, True), said
