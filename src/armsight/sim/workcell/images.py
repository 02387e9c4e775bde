"""One camera's images of the cell: what stands still is kept, the arm and the body are drawn where they are.

The arm is cast anew within the pixels it can cover (cell_links), at the middle of the exposure. Flat patterns (the body, a
board, a card) are painted exactly over it by ``paint``, once for about every pixel they move during the exposure, and
what of the arm is nearer stays before them. Then the lens's blur, light and vignetting, noise and rounding, as in
``optics``. Noise comes from a long strip drawn once, begun elsewhere for every image.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from armsight.data import Array, Ids, Image, Record
from armsight.geometry.pose import exp_se3, inverse, transform
from armsight.sim import cell_links
from armsight.sim.cell_noise import Window, exposed
from armsight.sim.cell_scene import LAMP_BASE, View, arm_capsules, capsule_boxes, corner_rays, pixel_rays, view
from armsight.sim.cell_solids import Solids
from armsight.sim.render.optics import (Optics, Radiance, Sensor, part_taps, shaded, spread)
from armsight.sim.render.faces import Exposure, paint_faces, palette
from armsight.sim.render.render import OUTLINE, Shutter, outline
from armsight.sim.render.scene import Pattern, Placed
from armsight.vision.camera import Camera

#: The lens and the light, after the shading correction that cameras do themselves.
LENS = Optics(0.7, vignetting=0.08, light_gradient=(0.04, -0.04))
#: Points around a pattern or a disc that bound it in the image, and by how much those around a disc are further out.
EDGE, _OUT = 16, 1.02
_STILL_PX = 0.05  # what moves less is painted once


@dataclass(frozen=True, eq=False)
class ArmSeen(Record):
    """The arm at the moment of an exposure.

    Attributes:
        parts: what it is made of.
        Ts_base_link: (7, 4, 4) row frames.
    """

    parts: Solids
    Ts_base_link: Array


@lru_cache(maxsize=64)
def _edges(patterns: tuple[Pattern, ...]) -> Array:
    """Return points (N, EDGE, 3) around each pattern's cells, and then each of its discs, m, body frame."""
    angle = np.arange(EDGE) * (math.tau / EDGE)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    around = []
    for pattern in patterns:
        for line in (outline(pattern)[:: 4 * OUTLINE // EDGE], *(d[:2] + _OUT * d[2] * circle for d in pattern.discs)):
            around.append(transform(pattern.T_body_pattern, np.column_stack([line, np.zeros(EDGE)])))
    return np.array(around)


_nodes = lru_cache(np.polynomial.legendre.leggauss)


def _moved(body: Placed, t_s: Array) -> Array:
    """Return a body's poses (N, 4, 4) so long (N,) after the middle of an exposure."""
    return np.asarray(body.T_camera_body @ exp_se3(np.outer(t_s, body.twist)))


class CellCamera:
    """A camera that stands in the cell.

    Attributes:
        camera: its lens.
        T_base_camera: (4, 4) where it is, m.
        still: what stands still before it.
    """

    def __init__(
        self,
        camera: Camera,
        T_base_camera: Array,
        foot: Solids,
        seed: int,
        *,
        sensor: Sensor | None = None,
        more: Array | None = None,
    ) -> None:
        """Look at the cell once.

        Args:
            camera: its lens.
            T_base_camera: (4, 4) where it is, m.
            foot: the arm's solids, whose base stands still.
            seed: of the clutter.
            sensor: noise of 2 grey levels by default.
            more: boxes that stand there besides, see cell_scene.
        """
        self.camera, self.T_base_camera = camera, T_base_camera
        self._sensor = sensor or Sensor()
        self._corners = corner_rays(camera)
        rays = pixel_rays(self._corners)
        self.still: View = view(camera, rays, T_base_camera, seed, foot, more)
        self._rays = np.ascontiguousarray(rays.transpose(2, 0, 1), np.float32)
        width, height = camera.image_size_px
        self._gain = shaded(np.full((height, width), self._sensor.gain, np.float32), LENS)
        self._still_grey = spread(self.still.light, LENS.psf_sigma_px) * self._gain
        to_lamp = inverse(T_base_camera)[:3, :3] @ LAMP_BASE
        self._lamp = (to_lamp / np.linalg.norm(to_lamp)).astype(np.float32)

    def image(
        self, arm: ArmSeen | None, bodies: Sequence[Placed], shutter: Shutter, strip: Radiance, start: int
    ) -> Image:
        """Return what the camera hands out.

        Args:
            arm: where the arm is; None leaves it out.
            bodies: flat patterns, placed in the camera's frame in the middle of the exposure of its middle row.
            shutter: how long it looks.
            strip: standard normal noise, from :func:`~armsight.sim.cell_noise.noise_strip`.
            start: where in it this image's noise begins.

        Returns:
            (H, W) uint8.
        """
        ends, radius, albedo = (np.zeros((0, 2, 3)), np.zeros(0), np.zeros(0))
        if arm is not None:
            ends, radius, albedo = arm_capsules(arm.parts, arm.Ts_base_link, self.T_base_camera)
        boxes = capsule_boxes(self.camera, ends, radius)
        exposure = self._exposure(bodies, shutter)
        margin = _reach(LENS.psf_sigma_px)
        crop = (0, 0, 0, 0) if exposure is None else self._around(exposure.shown(), 2 * margin)
        window = self._around(np.concatenate([[crop], boxes]), 2 * margin)
        u0, v0, u1, v1 = window
        light = self.still.light[v0:v1, u0:u1].copy()
        depth, ids = self.still.depth[v0:v1, u0:u1].copy(), np.zeros(light.shape, np.int16)
        cell_links.moving(self._rays, window, boxes, (ends, radius, albedo), self._lamp, light, depth, ids)
        seen = spread(light, LENS.psf_sigma_px) if light.size else light
        if exposure is not None and crop[0] < crop[2] and crop[1] < crop[3]:
            core = self._core(crop, margin)
            painted = self._painted(exposure, crop, window, (light, depth, ids))
            seen[_part(core, window)] = painted[_part(core, crop)]
        out: Image = np.empty(self._still_grey.shape, np.uint8)
        s = self._sensor
        core, noises = self._core(window, margin), (s.offset, s.read_noise, s.shot_noise)
        exposed(self._still_grey, seen, window, core, self._gain, strip, start, noises, out)
        return out

    def arm_ids(self, arm: ArmSeen) -> Image:
        """Return (H, W) which of the arm's moving solids each pixel sees, counted from 1; 0 where it sees none."""
        width, height = self.camera.image_size_px
        capsules = arm_capsules(arm.parts, arm.Ts_base_link, self.T_base_camera)
        boxes, window = capsule_boxes(self.camera, *capsules[:2]), (0, 0, width, height)
        light, depth, ids = self.still.light.copy(), self.still.depth.copy(), np.zeros((height, width), np.int16)
        cell_links.moving(self._rays, window, boxes, capsules, self._lamp, light, depth, ids)
        return ids

    def _around(self, boxes: Ids, margin: int) -> Window:
        """Return what holds all boxes (N, 4) that are not empty, with a margin, within the image."""
        full = boxes[(boxes[:, :2] < boxes[:, 2:]).all(axis=1)]
        if not len(full):
            return 0, 0, 0, 0
        u0, v0 = np.maximum(full[:, :2].min(axis=0) - margin, 0)
        u1, v1 = np.minimum(full[:, 2:].max(axis=0) + margin, self.camera.image_size_px)
        return int(u0), int(v0), int(u1), int(v1)

    def _exposure(self, bodies: Sequence[Placed], shutter: Shutter) -> Exposure | None:
        """Return what is painted: all that faces the camera, with boxes in the whole image; None where nothing does."""
        patterns = tuple(pattern for body in bodies for pattern in body.patterns)
        if not patterns:
            return None
        width, height = self.camera.image_size_px
        rolling = shutter.row_s > 0 and any(body.twist.any() for body in bodies)
        rows_s = (np.arange(height) - (height - 1) / 2) * shutter.row_s if rolling else np.zeros(1)
        ends_s = np.add.outer(np.array([-0.5, 0.5]) * shutter.exposure_s, rows_s[[0, -1] if rolling else [0]]).ravel()
        uv = self._each(lambda body: self._outlines(_moved(body, ends_s), body.patterns), bodies)
        bounds = np.concatenate([np.floor(uv.min(axis=(0, 2))) - 1, np.ceil(uv.max(axis=(0, 2))) + 2], axis=1)
        # What is behind the camera has no number there, and so no place in the image.
        boxes = np.fmax(np.fmin(bounds, (width, height, width, height)), 0.0).astype(np.int64)
        way_px = float(np.fmax.reduce(np.abs(uv[len(uv) // 2 :] - uv[: len(uv) // 2]), axis=None, initial=0.0))
        nodes, weights = _nodes(1 + math.ceil(max(way_px - _STILL_PX, 0.0)))
        t_s = np.add.outer(0.5 * shutter.exposure_s * nodes, rows_s)

        def placed(body: Placed) -> Array:
            Ts = _moved(body, t_s.ravel()).reshape(*t_s.shape, 4, 4)
            on = np.array([pattern.T_body_pattern for pattern in body.patterns])
            return np.asarray(Ts[:, None] @ on[:, None])

        Ts = self._each(placed, bodies)  # (S, P, R, 4, 4)
        # Its face is on the side that z points away from; what is behind the camera is not seen.
        faces = ((Ts[..., :3, 2] * Ts[..., :3, 3]).sum(axis=-1) > 0).all(axis=2) & (Ts[..., 2, 3] > 0).all(axis=2)
        order = np.argsort(np.where(faces, -np.linalg.norm(Ts[:, :, 0, :3, 3], axis=2), np.inf), axis=1, kind="stable")
        order = np.where(np.take_along_axis(faces, order, axis=1), order, -1)
        Ms = np.asarray(np.linalg.inv(Ts[..., :3, [0, 1, 3]]), dtype=np.float64)
        return Exposure(palette(patterns), 0.5 * weights, order, Ms, boxes)

    @staticmethod
    def _each(of: Callable[[Placed], Array], bodies: Sequence[Placed]) -> Array:
        """Return what each body gives, side by side along the second axis."""
        found = [of(body) for body in bodies if body.patterns]
        return found[0] if len(found) == 1 else np.concatenate(found, axis=1)

    def _outlines(self, Ts_camera_body: Array, patterns: tuple[Pattern, ...]) -> Array:
        """Return the edges of a body's patterns in pixels, (R, N, EDGE, 2), at poses (R, 4, 4)."""
        p = transform(Ts_camera_body[:, None, None], _edges(patterns))
        return self.camera.project(p.reshape(-1, 3)).reshape(*p.shape[:3], 2)

    def _painted(
        self, exposure: Exposure, crop: Window, window: Window, behind: tuple[Radiance, Radiance, Image]
    ) -> Radiance:
        """Return the light of the crop with the patterns painted in, through the lens, over the whole exposure."""
        u0, v0, u1, v1 = crop
        boxes = np.clip(exposure.boxes - (u0, v0, u0, v0), 0, (u1 - u0, v1 - v0) * 2)
        Ms = exposure.Ms
        Ms = np.ascontiguousarray(Ms[:, :, v0:v1]) if Ms.shape[2] > 1 else Ms
        total, edges = np.empty((v1 - v0, u1 - u0), np.float32), np.zeros((v1 - v0, u1 - u0), np.float32)
        layers = (behind[0][_part(crop, window)], behind[1][_part(crop, window)], behind[2][_part(crop, window)])
        shown, taps = exposure._replace(Ms=Ms, boxes=boxes), part_taps(LENS.psf_sigma_px)
        paint_faces(self._corners, self._rays, shown, (u0, v0), layers, taps, total, edges)
        return np.asarray(spread(total, LENS.psf_sigma_px) + edges)

    def _core(self, window: Window, margin: int) -> Window:
        """Return a window but for a margin where its blur did not know what is around; none at the image's border."""
        (width, height), (u0, v0, u1, v1) = self.camera.image_size_px, window
        return u0 + margin * (u0 > 0), v0 + margin * (v0 > 0), u1 - margin * (u1 < width), v1 - margin * (v1 < height)


def _part(part: Window, window: Window) -> tuple[slice, slice]:
    """Return the rows and columns of a part of a window."""
    return slice(part[1] - window[1], part[3] - window[1]), slice(part[0] - window[0], part[2] - window[0])


def _reach(sigma_px: float) -> int:
    """Return how far the lens spreads light, px."""
    return math.ceil(4.5 * sigma_px + 0.5)
