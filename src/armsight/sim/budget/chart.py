"""How far markers are off in the images of a camera: a chart of them, rendered through the camera's model and detected.

In: a camera's stages, a kind of marker, its size in the image, how far it moves during an exposure. Out: the standard
deviation of a detected position, px. The detectors are those that measure, so there is no second model of noise: mosaic,
denoising, sharpening and JPEG have their share, wherever in the pixels a marker is. Behind the markers' own faces is the
renderer's grey: an automatic exposure meters what it would before a scene.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
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
from armsight.sim.render.scene import BLACK, CLEAR, WHITE, Pattern, PosedBody, chessboard, marker_bits, plate, tag
from armsight.vision.camera import Camera
from armsight.vision.markers.board import open_board
from armsight.vision.markers.discs import DiscTarget
from armsight.vision.markers.tag import Tag, TagTarget

#: Detections that a chart needs: its sigma is then known to 5 %; half: 7 %, double: 4 % in twice the time.
LEAST_DETECTIONS = 100
_MOST_IMAGES, _MOST_SPOTS = 3, 200
#: Size of a chart's image, and of one that a board of squares of up to so many px fits into, px; half: vignetting and
#: flicker are twice as steep, double: four times the time; and its focal length, px, which changes nothing.
_SIZE_PX, _BOARD_PX, _SQUARE_PX, _FOCAL_PX = (960, 540), (480, 400), 32.0, 800.0
#: Images of a still scene until what a camera mixes of earlier ones has settled.
_SETTLED = 3
#: Charts are of sizes of this ratio up to a largest, px (larger markers are taken to be no better), and of these ways,
#: shares of the size; the noise is interpolated between two that are both found.
_FIRST_PX, _LAST_PX, _RATIO, _WAYS = 8.0, 64.0, 2.0, (0.0, 0.125, 0.25, 0.5, 1.0)
#: Share of a chart's markers that must be found.
_LEAST_FOUND = 0.5
FAMILY = "tag36h11"
#: A detection within this share of a marker's size belongs to it; one further off by so many sigmas is a blunder that the
#: measurement would leave out.
_NEAR, _BLUNDER = 0.35, 6.0


class Chart(NamedTuple):
    """What is rendered, where its markers are (N, 2), m, and what finds them in an image, px.

    Of a marker of several points its middle is looked for, for edges that two points share make both err alike: the
    points' sigma is then the one that independent points need for a middle as uncertain.
    """

    patterns: tuple[Pattern, ...]
    spots: Array
    find: Callable[[Image], Array]
    points: int = 1


def marker_noise(pipeline: CameraPipeline, kind: str, size_px: float, moved_px: float = 0.0) -> float:
    """Return the standard deviation of the position of a disc, tag or corner of a square along one axis, px.

    ``size_px``: a disc's diameter, side of a tag or square; ``moved_px``: its way during the exposure. InputError: at
    this size, or so blurred, most of such markers are not found.
    """
    at = math.log(min(size_px, _LAST_PX) / _FIRST_PX) / math.log(_RATIO)
    way = min(_WAYS, key=lambda each: abs(each - moved_px / size_px))
    sizes = (_FIRST_PX * _RATIO**step for step in (math.floor(at), math.ceil(at)))
    first, second = (_noise(pipeline, kind, size, way * size)[0] for size in sizes)
    if first and second:
        return float(first * (second / first) ** (at - math.floor(at)))
    shown_px = min(size_px, _LAST_PX)
    sigma, found, asked = _noise(pipeline, kind, shown_px, moved_px * shown_px / size_px)
    if not sigma:
        blur = f", blurred over {moved_px:.1f} px" if moved_px else ""
        what = f"a {kind} of {size_px:.1f} px{blur}: {found} of {asked} are found in a chart"
        raise InputError(f"{what}: expected half of them: a wider aperture, less motion or larger markers are needed")
    return sigma


@lru_cache(maxsize=512)
def _noise(pipeline: CameraPipeline, kind: str, size_px: float, moved_px: float) -> tuple[float, int, int]:
    """Render and detect charts until there are enough; return sigma, 0 where most are not found, the found and all."""
    size = _BOARD_PX if kind == "square" and size_px <= _SQUARE_PX else _SIZE_PX
    imager = SimulatedCamera(pipeline, size, seed=0)
    rng, off, asked = np.random.default_rng(42), list[Array](), 0
    for number in range(_MOST_IMAGES):
        chart, light, true = _shown(kind, size_px, number, pipeline.psf_sigma_px, size)
        if moved_px > 0:
            light = _smeared(light, moved_px, rng.uniform(0, np.pi))
        imager.forget()
        for k in range(_SETTLED if pipeline.temporal_denoise and not moved_px else 1):
            image = imager.expose(light, number=_SETTLED * number + k)
        inside = ((true > 1.5 * size_px) & (true < np.array(size) - 1.5 * size_px)).all(axis=1)
        asked += max(int(inside.sum()), 1)
        found = chart.find(np.asarray(image))
        if len(found):
            gaps = np.linalg.norm(found[:, None] - true[None], axis=2)
            near = gaps.min(axis=1) < _NEAR * size_px
            off.append((found - true[gaps.argmin(axis=1)])[near])
        if chart.points * sum(map(len, off)) >= LEAST_DETECTIONS or asked > LEAST_DETECTIONS / _LEAST_FOUND:
            break
    every = np.concatenate([np.zeros((0, 2)), *off])
    if len(every) < max(_LEAST_FOUND * asked, 8):
        return 0.0, len(every), asked
    every = every - np.median(every, axis=0)  # what all share, the calibration takes up
    scale = float(np.median(np.abs(every)) / 0.6745)
    near = every[(np.abs(every) < _BLUNDER * max(scale, 1e-4)).all(axis=1)]
    return float(np.sqrt(chart.points * (near**2).mean())), len(every), asked


@lru_cache(maxsize=2)
def _camera(size: tuple[int, int]) -> Camera:
    """Return a chart's camera, one of a size: the renderer keeps 12 MB of rays for each."""
    return Camera(size, "none", np.array([_FOCAL_PX, _FOCAL_PX, *((n - 1) / 2 for n in size)]), np.zeros(0))


@lru_cache(maxsize=12)  # 2 MB each
def _shown(
    kind: str, size_px: float, number: int, psf_sigma_px: float, size: tuple[int, int]
) -> tuple[Chart, Radiance, Array]:
    """Return a chart, its light, and its markers in the image (N, 2), px."""
    rng = np.random.default_rng((42, number))
    chart = _CHARTS[kind](size_px / _FOCAL_PX, rng)
    T = pose(exp_so3(np.array([0.0, 0.0, rng.uniform(-0.3, 0.3)])), np.array([0.0, 0.0, 1.0]))
    light = radiance(camera := _camera(size), [PosedBody(chart.patterns, T)], psf_sigma_px=psf_sigma_px)
    return chart, light, camera.project(transform(T, np.column_stack([chart.spots, np.zeros(len(chart.spots))])))


def _smeared(light: Radiance, way_px: float, direction: float) -> Radiance:
    """Return light (H, W) that moved during the exposure: its spectrum times that of the way."""
    down, across = np.fft.fftfreq(light.shape[0])[:, None], np.fft.rfftfreq(light.shape[1])
    spectrum = np.fft.rfft2(light) * np.sinc(way_px * (across * math.cos(direction) + down * math.sin(direction)))
    return np.fft.irfft2(spectrum, light.shape).astype(np.float32)


def _faces(pitch_m: float, side_m: float, value: float) -> tuple[Pattern, Array]:
    """Return square faces of a reflectance on a grid that fills the image, and their middles (N, 2), m."""
    n = [max(int(0.9 * size / (pitch_m * _FOCAL_PX)), 1) for size in _SIZE_PX]
    x, y = (pitch_m * (np.arange(count) - (count - 1) / 2) for count in n)
    values = np.full((2 * n[1] - 1, 2 * n[0] - 1), CLEAR)
    values[::2, ::2] = value
    edges = [(each[:, None] + side_m / 2 * np.array([-1.0, 1.0])).ravel() for each in (x, y)]
    return Pattern(edges[0], edges[1], values), np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def _spots(grid: Array, rng: np.random.Generator) -> Array:
    """Return some positions (N, 2) of a grid, each at a phase of its own, m."""
    spots = rng.permutation(grid)[:_MOST_SPOTS]
    return np.asarray(spots + rng.uniform(-0.5, 0.5, spots.shape) / _FOCAL_PX)


def _discs(size_m: float, rng: np.random.Generator) -> Chart:
    """Return bright discs on dark faces."""
    faces, grid = _faces(2.4 * size_m, 2.2 * size_m, BLACK)
    spots = _spots(grid, rng)
    target = DiscTarget(Body("chart", ("a",), np.zeros((1, 3))), np.ones(1), np.ones(1, bool), np.full((1, 3), np.nan))
    discs = np.column_stack([spots, np.tile([size_m / 2, WHITE], (len(spots), 1))])
    return Chart((replace(faces, discs=discs),), spots, lambda image: target.find(image).uv)


def _tags(size_m: float, rng: np.random.Generator) -> Chart:
    """Return tags on white faces; their middles are found."""
    faces, grid = _faces(2 * size_m, 1.4 * size_m, WHITE)
    tags, patterns, spots = list[Tag](), [faces], _spots(grid, rng)[: LEAST_DETECTIONS // 2]
    for k, (x, y) in enumerate(spots):
        tags.append(Tag(f"t{k}", FAMILY, k, size_m, pose(np.eye(3), np.array([x, y, 0.0]))))
        patterns.append(tag(marker_bits(FAMILY, k), size_m).on_body(tags[-1].T_body_tag))
    target = TagTarget("chart", tuple(tags))

    def middles(image: Image) -> Array:
        found = target.detect(image)
        whole = np.flatnonzero(np.bincount(found.ids // 4, minlength=1) == 4)
        return np.array([found.uv[found.ids // 4 == k].mean(axis=0) for k in whole]).reshape(-1, 2)

    return Chart(tuple(patterns), spots, middles, points=4)


def _squares(size_m: float, rng: np.random.Generator) -> Chart:
    """Return a chessboard that fits into the image."""
    columns, rows = (9, 6) if 12 * size_m * _FOCAL_PX < _SIZE_PX[0] else (4, 3)
    target = open_board(f"chessboard:{columns}x{rows}:{size_m:.9g}m")
    first = rng.uniform(-0.5, 0.5, 2) / _FOCAL_PX - size_m * np.array([columns - 1, rows - 1]) / 2
    paper = plate((columns + 3) * size_m, (rows + 3) * size_m, WHITE)
    board = chessboard(columns, rows, size_m).on_body(pose(np.eye(3), np.array([*first, 0.0])))
    return Chart((paper, board), target.body.points[:, :2] + first, lambda i: target.detect(i).uv)


_CHARTS = {"disc": _discs, "tag": _tags, "square": _squares}
