"""``armsight check`` from a CSV, and its plan."""

import csv
import json

import numpy as np
import pytest

from cli_runs import Said, refused, run

COLUMNS = ["test", "pose", "cycle", "approach", "t_s", "x_m", "y_m", "z_m", "qw", "qx", "qy", "qz"]
COMMAND = ["command_x_m", "command_y_m", "command_z_m", "command_qw", "command_qx", "command_qy", "command_qz"]
SIGMA = ["sigma_x_m", "sigma_y_m", "sigma_z_m"]


def said(capsys, *arguments):
    capsys.readouterr()
    code = run("check", *arguments)
    out = capsys.readouterr()
    return Said(code, out.out, out.err)


def rows_of(sigma_arm=1e-4, noise=5e-5):
    """Five poses by 30 cycles from two directions, a path and a circle with 0.2 mm of play along x."""
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


def test_every_figure(tmp_path, capsys):
    (tmp_path / "run").mkdir()
    file_of(tmp_path / "run" / "check.csv", rows_of())
    answer = said(capsys, tmp_path / "run", "--json", "-o", tmp_path / "figures.json")
    assert answer.code == 0
    (facts,) = answer.lines
    assert json.loads((tmp_path / "figures.json").read_text()) == facts
    assert set(facts["poses"]) == {f"P{k}" for k in range(1, 6)}
    for p in facts["poses"].values():
        assert p["count"] == 30
        assert p["AP_m"]["clean"] == pytest.approx(1e-3, abs=1e-4)
        assert p["RP_m"]["clean"] < p["RP_m"]["raw"]
    assert facts["vAP_m"]["P1"]["raw"] == pytest.approx(2e-4, abs=1.5e-4)
    assert facts["distance"]["AD_m"]["raw"] < 1e-4
    assert facts["path"]["AT_m"] == pytest.approx(5e-4, abs=1e-9)
    assert facts["circle"]["backlash_m"] == pytest.approx([2e-4, 0], abs=2e-5)
    assert len(facts["drift"]["dAP_m"]) == 5


def test_what_is_below_the_noise_is_said(tmp_path, capsys):
    rows = rows_of(sigma_arm=0.0, noise=1e-4)
    answer = said(capsys, file_of(tmp_path / "c.csv", rows))
    assert answer.code == 0
    assert "not resolvable" in answer.out
    assert "play along x and y 0.2" in answer.out


def test_the_plan(tmp_path, capsys):
    answer = said(capsys, "--plan", "six_r", "-o", tmp_path / "plan.csv")
    assert answer.code == 0
    assert "30 times" in answer.out
    assert len((tmp_path / "plan.csv").read_text().splitlines()) == 6
    refused(said(capsys, "--plan", "six_r", "--centre", "5000", "0", "0"), "within reach")


def test_mistakes(tmp_path, capsys):
    refused(said(capsys), "run folder", "--plan")
    refused(said(capsys, tmp_path / "none.csv"), "none.csv", "no such file")
    refused(said(capsys, file_of(tmp_path / "a.csv", rows_of()), "--wide"), "--plan")
    good = rows_of()
    bad = tmp_path / "bad.csv"
    file_of(bad, [["dance", *good[0][1:]]])
    refused(said(capsys, bad), "line 2", "'dance'", "pose, path, circle")
    file_of(bad, [[*good[0][:5], "x", *good[0][6:]]])
    refused(said(capsys, bad), "line 2", "x_m")
    file_of(bad, [[*good[0][:5], "nan", *good[0][6:]]])
    refused(said(capsys, bad), "line 2", "x_m", "finite")
    file_of(bad, good[:1])
    refused(said(capsys, bad), "3 times")
    file_of(bad, [[*good[0][:8], 2, *good[0][9:]]] * 3)
    refused(said(capsys, bad), "line 2", "quaternion")
    file_of(bad, [row for row in good if row[0] == "circle" and row[3] == 1])
    refused(said(capsys, bad), "circle", "clockwise")
    bad.write_text("pose,x_m\nP1,0\n")
    refused(said(capsys, bad), "y_m", "missing")
