"""An inertial unit in the filter: preintegration, derivatives, what windows add, and whether the covariance knows."""

from dataclasses import replace

import numpy as np
import pytest
from arm_rig import ARM, TICK_S, legs, measured, mounts, off, sampled, seen, states
from scipy.stats import chi2

from armsight.errors import InputError
from armsight.geometry.pose import exp_se3, pose
from armsight.geometry.rotation import exp_so3
from armsight.loop.estimators import Delay, KalmanEstimator, Outcome, Prior
from armsight.loop.references.inertial import INERTIAL_CLASSES, Inertial
from armsight.loop.references.strapdown import Samples, Strapdown, _constraint
from armsight.sim.references.inertial import InertialErrors, record
from asserts import numeric_jacobian

MOUNT = pose(exp_so3(np.array([0.4, -0.3, 1.0])), np.array([0.02, -0.01, 0.03]))
CLASS = INERTIAL_CLASSES["icm-42688"]
DENSITY = np.repeat([CLASS.gyro_noise, CLASS.noise], 3)
#: What a calibration leaves: rotation, lever, biases, M_a, M_g, G, tilt.
LEFT = np.repeat([5e-4, 5e-4, 2e-4, 5e-3, 3e-4, 3e-4, 1e-5, 3e-4], [3, 3, 3, 3, 6, 9, 9, 2])
CHANCE = 1e-4
#: The camera's delay is right.
KNOWN = Delay(0.0, 2e-4)


def unit(left=LEFT, **more):
    plain = Inertial.of("imu", "icm-42688", MOUNT)
    return replace(plain, cov=np.diag(left**2), sigma_delay_s=1e-4, **more)


def world(seed, seconds, blind_s, jump=None):
    """An arm's noisy readings, its true poses, what vision measured until it is blind, and a unit's samples.

    jump: added to the joints' angles (N, n) behind the readings, rad.
    """
    rng = np.random.default_rng(seed)
    shaft, (true, mounting) = legs(rng, seconds), mounts(rng)
    Ts = sampled(rng).tool(shaft if jump is None else shaft + jump)
    q = shaft + rng.normal(size=shaft.shape) * Prior().reading_rad
    looks = [measured(mounting, seen(rng, Ts[k], true), k * TICK_S) for k in range(20, int(blind_s / TICK_S), 16)]
    said = unit()
    there = said.moved(rng.normal(size=38) * LEFT)
    errors = InertialErrors(
        noise=DENSITY,
        rate_hz=1000.0,
        bandwidth_hz=400.0,
        bias=there.values[3:9],
        step=np.full(6, 1e-6),
        largest=np.full(6, 1e6),
    )
    t_s, z = record(np.arange(len(Ts)) * TICK_S, Ts @ there.T_tool_sensor, errors, rng)
    return q, Ts, looks, said, t_s + np.sqrt(2.0) / (2 * np.pi * 400.0), z


def go(q, looks, said=None, t_s=None, z=None, late=0, *, heard=None, delay=KNOWN, learns_delay=False):
    """Give everything in order of time, 10 ms at a time, images so many ticks late; return the estimator.

    heard: lists to which what became of images and windows is added.
    """
    estimator, looks = KalmanEstimator(ARM, delay=delay, learns_delay=learns_delay), list(looks)
    if heard is not None:
        estimator.on_innovation, estimator.on_reading = heard[0].append, lambda name, window: heard[1].append(window)
    sensor = None if said is None else replace(said, delay_s=np.sqrt(2.0) / (2 * np.pi * 400.0))
    for begin in range(0, len(q), 10):
        end = min(begin + 10, len(q))
        estimator.joints(states(np.arange(begin, end) * TICK_S, q[begin:end]))
        if sensor is not None:
            rows = (t_s > (begin - 1) * TICK_S) & (t_s <= (end - 1) * TICK_S)
            estimator.take(sensor, Samples(t_s[rows], z[rows], DENSITY))
        while looks and looks[0].t_s <= (end - 1 - late) * TICK_S:
            estimator.vision(looks.pop(0))
    return estimator


def test_images_that_waited_as_the_unit_came_count_as_those_after_it_do():
    q, _, looks, said, t_s, z = world(300, 1.2, 1.2)
    rows, covs = (t_s > 0.98) & (t_s < 1.1), []
    ahead = [look for look in looks if 1.0 < look.t_s < 1.05]  # of the joints
    for first in (True, False):
        estimator = go(q[:1000], [look for look in looks if look.t_s <= 1.0])
        for look in ahead if first else ():
            assert estimator.vision(look) is Outcome.WAITING
        estimator.take(said, Samples(t_s[rows], z[rows], DENSITY))
        for look in () if first else ahead:
            assert estimator.vision(look) is Outcome.WAITING
        for k in range(1000, 1080, 10):
            estimator.joints(states(np.arange(k, k + 10) * TICK_S, q[k : k + 10]))
        covs.append(estimator.estimate().cov)
    assert len(ahead) > 1
    np.testing.assert_allclose(*covs, rtol=1e-9, atol=1e-18)


def test_preintegration_is_that_of_a_hundred_times_finer_steps():
    w, f = np.array([1.2, -0.7, 2.0]), np.array([3.0, -2.0, 9.0])
    t = np.arange(0.0, 0.04, 1e-3)
    strapdown = Strapdown(unit())
    at = lambda s: np.hstack([w * (1 + 5 * s), f * (1 - 8 * s)])  # noqa: E731
    strapdown.add(Samples(t, np.array([at(s) for s in t]), DENSITY))
    begin, end = 0.0034, 0.0217
    got = strapdown.window(begin, end)
    R, v, p, n = np.eye(3), np.zeros(3), np.zeros(3), 2000
    h = (end - begin) / n
    for s in begin + h * (np.arange(n) + 0.5):
        both = at(s)
        push = R @ exp_so3(both[:3] * h / 2) @ both[3:]
        p, v, R = p + v * h + push * h * h / 2, v + push * h, R @ exp_so3(both[:3] * h)
    # A force that changes by 72 m/s3 is taken as its mean over a step: 72 h^3 / 12 a step are 6 nm, for 18 of them.
    np.testing.assert_allclose(got[1:10].reshape(3, 3), R, atol=1e-9)
    np.testing.assert_allclose(got[10:13], v, atol=2e-7)
    np.testing.assert_allclose(got[13:16], p, atol=1.5e-7)
    assert strapdown.window(-0.001, 0.01) is None
    assert strapdown.window(0.03, 0.06) is None


def constraint(strapdown, window, Ts, y):
    """Return residual and velocity at a window's end (9,), derivatives by the tool's tangents and by y, and the noise."""
    r, by, by_y, noise = np.zeros(9), np.zeros((9, 12)), np.zeros((9, 42)), np.zeros((9, 9))
    _constraint(window, strapdown._mount, Ts, y, by, by_y, r, noise)
    return r, by, by_y, noise


def test_the_derivatives_are_those_of_finite_differences():
    rng = np.random.default_rng(3)
    Ts = np.array([exp_se3(rng.normal(size=6)), np.eye(4)])
    Ts[1] = Ts[0] @ exp_se3(0.01 * rng.normal(size=6))
    t = np.arange(0.0, 0.03, 1e-3)
    z = np.hstack([np.tile([0.3, -0.5, 0.8], (30, 1)), np.tile([1.0, -4.0, 9.0], (30, 1))]) * (1 + 3 * t[:, None])
    y = np.concatenate([rng.normal(size=3), np.zeros(39)])

    def of(xi, y, sensor=None, late=0.0):
        strapdown = Strapdown(sensor or unit())
        strapdown.add(Samples(t + late, z, DENSITY))
        window = strapdown.window(0.005, 0.015)
        return constraint(strapdown, window, Ts @ exp_se3(xi.reshape(2, 6)), y)

    _, by_tool, by_y, _ = of(np.zeros(12), y)
    found = numeric_jacobian(lambda xi: of(xi, y)[0], np.zeros(12), 1e-4)
    # The rotation's residual is some 0.025: its logarithm is taken to first order, which leaves half of that.
    np.testing.assert_allclose(by_tool, found, atol=0.0125)
    np.testing.assert_allclose(by_tool[3:], found[3:], atol=1e-7)
    found = numeric_jacobian(lambda v: of(np.zeros(12), np.append(v, np.zeros(39)))[0], y[:3], 1e-3)
    np.testing.assert_allclose(by_y[:, :3], found, atol=1e-9)
    # Parameters: those of a unit that has them, weighed by what a calibration leaves of each; what they do to rotations
    # within the window is left out of their derivatives.
    found = numeric_jacobian(lambda step: of(np.zeros(12), y, unit().moved(step))[0], np.zeros(38), 1e-4)
    found, by = found * LEFT, by_y[:, 4:] * LEFT

    assert (np.abs(by - found) < 0.02 * np.abs(found).max(axis=1, keepdims=True)).all()
    # A unit whose delay is larger by so much: its samples, stamped alike, are earlier.
    found = (of(np.zeros(12), y, late=-1e-4)[0] - of(np.zeros(12), y, late=1e-4)[0]) / 2e-4
    assert np.abs(by_y[:, 3] - found).max() < 0.02 * np.abs(found).max()


def test_hidden_for_half_a_second_the_unit_lowers_the_error_and_the_covariance_knows():
    errors, squares, alone = [], [], []
    for seed in range(10):
        q, Ts, looks, *imu = world(200 + seed, 4.0, 3.5)
        now = go(q, looks, *imu).estimate()
        e = off(now.T_base_tool, Ts[-1])
        errors.append(e[:3])
        squares.append(e @ np.linalg.solve(now.cov, e))
        alone.append(off(go(q, looks).estimate().T_base_tool, Ts[-1])[:3])
    # 0.71 here and 0.66 on seeds 300 to 309: links that jump within a sample no samples show.
    assert np.sqrt(np.mean(np.square(errors))) < 0.8 * np.sqrt(np.mean(np.square(alone)))
    low, high = chi2.ppf([CHANCE, 1 - CHANCE], 6 * len(squares))
    assert low < np.sum(squares) < high, f"mean NEES {np.mean(squares):.2f}"


def test_all_late_images_are_reported_with_a_unit_as_without():
    q, _, looks, *imu = world(231, 1.2, 1.0)
    alone, beside = ([], []), ([], [])
    go(q, looks, late=40, heard=alone)
    go(q, looks, *imu, late=40, heard=beside)
    assert [each.t_s for each in beside[0]] == pytest.approx([each.t_s for each in alone[0]])
    assert len(beside[0]) == len(looks)


def test_the_delays_sigma_does_not_vanish_with_a_unit():
    q, _, looks, *imu = world(231, 0.6, 0.5)
    given = Delay(0.0, 4e-4)
    assert go(q, looks, *imu, delay=given).learned().delay.sigma_s == pytest.approx(given.sigma_s)


def test_while_the_delay_is_learned_a_unit_changes_nothing_and_the_delay_is_as_close_as_its_sigma_says():
    off_by, squares = [], []
    for seed in range(4):
        q, Ts, looks, *imu = world(260 + seed, 2.0, 2.0)
        late = [replace(look, t_s=look.t_s + 0.003) for look in looks]
        alone, beside = (go(q, late, *fused, delay=Delay(0.0, 0.01), learns_delay=True) for fused in ((), imu))
        np.testing.assert_array_equal(beside.estimate().T_base_tool, alone.estimate().T_base_tool)
        found = beside.learned().delay
        off_by.append((found.delay_s - 0.003) / found.sigma_s)
        e = off(beside.estimate().T_base_tool, Ts[-1])
        squares.append(e @ np.linalg.solve(beside.estimate().cov, e))
    for sums, freedom in ((np.square(off_by), 1), (squares, 6)):
        low, high = chi2.ppf([CHANCE, 1 - CHANCE], freedom * len(sums))
        assert low < np.sum(sums) < high, f"{sums} of {freedom}"


def test_what_noise_makes_of_a_window_is_that_of_sampled_noise():
    rng, rate, count = np.random.default_rng(270), 1000.0, 2000
    T = pose(exp_so3(np.array([0.3, -1.2, 0.7])), np.zeros(3))
    density = DENSITY * [1.0, 2.0, 3.0, 1.0, 2.0, 3.0]  # axes that are mixed up show
    plain, t = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 9.8], (51, 1)), np.arange(51) / rate
    found = []
    for _ in range(count):
        strapdown = Strapdown(unit())
        strapdown.add(Samples(t, plain + rng.normal(size=plain.shape) * density * np.sqrt(rate), density))
        window = strapdown.window(0.0, 0.05)
        found.append(constraint(strapdown, window, np.stack([T, T]), np.zeros(42))[0])
    expected, sampled_cov = (
        constraint(strapdown, window, np.stack([T, T]), np.zeros(42))[3],
        np.cov(np.transpose(found)),
    )
    sigma = np.sqrt(np.diag(expected))
    # Correlations of so many scatter by 1/sqrt(count), variances by sqrt(2/count); of 51 samples, 1/50 is at the ends.
    np.testing.assert_allclose(
        sampled_cov / np.outer(sigma, sigma), expected / np.outer(sigma, sigma), atol=5 * np.sqrt(2 / count) + 0.02
    )


def test_biases_wander_as_sampled_random_walks_do_where_joints_say_nothing():
    rng, z, T = np.random.default_rng(271), np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 9.8], (200, 1)), np.eye(4)
    strapdown, rows = Strapdown(unit()), 7
    strapdown.add(Samples(1e-3 * np.arange(200), z, DENSITY))
    beside = first = strapdown.started(None, 0.0, T, np.zeros(6), rows)
    H = np.stack([np.eye(6, 7)] * 2)  # the last row is the delay, which no reading changes
    for k in range(10):
        window = strapdown.window(0.01 * k, 0.01 * (k + 1))
        state, step = (np.zeros(rows), np.eye(rows)), (np.ones(rows), np.ones(rows))
        beside = strapdown.advanced(window, beside, state, step, (np.stack([T, T]), H), 6).beside
        beside = beside._replace(C=np.zeros_like(beside.C))
    # The bias differs over CORNER_S by as much as the average of the noise over that time is off.
    steps = rng.normal(size=(20000, 100, 6)) * (DENSITY / 6.0) * np.sqrt(1e-3)
    biases = slice(4 + 6, 4 + 12)
    gained = np.diag(beside.Y)[biases] - np.diag(first.Y)[biases]
    np.testing.assert_allclose(gained, steps.sum(axis=1).var(axis=0), rtol=0.05)


def test_samples_that_are_far_off_for_a_moment_are_an_outlier_and_are_not_used():
    q, _, looks, said, t_s, z = world(272, 1.5, 1.5)
    knocked = z.copy()
    knocked[(t_s > 1.302) & (t_s < 1.308)] += [0.0, 5.0, 0.0, 0.0, 0.0, 50.0]
    good, bad = ([], []), ([], [])
    as_it_is, now = (go(q, looks, said, t_s, each, heard=to).estimate() for each, to in ((z, good), (knocked, bad)))
    outliers = [sum(each.outcome is Outcome.OUTLIER for each in to[1]) for to in (good, bad)]
    assert outliers[0] == 0
    assert 1 <= outliers[1] <= 2
    moved = off(as_it_is.T_base_tool, now.T_base_tool)
    assert moved @ np.linalg.solve(now.cov, moved) < 1.0


#: What one of a chip's last digit is at 4 g and at 250 and 2000 deg/s; ST's of 250 deg/s, and 16.4 of MPU's per deg/s.
LSB_4G, LSB_250, LSB_2000 = 4 * 9.80665 / 32768, np.radians(250 / 32768), np.radians(2000 / 32768)
ST_250, MPU_2000 = np.radians(8.75e-3), np.radians(1 / 16.4)


@pytest.mark.parametrize(("axis", "step"), [(2, LSB_2000), (2, 2 * LSB_250), (2, MPU_2000), (5, LSB_4G)])
@pytest.mark.parametrize("steady", [(2.3, 22.0), (np.radians(125.0), 2 * 9.80665)])
@pytest.mark.parametrize("rate_hz", [100.0, 1000.0])
def test_steady_motion_and_push_are_not_clipped(axis, step, rate_hz, steady):
    rng, t_s, strapdown = np.random.default_rng(0), np.arange(0.0, 2.0, 1 / rate_hz), Strapdown(unit())
    z = rng.normal(size=(len(t_s), 6)) * DENSITY * np.sqrt(rate_hz / 2) + np.repeat(steady, 3)
    z[:, axis] = np.round(z[:, axis] / step) * step
    strapdown.add(Samples(t_s, z, DENSITY))
    windows = [strapdown.window(begin, begin + 0.04) for begin in np.arange(0.1, 1.9, 0.04)]
    assert np.isfinite(windows).all()


@pytest.mark.parametrize(("axis", "step"), [(2, LSB_2000), (1, LSB_250), (0, ST_250), (1, MPU_2000), (4, LSB_4G)])
@pytest.mark.parametrize("end", [-32768, 32767])
def test_values_at_the_end_of_a_chips_range_are_clipped(axis, step, end):
    t_s, strapdown = np.arange(0.0, 0.5, 1e-3), Strapdown(unit())
    z = np.random.default_rng(0).normal(size=(len(t_s), 6)) * DENSITY * np.sqrt(500.0)
    z[200:205, axis] = end * step
    strapdown.add(Samples(t_s, z, DENSITY))
    windows = [strapdown.window(begin, begin + 0.04) for begin in (0.1, 0.18, 0.3)]
    assert [bool(np.isfinite(window).all()) for window in windows] == [True, False, True]


@pytest.mark.parametrize(("axis", "largest"), [(4, 32767 * LSB_4G), (1, 32767 * LSB_250)])
def test_clipped_samples_count_as_missing_links_open_and_the_unit_goes_on(axis, largest):
    q, Ts, looks, said, t_s, z = world(272, 1.8, 1.8)
    knocked = z.copy()
    knocked[(t_s > 1.302) & (t_s < 1.308), axis] += 3 * largest
    knocked[:, axis] = np.clip(knocked[:, axis], -largest, largest)
    heard = [], []
    now = go(q, looks, said, t_s, knocked, heard=heard).estimate()
    assert all(each.outcome is Outcome.USED for each in heard[0])
    impacts = [each.t_s for each in heard[1] if each.outcome is Outcome.OUTLIER]
    assert 1 <= len(impacts) <= 2
    assert all(1.3 < at < 1.35 for at in impacts)
    assert sum(each.outcome is Outcome.USED and each.t_s > 1.35 for each in heard[1]) > 20
    e = off(now.T_base_tool, Ts[-1])
    assert e @ np.linalg.solve(now.cov, e) < chi2.ppf(1 - CHANCE, 6)


def test_smoothed_poses_use_what_came_after_and_their_covariance_knows():
    squares, ratios = [], []
    for seed in range(290, 293):
        q, Ts, looks, said, t_s, z = world(seed, 2.2, 2.2)
        estimator, live, looks = KalmanEstimator(ARM, delay=KNOWN, learns_delay=False), [], list(looks)
        for k in range(0, len(q), 10):
            estimator.joints(states(np.arange(k, k + 10) * TICK_S, q[k : k + 10]))
            rows = (t_s > (k - 10) * TICK_S) & (t_s <= k * TICK_S)
            estimator.take(said, Samples(t_s[rows], z[rows], DENSITY))
            while looks and looks[0].t_s <= (k + 9) * TICK_S:
                estimator.vision(looks.pop(0))
            live.append(off(estimator.estimate().T_base_tool, Ts[k + 9]))
        at = np.arange(1400, 1800, 10)
        track = estimator.smoothed(at * TICK_S)
        e = np.array([off(T, Ts[k]) for T, k in zip(track.Ts_base_tool, at, strict=True)])
        assert (np.linalg.eigvalsh(track.covs_own) > 0.0).all()
        squares.append(np.einsum("ni,nij,nj->n", e, np.linalg.inv(track.covs), e).mean() / 6)
        ratios.append(np.sqrt(np.mean(e[:, :3] ** 2) / np.mean(np.array(live)[140:180, :3] ** 2)))
    assert max(ratios) < 1.0
    assert np.mean(ratios) < 0.8
    assert 0.1 < np.mean(squares) < 2.0


def test_long_after_vision_and_unit_the_newest_state_says_what_was():
    q, _, looks, said, t_s, z = world(290, 3.4, 1.2)
    estimator = go(q, looks, said, t_s[t_s < 1.3], z[t_s < 1.3])
    track, alone = estimator.smoothed(np.array([3.0])), estimator.track(np.array([3.0]))
    np.testing.assert_allclose(track.Ts_base_tool, alone.Ts_base_tool, atol=1e-9)
    np.testing.assert_allclose(track.covs, alone.covs, rtol=1e-6, atol=1e-15)


def test_after_an_impact_links_may_be_anywhere_in_their_gaps():
    """A link jumps by 12 mrad in 10 ms, which its joint does not read: a window is an outlier, and the pose is right."""
    seconds, squares = 1.6, []
    t = np.arange(round(seconds / TICK_S)) * TICK_S
    ease = np.clip((t - 1.3) / 0.01, 0.0, 1.0)
    jump = 12e-3 * (ease**3 * (10 - 15 * ease + 6 * ease**2))[:, None] * np.eye(6)[1]
    for seed in range(280, 284):
        heard = [], []
        q, Ts, looks, *imu = world(seed, seconds, 1.28, jump)
        now = go(q, looks, *imu, heard=heard).estimate()
        (first, *_) = [each.t_s for each in heard[1] if each.outcome is Outcome.OUTLIER]
        assert 1.3 < first < 1.35
        e = off(now.T_base_tool, Ts[-1])
        squares.append(e @ np.linalg.solve(now.cov, e))
    assert np.sum(squares) < chi2.ppf(1 - CHANCE, 6 * len(squares)), f"mean NEES {np.mean(squares):.2f}"


def test_two_batches_of_half_of_what_is_kept_are_taken():
    strapdown = Strapdown(unit())
    for first in (0, 4096):
        strapdown.add(Samples(1e-3 * np.arange(first, first + 4096), np.zeros((4096, 6)), DENSITY))
    assert strapdown.window(8.19, 8.193) is not None


def test_late_images_give_what_images_in_time_give():
    q, _, looks, *imu = world(230, 2.0, 1.9)
    in_time, late = go(q, looks, *imu).estimate(), go(q, looks, *imu, late=40).estimate()
    # Meanwhile more readings of the joints have come about each window's ends: their noise differs, not what is known.
    sigma = np.sqrt(np.diag(in_time.cov)[:3].sum())
    assert np.linalg.norm(off(in_time.T_base_tool, late.T_base_tool)[:3]) < sigma
    np.testing.assert_allclose(np.diag(late.cov), np.diag(in_time.cov), rtol=0.6)


def test_a_unit_rotated_on_its_mount_shows_in_the_residuals_and_a_good_one_does_not():
    ratios = []
    for angle_deg in (0.0, 3.0):
        q, _, looks, said, t_s, z = world(240, 3.0, 3.0)
        R, found = exp_so3(np.radians([angle_deg, 0.0, 0.0])), []
        z = np.hstack([z[:, :3] @ R, z[:, 3:] @ R])
        estimator = KalmanEstimator(ARM, delay=Delay(0.0, 2e-4), learns_delay=False)
        estimator.on_reading = lambda name, i, found=found: found.append(i.z @ np.linalg.solve(i.cov, i.z) / 6)
        estimator.joints(states(np.arange(1500) * TICK_S, q[:1500]))
        for look in looks[:80]:
            estimator.vision(look)
        for k in range(1500, len(q), 10):
            estimator.joints(states(np.arange(k, k + 10) * TICK_S, q[k : k + 10]))
            rows = (t_s > (k - 20) * TICK_S) & (t_s <= (k - 10) * TICK_S)
            estimator.take(said, Samples(t_s[rows], z[rows], DENSITY))
        ratios.append(float(np.sqrt(np.median(found))))
    assert ratios[0] < 1.3
    assert ratios[1] > 1.5 * ratios[0]


@pytest.mark.parametrize("waits", [False, True])
def test_a_unit_that_images_contradict_is_used_no_more(waits):
    q, Ts, looks, said, t_s, z = world(241, 3.0, 3.0)
    R = exp_so3(np.radians([20.0, 0.0, 0.0]))
    looks, estimator = list(looks), KalmanEstimator(ARM, delay=Delay(0.0, 2e-4), learns_delay=False)
    for k in range(0, len(q), 10):
        if not waits:
            estimator.joints(states(np.arange(k, k + 10) * TICK_S, q[k : k + 10]))
        rows = (t_s > (k - 10) * TICK_S) & (t_s <= k * TICK_S)
        if k > 1000:
            heard = estimator.take(said, Samples(t_s[rows], np.hstack([z[rows, :3] @ R, z[rows, 3:] @ R]), DENSITY))
        while looks and looks[0].t_s <= (k + 9) * TICK_S:
            estimator.vision(looks.pop(0))
        if waits:
            estimator.joints(states(np.arange(k, k + 10) * TICK_S, q[k : k + 10]))
    assert heard is Outcome.OUTLIER
    alone = go(q, world(241, 3.0, 3.0)[2]).estimate()
    now = estimator.estimate()
    # What is known of the arm is that of the first second and of what came after: near what is known without a unit.
    assert np.linalg.norm(off(now.T_base_tool, Ts[-1])[:3]) < 4 * np.sqrt(np.trace(alone.cov[:3, :3]))


def test_nothing_heard_before_a_state_is_restored_changes_what_comes_after():
    """Neither images of a clock that jumped, nor a knock of the links; the first images afterwards are as wrong."""
    q, _, looks, said, t_s, z = world(274, 2.1, 2.1)
    late, knocked = (
        [replace(look, t_s=look.t_s + 0.03) for look in looks],
        np.where((t_s > 1.71) & (t_s < 1.73), 1e6, z.T),
    )
    came, outcomes = [], []
    for disturbed in (False, True):
        estimator = go(q[:1700], [look for look in looks if look.t_s < 1.55], said, t_s[t_s < 1.7], z[t_s < 1.7])
        before, sensor = estimator.remembered(), estimator._unit.sensor
        heard = [estimator.vision(look) for look in late if disturbed and 1.62 < look.t_s < 1.69]
        for first in range(1700, 2100, 10):
            t = np.arange(first, first + 10) * TICK_S
            estimator.joints(states(t, q[first : first + 10]))
            rows = (t_s >= t[0] - TICK_S / 2) & (t_s < t[-1] + TICK_S / 2)
            estimator.take(sensor, Samples(t_s[rows], (knocked.T if disturbed and first < 1750 else z)[rows], DENSITY))
            if first == 1740:
                assert (np.isfinite(estimator._struck_s), len(estimator._offsets) > 1) == (disturbed, disturbed)
                estimator.restore(before)
            heard += [estimator.vision(look) for look in late if t[0] <= look.t_s < t[-1] and first > 1740]
            now = estimator.estimate()
            came += [np.vstack([now.T_base_tool[:, [0, 1, 2, 3, 3, 3]], now.cov])] * (first > 1740)
        outcomes.append(heard)
    assert Outcome.USED not in outcomes[1][:4]
    np.testing.assert_array_equal(*np.split(np.array(came), 2))


@pytest.mark.parametrize("seed", [297, 298])
def test_a_cameras_clock_that_jumps_is_followed_with_a_unit(seed):
    q, Ts, looks, *imu = world(seed, 6.5, 6.5)
    jumped, heard = [replace(each, t_s=each.t_s + 2e-3 * (each.t_s > 2.0)) for each in looks], ([], [])
    estimator = go(q, jumped, *imu, heard=heard)
    assert all(each.outcome is Outcome.USED for each in heard[0])
    assert estimator.unit_differs()  # it is used yet
    now = estimator.estimate()
    e = off(now.T_base_tool, Ts[-1])
    assert e @ np.linalg.solve(now.cov, e) < chi2.ppf(1 - CHANCE, 6)
    assert abs(estimator.clock_offset_s(6.5) - 2e-3) < 1e-3
    # What was known of the delay before the unit is known again without it, and not while there is one.
    d, before = estimator.delay_row, KalmanEstimator(ARM, delay=KNOWN, learns_delay=False).remembered()
    estimator.restore(before)
    assert estimator.remembered().P[d, d] == 0.0
    assert np.isfinite(estimator.estimate().cov).all()


@pytest.mark.parametrize("beside", [False, True])
@pytest.mark.parametrize("jump_s", [0.01, -0.03])
def test_a_cameras_clock_that_jumps_in_motion_does_not_spoil_the_estimate(jump_s, beside):
    q, Ts, looks, *imu = world(501, 3.2, 3.2)
    jumped, heard, squares = [replace(each, t_s=each.t_s + jump_s * (each.t_s > 2.0)) for each in looks], ([], []), []
    for end in (2150, 2300, 2600, 3000, 3200):
        given = [each for each in jumped if each.t_s < end * TICK_S]
        estimator = go(q[:end], given, *(imu if beside else ()), heard=heard)
        e = off(estimator.estimate().T_base_tool, Ts[end - 1])
        squares.append(e @ np.linalg.solve(estimator.estimate().cov, e))
    assert max(squares) < chi2.ppf(1 - CHANCE, 6)  # without a mend: 600 and more
    assert abs(estimator.clock_offset_s(3.2) - jump_s) < 2e-3
    assert not any(each.outcome is Outcome.REOPENED for each in heard[0])
    assert bool(estimator.unit_differs()) is beside  # it is used yet


def test_samples_that_are_none_are_rejected():
    strapdown, z = Strapdown(unit()), np.zeros((3, 6))
    for t_s, given in ((np.array([0.0, 0.0, 1.0]), z), (np.arange(3.0), z[:, :5]), (np.arange(3.0), z + np.nan)):
        with pytest.raises(InputError, match="imu: expected samples"):
            strapdown.add(Samples(t_s, given, DENSITY))
