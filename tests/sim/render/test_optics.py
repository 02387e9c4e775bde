"""The lens and the sensor, by what they must keep and by the statistics of their noise."""

import numpy as np
import pytest

from armsight.errors import InputError
from armsight.sim.render.background import BACKGROUNDS
from armsight.sim.render.optics import Optics, Sensor, exposed, psf_taps, shaded

pytestmark = pytest.mark.opencv


@pytest.mark.parametrize("sigma", [0.7, 1.0, 2.0])
@pytest.mark.parametrize("parts", [1, 4])
def test_the_blur_keeps_all_light_and_its_position(sigma, parts):
    taps = psf_taps(sigma, parts)
    np.testing.assert_allclose(taps.sum(axis=1), 1.0)
    pixel = np.arange(taps.shape[1]) - taps.shape[1] // 2
    middles = (np.arange(parts) + 0.5) / parts - 0.5
    np.testing.assert_allclose(taps @ pixel, middles, atol=1e-4)
    variance = taps @ pixel**2 - (taps @ pixel) ** 2
    # Of the Gaussian, the part that sends and the pixel that receives.
    np.testing.assert_allclose(variance, sigma**2 + 1 / (12 * parts**2) + 1 / 12, rtol=1e-3)


def test_corners_are_darker_and_light_falls_across():
    flat = np.full((90, 160), 0.5, np.float32)
    dark = shaded(flat, Optics(vignetting=0.4))
    assert dark[45, 80] == pytest.approx(0.5, rel=1e-3)
    assert dark[0, 0] == pytest.approx(0.3, rel=0.01)
    tilted = shaded(flat, Optics(light_gradient=(0.2, 0.0)))
    assert tilted[45, -1] / tilted[45, 0] == pytest.approx(1.1 / 0.9, rel=2e-3)
    np.testing.assert_array_equal(tilted[0], tilted[-1])


def test_noise_has_the_spread_it_says():
    rng = np.random.default_rng(3)
    n = 200_000
    light = np.full((400, 500), 100 / 255, np.float32)
    image = exposed(light, Sensor(read_noise=2.0, shot_noise=0.05), rng).astype(float)
    variance = 4.0 + 5.0 + 1 / 12  # read, shot, rounding
    # A variance estimated from n samples of a Gaussian has a relative sigma of sqrt(2 / n).
    assert image.var() == pytest.approx(variance, rel=4 * np.sqrt(2 / n))
    assert image.mean() == pytest.approx(100, abs=4 * np.sqrt(variance / n))


def test_without_a_source_of_noise_light_is_only_rounded():
    light = np.array([[-0.1, 0.0, 0.2, 0.5, 1.0, 1.7]], np.float32)
    assert exposed(light, Sensor(), None).tolist() == [[0, 0, 51, 128, 255, 255]]
    assert exposed(light, Sensor(gain=100, offset=16), None).tolist() == [[6, 16, 36, 66, 116, 186]]


def test_jpeg_comes_back_nearly_the_same():
    light = np.tile(np.linspace(0, 1, 64, dtype=np.float32), (64, 1))
    plain, jpeg = exposed(light, Sensor(), None), exposed(light, Sensor(jpeg_quality=90), None)
    difference = np.abs(plain.astype(int) - jpeg)
    assert 0 < difference.max() <= 8
    with pytest.raises(InputError, match="1 to 100"):
        exposed(light, Sensor(jpeg_quality=0), None)


@pytest.mark.parametrize("kind", BACKGROUNDS)
def test_backgrounds_have_the_size_asked_for_and_come_from_the_seed(kind):
    first, again, other = (BACKGROUNDS[kind]((161, 97), np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert first.shape == (97, 161)
    assert first.dtype == np.float32
    assert first.min() > 0
    assert first.max() <= 1
    np.testing.assert_array_equal(first, again)
    assert (first != other).any() == (kind != "plain")
