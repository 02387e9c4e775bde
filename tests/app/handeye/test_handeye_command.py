"""``armsight handeye``: forms of tables, what it says, and what it rejects."""

import json
import re
from dataclasses import fields, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from armsight.app.handeye.command import Options, calibrate
from armsight.app.handeye.report import handeye_report
from armsight.errors import InputError
from armsight.geometry.pose import exp_se3, inverse, log_se3
from armsight.loop.handeye.recording import matched_rows, paired, seen_in_table, steady, upright
from armsight.loop.identify.misread import _nearer_models
from armsight.robot.arm_file import open_arm
from armsight.tables.poses import read_pose_table
from cli_runs import assert_has, assert_rejected

X = exp_se3(np.array([0.03, -0.02, 0.08, 0.2, -0.1, 1.2]))
Z = exp_se3(np.array([0.5, 0.1, 0.4, 2.0, 0.3, -0.4]))


def motion(n=14, seed=0, in_hand=True):
    """Poses of a flange, and of the body as seen, both a little off; m."""
    rng = np.random.default_rng(seed)
    q = open_arm("six_r").home + rng.uniform(-0.6, 0.6, (n, 6))
    A = open_arm("six_r").forward(q)
    B = inverse(A @ X) @ Z if in_hand else inverse(Z) @ A @ X
    return q, A, B @ exp_se3(rng.normal(0, [2e-4] * 3 + [5e-4] * 3, (n, 6)))


def matrices(path, Ts):
    """A table of 16 numbers a row."""
    np.savetxt(path, Ts.reshape(-1, 16), fmt="%.9f")
    return path


def named(path, head, rows):
    path.write_text("\n".join([head, *(",".join(str(cell) for cell in row) for row in rows)]) + "\n")
    return path


def quaternions(Ts):
    x, y, z, w = Rotation.from_matrix(Ts[:, :3, :3]).as_quat().T
    return np.stack([w, x, y, z], axis=1)


@pytest.fixture
def seen(tmp_path):
    return matrices(tmp_path / "seen.txt", motion()[2])


def asked(armsight, robot, seen, *more, eye="in-hand"):
    """A run of the command."""
    return armsight("handeye", "--robot", robot, "--seen", seen, "--eye", eye, *more)


def found(armsight, robot, seen, *more, eye="in-hand"):
    """The JSON of a run that must succeed."""
    said = asked(armsight, robot, seen, "--json", *more, eye=eye).done()
    return said.lines[0], said.err


def assert_right(document):
    assert np.abs(log_se3(inverse(X) @ np.array(document["T_flange_rig"]))).max() < 2e-3


@pytest.mark.parametrize("joints", [False, True])
def test_poses_and_joints_give_the_same(armsight, tmp_path, seen, joints):
    q, A, _ = motion()
    robot, options = matrices(tmp_path / "robot.csv", A), ()
    if joints:
        robot = named(robot, ",".join(f"q{i}_deg" for i in range(1, 7)), np.degrees(q))
        options = ("--model", "six_r")
    document, _ = found(armsight, robot, seen, *options)
    assert_right(document)
    assert document["held_out_rms_m"] < 2e-3
    assert all(pose["used"] for pose in document["poses"])


@pytest.mark.parametrize("form", ["q=[{q}] pose=p[{p}]", "movej([{q}]) # p[{p}]", "p[{p}],", "[{p}]", "[{p}],"])
def test_joints_beside_a_pose_are_not_taken_for_it(tmp_path, form):
    q, A, _ = motion()
    vectors = np.hstack([A[:, :3, 3], Rotation.from_matrix(A[:, :3, :3]).as_rotvec()])
    path, arm = tmp_path / "robot.txt", open_arm("six_r")
    written = [[", ".join(f"{v:.9f}" for v in row) for row in both] for both in zip(q, vectors, strict=True)]
    path.write_text("".join(["# of a UR\n", *(form.format(q=joints, p=pose) + "\n" for joints, pose in written)]))
    table = read_pose_table(path)
    np.testing.assert_allclose(table.Ts, A, atol=1e-8)
    if "p[" in form:
        assert table.notes == ()
        np.testing.assert_allclose(read_pose_table(path, arm=arm).Ts, A, atol=1e-8)
    else:
        assert "read as UR's pose: m and rotation vector" in table.notes[0]
        with pytest.raises(InputError, match="line 2: is this list a pose, or joint angles of six_r"):
            read_pose_table(path, arm=arm)


def test_lists_and_blocks_of_matrices_are_read_by_how_many_numbers_they_have(tmp_path):
    A = motion(8)[1]
    path = tmp_path / "robot.txt"
    np.savetxt(path, A[:, :3].reshape(-1, 4))  # 24 lines, a multiple of four
    np.testing.assert_allclose(read_pose_table(path).Ts, A, atol=1e-9)
    path.write_text("".join(f"{row.tolist()}\n" for row in A.reshape(-1, 16)))
    np.testing.assert_allclose(read_pose_table(path).Ts, A, atol=1e-9)
    path.write_text("".join(f"{row.tolist()}\n" for row in np.hstack([1e3 * A[:, :3, 3], quaternions(A)])))
    np.testing.assert_allclose(read_pose_table(path, rotation="wxyz", unit="mm").Ts, A, atol=1e-9)


@pytest.mark.parametrize("maker", ["KUKA", "Fanuc"])
def test_columns_beside_those_of_a_robots_maker_change_nothing(tmp_path, maker):
    _, A, _ = motion()
    angles = Rotation.from_matrix(A[:, :3, :3]).as_euler("ZYX" if maker == "KUKA" else "xyz", degrees=True)
    head = "image,t_s,S,X [mm],Y [mm],Z [mm]," + ("A [deg],B [deg],C [deg]" if maker == "KUKA" else "W,P,R")
    rows = [(f"{k}.png", k, 6, *row) for k, row in enumerate(np.hstack([1e3 * A[:, :3, 3], angles]))]
    table = read_pose_table(named(tmp_path / "robot.csv", head, rows))
    np.testing.assert_allclose(table.Ts, A, atol=1e-8)
    assert table.names[3] == "3.png"
    assert table.t_s[3] == 3
    assert f"read as {maker}'s: mm; degrees" in table.notes[0]
    assert "S" in table.notes[1]


def test_a_unit_or_a_rotation_that_is_given_counts(tmp_path):
    _, A, _ = motion()
    angles = Rotation.from_matrix(A[:, :3, :3])
    head = [f"position_{axis}" for axis in "xyz"] + [f"orientation_{axis}" for axis in "xyzw"]
    ros = named(tmp_path / "ros.csv", ",".join(head), np.hstack([1e3 * A[:, :3, 3], angles.as_quat()]))
    np.testing.assert_allclose(read_pose_table(ros, unit="mm").Ts, A, atol=1e-8)
    columns = np.hstack([A[:, :3, 3], angles.as_euler("XYZ", degrees=True)])
    euler = named(tmp_path / "euler.csv", "x,y,z,roll_deg,pitch_deg,yaw_deg", columns)
    table = read_pose_table(euler, rotation="XYZ")
    np.testing.assert_allclose(table.Ts, A, atol=1e-8)
    assert table.notes == ()
    assert "about fixed x, y and z" in read_pose_table(euler).notes[0]


def test_where_the_arms_geometry_is_off_the_error_is_of_the_transforms_that_are_given(tmp_path):
    q, _, _ = motion(16)
    off = q + np.array([0.0, 0.02, -0.02, 0.02, -0.02, 0.0])
    B = inverse(open_arm("six_r").forward(off) @ X) @ Z
    B = B @ exp_se3(np.random.default_rng(1).normal(0, [2e-4] * 3 + [5e-4] * 3, (16, 6)))
    nothing = dict.fromkeys(one.name for one in fields(Options)) | {"columns": ()}
    given = {
        "robot": named(tmp_path / "q.csv", ",".join(f"q{i}_rad" for i in range(1, 7)), q),
        "seen": matrices(tmp_path / "b.txt", B),
        "eye": "in-hand",
        "model": "six_r",
    }
    run = calibrate(Options(**(nothing | given)), lambda line: None)
    document, said = handeye_report(run).json(), handeye_report(run).text()
    assert document["noise"]["structure"] == "robot's geometry off"
    poses = np.array([pose["held_out_m"] for pose in document["poses"] if pose["used"]])
    assert document["held_out_rms_m"] == pytest.approx(np.sqrt((poses**2).mean()))
    held_out, nominal = (f"{1e3 * document[f'held_out_{of}rms_m']:.2f} mm" for of in ("", "nominal_"))
    assert nominal != held_out
    assert f"poses left out: {held_out}" in said
    assert f"with its nominal model poses left out are off by {held_out}, or by {nominal} where the mounting" in said


def test_people_read_sigma_whose_error_blunders_and_a_plan_and_get_a_page(armsight, tmp_path):
    _, A, B = motion(20)
    B[7] = B[7] @ exp_se3(np.array([0.05, 0, 0, 0.3, 0, 0]))
    robot, seen = matrices(tmp_path / "robot.txt", A), matrices(tmp_path / "seen.txt", B)
    said = asked(armsight, robot, seen, "--plan", 2, "-o", tmp_path / "out", eye="in_hand").done()
    assert "T_flange_rig" in said.out
    assert " ± " in said.out
    assert "poses left out:" in said.out
    assert "structure of the noise" in said.out
    assert "worst known along" in said.out
    assert "blunders, left out: 1" in said.out
    assert "line 8" in said.out
    assert "poses of the flange to take next" in said.out
    page = (tmp_path / "out" / "report.html").read_text()
    assert page.count("data:image/png") == 4
    assert len((tmp_path / "out" / "plan.csv").read_text().splitlines()) == 3
    document = json.loads((tmp_path / "out" / "handeye.json").read_text())
    assert document["plan"]["sigma_m"][1] < document["plan"]["sigma_m"][0] < document["worst_sigma_m"]


def test_a_plan_keeps_its_promise(armsight, tmp_path):
    """The poses planned, taken, give the sigma that was predicted."""
    _, A, B = motion(10)
    robot, seen = matrices(tmp_path / "robot.txt", A), matrices(tmp_path / "seen.txt", B)
    first, _ = found(armsight, robot, seen, "--plan", 6)
    more = np.array(first["plan"]["T_base_flange"])
    taken = inverse(more @ X) @ Z @ exp_se3(np.random.default_rng(1).normal(0, [2e-4] * 3 + [5e-4] * 3, (6, 6)))
    matrices(robot, np.concatenate([A, more]))
    matrices(seen, np.concatenate([B, taken]))
    after, _ = found(armsight, robot, seen)
    assert after["worst_sigma_m"] < first["worst_sigma_m"]
    assert after["worst_sigma_m"] == pytest.approx(first["plan"]["sigma_m"][-1], rel=0.6)


def test_planned_poses_are_near_those_taken_with_the_target_in_view_and_say_why(armsight, tmp_path):
    _, A, B = motion(12)
    robot, seen = matrices(tmp_path / "robot.txt", A), matrices(tmp_path / "seen.txt", B)
    plan = found(armsight, robot, seen, "--plan", 8)[0]["plan"]
    Ts = np.array(plan["T_base_flange"])
    for T, name, angle, why in zip(
        Ts, plan["nearest"], plan["rotated_from_nearest_rad"], plan["lowers_most"], strict=True
    ):
        assert angle < np.radians(25.5)
        way = log_se3(inverse(A[int(name.split()[1]) - 1]) @ T)
        assert np.linalg.norm(way[3:]) == pytest.approx(angle)
        assert re.fullmatch(r"(along|about) \[.+\] [\d.e-]+ to [\d.e-]+ (mm|deg)", why)
    middle, was = ((T[:, :3, 3] / T[:, 2:3, 3])[:, :2] for T in (inverse(Ts @ X) @ Z, B))
    assert (middle > was.min(axis=0) - 0.03).all()
    assert (middle < was.max(axis=0) + 0.03).all()


def test_streams_with_an_unknown_clock_offset(armsight, tmp_path):
    t_hand, t_eye = np.arange(0, 8, 0.02), np.arange(0.5, 7.5, 0.05)

    def motion_at(t):
        speeds = np.array([0.31, 0.47, 0.59, 0.71, 0.83, 1.03]) * 0.6 * np.pi
        return exp_se3(np.array([0.2, 0.2, 0.15, 0.5, 0.4, 0.5]) * np.sin(speeds * t[:, None] + np.arange(6)))

    B = (
        inverse(motion_at(t_eye) @ X)
        @ Z
        @ exp_se3(np.random.default_rng(0).normal(0, [2e-4] * 3 + [5e-4] * 3, (140, 6)))
    )
    head = "t_s,x_m,y_m,z_m,qw,qx,qy,qz"
    A = motion_at(t_hand)
    robot = named(tmp_path / "a.csv", head, np.hstack([t_hand[:, None], A[:, :3, 3], quaternions(A)]))
    seen = named(tmp_path / "b.csv", head, np.hstack([t_eye[:, None] - 0.123, B[:, :3, 3], quaternions(B)]))
    document, _ = found(armsight, robot, seen, "--streams")
    assert_right(document)
    assert abs(document["clock_offset_s"] - 0.123) < 4 * document["clock_offset_sigma_s"] < 4e-3
    other = asked(armsight, robot, seen, "--streams", eye="to-hand")
    assert_rejected(other, robot, "these poses fit --eye in-hand, not to-hand")
    large = named(tmp_path / "c.csv", head, np.hstack([t_hand[:, None], 39.37 * A[:, :3, 3], quaternions(A)]))
    document, notes = found(armsight, large, seen, "--streams", "--columns", "units=detect")
    assert "inches taken for metres; converted" in notes
    assert_right(document)


def test_millimetres_are_rejected_or_detected(armsight, tmp_path, seen):
    _, A, B = motion()
    A = A.copy()
    A[:, :3, 3] *= 1e3
    robot = matrices(tmp_path / "robot.txt", A)
    assert_rejected(asked(armsight, robot, seen), robot, "millimetres", "units=mm")
    document, notes = found(armsight, robot, seen, "--columns", "units=detect")
    assert "read as millimetres" in notes
    assert_right(document)
    cm = B.copy()
    cm[:, :3, 3] *= 10  # of a world a tenth as large: no length is beyond what metres may be
    tenth = A.copy()
    tenth[:, :3, 3] *= 1e-4
    said = asked(armsight, matrices(robot, tenth), matrices(tmp_path / "cm.txt", cm))
    assert_rejected(said, "centimetres taken for metres: correct seen:units, or give --columns units=detect")
    document, notes = found(armsight, robot, tmp_path / "cm.txt", "--columns", "units=detect")
    assert "the target's lengths are centimetres taken for metres; converted" in notes
    np.testing.assert_allclose(np.array(document["T_flange_rig"])[:3, 3], X[:3, 3] / 10, atol=1e-3)
    p_mm = np.array([[600, 10, 500], [500, 0, 400], [1, 1.5, 2]])  # one near the base's origin
    near = named(tmp_path / "near.csv", "x,y,z,qw,qx,qy,qz", np.hstack([p_mm, np.tile([1, 0, 0, 0], (3, 1))]))
    np.testing.assert_allclose(read_pose_table(near, detect_units=True).Ts[:, :3, 3], 1e-3 * p_mm)
    B = B.copy()
    B[:, :3, 3] *= 0.5
    half = matrices(tmp_path / "half.txt", B)
    assert_rejected(asked(armsight, matrices(robot, motion()[1]), half), "2 times as large as given", "--scale")
    document, _ = found(armsight, robot, half, "--scale")
    assert document["target_scale"] == pytest.approx(2.0, rel=0.01)


def test_what_does_not_fit_is_named(armsight, tmp_path, seen):
    q, A, _ = motion()

    def rejected(robot, *words, more=(), eye="in-hand", by=seen):
        assert_rejected(asked(armsight, robot, by, *more, eye=eye), robot, *words)

    path = tmp_path / "robot.txt"
    rejected(matrices(path, np.roll(A, 1, axis=0)), "shifted by 1 against the images")
    rejected(matrices(path, inverse(A)), "fit --eye to-hand", "inverse transforms")
    rejected(matrices(path, A), "fit --eye in-hand", eye="to-hand")
    mirrored = A.copy()
    mirrored[3, :3, 0] *= -1
    rejected(matrices(path, mirrored), "line 4", "left-handed")
    angles = Rotation.from_matrix(A[:, :3, :3]).as_euler("xyz", degrees=True)
    euler = named(tmp_path / "e.csv", "x_m,y_m,z_m,rx_deg,ry_deg,rz_deg", np.hstack([A[:, :3, 3], angles]))
    rejected(euler, "the rotations are xyz, not zyx", more=("--columns", "rotation=zyx"))
    rejected(euler, "give --columns rotation=")
    joints = named(tmp_path / "q.csv", ",".join(f"q{i}_rad" for i in range(1, 7)), q[:, [0, 2, 1, 3, 4, 5]])
    rejected(joints, "the joints are in another order", "q1, q3, q2", more=("--model", "six_r"))
    rejected(joints, "give --model")
    mirror = np.diag([1.0, -1.0, 1.0, 1.0])
    rejected(matrices(path, mirror @ A @ mirror), "left-handed frame: one axis is mirrored")
    head, arm = ",".join(f"q{i}_deg" for i in range(1, 7)), ("--model", "six_r")
    other_way = np.degrees(q) * np.array([1, 1, -1, 1, 1, 1])
    rejected(named(tmp_path / "s.csv", head, other_way), "joint 3", "counts the other way", more=arm)
    rejected(named(tmp_path / "u.csv", head, q), "the joints are in radians", more=arm)
    gripper = np.column_stack([np.degrees(q), q[:, 0]])
    rejected(named(tmp_path / "g.csv", head + ",q7_deg", gripper), "six_r has 6", "gripper", more=arm)
    speed = named(tmp_path / "v.csv", head + ",q7_deg,speed", np.column_stack([gripper, q[:, 0]]))
    rejected(speed, "six_r has 6", "gripper", more=arm)
    units = named(tmp_path / "t.csv", head.replace("q6_deg", "q6_rad"), q)
    rejected(units, "has q6_rad where q6_deg is expected", more=arm)
    rejected(named(tmp_path / "d.csv", head.replace("deg", "rad"), 90 + q), "are these degrees?", more=arm)
    displaced = A.copy()
    displaced[7:] = A[7:] @ exp_se3(np.array([0.0, 0.0, 0.1, 0.4, 0.0, 0.3]))
    rejected(
        matrices(path, displaced),
        "those from line 8",
        "fit one mounting each, but not the same",
        "TCP changed, by 100 mm and 28.6 deg",
    )
    displaced[7:] = exp_se3(np.array([0.0, 0.05, 0.0, 0.0, 0.0, 0.1])) @ A[7:]
    rejected(matrices(path, displaced), "those from line 8", "the robot's base, or the target, was displaced by")


def test_motions_that_leave_a_direction_open_are_rejected_as_such(armsight, tmp_path):
    """Closed forms are undetermined there, so consistent data fit badly, and so do parts and other readings."""
    rng = np.random.default_rng(1)
    _, A, B = motion(16)
    noise, path = inverse(inverse(A @ X) @ Z) @ B, tmp_path / "robot.txt"
    shifted = A.copy()
    shifted[:, :3, :3] = A[0, :3, :3]
    about_z = shifted.copy()
    rotvecs = np.random.default_rng(1).uniform(-1, 1, 16)[:, None] * [0, 0, 1]
    about_z[:, :3, :3] = Rotation.from_rotvec(rotvecs).as_matrix() @ np.diag([1.0, -1.0, -1.0])
    about_z[:, :3, 3] = np.random.default_rng(10).uniform(-0.3, 0.3, (16, 3)) + np.array([0.4, 0.0, 0.3])
    two = A[np.arange(16) % 2].copy()
    two[:, :3, 3] += rng.normal(0, 0.1, (16, 3))
    for Ts, said in ((shifted, "hardly rotates"), (about_z, "about one axis only"), (two, "about one axis only")):
        seen = matrices(tmp_path / "seen.txt", inverse(Ts @ X) @ Z @ noise)
        assert_rejected(asked(armsight, matrices(path, Ts), seen), said)


def test_exchanged_tables_that_put_the_cameras_far_from_the_flange_are_named(armsight, tmp_path, seen):
    robot = matrices(tmp_path / "robot.txt", motion()[1])
    said = "if that is not so, --robot and --seen are exchanged"
    right, exchanged = (found(armsight, *tables)[0] for tables in ((robot, seen), (seen, robot)))
    np.testing.assert_allclose(log_se3(np.array(exchanged["T_flange_rig"]) @ Z), 0.0, atol=2e-3)  # as good a fit
    assert said in str(exchanged["weak"])
    _, A, B = motion(16)  # as many as are advised
    more = matrices(tmp_path / "more.txt", B), matrices(tmp_path / "moved.txt", A)
    assert asked(armsight, *more).done().out.startswith("Usable only where what is named as weak below is not so")
    assert said not in str(right["weak"])


def test_many_blunders_ask_whether_the_rows_belong_together(armsight, tmp_path):
    _, A, B = motion(20)
    for k, off in zip((2, 5, 8, 11, 14, 17), np.random.default_rng(3).normal(0, 1, (6, 6)), strict=True):
        B[k] = B[k] @ exp_se3(off * np.repeat([0.1, 0.5], 3))
    robot, seen = matrices(tmp_path / "robot.txt", A), matrices(tmp_path / "seen.txt", B)
    said = asked(armsight, robot, seen, "-o", tmp_path / "out")
    assert said.code == 3
    assert "blunders, left out: 6" in said.out
    assert "do not trust this result: 6 of 20 poses are blunders, more than slips: do the rows belong" in said.out
    document = json.loads((tmp_path / "out" / "handeye.json").read_text())
    assert document["untrusted"][0].startswith("6 of 20 poses are blunders")
    assert "do not trust this result: 6 of 20" in (tmp_path / "out" / "report.html").read_text()


def test_a_scale_that_walks_is_given_at_the_first_pose_and_at_the_last(armsight, tmp_path):
    rng = np.random.default_rng(0)
    A = open_arm("six_r").forward(open_arm("six_r").home + rng.uniform(-0.6, 0.6, (60, 6)))
    eye = inverse(inverse(A @ X) @ Z @ exp_se3(rng.normal(0, 1e-4, (60, 6))))
    walked = np.exp(np.cumsum(rng.normal(0, 4e-3, 60)))
    eye[:, :3, 3] *= 2 * walked[:, None] / walked[0]
    A = A @ exp_se3(rng.normal(0, 5e-5, (60, 6)))
    head = "t_s,x_m,y_m,z_m,qw,qx,qy,qz"
    robot, seen = (
        named(tmp_path / name, head, np.column_stack([np.arange(60), Ts[:, :3, 3], quaternions(Ts)]))
        for name, Ts in (("robot.csv", A), ("seen.csv", inverse(eye)))
    )
    document, _ = found(armsight, robot, seen, "--scale")
    assert "target_scale" not in document
    assert document["target_scale_at_start"] == pytest.approx(0.5, abs=4 * document["target_scale_at_start_sigma"])
    low, high = document["target_scale_at_end"]
    assert low < 0.5 * walked[0] / walked[-1] < high
    assert document["target_scale_walks_sigma"] == pytest.approx(4e-3 * np.sqrt(59), rel=0.5)


def test_rows_shifted_where_an_arm_moves_in_equal_steps_are_no_blunders(armsight, tmp_path):
    """Two of three rows then fit another mounting exactly: the median of the residuals says nothing."""
    _, first, _ = motion(9, seed=4)
    step = exp_se3(np.array([0.02, 0.01, 0.0, 0.1, 0.3, 0.0]))
    A = np.concatenate([[T, T @ step, T @ step @ step] for T in first])
    B = inverse(A @ X) @ Z @ exp_se3(np.random.default_rng(1).normal(0, [2e-4] * 3 + [5e-4] * 3, (27, 6)))
    seen, path = matrices(tmp_path / "seen.txt", B), tmp_path / "robot.txt"

    def rejected(Ts, *words):
        said = asked(armsight, matrices(path, Ts), seen)
        assert_rejected(said, path, *words)

    rejected(np.roll(A, 1, axis=0), "shifted by 1 against the images; robot.txt line 2 belongs to line 1")
    rejected(np.roll(A, -5, axis=0), "shifted by 5 against the images; robot.txt line 1 belongs to line 6")
    rejected(A[[*range(10), *range(11, 27), 0]], "from line 11 on: a row is missing", "belongs to line 12")
    rejected(A[::-1], "in reverse order")
    rejected(A[np.random.default_rng(0).permutation(27)], "no other reading fits")


def test_readings_of_rotations_axes_and_units(armsight, tmp_path, seen):
    q, A, B = motion()
    path = tmp_path / "robot.txt"

    def rejected(robot, *words, more=(), by=seen):
        said = asked(armsight, robot, by, *more)
        assert_rejected(said, *words)

    other = A.copy()
    other[:, :3, :3] = np.swapaxes(A[:, :3, :3], 1, 2)
    rejected(matrices(path, other), "the rotations are inverse")
    other = A.copy()
    other[:, :2, 3] = A[:, [1, 0], 3]
    rejected(matrices(path, other), "the positions fit as y, x, z")
    columnwise, notes = found(armsight, matrices(path, np.swapaxes(A, 1, 2)), seen)  # Franka's O_T_EE, Eigen, MATLAB
    assert "its matrices are column by column" in notes
    assert_right(columnwise)
    angles = Rotation.from_matrix(A[:, :3, :3]).as_euler("ZYX", degrees=True)
    rejected(named(path, "X,Y,Z,W,P,R", np.hstack([1e3 * A[:, :3, 3], angles])), "about x and z are exchanged")
    doosan = Rotation.from_matrix(A[:, :3, :3]).as_euler("ZYZ", degrees=True)
    rejected(
        named(path, "X,Y,Z,A,B,C", np.hstack([1e3 * A[:, :3, 3], doosan])), "are ZYZ, not xyz: --columns rotation=ZYZ"
    )
    rejected(named(path, "x_m,y_m,z_m,rx_rad,ry_rad,rz_rad", np.hstack([A[:, :3, 3], angles])), "are these degrees?")
    x = Rotation.from_matrix(B[:, :3, :3]).as_quat()
    bare = tmp_path / "bare.csv"
    np.savetxt(bare, np.hstack([B[:, :3, 3], x]), delimiter=",")
    by = ("--columns", "units=m,seen:rotation=wxyz")
    rejected(
        matrices(path, A), bare, "the rotations are xyzw, not wxyz: --columns seen:rotation=xyzw", more=by, by=bare
    )
    other = A.copy()
    other[5, :3, 3] *= 1e3
    rejected(matrices(path, other), "are some rows in millimetres?", more=("--columns", "units=detect"))
    head, arm = ",".join(f"q{i}_deg" for i in range(1, 7)), ("--model", "six_r")
    rejected(named(path, head, np.degrees(q + np.pi / 2 * np.eye(6)[2])), "another zero", "add -90 deg to q3", more=arm)
    ur = open_arm("ur3").home + q
    flange = open_arm("ur3").forward(ur)
    by = matrices(tmp_path / "ur.txt", inverse(flange @ X) @ Z @ exp_se3(np.full((14, 6), 1e-4)))
    said = asked(armsight, named(path, head, np.degrees(ur)), by, "--model", "ur3e")
    assert "fit --model ur3" in said.err
    half = np.loadtxt(by).reshape(-1, 4, 4)
    half[:, :3, 3] *= 0.5
    half_seen = seen_in_table(read_pose_table(matrices(tmp_path / "half.txt", half)))
    ur3e = open_arm("ur3e")
    recording = paired(read_pose_table(tmp_path / "robot.txt", arm=ur3e), half_seen, True, ur3e)
    assert "fit --model ur3" in _nearer_models(recording, ur3e, 2e-3, scale=True)[0]
    names = ",".join(open_arm("six_r").joint_names)
    wrong = names.replace("joint5", "jont5")
    rejected(named(path, wrong, q), "is not known: is it", more=arm)


def test_points_in_kukas_language(tmp_path):
    _, A, _ = motion(3)
    angles = Rotation.from_matrix(A[:, :3, :3]).as_euler("ZYX", degrees=True)
    points = [
        f"DECL E6POS XP{k}={{X {x:.6f},Y {y:.6f}, Z {z:.6f},A {a:.7f},B {b:.7f},C {c:.7f},S 6,T 27,E1 0.0}}"
        for k, (x, y, z, a, b, c) in enumerate(np.hstack([1e3 * A[:, :3, 3], angles]))
    ]
    path = tmp_path / "points.dat"
    motions = "DECL PDAT PPDAT1={VEL 100.000,ACC 100.000,APO_DIST 100.000}"
    path.write_text("\n".join(["DEFDAT POINTS PUBLIC", motions, points[0], motions, *points[1:], motions, "ENDDAT"]))
    table = read_pose_table(path)
    np.testing.assert_allclose(table.Ts, A, atol=1e-7)
    assert table.lines.tolist() == [3, 5, 6]
    assert "KUKA" in table.notes[0]
    path.write_text("{A1 10,A2 -90,A3 90,A4 0,A5 45,A6 0}")
    np.testing.assert_allclose(np.degrees(read_pose_table(path, arm=open_arm("six_r")).q), [[10, -90, 90, 0, 45, 0]])
    path.write_text("{X 1,Y 2,Z 3,A 4,B 5}")
    with pytest.raises(InputError, match="line 1: a point needs"):
        read_pose_table(path)
    path.write_text("0 412,5 606,3 1 0 0 0\n1,5 412,5 606,3 1 0 0 0\n")
    some_whole = read_pose_table(path, rotation="wxyz", unit="mm")
    np.testing.assert_allclose(some_whole.Ts[:, :3, 3], [[0.0, 0.4125, 0.6063], [0.0015, 0.4125, 0.6063]])
    commas = "412,5 1129,8 606,3 1,0 0,0 0,0 0,0\n"
    path.write_text(commas)
    bare = read_pose_table(path, rotation="wxyz", unit="mm")
    np.testing.assert_allclose(bare.Ts[0, :3, 3], [0.4125, 1.1298, 0.6063])
    path.write_bytes(commas.replace(",", ".").encode("utf-16"))  # as spreadsheets write "Unicode text"
    np.testing.assert_allclose(read_pose_table(path, rotation="wxyz", unit="mm").Ts, bare.Ts)


def test_rows_without_an_image_and_rows_twice_are_noted(armsight, tmp_path, seen):
    _, A, B = motion()
    head = "name,x_m,y_m,z_m,qw,qx,qy,qz"

    def rows(Ts, names):
        return [(name, *T[:3, 3], *quaternions(T[None])[0]) for name, T in zip(names, Ts, strict=True)]

    names = [f"p{k}" for k in range(14)]
    by = named(tmp_path / "b.csv", head, rows(B, names))
    robot = named(tmp_path / "a.csv", head, rows(A[[*range(12), 0]], [*("C:\\a\\" + name for name in names[:12]), "x"]))
    _, notes = found(armsight, robot, by)
    assert_has(notes, "1 rows of", "2 images without a row", "p12, p13")
    again = [*range(14), 3]
    twice = matrices(tmp_path / "t.txt", A[again])
    one, notes = found(armsight, twice, matrices(tmp_path / "u.txt", B[again]))
    assert "1 rows repeat another" in notes
    assert len(one["poses"]) == 14
    frozen = B.copy()
    frozen[6] = B[5]
    _, notes = found(armsight, matrices(tmp_path / "t.txt", A), matrices(tmp_path / "u.txt", frozen))
    assert "the very same view in line 6, line 7" in notes


def test_a_tcp_taken_for_the_flange_is_noted_where_the_joints_are_known(armsight, tmp_path, seen):
    q, A, _ = motion()
    tool = exp_se3(np.array([0.0, 0.0, 0.12, 0.0, 0.0, 0.3]))
    head = ",".join([*(f"q{i}_rad" for i in range(1, 7)), "x_m", "y_m", "z_m", "qw", "qx", "qy", "qz"])
    moved = A @ tool
    robot = named(tmp_path / "r.csv", head, np.hstack([q, moved[:, :3, 3], quaternions(moved)]))
    document, notes = found(armsight, robot, seen, "--model", "six_r")
    assert "poses are of a TCP at [0.0 0.0 120.0] mm" in notes
    assert np.abs(log_se3(inverse(inverse(tool) @ X) @ np.array(document["T_flange_rig"]))).max() < 2e-3


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("x_m,y_m,z_m,qw,qx,qy,qz\n0,0,0,1,0,0,0\n0,0,0.1,1,0,oops,0\n", ["line 3", "qy is 'oops'", "not a number"]),
        ("x_m,y_m,z_m,qw,qx,qy,qz\n0,0,0,1,0,0\n", ["line 2", "6 fields where 7"]),
        ("x_m,y_m,z_m,qw,qx,qy\n0,0,0,1,0,0\n", ["line 1", "column qz is missing"]),
        ("x_m,y_m,z_m,qw,qx,qy,qz\n0,0,0,2,0,0,0\n", ["quaternion has length 2"]),
        ("1 2 3\n", ["line 1", "3 numbers without names"]),
        ("p[0, 0, 0, 0, 0]\n", ["line 1", "5 fields where 6"]),
        ("p[0, 0, 0, 0, 0, 0]\nhello\n", ["line 2", "expected one p[x, y, z, rx, ry, rz]"]),
        ("p[0, 0, 0, 0, 0, 0] p[0, 0, 0, 0, 0, 1]\n", ["line 1", "expected one p[x, y, z, rx, ry, rz]"]),
        ("[0, 0, 0, 0, 0, 0]\nq=[0, 0, 0, 0, 0, 0]\n", ["line 2", "expected a list"]),
        ("[0, 0, 0]\n", ["line 1", "3 numbers without names; known are 16"]),
        ("[0, 0, 0, 1, 0, 0, 0]\n", ["rotation=wxyz or rotation=xyzw"]),
        ("1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 2\n", ["line 8", "expected 0 0 0 1"]),
        ("1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n1 0 0 0\n", ["line 5", "ends within a matrix"]),
        ("X,Y,Z,A,B\n0,0,0,0,0\n", ["line 1", "no rotation"]),
        ("1 0 0 0 0 1 0 0 0 0 1.5 0\n", ["line 1", "no rotation"]),
        ("0 0 0 1 0 0 0\n", ["rotation=wxyz or rotation=xyzw"]),
        ("", ["no rows"]),
        ("DECL PDAT PPDAT1={VEL 100.0,ACC 100.0}\n", ["begins no table"]),
        ("- effector_wrt_world: [1, 0, 0, 0]\n", ["holds a list of 1, and no poses: expected a list of matrices"]),
        ("[[[1, 0, 0, 0.1], [0, 1, 0, 0.2]]]\n", ["holds a list of 1, and no poses: expected a list of matrices"]),
        ("j1,j2,j3,j4,j5,j6\n1,2,3,4,5,6\n", ["joints without a unit: name them q1_deg"]),
    ],
)
def test_a_damaged_table_is_one_line(armsight, tmp_path, seen, text, words):
    robot = tmp_path / "robot.csv"
    robot.write_text(text)
    assert_rejected(asked(armsight, robot, seen), robot, *words)
    if "rotation=wxyz" in words[0]:  # the option that names the table which is meant
        said = [f"seen:{word}" for word in words[0].split(" or ")]
        assert_rejected(asked(armsight, seen, robot), robot, " or ".join(said))


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ((), ["one way"]),
        (("--source", "x*.png"), ["--camera with --source"]),
        (("--source", "x*.png", "--camera", "c.json"), ["--target"]),
        (("--source", "x*.png", "--camera", "c.json", "--target", "chessboard:9x6:25mm"), ["no such images"]),
        (("--rig", "r.json", "--target", "chessboard:9x6:25mm"), ["--rig with --source"]),
    ],
)
def test_options_that_do_not_go_together_are_rejected(armsight, tmp_path, more, words):
    robot = matrices(tmp_path / "robot.txt", motion()[1])
    assert_rejected(armsight("handeye", "--robot", robot, "--eye", "in-hand", *more), *words)


def test_images_of_one_camera(armsight, tmp_path):
    """A chessboard drawn by a known camera, its calibration from a file and from the images."""
    rng = np.random.default_rng(2)
    K = np.array([[700.0, 0, 320], [0, 700, 240], [0, 0, 1]])
    squares = np.full((7 * 40 + 80, 9 * 40 + 80), 255, np.uint8)
    for i in range(7):
        for j in range(9):
            if (i + j) % 2 == 0:
                squares[40 + 40 * i : 80 + 40 * i, 40 + 40 * j : 80 + 40 * j] = 0
    to_board = np.array(
        [[0.025 / 40, 0, -0.05 + 0.5 * 0.025 / 40], [0, 0.025 / 40, -0.05 + 0.5 * 0.025 / 40], [0, 0, 1]]
    )
    A = []
    for k in range(9):
        xi = np.array(
            [*rng.uniform(-0.03, 0.03, 2), rng.uniform(-0.05, 0.05), *rng.uniform(-0.4, 0.4, 2), rng.uniform(-1, 1)]
        )
        middle = np.array([0.0875, 0.0625, 0, 0, 0, 0])
        T = exp_se3(np.array([0, 0, 0.45, 0, 0, 0])) @ exp_se3(xi) @ inverse(exp_se3(middle))
        H = K @ T[:3, [0, 1, 3]] @ to_board
        image = cv2.warpPerspective(squares, H, (640, 480), flags=cv2.INTER_AREA, borderValue=200)
        cv2.imwrite(str(tmp_path / f"im{k}.png"), cv2.GaussianBlur(image, (3, 3), 0.6))
        A.append(Z @ inverse(X @ T))
    robot = matrices(tmp_path / "robot.txt", np.array(A))
    camera = tmp_path / "camera.json"
    camera.write_text(json.dumps({"image_size_px": [640, 480], "K": K.tolist(), "distortion": []}))
    given = ("handeye", "--robot", robot, "--eye", "in-hand", "--source", tmp_path / "im*.png", "--json")
    said = armsight(*given, "--camera", camera, "--target", "chessboard:8x6:25mm").done()
    assert np.abs(log_se3(inverse(X) @ np.array(said.lines[0]["T_flange_rig"]))).max() < 3e-3
    assert said.lines[0]["reprojection_rms_px"] < 0.2
    camera.write_text(json.dumps({"image_size_px": [1280, 480], "K": K.tolist(), "distortion": []}))
    assert_rejected(armsight(*given, "--camera", camera, "--target", "chessboard:8x6:25mm"), "640x480 px", "1280x480")


@pytest.mark.parametrize("in_hand", [True, False])
def test_a_board_that_looks_the_same_rotated_is_rotated_back(in_hand):
    _, A, B = motion(12, in_hand=in_hand)
    flip = np.diag([-1.0, -1.0, 1.0, 1.0])
    flip[:2, 3] = 0.2, 0.1
    rotated = B.copy()
    rotated[[2, 5, 6]] = rotated[[2, 5, 6]] @ flip
    back, which = upright(A, rotated, (flip,))
    np.testing.assert_allclose(back, B, atol=1e-12)
    assert list(np.flatnonzero(which >= 0)) == [2, 5, 6]


def test_a_board_that_looks_the_same_rotated_keeps_its_side_from_shot_to_shot():
    flip = np.diag([-1.0, -1.0, 1.0, 1.0])
    true = np.array([exp_se3(np.array([0.0, 0.0, 0.5, 0.3 * k, -0.2 * k, 0.25 * k])) for k in range(12)])
    found = np.array([T @ flip if k in (3, 4, 8) else T for k, T in enumerate(true)])
    np.testing.assert_allclose(steady(found, (flip,)), true, atol=1e-12)
    np.testing.assert_array_equal(steady(found, ()), found)


def test_what_measure_wrote_is_joined_by_the_names_of_its_shots(tmp_path):
    B = motion()[2]
    rows = [[f"{k:04d}", "ok", "", k / 2, *row] for k, row in enumerate(np.hstack([B[:, :3, 3], quaternions(B)]))]
    rows[4][1:] = ["missed", "no body", 2.0, *[""] * 7]
    path = named(tmp_path / "measured.csv", "shot,status,reason,t_s,x_m,y_m,z_m,qw,qx,qy,qz", rows)
    found = read_pose_table(path)  # no other shot's pose stands for one that was missed
    np.testing.assert_allclose(found.Ts, np.delete(B, 4, axis=0), atol=1e-9)
    assert found.notes == (f"{path}: 1 of 14 rows have no pose, and are left out: line 6 (no body)",)
    assert not any(found.missed)
    table = read_pose_table(path, keep_missed=True)
    np.testing.assert_allclose(np.delete(table.Ts, 4, axis=0), np.delete(B, 4, axis=0), atol=1e-9)
    assert table.names == tuple(f"{k:04d}" for k in range(14))
    assert table.missed == tuple("no body" if k == 4 else "" for k in range(14))
    assert table.notes == ()
    images = replace(table, names=tuple(f"img/{name}.png" for name in table.names[::-1]))
    of_robot, of_seen = matched_rows(images, table.names, table.missed)
    assert [table.names[k] for k in of_seen] == [Path(images.names[k]).stem for k in of_robot]
    assert of_seen[0] == 13


@pytest.mark.parametrize(
    "gap", [",,,,,,", "nan,nan,nan,nan,nan,nan,nan", "0.1,0.2,0.3,0,0,0,0", "1,2,3,NULL,,-,N/A", "lost,,,,,,"]
)
def test_rows_without_a_pose_on_either_side_are_left_out_and_the_others_stay_paired(tmp_path, gap):
    """By order: a tracker that lost the body, a robot that was not asked."""
    A, B = motion()[1:]
    tables = []
    for name, Ts, gone in (("robot.csv", A, (2, 7)), ("seen.csv", B, (4, 7))):
        rows = [",".join(map(repr, row)) for row in np.hstack([Ts[:, :3, 3], quaternions(Ts)]).tolist()]
        path = tmp_path / name
        path.write_text("\n".join(["x_m,y_m,z_m,qw,qx,qy,qz", *(gap if k in gone else r for k, r in enumerate(rows))]))
        tables.append(read_pose_table(path, side=name[:-4], keep_missed=True))
    robot, seen = tables
    pairs = paired(robot, seen_in_table(seen), True, None)
    kept = [k for k in range(14) if k not in (2, 4, 7)]
    np.testing.assert_array_equal(pairs.rows, kept)
    np.testing.assert_allclose(pairs.poses.A, A[kept], atol=1e-9)
    np.testing.assert_allclose(pairs.poses.B, B[kept], atol=1e-9)
    said = "\n".join(pairs.notes)
    assert f"{robot.path}: no pose in line 4 (" in said
    assert "no target in line 6 (" in said
    assert len(read_pose_table(robot.path).Ts) == 12


def test_rows_without_a_pose_beneath_the_last_one_count_and_a_quaternion_is_named_by_its_line(tmp_path):
    A, B = motion()[1:]
    sides = [[",".join(map(repr, row)) for row in np.hstack([Ts[:, :3, 3], quaternions(Ts)]).tolist()] for Ts in (A, B)]
    head, paths = "x_m,y_m,z_m,qw,qx,qy,qz", [tmp_path / "robot.csv", tmp_path / "seen.csv"]

    def read(*rows):
        for path, each in zip(paths, rows, strict=True):
            path.write_text("\n".join([head, *each]))
        robot, seen = (read_pose_table(path, keep_missed=True) for path in paths)
        return paired(robot, seen_in_table(seen), True, None)

    empty = [",,,,,,"] * 11
    np.testing.assert_array_equal(read(sides[0], [*sides[1][:-3], *empty[:3]]).rows, np.arange(11))
    np.testing.assert_array_equal(read(sides[0], [*sides[1], *empty]).rows, np.arange(14))
    with pytest.raises(InputError, match="3 of 14 poses have both sides"):
        read(sides[0], [*sides[1][:3], *empty])
    with pytest.raises(InputError, match=r"14 rows, but 13 images or target poses \(of which 12 hold a target\)"):
        read(sides[0], [*sides[1][:5], empty[0], *sides[1][:7]])
    with pytest.raises(InputError, match=r"none of 11 rows has a pose; line 2: x_m is empty"):
        read(sides[0], empty)
    with pytest.raises(InputError, match=r"line 4: a quaternion has length 2, not 1"):
        read(sides[0], [*sides[1][:2], "0.1,0.2,0.3,-1,-1,-1,-1", *sides[1][3:]])


def test_a_convention_that_the_columns_contradict_is_not_used_with_a_note(tmp_path):
    path = tmp_path / "seen.csv"
    path.write_text("x_m,y_m,z_m,qw,qx,qy,qz\n0.1,0.2,0.3,1,0,0,0\n")
    (note,) = read_pose_table(path, rotation="rotvec", side="seen").notes
    assert "--columns seen:rotation=rotvec is not used" in note
    assert not read_pose_table(path, rotation="wxyz").notes


def test_a_mounting_that_is_hardly_known_is_answered_and_not_to_be_trusted(armsight, tmp_path):
    rng = np.random.default_rng(1)
    w = rng.uniform(-1, 1, (8, 6)) * [0.15, 0.15, 0.15, 0.5, 0.04, 0]
    A = exp_se3(w)
    B = inverse(A @ X) @ Z @ exp_se3(rng.normal(0, [1.5e-3] * 3 + [6e-3] * 3, (8, 6)))
    robot, seen = matrices(tmp_path / "robot.txt", A), matrices(tmp_path / "seen.txt", B)
    said = asked(armsight, robot, seen, "--json")
    assert said.code == 3
    assert 0.02 < said.lines[0]["worst_sigma_m"] < 0.5
    assert re.match(
        r"T_flange_rig is known, where the body was seen, to \d+ mm and \d\.\d deg only", said.lines[0]["untrusted"][0]
    )
