"""Bundle adjustment: OpenCV, finite differences, scipy's solver, the dense Jacobian and Monte Carlo are the oracles."""

import functools
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.optimize import least_squares

from armsight.errors import CalibrationError
from armsight.geometry.pose import exp_se3, log_se3
from armsight.vision.pose import bundle
from armsight.vision.pose.bundle import (
    CAUCHY_SCALE,
    BundleModel,
    BundleState,
    Observations,
    minimise,
    moved,
    predict,
    whiteners,
)
from armsight.vision.pose.projection import smooth
from asserts import assert_jacobian
from strategies import CAMERAS, ordinary_rig
from views import board, seen, somewhere

SIGMA_PX = 0.2


def problem(model="brown4", *, degree=0, shots=6, free_cameras=True, sigma=SIGMA_PX, seed=0):
    """A rig that sees a board, bent along its shape modes, in several shots: model, truth and noisy observations."""
    rng, rig, points = np.random.default_rng(seed), ordinary_rig(model), board()
    modes = smooth(points, degree) if degree else np.zeros((0, len(points), 3))
    shape = 1e-3 * rng.normal(size=len(modes))
    problem = BundleModel(points, modes, 1e-3, free_cameras)
    truth = BundleState(rig.cameras, rig.T_left_right, np.array([somewhere(rng) for _ in range(shots)]), shape)
    bent = points + np.einsum("k,kmi->mi", shape, modes)
    return (
        problem,
        truth,
        Observations.from_shots([seen(rig, bent, T, sigma=sigma, rng=rng) for T in truth.Ts_left_body]),
    )


def size(model, state):
    """Q, the number of shared parameters."""
    return sum(4 + camera.distortion.size for camera in state.cameras) + 6 + len(model.modes)


def apart(state, other):
    """Return what has to be added to ``state``'s shared parameters to get ``other``'s."""
    cameras = [b.parameters - a.parameters for a, b in zip(state.cameras, other.cameras, strict=True)]
    relative = log_se3(np.linalg.inv(state.T_left_right) @ other.T_left_right)
    return np.concatenate([*cameras, relative, other.shape - state.shape])


def scales(model, state):
    """Steps (Q,) that change pixels by about one: a scale for solvers and finite differences."""
    lenses = [np.concatenate([np.ones(4), np.full(camera.distortion.size, 1e-2)]) for camera in state.cameras]
    return np.concatenate([*lenses, np.full(6 + len(model.modes), 1e-3)])


def whitened(model, state, observations, x):
    """Whitened residuals (N, 2) of a state moved by x: shared parameters first, then the shots' tangents."""
    q = size(model, state)
    there = moved(state, x[:q], x[q:].reshape(-1, 6))
    r = observations.uv - predict(model, there, observations)[0]
    return np.linalg.solve(np.linalg.cholesky(observations.cov_uv + SIGMA_PX**2 * np.eye(2)), r[..., None])[..., 0]


def dense_jacobian(model, state, observations):
    """(2N, Q + 6S), of bodies in motion (2N, Q + 12S), Jacobian of the whitened predictions, no structure exploited."""
    W = whiteners(observations, SIGMA_PX)
    _, J_shared, J_pose = predict(model, state, observations)
    by_pose = np.zeros((*J_pose.shape[:2], observations.shot_count, J_pose.shape[2]))
    by_pose[np.arange(len(J_pose)), :, observations.shot] = W @ J_pose
    n = 2 * len(J_pose)
    return np.concatenate([(W @ J_shared).reshape(n, -1), by_pose.reshape(n, -1)], axis=1)


@pytest.mark.parametrize("name", CAMERAS)
def test_predictions_are_opencvs(name):
    model, truth, observations = problem(name, degree=2, sigma=0.0)
    # Two chains of a dozen operations on pixels of about 1e3: 1e3 * 2.2e-16 * 50.
    np.testing.assert_allclose(predict(model, truth, observations)[0], observations.uv, rtol=0, atol=1e-11)


def moving(model, truth, seed=3, sigma=(2e-3, 2e-3, 2e-3, 0.02, 0.02, 0.02)):
    """Let the body move between the exposures of every shot, far enough to show errors of a derivative."""
    motions = np.random.default_rng(seed).normal(size=(len(truth.Ts_left_body), 6)) * sigma
    return replace(model, motion_sigmas=np.tile(sigma, (len(motions), 1))), replace(truth, motions=motions)


def test_a_motion_is_a_rotation_about_the_bodys_middle_and_a_way_in_the_right_image_alone():
    model, truth, observations = problem("brown4", degree=2, shots=3)
    model, moved_on = moving(model, truth)
    uv, there = (predict(model, state, observations)[0] for state in (truth, moved_on))
    left = observations.camera == 0
    np.testing.assert_array_equal(uv[left], there[left])
    body, middle = model.body(truth.shape), model.points.mean(axis=0)
    for j, motion in enumerate(moved_on.motions):
        R = cv2.Rodrigues(np.array(motion[3:]))[0]
        body_then = (body - middle) @ R.T + middle + motion[:3]
        rows = ~left & (observations.shot == j)
        one = replace(model, points=body_then - np.tensordot(truth.shape, model.modes, axes=1))
        np.testing.assert_allclose(there[rows], predict(one, truth, observations)[0][rows], rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", CAMERAS)
@pytest.mark.parametrize("own", [6, 12], ids=["at rest", "moving between the exposures"])
def test_jacobians_by_all_that_is_shared_and_by_the_shots(name, own):
    model, truth, observations = problem(name, degree=2, shots=2)
    model, truth = moving(model, truth) if own == 12 else (model, truth)
    _, J_shared, J_shot = predict(model, truth, observations)
    q = J_shared.shape[2]
    assert q == size(model, truth)
    by_all = np.zeros((len(J_shot), 2, 2, own))  # a detection depends on its own shot alone
    by_all[np.arange(len(J_shot)), :, observations.shot] = J_shot
    assert_jacobian(
        np.concatenate([J_shared, by_all.reshape(len(J_shot), 2, 2 * own)], axis=2),
        lambda x: predict(model, moved(truth, x[:q], x[q:].reshape(2, own)), observations)[0],
        np.zeros(q + 2 * own),
        np.concatenate([0.1 * scales(model, truth), np.full(2 * own, 1e-4)]),
    )


def test_whiteners_are_roots_of_the_inverse_covariance():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(5, 2, 2))
    observations = replace(problem()[2], cov_uv=root @ root.transpose(0, 2, 1))
    W = whiteners(observations, 0.3)
    for w, cov in zip(W, observations.cov_uv, strict=True):
        np.testing.assert_allclose(w.T @ w @ (cov + 0.09 * np.eye(2)), np.eye(2), atol=1e-12)


def test_choosing_rows_and_shots():
    _, _, observations = problem(shots=4)
    keep = np.random.default_rng(0).uniform(size=len(observations.shot)) < 0.5
    some = observations.select(keep)
    assert some.shot_count == 4
    np.testing.assert_array_equal(some.uv, [uv for uv, k in zip(observations.uv, keep, strict=True) if k])
    two = observations.shots([3, 1])
    assert two.shot_count == 2
    for new, old in ((0, 1), (1, 3)):
        for field in ("camera", "point", "uv", "cov_uv"):
            np.testing.assert_array_equal(
                getattr(two, field)[two.shot == new], getattr(observations, field)[observations.shot == old]
            )


def test_flattening_leaves_out_what_is_not_seen():
    rig, points, rng = ordinary_rig(), board(2, 2), np.random.default_rng(0)
    shots = [seen(rig, points, somewhere(rng), hidden=h) for h in ([(0, 0), (2, 1)], [(1, 0), (1, 1)])]
    rows = Observations.from_shots(shots)
    expected = [(j, c, i) for j, shot in enumerate(shots) for i in range(4) for c in range(2) if shot.seen[i, c]]
    assert [*zip(rows.shot, rows.camera, rows.point, strict=True)] == expected
    np.testing.assert_array_equal(rows.uv, [shots[j].uv[i, c] for j, c, i in expected])


def started(model, truth, seed=1):
    """A start some ten pixels off."""
    rng = np.random.default_rng(seed)
    q = size(model, truth)
    return moved(
        truth, 3 * scales(model, truth) * rng.normal(size=q), 1e-2 * rng.normal(size=(len(truth.Ts_left_body), 6))
    )


def reference(model, state, observations, fun, **options):
    """Minimise with scipy, all parameters in one dense problem, next to ``state``: cost and where it ends."""
    n = 6 * len(state.Ts_left_body)
    x_scale = np.concatenate([scales(model, state), np.full(n, 1e-3)])
    found = least_squares(fun, np.zeros(len(x_scale)), x_scale=x_scale, xtol=1e-15, ftol=1e-15, gtol=1e-12, **options)
    return 2 * found.cost, found.x


@pytest.mark.parametrize(("name", "degree"), [("none", 0), ("brown4", 0), ("brown4", 2), ("fisheye", 0)])
def test_plain_minimum_is_scipys(name, degree):
    model, truth, observations = problem(name, degree=degree, shots=4)
    q, k = size(model, truth), len(model.modes)
    solution = minimise(model, started(model, truth), observations, SIGMA_PX, robust=False)

    def fun(x):
        prior = (solution.state.shape + x[q - k : q]) / model.shape_sigma_m
        return np.concatenate([whitened(model, solution.state, observations, x).ravel(), prior])

    cost, x = reference(model, solution.state, observations, fun)
    assert solution.cost == pytest.approx(cost, rel=1e-6)
    # Iteration ends when the cost falls by less than 1e-7 of itself: a step of sqrt(1e-7 * cost) standard deviations
    # was the last, and the next would be far shorter.
    assert (np.abs(x[:q]) <= np.sqrt(1e-7 * cost) * np.sqrt(np.diag(solution.cov_shared))).all()
    np.testing.assert_array_equal(
        solution.residuals_px, observations.uv - predict(model, solution.state, observations)[0]
    )


def test_robust_minimum_is_scipys_cauchy_of_each_detections_distance():
    model, truth, observations = problem("none", shots=4)
    spoilt = observations.uv + np.zeros_like(observations.uv)
    spoilt[::37] += 8.0
    observations = replace(observations, uv=spoilt)
    solution = minimise(model, started(model, truth), observations, SIGMA_PX)
    q = size(model, truth)

    def fun(x):
        return np.linalg.norm(whitened(model, solution.state, observations, x), axis=1)

    # scipy's cost is f_scale^2 / 2 sum log(1 + (f / f_scale)^2): ours, halved.
    cost, x = reference(model, solution.state, observations, fun, loss="cauchy", f_scale=CAUCHY_SCALE)
    assert solution.cost == pytest.approx(cost, rel=1e-6)
    assert solution.cost == pytest.approx(
        CAUCHY_SCALE**2 * np.log1p(fun(0 * x) ** 2 / CAUCHY_SCALE**2).sum(), rel=1e-12
    )
    assert (np.abs(x[:q]) <= np.sqrt(1e-7 * cost) * np.sqrt(np.diag(solution.cov_shared))).all()


def test_gross_errors_move_a_robust_fit_by_less_than_its_sigma():
    model, truth, observations = problem("brown4", shots=8)
    bad = np.random.default_rng(2).uniform(size=len(observations.uv)) < 0.03
    uv = np.where(bad[:, None], observations.uv + 20.0, observations.uv)
    clean = minimise(model, truth, observations, SIGMA_PX).state
    sigma = np.sqrt(np.diag(minimise(model, truth, observations, SIGMA_PX).cov_shared))
    robust = minimise(model, truth, replace(observations, uv=uv), SIGMA_PX)
    plain = minimise(model, truth, replace(observations, uv=uv), SIGMA_PX, robust=False)
    assert (np.abs(apart(clean, robust.state)) < sigma).all()
    assert np.abs(apart(clean, plain.state) / sigma).max() > 10


def test_minimum_and_covariance_with_motions_are_those_of_the_dense_problem():
    model, truth, _ = problem("brown4", shots=5)
    model, truth = moving(model, truth, sigma=(5e-4, 5e-4, 5e-4, 3e-3, 3e-3, 3e-3))
    _, _, observations = problem("brown4", shots=5)
    rng = np.random.default_rng(7)
    uv = predict(model, truth, observations)[0]
    observations = replace(observations, uv=uv + SIGMA_PX * rng.normal(size=uv.shape))
    start = replace(truth, motions=np.zeros((0, 6)))
    solution = minimise(model, start, observations, SIGMA_PX, robust=False)
    assert solution.converged
    state, q = solution.state, size(model, truth)
    W, J = whiteners(observations, SIGMA_PX), dense_jacobian(model, state, observations)
    own = q + (12 * np.arange(5)[:, None] + np.arange(6, 12)).ravel()
    prior = np.zeros((30, J.shape[1]))
    prior[np.arange(30), own] = 1 / model.motion_sigmas.ravel()
    J = np.concatenate([J, prior])
    r = (W @ (observations.uv - predict(model, state, observations)[0])[..., None]).ravel()
    r = np.concatenate([r, -(state.motions / model.motion_sigmas).ravel()])
    assert solution.cost == pytest.approx(r @ r, rel=1e-12)
    scale = np.linalg.norm(J, axis=0)
    C = np.linalg.inv((J / scale).T @ (J / scale)) / np.outer(scale, scale)
    sigma = np.sqrt(np.diag(C))
    # At a minimum one more Gauss-Newton step gains no more than the last one did: 1e-7 of the cost.
    assert (np.abs(C @ J.T @ r) <= np.sqrt(1e-7 * solution.cost) * sigma).all()
    np.testing.assert_allclose(
        solution.cov_shared / np.outer(sigma[:q], sigma[:q]), C[:q, :q] / np.outer(sigma[:q], sigma[:q]), atol=1e-6
    )
    for j in range(5):
        rows = own[6 * j : 6 * j + 6]
        s = np.outer(sigma[rows], sigma[rows])
        np.testing.assert_allclose(solution.cov_motions[j] / s, C[np.ix_(rows, rows)] / s, atol=1e-6)
    off = (state.motions - truth.motions) / np.sqrt(np.diagonal(solution.cov_motions, axis1=1, axis2=2))
    assert np.abs(off).max() < 4


def test_an_adjustment_that_runs_out_of_steps_says_so():
    model, truth, observations = problem("brown4")
    assert not minimise(model, started(model, truth), observations, SIGMA_PX, max_steps=2).converged
    assert minimise(model, started(model, truth), observations, SIGMA_PX).converged


def test_covariance_is_that_of_the_dense_jacobian():
    for name, degree in (("none", 0), ("brown5", 0), ("fisheye", 0), ("brown4", 2)):
        model, truth, observations = problem(name, degree=degree)
        solution = minimise(model, truth, observations, SIGMA_PX, robust=False)
        J, q, k = dense_jacobian(model, solution.state, observations), size(model, truth), len(model.modes)
        prior = np.zeros((k, J.shape[1]))
        prior[:, q - k : q] = np.eye(k) / model.shape_sigma_m
        J = np.concatenate([J, prior])
        scale = np.linalg.norm(J, axis=0)
        C = (np.linalg.inv((J / scale).T @ (J / scale)) / np.outer(scale, scale))[:q, :q]
        # The inverse loses the square of J's condition: 2.2e-16 times that.
        tolerance = 10 * 2.2e-16 * np.linalg.cond(J / scale) ** 2
        sigma = np.sqrt(np.diag(C))
        np.testing.assert_allclose(
            solution.cov_shared / np.outer(sigma, sigma), C / np.outer(sigma, sigma), atol=tolerance
        )
        assert tolerance < 1e-6


@pytest.mark.parametrize("robust", [False, True])
def test_where_the_images_show_nothing_the_prior_is_the_covariance(robust):
    model, truth, observations = problem("brown4", degree=2, free_cameras=False)
    solution = minimise(model, truth, observations, 1e7, robust=robust)
    k = len(model.modes)
    np.testing.assert_allclose(solution.cov_shared[-k:, -k:], model.shape_sigma_m**2 * np.eye(k), atol=1e-6 * 1e-6)


@functools.cache
def draws(robust, count=250):
    """Errors (count, Q) of fits to fresh noise, and the covariance each of them claims."""
    model, truth, clean = problem("none", sigma=0.0)
    rng = np.random.default_rng(5)
    errors, claims = [], []
    for _ in range(count):
        noisy = replace(clean, uv=clean.uv + SIGMA_PX * rng.normal(size=clean.uv.shape))
        solution = minimise(model, truth, noisy, SIGMA_PX, robust=robust)
        errors.append(apart(truth, solution.state))
        claims.append(solution.cov_shared)
    return np.array(errors), np.array(claims)


@pytest.mark.parametrize("robust", [False, True])
def test_covariance_is_that_of_monte_carlo(robust):
    errors, claims = draws(robust)
    n, q = errors.shape
    nees = np.einsum("ni,ni->n", errors, np.linalg.solve(claims, errors[..., None])[..., 0])
    # A chi-square of q degrees: mean q, variance 2 q; four standard errors of the mean of n.
    assert abs(nees.mean() - q) < 4 * np.sqrt(2 * q / n)
    # A sample variance scatters by sqrt(2 / n) of itself; fourteen parameters at once, so four standard errors again.
    ratio = np.diagonal(claims, axis1=1, axis2=2).mean(axis=0) / (errors**2).mean(axis=0)
    assert (np.abs(ratio - 1) < 4 * np.sqrt(2 / n)).all()


def test_what_is_held_stays_and_has_no_variance():
    model, truth, observations = problem("brown4", free_cameras=False)
    start = moved(truth, np.r_[np.zeros(16), 1e-3 * np.ones(6)], np.zeros((6, 6)))
    solution = minimise(model, start, observations, SIGMA_PX)
    np.testing.assert_array_equal(apart(truth, solution.state)[:16], 0)
    assert not solution.cov_shared[:16].any()
    assert not solution.cov_shared[:, :16].any()
    assert (np.diag(solution.cov_shared)[16:] > 0).all()
    free = np.zeros(22, bool)
    free[[0, 1, 17]] = True
    chosen = minimise(model, start, observations, SIGMA_PX, free=free)
    moved_by = apart(start, chosen.state)
    assert (moved_by[free] != 0).all()
    np.testing.assert_array_equal(moved_by[~free][:14], 0)  # the relative pose's are zero to rounding of log and exp
    np.testing.assert_allclose(moved_by[~free][14:], 0, atol=1e-15)
    poses_only = minimise(model, truth, observations, SIGMA_PX, free=np.zeros(22, bool))
    assert poses_only.cost < minimise(model, truth, observations, SIGMA_PX, max_steps=0).cost


def test_a_curved_valley_is_followed_to_its_end():
    model, truth, observations = problem("brown8")
    near = minimise(model, truth, observations, SIGMA_PX, robust=False)
    lenses = 10 * scales(model, truth)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        far = moved(truth, 0.1 * lenses * rng.normal(size=len(lenses)), 1e-2 * rng.normal(size=(6, 6)))
        solution = minimise(model, far, observations, SIGMA_PX, robust=False)
        assert solution.cost == pytest.approx(near.cost, rel=1e-5)


def test_a_step_to_a_focal_length_below_zero_is_rejected(monkeypatch):
    model, truth, observations = problem("none", shots=3)
    real, rejected = bundle._trial, []

    def trial(state, shared, poses):
        result = real(state, shared, poses)
        rejected.append(result is None)
        assert result is None or all((camera.intrinsics[:2] > 0).all() for camera in result.cameras)
        return result

    monkeypatch.setattr(bundle, "_trial", trial)
    # Three times the focal length from four times the distance: one of the linear steps goes through zero.
    wrong = tuple(camera.with_parameters(camera.parameters * [3, 3, 1, 1]) for camera in truth.cameras)
    T = truth.Ts_left_body.copy()
    T[:, :3, 3] *= 4
    solution = minimise(model, replace(truth, cameras=wrong, Ts_left_body=T), observations, SIGMA_PX, robust=False)
    assert any(rejected)
    near = minimise(model, truth, observations, SIGMA_PX, robust=False)
    assert solution.cost == pytest.approx(near.cost, rel=1e-6)


def test_a_start_behind_a_camera_is_rejected():
    model, truth, observations = problem("brown4")
    T = truth.Ts_left_body.copy()
    T[2, 2, 3] = -0.6
    with pytest.raises(CalibrationError, match="behind its camera"):
        minimise(model, replace(truth, Ts_left_body=T), observations, SIGMA_PX)


def test_a_shot_without_detections_is_reported():
    model, truth, observations = problem("brown4")
    with pytest.raises(CalibrationError, match="shot 2 of 6 in the adjustment has no detections"):
        minimise(model, truth, observations.select(observations.shot != 2), SIGMA_PX)


def test_the_order_of_the_shots_does_not_matter():
    model, truth, observations = problem("brown4", degree=2)
    order = np.array([3, 0, 5, 1, 4, 2])
    rows = np.concatenate([np.flatnonzero(observations.shot == j) for j in order])
    shuffled = Observations(
        np.repeat(np.arange(6), np.bincount(observations.shot)[order]),
        *(getattr(observations, name)[rows] for name in ("camera", "point", "uv", "cov_uv")),
        6,
    )
    one = minimise(model, truth, observations, SIGMA_PX)
    other = minimise(model, replace(truth, Ts_left_body=truth.Ts_left_body[order]), shuffled, SIGMA_PX)
    assert other.cost == pytest.approx(one.cost, rel=1e-9)
    sigma = np.sqrt(np.diag(one.cov_shared))
    assert (np.abs(apart(one.state, other.state)) < 1e-4 * sigma).all()


def test_moving_is_along_the_tangents():
    model, truth, _ = problem("brown4", degree=2)
    rng = np.random.default_rng(0)
    shared, poses = 1e-2 * rng.normal(size=size(model, truth)), 1e-2 * rng.normal(size=(6, 6))
    there = moved(truth, shared, poses)
    np.testing.assert_allclose(apart(truth, there), shared, atol=1e-12)
    for j in range(6):
        np.testing.assert_allclose(there.Ts_left_body[j], truth.Ts_left_body[j] @ exp_se3(poses[j]), atol=1e-15)
