"""One camera's images of the cell: what stands still is kept, the arm and the body are drawn where they are.

The arm is cast anew within the pixels it can cover (cell_links), at the middle of the exposure. Flat patterns (the body, a
board, a card) are painted exactly over it by ``paint``, once for about every pixel they move during the exposure, and
what of the arm is nearer stays before them. Then the lens's blur, light and vignetting, noise and rounding, as in
``optics``. Noise comes from a long strip drawn once, begun elsewhere for every image.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Ids, Image, Record
from armsight.geometry.pose import exp_se3, inverse, transform
from armsight.sim import cell_links
from armsight.sim.cell_noise import Window, exposed
from armsight.sim.cell_scene import LAMP_BASE, View, arm_capsules, capsule_boxes, corner_rays, pixel_rays, view
from armsight.sim.cell_solids import Solids
from armsight.sim.optics import Optics, Radiance, Sensor, blurred, shaded, spread
from armsight.sim.paint import Grid, paint
from armsight.sim.paint_disc import paint_disc
from armsight.sim.paint_parts import SUB, Slots
from armsight.sim.render import OUTLINE, Shutter, outline
from armsight.sim.scene import CLEAR, Pattern, Placed
from armsight.vision.camera import Camera

#: The lens and the light, after the shading correction that cameras do themselves.
LENS = Optics(0.7, vignetting=0.08, light_gradient=(0.04, -0.04))
#: Points around a pattern or a disc that bound it in the image, and by how much those around a disc are further out.
EDGE, _OUT = 16, 1.02
_STILL_PX = 0.05  # what moves less is painted once


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _nearer(
    rays: Array,
    Ms: Array,
    box: Window,
    corner: tuple[int, int],
    behind: Array,
    depth: NDArray[np.float32],
    ids: NDArray[np.int16],
    coarse: Array,
    slot: Slots,
) -> None:
    """Put back what of the arm is nearer than a pattern that was painted over it.

    ``box`` is the painted part of the window whose first column and row are ``corner``; ``behind``, ``depth`` and ``ids``
    are what was there before, and ``Ms`` takes rays to the pattern's plane, whose third coordinate is 1 / distance.
    """
    for v in range(box[1], box[3]):
        M = Ms[min(v, Ms.shape[0] - 1)]
        for u in range(box[0], box[2]):
            if ids[v, u] == 0:
                continue
            y, x = v + corner[1], u + corner[0]
            if (M[2, 0] * rays[0, y, x] + M[2, 1] * rays[1, y, x] + M[2, 2] * rays[2, y, x]) * depth[v, u] < 1.0:
                coarse[v, u] = behind[v, u]
                slot[v, u] = -1


@dataclass(frozen=True, eq=False)
class ArmSeen(Record):
    """The arm at the moment of an exposure.

    Attributes:
        parts: what it is made of.
        Ts_base_link: (7, 4, 4) row frames.
    """

    parts: Solids
    Ts_base_link: Array


class _Face(NamedTuple):
    """A pattern that faces the camera.

    Attributes:
        pattern: what it is.
        Ts: (1 or H, 4, 4) its pose, or its pose as each row sees it.
        boxes: (1 + K, 4) the pixels of its cells and of each disc.
    """

    pattern: Pattern
    Ts: Array
    boxes: Ids


_Step = tuple[float, list[_Face]]


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


@lru_cache(maxsize=64)
def _grid(pattern: Pattern) -> Grid:
    """Return a pattern's cells as the painter takes them."""
    values = np.pad(pattern.values, 1, constant_values=CLEAR)
    return np.array(pattern.x_edges), np.array(pattern.y_edges), values


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
        self._rays = np.ascontiguousarray(rays.transpose(2, 0, 1))
        width, height = camera.image_size_px
        self._gain = shaded(np.full((height, width), self._sensor.gain, np.float32), LENS)
        self._still_grey = self._blur(self.still.light.copy()) * self._gain
        to_lamp = inverse(T_base_camera)[:3, :3] @ LAMP_BASE
        self._lamp = to_lamp / np.linalg.norm(to_lamp)

    @staticmethod
    def _blur(light: Array) -> Radiance:
        """Return an image without edge pixels through the lens."""
        return spread(light.astype(np.float32), LENS.psf_sigma_px)

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
        steps = self._steps(bodies, shutter)
        margin = _reach(LENS.psf_sigma_px)
        crop = self._around(
            [tuple(face.boxes[0].tolist()) for _, faces in (steps[0], steps[-1]) for face in faces], 2 * margin
        )
        window = self._around([crop, *(tuple(box) for box in boxes.tolist())], 2 * margin)
        u0, v0, u1, v1 = window
        light = self.still.light[v0:v1, u0:u1].copy()
        depth, ids = self.still.depth[v0:v1, u0:u1].copy(), np.zeros(light.shape, np.int16)
        cell_links.moving(self._rays, window, boxes, (ends, radius, albedo), self._lamp, light, depth, ids)
        seen = self._blur(light) if light.size else light.astype(np.float32)
        if crop[0] < crop[2] and crop[1] < crop[3]:
            core = self._core(crop, margin)
            painted = self._painted(steps, crop, window, (light, depth, ids))
            seen[_part(core, window)] = painted[_part(core, crop)]
        out: Image = np.empty(self._still_grey.shape, np.uint8)
        s = self._sensor
        core = self._core(window, margin)
        light_core = np.ascontiguousarray(seen[_part(core, window)])
        noises = (s.offset, s.read_noise, s.shot_noise)
        exposed(self._still_grey, light_core, self._gain, core, strip, start, noises, out)
        return out

    def arm_ids(self, arm: ArmSeen) -> Image:
        """Return (H, W) which of the arm's moving solids each pixel sees, counted from 1; 0 where it sees none."""
        width, height = self.camera.image_size_px
        capsules = arm_capsules(arm.parts, arm.Ts_base_link, self.T_base_camera)
        boxes, window = capsule_boxes(self.camera, *capsules[:2]), (0, 0, width, height)
        light, depth, ids = self.still.light.copy(), self.still.depth.copy(), np.zeros((height, width), np.int16)
        cell_links.moving(self._rays, window, boxes, capsules, self._lamp, light, depth, ids)
        return ids

    def _around(self, boxes: Sequence[tuple[int, ...]], margin: int) -> Window:
        """Return what holds all boxes that are not empty, with a margin, within the image."""
        full = np.array([box for box in boxes if box[0] < box[2] and box[1] < box[3]])
        if not len(full):
            return 0, 0, 0, 0
        u0, v0 = np.maximum(full[:, :2].min(axis=0) - margin, 0)
        u1, v1 = np.minimum(full[:, 2:].max(axis=0) + margin, self.camera.image_size_px)
        return int(u0), int(v0), int(u1), int(v1)

    def _steps(self, bodies: Sequence[Placed], shutter: Shutter) -> list[_Step]:
        """Return the parts of the exposure: weight; faces, farthest first."""
        way_px = 0.0
        for body in bodies if shutter.exposure_s else ():
            ends = body.T_camera_body @ exp_se3(np.outer((-0.5, 0.5), shutter.exposure_s * body.twist))
            before, after = (self._outlines(T[None], body.patterns) for T in ends)
            way_px = max(way_px, float(np.nan_to_num(np.abs(after - before)).max()))
        nodes, weights = _nodes(1 + math.ceil(max(way_px - _STILL_PX, 0.0)))
        steps = []
        for x, w in zip(nodes, weights, strict=True):
            faces = [face for body in bodies for face in self._seen(body, 0.5 * shutter.exposure_s * float(x), shutter)]
            faces.sort(key=lambda face: -float(np.linalg.norm(face.Ts[0, :3, 3])))
            steps.append((0.5 * float(w), faces))
        return steps

    def _outlines(self, Ts_camera_body: Array, patterns: tuple[Pattern, ...]) -> Array:
        """Return the edges of a body's patterns in pixels, (R, N, EDGE, 2), at poses (R, 4, 4)."""
        p = transform(Ts_camera_body[:, None, None], _edges(patterns))
        return self.camera.project(p.reshape(-1, 3)).reshape(*p.shape[:3], 2)

    def _seen(self, body: Placed, t_s: float, shutter: Shutter) -> list[_Face]:
        """Return what of a body faces the camera at a time."""
        width, height = self.camera.image_size_px
        moving = shutter.row_s > 0 and body.twist.any()
        rows = (np.arange(height) - (height - 1) / 2) * shutter.row_s if moving else np.zeros(1)
        Ts_camera_body = body.T_camera_body @ exp_se3(np.outer(rows + t_s, body.twist))
        uv = self._outlines(Ts_camera_body[[0, -1]] if moving else Ts_camera_body, body.patterns)
        low = np.clip(np.floor(uv.min(axis=(0, 2))) - 1, 0, (width, height))
        high = np.clip(np.ceil(uv.max(axis=(0, 2))) + 2, 0, (width, height))
        boxes = np.nan_to_num(np.concatenate([low, high], axis=1)).astype(np.int64)
        found, next_box = [], 0
        for pattern in body.patterns:
            first, next_box = next_box, next_box + 1 + len(pattern.discs)
            Ts = Ts_camera_body @ pattern.T_body_pattern
            # Its face is on the side that z points away from; what is behind the camera is not seen.
            if ((Ts[:, :3, 2] * Ts[:, :3, 3]).sum(axis=1) > 0).all() and (Ts[:, 2, 3] > 0).all():
                found.append(_Face(pattern, Ts, boxes[first:next_box]))
        return found

    def _painted(
        self,
        steps: list[_Step],
        crop: Window,
        window: Window,
        arm: tuple[Array, NDArray[np.float32], Image],
    ) -> Radiance:
        """Return the light of the crop with the patterns painted in, through the lens, over the whole exposure."""
        u0, v0, u1, v1 = crop
        light, depth, ids = (np.ascontiguousarray(layer[_part(crop, window)]) for layer in arm)
        rays = np.ascontiguousarray(self._corners[v0 : v1 + 1, u0 : u1 + 1])
        fine = np.empty((1 << 13, SUB, SUB))
        total = np.zeros(light.shape, np.float32)
        for weight, faces in steps:
            coarse, slot, count = light.copy(), np.full(light.shape, -1, np.int32), 0
            for pattern, Ts, boxes in faces:
                rows = Ts[v0:v1] if len(Ts) > 1 else Ts
                Ms = np.ascontiguousarray(np.linalg.inv(rows[:, :3, [0, 1, 3]]))
                inner = np.clip(boxes - (u0, v0, u0, v0), 0, (u1 - u0, v1 - v0) * 2).tolist()
                fine, count = paint(rays, Ms, tuple(inner[0]), _grid(pattern), coarse, slot, fine, count)
                for disc, box in zip(pattern.discs, inner[1:], strict=True):
                    fine, count = paint_disc(rays, Ms, tuple(box), np.array(disc), coarse, slot, fine, count)
                _nearer(self._rays, Ms, tuple(inner[0]), (u0, v0), light, depth, ids, coarse, slot)
            total += np.float32(weight) * blurred(coarse, slot, fine[:count], LENS.psf_sigma_px)
        return total

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
