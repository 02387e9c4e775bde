"""``armsight arm calibrated``: a single arm's table beside that of its kind."""

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest

from armsight.geometry.rotation import quaternion_wxyz
from armsight.robot.calibration_file import calibration_text, read_calibration
from armsight.robot.models import MODELS
from armsight.robot.urdf.read import read_urdf
from cli_runs import assert_has

pytest.importorskip("yaml")
UR5E = MODELS["ur5e"]
#: One whose forearm is 0.4 mm longer.
LONGER = dataclasses.replace(UR5E, a=UR5E.a - 4e-4 * np.eye(6)[2])


def test_the_difference_is_said_and_the_arm_converted(armsight, tmp_path):
    path, out, back = tmp_path / "calibration.yaml", tmp_path / "arm.urdf", tmp_path / "back.yaml"
    path.write_text(calibration_text(LONGER, UR5E)[0])
    said = armsight("arm", "calibrated", "ur5e", path, "-o", out).done()
    assert "ur5e_calibrated puts its tool 0.400 mm from ur5e on the mean" in said.out
    q = np.array([0.1, -1.0, 0.9, 0.3, -0.4, 0.2])
    np.testing.assert_allclose(read_urdf(out).forward(q), LONGER.forward(q), atol=1e-9)
    said = armsight("arm", "calibrated", "ur5e", out, "-o", back, "--json")
    found = json.loads(said.out)
    assert found["tool_apart_mean_m"] == pytest.approx(4e-4, abs=1e-9)
    assert found["changes"]["a_m"][2] == pytest.approx(-4e-4, abs=1e-9)
    np.testing.assert_allclose(read_calibration(back, UR5E).forward(q), LONGER.forward(q), atol=1e-9)


def test_mistakes_are_one_line_and_nothing_is_written(armsight, tmp_path):
    path, out = tmp_path / "calibration.yaml", tmp_path / "arm.obj"
    path.write_text(calibration_text(UR5E, UR5E)[0])
    said = armsight("arm", "calibrated", "ur5e", path, "-o", out)
    assert said.code == 2
    assert "an arm is written as .urdf or .yaml" in said.err
    said = armsight("arm", "calibrated", "xarm7", path)
    assert said.code == 2
    assert "joint1 is missing; xarm7 has joint1" in said.err
    assert not out.exists()


def test_a_number_with_an_exponent_and_without_a_point_is_one(armsight, tmp_path):
    data = Path(__file__).parents[2] / "robot" / "data"
    said = armsight("arm", "calibrated", "ur5", data / "my_ur5.yaml")
    assert "ur5_calibrated puts its tool 1.061 mm from ur5 on the mean, 2.192 mm at most" in said.out
    (tmp_path / "plain.yaml").write_text((data / "my_ur5.yaml").read_text().replace("-1e-05", "-0.00001"))
    assert armsight("arm", "calibrated", "ur5", tmp_path / "plain.yaml").out == said.out


def test_the_controllers_own_file_of_a_real_ur3(armsight, tmp_path):
    """As its owner posted it (MyRobotLab/pyrobotlab issue 145): axes a little off parallel, normals 12 to 30 m away."""
    path = Path(__file__).parents[2] / "robot" / "data" / "ur3_calibration.conf"
    said = armsight("arm", "calibrated", "ur3", path)
    assert "ur3_calibrated puts its tool 0.988 mm from ur3 on the mean, 2.767 mm at most" in said.out
    assert "is it the calibration of another kind of arm" in armsight("arm", "calibrated", "ur5", path).err
    assert "six_r is none of theirs" in armsight("arm", "calibrated", "six_r", path).err
    (tmp_path / "cut.conf").write_text(path.read_text().replace("delta_d", "delta_x"))
    said = armsight("arm", "calibrated", "ur3", tmp_path / "cut.conf")
    assert_has(said.err, "holds delta_theta, delta_a, delta_x", "expected delta_d = [6 numbers]")


def test_the_body_on_the_flange_of_a_corrected_arm_does_not_count(armsight, tmp_path):
    """The tool of corrected.toml is the measured body, far from the flange and rotated: the arm is 0.4 mm off, not 200."""
    limits = ("q_min_rad", "q_max_rad", "qd_max_rad_s", "qdd_max_rad_s2", "qddd_max_rad_s3", "home_rad")
    ours = {key: getattr(LONGER, re.sub("_rad.*", "", key)) for key in limits}
    ours |= {"offset_rad": LONGER.offset, "d_m": LONGER.d, "a_m": LONGER.a, "alpha_rad": LONGER.alpha}
    rows = "".join(
        f'[[joint]]\nname = "j{i}"\ndirection = {int(LONGER.direction[i])}\nbeta_rad = 0.0\n'
        + "".join(f"{key} = {float(value[i])!r}\n" for key, value in ours.items())
        for i in range(6)
    )
    w, x, y, z = map(float, quaternion_wxyz(LONGER.T_base_0[:3, :3]))
    at = ", ".join(repr(float(each)) for each in LONGER.T_base_0[:3, 3])
    (tmp_path / "corrected.toml").write_text(
        'name = "ur5e"\nconvention = "standard"\nidentified = true\nversion = 3\n'
        f"T_base_0 = {{ position_m = [{at}], quaternion_wxyz = [{w}, {x}, {y}, {z}] }}\n"
        "T_flange_body = { position_m = [0.1, 0.15, -0.1], quaternion_wxyz = [0.0, 0.6, 0.8, 0.0] }\n" + rows
    )
    said = armsight("arm", "calibrated", "ur5e", tmp_path / "corrected.toml", "--json").done()
    assert said.lines[0]["tool_apart_mean_m"] == pytest.approx(4e-4, abs=1e-9)
    assert said.lines[0]["tool_rotated_max_rad"] == pytest.approx(0.0, abs=1e-6)
