"""Section 0: what each stage of a camera does to a disc of 20 px, found by armsight's fit and by two plain methods.

A grey plate faces the camera, 1 mm a pixel, with discs on dark squares at random positions. The plain methods know
nothing of the fit: the half-level contour along rays from the true centre with a circle through it, and the first moments
of the light.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np

from armsight.data import Body
from armsight.geometry.pose import pose
from armsight.sim.camera.pipeline import SimulatedCamera
from armsight.sim.camera.stages import (
    CameraPipeline,
    Defocus,
    ExposureTiming,
    Flicker,
    Glint,
    Jpeg,
    Lamp,
    Lens,
    Mosaic,
    Photosensor,
    Resizing,
    Sharpening,
    SpatialDenoise,
    TemporalDenoise,
    ToneCurve,
    Vignetting,
    WhiteNoise,
    preset_names,
)
from armsight.sim.render.render import radiance
from armsight.sim.render.scene import PosedBody, plate
from armsight.vision.camera import Camera
from armsight.vision.markers.discs import DiscTarget
from marker_report import Report

SIZE, FOCAL, DISTANCE_M = (1280, 720), 900.0, 0.9  # a pixel is 1 mm
RADIUS_PX, SQUARE_PX, PITCH_PX = 10.0, 56, 80
DARK, GREY, BRIGHT = 0.06, 0.4, 0.85
#: A disc is taken for found where a fit is so near to where it is expected.
NEAR_PX = 3.0
CAMERA = Camera(SIZE, "none", np.array([FOCAL, FOCAL, (SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2]), np.zeros(0))
#: A sensor without noise worth the name, for stages that need one.
IDEAL = Photosensor(1e6, 1e6, 0.0, 0.0, 0.0, 0.0, 0.0, 14, 0.0)
EVEN = (1.0, 1.0, 1.0)
#: The speed of moving discs in the image, px/s, and the shutters that see them.
SPEED = 500.0
BLUR_8MS = ExposureTiming(30, 8, 0, 0, 0, 0, 0)
ROLLING = ExposureTiming(30, 0, 14.4, 0, 0, 0, 0)


@dataclass(frozen=True)
class Case:
    """A stage under test.

    Attributes:
        name: as it is printed.
        pipeline: the camera.
        speed: of the discs to the right, px/s.
        before: images that the camera has seen, of moving discs where they were then.
    """

    name: str
    pipeline: CameraPipeline
    speed: float = 0.0
    before: int = 0


def cases() -> Iterator[Case]:
    """Return every stage alone, and the presets."""
    alone, noisy = CameraPipeline(), CameraPipeline(white_noise=WhiteNoise(2.0))
    good = CameraPipeline.load("webcam-good-light").sensor
    poor = CameraPipeline.load("webcam-poor-light").sensor
    assert good is not None
    assert poor is not None
    full = replace(good, full_well_e=good.white_e)
    yield Case("rounding to 8 bits alone", alone)
    yield Case("white noise, 2 grey levels", noisy)
    yield Case("motion blur, 8 ms at 500 px/s: 4 px", replace(alone, timing=BLUR_8MS), SPEED)
    yield Case("rolling shutter, 14.4 ms, 500 px/s", replace(alone, timing=ROLLING), SPEED)
    yield Case("lamp at 0.5 m, 1 mm a pixel, in a corner", replace(alone, lamp=Lamp(0.5, (0.0, 0.0), 1.0)))
    for peak in (0.1, 1.0):
        yield Case(f"glint of 3 px at the rim, peak {peak:g}", replace(alone, glint=Glint(peak, 3.0, (0.0, 0.0))))
    for sigma in (0.35, 0.5, 1.0):
        yield Case(f"lens, blur of {sigma:g} px", replace(alone, lens=Lens(sigma)))
    for radius in (1.0, 2.0):
        yield Case(f"defocus, radius {radius:g} px", replace(alone, defocus=Defocus(radius)))
    yield Case("vignetting, 40 % in the corners", replace(alone, vignetting=Vignetting(0.4)))
    yield Case("flicker 100 Hz, depth 0.3, rolling", replace(alone, timing=ROLLING, flicker=Flicker(100, 0.3)))
    yield Case("sensor, 1700 electrons at white", CameraPipeline(sensor=replace(full, prnu=0.0, dsnu_e=0.0)))
    dim = replace(poor, full_well_e=500.0, prnu=0.0, dsnu_e=0.0, hot_share=0.0)
    yield Case("sensor, 500 electrons at white", CameraPipeline(sensor=dim))
    yield Case("fixed pattern, 2 % PRNU", CameraPipeline(sensor=replace(IDEAL, prnu=0.02)))
    yield Case("saturation, light 2 x the range", CameraPipeline(sensor=replace(IDEAL, full_well_e=5e5)))
    for how in ("bilinear", "edge"):
        colour = Mosaic((0.6, 1.0, 0.62), (1.65, 1.0, 1.62), how)
        yield Case(f"mosaic, {how} demosaic, white balance 1 % off", CameraPipeline(sensor=IDEAL, mosaic=colour))
    yield Case("tone curve, gamma 2.2", replace(alone, tone=ToneCurve(1.0, 2.2, 0.0)))
    yield Case("tone curve, gamma 2.2, contrast 0.5", replace(alone, tone=ToneCurve(1.0, 2.2, 0.5)))
    yield Case("spatial denoise of noise 2", replace(noisy, denoise=SpatialDenoise(7, 2.0, 16.0)))
    temporal = replace(noisy, temporal_denoise=TemporalDenoise(0.7, 16.0))
    yield Case("temporal denoise of noise 2, at rest", temporal, 0.0, 8)
    yield Case("temporal denoise of noise 2, 0.3 px an image", temporal, 9.0, 8)
    for amount, sigma in ((0.5, 1.0), (1.0, 1.0), (1.5, 1.0), (1.0, 1.5)):
        yield Case(f"sharpening {amount:g}, sigma {sigma:g} px", replace(alone, sharpening=Sharpening(amount, sigma)))
    for scale in (1.5, 0.5):
        yield Case(f"resizing from {scale:g} times the size", replace(alone, resizing=Resizing(scale, "linear")))
    for quality in (95, 85, 70, 50):
        yield Case(f"JPEG quality {quality}", replace(alone, jpeg=Jpeg(quality, "4:2:0")))
    for name in preset_names():
        pipeline = CameraPipeline.load(name)
        yield Case(f"preset {name}", pipeline, 0.0, 4 if pipeline.temporal_denoise else 0)


def plate_of_discs(rng: np.random.Generator) -> tuple[PosedBody, np.ndarray]:
    """Return a plate of discs on dark squares that faces the camera, and the discs' centres (N, 2), px."""
    u, v = np.meshgrid(*(np.arange(PITCH_PX, n - PITCH_PX / 2, PITCH_PX) for n in SIZE))
    uv = np.stack([u.ravel(), v.ravel()], axis=1) + rng.uniform(-8, 8, (u.size, 2))
    xy, side = (uv - CAMERA.intrinsics[2:]) * 1e-3, SQUARE_PX * 1e-3
    square = plate(side, side, DARK, [(0.0, 0.0, RADIUS_PX * 1e-3, BRIGHT)])
    squares = [square.on_body(pose(np.eye(3), np.append(p, 0.0))) for p in xy]
    return PosedBody((plate(2.0, 2.0, GREY), *squares), pose(np.eye(3), np.array([0.0, 0.0, DISTANCE_M]))), uv


def images(case: Case, rng: np.random.Generator, seed: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Return images of a case and the true centres (N, 2) of the discs in each that count, when their rows looked."""
    pipeline = case.pipeline
    shutter = pipeline.shutter(SIZE[1])
    for repeat in range(2):
        body, uv = plate_of_discs(rng)
        device = SimulatedCamera(pipeline, SIZE, 100 * seed + repeat)
        twist = np.array([case.speed * 1e-3, 0, 0, 0, 0, 0])
        for k in range(-case.before, 1):
            T = body.T_camera_body.copy()
            T[0, 3] = 1e-3 * case.speed * k / 30
            posed = PosedBody(body.patterns, T, twist)
            light = radiance(CAMERA, [posed], psf_sigma_px=pipeline.psf_sigma_px, shutter=shutter)
            if pipeline.glint is None:
                image = device.expose(light, k / 30)
        if pipeline.glint is None:
            yield image, uv + np.outer(shutter.row_s * (uv[:, 1] - (SIZE[1] - 1) / 2), (case.speed, 0.0))
            continue
        for middle in uv[rng.choice(len(uv), 30, replace=False)]:
            angle = rng.uniform(0, 2 * np.pi)
            at = middle + 0.8 * RADIUS_PX * np.array([np.cos(angle), np.sin(angle)])
            glint = replace(pipeline.glint, centre=tuple((at / (np.array(SIZE) - 1)).tolist()))
            yield SimulatedCamera(replace(pipeline, glint=glint), SIZE, seed).expose(light), middle[None]


def by_fit(image: np.ndarray, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return centres (N, 2), radii (N,) and covariances (N, 2, 2) of armsight's disc fit; NaN where none is near."""
    body = Body("discs", ("A", "B", "C"), np.array([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]]))
    discs = DiscTarget(body, np.full(3, 0.01), np.ones(3, dtype=bool), np.tile([0.0, 0.0, -1.0], (3, 1))).find(image)
    found, radius, cov = np.full(uv.shape, np.nan), np.full(len(uv), np.nan), np.full((len(uv), 2, 2), np.nan)
    if len(discs.uv):
        apart = np.linalg.norm(discs.uv - uv[:, None], axis=2)
        nearest = apart.argmin(axis=1)
        good = apart[np.arange(len(uv)), nearest] < NEAR_PX
        S11, S12, S22 = discs.shape[nearest[good]].T
        found[good], cov[good] = discs.uv[nearest[good]], discs.cov_uv[nearest[good]]
        radius[good] = (S11 * S22 - S12**2) ** 0.25
    return found, radius, cov


def levels(image: np.ndarray, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the levels within (N,) and outside (N,) discs, and the edge's width (N,) from 10 to 90 % of their step, px."""
    inside, outside, width = np.empty(len(uv)), np.empty(len(uv)), np.empty(len(uv))
    reach = 24
    for i, (u, v) in enumerate(uv):
        window = image[round(v) - reach : round(v) + reach + 1, round(u) - reach : round(u) + reach + 1].astype(float)
        y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
        r = np.hypot(x + round(u) - u, y + round(v) - v)
        inside[i], outside[i] = window[r < 5].mean(), window[(r > 16) & (r < 22)].mean()
        near = (r > 3) & (r < 17)
        bins = np.round((r[near] - 3) / 0.25).astype(int)
        profile = np.bincount(bins, window[near]) / np.maximum(np.bincount(bins), 1)
        share = (profile - outside[i]) / (inside[i] - outside[i])
        at = [3 + 0.25 * _crossing(share, level) for level in (0.9, 0.1)]
        width[i] = at[1] - at[0]
    return inside, outside, width


def _crossing(profile: np.ndarray, level: float) -> float:
    """Return the index, with fraction, at which a falling profile last goes through a level."""
    above = np.flatnonzero(profile[:-1] >= level)
    k = int(above[-1])
    return k + (profile[k] - level) / (profile[k] - profile[k + 1])


def by_contour(image: np.ndarray, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return centres (N, 2) and radii (N,) of circles through the contour at half of the step, 64 rays a disc."""
    inside, outside, _ = levels(image, uv)
    angle, r = np.arange(64) * (2 * np.pi / 64), np.arange(3.0, 17.0, 0.1)
    c, s = np.cos(angle), np.sin(angle)
    found, radius = np.empty(uv.shape), np.empty(len(uv))
    for i, (u, v) in enumerate(uv):
        x, y = (u + np.outer(c, r)).astype(np.float32), (v + np.outer(s, r)).astype(np.float32)
        profiles = cv2.remap(image.astype(np.float32), x, y, cv2.INTER_LINEAR)
        half = (inside[i] + outside[i]) / 2
        rim = np.array([3.0 + 0.1 * _crossing(profile, half) for profile in profiles])
        A = np.column_stack([2 * rim * c, 2 * rim * s, np.ones(64)])  # Kasa's circle: linear in centre and rest
        du, dv, rest = np.linalg.lstsq(A, rim**2, rcond=None)[0]
        found[i], radius[i] = (u + du, v + dv), np.sqrt(rest + du**2 + dv**2)
    return found, radius


def by_moments(image: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Return centroids (N, 2) of the light above the surround, within 18 px."""
    _, outside, _ = levels(image, uv)
    found = np.empty(uv.shape)
    y, x = np.mgrid[-20:21, -20:21]
    for i, (u, v) in enumerate(uv):
        u0, v0 = round(u), round(v)
        window = image[v0 - 20 : v0 + 21, u0 - 20 : u0 + 21] - outside[i]
        window = window * (np.hypot(x + u0 - u, y + v0 - v) < 18)
        found[i] = u0 + (window * x).sum() / window.sum(), v0 + (window * y).sum() / window.sum()
    return found


#: What the fit gives, and how each column is printed.
FIT = ("fit RMS", "fit mean u", "fit mean v", "fit RMS / sigma", "fit radius")
FORMAT = {
    "found": "{:5.0f}",
    "fit RMS": "{:7.3f}",
    "fit mean u": "{:+10.3f}",
    "fit mean v": "{:+10.3f}",
    "fit RMS / sigma": "{:15.2f}",
    "fit radius": "{:+10.3f}",
    "contour RMS": "{:11.3f}",
    "contour radius": "{:+14.3f}",
    "moments RMS": "{:11.3f}",
    "edge width": "{:10.2f}",
}


def root_mean_square(error: np.ndarray) -> float:
    """Return the root of the mean squared length of errors (N, 2)."""
    return float(np.sqrt((error**2).sum(axis=1).mean()))


def section(seed: int, report: Report) -> None:
    report.say(f"  {'disc of 20 px; all in px, found in %':50s}" + " ".join(FORMAT))
    for number, case in enumerate(cases()):
        rng, parts = np.random.default_rng([seed, number]), []
        for image, uv in images(case, rng, seed + number):
            fit, radius, cov = by_fit(image, uv)
            circle, circle_radius = by_contour(image, uv)
            width = levels(image, uv)[2]
            sigma = np.sqrt(np.trace(cov, axis1=1, axis2=2))
            parts.append((fit - uv, radius, sigma, circle - uv, circle_radius, by_moments(image, uv) - uv, width))
        off, radius, sigma, circle, circle_radius, moments, width = (
            np.concatenate(p) for p in zip(*parts, strict=True)
        )
        good = np.isfinite(radius)
        fit = np.full(5, np.nan)
        if good.any():
            rms = root_mean_square(off[good])
            mean, expected = off[good].mean(axis=0), np.sqrt(np.mean(sigma[good] ** 2))
            fit = np.array([rms, *mean, rms / expected, radius[good].mean() - RADIUS_PX])
        values = {"found": 100 * good.mean()} | dict(zip(FIT, fit, strict=True))
        values |= {"contour RMS": root_mean_square(circle), "contour radius": circle_radius.mean() - RADIUS_PX}
        values |= {"moments RMS": root_mean_square(moments), "edge width": width.mean()}
        report.say(f"  {case.name:50s}" + " ".join(FORMAT[name].format(value) for name, value in values.items()))
        report.found[case.name] = {name: round(float(value), 4) for name, value in values.items()}
