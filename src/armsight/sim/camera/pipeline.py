"""A simulated camera: linear radiance in, the 8-bit image of its file out, one stage after the other.

    lamp, glint -> defocus -> vignetting -> flicker -> photons, fixed pattern, readout, converter -> white balance,
    demosaic -> tone curve -> denoise in space and time -> sharpen -> resize -> JPEG -> grey

The blur of the lens in focus, motion blur and the rolling shutter come first and belong to the renderer, which knows edges
and motion exactly: it is to use ``pipeline.psf_sigma_px`` and ``pipeline.shutter(height)``. The sensor's noise follows the
EMVA standard 1288, section 2: the variance of a pixel is its number of electrons plus that of the readout.
"""

from __future__ import annotations

import math
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Image
from armsight.errors import InputError
from armsight.sim.camera.stages import CameraPipeline, Flicker, Jpeg, Lamp, Photosensor, TemporalDenoise, ToneCurve
from armsight.sim.render.optics import Optics, Radiance, Sensor, exposed, noise_start, noise_strip, shaded

_METHODS = {
    "nearest": cv2.INTER_NEAREST_EXACT,
    "linear": cv2.INTER_LINEAR,
    "cubic": cv2.INTER_CUBIC,
    "area": cv2.INTER_AREA,
}
_DEMOSAIC = {"bilinear": cv2.COLOR_BayerRGGB2BGR, "edge": cv2.COLOR_BayerRGGB2BGR_EA}
_CHROMA = {
    "4:4:4": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
    "4:2:2": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_422,
    "4:2:0": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420,
}
_FULL = np.float32(65535)  # linear light of one between the converter and the tone curve, which work on 16 bits
_BAND = 32  # rows that are worked on together; even, as the mosaic's cells are
_METERED = 8  # every so many pixels count for the automatic gain
_HYSTERESIS = 0.75  # of a step: an error below it changes nothing


class SimulatedCamera:
    """One camera: its stages, its fixed pattern, and what it remembers from image to image."""

    def __init__(self, pipeline: CameraPipeline, image_size_px: tuple[int, int], seed: int = 0) -> None:
        """Make a camera; the same seed gives the same fixed pattern and noise."""
        self.pipeline, self._seed = pipeline, seed
        self._width, self._height = image_size_px
        self._native = image_size_px
        if pipeline.resizing is not None:  # whole cells of a mosaic
            width, height = (max(2, 2 * round(n * pipeline.resizing.native_scale / 2)) for n in image_size_px)
            self._native = width, height
        self._lamp = None if pipeline.lamp is None else lamp_gain(image_size_px, pipeline.lamp)
        self._glint = self._highlight()
        corner = pipeline.vignetting.corner if pipeline.vignetting else 0.0
        self._shade = shaded(np.ones(image_size_px[::-1], np.float32), Optics(vignetting=corner)) if corner else None
        self._sensitivity, self._dark_e = self._fixed_pattern()
        self._table = _tone_table(pipeline.tone)
        self._count = 0
        self.forget()

    def forget(self) -> None:
        """Forget the previous images: the automatic gain settles at once, and nothing is mixed into the next image."""
        self._previous: Radiance | None = None
        self._gain_step: int | None = None

    def expose(self, radiance: Radiance, time_s: float = 0.0, number: int | None = None) -> Image:
        """Return the image of a scene.

        ``radiance``: (H, W) linear light of each pixel, 1 for a white reflector, with the renderer's blur and motion.
        ``time_s``: middle of the exposure of the middle row, s; flicker follows it. ``number``: of the image; its noise
        follows from it and the camera's seed. By default images are counted. Returns (H, W) uint8, grey. Raises InputError:
        the radiance is of another size.
        """
        if radiance.shape != (self._height, self._width):
            raise InputError(f"the radiance is {radiance.shape}, must be ({self._height}, {self._width})")
        stages = self.pipeline
        number = self._count if number is None else number
        self._count += 1
        light = self._lit(self._through_lens(radiance), time_s)
        if stages.sensor is None and stages.tone is None:
            sigma = stages.white_noise.sigma_grey if stages.white_noise else 0.0
            rng = np.random.default_rng([self._seed, 21, number])
            return self._processed(exposed(light, Sensor(read_noise=sigma), rng), None)
        raw = self._read_out(light, number)
        if stages.mosaic is None:
            return self._processed(self._toned(raw), None)
        linear = np.asarray(cv2.demosaicing(raw, _DEMOSAIC[stages.mosaic.demosaic]))
        ycrcb = cv2.cvtColor(self._toned(linear), cv2.COLOR_BGR2YCrCb)
        return self._processed(cv2.extractChannel(ycrcb, 0), ycrcb)

    def _highlight(self) -> Radiance | None:
        """Return the light (H, W) of the glint."""
        glint = self.pipeline.glint
        if glint is None:
            return None
        x = np.arange(self._width) - glint.centre[0] * (self._width - 1)
        y = np.arange(self._height) - glint.centre[1] * (self._height - 1)
        across, down = (np.exp(-0.5 * (t / glint.sigma_px) ** 2) for t in (x, y))
        return np.asarray(glint.peak * np.outer(down, across), dtype=np.float32)

    def _fixed_pattern(self) -> tuple[Radiance, Radiance]:
        """Return what each pixel of the sensor makes of light of one, and its electrons in the dark."""
        sensor, mosaic, shape = self.pipeline.sensor, self.pipeline.mosaic, self._native[::-1]
        if sensor is None:
            return np.ones(shape, np.float32), np.zeros(shape, np.float32)
        rng = np.random.default_rng([self._seed, 20])
        sensitivity = 1 + np.float32(sensor.prnu) * rng.standard_normal(shape, dtype=np.float32)
        sensitivity *= np.float32(sensor.white_e)
        if mosaic is not None:
            sensitivity *= _mosaic(mosaic.response, shape)
        dark_e = np.float32(sensor.dsnu_e) * rng.standard_normal(shape, dtype=np.float32)
        hot = rng.integers(0, dark_e.size, round(sensor.hot_share * dark_e.size))
        dark_e.ravel()[hot] += rng.exponential(sensor.hot_e, hot.size).astype(np.float32)
        return sensitivity, dark_e

    def _through_lens(self, radiance: Radiance) -> Radiance:
        """Return the light on the sensor's plane, (H, W)."""
        stages, light = self.pipeline, radiance
        if self._lamp is not None:
            light = light * self._lamp
        if self._glint is not None:
            light = light + self._glint
        if stages.defocus is not None and stages.defocus.radius_px > 0:
            kernel = disc_kernel(stages.defocus.radius_px)
            light = _single(cv2.filter2D(light, cv2.CV_32F, kernel, borderType=cv2.BORDER_REPLICATE))
        return light if self._shade is None else light * self._shade

    def _lit(self, light: Radiance, time_s: float) -> Radiance:
        """Return the light on the sensor's own pixels, with the lamps' flicker."""
        if light.shape != self._native[::-1]:
            smaller = light.shape[1] > self._native[0]
            method = cv2.INTER_AREA if smaller else cv2.INTER_CUBIC
            light = _single(cv2.resize(light, self._native, interpolation=method))
        stages = self.pipeline
        if stages.flicker is not None:
            timing = stages.timing
            exposure_ms, readout_ms = (timing.exposure_ms, timing.readout_ms) if timing else (0.0, 0.0)
            light = light * flicker_gain(stages.flicker, time_s, len(light), exposure_ms, readout_ms)
        return light

    def _read_out(self, light: Radiance, number: int) -> Image:
        """Return what the converter gives, the dark level subtracted and the white balance applied, uint16."""
        stages, shape = self.pipeline, light.shape
        start = noise_start(self._seed, 0, number)
        noise = noise_strip(0, self._native)[start : start + light.size].reshape(shape)
        balance = _mosaic(stages.mosaic.white_balance if stages.mosaic else (1.0, 1.0, 1.0), (_BAND, shape[1]))
        if stages.sensor is None:
            sigma = np.float32(stages.white_noise.sigma_grey / 255 if stages.white_noise else 0.0)
        else:
            gain = self._analogue_gain(light, stages.sensor)
        out = np.empty(shape, np.uint16)
        for top in range(0, shape[0], _BAND):  # what is in the cache is fast
            rows = slice(top, top + _BAND)
            if stages.sensor is None:
                raw = light[rows] + sigma * noise[rows]
            else:
                electrons = light[rows] * self._sensitivity[rows] + self._dark_e[rows]
                raw = converted(electrons, noise[rows], stages.sensor, gain)
            raw *= _FULL * balance[: len(raw)]
            out[rows] = np.clip(np.rint(raw), 0, _FULL)
        return out

    def _toned(self, linear: Image) -> Image:
        """Return grey levels of linear light, uint16."""
        out = np.empty(linear.shape, np.uint8)
        for top in range(0, len(linear), _BAND):
            np.take(self._table, linear[top : top + _BAND], out=out[top : top + _BAND], mode="clip")
        return out

    def _analogue_gain(self, light: Radiance, sensor: Photosensor) -> float:
        """Return the gain of this image, and choose the next one's."""
        auto = self.pipeline.auto_exposure
        if auto is None:
            return 1.0
        seen = light[::_METERED, ::_METERED] * np.float32(sensor.white_e / sensor.full_well_e)
        last = math.floor(math.log2(auto.gain_max) / auto.step_ev)

        def missing(step: int) -> float:
            """Return by how many steps the image is too dark at a gain."""
            mean = float(np.minimum(seen * 2 ** (step * auto.step_ev), 1.0).mean())
            return math.log2(auto.target / max(mean, 1e-6)) / auto.step_ev

        if self._gain_step is None:
            self._gain_step = min(range(last + 1), key=lambda step: abs(missing(step)))
        step, error = self._gain_step, missing(self._gain_step)
        change = (error > _HYSTERESIS) - (error < -_HYSTERESIS)
        self._gain_step = min(max(step + change, 0), last)
        return float(2 ** (step * auto.step_ev))

    def _processed(self, luma: Image, ycrcb: Image | None) -> Image:
        """Return the file's image: luma (h, w) uint8 denoised, sharpened, resized, compressed; colour from ``ycrcb``."""
        stages = self.pipeline
        if stages.denoise is not None:
            by = stages.denoise
            luma = np.asarray(cv2.bilateralFilter(luma, by.diameter_px, by.sigma_grey, by.sigma_px))
        if stages.temporal_denoise is not None:
            y = luma.astype(np.float32)
            if self._previous is not None:
                _mix(y, self._previous, stages.temporal_denoise)
            self._previous, luma = y, cv2.convertScaleAbs(y)
        if stages.sharpening is not None:
            amount = stages.sharpening.amount
            y = luma.astype(np.float32)
            blurred = cv2.GaussianBlur(y, (0, 0), stages.sharpening.sigma_px, borderType=cv2.BORDER_REPLICATE)
            luma = np.asarray(cv2.addWeighted(y, 1 + amount, blurred, -amount, 0, dtype=cv2.CV_8U))
        if ycrcb is None or stages.jpeg is None:
            image = self._resized(luma)
        else:
            cv2.insertChannel(luma, ycrcb, 0)
            image = self._resized(cv2.cvtColor(ycrcb, cv2.COLOR_YCrCb2BGR))
        return image if stages.jpeg is None else compressed(image, stages.jpeg)

    def _resized(self, image: Image) -> Image:
        """Return an image of the sensor's size at the output's."""
        if self.pipeline.resizing is None:
            return image
        method = _METHODS[self.pipeline.resizing.method]
        return np.asarray(cv2.resize(image, (self._width, self._height), interpolation=method))


def _mosaic(rgb: tuple[float, float, float], shape: tuple[int, ...]) -> Radiance:
    """Return the value of each pixel's colour, of red, green and blue, in a mosaic (h, w) that begins with red."""
    cell = np.array([[rgb[0], rgb[1]], [rgb[1], rgb[2]]], np.float32)
    return np.tile(cell, (-(-shape[0] // 2), -(-shape[1] // 2)))[: shape[0], : shape[1]]


def converted(electrons: Radiance, noise: Radiance, sensor: Photosensor, gain: float) -> Radiance:
    """Return the converter's numbers, the dark level subtracted, as shares of their range.

    electrons (h, w) expected in each pixel, overwritten; noise (h, w) standard normal; ``gain``: before the converter.
    """
    most = 2**sensor.bits - 1
    dark = round(sensor.dark_level * most)
    electrons += noise * np.sqrt(np.maximum(electrons, 0) + np.float32(sensor.read_noise_e**2))
    np.minimum(electrons, np.float32(sensor.full_well_e), out=electrons)
    electrons *= np.float32(gain * (most - dark) / sensor.full_well_e)
    electrons += np.float32(dark)
    np.clip(np.rint(electrons, out=electrons), 0, most, out=electrons)
    electrons -= np.float32(dark)
    electrons *= np.float32(1 / (most - dark))
    return electrons


def _single(image: Image) -> Radiance:
    """Return an image of OpenCV's as what it is: single precision."""
    return np.asarray(image, dtype=np.float32)


def _tone_table(tone: ToneCurve | None) -> Image:
    """Return the grey level (65536,) of each 16-bit number; proportional without a tone curve."""
    light = np.arange(65536) / 65535
    if tone is not None:
        y = np.minimum(light * tone.gain, 1) ** (1 / tone.gamma)
        light = (1 - tone.contrast) * y + tone.contrast * (3 - 2 * y) * y**2
    return np.rint(255 * light).astype(np.uint8)


def lamp_gain(image_size_px: tuple[int, int], lamp: Lamp) -> Radiance:
    """Return the light (H, W) of a lamp relative to the plane's point nearest to it: (d^2 / (d^2 + r^2))^(3/2)."""
    width, height = image_size_px
    x = 1e-3 * lamp.pixel_mm * (np.arange(width) - lamp.foot[0] * (width - 1))
    y = 1e-3 * lamp.pixel_mm * (np.arange(height) - lamp.foot[1] * (height - 1))
    squares = np.add.outer(y**2, x**2)
    return np.asarray((1 + squares / lamp.distance_m**2) ** -1.5, dtype=np.float32)


def flicker_gain(
    flicker: Flicker, time_s: float, height: int, exposure_ms: float, readout_ms: float
) -> NDArray[np.float32]:
    """Return the light (height, 1) of lamps on mains power in each row, 1 on average.

    ``time_s``: middle of the exposure of the middle row. The cosine's mean over an exposure is its middle's times sinc.
    """
    times = time_s + 1e-3 * readout_ms * (np.arange(height) / max(height - 1, 1) - 0.5)
    depth = flicker.depth * np.sinc(flicker.frequency_hz * 1e-3 * exposure_ms)
    return np.asarray(1 + depth * np.cos(2 * np.pi * flicker.frequency_hz * times), dtype=np.float32)[:, None]


@lru_cache(maxsize=16)
def disc_kernel(radius_px: float, parts: int = 32) -> Array:
    """Return the share (n, n) that each pixel has of an even disc, from ``parts`` x ``parts`` samples a pixel."""
    half = math.ceil(radius_px + 0.5) - 1 if radius_px > 0.5 else 0
    n = 2 * half + 1
    at = (np.arange(n * parts) + 0.5) / parts - n / 2
    inside = np.add.outer(at**2, at**2) <= radius_px**2
    share = inside.reshape(n, parts, n, parts).mean(axis=(1, 3))
    return np.asarray(share / share.sum())


def _mix(y: Radiance, previous: Radiance, stage: TemporalDenoise) -> None:
    """Mix the previous image into a luma, where little has changed."""
    change = _single(cv2.blur(previous - y, (3, 3)))
    for top in range(0, len(y), _BAND):
        rows = slice(top, top + _BAND)
        weight = np.maximum(stage.weight - np.float32(stage.weight / stage.threshold_grey) * np.abs(change[rows]), 0)
        y[rows] += weight * (previous[rows] - y[rows])


def compressed(image: Image, stage: Jpeg) -> Image:
    """Return what a program reads of an image (H, W) or (H, W, 3) BGR that went through JPEG: grey, uint8."""
    options = [cv2.IMWRITE_JPEG_QUALITY, stage.quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, _CHROMA[stage.chroma]]
    _, data = cv2.imencode(".jpg", image, options)
    decoded = np.asarray(cv2.imdecode(data, cv2.IMREAD_UNCHANGED))
    return decoded if decoded.ndim == 2 else np.asarray(cv2.cvtColor(decoded, cv2.COLOR_BGR2GRAY))
