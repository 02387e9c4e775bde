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


def arriving(rng, t_s, busy=0.0):
    """When a loop of 4 ms takes images that arrive 30 ms after their exposure, busy for 60 ms now and then."""
    late = np.where(rng.random(len(t_s)) < busy, 0.06, 0.0)
    return np.maximum.accumulate(np.ceil((t_s + 0.03 + late) / 0.004) * 0.004)


@pytest.mark.parametrize(
    ("jump", "says_s"),
    [
        (lambda t: t - 1.0, 1.0),
        (lambda t: t + 1.0, -1.0),
        (lambda t: t - 0.13, 0.13),
        (lambda t: t - 15.0, 15.0),
        (lambda t: 1e6 + t, -1e6),
    ],
    ids=["back", "ahead", "back by less than it may be late", "restarted", "another epoch"],
)
@pytest.mark.parametrize("rate_hz", [10.0, 60.0])
def test_a_clock_that_jumps_is_put_right_before_a_time_is_given(jump, says_s, rate_hz):
    rng, clock = np.random.default_rng(7), FrameClock()
    t_s, stamps = stamped(rng, round(30 * rate_hz), period_s=1 / rate_hz, start_s=0.0, jitter_s=1e-4)
    lied = np.where(t_s > 15.0, jump(stamps), stamps)
    times = [clock.time(*pair) for pair in zip(lied, arriving(rng, t_s, busy=0.05), strict=True)]
    off = np.array([np.nan if each is None else each - t for each, t in zip(times, t_s, strict=True)]) - 0.04
    assert 3 <= np.isnan(off).sum() <= 15  # until four agree, with a loop that is busy
    assert np.nanmax(np.abs(off)) < 1e-3
    assert clock.stepped is not None
    assert clock.stepped[0] == pytest.approx(15.0, abs=5 / rate_hz + 0.1)
    assert clock.stepped[1] == pytest.approx(says_s, abs=1e-3)


def test_single_stamps_that_lie_and_a_loop_that_is_busy_are_no_jump():
    rng, clock = np.random.default_rng(8), FrameClock()
    t_s, stamps = stamped(rng, 1200, period_s=1 / 60, start_s=0.0, jitter_s=1e-4)
    odd = rng.random(len(t_s)) < 0.02
    arrived = arriving(rng, t_s, busy=0.1)
    times = [clock.time(s + 0.7 * o, a) for s, o, a in zip(stamps, odd, arrived, strict=True)]
    assert clock.stepped is None
    assert sum(each is None for each in times[10:]) >= odd[10:].sum()
    assert max(abs(each - t - 0.04) for each, t in zip(times[10:], t_s[10:], strict=True) if each is not None) < 2e-3
    assert clock.time(np.nan, arrived[-1] + 0.02) is None


@pytest.mark.parametrize("rate", [0.01, -0.01, 0.002])
def test_a_clock_of_another_rate_is_put_right(rate):
    rng, clock = np.random.default_rng(9), FrameClock()
    t_s, stamps = stamped(rng, 2400, period_s=1 / 60, start_s=0.0, jitter_s=1e-4)
    times = [clock.time(*pair) for pair in zip((1 + rate) * stamps, arriving(rng, t_s), strict=True)]
    off = np.array([np.nan if each is None else each - t for each, t in zip(times, t_s, strict=True)])
    assert clock.rate == pytest.approx(rate, rel=0.1)
    late = off[1200:][np.isfinite(off[1200:])]
    assert len(late) > 1100
    assert np.ptp(late) < 10e-3  # 200 ms as stamped


def test_stamps_of_single_precision_are_smoothed():
    rng, clock = np.random.default_rng(10), FrameClock()
    t_s, stamps = stamped(rng, 1200, period_s=1 / 60, start_s=0.0, jitter_s=1e-4)
    single = (1e8 + 1e3 * stamps).astype(np.float32).astype(float) / 1e3 - 1e5  # steps of 8 ms
    off = given(clock, single)[400:] - t_s[400:]
    assert np.std(off) < 0.3 * np.std(single[400:] - t_s[400:])


def test_few_images_in_a_second_and_a_slow_loop_are_no_clock_of_another_rate():
    clocks = []
    for seed in range(20):
        rng, clock = np.random.default_rng(seed), FrameClock()
        for second in range(60):  # a loop of 6 ms, which is busy now and then
            for t in 1.2 * second + 0.2 * rng.random() + PERIOD_S * np.arange(2):
                clock.time(t, 6e-3 * np.ceil(t / 6e-3) + 0.02 * rng.choice(2, p=[0.8, 0.2]))
        clocks.append(clock)
    assert [each.stepped for each in clocks] == 20 * [None]
