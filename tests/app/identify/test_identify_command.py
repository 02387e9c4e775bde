"""``armsight identify`` from files to files."""

import json
import os
import re
import subprocess
import sys
import tomllib
import xml.etree.ElementTree as ET
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from arms import FOUR
from identify_files import arm_toml, poses_csv, tracked_csv
from scipy.spatial.transform import Rotation
from worn_arm import worn

import armsight
from armsight.app.identify.report import assess, headline
from armsight.errors import InputError
from armsight.geometry.pose import pose
from armsight.loop.handeye.poses import HeldOut
from armsight.loop.identify.corrected import Corrected
from armsight.loop.identify.identify import Validation
from armsight.loop.identify.measured import Measured
from armsight.loop.identify.model import Model
from armsight.loop.identify.read import read_measured, read_poses
from armsight.robot.arm_file import open_arm
from armsight.robot.models import MODELS
from cli_runs import assert_rejected, run, said_of

#: Lines of the file that is identified from.
FITTED = []


@pytest.fixture
def one_part(monkeypatch):
    """Leave one part of the poses out, as of many."""
    monkeypatch.setattr("armsight.loop.identify.validate.MANY", 0)


def said(capsys, *arguments):
    return said_of(capsys, "identify", *arguments)


def test_from_files_to_files(tmp_path, capsys):
    data, out = poses_csv(tmp_path / "poses.csv", gaps=(3,)), tmp_path / "corrected"
    other = poses_csv(tmp_path / "other.csv", seed=1)
    other.write_text(other.read_text() + "".join(data.read_text().splitlines(True)[-7:]))
    arguments = ["--arm", arm_toml(tmp_path / "arm.toml", open_arm("six_r")), "--data", data]
    answer = said(capsys, *arguments, "--validate", other, "-o", out, "--json")
    assert answer.code == 0
    assert "line 5 (p1_x_mm)" in answer.err
    assert "other.csv: 7 of 47 poses are among those to identify from: left out" in answer.err
    (found,) = answer.lines
    assert found["identified"]["mean_m"] < 1e-4 < 8e-4 < found["nominal"]["mean_m"]
    for key in ("mean_m", "rms_m", "max_m"):
        assert 0 < found["identified"][key] < found["nominal"][key]
    parameters = {p["name"]: p for p in found["parameters"]}
    assert set(parameters["a2"]) >= {"name", "nominal", "value", "sigma", "frozen"}
    assert parameters["a2"]["frozen"] is None
    assert parameters["a2"]["value"] == pytest.approx(0.2535, abs=4 * parameters["a2"]["sigma"])
    assert "no pose can distinguish" in parameters["d1"]["frozen"]
    corrected = tomllib.loads((out / "corrected.toml").read_text())
    assert corrected["joint"][1]["a_m"] == parameters["a2"]["value"]
    zeros = tomllib.loads((out / "zeros.toml").read_text())
    assert zeros["joint"][2]["zero_rad"] == pytest.approx(parameters["offset3"]["value"], abs=1e-12)
    assert len(ET.parse(out / "corrected.urdf").getroot().findall("joint")) == 8
    assert json.loads((out / "identify.json").read_text())["parameters"] == found["parameters"]
    page = (out / "report.html").read_text()
    assert page.count("<img") == 5
    assert "://" not in page.split("</style>")[1]
    arm, urdf = open_arm(str(out / "corrected.toml")), open_arm(str(out / "corrected.urdf"))
    np.testing.assert_allclose(arm.forward(np.ones(6)), urdf.forward(np.ones(6)), atol=1e-9)
    # The ranges seen are in every output.
    q = read_poses(data).measured.q
    low, high = ([joint[f"{end}_rad"] for joint in found["joint_ranges_seen"]] for end in ("min", "max"))
    np.testing.assert_allclose(low, q.min(axis=0))
    np.testing.assert_allclose(high, q.max(axis=0))
    assert found["curve_fade_rad"] == pytest.approx(np.deg2rad(20))
    assert f"{np.degrees(low[0]):.1f}" in page
    assert [each["joint"][0]["seen_min_rad"] for each in (corrected, zeros)] == 2 * [low[0]]


def test_a_person_reads_a_sentence_and_the_held_out_line_first(tmp_path, capsys):
    data = poses_csv(tmp_path / "p.csv")
    answer = said(capsys, "--arm", "six_r", "--data", data)
    assert answer.code == 0
    lines = answer.out.splitlines()
    assert lines[0].startswith(("Good: ", "Usable: "))
    assert lines[1].startswith("held-out error ")
    assert "in 5 rounds" in lines[1]
    assert len(lines) <= 25
    assert "not fitted, or not alone" not in answer.out
    assert re.search(
        r"^\d+ more are fitted beside base and tool, \d+ are not \(-v lists all\)$", answer.out, re.MULTILINE
    )
    few = poses_csv(tmp_path / "few.csv", n=24)
    everything = said(capsys, "--arm", "six_r", "--data", few, "-v").out
    assert "not fitted, or not alone" in everything
    q1_deg = np.degrees(read_poses(few).measured.q[:, 0])
    assert f"joint 1  {q1_deg.min():.1f} to {q1_deg.max():.1f} deg" in everything


def test_an_identified_arm_is_better_only_where_it_corrects_something_by_more_than_chance():
    noise = -np.random.default_rng(0).normal(0.0, 1e-4, (40, 1))  # of the difference, m

    def grade(less_m, fitted, poses=40):
        off = (2e-3 + noise[:poses], 2e-3 - less_m + 0 * noise[:poses])
        held_out = Validation(*(HeldOut(each, np.zeros(0)) for each in off), False, 1.0)
        model = SimpleNamespace(parameters=[SimpleNamespace(kind="a")])
        found = SimpleNamespace(
            model=model, solution=SimpleNamespace(free=np.array([fitted])), moved_all_over=lambda: (1.0, 0.0), lacks=()
        )
        given = {"arm": SimpleNamespace(name="a"), "measured": None, "range_noise_m": None, "notes": ()}
        run = SimpleNamespace(held_out=held_out, how="poses", found=found, **given)
        result = assess(run)[0]
        assert ("no better than the nominal arm" in headline(run)) == (result == "poor")
        return result

    assert noise.mean() > 0  # by chance the mean error alone is less
    assert [grade(0.0, True), grade(1e-4, True), grade(1.5e-3, True)] == ["poor", "fair", "good"]
    assert [grade(1e-4, False), grade(1.5e-3, True, poses=1)] == ["poor", "poor"]


def test_a_written_urdf_is_the_identified_arm():
    rng = np.random.default_rng(2)
    arm = open_arm("six_r")
    T = arm.forward(rng.uniform(-1, 1, (4, 6)))
    model = Model.of(arm, Measured(rng.uniform(-1, 1, (4, 6)), T[:, None, :3, 3], T[:, :3, :3]), backlash=False)
    for modified in ("standard", "modified"):
        shaped = replace(model, arm=replace(arm, convention=modified))
        x = shaped.nominal()
        x[shaped.table_at : shaped.sources_at] += rng.normal(0, 0.01, 30)
        x[shaped.table_at + 29] = 0.0  # beta of row 6 is the tool's
        q = rng.uniform(-1, 1, 6)
        at = shaped.tool_in_base(x, q[None], None)[0]
        np.testing.assert_allclose(walk(ET.fromstring(Corrected(shaped, x, np.zeros(len(x))).urdf()), q), at, atol=1e-9)


def walk(robot, q):
    """Follow a URDF's joints from the base to the tool: the oracle."""
    T, angles = np.eye(4), iter(q)
    for joint in robot.findall("joint"):
        origin = joint.find("origin")
        xyz, rpy = (np.array([float(v) for v in origin.get(key).split()]) for key in ("xyz", "rpy"))
        T = T @ pose(Rotation.from_euler("xyz", rpy).as_matrix(), xyz)
        if joint.get("type") == "revolute":
            axis = np.array([float(v) for v in joint.find("axis").get("xyz").split()])
            T = T @ pose(Rotation.from_rotvec(axis * next(angles)).as_matrix(), np.zeros(3))
    return T


def test_plan(tmp_path, capsys):
    answer = said(capsys, "plan", "--arm", "six_r", "-n", "3", "-o", tmp_path / "plan.csv", "--json")
    assert answer.code == 0
    (found,) = answer.lines
    assert len(found["q_rad"]) == 3
    assert (np.diff(found["sigma_m"]) < 0).all()
    assert len((tmp_path / "plan.csv").read_text().splitlines()) == 4
    assert_rejected(said(capsys, "plan", "--arm", "six_r", "--rig", tmp_path / "rig.json"), "--data")
    assert_rejected(said(capsys, "plan", "--arm", "six_r", "-o", tmp_path / "plan.toml"), "plan.toml", ".csv")
    printed = said(capsys, "plan", "--arm", "six_r", "-n", "3", "-o", tmp_path / "plan.csv").out
    for q in np.degrees(found["q_rad"]):
        assert all(f"{v:.2f}" in printed for v in q)
    assert printed.endswith(f"written: {tmp_path / 'plan.csv'}\n")


def in_degrees(lines):
    """The same with degrees under the names of radians."""
    rows = [line.split(",") for line in lines]
    return [lines[0], *(",".join([*(str(np.degrees(float(q))) for q in row[:6]), *row[6:]]) for row in rows[1:])]


SIX_NAMES = ",".join(f"q{i}_rad" for i in range(1, 7))


@pytest.mark.parametrize(
    ("spoil", "parts"),
    [
        (lambda lines: ["q1_rad,q2_rad", "1,2"], ["line 1", "q3_rad"]),
        (lambda lines: ["a,b", "1,2"], ["line 1", "q1_rad", "q1_deg"]),
        (lambda lines: [SIX_NAMES, "0,0,0,0,0,0"], ["line 1", "p1_x_mm"]),
        (lambda lines: [f"{SIX_NAMES},p1_x_mm,p1_y_mm", "0,0,0,0,0,0,1,2"], ["p1_z_mm"]),
        (lambda lines: [*lines[:4], "x" + lines[4], *lines[5:]], ["line 5", "q1_rad"]),
        (in_degrees, ["degrees", "q1_deg"]),
    ],
)
def test_a_file_that_cannot_be_read_is_explained(tmp_path, capsys, spoil, parts):
    path = poses_csv(tmp_path / "bad.csv")
    path.write_text("\n".join(spoil(path.read_text().splitlines())) + "\n")
    assert_rejected(said(capsys, "--arm", "six_r", "--data", path), "bad.csv", *parts)


def test_mistakes_at_the_command_line(tmp_path, capsys):
    data = poses_csv(tmp_path / "p.csv")
    assert_rejected(said(capsys, "--data", data), "--arm")
    assert_rejected(said(capsys, "--arm", "six_rr", "--data", data), "six_rr", "six_r, puma560")
    assert_rejected(said(capsys, "--arm", "six_r", "--data", tmp_path / "none.csv"), "none.csv", "no such file")
    assert_rejected(said(capsys, "--arm", "six_r", "--data", data, "--prior", "a2"), "NAME=SIGMA")
    assert_rejected(said(capsys, "--arm", "six_r", "--data", data, "--prior", "b2=1"), "b2")
    assert_rejected(said(capsys, "--arm", "six_r", "--data", poses_csv(tmp_path / "few.csv", n=4)), "4 poses", "6")


def test_fewer_numbers_than_parameters_are_said_and_still_fitted(tmp_path, capsys, one_part):
    answer = said(capsys, "--arm", "six_r", "--data", poses_csv(tmp_path / "p.csv", n=12), "--json")
    assert answer.code == 0
    assert "12 poses are 36 numbers for" in answer.err


def test_mistakes_in_the_data_are_named_and_do_not_spoil_the_held_out_line(tmp_path, capsys, one_part):
    path = poses_csv(tmp_path / "p.csv", n=60)
    rows = [line.split(",") for line in path.read_text().splitlines()]
    for line in (8, 26, 27):
        rows[line - 1][6] = str(float(rows[line - 1][6]) + 10)
    path.write_text("\n".join(",".join(row) for row in rows))
    answer = said(capsys, "--arm", "six_r", "--data", path, "--json")
    (found,) = answer.lines
    assert found["left_out_lines"] == [8, 26, 27]
    assert "3 taken for mistakes apart" in found["validation"]
    assert found["identified"]["max_m"] < 1e-3  # one mistake that stayed in would be 10 mm
    parameters = {p["name"]: p for p in found["parameters"]}
    assert parameters["a2"]["value"] == pytest.approx(0.2535, abs=3 * parameters["a2"]["sigma"])


def with_sign(line):
    """A row whose second joint counts the other way."""
    row = line.split(",")
    return ",".join([row[0], str(-float(row[1])), *row[2:]])


@pytest.mark.parametrize(
    ("spoil", "said_of_it"),
    [
        (lambda lines: [], "no rows"),
        (lambda lines: lines[:1], "no rows"),
        (lambda lines: [lines[0].replace("q6_rad", "elbow"), *lines[1:]], "5 joints (q1_rad..q5_rad); six_r has 6"),
        (
            lambda lines: [lines[0] + ",q7_rad", *(line + ",0" for line in lines[1:])],
            "7 joints (q1_rad..q7_rad); six_r has 6",
        ),
        (lambda lines: [line.replace("p1_", "p2_") for line in lines], "no point 1"),
        (
            lambda lines: [
                lines[0],
                *(",".join(line.split(",")[1:6] + line.split(",")[:1] + line.split(",")[6:]) for line in lines[1:]),
            ],
            "order",
        ),
        (lambda lines: [lines[0], *(",".join(["1.5", *line.split(",")[1:]]) for line in lines[1:6])], "other joints"),
        (
            lambda lines: [lines[0], *map(with_sign, lines[1:])],
            "to validate with: the data fit this arm if the sign is",
        ),
        (
            lambda lines: [f"{lines[0]},p2_x_mm,p2_y_mm,p2_z_mm", *(f"{line},1,2,3" for line in lines[1:])],
            "have 2 tracked points a pose; those identified with have 1 tracked point a pose",
        ),
        (lambda lines: FITTED, "all poses are among those to identify from"),
        (lambda lines: [FITTED[0], *FITTED[5:20]], "all poses are among those to identify from"),
    ],
)
def test_a_wrong_file_to_validate_with_is_rejected_before_the_fit(tmp_path, capsys, monkeypatch, spoil, said_of_it):
    data, other = poses_csv(tmp_path / "p.csv", n=40), poses_csv(tmp_path / "o.csv", n=30, seed=1)
    FITTED[:] = data.read_text().splitlines()
    other.write_text("\n".join(spoil(other.read_text().splitlines())))

    def never(*arguments, **options):
        raise AssertionError("fitted before the file was looked at")

    monkeypatch.setattr("armsight.loop.identify.validate.identify", never)
    answer = said(capsys, "--arm", "six_r", "--data", data, "--validate", other)
    assert_rejected(answer, str(other), said_of_it)
    missing = said(capsys, "--arm", "six_r", "--data", data, "--validate", tmp_path / "none.csv")
    assert_rejected(missing, "none.csv")


@pytest.mark.parametrize(("own", "threads"), [(None, "1"), ("2", "2")])
def test_small_matrices_are_not_shared_between_threads(own, threads):
    code = "import os, armsight.app.main as main; main.group.get_command(None, 'identify');"
    code += "print(os.environ['OPENBLAS_NUM_THREADS'])"
    setting = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    setting |= {} if own is None else {"OPENBLAS_NUM_THREADS": own}
    done = subprocess.run([sys.executable, "-c", code], env=setting, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == threads


def test_no_folder_made_for_results_stays_after_a_mistake(tmp_path, capsys):
    few, there = poses_csv(tmp_path / "few.csv", n=4), tmp_path / "there"
    assert_rejected(said(capsys, "--arm", "six_r", "--data", few, "-o", tmp_path / "new" / "deep"), "4 poses")
    assert not (tmp_path / "new").exists()
    there.mkdir()
    assert_rejected(said(capsys, "--arm", "six_r", "--data", few, "-o", there), "4 poses")
    assert there.is_dir()
    assert_rejected(said(capsys, "--arm", "six_r", "--data", few, "-o", few), "cannot be made")
    empty = tmp_path / "empty"
    empty.mkdir()
    # A name too long, and a file in the way, come up only after the folder before them is made.
    for out in (tmp_path / "new" / "deep" / ("x" * 300), tmp_path / "new" / ".." / "few.csv" / "deep"):
        assert_rejected(said(capsys, "--arm", "six_r", "--data", few, "-o", out), "cannot be made")
        assert not (tmp_path / "new").exists()
    assert_rejected(said(capsys, "--arm", "six_r", "--data", few, "-o", tmp_path / "new" / ".." / "empty"), "4 poses")
    assert not (tmp_path / "new").exists()
    assert empty.is_dir()


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        (lambda text: text.replace("convention", "convetion"), ["convention"]),
        (lambda text: text.replace("a_mm", "a_inch", 1), ["joint 1", "a_inch", "a_mm"]),
        (lambda text: text.replace("d_m = 0.438", "d_m = 438"), ["joint 1", "d_mm"]),
        (lambda text: text.replace("[[joint]]", "", 1), ["joint"]),
        (lambda text: text + "x = [", ["not TOML"]),
    ],
)
def test_what_is_wrong_in_an_arm_file_is_reported(tmp_path, capsys, change, parts):
    path = arm_toml(tmp_path / "arm.toml", open_arm("six_r"))
    path.write_text(change(path.read_text()))
    data = poses_csv(tmp_path / "p.csv")
    assert_rejected(said(capsys, "--arm", path, "--data", data), "arm.toml", *parts)


def test_full_poses_with_covariance_are_read(tmp_path):
    R = Rotation.from_euler("xyz", [0.1, 0.2, 0.3])
    qx, qy, qz, qw = R.as_quat()
    upper = [f"cov_{i}{j}" for i in range(6) for j in range(i, 6)]
    C = np.diag([1, 2, 3, 4, 5, 6.0])
    path = tmp_path / "p.csv"
    names = [*(f"q{i}_deg" for i in range(1, 7)), "x_m", "y_m", "z_m", "qw", "qx", "qy", "qz", *upper, "approach1"]
    names += [f"approach{i}" for i in range(2, 7)]
    entries = [90, 0, 0, 0, 0, 0, 1, 2, 3, qw, qx, qy, qz, *(C[int(n[4]), int(n[5])] for n in upper), 1, -1, 0, 1, 1, 1]
    path.write_text(",".join(names) + "\n" + ",".join(map(repr, map(float, entries))) + "\n")
    measured = read_poses(path).measured
    assert measured.q[0, 0] == pytest.approx(np.pi / 2)
    np.testing.assert_allclose(measured.R_rig_body[0], R.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(measured.cov[0, :3, :3], R.as_matrix().T @ C[:3, :3] @ R.as_matrix(), atol=1e-12)
    np.testing.assert_array_equal(measured.approach[0], [1, -1, 0, 1, 1, 1])


def apart(tmp_path, n=40):
    """The poses of ``poses_csv`` as what vision wrote, shot by shot, one missed, and their joint angles."""
    head, *rows = [line.split(",") for line in poses_csv(tmp_path / "whole.csv", n=n).read_text().split()]
    seen = [f"{k:04d},ok,,{','.join(row[6:])}" for k, row in enumerate(rows)]
    seen[3] = "0003,missed,no body,,,"
    (tmp_path / "seen.csv").write_text("\n".join(["shot,status,reason," + ",".join(head[6:]), *seen]) + "\n")
    return tmp_path / "seen.csv", head[:6], [row[:6] for row in rows]


def read_joined(data, joints):
    return read_measured(data, open_arm("six_r"), joints)


def test_joints_of_a_table_of_their_own(tmp_path, armsight):
    seen, head, q = apart(tmp_path)
    whole = read_poses(tmp_path / "whole.csv").measured.q
    by_row, by_name = tmp_path / "rows.csv", tmp_path / "names.csv"
    by_row.write_text("\n".join([",".join(head), *(",".join(row) for row in q)]))
    read = read_joined(seen, by_row)
    np.testing.assert_allclose(read.measured.q, np.delete(whole, 3, axis=0), atol=1e-12)
    assert read.lines[:4].tolist() == [2, 3, 4, 6]
    assert "1 of 40 shots were missed" in read.notes[-1]
    backwards = [f"img/{k:04d}.png," + ",".join(q[k]) for k in range(39, 1, -1)]
    by_name.write_text("\n".join(["image," + ",".join(head), *backwards]))
    read = read_joined(seen, by_name)
    np.testing.assert_allclose(read.measured.q, whole[[2, *range(4, 40)]], atol=1e-12)
    assert "2 of 40 poses have no row" in " ".join(read.notes)
    seen.write_text(seen.read_text().replace(",".join(seen.read_text().split("\n")[6].split(",")[3:]), "nan,,null"))
    by_row.write_text("\n".join([",".join(head), *(",".join([""] * 6 if k == 8 else row) for k, row in enumerate(q))]))
    np.testing.assert_allclose(read_joined(seen, by_row).measured.q, np.delete(whole, [3, 5, 8], axis=0), atol=1e-12)
    by_row.write_text("\n".join([",".join(head), *(",".join(row) for row in q[1:])]))
    assert_rejected(armsight("identify", "--arm", "six_r", "--data", seen, "--joints", by_row), "39", "40", "image")
    whole_too = armsight("identify", "--arm", "six_r", "--data", tmp_path / "whole.csv", "--joints", by_name)
    assert_rejected(whole_too, "q1_rad", "--joints")


def test_joints_by_time_are_those_of_rests(tmp_path):
    q = np.repeat(np.arange(3.0)[:, None] * 0.1 + np.zeros(6), 20, axis=0)  # rests of 2 s, and jumps in 0.1 s
    rows = [f"{0.1 * k:.1f}," + ",".join(map(str, one)) for k, one in enumerate(q)]
    joints, seen = tmp_path / "joints.csv", tmp_path / "seen.csv"
    joints.write_text("\n".join(["t_s," + ",".join(f"q{k}_rad" for k in range(1, 7)), *rows]))
    shots = [f"{k},{0.25 * k + 0.05},1,2,{k}" for k in range(40)]
    seen.write_text("\n".join(["shot,t_s,p1_x_m,p1_y_m,p1_z_m", *shots]))
    read = read_joined(seen, joints)
    np.testing.assert_allclose(read.measured.q[:, 0], [0.0, 0.1, 0.2], atol=1e-12)
    assert np.all(np.abs((0.25 * (read.lines - 2) + 0.05) % 2.0 - 1.0) < 0.5)
    seen.write_text("\n".join(["shot,t_s,p1_x_m,p1_y_m,p1_z_m", *(f"{k},{k + 1e6},1,2,{k}" for k in range(40))]))
    with pytest.raises(InputError, match="other clocks"):
        read_joined(seen, joints)


@pytest.mark.parametrize("joints", [4, 7])
def test_an_arm_of_any_number_of_joints_is_reported(joints, tmp_path, capsys):
    arm = {4: FOUR, 7: MODELS["iiwa"]}[joints]
    w, rng = worn(joints, arm, waves=1), np.random.default_rng(joints)
    spec = arm.name if joints > 4 else arm_toml(tmp_path / "arm.toml", arm)
    tables = [tracked_csv(tmp_path / f"{part}.csv", w, n, rng) for part, n in (("fit", 60), ("other", 20))]
    out = tmp_path / "out"
    answer = said(capsys, "--arm", spec, "--data", tables[0], "--validate", tables[1], "-o", out)
    assert answer.code == 0, answer.err
    assert "\nheld-out error " in answer.out
    assert (out / "report-joints.png").stat().st_size > 10_000
    assert f">{arm.joint_names[-1]}<" in (out / "report.html").read_text()


def test_what_was_found_is_printed_and_stored_though_the_report_cannot_be_drawn(
    tmp_path, monkeypatch, capsys, one_part
):
    data, out = poses_csv(tmp_path / "p.csv"), tmp_path / "out"
    monkeypatch.setattr("armsight.app.show.report.Report.write", Mock(side_effect=RuntimeError("no figure")))
    with pytest.raises(RuntimeError, match="no figure"):
        run("identify", "--arm", "six_r", "--data", data, "-o", out)
    assert "\nheld-out error " in capsys.readouterr().out
    assert {path.name for path in out.iterdir()} >= {"corrected.toml", "zeros.toml", "identify.json"}


def test_sigmas_known_to_be_too_small_are_said_first_and_widened(tmp_path, capsys):
    data, other, loud = (poses_csv(tmp_path / f"{k}.csv", seed=k) for k in range(3))
    head, *rows = loud.read_text().splitlines()
    numbers = np.array([row.split(",") for row in rows], float)
    numbers[:, 6:] += np.random.default_rng(0).normal(0, 0.2, (len(rows), 3))  # mm: seven times the noise
    np.savetxt(loud, numbers, "%.9f", ",", header=head, comments="")
    plain, wide = (said(capsys, "--arm", "six_r", "--data", data, "--validate", v, "--json") for v in (other, loud))
    assert "times as large as predicted" not in plain.err
    note = next(line for line in wide.err.splitlines() if line.startswith("note: "))
    over = wide.lines[0]["residual_over_predicted"]
    assert 4 < over < 10
    assert f"are {over:.2f} times as large as predicted" in note
    sigmas = [{p["name"]: p["sigma"] for p in run.lines[0]["parameters"]} for run in (plain, wide)]
    assert sigmas[1]["a2"] == pytest.approx(over * sigmas[0]["a2"])
    found = armsight.identify(armsight.open_arm("six_r"), read_poses(data), other=read_poses(loud))
    assert found.value("a2")[1] == pytest.approx(sigmas[1]["a2"])  # one computation for both
    assert found.held_out.scale == pytest.approx(over)
