"""Images with truth: flat patterns on rigid bodies, seen through the full camera model.

Bodies, a background and a camera go in; an 8-bit image comes out that is exact in area (``paint``), in the lens's blur
and in the sensor's noise (``optics``). Light is linear: a grey level is proportional to the light on the pixel. Shadows
and glints are not modelled; between bodies the nearer one covers, by the share of each part of a pixel that it fills.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from armsight.data import Array, Image
from armsight.errors import InputError
from armsight.geometry.pose import exp_se3, inverse, transform
from armsight.sim.render.optics import Optics, Radiance, Sensor, blurred, exposed, shaded
from armsight.sim.render.paint import SUB, Box, paint, paint_disc
from armsight.sim.render.scene import CLEAR, Pattern, PosedBody
from armsight.vision.camera import Camera

#: Points along each side of a pattern whose projections bound it in the image.
OUTLINE = 16


@dataclass(frozen=True)
class Shutter:
    """When the pixels look."""

    exposure_s: float = 0.0  #: how long each row gathers light, s; 0 freezes all motion
    row_s: float = 0.0  #: how much later each row starts than the one above, s; 0 is a global shutter


#: The rays of so many rows are computed at once: those of all would need ten times the memory of the result.
_ROWS_AT_ONCE = 64


def corner_rays(camera: Camera) -> Array:
    """Return the rays (H + 1, W + 1, 3) through the corners of a camera's pixels: of depth one, of a fisheye unit ones."""
    width, height = camera.image_size_px
    rays = np.empty((height + 1, width + 1, 3))
    for first in range(0, height + 1, _ROWS_AT_ONCE):
        some = rays[first : first + _ROWS_AT_ONCE]
        v, u = np.mgrid[first : first + len(some), : width + 1] - 0.5
        some[:] = camera.unproject(np.stack([u.ravel(), v.ravel()], axis=1)).reshape(some.shape)
    if camera.model != "fisheye":
        rays /= rays[..., 2:].copy()  # then they are linear in the pixels but for the distortion
    return rays


#: Kept for the next image: tens of MB for a camera.
kept_rays = lru_cache(maxsize=4)(corner_rays)


def _covered(camera: Camera, T_camera_pattern: Array, points: Array) -> Box | None:
    """Bound in pixels (first column, first row, end column, end row) what an outline (N, 2) of a plane can cover."""
    width, height = camera.image_size_px
    p = transform(T_camera_pattern, np.column_stack([points, np.zeros(len(points))]))
    uv = camera.project(p)
    rays = camera.unproject(uv)
    # Far off the axis a distortion polynomial folds back: a projection counts only where its ray leads to the point.
    if not (np.linalg.norm(rays - p / np.linalg.norm(p, axis=1, keepdims=True), axis=1) < 1e-6).all():
        return 0, 0, width, height
    low = np.clip(np.floor(uv.min(axis=0)) - 1, 0, (width, height)).astype(int)
    high = np.clip(np.ceil(uv.max(axis=0)) + 2, 0, (width, height)).astype(int)
    return None if (low >= high).any() else (int(low[0]), int(low[1]), int(high[0]), int(high[1]))


@lru_cache(maxsize=16)
def outline(pattern: Pattern) -> Array:
    """Return points (4 * OUTLINE, 2) around the rectangle that a pattern's cells fill, m, pattern frame."""
    x, y = pattern.x_edges, pattern.y_edges
    t = np.linspace(0, 1, OUTLINE)[:, None]
    corners = np.array([[x[0], y[0]], [x[-1], y[0]], [x[-1], y[-1]], [x[0], y[-1]]])
    return np.concatenate([a + t * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)])


def _circle(disc: Array) -> Array:
    """Return points (N, 2) around a disc (4,)."""
    angle = np.arange(4 * OUTLINE) * (math.tau / (4 * OUTLINE))
    return np.asarray(disc[:2] + disc[2] * 1.01 * np.stack([np.cos(angle), np.sin(angle)], axis=1))


class _Canvas:
    """An image being painted: one value a pixel, and parts where an edge crosses it."""

    def __init__(self, camera: Camera, background: Image | float) -> None:
        width, height = camera.image_size_px
        self.camera = camera
        self.rays = kept_rays(camera)
        if np.shape(background) not in ((), (height, width)):
            raise InputError(f"the background is {np.shape(background)}, must be a number or ({height}, {width})")
        self.coarse = np.empty((height, width))
        self.coarse[:] = background
        self.slot = np.full((height, width), -1, np.int32)
        self.fine = np.empty((1 << 14, SUB, SUB))
        self.count = 0

    def paint(self, pattern: Pattern, Ts_camera_body: Array) -> None:
        """Paint a pattern at poses (1 or H, 4, 4): one for all rows or one for each."""
        Ts = Ts_camera_body @ pattern.T_body_pattern
        to_plane = Ts[:, :3, [0, 1, 3]]
        facing = np.linalg.det(to_plane) > 0  # the camera is on the side that z points away from
        if not facing.all():
            return
        Ms = np.asarray(np.linalg.inv(to_plane), dtype=np.float64)
        ends = Ts[[0, -1]] if len(Ts) > 1 else Ts
        x, y = np.array(pattern.x_edges), np.array(pattern.y_edges)
        grid = (x, y, np.pad(pattern.values, 1, constant_values=CLEAR))
        box = self._box(ends, outline(pattern))
        if box is not None:
            self.fine, self.count = paint(
                self.rays, Ms, box, (0, 0), grid, self.coarse, self.slot, self.fine, self.count
            )
        for disc in pattern.discs:
            box = self._box(ends, _circle(disc))
            if box is not None:
                self.fine, self.count = paint_disc(
                    self.rays, Ms, box, (0, 0), np.array(disc), self.coarse, self.slot, self.fine, self.count
                )

    def _box(self, Ts: Array, points: Array) -> Box | None:
        """Bound what an outline covers at any of a few poses."""
        boxes = [box for T in Ts if (box := _covered(self.camera, T, points)) is not None]
        if not boxes:
            return None
        low, high = np.min(boxes, axis=0), np.max(boxes, axis=0)
        return int(low[0]), int(low[1]), int(high[2]), int(high[3])


def _sub_exposures(camera: Camera, bodies: Sequence[PosedBody], exposure_s: float) -> list[tuple[float, float]]:
    """Return the times (s, from the middle) and weights of the sub-exposures that make up one exposure.

    They are Gauss and Legendre's: the blurred image of a moving edge is smooth over a pixel, so about one for each
    pixel of the way is as good as very many evenly spaced.
    """
    way_px = 0.0
    for body in bodies:
        for pattern in body.patterns:
            reach = np.linalg.norm(pattern.T_body_pattern[:3, 3]) + np.hypot(
                np.abs(pattern.x_edges).max(), np.abs(pattern.y_edges).max()
            )
            depth = max(np.linalg.norm(body.T_camera_body[:3, 3]) - reach, 0.05)
            speed = np.linalg.norm(body.twist[:3]) + np.linalg.norm(body.twist[3:]) * reach
            way_px = max(way_px, float(speed / depth * camera.intrinsics[:2].max() * exposure_s))
    if way_px == 0:
        return [(0.0, 1.0)]
    nodes, weights = np.polynomial.legendre.leggauss(2 + math.ceil(way_px))
    return [(0.5 * exposure_s * float(x), 0.5 * float(w)) for x, w in zip(nodes, weights, strict=True)]


def _distance(body: PosedBody) -> float:
    """Return how far the middle of a body's patterns is from the camera, m."""
    centres = np.mean([pattern.T_body_pattern[:3, 3] for pattern in body.patterns], axis=0)
    return float(np.linalg.norm(transform(body.T_camera_body, centres)))


def radiance(
    camera: Camera,
    bodies: Sequence[PosedBody],
    background: Image | float = 0.4,
    *,
    psf_sigma_px: float = 0.7,
    shutter: Shutter | None = None,
) -> Radiance:
    """Return the light (H, W) on each pixel of a camera, before vignetting and noise; arguments as :func:`render`."""
    shutter = shutter or Shutter()
    height = camera.image_size_px[1]
    rows = (np.arange(height) - (height - 1) / 2) * shutter.row_s if shutter.row_s else np.zeros(1)
    ordered = sorted((body for body in bodies if body.patterns), key=_distance, reverse=True)
    total = np.zeros((height, camera.image_size_px[0]), np.float32)
    for time, weight in _sub_exposures(camera, bodies, shutter.exposure_s):
        canvas = _Canvas(camera, background)
        for body in ordered:
            moving = shutter.row_s and body.twist.any()
            t = (rows if moving else np.zeros(1)) + time
            Ts = body.T_camera_body @ exp_se3(np.outer(t, body.twist) + np.outer(0.5 * t * t, body.acceleration))
            for pattern in body.patterns:
                canvas.paint(pattern, Ts)
        total += np.float32(weight) * blurred(canvas.coarse, canvas.slot, canvas.fine[: canvas.count], psf_sigma_px)
    return total


def render(
    camera: Camera,
    bodies: Sequence[PosedBody],
    background: Image | float = 0.4,
    *,
    optics: Optics | None = None,
    sensor: Sensor | None = None,
    shutter: Shutter | None = None,
    rng: np.random.Generator | None = None,
) -> Image:
    """Render what a camera sees of bodies posed in its frame, the nearer covering the farther: (H, W) uint8.

    By default lens blur is 0.7 px, noise 2 grey levels from ``rng`` (None: none), without motion blur. ``background``:
    one reflectance, or an image (H, W) of the camera's size, else InputError.
    """
    optics = optics or Optics()
    light = radiance(camera, bodies, background, psf_sigma_px=optics.psf_sigma_px, shutter=shutter)
    return exposed(shaded(light, optics), sensor or Sensor(), rng)


def render_pair(
    cameras: tuple[Camera, Camera],
    T_left_right: Array,
    bodies: Sequence[PosedBody],
    backgrounds: tuple[Image | float, Image | float] = (0.4, 0.4),
    *,
    optics: Optics | None = None,
    sensor: Sensor | None = None,
    shutter: Shutter | None = None,
    rng: np.random.Generator | None = None,
) -> tuple[Image, Image]:
    """Render what two cameras see at the same moment; bodies are posed in the left one's frame."""
    T_right_left = inverse(T_left_right)
    views = (list(bodies), [body.seen_from(T_right_left) for body in bodies])
    left, right = (
        render(camera, view, background, optics=optics, sensor=sensor, shutter=shutter, rng=rng)
        for camera, view, background in zip(cameras, views, backgrounds, strict=True)
    )
    return left, right
