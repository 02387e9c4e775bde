"""Cameras that moved against each other and bodies of another size: found, sized, and not found where nothing is wrong."""

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from faults import BODY, SIGMAS, SYNC_S, TRUE, ended, ripple, watched_body
from numpy.polynomial.chebyshev import chebval

from armsight.data import ExposureErrors
from armsight.geometry.pose import inverse, log_se3
from armsight.loop.health import HealthMonitor, Trust
from armsight.loop.health.rig import RigWatch
from armsight.vision.pose.posefit import PixelObservations, fit_pose, whitened


def test_nothing_is_found_where_nothing_is_wrong():
    assert [ended(seed, seconds=8.0) for seed in range(100, 104)] == 4 * [()]


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


def test_a_camera_that_exposes_late_is_named_as_time_and_poses_at_rest_stay_trusted():
    *_, (monitor, *_) = watched_body(1, skew_s=2e-3, seconds=8.0)
    (found,) = monitor.findings()
    assert (found.cause, found.unit) == ("time", "ms")
    assert abs(found.size - 2.0) < 4 * found.sigma
    assert found.sigma < 0.2  # the velocity is that of measured poses, to 10 %
    assert monitor.trust is Trust.FULL


def test_a_camera_that_moves_during_a_run_is_found_with_the_time():
    (found,) = ended(4, rotated=np.radians([0.0, 0.1, 0.0]), at_s=5.0)
    assert found.cause == "rig"
    assert found.since_s == pytest.approx(5.0, abs=1.5)


@pytest.mark.parametrize("side", [0, 1])  # poses refer to the left one
def test_the_covariance_grows_until_it_covers_the_error(side):
    errors = {False: [], True: []}
    rotates = side, np.radians([0.0, 0.05, 0.0]), lambda _: 1.0
    for _, t, T, estimate, given in watched_body(5, nod=rotates, seconds=6.0):
        off = log_se3(inverse(estimate.T_left_body) @ T)
        errors[t > 2.0].append([off @ np.linalg.solve(each.cov, off) for each in (estimate, given)])
    assert np.mean(errors[True], axis=0)[0] > 40.0
    assert np.mean(errors[True], axis=0)[1] < 12.0


def test_to_ask_often_changes_nothing():
    *_, (silent, *_) = watched_body(8, rotated=np.radians([0.02, 0.0, 0.0]), seconds=2.9)
    for k, (asked, *_) in enumerate(watched_body(8, rotated=np.radians([0.02, 0.0, 0.0]), seconds=2.9)):
        if k % 20 == 0:
            asked.findings()
    kept = [each._rig._fits[0].kept for each in (silent, asked)]
    np.testing.assert_array_equal(*([each.M for each in tests] for tests in kept))
    assert asked.findings() == silent.findings() == asked.findings()


def test_a_lens_that_the_model_cannot_express_is_named_and_neither_rig_nor_time():
    *_, (monitor, _, _, estimate, given) = watched_body(11, lens=ripple(0.4, np.array([1.7, 0.8]), 1.1), seconds=6.0)
    (found,) = monitor.findings()
    assert (found.cause, found.unit, found.since_s) == ("lens", "px", None)
    assert 0.03 < found.size < 0.3  # what a calibration with this model leaves of it
    assert found.sigma < 0.1 * found.size
    assert "richer lens model" in found.advice
    assert np.trace(given.cov) > np.trace(estimate.cov)
    assert monitor._rig.moved_since_s() is None


def test_the_test_in_which_a_camera_moves_is_left_out_of_its_size():
    """It has shots from before and after, and a jump that looks like speed."""
    (found,) = ended(9340, rotated=np.radians([0.1, 0.0, 0.0]), at_s=3.6, seconds=8.0)
    assert (found.cause, found.unit) == ("rig", "deg")
    assert abs(found.size - 0.1) < 4 * found.sigma < 0.04


def test_a_rig_without_covariance_is_not_tested():
    *_, estimate, _ = next(watched_body(6))
    monitor = HealthMonitor(replace(TRUE, cov=np.zeros_like(TRUE.cov)), BODY, SYNC_S)
    assert monitor.measured(estimate, 0.0) is estimate
    assert monitor.findings() == ()


def test_images_that_do_not_belong_together_in_one_shot_are_no_moved_camera():
    """A body that moved between the two exposures of one pair of images looks like moved cameras in that pair alone."""
    rig = replace(TRUE, cov=np.diag(SIGMAS**2), sigma_px=0.0)
    good, moved = (
        [estimate for *_, estimate, _ in watched_body(7, rotated=rotated, seconds=4.0)][::10]
        for rotated in (None, np.radians([0.3, 0.0, 0.0]))
    )

    def findings(estimates, period_s):
        watch = RigWatch(rig, BODY, SYNC_S)
        for k, estimate in enumerate(estimates):
            watch.take(estimate, None if period_s is None else k * period_s)
        return [(found.cause, found.alternatives) for found in watch.findings()]

    for period_s in (None, 1 / 3, 2.0):
        one_of_several = [*good[:4], moved[4], *good[5:]]
        assert findings(one_of_several, period_s) == findings(good[:4] + moved[4:5], period_s) == []
        assert findings(moved, period_s) == [("rig", ())]
        if period_s is not None:  # else they are of one test
            assert findings(good[:4] + moved[4:], period_s) == [("rig", ())]
        # One pose alone leaves both open.
        assert findings(moved[:1], period_s) == [("rig", ("time",))]


def test_the_estimate_is_what_dense_least_squares_gives():
    """The sums with everything eliminated, against one dense fit of all parameters with their priors."""
    rows = [
        (t, estimate) for _, t, _, estimate, _ in watched_body(7, rotated=np.radians([0.02, 0.05, 0.0]), seconds=0.9)
    ][::10]
    rig = replace(TRUE, cov=np.diag(SIGMAS**2), sigma_px=0.0)
    watch = RigWatch(rig, BODY, 0.0)
    for t, estimate in rows:
        watch.take(estimate, t)
    sums, size = watch._summed(watch._stays).of(watch._size), watch._size
    found, L, F = watch._estimated(sums.by(watch._scaled[:, : size + 7]).reduced(size)), watch.prior, watch._by_fault
    wide = np.diag(np.array([0.1, 0.1, 1, 1, 1, 1, 0.1]) ** 2.0)
    L = L + 1e-9 * np.eye(size)  # the skew's prior is none
    prior = np.linalg.inv(np.block([[L @ L.T, np.zeros((size, 7))], [np.zeros((7, size)), wide]]))
    G = np.hstack([np.eye(size), F])
    both = np.linalg.solve(G.T @ sums.H @ G + prior, G.T @ sums.b)
    assert found.f == pytest.approx(both[size:], rel=1e-3, abs=1e-6)


@pytest.mark.parametrize("moved", [False, True])
def test_the_rows_of_a_shot_are_those_of_a_dense_elimination(moved):
    """Pose free, unknown times in the covariance of the noise; polynomials by numpy.

    What is unknown is the skew, or errors of each exposure where detections were moved to one time.
    """
    rig = replace(TRUE, cov=np.diag(SIGMAS**2), sigma_px=0.02)
    (_, t, _, before, _), (_, now_s, _, estimate, _) = list(islice(watched_body(9), 0, 6, 5))
    own = 1e-4 * np.random.default_rng(9).normal(size=(len(BODY.points), 2, 6, 7))
    if moved:
        estimate = replace(estimate, exposures=ExposureErrors(own, np.zeros((2, 2))))
    watch = RigWatch(rig, replace(BODY, points=np.asfortranarray(BODY.points)), sync_s := 2e-3)
    watch.take(before, t)
    watch.reader.track.append((now_s, estimate.T_left_body))
    found, velocity = watch.reader.read(estimate, now_s), watch.reader.velocity()
    seen, points = PixelObservations.of(estimate.points.seen, rig.sigma_px), BODY.points
    fit = fit_pose(rig.cameras, rig.T_left_right, points, seen, estimate.T_left_body, robust=False, steps=0)
    W, A, B = whitened(rig.cameras, rig.T_left_right, points, seen, estimate.T_left_body)
    dense, P = np.zeros((len(A), found.rows.shape[1])), rig.parameter_count
    dense[:, 0] = (W @ fit.residuals_px[:, :, None]).ravel()
    dense[:, 1 : 1 + P] = B
    dense[:, 1 + P] = np.einsum("nij,nj->ni", A[:, :3].reshape(-1, 2, 3), points[seen.point]).ravel()
    dense[:, watch._size] = A @ velocity * np.repeat(seen.camera, 2)
    heights = np.array([camera.image_size_px[1] for camera in rig.cameras])[seen.camera]
    dense[:, watch._size - 1] = A @ velocity * np.repeat((seen.uv[:, 1] + 0.5) / heights - 0.5, 2)
    for k, (side, point) in enumerate(zip(seen.camera, seen.point, strict=True)):
        dense[2 * k : 2 * k + 2, 2 + P + 3 * point :][:, :3] = A[2 * k : 2 * k + 2, :3]
        x, y = 2.0 * (seen.uv[k] + 0.5) / rig.cameras[side].image_size_px - 1.0
        each = [chebval(x, np.eye(5)[i]) * chebval(y, np.eye(5)[j]) for i in range(5) for j in range(5 - i)]
        for axis in range(2):
            dense[2 * k : 2 * k + 2, watch._size + 1 + 15 * (2 * side + axis) :][:, :15] = np.outer(W[k, :, axis], each)
    errors = sync_s * dense[:, watch._size, None]
    if moved:
        errors = np.concatenate([A[2 * k : 2 * k + 2] @ own[k // 2, k % 2] for k in range(len(A) // 2)])
    V = np.linalg.inv(np.eye(len(A)) + errors @ errors.T)
    expected = dense.T @ (V - V @ A @ np.linalg.solve(A.T @ V @ A, A.T @ V)) @ dense
    scale = np.sqrt(np.outer(*2 * [np.diag(dense.T @ dense) + 1e-12]))
    assert found.rows.T @ found.rows / scale == pytest.approx(expected / scale, abs=1e-9)
    assert found.response == pytest.approx(-np.linalg.solve(A.T @ A, A.T @ dense[:, 1:]), rel=1e-6, abs=1e-12)


@pytest.mark.parametrize("scale", [1.05, 1.2, 1.0 / 1.2])
def test_a_body_file_that_is_far_off_is_a_body_of_another_size_alone(scale):
    (found,) = ended(5520, scale=scale)
    assert (found.cause, found.alternatives, found.unit) == ("body", (), "%")
    assert abs(found.size - 100.0 * (1.0 / scale - 1.0)) < 3 * found.sigma < 0.3


@pytest.mark.parametrize("fault", [{"rotated": np.radians([0.0, 0.05, 0.0])}, {"scale": 1.01}, {"skew_s": 1.0 / 30.0}])
def test_a_finding_says_what_it_costs_and_how_well_poses_are_known_without_it(fault):
    off, claimed = [], []
    for monitor, _, T, measured, _ in watched_body(7322, **fault):  # noqa: B007
        e = log_se3(inverse(measured.T_left_body) @ T)
        off.append(1e3 * np.linalg.norm(e[:3]) + 100.0 * np.linalg.norm(e[3:]))
        claimed.append(1e3 * np.sqrt(np.trace(measured.cov[:3, :3])))
    (found,) = monitor.findings()
    assert max(off) / 2.0 < found.cost_mm < 2.0 * max(off)  # of another time in each shot it is a sigma
    assert found.pose_sigma_mm == pytest.approx(np.median(claimed), rel=0.2)
    assert found.forbids
    assert f"by up to {found.cost_mm:.2f} mm (sigma {found.pose_sigma_mm:.2f} mm)" in found.line()
