"""The filter against a world with known errors: how near it comes, whether it knows, and what it does with the odd."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from arm_rig import (
    ARM,
    MIDDLE,
    TICK_S,
    Wander,
    distance_mm,
    legs,
    mounts,
    off,
    rms,
    run,
    sampled,
    seen,
    small,
    states,
    worn,
)
from scipy.stats import chi2

from armsight.loop.estimators import Delay, KalmanEstimator, Mounting, Outcome, PoseMeasurement, Prior

#: Chance with which a consistent filter fails a test of consistency here.
CHANCE = 1e-4


#: An arm whose links do not swing in their backlash: what potentiometers leave open is smooth.
QUIET = Prior(rest_rad=float(np.deg2rad(0.02)), rest_travel_rad=0.5)


def kalman(delay_s=0.0, sigma_s=2e-4, jitter_s=0.0, prior=None):
    return KalmanEstimator(ARM, prior=prior, delay=Delay(delay_s, sigma_s, jitter_s))


@pytest.mark.parametrize(
    ("world", "prior"),
    [(worn, None), (worn, QUIET), (lambda rng: sampled(rng, QUIET), QUIET)],
    ids=["worn", "worn quiet", "sampled quiet"],
)
def test_in_motion_and_through_half_a_second_without_vision_it_is_as_near_as_it_must(world, prior):
    fused, blind, alone = [], [], []
    for seed in (11, 12):
        rng = np.random.default_rng(seed)
        shaft = legs(rng, 10.0)
        track, Ts = run(rng, kalman(prior=prior), world(rng), shaft, blind=[(8.0, 8.5), (9.3, 9.8)])
        apart, t = distance_mm(track.Ts_base_tool, Ts), track.t_s
        fused.append(apart[(t > 3.0) & (track.vision_age_s < 0.1)])
        # A measurement comes 40 ms late, so it is without news from 8.04 to 8.54.
        blind.append(apart[((t > 8.04) & (t < 8.54)) | ((t > 9.34) & (t < 9.84))])
        alone.append(distance_mm(ARM.forward(shaft), Ts))
    # What the hand-eye calibration is off is in these, 0.12 mm.
    assert rms(np.concatenate(fused)) <= 0.25
    assert rms(np.concatenate(blind)) <= 0.5
    assert rms(np.concatenate(alone)) > 2.0


def nees(errors, covs):
    return np.einsum("ni,ni->n", errors, np.linalg.solve(covs, errors[..., None])[..., 0])


def test_it_is_consistent_in_motion_and_without_vision():
    errors, covs = {"seeing": [], "blind": []}, {"seeing": [], "blind": []}
    for seed in range(16):
        rng = np.random.default_rng(1000 + seed)
        late_s = rng.normal() * 1e-3
        estimator = kalman(0.03, 1e-3, 2e-4)
        track, Ts = run(
            rng, estimator, sampled(rng), legs(rng, 2.0), late_s=0.03 + late_s, jitter_s=2e-4, blind=[(1.5, 9.0)]
        )
        for name, row in (("seeing", 1499), ("blind", 1999)):
            errors[name].append(off(track.Ts_base_tool[row], Ts[row]))
            covs[name].append(track.covs[row])
    for name in errors:
        squares = nees(np.array(errors[name]), np.array(covs[name]))
        low, high = chi2.ppf([CHANCE / 2, 1 - CHANCE / 2], 6 * len(squares))
        assert low < squares.sum() < high, f"{name}: mean NEES {squares.mean():.2f}, six is right"


def test_at_rest_it_is_no_worse_than_vision():
    ratios = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        true, said = mounts(rng)
        exact = Mounting(true[0], true[1], said.cov)
        track, Ts = run(rng, kalman(), worn(rng), legs(rng, 3.0, pause_s=1.0), mount=(true, exact))
        rest = (track.t_s > 2.0) & (np.abs(track.qd).max(axis=1) < 0.05)
        ratios.append(rms(distance_mm(track.Ts_base_tool, Ts)[rest]))
    assert rms(ratios) <= np.sqrt(3) * 0.1 * 1.01  # one shot's noise, 0.1 mm an axis, as carried to the tool at least


def test_it_learns_backlash_and_delay():
    rng = np.random.default_rng(7)
    arm = worn(rng)
    estimator = kalman(0.030, 2e-3)
    run(rng, estimator, arm, legs(rng, 8.0), late_s=0.0316)
    learned = estimator.learned()
    # Before anything was seen each width was known to 0.28 degrees; an eighth of that.
    assert rms(np.degrees(learned.backlash - arm.backlash)) < 0.035
    assert learned.delay.delay_s == pytest.approx(0.0316, abs=4 * learned.delay.sigma_s + 1.5e-4)
    assert learned.delay.sigma_s < 3e-4
    assert (np.abs(learned.side) <= 1).all()
    assert (learned.sigma_joint_offset > 0).all()


def measurements(rng, seconds=2.0, rate_hz=60.0):
    """A motion at rest and moving, its readings, and what vision saw of it."""
    arm, shaft = worn(rng), legs(rng, seconds, pause_s=0.1)
    true, mounting = mounts(rng)
    Ts = arm.tool(shaft)
    rows = np.arange(20, len(shaft), int(1000 / rate_hz))
    return shaft, [mounting.pose_measurement(seen(rng, Ts[k], true), k * TICK_S) for k in rows], Ts


def fed(shaft):
    estimator = kalman()
    estimator.joints(states(np.arange(len(shaft)) * TICK_S, shaft))
    return estimator


def test_order_of_arrival_does_not_matter():
    shaft, seen_all, _ = measurements(np.random.default_rng(3))
    straight, crossed = fed(shaft), fed(shaft)
    for pose_measurement in seen_all:
        assert straight.vision(pose_measurement) is Outcome.USED
    for k in range(0, len(seen_all), 5):
        for pose_measurement in seen_all[k : k + 5][::-1]:
            assert crossed.vision(pose_measurement) is Outcome.USED
    a, b = straight.estimate(), crossed.estimate()
    assert np.allclose(a.T_base_tool, b.T_base_tool, atol=1e-9)
    assert np.allclose(a.cov, b.cov, rtol=1e-6, atol=1e-14)


@pytest.mark.parametrize("period_s", [0.1, TICK_S])
def test_readings_far_apart_and_measurements_of_one_time_leave_numbers(period_s):
    estimator, T = kalman(), ARM.forward(MIDDLE)
    estimator.joints(states(np.arange(12) * period_s, np.tile(MIDDLE, (12, 1))))
    pose_measurement = PoseMeasurement(10 * period_s, T, 1e-8 * np.eye(6), np.zeros((6, 6)))
    assert [estimator.vision(pose_measurement) for _ in range(3)] == [Outcome.USED] * 3
    for estimate in (estimator.estimate(), estimator.estimate(10 * period_s)):
        assert np.isfinite(estimate.T_base_tool).all()
        assert np.isfinite(estimate.cov).all()
    assert np.isfinite(estimator.smoothed(np.array([10.0 * period_s])).covs).all()


def test_a_measurement_older_than_what_is_kept_comes_too_late_and_one_from_the_future_waits():
    shaft, seen_all, _ = measurements(np.random.default_rng(4))
    estimator = kalman()
    half = len(shaft) // 2
    t = np.arange(len(shaft)) * TICK_S
    estimator.joints(states(t[:half], shaft[:half]))
    late, *rest = seen_all
    now = [pose_measurement for pose_measurement in rest if pose_measurement.t_s <= t[half - 1]]
    for pose_measurement in now:
        estimator.vision(pose_measurement)
    assert estimator.vision(rest[len(now) + 2]) is Outcome.WAITING
    age = estimator.estimate().vision_age_s
    estimator.joints(states(t[half:], shaft[half:]))
    assert estimator.estimate(float(t[half - 1])).vision_age_s < age  # the one that waited is in
    for pose_measurement in rest[len(now) :]:
        estimator.vision(pose_measurement)
    assert estimator.vision(late) is Outcome.TOO_LATE


def test_mistaken_poses_are_left_out_and_do_no_harm():
    rng = np.random.default_rng(5)
    shaft, seen_all, Ts = measurements(rng)
    estimator, outcomes = fed(shaft), []
    for k, pose_measurement in enumerate(seen_all):
        if k % 7 == 3:  # flipped, shifted, or the reflection of another marker: never the same way twice
            wrong = pose_measurement.T_base_tool @ small(rng.normal(size=6) * [0.02, 0.02, 0.02, 0.3, 0.3, 0.3])
            pose_measurement = type(pose_measurement)(
                pose_measurement.t_s, wrong, pose_measurement.cov_noise, pose_measurement.cov_common
            )
        outcomes.append(estimator.vision(pose_measurement))
    wrongs = np.arange(len(seen_all)) % 7 == 3
    assert all((v is Outcome.OUTLIER) == w for v, w in zip(outcomes, wrongs, strict=True))
    assert distance_mm(estimator.estimate().T_base_tool, Ts[-1]) < 1.0


def test_when_vision_insists_it_is_used_again():
    shaft, seen_all, Ts = measurements(np.random.default_rng(6))
    estimator, bump = fed(shaft), small([0.006, -0.004, 0.005, 0.01, 0.005, -0.008])
    outcomes = []
    for k, pose_measurement in enumerate(seen_all):
        moved = (
            bump @ pose_measurement.T_base_tool if k >= 40 else pose_measurement.T_base_tool
        )  # something knocked the arm's foot
        outcomes.append(
            estimator.vision(
                type(pose_measurement)(
                    pose_measurement.t_s, moved, pose_measurement.cov_noise, pose_measurement.cov_common
                )
            )
        )
    assert Outcome.REOPENED in outcomes[40:50]
    assert distance_mm(estimator.estimate().T_base_tool, bump @ Ts[-1]) < 1.0


def test_long_rest_leaves_a_covariance_that_is_one():
    rng = np.random.default_rng(8)
    true, mounting = mounts(rng)
    T = worn(rng).tool(MIDDLE[None])[0]
    estimator = kalman()
    for second in range(20):
        t = second + np.arange(1000) * TICK_S
        estimator.joints(states(t, MIDDLE + rng.normal(size=(1000, 6)) * 3.5e-4))
        for t_s in second + np.arange(0.01, 0.99, 1 / 30):
            assert estimator.vision(mounting.pose_measurement(seen(rng, T, true), t_s)) is Outcome.USED
    estimate = estimator.estimate()
    assert np.linalg.eigvalsh(estimate.cov_own).min() > 0
    assert off(estimate.T_base_tool, T) @ np.linalg.solve(estimate.cov, off(estimate.T_base_tool, T)) < chi2.isf(
        1e-5, 6
    )


def test_the_test_rig_wanders_as_it_says():
    rng = np.random.default_rng(9)
    at = np.arange(0, 70, 3.0)
    values = np.array([Wander(rng, 2.0, 0.5, 4).pose(at) for _ in range(20)])
    assert values.std() == pytest.approx(2.0, rel=5 / np.sqrt(2 * values.size))


def test_for_the_record_the_measurements_that_follow_are_heard_too():
    rng = np.random.default_rng(14)
    shaft, seen_all, Ts = measurements(rng, seconds=1.9)
    estimator, now, later, noted = fed(shaft), [], [], []
    estimator.vision(seen_all[0])
    for a, b in pairwise(seen_all):
        t_s = np.arange(round(a.t_s / TICK_S) + 1, round(b.t_s / TICK_S)) * TICK_S
        now.append(estimator.track(t_s))
        noted += estimator.intervals(t_s[:3])  # as no measurement came after them yet
        estimator.vision(b)
        later.append(estimator.smoothed(t_s))
        noted += estimator.intervals(t_s[3:])
    # Reckoned later, all at once: the same, whatever was heard since.
    late, parts = estimator.blended(noted), (slice(3), slice(3, None))
    for field in ("t_s", "Ts_base_tool", "covs", "covs_own", "q", "qd", "vision_age_s"):
        pairs = [both for pair in zip(now, later, strict=True) for both in zip(pair, parts, strict=True)]
        at_once = [getattr(track, field)[rows] for track, rows in pairs]
        assert getattr(late, field) == pytest.approx(np.concatenate(at_once), rel=1e-12, abs=1e-16)
    rows = np.rint(np.concatenate([track.t_s for track in now]) / TICK_S).astype(int)
    apart = [distance_mm(np.concatenate([track.Ts_base_tool for track in way]), Ts[rows]) for way in (now, later)]
    assert rms(apart[1][300:]) < rms(apart[0][300:])
    assert np.linalg.eigvalsh(later[-1].covs_own).min() > 0


def standing(seed, seconds=3.0):
    """Readings, measurements and true poses of an arm that trembles slowly at rest, with noisy readings."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(seconds * 1000)) * TICK_S
    shaft = MIDDLE + 6e-5 * np.sin(2 * np.pi * rng.uniform(3, 7, 6) * t[:, None] + rng.uniform(0, 6, 6))
    Ts, sigma = ARM.forward(shaft), np.repeat([1e-5, 1e-4], 3)
    at = np.arange(20, len(t) - 100, 1000 / 60).astype(int)
    seen_at = [
        PoseMeasurement(t[k], Ts[k] @ small(sigma * rng.normal(size=6)), np.diag(sigma**2), np.zeros((6, 6)))
        for k in at
    ]
    return t, shaft + Prior().reading_rad * rng.normal(size=shaft.shape), seen_at, Ts


def test_what_cameras_see_better_is_not_spoilt_by_the_readings_noise():
    creeping = Prior(creep_rad=float(np.deg2rad(0.05)))
    for seed in range(2):
        t, q, seen_at, Ts = standing(seed)
        estimator, record, coming = kalman(prior=creeping), [], seen_at.copy()
        for n in range(0, len(t), 4):
            estimator.joints(states(t[n : n + 4], q[n : n + 4]))
            while coming and coming[0].t_s + 0.013 <= t[n]:
                estimator.vision(coming.pop(0))
            if n >= 1600:
                record.append(estimator.smoothed(t[n - 600 : n - 596]))
        rows = np.rint(np.concatenate([track.t_s for track in record]) / TICK_S).astype(int)
        apart = distance_mm(np.concatenate([track.Ts_base_tool for track in record]), Ts[rows])
        # One shot's position is off by 0.017 mm. Smoothed readings alone scatter by 0.05 mrad a joint, half a metre away.
        assert rms(apart) < 1.1e3 * np.sqrt(3) * 1e-5


def test_what_a_measurement_taught_stays_as_its_readings_are_smoothed_anew():
    shaft, seen_all, _ = measurements(np.random.default_rng(15))
    seen_all = [
        replace(pose_measurement, t_s=pose_measurement.t_s + 0.5 * TICK_S) for pose_measurement in seen_all
    ]  # between two readings
    rng, t = np.random.default_rng(16), np.arange(len(shaft)) * TICK_S
    said = states(t, shaft + Prior().reading_rad * rng.normal(size=shaft.shape))
    for k in range(60, 100, 7):
        upto, at = round(seen_all[k].t_s / TICK_S) + 14, np.array([seen_all[k].t_s])
        estimator = kalman(sigma_s=1e-9)
        estimator.joints(states(t[:upto], said.q[:upto]))
        for pose_measurement in seen_all[: k + 1]:
            estimator.vision(pose_measurement)
        then = estimator.track(at)
        estimator.joints(states(t[upto : upto + 60], said.q[upto : upto + 60]))
        now = estimator.track(at)
        # Joints are where they were but for the slope of linearity and compliance, some 0.01, over what smoothing moved
        # them by.
        moved_mm = distance_mm(then.Ts_base_tool, now.Ts_base_tool)[0]
        assert moved_mm < 0.01 * np.abs(now.q - then.q).sum() * 1e3


def test_a_delay_that_is_not_to_be_learned_stays_and_counts():
    rng = np.random.default_rng(17)
    delay = Delay(0.03, 3e-4, 1e-4)
    estimator = KalmanEstimator(ARM, delay=delay, learns_delay=False)
    track, Ts = run(rng, estimator, worn(rng), legs(rng, 4.0), late_s=0.0303, jitter_s=1e-4)
    learned = estimator.learned().delay
    assert (learned.delay_s, learned.sigma_s) == pytest.approx((0.03, 3e-4), rel=1e-12)
    fast = int(np.argmax(np.linalg.norm(np.diff(Ts[2000:, :3, 3], axis=0), axis=1))) + 2000
    speed = (Ts[fast + 1] - Ts[fast - 1])[:3, 3] / (2 * TICK_S)
    way = Ts[fast][:3, :3].T @ speed / np.linalg.norm(speed)
    assert way @ track.covs[fast, :3, :3] @ way > (3e-4 * np.linalg.norm(speed)) ** 2
    assert np.linalg.eigvalsh(track.covs_own).min() > 0
