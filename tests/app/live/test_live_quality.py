"""What is wrong with an image is found and said in words."""

import cv2
import numpy as np
import pytest

from armsight.app.live.cameras import flicker_note, quality_notes
from armsight.vision.quality import FlickerWatch, ImageQuality, edge_spread_px, image_quality, same_camera


def squares(sigma_px, noise=1.0):
    """An image of bright squares, blurred."""
    image = np.full((360, 640), 60.0)
    for r in range(20, 340, 80):
        for c in range(20, 620, 80):
            image[r : r + 40, c : c + 40] = 190.0
    image = cv2.GaussianBlur(image, (0, 0), sigma_px)
    return np.clip(image + np.random.default_rng(0).normal(0, noise, image.shape), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("sigma_px", [0.8, 1.5, 2.5])
def test_the_edge_spread_is_that_of_the_blur(sigma_px):
    assert edge_spread_px(squares(sigma_px)) == pytest.approx(sigma_px, rel=0.2, abs=0.15)


def test_an_image_without_edges_has_no_edge_spread():
    assert edge_spread_px(np.full((100, 100), 90, np.uint8)) is None
    assert edge_spread_px(np.zeros((20, 20), np.uint8)) is None


@pytest.mark.parametrize(
    ("quality", "words"),
    [
        (ImageQuality(3.0, 120.0, 0.0), ["out of focus", "3.0 px"]),
        (ImageQuality(1.6, 120.0, 0.0), ["soft"]),
        (ImageQuality(1.0, 120.0, 0.05), ["saturated", "5%"]),
        (ImageQuality(1.0, 12.0, 0.0), ["too dark"]),
        (ImageQuality(1.0, 120.0, 0.0), []),
    ],
)
def test_words(quality, words):
    notes = quality_notes(quality)
    assert len(notes) == bool(words)
    assert all(word in notes[0].text for word in words)


def test_saturation_and_darkness_are_measured():
    image = np.full((90, 160), 20, np.uint8)
    image[:9] = 255
    found = image_quality(image)
    assert found.saturated == pytest.approx(0.1)
    assert found.mean == pytest.approx(43.5)


@pytest.mark.parametrize(("hz", "rate_hz"), [(100.0, 30.0), (120.0, 25.0), (100.0, 15.0)])
def test_flicker_is_found_with_its_frequency(hz, rate_hz):
    flicker, still, rows = FlickerWatch(rate_hz), squares(1.0), np.arange(360)
    for k in range(12):
        wave = 1 + 0.03 * np.sin(2 * np.pi * hz * (k / rate_hz + 4e-5 * rows))
        flicker.take(np.clip(still * wave[:, None], 0, 255).astype(np.uint8))
    amplitude, found_hz = flicker.found()
    assert found_hz == hz
    assert 0.01 < amplitude < 0.05
    assert f"{hz:.0f} Hz" in flicker_note(flicker).text


def test_what_moves_does_not_flicker():
    texture = np.random.default_rng(1).uniform(40, 200, (36, 64)).astype(np.uint8)
    flicker, still = FlickerWatch(30.0), cv2.resize(texture, (640, 360), interpolation=cv2.INTER_CUBIC)
    for k in range(12):
        flicker.take(np.roll(still, 9 * k, axis=0))
    assert flicker.found() is None
    assert flicker_note(FlickerWatch(30.0)) is None


def test_one_camera_twice_is_noticed():
    left = squares(1.0)
    assert same_camera(left, squares(1.0, noise=4.0))
    assert not same_camera(left, np.roll(left, 40, axis=1))
    assert not same_camera(left, left[:100])
