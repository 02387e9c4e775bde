"""A sensor's stream: clock, gaps, stuck values, rest, and the coefficients of its Allan deviation."""

import numpy as np
import pytest

from armsight.errors import InputError
from armsight.loop.references.stream import allan, check_stream, coefficients

PERIOD_S = 0.01


def stream(seconds=20.0, seed=0):
    """Two columns that rest, move from 5 to 8 s, and rest again."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, PERIOD_S)
    z = rng.normal(0.0, 0.01, (len(t), 2)) + np.array([0.0, 9.8])
    moves = (t > 5.0) & (t < 8.0)
    z[moves] += np.sin(7.0 * t[moves])[:, None]
    return t, z


def test_rate_rest_and_nothing_else_of_a_good_stream():
    t, z = stream()
    found = check_stream(t, z, "imu.csv")
    assert found.rate_hz == pytest.approx(100.0)
    assert (found.gaps, found.doubled, found.frozen_s, found.saturated) == (0, 0.0, 0.0, ())
    assert 8.0 <= t[found.rest.start] < 8.6
    assert found.rest.stop * PERIOD_S == pytest.approx(20.0, abs=0.3)


def test_gaps_doubled_frozen_and_saturated_values_are_found():
    t, z = stream()
    keep = (t < 10.0) | (t > 10.4)
    found = check_stream(t[keep], z[keep], "imu.csv")
    assert (found.gaps, round(found.longest_gap_s, 2)) == (1, 0.42)
    assert check_stream(t, np.repeat(z[::2], 2, axis=0), "imu.csv").doubled == pytest.approx(0.5, abs=0.01)
    stuck = z.copy()
    stuck[1200:1300] = stuck[1200]
    assert check_stream(t, stuck, "imu.csv").frozen_s == pytest.approx(0.99)
    assert check_stream(t, np.clip(z, None, [0.8, 20.0]), "imu.csv").saturated == (0,)


def test_a_clock_that_runs_backwards_is_rejected_with_the_reading():
    t, z = stream()
    t[700:] -= 0.5
    with pytest.raises(InputError, match=r"imu.csv: the clock runs backwards by 0.490 s at reading 701, 6.990 s"):
        check_stream(t, z, "imu.csv")


def test_white_noise_and_a_random_walk_come_out_with_their_size():
    rng, count = np.random.default_rng(4), 60_000
    white, walk = 0.02, 0.003  # per sqrt(Hz), and per s sqrt(s)
    z = rng.normal(0.0, white / np.sqrt(PERIOD_S), (count, 1))
    z += np.cumsum(rng.normal(0.0, walk * np.sqrt(PERIOD_S), (count, 1)), axis=0)
    tau, variance, freedom = allan(z, PERIOD_S)
    found = coefficients(tau, variance[:, 0], freedom)
    # 600 s: the variance at 1 s has 600 degrees of freedom, that at 100 s five.
    assert found["random_walk"] == pytest.approx(white, rel=0.05)
    assert found["rate_random_walk"] == pytest.approx(walk, rel=0.4)


def test_an_integral_that_is_rounded_is_quantization():
    step, rng = 0.5, np.random.default_rng(1)
    rate = np.diff(rng.uniform(-step / 2, step / 2, 40_001))[:, None] / PERIOD_S
    tau, variance, freedom = allan(rate, PERIOD_S)
    assert coefficients(tau, variance[:, 0], freedom)["quantization"] == pytest.approx(step / np.sqrt(12), rel=0.1)
