"""Motions of the tool in space: on the path by forward kinematics, rejected at the position plain geometry says."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from arm_motions import shifted, start, within
from scipy.spatial.transform import Rotation, Slerp

from armsight.errors import InputError
from armsight.robot.models import MODELS
from armsight.robot.trajectories import MotionRejected, arc, circle, line, waypoints
from armsight.robot.trajectories.trajectory import check_times, pieces

SIX_R = MODELS["six_r"]
#: Joint angles, deg, and 300 mm that each arm has room for. The tool of six_r goes across in front of it.
LINES = {
    "six_r": ((-26, -68.9, 79.4, -10.5, -64, 90), (0, 0.3, 0)),
    "puma560": ((0, 60, -150, 20, 60, 10), (0, 0, -0.3)),
    "ur5": ((0, -90, 90, -80, -90, 20), (0, 0.3, 0)),
    "ur10": ((0, -90, 90, -80, -90, 20), (-0.2, 0.2, 0.1)),
    "irb120": ((0, 0, 0, 0, 60, 0), (0, 0, -0.3)),
}


def off_line(arm, q, T, step):
    """How far the tool is from the straight line through T along a step, m."""
    p = arm.forward(q)[:, :3, 3] - T[:3, 3]
    along = np.array(step) / np.linalg.norm(step)
    return np.linalg.norm(p - (p @ along)[:, None] * along, axis=1).max()


@pytest.mark.parametrize("name", LINES)
def test_a_line_of_300_mm_in_1_s(name):
    arm = MODELS[name]
    q, step = np.radians(LINES[name][0]), np.array(LINES[name][1]) * 0.3 / np.linalg.norm(LINES[name][1])
    T = arm.forward(q)
    motion = line(arm, q, shifted(T, step), duration_s=1.0)
    assert motion.duration_s == pytest.approx(1.0, abs=1e-8)
    within(arm, motion)
    between = np.random.default_rng(0).uniform(0, 1, 500)  # not only where it was checked
    assert off_line(arm, motion.at(between).q, T, step) < 1e-9  # asked for are 1e-5
    np.testing.assert_allclose(arm.forward(motion.at(1.0).q), shifted(T, step), atol=1e-9)


def test_orientation_rotates_evenly_with_the_way():
    arm, q = MODELS["ur5"], start("ur5")
    T = arm.forward(q)
    goal = shifted(T, [0.05, 0.08, -0.04], [0.4, -0.5, 0.3])
    motion = line(arm, q, goal)
    Ts = arm.forward(motion.at(check_times(motion.duration_s)).q)
    share = np.linalg.norm(Ts[:, :3, 3] - T[:3, 3], axis=1) / np.linalg.norm(goal[:3, 3] - T[:3, 3])
    slerp = Slerp([0, 1], Rotation.from_matrix(np.array([T[:3, :3], goal[:3, :3]])))(np.clip(share, 0, 1))
    np.testing.assert_allclose(Ts[:, :3, :3], slerp.as_matrix(), atol=1e-8)
    assert (np.diff(share) > -1e-12).all()


def test_a_motion_without_a_duration_is_brought_to_a_limit():
    motion = line(SIX_R, start("six_r"), shifted(SIX_R.forward(start("six_r")), [0.0, 0.1, 0.0]))
    t = check_times(motion.duration_s)
    q, qd, qdd = motion.at(t)
    jerk = np.diff(qdd, axis=0)[:-1] / 1e-3
    used = [(np.abs(a) / b).max() for a, b in ((qd, SIX_R.qd_max), (qdd, SIX_R.qdd_max), (jerk, SIX_R.qddd_max))]
    assert 0.99 < max(used) <= 1 + 1e-9
    # The inverse finds the start anew, to two units of the last digit of an angle.
    np.testing.assert_allclose(q[0], start("six_r"), rtol=0, atol=2 * np.spacing(np.pi))
    goal = shifted(SIX_R.forward(start("six_r")), [0.0, 0.1, 0.0])
    with pytest.raises(InputError, match=r"duration_s is 0\.5; within the arm's limits this motion takes") as found:
        line(SIX_R, start("six_r"), goal, duration_s=0.5)
    reported = float(str(found.value).split()[-2])
    assert motion.duration_s <= reported < motion.duration_s + 3e-4
    assert line(SIX_R, start("six_r"), goal, duration_s=reported).duration_s == pytest.approx(reported, abs=1e-8)


def test_a_full_circle_comes_back_and_keeps_its_radius():
    arm, q = MODELS["ur10"], start("ur10")
    T = arm.forward(q)
    center, axis = T[:3, 3] + [0.05, 0.02, 0.0], np.array([0.1, 0.2, 1.0])
    motion = circle(arm, q, center, axis)
    Ts = arm.forward(motion.at(check_times(motion.duration_s)).q)
    out = Ts[:, :3, 3] - center
    axis /= np.linalg.norm(axis)
    height = out @ axis
    np.testing.assert_allclose(height, height[0], atol=1e-9)
    radius = np.linalg.norm(out - height[:, None] * axis, axis=1)
    np.testing.assert_allclose(radius, radius[0], atol=1e-9)
    np.testing.assert_allclose(Ts[:, :3, :3], np.tile(T[:3, :3], (len(Ts), 1, 1)), atol=1e-9)
    np.testing.assert_allclose(Ts[-1], T, atol=1e-9)
    swept = np.unwrap(np.arctan2(*(out @ np.stack([np.cross(axis, out[0]), out[0] - height[0] * axis], axis=1)).T))
    assert swept[-1] == pytest.approx(2 * np.pi, abs=1e-7)


def test_the_tool_rotates_with_the_circle_where_asked():
    arm, q = MODELS["ur10"], start("ur10")
    T = arm.forward(q)
    axis = np.array([0.0, 0.0, 1.0])
    motion = circle(arm, q, T[:3, 3] + [0.1, 0, 0], axis, 0.8, rotation_base=0.8 * axis)
    Ts = arm.forward(motion.at(check_times(motion.duration_s)).q)
    seen = np.swapaxes(Ts[:, :3, :3], 1, 2) @ (Ts[:, :3, 3] - (T[:3, 3] + [0.1, 0, 0]))[..., None]
    np.testing.assert_allclose(seen, np.tile(seen[0], (len(Ts), 1, 1)), atol=1e-9)  # the centre stays where it was


def test_an_arc_passes_its_points():
    arm, q = MODELS["ur5"], start("ur5")
    T = arm.forward(q)
    via, goal = T[:3, 3] + [0.0, 0.03, 0.02], shifted(T, [0.05, 0.04, 0.0], [0, 0, 0.3])
    motion = arc(arm, q, via, goal)
    Ts = arm.forward(motion.at(np.linspace(0, motion.duration_s, 20_001)).q)
    # Between samples the tool moves less than 0.1 mm, and half of that is as far as a sample may be from the point.
    assert np.linalg.norm(Ts[:, :3, 3] - via, axis=1).min() < 5e-5
    np.testing.assert_allclose(Ts[-1], goal, atol=1e-9)


def test_waypoints_are_passed_without_stopping():
    arm, q = MODELS["ur5"], start("ur5")
    T = arm.forward(q)
    corners = [shifted(T, [0.0, 0.08, 0.0]), shifted(T, [0.08, 0.08, 0.0], [0, 0, 0.2]), shifted(T, [0.08, 0.0, 0.05])]
    blend_m = 0.02
    motion = waypoints(arm, q, corners, blend_m=blend_m)
    within(arm, motion)
    t = check_times(motion.duration_s)
    p = arm.forward(motion.at(t).q)[:, :3, 3]
    speed = np.linalg.norm(np.diff(p, axis=0), axis=1) / 1e-3
    for corner in corners[:-1]:
        near = int(np.argmin(np.linalg.norm(p - corner[:3, 3], axis=1)))
        assert np.linalg.norm(p[near] - corner[:3, 3]) < 3 / 16 * np.sqrt(2) * blend_m + 1e-3
        assert speed[near] > 0.05
    np.testing.assert_allclose(p[-1], corners[-1][:3, 3], atol=1e-9)


def test_bends_are_passed_at_a_steady_pace_and_lines_faster():
    arm, q = MODELS["ur5"], start("ur5")
    T = arm.forward(q)
    corners = [shifted(T, [0.0, 0.15, 0.0]), shifted(T, [0.0, 0.15, -0.15]), shifted(T, [0.0, 0.0, -0.15])]
    motion = waypoints(arm, q, corners, blend_m=0.02)
    p = arm.forward(motion.at(check_times(motion.duration_s)).q)[:, :3, 3]
    moved = np.linalg.norm(np.diff(p, axis=0), axis=1)[:-1] / 1e-3
    middle = (p[1:-1] + p[:-2]) / 2
    for corner in corners[:-1]:
        # Within 10 mm of the corner the bend cuts it by up to 3/16 sqrt(2) 20 mm and its length by a fifth.
        pace = moved[np.linalg.norm(middle - corner[:3, 3], axis=1) < 0.012]
        assert len(pace) > 10
        assert 0.15 < pace.min() / moved.max() < pace.max() / moved.max() < 0.7
    slow = waypoints(arm, q, corners, blend_m=0.02, duration_s=2 * motion.duration_s)
    assert slow.duration_s == pytest.approx(2 * motion.duration_s)
    within(arm, slow)
    with pytest.raises(InputError, match="this motion takes"):
        waypoints(arm, q, corners, blend_m=0.02, duration_s=0.9 * motion.duration_s)


def test_a_long_motion_is_looked_through_in_pieces():
    t = check_times(50.0005)
    parts = pieces(t)
    assert len(parts) > 1
    np.testing.assert_array_equal(np.concatenate([parts[0], *(part[1:] for part in parts[1:])]), t)
    assert all(a[-1] == b[0] for a, b in pairwise(parts))
    assert [list(part) for part in pieces(np.array([0.0, 0.1]))] == [[0.0, 0.1]]
    arm, q = MODELS["ur5"], start("ur5")
    motion = line(arm, q, shifted(arm.forward(q), [0.0, 0.1, 0.0]), duration_s=45.0)
    assert motion.duration_s == pytest.approx(45.0, abs=1e-8)
    tight = replace(arm, q_min=np.where(np.arange(6) == 0, motion.at(40.0).q[0], arm.q_min))
    with pytest.raises(MotionRejected, match="joint 1 at") as found:
        line(tight, q, shifted(arm.forward(q), [0.0, 0.1, 0.0]), duration_s=45.0)
    assert found.value.t_s == pytest.approx(40.0, abs=0.01)


# Rejections: where and when.


def said_of(found, arm, motion_start, step):
    """Hold a rejection's share, position and text together."""
    T = arm.forward(motion_start)
    np.testing.assert_allclose(found.p_base, T[:3, 3] + found.share * np.array(step), atol=1e-9)
    x, y, z = 1e3 * found.p_base
    text = str(found)
    assert f"{100 * found.share:.1f} % of the way, {found.t_s:.3f} s after the start" in text
    assert f"tool at ({x:.1f}, {y:.1f}, {z:.1f}) mm" in text
    assert found.reason in text
    assert "\n" not in text


def test_a_joint_limit_is_rejected_where_geometry_says():
    arm = replace(SIX_R, q_max=np.radians([20.0, 45, 150, 150, 170, 180]))
    q = start("six_r")
    T, step = arm.forward(q), np.array([-0.01, 0.15, 0.0])
    with pytest.raises(
        MotionRejected, match=r"joint 1 at 20.000 deg is outside its limits -170.000 to 20.000"
    ) as found:
        line(arm, q, shifted(T, step), duration_s=2.0)
    # The wrist lies in the arm's plane: w = p - d6 z of the tool. Joint 1 is at 20 degrees where w is on that ray.
    w = T[:3, 3] - SIX_R.d[5] * T[:3, 2]
    ray = np.array([-np.sin(np.radians(20)), np.cos(np.radians(20)), 0.0])
    share = -(ray @ w) / (ray @ step)
    assert found.value.share == pytest.approx(share, abs=1e-7)  # ROUNDING of a limit over what joint 1 moves on the way
    said_of(found.value, arm, q, step)
    assert 0 < found.value.t_s < 2.0
    # The same motion at half the duration would be there at half the time.
    with pytest.raises(MotionRejected) as sooner:
        line(arm, q, shifted(T, step), duration_s=1.0)
    assert sooner.value.t_s == pytest.approx(found.value.t_s / 2, rel=1e-6)


def test_leaving_the_reach_is_rejected_where_the_elbow_is_straight():
    q = np.radians([0, -60, 70, -10, -90, 0])
    T, step = SIX_R.forward(q), np.array([0.4, 0.0, 0.0])
    with pytest.raises(MotionRejected, match=r"the path leaves the reach of the arm \(unreachable") as found:
        line(SIX_R, q, shifted(T, step))
    # Joint 4's axis, at the end of the forearm, moves with the tool; it cannot be further from joint 2's than a2 + a3.
    Ts = SIX_R.links(q)
    elbow = Ts[3, :3, 3] - Ts[1, :3, 3]
    a, b, c = step @ step, 2 * elbow @ step, elbow @ elbow - (0.2515 + 0.125) ** 2
    share = (-b + np.sqrt(b * b - 4 * a * c)) / (2 * a)
    assert found.value.share == pytest.approx(share, abs=1e-6)
    said_of(found.value, SIX_R, q, step)


@pytest.mark.parametrize(("name", "q_deg"), [("puma560", (10, 60, -150, 20, 5, 0)), ("irb120", (10, 0, -20, 20, 5, 0))])
def test_a_wrist_singularity_is_rejected_before_axes_4_and_6_are_in_line(name, q_deg):
    arm, before = MODELS[name], np.radians(q_deg)
    at = before * [1, 1, 1, 1, 0, 1]
    T, through = arm.forward(before), arm.forward(at)
    step = 2 * (through[:3, 3] - T[:3, 3])
    goal = shifted(T, step)
    rotation = Rotation.from_matrix(through[:3, :3] @ T[:3, :3].T).as_rotvec()
    goal[:3, :3] = Rotation.from_rotvec(2 * rotation).as_matrix() @ T[:3, :3]
    with pytest.raises(
        MotionRejected, match=r"a singularity: joints 4 and 6 can rotate with hardly any motion"
    ) as found:
        line(arm, before, goal)
    # Half way axis 5 is at zero; it is rejected where the tool's slowest way needs joints 200 times as fast.
    assert found.value.share < 0.5
    there = shifted(T, found.value.share * step, 2 * found.value.share * rotation)
    J = arm.jacobian(arm.inverse(there, near=before).q[0])
    J[:3] /= np.hypot(arm.a, arm.d).sum()
    assert np.linalg.svd(J, compute_uv=False)[-1] == pytest.approx(1 / 200, rel=1e-6)
    said_of(found.value, arm, before, step)


def test_a_start_in_a_singularity_is_rejected_at_once():
    with pytest.raises(MotionRejected, match=r"a singularity: joints 2, 3 and 4 .* 0.0 % of the way, 0.000 s") as found:
        line(SIX_R, SIX_R.home, shifted(SIX_R.forward(SIX_R.home), [-0.1, 0.0, 0.0]))
    assert (found.value.share, found.value.t_s) == (0.0, 0.0)


def test_whole_revolutions_are_kept():
    arm = MODELS["ur5"]
    q = start("ur5")
    q[5] += 2 * np.pi - 0.5
    motion = line(arm, q, shifted(arm.forward(q), [0.02, 0.03, 0.0], [0, 0, 0.1]))
    moved = motion.at(check_times(motion.duration_s)).q
    assert np.abs(np.diff(moved, axis=0)).max() < 0.01
    with pytest.raises(MotionRejected, match=r"joint 6 at 360.000 deg is outside its limits"):
        line(arm, q, shifted(arm.forward(q), [0.02, 0.03, 0.0], [0, 0, -0.6]))


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda a, q, T: line(a, q, np.eye(3)), r"T_base_goal has shape \(3, 3\)"),
        (lambda a, q, T: line(a, q, T), "nothing to travel"),
        (lambda a, q, T: line(a, q, np.full((4, 4), np.nan)), "NaN"),
        (lambda a, q, T: line(a, q, shifted(T, [0.1, 0, 0]), duration_s=-1), "positive number of seconds"),
        (lambda a, q, T: line(a, q, shifted(T, [0.1, 0, 0]), duration_s=1e9), "more than 3600 s is not planned"),
        (lambda a, q, T: circle(a, q, T[:3, 3], [0, 0, 1]), "on the circle's axis"),
        (lambda a, q, T: circle(a, q, T[:3, 3] + 0.1, [0, 0, 0]), "axis_base is zero"),
        (lambda a, q, T: circle(a, q, T[:3, 3] + 0.1, [0, 0, 1], 0.0), "angle_rad is 0.0"),
        (lambda a, q, T: circle(a, q, [0, 1], [0, 0, 1]), "center_base has shape"),
        (lambda a, q, T: arc(a, q, T[:3, 3] + [0.1, 0, 0], shifted(T, [0.2, 0, 0])), "plan a line"),
        (lambda a, q, T: waypoints(a, q, [shifted(T, [0.1, 0, 0])], blend_m=0.01), "2 or more are needed"),
        (lambda a, q, T: waypoints(a, q, [T, shifted(T, [0.1, 0, 0])], blend_m=0.01), "way-point 1 is where the tool"),
        (lambda a, q, T: waypoints(a, q, [shifted(T, [0.1, 0, 0]), T], blend_m=0.0), "blend_m is 0.0"),
        (lambda a, q, T: waypoints(a, q, [shifted(T, [0.1, 0, 0]), 2 * T], blend_m=0.1), "way-point 2 is no pose"),
        (lambda a, q, T: waypoints(a, q, "north", blend_m=0.1), "must be poses"),
    ],
)
def test_bad_input_is_rejected_in_one_line(make, said):
    arm, q = MODELS["ur5"], start("ur5")
    with pytest.raises(InputError, match=said) as found:
        make(arm, q, arm.forward(q))
    assert "\n" not in str(found.value)
