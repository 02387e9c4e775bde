"""Exposures by a blinking LED: its code is the firmware's, the claimed sigma holds, and what is no LED is named."""

import numpy as np
import pytest

from armsight.data import Missed, Shot
from armsight.loop.estimators import Delay
from armsight.loop.sync_led import Brightness, SyncLedWatch, code, estimate_sync, led_findings, light, with_led
from armsight.robot.board_registry import configured
from armsight.robot.boards.configuration import lab_configuration, pin_number
from armsight.robot.boards.emulated import EmulatedLink
from armsight.robot.boards.emulators import open_emulator
from armsight.sim.joints import JointPlant
from armsight.vision.rig import Shutters

BIT_S = 0.003


def test_the_firmware_blinks_the_code_in_step_with_its_ticks():
    config = lab_configuration()
    config["sync_led_pin"], config["sync_led_ticks"] = pin_number("PB13"), 2
    link = EmulatedLink(open_emulator("host"), JointPlant())
    with configured(link, config):
        begin = len(link.sync_led)
        link.step(1200)
    lit = np.frombuffer(bytes(link.sync_led), np.uint8)[begin:]
    np.testing.assert_array_equal(lit, code()[(begin + np.arange(1200)) // 2 % 511])


def test_without_a_pin_nothing_blinks():
    link = EmulatedLink(open_emulator("host"), JointPlant())
    with configured(link, lab_configuration()):
        link.step(100)
    assert not any(link.sync_led)


def test_the_code_is_a_maximum_length_sequence():
    signs = 2 * code() - 1
    assert {round(float(signs @ np.roll(signs, k))) for k in range(1, 511)} == {-1}


def test_light_is_the_integral_of_the_code():
    """Against the slow obvious: samples a hundredth of a bit apart."""
    t_s, exposure_s = np.array([0.0131, 1.5329, 7.7]), 0.0085
    fine = (np.arange(20000) + 0.5) / 20000 - 0.5
    on = code()[np.floor((t_s[:, None] + exposure_s * fine) / BIT_S).astype(int) % 511]
    np.testing.assert_allclose(light(t_s, exposure_s, BIT_S), on.mean(axis=1), atol=1e-4)


def brightness(rng, rate_hz, exposure_s, count, *, jitter_s=0.0, sync_s=0.0, gamma=1.0, lamp=0.0, skew_s=0.0):
    """What two cameras see, and the true delay."""
    start, delay_s = rng.uniform(0.0, 60.0), rng.uniform(0.0, 0.1)
    left = start + np.arange(count) / rate_hz * (1 + 3e-5 * rng.standard_normal())
    right = left + skew_s + rng.uniform(-sync_s, sync_s, count)
    stamp_s = left + delay_s + jitter_s * rng.standard_normal(count)
    kept = rng.random(count) > 0.03
    seen = []
    for t in (left, right):
        shine = lamp * np.sin(2 * np.pi * 100 * t)
        led = (
            20 + 150 * (light(t, exposure_s, BIT_S) + shine) ** gamma
            if gamma == 1
            else 20 + 150 * light(t, exposure_s, BIT_S) ** gamma
        )
        led, around = led + 0.6 * rng.standard_normal(count), 40 * (1 + shine) + 0.1 * rng.standard_normal(count)
        seen.append(Brightness(stamp_s[kept], led[kept], around[kept]))
    return seen, delay_s


@pytest.mark.parametrize(
    ("rate_hz", "exposure_s", "given"),
    [
        (60.0, 0.002, {"jitter_s": 5e-5, "sync_s": 1e-4}),
        (30.0, 0.008, {"jitter_s": 1e-3, "sync_s": 5e-4, "lamp": 0.02}),
        (50.0, 0.030, {"jitter_s": 3e-4, "gamma": 0.6}),
    ],
)
def test_delay_and_skew_are_within_their_sigma(rate_hz, exposure_s, given):
    """The mean square of errors over sigma is that of a chi-square, of 5 times 2 values (99.9%: 29.6)."""
    z = []
    for seed in range(5):
        rng = np.random.default_rng([71, seed])
        skew_s = rng.uniform(-0.02, 0.02)
        seen, delay_s = brightness(rng, rate_hz, exposure_s, 90, skew_s=skew_s, **given)
        found = estimate_sync(*seen, BIT_S)
        assert found.sigma_skew_s < 1.2e-4
        assert found.left.exposure_s == pytest.approx(exposure_s, rel=0.05)
        z += [(found.delay_s - delay_s) / found.sigma_delay_s, (found.skew_s - skew_s) / found.sigma_skew_s]
    assert 1.0 < np.square(z).sum() < 29.6


def test_a_lamp_and_noise_are_no_code():
    rng, t_s = np.random.default_rng(3), np.arange(72) / 60
    for led in (100 + 30 * np.sin(2 * np.pi * 7.3 * t_s), 100 + 9 * rng.standard_normal(72)):
        seen = Brightness(t_s + 5, led, np.full(72, 40.0))
        assert isinstance(estimate_sync(seen, seen, BIT_S), Missed)


def test_exposures_too_short_for_the_code_are_said():
    seen, _ = brightness(np.random.default_rng(4), 50.0, 0.0002, 90)
    found = estimate_sync(*seen, BIT_S)
    assert isinstance(found, Missed)
    assert "set sync_led_ticks to about the exposure" in found.reason


def spots(t_s, exposure_s, *, level=120.0, what=None):
    """An image with an LED of 7 px, and what else blinks."""
    rows, columns = np.indices((96, 128))
    image = 60.0 + np.random.default_rng(round(1e6 * t_s)).normal(0, 2, (96, 128))
    image += (
        level * light(np.array([t_s]), exposure_s, BIT_S) * np.exp(-((rows - 40.3) ** 2 + (columns - 70.6) ** 2) / 8)
    )
    if what is not None:
        image[10:20, 10:20] += 90 * what(t_s)
    return np.clip(image, 0, 255).astype(np.uint8)


def watched(image, *, count=330, skew_s=0.004, late=lambda t: 0.0):
    """What a watch says of shots at 60 Hz, 20 ms late."""
    watch = SyncLedWatch(BIT_S)
    for k in range(count):
        t_s = 12.0 + k / 60.013
        work = watch.take(Shot(str(k), image(t_s), image(t_s + skew_s), t_s + 0.02 + late(t_s)))
        if work is not None:
            work()
    return watch


def test_the_led_is_found_beside_a_lamp_and_followed():
    watch = watched(lambda t: spots(t, 0.004, what=lambda t: np.sin(40 * t)))
    assert len(watch.estimates) == 2
    found = watch.pooled()
    assert abs(found.delay_s - 0.02) < 4 * found.sigma_delay_s < 1e-4
    assert abs(found.skew_s - 0.004) < 4 * found.sigma_skew_s < 1e-4
    np.testing.assert_allclose(watch.row_shares, 40.8 / 96 - 0.5, atol=2e-3)
    assert watch.reason is None
    assert led_findings(watch) == ()


def test_a_bright_led_is_read_by_its_rim():
    found = watched(lambda t: spots(t, 0.004, level=5000.0), count=121).pooled()
    assert abs(found.delay_s - 0.02) < max(4 * found.sigma_delay_s, 1e-4)


def test_stamps_that_come_late_are_a_finding():
    (found,) = led_findings(watched(lambda t: spots(t, 0.004), late=lambda t: 0.002 * (t > 14.1)))
    assert found.cause == "time"
    assert abs(found.size - 2.0) < 4 * found.sigma


@pytest.mark.parametrize(
    ("image", "said"),
    [
        (lambda t: spots(t, 0.004, level=0.0), "left camera: nothing blinks in its images"),
        (lambda t: spots(t, 0.004, level=0.0, what=lambda t: np.sin(40 * t)), "flickers by itself at 6.4 Hz"),
        (
            lambda t: spots(t, 0.004, level=0.0, what=lambda t: 50 * light(np.array([t]), 0.004, BIT_S)),
            "the LED is saturated",
        ),
    ],
)
def test_why_there_is_no_led_is_said(image, said):
    assert said in watched(image, count=121).reason


def test_rows_and_readout_are_taken_out_of_what_the_led_says():
    seen, delay_s = brightness(np.random.default_rng(6), 60.0, 0.004, 90, skew_s=0.0051)
    found, rows = estimate_sync(*seen, BIT_S), np.array([0.25, 0.35])
    by_sweep = Shutters(0.0039, 0.0105, np.diag([2e-4, 1e-4]) ** 2)
    delay, shutters = with_led(Delay(0.0, 3e-4, 1e-5), by_sweep, found, rows)
    assert shutters.skew_s == pytest.approx(0.0051 - 0.1 * 0.0105, abs=3e-5)
    assert delay.delay_s == pytest.approx(delay_s + 0.25 * 0.0105, abs=1e-4)
    assert delay.sigma_s == pytest.approx(0.25e-4, rel=0.2)
    assert with_led(Delay(0.0, 3e-4), None, found, rows)[1].skew_s == found.skew_s
