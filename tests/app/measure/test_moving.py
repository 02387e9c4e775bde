"""``measure --skew`` and ``--readout`` on a rendered recording whose right camera is 5 ms late."""

import csv
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from armsight.app.measure.run import MeasureRun
from armsight.geometry.pose import pose
from armsight.geometry.rotation import exp_so3
from armsight.sim.example_rig import example_rig
from armsight.sim.recording import Truth, record, shot_names
from armsight.sim.render.scene import chessboard
from armsight.vision.rig import Shutters
from cli_runs import assert_rejected

SKEW_S, TARGET = 5e-3, ("--target", "chessboard:9x6:25mm")


def at(t_s):
    """Poses of a board in a hand, (N, 4, 4)."""
    swing = np.sin(2 * np.pi * t_s[:, None] * [0.7, 0.9, 0.5] + [0.3, 0.9, 1.7])
    return np.array([pose(exp_so3(0.2 * s), np.array([-0.08, -0.06, 0.6]) + s * [0.05, 0.04, 0.03]) for s in swing])


@pytest.fixture(scope="module")
def late(tmp_path_factory):
    """A folder with a recording and its rig, and the true poses at the left exposures."""
    folder, rig = tmp_path_factory.mktemp("late"), example_rig((640, 360), 450.0)
    t_s = np.arange(12) / 30
    for name, times in (("left", t_s), ("right", t_s + SKEW_S)):
        record(folder / name, Truth(rig, TARGET[1], shot_names(12), t_s, at(times)), [chessboard(9, 6, 0.025)])
    for k in range(12):
        shutil.copy(folder / "right" / f"right{k:03d}.png", folder / "left")
    rig = replace(rig, cov=1e-14 * np.eye(rig.parameter_count))
    rig.save(folder / "rig.json")
    return folder, rig, at(t_s)


def rms_mm(said, truth, code=0):
    assert said.code == code, said.err
    gaps = [
        np.array(r["position_m"]) - T[:3, 3] for r, T in zip(said.lines, truth, strict=False) if r["status"] == "ok"
    ]
    return 1e3 * np.sqrt(np.mean(np.square(gaps)))


def test_the_skew_is_noted_found_and_used(late, armsight, tmp_path):
    folder, _, truth = late
    start = ("measure", folder / "rig.json", *TARGET, "--source", folder / "left", "--json")
    as_it_is = armsight(*start)
    assert "do not expose at one time: skew 5." in as_it_is.err or "do not expose at one time: skew 4.9" in as_it_is.err
    found = armsight(
        *start,
        "--skew",
        "find",
        "-o",
        tmp_path / "poses.csv",
        "--view",
        tmp_path / "view",
        "--save-rig",
        tmp_path / "rig2.json",
    )
    given = armsight(*start, "--skew", "5ms")
    assert rms_mm(found, truth) < rms_mm(as_it_is, truth, code=3) / 5
    assert rms_mm(given, truth) < rms_mm(as_it_is, truth, code=3) / 5
    assert "(right later)" in found.err
    assert all(abs(r["shutters"]["skew_s"] - SKEW_S) < 2e-4 for r in found.lines)
    assert all(r["shutters"]["covariance_s2"][0][0] == 0 for r in given.lines)
    with open(tmp_path / "poses.csv", newline="", encoding="utf-8") as file:
        assert all(abs(float(row["skew_s"]) - SKEW_S) < 2e-4 for row in csv.DictReader(file))
    again = armsight("measure", tmp_path / "rig2.json", *start[2:])
    assert again.lines == found.lines
    assert_rejected(armsight(*start, "--save-rig", tmp_path / "rig3.json"), "or a body of discs")
    assert not (tmp_path / "rig3.json").exists()


def test_the_shutters_of_the_rig_are_used_for_recordings_only(late, armsight, tmp_path):
    folder, rig, truth = late
    replace(rig, shutters=Shutters(SKEW_S, 0.0, np.zeros((2, 2)))).save(tmp_path / "rig.json")
    said = armsight("measure", tmp_path / "rig.json", *TARGET, "--source", folder / "left", "--json")
    assert "note: skew 5.00 ms (right later)" in said.err
    assert rms_mm(said, truth) < 0.1
    pairs = "--source", f"pairs:{folder}/left/left*.png,{folder}/left/right*.png"
    said = armsight("measure", tmp_path / "rig.json", *TARGET, *pairs, "--json")
    assert "not used: no recording with times" in said.err
    assert all("shutters" not in r for r in said.lines)
    assert "shutters: skew 5.00 ms (right later)" in armsight("rig", "show", tmp_path / "rig.json").out


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (("--skew", "5"), "expected a time with its unit"),
        (("--skew", "soon"), "expected a time with its unit"),
        (("--readout", "-3ms"), "must not be below zero"),
        (("--skew", "5ms", "--readout", "find"), "needs --skew find"),
    ],
)
def test_bad_times_are_rejected(late, armsight, options, reason):
    folder = late[0]
    assert_rejected(armsight("measure", folder / "rig.json", *TARGET, "--source", folder / "left", *options), reason)


def test_images_without_times_are_rejected(late, armsight):
    folder = late[0]
    pairs = "--source", f"pairs:{folder}/left/left*.png,{folder}/left/right*.png"
    assert_rejected(armsight("measure", folder / "rig.json", *TARGET, *pairs, "--skew", "find"), "recording with times")


def test_a_rig_file_that_the_shots_have_nothing_for_is_said(tmp_path, capsys):
    shots, options = SimpleNamespace(noise=None, skewed=[]), SimpleNamespace(save_rig=tmp_path / "rig.json")
    assert not MeasureRun(options, example_rig((640, 360)), shots, None, None).keep_noise()
    assert "rig.json was not written: too few shots" in capsys.readouterr().err
    assert not (tmp_path / "rig.json").exists()
