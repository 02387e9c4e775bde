"""The stages of a camera, each against what physics or another program says of it."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.special import ndtr

from armsight.errors import InputError
from armsight.sim.camera.pipeline import SimulatedCamera, converted, disc_kernel, flicker_gain, lamp_gain
from armsight.sim.camera.stages import (
    AutoExposure,
    CameraPipeline,
    ExposureTiming,
    Flicker,
    Glint,
    Jpeg,
    Lamp,
    Mosaic,
    Photosensor,
    Resizing,
    Sharpening,
    TemporalDenoise,
    ToneCurve,
    WhiteNoise,
    preset_names,
)
from armsight.sim.render.background import cluttered
from armsight.sim.render.optics import Sensor, exposed
from armsight.sim.render.render import radiance
from armsight.sim.render.scene import PosedBody, plate
from armsight.vision.camera import Camera

SIZE = (160, 96)
SENSOR = Photosensor(1000, 2000, 5, 0, 0, 0, 0, 12, 0.05)
IDEAL = Photosensor(1e6, 1e6, 0, 0, 0, 0, 0, 14, 0)


def flat(level):
    return np.full(SIZE[::-1], level, np.float32)


def scene():
    return cluttered(SIZE, np.random.default_rng(2), 8)


def test_the_variance_of_a_pixel_is_its_electrons_and_the_readout_s():
    """EMVA 1288's photon transfer: a line of slope one in electrons, that begins at the readout's variance."""
    rng, n = np.random.default_rng(1), 200_000
    electrons = np.array([50.0, 200.0, 500.0, 800.0])
    found = [
        converted(np.full((400, 500), e, np.float32), rng.standard_normal((400, 500), np.float32), SENSOR, 2.0) * 1000
        for e in electrons
    ]
    variance, step_e = [x.var() for x in found], 1000 / (0.95 * 4095)
    expected = electrons + 5**2 + step_e**2 / 12
    assert [x.mean() for x in found] == pytest.approx(electrons, abs=4 * np.sqrt(expected.max() / n))
    np.testing.assert_allclose(variance, expected, rtol=4 * np.sqrt(2 / n))
    slope, begin = np.polyfit(electrons, variance, 1)
    assert slope == pytest.approx(1.0, abs=0.01)
    assert begin == pytest.approx(25.0, abs=3.0)


def test_a_pixel_is_full_at_its_well_and_the_converter_at_its_range():
    bright = np.full((8, 8), 5000, np.float32)
    np.testing.assert_array_equal(converted(bright.copy(), np.zeros_like(bright), SENSOR, 1.0), np.float32(1))
    np.testing.assert_array_equal(converted(bright.copy(), np.zeros_like(bright), SENSOR, 4.0), np.float32(1))


def test_a_pixel_keeps_its_pattern_and_cameras_differ():
    pipeline = CameraPipeline(sensor=replace(IDEAL, prnu=0.05))
    one, other = SimulatedCamera(pipeline, SIZE, 1), SimulatedCamera(pipeline, SIZE, 2)
    first, second, third = one.expose(flat(0.5)), one.expose(flat(0.5)), other.expose(flat(0.5))
    assert np.abs(first.astype(int) - second).max() <= 1
    assert first.std() == pytest.approx(0.05 * 127.5, rel=0.03)
    assert abs(np.corrcoef(first.ravel(), third.ravel())[0, 1]) < 0.05


def test_hot_pixels_are_where_they_were():
    pipeline = CameraPipeline(sensor=replace(IDEAL, hot_share=0.01, hot_e=1e5))
    camera = SimulatedCamera(pipeline, SIZE, 1)
    hot = camera.expose(flat(0.01)) > 10
    assert 0.005 < hot.mean() < 0.011
    assert ((camera.expose(flat(0.01)) > 10) != hot).mean() < 1e-3


@pytest.mark.opencv
@pytest.mark.parametrize("how", ["bilinear", "edge"])
def test_grey_comes_back_through_the_mosaic(how):
    mosaic = Mosaic((0.5, 1.0, 0.625), (2.0, 1.0, 1.6), how)
    smooth = (0.2 + 0.6 * np.add.outer(np.arange(SIZE[1]), np.arange(SIZE[0])) / sum(SIZE)).astype(np.float32)
    image = SimulatedCamera(CameraPipeline(sensor=IDEAL, mosaic=mosaic), SIZE).expose(smooth)
    np.testing.assert_allclose(image[2:-2, 2:-2], 255 * smooth[2:-2, 2:-2], atol=1.2)


def test_each_colour_is_where_the_mosaic_has_it():
    """By its share in the luma, ITU-R BT.601."""
    for balance, share in (((1.5, 1, 1), 0.299), ((1, 1.5, 1), 0.587), ((1, 1, 1.5), 0.114)):
        mosaic = Mosaic((1, 1, 1), balance, "bilinear")
        image = SimulatedCamera(CameraPipeline(sensor=IDEAL, mosaic=mosaic), SIZE).expose(flat(0.4))
        assert image.mean() == pytest.approx(255 * 0.4 * (1 + 0.5 * share), abs=0.6)


def test_a_wrong_white_balance_does_not_move_a_disc():
    """The colours' lattices are displaced by a pixel; demosaicing has to put them where they were."""
    y, x = np.mgrid[: SIZE[1], : SIZE[0]] - np.array([48.3, 80.4])[:, None, None]
    light = (0.102 + 0.7 * ndtr((15 - np.hypot(x, y)) / 1.2)).astype(np.float32)
    for mosaic in (Mosaic((1, 1, 1), (2, 0.5, 0.2), "bilinear"), Mosaic((1, 1, 1), (0.2, 0.5, 2), "bilinear")):
        image = SimulatedCamera(CameraPipeline(sensor=IDEAL, mosaic=mosaic), SIZE).expose(0.4 * light)
        above = image.astype(float) - image[20, 20]
        assert (above * x).sum() / above.sum() == pytest.approx(0.0, abs=0.02)
        assert (above * y).sum() / above.sum() == pytest.approx(0.0, abs=0.02)


@pytest.mark.parametrize(("amount", "sigma"), [(0.5, 0.8), (1.0, 1.0), (1.5, 1.5)])
def test_sharpening_overshoots_by_what_the_gaussian_takes_away(amount, sigma):
    """Beside a step of height A the blurred image is lower by A (1 - Phi(0.5 / sigma))."""
    light = flat(0.3)
    light[:, 80:] = 0.6
    image = SimulatedCamera(CameraPipeline(sharpening=Sharpening(amount, sigma)), SIZE).expose(light)
    step = 255 * 0.3
    assert image[48, 80] - 153 == pytest.approx(amount * step * (1 - ndtr(0.5 / sigma)), abs=1.5)
    assert 76.5 - image[48, 79] == pytest.approx(amount * step * (1 - ndtr(0.5 / sigma)), abs=1.5)
    assert image[48, 100] == 153


@pytest.mark.opencv
def test_jpeg_is_opencv_s():
    light = scene()
    plain = SimulatedCamera(CameraPipeline(), SIZE).expose(light)
    found = SimulatedCamera(CameraPipeline(jpeg=Jpeg(70, "4:2:0")), SIZE).expose(light)
    data = cv2.imencode(".jpg", plain, [cv2.IMWRITE_JPEG_QUALITY, 70])[1]
    np.testing.assert_array_equal(found, cv2.imdecode(data, cv2.IMREAD_GRAYSCALE))
    assert (found != plain).any()


@pytest.mark.opencv
def test_chroma_is_subsampled_as_asked(monkeypatch):
    """The frame header of the file says so: the sampling factors of its first component."""
    files, encode = [], cv2.imencode

    def kept(*args):
        done = encode(*args)
        files.append(done[1].tobytes())
        return done

    monkeypatch.setattr(cv2, "imencode", kept)
    mosaic = Mosaic((0.5, 1.0, 0.6), (2.0, 1.0, 1.6), "bilinear")
    for chroma, factors in (("4:4:4", 0x11), ("4:2:2", 0x21), ("4:2:0", 0x22)):
        SimulatedCamera(CameraPipeline(sensor=IDEAL, mosaic=mosaic, jpeg=Jpeg(80, chroma)), SIZE).expose(scene())
        header = files[-1].index(b"\xff\xc0")
        assert files[-1][header + 11] == factors


def test_a_rolling_shutter_moves_each_row_by_speed_and_time():
    camera = Camera(SIZE, "none", np.array([200.0, 200.0, 79.5, 47.5]), np.zeros(0))
    T, speed_px = np.eye(4), 400.0
    T[:3, 3] = 0.25, 0.0, 0.5
    body = PosedBody((plate(0.5, 2.0),), T, np.array([speed_px / 200 * 0.5, 0, 0, 0, 0, 0]))
    pipeline = CameraPipeline(timing=ExposureTiming(30, 0, 20, 0, 0, 0, 0))
    light = radiance(camera, [body], 0.1, shutter=pipeline.shutter(SIZE[1]))
    edge = ((0.85 - light) / 0.75).sum(axis=1) - 0.5  # where the plate begins, px
    rows = np.arange(SIZE[1]) - 47.5
    expected = 79.5 + speed_px * 0.020 * rows / SIZE[1]
    np.testing.assert_allclose(edge[3:-3], expected[3:-3], atol=0.001)  # the lens blurs rows at the border with less


def test_the_renderer_is_given_the_lens_s_blur():
    assert CameraPipeline().psf_sigma_px == 0.7
    assert CameraPipeline.load("webcam-good-light").psf_sigma_px == 0.5


def test_flicker_goes_round_once_a_period_and_not_at_all_over_whole_periods():
    light = Flicker(100, 0.3)
    rows = flicker_gain(light, 0.0, 101, 0.0, 20.0)[:, 0]
    np.testing.assert_allclose(rows, 1 + 0.3 * np.cos(2 * np.pi * (np.arange(101) - 50) / 50), atol=1e-6)
    fine = np.mean([flicker_gain(light, t, 1, 0.0, 0.0) for t in 0.0013 + np.linspace(-0.004, 0.004, 4001)])
    assert flicker_gain(light, 0.0013, 1, 8.0, 0.0)[0, 0] == pytest.approx(fine, abs=1e-4)
    np.testing.assert_allclose(flicker_gain(light, 0.0013, 50, 30.0, 20.0), 1.0, atol=1e-6)


def test_the_temporal_filter_averages_what_stands_and_lets_go_of_what_changes():
    still = CameraPipeline(white_noise=WhiteNoise(8.0), temporal_denoise=TemporalDenoise(0.5, 255.0))
    camera = SimulatedCamera(still, SIZE, 3)
    images = [camera.expose(flat(0.5)).astype(float) for _ in range(8)]
    # y_n = w y_(n-1) + (1 - w) x_n has (1 - w) / (1 + w) of the variance; the weight falls a little with the difference.
    assert images[-1].std() == pytest.approx(8 * np.sqrt(0.5 / 1.5), rel=0.05)
    quick = CameraPipeline(temporal_denoise=TemporalDenoise(0.9, 10.0))
    camera = SimulatedCamera(quick, SIZE)
    camera.expose(flat(0.2))
    np.testing.assert_array_equal(camera.expose(flat(0.6)), 153)
    camera.forget()
    np.testing.assert_array_equal(camera.expose(flat(0.61)), 156)


def test_the_gain_settles_at_once_then_moves_one_step_an_image():
    pipeline = CameraPipeline(sensor=replace(IDEAL, white_e=2.5e5), auto_exposure=AutoExposure(0.2, 0.25, 16))
    camera = SimulatedCamera(pipeline, SIZE)
    assert camera.expose(flat(0.2)).mean() == pytest.approx(0.2 * 255, rel=0.1)
    assert camera.expose(flat(0.2)).mean() == pytest.approx(0.2 * 255, rel=0.1)
    levels = [camera.expose(flat(0.4)).mean() for _ in range(8)]
    ratios = np.divide(levels[1:], levels[:-1])
    np.testing.assert_allclose(ratios[:3], 2**-0.25, rtol=0.02)
    assert levels[-1] == pytest.approx(0.2 * 255, rel=2**0.2 - 1)
    assert np.ptp(levels[5:]) < 0.01


def test_the_blur_of_defocus_is_an_even_disc():
    for radius in (0.3, 1.0, 2.0, 3.7):
        kernel = disc_kernel(radius)
        at = np.arange(len(kernel)) - len(kernel) // 2
        assert kernel.sum() == pytest.approx(1.0)
        if radius > 0.5:  # a disc's variance is r^2 / 4, a pixel's own 1 / 12
            assert kernel.sum(axis=0) @ at**2 == pytest.approx(radius**2 / 4 + _spread_of(radius), abs=0.02)


def _spread_of(radius):
    """Return what assigning a disc's points to their pixels adds to its variance, px^2, by sampling."""
    t = (np.arange(-5000, 5000) + 0.5) / 1000
    weight = np.sqrt(np.maximum(radius**2 - t**2, 0))
    return (weight @ np.round(t) ** 2 - weight @ t**2) / weight.sum()


def test_a_lamp_falls_off_with_distance_and_slope():
    gain = lamp_gain((101, 3), Lamp(0.5, (0.0, 0.5), 5.0))
    away = 0.25 / (0.25 + 0.5**2)  # at the end the ray is as long as sqrt(2) of the lamp's distance, at 45 degrees
    assert gain[1, 0] == 1.0
    assert gain[1, 100] == pytest.approx(away * np.cos(np.pi / 4), rel=1e-6)


def test_a_glint_is_where_it_is_put():
    image = SimulatedCamera(CameraPipeline(glint=Glint(0.5, 4.0, (0.25, 0.5))), SIZE).expose(flat(0.1))
    assert np.unravel_index(image.argmax(), image.shape)[1] == 40
    assert image.max() == pytest.approx(0.6 * 255, abs=2)


def test_the_tone_curve_is_a_power_and_an_s():
    light = np.tile(np.linspace(0, 1, SIZE[0], dtype=np.float32), (SIZE[1], 1))
    image = SimulatedCamera(CameraPipeline(tone=ToneCurve(1.0, 2.2, 0.5)), SIZE).expose(light)
    y = light[0] ** (1 / 2.2)
    np.testing.assert_allclose(image[0], 255 * (0.5 * y + 0.5 * (3 * y**2 - 2 * y**3)), atol=0.51)


@pytest.mark.parametrize("scale", [0.5, 1.5, 2.0])
def test_resizing_moves_nothing(scale):
    y, x = np.mgrid[: SIZE[1], : SIZE[0]] - np.array([48.3, 80.4])[:, None, None]
    light = (0.102 + 0.7 * ndtr((15 - np.hypot(x, y)) / 1.2)).astype(np.float32)
    image = SimulatedCamera(CameraPipeline(resizing=Resizing(scale, "linear")), SIZE).expose(light)
    above = image.astype(float) - image[0, 0]
    assert (above * x).sum() / above.sum() == pytest.approx(0.0, abs=0.01)
    assert (above * y).sum() / above.sum() == pytest.approx(0.0, abs=0.01)


def test_clean_is_the_renderer_s_own_noise():
    light = scene()
    image = SimulatedCamera(CameraPipeline.load("clean"), SIZE, 7).expose(light, number=4)
    rng = np.random.default_rng([7, 21, 4])
    np.testing.assert_array_equal(image, exposed(light, Sensor(read_noise=2.0), rng))


@pytest.mark.opencv
@pytest.mark.parametrize("name", preset_names())
def test_the_same_seed_gives_the_same_images(name):
    light = scene()
    before = light.copy()

    def images():
        camera = SimulatedCamera(CameraPipeline.load(name), SIZE, 5)
        return [camera.expose(light, k / 30) for k in range(3)]

    first, second = images(), images()
    for one, other in zip(first, second, strict=True):
        assert one.shape == SIZE[::-1]
        assert one.dtype == np.uint8
        np.testing.assert_array_equal(one, other)
    assert (first[1] != first[2]).any()
    np.testing.assert_array_equal(light, before)


def test_images_of_odd_size():
    for name in preset_names():
        image = SimulatedCamera(CameraPipeline.load(name), (161, 97)).expose(np.full((97, 161), 0.4, np.float32))
        assert image.shape == (97, 161)


def test_light_of_another_size():
    with pytest.raises(InputError, match=r"radiance is \(4, 4\), must be \(96, 160\)"):
        SimulatedCamera(CameraPipeline(), SIZE).expose(np.zeros((4, 4), np.float32))
