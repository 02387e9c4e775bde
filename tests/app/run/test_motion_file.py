"""Motion files: what is planned, and the messages about bad ones."""

import numpy as np
import pytest

from armsight.app.run.command import _motion_text
from armsight.app.run.motion_file import DEFAULT_MOTION, read_motions
from armsight.errors import InputError
from armsight.geometry.rotation import euler_zyx
from armsight.robot.arm_file import open_arm
from armsight.robot.models import MODELS
from armsight.sim.workcell.controlled import standing
from cli_runs import assert_has

ARM = open_arm("six_r")


def test_the_default_motion_goes_from_home_to_five_poses_and_back_and_along_a_line_and_a_circle():
    plan = read_motions(ARM)
    kinds = [motion.kind for motion in plan.motions]
    assert kinds[:6] == ["joints"] * 6
    assert_has(kinds, "line", "circle")
    q = plan.start
    assert q == pytest.approx(ARM.home)
    for motion in plan.motions:
        assert motion.trajectory.at(0.0).q == pytest.approx(q, abs=1e-9)  # each begins where the last one ended
        q = motion.trajectory.at(motion.trajectory.duration_s).q
        t = np.linspace(0, motion.trajectory.duration_s, 400)
        p = ARM.forward(motion.trajectory.at(t).q)[:, :3, 3]
        speed = np.linalg.norm(np.diff(p, axis=0), axis=1).max() / (t[1] - t[0])
        assert speed < 0.505  # up to 0.5 m/s, as the docs say
    assert q == pytest.approx(ARM.home)


def write(tmp_path, text):
    path = tmp_path / "motion.toml"
    path.write_text(text)
    return path


@pytest.mark.parametrize("key", ["euler_zyx_deg", "roll_pitch_yaw_deg"])  # the older key is still read
def test_a_line_goes_to_a_position_and_an_orientation(tmp_path, key):
    q = np.radians([10, -60, 80, 5, -80, 20])
    T0 = ARM.forward(q)
    p_mm, angles = 1e3 * T0[:3, 3] + [20, -10, 5], np.degrees(euler_zyx(T0[:3, :3])[0])
    line = f'start_deg = {np.degrees(q).tolist()}\n[[motion]]\nkind = "line"\nto_mm = {p_mm.tolist()}\n'
    plan = read_motions(ARM, write(tmp_path, f"{line}{key} = {angles.tolist()}\n"))
    T1 = ARM.forward(plan.motions[0].trajectory.at(99.0).q)
    assert 1e3 * T1[:3, 3] == pytest.approx(p_mm, abs=1e-6)
    assert T1[:3, :3] == pytest.approx(T0[:3, :3], abs=1e-9)


@pytest.mark.parametrize("key", ["rotation_deg", "turn_deg"])  # the older key is still read
def test_a_line_goes_by_a_step_and_rotates(tmp_path, key):
    path = write(
        tmp_path,
        'start_deg = [10, -60, 80, 5, -80, 20]\n[[motion]]\nkind = "line"\nby_mm = [30, -40, 10]\n'
        f"{key} = [0, 0, 15]\nrest_s = 0\n",
    )
    plan = read_motions(ARM, path)
    T0 = ARM.forward(plan.start)
    T1 = ARM.forward(plan.motions[0].trajectory.at(99.0).q)
    assert T1[:3, 3] - T0[:3, 3] == pytest.approx([0.03, -0.04, 0.01], abs=1e-9)
    c, s = np.cos(np.radians(15)), np.sin(np.radians(15))
    assert T1[:3, :3] @ T0[:3, :3].T == pytest.approx(np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]), abs=1e-9)
    assert plan.motions[0].rest_s == 0


BAD = {
    "not toml": ("[[motion", "not TOML"),
    "empty": ("", "no motion; give each as a table"),
    "no list": ("motion = 3", "no motion"),
    "unknown key": ("speed = 3", "unknown key 'speed'; known are start_deg"),
    "kind": ('[[motion]]\nkind = "jump"', "motion 1: kind is 'jump'; known are joints, home, line, circle"),
    "kinds": ('[[motion]]\nkind = ["home"]', "motion 1: kind is \\['home'\\]; known are"),
    "key": ('[[motion]]\nkind = "home"\nq_deg = [1]', "motion 1 \\(home\\): unknown key 'q_deg'"),
    "missing": ('[[motion]]\nkind = "joints"', "motion 1 \\(joints\\): q_deg is missing"),
    "count": ('[[motion]]\nkind = "joints"\nq_deg = [1, 2]', "q_deg must be 6 numbers"),
    "text": ('[[motion]]\nkind = "joints"\nq_deg = [1, 2, 3, 4, 5, "six"]', "q_deg must be 6 numbers"),
    "not finite": ('[[motion]]\nkind = "joints"\nq_deg = [1, 2, 3, 4, 5, inf]', "q_deg must be 6 numbers"),
    "long": (f'[[motion]]\nkind = "joints"\nq_deg = [1, 2, 3, 4, 5, {"9" * 400}]', "q_deg must be 6 numbers"),
    "scalar": ('[[motion]]\nkind = "home"\nrest_s = [1]', "rest_s must be a number"),
    "rest": ('[[motion]]\nkind = "home"\nrest_s = -1', "rest_s is -1; it must be 0 to 60"),
    "names": ('[[motion]]\nkind = "home"\nname = "a"\n[[motion]]\nkind = "home"\nname = "a"', "motion 2: name is 'a'"),
    "limits": (
        '[[motion]]\nkind = "joints"\nq_deg = [900, 0, 0, 0, 0, 0]',
        "motion 1 \\(joints 1\\): .*joint 1 at 900",
    ),
    "both": ('[[motion]]\nkind = "line"\nby_mm = [1, 2, 3]\nto_mm = [1, 2, 3]', "give either by_mm"),
    "reach": (
        'start_deg = [10, -60, 80, 5, -80, 20]\n[[motion]]\nkind = "line"\nby_mm = [3000, 0, 0]',
        "cannot be made: the path leaves the reach",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_messages_name_the_bad_file_and_the_motion(tmp_path, case):
    text, said = BAD[case]
    path = write(tmp_path, text)
    with pytest.raises(InputError, match=said) as caught:
        read_motions(ARM, path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_a_missing_file():
    with pytest.raises(InputError, match=r"nowhere\.toml"):
        read_motions(ARM, "nowhere.toml")


def test_the_default_motion_is_part_of_the_package():
    assert DEFAULT_MOTION.name == "default_motion.toml"
    assert DEFAULT_MOTION.is_file()


@pytest.mark.parametrize("arm", ["six_r", "so101", "ar4", "ur5e"])
@pytest.mark.parametrize("simulated", [False, True])
def test_every_arm_has_motions_without_a_file(arm, simulated, tmp_path):
    if (arm, simulated) == ("ur5e", False):
        pytest.skip("planned by armsight check plan, which has its own tests")
    model = standing(MODELS[arm]) if simulated else MODELS[arm]
    (tmp_path / "motion.toml").write_text(_motion_text(model, simulated=simulated))
    assert len(read_motions(model, tmp_path / "motion.toml").motions) >= 5
