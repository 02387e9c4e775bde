"""How far markers are off in the images of a camera: a chart of them, rendered through the camera's model and detected.

In: a camera's stages, a kind of marker, its size in the image, how far it moves during an exposure. Out: the standard
deviation of a detected position, px. The detectors are those that measure, so there is no second model of noise: mosaic,
denoising, sharpening and JPEG have their share, wherever in the pixels a marker is.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from armsight.data import Array, Body, Image
from armsight.errors import InputError
from armsight.geometry.pose import pose, transform
from armsight.geometry.rotation import exp_so3
from armsight.sim.camera.pipeline import SimulatedCamera
from armsight.sim.camera.stages import CameraPipeline
from armsight.sim.render.optics import Radiance
from armsight.sim.render.render import radiance
from armsight.sim.render.scene import BLACK, WHITE, Pattern, PosedBody, chessboard, marker_bits, plate, tag
from armsight.vision.camera import Camera
from armsight.vision.markers.board import open_board
from armsight.vision.markers.discs import DiscTarget
from armsight.vision.markers.tag import CORNERS, Tag, TagTarget

#: Detections that a chart needs: its sigma is then known to 4 %; half: 6 %, double: 3 % in twice the time.
LEAST_DETECTIONS = 150
_MOST_IMAGES, _MOST_SPOTS = 6, 200
#: Size of a chart's image and its focal length, px; both change nothing but the time.
_SIZE_PX, _FOCAL_PX = (640, 480), 800.0
#: Images of a still scene until what a camera mixes of earlier ones has settled.
_SETTLED = 3
#: Sizes are rounded to this share, movements to this, px: charts are used again.
_STEP, _STEP_PX = 0.2, 0.5
#: Share of a chart's markers that must be found.
_LEAST_FOUND = 0.5
FAMILY = "tag36h11"
#: A detection within this share of a marker's size belongs to it; one further off by so many sigmas is a blunder that the
#: measurement would leave out.
_NEAR, _BLUNDER = 0.35, 6.0


class Chart(NamedTuple):
    """What is rendered, where its markers are (N, 2), m, and what finds them in an image, px."""

    patterns: tuple[Pattern, ...]
    spots: Array
    find: Callable[[Image], Array]


def marker_noise(pipeline: CameraPipeline, kind: str, size_px: float, moved_px: float = 0.0) -> float:
    """Return the standard deviation of one marker's position along one axis, px.

    Args:
        pipeline: the camera's stages.
        kind: disc, tag or chessboard.
        size_px: diameter of a disc, side of a tag or of a square in the image.
        moved_px: way of the marker during the exposure.

    Raises:
        InputError: at this size, or so blurred, most of such markers are not found.
    """
    size = math.exp(_STEP * round(math.log(size_px) / _STEP))
    scale = math.sqrt(size / size_px) if kind == "disc" else 1.0  # a longer rim averages more; a corner is a corner
    return scale * _noise(pipeline, kind, size, _STEP_PX * round(moved_px / _STEP_PX))


@lru_cache(maxsize=512)
def _noise(pipeline: CameraPipeline, kind: str, size_px: float, moved_px: float) -> float:
    """Render and detect charts until there are enough detections."""
    camera = Camera(_SIZE_PX, "none", np.array([_FOCAL_PX, _FOCAL_PX, *((n - 1) / 2 for n in _SIZE_PX)]), np.zeros(0))
    rng, off, asked = np.random.default_rng(42), list[Array](), 0
    for number in range(_MOST_IMAGES):
        chart = _CHARTS[kind](size_px / _FOCAL_PX, rng)
        T = pose(exp_so3(np.array([0.0, 0.0, rng.uniform(-0.3, 0.3)])), np.array([0.0, 0.0, 1.0]))
        light = radiance(camera, [PosedBody(chart.patterns, T)], psf_sigma_px=pipeline.psf_sigma_px)
        if moved_px > 0:
            light = _smeared(light, moved_px, rng.uniform(0, np.pi))
        imager = SimulatedCamera(pipeline, _SIZE_PX, seed=number)
        for _ in range(1 if moved_px > 0 else _SETTLED):
            image = imager.expose(light)
        true = camera.project(transform(T, np.column_stack([chart.spots, np.zeros(len(chart.spots))])))
        inside = ((true > 2 * size_px) & (true < np.array(_SIZE_PX) - 2 * size_px)).all(axis=1)
        asked += max(int(inside.sum()), 1)
        found = chart.find(np.asarray(image))
        if len(found):
            gaps = np.linalg.norm(found[:, None] - true[None], axis=2)
            near = gaps.min(axis=1) < _NEAR * size_px
            off.append((found - true[gaps.argmin(axis=1)])[near])
        if sum(map(len, off)) >= LEAST_DETECTIONS:
            break
    every = np.concatenate([np.zeros((0, 2)), *off])
    if len(every) < max(_LEAST_FOUND * asked, 8):
        blur = f", blurred over {moved_px:.1f} px" if moved_px else ""
        raise InputError(f"a {kind} of {size_px:.1f} px{blur}: {len(every)} of {asked} are found in a chart")
    every = every - np.median(every, axis=0)  # what all share, the calibration takes up
    scale = float(np.median(np.abs(every)) / 0.6745)
    every = every[(np.abs(every) < _BLUNDER * max(scale, 1e-4)).all(axis=1)]
    return float(np.sqrt((every**2).mean()))


def _smeared(light: Radiance, way_px: float, direction: float) -> Radiance:
    """Return light (H, W) that moved during the exposure: its spectrum times that of the way."""
    down, across = np.fft.fftfreq(light.shape[0])[:, None], np.fft.rfftfreq(light.shape[1])
    spectrum = np.fft.rfft2(light) * np.sinc(way_px * (across * math.cos(direction) + down * math.sin(direction)))
    return np.fft.irfft2(spectrum, light.shape).astype(np.float32)


def _spots(pitch_m: float, rng: np.random.Generator) -> Array:
    """Return positions (N, 2) of a grid that fills the image, each at a phase of its own, m."""
    n = [max(int(0.9 * size / (pitch_m * _FOCAL_PX)), 1) for size in _SIZE_PX]
    x, y = (pitch_m * (np.arange(count) - (count - 1) / 2) for count in n)
    spots = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    spots = rng.permutation(spots)[:_MOST_SPOTS]
    return np.asarray(spots + rng.uniform(-0.5, 0.5, spots.shape) / _FOCAL_PX)


def _discs(size_m: float, rng: np.random.Generator) -> Chart:
    """Return bright discs on a dark plate."""
    spots = _spots(2.3 * size_m, rng)
    target = DiscTarget(Body("chart", ("a",), np.zeros((1, 3))), np.ones(1), np.ones(1, bool), np.full((1, 3), np.nan))
    discs = [(x, y, size_m / 2, WHITE) for x, y in spots]
    return Chart((plate(2.0, 2.0, BLACK, discs),), spots, lambda image: target.find(image).uv)


def _tags(size_m: float, rng: np.random.Generator) -> Chart:
    """Return tags on a white plate; their corners are found."""
    tags, patterns, spots = list[Tag](), [plate(2.0, 2.0, WHITE)], list[Array]()
    for k, (x, y) in enumerate(_spots(1.5 * size_m, rng)):
        tags.append(Tag(f"t{k}", FAMILY, k, size_m, pose(np.eye(3), np.array([x, y, 0.0]))))
        patterns.append(tag(marker_bits(FAMILY, k), size_m).on_body(tags[-1].T_body_tag))
        spots.append(transform(tags[-1].T_body_tag, CORNERS * (size_m / 2))[:, :2])
    target = TagTarget("chart", tuple(tags))
    return Chart(tuple(patterns), np.concatenate(spots), lambda image: target.detect(image).uv)


def _squares(size_m: float, rng: np.random.Generator) -> Chart:
    """Return a chessboard that fits into the image."""
    columns, rows = (9, 6) if 12 * size_m * _FOCAL_PX < _SIZE_PX[0] else (4, 3)
    target = open_board(f"chessboard:{columns}x{rows}:{size_m:.9g}m")
    first = rng.uniform(-0.5, 0.5, 2) / _FOCAL_PX - size_m * np.array([columns - 1, rows - 1]) / 2
    board = chessboard(columns, rows, size_m).on_body(pose(np.eye(3), np.array([*first, 0.0])))
    return Chart((plate(2.0, 2.0, WHITE), board), target.body.points[:, :2] + first, lambda i: target.detect(i).uv)


_CHARTS = {"disc": _discs, "tag": _tags, "chessboard": _squares}
