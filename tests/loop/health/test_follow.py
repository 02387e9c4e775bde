"""A rig that is put right while it is used."""

from dataclasses import replace
from types import SimpleNamespace

import faults
import numpy as np
import pytest

from armsight.data import Missed
from armsight.geometry.pose import adjoint, exp_se3, inverse, log_se3
from armsight.loop.estimators import Mounting
from armsight.loop.health import HealthFinding, HealthMonitor, follow
from armsight.loop.health.base_motion import Moved
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


def moved(xi, sigma_m=5e-5, *Ts):
    """The same motion (6,) as the arm's filter estimates it, as uncertain at T_TOOL, where the arm is, after poses Ts."""
    to_base = adjoint(T_TOOL)
    cov = to_base @ np.diag(np.repeat([sigma_m**2, (2 * sigma_m) ** 2], 3)) @ to_base.T
    return Moved(xi, cov, (*Ts, T_TOOL))


def follower():
    return RigFollower(faults.TRUE, faults.BODY)


def test_cameras_that_moved_in_the_newest_test_are_put_right_after_the_next_one():
    """A large rotation is found by the few shots after it that the running test has: it may have begun at any of them."""
    one, poses, found, rotated = None, [], None, np.radians([0.0, 0.0, 0.2])
    for monitor, t_s, _, estimate, _ in faults.watched_body(5100, rotated=rotated, at_s=5.0, seconds=20.0):
        one = one or RigFollower(monitor._rig.rig, faults.BODY)
        poses.append((t_s, estimate))
        if (watch := monitor.cameras_moved()) is not None and (since_s := watch.moved_since_s()) is not None:
            found = one.cameras(since_s, poses, t_s)
        if found is not None:
            break
    true = faults.TRUE.T_left_right @ exp_se3(np.append(np.zeros(3), rotated))
    left = np.linalg.norm(log_se3(inverse(found.update.rig.T_left_right) @ true)[3:])
    assert left < 4 * found.update.sigma_rad
    assert found.at_s < 8.0


def test_few_shots_are_rejected_with_the_reason():
    *_, (_, t_s, _, estimate, _) = faults.watched_body(7002, seconds=0.2)
    one = follower()
    assert one.cameras(0.0, [(t_s + 2.0, estimate)] * 20, 5.0) is None
    assert "1 shots since they moved differ" in one.rejected


def test_after_a_rejection_new_shots_are_waited_for_however_many_there_were(monkeypatch):
    *_, (_, _, _, estimate, _) = faults.watched_body(7005, seconds=0.1)
    tried = []
    monkeypatch.setattr(follow, "updated_rig", lambda *given: tried.append(1) or Missed("as ever"))
    one = follower()
    shots = [
        (0.1 * k, replace(estimate, T_left_body=estimate.T_left_body @ exp_se3(0.05 * (k % 2) * np.ones(6))))
        for k in range(200)
    ]
    for newest in range(50, 200):  # the window has 40 shots always
        one.cameras(0.0, shots[newest - 40 : newest], 20.0)
    assert len(tried) == 15
    assert one.rejected == "cameras: as ever"


def test_fixed_bodies_that_say_too_little_put_nothing_right():
    one, p_left = follower(), np.array([0.0, 0.0, 0.9])
    motion = np.array([0.002, 0, 0, 0, 0, 0])
    sigmas = np.repeat([5e-5, 1e-4], 3)
    assert one.base_by_bodies(2.0, (motion, np.diag(sigmas**2)), 5.0, p_left).by == "fixed bodies"
    assert one.base_by_bodies(2.0, (motion, np.diag((3 * sigmas) ** 2)), 5.0, p_left) is None
    assert "uncertain by 0.31 mm" in one.rejected


def test_findings_of_another_cause_stay_after_a_correction():
    """What began before, a body that others prove to move, and joints; cameras that rotated explain the rest."""
    at = {"size": 1.0, "sigma": 0.1, "unit": "mm", "advice": "look"}
    joint, slip = (HealthFinding("joint", f"joint {k} slipped by 1 deg", t_s, **at) for k, t_s in ((2, 3.0), (3, 8.5)))
    body, post, rig = (
        HealthFinding(cause, what, 8.5, **at)
        for cause, what in (("body", "it slipped by 1 mm"), ("fixed", "a post"), ("fixed", "the rig moved by 2 mm"))
    )
    monitor = HealthMonitor(faults.TRUE, faults.BODY, 0.0)
    monitor.watch_fixed(["post"])
    for what, found, stays in (
        ("base", (joint, post, rig), [(joint.cause, None), ("fixed", None), ("fixed", 9.0)]),
        ("cameras", (joint, slip, body), [("joint", None), ("joint", None)]),
    ):
        monitor._kept, monitor._landmarks.not_fixed = (), (post,)
        monitor._moved = lambda found=found: found
        update = None if what == "base" else SimpleNamespace(rig=faults.TRUE)
        monitor.put_right(RigCorrection(what, 8.0, 9.0, "body", update, np.zeros(6), np.zeros((6, 6))))
        del monitor._moved
        assert {(each.cause, each.corrected_s) for each in monitor.findings()} == set(stays)
        assert len(monitor.findings()) == len(stays)


def test_a_motion_of_the_rig_is_undone_by_its_mounting():
    motion = np.array([0.002, -0.001, 0.003, 0.001, 0.002, -0.001])
    old = Mounting(exp_se3(np.array([0.1, 0.9, 0.4, 1.0, 0.2, 0.3])), np.eye(4), 1e-10 * np.eye(12))
    true = old.T_base_rig @ exp_se3(motion)
    xi = log_se3(old.T_base_rig @ inverse(true))  # measured = T_old inv(T_true) true
    correction = follower().base_by_arm([change(BASE, xi)], old.T_base_rig, 15.0, moved(xi))
    new = correction.mounting(old)
    np.testing.assert_allclose(new.T_base_rig, true, atol=1e-5)
    assert (np.linalg.eigvalsh(new.cov[:6, :6]) > 1e-10).all()
    assert "the tool had appeared displaced by" in correction.line()


MM_2 = np.full(6, 0.002)
FAR = T_TOOL @ exp_se3(np.array([2.0, 0, 0, 0, 0, 0]))


@pytest.mark.parametrize(
    ("changes", "motion", "reason"),
    [
        ([change(BODY, MM_2)], moved(MM_2), "a change of the body explains the poses of the arm better"),
        ([change(BASE, MM_2)], moved(MM_2, 5e-4), "the tool would be uncertain by 0.50 mm"),
        ([change(BASE, MM_2)], moved(MM_2, 1e-4, FAR), "the tool would be uncertain by 0.41 mm"),
        ([change(BASE, MM_2)], None, "no pose was measured since it moved"),
        ([change(BASE, MM_2), change(BODY, np.full(6, 0.001))], moved(MM_2), "body cannot be excluded"),
    ],
)
def test_what_is_not_determined_is_not_put_right(changes, motion, reason):
    one = follower()
    assert one.base_by_arm(changes, np.eye(4), 15.0, motion) is None
    assert reason in one.rejected


def test_a_motion_that_was_put_right_is_refined_once_more_is_known_of_it():
    off = np.array([2e-4, -1e-4, 1e-4, 1e-4, 0.0, 2e-4])  # what the first correction leaves
    true_motion = np.array([0.002, -0.001, 0.003, 0.001, 0.002, -0.001])
    old = Mounting(exp_se3(np.array([0.1, 0.9, 0.4, 1.0, 0.2, 0.3])), np.eye(4), 1e-10 * np.eye(12))
    true = old.T_base_rig @ exp_se3(true_motion)
    one, xi = follower(), log_se3(old.T_base_rig @ inverse(true))
    first = one.base_by_arm([change(BASE, xi)], old.T_base_rig, 15.0, moved(xi + off, 2.8e-4))
    then = first.mounting(old)
    left = log_se3(then.T_base_rig @ inverse(true))
    assert one.refined(first, then.T_base_rig, 16.0, moved(left, 2.6e-4)) is None
    further = one.refined(first, then.T_base_rig, 16.0, moved(left + np.array([2e-3, 0, 0, 0, 0, 0]), 2.6e-4))
    assert further.refines is first  # a drift goes on
    second = one.refined(first, then.T_base_rig, 17.0, moved(left, 1e-4))
    new = second.mounting(then)
    np.testing.assert_allclose(new.T_base_rig, true, atol=1e-7)
    np.testing.assert_allclose(second.motion, true_motion, atol=1e-5)
    assert second.tool_m[0] == pytest.approx(first.tool_m[0], abs=4e-4)
    direct = replace(second, refines=None).mounting(old)
    np.testing.assert_allclose(new.cov, direct.cov, atol=1e-9)
    assert np.trace(new.cov) < np.trace(then.cov)


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
    again = remeasured(monitor._rig.rig, faults.BODY, estimate)
    assert np.linalg.norm(log_se3(inverse(again.T_left_body) @ estimate.T_left_body)[:3]) < 1e-4
