"""A rig that is put right while it is used."""

from dataclasses import replace

import faults
import numpy as np
import pytest

from armsight.geometry.pose import exp_se3, inverse, log_se3
from armsight.loop.estimators import Mounting
from armsight.loop.health.change import Change, suspects
from armsight.loop.health.follow import RigCorrection, RigFollower, remeasured
from armsight.loop.health.landmarks import LandmarkWatch

BASE, BODY, RIG = (next(each for each in suspects(6) if each.kind == kind) for kind in ("rig", "body", "drift"))
T_TOOL = exp_se3(np.array([0.4, 0.1, 0.5, 0.3, -0.2, 0.5]))


def change(suspect, xi, sigma_m=5e-5, score=50.0):
    """A hypothesis by which the measured tool is exp(xi) times the true one (6,), in the base's frame."""
    effect = np.linalg.inv(np.array([log_se3(exp_se3(e)) for e in np.eye(6)]))  # of the tangent at the tool itself
    xi_tool = log_se3(inverse(T_TOOL) @ exp_se3(xi) @ T_TOOL)
    cov = np.diag(np.repeat([sigma_m**2, (2 * sigma_m) ** 2], 3))
    return Change(suspect, 10.0, 14.0, xi_tool, cov, 200.0, score, effect, T_TOOL)


def follower():
    return RigFollower(faults.TRUE, faults.BODY)


def test_cameras_that_rotate_in_mid_run_are_put_right():
    rotated = np.array([0.0, np.radians(0.05), 0.0])
    poses, found, squares, rig = [], None, [], follower()
    for monitor, t_s, T, estimate, _ in faults.watched_body(7001, rotated=rotated, at_s=2.0, seconds=6.5):
        poses.append((t_s, estimate))
        if found is None:
            rig = RigFollower(monitor._rig._rig, faults.BODY) if len(poses) == 1 else rig
            watch = monitor.cameras_moved() if len(poses) % 30 == 0 else None
            since_s = None if watch is None else watch.moved_since_s()
            found = None if since_s is None else rig.cameras(since_s, poses, t_s)
            if found is not None:
                monitor.put_right(found)
        elif len(poses) % 8 == 0:
            again = faults.measured(found.update.rig, faults.BODY, T, estimate.points.seen.uv)
            off = log_se3(inverse(again.T_left_body) @ T)
            squares.append(off @ np.linalg.solve(again.cov, off))
    assert found.at_s < 6.0
    assert found.since_s == pytest.approx(2.0, abs=1.1)
    true = faults.TRUE.T_left_right @ exp_se3(np.append(np.zeros(3), rotated))
    off = log_se3(inverse(found.update.rig.T_left_right) @ true)[3:]
    assert np.degrees(np.linalg.norm(off)) < 0.02
    assert np.mean(squares) < 22.5  # the calibration's error is drawn once: six degrees of freedom, one of a thousand
    (finding,) = monitor.findings()
    assert (finding.cause, finding.corrected_s) == ("rig", found.at_s)


def test_few_shots_are_rejected_with_the_reason():
    *_, (_, t_s, _, estimate, _) = faults.watched_body(7002, seconds=0.2)
    one = follower()
    assert one.cameras(0.0, [(t_s + 2.0, estimate)] * 20, 5.0) is None
    assert "1 shots since they moved differ" in one.rejected


def test_a_motion_of_the_rig_is_undone_by_its_mounting():
    moved = np.array([0.002, -0.001, 0.003, 0.001, 0.002, -0.001])
    old = Mounting(exp_se3(np.array([0.1, 0.9, 0.4, 1.0, 0.2, 0.3])), np.eye(4), 1e-10 * np.eye(12))
    true = old.T_base_rig @ exp_se3(moved)
    xi = log_se3(old.T_base_rig @ inverse(true))  # measured = T_old inv(T_true) true
    correction = follower().base_by_arm([change(BASE, xi)], old.T_base_rig, 15.0)
    new = correction.mounting(old)
    np.testing.assert_allclose(new.T_base_rig, true, atol=1e-5)
    assert (np.linalg.eigvalsh(new.cov[:6, :6]) > 1e-10).all()
    assert "the tool had appeared displaced by" in correction.line()


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ([change(BODY, np.full(6, 0.002))], "a change of the body explains the poses of the arm better"),
        ([change(BASE, np.full(6, 0.002), sigma_m=3e-4)], "the tool would be uncertain by 0.30 mm"),
        ([change(BASE, np.full(6, 0.002)), change(BODY, np.full(6, 0.001))], "body cannot be excluded"),
    ],
)
def test_what_is_not_determined_is_not_put_right(changes, reason):
    one = follower()
    assert one.base_by_arm(changes, np.eye(4), 15.0) is None
    assert reason in one.rejected


def test_fixed_bodies_show_by_how_much_both_cameras_moved():
    *_, (_, _, _, estimate, _) = faults.watched_body(7003, seconds=0.1)
    watch, motion = LandmarkWatch(["a", "b"]), exp_se3(np.array([0.002, 0.0, 0.001, 0.0, 0.001, 0.0]))
    Ts = estimate.T_left_body, exp_se3(np.array([0.2, 0.1, 0.0, 0.0, 0.4, 0.0])) @ estimate.T_left_body
    for k in range(36):  # the cameras move within a mean of five
        for row, T in enumerate(Ts):
            T = inverse(motion) @ T if k >= 12 else T
            watch.take(row, replace(estimate, T_left_body=T), 0.2 * k)
    m, cov = watch.motion
    np.testing.assert_allclose(m, log_se3(motion), atol=1e-5)
    old = Mounting(np.eye(4), np.eye(4), np.zeros((12, 12)))
    correction = RigCorrection("base", 2.4, 5.4, "fixed bodies", None, m, cov)
    np.testing.assert_allclose(correction.mounting(old).T_base_rig, motion, atol=1e-5)


def test_a_pose_is_measured_again_with_another_rig():
    *_, (monitor, _, _, estimate, _) = faults.watched_body(7004, seconds=0.1)
    again = remeasured(monitor._rig._rig, faults.BODY, estimate)
    assert np.linalg.norm(log_se3(inverse(again.T_left_body) @ estimate.T_left_body)[:3]) < 1e-4
