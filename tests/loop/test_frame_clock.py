"""Stamps that jitter: the line through them, frames that are lost, stamps that lie, rates that change."""

import numpy as np
import pytest

from armsight.loop.frame_clock import MEMORY, FrameClock

PERIOD_S, JITTER_S = 1 / 29.97, 1e-3


def stamped(rng, count, *, period_s=PERIOD_S, start_s=5.0, lost=0.0, jitter_s=JITTER_S):
    """Times of frames that arrive, and their stamps, 40 ms late on average."""
    t_s = start_s + period_s * np.arange(count)[rng.random(count) >= lost]
    return t_s, t_s + 0.04 + jitter_s * rng.standard_normal(len(t_s))


def given(clock, stamps):
    return np.array([clock.time(t) for t in stamps])


@pytest.mark.parametrize("lost", [0.0, 0.3])
def test_most_of_the_jitter_goes_and_the_delay_stays(lost):
    left = []
    for seed in range(10):
        t_s, stamps = stamped(np.random.default_rng(seed), 600, lost=lost)
        clock = FrameClock()
        errors = given(clock, stamps)[200:] - t_s[200:] - 0.04
        left.append(np.sqrt(np.mean(errors**2)))
        assert clock.period_s == pytest.approx(PERIOD_S, rel=1e-3)
        assert clock.jitter_s == pytest.approx(JITTER_S, rel=0.35)
    assert np.sqrt(np.mean(np.square(left))) < (1.3 if lost == 0 else 1.7) * JITTER_S * np.sqrt(4 / MEMORY)


def test_its_first_time_is_that_of_the_line_of_least_squares():
    _, stamps = stamped(np.random.default_rng(1), 8)
    times = given(FrameClock(), stamps)
    assert (times[:7] == stamps[:7]).all()
    assert times[7] == pytest.approx(np.polyval(np.polyfit(np.arange(8), stamps, 1), 7), abs=1e-12)


def test_frames_that_are_asked_for_in_short_spells_keep_their_delay():
    for seed in range(20):
        rng = np.random.default_rng(seed)
        t_s, stamps = stamped(rng, 3000)
        asked = np.arange(3000) % 27 < 4  # a few frames, then none for most of a second
        asked[2400:] = True
        clock = FrameClock()
        errors = (given(clock, stamps[asked]) - t_s[asked] - 0.04)[-500:]
        assert abs(errors.mean()) < 0.3 * JITTER_S
        assert np.sqrt(np.mean(errors**2)) < 0.4 * JITTER_S


def test_a_period_that_drifts_is_followed():
    rng = np.random.default_rng(2)
    t_s = np.cumsum(PERIOD_S * (1 + np.linspace(0.0, 2e-4, 3000)))
    errors = given(FrameClock(), t_s + JITTER_S * rng.standard_normal(3000))[200:] - t_s[200:]
    assert np.sqrt(np.mean(errors**2)) < 0.5 * JITTER_S


def test_a_single_stamp_that_lies_is_put_right():
    t_s, stamps = stamped(np.random.default_rng(3), 300)
    stamps[200] += 0.015
    assert abs(given(FrameClock(), stamps)[200] - t_s[200] - 0.04) < 1e-3


def test_another_rate_begins_anew():
    rng = np.random.default_rng(4)
    t_s, stamps = stamped(rng, 200)
    slow_s, late = stamped(rng, 300, period_s=0.0503, start_s=t_s[-1] + 0.05)
    clock = FrameClock()
    given(clock, stamps)
    errors = given(clock, late) - slow_s - 0.04
    assert np.abs(errors).max() < 0.02  # until the rate is known again the stamps themselves, or the line's time twice
    assert (np.abs(errors) > 5 * JITTER_S).sum() <= 2
    assert np.sqrt(np.mean(errors[150:] ** 2)) < 0.5 * JITTER_S
    assert clock.period_s == pytest.approx(0.0503, rel=1e-3)


def test_frames_that_have_no_period_keep_their_stamps():
    for seed in range(10):
        stamps = np.cumsum(np.random.default_rng(seed).uniform(0.01, 0.2, 200))
        assert np.isclose(given(FrameClock(), stamps), stamps).mean() > 0.9


def test_stamps_that_do_not_rise_begin_anew():
    clock = FrameClock()
    given(clock, np.arange(20) * 0.03)
    assert clock.time(0.1) == 0.1
    assert clock.period_s == 0.0
