"""The camera's delay from a sweep: how near, and what is rejected."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from arm_rig import ARM, MIDDLE, TICK_S, mounts, sampled, seen, states, worn

from armsight.errors import CalibrationError, InputError
from armsight.geometry.pose import exp_se3, transform
from armsight.loop.delay import estimate_delay, time_between
from armsight.loop.estimators import Prior
from armsight.tables.poses import PoseTable


def sweep(rng, world, late_s, rate_hz, amplitude_deg=12.0):
    """Six seconds of all joints to and fro at different speeds, from rest to rest; what came late by so much."""
    t = np.arange(6000) * TICK_S
    ramp = np.clip(t - 0.5, 0, 1) * np.clip((5.3 - t) / 0.8, 0, 1)
    swing = np.sin(2 * np.pi * rng.uniform(0.4, 0.9, 6) * t[:, None]) * (ramp**2 * (3 - 2 * ramp))[:, None]
    shaft = MIDDLE + np.radians(amplitude_deg) * swing
    Ts = world(rng).tool(shaft)
    true, mounting = mounts(rng)
    rows = np.arange(700, 5200, 1000 / rate_hz).astype(int)
    measurements = [mounting.pose_measurement(seen(rng, Ts[k], true), t[k] + late_s) for k in rows]
    return states(t, shaft + rng.normal(size=shaft.shape) * Prior().reading_rad), measurements


@pytest.mark.parametrize(("world", "late_s", "rate_hz"), [(worn, 0.085, 60), (worn, 0.02, 15), (sampled, 0.3, 30)])
def test_it_is_found_to_a_fraction_of_a_millisecond(world, late_s, rate_hz):
    joints, measurements = sweep(np.random.default_rng(rate_hz), world, late_s, rate_hz)
    delay = estimate_delay(ARM, joints, measurements)
    assert delay.sigma_s < 8e-4
    assert delay.delay_s == pytest.approx(late_s, abs=4 * delay.sigma_s)


def test_how_far_stamps_scatter_is_reported():
    rng = np.random.default_rng(7)
    joints, measurements = sweep(rng, worn, 0.03, 50)
    jitter_s = 3e-4
    late = [replace(s, t_s=s.t_s + rng.normal() * jitter_s) for s in measurements]
    lost = [s for n, s in enumerate(late) if n % 7]  # a shot that is missed is no jitter
    # The median of 190 distances gives it to 8 %; with 0.4 ms between the exposures their middle is off by half of that.
    assert estimate_delay(ARM, joints, lost).jitter_s == pytest.approx(jitter_s, rel=0.25)
    assert estimate_delay(ARM, joints, late, sync_s=4e-4).jitter_s == pytest.approx(np.hypot(3e-4, 2e-4), rel=0.25)
    assert estimate_delay(ARM, joints, measurements).jitter_s < 1e-9
    # Stamps of whole milliseconds of a camera at 60 Hz are off by up to half of one.
    joints, measurements = sweep(rng, worn, 0.03, 60)
    assert estimate_delay(ARM, joints, measurements).jitter_s == pytest.approx(1e-3 / np.sqrt(12), rel=0.3)


def test_its_sigma_is_honest():
    scores = []
    for seed in range(6):
        rng = np.random.default_rng(50 + seed)
        late_s = rng.uniform(0, 0.1)
        delay = estimate_delay(ARM, *sweep(rng, sampled, late_s, 15))
        scores.append((delay.delay_s - late_s) / delay.sigma_s)
    # A sum of six squares of one sigma is below 24.1 but for 1 in 2000.
    assert np.square(scores).sum() < 24.1


def test_a_camera_ahead_of_the_joints_clock_is_found_too():
    joints, measurements = sweep(np.random.default_rng(2), worn, -0.04, 30)
    delay = estimate_delay(ARM, joints, measurements)
    assert delay.delay_s == pytest.approx(-0.04, abs=4 * delay.sigma_s)


def test_an_arm_that_hardly_moves_is_rejected():
    joints, measurements = sweep(np.random.default_rng(3), worn, 0.03, 15, amplitude_deg=0.05)
    with pytest.raises(CalibrationError, match="move all joints to and fro, faster"):
        estimate_delay(ARM, joints, measurements)


def test_another_arms_motion_is_rejected():
    joints, _ = sweep(np.random.default_rng(4), worn, 0.03, 30)
    _, measurements = sweep(np.random.default_rng(5), worn, 0.03, 30)
    with pytest.raises(CalibrationError, match="do not describe the same motion"):
        estimate_delay(ARM, joints, measurements)


def test_too_little_is_rejected():
    joints, measurements = sweep(np.random.default_rng(6), worn, 0.03, 30)
    with pytest.raises(InputError, match="20 or more pose measurements in order of time, got 10"):
        estimate_delay(ARM, joints, measurements[:10])
    with pytest.raises(InputError, match="20 or more pose measurements in order of time"):
        estimate_delay(ARM, joints, measurements[::-1])
    with pytest.raises(InputError, match="do not cover the pose measurements"):
        estimate_delay(ARM, states(joints.t_s[:2000], joints.q[:2000]), measurements)


def two_tables(rng, late_s, move, bent=1e-3, seconds=12.0):
    """What two rigs measure of one motion: at 30 and 25 Hz, noise of 0.05 mm, 0.15 in depth, lenses that bend space."""
    tables = []
    for t, clock in ((np.arange(0, seconds, 1 / 30), 0.0), (np.arange(0.77, seconds + 1.3, 1 / 25), late_s)):
        p = transform(exp_se3(rng.normal(size=6)), move(t))
        p = p * (1 + bent * rng.normal()) + 20 * bent * (p - p.mean(axis=0))[:, :1] * (p - p.mean(axis=0))
        Ts = np.tile(np.eye(4), (len(t), 1, 1))
        Ts[:, :3, 3] = p + 5e-5 * np.array([1.0, 1.0, 3.0]) * rng.normal(size=p.shape)
        tables.append(PoseTable(Path("poses.csv"), np.arange(len(t)), Ts, t_s=t + clock))
    return tables


def test_two_rigs_agree_on_time_within_their_sigma():
    """Student's with 7 freedoms: the mean of 30 squares over sigma is 1.4 with a scatter of 0.5 (its fourth moment)."""
    squares = []
    for seed in range(100, 130):
        rng = np.random.default_rng(seed)
        f, phase, size = rng.uniform(0.15, 0.7, (3, 3)), rng.uniform(0, 6.3, (3, 3)), rng.uniform(0.02, 0.06, (3, 3))
        late = rng.uniform(-1e3, 1e3)

        def move(t, f=f, phase=phase, size=size):
            return (size * np.sin(2 * np.pi * f * t[:, None, None] + phase)).sum(axis=2)

        found = time_between(*two_tables(rng, late, move))
        assert found.sigma_s < 2e-4
        squares.append(((found.delay_s - late) / found.sigma_s) ** 2)
    assert 0.4 < np.mean(squares) < 2.4


def test_a_motion_that_shows_no_time_is_rejected():
    rng, w = np.random.default_rng(3), 2 * np.pi * np.array([1.0, 2.0, 1.0])
    periodic = two_tables(rng, 5.0, lambda t: 0.05 * np.sin(w * t[:, None] + np.array([0.0, 0.4, 1.5])))
    first, second = two_tables(rng, 5.0, lambda t: np.zeros((len(t), 3)))
    with pytest.raises(CalibrationError, match="repeats itself"):
        time_between(*periodic)
    with pytest.raises(CalibrationError, match=r"moved by 0\.\d+ mm RMS, .* was at rest"):
        time_between(first, second)
    f = rng.uniform(0.15, 0.7, (2, 3))
    moving = [two_tables(rng, 5.0, lambda t, f=f: 0.05 * np.sin(2 * np.pi * f * t[:, None])) for f in f]
    with pytest.raises(CalibrationError, match="they saw different motions"):
        time_between(moving[0][0], moving[1][1])
    with pytest.raises(InputError, match="a column t_s is needed"):
        time_between(first, replace(second, t_s=None))
