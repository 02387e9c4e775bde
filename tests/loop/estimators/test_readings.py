"""The memory of the potentiometers: smoothing, hysteresis, what is kept."""

import numpy as np
import pytest
from arm_rig import ARM, states

from armsight.loop.estimators.parabola import LONG_SPAN_S, SPAN_S
from armsight.loop.estimators.readings import GAP_RAD, KEPT_S, STILL_SPAN_S, Readings

SIGMA = 3e-4


def filled(q_of_t, seconds, sigma=1e-9, noise=None):
    readings = Readings(sigma, ARM)
    t = np.arange(round(seconds * 1000)) * 1e-3
    q = q_of_t(t)[:, None] * np.ones(6)
    readings.add(states(t, q if noise is None else q + noise))
    return readings, t


def test_parabolas_pass_unharmed_with_their_slope():
    readings, t = filled(lambda t: 0.3 - 0.7 * t + 2.0 * t**2, 0.5)
    at = np.array([0.0, 0.01, 0.2005, t[-1]])
    out = readings.at(at)
    assert np.allclose(out.q[:, 3], 0.3 - 0.7 * at + 2.0 * at**2, atol=1e-12)
    assert np.allclose(out.qd[:, 3], -0.7 + 4.0 * at, atol=1e-9)


@pytest.mark.parametrize("speed", [0.0, 0.5])
@pytest.mark.parametrize("back_s", [0.0, 0.01, 0.1])
def test_the_variance_left_is_what_is_left(back_s, speed):
    rng = np.random.default_rng(1)
    off, said = [], []
    for _ in range(150):
        readings, t = filled(lambda t: speed * t, 0.4, SIGMA, SIGMA * rng.normal(size=(400, 6)))
        at = t[-1] - back_s
        out = readings.at(np.array([at]))
        off.append(out.q[0] - speed * at)
        said.append(out.variance[0])
    off, said = np.array(off), np.array(said)
    # A joint that stands is averaged but for noise that looks like motion: less than 1% by three sigma of two tests.
    still = said < 2 / (STILL_SPAN_S * 1000)
    assert still.mean() == 0 if speed else still.mean() > 0.99 - 3 * np.sqrt(0.01 / 900)
    counted = still if speed == 0 else ~still
    # The variance of 900 samples is within 5 sqrt(2 / 900) of itself.
    assert np.var(off[counted]) == pytest.approx(SIGMA**2 * said[counted].mean(), rel=5 * np.sqrt(2 / 900))
    # The end of a parabola through N has 9/N, its middle 9/(4N) (to 1/N^2); a mean of M has 1/M.
    assert said.max() < (9.5 if back_s < SPAN_S / 2 else 2.5) / (SPAN_S * 1000)
    assert said[still] == pytest.approx(1 / (STILL_SPAN_S * 1000), rel=0.02)


@pytest.mark.parametrize(("speed", "at_s"), [(0.0, 0.6), (0.5, 0.6)], ids=["standing", "moving"])
def test_what_is_left_of_the_noise_lasts_as_long_as_is_said(speed, at_s):
    """The integral of its correlation over all lags is that of a Gauss-Markov process with this time constant: twice it."""
    rng = np.random.default_rng(12)
    lags = np.arange(-400, 401) * 1e-3
    products, said = np.zeros(len(lags)), []
    for _ in range(60):
        readings, _ = filled(lambda t: speed * t, 1.2, SIGMA, SIGMA * rng.normal(size=(1200, 6)))
        out = readings.at(at_s + lags)
        off = out.q - speed * (at_s + lags)[:, None]
        products += off @ off[len(lags) // 2]
        said.append(out.lasts_s[len(lags) // 2])
    whole = products.sum() * 1e-3 / products[len(lags) // 2]
    # A sum over 0.8 s of 360 samples that last for L: their mean product scatters by sqrt(0.8 / 2 L / 360) of the integral.
    lasts = float(np.mean(said))
    assert whole / 2 == pytest.approx(lasts, rel=4 * np.sqrt(0.8 / (2 * lasts) / 360) + 0.05)
    assert lasts == pytest.approx(
        0.15 if speed == 0 else LONG_SPAN_S / 4.5, rel=0.05
    )  # half of 0.3 s; 4/9 of 0.098 s / 2


def test_a_joint_that_drifts_is_averaged_where_its_readings_lie_around_the_time():
    rng = np.random.default_rng(13)
    # 1 mrad/s: in 0.3 s as much as the noise of one reading.
    readings, _ = filled(lambda t: 1e-3 * t, 1.0, SIGMA, SIGMA * rng.normal(size=(1000, 6)))
    out = readings.at(np.array([0.5]))
    assert (out.variance < 2 / (STILL_SPAN_S * 1000)).all()
    assert np.abs(out.q[0] - 0.5e-3).max() < 4 * SIGMA / np.sqrt(STILL_SPAN_S * 1000)


def test_a_joint_that_begins_to_move_is_not_averaged_over_its_rest():
    readings, t = filled(lambda t: np.where(t > 0.3, 0.5 * (t - 0.3), 0.0), 0.36, SIGMA, 0.0 * np.zeros((360, 6)))
    out = readings.at(t[-1:])
    # Where the window of the parabola lies wholly in the motion, the joint is where it is.
    assert out.q[0] == pytest.approx(np.full(6, 0.5 * (t[-1] - 0.3)), abs=1e-9)
    assert out.qd[0] == pytest.approx(np.full(6, 0.5), abs=1e-6)


def test_the_side_is_the_backlash_operators():
    def q_of_t(t):
        return 0.2 * np.sin(3 * t) + 0.05 * np.sin(11 * t)

    readings, t = filled(q_of_t, 1.9)
    out = readings.at(t)
    held, sides, q = q_of_t(t)[0], [], q_of_t(t)
    for angle in q:
        held = min(max(held, angle - GAP_RAD / 2), angle + GAP_RAD / 2)
        sides.append((angle - held) / (GAP_RAD / 2))
    # The parabola's end is off by q''' SPAN^3 / 120, at most 72 * SPAN^3 / 120 = 7e-5 rad, 0.04 of half a gap.
    # At the very start there are too few readings for a parabola.
    assert np.abs(out.unseen[:, 0, 0] - sides)[50:].max() < 0.1
    travel = np.abs(np.diff(q)).sum()
    assert out.travel[-1, 0] == pytest.approx(travel, rel=1e-2)
    assert (np.diff(out.travel, axis=0) >= 0).all()
    assert (np.diff(out.flips[:, 0], axis=0) >= 0).all()


def test_noise_at_rest_neither_travels_nor_changes_sides():
    rng = np.random.default_rng(2)

    def q_of_t(t):
        u = np.minimum(t / 0.5, 1.0)
        return 0.3 * u**3 * (10 - 15 * u + 6 * u**2)

    readings, t = filled(q_of_t, 2.0, SIGMA, SIGMA * rng.normal(size=(2000, 6)))
    moving, resting = readings.at(np.array([0.5])), readings.at(t[-1:])
    assert moving.unseen[:, 0].min() > 0.99
    assert resting.unseen[:, 0].min() > 0.9
    assert (resting.travel - moving.travel).max() < 10 * SIGMA


def test_what_came_in_parts_is_as_what_came_at_once():
    def q_of_t(t):
        return 0.4 * np.sin(5 * t)

    readings = Readings(1e-9, ARM)
    t = np.arange(20_000) * 1e-3
    for part in np.array_split(t, 700):
        readings.add(states(part, q_of_t(part)[:, None] * np.ones(6)))
    oldest, newest = readings.span_s
    assert newest == t[-1]
    assert newest - oldest >= KEPT_S
    at = np.linspace(newest - KEPT_S, newest, 50)
    assert np.allclose(readings.at(at).q[:, 0], q_of_t(at), atol=5**3 * 0.4 * SPAN_S**3 / 100)
    # One swing to and fro in 2 pi / 5 s travels 1.6 rad.
    assert readings.at(t[-1:]).travel[0, 0] == pytest.approx(np.abs(np.diff(q_of_t(t))).sum(), rel=1e-2)


def test_few_readings_are_averaged_and_one_is_itself():
    readings = Readings(SIGMA, ARM)
    readings.add(states([1.0], np.full((1, 6), 0.2)))
    out = readings.at(np.array([1.0]))
    assert (out.q == 0.2).all()
    assert (out.variance[0] == 1).all()


def test_a_joint_that_crosses_its_backlash_at_once_is_not_smoothed_across_it():
    """Another joint, which moves smoothly, is smoothed as before."""
    rng = np.random.default_rng(5)
    t = np.arange(250) * 4e-3
    moves = np.stack([0.5 * t] * 6, axis=1)
    moves[:, 1] += np.deg2rad(1.0) * np.clip((t - 0.503) / 0.009, 0.0, 1.0)
    readings = Readings(SIGMA, ARM)
    readings.add(states(t, moves + SIGMA * rng.normal(size=moves.shape)))
    at = np.arange(0.42, 0.6, 1e-3)
    out = readings.at(at)
    true = 0.5 * at + np.deg2rad(1.0) * np.clip((at - 0.503) / 0.009, 0.0, 1.0)
    sigma = SIGMA * np.sqrt(out.variance[:, 1])
    assert np.abs(out.q[:, 1] - true).max() < np.deg2rad(0.2)  # across it, half a degree
    assert (np.abs(out.q[:, 1] - true) < 3.5 * sigma).mean() > 0.95
    assert out.variance[:, 0].max() < 0.12


def test_noise_greater_than_is_said_is_smoothed_all_the_same_and_counted():
    rng = np.random.default_rng(6)
    readings, t = filled(lambda t: 0.5 * t, 0.4, SIGMA, 4.0 * SIGMA * rng.normal(size=(400, 6)))
    out = readings.at(t[150:250])
    assert np.median(out.variance) == pytest.approx(16 * 2.25 / (LONG_SPAN_S * 1000), rel=0.2)
    assert np.median(out.lasts_s) == pytest.approx(LONG_SPAN_S / 4.5, rel=0.1)  # as long as that of any white noise


@pytest.mark.parametrize("speed", [0.0, 0.01, 0.03, 0.1])
def test_rounded_readings_are_as_uncertain_as_rounding_leaves_them(speed):
    rng = np.random.default_rng(7)
    step = np.deg2rad(0.088)
    off, said = [], []
    for _ in range(200):
        readings = Readings(np.deg2rad(0.02), ARM, step)
        t = np.arange(200) * 4e-3
        true = speed * t[:, None] + rng.uniform(-step, step, 6)
        readings.add(states(t, step * np.round(true / step)))
        out = readings.at(np.array([t[120]]))
        off.append((out.q[0] - true[120]) / (np.deg2rad(0.02) * np.sqrt(out.variance[0])))
        said.append(out.lasts_s[0])
    assert 0.2 < np.mean(np.square(off)) < 1.5
    assert np.median(said) > 1.0 if speed == 0.0 else np.median(said) < 0.2
