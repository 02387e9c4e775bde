"""The examples run as they are printed, and what they print is right."""

import re
import runpy
from pathlib import Path

import numpy as np
import pytest

from armsight import StereoRig
from armsight.sim.recording import Truth

EXAMPLES = sorted((Path(__file__).resolve().parent.parent / "examples").glob("*.py"))


def run(number: str, folder: Path) -> None:
    """Run the example of a number in a folder."""
    (path,) = [path for path in EXAMPLES if path.name.startswith(number)]
    runpy.run_path(str(path))["main"](folder)


def test_examples_are_numbered_and_tried_here():
    tried = re.findall(r'run\("(\d\d)"', Path(__file__).read_text(encoding="utf-8"))
    assert [path.name[:2] for path in EXAMPLES] == sorted(set(tried))


def test_measure_a_board(tmp_path, capsys):
    run("01", tmp_path)
    found = re.findall(r"^\d+: .* sigma ([\d.]+) mm, error ([\d.]+) mm$", capsys.readouterr().out, re.MULTILINE)
    assert len(found) == 5
    # |error|^2 is at most chi-square of three degrees of freedom times the largest variance, which the trace bounds:
    # 5.54^2 is its quantile 1 - 1e-6. Both figures are printed to 0.0005 mm.
    for sigma, error in np.array(found, float):
        assert error <= 5.54 * (sigma + 5e-4) + 5e-4


def test_calibrate_in_python(tmp_path, capsys):
    run("02", tmp_path)
    rig, truth = StereoRig.load(tmp_path / "rig.json"), Truth.load(tmp_path / "board").rig
    # The baseline's direction in the right camera's axes, along which the tangent's first three numbers point.
    along = rig.T_left_right[:3, :3].T @ rig.T_left_right[:3, 3] / rig.baseline_m
    sigma = float(np.sqrt(along @ rig.cov[-6:-3, -6:-3] @ along))
    assert rig.baseline_m == pytest.approx(truth.baseline_m, abs=5 * sigma)
    printed = re.search(r"baseline ([\d.]+) mm, truth ([\d.]+) mm", capsys.readouterr().out)
    assert printed is not None
    assert [float(text) for text in printed.groups()] == pytest.approx(
        [1e3 * rig.baseline_m, 1e3 * truth.baseline_m], abs=5.1e-4
    )


def test_follow_a_plate(capsys):
    run("03", EXAMPLES[0].parent)
    lines = capsys.readouterr().out.splitlines()
    ways = [line.split(": ")[1] for line in lines]
    assert ways[0] == "searched"
    assert set(ways[5:8]) == {"lost"}
    assert set(ways[1:5] + ways[9:]) == {"followed"}
    found = np.array(re.findall(r"sigma ([\d.]+) mm, error ([\d.]+) mm$", "\n".join(lines), re.MULTILINE), float)
    assert len(found) == 9
    assert (found[:, 1] <= 5.54 * (found[:, 0] + 5e-4) + 5e-4).all()  # see test_measure_a_board


def test_render_a_recording(tmp_path, capsys):
    run("05", tmp_path)
    rig, truth = StereoRig.load(tmp_path / "rig.json"), Truth.load(tmp_path / "arm").rig
    along = rig.T_left_right[:3, :3].T @ rig.T_left_right[:3, 3] / rig.baseline_m
    sigma = float(np.sqrt(along @ rig.cov[-6:-3, -6:-3] @ along))
    assert rig.baseline_m == pytest.approx(truth.baseline_m, abs=5 * sigma)
    assert f"baseline {1e3 * rig.baseline_m:.3f} mm" in capsys.readouterr().out


def test_dense(capsys):
    # run("04") but for its main, which takes no folder
    (path,) = [path for path in EXAMPLES if path.name.startswith("04")]
    runpy.run_path(str(path))["main"]()
    found = re.search(r"error ([\d.]+) mm, ([\d.]+) deg", capsys.readouterr().out)
    assert found is not None
    assert float(found[1]) < 1.0  # what docs/dense.md says of 0.8 m
    assert float(found[2]) < 0.5
