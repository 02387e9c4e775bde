"""Locating: scipy on OpenCV's projection is the oracle of the pose, Monte Carlo of its covariance."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2

from armsight.data import Body, Correspondences, Missed
from armsight.geometry.pose import exp_se3, log_se3, pose, transform
from armsight.geometry.rotation import exp_so3
from armsight.vision.camera import Camera
from armsight.vision.markers.tag import CORNERS
from armsight.vision.pose import locate as module
from armsight.vision.pose.locate import locate
from armsight.vision.pose.pnp import consensus_poses
from armsight.vision.rig import StereoRig
from armsight.vision.triangulate import triangulate
from asserts import numeric_jacobian
from strategies import CAMERAS, ordinary_rig
from views import board, body_of, both_pixels, seen, somewhere

SIGMA_PX = 0.2
CLOUD = np.random.default_rng(3).uniform(-0.05, 0.05, (12, 3))
#: What a calibration from a dozen pairs leaves open: half a pixel of focal length and centre, a tenth of a milliradian.
LENS = (0.5, 0.5, 0.5, 0.5, 1e-3, 1e-3, 1e-4, 1e-4)
CALIBRATION = np.array([*LENS, *LENS, *(3 * [1e-4]), *(3 * [1e-4])])


def rig_of(model="brown4", *, known=True):
    """A rig with a noise of SIGMA_PX, its calibration known exactly or with a dense covariance."""
    base = ordinary_rig(model)
    if known:
        return replace(base, cov=np.zeros_like(base.cov), sigma_px=SIGMA_PX)
    n = base.parameter_count
    mix = np.linalg.qr(np.random.default_rng(0).normal(size=(n, n)))[0] * np.linspace(0.3, 1.5, n)
    root = CALIBRATION[:, None] * mix
    return replace(base, cov=root @ root.T, sigma_px=SIGMA_PX)


def located(rig, points, shot):
    """Locate without the gate: every detection reaches the fit."""
    body = body_of(points)
    return locate(rig, body, triangulate(rig, body, shot))


def error(estimate, T):
    """Tangent (6,) from the estimate to the truth."""
    return log_se3(np.linalg.inv(estimate.T_left_body) @ T)


def nees(estimate, T):
    """Normalised squared error, six degrees of freedom."""
    xi = error(estimate, T)
    return xi @ np.linalg.solve(estimate.cov, xi)


#: One in a hundred million by chance: beyond it a pose is in a wrong minimum, or its covariance is wrong.
WRONG = chi2.ppf(1 - 1e-8, 6)


@pytest.mark.parametrize("model", CAMERAS)
@pytest.mark.parametrize("points", [CLOUD, CLOUD[:4], CLOUD[:3], board(4, 3)], ids=["cloud", "four", "three", "board"])
def test_without_noise_it_is_the_truth(model, points):
    rig, rng = rig_of(model), np.random.default_rng(0)
    for _ in range(5):
        T = somewhere(rng)
        found = located(rig, points, seen(rig, points, T))
        assert np.abs(error(found, T)).max() < 1e-9
        assert found.residual_rms_m < 1e-9
        assert found.reprojection_rms_px < 1e-6
        assert found.misfit == 1
        assert found.dropped == ()


@pytest.mark.parametrize("model", CAMERAS)
def test_it_is_the_minimum_and_the_covariance_of_a_slow_solver(model):
    rig, rng, points = rig_of(model, known=True), np.random.default_rng(1), CLOUD[:6]
    root = 0.3 * (np.eye(2) + 0.5 * rng.normal(size=(6, 2, 2, 2)))
    cov_uv = root @ root.transpose(0, 1, 3, 2)
    T = somewhere(rng)
    shot = seen(rig, points, T, sigma=SIGMA_PX, rng=rng, hidden=[(1, 0), (4, 1)])
    shot = replace(shot, cov_uv=cov_uv)
    found = located(rig, points, shot)
    W = np.linalg.inv(np.linalg.cholesky(cov_uv + SIGMA_PX**2 * np.eye(2)))

    def whitened(x):
        r = shot.uv - both_pixels(rig, transform(found.T_left_body @ exp_se3(x), points))
        return (W @ r[..., None])[shot.seen].ravel()

    sigma = np.sqrt(np.diag(found.cov_noise))
    slow = least_squares(whitened, np.zeros(6), x_scale=sigma, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert (np.abs(slow.x) < 1e-3 * sigma).all()
    J = numeric_jacobian(whitened, np.zeros(6), 1e-4)
    np.testing.assert_allclose(
        found.cov_noise / np.outer(sigma, sigma), np.linalg.inv(J.T @ J) / np.outer(sigma, sigma), atol=1e-6
    )
    np.testing.assert_array_equal(found.cov, found.cov_noise)
    r = (shot.uv - both_pixels(rig, transform(found.T_left_body, points)))[shot.seen]
    assert found.reprojection_rms_px == pytest.approx(np.sqrt((r**2).sum(axis=1).mean()), rel=1e-6)
    gap = found.points.p_left - transform(found.T_left_body, points[[0, 2, 3, 5]])
    assert found.residual_rms_m == pytest.approx(np.sqrt((gap**2).sum(axis=1).mean()), rel=1e-9)


@pytest.mark.parametrize("model", CAMERAS)
def test_what_may_move_an_images_detections_together_is_in_the_covariance_and_no_noise(model):
    rig, rng = rig_of(model), np.random.default_rng(4)
    common = np.array([[[0.02, -0.01, 1e-4], [0.0, 0.0, 0.0]], [[-0.03, 0.02, -5e-5], [0.01, 0.01, -2e-5]]])
    for _ in range(3):
        shot = seen(rig, CLOUD, somewhere(rng))
        plain, found = located(rig, CLOUD, shot), located(rig, CLOUD, replace(shot, common=common))
        expected = np.zeros((6, 6))  # as the pose moves when they do
        for side, (*c, k) in ((n, shift) for n in (0, 1) for shift in common[n]):
            uv = shot.uv.copy()
            uv[:, side] += c + k * uv[:, side]
            xi = error(plain, located(rig, CLOUD, replace(shot, uv=uv)).T_left_body)
            expected += np.outer(xi, xi)
        gain = found.cov - plain.cov
        # What is not linear is of the shifts' share in the distance between the points: 0.1 px of 50 px and more.
        assert np.linalg.norm(gain - expected) < 0.01 * np.linalg.norm(expected)
        assert (found.cov_noise == plain.cov_noise).all()
        assert (found.T_left_body == plain.T_left_body).all()


def draws(points, n, seed, share):
    """Measure shots that rigs sampled from the covariance see with noise, with the one rig we assume."""
    assumed, rng = rig_of(known=False), np.random.default_rng(seed)
    assumed = replace(assumed, cov=share**2 * assumed.cov)
    root = np.linalg.cholesky(assumed.cov)
    for _ in range(n):
        true = assumed.perturbed(root @ rng.normal(size=len(root)))
        T = somewhere(rng, tilt=(0.4, 0.4, 1.0))
        yield located(assumed, points, seen(true, points, T, sigma=SIGMA_PX, rng=rng)), T


def assert_covers(values):
    """Hold normalised squared errors to be a chi-square of six degrees: mean and the 95% ellipsoid."""
    n = len(values)
    # The mean's 95% band; a chi-square of six degrees has variance twelve.
    assert abs(np.mean(values) - 6) < 1.96 * np.sqrt(12 / n)
    inside = np.mean(values < chi2.ppf(0.95, 6))
    assert abs(inside - 0.95) < max(0.02, 3 * np.sqrt(0.95 * 0.05 / n))


def test_the_covariance_covers_noise_and_calibration():
    values, alone = [], []
    for found, T in draws(CLOUD[:8], 2000, seed=1, share=0.3):
        values.append(nees(found, T))
        alone.append(nees(replace(found, cov=found.cov_noise), T))
    assert_covers(np.array(values))
    # Both shares count here: either alone would be far off.
    assert np.mean(alone) > 10


@pytest.mark.parametrize(
    ("points", "n"), [(CLOUD[:3], 200), (CLOUD[:4], 100), (board(4, 3), 300)], ids=["3", "4", "board"]
)
@pytest.mark.parametrize("share", [0.0, 1.0])
def test_the_covariance_covers_for_other_bodies(points, n, share):
    if share == 0.0:
        rig, rng = rig_of(), np.random.default_rng(2)
        Ts = [somewhere(rng) for _ in range(n)]
        shots = [(located(rig, points, seen(rig, points, T, sigma=SIGMA_PX, rng=rng)), T) for T in Ts]
    else:
        shots = list(draws(points, n, 3, share))
    assert_covers(np.array([nees(found, T) for found, T in shots]))


@pytest.mark.parametrize("camera", [0, 1])
@pytest.mark.parametrize("direction", [0.0, 0.8, 1.6])
def test_one_gross_error_is_dropped_by_name_and_moves_nothing(camera, direction):
    rig, points, rng = rig_of(), CLOUD[:8], np.random.default_rng(4)
    for k in range(8):
        T = somewhere(rng)
        shot = seen(rig, points, T, sigma=SIGMA_PX, rng=rng)
        uv = shot.uv.copy()
        uv[k, camera] += 30 * np.array([np.cos(direction), np.sin(direction)])
        found = located(rig, points, replace(shot, uv=uv))
        assert [d.point for d in found.dropped] == [f"P{k}"]
        assert found.dropped[0].reason.endswith(f"px off the body in the {('left', 'right')[camera]} image")
        assert 25 < float(found.dropped[0].reason.split()[0]) < 35
        assert k not in found.points.ids
        uv[k, camera] = np.nan
        without = located(rig, points, replace(shot, uv=uv))
        assert (np.abs(error(found, without.T_left_body)) < 1e-3 * np.sqrt(np.diag(without.cov))).all()
        np.testing.assert_allclose(found.cov, without.cov, rtol=1e-3, atol=1e-3 * np.abs(without.cov).max())


@pytest.mark.parametrize("count", [4, 8, 12])
@pytest.mark.parametrize("off", [100.0, 200.0, 350.0])
def test_no_error_along_the_epipolar_line_leads_to_a_wrong_minimum(count, off):
    """The gate lets such a point pass; its depth is metres off and pulls the rigid fit that is the start."""
    rig, points, rng = rig_of(), CLOUD[:count], np.random.default_rng(5)
    for _ in range(60):
        T = somewhere(rng, tilt=(0.4, 0.4, 1.0))
        shot = seen(rig, points, T, sigma=SIGMA_PX, rng=rng)
        uv, k = shot.uv.copy(), rng.integers(count)
        uv[k, rng.integers(2), 0] += rng.choice([-1, 1]) * off
        found = located(rig, points, replace(shot, uv=uv))
        assert nees(found, T) < WRONG
        assert {d.point for d in found.dropped} == {f"P{k}"}


def small_body_rig(baseline_m=0.35, away_m=1.7):
    """Two cameras of 8000 px focal length that look at one position; 0.5 px of noise."""
    camera = Camera((2000, 1500), "none", np.array([8000.0, 8000.0, 999.5, 749.5]), np.zeros(0))
    half = np.arcsin(baseline_m / 2 / away_m)
    T = pose(exp_so3(np.array([0.0, -2 * half, 0.0])), baseline_m * np.array([np.cos(half), 0.0, np.sin(half)]))
    return StereoRig(camera, camera, T, np.zeros((14, 14)), 0.5)


SMALL = {
    "triangle": (np.array([[0.0, 0, 0], [0.06, 0, 0], [0, 0.05, 0]]), 300),
    "flat square": (board(2, 2, 0.042), 100),
    "tetrahedron": (np.array([[0.0, 0, 0], [0.06, 0, 0], [0, 0.06, 0], [0, 0, 0.04]]), 100),
}


@pytest.mark.parametrize("name", SMALL)
def test_small_bodies_far_away_are_not_mirrored(name):
    rig, rng = small_body_rig(), np.random.default_rng(6)
    points, n = SMALL[name]
    points, wrong = points - points.mean(axis=0), 0
    for _ in range(n):
        T = pose(exp_so3(rng.normal(size=3) * [0.5, 0.5, 2.0]), np.array([0, 0, 1.7]) + rng.uniform(-0.05, 0.05, 3))
        found = located(rig, points, seen(rig, points, T, sigma=0.5, rng=rng))
        wrong += isinstance(found, Missed) or nees(found, T) > WRONG
    assert wrong <= 0.01 * n


def test_points_of_one_camera_improve_the_pose():
    rig, rng = rig_of(), np.random.default_rng(7)
    points, both = np.concatenate([0.5 * CLOUD[:8], 1.5 * CLOUD[8:]]), 8
    errors, claims = {True: [], False: []}, {True: [], False: []}
    for _ in range(100):
        T = somewhere(rng)
        shot = seen(rig, points, T, sigma=SIGMA_PX, rng=rng, hidden=[(i, i % 2) for i in range(both, 12)])
        less = Correspondences(*(a[:both] for a in (shot.ids, shot.uv, shot.cov_uv)))
        for more, given in ((True, shot), (False, less)):
            found = located(rig, points, given)
            assert len(found.points.ids) == both
            errors[more].append(error(found, T))
            claims[more].append(np.diag(found.cov))
    rms = {more: np.sqrt(np.mean(np.square(e), axis=0)) for more, e in errors.items()}
    sigma = {more: np.sqrt(np.mean(c, axis=0)) for more, c in claims.items()}
    assert (sigma[True] < 0.95 * sigma[False]).all()
    assert (rms[True] < 0.95 * rms[False]).all()


@pytest.mark.parametrize("count", [0, 1, 2])
def test_fewer_than_three_points_are_missed(count):
    rig, T = rig_of(), somewhere(np.random.default_rng(8))
    found = located(rig, CLOUD, seen(rig, CLOUD, T, hidden=[(i, 1) for i in range(count, 12)]))
    assert found == Missed(f"{count} matched points, 3 are needed")


def test_a_miss_says_what_was_dropped():
    rig, T = rig_of(), somewhere(np.random.default_rng(8))
    shot = seen(rig, CLOUD[:3], T)
    uv = shot.uv.copy()
    uv[1, 1, 0] += 500.0  # its rays part
    found = located(rig, CLOUD[:3], replace(shot, uv=uv))
    assert found.reason.startswith("2 matched points, 3 are needed; dropped: P1 (its rays do not meet")


@pytest.mark.parametrize("points", [board(2, 2, 0.042), CLOUD[:5], CLOUD[:3]], ids=["tag", "cloud", "triangle"])
@pytest.mark.parametrize("far", [False, True])
def test_few_points_are_where_all_poses_that_one_camera_allows_lead(points, far, monkeypatch):
    """Near the limit of distinguishing a body from its mirror image, with a displaced detection, and with one missing."""
    rig, tried, starts = small_body_rig(0.03, 3.5) if far else rig_of(), [], module._starts
    rng = np.random.default_rng(15)
    for k in range(45):
        T = pose(exp_so3(0.6 * rng.normal(size=3)), np.array([0.0, 0.0, 3.5])) if far else somewhere(rng)
        shot = seen(rig, points, T, sigma=rig.sigma_px, rng=rng)
        uv, (point, side) = shot.uv.copy(), rng.integers((len(points), 2))
        if k % 3 == 1:
            uv[point, side] += rig.sigma_px * rng.uniform(-40, 40, 2)
        elif k % 3 == 2 and len(points) > 3:
            uv[point, side] = np.nan
        shot = replace(shot, uv=uv)
        with monkeypatch.context() as patch:
            patch.setattr(module, "consensus_poses", lambda *given, k=k: tried.append(k) or consensus_poses(*given))
            fast = located(rig, points, shot)
        with monkeypatch.context() as patch:
            patch.setattr(module, "_starts", lambda rig, body, points, _: starts(rig, body, points, None))
            slow = located(rig, points, shot)
        if isinstance(slow, Missed):
            assert fast == slow
            continue
        assert [d.point for d in fast.dropped] == [d.point for d in slow.dropped]
        assert (np.abs(error(fast, slow.T_left_body)) < 1e-3 * np.sqrt(np.diag(slow.cov))).all()
    assert len(set(tried)) < 25  # most shots need no other poses than the first and its mirror image


LINE = np.outer(np.linspace(-0.05, 0.05, 5), [1.0, 0.5, 0.2])


def test_points_on_one_line_are_missed():
    rig, rng = rig_of(), np.random.default_rng(9)
    for points in (LINE, LINE[:3], LINE + 1e-5 * rng.normal(size=(5, 3)), np.zeros((4, 3))):
        found = located(rig, points, seen(rig, points, somewhere(rng), sigma=SIGMA_PX, rng=rng))
        assert found == Missed("the matched points lie on one line")


def test_points_left_on_one_line_by_an_outlier_are_missed():
    rig, rng = rig_of(), np.random.default_rng(10)
    points = np.concatenate([LINE, [[0.0, 0.06, 0.0]]])
    for _ in range(20):
        shot = seen(rig, points, somewhere(rng, tilt=(0.2, 0.2, 0.2)), sigma=SIGMA_PX, rng=rng)
        uv = shot.uv.copy()
        uv[5, :, 1] += 250.0  # off in both images, and farther from the line than any rotation about it leads
        found = located(rig, points, replace(shot, uv=uv))
        assert found == Missed("the points that agree with one pose of the body lie on one line")


def test_what_is_not_the_body_is_missed_and_a_bad_print_is_reported():
    rig, rng, points = rig_of(), np.random.default_rng(11), board(6, 4)
    for _ in range(10):
        T = somewhere(rng)
        shot = seen(rig, points, T, sigma=SIGMA_PX, rng=rng)
        mixed = located(rig, points[rng.permutation(24)], shot)
        assert isinstance(mixed, Missed)
        assert "the detections are not those of the body" in mixed.reason
        doubled = located(rig, 2 * points, shot)
        assert isinstance(doubled, Missed)
        assert "0.50 times as far apart as its points" in doubled.reason
        tenfold = located(rig, 10 * points, shot)
        assert isinstance(tenfold, Missed)
        assert "0.10 times as far apart as its points (is its size right, and its unit?)" in tenfold.reason
        scaled = located(rig, 1.01 * points, shot)
        # A hundredth of an apparent size of about 60 px is three times the noise, and the covariance says so.
        assert scaled.misfit > 1.5
        sharp = located(replace(rig, sigma_px=scaled.misfit * SIGMA_PX), 1.01 * points, shot)
        assert sharp.misfit == 1
        np.testing.assert_allclose(scaled.cov, sharp.cov, rtol=1e-3, atol=1e-3 * np.abs(sharp.cov).max())


def test_a_print_that_is_a_little_too_large_is_not_taken_for_single_markers_of_another_size():
    rig, rng = replace(rig_of(), sigma_px=0.02), np.random.default_rng(13)
    middles = np.array([(x, y, 0) for x in (-60, 0, 60) for y in (-60, 0, 60)]) / 1e3
    points = np.concatenate([m + CORNERS * 0.015 for m in middles])
    body = Body("plate", tuple(f"T{k}.{i}" for k in range(9) for i in range(4)), points)
    for _ in range(20):
        shot = seen(rig, 1.018 * points, somewhere(rng), sigma=0.02, rng=rng)
        found = locate(rig, body, triangulate(rig, body_of(points), shot))
        assert not isinstance(found, Missed), found.reason


def test_markers_of_another_size_at_the_right_positions_are_named_with_the_size_that_fits():
    rig, rng = replace(rig_of(), sigma_px=0.02), np.random.default_rng(12)
    middles = np.array([[-45, -45, 0], [45, -45, 0], [45, 45, 0], [-45, 45, 0]]) / 1e3
    names = tuple(f"T{k}.{i}" for k in range(4) for i in range(4))

    def tags(size_m, spread=1.0):
        return np.concatenate([spread * m + CORNERS * size_m / 2 for m in middles])

    for _ in range(5):
        shot = seen(rig, tags(0.045), somewhere(rng), sigma=0.02, rng=rng)
        found = [
            locate(rig, Body("plate", names, points), triangulate(rig, body_of(points), shot))
            for points in (tags(0.045), tags(0.0525), tags(0.0525, 0.0525 / 0.045))
        ]
        assert found[0].misfit == 1
        assert re.search(
            r"have another size than its file says: T0 (44\.9\d*|45[.0-9]*) mm instead of 52\.5,", found[1].reason
        )
        assert "its points lie 0.857 times as far apart" in found[2].reason  # all of it is larger


def test_a_wrong_size_is_asked_for_however_noisy_the_rig_is():
    rig, rng = replace(rig_of(), sigma_px=1.2), np.random.default_rng(14)
    points = np.array([(x, y, 0) for x in range(-60, 61, 20) for y in range(-60, 61, 20)]) / 1e3
    found = [
        locate(
            rig, body_of(points), triangulate(rig, body_of(points), seen(rig, points / 1.2, pose, sigma=0.1, rng=rng))
        )
        for pose in (somewhere(rng) for _ in range(5))
    ]
    reasons = [each.reason for each in found if isinstance(each, Missed)]
    assert reasons
    assert all(
        "is the size in the target right" in reason and "between the two exposures" in reason for reason in reasons
    )
