"""A sensor's stream: clock, gaps, stuck values, rest, and the coefficients of its Allan deviation."""

import numpy as np
import pytest

from armsight.errors import InputError
from armsight.geometry.pose import exp_se3
from armsight.loop.references.stream import SETTLED_M, allan, check_stream, coefficients, settling
from armsight.sim.references.inertial import InertialErrors, record

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


@pytest.mark.parametrize("speed", [0.3, 1.0, 2.0])
def test_a_range_of_a_coarse_step_has_no_rest_and_no_end(speed):
    """Steps of 10 mm, which repeat while the tool goes to and fro by 0.4 m, and then slowly."""
    t = np.arange(0.0, 30.0, 0.02)
    far = 1.0 + 0.2 * np.sin(speed * t) + 0.05 * np.sin(1.7 * speed * t)
    found = check_stream(t, np.round(far, 2)[:, None], "wire.csv")
    assert (found.saturated, found.rests) == ((), ())
    noise = np.random.default_rng(6).normal(0.0, 1e-3, (len(t), 1))
    at_end = check_stream(t, np.minimum(far[:, None] + noise, 1.15), "wire.csv")
    assert at_end.saturated == (0,)  # which no step explains


def test_a_coarse_axis_is_not_saturated():
    rng = np.random.default_rng(2)
    t = np.arange(0.0, 20.0, PERIOD_S)
    z = np.round(rng.normal(0.0, 0.8, (len(t), 3)) + np.array([0.0, 0.3, 5.0]))
    assert check_stream(t, z, "imu.csv").saturated == ()


@pytest.mark.parametrize(
    ("hz", "damping", "amplitude_m"),
    [(18.1, 0.036, 6.2e-5), (7.6, 0.034, 3.6e-4), (23.9, 0.05, 5.3e-4), (38.2, 0.061, 4.9e-4), (6.3, 0.03, 6.4e-5)],
)
def test_a_vibration_after_stops_is_found_and_none_where_there_is_none(hz, damping, amplitude_m):
    t = np.arange(0.0, 14.0, 1e-3)
    x, swings, w = np.zeros(len(t)), np.zeros(len(t)), 2 * np.pi * hz
    for sign, stop in ((1, 2.0), (-1, 6.0), (1, 10.0)):
        u, after = np.clip((t - stop + 1.2) / 1.2, 0.0, 1.0), np.maximum(t - stop, 0.0)
        x += sign * 0.2 * (10 * u**3 - 15 * u**4 + 6 * u**5)
        swings += np.exp(-damping * w * after) * np.sin(w * np.sqrt(1 - damping**2) * after)
    xi, hum = np.zeros((len(t), 6)), np.repeat([1e-3, 0.02], 3)  # of motors, which no stop begins or ends
    errors = InertialErrors(rate_hz=1000.0, bandwidth_hz=250.0, noise=np.full(6, 7e-4), hum=hum, hum_hz=97.0)
    for size in (amplitude_m, 0.0):
        xi[:, 0], xi[:, 5] = x + size * swings, 0.5 * x
        t_s, z = record(t, exp_se3(xi), errors, np.random.default_rng(1))
        found = settling(t_s, z[:, 3:], check_stream(t_s, z, "imu.csv").rests)
        if size:
            assert (found.stops, found.frequency_hz) == (3, pytest.approx(hz, rel=0.01))
            assert found.damping == pytest.approx(damping, rel=0.05)
            assert found.amplitude_m == pytest.approx(size, rel=0.1)
            late_s = 0.01 + 0.01 / (damping * w)  # 1 % of amplitude by noise; much where it decays slowly
            assert found.time_s == pytest.approx(np.log(size / SETTLED_M) / (damping * w), abs=late_s)
        else:
            assert found is None
