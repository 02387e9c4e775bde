import numpy as np
import pytest
from scipy.stats import chi2, t

from armsight.errors import InputError
from armsight.geometry.pose import exp_se3, pose
from armsight.loop.iso9283 import poses as iso9283
from armsight.loop.iso9283.paths import circle_metrics, path_metrics, plane_axes
from armsight.loop.iso9283.plan import CLEAR_RAD, CUBES_M, plan_check
from armsight.robot.arm_file import open_arm

ARM_M = np.array([2e-4, 1e-4, 0.5e-4])


def attained(seed, n, arm=ARM_M, noise=0.0, off=(0, 0, 0)):
    """Poses about a command, and the instrument's covariance."""
    rng = np.random.default_rng(seed)
    command = exp_se3(np.array([0.3, 0.2, 0.5, 0.1, 0.2, 0.3]))
    p = command[:3, 3] + off + rng.normal(0, arm, (n, 3)) + rng.normal(0, noise, (n, 3))
    reversals = exp_se3(rng.normal(0, [0, 0, 0, 1e-3, 1e-3, 1e-3], (n, 6)))[:, :3, :3]
    Ts = np.array([pose(command[:3, :3] @ R, at) for R, at in zip(reversals, p, strict=True)])
    return Ts, command, np.repeat(np.eye(3)[None] * noise**2, n, axis=0)


def by_the_book(p):
    """RP_l of the standard, written out."""
    middle = sum(p) / len(p)
    lengths = [float(np.sqrt(sum((q - middle) ** 2))) for q in p]
    mean = sum(lengths) / len(p)
    return mean + 3 * (sum((at - mean) ** 2 for at in lengths) / (len(p) - 1)) ** 0.5


def test_without_noise_the_metrics_are_the_standards():
    Ts, command, cov = attained(1, 30, off=(1e-3, 0, 0))
    metrics = iso9283.pose_metrics(Ts, command, cov)
    assert metrics.RP_m.raw == pytest.approx(by_the_book(Ts[:, :3, 3]), rel=1e-12)
    assert metrics.RP_m.clean == pytest.approx(metrics.RP_m.raw, rel=1e-9)
    assert metrics.AP_m.raw == pytest.approx(np.linalg.norm(Ts[:, :3, 3].mean(axis=0) - command[:3, 3]), rel=1e-12)
    assert np.linalg.norm(metrics.AP_xyz_m - [1e-3, 0, 0]) < 4 * np.linalg.norm(ARM_M) / np.sqrt(30)
    np.testing.assert_allclose(metrics.RP_rotation_rad, 3e-3, rtol=0.5)  # 30 numbers: 13 % sigma


@pytest.mark.parametrize("n", [3, 5, 30])
def test_the_best_value_lies_within_its_interval(n):
    metrics = [iso9283.pose_metrics(*attained(seed, n, noise=1e-4)).RP_m for seed in range(40)]
    resolved = [metric for metric in metrics if metric.clean is not None]
    assert len(resolved) > 5
    for metric in resolved:
        assert metric.low <= metric.clean <= metric.high


def population(cov):
    """RP of a normal scatter, by very many positions."""
    at = np.random.default_rng(0).multivariate_normal(np.zeros(3), cov, 400_000)
    length = np.linalg.norm(at, axis=1)
    return length.mean() + 3 * length.std()


def covers(metrics, true, widest):
    """Hold intervals to what they say: 95 % of them, a binomial of so many, hold the truth; not less by its 4 sigmas.

    Half of them are no wider than what is given.
    """
    share = np.mean([metric.low <= true <= metric.high for metric in metrics])
    assert share > 0.95 - 4 * np.sqrt(0.95 * 0.05 / len(metrics)), share
    width = np.median([metric.high - metric.low for metric in metrics])
    assert width < widest, (width, widest)


def chi_width(n):
    """Width of the interval of 95 % of a deviation of n numbers, as a share of it."""
    return np.sqrt((n - 1) / chi2.ppf(0.025, n - 1)) - np.sqrt((n - 1) / chi2.ppf(0.975, n - 1))


def mean_width(sigma, n):
    """Width of Student's interval of 95 % of the mean of n numbers."""
    return 2 * t.ppf(0.975, n - 1) * sigma / np.sqrt(n)


@pytest.mark.parametrize("shape", [(1.0, 1.0, 1.0), (1.0, 0.05, 0.05)])
@pytest.mark.parametrize(("n", "noise"), [(10, 0.5), (30, 0.0), (30, 0.5)])
def test_the_instruments_noise_is_taken_off_and_the_interval_holds(shape, n, noise):
    arm = np.diag(np.square(shape))
    true, rng = population(arm), np.random.default_rng(7)
    C = np.eye(3) * noise**2 * np.trace(arm) / 3
    metrics = []
    for _ in range(80):
        p = rng.multivariate_normal(np.zeros(3), arm + C, n)
        metrics.append(iso9283.repeatability(p, np.broadcast_to(C, (n, 3, 3))))
    # No wider than that of a deviation of a needle-like scatter, which is known least; the noise is added to it.
    covers(metrics, true, 1.25 * (1 + noise**2) * chi_width(n) * true)
    clean = [f.clean for f in metrics if f.clean is not None]
    if n == 30 and noise < 1:  # all are resolved: none is left out, which would take the smallest
        assert len(clean) == 80
        # The standard's metric is 1 / n too small itself, and scatters by 17 % at most, the mean of 80 by 2 %.
        assert np.mean(clean) == pytest.approx(true, rel=0.1)
        assert np.mean([f.raw for f in metrics]) == pytest.approx(population(arm + C), rel=0.1)


def test_limit_of_distances_is_that_of_very_many():
    for shape in ((1, 1, 1), (1, 0.25, 0.04), (1, 0, 0)):
        cov = np.diag(np.array(shape, float))
        assert float(iso9283.distance_limit(cov)) == pytest.approx(population(cov), rel=3e-3)  # 0.1 % sigma of chance
    # A normal number in one dimension: E |x| = sqrt(2 / pi).
    mean = np.sqrt(2 / np.pi)
    assert float(iso9283.distance_limit(np.diag([4.0, 0, 0]))) == pytest.approx(
        2 * (mean + 3 * np.sqrt(1 - mean**2)), rel=1e-5
    )


@pytest.mark.parametrize("noise", [1e-4, 1e-6])
def test_what_is_below_the_noise_is_not_resolvable(noise):
    resolved = 0
    for seed in range(100):
        Ts, _, cov = attained(seed, 30, arm=np.zeros(3), noise=noise)
        metric = iso9283.repeatability(Ts[:, :3, 3], cov)
        resolved += metric.clean is not None
        assert 0 < metric.resolvable < metric.raw
        assert metric.low == 0 or metric.clean is not None
        assert metric.high >= metric.resolvable or metric.clean is not None
    assert resolved <= 8  # 2.5 % by chance, a binomial of 100 stays below 8 with 0.1 %


def test_what_could_be_resolved_is_resolved_about_half_the_time():
    resolved = 0
    cov = np.broadcast_to(np.eye(3) * 1e-8, (30, 3, 3))
    least = iso9283.repeatability(np.random.default_rng(0).normal(0, 1e-4, (30, 3)), cov).resolvable
    unit = float(iso9283.distance_limit(np.eye(3)))
    rng = np.random.default_rng(1)
    for _ in range(100):
        p = rng.normal(0, np.hypot(least / unit, 1e-4), (30, 3))
        resolved += iso9283.repeatability(p, cov).clean is not None
    assert 25 < resolved < 75  # the trace is as often above its mean as below it; the freedom is found by trial


@pytest.mark.parametrize(("n", "off", "common"), [(5, 1e-3, 0.0), (30, 0.0, 0.0), (30, 5e-5, 2e-5), (30, 1e-3, 1e-4)])
def test_accuracy_and_distance_hold_their_intervals(n, off, common):
    rng = np.random.default_rng(11)
    metrics, errors, scatters = [], [], []
    command = np.eye(4)
    for _ in range(80):
        p = rng.normal(0, ARM_M, (n, 3)) + off * np.array([0.8, 0.6, 0]) + rng.normal(0, common, 3)
        Ts = np.array([pose(np.eye(3), at) for at in p])
        cov = np.zeros((n, 3, 3))
        metrics.append(iso9283.pose_metrics(Ts, command, cov, np.eye(3) * common**2).AP_m)
        to = rng.normal([0.5, 0, 0], ARM_M[0], (n, 3))
        AD, RD = iso9283.distance_metrics(rng.normal(0, ARM_M[0], (n, 3)), to, 0.5 - off, cov)
        errors.append(AD)
        scatters.append(RD)
    # A length of three parts reaches no further than its largest part's interval by half, and from 0 on.
    covers(metrics, off, 1.5 * np.hypot(mean_width(ARM_M[0], n), 4 * common))
    covers(errors, off, 1.25 * mean_width(ARM_M[0] * np.sqrt(2), n))
    covers(scatters, 3 * ARM_M[0] * np.sqrt(2), (1.25 + 2.5 / n) * chi_width(n) * 3 * ARM_M[0] * np.sqrt(2))


def test_accuracy_over_the_workspace():
    rng = np.random.default_rng(4)
    true = rng.normal(0, 1e-3, (100, 3))
    cov = np.broadcast_to(np.eye(3) * 4e-8, (100, 3, 3))
    mean, largest = np.linalg.norm(true, axis=1).mean(), np.linalg.norm(true, axis=1).max()
    common = np.eye(3) * 9e-8
    found = [
        iso9283.anywhere(true + rng.normal(0, 2e-4, (100, 3)) + rng.normal(0, 3e-4, 3), cov, common) for _ in range(100)
    ]
    covers([f[0] for f in found], mean, 4 * np.hypot(2e-4 / 10, 3e-4))
    covers([f[1] for f in found], largest, 1.25 * 4 * np.hypot(2e-4, 3e-4))
    for metric, its in zip(iso9283.anywhere(true, 0 * cov, common), (mean, largest), strict=True):
        assert metric.raw == metric.clean == pytest.approx(its)
        assert metric.low is metric.high is metric.sigma is None  # attained once, and no sigma: the noise is not known


def test_accuracy_below_its_own_scatter_is_not_resolvable():
    Ts, command, cov = attained(3, 30)
    assert iso9283.pose_metrics(Ts - Ts.mean(axis=0) + command, command, cov).AP_m.clean is None


def test_two_directions_and_distance():
    rng = np.random.default_rng(5)
    a, b = rng.normal(0, 2e-5, (30, 3)), rng.normal([3e-4, 0, 0], 2e-5, (30, 3))
    several = iso9283.multi_directional([a, b])
    assert several.clean == pytest.approx(3e-4, abs=4 * 2e-5 * np.sqrt(2 / 30))
    AD, RD = iso9283.distance_metrics(a, b + np.array([0.5, 0, 0]), 0.5, np.zeros((30, 3, 3)))
    assert AD.clean == pytest.approx(3e-4, abs=4 * 2e-5 * np.sqrt(2 / 30))
    assert RD.clean == pytest.approx(3 * 2e-5 * np.sqrt(2), rel=0.5)
    with pytest.raises(InputError, match="one direction only"):
        iso9283.multi_directional([a])


def test_drift_is_seen():
    t = np.arange(50.0)
    times, wander, largest = iso9283.drift(t, np.outer(t, [1e-5, 0, 0]))
    np.testing.assert_allclose(wander, (times - times[0]) * 1e-5, rtol=1e-9)
    assert largest.raw == pytest.approx(4e-4)
    assert largest.clean is not None
    still = iso9283.drift(t, np.random.default_rng(0).normal(0, 1e-5, (50, 3)))[2]
    assert still.clean is None
    assert still.high < 4e-5
    rng = np.random.default_rng(5)
    steps = np.outer(np.repeat(np.arange(5), 6), [1, 0, 0])
    found = [iso9283.drift(np.arange(30.0), rng.normal(0, 0.5, (30, 3)) + steps)[2] for _ in range(80)]
    covers(found, 4, 1.25 * np.sqrt(2) * mean_width(0.5, 6))


def test_a_path():
    rng = np.random.default_rng(2)
    s = np.linspace(0, 0.4, 40)
    command = np.stack([s, 0 * s, 0 * s], axis=1)
    bow = np.stack([0 * s, 1e-3 * np.sin(np.pi * s / 0.4), 0 * s], axis=1)
    ahead = np.array([2e-3, 0, 0])  # along the path: is no error of the path
    paths = command + bow + ahead + rng.normal(0, 1e-5, (10, 40, 3))
    metrics = path_metrics(paths, command, np.zeros((10, 40, 3, 3)))
    assert metrics.AT_m.clean == pytest.approx(1e-3, abs=4 * 1e-5 / np.sqrt(10))
    # Square to the path two directions of 10 um scatter: RP 3.2 times that, the largest of 40 at most twice as much.
    assert 2e-5 < metrics.RT_m.raw < 7e-5
    with pytest.raises(InputError, match="followed 2 times"):
        path_metrics(paths[:2], command, np.zeros((2, 40, 3, 3)))


def test_a_path_holds_its_interval():
    rng = np.random.default_rng(2)
    s = np.linspace(0, 0.4, 40)
    command = np.stack([s, 0 * s, 0 * s], axis=1)
    bow = np.stack([0 * s, 1e-3 * np.sin(np.pi * s / 0.4), 0 * s], axis=1)
    metrics = []
    for _ in range(60):
        common = rng.normal(0, 1e-4, 3)
        paths = command + bow + common + rng.normal(0, 5e-5, (10, 1, 3)) + rng.normal(0, 1e-5, (10, 40, 3))
        metrics.append(path_metrics(paths, command, np.zeros((10, 40, 3, 3)), np.eye(3) * 1e-8))
    covers([f.AT_m for f in metrics], 1e-3, 1.5 * np.hypot(mean_width(np.hypot(5e-5, 1e-5), 10), 4e-4))
    true = population(np.diag([0, 1, 1]) * (5e-5**2 + 1e-5**2))
    covers([f.RT_m for f in metrics], true, 1.5 * chi_width(10) * true)


def test_a_path_goes_on():
    command = np.array([[0.1, 0, 0], [0.2, 0, 0], [0.2, 0, 0], [0.2, 0, 0], [0.3, 0, 0]])
    with pytest.raises(InputError, match="point 3 the commanded path does not advance"):
        path_metrics(np.repeat(command[None], 3, axis=0), command, np.zeros((3, 5, 3, 3)))


def test_rows_all_alike_show_less_than_the_noise():
    cov = np.broadcast_to(np.eye(3) * 1e-8, (30, 3, 3))
    metric = iso9283.repeatability(np.zeros((30, 3)), cov)
    assert metric.clean is None
    assert metric.sigma is None
    # The trace of 30 positions is known to 1 / sqrt(2 * 87), its 97.5 % is 2 sigmas up.
    least = float(iso9283.distance_limit(np.eye(3) * 1e-8)) * np.sqrt(1.96 * np.sqrt(2 / 87))
    assert metric.high == metric.resolvable == pytest.approx(least, rel=0.05)
    assert iso9283.repeatability(np.zeros((30, 3)), 0 * cov).clean == 0  # known without noise
    RD = iso9283.distance_metrics(np.zeros((30, 3)), np.ones((30, 3)), 1.0, cov)[1]
    assert RD.clean is None
    assert RD.high > 0


@pytest.mark.parametrize("backlash", [(0.0, 0.0), (3e-4, 1e-4)])
def test_backlash_shows_at_the_quadrants(backlash):
    rng = np.random.default_rng(7)
    angle = np.linspace(0, 2 * np.pi, 720, endpoint=False) + 0.004
    ways = []
    for way in (1.0, -1.0):
        p = np.stack([0.1 * np.cos(angle), 0.1 * np.sin(angle), 0 * angle], axis=1)
        speed = way * np.stack([-np.sin(angle), np.cos(angle), 0 * angle], axis=1)
        ways.append(
            p - 0.5 * np.array([*backlash, 0]) * np.sign(speed) + rng.normal(0, 1e-5, p.shape) + [0.4, 0.1, 0.3]
        )
    metrics = circle_metrics(*ways, np.eye(3)[:2])
    for found, true in zip(metrics.backlash_m, backlash, strict=True):
        sigma = (found.high - found.low) / (2 * 1.96)
        assert abs(found.raw - true) < 5 * sigma
        assert sigma < 1e-5
        assert found.sigma == (pytest.approx(sigma, rel=1e-4) if true else None)
        assert (found.clean is not None) == (true > 0)
    # At the jumps both ways differ by the backlash, elsewhere by its share along the radius.
    assert metrics.hysteresis_m.raw == pytest.approx(np.hypot(*backlash), abs=6e-5 if any(backlash) else 3e-5)
    np.testing.assert_allclose(metrics.centre_m, [0.4, 0.1, 0.3], atol=5e-6)
    with pytest.raises(InputError, match=r"300 positions, up to 210\.5 degrees apart"):
        circle_metrics(ways[0][:300], ways[1], np.eye(3)[:2])


def ring(angle_deg):
    a = np.radians(angle_deg)
    return np.stack([0.1 * np.cos(a), 0.1 * np.sin(a), 0 * a], axis=1)


def test_a_reversal_needs_positions_beside_it():
    whole = ring(np.arange(0.5, 360, 1.0))
    asked = ring(np.arange(1.0, 361, 4.0))  # what the message asks for
    circle_metrics(asked, asked, np.eye(3)[:2])
    angle = np.arange(0.5, 360, 1.0)
    few = angle[(angle < 8) | (angle > 32) | (np.abs(angle - 20) < 2)]
    one_position = np.sort(np.append(np.repeat(20.0, 9), angle[(angle < 8) | (angle > 32)]))
    for positions, count in ((few, 4), (one_position, 9)):
        with pytest.raises(
            InputError, match=f"clockwise has {count} positions between 8 and 32 degrees .* of 0 degrees"
        ):
            circle_metrics(ring(positions), whole, np.eye(3)[:2])


@pytest.mark.parametrize("times", [1, 3])
def test_circularity_holds_its_interval_without_a_sigma(times):
    rng, metrics = np.random.default_rng(8), []
    angle = np.tile(np.arange(0, 360, 0.5), times)
    true = ring(angle) * (1 + 2e-3 * np.cos(2 * np.radians(angle)))[:, None]  # an oval, 0.4 mm of circularity
    for _ in range(60):
        ways = [true + rng.normal(0, 1e-4, true.shape) for _ in range(2)]
        metrics.append(circle_metrics(*ways, np.eye(3)[:2]).circularity_m)
    # 8 positions a bin. Below the error's own largest, of two ways of 90, 2 * 3.3 sigmas; above the interval of two means.
    covers(metrics, 4e-4, (2 * 3.3 + 2 * np.sqrt(2)) * 1e-4 / np.sqrt(8 * times))


def test_jumps_that_do_not_agree_are_no_backlash():
    angle = np.linspace(0, 2 * np.pi, 720, endpoint=False) + 0.004
    ways = []
    for kink in (1.0, -1.0):  # a radius that jumps up at 0 degrees one way and down the other: no backlash does that
        r = 0.1 + 5e-4 * kink * (angle < np.pi) * np.cos(angle / 2)
        r = r + np.random.default_rng(1).normal(0, 1e-5, r.shape)
        ways.append(np.stack([r * np.cos(angle), r * np.sin(angle), 0 * angle], axis=1))
    backlash = circle_metrics(*ways, np.eye(3)[:2]).backlash_m[0]
    assert backlash.clean is None
    assert backlash.resolvable > 3e-4


@pytest.mark.parametrize("cov", [None, np.eye(3) * 9e-10])
def test_noise_alone_makes_no_circularity(cov):
    rng, angle, resolved = np.random.default_rng(3), np.linspace(0, 2 * np.pi, 720, endpoint=False), 0
    for _ in range(40):
        ways = [np.stack([0.1 * np.cos(angle), 0.1 * np.sin(angle), 0 * angle], axis=1) for _ in range(2)]
        ways = [p + rng.normal(0, 3e-5, p.shape) for p in ways]
        metrics = circle_metrics(*ways, np.eye(3)[:2], cov)
        resolved += (metrics.circularity_m.clean is not None) + (metrics.hysteresis_m.clean is not None)
    assert resolved <= 8  # of 80; 2.5 % by chance


@pytest.mark.parametrize("normal", [(0, 0, 1), (0, 0, -1), (1, 0, 0), (0.6, 0, -0.8)])
def test_axes_of_a_plane(normal):
    axes = plane_axes(np.array(normal, float))
    np.testing.assert_allclose(axes @ axes.T, np.eye(2), atol=1e-12)
    np.testing.assert_allclose(axes @ normal, 0, atol=1e-12)
    np.testing.assert_allclose(plane_axes(-np.array(normal, float)), axes, atol=1e-12)


@pytest.mark.parametrize("name", ["six_r", "ur10", "irb120", "puma560"])
def test_the_plan_is_within_reach(name):
    arm = open_arm(name)
    plan = plan_check(arm)
    assert len(plan.names) == 5
    assert plan.side_m in CUBES_M
    np.testing.assert_allclose(arm.forward(plan.q), plan.Ts_base_tool, atol=1e-8)
    assert np.all((plan.q > arm.q_min + CLEAR_RAD) & (plan.q < arm.q_max - CLEAR_RAD))
    signs = [
        arm.inverse(T, near=q).signs[np.argmin(np.abs(arm.inverse(T, near=q).q - q).sum(axis=1))].tolist()
        for T, q in zip(plan.Ts_base_tool, plan.q, strict=True)
    ]
    assert all(sign == signs[0] for sign in signs)  # no elbow flips on the way
    off = (plan.Ts_base_tool[1:, :3, 3] - plan.centre) / (plan.side_m / 2)
    np.testing.assert_allclose(np.abs(off), 0.8, atol=1e-9)
    np.testing.assert_allclose(off[:, 0], off[:, 2], atol=1e-9)  # the standard's diagonal plane


def test_the_wide_plan_has_a_hundred_poses():
    plan = plan_check(open_arm("ur5"), wide=True)
    assert len(plan.names) == 100


def test_a_plan_keeps_to_what_is_allowed():
    arm = open_arm("ur10")
    plan = plan_check(arm, wide=True, allowed=lambda Ts: Ts[:, 0, 3] < -0.6)
    assert (plan.Ts_base_tool[:, 0, 3] < -0.6).all()
    with pytest.raises(InputError, match="within reach"):
        plan_check(arm, allowed=lambda Ts: np.zeros(len(Ts), bool))
