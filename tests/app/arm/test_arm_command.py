"""``armsight arm``: its answers against the library's own, its text, and every kind of bad input one by one."""

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from armsight.geometry.pose import pose
from armsight.geometry.rotation import from_euler_zyx
from armsight.robot.arm_file import split_arm
from armsight.robot.kinematics.reach import reach
from armsight.robot.models import MODELS
from armsight.robot.urdf.write import write_urdf
from cli_runs import assert_has, assert_rejected

SIX_R = MODELS["six_r"]
Q_DEG = (10, -20, 30, 0, -90, 5)
HOME = (657.8, 0, 438, -90, 0, -90)


def on_one_line(text):
    return " ".join(text.split())


def test_forward_kinematics_with_negative_angles_as_plain_arguments(armsight):
    said = armsight("arm", "fk", "six_r", *Q_DEG).done()
    assert (
        said.out.splitlines()[0] == "tool at (627.337, 110.616, 459.803) mm, euler zyx (-80.870, 4.924, -100.037) deg"
    )
    (found,) = armsight("arm", "fk", "six_r", *Q_DEG, "--json").lines
    np.testing.assert_array_equal(found["T_base_tool"], SIX_R.forward(np.radians(Q_DEG)))
    np.testing.assert_allclose(found["q_deg"], Q_DEG, atol=1e-13)
    np.testing.assert_allclose(found["q_rad"], np.radians(Q_DEG))
    assert found["within_limits"] is True


@pytest.mark.parametrize(
    "angles", [("-1e1", "-.5", "0", "-0", "-90.0", "+5"), ("--json", "-1", "-2", "-3", "-4", "-5", "-6")]
)
def test_numbers_are_read_however_they_are_written(angles, armsight):
    said = armsight("arm", "fk", "ur5", *angles)
    assert said.code == 0, said


def test_the_home_pose_is_the_sources(armsight):
    said = armsight("arm", "fk", "six_r", 0, 0, 0, 0, -90, 0, "--json")
    want = [[0, 0, 1, 0.6578], [-1, 0, 0, 0], [0, -1, 0, 0.438], [0, 0, 0, 1]]
    np.testing.assert_allclose(said.lines[0]["T_base_tool"], want, atol=1e-15)
    np.testing.assert_allclose(said.lines[0]["position_mm"], HOME[:3], atol=1e-12)


def test_the_jacobian(armsight):
    (found,) = armsight("arm", "jacobian", "six_r", *Q_DEG, "--json").lines
    q = np.radians(Q_DEG)
    np.testing.assert_array_equal(found["J_base"], SIX_R.jacobian(q))
    assert found["manipulability"] == pytest.approx(abs(np.linalg.det(SIX_R.jacobian(q))))
    text = armsight("arm", "jacobian", "six_r", *Q_DEG).out.splitlines()
    printed = np.array([line.split() for line in text[1:7]], float)
    np.testing.assert_allclose(printed, SIX_R.jacobian(q), atol=5.1e-7)


def test_inverse_kinematics_gives_every_solution_with_its_configuration(armsight):
    pose_of = (300, 120, 550, -30, 40, 20)
    found = armsight("arm", "ik", "ur5", *pose_of, "--json").one
    T = pose(from_euler_zyx(*np.radians(pose_of[3:])), np.array(pose_of[:3]) / 1e3)
    np.testing.assert_allclose(found["T_base_tool"], T, atol=1e-15)
    assert found["reachable"]
    assert found["reason"] is None
    assert found["nearest"] is None
    assert len(found["solutions"]) == 8
    for solution in found["solutions"]:
        np.testing.assert_allclose(MODELS["ur5"].forward(solution["q_rad"]), T, atol=1e-9)
        np.testing.assert_allclose(np.radians(solution["q_deg"]), solution["q_rad"])
        assert solution["within_limits"]
    seen = {tuple(solution["configuration"].values()) for solution in found["solutions"]}
    assert len(seen) == 8
    assert set(found["solutions"][0]["configuration"]) == {"shoulder", "elbow", "wrist"}


def test_what_ik_prints_leads_back_to_the_pose(armsight):
    rows = armsight("arm", "ik", "six_r", 500, 0, 500, 0, 90, 0).out.splitlines()[2:]
    assert len(rows) == 4
    for row in rows:
        q = row.split()[1:7]
        said = armsight("arm", "fk", "six_r", *q)
        at = said.out.split("mm")[0].removeprefix("tool at (").rstrip(") ").split(", ")
        np.testing.assert_allclose(np.array(at, float), [500, 0, 500], atol=0.05)  # angles of three decimals
    assert "outside limits: joint1 joint2" in rows[2]


def test_a_pose_out_of_reach_is_an_answer_with_exit_code_1(armsight):
    said = armsight("arm", "ik", "six_r", 900, 0, 500, 0, 90, 0)
    assert said.code == 1
    assert said.err == ""
    assert_has(said.out, "unreachable: upper arm and forearm are too short", "nearest pose within limits: (65")
    (found,) = armsight("arm", "ik", "six_r", 900, 0, 500, 0, 90, 0, "--json").lines
    assert not found["reachable"]
    assert found["solutions"] == []
    nearest = found["nearest"]
    np.testing.assert_allclose(SIX_R.forward(nearest["q_rad"]), nearest["T_base_tool"], atol=1e-12)
    off = np.linalg.norm(np.array(nearest["T_base_tool"])[:3, 3] - [0.9, 0, 0.5])
    assert nearest["off_m"] == pytest.approx(off)
    assert SIX_R.within_limits(nearest["q_rad"])


def test_a_pose_that_only_joints_beyond_their_limits_reach_has_exit_code_1(armsight):
    said = armsight("arm", "ik", "six_r", *_behind(), "--json")
    assert said.code == 1
    (found,) = said.lines
    assert found["solutions"]
    assert not any(solution["within_limits"] for solution in found["solutions"])
    assert found["reason"].startswith("outside limits")
    assert found["nearest"] is not None


def _behind():
    """A pose that needs joint 1 at 176 degrees, six degrees beyond its limit, and reaching over does not help."""
    T = SIX_R.forward(np.radians([176, 20, 60, 0, -90, 0]))
    z, y, x = np.degrees([np.arctan2(T[1, 0], T[0, 0]), np.arcsin(-T[2, 0]), np.arctan2(T[2, 1], T[2, 2])])
    return (*(1e3 * T[:3, 3]), z, y, x)


def test_angles_beyond_the_limits_are_noted(armsight):
    said = armsight("arm", "fk", "six_r", 0, 60, 0, 0, 0, 0).done()
    assert said.err == "note: joint2 at 60.000 deg is outside its limits -180.000 to 45.000 deg\n"


def test_the_list_and_the_numbers_of_an_arm(armsight):
    listed = armsight("arm", "list")
    assert [line.split()[0] for line in listed.out.splitlines()] == list(MODELS)
    (arms,) = armsight("arm", "list", "--json").lines
    assert [arm["arm"] for arm in arms] == list(MODELS)
    text = on_one_line(armsight("arm", "show", "six_r").out)
    assert "joint2 251.500 0.000 0 0 +1 -180 45 90 360 3600 0" in text
    assert "tool at home: (657.800, 0.000, 438.000) mm" in text
    assert "reach of the tool: 657.8 mm from joint 1's axis" in text
    assert "limits are chosen" in text
    (found,) = armsight("arm", "show", "six_r", "--json").lines
    assert [joint["a_m"] for joint in found["joints"]] == SIX_R.a.tolist()
    assert [joint["qd_max_rad_s"] for joint in found["joints"]] == SIX_R.qd_max.tolist()


@pytest.mark.parametrize("name", MODELS)
def test_reach_is_what_no_pose_goes_beyond(name):
    arm = MODELS[name]
    extent = reach(arm)
    q = np.random.default_rng(99).uniform(arm.q_min, arm.q_max, (100_000, arm.joints))
    p = arm.forward(q)[:, :3, 3] - [*arm.T_base_0[:2, 3], 0.0]
    seen = np.hypot(p[:, 0], p[:, 1]).max(), -p[:, 2].min(), p[:, 2].max()
    found = extent.radius_m, -extent.low_m, extent.high_m
    for far, most in zip(seen, found, strict=True):
        assert far <= most + 1e-9
        assert far > 0.9 * most - 0.05  # random poses come near it


def test_the_reach_of_six_r_is_all_its_links_in_one_line():
    # Axis 5 rotates the tool into the line: a1 + a2 + a3 + a4 + d6; upwards from joint 2, without a1, on d1.
    extent = reach(SIX_R)
    assert extent.radius_m == pytest.approx(0.0365 + 0.2515 + 0.125 + 0.092 + 0.1528, abs=1e-8)
    assert extent.high_m == pytest.approx(0.438 + 0.2515 + 0.125 + 0.092 + 0.1528, abs=1e-8)


def test_the_picture_is_a_png_and_not_empty(tmp_path, armsight):
    path = tmp_path / "arm.png"
    assert armsight("arm", "show", "six_r", "-o", path).code == 0
    data = path.read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    assert struct.unpack(">II", data[16:24]) == (1500, 840)
    assert len(data) > 20_000


def test_an_arm_goes_out_as_urdf_and_answers_from_there(tmp_path, armsight):
    path = tmp_path / "arm.urdf"
    said = armsight("arm", "urdf", "irb120", "-o", path)
    assert (said.code, said.out) == (0, f"{path}\n")
    (here,) = armsight("arm", "fk", path, *Q_DEG, "--json").lines
    (there,) = armsight("arm", "fk", "irb120", *Q_DEG, "--json").lines
    np.testing.assert_allclose(here["T_base_tool"], there["T_base_tool"], atol=1e-12)
    assert here["arm"] == "irb120"


def test_a_toml_file_is_an_arm_as_well(tmp_path, armsight):
    path = tmp_path / "arm.toml"
    rows = [
        f"[[joint]]\na_m = {float(SIX_R.a[i])!r}\nd_m = {float(SIX_R.d[i])!r}\nalpha_rad = {float(SIX_R.alpha[i])!r}\n"
        f"offset_rad = {float(SIX_R.offset[i])!r}\n"
        for i in range(6)
    ]
    path.write_text(f'name = "mine"\nconvention = "{SIX_R.convention}"\n' + "".join(rows))
    said = armsight("arm", "show", path).done()
    assert said.out.startswith("mine: ")
    (here,) = armsight("arm", "fk", path, *Q_DEG, "--json").lines
    np.testing.assert_allclose(here["T_base_tool"], SIX_R.forward(np.radians(Q_DEG)), atol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("fk", "six_r"), ("6 joints", "0 angles were given")),
        (("fk", "six_r", 1, 2, 3), ("6 joints", "3 angles were given")),
        (("fk", "six_r", 1, 2, 3, 4, 5, 6, 7), ("7 angles were given",)),
        (("jacobian", "six_r", 1, 2, 3, 4, 5), ("5 angles were given",)),
        (("fk", "six_r", 1, 2, 3, 4, 5, "nan"), ("q6 is nan", "finite")),
        (("fk", "six_r", "-inf", 2, 3, 4, 5, 6), ("q1 is -inf", "finite")),
        (("fk", "six_r", 1, 2, "elbow", 4, 5, 6), ("q3 is 'elbow'", "must be a number")),
        (("fk", "six_r", 1, 2, 3, 4, 5, 5000), ("q6 is 5000 degrees", "no joint rotates further")),
        (("fk", "seven_r", 1, 2, 3, 4, 5, 6), ("'seven_r' is unknown", "six_r, puma560, ur5, ur10, irb120")),
        (("show", "seven_r"), ("'seven_r' is unknown", "six_r")),
        (("ik", "six_r", 1, 2, 3), ("six numbers, x y z euler_z euler_y euler_x", "3 were given")),
        (("ik", "six_r", 400, 0, "far", 0, 0, 0), ("z is 'far'",)),
        (("ik", "six_r", 400, 0, 500, 0, "nan", 0), ("euler_y is nan",)),
        (("ik", "seven_r", 400, 0, 500, 0, 0, 0), ("'seven_r' is unknown",)),
        (("fk", "six_r", 1, 2, 3, 4, 5, 6, "--jsn"), ("no such option: --jsn",)),
        (("fk", "none.urdf", 1, 2, 3, 4, 5, 6), ("none.urdf: no such file",)),
        (("show", "six_r#hand"), ("a link behind # belongs to .urdf files",)),
        (("show", "six_r", "-o", "none/arm.png"), ("none/arm.png: cannot be written", "no folder")),
        (("urdf", "six_r", "-o", "none/arm.urdf"), ("none/arm.urdf: cannot be written", "no folder")),
        (("urdf", "seven_r", "-o", "arm.urdf"), ("'seven_r' is unknown",)),
    ],
)
def test_mistakes_are_one_line_and_exit_code_2(arguments, said, armsight, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert_rejected(armsight("arm", *arguments), *said)
    assert list(tmp_path.iterdir()) == []


def test_a_malformed_urdf_is_named_with_its_element(armsight, tmp_path):
    path = tmp_path / "arm.urdf"
    write_urdf(SIX_R, path)
    whole = path.read_text()
    path.write_text(whole[:700])
    assert_rejected(armsight("arm", "show", path), path, "not XML")
    path.write_text(whole.replace('<axis xyz="0 0 1" />', '<axis xyz="0 0" />', 1))
    assert_rejected(armsight("arm", "ik", path, 400, 0, 500, 0, 0, 0), path, "joint 'joint1'", '<axis xyz="0 0">')
    assert_rejected(armsight("arm", "urdf", path, "-o", path), "is read, and would be written over")
    assert '<axis xyz="0 0" />' in path.read_text()


def test_readings_of_an_identified_arm_are_corrected(armsight, tmp_path):
    """A curve of 0.01 rad in joint 1, within the readings seen: the arm is where it is at the true angle."""
    from armsight.loop.identify.corrected import Corrected
    from armsight.loop.identify.measured import Measured
    from armsight.loop.identify.model import Model

    home = SIX_R.home[None]
    model = Model.of(SIX_R, Measured(home, np.zeros((1, 1, 3))), backlash=False)
    model = model.with_seen(home + np.array([[-2.0], [2.0]]))
    x = model.nominal()
    x[model.names.index("wave1_cos1")] = 0.01
    path, q = tmp_path / "corrected.toml", np.radians(Q_DEG)
    Corrected(model, x, np.zeros(len(x))).save(path)
    said = armsight("arm", "fk", path, *Q_DEG, "--json")
    true = q + 0.01 * np.cos(q[0]) * np.eye(6)[0]
    np.testing.assert_allclose(
        said.lines[0]["T_base_tool"], replace(SIX_R, T_flange_tool=np.eye(4)).forward(true), atol=1e-12
    )
    assert "curves" in said.err
    assert armsight("arm", "show", path).code == 0


def test_a_link_that_is_named_counts_everywhere(armsight):
    path = Path(__file__).parents[2] / "robot" / "data" / "fingers.urdf"
    said = armsight("identify", "plan", "--arm", f"{path}#nothing", "-n", "1")
    assert said.code == 2
    assert "link 'nothing' is not behind 4 to 7 rotary joints alone; these are: tool0, camera_link" in said.err
    said = armsight("arm", "fk", f"{path}#camera_link", "0", "0", "0", "0", "0").done()
    assert "note: " in said.err
    assert split_arm("a.urdf#b") == ("a.urdf", "b")
    assert split_arm("a.urdf") == ("a.urdf", None)
