"""Cameras that moved against each other and bodies of another size: found, sized, and not found where nothing is wrong."""

from dataclasses import replace

import numpy as np
import pytest

from armsight.data import Body, Correspondences, Points, PoseEstimate
from armsight.geometry.pose import exp_se3, inverse, log_se3, pose
from armsight.geometry.rotation import exp_so3
from armsight.loop.health import HealthMonitor
from armsight.loop.health.rig import RigWatch
from armsight.sim.example_rig import example_rig
from armsight.sim.workcell.body import body_target
from armsight.vision.posefit import PixelObservations, fit_pose, whitened
from armsight.vision.triangulate import triangulate
from views import both_pixels

RATE_HZ, SIGMA_PX, SYNC_S = 30.0, 0.03, 6e-5
TRUE = example_rig(convergence_deg=1.0)
#: As of a calibration with 30 pairs: focal lengths and centre, distortion; translation m, rotation rad.
SIGMAS = np.concatenate([*2 * [[0.05] * 4 + [5e-4, 1e-3, 2e-5, 2e-5, 1e-3]], 3 * [1e-5], 3 * [2e-5]])
BODY = body_target().body


def measured(rig, body, T_start, uv):
    """The pose of a body from pixels (N, 2, 2), as vision makes it."""
    seen = Correspondences(np.arange(len(uv)), uv, np.tile(SIGMA_PX**2 * np.eye(2), (len(uv), 2, 1, 1)))
    observations = PixelObservations.of(seen, rig.sigma_px)
    fit = fit_pose(rig.cameras, rig.T_left_right, body.points, observations, T_start, robust=False)
    _, A, B = whitened(rig.cameras, rig.T_left_right, body.points, observations, fit.T_left_body)
    noise = np.linalg.inv(fit.information)
    gain = noise @ A.T @ B
    points = triangulate(rig, body, seen)
    points = Points(points.ids, points.p_left, points.cov, points.calibration, seen)
    return PoseEstimate(fit.T_left_body, noise + gain @ rig.cov @ gain.T, noise, 0.0, 0.0, 1.0, points)


def run(seed, *, rotated=None, scale=1.0, at_s=0.0, seconds=12.0):
    """Watch a body that moves and rests; yield the monitor, the time, the true pose, and what it returned for each shot."""
    rng = np.random.default_rng(seed)
    cov = np.diag(SIGMAS**2)
    given = replace(TRUE.perturbed(SIGMAS * rng.normal(size=len(SIGMAS))), cov=cov, sigma_px=0.0)
    moved = (
        TRUE
        if rotated is None
        else replace(TRUE, T_left_right=TRUE.T_left_right @ exp_se3(np.append(np.zeros(3), rotated)))
    )
    body = Body(BODY.name, BODY.point_names, scale * BODY.points)
    points = BODY.points + 2e-5 * rng.normal(size=BODY.points.shape)
    monitor = HealthMonitor(given, body, SYNC_S)
    rates, phases = rng.uniform(0.05, 0.2, 6), rng.uniform(0, 2 * np.pi, 6)
    for k in range(round(seconds * RATE_HZ)):
        t = k / RATE_HZ
        u = np.sin(2 * np.pi * rates * min(t, 0.6 * seconds) + phases)  # it rests at the end
        T = pose(exp_so3(0.3 * u[3:]), np.array([0.1, 0.0, 0.9]) + np.array([0.12, 0.08, 0.12]) * u[:3])
        true = moved if t >= at_s else TRUE
        uv = both_pixels(true, points @ T[:3, :3].T + T[:3, 3])
        estimate = measured(given, body, T, uv + SIGMA_PX * rng.normal(size=uv.shape))
        yield monitor, t, T, estimate, monitor.measured(estimate, t)


def ended(seed, **fault):
    """The findings at the end of a run."""
    *_, (monitor, *_) = run(seed, **fault)
    return monitor.findings()


def test_nothing_is_found_where_nothing_is_wrong():
    assert [ended(seed, seconds=8.0) for seed in range(100, 110)] == 10 * [()]


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_rotated_camera_is_found_and_sized(axis):
    (found,) = ended(axis, rotated=np.radians(0.05) * np.eye(3)[axis])
    assert (found.cause, found.unit) == ("rig", "deg")
    assert abs(found.size - 0.05) < 4 * found.sigma
    assert found.sigma < 0.015
    assert found.since_s < 2.5


@pytest.mark.parametrize("scale", [0.99, 1.01])
def test_a_body_file_of_another_size_is_found_and_the_baseline_named_with_it(scale):
    (found,) = ended(3, scale=scale)
    assert (found.cause, found.unit) == ("body", "%")
    assert abs(found.size - 100 * (1 / scale - 1)) < 4 * found.sigma
    assert "cannot be distinguished" in found.what


def test_a_camera_that_moves_during_a_run_is_found_with_the_time():
    (found,) = ended(4, rotated=np.radians([0.0, 0.1, 0.0]), at_s=5.0)
    assert found.cause == "rig"
    assert found.since_s == pytest.approx(5.0, abs=1.5)


def test_the_covariance_grows_until_it_covers_the_error():
    errors = {False: [], True: []}
    for _, t, T, estimate, given in run(5, rotated=np.radians([0.0, 0.05, 0.0]), seconds=6.0):
        off = log_se3(inverse(estimate.T_left_body) @ T)
        errors[t > 2.0].append([off @ np.linalg.solve(each.cov, off) for each in (estimate, given)])
    assert np.mean(errors[True], axis=0)[0] > 40.0
    assert np.mean(errors[True], axis=0)[1] < 12.0


def test_a_rig_without_covariance_is_not_tested():
    *_, estimate, _ = next(run(6))
    monitor = HealthMonitor(replace(TRUE, cov=np.zeros_like(TRUE.cov)), BODY, SYNC_S)
    assert monitor.measured(estimate, 0.0) is estimate
    assert monitor.findings() == ()


def test_the_estimate_is_what_dense_least_squares_gives():
    """The sums with everything eliminated, against one dense fit of all parameters with their priors."""
    rows = [(t, estimate) for _, t, _, estimate, _ in run(7, rotated=np.radians([0.02, 0.05, 0.0]), seconds=0.9)][::10]
    rig = replace(TRUE, cov=np.diag(SIGMAS**2), sigma_px=0.0)
    watch = RigWatch(rig, BODY, 0.0)
    for t, estimate in rows:
        watch.take(estimate, t)
    watch._close_stay()
    found, size = watch._estimated(watch._test), watch._size
    sums, L, F = watch._test, watch._prior, watch._by_fault
    wide = np.diag(np.array([0.1, 0.1, 1, 1, 1, 1]) ** 2.0)
    prior = np.linalg.inv(np.block([[L @ L.T, np.zeros((size, 6))], [np.zeros((6, size)), wide]]))
    G = np.hstack([np.eye(size), F])
    both = np.linalg.solve(G.T @ sums.H @ G + prior, G.T @ sums.b)
    assert found.f == pytest.approx(both[size:], rel=1e-3, abs=1e-6)
