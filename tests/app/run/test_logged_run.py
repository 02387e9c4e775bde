"""``armsight run --board poses:FILE``: an arm that another program moved, its angles in a file; nothing is commanded."""

import csv
import json

import numpy as np
import pytest

from armsight.app.run import logged
from armsight.app.run.logged import read_angles
from armsight.data import Missed, PoseEstimate, Shot
from armsight.errors import InputError
from armsight.geometry.pose import exp_se3, inverse, pose
from armsight.geometry.rotation import exp_so3
from armsight.robot.arm_file import open_arm
from armsight.sim.example_rig import example_rig
from armsight.vision import sources
from cli_runs import assert_rejected

TARGET = "chessboard:9x6:25mm"
COUNT, SIGMA_M, SIGMA_RAD = 24, 1e-4, 3e-4


class Recorded:
    """Shots by name and time, without images."""

    def __init__(self, names, times):
        self._left = [Shot(name, None, None, t) for name, t in zip(names, times, strict=True)]

    def read(self):
        return self._left.pop(0) if self._left else None

    def close(self):
        pass


@pytest.fixture
def setting(tmp_path, monkeypatch):
    """An arm at 24 poses, what the cameras measured of it, and its files."""
    rng, arm = np.random.default_rng(4), open_arm("six_r")
    q = np.clip(arm.home + rng.uniform(-0.7, 0.7, (COUNT, 6)), arm.q_min, arm.q_max)
    T_base_rig, T_tool_body = (
        pose(exp_so3(np.array([1.2, 0.3, -0.4])), [0.9, -0.2, 0.5]),
        pose(exp_so3(np.array([0, 0.2, 0.1])), [0.0, 0.02, 0.08]),
    )
    cov = np.diag([SIGMA_M**2] * 3 + [SIGMA_RAD**2] * 3)
    names, times = [f"{k:04d}" for k in range(COUNT)], [10.0 + 2 * k for k in range(COUNT)]
    seen = {}
    for name, each in zip(names, q, strict=True):
        T = inverse(T_base_rig) @ arm.forward(each) @ T_tool_body @ exp_se3(rng.multivariate_normal(np.zeros(6), cov))
        seen[name] = PoseEstimate(T, cov, cov, 1e-4, 0.1, 1.0, None)
    seen["0005"] = Missed("left: the board is not found")
    monkeypatch.setattr(logged, "measure", lambda rig, target, shot: seen[shot.name])
    monkeypatch.setattr(sources, "open_source", lambda spec: Recorded(names, times))
    example_rig((640, 360)).save(tmp_path / "rig.json")
    return names, times, q, T_base_rig


def table(path, header, rows):
    path.write_text("\n".join([",".join(header), *(",".join(map(str, row)) for row in rows)]) + "\n")
    return path


DEG = [f"q{k}_deg" for k in range(1, 7)]


def run(armsight, tmp_path, *more):
    board = f"poses:{tmp_path / 'angles.csv'}"
    files = ("--rig", tmp_path / "rig.json", "--target", TARGET)
    return armsight("run", "--source", "folder:x", "--board", board, *files, "-o", tmp_path / "out", *more)


def test_angles_by_name_give_hand_eye_errors_and_a_file_for_identify(armsight, setting, tmp_path):
    names, _, q, T_base_rig = setting
    table(tmp_path / "angles.csv", ["shot", *DEG], [[n, *np.degrees(a)] for n, a in zip(names, q, strict=True)])
    said = run(armsight, tmp_path, "--json")
    assert said.code == 0, said.err
    (summary,) = said.lines
    assert summary == json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (summary["shots"], summary["poses"], summary["rows_shifted_by"]) == (COUNT, COUNT - 1, 0)
    assert summary["missed"] == ["0005: left: the board is not found"]
    assert 0.05 < summary["held_out_position_rms_mm"] < 0.6
    handeye = json.loads((tmp_path / "out" / "handeye.json").read_text())
    off = inverse(T_base_rig) @ np.array(handeye["T_base_rig"])
    assert np.abs(off[:3, 3]).max() < 1.5e-3
    rows = list(csv.DictReader((tmp_path / "out" / "handeye_poses.csv").read_text().splitlines()))
    assert len(rows) == COUNT - 1
    assert float(rows[0]["q3_rad"]) == pytest.approx(q[0, 2])
    assert "Error of each pose" in (tmp_path / "out" / "report.html").read_text()
    errors = list(csv.DictReader((tmp_path / "out" / "errors.csv").read_text().splitlines()))
    assert [row["shot"] for row in errors] == [name for name in names if name != "0005"]


def test_angles_by_time_are_interpolated(armsight, setting, tmp_path):
    _, times, q, _ = setting
    step = np.linspace(-1, 1, 6)
    rows = [[t + dt, *np.degrees(a + dt * step)] for t, a in zip(times, q, strict=True) for dt in (-0.1, -0.02, 0.08)]
    table(tmp_path / "angles.csv", ["t_s", *DEG], rows[6:])
    said = run(armsight, tmp_path)
    assert said.code == 0, said.err
    assert "21 of 24 shots measured with joint angles" in said.out
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["without_angles"] == ["0000", "0001"]


def test_rows_that_are_shifted_by_one_are_found_and_said(armsight, setting, tmp_path):
    _, _, q, _ = setting
    rad = [f"q{k}_rad" for k in range(1, 7)]
    table(tmp_path / "angles.csv", rad, np.roll(q, -1, axis=0))
    assert_rejected(
        run(armsight, tmp_path, "--json"), "the angles of the row before fit every shot far better than its own"
    )


def test_angles_that_cannot_be_the_arms_are_said(armsight, setting, tmp_path):
    names, _, q, _ = setting
    exchanged = q[:, [0, 2, 1, 3, 4, 5]]
    table(tmp_path / "angles.csv", ["shot", *DEG], [[n, *np.degrees(a)] for n, a in zip(names, exchanged, strict=True)])
    said = run(armsight, tmp_path, "--json")
    assert said.code == 3
    assert "the joints' order is q1, q3, q2, q4, q5, q6" in said.err
    assert said.lines[0]["weak"][0].startswith("the data fit this arm if")


@pytest.mark.parametrize(
    ("header", "rows", "said"),
    [
        (
            ["shot", *DEG, "q7_deg"],
            [["0000", *range(7)]],
            "7 joints (q1_deg..q7_deg); six_r has 6; is the last one a gripper?",
        ),
        (["shot", *DEG[:5]], [["0000", *range(5)]], "5 joints (q1_deg..q5_deg); six_r has 6; column q6_deg is missing"),
        (["shot", "a"], [["0000", 1]], "no joint angles: q1_deg .. or q1_rad .. are needed"),
        (["shot", *DEG], [["0000", 1, 2, "x", 4, 5, 6]], "angles.csv: line 2: q3_deg is 'x', not a number"),
        (["shot", *DEG], [["0000", 1, 2, 3, 4, 5]], "angles.csv: line 2: 6 fields where 7 are expected"),
        (["shot", *DEG], [["0000", *range(6)]] * 2, "shot '0000' names two rows"),
        (["t_s", *DEG], [[1, *range(6)], [1, *range(6)]], "angles.csv: line 3: t_s does not rise: 1 s"),
        (["shot", *DEG], [["none", *range(6)]], "no row is of one of the shots: the first row's shot is 'none'"),
        (["t_s", *DEG], [[1, *range(6)], [2, *range(6)]], "no shot was taken while angles were logged"),
        (DEG, [range(6)] * 3, "3 rows, but 24 shots"),
        (["shot", *DEG], [], "no rows"),
        ([name.replace("deg", "rad") for name in DEG], [[" "]], "no rows"),
        (
            ["shot", *DEG],
            [["0000", *range(6)]],
            "1 of 24 shots show the body and have joint angles; 12 at least are needed",
        ),
        (
            ["shot", *(name.replace("deg", "rad") for name in DEG)],
            [["0000", 1, 2, 90, 4, 5, 6]],
            "angles.csv: line 2: q3_rad is 90: are these degrees?",
        ),
    ],
)
def test_a_wrong_file_is_one_line(armsight, setting, tmp_path, header, rows, said):
    table(tmp_path / "angles.csv", header, rows)
    assert_rejected(run(armsight, tmp_path), said)


def test_motion_is_not_for_logged_poses(armsight, setting, tmp_path):
    assert_rejected(
        run(armsight, tmp_path, "--open-loop"),
        "commands no motion: leave out --motion, --open-loop, --fixed, --follow-rig, --references and --sync-led",
    )
    assert_rejected(run(armsight, tmp_path), "angles.csv: no such file")


def test_a_row_without_angles_is_a_shot_without_and_the_others_stay_in_order(tmp_path):
    path = table(tmp_path / "a.csv", DEG, [[10.0] * 6, ["nan"] * 6, [""] * 6, [30.0] * 6])
    angles = read_angles(path, open_arm("six_r"))
    found = angles.at(["a", "b", "c", "d"], [None] * 4)
    assert [q is None for q in found] == [False, True, True, False]
    np.testing.assert_allclose(np.degrees([found[0], found[3]]), [[10.0] * 6, [30.0] * 6])
    assert (
        "2 of 4 rows have no pose, and are left out: line 3 (q1_deg is nan), line 4 (q1_deg is empty)"
        in angles.notes[0]
    )


def test_angles_far_apart_in_time_are_not_interpolated(tmp_path):
    rows = [[0.0, *[0.0] * 6, 1], [1.0, *[10.0] * 6, 2], [1.1, *[20.0] * 6, 3]]
    path = table(tmp_path / "a.csv", ["t_s", *DEG, "elbow_flex.pos"], rows)
    angles = read_angles(path, open_arm("six_r"))
    assert len(angles.notes) == 1
    assert "elbow_flex.pos" in angles.notes[0]
    before, within, exact = angles.at(["a", "b", "c"], [0.5, 1.05, 1.0])
    assert before is None
    assert np.degrees(within) == pytest.approx(15.0)
    assert np.degrees(exact) == pytest.approx(10.0)
    with pytest.raises(InputError, match="but the shots have no times"):
        angles.at(["a"], [None])
