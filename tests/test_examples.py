"""The examples run as they are printed, and what they print is right."""

import re
import runpy
from pathlib import Path

import numpy as np
import pytest

from armsight import StereoRig, open_arm
from armsight.sim.recording import Truth

FOLDER = Path(__file__).resolve().parent.parent / "examples"
EXAMPLES = sorted(FOLDER.glob("*.py"))
#: |error|^2 is at most chi-square of three degrees of freedom times the largest variance, which the trace bounds: this is
#: the root of its quantile 1 - 1e-6. Sigma and error are printed to 0.0005 mm.
WORST_SIGMAS, HALF_DIGIT_MM = 5.54, 5e-4


def errors_mm(text):
    """Return (N, 2) sigmas and errors that a text ends its lines with."""
    return np.array(re.findall(r"sigma ([\d.]+) mm, error ([\d.]+) mm$", text, re.MULTILINE), float)


def assert_honest(found, count):
    assert len(found) == count
    assert (found[:, 1] <= WORST_SIGMAS * (found[:, 0] + HALF_DIGIT_MM) + HALF_DIGIT_MM).all()


def baseline_mm(folder, name):
    """Return the baseline of the rig that an example saved, held against the truth by its own sigma."""
    rig, truth = StereoRig.load(folder / "rig.json"), Truth.load(folder / name).rig
    # The baseline's direction in the right camera's axes, along which the tangent's first three numbers point.
    along = rig.T_left_right[:3, :3].T @ rig.T_left_right[:3, 3] / rig.baseline_m
    sigma = float(np.sqrt(along @ rig.cov[-6:-3, -6:-3] @ along))
    assert 0 < sigma < 1e-3
    assert rig.baseline_m == pytest.approx(truth.baseline_m, abs=5 * sigma)
    return 1e3 * rig.baseline_m, 1e3 * truth.baseline_m


def measure_a_board(main, folder, capsys):
    main(folder)
    assert_honest(errors_mm(capsys.readouterr().out), 5)


def calibrate_in_python(main, folder, capsys):
    main(folder)
    (printed,) = re.findall(r"baseline ([\d.]+) mm, truth ([\d.]+) mm", capsys.readouterr().out)
    assert [float(text) for text in printed] == pytest.approx(baseline_mm(folder, "board"), abs=5.1e-4)


def follow_a_plate(main, folder, capsys):
    returned = main(FOLDER)
    out = capsys.readouterr().out
    ways = [line.split(": ")[1] for line in out.splitlines()]
    assert ways[0] == "searched"
    assert set(ways[5:8]) == {"lost"}
    assert set(ways[1:5] + ways[9:]) == {"followed"}
    assert_honest(errors_mm(out), 9)
    np.testing.assert_allclose(np.array(returned)[:, 1:], errors_mm(out), atol=HALF_DIGIT_MM)


def dense(main, folder, capsys):
    depth_m = main()
    ((share, sigma_mm, _),) = re.findall(r"measured (\d+)% .* ([\d.]+) mm at ([\d.]+) m", capsys.readouterr().out)
    assert int(share) > 80  # a strip of either side is in one image only
    assert 2.0 < float(sigma_mm) < 7.0  # 0.06 to 0.2 px at 1.4 m (f 480 px, baseline 0.12 m)
    assert np.nanmin(depth_m) > 0.6  # the plate before, the wall behind
    assert 1.2 < np.nanmax(depth_m) < 2.0


def render_a_recording(main, folder, capsys):
    (printed,) = re.findall(r"baseline ([\d.]+) mm, truly ([\d.]+)", (folder / "said.txt").read_text())
    assert [float(text) for text in printed] == pytest.approx(baseline_mm(folder / "recording", "arm"), abs=5.1e-4)


def handeye_for_a_paper(main, folder, capsys):
    main(folder)
    out = capsys.readouterr().out
    assert_honest(errors_mm(out), 1)
    (left_out,) = re.findall(r"left out of the fit: ([\d.]+) mm", out)
    assert 0.2 < float(left_out) < 0.8  # three axes of 0.2 mm and the fit's own error: 0.32 mm in the mean
    lines = (folder / "handeye.tex").read_text().splitlines()
    assert [line.count("&") for line in lines] == [0, 8, 0, 8, 8, 0]


def recording_into_pandas(main, folder, capsys):
    main(folder)
    assert capsys.readouterr().out.startswith("12 of 12 shots\n")
    assert len((folder / "poses.csv").read_text().splitlines()) == 13


def plate_to_print(main, folder, capsys):
    triangles = main(folder)
    corners = [[tuple(corner) for corner in triangle] for triangle in np.round(triangles, 6)]
    edges = [(t[k], t[k - 2]) for t in corners for k in range(3)]
    assert len(set(edges)) == len(edges)
    assert {(b, a) for a, b in edges} == set(edges)  # each edge once in either direction: closed, faces outwards

    def two_holes(diameter_mm):  # polygons of 48 sides
        return 2 * 24 * (diameter_mm / 2) ** 2 * np.sin(np.pi / 24)

    volume = (90 * 90 - two_holes(2.5)) * 3 + (32 * 12 - two_holes(3.2)) * 20
    assert np.linalg.det(triangles).sum() / 6 == pytest.approx(volume, rel=1e-9)
    assert (folder / "plate.stl").stat().st_size == 84 + 50 * len(triangles)


def poses_without_an_arm(main, folder, capsys):
    main("xarm7", folder)
    assert capsys.readouterr().out == "40 poses of a simulated xarm7: joints.csv, poses.csv\n"
    joints, poses = (np.genfromtxt(folder / f"{name}.csv", delimiter=",", names=True) for name in ("joints", "poses"))
    assert joints.dtype.names == ("t_s", *(f"q{k}_rad" for k in range(1, 8)))
    q = np.column_stack([joints[name] for name in joints.dtype.names[1:]])
    arm = open_arm("xarm7")
    assert (arm.q_min <= q).all()
    assert (q <= arm.q_max).all()
    p_mm = np.column_stack([poses[name] for name in ("x_mm", "y_mm", "z_mm")])
    moved_mm, nominal_mm = np.ptp(p_mm, axis=0), np.ptp(1e3 * arm.forward(q)[:, :3, 3], axis=0)
    assert np.linalg.norm(moved_mm) == pytest.approx(np.linalg.norm(nominal_mm), rel=0.2)  # the same motion, rotated


#: Number of an example -> what runs it and holds what it prints.
CHECKS = {
    "01": measure_a_board,
    "02": calibrate_in_python,
    "03": follow_a_plate,
    "04": dense,
    "05": render_a_recording,
    "06": handeye_for_a_paper,
    "07": recording_into_pandas,
    "08": plate_to_print,
    "09": poses_without_an_arm,
}


def test_every_example_has_a_number_and_a_check():
    assert [path.name[:2] for path in EXAMPLES] == sorted(CHECKS)


@pytest.mark.parametrize("path", EXAMPLES, ids=[path.stem for path in EXAMPLES])
def test_it_runs_and_what_it_prints_is_right(path, tmp_path, capsys, example_recording):
    here = example_recording if path.name[:2] == "05" else tmp_path
    CHECKS[path.name[:2]](runpy.run_path(str(path))["main"], here, capsys)


def test_examples_run_where_a_script_has_no_file_of_its_own():
    """The gallery runs their text: ``__file__`` does not exist there."""
    assert [path.name for path in FOLDER.glob("*.py") if "__file__" in path.read_text(encoding="utf-8")] == []
