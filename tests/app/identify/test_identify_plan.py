"""Choosing the next poses from what was measured and what the cameras can see."""

import csv

import numpy as np
import pytest
from identify_files import poses_csv

from armsight.errors import InputError
from armsight.geometry.pose import exp_se3, inverse, pose
from armsight.loop.identify.measured import Measured
from armsight.loop.identify.plan import plan_joints
from armsight.robot.arm_file import open_arm
from armsight.vision.camera import Camera
from armsight.vision.rig import StereoRig
from cli_runs import assert_rejected, said_of

T_FLANGE_BODY = exp_se3(np.array([0.02, -0.01, 0.05, 0.1, 0.2, -0.3]))


def rig_in_front():
    """Two cameras side by side."""
    camera = Camera((1280, 720), "brown5", np.array([900.0, 900, 640, 360]), np.array([-0.1, 0.05, 1e-4, 2e-4, 0.0]))
    n = 2 * camera.parameters.size + 6
    return StereoRig(camera, camera, pose(np.eye(3), np.array([0.2, 0, 0])), np.zeros((n, n)), 0.1)


def T_base_rig(away_m):
    """Return where the rig stands: so far from axis 1, 0.6 m up, looking at the axis."""
    return pose(np.array([[0, 0, -1.0], [1, 0, 0], [0, -1, 0]]), np.array([away_m, -0.1, 0.6]))


def seen_by(rig, T_rig, q):
    """Return T_rig_body at joint angles, and whether both images hold its middle: projected by hand, no lens."""
    T = inverse(T_rig) @ open_arm("ur10").forward(q) @ T_FLANGE_BODY
    p = T[:, :3, 3]
    inside = p[:, 2] > 0
    for shift in (0.0, 0.2):
        uv = 900 * (p[:, :2] - [shift, 0]) / p[:, 2:] + [640, 360]
        inside &= ((uv > 30) & (uv < [1250, 690])).all(axis=1)
    return T, inside


def done_before(rig, T_rig, n, *, points=0):
    """Return n poses that the rig sees, as full poses or as points on the body."""
    rng = np.random.default_rng(5)
    q = rng.uniform(-np.pi, np.pi, (20000, 6))
    T, inside = seen_by(rig, T_rig, q)
    rows = np.flatnonzero(inside)[:n]
    T = T[rows] @ exp_se3(rng.normal(0, [1e-4] * 3 + [5e-4] * 3, (n, 6)))
    if points:
        body = np.array([[0, 0, 0, 1.0], [0.05, 0, 0, 1], [0, 0.05, 0, 1], [0, 0, 0.05, 1]])[:points]
        return Measured(q[rows], np.einsum("nij,kj->nki", T, body)[..., :3])
    cov = np.tile(np.diag([1e-4] * 3 + [5e-4] * 3) ** 2, (n, 1, 1))
    return Measured(q[rows], T[:, None, :3, 3], T[:, :3, :3], cov, rng.choice([-1.0, 1.0], (n, 6)))


@pytest.mark.parametrize(("away_m", "points"), [(1.1, 0), (2.0, 0), (1.1, 1), (1.1, 4)])
def test_a_rig_nearer_than_the_arms_reach_sees_every_planned_pose(away_m, points):
    """The arm reaches 1.3 m: behind cameras 1.1 m away, where nothing is seen and no covariance stands for it."""
    rig, T_rig = rig_in_front(), T_base_rig(away_m)
    plan = plan_joints(open_arm("ur10"), done_before(rig, T_rig, 15, points=points), rig, 3, 0)
    assert (np.diff(plan.sigma_m) < 0).all()
    assert seen_by(rig, T_rig, plan.q)[1].all()


def test_poses_that_rotate_the_body_further_away_than_it_was_seen_are_not_planned():
    rig, T_rig = rig_in_front(), T_base_rig(1.6)
    done = done_before(rig, T_rig, 600)
    toward = np.einsum("nji,nj->ni", done.R_rig_body, -done.p_rig[:, 0])
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    near = np.flatnonzero(toward[:, 2] > np.cos(np.radians(40)))  # seen from its +z only
    assert len(near) >= 15
    plan = plan_joints(open_arm("ur10"), done.rows(near[:15]), rig, 3, 0)
    T, inside = seen_by(rig, T_rig, plan.q)
    ray = np.einsum("nji,nj->ni", T[:, :3, :3], -T[:, :3, 3])
    assert inside.all()
    # Its mean direction is that much off +z at most, and 10 degrees more are allowed.
    assert (ray[:, 2] / np.linalg.norm(ray, axis=1) > np.cos(np.radians(40 + 40 + 10))).all()


def test_a_rig_that_sees_no_pose_of_the_arm_is_reported():
    rig = rig_in_front()
    T_away = T_base_rig(1.1) @ pose(np.diag([-1.0, 1, -1]), np.zeros(3))
    rng = np.random.default_rng(5)
    q = rng.uniform(-1, 1, (15, 6))
    T = inverse(T_away) @ open_arm("ur10").forward(q) @ T_FLANGE_BODY
    with pytest.raises(InputError, match="can be reached and seen"):
        plan_joints(open_arm("ur10"), Measured(q, T[:, None, :3, 3], T[:, :3, :3]), rig, 3, 0)


def said(capsys, *arguments):
    return said_of(capsys, "identify", "plan", "--arm", "six_r", *arguments)


def test_poses_that_cannot_locate_the_arm_are_rejected_as_identify_rejects_them(tmp_path, capsys):
    assert_rejected(said(capsys, "--data", poses_csv(tmp_path / "few.csv", n=5)), "5 poses are fewer than 6")
    path = poses_csv(tmp_path / "alike.csv")
    with path.open() as file:
        head, first, *rest = list(csv.reader(file))
    path.write_text("\n".join(",".join(row) for row in [head, first, *(first[:6] + row[6:] for row in rest)]))
    assert_rejected(said(capsys, "--data", path), "the poses are too alike")
    exchanged = [head, *(row[1::-1] + row[2:] for row in [first, *rest])]
    path.write_text("\n".join(",".join(row) for row in exchanged))
    assert_rejected(said(capsys, "--data", path), "order is q2, q1")
