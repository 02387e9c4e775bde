"""Fixed bodies in view: cameras that moved together, bodies that are not fixed, and what looks alike."""

import numpy as np
import pytest

from armsight.data import PoseEstimate
from armsight.geometry.pose import exp_se3, inverse, pose
from armsight.geometry.rotation import exp_so3
from armsight.loop.health import HealthFinding, HealthMonitor
from armsight.loop.health.landmarks import LandmarkWatch
from armsight.sim.example_rig import example_rig
from armsight.sim.workcell.body import body_target

NOISE = np.diag(np.repeat([4e-5, 3e-4], 3) ** 2)
COV = NOISE + np.diag(np.repeat([2e-4, 5e-4], 3) ** 2)
AT_S = 4.0
CAMERAS = np.array([5e-4, 0.0, 2e-4, 0.0, np.radians(0.05), 0.0])


def watched(seed, count, *, cameras=None, bodies=None, seconds=8.0, hidden=None, coarse=None):
    """A watch of so many fixed bodies; cameras (6,) or some bodies {row: (6,)} move at AT_S.

    One may be hidden from a second before on, another be measured ten times worse.
    """
    rng = np.random.default_rng(seed)
    watch = LandmarkWatch([f"post {k}" for k in range(count)])
    Ts = [pose(exp_so3(0.4 * rng.normal(size=3)), np.array([0.3 * k - 0.3, 0.1, 1.0])) for k in range(count)]
    root = np.linalg.cholesky(NOISE)
    for t_s in np.arange(0.0, seconds, 0.1):
        for row, T in enumerate(Ts):
            if row == hidden and t_s > AT_S - 1.0:
                continue
            scale = 10.0 if row == coarse else 1.0
            if t_s >= AT_S:
                T = T if cameras is None else inverse(exp_se3(cameras)) @ T
                T = T if bodies is None or row not in bodies else T @ exp_se3(bodies[row])
            T = T @ exp_se3(scale * root @ rng.normal(size=6))
            noise = scale**2 * NOISE
            watch.take(row, PoseEstimate(T, COV - NOISE + noise, noise, 0.0, 0.0, 1.0, None), t_s)
    return watch


@pytest.mark.parametrize("count", [1, 2, 3])
def test_nothing_is_found_where_nothing_moves(count):
    for seed in range(5):
        assert watched(seed, count, seconds=10.0).findings() == ()


@pytest.mark.parametrize("count", [2, 3])
def test_cameras_that_moved_together_are_named_and_sized(count):
    watch = watched(10, count, cameras=CAMERAS)
    (found,) = watch.findings()
    assert found.cause == "fixed"
    assert "both cameras moved together" in found.what
    assert watch.cameras_moved
    assert abs(found.size - 1e3 * np.linalg.norm(CAMERAS[:3])) < 4 * found.sigma
    assert found.since_s == pytest.approx(AT_S, abs=1.0)
    assert found.alternatives == ()
    (found,) = watched(11, count, cameras=np.array([0.0, 0.0, 9e-4, 0.0, 0.0, 0.0])).findings()
    assert found.alternatives == ("lens",)


@pytest.mark.parametrize("count", [2, 3])
def test_a_body_that_is_not_fixed_is_named_as_another_stands(count):
    watch = watched(11, count, bodies={1: np.array([1e-3, 0, 0, 0, 0, 0])})
    (found,) = watch.findings()
    assert "post 1 is not fixed" in found.what
    assert not watch.cameras_moved
    assert abs(found.size - 1.0) < 4 * found.sigma


def test_a_body_that_moves_beside_cameras_that_move_is_named_by_two_that_agree():
    cameras, other = watched(12, 3, cameras=CAMERAS, bodies={2: np.array([0, 2e-3, 0, 0, 0, 0])}).findings()
    assert "as 2 fixed bodies show" in cameras.what
    assert "post 2 is not fixed" in other.what


@pytest.mark.parametrize("hidden", [0, 1])
def test_a_body_that_left_the_view_does_not_end_the_watch(hidden):
    (found,) = watched(15, 2, cameras=10.0 * CAMERAS, hidden=hidden, seconds=10.0).findings()
    assert f"the cameras moved, or the fixed body post {1 - hidden}" in found.what
    watch = watched(16, 3, cameras=10.0 * CAMERAS, hidden=hidden, seconds=10.0)
    assert watch.cameras_moved
    assert "as 2 fixed bodies show" in watch.findings()[0].what


def test_a_body_that_is_measured_coarsely_does_not_prove_that_the_cameras_stand():
    watch = watched(17, 2, cameras=CAMERAS, coarse=1)
    (found,) = watch.findings()
    assert "too coarsely" in found.what
    (found,) = watched(18, 2, bodies={0: np.array([5e-3, 0, 0, 0, 0, 0])}, coarse=1).findings()
    assert "post 0 is not fixed" in found.what


def test_what_looks_alike_is_not_decided():
    (alone,) = watched(13, 1, cameras=CAMERAS).findings()
    assert "with one alone the two look alike" in alone.what
    shifts = {0: np.array([1e-3, 0, 0, 0, 0, 0]), 1: np.array([0, 1e-3, 0, 0, 0, 0.01])}
    (both,) = watched(14, 2, bodies=shifts).findings()
    assert "cannot be distinguished" in both.what


def test_a_body_that_was_not_seen_is_named():
    assert watched(15, 2, seconds=0.3).never_seen == ("post 0", "post 1")


def found_with(monkeypatch, watch, cause, alternatives=()):
    """What a monitor finds, where an arm's estimator saw a change of a cause as well."""
    arm = HealthFinding(cause, "what the arm says", AT_S - 0.2, 2.0, 0.1, "mm", "", alternatives)
    monitor = HealthMonitor(example_rig(), body_target().body, 0.0)
    monitor._landmarks = watch
    monkeypatch.setattr(monitor, "_changed", lambda: (arm,))
    return monitor.findings()


@pytest.mark.parametrize(
    ("count", "cause", "alternatives"),
    [(1, "fixed", ()), (2, "fixed", ()), (1, "body", ("fixed",)), (2, "body", ("fixed",)), (2, "estimator", ())],
)
def test_cameras_that_arm_and_fixed_bodies_saw_move_are_one_finding(monkeypatch, count, cause, alternatives):
    (found,) = found_with(monkeypatch, watched(10, count, cameras=CAMERAS), cause, alternatives)
    assert (found.cause, found.alternatives, found.since_s) == ("fixed", (), AT_S - 0.2)
    assert ("the poses of the arm show" in found.what) == (count == 1)


def test_a_joint_that_slips_and_a_body_that_is_not_fixed_are_two_findings(monkeypatch):
    cameras, posts = watched(10, 2, cameras=CAMERAS), watched(11, 2, bodies={1: np.array([1e-3, 0, 0, 0, 0, 0])})
    assert [each.cause for each in found_with(monkeypatch, cameras, "joint")] == ["joint", "fixed"]
    assert len(found_with(monkeypatch, posts, "fixed")) == 2
    assert len(found_with(monkeypatch, watched(10, 1, cameras=CAMERAS), "estimator")) == 2
