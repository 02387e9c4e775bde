"""The whole experiment: what `armsight demo --quick` leaves, and how a demo ends that goes wrong."""

import csv
import json
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from armsight.app.demo import demo
from armsight.app.demo.demo import Demo, run_demo
from armsight.app.stream.mcap_file import LazyMcap
from armsight.errors import ArmsightError
from armsight.geometry.rotation import from_quaternion_wxyz, log_so3
from armsight.loop.identify.read import read_poses
from armsight.sim.workcell.cameras import open_cameras
from armsight.sim.workcell.workcell import Workcell
from cli_runs import assert_has, assert_rejected


@pytest.fixture(scope="module")
def quick(quick_demo):
    """Return the folder of a run of ``armsight demo --quick``, its summary, and what it printed."""
    folder = quick_demo / "demo"
    return folder, json.loads((folder / "summary.json").read_text()), (quick_demo / "demo.txt").read_text()


def rows(folder, name):
    found = list(csv.DictReader((folder / f"{name}.csv").read_text().splitlines()))
    p = np.array([[float(r[f"{a}_m"]) for a in "xyz"] for r in found])
    q = np.array([[float(r[f"q{a}"]) for a in "wxyz"] for r in found])
    return np.array([float(r["t_s"]) for r in found]), p, q, np.array([r["phase"] for r in found])


def hidden(folder, t_s):
    """While a card hides the body, half a second of the first circle, errors are counted for themselves."""
    begin_s, end_s = map(float, re.search(r"([\d.]+) s to +([\d.]+) s +open_loop +circle", log_of(folder)).groups())
    card_s = begin_s + 0.4 * (end_s - begin_s)
    return (t_s > card_s - 0.01) & (t_s < card_s + 0.55)


def log_of(folder):
    return (folder / "run.log").read_text()


@pytest.mark.parametrize("name", ["vision", "potentiometers", "fused", "live"])
def test_anyone_can_recompute_the_metrics_from_the_files(quick, name):
    folder, summary, _ = quick
    t, p, q, phase = rows(folder, name)
    t_true, p_true, q_true, _ = rows(folder, "truth")
    moving = (phase == "open_loop") & ~hidden(folder, t)
    assert moving.sum() == summary[name]["rows"]
    at = np.stack([np.interp(t, t_true, p_true[:, i]) for i in range(3)], axis=1)
    off = np.linalg.norm(p - at, axis=1)[moving]
    assert np.sqrt((off**2).mean()) == pytest.approx(summary[name]["position_rms_m"], rel=1e-3)
    assert off.max() == pytest.approx(summary[name]["position_max_m"], rel=1e-2)
    nearest = np.clip(np.searchsorted(t_true, t), 0, len(t_true) - 1)
    angles = [
        np.linalg.norm(log_so3(from_quaternion_wxyz(q[k]).T @ from_quaternion_wxyz(q_true[nearest[k]])))
        for k in np.flatnonzero(moving)[::7]
    ]
    # The nearest millisecond instead of interpolation: at 2 rad/s half a milliradian.
    assert np.sqrt(np.square(angles).mean()) == pytest.approx(summary[name]["orientation_rms_rad"], abs=1e-3)


def test_vision_is_accurate_and_potentiometers_are_not(quick):
    _, summary, _ = quick
    assert summary["ended_by"] is None
    assert summary["vision"]["position_rms_m"] < 0.2e-3
    assert summary["vision"]["orientation_rms_rad"] < np.radians(0.15)
    assert summary["potentiometers"]["position_rms_m"] > 5 * summary["vision"]["position_rms_m"]
    assert summary["fused"]["position_rms_m"] < 0.25e-3
    assert summary["shots"]["missed"] <= 0.05 * summary["shots"]["measured"]
    # The delay the workcell has: half an exposure of 2 ms, and 12 ms.
    assert summary["camera_delay_s"]["value"] == pytest.approx(13e-3, abs=0.4e-3)


def test_the_record_is_there_for_every_reading(quick):
    folder, *_ = quick
    np.testing.assert_allclose(rows(folder, "fused")[0], rows(folder, "potentiometers")[0], rtol=0, atol=1e-6)


def test_closing_the_loop_reduces_the_errors(quick):
    _, summary, _ = quick
    c = summary["closed_loop"]
    assert c["rest_error_after_m"] < c["rest_error_before_m"] / 5
    assert c["path_error_after_m"] < c["path_error_before_m"] / 2


def test_the_folder_holds_what_its_page_says(quick):
    folder, summary, _ = quick
    assert summary["version"] == 2
    for name in ("truth", "vision", "potentiometers", "fused", "live", "reference", "joints"):
        assert (folder / f"{name}.csv").stat().st_size > 1000
    for name in ("joints", "path", "errors", "loop", "latency", "pose", "workcell"):
        assert (folder / f"{name}.png").read_bytes()[:4] == b"\x89PNG"
    page = (folder / "report.html").read_text()
    # It needs no network. A picture's base64 may hold the letters, but no colon.
    assert "http:" not in page.replace("http://www.w3.org", "")
    assert "https:" not in page
    assert set(rows(folder, "vision")[3]) == {"calibration", "open_loop", "closed_loop", "rest"}
    hands = read_poses(folder / "handeye_poses.csv").measured
    assert len(hands) == summary["handeye"]["poses"]
    assert set(np.unique(hands.approach)) == {-1, 0, 1} or set(np.unique(hands.approach)) == {-1, 1}
    assert np.linalg.eigvalsh(hands.cov).min() > 0
    assert "shots measured" in log_of(folder)
    assert "line" in log_of(folder)


def broken(tmp_path, monkeypatch, mend):
    """Run with a workcell that ``mend`` has changed; returns the message."""

    class Mended(Workcell):
        @classmethod
        def open(cls, **options):
            workcell = super().open(**options | {"processes": False})
            mend(workcell)
            monkeypatch.setattr(demo, "_calibrated", lambda *given: SimpleNamespace(rig=workcell.truth.rig))
            return workcell

    class Here:
        """No second process: it would take longer to begin than the run lasts."""

        def __init__(self, make, *modules):
            self._call = make()

        def __call__(self, *arguments):
            return self._call(*arguments)

        def close(self):
            pass

    monkeypatch.setattr(demo, "Workcell", Mended)
    monkeypatch.setattr(demo, "Process", Here)
    monkeypatch.setattr("armsight.app.run.folder.LazyMcap", lambda *given, process: LazyMcap(*given))
    monkeypatch.setattr(demo, "_AMOUNTS", {True: (6, 12, 0)})
    with pytest.raises(ArmsightError) as caught:
        run_demo(Demo(tmp_path, emulator="host", cameras="640x360@30", quick=True, seed=1))
    assert json.loads((tmp_path / "summary.json").read_text())["ended_by"] in str(caught.value)
    return str(caught.value)


def test_a_body_out_of_view_at_the_start(tmp_path, monkeypatch):
    said = broken(tmp_path, monkeypatch, lambda workcell: workcell.cover(0.0, 100.0))
    assert_has(said, "is not seen where the arm stands", "bring it into the view")


def test_a_camera_that_is_gone(tmp_path, monkeypatch):
    for stale in ("truth.csv", "errors.png", "summary.json", "report.html"):  # of an earlier run, its page last
        (tmp_path / stale).write_text("{}")
    (tmp_path / "mine.txt").write_text("mine")
    said = broken(tmp_path, monkeypatch, lambda workcell: workcell.source.unplug(3.0, "left camera: unplugged"))
    assert said.startswith("left camera: unplugged")
    left = {path.name for path in tmp_path.iterdir()}
    assert not left & {"report.html", "truth.csv", "errors.png"}
    assert {"mine.txt", "summary.json", "joints.csv", "poses.csv"} <= left


def test_a_board_that_faults(tmp_path, monkeypatch):
    def fails(workcell):
        step = workcell.plant.step

        def stepped(*arguments):
            if workcell.t_s > 2.0:
                workcell.plant.supply_mv = 3000
            step(*arguments)

        monkeypatch.setattr(workcell.plant, "step", stepped)

    said = broken(tmp_path, monkeypatch, fails)
    assert_has(said, "the board changed to FAULTED", "supply too low")


@pytest.mark.parametrize(
    "options", [("--seed", "-1"), ("--seed", "many"), ("--speed", "9"), ("--board", "serial:x"), ("--layout", "round")]
)
def test_options_typed_wrong(armsight, options):
    assert armsight("demo", *options).code == 2


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--arm", "rusty"), "arm 'rusty' is unknown"),
        (("--cameras", "big"), "cameras 'big'"),
        (("--cameras", "webcam:640x480@30"), "a NAME is one of webcams, clean, cheap-webcam"),
        (("--cameras", "none.toml"), "none.toml: no such file"),
        (("--board", "emulated:cray"), "cray"),
    ],
)
def test_names_that_are_not_known(armsight, tmp_path, options, said):
    got = armsight("demo", "-o", tmp_path, *options)
    assert got.code == 2
    assert said in got.err
    assert len(got.err.splitlines()) == 1


@pytest.mark.parametrize("cameras", ["webcams", "webcams:640x480@15", "1280x720@60", "industrial:640x480@15"])
def test_the_study_of_rates_takes_the_same_cameras(cameras):
    (given, _), (at, _) = open_cameras(cameras), open_cameras(demo.cameras_at(cameras, 4.0))
    assert at.rate_hz == 4.0
    assert replace(at, rate_hz=given.rate_hz) == given


def test_people_read_millimetres(quick):
    folder, summary, printed = quick
    vision = next(line for line in printed.splitlines() if line.startswith("vision"))
    assert vision.split()[1] == f"{1e3 * summary['vision']['position_rms_m']:.3f}"
    assert_has(printed, "RMS, mm", "times smaller")
    page = (folder / "report.html").read_text()  # the same numbers as in the terminal
    assert all(f">{cell}</td>" in page for cell in vision.split()[1:])


def test_an_arm_model_that_cannot_be_read_leaves_nothing_behind(armsight, tmp_path):
    (tmp_path / "none.toml").write_text("identified = true\n")
    for name, said in (
        ("none.toml", "none.toml: 4 to 7 [[joint]] tables"),
        ("lost.toml", "lost.toml"),
        ("lost.urdf", "lost.urdf"),
    ):
        assert_rejected(armsight("demo", "--nominal-arm", tmp_path / name, "-o", tmp_path / "run"), said)
        assert not (tmp_path / "run").exists()
