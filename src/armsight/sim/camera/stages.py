"""The parameters of a simulated camera: one frozen record for each stage, read from a TOML file.

In: the name of a preset, or a file whose tables are stages. Out: a :class:`CameraPipeline`. A stage that the file does
not have is left out. What each parameter does to a disc: the documentation's page on the camera model.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Self

from armsight.errors import InputError, naming
from armsight.files import read_toml
from armsight.sim.render.optics import Optics
from armsight.sim.render.render import Shutter

_PRESETS = Path(__file__).parent / "presets"


def _number(low: float, high: float, *, count: int = 1, whole: bool = False) -> Any:  # noqa: ANN401
    """Return a field that holds a number within a range, or ``count`` of them."""
    return field(metadata={"range": (low, high), "count": count, "whole": whole})


def _one_of(*choices: str) -> Any:  # noqa: ANN401
    """Return a field that holds one of some words."""
    return field(metadata={"choices": choices})


def _allowed(value: object, rule: dict[str, Any]) -> bool:
    """Return whether a value is what a field's rule allows."""
    if "choices" in rule:
        return value in rule["choices"]
    numbers = value if isinstance(value, tuple) else (value,)
    kinds, (low, high) = int if rule["whole"] else int | float, rule["range"]
    right = isinstance(value, tuple) == (rule["count"] > 1) and len(numbers) == rule["count"]
    return right and all(isinstance(n, kinds) and not isinstance(n, bool) and low <= n <= high for n in numbers)


def _rule_text(rule: dict[str, Any]) -> str:
    if "choices" in rule:
        return f"one of {', '.join(rule['choices'])}"
    low, high = rule["range"]
    kind = "whole number" if rule["whole"] else "number"
    many = f"a list of {rule['count']} {kind}s, each" if rule["count"] > 1 else f"a {kind}"
    return f"{many} from {low:g} to {high:g}"


@dataclass(frozen=True)
class Stage:
    """What all stages share: InputError names a value that is not within its range."""

    def __post_init__(self) -> None:
        """Check every value against its field's range."""
        for each in fields(self):
            value, rule = getattr(self, each.name), dict(each.metadata)
            if not _allowed(value, rule):
                given = list(value) if isinstance(value, tuple) else value
                raise InputError(f"{each.name} must be {_rule_text(rule)}, got {given!r}")


@dataclass(frozen=True)
class ExposureTiming(Stage):
    """When the camera looks; the renderer applies motion blur and the rolling shutter, see :meth:`CameraPipeline.shutter`.

    ``readout_ms``: from the first row's beginning to the last row's, 0 for a global shutter; ``delay_ms``: from the end
    of the exposure until the image has arrived; ``jitter_ms``: sigma of the stamp; the exposures of two begin
    ``sync_ms`` apart at most, by chance, the right one always by ``skew_ms`` later.
    """

    rate_hz: float = _number(1, 500)
    exposure_ms: float = _number(0, 100)
    readout_ms: float = _number(0, 100)
    delay_ms: float = _number(0, 500)
    jitter_ms: float = _number(0, 20)
    sync_ms: float = _number(0, 20)
    skew_ms: float = _number(0, 40)


@dataclass(frozen=True)
class Lens(Stage):
    """A lens in focus; the renderer applies its blur, exactly in area, see :attr:`CameraPipeline.psf_sigma_px`."""

    psf_sigma_px: float = _number(0.1, 5)  #: standard deviation of the Gaussian blur, pixels of the output


@dataclass(frozen=True)
class Lamp(Stage):
    """A lamp near a target plane: a smooth gain over the image, cos(angle) / distance^2 of a plane that faces it.

    ``foot``: the point of the image that the lamp is in front of, shares of width and height; ``pixel_mm``: on the plane.
    """

    distance_m: float = _number(0.1, 10)
    foot: tuple[float, float] = _number(-1, 2, count=2)
    pixel_mm: float = _number(0.01, 10)


@dataclass(frozen=True)
class Glint(Stage):
    """A specular highlight, Gaussian in the image, at shares of width and height; a peak of 1 is a white reflector."""

    peak: float = _number(0, 100)
    sigma_px: float = _number(0.3, 100)
    centre: tuple[float, float] = _number(-1, 2, count=2)


@dataclass(frozen=True)
class Defocus(Stage):
    """The blur of a lens that is out of focus, beside that in focus: an even disc of a radius, pixels of the output."""

    radius_px: float = _number(0, 5)


@dataclass(frozen=True)
class Vignetting(Stage):
    """Darker corners, which lose this share of the light, falling with the square of the radius."""

    corner: float = _number(0, 0.9)


@dataclass(frozen=True)
class Resizing(Stage):
    """A sensor of another size than the output; the camera interpolates."""

    native_scale: float = _number(0.25, 3)  #: the sensor's width over the output's
    method: str = _one_of("nearest", "linear", "cubic", "area")  #: of the camera's own interpolation


@dataclass(frozen=True)
class Flicker(Stage):
    """Lamps on mains power, at twice its frequency: the light varies with a cosine of ``depth`` times the mean.

    It is averaged over the exposure, by rows in a rolling shutter.
    """

    frequency_hz: float = _number(10, 1000)
    depth: float = _number(0, 1)


@dataclass(frozen=True)
class Photosensor(Stage):
    """From light to numbers, in electrons: photons, fixed pattern, readout, converter."""

    white_e: float = _number(1, 1e6)  #: electrons that a white reflector (radiance 1) gives in an exposure
    full_well_e: float = _number(100, 1e6)  #: electrons at which a pixel, and at a gain of one the converter, is full
    read_noise_e: float = _number(0, 500)  #: noise of the readout
    prnu: float = _number(0, 0.2)  #: pixels differ in sensitivity by this share (standard deviation)
    dsnu_e: float = _number(0, 500)  #: pixels differ in the dark by so many electrons (standard deviation)
    hot_share: float = _number(0, 0.01)  #: share of hot pixels
    hot_e: float = _number(0, 1e5)  #: mean of what a hot pixel has in the dark, exponentially distributed
    bits: int = _number(8, 14, whole=True)  #: of the converter
    dark_level: float = _number(0, 0.2)  #: share of the converter's range that black is at; the camera subtracts it


@dataclass(frozen=True)
class AutoExposure(Stage):
    """Automatic gain before the converter; the exposure time stays, for the renderer needs it beforehand.

    ``target``: share of the converter's range that the image's mean is brought to, before the tone curve, by
    ``step_ev`` an image at most, powers of two, up to ``gain_max``; the least is 1.
    """

    target: float = _number(0.01, 0.9)
    step_ev: float = _number(0.02, 2)
    gain_max: float = _number(1, 256)


@dataclass(frozen=True)
class Mosaic(Stage):
    """A colour filter array (RGGB) over the sensor, white balance, and the interpolation of colours.

    ``response``: what red, green and blue pixels get of the light, relative to green; ``white_balance``: factors of these.
    """

    response: tuple[float, float, float] = _number(0.05, 2, count=3)
    white_balance: tuple[float, float, float] = _number(0.2, 8, count=3)
    demosaic: str = _one_of("bilinear", "edge")


@dataclass(frozen=True)
class ToneCurve(Stage):
    """From linear light to grey levels: gain, power 1 / gamma, and a share ``contrast`` of the S-curve 3 y^2 - 2 y^3."""

    gain: float = _number(0.1, 16)
    gamma: float = _number(0.5, 3)
    contrast: float = _number(0, 1)


@dataclass(frozen=True)
class SpatialDenoise(Stage):
    """A bilateral filter of the luma."""

    diameter_px: int = _number(3, 15, whole=True)  #: of the neighbourhood, pixels of the sensor
    sigma_px: float = _number(0.3, 10)  #: weight by distance
    sigma_grey: float = _number(0.5, 200)  #: weight by difference, grey levels


@dataclass(frozen=True)
class TemporalDenoise(Stage):
    """A recursive filter of the luma: the previous output has ``weight`` where nothing has changed.

    That falls to zero at a difference of ``threshold_grey`` levels, a mean over 3 x 3 pixels.
    """

    weight: float = _number(0, 0.95)
    threshold_grey: float = _number(0.5, 255)


@dataclass(frozen=True)
class Sharpening(Stage):
    """An unsharp mask of the luma: y + amount (y - blurred y), the blur's sigma in pixels of the sensor."""

    amount: float = _number(0, 4)
    sigma_px: float = _number(0.3, 5)


@dataclass(frozen=True)
class Jpeg(Stage):
    """Compression of each image, as in MJPEG: quality as libjpeg counts, subsampling of the colour differences."""

    quality: int = _number(1, 100, whole=True)
    chroma: str = _one_of("4:4:4", "4:2:2", "4:2:0")


@dataclass(frozen=True)
class WhiteNoise(Stage):
    """In lieu of a sensor: Gaussian noise of one sigma everywhere, grey levels."""

    sigma_grey: float = _number(0, 50)


@dataclass(frozen=True)
class CameraPipeline:
    """The stages of a camera, in the order in which the light and the numbers pass them; None leaves a stage out."""

    timing: ExposureTiming | None = None
    lens: Lens | None = None
    lamp: Lamp | None = None
    glint: Glint | None = None
    defocus: Defocus | None = None
    vignetting: Vignetting | None = None
    resizing: Resizing | None = None
    flicker: Flicker | None = None
    sensor: Photosensor | None = None
    auto_exposure: AutoExposure | None = None
    mosaic: Mosaic | None = None
    white_noise: WhiteNoise | None = None
    tone: ToneCurve | None = None
    denoise: SpatialDenoise | None = None
    temporal_denoise: TemporalDenoise | None = None
    sharpening: Sharpening | None = None
    jpeg: Jpeg | None = None

    def __post_init__(self) -> None:
        """Check that stages that need others have them."""
        if self.sensor is not None and self.white_noise is not None:
            raise InputError("sensor and white_noise exclude each other: leave one out")
        for name in ("auto_exposure", "mosaic"):
            if getattr(self, name) is not None and self.sensor is None:
                raise InputError(f"{name} needs the stage sensor")

    @classmethod
    def load(cls, name: str | os.PathLike[str]) -> Self:
        """Return a preset, or what a TOML file says; InputError names a stage, key or value that is not allowed.

        A file's key ``preset`` names the preset that it changes; ``stage = false`` leaves one of its stages out.
        """
        path = os.fspath(name)
        if path in preset_names():
            return cls._from_tables(_PRESETS / f"{path}.toml")
        if not path.endswith(".toml"):
            raise InputError(f"camera {path!r} is unknown; known are {', '.join(preset_names())}, or a TOML file")
        return cls._from_tables(path)

    @classmethod
    def _from_tables(cls, path: str | Path) -> Self:
        tables = read_toml(path)
        base = tables.pop("preset", None)
        if base is not None:
            if base not in preset_names():
                raise InputError(f"{path}: preset is {base!r}; known are {', '.join(preset_names())}")
            changed = tables
            tables = read_toml(_PRESETS / f"{base}.toml")
            for stage, values in changed.items():
                tables[stage] = tables.get(stage, {}) | values if isinstance(values, dict) else values
        stages: dict[str, Any] = {
            name: _stage(path, name, values)
            for name, values in tables.items()
            if not (values is False and name in STAGES)
        }
        with naming(path):
            return cls(**stages)

    def shutter(self, height: int) -> Shutter:
        """Return how the renderer has to expose an image of so many rows."""
        if self.timing is None:
            return Shutter()
        return Shutter(1e-3 * self.timing.exposure_ms, 1e-3 * self.timing.readout_ms / height)

    @property
    def psf_sigma_px(self) -> float:
        """The blur that the renderer has to apply, px; its own default without a lens."""
        return Optics().psf_sigma_px if self.lens is None else self.lens.psf_sigma_px

    def exposed_for(self, exposure_s: float) -> Self:
        """Return the same camera with another exposure time, s, which changes the electrons in proportion."""
        if self.timing is None:
            return self
        share = 1e3 * exposure_s / self.timing.exposure_ms if self.timing.exposure_ms else 1.0
        sensor = self.sensor and replace(self.sensor, white_e=share * self.sensor.white_e)
        return replace(self, timing=replace(self.timing, exposure_ms=1e3 * exposure_s), sensor=sensor)


#: Table of a file -> what it holds.
STAGES: dict[str, type[Stage]] = {
    "timing": ExposureTiming,
    "lens": Lens,
    "lamp": Lamp,
    "glint": Glint,
    "defocus": Defocus,
    "vignetting": Vignetting,
    "resizing": Resizing,
    "flicker": Flicker,
    "sensor": Photosensor,
    "auto_exposure": AutoExposure,
    "mosaic": Mosaic,
    "white_noise": WhiteNoise,
    "tone": ToneCurve,
    "denoise": SpatialDenoise,
    "temporal_denoise": TemporalDenoise,
    "sharpening": Sharpening,
    "jpeg": Jpeg,
}


def preset_names() -> tuple[str, ...]:
    """Return the names of the presets, the plainest first."""
    return ("clean", *sorted(path.stem for path in _PRESETS.glob("*.toml") if path.stem != "clean"))


def _stage(path: str | Path, name: str, values: object) -> Stage:
    if name not in STAGES:
        raise InputError(f"{path}: unknown stage {name!r}; known are preset, {', '.join(STAGES)}")
    if not isinstance(values, dict):
        raise InputError(f"{path}: {name} must be a table [{name}] of its parameters, or false, got {values!r}")
    keys = [each.name for each in fields(STAGES[name])]
    for key in values:
        if key not in keys:
            raise InputError(f"{path}: [{name}] has an unknown key {key!r}; known are {', '.join(keys)}")
    missing = [key for key in keys if key not in values]
    if missing:
        raise InputError(f"{path}: [{name}] lacks {', '.join(missing)}")
    try:
        return STAGES[name](
            **{key: tuple(value) if isinstance(value, list) else value for key, value in values.items()}
        )
    except InputError as error:
        raise InputError(f"{path}: [{name}] {error}") from None
